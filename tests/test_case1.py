"""Case study 1: what is available when, the same bytes twice, and a run that can be stopped and gone on with."""

from __future__ import annotations

import csv
import io
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco")

from ropetrace.errors import ConfigError, OutputError, RopetraceError
from ropetrace.evaluation import runner
from ropetrace.evaluation.case1 import (
    CONDITIONS,
    Case,
    Case1Settings,
    Readings,
    frame_stamps,
    measure_compute_time,
    run_case,
    schedule,
)
from ropetrace.evaluation.case1_report import COLUMNS, csv_text, report_text, summary_table, write_report
from ropetrace.evaluation.experiments import CASE1, choose_cases
from ropetrace.evaluation.methods import TUNED
from ropetrace.evaluation.runner import run_cases

REAL_TIME, SLOW_MOTION = CONDITIONS
SHORT = Case1Settings(duration=0.5, warm_up=0.1, latency=0.005, phase=0.5)


def example_readings(count: int = 4, lost: tuple[int, ...] = ()) -> Readings:
    """Readings of errors that are known: 1 mm, 2 mm, ... and as many hundredths of a radian."""
    errors = np.arange(1, count + 1) * 1e-3
    errors[list(lost)] = np.nan
    arrays: dict[str, Any] = {item.name: errors * (10 if "angular" in item.name else 1) for item in fields(Readings)}
    found = np.isfinite(errors)
    arrays |= {
        "time": np.arange(1, count + 1) / 10,
        "status": np.where(found, "ok", "lost"),
        "coverage": found.astype(float),
        "speed": np.full(count, 0.5),
        "linear_floor": np.full(count, 0.0001),
        "angular_floor": np.full(count, 0.001),
    }
    return Readings(**arrays)


def test_a_fast_tracker_takes_every_frame() -> None:
    assert schedule(np.array([0.0, 1.0, 2.0]), 0.25) == [(0, 0.25), (1, 1.25), (2, 2.25)]
    assert schedule(np.array([0.0, 1.0]), 0.0) == [(0, 0.0), (1, 1.0)]
    assert schedule(np.array([]), 0.25) == []


def test_a_slow_tracker_takes_the_newest_frame_when_it_is_free() -> None:
    """With 1.5 intervals a frame: while frame 0 is worked on, 1 arrives and waits; after it, 2 and 3 have arrived."""
    assert schedule(np.arange(6.0), 1.5) == [(0, 1.5), (1, 3.0), (3, 4.5), (4, 6.0), (5, 7.5)]


def test_a_frame_that_arrives_as_the_tracker_gets_free_is_taken() -> None:
    assert schedule(np.arange(3.0), 1.0) == [(0, 1.0), (1, 2.0), (2, 3.0)]


def test_with_a_latency_of_several_intervals_most_frames_are_passed_over() -> None:
    assert schedule(np.arange(10.0), 4.0) == [(0, 4.0), (4, 8.0), (8, 12.0), (9, 16.0)]


@pytest.mark.parametrize("compute_time", [0.004, 0.05])
def test_a_centreline_is_never_younger_than_it_can_be(compute_time: float) -> None:
    readings = run_case(REAL_TIME, 0.8, replace(SHORT, duration=1.0), compute_time)
    assert len(readings.time) == 10
    assert np.nanmin(readings.age) >= compute_time - 1e-9
    found = np.isfinite(readings.linear)
    assert found[2:].all()
    assert (readings.status[~found] == "lost").all()
    assert (readings.linear[found] < 0.05).all()


def test_the_age_is_that_of_the_schedule() -> None:
    """Frames come half an interval after a reading, so the newest is half an interval old, or one and a half."""
    soon = run_case(REAL_TIME, 0.0, SHORT, 0.01)
    np.testing.assert_allclose(soon.age, 0.5 / 30, atol=1e-9)
    late = run_case(REAL_TIME, 0.0, SHORT, 0.02)
    np.testing.assert_allclose(late.age, 1.5 / 30, atol=1e-9)


def test_before_the_first_centreline_readings_are_missing() -> None:
    readings = run_case(REAL_TIME, 0.0, replace(SHORT, warm_up=0.0), 0.25)
    np.testing.assert_array_equal(np.isnan(readings.linear), [True, True, False, False, False])
    assert readings.coverage[:2].tolist() == [0, 0]


def test_a_case_repeats_bit_for_bit() -> None:
    settings = replace(SHORT, duration=2.0, noise="kinect_v1")
    case = Case(REAL_TIME, 0.8)
    first, second = (csv_text({case: run_case(REAL_TIME, 0.8, settings, 0.005)}) for _ in range(2))
    assert first == second
    assert first.count("\n") == 21


@pytest.mark.parametrize("method", ["cpd", TUNED])
def test_another_method_is_timed_and_judged_alike(method: str) -> None:
    settings = replace(SHORT, method=method, latency=None)
    seconds = measure_compute_time(SLOW_MOTION, settings, frames=3)
    assert 0 < seconds < 0.05
    real = measure_compute_time(REAL_TIME, settings, frames=3)
    readings = run_case(REAL_TIME, 0.8, settings, real)
    assert np.nanmin(readings.age) >= real - 1e-9
    assert np.nanmean(readings.linear_at_stamp) < 0.02
    report = report_text({Case(REAL_TIME, 0.8): readings}, settings, {"30fps": real})
    assert f"tracker: {method};" in report
    assert "its own method, slicing" in report


