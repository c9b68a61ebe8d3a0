"""The folder in which the finished cases of an experiment are kept, and the settings they were run with."""

from __future__ import annotations

import io
import os
import tomllib
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any, Generic, cast

import numpy as np

from ropetrace.config import read_toml
from ropetrace.errors import ConfigError, OutputError
from ropetrace.evaluation.case1 import Condition
from ropetrace.evaluation.experiments import ComputeTimes, Experiment, Result, Settings, SomeCase
from ropetrace.results.base import uninterrupted, writing


class CaseFolder(Generic[SomeCase, Settings, Result]):
    """Where a run is kept: `settings.toml`, and a file for each case that is finished.

    Parameters
    ----------
    path : Path
        The folder; it is made by `begin`.
    experiment : Experiment
        Whose cases.
    """

    def __init__(self, path: Path, experiment: Experiment[SomeCase, Settings, Result]) -> None:
        self.path = path
        self.experiment = experiment
        self._settings_path = path / "settings.toml"

    def begin(self, settings: Settings, conditions: Sequence[Condition] = (), overwrite: bool = False) -> ComputeTimes:
        """Begin a run, or go on with one of the same settings.

        Parameters
        ----------
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
        ConfigError
            If the folder holds a run with other settings.
        OutputError
            If it holds something else, or cannot be written.
        """
        times = {} if overwrite else self._earlier(settings)
        before = set(times)
        if self.experiment.measure is not None:
            for condition in conditions:
                if condition.name not in times:
                    times[condition.name] = self.experiment.measure(condition, settings)
        with writing(self.path):
            (self.path / "cases").mkdir(parents=True, exist_ok=True)
            if overwrite:
                for file in (self.path / "cases").glob("*.npz"):
                    file.unlink()
        if overwrite or set(times) != before or not self._settings_path.exists():
            replace_file(self._settings_path, self._settings_text(settings, times).encode())
        return times

    def _earlier(self, settings: Settings) -> ComputeTimes:
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
        before, now = _flat(table), _flat(tomllib.loads(_toml(_settings_table(settings))))
        for name in {**now, **before}:
            if before.get(name) != now.get(name):
                was, is_now = (_shown(values.get(name)) for values in (before, now))
                raise ConfigError(
                    f"{self.path} was begun with other settings ({name}: {was}, now {is_now}): choose another --out, "
                    "or give --overwrite to begin anew"
                )
        if not isinstance(times, dict) or not all(isinstance(value, float) for value in times.values()):
            raise ConfigError(f"{self._settings_path}: [compute_time] does not hold seconds: give --overwrite")
        return times

    def _settings_text(self, settings: Settings, times: ComputeTimes) -> str:
        lines = [
            f"# Of `ropetrace reproduce {self.experiment.name}`. A run with other settings needs another folder.",
            _toml(_settings_table(settings)),
        ]
        if times:
            lines += [
                "",
                "# From a frame's arrival to its centreline, simulated seconds; measured once, then applied to all.",
                "[compute_time]",
                *(f"{name} = {value!r}" for name, value in sorted(times.items())),
            ]
        return "\n".join(lines) + "\n"

    def case_path(self, case: SomeCase) -> Path:
        """The file of a case."""
        return self.path / "cases" / f"{case.name}.npz"

    def save(self, case: SomeCase, result: Result) -> None:
        """Keep a finished case: the whole file or none."""
        stream = io.BytesIO()
        np.savez(stream, **_as_dict(result))
        replace_file(self.case_path(case), stream.getvalue())

    def load(self, case: SomeCase) -> Result:
        """A finished case.

        Raises
        ------
        OutputError
            If it cannot be read.
        """
        return cast(Result, read_arrays(self.case_path(case), self.experiment.result))

    def finished(self, cases: Sequence[SomeCase]) -> list[SomeCase]:
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


def read_arrays(path: Path, kind: type[Any]) -> Any:
    """A dataclass of arrays from the NPZ file that keeps them by their names.

    Raises
    ------
    OutputError
        If it cannot be read.
    """
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as arrays:
            return kind(**{item.name: arrays[item.name] for item in fields(kind)})
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise OutputError(f"{path}: cannot be read ({error}): delete it, and run again") from None


def replace_files(folder: Path, files: dict[str, bytes]) -> list[Path]:
    """`replace_file` for several, by their names; gives their paths."""
    for name, data in files.items():
        replace_file(folder / name, data)
    return [folder / name for name in files]


def _settings_table(settings: Any) -> dict[str, Any]:
    return {"version": version("ropetrace"), **_as_dict(settings)}


def _as_dict(item: Any) -> dict[str, Any]:
    """Of a dataclass."""
    return asdict(item)


def _toml(table: dict[str, Any], name: str = "") -> str:
    """A table and the tables in it; what is None is left out."""
    lines = [f"[{name}]"] if name else []
    inner = []
    for key, value in table.items():
        if isinstance(value, dict):
            inner.append(_toml(value, f"{name}.{key}" if name else key))
        elif value is not None:
            lines.append(f"{key} = {_shown(value)}")
    return "\n\n".join(["\n".join(lines), *inner])


def _flat(table: dict[str, Any], start: str = "") -> dict[str, Any]:
    """The settings of all tables, by names such as tracing.gain_near."""
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat |= _flat(value, f"{start}{key}.") if isinstance(value, dict) else {start + key: value}
    return flat


def _shown(value: Any) -> str:
    """As TOML."""
    if value is None:
        return "not set"
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(map(_shown, value)) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    return f'"{value}"' if isinstance(value, str) else repr(value)
