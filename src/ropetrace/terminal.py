"""What the commands share on a terminal."""

from __future__ import annotations

import errno
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from types import FrameType, TracebackType
from typing import Any, Self

NOTHING_FOUND, BAD_INPUT, DAMAGED, INTERRUPTED = 1, 2, 3, 130
"""Exit codes: no frame gave an estimate; what was given is wrong; part of the recording was lost; after Ctrl-C."""

ENDINGS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""The signals by which a run is told to end: Ctrl-C, `kill`, and a terminal that is gone."""

INTERRUPTS: list[int] = []
"""Signals that came. The exception alone is not enough: raised inside the compiler's callbacks it is swallowed."""


def on_endings(handler: Callable[[int, FrameType | None], None]) -> dict[signal.Signals, Any]:
    """Have this called for each of `ENDINGS`, but not for the end of the terminal where that is ignored, as by `nohup`.

    Returns
    -------
    dict
        What was called before.
    """
    numbers = [number for number in ENDINGS if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN]
    return {number: signal.signal(number, handler) for number in numbers}


def interrupt(number: int, frame: FrameType | None) -> None:
    """What is called for each of `ENDINGS` where nothing else is: it ends what is done at once."""
    if _is_new(number):
        raise KeyboardInterrupt


def _is_new(number: int) -> bool:
    """Note a signal. The system and the shell both tell of a terminal that is gone: that is not a second one."""
    is_new = number != signal.SIGHUP or number not in INTERRUPTS
    if is_new:
        INTERRUPTS.append(number)
    return is_new


def is_unread(error: OSError) -> bool:
    """Whether nobody reads our output any more: they have gone, as `ropetrace info | head` does, or the terminal is."""
    return isinstance(error, BrokenPipeError) or (error.errno == errno.EIO and signal.SIGHUP in INTERRUPTS)


def progress_bar(total: int | None, unit: str) -> Any:
    """A tqdm bar with its rate, a context manager; it shows nothing when piped."""
    from tqdm import tqdm

    return tqdm(total=total, unit=unit, disable=not sys.stderr.isatty(), leave=False)


class Interruption:
    """While it is entered, `ENDINGS` end a run after the frame that is worked on; a second one, at once.

    The work is not broken off because an exception out of a callback of the compiler is swallowed, or becomes an error
    of the compiler's own. What asks for frames must stop when there is something in `INTERRUPTS`.
    """

    def __init__(self) -> None:
        self._is_waiting = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._before = on_endings(self._end)
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
        if _is_new(number) and (self._is_waiting or len(INTERRUPTS) > 1):
            raise KeyboardInterrupt
