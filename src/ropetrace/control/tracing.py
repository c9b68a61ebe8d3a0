"""The arm traces the rope (section 5.2): which waypoint next, how fast the tool, and how that ends.

Everything is in the frame of the arm's base. Equations 15-17 let the tool's X axis point along the rope and its Z axis
at the camera, so the arm stands on the side of the rope that the camera does not see; `TracingSettings.approach` turns
the tool round for an arm that stands beside the camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Any, Literal, NamedTuple

import numpy as np
from numba import njit

from ropetrace.control.arm import Arm, JointLimits
from ropetrace.control.kinematics import joint_velocities_within, secondary_velocity
from ropetrace.errors import ConfigError
from ropetrace.types import FloatArray

FELL_OFF_TIME = 0.1
"""The tool may be further from the rope than allowed for this long, seconds."""

STUCK_TIME, STUCK_WAY = 3.0, 0.01
"""A tool that has not got this much further along the rope, metres, in this time, seconds, is stuck."""

BRAKING_SHARE = 0.5
"""Of the joints' accelerations, with which the tracer plans to stop before the end of a range."""

END_MARGIN = 0.02
"""Distance that the tracer keeps from the ends of the ranges, rad."""

WINDOW = 0.15
"""The tool's place on the rope is looked for this far round the last one: strands that cross are not taken, metres."""


