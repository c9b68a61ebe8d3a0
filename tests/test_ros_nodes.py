"""The nodes of live ROS 2, one at a time: what they make of what comes, and of what does not."""

from __future__ import annotations

import itertools
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("zenoh")
pytest.importorskip("mujoco")
pytest.importorskip("pinocchio")

from ropetrace.control.arm import Arm
from ropetrace.control.limits import Command
from ropetrace.errors import ConfigError, FrameError
from ropetrace.evaluation.case1 import CONDITIONS, Case1Settings, scenario
from ropetrace.evaluation.case2 import PLACEMENTS
from ropetrace.evaluation.metrics import symmetric_mean
from ropetrace.motion import make_motion
from ropetrace.recordings.ros_frames import CLOUD_TOPIC, COLOR_TOPIC, DEPTH_TOPIC, frame_messages
from ropetrace.recordings.ros_messages import CLOUD, IMAGE, RawMessage, decoded, stamp_and_frame
from ropetrace.results.ros_estimates import DIAGNOSTICS, PATH, TRAJECTORY, header, make, typestore
from ropetrace.ros import messages, simulated_cell
from ropetrace.ros.commanded import CommandedMotion
from ropetrace.ros.graph import Publisher, RosNode, Subscription
from ropetrace.ros.kinematic_system import ARM_GONE, ArmSettings, KinematicSystem, ReceivedMotion
from ropetrace.ros.live_camera import CameraTopics, LiveCamera
from ropetrace.ros.messages import JOINTS, NUMBERS, POSES, TIME, JointReading
from ropetrace.ros.reporting import Reporter
from ropetrace.ros.robot_filter import RobotFilter
from ropetrace.ros.simulated_cell import ARM_AWAY, COMMAND_LASTS, CellSettings, SimulatedCell, cell_config
from ropetrace.ros.track_deformable import TrackDeformable
from ropetrace.ros.trajectory_tracker import TrajectoryTracker
from ropetrace.ros.zenoh_graph import ZenohNode
from ropetrace.sim.scenario import CLUTTER, ROBOT_COLOR, SimulatedScene
from ropetrace.sim.scene import Capsules
from ropetrace.types import BadFrame, CloudFrame, FloatArray, Frame, Motion, RgbdFrame, Status, Waypoints, moved
from ros_rig import LocalNode, routed, until
from ros_twins import path, trajectory

PANDA = Arm.named("panda")
START = np.array(PLACEMENTS["behind"].start)


@pytest.fixture(scope="module")
def scene() -> tuple[RgbdFrame, FloatArray]:
    """A rope that hangs still, and where it is."""
    simulated = SimulatedScene(scenario(CONDITIONS[0], 0.0, Case1Settings()))
    frame = simulated.camera.expose(simulated.scene_at, simulated.camera.stamp(1), 1)
    return frame, simulated.truth().polyline


class Sender:
    """A camera: sends frames with the stamps that they are given."""

    def __init__(self, node: ZenohNode) -> None:
        self._node = node
        self._publishers: dict[str, Publisher] = {}

    def send(self, frame: Frame, ahead: float = 0.0, without: str = "") -> None:
        for message in frame_messages(replace(frame, stamp_ns=time.time_ns() + round(ahead * 1e9))):
            if message.topic == without:
                continue
            if message.topic not in self._publishers:
                self._publishers[message.topic] = self._node.publisher(message.topic, message.type)
            self._publishers[message.topic].put_packed(bytes(message.data))
        time.sleep(0.03)


@contextmanager
def running(node: Any) -> Iterator[None]:
    """A node that runs beside the test."""
    stop = threading.Event()
    thread = threading.Thread(target=node.run, args=(stop.is_set,))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@contextmanager
def graph() -> Iterator[tuple[ZenohNode, ZenohNode]]:
    """A node under test, and one beside it."""
    with routed() as connection, ZenohNode("tested", connection) as tested, ZenohNode("beside", connection) as beside:
        yield tested, beside


def says(read: Subscription, words: str, do: Callable[[], None] = lambda: None) -> Callable[[], bool]:
    def heard() -> bool:
        do()
        time.sleep(0.01)
        return any(words in decoded(message).status[0].message for message in read.take())

    return heard


def tracked(camera: Sender, frame: Frame, paths: Subscription) -> Callable[[], bool]:
    def found() -> bool:
        camera.send(frame)
        return poses(paths.newest()) > 10

    return found


def poses(message: RawMessage | None) -> int:
    return -1 if message is None else len(decoded(message).poses)


