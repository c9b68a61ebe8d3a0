"""The viewer in a window of its own, while the rope is being tracked."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
from collections.abc import Mapping, Sequence

from ropetrace.errors import OutputError
from ropetrace.results import NO_METADATA
from ropetrace.results.base import Closing
from ropetrace.results.feed import Feed, RerunProcess, start_rerun, stop_rerun
from ropetrace.types import Cloud, Estimate, FloatArray, Frame
from ropetrace.viewer import ArmView, RerunLog, default_blueprint, new_recording

CLOSE_SECONDS = 10.0
"""How long the app may take to accept the end of the run."""

SETTLE_SECONDS = 0.7
"""How long the app must have listened to be taken for started: it listens before it opens its window, and ends if it
cannot."""

MEMORY_LIMIT = "2GB"
"""When the pictures take more than this, the app drops the oldest."""

HINT = "write the pictures to a file instead (--out run.rrd) and open it where there is a screen (rerun run.rrd)"


class LiveViewer(Closing):
    """Shows the latest estimate in the Rerun viewer; a `ResultWriter` that never makes its caller wait.

    Frames that come faster than they can be shown are skipped: see `ropetrace.results.feed.Feed`. The app listens on
    127.0.0.1 only.

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
        self._app, self.port = _start_app(arguments)
        with contextlib.ExitStack() as undo:
            undo.callback(stop_rerun, self._app)
            recording = new_recording()
            address = f"rerun+http://127.0.0.1:{self.port}/proxy"
            recording.connect_grpc(address, default_blueprint=default_blueprint(arm))
            log = RerunLog(recording, frame_name=frame_name, frame_from_camera=frame_from_camera, metadata=metadata)
            self._feed = Feed("viewer", recording, log.log, lambda: self._app.poll() is None)
            undo.pop_all()

    @property
    def skipped(self) -> int:
        """Frames that were not shown so far, or not with all their ropes, while the window was open."""
        return self._feed.skipped

    @property
    def running(self) -> bool:
        """Whether the window is open and being fed."""
        return self._feed.running and self._app.poll() is None

    def write(
        self,
        index: int,
        estimate: Estimate,
        frame: Frame | None = None,
        cloud: Cloud | None = None,
        arm: ArmView | None = None,
    ) -> None:
        self._feed.write(index, estimate, frame, cloud, arm)

    def close(self, *, keep_window: bool = True) -> None:
        """Show the last frame and stop; a second call does nothing.

        Parameters
        ----------
        keep_window : bool
            Whether the window stays until its user closes it.
        """
        try:
            self._feed.stop(CLOSE_SECONDS)
        finally:
            if self._feed.running or not keep_window:
                # An app that hangs holds up everything that speaks to it, the end of this process too.
                stop_rerun(self._app)
                self._feed.stop()


def _start_app(arguments: Sequence[str]) -> tuple[RerunProcess, int]:
    """Start the app and wait until it listens; its process and its port."""
    screens = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
    if sys.platform == "linux" and not any(map(os.environ.get, screens)) and "--headless" not in arguments:
        raise OutputError(f"there is no screen for the viewer: {HINT}")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    # Without --bind the app listens on every network.
    command = [sys.executable, "-m", "rerun_cli", "--bind", "127.0.0.1", "--port", str(port)]
    command += ["--hide-welcome-screen", "--memory-limit", MEMORY_LIMIT, *arguments]
    try:
        return start_rerun(command, [("127.0.0.1", port)], name="viewer", settle_seconds=SETTLE_SECONDS), port
    except OutputError as error:
        raise OutputError(f"{error}: {HINT}") from None
