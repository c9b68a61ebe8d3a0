"""The folder in which finished runs are kept, each in a file, with the settings that they were run with."""

from __future__ import annotations

import io
import json
import os
import tomllib
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import fields
from importlib.metadata import version
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, cast

import numpy as np

from ropetrace.config import read_toml
from ropetrace.errors import ConfigError, OutputError
from ropetrace.recordings.base import printable
from ropetrace.results.base import uninterrupted, writing

LOCK_FILE = ".lock"
"""What a process locks in a folder to which it alone writes; it stays there, and is of no other meaning."""


class Named(Protocol):
    """What every run has."""

    @property
    def name(self) -> str:
        """Of its file."""


SomeRun = TypeVar("SomeRun", bound=Named)
Result = TypeVar("Result")


class SettingsFile:
    """`settings.toml` of a folder: what all runs that are kept in it depend on.

    Parameters
    ----------
    folder : Path
        It need not exist.
    command : str
        Of `ropetrace`, whose runs they are.
    """

    def __init__(self, folder: Path, command: str) -> None:
        self._folder = folder
        self._command = command
        self._path = folder / "settings.toml"

    def measured(self, settings: Mapping[str, Any]) -> dict[str, float]:
        """What was measured before the runs that are in the folder; nothing if there are none.

        Parameters
        ----------
        settings : mapping
            Those of the runs that are to join them.

        Raises
        ------
        ConfigError
            If the runs have other settings.
        OutputError
            If the folder holds something else.
        """
        folder = self._folder
        with writing(folder):
            if folder.exists() and not folder.is_dir():
                raise OutputError(f"{folder} is a file: give the name of a folder")
            if not self._path.exists():
                if folder.exists() and any(path.name != LOCK_FILE for path in folder.iterdir()):
                    raise OutputError(
                        f"{folder} holds other things, and no settings.toml: choose another --out, "
                        "or give --overwrite to write among them"
                    )
                return {}
        table = read_toml(self._path)
        times = table.pop("compute_time", {})
        before, now = _flat(table), _flat(tomllib.loads(_toml(_with_version(settings))))
        for name in {**now, **before}:
            if before.get(name) != now.get(name):
                was, is_now = (_shown(values.get(name)) for values in (before, now))
                raise ConfigError(
                    f"{folder} was begun with other settings ({name}: {was}, now {is_now}): choose another --out, "
                    "or give --overwrite to begin anew"
                )
        if not isinstance(times, dict) or not all(isinstance(value, float) for value in times.values()):
            raise ConfigError(f"{self._path}: [compute_time] does not hold seconds: give --overwrite")
        return times

    def write(self, settings: Mapping[str, Any], measured: Mapping[str, float] | None = None) -> None:
        """Write it: what is None is left out."""
        lines = [
            f"# Of `ropetrace {self._command}`. A run with other settings needs another folder.",
            _toml(_with_version(settings)),
        ]
        if measured:
            lines += [
                "",
                "# From a frame's arrival to its centreline, simulated seconds; measured once, then applied to all.",
                "[compute_time]",
                *(f"{name} = {value!r}" for name, value in sorted(measured.items())),
            ]
        replace_file(self._path, ("\n".join(lines) + "\n").encode())


class RunFolder(Generic[SomeRun, Result]):
    """Where runs are kept: `settings.toml`, and a file for each run that is finished.

    Parameters
    ----------
    path : Path
        The folder; it is made by `begin`.
    result : type
        Of a run: a dataclass of arrays.
    command : str
        Of `ropetrace`, whose runs they are.
    inner : str
        The folder in it that has their files.

    Attributes
    ----------
    settings : SettingsFile
        What all of its runs depend on.
    """

    def __init__(self, path: Path, result: type[Result], command: str, inner: str) -> None:
        self.path = path
        self._result = result
        self._arrays = [item.name for item in fields(cast(Any, result))]
        self._files = path / inner
        self.settings = SettingsFile(path, command)

    def begin(
        self, settings: Mapping[str, Any], measured: Mapping[str, float] | None = None, overwrite: bool = False
    ) -> None:
        """Begin, or go on with runs of the same settings.

        Parameters
        ----------
        settings : mapping
            What all runs depend on: texts, numbers, sequences of them, and mappings; what is None is left out.
        measured : mapping, optional
            Compute times by their names, simulated seconds: see `SettingsFile.measured`.
        overwrite : bool
            Begin anew, whatever was run before.

        Raises
        ------
        ConfigError
            If the folder holds runs with other settings.
        OutputError
            If it holds something else, or cannot be written.
        """
        if not overwrite:
            self.settings.measured(settings)
        with writing(self.path):
            self._files.mkdir(parents=True, exist_ok=True)
            if overwrite:
                for file in self._files.glob("*.npz"):
                    file.unlink()
        self.settings.write(settings, measured)

    def run_path(self, run: SomeRun) -> Path:
        """The file of a run."""
        return self._files / f"{run.name}.npz"

    def finished(self, runs: Sequence[SomeRun]) -> list[SomeRun]:
        """Which of the runs are finished."""
        return [run for run in runs if self.run_path(run).exists()]

    def save(self, run: SomeRun, result: Result) -> None:
        """Keep a finished run: the whole file or none."""
        arrays = {name: getattr(result, name) for name in self._arrays}
        stream = io.BytesIO()
        np.savez_compressed(stream, **arrays)
        replace_file(self.run_path(run), stream.getvalue())

    def load(self, run: SomeRun) -> Result:
        """A finished run.

        Raises
        ------
        OutputError
            If it cannot be read.
        """
        path = self.run_path(run)
        try:
            with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as arrays:
                return self._result(**{name: arrays[name] for name in self._arrays})
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise OutputError(f"{path}: cannot be read ({error}): delete it, and run again") from None


def replace_file(path: Path, data: bytes) -> None:
    """Write a file as a whole, in the place of an earlier one: nobody ever sees half of it.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    part = path.with_name(f".{path.name}.part")
    with writing(path), uninterrupted():
        try:
            part.write_bytes(data)
            os.replace(part, path)
        except OSError:
            part.unlink(missing_ok=True)
            raise


def replace_files(folder: Path, files: dict[str, bytes]) -> list[Path]:
    """`replace_file` for several, by their names; gives their paths."""
    for name, data in files.items():
        replace_file(folder / name, data)
    return [folder / name for name in files]


def _with_version(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {"version": version("ropetrace"), **settings}


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
    """As TOML, which takes no bytes that are no text, as names of files may have."""
    if value is None:
        return "not set"
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(map(_shown, value)) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    return json.dumps(printable(value), ensure_ascii=False) if isinstance(value, str) else repr(value)
