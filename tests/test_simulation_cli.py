"""`ropetrace simulate` and `ropetrace reproduce`, end to end: recordings that open, truths that fit."""

from __future__ import annotations

import dataclasses
import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco")

from ropetrace.cli_simulation import Reproduce, Simulate, parse_duration
from ropetrace.config import RopeConfig
from ropetrace.errors import ConfigError, RopetraceError
from ropetrace.evaluation.metrics import symmetric_mean
from ropetrace.recordings import open_recording
from ropetrace.sim.scenario import scenario_names
from ropetrace.trackers import make_tracker
from ropetrace.types import BadFrame, Status

COLOR = "#c8281e"
SMALL = """
duration = 0.2
[wind]
frequency = 0.8
[camera]
width = 160
height = 120
"""


def truth_of(path: Path) -> dict[str, Any]:
    with np.load(path, allow_pickle=False) as arrays:
        return dict(arrays)


def write_scenario(folder: Path, text: str = SMALL) -> str:
    path = folder / "mine.toml"
    path.write_text(text)
    return str(path)


def check_round_trip(recording: Path, truth_file: Path, frames: int, bound: float) -> None:
    """Track a recording, and compare with its truth."""
    truth = truth_of(truth_file)
    tracker = make_tracker(RopeConfig(0.015, COLOR))
    events = list(open_recording(recording).frames())
    assert len(events) == len(truth["stamp_ns"]) == frames
    for event, stamp, polyline in zip(events, truth["stamp_ns"], truth["polyline"], strict=True):
        assert not isinstance(event, BadFrame)
        assert event.stamp_ns == stamp
        estimate = tracker.update(event)
        assert estimate.status is Status.OK
        assert symmetric_mean(estimate.waypoints.positions, polyline) < bound


def test_a_simulated_mcap_is_tracked_to_its_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "swing.mcap"
    assert Simulate("swing", out, seconds=0.5).run() == 0
    check_round_trip(out, tmp_path / "swing.mcap.truth.npz", 15, 0.002)
    said = capsys.readouterr().out
    assert str(out) in said
    assert "15 frames" in said
    assert f"ropetrace track {out} --diameter 15mm --color '{COLOR}'" in said


def test_a_simulated_folder_is_tracked_to_its_truth(tmp_path: Path) -> None:
    assert Simulate("drop", tmp_path / "drop", seconds=0.5).run() == 0
    check_round_trip(tmp_path / "drop", tmp_path / "drop" / "truth.npz", 15, 0.002)


def test_the_truth_says_all_of_a_frame(tmp_path: Path) -> None:
    Simulate(write_scenario(tmp_path), tmp_path / "a.mcap").run()
    truth = truth_of(tmp_path / "a.mcap.truth.npz")
    shapes = {name: array.shape for name, array in truth.items()}
    assert shapes == {
        "stamp_ns": (6,),
        "polyline": (6, 11, 3),
        "link_quaternions": (6, 10, 4),
        "link_centres": (6, 10, 3),
        "link_velocities": (6, 10, 3),
        "visible_fraction": (6,),
        "world_from_camera": (4, 4),
        "scenario": (),
    }
    assert json.loads(str(truth["scenario"]))["camera"]["width"] == 160
    np.testing.assert_array_equal(truth["stamp_ns"], np.round(np.arange(6) * 1e9 / 30))
    # The world's centres, seen from the camera, are the middles of the links.
    pose = truth["world_from_camera"]
    centres = (truth["link_centres"] - pose[:3, 3]) @ pose[:3, :3]
    np.testing.assert_allclose(centres, (truth["polyline"][:, 1:] + truth["polyline"][:, :-1]) / 2, atol=1e-12)
    np.testing.assert_array_equal(truth["visible_fraction"] > 0.9, True)


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    scenario = write_scenario(tmp_path, SMALL + 'noise = "stereo"\n')
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        Simulate(scenario, tmp_path / f"{name}.mcap", seed=seed).run()
    a, b, c = ((tmp_path / f"{name}.mcap").read_bytes() for name in "abc")
    assert a == b
    assert a != c
    first, second = (truth_of(tmp_path / f"{name}.mcap.truth.npz") for name in "ac")
    np.testing.assert_array_equal(first["polyline"], second["polyline"])


