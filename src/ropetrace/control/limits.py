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

from ropetrace.control.joint_steps import MOST_RAMP, all_finite, bound, move
from ropetrace.errors import ConfigError, RopetraceError
from ropetrace.types import FloatArray

if TYPE_CHECKING:
    from ropetrace.control.arm import JointLimits

_SETTLED = 0.5
"""Seconds of rest after which the arm has arrived where it was sent."""

_CLOCK_ROUNDING = 1e-9
"""By which sums of periods differ, s."""

_LONGEST_GAP = 1e3
"""In which an arm may have gone on, s."""


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
        if (self._limits[3] > MOST_RAMP * self._limits[4]).any():
            raise ConfigError(
                f"guard: at a period of {period:g} s a joint's jerk limit is too low for its acceleration: "
                f"it would need more than {MOST_RAMP} periods to take it back"
            )
        self._count = self._limits.shape[1]
        self._state = np.zeros((4, self._count))
        self._zero = np.zeros(self._count)
        self.reset(position)
        # Compiles the kernels now rather than in the first step.
        move(self._state, self._limits, self.period, self._state[0], self._zero, False, False)
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
        bound(self._state, self._limits, self.period, self._state[0] if known is None else known, box)
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
        moving = move(
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
        if not all_finite(array):
            joint = int(np.isfinite(array).argmin())
            return None, f"the {name} of joint {joint + 1} is {array[joint]}"
        return array, ""


def finite_number(value: Any) -> float | None:
    """A finite number, else None."""
    try:
        number = float(value) if np.ndim(value) == 0 else math.nan
    except Exception:
        return None
    return number if math.isfinite(number) else None
