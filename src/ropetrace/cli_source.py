"""What the commands on recordings are told of the recording and of the rope: words for people, no logic."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from tyro.conf import OmitArgPrefixes, arg

from ropetrace.errors import ConfigError

if TYPE_CHECKING:
    from ropetrace.config import RopeConfig
    from ropetrace.recordings import Recording

_MOST_FRAMES = 10**12


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

    def open(self, recording: Path) -> Recording:
        """Open a recording."""
        from ropetrace.recordings import open_recording

        self.check()
        return open_recording(
            recording,
            rate=self.rate,
            depth_topic=self.depth_topic,
            color_topic=self.color_topic,
            cloud_topic=self.cloud_topic,
        )


@dataclass(frozen=True)
class Source:
    """Which recording, and which part of it."""

    recording: Annotated[Path, tyro.conf.Positional, arg(metavar="RECORDING")]
    """An RGB-D folder, a ROS 2 bag (.mcap, .db3, or their folder), a ROS 1 .bag, or point clouds (a folder of .npy,
    .npz, .ply, .pcd, or one of them)."""
    part: OmitArgPrefixes[Part]

    def open(self) -> Recording:
        """Open the recording."""
        return self.part.open(self.recording)


@dataclass(frozen=True)
class Rope:
    """What is known of the rope."""

    diameter: Annotated[str | None, arg(aliases=["-d"], metavar="LENGTH")] = None
    """The rope's diameter, such as 12mm. Needed here or in the config."""
    color: Annotated[str | None, arg(aliases=["-c"], metavar="'#RRGGBB'")] = None
    """The rope's colour in full light, such as '#c8281e'. Without it, everything with depth is rope."""
    config: Annotated[Path | None, arg(metavar="FILE")] = None
    """A TOML file with further settings; those given here count first."""

    def settings(self) -> RopeConfig:
        """The settings of the file and the command line together."""
        from ropetrace.config import RopeConfig

        given = self._given()
        if self.config is not None:
            return RopeConfig.from_toml(self.config, **given)
        if self.diameter is None:
            raise ConfigError("the rope's diameter is missing: give --diameter, such as --diameter 12mm")
        return RopeConfig(**{name: value for name, value in given.items() if value is not None})

    def _given(self) -> dict[str, Any]:
        """Top-level settings; None where the command line says nothing."""
        from ropetrace.config import parse_length

        return {"diameter": None if self.diameter is None else parse_length(self.diameter), "color": self.color}


@dataclass(frozen=True)
class TrackedRope(Rope):
    """What is known of the rope, and what tracks it."""

    method: Annotated[str | None, arg(metavar="NAME")] = None
    """The tracker: slicing (the default), schulman, cpd, gltp, spr, trackdlo or cdcpd."""

    def _given(self) -> dict[str, Any]:
        return super()._given() | {"method": self.method}
