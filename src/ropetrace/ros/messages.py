"""Paths, motion and joints as ROS 2 messages and back; frames stand in `recordings`, estimates in `results`."""

from __future__ import annotations

from typing import Any

import numpy as np

from ropetrace.errors import FrameError
from ropetrace.recordings.ros_messages import RawMessage, decoded
from ropetrace.results.ros_estimates import NANOSECONDS, make
from ropetrace.types import FloatArray, Motion, Waypoints

POSES = "geometry_msgs/msg/PoseArray"
JOINTS = "sensor_msgs/msg/JointState"
NUMBERS = "std_msgs/msg/Float64MultiArray"
TIME = "sensor_msgs/msg/TimeReference"

MOST_WAYPOINTS = 100_000
"""That are taken from a message: a rope of a kilometre."""


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
    poses = [stamped.pose for stamped in decoded(message).poses]
    return _waypoints(
        message.topic,
        [(p.position.x, p.position.y, p.position.z) for p in poses],
        [(p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w) for p in poses],
    )


def moving_waypoints(message: RawMessage) -> tuple[Waypoints, Motion] | None:
    """The waypoints of a trajectory_msgs/MultiDOFJointTrajectory and how they move; None where that is not known.

    The message says nothing of standard deviations: they are NaN.

    Raises
    ------
    FrameError
        If it is damaged or not as `results.ros_estimates.trajectory` makes it.
    """
    body = decoded(message)
    if not body.points:
        return None
    point = body.points[0]
    places = [(t.translation.x, t.translation.y, t.translation.z) for t in point.transforms]
    turns = [(t.rotation.x, t.rotation.y, t.rotation.z, t.rotation.w) for t in point.transforms]
    found = _waypoints(message.topic, places, turns)
    velocities = np.array([(t.linear.x, t.linear.y, t.linear.z) for t in point.velocities]).reshape(-1, 3)
    accelerations = np.array([(t.linear.x, t.linear.y, t.linear.z) for t in point.accelerations]).reshape(-1, 3)
    if not len(found) == len(velocities) == len(accelerations):
        raise FrameError(
            f"{message.topic}: {len(found)} poses, {len(velocities)} velocities and {len(accelerations)} "
            "accelerations do not fit"
        )
    if not (np.isfinite(velocities).all() and np.isfinite(accelerations).all()):
        raise FrameError(f"{message.topic}: a velocity or an acceleration is not finite")
    unknown = np.full(velocities.shape, np.nan)
    return found, Motion(velocities, accelerations, unknown, unknown, unknown)


def has_velocities(message: RawMessage) -> bool:
    """Whether a sensor_msgs/JointState tells velocities: they may be left out.

    Raises
    ------
    FrameError
        If it is damaged.
    """
    return len(decoded(message).velocity) > 0


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
    body = decoded(message)
    values = np.asarray(getattr(body, of), float)
    if len(values) != len(body.name):
        raise FrameError(f"{message.topic}: {len(body.name)} joints, but {len(values)} of {of}")
    places = {name: place for place, name in enumerate(body.name)}
    missing = [name for name in names if name not in places]
    if missing:
        raise FrameError(f"{message.topic}: the joint {missing[0]} is not in it: {', '.join(body.name[:16])}")
    found = values[[places[name] for name in names]]
    if not np.isfinite(found).all():
        raise FrameError(f"{message.topic}: the {of} of a joint is not finite")
    return found


def _waypoints(topic: str, positions: list[Any], quaternions: list[Any]) -> Waypoints:
    if not positions:
        return Waypoints.none()
    places, turns = np.array(positions, float), np.array(quaternions, float)
    if not 2 <= len(places) <= MOST_WAYPOINTS:
        raise FrameError(f"{topic}: {len(places)} poses: expected none, or 2 to {MOST_WAYPOINTS}")
    if not (np.isfinite(places).all() and np.isfinite(turns).all()):
        raise FrameError(f"{topic}: a pose is not finite")
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    return Waypoints(places, turns, np.concatenate(([0.0], np.cumsum(steps))))
