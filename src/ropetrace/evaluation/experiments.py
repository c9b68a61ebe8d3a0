"""The experiments that can be repeated, each a set of cases, and which cases are run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from ropetrace.errors import ConfigError
from ropetrace.evaluation.case1 import (
    CONDITIONS,
    FREQUENCIES,
    Case,
    Case1Settings,
    Readings,
    run_case,
    scenario,
)
from ropetrace.evaluation.case2 import Case2Settings, Tracing, run_tracing

Settings = TypeVar("Settings")
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Experiment(Generic[Settings, Result]):
    """What differs from experiment to experiment.

    Parameters
    ----------
    name : str
        As on the command line.
    result : type
        Of a case: a dataclass of arrays.
    shared : callable
        From the experiment's settings to those of the rope, the camera and the tracker.
    run : callable
        Runs a case, given its settings and the time from a frame's arrival to its centreline, simulated seconds. A
        function of this module: workers are told its name.
    """

    name: str
    result: type[Result]
    shared: Callable[[Settings], Case1Settings]
    run: Callable[[Case, Settings, float], Result]


def _case1_settings(settings: Case1Settings) -> Case1Settings:
    return settings


def _run_case1(case: Case, settings: Case1Settings, compute_time: float) -> Readings:
    return run_case(case.condition, case.frequency, settings, compute_time)


def _run_case2(case: Case, settings: Case2Settings, compute_time: float) -> Tracing:
    return run_tracing(case.condition, case.frequency, settings, compute_time, case.repeat or 0)


CASE1 = Experiment("case1", Readings, _case1_settings, _run_case1)
CASE2 = Experiment("case2", Tracing, Case2Settings.as_case1, _run_case2)


def choose_cases(
    settings: Case1Settings | Case2Settings,
    conditions: Sequence[str] = ("30fps", "60fps"),
    frequencies: Sequence[float] = FREQUENCIES,
) -> list[Case]:
    """The cases of some conditions and frequencies, each checked; of case study 2, every tracing is a case.

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
