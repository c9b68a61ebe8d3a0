"""The camera of a running ROS graph as a live source."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("zenoh")
pytest.importorskip("xxhash")

import ros_rig
from ropetrace.errors import ConfigError, MissingExtraError, RecordingError, RopetraceError
from ropetrace.live import LiveRecording, ros_camera
from ropetrace.live.ros_camera import open_ros
from ropetrace.recordings import open_recording
from ropetrace.recordings.ros_frames import CLOUD_TOPIC, COLOR_TOPIC, DEPTH_TOPIC
from ropetrace.recordings.ros_messages import CAMERA, IMAGE
from ropetrace.ros import live_camera
from ropetrace.ros.live_camera import CameraTopics, LiveCamera, camera_info_beside
from ropetrace.ros.zenoh_graph import ZenohNode
from ropetrace.ros.zenoh_session import Connection
from ropetrace.types import BadFrame, CloudFrame, Event, Frame, Intrinsics, RgbdFrame
from ros_rig import LocalNode, free_endpoint, routed, until

LENS = Intrinsics(4, 3, 5.0, 6.0, 1.5, 1.0)
DEPTH = np.arange(12, dtype=np.uint16).reshape(3, 4) + 1000
COLOR = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)
POINTS = np.arange(6, dtype=np.float32).reshape(2, 3) + 1


def rgbd() -> RgbdFrame:
    return RgbdFrame(time.time_ns(), DEPTH, 0.001, LENS, COLOR)


def gray() -> RgbdFrame:
    return RgbdFrame(time.time_ns(), DEPTH, 0.001, LENS, None)


def cloud() -> CloudFrame:
    return CloudFrame(time.time_ns(), POINTS)


def publishing(connection: Connection, frame: Callable[[], Frame], under: str = "") -> AbstractContextManager[None]:
    """A camera on the graph."""
    return ros_rig.publishing(lambda: ZenohNode("camera", connection), frame, under)


def opened(connection: Connection, **topics: str) -> LiveRecording:
    recording = open_recording(f"ros2:{connection.router}", **topics)  # type: ignore[arg-type]
    assert isinstance(recording, LiveRecording)
    return recording


def first(recording: LiveRecording, count: int = 3) -> list[Event]:
    return list(recording.frames(limit=count))


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    monkeypatch.setattr(live_camera, "COLOR_PATIENCE", 0.3)
    monkeypatch.setattr(ros_camera, "PRESENT_SECONDS", 30.0)


def complaint(recording: LiveRecording) -> str:
    """Why there are no frames."""
    with pytest.raises(RecordingError) as caught:
        first(recording)
    return str(caught.value)


def test_images_with_their_colour_and_their_true_age(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_camera, "COLOR_PATIENCE", 10.0)
    with routed() as connection, publishing(connection, rgbd):
        recording = opened(connection)
        # A busy machine may lose one.
        frames = (event for event in recording.frames() if isinstance(event, RgbdFrame))
        stamps = []
        for _ in range(5):
            frame = next(frames)
            assert frame.color is not None
            stamps.append(frame.stamp_ns)
        age = recording.age()
        recording.close()
    np.testing.assert_array_equal(frame.depth, DEPTH)
    np.testing.assert_array_equal(frame.color, COLOR)
    assert frame.depth_unit_m == 0.001
    assert frame.intrinsics == recording.intrinsics == LENS
    assert stamps == sorted(set(stamps))
    # The stamps are this machine's time, so the age counts from them.
    assert not any("counts from the frames' arrival" in line for line in recording.clock_lines())
    assert 0 < age < 5
    assert recording.kind == "live ROS 2 camera"


def test_images_whose_colour_nobody_publishes_come_without() -> None:
    with routed() as connection, publishing(connection, gray):
        event = first(opened(connection))[-1]
    assert isinstance(event, RgbdFrame)
    assert event.color is None


def test_colour_that_is_left_out_and_colour_that_was_asked_for() -> None:
    with routed() as connection:
        with publishing(connection, rgbd):
            event = first(opened(connection, color_topic=""))[-1]
            assert isinstance(event, RgbdFrame)
            assert event.color is None
        with publishing(connection, gray):
            event = first(opened(connection, color_topic=COLOR_TOPIC))[-1]
            assert isinstance(event, BadFrame)
            assert "no colour image within 20 ms" in event.reason


def test_other_topics_have_the_camera_info_beside_them() -> None:
    with routed() as connection, publishing(connection, gray, under="/left"):
        event = first(opened(connection, depth_topic=f"/left{DEPTH_TOPIC}"))[-1]
    assert isinstance(event, RgbdFrame)
    assert camera_info_beside("/left/depth/image_raw") == "/left/depth/camera_info"


def test_clouds() -> None:
    with routed() as connection, publishing(connection, cloud):
        event = first(opened(connection, cloud_topic=CLOUD_TOPIC))[-1]
    assert isinstance(event, CloudFrame)
    np.testing.assert_array_equal(event.points, POINTS)


def test_no_router() -> None:
    endpoint = free_endpoint()
    with pytest.raises(RecordingError, match=f"no router at {endpoint}: start one with `ropetrace node router`"):
        first(opened(Connection(router=endpoint)))


def test_a_graph_without_this_camera_names_those_that_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros_camera, "PRESENT_SECONDS", 1.0)
    with routed() as connection:

        def told(words: str) -> bool:
            """A busy machine may not see all that is published within the second."""
            return words in complaint(opened(connection))

        with pytest.raises(RecordingError, match=f"nothing came on {DEPTH_TOPIC} .* there are no images and no clouds"):
            first(opened(connection))
        with publishing(connection, gray, under="/left"), publishing(connection, cloud):
            there = f"there are {CLOUD_TOPIC} (PointCloud2), /left{DEPTH_TOPIC} (Image)"
            until(lambda: told(f"{there}: choose with --depth-topic or --cloud-topic"))
        with ZenohNode("camera", connection) as silent:
            silent.publisher(DEPTH_TOPIC, IMAGE)
            until(lambda: told("it is published, but silent"))
        with ZenohNode("camera", connection) as wrong:
            wrong.publisher(DEPTH_TOPIC, CAMERA)
            until(lambda: told("CameraInfo, expected sensor_msgs/msg/Image: not read"))


def test_a_camera_of_another_domain_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros_camera, "PRESENT_SECONDS", 1.0)
    with routed() as connection, publishing(connection, gray):
        monkeypatch.setenv("ROS_DOMAIN_ID", "7")
        with pytest.raises(RecordingError, match=r"no clouds at .* with ROS_DOMAIN_ID=7"):
            first(opened(connection))


def test_a_camera_that_goes_and_returns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ropetrace.live.stream.RESTART_SECONDS", 1.0)
    monkeypatch.setattr("ropetrace.live.stream.RETRY_SECONDS", 0.1)
    with routed() as connection:
        recording = opened(connection)
        recording._silence, recording._give_up = 0.2, 300.0
        frames = recording.frames()
        with publishing(connection, rgbd):
            assert isinstance(next(frames), RgbdFrame)
        # Away for so long that it is looked for anew.
        monkeypatch.setattr(ros_camera, "PRESENT_SECONDS", 1.0)
        until(lambda: "nothing came on" in getattr(next(frames), "reason", ""))
        monkeypatch.setattr(ros_camera, "PRESENT_SECONDS", 30.0)
        with publishing(connection, rgbd):
            until(lambda: isinstance(next(frames), RgbdFrame))
        frames.close()  # type: ignore[attr-defined]
    assert any("gave no frame for" in problem for problem in recording.problems)


@pytest.mark.parametrize(
    ("address", "options", "error", "words"),
    [
        ("ros2:", {"cloud_topic": "/c", "depth_topic": "/d"}, RecordingError, "but not both"),
        ("ros2:", {"depth_topic": "d"}, ConfigError, "no full name of a topic"),
        ("ros2:", {"rate": 30.0}, RecordingError, "leave out --rate"),
        ("ros2:127.0.0.1:7447", {}, ConfigError, "expected an endpoint such as tcp/"),
        ("ros1:somewhere", {}, RecordingError, "the master in ROS_MASTER_URI"),
    ],
)
def test_the_door_refuses(address: str, options: dict[str, Any], error: type[RopetraceError], words: str) -> None:
    with pytest.raises(error, match=words):
        open_recording(address, **options)


def test_a_domain_that_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "home")
    with pytest.raises(ConfigError, match="ROS_DOMAIN_ID = 'home'"):
        open_recording("ros2:tcp/127.0.0.1:7447")


def test_ros1_without_rospy_is_one_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rospy", None)
    with pytest.raises(MissingExtraError, match="rospy"):
        open_recording("ros1:")


def seen_for(camera: LiveCamera, node: LocalNode, *left_out: str, seconds: float = 0.5) -> list[Event]:
    """What a camera of 100 frames a second gives: three frames at least."""
    found: list[Event] = []
    end = time.monotonic() + seconds
    while time.monotonic() < end or len(found) < 3:
        node.show(rgbd(), *left_out)
        seen = camera.take()
        if seen is not None:
            found.append(seen.event)
        time.sleep(0.01)
    return found


def test_a_fast_camera_without_its_partners_is_told_and_not_silent() -> None:
    node = LocalNode()
    camera = LiveCamera(node, CameraTopics(), wants_color=True)
    info = camera_info_beside(DEPTH_TOPIC)
    reasons = {getattr(event, "reason", "") for event in seen_for(camera, node, info)}
    assert reasons == {f"{DEPTH_TOPIC}: no camera_info yet on {info}"}
    reasons = {getattr(event, "reason", "") for event in seen_for(camera, node, COLOR_TOPIC)}
    assert any("no colour image within " in reason for reason in reasons)
    assert isinstance(seen_for(camera, node)[-1], RgbdFrame)


def test_colour_that_came_once_is_waited_for() -> None:
    node = LocalNode()
    camera = LiveCamera(node, CameraTopics(), wants_color=True, may_lack_color=True)
    without = seen_for(camera, node, COLOR_TOPIC)
    assert {type(event) for event in without} == {RgbdFrame}
    assert all(event.color is None for event in without if isinstance(event, RgbdFrame))
    complete = seen_for(camera, node, seconds=0.2)
    assert isinstance(complete[-1], RgbdFrame)
    assert complete[-1].color is not None
    assert isinstance(seen_for(camera, node, COLOR_TOPIC)[-1], BadFrame)


def shown(number: int) -> RgbdFrame:
    """A frame of 60 a second whose pixels tell its number in depth and in colour."""
    depth, color = np.full((3, 4), 1000 + number, np.uint16), np.full((3, 4, 3), number, np.uint8)
    return RgbdFrame(1_700_000_000 * 10**9 + number * 16_000_000, depth, 0.001, LENS, color)


@pytest.mark.parametrize("in_order", [False, True])
def test_colour_is_that_of_the_depth_image_and_not_of_the_one_before(
    in_order: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Depth comes first, and once a depth image is lost: what is nearest by then is 16 ms away, and near enough."""
    monkeypatch.setattr(live_camera, "LONGEST_WAIT", 1e6)
    node = LocalNode()
    camera = LiveCamera(node, CameraTopics(), wants_color=True, in_order=in_order)
    pairs = []
    for number in range(12):
        for left_out in ({COLOR_TOPIC}, {DEPTH_TOPIC}):
            node.show(shown(number), *left_out, *([DEPTH_TOPIC] if number == 4 else []))
            seen = camera.take()
            if seen is not None:
                assert isinstance(seen.event, RgbdFrame)
                assert seen.event.color is not None
                pairs.append((int(seen.event.depth[0, 0]) - 1000, int(seen.event.color[0, 0, 0])))
    assert pairs == [(number, number) for number in range(12) if number != 4]


