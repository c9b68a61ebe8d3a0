"""Messages that are packed as whole arrays: byte for byte those of rosbags, and back."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ropetrace.recordings.ros_messages import RawMessage
from ropetrace.results.ros_estimates import PATH, TRAJECTORY, header, make, typestore
from ropetrace.results.ros_packed import pack_path, pack_poses, pack_trajectory, unpack_path, unpack_trajectory
from ropetrace.ros import messages
from ropetrace.types import Motion, Waypoints
from ros_twins import path, pose_array, trajectory

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
    found = unpack_path(bytes(spoilt)) if which else unpack_trajectory(bytes(spoilt))
    if found is None:
        return
    body = typestore().deserialize_cdr(bytes(spoilt), PATH if which else TRAJECTORY)
    if which:
        assert len(body.poses) == len(found)
    else:
        assert len(body.points[0].transforms if body.points else []) == len(found[0])


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
