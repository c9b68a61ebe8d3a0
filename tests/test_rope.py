"""Ropes in MuJoCo against physics that is known otherwise: formulas, conservation, symmetry, and smaller steps."""

from __future__ import annotations

import hashlib
import importlib
import math
import subprocess
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from helpers import random_rotation
from ropetrace.centerline import waypoint_frames
from ropetrace.errors import ConfigError, MissingExtraError
from ropetrace.sim import rope as rope_module
from ropetrace.sim.rope import GRAVITY, MOST_LINKS, TIMESTEP, RopeModel, RopeSimulation, RopeState, Wind
from ropetrace.sim.scene import looking_at
from ropetrace.types import FloatArray

pytest.importorskip("mujoco")

LOSSLESS = RopeModel(damping=0.0)
THIN = RopeModel(links=20, link_length=0.05, radius=0.006, link_mass=0.004, smooth=True)


def states(simulation: RopeSimulation, times: ArrayLike) -> list[RopeState]:
    """Where the rope is at each of the times, to the nearest step."""
    found = []
    for time in np.asarray(times, float):
        simulation.advance(float(time))
        found.append(simulation.state())
    return found


def tips(simulation: RopeSimulation, times: ArrayLike) -> FloatArray:
    return np.array([state.polyline[-1] for state in states(simulation, times)])


def digest(simulation: RopeSimulation, seconds: float) -> str:
    """Of everything that a rope does."""
    hashed = hashlib.sha256()
    for state in states(simulation, np.arange(0, seconds, 1 / 60)):
        for array in (state.polyline, state.centres, state.rotations, state.velocities):
            hashed.update(array.tobytes())
    return hashed.hexdigest()


def hands(near: ArrayLike, far: ArrayLike, sway: ArrayLike = (0.0, 0.0, 0.0)) -> Callable[[float], FloatArray]:
    """One end held still, the other moved to and fro at 0.8 Hz."""

    first, last, swing = (np.asarray(place, float) for place in (near, far, sway))

    def ends(time: float) -> FloatArray:
        return np.stack([first, last + swing * math.sin(2 * math.pi * 0.8 * time)])

    return ends


def dominant_frequency(values: FloatArray, step: float) -> float:
    """Hz: the best fit of a sine, found by a search round the peak of a padded spectrum."""
    values = (values - values.mean()) * np.hanning(len(values))
    spectrum = np.abs(np.fft.rfft(values, 64 * len(values)))
    return float(np.argmax(spectrum) / (64 * len(values) * step))


# Swinging


def test_a_hanging_chain_swings_freely_at_its_own_frequency() -> None:
    """A uniform hanging chain swings with j_01 / 2 sqrt(g / L), 1.2024 sqrt(g / L); ten links a little slower."""
    times = np.arange(0, 40, 0.05)
    x = tips(RopeSimulation(RopeModel(damping=2e-5), lift=0.0005), times)[:, 0]
    frequency = dominant_frequency(x, 0.05)
    chain = 1.2024 * math.sqrt(GRAVITY / 0.55) / (2 * math.pi)
    assert chain == pytest.approx(0.8082, abs=1e-4)
    assert frequency == pytest.approx(chain, rel=0.005)


def test_one_link_is_a_physical_pendulum() -> None:
    """A pill swings with sqrt(m g d / I), I = I_centre + m d^2, by the moment of inertia of cylinder and half balls."""
    r, h, m = 0.02, 0.16, 0.3
    volumes = np.array([math.pi * r**2 * h, 4 / 3 * math.pi * r**3])
    cylinder, ball = m * volumes / volumes.sum()
    inertia = cylinder * (h**2 / 12 + r**2 / 4) + ball * (0.4 * r**2 + h**2 / 4 + 3 / 8 * r * h)
    expected = math.sqrt(m * GRAVITY * 0.1 / (inertia + m * 0.1**2)) / (2 * math.pi)
    model = RopeModel(links=1, link_length=h + 2 * r, radius=r, link_mass=m, damping=0.0)
    x = tips(RopeSimulation(model, lift=1e-5), np.arange(0, 40, 0.02))[:, 0]
    assert dominant_frequency(x, 0.02) == pytest.approx(expected, rel=1e-3)


