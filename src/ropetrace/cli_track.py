"""`ropetrace track`, and what the commands that track share: words for people, no logic."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, arg

from ropetrace.cli_simulation import parse_duration
from ropetrace.cli_source import Source, TrackedRope
from ropetrace.errors import ConfigError, OutputError, RopetraceError
from ropetrace.terminal import BAD_INPUT, DAMAGED, INTERRUPTED, INTERRUPTS, NOTHING_FOUND, Interruption, progress_bar

if TYPE_CHECKING:
    from ropetrace.config import RopeConfig
    from ropetrace.recordings import Recording
    from ropetrace.types import Event, FloatArray


@dataclass(frozen=True)
class Results:
    """Where the results go, and what they tell."""

    out: Annotated[tuple[Path, ...], arg(aliases=["-o"], metavar="FILE ...")] = ()
    """Results: .csv, .parquet, .npz, .mcap or .rrd; several may be given."""
    mask: Annotated[Path | None, arg(metavar="FILE")] = None
    """An image of the frames' size, white where the rope may be; replaces the colour."""
    frame: Literal["camera", "world"] = "camera"
    """The frame of the results; world needs camera_pose in the config."""
    predict: Annotated[str | None, arg(metavar="now|DURATION")] = None
    """Write the centreline of a later time than the frame's stamp: a duration such as 40ms, or now, the moment at which
    the frame has been worked on; frames of a recording count as if they came at their stamps."""
    overwrite: bool = False
    """Replace results that exist."""


@dataclass(frozen=True)
class Track:
    """Track the rope through a recording.

    ropetrace track RECORDING --diameter 12mm --color '#c8281e' --out result.csv
    """

    source: OmitArgPrefixes[Source]
    rope: OmitArgPrefixes[TrackedRope]
    results: OmitArgPrefixes[Results]
    picture: Annotated[Path | None, arg(metavar="FILE")] = None
    """A picture of six frames spread over the run, with the centreline drawn over them."""
    view: bool = False
    """Show it live in the Rerun viewer."""

    def run(self) -> int:
        config = self.rope.settings(self.source.first_frames)
        predict = prediction(self.results.predict, config)
        recording = self.source.open()
        return track(
            recording,
            config,
            list(self.results.out),
            predict=predict,
            picture=self.picture,
            start=self.source.part.start,
            limit=self.source.part.limit,
            mask=self.results.mask,
            frame=self.results.frame,
            view=self.view,
            overwrite=self.results.overwrite,
            inputs=[path for path in (self.rope.config, self.results.mask) if path is not None],
        )


def track(
    recording: Recording,
    config: RopeConfig,
    outputs: list[Path],
    *,
    predict: float | Literal["now"] = 0.0,
    picture: Path | None = None,
    start: int = 0,
    limit: int | None = None,
    mask: Path | None = None,
    frame: str = "camera",
    view: bool = False,
    overwrite: bool = False,
    extra_sinks: Sequence[Any] = (),
    inputs: Sequence[Path] = (),
    served: bool = False,
) -> int:
    """Track a recording, write the results and print what came of it; the exit code.

    Parameters
    ----------
    extra_sinks : sequence of Sink
        Are given every estimate, too.
    inputs : sequence of Path
        Files that must not be overwritten.
    served : bool
        Whether `extra_sinks` show pictures to people: a recording is then tracked at its own pace, and an interrupt is
        its ordinary end, as it is for a live source.
    """
    from ropetrace.live import LiveRecording
    from ropetrace.motion import make_motion
    from ropetrace.picture import ContactSheet
    from ropetrace.recordings.base import check_color, frames_to_come
    from ropetrace.results import GROWING, check_outputs, open_writer
    from ropetrace.trackers import make_tracker
    from ropetrace.tracking import track_recording

    pose = pose_of(config, frame)
    if picture is not None and frame == "world":
        raise ConfigError("--picture draws in the camera's frame: leave out --frame world")
    live = recording if isinstance(recording, LiveRecording) else None
    sources = [*([] if live else [recording.path]), *inputs]
    check_outputs(outputs, overwrite, sources)
    for path in outputs:
        if live and limit is None and path.suffix.lower() in GROWING:
            raise ConfigError(
                f"{path}: {path.suffix} is kept in memory until the end, and a camera has none: take .csv or .mcap, "
                "or give --limit"
            )
    for path in [_settings_of(path) for path in outputs] + ([] if picture is None else [picture]):
        if path.exists() and (not overwrite or any(path.samefile(source) for source in sources)):
            raise OutputError(f"{path} exists already: choose another name or give --overwrite")
    check_color(recording, config.asks_for_color and mask is None, start)
    tracker = make_tracker(config, None if mask is None else _mask(mask))
    resolved = config.resolved().to_toml()
    contact = None if picture is None else ContactSheet(picture)
    with ExitStack() as stack:
        viewer = None
        if view:
            from ropetrace.results.live import LiveViewer

            # Before the writers, which replace earlier results: there may be no screen.
            viewer = stack.enter_context(LiveViewer(frame_name=frame, frame_from_camera=pose))
        sinks: list[Any] = [
            stack.enter_context(
                open_writer(
                    path, overwrite=overwrite, frame_name=frame, metadata={"config": resolved}, frame_from_camera=pose
                )
            )
            for path in outputs
        ]
        for path in outputs:
            _write_config(_settings_of(path), resolved)
        if viewer is not None:
            sinks.append(viewer)
        if contact is not None:
            sinks.append(contact)
        sinks += extra_sinks
        if live is not None:
            stack.callback(live.close)
        events = _Events(recording.frames(start, limit))
        with _progress(frames_to_come(recording, start, limit)) as advance, Interruption() as interruption:
            summary = track_recording(
                interruption.ending_waits(at_own_pace(events) if served and live is None else events),
                tracker,
                sinks,
                motion=partial(make_motion, config.motion.method, config.diameter),
                predict=predict,
                first_index=start,
                world_from_camera=pose,
                wants_cloud=view or served or any(path.suffix.lower() == ".rrd" for path in outputs),
                age=None if live is None else live.age,
                on_frame=lambda estimate: advance(str(estimate.status)),
                should_stop=lambda: bool(INTERRUPTS),
            )
    if contact is not None:
        contact.save()
    print("\n".join(summary.lines() + ([] if live is None else live.lines())))
    for problem in recording.problems:
        print(f"damage    {problem}")
    for path in outputs:
        print(f"written   {path} (settings: {path.name}.toml)")
    if viewer is not None and viewer.skipped:
        print(f"viewer    skipped {viewer.skipped} frames to keep up")
    kept = "; what was tracked until then is written" if outputs else ""
    if events.fault is not None:
        print(f"ropetrace: {events.fault}{kept}", file=sys.stderr)
        return BAD_INPUT
    # A live source has no other end.
    if summary.interrupted and live is None and not served:
        print(f"ropetrace: interrupted{kept}", file=sys.stderr)
        return INTERRUPTED
    if recording.problems:
        print("ropetrace: part of the recording was lost (see damage above)", file=sys.stderr)
        return DAMAGED
    if not summary.frames and not (served and summary.interrupted):
        print(f"ropetrace: there is no frame at or after --start {start}", file=sys.stderr)
        return NOTHING_FOUND
    if summary.frames and not summary.found:
        print(
            "ropetrace: no frame gave an estimate; `ropetrace doctor` with the same arguments says why",
            file=sys.stderr,
        )
        return NOTHING_FOUND
    return 0


