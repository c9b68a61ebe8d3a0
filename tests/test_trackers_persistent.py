"""The rope as a whole: what is hidden, what comes back, several ropes, and honest words about all of it.

The ropes sway before a camera of 320x240; curtains hang in between. What the tracker is told of is the colour and the
diameter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from helpers import RED_TEXT, at_equal_length
from ropetrace.config import OrderingConfig, RopeConfig
from ropetrace.errors import ConfigError, FrameError
from ropetrace.sim.camera import Boxes, Capsules, Plane, RayCaster, Scene
from ropetrace.trackers import PersistentTracker, SlicingTracker, make_tracker
from ropetrace.trackers.clouds import nearest_distances
from ropetrace.types import BadFrame, CloudFrame, Estimate, FloatArray, Frame, Intrinsics, RgbdFrame, Status

CAMERA = Intrinsics(320, 240, 277.0, 277.0, 159.5, 119.5)
CASTER = RayCaster(CAMERA)
DIAMETER = 0.015
LENGTH = 0.5
SURE = 0.3 * DIAMETER
"""No waypoint that is seen is less sure than this, one standard deviation, metres."""

RATE = 30
WALL = (Plane((0.0, 0.0, 1.0), 1.4, (90, 90, 90), 1),)
NOTHING = Boxes.none()
ALL_HIDDEN = (-0.4, 0.4, -0.3, 0.3)
"""Of a curtain before the whole view."""

Curves = FloatArray | Sequence[FloatArray]


def hanging(
    seconds: float, x: float = 0.0, length: float = LENGTH, far: float = 0.9, sway: float = 0.25, bend: float = 0.3
) -> FloatArray:
    """A rope that hangs from (x, -0.27, far) and sways at 0.5 Hz, (401, 3), metres."""
    s = np.linspace(0, 1, 401)
    phase = np.pi * seconds
    turn = sway * np.sin(phase) + bend * s * np.sin(phase - 1.5 * s)
    steps = np.stack([np.sin(turn), np.cos(turn), 0 * turn], axis=1)[:-1] * length / 400
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]) + [x, -0.27, far]


def stick(x: float, top: float, bottom: float, far: float = 0.9) -> FloatArray:
    return np.array([[x, top, far], [x, bottom, far]])


def curtain(left: float, right: float, top: float, bottom: float, far: float = 0.6) -> Boxes:
    """A thin box before the rope; metres in the plane at this distance."""
    middle = ((left + right) / 2, (top + bottom) / 2, far)
    return Boxes.one(middle, (right - left, bottom - top, 0.01), (40, 90, 200), 2)


def view(
    curves: Curves,
    seconds: float,
    boxes: Boxes = NOTHING,
    wall: bool = True,
    pose: FloatArray | None = None,
    colors: Sequence[tuple[int, int, int]] | None = None,
) -> RgbdFrame:
    """Red ropes before a wall."""
    curves = [curves] if isinstance(curves, np.ndarray) else curves
    colors = [(200, 40, 30)] * len(curves) if colors is None else colors
    capsules = Capsules.none()
    for curve, color in zip(curves, colors, strict=True):
        capsules = capsules + Capsules.along(curve, DIAMETER / 2, color)
    image = CASTER.render(Scene(capsules, WALL if wall else (), boxes), pose)
    return RgbdFrame(round(seconds * 1e9), image.depth.copy(), 1.0, CAMERA, image.color.copy())


def as_cloud(frame: RgbdFrame) -> CloudFrame:
    assert frame.color is not None
    rows, columns = np.nonzero(frame.depth > 0)
    z = frame.depth[rows, columns].astype(float)
    points = np.stack([(columns - CAMERA.cx) / CAMERA.fx * z, (rows - CAMERA.cy) / CAMERA.fy * z, z], axis=1)
    return CloudFrame(frame.stamp_ns, points, frame.color[rows, columns])


def tracker(ropes: int | Literal["auto"] = 1, **settings: Any) -> PersistentTracker:
    return PersistentTracker(RopeConfig(DIAMETER, RED_TEXT, "persistent", ropes, **settings))


def assert_sound(estimate: Estimate) -> None:
    """What holds of every estimate, whatever the frame."""
    assert (estimate.status is Status.OK) == (not estimate.reasons)
    waypoints = estimate.waypoints
    if estimate.status is Status.LOST:
        assert len(estimate.nodes) == len(waypoints) == 0
        return
    assert len(estimate.nodes) >= 2
    assert len(waypoints) >= 2
    for array in (estimate.nodes, waypoints.positions, waypoints.quaternions, waypoints.arc_length):
        assert np.isfinite(array).all()
    assert (np.diff(waypoints.arc_length) > 0).all()
    assert estimate.seen is not None
    assert estimate.position_sigma is not None
    assert (estimate.position_sigma > 0).all()


def update_all(rope: PersistentTracker, frame: Frame | BadFrame) -> tuple[Estimate, ...]:
    estimates = rope.update_all(frame)
    for number, estimate in enumerate(estimates):
        assert_sound(estimate)
        assert estimate.stamp_ns == frame.stamp_ns
        assert estimate.rope == number
    return estimates


def update(rope: PersistentTracker, frame: Frame | BadFrame) -> Estimate:
    (estimate,) = update_all(rope, frame)
    return estimate


def off(estimate: Estimate, curve: FloatArray) -> float:
    """The largest distance at equal parts of both lengths from start to end, metres: sees swapped ends."""
    positions = estimate.waypoints.positions
    return float(np.linalg.norm(at_equal_length(positions, 100) - at_equal_length(curve, 100), axis=1).max())


def shares(estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    """Where the waypoints are on the plane of the curtains, 0.6 m away: x and y, metres."""
    x, y, z = estimate.waypoints.positions.T
    return x / z * 0.6, y / z * 0.6


def says(estimate: Estimate, words: str) -> bool:
    return any(words in reason for reason in estimate.reasons)


def run(rope: PersistentTracker, count: int, frame_at: Callable[[int], Frame | BadFrame]) -> list[Estimate]:
    return [update(rope, frame_at(index)) for index in range(count)]


# --- nothing hidden ---


def test_a_rope_that_is_seen_from_end_to_end_is_what_slicing_makes_of_it() -> None:
    """But for the last bits, where slicing looked at the rope from its other end."""
    rope, slicing = tracker(), SlicingTracker(RopeConfig(DIAMETER, RED_TEXT))
    for index in range(20):
        frame = view(hanging(index / RATE), index / RATE)
        whole, sliced = update(rope, frame), slicing.update(frame)
        assert whole.status is Status.OK
        np.testing.assert_allclose(whole.waypoints.positions, sliced.waypoints.positions, atol=1e-12)
        np.testing.assert_allclose(whole.waypoints.quaternions, sliced.waypoints.quaternions, atol=1e-9)
        assert (whole.point_count, whole.point_stride) == (sliced.point_count, sliced.point_stride)


def test_what_is_seen_is_told_as_seen_and_sure() -> None:
    estimate = update(tracker(), view(hanging(0.0), 0.0))
    assert estimate.seen is not None
    assert estimate.seen.all()
    assert estimate.position_sigma is not None
    assert estimate.position_sigma.max() < SURE
    assert off(estimate, hanging(0.0)) < DIAMETER


def test_it_is_made_by_name_and_takes_no_nodes() -> None:
    config = RopeConfig(DIAMETER, method="persistent")
    assert isinstance(make_tracker(config), PersistentTracker)
    with pytest.raises(ConfigError, match="takes no nodes"):
        make_tracker(config, nodes=np.zeros((45, 3)))


def test_a_mask_takes_the_place_of_the_colour() -> None:
    frame = view(hanging(0.0), 0.0)
    assert frame.color is not None
    colorless = RgbdFrame(0, frame.depth, 1.0, CAMERA)
    masked = PersistentTracker(RopeConfig(DIAMETER), (frame.depth > 0) & (frame.depth < 1.2))
    assert off(update(masked, colorless), hanging(0.0)) < DIAMETER
    with pytest.raises(FrameError):
        tracker().update(colorless)


@pytest.mark.parametrize("first", [(0.0, -1.0, 1.0), (0.0, 1.0, 1.0)])
def test_the_start_is_the_end_that_the_settings_name(first: tuple[float, float, float]) -> None:
    named = tracker(ordering=OrderingConfig(first="point", first_point=first))
    for index in range(4):
        positions = update(named, view(hanging(index / RATE), index / RATE)).waypoints.positions
        assert np.sign(positions[0, 1] - positions[-1, 1]) == first[1]


# --- a part is hidden ---

HIDDEN = {
    "end": (-0.4, 0.4, 0.05, 0.4),
    "start": (-0.4, 0.4, -0.4, -0.08),
    "middle": (-0.4, 0.4, -0.08, 0.0),
}


@pytest.mark.parametrize("wall", [True, False], ids=["wall", "nothing behind"])
@pytest.mark.parametrize("part", HIDDEN)
def test_what_is_hidden_is_kept_told_and_not_called_seen(part: str, wall: bool) -> None:
    """For a second, while the rope sways on."""
    left, right, top, bottom = HIDDEN[part]
    boxes = curtain(left, right, top, bottom)
    rope = tracker()

    def frame_at(index: int) -> RgbdFrame:
        return view(hanging(index / RATE), index / RATE, NOTHING if index < 6 else boxes, wall)

    for index, estimate in enumerate(run(rope, 36, frame_at)):
        assert off(estimate, hanging(index / RATE)) < 0.02
        assert estimate.waypoints.length == pytest.approx(LENGTH, rel=0.03)
        if index < 6:
            continue
        assert estimate.status is Status.DEGRADED
        assert says(estimate, "of the rope is hidden")
        assert estimate.seen is not None
        assert estimate.position_sigma is not None
        _, y = shares(estimate)
        assert not estimate.seen[(y > top + 0.01) & (y < bottom - 0.01)].any()
        assert estimate.seen[(y < top - 0.03) | (y > bottom + 0.03)].all()
        assert estimate.position_sigma[estimate.seen].max() < SURE


def test_sigma_grows_while_a_part_is_hidden_and_shrinks_when_it_is_seen_again() -> None:
    boxes = curtain(*HIDDEN["end"])
    rope = tracker()
    last = []
    for index in range(14):
        estimate = update(rope, view(hanging(0.0), index / RATE, boxes if 2 <= index < 12 else NOTHING))
        assert estimate.position_sigma is not None
        last.append(estimate.position_sigma[-1])
    assert (np.diff(last[1:12]) > 0).all()
    assert last[0] == last[1] == last[12] == last[13] < SURE


def test_a_hidden_part_makes_way_for_what_is_seen_behind_it() -> None:
    """The cover moves aside and shows the wall where the rope's end was expected: it is behind what is left of it."""
    rope = tracker()
    for index in range(30):
        curve = hanging(0.0, bend=0.0)[: 401 if index < 15 else 240]
        boxes = curtain(-0.2 if index < 15 else 0.02, 0.3, 0.02, 0.3)
        estimate = update(rope, view(curve, index / RATE, NOTHING if index < 3 else boxes))
        x, y = shares(estimate)
        if index == 14:
            assert abs(x[-1]) < 0.005
    assert (x[y > 0.12] > 0.015).all()
    assert estimate.waypoints.length == pytest.approx(LENGTH, rel=0.03)
    assert says(estimate, "where the rope is expected there is nothing")


