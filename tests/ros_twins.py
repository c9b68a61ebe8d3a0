"""Messages made one by one with rosbags: what `results.ros_packed` must equal, and what other readers must read."""

from __future__ import annotations

from typing import Any

import numpy as np

from ropetrace.recordings.ros_frames import frame_messages
from ropetrace.results.ros_estimates import DIAGNOSTICS, PATH, TRAJECTORY, diagnostics, header, make, typestore
from ropetrace.ros import messages
from ropetrace.ros.messages import JOINTS, NUMBERS, POSES, TIME
from ropetrace.types import CloudFrame, FloatArray, Frame, Intrinsics, Motion, RgbdFrame, Status, Waypoints

STAMP = 1_700_000_000_123_456_789
ROWS = np.arange(15.0).reshape(5, 3)
WAYPOINTS = Waypoints(ROWS, np.tile([0.1, 0.2, 0.3, 0.9], (5, 1)), np.arange(5.0))


def published() -> list[tuple[str, bytes]]:
    """A message in CDR of every type that the nodes publish or record, also with lists that are empty."""
    held = header(STAMP, "camera")
    lens = Intrinsics(4, 3, 5.0, 6.0, 1.5, 1.0)
    color = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)
    frames: list[Frame] = [
        RgbdFrame(STAMP, np.arange(12, dtype=np.uint16).reshape(3, 4), 0.001, lens, color),
        CloudFrame(STAMP, np.arange(6, dtype=np.float32).reshape(2, 3), color[0, :2]),
    ]
    motion = Motion(ROWS + 1, ROWS + 2, ROWS, ROWS, ROWS)
    made = [
        (PATH, path(held, WAYPOINTS)),
        (PATH, path(held, Waypoints.none())),
        (POSES, pose_array(held, WAYPOINTS)),
        (TRAJECTORY, trajectory(held, WAYPOINTS, motion)),
        (TRAJECTORY, trajectory(held, WAYPOINTS, None)),
        *((DIAGNOSTICS, diagnostics(held, "näme", status, "why", {"a": "b", "": ""})) for status in Status),
        (DIAGNOSTICS, diagnostics(held, "name", Status.OK, "", {})),
        (JOINTS, messages.joint_state(held, ("a", "bcd"), np.array([1.0, 2.0]), None)),
        (JOINTS, messages.joint_state(held, ("a",), None, np.array([-3.5]))),
        (NUMBERS, messages.numbers(np.array([1.0, -2.0, 3.0]))),
        (NUMBERS, messages.numbers(np.empty(0))),
        (TIME, messages.time_reference(held, 1_600_000_000_000_000_007)),
    ]
    images = [(message.type, bytes(message.data)) for frame in frames for message in frame_messages(frame)]
    return [*images, *((name, bytes(typestore().serialize_cdr(message, name))) for name, message in made)]


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
