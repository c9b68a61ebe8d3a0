"""Case study 3: the pipe, where its markers are, whose clock is found, and the errors of tracks that are known."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

from helpers import DATA, needs_data
from ropetrace.centerline import make_waypoints
from ropetrace.config import RopeConfig
from ropetrace.errors import ConfigError, RecordingError
from ropetrace.evaluation import case3
from ropetrace.evaluation.case3 import (
    HEIGHTS,
    Case3,
    Case3Settings,
    MarkerTrack,
    Tracked,
    choose_cases,
    errors,
    run_case,
)
from ropetrace.evaluation.case3_mocap import run_motion_capture
from ropetrace.evaluation.case3_report import csv_text, report_text, write_report
from ropetrace.evaluation.clocks import clock_offset
from ropetrace.evaluation.experiments import CASE3
from ropetrace.evaluation.methods import CASE_METHODS, TUNED, case_tracker
from ropetrace.evaluation.runner import run_cases
from ropetrace.sim.pipe import PipeModel, PipeSimulation, lifted_angles
from ropetrace.types import Estimate, FloatArray, Status, Waypoints

SHORT = Case3Settings(duration=1.5, skip=0.3)
PIPE = PipeModel()


@pytest.mark.parametrize("lift", [0.0, 0.005, 0.045])
@pytest.mark.parametrize("tilt", [0.0, math.pi / 2])
def test_the_free_end_is_lifted_as_told(lift: float, tilt: float) -> None:
    model = PipeModel(tilt=tilt, modulus=15e6 if tilt == 0 else 300e6)
    rest, lifted = (PipeSimulation(model, (0.1, 0.2, 1.0), height, 0.3).axis() for height in (0.0, lift))
    assert lifted[-1, 2] - rest[-1, 2] == pytest.approx(lift, abs=1e-9)
    assert np.allclose(lifted[0], [0.1, 0.2, 1.0])
    assert np.allclose(np.linalg.norm(np.diff(lifted, axis=0), axis=1), model.link_length)
    # All in one plane, which the azimuth turns.
    assert np.allclose((lifted - lifted[0])[:, :2] @ [-math.sin(0.3), math.cos(0.3)], 0, atol=1e-9)


def test_a_pipe_at_rest_stays_there() -> None:
    pipe = PipeSimulation(PipeModel(tilt=1.0, modulus=100e6))
    before = pipe.axis()
    pipe.advance(1.0)
    assert np.allclose(pipe.axis(), before, atol=1e-6)


def test_the_swing_is_that_of_a_beam_with_weight() -> None:
    """Between Dunkerley's bound, f^2 = beam^2 + chain^2, and a little above; and it dies away slowly."""
    pipe = PipeSimulation(PIPE, lift=0.005)
    times = np.arange(0, 5, 1 / 60)
    places = []
    for time in times:
        pipe.advance(time)
        places.append(pipe.axis()[-1, 0])
    swing = np.array(places)
    crossings = np.flatnonzero((swing[1:] > 0) & (swing[:-1] <= 0))
    frequency = 1 / np.diff(times[crossings]).mean()
    beam = 3.516 / (2 * math.pi * PIPE.length**2) * math.sqrt(PIPE.bending_stiffness / PIPE.mass_per_length)
    chain = 1.2024 * math.sqrt(9.81 / PIPE.length) / (2 * math.pi)
    assert math.hypot(beam, chain) < frequency < 1.05 * math.hypot(beam, chain)
    assert 0.6 < np.abs(swing[-48:]).max() / np.abs(swing[:48]).max() < 0.9


def test_a_cantilever_sags_as_the_books_say() -> None:
    """w L^4 / 8 EI, for a stiff one."""
    model = PipeModel(tilt=math.pi / 2, modulus=3e9, links=40)
    sag = model.link_length * np.cos(lifted_angles(model, 0.0)).sum()
    expected = model.mass_per_length * 9.81 * model.length**4 / (8 * model.bending_stiffness)
    assert sag == pytest.approx(expected, rel=0.01)


def test_what_no_pipe_can_do_is_refused() -> None:
    with pytest.raises(ConfigError, match="lifts"):
        lifted_angles(PIPE, 1.0)
    pipe = PipeSimulation(PIPE)
    pipe.advance(0.1)
    with pytest.raises(ConfigError, match="back"):
        pipe.advance(0.0)
    with pytest.raises(ConfigError, match="wall"):
        PipeModel(wall=0.02)


