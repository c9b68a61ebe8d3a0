"""Where the tool goes next, and how fast (equations 15-22): the small functions, and one kernel made of them.

Everything is in the frame of the arm's base, in metres, seconds and radians.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from ropetrace.control.curve import apart, arc_lengths, at_arc, chord, closest_place, place_at_distance
from ropetrace.control.frames import STEEP, frame_onto, rotation_onto
from ropetrace.types import FloatArray

MOST_TURN = 0.3
"""Of a greater angle between tool and rope only this much counts in equations 21 and 22, rad: else a tool that has far
to turn neglects the rope's place, with joints at their limits and with a gain that is low."""

_MOMENT = 1e-5
"""Time over which the turning of the rope's frame is found, seconds."""


class Gains(NamedTuple):
    """Of equations 20-22; see `tracing.TracingSettings`."""

    near: float
    far: float
    slope: float
    feed_forward: float
    lead: float
    distance: float


class Guidance(NamedTuple):
    """Where the tool is to go.

    Attributes
    ----------
    twist : (6,) float array
        Wanted of the tool, along the base's axes: m/s and rad/s.
    viable : bool
        Whether what it aims at satisfies equations 18-20; the end of the rope may be closer than delta_p.
    place : float
        Arc length of the tool's place on the rope, metres; 0 on the way to the first waypoint.
    length : float
        Of the rope, metres.
    distance : float
        From the tool to the rope; to the first waypoint on the way there, metres.
    remaining : float
        From the tool to the first waypoint on the way there, else to the last one, metres.
    turn : float
        Angle between the tool's frame and the one that it is to have, rad.
    tangent : (3,) float array
        The rope's direction at the tool's place, unit vector.
    sliding : float
        Velocity of the rope there along itself, m/s.
    """

    twist: FloatArray
    viable: bool
    place: float
    length: float
    distance: float
    remaining: float
    turn: float
    tangent: FloatArray
    sliding: float


