"""The live view that browsers open: Rerun's own servers in a process of their own, behind one gate."""

from __future__ import annotations

import contextlib
import ctypes
import secrets
import signal
import socket
import sys
import time
from pathlib import Path

from ropetrace.errors import OutputError, import_extra
from ropetrace.results.base import Closing
from ropetrace.results.feed import Address, Feed, start_rerun, stop_rerun
from ropetrace.serving_gate import Gate
from ropetrace.types import Cloud, Estimate, FloatArray, Frame
from ropetrace.viewer import RerunLog, default_blueprint, new_recording

MEMORY_LIMIT = "16MiB"
"""What Rerun keeps for browsers that come later; then it drops the oldest. A browser loads it all when it is opened."""

FLUSH_SECONDS = 0.1
"""What is logged in this time goes to the browsers together: they take few large pieces better than many small ones."""

CLOSE_SECONDS = 5.0
"""How long Rerun may take to accept the end of the run."""


class ViewServer(Closing):
    """Serves the latest estimates to browsers; a `ResultWriter` that never makes its caller wait.

    Frames that come faster than they can be shown are skipped: see `ropetrace.results.feed.Feed`.

    Parameters
    ----------
    host, port
        As for `ropetrace.listening.Door`.
    frame_name, frame_from_camera
        As for `ropetrace.viewer.RerunLog`.

    Attributes
    ----------
    url : str
        What people open.
    open_to_others : bool
        Whether other machines may get in.

    Raises
    ------
    ConfigError
        If this machine has no such address.
    OutputError
        If the port is taken, or Rerun does not start.
    """

    def __init__(
        self, host: str, port: int, *, frame_name: str = "camera", frame_from_camera: FloatArray | None = None
    ) -> None:
        with contextlib.ExitStack() as undo:
            self._gate = Gate(host, port)
            undo.callback(self._gate.close)
            self._rerun = _Rerun()
            undo.callback(self._rerun.end)
            self._gate.open(self._rerun.page, self._rerun.stream)
            recording = new_recording(FLUSH_SECONDS)
            address, stream_port = self._rerun.stream
            recording.connect_grpc(f"rerun+http://{address}:{stream_port}/proxy", default_blueprint=default_blueprint())
            log = RerunLog(recording, frame_name=frame_name, frame_from_camera=frame_from_camera, live=True)
            self._feed = Feed("view", recording, log.log, lambda: self.problem is None, FLUSH_SECONDS)
            undo.pop_all()
        self.url, self.open_to_others = self._gate.door.url, self._gate.door.open_to_others

    @property
    def skipped(self) -> int:
        """Frames that were not shown so far, or not with all their ropes, while Rerun was there."""
        return self._feed.skipped

    @property
    def problem(self) -> str | None:
        """Why nothing is served any more, if that is so."""
        return self._rerun.problem

    def write(self, index: int, estimate: Estimate, frame: Frame | None = None, cloud: Cloud | None = None) -> None:
        self._feed.write(index, estimate, frame, cloud)

    def wait(self) -> None:
        """Wait until nothing is served any more."""
        while self.problem is None:
            time.sleep(0.1)

    def close(self) -> None:
        """Cut the browsers off and end Rerun; a second call does nothing."""
        with contextlib.ExitStack() as whatever_happens:
            whatever_happens.callback(self._gate.close)
            whatever_happens.callback(self._feed.stop)
            # A server that hangs holds up everything that speaks to it, the end of this process too.
            whatever_happens.callback(self._rerun.end)
            self._feed.stop(CLOSE_SECONDS)


class _Rerun:
    """Rerun's servers of the page and of the pictures, at an address of loopback that nobody else uses.

    The SDK's own `serve_grpc` and `serve_web_viewer` listen on every network.
    """

    def __init__(self) -> None:
        folder = Path(str(import_extra("rerun_cli", "viewer").__file__)).parent
        program = next(filter(Path.exists, (folder / "rerun", folder / "Rerun.app/Contents/MacOS/Rerun")), None)
        if program is None:
            raise OutputError(f"{folder}: the program rerun is not there: pip install --force-reinstall rerun-sdk")
        # A page that was let in by a wrong name cannot guess where this is.
        host = f"127.{'.'.join(str(secrets.randbelow(254) + 1) for _ in range(3))}" if _LINUX else "127.0.0.1"
        self.page, self.stream = _free_addresses(host)
        command = [str(program), "--serve-web", "--bind", host, "--server-memory-limit", MEMORY_LIMIT]
        command += ["--port", str(self.stream[1]), "--web-viewer-port", str(self.page[1])]
        # It calls one function of the kernel, so that other threads do not matter.
        before = _die_with_parent if _LINUX else None
        self._process = start_rerun(command, (self.page, self.stream), name="view", before=before)

    @property
    def problem(self) -> str | None:
        code = self._process.poll()
        if code is None:
            return None
        # Who is killed for want of memory could say nothing of it; what it said before is about something else.
        words = "" if code == -signal.SIGKILL else self._process.trouble
        return f"the view has ended: rerun stopped with code {code}" + (f" ({words})" if words else "")

    def end(self) -> None:
        stop_rerun(self._process)


_LINUX = sys.platform == "linux"
_LIBC = ctypes.CDLL(None) if _LINUX else None
_PR_SET_PDEATHSIG = 1


def _die_with_parent() -> None:
    """In the child: be killed when the thread that started it is, so that no kill leaves Rerun behind."""
    assert _LIBC is not None
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _free_addresses(host: str) -> tuple[Address, Address]:
    """Two ports of an address on which nothing listens."""
    with socket.socket() as one, socket.socket() as other:
        for probe in (one, other):
            probe.bind((host, 0))
        return (host, int(one.getsockname()[1])), (host, int(other.getsockname()[1]))
