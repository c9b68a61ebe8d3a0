"""Processes that work on one thing at a time, each of which may die or hang without the others.

The process pool of the standard library serves where nothing may die: a process that dies there ends all others, and
nobody is told on what it worked.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import connection
from types import TracebackType
from typing import Any, Self

from ropetrace.errors import RopetraceError
from ropetrace.evaluation.runner import end_with_parent, without_interrupt

LONGEST_SILENCE = 120.0
"""A process that starts or works on a frame for longer hangs, seconds. The first frame may have to be compiled for."""

_LONGEST_LOOK = 5.0
"""Of the time between two looks at a process, so much counts as its silence, seconds: both may have been stopped, as by
Ctrl-Z."""

_TELL_EVERY = 1.0
"""Seconds between two signs of life at least, so that nobody is kept busy by them."""

_THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_CONTEXT = multiprocessing.get_context("spawn")
"""Not forked: a fork of a process with threads can hang."""


class WorkerLostError(Exception):
    """A process died, or was ended since it hung."""


class Worker:
    """A process of one thread that calls a function at a time."""

    def __init__(self) -> None:
        self.pipe, theirs = _CONTEXT.Pipe()
        self._process = _CONTEXT.Process(target=_serve, args=(theirs,), daemon=True)
        with _one_thread(), without_interrupt():
            self._process.start()
        theirs.close()
        self._answer: Any = None
        self._looked = 0.0
        self._silence = 0.0
        self._before_first = 0.0

    def begin(self, function: Callable[..., Any], *arguments: Any, before_first: float = 0.0) -> None:
        """Have a function called with these arguments and `on_frame`, which it is to call as a sign of life.

        Before the first such sign it may be silent for `before_first` seconds longer than later.
        """
        self._answer = None
        self._silence, self._looked = 0.0, time.monotonic()
        self._before_first = before_first
        with suppress(OSError):  # `is_done` sees that it died
            self.pipe.send((function, arguments))

    @property
    def is_done(self) -> bool:
        """Whether the call has ended, or the process is lost. To be asked again and again."""
        now = time.monotonic()
        self._silence += min(now - self._looked, _LONGEST_LOOK)
        self._looked = now
        try:
            while self._answer is None and self.pipe.poll():
                self._answer = self.pipe.recv()
                self._silence = self._before_first = 0.0
        except (OSError, EOFError):
            self._process.join(1)
            self._answer = WorkerLostError(f"its process was killed ({self._end()})")
        patience = LONGEST_SILENCE + self._before_first
        if self._answer is None and self._silence > patience:
            self._answer = WorkerLostError(f"it hung: no frame was finished for {patience:.0f} s")
        return self._answer is not None

    def result(self) -> Any:
        """What the function returned.

        Raises
        ------
        RopetraceError
            If it raised something.
        WorkerLostError
            If the process is lost.
        """
        if isinstance(self._answer, Exception):
            raise self._answer
        return self._answer

    @property
    def is_lost(self) -> bool:
        """Whether it takes no further calls."""
        return isinstance(self._answer, WorkerLostError)

    def kill(self) -> None:
        """End the process, whatever it does."""
        self._process.kill()
        self._process.join()
        self.pipe.close()

    def _end(self) -> str:
        code = self._process.exitcode
        return signal.Signals(-code).name if code is not None and code < 0 else f"exit code {code}"


class Workers:
    """At most so many processes, which are started when they are needed and end with the block.

    Parameters
    ----------
    most : int
        How many.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._idle: list[Worker] = []
        self._all: list[Worker] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for worker in self._all:
            worker.kill()

    def idle(self) -> Worker | None:
        """One that does nothing; None if all are at work."""
        if not self._idle:
            if len(self._all) == self._most:
                return None
            self._all.append(Worker())
            return self._all[-1]
        return self._idle.pop()

    def wait(self, working: Collection[Worker]) -> list[Worker]:
        """Those of the working that are done, after a second at the latest; they are idle then, or killed."""
        connection.wait([worker.pipe for worker in working], timeout=1)
        done = [worker for worker in working if worker.is_done]
        for worker in done:
            if worker.is_lost:
                worker.kill()
                self._all.remove(worker)
            else:
                self._idle.append(worker)
        return done


def _serve(pipe: Any) -> None:
    """What the process does: call a function, send what comes of it, and so on."""
    end_with_parent()
    told = 0.0

    def on_frame() -> None:
        nonlocal told
        if time.monotonic() - told > _TELL_EVERY:
            told = time.monotonic()
            pipe.send(None)

    while True:
        function, arguments = pipe.recv()
        try:
            answer = function(*arguments, on_frame)
        except RopetraceError as error:
            answer = error
        except Exception as error:
            answer = RopetraceError(f"a run failed ({type(error).__name__}: {error}); the finished ones are kept")
        pipe.send(answer)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Processes that are started in the block use one thread."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
