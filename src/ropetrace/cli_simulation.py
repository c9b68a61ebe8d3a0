"""The commands that simulate: words for people, no logic."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from ropetrace.errors import ConfigError, import_extra
from ropetrace.terminal import INTERRUPTED, progress_bar

if TYPE_CHECKING:
    from ropetrace.evaluation.experiments import Experiment

QUICK_SECONDS = 10.0
"""Of a case of case1, with --quick."""

QUICK_FREQUENCIES = (0.0, 0.8, 1.6)
"""Of the wind in case2, with --quick, Hz."""

QUICK_HEIGHTS = (0.0, 0.020, 0.045)
"""Of the drops in case3, with --quick, metres."""

QUICK_DROP_SECONDS = 5.0
"""Of a drop in case3, with --quick."""


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


Plan = tuple["Experiment[Any, Any, Any]", Any, Any, list[Any]]
"""An experiment, the module of its report, its settings, and its cases."""


@dataclass(frozen=True)
class Reproduce:
    """Repeat an experiment of the paper in simulation, and set the result beside its figures.

    Finished cases are kept: the same command goes on where it was interrupted.

    ropetrace reproduce case1 --quick
    """

    experiment: Positional[Literal["case1", "case2", "case3"]]
    """case1: the error of a tracker on a rope that sways in a wind (section 6.2, Figures 4 and 5). case2: a simulated
    arm traces that rope (section 6.3, Figure 6). case3: trackers of a pipe that is dropped (section 6.4, Figure 8)."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="PATH")] = None
    """The folder for the results; by default the name of the experiment, and for case1 with another method than slicing
    case1_NAME."""
    quick: bool = False
    """case1: 10 s of simulated time a case in the place of 300 s. case2: one tracing a case, at 0, 0.8 and 1.6 Hz.
    case3: one drop of 5 s from 0, 20 and 45 mm each."""
    method: Annotated[str | None, arg(metavar="NAME")] = None
    """case1 only. The tracker: slicing (by default), any other that `ropetrace track` has, or schulman_tuned, which is
    schulman with parameters tuned for this rope."""
    methods: Annotated[tuple[str, ...] | None, arg(metavar="NAME ...")] = None
    """case3 only. The trackers, named as for --method, with spaces or commas between them; by default slicing and
    schulman. Further ones join a run."""
    conditions: tuple[Literal["30fps", "60fps"], ...] | None = None
    """case1 and case2. 30fps: 480x360 in real time; 60fps: 1280x720 in a tenth of real time. By default both; the
    report shows those chosen."""
    frequencies: Annotated[tuple[float, ...] | None, arg(metavar="HZ ...")] = None
    """case1 and case2. Of the wind, Hz; by default 0 to 1.6 in steps of 0.2."""
    noise: str | None = None
    """Of the depth camera: none, kinect_v1, stereo, kinect_v1_edges, stereo_edges. By default none (as in the paper),
    and stereo in case3, whose camera was a real one."""
    latency: Annotated[str | None, arg(metavar="DURATION")] = None
    """case1 and case2. From a frame's arrival to its centreline, such as 40ms of simulated time; by default measured on
    this machine."""
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
        from ropetrace.evaluation.runner import check_engine, run_cases

        plan = {"case1": self._case1, "case2": self._case2, "case3": self._case3}[self.experiment]
        experiment, report, settings, cases = plan()
        check_engine(self.jobs, self.cluster)
        out = self._folder()
        folder = experiment.folder(out)
        timed = experiment.measure is not None
        conditions = [*dict.fromkeys(case.condition for case in cases)] if timed else []
        try:
            times = experiment.begin(folder, settings, conditions, self.overwrite)
            with _progress(len(cases), "case") as advance:
                advance(len(folder.finished(cases)))
                engine: dict[str, Any] = {"jobs": self.jobs, "cluster": self.cluster}
                run_cases(experiment, folder, cases, settings, times, on_progress=advance, **engine)
        except KeyboardInterrupt:
            done = f"{len(folder.finished(cases))} of {len(cases)} cases"
            print(f"ropetrace: interrupted; {done} are finished and kept in {out}", file=sys.stderr)
            return INTERRUPTED
        results = {case: folder.load(case) for case in cases}
        paths = report.write_report(out, results, settings, *([times] if timed else []))
        print(report.summary_table(results))
        if self.experiment == "case3":
            print(f"\nMean linear error over the drops, mm:\n\n{report.means_table(results)}")
        print()
        for name, path in zip(("readings", "report", "figure"), paths, strict=True):
            print(f"{name:9} {path}")
        return 0

    def _folder(self) -> Path:
        """Where the results go."""
        if self.out is not None:
            return self.out
        return Path(self.experiment if self.method in (None, "slicing") else f"{self.experiment}_{self.method}")

    def _case1(self) -> Plan:
        from ropetrace.evaluation import case1_report
        from ropetrace.evaluation.case1 import Case1Settings
        from ropetrace.evaluation.experiments import CASE1

        self._refuse("placement", "methods")
        settings = Case1Settings(
            duration=QUICK_SECONDS if self.quick else Case1Settings().duration,
            noise=self.noise or "none",
            method=self.method or "slicing",
            predict=self.predict or "none",
            phase=self.phase,
            latency=None if self.latency is None else parse_duration(self.latency),
        )
        return CASE1, case1_report, settings, self._swaying(settings)

    def _case2(self) -> Plan:
        import_extra("pinocchio", "arm")
        from ropetrace.evaluation import case2_report
        from ropetrace.evaluation.case2 import Case2Settings
        from ropetrace.evaluation.experiments import CASE2

        self._refuse("predict", "phase", "method", "methods")
        settings = Case2Settings.at(
            self.placement or "behind",
            tracings=1 if self.quick else Case2Settings().tracings,
            noise=self.noise or "none",
            latency=None if self.latency is None else parse_duration(self.latency),
        )
        return CASE2, case2_report, settings, self._swaying(settings, QUICK_FREQUENCIES if self.quick else None)

    def _swaying(self, settings: Any, frequencies: tuple[float, ...] | None = None) -> list[Any]:
        """The cases of a rope in a wind; the frequencies are those without --frequencies, if not all."""
        from ropetrace.evaluation.case1 import CONDITIONS, FREQUENCIES
        from ropetrace.evaluation.experiments import choose_cases

        conditions = [condition.name for condition in CONDITIONS] if self.conditions is None else self.conditions
        chosen = frequencies or FREQUENCIES if self.frequencies is None else self.frequencies
        return choose_cases(settings, conditions, chosen)

    def _case3(self) -> Plan:
        from ropetrace.evaluation import case3_report
        from ropetrace.evaluation.case3 import HEIGHTS, REPEATS, Case3Settings, choose_cases
        from ropetrace.evaluation.experiments import CASE3

        self._refuse("method", "conditions", "frequencies", "latency", "predict", "phase", "placement")
        settings = Case3Settings(
            duration=QUICK_DROP_SECONDS if self.quick else Case3Settings().duration,
            noise=self.noise or Case3Settings().noise,
        )
        given = ("slicing", "schulman") if self.methods is None else self.methods
        names = [name for text in given for name in text.split(",") if name]
        heights, repeats = (QUICK_HEIGHTS, 1) if self.quick else (HEIGHTS, REPEATS)
        return CASE3, case3_report, settings, choose_cases(names, heights, repeats)

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
