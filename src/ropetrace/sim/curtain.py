"""A curtain that comes in between camera and rope, and hides a part of it. World frame: z up, metres, seconds."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ropetrace.config import Vector
from ropetrace.errors import ConfigError
from ropetrace.sim.scene import Boxes, Color


@dataclass(frozen=True, slots=True)
class CurtainSettings:
    """The `[curtain]` table of a scenario: a box that comes in between camera and rope, and stays."""

    box: tuple[float, float, float, float, float, float] | None = None
    """Where it stays: the centre x, y, z and the edges."""
    comes_from: Vector = (0.0, 0.0, 0.0)
    """Where it is at the beginning, this far from there."""
    leaves_at: float = 0.0
    """When it begins to move, seconds."""
    arrives_at: float = 0.0
    """From then on it stands still, seconds."""

    def __post_init__(self) -> None:
        for name in ("box", "comes_from", "leaves_at", "arrives_at"):
            value = getattr(self, name)
            if value is not None and not np.isfinite(value).all():
                raise ConfigError(f"curtain.{name} = {value}: expected finite numbers")
        if self.box is not None and min(self.box[3:]) <= 0:
            raise ConfigError("curtain.box: the last three numbers are its edges, above 0")
        if self.arrives_at < self.leaves_at:
            raise ConfigError(f"curtain.arrives_at = {self.arrives_at} is before curtain.leaves_at = {self.leaves_at}")

    def boxes(self, time: float, color: Color, label: int) -> Boxes:
        """The curtain at a time, seconds; none without a box."""
        if self.box is None:
            return Boxes.none()
        left = (self.arrives_at - time) / max(self.arrives_at - self.leaves_at, 1e-9)
        away = (1 - math.cos(math.pi * min(max(left, 0.0), 1.0))) / 2
        x, y, z = (place + away * far for place, far in zip(self.box[:3], self.comes_from, strict=True))
        return Boxes.one((x, y, z), self.box[3:], color, label)
