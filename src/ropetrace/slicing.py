"""Recursive slicing of a point cloud into node clouds (section 4.1, equations 1-11).

The part with the largest variance is cut in two through its centroid, across its first principal axis, until no
part's variance exceeds the threshold.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numba import njit

from ropetrace.types import FloatArray, Slices, coordinate_buffer

_TIE = 1e-7
"""Points this close to the cutting plane, in standard deviations along the axis, lie on it."""

_EQUAL = 1e-6
"""Relative difference below which two eigenvalues, or a skewness and zero, are taken to be equal."""

_STEEP_NORMAL, _LARGE_COORDINATE = 0.78693, 0.10371
"""Limits of direction cosines that the directions of grids do not meet: (4, 0, 3) / 5 would meet 0.8."""


@dataclass(slots=True, eq=False)
class Slicer:
    """Slices clouds; its buffers are used again by every call.

    Parameters
    ----------
    variance_threshold : float
        delta_sigma of equation 9, m^2.
    min_points : int, optional
        delta_O of equation 10: parts with fewer points are dropped. By default a quarter of the median part, at
        least 2: what noise leaves over is smaller than what a rope gives at the same distance. Parts of one or two
        points, which stray points make, do not count for the median.
    max_nodes : int
        No more parts than this are made.
    """

    variance_threshold: float
    min_points: int | None
    max_nodes: int
    _spare: FloatArray = field(default_factory=lambda: np.empty((3, 0)))

    def slice(self, points: FloatArray) -> Slices:
        """Cut a cloud.

        Parameters
        ----------
        points : (3, N) float array
            x, y, z, metres, all finite. They are sorted in place, part after part.
        """
        if self._spare.shape[1] < points.shape[1]:
            self._spare = coordinate_buffer(points.shape[1])
        moments = np.empty((self.max_nodes, 10))
        ranges = np.empty((self.max_nodes, 2), np.int64)
        # Row by row, since a part of a larger buffer is not contiguous as a whole, and the kernels want it to be.
        parts, capped = _slice(
            (points[0], points[1], points[2]),
            (self._spare[0], self._spare[1], self._spare[2]),
            self.variance_threshold,
            self.min_points or 2,
            moments,
            ranges,
        )
        moments, ranges = moments[:parts], ranges[:parts]
        slices = Slices(
            moments[:, :3],
            moments[:, [3, 4, 5, 4, 6, 7, 5, 7, 8]].reshape(-1, 3, 3),
            ranges[:, 1] - ranges[:, 0],
            bool(capped),
            ranges[:, 0],
        )
        if self.min_points is not None:
            return slices.kept(slices.counts >= self.min_points)
        solid = slices.counts[slices.counts > 2]
        least = max(2.0, np.median(solid) / 4) if len(solid) else 2.0
        return slices.kept(slices.counts >= least)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _measure(points: Any, start: int, stop: int, out: Any) -> None:
    """Mean, covariance (xx, xy, xz, yy, yz, zz) and its trace.

    Sums are taken about the part's first point, so that no digits are lost to the distance from the camera or to a
    stray point far away.
    """
    x, y, z = points
    ox, oy, oz = x[start], y[start], z[start]
    sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
    for i in range(np.uintp(start), np.uintp(stop)):
        dx, dy, dz = x[i] - ox, y[i] - oy, z[i] - oz
        sx += dx
        sy += dy
        sz += dz
        sxx += dx * dx
        sxy += dx * dy
        sxz += dx * dz
        syy += dy * dy
        syz += dy * dz
        szz += dz * dz
    n = stop - start
    mx, my, mz = sx / n, sy / n, sz / n
    out[0], out[1], out[2] = ox + mx, oy + my, oz + mz
    out[3], out[4], out[5] = sxx / n - mx * mx, sxy / n - mx * my, sxz / n - mx * mz
    out[6], out[7], out[8] = syy / n - my * my, syz / n - my * mz, szz / n - mz * mz
    out[9] = max(out[3] + out[6] + out[8], 0.0)


@njit(cache=True, nogil=True)
def _eigen(m: Any) -> Any:
    """Eigenvalues and eigenvectors (columns) of a symmetric 3x3 matrix, by Jacobi rotations."""
    a = np.empty((3, 3))
    a[0, 0], a[0, 1], a[0, 2], a[1, 1], a[1, 2], a[2, 2] = m[3], m[4], m[5], m[6], m[7], m[8]
    v = np.eye(3)
    for _ in range(12):
        off = a[0, 1] ** 2 + a[0, 2] ** 2 + a[1, 2] ** 2
        if off <= 1e-30 * (a[0, 0] ** 2 + a[1, 1] ** 2 + a[2, 2] ** 2):
            break
        for p, q, r in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
            apq = a[p, q]
            if apq == 0.0:
                continue
            theta = (a[q, q] - a[p, p]) / (2 * apq)
            t = 1 / (abs(theta) + np.sqrt(theta * theta + 1))
            if theta < 0:
                t = -t
            c = 1 / np.sqrt(t * t + 1)
            s = t * c
            a[p, p] -= t * apq
            a[q, q] += t * apq
            a[p, q] = 0.0
            arp, arq = a[min(r, p), max(r, p)], a[min(r, q), max(r, q)]
            a[min(r, p), max(r, p)] = c * arp - s * arq
            a[min(r, q), max(r, q)] = s * arp + c * arq
            for k in range(3):
                vkp, vkq = v[k, p], v[k, q]
                v[k, p] = c * vkp - s * vkq
                v[k, q] = s * vkp + c * vkq
    return a, v


@njit(cache=True, nogil=True)
def _first_axis(m: Any, axis: Any) -> float:
    """First principal axis, with a sign and, among equals, a direction that rounding cannot turn; its variance."""
    a, v = _eigen(m)
    first = 0
    last = 0
    for k in range(1, 3):
        if a[k, k] > a[first, first]:
            first = k
        if a[k, k] <= a[last, last]:
            last = k
    middle = 3 - first - last
    for k in range(3):
        axis[k] = v[k, first]
    if first == last or a[last, last] > (1 - _EQUAL) * a[first, first]:
        axis[0], axis[1], axis[2] = 1.0, 0.0, 0.0
    elif a[middle, middle] > (1 - _EQUAL) * a[first, first]:
        # Any direction in the plane of the two will do: the one closest to a fixed coordinate axis is always the same.
        fixed = 0 if abs(v[0, last]) < _STEEP_NORMAL else 1
        size = np.sqrt(1 - v[fixed, last] ** 2)
        for k in range(3):
            axis[k] = ((1.0 if k == fixed else 0.0) - v[fixed, last] * v[k, last]) / size
    for k in range(3):
        if abs(axis[k]) > _LARGE_COORDINATE:
            if axis[k] < 0:
                for j in range(3):
                    axis[j] = -axis[j]
            break
    return max(a[first, first], 0.0)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _ties(x: Any, y: Any, z: Any, start: int, stop: int, mean: Any, axis: Any, tie: float) -> Any:
    """How many points lie on the cutting plane, and the sums of cubes and absolute cubes of their distances."""
    ax, ay, az = axis[0], axis[1], axis[2]
    mx, my, mz = mean[0], mean[1], mean[2]
    ties = 0
    for i in range(np.uintp(start), np.uintp(stop)):
        ties += abs((x[i] - mx) * ax + (y[i] - my) * ay + (z[i] - mz) * az) <= tie
    cubes = absolute = 0.0
    if ties:
        for i in range(start, stop):
            place = (x[i] - mx) * ax + (y[i] - my) * ay + (z[i] - mz) * az
            cubes += place**3
            absolute += abs(place**3)
    return ties, cubes, absolute


@njit(cache=True, nogil=True)
def _cut(points: Any, spare: Any, start: int, stop: int, mean: Any, axis: Any, variance: float) -> int:
    """Move the points before the cutting plane behind those on or beyond it; returns where they begin.

    Points on the plane (equations 6 and 7 put them on the side the axis points to, and its sign is arbitrary) go to
    the side of the longer tail; where the part is symmetric, to the side of the axis' first large coordinate. Neither
    depends on rounding, so gridded clouds are cut alike wherever they lie.
    """
    x, y, z = points
    spare_x, spare_y, spare_z = spare
    tie = _TIE * np.sqrt(variance)
    ties, cubes, absolute = _ties(x, y, z, start, stop, mean, axis, tie)
    sign = -1.0 if ties and cubes < -_EQUAL * absolute else 1.0
    ax, ay, az = sign * axis[0], sign * axis[1], sign * axis[2]
    mx, my, mz = mean[0], mean[1], mean[2]
    left = np.uintp(start)
    right = np.uintp(0)
    for i in range(np.uintp(start), np.uintp(stop)):
        # Written to both sides and counted on one: no branch for the processor to guess wrong.
        xi, yi, zi = x[i], y[i], z[i]
        beyond = np.uintp((xi - mx) * ax + (yi - my) * ay + (zi - mz) * az >= -tie)
        x[left], y[left], z[left] = xi, yi, zi
        spare_x[right], spare_y[right], spare_z[right] = xi, yi, zi
        left += beyond
        right += np.uintp(1) - beyond
    for i in range(right):
        x[left + i], y[left + i], z[left + i] = spare_x[i], spare_y[i], spare_z[i]
    return int(left)


@njit(cache=True, nogil=True)
def _sift_up(heap: Any, size: int, moments: Any) -> None:
    """Restore a heap, largest trace first, after a part was put at its end."""
    child = size - 1
    while child:
        parent = (child - 1) // 2
        if moments[heap[parent], 9] >= moments[heap[child], 9]:
            break
        heap[parent], heap[child] = heap[child], heap[parent]
        child = parent


@njit(cache=True, nogil=True)
def _sift_down(heap: Any, size: int, moments: Any) -> None:
    """Restore the heap after its first part was replaced."""
    parent = 0
    while True:
        child = 2 * parent + 1
        if child >= size:
            break
        if child + 1 < size and moments[heap[child + 1], 9] > moments[heap[child], 9]:
            child += 1
        if moments[heap[parent], 9] >= moments[heap[child], 9]:
            break
        heap[parent], heap[child] = heap[child], heap[parent]
        parent = child


@njit(cache=True, nogil=True)
def _slice(points: Any, spare: Any, threshold: float, min_points: int, moments: Any, ranges: Any) -> Any:
    """Fill `moments` and `ranges` with the parts; returns how many, and whether the cap on parts was met."""
    count = len(points[0])
    max_parts = len(ranges)
    if count < min_points or count == 0:
        return 0, False
    heap = np.empty(max_parts, np.int64)
    axis = np.empty(3)
    ranges[0, 0], ranges[0, 1] = 0, count
    _measure(points, 0, count, moments[0])
    heap[0] = 0
    heap_size = parts = 1
    threshold *= 1 + 1e-9
    capped = False
    while heap_size:
        part = heap[0]
        if moments[part, 9] <= threshold:
            break
        start, stop = ranges[part]
        variance = _first_axis(moments[part], axis)
        middle = _cut(points, spare, start, stop, moments[part], axis, variance)
        if middle == start or middle == stop:
            # Points that coincide, or nearly: no plane separates them.
            heap_size -= 1
            heap[0] = heap[heap_size]
            _sift_down(heap, heap_size, moments)
            continue
        keep_left, keep_right = middle - start >= min_points, stop - middle >= min_points
        if keep_left and keep_right and parts == max_parts:
            capped = True
            break
        if keep_left:
            ranges[part, 1] = middle
            _measure(points, start, middle, moments[part])
            _sift_down(heap, heap_size, moments)
        if keep_right:
            new = parts if keep_left else part
            ranges[new, 0], ranges[new, 1] = middle, stop
            _measure(points, middle, stop, moments[new])
            if keep_left:
                heap[heap_size] = new
                heap_size += 1
                parts += 1
                _sift_up(heap, heap_size, moments)
            else:
                _sift_down(heap, heap_size, moments)
        if not keep_left and not keep_right:
            heap_size -= 1
            heap[0] = heap[heap_size]
            _sift_down(heap, heap_size, moments)
            ranges[part, 1] = start
    return parts, capped