def test_a_rope_that_is_hidden_while_it_moves_is_expected_to_move_on() -> None:
    """At 0.6 m/s, 2 cm a frame."""
    rope = tracker()
    for index in range(9):
        curve = hanging(0.0, x=-0.08 + 0.02 * index)
        estimate = update(rope, view(curve, index / RATE, NOTHING if index < 8 else curtain(*ALL_HIDDEN)))
    assert estimate.seen is not None
    assert not estimate.seen.any()
    assert off(estimate, curve) < 0.01


# --- all of it is hidden, and comes back ---


@pytest.mark.parametrize("way", ["across", "down", "up"])
def test_a_curtain_that_passes_swaps_no_ends_and_keeps_the_length(way: str) -> None:
    """It hides all of the rope for a while."""
    rope = tracker()
    statuses = []
    for index in range(90):
        at = -0.5 + index / 90
        box = {
            "across": (at - 0.12, at + 0.12, -0.3, 0.3),
            "down": (-0.4, 0.4, at - 0.2, at + 0.2),
            "up": (-0.4, 0.4, -at - 0.2, -at + 0.2),
        }[way]
        curve = hanging(index / RATE, sway=0.1)
        estimate = update(rope, view(curve, index / RATE, curtain(*box)))
        statuses.append(estimate.status)
        if estimate.status is not Status.LOST:
            assert estimate.waypoints.positions[0, 1] < estimate.waypoints.positions[-1, 1]
            assert estimate.waypoints.length == pytest.approx(LENGTH, rel=0.03)
    assert Status.DEGRADED in statuses
    assert estimate.status is Status.OK
    assert off(estimate, curve) < DIAMETER


