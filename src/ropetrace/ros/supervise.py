"""Nodes as processes: started, started again, and ended together."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable

from ropetrace.ros.saying import say
from ropetrace.terminal import BAD_INPUT, on_endings

RESTART_AFTER = 1.0
"""Seconds."""

LONGEST_END = 10.0
"""A node that has not ended by itself after this long is killed, seconds."""

ROUTER = "router"
"""The node that ends last: what the others say while they end may go through it."""

_SUPERVISOR = "ROPETRACE_SUPERVISOR"
"""The process with whose end a node ends, in its environment."""

_PR_SET_PDEATHSIG = 1


def told_to_stop() -> Callable[[], bool]:
    """Whether an end was asked for, as by Ctrl-C: a loop ends where it chooses, not in the middle of a message."""
    stop = threading.Event()
    on_endings(lambda *_: stop.set())
    return stop.is_set


def supervise(commands: dict[str, list[str]], should_stop: Callable[[], bool]) -> int:
    """Run the nodes until told to stop; one that ends is started again, unless what it was told is wrong.

    Each is a process group of its own: Ctrl-C comes here alone, and to none that is still starting. Each ends when this
    process does, however that comes about: see `end_with_supervisor`.

    Parameters
    ----------
    commands : dict of str to list of str
        What each node is told, by its name.
    should_stop : callable
        Whether to end.

    Returns
    -------
    int
        The exit code.
    """
    running: dict[str, subprocess.Popen[bytes]] = {}
    due = dict.fromkeys(commands, 0.0)
    environment = {**os.environ, _SUPERVISOR: str(os.getpid())}
    try:
        while not should_stop():
            for name, flags in commands.items():
                if name not in running and time.monotonic() >= due[name]:
                    command = [sys.executable, "-m", "ropetrace", "node", name, *flags]
                    running[name] = subprocess.Popen(command, process_group=0, env=environment)
            for name, process in list(running.items()):
                code = process.poll()
                if code is None or should_stop():
                    continue
                if code == BAD_INPUT:
                    return BAD_INPUT
                say(f"all: {name} ended with code {code}: it is started again")
                del running[name]
                due[name] = time.monotonic() + RESTART_AFTER
            time.sleep(0.1)
        return 0
    finally:
        end_all(running)


def end_with_supervisor() -> None:
    """Let this process be asked to end, as by `kill`, when the supervisor that started it ends, if one did.

    The kernel does it, so that it happens even where the supervisor is killed with SIGKILL; Linux only.
    """
    supervisor = os.environ.pop(_SUPERVISOR, None)
    if supervisor is None or sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if str(os.getppid()) != supervisor:
        # It ended before the kernel was told.
        raise SystemExit(128 + signal.SIGTERM)


def end_all(running: dict[str, subprocess.Popen[bytes]]) -> None:
    """End the nodes, by their names: all others first, and then the router."""
    _end([process for name, process in running.items() if name != ROUTER])
    _end([process for name, process in running.items() if name == ROUTER])


def _end(processes: list[subprocess.Popen[bytes]]) -> None:
    """Ask all to end, and wait."""
    for process in processes:
        process.terminate()
    end = time.monotonic() + LONGEST_END
    for process in processes:
        try:
            process.wait(max(end - time.monotonic(), 0.1))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
