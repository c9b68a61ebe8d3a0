"""Finding the settings of a rope by eye: the state behind the page of `ropetrace tune`, which knows of no browser."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from ropetrace.config import RopeConfig, format_color, from_table
from ropetrace.errors import ConfigError, FrameError, RecordingError
from ropetrace.live import LiveRecording
from ropetrace.picture import backdrop, pixels_of
from ropetrace.proposal import propose_color_at, propose_diameter
from ropetrace.recordings import Recording
from ropetrace.recordings.base import has_color
from ropetrace.trackers import Tracker, make_tracker
from ropetrace.trackers.slicing import SlicingTracker
from ropetrace.tracking import estimates_of
from ropetrace.types import (
    BadFrame,
    Cloud,
    CloudFrame,
    Estimate,
    Event,
    FloatArray,
    Frame,
    Status,
    lacks_color,
    moved,
)

NO_COLOR = "a colour is asked for, but the recording has none: leave out the colour, or record it"

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

_NEAR_CLICK = 6.0
"""How far from a click the point of a cloud lies that is meant, pixels,"""

_ONE_THING = 0.01
"""and the others that make its colour, metres."""

_SETTLED = 0.02
"""A diameter that is measured on slices is found when it changes by less than this share."""

_MOST_ROUNDS = 12

_LOST_EDGES = (1.0, 1.25, 1.6, 2.0)
"""Depth alone loses the edges of a rope: it may be this many times as thick as it looks."""

_BOX_MARGIN = 0.05
"""Between what passes and the box round it, metres."""


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """What the settings make of one frame.

    Parameters
    ----------
    index : int
        The frame's place in the recording, or in the frames that were taken from a live source.
    event : RgbdFrame, CloudFrame or BadFrame
        The frame.
    config : RopeConfig
        The settings.
    knows_diameter : bool
        Whether the diameter was given, set or measured.
    cloud : Cloud
        What passes; where too much does, every k-th point of it.
    slices : (K, 3) float array
        The centroids of its slices, metres, camera frame.
    estimates : tuple of Estimate
        One a rope; none as long as nobody has looked.
    age : float, optional
        Of a live frame when it was tracked, seconds; None for a frame that is held, or was recorded.
    """

    index: int
    event: Event
    config: RopeConfig
    knows_diameter: bool
    cloud: Cloud
    slices: FloatArray
    estimates: tuple[Estimate, ...]
    age: float | None = None

    @property
    def has_color(self) -> bool:
        """Whether there is anything for a colour gate to look at."""
        return not isinstance(self.event, BadFrame) and not lacks_color(self.event)

    @property
    def is_gated(self) -> bool:
        """Whether anything is kept out, or could not be for want of colour."""
        return self.config.asks_for_color or self.config.segmentation.box_min is not None or not self.has_color


class Tuning:
    """A source of frames, one of its frames, and settings that change.

    A recording stands still: each frame is looked at as if it were the first. A live source runs, and the tracker with
    it, until `frozen` is set: then its frame is held, and looked at like a recorded one.

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

    Attributes
    ----------
    frozen : bool
        Whether a live source is held.

    Raises
    ------
    ConfigError
        If the colour is that of a pixel of the first frame: it would be another in each frame that is looked at. If a
        colour is asked for, and the first frames have none. If a live source is limited.
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
        self.frozen = False
        self._recording = recording
        self._live = recording if isinstance(recording, LiveRecording) else None
        self._frames: Iterator[Event] | None = None
        self._wants_next = False
        self._tracker: tuple[RopeConfig, Tracker] | None = None
        if self._live is not None and limit is not None:
            raise ConfigError(f"{recording.path}: a live source is tuned until you end it: leave out --limit")
        ends = [end for end in (recording.frame_count, None if limit is None else start + limit) if end is not None]
        self.end = min(ends) if ends else None
        if self._live is not None:
            self._shown: tuple[int, Event] = (0, self._newest())
        elif not self.go_to(start):
            raise RecordingError(f"{recording.path}: there is no frame {start}")
        if self.config.asks_for_color and not self._has_color():
            self.close()
            raise ConfigError(NO_COLOR)

    def _has_color(self) -> bool:
        """Whether the first frames have colour; a live source is not begun anew to find out."""
        if self._live is not None:
            return isinstance(self.event, BadFrame) or not lacks_color(self.event)
        return has_color(self._recording, self.first)

    @property
    def name(self) -> str:
        """What is looked at, for people."""
        return str(self._recording.path)

    @property
    def is_live(self) -> bool:
        """Whether frames come by themselves."""
        return self._live is not None

    @property
    def index(self) -> int:
        """The place of the frame that is looked at."""
        return self._shown[0]

    @property
    def event(self) -> Event:
        """The frame that is looked at."""
        return self._shown[1]

    @property
    def wants_frame(self) -> bool:
        """Whether the next thing to do is to `take` a frame."""
        return self.is_live and (self._wants_next or not self.frozen)

    def take(self) -> bool:
        """Wait for the newest frame of a live source.

        A camera that gives nothing makes a `BadFrame`; false if it has failed, too. The next call begins it anew.
        """
        self._wants_next = False
        try:
            event, works = self._newest(), True
        except RecordingError as error:
            event, works = BadFrame(self.event.stamp_ns, str(error)), False
        self._shown = (self.index + 1, event)
        return works

    def _newest(self) -> Event:
        if self._frames is None:
            self._frames = self._recording.frames()
        try:
            return next(self._frames)
        except RecordingError:
            self._frames = None
            raise

    def close(self) -> None:
        """Let go of a live source."""
        self._frames = None
        if self._live is not None:
            self._live.close()

    def go_to(self, index: int) -> bool:
        """Look at another frame, of a live source at its newest; false, and the same one, if there is none."""
        if self.is_live:
            self._wants_next = True
            return True
        if index < self.first or (self.end is not None and index >= self.end):
            return False
        event = next(iter(self._recording.frames(index, 1)), None)
        if event is None:
            self.end = index
            return False
        self._shown = (index, event)
        return True

    def click(self, column: int, row: int, event: Event | None = None) -> list[str]:
        """Take the colour of the thing at a pixel, and measure its diameter if that is not known; says what was found.

        A cloud's pixels are those of `ropetrace.picture.backdrop`. Where there is no colour, the diameter is measured.

        Parameters
        ----------
        column, row : int
            The pixel.
        event : RgbdFrame, CloudFrame or BadFrame, optional
            The frame that was clicked on, if it is not the one that is looked at.

        Raises
        ------
        ConfigError
            If there is nothing at that pixel.
        FrameError
            If the frame is bad.
        """
        frame = _sound(self.event if event is None else event)
        if lacks_color(frame):
            return ["there is no colour to gate with: what has depth passes", *self.measure(frame)]
        if isinstance(frame, CloudFrame):
            color, said = _color_in_cloud(frame, column, row), []
        else:
            proposal = propose_color_at(frame, column, row)
            color, said = proposal.color, list(proposal.reasons)
        segmentation = dataclasses.replace(self.config.segmentation, lab_min=None, lab_max=None)
        self.config = dataclasses.replace(self.config, color=color, segmentation=segmentation)
        if not self.knows_diameter:
            try:
                said += self.measure(frame)
            except (ConfigError, FrameError) as error:
                said.append(f"the diameter is not measured: {error}")
        return said

    def measure(self, event: Event | None = None) -> list[str]:
        """Take the diameter that a frame shows, by default the one that is looked at; says what was found.

        Raises
        ------
        ConfigError, FrameError
            If it cannot be measured.
        """
        frame = _sound(self.event if event is None else event)
        if isinstance(frame, CloudFrame):
            diameter = self._diameter_of_slices(frame)
            said = [f"diameter {diameter * 1e3:.1f} mm, as the slices of the points show it: doubt it by a third"]
        else:
            size = propose_diameter([frame], self.config.color)
            diameter, said = size.diameter, [f"diameter {size.text()}", *size.reasons]
            if self.config.color is None:
                diameter = self._with_lost_edges(frame, size.diameter)
                said.append(f"depth loses a rope's edges: {diameter * 1e3:.1f} mm is taken; set it if you know it")
        self.change({"diameter": round(diameter, 5)})
        return said

    def _diameter_of_slices(self, frame: Frame) -> float:
        """The diameter at which the slices are as wide as it says."""
        diameter = self.config.diameter
        with suppress(ConfigError):  # thinner or thicker than any rope
            for _ in range(_MOST_ROUNDS):
                tracker = SlicingTracker(dataclasses.replace(self.config, diameter=diameter))
                tracker.update(frame)
                before, diameter = diameter, tracker.seen_diameter
                if abs(diameter - before) < _SETTLED * before:
                    return diameter
        raise ConfigError("the points show no diameter: set it with its slider")

    def _with_lost_edges(self, frame: Frame, diameter: float) -> float:
        """The thinnest that a rope may be that looks this thick without colour, and is then followed well."""
        for times in _LOST_EDGES:
            tracker = make_tracker(dataclasses.replace(self.config, diameter=times * diameter))
            if tracker.update(frame).status is Status.OK:
                return times * diameter
        return diameter

    def put_box_round(self, points: FloatArray) -> None:
        """Put a position box round points, (N, 3), metres, camera frame; a few that lie apart may stay outside.

        Raises
        ------
        ConfigError
            If there are none.
        """
        if not len(points):
            raise ConfigError("nothing passes that a box could be put round")
        if self.config.segmentation.box_frame == "world":
            points = moved(points, self.config.world_from_camera())
        low, high = np.percentile(points, [1, 99], axis=0)
        self.change(
            {
                "segmentation.box_min": np.round(low - _BOX_MARGIN, 3).tolist(),
                "segmentation.box_max": np.round(high + _BOX_MARGIN, 3).tolist(),
            }
        )

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

    def glance(self) -> Look:
        """The frame, before anything was made of it."""
        index, event = self._shown
        nothing = Cloud(np.empty((0, 3)), np.empty(0, np.int32))
        return Look(index, event, self.config, self.knows_diameter, nothing, np.empty((0, 3)), ())

    def look(self) -> Look:
        """What the settings make of the frame; of a live one that is not held, after those before it."""
        index, event = self._shown
        config, knows_diameter, live = self.config, self.knows_diameter, None if self.frozen else self._live
        if live is None or self._tracker is None or self._tracker[0] is not config:
            self._tracker = (config, make_tracker(config))
        tracker = self._tracker[1]
        estimates = estimates_of(event, tracker, [0])
        age = None if live is None or isinstance(event, BadFrame) else live.age()
        cloud = tracker.cloud()
        slices = SlicingTracker(config).slicer.slice(np.ascontiguousarray(cloud.points.T)).centroids
        return Look(index, event, config, knows_diameter, cloud, slices, estimates, age)


