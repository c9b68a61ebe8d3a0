"""Distances between an estimated centerline and the true curve, frame by frame. `sequences` sums them up over a run.

Both are polylines in the same frame of coordinates. The one-way distance from waypoint to truth, which the paper
reports (`paper_errors`), rewards a tracker that finds only a part of the rope: `symmetric_mean` and `coverage` do not.
Neither of those sees a rope that is followed in the wrong order or doubled back: `discrete_frechet`, `node_errors` and
`length_error` do.

An estimate of fewer than two vertices is no curve: its error is NaN, which `sequences.ErrorStatistics` counts as a
failure, and its coverage is 0. A truth that is no curve, and coordinates that are not finite, raise ValueError.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ropetrace.types import FloatArray

_TIE = 1e-12
"""Distances that differ by less are equal, metres: at a joint, two links are equally near but for the round-off."""


class Projections(NamedTuple):
    """Where points land on a polyline.

    Parameters
    ----------
    segments : (N,) int64 array
        Segment k runs from vertex k to vertex k + 1.
    fractions : (N,) float array
        Place on the segment, 0 at its first vertex to 1 at its second.
    distances : (N,) float array
        From the point to that place, metres.
    """

    segments: NDArray[np.int64]
    fractions: FloatArray
    distances: FloatArray


def projections(points: FloatArray, polyline: FloatArray) -> Projections:
    """The nearest place on a polyline to each point.

    On the segment from a to b, that is a + t (b - a) with t = <p - a, b - a> / |b - a|^2, cut to [0, 1]. Where segments
    are equally near (within 1e-12 m), as at a joint, the first is taken. A segment without length is passed over.

    Parameters
    ----------
    points : (N, 3) float array
        Metres.
    polyline : (K, 3) float array
        Vertices, K >= 2, metres.

    Raises
    ------
    ValueError
        If the polyline has fewer than two vertices, or a coordinate is not finite.
    """
    points, polyline = _checked(points, "points", 0), _checked(polyline, "polyline", 2)
    found = Projections(np.zeros(len(points), np.int64), np.zeros(len(points)), np.empty(len(points)))
    _project(points, polyline, *found)
    return found


def distances_to_curve(points: FloatArray, curve: FloatArray) -> FloatArray:
    """Distance of each point to the nearest place on a polyline.

    Parameters
    ----------
    points : (N, 3) float array
        Metres.
    curve : (K, 3) float array
        Vertices, K >= 2, metres.

    Returns
    -------
    (N,) float array
        Metres.
    """
    return projections(points, curve).distances


def curve_length(curve: FloatArray) -> float:
    """Sum of a polyline's segments, metres."""
    return float(np.linalg.norm(np.diff(curve, axis=0), axis=1).sum())


def at_equal_arc_length(curve: FloatArray, count: int) -> FloatArray:
    """Points at equal parts of a polyline's length: c(s_k), s_k = k / (count - 1).

    Parameters
    ----------
    curve : (K, 3) float array
        Vertices, metres.
    count : int
        Points, first and last vertex included.

    Returns
    -------
    (count, 3) float array
        Metres.
    """
    curve = _checked(curve, "curve", 1)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    places = np.linspace(0, length[-1], count)
    return np.stack([np.interp(places, length, curve[:, axis]) for axis in range(3)], axis=1)


def resample(curve: FloatArray, spacing: float) -> FloatArray:
    """Points along a polyline at equal arc length.

    Parameters
    ----------
    curve : (K, 3) float array
        Vertices, metres.
    spacing : float
        Wanted distance, metres; the nearest that divides the length evenly is used.

    Returns
    -------
    (N, 3) float array
        First and last vertex included.
    """
    curve = _checked(curve, "curve", 1)
    return at_equal_arc_length(curve, max(round(curve_length(curve) / spacing), 1) + 1)


# --- distances between two curves ---
# Throughout: `estimate`, T, and `truth`, G, are (K, 3) vertices in metres; `spacing` is the arc length at which both
# are sampled, metres; d(p, C) is the distance of a point to the nearest place on a curve.


def one_way_mean(estimate: FloatArray, truth: FloatArray, spacing: float = 0.001) -> float:
    """Mean distance from the estimate to the truth: mean_i d(T_i, G), metres. Blind to what the estimate misses."""
    if len(estimate) < 2:
        return math.nan
    return float(distances_to_curve(resample(estimate, spacing), truth).mean())


