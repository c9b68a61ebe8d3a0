"""The centreline: SciPy's natural spline at equal arc length, and frames that turn only as the rope does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from helpers import SHAPES, at_equal_length, random_rotation
from ropetrace.centerline import (
    chain_tangents,
    extend_to_tips,
    make_waypoints,
    sample_spline,
    waypoint_frames,
    waypoints_through,
)
from ropetrace.types import FloatArray, Waypoints

seeds = st.integers(0, 2**32 - 1)


def wavy(rng: np.random.Generator, count: int) -> FloatArray:
    """A chain of `count` nodes 1 to 5 cm apart."""
    steps = rng.normal(0, 1, (count - 1, 3)) + rng.normal(0, 2, 3)
    steps *= rng.uniform(0.01, 0.05, (count - 1, 1)) / np.linalg.norm(steps, axis=1, keepdims=True)
    return np.concatenate([[[0.0, 0.0, 1.0]], 1 + np.cumsum(steps, axis=0) - [1, 1, 0]])


def chord_knots(chain: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(chain, axis=0), axis=1))])


# --- the curve ---


@settings(max_examples=60, deadline=None)
@given(seeds, st.integers(2, 40), st.floats(0.001, 0.05))
def test_spline_is_scipys_natural_spline(seed: int, count: int, spacing: float) -> None:
    chain = wavy(np.random.default_rng(seed), count)
    positions, tangents, arc_length = sample_spline(chain, spacing)
    knots = chord_knots(chain)
    spline = CubicSpline(knots, chain, bc_type="natural")
    fine = np.linspace(0, knots[-1], 40 * count + 1)
    length = chord_knots(spline(fine))
    # Each sample is on SciPy's curve, and at its place on it as closely as chords measure the length.
    places = np.interp(arc_length / arc_length[-1] * length[-1], length, fine)
    np.testing.assert_allclose(positions, spline(places), atol=6e-2 * knots[-1] / count)
    for index in range(0, len(positions), max(1, len(positions) // 7)):
        near = np.linspace(places[index] - 0.01, places[index] + 0.01, 4001).clip(0, knots[-1])
        offsets = np.linalg.norm(spline(near) - positions[index], axis=1)
        assert offsets.min() < 1e-5
        slope = spline(near[offsets.argmin()], 1)
        assert tangents[index] @ slope / np.linalg.norm(slope) > 1 - 1e-5
    np.testing.assert_allclose(np.linalg.norm(tangents, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(positions[[0, -1]], chain[[0, -1]], atol=1e-12)
    assert arc_length[-1] == pytest.approx(length[-1], rel=5e-3)


@pytest.mark.parametrize("name", SHAPES)
def test_samples_lie_at_equal_arc_length(name: str) -> None:
    chain = at_equal_length(SHAPES[name], 40)
    positions, _, arc_length = sample_spline(chain, 0.006)
    np.testing.assert_allclose(np.diff(arc_length), arc_length[-1] / (len(arc_length) - 1), rtol=1e-9)
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert steps.max() / steps.min() < 1.03
    assert abs(arc_length[1] - 0.006) < 0.006 / len(arc_length) + 1e-9


def test_two_nodes_make_a_straight_line() -> None:
    chain = np.array([[0.0, 0, 1], [0.1, 0, 1]])
    positions, tangents, arc_length = sample_spline(chain, 0.01)
    np.testing.assert_allclose(positions[:, 0], np.linspace(0, 0.1, 11), atol=1e-15)
    np.testing.assert_allclose(tangents, np.tile([1.0, 0, 0], (11, 1)))
    assert arc_length[-1] == pytest.approx(0.1)


def test_a_spacing_longer_than_the_rope_leaves_its_two_ends() -> None:
    positions, _, arc_length = sample_spline(np.array([[0.0, 0, 1], [0.1, 0, 1]]), 5.0)
    np.testing.assert_allclose(positions[:, 0], [0, 0.1])
    np.testing.assert_allclose(arc_length, [0, 0.1])


def test_a_rope_of_kilometres_has_a_bounded_number_of_waypoints() -> None:
    positions, _, arc_length = sample_spline(np.array([[0.0, 0, 1], [1e9, 0, 1], [2e9, 5, 1]]), 0.006)
    assert len(positions) <= 100_001
    assert arc_length[-1] == pytest.approx(2e9)


@settings(max_examples=60, deadline=None)
@given(seeds, st.integers(3, 30))
def test_tangents_of_the_parabola_through_three_neighbours(seed: int, count: int) -> None:
    chain = wavy(np.random.default_rng(seed), count)
    knots = chord_knots(chain)
    for index, tangent in enumerate(chain_tangents(chain)):
        first = min(max(index - 1, 0), count - 3)
        window = slice(first, first + 3)
        slope = np.array(
            [np.polyval(np.polyder(np.polyfit(knots[window] - knots[index], chain[window, k], 2)), 0) for k in range(3)]
        )
        np.testing.assert_allclose(tangent, slope / np.linalg.norm(slope), atol=1e-7)


def test_tangents_of_two_nodes() -> None:
    np.testing.assert_allclose(chain_tangents(np.array([[0.0, 0, 1], [0, 2, 1]])), [[0, 1, 0], [0, 1, 0]])


def test_tips_reach_on_along_the_ends() -> None:
    angle = np.linspace(0, 1, 30)
    chain = np.stack([np.cos(angle), np.sin(angle), np.ones(30)], axis=1)
    extended = extend_to_tips(chain, (0.01, 0.03))
    np.testing.assert_array_equal(extended[1:-1], chain)
    np.testing.assert_allclose(np.linalg.norm(extended[[0, -1]] - chain[[0, -1]], axis=1), [0.01, 0.03])
    ahead = [np.cos(1 + 0.03), np.sin(1 + 0.03), 1]
    behind = [np.cos(-0.01), np.sin(-0.01), 1]
    np.testing.assert_allclose(extended[[0, -1]], [behind, ahead], atol=1e-3)


# --- the frames ---


def assert_rotations(frames: FloatArray) -> None:
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.tile(np.eye(3), (len(frames), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(frames), 1, atol=1e-12)


def turn_angles(frames: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_matrix(frames[1:] @ frames[:-1].transpose(0, 2, 1)).magnitude())


@settings(max_examples=80, deadline=None)
@given(seeds, st.integers(1, 60), st.sampled_from([0.0, 0.05, 0.3, 1.0]))
def test_frames_are_rotations_with_x_along_the_rope(seed: int, count: int, spread: float) -> None:
    """Random tangents, many of them close to the viewing axis or on it, towards the camera or away."""
    rng = np.random.default_rng(seed)
    tangents = rng.normal(0, 1, (count, 3)) * [spread, spread, 1]
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    frames = waypoint_frames(tangents)
    assert_rotations(frames)
    np.testing.assert_allclose(frames[:, :, 0], tangents, atol=1e-12)


def test_away_from_the_view_frames_are_the_papers() -> None:
    rng = np.random.default_rng(0)
    tangents = rng.normal(0, 1, (200, 3))
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    tangents = tangents[np.hypot(tangents[:, 0], tangents[:, 1]) > 0.2]
    frames = waypoint_frames(tangents)
    y = np.cross(tangents, [0, 0, 1])
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    np.testing.assert_allclose(frames[:, :, 1], y, atol=1e-12)
    np.testing.assert_allclose(frames[:, :, 2], np.cross(tangents, y), atol=1e-12)


@pytest.mark.parametrize("offset", [0.0, 1e-9, 1e-3, 0.05, 0.15, 0.19])
@pytest.mark.parametrize("sign", [1, -1])
def test_frames_are_continuous_through_the_viewing_axis(offset: float, sign: int) -> None:
    """The tangent sweeps a half circle that passes the viewing axis at a small distance, or meets it."""
    angle = np.linspace(0, np.pi, 400)
    tangents = np.stack([np.cos(angle), np.full(400, offset), sign * np.sin(angle)], axis=1)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    frames = waypoint_frames(tangents)
    assert_rotations(frames)
    # The rope turns by 0.45 degrees a step; half a turn of twist may be spread over the 23 degrees near the axis.
    assert np.degrees(turn_angles(frames).max()) < 6


def test_an_end_that_turns_to_the_camera_carries_its_frame_without_twist() -> None:
    angle = np.linspace(0, np.pi / 2, 300)
    tangents = np.stack([np.cos(angle), np.zeros(300), np.sin(angle)], axis=1)
    for ordered in (tangents, tangents[::-1]):
        frames = waypoint_frames(ordered)
        np.testing.assert_allclose(turn_angles(frames), angle[1], atol=1e-9)


def test_a_transported_frame_does_not_twist() -> None:
    """Along a curve near the viewing axis, neighbouring frames differ by the smallest rotation between tangents."""
    t = np.linspace(0, 4, 200)
    tangents = np.stack([0.1 * np.sin(3 * t), 0.08 * np.cos(2 * t), np.ones(200)], axis=1)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    frames = waypoint_frames(tangents)
    between = np.arccos(np.clip((tangents[1:] * tangents[:-1]).sum(axis=1), -1, 1))
    np.testing.assert_allclose(turn_angles(frames), between, atol=1e-7)


@pytest.mark.parametrize("toward", [1.0, -1.0])
def test_a_rope_that_points_at_the_camera_has_a_frame(toward: float) -> None:
    for count in (1, 2, 7):
        frames = waypoint_frames(np.tile([0.0, 0.0, toward], (count, 1)))
        assert_rotations(frames)
        np.testing.assert_allclose(frames[:, :, 1], np.tile([1.0, 0, 0], (count, 1)), atol=1e-12)


def test_a_tangent_that_turns_round_still_has_a_frame() -> None:
    tangents = np.array([[1.0, 0, 0], [0.1, 0, 0.995], [-0.1, 0, -0.995], [0, 0, -1], [0, 0, 1], [-1, 0, 0]])
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    assert_rotations(waypoint_frames(tangents))


# --- quaternions ---


@settings(max_examples=60, deadline=None)
@given(seeds, st.integers(3, 25), st.floats(0, 1))
def test_quaternions_are_scipys_and_continuous(seed: int, count: int, flatness: float) -> None:
    rng = np.random.default_rng(seed)
    chain = wavy(rng, count) * [flatness, flatness, 1] + rng.normal(0, 1e-3, (count, 3))
    waypoints = make_waypoints(chain, 0.005)
    _, tangents, _ = sample_spline(chain, 0.005)
    expected = Rotation.from_matrix(waypoint_frames(tangents))
    np.testing.assert_allclose(np.linalg.norm(waypoints.quaternions, axis=1), 1, atol=1e-12)
    assert (Rotation.from_quat(waypoints.quaternions) * expected.inv()).magnitude().max() < 1e-7
    assert ((waypoints.quaternions[1:] * waypoints.quaternions[:-1]).sum(axis=1) >= 0).all()


def test_every_branch_of_the_quaternion_is_right() -> None:
    """Half turns about each axis and about diagonals, where the trace is smallest."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        tangent = random_rotation(rng)[:, 0]
        chain = np.array([0, 0, 1.0]) + np.outer([0, 0.1, 0.2], tangent)
        waypoints = make_waypoints(chain, 0.1)
        matrices = Rotation.from_quat(waypoints.quaternions).as_matrix()
        np.testing.assert_allclose(matrices[:, :, 0], np.tile(tangent, (len(matrices), 1)), atol=1e-9)
        np.testing.assert_allclose(matrices, waypoint_frames(np.tile(tangent, (len(matrices), 1))), atol=1e-9)


