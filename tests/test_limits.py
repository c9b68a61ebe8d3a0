"""The guard keeps the joints' limits whatever comes in, and gets out of the way where it can."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ropetrace.control import joint_steps, tool_limits
from ropetrace.control.arm import JointLimits
from ropetrace.control.limits import Command, GuardOptions, MotionGuard, Reason
from ropetrace.control.tool_limits import ToolLimits
from ropetrace.errors import ConfigError, RopetraceError
from ropetrace.types import FloatArray

PANDA = JointLimits(
    np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]),
    np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]),
    np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61]),
    np.array([15, 7.5, 10, 12.5, 15, 20, 20]),
    np.array([7500, 3750, 5000, 6250, 7500, 10000, 10000]),
)
FR3 = JointLimits(
    np.array([-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159]),
    np.array([2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159]),
    np.array([2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26]),
    np.full(7, 10.0),
    np.full(7, 5000.0),
)
HOME = np.array([0, -0.785, 0, -2.356, 0, 1.571, 0.785])
WISH = np.array([0.5, -0.3, 0.2, 0.4, 0.1, 1, -1])
PERIODS = (1 / 30, 1 / 200, 1 / 240, 1 / 1000, 1 / 4000)
TOLERANCE = 1e-9


def motions(
    start: FloatArray, commands: FloatArray, measured: Sequence[Any] | FloatArray, period: float
) -> list[FloatArray]:
    """Where the joints have been sent: positions, (k, n), each command held for a period.

    A motion that starts after more than half a second without velocity and acceleration starts where it was measured.
    """
    still = ~np.any(commands, axis=1)
    result, first, rest = [], 0, 0
    for step in range(len(commands)):
        if rest * period > 0.5 and not still[step]:
            result.append(start + period * np.cumsum(commands[first:step], axis=0))
            start, first = np.asarray(measured[step]), step
        rest = rest + 1 if still[step] and (step == 0 or still[step - 1]) else 0
    return [np.concatenate([[start], start + period * np.cumsum(commands[first:], axis=0)]), *result]


def violations(limits: JointLimits, period: float, paths: list[FloatArray], commands: FloatArray) -> dict[str, int]:
    """How many numbers break a limit, from the definitions; the arm starts at rest.

    Beyond the end of its range a joint may be only as far as at the start of its motion.
    """
    before = np.zeros((1, commands.shape[1]))
    acceleration = np.diff(commands, axis=0, prepend=before) / period
    jerk = np.diff(acceleration, axis=0, prepend=before) / period
    beyond = 0
    for path in paths:
        upper = np.maximum(limits.upper, path[:1]) + TOLERANCE
        lower = np.minimum(limits.lower, path[:1]) - TOLERANCE
        beyond += int(((path > upper) | (path < lower)).sum())
    more = 1 + TOLERANCE
    return {
        "non-finite": int((~np.isfinite(commands)).sum()),
        "position": beyond,
        "velocity": int((np.abs(commands) > limits.velocity * more).sum()),
        "acceleration": int((np.abs(acceleration) > limits.acceleration * more).sum()),
        "jerk": int((np.abs(jerk) > limits.jerk * more).sum()),
    }


class Rig:
    """A guard, a clock, and an arm that does what it is told."""

    def __init__(
        self,
        period: float = 1 / 240,
        limits: JointLimits = PANDA,
        start: FloatArray = HOME,
        options: GuardOptions | None = None,
    ) -> None:
        self.guard = MotionGuard(limits, start, period, options)
        self.limits, self.period, self.now = limits, period, 100.0
        self.start = self.q = np.array(start)
        self.measured: list[Any] = []
        self.commands: list[FloatArray] = []

    def step(self, desired: Any = WISH, hold: str | None = None, **wrong: Any) -> Command:
        self.now += self.period
        given = {"now": self.now, "measured": self.q, "desired": desired, "stamp": self.now - 0.03, **wrong}
        command = self.guard.step(**given, hold=hold)
        self.measured.append(given["measured"])
        self.commands.append(command.velocity)
        self.q = self.q + self.period * command.velocity
        return command

    def run(self, seconds: float, desired: Any = WISH, hold: str | None = None) -> FloatArray:
        """(K, n) commands."""
        return np.array([self.step(desired, hold).velocity for _ in range(math.ceil(seconds / self.period))])

    def to_rest(self) -> int:
        """Steps that braking takes."""
        for count in range(100_000):
            if self.guard.at_rest:
                return count
            assert self.step(hold="stop").reason is Reason.HOLD
        raise AssertionError("does not come to rest")

    def check(self) -> None:
        commands = np.array(self.commands)
        paths = motions(self.start, commands, self.measured, self.period)
        assert not any(violations(self.limits, self.period, paths, commands).values())


@pytest.mark.parametrize("period", PERIODS)
@pytest.mark.parametrize("limits", [PANDA, FR3], ids=["panda", "fr3"])
def test_random_wishes_keep_the_limits(period: float, limits: JointLimits) -> None:
    rng = np.random.default_rng(round(1 / period))
    for _ in range(5):
        near = limits.upper - (limits.upper - limits.lower) * np.round(rng.random(7)) - 10 ** rng.uniform(-6, -2, 7)
        start = np.where(rng.random(7) < 0.5, near, rng.uniform(limits.lower, limits.upper))
        rig = Rig(period, limits, start)
        while len(rig.commands) < 1000:
            wish = limits.velocity * rng.normal(size=7) * 10 ** rng.uniform(-3, 2)
            rig.run(rng.integers(1, 40) * period, wish)
        rig.check()


def slow_reach(v: float, a: float, acceleration: float, jerk: float, period: float) -> float:
    """How far up a braking joint gets, step by step, each deceleration found by trying which can be taken back."""
    here = highest = 0.0
    while abs(v) > 1e-12 or abs(a) > 1e-9:
        low, high = 0.0, acceleration
        for _ in range(60):
            middle = 0.5 * (low + high)
            taken_back = np.arange(middle, 0, -jerk).sum() * period
            low, high = (middle, high) if taken_back <= abs(v) else (low, middle)
        a = float(np.clip(-math.copysign(low, v), a - jerk, a + jerk))
        v += period * a
        here += period * v
        highest = max(highest, here)
    return highest


@pytest.mark.parametrize("jerk", [0.7, 3.0, 10.0, 25.0])
def test_reach_equals_its_twin(jerk: float) -> None:
    rng = np.random.default_rng(11)
    for _ in range(40):
        v, a = rng.uniform(-1, 1) * 10 ** rng.uniform(-2, 0), rng.uniform(-10, 10)
        assert joint_steps._reach(v, a, 10.0, jerk, 0.01) == pytest.approx(slow_reach(v, a, 10.0, jerk, 0.01), abs=1e-9)


@pytest.mark.parametrize("period", PERIODS)
def test_braking_ends_exactly_at_rest(period: float) -> None:
    rng = np.random.default_rng(1)
    for _ in range(40):
        rig = Rig(period)
        rig.run(rng.uniform(0, 0.3), rng.normal(size=7))
        rig.run(rng.integers(1, 4) * period, 10 * rng.normal(size=7))
        rig.to_rest()
        assert not rig.run(0.02, hold="stop").any()
        rig.check()


@pytest.mark.parametrize("period", PERIODS)
@pytest.mark.parametrize("joint", range(7))
def test_stop_is_as_short_as_the_limits_permit(period: float, joint: int) -> None:
    rig = Rig(period, start=np.where(np.arange(7) == joint, PANDA.lower, HOME))
    rig.run(0.6, PANDA.velocity * (np.arange(7) == joint))
    speed, acceleration = PANDA.velocity[joint], PANDA.acceleration[joint]
    assert rig.guard.velocity[joint] == speed
    start = rig.q[joint]
    duration, angle = rig.to_rest() * period, rig.q[joint] - start
    ramp = acceleration / PANDA.jerk[joint]
    assert speed / acceleration <= duration <= speed / acceleration + ramp + 2.001 * period
    assert abs(angle - speed**2 / (2 * acceleration)) <= speed * (ramp + period)
    if joint == 1:
        assert duration == pytest.approx(0.290, abs=ramp + 2 * period)
        assert angle == pytest.approx(0.315, abs=speed * (ramp + period))


@pytest.mark.parametrize("period", PERIODS)
@pytest.mark.parametrize("sign", [-1, 1])
def test_constant_wish_is_reached_in_its_direction_and_held_exactly(period: float, sign: int) -> None:
    rig = Rig(period)
    commands = sign * rig.run(0.3, sign * np.abs(WISH)) * np.sign(WISH)
    reached = int(np.argmax((commands == WISH).all(axis=1)))
    assert 0 < reached * period + period <= 0.05 + 1 / 240 + period
    assert (commands[reached:] == WISH).all()
    assert (np.abs(commands) <= np.abs(WISH) * (1 + 1e-12)).all()
    share = commands[:reached] @ WISH / (WISH @ WISH)
    np.testing.assert_allclose(commands[:reached], np.outer(share, WISH), atol=1e-3 if period < 1e-3 else 1e-12)


@pytest.mark.parametrize("period", PERIODS)
def test_feasible_trajectory_passes_unchanged(period: float) -> None:
    rig = Rig(period)
    amplitude = PANDA.acceleration / (3 * math.pi)
    for _ in range(math.ceil(2 / period)):
        seconds = rig.now + rig.period - 100
        # A start without a step in acceleration.
        wish = np.minimum(amplitude, 0.9) * math.sin(math.pi * seconds) * math.sin(math.pi * seconds / 2)
        np.testing.assert_allclose(rig.step(wish).velocity, wish, rtol=0, atol=1e-12)


def test_too_fast_a_wish_keeps_its_direction() -> None:
    rig = Rig()
    wish = 20 * WISH
    final = rig.run(0.4, wish)[-1]
    np.testing.assert_allclose(final, wish * (2.61 / 20), rtol=1e-12)
    assert (np.abs(final) <= PANDA.velocity).all()
    np.testing.assert_allclose(rig.run(0.1, 1e300 * WISH)[-1], final, rtol=1e-12)


@pytest.mark.parametrize("period", PERIODS)
@pytest.mark.parametrize("side", [-1, 1])
def test_joint_driven_against_its_limit_stops_at_it(period: float, side: int) -> None:
    limit = PANDA.upper if side > 0 else PANDA.lower
    for joint in range(7):
        rig = Rig(period, start=np.where(np.arange(7) == joint, limit - side * 0.7, HOME))
        rig.run(1.5, 50.0 * side * (np.arange(7) == joint))
        assert abs(rig.q[joint] - limit[joint]) < 1e-9
        rig.check()


@pytest.mark.parametrize("joint", [5, 6])
def test_motion_along_the_wish_slows_as_a_whole_before_a_limit(joint: int) -> None:
    limit = np.where(WISH > 0, PANDA.upper, PANDA.lower)
    rig = Rig(start=np.where(np.arange(7) == joint, limit - 0.5 * np.sign(WISH), HOME))
    commands = rig.run(2, WISH)
    shares = commands @ WISH / (WISH @ WISH)
    np.testing.assert_allclose(commands, np.outer(shares, WISH), atol=1e-12)
    assert shares[-1] < 1e-6


@pytest.mark.parametrize("period", PERIODS)
def test_turning_back_close_to_a_limit(period: float) -> None:
    """An acceleration towards the limit must be taken back before it, even if the joint still moves away from it."""
    rng = np.random.default_rng(6)
    for _ in range(40):
        distance, side = 10 ** rng.uniform(-7, -3, 7), rng.choice([-1, 1], 7)
        rig = Rig(period, start=np.where(side > 0, PANDA.upper - distance, PANDA.lower + distance))
        for _ in range(4):
            rig.run(rng.integers(1, 12) * period, -side * 10 ** rng.uniform(-3, 0))
            rig.run(rng.integers(1, 12) * period, side * rng.uniform(0, 2))
        rig.check()


@pytest.mark.parametrize("period", PERIODS)
@pytest.mark.parametrize("sign", [-1, 1])
def test_full_acceleration_ends_at_the_speed_limit(period: float, sign: int) -> None:
    rig = Rig(period)
    for _ in range(math.ceil(0.36 / period)):
        rig.step(rig.guard.velocity_bounds(rig.q)[(sign + 1) // 2])
    np.testing.assert_allclose(np.abs(rig.commands).max(axis=0)[[0, 2, 4, 6]], PANDA.velocity[[0, 2, 4, 6]])
    rig.check()


@pytest.mark.parametrize("period", PERIODS)
def test_no_joint_moves_away_from_its_wish_but_to_take_acceleration_back(period: float) -> None:
    rng = np.random.default_rng(9)
    jerk = PANDA.jerk * period
    for _ in range(20):
        rig, velocity, acceleration = Rig(period), np.zeros(7), np.zeros(7)
        while len(rig.commands) * period < 0.5 and len(rig.commands) < 300:
            wish = rng.uniform(-1, 1, 7)
            for _ in range(rng.integers(1, 20)):
                after = rig.step(wish).velocity
                free = np.abs(acceleration) <= jerk
                assert ((after - velocity) * (wish - velocity) >= -1e-15)[free].all()
                assert (np.abs(after - velocity) <= np.abs(wish - velocity) + 1e-15)[free].all()
                velocity, acceleration = after, (after - velocity) / period


@pytest.mark.parametrize("period", PERIODS)
def test_from_beyond_a_limit_only_inward(period: float) -> None:
    start = np.where(np.arange(7) == 2, PANDA.upper + 0.1, HOME)
    outward, inward = 0.5 * (np.arange(7) == 2), -0.5 * (np.arange(7) == 2)
    rig = Rig(period, start=start)
    assert rig.run(0.3, outward).max() <= 0
    assert rig.run(0.1, inward)[-1, 2] < -0.1
    deepest = rig.q[2]
    commands = rig.run(0.5, outward)
    assert rig.q[2] <= deepest
    assert abs(commands[-1, 2]) < 1e-9
    rig.run(0.5, inward)
    assert rig.q[2] < PANDA.upper[2]
    rig.check()


@pytest.mark.parametrize("side", [-1, 1])
def test_joint_at_its_limit_does_not_stop_the_others_unless_asked_for_more(side: int) -> None:
    third = np.arange(7) == 2
    start = np.where(third, PANDA.upper if side > 0 else PANDA.lower, HOME)
    others = np.where(third, 0, WISH)
    for outward in (0.0, -0.2, 5e-5):
        assert (Rig(start=start).run(0.2, others + side * outward * third)[-1, ~third] == WISH[~third]).all()
    assert not Rig(start=start).run(0.2, others + side * 0.2 * third).any()
    rig = Rig(start=start)
    for _ in range(48):
        lower, upper = rig.guard.velocity_bounds(rig.q)
        rig.step(np.clip(others + side * 0.2 * third, lower, upper))
    np.testing.assert_allclose(rig.guard.velocity, others, atol=1e-9)


@pytest.mark.parametrize("period", PERIODS)
@pytest.mark.parametrize("noise", [0, 1e-3])
def test_wish_within_the_bounds_is_met(period: float, noise: float) -> None:
    rng = np.random.default_rng(3)
    near = np.where(rng.random(7) < 0.5, PANDA.upper - 0.01, PANDA.lower + 0.01)
    rig = Rig(period, start=np.where(rng.random(7) < 0.7, near, HOME))
    for step in range(600):
        measured = rig.q + noise * rng.normal(size=7)
        lower, upper = rig.guard.velocity_bounds(measured)
        assert (lower <= upper).all()
        share = rng.random(7) if step % 50 < 25 else float(step % 100 < 50)
        wish = np.minimum(lower + share * (upper - lower), upper)
        np.testing.assert_array_equal(rig.step(wish, measured=measured).velocity, wish)
    rig.check()


@pytest.mark.parametrize("period", PERIODS)
def test_bounds_far_from_any_limit_are_those_of_acceleration_and_jerk(period: float) -> None:
    lower, upper = Rig(period).guard.velocity_bounds([math.nan] * 7)  # type: ignore[arg-type]
    reach = np.minimum(np.minimum(PANDA.acceleration, PANDA.jerk * period) * period, PANDA.velocity)
    np.testing.assert_allclose([-lower, upper], [reach, reach])


WRONG: list[tuple[dict[str, Any], Reason, str]] = [
    ({"now": math.nan}, Reason.INPUT, "time is nan"),
    ({"now": "noon"}, Reason.INPUT, "time is 'noon'"),
    ({"now": math.inf}, Reason.INPUT, "time is inf"),
    ({"now": np.array([100.0, 101.0])}, Reason.INPUT, "time is array"),
    ({"stamp": np.array([100.0])}, Reason.INPUT, "stamp is array"),
    ({"stamp": np.complex128(100)}, Reason.INPUT, "stamp is"),
    ({"stamp": math.nan}, Reason.INPUT, "stamp is nan"),
    ({"stamp": None}, Reason.INPUT, "stamp is None"),
    ({"stamp": -math.inf}, Reason.INPUT, "stamp is -inf"),
    ({"measured": HOME[:6]}, Reason.INPUT, "measured position has shape (6,)"),
    ({"measured": None}, Reason.INPUT, "measured position is no array"),
    ({"measured": np.where(np.arange(7) == 3, np.nan, HOME)}, Reason.INPUT, "measured position of joint 4 is nan"),
    ({"desired": np.zeros((7, 1))}, Reason.INPUT, "desired velocity has shape (7, 1)"),
    ({"desired": None}, Reason.INPUT, "desired velocity is no array"),
    ({"desired": ["fast"] * 7}, Reason.INPUT, "desired velocity is no array"),
    ({"desired": [[1], [2, 3]]}, Reason.INPUT, "desired velocity is no array"),
    ({"desired": np.ones(7, complex)}, Reason.INPUT, "desired velocity is no array"),
    ({"desired": np.where(np.arange(7) == 6, -np.inf, WISH)}, Reason.INPUT, "desired velocity of joint 7 is -inf"),
    ({"hold": "the rope is lost"}, Reason.HOLD, "the rope is lost"),
    ({"hold": "", "desired": None}, Reason.HOLD, ""),
    ({"stamp": 0.0}, Reason.STALE, "s old: at most 0.1 s"),
    ({"stamp": 1e9}, Reason.STALE, "at most 0.02 s in the future"),
    ({"now": 50.0, "stamp": 50.0}, Reason.CLOCK, "s since the last step"),
    ({"now": 5000.0, "stamp": 5000.0}, Reason.CLOCK, "s since the last step"),
    ({"now": 1.7e308, "stamp": 1.7e308}, Reason.CLOCK, "s since the last step"),
    ({"measured": HOME + 10}, Reason.TRACKING, "joint 7 is at 10.79 rad"),
]


@pytest.mark.parametrize(("wrong", "reason", "text"), WRONG)
@pytest.mark.parametrize("period", [1 / 240, 1 / 1000])
def test_what_is_wrong_brakes_in_the_same_step(wrong: dict[str, Any], reason: Reason, text: str, period: float) -> None:
    rig, twin = Rig(period), Rig(period)
    for each in (rig, twin):
        assert (each.run(0.2)[-1] == WISH).all()
    command = rig.step(**wrong)
    assert command.reason is reason
    assert text in command.text
    np.testing.assert_array_equal(command.velocity, twin.step(hold="stop").velocity)
    assert (np.abs(command.velocity) < np.abs(WISH)).all()
    rig.step()
    after = rig.step()
    if reason is Reason.TRACKING:
        assert after.reason is reason
        assert not rig.run(0.4)[-1].any()
    else:
        assert after == (after.velocity, None, "")
        assert (rig.run(0.2)[-1] == WISH).all()


@pytest.mark.parametrize("period", PERIODS)
def test_speed_never_grows_while_braking_but_to_take_the_acceleration_back(period: float) -> None:
    rng = np.random.default_rng(5)
    grew = 0.0
    for _ in range(30):
        rig = Rig(period)
        rig.run(rng.uniform(0, 0.3), 3 * rng.normal(size=7))
        state = rig.guard.velocity
        acceleration = (state - (rig.commands[-2] if len(rig.commands) > 1 else 0)) / period
        count = rig.to_rest()
        speeds = np.abs([state, *rig.commands[len(rig.commands) - count :]])
        jerk = PANDA.jerk * period
        most = np.where(jerk >= 2 * PANDA.acceleration, 0, acceleration**2 / (2 * PANDA.jerk))
        assert (speeds.max(axis=0) <= speeds[0] + most + 1e-12).all()
        grew = max(grew, (speeds.max(axis=0) - speeds[0]).max())
    assert (grew == 0) == (period >= 1 / 250)


def test_any_form_of_array_is_taken_without_compiling_again() -> None:
    expected = Rig().step().velocity
    strided = np.repeat(WISH, 2)[::2]
    fixed = WISH.copy()
    fixed.flags.writeable = False
    tool = ToolLimits()
    forms: list[Any] = [strided, fixed, list(WISH), tuple(WISH), WISH.astype(">f8")]
    for form in forms:
        np.testing.assert_array_equal(Rig().step(form, measured=tuple(HOME)).velocity, expected)
        np.testing.assert_array_equal(tool.scale(np.zeros((7, 6)).T, fixed[:3], form), WISH)
    Rig().step(WISH.astype(np.float32))
    Rig().step(np.arange(7))
    Rig().guard.velocity_bounds(fixed)
    for kernel in (joint_steps.move, joint_steps.bound, joint_steps.all_finite, tool_limits._tool_share):
        assert len(kernel.signatures) == 1


def test_clock_must_go_on_by_less_than_five_periods() -> None:
    for late, reason in ((0, None), (-1, Reason.CLOCK), (-1.5, Reason.CLOCK), (3.9, None), (4.1, Reason.CLOCK)):
        rig = Rig()
        rig.now = 0.0
        rig.step()
        rig.now += late * rig.period
        assert rig.step().reason is reason
        assert rig.step().reason is None


def test_age_of_the_trajectory() -> None:
    for age, reason in ((0.099, None), (0.101, Reason.STALE), (-0.019, None), (-0.021, Reason.STALE)):
        rig = Rig()
        assert rig.step(stamp=rig.now + rig.period - age).reason is reason


def test_stale_trajectory_stops_the_arm_and_a_fresh_one_starts_it_again() -> None:
    rig = Rig()
    rig.run(0.2)
    stamp, braking, reasons = rig.now, 0.0, set()
    while not rig.guard.at_rest:
        command = rig.step(stamp=stamp)
        braking += rig.period * (command.reason is not None)
        reasons.add(command.reason)
    assert reasons == {None, Reason.STALE}
    assert rig.now - stamp <= 0.1 + braking + rig.period
    assert braking <= (np.abs(WISH) / PANDA.acceleration).max() + 3 * rig.period
    rig.run(1)
    assert (rig.commands[-1] == WISH).all()
    rig.check()


def test_arm_that_is_not_where_it_was_sent_stays_stopped_until_reset() -> None:
    rig = Rig()
    rig.run(0.2)
    rig.q = rig.q + np.array([0, 0, 0.099, 0, 0, 0, 0])
    assert rig.step().reason is None
    rig.q = rig.q - np.array([0, 0, 0, 0.11, 0, 0, 0])
    command = rig.step()
    assert command.reason is Reason.TRACKING
    assert "joint 4" in command.text
    with pytest.raises(RopetraceError, match="still moving"):
        rig.guard.reset(rig.q)
    rig.q = rig.q + np.array([0, 0, 0, 0.11, 0, 0, 0])
    assert not rig.run(0.5)[-1].any()
    assert rig.step(hold="done").reason is Reason.TRACKING
    for wrong in (HOME[:6], np.full(7, np.nan), None):
        with pytest.raises(ValueError, match="the position"):
            rig.guard.reset(wrong)  # type: ignore[arg-type]
    rig.guard.reset(rig.q)
    assert rig.step().reason is None


def test_commands_that_last_longer_or_shorter_than_a_period_are_counted_as_long_as_they_last() -> None:
    """A loop on a busy machine: 25 ms are missed again and again, then made up for; the arm holds what it was told."""
    rig = Rig(1 / 200)
    rig.run(0.1)
    drift = 0.0
    for _ in range(40):
        for late in (4.0, -0.9, -0.9, 0.0):
            rig.now += late * rig.period
            rig.q = rig.q + late * rig.period * rig.commands[-1]
            drift += late * rig.period
            assert rig.step().reason is None
    np.testing.assert_allclose(rig.guard.position, rig.q, atol=1e-9)
    assert drift * np.abs(WISH).max() > rig.guard.options.max_tracking_error


@pytest.mark.parametrize("unknown", [0, 3])
@pytest.mark.parametrize(("held", "fault"), [(0.0, False), (0.4, False), (1.0, False), (1.6, True), (-0.6, True)])
def test_after_a_gap_the_arm_may_be_anywhere_on_its_way(held: float, fault: bool, unknown: int) -> None:
    """Also where its position is not known at first."""
    rig = Rig()
    rig.run(0.3)
    rig.now += 0.3
    rig.q = rig.q + held * 0.3 * rig.commands[-1]
    for _ in range(unknown):
        assert rig.step(measured=np.full(7, np.nan)).reason in (Reason.CLOCK, Reason.INPUT)
    command = rig.step()
    if fault:
        assert command.reason is Reason.TRACKING
    else:
        assert command.reason is (None if unknown else Reason.CLOCK)
        np.testing.assert_allclose(rig.guard.position, rig.q, atol=1e-9)
        rig.to_rest()
        np.testing.assert_allclose(rig.guard.position, rig.q, atol=1e-9)


@pytest.mark.parametrize("clock", ["every fifth time is not known", "it has half the resolution"])
def test_a_clock_that_is_bad_now_and_then_adds_up_to_nothing(clock: str) -> None:
    rig = Rig()
    rig.run(0.2)
    for count in range(400):
        coarse = rig.now + rig.period * (count % 2)
        now = coarse if clock.startswith("it") else math.nan if count % 5 == 0 else rig.now + rig.period
        rig.step(now=now, stamp=rig.now)
    np.testing.assert_allclose(rig.guard.position, rig.q, atol=1.5 * rig.period * np.abs(WISH).max())


def test_what_is_located_is_of_now() -> None:
    """A step that comes three periods late, fast, at a low rate: the controller asks before it steps."""
    rig = Rig(1 / 30)
    rig.run(1.0, 2 * WISH)
    rig.now += 3 * rig.period
    rig.q = rig.q + 3 * rig.period * rig.commands[-1]
    assert rig.guard.locate(rig.now + rig.period, rig.q) is not None
    np.testing.assert_allclose(rig.guard.position, rig.q, atol=1e-9)
    assert rig.step(2 * WISH).reason is None
    np.testing.assert_allclose(rig.guard.position, rig.q, atol=1e-9)
    assert rig.guard.locate(rig.now + rig.period, rig.q + 0.11) is None


@pytest.mark.parametrize("side", [-1, 1])
def test_room_is_counted_from_the_worse_of_commanded_and_measured_position(side: int) -> None:
    first = np.arange(7) == 0
    near = np.where(first, side * (PANDA.upper - 0.3), HOME)
    for offset in (0.04, -0.04):
        rig = Rig(start=near)
        rig.q = near + offset * first
        rig.run(1, 2.0 * side * first)
        assert max(side * rig.q[0], side * rig.guard.position[0]) == pytest.approx(PANDA.upper[0], abs=1e-9)
    rng = np.random.default_rng(2)
    rig = Rig(start=near)
    for _ in range(500):
        rig.step(2.0 * side * first, measured=rig.q + 0.005 * rng.normal(size=7))
    rig.check()
    assert PANDA.upper[0] - 0.02 < side * rig.q[0] <= PANDA.upper[0] + TOLERANCE


def test_motion_after_rest_starts_from_the_measured_position() -> None:
    rig = Rig()
    rig.q = HOME + 0.05
    for _ in range(2):
        rig.run(0.2)
        rig.run(0.3, 0 * WISH)
    assert rig.guard.position == pytest.approx(rig.q - 0.05)
    rig.run(0.5, 0 * WISH)
    assert rig.guard.position == pytest.approx(rig.q - 0.05)
    rig.step()
    np.testing.assert_allclose(rig.guard.position, rig.q, rtol=0, atol=1e-15)


def test_options() -> None:
    options = GuardOptions(velocity_scale=0.5, acceleration_scale=0.25, margin=0.2)
    rig = Rig(start=np.where(np.arange(7) == 0, 1.5, HOME), options=options)
    commands = rig.run(2, 10.0 * (np.arange(7) == 0))
    assert commands.max() == pytest.approx(0.5 * PANDA.velocity[0])
    assert np.diff(commands[:, 0]).max() == pytest.approx(0.25 * PANDA.acceleration[0] * rig.period)
    assert rig.q[0] == pytest.approx(PANDA.upper[0] - 0.2, abs=1e-9)


@pytest.mark.parametrize(
    "wrong",
    [
        {"velocity_scale": 0.0},
        {"acceleration_scale": 1.1},
        {"velocity_scale": math.nan},
        {"margin": -0.1},
        {"margin": math.inf},
        {"max_age": 0.0},
        {"max_future": math.nan},
        {"max_gap": 1.0},
        {"max_tracking_error": -1.0},
    ],
)
def test_impossible_options(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        GuardOptions(**wrong)


def test_impossible_guards() -> None:
    for period in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ConfigError, match="period"):
            MotionGuard(PANDA, HOME, period)
    with pytest.raises(ConfigError, match="no range"):
        MotionGuard(PANDA, HOME, 0.01, GuardOptions(margin=1.8))
    with pytest.raises(ConfigError, match="jerk"):
        MotionGuard(PANDA, HOME, 1e-6)
    with pytest.raises(ValueError, match="expected \\(7,\\)"):
        MotionGuard(PANDA, HOME[:3], 0.01)


anything = st.floats(width=64)
vectors = st.one_of(
    st.lists(anything, min_size=7, max_size=7),
    st.lists(st.floats(-5, 5), min_size=7, max_size=7),
    st.lists(anything, max_size=8),
    st.none(),
)
moments = st.one_of(st.floats(0, 0.02), anything)


@given(
    st.sampled_from([PANDA, FR3]),
    st.sampled_from(PERIODS),
    st.lists(st.floats(-0.05, 1.05), min_size=7, max_size=7),
    st.lists(
        st.tuples(
            st.integers(1, 30),
            vectors,
            st.one_of(st.floats(-0.05, 0.05), vectors),
            moments,
            moments,
            st.sampled_from([None, None, "x"]),
        ),
        max_size=12,
    ),
)
@settings(max_examples=150, deadline=None)
def test_limits_hold_for_any_input(limits: JointLimits, period: float, place: list[float], phases: list[Any]) -> None:
    rig = Rig(period, limits, limits.lower + np.array(place) * (limits.upper - limits.lower))
    for count, desired, measured, late, age, hold in phases:
        for _ in range(count):
            seen = rig.q + measured if isinstance(measured, float) else measured
            rig.now += late if 0 <= late < period else 0
            wrong = {} if 0 <= late < period else {"now": late}
            rig.step(desired, hold, measured=seen, stamp=rig.now - age, **wrong)
    rig.step()
    rig.check()


JACOBIAN = np.random.default_rng(8).normal(size=(6, 7))


def test_tool_keeps_its_speeds() -> None:
    tool = ToolLimits(linear=0.2, angular=0.5)
    rng = np.random.default_rng(0)
    for _ in range(200):
        jacobian, wish = rng.normal(size=(6, 7)), rng.normal(size=7) * 10 ** rng.uniform(-3, 3)
        scaled = tool.scale(jacobian, np.zeros(3), wish)
        linear, angular = np.linalg.norm((jacobian @ wish).reshape(2, 3), axis=1)
        np.testing.assert_allclose(scaled, wish * min(1, 0.2 / linear, 0.5 / angular), rtol=1e-12)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", [-1, 1])
def test_tool_stops_at_a_wall_and_comes_back(axis: int, side: int) -> None:
    period, deceleration = 1 / 240, 2.0
    tool = ToolLimits(low=[-0.5, -0.6, 0.1], high=[0.5, 0.6, 0.9], deceleration=deceleration, period=period)
    wall = np.array([[-0.5, -0.6, 0.1], [0.5, 0.6, 0.9]])[(side + 1) // 2, axis]
    jacobian = np.eye(6)
    position, outward = np.array([0, 0, 0.5]), np.zeros(6)
    outward[axis] = side
    speed = 1.0
    for _ in range(400):
        scaled = tool.scale(jacobian, position, outward)
        assert speed - abs(scaled[axis]) <= deceleration * period * (1 + 1e-9)
        speed = abs(scaled[axis])
        position = position + period * scaled[:3]
        assert side * (position[axis] - wall) <= 1e-12
    assert abs(position[axis] - wall) < 1e-3
    along = np.roll(outward, 1)
    np.testing.assert_array_equal(tool.scale(jacobian, position + 0.01 * outward[:3], along), along)
    np.testing.assert_array_equal(tool.scale(jacobian, position + 0.01 * outward[:3], -outward), -outward)
    assert not tool.scale(jacobian, position + 0.01 * outward[:3], outward).any()


def test_tool_request_that_cannot_be_judged_brakes_the_guard() -> None:
    tool, rig = ToolLimits(), Rig()
    bad = JACOBIAN.copy()
    bad[4, 2] = np.nan
    for request in (
        (bad, np.zeros(3), WISH),
        (JACOBIAN, np.array([0, np.inf, 0]), WISH),
        (JACOBIAN, np.zeros(3), np.where(np.arange(7) == 1, np.nan, WISH)),
        (JACOBIAN[:3], np.zeros(3), WISH),
        (JACOBIAN[:, :6], np.zeros(3), WISH),
        (JACOBIAN, np.zeros(2), WISH),
    ):
        assert rig.step(tool.scale(*request)).reason is Reason.INPUT


@pytest.mark.parametrize(
    "wrong",
    [
        {"linear": 0.0},
        {"angular": math.nan},
        {"deceleration": -1.0},
        {"period": math.inf},
        {"low": (0, 0, 0), "high": (1, 1, 0)},
        {"low": (0, 0)},
        {"low": (math.nan, 0, 0)},
    ],
)
def test_impossible_tool_limits(wrong: dict[str, Any]) -> None:
    with pytest.raises((ConfigError, ValueError)):
        ToolLimits(**wrong)