def test_images_become_a_path_poses_and_a_status(scene: tuple[RgbdFrame, FloatArray]) -> None:
    frame, truth = scene
    with graph() as (node, beside):
        camera = Sender(beside)
        paths, arrays = (
            beside.subscription("/ropetrace/centerline", PATH),
            beside.subscription("/ropetrace/poses", POSES),
        )
        statuses = beside.subscription("/ropetrace/status", DIAGNOSTICS)
        with running(TrackDeformable(node, cell_config())):
            newest: dict[str, RawMessage] = {}

            def found() -> bool:
                camera.send(frame)
                for read in (paths, arrays, statuses):
                    message = read.newest()
                    if message is not None:
                        newest[read.type] = message
                # The first image may come before its camera_info.
                return len(newest) == 3 and poses(newest[PATH]) > 10

            until(found)
        waypoints = messages.waypoints(newest[PATH])
        assert symmetric_mean(waypoints.positions, truth) < 0.003, "metres"
        assert stamp_and_frame(newest[PATH])[1] == "camera_color_optical_frame"
        assert abs(time.time_ns() - stamp_and_frame(newest[PATH])[0]) < 60e9
        assert len(decoded(newest[POSES]).poses) == len(waypoints)
        status = decoded(newest[DIAGNOSTICS]).status[0]
        assert status.level == status.OK
        values = {pair.key: pair.value for pair in status.values}
        assert values["status"] == "ok"
        assert float(values["length"]) == pytest.approx(waypoints.length, rel=0.01)


def test_clouds_become_a_path(scene: tuple[RgbdFrame, FloatArray]) -> None:
    frame, truth = scene
    lens = frame.intrinsics
    rows, columns = np.nonzero((frame.depth > 0) & np.isfinite(frame.depth) & (frame.color[:, :, 0] > 60))  # type: ignore[index]
    depth = frame.depth[rows, columns]
    points = np.stack([(columns - lens.cx) / lens.fx * depth, (rows - lens.cy) / lens.fy * depth, depth], axis=1)
    assert frame.color is not None
    cloud = CloudFrame(0, points.astype(np.float32), frame.color[rows, columns])
    with graph() as (node, beside):
        camera, paths = Sender(beside), beside.subscription("/ropetrace/centerline", PATH)
        with running(TrackDeformable(node, cell_config(), CameraTopics(cloud=CLOUD_TOPIC))):
            got: list[RawMessage] = []

            def found() -> bool:
                camera.send(cloud)
                got.extend(message for message in paths.take() if poses(message) > 1)
                return bool(got)

            until(found)
        assert symmetric_mean(messages.waypoints(got[-1]).positions, truth) < 0.003, "metres"


def test_a_camera_of_the_wrong_type_is_told(scene: tuple[RgbdFrame, FloatArray]) -> None:
    with graph() as (node, beside):
        heard = beside.subscription("/diagnostics", DIAGNOSTICS, depth=100)
        beside.publisher(DEPTH_TOPIC, CLOUD)
        with running(TrackDeformable(node, cell_config())):
            until(
                says(heard, f"{DEPTH_TOPIC} of node beside is sensor_msgs/msg/PointCloud2, expected {IMAGE}: not read")
            )


def test_a_stamp_from_the_future_is_told(scene: tuple[RgbdFrame, FloatArray]) -> None:
    with graph() as (node, beside):
        camera, heard = Sender(beside), beside.subscription("/diagnostics", DIAGNOSTICS, depth=100)
        with running(TrackDeformable(node, cell_config())):
            until(says(heard, "s in the future: the clocks", lambda: camera.send(scene[0], ahead=5.0)))
            until(says(heard, "tracking", lambda: camera.send(scene[0])))


def test_a_camera_may_change_its_size(scene: tuple[RgbdFrame, FloatArray]) -> None:
    frame = scene[0]
    lens = frame.intrinsics
    assert frame.color is not None
    smaller = RgbdFrame(
        0,
        np.ascontiguousarray(frame.depth[::2, ::2]),
        frame.depth_unit_m,
        replace(
            lens, width=lens.width // 2, height=lens.height // 2, fx=lens.fx / 2, fy=lens.fy / 2,
            cx=lens.cx / 2, cy=lens.cy / 2,
        ),
        np.ascontiguousarray(frame.color[::2, ::2]),
    )  # fmt: skip
    with graph() as (node, beside):
        camera, paths = Sender(beside), beside.subscription("/ropetrace/centerline", PATH, depth=1000)
        with running(TrackDeformable(node, cell_config())):
            for shown in (frame, smaller, frame, smaller):
                for _ in range(5):
                    camera.send(shown)
                paths.take()
                until(tracked(camera, shown, paths))
            # Images of one size with the camera_info of another are told, not tracked.
            wrong = frame_messages(replace(frame, stamp_ns=time.time_ns()))
            heard = beside.subscription("/diagnostics", DIAGNOSTICS, depth=100)
            senders = {
                message.topic: beside.publisher(message.topic, message.type)
                for message in wrong
                if message.type == IMAGE
            }

            def mixed() -> None:
                for message in frame_messages(replace(frame, stamp_ns=time.time_ns())):
                    if message.topic in senders:
                        senders[message.topic].put_packed(bytes(message.data))

            until(says(heard, "its intrinsics are for 240x180", mixed))


