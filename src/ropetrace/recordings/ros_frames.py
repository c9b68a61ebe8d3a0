"""Frames as the ROS 2 messages that ROS tools and Foxglove read, losslessly."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ropetrace.errors import FrameError
from ropetrace.recordings.ros_messages import CAMERA, CLOUD, IMAGE, RawMessage
from ropetrace.results.ros_estimates import LAST_STAMP, header, make, typestore
from ropetrace.types import CloudFrame, Frame, Intrinsics

DEPTH_TOPIC = "/camera/aligned_depth_to_color/image_raw"
COLOR_TOPIC = "/camera/color/image_raw"
CLOUD_TOPIC = "/camera/depth/color/points"
FRAME_ID = "camera_color_optical_frame"


def frame_messages(frame: Frame) -> list[RawMessage]:
    """The messages of a frame, logged at its stamp.

    Depth is ``16UC1`` where it is uint16 millimetres and ``32FC1``, float32 metres, otherwise: ROS has no other unit.
    Colour is ``rgb8``, both with their ``camera_info``. A cloud is a PointCloud2 of float32 or float64, as it is.

    Raises
    ------
    FrameError
        If the stamp does not fit a ROS time: before 1970, after 2038.
    """
    if not 0 <= frame.stamp_ns <= LAST_STAMP:
        raise FrameError("the stamp does not fit a ROS time: before 1970, or after 2038")
    held = header(frame.stamp_ns, FRAME_ID)
    if isinstance(frame, CloudFrame):
        return [_packed(CLOUD_TOPIC, CLOUD, frame.stamp_ns, _cloud(held, frame))]
    depth, encoding = _depth(frame.depth, frame.depth_unit_m)
    parts = [(DEPTH_TOPIC, depth, encoding)]
    if frame.color is not None:
        parts.insert(0, (COLOR_TOPIC, frame.color, "rgb8"))
    camera = _camera(held, frame.intrinsics)
    messages = []
    for topic, pixels, name in parts:
        # The camera first: a reader that meets the image knows how to use it.
        messages.append(_packed(topic.rsplit("/", 1)[0] + "/camera_info", CAMERA, frame.stamp_ns, camera))
        messages.append(_packed(topic, IMAGE, frame.stamp_ns, _image(held, pixels, name)))
    return messages


def _packed(topic: str, kind: str, stamp_ns: int, message: Any) -> RawMessage:
    return RawMessage(topic, kind, "cdr", stamp_ns, typestore().serialize_cdr(message, kind, little_endian=True))


def _depth(depth: NDArray[Any], unit_m: float) -> tuple[NDArray[Any], str]:
    """Depth in a unit that ROS has, and its encoding."""
    if depth.dtype == np.uint16 and unit_m == 0.001:
        return depth, "16UC1"
    if depth.dtype == np.float32 and unit_m == 1:
        return depth, "32FC1"
    return (depth.astype(np.float64) * unit_m).astype(np.float32), "32FC1"


def _little_endian(values: NDArray[Any]) -> NDArray[np.uint8]:
    """The bytes of an array."""
    stored = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    return stored.reshape(-1).view(np.uint8)


def _image(held: Any, pixels: NDArray[Any], encoding: str) -> Any:
    data = _little_endian(pixels)
    height, width = pixels.shape[:2]
    return make(IMAGE, held, height, width, encoding, 0, len(data) // height, data)


def _camera(held: Any, camera: Intrinsics) -> Any:
    k = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1], float)
    p = np.insert(k, (3, 6, 9), 0.0)
    region = make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    return make(
        CAMERA, held, camera.height, camera.width, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), p, 0, 0, region
    )


def _cloud(held: Any, frame: CloudFrame) -> Any:
    field = typestore().types["sensor_msgs/msg/PointField"]
    number, kind = (field.FLOAT32, "<f4") if frame.points.dtype.itemsize <= 4 else (field.FLOAT64, "<f8")
    layout = [(axis, kind) for axis in "xyz"] + ([] if frame.colors is None else [("rgb", "<u4")])
    rows = np.empty(len(frame.points), layout)
    for axis, values in zip("xyz", frame.points.T, strict=True):
        rows[axis] = values
    size = np.dtype(kind).itemsize
    fields = [field(axis, size * place, number, 1) for place, axis in enumerate("xyz")]
    if frame.colors is not None:
        red, green, blue = frame.colors.T.astype(np.uint32)
        rows["rgb"] = red << 16 | green << 8 | blue
        fields.append(field("rgb", 3 * size, field.UINT32, 1))
    step = rows.dtype.itemsize
    data = rows.view(np.uint8).reshape(-1)
    return make(CLOUD, held, 1, len(rows), fields, False, step, step * len(rows), data, False)
