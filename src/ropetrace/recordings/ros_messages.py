"""ROS messages, of ROS 1 and 2, as arrays: images, compressed images, cameras and point clouds."""

from __future__ import annotations

import math
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from ropetrace.errors import FrameError
from ropetrace.recordings import images
from ropetrace.recordings.base import one_line
from ropetrace.results.ros_estimates import LAST_STAMP, NANOSECONDS
from ropetrace.types import MAX_IMAGE_PIXELS, Intrinsics

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA = "sensor_msgs/msg/CameraInfo"
CLOUD = "sensor_msgs/msg/PointCloud2"

DEPTH_ENCODINGS = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}
COLOR_ENCODINGS = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2), "bgra8": (2, 1, 0)}
"""The places of red, green and blue in a pixel."""

MAX_MESSAGE_BYTES = 512 * 2**20
"""The largest message, chunk or record that is read into memory, bytes."""

# PointField's numbers of types.
_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a recording: its message type as ROS 2 writes it, and how many messages it has, if known."""

    type: str
    count: int | None


@dataclass(frozen=True, slots=True)
class RawMessage:
    """A message as it is stored; `encoding` is ``cdr`` or ``ros1``, `log_time_ns` the time of recording."""

    topic: str
    type: str
    encoding: str
    log_time_ns: int
    data: bytes | memoryview


class MessageSource(Protocol):
    """A file of ROS messages.

    Attributes
    ----------
    path : Path
        The file or folder.
    kind : str
        What it is, for people.
    checksums : str
        What protects the content, for people; final after a pass over the messages.
    problems : list of str
        The damage found so far.
    """

    @property
    def path(self) -> Path: ...
    @property
    def kind(self) -> str: ...
    @property
    def checksums(self) -> str: ...
    @property
    def problems(self) -> list[str]: ...

    def topics(self) -> dict[str, Topic]:
        """The topics by name."""
        ...

    def messages(self, wanted: Collection[str] | None = None) -> Iterator[RawMessage]:
        """The messages of the wanted topics, or of all, in the order in which they were recorded."""
        ...


def ros2_type(name: str) -> str:
    """The name of a message type as ROS 2 writes it: ``sensor_msgs/Image`` is ``sensor_msgs/msg/Image``."""
    package, _, rest = name.partition("/")
    return name if not rest or "/" in rest else f"{package}/msg/{rest}"


@cache
def typestore(encoding: str) -> Any:
    """The message definitions of ``cdr`` (ROS 2) or ``ros1``."""
    return get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)


def stamp_and_frame(message: RawMessage) -> tuple[int, str]:
    """The header's stamp, nanoseconds, and frame, read without decoding the rest.

    Raises
    ------
    FrameError
        If the message is too short or of an unknown encoding, or the stamp is none: before 1970, after 2038.
    """
    data = message.data
    try:
        if message.encoding == "ros1":
            _, seconds, nanoseconds, length = struct.unpack_from("<IIII", data)
            text = bytes(data[16 : 16 + length])
        elif message.encoding == "cdr":
            order = "<" if data[1] & 1 else ">"
            seconds, nanoseconds, length = struct.unpack_from(f"{order}iII", data, 4)
            text = bytes(data[16 : 16 + length]).rstrip(b"\0")
        else:
            raise FrameError(f"{message.topic}: messages encoded as {message.encoding!r}: only cdr and ros1 are read")
    except (struct.error, IndexError):
        raise FrameError(f"{message.topic}: a message of {len(data)} bytes has no whole header") from None
    stamp_ns = seconds * NANOSECONDS + nanoseconds
    if not 0 <= stamp_ns <= LAST_STAMP:
        raise FrameError(f"{message.topic}: the stamp {seconds} s and {nanoseconds} ns is no time from 1970 to 2038")
    return stamp_ns, text.decode(errors="replace")


def decoded(message: RawMessage) -> Any:
    """The message as an object with the fields of its type.

    Raises
    ------
    FrameError
        If it cannot be decoded.
    """
    if message.encoding not in ("cdr", "ros1"):
        raise FrameError(f"messages encoded as {message.encoding!r}: only cdr and ros1 are read")
    store = typestore(message.encoding)
    read = store.deserialize_ros1 if message.encoding == "ros1" else store.deserialize_cdr
    try:
        return read(memoryview(message.data), message.type)
    except Exception as error:
        raise FrameError(f"the message cannot be decoded: {one_line(error)}") from None


def depth_image(message: RawMessage) -> tuple[NDArray[Any], float]:
    """Depth from an Image or a CompressedImage.

    Returns
    -------
    depth : (H, W) uint16 or float32 array
        Depth as it was recorded.
    unit : float
        Metres in one unit: 0.001 for uint16, 1 for float32, as ROS has it (REP 118).

    Raises
    ------
    FrameError
        If it is damaged or not depth.
    """
    body = decoded(message)
    if message.type == COMPRESSED:
        depth = _compressed_depth(bytes(body.data), body.format)
    else:
        kind = DEPTH_ENCODINGS.get(body.encoding)
        if kind is None:
            raise FrameError(f"encoding {body.encoding!r} is not depth: expected {', '.join(DEPTH_ENCODINGS)}")
        depth = _pixels(body, np.dtype(kind), 1)[:, :, 0]
    return depth, 0.001 if depth.dtype == np.uint16 else 1.0


def color_image(message: RawMessage) -> NDArray[np.uint8]:
    """Colour from an Image or a CompressedImage: (H, W, 3) uint8, sRGB.

    Raises
    ------
    FrameError
        If it is damaged or not colour.
    """
    body = decoded(message)
    if message.type == COMPRESSED:
        return images.decode_color(bytes(body.data))
    places = COLOR_ENCODINGS.get(body.encoding)
    if places is None:
        raise FrameError(f"encoding {body.encoding!r} is not colour: expected {', '.join(COLOR_ENCODINGS)}")
    channels = 4 if "a" in body.encoding else 3
    pixels = _pixels(body, np.dtype(np.uint8), channels)
    if body.encoding == "rgb8":
        return pixels
    # Channel by channel: an index of all three takes eight times as long.
    ordered = np.empty((*pixels.shape[:2], 3), np.uint8)
    for channel, place in enumerate(places):
        ordered[:, :, channel] = pixels[:, :, place]
    return ordered


def _pixels(image: Any, kind: np.dtype[Any], channels: int) -> NDArray[Any]:
    """The (H, W, channels) pixels of an Image: a copy, in this machine's byte order."""
    width, height, step = image.width, image.height, image.step
    if not width or not height or width * height > MAX_IMAGE_PIXELS:
        raise FrameError(f"the image declares {width}x{height}: 1 to {MAX_IMAGE_PIXELS} pixels in all are taken")
    used = width * channels * kind.itemsize
    if step < used or step * height != len(image.data):
        raise FrameError(
            f"the image is {width}x{height} {image.encoding} with {step} bytes a row: "
            f"{len(image.data)} bytes of data do not fit that"
        )
    rows = np.frombuffer(image.data, np.uint8).reshape(height, step)[:, :used]
    stored = np.ascontiguousarray(rows).view(kind.newbyteorder(">" if image.is_bigendian else "<"))
    return np.array(stored, dtype=kind).reshape(height, width, channels)