def test_a_rope_at_rest_is_found_to_a_tenth_of_a_millimetre() -> None:
    for condition in CONDITIONS:
        readings = run_case(condition, 0.0, SHORT, 0.001)
        assert readings.linear.max() < 1e-4
        assert readings.angular.max() < 0.005
        np.testing.assert_array_equal(readings.linear, readings.linear_at_stamp)


def test_cases_are_checked_before_they_run() -> None:
    assert [case.name for case in choose_cases(SHORT, ["60fps"], [0.8, 0.0])] == ["60fps_0.0", "60fps_0.8"]
    assert len(choose_cases(SHORT)) == 18
    for settings, conditions, frequencies, said in (
        (SHORT, ["25fps"], [0.8], "unknown condition"),
        (SHORT, ["30fps"], [20.0], "resolves"),
        (SHORT, ["30fps"], [-1.0], "frequency"),
        (SHORT, ["30fps"], [], "no case"),
        (replace(SHORT, noise="fog"), ["30fps"], [0.8], "noise model"),
    ):
        with pytest.raises(ConfigError, match=said):
            choose_cases(settings, conditions, frequencies)


def run_in(path: Path, settings: Case1Settings = SHORT, overwrite: bool = False, **options: str) -> bytes:
    """Two cases, side by side; the bytes of their readings."""
    cases = choose_cases(settings, ["30fps"], [0.0, 0.8])
    folder = CASE1.folder(path)
    times = CASE1.begin(folder, settings, [REAL_TIME], overwrite)
    counts: list[int] = []
    run_cases(CASE1, folder, cases, settings, times, on_progress=counts.append, jobs=2, **options)
    assert len(folder.finished(cases)) == 2
    results = {case: folder.load(case) for case in cases}
    written = write_report(path, results, settings, times)
    assert [file.name for file in written] == ["case1.csv", "case1.md", "case1.png"]
    return b"".join(file.read_bytes() for file in written)


def test_a_run_goes_on_where_it_stopped_and_gives_the_same_bytes(tmp_path: Path) -> None:
    whole = run_in(tmp_path / "case1")
    deleted = tmp_path / "case1" / "cases" / "30fps_0.8.npz"
    kept = tmp_path / "case1" / "cases" / "30fps_0.0.npz"
    deleted.unlink()
    before = kept.stat().st_mtime_ns
    assert run_in(tmp_path / "case1") == whole
    assert kept.stat().st_mtime_ns == before, "a finished case is not run again"
    with pytest.raises(ConfigError, match=r"latency: 0\.005, now 0\.04"):
        run_in(tmp_path / "case1", replace(SHORT, latency=0.04))
    assert run_in(tmp_path / "case1", replace(SHORT, latency=0.04), overwrite=True) != whole


def test_the_compute_time_is_measured_once(tmp_path: Path) -> None:
    measured: list[str] = []

    def measure(condition: object, settings: object) -> float:
        measured.append(str(condition))
        return 0.001 * len(measured)

    experiment = replace(CASE1, measure=measure)
    settings = replace(SHORT, latency=None)
    folder = experiment.folder(tmp_path / "case1")
    assert experiment.begin(folder, settings, [REAL_TIME]) == {"30fps": 0.001}
    assert experiment.begin(folder, settings, CONDITIONS) == {"30fps": 0.001, "60fps": 0.002}
    assert experiment.begin(folder, settings, CONDITIONS) == {"30fps": 0.001, "60fps": 0.002}
    assert len(measured) == 2
    assert experiment.begin(folder, settings, [REAL_TIME], overwrite=True) == {"30fps": 0.003}


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(OutputError, match=r"no settings\.toml"):
        CASE1.begin(CASE1.folder(tmp_path), SHORT, [REAL_TIME])
    with pytest.raises(OutputError, match="is a file"):
        CASE1.begin(CASE1.folder(tmp_path / "letter.txt"), SHORT, [REAL_TIME])
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


def test_a_damaged_case_is_named(tmp_path: Path) -> None:
    folder, case = CASE1.folder(tmp_path / "case1"), Case(REAL_TIME, 0.8)
    CASE1.begin(folder, SHORT, [REAL_TIME])
    folder.run_path(case).write_bytes(b"PK\x03\x04 no")
    with pytest.raises(OutputError, match=r"30fps_0\.8\.npz: cannot be read"):
        folder.load(case)


