"""Where the tool goes next: equations 15-22 one by one, and a free tool that follows ropes of all shapes."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ropetrace.centerline import waypoint_frames
from ropetrace.control.frames import STEEP, rotation_vector, waypoint_frame
from ropetrace.control.guidance import MOST_TURN, Gains, Guidance, adaptive_gain, guide, viable
from ropetrace.types import FloatArray
from tracing_rig import distance

GAINS = Gains(14.0, 3.0, 30.0, 1.0, 0.0, 0.01)
VIEW = np.array([0.0, 1.0, 0.0])
PERIOD = 1 / 240


def unit(values: object) -> FloatArray:
    vector = np.asarray(values, float)
    return vector / np.linalg.norm(vector)


def pose(position: object, x: object = (1.0, 0, 0), view: FloatArray = VIEW) -> FloatArray:
    """A tool on a rope that runs along x."""
    result = np.eye(4)
    result[:3, :3] = waypoint_frame(unit(x), view, np.eye(3))
    result[:3, 3] = np.asarray(position, float)
    return result


def line(count: int = 51, length: float = 0.5) -> FloatArray:
    return np.linspace(0, length, count)[:, None] * [1.0, 0, 0]


def at_rest(positions: FloatArray, tool: FloatArray, last: float | None, waypoints: bool = False) -> Guidance:
    still = np.zeros_like(positions)
    return guide(positions, still, still, tool, VIEW, GAINS, last, waypoints=waypoints)


# --- equations 15-17 ---


@pytest.mark.parametrize("from_camera", [False, True])
def test_frames_are_those_of_the_printed_cross_products(from_camera: bool) -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        x, view = unit(rng.normal(size=3)), unit(rng.normal(size=3))
        if np.linalg.norm(np.cross(x, view)) < STEEP:
            continue
        y = unit(np.cross(x, view)) * (-1 if from_camera else 1)
        frame = waypoint_frame(3 * x, view, Rotation.random(random_state=1).as_matrix(), from_camera)
        np.testing.assert_allclose(frame, np.stack([x, y, np.cross(x, y)], axis=1), atol=1e-12)


def test_frames_equal_those_of_the_centreline() -> None:
    tangents = np.array([unit([1.0, math.sin(a), math.cos(a) - 0.5]) for a in np.linspace(0, 2, 30)])
    for tangent, frame in zip(tangents, waypoint_frames(tangents), strict=True):
        np.testing.assert_allclose(waypoint_frame(tangent, np.array([0, 0, 1.0]), np.eye(3)), frame, atol=1e-12)


def test_where_the_rope_points_along_the_view_the_tool_keeps_its_turn() -> None:
    tool = Rotation.from_euler("xyz", [0.3, -0.2, 0.7]).as_matrix()
    np.testing.assert_allclose(waypoint_frame(tool[:, 0], tool[:, 0], tool), tool, atol=1e-12)
    # Turned onto the rope by the smallest rotation.
    x = unit(tool[:, 0] + 0.4 * tool[:, 1] - 0.3 * tool[:, 2])
    axis = unit(np.cross(tool[:, 0], x))
    smallest = Rotation.from_rotvec(axis * math.acos(x @ tool[:, 0])).as_matrix() @ tool
    np.testing.assert_allclose(waypoint_frame(x, -x, tool), smallest, atol=1e-12)


@given(st.integers(0, 2**32 - 1), st.floats(-9, 0))
def test_a_frame_is_a_rotation_however_the_rope_points(seed: int, power: float) -> None:
    rng = np.random.default_rng(seed)
    view, tool = unit(rng.normal(size=3)), Rotation.random(random_state=rng).as_matrix()
    for base in (view, -view, tool[:, 0], -tool[:, 0], tool[:, 1]):
        frame = waypoint_frame(unit(base + 10**power * rng.normal(size=3)), view, tool, bool(rng.integers(2)))
        np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-9)
        assert np.linalg.det(frame) > 0


def test_the_frame_changes_steadily_as_the_rope_comes_out_of_the_view() -> None:
    view = np.array([0, 0, 1.0])
    tool = waypoint_frame(unit([0.5, 0.5, 0.7]), view, np.eye(3))
    angles = np.linspace(0, 0.5, 501)
    frames = [waypoint_frame(np.array([math.sin(a), 0, math.cos(a)]), view, tool) for a in angles]
    turns = [np.linalg.norm(rotation_vector(after, before)) for before, after in pairwise(frames)]
    assert max(turns) < 0.02


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-3, 1.0, 3.0, math.pi - 1e-3, math.pi - 1e-6, math.pi])
def test_rotation_vectors_are_those_of_scipy(angle: float) -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        current, axis = Rotation.random(random_state=rng), unit(rng.normal(size=3))
        target = Rotation.from_rotvec(angle * axis) * current
        found = rotation_vector(target.as_matrix(), current.as_matrix())
        expected = (target * current.inv()).as_rotvec()
        if found @ expected < 0 and angle > 3.14:
            expected = -expected
        np.testing.assert_allclose(found, expected, atol=1e-8)
        turned = Rotation.from_rotvec(found) * current
        assert (turned.inv() * target).magnitude() < 1e-7


# --- equations 18-20 ---


def test_viable_is_equations_18_to_20() -> None:
    tool, x = np.array([0.0, 0, 0]), np.array([1.0, 0, 0])
    positions = np.array([[-0.1, 0, 0], [0, 0.1, 0], [0.005, 0, 0], [0.01, 0, 0], [0.1, 0, 0], [0.1, 0, 0]])
    tangents = np.array([[1, 0, 0], [0, 1, 0], [1, 0, 0], [1, 0, 0], [-0.01, 1, 0], [0.01, 1, 0]])
    assert viable(tool, x, positions, tangents, 0.01).tolist() == [False, True, False, True, False, True]


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_by_waypoints_the_first_viable_one_of_all_is_aimed_at(seed: int) -> None:
    rng = np.random.default_rng(seed)
    positions = np.cumsum(rng.normal(size=(30, 3)) * 0.02 + [0.01, 0, 0], axis=0)
    tool = np.eye(4)
    tool[:3, :3], tool[:3, 3] = Rotation.random(random_state=rng).as_matrix(), positions[rng.integers(30)] + 0.005
    arcs = np.r_[0, np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))]
    before, after = np.maximum(arcs - 0.015, 0), np.minimum(arcs + 0.015, arcs[-1])
    chords = np.stack([np.interp(after, arcs, p) - np.interp(before, arcs, p) for p in positions.T], axis=1)
    tangents = chords / np.linalg.norm(chords, axis=1, keepdims=True)
    allowed = viable(tool[:3, 3], tool[:3, 0], positions, tangents, 0.01)
    found = at_rest(positions, tool, arcs[rng.integers(30)], waypoints=True)
    assert found.viable == allowed.any()
    n = int(allowed.argmax()) if allowed.any() else -1
    offset = positions[n] - tool[:3, 3]
    turn = rotation_vector(waypoint_frame(tangents[n], VIEW, tool[:3, :3]), tool[:3, :3])
    gain = adaptive_gain(float(np.linalg.norm(np.r_[offset, turn])), 14, 3, 30)
    np.testing.assert_allclose(found.twist, gain * np.r_[offset, turn], atol=1e-9)


def test_along_the_rope_the_point_just_delta_p_away_is_aimed_at() -> None:
    for x in np.linspace(0.1, 0.2, 23):
        found = at_rest(line(), pose([x, 0.006, 0]), x - 0.01)
        assert found.viable
        assert found.place == pytest.approx(x)
        gain = adaptive_gain(0.01, 14, 3, 30)
        np.testing.assert_allclose(found.twist, gain * np.array([0.008, -0.006, 0, 0, 0, 0]), atol=1e-6)


def test_a_tool_that_is_further_off_first_comes_to_its_place() -> None:
    found = at_rest(line(), pose([0.203, 0.03, 0]), 0.2)
    np.testing.assert_allclose(unit(found.twist), [0, -1, 0, 0, 0, 0], atol=1e-6)


def test_a_tool_that_points_away_turns_where_it_is() -> None:
    found = at_rest(line(), pose([0.2, 0, 0], [-1, 0.1, 0.2]), 0.2)
    assert not found.viable
    np.testing.assert_allclose(found.twist[:3], 0, atol=1e-9)
    assert found.turn > 2
    assert np.linalg.norm(found.twist[3:]) == pytest.approx(MOST_TURN * adaptive_gain(MOST_TURN, 14, 3, 30))


# --- equations 21 and 22 ---


def test_the_gain_is_equation_22() -> None:
    assert adaptive_gain(0.0, 14, 3, 30) == 14
    assert adaptive_gain(1e9, 14, 3, 30) == 3
    assert adaptive_gain(0.2, 14, 3, 30) == pytest.approx((14 - 3) * math.exp(-30 / (14 - 3) * 0.2) + 3)
    slope = (adaptive_gain(1e-7, 14, 3, 30) - adaptive_gain(0, 14, 3, 30)) / 1e-7
    assert slope == pytest.approx(-30, rel=1e-5)


@pytest.mark.parametrize("distance", [0.0, 0.1, 1e6])
def test_equal_gains_are_a_constant_gain(distance: float) -> None:
    assert adaptive_gain(distance, 5, 5, 30) == 5
    assert adaptive_gain(distance, 5, 5 + 1e-13, 30) == pytest.approx(5)


@pytest.mark.parametrize("waypoints", [False, True])
@pytest.mark.parametrize("beta", [0.0, 0.7, 1.0])
def test_the_ropes_velocity_is_fed_forward(waypoints: bool, beta: float) -> None:
    positions = line()
    velocity = np.stack([np.full(51, 0.3), positions[:, 0] * 2, np.zeros(51)], axis=1)
    acceleration = np.tile([0, 0, 5.0], (51, 1))
    gains, tool = GAINS._replace(feed_forward=beta, lead=0.01), pose([0.205, 0, 0])
    moving = guide(positions, velocity, acceleration, tool, VIEW, gains, 0.2, waypoints=waypoints)
    part = moving.twist - at_rest(positions, tool, 0.2, waypoints).twist
    place = 0.22 if waypoints else 0.205
    np.testing.assert_allclose(part, beta * np.array([0.3, 2 * place, 0.05, 0, 0, 2]), atol=1e-4)
    assert moving.sliding == pytest.approx(0.3)


@pytest.mark.parametrize("view", [VIEW, np.array([0.1, 0, 1.0]), np.array([1, 0.1, -0.5]), np.array([0.2, -1, 0.1])])
def test_the_angular_velocity_is_that_of_the_frame(view: FloatArray) -> None:
    """Against the rotation between the frames a moment before and after, of a rope that bends as it swings."""
    view, arcs = unit(view), np.linspace(0, 0.5, 101)

    def rope(time: float) -> FloatArray:
        swing = 0.3 * np.sin(3 * time) * arcs**2 + 0.1 * np.cos(5 * time) * arcs
        return np.stack([arcs, swing, 0.5 * swing - 0.2 * np.sin(2 * time) * arcs], axis=1)

    def frame(time: float) -> FloatArray:
        positions = rope(time)
        along = np.r_[0, np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))]
        # Velocity is that of a point of the rope, so of a share of the length where the rope stretches.
        middle = 0.6 * along[-1]
        ends = [np.array([np.interp(middle + s, along, p) for p in positions.T]) for s in (-0.015, 0.015)]
        return waypoint_frame(ends[1] - ends[0], view, np.eye(3))

    step = 1e-4
    for time in (0.1, 0.4, 0.9):
        positions = rope(time)
        velocity = (rope(time + step) - rope(time - step)) / (2 * step)
        length = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
        tool = np.eye(4)
        tool[:3, :3] = frame(time)
        tool[:3, 3] = [np.interp(0.6, np.linspace(0, 1, 101), p) for p in positions.T]
        still, moving = (
            guide(positions, beta * velocity, 0 * velocity, tool, view, GAINS, 0.6 * length) for beta in (0, 1)
        )
        expected = rotation_vector(frame(time + step), frame(time - step)) / (2 * step)
        np.testing.assert_allclose((moving.twist - still.twist)[3:], expected, atol=0.01 + 0.02 * abs(expected).max())


# --- the tool's place ---


def test_on_the_way_to_the_first_waypoint_nothing_else_counts() -> None:
    found = at_rest(line(), pose([0.3, 0.01, 0]), None)
    assert found.place == 0
    assert found.remaining == found.distance == pytest.approx(math.hypot(0.3, 0.01))
    np.testing.assert_allclose(unit(found.twist[:3]), unit([-0.3, -0.01, 0]))


def test_the_pace_is_kept_to_the_very_end() -> None:
    for x in (0.45, 0.492, 0.499, 0.5):
        found = at_rest(line(), pose([x, 0, 0]), x)
        assert found.twist[0] == pytest.approx(0.01 * adaptive_gain(0.01, 14, 3, 30), rel=1e-5)
    assert at_rest(line(), pose([0.52, 0, 0]), 0.5).twist[0] < 0


def test_the_place_stays_on_its_strand() -> None:
    back = line()[::-1] + [0, 0.02, 0]
    positions = np.concatenate([line(), back])
    for last, place in ((0.2, 0.25), (0.75, 0.77)):
        found = at_rest(positions, pose([0.25, 0.011, 0]), last)
        assert found.place == pytest.approx(place, abs=1e-9)
        assert found.distance == pytest.approx(min(abs(0.011 - (0 if last < 0.5 else 0.02)), 0.02))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
@pytest.mark.parametrize("waypoints", [False, True])
def test_what_is_not_finite_gives_no_twist(bad: float, waypoints: bool) -> None:
    for which in range(4):
        given = [line(), np.zeros((51, 3)), np.zeros((51, 3)), pose([0.2, 0, 0])]
        given[which] = given[which].copy()
        given[which][slice(None) if which < 3 else slice(3), -1] = bad
        found = guide(given[0], given[1], given[2], given[3], VIEW, GAINS._replace(lead=0.01), 0.2, waypoints=waypoints)
        finite = np.isfinite([*found.twist, found.distance, found.remaining]).all()
        assert not finite or (bad == 1e300 and which in (1, 2))


def test_a_rope_without_length_gives_no_twist() -> None:
    assert np.isnan(at_rest(np.zeros((5, 3)), pose([0.2, 0, 0]), 0.0).twist).any()


def test_coincident_waypoints_do_no_harm() -> None:
    for last in (0.0, 0.1, 0.3):
        doubled = at_rest(np.repeat(line(), 3, axis=0), pose([0.2, 0.003, 0]), last)
        single = at_rest(line(), pose([0.2, 0.003, 0]), last)
        np.testing.assert_allclose(doubled.twist, single.twist, atol=1e-9)


# --- a free tool ---


def arc(radius: float, start: float, end: float) -> FloatArray:
    angles = np.linspace(start, end, max(20, int(abs(end - start) * radius / 0.01)))
    return np.stack([radius * np.sin(angles), radius * (1 - np.cos(angles)), 0 * angles], axis=1)


def hairpin(radius: float) -> FloatArray:
    """Out, half a turn, and back beside itself."""
    leg = line(21, 0.2)
    return np.concatenate([leg, (arc(radius, 0, math.pi) + [0.2, 0, 0])[1:], (leg[::-1] + [0, 2 * radius, 0])[1:]])


def loop(radius: float) -> FloatArray:
    """Once round and across itself, where it lies on top of itself but for 2 mm."""
    leg = line(21, 0.2)
    ring = arc(radius, 0, 2 * math.pi) + [0.2, 0, 0]
    ring[:, 2] = np.linspace(0, 0.002, len(ring))
    return np.concatenate([leg, ring[1:], (leg + [0.2, 0, 0.002])[1:]])


def follow(positions: FloatArray, steps: int = 3000, view: FloatArray = VIEW) -> tuple[list[Guidance], list[float]]:
    """A tool that does what is wanted, from the first waypoint to the last: and its distance from the rope."""
    tool, found, errors = pose(positions[0], positions[1] - positions[0], view), [], []
    still, place = np.zeros_like(positions), 0.0
    for _ in range(steps):
        found.append(guide(positions, still, still, tool, view, GAINS, place))
        twist, place = found[-1].twist, found[-1].place
        tool[:3, 3] += PERIOD * twist[:3]
        tool[:3, :3] = Rotation.from_rotvec(PERIOD * twist[3:]).as_matrix() @ tool[:3, :3]
        errors.append(distance(tool[:3, 3], positions))
        if place >= found[-1].length - 1e-6:
            break
    return found, errors


@pytest.mark.parametrize(
    ("shape", "worst"),
    [
        (line, 0.001),
        (lambda: hairpin(0.05), 0.002),
        (lambda: hairpin(0.02), 0.005),
        (lambda: hairpin(0.012), 0.008),
        (lambda: loop(0.1), 0.001),
        (lambda: loop(0.03), 0.004),
    ],
)
def test_a_free_tool_follows_each_strand_to_the_end(shape: Callable[[], FloatArray], worst: float) -> None:
    view = np.array([0, 0, -1.0])
    found, errors = follow(shape(), view=view)
    places = np.array([step.place for step in found])
    assert places[-1] == pytest.approx(found[-1].length, abs=1e-6)
    assert np.diff(places).max() < 0.003, "it jumps to another strand"
    assert max(errors) < worst


def test_a_rope_that_turns_into_the_view_is_followed_without_a_twitch() -> None:
    positions = np.concatenate([line(21, 0.2), arc(0.1, 0, math.pi)[1:] + [0.2, 0, 0]])
    found, errors = follow(positions, view=np.array([0.0, 1.0, 0.02]) / math.hypot(1, 0.02))
    assert found[-1].place == pytest.approx(found[-1].length, abs=1e-6)
    assert max(errors) < 0.002
    assert max(np.linalg.norm(step.twist[3:]) for step in found) < 5
