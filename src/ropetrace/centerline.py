"""From ordered nodes to waypoints: a spline by arc length, and a frame at each waypoint (section 4.2, equations 15-17).

The kernels do what SciPy's `CubicSpline` and `Rotation` do, which the tests compare them with; for the few dozen nodes
of a rope, calling SciPy took a third of a whole frame's time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ropetrace.types import FloatArray, Waypoints

_FINE_STEPS = 8
"""Pieces into which each span of the spline is divided to measure its length."""

MOST_SPACINGS = 100_000
"""More waypoints than these are not made: such a length is a wrong unit, and must not exhaust the memory."""

SHORTEST_STEP = 1e-6
"""Nodes closer together than this are one, metres."""

_STEEP = 0.2
"""Sine of the angle between rope and view below which equation 16 is too ill-conditioned to be used."""


def chain_tangents(chain: FloatArray) -> FloatArray:
    """Unit tangents of a polyline at its vertices: those of the parabola through each vertex and its two neighbours.

    Parameters
    ----------
    chain : (M, 3) float array
        M >= 2, neighbours distinct, metres.

    Returns
    -------
    (M, 3) float array
    """
    tangents = np.empty_like(chain)
    _chain_tangents(chain, tangents)
    return tangents


def extend_to_tips(chain: FloatArray, reach: tuple[float, float]) -> FloatArray:
    """The chain with a point added at each end: end nodes are centroids, half a slice short of the rope's tips.

    Parameters
    ----------
    chain : (M, 3) float array
        Nodes, M >= 2, metres.
    reach : (start, end)
        How far the rope goes on beyond its first and last node, metres.

    Returns
    -------
    (M + 2, 3) float array
        Shorter by what does not reach on.
    """
    tangents = chain_tangents(chain)
    first, last = chain[0] - reach[0] * tangents[0], chain[-1] + reach[1] * tangents[-1]
    # A slice without extent, as of coincident points, has no tip beyond it.
    before = [first] if reach[0] > SHORTEST_STEP else []
    after = [last] if reach[1] > SHORTEST_STEP else []
    return np.array([*before, *chain, *after])


def sample_spline(chain: FloatArray, spacing: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A natural cubic spline through the chain, sampled at equal arc length.

    Parameters
    ----------
    chain : (M, 3) float array
        M >= 2, neighbours distinct, metres.
    spacing : float
        Wanted arc length between samples, metres; the nearest that divides the length evenly is used, so that the
        last sample is the last node. No more than `MOST_SPACINGS` are made.

    Returns
    -------
    positions : (W, 3) float array
        Metres.
    tangents : (W, 3) float array
        Unit vectors: the limit of equation 15 for close waypoints.
    arc_length : (W,) float array
        Metres from the first node.
    """
    positions, tangents, arc_length = _sample_spline(np.ascontiguousarray(chain), spacing)
    return positions, tangents, arc_length


def spline_at(knots: FloatArray, chain: FloatArray, places: FloatArray) -> FloatArray:
    """Points of a natural cubic spline through the chain.

    Parameters
    ----------
    knots : (M,) float array
        Where the chain's points are along it, M >= 2, growing, metres.
    chain : (M, 3) float array
        Metres.
    places : (P,) float array
        Growing, from the first to the last knot, metres.

    Returns
    -------
    (P, 3) float array
        Metres.
    """
    points = np.empty((len(places), 3))
    _spline_at(knots, np.ascontiguousarray(chain), places, points)
    return points


def waypoint_frames(tangents: FloatArray) -> FloatArray:
    """Rotation matrices of the waypoints' frames (equations 15-17).

    X runs along the rope, Y = X x Z_C and Z = X x Y with Z_C the camera's viewing axis, each made a unit vector (the
    printed cross products are shorter, and vanish where the rope points at the camera). Where the angle to the view is
    too small for that rule, the frame is carried along the rope without twist, and what twist is needed to meet the
    rule again on the other side is spread evenly.

    Parameters
    ----------
    tangents : (W, 3) float array
        Unit vectors, camera frame.

    Returns
    -------
    (W, 3, 3) float array
        Columns X, Y, Z: orthonormal, determinant +1.
    """
    frames = np.empty((len(tangents), 3, 3))
    _waypoint_frames(tangents, frames)
    return frames