def steady(frequency: float, model: RopeModel | None = None) -> tuple[float, float]:
    """The tip's amplitude, metres, and the highest speed of a link, m/s, of the settled rope."""
    simulation = RopeSimulation(model or RopeModel(), wind=Wind(frequency))
    simulation.advance(12)
    run = states(simulation, np.arange(12, 12 + max(5.0, 2 / frequency), 1 / 60))
    return (
        max(abs(float(state.polyline[-1, 0])) for state in run),
        max(float(np.linalg.norm(state.velocities, axis=1).max()) for state in run),
    )


def test_the_rope_resonates_at_the_papers_frequency() -> None:
    sweep = {frequency: steady(frequency) for frequency in (0.6, 0.7, 0.8, 0.9, 1.0)}
    assert max(sweep, key=lambda frequency: sweep[frequency][0]) == 0.8
    assert sweep[0.8] == pytest.approx((0.283, 1.49), rel=0.05)
    for frequency, amplitude, speed in ((0.6, 0.123, 0.437), (0.7, 0.191, 0.829), (1.0, 0.111, 0.654)):
        assert sweep[frequency] == pytest.approx((amplitude, speed), rel=0.05)


def test_mass_changes_nothing_but_the_weight_of_the_damping() -> None:
    light = RopeModel(link_mass=0.004, damping=0.0)
    heavy = RopeModel(link_mass=0.1, damping=0.0)
    times = np.arange(0, 5, 0.25)
    difference = tips(RopeSimulation(light, wind=Wind(0.8)), times) - tips(RopeSimulation(heavy, wind=Wind(0.8)), times)
    assert np.abs(difference).max() < 1e-9


@pytest.mark.parametrize("damping", [2e-4, 1e-3])
@pytest.mark.parametrize("direction", [(0.6, 0.8, 0.0), (0.0, -1.0, 0.0), (math.sqrt(0.5), math.sqrt(0.5), 0.0)])
def test_the_direction_of_the_wind_does_not_matter(direction: tuple[float, float, float], damping: float) -> None:
    """A rope that hangs is round: links must not spin themselves apart where rounding lets them twist."""
    times = np.arange(0, 12, 0.5)
    model = RopeModel(damping=damping)
    along_x = tips(RopeSimulation(model, wind=Wind(0.8)), times)
    turned = tips(RopeSimulation(model, wind=Wind(0.8, direction=direction)), times)
    expected = along_x[:, :1] * np.array(direction) + along_x * [0, 0, 1]
    # With much damping the integrator is another: the two must agree with each other all the same.
    np.testing.assert_allclose(turned, expected, atol=1e-6)


def test_a_swing_that_leaves_its_plane_goes_on() -> None:
    """Let go along x and blown along y, the links twist; a second of it must not end at rest, as after a reset."""
    simulation = RopeSimulation(RopeModel(), wind=Wind(0.8, direction=(0.0, 1.0, 0.0)), lift=0.2)
    run = states(simulation, np.arange(0, 10, 1 / 60))
    steps = np.linalg.norm(np.diff([state.centres for state in run], axis=0), axis=2)
    assert steps.max() < 4 / 60
    # By then the throw has died away, and the swing of the wind is there.
    assert np.abs(tips(simulation, np.arange(12, 14, 0.05))[:, 1]).max() == pytest.approx(0.283, rel=0.05)


# Energy


def test_energy_is_conserved_without_wind_and_damping() -> None:
    simulation = RopeSimulation(LOSSLESS, lift=0.05)
    energies = []
    for time in np.arange(0, 20, 0.1):
        simulation.advance(float(time))
        energies.append(simulation.energy())
    assert np.ptp(energies) < 1e-6 * abs(energies[0])


