"""Case study 2 (section 6.3): a simulated arm traces the rope that sways in a wind, through the whole system.

The camera's frames become centrelines, those become motion, and at every control step the rope is predicted to that
moment; the tracer turns it into joint velocities, the guard into commands, and the arm follows as well as its servos
can. Latency is simulated as in case study 1. Readings compare the tool with the rope as it is; none is removed.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ropetrace.config import RopeConfig, Vector
from ropetrace.control.arm import Arm
from ropetrace.control.controller import Control, TracingController
from ropetrace.control.kinematics import manipulability
from ropetrace.control.limits import Command, GuardOptions, Reason
from ropetrace.control.tool_limits import ToolLimits
from ropetrace.control.tracing import Phase, TracingSettings
from ropetrace.errors import ConfigError
from ropetrace.evaluation.case1 import Case1Settings, Condition, rope_config, scenario, schedule
from ropetrace.evaluation.metrics import projections
from ropetrace.evaluation.paper_errors import angular_errors, linear_errors
from ropetrace.motion import make_motion
from ropetrace.self_filter import without_robot
from ropetrace.sim.arm import RESPONSE, ArmSimulation
from ropetrace.sim.rope import TIMESTEP
from ropetrace.sim.scenario import SimulatedScene
from ropetrace.sim.scene import inverse_pose
from ropetrace.trackers import make_tracker
from ropetrace.types import Estimate, FloatArray, RgbdFrame

CONTROL_RATE = 240.0
"""Control steps a second: a whole number of steps of the simulation."""

WATCHED = 0.5
"""The tracker runs for this long before the arm starts, seconds."""

MARGIN = 0.01
"""The guard keeps this far from the ends of the joints' ranges, rad."""

TOOL_TURN = 10.0
"""Greatest angular speed of the tool, rad/s. The rope's end turns at 4 rad/s at the resonance; Franka's 2.5 rad/s are a
limit of its Cartesian interfaces, and the arm is driven by joint velocities."""


@dataclass(frozen=True, slots=True)
class Placement:
    """Where the arm stands and how it starts; the default is on the far side of the rope from the camera."""

    base: Vector = (-0.183, 0.461, 0.586)
    """World frame, metres."""
    yaw_degrees: float = -100.9
    """Of the base about the vertical."""
    start: tuple[float, ...] = (2.6544, 0.8773, -1.9534, -2.6192, -2.5844, 2.6956, 1.0956)
    """Joint angles with the tool at the top of the rope, rad."""

    def world_from_base(self) -> FloatArray:
        """The base's pose, (4, 4)."""
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("z", self.yaw_degrees, degrees=True).as_matrix()
        pose[:3, 3] = self.base
        return pose


PLACEMENTS = {
    "behind": Placement(),
    "beside_camera": Placement(
        (0.591, -0.267, 0.13), -165.8, (2.1336, -0.3582, -2.1872, -1.0611, -1.8946, 1.498, -1.0699)
    ),
}
"""By name: where equations 15-17 want the arm, and on the camera's side, where its hand hides part of the rope."""