def symmetric_mean(estimate: FloatArray, truth: FloatArray, spacing: float = 0.001) -> float:
    """Half the sum of the mean distances of each curve to the other: (mean d(T, G) + mean d(G, T)) / 2, metres.

    Parameters
    ----------
    estimate, truth : (K, 3) float array
        Vertices, metres.
    spacing : float
        Both curves are sampled at this arc length, metres.
    """
    if len(estimate) < 2:
        return math.nan
    return (one_way_mean(estimate, truth, spacing) + one_way_mean(truth, estimate, spacing)) / 2


def hausdorff(estimate: FloatArray, truth: FloatArray, percentile: float = 100.0, spacing: float = 0.001) -> float:
    """The worst place of both curves: max(max_i d(T_i, G), max_j d(G_j, T)), metres, low by at most half the spacing.

    Parameters
    ----------
    estimate, truth : (K, 3) float array
        Vertices, metres.
    percentile : float
        Instead of each of the two inner maxima, this percentile, 0 to 100: 95 gives the 95 % Hausdorff distance.
    spacing : float
        Both curves are sampled at this arc length, metres.
    """
    if len(estimate) < 2:
        return math.nan
    there = distances_to_curve(resample(estimate, spacing), truth)
    back = distances_to_curve(resample(truth, spacing), estimate)
    return float(max(np.percentile(there, percentile), np.percentile(back, percentile)))


def discrete_frechet(estimate: FloatArray, truth: FloatArray, spacing: float = 0.001) -> float:
    """The shortest leash for two walkers that go along the curves from start to end and never back, metres.

    F(i, j) = max(|T_i - G_j|, min(F(i-1, j), F(i, j-1), F(i-1, j-1))) at the last samples of both: high by at most the
    spacing. The direction counts: see `is_reversed`. Its time grows as the product of both numbers of samples.

    Parameters
    ----------
    estimate, truth : (K, 3) float array
        Vertices, metres.
    spacing : float
        Both curves are sampled at this arc length, metres.
    """
    if len(estimate) < 2:
        return math.nan
    return float(_frechet(resample(estimate, spacing), resample(_checked(truth, "truth", 2), spacing)))


def node_errors(estimate: FloatArray, truth: FloatArray, count: int = 101) -> FloatArray:
    """Distance at equal arc length in the direction as given: |T(s_k) - G(s_k)|, s_k = k / (count - 1).

    Parameters
    ----------
    estimate, truth : (K, 3) float array
        Vertices, metres.
    count : int
        Places that are compared.

    Returns
    -------
    (count,) float array
        Metres. Their mean and max are the node error; the first and the last are the tip errors.
    """
    truth = at_equal_arc_length(_checked(truth, "truth", 2), count)
    if len(estimate) < 2:
        return np.full(count, math.nan)
    return np.asarray(np.linalg.norm(at_equal_arc_length(estimate, count) - truth, axis=1))


def is_reversed(estimate: FloatArray, truth: FloatArray, count: int = 101) -> bool | None:
    """Whether the estimate runs from the true end to the true start: its mean node error is less when it is reversed.

    The whole curve is asked, not the ends alone, which may lie side by side. A rope that is folded in two and of which
    only one leg is found fits either way: there the answer is chance.

    Returns
    -------
    bool or None
        None where there is no estimate.
    """
    if len(estimate) < 2:
        return None
    return bool(node_errors(estimate[::-1], truth, count).mean() < node_errors(estimate, truth, count).mean())


def coverage(estimate: FloatArray, truth: FloatArray, threshold: float, spacing: float = 0.001) -> float:
    """The share of the true curve's length that lies within the threshold of the estimate, 0 to 1.

    Parameters
    ----------
    estimate, truth : (K, 3) float array
        Vertices, metres.
    threshold, spacing : float
        Metres.
    """
    if len(estimate) < 2:
        return 0.0
    return float((distances_to_curve(resample(_checked(truth, "truth", 2), spacing), estimate) <= threshold).mean())


def tip_errors(estimate: FloatArray, truth: FloatArray) -> tuple[float, float]:
    """Distance of the starts, |T(0) - G(0)|, and of the ends, |T(1) - G(1)|, in the direction as given, metres."""
    start, end = node_errors(estimate, truth, 2)
    return float(start), float(end)


