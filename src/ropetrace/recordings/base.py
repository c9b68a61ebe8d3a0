"""What every recording offers, and the checks that every reader makes before it opens a file."""

from __future__ import annotations

import json
import os
import re
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from ropetrace.errors import ConfigError, FrameError, RecordingError
from ropetrace.types import BadFrame, Event, Intrinsics, lacks_color

DEFAULT_PAIR_GAP = 0.02
"""Colour and depth that were taken farther apart than this are not of one moment, seconds."""

MAX_FILE_BYTES = 512 * 2**20
"""The largest image or cloud file that is read into memory, bytes."""

MAX_TEXT_BYTES = 64 * 2**20
"""The largest text file that is read, bytes."""


@dataclass(frozen=True, slots=True)
class StreamInfo:
    """One stream of a recording.

    Parameters
    ----------
    name : str
        The topic, or the folder.
    encoding : str
        Its message type and image encoding, or its kind of file.
    count : int
        Messages or files.
    width, height : int, optional
        Image size, pixels.
    rate_hz : float, optional
        Mean rate over the steps in which the stamps rise, Hz; None without stamps.
    largest_gap : float, optional
        The longest step between stamps that follow each other, seconds.
    not_rising : int
        Stamps that repeat the one before or run back.
    """

    name: str
    encoding: str
    count: int
    width: int | None = None
    height: int | None = None
    rate_hz: float | None = None
    largest_gap: float | None = None
    not_rising: int = 0


@dataclass(frozen=True, slots=True)
class RecordingInfo:
    """What is in a recording, after all of it was read once.

    Parameters
    ----------
    path : Path
        The recording.
    kind : str
        What it is, for people.
    streams : tuple of StreamInfo
        The streams that are used come first.
    duration : float, optional
        From the first frame's stamp to the last, seconds; None if there are not two.
    intrinsics : Intrinsics, optional
        The camera; None for clouds.
    checksums : str
        What protects the content, for people: how far damage can be noticed at all.
    problems : tuple of str
        The damage that was found, a sentence each.
    """

    path: Path
    kind: str
    streams: tuple[StreamInfo, ...]
    duration: float | None
    intrinsics: Intrinsics | None
    checksums: str
    problems: tuple[str, ...]


class Recording(Protocol):
    """Frames that were recorded, in the order in which they were recorded.

    Attributes
    ----------
    path : Path
        What was opened.
    kind : str
        What it is, for people.
    frame_count : int, optional
        Frames in it, bad ones included, where that can be known without reading all of it.
    intrinsics : Intrinsics, optional
        The camera; None for clouds.
    problems : list of str
        The damage found so far, each a sentence that states the loss; complete once `frames` is exhausted.
    """

    @property
    def path(self) -> Path: ...
    @property
    def kind(self) -> str: ...
    @property
    def frame_count(self) -> int | None: ...
    @property
    def intrinsics(self) -> Intrinsics | None: ...
    @property
    def problems(self) -> list[str]: ...

    def frames(self, start: int = 0, limit: int | None = None) -> Iterator[Event]:
        """The frames, lazily; may be called again.

        A frame that cannot be decoded is a `BadFrame`, and the stream goes on after it.

        Parameters
        ----------
        start : int
            Frames of the recording to skip, bad ones counted.
        limit : int, optional
            Frames to yield at most, bad ones counted.

        Raises
        ------
        RecordingError
            If nothing at all can be read.
        """
        ...

    def info(self) -> RecordingInfo:
        """Read all of the recording once, without decoding pixels, and say what is in it.

        Raises
        ------
        RecordingError
            If nothing at all can be read.
        """
        ...


def frames_to_come(recording: Recording, start: int = 0, limit: int | None = None) -> int | None:
    """How many frames `recording.frames(start, limit)` gives, where that can be known without reading all of it."""
    if recording.frame_count is None:
        return limit
    left = max(recording.frame_count - start, 0)
    return left if limit is None else min(left, limit)


NO_COLOR = "a colour is asked for, but the frames have none: leave out the colour, or record it"


def check_color(recording: Recording, asks_for_color: bool, start: int = 0) -> None:
    """Raise a ConfigError if a colour is asked for and the frames have none; `start` as that of `frames`."""
    if asks_for_color and not has_color(recording, start):
        raise ConfigError(NO_COLOR)


def has_color(recording: Recording, start: int = 0) -> bool:
    """Whether the first sound frame has colour; true if there is no sound frame, which shows later."""
    for event in recording.frames(start, 50):
        if not isinstance(event, BadFrame):
            return not lacks_color(event)
    return True


class StampStatistics:
    """Counts what the stamps of one stream do; stamps in nanoseconds."""

    def __init__(self) -> None:
        self.count = 0
        self.not_rising = 0
        self._rising_steps = 0
        self._rising_ns = 0
        self._largest_ns: int | None = None
        self._last: int | None = None
        self._span: tuple[int, int] | None = None

    def add(self, stamp_ns: int) -> None:
        """Count one more stamp."""
        self.count += 1
        if self._last is not None:
            step = stamp_ns - self._last
            if step > 0:
                self._rising_steps += 1
                self._rising_ns += step
                self._largest_ns = max(step, self._largest_ns or 0)
            else:
                self.not_rising += 1
        self._last = stamp_ns
        low, high = self._span or (stamp_ns, stamp_ns)
        self._span = (min(low, stamp_ns), max(high, stamp_ns))

    @property
    def duration(self) -> float | None:
        """Seconds from the earliest stamp to the latest; None with fewer than two."""
        return (self._span[1] - self._span[0]) / 1e9 if self._span and self.count > 1 else None

    def stream(self, name: str, encoding: str, width: int | None = None, height: int | None = None) -> StreamInfo:
        """The row of `RecordingInfo` for this stream."""
        rate = self._rising_steps / (self._rising_ns / 1e9) if self._rising_ns else None
        gap = self._largest_ns / 1e9 if self._largest_ns is not None else None
        return StreamInfo(name, encoding, self.count, width, height, rate, gap, self.not_rising)


