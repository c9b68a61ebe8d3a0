"""The experiments that can be repeated, each a set of cases, and which cases are run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, cast

from ropetrace.errors import ConfigError
from ropetrace.evaluation import case3
from ropetrace.evaluation.case1 import (
    CONDITIONS,
    FREQUENCIES,
    Case,
    Case1Settings,
    Condition,
    Readings,
    measure_compute_time,
    run_case,
    scenario,
)
from ropetrace.evaluation.case2 import Case2Settings, Tracing, run_tracing
from ropetrace.evaluation.case3 import Case3, Case3Settings, Tracked
from ropetrace.evaluation.run_folder import Named, Result, RunFolder


class Sized(Named, Protocol):
    """What every case has, whichever the experiment."""

    @property
    def work(self) -> float:
        """More takes longer."""


SomeCase = TypeVar("SomeCase", bound=Sized)
Settings = TypeVar("Settings")

ComputeTimes = dict[str, float]
"""From a frame's arrival to its centreline, simulated seconds, by the condition's name; empty without latency."""


@dataclass(frozen=True, slots=True)
class Experiment(Generic[SomeCase, Settings, Result]):
    """What differs from experiment to experiment.

    Parameters
    ----------
    name : str
        As on the command line.
    result : type
        Of a case: a dataclass of arrays.
    run : callable
        Runs a case, given its settings and the compute times. A function of this module: workers are told its name.
    measure : callable, optional
        The compute time under a condition. None where no latency is simulated.
    """

    name: str
    result: type[Result]
    run: Callable[[SomeCase, Settings, ComputeTimes], Result]
    measure: Callable[[Condition, Settings], float] | None = None

    def folder(self, path: Path) -> RunFolder[SomeCase, Result]:
        """Where its finished cases are kept."""
        return RunFolder(path, self.result, f"reproduce {self.name}", "cases")

    def begin(
        self,
        folder: RunFolder[SomeCase, Result],
        settings: Settings,
        conditions: Sequence[Condition] = (),
        overwrite: bool = False,
    ) -> ComputeTimes:
        """Begin a run, or go on with one of the same settings.

        Parameters
        ----------
        folder : RunFolder
            See `folder`.
        settings : dataclass
            Of the run.
        conditions : sequence of Condition
            Whose compute time is measured, if the experiment simulates latency. What was measured before is used again.
        overwrite : bool
            Begin anew, whatever was run before.

        Returns
        -------
        ComputeTimes
            Also of conditions that were measured before.

        Raises
        ------
        ConfigError, OutputError
            As `RunFolder.begin`.
        """
        table = asdict(cast(Any, settings))
        times = {} if overwrite else folder.settings.measured(table)
        if self.measure is not None:
            for condition in conditions:
                if condition.name not in times:
                    times[condition.name] = self.measure(condition, settings)
        folder.begin(table, times, overwrite)
        return times


def _run_case1(case: Case, settings: Case1Settings, compute_times: ComputeTimes) -> Readings:
    return run_case(case.condition, case.frequency, settings, compute_times[case.condition.name])


def _run_case2(case: Case, settings: Case2Settings, compute_times: ComputeTimes) -> Tracing:
    seconds = compute_times[case.condition.name]
    return run_tracing(case.condition, case.frequency, settings, seconds, case.repeat or 0)


def _measure_case2(condition: Condition, settings: Case2Settings) -> float:
    return measure_compute_time(condition, settings.as_case1())


def _run_case3(case: Case3, settings: Case3Settings, compute_times: ComputeTimes) -> Tracked:
    return case3.run_case(case, settings)


CASE1 = Experiment("case1", Readings, _run_case1, measure_compute_time)
CASE2 = Experiment("case2", Tracing, _run_case2, _measure_case2)
CASE3 = Experiment("case3", Tracked, _run_case3)


def choose_cases(
    settings: Case1Settings | Case2Settings,
    conditions: Sequence[str] = ("30fps", "60fps"),
    frequencies: Sequence[float] = FREQUENCIES,
) -> list[Case]:
    """The cases of case study 1 or 2, of some conditions and frequencies, each checked; a tracing is a case.

    Raises
    ------
    ConfigError
        If there is no such condition, or a frequency or a setting is impossible.
    """
    known = {condition.name: condition for condition in CONDITIONS}
    unknown = [name for name in conditions if name not in known]
    if unknown:
        raise ConfigError(f"unknown condition {unknown[0]!r}: choose of {', '.join(known)}")
    chosen = [known[name] for name in known if name in conditions]
    shared, repeats = (
        (settings, [None])
        if isinstance(settings, Case1Settings)
        else (settings.as_case1(), list(range(settings.tracings)))
    )
    cases = [
        Case(condition, float(frequency), repeat)
        for condition in chosen
        for frequency in sorted({*frequencies})
        for repeat in repeats
    ]
    if not cases:
        raise ConfigError("no case is chosen: give one condition and one frequency at least")
    for case in cases:
        planned = scenario(case.condition, case.frequency, shared)
        planned.camera.camera(shared.seed)
    return cases
