"""The folder of a batch: the results, and a summary that says what became of each recording.

A result is first left whole in a hidden folder; its row is added to the summary, and then it is moved to its place. A
kill between the two is made good by the next run. So what has a result has a row.
"""

from __future__ import annotations

import csv
import errno
import io
import os
import shutil
import uuid
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from ropetrace.errors import OutputError
from ropetrace.evaluation.run_folder import LOCK_FILE, SettingsFile, replace_file
from ropetrace.results.base import check_place, lock, uninterrupted, writing

SUMMARY = "summary.csv"

_MOST_TEXT = 5000
"""Letters of one cell of the summary; tools, Python's `csv` among them, refuse very long ones."""

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
                with disk_full_told(self.path), writing(place):
                    place.parent.mkdir(parents=True, exist_ok=True)
                    check_place(place)
            except DiskFullError:
                raise
            except OutputError as error:
                outcome = replace(outcome, result="", error=str(error))
        row = _rows([astuple(outcome)])
        with uninterrupted(), disk_full_told(self.path), writing(self._summary):
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


@contextmanager
def disk_full_told(folder: Path) -> Generator[None]:
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
