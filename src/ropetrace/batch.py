"""Tracks the rope through many recordings side by side, and keeps each result as soon as it is finished.

On this machine the processes of `ropetrace.evaluation.workers` serve: one that dies or hangs fails its recording alone.
On a cluster Dask does, by the interface of `concurrent.futures`; its workers read and write the same paths as this
process.

A worker leaves a whole result in a hidden folder of the run, and this process adds it to the folder of results: see
`ropetrace.batch_folder`. What is there is never done again.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from ropetrace.batch_folder import DiskFullError, Outcome, ResultFolder, disk_full_told
from ropetrace.config import RopeConfig
from ropetrace.errors import ConfigError, RecordingError, RopetraceError
from ropetrace.evaluation.runner import dask_executor
from ropetrace.evaluation.workers import Worker, WorkerLostError, Workers
from ropetrace.motion import make_motion
from ropetrace.recordings import open_recording
from ropetrace.recordings.base import check_color
from ropetrace.results import open_writer
from ropetrace.results.base import writing
from ropetrace.trackers import make_tracker
from ropetrace.tracking import track_recording
from ropetrace.types import Estimate, Status

_MOST_DAMAGE = 5
"""Sentences on the damage of a recording that the summary has."""

_SLOWEST_READING = 20e6
"""Bytes a second: a recording that was never closed has to be read as a whole before its first frame."""


@dataclass(frozen=True, slots=True)
class Task:
    """A recording to be tracked, and all that a worker must know for that.

    Parameters
    ----------
    recording : Path
        Where it is.
    name : str
        Its path below the folder that all recordings are in.
    format : str
        The ending of results.
    config : RopeConfig
        Of the rope.
    options : mapping
        Of `open_recording`.
    start : int
        Frames to skip.
    limit : int, optional
        Frames to use at most.
    """

    recording: Path
    name: str
    format: str
    config: RopeConfig
    options: dict[str, Any]
    start: int = 0
    limit: int | None = None

    @property
    def result(self) -> str:
        """The file of results, below the folder of results."""
        return f"{self.name}.{self.format}"


def run_batch(
    folder: ResultFolder,
    tasks: Sequence[Task],
    *,
    jobs: int = 1,
    cluster: str | None = None,
    on_outcome: Callable[[Outcome], object] = lambda outcome: None,
) -> None:
    """Track the recordings that have no result yet. One that fails is told and does not stop the rest.

    Parameters
    ----------
    folder : ResultFolder
        Takes the outcomes. An interruption keeps those that are finished.
    tasks : sequence of Task
        Recordings of different names.
    jobs : int
        At a time on this machine.
    cluster : str, optional
        Address of a Dask scheduler, in place of this machine; see `ropetrace.evaluation.runner.check_engine`.
    on_outcome : callable
        Is told of each.

    Raises
    ------
    ConfigError
        If the cluster cannot be reached, or has another version of ropetrace.
    DiskFullError
        If there is no room for results.
    OutputError
        If the summary cannot be written.
    """
    waiting = [task for task in tasks if not folder.finished(task.name)]
    if not waiting:
        return
    if cluster is None:
        run = _run_here(waiting, folder.parts, min(jobs, len(waiting)))
    else:
        run = _run_there(waiting, folder.parts, cluster)
    with closing(run) as outcomes:  # whatever happens, the workers end first
        for outcome in outcomes:
            on_outcome(folder.add(outcome))


def _run_here(tasks: Sequence[Task], parts: Path, jobs: int) -> Generator[Outcome]:
    waiting = deque(tasks)
    with Workers(jobs) as workers:
        running: dict[Worker, Task] = {}
        while waiting or running:
            while waiting and (worker := workers.idle()):
                task = running[worker] = waiting.popleft()
                worker.begin(track_task, task, parts, before_first=_size(task.recording) / _SLOWEST_READING)
            for worker in workers.wait(running):
                task = running.pop(worker)
                try:
                    yield worker.result()
                except DiskFullError:
                    raise
                except (RopetraceError, WorkerLostError) as error:
                    yield Outcome(task.name, error=str(error))


def _size(recording: Path) -> int:
    """Bytes of a file, or of those in a folder; 0 for what is not known."""
    try:
        if os.path.isdir(recording):
            return sum(entry.stat().st_size for entry in os.scandir(recording))
        return os.path.getsize(recording)
    except OSError:
        return 0


def _run_there(tasks: Sequence[Task], parts: Path, cluster: str) -> Generator[Outcome]:
    with dask_executor(cluster) as executor:
        wanted = version("ropetrace")
        running: dict[Future[Outcome], Task] = {
            executor.submit(_on_cluster, task, parts, wanted): task for task in tasks
        }
        while running:
            for future in wait(running, timeout=1, return_when=FIRST_COMPLETED)[0]:
                task = running.pop(future)
                try:
                    yield future.result()
                except (ConfigError, DiskFullError):
                    raise
                except Exception as error:  # such as Dask's KilledWorker
                    yield Outcome(task.name, error=f"{type(error).__name__}: {error}")


def _on_cluster(task: Task, parts: Path, wanted: str) -> Outcome:
    if version("ropetrace") != wanted:
        raise ConfigError(f"a worker has ropetrace {version('ropetrace')}, not {wanted}")
    return track_task(task, parts)


def track_task(task: Task, parts: Path, on_frame: Callable[[], object] = lambda: None) -> Outcome:
    """Track one recording; its result is then in `parts`, wholly or not at all.

    Parameters
    ----------
    task : Task
        Which.
    parts : Path
        The folder for whole results, that of the `ResultFolder`.
    on_frame : callable
        Is told of every frame.

    Raises
    ------
    DiskFullError
        If there is no room for the result.
    """
    started = time.monotonic()
    whole = parts / task.result
    try:
        # Each in a folder of its own: Dask may have a recording tracked twice.
        with (
            disk_full_told(parts.parent),
            writing(Path(task.result)),
            tempfile.TemporaryDirectory(dir=parts) as folder,
        ):
            part = Path(folder) / f"result.{task.format}"
            outcome = _tracked(task, part, on_frame, started)
            _sync(part)
            whole.parent.mkdir(parents=True, exist_ok=True)
            os.replace(part, whole)
            return outcome
    except DiskFullError:
        raise
    except RopetraceError as error:
        return Outcome(task.name, seconds=_seconds_since(started), error=str(error))


def _sync(file: Path) -> None:
    """Wait until the disk has a file: what is listed as finished is never looked at again, also after a power cut."""
    with file.open("rb+") as stream:
        os.fsync(stream.fileno())


def _tracked(task: Task, part: Path, on_frame: Callable[[], object], started: float) -> Outcome:
    def tell(estimate: Estimate) -> None:
        on_frame()

    config = task.config
    recording = open_recording(task.recording, **task.options)
    check_color(recording, config.asks_for_color, task.start)
    with open_writer(part, metadata={"config": config.resolved().to_toml()}) as writer:
        summary = track_recording(
            recording.frames(task.start, task.limit),
            make_tracker(config),
            [writer],
            motion=partial(make_motion, config.motion.method, config.diameter),
            first_index=task.start,
            on_frame=tell,
        )
    if not summary.frames:
        raise RecordingError(f"{task.recording}: there is no frame at or after --start {task.start}")
    ok, degraded, lost = (sum(rope.statuses[status] for rope in summary.ropes.values()) for status in Status)
    more = len(recording.problems) - _MOST_DAMAGE
    damage = "; ".join([*recording.problems[:_MOST_DAMAGE], *([f"and {more} more"] if more > 0 else [])])
    seconds = _seconds_since(started)
    return Outcome(task.name, summary.frames, ok, degraded, lost, seconds, task.result, damage)


def _seconds_since(started: float) -> float:
    return round(time.monotonic() - started, 3)