def test_a_camera_that_vanishes_is_told_and_one_that_returns_is_tracked(scene: tuple[RgbdFrame, FloatArray]) -> None:
    with routed() as connection, ZenohNode("tested", connection) as node, ZenohNode("reader", connection) as reader:
        heard = reader.subscription("/diagnostics", DIAGNOSTICS, depth=100)
        paths = reader.subscription("/ropetrace/centerline", PATH, depth=1000)
        with running(TrackDeformable(node, cell_config())):
            for _ in range(2):
                with ZenohNode("camera", connection) as beside:
                    camera = Sender(beside)
                    until(tracked(camera, scene[0], paths))
                until(says(heard, f"nothing came on {DEPTH_TOPIC} for"))


def test_depth_without_its_colour_or_camera_is_told(scene: tuple[RgbdFrame, FloatArray]) -> None:
    with graph() as (node, beside):
        camera, heard = Sender(beside), beside.subscription("/diagnostics", DIAGNOSTICS, depth=100)
        info = DEPTH_TOPIC.rsplit("/", 1)[0] + "/camera_info"
        with running(TrackDeformable(node, cell_config())):
            until(says(heard, f"no camera_info yet on {info}", lambda: camera.send(scene[0], without=info)))
            until(says(heard, "no colour image within 20 ms", lambda: camera.send(scene[0], without=COLOR_TOPIC)))


def test_damaged_messages_are_told_and_survived(scene: tuple[RgbdFrame, FloatArray]) -> None:
    with graph() as (node, beside):
        camera, heard = Sender(beside), beside.subscription("/diagnostics", DIAGNOSTICS, depth=100)
        damaged = beside.publisher(DEPTH_TOPIC, IMAGE)
        with running(TrackDeformable(node, cell_config())):
            until(says(heard, "has no whole header", lambda: damaged.put_packed(b"\x00\x01\x00\x00abc")))
            until(says(heard, "tracking", lambda: camera.send(scene[0])))


def test_topics_that_are_the_same() -> None:
    with pytest.raises(ConfigError, match="a topic of its own"):
        CameraTopics(depth="/a", color="/a")


def straight(shift: float) -> Waypoints:
    positions = np.stack([np.full(50, shift), np.zeros(50), np.linspace(1.0, 1.49, 50)], axis=1)
    return Waypoints(positions, np.tile([0.0, 0.0, 0.0, 1.0], (50, 1)), positions[:, 2] - 1.0)


def test_paths_become_velocities_and_a_prediction() -> None:
    speed = 0.3
    with graph() as (node, beside):
        sent = beside.publisher("/ropetrace/centerline", PATH)
        moving = beside.subscription("/ropetrace/motion", TRAJECTORY, depth=1000)
        predicted = beside.subscription("/ropetrace/predicted", PATH, depth=1000)
        heard = beside.subscription("/diagnostics", DIAGNOSTICS, depth=100)
        began = time.time()
        with running(TrajectoryTracker(node, cell_config())):
            for _ in range(90):
                now = time.time()
                sent.put(path(header(round(now * 1e9), "camera"), straight(speed * (now - began))))
                time.sleep(1 / 30)
            known = messages.moving_waypoints(moving.take()[-1])
            assert known is not None
            assert np.abs(known[1].velocities - [speed, 0, 0]).max() < 0.02, "m/s"
            last = predicted.take()[-1]
            stamp, frame_id = stamp_and_frame(last)
            assert frame_id == "camera"
            # A sleep that is not exact is no error: the prediction is for its own stamp.
            assert np.abs(messages.waypoints(last).positions[:, 0] - speed * (stamp / 1e9 - began)).max() < 0.003
            until(says(heard, "the rope is lost", lambda: sent.put(path(header(time.time_ns(), ""), Waypoints.none()))))
            until(says(heard, "nothing came on /ropetrace/centerline"))
            one = make(PATH, header(time.time_ns(), ""), decoded(last).poses[:1])
            until(says(heard, "1 poses: expected none, or 2", lambda: sent.put(one)))