def test_a_rope_that_was_out_of_sight_for_two_seconds_is_back_in_half_a_second_with_the_same_start() -> None:
    """Meanwhile its lower end has become the upper one."""

    def leaning(slope: float) -> FloatArray:
        return np.array([[-0.2, -slope, 0.9], [0.2, slope, 0.9]])

    rope = tracker()
    for index in range(90):
        curve = leaning(0.03) if index < 30 else leaning(-0.03)
        hidden = 10 <= index < 70
        estimate = update(rope, view(curve, index / RATE, curtain(*ALL_HIDDEN) if hidden else NOTHING))
        if hidden:
            assert estimate.status is not Status.OK
            assert estimate.seen is None or not estimate.seen.any()
        elif index < 10 or index >= 85:
            assert estimate.status is Status.OK
            assert off(estimate, curve) < DIAMETER
    assert estimate.waypoints.positions[0, 0] < 0


def test_what_is_hidden_for_long_is_lost() -> None:
    rope = tracker()
    run(rope, 3, lambda index: view(hanging(0.0), index / RATE))
    statuses = [update(rope, view(hanging(0.0), 0.1 * index, curtain(*ALL_HIDDEN))).status for index in range(1, 30)]
    assert statuses[0] is Status.DEGRADED
    assert statuses[-1] is Status.LOST
    assert sorted(statuses, key=lambda status: status is Status.LOST) == statuses