@pytest.mark.parametrize("true_offset", [-0.2371, 0.0, 0.1234])
def test_the_clock_of_the_markers_is_found(true_offset: float) -> None:
    rng = np.random.default_rng(0)

    def motion(times: FloatArray) -> FloatArray:
        return np.outer(0.05 * np.exp(-0.05 * times) * np.sin(7.8 * times), [1.0, 0.1, 0.05])

    times = np.arange(300) / 30 + 0.013
    cloud = 0.9 * motion(times) + [0.3, 0.1, 1.0] + rng.normal(0, 0.0005, (300, 3))
    cloud[40:50] = np.nan
    theirs = np.arange(1400) / 120
    markers = motion(theirs) + rng.normal(0, 0.0002, (1400, 3))
    found = clock_offset(times, cloud, theirs + true_offset, markers, 0.25)
    assert found == pytest.approx(true_offset, abs=1e-3)


def test_what_does_not_move_tells_no_time() -> None:
    times = np.arange(300) / 30
    rng = np.random.default_rng(0)
    still = rng.normal(0, 0.0002, (300, 3))
    assert clock_offset(times, still, times, still, 0.25) is None
    moving = np.outer(0.05 * np.sin(7.8 * times), [1.0, 0.0, 0.0])
    assert clock_offset(times, rng.normal(0, 0.05, (300, 3)), times, moving, 0.25) is None


