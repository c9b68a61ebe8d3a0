"""Paths, poses and trajectories made pose by pose with rosbags: what `results.ros_packed` must equal."""

from __future__ import annotations

from typing import Any

import numpy as np

from ropetrace.results.ros_estimates import PATH, TRAJECTORY, make
from ropetrace.types import FloatArray, Motion, Waypoints


def pose(position: list[float], quaternion: list[float]) -> Any:
    """A geometry_msgs/Pose from metres and ``xyzw``."""
    return make(
        "geometry_msgs/msg/Pose",
        make("geometry_msgs/msg/Point", *position),
        make("geometry_msgs/msg/Quaternion", *quaternion),
    )


def path(held: Any, waypoints: Waypoints) -> Any:
    """A nav_msgs/Path of the waypoints; without poses where there are none."""
    return make(
        PATH,
        held,
        [make("geometry_msgs/msg/PoseStamped", held, pose(row[:3], row[3:])) for row in _pose_rows(waypoints)],
    )


def pose_array(held: Any, waypoints: Waypoints) -> Any:
    """A geometry_msgs/PoseArray of the waypoints."""
    return make("geometry_msgs/msg/PoseArray", held, [pose(row[:3], row[3:]) for row in _pose_rows(waypoints)])


def _pose_rows(waypoints: Waypoints) -> list[list[float]]:
    rows: list[list[float]] = np.hstack((waypoints.positions, waypoints.quaternions)).tolist()
    return rows


def trajectory(held: Any, waypoints: Waypoints, motion: Motion | None) -> Any:
    """A trajectory_msgs/MultiDOFJointTrajectory: one point of poses, velocities and accelerations, a joint a waypoint.

    Where the motion is not known there is no joint and no point.
    """
    if motion is None or not len(motion):
        return make(TRAJECTORY, held, [], [])

    def vector(row: list[float]) -> Any:
        return make("geometry_msgs/msg/Vector3", *row)

    def twists(rows: FloatArray) -> list[Any]:
        still = vector([0.0, 0.0, 0.0])
        return [make("geometry_msgs/msg/Twist", vector(row), still) for row in rows.tolist()]

    point = make(
        "trajectory_msgs/msg/MultiDOFJointTrajectoryPoint",
        [
            make("geometry_msgs/msg/Transform", vector(row[:3]), make("geometry_msgs/msg/Quaternion", *row[3:]))
            for row in _pose_rows(waypoints)
        ],
        twists(motion.velocities),
        twists(motion.accelerations),
        make("builtin_interfaces/msg/Duration", 0, 0),
    )
    return make(TRAJECTORY, held, [f"waypoint_{number}" for number in range(len(waypoints))], [point])
