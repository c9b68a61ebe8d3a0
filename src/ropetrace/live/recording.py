"""A live camera that is read as a recording is."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from ropetrace.errors import RecordingError
from ropetrace.live.camera import Camera, Capture
from ropetrace.live.clock import ClockWatch
from ropetrace.live.stream import Stream
from ropetrace.recordings.base import RecordingInfo, StampStatistics, note
from ropetrace.types import BadFrame, CloudFrame, Event, Intrinsics, RgbdFrame

SILENCE_SECONDS = 1.0
"""A camera that gives nothing for this long is told as a bad frame, and again after each such time."""

GIVE_UP_SECONDS = 30.0
"""A camera that gives nothing for this long ends the frames with an error."""

INFO_SECONDS = 2.0
"""How long `info` looks at a camera."""

MOST_GAPS = 100
"""Times without frames that are told one by one."""

START_FRAMES = 2
"""The first frames of a run wait for the compiler, or for its cache: what is dropped meanwhile is counted apart."""


class LiveRecording:
    """The newest frames of a camera; a `Recording` without an end.

    `frames` starts the camera and, when it is closed or exhausted, stops it and joins the thread. Each call begins
    anew and ends the one before.

    Parameters
    ----------
    address : str
        What the user calls it, such as ``sim:swing``.
    camera : Camera
        Where frames come from.
    silence, give_up : float
        In the place of `SILENCE_SECONDS` and `GIVE_UP_SECONDS`.

    Attributes
    ----------
    on_event : callable, optional
        Is given every frame that comes, also those that nobody takes, before it can be taken: for a recorder. It is
        called by the camera's thread, and must be quick. Counts from the next call of `frames`.
    intrinsics : Intrinsics, optional
        Of the newest frame that was taken; None before the first, and for clouds.
    problems : list of str
        Times without frames, a sentence each for the first `MOST_GAPS`.
    dropped : int
        Frames that nobody took since `frames` was called, because they were busy with one before.
    dropped_at_start : int
        How many of them came during the first two frames.
    """

    def __init__(
        self, address: str, camera: Camera, *, silence: float = SILENCE_SECONDS, give_up: float = GIVE_UP_SECONDS
    ) -> None:
        self.path = Path(address)
        self.kind = f"live {camera.kind}"
        self.frame_count: int | None = None
        self.intrinsics: Intrinsics | None = None
        self.problems: list[str] = []
        self.dropped = 0
        self.dropped_at_start = 0
        self.on_event: Callable[[Event], object] | None = None
        self._camera = camera
        self._silence = silence
        self._give_up = give_up
        self._stream: Stream | None = None
        self._clock = ClockWatch()
        self._newest: Capture | None = None
        self._gaps = 0
        self._lost_before = 0

    def frames(self, start: int = 0, limit: int | None = None) -> Iterator[Event]:
        """The newest frame each time, until `limit` or without an end.

        While the camera gives nothing there is a `BadFrame` a second, which says why as far as that is known; its stamp
        is on the camera's clock. The first frame is waited for without them.

        Raises
        ------
        RecordingError
            If `start` is not 0, the camera is not there or fails, or gives nothing for half a minute.
        """
        if start:
            raise RecordingError(f"{self.path}: a live source has no beginning: leave out --start")
        return self._frames(limit)

    def _frames(self, limit: int | None) -> Iterator[Event]:
        self.close()
        self.dropped = self.dropped_at_start = 0
        self._clock, self._newest = ClockWatch(), None
        self._lost_before = self._lost()
        stream = self._stream = Stream(self._camera, self.on_event)
        begin = heard = time.monotonic()
        silent = 0.0
        try:
            for _ in itertools.count() if limit is None else range(limit):
                capture = self._wait_for_first(stream) if self._newest is None else stream.take(self._silence)
                if self._stream is not stream:
                    return
                if capture is None:
                    silent = time.monotonic() - heard
                    if silent >= self._give_up:
                        raise self._silent(stream, silent)
                    yield self._missing(stream, silent)
                    continue
                if silent:
                    self._note_gap(heard - begin, time.monotonic() - heard)
                    silent = 0.0
                self._took(capture, stream.dropped)
                yield capture.event
                # Whoever takes long over a frame is late, and the camera is not silent.
                heard = time.monotonic()
        finally:
            if silent:
                self._note_gap(heard - begin, silent)
            self._stop(stream)

    def _wait_for_first(self, stream: Stream) -> Capture:
        capture = stream.take(self._give_up)
        if capture is None:
            raise self._silent(stream, self._give_up)
        return capture

    def close(self) -> None:
        """Stop the camera and join its thread; a second call does nothing."""
        stream, self._stream = self._stream, None
        if stream is not None:
            self._stop(stream)

    def _stop(self, stream: Stream) -> None:
        if not stream.close():
            note(self.problems, f"the {self._camera.kind} hangs and did not stop: start it anew, or unplug it")

    def age(self) -> float:
        """Seconds since the stamp of the frame that was taken last; since its arrival where the camera's clock is not
        known or cannot be true."""
        assert self._newest is not None, "no frame was taken"
        return (time.monotonic_ns() - self._clock.moment(self._newest)) / 1e9

    def lines(self) -> list[str]:
        """What was dropped and what the stamps did, for people."""
        late = self.dropped - self.dropped_at_start
        return [
            f"dropped   {late} frames that came while an earlier one was worked on, "
            f"and {self.dropped_at_start} during the first two",
            *self.clock_lines(),
        ]

    def clock_lines(self) -> list[str]:
        """What the stamps did that a clock would not, and what was lost on the way, for people; most often nothing."""
        lost = self._lost() - self._lost_before
        lines = [f"lost      {lost} frames that came faster than they were read"] if lost else []
        return [*lines, *self._clock.lines()]

    def info(self) -> RecordingInfo:
        """Look at the camera for two seconds, and say what comes.

        Raises
        ------
        RecordingError
            If the camera is not there or fails, or gives nothing for half a minute.
        """
        stamps, name = StampStatistics(), ""
        size: tuple[int, int] | tuple[None, None] = None, None
        end: float | None = None
        for event in self._frames(None):
            end = end or time.monotonic() + INFO_SECONDS
            if isinstance(event, RgbdFrame):
                name = f"{event.depth.dtype} depth" + ("" if event.color is None else " and colour")
                size = event.intrinsics.width, event.intrinsics.height
            elif isinstance(event, CloudFrame):
                name = "points"
            if not isinstance(event, BadFrame):
                stamps.add(event.stamp_ns)
            if time.monotonic() > end:
                break
        self.close()
        return RecordingInfo(
            self.path,
            self.kind,
            (stamps.stream(str(self.path), name, *size),),
            stamps.duration,
            self.intrinsics,
            "none: a live source",
            tuple(self.problems),
        )

    def _took(self, capture: Capture, dropped: int) -> None:
        self.dropped = dropped
        if self._clock.frames < START_FRAMES + 1:
            self.dropped_at_start = dropped
        self._clock.add(capture)
        self._newest = capture
        if isinstance(capture.event, RgbdFrame):
            self.intrinsics = capture.event.intrinsics

    def _missing(self, stream: Stream, seconds: float) -> BadFrame:
        assert self._newest is not None
        since = time.monotonic_ns() - self._newest.arrival_ns
        why = stream.trouble or "is it still connected, and running?"
        return BadFrame(
            self._newest.event.stamp_ns + since, f"the {self._camera.kind} gave no frame for {seconds:.1f} s: {why}"
        )

    def _silent(self, stream: Stream, seconds: float) -> RecordingError:
        why = stream.trouble or "it is there, but silent: start it anew, or unplug it and plug it in again"
        return RecordingError(f"{self.path}: the {self._camera.kind} gave no frame for {seconds:.1f} s: {why}")

    def _lost(self) -> int:
        return int(getattr(self._camera, "lost", 0))

    def _note_gap(self, after: float, seconds: float) -> None:
        self._gaps += 1
        more = self._gaps - MOST_GAPS
        if more > 0:
            if more > 1:
                self.problems.remove(_more_gaps(more - 1))
            self.problems.append(_more_gaps(more))
            return
        note(self.problems, f"the {self._camera.kind} gave no frame for {seconds:.1f} s, {after:.1f} s after the start")


def _more_gaps(count: int) -> str:
    return f"and {count} more times without frames"