def test_energy_is_that_of_the_links() -> None:
    """At rest m g z; in motion also m v^2 / 2 and a little of rotation."""
    simulation = RopeSimulation(LOSSLESS, anchor=(0.0, 0.0, 2.0), lift=0.3)
    potential = 0.1 * GRAVITY * simulation.state().centres[:, 2].mean()
    assert simulation.energy() == pytest.approx(potential, rel=1e-12)
    simulation.advance(0.3)
    state = simulation.state()
    energy = 0.1 * GRAVITY * state.centres[:, 2].mean() + 0.005 * (state.velocities**2).sum()
    assert 0 < simulation.energy() - energy < 0.003


@pytest.mark.parametrize("damping", [2e-4, 1e-3, 5e-3, 0.1])
def test_damping_takes_energy_and_gives_none(damping: float) -> None:
    simulation = RopeSimulation(RopeModel(damping=damping), lift=0.2)
    energies = []
    for time in np.arange(0, 8, 1 / 60):
        simulation.advance(float(time))
        energies.append(simulation.energy())
    # The gentlest damping: what the integrator errs stays far below what is lost.
    assert np.diff(energies).max() < 1e-7
    assert energies[-1] < energies[0] - 0.01


# Steps


def trajectory(monkeypatch: pytest.MonkeyPatch, step: float, wind: Wind | None, lift: float) -> FloatArray:
    monkeypatch.setattr(rope_module, "TIMESTEP", step)
    return tips(RopeSimulation(LOSSLESS, wind=wind, lift=lift), np.arange(0, 3, 0.05))


def test_smaller_steps_converge_with_the_first_order_of_the_held_wind(monkeypatch: pytest.MonkeyPatch) -> None:
    """The wind's force is held over a step: halving the step halves what is still wrong."""
    runs = [trajectory(monkeypatch, 1 / (240 * 2**k), Wind(0.8), 0.0) for k in range(4)]
    gaps = [float(np.abs(runs[k + 1] - runs[k]).max()) for k in range(3)]
    assert 1.8 < gaps[0] / gaps[1] < 2.2
    assert 1.8 < gaps[1] / gaps[2] < 2.2
    # The step in use is within a millimetre of the limit: the sum of all halvings to come.
    assert 2 * gaps[1] < 1e-3


