"""The linear and the angular error of the paper (section 6.2), exactly as it defines them.

Both look from the waypoints to the truth only, and so reward a tracker that finds only a part of the rope: report
`metrics.symmetric_mean`, the 95 % `metrics.hausdorff` and `metrics.coverage` beside them.
"""

from __future__ import annotations

import math

import numpy as np

from ropetrace.evaluation.metrics import distances_to_curve, projections
from ropetrace.types import FloatArray


def linear_errors(waypoints: FloatArray, polyline: FloatArray) -> FloatArray:
    """The paper's linear error of each waypoint: |w_i - projection of w_i onto the truth|.

    Parameters
    ----------
    waypoints : (W, 3) float array
        Metres.
    polyline : (K, 3) float array
        The truth: start, joints and end of the rope, metres.

    Returns
    -------
    (W,) float array
        Metres.
    """
    return distances_to_curve(waypoints, polyline)


def angular_errors(
    positions: FloatArray, quaternions: FloatArray, polyline: FloatArray, link_quaternions: FloatArray
) -> FloatArray:
    """The paper's angular error of each waypoint: arccos(2 <r_1, r_2>^2 - 1).

    r_1 is the waypoint's orientation and r_2 that of the link on which the waypoint's projection onto the truth lies
    (the first of two links at their joint). This is the whole angle between the two frames, twist about the rope
    included, so both must follow one convention: X along the rope from start to end, Y by the paper's rule. A rope that
    is tracked from the other end is wrong by up to pi. The quaternions are normalised first: a norm of 1 - 1e-6 would
    read as 3 mrad. The form resolves no angle below 3e-8 rad.

    Parameters
    ----------
    positions : (W, 3) float array
        Waypoints, metres.
    quaternions : (W, 4) float array
        Orientations of the waypoints, ``xyzw``, of either sign.
    polyline : (K, 3) float array
        The truth: start, joints and end of the rope, metres.
    link_quaternions : (K - 1, 4) float array
        Orientations of the links between them, ``xyzw``, of either sign.

    Returns
    -------
    (W,) float array
        Radians, 0 to pi.

    Raises
    ------
    ValueError
        If shapes do not fit, or a quaternion is zero or not finite.
    """
    ours, true = _unit_quaternions(quaternions, len(positions)), _unit_quaternions(link_quaternions, len(polyline) - 1)
    links = projections(positions, polyline).segments
    overlap = np.minimum(np.abs(np.sum(ours * true[links], axis=1)), 1.0)
    return np.asarray(np.arccos(2 * overlap**2 - 1))


def mean_linear_error(waypoints: FloatArray, polyline: FloatArray) -> float:
    """The paper's linear error of one reading: the mean of `linear_errors`, metres; NaN without waypoints."""
    return float(linear_errors(waypoints, polyline).mean()) if len(waypoints) else math.nan


def mean_angular_error(
    positions: FloatArray, quaternions: FloatArray, polyline: FloatArray, link_quaternions: FloatArray
) -> float:
    """The paper's angular error of one reading: the mean of `angular_errors`, radians; NaN without waypoints."""
    if not len(positions):
        return math.nan
    return float(angular_errors(positions, quaternions, polyline, link_quaternions).mean())


def _unit_quaternions(quaternions: FloatArray, count: int) -> FloatArray:
    array = np.asarray(quaternions, dtype=float)
    if array.shape != (count, 4):
        raise ValueError(f"quaternions: shape {array.shape}, expected ({count}, 4)")
    norms = np.linalg.norm(array, axis=1, keepdims=True)
    if not (np.isfinite(norms) & (norms > 0)).all():
        raise ValueError("quaternions: one is zero or not finite")
    return np.asarray(array / norms)
