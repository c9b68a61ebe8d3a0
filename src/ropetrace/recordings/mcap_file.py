"""Writes frames to MCAP as the ROS 2 messages that ROS tools and Foxglove read."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from ropetrace.errors import OutputError
from ropetrace.recordings.ros_messages import CAMERA, IMAGE, typestore
from ropetrace.types import Intrinsics, RgbdFrame

DEPTH_TOPIC = "/camera/aligned_depth_to_color/image_raw"
COLOR_TOPIC = "/camera/color/image_raw"
FRAME_ID = "camera_color_optical_frame"

# What a killed process loses is the chunk that was not full yet; a larger frame is a chunk of its own.
_CHUNK_BYTES = 64 * 1024


class McapFrameWriter:
    """Writes frames into a new MCAP file, losslessly; what was written before a crash stays readable.

    Every chunk has a CRC, and so has the file. Depth goes to ``/camera/aligned_depth_to_color/image_raw`` as
    16UC1 (uint16 millimetres) or 32FC1 (float32 metres), colour to ``/camera/color/image_raw`` as rgb8, each
    with its ``camera_info``.

    Parameters
    ----------
    path : path
        The file; must not exist.
    intrinsics : Intrinsics
        The camera.
    depth_unit_m : float
        Metres in one unit of depth: ROS has 0.001 for uint16 and 1 for float32, and no other.

    Raises
    ------
    OutputError
        If the file exists or cannot be made, or the unit is none of the two.
    """

    def __init__(self, path: str | Path, intrinsics: Intrinsics, depth_unit_m: float) -> None:
        self.path = Path(path)
        self.intrinsics = intrinsics
        self.depth_unit_m = depth_unit_m
        kinds: dict[float, tuple[Any, str]] = {0.001: (np.uint16, "16UC1"), 1.0: (np.float32, "32FC1")}
        if depth_unit_m not in kinds:
            raise OutputError(
                f"{self.path}: depth_unit_m = {depth_unit_m}: ROS images hold uint16 millimetres (0.001) "
                "or float32 metres (1); convert depth to metres, or write an RGB-D folder"
            )
        self._depth_type, self._encoding = kinds[depth_unit_m]
        self._messages = typestore("cdr")
        self._closed = False
        try:
            self._stream = open(self.path, "xb")  # noqa: SIM115 (closed by close())
        except FileExistsError:
            raise OutputError(f"{self.path}: the file exists; name a new one") from None
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {error.strerror}") from None
        # Any: parts of the library are not typed.
        self._writer: Any = Writer(
            self._stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True
        )
        self._writer.start(profile="ros2")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def write(self, frame: RgbdFrame) -> None:
        """Add a frame.

        Raises
        ------
        OutputError
            If the frame's camera, unit or type of depth is not the file's, its stamp does not fit a ROS
            header, or the disk refuses.
        """
        if frame.intrinsics != self.intrinsics or frame.depth_unit_m != self.depth_unit_m:
            raise OutputError(f"{self.path}: the frame's camera or depth unit is not the recording's")
        if frame.depth.dtype != self._depth_type:
            raise OutputError(
                f"{self.path}: depth is {frame.depth.dtype}; with depth_unit_m = {self.depth_unit_m} "
                f"ROS images hold {np.dtype(self._depth_type)}"
            )
        if not 0 <= frame.stamp_ns < 2**31 * 10**9:
            raise OutputError(f"{self.path}: the stamp {frame.stamp_ns} ns does not fit a ROS header")
        header = self._header(frame.stamp_ns)
        try:
            if frame.color is not None:
                self._write_image(COLOR_TOPIC, header, frame.stamp_ns, frame.color, "rgb8")
            self._write_image(DEPTH_TOPIC, header, frame.stamp_ns, frame.depth, self._encoding)
            self._stream.flush()
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {error.strerror}") from None

    def _header(self, stamp_ns: int) -> Any:
        types = self._messages.types
        stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=FRAME_ID)

    def _write_image(self, topic: str, header: Any, stamp_ns: int, pixels: NDArray[Any], encoding: str) -> None:
        stored = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("<"))
        image = self._messages.types[IMAGE](
            header=header,
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=stored.nbytes // pixels.shape[0],
            data=stored.view(np.uint8).reshape(-1),
        )
        # The camera first: a reader that meets the image knows how to use it.
        self._add(topic.rsplit("/", 1)[0] + "/camera_info", CAMERA, stamp_ns, self._camera(header))
        self._add(topic, IMAGE, stamp_ns, image)

    def _camera(self, header: Any) -> Any:
        camera = self.intrinsics
        types = self._messages.types
        region = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        k = [camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1]
        p = [camera.fx, 0, camera.cx, 0, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0]
        return types[CAMERA](
            header=header,
            height=camera.height,
            width=camera.width,
            distortion_model="plumb_bob",
            d=np.zeros(5),
            k=np.array(k, dtype=float),
            r=np.eye(3).reshape(-1),
            p=np.array(p, dtype=float),
            binning_x=0,
            binning_y=0,
            roi=region,
        )

    def _add(self, topic: str, kind: str, stamp_ns: int, message: Any) -> None:
        if kind not in self._schemas:
            text, _ = self._messages.generate_msgdef(kind, ros_version=2)
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", text.encode())
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[kind])
        data = self._messages.serialize_cdr(message, kind, little_endian=True)
        self._writer.add_message(self._channels[topic], stamp_ns, bytes(data), stamp_ns)

    def close(self) -> None:
        """Write the index and close the file; may be called again.

        Raises
        ------
        OutputError
            If the disk refuses.
        """
        if self._closed:
            return
        self._closed = True
        try:
            with self._stream:
                self._writer.finish()
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {error.strerror}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
