"""The controller: frames in, commands out, and nothing that comes in makes it raise or break a limit."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ropetrace.control.arm import Arm
from ropetrace.control.controller import LOST_AFTER, UNKNOWN, Control, TracingController
from ropetrace.control.limits import GuardOptions, Reason
from ropetrace.control.tracing import Phase
from ropetrace.errors import ConfigError
from ropetrace.motion import make_motion
from ropetrace.types import Estimate, Status, Waypoints, moved
from test_limits import PANDA, motions, violations
from tracing_rig import PERIOD, START, KnownMotion, Loop, Rope, camera_pose, hanging, waypoints

pytest.importorskip("pinocchio")

ARM = Arm.named("panda")
SWINGING = hanging(swing=0.1)


@pytest.fixture
def panda() -> Arm:
    return ARM


@pytest.fixture
def running(panda: Arm) -> Loop:
    """Half a second into a tracing."""
    loop = Loop(panda, SWINGING)
    for _ in range(120):
        control = loop.step()
    assert control.step is not None
    assert control.step.phase is Phase.TRACING
    return loop


def check(loop: Loop) -> None:
    commands = np.array(loop.commands)
    paths = motions(loop.start, commands, loop.measured, PERIOD)
    assert not any(violations(PANDA, PERIOD, paths, commands).values())


def seconds_until(loop: Loop, reason: Reason) -> float:
    """From the newest frame's stamp until the guard brakes."""
    stamp = loop.controller._stamp
    assert stamp is not None
    for _ in range(60):
        control = loop.step()
        if control.command.reason is reason:
            return loop.now - stamp
        assert control.command.reason is None
    raise AssertionError("does not brake")


def test_traces_with_the_estimators_motion(panda: Arm) -> None:
    """With centrelines that are exact, at 30 frames a second: what the prediction is wrong by, the tool is off."""
    motion = make_motion("arc_length", 0.012)
    assert motion is not None
    loop = Loop(panda, SWINGING)
    loop.controller._motion = motion
    control = loop.run()
    assert control.step is not None
    assert control.step.phase is Phase.DONE
    assert np.mean(loop.errors) < 0.002
    assert control.command.reason is Reason.HOLD
    assert control.command.text == "done"
    check(loop)


def test_stands_still_until_the_motion_is_known(panda: Arm) -> None:
    loop = Loop(panda, SWINGING)
    loop.blind = True
    for _ in range(10):
        control = loop.step()
        assert control.step is None
        assert control.command.text == UNKNOWN
    np.testing.assert_array_equal(loop.commands, np.zeros((10, 7)))


def test_braking_begins_within_100_ms_of_the_newest_stamp(running: Loop) -> None:
    running.blind = True
    begun = seconds_until(running, Reason.STALE)
    assert 0.08 < begun <= 0.1
    speeds = [np.abs(running.step().command.velocity).max() for _ in range(120)]
    assert speeds[-1] == 0
    check(running)


def test_a_stamp_from_the_future_is_as_good_as_none(running: Loop) -> None:
    running.blind = True
    for ahead, reason in ((0.01, None), (0.03, Reason.STALE), (1e6, Reason.STALE)):
        running.controller.see(running.estimate(running.now + PERIOD + ahead))
        assert running.step().command.reason is reason
    check(running)


def test_frames_without_the_rope_stop_the_arm(running: Loop) -> None:
    running.blind = True
    lost = Estimate.lost(round(running.now * 1e9), "dark")
    for count in range(1, LOST_AFTER + 1):
        running.controller.see(lost)
        control = running.step()
        assert (control.command.reason is None) == (count < LOST_AFTER)
    assert control.command.reason is Reason.HOLD
    assert control.command.text == f"the rope is lost: {LOST_AFTER} frames without it"
    running.blind = False
    assert running.run().command.text == "done"
    check(running)


