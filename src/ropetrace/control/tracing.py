"""The arm traces the rope (section 5.2): joint velocities step by step, how far the task is, and how it ends.

Everything is in the frame of the arm's base. Equations 15-17 let the tool's X axis point along the rope and its Z axis
at the camera, so the arm stands on the side of the rope that the camera does not see; `TracingSettings.approach` turns
the tool round for an arm that stands beside the camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Literal, NamedTuple

import numpy as np

from ropetrace.control.arm import Arm, JointLimits
from ropetrace.control.guidance import Gains, Guidance, guide
from ropetrace.control.kinematics import joint_velocities_within, secondary_velocity
from ropetrace.errors import ConfigError
from ropetrace.types import FloatArray

ERROR_TIME = 0.3
"""Time constant of the running error, seconds: a tool that is 10 cm off has fallen off after 0.2 s."""

START_TURN = 0.5
"""The tracing begins when the tool's frame is off by less than this, rad."""

TURNED_TIME = 0.1
"""A tool that points against the rope for this long, seconds, has lost it: the rope's ends may have changed places."""

STUCK_TIME, STUCK_WAY = 3.0, 0.01
"""A tool that has not got this much further along the rope, metres, in this time, seconds, is stuck."""

FASTEST = 2.0
"""No tool goes along a rope faster than this, m/s: what seems to is an error in the rope's velocity."""

LONGEST_STEP = 0.1
"""More than this does not count as time between two steps: the rope was out of sight, or a clock was set, seconds."""

FINISH = 0.003
"""The rope is traced when the tool's place is this close to its end, metres."""

WHOLE = 0.9
"""The tool has to have come along the rope by this share of the greatest length seen: the end that is in sight may not
be the rope's."""

BRAKING_SHARE = 0.5
"""Of the joints' accelerations, with which the tracer plans to stop before the end of a range."""

END_MARGIN = 0.02
"""Distance that the tracer keeps from the ends of the ranges, rad."""


@dataclass(frozen=True, slots=True)
class TracingSettings:
    """Gains of the controller; the paper's Table II is lost, these were found in simulation.

    Raises
    ------
    ConfigError
        If a value is impossible; the message names it.
    """

    gain_near: float = 14.0
    """alpha of equation 22 where the next waypoint is reached, 1/s. Speed along the rope is about this times
    `waypoint_distance`."""
    gain_far: float = 3.0
    """alpha where it is far away, 1/s."""
    gain_slope: float = 30.0
    """How fast alpha falls with the distance from the waypoint, 1/s for a metre or a radian."""
    feed_forward: float = 1.0
    """beta of equation 21."""
    waypoint_distance: float = 0.01
    """delta_p of equation 20, metres."""
    manipulability_gain: float = 2.0
    """k_s of equation 23."""
    joint_limit_gain: float = 10.0
    """k_jl of equation 23."""
    follow: Literal["rope", "waypoints"] = "rope"
    """The rope as a curve, with the velocity that it has where the tool is. Or as in the paper: the first viable
    waypoint of all, with its velocity, until there is none. That lets the tool lag or lead by the distance times the
    velocity's change along the rope over the gain, and end early."""
    lead: float = 0.0
    """The velocity that is fed forward is that of this much later: half a control period and the arm's own delay, s."""
    approach: Literal["towards_camera", "from_camera"] = "towards_camera"
    """Where the tool's Z axis points: at the camera (equations 15-17), or away from it."""
    reach: float = 0.01
    """The first and the last waypoint are reached within this distance, metres."""
    max_distance: float = 0.05
    """A tool that is further from the rope than this, in the running mean of `Step.error`, has fallen off, metres."""

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, str):
                continue
            if not (math.isfinite(value) and value >= 0):
                raise ConfigError(f"tracing.{item.name} = {value}: expected a finite number from 0")
        for name in ("gain_near", "waypoint_distance", "reach", "max_distance"):
            if getattr(self, name) <= 0:
                raise ConfigError(f"tracing.{name} = {getattr(self, name)}: expected a number above 0")
        for name, options in (("follow", ("rope", "waypoints")), ("approach", ("towards_camera", "from_camera"))):
            if getattr(self, name) not in options:
                raise ConfigError(f"tracing.{name} = {getattr(self, name)!r}: expected one of {', '.join(options)}")
        if self.lead > 0.1:
            raise ConfigError(f"tracing.lead = {self.lead}: expected 0 to 0.1 s")


