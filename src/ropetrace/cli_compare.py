"""The command that compares trackers: words for people, no logic."""

from __future__ import annotations

import dataclasses
import difflib
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from ropetrace.cli_source import Part, Rope
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
    rope: OmitArgPrefixes[Rope] = field(default_factory=Rope)
    """Of a recording."""
    part: OmitArgPrefixes[Part] = field(default_factory=Part)
    """Which part of a recording; of the suite, how many frames of each case to use at most."""
    jobs: Annotated[int | None, arg(aliases=["-j"], metavar="N")] = None
    """Runs at a time; by default as many as there are cores."""
    overwrite: bool = False
    """Begin anew, in the place of the runs that are finished."""

    def run(self) -> int:
        from ropetrace.evaluation.compare_report import write_report
        from ropetrace.evaluation.compare_runs import comparison_folder, run_tasks, settings_of
        from ropetrace.suite import SUITE_VERSION

        self.part.check()
        jobs = self._jobs()
        methods = self._methods()
        if self.source == "suite":
            _refuse(self.rope, "the suite")
            _refuse(dataclasses.replace(self.part, limit=None), "the suite")
            import_extra("mujoco", "sim")
            tasks = self._suite_tasks(methods)
            settings = settings_of(SUITE_VERSION, None, None, limit=self.part.limit, timing=self.timing)
            title = f"ropetrace compare: suite {SUITE_VERSION}"
        else:
            if self.cases:
                raise ConfigError("--cases means nothing for a recording: leave it out")
            case, config = self._recording()
            tasks = [_task(case, config, method) for method in methods]
            settings = settings_of(None, config, case, limit=self.part.limit, timing=self.timing)
            title = f"ropetrace compare: {case.name}"
        folder = comparison_folder(self.out)
        folder.begin(settings, overwrite=self.overwrite)
        try:
            with progress_bar(len(tasks), "run") as bar:
                bar.update(len(folder.finished(tasks)))
                run_tasks(folder, tasks, jobs, self.part.limit, bar.update)
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
        from ropetrace.evaluation.compare_runs import RecordedCase

        config, part, path = self.rope.settings(), self.part, Path(self.source)
        part.open(path)
        case = RecordedCase(
            path,
            config.diameter,
            config.color,
            part.start,
            part.rate,
            part.depth_topic,
            part.color_topic,
            part.cloud_topic,
        )
        return case, config


def _refuse(options: Rope | Part, what: str) -> None:
    """Options that mean nothing for what is compared."""
    for item in dataclasses.fields(options):
        if getattr(options, item.name) != item.default:
            raise ConfigError(f"--{item.name.replace('_', '-')} means nothing for {what}: leave it out")


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
