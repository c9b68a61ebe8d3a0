"""Comparisons: figures of trackers whose error is known, failures that stop nobody else, a page that stands alone."""

from __future__ import annotations

import csv
import math
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers import DATA, needs_data
from ropetrace.cli_compare import Compare
from ropetrace.cli_source import Part, Rope
from ropetrace.config import RopeConfig
from ropetrace.errors import ConfigError, FrameError, OutputError, RopetraceError
from ropetrace.evaluation import compare, workers
from ropetrace.evaluation.compare import Figures, disagreements, run_method, telling_frames
from ropetrace.evaluation.compare_report import write_report
from ropetrace.evaluation.compare_runs import Task, comparison_folder, run_tasks
from ropetrace.evaluation.compare_tables import CSV_COLUMNS
from ropetrace.suite import Truth
from ropetrace.types import BadFrame, Estimate, Event, FloatArray, Intrinsics, RgbdFrame, Status, Waypoints

CAMERA = Intrinsics(64, 48, 60.0, 60.0, 31.5, 23.5)
FRAMES = 12
LENGTH = 0.6


def true_line(index: int) -> FloatArray:
    return np.array([[-0.3, 0.01 * index, 1.0], [0.0, 0.01 * index, 1.0], [0.3, 0.01 * index, 1.0]])


@dataclass(frozen=True)
class FakeCase:
    """A straight rope that sinks by 1 cm a frame; `known` tells its truth."""

    name: str = "fake"
    description: str = "A rope <that> sinks"
    diameter: float = 0.01
    color: str | None = None
    known: bool = True

    def frames(self, limit: int | None = None) -> Iterator[tuple[Event, Truth | None]]:
        for index in range(min(limit or FRAMES, FRAMES)):
            stamp = index * 33_000_000
            truth = Truth(true_line(index), 1.0) if self.known else None
            if index == 5 and self.name == "damaged":
                yield BadFrame(stamp, "torn"), truth
            else:
                yield RgbdFrame(stamp, np.full((48, 64), 1500, np.uint16), 0.001, CAMERA), truth


class FakeTracker:
    """Does what the method's name says."""

    def __init__(self, method: str) -> None:
        self.method = method
        self.count = 0

    def update(self, frame: Event) -> Estimate:
        index, self.count = self.count, self.count + 1
        if isinstance(frame, BadFrame):
            return Estimate.lost(frame.stamp_ns, frame.reason)
        line = true_line(index)
        if self.method == "lost":
            return Estimate.lost(frame.stamp_ns, "nothing seen")
        if self.method == "crashing" and index == 4:
            raise ZeroDivisionError("a <bad>\nthing")
        if self.method == "dying" and index == 4:
            os.kill(os.getpid(), signal.SIGKILL)
        if self.method == "hanging" and index == 4:
            time.sleep(600)
        if self.method == "unfit":
            raise FrameError("no colour")
        if self.method == "flipping" and index in (6, 7):
            line = line[::-1]
        if self.method == "half":
            line = line[:2]
        if self.method == "nan" and index == 3:
            line = np.full_like(line, math.nan)
        line = line + {"off": [0.0, 0.02, 0.0]}.get(self.method, [0.0, 0.0, 0.0])
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
        return Estimate(
            frame.stamp_ns, Status.OK, waypoints=Waypoints(line, np.tile([0.0, 0, 0, 1], (len(line), 1)), arc)
        )


