"""Scenarios: what the package ships runs and is told truly, and what a file gets wrong is told before anything runs."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ropetrace.config import RopeConfig
from ropetrace.errors import ConfigError
from ropetrace.evaluation.metrics import distances_to_curve
from ropetrace.sim import rope as rope_module
from ropetrace.sim import scenario as scenario_module
from ropetrace.sim.rope import TIMESTEP, RopeModel, Wind
from ropetrace.sim.scenario import (
    CLUTTER,
    ROPE,
    ROPE_COLOR,
    SECOND_ROPE,
    CameraSettings,
    ClutterSettings,
    MotionSettings,
    Scenario,
    SimulatedScene,
    Truth,
    load_scenario,
    scenario_names,
)
from ropetrace.sim.scene import inverse_pose
from ropetrace.trackers import SlicingTracker
from ropetrace.types import FloatArray, RgbdFrame, Status

pytest.importorskip("mujoco")

SWING = Scenario(wind=Wind(0.8), camera=CameraSettings(width=160, height=120, exact_depth=True))


def frames(scenario: Scenario, count: int = 3, skip: int = 0) -> list[tuple[RgbdFrame, Truth]]:
    return list(itertools.islice(SimulatedScene(scenario).frames(), skip, skip + count))


def points(frame: RgbdFrame, where: NDArray[np.bool_]) -> FloatArray:
    """Back-projection of the pixels of a mask, (N, 3), camera frame."""
    rows, columns = np.nonzero(where)
    z = frame.depth[rows, columns] * frame.depth_unit_m
    camera = frame.intrinsics
    return np.stack([(columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z], axis=1)


def digest(scenario: Scenario, count: int) -> str:
    hashed = hashlib.sha256()
    for frame, truth in frames(scenario, count):
        assert frame.color is not None
        for array in (frame.depth, frame.color, truth.polyline, truth.link_quaternions, truth.state.velocities):
            hashed.update(array.tobytes())
        hashed.update(f"{frame.stamp_ns} {truth.visible_fraction!r}".encode())
    return hashed.hexdigest()


# What the package ships


def test_names() -> None:
    assert set(scenario_names()) >= {"still", "swing", "swing_kinect", "drop", "held", "clutter", "two_ropes"}
    assert scenario_names() == sorted(scenario_names())


@pytest.mark.parametrize("name", scenario_names())
def test_every_scenario_runs_and_can_be_tracked(name: str) -> None:
    scenario = load_scenario(name)
    assert scenario.description
    tracker = SlicingTracker(
        RopeConfig(diameter=2 * scenario.rope.radius, color="#{:02x}{:02x}{:02x}".format(*ROPE_COLOR))
    )
    for index, (frame, truth) in enumerate(frames(scenario)):
        assert frame.stamp_ns == round(index / scenario.camera.rate * 1e9)
        estimate = tracker.update(frame)
        assert estimate.status is not Status.LOST
        # Two ropes of one colour and a hidden stretch are hard; all the same, what is found is on a rope.
        truths = [truth.polyline]
        if scenario.clutter.second_rope is not None:
            turn = inverse_pose(SimulatedScene(scenario).world_from_camera)[:3, :3]
            truths.append(truth.polyline + turn @ np.array(scenario.clutter.second_rope))
        gaps = np.min([distances_to_curve(estimate.nodes, curve) for curve in truths], axis=0)
        assert np.median(gaps) < 0.005


@pytest.mark.parametrize("name", scenario_names())
def test_truth_agrees_with_the_pixels(name: str) -> None:
    """Exact pixels that show the rope lie on pills about the truth; the truth's links are those of the polyline."""
    scenario = load_scenario(name)
    scene = SimulatedScene(scenario)
    camera = dataclasses.replace(scenario.camera, noise="none", exact_depth=True, width=320, height=240).camera(
        scenario.seed
    )
    radius = scenario.rope.radius
    for _, truth in itertools.islice(scene.frames(), 0, 11, 5):
        image = camera.render(scene.scene())
        frame = RgbdFrame(0, image.depth.copy(), 1.0, camera.intrinsics)
        rope = points(frame, image.label == ROPE)
        assert len(rope) > 300
        gaps = distances_to_curve(rope, truth.polyline)
        assert gaps.max() < radius + 1e-5
        assert np.median(gaps) == pytest.approx(radius, rel=0.02)
        second = points(frame, image.label == SECOND_ROPE)
        assert (len(second) > 0) == (scenario.clutter.second_rope is not None)
        assert len(second) == 0 or distances_to_curve(second, truth.polyline).min() > radius
        has_clutter = any((scenario.clutter.wall, scenario.clutter.floor, scenario.clutter.boxes))
        assert (image.label == CLUTTER).any() == has_clutter
        along = Rotation.from_quat(truth.link_quaternions).as_matrix()[:, :, 0]
        np.testing.assert_allclose(along, np.diff(truth.polyline, axis=0) / scenario.rope.link_length, atol=1e-6)
        world = truth.polyline @ scene.world_from_camera[:3, :3].T + scene.world_from_camera[:3, 3]
        np.testing.assert_allclose(world, truth.state.polyline, atol=1e-12)


