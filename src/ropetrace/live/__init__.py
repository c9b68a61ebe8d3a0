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


def open_live(
    address: str | Path,
    *,
    depth_topic: str | None = None,
    color_topic: str | None = None,
    cloud_topic: str | None = None,
) -> LiveRecording:
    """Open a camera by its address.

    Parameters
    ----------
    address : str
        ``sim:SCENARIO``, ``realsense:``, ``realsense:SERIAL``, ``ros2:``, ``ros2:tcp/HOST:PORT`` or ``ros1:``.
    depth_topic, color_topic, cloud_topic : str, optional
        Of ROS; see `ropetrace.live.ros_camera.open_ros`.

    Raises
    ------
    RecordingError
        If there is no such camera, or it has no topics.
    ConfigError
        If a scenario is unknown or wrong; if a topic or an endpoint of ROS is impossible.
    MissingExtraError
        If the package that the camera needs is not installed.
    """
    scheme, _, name = str(address).partition(":")
    if scheme in ("ros1", "ros2"):
        from ropetrace.live.ros_camera import open_ros

        return LiveRecording(str(address), open_ros(str(address), depth_topic, color_topic, cloud_topic))
    if depth_topic is not None or color_topic is not None or cloud_topic is not None:
        raise RecordingError(f"{address}: this live source has no topics: leave the topics out")
    if scheme == "sim":
        from ropetrace.errors import import_extra

        import_extra("mujoco", "sim")
        from ropetrace.live.simulated import SimulatedCamera

        return LiveRecording(str(address), SimulatedCamera(name))
    if scheme == "realsense":
        from ropetrace.live.realsense import find_realsense

        return LiveRecording(str(address), find_realsense(name))
    raise RecordingError(
        f"{address}: there is no such file, and {scheme}: is no live source: give sim:SCENARIO, realsense:, "
        "realsense:SERIAL, ros2:, ros2:tcp/HOST:PORT or ros1:"
    )
