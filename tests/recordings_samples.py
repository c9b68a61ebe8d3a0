"""Small recordings of every kind, and what is in them, for the tests of the readers."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter

from ropetrace.recordings.base import Recording
from ropetrace.recordings.ros_messages import CAMERA, CLOUD, COMPRESSED, IMAGE, typestore
from ropetrace.types import BadFrame, CloudFrame, Event, Intrinsics, RgbdFrame

CAMERA_8X6 = Intrinsics(8, 6, 9.5, 9.25, 3.5, 2.75)
STEP_NS = 33_333_333
DEPTH, COLOR, INFO = "/camera/depth/image_raw", "/camera/color/image_raw", "/camera/depth/camera_info"

Sample = tuple[str, str, int, Any]
"""Topic, message type, time of recording and message."""


def make_frames(count: int, kind: type = np.uint16, color: bool = True, start_ns: int = 10**18) -> list[RgbdFrame]:
    """Frames of noise, 8x6 pixels, 30 Hz."""
    random = np.random.default_rng(7)
    frames = []
    for i in range(count):
        depth = random.integers(0, 65536, (6, 8)).astype(np.uint16)
        if kind is np.float32:
            depth = (depth / 1000).astype(np.float32)
        pixels = random.integers(0, 256, (6, 8, 3)).astype(np.uint8) if color else None
        unit = 0.001 if kind is np.uint16 else 1.0
        frames.append(RgbdFrame(start_ns + i * STEP_NS, depth, unit, CAMERA_8X6, pixels))
    return frames


def contents(events: Iterable[Event]) -> list[Any]:
    """What can be compared: all data of the good frames, the reason of the bad ones."""
    rows: list[Any] = []
    for event in events:
        if isinstance(event, RgbdFrame):
            color = None if event.color is None else event.color.tobytes()
            data = (str(event.depth.dtype), event.depth.shape, event.depth.tobytes(), color)
            rows.append((event.stamp_ns, *data, event.depth_unit_m, event.intrinsics))
        elif isinstance(event, CloudFrame):
            colors = None if event.colors is None else event.colors.tobytes()
            rows.append((event.stamp_ns, str(event.points.dtype), event.points.tobytes(), colors))
        else:
            rows.append(event.reason)
    return rows


def reasons(recording: Recording) -> list[str]:
    """Why the bad frames are bad."""
    return [event.reason for event in recording.frames() if isinstance(event, BadFrame)]


def write_camera(path: Path, **changes: object) -> None:
    """The camera of the samples as JSON; a change to None leaves a key out."""
    camera = CAMERA_8X6
    table = {"width": 8, "height": 6, "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    table = {**table, "depth_unit_m": 0.001, **changes}  # type: ignore[dict-item]
    path.write_text(json.dumps({key: value for key, value in table.items() if value is not None}))


class Messages:
    """Makes ROS messages of one ROS version."""

    def __init__(self, encoding: str = "cdr") -> None:
        self.encoding = encoding
        self.store = typestore(encoding)
        self.types = self.store.types

    def header(self, stamp_ns: int, frame: str = "camera") -> Any:
        time = self.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        first = {"seq": 0} if self.encoding == "ros1" else {}
        return self.types["std_msgs/msg/Header"](**first, stamp=time, frame_id=frame)

    def image(self, stamp_ns: int, pixels: Any, encoding: str, padding: int = 0, **changes: Any) -> Any:
        height, width = pixels.shape[:2]
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=99)
        values = {
            "header": self.header(stamp_ns),
            "height": height,
            "width": width,
            "encoding": encoding,
            "is_bigendian": int(pixels.dtype.byteorder == ">"),
            "step": rows.shape[1],
            "data": rows.reshape(-1),
        }
        return self.types[IMAGE](**(values | changes))

    def compressed(self, stamp_ns: int, data: bytes, declared: str) -> Any:
        body = np.frombuffer(data, np.uint8)
        return self.types[COMPRESSED](header=self.header(stamp_ns), format=declared, data=body)

    def camera(self, stamp_ns: int, width: int = 8, height: int = 6, fx: float = CAMERA_8X6.fx) -> Any:
        k = np.array([fx, 0, CAMERA_8X6.cx, 0, CAMERA_8X6.fy, CAMERA_8X6.cy, 0, 0, 1], float)
        names = ("D", "K", "R", "P") if self.encoding == "ros1" else ("d", "k", "r", "p")
        matrices = dict(zip(names, (np.zeros(5), k, np.eye(3).reshape(-1), np.zeros(12)), strict=True))
        region = self.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        return self.types[CAMERA](
            header=self.header(stamp_ns),
            height=height,
            width=width,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=region,
            **matrices,
        )

    def cloud(self, stamp_ns: int, table: Any, height: int = 1, padding: int = 0, **changes: Any) -> Any:
        """A cloud from a structured array."""
        numbers = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
        field = self.types["sensor_msgs/msg/PointField"]
        fields = [
            field(name=name, offset=int(offset), datatype=numbers[kind.str[1:]], count=1)
            for name, (kind, offset) in table.dtype.fields.items()
        ]
        rows = table.view(np.uint8).reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        values = {
            "header": self.header(stamp_ns),
            "height": height,
            "width": len(table) // height,
            "fields": fields,
            "is_bigendian": any(kind.byteorder == ">" for kind, *_ in table.dtype.fields.values()),
            "point_step": table.dtype.itemsize,
            "row_step": rows.shape[1],
            "data": rows.reshape(-1),
            "is_dense": False,
        }
        return self.types[CLOUD](**(values | changes))

    def serialized(self, message: Any) -> bytes:
        kind = message.__msgtype__
        ros1 = self.encoding == "ros1"
        return bytes(self.store.serialize_ros1(message, kind) if ros1 else self.store.serialize_cdr(message, kind))


def rgbd_messages(make: Messages, frames: Iterable[RgbdFrame]) -> list[Sample]:
    """Camera, colour and depth messages of frames."""
    rows: list[Sample] = []
    for frame in frames:
        stamp = frame.stamp_ns
        encoding = "16UC1" if frame.depth.dtype == np.uint16 else "32FC1"
        rows.append((INFO, CAMERA, stamp, make.camera(stamp)))
        if frame.color is not None:
            rows.append((COLOR, IMAGE, stamp, make.image(stamp, frame.color, "rgb8")))
        rows.append((DEPTH, IMAGE, stamp, make.image(stamp, frame.depth, encoding)))
    return rows


def write_mcap(path: Path, rows: Iterable[Sample], encoding: str = "cdr", **options: Any) -> Path:
    """An MCAP file; `options` go to the library's writer."""
    make = Messages(encoding)
    options = {"compression": CompressionType.ZSTD, "enable_data_crcs": True, **options}
    with path.open("wb") as stream:
        writer: Any = McapWriter(stream, **options)
        writer.start(profile="ros2")
        channels: dict[str, int] = {}
        for topic, kind, time, message in rows:
            if topic not in channels:
                schema = writer.register_schema(kind, "ros2msg", b"")
                channels[topic] = writer.register_channel(topic, encoding, schema)
            data = message if isinstance(message, bytes) else make.serialized(message)
            writer.add_message(channels[topic], time, data, time)
        writer.finish()
    return path


