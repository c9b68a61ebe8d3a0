"""The order of the nodes along the rope (section 4.2, equations 12-14).

`order_path` treats the rope as an open chain through the nodes and looks for the cheapest: length costs, gaps between
slices cost more, and sharp turns cost, so that a hairpin, a crossing and a coil keep their order. `order_greedy` is the
paper's rule.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ropetrace.types import FloatArray

GAP_COST = 3.0
"""Cost of free space between two slices, relative to length."""

TURN_COST = 1.5
"""Cost of a right angle at a node, in typical distances between neighbours."""

_EASY = 2.0
"""A joint between neighbours that costs less than this is not worth undoing."""

_LONGEST_MOVE = 3
"""Nodes that the search moves together."""

Indices = NDArray[np.int64]


def order_path(centroids: FloatArray, covariances: FloatArray) -> Indices:
    """The open chain of least cost through all nodes.

    The cost of an edge is its length plus `GAP_COST` times the free space in it, in units of the median distance to
    the nearest node; a slice fills sqrt(3) of its standard deviation to each side, as an even spread of points does.
    A turn by t costs `TURN_COST` (1 - cos t)^2. The search starts from the cheapest edges, as Kruskal's algorithm
    picks them, and exchanges edges and moves nodes (2-opt and or-opt) until nothing is gained.

    Parameters
    ----------
    centroids : (M, 3) float array
        Metres.
    covariances : (M, 3, 3) float array
        Covariance of each slice's points, m^2.

    Returns
    -------
    (M,) int array
        Indices of the nodes along the rope, from either end.
    """
    count = len(centroids)
    if count < 3:
        return np.arange(count)
    costs, directions = edge_costs(centroids, covariances)
    path = np.empty(count, np.int64)
    _link(costs, path)
    _improve(costs, directions, path)
    return path


def edge_costs(centroids: FloatArray, covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cost of joining each two nodes, (M, M), and the unit vectors between them, (M, M, 3)."""
    count = len(centroids)
    costs = np.empty((count, count))
    directions = np.empty((count, count, 3))
    _edges(np.ascontiguousarray(centroids), np.ascontiguousarray(covariances), costs, directions)
    return costs, directions


def free_space(centroids: FloatArray, covariances: FloatArray) -> FloatArray:
    """The free space between neighbours of a chain: their distance less what their slices fill, at least 0.

    Parameters
    ----------
    centroids : (M, 3) float array
        In order, metres.
    covariances : (M, 3, 3) float array
        m^2.

    Returns
    -------
    (M - 1,) float array
        Metres.
    """
    steps = np.diff(centroids, axis=0)
    sizes = np.linalg.norm(steps, axis=1)
    units = steps / np.maximum(sizes, 1e-12)[:, None]
    before = np.sqrt(np.maximum(3 * np.einsum("mi,mij,mj->m", units, covariances[:-1], units), 0))
    after = np.sqrt(np.maximum(3 * np.einsum("mi,mij,mj->m", units, covariances[1:], units), 0))
    return np.maximum(sizes - before - after, 0)


def order_greedy(centroids: FloatArray, start: int) -> Indices:
    """The paper's rule: the node closest to the start (equation 13), then each time the closest straight on.

    Equation 14 is read as its text says: maximise -ln(distance) plus the dot product of the two directions. As printed
    that product is in m^2 and has no effect at a rope's scale; both directions are made unit vectors, so that it is
    the cosine of the turn and one weight serves every rope.

    Parameters
    ----------
    centroids : (M, 3) float array
        Metres.
    start : int
        Index of the first node (equation 12: `end_scores`).

    Returns
    -------
    (M,) int array
    """
    count = len(centroids)
    path = [start]
    left = np.ones(count, bool)
    left[start] = False
    heading = np.zeros(3)
    while len(path) < count:
        steps = centroids - centroids[path[-1]]
        sizes = np.maximum(np.linalg.norm(steps, axis=1), 1e-12)
        scores = -np.log(sizes) + steps @ heading / sizes
        scores[~left] = -np.inf
        chosen = int(np.argmax(scores))
        heading = steps[chosen] / sizes[chosen]
        left[chosen] = False
        path.append(chosen)
    return np.array(path, np.int64)


