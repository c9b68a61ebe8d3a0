"""What the commands on recordings are told of the recording and of the rope: words for people, no logic."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import tyro
from tyro.conf import OmitArgPrefixes, arg

from ropetrace.errors import ConfigError

if TYPE_CHECKING:
    from ropetrace.config import RopeConfig
    from ropetrace.recordings import Recording
    from ropetrace.types import Frame

_MOST_FRAMES = 10**12

_FIRST_FRAMES = 15
"""Frames that are looked at for a diameter or a colour that is not given."""

AUTO = "auto"


@dataclass(frozen=True)
class Part:
    """Which part of a recording."""

    rate: Annotated[float | None, arg(metavar="HZ")] = None
    """Frames per second, for recordings without stamps."""
    start: Annotated[int, arg(metavar="N")] = 0
    """Frames to skip."""
    limit: Annotated[int | None, arg(metavar="N")] = None
    """Frames to use at most."""
    depth_topic: Annotated[str | None, arg(metavar="TOPIC")] = None
    """ROS: the depth images. Found by type if not given."""
    color_topic: Annotated[str | None, arg(metavar="TOPIC")] = None
    """ROS: the colour images. Found by type if not given."""
    cloud_topic: Annotated[str | None, arg(metavar="TOPIC")] = None
    """ROS: point clouds, in the place of depth images."""

    def check(self) -> None:
        """Refuse numbers of frames that cannot be."""
        if not 0 <= self.start <= _MOST_FRAMES:
            raise ConfigError(f"--start {self.start}: expected 0 to {_MOST_FRAMES}")
        if self.limit is not None and not 1 <= self.limit <= _MOST_FRAMES:
            raise ConfigError(f"--limit {self.limit}: expected 1 to {_MOST_FRAMES}")

    def open(self, recording: Path, live: bool = False) -> Recording:
        """Open a recording, or a live source if that may be."""
        from ropetrace.live import scheme_of
        from ropetrace.recordings import open_recording

        self.check()
        if scheme_of(recording) is not None:
            if not live:
                raise ConfigError(f"{recording}: a live source is never twice the same: give a recording")
            if self.start:
                raise ConfigError(f"--start {self.start}: a live source begins when it is opened: leave out --start")
        return open_recording(recording, **self.options())

    def options(self) -> dict[str, Any]:
        """What `open_recording` is told of any recording."""
        return {name: getattr(self, name) for name in ("rate", "depth_topic", "color_topic", "cloud_topic")}


@dataclass(frozen=True)
class Source:
    """Which recording, and which part of it."""

    recording: Annotated[Path, tyro.conf.Positional, arg(metavar="RECORDING")]
    """An RGB-D folder, a ROS 2 bag (.mcap, .db3, or their folder), a ROS 1 .bag, or point clouds (a folder of .npy,
    .npz, .ply, .pcd, or one of them). Live: sim:SCENARIO, realsense:, realsense:SERIAL, ros2:,
    ros2:tcp/HOST:PORT or ros1:."""
    part: OmitArgPrefixes[Part]

    def open(self) -> Recording:
        """Open the recording."""
        return self.part.open(self.recording, live=True)

    def first_frames(self) -> list[Frame]:
        """The first frames of the part, without bad ones."""
        from ropetrace.types import BadFrame

        limit = min(self.part.limit or _FIRST_FRAMES, _FIRST_FRAMES)
        return [frame for frame in self.open().frames(self.part.start, limit) if not isinstance(frame, BadFrame)]


@dataclass(frozen=True)
class Rope:
    """What is known of the rope."""

    diameter: Annotated[str | None, arg(aliases=["-d"], metavar="LENGTH|auto")] = None
    """The rope's diameter, such as 12mm, or auto: as the first frames show it. Needed here or in the config."""
    color: Annotated[str | None, arg(aliases=["-c"], metavar="'#RRGGBB'|auto|@COLUMN,ROW")] = None
    """The rope's colour in full light, such as '#c8281e'; auto: that of the largest thin thing that moves; @COLUMN,ROW:
    that of the thing at a pixel of the first frame. Without it, everything with depth is rope."""
    config: Annotated[Path | None, arg(metavar="FILE")] = None
    """A TOML file with further settings; those given here count first."""

    def settings(self, first_frames: Callable[[], list[Frame]] | None = None) -> RopeConfig:
        """The settings of the file and the command line together.

        Parameters
        ----------
        first_frames : callable, optional
            Where frames come from if the diameter or the colour is to be found in them.
        """
        from ropetrace.config import RopeConfig

        if self.diameter == AUTO or self._seeks_color:
            if first_frames is None:
                raise ConfigError("auto and @COLUMN,ROW are for track and doctor: use what `ropetrace track` finds")
            frames = first_frames()
            found = self._found(frames)
            config = found.settings()
            _print_contradictions(config, frames)
            return config
        given = self._given()
        if self.config is not None:
            return RopeConfig.from_toml(self.config, **given)
        if self.diameter is None:
            raise ConfigError("the rope's diameter is missing: give --diameter, such as --diameter 12mm, or auto")
        return RopeConfig(**{name: value for name, value in given.items() if value is not None})

    @property
    def _seeks_color(self) -> bool:
        return self.color is not None and (self.color == AUTO or self.color.startswith("@"))

    def _given(self) -> dict[str, Any]:
        """Top-level settings; None where the command line says nothing."""
        from ropetrace.config import parse_length

        return {"diameter": None if self.diameter is None else parse_length(self.diameter), "color": self.color}

    def _found(self, frames: list[Frame]) -> Self:
        """The same with the diameter and the colour that the frames show; told on stderr."""
        from ropetrace.config import parse_length, read_toml
        from ropetrace.proposal import propose_color, propose_color_at, propose_diameter

        if not frames:
            raise ConfigError("there is no frame to look for the rope in: give --diameter and --color")
        table = {} if self.config is None else read_toml(self.config)
        color, diameter = self.color or table.get("color"), self.diameter or table.get("diameter")
        if self.color is not None and self._seeks_color:
            if self.color == AUTO:
                proposal = propose_color(frames, None if diameter in (None, AUTO) else parse_length(diameter))
            else:
                proposal = propose_color_at(frames[0], *_pixel(self.color))
            print(
                f"color     {'; '.join(proposal.reasons)} (confidence {proposal.confidence:.2f}); "
                "if this is not the rope, give --color '#rrggbb' or --color @COLUMN,ROW",
                file=sys.stderr,
            )
            color = proposal.color
        if self.diameter == AUTO:
            size = propose_diameter(frames, color)
            print(f"diameter  {'; '.join([size.text(), *size.reasons])}", file=sys.stderr)
            diameter = round(size.diameter, 5)
        return replace(self, color=color, diameter=None if diameter is None else str(diameter))