@pytest.mark.parametrize("name", scenario_names())
def test_the_visible_fraction(name: str) -> None:
    scenario = load_scenario(name)
    fractions = [truth.visible_fraction for _, truth in frames(scenario, 8)]
    if name == "clutter":
        # A board of 8 cm, 0.8 of the way to 55 cm of rope, hides 10 cm and what perspective adds.
        assert 0.7 < min(fractions) <= max(fractions) < 0.9
    else:
        assert fractions == [1.0] * 8


def test_a_board_hides_what_perspective_says() -> None:
    """The camera is 1 m away; a board half way, 5 cm high at the height of the eye, hides 10 cm of a rope of 55."""
    board = ClutterSettings(boxes=((0.0, -0.5, 0.675, 0.4, 0.0001, 0.05),))
    (_, truth), *_ = frames(Scenario(clutter=board, rope=RopeModel(smooth=True)), 1)
    assert truth.visible_fraction == pytest.approx(1 - 0.10 / 0.55, abs=0.004)


def test_a_rope_that_is_not_in_the_image_is_not_visible() -> None:
    away = CameraSettings(width=160, height=120, look_at=(0.0, -2.0, 0.675))
    (frame, truth), *_ = frames(Scenario(camera=away), 1)
    assert truth.visible_fraction == 0
    assert not frame.depth.any()


# Time


def test_stamps_states_and_count() -> None:
    scenario = dataclasses.replace(SWING, duration=0.5)
    scene = SimulatedScene(scenario)
    run = list(scene.frames())
    assert len(run) == scenario.frame_count == 15
    for index, (frame, truth) in enumerate(run):
        assert truth.state.time == pytest.approx(index / 30, abs=1e-12)
        assert frame.stamp_ns == round(index / 30 * 1e9)
    assert Scenario(duration=0.001).frame_count == 1


@pytest.mark.parametrize("rate", [7.0, 25.0, 29.97, 90.0])
def test_a_rate_that_does_not_divide_the_steps_is_true_to_half_a_step(rate: float) -> None:
    """Picture and truth are of the same step, which is the nearest to the stamp."""
    scenario = dataclasses.replace(SWING, camera=dataclasses.replace(SWING.camera, rate=rate))
    for frame, truth in frames(scenario, 3, 20):
        assert abs(truth.state.time - frame.stamp_ns * 1e-9) <= TIMESTEP / 2 + 1e-9
        rope = points(frame, frame.depth > 0)
        assert distances_to_curve(rope, truth.polyline).max() < 0.0075 + 1e-5