def write_bag(path: Path, rows: Iterable[Sample], compression: str = "none", chunk_bytes: int = 2000) -> Path:
    """A ROS 1 bag."""
    make = Messages("ros1")
    writer = BagWriter(path)
    writer.chunk_threshold = chunk_bytes
    if compression != "none":
        writer.set_compression(getattr(BagWriter.CompressionFormat, compression.upper()))
    with writer:
        connections: dict[str, Any] = {}
        for topic, kind, time, message in rows:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=make.store)
            writer.write(connections[topic], time, make.serialized(message))
    return path


def write_rosbag2(path: Path, rows: Iterable[Sample], plugin: str = "SQLITE3") -> Path:
    """A rosbag2 folder."""
    make = Messages("cdr")
    with FolderWriter(path, version=9, storage_plugin=StoragePlugin[plugin]) as writer:
        connections: dict[str, Any] = {}
        for topic, kind, time, message in rows:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=make.store)
            writer.write(connections[topic], time, make.serialized(message))
    return path


def mutated(data: bytes, random: np.random.Generator) -> bytes:
    """The data with a few random changes: bits, bytes, runs of zeros, cuts and insertions."""
    changed = bytearray(data)
    for _ in range(int(random.integers(1, 6))):
        if not changed:
            break
        at = int(random.integers(len(changed)))
        kind = random.integers(6)
        if kind == 0:
            changed[at] ^= 1 << int(random.integers(8))
        elif kind == 1:
            changed[at] = int(random.choice([0, 1, 127, 128, 255]))
        elif kind == 2:
            changed[at : at + 8] = random.bytes(8)
        elif kind == 3:
            del changed[at : at + int(random.integers(1, 64))]
        elif kind == 4:
            changed[at:at] = random.bytes(int(random.integers(1, 16)))
        elif random.random() < 0.3:
            del changed[at:]
    return bytes(changed)
