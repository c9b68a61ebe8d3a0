"""The paper's Algorithm 1, rebuilt from section 5.1 and the caption of Figure 2.

Each waypoint is matched with the closest one of the frame before; the way between them over the time is its
velocity, the same with successive velocities its acceleration, and a Kalman filter smooths each. It is here to be
compared with: a rope that moves along itself, or whose waypoints are spaced anew, has the wrong velocity.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ropetrace.types import FloatArray, Motion, Waypoints

LONGEST_PAUSE = 0.25
"""After a longer one the frame before says nothing of this one, seconds."""

FARTHEST = 0.5
"""A closest waypoint further away than this is another rope's, or the order is reversed, metres."""

VELOCITY_NOISE, ACCELERATION_NOISE = 0.05, 3.0
"""Standard deviations of what the differences of positions and of velocities give, m/s and m/s^2. The paper names none;
these suit a node noise of 1 mm at 30 frames a second."""

VELOCITY_DRIFT, ACCELERATION_DRIFT = 5.0, 50.0
"""How fast both change, as random walks: m/s^1.5 and m/s^2.5."""


class ClosestMotion:
    """Follows one rope; see `motion.MotionEstimator`.

    Parameters
    ----------
    diameter : float
        Of the rope, metres; not used, since the paper's filters are set by hand.
    """

    def __init__(self, diameter: float = 0.0) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the frames so far."""
        self._stamp_ns: int | None = None
        self._motion: Motion | None = None
        self._positions: FloatArray = np.empty((0, 3))
        self._velocities = self._accelerations = self._positions
        self._variances = np.zeros(2)
        self._updates = 0

    @property
    def stamp_ns(self) -> int | None:
        """Of the frame that `predict` starts from."""
        return None if self._motion is None else self._stamp_ns

    def update(self, stamp_ns: int, waypoints: Waypoints) -> Motion | None:
        """Take the waypoints of a frame; see `motion.MotionEstimator.update`."""
        if not np.isfinite(waypoints.positions).all():
            raise ValueError("waypoints: a coordinate is not a finite number")
        if not len(waypoints):
            return None
        dt = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * 1e-9
        if self._stamp_ns is None or abs(dt) > LONGEST_PAUSE:
            self.reset()
            self._remember(stamp_ns, waypoints.positions, np.zeros((len(waypoints), 3)), np.zeros((len(waypoints), 3)))
            return None
        if dt <= 0:
            return None
        positions = np.ascontiguousarray(waypoints.positions)
        velocities, accelerations = np.empty_like(positions), np.empty_like(positions)
        self._updates += 1
        self._variances += np.array([VELOCITY_DRIFT, ACCELERATION_DRIFT]) ** 2 * dt
        gains = self._variances / (self._variances + np.array([VELOCITY_NOISE, ACCELERATION_NOISE]) ** 2)
        if self._updates == 1:
            gains[:] = 1.0, 0.0
        elif self._updates == 2:
            gains[1] = 1.0
        farthest = _follow(
            positions, dt, self._positions, self._velocities, self._accelerations, gains, velocities, accelerations
        )
        if farthest > FARTHEST:
            self.reset()
            self._remember(stamp_ns, positions, np.zeros_like(positions), np.zeros_like(positions))
            return None
        if self._updates == 1:
            self._variances[:] = VELOCITY_NOISE**2, 0.0
        elif self._updates == 2:
            self._variances[1] = ACCELERATION_NOISE**2
        else:
            self._variances *= 1 - gains
        self._remember(stamp_ns, positions, velocities, accelerations)
        self._motion = self._after(0.0)
        return self._motion

    def predict(self, ahead: float) -> tuple[FloatArray, Motion] | None:
        """Where the waypoints of the last update are `ahead` seconds later; see `motion.MotionEstimator.predict`."""
        if self._motion is None:
            return None
        moved = self._positions + ahead * self._velocities + ahead**2 / 2 * self._accelerations
        return moved, self._after(ahead)

    def _remember(
        self, stamp_ns: int, positions: FloatArray, velocities: FloatArray, accelerations: FloatArray
    ) -> None:
        self._stamp_ns = stamp_ns
        self._positions, self._velocities, self._accelerations = positions, velocities, accelerations

    def _after(self, ahead: float) -> Motion:
        """The motion `ahead` seconds after the last update."""
        shape = self._positions.shape
        velocity, acceleration = self._variances.tolist()
        if self._updates == 1:
            acceleration = ACCELERATION_DRIFT**2
        velocity = velocity + ahead**2 * acceleration + VELOCITY_DRIFT**2 * ahead
        acceleration = acceleration + ACCELERATION_DRIFT**2 * ahead
        # The position is taken as it comes: its noise is that of the velocity over one frame at 30 Hz.
        position = (VELOCITY_NOISE / 30) ** 2 + ahead**2 * velocity
        return Motion(
            self._velocities + ahead * self._accelerations,
            self._accelerations,
            *(np.full(shape, np.sqrt(variance)) for variance in (position, velocity, acceleration)),
        )


@njit(cache=True, nogil=True)
def _follow(
    positions: Any, dt: float, previous: Any, velocities: Any, accelerations: Any, gains: Any, new_v: Any, new_a: Any
) -> float:
    """Match each waypoint with the closest of the frame before and update its filters; the greatest distance."""
    farthest = 0.0
    for i in range(len(positions)):
        closest, least = 0, np.inf
        for j in range(len(previous)):
            away = 0.0
            for c in range(3):
                away += (positions[i, c] - previous[j, c]) ** 2
            if away < least:
                closest, least = j, away
        farthest = max(farthest, least)
        for c in range(3):
            expected = velocities[closest, c] + dt * accelerations[closest, c]
            seen = (positions[i, c] - previous[closest, c]) / dt
            new_v[i, c] = expected + gains[0] * (seen - expected)
            change = (seen - velocities[closest, c]) / dt
            new_a[i, c] = accelerations[closest, c] + gains[1] * (change - accelerations[closest, c])
    return np.sqrt(farthest)
