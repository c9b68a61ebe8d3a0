"""Ropes that are led along a curve: shapes that a hanging rope does not take, such as a loop, a coil or a hairpin.

World frame: z up, metres, seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ropetrace.config import Vector
from ropetrace.errors import ConfigError
from ropetrace.sim.rope import RopeModel, RopeState
from ropetrace.types import FloatArray

_INSTANT = 1e-4
"""Velocities are differences of positions this far before and after, seconds."""


@dataclass(frozen=True, slots=True)
class CurveSettings:
    """The `[curve]` table of a scenario: a straight leg, an arc, and a straight leg; without a radius, physics rules.

    A link at arc length s of a rope of length L points along (cos b cos a, sin b, cos b sin a), turned by `yaw_degrees`
    about the vertical. b is `slope_degrees`; a(s) is the heading, which grows by `turn_degrees` over the arc, plus the
    sway, A sin(2 pi (f t - s / L)). Links keep their length whatever a is: the rope never stretches.
    """

    radius: float | None = None
    """Of the arc, metres, as seen across the plane."""
    turn_degrees: float = 360.0
    """Of the arc: 180 is a hairpin, 360 a loop, several times 360 with a slope a coil."""
    heading_degrees: float = 0.0
    """Of the first leg in the x-z plane: 0 is along x, -90 is down."""
    slope_degrees: float = 0.0
    """By which the rope leaves the plane: strands that cross are apart."""
    yaw_degrees: float = 0.0
    center: Vector = (0.0, 0.0, 0.675)
    """Where the middle of all links is."""
    sway_degrees: float = 0.0
    """A."""
    sway_frequency: float = 0.5
    """f, Hz."""

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if value is not None and not np.isfinite(value).all():
                raise ConfigError(f"curve.{name} = {value}: expected finite numbers")
        if self.radius is not None and self.radius <= 0:
            raise ConfigError(f"curve.radius = {self.radius}: expected more than 0 metres")
        if self.turn_degrees < 0:
            raise ConfigError(f"curve.turn_degrees = {self.turn_degrees}: expected 0 or more")
        if not -90 < self.slope_degrees < 90:
            raise ConfigError(f"curve.slope_degrees = {self.slope_degrees}: expected more than -90 and less than 90")

    @property
    def arc(self) -> float:
        """How much of the rope the arc takes, metres; 0 without a radius."""
        if self.radius is None:
            return 0.0
        return math.radians(self.turn_degrees) * self.radius / math.cos(math.radians(self.slope_degrees))


class CurveRope:
    """A rope that follows a curve in time; used as `ropetrace.sim.rope.RopeSimulation` is.

    Parameters
    ----------
    settings : CurveSettings
        With a radius.
    model : RopeModel
        Links and radius; masses and joints mean nothing here.
    camera_axis : (x, y, z)
        Viewing axis of the camera, world frame, for the Y and Z axes of the links (equations 16 and 17).
    """

    def __init__(self, settings: CurveSettings, model: RopeModel, camera_axis: tuple[float, float, float]) -> None:
        self.model = model
        self.time = 0.0
        self._settings = settings
        self._camera_axis = np.array(camera_axis)
        self._places = (np.arange(model.links) + 0.5) * model.link_length
        leg = (model.length - settings.arc) / 2
        turned = np.clip((self._places - leg) / max(settings.arc, 1e-12), 0, 1)
        self._headings = np.radians(settings.heading_degrees + settings.turn_degrees * turned)

    def advance(self, time: float) -> None:
        """Go to a time, seconds."""
        self.time = time

    def _polyline(self, time: float) -> FloatArray:
        """Start, joints and end at a time, (N + 1, 3), metres, world frame."""
        settings = self._settings
        phase = settings.sway_frequency * time - self._places / self.model.length
        heading = self._headings + math.radians(settings.sway_degrees) * np.sin(2 * np.pi * phase)
        slope, yaw = math.radians(settings.slope_degrees), math.radians(settings.yaw_degrees)
        across, away = np.cos(heading) * math.cos(slope), math.sin(slope)
        steps = np.stack(
            [
                across * math.cos(yaw) - away * math.sin(yaw),
                across * math.sin(yaw) + away * math.cos(yaw),
                np.sin(heading) * math.cos(slope),
            ],
            axis=1,
        )
        line = np.concatenate([np.zeros((1, 3)), np.cumsum(steps * self.model.link_length, axis=0)])
        return np.asarray(line - (line[1:] + line[:-1]).mean(axis=0) / 2 + settings.center)

    def state(self) -> RopeState:
        """Where the rope is now."""
        line = self._polyline(self.time)
        before, after = (self._polyline(self.time + step) for step in (-_INSTANT, _INSTANT))
        moving = (after - before) / (2 * _INSTANT)
        x = np.diff(line, axis=0) / self.model.link_length
        y = np.cross(x, self._camera_axis)
        y /= np.maximum(np.linalg.norm(y, axis=1, keepdims=True), 1e-12)
        return RopeState(
            self.time,
            line,
            (line[1:] + line[:-1]) / 2,
            np.stack([x, y, np.cross(x, y)], axis=2),
            (moving[1:] + moving[:-1]) / 2,
        )

    def capsule_axes(self) -> tuple[FloatArray, FloatArray]:
        """Starts and ends of the links' capsule axes, each (N, 3), metres, world frame."""
        line = self._polyline(self.time)
        inset = 0.0 if self.model.smooth else self.model.radius / self.model.link_length
        step = inset * np.diff(line, axis=0)
        return line[:-1] + step, line[1:] - step