def test_a_path_from_the_future_is_not_followed_until_the_clocks_agree() -> None:
    node = LocalNode()
    tracker = TrajectoryTracker(node, cell_config())
    sent = node.publisher("/ropetrace/centerline", PATH)
    outputs = [
        node.subscription("/ropetrace/motion", TRAJECTORY, depth=1000),
        node.subscription("/ropetrace/predicted", PATH, depth=1000),
    ]
    heard = node.subscription("/diagnostics", DIAGNOSTICS, depth=100)

    def follow(ahead: float) -> int:
        """How many of the outputs came."""
        sent.put(path(header(time.time_ns() + round(ahead * 1e9), "camera"), straight(0.1)))
        tracker.step()
        time.sleep(0.01)
        return sum(len(output.take()) for output in outputs)

    assert [follow(10.0) for _ in range(5)] == [0] * 5
    assert any("in the future: the clocks" in decoded(message).status[0].message for message in heard.take())
    until(lambda: follow(0.0) == 2)


def test_no_motion_is_no_trajectory_tracker() -> None:
    config = cell_config()
    with graph() as (node, _), pytest.raises(ConfigError, match="needs the motion"):
        TrajectoryTracker(node, replace(config, motion=replace(config.motion, method="none")))


class ArmAndRope:
    """An arm that does exactly as it is told, and a rope at rest: both sent by `beside`."""

    def __init__(self, beside: RosNode) -> None:
        self.position = START.copy()
        self.ropes: list[int] = []
        self._joints = beside.publisher("/joint_states", JOINTS)
        self._paths = beside.publisher("/ropetrace/centerline", PATH)
        self._moving = beside.publisher("/ropetrace/motion", TRAJECTORY)
        self._camera_from_base = np.linalg.inv(cell_config().world_from_camera())
        tool = PANDA.forward(START)[:3, 3]
        offsets = np.linspace(-0.02, 0.4, 80)[:, None] * [0.0, 0.0, -1.0]
        points = (tool + offsets) @ self._camera_from_base[:3, :3].T + self._camera_from_base[:3, 3]
        turns = np.tile([0.0, 0.0, 0.0, 1.0], (80, 1))
        self._rope = Waypoints(points, turns, np.linspace(0, 0.42, 80))

    def send_joints(self, ahead: float = 0.0) -> None:
        held = header(time.time_ns() + round(ahead * 1e9), "")
        self._joints.put(messages.joint_state(held, PANDA.joint_names, self.position, np.zeros(7)))

    def send_gripper(self) -> None:
        held, fingers = header(time.time_ns(), ""), ("panda_finger_joint1", "panda_finger_joint2")
        self._joints.put(messages.joint_state(held, fingers, np.zeros(2), np.zeros(2)))

    def send_rope(self, ahead: float = 0.0) -> None:
        self.ropes.append(time.time_ns() + round(ahead * 1e9))
        held, still = header(self.ropes[-1], "camera"), np.zeros((80, 3))
        self._moving.put(trajectory(held, self._rope, Motion(still, still, still, still, still)))

    def send_lost(self) -> None:
        self._paths.put(path(header(time.time_ns(), "camera"), Waypoints.none()))


class Drive:
    """An arm that is driven by the node in steps, in real time, without a graph."""

    def __init__(self) -> None:
        self.node = LocalNode()
        self.velocities = self.node.subscription("/ropetrace/velocity_commands", NUMBERS, depth=10_000)
        self.named = self.node.subscription("/ropetrace/joint_commands", JOINTS, depth=10_000)
        self.basis = self.node.subscription("/ropetrace/command_basis", TIME, depth=10_000)
        self._told = self.node.subscription("/diagnostics", DIAGNOSTICS, depth=1000)
        self.cell = ArmAndRope(self.node)
        self.system = KinematicSystem(self.node, cell_config().world_from_camera(), ArmSettings(rate=50))
        self._velocity, self._told_at = np.zeros(7), time.time()

    def joints(self) -> None:
        self.cell.send_joints()

    def rope(self) -> None:
        self.cell.send_rope()

    def step(self, *send: Callable[[], None]) -> Command | None:
        """Send, and make one step; what was told by it. The arm holds each command until the next."""
        now = time.time()
        self.cell.position = self.cell.position + (now - self._told_at) * self._velocity
        for one in send:
            one()
        command = self.system.step(now)
        self._told_at = now
        self._velocity = np.zeros(7) if command is None else command.velocity
        time.sleep(self.system.period)
        return command

    def until(self, condition: Callable[[Command | None], bool], *send: Callable[[], None]) -> None:
        """Step until a command is as it should be."""
        until(lambda: condition(self.step(*send)))

    def steps(self, seconds: float, *send: Callable[[], None]) -> list[Command | None]:
        """What was told meanwhile, in three steps at least."""
        end = time.monotonic() + seconds
        told: list[Command | None] = []
        while time.monotonic() < end or len(told) < 3:
            told.append(self.step(*send))
        return told

    def said(self) -> list[str]:
        """On /diagnostics since the last call."""
        return [decoded(message).status[0].message for message in self._told.take()]


def fast(command: Command | None) -> bool:
    return command is not None and float(np.abs(command.velocity).max()) > 0.01