def _compressed_depth(data: bytes, declared: str) -> NDArray[Any]:
    """Depth from the transports ``compressed``, a PNG, and ``compressedDepth``, 12 bytes before a PNG."""
    has_header = not data.startswith(images.PNG_SIGNATURE)
    if has_header and not data[12:].startswith(images.PNG_SIGNATURE):
        what = "JPEG, which destroys depth" if data.startswith(images.JPEG_SIGNATURE) else "not PNG"
        raise FrameError(f"compressed depth (format {declared!r}) is {what}: record it raw or as compressedDepth png")
    depth = images.decode_depth(data[12:] if has_header else data)
    if not declared.startswith("32FC1"):
        return depth
    if not has_header:
        raise FrameError(f"compressed depth of format {declared!r} has no compressedDepth header: no unit is known")
    # The transport stores metres as quantised inverse depth, value = a / depth + b.
    _, a, b = struct.unpack_from("<iff", data)
    if not (math.isfinite(a) and math.isfinite(b) and a > 0):
        raise FrameError(f"compressed depth has impossible parameters ({a}, {b})")
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        metres = (np.float32(a) / (depth.astype(np.float32) - np.float32(b))).astype(np.float32)
    metres[depth == 0] = np.nan
    return metres


def image_size(message: RawMessage) -> tuple[int, int, str]:
    """Width, height and encoding of an Image or CompressedImage, without decoding its pixels.

    Raises
    ------
    FrameError
        If it is damaged.
    """
    body = decoded(message)
    if message.type == IMAGE:
        return body.width, body.height, body.encoding
    data = bytes(body.data)
    if data.startswith(images.JPEG_SIGNATURE):
        return (*images.jpeg_size(data), body.format)
    header = images.check_png(data if data.startswith(images.PNG_SIGNATURE) else data[12:])
    return header.width, header.height, body.format


