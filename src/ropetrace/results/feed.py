"""Rerun as a process of its own, and the thread that hands it frames."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from ropetrace.errors import OutputError
from ropetrace.types import Estimate

START_SECONDS = 20.0
"""How long Rerun may take until it listens."""

SEND_SECONDS = 5.0
"""How long Rerun may take for one frame before the next one is tried."""

_KEPT_LINES = 100
"""Of what Rerun says, the newest."""

_LONGEST_LINE = 4096
"""Bytes."""

_COLORS = re.compile(r"\x1b\[[0-9;]*m")
"""What paints the words on a terminal."""

_TROUBLE = re.compile(r"\b(Error|ERROR|panicked|caught a signal)\b")
"""In the line by which Rerun tells why it ends."""

Address = tuple[str, int]


class Feed:
    """Hands the newest frame to Rerun in a thread of its own, so that `write` never makes its caller wait.

    What is written goes into a slot, beside the other ropes of the same frame; what is still in the slot when the next
    frame comes is skipped. The first picture that fails is told as a warning.

    Parameters
    ----------
    name : str
        What is fed, for people.
    recording : rerun.RecordingStream
        Is disconnected at the end.
    log : callable
        Logs one rope in one frame to the recording; takes what `write` is given.
    is_there : callable
        Whether Rerun still runs; the thread ends if it does not.
    flush_seconds : float
        How often what is logged is waited for; 0: after each frame.

    Attributes
    ----------
    skipped : int
        Frames that were not shown so far, or not with all their ropes, while Rerun was there.
    """

    def __init__(
        self,
        name: str,
        recording: Any,
        log: Callable[..., None],
        is_there: Callable[[], bool],
        flush_seconds: float = 0.0,
    ) -> None:
        self.skipped = 0
        self._name = name
        self._recording = recording
        self._log = log
        self._is_there = is_there
        self._flush_seconds = flush_seconds
        self._slot: list[tuple[Any, ...]] = []
        self._changed = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether frames are still handed on."""
        return self._thread.is_alive()

    def write(self, index: int, estimate: Estimate, *pictures: Any) -> None:
        """Show one rope in one frame, unless the next frame comes first."""
        with self._changed:
            if not self._slot or self._slot[0][0] != index:
                self.skipped += bool(self._slot) and self.running and self._is_there()
                self._slot = []
            self._slot.append((index, estimate, *pictures))
            self._changed.notify()

    def stop(self, timeout: float | None = None) -> None:
        """Show what is in the slot and end, or wait for that no longer than `timeout` seconds."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        self._thread.join(timeout)

    def _run(self) -> None:
        flushed, told = time.monotonic(), False
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._slot or self._stopping)
                slot, self._slot = self._slot, []
            if not slot or not self._is_there():
                break
            try:
                for shown in slot:
                    self._log(*shown)
                if time.monotonic() - flushed >= self._flush_seconds:
                    self._recording.flush(timeout_sec=SEND_SECONDS)
                    flushed = time.monotonic()
            except Exception as error:
                # Whatever is wrong with a picture must not stop the tracking.
                if not self._is_there():
                    continue
                with self._changed:
                    self.skipped += 1
                if not told:
                    told = True
                    warnings.warn(f"the {self._name} misses frames: {error}", RuntimeWarning, stacklevel=2)
        self._recording.disconnect()


class RerunProcess(subprocess.Popen[bytes]):
    """Rerun, in a session of its own: Ctrl-C in the terminal is for us. Its last words are kept, and no others.

    Parameters
    ----------
    command : sequence of str
        The program and its arguments.
    before : callable, optional
        Called in the child before the program; must not touch what other threads hold.
    """

    def __init__(self, command: Sequence[str], before: Callable[[], None] | None = None) -> None:
        super().__init__(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            preexec_fn=before,
        )
        self._lines: deque[str] = deque(maxlen=_KEPT_LINES)
        self._listener = threading.Thread(target=self._listen, name="words of rerun", daemon=True)
        self._listener.start()

    @property
    def last_words(self) -> str:
        """The last line that it said."""
        self._listener.join(1.0)
        return next(reversed(self._lines.copy()), "no message")

    @property
    def trouble(self) -> str:
        """The last line that tells why it ended; empty if none does."""
        self._listener.join(1.0)
        return next((line for line in reversed(self._lines.copy()) if _TROUBLE.search(line)), "")

    def _listen(self) -> None:
        """Take all that it says, so that it never waits for us."""
        assert self.stdout is not None
        with self.stdout as words:
            while piece := words.readline(_LONGEST_LINE):
                if line := _COLORS.sub("", piece.decode(errors="replace")).strip():
                    self._lines.append(line)


def start_rerun(
    command: Sequence[str],
    addresses: Sequence[Address],
    *,
    name: str,
    settle_seconds: float = 0.0,
    before: Callable[[], None] | None = None,
) -> RerunProcess:
    """Start Rerun, and return when it listens.

    Parameters
    ----------
    command, before
        As for `RerunProcess`.
    addresses : sequence of (str, int)
        Where it must listen.
    name : str
        What it is, for people.
    settle_seconds : float
        How long it must then go on to be taken for started.

    Raises
    ------
    OutputError
        If it ends, or does not listen in `START_SECONDS`; the message has its own words.
    """
    process = RerunProcess(command, before)
    try:
        _wait(process, addresses, settle_seconds)
    except TimeoutError:
        stop_rerun(process)
        raise OutputError(f"the {name} did not start ({process.trouble or process.last_words})") from None
    except BaseException:
        stop_rerun(process)
        raise
    return process


def stop_rerun(process: subprocess.Popen[bytes]) -> None:
    """Kill Rerun and what it started; a second call does nothing."""
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _wait(process: subprocess.Popen[bytes], addresses: Sequence[Address], settle_seconds: float) -> None:
    """Return once all addresses listen and nothing ends; a TimeoutError if it ends or never does."""
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline and process.poll() is None:
        with contextlib.suppress(OSError), contextlib.ExitStack() as probes:
            for address in addresses:
                probes.enter_context(socket.create_connection(address, 0.2))
            with contextlib.suppress(subprocess.TimeoutExpired):
                if settle_seconds:
                    process.wait(settle_seconds)
                    break
            return
        time.sleep(0.02)
    raise TimeoutError
