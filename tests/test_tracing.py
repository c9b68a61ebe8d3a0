"""The tracer: ropes that are still, drift and swing, the phases of the task and how it ends."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ropetrace.control.arm import Arm
from ropetrace.control.tracing import (
    ERROR_TIME,
    FINISH,
    STUCK_TIME,
    Phase,
    RopeTracer,
    Step,
    TracingSettings,
    stopping_velocities,
)
from ropetrace.errors import ConfigError
from ropetrace.types import FloatArray
from test_limits import motions, violations
from tracing_rig import CAMERA_AXIS, PERIOD, START, TOP, Loop, Rope, distance, hanging

pytest.importorskip("pinocchio")

STILL = hanging()


@pytest.fixture(scope="module")
def panda() -> Arm:
    return Arm.named("panda")


def last(loop: Loop, seconds: float = 20.0) -> Step:
    step = loop.run(seconds).step
    assert step is not None
    return step


def shifted(rope: Rope, by: FloatArray) -> Rope:
    return lambda time: rope(time) + by


class Direct:
    """A tracer that is told where the rope is, and an arm that does exactly what is wished."""

    def __init__(self, arm: Arm, start: FloatArray = START, **settings: Any) -> None:
        self.tracer = RopeTracer(arm, TracingSettings(**settings), CAMERA_AXIS)
        self.q, self.now = start, 5.0

    def step(self, positions: FloatArray, elapsed: float = PERIOD) -> Step:
        self.now += elapsed
        still = np.zeros_like(positions)
        step = self.tracer.step(self.now, self.q, positions, still, still)
        if np.isfinite(step.velocity).all():
            self.q = self.q + PERIOD * step.velocity
        return step

    def run(self, positions: FloatArray, seconds: float) -> Step:
        for _ in range(round(seconds / PERIOD)):
            step = self.step(positions)
        return step


# --- how well ---


def test_a_rope_at_rest_is_traced_to_half_a_millimetre(panda: Arm) -> None:
    loop = Loop(panda, STILL)
    step = last(loop)
    assert step.phase is Phase.DONE
    assert step.place >= step.length - FINISH
    assert max(loop.errors) < 0.5e-3
    assert np.mean(loop.errors) < 0.05e-3
    # At the pace of the gain times the distance.
    assert loop.now - 10 == pytest.approx(0.45 / 0.138, rel=0.1)


@pytest.mark.parametrize("drift", [(0.02, 0.06, 0.02), (0, 0.1, 0), (0, 0, 0.1)])
def test_a_rope_that_drifts_is_traced_to_a_millimetre(panda: Arm, drift: tuple[float, ...]) -> None:
    loop = Loop(panda, hanging(length=0.3, drift=drift))
    assert last(loop).phase is Phase.DONE
    assert max(loop.errors[60:]) < 0.3e-3
    assert np.mean(loop.errors) < 0.2e-3


@pytest.mark.parametrize(("swing", "worst"), [(0.1, 0.5e-3), (0.2, 1e-3)])
def test_a_rope_that_swings_is_traced_to_a_millimetre(panda: Arm, swing: float, worst: float) -> None:
    loop = Loop(panda, hanging(swing=swing))
    assert last(loop).phase is Phase.DONE
    assert max(loop.errors) < worst


def test_both_approaches_are_the_same_to_cameras_on_opposite_sides(panda: Arm) -> None:
    rope, loops = hanging(swing=0.1), []
    settings = TracingSettings(lead=PERIOD / 2)
    for one, axis in ((settings, CAMERA_AXIS), (replace(settings, approach="from_camera"), -CAMERA_AXIS)):
        loops.append(Loop(panda, rope, one, camera_axis=axis))
        assert last(loops[-1]).phase is Phase.DONE
        np.testing.assert_allclose(loops[-1].tool[:3, 2], [1, 0, 0], atol=0.15)
    np.testing.assert_allclose(loops[0].commands, loops[1].commands, atol=1e-6)


def test_the_papers_controller_works_and_is_worse_where_the_rope_moves(panda: Arm) -> None:
    """Of waypoints 1 cm apart, swung by 10 cm: 0.05 mm on average along the rope, 0.8 mm from waypoint to waypoint."""
    means: dict[str, float] = {}
    settings = TracingSettings(lead=PERIOD / 2)
    for one in (settings, replace(settings, follow="waypoints")):
        loop = Loop(panda, hanging(swing=0.1), one)
        step = last(loop)
        assert step.phase is Phase.DONE
        assert step.place > step.length - 0.015
        means[one.follow] = float(np.mean(loop.errors))
    assert means["rope"] < 0.1e-3
    assert 5 * means["rope"] < means["waypoints"] < 2e-3


def test_without_feed_forward_the_tool_lags(panda: Arm) -> None:
    settings = TracingSettings(feed_forward=0.0)
    loop = Loop(panda, hanging(length=0.3, drift=(0, 0.05, 0)), settings)
    assert last(loop).phase is Phase.DONE
    assert 2e-3 < np.mean(loop.errors) < 6e-3


def test_waypoints_may_change_in_number_from_step_to_step(panda: Arm) -> None:
    loop = Loop(panda, lambda time: hanging(count=20 + round(time * 240) % 83)(time))
    assert last(loop).phase is Phase.DONE
    assert max(loop.errors) < 0.5e-3


@pytest.mark.parametrize("length", [0.002, 0.008, 0.012, 0.05])
def test_a_short_rope_is_traced_too(panda: Arm, length: float) -> None:
    step = last(Loop(panda, hanging(length=length, count=3)))
    assert step.phase is Phase.DONE
    assert step.place >= length - FINISH - 1e-9


def test_a_rope_along_the_view_is_traced_with_the_turn_that_the_tool_has(panda: Arm) -> None:
    tracer = Direct(panda)
    tracer.tracer = RopeTracer(panda, TracingSettings(), np.array([0, 0, -1.0]))
    before = panda.forward(START)[:3, :3]
    assert tracer.run(STILL(0.0), 4.0).phase is Phase.DONE
    np.testing.assert_allclose(panda.forward(tracer.q)[:3, :3], before, atol=0.01)


# --- phases ---


def test_a_rope_further_away_is_approached_first(panda: Arm) -> None:
    loop = Loop(panda, lambda time: STILL(time) + [0.05, -0.1, -0.05])
    control = loop.step()
    while control.step is None or control.step.phase is Phase.APPROACHING:
        control = loop.step()
        assert control.step is not None
        assert control.step.place == control.step.error == 0
    assert distance(loop.tool[:3, 3], loop.rope(0.0)[:1].repeat(2, axis=0)) < 0.011
    assert last(loop).phase is Phase.DONE


def test_tracing_begins_when_the_tool_has_turned(panda: Arm) -> None:
    start = START + [0, 0, 0, 0, 0, 0, 0.9]
    tracer = Direct(panda, start)
    positions = STILL(0.0) + panda.forward(start)[:3, 3] - STILL(0.0)[0]
    assert tracer.step(positions).phase is Phase.APPROACHING
    assert tracer.run(positions, 1.0).phase is Phase.TRACING


def test_an_unreachable_rope_leaves_the_tool_stuck(panda: Arm) -> None:
    loop = Loop(panda, lambda time: STILL(time) + [2.0, 0, 0])
    assert last(loop).phase is Phase.STUCK
    assert 3 < loop.now - 10 < 8


@pytest.mark.parametrize("when", [0.05, 1.0, 3.0])
def test_a_rope_whose_ends_change_places_is_not_done(panda: Arm, when: float) -> None:
    loop = Loop(panda, lambda time: STILL(time)[:: 1 if time < 10 + when else -1])
    assert last(loop).phase is Phase.FELL_OFF
    assert loop.now - 10 < when + 0.2


def test_not_even_a_short_one(panda: Arm) -> None:
    rope = hanging(length=0.1, count=11)
    loop = Loop(panda, lambda time: rope(time)[:: 1 if time < 10.2 else -1])
    assert last(loop).phase is Phase.FELL_OFF


def test_ends_that_change_places_for_a_moment_do_no_harm(panda: Arm) -> None:
    loop = Loop(panda, lambda time: STILL(time)[:: -1 if 11 < time < 11.05 else 1])
    assert last(loop).phase is Phase.DONE
    assert max(loop.errors) < 0.01


def test_an_end_that_is_hidden_is_not_the_end(panda: Arm) -> None:
    def rope(time: float) -> FloatArray:
        return STILL(time)[: 25 if 11 < time < 13 else None]

    loop = Loop(panda, rope)
    while loop.now < 12.9:
        control = loop.step()
        assert control.step is None or not control.step.phase.ended
    assert last(loop).phase is Phase.DONE
    stays = Loop(panda, lambda time: STILL(time)[: 25 if time > 11 else None])
    assert last(stays).phase is Phase.STUCK


def test_a_start_that_is_hidden_behind_the_tool_does_not_matter(panda: Arm) -> None:
    loop = Loop(panda, lambda time: STILL(time)[min(20, max(0, int((time - 11) * 12))) :])
    assert last(loop).phase is Phase.DONE
    assert max(loop.errors) < 0.5e-3


def test_a_rope_that_leaves_has_been_lost(panda: Arm) -> None:
    for away, soonest, latest in ((0.1, 0.1, 0.3), (1.0, 0.0, 0.05)):
        tracer = Direct(panda)
        assert tracer.run(STILL(0.0), 1.0).phase is Phase.TRACING
        since = tracer.now
        still = tracer.q
        while tracer.tracer.phase is Phase.TRACING:
            tracer.q = still
            step = tracer.step(STILL(0.0) + [0, away, 0])
        assert step.phase is Phase.FELL_OFF
        assert soonest <= tracer.now - since < latest


def test_the_running_error_forgets(panda: Arm) -> None:
    tracer = Direct(panda)
    tracer.run(STILL(0.0), 1.0)
    pose = tracer.q
    for _ in range(10):
        tracer.q = pose
        step = tracer.step(STILL(0.0) + [0, 0.04, 0])
    expected = 0.04 * (1 - math.exp(-10 * PERIOD / ERROR_TIME))
    assert step.error == pytest.approx(expected, rel=0.05)
    tracer.q = pose
    assert tracer.run(STILL(0.0), 1.0).error < 0.003


def test_the_papers_task_ends_where_no_waypoint_is_viable(panda: Arm) -> None:
    tracer = Direct(panda, follow="waypoints")
    tracer.run(STILL(0.0), 0.5)
    assert tracer.step(STILL(0.0)[::-1]).phase is Phase.FELL_OFF


def test_time_that_jumps_or_stands_still_does_not_end_the_task(panda: Arm) -> None:
    tracer = Direct(panda)
    tracer.run(STILL(0.0), 0.5)
    for jump in (3600.0, -7200.0, 0.0, 1e9, -1e9):
        assert tracer.step(STILL(0.0), jump).phase is Phase.TRACING
    assert tracer.run(STILL(0.0), 4.0).phase is Phase.DONE


def test_a_pause_does_not_make_the_tool_stuck(panda: Arm) -> None:
    loop = Loop(panda, hanging(swing=0.1))
    loop.run(1.0)
    loop.blind = True
    assert loop.run(2 * STUCK_TIME).step is None
    loop.blind = False
    assert last(loop).phase is Phase.DONE
    assert max(loop.errors) < 0.02


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
def test_what_is_not_finite_changes_nothing(panda: Arm, bad: float) -> None:
    tracer = Direct(panda)
    before = tracer.run(STILL(0.0), 0.5)
    positions = STILL(0.0)
    positions[20, 1] = bad
    step = tracer.step(positions)
    assert np.isnan(step.velocity).all()
    assert step[1:] == before[1:]
    for wrong in (positions[:1], positions[:0], np.zeros((0, 3)), np.ones((9, 3))):
        assert np.isnan(tracer.step(wrong).velocity).all()
    here = STILL(0.0)
    assert np.isnan(tracer.tracer.step(math.nan, tracer.q, here, here, here).velocity).all()
    assert np.isnan(tracer.tracer.step(9.0, tracer.q, here, here[:-1], here).velocity).all()
    assert np.isnan(tracer.tracer.step(9.0, np.full(7, np.nan), here, here, here).velocity).all()
    assert tracer.run(STILL(0.0), 4.0).phase is Phase.DONE


def test_an_ended_task_stays_so_until_reset(panda: Arm) -> None:
    tracer = Direct(panda)
    assert tracer.run(STILL(0.0), 4.0).phase is Phase.DONE
    for positions in (STILL(0.0), np.zeros((0, 3)), np.full((5, 3), np.nan)):
        step = tracer.step(positions)
        assert step.phase is Phase.DONE
        np.testing.assert_array_equal(step.velocity, np.zeros(7))
    tracer.tracer.reset()
    assert tracer.step(STILL(0.0)).phase is Phase.APPROACHING


# --- the joints ---


def test_limits_hold_at_the_ends_of_ranges_and_at_singular_poses(panda: Arm) -> None:
    limits = panda.limits
    rng = np.random.default_rng(5)
    poses = [limits.lower, limits.upper, np.zeros(7), np.array([0, 0, 0, -0.07, 0, 0, 0])]
    poses += [np.where(rng.random(7) < 0.3, limits.upper, rng.uniform(limits.lower, limits.upper)) for _ in range(6)]
    for start in poses:
        place = panda.forward(start)[:3, 3]
        loop = Loop(panda, shifted(hanging(length=0.3, swing=0.1), place - TOP), start=start)
        loop.run(1.0)
        commands = np.array(loop.commands)
        paths = motions(loop.start, commands, loop.measured, PERIOD)
        assert not any(violations(limits, PERIOD, paths, commands).values())


def test_stopping_velocities_leave_room_to_stop(panda: Arm) -> None:
    limits = panda.limits
    lower, upper = stopping_velocities(START, limits)
    assert (lower < 0).all()
    assert (upper > 0).all()
    for q in (limits.lower - 0.1, limits.lower):
        lower, upper = stopping_velocities(q, limits)
        np.testing.assert_array_equal(lower, np.zeros(7))
        np.testing.assert_array_equal(upper, limits.velocity)
    _, upper = stopping_velocities(limits.upper - 0.02 - 0.05, limits)
    np.testing.assert_allclose(upper, np.minimum(np.sqrt(limits.acceleration * 0.05), limits.velocity))


# --- settings ---


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gain_near", 0.0),
        ("gain_far", -1.0),
        ("gain_slope", math.nan),
        ("feed_forward", math.inf),
        ("waypoint_distance", 0.0),
        ("lead", 0.2),
        ("reach", 0.0),
        ("max_distance", 0.0),
        ("follow", "tool"),
        ("approach", "camera"),
    ],
)
def test_impossible_settings_are_named(name: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=f"tracing.{name} = "):
        TracingSettings(**{name: value})


@pytest.mark.parametrize("axis", [(0, 0, 0), (0, 0, 2), (0, 1), (math.nan, 0, 1)])
def test_a_camera_axis_is_a_unit_vector(panda: Arm, axis: tuple[float, ...]) -> None:
    with pytest.raises(ConfigError, match="expected a unit vector"):
        RopeTracer(panda, TracingSettings(), np.array(axis))