def test_colour_that_is_not_the_nearest_serves_where_no_other_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_camera, "LONGEST_WAIT", 1e6)
    node = LocalNode()
    camera = LiveCamera(node, CameraTopics(), wants_color=True)
    node.show(shown(0), DEPTH_TOPIC)
    node.show(shown(1), COLOR_TOPIC)
    assert camera.take() is None
    monkeypatch.setattr(live_camera, "LONGEST_WAIT", 0.0)
    seen = camera.take()
    assert seen is not None
    assert isinstance(seen.event, RgbdFrame)


def test_what_nobody_takes_in_order_is_counted_and_not_kept() -> None:
    node = LocalNode()
    camera = LiveCamera(node, CameraTopics(cloud=CLOUD_TOPIC), wants_color=False, in_order=True)
    for _ in range(3):
        for _ in range(4):
            node.show(cloud())
        camera.take()
    taken = 3
    while camera.take() is not None:
        taken += 1
    assert taken + camera.skipped == 12
    assert camera.skipped >= 5
    # What makes room before it is looked at counts, too.
    for _ in range(10):
        node.show(cloud())
    while camera.take() is not None:
        taken += 1
    assert taken + camera.skipped == 22


def test_images_in_order_do_not_stay_behind() -> None:
    node = LocalNode()
    camera = LiveCamera(node, CameraTopics(), wants_color=True, in_order=True)
    taken = []
    for number in range(60):
        node.show(shown(number))
        if number % 2:  # two come while one is worked on
            seen = camera.take()
            assert seen is not None
            assert isinstance(seen.event, RgbdFrame)
            taken.append(int(seen.event.depth[0, 0]) - 1000)
            assert number - taken[-1] <= 8
    assert taken == sorted(taken)
    while camera.take() is not None:
        taken.append(0)
    assert len(taken) + camera.skipped == 60


