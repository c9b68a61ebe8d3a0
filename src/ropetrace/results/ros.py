"""Results as MCAP with ROS 2 messages, for Foxglove, RViz and ``ros2 bag``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from mcap.writer import Writer
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from ropetrace.errors import OutputError
from ropetrace.results.base import Closing, WholeFile, rope_name, uninterrupted
from ropetrace.types import Cloud, Estimate, Frame, Status

TOPICS = "/ropetrace"
"""What the topics of the first rope begin with; those of another have its name after it."""

PATH = "nav_msgs/msg/Path"
TRAJECTORY = "trajectory_msgs/msg/MultiDOFJointTrajectory"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
CLOUD = "sensor_msgs/msg/PointCloud2"

NANOSECONDS = 1_000_000_000
LAST_STAMP = (1 << 31) * NANOSECONDS - 1
"""The last stamp that a ROS time holds."""


class McapWriter(Closing):
    """A `PATH`, a `TRAJECTORY` and a `DIAGNOSTICS` message for each rope of a frame, and a `CLOUD`.

    The cloud is of the waypoints, with what the tracker tells of each as a field of its own: it begins with the first
    estimate of which the tracker tells something. Each further rope has topics of its own from its first estimate on.
    A lost frame is a path without poses, which clears the curve in a viewer, and a motion that is not known is a
    trajectory without points. The messages are logged at the frame's stamp, among the images that they come from; the
    stamp in the path's, the motion's and the cloud's header is the time for which they hold. Each estimate is a chunk
    of its own, with a checksum, and reaches the system before `write` returns: a process that is killed loses none
    that was written. The metadata are the record ``ropetrace``, `frame_name` among them.

    Raises
    ------
    OutputError
        If the file cannot be created or written, or a time does not fit a ROS time: before 1970, after 2038.
    """

    def __init__(self, path: Path, *, overwrite: bool, frame_name: str, metadata: Mapping[str, str]) -> None:
        self._path = path
        self._frame_id = "camera_color_optical_frame" if frame_name == "camera" else frame_name
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._file = WholeFile(path, overwrite)
        writer: Any = Writer(cast(IO[bytes], _FrameStream(self._file)), enable_data_crcs=True)
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._ropes: dict[int, _Channels] = {}
        self._closed = False
        self._broken = False
        with self._file.closed_on_error():
            self._writer.start(profile="ros2", library="ropetrace")
            self._writer.add_metadata("ropetrace", {**metadata, "frame_name": frame_name})
            self._ropes[0] = self._channels(0)
            self._writer.flush()

    def write(self, index: int, estimate: Estimate, frame: Frame | None = None, cloud: Cloud | None = None) -> None:
        stamp_ns = estimate.stamp_ns
        held_ns = stamp_ns + estimate.ahead_ns
        for name, time_ns in (("stamp", stamp_ns), ("predicted time", held_ns)):
            if not 0 <= time_ns <= LAST_STAMP:
                raise OutputError(f"{self._path}: frame {index}: the {name} {time_ns} ns does not fit a ROS time")
        if estimate.rope not in self._ropes:
            self._ropes[estimate.rope] = self._channels(estimate.rope)
        channels = self._ropes[estimate.rope]
        if channels.waypoints is None and (estimate.seen is not None or estimate.position_sigma is not None):
            channels.waypoints = self._channel(estimate.rope, "waypoints", CLOUD)
        held = self._header(held_ns)
        messages = [
            (channels.centerline, self._path_message(held, estimate), PATH),
            (channels.motion, self._motion_message(held, estimate), TRAJECTORY),
            (channels.status, self._status_message(self._header(stamp_ns), estimate), DIAGNOSTICS),
        ]
        if channels.waypoints is not None:
            messages.append((channels.waypoints, self._cloud_message(held, estimate), CLOUD))
        packed = [(channel, self._store.serialize_cdr(message, name)) for channel, message, name in messages]
        try:
            with uninterrupted():
                for channel, data in packed:
                    self._writer.add_message(channel, stamp_ns, bytes(data), stamp_ns, channels.written)
                channels.written += 1
                self._writer.flush()
        except OutputError:
            self._broken = True
            raise

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        try:
            # The index of a file that lacks a frame would be wrong; without it the frames before can be read.
            if not self._broken:
                with uninterrupted():
                    self._writer.finish()
                    self._writer.flush()
        finally:
            self._file.close()

    def _channels(self, rope: int) -> _Channels:
        return _Channels(
            self._channel(rope, "centerline", PATH),
            self._channel(rope, "motion", TRAJECTORY),
            self._channel(rope, "status", DIAGNOSTICS),
        )

    def _channel(self, rope: int, topic: str, name: str) -> int:
        if name not in self._schemas:
            text, _ = self._store.generate_msgdef(name, ros_version=2)
            self._schemas[name] = self._writer.register_schema(name, "ros2msg", text.encode())
        topic = "/".join((TOPICS, topic) if rope == 0 else (TOPICS, rope_name(rope), topic))
        return int(self._writer.register_channel(topic, "cdr", self._schemas[name], {"offered_qos_profiles": ""}))

    def _header(self, time_ns: int) -> Any:
        types = self._store.types
        time = types["builtin_interfaces/msg/Time"](*divmod(time_ns, NANOSECONDS))
        return types["std_msgs/msg/Header"](time, self._frame_id)

    def _path_message(self, header: Any, estimate: Estimate) -> Any:
        types = self._store.types
        pose_stamped, pose = types["geometry_msgs/msg/PoseStamped"], types["geometry_msgs/msg/Pose"]
        point, quaternion = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Quaternion"]
        rows = np.hstack((estimate.waypoints.positions, estimate.waypoints.quaternions)).tolist()
        return types[PATH](header, [pose_stamped(header, pose(point(*row[:3]), quaternion(*row[3:]))) for row in rows])

    def _motion_message(self, header: Any, estimate: Estimate) -> Any:
        types = self._store.types
        motion, waypoints = estimate.motion, estimate.waypoints
        if motion is None or not len(motion):
            return types[TRAJECTORY](header, [], [])
        vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
        transform, twist = types["geometry_msgs/msg/Transform"], types["geometry_msgs/msg/Twist"]
        still = vector(0.0, 0.0, 0.0)
        point = types["trajectory_msgs/msg/MultiDOFJointTrajectoryPoint"](
            [
                transform(vector(*position), quaternion(*turn))
                for position, turn in zip(waypoints.positions.tolist(), waypoints.quaternions.tolist(), strict=True)
            ],
            [twist(vector(*velocity), still) for velocity in motion.velocities.tolist()],
            [twist(vector(*acceleration), still) for acceleration in motion.accelerations.tolist()],
            types["builtin_interfaces/msg/Duration"](0, 0),
        )
        return types[TRAJECTORY](header, [f"waypoint_{number}" for number in range(len(waypoints))], [point])

    def _cloud_message(self, header: Any, estimate: Estimate) -> Any:
        types = self._store.types
        field = types["sensor_msgs/msg/PointField"]
        columns: list[tuple[str, int, NDArray[Any]]] = [
            (axis, field.FLOAT32, places) for axis, places in zip("xyz", estimate.waypoints.positions.T, strict=True)
        ]
        if estimate.seen is not None:
            columns.append(("seen", field.UINT8, estimate.seen))
        if estimate.position_sigma is not None:
            columns.append(("tracker_sigma", field.FLOAT64, estimate.position_sigma))
        kinds = {field.FLOAT32: "<f4", field.FLOAT64: "<f8", field.UINT8: "u1"}
        rows = np.empty(len(estimate.waypoints), [(name, kinds[kind]) for name, kind, _ in columns])
        for name, _, values in columns:
            rows[name] = values
        layout: Any = rows.dtype.fields
        fields = [field(name, layout[name][1], kind, 1) for name, kind, _ in columns]
        size = rows.dtype.itemsize
        return types[CLOUD](
            header, 1, len(rows), fields, False, size, size * len(rows), rows.view(np.uint8).reshape(-1), True
        )

    def _status_message(self, header: Any, estimate: Estimate) -> Any:
        types = self._store.types
        status, pair = types["diagnostic_msgs/msg/DiagnosticStatus"], types["diagnostic_msgs/msg/KeyValue"]
        level = {Status.OK: status.OK, Status.DEGRADED: status.WARN, Status.LOST: status.ERROR}[estimate.status]
        # A file name in a reason may hold bytes that are no UTF-8.
        message = "; ".join(estimate.reasons).encode(errors="replace").decode() or str(estimate.status)
        values = {
            "status": str(estimate.status),
            "point_count": str(estimate.point_count),
            "nodes": str(len(estimate.nodes)),
            "length": repr(estimate.waypoints.length),
            "ahead": repr(estimate.ahead_ns / NANOSECONDS),
            "rope": str(estimate.rope),
        }
        name = "ropetrace" if estimate.rope == 0 else f"ropetrace: {rope_name(estimate.rope)}"
        return types[DIAGNOSTICS](header, [status(level, name, message, "", [pair(*item) for item in values.items()])])


@dataclass(slots=True)
class _Channels:
    """The topics of one rope, and how many of its estimates were written."""

    centerline: int
    motion: int
    status: int
    waypoints: int | None = None
    written: int = 0


class _FrameStream:
    """What the MCAP writer writes to: keeps it until `flush`, which hands it on whole."""

    def __init__(self, file: WholeFile) -> None:
        self._file = file
        self._pending = bytearray()

    def write(self, data: bytes) -> int:
        self._pending += data
        return len(data)

    def tell(self) -> int:
        return self._file.size + len(self._pending)

    def flush(self) -> None:
        self._file.append(self._pending)
        self._pending.clear()
