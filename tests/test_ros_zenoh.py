"""The transport against what rmw_zenoh's own documents and sources say, as a raw Zenoh peer sees it."""

from __future__ import annotations

import os
import select
import signal
import struct
import subprocess
import sys
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("zenoh")
pytest.importorskip("xxhash")

import zenoh
from rosbags.typesys import Stores, get_typestore

from ropetrace.errors import ConfigError, RosError
from ropetrace.recordings.ros_messages import CAMERA, CLOUD, IMAGE, decoded
from ropetrace.results.ros_estimates import DIAGNOSTICS, PATH, TRAJECTORY, make, typestore
from ropetrace.ros import messages
from ropetrace.ros.graph import Publisher, check_topic
from ropetrace.ros.zenoh_graph import (
    ZenohNode,
    attachment,
    dds_type,
    node_token,
    publisher_id,
    ros_type,
    topic_key,
    topic_token,
    type_hash,
)
from ropetrace.ros.zenoh_session import Connection, open_session
from ros_rig import free_endpoint, listening, routed, until

STRING = "std_msgs/msg/String"
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
"""From docs/design.md of rmw_zenoh."""

TYPES = (IMAGE, CAMERA, CLOUD, PATH, TRAJECTORY, DIAGNOSTICS, messages.POSES, messages.JOINTS, messages.NUMBERS)


@pytest.mark.parametrize(
    ("name", "known"),
    [
        (STRING, STRING_HASH),
        # Seen in other projects' recordings of a real graph.
        ("std_msgs/msg/UInt64", "RIHS01_fbdc52018fc13755dce18024d1a671c856aa8b4aaf63adfb095b608f98e8c943"),
        ("geometry_msgs/msg/TwistStamped", "RIHS01_5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64"),
    ],
)
def test_hashes_are_the_published_ones(name: str, known: str) -> None:
    assert type_hash(name, humble=False) == known


def test_key_expressions_are_those_of_the_design_document() -> None:
    assert topic_key(0, "/chatter", STRING) == f"0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
    assert topic_key(0, "/robot1/chatter", STRING) == f"0/robot1/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
    assert topic_key(0, "/chatter", STRING, humble=True).endswith("String_/TypeHashNotSupported")
    assert ros_type(dds_type(STRING)) == STRING


def test_tokens_are_those_of_the_design_document() -> None:
    session = "aac3178e146ba6f1fc6e6a4085e77f21"
    assert node_token(2, session, "listener") == f"@ros2_lv/2/{session}/0/0/NN/%/%/listener"
    documented = (
        f"@ros2_lv/2/{session}/0/10/MS/%/%/listener/%chatter/std_msgs::msg::dds_::String_/{STRING_HASH}/::,10:,:,:,,"
    )
    # The documented one is reliable, the default, which is left out; ours is best effort, 2 in rmw/types.h.
    ours = topic_token(2, session, 10, "MS", "listener", "/chatter", STRING, 10)
    assert ours == documented.replace("/::,10", "/2::,10")
    assert topic_token(2, session, 1, "MP", "n", "/a/b", STRING, 42).endswith("/2::,:,:,:,,")


def test_the_attachment_is_what_zenohs_own_serializer_makes() -> None:
    from zenoh.ext import Int64, z_serialize

    gid = bytes(range(16))
    # rmw_zenoh serializes an int64, an int64 and 16 bytes, one after the other (attachment_helpers.cpp).
    assert attachment(7, 10**18, gid) == z_serialize((Int64(7), Int64(10**18), gid)).to_bytes()
    assert len(attachment(7, 10**18, gid)) == 33


def test_a_publishers_id_is_xxh3_of_its_token_as_rmw_zenoh_lays_it_out() -> None:
    # XXH3-128 of nothing is 99aa06d3014798d8 6001c324468d497f, as its authors have it; liveliness_utils.cpp copies the
    # lower half first, each in the order of a little-endian machine.
    low, high = 0x6001C324468D497F, 0x99AA06D3014798D8
    assert publisher_id("") == struct.pack("<QQ", low, high)


def test_our_types_are_the_same_in_all_distributions() -> None:
    stores = [get_typestore(getattr(Stores, f"ROS2_{name}")) for name in ("HUMBLE", "JAZZY", "KILTED", "LYRICAL")]
    for name in TYPES:
        assert {store.hash_rihs01(name) for store in stores} == {type_hash(name, humble=False)}, name


def raw_peer(connection: Connection) -> Any:
    """A Zenoh session that knows nothing of ropetrace."""
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("connect/endpoints", f'["{connection.router}"]')
    config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


