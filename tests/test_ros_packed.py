"""Messages that are packed as whole arrays: byte for byte those of rosbags, and back."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ropetrace.errors import FrameError
from ropetrace.recordings.ros_messages import RawMessage, stamp_and_frame
from ropetrace.results.ros_estimates import PATH, TRAJECTORY, header, make, typestore
from ropetrace.results.ros_packed import (
    MOST_WAYPOINTS,
    pack_path,
    pack_poses,
    pack_trajectory,
    unpack_path,
    unpack_trajectory,
)
from ropetrace.ros import messages
from ropetrace.types import FloatArray, Motion, Waypoints
from ros_twins import path, pose_array, trajectory

POINT = "trajectory_msgs/msg/MultiDOFJointTrajectoryPoint"
STAMP = 1_700_000_000_123_456_789


def rope(count: int, seed: int = 0) -> tuple[Waypoints, Motion]:
    rng = np.random.default_rng(seed)
    moving = Motion(*(rng.normal(size=(count, 3)) for _ in range(5)))
    if not count:
        return Waypoints.none(), moving
    turns = rng.normal(size=(count, 4))
    return Waypoints(rng.normal(size=(count, 3)), turns, np.arange(count, dtype=float)), moving


@settings(deadline=None, max_examples=60)
@given(count=st.integers(0, 130), frame_id=st.text(max_size=40), seed=st.integers(0, 9))
def test_the_bytes_are_those_of_rosbags(count: int, frame_id: str, seed: int) -> None:
    waypoints, motion = rope(count, seed)
    held = header(STAMP, frame_id)
    store = typestore()
    assert pack_path(STAMP, frame_id, waypoints) == bytes(store.serialize_cdr(path(held, waypoints), PATH))
    poses = bytes(store.serialize_cdr(pose_array(held, waypoints), messages.POSES))
    assert pack_poses(STAMP, frame_id, waypoints) == poses
    for known in (motion, None):
        made = bytes(store.serialize_cdr(trajectory(held, waypoints, known), TRAJECTORY))
        assert pack_trajectory(STAMP, frame_id, waypoints, known) == made


@settings(deadline=None, max_examples=30)
@given(count=st.integers(0, 130), frame_id=st.text(max_size=40))
def test_what_was_packed_comes_back(count: int, frame_id: str) -> None:
    waypoints, motion = rope(count)
    poses = unpack_path(pack_path(STAMP, frame_id, waypoints))
    known = unpack_trajectory(memoryview(pack_trajectory(STAMP, frame_id, waypoints, motion)))
    assert poses is not None
    assert known is not None
    np.testing.assert_array_equal(poses, np.hstack((waypoints.positions, waypoints.quaternions)))
    np.testing.assert_array_equal(known[0], poses)
    np.testing.assert_array_equal(known[1], motion.velocities)
    np.testing.assert_array_equal(known[2], motion.accelerations)


@settings(deadline=None, max_examples=300)
@given(data=st.data(), which=st.booleans())
def test_damage_is_refused_or_read_as_rosbags_reads_it(data: st.DataObject, which: bool) -> None:
    waypoints, motion = rope(5)
    sound = pack_path(STAMP, "camera", waypoints) if which else pack_trajectory(STAMP, "camera", waypoints, motion)
    spoilt = bytearray(sound[: data.draw(st.integers(0, len(sound)))])
    for _ in range(data.draw(st.integers(0, 3))):
        if spoilt:
            spoilt[data.draw(st.integers(0, len(spoilt) - 1))] = data.draw(st.integers(0, 255))
    found = unpacked(bytes(spoilt)) if which else unpack_trajectory(bytes(spoilt))
    if found is None:
        return
    try:
        body = typestore().deserialize_cdr(bytes(spoilt), PATH if which else TRAJECTORY)
    except Exception:
        return  # It looks at what is not used here, too: names that are no UTF-8, for one.
    read: tuple[list[Any], list[Any], list[Any]]
    if which:
        read = [(stamped.pose.position, stamped.pose.orientation) for stamped in body.poses], [], []
    else:
        point = body.points[0] if body.points else make(POINT, [], [], [], None)
        read = (
            [(at.translation, at.rotation) for at in point.transforms],
            [twist.linear for twist in point.velocities],
            [twist.linear for twist in point.accelerations],
        )
    rows = [[at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w] for at, turn in read[0]]
    np.testing.assert_array_equal(found[0], np.reshape(rows, (-1, 7)))
    for ours, theirs in zip(found[1:], read[1:], strict=True):
        np.testing.assert_array_equal(ours, np.reshape([[v.x, v.y, v.z] for v in theirs], (-1, 3)))


def unpacked(data: bytes) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """A path as a trajectory of unknown motion."""
    poses = unpack_path(data)
    return None if poses is None else (poses, np.empty((0, 3)), np.empty((0, 3)))


@pytest.mark.parametrize("frames", [("camera", "map"), ("camera", "camera_2")])
def test_a_path_of_another_maker_is_read_too(frames: tuple[str, str]) -> None:
    """Poses whose headers are not that of the path."""
    waypoints, _ = rope(4)
    body = path(header(STAMP, frames[0]), waypoints)
    for stamped in body.poses:
        stamped.header = header(STAMP + 1, frames[1])
    data = bytes(typestore().serialize_cdr(body, PATH))
    assert unpack_path(data) is None
    found = messages.waypoints(RawMessage("/path", PATH, "cdr", 0, data))
    np.testing.assert_array_equal(found.positions, waypoints.positions)
    np.testing.assert_array_equal(found.quaternions, waypoints.quaternions)


@pytest.mark.parametrize("place", range(3))
def test_a_path_with_one_pose_of_another_frame_is_left_to_rosbags(place: int) -> None:
    waypoints, _ = rope(3)
    body = path(header(STAMP, "camera"), waypoints)
    body.poses[place].header = header(STAMP, "gopher")
    assert unpack_path(bytes(typestore().serialize_cdr(body, PATH))) is None


def test_more_waypoints_than_a_rope_has_are_refused() -> None:
    """Before their names are made, which would take long."""
    count = 40 * MOST_WAYPOINTS
    data = b"\0\1\0\0" + struct.pack("<iII", 0, 0, 1) + bytes(4) + struct.pack("<I", count) + bytes(56 * count)
    with pytest.raises(FrameError, match="4000000 joints: expected 100000 at most"):
        unpack_trajectory(data)


@pytest.mark.parametrize(
    ("encoding", "data"),
    [
        ("ros1", struct.pack("<IIII", 0, 2**32 - 1, 0, 0)),
        ("cdr", b"\0\1\0\0" + struct.pack("<iIII", 2**31 - 1, 10**9, 1, 0)),
        ("cdr", b"\0\1\0\0" + struct.pack("<iIII", -1, 0, 1, 0)),
    ],
)
def test_a_wild_stamp_is_an_error_of_its_message(encoding: str, data: bytes) -> None:
    with pytest.raises(FrameError, match=r"/path: the stamp .* is no time from 1970 to 2038"):
        stamp_and_frame(RawMessage("/path", PATH, encoding, 0, data))


def test_the_last_stamp_is_one() -> None:
    data = b"\0\1\0\0" + struct.pack("<iIII", 2**31 - 1, 10**9 - 1, 1, 0)
    assert stamp_and_frame(RawMessage("/path", PATH, "cdr", 0, data))[0] == 2**31 * 10**9 - 1


def test_a_trajectory_of_another_maker_is_read_too() -> None:
    waypoints, motion = rope(4)
    body = trajectory(header(STAMP, "camera"), waypoints, motion)
    body.joint_names = ["a", "b", "c", "d"]
    body.points.append(body.points[0])
    data = bytes(typestore().serialize_cdr(body, TRAJECTORY))
    assert unpack_trajectory(data) is None
    found = messages.moving_waypoints(RawMessage("/motion", TRAJECTORY, "cdr", 0, data))
    assert found is not None
    np.testing.assert_array_equal(found[0].positions, waypoints.positions)
    np.testing.assert_array_equal(found[1].velocities, motion.velocities)


def test_big_endian_is_left_to_rosbags() -> None:
    waypoints, _ = rope(3)
    data = bytes(typestore().serialize_cdr(path(header(STAMP, "camera"), waypoints), PATH, little_endian=False))
    assert unpack_path(data) is None
    assert len(messages.waypoints(RawMessage("/path", PATH, "cdr", 0, data))) == 3


def test_counts_that_lie_allocate_nothing() -> None:
    assert unpack_path(b"\0\1\0\0" + struct.pack("<iIII", 0, 0, 1, 0) + struct.pack("<I", 2**32 - 1)) is None
    huge = b"\0\1\0\0" + struct.pack("<iII", 0, 0, 1) + b"\0\0\0\0" + struct.pack("<II", 2**32 - 1, 0)
    assert unpack_trajectory(huge) is None
    empty = make(TRAJECTORY, header(0, ""), [], [])
    data = bytes(typestore().serialize_cdr(empty, TRAJECTORY))
    assert messages.moving_waypoints(RawMessage("/motion", TRAJECTORY, "cdr", 0, data)) is None
