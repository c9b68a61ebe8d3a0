"""Paths, poses and trajectories as ROS 2 messages in CDR, and back: whole arrays at a time.

CDR puts each number at a multiple of its size, counted from the fifth byte. A pose with its header may so be longer in
the first place than in the following ones, which are all alike.
"""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import Any

import numpy as np

from ropetrace.errors import FrameError
from ropetrace.results.ros_estimates import NANOSECONDS
from ropetrace.types import FloatArray, Motion, Waypoints

_PLAIN_CDR = b"\x00\x01\x00\x00"
"""Little endian, without parameters."""

MOST_WAYPOINTS = 100_000
"""That are taken from a message: a rope of a kilometre."""


def pack_path(stamp_ns: int, frame_id: str, waypoints: Waypoints) -> bytes:
    """A nav_msgs/Path of the waypoints; without poses where there are none.

    Parameters
    ----------
    stamp_ns : int
        Of the header and of each pose, 0 to `ros_estimates.LAST_STAMP` nanoseconds.
    frame_id : str
        Of the same.
    waypoints : Waypoints
        W of them.
    """
    held = _header(stamp_ns, frame_id)
    count = len(waypoints)
    begin = _padded(held, 4) + struct.pack("<I", count)
    if not count:
        return _PLAIN_CDR + begin
    rows = np.zeros(count, _stamped_pose(len(held)))
    rows["header"] = np.frombuffer(held, f"V{len(held)}")[0]
    rows["pose"] = _poses(waypoints)
    return _PLAIN_CDR + _padded(begin + held, 8) + rows.tobytes()[rows.itemsize - 56 :]


def pack_poses(stamp_ns: int, frame_id: str, waypoints: Waypoints) -> bytes:
    """A geometry_msgs/PoseArray of the waypoints; see `pack_path`."""
    begin = _padded(_header(stamp_ns, frame_id), 4) + struct.pack("<I", len(waypoints))
    if not len(waypoints):
        return _PLAIN_CDR + begin
    return _PLAIN_CDR + _padded(begin, 8) + _poses(waypoints).tobytes()


def pack_trajectory(stamp_ns: int, frame_id: str, waypoints: Waypoints, motion: Motion | None) -> bytes:
    """A trajectory_msgs/MultiDOFJointTrajectory: one point of poses, velocities and accelerations, a joint a waypoint.

    Where the motion is not known there is no joint and no point. See `pack_path`.
    """
    begin = _padded(_header(stamp_ns, frame_id), 4)
    if motion is None or not len(motion):
        return _PLAIN_CDR + begin + struct.pack("<II", 0, 0)
    count = len(waypoints)
    begin = _padded(begin + _joint_names(count), 4) + struct.pack("<II", 1, count)
    parts = [_PLAIN_CDR, _padded(begin, 8), _poses(waypoints).tobytes()]
    for rows in (motion.velocities, motion.accelerations):
        twists = np.zeros((count, 6), "<f8")
        twists[:, :3] = rows
        parts += [struct.pack("<II", count, 0), twists.tobytes()]
    return b"".join([*parts, struct.pack("<iI", 0, 0)])


def unpack_path(data: bytes | memoryview) -> FloatArray | None:
    """The poses of a nav_msgs/Path as `pack_path` makes it.

    Returns
    -------
    (W, 7) float array or None
        Positions, metres, and quaternions ``xyzw``; None if it is made in another way, which may be as sound.
    """
    found = _begin(data)
    if found is None:
        return None
    at, header_size = found
    if len(data) < at + 4:
        return None
    (count,) = struct.unpack_from("<I", data, at)
    at += 4
    if not count:
        return np.empty((0, 7)) if len(data) == at else None
    row = _stamped_pose(header_size)
    first = at + header_size + -(at - 4 + header_size) % 8
    if len(data) != first + 56 + (count - 1) * row.itemsize:
        return None
    held = data[4 : 4 + header_size]
    if data[at : at + header_size] != held:
        return None
    rows = np.frombuffer(data, row, count - 1, first + 56)
    if count > 1 and (rows["header"] != np.frombuffer(held, f"V{header_size}")).any():
        return None
    return np.vstack((np.frombuffer(data, "<f8", 7, first)[None], rows["pose"])).astype(float)


def unpack_trajectory(data: bytes | memoryview) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Poses (W, 7), velocities and accelerations (W, 3) of a trajectory as `pack_trajectory` makes it.

    Returns
    -------
    tuple or None
        Metres and seconds, of no waypoints where the motion was not known; None if it is made in another way.

    Raises
    ------
    FrameError
        If there are more than `MOST_WAYPOINTS`.
    """
    found = _begin(data)
    if found is None or len(data) < found[0] + 8:
        return None
    at = found[0]
    (count,) = struct.unpack_from("<I", data, at)
    if not count:
        empty = np.empty((0, 3))
        return (np.empty((0, 7)), empty, empty) if bytes(data[at:]) == bytes(8) else None
    if count > len(data) // 56:
        return None
    if count > MOST_WAYPOINTS:
        raise FrameError(f"{count} joints: expected {MOST_WAYPOINTS} at most")
    names = _joint_names(count)
    if data[at : at + len(names)] != names:
        return None
    at += len(names) + -len(names) % 4
    poses = at + 8 + -(at + 8 - 4) % 8
    twist = 8 + count * 48
    if len(data) != poses + count * 56 + 2 * twist + 8:
        return None
    if struct.unpack_from("<II", data, at) != (1, count):
        return None
    ends = [poses + count * 56 + place * twist for place in range(2)]
    if any(struct.unpack_from("<I", data, end) != (count,) for end in ends):
        return None
    velocities, accelerations = (
        np.frombuffer(data, "<f8", count * 6, end + 8).reshape(count, 6)[:, :3].astype(float) for end in ends
    )
    return np.frombuffer(data, "<f8", count * 7, poses).reshape(count, 7).astype(float), velocities, accelerations


def _header(stamp_ns: int, frame_id: str) -> bytes:
    """A std_msgs/Header that begins at a multiple of four."""
    name = frame_id.encode() + b"\0"
    return struct.pack("<iII", *divmod(stamp_ns, NANOSECONDS), len(name)) + name


def _begin(data: bytes | memoryview) -> tuple[int, int] | None:
    """Where the message goes on behind its header, and the header's size; None if it is no plain CDR."""
    if len(data) < 16 or bytes(data[:4]) != _PLAIN_CDR:
        return None
    size = 12 + int(struct.unpack_from("<I", data, 12)[0])
    return 4 + size + -size % 4, size


def _padded(data: bytes, size: int) -> bytes:
    """With zeros up to a multiple of a size."""
    return data + bytes(-len(data) % size)


def _stamped_pose(header_size: int) -> np.dtype[Any]:
    """A geometry_msgs/PoseStamped that begins at a multiple of eight."""
    offset = header_size + -header_size % 8
    formats = [f"V{header_size}", ("<f8", (7,))]
    return np.dtype({"names": ["header", "pose"], "formats": formats, "offsets": [0, offset], "itemsize": offset + 56})


def _poses(waypoints: Waypoints) -> FloatArray:
    return np.hstack((waypoints.positions, waypoints.quaternions)).astype("<f8", copy=False)


@lru_cache(maxsize=16)
def _joint_names(count: int) -> bytes:
    """The names of one or more waypoints, a sequence of strings that begins at a multiple of four."""
    parts = [struct.pack("<I", count)]
    for number in range(count):
        name = f"waypoint_{number}\0".encode()
        parts += [struct.pack("<I", len(name)), name, bytes(-len(name) % 4)]
    return b"".join(parts[:-1])
