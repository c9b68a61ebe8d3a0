"""The command line: words for people, no logic."""

from __future__ import annotations

import io
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import OmitArgPrefixes, arg

from ropetrace.cli_batch import Batch
from ropetrace.cli_compare import Compare
from ropetrace.cli_node import Node
from ropetrace.cli_record import Record, Recover
from ropetrace.cli_simulation import Reproduce, Simulate, parse_duration
from ropetrace.cli_source import Part, Source, TrackedRope
from ropetrace.cli_trace import Trace
from ropetrace.cli_tune import Tune
from ropetrace.errors import ConfigError, OutputError, RopetraceError
from ropetrace.terminal import BAD_INPUT, DAMAGED, INTERRUPTED, INTERRUPTS, NOTHING_FOUND, progress_bar

if TYPE_CHECKING:
    from ropetrace.config import RopeConfig
    from ropetrace.recordings import Recording

_DOCTOR_PICTURE = Path("ropetrace-doctor.png")


@dataclass(frozen=True)
class Demo:
    """Make a short RGB-D recording, track it, and say where the results are."""

    out: Annotated[Path, arg(aliases=["-o"])] = Path("ropetrace-demo")
    """The folder for the recording and the results."""

    def run(self) -> int:
        from ropetrace import demo
        from ropetrace.config import RopeConfig, format_color
        from ropetrace.recordings import open_recording

        recording_folder = self.out / "recording"
        try:
            self.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{self.out}: cannot be made: {error.strerror}") from None
        if not recording_folder.exists():
            print(f"making a recording of {demo.FRAMES} frames ...")
            demo.make_recording(recording_folder)
        config = RopeConfig(demo.DIAMETER, format_color(demo.COLOR))
        result, picture = self.out / "result.csv", self.out / "result.png"
        print("tracking it (the first run on a machine compiles for some seconds) ...")
        truth = _TruthOfDemo()
        code = _track(
            open_recording(recording_folder), config, [result], picture=picture, overwrite=True, extra_sinks=[truth]
        )
        print(f"error     {truth.mean() * 1e3:.2f} mm mean distance to the true centreline (symmetric)")
        print(f"recording {recording_folder}\nresult    {result}\npicture   {picture}")
        print(
            "the same by hand:\n"
            f"  ropetrace track {recording_folder} --diameter 12mm --color '{config.color}' --out my-result.csv"
        )
        return code


@dataclass(frozen=True)
class Track:
    """Track the rope through a recording.

    ropetrace track RECORDING --diameter 12mm --color '#c8281e' --out result.csv
    """

    source: OmitArgPrefixes[Source]
    rope: OmitArgPrefixes[TrackedRope]
    out: Annotated[tuple[Path, ...], arg(aliases=["-o"], metavar="FILE ...")] = ()
    """Results: .csv, .parquet, .npz, .mcap or .rrd; several may be given."""
    picture: Annotated[Path | None, arg(metavar="FILE")] = None
    """A picture of six frames spread over the run, with the centreline drawn over them."""
    mask: Annotated[Path | None, arg(metavar="FILE")] = None
    """An image of the frames' size, white where the rope may be; replaces the colour."""
    frame: Literal["camera", "world"] = "camera"
    """The frame of the results; world needs camera_pose in the config."""
    predict: Annotated[str | None, arg(metavar="now|DURATION")] = None
    """Write the centreline of a later time than the frame's stamp: a duration such as 40ms, or now, the moment at which
    the frame has been worked on; frames of a recording count as if they came at their stamps."""
    view: bool = False
    """Show it live in the Rerun viewer."""
    overwrite: bool = False
    """Replace results that exist."""

    def run(self) -> int:
        config = self.rope.settings(self.source.first_frames)
        predict = _prediction(self.predict, config)
        recording = self.source.open()
        return _track(
            recording,
            config,
            list(self.out),
            predict=predict,
            picture=self.picture,
            start=self.source.part.start,
            limit=self.source.part.limit,
            mask=self.mask,
            frame=self.frame,
            view=self.view,
            overwrite=self.overwrite,
            inputs=[path for path in (self.rope.config, self.mask) if path is not None],
        )