def test_on_a_dask_cluster_the_bytes_are_the_same(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    # In a process of its own: Dask leaves threads and warnings behind.
    code = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from pathlib import Path
from distributed import LocalCluster
from test_case1 import run_in
options = dict(n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None)
with LocalCluster(host="127.0.0.1", **options) as cluster:
    run_in(Path("cluster"), cluster=cluster.scheduler_address)
"""
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True, capture_output=True, timeout=300)
    run_in(tmp_path / "here")
    for name in ("case1.csv", "case1.md", "case1.png"):
        assert (tmp_path / "cluster" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()


def test_a_cluster_without_an_address_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(ConfigError, match="address of a Dask scheduler"):
        run_in(tmp_path / "case1", cluster="nonsense")


def test_ctrl_c_keeps_finished_cases_and_says_so_in_one_line(tmp_path: Path) -> None:
    code = (
        "import sys; from ropetrace.cli_simulation import Reproduce; "
        "sys.exit(Reproduce('case1', quick=True, conditions=('30fps',), latency='1ms', jobs=2).run())"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 300
    while not list(tmp_path.glob("case1/cases/*.npz")) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: the workers get it too
    out, err = process.communicate(timeout=300)
    assert process.returncode == 130, err
    assert out == ""
    assert err.count("\n") == 1, err
    kept = list(tmp_path.glob("case1/cases/*.npz"))
    assert f"{len(kept)} of 9 cases are finished and kept" in err
    assert 1 <= len(kept) < 9
    assert sorted(path.name for path in tmp_path.glob("case1/*")) == ["cases", "settings.toml"]


def test_a_case_that_fails_is_one_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "version", lambda name: "0.0.0")
    folder = CASE1.folder(tmp_path / "case1")
    cases = choose_cases(SHORT, ["30fps"], [0.8])
    with pytest.raises(RopetraceError, match=r"a worker has ropetrace .*, not 0\.0\.0"):
        run_cases(CASE1, folder, cases, SHORT, CASE1.begin(folder, SHORT, [REAL_TIME]))
    with pytest.raises(ConfigError, match="--jobs 0"):
        run_cases(CASE1, folder, cases, SHORT, {"30fps": 0.01}, jobs=0)


def test_the_csv_has_every_reading_and_its_very_bits() -> None:
    case, readings = Case(REAL_TIME, 0.8), example_readings(lost=(2,))
    rows = list(csv.DictReader(io.StringIO(csv_text({case: readings}))))
    assert list(rows[0]) == ["condition", "frequency_hz", *COLUMNS]
    assert [row["linear_m"] for row in rows] == ["0.001", "0.002", "", "0.004"]
    assert [row["status"] for row in rows] == ["ok", "ok", "lost", "ok"]
    for column, name in COLUMNS.items():
        if name != "status":
            read = [float(row[column] or "nan") for row in rows]
            np.testing.assert_array_equal(read, getattr(readings, name))


def test_the_summary_counts_what_is_missing_and_shows_what_was_found() -> None:
    results = {Case(REAL_TIME, 0.8): example_readings(lost=(3,)), Case(SLOW_MOTION, 0.8): example_readings()}
    lost, whole = ([cell.strip() for cell in line.split("|")] for line in summary_table(results).splitlines()[2:])
    mean = (1 + 2 + 3 + 550) / 4
    assert lost[1:5] == ["30fps", "0.8", "4", "1"]
    assert lost[5].startswith(f"{mean:.3f} ± ")
    assert lost[6] == "12.1 ± 8.25"
    assert lost[9].startswith(f"{(1 + 2 + 3 + 100 * math.pi) / 4:.3f} ± ")
    assert whole[4:6] == ["0", "2.500 ± 1.118"]
    report = report_text(results, SHORT, {"30fps": 0.005})
    assert "those that were found, alone" in report
    assert "2.000 ± 0.816" in report


def test_the_parts_of_the_error_at_the_resonance_make_it_up() -> None:
    report = report_text({Case(REAL_TIME, 0.8): example_readings()}, SHORT, {"30fps": 0.005})
    assert "5 ms" in report
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in report.splitlines() if " 30fps |" in line]
    mean_error, linear, angular = rows[-3:]
    assert mean_error[1:] == ["1", "2.500", "9.70"]
    moved, own, spline, rest, total = map(float, linear[4:])
    assert spline == 0.1
    assert moved + own + rest == pytest.approx(total)
    assert linear[3] == "1.250", "age x speed: 2.5 ms at 0.5 m/s"
    floor, beyond, age, whole = map(float, angular[1:])
    assert floor + beyond + age == pytest.approx(whole)
    assert "resonance" not in report_text({Case(REAL_TIME, 0.2): example_readings()}, SHORT, {"30fps": 0.005})


def test_frames_come_at_every_phase_equally_often() -> None:
    settings = Case1Settings(duration=300.0)
    stamps = frame_stamps(30.0, 9300, settings)
    phases = (stamps[300:] * 30.0) % 1
    counts, _ = np.histogram(phases, bins=np.arange(17) / 16 - 1 / 32, range=(0, 1))
    assert counts[1:].min() > 0.9 * 9000 / 16
    assert np.diff(stamps).max() < 1 / 30 + 1 / 400
    np.testing.assert_allclose(stamps * 480, np.round(stamps * 480), atol=1e-9)
    fixed = frame_stamps(30.0, 100, Case1Settings(phase=0.5))
    np.testing.assert_allclose(fixed, (np.arange(100) + 0.5) / 30.0, atol=1e-12)