class Phase(StrEnum):
    """How far the task is."""

    APPROACHING = "approaching"
    """On the way to the first waypoint."""
    TRACING = "tracing"
    DONE = "done"
    """The tool has come to the end of the rope, and along the whole of it."""
    FELL_OFF = "fell off"
    """The tool is too far from the rope, points against it, or nothing is ahead of it although the end is not there."""
    STUCK = "stuck"
    """The tool makes no headway."""

    @property
    def ended(self) -> bool:
        """Whether there is nothing more to do."""
        return self in (Phase.DONE, Phase.FELL_OFF, Phase.STUCK)


class Step(NamedTuple):
    """What one control step came to.

    Attributes
    ----------
    velocity : (n,) float array
        Wanted of the joints, rad/s; zero once the task has ended.
    phase : Phase
        Of the task.
    place : float
        Arc length of the tool's place on the rope, metres.
    length : float
        Of the rope, metres.
    distance : float
        From the tool to the rope; on the way there, to the first waypoint. Metres.
    error : float
        Running mean of the distance since the tracing began, over `ERROR_TIME`, metres.
    """

    velocity: FloatArray
    phase: Phase
    place: float
    length: float
    distance: float
    error: float


class RopeTracer:
    """Leads an arm's tool along a rope that moves. It only wishes: `limits.MotionGuard` decides.

    Parameters
    ----------
    arm : Arm
        Which.
    settings : TracingSettings
        Gains.
    camera_axis : (3,) float array
        The camera's viewing direction in the base's frame, R^Z_C of equation 16.

    Raises
    ------
    ConfigError
        If the axis is no unit vector.
    """

    def __init__(self, arm: Arm, settings: TracingSettings, camera_axis: FloatArray) -> None:
        axis = np.array(camera_axis, float)
        if axis.shape != (3,) or not 0.99 < np.linalg.norm(axis) < 1.01:
            raise ConfigError(f"camera_axis = {camera_axis}: expected a unit vector")
        self.arm = arm
        self.settings = settings
        self._axis = axis / np.linalg.norm(axis)
        self._gains = Gains(
            float(settings.gain_near),
            float(settings.gain_far),
            float(settings.gain_slope),
            float(settings.feed_forward),
            float(settings.lead),
            float(settings.waypoint_distance),
        )
        # Compiles the kernels now rather than in the first step.
        self.reset()
        self.step(0.0, 0.5 * (arm.limits.lower + arm.limits.upper), np.eye(3), np.zeros((3, 3)), np.zeros((3, 3)))
        self.reset()

    def reset(self) -> None:
        """Begin again at the first waypoint."""
        self.phase = Phase.APPROACHING
        self._time: float | None = None
        self._last = Step(np.zeros(self.arm.count), self.phase, 0.0, 0.0, math.nan, 0.0)
        self._tool: FloatArray | None = None
        self._whole = 0.0
        self._traced = 0.0
        self._turned = 0.0
        self._idle = 0.0
        self._farthest = -math.inf

    def step(
        self,
        now: float,
        q: FloatArray,
        positions: FloatArray,
        velocities: FloatArray,
        accelerations: FloatArray,
    ) -> Step:
        """One control step: from the rope as it is now to joint velocities.

        Parameters
        ----------
        now : float
            Seconds. Time that stands still, runs back or jumps does not count.
        q : (n,) float array
            Joint angles, rad.
        positions, velocities, accelerations : (W, 3) float array
            The waypoints predicted for `now`, base frame: metres, m/s, m/s^2. Any number of them, from step to step.

        Returns
        -------
        Step
            With a velocity of NaN, at which the guard brakes, if an input is not finite or there are fewer than two
            waypoints, or all at one place; nothing else changes then. Once the task has ended, the last one at rest.

        Raises
        ------
        ValueError
            If there is not one angle a joint.
        """
        if self.phase.ended:
            return self._last
        nothing = self._last._replace(velocity=np.full(self.arm.count, np.nan))
        shape = np.shape(positions)
        if not math.isfinite(now) or shape[0] < 2 or not shape == np.shape(velocities) == np.shape(accelerations):
            return nothing
        settings, limits = self.settings, self.arm.limits
        pose, jacobian = self.arm.kinematics(q)
        guidance = guide(
            positions,
            velocities,
            accelerations,
            pose,
            self._axis,
            self._gains,
            None if self.phase is Phase.APPROACHING else self._last.place,
            waypoints=settings.follow == "waypoints",
            from_camera=settings.approach == "from_camera",
        )
        if not (np.isfinite(guidance.twist).all() and math.isfinite(guidance.distance + guidance.remaining)):
            return nothing
        elapsed = 0.0 if self._time is None else min(max(now - self._time, 0.0), LONGEST_STEP)
        self._time = now
        error = self._judge(elapsed, pose, guidance)
        if self.phase.ended:
            velocity = np.zeros(self.arm.count)
        else:
            wish = secondary_velocity(q, jacobian, limits, settings.manipulability_gain, settings.joint_limit_gain)
            bounds = stopping_velocities(q, limits)
            velocity, _ = joint_velocities_within(jacobian, guidance.twist, wish, *bounds)
        self._last = Step(velocity, self.phase, guidance.place, guidance.length, guidance.distance, error)
        return self._last

    def _judge(self, elapsed: float, pose: FloatArray, guidance: Guidance) -> float:
        """Go on to the next phase where that is due; returns the running error."""
        settings = self.settings
        share = -math.expm1(-elapsed / ERROR_TIME)
        longer = max(guidance.length - self._whole, 0.0)
        self._whole += longer * (share if self._whole else 1.0)
        if self.phase is Phase.APPROACHING:
            if guidance.remaining <= settings.reach and guidance.turn <= START_TURN:
                self.phase = Phase.TRACING
                self._idle, self._farthest = 0.0, 0.0
            else:
                self._check_headway(elapsed, -guidance.remaining)
            return 0.0

        if self._tool is None:
            self._traced = guidance.place
        elif elapsed < LONGEST_STEP:
            advance = float((pose[:3, 3] - self._tool) @ guidance.tangent) - elapsed * guidance.sliding
            self._traced += min(max(advance, -FASTEST * elapsed), FASTEST * elapsed)
        self._tool = pose[:3, 3].copy()
        error = self._last.error + share * (guidance.distance - self._last.error)
        facing = pose[:3, 0] @ guidance.tangent >= 0
        self._turned = 0.0 if facing else self._turned + elapsed
        whole = facing and self._traced >= WHOLE * self._whole - FINISH
        if settings.follow == "waypoints" and not guidance.viable:
            near = guidance.remaining <= max(settings.reach, settings.waypoint_distance)
            self.phase = Phase.DONE if near and whole else Phase.FELL_OFF
        elif whole and guidance.remaining <= settings.reach and guidance.place >= guidance.length - FINISH:
            self.phase = Phase.DONE
        elif error > settings.max_distance or self._turned > TURNED_TIME:
            self.phase = Phase.FELL_OFF
        else:
            self._check_headway(elapsed, guidance.place)
        return error

    def _check_headway(self, elapsed: float, way: float) -> None:
        self._idle += elapsed
        if way > self._farthest + STUCK_WAY:
            self._farthest, self._idle = way, 0.0
        elif self._idle > STUCK_TIME:
            self.phase = Phase.STUCK


def stopping_velocities(q: FloatArray, limits: JointLimits) -> tuple[FloatArray, FloatArray]:
    """Least and greatest velocity of each joint from which it can stop before the end of its range, (n,) each, rad/s.

    They use only `BRAKING_SHARE` of the accelerations, so that a wish inside them is not one at which the guard brakes.
    How fast the wish may change is left to the guard: a bound on that would make the whole twist shorter.
    """
    room = 2 * BRAKING_SHARE * limits.acceleration
    lower = -np.minimum(limits.velocity, np.sqrt(room * np.maximum(q - limits.lower - END_MARGIN, 0.0)))
    upper = np.minimum(limits.velocity, np.sqrt(room * np.maximum(limits.upper - END_MARGIN - q, 0.0)))
    return lower, upper
