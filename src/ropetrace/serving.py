"""The live view that browsers open: Rerun's own servers in a process of their own, behind one gate."""

from __future__ import annotations

import contextlib
import ctypes
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

from ropetrace.errors import OutputError, import_extra
from ropetrace.results.base import Closing
from ropetrace.serving_gate import Address, Gate
from ropetrace.types import Cloud, Estimate, FloatArray, Frame
from ropetrace.viewer import RerunLog, default_blueprint, new_recording

MEMORY_LIMIT = "16MiB"
"""What Rerun keeps for browsers that come later; then it drops the oldest. A browser loads it all when it is opened."""

START_SECONDS = 20.0
"""How long Rerun may take until it listens."""

SEND_SECONDS = 5.0
"""How long Rerun may take for one frame before the next one is tried."""

FLUSH_SECONDS = 0.1
"""What is logged in this time goes to the browsers together: they take few large pieces better than many small ones."""

CLOSE_SECONDS = 5.0
"""How long Rerun may take to accept the end of the run."""


class ViewServer(Closing):
    """Serves the latest estimates to browsers; a `ResultWriter` that never makes its caller wait.

    `write` puts the estimate into a slot, beside those of other ropes in the same frame, and returns. A thread takes
    them from there; what is still in the slot when the next frame comes is skipped.

    Parameters
    ----------
    host, port
        As for `ropetrace.serving_gate.Gate`.
    frame_name, frame_from_camera
        As for `ropetrace.viewer.RerunLog`.

    Attributes
    ----------
    url : str
        What people open.
    open_to_others : bool
        Whether other machines may get in.
    skipped : int
        Frames that were not shown so far, or not with all their ropes.

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
        self.skipped = 0
        self._slot: list[tuple[int, Estimate, Frame | None, Cloud | None]] = []
        self._changed = threading.Condition()
        self._stopping = False
        with contextlib.ExitStack() as undo:
            self._gate = Gate(host, port)
            undo.callback(self._gate.close)
            self._rerun = _Rerun()
            undo.callback(self._rerun.end)
            self._gate.open(self._rerun.page, self._rerun.stream)
            undo.pop_all()
        self.url, self.open_to_others = self._gate.url, bool(self._gate.key)
        self._recording = new_recording(FLUSH_SECONDS)
        address, stream_port = self._rerun.stream
        self._recording.connect_grpc(
            f"rerun+http://{address}:{stream_port}/proxy", default_blueprint=default_blueprint()
        )
        self._log = RerunLog(self._recording, frame_name=frame_name, frame_from_camera=frame_from_camera, live=True)
        self._thread = threading.Thread(target=self._feed, name="view", daemon=True)
        self._thread.start()

    @property
    def problem(self) -> str | None:
        """Why nothing is served any more, if that is so."""
        return self._rerun.problem

    def write(self, index: int, estimate: Estimate, frame: Frame | None = None, cloud: Cloud | None = None) -> None:
        with self._changed:
            if not self._slot or self._slot[0][0] != index:
                self.skipped += bool(self._slot) or not self._thread.is_alive()
                self._slot = []
            self._slot.append((index, estimate, frame, cloud))
            self._changed.notify()

    def wait(self, until: Callable[[], bool]) -> None:
        """Wait until nothing is served any more, or `until` is true."""
        while self.problem is None and not until():
            time.sleep(0.1)

    def close(self) -> None:
        """Cut the browsers off and end Rerun; a second call does nothing."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        self._thread.join(CLOSE_SECONDS)
        # A server that hangs holds up everything that speaks to it, the end of this process too.
        self._rerun.end()
        self._thread.join()
        self._gate.close()

    def _feed(self) -> None:
        """Hand frames to Rerun, one at a time, until `close` or until it has ended."""
        flushed = time.monotonic()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._slot or self._stopping)
                slot, self._slot = self._slot, []
            if not slot or self.problem is not None:
                break
            try:
                for shown in slot:
                    self._log.log(*shown)
                if time.monotonic() - flushed >= FLUSH_SECONDS:
                    self._recording.flush(timeout_sec=SEND_SECONDS)
                    flushed = time.monotonic()
            except Exception:
                # Whatever is wrong with a picture must not stop the tracking.
                with self._changed:
                    self.skipped += 1
        self._recording.disconnect()


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
        with tempfile.TemporaryFile() as messages:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=messages,
                stderr=messages,
                # Ctrl-C in the terminal is for us.
                start_new_session=True,
                # It calls one function of the kernel, so that other threads do not matter.
                preexec_fn=_die_with_parent if _LINUX else None,  # noqa: PLW1509
            )
            try:
                self._wait()
            except TimeoutError:
                self.end()
                messages.seek(0)
                lines = [line for line in messages.read().decode(errors="replace").splitlines() if line.strip()]
                raise OutputError(f"the view did not start ({lines[-1].strip() if lines else 'no message'})") from None
            except BaseException:
                self.end()
                raise

    @property
    def problem(self) -> str | None:
        code = self._process.poll()
        return None if code is None else f"the view has ended: rerun stopped with code {code}"

    def end(self) -> None:
        self._process.kill()
        self._process.wait()

    def _wait(self) -> None:
        """Return once both listen; a TimeoutError if it ends or never does."""
        deadline = time.monotonic() + START_SECONDS
        while time.monotonic() < deadline and self._process.poll() is None:
            with (
                contextlib.suppress(OSError),
                socket.create_connection(self.page, 0.2),
                socket.create_connection(self.stream, 0.2),
            ):
                return
            time.sleep(0.02)
        raise TimeoutError


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
