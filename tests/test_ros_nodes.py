"""The nodes of live ROS 2, one at a time: what they make of what comes, and of what does not."""

from __future__ import annotations

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
from ropetrace.errors import ConfigError, FrameError
from ropetrace.evaluation.case1 import CONDITIONS, Case1Settings, scenario
from ropetrace.evaluation.case2 import PLACEMENTS
from ropetrace.evaluation.metrics import symmetric_mean
from ropetrace.motion import make_motion
from ropetrace.recordings.ros_frames import CLOUD_TOPIC, COLOR_TOPIC, DEPTH_TOPIC, frame_messages
from ropetrace.recordings.ros_messages import CLOUD, IMAGE, RawMessage, decoded, stamp_and_frame
from ropetrace.results.ros_estimates import DIAGNOSTICS, PATH, TRAJECTORY, header, make, typestore
from ropetrace.ros import messages
from ropetrace.ros.graph import Publisher, Subscription
from ropetrace.ros.kinematic_system import ArmSettings, KinematicSystem, ReceivedMotion, position_at
from ropetrace.ros.live_camera import CameraTopics, LiveCamera
from ropetrace.ros.messages import JOINTS, NUMBERS, POSES, TIME
from ropetrace.ros.robot_filter import RobotFilter
from ropetrace.ros.simulated_cell import ARM_AWAY, CellSettings, SimulatedCell, cell_config
from ropetrace.ros.track_deformable import TrackDeformable
from ropetrace.ros.trajectory_tracker import TrajectoryTracker
from ropetrace.ros.zenoh_graph import ZenohNode
from ropetrace.sim.scenario import CLUTTER, ROBOT_COLOR, SimulatedScene
from ropetrace.sim.scene import Capsules
from ropetrace.types import BadFrame, CloudFrame, FloatArray, Frame, Motion, RgbdFrame, Waypoints, moved
from ros_rig import routed, until
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


def test_no_motion_is_no_trajectory_tracker() -> None:
    config = cell_config()
    with graph() as (node, _), pytest.raises(ConfigError, match="needs the motion"):
        TrajectoryTracker(node, replace(config, motion=replace(config.motion, method="none")))


class ArmAndRope:
    """An arm that does exactly as it is told, and a rope at rest: both sent by `beside`."""

    def __init__(self, beside: ZenohNode) -> None:
        self.position = START.copy()
        self._joints = beside.publisher("/joint_states", JOINTS)
        self._paths = beside.publisher("/ropetrace/centerline", PATH)
        self._moving = beside.publisher("/ropetrace/motion", TRAJECTORY)
        self._camera_from_base = np.linalg.inv(cell_config().world_from_camera())
        tool = PANDA.forward(START)[:3, 3]
        offsets = np.linspace(-0.02, 0.4, 80)[:, None] * [0.0, 0.0, -1.0]
        points = (tool + offsets) @ self._camera_from_base[:3, :3].T + self._camera_from_base[:3, 3]
        turns = np.tile([0.0, 0.0, 0.0, 1.0], (80, 1))
        self._rope = Waypoints(points, turns, np.linspace(0, 0.42, 80))

    def send_joints(self) -> None:
        held = header(time.time_ns(), "")
        self._joints.put(messages.joint_state(held, PANDA.joint_names, self.position, np.zeros(7)))

    def send_rope(self) -> None:
        held, still = header(time.time_ns(), "camera"), np.zeros((80, 3))
        self._moving.put(trajectory(held, self._rope, Motion(still, still, still, still, still)))

    def send_lost(self) -> None:
        self._paths.put(path(header(time.time_ns(), "camera"), Waypoints.none()))


def drive(system: KinematicSystem, cell: ArmAndRope, seconds: float, joints: bool = True, rope: bool = True) -> Any:
    """Steps in real time; the last command."""
    command = None
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if joints:
            cell.send_joints()
        if rope:
            cell.send_rope()
        time.sleep(0.002)
        command = system.step(time.time())
        if command is not None:
            cell.position = cell.position + system.period * command.velocity
        time.sleep(max(system.period - 0.003, 0.0))
    return command


