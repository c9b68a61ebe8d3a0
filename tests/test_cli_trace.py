"""`ropetrace trace`, end to end."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mujoco")
pytest.importorskip("pinocchio")

from ropetrace import cli_trace, terminal
from ropetrace.cli_trace import Trace
from ropetrace.errors import ConfigError, OutputError
from ropetrace.terminal import INTERRUPTED
from ropetrace.trackers import SlicingTracker
from ropetrace.types import Estimate


def test_a_rope_at_rest_is_traced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "trace.rrd"
    assert Trace(wind=0.0, view=False, out=out).run() == 0
    lines = capsys.readouterr().out.splitlines()
    outcome = next(line for line in lines if line.startswith("outcome"))
    assert "done" in outcome
    table = next(line for line in lines if line.startswith("all "))
    count, mean = table.split()[1:3]
    assert int(count) > 20
    assert float(mean) < 0.5, "millimetres"
    assert out.stat().st_size > 100_000


def test_without_a_screen_it_goes_on(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    assert Trace(wind=0.0).run() == 0
    assert "there is no screen" in capsys.readouterr().out


def test_a_tracing_that_fails_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    # With so much latency no trajectory is ever fresh enough to be followed.
    assert Trace(wind=0.0, view=False, latency="300ms").run() == 1
    assert "the tracing ended early" in capsys.readouterr().err


def test_ctrl_c_waits_for_the_frame_that_is_worked_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    told: list[int] = []
    monkeypatch.setattr(terminal, "INTERRUPTS", told)
    monkeypatch.setattr(cli_trace, "INTERRUPTS", told)
    tracked = []

    class Tracker(SlicingTracker):
        def update(self, *given: Any) -> Estimate:
            signal.raise_signal(signal.SIGINT)
            estimate = super().update(*given)
            tracked.append(estimate)
            return estimate

    monkeypatch.setattr("ropetrace.evaluation.case2.make_tracker", Tracker)
    assert Trace(wind=0.0, view=False).run() == INTERRUPTED
    assert len(tracked) == 1
    assert capsys.readouterr().err == "ropetrace: interrupted\n"


def test_the_view_is_an_rrd_file(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"\.rrd"):
        Trace(view=False, out=tmp_path / "trace.mcap").run()
    (tmp_path / "trace.rrd").write_text("mine")
    with pytest.raises(OutputError, match="exists already"):
        Trace(view=False, out=tmp_path / "trace.rrd").run()


def test_a_wind_that_cannot_be(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="frequency"):
        Trace(wind=-1.0, view=False).run()


def test_the_command_is_known() -> None:
    result = subprocess.run(
        [sys.executable, "-m", "ropetrace", "trace", "--wind", "99", "--no-view"],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert result.returncode == 2
    assert "99" in result.stderr
    assert "Traceback" not in result.stderr
