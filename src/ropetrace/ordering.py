"""The order of the nodes along the rope (section 4.2, equations 12-14).

`order_path` treats the rope as an open chain through the nodes and looks for the cheapest: length costs, gaps between
slices cost more, and sharp turns cost, so that a hairpin, a crossing and a coil keep their order. `order_greedy` is the
paper's rule.
"""

from __future__ import annotations

from dataclasses import dataclass
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

_TOUCH = 0.2
"""Slices touch where less than this part of their distance is free space."""

_LONGEST_MOVE = 3
"""Nodes that the search moves together."""

SEARCH_BUDGET = 250_000
"""Changes of the order that are looked at in one frame, at most: some ten milliseconds."""

_MOST_PIECES = 8
"""Pieces that the chain is cut into at once: the time grows with 4^n."""

Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class NodeGraph:
    """What it takes to go from each node to each other.

    Parameters
    ----------
    gaps : (M, M) float array
        Free space between two slices, metres: their distance less what they fill, at least 0. A slice fills sqrt(3)
        of its standard deviation to each side, as an even spread of points does.
    costs : (M, M) float array
        Distance plus `GAP_COST` times the gap, in units of the median distance to the nearest node.
    directions : (M, M, 3) float array
        Unit vectors from node to node.
    touching : (M,) int array
        How many others each slice touches: 2 on a rope, more on a surface.
    """

    gaps: FloatArray
    costs: FloatArray
    directions: FloatArray
    touching: Indices

    @classmethod
    def of(cls, centroids: FloatArray, covariances: FloatArray) -> NodeGraph:
        """The graph of slices with (M, 3) centroids, metres, and (M, 3, 3) covariances, m^2."""
        count = len(centroids)
        graph = cls(
            np.empty((count, count)),
            np.empty((count, count)),
            np.empty((count, count, 3)),
            np.zeros(count, np.int64),
        )
        _fill_graph(centroids, covariances, graph.gaps, graph.costs, graph.directions, graph.touching)
        return graph


def order_path(graph: NodeGraph) -> Indices:
    """The open chain of least cost through all nodes.

    To the costs of the edges comes `TURN_COST` (1 - cos t)^2 for a turn by t. The search starts from the cheapest
    edges, as Kruskal's algorithm picks them. Then, until nothing is gained, the chain is cut at its worst joints and
    the pieces are put together in the best of all orders (Held and Karp's dynamic programme), stretches are turned
    round (2-opt) and single nodes moved (or-opt).

    The search ends when `SEARCH_BUDGET` changes have been looked at: a rope needs a few thousand, hundreds of nodes
    that form no rope would take seconds.

    Returns
    -------
    (M,) int array
        Indices of the nodes along the rope, from either end.
    """
    path = np.arange(len(graph.touching))
    if len(path) > 2:
        _link(graph.costs, path)
        _improve(graph.costs, graph.directions, path)
    return path


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
    return bool(_runs_backwards(chain, previous))


def starts_at_end(chain: FloatArray, first_point: tuple[float, float, float] | None = None) -> bool:
    """Whether a chain's last node is rather its start: nearer to the given point, or higher in the image.

    Parameters
    ----------
    chain : (M, 3) float array
        Nodes in order, metres, camera frame.
    first_point : (x, y, z), optional
        Where ropes start, metres.
    """
    if first_point is None:
        return bool(chain[-1, 1] < chain[0, 1])
    distances = np.linalg.norm(chain[[0, -1]] - np.array(first_point), axis=1)
    return bool(distances[1] < distances[0])


@njit(cache=True, nogil=True)
def _runs_backwards(chain: Any, previous: Any) -> bool:
    here, before = _sampled(chain), _sampled(previous)
    forwards = backwards = 0.0
    for index in range(len(here)):
        forwards += np.sqrt(np.sum((here[index] - before[index]) ** 2))
        backwards += np.sqrt(np.sum((here[len(here) - 1 - index] - before[index]) ** 2))
    return backwards < forwards


@njit(cache=True, nogil=True)
def _sampled(chain: Any) -> Any:
    """Nine points at equal parts of a polyline's length."""
    length = np.zeros(len(chain))
    for index in range(1, len(chain)):
        length[index] = length[index - 1] + np.sqrt(np.sum((chain[index] - chain[index - 1]) ** 2))
    points = np.empty((9, 3))
    places = np.linspace(0.0, length[-1], 9)
    for axis in range(3):
        points[:, axis] = np.interp(places, length, np.ascontiguousarray(chain[:, axis]))
    return points


@njit(cache=True, nogil=True)
def _gap(a: Any, b: Any, covariance_a: Any, covariance_b: Any, unit: Any) -> Any:
    """Distance of two slices, and the free space in it; fills in the unit vector from a to b."""
    size = 0.0
    for k in range(3):
        unit[k] = b[k] - a[k]
        size += unit[k] * unit[k]
    size = np.sqrt(size)
    for k in range(3):
        unit[k] = unit[k] / size if size > 0 else 0.0
    spread_a = spread_b = 0.0
    for k in range(3):
        for m in range(3):
            spread_a += unit[k] * covariance_a[k, m] * unit[m]
            spread_b += unit[k] * covariance_b[k, m] * unit[m]
    return size, max(0.0, size - np.sqrt(max(3 * spread_a, 0.0)) - np.sqrt(max(3 * spread_b, 0.0)))


