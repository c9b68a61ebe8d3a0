"""What a camera must be able to do to be a live source."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from ropetrace.errors import RecordingError
from ropetrace.types import Event


class CameraGoneError(RecordingError):
    """A camera is not there, or gives nothing any more; it may come back."""


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """A frame of a live camera, and when it came.

    Parameters
    ----------
    event : RgbdFrame, CloudFrame or BadFrame
        Its stamp is of the camera's own clock.
    arrival_ns : int
        When it came into this program, on the clock of `time.monotonic_ns`.
    moment_ns : int, optional
        The stamp on the clock of `time.monotonic_ns`; None where the camera's clock is not known.
    """

    event: Event
    arrival_ns: int
    moment_ns: int | None = None


class Camera(Protocol):
    """A camera; all of its methods are called by one thread.

    One that knows how many frames it has lost since its first may say so in an attribute ``lost``.

    Attributes
    ----------
    kind : str
        What it is, for people.
    """

    @property
    def kind(self) -> str: ...

    def connect(self) -> None:
        """Begin to take frames; leaves nothing open if it fails.

        Raises
        ------
        CameraGoneError
            If the camera is not there.
        """

    def fetch(self, timeout: float) -> Capture | None:
        """The next frame, or None if none comes within about `timeout` seconds.

        Raises
        ------
        CameraGoneError
            If the camera is not there any more.
        """

    def disconnect(self) -> None:
        """Let go of the camera."""
