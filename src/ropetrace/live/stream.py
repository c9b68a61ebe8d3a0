"""A thread that fetches the frames of a camera, shows each to whoever wants all, and keeps only the newest."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from ropetrace.errors import RecordingError, RopetraceError
from ropetrace.live.camera import Camera, CameraGoneError, Capture
from ropetrace.recordings.base import one_line
from ropetrace.types import Event

FETCH_SECONDS = 0.1
"""How long a camera may wait for a frame before it is asked whether to stop."""

RESTART_SECONDS = 5.0
"""A camera that gives nothing for this long is let go and connected again."""

RETRY_SECONDS = 0.5
"""How often a camera that is gone is looked for."""

CLOSE_SECONDS = 5.0
"""How long a camera may take to stop; one that hangs is left to itself."""


class Stream:
    """The newest frame of a camera, which a thread fetches until `close`.

    A camera that goes away is taken up again when it returns. Any other error of the camera ends the thread, and is
    raised by `take`.

    Parameters
    ----------
    camera : Camera
        Is connected and asked for frames by the thread alone.
    on_event : callable, optional
        Is given every frame by the thread, before anybody can take it. It must be quick: the camera waits for it.

    Attributes
    ----------
    dropped : int
        Frames that were never taken, because a newer one came before.
    trouble : str
        Why the camera is gone; empty while it is there.
    """

    def __init__(self, camera: Camera, on_event: Callable[[Event], object] | None = None) -> None:
        self.dropped = 0
        self.trouble = ""
        self._camera = camera
        self._on_event = on_event
        self._changed = threading.Condition()
        self._newest: Capture | None = None
        self._failure: Exception | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
        self._thread.start()

    def take(self, timeout: float) -> Capture | None:
        """The newest frame, once; None if there is none within `timeout` seconds.

        Raises
        ------
        RopetraceError
            If the camera failed.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or self._failure is not None, timeout)
            newest, self._newest = self._newest, None
            failure = self._failure
        if newest is not None or failure is None:
            return newest
        if isinstance(failure, RopetraceError):
            raise failure
        raise RecordingError(
            f"the {self._camera.kind} failed: {type(failure).__name__}: {one_line(failure)}"
        ) from failure

    def close(self) -> bool:
        """Stop the camera and join the thread; False if the camera hangs. A second call does nothing."""
        self._stopping.set()
        self._thread.join(CLOSE_SECONDS)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._camera.connect()
            self._fetch_while_there()
            while self._has_returned():
                self._fetch_while_there()
        except Exception as error:
            with self._changed:
                self._failure = error
                self._changed.notify()

    def _fetch_while_there(self) -> None:
        """Until the camera gives no frames any more, or is to stop; then let it go."""
        since = time.monotonic()
        try:
            while not self._stopping.is_set() and time.monotonic() - since < RESTART_SECONDS:
                capture = self._camera.fetch(FETCH_SECONDS)
                if capture is not None and not self._stopping.is_set():
                    since = time.monotonic()
                    self._put(capture)
        except CameraGoneError as error:
            self.trouble = str(error)
        finally:
            self._camera.disconnect()

    def _has_returned(self) -> bool:
        """Connect as soon as the camera is there again; False when told to stop before."""
        while not self._stopping.wait(RETRY_SECONDS):
            try:
                self._camera.connect()
            except CameraGoneError as error:
                self.trouble = str(error)
            else:
                self.trouble = ""
                return True
        return False

    def _put(self, capture: Capture) -> None:
        if self._on_event is not None:
            self._on_event(capture.event)
        with self._changed:
            self.dropped += self._newest is not None
            self._newest = capture
            self._changed.notify()
