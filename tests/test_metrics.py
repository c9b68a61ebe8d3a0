"""Measures of curves and runs: known answers, equal to brute force, and blind to nothing that the paper's misses."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.distance import directed_hausdorff
from scipy.spatial.transform import Rotation

from ropetrace.evaluation.metrics import (
    at_equal_arc_length,
    coverage,
    curve_length,
    discrete_frechet,
    distances_to_curve,
    hausdorff,
    is_reversed,
    kinks,
    length_error,
    node_errors,
    one_way_mean,
    projections,
    resample,
    symmetric_mean,
    tangent_error,
    tip_errors,
)
from ropetrace.evaluation.paper_errors import angular_errors, linear_errors, mean_angular_error, mean_linear_error
from ropetrace.evaluation.sequences import (
    EndSwaps,
    ErrorStatistics,
    bootstrap_interval,
    end_swaps,
    false_ok_rate,
    frames_without_estimate,
    good_frames,
    loss_rate,
    times_to_recover,
)
from ropetrace.types import FloatArray, Status

LINE = np.array([[0.0, 0, 1], [1.0, 0, 1]])
NOTHING = np.empty((0, 3))
OK, DEGRADED, LOST = Status.OK, Status.DEGRADED, Status.LOST
seeds = st.integers(0, 2**32 - 1)


def brute_force(points: FloatArray, curve: FloatArray) -> FloatArray:
    """The nearest of many places on the curve: too far by no more than the second number."""
    t = np.linspace(0, 1, 2001)[:, None]
    places = np.concatenate([a + t * (b - a) for a, b in itertools.pairwise(curve)])
    return np.asarray(np.linalg.norm(points[:, None] - places[None], axis=2).min(axis=1))


@settings(max_examples=40, deadline=None)
@given(seeds, st.integers(2, 6), st.integers(1, 20))
def test_distances_equal_brute_force(seed: int, vertices: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    curve = rng.normal(0, 1, (vertices, 3))
    if vertices > 3:
        curve[2] = curve[1]  # a vertex twice
    points = np.concatenate([rng.normal(0, 2, (count, 3)), curve])
    step = np.linalg.norm(np.diff(curve, axis=0), axis=1).max() / 2000
    found, expected = distances_to_curve(points, curve), brute_force(points, curve)
    assert (found <= expected + 1e-12).all()
    assert (found >= expected - step).all()
    np.testing.assert_allclose(found[count:], 0, atol=1e-12)


def test_distances_beside_and_beyond_a_line() -> None:
    points = np.array([[0.5, 0.3, 1.4], [-3.0, 4.0, 1.0], [1.0, 0.0, 3.0]])
    np.testing.assert_allclose(distances_to_curve(points, LINE), [0.5, 5.0, 2.0], atol=1e-6)


def test_resampled_points_lie_at_equal_length() -> None:
    curve = np.array([[0.0, 0, 0], [3, 0, 0], [3, 4, 0]])
    points = resample(curve, 0.9)
    assert len(points) == 9
    np.testing.assert_allclose(points[[0, -1]], curve[[0, -1]])
    places = np.linspace(0, 7, 9)
    np.testing.assert_allclose(points[:, 0], np.minimum(places, 3))
    np.testing.assert_allclose(points[:, 1], np.maximum(places - 3, 0))
    assert len(resample(curve, 100.0)) == 2


def test_symmetric_mean_of_parallel_lines_and_of_itself() -> None:
    assert symmetric_mean(LINE + [0, 0.003, 0], LINE) == pytest.approx(0.003)
    assert symmetric_mean(LINE, LINE) == pytest.approx(0, abs=1e-15)


def test_a_tenth_of_the_rope_is_not_a_good_track() -> None:
    part = np.array([[0.0, 0.001, 1], [0.1, 0.001, 1]])
    assert distances_to_curve(resample(part, 0.001), LINE).mean() == pytest.approx(0.001)
    # 0.9 m of the truth lie up to 0.9 m away: 0.405 m on average.
    assert symmetric_mean(part, LINE) == pytest.approx((0.001 + 0.405) / 2, rel=0.01)
    assert coverage(part, LINE, 0.01) == pytest.approx(0.11, abs=0.002)


def test_symmetric_mean_does_not_depend_on_direction_order_or_vertices() -> None:
    rng = np.random.default_rng(0)
    a = np.cumsum(rng.normal(0, 0.1, (6, 3)), axis=0)
    b = a + rng.normal(0, 0.01, a.shape)
    once = symmetric_mean(a, b)
    assert symmetric_mean(b, a) == pytest.approx(once)
    assert symmetric_mean(a[::-1], b) == pytest.approx(once, rel=1e-3)
    assert symmetric_mean(resample(a, 1e-4), b) == pytest.approx(once, rel=1e-2)


def test_coverage_counts_length_within_the_threshold() -> None:
    half = np.array([[0.0, 0, 1], [0.5, 0, 1]])
    assert coverage(half, LINE, 0.0001) == pytest.approx(0.5, abs=0.002)
    assert coverage(LINE, half, 0.0001) == 1.0
    assert coverage(LINE + [0, 0.011, 0], LINE, 0.01) == 0.0


def polyline_from(seed: int, vertices: int, size: float = 0.1) -> FloatArray:
    return np.asarray(np.cumsum(np.random.default_rng(seed).normal(0, size, (vertices, 3)), axis=0))


# --- projections ---


def projections_twin(points: FloatArray, polyline: FloatArray) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """The kernel's formula on whole arrays."""
    steps = np.diff(polyline, axis=0)
    offsets = points[:, None] - polyline[None, :-1]
    fractions = np.clip((offsets * steps).sum(axis=2) / (steps**2).sum(axis=1), 0, 1)
    distances = np.linalg.norm(offsets - fractions[..., None] * steps, axis=2)
    segments = np.argmax(distances <= distances.min(axis=1, keepdims=True) + 1e-12, axis=1)
    rows = np.arange(len(points))
    return segments, fractions[rows, segments], distances[rows, segments]


