"""What stands between any controller and the joints: velocities that never exceed the limits, whatever comes in.

Time goes in periods of ``dt``. The velocity v commanded in a step is held until the next, so that

    a = (v - v_before) / dt,   jerk = (a - a_before) / dt,   q_next = q + dt v.

Why the limits hold, for each joint: *braking* is one fixed rule that brings any (v, a) to rest within the limits of
acceleration and jerk. A state (q, v, a) is *safe* if braking from it keeps to the limits of position and velocity until
rest. Braking leads from a safe state to a safe state, since what remains is part of what was found to be safe. The
guard goes only to states that it has found to be safe, or brakes; it starts at rest, which is safe. Where a limit is
exceeded already, as by a joint that starts beyond it, safe means that braking goes no further beyond than braking from
the state before would have: such a joint can move only inward, and can always do so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import njit

from ropetrace.errors import ConfigError, RopetraceError
from ropetrace.types import FloatArray

if TYPE_CHECKING:
    from ropetrace.control.arm import JointLimits

_SLACK = 1e-4
"""A wish that misses a bound of one joint by less, rad/s, meets it: solvers are not exact, and must not freeze."""

_SETTLED = 0.5
"""Seconds of rest after which the arm has arrived where it was sent."""

_STILL = 1e-6
"""Speed towards a wall, m/s, that is round-off."""

_CLOCK_ROUNDING = 1e-9
"""By which sums of periods differ, s."""

_LONGEST_GAP = 1e3
"""In which an arm may have gone on, s."""

_MOST_RAMP = 1000
"""Periods in which an acceleration can be taken back, at most: more is a wrong unit."""


class Reason(StrEnum):
    """Why the guard brakes."""

    TRACKING = "tracking"
    """The arm is not where it was sent; stays until `MotionGuard.reset`."""
    CLOCK = "clock"
    """The caller's time stood still, ran back or jumped."""
    INPUT = "input"
    """A number is not finite, or an array has the wrong shape."""
    HOLD = "hold"
    """The caller said so."""
    STALE = "stale"
    """The trajectory is too old, or from the future."""


class Command(NamedTuple):
    """What the guard lets through.

    Attributes
    ----------
    velocity : (n,) float array
        Of the joints, until the next step, rad/s. Always finite.
    reason : Reason or None
        Why the guard brakes, None if it does not.
    text : str
        The same in words; empty if it does not brake.
    """

    velocity: FloatArray
    reason: Reason | None = None
    text: str = ""