def box_corners(config: RopeConfig) -> FloatArray | None:
    """The corners of the position box in the camera's frame, (8, 3), metres; the last axis changes fastest."""
    low, high = config.segmentation.box_min, config.segmentation.box_max
    if low is None or high is None:
        return None
    corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij")).reshape(3, -1).T
    if config.segmentation.box_frame == "world":
        corners = moved(corners, np.linalg.inv(config.world_from_camera()).astype(float))
    return corners


def _sound(event: Event) -> Frame:
    if isinstance(event, BadFrame):
        raise FrameError(f"this frame is bad: {event.reason}")
    return event


def _color_in_cloud(frame: CloudFrame, column: int, row: int) -> str:
    """The colour in full light of the points about the one at a pixel: the median of the brighter half."""
    assert frame.colors is not None
    camera = backdrop(frame)[1]
    ahead = np.isfinite(frame.points).all(axis=1) & (frame.points[:, 2] > 0)
    points = frame.points[ahead].astype(float)
    away = np.linalg.norm(pixels_of(points, camera) - [column, row], axis=1)
    if not len(away) or away.min() > _NEAR_CLICK:
        raise ConfigError(f"there is no point near {column},{row}: choose one on the rope")
    near = frame.colors[ahead][np.linalg.norm(points - points[np.argmin(away)], axis=1) <= _ONE_THING]
    bright = near[np.argsort(near.sum(axis=1), kind="stable")[len(near) // 2 :]]
    return format_color(np.median(bright, axis=0).astype(int))
