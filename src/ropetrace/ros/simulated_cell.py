"""A camera and an arm that are simulated, in real time: case study 2's, for tests and for trying the nodes."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ropetrace.config import RopeConfig
from ropetrace.control.arm import Arm
from ropetrace.errors import ConfigError, FrameError
from ropetrace.evaluation.case1 import CONDITIONS, Case1Settings, rope_config, scenario
from ropetrace.evaluation.case2 import CONTROL_RATE, PLACEMENTS
from ropetrace.recordings.ros_frames import frame_messages
from ropetrace.recordings.ros_messages import RawMessage
from ropetrace.results.ros_estimates import header, topic_of
from ropetrace.ros import messages
from ropetrace.ros.graph import Publisher, RosNode
from ropetrace.ros.messages import JOINTS
from ropetrace.ros.reporting import Reporter
from ropetrace.sim.arm import ArmSimulation
from ropetrace.sim.scenario import CameraSettings, SimulatedScene
from ropetrace.sim.scene import inverse_pose
from ropetrace.types import FloatArray, RgbdFrame, Status

COMMAND_LASTS = 0.1
"""The arm stops by itself when no command has come for this long, seconds."""

JOINT_STATES_EVERY = 2
"""Control periods between two messages of the joints."""

COMMANDS_KEPT = 128
"""Joint commands that wait for their time, which comes late where the simulation is behind real time."""

TOLD_BEHIND = 0.1
"""A simulation that is behind real time by more is told, seconds."""

MOST_BEHIND = 0.5
"""If by more than this, its clock is set, seconds."""

ARM = "panda"
"""Whose joints at the start `evaluation.case2.PLACEMENTS` has."""

_ROUNDING = 1e-9
"""Stamps and steps are sums of fractions: without it a frame comes a step late, seconds."""

_CONDITIONS = {condition.name: condition for condition in CONDITIONS}

ARM_AWAY = 1.5
"""For how long an arm that is put back says nothing, seconds: whoever drives it must know that it is another."""


@dataclass(frozen=True, slots=True)
class CellSettings:
    """What is simulated.

    Raises
    ------
    ConfigError
        If there is no such condition.
    """

    wind: float = 0.0
    """How often the wind turns in a second; 0 is no wind."""
    warm_up: float = 2.0
    """Seconds of simulated time before the first frame."""
    condition: str = CONDITIONS[0].name
    """The camera: one of `evaluation.case1.CONDITIONS`, in real time."""

    def __post_init__(self) -> None:
        if self.condition not in _CONDITIONS:
            raise ConfigError(f"condition = {self.condition!r}: choose of {', '.join(_CONDITIONS)}")


def cell_config() -> RopeConfig:
    """The settings for the nodes: the rope, and the camera's pose in the frame of the arm's base."""
    world_from_camera = CameraSettings().camera(0).world_from_camera
    assert world_from_camera is not None
    pose = inverse_pose(PLACEMENTS["behind"].world_from_base()) @ world_from_camera
    x, y, z = pose[:3, 3].tolist()
    qx, qy, qz, qw = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    return replace(rope_config(Case1Settings(method="persistent")), camera_pose=(x, y, z, qx, qy, qz, qw))


class SimulatedCell:
    """Publishes depth, colour, camera_info and joint_states, and follows ``joint_commands``.

    Parameters
    ----------
    node : RosNode
        Of the graph.
    settings : CellSettings
        What is simulated, without noise.

    Attributes
    ----------
    simulated : SimulatedScene
        The rope and its camera.
    moving : ArmSimulation
        The arm.

    Raises
    ------
    ConfigError
        If a setting is impossible.
    MissingExtraError
        If MuJoCo or Pinocchio is not installed.
    """

    def __init__(self, node: RosNode, settings: CellSettings | None = None) -> None:
        settings = settings or CellSettings()
        shared = Case1Settings(warm_up=settings.warm_up)
        self.simulated = SimulatedScene(scenario(_CONDITIONS[settings.condition], settings.wind, shared))
        self._arm = Arm.named(ARM)
        self._node = node
        self._images: dict[str, Publisher] = {}
        self._joints = node.publisher("/joint_states", JOINTS)
        self._commands = node.subscription(topic_of(0, "joint_commands"), JOINTS, COMMANDS_KEPT)
        self._waiting: deque[RawMessage] = deque(maxlen=COMMANDS_KEPT)
        self._reporter = Reporter(node)
        self._warm_up = settings.warm_up
        self._now = 0.0
        self._start = np.array(PLACEMENTS["behind"].start)
        self.moving = ArmSimulation(self._arm, self._start, PLACEMENTS["behind"].world_from_base())
        self.put_back()

    def put_back(self) -> None:
        """Put the arm back to where it started; for `ARM_AWAY` it says nothing and does not move."""
        self.moving.restart(self._start)
        self._arm_start = self._now
        self._away_until = self._now + ARM_AWAY
        self._velocity = np.zeros(self._arm.count)
        self._commanded = -math.inf

    def run(self, should_stop: Callable[[], bool], on_tick: Callable[[float], object] = lambda now: None) -> None:
        """Simulate in real time until told to stop.

        Parameters
        ----------
        should_stop : callable
            Is asked at each of `CONTROL_RATE` steps a second.
        on_tick : callable
            Is told the seconds since the start at each of them.
        """
        camera, rope = self.simulated.camera, self.simulated.rope
        rope.advance(self._warm_up)
        frame = int(np.ceil(self._warm_up * camera.rate)) + 1
        tick = 0
        started = time.time()
        while not should_stop():
            tick += 1
            now = self._now = tick / CONTROL_RATE
            ahead = started + now - time.time()
            if ahead < -MOST_BEHIND:
                started -= ahead
                self._reporter.tell(Status.DEGRADED, f"slower than real time: {-ahead:.1f} s were left out")
            elif ahead < -TOLD_BEHIND:
                self._reporter.tell(Status.DEGRADED, f"{-ahead:.2f} s behind real time")
            else:
                self._reporter.tell(Status.OK, "simulating")
            time.sleep(max(ahead, 0.0))
            self.moving.advance(now - self._arm_start, self._command(started + now))
            if camera.stamp(frame) <= self._warm_up + now + _ROUNDING:
                self.simulated.robot = self.moving.capsules()
                exposed = camera.expose(self.simulated.scene_at, camera.stamp(frame), frame)
                stamp_ns = round((started + camera.stamp(frame) - self._warm_up) * 1e9)
                self._publish(replace(exposed, stamp_ns=stamp_ns))
                frame += 1
            rope.advance(self._warm_up + now)
            if tick % JOINT_STATES_EVERY == 0 and now >= self._away_until:
                held = header(round((started + now) * 1e9), "")
                state = messages.joint_state(held, self._arm.joint_names, self.moving.position, self.moving.velocity)
                self._joints.put(state)
            on_tick(now)

    def _command(self, moment: float) -> FloatArray:
        """What the joints do by the commands that had come by a moment, seconds since 1970, (n,), rad/s.

        A real arm does not wait while this process does.
        """
        self._waiting.extend(self._commands.take())
        while self._waiting and self._waiting[0].log_time_ns <= moment * 1e9:
            message = self._waiting.popleft()
            try:
                self._velocity = messages.joint_values(message, self._arm.joint_names, "velocity")
                self._commanded = message.log_time_ns / 1e9
            except FrameError as error:
                self._reporter.tell(Status.DEGRADED, str(error))
        if moment - self._commanded > COMMAND_LASTS or self._now < self._away_until:
            self._velocity = np.zeros(self._arm.count)
        return self._velocity

    def _publish(self, frame: RgbdFrame) -> None:
        for message in frame_messages(frame):
            if message.topic not in self._images:
                self._images[message.topic] = self._node.publisher(message.topic, message.type)
            self._images[message.topic].put_packed(bytes(message.data))