def guide(
    positions: FloatArray,
    velocities: FloatArray,
    accelerations: FloatArray,
    pose: FloatArray,
    camera_axis: FloatArray,
    gains: Gains,
    last_place: float | None,
    *,
    waypoints: bool = False,
    from_camera: bool = False,
) -> Guidance:
    """The tool's wanted twist (equations 18-22).

    The tool follows the rope as a curve. It aims at the first point ahead of its place that is delta_p away (equation
    20); if that is not viable by equations 18 and 19, at its place, until it has turned; if all that is left is closer
    than delta_p, straight on beyond the end, so as not to slow down. Its place moves along the rope from the last one:
    a strand that crosses, or lies alongside, is not taken. With `waypoints`, as in the paper, it aims at the first
    viable waypoint of all.

    Parameters
    ----------
    positions, velocities, accelerations : (W, 3) float array
        Of the waypoints, W >= 2, base frame.
    pose : (4, 4) float array
        base_from_tool.
    camera_axis : (3,) float array
        Unit vector, the camera's viewing direction.
    gains : Gains
    last_place : float or None
        Arc length of the tool's place a step before; None on the way to the first waypoint.
    waypoints : bool
        Go from waypoint to waypoint, with the velocity of the next one fed forward, as in the paper.
    from_camera : bool
        See `frames.waypoint_frame`.

    Returns
    -------
    Guidance
        With a twist of NaN where something is not finite, or all waypoints coincide.
    """
    twist, tangent = np.empty(6), np.empty(3)
    found, place, length, away, remaining, turn, sliding = _guide(
        np.ascontiguousarray(positions, dtype=np.float64),
        np.ascontiguousarray(velocities, dtype=np.float64),
        np.ascontiguousarray(accelerations, dtype=np.float64),
        np.ascontiguousarray(pose, dtype=np.float64),
        camera_axis,
        gains,
        waypoints,
        from_camera,
        last_place is None,
        last_place or 0.0,
        twist,
        tangent,
    )
    return Guidance(twist, bool(found), place, length, away, remaining, turn, tangent, sliding)


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
    tool, axis = np.array(tool_position, float), np.array(tool_x, float)
    return np.array(
        [
            _faces(tool, axis, np.array(position, float), np.array(tangent, float))
            and apart(tool, np.array(position, float)) >= distance
            for position, tangent in zip(positions, tangents, strict=True)
        ],
        dtype=bool,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _adaptive_gain(distance: float, near: float, far: float, slope: float) -> float:
    if abs(near - far) < 1e-12:
        return far
    return (near - far) * np.exp(-slope / (near - far) * distance) + far


@njit(cache=True, nogil=True, error_model="numpy")
def _faces(tool: Any, tool_x: Any, position: Any, tangent: Any) -> bool:
    """Equations 18 and 19: the waypoint is ahead of the tool, and points where the tool points."""
    ahead = same = 0.0
    for k in range(3):
        ahead += tool_x[k] * (position[k] - tool[k])
        same += tool_x[k] * tangent[k]
    return ahead >= 0 and same >= 0


@njit(cache=True, nogil=True, error_model="numpy")
def _first_viable(positions: Any, arcs: Any, tool: Any, tool_x: Any, distance: float) -> int:
    """The first waypoint that satisfies equations 18-20; -1 if none does."""
    tangent = np.empty(3)
    for n in range(len(positions)):
        chord(positions, arcs, arcs[n], tangent)
        if _faces(tool, tool_x, positions[n], tangent) and apart(tool, positions[n]) >= distance:
            return n
    return -1


@njit(cache=True, nogil=True, error_model="numpy")
def _guide(
    positions: Any,
    velocities: Any,
    accelerations: Any,
    pose: Any,
    axis: Any,
    gains: Any,
    waypoints: bool,
    from_camera: bool,
    approaching: bool,
    last_place: float,
    twist: Any,
    tangent: Any,
) -> tuple[bool, float, float, float, float, float, float]:
    """See `guide`."""
    tool, tool_x = pose[:3, 3].copy(), pose[:3, 0].copy()
    aim = np.empty(3)
    arcs = arc_lengths(positions)
    length = arcs[-1]
    if not np.isfinite(length):
        twist[:], tangent[:] = np.nan, np.nan
        return False, last_place, np.nan, np.nan, np.nan, np.nan, np.nan

    place, away, goal, found = 0.0, apart(positions[0], tool), 0.0, True
    remaining = away
    if not approaching:
        place, away = closest_place(positions, arcs, tool, last_place)
        remaining = apart(positions[-1], tool)
        if waypoints:
            index = _first_viable(positions, arcs, tool, tool_x, gains.distance)
            found = index >= 0
            goal = arcs[index]
        else:
            goal = place_at_distance(positions, arcs, place, tool, gains.distance)
            chord(positions, arcs, goal, tangent)
            at_arc(positions, arcs, goal, aim)
            found = _faces(tool, tool_x, aim, tangent)
            if not found and goal < length:
                goal = place

    offset, frame = np.empty(6), np.empty((3, 3))
    chord(positions, arcs, goal, tangent)
    frame_onto(tangent, axis, from_camera, pose[:3, :3], frame)
    at_arc(positions, arcs, goal, aim)
    rotation_onto(frame, pose[:3, :3], offset[3:])
    if goal == length and not approaching and not waypoints:
        beyond = max(gains.distance - remaining, 0.0) / max(apart(tangent, np.zeros(3)), 1e-300)
        for k in range(3):
            aim[k] += beyond * tangent[k]
    turn = np.sqrt(offset[3] ** 2 + offset[4] ** 2 + offset[5] ** 2)
    size = 0.0
    for k in range(3):
        offset[k] = aim[k] - tool[k]
        if turn > MOST_TURN and not waypoints:
            offset[3 + k] *= MOST_TURN / turn
    for k in range(6):
        size += offset[k] ** 2
    gain = _adaptive_gain(np.sqrt(size), gains.near, gains.far, gains.slope)
    source = goal if waypoints else place
    moving = np.empty(6)
    _rope_twist(positions, velocities, accelerations, arcs, source, axis, from_camera, pose, gains.lead, moving)
    for k in range(6):
        twist[k] = gain * offset[k] + gains.feed_forward * moving[k]

    size = sliding = 0.0
    chord(positions, arcs, place, tangent)
    at_arc(velocities, arcs, place, aim)
    for k in range(3):
        size += tangent[k] ** 2
    for k in range(3):
        tangent[k] /= np.sqrt(size)
        sliding += tangent[k] * aim[k]
    return found, place, length, away, remaining, turn, sliding


@njit(cache=True, nogil=True, error_model="numpy")
def _rope_twist(
    positions: Any,
    velocities: Any,
    accelerations: Any,
    arcs: Any,
    place: float,
    axis: Any,
    from_camera: bool,
    pose: Any,
    lead: float,
    moving: Any,
) -> None:
    """Velocity of the rope at a place and angular velocity of its frame there, `lead` seconds later.

    Where the frame is the tool's rather than that of the rule, it follows the rope without twist.
    """
    tangent, rate, more = np.empty(3), np.empty(3), np.empty(3)
    at_arc(velocities, arcs, place, moving[:3])
    at_arc(accelerations, arcs, place, more)
    for k in range(3):
        moving[k] += lead * more[k]
    chord(positions, arcs, place, tangent)
    chord(velocities, arcs, place, rate)
    chord(accelerations, arcs, place, more)
    size = 0.0
    for k in range(3):
        rate[k] += lead * more[k]
        more[k] = tangent[k] + _MOMENT * rate[k]
        size += tangent[k] ** 2
    now, then = np.empty((3, 3)), np.empty((3, 3))
    sine = frame_onto(tangent, axis, from_camera, pose[:3, :3], now)
    frame_onto(more, axis, from_camera, pose[:3, :3], then)
    rotation_onto(then, now, moving[3:])
    for k in range(3):
        moving[3 + k] /= _MOMENT
        if sine < STEEP:
            a, b = (k + 1) % 3, (k + 2) % 3
            moving[3 + k] = (tangent[a] * rate[b] - tangent[b] * rate[a]) / size
