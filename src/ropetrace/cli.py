"""The command line: words for people, no logic."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from tyro.conf import OmitArgPrefixes, arg

from ropetrace.cli_batch import Batch
from ropetrace.cli_compare import Compare
from ropetrace.cli_node import Node
from ropetrace.cli_record import Record, Recover
from ropetrace.cli_serve import Serve
from ropetrace.cli_simulation import Reproduce, Simulate
from ropetrace.cli_source import Part, Source, TrackedRope
from ropetrace.cli_trace import Trace
from ropetrace.cli_track import Track, track
from ropetrace.cli_tune import Tune
from ropetrace.errors import ConfigError, OutputError, RopetraceError
from ropetrace.terminal import (
    BAD_INPUT,
    DAMAGED,
    INTERRUPTED,
    INTERRUPTS,
    NOTHING_FOUND,
    interrupt,
    is_unread,
    on_endings,
)

if TYPE_CHECKING:
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
        code = track(
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
        | Annotated[Serve, tyro.conf.subcommand("serve")]
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
    on_endings(interrupt)
    try:
        code = _run(command)
    except OSError as error:
        if not is_unread(error):
            raise
        # Nor is what Python would still say when it ends.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            os.dup2(nowhere, stream.fileno())
        code = INTERRUPTED if INTERRUPTS else 0
    sys.exit(code)


def _run(command: Any) -> int:
    try:
        return int(command.run())
    except RopetraceError as error:
        print(f"ropetrace: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("ropetrace: interrupted", file=sys.stderr)
        return INTERRUPTED


def _spread(recording: Recording, part: Part, count: int) -> Iterator[Any]:
    """About `count` frames over the recording, or over the part of it that is asked for."""
    from ropetrace.recordings.base import frames_to_come

    available = frames_to_come(recording, part.start, part.limit)
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
