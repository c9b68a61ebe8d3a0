"""What all pages of `ropetrace tune` are shown, and which of their requests counts in it."""

from __future__ import annotations

import json
import threading
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from ropetrace.tune_look import Look
from ropetrace.tune_message import message_of
from ropetrace.tuning import Tuning
from ropetrace.types import BadFrame


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What is shown of a frame.

    Parameters
    ----------
    change : int
        The number of the last request that counts in it.
    look : Look, optional
        None as long as the source is not open.
    busy : str
        What is waited for.
    rate : float
        Frames a second that are looked at; 0 if that is not known.
    """

    change: int
    look: Look | None = None
    busy: str = ""
    rate: float = 0.0


@dataclass(frozen=True, slots=True)
class Answer:
    """What the last request came to: what was found, what went wrong, and whether a file is to be replaced."""

    said: list[str] = field(default_factory=list)
    trouble: str = ""
    asks_to_replace: bool = False


class Board:
    """The newest that there is to show; those who show it, and who look at it, do so in threads of their own.

    Parameters
    ----------
    out : Path
        Where the settings are saved.

    Attributes
    ----------
    news : threading.Condition
        Told of whatever changes here; held while several things are read, or changed, as one.
    tuning : Tuning, optional
        The source and its settings; None as long as it is not open.
    shown : Shown
    version : int
        Greater with each that is shown.
    change : int
        The number of the last request.
    """

    def __init__(self, out: Path) -> None:
        self.out = out
        self.news = threading.Condition()
        self.tuning: Tuning | None = None
        self.shown = Shown(0, busy="One moment")
        self.version = 1
        self.change = 0
        self._answer = Answer()
        self._encoding = threading.Lock()
        self._encoded = (0, "")

    def show(self, shown: Shown, trouble: str = "") -> None:
        """Show something, unless more requests count in what is there; `trouble` stays until the next request."""
        with self.news:
            if shown.change < self.shown.change:
                return
            self.shown = shown
            if trouble:
                self._answer = replace(self._answer, trouble=trouble)
            self.version += 1
            self.news.notify_all()

    def answer(self, answer: Answer) -> int:
        """Say what a request came to; gives its number, which is the `change` of what is shown after it."""
        with self.news:
            self._answer = answer
            self.change += 1
            if self.tuning is not None and (self.shown.busy or isinstance(self.tuning.event, BadFrame)):
                # Whoever clicks while the kernels compile, or a camera is waited for, sees at once what was found.
                self.show(replace(self.shown, change=self.change, look=self.tuning.glance()))
            self.news.notify_all()
            return self.change

    def newest(self) -> tuple[int, Shown, str]:
        """The version, what is shown, and its JSON, which is made once for all pages."""
        with self._encoding:
            with self.news:
                version, shown, answer = self.version, self.shown, self._answer
            if self._encoded[0] != version:
                self._encoded = version, json.dumps(self._state(shown, answer))
            return version, shown, self._encoded[1]

    def _state(self, shown: Shown, answer: Answer) -> dict[str, Any]:
        state = {"busy": shown.busy, "rate": shown.rate, "out": str(self.out), **asdict(answer)}
        tuning = self.tuning
        if tuning is not None:
            state |= {"source": tuning.name, "live": tuning.is_live, "frozen": tuning.frozen}
            state |= {"first": tuning.first, "end": tuning.end}
            if shown.look is not None:
                state["look"] = message_of(shown.look, tuning.is_live)
        return state
