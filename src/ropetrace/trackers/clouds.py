"""Clouds and chains of nodes: cells of a grid, distances, places along a chain."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ropetrace.types import FloatArray

FARTHEST = 1e4
"""A point with a coordinate beyond this is none, metres."""


def voxel_grid(points: FloatArray, edge: float) -> tuple[FloatArray, FloatArray]:
    """One point for each cell of a grid that has any: their mean.

    Parameters
    ----------
    points : (3, N) float array
        Metres.
    edge : float
        Of the cells, metres. They are aligned with the origin.

    Returns
    -------
    centroids : (K, 3) float array
        In the order of their cells (x, then y, then z), whatever the order of the points.
    weights : (K,) float array
        Points of each cell over the mean number: a sum with these weights is one over the points.
    """
    count = points.shape[1]
    size = 1 << max(int(2 * count - 1).bit_length(), 4)
    centroids, counts = _voxel_grid((points[0], points[1], points[2]), edge, size)
    return centroids, counts / counts.mean() if len(counts) else counts


def nearest_distances(nodes: FloatArray, points: FloatArray) -> FloatArray:
    """Distance of each node to the nearest of the points, (M,), metres.

    Parameters
    ----------
    nodes : (M, 3) float array
        Metres.
    points : (N, 3) float array
        N >= 1, metres.
    """
    distances, _ = _nearest(np.ascontiguousarray(nodes), np.ascontiguousarray(points))
    return distances


def nearest_nodes(points: FloatArray, nodes: FloatArray) -> NDArray[np.int64]:
    """Index of the node nearest to each point, (N,); points and nodes are (N, 3) and (M, 3), metres."""
    _, indices = _nearest(np.ascontiguousarray(points), np.ascontiguousarray(nodes))
    return indices


def distances_to_chain(points: FloatArray, chain: FloatArray) -> FloatArray:
    """Distance of each point to the polyline through a chain, (N,), metres.

    Parameters
    ----------
    points : (N, 3) float array
        Metres.
    chain : (M, 3) float array
        M >= 2, metres.
    """
    distances = np.empty(len(points))
    _distances_to_chain(np.ascontiguousarray(points), np.ascontiguousarray(chain), distances)
    return distances


def arc_lengths(chain: FloatArray) -> FloatArray:
    """Places of a chain's nodes along it, (M,), metres from the first; the chain is (M, 3), metres."""
    steps = np.linalg.norm(np.diff(chain, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def evenly_along(chain: FloatArray, count: int) -> FloatArray:
    """`count` points at equal arc length along a chain, both (., 3) and in metres, its ends among them."""
    arc = arc_lengths(chain)
    places = np.linspace(0, arc[-1], count)
    return interpolated(places, arc, chain)


def interpolated(places: FloatArray, knots: FloatArray, rows: FloatArray) -> FloatArray:
    """Rows, (K, 3), interpolated from their growing knots, (K,), to other places, (P, 3)."""
    return np.stack([np.interp(places, knots, rows[:, axis]) for axis in range(3)], axis=1)


def walk(polyline: FloatArray, strides: FloatArray) -> FloatArray:
    """Points along a polyline, each at its stride from the one before as the crow flies.

    The next point is where the rest of the polyline first leaves the sphere of that radius round the last one.

    Parameters
    ----------
    polyline : (K, 3) float array
        K >= 1, metres; the walk starts at its first vertex.
    strides : (S,) float array
        Above 0, metres.

    Returns
    -------
    (P, 3) float array
        P - 1 <= S strides fit on the polyline.
    """
    return np.asarray(_walk(np.ascontiguousarray(polyline), np.ascontiguousarray(strides)))


@njit(cache=True, nogil=True)
def _voxel_grid(points: Any, edge: float, size: int) -> Any:
    """Cells are found through a hash table of `size` places, a power of two, by linear probing."""
    xs, ys, zs = points
    table = np.full(size, -1, np.int64)
    keys = np.empty(len(xs), np.int64)
    sums = np.empty((len(xs), 4))
    used = 0
    per_edge = 1 / edge
    half = np.int64(1) << np.int64(20)
    for n in range(len(xs)):
        x, y, z = xs[n], ys[n], zs[n]
        if not (abs(x) < FARTHEST and abs(y) < FARTHEST and abs(z) < FARTHEST):
            continue
        key = np.int64(0)
        for value in (x, y, z):
            cell = np.int64(min(max(np.floor(value * per_edge), -half), half - 1)) + half
            key = (key << np.int64(21)) | cell
        # Fibonacci hashing: the product's high bits depend on all of the key's.
        place = ((key * np.int64(-7046029254386353131)) >> np.int64(20)) & np.int64(size - 1)
        while table[place] >= 0 and keys[table[place]] != key:
            place = (place + 1) & (size - 1)
        voxel = table[place]
        if voxel < 0:
            voxel = used
            table[place] = voxel
            keys[voxel] = key
            sums[voxel] = 0.0
            used += 1
        sums[voxel, 0] += x
        sums[voxel, 1] += y
        sums[voxel, 2] += z
        sums[voxel, 3] += 1.0
    order = np.argsort(keys[:used])
    centroids, counts = np.empty((used, 3)), np.empty(used)
    for k in range(used):
        row = sums[order[k]]
        counts[k] = row[3]
        for axis in range(3):
            centroids[k, axis] = row[axis] / row[3]
    return centroids, counts


@njit(cache=True, nogil=True)
def _nearest(first: Any, second: Any) -> Any:
    distances, indices = np.empty(len(first)), np.zeros(len(first), np.int64)
    for i in range(len(first)):
        x, y, z = first[i, 0], first[i, 1], first[i, 2]
        least = np.inf
        for j in range(len(second)):
            squared = (second[j, 0] - x) ** 2 + (second[j, 1] - y) ** 2 + (second[j, 2] - z) ** 2
            if squared < least:
                least = squared
                indices[i] = j
        distances[i] = np.sqrt(least)
    return distances, indices


@njit(cache=True, nogil=True)
def _distances_to_chain(points: Any, chain: Any, distances: Any) -> None:
    segments = len(chain) - 1
    steps = np.empty((segments, 3))
    per_square = np.empty(segments)
    for m in range(segments):
        square = 0.0
        for axis in range(3):
            steps[m, axis] = chain[m + 1, axis] - chain[m, axis]
            square += steps[m, axis] ** 2
        per_square[m] = 1 / square if square > 0.0 else 0.0
    for n in range(len(points)):
        least = np.inf
        for m in range(segments):
            x, y, z = points[n, 0] - chain[m, 0], points[n, 1] - chain[m, 1], points[n, 2] - chain[m, 2]
            part = (x * steps[m, 0] + y * steps[m, 1] + z * steps[m, 2]) * per_square[m]
            part = min(max(part, 0.0), 1.0)
            x, y, z = x - part * steps[m, 0], y - part * steps[m, 1], z - part * steps[m, 2]
            least = min(least, x * x + y * y + z * z)
        distances[n] = np.sqrt(least)


@njit(cache=True, nogil=True)
def _walk(polyline: Any, strides: Any) -> Any:
    found = np.empty((len(strides) + 1, 3))
    found[0] = polyline[0]
    segment, part = 0, 0.0
    for s in range(len(strides)):
        reached = False
        while segment < len(polyline) - 1 and not reached:
            # |from + t along|^2 = stride^2, of which the larger root is where the segment leaves the sphere.
            square = product = inside = 0.0
            for axis in range(3):
                along = polyline[segment + 1, axis] - polyline[segment, axis]
                away = polyline[segment, axis] - found[s, axis]
                square += along * along
                product += along * away
                inside += away * away
            inside -= strides[s] ** 2
            root = product * product - square * inside
            if square > 0.0 and root >= 0.0:
                place = (-product + np.sqrt(root)) / square
                if part <= place <= 1.0:
                    part = place
                    reached = True
            if not reached:
                segment += 1
                part = 0.0
        if not reached:
            return found[: s + 1]
        for axis in range(3):
            here, there = polyline[segment, axis], polyline[segment + 1, axis]
            found[s + 1, axis] = here + part * (there - here)
    return found


@njit(cache=True, nogil=True)
def closest_places(a: Any, b: Any, c: Any, d: Any) -> Any:
    """Where two stretches ab and cd come closest, as fractions, and how close.

    Ericson, Real-Time Collision Detection (2005), 5.1.9.
    """
    uu = vv = uv = uw = vw = 0.0
    for k in range(3):
        u, v, w = b[k] - a[k], d[k] - c[k], a[k] - c[k]
        uu += u * u
        vv += v * v
        uv += u * v
        uw += u * w
        vw += v * w
    across = uu * vv - uv * uv
    s = min(max((uv * vw - uw * vv) / across, 0.0), 1.0) if across > 1e-12 * uu * vv else 0.0
    t = (uv * s + vw) / vv if vv > 0 else 0.0
    if t < 0.0 or t > 1.0 or vv == 0.0:
        t = min(max(t, 0.0), 1.0)
        s = min(max((uv * t - uw) / uu, 0.0), 1.0) if uu > 0 else 0.0
    total = 0.0
    for k in range(3):
        total += (a[k] + s * (b[k] - a[k]) - c[k] - t * (d[k] - c[k])) ** 2
    return s, t, np.sqrt(total)