@pytest.mark.parametrize("humble", [False, True])
def test_a_raw_peer_sees_the_node_its_topics_and_its_messages(humble: bool) -> None:
    with routed() as base, raw_peer(base) as raw:
        connection = Connection(router=base.router, humble=humble, domain=3)
        samples: list[Any] = []
        tokens: list[tuple[str, str]] = []
        held = [
            raw.declare_subscriber("**", samples.append),
            raw.liveliness().declare_subscriber(
                "@ros2_lv/**", lambda s: tokens.append((str(s.kind).rpartition(".")[2], str(s.key_expr))), history=True
            ),
        ]
        node = ZenohNode("talker", connection)
        publisher = node.publisher("/chatter", STRING)
        node.subscription("/camera/depth", IMAGE)
        until(lambda: len(tokens) == 3)
        hashed = "TypeHashNotSupported" if humble else STRING_HASH

        def send() -> int:
            publisher.put(make(STRING, "Hello World: 1"))
            time.sleep(0.05)
            return len(samples)

        until(send)
        first = samples[0]
        assert str(first.key_expr) == f"3/chatter/std_msgs::msg::dds_::String_/{hashed}"
        # The bytes of a std_msgs/String in CDR, little endian, written out by hand.
        assert first.payload.to_bytes() == b"\x00\x01\x00\x00\x0f\x00\x00\x00Hello World: 1\x00"
        read = get_typestore(Stores.ROS2_HUMBLE if humble else Stores.ROS2_JAZZY)
        assert read.deserialize_cdr(first.payload.to_bytes(), STRING).data == "Hello World: 1"
        sequence, stamp, size = struct.unpack_from("<qqB", first.attachment.to_bytes())
        assert sequence >= 1
        assert abs(stamp - time.time_ns()) < 60e9
        assert size == 16
        published = next(token for _, token in tokens if "/MP/" in token)
        assert first.attachment.to_bytes()[17:] == publisher_id(published)
        kinds = sorted(token.split("/")[5] for _, token in tokens)
        assert kinds == ["MP", "MS", "NN"]
        for _, token in tokens:
            assert token.split("/")[1:4] == ["3", tokens[0][1].split("/")[2], "0"]
        assert published.split("/")[6:12] == ["%", "%", "talker", "%chatter", "std_msgs::msg::dds_::String_", hashed]
        node.close()
        until(lambda: sum(kind == "DELETE" for kind, _ in tokens) == 3)
        assert len(held) == 2


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_messages_arrive_and_only_the_last_are_kept(mode: Any) -> None:
    with routed() as base, ZenohNode("a", replace(base, mode=mode)) as one, ZenohNode("b", base) as two:
        publisher, read = one.publisher("/text", STRING), two.subscription("/text", STRING, depth=2)

        def sent() -> bool:
            for number in range(5):
                publisher.put(make(STRING, str(number)))
            two.wait(1.0)
            time.sleep(0.1)
            return [decoded(message).data for message in read.take()] == ["3", "4"]

        until(sent)
        assert read.newest() is None


def test_a_burst_of_small_messages_arrives_whole_on_a_busy_machine() -> None:
    burners = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(3)]
    try:
        with routed() as connection, ZenohNode("arm", connection) as arm, ZenohNode("reader", connection) as reader:
            publisher, read = arm.publisher("/text", STRING), reader.subscription("/text", STRING, depth=1000)
            data = bytes(typestore().serialize_cdr(make(STRING, "done"), STRING))

            def met() -> bool:
                publisher.put_packed(data)
                reader.wait(0.1)
                return bool(read.take())

            until(met)
            reader.wait(0.5)
            read.take()
            arrived = 0
            for sent in range(12, 12 * 40, 12):
                for _ in range(12):
                    publisher.put_packed(data)

                def all_came(sent: int = sent) -> bool:
                    nonlocal arrived
                    arrived += len(read.take())
                    return arrived >= sent

                until(all_came)
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


def test_a_topic_of_another_type_is_refused_with_words() -> None:
    with routed() as connection, ZenohNode("camera", connection) as camera, ZenohNode("reader", connection) as reader:
        read = reader.subscription("/camera/depth", IMAGE)
        assert read.problem() == ""
        wrong = camera.publisher("/camera/depth", STRING)
        until(read.problem)
        assert read.problem() == (
            "/camera/depth of node camera is std_msgs/msg/String, expected sensor_msgs/msg/Image: not read"
        )
        wrong.put(make(STRING, "no image"))
        reader.wait(0.3)
        assert read.newest() is None
        camera.close()
        until(lambda: not read.problem())


def test_a_node_of_humble_is_told_from_one_of_jazzy() -> None:
    with routed() as connection:
        old = Connection(router=connection.router, humble=True)
        with ZenohNode("camera", old) as camera, ZenohNode("reader", connection) as reader:
            read = reader.subscription("/text", STRING)
            camera.publisher("/text", STRING)
            until(read.problem)
            assert "another definition" in read.problem()
            assert "Humble needs --humble" in read.problem()