@pytest.mark.parametrize("in_order", [False, True])
def test_the_colour_of_the_frame_beside_is_not_taken_for_a_lost_one(in_order: bool) -> None:
    """At 60 frames a second they are 17 ms apart, in which a rope may go 3 cm."""
    node = LocalNode()
    camera = LiveCamera(node, CameraTopics(), wants_color=True, in_order=in_order)
    start, taken = time.time_ns(), []
    for number in range(40):
        frame = replace(shown(number), stamp_ns=start + number * 16_666_667)
        node.show(frame, *([COLOR_TOPIC] if number % 10 == 9 else []))
        while (seen := camera.take()) is not None:
            if isinstance(seen.event, RgbdFrame) and number > 9:
                assert seen.event.color is not None
                taken.append((seen.event.stamp_ns - start) // 16_666_667)
                assert seen.event.color[0, 0, 0] == taken[-1]
    assert taken == [number for number in range(10, 40) if number % 10 != 9]


def test_images_that_wait_have_bounded_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_camera, "BUFFERED_BYTES", 1000)
    monkeypatch.setattr(live_camera, "LONGEST_WAIT", 1e6)
    node = LocalNode()
    camera = LiveCamera(node, CameraTopics(), wants_color=True, in_order=True)
    for number in range(20):
        node.show(shown(number), COLOR_TOPIC)
        assert camera.take() is None
    assert 1 <= camera.waiting < 12
    assert camera.waiting + camera.skipped == 20