def pose_of(config: RopeConfig, frame: str) -> FloatArray | None:
    """The camera's pose in the frame of the results, (4, 4); None for the camera's own. ConfigError if not known."""
    if frame == "camera":
        return None
    if config.camera_pose is None:
        raise ConfigError("--frame world needs camera_pose in the config")
    return config.world_from_camera()


class _Events:
    """The events of a source. A fault after the first of them is their end, and is kept."""

    def __init__(self, events: Iterable[Event]) -> None:
        self.fault: RopetraceError | None = None
        self._events = events

    def __iter__(self) -> Iterator[Event]:
        any_came = False
        try:
            for event in self._events:
                any_came = True
                yield event
        except RopetraceError as error:
            if not any_came:
                raise
            self.fault = error


def at_own_pace(events: Iterable[Event]) -> Iterator[Event]:
    """Each event of a recording as long after the one before as by the stamps, and not after more than `LONGEST_GAP`.

    Whoever is late stays late: nothing is rushed to catch up.
    """
    due, before = time.monotonic(), None
    for event in events:
        if before is not None:
            due += min(max(event.stamp_ns - before, 0) / 1e9, LONGEST_GAP)
        before = event.stamp_ns
        now = time.monotonic()
        if now < due:
            time.sleep(due - now)
        else:
            due = now
        yield event


@contextmanager
def _progress(total: int | None) -> Iterator[Any]:
    """A bar of frames that is told of statuses."""
    with progress_bar(total, "frame") as bar:

        def advance(status: str) -> None:
            bar.set_postfix_str(status, refresh=False)
            bar.update()

        yield advance


LONGEST_GAP = 2.0
"""Seconds."""

LONGEST_PREDICTION = 1.0
"""Seconds: further ahead no extrapolation of a rope's motion means anything."""


def prediction(text: str | None, config: RopeConfig) -> float | Literal["now"]:
    """What --predict asks for, checked."""
    if text is None:
        return 0.0
    if config.motion.method == "none":
        raise ConfigError('--predict needs the motion of the rope: take motion.method = "none" out of the config')
    if text == "now":
        return "now"
    try:
        seconds = parse_duration(text)
    except ConfigError as error:
        raise ConfigError(f"--predict: {error}, or now") from None
    if not 0 <= seconds <= LONGEST_PREDICTION:
        raise ConfigError(f"--predict {text}: expected 0 to {LONGEST_PREDICTION:g} s")
    return seconds


def _settings_of(path: Path) -> Path:
    """Where the settings of a result are kept."""
    return path.with_name(path.name + ".toml")


def _write_config(path: Path, text: str) -> None:
    try:
        path.write_text(f"# ropetrace {version('ropetrace')}, {time.strftime('%Y-%m-%d')}\n{text}", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from None


def _mask(path: Path) -> Any:
    import numpy as np
    from PIL import Image

    try:
        if not path.is_file():
            raise OSError("not a file")
        with Image.open(path) as image:
            return np.asarray(image.convert("L")) > 127
    except (OSError, Image.DecompressionBombError) as error:
        raise ConfigError(f"--mask {path}: cannot be read as an image: {error}") from None
