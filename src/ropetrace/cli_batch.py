"""The command that tracks many recordings: words for people, no logic."""

from __future__ import annotations

import os
import sys
import tomllib
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import OmitArgPrefixes, arg

from ropetrace.cli_source import Part, TrackedRope
from ropetrace.errors import OutputError, import_extra
from ropetrace.terminal import BAD_INPUT, DAMAGED, INTERRUPTED, NOTHING_FOUND, progress_bar

if TYPE_CHECKING:
    from ropetrace.batch_folder import Outcome, ResultFolder
    from ropetrace.config import RopeConfig
    from ropetrace.recordings.find import Found


@dataclass(frozen=True)
class Batch:
    """Track the rope through many recordings, on all cores or on a cluster.

    Finished results are kept: the same command goes on where it was interrupted, and tries again what failed.

    ropetrace batch 'recordings/**' --out results --diameter 12mm --color '#c8281e'
    """

    recordings: Annotated[tuple[str, ...], tyro.conf.Positional, arg(metavar="PATTERN ...")]
    """Recordings, folders of them, or patterns in quotes, such as 'recordings/**'."""
    part: OmitArgPrefixes[Part]
    rope: OmitArgPrefixes[TrackedRope]
    out: Annotated[Path, arg(aliases=["-o"], metavar="FOLDER")]
    """The folder for the results, which mirrors that of the recordings, and for summary.csv."""
    format: Literal["csv", "parquet", "npz", "mcap"] = "csv"
    """Of the results."""
    jobs: Annotated[int | None, arg(aliases=["-j"], metavar="N")] = None
    """Recordings at a time; by default as many as there are cores."""
    cluster: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """A Dask scheduler whose workers see the same files, such as tcp://host:8786; in place of this machine."""
    overwrite: bool = False
    """Begin anew, in the place of the results that are finished."""

    def run(self) -> int:
        from ropetrace.batch import run_batch
        from ropetrace.batch_folder import ResultFolder
        from ropetrace.evaluation.runner import check_engine
        from ropetrace.recordings.find import find_recordings

        self.part.check()
        check_engine(self.jobs, self.cluster)
        if self.format == "parquet":
            import_extra("pyarrow", "parquet")
        config = self.rope.settings()
        found = find_recordings(self.recordings, self.out)
        for trouble in found.unreadable:
            print(trouble, file=sys.stderr)
        self._check_out(found)
        tasks = self._tasks(found, config)
        with ResultFolder(self.out, self._settings(found, config), self.overwrite) as folder:
            before = sum(folder.finished(task.name) for task in tasks)
            jobs = self.jobs or len(os.sched_getaffinity(0))
            try:
                with progress_bar(len(tasks), "recording") as bar:
                    bar.update(before)

                    def tell(outcome: Outcome) -> None:
                        if outcome.error:
                            bar.write(f"{outcome.recording}: {outcome.error}", file=sys.stderr)
                        bar.update()

                    run_batch(folder, tasks, jobs=jobs, cluster=self.cluster, on_outcome=tell)
            except (KeyboardInterrupt, OutputError) as error:
                interrupted = isinstance(error, KeyboardInterrupt)
                done = f"{sum(folder.finished(task.name) for task in tasks)} of {len(tasks)} recordings"
                print(
                    f"ropetrace: {'interrupted' if interrupted else error}; {done} are finished and kept in {self.out}",
                    file=sys.stderr,
                )
                return INTERRUPTED if interrupted else BAD_INPUT
            finally:
                # On a full disk the rows stay in the order in which they came.
                with suppress(OutputError):
                    folder.sort([task.name for task in tasks])
            return _tell(folder, [folder.outcomes[task.name] for task in tasks], before)

    def _check_out(self, found: Found) -> None:
        """Results in a recording would be taken for a part of it."""
        out = Path(os.path.realpath(self.out))
        for recording in found.recordings.values():
            if Path(os.path.realpath(recording)) in (out, *out.parents):
                raise OutputError(f"{self.out} is, or lies in, the recording {recording}: choose another folder")

    def _tasks(self, found: Found, config: RopeConfig) -> list[Any]:
        from ropetrace.batch import Task
        from ropetrace.batch_folder import SUMMARY

        part = self.part
        tasks = [
            Task(path, name, self.format, config, part.options(), part.start, part.limit)
            for name, path in found.recordings.items()
        ]
        if any(task.result == SUMMARY for task in tasks):
            raise OutputError(
                f"{SUMMARY} is the summary, and cannot be the result of a recording: rename the recording"
            )
        return tasks

    def _settings(self, found: Found, config: RopeConfig) -> dict[str, Any]:
        return {
            "recordings": str(found.root),
            "format": self.format,
            **asdict(self.part),
            "config": tomllib.loads(config.to_toml()),
        }


def _tell(folder: ResultFolder, outcomes: list[Outcome], before: int) -> int:
    """Say what came of it; the exit code."""
    from ropetrace.batch_folder import SUMMARY

    failed = [outcome for outcome in outcomes if outcome.failed]
    damaged = [outcome for outcome in outcomes if outcome.error and not outcome.failed]
    frames, ok, degraded, lost = (
        sum(getattr(outcome, name) for outcome in outcomes) for name in ("frames", "ok", "degraded", "lost")
    )
    print(f"recordings {len(outcomes)} ({len(outcomes) - len(failed)} finished, {before} of them before, ", end="")
    print(f"{len(failed)} failed, {len(damaged)} damaged)")
    print(f"frames     {frames} ({ok} ok, {degraded} degraded, {lost} lost)")
    print(f"summary    {folder.path / SUMMARY}")
    if not ok + degraded:
        print("ropetrace: no frame gave an estimate; `ropetrace doctor` on one recording says why", file=sys.stderr)
        return NOTHING_FOUND
    if failed or damaged:
        print("ropetrace: part of the recordings was lost (see the summary)", file=sys.stderr)
        return DAMAGED
    return 0