def test_the_truth_of_a_blurred_frame_is_at_its_stamp() -> None:
    blurred = dataclasses.replace(SWING.camera, exposure=0.02, motion_blur=True)
    sharp = frames(SWING, 25)
    soft = frames(dataclasses.replace(SWING, camera=blurred), 25)
    for (_, a), (frame, b) in zip(sharp, soft, strict=True):
        assert b.state.time == pytest.approx(frame.stamp_ns * 1e-9, abs=1e-9)
        np.testing.assert_array_equal(a.polyline, b.polyline)
        np.testing.assert_array_equal(a.link_quaternions, b.link_quaternions)
        assert a.visible_fraction == b.visible_fraction
    # It is blurred: the colour of a rope in full swing is spread over more pixels.
    wide, narrow = soft[20][0].color, sharp[20][0].color
    assert wide is not None
    assert narrow is not None
    assert np.count_nonzero(wide.any(axis=2)) > np.count_nonzero(narrow.any(axis=2))


def test_exposure_without_blur_changes_nothing_in_the_picture() -> None:
    late = dataclasses.replace(SWING.camera, exposure=0.02, latency=0.05)
    assert digest(SWING, 3) == digest(dataclasses.replace(SWING, camera=late), 3)
    assert SimulatedScene(dataclasses.replace(SWING, camera=late)).camera.arrival(1.0) == pytest.approx(1.06)


def test_no_wind_and_no_noise_is_a_still_picture() -> None:
    first, *rest = frames(load_scenario("still"), 5)
    for frame, truth in rest:
        np.testing.assert_array_equal(frame.depth, first[0].depth)
        np.testing.assert_array_equal(truth.polyline, first[1].polyline)


# The same again


def test_same_bytes() -> None:
    """Over scenes, and over processes; another seed is another noise over the same motion."""
    noisy = load_scenario("swing_kinect")
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import test_scenario as t\n"
        "print(t.digest(t.load_scenario('swing_kinect'), 4), t.digest(t.SWING, 4))"
    )
    folder = str(Path(__file__).parent)
    there = subprocess.run([sys.executable, "-c", code, folder], capture_output=True, text=True, check=True)
    assert there.stdout.split() == [digest(noisy, 4), digest(SWING, 4)]
    other = dataclasses.replace(noisy, seed=1)
    assert digest(other, 2) != digest(noisy, 2)
    np.testing.assert_array_equal(frames(other)[2][1].polyline, frames(noisy)[2][1].polyline)


def test_depth_units() -> None:
    """Millimetres of uint16 by default, which an RGB-D folder can hold; exact metres on demand."""
    small = CameraSettings(width=160, height=120)
    stepped = frames(Scenario(camera=small), 1)[0][0]
    exact = frames(Scenario(camera=dataclasses.replace(small, exact_depth=True)), 1)[0][0]
    assert (stepped.depth.dtype.name, stepped.depth_unit_m) == ("uint16", 0.001)
    assert (exact.depth.dtype.name, exact.depth_unit_m) == ("float32", 1.0)
    assert np.abs(stepped.depth * 0.001 - exact.depth).max() <= 0.00051


# Files


def test_a_file_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = """
        duration = 1.0
        seed = 4
        [rope]
        links = 4
        top = "clamped"
        [wind]
        frequency = 1
        direction = [0, 1, 0]
        [camera]
        width = 160
        height = 120
        position = [0.2, -0.8, 0.8]
        look_at = [0, 0, 0.8]
        [clutter]
        floor = 0
    """
    (tmp_path / "my scene.toml").write_text(text)
    scenario = load_scenario(str(tmp_path / "my scene.toml"))
    assert scenario.rope == RopeModel(links=4, top="clamped")
    assert (scenario.seed, scenario.wind.direction, scenario.clutter.floor) == (4, (0.0, 1.0, 0.0), 0.0)
    monkeypatch.chdir(tmp_path)
    assert load_scenario("my scene.toml") == scenario
    assert len(frames(scenario)) == 3
    (tmp_path / "empty.toml").write_text("")
    assert load_scenario("empty.toml") == Scenario()