def test_waypoints_that_are_not_finite_are_no_frame(running: Loop) -> None:
    seen = running.estimate(running.now)
    positions = seen.waypoints.positions.copy()
    positions[3, 0] = math.nan
    for _ in range(LOST_AFTER):
        running.controller.see(replace(seen, waypoints=replace(seen.waypoints, positions=positions)))
    running.blind = True
    assert running.step().command.text.startswith("the rope is lost")


def test_frames_in_another_order_and_without_waypoints_do_no_harm(running: Loop) -> None:
    motion = make_motion("arc_length", 0.012)
    assert motion is not None
    running.controller._motion = motion
    running.blind = True
    for back in (0.03, 0.0, 0.06, -0.01, 3.0):
        running.controller.see(running.estimate(running.now - back))
        running.step()
    stamp = round(running.now * 1e9)
    running.controller.see(Estimate(stamp, Status.DEGRADED, ("nothing",), waypoints=Waypoints.none()))
    assert running.step().command.text == UNKNOWN
    running.blind = False
    assert running.run().command.text == "done"
    check(running)


@pytest.mark.parametrize(
    ("q", "reason"),
    [
        (np.full(7, np.nan), Reason.INPUT),
        (np.zeros(6), Reason.INPUT),
        (None, Reason.INPUT),
        ("joints", Reason.INPUT),
        ([[1], [2, 3]], Reason.INPUT),
        (START.astype(complex), Reason.INPUT),
        (START + [0, 0, 0, 0.2, 0, 0, 0], Reason.TRACKING),
        (np.full(7, 1.7e308), Reason.TRACKING),
    ],
)
def test_a_position_that_is_wrong_brakes_and_says_so(panda: Arm, q: Any, reason: Reason) -> None:
    loop = Loop(panda, SWINGING)
    loop.step()
    control = loop.act(loop.now + PERIOD, q)
    assert control.step is None
    assert control.command.reason is reason


@pytest.mark.parametrize("now", [math.nan, math.inf, None, "now", [1.0], 10**400, 1e308, -1e308, True])
def test_a_time_that_is_wrong_brakes(running: Loop, now: Any) -> None:
    control = running.act(now, running.q)
    assert control.command.reason in (Reason.INPUT, Reason.CLOCK)
    check(running)


def test_time_that_stands_still_or_runs_back_brakes(running: Loop) -> None:
    for now in (running.now, running.now - PERIOD):
        assert running.act(now, running.q).command.reason is Reason.CLOCK
    assert running.step().command.reason is None
    check(running)


def test_a_prediction_that_is_not_finite_brakes(running: Loop) -> None:
    for bad in (np.nan, np.inf, -np.inf, 1e200, 1e308):
        right = running.controller._motion
        running.controller._motion = Spoilt(running, bad, 12)
        control = running.step()
        assert np.isfinite(control.command.velocity).all()
        running.controller._motion = right
        check(running)
    assert running.run().command.text == "done"


class Spoilt(KnownMotion):
    """Predicts with one number that is wrong."""

    def __init__(self, loop: Loop, bad: float, where: int) -> None:
        super().__init__(loop.rope, loop.camera_from_base)
        self.stamp_ns = loop.controller._motion.stamp_ns
        self.bad, self.where = bad, where

    def predict(self, ahead: float) -> Any:
        prediction = super().predict(ahead)
        assert prediction is not None
        positions, motion = prediction
        part = (positions, motion.velocities, motion.accelerations)[self.where % 3]
        part[self.where % len(part), 1] = self.bad
        return positions, motion


def test_the_guard_is_given_a_period_less(panda: Arm) -> None:
    loop = Loop(panda, SWINGING, options=GuardOptions(max_age=0.05))
    assert loop.controller.guard.options.max_age == pytest.approx(0.05 - PERIOD)
    with pytest.raises(ConfigError, match="max_age"):
        Loop(panda, SWINGING, options=GuardOptions(max_age=PERIOD / 2))


