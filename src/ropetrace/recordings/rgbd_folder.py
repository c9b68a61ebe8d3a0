"""RGB-D folders in the layout of the TUM benchmark: images in ``depth/`` and ``rgb/``, stamps in text files.

::

    camera.json                 width height fx fy cx cy (pixels) depth_unit_m (metres)
    depth.txt   rgb.txt         lines "seconds path"; # begins a comment
    depth/      rgb/            16-bit grey PNG; 8-bit PNG or JPEG
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Self, TextIO

import numpy as np
from numpy.typing import NDArray

from ropetrace.errors import FrameError, OutputError, RecordingError
from ropetrace.recordings import images
from ropetrace.recordings.base import (
    DEFAULT_PAIR_GAP,
    MAX_TEXT_BYTES,
    RecordingInfo,
    StampStatistics,
    note,
    read_camera,
    read_file,
)
from ropetrace.recordings.pairing import missing_color, nearest, reach_around
from ropetrace.types import BadFrame, Event, Intrinsics, RgbdFrame

_STAMP = re.compile(r"([+-]?)([0-9]{1,10})(?:\.([0-9]{0,30}))?")


def parse_stamp(text: str) -> int | None:
    """Nanoseconds from decimal seconds, exactly (digits beyond the ninth are cut); None if it is no stamp.

    >>> parse_stamp("1305031102.160407"), parse_stamp("-0.5"), parse_stamp("nan")
    (1305031102160407000, -500000000, None)
    """
    match = _STAMP.fullmatch(text)
    if match is None:
        return None
    magnitude = int(match[2]) * 10**9 + int((match[3] or "")[:9].ljust(9, "0"))
    return -magnitude if match[1] == "-" else magnitude


def format_stamp(stamp_ns: int) -> str:
    """Decimal seconds with nine decimals, which `parse_stamp` reads back exactly."""
    sign = "-" if stamp_ns < 0 else ""
    return f"{sign}{abs(stamp_ns) // 10**9}.{abs(stamp_ns) % 10**9:09d}"


@dataclass(frozen=True, slots=True)
class _Row:
    stamp_ns: int
    file: Path


class RgbdFolder:
    """A recording in an RGB-D folder; see `ropetrace.recordings.base.Recording`.

    Parameters
    ----------
    path : Path
        The folder that holds ``depth.txt``.
    max_pair_gap : float
        Colour farther than this from a depth image is not paired with it, seconds.

    Raises
    ------
    RecordingError
        If the camera or the list of depth images is missing or unusable, or a path leaves the folder.
    """

    kind = "RGB-D folder"

    def __init__(self, path: Path, max_pair_gap: float = DEFAULT_PAIR_GAP) -> None:
        self.path = path
        self.problems: list[str] = []
        self.intrinsics, self.depth_unit_m = read_camera(path / "camera.json")
        self._max_gap_ns = round(max_pair_gap * 1e9)
        self._depth = _read_rows(path, "depth.txt", self.problems)
        if not self._depth:
            raise RecordingError(f"{path / 'depth.txt'}: lists no image; write a line 'seconds path' for each")
        has_color = os.path.lexists(path / "rgb.txt")
        rows = _read_rows(path, "rgb.txt", self.problems) if has_color else []
        self._color = sorted(rows, key=lambda row: row.stamp_ns) if has_color else None
        self._color_rows = rows
        self._color_stamps = [row.stamp_ns for row in self._color or ()]

    @property
    def frame_count(self) -> int:
        """Depth images that are listed."""
        return len(self._depth)

    def frames(self, start: int = 0, limit: int | None = None) -> Iterator[Event]:
        """See `Recording.frames`."""
        for row in islice(self._depth, start, None if limit is None else start + limit):
            try:
                depth = images.decode_depth(read_file(row.file))
                color = self._color_of(row.stamp_ns)
                yield RgbdFrame(row.stamp_ns, depth, self.depth_unit_m, self.intrinsics, color)
            except FrameError as error:
                yield BadFrame(row.stamp_ns, f"{row.file.relative_to(self.path)}: {error}")

    def _color_of(self, stamp_ns: int) -> NDArray[np.uint8] | None:
        """The colour image nearest to a depth image."""
        if self._color is None:
            return None
        index = nearest(self._color_stamps, stamp_ns)
        if index is None:
            raise FrameError(missing_color(None, self._max_gap_ns))
        gap, reach = (
            abs(self._color_stamps[index] - stamp_ns),
            reach_around(self._color_stamps, index, self._max_gap_ns),
        )
        if gap > reach:
            raise FrameError(missing_color(gap, reach))
        row = self._color[index]
        try:
            return images.decode_color(read_file(row.file))
        except FrameError as error:
            raise FrameError(f"its colour image {row.file.relative_to(self.path)}: {error}") from None

    def info(self) -> RecordingInfo:
        """See `Recording.info`."""
        streams, duration = [], None
        for name, encoding, rows in (
            ("depth", "16-bit grey PNG", self._depth),
            ("rgb", "8-bit PNG or JPEG", self._color_rows),
        ):
            statistics = StampStatistics()
            for row in rows:
                statistics.add(row.stamp_ns)
            note_bad_images(self.path, [row.file for row in rows], name, self.problems)
            if rows:
                streams.append(statistics.stream(name, encoding, self.intrinsics.width, self.intrinsics.height))
            duration = statistics.duration if name == "depth" else duration
        checksums = "every PNG chunk has a CRC; JPEG has none"
        return RecordingInfo(
            self.path, self.kind, tuple(streams), duration, self.intrinsics, checksums, tuple(self.problems)
        )


def note_bad_images(folder: Path, files: list[Path], name: str, problems: list[str]) -> None:
    """Check the images without decoding their pixels; notes how many are bad, and the first."""
    bad: list[str] = []
    for file in files:
        try:
            data = read_file(file)
            if not data.startswith(images.JPEG_SIGNATURE):
                images.check_png(data)
        except FrameError as error:
            bad.append(f"{file.relative_to(folder)}: {error}")
    if bad:
        note(problems, f"{len(bad)} of {len(files)} {name} images are unreadable; the first: {bad[0]}")


def _read_rows(folder: Path, name: str, problems: list[str]) -> list[_Row]:
    """The stamps and files that a text file lists."""
    try:
        text = read_file(folder / name, MAX_TEXT_BYTES).decode(errors="replace")
    except FrameError as error:
        raise RecordingError(f"{folder}: {error}; it must list the images, a line 'seconds path' each") from None
    rows: list[_Row] = []
    unreadable: list[int] = []
    inside: dict[str, bool] = {}
    root = os.path.realpath(folder)
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#", 1)[0].split(maxsplit=1)
        if not words:
            continue
        stamp = parse_stamp(words[0])
        relative = words[1].strip() if len(words) == 2 else ""
        if stamp is None or not relative or "\0" in relative:
            unreadable.append(number)
            continue
        if not _stays_inside(root, relative, inside):
            raise RecordingError(
                f"{folder / name}: line {number}: {relative!r} leaves the folder; paths must stay in it"
            )
        rows.append(_Row(stamp, folder / relative))
    if unreadable:
        note(
            problems,
            f"{name}: {len(unreadable)} lines are not 'seconds path' and are left out, "
            f"the first is line {unreadable[0]}",
        )
    return rows


def _stays_inside(root: str, relative: str, inside: dict[str, bool]) -> bool:
    """Whether a listed path stays in the folder, links followed; `inside` remembers folders."""
    if os.path.isabs(relative) or ".." in Path(relative).parts:
        return False
    parent = os.path.dirname(relative)
    if parent not in inside:
        inside[parent] = _is_below(root, os.path.join(root, parent))
    file = os.path.join(root, relative)
    return inside[parent] and (not os.path.islink(file) or _is_below(root, file))


def _is_below(root: str, path: str) -> bool:
    real = os.path.realpath(path)
    return real == root or real.startswith(root.rstrip(os.sep) + os.sep)


class RgbdFolderWriter:
    """Writes frames into a new RGB-D folder, losslessly; what was written before a crash stays readable.

    Parameters
    ----------
    path : path
        The folder; must not exist, or be empty.
    intrinsics : Intrinsics
        The camera.
    depth_unit_m : float
        Metres in one unit of depth.

    Raises
    ------
    OutputError
        If the folder holds something already, or cannot be made.
    """

    def __init__(self, path: str | Path, intrinsics: Intrinsics, depth_unit_m: float) -> None:
        self.path = Path(path)
        self.intrinsics = intrinsics
        self.depth_unit_m = depth_unit_m
        self._count = 0
        self._lists: dict[str, TextIO] = {}
        camera = {
            "width": intrinsics.width,
            "height": intrinsics.height,
            "fx": intrinsics.fx,
            "fy": intrinsics.fy,
            "cx": intrinsics.cx,
            "cy": intrinsics.cy,
            "depth_unit_m": depth_unit_m,
        }
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            if any(self.path.iterdir()):
                raise OutputError(f"{self.path}: the folder is not empty; name a new one")
            (self.path / "camera.json").write_text(json.dumps(camera, indent=1) + "\n")
            self._list("depth")
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {error.strerror}") from None

    def write(self, frame: RgbdFrame) -> None:
        """Add a frame.

        Raises
        ------
        OutputError
            If the frame's camera, unit or type of depth is not the folder's, or the disk refuses.
        """
        if frame.depth.dtype != np.uint16:
            raise OutputError(f"{self.path}: depth is {frame.depth.dtype}; PNG holds uint16 only: write MCAP instead")
        if frame.intrinsics != self.intrinsics or frame.depth_unit_m != self.depth_unit_m:
            raise OutputError(f"{self.path}: the frame's camera or depth unit is not the recording's")
        try:
            # The image first: a line of the list never names a file that is not there.
            self._write_image("depth", frame.stamp_ns, images.encode_png(frame.depth))
            if frame.color is not None:
                self._write_image("rgb", frame.stamp_ns, images.encode_png(frame.color))
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {error.strerror}") from None
        self._count += 1

    def _write_image(self, name: str, stamp_ns: int, data: bytes) -> None:
        # The count keeps names apart where stamps repeat.
        relative = f"{name}/{self._count:06d}_{format_stamp(stamp_ns)}.png"
        stream = self._list(name)
        (self.path / relative).write_bytes(data)
        stream.write(f"{format_stamp(stamp_ns)} {relative}\n")
        stream.flush()

    def _list(self, name: str) -> TextIO:
        if name not in self._lists:
            (self.path / name).mkdir()
            self._lists[name] = (self.path / f"{name}.txt").open("w", encoding="utf-8")
            self._lists[name].write("# seconds path\n")
            self._lists[name].flush()
        return self._lists[name]

    def close(self) -> None:
        """Close the lists; may be called again."""
        for stream in self._lists.values():
            stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