def test_the_list_names_every_scenario(capsys: pytest.CaptureFixture[str]) -> None:
    assert Simulate(list=True).run() == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == scenario_names()
    assert all(len(line.split()) > 4 for line in lines)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[rope]\nlink_length = -0.1", "link_length"),
        ("[camera]\nposition = [0.0, -0.003, 0.9]", "camera is"),
        ("[wind]\nfrequency = 50", "resolves"),
        ("[camera]\nrate = 0", "rate"),
        ("duration = -1", "duration"),
        ('[camera]\nnoise = "fog"', "noise model"),
        ("[camera]\ndepth_unit = 0.005", "depth_unit"),
        ("[rope]\nlinks = 'ten'", "links"),
        ("colour = 1", "unknown setting"),
    ],
)
def test_an_impossible_scenario_is_refused_before_anything_is_written(tmp_path: Path, text: str, said: str) -> None:
    scenario = write_scenario(tmp_path, text)
    with pytest.raises(RopetraceError, match=said) as caught:
        Simulate(scenario, tmp_path / "out.mcap").run()
    assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.toml"]


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (Simulate(), "which scenario"),
        (Simulate("swing"), "where to"),
        (Simulate("sving", Path("a.mcap")), "unknown scenario 'sving'"),
        (Simulate("none.toml", Path("a.mcap")), "cannot be read"),
        (Simulate("swing", Path("a.mcap"), seconds=-1), "duration"),
        (Simulate("swing", Path("a.mcap"), seed=-1), "seed"),
        (Simulate("swing", Path("a")), "float depth .* give a.mcap"),
        (Simulate("drop", Path("a.bag")), "not written"),
        (Simulate("drop", Path("missing/a.mcap")), "does not exist"),
        (Reproduce("case1", noise="fog"), "noise model"),
        (Reproduce("case1", latency="soon"), "not a duration"),
        (Reproduce("case1", latency="-1ms"), "latency"),
        (Reproduce("case1", phase=1.5), "phase"),
        (Reproduce("case1", frequencies=(13.0,)), "resolves"),
        (Reproduce("case1", jobs=0), "--jobs 0"),
        (Reproduce("case1", placement="behind"), "--placement means nothing for case1"),
        (Reproduce("case1", method="guessing"), "unknown method 'guessing'"),
        (Reproduce("case1", methods=("slicing",)), "--methods means nothing for case1"),
        (Reproduce("case2", method="slicing"), "--method means nothing for case2"),
        (Reproduce("case3", methods=("guessing",)), "unknown method 'guessing'"),
        (Reproduce("case3", methods=()), "no method"),
        (Reproduce("case3", noise="fog"), "noise model"),
        (Reproduce("case3", jobs=0), "--jobs 0"),
        (Reproduce("case3", method="slicing"), "--method means nothing for case3"),
        (Reproduce("case3", latency="1ms"), "--latency means nothing for case3"),
        (Reproduce("case3", conditions=("30fps",)), "--conditions means nothing for case3"),
        (Reproduce("case3", frequencies=(0.0,)), "--frequencies means nothing for case3"),
        (Reproduce("case2", predict="now"), "--predict means nothing for case2"),
        (Reproduce("case2", phase=0.5), "--phase means nothing for case2"),
        (Reproduce("case2", noise="fog"), "noise model"),
        (Reproduce("case2", latency="-1ms"), "latency"),
        (Reproduce("case2", frequencies=(13.0,)), "resolves"),
        (Reproduce("case2", jobs=0), "--jobs 0"),
    ],
)
def test_what_cannot_be_is_one_line_and_leaves_nothing(
    command: Simulate | Reproduce, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RopetraceError, match=said) as caught:
        command.run()
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["out.mcap", "out"])
def test_a_recording_is_replaced_only_when_asked(tmp_path: Path, name: str) -> None:
    command = Simulate(write_scenario(tmp_path), tmp_path / name)
    assert command.run() == 0
    with pytest.raises(RopetraceError, match="--overwrite"):
        command.run()
    assert dataclasses.replace(command, overwrite=True, seconds=0.1).run() == 0
    assert sum(1 for _ in open_recording(tmp_path / name).frames()) == 3


def test_a_folder_of_something_else_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "depth.txt").write_text("dear")
    with pytest.raises(RopetraceError, match="holds no simulated recording"):
        Simulate("drop", tmp_path / "mine", overwrite=True).run()
    assert (tmp_path / "mine" / "depth.txt").read_text() == "dear"