def test_a_rope_that_is_gone_without_anything_before_it_is_lost_at_once() -> None:
    rope = tracker()
    run(rope, 3, lambda index: view(hanging(0.0), index / RATE))
    assert update(rope, view([], 0.1)).status is Status.LOST


def test_twenty_dropped_frames_do_no_harm() -> None:
    rope = tracker()
    for index in [*range(10), *range(30, 40)]:
        estimate = update(rope, view(hanging(index / RATE), index / RATE))
        assert estimate.status is Status.OK
        assert off(estimate, hanging(index / RATE)) < DIAMETER


@pytest.mark.parametrize("part", [None, "end", "middle"])
def test_a_camera_that_is_bumped_by_five_centimetres_goes_on(part: str | None) -> None:
    bumped = np.eye(4)
    bumped[0, 3] = 0.05
    rope = tracker()
    for index in range(25):
        boxes = NOTHING if part is None or index < 5 else curtain(*HIDDEN[part])
        curve = hanging(index / RATE, sway=0.1)
        estimate = update(rope, view(curve, index / RATE, boxes, pose=bumped if index >= 10 else None))
        assert estimate.waypoints.length == pytest.approx(LENGTH, rel=0.03)
        if index >= 16:
            assert off(estimate, curve - bumped[:3, 3]) < 0.03
    assert (estimate.status is Status.OK) == (part is None)


# --- what a rope is: its length and its ends ---


@pytest.mark.parametrize("end", ["start", "end"])
def test_an_end_that_is_hidden_from_the_first_frame_is_told_and_the_rope_grows_as_it_appears(end: str) -> None:
    rope = tracker()
    lengths, frames_told = [], 0
    for index in range(40):
        edge = 0.05 + 0.01 * max(index - 5, 0) if end == "end" else -0.05 - 0.01 * max(index - 5, 0)
        boxes = curtain(-0.4, 0.4, edge, 0.5) if end == "end" else curtain(-0.4, 0.4, -0.5, edge)
        curve = hanging(index / RATE, sway=0.1)
        estimate = update(rope, view(curve, index / RATE, boxes))
        lengths.append(estimate.waypoints.length)
        told = says(estimate, "an end has not been seen yet")
        frames_told += told
        if not told:
            assert off(estimate, curve) < DIAMETER
    assert frames_told >= 10
    assert lengths[0] < 0.8 * LENGTH
    assert np.diff(lengths).min() > -DIAMETER
    assert estimate.status is Status.OK
    assert lengths[-1] == pytest.approx(LENGTH, rel=0.03)


@pytest.mark.parametrize("end", ["start", "end"])
def test_a_rope_that_really_got_shorter_is_taken_over_after_a_while(end: str) -> None:
    rope = tracker()
    for index in range(40):
        whole = hanging(index / RATE)
        curve = whole if index < 5 else whole[:-80] if end == "end" else whole[80:]
        estimate = update(rope, view(curve, index / RATE))
        if 5 <= index < 10:
            assert estimate.status is Status.DEGRADED
            assert estimate.waypoints.length == pytest.approx(LENGTH, rel=0.03)
    assert estimate.status is Status.OK
    assert off(estimate, curve) < DIAMETER


def fading(seconds: float, lit: bool) -> RgbdFrame:
    """A rope whose lower third may lie in another light, and is then of another colour."""
    curve = hanging(seconds)
    return view([curve[:271], curve[270:]], seconds, colors=[(200, 40, 30), (200, 40, 30) if lit else (60, 60, 60)])


def test_a_part_that_loses_its_colour_for_a_moment_is_told() -> None:
    estimates = run(tracker(), 12, lambda index: fading(index / RATE, lit=not 5 <= index < 10))
    assert [estimate.status is Status.OK for estimate in estimates] == [not 5 <= index < 10 for index in range(12)]
    for estimate in estimates:
        assert estimate.waypoints.length == pytest.approx(LENGTH, rel=0.03)


def test_a_part_that_is_there_but_lost_its_colour_is_not_taken_for_cut_off() -> None:
    estimates = run(tracker(), 30, lambda index: fading(index / RATE, lit=index < 5))
    assert estimates[-1].status is not Status.OK


def test_an_end_behind_something_that_is_hardly_nearer_is_not_taken_for_cut_off() -> None:
    """Its front is 2 cm before the axis."""
    boxes = curtain(-0.4, 0.4, 0.08, 0.4, far=0.885)
    estimates = run(tracker(), 40, lambda index: view(hanging(0.0), index / RATE, NOTHING if index < 5 else boxes))
    assert estimates[-1].status is not Status.OK


def test_one_frame_of_another_length_is_no_other_rope_however_slow_the_camera() -> None:
    estimates = run(tracker(), 8, lambda index: fading(index / 2, lit=index != 5))
    assert estimates[5].status is Status.DEGRADED