def end_scores(centroids: FloatArray, first_point: tuple[float, float, float] | None = None) -> FloatArray:
    """How well each node serves as the first (equation 12).

    Parameters
    ----------
    centroids : (M, 3) float array
        Metres, camera frame.
    first_point : (x, y, z), optional
        Prefer nodes close to this point, metres. By default nodes towards the top of the image are preferred.

    Returns
    -------
    (M,) float array
        Metres; the largest is the start.
    """
    spread = np.linalg.norm(centroids[:, None] - centroids[None], axis=2).sum(axis=1)
    if first_point is None:
        return np.asarray(spread - centroids[:, 1])
    return np.asarray(spread - np.linalg.norm(centroids - np.array(first_point), axis=1))


def runs_backwards(chain: FloatArray, previous: FloatArray) -> bool:
    """Whether a chain runs from the previous chain's end to its start.

    The whole curves decide, sampled at equal parts of their length, not their ends alone: ends are where a rope moves
    fastest.

    Parameters
    ----------
    chain, previous : (M, 3) and (K, 3) float arrays
        Nodes in order, metres.
    """
    here, before = _sampled(chain), _sampled(previous)
    forwards = np.linalg.norm(here - before, axis=1).sum()
    backwards = np.linalg.norm(here[::-1] - before, axis=1).sum()
    return bool(backwards < forwards)


