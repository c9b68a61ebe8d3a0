"""What a depth image says of places where a rope may be."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ropetrace.sim.camera import Boxes, Capsules, Plane, RayCaster, Scene
from ropetrace.trackers.sight import is_behind, is_clear, looked_through, nearest_hidden, sees_past
from ropetrace.types import CloudFrame, FloatArray, Intrinsics, RgbdFrame

CAMERA = Intrinsics(320, 240, 277.0, 277.0, 159.5, 119.5)
DIAMETER = 0.015
FAR = 0.9
END, BEFORE = np.array([0.0, 0.1, FAR]), np.array([0.0, 0.08, FAR])
"""Of a rope that hangs down from the upper edge of the image to its lower half."""

WALL = (Plane((0.0, 0.0, 1.0), 1.4, (90, 90, 90), 1),)
CLOUD = CloudFrame(0, np.zeros((1, 3)))

quick = settings(max_examples=60, deadline=None)


def curtain(top: float, bottom: float, left: float = -0.5, right: float = 0.5, far: float = 0.6) -> Boxes:
    """A thin box whose front is at this distance, metres; top to bottom is -y to y."""
    middle = ((left + right) / 2, (top + bottom) / 2, far + 0.005)
    return Boxes.one(middle, (right - left, bottom - top, 0.01), (40, 90, 200), 2)


def view(*boxes: Boxes, wall: bool = True, bottom: float = 0.1) -> RgbdFrame:
    """The rope from the upper edge to where it ends, and what is before and behind it."""
    rope = Capsules.along(np.array([[0.0, -0.5, FAR], [0.0, bottom, FAR]]), DIAMETER / 2)
    image = RayCaster(CAMERA).render(Scene(rope, WALL if wall else (), sum(boxes, Boxes.none())))
    return RgbdFrame(0, image.depth, 1.0, CAMERA)


def at_depth(x: float, y: float, far: float, before: float) -> FloatArray:
    """The place at one distance that a place (x, y) at another hides, (1, 3), metres."""
    return np.array([[x * far / before, y * far / before, far]])


# --- clear ends ---


@pytest.mark.parametrize("wall", [True, False])
def test_an_end_before_a_wall_or_before_nothing_is_clear(wall: bool) -> None:
    assert is_clear(view(wall=wall), END, BEFORE, DIAMETER)


@pytest.mark.parametrize("wall", [True, False])
@pytest.mark.parametrize("beyond", [0.0, 0.02, 0.05])
def test_an_end_with_something_nearer_just_beyond_it_is_not_clear(beyond: float, wall: bool) -> None:
    edge = (END[1] + beyond) * 0.6 / FAR
    assert not is_clear(view(curtain(edge, 0.3), wall=wall), END, BEFORE, DIAMETER)


@pytest.mark.parametrize(
    "box",
    [
        curtain(0.25 * 0.6 / FAR, 0.3),  # far beyond it
        curtain(-0.5, 0.5, 0.15, 0.5),  # beside it
        curtain(-0.5, -0.05),  # before it along the rope
        curtain(-0.5, 0.5, far=1.1),  # behind it
    ],
)
def test_what_is_elsewhere_leaves_an_end_clear(box: Boxes) -> None:
    assert is_clear(view(box), END, BEFORE, DIAMETER)


def test_an_end_at_the_edge_of_the_image_is_not_clear() -> None:
    low = 119.5 * FAR / CAMERA.fy
    frame = view(bottom=0.6)
    assert not is_clear(frame, np.array([0.0, low, FAR]), np.array([0.0, low - 0.02, FAR]), DIAMETER)
    short = view(bottom=low - 0.05)
    assert is_clear(short, np.array([0.0, low - 0.05, FAR]), np.array([0.0, low - 0.07, FAR]), DIAMETER)


def test_in_a_cloud_every_end_is_clear() -> None:
    assert is_clear(CLOUD, END, BEFORE, DIAMETER)


# --- places: behind, before, free ---


@quick
@given(st.floats(-0.25, 0.25), st.floats(-0.18, 0.18), st.floats(0.3, 1.3))
def test_a_place_is_behind_before_or_at_what_the_camera_sees(x: float, y: float, far: float) -> None:
    """Where a curtain at 0.6 m covers the left half of a wall at 1.4 m; the rope is out of the way."""
    frame = view(curtain(-0.5, 0.5, -0.5, 0.0), bottom=-0.45)
    place = np.array([[x * far, y * far, far]])
    column = round(CAMERA.fx * x + CAMERA.cx)
    if abs(column - CAMERA.cx) < 2:
        return
    surface = 0.6 if column < CAMERA.cx else 1.4
    assert is_behind(frame, place, DIAMETER)[0] == (surface < far - DIAMETER)
    assert sees_past(frame, place, DIAMETER)[0] == (surface > far + DIAMETER)
    assert looked_through(frame, place, DIAMETER)[0] == (surface >= far + DIAMETER)


def test_before_nothing_a_place_is_looked_through_but_nothing_is_seen_past_it() -> None:
    frame = view(wall=False)
    place = np.array([[0.2, 0.1, FAR]])
    assert looked_through(frame, place, DIAMETER).all()
    assert not sees_past(frame, place, DIAMETER).any()
    assert not is_behind(frame, place, DIAMETER).any()


def test_out_of_the_image_nothing_is_known() -> None:
    place = np.array([[2.0, 0.0, FAR], [0.0, -2.0, FAR]])
    for say in (is_behind, sees_past, looked_through):
        assert not say(view(), place, DIAMETER).any()


def test_without_depth_a_place_is_hidden_only_in_the_shadow_of_something_nearer() -> None:
    frame = view(curtain(-0.5, 0.5, -0.5, 0.0), bottom=-0.45)
    depth = frame.depth.copy()
    depth[:, 160:164] = 0
    depth[:, 260:264] = 0
    shadowed = RgbdFrame(0, depth, 1.0, CAMERA)
    places = np.array([[(column - CAMERA.cx) * FAR / CAMERA.fx, 0.0, FAR] for column in (162, 180, 262)])
    assert looked_through(shadowed, places, DIAMETER).tolist() == [False, True, True]
    _, moved = nearest_hidden(shadowed, places, DIAMETER)
    assert not moved[0]
    assert moved[1]


def test_steps_of_a_millimetre_say_the_same_as_metres() -> None:
    frame = view(curtain(-0.5, 0.5, -0.5, 0.0))
    steps = RgbdFrame(0, np.rint(frame.depth * 1000).astype(np.uint16), 0.001, CAMERA)
    x, y, far = np.meshgrid(np.linspace(-0.3, 0.3, 13), np.linspace(-0.2, 0.2, 9), [0.5, 0.8, FAR, 1.2])
    places = np.stack([x.ravel(), y.ravel(), far.ravel()], axis=1)
    for say in (is_behind, sees_past, looked_through):
        np.testing.assert_array_equal(say(steps, places, DIAMETER), say(frame, places, DIAMETER))
    assert is_clear(steps, END, BEFORE, DIAMETER) == is_clear(frame, END, BEFORE, DIAMETER)


def test_of_a_cloud_nothing_is_known() -> None:
    places = np.random.default_rng(0).normal(0, 0.3, (20, 3)) + [0.0, 0.0, 1.0]
    for say in (is_behind, sees_past, looked_through):
        assert not say(CLOUD, places, DIAMETER).any()
    targets, moved = nearest_hidden(CLOUD, places, DIAMETER)
    np.testing.assert_array_equal(targets, places)
    assert not moved.any()


# --- the nearest hidden place ---


@quick
@given(st.floats(0.01, 0.18), st.floats(-0.2, 0.2))
def test_a_free_place_moves_to_behind_a_curtain_that_is_near(beside: float, y: float) -> None:
    frame = view(curtain(-0.5, 0.5, -0.5, 0.0), bottom=-0.45)
    places = np.array([[beside, y, FAR]])
    targets, moved = nearest_hidden(frame, places, DIAMETER)
    assert moved.all()
    assert is_behind(frame, targets, DIAMETER).all()
    assert targets[0, 2] == FAR
    assert np.linalg.norm(targets - places) == pytest.approx(beside, abs=0.02)


def test_what_is_hidden_already_and_what_is_far_from_all_cover_does_not_move() -> None:
    frame = view(curtain(-0.5, 0.5, -0.5, -0.05), bottom=-0.45)
    behind = at_depth(-0.2, 0.0, FAR, 0.6)
    places = np.concatenate([behind, [[0.2, 0.0, FAR]]])
    targets, moved = nearest_hidden(frame, places, DIAMETER)
    np.testing.assert_array_equal(targets, places)
    assert not moved.any()


def test_the_places_that_are_asked_for_are_left_as_they_are() -> None:
    frame = view(curtain(-0.5, 0.5, -0.5, 0.0))
    places = np.array([[0.05, 0.0, FAR]])
    before = places.copy()
    nearest_hidden(frame, places, DIAMETER)
    np.testing.assert_array_equal(places, before)