@settings(max_examples=40, deadline=None)
@given(seeds, st.integers(2, 12), st.integers(0, 30))
def test_projections_equal_their_twin(seed: int, vertices: int, count: int) -> None:
    polyline = polyline_from(seed, vertices)
    points = np.concatenate([np.random.default_rng(seed).normal(0, 0.3, (count, 3)), polyline])
    found, twin = projections(points, polyline), projections_twin(points, polyline)
    np.testing.assert_array_equal(found.segments, twin[0])
    np.testing.assert_allclose(found.fractions, twin[1], atol=1e-9)
    np.testing.assert_allclose(found.distances, twin[2], atol=1e-12)
    places = polyline[found.segments] + found.fractions[:, None] * np.diff(polyline, axis=0)[found.segments]
    np.testing.assert_allclose(np.linalg.norm(points - places, axis=1), found.distances, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_a_joint_belongs_to_the_first_of_its_links_whatever_the_round_off(seed: int) -> None:
    rng = np.random.default_rng(seed)
    steps = np.array([[0.0, 0, 0], [0.055, 0, 0], [0.055, 0.055, 0], [0.11, 0.055, 0]])
    polyline = Rotation.from_quat(rng.normal(size=4)).apply(steps) + rng.normal(0, 1, 3)
    np.testing.assert_array_equal(projections(polyline, polyline).segments, [0, 0, 1, 2])
    outside = polyline[1] + 0.3 * (polyline[1] - (polyline[0] + polyline[2]) / 2)
    assert projections(outside[None], polyline).segments[0] == 0


def test_segments_without_length_are_passed_over() -> None:
    repeated = np.array([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0]])
    found = projections(np.array([[-1.0, 0, 0], [0.25, 2, 0], [3, 0, 0]]), repeated)
    np.testing.assert_array_equal(found.segments, [1, 1, 1])
    np.testing.assert_allclose(found.fractions, [0, 0.25, 1])
    point = projections(np.array([[0.0, 3, 4]]), np.zeros((3, 3)))
    assert (point.segments[0], point.fractions[0], point.distances[0]) == (0, 0.0, 5.0)


