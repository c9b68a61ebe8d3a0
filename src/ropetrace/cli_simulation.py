"""The commands that simulate: words for people, no logic."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from ropetrace.errors import ConfigError, import_extra
from ropetrace.terminal import INTERRUPTED, progress_bar

QUICK_SECONDS = 10.0
"""Of a case of case1, with --quick."""

QUICK_FREQUENCIES = (0.0, 0.8, 1.6)
"""Of the wind in case2, with --quick, Hz."""


@dataclass(frozen=True)
class Simulate:
    """Write the recording of a simulated rope, and the truth beside it.

    ropetrace simulate swing --out swing.mcap
    """

    scenario: Annotated[Positional[str | None], arg(metavar="SCENARIO")] = None
    """The name of a scenario (see --list), or a TOML file."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="PATH")] = None
    """The recording: an .mcap file or a folder, new. The truth goes to OUT.truth.npz, or to truth.npz in the folder."""
    seconds: Annotated[float | None, arg(metavar="S")] = None
    """How long; by default as the scenario says."""
    seed: Annotated[int | None, arg(metavar="N")] = None
    """Of the noise; by default as the scenario says."""
    overwrite: bool = False
    """Replace a recording that exists."""
    list: bool = False
    """Name the scenarios, and do nothing else."""

    def run(self) -> int:
        from ropetrace.sim.scenario import load_scenario, scenario_names

        if self.list:
            width = max(map(len, scenario_names()))
            for name in scenario_names():
                found = load_scenario(name)
                camera = found.camera
                size = f"{camera.width}x{camera.height}, {camera.rate:g} fps, {found.duration:g} s"
                print(f"{name:{width}}  {found.description} ({size})")
            return 0
        if self.scenario is None:
            raise ConfigError("which scenario? `ropetrace simulate --list` names them")
        if self.out is None:
            raise ConfigError(f"where to? such as: ropetrace simulate {self.scenario} --out recording.mcap")
        given: dict[str, Any] = {"duration": self.seconds, "seed": self.seed}
        scenario = replace(load_scenario(self.scenario), **{k: v for k, v in given.items() if v is not None})

        from ropetrace.sim.record import Recorder

        recorder = Recorder(scenario, self.out, self.overwrite)
        try:
            with _progress(scenario.frame_count, "frame") as advance:
                recorder.run(advance)
        except KeyboardInterrupt:
            done = f"{recorder.frames_done} of {scenario.frame_count} frames"
            print(f"ropetrace: interrupted; {done} and their truth are written", file=sys.stderr)
            return INTERRUPTED
        print(f"recording {self.out} ({recorder.frames_done} frames)\ntruth     {recorder.truth_path}")
        diameter = 2e3 * scenario.rope.radius
        print(
            f"track it: ropetrace track {self.out} --diameter {diameter:g}mm --color '{_rope_color()}' --out track.csv"
        )
        return 0


