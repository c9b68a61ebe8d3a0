"""One step of joints that keep their limits, and how far they get while they brake: the guard's arithmetic.

See `ropetrace.control.limits` for why they hold. A state is four rows: position, velocity, acceleration and the last
wish of each joint; the limits are five: the ends of its range, greatest velocity and acceleration, and jerk times the
period, which is what ``jerk`` means below.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

MOST_RAMP = 1000
"""Periods in which an acceleration can be taken back, at most: more is a wrong unit."""

_SLACK = 1e-4
"""A wish that misses a bound of one joint by less, rad/s, meets it: solvers are not exact, and must not freeze."""


@njit(cache=True, nogil=True)
def all_finite(array: Any) -> bool:
    """Whether there is neither NaN nor infinity in a vector."""
    for value in array:
        if not np.isfinite(value):
            return False
    return True


@njit(cache=True, nogil=True)
def _ramp(change: float, jerk: float) -> float:
    """The greatest acceleration that, taken back by `jerk` a period, adds up to no more than `change`.

    Inverse of ``(m + 1) a - jerk m (m + 1) / 2`` with ``m = floor(a / jerk)``. All three in units of rad/s^2: a change
    of velocity is divided by the period, a jerk multiplied by it.
    """
    if change <= jerk:
        return change
    m = np.floor((np.sqrt(1 + 8 * change / jerk) - 1) / 2)
    return (change + jerk * m * (m + 1) / 2) / (m + 1)


@njit(cache=True, nogil=True)
def _brake(v: float, a: float, acceleration: float, jerk: float, period: float) -> tuple[float, float]:
    """The next velocity and acceleration of a joint that brakes: to rest exactly, as fast as the limits permit."""
    speed = abs(v) / period
    strongest = min(_ramp(speed, jerk), acceleration)
    wanted = -math.copysign(strongest, v)
    chosen = min(max(wanted, a - jerk), a + jerk)
    if chosen == wanted and strongest == speed:
        return 0.0, chosen
    return v + period * chosen, chosen


@njit(cache=True, nogil=True)
def _reach(v: float, a: float, acceleration: float, jerk: float, period: float) -> float:
    """How far up a joint gets from here while it brakes, rad: 0 if it only goes down."""
    if v <= 0 and a - jerk <= _ramp(-v / period, jerk):
        return 0.0
    m = np.floor(acceleration / jerk)
    whole_ramp = (m + 1) * acceleration - jerk * m * (m + 1) / 2
    here = highest = 0.0
    for _ in range(10 * MOST_RAMP):
        if v == 0 and a == 0:
            return highest
        v, a = _brake(v, a, acceleration, jerk, period)
        here += period * v
        highest = max(highest, here)
        speed = abs(v) / period
        if abs(a) == acceleration and v * a < 0 and speed > whole_ramp + acceleration:
            steps = np.floor((speed - whole_ramp) / acceleration)
            here += period * steps * (v + period * a * (steps + 1) / 2)
            v += period * a * steps
            highest = max(highest, here)
    return np.inf


@njit(cache=True, nogil=True)
def _most(
    v: float, a: float, room: float, top: float, acceleration: float, jerk: float, period: float
) -> tuple[float, float, float]:
    """The greatest next velocity of a joint from which it can still stop within the room above it.

    Also the greatest that it may aim at, which is less than `top` only if the room is what limits it; and the room
    itself, which is at least what braking needs.
    """
    braked, brake = _brake(v, a, acceleration, jerk, period)
    room = max(room, _reach(v, a, acceleration, jerk, period))
    high = max(min(a + jerk, acceleration, _ramp((top - v) / period, jerk)), brake)
    best = v + period * high
    if period * best + _reach(best, high, acceleration, jerk, period) <= room:
        return best, top, room
    low, best = brake, braked
    for _ in range(40):
        middle = 0.5 * (low + high)
        tried = v + period * middle
        if period * tried + _reach(tried, middle, acceleration, jerk, period) <= room:
            low, best = middle, tried
        else:
            high = middle
    return best, max(best, 0.0), room


@njit(cache=True, nogil=True)
def bound(state: Any, limits: Any, period: float, measured: Any, box: Any) -> None:
    """Rows of the box: least and greatest velocity of the next step, least and greatest to aim at, room on each side.

    The room downward is positive, too.
    """
    for i in range(state.shape[1]):
        q, v, a = state[0, i], state[1, i], state[2, i]
        top, acceleration, jerk = limits[2, i], limits[3, i], limits[4, i]
        room = min(q, measured[i]) - limits[0, i]
        least, aim, room = _most(-v, -a, room, top, acceleration, jerk, period)
        box[0, i], box[2, i], box[4, i] = -least, -aim, room
        room = limits[1, i] - max(q, measured[i])
        box[1, i], box[3, i], box[5, i] = _most(v, a, room, top, acceleration, jerk, period)


@njit(cache=True, nogil=True)
def _choose(state: Any, limits: Any, period: float, wish: Any, box: Any, chosen: Any) -> None:
    """The velocities in the box that come closest to the wish, along a line."""
    count = state.shape[1]
    changed = False
    share = 1.0
    for i in range(count):
        changed = changed or wish[i] != state[3, i]
        share = min(share, limits[2, i] / max(abs(wish[i]), limits[2, i]))
    inside = True
    for i in range(count):
        chosen[i] = wish[i] * share
        if box[0, i] - _SLACK <= chosen[i] <= box[1, i] + _SLACK:
            chosen[i] = min(max(chosen[i], box[0, i]), box[1, i])
        else:
            inside = False
    if inside and changed:
        return

    share = 1.0
    for i in range(count):
        if chosen[i] > 0:
            share = min(share, box[3, i] / chosen[i])
        elif chosen[i] < 0:
            share = min(share, box[2, i] / chosen[i])
    most = 1.0
    for i in range(count):
        target = min(max(chosen[i] * share, box[2, i]), box[3, i])
        chosen[i] = target
        v, jerk = state[1, i], limits[4, i]
        change = target - v
        if change > 0:
            most = min(most, min(box[1, i] - v, period * _ramp(change / period, jerk)) / change)
        elif change < 0:
            most = min(most, max(box[0, i] - v, -period * _ramp(-change / period, jerk)) / change)
    for i in range(count):
        if most < 1:
            chosen[i] = state[1, i] + max(most, 0.0) * (chosen[i] - state[1, i])
        chosen[i] = min(max(chosen[i], box[0, i]), box[1, i])


@njit(cache=True, nogil=True)
def move(state: Any, limits: Any, period: float, measured: Any, wish: Any, braking: bool, settled: bool) -> bool:
    """One step of the state; whether the joints move after it."""
    count = state.shape[1]
    box, chosen, wanted = np.empty((6, count)), np.empty(count), np.empty(count)
    if not braking:
        bound(state, limits, period, measured, box)
        _choose(state, limits, period, wish, box, chosen)
        for i in range(count):
            v, acceleration, jerk = chosen[i], limits[3, i], limits[4, i]
            wanted[i] = (v - state[1, i]) / period
            up = period * v + _reach(v, wanted[i], acceleration, jerk, period)
            down = -period * v + _reach(-v, -wanted[i], acceleration, jerk, period)
            braking = braking or not (up <= box[5, i] + 1e-12 and down <= box[4, i] + 1e-12)
    moving = False
    for i in range(count):
        if braking:
            chosen[i], wanted[i] = _brake(state[1, i], state[2, i], limits[3, i], limits[4, i], period)
        moving = moving or chosen[i] != 0 or wanted[i] != 0
    for i in range(count):
        start = measured[i] if settled and moving else state[0, i]
        state[0, i] = start + period * chosen[i]
        state[1, i] = chosen[i]
        state[2, i] = wanted[i]
        state[3, i] = wish[i]
    return moving
