"""Where the runs of a comparison are kept, and how they are computed side by side or, to be timed, one by one."""

from __future__ import annotations

import tomllib
import zipfile
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ropetrace.config import RopeConfig
from ropetrace.errors import OutputError, RopetraceError
from ropetrace.evaluation.compare import Run, run_method, run_of_failure
from ropetrace.evaluation.run_folder import RunFolder
from ropetrace.evaluation.workers import Worker, WorkerLostError, Workers
from ropetrace.recordings import open_recording
from ropetrace.sim.record import truth_path
from ropetrace.suite import Case, Truth
from ropetrace.types import Event


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
    def name(self) -> str:
        """Of its file."""
        return "{}.{}".format(*self.key)

    @property
    def key(self) -> tuple[str, str]:
        """The names of case and method."""
        return self.case.name, self.config.method


def comparison_folder(path: Path) -> RunFolder[Task, Run]:
    """Where the runs of a comparison are kept."""
    return RunFolder(path, Run, "compare", "runs")


def run_tasks(
    folder: RunFolder[Task, Run],
    tasks: Sequence[Task],
    jobs: int,
    limit: int | None = None,
    on_progress: Callable[[int], object] = lambda count: None,
) -> None:
    """Run the tasks that are not finished. An interruption or an error keeps those that are.

    A method whose process dies or hangs has failed on that case, and the rest goes on.

    Parameters
    ----------
    folder : RunFolder
        Where they are kept.
    tasks : sequence of Task
        What is run.
    jobs : int
        Runs at a time, each in a process of one thread.
    limit : int, optional
        Frames of each case to use at most.
    on_progress : callable
        Is told at least once a second how many more runs are finished, 0 among them.

    Raises
    ------
    RopetraceError
        If a case cannot be read.
    """
    waiting = deque((task, "") for task in tasks if not folder.run_path(task).exists())
    with Workers(jobs) as workers:
        running: dict[Worker, tuple[Task, str]] = {}
        while waiting or running:
            while waiting and (worker := workers.idle()):
                task, failure = running[worker] = waiting.popleft()
                if failure:
                    worker.begin(run_of_failure, task.case, failure, limit)
                else:
                    worker.begin(run_method, task.case, task.config, limit)
            finished = 0
            for worker in workers.wait(running):
                task, failure = running.pop(worker)
                try:
                    folder.save(task, worker.result())
                    finished += 1
                except WorkerLostError as error:
                    if failure:
                        raise RopetraceError(f"{task.case.name}: its frames cannot be read: {error}") from None
                    waiting.appendleft((task, str(error)))
            on_progress(finished)


def settings_of(
    suite_version: str | None, config: RopeConfig | None, case: RecordedCase | None, **more: Any
) -> dict[str, Any]:
    """What `RunFolder.begin` compares: of the suite, or of a recording and the rope in it; what is None is not set."""
    table: dict[str, Any] = {"suite": suite_version, **more}
    if case is not None:
        table |= {
            f"recording_{name}": value for name, value in asdict(case).items() if name not in ("path", "diameter")
        }
        table["recording"] = str(case.path.resolve())
    if config is not None:
        table["config"] = tomllib.loads(config.to_toml())
    return table
