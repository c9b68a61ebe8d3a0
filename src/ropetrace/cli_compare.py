"""The command that compares trackers: words for people, no logic."""

from __future__ import annotations

import dataclasses
import difflib
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from ropetrace.errors import ConfigError, RopetraceError, import_extra
from ropetrace.terminal import INTERRUPTED, progress_bar

if TYPE_CHECKING:
    from ropetrace.config import RopeConfig
    from ropetrace.evaluation.compare_runs import RecordedCase, Task
    from ropetrace.suite import Case


@dataclass(frozen=True)
class Compare:
    """Run several trackers on the same frames, and write tables and a page that sets them side by side.

    Finished runs are kept: the same command goes on where it was interrupted, and further methods join the rest.

    ropetrace compare suite --methods slicing,cpd

    ropetrace compare RECORDING --diameter 12mm --color '#c8281e'
    """

    source: Annotated[Positional[str], arg(metavar="suite|RECORDING")]
    """suite: the benchmark that ships with ropetrace. Or a recording: see `ropetrace track`."""
    methods: Annotated[tuple[str, ...], arg(aliases=["-m"], metavar="NAME,...")] = ()
    """The trackers; by default all."""
    cases: Annotated[tuple[str, ...], arg(metavar="NAME,...")] = ()
    """Of the suite; by default all, with the recordings of $ROPETRACE_DATA."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="FOLDER")] = Path("compare")
    """The folder for compare.html, compare.md, compare.csv and the finished runs."""
    timing: bool = False
    """Run one thing at a time, on one thread, so that the times can be compared."""
    diameter: Annotated[str | None, arg(aliases=["-d"], metavar="LENGTH")] = None
    """Recording: the rope's diameter, such as 12mm. Needed here or in the config."""
    color: Annotated[str | None, arg(aliases=["-c"], metavar="'#RRGGBB'")] = None
    """Recording: the rope's colour in full light, such as '#c8281e'."""
    config: Annotated[Path | None, arg(metavar="FILE")] = None
    """Recording: a TOML file with further settings; those given here count first."""
    rate: Annotated[float | None, arg(metavar="HZ")] = None
    """Recording: frames per second, where it has no stamps."""
    start: Annotated[int, arg(metavar="N")] = 0
    """Recording: frames to skip."""
    limit: Annotated[int | None, arg(metavar="N")] = None
    """Frames of the recording, or of each case, to use at most."""
    depth_topic: Annotated[str | None, arg(metavar="TOPIC")] = None
    """ROS recording: the depth images. Found by type if not given."""
    color_topic: Annotated[str | None, arg(metavar="TOPIC")] = None
    """ROS recording: the colour images. Found by type if not given."""
    cloud_topic: Annotated[str | None, arg(metavar="TOPIC")] = None
    """ROS recording: point clouds, in the place of depth images."""
    jobs: Annotated[int | None, arg(aliases=["-j"], metavar="N")] = None
    """Runs at a time; by default as many as there are cores."""
    overwrite: bool = False
    """Begin anew, in the place of the runs that are finished."""

    def run(self) -> int:
        from ropetrace.evaluation.compare_report import write_report
        from ropetrace.evaluation.compare_runs import RunFolder, run_tasks, settings_of, worker_pool
        from ropetrace.suite import SUITE_VERSION

        if self.limit is not None and self.limit < 1:
            raise ConfigError(f"--limit {self.limit}: expected 1 or more")
        jobs = self._jobs()
        methods = self._methods()
        if self.source == "suite":
            self._refuse("diameter", "color", "config", "rate", "start", "depth_topic", "color_topic", "cloud_topic")
            import_extra("mujoco", "sim")
            tasks = self._suite_tasks(methods)
            settings = settings_of(SUITE_VERSION, None, None, limit=self.limit, timing=self.timing)
            title = f"ropetrace compare: suite {SUITE_VERSION}"
        else:
            self._refuse("cases")
            case, config = self._recording()
            tasks = [_task(case, config, method) for method in methods]
            settings = settings_of(None, config, case, limit=self.limit, timing=self.timing)
            title = f"ropetrace compare: {case.name}"
        folder = RunFolder(self.out)
        folder.begin(settings, self.overwrite)
        finished = len(folder.finished(tasks))
        try:
            with progress_bar(len(tasks), "run") as bar:
                bar.update(finished)
                if finished < len(tasks):
                    with worker_pool(min(jobs, len(tasks) - finished)) as pool:
                        run_tasks(folder, tasks, pool, self.limit, bar.update)
            paths, summary = write_report(folder, tasks, title, self.timing)
        except KeyboardInterrupt:
            done = f"{len(folder.finished(tasks))} of {len(tasks)} runs"
            print(f"ropetrace: interrupted; {done} are finished and kept in {self.out}", file=sys.stderr)
            return INTERRUPTED
        print(summary)
        print()
        for name, path in zip(("frames", "tables", "page"), paths, strict=True):
            print(f"{name:7} {path}")
        return 0

    def _methods(self) -> list[str]:
        from ropetrace.trackers import METHODS

        chosen = _names("method", self.methods, tuple(METHODS)) or list(METHODS)
        return [method for method in METHODS if method in chosen]

    def _jobs(self) -> int:
        if self.jobs is not None and self.jobs < 1:
            raise ConfigError(f"--jobs {self.jobs}: expected 1 or more")
        if self.timing and self.jobs not in (None, 1):
            raise ConfigError(f"--jobs {self.jobs} with --timing: times are measured one run at a time")
        return 1 if self.timing else self.jobs or len(os.sched_getaffinity(0))

    def _suite_tasks(self, methods: list[str]) -> list[Task]:
        from ropetrace import suite
        from ropetrace.config import RopeConfig

        names = _names("case", self.cases, suite.cases()) or list(suite.cases())
        cases = [suite.open_case(name) for name in suite.cases() if name in names]
        return [_task(case, RopeConfig(case.diameter, case.color), method) for case in cases for method in methods]

    def _recording(self) -> tuple[RecordedCase, RopeConfig]:
        from ropetrace.cli import Rope, Source
        from ropetrace.evaluation.compare_runs import RecordedCase

        config = Rope(self.diameter, self.color, self.config).settings()
        source = Source(
            Path(self.source), self.rate, self.start, self.limit, self.depth_topic, self.color_topic, self.cloud_topic
        )
        source.open()
        case = RecordedCase(
            source.recording,
            config.diameter,
            config.color,
            source.start,
            source.rate,
            source.depth_topic,
            source.color_topic,
            source.cloud_topic,
        )
        return case, config

    def _refuse(self, *options: str) -> None:
        """Those that mean nothing here."""
        for name in options:
            if getattr(self, name) not in (None, (), 0):
                what = "the suite" if self.source == "suite" else "a recording"
                raise ConfigError(f"--{name.replace('_', '-')} means nothing for {what}: leave it out")


def _task(case: Case, config: RopeConfig, method: str) -> Task:
    """Checked as far as that can be done before it runs."""
    from ropetrace.evaluation.compare_runs import Task
    from ropetrace.trackers import make_tracker

    task = Task(case, dataclasses.replace(config, method=method))
    try:
        make_tracker(task.config)
    except RopetraceError:
        raise
    except Exception:  # the run keeps what went wrong
        pass
    return task


def _names(kind: str, given: tuple[str, ...], known: tuple[str, ...]) -> list[str]:
    """Of methods or cases, given apart or with commas."""
    names = [name for text in given for name in text.split(",") if name]
    for name in names:
        if name not in known:
            close = difflib.get_close_matches(name, known, 1)
            hint = f"; did you mean {close[0]}?" if close else ""
            raise ConfigError(f"unknown {kind} {name!r}: choose of {', '.join(known)}{hint}")
    return names
