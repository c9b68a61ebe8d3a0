"""The paper's node kinematic_system: the rope's motion and the arm's joints in, joint velocities out."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ropetrace.control.arm import Arm
from ropetrace.control.controller import TracingController
from ropetrace.control.limits import Command, GuardOptions, Reason
from ropetrace.control.tool_limits import ToolLimits
from ropetrace.control.tracing import Phase, TracingSettings
from ropetrace.errors import ConfigError, FrameError
from ropetrace.motion.filters import transition
from ropetrace.recordings.ros_messages import stamp_and_frame
from ropetrace.results.ros_estimates import NANOSECONDS, PATH, TRAJECTORY, header, topic_of
from ropetrace.ros import messages
from ropetrace.ros.commanded import JOINTS_FRESH, LONGEST_RESPONSE, CommandedMotion
from ropetrace.ros.graph import LONGEST_BRAKING, MAX_FUTURE, RosNode, check_topic
from ropetrace.ros.messages import JOINTS, NUMBERS, TIME, JointReading
from ropetrace.ros.reporting import Reporter
from ropetrace.types import Estimate, FloatArray, Motion, Status, Waypoints

MARGIN = 0.01
"""The guard keeps this far from the ends of the joints' ranges, rad."""

ARM_GONE = 1.0
"""An arm that has said nothing for this long is gone, seconds; when it is back, all begins from where it stands."""

JOINTS_KEPT = 16
"""Messages on the joints' topic between two steps: others than the arm may publish there, such as a gripper."""

REST_TOLD = 0.2
"""For which an arm at rest is still told so at the end, seconds: a message may be lost."""