def test_smaller_steps_converge_with_the_fourth_order_without_wind(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = [trajectory(monkeypatch, 1 / (240 * 2**k), None, 0.02) for k in range(4)]
    gaps = [float(np.abs(runs[k + 1] - runs[k]).max()) for k in range(3)]
    assert gaps[0] / gaps[1] > 8
    assert gaps[1] / gaps[2] > 8


# States


@pytest.mark.parametrize("kind", ["pinned", "clamped", "free", "held", "stiff"])
def test_velocities_are_differences_of_positions(kind: str) -> None:
    ends = hands((0, 0, 1), (0.3, 0, 1), (0.05, 0.05, 0.02)) if kind == "held" else None
    model = RopeModel(damping=5e-3) if kind == "stiff" else RopeModel(top=kind if ends is None else "pinned")  # type: ignore[arg-type]
    simulation = RopeSimulation(model, wind=Wind(0.8, direction=(0.6, 0.8, 0.0)), ends=ends)
    for time in (0.4, 1.0, 2.3):
        before, now, after = states(simulation, np.array([-1, 0, 1]) * TIMESTEP + round(time / TIMESTEP) * TIMESTEP)
        slope = (after.centres - before.centres) / (after.time - before.time)
        np.testing.assert_allclose(now.velocities, slope, atol=0.01)
        assert np.abs(slope).max() > 0.02


@pytest.mark.parametrize("kind", ["pinned", "clamped", "free", "held"])
def test_polyline_centres_rotations_and_capsules_tell_of_the_same_links(kind: str) -> None:
    ends = hands((0, 0, 1), (0.3, 0, 1), (0.05, 0.05, 0.02)) if kind == "held" else None
    for smooth in (False, True):
        model = RopeModel(top=kind if ends is None else "pinned", smooth=smooth)  # type: ignore[arg-type]
        simulation = RopeSimulation(model, wind=Wind(0.8, direction=(0.6, 0.8, 0.0)), ends=ends)
        for time, state in zip((0.0, 0.7, 2.0), states(simulation, (0.0, 0.7, 2.0)), strict=True):
            segments = np.diff(state.polyline, axis=0)
            np.testing.assert_allclose(np.linalg.norm(segments, axis=1), 0.055, rtol=1e-9)
            np.testing.assert_allclose(state.rotations[:, :, 0], segments / 0.055, atol=1e-9)
            np.testing.assert_allclose(
                np.einsum("nij,nkj->nik", state.rotations, state.rotations), np.tile(np.eye(3), (10, 1, 1)), atol=1e-9
            )
            np.testing.assert_allclose(np.linalg.det(state.rotations), 1, atol=1e-9)
            np.testing.assert_allclose(state.centres, (state.polyline[:-1] + state.polyline[1:]) / 2, atol=1e-9)
            assert state.time == pytest.approx(time)
        starts, stops = simulation.capsule_axes()
        inset = 0.0 if smooth else 0.0075
        along = state.rotations[:, :, 0]
        np.testing.assert_allclose(starts, state.polyline[:-1] + inset * along, atol=1e-9)
        np.testing.assert_allclose(stops, state.polyline[1:] - inset * along, atol=1e-9)


def test_a_state_is_a_copy() -> None:
    simulation = RopeSimulation(RopeModel(), wind=Wind(0.8))
    state = simulation.state()
    capsules = simulation.capsule_axes()
    kept = state.polyline.copy(), state.centres.copy(), state.rotations.copy(), capsules[0].copy()
    simulation.advance(1)
    found = state.polyline, state.centres, state.rotations, capsules[0]
    for now, before in zip(found, kept, strict=True):
        np.testing.assert_array_equal(now, before)


@pytest.mark.parametrize("position", [(0.0, -1.0, 0.0), (1.0, 0.0, 0.3), (-0.7, 0.5, 0.8), (0.1, 0.1, 2.0)])
def test_links_at_rest_have_the_frames_of_waypoints(position: tuple[float, float, float]) -> None:
    """Equations 15-17, seen from the camera, wherever it stands."""
    world_from_camera = looking_at(position, (0.0, 0.0, -0.2))
    axis = world_from_camera[:3, 2]
    simulation = RopeSimulation(RopeModel(), camera_axis=(float(axis[0]), float(axis[1]), float(axis[2])))
    in_camera = world_from_camera[:3, :3].T @ simulation.state().rotations
    np.testing.assert_allclose(in_camera, waypoint_frames(in_camera[:, :, 0].copy()), atol=1e-12)


def test_links_that_swing_in_the_image_have_the_frames_of_waypoints() -> None:
    pose = looking_at((0.0, -1.0, -0.275), (0.0, 0.0, -0.275))
    for state in states(RopeSimulation(RopeModel(), wind=Wind(0.8)), np.arange(0, 8, 0.4)):
        in_camera = pose[:3, :3].T @ state.rotations
        np.testing.assert_allclose(in_camera, waypoint_frames(in_camera[:, :, 0].copy()), atol=1e-9)


# The same again


def test_the_same_arguments_give_the_same_bytes() -> None:
    arguments: list[dict[str, Any]] = [
        {"wind": Wind(0.8, direction=(0.6, 0.8, 0.0))},
        {"lift": 0.2},
        {"ends": hands((0, 0, 1), (0.3, 0.1, 1), (0.05, 0.05, 0.02))},
    ]
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import test_rope as t\n"
        "print(t.digest(t.RopeSimulation(t.RopeModel(), wind=t.Wind(0.8, direction=(0.6, 0.8, 0.0))), 3))\n"
        "print(t.digest(t.RopeSimulation(t.RopeModel(), lift=0.2), 3))\n"
        "e = t.hands((0, 0, 1), (0.3, 0.1, 1), (0.05, 0.05, 0.02))\n"
        "print(t.digest(t.RopeSimulation(t.RopeModel(), ends=e), 3))"
    )
    here = [digest(RopeSimulation(RopeModel(), **these), 3) for these in arguments]
    assert here == [digest(RopeSimulation(RopeModel(), **these), 3) for these in arguments]
    folder = __file__.rpartition("/")[0]
    there = subprocess.run([sys.executable, "-c", code, folder], capture_output=True, text=True, check=True)
    assert there.stdout.split() == here