def test_flickering_behind_a_curtain_does_not_cut_a_rope() -> None:
    boxes = curtain(*HIDDEN["end"])
    rope = tracker()
    for index in range(90):
        flickers = index > 5 and index % 4 == 0
        curve = hanging(0.0)[:271] if flickers else hanging(0.0)
        estimate = update(rope, view(curve, index / RATE, NOTHING if flickers or index < 5 else boxes))
        assert estimate.status is not Status.OK or index < 5


# --- crossings, and what else has the rope's colour ---


def looping(turns: float) -> FloatArray:
    """A rope of 0.76 m whose middle turns by so many turns, and which crosses itself if that is one, (2001, 3)."""
    arc, leg = 0.44, 0.16
    heading = np.concatenate([np.zeros(500), np.linspace(0, 2 * np.pi * turns, 1000), np.full(500, 2 * np.pi * turns)])
    steps = np.concatenate([np.full(500, leg / 500), np.full(1000, arc / 1000), np.full(500, leg / 500)])
    away = np.full(2000, 0.06 / 2000)
    curve = np.cumsum(np.stack([np.cos(heading) * steps, np.sin(heading) * steps, away], axis=1), axis=0)
    return np.asarray(curve - curve.mean(axis=0) + [0.0, 0.0, 0.95])


@pytest.mark.parametrize("way", ["opens", "closes"])
def test_a_crossing_that_opens_or_closes_keeps_the_order(way: str) -> None:
    rope = tracker(ordering=OrderingConfig(first="point", first_point=(-1.0, 0.0, 1.0)))
    for index in range(40):
        part = min(max(index - 5, 0) / 25, 1)
        curve = looping(1 - 0.6 * part if way == "opens" else 0.4 + 0.6 * part)
        estimate = update(rope, view(curve, index / RATE))
        if index == 0:
            curve_runs = np.linalg.norm(estimate.waypoints.positions[0] - curve[0]) < 0.05
            assert (estimate.status is Status.OK) == (way == "closes")
        assert off(estimate, curve if curve_runs else curve[::-1]) < 1.5 * DIAMETER
        assert estimate.waypoints.length == pytest.approx(0.76, rel=0.04)
    assert (estimate.status is Status.OK) == (way == "opens")


@pytest.mark.parametrize(
    "degrees",
    [0, 15, 30, 45, 60, 75],
)
def test_while_a_crossing_of_which_the_order_was_a_guess_opens_ok_means_right(degrees: float) -> None:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    rope = tracker()
    for index in range(35):
        curve = (looping(1 - 0.6 * min(max(index - 5, 0) / 25, 1)) - [0, 0, 0.95]) * 0.8 @ turn + [0, 0, 0.9]
        estimate = update(rope, view(curve, index / RATE))
        if estimate.status is Status.OK:
            assert min(off(estimate, curve), off(estimate, curve[::-1])) < 0.025
    assert estimate.status is Status.OK


def test_something_else_of_that_colour_is_told_and_left_out() -> None:
    rope = tracker()
    for index in range(15):
        curve = hanging(index / RATE)
        there = [stick(0.2, -0.1, 0.1)] if 4 <= index < 12 else []
        estimate = update(rope, view([curve, *there], index / RATE))
        assert (estimate.status is Status.OK) == (not there)
        assert says(estimate, "something else of that colour is left out") == bool(there)
        assert off(estimate, curve) < DIAMETER


def test_something_else_of_that_colour_in_the_first_frame_is_told_and_left_out() -> None:
    frame = view([hanging(0.0), stick(0.2, -0.1, 0.1)], 0.0)
    estimate = update(tracker(), frame)
    assert estimate.status is Status.DEGRADED
    assert says(estimate, "something else of that colour")
    assert off(estimate, hanging(0.0)) < DIAMETER


@pytest.mark.parametrize("far", [0.75, 1.05], ids=["before", "behind"])
def test_another_rope_that_passes_before_or_behind_does_not_lead_the_rope_away(far: float) -> None:
    rope = tracker()
    for index in range(60):
        curve = hanging(index / RATE, sway=0.1)
        other = hanging(0.3, x=0.25 - 0.5 * index / 60, length=0.4, far=far, sway=0.05)
        estimate = update(rope, view([curve, other] if index > 2 else curve, index / RATE))
        assert off(estimate, curve) < 0.02


def test_a_hidden_rope_does_not_leap_to_something_else_of_its_colour() -> None:
    """Which stands 60 cm away, half behind a box."""
    rope = tracker()
    boxes = curtain(-0.33, -0.05, -0.3, 0.3) + curtain(0.15, 0.35, 0.05, 0.2)
    for index in range(15):
        curve = hanging(index / RATE, x=-0.25, sway=0.05)
        other = [stick(0.35, -0.1, 0.15)] if index >= 10 else []
        estimate = update(rope, view([curve, *other], index / RATE, boxes if index >= 5 else NOTHING))
        assert estimate.status is Status.LOST or off(estimate, curve) < 0.1


# --- several ropes ---


