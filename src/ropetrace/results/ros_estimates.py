"""An estimate as ROS 2 messages: what a file of results and a live topic share."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from ropetrace.results.base import rope_name
from ropetrace.types import Estimate, Status

TOPICS = "/ropetrace"
"""What the topics of the first rope begin with; those of another have its name after it."""

PATH = "nav_msgs/msg/Path"
TRAJECTORY = "trajectory_msgs/msg/MultiDOFJointTrajectory"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
CLOUD = "sensor_msgs/msg/PointCloud2"

NANOSECONDS = 1_000_000_000
LAST_STAMP = (1 << 31) * NANOSECONDS - 1
"""The last stamp that a ROS time holds."""


@cache
def typestore() -> Any:
    """The message definitions that are written: those of Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


def make(name: str, *values: Any) -> Any:
    """A message of a type, with its fields in order."""
    return typestore().types[name](*values)


def topic_of(rope: int, topic: str) -> str:
    """The full name of a rope's topic."""
    return "/".join((TOPICS, topic) if rope == 0 else (TOPICS, rope_name(rope), topic))


def header(stamp_ns: int, frame_id: str) -> Any:
    """A std_msgs/Header; the stamp is 0 to `LAST_STAMP` nanoseconds."""
    return make("std_msgs/msg/Header", make("builtin_interfaces/msg/Time", *divmod(stamp_ns, NANOSECONDS)), frame_id)


def waypoint_cloud(held: Any, estimate: Estimate) -> Any:
    """A sensor_msgs/PointCloud2 of the waypoints, with what the tracker tells of each as a field of its own."""
    x, y, z = estimate.waypoints.positions.T
    columns: dict[str, NDArray[Any]] = {name: axis.astype("<f4") for name, axis in (("x", x), ("y", y), ("z", z))}
    if estimate.seen is not None:
        columns["seen"] = estimate.seen.astype("u1")
    if estimate.position_sigma is not None:
        columns["tracker_sigma"] = estimate.position_sigma.astype("<f8")
    return point_cloud(held, columns)


def point_cloud(held: Any, columns: Mapping[str, NDArray[Any]]) -> Any:
    """A sensor_msgs/PointCloud2 of named columns of ``<f4``, ``<f8`` or ``u1``, all of one length."""
    field = typestore().types["sensor_msgs/msg/PointField"]
    kinds = {np.dtype("<f4"): field.FLOAT32, np.dtype("<f8"): field.FLOAT64, np.dtype("u1"): field.UINT8}
    rows = np.empty(len(next(iter(columns.values()))), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    layout: Any = rows.dtype.fields
    fields = [field(name, layout[name][1], kinds[column.dtype], 1) for name, column in columns.items()]
    size = rows.dtype.itemsize
    return make(CLOUD, held, 1, len(rows), fields, False, size, size * len(rows), rows.view(np.uint8).reshape(-1), True)


def estimate_status(held: Any, estimate: Estimate) -> Any:
    """A diagnostic_msgs/DiagnosticArray of an estimate's status, its reasons and its sizes."""
    values = {
        "status": str(estimate.status),
        "point_count": str(estimate.point_count),
        "nodes": str(len(estimate.nodes)),
        "length": repr(estimate.waypoints.length),
        "ahead": repr(estimate.ahead_ns / NANOSECONDS),
        "rope": str(estimate.rope),
    }
    name = "ropetrace" if estimate.rope == 0 else f"ropetrace: {rope_name(estimate.rope)}"
    return diagnostics(held, name, estimate.status, "; ".join(estimate.reasons) or str(estimate.status), values)


def diagnostics(held: Any, name: str, status: Status, text: str, values: Mapping[str, str]) -> Any:
    """A diagnostic_msgs/DiagnosticArray with one entry."""
    entry, pair = typestore().types["diagnostic_msgs/msg/DiagnosticStatus"], "diagnostic_msgs/msg/KeyValue"
    level = {Status.OK: entry.OK, Status.DEGRADED: entry.WARN, Status.LOST: entry.ERROR}[status]
    # A file name in a reason may hold bytes that are no UTF-8.
    message = text.encode(errors="replace").decode()
    return make(DIAGNOSTICS, held, [entry(level, name, message, "", [make(pair, *item) for item in values.items()])])