def test_how_often_it_is_looked_at_does_not_matter() -> None:
    model, wind = RopeModel(), Wind(0.8, direction=(0.6, 0.8, 0.0))
    watched, alone = RopeSimulation(model, wind=wind), RopeSimulation(model, wind=wind)
    for time in np.arange(0, 2, 0.013):
        watched.advance(float(time))
        watched.state()
        watched.energy()
    watched.advance(2)
    alone.advance(2)
    np.testing.assert_array_equal(watched.state().polyline, alone.state().polyline)
    np.testing.assert_array_equal(watched.state().velocities, alone.state().velocities)


@pytest.mark.parametrize("wind", [None, Wind(0.0), Wind(0.0, speed=30.0)])
@pytest.mark.parametrize("top", ["pinned", "clamped"])
def test_without_wind_a_hanging_rope_is_exactly_still(wind: Wind | None, top: Any) -> None:
    simulation = RopeSimulation(RopeModel(top=top), anchor=(0.1, 0.2, 0.95), wind=wind)
    hanging = np.array([0.1, 0.2, 0.95]) - np.outer(np.arange(11.0), [0, 0, 0.055])
    for state in states(simulation, (0, 0.5, 10)):
        np.testing.assert_allclose(state.polyline, hanging, atol=1e-12)
        assert not state.velocities.any()


def test_time_goes_on_and_not_back() -> None:
    simulation = RopeSimulation(RopeModel())
    simulation.advance(0.5)
    simulation.advance(0.5)
    assert simulation.time == 0.5
    with pytest.raises(ConfigError, match=r"is at 0\.5000 s and does not go back to 0\.4000 s"):
        simulation.advance(0.4)
    for rate in (30, 60):
        assert (1 / rate / TIMESTEP) % 1 == pytest.approx(0, abs=1e-12)


# Tops, lifts, holds


def test_a_free_rope_falls() -> None:
    for lift in (0.0, 0.2):
        simulation = RopeSimulation(RopeModel(top="free"), anchor=(0, 0, 1), lift=lift)
        before = simulation.state()
        simulation.advance(0.5)
        fall = simulation.state().polyline - before.polyline
        np.testing.assert_allclose(fall, np.tile([0, 0, -GRAVITY * 0.125], (11, 1)), atol=1e-9)


def test_a_clamped_rope_keeps_its_first_link() -> None:
    simulation = RopeSimulation(RopeModel(top="clamped"), anchor=(0, 0, 1), wind=Wind(0.8))
    simulation.advance(3)
    state = simulation.state()
    np.testing.assert_allclose(state.polyline[:2], np.array([[0, 0, 1], [0, 0, 0.945]]), atol=1e-12)
    assert abs(state.polyline[-1, 0]) > 0.01
    rod = RopeSimulation(RopeModel(links=1, top="clamped"), wind=Wind(0.8))
    rod.advance(1)
    assert not rod.state().velocities.any()


def test_stiffness_holds_a_rope_straighter_than_its_weight() -> None:
    bends = []
    for stiffness in (0.0, 0.05, 0.3):
        simulation = RopeSimulation(
            RopeModel(stiffness=stiffness, top="clamped"), wind=Wind(0.4, direction=(0.6, 0.8, 0.0))
        )
        simulation.advance(8)
        bends.append(float(np.abs(tips(simulation, np.arange(8, 12, 0.1))[:, :2]).max()))
    assert bends[0] > 1.1 * bends[1] > 1.2 * bends[2] > 0


@pytest.mark.parametrize("lift", [0.0, 0.01, 0.2, 0.55, 1.0, 1.1])
def test_a_lifted_end_is_as_much_higher(lift: float) -> None:
    for top in ("pinned", "free"):
        state = RopeSimulation(RopeModel(top=top), anchor=(0.1, 0.2, 0.95), lift=lift).state()  # type: ignore[arg-type]
        np.testing.assert_allclose(state.polyline[0], [0.1, 0.2, 0.95], atol=1e-12)
        assert state.polyline[-1, 2] == pytest.approx(0.4 + lift, abs=1e-9)
        assert state.polyline[-1, 1] == pytest.approx(0.2, abs=1e-9)
        assert state.polyline[-1, 0] > 0.1 - 1e-6
        assert not state.velocities.any()


