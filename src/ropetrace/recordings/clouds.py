"""Point clouds from .npy, .npz, .ply and .pcd files: one file, or a folder with a file a frame.

The sizes that a file declares are checked against its length before anything is allocated for them.
"""

from __future__ import annotations

import io
import math
import re
import struct
import warnings
import zipfile
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ropetrace.errors import FrameError, MissingExtraError, RecordingError, import_extra
from ropetrace.recordings.base import (
    MAX_FILE_BYTES,
    RecordingInfo,
    StampStatistics,
    natural_key,
    note,
    one_line,
    read_file,
    stamp_at,
)
from ropetrace.types import MAX_IMAGE_PIXELS, BadFrame, CloudFrame, Event

Cloud = tuple[NDArray[Any], NDArray[np.uint8] | None]
"""Points (N, 3) and their colours (N, 3), if there are any."""

SUFFIXES = (".npy", ".npz", ".ply", ".pcd")

_PLY_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16", "float16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64", "int64", "uint64"), 8),
}
_MAX_HEADER_BYTES = 64 * 1024
# LZF repeats at most 264 bytes by 3.
_LZF_RATIO = 264 / 3


class CloudFiles:
    """A recording of cloud files; see `ropetrace.recordings.base.Recording`.

    Parameters
    ----------
    path : Path
        A file, which becomes one frame of stamp 0, or a folder.
    rate : float, optional
        Frames per second of a folder.

    Raises
    ------
    RecordingError
        If `path` is a file that cannot be read.
    MissingExtraError
        If a package that reads the files is not installed.
    """

    intrinsics = None

    def __init__(self, path: Path, rate: float | None = None) -> None:
        self.path = path
        self.problems: list[str] = []
        self._rate = rate or 1.0
        self._only: CloudFrame | None = None
        if path.is_dir():
            self.kind = "point cloud folder"
            files = [file for file in path.iterdir() if file.suffix.lower() in SUFFIXES]
            self._files = sorted(files, key=lambda file: natural_key(file.name))
            return
        self.kind = "point cloud file"
        self._files = [path]
        try:
            self._only = load_cloud(path, 0)
        except FrameError as error:
            raise RecordingError(f"{path}: {str(error).removeprefix(path.name + ': ')}") from None

    @property
    def frame_count(self) -> int:
        """Cloud files."""
        return len(self._files)

    def frames(self, start: int = 0, limit: int | None = None) -> Iterator[Event]:
        """See `Recording.frames`."""
        stop = None if limit is None else start + limit
        for index, file in islice(enumerate(self._files), start, stop):
            stamp = stamp_at(index, self._rate)
            try:
                yield self._only or load_cloud(file, stamp)
            except FrameError as error:
                yield BadFrame(stamp, f"{file.name}: {str(error).removeprefix(file.name + ': ')}")

    def info(self) -> RecordingInfo:
        """See `Recording.info`."""
        statistics = StampStatistics()
        bad: list[str] = []
        for event in self.frames():
            statistics.add(event.stamp_ns)
            if isinstance(event, BadFrame):
                bad.append(event.reason)
        if bad:
            note(self.problems, f"{len(bad)} of {len(self._files)} files are unreadable; the first: {bad[0]}")
        kinds = "/".join(sorted({file.suffix.lower()[1:] for file in self._files}))
        return RecordingInfo(
            self.path,
            self.kind,
            (statistics.stream("cloud", kinds),),
            statistics.duration,
            None,
            "a CRC in .npz; none in .npy, .ply and .pcd",
            tuple(self.problems),
        )


def load_cloud(path: Path, stamp_ns: int) -> CloudFrame:
    """The cloud in one file; float points as they are stored, whole numbers as float64.

    Raises
    ------
    FrameError
        If it is damaged, too large, or holds no (N, 3) points.
    MissingExtraError
        If the package that reads it is not installed.
    """
    data = read_file(path)
    read = {".npy": _npy, ".npz": _npz, ".ply": _ply, ".pcd": _pcd}[path.suffix.lower()]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return CloudFrame(stamp_ns, *read(data))
    except (FrameError, MissingExtraError):
        raise
    except Exception as error:
        raise FrameError(f"a damaged {path.suffix} file: {one_line(error)}") from None


