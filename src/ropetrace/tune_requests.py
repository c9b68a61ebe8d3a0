"""What a page of `ropetrace tune` may ask for, and what is done then."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from ropetrace.errors import ConfigError
from ropetrace.evaluation.run_folder import replace_file
from ropetrace.tune_board import Answer, Board
from ropetrace.tune_look import Look
from ropetrace.tuning import Tuning


class SavedSettings:
    """The file in which settings are saved.

    Parameters
    ----------
    path : Path
        It need not be there.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._written: bytes | None = None

    @property
    def was_saved(self) -> bool:
        """Whether `save` has written it."""
        return self._written is not None

    def is_of_others(self) -> bool:
        """Whether there is a file that is not what was saved last."""
        try:
            return self.path.read_bytes() != self._written
        except FileNotFoundError:
            return False
        except OSError:
            return self.path.exists()

    def save(self, text: str) -> None:
        """Write settings, whole or not at all.

        Raises
        ------
        OutputError
            If they cannot be written.
        """
        content = f"# ropetrace {version('ropetrace')}, tuned by eye\n{text}".encode()
        replace_file(self.path, content)
        self._written = content


class Requests:
    """Does what pages ask for, one thing after the other.

    Parameters
    ----------
    board : Board
        What they are shown.
    file : SavedSettings
        The only one that they can write.
    """

    def __init__(self, board: Board, file: SavedSettings) -> None:
        self._board = board
        self._file = file
        self._acting = threading.Lock()

    def do(self, asked: Mapping[str, Any], sent: tuple[Look, ...]) -> Answer:
        """Do one thing.

        Parameters
        ----------
        asked : mapping
            What a page says, as it came.
        sent : tuple of Look
            What it may show.

        Raises
        ------
        RopetraceError
            If it cannot be done.
        ValueError, TypeError, KeyError, AttributeError, OverflowError
            If it is not what a page asks for.
        """
        tuning, look = self._board.tuning, self._board.shown.look
        if tuning is None or look is None:
            raise ConfigError("the source is not open yet")
        with self._acting:
            match asked["do"]:
                case "click":
                    event = next((each.event for each in sent if each.index == asked["index"]), None)
                    return Answer(tuning.click(int(asked["column"]), int(asked["row"]), event))
                case "measure":
                    return Answer(tuning.measure())
                case "box":
                    tuning.put_box_round(look.cloud.points)
                case "set":
                    tuning.change(asked["settings"])
                case "go":
                    return Answer([] if tuning.go_to(int(asked["index"])) else ["there is no such frame"])
                case "freeze":
                    tuning.frozen = bool(asked["frozen"])
                case "save":
                    return self._save(tuning, bool(asked["replace"]))
                case _:
                    raise ValueError
        return Answer()

    def _save(self, tuning: Tuning, may_replace: bool) -> Answer:
        path = self._file.path
        if not tuning.knows_diameter:
            raise ConfigError("the diameter is not known yet: click on the rope, or set it")
        if self._file.is_of_others() and not may_replace:
            trouble = f"{path} is there already: press 'replace' to write over it"
            return Answer(trouble=trouble, asks_to_replace=True)
        self._file.save(tuning.config.to_toml())
        return Answer([f"saved: ropetrace track {tuning.name} --config {path}"])