@dataclass(frozen=True, slots=True)
class TracingSettings:
    """Gains of the controller; the paper's Table II is lost, these were found in simulation.

    Raises
    ------
    ConfigError
        If a value is impossible; the message names it.
    """

    gain_near: float = 10.0
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
    velocity_at: Literal["tool", "waypoint"] = "tool"
    """Whose velocity is fed forward: of the rope where the tool is, or, as in the paper, of the next waypoint. The
    waypoint's lets the tool lag or lead by the distance times the velocity's change along the rope over the gain."""
    lead: float = 0.0
    """The velocity that is fed forward is that of this much later: half a control period and the arm's own delay, s."""
    approach: Literal["towards_camera", "from_camera"] = "towards_camera"
    """Where the tool's Z axis points: at the camera (equations 15-17), or away from it."""
    reach: float = 0.01
    """The first and the last waypoint are reached within this distance, metres."""
    max_distance: float = 0.05
    """A tool further from the rope than this has fallen off, metres."""

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
        for name, options in (("velocity_at", ("tool", "waypoint")), ("approach", ("towards_camera", "from_camera"))):
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
    """The tool has reached the last waypoint."""
    FELL_OFF = "fell off"
    """The tool is too far from the rope, or nothing is ahead of it although the end has not been reached."""
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
        From the tool to the rope, metres.
    """

    velocity: FloatArray
    phase: Phase
    place: float
    length: float
    distance: float


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
    """

    def __init__(self, arm: Arm, settings: TracingSettings, camera_axis: FloatArray) -> None:
        axis = np.array(camera_axis, float)
        if axis.shape != (3,) or not 0.99 < np.linalg.norm(axis) < 1.01:
            raise ConfigError(f"camera_axis = {camera_axis}: expected a unit vector")
        self.arm = arm
        self.settings = settings
        self._axis = axis / np.linalg.norm(axis)
        self._gains = np.array(
            [settings.gain_near, settings.gain_far, settings.gain_slope, settings.feed_forward, settings.lead]
        )
        self.reset()

    def reset(self) -> None:
        """Begin again at the first waypoint."""
        self.phase = Phase.APPROACHING
        self._place = 0.0
        self._off_since: float | None = None
        self._mark: tuple[float, float] | None = None
        self._closest_so_far = math.inf

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
            Seconds.
        q : (n,) float array
            Joint angles, rad.
        positions, velocities, accelerations : (W, 3) float array
            The waypoints predicted for `now`, W >= 2, base frame: metres, m/s, m/s^2.

        Returns
        -------
        Step
            With a velocity of NaN if an input is not finite, at which the guard brakes; the phase does not change then.
        """
        settings = self.settings
        if not self.phase.ended and (len(positions) < 2 or not math.isfinite(now)):
            return Step(np.full(self.arm.count, np.nan), self.phase, self._place, 0.0, math.nan)
        pose, jacobian = self.arm.kinematics(q)
        twist = np.empty(6)
        index, place, length, distance, remaining = _guide(
            np.ascontiguousarray(positions),
            velocities,
            accelerations,
            pose,
            self._axis,
            self._gains,
            settings.waypoint_distance,
            settings.velocity_at == "tool",
            settings.approach == "from_camera",
            self.phase == Phase.APPROACHING,
            self._place,
            twist,
        )
        finite = math.isfinite(distance) and bool(np.isfinite(twist).all())
        if finite:
            self._judge(now, index, place, length, distance, remaining)
        if self.phase.ended:
            return Step(np.zeros(self.arm.count), self.phase, self._place, length, distance)
        if not finite:
            return Step(np.full(self.arm.count, np.nan), self.phase, self._place, length, distance)
        limits = self.arm.limits
        wish = secondary_velocity(q, jacobian, limits, settings.manipulability_gain, settings.joint_limit_gain)
        velocity, _ = joint_velocities_within(jacobian, twist, wish, *stopping_velocities(q, limits))
        return Step(velocity, self.phase, self._place, length, distance)

    def _judge(self, now: float, index: int, place: float, length: float, distance: float, remaining: float) -> None:
        """Go on to the next phase where that is due."""
        settings = self.settings
        if self.phase == Phase.APPROACHING:
            if remaining <= settings.reach:
                self.phase = Phase.TRACING
                self._mark = (now, place)
                self._place = place
                return
            if remaining < self._closest_so_far - STUCK_WAY or self._mark is None:
                self._closest_so_far, self._mark = min(remaining, self._closest_so_far), (now, 0.0)
            if now - self._mark[0] > STUCK_TIME:
                self.phase = Phase.STUCK
            return
        if self.phase != Phase.TRACING:
            return
        self._place = place
        if index < 0 and remaining <= settings.reach:
            self.phase = Phase.DONE
            return
        if distance > settings.max_distance:
            self._off_since = now if self._off_since is None else self._off_since
            if now - self._off_since > FELL_OFF_TIME:
                self.phase = Phase.FELL_OFF
                return
        else:
            self._off_since = None
        if index < 0 and remaining > max(settings.max_distance, 2 * settings.waypoint_distance):
            self.phase = Phase.FELL_OFF
            return
        if self._mark is None or place > self._mark[1] + STUCK_WAY:
            self._mark = (now, place)
        elif now - self._mark[0] > STUCK_TIME:
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


def adaptive_gain(distance: float, near: float, far: float, slope: float) -> float:
    """alpha of equation 22: `near` at distance 0, where it falls by `slope`, to `far` at infinity, 1/s.

    Where both are equal the printed form is 0/0: the gain is then constant.
    """
    return float(_adaptive_gain(distance, near, far, slope))


def viable(
    tool_position: FloatArray,
    tool_x: FloatArray,
    positions: FloatArray,
    tangents: FloatArray,
    distance: float,
) -> Any:
    """Which waypoints the tool can go to next (equations 18-20), (W,) bool.

    Parameters
    ----------
    tool_position, tool_x : (3,) float array
        The tool's origin and X axis.
    positions, tangents : (W, 3) float array
        The waypoints and their X axes.
    distance : float
        delta_p, metres.
    """
    away = positions - tool_position
    return (away @ tool_x >= 0) & (tangents @ tool_x >= 0) & (np.linalg.norm(away, axis=1) >= distance)


def waypoint_frame(tangent: FloatArray, camera_axis: FloatArray, from_camera: bool = False) -> FloatArray:
    """The frame of a waypoint, (3, 3), from its X axis and the camera's axis (equations 16 and 17, as unit vectors).

    With `from_camera` Y and Z are reversed. NaN where the rope points along the view: the rule gives no frame there.
    """
    frame = np.empty((3, 3))
    _frame(np.asarray(tangent, float), np.asarray(camera_axis, float), from_camera, frame)
    return frame


def rotation_vector(target: FloatArray, current: FloatArray) -> FloatArray:
    """The rotation that turns one frame (3, 3) into another, as axis times angle, (3,), rad, 0 to pi."""
    vector = np.empty(3)
    _rotation_vector(target, current, vector)
    return vector


@njit(cache=True, nogil=True)
def _adaptive_gain(distance: float, near: float, far: float, slope: float) -> float:
    if abs(near - far) < 1e-12:
        return far
    return (near - far) * np.exp(-slope / (near - far) * distance) + far


@njit(cache=True, nogil=True)
def _frame(tangent: Any, axis: Any, from_camera: bool, frame: Any) -> None:
    """Columns X, Y = X x Z_C, Z = X x Y, made unit vectors."""
    sign = -1.0 if from_camera else 1.0
    along = size = 0.0
    for k in range(3):
        along += tangent[k] * tangent[k]
    along = np.sqrt(along)
    for k in range(3):
        frame[k, 0] = tangent[k] / along
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        frame[k, 1] = sign * (frame[a, 0] * axis[b] - frame[b, 0] * axis[a])
        size += frame[k, 1] ** 2
    size = np.sqrt(size)
    for k in range(3):
        frame[k, 1] = frame[k, 1] / size if size > 1e-9 else np.nan
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        frame[k, 2] = frame[a, 0] * frame[b, 1] - frame[b, 0] * frame[a, 1]


@njit(cache=True, nogil=True)
def _rotation_vector(target: Any, current: Any, vector: Any) -> None:
    turn = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                turn[i, j] += target[i, k] * current[j, k]
    sine = 0.0
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        vector[k] = 0.5 * (turn[b, a] - turn[a, b])
        sine += vector[k] ** 2
    sine = np.sqrt(sine)
    cosine = 0.5 * (turn[0, 0] + turn[1, 1] + turn[2, 2] - 1.0)
    angle = np.arctan2(sine, cosine)
    if sine > 1e-9:
        for k in range(3):
            vector[k] *= angle / sine
        return
    if cosine > 0:
        return
    # Half a turn: the axis is the column of (turn + I) / 2 that is longest.
    most = 0
    for k in range(1, 3):
        if turn[k, k] > turn[most, most]:
            most = k
    size = np.sqrt(max(0.5 * (turn[most, most] + 1.0), 1e-12))
    for k in range(3):
        vector[k] = np.pi * 0.5 * (turn[k, most] + (1.0 if k == most else 0.0)) / size


@njit(cache=True, nogil=True)
def _at(values: Any, arcs: Any, place: float, out: Any) -> None:
    """Linear interpolation along the arc length, held beyond the ends."""
    segment = min(max(np.searchsorted(arcs, place) - 1, 0), len(arcs) - 2)
    part = (place - arcs[segment]) / max(arcs[segment + 1] - arcs[segment], 1e-12)
    part = min(max(part, 0.0), 1.0)
    for k in range(3):
        out[k] = values[segment, k] + part * (values[segment + 1, k] - values[segment, k])


@njit(cache=True, nogil=True)
def _closest(positions: Any, arcs: Any, tool: Any, around: float, window: float) -> tuple[float, float]:
    """Arc length and distance of the place on the polyline that is closest to the tool, within the window."""
    best, where = np.inf, around
    for n in range(len(positions) - 1):
        if arcs[n + 1] < around - window or arcs[n] > around + window:
            continue
        size = along = 0.0
        for k in range(3):
            step = positions[n + 1, k] - positions[n, k]
            size += step * step
            along += step * (tool[k] - positions[n, k])
        part = min(max(along / size, 0.0), 1.0) if size > 1e-18 else 0.0
        away = 0.0
        for k in range(3):
            away += (positions[n, k] + part * (positions[n + 1, k] - positions[n, k]) - tool[k]) ** 2
        if away < best:
            best, where = away, arcs[n] + part * (arcs[n + 1] - arcs[n])
    return where, np.sqrt(best)


_HALF_CHORD = 0.015
"""The rope's direction is that of a chord this far to either side, metres: a waypoint's spacing has too much noise."""


@njit(cache=True, nogil=True)
def _tangent(positions: Any, arcs: Any, place: float, out: Any) -> float:
    """The rope's direction at a place, not normalised; the arc length that it spans."""
    before, after = max(place - _HALF_CHORD, 0.0), min(place + _HALF_CHORD, arcs[-1])
    here = np.empty(3)
    _at(positions, arcs, before, here)
    _at(positions, arcs, after, out)
    for k in range(3):
        out[k] -= here[k]
    return after - before


