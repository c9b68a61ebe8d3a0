"""Finds the recordings among files and folders, without opening any."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ropetrace.errors import RecordingError
from ropetrace.recordings import CLOUD_SUFFIXES, ROS_MAGICS
from ropetrace.recordings.base import natural_key

_ROS_SUFFIXES = (".mcap", ".db3", ".bag")
_TRUTH = "truth.npz"
"""What the truth of a simulated recording is called, or ends in."""


@dataclass(frozen=True, slots=True)
class Found:
    """Recordings that were found.

    Parameters
    ----------
    root : Path
        The folder that all are in.
    recordings : dict of str to Path
        By their paths below the root, in natural order.
    """

    root: Path
    recordings: dict[str, Path]


def find_recordings(patterns: Sequence[str], left_out: Path) -> Found:
    """The recordings that patterns such as ``recordings/**`` match, each once.

    A folder that is a recording counts as one, and nothing in it is another. A folder that is none is searched. Of ROS
    files in a folder each is a recording, unless there is a ``metadata.yaml`` that makes them one.

    Parameters
    ----------
    patterns : sequence of str
        Paths, or patterns as `glob` has them. A single file is taken whatever it is.
    left_out : Path
        A folder in which nothing is searched: that of the results.

    Raises
    ------
    RecordingError
        If a pattern matches no recording.
    """
    search = _Search(left_out.resolve())
    bases = []
    for pattern in patterns:
        base, matches = _matches(pattern)
        if not search.add(matches):
            raise RecordingError(f"{pattern}: no recording is there")
        bases.append(base)
    root = Path(os.path.commonpath(bases))
    names = sorted((path.relative_to(root).as_posix() for path in search.found.values()), key=natural_key)
    return Found(root, {name: root / name for name in names})


class _Search:
    """What was found so far.

    Attributes
    ----------
    found : dict of Path to Path
        Recordings as they were given, by where they really are.
    """

    def __init__(self, left_out: Path) -> None:
        self.found: dict[Path, Path] = {}
        self._seen = {left_out}

    def add(self, matches: Sequence[Path]) -> bool:
        """Search some paths; whether any recording, be it a known one, is there."""
        hit = False
        for match in sorted(matches, key=lambda path: len(path.parts)):
            if match.is_file() and len(matches) == 1 and not self._is_known(match.resolve()):
                self.found[match.resolve()] = match
            self._look(match)
            real = match.resolve()
            hit |= self._is_known(real) or any(real in place.parents for place in self.found)
        return hit

    def _look(self, path: Path) -> None:
        real = path.resolve()
        if real in self._seen or self._is_known(real):
            return
        self._seen.add(real)
        if is_recording(path):
            self.found[real] = path
        elif path.is_dir():
            for name in sorted(os.listdir(path)):
                if not name.startswith("."):
                    self._look(path / name)

    def _is_known(self, real: Path) -> bool:
        """Whether it is a recording that was found, or lies in one."""
        return real in self.found or any(parent in self.found for parent in real.parents)


def is_recording(path: Path) -> bool:
    """Whether a file or a folder looks like a recording; whether it is a sound one shows when it is opened."""
    try:
        if path.is_dir():
            return _is_recording_folder(path)
        if not path.is_file() or path.name.endswith(_TRUTH):
            return False
        if path.suffix.lower() in _ROS_SUFFIXES + CLOUD_SUFFIXES:
            return True
        with path.open("rb") as file:
            return file.read(16).startswith(ROS_MAGICS)
    except OSError:
        return False


def _is_recording_folder(path: Path) -> bool:
    names = [name for name in os.listdir(path) if not name.startswith(".")]
    if "depth.txt" in names or any(name.startswith("depth_") and name.endswith(".png") for name in names):
        return True
    if "metadata.yaml" in names and any(name.endswith((".mcap", ".db3")) for name in names):
        return True
    return bool(names) and all(name.lower().endswith(CLOUD_SUFFIXES) and not name.endswith(_TRUTH) for name in names)


def _matches(pattern: str) -> tuple[Path, list[Path]]:
    """The folder before the first wildcard, and what the pattern matches; paths are absolute."""
    # A folder is searched anyway, with no need to look at each file in its recordings.
    literal = Path(os.path.abspath(re.sub(r"(/\*\*)+/?$", "", pattern) or "/"))
    if os.path.lexists(literal):
        is_searched = literal.is_dir() and not is_recording(literal)
        return (literal if is_searched else literal.parent), [literal]
    parts = literal.parts
    first = next((place for place, part in enumerate(parts) if glob.has_magic(part)), len(parts))
    return Path(*parts[:first]), [Path(match) for match in glob.iglob(str(literal), recursive=True)]
