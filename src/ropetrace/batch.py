"""Tracks the rope through many recordings side by side, and keeps each result as soon as it is finished.

On this machine the processes of `ropetrace.evaluation.workers` serve: one that dies or hangs fails its recording alone.
On a cluster Dask does, by the interface of `concurrent.futures`; its workers read and write the same paths as this
process.

A worker leaves a whole result in a hidden folder of the run. This process adds the row to the summary and then moves
the result to its place; a kill between the two is made good by the next run. So what has a result has a row, and what
has a row is never done again.
"""

from __future__ import annotations

import csv
import errno
import io
import os
import shutil
import tempfile
import time
import uuid
from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import astuple, dataclass, fields, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from ropetrace.config import RopeConfig
from ropetrace.errors import ConfigError, OutputError, RecordingError, RopetraceError
from ropetrace.evaluation.run_folder import LOCK_FILE, SettingsFile, replace_file
from ropetrace.evaluation.runner import dask_executor
from ropetrace.evaluation.workers import Worker, WorkerLostError, Workers
from ropetrace.motion import make_motion
from ropetrace.recordings import open_recording
from ropetrace.recordings.base import has_color
from ropetrace.results import open_writer
from ropetrace.results.base import check_place, lock, uninterrupted, writing
from ropetrace.trackers import make_tracker
from ropetrace.tracking import track_recording
from ropetrace.types import Estimate, Status

SUMMARY = "summary.csv"

_MOST_DAMAGE = 5
"""Sentences on the damage of a recording that the summary has."""

_MOST_TEXT = 5000
"""Letters of one cell of the summary; tools, Python's `csv` among them, refuse very long ones."""

_SLOWEST_READING = 20e6
"""Bytes a second: a recording that was never closed has to be read as a whole before its first frame."""

_PARTS = ".part-"
"""What the folder of a run begins with in which workers write."""


class DiskFullError(OutputError):
    """There is no room for results; no recording has a chance."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a recording: a row of the summary.

    Parameters
    ----------
    recording : str
        Its path below the folder that all are in.
    frames : int
        That were tracked.
    ok, degraded, lost : int
        Estimates of each status; one a frame where there is one rope.
    seconds : float
        That it took.
    result : str
        The file of results, below the folder of results; empty if the recording failed.
    error : str
        Why it failed; or, beside a result, what damage was found. Empty if all is well.
    """

    recording: str
    frames: int = 0
    ok: int = 0
    degraded: int = 0
    lost: int = 0
    seconds: float = 0.0
    result: str = ""
    error: str = ""

    @property
    def failed(self) -> bool:
        """Whether there is no result."""
        return not self.result


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