def _pixel(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"@(\d{1,5}),(\d{1,5})", text)
    if match is None:
        raise ConfigError(f"--color {text}: write the pixel like @320,240: column, row")
    return int(match[1]), int(match[2])


def _ropes(text: str) -> int | str:
    if text != AUTO and not text.isdecimal():
        raise ConfigError(f"--ropes {text}: expected a number, or {AUTO}")
    return AUTO if text == AUTO else int(text)


def _print_contradictions(config: RopeConfig, frames: list[Frame]) -> None:
    from ropetrace.proposal import contradictions

    for trouble in contradictions(config, frames):
        print(f"warning   {trouble}", file=sys.stderr)


@dataclass(frozen=True)
class TrackedRope(Rope):
    """What is known of the rope, and what tracks it."""

    method: Annotated[str | None, arg(metavar="NAME")] = None
    """The tracker: persistent (the default), slicing, schulman, cpd, gltp, spr, trackdlo or cdcpd."""
    ropes: Annotated[str | None, arg(metavar="N|auto")] = None
    """How many ropes are followed: 1 by default, or auto for all that are seen. With the method persistent alone."""

    def _given(self) -> dict[str, Any]:
        return super()._given() | {"method": self.method, "ropes": None if self.ropes is None else _ropes(self.ropes)}