def make_waypoints(chain: FloatArray, spacing: float, previous: Waypoints | None = None) -> Waypoints:
    """Waypoints with poses along a chain that reaches from tip to tip.

    Parameters
    ----------
    chain : (M, 3) float array
        M >= 2, neighbours distinct, metres, camera frame.
    spacing : float
        Arc length between waypoints, metres.
    previous : Waypoints, optional
        Of the frame before: its first quaternion settles the sign of the first of this one.

    Returns
    -------
    Waypoints
        Quaternions are continuous in sign along the rope and from frame to frame.
    """
    positions, tangents, arc_length = sample_spline(chain, spacing)
    reference = previous.quaternions[0] if previous is not None and len(previous) else _IDENTITY
    quaternions = np.empty((len(tangents), 4))
    _quaternions(waypoint_frames(tangents), reference, quaternions)
    return Waypoints(positions, quaternions, arc_length)


def waypoints_through(positions: FloatArray, previous: Waypoints | None = None) -> Waypoints:
    """Waypoints with poses at given places, such as predicted ones: nothing is sampled anew.

    Parameters
    ----------
    positions : (W, 3) float array
        W >= 2, in order along the rope, metres, camera frame. Places that coincide are allowed.
    previous : Waypoints, optional
        As in `make_waypoints`.
    """
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    arc_length = np.concatenate([[0.0], np.cumsum(steps)])
    distinct = np.concatenate([[True], steps > SHORTEST_STEP])
    if np.count_nonzero(distinct) < 2:
        tangents = np.tile([0.0, 1.0, 0.0], (len(positions), 1))
    else:
        tangents = chain_tangents(np.ascontiguousarray(positions[distinct]))[np.cumsum(distinct) - 1]
    reference = previous.quaternions[0] if previous is not None and len(previous) else _IDENTITY
    quaternions = np.empty((len(tangents), 4))
    _quaternions(waypoint_frames(tangents), reference, quaternions)
    return Waypoints(positions, quaternions, arc_length)


_IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


@njit(cache=True, nogil=True)
def _chain_tangents(chain: Any, tangents: Any) -> None:
    count = len(chain)
    steps = np.empty(3)
    for m in range(count):
        first = min(max(m - 1, 0), max(count - 3, 0))
        middle, last = first + 1, min(first + 2, count - 1)
        before = after = 0.0
        for k in range(3):
            before += (chain[middle, k] - chain[first, k]) ** 2
            after += (chain[last, k] - chain[middle, k]) ** 2
        before, after = np.sqrt(before), np.sqrt(after)
        size = 0.0
        for k in range(3):
            slope = (chain[middle, k] - chain[first, k]) / before
            if last == middle:
                steps[k] = slope
            else:
                bend = ((chain[last, k] - chain[middle, k]) / after - slope) / (before + after)
                place = -before if m == first else (0.0 if m == middle else after)
                steps[k] = slope + bend * (before + 2 * place)
            size += steps[k] * steps[k]
        for k in range(3):
            tangents[m, k] = steps[k] / np.sqrt(size)


@njit(cache=True, nogil=True)
def _second_derivatives(knots: Any, chain: Any) -> Any:
    """Of the natural cubic spline at its knots, by the Thomas algorithm."""
    count = len(chain)
    result = np.zeros((count, 3))
    weights = np.zeros(count)
    for m in range(1, count - 1):
        before, after = knots[m] - knots[m - 1], knots[m + 1] - knots[m]
        pivot = 2 * (before + after) - before * weights[m - 1]
        weights[m] = after / pivot
        for k in range(3):
            change = (chain[m + 1, k] - chain[m, k]) / after - (chain[m, k] - chain[m - 1, k]) / before
            result[m, k] = (6 * change - before * result[m - 1, k]) / pivot
    for m in range(count - 2, 0, -1):
        for k in range(3):
            result[m, k] -= weights[m] * result[m + 1, k]
    return result