def _sampled(chain: FloatArray, count: int = 9) -> FloatArray:
    """Points at equal parts of a polyline's length."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(chain, axis=0), axis=1))])
    places = np.linspace(0, length[-1], count)
    return np.stack([np.interp(places, length, chain[:, axis]) for axis in range(3)], axis=1)


@njit(cache=True, nogil=True)
def _edges(centroids: Any, covariances: Any, costs: Any, directions: Any) -> None:
    count = len(centroids)
    nearest = np.full(count, np.inf)
    gaps = np.zeros((count, count))
    unit = np.empty(3)
    for i in range(count):
        costs[i, i] = np.inf
        directions[i, i] = 0.0
        for j in range(i):
            size = 0.0
            for k in range(3):
                unit[k] = centroids[j, k] - centroids[i, k]
                size += unit[k] * unit[k]
            size = np.sqrt(size)
            for k in range(3):
                unit[k] = unit[k] / size if size > 0 else 0.0
                directions[i, j, k] = unit[k]
                directions[j, i, k] = -unit[k]
            spread_i = spread_j = 0.0
            for k in range(3):
                for m in range(3):
                    spread_i += unit[k] * covariances[i, k, m] * unit[m]
                    spread_j += unit[k] * covariances[j, k, m] * unit[m]
            costs[i, j] = size
            gaps[i, j] = max(0.0, size - np.sqrt(max(3 * spread_i, 0.0)) - np.sqrt(max(3 * spread_j, 0.0)))
            nearest[i] = min(nearest[i], size)
            nearest[j] = min(nearest[j], size)
    scale = max(np.median(nearest), 1e-9)
    for i in range(count):
        for j in range(i):
            costs[i, j] = (costs[i, j] + GAP_COST * gaps[i, j]) / scale
            costs[j, i] = costs[i, j]


@njit(cache=True, nogil=True)
def _link(costs: Any, path: Any) -> None:
    """Join the nodes by the cheapest edges that leave an open chain."""
    count = len(path)
    pairs = count * (count - 1) // 2
    edge_cost = np.empty(pairs)
    edge_from = np.empty(pairs, np.int32)
    edge_to = np.empty(pairs, np.int32)
    at = 0
    for i in range(count):
        for j in range(i):
            edge_cost[at], edge_from[at], edge_to[at] = costs[i, j], i, j
            at += 1
    neighbours = np.full((count, 2), -1, np.int64)
    piece = np.arange(count)
    joined = 0
    for edge in np.argsort(edge_cost):
        i, j = edge_from[edge], edge_to[edge]
        if neighbours[i, 1] >= 0 or neighbours[j, 1] >= 0 or piece[i] == piece[j]:
            continue
        neighbours[i, 0 if neighbours[i, 0] < 0 else 1] = j
        neighbours[j, 0 if neighbours[j, 0] < 0 else 1] = i
        old, new = piece[j], piece[i]
        for k in range(count):
            if piece[k] == old:
                piece[k] = new
        joined += 1
        if joined == count - 1:
            break
    here = 0
    while neighbours[here, 1] >= 0:
        here += 1
    before = -1
    for at in range(count):
        path[at] = here
        after = neighbours[here, 0] if neighbours[here, 0] != before else neighbours[here, 1]
        before, here = here, after


@njit(cache=True, nogil=True)
def _turn(directions: Any, i: int, j: int, k: int) -> float:
    """Cost of the turn at node j on the way from i to k; none at the ends of the chain."""
    if i < 0 or k < 0:
        return 0.0
    cosine = 0.0
    for axis in range(3):
        cosine += directions[i, j, axis] * directions[j, k, axis]
    return TURN_COST * (1 - cosine) ** 2


@njit(cache=True, nogil=True)
def _joint(costs: Any, directions: Any, i: int, j: int, k: int, m: int) -> float:
    """Cost of the edge from j to k and of the turns at both its ends; i and m are the nodes beyond."""
    if j < 0 or k < 0:
        return 0.0
    return costs[j, k] + _turn(directions, i, j, k) + _turn(directions, j, k, m)


@njit(cache=True, nogil=True)
def _at(path: Any, index: int) -> int:
    return path[index] if 0 <= index < len(path) else -1


@njit(cache=True, nogil=True)
def _string(costs: Any, directions: Any, nodes: Any, count: int) -> float:
    """Cost of a stretch of chain: its edges and the turns at its inner nodes. -1 marks what lies beyond the ends."""
    total = 0.0
    for index in range(count - 1):
        if nodes[index] >= 0 and nodes[index + 1] >= 0:
            total += costs[nodes[index], nodes[index + 1]]
            if index > 0:
                total += _turn(directions, nodes[index - 1], nodes[index], nodes[index + 1])
    return total


@njit(cache=True, nogil=True)
def _improve(costs: Any, directions: Any, path: Any) -> None:
    for _ in range(4 * len(path)):
        if not (_exchange(costs, directions, path) or _move(costs, directions, path)):
            break


@njit(cache=True, nogil=True)
def _exchange(costs: Any, directions: Any, path: Any) -> bool:
    """Turn round the stretch of chain that gains most (2-opt); False if none gains."""
    count = len(path)
    joints = np.zeros(count + 1)
    for at in range(1, count):
        joints[at] = _joint(
            costs, directions, _at(path, at - 2), path[at - 1], path[at], _at(path, at + 1)
        )
    best, best_first, best_last = -1e-9, -1, -1
    for first in range(count - 1):
        for last in range(first + 1, count):
            before = joints[first] + joints[last + 1]
            if before < _EASY or (joints[first] < _EASY and joints[last + 1] < _EASY):
                continue
            gain = (
                _joint(
                    costs, directions, _at(path, first - 2), _at(path, first - 1), path[last], path[last - 1]
                )
                + _joint(
                    costs, directions, path[first + 1], path[first], _at(path, last + 1), _at(path, last + 2)
                )
                - before
            )
            if gain < best:
                best, best_first, best_last = gain, first, last
    if best_first < 0:
        return False
    path[best_first : best_last + 1] = path[best_first : best_last + 1][::-1].copy()
    return True


@njit(cache=True, nogil=True)
def _move(costs: Any, directions: Any, path: Any) -> bool:
    """Put a few nodes elsewhere in the chain, either way round, where that gains most (or-opt); False if none gains."""
    count = len(path)
    nodes = np.empty(_LONGEST_MOVE + 4, np.int64)
    best, best_first, best_size, best_place, best_turned = -1e-9, -1, 0, 0, False
    for size in range(1, min(_LONGEST_MOVE, count - 2) + 1):
        for first in range(count - size + 1):
            for k in range(size + 4):
                nodes[k] = _at(path, first - 2 + k)
            removed = _string(costs, directions, nodes, size + 4)
            if removed < _EASY * (size + 3):
                continue
            nodes[2], nodes[3] = _at(path, first + size), _at(path, first + size + 1)
            removed -= _string(costs, directions, nodes, 4)
            if removed < _EASY:
                continue
            for place in range(count - size + 1):
                if place == first:
                    continue
                for k in range(4):
                    index = place - 2 + k
                    nodes[k] = _at(path, index if index < first else index + size) if index >= 0 else -1
                closed = _string(costs, directions, nodes, 4)
                behind, beyond = nodes[2], nodes[3]
                nodes[size + 2], nodes[size + 3] = behind, beyond
                for turned in (False, True):
                    for k in range(size):
                        nodes[2 + k] = path[first + (size - 1 - k if turned else k)]
                    gain = _string(costs, directions, nodes, size + 4) - closed - removed
                    if gain < best:
                        best, best_first, best_size, best_place, best_turned = gain, first, size, place, turned
    if best_first < 0:
        return False
    piece = path[best_first : best_first + best_size].copy()
    if best_turned:
        piece = piece[::-1].copy()
    rest = np.concatenate((path[:best_first], path[best_first + best_size :]))
    path[:best_place] = rest[:best_place]
    path[best_place : best_place + best_size] = piece
    path[best_place + best_size :] = rest[best_place:]
    return True