def length_error(estimate: FloatArray, truth: FloatArray) -> float:
    """Relative and signed: (L_T - L_G) / L_G. Below 0 is too short: -0.1 is a tenth missing."""
    length = curve_length(_checked(truth, "truth", 2))
    if length == 0:
        raise ValueError("the truth has no length")
    return curve_length(_checked(estimate, "estimate", 2)) / length - 1 if len(estimate) >= 2 else math.nan


def tangent_error(estimate: FloatArray, truth: FloatArray, spacing: float = 0.001) -> float:
    """Mean angle between the estimate and the true segment that is nearest: mean_i arccos |<t_i, g_i>|, rad, 0 to pi/2.

    t_i is the direction between two neighbouring samples of the estimate, and g_i that of the segment of the truth on
    which their middle's projection lies. Blind to the sense of direction and to the twist.
    """
    if len(estimate) < 2:
        return math.nan
    samples = resample(estimate, spacing)
    nearest = projections((samples[1:] + samples[:-1]) / 2, truth).segments
    return float(_angles(np.diff(samples, axis=0), np.diff(truth, axis=0)[nearest], either_way=True).mean())


def kinks(nodes: FloatArray, limit: float = np.pi / 3) -> int:
    """How many times a chain of nodes turns by more than the limit, by default 60 degrees.

    Parameters
    ----------
    nodes : (M, 3) float array
        In order along the rope, metres. A node that repeats the one before is passed over.
    limit : float
        Radians.
    """
    steps = np.diff(_checked(nodes, "nodes", 0), axis=0)
    steps = steps[np.linalg.norm(steps, axis=1) > 0]
    return int(np.count_nonzero(_angles(steps[:-1], steps[1:]) > limit))


def _angles(first: FloatArray, second: FloatArray, either_way: bool = False) -> FloatArray:
    """Angles between two rows of vectors, or between the lines along them, radians; sharp also where they are small."""
    along = np.sum(first * second, axis=1)
    across = np.linalg.norm(np.cross(first, second), axis=1)
    return np.asarray(np.arctan2(across, np.abs(along) if either_way else along))


def _checked(points: FloatArray, name: str, least: int) -> FloatArray:
    array = np.ascontiguousarray(points, dtype=float)
    if array.ndim != 2 or array.shape[1] != 3 or len(array) < least:
        raise ValueError(f"{name}: shape {array.shape}, expected (N, 3) with N >= {least}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: a coordinate is not a finite number")
    return array


@njit(cache=True, nogil=True)
def _project(points: Any, polyline: Any, segments: Any, fractions: Any, distances: Any) -> None:
    for index in range(len(points)):
        best = nearer = np.inf  # squared, as is `distance`; what is no nearer than `nearer` is a tie
        for vertex in range(len(polyline) - 1):
            along = size = 0.0
            for axis in range(3):
                step = polyline[vertex + 1, axis] - polyline[vertex, axis]
                along += step * (points[index, axis] - polyline[vertex, axis])
                size += step * step
            if size == 0.0:
                continue
            part = min(max(along / size, 0.0), 1.0)
            distance = 0.0
            for axis in range(3):
                step = polyline[vertex + 1, axis] - polyline[vertex, axis]
                distance += (points[index, axis] - polyline[vertex, axis] - part * step) ** 2
            if distance < nearer:
                best = distance
                nearer = max(np.sqrt(distance) - _TIE, 0.0) ** 2
                segments[index] = vertex
                fractions[index] = part
        if best == np.inf:  # a polyline without length
            best = 0.0
            for axis in range(3):
                best += (points[index, axis] - polyline[0, axis]) ** 2
        distances[index] = np.sqrt(best)


@njit(cache=True, nogil=True)
def _frechet(first: Any, second: Any) -> float:
    row = np.empty(len(second))  # F(i - 1, .), and F(i, .) up to j; squared
    for i in range(len(first)):
        diagonal = np.inf  # F(i - 1, j - 1)
        for j in range(len(second)):
            shortest = np.inf if i == 0 else min(row[j], diagonal)
            if j > 0:
                shortest = min(shortest, row[j - 1])
            if i == 0 and j == 0:
                shortest = 0.0
            distance = 0.0
            for axis in range(3):
                distance += (first[i, axis] - second[j, axis]) ** 2
            if i > 0:
                diagonal = row[j]
            row[j] = max(distance, shortest)
    return np.sqrt(row[-1])
