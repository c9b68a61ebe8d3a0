"""How fast an arm's tool may go, and where."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from ropetrace.control.joint_steps import all_finite
from ropetrace.errors import ConfigError
from ropetrace.types import FloatArray

_STILL = 1e-6
"""Speed towards a wall, m/s, that is round-off."""


class ToolLimits:
    """How fast the tool may go, and where: makes a wish for joint velocities shorter as a whole.

    It acts on the wish, before the guard. What the guard makes of it keeps the joints' limits first: while it brakes or
    changes direction, the tool may leave the line, be faster for a moment or pass a wall by a little. A wall that must
    not be touched needs room in front of it, or a robot that watches it itself.

    Parameters
    ----------
    linear, angular : float
        Greatest speeds of the tool, m/s and rad/s. By default a Panda's.
    low, high : (3,) float array
        Corners of the box in the base's frame in which the tool's origin must stay, metres. By default without end.
    deceleration : float
        With which the tool comes to rest at a wall, m/s^2: less than the joints can do in any pose of the task.
    period : float
        Of the control loop, s.

    Raises
    ------
    ConfigError
        If a value is not positive, or the box is empty or no box.
    """

    def __init__(
        self,
        linear: float = 1.7,
        angular: float = 2.5,
        low: Any = (-math.inf, -math.inf, -math.inf),
        high: Any = (math.inf, math.inf, math.inf),
        deceleration: float = 1.0,
        period: float = 1 / 240,
    ) -> None:
        for name, value in (
            ("linear speed", linear),
            ("angular speed", angular),
            ("deceleration", deceleration),
            ("period", period),
        ):
            if not 0 < value < math.inf:
                raise ConfigError(f"tool limits: the {name} is {value}: it must be a finite number above 0")
        box = np.array([low, high], dtype=np.float64)
        if box.shape != (2, 3) or not (box[0] < box[1]).all():
            raise ConfigError(f"tool limits: the box from {low} to {high} is empty, or not of three numbers each")
        self._speeds = (float(linear), float(angular))
        self._box = box
        self._deceleration, self._period = float(deceleration), float(period)
        self.scale(np.zeros((6, 1)), np.zeros(3), np.zeros(1))

    def scale(self, jacobian: FloatArray, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """Joint velocities in the same direction, with which the tool keeps its limits.

        Parameters
        ----------
        jacobian : (6, n) float array
            From joint velocities to the tool's velocity, m/s, and angular velocity, rad/s, along the base's axes.
        position : (3,) float array
            Of the tool in the base's frame, metres.
        velocity : (n,) float array
            Wanted of the joints, rad/s.

        Returns
        -------
        (n,) float array
            Zero if the tool is at a wall and the wish goes outward; one that goes inward or along it is always let
            through. If anything is not finite or of a wrong shape, all NaN: the guard brakes at it and says so.
        """
        wish = np.array(velocity, dtype=np.float64, order="C")
        mapping = np.array(jacobian, dtype=np.float64, order="C")
        place = np.array(position, dtype=np.float64, order="C")
        if wish.ndim != 1 or mapping.shape != (6, len(wish)) or place.shape != (3,):
            return np.full(wish.shape, np.nan)
        linear, angular = self._speeds
        share = _tool_share(mapping, place, wish, linear, angular, self._box, self._deceleration, self._period)
        return wish * share if math.isfinite(share) else np.full(wish.shape, np.nan)


@njit(cache=True, nogil=True)
def _tool_share(
    jacobian: Any,
    position: Any,
    velocity: Any,
    linear: float,
    angular: float,
    box: Any,
    deceleration: float,
    period: float,
) -> float:
    """How much of the joint velocities keeps the tool within its limits, 0 to 1; NaN if anything is not finite."""
    twist = np.zeros(6)
    for row in range(6):
        for i in range(len(velocity)):
            twist[row] += jacobian[row, i] * velocity[i]
    if not (all_finite(twist) and all_finite(position)):
        return np.nan
    share = linear / max(np.sqrt(twist[0] ** 2 + twist[1] ** 2 + twist[2] ** 2), linear)
    share = min(share, angular / max(np.sqrt(twist[3] ** 2 + twist[4] ** 2 + twist[5] ** 2), angular))
    for k in range(3):
        room = box[1, k] - position[k] if twist[k] > 0 else position[k] - box[0, k]
        if abs(twist[k]) > _STILL and room < np.inf:
            step = deceleration * period
            fastest = np.sqrt(step * step + 2 * deceleration * max(room, 0.0)) - step
            share = min(share, fastest / max(abs(twist[k]), fastest))
    return share
