"""The command that starts nodes of live ROS: words for people, no logic."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, arg

from ropetrace.cli_source import Rope
from ropetrace.errors import ConfigError, OutputError, import_extra
from ropetrace.ros.joining import Way, best_way, domain_of_environment
from ropetrace.ros.saying import say
from ropetrace.ros.supervise import ROUTER, end_with_supervisor, supervise, told_to_stop

if TYPE_CHECKING:
    from ropetrace.config import RopeConfig
    from ropetrace.ros.graph import RosNode

ROUTER_EVERY = 0.5
"""Between two looks for the router, seconds."""


@dataclass(frozen=True)
class Reach:
    """How the ROS graph is reached."""

    ros: Literal["auto", Way] = "auto"
    """zenoh: ROS 2 without an installation; rclpy: an installed ROS 2; rospy: ROS 1. auto: rclpy where it can be
    imported; else rospy, where it can be and ROS_MASTER_URI is set; else zenoh."""
    router: Annotated[str, arg(metavar="ENDPOINT")] = "tcp/127.0.0.1:7447"
    """The Zenoh router: `ropetrace node router`, or rmw_zenohd of ROS. This and the following are for zenoh alone."""
    mode: Literal["peer", "client"] = "peer"
    """peer: data goes straight from node to node, as rmw_zenoh does it; client: through the router."""
    listen: Annotated[str, arg(metavar="ENDPOINT")] = "tcp/127.0.0.1:0"
    """Where a peer is reached: by default from this machine only, at a port that the system chooses."""
    multicast: bool = False
    """Look for others on the local network, too; this listens beyond this machine."""
    domain: Annotated[int | None, arg(metavar="N")] = None
    """The ROS domain; by default that of ROS_DOMAIN_ID, or 0."""
    humble: bool = False
    """Speak with ROS 2 Humble, in the place of Jazzy, Kilted and Lyrical."""
    shared_memory: bool = False
    """Hand on large images by shared memory: sooner, but each node that ends leaves 16 MB in those that it spoke to."""

    def way(self) -> Way:
        """What `ros` comes to here.

        Raises
        ------
        ConfigError
            If there are options that only another way has.
        """
        given = [item.name for item in dataclasses.fields(self)[1:] if getattr(self, item.name) != item.default]
        if self.ros == "auto":
            return "zenoh" if given else best_way()
        if given and self.ros != "zenoh":
            told = {"rclpy": "rclpy takes ROS_DOMAIN_ID and RMW_IMPLEMENTATION", "rospy": "rospy takes ROS_MASTER_URI"}
            raise ConfigError(f"--{given[0]} is for --ros zenoh alone, not for --ros {self.ros}: {told[self.ros]}")
        return self.ros

    def node(self, name: str, should_stop: Callable[[], bool]) -> RosNode | None:
        """Join the graph; says so if there is no router, or no roscore. None if told to stop while it waits for one."""
        way = self.way()
        if way == "rclpy":
            from ropetrace.ros.rclpy_graph import RclpyNode

            return RclpyNode(name)
        if way == "rospy":
            from ropetrace.ros.rospy_graph import RospyNode

            return RospyNode(name)
        return self._zenoh_node(name, should_stop)

    def _zenoh_node(self, name: str, should_stop: Callable[[], bool]) -> RosNode | None:
        from ropetrace.ros.zenoh_graph import ZenohNode
        from ropetrace.ros.zenoh_session import START_ROUTER, Connection, router_answers

        domain = self.domain if self.domain is not None else domain_of_environment()
        connection = Connection(
            self.router, self.mode, self.listen, self.multicast, domain, self.humble, self.shared_memory
        )
        if not router_answers(self.router):
            say(f"{name}: no router at {self.router} yet: {START_ROUTER}")
            # A peer joins when one comes; a client is nothing without.
            while connection.mode == "client" and not router_answers(self.router):
                if should_stop():
                    return None
                time.sleep(ROUTER_EVERY)
        return ZenohNode(name, connection)


@dataclass(frozen=True)
class Images:
    """What the camera publishes; the defaults are those of a RealSense."""

    depth_topic: Annotated[str, arg(metavar="TOPIC")] = "/camera/aligned_depth_to_color/image_raw"
    """sensor_msgs/Image: depth, aligned to colour."""
    color_topic: Annotated[str, arg(metavar="TOPIC")] = "/camera/color/image_raw"
    """sensor_msgs/Image: colour; read where the rope has one."""
    camera_topic: Annotated[str, arg(metavar="TOPIC")] = "/camera/aligned_depth_to_color/camera_info"
    """sensor_msgs/CameraInfo of the depth images."""
    cloud_topic: Annotated[str | None, arg(metavar="TOPIC")] = None
    """sensor_msgs/PointCloud2, in the place of images."""


@dataclass(frozen=True)
class Robot:
    """The arm."""

    arm: str = "panda"
    """One that comes with ropetrace: panda or fr3."""
    joint_topic: Annotated[str, arg(metavar="TOPIC")] = "/joint_states"
    """sensor_msgs/JointState: where the joints are."""


@dataclass(frozen=True)
class Commands:
    """What the arm is told."""

    rate: Annotated[float, arg(metavar="HZ")] = 100.0
    """Commands in a second."""
    response: Annotated[float, arg(metavar="SECONDS")] = 0.0
    """From a command's arrival until the joints move at its velocity."""
    tool_turn: Annotated[float, arg(metavar="RAD/S")] = 2.5
    """Greatest angular speed of the tool."""
    command_topic: Annotated[str, arg(metavar="TOPIC")] = "/ropetrace/velocity_commands"
    """std_msgs/Float64MultiArray: how fast they are to be, as ros2_control takes it."""


