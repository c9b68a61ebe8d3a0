"""For the formats that can be read only once they are finished: finish them again and again."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from ropetrace.results.base import check_place, create, uninterrupted, writing

SHORTEST_INTERVAL = 1.0
"""Least time between two checkpoints, seconds."""

REST = 10
"""Time between two checkpoints, in times that the last one took: they cost at most 1/11 of a run."""


class Checkpoint:
    """A file that is replaced as a whole, so that whoever reads it sees a whole one: the last.

    Parameters
    ----------
    path : path
        The file. Each new version is first written beside it, under a hidden name.
    overwrite : bool
        Whether the file may exist.
    save : function of a binary file
        Writes the whole of what is to be kept.

    Raises
    ------
    OutputError
        If the file cannot be created or written.
    """

    def __init__(self, path: Path, overwrite: bool, save: Callable[[BinaryIO], None]) -> None:
        self._path = path
        self._save = save
        self._next = 0.0
        check_place(path)
        if not overwrite:
            create(path, overwrite).close()
        try:
            self.write()
        except BaseException:
            if not overwrite:
                path.unlink(missing_ok=True)
            raise

    def write_if_due(self) -> None:
        """Write a new version if the last is old enough."""
        if time.monotonic() >= self._next:
            self.write()

    def write(self, *, last: bool = False) -> None:
        """Write a new version; `last` also waits until the disk has it."""
        started = time.monotonic()
        part = self._path.with_name(f".{self._path.name}.part")
        with writing(self._path), uninterrupted():
            try:
                with create(part, overwrite=True) as file:
                    self._save(file)
                    if last:
                        os.fsync(file.fileno())
                os.replace(part, self._path)
            except BaseException:
                part.unlink(missing_ok=True)
                raise
        ended = time.monotonic()
        self._next = ended + max(SHORTEST_INTERVAL, REST * (ended - started))
