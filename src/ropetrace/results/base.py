"""What every writer of results shares: the protocol, the check of the path, the words of an error."""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import stat
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType, TracebackType
from typing import BinaryIO, Protocol, Self

import numpy as np

from ropetrace.errors import OutputError
from ropetrace.terminal import ENDINGS
from ropetrace.types import Cloud, Estimate, FloatArray, Frame

STATUS_COLUMNS = ("frame", "stamp_ns", "ahead_ns", "waypoint", "status")
"""The columns of a row that say what it belongs to."""

WAYPOINT_COLUMNS = ("arc_length", "x", "y", "z", "qx", "qy", "qz", "qw")
"""The columns of a row that hold the waypoint: metres, and a quaternion."""

MOTION_ARRAYS = ("velocities", "accelerations", "position_sigma", "velocity_sigma", "acceleration_sigma")
"""The arrays of a `Motion`, (W, 3) each, in the order in which `motion_rows` puts them side by side."""

MOTION_COLUMNS = tuple(
    prefix + axis for prefix in ("v", "a", "sigma_", "sigma_v", "sigma_a") for axis in ("x", "y", "z")
)
"""The columns of a row that hold the waypoint's motion: metres, m/s, m/s^2. Empty where it is not known."""

FLOAT_COLUMNS = WAYPOINT_COLUMNS + MOTION_COLUMNS
"""The columns of a row that hold numbers with a fraction."""

TRACKER_COLUMNS = ("rope", "seen", "tracker_sigma")
"""The columns of a row that say which rope it is and what the tracker tells of the waypoint: whether the camera saw it,
and the standard deviation of its position, metres. The last two are empty where it does not tell."""

COLUMNS = STATUS_COLUMNS + FLOAT_COLUMNS + TRACKER_COLUMNS
"""The columns of the table formats, in order."""


def motion_rows(estimate: Estimate) -> FloatArray:
    """The motion of the waypoints, (W, 15), as `MOTION_COLUMNS` name it; NaN where it is not known."""
    motion = estimate.motion
    if motion is None:
        return np.full((len(estimate.waypoints), len(MOTION_COLUMNS)), np.nan)
    return np.hstack([getattr(motion, name) for name in MOTION_ARRAYS])


def float_rows(estimate: Estimate) -> FloatArray:
    """A row a waypoint, (W, 23), as `FLOAT_COLUMNS` name it; NaN for what is not known."""
    waypoints = estimate.waypoints
    return np.column_stack((waypoints.arc_length, waypoints.positions, waypoints.quaternions, motion_rows(estimate)))


def rope_name(rope: int) -> str:
    """What the topics and entities of a rope are called by."""
    return f"rope_{rope}"


class ResultWriter(Protocol):
    """Takes the estimates of a run, a call for each rope of a frame. A context manager that closes itself."""

    def write(self, index: int, estimate: Estimate, frame: Frame | None = None, cloud: Cloud | None = None) -> None:
        """Add the estimate of one rope in one frame; those of a frame follow one another.

        Parameters
        ----------
        index : int
            The frame's place in its recording.
        estimate : Estimate
            Written as given: transform it before.
        frame, cloud : optional
            What the estimate was made of; for the formats that show pictures.

        Raises
        ------
        OutputError
            If it cannot be written.
        """

    def close(self) -> None:
        """Finish the file; a second call does nothing."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class Closing:
    """The context-manager half of a writer."""

    def close(self) -> None:
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # A disk that is full fails twice, in write and in close: what the user must see is the first.
        with contextlib.suppress(OutputError) if error is not None else contextlib.nullcontext():
            self.close()


def cannot_write(path: Path, error: OSError) -> OutputError:
    """The one line for a file that the operating system refuses."""
    return OutputError(f"{path}: cannot be written: {error.strerror or error}")


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn the operating system's refusals into an OutputError that names the file."""
    try:
        yield
    except OSError as error:
        raise cannot_write(path, error) from None