def test_the_arm_moves_only_while_all_is_known() -> None:
    with graph() as (node, beside):
        cell = ArmAndRope(beside)
        velocities = beside.subscription("/ropetrace/velocity_commands", NUMBERS, depth=10_000)
        named = beside.subscription("/ropetrace/joint_commands", JOINTS, depth=10_000)
        system = KinematicSystem(node, cell_config().world_from_camera(), ArmSettings(rate=50))
        assert drive(system, cell, 0.5, joints=False) is None
        assert velocities.take() == []

        until(lambda: np.abs(getattr(drive(system, cell, 0.3), "velocity", 0.0)).max() > 0.01)
        until(lambda: len(named.take()) > 0 and len(velocities.take()) > 0)

        # A rope that is not seen any more stops the arm, and one that is seen again is traced.
        command = drive(system, cell, 1.0, rope=False)
        assert not command.velocity.any()
        assert "old" in command.text
        until(lambda: np.abs(drive(system, cell, 0.2).velocity).max() > 0.01)

        # So do frames in which it is lost.
        def lost() -> bool:
            drive(system, cell, 0.05)
            for _ in range(4):
                cell.send_lost()
            cell.send_joints()
            time.sleep(0.005)
            command = system.step(time.time())
            return command is not None and "the rope is lost" in command.text

        until(lost)

        # An arm that is not heard any more is braked; when it is back elsewhere, all begins anew from there.
        command = drive(system, cell, 0.7, joints=False)
        assert not command.velocity.any()
        until(lambda: drive(system, cell, 0.3, joints=False) is None)
        cell.position = START + 0.3 * (np.arange(7) == 6)
        until(lambda: drive(system, cell, 0.2) is not None)
        assert "apart" not in drive(system, cell, 0.5).text


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
    with graph() as (node, beside):
        cell = ArmAndRope(beside)
        commands = beside.subscription("/ropetrace/joint_commands", JOINTS, depth=10_000)
        basis = beside.subscription("/ropetrace/command_basis", TIME, depth=10_000)
        system = KinematicSystem(node, cell_config().world_from_camera(), ArmSettings(rate=50))
        until(lambda: np.abs(getattr(drive(system, cell, 0.3), "velocity", 0.0)).max() > 0.01)
        stamps = {stamp_and_frame(message)[0] for message in commands.take()}
        seen = [decoded(message) for message in basis.take()]
        assert len(seen) > 3
        for told in seen:
            command_ns = told.header.stamp.sec * 10**9 + told.header.stamp.nanosec
            assert command_ns in stamps
            assert 0 <= command_ns - (told.time_ref.sec * 10**9 + told.time_ref.nanosec) < 0.3e9


@pytest.mark.parametrize(
    ("age", "velocity", "carried"), [(0.02, 0.5, 0.01), (0.02, None, 0), (5, 0.5, 0), (-5, 0.5, 0)]
)
def test_joints_are_carried_on_from_their_stamp(age: float, velocity: float | None, carried: float) -> None:
    """A message 20 ms old that says 0.5 rad/s is 10 mrad behind the arm; one of another time says nothing."""
    now = 1e9
    moving = None if velocity is None else np.full(7, velocity)
    state = messages.joint_state(header(round((now - age) * 1e9), ""), PANDA.joint_names, START, moving)
    message = RawMessage("/joint_states", JOINTS, "cdr", 0, bytes(typestore().serialize_cdr(state, JOINTS)))
    np.testing.assert_allclose(position_at(now, message, PANDA.joint_names) - START, carried, atol=1e-6)


@pytest.mark.parametrize("in_order", [False, True])
def test_the_newest_frame_or_every_one(scene: tuple[RgbdFrame, FloatArray], in_order: bool) -> None:
    with graph() as (node, beside):
        camera, sender = LiveCamera(node, CameraTopics(), True, in_order=in_order), Sender(beside)

        def seen_one() -> bool:
            sender.send(scene[0])
            return camera.take() is not None

        until(seen_one)
        time.sleep(0.1)
        while camera.take() is not None:
            """Those of the beginning."""
        for _ in range(3):
            sender.send(scene[0])
        time.sleep(0.2)
        taken = []
        while (seen := camera.take()) is not None:
            taken.append(seen.event.stamp_ns)
        assert len(taken) == (3 if in_order else 1)
        assert sorted(taken) == taken


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
    with graph() as (node, beside):
        cell = SimulatedCell(node, CellSettings(condition="60fps"))
        joints = beside.subscription("/joint_states", JOINTS, depth=10_000)
        images = beside.subscription(DEPTH_TOPIC, IMAGE, depth=1000)
        commands = beside.publisher("/ropetrace/joint_commands", JOINTS)
        heard: list[tuple[float, bool]] = []

        def tick(now: float) -> None:
            fast = messages.joint_state(header(time.time_ns(), ""), PANDA.joint_names, None, np.full(7, 0.1))
            commands.put(fast)
            heard.append((now, bool(joints.take())))
            if abs(now - ARM_AWAY - 0.5) < 1e-6:
                assert np.abs(cell.moving.position - START).max() > 0.001
                cell.put_back()
            if ARM_AWAY + 0.6 < now < 2 * ARM_AWAY + 0.4:
                assert np.abs(cell.moving.position - START).max() < 1e-6
            if now < ARM_AWAY - 0.1:
                assert np.abs(cell.moving.position - START).max() < 1e-6

        end = time.monotonic() + 2 * ARM_AWAY + 1.5
        cell.run(lambda: time.monotonic() > end, tick)
        first = [now for now, any_ in heard if any_]
        assert any(ARM_AWAY <= now < ARM_AWAY + 0.5 for now in first)
        assert not any(ARM_AWAY + 0.7 < now < 2 * ARM_AWAY + 0.4 for now in first)
        assert decoded(images.take()[-1]).width == 1280


def test_a_cell_that_cannot_be() -> None:
    with pytest.raises(ConfigError, match="condition = '45fps': choose of 30fps, 60fps"):
        CellSettings(condition="45fps")
