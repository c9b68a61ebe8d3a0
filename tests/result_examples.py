"""Estimates, frames and clouds for the tests of the writers: a turning helix, now and then lost."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from ropetrace.types import Cloud, Estimate, Intrinsics, Motion, RgbdFrame, Status, Waypoints

FIRST_STAMP = 1_700_000_000_123_456_789
REASONS = ('a gap of 4 cm, "bridged"', "second line:\nnaïve – длина ≈ 3 m")


def helix(index: int, count: int = 50) -> Waypoints:
    """A helix of 0.6 m height that turns from frame to frame."""
    turn = np.linspace(0, 6, count)
    angle = turn + 0.1 * index
    positions = np.column_stack((0.1 * np.cos(angle), 0.1 * turn - 0.3, 1 + 0.1 * np.sin(angle)))
    quaternions = Rotation.from_euler("yz", np.column_stack((-angle, np.full(count, 0.8)))).as_quat()
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return Waypoints(positions, np.asarray(quaternions), np.concatenate(([0.0], np.cumsum(steps))))


def motion(index: int, count: int = 50) -> Motion:
    """Of the helix that turns by 0.1 rad in 0.1 s; the sigmas differ from axis to axis and from array to array."""
    angle = np.linspace(0, 6, count) + 0.1 * index
    zero = np.zeros(count)
    velocities = 0.1 * np.column_stack((-np.sin(angle), zero, np.cos(angle)))
    accelerations = -0.1 * np.column_stack((np.cos(angle), zero, np.sin(angle)))
    sigma = np.array([0.001, 0.002, 0.003]) * np.linspace(1, 2, count)[:, None]
    return Motion(velocities, accelerations, sigma, 7 * sigma, 61 * sigma)


def estimate(index: int) -> Estimate:
    """Every 5th frame from the 4th on is lost, every 5th from the 3rd on is degraded.

    The motion is not known in the first frame and after a lost one; every 3rd frame is predicted, 25 ms ahead.
    """
    stamp_ns = FIRST_STAMP + index * 33_333_333
    if index % 5 == 4:
        return Estimate.lost(stamp_ns, "too few points (3 < 25)", point_count=3)
    waypoints = helix(index)
    nodes = waypoints.positions[:: 7 + index % 3]
    moving = motion(index) if index % 5 else None
    ahead_ns = 25_000_000 if index % 3 == 1 else 0
    if index % 5 == 3:
        return Estimate(stamp_ns, Status.DEGRADED, REASONS, nodes, waypoints, 900, 1, moving, ahead_ns)
    return Estimate(stamp_ns, Status.OK, (), nodes, waypoints, 1000 + index, 1, moving, ahead_ns)


def estimates(count: int) -> list[Estimate]:
    """The estimates of a run."""
    return [estimate(index) for index in range(count)]


def told(index: int, rope: int = 0) -> Estimate:
    """The estimate with a hidden middle and a standard deviation that grows towards it."""
    item = dataclasses.replace(estimate(index), rope=rope)
    places = np.linspace(-1, 1, len(item.waypoints))
    return dataclasses.replace(item, seen=abs(places) > 0.3, position_sigma=0.001 + 0.02 * (1 - abs(places)))


def frame(index: int, width: int = 64, height: int = 48, color: bool = True) -> RgbdFrame:
    """A slope with a grey image."""
    camera = Intrinsics(width, height, 0.8 * width, 0.8 * width, (width - 1) / 2, (height - 1) / 2)
    depth = np.tile(np.linspace(500, 1500, width).astype(np.uint16), (height, 1))
    image = np.full((height, width, 3), 90, np.uint8) if color else None
    return RgbdFrame(FIRST_STAMP + index * 33_333_333, depth, 0.001, camera, image)


def cloud(index: int) -> Cloud:
    """Points of four nodes, and every tenth of none."""
    points = np.repeat(helix(index).positions, 4, axis=0)
    node = (np.arange(len(points)) // 50).astype(np.int32)
    node[::10] = -1
    return Cloud(points, node)