@dataclass(frozen=True)
class Reproduce:
    """Repeat an experiment of the paper in simulation, and set the result beside its figures.

    Finished cases are kept: the same command goes on where it was interrupted.

    ropetrace reproduce case1 --quick
    """

    experiment: Positional[Literal["case1", "case2"]]
    """case1: the error of the tracker on a rope that sways in a wind (section 6.2, Figure 4). case2: a simulated arm
    traces that rope (section 6.3, Figure 6)."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="PATH")] = None
    """The folder for the results; by default the name of the experiment."""
    quick: bool = False
    """case1: 10 s of simulated time a case in the place of 300 s. case2: one tracing a case, at 0, 0.8 and 1.6 Hz."""
    conditions: tuple[Literal["30fps", "60fps"], ...] = ("30fps", "60fps")
    """30fps: 480x360 in real time; 60fps: 1280x720 in a tenth of real time. The report shows those chosen."""
    frequencies: Annotated[tuple[float, ...] | None, arg(metavar="HZ ...")] = None
    """Of the wind, Hz; by default 0 to 1.6 in steps of 0.2."""
    noise: str = "none"
    """Of the depth camera: none (as in the paper), kinect_v1, stereo, kinect_v1_edges, stereo_edges."""
    latency: Annotated[str | None, arg(metavar="DURATION")] = None
    """From a frame's arrival to its centreline, such as 40ms of simulated time; by default measured on this machine."""
    predict: Literal["none", "now"] | None = None
    """case1 only. now: each reading asks for the centreline of its own moment, predicted from what is available then;
    by default none. The arm of case2 always predicts."""
    phase: float | None = None
    """case1 only. When frames come, in frame intervals after a reading, 0 to 1; 0 is the worst. By default every phase
    comes equally often, as from a camera that nobody synchronises."""
    placement: Literal["behind", "beside_camera"] | None = None
    """case2 only. Where the arm stands: behind the rope as seen from the camera (by default), or beside the camera,
    where its hand hides part of the rope."""
    jobs: Annotated[int | None, arg(aliases=["-j"], metavar="N")] = None
    """Cases at a time; by default as many as there are cores."""
    cluster: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """Run the cases on a Dask cluster, such as tcp://host:8786, in the place of this machine."""
    overwrite: bool = False
    """Begin anew, in the place of the cases that are finished."""

    def run(self) -> int:
        import_extra("matplotlib", "sim")  # not after minutes of work
        import_extra("mujoco", "sim")
        from ropetrace.evaluation import case1_report, case2_report
        from ropetrace.evaluation.case1 import FREQUENCIES
        from ropetrace.evaluation.case_files import CaseFolder
        from ropetrace.evaluation.experiments import CASE1, CASE2, Experiment, choose_cases
        from ropetrace.evaluation.runner import check_engine, run_cases

        experiment: Experiment[Any, Any]
        report: Any
        if self.experiment == "case1":
            experiment, report, settings = CASE1, case1_report, self._case1()
        else:
            import_extra("pinocchio", "arm")
            experiment, report, settings = CASE2, case2_report, self._case2()
        few = self.quick and self.experiment == "case2"
        cases = choose_cases(
            settings,
            self.conditions,
            (QUICK_FREQUENCIES if few else FREQUENCIES) if self.frequencies is None else self.frequencies,
        )
        check_engine(self.jobs, self.cluster)
        out = Path(self.experiment) if self.out is None else self.out
        folder: CaseFolder[Any, Any] = CaseFolder(out, experiment)
        try:
            times = folder.begin(settings, [*dict.fromkeys(case.condition for case in cases)], self.overwrite)
            with _progress(len(cases), "case") as advance:
                advance(len(folder.finished(cases)))
                run_cases(folder, cases, settings, times, jobs=self.jobs, cluster=self.cluster, on_progress=advance)
        except KeyboardInterrupt:
            done = f"{len(folder.finished(cases))} of {len(cases)} cases"
            print(f"ropetrace: interrupted; {done} are finished and kept in {out}", file=sys.stderr)
            return INTERRUPTED
        results = {case: folder.load(case) for case in cases}
        paths = report.write_report(out, results, settings, times)
        print(report.summary_table(results))
        print()
        for name, path in zip(("readings", "report", "figure"), paths, strict=True):
            print(f"{name:9} {path}")
        return 0

    def _case1(self) -> Any:
        from ropetrace.evaluation.case1 import Case1Settings

        self._refuse("placement")
        return Case1Settings(
            duration=QUICK_SECONDS if self.quick else Case1Settings().duration,
            noise=self.noise,
            predict=self.predict or "none",
            phase=self.phase,
            latency=None if self.latency is None else parse_duration(self.latency),
        )

    def _case2(self) -> Any:
        from ropetrace.evaluation.case2 import Case2Settings

        self._refuse("predict", "phase")
        return Case2Settings.at(
            self.placement or "behind",
            tracings=1 if self.quick else Case2Settings().tracings,
            noise=self.noise,
            latency=None if self.latency is None else parse_duration(self.latency),
        )

    def _refuse(self, *options: str) -> None:
        """Those that mean nothing for this experiment."""
        for name in options:
            if getattr(self, name) is not None:
                raise ConfigError(f"--{name} means nothing for {self.experiment}: leave it out")


def parse_duration(text: str) -> float:
    """Seconds from a number of seconds or from a text with a unit.

    >>> parse_duration("40ms"), parse_duration("0.04s"), parse_duration("0.04")
    (0.04, 0.04, 0.04)

    Raises
    ------
    ConfigError
        If the text is not a duration.
    """
    match = re.fullmatch(r"\s*([-+0-9.eE]+)\s*(ms|s)?\s*", text)
    try:
        seconds = math.nan if match is None else float(match[1]) / (1000 if match[2] == "ms" else 1)
    except ValueError:
        seconds = math.nan
    if not math.isfinite(seconds):
        raise ConfigError(f"{text!r} is not a duration: write it like 40ms, 0.04s or 0.04 (seconds)")
    return seconds


@contextmanager
def _progress(total: int, unit: str) -> Iterator[Any]:
    """A bar that is told of counts."""
    with progress_bar(total, unit) as bar:

        def advance(count: int = 1) -> None:
            bar.update(count)
            if not count:
                bar.refresh()

        yield advance


def _rope_color() -> str:
    from ropetrace.config import format_color
    from ropetrace.sim.scenario import ROPE_COLOR

    return format_color(ROPE_COLOR)