class ResultFolder:
    """The folder of a batch: the results, `settings.toml`, and `summary.csv` with a row for each recording.

    The summary grows by a row whenever a recording is finished or has failed, so that a run that is killed can go on.
    A context manager, which nobody else can be in meanwhile.

    Parameters
    ----------
    path : Path
        The folder.
    settings : mapping
        What all results depend on; see `SettingsFile`.
    overwrite : bool
        Begin anew: results that were listed before are removed.

    Attributes
    ----------
    outcomes : dict of str to Outcome
        By the recording.
    parts : Path
        Where the workers of this run leave whole results, absolute; removed at the end.

    Raises
    ------
    ConfigError
        If results with other settings are there.
    OutputError
        If the folder holds something else, cannot be written, or another batch writes to it.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any], overwrite: bool) -> None:
        self.path = path
        self.parts = path.absolute() / f"{_PARTS}{uuid.uuid4().hex}"
        self.outcomes: dict[str, Outcome] = {}
        self._summary = path / SUMMARY
        file = SettingsFile(path, "batch")
        if not overwrite:
            file.measured(settings)
        with ExitStack() as stack, writing(path):
            path.mkdir(parents=True, exist_ok=True)
            # A file of its own, since all others are replaced as a whole; open for writing, as NFS demands for a lock.
            handle = os.open(path / LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o666)
            stack.callback(os.close, handle)
            lock(handle, path)
            before = self._read()
            self._move_what_is_listed(before)
            self._remove_parts()
            if overwrite:
                for outcome in before:
                    (path / outcome.result).unlink(missing_ok=True) if outcome.result else None
            else:
                self.outcomes = {outcome.recording: outcome for outcome in before if self._is_kept(outcome)}
            file.write(settings)
            self._rewrite(self.outcomes.values())
            self._rows = stack.enter_context(self._summary.open("ab", buffering=0))
            self.parts.mkdir()
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._remove_parts()
        self._stack.close()

    def _move_what_is_listed(self, outcomes: Iterable[Outcome]) -> None:
        """A run was killed after it had added a row, and before the result was in its place."""
        for parts in self.path.glob(_PARTS + "*"):
            for outcome in outcomes:
                if outcome.result:
                    with suppress(OSError):
                        os.replace(parts / outcome.result, self.path / outcome.result)

    def _remove_parts(self) -> None:
        for parts in self.path.glob(_PARTS + "*"):
            shutil.rmtree(parts, ignore_errors=True)

    def finished(self, name: str) -> bool:
        """Whether a recording has a result."""
        return name in self.outcomes and not self.outcomes[name].failed

    def add(self, outcome: Outcome) -> Outcome:
        """Add the outcome of a recording to the summary, and move its result from `parts` to its place.

        Returns
        -------
        Outcome
            As it is in the summary: a failure where there is no place for the result.

        Raises
        ------
        DiskFullError
            If there is no room.
        OutputError
            If the summary cannot be written.
        """
        if len(outcome.error) > _MOST_TEXT:
            outcome = replace(outcome, error=f"{outcome.error[:_MOST_TEXT]}...")
        if not outcome.failed:
            place = self.path / outcome.result
            try:
                with _disk_full_told(self.path), writing(place):
                    place.parent.mkdir(parents=True, exist_ok=True)
                    check_place(place)
            except DiskFullError:
                raise
            except OutputError as error:
                outcome = replace(outcome, result="", error=str(error))
        row = _rows([astuple(outcome)])
        with uninterrupted(), _disk_full_told(self.path), writing(self._summary):
            if self._rows.write(row) < len(row):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            if not outcome.failed:
                os.replace(self.parts / outcome.result, self.path / outcome.result)
            self.outcomes[outcome.recording] = outcome
        return outcome

    def sort(self, names: Sequence[str]) -> None:
        """Put the summary in the order of these recordings; others stay behind them."""
        ordered = {name: self.outcomes[name] for name in names if name in self.outcomes}
        self._rewrite((ordered | self.outcomes).values())

    def _is_kept(self, outcome: Outcome) -> bool:
        return bool(outcome.result) and (self.path / outcome.result).is_file()

    def _read(self) -> list[Outcome]:
        """The outcomes of the summary; a row that was cut off by a kill, or is none that we write, is none."""
        if not self._summary.exists():
            return []
        found = []
        # Bytes, since a text file has other ends of lines than a name may have.
        text = self._summary.read_bytes().decode("utf-8", "surrogateescape")
        for row in _whole_rows(text)[1:]:
            try:
                recording, frames, ok, degraded, lost, seconds, result, error = row
                counts = (int(frames), int(ok), int(degraded), int(lost))
                outcome = Outcome(recording, *counts, float(seconds), result, error)
            except ValueError:
                continue
            if not Path(result).is_absolute() and ".." not in Path(result).parts:
                found.append(outcome)
        return found

    def _rewrite(self, outcomes: Iterable[Outcome]) -> None:
        header = tuple(item.name for item in fields(Outcome))
        replace_file(self._summary, _rows([header, *map(astuple, outcomes)]))


def _rows(rows: Sequence[tuple[Any, ...]]) -> bytes:
    stream = io.StringIO()
    # All texts are quoted: names may have any end of a line in them.
    csv.writer(stream, lineterminator="\n", quoting=csv.QUOTE_NONNUMERIC).writerows(rows)
    return stream.getvalue().encode("utf-8", "surrogateescape")


def _whole_rows(text: str) -> list[list[str]]:
    """The rows of a CSV text that can be read."""
    rows, reader = [], csv.reader(io.StringIO(text, newline=""))
    while True:
        try:
            rows.append(next(reader))
        except csv.Error:
            continue
        except StopIteration:
            return rows


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
            _disk_full_told(parts.parent),
            writing(Path(task.result)),
            tempfile.TemporaryDirectory(dir=parts) as folder,
        ):
            part = Path(folder) / f"result.{task.format}"
            outcome = _tracked(task, part, on_frame, started)
            whole.parent.mkdir(parents=True, exist_ok=True)
            os.replace(part, whole)
            return outcome
    except DiskFullError:
        raise
    except RopetraceError as error:
        return Outcome(task.name, seconds=_seconds_since(started), error=str(error))


@contextmanager
def _disk_full_told(folder: Path) -> Generator[None]:
    """Tell a full disk from other reasons for which a file cannot be written, by what the system said first."""
    try:
        yield
    except OutputError as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT):
                raise DiskFullError(f"{folder}: the disk is full ({cause.strerror})") from None
            cause = cause.__context__
        raise


def _tracked(task: Task, part: Path, on_frame: Callable[[], object], started: float) -> Outcome:
    def tell(estimate: Estimate) -> None:
        on_frame()

    config = task.config
    recording = open_recording(task.recording, **task.options)
    if config.asks_for_color and not has_color(recording, task.start):
        raise ConfigError("a colour is asked for, but the recording has none")
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