@pytest.fixture
def forked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers that have the fakes."""
    monkeypatch.setattr(workers, "_CONTEXT", multiprocessing.get_context("fork"))


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch) -> None:
    def make(config: RopeConfig) -> FakeTracker:
        if config.method == "absent":
            raise ImportError("no such thing")
        return FakeTracker(config.method)

    monkeypatch.setattr(compare, "make_tracker", make)


def task(method: str, **case: Any) -> Task:
    return Task(FakeCase(**case), RopeConfig(0.01, method=method))


def figures(method: str, **case: Any) -> Figures:
    one = task(method, **case)
    return Figures.of(run_method(one.case, one.config), 0.005)


@pytest.mark.usefixtures("fakes")
def test_a_perfect_tracker_has_no_error() -> None:
    one = figures("perfect")
    assert one.symmetric is not None
    assert one.node is not None
    assert one.tip_end is not None
    assert one.symmetric.worst < 1e-9
    assert one.node.worst < 1e-9
    assert one.tip_end.worst < 1e-9
    assert (one.covered, one.swaps, one.lost, one.degraded, one.false_ok) == (1.0, 0, 0, 0, 0.0)
    assert one.length_error < 1e-9
    assert one.length_median == pytest.approx(LENGTH)
    assert one.frames == FRAMES
    assert 0 <= one.p50_ms <= one.p99_ms


@pytest.mark.usefixtures("fakes")
@pytest.mark.parametrize("method", ["lost", "unfit", "absent"])
def test_a_tracker_that_finds_nothing_gets_the_penalty(method: str) -> None:
    one = figures(method)
    for statistics in (one.symmetric, one.node, one.tip_start, one.tip_end):
        assert statistics is not None
        assert [statistics.mean, statistics.worst] == pytest.approx([LENGTH, LENGTH])
        assert statistics.missing == FRAMES
    assert (one.covered, one.lost, one.length_error, one.false_ok) == (0.0, FRAMES, 1.0, 0.0)
    assert one.failure == ("ImportError: no such thing" if method == "absent" else "")


@pytest.mark.usefixtures("fakes")
def test_errors_are_what_they_are() -> None:
    off, half, flipping = figures("off"), figures("half"), figures("flipping")
    assert off.symmetric is not None
    assert off.symmetric.mean == pytest.approx(0.02)
    assert off.covered == 0.0
    assert off.false_ok == 1.0
    assert half.length_error == pytest.approx(0.5)
    assert half.covered == pytest.approx(0.52, abs=0.01)
    assert half.tip_end is not None
    assert half.tip_end.mean == pytest.approx(0.3)
    assert flipping.swaps == 2
    assert flipping.node is not None
    assert flipping.node.worst == pytest.approx(0.3, rel=0.02)
    assert flipping.symmetric is not None
    assert flipping.symmetric.worst < 1e-9
    assert flipping.false_ok == pytest.approx(2 / FRAMES)


@pytest.mark.usefixtures("fakes")
def test_a_failure_ends_a_run_and_its_frames_count() -> None:
    one = figures("crashing")
    assert one.failure == "ZeroDivisionError: a <bad> thing"
    assert one.lost == FRAMES - 4
    assert one.symmetric is not None
    assert one.symmetric.mean == pytest.approx(LENGTH * (FRAMES - 4) / FRAMES)
    assert figures("nan").failure == "ValueError: a waypoint is not finite"
    assert figures("perfect", name="damaged").lost == 1


@pytest.mark.usefixtures("fakes")
def test_distances_between_methods_choose_the_frames() -> None:
    runs = [run_method(FakeCase(), RopeConfig(0.01, method=method)) for method in ("perfect", "off", "nan")]
    np.testing.assert_allclose(disagreements(runs[0], runs[1]), 0.02, rtol=1e-5)
    assert np.isnan(disagreements(runs[0], runs[2])).sum() == FRAMES - 3
    chosen = telling_frames(runs)
    assert chosen == sorted(chosen)
    assert len(chosen) == 3
    assert len(telling_frames(runs[:1])) == 3


def rows_of(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


class Outside(HTMLParser):
    """What a page asks for, and whether its tags are closed."""

    def __init__(self) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag not in ("script", "link", "iframe", "object")
        self.sources += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "xlink:href")]
        self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def check_page(text: str) -> None:
    """It parses as XML too, and nothing in it leads out."""
    page = Outside()
    page.feed(text)
    assert page.open == []
    assert all(source.startswith(("data:image/png;base64,", "#")) for source in page.sources)
    assert not re.search(r"https?://|url\(|@import", text)
    ET.fromstring(text.removeprefix("<!DOCTYPE html>"))


@pytest.mark.usefixtures("fakes", "forked")
def test_a_report_names_the_failure_and_goes_on(tmp_path: Path) -> None:
    folder = comparison_folder(tmp_path / "out")
    folder.begin({"suite": "1"})
    tasks = [
        task(method, name=name, known=name != "unknown")
        for name in ("fake", "unknown", "damaged")
        for method in ("crashing", "perfect", "lost")
    ]
    finished: list[int] = []
    run_tasks(folder, tasks[:4], 1, on_progress=finished.append)
    assert folder.finished(tasks) == tasks[:4]
    before = {path: path.stat().st_mtime_ns for path in (folder.path / "runs").iterdir()}
    run_tasks(folder, tasks, 1, on_progress=finished.append)
    assert sum(finished) == len(tasks)
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in before.items())
    (frames, tables, html), summary = write_report(folder, tasks, "A <title>", False)
    text = tables.read_text()
    assert "crashing failed on fake, frame 4: ZeroDivisionError: a <bad> thing" in text
    assert "crashing failed on fake" in summary
    assert re.search(r"\| +fake \| +400\* \| +\S+ \| +600 \|", text)
    assert "approximate" in text
    rows = rows_of(frames)
    assert len(rows) == 9 * FRAMES
    assert list(rows[0]) == ["case", "method", "frame", *CSV_COLUMNS]
    assert [row["status"] for row in rows[:6]] == ["ok"] * 4 + ["", ""]
    assert rows[0]["symmetric_m"] != "" == rows[5]["symmetric_m"]
    page = html.read_text()
    check_page(page)
    assert page.count("<img") in (8, 9)  # the damaged frame has no picture
    assert "A &lt;title&gt;" in page
    assert write_report(folder, tasks, "A <title>", False)[1] == summary
    assert html.read_text() == page


@pytest.mark.usefixtures("fakes", "forked")
@pytest.mark.parametrize("jobs", [1, 2])
def test_a_method_that_dies_or_hangs_stops_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jobs: int) -> None:
    monkeypatch.setattr(workers, "LONGEST_SILENCE", 10.0)
    folder = comparison_folder(tmp_path / "out")
    folder.begin({"suite": "1"})
    tasks = [task(method) for method in ("dying", "perfect", "hanging", "off")]
    run_tasks(folder, tasks, jobs)
    runs = {task.config.method: folder.load(task) for task in tasks}
    assert str(runs["dying"].failure) == "its process was killed (SIGKILL)"
    assert str(runs["hanging"].failure) == "it hung: no frame was finished for 10 s"
    for method, run in runs.items():
        assert len(run) == FRAMES
        assert run.has_truth
        assert Figures.of(run, 0.005).lost == (FRAMES if method in ("dying", "hanging") else 0)
    assert not multiprocessing.active_children()


@dataclass(frozen=True)
class Unreadable(FakeCase):
    """Its frames cannot be read: what is raised, or else the process dies."""

    error: Exception | None = None

    def frames(self, limit: int | None = None) -> Iterator[tuple[Event, Truth | None]]:
        yield from super().frames(3)
        if self.error is None:
            os.kill(os.getpid(), signal.SIGKILL)
        else:
            raise self.error


@pytest.mark.usefixtures("fakes", "forked")
@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OutputError("the truth is gone"), "^the truth is gone$"),
        (ZeroDivisionError("no"), r"a run failed \(ZeroDivisionError: no\)"),
        (None, r"fake: its frames cannot be read: its process was killed \(SIGKILL\)"),
    ],
)
def test_a_case_that_cannot_be_read_is_an_error(tmp_path: Path, error: Exception | None, said: str) -> None:
    folder = comparison_folder(tmp_path / "out")
    folder.begin({"suite": "1"})
    with pytest.raises(RopetraceError, match=said):
        run_tasks(folder, [task("off"), Task(Unreadable(error=error), RopeConfig(0.01, method="perfect"))], 1)
    assert folder.finished([task("off")]) == [task("off")]
    assert not multiprocessing.active_children()


def test_a_folder_of_another_comparison_is_kept(tmp_path: Path) -> None:
    folder = comparison_folder(tmp_path / "out")
    settings = {
        "suite": None,
        "timing": False,
        "recording": 'a\n"ü',
        "config": {"diameter": 0.01, "cpd": {"nodes": 30}},
    }
    folder.begin(settings)
    folder.begin(settings)
    with pytest.raises(ConfigError, match=r"timing: false, now true.*--overwrite"):
        folder.begin({**settings, "timing": True})
    with pytest.raises(ConfigError, match=r"config\.cpd\.nodes: 30, now not set"):
        folder.begin({**settings, "config": {"diameter": 0.01}})
    folder.run_path(task("slicing")).write_bytes(b"no archive")
    with pytest.raises(OutputError, match="delete it"):
        folder.load(task("slicing"))
    folder.begin({"suite": "2"}, overwrite=True)
    assert not folder.run_path(task("slicing")).exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").touch()
    with pytest.raises(OutputError, match="holds other things"):
        comparison_folder(tmp_path / "mine").begin({})
    (tmp_path / "file").touch()
    for place in ("file", "file/inside"):
        with pytest.raises(OutputError, match="file"):
            comparison_folder(tmp_path / place).begin({})


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"methods": ("slicng",)}, "did you mean slicing"),
        ({"methods": ("slicing,gpltp",)}, "unknown method 'gpltp'.*did you mean gltp"),
        ({"cases": ("still", "hairpn")}, "did you mean hairpin"),
        ({"rope": Rope("12mm")}, "--diameter means nothing for the suite"),
        ({"part": Part(start=3)}, "--start means nothing for the suite"),
        ({"part": Part(limit=0)}, "--limit 0"),
        ({"jobs": 0}, "--jobs 0"),
        ({"jobs": 2, "timing": True}, "one run at a time"),
        ({"source": "nowhere.mcap"}, "diameter is missing"),
        ({"source": "nowhere.mcap", "rope": Rope("12mm")}, "nowhere.mcap"),
        ({"source": "nowhere.mcap", "cases": ("still",)}, "--cases means nothing for a recording"),
    ],
)
def test_what_cannot_be_is_refused(given: dict[str, Any], said: str, tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    out = tmp_path / "out"
    with pytest.raises(RopetraceError, match=said):
        Compare(**{"source": "suite", "out": out, **given}).run()
    assert not out.exists()


def test_from_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("mujoco")
    out = tmp_path / "out"
    command = Compare("suite", ("slicing",), ("still",), out, part=Part(limit=10))
    assert command.run() == 0
    said = capsys.readouterr().out
    assert "slicing" in said
    assert str(out / "compare.html") in said
    rows = rows_of(out / "compare.csv")
    assert len(rows) == 10
    assert all(float(row["symmetric_m"]) < 0.001 for row in rows)
    check_page((out / "compare.html").read_text())
    assert command.run() == 0  # from the runs that are kept
    with pytest.raises(ConfigError, match="limit: 10, now 5"):
        Compare("suite", ("slicing",), ("still",), out, part=Part(limit=5)).run()


def test_an_interrupted_comparison_goes_on(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    out = tmp_path / "out"
    command = [sys.executable, "-m", "ropetrace", "compare", "suite", "-m", "slicing", "-j", "1", "-o", str(out)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        end = time.monotonic() + 300
        while not list(out.glob("runs/*.npz")) and time.monotonic() < end:
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=300)
    assert process.returncode == 130
    assert re.search(r"interrupted; [1-9]\d* of \d+ runs are finished", said)
    assert list(out.glob("runs/still.slicing.npz"))
    assert not (out / "compare.html").exists()


@needs_data
def test_a_recording_without_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = DATA / "bcpd_rope_d435"
    options: dict[str, Any] = {
        "rope": Rope("6mm"),
        "part": Part(rate=5.0, limit=3),
        "jobs": 1,
        "out": tmp_path / "out",
    }
    assert Compare(str(recording), ("slicing,cpd",), **options).run() == 0
    said = capsys.readouterr().out
    assert "length m" in said
    assert "symmetric" not in said
    text = (tmp_path / "out" / "compare.md").read_text()
    assert "Distance between the methods" in text
    check_page((tmp_path / "out" / "compare.html").read_text())


def test_a_simulated_recording_has_its_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("mujoco")
    from ropetrace.cli_simulation import Simulate

    recording = tmp_path / "swing.mcap"
    assert Simulate("swing", recording, seconds=0.3).run() == 0
    options: dict[str, Any] = {"rope": Rope("15mm", "#c8281e"), "jobs": 1, "out": tmp_path / "out"}
    assert Compare(str(recording), ("slicing",), part=Part(start=2), **options).run() == 0
    assert "symmetric mm" in capsys.readouterr().out
    assert len(rows_of(tmp_path / "out" / "compare.csv")) == 7
    with pytest.raises(ConfigError, match="no frames to compare on"):
        Compare(str(recording), ("slicing",), part=Part(start=99), overwrite=True, **options).run()
