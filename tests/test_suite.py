"""The suite: every case opens, repeats, and is told truly; what is hidden is hidden as designed."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
from importlib import resources

import numpy as np
import pytest

from helpers import needs_data
from ropetrace import suite
from ropetrace.errors import ConfigError
from ropetrace.evaluation.metrics import curve_length, distances_to_curve
from ropetrace.sim.curtain import CurtainSettings
from ropetrace.sim.curve import CurveSettings
from ropetrace.sim.rope import RopeModel, Wind
from ropetrace.sim.scenario import Scenario, SimulatedScene
from ropetrace.suite import ScenarioCase
from ropetrace.types import RgbdFrame

pytest.importorskip("mujoco")

CURVES = ("loop", "crossing", "coil", "hairpin")
VISIBLE = {"tip_hidden": 0.75, "middle_hidden": 0.8, "occlusion_25": 0.75, "occlusion_50": 0.5, "occlusion_75": 0.25}
"""From 1 s on the curtain stands."""
SELF_HIDDEN = {"loop": 0.90, "crossing": 0.97, "coil": 0.82}
TIMES = (0.0, 1.5, 2.9)


def scenario_case(name: str) -> ScenarioCase:
    case = suite.open_case(name)
    assert isinstance(case, ScenarioCase)
    return case


def digest(name: str, count: int = 2) -> str:
    hashed = hashlib.sha256()
    for frame, truth in suite.open_case(name).frames(count):
        assert isinstance(frame, RgbdFrame)
        assert truth is not None
        assert frame.color is not None
        for array in (frame.depth, frame.color, truth.polyline):
            hashed.update(array.tobytes())
    return hashed.hexdigest()


def test_the_cases_have_a_version() -> None:
    """Whoever changes a case raises SUITE_VERSION, and writes the new digest here."""
    folder = resources.files("ropetrace.suite").joinpath("scenarios")
    assert {file.name for file in folder.iterdir()} == {f"{name}.toml" for name in suite.SCENARIOS}
    texts = [folder.joinpath(f"{name}.toml").read_bytes() for name in suite.SCENARIOS]
    assert (suite.SUITE_VERSION, hashlib.sha256(b"".join(texts)).hexdigest()[:16]) == ("1", "9da7d46c535399ef")


@pytest.mark.parametrize("name", suite.SCENARIOS)
def test_every_case_is_short_and_told_truly(name: str) -> None:
    case = scenario_case(name)
    scenario = case.scenario
    assert case.description
    assert case.color == "#c8281e"
    assert 90 <= scenario.frame_count <= 120
    assert (scenario.camera.width, scenario.camera.height, scenario.camera.rate) == (640, 480, 30)
    scene = SimulatedScene(scenario)
    camera = scene.camera.intrinsics
    for time in TIMES:
        scene.scene_at(time)
        truth = scene.truth()
        line = truth.polyline
        np.testing.assert_allclose(np.linalg.norm(np.diff(line, axis=0), axis=1), scenario.rope.link_length, rtol=1e-9)
        columns, rows = (line[:, :2] / line[:, 2:] * camera.fx + [camera.cx, camera.cy]).T
        assert (columns > 5).all()
        assert (columns < 634).all()
        assert (rows > 5).all()
        assert (rows < 474).all()
        if time > 0 and name in VISIBLE:
            assert truth.visible_fraction == pytest.approx(VISIBLE[name], abs=0.03)
        elif name != "middle_hidden":
            assert truth.visible_fraction > SELF_HIDDEN.get(name, 0.99)


@pytest.mark.parametrize("name", ["fast_swing", "coil", "noise_stereo", "occlusion_50"])
def test_a_case_repeats(name: str) -> None:
    assert digest(name) == digest(name)


@pytest.mark.parametrize("name", CURVES)
def test_a_curve_sways_and_does_not_pass_through_itself(name: str) -> None:
    scenario = scenario_case(name).scenario
    scene = SimulatedScene(scenario)
    before = None
    for time in np.linspace(0, 2.9, 8):
        scene.scene_at(float(time))
        state = scene.rope.state()
        line = state.polyline
        apart = round(6 * scenario.rope.radius / scenario.rope.link_length)
        for index in range(0, len(line) - apart - 1, 3):
            assert distances_to_curve(line[index : index + 1], line[index + apart :])[0] > 2 * scenario.rope.radius
        assert before is None or np.abs(line - before).max() > 0.003
        before = line
        across = np.einsum("nij,nik->njk", state.rotations, state.rotations)
        np.testing.assert_allclose(across, np.broadcast_to(np.eye(3), across.shape), atol=1e-9)
        scene.scene_at(float(time) + 1e-3)
        moved = (scene.rope.state().centres - state.centres) / 1e-3
        np.testing.assert_allclose(moved, state.velocities, atol=2e-3)


def test_of_two_ropes_the_one_that_is_meant_fills_more_of_the_image() -> None:
    scene = SimulatedScene(scenario_case("two_ropes").scenario)
    label = scene.camera.render(scene.scene()).label
    assert np.count_nonzero(label == 0) > 1.15 * np.count_nonzero(label == 1) > 1000


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ConfigError, match="did you mean swing"):
        suite.open_case("swng")
    with pytest.raises(ConfigError, match="arc of curve takes"):
        Scenario(curve=CurveSettings(radius=0.2))
    with pytest.raises(ConfigError, match="no motion and no wind"):
        Scenario(wind=Wind(0.8), curve=CurveSettings(radius=0.05))
    for wrong in ({"radius": 0.0}, {"slope_degrees": 90.0}, {"turn_degrees": -1.0}, {"sway_degrees": float("nan")}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            CurveSettings(**wrong)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="edges"):
        CurtainSettings(box=(0, 0, 0, 1, 1, 0))
    with pytest.raises(ConfigError, match="before"):
        CurtainSettings(leaves_at=2, arrives_at=1)
    with pytest.raises(ConfigError, match="camera is"):
        SimulatedScene(Scenario(curtain=CurtainSettings((0.0, -1.0, 0.675, 0.1, 0.1, 0.1), (2.0, 0.0, 0.0), 1, 2)))


def test_pills_on_a_curve_end_where_the_links_end() -> None:
    rope = RopeModel(links=10, link_length=0.05)
    scene = SimulatedScene(Scenario(rope=rope, curve=CurveSettings(radius=0.05, turn_degrees=180)))
    starts, ends = scene.rope.capsule_axes()
    np.testing.assert_allclose(np.linalg.norm(ends - starts, axis=1), 0.05 - 2 * rope.radius)


@needs_data
def test_recordings_join_where_they_are_present() -> None:
    assert {"mocap_1", "mocap_2", "real_d435"} < set(suite.cases())
    frame, truth = next(suite.open_case("mocap_2").frames())
    assert truth is not None
    assert truth.visible_fraction > 0.99
    assert 0.85 < curve_length(truth.polyline) < 1.0
    again, _ = next(suite.open_case("mocap_2").frames())
    assert isinstance(frame, RgbdFrame)
    assert isinstance(again, RgbdFrame)
    np.testing.assert_array_equal(frame.depth, again.depth)
    assert [truth for _, truth in suite.open_case("real_d435").frames()] == [None] * 6


def test_without_recordings_there_are_the_scenarios(monkeypatch: pytest.MonkeyPatch, tmp_path: object) -> None:
    monkeypatch.setenv("ROPETRACE_DATA", str(tmp_path))
    assert suite.cases() == suite.SCENARIOS
    with pytest.raises(ConfigError, match="unknown case 'mocap_1'"):
        suite.open_case("mocap_1")
    assert len(list(itertools.islice(suite.open_case("still").frames(), 1))) == 1
    assert dataclasses.is_dataclass(suite.Truth)
