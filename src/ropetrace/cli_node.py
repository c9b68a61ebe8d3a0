"""The command that starts nodes of live ROS 2: words for people, no logic."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import tempfile
import threading
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
from ropetrace.terminal import BAD_INPUT

if TYPE_CHECKING:
    from ropetrace.config import RopeConfig
    from ropetrace.ros.graph import RosNode

RESTART_AFTER = 1.0
"""Seconds."""

LONGEST_END = 10.0
"""A node that has not ended by itself after this long is killed, seconds."""


@dataclass(frozen=True)
class Reach:
    """How the ROS graph is reached."""

    router: Annotated[str, arg(metavar="ENDPOINT")] = "tcp/127.0.0.1:7447"
    """The Zenoh router: `ropetrace node router`, or rmw_zenohd of ROS."""
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

    def node(self, name: str) -> RosNode:
        """Join the graph; says so if there is no router."""
        from ropetrace.ros.zenoh_graph import ZenohNode
        from ropetrace.ros.zenoh_session import Connection, router_answers

        domain = self.domain if self.domain is not None else _domain_of_environment()
        connection = Connection(self.router, self.mode, self.listen, self.multicast, domain, self.humble)
        if not router_answers(self.router):
            print(
                f"{name}: no router at {self.router} yet: start one with `ropetrace node router`, "
                "or `ros2 run rmw_zenoh_cpp rmw_zenohd`",
                file=sys.stderr,
                flush=True,
            )
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
class Joints:
    """The arm."""

    arm: str = "panda"
    """One that comes with ropetrace: panda or fr3."""
    rate: Annotated[float, arg(metavar="HZ")] = 100.0
    """Commands in a second."""
    joint_topic: Annotated[str, arg(metavar="TOPIC")] = "/joint_states"
    """sensor_msgs/JointState: where the joints are."""
    command_topic: Annotated[str, arg(metavar="TOPIC")] = "/ropetrace/velocity_commands"
    """std_msgs/Float64MultiArray: how fast they are to be, as ros2_control takes it."""


@dataclass(frozen=True)
class TrackDeformable:
    """Images or clouds in; the centreline, its poses and its status out."""

    rope: OmitArgPrefixes[Rope]
    images: OmitArgPrefixes[Images]
    reach: OmitArgPrefixes[Reach]

    def run(self) -> int:
        from ropetrace.ros import track_deformable
        from ropetrace.ros.live_camera import CameraTopics

        images = self.images
        config = self.rope.settings()
        topics = CameraTopics(images.depth_topic, images.color_topic, images.camera_topic, images.cloud_topic)
        return _run(self.reach, "track_deformable", lambda node: track_deformable.TrackDeformable(node, config, topics))


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
    joints: OmitArgPrefixes[Joints]
    reach: OmitArgPrefixes[Reach]

    def run(self) -> int:
        from ropetrace.ros import kinematic_system

        config = self.rope.settings()
        _check_camera_pose(config)
        settings = kinematic_system.ArmSettings(**dataclasses.asdict(self.joints))
        pose = config.world_from_camera()
        return _run(self.reach, "kinematic_system", lambda node: kinematic_system.KinematicSystem(node, pose, settings))


@dataclass(frozen=True)
class Sim:
    """A simulated camera, rope and arm, for trying the others."""

    reach: OmitArgPrefixes[Reach]
    wind: Annotated[float, arg(metavar="HZ")] = 0.0
    """How often the wind turns in a second; 0.8 is the rope's resonance, 0 no wind."""
    settings: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the settings for the other nodes, for their --config."""

    def run(self) -> int:
        from ropetrace.ros.simulated_cell import CellSettings, SimulatedCell, cell_config

        if self.settings is not None:
            _write_settings(self.settings, cell_config())
        return _run(self.reach, "ropetrace_sim", lambda node: SimulatedCell(node, CellSettings(self.wind)))


@dataclass(frozen=True)
class Router:
    """Makes the nodes known to each other, where no rmw_zenohd of ROS runs."""

    router: Annotated[str, arg(metavar="ENDPOINT")] = "tcp/127.0.0.1:7447"
    """Where it listens."""

    def run(self) -> int:
        from ropetrace.ros.zenoh_session import open_router

        should_stop = _told_to_stop()
        with closing(open_router(self.router)):
            print(f"router: listening at {self.router}", file=sys.stderr, flush=True)
            while not should_stop():
                time.sleep(0.1)
        return 0


@dataclass(frozen=True)
class All:
    """The three nodes, each a process of its own, and a router if none answers."""

    rope: OmitArgPrefixes[Rope]
    images: OmitArgPrefixes[Images]
    joints: OmitArgPrefixes[Joints]
    reach: OmitArgPrefixes[Reach]
    simulate: bool = False
    """With the simulated camera and arm, and their settings in the place of a rope's."""

    def run(self) -> int:
        import_extra("zenoh", "ros2")
        for module, extra in (("pinocchio", "arm"), *([("mujoco", "sim")] if self.simulate else [])):
            import_extra(module, extra)
        from ropetrace.ros.zenoh_session import router_answers

        with tempfile.TemporaryDirectory(prefix="ropetrace-") as folder:
            rope = _flags(self.rope)
            if self.simulate:
                from ropetrace.ros.simulated_cell import cell_config

                settings = Path(folder) / "sim.toml"
                _write_settings(settings, cell_config())
                rope = ["--config", str(settings)]
            else:
                _check_camera_pose(self.rope.settings())
            reach = _flags(self.reach)
            commands = {
                "track_deformable": [*rope, *_flags(self.images), *reach],
                "trajectory_tracker": [*rope, *reach],
                "kinematic_system": [*rope, *_flags(self.joints), *reach],
            }
            if self.simulate:
                commands = {"sim": reach, **commands}
            if not router_answers(self.reach.router):
                commands = {"router": ["--router", self.reach.router], **commands}
            return _supervise(commands, _told_to_stop())