MOST_PROBLEMS = 100
"""Sentences on the damage of one recording."""

_LAST_PROBLEMS = 9
"""Of those, the ones that came last: at the end a reader sums up the loss."""

_MORE_PROBLEMS = "further damage of the same kinds is not listed"


def note(problems: list[str], problem: str) -> None:
    """Add a problem, unless an earlier pass over the recording found it; of very many the middle is left out."""
    if problem in problems:
        return
    problems.append(problem)
    if len(problems) > MOST_PROBLEMS:
        problems[-_LAST_PROBLEMS - 2 : -_LAST_PROBLEMS] = [_MORE_PROBLEMS]


def one_line(error: Exception) -> str:
    """What another library says of an error, as one line of bounded length."""
    return " ".join(str(error).split())[:200] or type(error).__name__


def printable(text: str) -> str:
    """A name from a file as it may be shown: line breaks and control characters are escaped."""
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


def stamp_at(index: int, rate: float) -> int:
    """The stamp of frame `index` at `rate` frames per second, nanoseconds."""
    return round(index * 1e9 / rate)


def natural_key(name: str) -> tuple[tuple[int, str], ...]:
    """A sort key by which ``frame_9`` comes before ``frame_10``."""
    parts = re.split(r"([0-9]+)", name)
    return tuple((int(part) if part[:1].isdecimal() else -1, part) for part in parts)


def regular_file_size(path: Path) -> int:
    """The size of a regular file, bytes; a FIFO or a device would block or never end.

    Raises
    ------
    FrameError
        If it is missing or anything but a regular file.
    """
    try:
        status = os.stat(path)
    except (OSError, ValueError) as error:
        raise FrameError(f"{path.name}: {getattr(error, 'strerror', None) or error}") from None
    if not stat.S_ISREG(status.st_mode):
        raise FrameError(f"{path.name}: not a regular file")
    return status.st_size


def read_file(path: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """All bytes of a regular file.

    Raises
    ------
    FrameError
        If it is missing, unreadable, empty, larger than `limit` bytes or not a regular file.
    """
    size = regular_file_size(path)
    if size == 0:
        raise FrameError(f"{path.name}: the file is empty")
    if size > limit:
        raise FrameError(f"{path.name}: {size} bytes are more than the {limit} that are taken")
    try:
        with open(path, "rb") as stream:
            return stream.read(limit)
    except OSError as error:
        raise FrameError(f"{path.name}: {error.strerror}") from None


CAMERA_KEYS = ("width", "height", "fx", "fy", "cx", "cy", "depth_unit_m")


def read_camera(path: Path) -> tuple[Intrinsics, float]:
    """The camera and the metres in one unit of depth from a JSON file; further keys are allowed.

    Raises
    ------
    RecordingError
        If the file is missing, is not JSON, or lacks a key or holds an impossible value.
    """
    wanted = f"a JSON object with {', '.join(CAMERA_KEYS)} (pixels; metres in one unit of depth)"
    if not os.path.lexists(path):
        raise RecordingError(f"{path}: there is no such file, and depth is useless without its camera: write {wanted}")
    try:
        table: Any = json.loads(read_file(path, 2**20).decode())
    except FrameError as error:
        raise RecordingError(f"{path.parent}: {error}; it must be {wanted}") from None
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"{path}: not JSON ({error}); it must be {wanted}") from None
    if not isinstance(table, dict):
        raise RecordingError(f"{path}: holds a {type(table).__name__}; it must be {wanted}")
    missing = [key for key in CAMERA_KEYS if key not in table]
    if missing:
        raise RecordingError(f"{path}: lacks {', '.join(missing)}; it must be {wanted}")
    numbers: dict[str, float] = {}
    for key in CAMERA_KEYS:
        if not isinstance(table[key], (int, float)) or isinstance(table[key], bool):
            raise RecordingError(f"{path}: {key} = {table[key]!r} is not a number; it must be {wanted}")
        try:
            numbers[key] = float(table[key])
        except OverflowError:
            raise RecordingError(f"{path}: {key} is too large a number; it must be {wanted}") from None
        if key in ("width", "height") and not numbers[key].is_integer():
            raise RecordingError(f"{path}: {key} = {table[key]!r} is not a whole number of pixels")
    size = int(numbers["width"]), int(numbers["height"])
    try:
        camera = Intrinsics(*size, *(numbers[key] for key in ("fx", "fy", "cx", "cy")))
    except FrameError as error:
        raise RecordingError(f"{path}: {error}") from None
    unit = numbers["depth_unit_m"]
    if not 1e-7 <= unit <= 1:
        raise RecordingError(f"{path}: depth_unit_m = {unit} is impossible: millimetres are 0.001, metres 1")
    return camera, unit