def catenary_sag(span: float, length: float) -> float:
    """How far the middle of a rope hangs below its level ends: 2 a sinh(span / 2a) = length."""
    low, high = 1e-3, 1e3
    for _ in range(200):
        a = math.sqrt(low * high)
        argument = span / (2 * a)
        low, high = (a, high) if argument > 500 or 2 * a * math.sinh(argument) > length else (low, a)
    return a * (math.cosh(span / (2 * a)) - 1)


def test_a_held_rope_hangs_in_a_catenary_and_rests() -> None:
    simulation = RopeSimulation(THIN, ends=hands((0, 0, 1), (0.6, 0, 1)))
    before, after = states(simulation, (0, 4))
    assert 1 - before.polyline[:, 2].min() == pytest.approx(catenary_sag(0.6, 1.0), rel=0.005)
    np.testing.assert_allclose(before.polyline[:, 0], 0.6 - before.polyline[::-1, 0], atol=1e-3)
    assert np.abs(after.polyline - before.polyline).max() < 2e-4
    assert np.abs(after.velocities).max() < 1e-3


@pytest.mark.parametrize("model", [RopeModel(), RopeModel(links=10, link_length=0.5, link_mass=1.0)])
@pytest.mark.parametrize(
    "part", [(0.5, 0.0, 0.0), (0.0, 0.0, -0.4), (0.02, 0.0, 0.2), (0.0, 0.9, 0.3), (0.0, 0.0, 0.0)]
)
def test_a_held_rope_of_any_size_rests_wherever_its_ends_are(
    model: RopeModel, part: tuple[float, float, float]
) -> None:
    simulation = RopeSimulation(model, ends=hands((0, 0, 1), np.array([0, 0, 1]) + np.array(part) * model.length))
    before, after = states(simulation, (0, 2))
    places = np.array([[0, 0, 1], np.array([0, 0, 1]) + np.array(part) * model.length])
    np.testing.assert_allclose(before.polyline[[0, -1]], places, atol=2e-3)
    assert np.abs(after.polyline - before.polyline).max() < 0.005 * model.length


def test_held_ends_follow_their_trajectory() -> None:
    """As closely as 20 ms at 0.8 Hz and 9.4 cm; the rope keeps its length; what is held still stays."""
    ends = hands((-0.3, 0, 0.9), (0.3, 0, 0.85), (0.08, 0.05, 0.0))
    simulation = RopeSimulation(THIN, ends=ends)
    for state in states(simulation, np.arange(0, 6, 1 / 30)):
        near, far = ends(state.time)
        assert np.linalg.norm(state.polyline[0] - near) < 1e-3
        assert np.linalg.norm(state.polyline[-1] - far) < 0.02 * 2 * math.pi * 0.8 * 0.0943
        np.testing.assert_allclose(np.linalg.norm(np.diff(state.polyline, axis=0), axis=1), 0.05, rtol=1e-9)
    assert np.ptp(tips(simulation, np.arange(6, 8, 1 / 30))[:, 0]) == pytest.approx(0.16, rel=0.05)


def test_wind_blows_a_held_rope_too() -> None:
    ends = hands((0, 0, 1), (0.3, 0, 1))
    simulation = RopeSimulation(RopeModel(), wind=Wind(0.5, direction=(0.0, 1.0, 0.0)), ends=ends)
    assert max(abs(state.polyline[5, 1]) for state in states(simulation, np.arange(0, 4, 0.1))) > 0.02


def test_ends_that_leave_each_other_too_far_are_told() -> None:
    def ends(time: float) -> FloatArray:
        return np.array([[0, 0, 1], [0.3 + time, 0, 1]])

    simulation = RopeSimulation(RopeModel(), ends=ends)
    with pytest.raises(ConfigError, match=r"held ends are 0\.55\d m apart at 0\.25\d s: the rope is 0\.55 m long"):
        simulation.advance(1)