def test_signs_follow_the_frame_before() -> None:
    previous: Waypoints | None = None
    for angle in np.linspace(0, 4 * np.pi, 200):
        chain = np.outer(np.linspace(-0.2, 0.2, 9), [np.cos(angle), np.sin(angle), 0]) + [0, 0, 1]
        waypoints = make_waypoints(chain, 0.01, previous)
        if previous is not None:
            assert (waypoints.quaternions[0] * previous.quaternions[0]).sum() > 0.99
        previous = waypoints
    assert make_waypoints(chain, 0.01, Waypoints.none()).length == pytest.approx(0.4)


# --- waypoints through given places ---


@pytest.mark.parametrize("name", SHAPES)
def test_waypoints_through_the_samples_of_a_centreline_are_its_own(name: str) -> None:
    made = make_waypoints(at_equal_length(SHAPES[name], 40), 0.006)
    through = waypoints_through(made.positions, made)
    np.testing.assert_array_equal(through.positions, made.positions)
    np.testing.assert_allclose(through.arc_length, chord_knots(made.positions))
    turned = Rotation.from_quat(through.quaternions) * Rotation.from_quat(made.quaternions).inv()
    assert np.degrees(turned.magnitude().max()) < 3


@settings(max_examples=60, deadline=None)
@given(seeds, st.integers(2, 30), st.integers(0, 10))
def test_waypoints_through_places_of_which_some_coincide(seed: int, count: int, repeats: int) -> None:
    rng = np.random.default_rng(seed)
    chain = wavy(rng, count)
    again = np.sort(np.concatenate([np.arange(count), rng.integers(0, count, repeats)]))
    plain, doubled = waypoints_through(chain), waypoints_through(chain[again])
    np.testing.assert_array_equal(doubled.positions, chain[again])
    np.testing.assert_allclose(doubled.arc_length, plain.arc_length[again], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(doubled.quaternions, axis=1), 1)
    along = Rotation.from_quat(doubled.quaternions).as_matrix()[:, :, 0]
    np.testing.assert_allclose(along, chain_tangents(chain)[again], atol=1e-7)


def test_waypoints_that_all_coincide_have_poses_all_the_same() -> None:
    waypoints = waypoints_through(np.ones((4, 3)))
    assert waypoints.length == 0
    np.testing.assert_allclose(np.linalg.norm(waypoints.quaternions, axis=1), 1)


def test_the_quaternions_continue_those_before() -> None:
    chain = wavy(np.random.default_rng(5), 10)
    first = waypoints_through(chain)
    flipped = Waypoints(first.positions, -first.quaternions, first.arc_length)
    np.testing.assert_allclose(waypoints_through(chain, flipped).quaternions, -first.quaternions)