@pytest.mark.parametrize("curve", [NOTHING, LINE[:1], np.array([[0.0, 0, math.nan], [1, 0, 0]]), LINE[:, :2]])
def test_a_truth_that_is_no_curve_is_an_error(curve: FloatArray) -> None:
    measures: list[Callable[[FloatArray, FloatArray], object]] = [
        projections, linear_errors, one_way_mean, symmetric_mean, hausdorff, discrete_frechet, node_errors, is_reversed,
        tip_errors, length_error, tangent_error, lambda a, b: coverage(a, b, 0.01),
    ]  # fmt: skip
    for measure in measures:
        with pytest.raises(ValueError, match=r"shape|finite"):
            measure(LINE, curve)


def test_a_point_that_is_not_finite_is_an_error() -> None:
    with pytest.raises(ValueError, match="points: a coordinate is not a finite number"):
        projections(np.array([[0.0, math.nan, 0]]), LINE)


def test_no_estimate_is_no_number_and_covers_nothing() -> None:
    for estimate in (NOTHING, LINE[:1]):
        for measure in (one_way_mean, symmetric_mean, hausdorff, discrete_frechet, length_error, tangent_error):
            assert math.isnan(measure(estimate, LINE)), measure
        assert np.isnan(node_errors(estimate, LINE, 7)).tolist() == [True] * 7
        assert np.isnan(tip_errors(estimate, LINE)).all()
        assert is_reversed(estimate, LINE) is None
        assert coverage(estimate, LINE, 10.0) == 0
    assert math.isnan(mean_linear_error(NOTHING, LINE))
    assert math.isnan(mean_angular_error(NOTHING, np.empty((0, 4)), LINE, np.array([[0.0, 0, 0, 1]])))
    assert kinks(NOTHING) == 0


# --- the paper's errors ---


def about_z(angle: float) -> list[float]:
    return [0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2)]


def test_linear_errors_of_a_bent_rope() -> None:
    polyline = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0]])
    waypoints = np.array([[-0.03, 0.04, 0], [0.05, 0, 0.002], [0.102, 0.07, 0], [0.1, 0.1, 0.01]])
    np.testing.assert_allclose(linear_errors(waypoints, polyline), [0.05, 0.002, 0.002, 0.01], atol=1e-15)
    assert mean_linear_error(waypoints, polyline) == pytest.approx(0.016)


def test_angular_errors_of_a_bent_rope() -> None:
    polyline = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0]])
    links = np.array([about_z(0), about_z(np.pi / 2)])
    # On the first link, at the joint (so of the first link), on the second link, and turned right round.
    positions = np.array([[0.05, 0.001, 0], [0.1, 0, 0], [0.1, 0.05, 0], [0.1, 0.09, 0]])
    quaternions = np.array([about_z(0.2), about_z(np.pi / 4), about_z(np.pi / 2 - 0.1), about_z(-np.pi / 2)])
    expected = [0.2, np.pi / 4, 0.1, np.pi]
    found = angular_errors(positions, quaternions, polyline, links)
    np.testing.assert_allclose(found, expected, atol=1e-7)
    assert mean_angular_error(positions, quaternions, polyline, links) == pytest.approx(np.mean(expected))


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_angular_errors_equal_the_angle_of_the_rotation_between(seed: int) -> None:
    rng = np.random.default_rng(seed)
    polyline = polyline_from(seed, 11)
    ours, links = Rotation.from_quat(rng.normal(size=(50, 4))), Rotation.from_quat(rng.normal(size=(10, 4)))
    positions = rng.normal(0, 0.3, (50, 3))
    segments = projections_twin(positions, polyline)[0]
    expected = (ours * links[segments].inv()).magnitude()
    signs = rng.choice([-1.0, 1.0], (50, 1))
    found = angular_errors(positions, signs * ours.as_quat(), polyline, -links.as_quat())
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_equal_orientations_differ_by_nothing_even_where_round_off_or_single_precision_exceeds_a_norm_of_1() -> None:
    rng = np.random.default_rng(3)
    same = Rotation.from_quat(rng.normal(size=(1000, 4))).as_quat()
    for factor in (1.0, 1 + 1e-15, 1 - 1e-6, 1 + 1e-3):
        for index in range(0, 1000, 10):
            pair = same[[index]]
            for sign in (-1, 1):
                assert angular_errors(LINE[:1], sign * factor * pair, LINE, pair)[0] < 1e-7
    single = same.astype(np.float32)
    for index in range(1000):
        assert angular_errors(LINE[:1], single[[index]], LINE, same[[index]])[0] < 1e-6


