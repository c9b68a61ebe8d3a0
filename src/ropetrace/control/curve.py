"""The rope as a polyline by arc length: places on it, its direction, and what lies at them. Kernels.

`positions` are (W, 3), W >= 2, metres; `arcs` (W,) their arc lengths; a place is an arc length.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

HALF_CHORD = 0.015
"""The rope's direction is that of a chord this far to either side, metres: a waypoint's spacing has too much noise."""


@njit(cache=True, nogil=True, error_model="numpy")
def apart(one: Any, other: Any) -> float:
    """The distance between two points."""
    total = 0.0
    for k in range(3):
        total += (one[k] - other[k]) ** 2
    return np.sqrt(total)


@njit(cache=True, nogil=True, error_model="numpy")
def arc_lengths(positions: Any) -> Any:
    """Arc lengths of the waypoints, (W,)."""
    arcs = np.zeros(len(positions))
    for n in range(1, len(positions)):
        arcs[n] = arcs[n - 1] + apart(positions[n], positions[n - 1])
    return arcs


@njit(cache=True, nogil=True, error_model="numpy")
def _segment(arcs: Any, place: float) -> int:
    return min(max(int(np.searchsorted(arcs, place)) - 1, 0), len(arcs) - 2)


@njit(cache=True, nogil=True, error_model="numpy")
def at_arc(values: Any, arcs: Any, place: float, out: Any) -> None:
    """Linear interpolation along the arc length, held beyond the ends."""
    segment = _segment(arcs, place)
    part = (place - arcs[segment]) / max(arcs[segment + 1] - arcs[segment], 1e-12)
    part = min(max(part, 0.0), 1.0)
    for k in range(3):
        out[k] = values[segment, k] + part * (values[segment + 1, k] - values[segment, k])


@njit(cache=True, nogil=True, error_model="numpy")
def _on_segment(positions: Any, n: int, tool: Any) -> tuple[float, float]:
    """The point of a segment that is closest to the tool: 0 to 1 along it, and its squared distance."""
    size = along = away = 0.0
    for k in range(3):
        step = positions[n + 1, k] - positions[n, k]
        size += step * step
        along += step * (tool[k] - positions[n, k])
    part = min(max(along / size, 0.0), 1.0) if size > 1e-18 else 0.0
    for k in range(3):
        away += (positions[n, k] + part * (positions[n + 1, k] - positions[n, k]) - tool[k]) ** 2
    return part, away


@njit(cache=True, nogil=True, error_model="numpy")
def closest_place(positions: Any, arcs: Any, tool: Any, start: float) -> tuple[float, float]:
    """Arc length and distance of the place closest to the tool that is reached from a start while getting closer."""
    first = _segment(arcs, start)
    part, begin = _on_segment(positions, first, tool)
    best, where = begin, arcs[first] + part * (arcs[first + 1] - arcs[first])
    for step in (1, -1):
        n, least = first + step, begin
        while 0 <= n < len(positions) - 1:
            part, away = _on_segment(positions, n, tool)
            # What is added is rounding, where two segments meet.
            if not away <= least + 1e-15:
                break
            least = away
            if away < best:
                best, where = away, arcs[n] + part * (arcs[n + 1] - arcs[n])
            n += step
    return where, np.sqrt(best)


@njit(cache=True, nogil=True, error_model="numpy")
def chord(positions: Any, arcs: Any, place: float, out: Any) -> float:
    """The rope's direction at a place, not normalised; the arc length that it spans."""
    before, after = max(place - HALF_CHORD, 0.0), min(place + HALF_CHORD, arcs[-1])
    here = np.empty(3)
    at_arc(positions, arcs, before, here)
    at_arc(positions, arcs, after, out)
    for k in range(3):
        out[k] -= here[k]
    return after - before


@njit(cache=True, nogil=True, error_model="numpy")
def place_at_distance(positions: Any, arcs: Any, place: float, tool: Any, distance: float) -> float:
    """Arc length of the first point ahead of the place that is this far from the tool; the end if none is.

    Equation 20 with waypoints that lie as close as one likes: the tool does not jerk from waypoint to waypoint.
    """
    for n in range(1, len(positions)):
        if arcs[n] < place or apart(positions[n], tool) < distance:
            continue
        low, high = max(arcs[n - 1], place), arcs[n]
        here = np.empty(3)
        for _ in range(20):
            middle = 0.5 * (low + high)
            at_arc(positions, arcs, middle, here)
            if apart(here, tool) < distance:
                low = middle
            else:
                high = middle
        return high
    return arcs[-1]