@dataclass(frozen=True)
class Node:
    """Live ROS 2 without a ROS installation: a node, or the whole graph.

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
        return self.node.run()


def _run(reach: Reach, name: str, make: Callable[[RosNode], Any]) -> int:
    """Make a node and let it run until Ctrl-C."""
    should_stop = _told_to_stop()
    with reach.node(name) as node:
        made = make(node)
        print(f"{name}: running", file=sys.stderr, flush=True)
        made.run(should_stop)
    print(f"{name}: ended", file=sys.stderr, flush=True)
    return 0


def _told_to_stop() -> Callable[[], bool]:
    """Whether an end was asked for, as by Ctrl-C: a loop ends where it chooses, not in the middle of a message."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: stop.set())
    return stop.is_set


def _supervise(commands: dict[str, list[str]], should_stop: Callable[[], bool]) -> int:
    """Run the nodes until told to stop; one that ends is started again, unless what it was told is wrong.

    Each is a process group of its own: Ctrl-C comes here alone, and to none that is still starting.
    """
    running: dict[str, subprocess.Popen[bytes]] = {}
    due = dict.fromkeys(commands, 0.0)
    try:
        while not should_stop():
            for name, flags in commands.items():
                if name not in running and time.monotonic() >= due[name]:
                    command = [sys.executable, "-m", "ropetrace", "node", name, *flags]
                    running[name] = subprocess.Popen(command, process_group=0)
            for name, process in list(running.items()):
                code = process.poll()
                if code is None or should_stop():
                    continue
                if code == BAD_INPUT:
                    return BAD_INPUT
                print(f"all: {name} ended with code {code}: it is started again", file=sys.stderr, flush=True)
                del running[name]
                due[name] = time.monotonic() + RESTART_AFTER
            time.sleep(0.1)
        return 0
    finally:
        _end(list(running.values()))


def _end(processes: list[subprocess.Popen[bytes]]) -> None:
    """Ask all to end, and wait; the first in the list last, since it may be the router."""
    for process in reversed(processes):
        process.terminate()
    end = time.monotonic() + LONGEST_END
    for process in processes:
        try:
            process.wait(max(end - time.monotonic(), 0.1))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


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


def _domain_of_environment() -> int:
    text = os.environ.get("ROS_DOMAIN_ID", "") or "0"
    if not text.isdecimal():
        raise ConfigError(f"ROS_DOMAIN_ID = {text!r}: expected a number")
    return int(text)


def _check_camera_pose(config: RopeConfig) -> None:
    if config.camera_pose is None:
        raise ConfigError(
            "kinematic_system needs camera_pose in the settings: the camera in the frame of the arm's base"
        )


def _write_settings(path: Path, config: RopeConfig) -> None:
    try:
        path.write_text(config.to_toml(), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from None
