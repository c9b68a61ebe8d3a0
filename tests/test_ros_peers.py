"""Independent peers: other people's implementations read what ours send. Each test needs a package of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from ropetrace.recordings.ros_frames import frame_messages
from ropetrace.results.ros_estimates import DIAGNOSTICS, PATH, TRAJECTORY, diagnostics, header, typestore
from ropetrace.ros import messages
from ropetrace.ros.messages import JOINTS, NUMBERS, POSES
from ropetrace.types import CloudFrame, Frame, Intrinsics, Motion, RgbdFrame, Status, Waypoints
from ros_rig import routed, until
from ros_twins import path, pose_array, trajectory

ROWS = np.arange(15.0).reshape(5, 3)
WAYPOINTS = Waypoints(ROWS, np.tile([0.5, 0.5, 0.5, 0.5], (5, 1)), np.arange(5.0))
STAMP = 1_700_000_000_123_456_789


def packed() -> list[tuple[str, bytes]]:
    """A message in CDR of every type that the nodes publish or record."""
    held = header(STAMP, "camera")
    lens = Intrinsics(4, 3, 5.0, 6.0, 1.5, 1.0)
    color = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)
    frames: list[Frame] = [
        RgbdFrame(STAMP, np.arange(12, dtype=np.uint16).reshape(3, 4), 0.001, lens, color),
        CloudFrame(STAMP, np.arange(6, dtype=np.float32).reshape(2, 3), color[0, :2]),
    ]
    made = [
        (PATH, path(held, WAYPOINTS)),
        (PATH, path(held, Waypoints.none())),
        (POSES, pose_array(held, WAYPOINTS)),
        (TRAJECTORY, trajectory(held, WAYPOINTS, Motion(ROWS + 1, ROWS + 2, ROWS, ROWS, ROWS))),
        (DIAGNOSTICS, diagnostics(held, "näme", Status.OK, "why", {"a": "b", "": ""})),
        (JOINTS, messages.joint_state(held, ("a", "bcd"), np.array([1.0, 2.0]), None)),
        (NUMBERS, messages.numbers(np.array([1.0, -2.0, 3.0]))),
    ]
    images = [(message.type, bytes(message.data)) for frame in frames for message in frame_messages(frame)]
    return [*images, *((name, bytes(typestore().serialize_cdr(message, name))) for name, message in made)]


def definition(name: str) -> str:
    """The text of a type, with those within."""
    return str(typestore().generate_msgdef(name, ros_version=2)[0])


def test_mcap_ros2_decodes_and_encodes_every_message_to_the_same_bytes() -> None:
    dynamic = pytest.importorskip("mcap_ros2._dynamic", reason="mcap-ros2-support is not installed")
    seen = set()
    for name, data in packed():
        decoded = dynamic.generate_dynamic(name, definition(name))[name](data)
        assert bytes(dynamic.serialize_dynamic(name, definition(name))[name](decoded)) == data, name
        seen.add(name)
    assert len(seen) == 9


READER = """
import json, sys
import numpy as np
from zenoh_ros2_sdk import ROS2Subscriber
from zenoh_ros2_sdk.discovery import get_topic_names_and_types
port, definition = int(sys.argv[1]), sys.argv[2]
def came(message):
    poses = [[pose.pose.position.x, pose.pose.position.y, pose.pose.position.z] for pose in message.poses]
    topics = get_topic_names_and_types(domain_id=5, router_port=port)
    print(json.dumps({"topics": dict(topics), "poses": poses, "frame": message.header.frame_id}), flush=True)
read = ROS2Subscriber("/ropetrace/centerline", "nav_msgs/msg/Path", came, msg_definition=definition, domain_id=5,
                      router_port=port, type_hash=sys.argv[3])
sys.stdin.read()
"""


def test_zenoh_ros2_sdk_lists_the_topics_and_reads_the_centreline(tmp_path: Path) -> None:
    pytest.importorskip("zenoh")
    pytest.importorskip("xxhash")
    if find_spec("zenoh_ros2_sdk") is None:
        pytest.skip("zenoh-ros2-sdk is not installed")
    from ropetrace.ros.zenoh_graph import ZenohNode, type_hash

    # Our hash: theirs needs definitions that it fetches with git.
    told = [definition(PATH), type_hash(PATH, humble=False)]
    out = tmp_path / "out.txt"
    with routed() as base, ZenohNode("track_deformable", replace(base, domain=5)) as node, out.open("w") as printed:
        publisher = node.publisher("/ropetrace/centerline", PATH)
        node.publisher("/ropetrace/poses", POSES)
        command = [sys.executable, "-c", READER, base.router.rpartition(":")[2], *told]
        # It wants git, if only for what it does not do here.
        quiet = {**os.environ, "HOME": str(tmp_path), "GIT_PYTHON_REFRESH": "quiet"}
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=printed, env=quiet) as reader:
            try:

                def complete() -> list[dict[str, object]]:
                    assert reader.poll() is None, "the reader has ended"
                    publisher.put(path(header(STAMP, "camera"), WAYPOINTS))
                    lines = out.read_text().splitlines()
                    # Its list is a one-shot query, which now and then has no answer.
                    return [row for row in map(json.loads, lines) if len(row["topics"]) == 2]

                until(complete)
                row = complete()[0]
            finally:
                reader.kill()
    assert row["topics"] == {"/ropetrace/centerline": [PATH], "/ropetrace/poses": [POSES]}
    assert row["poses"] == ROWS.tolist()
    assert row["frame"] == "camera"
