"""Case study 2: an arm that traces the rope, what is counted and what is named, and a run that can be gone on with."""

from __future__ import annotations

import csv
import io
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("pinocchio")

from ropetrace.errors import ConfigError
from ropetrace.evaluation.case1 import CONDITIONS, Case
from ropetrace.evaluation.case2 import PLACEMENTS, Case2Settings, Placement, Tracing, run_tracing
from ropetrace.evaluation.case2_report import (
    COLUMNS,
    csv_text,
    figure,
    joints_table,
    limits_table,
    report_text,
    summary_table,
    worst_table,
    write_report,
)
from ropetrace.evaluation.experiments import CASE2, choose_cases
from ropetrace.evaluation.runner import run_cases

REAL_TIME, SLOW_MOTION = CONDITIONS
SHORT = Case2Settings(tracings=2, warm_up=0.6, latency=0.001)


def example(count: int = 4, outcome: str = "done", scale: float = 1.0, **others: Any) -> Tracing:
    """A tracing of errors that are known: 1 mm, 2 mm, ... and as many hundredths of a radian, times the scale."""
    errors = scale * np.arange(1, count + 1)
    arrays: dict[str, Any] = {
        "time": np.arange(count) / 10,
        "linear": errors * 1e-3,
        "angular": errors * 1e-2,
        "place": np.linspace(0, 1, count),
        "visible": np.full(count, 0.9),
        "outcome": np.array(outcome),
        "approach": np.array(0.25),
        "duration": np.array(count / 10),
        "manipulability": np.array(0.03),
        "margin": np.array([1, 0.5, 0.25, 0.125, 0.5, 1, 2]),
        "velocity": np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]),
        "acceleration": np.array([1.0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]),
        "jerk": np.full(7, 0.75),
        "tool_speed": np.array(1.5),
        "limited": np.array(0.5),
        "braked": np.array(""),
        "traced": np.array(0.98),
    }
    return Tracing(**arrays | others)


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.split("|")[1:-1]]


@pytest.fixture(scope="module")
def still() -> Tracing:
    """A rope that hangs still."""
    return run_tracing(REAL_TIME, 0.0, SHORT, 0.001, 0)


def test_a_rope_at_rest_is_traced_from_end_to_end(still: Tracing) -> None:
    assert still.completed
    assert still.traced > 0.95
    assert len(still.time) > 20
    np.testing.assert_allclose(np.diff(still.time), 0.1, atol=1e-9)
    assert still.linear[5:].max() < 1e-3, "metres"
    assert still.angular[5:].max() < 0.05
    assert (np.diff(still.place) > -0.01).all()
    assert (still.visible == 1).all(), "the arm is behind the rope"
    for peak in (still.velocity, still.acceleration, still.jerk):
        assert peak.shape == (7,)
        assert peak.max() < 1 + 1e-9
    assert still.margin.min() > 0
    assert str(still.braked) == ""


def test_a_tracing_repeats_bit_for_bit() -> None:
    case = Case(REAL_TIME, 0.8, 0)
    settings = replace(SHORT, noise="kinect_v1", longest=1.0)
    first, second = (csv_text({case: run_tracing(REAL_TIME, 0.8, settings, 0.001, 0)}) for _ in range(2))
    assert first == second
    assert first != csv_text({case: run_tracing(REAL_TIME, 0.8, settings, 0.001, 1)}), "another phase and other noise"


def test_a_tracing_that_takes_too_long_is_named_and_its_readings_stay() -> None:
    tracing = run_tracing(REAL_TIME, 0.0, replace(SHORT, longest=1.0), 0.001, 0)
    assert str(tracing.outcome) == "too slow"
    assert not tracing.completed
    assert 8 <= len(tracing.time) <= 10
    assert 0.05 < tracing.traced < 0.6


def test_readings_go_on_while_the_arm_is_blind() -> None:
    """Centrelines that come half a second late are too old: the arm stands still, and the readings tell."""
    tracing = run_tracing(REAL_TIME, 0.0, replace(SHORT, longest=1.0), 0.5, 0)
    assert str(tracing.outcome) == "too slow: stale"
    assert "stale" in str(tracing.braked)
    assert tracing.velocity.max() == 0


def test_an_arm_beside_the_camera_hides_the_rope_from_it() -> None:
    settings = replace(Case2Settings.at("beside_camera"), warm_up=0.6, longest=3.0)
    assert settings.tracing.approach == "from_camera"
    tracing = run_tracing(REAL_TIME, 0.0, settings, 0.001, 0)
    assert tracing.visible.min() < 0.9
    assert tracing.margin.min() > 0
    for peak in (tracing.velocity, tracing.acceleration, tracing.jerk):
        assert peak.max() < 1 + 1e-9


def test_settings_are_checked() -> None:
    for wrong, said in (
        ({"tracings": 0}, "tracings"),
        ({"longest": 0.0}, "longest"),
        ({"interval": 0.001}, "interval"),
        ({"interval": 0.101}, "multiple of the period"),
        ({"latency": -1.0}, "latency"),
        ({"warm_up": -20.0}, "warm_up"),
    ):
        with pytest.raises(ConfigError, match=said):
            Case2Settings(**wrong)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="unknown placement 'above': choose of behind, beside_camera"):
        Case2Settings.at("above")
    with pytest.raises(ConfigError, match="noise model"):
        choose_cases(Case2Settings(noise="fog"))
    with pytest.raises(ConfigError, match="7 joints"):
        run_tracing(REAL_TIME, 0.0, Case2Settings(placement=Placement(start=(0.0,))), 0.001, 0)