@dataclass(frozen=True)
class Info:
    """Say what is in a recording: streams, sizes, rates, gaps, intrinsics, damage."""

    source: OmitArgPrefixes[Source]

    def run(self) -> int:
        info = self.source.open().info()
        print(f"{info.path}: {info.kind}")
        header = ("stream", "encoding", "count", "size", "rate", "longest gap", "not rising")
        rows = [
            (
                stream.name,
                stream.encoding,
                str(stream.count),
                "" if stream.width is None else f"{stream.width}x{stream.height}",
                "" if stream.rate_hz is None else f"{stream.rate_hz:.2f} Hz",
                "" if stream.largest_gap is None else f"{stream.largest_gap * 1e3:.1f} ms",
                str(stream.not_rising),
            )
            for stream in info.streams
        ]
        widths = [max(len(row[k]) for row in [header, *rows]) for k in range(len(header))]
        for row in [header, *rows]:
            print("  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
        if info.duration is not None:
            print(f"duration   {info.duration:.3f} s")
        if info.intrinsics is not None:
            camera = info.intrinsics
            print(
                f"intrinsics {camera.width}x{camera.height}, fx {camera.fx:.3f}, fy {camera.fy:.3f}, "
                f"cx {camera.cx:.3f}, cy {camera.cy:.3f}"
            )
        print(f"checksums  {info.checksums}")
        for problem in info.problems:
            print(f"damage     {problem}")
        return DAMAGED if info.problems else 0


@dataclass(frozen=True)
class Doctor:
    """Find out why tracking fails on a recording, and which setting would help."""

    source: OmitArgPrefixes[Source]
    rope: OmitArgPrefixes[TrackedRope]
    picture: Path = _DOCTOR_PICTURE
    """Where to put the picture of what the gate keeps."""
    frames: int = 20
    """How many frames to look at, spread over the recording."""
    overwrite: bool = False
    """Replace a picture that exists; the default one is always replaced."""

    def run(self) -> int:
        from ropetrace.doctor import diagnose
        from ropetrace.picture import save_picture

        if not 1 <= self.frames <= 10_000:
            raise ConfigError(f"--frames {self.frames}: expected 1 to 10000")
        if self.picture.exists() and self.picture != _DOCTOR_PICTURE and not self.overwrite:
            raise OutputError(f"{self.picture} exists already: choose another name or give --overwrite")
        config = self.rope.settings(self.source.first_frames)
        recording = self.source.open()
        diagnosis = diagnose(_spread(recording, self.source.part, self.frames), config, recording.info())
        print("\n".join(diagnosis.lines()))
        if diagnosis.picture is not None:
            save_picture(diagnosis.picture, self.picture)
            print(f"picture of what passes: {self.picture}")
        return 0 if diagnosis.healthy else NOTHING_FOUND


def main() -> None:
    """The entry point: parse, run, and turn errors into one line and an exit code."""
    if sys.argv[1:] == ["--version"]:
        print(version("ropetrace"))
        return
    command = tyro.cli(
        Annotated[Demo, tyro.conf.subcommand("demo")]
        | Annotated[Track, tyro.conf.subcommand("track")]
        | Annotated[Batch, tyro.conf.subcommand("batch")]
        | Annotated[Record, tyro.conf.subcommand("record")]
        | Annotated[Recover, tyro.conf.subcommand("recover")]
        | Annotated[Info, tyro.conf.subcommand("info")]
        | Annotated[Doctor, tyro.conf.subcommand("doctor")]
        | Annotated[Tune, tyro.conf.subcommand("tune")]
        | Annotated[Simulate, tyro.conf.subcommand("simulate")]
        | Annotated[Trace, tyro.conf.subcommand("trace")]
        | Annotated[Node, tyro.conf.subcommand("node")]
        | Annotated[Compare, tyro.conf.subcommand("compare")]
        | Annotated[Reproduce, tyro.conf.subcommand("reproduce")],  # type: ignore[arg-type]
        prog="ropetrace",
        description="The 3-D shape of a rope, cable or hose from the recordings of an RGB-D camera. "
        "`ropetrace --version` tells the version.",
    )
    for stream in (sys.stdout, sys.stderr):
        # A name that the terminal cannot show must not end a run that is done.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    signal.signal(signal.SIGTERM, _interrupt)
    signal.signal(signal.SIGINT, _interrupt)
    try:
        code = command.run()
    except RopetraceError as error:
        print(f"ropetrace: {error}", file=sys.stderr)
        code = BAD_INPUT
    except KeyboardInterrupt:
        print("ropetrace: interrupted", file=sys.stderr)
        code = INTERRUPTED
    except BrokenPipeError:
        # Whoever reads our output has gone, as `ropetrace info | head` does.
        sys.stderr.close()
        code = 0
    sys.exit(code)


def _interrupt(number: int, frame: object) -> None:
    INTERRUPTS.append(number)
    raise KeyboardInterrupt


def _track(
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
    extra_sinks: list[Any] | None = None,
    inputs: list[Path] | None = None,
) -> int:
    from ropetrace.live import LiveRecording
    from ropetrace.motion import make_motion
    from ropetrace.picture import ContactSheet
    from ropetrace.recordings.base import has_color
    from ropetrace.results import check_outputs, open_writer
    from ropetrace.trackers import make_tracker
    from ropetrace.tracking import track_recording

    if frame == "world" and config.camera_pose is None:
        raise ConfigError("--frame world needs camera_pose in the config")
    if picture is not None and frame == "world":
        raise ConfigError("--picture draws in the camera's frame: leave out --frame world")
    live = recording if isinstance(recording, LiveRecording) else None
    sources = [*([] if live else [recording.path]), *(inputs or [])]
    check_outputs(outputs, overwrite, sources)
    for path in [_settings_of(path) for path in outputs] + ([] if picture is None else [picture]):
        if path.exists() and (not overwrite or any(path.samefile(source) for source in sources)):
            raise OutputError(f"{path} exists already: choose another name or give --overwrite")
    if config.asks_for_color and mask is None and not has_color(recording, start):
        raise ConfigError("a colour is asked for, but the recording has none: leave out the colour, or record it")
    tracker = make_tracker(config, None if mask is None else _mask(mask))
    resolved = config.resolved().to_toml()
    pose = config.world_from_camera() if frame == "world" else None
    contact = None if picture is None else ContactSheet(picture)
    with ExitStack() as stack:
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
        viewer = None
        if view:
            from ropetrace.results.live import LiveViewer

            viewer = stack.enter_context(LiveViewer(frame_name=frame, frame_from_camera=pose))
            sinks.append(viewer)
        if contact is not None:
            sinks.append(contact)
        sinks += extra_sinks or []
        if live is not None:
            stack.callback(live.close)
        total = None if recording.frame_count is None else max(recording.frame_count - start, 0)
        if limit is not None:
            total = limit if total is None else min(total, limit)
        with _progress(total) as advance:
            summary = track_recording(
                recording.frames(start, limit),
                tracker,
                sinks,
                motion=partial(make_motion, config.motion.method, config.diameter),
                predict=predict,
                first_index=start,
                world_from_camera=pose,
                wants_cloud=view or any(path.suffix.lower() == ".rrd" for path in outputs),
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
    # A live source has no other end.
    if summary.interrupted and live is None:
        print("ropetrace: interrupted; what was tracked until then is written", file=sys.stderr)
        return INTERRUPTED
    if recording.problems:
        print("ropetrace: part of the recording was lost (see damage above)", file=sys.stderr)
        return DAMAGED
    if not summary.frames:
        print(f"ropetrace: there is no frame at or after --start {start}", file=sys.stderr)
        return NOTHING_FOUND
    if not summary.found:
        print(
            "ropetrace: no frame gave an estimate; `ropetrace doctor` with the same arguments says why",
            file=sys.stderr,
        )
        return NOTHING_FOUND
    return 0


@contextmanager
def _progress(total: int | None) -> Iterator[Any]:
    """A bar of frames that is told of statuses."""
    with progress_bar(total, "frame") as bar:

        def advance(status: str) -> None:
            bar.set_postfix_str(status, refresh=False)
            bar.update()

        yield advance


LONGEST_PREDICTION = 1.0
"""Seconds: further ahead no extrapolation of a rope's motion means anything."""


def _prediction(text: str | None, config: RopeConfig) -> float | Literal["now"]:
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


def _spread(recording: Recording, part: Part, count: int) -> Iterator[Any]:
    """About `count` frames over the recording, or over the part of it that is asked for."""
    available = part.limit or (None if recording.frame_count is None else recording.frame_count - part.start)
    every = 1 if available is None else max(available // count, 1)
    for index, event in enumerate(recording.frames(part.start, part.limit or count * every)):
        if index % every == 0:
            yield part.start + index, event


class _TruthOfDemo:
    """A sink that compares the demo's estimates with the curves that it was made of."""

    def __init__(self) -> None:
        self._errors: list[float] = []

    def write(self, index: int, estimate: Any, frame: Any, cloud: Any) -> None:
        from ropetrace import demo
        from ropetrace.evaluation.metrics import symmetric_mean

        if len(estimate.waypoints) > 1:
            truth = demo.rope_curve(estimate.stamp_ns / 1e9)
            self._errors.append(symmetric_mean(estimate.waypoints.positions, truth))

    def mean(self) -> float:
        """Metres."""
        return sum(self._errors) / max(len(self._errors), 1)


if __name__ == "__main__":
    main()
