"""The simulated arm: how well it follows its commands, and that it repeats."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ropetrace.control.arm import Arm
from ropetrace.errors import ConfigError
from ropetrace.sim.arm import ARM_TIMESTEP, RESPONSE, ArmSimulation
from ropetrace.sim.scenario import CLUTTER
from ropetrace.types import FloatArray
from tracing_rig import PERIOD, START

pytest.importorskip("pinocchio")
pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def panda() -> Arm:
    return Arm.named("panda")


def base() -> FloatArray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [0.1, -0.2, 1.2]).as_matrix()
    pose[:3, 3] = [0.3, -0.4, 0.6]
    return pose


def run(arm: Arm, seconds: float = 1.0) -> tuple[ArmSimulation, Any, FloatArray, Any]:
    """Sines on all joints: times, positions and commands."""
    moving = ArmSimulation(arm, START, base())
    positions, commands = [], []
    times = np.arange(1, round(seconds / PERIOD) + 1) * PERIOD
    for time in times:
        commands.append(0.6 * np.sin(2 * np.pi * (0.4 + 0.1 * np.arange(7)) * time))
        moving.advance(time, commands[-1])
        positions.append(moving.position)
    return moving, times, np.array(positions), np.array(commands)


@pytest.mark.parametrize("name", ["panda", "fr3"])
def test_stands_still_where_it_is_put_whatever_gravity_does(name: str) -> None:
    arm = Arm.named(name)
    start = np.clip(START, arm.limits.lower + 0.1, arm.limits.upper - 0.1)
    moving = ArmSimulation(arm, start, base())
    moving.advance(2.0, np.zeros(arm.count))
    np.testing.assert_allclose(moving.position, start, atol=1e-6)
    np.testing.assert_allclose(moving.velocity, 0, atol=1e-6)
    assert moving.time == pytest.approx(2.0, abs=ARM_TIMESTEP / 2)


@pytest.mark.parametrize("joint", range(7))
def test_a_step_of_velocity_is_reached_within_the_response(panda: Arm, joint: int) -> None:
    moving = ArmSimulation(panda, START, base())
    shares = []
    for step in range(1, 97):
        moving.advance(step * ARM_TIMESTEP, 0.1 * np.eye(7)[joint])
        shares.append(moving.velocity[joint] / 0.1)
    assert shares[round(3 * RESPONSE / ARM_TIMESTEP)] > 0.8
    # What was lost on the way is made up for.
    assert max(shares) < 1.4
    assert shares[-1] == pytest.approx(1, abs=0.05)
    assert moving.position[joint] - START[joint] == pytest.approx(0.01, abs=1e-4)


def test_follows_smooth_commands_with_the_delay_of_its_servos(panda: Arm) -> None:
    _, times, positions, commands = run(panda, 3.0)
    ideal = START + PERIOD * np.cumsum(commands, axis=0)
    off = np.abs(positions - ideal)[24:]
    assert off.max() < 0.012, "rad, less than the velocity times 0.02 s"
    late = [np.interp(times - delay, times, column) for delay in (0.0, 0.005, 0.01) for column in (ideal - START).T]
    errors = np.abs(np.array(late).reshape(3, 7, -1)[:, :, 24:] - (positions - START).T[:, 24:]).max(axis=2)
    assert errors.min(axis=0).max() < 0.006


def test_its_torques_are_limited(panda: Arm) -> None:
    moving = ArmSimulation(panda, START, base())
    moving.advance(0.01, np.full(7, 50.0))
    torques = np.abs(moving._data.qfrc_actuator)
    np.testing.assert_allclose(torques[:6], [87, 87, 87, 87, 12, 12])
    assert torques[6] <= 12


def test_the_same_commands_give_the_same_bytes(panda: Arm) -> None:
    assert run(panda)[2].tobytes() == run(Arm.named("panda"))[2].tobytes()


def test_time_that_is_past_changes_nothing(panda: Arm) -> None:
    moving = ArmSimulation(panda, START, base())
    moving.advance(0.5, np.full(7, 0.1))
    before = moving.position
    moving.advance(0.3, np.full(7, -1.0))
    np.testing.assert_array_equal(moving.position, before)
    before[:] = 0
    assert moving.position.any(), "a copy"


def test_tool_and_capsules_are_in_the_world_frame(panda: Arm) -> None:
    moving = run(panda, 0.2)[0]
    np.testing.assert_allclose(moving.world_from_tool(), base() @ panda.forward(moving.position), atol=1e-12)
    starts, ends, radii = panda.capsules(moving.position)
    capsules, place = moving.capsules(), base()
    np.testing.assert_allclose(capsules.starts, starts @ place[:3, :3].T + place[:3, 3], atol=1e-6)
    np.testing.assert_allclose(capsules.ends, ends @ place[:3, :3].T + place[:3, 3], atol=1e-6)
    np.testing.assert_allclose(capsules.radii, radii, atol=1e-6)
    assert set(np.unique(capsules.labels)) == {CLUTTER}


@pytest.mark.parametrize("position", [np.zeros(6), np.full(7, np.nan), np.zeros((7, 1))])
def test_impossible_positions_are_refused(panda: Arm, position: FloatArray) -> None:
    with pytest.raises(ConfigError, match="has 7 joints"):
        ArmSimulation(panda, position, base())


def test_a_start_outside_a_range_is_refused(panda: Arm) -> None:
    with pytest.raises(ConfigError, match=r"joint 4 at 0\.1 rad: its range is -3\.0718 to -0\.0698 rad"):
        ArmSimulation(panda, START * [1, 1, 1, 0, 1, 1, 1] + [0, 0, 0, 0.1, 0, 0, 0], base())


@pytest.mark.parametrize("velocity", [np.zeros(6), np.full(7, np.nan), 0.1])
def test_impossible_commands_are_refused(panda: Arm, velocity: FloatArray) -> None:
    moving = ArmSimulation(panda, START, base())
    with pytest.raises(ValueError, match="7 finite numbers"):
        moving.advance(0.1, velocity)


def test_an_arm_that_is_restarted_is_as_new(panda: Arm) -> None:
    def moved(simulation: ArmSimulation) -> FloatArray:
        for step in range(1, 60):
            simulation.advance(step / 240, np.linspace(-0.3, 0.3, simulation.arm.count))
        return simulation.position

    fresh, used = (ArmSimulation(panda, START, np.eye(4)) for _ in range(2))
    moved(used)
    used.restart(START)
    assert used.time == 0
    np.testing.assert_array_equal(used.position, START)
    assert not used.velocity.any()
    np.testing.assert_array_equal(moved(used), moved(fresh))
    with pytest.raises(ConfigError, match="joints"):
        used.restart(START[:3])