@njit(cache=True, nogil=True)
def _at_distance(positions: Any, arcs: Any, index: int, place: float, tool: Any, distance: float) -> float:
    """Arc length, between the waypoint before `index` and it, at which the rope is just `distance` from the tool.

    Equation 20 with waypoints that lie as close as one likes: the tool does not jerk from waypoint to waypoint.
    """
    low, high = max(arcs[index - 1], place), arcs[index]
    here = np.empty(3)
    for _ in range(20):
        middle = 0.5 * (low + high)
        _at(positions, arcs, middle, here)
        away = 0.0
        for k in range(3):
            away += (here[k] - tool[k]) ** 2
        if away < distance * distance:
            low = middle
        else:
            high = middle
    return high


@njit(cache=True, nogil=True)
def _guide(
    positions: Any,
    velocities: Any,
    accelerations: Any,
    pose: Any,
    axis: Any,
    gains: Any,
    distance: float,
    at_tool: bool,
    from_camera: bool,
    approaching: bool,
    last_place: float,
    twist: Any,
) -> tuple[int, float, float, float, float]:
    """The tool's wanted twist (equations 18-22).

    Returns the next waypoint's index (-1 if none is viable: then the last one is aimed at), the tool's place on the
    rope, the rope's length, the distance from it, and the distance to the first (approaching) or last waypoint.
    """
    count = len(positions)
    tool, tool_x = pose[:3, 3], pose[:3, 0]
    arcs = np.zeros(count)
    for n in range(1, count):
        size = 0.0
        for k in range(3):
            size += (positions[n, k] - positions[n - 1, k]) ** 2
        arcs[n] = arcs[n - 1] + np.sqrt(size)
    length = arcs[-1]
    if not np.isfinite(length):
        return -1, last_place, np.nan, np.nan, np.nan
    if approaching:
        place, away = _closest(positions, arcs, tool, 0.0, distance)
    else:
        place, away = _closest(positions, arcs, tool, last_place, WINDOW)
        if not np.isfinite(away):
            place, away = _closest(positions, arcs, tool, 0.0, np.inf)

    index = 0
    tangent = np.empty(3)
    if not approaching:
        index = -1
        for n in range(count):
            if arcs[n] < place:
                continue
            ahead = size = same = 0.0
            _tangent(positions, arcs, arcs[n], tangent)
            for k in range(3):
                off = positions[n, k] - tool[k]
                ahead += tool_x[k] * off
                size += off * off
                same += tool_x[k] * tangent[k]
            if ahead >= 0 and same >= 0 and size >= distance * distance:
                index = n
                break
    goal = arcs[index] if index >= 0 else length
    if at_tool and index > 0:
        goal = _at_distance(positions, arcs, index, place, tool, distance)

    _tangent(positions, arcs, goal, tangent)
    frame, aim = np.empty((3, 3)), np.empty(3)
    _frame(tangent, axis, from_camera, frame)
    _at(positions, arcs, goal, aim)
    offset = np.empty(6)
    size = left = 0.0
    _rotation_vector(frame, pose[:3, :3], offset[3:])
    for k in range(3):
        offset[k] = aim[k] - tool[k]
        left += (positions[0 if approaching else count - 1, k] - tool[k]) ** 2
    for k in range(6):
        size += offset[k] ** 2
    gain = _adaptive_gain(np.sqrt(size), gains[0], gains[1], gains[2])

    source = place if at_tool else goal
    moving = np.empty(6)
    _rope_twist(positions, velocities, accelerations, arcs, source, axis, from_camera, gains[4], moving)
    for k in range(6):
        twist[k] = gain * offset[k] + gains[3] * moving[k]
    return index, place, length, away, np.sqrt(left)


@njit(cache=True, nogil=True)
def _rope_twist(
    positions: Any,
    velocities: Any,
    accelerations: Any,
    arcs: Any,
    place: float,
    axis: Any,
    from_camera: bool,
    lead: float,
    moving: Any,
) -> None:
    """Velocity of the rope at a place and angular velocity of its frame there, `lead` seconds later."""
    ahead, change, later = np.empty(3), np.empty(3), np.empty(3)
    _at(velocities, arcs, place, moving[:3])
    _at(accelerations, arcs, place, later)
    for k in range(3):
        moving[k] += lead * later[k]
    tangent = np.empty(3)
    span = _tangent(positions, arcs, place, tangent)
    _tangent(velocities, arcs, place, change)
    _tangent(accelerations, arcs, place, ahead)
    for k in range(3):
        change[k] += lead * ahead[k]
    moment = 1e-3
    for k in range(3):
        later[k] = tangent[k] + moment * change[k]
    now, then, turn = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    _frame(tangent, axis, from_camera, now)
    _frame(later, axis, from_camera, then)
    _rotation_vector(then, now, turn)
    for k in range(3):
        rate = turn[k] / moment
        moving[3 + k] = rate if span > 0 and np.isfinite(rate) else 0.0