@njit(cache=True, nogil=True)
def _sample_spline(chain: Any, spacing: float) -> Any:
    count = len(chain)
    knots = np.zeros(count)
    for m in range(1, count):
        size = 0.0
        for k in range(3):
            size += (chain[m, k] - chain[m - 1, k]) ** 2
        knots[m] = knots[m - 1] + np.sqrt(size)
    second = _second_derivatives(knots, chain)

    fine = np.empty((count - 1) * _FINE_STEPS + 1)
    length = np.zeros(len(fine))
    here, before, slope = np.empty(3), np.empty(3), np.empty(3)
    for index in range(len(fine)):
        m = min(index // _FINE_STEPS, count - 2)
        fine[index] = knots[m] + (index - m * _FINE_STEPS) / _FINE_STEPS * (knots[m + 1] - knots[m])
        _evaluate(knots, chain, second, m, fine[index], here, slope)
        if index:
            size = 0.0
            for k in range(3):
                size += (here[k] - before[k]) ** 2
            length[index] = length[index - 1] + np.sqrt(size)
        before[:] = here

    total = length[-1]
    samples = int(min(max(np.round(total / spacing), 1.0), MOST_SPACINGS)) + 1
    positions, tangents, arc_length = np.empty((samples, 3)), np.empty((samples, 3)), np.empty(samples)
    piece = 0
    for index in range(samples):
        arc_length[index] = total * index / (samples - 1)
        while piece < len(fine) - 2 and length[piece + 1] < arc_length[index]:
            piece += 1
        part = (arc_length[index] - length[piece]) / max(length[piece + 1] - length[piece], 1e-300)
        place = fine[piece] + min(part, 1.0) * (fine[piece + 1] - fine[piece])
        _evaluate(knots, chain, second, min(piece // _FINE_STEPS, count - 2), place, positions[index], slope)
        size = np.sqrt(slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2)
        for k in range(3):
            tangents[index, k] = slope[k] / size
    return positions, tangents, arc_length


@njit(cache=True, nogil=True)
def _spline_at(knots: Any, chain: Any, places: Any, points: Any) -> None:
    second = _second_derivatives(knots, chain)
    slope = np.empty(3)
    m = 0
    for index in range(len(places)):
        while m < len(knots) - 2 and knots[m + 1] < places[index]:
            m += 1
        _evaluate(knots, chain, second, m, places[index], points[index], slope)


@njit(cache=True, nogil=True)
def _evaluate(knots: Any, chain: Any, second: Any, m: int, place: float, position: Any, slope: Any) -> None:
    """Position and derivative on the span from knot m to m + 1."""
    span = knots[m + 1] - knots[m]
    b = (place - knots[m]) / span
    a = 1 - b
    for k in range(3):
        position[k] = (
            a * chain[m, k]
            + b * chain[m + 1, k]
            + ((a**3 - a) * second[m, k] + (b**3 - b) * second[m + 1, k]) * span * span / 6
        )
        slope[k] = (chain[m + 1, k] - chain[m, k]) / span + (
            (3 * b * b - 1) * second[m + 1, k] - (3 * a * a - 1) * second[m, k]
        ) * span / 6


@njit(cache=True, nogil=True)
def _waypoint_frames(tangents: Any, frames: Any) -> None:
    count = len(tangents)
    ruled = np.empty(count, np.bool_)
    first_ruled = -1
    for i in range(count):
        x, y = tangents[i, 0], tangents[i, 1]
        size = np.sqrt(x * x + y * y)
        ruled[i] = size >= _STEEP
        frames[i, :, 0] = tangents[i]
        if ruled[i]:
            frames[i, 0, 1], frames[i, 1, 1], frames[i, 2, 1] = y / size, -x / size, 0.0
            if first_ruled < 0:
                first_ruled = i
    if first_ruled < 0:
        # The whole rope points at the camera: start from the image's x axis.
        first_ruled = 0
        x = tangents[0, 0]
        size = np.sqrt(1 - x * x)
        for k in range(3):
            frames[0, k, 1] = ((1.0 if k == 0 else 0.0) - x * tangents[0, k]) / size
    for i in range(first_ruled - 1, -1, -1):
        _transport(frames, i + 1, i)
    last_ruled = first_ruled
    for i in range(first_ruled + 1, count):
        if ruled[i]:
            if i > last_ruled + 1:
                _spread_twist(frames, last_ruled, i)
            last_ruled = i
        else:
            _transport(frames, i - 1, i)
    for i in range(count):
        for k in range(3):
            j, m = (k + 1) % 3, (k + 2) % 3
            frames[i, k, 2] = frames[i, j, 0] * frames[i, m, 1] - frames[i, m, 0] * frames[i, j, 1]


@njit(cache=True, nogil=True)
def _transport(frames: Any, source: int, target: int) -> None:
    """Carry the Y axis to the next X axis by the smallest rotation between the two X axes."""
    cosine = along = 0.0
    for k in range(3):
        cosine += frames[source, k, 0] * frames[target, k, 0]
        along += frames[source, k, 1] * frames[target, k, 0]
    size = overlap = 0.0
    for k in range(3):
        moved = frames[source, k, 1] - along / max(1 + cosine, 1e-9) * (frames[source, k, 0] + frames[target, k, 0])
        frames[target, k, 1] = moved
        overlap += moved * frames[target, k, 0]
    for k in range(3):
        frames[target, k, 1] -= overlap * frames[target, k, 0]
        size += frames[target, k, 1] ** 2
    for k in range(3):
        frames[target, k, 1] /= np.sqrt(size)


@njit(cache=True, nogil=True)
def _spread_twist(frames: Any, first: int, last: int) -> None:
    """Turn the carried Y axes between two that the rule gives, so that they lead from the one to the other."""
    given = frames[last, :, 1].copy()
    _transport(frames, last - 1, last)
    cosine = sine = 0.0
    for k in range(3):
        j, m = (k + 1) % 3, (k + 2) % 3
        cosine += frames[last, k, 1] * given[k]
        sine += (frames[last, j, 1] * given[m] - frames[last, m, 1] * given[j]) * frames[last, k, 0]
    twist = np.arctan2(sine, cosine)
    frames[last, :, 1] = given
    side = np.empty(3)
    for i in range(first + 1, last):
        angle = twist * (i - first) / (last - first)
        for k in range(3):
            j, m = (k + 1) % 3, (k + 2) % 3
            across = frames[i, j, 0] * frames[i, m, 1] - frames[i, m, 0] * frames[i, j, 1]
            side[k] = np.cos(angle) * frames[i, k, 1] + np.sin(angle) * across
        frames[i, :, 1] = side


@njit(cache=True, nogil=True)
def _quaternions(frames: Any, reference: Any, quaternions: Any) -> None:
    """Unit quaternions xyzw of rotation matrices, each on the side of the one before (Shepperd's method)."""
    for i in range(len(frames)):
        r, q = frames[i], quaternions[i]
        trace = r[0, 0] + r[1, 1] + r[2, 2]
        largest = 3
        most = trace
        for k in range(3):
            if r[k, k] > most:
                largest, most = k, r[k, k]
        if largest == 3:
            q[0], q[1], q[2] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
            q[3] = 1 + trace
        else:
            a, b, c = largest, (largest + 1) % 3, (largest + 2) % 3
            q[a] = 1 - trace + 2 * r[a, a]
            q[b] = r[b, a] + r[a, b]
            q[c] = r[c, a] + r[a, c]
            q[3] = r[c, b] - r[b, c]
        before = reference if i == 0 else quaternions[i - 1]
        size = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
        if q[0] * before[0] + q[1] * before[1] + q[2] * before[2] + q[3] * before[3] < 0:
            size = -size
        for k in range(4):
            q[k] /= size
