"""Finding the settings of a rope by eye: the state behind the page of `ropetrace tune`, which knows of no browser."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ropetrace.config import RopeConfig, from_table
from ropetrace.errors import ConfigError, FrameError, RecordingError
from ropetrace.proposal import propose_color_at, propose_diameter
from ropetrace.recordings import Recording
from ropetrace.trackers import make_tracker
from ropetrace.trackers.persistent import PersistentTracker
from ropetrace.trackers.slicing import SlicingTracker
from ropetrace.types import BadFrame, Cloud, Estimate, Event, FloatArray, moved

UNKNOWN_DIAMETER = 0.012
"""What is begun with where no diameter is given, metres: the first click measures it."""

TUNED = (
    "diameter",
    "color",
    "segmentation.color_tolerance",
    "segmentation.box_min",
    "segmentation.box_max",
    "slicing.variance_threshold",
    "slicing.min_points",
)
"""The settings that can be changed."""


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """What the settings make of one frame, seen as the first: nothing of the frames before it counts.

    Parameters
    ----------
    index : int
        The frame's place in the recording.
    event : RgbdFrame, CloudFrame or BadFrame
        The frame.
    cloud : Cloud
        What passes; where too much does, every k-th point of it.
    slices : (K, 3) float array
        The centroids of its slices, metres, camera frame.
    estimates : tuple of Estimate
        One a rope.
    """

    index: int
    event: Event
    cloud: Cloud
    slices: FloatArray
    estimates: tuple[Estimate, ...]


class Tuning:
    """A recording, one of its frames, and settings that change.

    Parameters
    ----------
    recording : Recording
        Its frames are read when they are looked at.
    config : RopeConfig, optional
        Where to begin; without it the diameter is unknown and everything passes.
    start : int
        The first frame.
    limit : int, optional
        How many frames there are from there on.

    Raises
    ------
    ConfigError
        If the colour is that of a pixel of the first frame: it would be another in each frame that is looked at.
    RecordingError
        If there is no frame.
    """

    def __init__(
        self, recording: Recording, config: RopeConfig | None = None, start: int = 0, limit: int | None = None
    ) -> None:
        self.config = RopeConfig(UNKNOWN_DIAMETER) if config is None else config
        if self.config.segmentation.color_pixel is not None:
            raise ConfigError("segmentation.color_pixel: take it out, and click on the rope in the page")
        self.knows_diameter = config is not None
        self.first = start
        self._recording = recording
        count = recording.frame_count
        ends = [end for end in (count, None if limit is None else start + limit) if end is not None]
        self.end = min(ends) if ends else None
        if not self.go_to(start):
            raise RecordingError(f"{recording.path}: there is no frame {start}")

    def go_to(self, index: int) -> bool:
        """Look at another frame; false, and the same one, if there is none."""
        if index < self.first or (self.end is not None and index >= self.end):
            return False
        event = next(iter(self._recording.frames(index, 1)), None)
        if event is None:
            self.end = index
            return False
        self.index, self.event = index, event
        return True

    def click(self, column: int, row: int) -> list[str]:
        """Take the colour of the thing at a pixel, and measure its diameter if that is not known; says what was found.

        Raises
        ------
        ConfigError
            If there is nothing at that pixel.
        FrameError
            If the frame is bad or has no colour.
        """
        if isinstance(self.event, BadFrame):
            raise FrameError(f"this frame is bad: {self.event.reason}")
        proposal = propose_color_at(self.event, column, row)
        segmentation = dataclasses.replace(self.config.segmentation, lab_min=None, lab_max=None)
        self.config = dataclasses.replace(self.config, color=proposal.color, segmentation=segmentation)
        said = list(proposal.reasons)
        if not self.knows_diameter:
            try:
                said += self.measure()
            except (ConfigError, FrameError) as error:
                said.append(f"the diameter is not measured: {error}")
        return said

    def measure(self) -> list[str]:
        """Take the diameter that this frame shows; says what was found.

        Raises
        ------
        ConfigError, FrameError
            If it cannot be measured.
        """
        if isinstance(self.event, BadFrame):
            raise FrameError(f"this frame is bad: {self.event.reason}")
        size = propose_diameter([self.event], self.config.color)
        self.change({"diameter": round(size.diameter, 5)})
        return [f"diameter {size.text()}", *size.reasons]

    def change(self, settings: Mapping[str, Any]) -> None:
        """Change settings of `TUNED`, all or none; None is the default.

        Raises
        ------
        ConfigError
            If one is not of those, or impossible; the settings are then as they were.
        """
        table = tomllib.loads(self.config.to_toml())
        for name, value in settings.items():
            if name not in TUNED:
                raise ConfigError(f"{name} cannot be changed here")
            section, _, key = name.rpartition(".")
            home = table.setdefault(section, {}) if section else table
            home.pop(key, None)
            if value is not None:
                home[key] = value
        self.config = from_table(RopeConfig, table)
        self.knows_diameter = self.knows_diameter or "diameter" in settings

    def look(self) -> Look:
        """What the settings make of the frame.

        Raises
        ------
        FrameError
            If a colour is asked for and the frame has none.
        """
        tracker = make_tracker(self.config)
        if isinstance(tracker, PersistentTracker):
            estimates = tracker.update_all(self.event)
        else:
            estimates = (tracker.update(self.event),)
        return Look(self.index, self.event, tracker.cloud(), self._slices(), estimates)

    def _slices(self) -> FloatArray:
        if isinstance(self.event, BadFrame):
            return np.empty((0, 3))
        slicing = SlicingTracker(self.config)
        points, _, _ = slicing.rope_points(self.event)
        return slicing.slicer.slice(points).centroids

    def box_corners(self) -> FloatArray | None:
        """The corners of the position box in the camera's frame, (8, 3), metres; the last axis changes fastest."""
        low, high = self.config.segmentation.box_min, self.config.segmentation.box_max
        if low is None or high is None:
            return None
        corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij")).reshape(3, -1).T
        if self.config.segmentation.box_frame == "world":
            corners = moved(corners, np.linalg.inv(self.config.world_from_camera()).astype(float))
        return corners