def check_place(path: Path) -> None:
    """Raise an OutputError if no file can be at this path."""
    with writing(path):
        if path.is_dir():
            raise OutputError(f"{path} is a folder: give the name of a file")
        if not path.parent.is_dir():
            raise OutputError(f"{path}: the folder {path.parent} does not exist")


def create(
    path: Path, overwrite: bool, buffering: int = -1, opener: Callable[[str, int], int] | None = None
) -> BinaryIO:
    """Open a new file; `opener` as that of the built-in `open`.

    Raises
    ------
    OutputError
        If the file exists and `overwrite` is not set, or it cannot be made.
    """
    check_place(path)
    try:
        return open(path, "wb" if overwrite else "xb", buffering=buffering, opener=opener)
    except FileExistsError:
        raise OutputError(f"{path} exists already: choose another name or give --overwrite") from None
    except OSError as error:
        raise cannot_write(path, error) from None


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold back `ENDINGS` until the block is done, so that they never leave half a frame behind."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    held: list[tuple[int, FrameType | None]] = []
    previous = {
        number: signal.signal(number, lambda number, frame: held.append((number, frame)))
        for number in ENDINGS
        if signal.getsignal(number) is not None
    }
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        for late, frame in held:
            handler = previous[signal.Signals(late)]
            if callable(handler):
                handler(late, frame)
            elif handler is signal.SIG_DFL:
                signal.raise_signal(late)


class WholeFile:
    """A file that takes each piece of data whole or, where the disk is full, not at all.

    There is no buffer in the process: when `append` returns the system has the data, and a kill cannot take
    them. What was in the file before is there until the first `append`. Another process that would write to it
    meanwhile is refused by a lock.

    Raises
    ------
    OutputError
        If the file cannot be created or written, or another process writes to it.
    """

    def __init__(self, path: Path, overwrite: bool) -> None:
        self._path = path
        self._is_new = not os.path.lexists(path)
        self._file = create(path, overwrite, buffering=0, opener=_keeping)
        self.size = 0
        # Devices and pipes can be shared, and have nothing to be cut off.
        self._is_regular = stat.S_ISREG(os.fstat(self._file.fileno()).st_mode)
        self._is_begun = False
        if self._is_regular:
            with self.closed_on_error():
                lock(self._file, path)

    @contextlib.contextmanager
    def closed_on_error(self) -> Iterator[None]:
        """For the constructor of a writer, which nobody closes if it fails."""
        try:
            yield
        except BaseException:
            self._file.close()
            raise

    def append(self, data: bytes | bytearray) -> None:
        """Write all of the data, or raise and leave the file as it was."""
        written = 0
        with writing(self._path), uninterrupted(), memoryview(data) as view:
            if self._is_regular and not self._is_begun:
                self._file.truncate(0)
            self._is_begun = True
            try:
                while written < len(view):
                    written += self._file.write(view[written:])
            except OSError:
                with contextlib.suppress(OSError):
                    self._file.seek(self.size)
                    self._file.truncate()
                raise
            self.size += written

    def sync(self) -> None:
        """Wait until the disk has all that was written."""
        with writing(self._path):
            os.fdatasync(self._file.fileno())

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        with writing(self._path):
            self._file.close()

    def discard(self) -> None:
        """Close the file as if it had never been opened: a new one is removed, and one with data of this run too."""
        with writing(self._path):
            if self._is_regular and (self._is_new or self._is_begun):
                self._path.unlink(missing_ok=True)
            self._file.close()


def _keeping(path: str, flags: int) -> int:
    """Open a file, and leave what is in it until it is locked."""
    return os.open(path, flags & ~os.O_TRUNC, 0o666)


def lock(file: BinaryIO | int, path: Path) -> None:
    """Lock a file that is open for writing until it is closed.

    Raises
    ------
    OutputError
        If another process has locked it.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise OutputError(f"{path} is being written by another process") from None
    except OSError:
        pass  # some network file systems have no locks