def rests(words: str) -> Callable[[Command | None], bool]:
    """That the arm stands still, for this reason."""
    return lambda command: command is not None and not command.velocity.any() and words in command.text


def test_the_arm_moves_only_while_all_is_known() -> None:
    drive = Drive()
    cell, joints, rope = drive.cell, drive.joints, drive.rope
    assert not any(drive.steps(0.2, rope))
    assert drive.velocities.take() == []

    drive.until(fast, joints, rope)
    assert drive.velocities.take()
    assert drive.named.take()

    # A rope that is not seen any more stops the arm, and one that is seen again is traced.
    drive.until(rests("old"), joints)
    drive.until(fast, joints, rope)

    # So do frames in which it is lost.
    def rests_for_it() -> bool:
        """Within five steps: later it is old."""
        drive.until(fast, joints, rope)
        return any(rests("the rope is lost")(drive.step(joints, *[cell.send_lost] * 4)) for _ in range(5))

    until(rests_for_it)
    drive.until(fast, joints, rope)

    # An arm that is not heard any more is braked; when it is back elsewhere, all begins anew from there.
    drive.until(rests(""), rope)
    drive.until(lambda command: command is None, rope)
    cell.position = START + 0.3 * (np.arange(7) == 6)
    drive.until(fast, joints, rope)


def test_an_arm_that_was_not_where_it_was_sent_stops_for_good() -> None:
    """Even if it says nothing for longer than an arm that is gone."""
    drive = Drive()
    drive.until(fast, drive.joints, drive.rope)
    drive.cell.position = drive.cell.position + 0.3 * (np.arange(7) == 6)
    drive.until(rests("apart"), drive.joints, drive.rope)
    assert all(map(rests("apart"), drive.steps(ARM_GONE + 0.2, drive.rope)))
    assert all(map(rests("apart"), drive.steps(0.3, drive.joints, drive.rope)))


def test_motion_from_the_future_stops_the_arm_and_true_motion_moves_it_again() -> None:
    drive = Drive()
    drive.until(fast, drive.joints, drive.rope)
    drive.until(rests("in the future"), drive.joints, lambda: drive.cell.send_rope(3600.0))
    drive.until(fast, drive.joints, drive.rope)


@pytest.mark.parametrize(
    ("ahead", "said"), [(-1000.0, r"1\d\d\d\.\d\d s old"), (1000.0, r"(1000|9\d\d)\.\d\d s in the future")]
)
def test_joints_of_another_time_stop_the_arm(ahead: float, said: str) -> None:
    drive = Drive()
    drive.steps(0.2, lambda: drive.cell.send_joints(ahead), drive.rope)
    assert drive.velocities.take() == []
    words = re.compile(f"/joint_states: the stamp is {said}: the clocks of the arm and of this machine differ")
    assert any(map(words.search, drive.said()))
    drive.until(fast, drive.joints, drive.rope)
    drive.until(rests(""), lambda: drive.cell.send_joints(ahead), drive.rope)
    until(lambda: drive.step(lambda: drive.cell.send_joints(ahead)) and any(map(words.search, drive.said())))
    drive.until(fast, drive.joints, drive.rope)


def test_a_gripper_on_the_arms_topic_is_passed_over() -> None:
    drive = Drive()
    drive.step(drive.cell.send_gripper)
    drive.step(drive.cell.send_gripper)
    assert any("the joint panda_joint1 is not in it: panda_finger_joint1" in told for told in drive.said())
    drive.until(fast, drive.joints, *[drive.cell.send_gripper] * 3, drive.rope)
    assert "ok" not in [told for told in drive.said() if "finger" in told]


@pytest.mark.parametrize("fails", [True, False])
def test_whatever_ends_the_node_the_arm_comes_to_rest(fails: bool) -> None:
    drive = Drive()
    sent: list[FloatArray] = []

    def take() -> None:
        for message in drive.velocities.take():
            sent.append(np.array(decoded(message).data))
            drive.cell.position = drive.cell.position + drive.system.period * sent[-1]

    def told_to_stop() -> bool:
        take()
        if sent and np.abs(sent[-1]).max() > 0.05:
            if fails:
                raise RuntimeError("in mid-motion")
            return True
        drive.joints()
        drive.rope()
        return False

    if fails:
        with pytest.raises(RuntimeError, match="in mid-motion"):
            drive.system.run(told_to_stop)
    else:
        drive.system.run(told_to_stop)
    moving = len(sent)
    take()
    assert np.abs(sent[moving - 1]).max() > 0.05
    assert len(sent) - moving >= 3
    assert not np.any(sent[-3:]), "it is told so more than once"


