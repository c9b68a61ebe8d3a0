"""The whole tracker: shapes, accuracy, honest statuses, and whatever a camera may throw at it."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from helpers import (
    DATA,
    LARGE,
    RED_TEXT,
    SHAPES,
    SMALL,
    needs_data,
    random_rotation,
    rope_cloud,
    seen,
    straight,
    worst_at_equal_length,
)
from ropetrace.config import CenterlineConfig, OrderingConfig, RopeConfig, SegmentationConfig, SlicingConfig
from ropetrace.errors import ConfigError, FrameError
from ropetrace.evaluation.metrics import coverage, distances_to_curve, symmetric_mean
from ropetrace.sim.camera import Capsules, Plane
from ropetrace.trackers import METHODS, PersistentTracker, SlicingTracker, make_tracker
from ropetrace.types import BadFrame, CloudFrame, Estimate, FloatArray, Intrinsics, RgbdFrame, Status

ROPE = RopeConfig(diameter=0.012)
RED_ROPE = RopeConfig(diameter=0.012, color=RED_TEXT)
HANGING = SHAPES["hanging"]


def assert_sound(estimate: Estimate) -> None:
    """What holds of every estimate, whatever the frame."""
    if estimate.status is Status.LOST:
        assert len(estimate.nodes) == len(estimate.waypoints) == 0
        assert estimate.reasons
        return
    assert (estimate.status is Status.OK) == (not estimate.reasons)
    assert len(estimate.nodes) >= 2
    waypoints = estimate.waypoints
    assert len(waypoints) >= 2
    for array in (estimate.nodes, waypoints.positions, waypoints.quaternions, waypoints.arc_length):
        assert np.isfinite(array).all()
    np.testing.assert_allclose(np.linalg.norm(waypoints.quaternions, axis=1), 1, atol=1e-9)
    assert (np.diff(waypoints.arc_length) > 0).all()


def update(tracker: SlicingTracker, frame: RgbdFrame | CloudFrame) -> Estimate:
    estimate = tracker.update(frame)
    assert_sound(estimate)
    assert estimate.stamp_ns == frame.stamp_ns
    cloud = tracker.cloud()
    assert len(cloud.points) == -(-estimate.point_count // estimate.point_stride)
    assert cloud.node.max(initial=-1) == len(estimate.nodes) - 1
    return estimate


def lost(frame: RgbdFrame | CloudFrame, config: RopeConfig = ROPE) -> str:
    estimate = update(SlicingTracker(config), frame)
    assert estimate.status is Status.LOST
    return estimate.reasons[0]


def cloud_frame(points: FloatArray, stamp_ns: int = 0) -> CloudFrame:
    return CloudFrame(stamp_ns, np.ascontiguousarray(points))


# --- shapes, end to end ---

CROSSING = ("crossing loop",)


@pytest.mark.parametrize("name", [name for name in SHAPES if name != "helix"])
def test_every_shape_is_tracked_from_end_to_end(name: str) -> None:
    estimate = update(SlicingTracker(RED_ROPE), seen(SHAPES[name], camera=LARGE))
    if name in CROSSING:
        assert any("strands overlap" in reason for reason in estimate.reasons)
    else:
        assert estimate.status is Status.OK, estimate.reasons
    assert worst_at_equal_length(estimate.waypoints.positions, SHAPES[name]) < 0.02
    assert symmetric_mean(estimate.waypoints.positions, SHAPES[name]) < 0.001


@pytest.mark.parametrize("name", [name for name in SHAPES if name != "helix"])
def test_every_shape_is_tracked_through_sensor_noise(name: str) -> None:
    rng = np.random.default_rng(5)
    for _ in range(3):
        estimate = update(SlicingTracker(RED_ROPE), seen(SHAPES[name], camera=LARGE, noise=rng))
        assert worst_at_equal_length(estimate.waypoints.positions, SHAPES[name]) < 0.03
        assert symmetric_mean(estimate.waypoints.positions, SHAPES[name]) < 0.002


def test_a_helix_whose_far_side_is_hidden_is_right_or_not_called_ok() -> None:
    for camera in (SMALL, LARGE):
        estimate = update(SlicingTracker(RED_ROPE), seen(SHAPES["helix"], camera=camera))
        right = worst_at_equal_length(estimate.waypoints.positions, SHAPES["helix"]) < 0.03
        assert right or estimate.status is not Status.OK


def test_waypoints_run_from_tip_to_tip_at_the_spacing() -> None:
    estimate = update(SlicingTracker(RED_ROPE), seen(HANGING))
    length = float(np.linalg.norm(np.diff(HANGING, axis=0), axis=1).sum())
    assert estimate.waypoints.length == pytest.approx(length, abs=0.012)
    assert np.diff(estimate.waypoints.arc_length).mean() == pytest.approx(0.006, rel=0.02)
    assert coverage(estimate.waypoints.positions, HANGING, 0.005) > 0.98
    x_axes = Rotation.from_quat(estimate.waypoints.quaternions).as_matrix()[:, :, 0]
    steps = np.diff(estimate.waypoints.positions, axis=0)
    assert (np.sum(x_axes[:-1] * steps, axis=1) / np.linalg.norm(steps, axis=1)).min() > 0.99


def test_images_and_clouds_of_the_same_points_give_the_same() -> None:
    frame = seen(HANGING)
    tracker = SlicingTracker(ROPE)
    from_image = update(tracker, frame)
    points = tracker.cloud().points
    shuffled = points[np.random.default_rng(0).permutation(len(points))]
    from_cloud = update(SlicingTracker(ROPE), cloud_frame(shuffled))
    np.testing.assert_allclose(from_cloud.waypoints.positions, from_image.waypoints.positions, atol=1e-9)


def test_turning_the_camera_turns_the_shape_and_changes_nothing_else() -> None:
    """Up to the end that comes first, which depends on what is up."""
    rng = np.random.default_rng(3)
    for _ in range(10):
        points = rope_cloud(rng, 3000).T
        rotation = random_rotation(rng)
        follow = RopeConfig(diameter=0.012, ordering=OrderingConfig(first="point", first_point=(9.0, 0.0, 0.0)))
        turned_point = tuple(float(v) for v in rotation @ [9.0, 0, 0])
        turned = RopeConfig(
            diameter=0.012,
            ordering=OrderingConfig(first="point", first_point=(turned_point[0], turned_point[1], turned_point[2])),
        )
        a = update(SlicingTracker(follow), cloud_frame(points))
        b = update(SlicingTracker(turned), cloud_frame(points @ rotation.T))
        assert a.status is b.status
        np.testing.assert_allclose(b.nodes, a.nodes @ rotation.T, atol=1e-9)
        np.testing.assert_allclose(b.waypoints.positions, a.waypoints.positions @ rotation.T, atol=1e-9)


# --- accuracy on what has a formula ---

ARC = np.stack(
    [0.3 * np.cos(np.linspace(-0.9, 0.9, 400)) - 0.25, 0.3 * np.sin(np.linspace(-0.9, 0.9, 400)), np.ones(400)], axis=1
)
POSES = {
    "upright": straight((0.013, 0.0, 1.0), (0.0, 1.0, 0.0), 0.5),
    "leaning": straight((0.0, 0.0, 1.0), (0.2, 1.0, 0.0), 0.5),
    "diagonal": straight((0.0, 0.01, 1.0), (1.0, 1.0, 0.0), 0.5),
    "level": straight((0.0, 0.007, 1.0), (1.0, 0.0, 0.0), 0.5),
    "away": straight((0.0, 0.0, 1.0), (0.3, 1.0, 0.4), 0.5),
    "arc": ARC,
    "wave": SHAPES["hanging"],
}


@pytest.mark.parametrize("camera", [SMALL, LARGE], ids=["480x360", "1280x720"])
@pytest.mark.parametrize("name", POSES)
def test_a_noise_free_cylinder_of_15_mm_is_found_to_a_fifth_of_a_millimetre(name: str, camera: Intrinsics) -> None:
    estimate = update(SlicingTracker(RopeConfig(diameter=0.015)), seen(POSES[name], 0.0075, camera))
    assert estimate.status is Status.OK
    assert symmetric_mean(estimate.waypoints.positions, POSES[name]) <= 0.0002


@pytest.mark.parametrize(
    ("camera", "usual", "worst"), [(SMALL, 0.0002, 0.0004), (LARGE, 0.0001, 0.00015)], ids=["480x360", "1280x720"]
)
@pytest.mark.parametrize("turn", [0.0, 45.0, 90.0])
def test_a_rope_along_the_pixel_grid_is_found_less_well_but_not_badly(
    camera: Intrinsics, usual: float, worst: float, turn: float
) -> None:
    """Its edges fall on the same part of a pixel all along, so that nothing averages out: the weak spot, in figures."""
    errors = []
    for phase in np.linspace(0, 1, 12, endpoint=False):
        shift = phase / camera.fx
        along = (float(np.sin(np.radians(turn))), float(np.cos(np.radians(turn))), 0.0)
        curve = straight((shift, 0.3 * shift, 1.0), along, 0.5)
        estimate = update(SlicingTracker(RopeConfig(diameter=0.015)), seen(curve, 0.0075, camera))
        errors.append(symmetric_mean(estimate.waypoints.positions, curve))
    assert np.median(errors) <= usual
    assert max(errors) <= worst


# --- which end is first ---


def test_ends_do_not_swap_while_a_rope_turns_through_horizontal() -> None:
    rng = np.random.default_rng(2)
    tracker = SlicingTracker(RED_ROPE)
    for step, angle in enumerate(np.radians(np.arange(90, 90 + 360, 6.0))):
        curve = straight((0.0, 0.0, 1.0), (float(np.cos(angle)), float(np.sin(angle)), 0.0), 0.5)
        estimate = update(tracker, seen(curve, stamp_ns=step, noise=rng))
        first, last = estimate.waypoints.positions[[0, -1]]
        assert np.linalg.norm(first - curve[0]) < np.linalg.norm(last - curve[0])


def test_a_level_rope_keeps_its_ends_and_does_not_if_told_not_to() -> None:
    rng = np.random.default_rng(2)
    curve = straight((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), 0.5)
    alone = RopeConfig(diameter=0.012, ordering=OrderingConfig(follow_previous=False))
    swaps = {}
    for config in (ROPE, alone):
        tracker = SlicingTracker(config)
        left_first = [
            update(tracker, seen(curve, stamp_ns=step, noise=rng)).waypoints.positions[0, 0] < 0 for step in range(40)
        ]
        swaps[config.ordering.follow_previous] = int(np.count_nonzero(np.diff(left_first)))
    assert swaps[True] == 0
    assert swaps[False] > 0


def test_the_first_end_is_the_upper_one_or_the_one_near_a_point() -> None:
    for curve in (HANGING, HANGING[::-1].copy()):
        assert update(SlicingTracker(ROPE), seen(curve)).nodes[0, 1] < 0
        foot = RopeConfig(diameter=0.012, ordering=OrderingConfig(first="point", first_point=(0.0, 0.4, 1.0)))
        assert update(SlicingTracker(foot), seen(curve)).nodes[0, 1] > 0


def test_ends_are_the_same_after_the_rope_was_out_of_sight() -> None:
    tracker = SlicingTracker(ROPE)
    upside_down = straight((0.0, 0.0, 1.0), (0.3, -1.0, 0.0), 0.5)
    tracker.update(seen(straight((0.0, 0.0, 1.0), (1.0, 0.05, 0.0), 0.5)))
    assert update(tracker, seen(np.zeros((1, 3)), stamp_ns=1)).status is Status.LOST
    assert update(tracker, seen(upside_down, stamp_ns=2)).nodes[0, 1] > 0
    tracker.reset()
    assert update(tracker, seen(upside_down, stamp_ns=3)).nodes[0, 1] < 0


# --- nothing there, or hardly anything ---


def test_nothing_is_lost_with_a_reason() -> None:
    assert lost(seen(np.zeros((1, 3)))) == "no points of the rope's colour and place"
    assert lost(cloud_frame(np.empty((0, 3)))) == "no points of the rope's colour and place"
    assert lost(cloud_frame(np.full((500, 3), np.nan))) == "no points of the rope's colour and place"
    assert lost(cloud_frame(np.full((500, 3), np.inf))) == "no points of the rope's colour and place"
    blind = RgbdFrame(0, np.full((360, 480), np.nan, np.float32), 1.0, SMALL)
    assert lost(blind) == "no points of the rope's colour and place"


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_a_few_points_are_too_few(count: int) -> None:
    points = np.linspace([0, 0, 1], [0.5, 0, 1], count)
    assert lost(cloud_frame(points)) == f"too few points ({count})"


def test_identical_points_make_no_rope() -> None:
    assert "500 points make a single slice" in lost(cloud_frame(np.ones((500, 3))))


def test_two_heaps_do_not_hang_together() -> None:
    points = np.repeat([[0.0, 0, 1], [0.5, 0, 1]], 200, axis=0)
    assert lost(cloud_frame(points)) == "the points do not hang together"


def test_a_diameter_larger_than_the_rope_is_told() -> None:
    assert "is too large for them" in lost(seen(straight((0, 0, 1), (0, 1, 0), 0.05)), RopeConfig(diameter=0.2))


def test_lines_and_planes_do_not_break_it() -> None:
    rng = np.random.default_rng(0)
    t = np.linspace(-0.3, 0.3, 1500)
    line = np.stack([t, 0.3 * t, 1 + 0.1 * t], axis=1)
    thin = update(SlicingTracker(ROPE), cloud_frame(line))
    assert "as wide as a tube of" in thin.reasons[0]
    assert symmetric_mean(thin.waypoints.positions, line) < 0.01
    toward = np.stack([0 * t, 0 * t, 1 + t], axis=1)
    update(SlicingTracker(ROPE), cloud_frame(toward))
    plane = np.column_stack([rng.uniform(-0.3, 0.3, (4000, 2)), np.ones(4000)])
    assert update(SlicingTracker(ROPE), cloud_frame(plane)).status is not Status.OK


@pytest.mark.parametrize("scale", [1e-6, 1e3, 1e6, 1e12, 1e30, 1e100, 1e200])
def test_a_wrong_unit_or_garbage_is_not_called_ok(scale: float) -> None:
    points = rope_cloud(np.random.default_rng(0), 5000).T * scale
    assert update(SlicingTracker(ROPE), cloud_frame(points)).status is not Status.OK


def test_one_stray_point_at_the_end_of_the_world_costs_nothing() -> None:
    points = rope_cloud(np.random.default_rng(1), 4000).T
    plain = update(SlicingTracker(ROPE), cloud_frame(points))
    for far in (50.0, 1e6, 3e38):
        for where in (0, len(points)):
            with_stray = np.insert(points, where, [far, 0, 1], axis=0)
            estimate = update(SlicingTracker(ROPE), cloud_frame(with_stray))
            assert estimate.status is not Status.LOST
            assert symmetric_mean(estimate.waypoints.positions, plain.waypoints.positions) < 0.002


# --- background, caps, several ropes ---


@pytest.mark.parametrize("wavy", [False, True])
@pytest.mark.parametrize("pixels", [40_000, 300_000, 921_600])
def test_background_taken_for_rope_is_told_and_soon_over(pixels: int, wavy: bool) -> None:
    """A wall that fills part of the image and passes every gate: not called ok, in bounded time, and then forgotten."""
    wall = np.zeros((720, 1280), np.float32)
    height = round((pixels * 9 / 16) ** 0.5)
    wall[:height, : pixels // height] = 1.5
    if wavy:
        wall[wall > 0] += (0.1 * np.sin(np.arange(720) / 40))[np.nonzero(wall)[0]].astype(np.float32)
    tracker = SlicingTracker(ROPE)
    tracker.update(seen(HANGING, camera=LARGE))
    started = time.process_time()
    estimate = update(tracker, RgbdFrame(1, wall, 1.0, LARGE))
    assert time.process_time() - started < 60, "bounded, with all its compiling on a slow machine"
    assert estimate.status is not Status.OK
    after = update(tracker, seen(HANGING, camera=LARGE, stamp_ns=2))
    assert after.status is Status.OK
    assert symmetric_mean(after.waypoints.positions, HANGING) < 0.001


def test_a_cloud_of_noise_is_not_called_ok() -> None:
    rng = np.random.default_rng(0)
    for count in (300, 3000, 30_000):
        points = rng.uniform([-0.5, -0.5, 0.7], [0.5, 0.5, 1.5], (count, 3))
        assert update(SlicingTracker(ROPE), cloud_frame(points)).status is not Status.OK


def test_caps_are_honoured_and_told() -> None:
    few = RopeConfig(diameter=0.012, slicing=SlicingConfig(max_nodes=8))
    estimate = update(SlicingTracker(few), seen(HANGING))
    assert estimate.status is Status.DEGRADED
    assert len(estimate.nodes) <= 8
    assert any("more than 8 slices" in reason for reason in estimate.reasons)
    thin = RopeConfig(diameter=0.012, slicing=SlicingConfig(max_points=500))
    estimate = update(SlicingTracker(thin), seen(HANGING))
    assert estimate.status is Status.DEGRADED
    assert estimate.point_stride == -(-estimate.point_count // 500) > 1
    assert any("one in" in reason for reason in estimate.reasons)
    assert symmetric_mean(estimate.waypoints.positions, HANGING) < 0.003


def test_two_ropes_are_told_and_one_of_them_is_tracked() -> None:
    longer = straight((0.3, 0.0, 1.0), (0.0, 1.0, 0.0), 0.6)
    shorter = straight((-0.2, 0.0, 1.0), (0.0, 1.0, 0.0), 0.4)
    estimate = update(SlicingTracker(RED_ROPE), seen(longer, more=Capsules.along(shorter, 0.006)))
    assert estimate.status is Status.DEGRADED
    assert "are left out" in estimate.reasons[0]
    assert symmetric_mean(estimate.waypoints.positions, longer) < 0.001


def test_a_hidden_middle_is_bridged_and_told_or_left_out_and_told() -> None:
    for width, word in ((0.08, "is bridged"), (0.3, "are left out")):
        upper = straight((0.0, -0.1 - width / 2, 1.0), (0.0, 1.0, 0.0), 0.2)
        lower = straight((0.0, 0.15 + width / 2, 1.0), (0.0, 1.0, 0.0), 0.3)
        estimate = update(SlicingTracker(ROPE), seen(upper, more=Capsules.along(lower, 0.006)))
        assert estimate.status is Status.DEGRADED
        assert word in " ".join(estimate.reasons)


# --- colour, boxes, masks ---

FLOOR = Plane((0.0, 0.0, 1.0), 1.06, (90, 110, 90), 1)


def test_the_colour_finds_the_rope_before_a_wall() -> None:
    frame = seen(HANGING, planes=(FLOOR,))
    estimate = update(SlicingTracker(RED_ROPE), frame)
    assert estimate.status is Status.OK
    assert symmetric_mean(estimate.waypoints.positions, HANGING) < 0.001
    assert update(SlicingTracker(ROPE), frame).status is not Status.OK


def test_a_pixel_gives_the_colour_and_reset_asks_it_again() -> None:
    column, row = (round(float(v)) for v in HANGING[1000, :2] / HANGING[1000, 2] * SMALL.fx + [SMALL.cx, SMALL.cy])
    config = RopeConfig(diameter=0.012, segmentation=SegmentationConfig(color_pixel=(column, row)))
    frame = seen(HANGING, planes=(FLOOR,))
    tracker = SlicingTracker(config)
    assert update(tracker, frame).status is Status.OK
    assert frame.color is not None
    swapped = RgbdFrame(1, frame.depth, 1.0, SMALL, np.ascontiguousarray(frame.color[..., ::-1]))
    assert update(tracker, swapped).status is Status.LOST
    tracker.reset()
    assert update(tracker, swapped).status is Status.OK


def test_a_pixel_outside_or_a_cloud_is_refused() -> None:
    config = RopeConfig(diameter=0.012, segmentation=SegmentationConfig(color_pixel=(480, 10)))
    with pytest.raises(FrameError, match="lies outside the 480x360 image"):
        SlicingTracker(config).update(seen(HANGING))
    with pytest.raises(FrameError, match="needs images"):
        SlicingTracker(config).update(CloudFrame(0, np.zeros((5, 3)), np.zeros((5, 3), np.uint8)))


def test_no_colour_where_it_is_asked_for() -> None:
    frame = seen(HANGING)
    bare = RgbdFrame(0, frame.depth, 1.0, SMALL)
    for config in (
        RED_ROPE,
        RopeConfig(diameter=0.012, segmentation=SegmentationConfig(color_pixel=(3, 3))),
        RopeConfig(diameter=0.012, segmentation=SegmentationConfig(lab_min=(0, 0, 0), lab_max=(90, 90, 90))),
    ):
        with pytest.raises(FrameError, match="a colour is asked for, but the frame has none"):
            SlicingTracker(config).update(bare)
    with pytest.raises(FrameError, match="frame has none"):
        SlicingTracker(RED_ROPE).update(cloud_frame(np.zeros((5, 3))))
    assert SlicingTracker(ROPE).update(bare).status is Status.OK


def test_a_lab_box_serves_as_colour() -> None:
    config = RopeConfig(diameter=0.012, segmentation=SegmentationConfig(lab_min=(20, 30, 15), lab_max=(60, 80, 70)))
    assert update(SlicingTracker(config), seen(HANGING, planes=(FLOOR,))).status is Status.OK


@pytest.mark.parametrize("in_world", [False, True])
def test_the_position_box_finds_the_rope_before_a_wall(in_world: bool) -> None:
    low, high = (-0.4, -0.4, 0.9), (0.4, 0.4, 1.04)
    pose = None
    if in_world:  # a camera 2 m up that looks straight down: the wall is the floor
        pose = (1.0, 0.5, 2.0, 1.0, 0.0, 0.0, 0.0)
        low, high = (0.6, 0.1, 0.96), (1.4, 0.9, 1.1)
    config = RopeConfig(
        diameter=0.012,
        camera_pose=pose,
        segmentation=SegmentationConfig(box_min=low, box_max=high, box_frame="world" if in_world else "camera"),
    )
    estimate = update(SlicingTracker(config), seen(HANGING, planes=(FLOOR,)))
    assert estimate.status is Status.OK
    assert symmetric_mean(estimate.waypoints.positions, HANGING) < 0.001


def test_a_mask_takes_the_place_of_the_colour() -> None:
    frame = seen(HANGING, planes=(FLOOR,))
    mask = frame.depth < 1.05
    tracker = SlicingTracker(RopeConfig(diameter=0.012, color="#00ff00"), mask)
    assert update(tracker, frame).status is Status.OK
    function = SlicingTracker(ROPE, lambda f: f.depth < 1.05 if isinstance(f, RgbdFrame) else np.ones(1, bool))
    assert update(function, frame).status is Status.OK
    no_color = RgbdFrame(1, frame.depth, 1.0, SMALL)
    assert update(tracker, no_color).status is Status.OK


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (np.ones((10, 10), bool), "expected bool of shape \\(360, 480\\)"),
        (np.ones((360, 480), np.uint8), "the mask is uint8"),
        (np.ones((480, 360), bool), "the mask is bool of shape \\(480, 360\\)"),
        ([[True]], "the mask is"),
    ],
)
def test_a_mask_that_does_not_fit_is_refused(mask: Any, message: str) -> None:
    with pytest.raises(FrameError, match=message):
        SlicingTracker(ROPE, mask).update(seen(HANGING))


# --- streams ---


def test_stamps_that_repeat_or_run_back_are_told_once() -> None:
    tracker = SlicingTracker(ROPE)
    frame = seen(HANGING)

    def reasons(stamp_ns: int) -> tuple[str, ...]:
        return update(tracker, RgbdFrame(stamp_ns, frame.depth, 1.0, SMALL)).reasons

    assert reasons(10**9) == ()
    assert reasons(10**9) == ("the stamp repeats that of the frame before",)
    assert reasons(5 * 10**8) == ("the stamp runs back by 0.500 s",)
    assert reasons(6 * 10**8) == ()
    tracker.reset()
    assert reasons(0) == ()


def test_a_frame_that_fails_leaves_the_tracker_as_it_was() -> None:
    calls = 0

    def mask(frame: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == 2:
            raise RuntimeError("the user's own")
        return np.ones((3, 3) if calls == 3 else frame.depth.shape, bool)

    tracker = SlicingTracker(ROPE, mask)
    upside_down = straight((0.0, 0.0, 1.0), (0.1, -1.0, 0.0), 0.6)
    first = update(tracker, seen(HANGING))
    with pytest.raises(RuntimeError, match="the user's own"):
        tracker.update(seen(HANGING, stamp_ns=1))
    assert len(tracker.cloud().points) == 0, "the points of another frame"
    with pytest.raises(FrameError):
        tracker.update(seen(HANGING, stamp_ns=2))
    assert len(tracker.cloud().points) == 0
    again = update(tracker, seen(HANGING, stamp_ns=3))
    assert again.status is Status.OK
    np.testing.assert_array_equal(again.waypoints.positions, first.waypoints.positions)
    assert update(tracker, seen(upside_down, stamp_ns=4)).status is Status.OK


def test_the_same_frames_give_the_same_bytes() -> None:
    def run(tracker: SlicingTracker) -> Iterator[bytes]:
        rng = np.random.default_rng(4)
        for step in range(5):
            name = list(SHAPES)[step]
            estimate = tracker.update(seen(SHAPES[name], stamp_ns=step, noise=rng))
            waypoints = estimate.waypoints
            for array in (estimate.nodes, waypoints.positions, waypoints.quaternions, waypoints.arc_length):
                yield array.tobytes()
            yield tracker.cloud().node.tobytes()

    tracker = SlicingTracker(RED_ROPE)
    first = list(run(tracker))
    assert list(run(SlicingTracker(RED_ROPE))) == first
    tracker.reset()
    assert list(run(tracker)) == first, "reset() left something behind"


def test_an_estimate_outlives_the_next_frame() -> None:
    tracker = SlicingTracker(ROPE)
    estimate = tracker.update(seen(HANGING))
    cloud = tracker.cloud()
    kept = [a.copy() for a in (estimate.nodes, estimate.waypoints.positions, cloud.points, cloud.node)]
    tracker.update(seen(SHAPES["s"], stamp_ns=1))
    for before, now in zip(kept, (estimate.nodes, estimate.waypoints.positions, cloud.points, cloud.node), strict=True):
        np.testing.assert_array_equal(before, now)


def test_frames_are_not_written_to() -> None:
    frame = seen(HANGING)
    points = rope_cloud(np.random.default_rng(0), 2000).T.copy()
    for given in (frame, cloud_frame(points)):
        array = given.depth if isinstance(given, RgbdFrame) else given.points
        before = array.copy()
        array.setflags(write=False)
        update(SlicingTracker(ROPE), given)
        np.testing.assert_array_equal(array, before)


def test_labels_are_those_of_the_nodes() -> None:
    tracker = SlicingTracker(RED_ROPE)
    estimate = update(tracker, seen(HANGING, noise=np.random.default_rng(0)))
    cloud = tracker.cloud()
    assert len(cloud.points) == estimate.point_count
    assert set(np.unique(cloud.node)) - {-1} == set(range(len(estimate.nodes)))
    assert (cloud.node >= 0).mean() > 0.95
    for index, node in enumerate(estimate.nodes):
        assert np.linalg.norm(cloud.points[cloud.node == index].mean(axis=0) - node) < 0.012
    tracker.update(seen(np.zeros((1, 3)), stamp_ns=1))
    assert len(tracker.cloud().points) == 0


def test_stages_are_told_in_order() -> None:
    stages: list[str] = []
    tracker = SlicingTracker(ROPE)
    tracker.update(seen(HANGING), stages.append)
    assert stages == ["segmentation", "slicing", "ordering", "centerline"]
    stages.clear()
    tracker.update(seen(np.zeros((1, 3)), stamp_ns=1), stages.append)
    assert stages == ["segmentation"]


def test_the_diameter_that_is_seen() -> None:
    for diameter in (0.01, 0.015):
        tracker = SlicingTracker(RopeConfig(diameter=diameter))
        assert tracker.seen_diameter == 0.0
        tracker.update(seen(HANGING, diameter / 2, LARGE))
        assert tracker.seen_diameter == pytest.approx(diameter, rel=0.1)


# --- settings reach what they set ---


def test_the_papers_settings() -> None:
    config = RopeConfig(
        diameter=0.012,
        slicing=SlicingConfig(variance_threshold=3e-4, min_points=20, surface_offset=(0.0, 0.0, 0.005)),
        ordering=OrderingConfig(method="greedy"),
        centerline=CenterlineConfig(spacing=0.02),
    )
    estimate = update(SlicingTracker(config), seen(HANGING))
    assert estimate.status is Status.OK
    assert symmetric_mean(estimate.waypoints.positions, HANGING) < 0.002
    assert np.diff(estimate.waypoints.arc_length).mean() == pytest.approx(0.02, rel=0.05)
    assert len(estimate.nodes) < len(update(SlicingTracker(ROPE), seen(HANGING)).nodes)


def test_methods_are_found_by_name() -> None:
    assert isinstance(make_tracker(ROPE), PersistentTracker)
    assert isinstance(make_tracker(replace(ROPE, method="slicing")), SlicingTracker)
    assert next(iter(METHODS)) == "persistent"
    with pytest.raises(ConfigError, match="method = 'magic': expected one of persistent"):
        make_tracker(RopeConfig(diameter=0.01, method="magic"))


# --- real recordings ---


def bcpd_frames() -> Iterator[RgbdFrame]:
    folder = DATA / "bcpd_rope_d435"
    k = json.loads((folder / "intrinsics.json").read_text())
    camera = Intrinsics(k["width"], k["height"], k["fx"], k["fy"], k["cx"], k["cy"])
    for index in range(6):
        depth = np.asarray(Image.open(folder / f"depth_{index:03d}.png")).astype(np.uint16)
        yield RgbdFrame(index, depth, k["depth_unit_m"], camera)


@needs_data
def test_a_real_rope_on_a_table() -> None:
    tracker = SlicingTracker(RopeConfig(diameter=0.006))
    previous: FloatArray | None = None
    for frame in bcpd_frames():
        estimate = update(tracker, frame)
        assert estimate.status is not Status.LOST
        line = estimate.waypoints.positions
        assert 0.8 < estimate.waypoints.length < 1.3
        assert distances_to_curve(tracker.cloud().points, line).mean() <= 0.004
        # One chain: nearly every point belongs to one of its nodes.
        assert (tracker.cloud().node >= 0).mean() > 0.95
        if previous is not None:
            ends = np.linalg.norm(line[[0, -1]] - previous[[0, -1]], axis=1)
            swapped = np.linalg.norm(line[[-1, 0]] - previous[[0, -1]], axis=1)
            assert ends.sum() < swapped.sum()
        previous = line


@needs_data
@pytest.mark.parametrize("rope", [1, 2])
def test_real_motion_seen_by_a_made_camera(rope: int) -> None:
    camera = Intrinsics(640, 480, 615.0, 615.0, 319.5, 239.5)
    markers = np.load(DATA / "deform_mocap" / f"DLO{rope}_clean.npz")["markers"][3].astype(float)
    knots = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(markers, axis=1), axis=2).mean(axis=0))])
    curves = CubicSpline(knots, markers, axis=1)(np.linspace(0, knots[-1], 300))
    curves -= (curves.min(axis=(0, 1)) + curves.max(axis=(0, 1))) / 2
    curves = np.stack([curves[..., 0], -curves[..., 2], curves[..., 1] + 1.25], axis=-1)
    rng = np.random.default_rng(0)
    tracker = SlicingTracker(RED_ROPE)
    errors = []
    for index in range(0, 500, 25):
        estimate = update(tracker, seen(curves[index], 0.006, camera, index, rng))
        assert estimate.status is not Status.LOST
        errors.append(symmetric_mean(estimate.waypoints.positions, curves[index]))
    assert np.mean(errors) <= 0.0012


@needs_data
@pytest.mark.parametrize(
    "path",
    [
        "kinect_rope/data4.npz",
        "kinect_rope/rope1.npz",
        "xtion_cable/cableA.npz",
        "xtion_cable/plane2.npz",
        *(f"azure_soft_joint/{index}.npz" for index in (0, 1, 2, 4)),
        "branched_cable_cloud/full.npz",
    ],
)
@pytest.mark.parametrize("diameter", [0.004, 0.012, 0.04])
def test_real_clouds_get_a_status(path: str, diameter: float) -> None:
    points = np.load(DATA / path)["points"]
    estimate = update(SlicingTracker(RopeConfig(diameter=diameter)), cloud_frame(points.astype(float)))
    if path == "xtion_cable/plane2.npz":
        assert estimate.status is not Status.OK


# --- not called ok ---


def test_what_is_no_ropes_shape_is_not_called_ok() -> None:
    ball = np.zeros((1, 3)) + [[0.0, 0.0, 1.0]]
    scenes = {
        "a ball": (seen(np.repeat(ball, 2, axis=0), 0.02), 0.012),
        "a diameter of 20 cm": (seen(HANGING), 0.2),
        "twice the diameter": (seen(HANGING, camera=LARGE), 0.024),
        "half the diameter": (seen(HANGING, camera=LARGE), 0.006),
    }
    for name, (frame, diameter) in scenes.items():
        assert update(SlicingTracker(RopeConfig(diameter=diameter)), frame).status is not Status.OK, name


def test_a_length_that_jumps_is_told_until_it_is_usual() -> None:
    tracker = SlicingTracker(ROPE)
    whole, half = straight((0, 0, 1), (0.1, 1, 0), 0.6), straight((0, -0.15, 1), (0.1, 1, 0), 0.3)
    for stamp in range(10):
        assert update(tracker, seen(whole, stamp_ns=stamp)).status is Status.OK
    statuses = [update(tracker, seen(half, stamp_ns=10 + k)) for k in range(20)]
    assert "0.6" in statuses[0].reasons[0]
    assert "a part is hidden" in statuses[0].reasons[0]
    assert statuses[-1].status is Status.OK, "that is how long the rope is now"


def test_a_stamp_that_leaps_ahead_is_told() -> None:
    tracker = SlicingTracker(ROPE)
    update(tracker, seen(HANGING))
    assert "leaps ahead by 3600 s" in update(tracker, seen(HANGING, stamp_ns=3600 * 10**9)).reasons[0]


def test_a_rope_that_leads_away_does_not_overlap_itself() -> None:
    for angle in (20, 30, 45):
        away = np.radians(angle)
        rope = straight((0.0, 0.0, 1.1), (np.sin(away), 0.0, np.cos(away)), 0.5)
        reasons = update(SlicingTracker(ROPE), seen(rope, camera=LARGE)).reasons
        assert not any("overlap" in reason for reason in reasons)


def test_a_bad_frame_is_lost_and_forgotten() -> None:
    tracker = SlicingTracker(ROPE)
    update(tracker, seen(HANGING))
    lost_frame = tracker.update(BadFrame(1, "the image is torn"))
    assert (lost_frame.status, lost_frame.reasons) == (Status.LOST, ("the image is torn",))
    assert len(tracker.cloud().points) == 0
    assert update(tracker, seen(HANGING, stamp_ns=2)).status is Status.OK


def test_repeated_spots_never_raise() -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        spots = rng.normal(0, 10.0 ** rng.integers(-9, 3), (rng.integers(1, 9), 3)) + [0, 0, 1]
        update(SlicingTracker(ROPE), cloud_frame(np.repeat(spots, rng.integers(1, 60), axis=0)))