@pytest.mark.parametrize("bad", [[[0.0, 0, 0, 0]], [[0.0, 0, 0, math.nan]], [[0.0, 0, 1]], [[0.0, 0, 0, 1]] * 2])
def test_a_quaternion_that_is_none_is_an_error(bad: list[list[float]]) -> None:
    good = np.array([[0.0, 0, 0, 1]])
    for pair in ((np.array(bad), good), (good, np.array(bad))):
        with pytest.raises(ValueError, match="quaternions"):
            angular_errors(LINE[:1], pair[0], LINE, pair[1])


# --- distances between curves ---


def frechet_twin(a: FloatArray, b: FloatArray) -> float:
    """The shortest leash over every way of walking on: one, the other, or both."""
    here = float(np.linalg.norm(a[0] - b[0]))
    steps = [(a[i:], b[j:]) for i, j in ((1, 0), (0, 1), (1, 1)) if len(a) > i and len(b) > j]
    return max(here, min(frechet_twin(*step) for step in steps)) if steps else here


@settings(max_examples=30, deadline=None)
@given(seeds, st.integers(2, 6), st.integers(2, 6))
def test_frechet_equals_every_walk_tried(seed: int, ours: int, true: int) -> None:
    a, b = polyline_from(seed, ours), polyline_from(seed + 1, true)
    spacing = max(curve_length(a), curve_length(b)) / 5
    expected = frechet_twin(resample(a, spacing), resample(b, spacing))
    assert discrete_frechet(a, b, spacing) == pytest.approx(expected, rel=1e-12)


@settings(max_examples=30, deadline=None)
@given(seeds, st.floats(0, 0.1))
def test_frechet_of_curves_that_lie_close_equals_every_walk_tried(seed: int, noise: float) -> None:
    a = polyline_from(seed, 5)
    b = a + np.random.default_rng(seed).normal(0, noise, a.shape)
    spacing = curve_length(a) / 5
    expected = frechet_twin(resample(a, spacing), resample(b, spacing))
    assert discrete_frechet(a, b, spacing) == pytest.approx(expected, rel=1e-12)
    assert discrete_frechet(a, a, spacing) == 0
    assert discrete_frechet(a + [0.0, 0.03, 0.04], a, spacing) == pytest.approx(0.05)


@settings(max_examples=30, deadline=None)
@given(seeds, st.integers(2, 6), st.integers(2, 6))
def test_distances_keep_their_known_order(seed: int, ours: int, true: int) -> None:
    a, b = polyline_from(seed, ours), polyline_from(seed + 1, true)
    one_way, symmetric, worst, leash = (f(a, b) for f in (one_way_mean, symmetric_mean, hausdorff, discrete_frechet))
    assert symmetric == pytest.approx((one_way + one_way_mean(b, a)) / 2)
    assert one_way <= worst + 1e-12
    assert symmetric <= worst + 1e-12
    assert hausdorff(a, b, 95) <= worst <= leash + 1e-12
    # Two walkers at equal parts of the length have one of the leashes that Frechet chooses from.
    assert leash <= node_errors(a, b, 2001).max() + 0.002
    for symmetrical in (symmetric_mean, hausdorff, discrete_frechet):
        assert symmetrical(a, b) == pytest.approx(symmetrical(b, a), rel=1e-12)


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_hausdorff_equals_scipys_between_dense_samples(seed: int) -> None:
    a, b = polyline_from(seed, 5), polyline_from(seed + 1, 4)
    dense = resample(a, 0.001), resample(b, 0.001)
    expected = max(directed_hausdorff(*dense)[0], directed_hausdorff(*dense[::-1])[0])
    assert hausdorff(a, b) == pytest.approx(expected, abs=0.001)


