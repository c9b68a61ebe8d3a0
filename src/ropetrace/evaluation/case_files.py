"""Which cases of case study 1 are run, and the folder in which the finished ones are kept."""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from ropetrace.config import read_toml
from ropetrace.errors import ConfigError, OutputError
from ropetrace.evaluation.case1 import (
    CONDITIONS,
    FREQUENCIES,
    Case1Settings,
    Condition,
    Readings,
    measure_compute_time,
    scenario,
)
from ropetrace.results.base import uninterrupted, writing


@dataclass(frozen=True, slots=True)
class Case:
    """A camera condition and a frequency of the wind, Hz."""

    condition: Condition
    frequency: float

    @property
    def name(self) -> str:
        """Such as 30fps_0.8."""
        return f"{self.condition.name}_{self.frequency!r}"


def choose_cases(
    settings: Case1Settings,
    conditions: Sequence[str] = ("30fps", "60fps"),
    frequencies: Sequence[float] = FREQUENCIES,
) -> list[Case]:
    """The cases of some conditions and frequencies, each checked.

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
    cases = [Case(condition, float(frequency)) for condition in chosen for frequency in sorted({*frequencies})]
    if not cases:
        raise ConfigError("no case is chosen: give one condition and one frequency at least")
    for case in cases:
        planned = scenario(case.condition, case.frequency, settings)
        planned.camera.camera(settings.seed)
    return cases


class Case1Folder:
    """Where a run is kept: `settings.toml`, and a file for each case that is finished.

    Parameters
    ----------
    path : Path
        The folder; it is made by `begin`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._settings_path = path / "settings.toml"

    def begin(
        self, settings: Case1Settings, conditions: Sequence[Condition], overwrite: bool = False
    ) -> dict[str, float]:
        """Begin a run, or go on with one of the same settings.

        Parameters
        ----------
        settings : Case1Settings
            Of the run.
        conditions : sequence of Condition
            Whose compute time is needed. What was measured before is used again.
        overwrite : bool
            Begin anew, whatever was run before.

        Returns
        -------
        dict of condition name to compute time, simulated seconds

        Raises
        ------
        ConfigError
            If the folder holds a run with other settings.
        OutputError
            If it holds something else, or cannot be written.
        """
        times = {} if overwrite else self._earlier(settings)
        missing = [condition for condition in conditions if condition.name not in times]
        times |= {condition.name: measure_compute_time(condition, settings) for condition in missing}
        with writing(self.path):
            (self.path / "cases").mkdir(parents=True, exist_ok=True)
            if overwrite:
                for file in (self.path / "cases").glob("*.npz"):
                    file.unlink()
        if missing or overwrite:
            replace_file(self._settings_path, _settings_text(settings, times).encode())
        return times

    def _earlier(self, settings: Case1Settings) -> dict[str, float]:
        """The compute times of the run that is in the folder; none if there is none."""
        with writing(self.path):
            if self.path.exists() and not self.path.is_dir():
                raise OutputError(f"{self.path} is a file: give the name of a folder")
            if not self._settings_path.exists():
                if self.path.exists() and any(self.path.iterdir()):
                    raise OutputError(
                        f"{self.path} holds other things, and no settings.toml: choose another --out, "
                        "or give --overwrite to write among them"
                    )
                return {}
        table = read_toml(self._settings_path)
        times = table.pop("compute_time", {})
        now = _settings_table(settings)
        for name in {**now, **table}:
            if table.get(name) != now.get(name):
                was, is_now = (_shown(values.get(name)) for values in (table, now))
                raise ConfigError(
                    f"{self.path} was begun with other settings ({name}: {was}, now {is_now}): choose another --out, "
                    "or give --overwrite to begin anew"
                )
        if not isinstance(times, dict) or not all(isinstance(value, float) for value in times.values()):
            raise ConfigError(f"{self._settings_path}: [compute_time] does not hold seconds: give --overwrite")
        return times

    def case_path(self, case: Case) -> Path:
        """The file of a case."""
        return self.path / "cases" / f"{case.name}.npz"

    def save(self, case: Case, readings: Readings) -> None:
        """Keep a finished case: the whole file or none."""
        stream = io.BytesIO()
        np.savez(stream, **asdict(readings))
        replace_file(self.case_path(case), stream.getvalue())

    def load(self, case: Case) -> Readings:
        """A finished case.

        Raises
        ------
        OutputError
            If it cannot be read.
        """
        path = self.case_path(case)
        try:
            with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as arrays:
                return Readings(**{item.name: arrays[item.name] for item in fields(Readings)})
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise OutputError(f"{path}: cannot be read ({error}): delete it, and run again") from None

    def finished(self, cases: Sequence[Case]) -> list[Case]:
        """Which of the cases are finished."""
        return [case for case in cases if self.case_path(case).exists()]


def replace_file(path: Path, data: bytes) -> None:
    """Write a file as a whole, in the place of an earlier one: nobody ever sees half of it.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    part = path.with_name(f".{path.name}.part")
    with writing(path), uninterrupted():
        part.write_bytes(data)
        os.replace(part, path)


def _settings_table(settings: Case1Settings) -> dict[str, Any]:
    values = {name: value for name, value in asdict(settings).items() if value is not None}
    return {"version": version("ropetrace"), **values}


def _settings_text(settings: Case1Settings, times: dict[str, float]) -> str:
    lines = ["# Of `ropetrace reproduce case1`. A run with other settings needs another folder."]
    lines += [f"{name} = {_shown(value)}" for name, value in _settings_table(settings).items()]
    lines += ["", "# From a frame's arrival to its centreline, simulated seconds; measured once, then applied to all."]
    lines += ["[compute_time]", *(f"{name} = {value!r}" for name, value in sorted(times.items()))]
    return "\n".join(lines) + "\n"


def _shown(value: Any) -> str:
    """As TOML."""
    if value is None:
        return "measured"
    return f'"{value}"' if isinstance(value, str) else repr(value)