@dataclass(frozen=True, slots=True)
class ArmSettings:
    """Which arm, and where it is spoken to.

    Raises
    ------
    ConfigError
        If a value is impossible.
    """

    arm: str = "panda"
    """One that comes with ropetrace: panda or fr3."""
    rate: float = 100.0
    """Commands in a second."""
    response: float = 0.0
    """From a command's arrival until the joints move at its velocity, seconds."""
    tool_turn: float = 2.5
    """Greatest angular speed of the tool, rad/s; 2.5 is Franka's for its Cartesian interfaces."""
    joint_topic: str = "/joint_states"
    """sensor_msgs/JointState of the arm."""
    command_topic: str = "/ropetrace/velocity_commands"
    """std_msgs/Float64MultiArray of joint velocities, such as /forward_velocity_controller/commands."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rate) and 1 <= self.rate <= 1000):
            raise ConfigError(f"rate = {self.rate} Hz: expected 1 to 1000")
        if not 0 <= self.response <= LONGEST_RESPONSE:
            raise ConfigError(f"response = {self.response} s: expected 0 to {LONGEST_RESPONSE:g}")
        for name in (self.joint_topic, self.command_topic):
            check_topic(name)


class ReceivedMotion:
    """A `motion.MotionEstimator` that is told the motion: predictions go on from it as `motion.filters` do."""

    def __init__(self) -> None:
        self._known: tuple[int, Waypoints, Motion] | None = None
        self._next: Motion | None = None

    @property
    def stamp_ns(self) -> int | None:
        """Of the frame whose motion came last, nanoseconds."""
        return None if self._known is None else self._known[0]

    def announce(self, motion: Motion) -> None:
        """The motion of the waypoints that `update` is given next."""
        self._next = motion

    def update(self, stamp_ns: int, waypoints: Waypoints) -> Motion | None:
        """Take the waypoints whose motion was announced, whatever was known before: clocks are set back, too."""
        if self._next is not None:
            self._known = stamp_ns, waypoints, self._next
        return self._next

    def predict(self, ahead: float) -> tuple[FloatArray, Motion] | None:
        """See `motion.MotionEstimator.predict`."""
        if self._known is None:
            return None
        _, waypoints, motion = self._known
        f01, f02, f12, f22 = transition(ahead)
        velocities = motion.velocities + f12 * motion.accelerations
        unknown = np.full(velocities.shape, np.nan)
        return (
            waypoints.positions + f01 * motion.velocities + f02 * motion.accelerations,
            Motion(velocities, f22 * motion.accelerations, unknown, unknown, unknown),
        )

    def reset(self) -> None:
        """Forget all."""
        self._known = self._next = None


class KinematicSystem:
    """Lets an arm trace the first rope; it reads ``centerline``, to know when the rope is lost, and ``motion``.

    The commands are two messages: the velocities alone, as ros2_control takes them, and ``joint_commands``, a
    JointState with names and a stamp. Beside them ``command_basis`` has the stamp of the newest image behind each.
    Nothing is sent before the arm's joints are known. Where the rope, its motion or the joints' positions are missing
    or too old, the arm brakes, as `control.controller` has it. After an arm that was gone for `ARM_GONE` has come back,
    the tracing begins anew; not if it was found elsewhere than it was sent: that arm stays at rest.

    Parameters
    ----------
    node : RosNode
        Of the graph.
    base_from_camera : (4, 4) float array
        The camera's pose in the frame of the arm's base.
    settings : ArmSettings
        Of the arm.
    tracing : TracingSettings, optional
        Of the tracer; by default with a lead of half a period and the arm's response.

    Raises
    ------
    ConfigError
        If there is no such arm.
    MissingExtraError
        If Pinocchio is not installed.
    """

    def __init__(
        self,
        node: RosNode,
        base_from_camera: FloatArray,
        settings: ArmSettings | None = None,
        tracing: TracingSettings | None = None,
    ) -> None:
        self.settings = settings or ArmSettings()
        self.period = 1 / self.settings.rate
        self._arm = Arm.named(self.settings.arm)
        self._base_from_camera = base_from_camera
        self._tracing = tracing or TracingSettings(lead=self.period / 2 + self.settings.response)
        self._motion = ReceivedMotion()
        self._paths = node.subscription(topic_of(0, "centerline"), PATH, depth=10)
        self._moving = node.subscription(topic_of(0, "motion"), TRAJECTORY)
        self._joints = node.subscription(self.settings.joint_topic, JOINTS, JOINTS_KEPT)
        self._velocities = node.publisher(self.settings.command_topic, NUMBERS)
        self._commands = node.publisher(topic_of(0, "joint_commands"), JOINTS)
        self._basis = node.publisher(topic_of(0, "command_basis"), TIME)
        self._reporter = Reporter(node)
        self._controller: TracingController | None = None
        self._reading: JointReading | None = None
        self._commanded = CommandedMotion(self.settings.rate, self.settings.response)
        self._heard = -math.inf
        self._clock = math.nan
        self._fault = ""
        self._astray = False

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Control at the fixed rate until told to stop, or something fails; then bring the arm to rest."""
        try:
            for now in self._periods():
                if should_stop():
                    break
                self.step(now)
        finally:
            self._come_to_rest()

    def _periods(self) -> Iterator[float]:
        """Each period's time, seconds since 1970."""
        due = time.monotonic()
        while True:
            yield time.time()
            due = max(due + self.period, time.monotonic() - self.period)
            time.sleep(max(due - time.monotonic(), 0.0))

    def _come_to_rest(self) -> None:
        """Brake, whatever else is known, and tell the arm for a while that it is at rest."""
        if self._controller is None:
            return
        guard, unknown = self._controller.guard, np.full(self._arm.count, np.nan)
        end = time.monotonic() + LONGEST_BRAKING
        rest_end = math.inf
        for now in self._periods():
            command = guard.step(now, unknown, None, now)
            # What fails here may be what has ended the node; the next command may still arrive.
            with contextlib.suppress(Exception):
                self._send(now, command)
            if guard.at_rest:
                rest_end = min(rest_end, time.monotonic() + REST_TOLD)
            if time.monotonic() > min(end + REST_TOLD, rest_end):
                return

    def step(self, now: float) -> Command | None:
        """One control step.

        Parameters
        ----------
        now : float
            Seconds since 1970.

        Returns
        -------
        Command or None
            What was sent; None where nothing was, since there is no arm.
        """
        self._learn_joints()
        clock = now - time.monotonic()
        if abs(clock - self._clock) > self.period:
            # It was set: how long the last command has lasted is not known by it.
            self._commanded.forget()
        self._clock = clock
        silent = time.monotonic() - self._heard
        if self._controller is not None and silent > ARM_GONE and self._controller.guard.at_rest and not self._astray:
            self._controller = None
            self._commanded.forget()
        fresh = None if self._reading is None else self._commanded.carried_on(now, self._reading)
        if self._controller is None and fresh is not None:
            self._motion.reset()
            self._controller = TracingController(
                self._arm,
                fresh,
                self._base_from_camera,
                self._motion,
                self.period,
                self._tracing,
                GuardOptions(margin=MARGIN),
                ToolLimits(angular=self.settings.tool_turn, period=self.period),
            )
            # Making it may have taken longer than the guard lets pass between two steps.
            return None
        self._see(self._controller)
        if self._controller is None:
            told = self._fault or self._joints.problem() or f"no arm: nothing came on {self._joints.topic}"
            self._reporter.tell(Status.LOST, told)
            return None
        step, command = self._controller.act(now, fresh)
        self._astray = command.reason is Reason.TRACKING
        self._send(now, command)
        phase = "" if step is None else str(step.phase)
        if fresh is None:
            told = self._fault or f"{self._joints.topic} is silent for {silent:.2f} s"
            self._reporter.tell(Status.LOST, f"braking: {told}")
        elif command.reason is None or phase == Phase.DONE:
            self._reporter.tell(Status.OK, phase)
        elif self._astray:
            told = f"braking: {command.text}; it stays at rest until this node is started again"
            self._reporter.tell(Status.DEGRADED, told, {"reason": str(command.reason)})
        else:
            self._reporter.tell(Status.DEGRADED, f"braking: {command.text}", {"reason": str(command.reason)})
        return command

    def _learn_joints(self) -> None:
        """Take the newest message that has all of the arm's joints."""
        fault = ""
        for message in reversed(self._joints.take()):
            try:
                self._reading = messages.joint_reading(message, self._arm.joint_names)
            except FrameError as error:
                fault = fault or str(error)
                continue
            self._heard = time.monotonic()
            self._fault = self._untimely((message.log_time_ns - self._reading.stamp_ns) / NANOSECONDS)
            return
        # Beside an arm that was just heard it is somebody else's.
        if time.monotonic() - self._heard > JOINTS_FRESH:
            self._fault = fault or self._fault

    def _untimely(self, age: float) -> str:
        """What is wrong with the joints' stamps, by their age at arrival, seconds; empty if nothing is."""
        if -MAX_FUTURE <= age <= JOINTS_FRESH:
            return ""
        when = f"{age:.2f} s old" if age > 0 else f"{-age:.2f} s in the future"
        return f"{self._joints.topic}: the stamp is {when}: the clocks of the arm and of this machine differ"

    def _see(self, controller: TracingController | None) -> None:
        """Hand on what came of the rope; without a controller it is forgotten."""
        paths, moving = self._paths.take(), self._moving.newest()
        if controller is None:
            return
        for message in paths:
            try:
                if not len(messages.waypoints(message)):
                    controller.see(Estimate.lost(stamp_and_frame(message)[0], "the path is empty"))
            except FrameError as error:
                self._reporter.tell(Status.DEGRADED, str(error))
        if moving is None:
            return
        try:
            known = messages.moving_waypoints(moving)
            if known is not None:
                self._motion.announce(known[1])
                controller.see(Estimate(stamp_and_frame(moving)[0], Status.OK, waypoints=known[0]))
        except FrameError as error:
            self._reporter.tell(Status.DEGRADED, str(error))

    def _send(self, now: float, command: Command) -> None:
        self._commanded.command(now, command.velocity)
        self._velocities.put(messages.numbers(command.velocity))
        held = header(round(now * 1e9), "")
        self._commands.put(messages.joint_state(held, self._arm.joint_names, None, command.velocity))
        if self._motion.stamp_ns is not None:
            self._basis.put(messages.time_reference(held, self._motion.stamp_ns))
