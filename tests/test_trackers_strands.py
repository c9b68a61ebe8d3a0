"""From slices to strands: stretches of rope that are seen without a break, and which of their ends are clear."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import RED_TEXT, SHAPES
from ropetrace.config import RopeConfig
from ropetrace.evaluation.metrics import distances_to_curve
from ropetrace.sim.camera import Boxes, Capsules, Plane, RayCaster, Scene
from ropetrace.trackers import SlicingTracker
from ropetrace.trackers.clouds import arc_lengths, nearest_nodes
from ropetrace.trackers.strands import Strand, path_through, strands_of
from ropetrace.types import CloudFrame, FloatArray, Frame, Intrinsics, RgbdFrame

CAMERA = Intrinsics(320, 240, 277.0, 277.0, 159.5, 119.5)
DIAMETER = 0.015
STRAIGHT = np.array([[-0.02, -0.25, 0.9], [0.02, 0.2, 0.92]])
WALL = (Plane((0.0, 0.0, 1.0), 1.4, (90, 90, 90), 1),)

quick = settings(max_examples=50, deadline=None)


def curtain(top: float, bottom: float) -> Boxes:
    return Boxes.one((0.0, (top + bottom) / 2, 0.605), (1.0, bottom - top, 0.01), (40, 90, 200), 2)


def view(*curves: FloatArray, boxes: Boxes | None = None) -> RgbdFrame:
    capsules = sum((Capsules.along(curve, DIAMETER / 2) for curve in curves), Capsules.none())
    image = RayCaster(CAMERA).render(Scene(capsules, WALL, Boxes.none() if boxes is None else boxes))
    return RgbdFrame(0, image.depth, 1.0, CAMERA, image.color)


def strands_in(frame: Frame) -> list[Strand]:
    """From the upper to the lower, each downwards."""
    tracker = SlicingTracker(RopeConfig(DIAMETER, RED_TEXT))
    points, _, _ = tracker.rope_points(frame)
    strands = strands_of(path_through(tracker.slicer.slice(points), DIAMETER), points, frame, DIAMETER)
    down = [strand if strand.nodes[0, 1] < strand.nodes[-1, 1] else strand.reversed() for strand in strands]
    return sorted(down, key=lambda strand: float(strand.nodes[0, 1]))


def random_strand(seed: int) -> Strand:
    rng = np.random.default_rng(seed)
    nodes = np.cumsum(rng.normal(0, 0.02, (int(rng.integers(2, 12)), 3)), axis=0) + [0.0, 0.0, 1.0]
    reach = (float(rng.uniform(0, 0.01)), float(rng.uniform(0, 0.01)))
    clear = (bool(rng.integers(2)), bool(rng.integers(2)))
    return Strand.through(nodes, reach, clear, rng.uniform(0.01, 0.02, len(nodes)))


def assert_same(a: Strand, b: Strand) -> None:
    np.testing.assert_array_equal(a.nodes, b.nodes)
    np.testing.assert_array_equal(a.widths, b.widths)
    np.testing.assert_allclose(a.arc, b.arc, atol=1e-15)
    assert (a.length, a.reach, a.clear) == (b.length, b.reach, b.clear)


# --- what a strand is ---


@quick
@given(st.integers(0, 2**32 - 1))
def test_a_strand_that_is_reversed_twice_is_the_same(seed: int) -> None:
    strand = random_strand(seed)
    assert_same(strand.reversed().reversed(), strand)


@quick
@given(st.integers(0, 2**32 - 1))
def test_a_reversed_strand_is_what_its_reversed_nodes_make(seed: int) -> None:
    strand = random_strand(seed)
    again = Strand.through(strand.nodes[::-1], strand.reach[::-1], strand.clear[::-1], strand.widths[::-1])
    np.testing.assert_allclose(strand.reversed().arc, again.arc, atol=1e-12)
    np.testing.assert_allclose(strand.reversed().chain, again.chain, atol=1e-12)
    np.testing.assert_allclose(strand.chain[::-1], again.chain, atol=1e-12)
    assert strand.length == pytest.approx(again.length)
    assert (strand.reversed().reach, strand.reversed().clear) == (again.reach, again.clear)


@quick
@given(st.integers(0, 2**32 - 1))
def test_arc_runs_from_the_very_end_and_the_chain_is_as_long_as_the_strand(seed: int) -> None:
    strand = random_strand(seed)
    assert strand.arc[0] == strand.reach[0]
    assert strand.length - strand.arc[-1] == pytest.approx(strand.reach[1], abs=1e-12)
    assert arc_lengths(strand.chain)[-1] == pytest.approx(strand.length)


@quick
@given(st.integers(0, 2**31), st.integers(0, 2**31))
def test_joined_strands_have_the_ends_of_both_and_the_straight_way_between(first: int, second: int) -> None:
    a, b = random_strand(first), random_strand(second)
    joined = a.joined(b)
    np.testing.assert_array_equal(joined.nodes, np.concatenate([a.nodes, b.nodes]))
    np.testing.assert_array_equal(joined.widths, np.concatenate([a.widths, b.widths]))
    assert joined.reach == (a.reach[0], b.reach[1])
    assert joined.clear == (a.clear[0], b.clear[1])
    chord = float(np.linalg.norm(b.nodes[0] - a.nodes[-1]))
    assert joined.length == pytest.approx(a.length - a.reach[1] + chord + b.length - b.reach[0])


# --- strands of a frame ---


def test_a_straight_rope_is_one_strand_from_tip_to_tip_with_clear_ends() -> None:
    (strand,) = strands_in(view(STRAIGHT))
    assert strand.clear == (True, True)
    assert np.linalg.norm(strand.chain[[0, -1]] - STRAIGHT, axis=1).max() < DIAMETER
    assert strand.length == pytest.approx(np.linalg.norm(STRAIGHT[1] - STRAIGHT[0]), abs=DIAMETER)
    assert distances_to_curve(strand.nodes, STRAIGHT).max() < 0.001


def test_a_curtain_before_the_middle_makes_two_strands_whose_inner_ends_are_not_clear() -> None:
    upper, lower = strands_in(view(STRAIGHT, boxes=curtain(-0.04, 0.02)))
    assert upper.clear == (True, False)
    assert lower.clear == (False, True)
    scale = 0.9 / 0.6
    assert upper.chain[-1, 1] == pytest.approx(-0.04 * scale, abs=0.01)
    assert lower.chain[0, 1] == pytest.approx(0.02 * scale, abs=0.015)


def test_a_curtain_before_an_end_leaves_one_strand_that_may_go_on() -> None:
    (strand,) = strands_in(view(STRAIGHT, boxes=curtain(0.05, 0.3)))
    assert strand.clear == (True, False)
    (strand,) = strands_in(view(STRAIGHT, boxes=curtain(-0.3, -0.05)))
    assert strand.clear == (False, True)


def test_a_rope_that_leaves_the_image_may_go_on() -> None:
    (strand,) = strands_in(view(STRAIGHT * [1, 3, 1]))
    assert strand.clear == (False, False)


def test_two_ropes_are_two_strands_with_clear_ends() -> None:
    strands = strands_in(view(STRAIGHT - [0.1, 0.02, 0], STRAIGHT + [0.1, 0, 0]))
    assert [strand.clear for strand in strands] == [(True, True)] * 2
    assert [strand.nodes[:, 0].mean() < 0 for strand in strands] == [True, False]


def test_a_cloud_has_the_strands_of_its_image_but_all_ends_are_clear() -> None:
    frame = view(STRAIGHT, boxes=curtain(-0.04, 0.02))
    assert frame.color is not None
    rows, columns = np.nonzero((frame.color[..., 0] > 100) & (frame.color[..., 2] < 100) & (frame.depth < 1.0))
    z = frame.depth[rows, columns].astype(float)
    points = np.stack([(columns - CAMERA.cx) / CAMERA.fx * z, (rows - CAMERA.cy) / CAMERA.fy * z, z], axis=1)
    from_cloud = strands_in(CloudFrame(0, points, frame.color[rows, columns]))
    for strand, other in zip(from_cloud, strands_in(frame), strict=True):
        np.testing.assert_allclose(strand.nodes, other.nodes, atol=1e-6)
        assert strand.clear == (True, True)


WRONG_TURN = pytest.mark.xfail(strict=True, reason="a strand goes on along the wrong arm of the crossing")


@pytest.mark.parametrize("turn", [0.0, 15.0, pytest.param(35.0, marks=WRONG_TURN), 45.0])
def test_strands_of_a_rope_that_crosses_itself_follow_it_and_end_before_the_crossing(turn: float) -> None:
    """Nothing of them is in the wrong order: each runs along the curve in one direction."""
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    curve = SHAPES["crossing loop"] * 0.8 @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [0.0, 0.0, 0.1]
    strands = strands_in(view(curve))
    assert len(strands) > 1
    for strand in strands:
        assert distances_to_curve(strand.nodes, curve).max() < 0.5 * DIAMETER
        way = np.sign(np.diff(nearest_nodes(strand.nodes, curve)))
        assert (way == way[0]).all()
    assert sum(strand.length for strand in strands) > 0.7 * arc_lengths(curve)[-1]
    assert [end for strand in strands for end in strand.clear].count(True) == 2