def test_two_ropes_that_cross_in_the_view_keep_their_identities() -> None:
    rope = tracker(2)
    numbered: list[int] = []
    for index in range(66):
        part = min(index / 60, 1)
        curves = (
            hanging(index / RATE, x=-0.12 + 0.24 * part, length=0.45, far=0.85, sway=0.1),
            hanging(index / RATE + 0.5, x=0.0, length=0.45, far=0.97, sway=0.1),
        )
        estimates = update_all(rope, view(curves, index / RATE))
        numbered = numbered or [int(np.argmin([off(estimate, curve) for curve in curves])) for estimate in estimates]
        for estimate, number in zip(estimates, numbered, strict=True):
            assert off(estimate, curves[number]) < 0.02
    assert sorted(numbered) == [0, 1]
    assert [estimate.status for estimate in estimates] == [Status.OK] * 2


def test_two_ropes_that_were_hidden_come_back_as_they_were() -> None:
    rope = tracker(2)
    starts = []
    for index in range(40):
        curves = [hanging(index / RATE, x=x, length=0.4, sway=0.1) for x in (-0.12, 0.12)]
        hidden = 5 <= index < 26
        estimates = update_all(rope, view(curves, index / RATE, curtain(*ALL_HIDDEN) if hidden else NOTHING))
        if not hidden:
            starts.append([bool(estimate.waypoints.positions[0, 0] < 0) for estimate in estimates])
    assert all(start == starts[0] for start in starts)
    assert sorted(starts[0]) == [False, True]


def test_all_ropes_that_are_seen_are_found() -> None:
    rope = tracker("auto")
    numbered: list[int] = []
    for index in range(10):
        curves = [hanging(index / RATE, x=x, length=0.4, sway=0.1) for x in (-0.2, 0.08, 0.2)]
        estimates = update_all(rope, view(curves, index / RATE))
        assert [estimate.status for estimate in estimates] == [Status.OK] * 3
        numbered = numbered or [int(np.argmin([off(estimate, curve) for curve in curves])) for estimate in estimates]
        for estimate, number in zip(estimates, numbered, strict=True):
            assert off(estimate, curves[number]) < DIAMETER
    assert sorted(numbered) == [0, 1, 2]


def test_a_short_piece_is_no_rope_and_is_told() -> None:
    rope = tracker("auto")
    for index in range(15):
        curves = [hanging(index / RATE, x=x, length=0.4, sway=0.1) for x in (-0.2, 0.2)]
        estimates = update_all(rope, view([*curves, stick(0.08, 0.0, 0.08)], index / RATE))
        assert len(estimates) == 2
        for estimate in estimates:
            assert says(estimate, "something else of that colour")
            assert min(off(estimate, curve) for curve in curves) < DIAMETER


def test_a_rope_in_the_middle_of_others_is_as_right_as_they_are() -> None:
    rope = tracker("auto")
    for index in range(8):
        curves = [hanging(index / RATE, x=x, length=0.4, sway=0.1) for x in (-0.2, 0.0, 0.2)]
        for estimate in update_all(rope, view(curves, index / RATE)):
            assert estimate.status is Status.OK
            assert min(off(estimate, curve) for curve in curves) < DIAMETER


def test_ropes_that_come_side_by_side_keep_their_lengths_or_are_not_ok() -> None:
    """Until their axes are 3 cm apart: two diameters."""
    rope = tracker(2)
    for index in range(40):
        apart = max(0.2 * (1 - index / 30), 0.03)
        curves = [hanging(index / RATE, x=x, length=0.4, sway=0.1) for x in (-apart / 2, apart / 2)]
        for estimate in update_all(rope, view(curves, index / RATE)):
            assert estimate.status is not Status.OK or estimate.waypoints.length == pytest.approx(0.4, rel=0.1)


def test_ropes_that_hang_side_by_side_in_the_first_frame_are_not_one_that_is_ok() -> None:
    """Their axes are 3 cm apart."""
    rope = tracker(2)
    for index in range(5):
        curves = [hanging(index / RATE, x=x, length=0.4, sway=0.1) for x in (-0.015, 0.015)]
        for estimate in update_all(rope, view(curves, index / RATE)):
            assert estimate.status is not Status.OK or estimate.waypoints.length == pytest.approx(0.4, rel=0.1)


@pytest.mark.parametrize("ropes", [2, "auto"])
def test_a_rope_that_appears_later_is_taken_up(ropes: int | Literal["auto"]) -> None:
    rope = tracker(ropes)
    for index in range(20):
        curves = [hanging(index / RATE, x=x, length=0.4, sway=0.1) for x in (-0.12, 0.12)[: 1 if index < 5 else 2]]
        estimates = update_all(rope, view(curves, index / RATE))
        assert off(estimates[0], curves[0]) < DIAMETER
    assert len(estimates) == 2
    assert off(estimates[1], curves[1]) < DIAMETER
    assert [estimate.status for estimate in estimates] == [Status.OK] * 2