def _npy(data: bytes) -> Cloud:
    array = _array(data)
    if array.ndim == 2 and array.shape[1] == 6:
        return _points(array[:, :3]), _colors(array[:, 3:])
    return _points(array), None


def _array(data: bytes) -> NDArray[Any]:
    """An array from the bytes of an .npy file; nothing is unpickled."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise FrameError(f"an .npy file of version {version}; save a plain array of numbers")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, kind = read(stream)
    if kind.kind not in "fiu":
        raise FrameError(f"an array of {kind}; points must be numbers")
    declared = math.prod(shape) * kind.itemsize
    if any(size < 0 for size in shape) or declared != len(data) - stream.tell():
        raise FrameError(f"the array declares shape {shape} of {kind}: the file is not of that length")
    return np.frombuffer(data, kind, offset=stream.tell()).reshape(shape, order="F" if fortran else "C")


def _npz(data: bytes) -> Cloud:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        names = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
        for entry in names.values():
            if entry.file_size > MAX_FILE_BYTES:
                raise FrameError(f"{entry.filename} declares {entry.file_size} bytes: {MAX_FILE_BYTES} are taken")
        # Reading stops at the declared size, and checks the CRC there.
        if "points" in names:
            points = _points(_array(archive.read(names["points"])))
            name = next((name for name in ("colors_rgb", "colors") if name in names), None)
            return points, None if name is None else _colors(_array(archive.read(names[name])))
        if len(names) == 1:
            return _npy(archive.read(next(iter(names.values()))))
        found = ", ".join(repr(name) for name in list(names)[:8])
        raise FrameError(f"needs an array 'points' of shape (N, 3); it holds {found or 'nothing'}")


def _ply(data: bytes) -> Cloud:
    _check_ply(data)
    loaded = import_extra("trimesh.exchange.ply", "clouds").load_ply(io.BytesIO(data), fix_texture=False)
    if "vertices" not in loaded:
        return np.empty((0, 3), np.float32), None
    colors = loaded.get("vertex_colors")
    return _points(np.asarray(loaded["vertices"])), None if colors is None else _colors(np.asarray(colors)[:, :3])


def _check_ply(data: bytes) -> None:
    """Refuse a header whose counts do not fit the length of the file."""
    end = data.find(b"end_header", 0, _MAX_HEADER_BYTES)
    if not data.startswith(b"ply") or end < 0:
        raise FrameError("not a PLY file: it has no whole header")
    left = len(data) - end - len(b"end_header")
    is_ascii: bool | None = None
    count = 0
    for line in data[:end].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        if words[:1] == ["format"]:
            is_ascii = words[1:2] == ["ascii"]
        elif words[:1] == ["element"]:
            if len(words) != 3 or not re.fullmatch(r"[0-9]{1,18}", words[2]):
                raise FrameError(f"impossible PLY header line {line!r}")
            count = int(words[2])
        elif words[:1] == ["property"]:
            # A list is at least its count; a number in text is at least a digit and a space.
            kind = words[2] if words[1:2] == ["list"] and len(words) > 2 else words[1] if len(words) > 1 else ""
            if kind not in _PLY_BYTES or is_ascii is None:
                raise FrameError(f"impossible PLY header line {line!r}")
            left -= count * (2 if is_ascii else _PLY_BYTES[kind])
        if count > MAX_IMAGE_PIXELS or left < -2:
            raise FrameError(f"the PLY header declares {count} elements: the file is too short for them")


def _pcd(data: bytes) -> Cloud:
    _check_pcd(data)
    cloud = import_extra("pypcd4", "clouds").PointCloud.from_fileobj(io.BytesIO(data))
    missing = [name for name in "xyz" if name not in cloud.fields]
    if missing:
        raise FrameError(f"needs the fields x, y, z; it holds {', '.join(cloud.fields[:16])}")
    points = _points(cloud.numpy(("x", "y", "z")))
    name = next((name for name in ("rgb", "rgba") if name in cloud.fields), None)
    if name is None:
        return points, None
    packed = np.ascontiguousarray(cloud.pc_data[name])
    if packed.dtype.itemsize != 4:
        return points, None
    value = packed.view(np.uint32).reshape(-1)
    return points, np.stack([(value >> shift) & 255 for shift in (16, 8, 0)], axis=1).astype(np.uint8)


def _check_pcd(data: bytes) -> None:
    """Refuse a header whose counts do not fit the length of the file."""
    match = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data[:_MAX_HEADER_BYTES], re.MULTILINE)
    if match is None:
        raise FrameError("not a PCD file: it has no whole header")
    header: dict[str, list[str]] = {}
    for line in data[: match.start()].decode("ascii", "replace").splitlines():
        words = line.split()
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
    numbers: dict[str, list[int]] = {}
    header.setdefault("COUNT", ["1"] * len(header.get("FIELDS", [])))
    for key in ("SIZE", "COUNT", "WIDTH", "HEIGHT", "POINTS"):
        if not header.get(key) or not all(re.fullmatch(r"[0-9]{1,18}", word) for word in header[key]):
            raise FrameError(f"impossible PCD header line {key} {' '.join(header.get(key, ['(missing)']))[:80]}")
        numbers[key] = [int(word) for word in header[key]]
    fields = len(header.get("FIELDS", []))
    if not fields or not fields == len(numbers["SIZE"]) == len(numbers["COUNT"]) == len(header.get("TYPE", [])):
        raise FrameError("the PCD header's FIELDS, SIZE, TYPE and COUNT are not of one length")
    points = numbers["POINTS"][0]
    row = sum(size * count for size, count in zip(numbers["SIZE"], numbers["COUNT"], strict=True))
    left, method = len(data) - match.end(), match[1]
    if points != numbers["WIDTH"][0] * numbers["HEIGHT"][0] or max(*numbers["COUNT"], sum(numbers["COUNT"])) > 4096:
        raise FrameError(f"the PCD header declares {points} points, which does not fit the rest of it")
    if method == b"binary_compressed":
        packed, unpacked = struct.unpack_from("<II", data, match.end()) if left >= 8 else (0, 0)
        fits = packed <= left - 8 and unpacked == points * row and unpacked <= min(packed * _LZF_RATIO, MAX_FILE_BYTES)
    else:
        fits = points * row <= left if method == b"binary" else points * 2 * sum(numbers["COUNT"]) <= left + 2
    if points > MAX_IMAGE_PIXELS or not fits:
        raise FrameError(f"the PCD header declares {points} points: the file is not of that length")


def _points(array: NDArray[Any]) -> NDArray[Any]:
    """An (N, 3) float array that this machine computes with."""
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise FrameError(f"an array of {array.dtype} of shape {array.shape}; points must be numbers of shape (N, 3)")
    if len(array) > MAX_IMAGE_PIXELS:
        raise FrameError(f"{len(array)} points: {MAX_IMAGE_PIXELS} are taken at most")
    small = array.dtype.kind == "f" and array.dtype.itemsize <= 4
    return np.array(array, dtype=np.float32 if small else np.float64, order="C")


def _colors(array: NDArray[Any]) -> NDArray[np.uint8]:
    """(N, 3) colours of 0 to 255, or of 0 to 1 where they are floats and none is larger."""
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise FrameError(f"colours are {array.dtype} of shape {array.shape}: expected (N, 3) numbers of 0 to 255")
    if array.dtype == np.uint8:
        return np.array(array, order="C")
    values = np.nan_to_num(array.astype(np.float64), nan=0.0)
    if array.dtype.kind == "f" and values.size and values.max() <= 1:
        values = values * 255
    if values.size and not 0 <= values.min() <= values.max() <= 255:
        raise FrameError(f"colours of {values.min():g} to {values.max():g}: expected 0 to 255, or 0 to 1")
    return np.round(values).astype(np.uint8)
