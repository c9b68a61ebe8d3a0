"""Finds the recordings among files and folders, without opening any."""

from __future__ import annotations

import glob
import os
import re
from collections import deque
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
    unreadable : tuple of str
        Folders that could not be searched, and why: a sentence each.
    """

    root: Path
    recordings: dict[str, Path]
    unreadable: tuple[str, ...] = ()


def find_recordings(patterns: Sequence[str], left_out: Path) -> Found:
    """The recordings that patterns such as ``recordings/**`` match, each once.

    A folder that is a recording counts as one, and nothing in it is another. A folder that is none is searched. Of ROS
    files in a folder each is a recording, unless there is a ``metadata.yaml`` that makes them one.

    Parameters
    ----------
    patterns : sequence of str
        Paths, or patterns as `glob` has them. A single file is taken whatever it is.
    left_out : Path
        A folder of which nothing is taken: that of the results.

    Raises
    ------
    RecordingError
        If a pattern matches no recording, or is empty.
    """
    search = _Search(left_out)
    bases = []
    for pattern in patterns:
        if not pattern:
            raise RecordingError("an empty pattern names no recording: give a file, a folder or a pattern")
        base, matches = _matches(pattern)
        if not search.add(matches):
            left = f"; the folder of results, {left_out}, is left out" if search.has_left_out else ""
            raise RecordingError("; ".join([f"{pattern}: no recording is there{left}", *search.unreadable]))
        bases.append(base)
    root = Path(os.path.commonpath(bases))
    names = sorted((path.relative_to(root).as_posix() for path in search.found.values()), key=natural_key)
    return Found(root, {name: root / name for name in names}, tuple(search.unreadable))


class _Search:
    """What was found so far.

    Attributes
    ----------
    found : dict of Path to Path
        Recordings as they were given, by where they really are.
    unreadable : list of str
        Folders that could not be searched, and why.
    has_left_out : bool
        Whether anything was left out that was asked for.
    """

    def __init__(self, left_out: Path) -> None:
        self.found: dict[Path, Path] = {}
        self.unreadable: list[str] = []
        self.has_left_out = False
        self._left_out = _real(left_out)
        self._seen: set[Path] = set()

    def add(self, matches: Sequence[Path]) -> bool:
        """Search some paths; whether any recording, be it a known one, is there.

        What is reached by a link comes last: the name of a recording must not depend on where a link, such as
        ``current``, points today.
        """
        if len(matches) == 1 and os.path.isfile(matches[0]):
            self._take(matches[0])
        links_in = {match: sum(map(os.path.islink, (match, *match.parents))) for match in matches}
        fewest = min(links_in.values(), default=0)
        near = sorted(matches, key=lambda match: (links_in[match], len(match.parts)))
        paths = deque(match for match in near if links_in[match] == fewest)
        links = deque(match for match in near if links_in[match] > fewest)
        while paths or links:
            self._look(paths.popleft() if paths else links.popleft(), paths, links)
        places = set(self.found).union(*(place.parents for place in self.found))
        return any(_real(match) in places or self._is_known(_real(match)) for match in matches)

    def _look(self, path: Path, paths: deque[Path], links: deque[Path]) -> None:
        """Take a recording, or add what is in a folder to what is to be searched."""
        real = _real(path)
        if real in self._seen:
            return
        self._seen.add(real)
        if is_recording(path):
            self._take(path)
        elif not self._is_known(real) and not self._is_left_out(real) and os.path.isdir(path):
            try:
                names = sorted(os.listdir(path))
            except OSError as error:
                self.unreadable.append(f"{path}: cannot be searched: {error.strerror}")
                return
            for inner in (path / name for name in names if not name.startswith(".")):
                (links if os.path.islink(inner) else paths).append(inner)

    def _take(self, path: Path) -> None:
        real = _real(path)
        if not self._is_known(real) and not self._is_left_out(real):
            self.found[real] = path

    def _is_left_out(self, real: Path) -> bool:
        is_left_out = self._left_out in (real, *real.parents)
        self.has_left_out |= is_left_out
        return is_left_out

    def _is_known(self, real: Path) -> bool:
        """Whether it is a recording that was found, or lies in one."""
        return real in self.found or any(parent in self.found for parent in real.parents)


def _real(path: Path) -> Path:
    """Where a path really is; unlike `Path.resolve` this takes links that go round in a circle."""
    return Path(os.path.realpath(path))


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
        is_searched = os.path.isdir(literal) and not is_recording(literal)
        return (literal if is_searched else literal.parent), [literal]
    parts = literal.parts
    first = next((place for place, part in enumerate(parts) if glob.has_magic(part)), len(parts))
    return Path(*parts[:first]), [Path(match) for match in glob.iglob(str(literal), recursive=True)]