def test_ropes_are_not_taken_up_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ropetrace.trackers.persistent.MOST_ROPES", 2)
    late, crowded = tracker("auto"), tracker("auto")
    for index in range(20):
        curves = [hanging(index / RATE, x=x, length=0.4) for x in (-0.2, 0.0, 0.2)]
        estimates = update_all(late, view(curves[: 2 if index < 5 else 3], index / RATE))
        assert len(update_all(crowded, view(curves, index / RATE))) == 2
        if index < 5:
            assert [estimate.status for estimate in estimates] == [Status.OK] * 2
    assert len(estimates) == 2
    assert all(says(estimate, "2 ropes are followed already: no more") for estimate in estimates)


def test_that_fewer_ropes_are_seen_than_wanted_is_told() -> None:
    curves = [hanging(0.0, x=x, length=0.4) for x in (-0.12, 0.12)]
    rope = tracker(3)
    for index in range(2):
        estimates = update_all(rope, view(curves, index / RATE))
        assert [estimate.status for estimate in estimates] == [Status.OK, Status.OK, Status.LOST]
        assert estimates[2].reasons == ("only 2 of 3 ropes have been seen",)
    assert [estimate.status for estimate in update_all(rope, BadFrame(10**8, "torn"))] == [Status.LOST] * 3


def test_update_tells_of_the_first_rope() -> None:
    curves = [hanging(0.0, x=x, length=0.4) for x in (-0.12, 0.12)]
    one, all_of_them = tracker(2), tracker(2)
    frame = view(curves, 0.0)
    np.testing.assert_array_equal(one.update(frame).nodes, all_of_them.update_all(frame)[0].nodes)


# --- whatever the frames ---

_GRAY: NDArray[np.uint8] = np.full((240, 320, 3), 90, np.uint8)
_RED: NDArray[np.uint8] = np.array([[200, 40, 30]], np.uint8)
BLIND: dict[str, Callable[[int], Frame | BadFrame]] = {
    "bad": lambda stamp: BadFrame(stamp, "torn"),
    "no depth": lambda stamp: RgbdFrame(stamp, np.zeros((240, 320), np.float32), 1.0, CAMERA, _GRAY),
    "NaN depth": lambda stamp: RgbdFrame(stamp, np.full((240, 320), np.nan, np.float32), 1.0, CAMERA, _GRAY),
    "other colour": lambda stamp: RgbdFrame(stamp, np.full((240, 320), 1.0, np.float32), 1.0, CAMERA, _GRAY),
    "no points": lambda stamp: CloudFrame(stamp, np.empty((0, 3)), np.empty((0, 3), np.uint8)),
    "NaN points": lambda stamp: CloudFrame(stamp, np.full((50, 3), np.nan), np.tile(_RED, (50, 1))),
    "one point": lambda stamp: CloudFrame(stamp, np.ones((1, 3)), np.tile(_RED, (1, 1))),
}