def test_the_markers_are_where_the_paper_has_them(monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[MarkerTrack] = []

    def only_markers(frames: object, markers: MarkerTrack, *rest: object) -> None:
        kept.append(markers)

    monkeypatch.setattr(case3, "judged", only_markers)
    for offset in (0.0, 0.0175):
        run_case(Case3(0.0, 0, "slicing"), replace(SHORT, marker_noise=0.0, marker_offset=offset))
    on_axis, beside = (markers.positions for markers in kept)
    # The pipe hangs straight down from 0.35 m above the camera's axis, 1 m away.
    heights = 0.35 - np.arange(8) * 0.077
    assert np.allclose(on_axis[0], np.stack([np.zeros(8), heights, np.ones(8)], axis=1), atol=1e-6)
    assert np.allclose(np.abs(beside - on_axis)[0], [0.0175, 0, 0], atol=1e-6)
    assert np.diff(kept[0].times) == pytest.approx(1 / 120)


def estimate_of(curve: FloatArray) -> Estimate:
    return Estimate(0, Status.OK, nodes=curve, waypoints=make_waypoints(curve, 0.01))


def test_a_perfect_track_has_no_error() -> None:
    turn = np.linspace(0, 0.7, 141)
    curve = np.stack([np.sin(turn), 1 - np.cos(turn), 1 + 0.1 * turn], axis=1)
    markers = curve[::-1][::15][:8]
    found = errors(estimate_of(curve), markers)
    assert found["linear"] < 2e-4
    assert found["to_markers"] < 1e-4
    assert found["symmetric"] < 2e-4
    assert found["coverage"] == 1.0
    assert errors(estimate_of(curve[::-1].copy()), markers)["linear"] == pytest.approx(found["linear"], abs=1e-6)


def test_errors_of_tracks_that_are_wrong() -> None:
    markers = np.stack([np.zeros(8), -0.077 * np.arange(8), np.ones(8)], axis=1)
    whole = np.array([[0.005, 0.1, 1.0], [0.005, -0.7, 1.0]])
    # What goes on beyond the markers does not count.
    assert errors(estimate_of(whole), markers)["linear"] == pytest.approx(0.005)
    half = np.array([[0.0, 0.0, 1.0], [0.0, -0.077 * 3.5, 1.0]])
    found = errors(estimate_of(half), markers)
    # A half is perfect to the paper's error, and to no other.
    assert found["linear"] == pytest.approx(0.0, abs=1e-9)
    assert found["symmetric"] > 0.02
    assert found["coverage"] == pytest.approx(0.5, abs=0.03)
    lost = errors(Estimate(0, Status.LOST, waypoints=Waypoints.none()), markers)
    assert math.isnan(lost["linear"])
    assert lost["coverage"] == 0


def test_a_short_case_is_right_and_repeats() -> None:
    case = Case3(0.025, 1, "slicing")
    settings = replace(SHORT, duration=2.5)
    first, again = run_case(case, settings), run_case(case, settings)
    for item in fields(Tracked):
        assert np.array_equal(getattr(first, item.name), getattr(again, item.name)), item.name
    assert len(first.time) == pytest.approx(2.2 * 30, abs=1)
    assert first.linear.mean() < 0.002
    assert first.symmetric.mean() < 0.002
    assert first.speed.max() > 0.5
    assert abs(first.clock_error) < 0.001


def test_an_offset_that_nobody_is_told_of_is_an_error() -> None:
    case = Case3(0.0, 0, "slicing")
    result = run_case(case, replace(SHORT, duration=0.6, marker_offset=0.0175))
    assert result.linear.mean() == pytest.approx(0.0175, abs=0.002)
    assert math.isnan(result.clock_error)


def test_every_method_sees_the_same_drop() -> None:
    ours, theirs = (run_case(Case3(0.005, 0, method), replace(SHORT, duration=0.8)) for method in ("slicing", TUNED))
    assert np.array_equal(ours.time, theirs.time)
    assert np.array_equal(ours.clock_error, theirs.clock_error, equal_nan=True)
    assert np.nanmean(theirs.linear) < 0.01
    with pytest.raises(ConfigError, match="slicing"):
        run_case(Case3(0.0, 0, "guessing"), SHORT)


def test_the_cases_are_the_papers() -> None:
    cases = choose_cases(["slicing", "schulman"])
    assert len(cases) == 60
    assert [round(height * 1e3) for height in HEIGHTS] == [0, 5, 10, 15, 20, 25, 30, 35, 40, 45]
    assert len({case.name for case in cases}) == 60
    assert cases[4].name == "slicing_5mm_2"
    assert choose_cases(["slicing", "schulman", "slicing"]) == cases
    for methods, said in (([], "no method"), (["slicing", "guessing"], "unknown method 'guessing': choose of")):
        with pytest.raises(ConfigError, match=said):
            choose_cases(methods)


def test_a_run_goes_on_where_it_stopped_and_takes_further_methods(tmp_path: Path) -> None:
    settings = replace(SHORT, duration=0.5)
    folder = CASE3.folder(tmp_path / "case3")
    first = choose_cases(["slicing"], (0.0, 0.005), 1)
    assert CASE3.begin(folder, settings) == {}
    run_cases(CASE3, folder, first, settings, {}, jobs=1)
    kept = [folder.run_path(case).stat().st_mtime_ns for case in first]
    assert CASE3.begin(folder, settings) == {}
    both = choose_cases(["slicing", TUNED], (0.0, 0.005), 1)
    assert folder.finished(both) == first
    counts: list[int] = []
    run_cases(CASE3, folder, both, settings, {}, jobs=1, on_progress=counts.append)
    assert sum(counts) == 2
    assert [folder.run_path(case).stat().st_mtime_ns for case in first] == kept
    loaded, again = folder.load(first[1]), run_case(first[1], settings)
    for item in fields(Tracked):
        assert np.array_equal(getattr(loaded, item.name), getattr(again, item.name), equal_nan=item.name != "status")
    with pytest.raises(ConfigError, match='noise: "stereo", now "none"'):
        CASE3.begin(folder, replace(settings, noise="none"))
    assert "compute_time" not in (tmp_path / "case3" / "settings.toml").read_text()


def example_results() -> dict[Case3, Tracked]:
    values = np.array([0.001, 0.003, math.nan])
    found = np.isfinite(values)
    tracked = Tracked(
        np.arange(3) / 30,
        np.where(found, "ok", "lost"),
        values,
        values,
        values,
        found.astype(float),
        np.full(3, 0.5),
        np.array(1e-5),
    )
    return dict.fromkeys(choose_cases(["slicing", "schulman"], (0.0, 0.005), 2), tracked)


def test_the_report_counts_what_is_missing(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    results = example_results()
    text = report_text(results, Case3Settings())
    # (1 + 3 + 700) / 3 mm.
    assert "234.667" in text
    assert "30.3" in text
    assert "33.0" in text
    rows = list(csv.DictReader(io.StringIO(csv_text(results))))
    assert len(rows) == 8 * 3
    assert [row["linear_m"] for row in rows[:3]] == ["0.001", "0.003", ""]
    paths = write_report(tmp_path, results, Case3Settings())
    before = [path.read_bytes() for path in paths]
    assert [path.read_bytes() for path in write_report(tmp_path, results, Case3Settings())] == before


@needs_data
def test_real_motion_is_judged_alike() -> None:
    file = DATA / "deform_mocap" / "DLO1_clean.npz"
    result = run_motion_capture(file, 0, "slicing", replace(SHORT, skip=1.0), every=20)
    assert np.nanmean(result.linear) < 0.004
    assert np.isnan(result.clock_error)
    with pytest.raises(RecordingError):
        run_motion_capture(file, 100_000, "slicing", SHORT)
    with pytest.raises(RecordingError):
        run_motion_capture(Path("none.npz"), 0, "slicing", SHORT)


def test_methods_are_found_by_their_names() -> None:
    config = RopeConfig(0.025)
    assert type(case_tracker("slicing", config)).__name__ == "SlicingTracker"
    assert type(case_tracker(TUNED, config)).__name__ == "SchulmanTracker"
    for method in CASE_METHODS:
        case_tracker(method, config)