def test_what_a_live_source_loses_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    node = LocalNode()
    camera = open_ros("ros2:tcp/127.0.0.1:1", cloud_topic=CLOUD_TOPIC)
    monkeypatch.setattr(camera, "_graph", replace(camera._graph, join=lambda: node))
    recording = LiveRecording("ros2:", camera)

    def overrun() -> bool:
        for _ in range(10):
            node.show(cloud())
        return camera.lost >= 5

    with ros_rig.publishing(lambda: node, cloud):
        frames = recording.frames()
        next(frames)
        until(overrun)
        frames.close()  # type: ignore[attr-defined]
    assert any(line.startswith("lost      ") and "faster than they were read" in line for line in recording.lines())


ROS1_CAMERA = """
import rospy, time
from sensor_msgs.msg import CameraInfo, Image
rospy.init_node("camera", disable_signals=True)
put = {name: rospy.Publisher("/camera/aligned_depth_to_color/" + name, kind, queue_size=2)
       for name, kind in (("image_raw", Image), ("camera_info", CameraInfo))}
while True:
    info = CameraInfo(width=4, height=3, K=[5, 0, 1.5, 0, 6, 1, 0, 0, 1])
    image = Image(width=4, height=3, encoding="16UC1", step=8, data=b"\\x01\\x04" * 12)
    info.header.stamp = image.header.stamp = rospy.Time.from_sec(time.time())
    put["camera_info"].publish(info)
    put["image_raw"].publish(image)
    time.sleep(0.03)
"""

ROS1_READER = """
import json
from ropetrace.live import ros_camera
from ropetrace.recordings import open_recording
from ropetrace.errors import RecordingError
try:
    next(open_recording("ros1:", depth_topic="/nope/image_raw").frames())
except RecordingError as error:
    print(json.dumps(str(error)), flush=True)
ros_camera.PRESENT_SECONDS = 30
for _ in range(2):
    recording = open_recording("ros1:")
    for frame in recording.frames(limit=3):
        last = frame
    print(json.dumps([type(last).__name__, int(last.depth[0, 0]), last.intrinsics.fx, last.color is None,
                      [line for line in recording.clock_lines() if not line.startswith("lost")]]), flush=True)
"""


def test_ros1(tmp_path: Path) -> None:
    ros1 = pytest.importorskip("test_ros1")
    if ros1.missing():
        pytest.skip(f"ROS 1: {ros1.missing()}")
    core = ros1.Core(tmp_path)
    command = [sys.executable, "-c", ROS1_READER]
    try:
        core.start()
        with core.debian(ROS1_CAMERA):
            core.came("/camera/aligned_depth_to_color/camera_info")
            done = subprocess.run(command, env=core.our_env, capture_output=True, text=True, timeout=300, check=True)
    finally:
        core.stop()
    missing, *frames = map(json.loads, done.stdout.splitlines())
    assert "nothing came on /nope/image_raw" in missing
    assert f"there are {DEPTH_TOPIC} (Image)" in missing
    assert frames == [["RgbdFrame", 0x0401, 5.0, True, []]] * 2