@pytest.mark.parametrize("kind", BLIND)
def test_a_frame_that_shows_nothing_is_lost_with_a_reason_and_forgets_nothing(kind: str) -> None:
    rope = tracker()
    assert update(rope, BLIND[kind](0)).status is Status.LOST
    assert off(update(rope, view(hanging(0.0), 1 / RATE)), hanging(0.0)) < DIAMETER
    estimate = update(rope, BLIND[kind](2 * 10**9 // RATE))
    assert estimate.status is Status.LOST
    assert estimate.reasons[0]
    assert len(rope.cloud().points) == (1 if kind == "one point" else 0)
    again = update(rope, view(hanging(0.0), 3 / RATE))
    assert again.status is Status.OK
    assert off(again, hanging(0.0)) < DIAMETER


def test_stamps_that_repeat_run_back_or_leap_are_told_and_do_no_harm() -> None:
    rope = tracker()
    boxes = curtain(*HIDDEN["end"])
    update(rope, view(hanging(0.0), 1.0))
    for seconds, words in ((1.0, "repeats"), (0.9, "runs back"), (1000.0, "leaps"), (0.0, "runs back"), (0.03, "")):
        for stamp, box, reason in ((seconds, NOTHING, words), (seconds + 0.01, boxes, "is hidden")):
            estimate = update(rope, view(hanging(0.0), stamp, box))
            assert says(estimate, reason) or not reason
            assert (estimate.status is Status.OK) == (not reason)
            assert off(estimate, hanging(0.0)) < 0.02


def test_clouds_are_followed_like_images_where_nothing_at_the_ends_is_hidden() -> None:
    rope = tracker()
    boxes = curtain(*HIDDEN["middle"])
    for index in range(20):
        curve = hanging(index / RATE)
        estimate = update(rope, as_cloud(view(curve, index / RATE, boxes if 5 <= index < 15 else NOTHING)))
        assert (estimate.status is Status.OK) == (not 5 <= index < 15)
        assert off(estimate, curve) < DIAMETER


def a_film() -> Iterable[Frame]:
    for index in range(12):
        boxes = curtain(*HIDDEN["end"]) if 3 <= index < 9 else NOTHING
        yield view([hanging(index / RATE), stick(0.2, -0.1, 0.1)], index / RATE, boxes)


def bytes_of(estimates: Iterable[Estimate]) -> list[tuple[Any, ...]]:
    return [
        (
            estimate.status,
            estimate.reasons,
            estimate.nodes.tobytes(),
            estimate.waypoints.positions.tobytes(),
            estimate.waypoints.quaternions.tobytes(),
            None if estimate.seen is None else estimate.seen.tobytes(),
            None if estimate.position_sigma is None else estimate.position_sigma.tobytes(),
        )
        for estimate in estimates
    ]


def test_the_same_frames_give_the_same_bytes_also_after_a_reset() -> None:
    first = tracker()
    once = bytes_of([update(first, frame) for frame in a_film()])
    second = tracker()
    assert bytes_of([update(second, frame) for frame in a_film()]) == once
    first.reset()
    assert bytes_of([update(first, frame) for frame in a_film()]) == once


def test_after_a_reset_the_start_is_chosen_anew() -> None:
    rope = tracker()
    down = stick(0.0, -0.2, 0.2)
    first = update(rope, view(down, 0.0)).waypoints.positions
    assert first[0, 1] < first[-1, 1]
    for index, degrees in enumerate(range(0, 181, 10)):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        turned = (down - [0, 0, 0.9]) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [0, 0, 0.9]
        estimate = update(rope, view(turned, (index + 1) / RATE))
        assert off(estimate, turned) < DIAMETER
    rope.reset()
    anew = update(rope, view(turned, 2.0)).waypoints.positions
    assert anew[0, 1] < anew[-1, 1]


def test_estimates_are_not_changed_by_later_frames() -> None:
    rope = tracker()
    kept: list[Estimate] = []
    told: list[tuple[Any, ...]] = []
    for frame in a_film():
        kept.append(update(rope, frame))
        told += bytes_of(kept[-1:])
    assert bytes_of(kept) == told


def test_the_cloud_has_all_points_and_the_nodes_they_are_near() -> None:
    rope = tracker()
    update(rope, view(hanging(0.0), 0.0))
    estimate = update(rope, view([hanging(0.0), stick(0.2, -0.1, 0.1)], 1 / RATE))
    cloud = rope.cloud()
    assert len(cloud.points) == estimate.point_count
    assert cloud.node.max() < len(estimate.nodes)
    of_rope = cloud.node >= 0
    np.testing.assert_array_equal(of_rope, cloud.points[:, 0] < 0.15)
    assert np.linalg.norm(cloud.points - estimate.nodes[cloud.node], axis=1)[of_rope].max() < 2 * DIAMETER
    assert nearest_distances(cloud.points[of_rope], estimate.nodes) == pytest.approx(
        np.linalg.norm(cloud.points - estimate.nodes[cloud.node], axis=1)[of_rope]
    )
    cloud.points[:] = 0.0
    assert rope.cloud().points.any()


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 2, "auto"]))
def test_whatever_comes_estimates_are_sound(seed: int, ropes: int | Literal["auto"]) -> None:
    """Ropes that come and go, curtains anywhere, holes in the depth, blind frames, clouds, stamps that leap."""
    rng = np.random.default_rng(seed)
    rope = tracker(ropes)
    seconds = 0.0
    for _ in range(8):
        seconds += rng.choice([1 / RATE, 1 / RATE, 0.0, -0.1, 0.7, 70.0])
        curves = [
            hanging(seconds % 10, x=x + rng.normal(0, 0.01), length=rng.uniform(0.1, 0.5), far=far)[
                :: rng.choice([-1, 1])
            ]
            for x, far in ((-0.1, 0.9), (0.0, 0.8), (0.15, 1.0))[: rng.integers(4)]
        ]
        left, top = rng.uniform(-0.4, 0.2, 2)
        boxes = curtain(left, left + rng.uniform(0.02, 0.4), top, top + rng.uniform(0.02, 0.4), rng.uniform(0.3, 1.2))
        frame = view(curves, seconds, boxes, wall=bool(rng.integers(2)))
        holes = (frame.depth * 1000 * (rng.random(frame.depth.shape) < rng.uniform(0.3, 1))).astype(np.uint16)
        blind = BLIND[str(rng.choice(list(BLIND)))](frame.stamp_ns)
        holed = RgbdFrame(frame.stamp_ns, holes, 0.001, CAMERA, frame.color)
        events: list[Frame | BadFrame] = [frame, frame, holed, as_cloud(frame), blind]
        update_all(rope, events[rng.integers(len(events))])
        assert len(rope.cloud().node) == len(rope.cloud().points)
