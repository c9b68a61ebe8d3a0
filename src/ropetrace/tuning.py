"""Finding the settings of a rope by eye: the state behind the page of `ropetrace tune`, which knows of no browser."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ropetrace.config import RopeConfig, from_table
from ropetrace.errors import ConfigError, FrameError, RecordingError
from ropetrace.live import LiveRecording
from ropetrace.recordings import Recording
from ropetrace.recordings.base import NO_COLOR, check_color, frames_to_come
from ropetrace.trackers import Tracker, make_tracker
from ropetrace.trackers.slicing import SlicingTracker
from ropetrace.tracking import estimates_of
from ropetrace.tune_look import TUNED, Look
from ropetrace.tune_measuring import box_round, color_at, diameter_in
from ropetrace.types import BadFrame, Cloud, Event, FloatArray, Frame, lacks_color

UNKNOWN_DIAMETER = 0.012
"""What is begun with where no diameter is given, metres: the first click measures it."""


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
        count = frames_to_come(recording, start, limit)
        self.end = None if count is None else start + count
        if self._live is not None:
            self._shown: tuple[int, Event] = (0, self._newest())
        elif not self.go_to(start):
            raise RecordingError(f"{recording.path}: there is no frame {start}")
        self._check_color()

    def _check_color(self) -> None:
        """Refuse a colour that the first frames have not; a live source is not begun anew to find out."""
        if self._live is None:
            check_color(self._recording, self.config.asks_for_color, self.first)
        elif self.config.asks_for_color and not isinstance(self.event, BadFrame) and lacks_color(self.event):
            self.close()
            raise ConfigError(NO_COLOR)

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
        frame = self._sound(event)
        if lacks_color(frame):
            return ["there is no colour to gate with: what has depth passes", *self.measure(frame)]
        color, said = color_at(frame, column, row)
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
        diameter, said = diameter_in(self._sound(event), self.config)
        self.change({"diameter": round(diameter, 5)})
        return said

    def _sound(self, event: Event | None) -> Frame:
        """A frame, by default the one that is looked at; FrameError if it is bad."""
        event = self.event if event is None else event
        if isinstance(event, BadFrame):
            raise FrameError(f"this frame is bad: {event.reason}")
        return event

    def put_box_round(self, points: FloatArray) -> None:
        """Put a position box round points, (N, 3), metres, camera frame; a few that lie apart may stay outside.

        Raises
        ------
        ConfigError
            If there are none.
        """
        low, high = box_round(points, self.config)
        self.change({"segmentation.box_min": low, "segmentation.box_max": high})

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
