"""From ordered nodes to waypoints: a spline by arc length, and a frame at each waypoint (section 4.2, equations 15-17)."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from ropetrace.types import FloatArray, Waypoints

_FINE_STEPS = 6
"""Pieces into which each span of the spline is divided to measure its length."""

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
    steps = np.diff(chain, axis=0)
    sizes = np.linalg.norm(steps, axis=1, keepdims=True)
    slopes = steps / sizes
    if len(chain) == 2:
        return np.repeat(slopes, 2, axis=0)
    before, after = sizes[:-1], sizes[1:]
    inner = (slopes[:-1] * after + slopes[1:] * before) / (before + after)
    tangents = np.concatenate([[2 * slopes[0] - inner[0]], inner, [2 * slopes[-1] - inner[-1]]])
    return np.asarray(tangents / np.linalg.norm(tangents, axis=1, keepdims=True))


def extend_to_tips(chain: FloatArray, tangents: FloatArray, reach: tuple[float, float]) -> FloatArray:
    """The chain with a point added at each end: end nodes are centroids, half a slice short of the rope's tips.

    Parameters
    ----------
    chain, tangents : (M, 3) float array
        Nodes and unit tangents.
    reach : (start, end)
        How far the rope goes on beyond its first and last node, metres.

    Returns
    -------
    (M + 2, 3) float array
    """
    return np.concatenate(
        [[chain[0] - reach[0] * tangents[0]], chain, [chain[-1] + reach[1] * tangents[-1]]]
    )


def sample_spline(chain: FloatArray, spacing: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A cubic spline through the chain, sampled at equal arc length.

    Parameters
    ----------
    chain : (M, 3) float array
        M >= 2, neighbours distinct, metres.
    spacing : float
        Wanted arc length between samples, metres; the nearest that divides the length evenly is used, so that the
        last sample is the last node.

    Returns
    -------
    positions : (W, 3) float array
        Metres.
    tangents : (W, 3) float array
        Unit vectors: the limit of equation 15 for close waypoints.
    arc_length : (W,) float array
        Metres from the first node.
    """
    knots = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(chain, axis=0), axis=1))])
    spline = CubicSpline(knots, chain, bc_type="natural")
    fine = np.interp(np.arange(_FINE_STEPS * (len(knots) - 1) + 1), np.arange(len(knots)) * _FINE_STEPS, knots)
    curve = spline(fine)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    count = max(int(round(length[-1] / spacing)), 1) + 1
    arc_length = np.linspace(0, length[-1], count)
    places = np.interp(arc_length, length, fine)
    tangents = spline(places, 1)
    return spline(places), tangents / np.linalg.norm(tangents, axis=1, keepdims=True), arc_length


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
    sides = np.stack([tangents[:, 1], -tangents[:, 0], np.zeros(len(tangents))], axis=1)
    sizes = np.hypot(tangents[:, 0], tangents[:, 1])
    ruled = sizes >= _STEEP
    if ruled.all():
        sides /= sizes[:, None]
    else:
        _carry(tangents, sides, sizes, ruled)
    return np.stack([tangents, sides, np.cross(tangents, sides)], axis=2)


def _carry(tangents: FloatArray, sides: FloatArray, sizes: FloatArray, ruled: np.ndarray) -> None:
    """Fill in the Y axes where the rule does not hold, in place."""
    sides[ruled] /= sizes[ruled, None]
    good = np.flatnonzero(ruled)
    if not len(good):
        # The whole rope points at the camera: start from the image's x axis.
        side = np.array([1.0, 0.0, 0.0]) - tangents[0, 0] * tangents[0]
        sides[0] = side / np.linalg.norm(side)
        good = np.array([0])
    for index in range(good[0] - 1, -1, -1):
        sides[index] = _transported(sides[index + 1], tangents[index + 1], tangents[index])
    for first, last in zip(good, [*good[1:], len(tangents)], strict=True):
        if last == first + 1:
            continue
        for index in range(first + 1, last):
            sides[index] = _transported(sides[index - 1], tangents[index - 1], tangents[index])
        if last == len(tangents):
            break
        arrived = _transported(sides[last - 1], tangents[last - 1], tangents[last])
        twist = np.arctan2(np.dot(np.cross(arrived, sides[last]), tangents[last]), np.dot(arrived, sides[last]))
        for index in range(first + 1, last):
            angle = twist * (index - first) / (last - first)
            sides[index] = np.cos(angle) * sides[index] + np.sin(angle) * np.cross(tangents[index], sides[index])


def _transported(side: FloatArray, before: FloatArray, after: FloatArray) -> FloatArray:
    """A vector across the rope, carried to the next tangent by the smallest rotation."""
    axis = np.cross(before, after)
    cosine = float(np.dot(before, after))
    moved = side + np.cross(axis, side) + np.cross(axis, np.cross(axis, side)) / max(1 + cosine, 1e-9)
    moved = moved - np.dot(moved, after) * after
    return np.asarray(moved / np.linalg.norm(moved))


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
    quaternions = np.asarray(Rotation.from_matrix(waypoint_frames(tangents)).as_quat())
    signs = np.where(np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0, -1.0, 1.0)
    quaternions[1:] *= np.cumprod(signs)[:, None]
    reference = previous.quaternions[0] if previous is not None and len(previous) else np.array([0.0, 0, 0, 1])
    if np.dot(quaternions[0], reference) < 0:
        quaternions = -quaternions
    return Waypoints(positions, quaternions, arc_length)
