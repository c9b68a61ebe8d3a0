"""Recordings in, frames out: `open_recording` is the one door; writers are in the module of their format."""

from __future__ import annotations

import math
import os
import stat
from pathlib import Path

from ropetrace.errors import RecordingError
from ropetrace.recordings.base import DEFAULT_PAIR_GAP, Recording, RecordingInfo, StreamInfo

__all__ = ["Recording", "RecordingInfo", "StreamInfo", "open_recording"]

CLOUD_SUFFIXES = (".npy", ".npz", ".ply", ".pcd")
ROS_MAGICS = (b"\x89MCAP", b"SQLite format 3", b"#ROSBAG V")
_PACKED = (".zstd", ".zst")
_KNOWN = (
    "a folder with depth.txt and camera.json (RGB-D), a folder with depth_*.png and intrinsics.json, "
    "a rosbag2 folder, .mcap, .db3, .bag, or .npy/.npz/.ply/.pcd clouds"
)


def open_recording(
    path: str | Path,
    *,
    rate: float | None = None,
    depth_topic: str | None = None,
    color_topic: str | None = None,
    cloud_topic: str | None = None,
    max_pair_gap: float = DEFAULT_PAIR_GAP,
) -> Recording:
    """Open a recording of any known kind, recognised by what is in it, or a live camera.

    Parameters
    ----------
    path : path
        A file or a folder; or an address of `ropetrace.live.open_live`, such as ``ros2:``, for a `LiveRecording`.
    rate : float, optional
        Frames per second, for recordings that have no stamps of their own (and only for those).
    depth_topic, color_topic, cloud_topic : str, optional
        Topics of a ROS recording that are used in place of those found by type and name, or of a live ROS graph in
        place of a RealSense's. An empty `color_topic` leaves colour out.
    max_pair_gap : float
        Colour farther than this from a depth image is not paired with it, seconds.

    Raises
    ------
    RecordingError
        If it cannot be read, or not as it was asked for; the message says what to do.
    ConfigError
        If the scenario of a live simulation is unknown or wrong; if a topic or an endpoint of ROS is impossible.
    MissingExtraError
        If the package that reads a .ply or .pcd cloud, or that a live camera needs, is not installed.
    """
    from ropetrace.live import open_live, scheme_of

    if scheme_of(path) is not None:
        if rate is not None:
            raise RecordingError(f"{path}: a live source has stamps of its own: leave out --rate")
        return open_live(path, depth_topic=depth_topic, color_topic=color_topic, cloud_topic=cloud_topic)
    path = Path(path)
    if rate is not None and not (math.isfinite(rate) and 1e-3 <= rate <= 1e6):
        raise RecordingError(f"the rate {rate} is impossible: give frames per second, such as 30")
    if not 0 <= max_pair_gap <= 3600:
        raise RecordingError(f"the pairing bound {max_pair_gap} is impossible: give seconds, such as 0.02")
    try:
        names = _entries(path)
        if _holds_ros(path, names):
            from ropetrace.recordings.ros_recording import RosRecording
            from ropetrace.recordings.rosbag2_folder import Rosbag2Folder, open_ros_file

            source = open_ros_file(path) if names is None else Rosbag2Folder(path)
            _refuse_rate(path, rate, source.kind)
            return RosRecording(source, depth_topic, color_topic, cloud_topic, max_pair_gap)
        found = _open_file(path, rate) if names is None else _open_folder(path, names, rate, max_pair_gap)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
    if depth_topic is not None or color_topic is not None or cloud_topic is not None:
        raise RecordingError(f"{path}: a {found.kind} has no topics: leave the topics out")
    return found


def _entries(path: Path) -> list[str] | None:
    """The names in a folder, or None for a file that may be opened without blocking."""
    try:
        mode = os.stat(path).st_mode
    except ValueError as error:  # such as a NUL in the path
        raise RecordingError(f"{str(path)!r}: not a path: {error}") from None
    if stat.S_ISDIR(mode):
        names = sorted(os.listdir(path))
        if not names:
            raise RecordingError(f"{path}: the folder is empty; expected {_KNOWN}")
        return names
    if not stat.S_ISREG(mode):
        raise RecordingError(f"{path}: a device, FIFO or socket, no file and no folder; give a recording")
    return None


def _holds_ros(path: Path, names: list[str] | None) -> bool:
    if names is not None:
        return "depth.txt" not in names and any(name.endswith((".mcap", ".db3")) for name in names)
    with open(path, "rb") as stream:
        head = stream.read(16)
    if not head:
        raise RecordingError(f"{path}: the file is empty (0 bytes)")
    if path.name.endswith(_PACKED):
        raise RecordingError(f"{path}: a compressed file: unpack it first, with 'zstd -d {path.name}'")
    return path.suffix.lower() in (".mcap", ".db3", ".bag") or head.startswith(ROS_MAGICS)


def _open_folder(path: Path, names: list[str], rate: float | None, max_pair_gap: float) -> Recording:
    if "depth.txt" in names:
        from ropetrace.recordings.rgbd_folder import RgbdFolder

        _refuse_rate(path, rate, RgbdFolder.kind)
        return RgbdFolder(path, max_pair_gap)
    if any(name.startswith("depth_") and name.endswith(".png") for name in names):
        from ropetrace.recordings.depth_folder import DepthFolder

        return DepthFolder(path, _needed_rate(path, rate, DepthFolder.kind))
    if any(name.lower().endswith(CLOUD_SUFFIXES) for name in names):
        from ropetrace.recordings.clouds import CloudFiles

        return CloudFiles(path, _needed_rate(path, rate, "folder of clouds"))
    for name in names:
        if name.endswith(_PACKED):
            raise RecordingError(
                f"{path}: {name} is compressed: unpack the files first, with 'zstd -d *.zstd' in that folder"
            )
    raise RecordingError(f"{path}: not a recording: it holds {_listed(names)}; expected {_KNOWN}")


def _open_file(path: Path, rate: float | None) -> Recording:
    if path.suffix.lower() in CLOUD_SUFFIXES:
        from ropetrace.recordings.clouds import CloudFiles

        return CloudFiles(path)
    with open(path, "rb") as stream:
        head = stream.read(16)
    raise RecordingError(f"{path}: not a recording (it begins with {head!r}); expected {_KNOWN}")


def _needed_rate(path: Path, rate: float | None, kind: str) -> float:
    if rate is None:
        raise RecordingError(f"{path}: a {kind} has no stamps: give its frames per second, such as --rate 30")
    return rate


def _refuse_rate(path: Path, rate: float | None, kind: str) -> None:
    if rate is not None:
        raise RecordingError(f"{path}: a {kind} has stamps of its own: leave out --rate")


def _listed(names: list[str], most: int = 8) -> str:
    """The first names, escaped, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(repr(name) for name in names[:most]) + more