def test_a_scenario_that_there_is_not(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"unknown scenario 'swimg': give a \.toml file or one of clutter, drop"):
        load_scenario("swimg")
    with pytest.raises(ConfigError, match=r"absent\.toml: cannot be read: No such file"):
        load_scenario(str(tmp_path / "absent.toml"))
    (tmp_path / "bad.toml").write_text("[rope\n")
    with pytest.raises(ConfigError, match=r"bad\.toml: not a TOML file"):
        load_scenario(str(tmp_path / "bad.toml"))
    for strange in ("", ".", "/", "__init__", "../scenarios/still"):
        with pytest.raises(ConfigError, match="unknown scenario"):
            load_scenario(strange)


def test_other_files_in_the_folder_are_no_scenarios(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "scenarios").mkdir()
    for name in ("b.toml", "a.toml", "a.toml~", "README.md"):
        (tmp_path / "scenarios" / name).touch()
    monkeypatch.setattr("ropetrace.sim.scenario.resources.files", lambda _: tmp_path)
    assert scenario_names() == ["a", "b"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("duratoin = 3", "unknown setting duratoin: did you mean duration?"),
        ("[wind]\nfreqency = 1", "unknown setting wind.freqency: did you mean wind.frequency?"),
        ("[camra]\nwidth = 3", "unknown setting camra: did you mean camera?"),
        ("[clutter]\nbox = []", "unknown setting clutter.box: did you mean clutter.boxes?"),
        ("wind = 0.8", r"wind is a table: write \[wind\]"),
        ("duration = 0", "duration = 0.0: expected more than 0"),
        ("duration = nan", "duration = nan"),
        ("duration = inf", "duration = inf"),
        ('seed = "a"', "seed = 'a': expected a whole number"),
        ("[rope]\nlink_length = -0.1", r"link_length = -0\.1"),
        ("[rope]\nlinks = 3.5", r"rope\.links = 3\.5: expected a whole number"),
        ('[rope]\ntop = "fixed"', r"rope\.top = 'fixed': expected one of 'pinned', 'clamped', 'free'"),
        ("[wind]\nfrequency = 13", "wind frequency = 13.0 Hz: a step of"),
        ("[wind]\ndirection = [nan, 0, 0]", "unit vector"),
        ("[motion]\nanchor = [0, 0]", "motion.anchor = .*expected 3 numbers"),
        ("[motion]\nanchor = [0, 0, nan]", "motion.anchor"),
        ("[motion]\nsway = [0.1, 0, 0]", "motion.sway moves a held end: give motion.far_end"),
        ("[motion]\nfar_end = [0.6, 0, 0.95]", "motion.far_end gets 0.600 m from motion.anchor"),
        ("[motion]\nfar_end = [0.4, 0, 0.95]\nsway = [-0.2, 0, 0]", "motion.far_end gets 0.600 m from motion.anchor"),
        ("[motion]\nfar_end = [inf, 0, 0.95]", "motion.far_end"),
        ("[motion]\nfar_end = [0.4, 0, 0.95]\nsway_frequency = -1", "motion.sway_frequency = -1.0"),
        ("[motion]\nfar_end = [0.4, 0, 0.95]\nsway_frequency = 12.5", "expected 0 to 12 Hz"),
        ("[clutter]\nwall = nan", "clutter.wall"),
        ("[clutter]\nboxes = [[0, 0, 0, 1, 1, 0]]", "clutter.boxes"),
        ("[clutter]\nrobot = [[0, 0, 0, 1, 1, 0, -1]]", "clutter.robot"),
        ("[clutter]\nsecond_rope = [nan, 0, 0]", "clutter.second_rope"),
    ],
)
def test_what_a_file_gets_wrong_is_named(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(text)
    with pytest.raises(ConfigError, match=rf"scenario .*s\.toml: .*{message}"):
        load_scenario(str(tmp_path / "s.toml"))


def scene_error(scenario: Scenario, monkeypatch: pytest.MonkeyPatch, mujoco: bool = False) -> str:
    """The message of a scenario that is refused, without MuJoCo unless it is needed."""
    if not mujoco:

        def refuse(*_: str) -> None:
            pytest.fail("MuJoCo was started")

        monkeypatch.setattr(rope_module, "import_extra", refuse)
    with pytest.raises(ConfigError) as caught:
        SimulatedScene(scenario)
    return str(caught.value)


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (CameraSettings(width=0), "image size 0x480 is impossible"),
        (CameraSettings(fov_degrees=180), "horizontal_fov"),
        (CameraSettings(rate=0), "rate = 0"),
        (CameraSettings(rate=math.nan), "rate = nan"),
        (CameraSettings(exposure=0.1), "exposure = 0.1 s is longer than"),
        (CameraSettings(latency=-1), "latency = -1"),
        (CameraSettings(depth_unit=0), "depth_unit = 0"),
        (CameraSettings(noise="kinct"), "unknown noise model 'kinct'"),
        (CameraSettings(position=(0, 0, 0.675)), "cannot look at"),
        (CameraSettings(position=(math.nan, 0, 0.675)), "rigid"),
    ],
)
def test_a_camera_that_cannot_be(camera: CameraSettings, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert message in scene_error(Scenario(camera=camera), monkeypatch)


def test_a_rope_that_cannot_be(monkeypatch: pytest.MonkeyPatch) -> None:
    clamped = Scenario(rope=RopeModel(top="clamped"), motion=MotionSettings(lift=0.1))
    assert "clamped rope cannot be lifted" in scene_error(clamped, monkeypatch)
    lifted = Scenario(motion=MotionSettings(lift=1.2))
    assert "lift = 1.2 m" in scene_error(lifted, monkeypatch)
    seeded = Scenario(seed=-1)
    assert "seed = -1" in scene_error(seeded, monkeypatch)


@pytest.mark.parametrize(
    ("position", "clutter", "what"),
    [
        ((0.0, 0.0, 0.6), ClutterSettings(), "mm inside capsule"),
        ((0.0, -0.012, 0.6), ClutterSettings(), "mm from capsule"),
        ((0.2, 0.0, 0.6), ClutterSettings(second_rope=(0.2, 0.0, 0.0)), f"(label {SECOND_ROPE})"),
        ((0.0, -1.0, 0.6), ClutterSettings(boxes=((0.0, -1.0, 0.6, 0.2, 0.2, 0.2),)), "mm inside box"),
        ((0.0, -1.0, 0.6), ClutterSettings(robot=((0.0, -1.0, 0.0, 0.0, -1.0, 1.0, 0.1),)), "mm inside capsule"),
    ],
)
def test_a_camera_inside_something_is_refused(
    position: tuple[float, float, float], clutter: ClutterSettings, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = CameraSettings(position=position, look_at=(position[0] + 0.3, 0.3, 0.6))
    assert what in scene_error(Scenario(camera=camera, clutter=clutter), monkeypatch, mujoco=True)


def test_a_free_rope_leaves_the_image() -> None:
    """And is then not visible; nothing fails."""
    free = Scenario(rope=RopeModel(top="free"), camera=CameraSettings(width=160, height=120))
    (_, first), *_, (frame, last) = frames(free, 31)
    assert (first.visible_fraction, last.visible_fraction) == (1.0, 0.0)
    assert not frame.depth.any()


def test_a_wall_in_front_hides_all() -> None:
    hidden = Scenario(camera=CameraSettings(width=160, height=120), clutter=ClutterSettings(wall=-0.3))
    (frame, truth), *_ = frames(hidden, 1)
    assert truth.visible_fraction == 0
    np.testing.assert_array_equal(frame.depth, 700)


def test_labels_are_distinct() -> None:
    assert len({ROPE, SECOND_ROPE, CLUTTER}) == 3
    assert scenario_module.ROPE_COLOR == (200, 40, 30)
