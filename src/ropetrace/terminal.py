"""What the commands share on a terminal."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterable, Iterator
from types import FrameType, TracebackType
from typing import Any, Self

NOTHING_FOUND, BAD_INPUT, DAMAGED, INTERRUPTED = 1, 2, 3, 130
"""Exit codes: no frame gave an estimate; what was given is wrong; part of the recording was lost; after Ctrl-C."""

INTERRUPTS: list[int] = []
"""Signals that came. The exception alone is not enough: raised inside the compiler's callbacks it is swallowed."""


def progress_bar(total: int | None, unit: str) -> Any:
    """A tqdm bar with its rate, a context manager; it shows nothing when piped."""
    from tqdm import tqdm

    return tqdm(total=total, unit=unit, disable=not sys.stderr.isatty(), leave=False)


class Interruption:
    """While it is entered, Ctrl-C and SIGTERM end a run after the frame that is worked on; a second one, at once.

    The work is not broken off because an exception out of a callback of the compiler is swallowed, or becomes an error
    of the compiler's own. What asks for frames must stop when there is something in `INTERRUPTS`.
    """

    def __init__(self) -> None:
        self._is_waiting = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._end) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def ending_waits(self, frames: Iterable[Any]) -> Iterator[Any]:
        """The same frames; the wait for one is ended at once."""
        iterator = iter(frames)
        while True:
            self._is_waiting = True
            try:
                if INTERRUPTS:
                    raise KeyboardInterrupt
                frame = next(iterator)
            except StopIteration:
                return
            finally:
                self._is_waiting = False
            yield frame

    def _end(self, number: int, frame: FrameType | None) -> None:
        INTERRUPTS.append(number)
        if self._is_waiting or len(INTERRUPTS) > 1:
            raise KeyboardInterrupt
