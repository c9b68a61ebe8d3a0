"""Where the runs of a comparison are kept, and how they are computed side by side or, to be timed, one by one."""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import cast

import numpy as np

from ropetrace.config import RopeConfig, read_toml
from ropetrace.errors import ConfigError, OutputError
from ropetrace.evaluation.case_files import read_arrays, replace_file
from ropetrace.evaluation.compare import Run, run_method
from ropetrace.evaluation.runner import process_pool, result_of, without_interrupt
from ropetrace.recordings import open_recording
from ropetrace.results.base import writing
from ropetrace.sim.record import truth_path
from ropetrace.suite import Case, Truth
from ropetrace.types import Event

_THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

Setting = str | float | bool | int


@dataclass(frozen=True, slots=True)
class RecordedCase:
    """A user's recording as a case. A simulated one has its truth beside it.

    Parameters
    ----------
    path : Path
        The recording.
    diameter : float
        Of the rope, metres.
    color : str, optional
        Of the rope in full light.
    start : int
        Frames to skip.
    rate : float, optional
        See `ropetrace.recordings.open_recording`, as for the topics.
    """

    path: Path
    diameter: float
    color: str | None = None
    start: int = 0
    rate: float | None = None
    depth_topic: str | None = None
    color_topic: str | None = None
    cloud_topic: str | None = None

    @property
    def name(self) -> str:
        """For reports and file names."""
        return self.path.resolve().name

    @property
    def description(self) -> str:
        """For reports."""
        return "With the truth of its simulation" if truth_path(self.path).is_file() else "No truth is known"

    def frames(self, limit: int | None = None) -> Iterator[tuple[Event, Truth | None]]:
        """Every frame, with its truth where the recording was simulated."""
        recording = open_recording(
            self.path,
            rate=self.rate,
            depth_topic=self.depth_topic,
            color_topic=self.color_topic,
            cloud_topic=self.cloud_topic,
        )
        truths = self._truths()
        for event in recording.frames(self.start, limit):
            yield event, truths.get(event.stamp_ns)

    def _truths(self) -> dict[int, Truth]:
        path = truth_path(self.path)
        if not path.is_file():
            return {}
        try:
            with np.load(path, allow_pickle=False) as arrays:
                rows = zip(arrays["stamp_ns"], arrays["polyline"], arrays["visible_fraction"], strict=True)
                return {int(stamp): Truth(line, float(seen)) for stamp, line, seen in rows}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise OutputError(f"{path}: the truth cannot be read ({error}): move it away, and run again") from None


@dataclass(frozen=True, slots=True)
class Task:
    """A method on a case.

    Parameters
    ----------
    case : Case
        The frames.
    config : RopeConfig
        Of its rope, with the method.
    """

    case: Case
    config: RopeConfig

    @property
    def key(self) -> tuple[str, str]:
        """The names of case and method."""
        return self.case.name, self.config.method


class RunFolder:
    """Where a comparison is kept: `settings.toml`, and a file for each run that is finished.

    Parameters
    ----------
    path : Path
        The folder; it is made by `begin`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def begin(self, settings: Mapping[str, Setting], overwrite: bool = False) -> None:
        """Begin a comparison, or go on with one of the same settings.

        Parameters
        ----------
        settings : mapping
            What the figures of a run depend on, but for its case and its method.
        overwrite : bool
            Begin anew, whatever was run before.

        Raises
        ------
        ConfigError
            If the folder holds a comparison with other settings.
        OutputError
            If it holds something else, or cannot be written.
        """
        file = self.path / "settings.toml"
        with writing(self.path):
            if self.path.exists() and not self.path.is_dir():
                raise OutputError(f"{self.path} is a file: give the name of a folder")
            if not overwrite and file.exists():
                self._check_same(read_toml(file), settings)
            elif not overwrite and self.path.exists() and any(self.path.iterdir()):
                raise OutputError(
                    f"{self.path} holds other things, and no settings.toml: choose another --out, "
                    "or give --overwrite to write among them"
                )
            (self.path / "runs").mkdir(parents=True, exist_ok=True)
            if overwrite:
                for run in (self.path / "runs").glob("*.npz"):
                    run.unlink()
        lines = ["# Of `ropetrace compare`. A run with other settings needs another folder."]
        lines += [f"{name} = {json.dumps(value)}" for name, value in settings.items()]
        replace_file(file, ("\n".join(lines) + "\n").encode())

    def _check_same(self, before: Mapping[str, Setting], now: Mapping[str, Setting]) -> None:
        for name in {**now, **before}:
            was, is_now = before.get(name, "not set"), now.get(name, "not set")
            if was != is_now:
                shown = "" if "\n" in f"{was}{is_now}" else f": {was}, now {is_now}"
                raise ConfigError(
                    f"{self.path} was begun with other settings ({name}{shown}): choose another --out, "
                    "or give --overwrite to begin anew"
                )

    def run_path(self, task: Task) -> Path:
        """The file of a run."""
        return self.path / "runs" / "{}.{}.npz".format(*task.key)

    def finished(self, tasks: Sequence[Task]) -> list[Task]:
        """Which of the tasks are finished."""
        return [task for task in tasks if self.run_path(task).exists()]

    def save(self, task: Task, run: Run) -> None:
        """Keep a run: the whole file or none."""
        stream = io.BytesIO()
        np.savez_compressed(stream, **{item.name: getattr(run, item.name) for item in fields(Run)})
        replace_file(self.run_path(task), stream.getvalue())

    def load(self, task: Task) -> Run:
        """A finished run.

        Raises
        ------
        OutputError
            If it cannot be read.
        """
        return cast(Run, read_arrays(self.run_path(task), Run))


@contextmanager
def worker_pool(jobs: int) -> Iterator[Executor]:
    """Processes of one thread each."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        with process_pool(jobs) as pool:
            yield pool
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def run_tasks(
    folder: RunFolder,
    tasks: Sequence[Task],
    executor: Executor,
    limit: int | None = None,
    on_progress: Callable[[int], object] = lambda count: None,
) -> None:
    """Run the tasks that are not finished. An interruption or an error keeps those that are.

    Parameters
    ----------
    folder : RunFolder
        Where they are kept.
    tasks : sequence of Task
        What is run.
    executor : Executor
        Such as `worker_pool`.
    limit : int, optional
        Frames of each case to use at most.
    on_progress : callable
        Is told about once a second how many more runs are finished, 0 among them.

    Raises
    ------
    RopetraceError
        If a case cannot be read, or a worker dies.
    """
    running: dict[Future[Run], Task] = {}
    with without_interrupt():
        for task in tasks:
            if not folder.run_path(task).exists():
                running[executor.submit(run_method, task.case, task.config, limit)] = task
    while running:
        done, _ = wait(running, timeout=1, return_when=FIRST_COMPLETED)
        for future in done:
            folder.save(running.pop(future), result_of(future))
        on_progress(len(done))


def settings_of(
    suite_version: str | None, config: RopeConfig | None, case: RecordedCase | None, **more: Setting | None
) -> dict[str, Setting]:
    """What `RunFolder.begin` compares: of the suite, or of a recording and the rope in it; what is None is left out."""
    table: dict[str, Setting | None] = {"suite": suite_version, **more}
    if case is not None:
        table |= {
            f"recording_{name}": value for name, value in asdict(case).items() if name not in ("path", "diameter")
        }
        table["recording"] = str(case.path.resolve())
    if config is not None:
        table["config"] = config.to_toml()
    return {name: value for name, value in table.items() if value is not None}