@dataclass(frozen=True, slots=True)
class Case2Settings:
    """What is run."""

    tracings: int = 3
    """Of each frequency and condition; they start at different phases of the swing."""
    arm: str = "panda"
    warm_up: float = 10.0
    """Seconds in which the swing grows."""
    interval: float = 0.1
    """Seconds between readings."""
    longest: float = 60.0
    """A tracing that takes longer has failed, seconds."""
    noise: str = "none"
    method: str = "persistent"
    self_filter: bool = True
    """Take the arm out of the image before tracking; a noisy sensor's depth bleeds from the hand into the rope."""
    latency: float | None = None
    """From the arrival of a frame to its centreline, seconds; None is measured."""
    seed: int = 0
    placement: Placement = field(default_factory=Placement)
    tracing: TracingSettings = field(default_factory=lambda: TracingSettings(lead=0.5 / CONTROL_RATE + RESPONSE))

    def __post_init__(self) -> None:
        if not 1 <= self.tracings <= 1000:
            raise ConfigError(f"tracings = {self.tracings}: expected 1 to 1000")
        if not 0 < self.longest <= 600:
            raise ConfigError(f"longest = {self.longest} s: expected more than 0, and 600 s at most")
        steps = self.interval * CONTROL_RATE
        if steps < 1 or abs(steps - round(steps)) > 1e-6:
            raise ConfigError(f"interval = {self.interval} s: expected a multiple of the period, 1/{CONTROL_RATE:g} s")
        self.as_case1()

    @classmethod
    def at(cls, placement: str, **others: Any) -> Self:
        """With the arm at one of `PLACEMENTS`.

        Beside the camera the tool is turned round, and hides what it reaches for: 3 cm from it is near enough there.

        Raises
        ------
        ConfigError
            If there is no such placement, or another setting is impossible.
        """
        if placement not in PLACEMENTS:
            raise ConfigError(f"unknown placement {placement!r}: choose of {', '.join(PLACEMENTS)}")
        settings = cls(placement=PLACEMENTS[placement], **others)
        if placement == "behind":
            return settings
        return replace(settings, tracing=replace(settings.tracing, approach="from_camera", reach=0.03))

    def as_case1(self) -> Case1Settings:
        """The settings that both experiments share."""
        return Case1Settings(
            duration=WATCHED + self.longest,
            warm_up=self.warm_up + 10.0,
            noise=self.noise,
            method=self.method,
            predict="now",
            latency=self.latency,
            seed=self.seed,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Tracing:
    """One tracing, from the first waypoint to its end.

    Parameters
    ----------
    time : (R,) float array
        Of the readings, simulated seconds.
    linear, angular : (R,) float array
        From the tool to the true rope, metres and rad: the paper's errors.
    place : (R,) float array
        Share of the rope's length at which the tool is.
    visible : (R,) float array
        Share of the rope's length that the camera sees.
    outcome : str
        A `Phase`, why the guard stopped the arm for good, or that it took too long.
    approach, duration : float
        Of the way to the first waypoint, and of the tracing, seconds.
    manipulability : float
        The least (equation 24).
    margin : float array (n,)
        The least distance of each joint to an end of its range, rad.
    velocity, acceleration, jerk : (n,) float array
        The greatest that were commanded, as shares of each joint's limit.
    tool_speed : float
        The greatest, m/s.
    limited : float
        Share of the control steps in which the guard could not grant the wish.
    braked : str
        Reasons for which the guard braked before the end, with the control steps of each; empty if none.
    traced : float
        Share of the rope's length that the tool has come past, no further off than `TracingSettings.max_distance`.
    """

    time: FloatArray
    linear: FloatArray
    angular: FloatArray
    place: FloatArray
    visible: FloatArray
    outcome: NDArray[np.str_]
    approach: FloatArray
    duration: FloatArray
    manipulability: FloatArray
    margin: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    jerk: FloatArray
    tool_speed: FloatArray
    limited: FloatArray
    braked: NDArray[np.str_]
    traced: FloatArray

    @property
    def completed(self) -> bool:
        """Whether the whole rope was traced."""
        return str(self.outcome) == Phase.DONE


class ToolErrors(NamedTuple):
    """Of the tool against the rope as it is.

    Attributes
    ----------
    linear, angular : float
        The paper's errors, metres and rad.
    place : float
        Share of the rope's length at which the tool is.
    visible : float
        Share of the rope's length that the camera sees.
    """

    linear: float
    angular: float
    place: float
    visible: float


class ClosedLoop:
    """The rope, its camera, the tracker, the motion, the arm and its controller, in simulated time.

    Parameters
    ----------
    condition : Condition
        The camera.
    frequency : float
        Of the wind, Hz.
    settings : Case2Settings
        The rest.
    compute_time : float
        From a frame's arrival to its centreline, simulated seconds.
    repeat : int
        Which of the tracings: chooses the phase of the swing and the noise.
    """

    def __init__(
        self, condition: Condition, frequency: float, settings: Case2Settings, compute_time: float, repeat: int = 0
    ) -> None:
        shared = replace(settings.as_case1(), seed=settings.seed + repeat)
        self.settings = settings
        self.simulated = SimulatedScene(scenario(condition, frequency, shared))
        self.config: RopeConfig = rope_config(shared)
        self.tracker = make_tracker(self.config)
        placement = settings.placement
        self.arm = Arm.named(settings.arm)
        start = np.array(placement.start)
        self.moving = ArmSimulation(self.arm, start, placement.world_from_base())
        base_from_world = inverse_pose(self.moving.world_from_base)
        motion = make_motion(self.config.motion.method, self.config.diameter)
        assert motion is not None
        period = 1 / CONTROL_RATE
        self.controller = TracingController(
            self.arm,
            start,
            base_from_world @ self.simulated.world_from_camera,
            motion,
            period,
            settings.tracing,
            GuardOptions(margin=MARGIN),
            ToolLimits(angular=TOOL_TURN, period=period),
        )
        delay = 0.0 if frequency == 0 else repeat / settings.tracings / frequency
        self.begin = math.ceil((settings.warm_up + delay) * CONTROL_RATE) / CONTROL_RATE
        rate = self.simulated.camera.rate
        first = math.ceil((self.begin - WATCHED) * rate)
        self._stamps = (
            np.round(np.arange(first, first + math.ceil((WATCHED + settings.longest) * rate) + 1) / rate / TIMESTEP)
            * TIMESTEP
        )
        arrivals = np.array([self.simulated.camera.arrival(stamp) for stamp in self._stamps])
        self._schedule = deque(schedule(arrivals, compute_time))
        self._first = first
        self._waiting: deque[tuple[float, Estimate]] = deque()
        self._command = np.zeros(self.arm.count)
        self._tick = round((self.begin - WATCHED) * CONTROL_RATE)
        # The arm's clock starts where the camera's does.
        self._arm_start = self._tick / CONTROL_RATE
        self.simulated.robot = self.moving.capsules()
        self.on_frame: Callable[[Any, Estimate], None] | None = None
        """Told of each frame and its estimate, for a viewer."""

    @property
    def time(self) -> float:
        """Simulated seconds."""
        return self._tick / CONTROL_RATE

    def see(self) -> None:
        """Go on by one control period: the world moves, the camera and the tracker work."""
        self._tick += 1
        now = self.time
        self.moving.advance(now - self._arm_start, self._command)
        while self._schedule and self._stamps[self._schedule[0][0]] <= now + 1e-9:
            index, available = self._schedule.popleft()
            self.simulated.robot = self.moving.capsules()
            frame = self.simulated.camera.expose(self.simulated.scene_at, self._stamps[index], self._first + index)
            if self.settings.self_filter:
                frame = self._without_arm(frame)
            estimate = self.tracker.update(frame)
            self._waiting.append((available, estimate))
            if self.on_frame is not None:
                self.on_frame(frame, estimate)
        self.simulated.rope.advance(now)
        while self._waiting and self._waiting[0][0] <= now + 1e-9:
            self.controller.see(self._waiting.popleft()[1])

    def _without_arm(self, frame: RgbdFrame) -> RgbdFrame:
        """What the tracker is given, if the arm is taken out of the image by where its joints say that it is."""
        arm = self.simulated.robot.transformed(inverse_pose(self.simulated.world_from_camera))
        return without_robot(frame, arm.starts, arm.ends, arm.radii)

    def act(self) -> Control:
        """One control step; its command holds until the next."""
        control = self.controller.act(self.time, self.moving.position)
        self._command = control.command.velocity
        return control

    def tool_errors(self) -> ToolErrors:
        """How far the tool is from the rope now."""
        return tool_errors(self.simulated, self.moving, turned=self.settings.tracing.approach == "from_camera")


def tool_errors(simulated: SimulatedScene, moving: ArmSimulation, turned: bool = False) -> ToolErrors:
    """How far an arm's tool is from the rope now; `turned` is a tool that points away from the camera."""
    truth = simulated.truth()
    tool = inverse_pose(simulated.world_from_camera) @ moving.world_from_tool()
    turn = tool[:3, :3] @ np.diag([1.0, -1.0, -1.0]) if turned else tool[:3, :3]
    place = tool[None, :3, 3]
    quaternion = Rotation.from_matrix(turn).as_quat()[None]
    landed = projections(place, truth.polyline)
    link = int(landed.segments[0])
    lengths = np.linalg.norm(np.diff(truth.polyline, axis=0), axis=1)
    return ToolErrors(
        float(linear_errors(place, truth.polyline)[0]),
        float(angular_errors(place, quaternion, truth.polyline, truth.link_quaternions)[0]),
        float((lengths[:link].sum() + landed.fractions[0] * lengths[link]) / lengths.sum()),
        truth.visible_fraction,
    )


def run_tracing(
    condition: Condition, frequency: float, settings: Case2Settings, compute_time: float, repeat: int
) -> Tracing:
    """One tracing; see `ClosedLoop`."""
    loop = ClosedLoop(condition, frequency, settings, compute_time, repeat)
    while loop.time < loop.begin:
        loop.see()
    return trace(loop)


def trace(loop: ClosedLoop, on_reading: Callable[[dict[str, float]], None] = lambda row: None) -> Tracing:
    """Run a loop from where it is to the end of its task."""
    settings, arm = loop.settings, loop.arm
    period = 1 / CONTROL_RATE
    every = round(settings.interval * CONTROL_RATE)
    rows: list[dict[str, float]] = []
    commands = [loop.controller.guard.velocity]
    least, margin, speed = math.inf, np.full(arm.count, math.inf), 0.0
    limited = steps = 0
    braked: dict[str, int] = {}
    began = loop.time
    tracing_since: float | None = None
    outcome = "too slow"
    while loop.time - began < settings.longest:
        wish, command = loop.act()
        commands.append(command.velocity)
        q = loop.moving.position
        jacobian = arm.kinematics(q)[1]
        least = min(least, manipulability(jacobian))
        margin = np.minimum(margin, np.minimum(q - arm.limits.lower, arm.limits.upper - q))
        speed = max(speed, float(np.linalg.norm(jacobian[:3] @ loop.moving.velocity)))
        if wish is not None and wish.phase.ended:
            outcome = str(wish.phase)
            break
        if wish is not None and wish.phase is Phase.TRACING:
            tracing_since = loop.time if tracing_since is None else tracing_since
            steps += 1
            limited += bool(np.abs(command.velocity - wish.velocity).max() > 1e-3)
        if tracing_since is not None and round((loop.time - tracing_since) * CONTROL_RATE) % every == 0:
            rows.append({"time": loop.time, **loop.tool_errors()._asdict()})
            on_reading(rows[-1])
        braking = "" if command.reason is None else _named(command)
        if braking:
            braked[braking] = braked.get(braking, 0) + 1
        if command.reason is Reason.TRACKING:
            outcome = command.text
            break
        outcome = f"too slow: {braking}" if braking else "too slow"
        loop.see()
    end = loop.time
    velocities = np.array(commands)
    accelerations = np.diff(velocities, axis=0, prepend=velocities[:1]) / period
    jerks = np.diff(accelerations, axis=0, prepend=accelerations[:1]) / period
    limits = arm.limits
    columns = {name: np.array([row[name] for row in rows]) for name in ("time", *ToolErrors._fields)}
    since = end if tracing_since is None else tracing_since
    last = loop.tool_errors()
    passed = [(errors["place"], errors["linear"]) for errors in rows] + [(last.place, last.linear)] * bool(rows)
    return Tracing(
        **columns,
        outcome=np.array(outcome),
        approach=np.array(since - began),
        duration=np.array(end - since),
        manipulability=np.array(least),
        margin=margin,
        velocity=np.abs(velocities).max(axis=0) / limits.velocity,
        acceleration=np.abs(accelerations).max(axis=0) / limits.acceleration,
        jerk=np.abs(jerks).max(axis=0) / limits.jerk,
        tool_speed=np.array(speed),
        limited=np.array(limited / max(steps, 1)),
        braked=np.array(", ".join(f"{count} x {reason}" for reason, count in braked.items())),
        traced=np.array(max((at for at, off in passed if off <= settings.tracing.max_distance), default=0.0)),
    )


def _named(command: Command) -> str:
    """Why the guard brakes, without figures: the same words for the same reason."""
    return command.text.split(":")[0] if command.reason is Reason.HOLD else str(command.reason)
