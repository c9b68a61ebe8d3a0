"""Records frames, and what a tracker makes of them, so that a kill loses nothing and a slow disk holds nobody up.

`Recorder` writes: what it has written survives a kill of the process, and a second later a power cut.
`BackgroundRecorder` stands before it where nobody may wait for a disk.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Mapping
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

from ropetrace.errors import FrameError, OutputError
from ropetrace.recordings.mcap_append import McapAppender
from ropetrace.recordings.ros_frames import frame_messages
from ropetrace.recordings.ros_messages import RawMessage
from ropetrace.results.base import Closing, uninterrupted
from ropetrace.results.ros import METADATA, EstimateMessages
from ropetrace.types import Cloud, Estimate, Frame, RgbdFrame

SYNC_SECONDS = 0.5
"""Between two calls that have the disk take what was written. A power cut loses this and the time that a call takes."""

QUEUE_BYTES = 256 * 2**20
"""Of frames that wait for the disk at most: five seconds of 640x480 depth and colour at 30 Hz."""

QUEUE_ESTIMATES = 1000
"""Estimates that wait for the disk at most."""


class Recorder(Closing):
    """Frames and estimates in a new MCAP file.

    When `write` returns, the system has the frame: whoever kills the process cannot take it. A thread has the disk take
    it within a second. Images go to the topics of `ropetrace.recordings.ros_frames`, estimates to those of
    `ropetrace.results.ros`. The first frame says what all are: a recording has one camera. Until it is written a file
    that is overwritten stays as it was, and estimates wait for it; without any frame no file comes of it.

    Parameters
    ----------
    path : path
        The file; ``.mcap``.
    overwrite : bool
        Whether it may exist.
    metadata : mapping of str to str
        Kept in the file, such as the resolved configuration of the tracker.

    Attributes
    ----------
    frames : int
        Frames that were written.

    Raises
    ------
    OutputError
        If the file cannot be created, or another process writes to it.
    """

    def __init__(self, path: str | Path, *, overwrite: bool = False, metadata: Mapping[str, str] | None = None) -> None:
        self.path = Path(path)
        self.frames = 0
        self._nature: tuple[Any, ...] | None = None
        self._estimates = EstimateMessages("camera")
        self._early: list[list[RawMessage]] = []
        records = {METADATA: {**(metadata or {}), "frame_name": "camera"}}
        self._file = McapAppender(self.path, overwrite, records)
        self._closing = threading.Event()
        self._sync_error: OutputError | None = None
        self._syncing = threading.Thread(target=self._sync_often, name="recorder sync", daemon=True)
        self._syncing.start()

    @property
    def size(self) -> int:
        """Bytes that were written."""
        return self._file.size

    def write(self, frame: Frame) -> None:
        """Add a frame. When this returns, no kill can take it.

        Raises
        ------
        FrameError
            If it is not of the camera of the first frame, or its stamp does not fit a ROS time; others can follow.
        OutputError
            If the disk refuses; nothing can follow.
        """
        nature = _nature(frame)
        if self._nature not in (None, nature):
            raise FrameError("its camera, size, unit or colour is not that of the first frame")
        self._append(frame_messages(frame))
        self._nature = nature
        self.frames += 1
        while self._early:
            self._append(self._early.pop(0))

    def write_estimate(self, estimate: Estimate) -> None:
        """Add the estimate of one rope in one frame, in the camera's frame.

        Raises
        ------
        FrameError
            If a time does not fit a ROS time, or a thousand estimates wait for the first frame already.
        OutputError
            If the disk refuses.
        """
        messages = self._estimates.of(estimate)
        if self.frames:
            self._append(messages)
        elif len(self._early) < QUEUE_ESTIMATES:
            self._early.append(messages)
        else:
            raise FrameError(f"{QUEUE_ESTIMATES} estimates wait for the first frame already")

    def close(self) -> None:
        """Write the index that other tools want, and close the file; a second call does nothing.

        Without a frame a new file is removed, and one that was there is left as it was.

        Raises
        ------
        OutputError
            If the disk refuses; what was written can be read all the same.
        """
        self._closing.set()
        self._syncing.join()
        if self.frames:
            self._file.close()
        else:
            self._file.discard()
        # The system tells of a fault of the disk once: asked again by `close`, it knows of none.
        error, self._sync_error = self._sync_error, None
        if error is not None:
            raise error

    def _append(self, messages: list[RawMessage]) -> None:
        if self._sync_error is not None:
            raise self._sync_error
        self._file.append(messages)

    def _sync_often(self) -> None:
        while not self._closing.wait(SYNC_SECONDS):
            try:
                self._file.sync()
            except OutputError as error:
                self._sync_error = error
                return


class BackgroundRecorder(Closing):
    """Hands frames and estimates to a `Recorder` in a thread, through a queue of bounded size.

    Whoever offers a frame never waits: what does not fit is dropped and counted. A disk that is full ends the
    recording, and nothing else. The arrays of a frame must not be changed after it was handed over.

    Parameters
    ----------
    recorder : Recorder
        Is closed with this.
    limit : int
        Bytes of frames that wait at most; one frame may always wait.

    Attributes
    ----------
    failure : OutputError, optional
        Why the recording has ended.
    dropped : int
        Frames that were not written since the disk was too slow or had failed, or the recording had ended.
    refused : Counter of str
        Frames and estimates that cannot be in this recording, by the reason.
    dropped_estimates : int
        Estimates that were not written for the same reasons.
    """

    def __init__(self, recorder: Recorder, limit: int = QUEUE_BYTES) -> None:
        self.recorder = recorder
        self.failure: OutputError | None = None
        self.dropped = 0
        self.dropped_estimates = 0
        self.refused: Counter[str] = Counter()
        self._limit = limit
        self._frames_bytes = 0
        self._items: deque[Frame | Estimate] = deque()
        self._estimates = 0
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    def offer(self, frame: Frame) -> bool:
        """Hand over a frame without waiting; whether there was room for it."""
        with self._changed:
            return self._add(frame)

    def put(self, frame: Frame) -> None:
        """Hand over a frame, and wait until there is room: for sources that wait, as files do."""
        with self._changed:
            self._changed.wait_for(lambda: self._has_ended or self._has_room(frame))
            self._add(frame)

    def write(self, index: int, estimate: Estimate, frame: Frame | None = None, cloud: Cloud | None = None) -> None:
        """Hand over an estimate without waiting; a `ropetrace.tracking.Sink`."""
        with self._changed:
            self._add_estimate(estimate)

    def put_estimate(self, estimate: Estimate) -> None:
        """Hand over an estimate, and wait until there is room, as `put` does."""
        with self._changed:
            self._changed.wait_for(lambda: self._has_ended or self._estimates < QUEUE_ESTIMATES)
            self._add_estimate(estimate)

    def close(self) -> None:
        """Wait until all that was handed over is written, and close the recorder; a second call does nothing.

        Raises
        ------
        OutputError
            If the disk refuses the end; where it refused before, `failure` says so.
        """
        with uninterrupted():
            with self._changed:
                self._closing = True
                self._changed.notify_all()
            self._thread.join()
            with suppress(OutputError) if self.failure is not None else nullcontext():
                self.recorder.close()

    @property
    def _has_ended(self) -> bool:
        return self.failure is not None or self._closing

    def _has_room(self, frame: Frame) -> bool:
        return not self._frames_bytes or self._frames_bytes + _bytes_of(frame) <= self._limit

    def _add(self, frame: Frame) -> bool:
        if self._has_ended or not self._has_room(frame):
            self.dropped += 1
            return False
        self._frames_bytes += _bytes_of(frame)
        self._items.append(frame)
        self._changed.notify_all()
        return True

    def _add_estimate(self, estimate: Estimate) -> None:
        if self._has_ended or self._estimates >= QUEUE_ESTIMATES:
            self.dropped_estimates += 1
            return
        self._estimates += 1
        self._items.append(estimate)
        self._changed.notify_all()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._items or self._closing)
                if not self._items:
                    return
                item = self._items[0]
            try:
                self._write(item)
            except Exception as error:
                self._fail(error if isinstance(error, OutputError) else OutputError(f"{self.recorder.path}: {error!r}"))
                return
            with self._changed:
                self._items.popleft()
                if isinstance(item, Estimate):
                    self._estimates -= 1
                else:
                    self._frames_bytes -= _bytes_of(item)
                self._changed.notify_all()

    def _write(self, item: Frame | Estimate) -> None:
        try:
            if isinstance(item, Estimate):
                self.recorder.write_estimate(item)
            else:
                self.recorder.write(item)
        except FrameError as error:
            self.refused[str(error)] += 1

    def _fail(self, error: OutputError) -> None:
        with self._changed:
            self.failure = error
            estimates = sum(isinstance(item, Estimate) for item in self._items)
            self.dropped_estimates += estimates
            self.dropped += len(self._items) - estimates
            self._items.clear()
            self._changed.notify_all()


def _nature(frame: Frame) -> tuple[Any, ...]:
    """What all frames of a recording share."""
    if isinstance(frame, RgbdFrame):
        return frame.intrinsics, frame.depth.dtype, frame.depth_unit_m, frame.color is None
    return ("cloud",)


def _bytes_of(frame: Frame) -> int:
    arrays = (frame.depth, frame.color) if isinstance(frame, RgbdFrame) else (frame.points, frame.colors)
    return sum(array.nbytes for array in arrays if array is not None)