def test_a_node_whose_stderr_is_closed_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    class Closed:
        def write(self, text: str) -> int:
            raise BrokenPipeError

        flush = write

    node = LocalNode()
    heard = node.subscription("/diagnostics", DIAGNOSTICS)
    monkeypatch.setattr("sys.stderr", Closed())
    Reporter(node).tell(Status.OK, "tracing")
    assert [decoded(message).status[0].message for message in heard.take()] == ["tracing"]


def test_a_change_is_told_again_soon_and_what_flickers_fills_no_log(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    node, clock = LocalNode(), [100.0]
    heard = node.subscription("/diagnostics", DIAGNOSTICS, depth=1000)
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    reporter = Reporter(node)

    def told(texts: list[str]) -> tuple[list[str], list[str]]:
        """One each 10 ms; on the topic and on stderr."""
        for text in texts:
            reporter.tell(Status.OK, text)
            clock[0] += 0.01
        said = capsys.readouterr().err.splitlines()
        return [decoded(message).status[0].message for message in heard.take()], said

    assert told(["tracing"] * 50)[0] == ["tracing"] * 2
    assert told(["done"] * 100)[0] == ["done"] * 2, "at once and after 0.1 s, of which one may be lost"
    assert told(["done"] * 200)[0] == ["done"] * 2
    flickers, said = told(["tracing", "lost"] * 500)
    assert len(flickers) == 1000
    assert 18 <= len(said) <= 22, "each once a second"
    assert told(["lost"] * 200)[1][-1:] == [], "what stays was said last"
    assert told(["tracing"] * 5 + ["lost"] * 200)[1][-1] == "local: ok: lost"


def test_damaged_paths_beside_a_sound_motion_do_not_stop_the_arm() -> None:
    drive = Drive()
    paths = drive.node.publisher("/ropetrace/centerline", PATH)
    drive.until(fast, drive.joints, drive.rope)
    for _ in range(20):
        drive.step(drive.joints, drive.rope, lambda: paths.put_packed(b"damaged"))
    drive.until(fast, drive.joints, drive.rope, lambda: paths.put_packed(b"damaged"))


def test_a_joint_that_is_missing_is_told() -> None:
    state = messages.joint_state(header(1, ""), ("a", "b"), np.array([1.0, 2.0]), None)
    message = RawMessage("/joint_states", JOINTS, "cdr", 0, bytes(typestore().serialize_cdr(state, JOINTS)))
    assert messages.joint_values(message, ("b", "a"), "position").tolist() == [2.0, 1.0]
    with pytest.raises(FrameError, match="the joint c is not in it: a, b"):
        messages.joint_values(message, ("c",), "position")
    with pytest.raises(FrameError, match="2 joints, but 0 of velocity"):
        messages.joint_values(message, ("a",), "velocity")


@pytest.mark.parametrize(
    "wrong", [{"rate": 0.5}, {"rate": float("nan")}, {"response": 0.2}, {"response": -1.0}, {"joint_topic": "joints"}]
)
def test_an_arm_that_cannot_be(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        ArmSettings(**wrong)


def test_predictions_are_those_of_the_motion_that_was_sent() -> None:
    own, received = make_motion("arc_length", 0.015), ReceivedMotion()
    assert own is not None
    arcs = np.linspace(0.0, 0.6, 40)
    motion = None
    for frame in range(12):
        time_s = frame / 30
        places = np.stack([0.1 * arcs * np.sin(5 * time_s), arcs, np.ones(40)], axis=1)
        rope = Waypoints(places, np.tile([0.0, 0.0, 0.0, 1.0], (40, 1)), arcs)
        motion = own.update(round(time_s * 1e9), rope)
    assert motion is not None
    received.announce(motion)
    received.update(round(time_s * 1e9), rope)
    for ahead in (0.0, 0.004, 0.03):
        ours, theirs = received.predict(ahead), own.predict(ahead)
        assert ours is not None
        assert theirs is not None
        np.testing.assert_allclose(ours[0], theirs[0], atol=1e-9)
        np.testing.assert_allclose(ours[1].velocities, theirs[1].velocities, atol=1e-9)
        np.testing.assert_allclose(ours[1].accelerations, theirs[1].accelerations, atol=1e-9)


def test_each_command_names_the_image_that_it_rests_on() -> None:
    drive = Drive()
    drive.until(fast, drive.joints, drive.rope)
    drive.steps(0.1, drive.joints, drive.rope)
    stamps = [stamp_and_frame(message)[0] for message in drive.named.take()]
    seen = [decoded(message) for message in drive.basis.take()]
    assert len(seen) > 1
    ropes = []
    for told in seen:
        assert told.header.stamp.sec * 10**9 + told.header.stamp.nanosec in stamps
        ropes.append(told.time_ref.sec * 10**9 + told.time_ref.nanosec)
    assert set(ropes) <= set(drive.cell.ropes)
    assert ropes == sorted(ropes)
    assert ropes[-1] == drive.cell.ropes[-1]


def reading(age: float) -> messages.JointReading:
    """Of joints at `START`, as a message that is this old tells it at a billion seconds; infinitely old: no stamp."""
    stamp_ns = 0 if np.isinf(age) else round((1e9 - age) * 1e9)
    state = messages.joint_state(header(stamp_ns, ""), PANDA.joint_names, START, None)
    data = bytes(typestore().serialize_cdr(state, JOINTS))
    return messages.joint_reading(RawMessage("/joint_states", JOINTS, "cdr", 10**18, data), PANDA.joint_names)


def going(until: float = 1e9, response: float = 0.0) -> CommandedMotion:
    """Joints that are told 0.5 rad/s each 10 ms for the last 0.2 s."""
    told = CommandedMotion(100, response)
    for step in range(-20, 1):
        told.command(until + step * 0.01, np.full(7, 0.5))
    return told


@pytest.mark.parametrize(
    ("age", "response", "carried"),
    [(0.02, 0.0, 0.01), (0.085, 0.0, 0.0425), (0.02, 0.005, 0.01), (-0.01, 0.0, 0), (np.inf, 0.0, 0)],
)
def test_joints_are_carried_on_from_their_stamp(age: float, response: float, carried: float) -> None:
    """A message 20 ms old, of joints told 0.5 rad/s, is 10 mrad behind; one without a stamp is of its arrival."""
    position = going(response=response).carried_on(1e9, reading(age))
    assert position is not None
    np.testing.assert_allclose(position - START, carried, atol=1e-6)


def test_joints_without_a_stamp_are_carried_on_from_their_arrival() -> None:
    position = going(1e9 + 0.04).carried_on(1e9 + 0.04, reading(np.inf))
    assert position is not None
    np.testing.assert_allclose(position - START, 0.02, atol=1e-6)


def test_joints_that_turned_round_are_not_carried_on_as_they_went() -> None:
    """The arm went on for 50 ms after the message and then back for 40: by its own velocity it would be far away."""
    told = CommandedMotion(200)
    assert np.array_equal(told.carried_on(1e9, reading(0.09)), START)  # type: ignore[arg-type]
    for step in range(-28, 0):
        told.command(1e9 + step * 0.005, np.full(7, 4.0 if step < -8 else -4.0))
    position = told.carried_on(1e9, reading(0.09))
    assert position is not None
    np.testing.assert_allclose(position - START, 0.05 * 4 - 0.04 * 4, atol=1e-6)


def test_a_command_lasts_until_the_next_however_late_it_comes() -> None:
    told = going()
    told.command(1e9 + 0.06, np.zeros(7))
    position = told.carried_on(1e9 + 0.08, JointReading(10**18 - 10_000_000, START))
    assert position is not None
    np.testing.assert_allclose(position - START, 0.07 * 0.5, atol=1e-6)
    # A clock that is set back begins anew.
    told.command(1e9 - 100, np.zeros(7))
    assert np.array_equal(told.carried_on(1e9 - 99.99, JointReading(10**18 - 100 * 10**9, START)), START)  # type: ignore[arg-type]


@pytest.mark.parametrize("age", [5, 0.11, -0.03, -3600])
def test_joints_of_another_time_say_nothing(age: float) -> None:
    """The last is a clock that was set back by an hour after the message came."""
    assert going().carried_on(1e9, reading(age)) is None


@pytest.mark.parametrize("in_order", [False, True])
def test_the_newest_frame_or_every_one(scene: tuple[RgbdFrame, FloatArray], in_order: bool) -> None:
    with graph() as (node, beside):
        camera, sender = LiveCamera(node, CameraTopics(), True, in_order=in_order), Sender(beside)
        expected = 3 if in_order else 1

        def as_many_come_of_three() -> bool:
            """As far as the graph knows them both, and loses none."""
            while camera.take() is not None:
                """Those of before."""
            for _ in range(3):
                sender.send(scene[0])
            time.sleep(0.2)
            taken = []
            while (seen := camera.take()) is not None:
                taken.append(seen.event.stamp_ns)
            assert sorted(taken) == taken
            return len(taken) == expected

        until(as_many_come_of_three)


def test_the_arm_is_taken_out_of_the_image() -> None:
    """Joints of the image's time do it, those of another do not, and that is told."""
    moving = SimulatedScene(scenario(CONDITIONS[0], 0.0, Case1Settings()))
    placement = PLACEMENTS["behind"]
    starts, ends, radii = PANDA.capsules(START)
    pose = placement.world_from_base()
    moving.robot = Capsules.between(moved(starts, pose), moved(ends, pose), radii, ROBOT_COLOR, CLUTTER)
    frame = moving.camera.expose(moving.scene_at, moving.camera.stamp(1), 1)
    moving.robot = Capsules.none()
    without = moving.camera.expose(moving.scene_at, moving.camera.stamp(1), 1)
    seen = frame.depth != without.depth
    assert seen.sum() > 500
    with graph() as (node, beside):
        robot = RobotFilter(node, PANDA, "/joint_states", cell_config().world_from_camera())
        joints = beside.publisher("/joint_states", JOINTS)
        assert robot.clear(frame) is frame
        assert "nothing on /joint_states is of its time" in robot.fault

        def sent(ahead: float, offset: float) -> None:
            held = header(frame.stamp_ns + round(ahead * 1e9), "")
            joints.put(messages.joint_state(held, PANDA.joint_names, START + offset, None))
            # The image is between these, and nearer to them.
            held = header(frame.stamp_ns + round(ahead / 2 * 1e9), "")
            joints.put(messages.joint_state(held, ("panda_finger_joint1",), np.zeros(1), None))

        def cleared() -> bool:
            sent(-0.01, -0.3)
            sent(0.03, 0.9)
            time.sleep(0.02)
            made = robot.clear(frame)
            assert isinstance(made, RgbdFrame)
            return robot.fault == "" and not made.depth[seen].any()

        until(cleared)
        assert robot.clear(BadFrame(frame.stamp_ns, "bad")) == BadFrame(frame.stamp_ns, "bad")
        late = replace(frame, stamp_ns=frame.stamp_ns + 10**9)
        assert robot.clear(late) is late


def test_an_arm_that_is_put_back_says_nothing_and_stands_still() -> None:
    node = LocalNode()
    cell = SimulatedCell(node, CellSettings(condition="60fps"))
    joints = node.subscription("/joint_states", JOINTS, depth=10_000)
    images = node.subscription(DEPTH_TOPIC, IMAGE)
    commands = node.publisher("/ropetrace/joint_commands", JOINTS)
    heard: list[float] = []
    moved: list[float] = []
    ended: list[float] = []
    back_at = ARM_AWAY + 0.5

    def tick(now: float) -> None:
        fast = messages.joint_state(header(time.time_ns(), ""), PANDA.joint_names, None, np.full(7, 0.1))
        commands.put(fast)
        heard.extend([now] if joints.take() else [])
        moved.extend([now] if np.abs(cell.moving.position - START).max() > 1e-6 else [])
        if not put_back and now > back_at and moved and heard:
            cell.put_back()
            put_back.append(now)
        ended.extend([now] if put_back and now > put_back[0] + ARM_AWAY + 0.5 else [])

    put_back: list[float] = []
    cell.run(lambda: bool(ended), tick)
    for times in (heard, moved):
        assert min(times) >= ARM_AWAY
        assert any(now <= put_back[0] for now in times)
        assert not any(put_back[0] < now < put_back[0] + ARM_AWAY for now in times)
        assert any(now >= put_back[0] + ARM_AWAY for now in times)
    assert decoded(images.take()[-1]).width == 1280


def test_a_simulation_that_stalls_makes_up_for_it_by_the_commands_of_each_moment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A real arm does not wait for a slow camera."""
    monkeypatch.setattr(simulated_cell, "MOST_BEHIND", 300.0)
    node = LocalNode()
    cell = SimulatedCell(node)
    commands = node.publisher("/ropetrace/joint_commands", JOINTS)
    told: list[tuple[float, float]] = []
    started, stalled, ended = threading.Event(), threading.Event(), threading.Event()
    behind: list[float] = []

    def command() -> None:
        assert started.wait(300)
        for step in range(100):
            speed = 0.3 if step < 50 else 0.0
            velocity = np.full(7, speed)
            told.append((time.time(), speed))
            commands.put(messages.joint_state(header(time.time_ns(), ""), PANDA.joint_names, None, velocity))
            if step == 30:
                stalled.set()
            time.sleep(0.01)
        ended.set()

    def tick(now: float) -> None:
        behind.append(time.monotonic() - now)
        if now > ARM_AWAY + 0.1:
            started.set()
        if stalled.is_set():
            stalled.clear()
            time.sleep(0.3)

    thread = threading.Thread(target=command)
    thread.start()
    cell.run(lambda: ended.is_set() and behind[-1] < min(behind) + 0.02, tick)
    thread.join()
    gone = sum(speed * min(after - at, COMMAND_LASTS) for (at, speed), (after, _) in itertools.pairwise(told))
    np.testing.assert_allclose(cell.moving.position - START, gone, atol=0.012)


def test_a_cell_that_cannot_be() -> None:
    with pytest.raises(ConfigError, match="condition = '45fps': choose of 30fps, 60fps"):
        CellSettings(condition="45fps")