# Wind


@pytest.mark.parametrize("coupling", [0.5, 1.0, 5.0])
def test_a_free_link_follows_the_wind_by_its_formula(coupling: float) -> None:
    """v' = k (U sin(w t) d - v) + g: the solution from rest in closed form."""
    f, speed, direction = 1.3, 2.0, np.array([0.6, 0.0, 0.8])
    wind = Wind(f, speed, coupling, (0.6, 0.0, 0.8))
    simulation = RopeSimulation(RopeModel(links=1, top="free"), wind=wind)
    w, k = 2 * math.pi * f, coupling
    for state in states(simulation, np.arange(0, 3, 0.1)):
        t = state.time
        blown = speed * k / (k**2 + w**2) * (k * math.sin(w * t) - w * math.cos(w * t) + w * math.exp(-k * t))
        falling = np.array([0, 0, -GRAVITY / k * (1 - math.exp(-k * t))])
        # The force is held over a step: it is late by half of one.
        np.testing.assert_allclose(state.velocities[0], blown * direction + falling, atol=0.012 * k)


def test_the_velocity_of_the_air() -> None:
    wind = Wind(0.5, 3.0, direction=(0.0, 1.0, 0.0))
    np.testing.assert_allclose(wind.velocity(0.5), [0, 3, 0], atol=1e-12)
    np.testing.assert_allclose(wind.velocity(1.0), [0, 0, 0], atol=1e-12)
    assert not Wind().velocity(0.3).any()


# Bad input, told before MuJoCo is there


class StartedError(Exception):
    """MuJoCo was asked for."""


@pytest.fixture
def no_start(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: str) -> ModuleType:
        raise StartedError

    monkeypatch.setattr(rope_module, "import_extra", refuse)


