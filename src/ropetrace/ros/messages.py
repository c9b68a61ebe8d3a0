"""Paths, motion and joints as ROS 2 messages and back; frames stand in `recordings`, estimates in `results`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ropetrace.errors import FrameError
from ropetrace.recordings.ros_messages import RawMessage, decoded, stamp_and_frame
from ropetrace.results.ros_estimates import NANOSECONDS, make
from ropetrace.results.ros_packed import MOST_WAYPOINTS, unpack_path, unpack_trajectory
from ropetrace.types import FloatArray, Motion, Waypoints

POSES = "geometry_msgs/msg/PoseArray"
JOINTS = "sensor_msgs/msg/JointState"
NUMBERS = "std_msgs/msg/Float64MultiArray"
TIME = "sensor_msgs/msg/TimeReference"


def joint_state(held: Any, names: tuple[str, ...], position: FloatArray | None, velocity: FloatArray | None) -> Any:
    """A sensor_msgs/JointState; rad and rad/s, each left empty where it is None."""
    empty = np.empty(0)
    return make(
        JOINTS,
        held,
        list(names),
        empty if position is None else np.array(position, float),
        empty if velocity is None else np.array(velocity, float),
        empty,
    )


def numbers(values: FloatArray) -> Any:
    """A std_msgs/Float64MultiArray, flat, as the controllers of ros2_control take it."""
    return make(NUMBERS, make("std_msgs/msg/MultiArrayLayout", [], 0), np.array(values, float))


def time_reference(held: Any, image_ns: int) -> Any:
    """A sensor_msgs/TimeReference: the stamp of the newest image behind what the header's stamp names."""
    stamp = make("builtin_interfaces/msg/Time", *divmod(image_ns, NANOSECONDS))
    return make(TIME, held, stamp, "the newest image")


def waypoints(message: RawMessage) -> Waypoints:
    """The waypoints of a nav_msgs/Path; none where it has no poses. Their arc length is that of their polyline.

    Raises
    ------
    FrameError
        If it is damaged, has one pose only, too many, or one that is not finite.
    """
    poses = unpack_path(message.data) if message.encoding == "cdr" else None
    if poses is None:
        body = [stamped.pose for stamped in decoded(message).poses]
        poses = _rows((p.position, p.orientation) for p in body)
    return _waypoints(message.topic, poses)


def moving_waypoints(message: RawMessage) -> tuple[Waypoints, Motion] | None:
    """The waypoints of a trajectory_msgs/MultiDOFJointTrajectory and how they move; None where that is not known.

    The message says nothing of standard deviations: they are NaN.

    Raises
    ------
    FrameError
        If it is damaged or not as `results.ros_packed.pack_trajectory` makes it.
    """
    known = unpack_trajectory(message.data) if message.encoding == "cdr" else None
    if known is None:
        body = decoded(message)
        if not body.points:
            return None
        point = body.points[0]
        velocities, accelerations = (
            np.array([(t.linear.x, t.linear.y, t.linear.z) for t in twists], float).reshape(-1, 3)
            for twists in (point.velocities, point.accelerations)
        )
        known = _rows((t.translation, t.rotation) for t in point.transforms), velocities, accelerations
    poses, velocities, accelerations = known
    if not len(poses):
        return None
    if not len(poses) == len(velocities) == len(accelerations):
        raise FrameError(
            f"{message.topic}: {len(poses)} poses, {len(velocities)} velocities and {len(accelerations)} "
            "accelerations do not fit"
        )
    found = _waypoints(message.topic, poses)
    if not (np.isfinite(velocities).all() and np.isfinite(accelerations).all()):
        raise FrameError(f"{message.topic}: a velocity or an acceleration is not finite")
    unknown = np.full(velocities.shape, np.nan)
    return found, Motion(velocities, accelerations, unknown, unknown, unknown)


@dataclass(frozen=True, slots=True, eq=False)
class JointReading:
    """Where joints were.

    Parameters
    ----------
    stamp_ns : int
        When, nanoseconds since 1970.
    position : (n,) float array
        rad.
    """

    stamp_ns: int
    position: FloatArray


def joint_reading(message: RawMessage, names: tuple[str, ...]) -> JointReading:
    """The named joints of a sensor_msgs/JointState; of its arrival if it has no stamp.

    Raises
    ------
    FrameError
        If it is damaged, a joint is missing, or a position is not finite.
    """
    position = _of_joints(message.topic, decoded(message), names, "position")
    return JointReading(stamp_and_frame(message)[0] or message.log_time_ns, position)


def joint_values(message: RawMessage, names: tuple[str, ...], of: str) -> FloatArray:
    """The named joints' values in a sensor_msgs/JointState, in the order of `names`.

    Parameters
    ----------
    message : RawMessage
        Other joints may be in it.
    names : tuple of str
        n joints.
    of : str
        ``position`` or ``velocity``.

    Raises
    ------
    FrameError
        If it is damaged, a joint is missing, or a value is not finite.
    """
    return _of_joints(message.topic, decoded(message), names, of)


def _of_joints(topic: str, body: Any, names: tuple[str, ...], of: str) -> FloatArray:
    values = np.asarray(getattr(body, of), float)
    if len(values) != len(body.name):
        raise FrameError(f"{topic}: {len(body.name)} joints, but {len(values)} of {of}")
    places = {name: place for place, name in enumerate(body.name)}
    missing = [name for name in names if name not in places]
    if missing:
        raise FrameError(f"{topic}: the joint {missing[0]} is not in it: {', '.join(body.name[:16])}")
    found = values[[places[name] for name in names]]
    if not np.isfinite(found).all():
        raise FrameError(f"{topic}: the {of} of a joint is not finite")
    return found


def _rows(poses: Iterable[tuple[Any, Any]]) -> FloatArray:
    """Positions and quaternions, (W, 7)."""
    rows = [(at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w) for at, turn in poses]
    return np.array(rows, float).reshape(-1, 7)


def _waypoints(topic: str, poses: FloatArray) -> Waypoints:
    if not len(poses):
        return Waypoints.none()
    if not 2 <= len(poses) <= MOST_WAYPOINTS:
        raise FrameError(f"{topic}: {len(poses)} poses: expected none, or 2 to {MOST_WAYPOINTS}")
    if not np.isfinite(poses).all():
        raise FrameError(f"{topic}: a pose is not finite")
    places = np.ascontiguousarray(poses[:, :3])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    return Waypoints(places, np.ascontiguousarray(poses[:, 3:]), np.concatenate(([0.0], np.cumsum(steps))))