@njit(cache=True, nogil=True)
def _fill_graph(centroids: Any, covariances: Any, gaps: Any, costs: Any, directions: Any, touching: Any) -> None:
    count = len(centroids)
    nearest = np.full(count, np.inf)
    unit = np.empty(3)
    for i in range(count):
        gaps[i, i] = costs[i, i] = np.inf
        directions[i, i] = 0.0
        for j in range(i):
            size, gap = _gap(centroids[i], centroids[j], covariances[i], covariances[j], unit)
            for k in range(3):
                directions[i, j, k] = unit[k]
                directions[j, i, k] = -unit[k]
            gaps[i, j] = gaps[j, i] = gap
            costs[i, j] = size + GAP_COST * gap
            nearest[i] = min(nearest[i], size)
            nearest[j] = min(nearest[j], size)
            if gap < _TOUCH * size:
                touching[i] += 1
                touching[j] += 1
    scale = max(np.median(nearest), 1e-9)
    for i in range(count):
        for j in range(i):
            costs[i, j] /= scale
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
    budget = np.array([SEARCH_BUDGET])
    while budget[0] > 0:
        if not (
            _reassemble(costs, directions, path, budget)
            or _exchange(costs, directions, path, budget)
            or _move(costs, directions, path, budget)
        ):
            break


@njit(cache=True, nogil=True)
def _reassemble(costs: Any, directions: Any, path: Any, budget: Any) -> bool:
    """Cut the chain at its worst joints and put the pieces together in the best order; False if it was that already."""
    count = len(path)
    joints = np.zeros(count)
    for at in range(1, count):
        joints[at] = _joint(costs, directions, _at(path, at - 2), path[at - 1], path[at], _at(path, at + 1))
    cuts = np.argsort(-joints)[: _MOST_PIECES - 1]
    cuts = np.sort(cuts[joints[cuts] >= _EASY])
    if len(cuts) == 0:
        return False
    starts = np.concatenate((np.zeros(1, np.int64), cuts))
    stops = np.concatenate((cuts, np.full(1, count)))
    pieces = len(starts)

    # A piece and its direction are one number, 2 * piece + (1 if it runs backwards).
    turned = 2 * pieces
    budget[0] -= (1 << pieces) * turned * turned // 8
    link = np.empty((turned, turned))
    for a in range(turned):
        first_a, last_a = starts[a // 2], stops[a // 2] - 1
        tail = path[last_a] if a % 2 == 0 else path[first_a]
        before = -1 if first_a == last_a else (path[last_a - 1] if a % 2 == 0 else path[first_a + 1])
        for b in range(turned):
            first_b, last_b = starts[b // 2], stops[b // 2] - 1
            head = path[first_b] if b % 2 == 0 else path[last_b]
            after = -1 if first_b == last_b else (path[first_b + 1] if b % 2 == 0 else path[last_b - 1])
            link[a, b] = _joint(costs, directions, before, tail, head, after)

    best = np.full((1 << pieces, turned), np.inf)
    came = np.full((1 << pieces, turned), -1, np.int64)
    for a in range(turned):
        best[1 << (a // 2), a] = 0.0
    for used in range(1, 1 << pieces):
        for a in range(turned):
            if best[used, a] == np.inf:
                continue
            for b in range(turned):
                if used & (1 << (b // 2)):
                    continue
                cost = best[used, a] + link[a, b]
                more = used | (1 << (b // 2))
                if cost < best[more, b]:
                    best[more, b] = cost
                    came[more, b] = a
    used = (1 << pieces) - 1
    last = int(np.argmin(best[used]))
    old = path.copy()
    at = count
    while last >= 0:
        piece = old[starts[last // 2] : stops[last // 2]]
        at -= len(piece)
        path[at : at + len(piece)] = piece if last % 2 == 0 else piece[::-1]
        last, used = came[used, last], used & ~(1 << (last // 2))
    # The links leave out the turn at a piece of a single node, so only the whole chain's cost tells.
    if _string(costs, directions, path, count) < _string(costs, directions, old, count) - 1e-9:
        return True
    path[:] = old
    return False


@njit(cache=True, nogil=True)
def _exchange(costs: Any, directions: Any, path: Any, budget: Any) -> bool:
    """Turn round the stretch of chain that gains most (2-opt); False if none gains."""
    count = len(path)
    joints = np.zeros(count + 1)
    for at in range(1, count):
        joints[at] = _joint(costs, directions, _at(path, at - 2), path[at - 1], path[at], _at(path, at + 1))
    best, best_first, best_last = -1e-9, -1, -1
    for first in range(count - 1):
        for last in range(first + 1, count):
            before = joints[first] + joints[last + 1]
            if before < _EASY or (joints[first] < _EASY and joints[last + 1] < _EASY):
                continue
            budget[0] -= 1
            gain = (
                _joint(costs, directions, _at(path, first - 2), _at(path, first - 1), path[last], path[last - 1])
                + _joint(costs, directions, path[first + 1], path[first], _at(path, last + 1), _at(path, last + 2))
                - before
            )
            if gain < best:
                best, best_first, best_last = gain, first, last
    if best_first < 0:
        return False
    path[best_first : best_last + 1] = path[best_first : best_last + 1][::-1].copy()
    return True


@njit(cache=True, nogil=True)
def _move(costs: Any, directions: Any, path: Any, budget: Any) -> bool:
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
            if removed < _EASY or budget[0] <= 0:
                continue
            budget[0] -= 2 * count
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