def camera(message: RawMessage) -> Intrinsics:
    """The pinhole camera of a CameraInfo: its matrix K.

    Raises
    ------
    FrameError
        If it is damaged, uncalibrated or impossible.
    """
    body = decoded(message)
    k = np.asarray(body.K if message.encoding == "ros1" else body.k, dtype=float)
    if not k.any():
        raise FrameError("the camera is not calibrated: fx = fy = 0")
    return Intrinsics(body.width, body.height, float(k[0]), float(k[4]), float(k[2]), float(k[5]))


def cloud(message: RawMessage) -> tuple[NDArray[Any], NDArray[np.uint8] | None]:
    """The points of a PointCloud2.

    Returns
    -------
    points : (N, 3) float32 or float64 array
        Metres; points that are not finite are kept.
    colors : (N, 3) uint8 array, optional
        sRGB, where there is a packed field ``rgb`` or ``rgba``.

    Raises
    ------
    FrameError
        If it is damaged or its fields are not those of points.
    """
    body = decoded(message)
    count, point_step = body.width * body.height, body.point_step
    if count > MAX_IMAGE_PIXELS:
        raise FrameError(f"the cloud declares {count} points: {MAX_IMAGE_PIXELS} are taken at most")
    if body.row_step < body.width * point_step or body.row_step * body.height != len(body.data):
        raise FrameError(
            f"the cloud is {body.width}x{body.height} points of {point_step} bytes with {body.row_step} "
            f"bytes a row: {len(body.data)} bytes of data do not fit that"
        )
    order = ">" if body.is_bigendian else "<"
    fields: dict[str, tuple[str, int]] = {}
    for field in body.fields:
        kind = _FIELD_TYPES.get(field.datatype)
        if kind is not None and field.offset + int(kind[1]) <= point_step:
            fields[field.name] = (kind, field.offset)
    if any(fields.get(name, ("",))[0] not in ("f4", "f8") for name in "xyz"):
        found = ", ".join(repr(field.name) for field in body.fields[:16])
        raise FrameError(f"the cloud needs fields x, y, z of float32 or float64 within a point; found: {found}")
    rows = np.frombuffer(body.data, np.uint8).reshape(body.height, body.row_step)[:, : body.width * point_step]
    raw = np.ascontiguousarray(rows).reshape(count, point_step)

    def column(kind: str, offset: int) -> NDArray[Any]:
        return np.ascontiguousarray(raw[:, offset : offset + int(kind[1])]).view(order + kind)[:, 0]

    precise = any(fields[name][0] == "f8" for name in "xyz")
    points = np.stack([column(*fields[name]) for name in "xyz"], axis=1, dtype="f8" if precise else "f4")
    packed = next((fields[name] for name in ("rgb", "rgba") if name in fields), None)
    if packed is None or packed[0] not in ("f4", "u4", "i4"):
        return points, None
    value = column("u4", packed[1])
    return points, np.stack([(value >> shift) & 255 for shift in (16, 8, 0)], axis=1).astype(np.uint8)