STOPPED_READER = """
import sys, time
from ropetrace.ros.zenoh_session import Connection
from ropetrace.ros.zenoh_graph import ZenohNode
node = ZenohNode("stopped", Connection(router=sys.argv[1]))
read = node.subscription("/camera/depth", "sensor_msgs/msg/Image")
while not read.take():
    node.wait(0.1)
print("reading", flush=True)
time.sleep(600)
"""


def test_a_reader_that_hangs_does_not_hold_up_the_publisher() -> None:
    with routed() as connection, ZenohNode("camera", connection) as camera:
        publisher = camera.publisher("/camera/depth", IMAGE)
        reader = subprocess.Popen(
            [sys.executable, "-c", STOPPED_READER, connection.router], stdout=subprocess.PIPE, text=True
        )
        with reader:
            try:
                assert reader.stdout is not None
                output = reader.stdout
                data = bytes(10**6)

                def reading() -> bool:
                    publisher.put_packed(data)
                    time.sleep(0.03)
                    return bool(select.select([output], [], [], 0)[0])

                until(reading)
                reader.send_signal(signal.SIGSTOP)
                took = []
                for _ in range(60):
                    start = time.perf_counter()
                    publisher.put_packed(data)
                    took.append(time.perf_counter() - start)
                    time.sleep(0.01)
                assert np.median(took) < 0.2, "seconds"
                assert max(took) < 3, "seconds"
            finally:
                reader.kill()


COUNTING_READER = """
import sys
from pathlib import Path
from ropetrace.ros.zenoh_session import Connection
from ropetrace.ros.zenoh_graph import ZenohNode
node = ZenohNode("reader", Connection(router=sys.argv[1]))
read = node.subscription("/camera/depth", "sensor_msgs/msg/Image")
for _ in sys.stdin:
    while not read.take():
        node.wait(0.1)
    rows = Path("/proc/self/status").read_text().splitlines()
    print(next(row for row in rows if row.startswith("VmRSS")), flush=True)
"""


def test_cameras_that_come_and_go_leave_no_memory_behind() -> None:
    """By shared memory, Zenoh 1.10 would keep 16 MB of each."""
    with routed() as connection:
        reader = subprocess.Popen(
            [sys.executable, "-c", COUNTING_READER, connection.router],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        with reader:
            try:
                assert reader.stdin is not None
                assert reader.stdout is not None
                output, sizes = reader.stdout, []
                for _ in range(6):
                    reader.stdin.write("\n")
                    reader.stdin.flush()
                    with ZenohNode("camera", connection) as camera:
                        publisher = camera.publisher("/camera/depth", IMAGE)

                        def read(publisher: Publisher = publisher) -> bool:
                            publisher.put_packed(bytes(100_000))
                            return bool(select.select([output], [], [], 0.02)[0])

                        until(read)
                    sizes.append(int(output.readline().split()[1]) / 1024)
                assert sizes[-1] - sizes[1] < 20, f"MB: {sizes}"
            finally:
                reader.kill()


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_nothing_listens_beyond_loopback(mode: Any) -> None:
    with routed() as base:
        script = (
            "import sys, time\n"
            "from ropetrace.ros.zenoh_session import Connection\n"
            "from ropetrace.ros.zenoh_graph import ZenohNode\n"
            "node = ZenohNode('quiet', Connection(router=sys.argv[1], mode=sys.argv[2]))\n"
            "node.publisher('/text', 'std_msgs/msg/String')\n"
            "node.subscription('/other', 'std_msgs/msg/String')\n"
            "print('up', flush=True)\n"
            "time.sleep(600)\n"
        )
        command = [sys.executable, "-c", script, base.router, mode]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            try:
                assert process.stdout is not None
                assert process.stdout.readline() == "up\n"
                heard = listening(process.pid)
            finally:
                process.kill()
    assert {host for _, host in heard} <= {"127.0.0.1"}
    assert [kind for kind, _ in heard] == (["tcp"] if mode == "peer" else [])
    assert {host for _, host in listening(os.getpid())} <= {"127.0.0.1"}, "the router"


@pytest.mark.parametrize("name", ["chatter", "/", "//a", "/a b", "/a/", "/1", "/a*", ""])
def test_names_that_are_none(name: str) -> None:
    with pytest.raises(ConfigError, match="no full name of a topic"):
        check_topic(name)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"domain": 233}, "0 to 232"),
        ({"domain": -1}, "0 to 232"),
        ({"mode": "router"}, "peer"),
        ({"router": "127.0.0.1:7447"}, "tcp/127.0.0.1:7447"),
        ({"listen": "tcp/127.0.0.1:99999"}, "endpoint"),
    ],
)
def test_a_connection_that_cannot_be(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        Connection(**wrong)


def test_a_session_that_cannot_be_opened_is_one_error() -> None:
    with pytest.raises(RosError, match="no Zenoh session"):
        open_session(Connection(router=free_endpoint(), mode="client"))
    with pytest.raises(RosError, match="no Zenoh session"):
        open_session(Connection(router=free_endpoint(), listen="tcp/203.0.113.1:7447"))
