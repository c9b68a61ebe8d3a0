"""Live cameras, which are read as recordings are; `ropetrace.recordings.open_recording` is the door."""

from __future__ import annotations

import re
from pathlib import Path

from ropetrace.errors import RecordingError
from ropetrace.live.camera import Camera, CameraGoneError, Capture
from ropetrace.live.recording import LiveRecording

__all__ = ["Camera", "CameraGoneError", "Capture", "LiveRecording", "open_live", "scheme_of"]


def scheme_of(address: str | Path) -> str | None:
    """What stands before the colon of a live source's address; None for the path of a recording.

    A file or folder of that name is a recording.
    """
    match = re.match(r"([a-z][a-z0-9]+):", str(address))
    return match[1] if match and not Path(address).exists() else None


def open_live(address: str | Path) -> LiveRecording:
    """Open a camera by its address: ``sim:SCENARIO``, ``realsense:`` or ``realsense:SERIAL``.

    Raises
    ------
    RecordingError
        If there is no such camera.
    ConfigError
        If a scenario is unknown or wrong.
    MissingExtraError
        If the package that the camera needs is not installed.
    """
    scheme, _, name = str(address).partition(":")
    if scheme == "sim":
        from ropetrace.errors import import_extra

        import_extra("mujoco", "sim")
        from ropetrace.live.simulated import SimulatedCamera

        return LiveRecording(str(address), SimulatedCamera(name))
    if scheme == "realsense":
        from ropetrace.live.realsense import find_realsense

        return LiveRecording(str(address), find_realsense(name))
    raise RecordingError(
        f"{address}: there is no such file, and {scheme}: is no live source: give sim:SCENARIO, realsense: or "
        "realsense:SERIAL"
    )