@pytest.mark.usefixtures("no_start")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RopeModel(links=0), "links = 0: expected 1 to"),
        (lambda: RopeModel(links=MOST_LINKS + 1), "links = 401"),
        (lambda: RopeModel(link_length=-0.1), r"link_length = -0\.1"),
        (lambda: RopeModel(link_length=math.nan), "link_length = nan"),
        (lambda: RopeModel(radius=0.0), r"radius = 0\.0"),
        (lambda: RopeModel(radius=0.03), "pill of radius 0.03 is longer than link_length"),
        (lambda: RopeModel(link_mass=0.0), "link_mass"),
        (lambda: RopeModel(link_mass=math.inf), "link_mass = inf"),
        (lambda: RopeModel(damping=-1e-9), "damping"),
        (lambda: RopeModel(damping=math.nan), "damping = nan"),
        (lambda: RopeModel(stiffness=math.inf), "stiffness = inf"),
        (lambda: RopeModel(top="tied"), "top = 'tied': expected 'pinned', 'clamped' or 'free'"),  # type: ignore[arg-type]
        (lambda: Wind(-0.1), r"wind frequency = -0\.1"),
        (lambda: Wind(math.nan), "wind frequency = nan"),
        (lambda: Wind(12.1), r"wind frequency = 12\.1 Hz: a step of 2\.08 ms resolves 12 Hz at most"),
        (lambda: Wind(1, math.inf), "wind speed = inf"),
        (lambda: Wind(1, coupling=-1), "coupling = -1"),
        (lambda: Wind(1, coupling=math.nan), "coupling = nan"),
        (lambda: Wind(1, direction=(1.0, 1.0, 0.0)), "unit vector"),
        (lambda: Wind(1, direction=(math.nan, 0.0, 0.0)), "unit vector"),
        (lambda: RopeSimulation(RopeModel(), lift=1.2), r"lift = 1\.2 m: a rope of 0\.55 m can be lifted by 0 to 1\.1"),
        (lambda: RopeSimulation(RopeModel(), lift=-0.1), "lift"),
        (lambda: RopeSimulation(RopeModel(), lift=math.nan), "lift = nan"),
        (lambda: RopeSimulation(RopeModel(top="clamped"), lift=0.1), "clamped rope cannot be lifted"),
        (lambda: RopeSimulation(RopeModel(), anchor=(0.0, math.nan, 0.0)), "anchor"),
        (lambda: RopeSimulation(RopeModel(), camera_axis=(0.0, 0.0, 1.0)), "looks along a hanging rope"),
        (lambda: RopeSimulation(RopeModel(), camera_axis=(math.nan, 0.0, 1.0)), "camera_axis"),
        (lambda: RopeSimulation(RopeModel(top="free"), ends=hands((0, 0, 1), (0.3, 0, 1))), "held at both ends"),
        (lambda: RopeSimulation(RopeModel(), lift=0.1, ends=hands((0, 0, 1), (0.3, 0, 1))), "held at both ends"),
        (lambda: RopeSimulation(RopeModel(), ends=hands((0, 0, 1), (0.6, 0, 1))), r"0\.600 m apart at 0\.000 s"),
        (lambda: RopeSimulation(RopeModel(), ends=hands((0, 0, 1), (math.nan, 0, 1))), "two points"),
        (lambda: RopeSimulation(RopeModel(), ends=lambda _: np.zeros(3)), "two points"),
    ],
)
def test_bad_input_is_told_before_mujoco_is_started(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make()


@pytest.mark.parametrize(
    "model",
    [
        RopeModel(stiffness=10.0),
        RopeModel(links=100, link_length=1e-3, radius=1e-3, link_mass=1e-4, smooth=True),
    ],
)
def test_a_rope_too_quick_for_the_step_is_refused(model: RopeModel) -> None:
    with pytest.raises(ConfigError, match=r"swings too fast for the step of 2\.08 ms: take fewer"):
        RopeSimulation(model, wind=Wind(0.8))


def test_mujoco_reads_the_longest_rope() -> None:
    model = RopeModel(links=MOST_LINKS, link_length=0.05, smooth=True)
    xml = rope_module._mjcf(model, np.zeros(3), True)
    assert importlib.import_module("mujoco").MjModel.from_xml_string(xml).nbody == 1 + MOST_LINKS + 2


@pytest.mark.parametrize("model", [RopeModel(damping=0.02), RopeModel(stiffness=0.2), RopeModel(links=2, damping=1.0)])
def test_what_is_not_refused_is_stable(
    model: RopeModel, capfd: pytest.CaptureFixture[str], tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """MuJoCo tells of instability in a file where one stands, and goes on with a rope that it has reset."""
    monkeypatch.chdir(tmp_path)
    simulation = RopeSimulation(model, wind=Wind(0.8, direction=(0.6, 0.8, 0.0)), lift=0.1)
    assert np.abs(np.diff(tips(simulation, np.arange(0, 5, 1 / 60)), axis=0)).max() < 0.05
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr().err == ""


def test_an_unstable_rope_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    """Should one come through all the same, it is no rope that has silently started anew."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(RopeSimulation, "_fit_to_step", lambda _: None)
    simulation = RopeSimulation(RopeModel(stiffness=100.0), wind=Wind(0.8), lift=0.1)
    with pytest.raises(ConfigError, match=r"became unstable before \d"):
        simulation.advance(5)


def test_without_mujoco_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    real = importlib.import_module

    def missing(name: str, package: str | None = None) -> ModuleType:
        if name == "mujoco":
            raise ImportError("No module named 'mujoco'")
        return real(name, package)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(MissingExtraError, match=r"'mujoco'.*pip install 'ropetrace\[sim\]'"):
        RopeSimulation(RopeModel())


def test_the_frame_of_a_link_follows_any_camera_axis() -> None:
    """Orthonormal whatever axis is given, of any length."""
    rng = np.random.default_rng(1)
    for _ in range(5):
        axis = 3 * random_rotation(rng)[0]
        rotations = RopeSimulation(RopeModel(links=2), camera_axis=(axis[0], axis[1], axis[2])).state().rotations
        np.testing.assert_allclose(rotations[0] @ rotations[0].T, np.eye(3), atol=1e-12)
        assert abs(rotations[0, :, 1] @ axis) < 1e-12