def test_a_tail_of_less_than_a_twentieth_is_not_in_the_95_percent_hausdorff_distance() -> None:
    def with_tail(length: float) -> FloatArray:
        return np.array([[0.0, 0.002, 1], [1.0, 0.002, 1], [1.0, length, 1]])

    assert hausdorff(with_tail(0.04), LINE) == pytest.approx(0.04)
    assert hausdorff(with_tail(0.04), LINE, 95) == pytest.approx(0.002, abs=1e-4)
    assert hausdorff(LINE, with_tail(0.04), 95) == pytest.approx(0.002, abs=1e-4)
    assert hausdorff(with_tail(0.2), LINE, 95) == pytest.approx(0.2 - 0.05 * 1.198, abs=0.001)


def test_what_each_measure_sees_of_a_rope_half_a_metre_long() -> None:
    """The three tracks of the reliability study: 3 mm off and short at the tip, a tenth only, and doubled back."""
    truth = np.array([[0.0, 0, 1], [0.55, 0, 1]])
    full = np.array([[0.0, 0.003, 1], [0.525, 0.003, 1]])
    tenth = np.array([[0.0, 0.001, 1], [0.055, 0.001, 1]])
    doubled = np.array([[0.0, 0.003, 1], [0.525, 0.003, 1], [0.0, 0.003, 1]])
    for estimate, one_way, symmetric, worst, leash, cover, length in (
        (full, 0.003, 0.0033, 0.0252, 0.0252, 0.97, -0.045),
        (tenth, 0.001, 0.112, 0.495, 0.495, 0.12, -0.9),
        (doubled, 0.003, 0.0033, 0.0252, 0.55, 0.97, 0.909),
    ):
        assert one_way_mean(estimate, truth) == pytest.approx(one_way, abs=1e-6)
        assert symmetric_mean(estimate, truth) == pytest.approx(symmetric, rel=0.02)
        assert hausdorff(estimate, truth) == pytest.approx(worst, abs=2e-4)
        assert discrete_frechet(estimate, truth) == pytest.approx(leash, abs=2e-4)
        assert coverage(estimate, truth, 0.010) == pytest.approx(cover, abs=0.01)
        assert length_error(estimate, truth) == pytest.approx(length, abs=0.001)


def test_node_and_tip_errors_see_a_slide_along_the_rope() -> None:
    slid = LINE + [0.03, 0.04, 0]
    np.testing.assert_allclose(node_errors(slid, LINE, 11), 0.05)
    assert tip_errors(slid, LINE) == pytest.approx((0.05, 0.05))
    # Stretched by a tenth beyond the end: the error grows from nothing to 10 cm.
    longer = np.array([[0.0, 0, 1], [1.1, 0, 1]])
    np.testing.assert_allclose(node_errors(longer, LINE, 11), np.linspace(0, 0.1, 11), atol=1e-15)
    assert tip_errors(longer, LINE) == pytest.approx((0, 0.1))
    # The vertices do not matter, the length does.
    np.testing.assert_allclose(node_errors(at_equal_arc_length(longer, 37), LINE, 11), np.linspace(0, 0.1, 11))


def test_a_reversed_rope_is_told_by_its_whole_and_not_by_its_ends() -> None:
    def ring(start: float, end: float) -> FloatArray:
        turn = np.pi * np.linspace(start, end, 200)
        return np.stack([0.1 * np.cos(turn), 0.1 * np.sin(turn), np.ones(200)], axis=1)

    curve = ring(0, 1.9)
    assert is_reversed(curve, curve) is False
    assert is_reversed(curve[::-1], curve) is True
    early = ring(-0.08, 1.7)  # its start is nearer to the true end
    assert np.linalg.norm(early[0] - curve[-1]) < np.linalg.norm(early[0] - curve[0])
    assert is_reversed(early, curve) is False
    assert is_reversed(early[::-1], curve) is True
    reversed_line = LINE[::-1]
    assert discrete_frechet(reversed_line, LINE) == pytest.approx(1)
    assert symmetric_mean(reversed_line, LINE) == pytest.approx(0, abs=1e-15)


def test_length_error_is_signed_and_relative() -> None:
    assert length_error(LINE / 2, LINE) == pytest.approx(-0.5)
    assert length_error(2 * LINE, LINE) == pytest.approx(1.0)
    assert length_error(LINE, LINE) == 0
    with pytest.raises(ValueError, match="no length"):
        length_error(LINE, np.zeros((2, 3)))