@dataclass(frozen=True, slots=True)
class GuardOptions:
    """How careful the guard is.

    Parameters
    ----------
    velocity_scale, acceleration_scale : float
        Share of the joints' limits that is used, above 0 to 1.
    margin : float
        Distance kept from the ends of each joint's range, rad. None is needed for the guard's own sake: give what the
        arm may overshoot where it is told to stop.
    max_age : float
        A trajectory older than this is not followed, s.
    max_future : float
        Nor one from further in the future than this, s: clocks of two machines differ by a little, and a stamp that is
        wrong must not pass for fresh.
    max_gap : float
        The greatest time between two steps, in periods.
    max_tracking_error : float
        The greatest difference between where a joint was sent and where it is, rad.

    Raises
    ------
    ConfigError
        If a value is out of its range.
    """

    velocity_scale: float = 1.0
    acceleration_scale: float = 1.0
    margin: float = 0.0
    max_age: float = 0.1
    max_future: float = 0.02
    max_gap: float = 5.0
    max_tracking_error: float = 0.1

    def __post_init__(self) -> None:
        for name in ("velocity_scale", "acceleration_scale"):
            if not 0 < getattr(self, name) <= 1:
                raise ConfigError(f"guard: {name} is {getattr(self, name)}: it must be above 0 and at most 1")
        for name in ("margin", "max_future"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ConfigError(f"guard: {name} is {getattr(self, name)}: it must be a finite number from 0")
        for name in ("max_age", "max_tracking_error"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"guard: {name} is {getattr(self, name)}: it must be a finite number above 0")
        if not 1 < self.max_gap < math.inf:
            raise ConfigError(f"guard: max_gap is {self.max_gap}: it must be a finite number above 1 (period)")


class MotionGuard:
    """Lets a wish for joint velocities through as far as the joints' limits permit, and brakes when something is wrong.

    A new wish inside `velocity_bounds` is met exactly. Any other is approached along a straight line in the space of
    joint velocities, at the pace of the slowest joint, so that the direction of motion is kept where it can be: the
    wish is first made shorter as a whole, until no joint exceeds its speed, or gets closer to the end of its range than
    it can stop. A wish that pushes a joint against its end therefore stops the arm; who wants the other joints to go on
    asks for nothing outside `velocity_bounds`. A wish that stays the same is reached without overshoot, except that one
    met at once with an acceleration above ``jerk dt`` is passed while that is taken back.

    The guard keeps the state that it has commanded. Its position is the sum of the velocities, each times the time
    until the next step, since the robot holds a command until another comes. Whether it did so in a gap above
    `GuardOptions.max_gap` nobody knows: of the places where the joint can be by then, the one nearest to the next
    measured position counts. Else the measured position enters in three ways. A difference above
    `GuardOptions.max_tracking_error` is a fault. Room to each end of a joint's range is counted from the worse of
    commanded and measured position; noise can thus only make the guard more careful, and the commanded position of
    steps in time respects the limits on its own account. And a motion that starts after half a second of rest starts
    from the measured position, so that small differences do not add up.

    When braking, each joint stops by itself, as fast as its limits of acceleration and jerk permit. With
    ``jerk dt >= 2 acceleration`` (an arm of Franka's at up to 250 Hz) no joint's speed ever grows meanwhile; at higher
    rates it grows until the acceleration is taken back, for up to ``acceleration / (jerk dt)`` periods.

    Parameters
    ----------
    limits : JointLimits
        Of the arm. A limit of velocity that depends on position, as FR3's does, is not known here.
    position : (n,) float array
        Where the arm stands still, rad.
    period : float
        dt, s. The robot must hold each command for this time.
    options : GuardOptions, optional

    Raises
    ------
    ConfigError
        If the period or the margin is impossible for this arm.
    ValueError
        If the position is not n finite numbers.
    """

    def __init__(
        self, limits: JointLimits, position: FloatArray, period: float, options: GuardOptions | None = None
    ) -> None:
        self.options = options or GuardOptions()
        self.period = float(period)
        if not 0 < self.period < math.inf:
            raise ConfigError(f"guard: the period is {period} s: it must be a finite number above 0")
        self._limits = np.array(
            [
                limits.lower + self.options.margin,
                limits.upper - self.options.margin,
                self.options.velocity_scale * limits.velocity,
                self.options.acceleration_scale * limits.acceleration,
                limits.jerk * self.period,
            ]
        )
        if (self._limits[0] >= self._limits[1]).any():
            raise ConfigError(f"guard: a margin of {self.options.margin:g} rad leaves a joint no range")
        if (self._limits[3] > _MOST_RAMP * self._limits[4]).any():
            raise ConfigError(
                f"guard: at a period of {period:g} s a joint's jerk limit is too low for its acceleration: "
                f"it would need more than {_MOST_RAMP} periods to take it back"
            )
        self._count = self._limits.shape[1]
        self._state = np.zeros((4, self._count))
        self._zero = np.zeros(self._count)
        self.reset(position)
        # Compiles the kernels now rather than in the first step.
        _move(self._state, self._limits, self.period, self._state[0], self._zero, False, False)
        self.velocity_bounds()

    @property
    def position(self) -> FloatArray:
        """Where the joints have been sent, (n,), rad."""
        return self._state[0].copy()

    @property
    def velocity(self) -> FloatArray:
        """The last command, (n,), rad/s."""
        return self._state[1].copy()

    @property
    def at_rest(self) -> bool:
        """Whether velocity and acceleration are zero."""
        return not self._state[1:3].any()

    def reset(self, position: FloatArray) -> None:
        """Start again from where the arm stands still; clears a tracking fault.

        Parameters
        ----------
        position : (n,) float array
            Measured, rad.

        Raises
        ------
        ValueError
            If it is not n finite numbers.
        RopetraceError
            If the guard has not yet brought the arm to rest.
        """
        start, wrong = self._vector("position", position)
        if start is None:
            raise ValueError(wrong)
        if not self.at_rest:
            raise RopetraceError("the arm is still moving: go on calling step() until it is at rest, then reset()")
        self._state[0] = start
        self._in_doubt = np.zeros(self._count)
        self._fault = ""
        self._last: float | None = None
        self._counted_until = 0.0
        self._rest = 0

    def locate(self, now: Any, measured: Any) -> FloatArray | None:
        """The measured position as an array, (n,), rad; None where `step` brakes at it, whatever else it is given.

        The last command is counted until now, so that `position` and `velocity_bounds` are of now, too.

        Parameters
        ----------
        now, measured
            As `step` will be given them.
        """
        where = self._vector("", measured)[0]
        self._count_until(finite_number(now), where)
        if where is None or not np.abs(where - self._state[0]).max() <= self.options.max_tracking_error:
            return None
        return where

    def velocity_bounds(self, measured: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """What each joint can do in the next step.

        Joints do not depend on each other: any wish inside the bounds can be met, and is if it is a new one.

        Parameters
        ----------
        measured : (n,) float array, optional
            Where the joints are, rad, as it will be given to `step`. Ignored where it is not n finite numbers.

        Returns
        -------
        lower, upper : (n,) float array
            Least and greatest velocity of each joint, rad/s.
        """
        known = None if measured is None else self._vector("", measured)[0]
        box = np.empty((6, self._count))
        _bound(self._state, self._limits, self.period, self._state[0] if known is None else known, box)
        return box[0], box[1]

    def step(
        self, now: float, measured: FloatArray, desired: FloatArray | None, stamp: float, hold: str | None = None
    ) -> Command:
        """The command for the next period. Never raises for bad input: it brakes.

        Parameters
        ----------
        now : float
            The caller's clock, s: monotonic, the same as of `stamp`.
        measured : (n,) float array
            Where the joints are, rad.
        desired : (n,) float array
            Joint velocities that the controller wants, rad/s. Not looked at when told to hold.
        stamp : float
            Of the sensor data that the wish rests on, s.
        hold : str, optional
            A reason of the caller's to stop.

        Returns
        -------
        Command
        """
        where, wrong = self._vector("measured position", measured)
        self._count_until(finite_number(now), where)
        wish, vain = (None, "") if hold is not None else self._vector("desired velocity", desired)
        reason, text = self._objection(now, where, wrong, vain, stamp, hold)
        braking = reason is not None or where is None or wish is None
        settled = self._rest * self.period > _SETTLED
        moving = _move(
            self._state,
            self._limits,
            self.period,
            self._state[0] if where is None else where,
            self._zero if wish is None else wish,
            braking,
            settled,
        )
        self._counted_until += self.period
        self._rest = 0 if moving else self._rest + 1
        return Command(self._state[1].copy(), reason, text)

    def _count_until(self, now: float | None, where: FloatArray | None) -> None:
        """Count the last command for as long as it lasted; what is in doubt, as the measured position has it."""
        last = self._last
        if now is not None and (last is None or now < last):
            self._counted_until = now
        elif now is not None and last is not None and now > last:
            # No arm goes on for so long, and no sum overflows.
            late = min(now - self._counted_until, _LONGEST_GAP)
            if late >= (self.options.max_gap - 1) * self.period:
                self._in_doubt += late * self._state[1]
            elif abs(late) > _CLOCK_ROUNDING:
                self._state[0] += late * self._state[1]
            self._counted_until = now
        if where is not None and self._in_doubt.any():
            low, high = np.minimum(self._in_doubt, 0), np.maximum(self._in_doubt, 0)
            self._state[0] += np.clip(where - self._state[0], low, high)
            self._in_doubt[:] = 0

    def _objection(
        self, now: float, where: FloatArray | None, wrong: str, vain: str, stamp: float, hold: str | None
    ) -> tuple[Reason | None, str]:
        """Why to brake: the gravest reason."""
        time, last = finite_number(now), self._last
        if time is not None:
            self._last = time
        if where is not None and not self._fault:
            errors = np.abs(where - self._state[0])
            joint = int(errors.argmax())
            if not errors[joint] <= self.options.max_tracking_error:
                self._fault = (
                    f"joint {joint + 1} is at {where[joint]:.4g} rad, but was sent to {self._state[0, joint]:.4g} rad: "
                    f"more than {self.options.max_tracking_error:g} rad apart"
                )
        if self._fault:
            return Reason.TRACKING, self._fault
        if time is None:
            return Reason.INPUT, f"the time is {now!r}, not a finite number of seconds"
        if last is not None and not 0 < time - last < self.options.max_gap * self.period:
            return Reason.CLOCK, (
                f"{time - last:.4g} s since the last step: expected {self.period:.4g} s, "
                f"and less than {self.options.max_gap * self.period:.4g} s"
            )
        if wrong:
            return Reason.INPUT, wrong
        if hold is not None:
            return Reason.HOLD, str(hold)
        made = finite_number(stamp)
        if made is None:
            return Reason.INPUT, f"the stamp is {stamp!r}, not a finite number of seconds"
        if not -self.options.max_future <= time - made <= self.options.max_age:
            limit = f"{self.options.max_age:g} s" if time > made else f"{self.options.max_future:g} s in the future"
            return Reason.STALE, f"the trajectory is {time - made:.4g} s old: at most {limit} is followed"
        return (Reason.INPUT, vain) if vain else (None, "")

    def _vector(self, name: str, values: Any) -> tuple[FloatArray | None, str]:
        """n finite numbers as an array, or what is wrong with them."""
        try:
            given = np.asarray(values)
            # A copy: for an array that is read-only or strided, the kernels would be compiled again, for seconds.
            array = np.array(given, dtype=np.float64, order="C") if given.dtype.kind in "fiu" else None
        except Exception:
            array = None
        if array is None:
            return None, f"the {name} is no array of numbers"
        if array.shape != (self._count,):
            return None, f"the {name} has shape {array.shape}: expected ({self._count},), one number a joint"
        if not _finite(array):
            joint = int(np.isfinite(array).argmin())
            return None, f"the {name} of joint {joint + 1} is {array[joint]}"
        return array, ""


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


def finite_number(value: Any) -> float | None:
    """A finite number, else None."""
    try:
        number = float(value) if np.ndim(value) == 0 else math.nan
    except Exception:
        return None
    return number if math.isfinite(number) else None


@njit(cache=True, nogil=True)
def _finite(array: Any) -> bool:
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
    for _ in range(10 * _MOST_RAMP):
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
def _bound(state: Any, limits: Any, period: float, measured: Any, box: Any) -> None:
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
def _move(state: Any, limits: Any, period: float, measured: Any, wish: Any, braking: bool, settled: bool) -> bool:
    """One step of the state; whether the joints move after it."""
    count = state.shape[1]
    box, chosen, wanted = np.empty((6, count)), np.empty(count), np.empty(count)
    if not braking:
        _bound(state, limits, period, measured, box)
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
    if not (_finite(twist) and _finite(position)):
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
