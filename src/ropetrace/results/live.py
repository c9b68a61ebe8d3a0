"""The viewer in a window of its own, while the rope is being tracked."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Mapping, Sequence

from ropetrace.errors import OutputError
from ropetrace.results.base import Closing
from ropetrace.types import Cloud, Estimate, FloatArray, Frame
from ropetrace.viewer import NO_METADATA, ArmView, RerunLog, default_blueprint, new_recording

START_SECONDS = 20.0
"""How long the app may take until it listens."""

SEND_SECONDS = 5.0
"""How long the app may take for one frame before the next one is tried."""

CLOSE_SECONDS = 10.0
"""How long the app may take to accept the end of the run."""

SETTLE_SECONDS = 0.7
"""How long the app must have listened to be taken for started."""

MEMORY_LIMIT = "2GB"
"""When the pictures take more than this, the app drops the oldest."""

HINT = "write the pictures to a file instead (--out run.rrd) and open it where there is a screen (rerun run.rrd)"


class LiveViewer(Closing):
    """Shows the latest estimate in the Rerun viewer; a `ResultWriter` that never makes its caller wait.

    `write` puts the estimate into a slot, beside those of other ropes in the same frame, and returns. A thread takes
    them from there; what is still in the slot when the next frame comes is skipped. The app listens on 127.0.0.1 only.

    Parameters
    ----------
    frame_name, frame_from_camera, metadata
        As for `ropetrace.viewer.RerunLog`.
    arguments : sequence of str
        More arguments for the app, such as ``--headless``.
    arm : bool
        Whether an arm will be shown.

    Attributes
    ----------
    skipped : int
        Frames that were not shown so far, or not with all their ropes.
    port : int
        Where the app listens.

    Raises
    ------
    OutputError
        If the app does not start: most often, for want of a screen.
    """

    def __init__(
        self,
        *,
        frame_name: str = "camera",
        frame_from_camera: FloatArray | None = None,
        metadata: Mapping[str, str] = NO_METADATA,
        arguments: Sequence[str] = (),
        arm: bool = False,
    ) -> None:
        self.skipped = 0
        self._slot: list[tuple[int, Estimate, Frame | None, Cloud | None, ArmView | None]] = []
        self._changed = threading.Condition()
        self._stopping = False
        self._app, self.port = _start_app(arguments)
        self._recording = new_recording()
        address = f"rerun+http://127.0.0.1:{self.port}/proxy"
        self._recording.connect_grpc(address, default_blueprint=default_blueprint(arm))
        self._log = RerunLog(
            self._recording, frame_name=frame_name, frame_from_camera=frame_from_camera, metadata=metadata
        )
        self._thread = threading.Thread(target=self._feed, name="viewer", daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether the window is open and being fed."""
        return self._thread.is_alive() and self._app.poll() is None

    def write(
        self,
        index: int,
        estimate: Estimate,
        frame: Frame | None = None,
        cloud: Cloud | None = None,
        arm: ArmView | None = None,
    ) -> None:
        with self._changed:
            if not self._slot or self._slot[0][0] != index:
                self.skipped += bool(self._slot) or not self._thread.is_alive()
                self._slot = []
            self._slot.append((index, estimate, frame, cloud, arm))
            self._changed.notify()

    def close(self, *, keep_window: bool = True) -> None:
        """Show the last frame and stop; a second call does nothing.

        Parameters
        ----------
        keep_window : bool
            Whether the window stays until its user closes it.
        """
        with self._changed:
            self._stopping = True
            self._changed.notify()
        self._thread.join(CLOSE_SECONDS)
        if self._thread.is_alive() or not keep_window:
            # An app that hangs holds up everything that speaks to it, the end of this process too.
            _stop_app(self._app)
            self._thread.join()

    def _feed(self) -> None:
        """Hand frames to the app, one at a time, until `close` or until the app has ended."""
        warned = False
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._slot or self._stopping)
                slot, self._slot = self._slot, []
            if not slot or self._app.poll() is not None:
                break
            try:
                for shown in slot:
                    self._log.log(*shown)
                self._recording.flush(timeout_sec=SEND_SECONDS)
            except Exception as error:
                # Whatever is wrong with a picture must not stop the tracking.
                with self._changed:
                    self.skipped += 1
                if self._app.poll() is None and not warned:
                    warned = True
                    warnings.warn(f"the viewer misses frames: {error}", RuntimeWarning, stacklevel=2)
        self._recording.disconnect()


def _start_app(arguments: Sequence[str]) -> tuple[subprocess.Popen[bytes], int]:
    """Start the app and wait until it listens; its process and its port."""
    screens = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
    if sys.platform == "linux" and not any(map(os.environ.get, screens)) and "--headless" not in arguments:
        raise OutputError(f"there is no screen for the viewer: {HINT}")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    # Without --bind the app listens on every network.
    command = [sys.executable, "-m", "rerun_cli", "--bind", "127.0.0.1", "--port", str(port)]
    with tempfile.TemporaryFile() as messages:
        app = subprocess.Popen(
            [*command, "--hide-welcome-screen", "--memory-limit", MEMORY_LIMIT, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=messages,
            stderr=messages,
            # Ctrl-C in the terminal ends the tracking; the window stays.
            start_new_session=True,
        )
        try:
            _wait_for_app(app, port)
        except TimeoutError:
            _stop_app(app)
            messages.seek(0)
            lines = [line for line in messages.read().decode(errors="replace").splitlines() if line.strip()]
            reason = next((line for line in lines if "Error" in line), lines[-1] if lines else "no message")
            raise OutputError(f"the viewer did not start ({reason.strip()}): {HINT}") from None
        except BaseException:
            _stop_app(app)
            raise
    return app, port


def _wait_for_app(app: subprocess.Popen[bytes], port: int) -> None:
    """Return once the app has listened for `SETTLE_SECONDS`; a TimeoutError if it ends or never does."""
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline and app.poll() is None:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 0.2):
            # It listens before it opens its window, and ends if it cannot.
            with contextlib.suppress(subprocess.TimeoutExpired):
                app.wait(SETTLE_SECONDS)
                break
            return
        time.sleep(0.05)
    raise TimeoutError


def _stop_app(app: subprocess.Popen[bytes]) -> None:
    """End the app and what it started."""
    if app.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(app.pid, signal.SIGKILL)
        app.wait()
