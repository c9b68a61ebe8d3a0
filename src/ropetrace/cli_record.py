"""The commands that record, and that finish a recording which was killed: words for people, no logic."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from tyro.conf import OmitArgPrefixes, arg

from ropetrace.cli_source import Source, TrackedRope
from ropetrace.errors import OutputError, RopetraceError
from ropetrace.terminal import BAD_INPUT, DAMAGED, INTERRUPTED, INTERRUPTS, NOTHING_FOUND, Interruption, progress_bar

if TYPE_CHECKING:
    from ropetrace.config import RopeConfig
    from ropetrace.live import LiveRecording
    from ropetrace.recorder import BackgroundRecorder
    from ropetrace.recordings import Recording
    from ropetrace.trackers import Tracker
    from ropetrace.tracking import Summary
    from ropetrace.types import Cloud, Estimate, Event, Frame


@dataclass(frozen=True)
class Record:
    """Record frames in an .mcap file of which a kill takes nothing. With a rope, track it too.

    ropetrace record SOURCE --out recording.mcap

    ropetrace record SOURCE --out recording.mcap --diameter 12mm --color '#c8281e'
    """

    source: OmitArgPrefixes[Source]
    rope: OmitArgPrefixes[TrackedRope]
    out: Annotated[Path, arg(aliases=["-o"], metavar="FILE")]
    """The recording: .mcap."""
    overwrite: bool = False
    """Replace a file that exists."""

    def run(self) -> int:
        from ropetrace.recorder import BackgroundRecorder, Recorder
        from ropetrace.recordings.base import check_color
        from ropetrace.results import check_outputs
        from ropetrace.trackers import make_tracker

        if self.out.suffix.lower() != ".mcap":
            raise OutputError(f"{self.out}: a recording is an .mcap file")
        inputs = [self.source.recording, *([] if self.rope.config is None else [self.rope.config])]
        check_outputs([self.out], self.overwrite, inputs)
        config = self._config()
        recording = self.source.open()
        if config is not None:
            check_color(recording, config.asks_for_color, self.source.part.start)
        tracker = None if config is None else make_tracker(config)
        metadata = {} if config is None else {"config": config.resolved().to_toml()}
        recorder = Recorder(self.out, overwrite=self.overwrite, metadata=metadata)
        with BackgroundRecorder(recorder) as background:
            run = _Run(self.source, recording, background)
            summary = run.frames() if config is None or tracker is None else run.tracked(config, tracker)
        return run.tell(summary, config is not None)

    def _config(self) -> RopeConfig | None:
        if all(getattr(self.rope, item.name) is None for item in fields(self.rope)):
            return None
        return self.rope.settings(self.source.first_frames)


@dataclass(frozen=True)
class Recover:
    """Finish a recording whose recorder was killed, so that other tools can read it too: in place, in one pass."""

    recording: Annotated[Path, tyro.conf.Positional, arg(metavar="FILE")]
    """An .mcap file of `ropetrace record`, or of `ropetrace track`."""

    def run(self) -> int:
        from ropetrace.recordings.mcap_recover import recover

        size = self.recording.stat().st_size if self.recording.is_file() else None
        with progress_bar(size, "B") as bar:
            found = recover(self.recording, bar.update)
        if found.was_whole:
            print(f"{self.recording} is whole: {found.messages} messages; nothing was changed")
        else:
            print(
                f"{self.recording}: {found.messages} messages; finished, after {found.cut} bytes were cut off its end"
            )
        return 0


class _Run:
    """The frames on their way to the recorder, and what became of them."""

    def __init__(self, source: Source, recording: Recording, recorder: BackgroundRecorder) -> None:
        from ropetrace.live import LiveRecording

        self._part = source.part
        self._recording = recording
        self._recorder = recorder
        self._live = recording if isinstance(recording, LiveRecording) else None
        self._came = 0
        self._unreadable = 0
        self._tracked = 0
        self._last: Event | None = None
        self._fault: RopetraceError | None = None

    def frames(self) -> Summary:
        """Record without tracking."""
        from ropetrace.tracking import Summary

        summary = Summary()
        with self._bar() as bar, closing(self._events()) as events, Interruption() as interruption:
            try:
                for _ in interruption.ending_waits(events):
                    self._show(bar)
                    if self._should_stop():
                        break
            except KeyboardInterrupt:
                summary.interrupted = True
        summary.interrupted |= bool(INTERRUPTS)
        return summary

    def tracked(self, config: RopeConfig, tracker: Tracker) -> Summary:
        """Record and track; each frame is on its way to the disk before it is tracked."""
        from ropetrace.motion import make_motion
        from ropetrace.tracking import track_recording

        with self._bar() as bar, closing(self._events()) as events, Interruption() as interruption:
            return track_recording(
                interruption.ending_waits(events),
                tracker,
                [self],
                motion=partial(make_motion, config.motion.method, config.diameter),
                first_index=self._part.start,
                age=None if self._live is None else self._live.age,
                on_frame=lambda estimate: self._show(bar),
                should_stop=self._should_stop,
            )

    def write(self, index: int, estimate: Estimate, frame: Frame | None = None, cloud: Cloud | None = None) -> None:
        """Hand over an estimate; of a file it waits for the disk, as the frames do. A `ropetrace.tracking.Sink`."""
        if self._live is None:
            self._recorder.put_estimate(estimate)
        else:
            self._recorder.write(index, estimate)

    def tell(self, summary: Summary, tracked: bool) -> int:
        """Say what came of it; the exit code."""
        recorder, recording = self._recorder, self._recording
        written = recorder.recorder
        print(f"recorded  {written.frames} frames, {written.size / 1e6:.1f} MB")
        if recorder.dropped or recorder.dropped_estimates:
            print(
                f"lost      {recorder.dropped} frames and {recorder.dropped_estimates} estimates that the disk was too "
                "slow or too full for"
            )
        for reason, count in recorder.refused.items():
            print(f"refused   {count} x {reason}")
        if self._unreadable:
            print(f"left out  {self._unreadable} frames that the source could not give")
        if tracked:
            print("\n".join(summary.lines()))
            untracked = self._came - self._unreadable - self._tracked
            if untracked:
                print(f"untracked {untracked} frames that came while the tracker was busy with an earlier one")
        for line in [] if self._live is None else self._live.clock_lines():
            print(line)
        for problem in recording.problems:
            print(f"damage    {problem}")
        fault = recorder.failure or self._fault
        if fault is not None:
            kept = "; what was recorded before is kept" if written.frames else ""
            print(f"ropetrace: {fault}{kept}", file=sys.stderr)
            return BAD_INPUT
        if written.frames:
            print(f"written   {written.path}")
        # A live source has no other end.
        interrupted = summary.interrupted and self._live is None
        if not written.frames:
            print(f"ropetrace: {'interrupted; ' * interrupted}no frame was recorded", file=sys.stderr)
            return INTERRUPTED if interrupted else NOTHING_FOUND
        if interrupted:
            print("ropetrace: interrupted; what was recorded until then is kept", file=sys.stderr)
            return INTERRUPTED
        if recording.problems or recorder.dropped or recorder.refused or self._unreadable:
            print("ropetrace: part of the frames is not in the recording (see above)", file=sys.stderr)
            return DAMAGED
        if recorder.dropped_estimates:
            print("ropetrace: part of the estimates is not in the recording (see above)", file=sys.stderr)
            return DAMAGED
        return 0

    def _events(self) -> Generator[Event]:
        """The frames that are to be tracked; all are recorded, and a fault of the source ends them."""
        from ropetrace.types import BadFrame

        try:
            for event in self._from_file() if self._live is None else self._from_camera(self._live):
                self._tracked += not isinstance(event, BadFrame)
                yield event
        except RopetraceError as error:
            if not self._came:
                raise
            self._fault = error

    def _from_file(self) -> Generator[Event]:
        """Every frame; it waits for the disk."""
        for event in self._recording.frames(self._part.start, self._part.limit):
            self._take(event, self._recorder.put)
            yield event

    def _from_camera(self, live: LiveRecording) -> Generator[Event]:
        """The newest frame each time, while the camera's thread has every frame recorded."""
        live.on_event = self._take_until_limit
        try:
            for event in live.frames():
                last = self._last
                if last is None or event is last:
                    yield event
                if last is not None:
                    return
        finally:
            live.close()

    def _take_until_limit(self, event: Event) -> None:
        if self._last is None:
            self._take(event, self._recorder.offer)
            if self._came == self._part.limit:
                self._last = event

    def _take(self, event: Event, hand_over: Callable[[Frame], object]) -> None:
        from ropetrace.types import BadFrame

        self._came += 1
        if isinstance(event, BadFrame):
            self._unreadable += 1
        else:
            hand_over(event)

    def _should_stop(self) -> bool:
        return bool(INTERRUPTS) or self._recorder.failure is not None

    def _bar(self) -> Any:
        from ropetrace.recordings.base import frames_to_come

        return progress_bar(frames_to_come(self._recording, self._part.start, self._part.limit), "frame")

    def _show(self, bar: Any) -> None:
        """The frames that no kill can take any more; those in the queue are not among them."""
        if self._recorder.dropped:
            bar.set_postfix_str(f"{self._recorder.dropped} lost, the disk is too slow", refresh=False)
        bar.update(self._recorder.recorder.frames - bar.n)