def test_the_cameras_pose_is_copied(panda: Arm) -> None:
    pose, loop = camera_pose(), Loop(panda, SWINGING)
    controller = TracingController(panda, START, pose, loop.controller._motion, PERIOD)
    pose[:] = np.nan
    controller.see(loop.estimate(10.0))
    assert controller.act(10.0, START).command.reason is None


numbers = st.floats(allow_nan=True, allow_infinity=True)
anything = st.one_of(numbers, st.none(), st.text(max_size=3), st.integers(), st.lists(numbers, max_size=9))


@settings(deadline=None, max_examples=150)
@given(anything, st.one_of(anything, st.lists(numbers, min_size=7, max_size=7)), st.booleans())
@example(math.nan, [1.7e308] * 7, True)
@example([[1]], [[1], [1, 2]], True)
def test_act_never_raises(now: Any, q: Any, seen: bool) -> None:
    loop = Loop(ARM, SWINGING)
    if seen:
        loop.step()
    control = loop.controller.act(now, q)
    assert np.isfinite(control.command.velocity).all()


def jumped(rng: np.random.Generator, loop: Loop) -> Rope:
    """Another rope, somewhere near or not."""
    rope = hanging(rng.uniform(0.001, 1.0), int(rng.integers(2, 120)), rng.uniform(0, 0.3))(loop.now)
    place = rope + rng.normal(size=3) * 10 ** rng.uniform(-3, 1)
    return lambda time: place


def spoil(rng: np.random.Generator, loop: Loop, chance: float) -> Control:
    """A step in which something may be wrong."""
    controller, right = loop.controller, loop.rope
    loop.step_count += 1
    now: Any = loop.now
    measured: Any = loop.q + 0.0005 * rng.normal(size=7)
    if rng.random() < 0.125:
        stamp = now - 0.01
        if rng.random() < chance:
            stamp += rng.choice([-1.0, -0.05, 0.05, 1.0, 1e6])
        if rng.random() < chance:
            loop.rope = jumped(rng, loop)
        controller.see(Estimate.lost(0, "dark") if rng.random() < chance else loop.estimate(stamp))
        loop.rope = right
    kind = rng.random() / chance
    motion = controller._motion
    if kind < 0.2:
        controller._motion = Spoilt(loop, rng.choice([np.nan, np.inf, 1e300, 1e9]), int(rng.integers(100)))
    elif kind < 0.4:
        measured = np.where(rng.random(7) < 0.3, rng.choice([np.nan, np.inf, 1e300]), measured)
    elif kind < 0.5:
        now = rng.choice([np.nan, np.inf, now - 1.0, now + 1.0, now - PERIOD])
    elif kind < 0.6:
        measured = measured[: rng.integers(7)]
    if controller._stamp is None:
        controller._motion = motion
    control = loop.act(now, measured)
    controller._motion = motion
    return control


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.01, 0.1, 0.5]))
def test_limits_hold_under_any_faults(seed: int, chance: float) -> None:
    rng = np.random.default_rng(seed)
    ends = np.where(rng.random(7) < 0.5, PANDA.lower, PANDA.upper)
    start = START if rng.random() < 0.5 else np.where(rng.random(7) < 0.3, ends, rng.uniform(PANDA.lower, PANDA.upper))
    loop = Loop(ARM, SWINGING, start=start)
    for _ in range(240):
        assert np.isfinite(spoil(rng, loop, chance).command.velocity).all()
    check(loop)


def test_estimates_are_taken_in_the_cameras_frame(panda: Arm) -> None:
    loop = Loop(panda, SWINGING)
    seen = loop.estimate(10.0).waypoints.positions
    np.testing.assert_allclose(moved(seen, camera_pose()), SWINGING(10.0), atol=1e-12)
    assert waypoints(seen).length == pytest.approx(waypoints(SWINGING(10.0)).length)
