"""Independent peers: other people's implementations read what ours send. Each test needs a package of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest

from ropetrace.results.ros_estimates import PATH, header, typestore
from ropetrace.ros.messages import POSES
from ros_rig import routed, until
from ros_twins import ROWS, STAMP, WAYPOINTS, path, published


def definition(name: str) -> str:
    """The text of a type, with those within."""
    return str(typestore().generate_msgdef(name, ros_version=2)[0])


def test_mcap_ros2_decodes_and_encodes_every_message_to_the_same_bytes() -> None:
    dynamic = pytest.importorskip("mcap_ros2._dynamic", reason="mcap-ros2-support is not installed")
    seen = set()
    for name, data in published():
        decoded = dynamic.generate_dynamic(name, definition(name))[name](data)
        assert bytes(dynamic.serialize_dynamic(name, definition(name))[name](decoded)) == data, name
        seen.add(name)
    assert len(seen) == 10


READER = """
import json, sys
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