def test_tangent_error_of_turned_lines_and_of_a_zigzag() -> None:
    for angle in (1e-9, 0.01, 0.7, np.pi / 2):
        turned = np.array([[0.0, 0, 1], [math.cos(angle), math.sin(angle), 1]])
        assert tangent_error(turned, LINE) == pytest.approx(angle, rel=1e-6)
        assert tangent_error(turned[::-1], LINE) == pytest.approx(angle, rel=1e-6)
    x = np.arange(0, 1.01, 0.1)
    zigzag = np.stack([x, 0.1 * (np.arange(11) % 2), np.ones(11)], axis=1)
    assert tangent_error(zigzag, LINE) == pytest.approx(np.pi / 4, rel=0.01)
    # Each half is compared with its own link; a vertex twice is no link.
    bent = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0]])
    assert tangent_error(bent + [0.0, 0, 0.002], bent) == pytest.approx(0, abs=1e-9)


def test_kinks_are_turns_of_more_than_60_degrees() -> None:
    def turning(degrees: float) -> FloatArray:
        angle = np.radians(degrees)
        return np.array([[0.0, 0, 0], [1, 0, 0], [1 + math.cos(angle), math.sin(angle), 0]])

    assert [kinks(turning(degrees)) for degrees in (0, 30, 59, 61, 90, 179.9, 180)] == [0, 0, 0, 1, 1, 1, 1]
    assert kinks(turning(50), limit=np.radians(45)) == 1
    staircase = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 0], [2, 1, 0], [2, 2, 0]])
    assert kinks(staircase) == 3
    assert kinks(staircase[:2]) == kinks(staircase[:1]) == 0


# --- over a run ---


def test_statistics_count_a_frame_without_an_estimate_as_the_stated_failure() -> None:
    found = ErrorStatistics.of([0.001, math.nan, 0.003, math.nan], penalty=0.5)
    assert (found.count, found.missing, found.penalty, found.worst) == (4, 2, 0.5, 0.5)
    assert found.mean == pytest.approx((0.001 + 0.003 + 1.0) / 4)
    assert found.median == pytest.approx((0.003 + 0.5) / 2)
    assert found.std == pytest.approx(np.std([0.001, 0.003, 0.5, 0.5]))
    assert found.p95 == pytest.approx(0.5)
    whole = ErrorStatistics.of(np.arange(101.0), penalty=1000)
    assert (whole.missing, whole.mean, whole.median, whole.p95, whole.worst) == (0, 50, 50, 95, 100)
    assert whole.std == pytest.approx(np.sqrt((101**2 - 1) / 12))
    # Losing every second frame is never better than keeping it.
    assert ErrorStatistics.of([0.1] * 10, 0.55).mean < ErrorStatistics.of([0.1, math.inf] * 5, 0.55).mean


def test_statistics_say_what_is_missing() -> None:
    assert ErrorStatistics.of([0.002, math.nan], 0.55).describe("mm", 1000) == (
        "mean 276 mm, std 274 mm, median 276 mm, p95 522.6 mm, worst 550 mm; "
        "2 frames, 1 without an estimate, each counted as 550 mm"
    )
    text = str(ErrorStatistics.of([0.25, 0.75], 1.0))
    assert text == "mean 0.5, std 0.25, median 0.5, p95 0.725, worst 0.75; 2 frames, 0 without an estimate"


@pytest.mark.parametrize(
    ("errors", "penalty"), [([], 1.0), ([1.0], 0.0), ([1.0], math.nan), ([1.0], math.inf), ([-1.0], 1.0)]
)
def test_statistics_of_nothing_or_with_a_free_failure_are_an_error(errors: list[float], penalty: float) -> None:
    with pytest.raises(ValueError, match=r"errors|penalty"):
        ErrorStatistics.of(errors, penalty)


def test_end_swaps_are_counted_across_frames_without_an_estimate() -> None:
    assert end_swaps([False] * 5) == EndSwaps(0, 5)
    assert end_swaps([True] * 5).count == 0  # the other end throughout: no swap
    swaps = end_swaps([False, None, True, True, None, True, False, None])
    assert swaps == EndSwaps(2, 5)
    assert swaps.per_thousand_frames == pytest.approx(400)
    assert math.isnan(end_swaps([None, None]).per_thousand_frames)


