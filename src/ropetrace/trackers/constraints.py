"""A rope that does not stretch and does not pass through itself: the nearest nodes that obey.

CDCPD2 hands min sum |y - z|^2 under its constraints to a commercial solver. All of them are convex, and each alone has
its nearest point in closed form; Dykstra's algorithm takes them in turn, each time giving back what the same constraint
took the last time, and tends to the nearest point of all (Boyle and Dykstra, 1986). No solver is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ropetrace.trackers.clouds import closest_places
from ropetrace.types import FloatArray

_TOLERANCE = 1e-6
"""It ends when no node moves by more than this in a round, metres."""

_MOST_ROUNDS = 3000


@dataclass(frozen=True, slots=True, eq=False)
class Strands:
    """Pairs of edges that were close, and where they were closest.

    Parameters
    ----------
    edges : (P, 2) int64 array
        Edge k runs from node k to node k + 1.
    places : (P, 2) float array
        Fractions of both edges, 0 to 1.
    directions : (P, 3) float array
        Unit vectors from the first edge to the second.
    """

    edges: NDArray[np.int64]
    places: FloatArray
    directions: FloatArray


def close_strands(nodes: FloatArray, within: float) -> Strands:
    """The pairs of edges closer than a distance, but for those less than twice that apart along the rope.

    Parameters
    ----------
    nodes : (M, 3) float array
        Along the rope, metres.
    within : float
        Metres.
    """
    edges, places, directions = _close_strands(np.ascontiguousarray(nodes), within)
    return Strands(edges, places, directions)


def nearest_feasible(
    nodes: FloatArray, longest: float, strands: Strands | None = None, clearance: float = 0.0
) -> FloatArray:
    """The nearest chain whose edges are no longer, and whose strands no closer, than they may be (Wang et al., 2021).

    The y of least sum |y_m - nodes_m|^2 under |y_m - y_(m+1)| <= longest and, for each pair of close strands with the
    direction v, (q_j - q_i) v >= clearance, with q on the edges where they were closest.

    Parameters
    ----------
    nodes : (M, 3) float array
        Metres.
    longest : float
        An edge's length at most, metres.
    strands : Strands, optional
        See `close_strands`.
    clearance : float
        Metres.

    Returns
    -------
    (M, 3) float array
        Metres; after `_MOST_ROUNDS` as near as it came, where the constraints contradict each other.
    """
    strands = Strands(np.empty((0, 2), np.int64), np.empty((0, 2)), np.empty((0, 3))) if strands is None else strands
    moved = np.array(nodes)
    _nearest_feasible(moved, longest, strands.edges, strands.places, strands.directions, clearance)
    return moved


@njit(cache=True, nogil=True)
def _nearest_feasible(y: Any, longest: float, edges: Any, places: Any, directions: Any, clearance: float) -> None:
    count = len(y)
    # What each constraint took the last time: of an edge, from its first node (its second node got the opposite); of a
    # pair of strands, in units of its direction and of how much each node takes part.
    pulled = np.zeros((count - 1, 3))
    pushed = np.zeros(len(edges))
    before = np.empty_like(y)
    for _ in range(_MOST_ROUNDS):
        before[:] = y
        for k in range(count - 1):
            square = 0.0
            for axis in range(3):
                y[k, axis] -= pulled[k, axis]
                y[k + 1, axis] += pulled[k, axis]
                square += (y[k + 1, axis] - y[k, axis]) ** 2
            size = np.sqrt(square)
            excess = 0.5 * (1 - longest / size) if size > longest else 0.0
            for axis in range(3):
                pulled[k, axis] = excess * (y[k + 1, axis] - y[k, axis])
            for axis in range(3):
                y[k, axis] += pulled[k, axis]
                y[k + 1, axis] -= pulled[k, axis]
        for p in range(len(edges)):
            i, j = edges[p, 0], edges[p, 1]
            s, t = places[p, 0], places[p, 1]
            apart = 0.0
            for axis in range(3):
                v = directions[p, axis]
                _push(y, i, j, s, t, axis, -pushed[p] * v)
                first = (1 - s) * y[i, axis] + s * y[i + 1, axis]
                second = (1 - t) * y[j, axis] + t * y[j + 1, axis]
                apart += (second - first) * v
            part = (1 - s) ** 2 + s**2 + (1 - t) ** 2 + t**2
            pushed[p] = max(clearance - apart, 0.0) / part
            for axis in range(3):
                _push(y, i, j, s, t, axis, pushed[p] * directions[p, axis])
        most = 0.0
        for k in range(count):
            for axis in range(3):
                most = max(most, abs(y[k, axis] - before[k, axis]))
        if most < _TOLERANCE:
            break


@njit(cache=True, nogil=True)
def _push(y: Any, i: int, j: int, s: float, t: float, axis: int, force: float) -> None:
    """Push two edges apart along an axis, their ends by as much as the places s and t are theirs."""
    y[i, axis] -= (1 - s) * force
    y[i + 1, axis] -= s * force
    y[j, axis] += (1 - t) * force
    y[j + 1, axis] += t * force


@njit(cache=True, nogil=True)
def _close_strands(nodes: Any, within: float) -> Any:
    count = len(nodes)
    arc = np.zeros(count)
    for m in range(1, count):
        arc[m] = arc[m - 1] + np.sqrt(np.sum((nodes[m] - nodes[m - 1]) ** 2))
    pairs = [(0, 0, 0.0, 0.0) for _ in range(0)]
    for i in range(count - 1):
        for j in range(i + 2, count - 1):
            if arc[j] - arc[i + 1] < 2 * within:
                continue
            middle = 0.0
            for axis in range(3):
                middle += (nodes[i, axis] + nodes[i + 1, axis] - nodes[j, axis] - nodes[j + 1, axis]) ** 2 / 4
            if np.sqrt(middle) > within + (arc[i + 1] - arc[i] + arc[j + 1] - arc[j]) / 2:
                continue
            s, t, distance = closest_places(nodes[i], nodes[i + 1], nodes[j], nodes[j + 1])
            if 1e-9 < distance < within:
                pairs.append((i, j, s, t))
    edges, places = np.empty((len(pairs), 2), np.int64), np.empty((len(pairs), 2))
    directions = np.empty((len(pairs), 3))
    for p in range(len(pairs)):
        i, j, s, t = pairs[p]
        edges[p, 0], edges[p, 1], places[p, 0], places[p, 1] = i, j, s, t
        size = 0.0
        for axis in range(3):
            gap = (1 - t) * nodes[j, axis] + t * nodes[j + 1, axis] - (1 - s) * nodes[i, axis] - s * nodes[i + 1, axis]
            directions[p, axis] = gap
            size += gap * gap
        for axis in range(3):
            directions[p, axis] /= np.sqrt(size)
    return edges, places, directions