def test_after_ctrl_c_frames_and_truths_are_as_many(tmp_path: Path) -> None:
    scenario = write_scenario(tmp_path, SMALL.replace("0.2", "1000"))
    code = (
        "import sys; from pathlib import Path; from ropetrace.cli_simulation import Simulate; "
        f"sys.exit(Simulate({scenario!r}, Path('out.mcap')).run())"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    recording = tmp_path / "out.mcap"
    deadline = time.monotonic() + 300
    while (not recording.exists() or recording.stat().st_size < 50_000) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=300)
    assert process.returncode == 130, err
    assert err.count("\n") == 1, err
    stamps = truth_of(tmp_path / "out.mcap.truth.npz")["stamp_ns"]
    frames = [event.stamp_ns for event in open_recording(recording).frames()]
    assert len(frames) > 3
    np.testing.assert_array_equal(frames, stamps)
    assert f"{len(frames)} of 30000 frames" in err


def test_reproduce_prints_the_table_and_the_paths(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("ropetrace.cli_simulation.QUICK_SECONDS", 0.5)
    monkeypatch.chdir(tmp_path)
    command = Reproduce("case1", quick=True, conditions=("30fps",), frequencies=(0.0,), latency="5ms", jobs=1)
    for given, folder in (
        (command, "case1"),
        (dataclasses.replace(command, method="gltp"), "case1_gltp"),
        (dataclasses.replace(command, out=Path("out"), method="gltp"), "out"),
    ):
        assert given.run() == 0
        said = capsys.readouterr().out
        assert "2.69 ± 0.0892" in said
        for name in ("case1.csv", "case1.md", "case1.png"):
            assert f" {folder}/{name}" in said
            assert (tmp_path / folder / name).stat().st_size > 100
        assert len((tmp_path / folder / "case1.csv").read_text().splitlines()) == 6
    assert dataclasses.replace(command, method="slicing").run() == 0
    assert " case1/case1.csv" in capsys.readouterr().out


def test_reproduce_case2_prints_the_table_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pinocchio")
    monkeypatch.chdir(tmp_path)
    command = Reproduce("case2", quick=True, conditions=("30fps",), frequencies=(0.0,), latency="1ms", jobs=1)
    assert command.run() == 0
    said = capsys.readouterr().out
    assert "1 of 1" in said
    for name in ("case2.csv", "case2.md", "case2.png"):
        assert f"case2/{name}" in said
        assert (tmp_path / "case2" / name).stat().st_size > 100
    before = (tmp_path / "case2" / "case2.md").read_bytes()
    assert command.run() == 0
    assert (tmp_path / "case2" / "case2.md").read_bytes() == before
    assert capsys.readouterr().out == said
    with pytest.raises(ConfigError, match="begun with other settings"):
        dataclasses.replace(command, placement="beside_camera").run()


def test_reproduce_case3_prints_the_tables_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("ropetrace.cli_simulation.QUICK_DROP_SECONDS", 2.5)
    monkeypatch.setattr("ropetrace.cli_simulation.QUICK_HEIGHTS", (0.0, 0.02))
    monkeypatch.chdir(tmp_path)
    command = Reproduce("case3", quick=True, methods=("slicing",), jobs=1)
    assert command.run() == 0
    said = capsys.readouterr().out
    assert "30.3" in said
    for name in ("case3.csv", "case3.md", "case3.png"):
        assert f"case3/{name}" in said
        assert (tmp_path / "case3" / name).stat().st_size > 100
    before = (tmp_path / "case3" / "case3.csv").read_bytes()
    assert command.run() == 0
    assert capsys.readouterr().out == said
    assert (tmp_path / "case3" / "case3.csv").read_bytes() == before
    with pytest.raises(ConfigError, match="begun with other settings"):
        dataclasses.replace(command, noise="none").run()


@pytest.mark.parametrize(("text", "seconds"), [("40ms", 0.04), ("0.04s", 0.04), (" 0.04 ", 0.04), ("1e-3 s", 0.001)])
def test_durations(text: str, seconds: float) -> None:
    assert parse_duration(text) == seconds


@pytest.mark.parametrize("text", ["", "ms", "40 m", "nan", "1e999", "4 0ms", "inf s"])
def test_no_durations(text: str) -> None:
    with pytest.raises(ConfigError, match="not a duration"):
        parse_duration(text)