def test_end_swaps_of_a_rope_that_is_flipped_now_and_then() -> None:
    curves = [polyline_from(7, 8) + 0.01 * k for k in range(100)]
    flipped = [40 <= k < 60 for k in range(100)]
    found = [is_reversed(curve[::-1] if flip else curve, curve) for curve, flip in zip(curves, flipped, strict=True)]
    assert found == flipped
    assert end_swaps(found).per_thousand_frames == pytest.approx(20)


def test_good_frames_losses_and_false_oks() -> None:
    statuses = [OK, OK, DEGRADED, LOST, None, OK, OK]
    errors = np.array([0.001, 0.03, 0.001, math.nan, math.nan, 0.0299, math.nan])
    good = good_frames(statuses, errors, radius=0.01)
    assert good.tolist() == [True, False, True, False, False, True, False]
    assert loss_rate(good) == pytest.approx(4 / 7)
    assert frames_without_estimate(statuses) == 2
    # OK and 3 radii away or without a curve; a degraded or lost frame claims nothing.
    frechet = np.array([0.5, 0.03, 0.5, math.nan, 0.5, 0.001, math.nan])
    assert false_ok_rate(statuses, frechet, radius=0.01) == pytest.approx(2 / 7)
    with pytest.raises(ValueError, match="one value a frame"):
        good_frames(statuses, errors[:-1], 0.01)
    with pytest.raises(ValueError, match="one value a frame"):
        false_ok_rate(statuses, frechet[:-1], 0.01)


def flags(text: str) -> NDArray[np.bool_]:
    return np.array([letter == "x" for letter in text], dtype=bool)


@pytest.mark.parametrize(
    ("visible", "good", "expected"),
    [
        ("xxxxxxxx", "...xxxxx", []),  # never out of sight
        ("xx..xxxx", "xx..xxxx", [0.0]),
        ("xx..xxxx", "xx....xx", [0.2]),
        ("xx..xxxx", "xxxx.xxx", [0.1]),  # good while hidden is no recovery
        (".xx..xxx", "..x....x", [0.1, 0.2]),
        ("x.xx.xxx", "x.....xx", [math.inf, 0.1]),  # hidden again before it was found
        ("xxxx.xxx", "xxxx....", [math.inf]),
        ("xxxxxx..", "xxxxxx..", []),
    ],
)
def test_times_to_recover(visible: str, good: str, expected: list[float]) -> None:
    stamps = 5_000_000_000 + 100_000_000 * np.arange(8, dtype=np.int64)
    assert times_to_recover(stamps, flags(visible), flags(good)) == pytest.approx(expected)


def test_times_to_recover_needs_stamps_in_order() -> None:
    with pytest.raises(ValueError, match="runs back"):
        times_to_recover(np.array([0, 2, 1]), flags("xxx"), flags("xxx"))
    with pytest.raises(ValueError, match="one value a frame"):
        times_to_recover(np.array([0, 1, 2]), flags("xx"), flags("xxx"))


def test_bootstrap_interval_is_that_of_theory_and_repeats() -> None:
    figures = np.random.default_rng(2).normal(5, 2, 400)
    low, high = bootstrap_interval(figures)
    half = 1.96 * figures.std() / 20
    assert (low, high) == pytest.approx((figures.mean() - half, figures.mean() + half), abs=0.02)
    assert bootstrap_interval(figures) == (low, high) != bootstrap_interval(figures, seed=1)
    narrow = bootstrap_interval(figures, confidence=0.5)
    assert low < narrow[0] < narrow[1] < high
    # Of two runs, a quarter of the draws is the lesser one twice.
    assert bootstrap_interval([1.0, 3.0]) == (1.0, 3.0)
    assert bootstrap_interval([1.0, 3.0], confidence=0.4) == (2.0, 2.0)
    assert bootstrap_interval([2.0, 2.0, 2.0]) == (2.0, 2.0)


@pytest.mark.parametrize("figures", [[], [1.0], [1.0, math.nan]])
def test_bootstrap_interval_of_one_run_is_an_error(figures: list[float]) -> None:
    with pytest.raises(ValueError, match="two runs or more"):
        bootstrap_interval(figures)
