"""Frames, waypoints and estimates refuse what cannot be right, and say what it was."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers import random_rotation
from ropetrace.errors import FrameError
from ropetrace.types import (
    Cloud,
    CloudFrame,
    Estimate,
    Intrinsics,
    Motion,
    RgbdFrame,
    Status,
    Waypoints,
    coordinate_buffer,
)

CAMERA = Intrinsics(8, 6, 10.0, 10.0, 3.5, 2.5)
DEPTH = np.zeros((6, 8), np.uint16)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "image size 0x6 is impossible"),
        ({"height": -6}, "impossible"),
        ({"width": 10**6, "height": 10**6}, "impossible"),
        ({"fx": 0.0}, "focal lengths fx = 0.0, fy = 10.0 must be positive"),
        ({"fy": -10.0}, "must be positive"),
        ({"fx": math.nan}, "fx = nan is not a finite number"),
        ({"cy": math.inf}, "cy = inf is not a finite number"),
        ({"cx": 16.0}, "belong to another resolution"),
        ({"cy": -6.0}, "belong to another resolution"),
    ],
)
def test_impossible_cameras(change: dict[str, Any], message: str) -> None:
    with pytest.raises(FrameError, match=message):
        dataclasses.replace(CAMERA, **change)


def test_a_principal_point_beside_the_image_is_a_cropped_one() -> None:
    assert dataclasses.replace(CAMERA, cx=-7.0, cy=11.0).cx == -7.0


@pytest.mark.parametrize(
    ("depth", "unit", "color", "message"),
    [
        (np.zeros((6, 8), np.float64), 1.0, None, "depth is float64 of shape \\(6, 8\\): expected"),
        (np.zeros((6, 8), np.int16), 1.0, None, "depth is int16"),
        (np.zeros((6, 8), ">u2"), 1.0, None, "depth is >u2"),
        (np.zeros((6, 8, 1), np.uint16), 1.0, None, "expected an \\(H, W\\) image"),
        (np.zeros((8, 6), np.uint16), 1.0, None, "depth is 6x8, its intrinsics are for 8x6"),
        (DEPTH, 0.0, None, "depth_unit_m = 0.0 must be a positive number"),
        (DEPTH, -1.0, None, "depth_unit_m"),
        (DEPTH, math.nan, None, "depth_unit_m = nan"),
        (DEPTH, math.inf, None, "depth_unit_m = inf"),
        (DEPTH, 0.001, np.zeros((6, 8), np.uint8), "colour is uint8 of shape \\(6, 8\\)"),
        (DEPTH, 0.001, np.zeros((6, 8, 4), np.uint8), "expected an \\(H, W, 3\\)"),
        (DEPTH, 0.001, np.zeros((6, 8, 3), np.float32), "colour is float32"),
        (
            DEPTH,
            0.001,
            np.zeros((12, 16, 3), np.uint8),
            "colour is 16x12 but depth is 8x6: record depth that is aligned",
        ),
    ],
)
def test_impossible_images(depth: Any, unit: float, color: Any, message: str) -> None:
    with pytest.raises(FrameError, match=message):
        RgbdFrame(0, depth, unit, CAMERA, color)


def test_both_kinds_of_depth_are_taken() -> None:
    assert RgbdFrame(0, DEPTH, 0.001, CAMERA).color is None
    assert RgbdFrame(0, DEPTH.astype(np.float32), 1.0, CAMERA, np.zeros((6, 8, 3), np.uint8)).stamp_ns == 0


@pytest.mark.parametrize(
    ("points", "colors", "message"),
    [
        (np.zeros((3, 4)), None, "expected \\(N, 3\\) floating point"),
        (np.zeros(3), None, "expected \\(N, 3\\)"),
        (np.zeros((4, 3), int), None, "points are int64"),
        (np.zeros((4, 3)), np.zeros((5, 3), np.uint8), "point colours are uint8 of shape \\(5, 3\\)"),
        (np.zeros((4, 3)), np.zeros((4, 3)), "point colours are float64"),
    ],
)
def test_impossible_clouds(points: Any, colors: Any, message: str) -> None:
    with pytest.raises(FrameError, match=message):
        CloudFrame(0, points, colors)


def test_frames_and_estimates_are_frozen() -> None:
    for thing in (RgbdFrame(0, DEPTH, 0.001, CAMERA), CloudFrame(0, np.zeros((4, 3))), Estimate.lost(0, "x")):
        with pytest.raises(dataclasses.FrozenInstanceError):
            thing.stamp_ns = 1  # type: ignore[misc]


def test_waypoints_of_other_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="do not fit"):
        Waypoints(np.zeros((4, 3)), np.zeros((3, 4)), np.zeros(4))
    with pytest.raises(ValueError, match="do not fit"):
        Waypoints(np.zeros((4, 2)), np.zeros((4, 4)), np.zeros(4))
    with pytest.raises(ValueError, match="arc_length has shape"):
        Waypoints(np.zeros((4, 3)), np.zeros((4, 4)), np.zeros(5))
    with pytest.raises(ValueError, match="cloud: shapes"):
        Cloud(np.zeros((4, 3)), np.zeros(3, np.int32))


def test_no_waypoints() -> None:
    none = Waypoints.none()
    assert (len(none), none.length, len(none.transformed(np.eye(4)))) == (0, 0.0, 0)


def test_waypoints_in_another_frame() -> None:
    rng = np.random.default_rng(0)
    angles = np.linspace(0, 7, 50)
    quaternions = Rotation.from_rotvec(angles[:, None] * [0.6, 0.0, 0.8]).as_quat()
    quaternions *= np.where(np.cumsum(np.r_[False, (quaternions[1:] * quaternions[:-1]).sum(1) < 0]) % 2, -1, 1)[
        :, None
    ]
    waypoints = Waypoints(rng.random((50, 3)), quaternions, np.linspace(0, 1, 50))
    for _ in range(20):
        transform = np.eye(4)
        transform[:3, :3], transform[:3, 3] = random_rotation(rng), rng.uniform(-3, 3, 3)
        moved = waypoints.transformed(transform)
        homogeneous = np.column_stack([waypoints.positions, np.ones(50)]) @ transform.T
        np.testing.assert_allclose(moved.positions, homogeneous[:, :3], atol=1e-14)
        np.testing.assert_allclose(
            Rotation.from_quat(moved.quaternions).as_matrix(),
            transform[:3, :3] @ Rotation.from_quat(quaternions).as_matrix(),
            atol=1e-12,
        )
        assert ((moved.quaternions[1:] * moved.quaternions[:-1]).sum(axis=1) > 0).all()
        assert moved.length == waypoints.length == 1.0


def test_a_motion_of_other_shapes_is_refused() -> None:
    rows = np.zeros((4, 3))
    assert len(Motion(rows, rows, rows, rows, rows)) == 4
    with pytest.raises(ValueError, match=r"motion: shapes .*\(4, 3\), \(5, 3\).* do not fit, expected \(W, 3\)"):
        Motion(rows, rows, rows, rows, np.zeros((5, 3)))
    with pytest.raises(ValueError, match="do not fit"):
        Motion(*[np.zeros((4, 2))] * 5)
    with pytest.raises(ValueError, match="do not fit"):
        Motion(*[np.zeros(3)] * 5)
    with pytest.raises(ValueError, match="estimate: 0 waypoints, but the motion of 4"):
        Estimate(0, Status.OK, motion=Motion(rows, rows, rows, rows, rows))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seen": np.ones(3, bool)}, r"seen is bool of shape \(3,\): expected bool of shape \(4,\)"),
        ({"seen": np.ones(4)}, "seen is float64"),
        ({"position_sigma": np.ones((4, 3))}, r"position_sigma is float64 of shape \(4, 3\): expected .* \(4,\)"),
        ({"position_sigma": np.ones(4, np.float32)}, "position_sigma is float32"),
        ({"position_sigma": np.array([0.0, 1, -1e-9, 1])}, "a position_sigma is negative or not a finite number"),
        ({"position_sigma": np.array([0.0, 1, math.nan, 1])}, "a position_sigma is negative or not a finite number"),
        ({"position_sigma": np.array([0.0, 1, math.inf, 1])}, "a position_sigma is negative or not a finite number"),
        ({"rope": -1}, "rope = -1 is negative"),
    ],
)
def test_what_a_tracker_tells_of_the_waypoints_fits_them(change: dict[str, Any], message: str) -> None:
    waypoints = Waypoints(np.zeros((4, 3)), np.zeros((4, 4)), np.zeros(4))
    whole = Estimate(0, Status.OK, waypoints=waypoints, seen=np.ones(4, bool), position_sigma=np.zeros(4), rope=2)
    assert (whole.rope, Estimate.lost(0, "x").rope, Estimate.lost(0, "x", rope=2).rope) == (2, 0, 2)
    with pytest.raises(ValueError, match=f"estimate: {message}"):
        dataclasses.replace(whole, **change)


def test_a_motion_in_another_frame() -> None:
    """Its sigmas are the square roots of the diagonals of covariances that turn."""
    rng = np.random.default_rng(0)
    motion = Motion(rng.normal(size=(20, 3)), rng.normal(size=(20, 3)), *rng.random((3, 20, 3)))
    for _ in range(20):
        transform = np.eye(4)
        transform[:3, :3], transform[:3, 3] = random_rotation(rng), rng.uniform(-3, 3, 3)
        turn = transform[:3, :3]
        turned = motion.rotated(transform)
        for name in ("velocities", "accelerations"):
            expected = [turn @ row for row in getattr(motion, name)]
            np.testing.assert_allclose(getattr(turned, name), expected, atol=1e-14)
        for name in ("position_sigma", "velocity_sigma", "acceleration_sigma"):
            expected = [np.sqrt(np.diag(turn @ np.diag(row**2) @ turn.T)) for row in getattr(motion, name)]
            np.testing.assert_allclose(getattr(turned, name), expected, atol=1e-14)


def test_a_lost_estimate_has_nothing_but_its_reason() -> None:
    lost = Estimate.lost(5, "too few points (3)", 3)
    assert (lost.stamp_ns, lost.status, lost.reasons) == (5, Status.LOST, ("too few points (3)",))
    assert (lost.nodes.shape, len(lost.waypoints), lost.point_count) == ((0, 3), 0, 3)


def test_statuses_are_their_words() -> None:
    assert [f"{status}" for status in Status] == ["ok", "degraded", "lost"]


@pytest.mark.parametrize("count", [0, 1, 511, 512, 480 * 360, 640 * 480, 1280 * 720, 4096])
def test_rows_of_a_buffer_lie_off_the_page_grid(count: int) -> None:
    buffer = coordinate_buffer(count)
    assert buffer.shape[0] == 3
    assert count <= buffer.shape[1] <= count + 1024
    assert buffer.strides[0] % 4096 != 0
