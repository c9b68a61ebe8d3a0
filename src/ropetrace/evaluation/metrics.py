"""Distances between an estimated centreline and the true curve.

Both are polylines. The one-way distance from waypoint to truth, which the paper reports, rewards a tracker that finds
only a part of the rope: `symmetric_mean` and `coverage` do not.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ropetrace.types import FloatArray


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
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    places = np.linspace(0, length[-1], max(round(length[-1] / spacing), 1) + 1)
    return np.stack([np.interp(places, length, curve[:, axis]) for axis in range(3)], axis=1)


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
    result = np.empty(len(points))
    _distances(np.ascontiguousarray(points, dtype=float), np.ascontiguousarray(curve, dtype=float), result)
    return result


def symmetric_mean(estimate: FloatArray, truth: FloatArray, spacing: float = 0.001) -> float:
    """Half the sum of the mean distances of each curve to the other: (mean d(T, G) + mean d(G, T)) / 2, metres.

    Parameters
    ----------
    estimate, truth : (K, 3) float array
        Vertices, metres.
    spacing : float
        Both curves are sampled at this arc length, metres.
    """
    there = distances_to_curve(resample(estimate, spacing), truth).mean()
    back = distances_to_curve(resample(truth, spacing), estimate).mean()
    return float(there + back) / 2


def coverage(estimate: FloatArray, truth: FloatArray, threshold: float, spacing: float = 0.001) -> float:
    """The share of the true curve's length that lies within the threshold of the estimate, 0 to 1.

    Parameters
    ----------
    estimate, truth : (K, 3) float array
        Vertices, metres.
    threshold, spacing : float
        Metres.
    """
    return float((distances_to_curve(resample(truth, spacing), estimate) <= threshold).mean())


@njit(cache=True, nogil=True)
def _distances(points: Any, curve: Any, result: Any) -> None:
    for index in range(len(points)):
        best = np.inf
        for vertex in range(len(curve) - 1):
            along = size = 0.0
            for axis in range(3):
                step = curve[vertex + 1, axis] - curve[vertex, axis]
                along += step * (points[index, axis] - curve[vertex, axis])
                size += step * step
            part = min(max(along / size, 0.0), 1.0) if size > 0 else 0.0
            distance = 0.0
            for axis in range(3):
                step = curve[vertex + 1, axis] - curve[vertex, axis]
                distance += (points[index, axis] - curve[vertex, axis] - part * step) ** 2
            best = min(best, distance)
        result[index] = np.sqrt(best)