@dataclass(frozen=True)
class TrackDeformable:
    """Images or clouds in; the centreline, its poses and its status out."""

    rope: OmitArgPrefixes[Rope]
    images: OmitArgPrefixes[Images]
    robot: OmitArgPrefixes[Robot]
    reach: OmitArgPrefixes[Reach]
    self_filter: bool = False
    """Take the arm out of the images, by where its joints are; the settings must have camera_pose."""

    def run(self) -> int:
        from ropetrace.ros.live_camera import CameraTopics
        from ropetrace.ros.track_deformable import TrackDeformable

        images, robot = self.images, self.robot
        config = self.rope.settings()
        topics = CameraTopics(images.depth_topic, images.color_topic, images.camera_topic, images.cloud_topic)
        if not self.self_filter:
            return _run(self.reach, "track_deformable", lambda node: TrackDeformable(node, config, topics))
        _check_images(images)
        _check_camera_pose(config, "--self-filter")
        from ropetrace.control.arm import Arm
        from ropetrace.ros.robot_filter import RobotFilter

        arm, pose = Arm.named(robot.arm), config.world_from_camera()

        def make(node: RosNode) -> TrackDeformable:
            return TrackDeformable(node, config, topics, RobotFilter(node, arm, robot.joint_topic, pose))

        return _run(self.reach, "track_deformable", make)


@dataclass(frozen=True)
class TrajectoryTracker:
    """The centreline in; its velocities, accelerations, and where it is now, out."""

    rope: OmitArgPrefixes[Rope]
    reach: OmitArgPrefixes[Reach]

    def run(self) -> int:
        from ropetrace.ros import trajectory_tracker

        config = self.rope.settings()
        return _run(self.reach, "trajectory_tracker", lambda node: trajectory_tracker.TrajectoryTracker(node, config))


@dataclass(frozen=True)
class KinematicSystem:
    """The rope's motion and the arm's joints in; joint velocities out, at a fixed rate.

    The camera_pose of the settings is the camera in the frame of the arm's base.
    """

    rope: OmitArgPrefixes[Rope]
    robot: OmitArgPrefixes[Robot]
    commands: OmitArgPrefixes[Commands]
    reach: OmitArgPrefixes[Reach]

    def run(self) -> int:
        from ropetrace.ros import kinematic_system

        config = self.rope.settings()
        _check_camera_pose(config, "kinematic_system")
        settings = kinematic_system.ArmSettings(**dataclasses.asdict(self.robot), **dataclasses.asdict(self.commands))
        pose = config.world_from_camera()
        return _run(self.reach, "kinematic_system", lambda node: kinematic_system.KinematicSystem(node, pose, settings))


@dataclass(frozen=True)
class Simulated:
    """What is simulated."""

    wind: Annotated[float, arg(metavar="HZ")] = 0.0
    """How often the wind turns in a second; 0.8 is the rope's resonance, 0 no wind."""
    condition: Literal["30fps", "60fps"] = "30fps"
    """The camera: 480x360 at 30 frames a second, or 1280x720 at 60."""