def test_every_tracing_is_a_case() -> None:
    assert len(choose_cases(Case2Settings())) == 54
    names = [case.name for case in choose_cases(SHORT, ["60fps"], [0.8])]
    assert names == ["60fps_0.8_1", "60fps_0.8_2"]


def run_in(path: Path, settings: Case2Settings = SHORT) -> bytes:
    """Two tracings side by side; the bytes of their report."""
    cases = choose_cases(settings, ["30fps"], [0.0])
    folder = CASE2.folder(path)
    times = CASE2.begin(folder, settings, [REAL_TIME])
    run_cases(CASE2, folder, cases, settings, times, jobs=2)
    results = {case: folder.load(case) for case in cases}
    written = write_report(path, results, settings, times)
    assert [file.name for file in written] == ["case2.csv", "case2.md", "case2.png"]
    return b"".join(file.read_bytes() for file in written)


def test_a_run_goes_on_where_it_stopped_and_gives_the_same_bytes(tmp_path: Path) -> None:
    settings = replace(SHORT, longest=0.5)
    whole = run_in(tmp_path, settings)
    lost, kept = (tmp_path / "cases" / f"30fps_0.0_{number}.npz" for number in (2, 1))
    lost.unlink()
    before = kept.stat().st_mtime_ns
    assert run_in(tmp_path, settings) == whole
    assert kept.stat().st_mtime_ns == before, "a finished tracing is not run again"
    table = tomllib.loads((tmp_path / "settings.toml").read_text())
    assert table["placement"]["start"] == list(settings.placement.start)
    assert table["tracing"]["gain_near"] == settings.tracing.gain_near
    assert table["compute_time"] == {"30fps": 0.001}
    stiffer = replace(settings, tracing=replace(settings.tracing, gain_near=1.5))
    with pytest.raises(ConfigError, match=r"tracing\.gain_near: .*, now 1\.5"):
        run_in(tmp_path, stiffer)
    moved = replace(settings, placement=PLACEMENTS["beside_camera"])
    with pytest.raises(ConfigError, match=r"placement\.base: \["):
        run_in(tmp_path, moved)


def test_the_csv_has_every_reading_and_its_very_bits() -> None:
    failed = example(2, 'joint 4 is at 1 rad, "far"')
    text = csv_text({Case(REAL_TIME, 0.8, 0): example(), Case(REAL_TIME, 0.8, 2): failed})
    rows = list(csv.DictReader(io.StringIO(text)))
    assert list(rows[0]) == ["condition", "frequency_hz", "tracing", "outcome", *COLUMNS]
    assert [row["tracing"] for row in rows] == ["1"] * 4 + ["3"] * 2
    assert rows[-1]["outcome"] == str(failed.outcome)
    for column, name in COLUMNS.items():
        np.testing.assert_array_equal([float(row[column]) for row in rows[:4]], getattr(example(), name))


RESULTS = {
    Case(REAL_TIME, 0.0, 0): example(scale=0.1),
    Case(REAL_TIME, 0.8, 0): example(),
    Case(REAL_TIME, 0.8, 1): example(2, "fell off", 10.0, traced=np.array(0.5), braked=np.array("3 x stale")),
    Case(SLOW_MOTION, 0.8, 0): example(0, "stuck", traced=np.array(0.0)),
}


def test_failures_are_counted_and_named_and_never_removed() -> None:
    rows = [cells(line) for line in summary_table(RESULTS).splitlines()[2:]]
    assert [row[2] for row in rows] == ["1 of 1", "1 of 2", "0 of 1"]
    pooled = np.array([1, 2, 3, 4, 10, 20])
    assert rows[1][3:5] == ["74.0%", "6"]
    assert rows[1][5:7] == [f"{pooled.mean():.3f} ± {pooled.std():.3f}", "20.00"]
    assert rows[2][4:9] == ["0", "", "", "", ""], "nothing to say of no readings"
    report = report_text(RESULTS, SHORT, {"30fps": 0.001})
    assert "2 of 4 tracings were completed" in report
    assert [cells(line) for line in report.splitlines() if "fell off" in line] == [
        ["30fps", "0.8", "2", "fell off", "50.0%", "2"]
    ]
    assert figure(RESULTS).startswith(b"\x89PNG")


def test_the_worst_case_stands_beside_the_papers() -> None:
    (row,) = [cells(line) for line in worst_table(RESULTS).splitlines()[2:]]
    assert row[:2] == ["30fps", "0.8"]
    assert row[3] == "25.8 ± 31.8"
    assert row[6] == "0.249 ± 0.177"
    assert float(row[5].split()[0]) == pytest.approx(0.0667, abs=5e-4)


def test_the_limits_say_which_joint() -> None:
    rows = [cells(line) for line in limits_table(RESULTS).splitlines()[2:]]
    assert rows[0][2:9] == ["0.0300", "0.125 (J4)", "70% (J7)", "100% (J1)", "75% (J1)", "1.50", "50.0%"]
    assert [row[9:] for row in rows] == [["90%", "nothing"], ["90%", "3 x stale"], ["", "nothing"]]
    joints = [cells(line) for line in joints_table(RESULTS).splitlines()[2:]]
    assert joints[3] == ["J4", "0.125", "40%", "40%", "75%"]


def test_the_report_states_the_gains() -> None:
    report = report_text(RESULTS, SHORT, {"30fps": 0.001})
    assert "Table II is lost" in report
    gains = {cells(line)[0]: cells(line)[2] for line in report.splitlines() if "lambda_0" in line}
    assert gains == {"gain_near": f"{SHORT.tracing.gain_near:g}"}