@dataclass(frozen=True)
class Sim:
    """A simulated camera, rope and arm, for trying the others."""

    reach: OmitArgPrefixes[Reach]
    simulated: OmitArgPrefixes[Simulated]
    settings: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the settings for the other nodes, for their --config."""

    def run(self) -> int:
        from ropetrace.ros.simulated_cell import CellSettings, SimulatedCell, cell_config

        if self.settings is not None:
            _write_settings(self.settings, cell_config())
        settings = CellSettings(self.simulated.wind, condition=self.simulated.condition)
        return _run(self.reach, "ropetrace_sim", lambda node: SimulatedCell(node, settings))


@dataclass(frozen=True)
class Router:
    """Makes the nodes known to each other, where no rmw_zenohd of ROS runs."""

    router: Annotated[str, arg(metavar="ENDPOINT")] = "tcp/127.0.0.1:7447"
    """Where it listens."""

    def run(self) -> int:
        from ropetrace.ros.zenoh_session import open_router

        should_stop = told_to_stop()
        with closing(open_router(self.router)):
            say(f"router: listening at {self.router}")
            while not should_stop():
                time.sleep(0.1)
        return 0


@dataclass(frozen=True)
class All:
    """The three nodes, each a process of its own, and with zenoh a router if none answers."""

    rope: OmitArgPrefixes[Rope]
    images: OmitArgPrefixes[Images]
    robot: OmitArgPrefixes[Robot]
    commands: OmitArgPrefixes[Commands]
    reach: OmitArgPrefixes[Reach]
    simulated: OmitArgPrefixes[Simulated]
    self_filter: bool = False
    """Take the arm out of the images, by where its joints are."""
    simulate: bool = False
    """With a simulated camera and arm, and the settings for their rope."""

    def run(self) -> int:
        self._check()
        way = self.reach.way()
        if way == "zenoh":
            import_extra("zenoh", "ros2")
        for module, extra in (("pinocchio", "arm"), *([("mujoco", "sim")] if self.simulate else [])):
            import_extra(module, extra)

        with tempfile.TemporaryDirectory(prefix="ropetrace-") as folder:
            rope = _flags(self.rope)
            if self.simulate:
                from ropetrace.ros.simulated_cell import cell_config

                settings = Path(folder) / "sim.toml"
                _write_settings(settings, cell_config())
                rope = ["--config", str(settings)]
            else:
                _check_camera_pose(self.rope.settings(), "kinematic_system")
            robot = _flags(self.robot)
            filtered = [*robot, "--self-filter"] if self.self_filter else []
            reach = _flags(dataclasses.replace(self.reach, ros=way))
            commands = {
                "track_deformable": [*rope, *_flags(self.images), *filtered, *reach],
                "trajectory_tracker": [*rope, *reach],
                "kinematic_system": [*rope, *robot, *_flags(self.commands), *reach],
            }
            if self.simulate:
                commands = {"sim": [*reach, *_flags(self.simulated)], **commands}
            if way == "zenoh":
                from ropetrace.ros.zenoh_session import router_answers

                if not router_answers(self.reach.router):
                    commands = {ROUTER: ["--router", self.reach.router], **commands}
            return supervise(commands, told_to_stop())

    def _check(self) -> None:
        """Options that would do nothing are refused."""
        if self.self_filter:
            _check_images(self.images)
        if not self.simulate:
            for flag in _flags(self.simulated)[:1]:
                raise ConfigError(f"{flag} is for --simulate")
            return
        for flag in [*_flags(self.rope), *_flags(self.images), *_flags(self.robot)][:1]:
            raise ConfigError(f"{flag}: --simulate brings its own rope, camera and arm: leave it out")


@dataclass(frozen=True)
class Node:
    """Live ROS, 2 or 1, with or without a ROS installation: a node, or the whole graph.

    ropetrace node all --simulate
    """

    node: OmitArgPrefixes[
        OmitSubcommandPrefixes[
            Annotated[TrackDeformable, tyro.conf.subcommand("track_deformable")]
            | Annotated[TrajectoryTracker, tyro.conf.subcommand("trajectory_tracker")]
            | Annotated[KinematicSystem, tyro.conf.subcommand("kinematic_system")]
            | Annotated[Sim, tyro.conf.subcommand("sim")]
            | Annotated[Router, tyro.conf.subcommand("router")]
            | Annotated[All, tyro.conf.subcommand("all")]
        ]
    ]

    def run(self) -> int:
        end_with_supervisor()
        return self.node.run()


def _run(reach: Reach, name: str, make: Callable[[RosNode], Any]) -> int:
    """Make a node and let it run until Ctrl-C."""
    should_stop = told_to_stop()
    joined = reach.node(name, should_stop)
    if joined is not None:
        with joined as node:
            made = make(node)
            say(f"{name}: running")
            made.run(should_stop)
    say(f"{name}: ended")
    return 0


def _flags(options: Any) -> list[str]:
    """The command line that gives these options, without those that are the default."""
    flags = []
    for item in dataclasses.fields(options):
        value = getattr(options, item.name)
        if value == item.default:
            continue
        flag = f"--{item.name.replace('_', '-')}"
        flags += [flag] if value is True else [flag, str(value)]
    return flags


def _check_images(images: Images) -> None:
    if images.cloud_topic is not None:
        raise ConfigError("--self-filter takes the arm out of images, not of clouds: leave out --cloud-topic")


def _check_camera_pose(config: RopeConfig, who: str) -> None:
    if config.camera_pose is None:
        raise ConfigError(f"{who} needs camera_pose in the settings: the camera in the frame of the arm's base")


def _write_settings(path: Path, config: RopeConfig) -> None:
    try:
        path.write_text(config.to_toml(), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from None
