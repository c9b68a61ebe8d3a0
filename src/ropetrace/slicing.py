"""Recursive slicing of a point cloud into node clouds (section 4.1, equations 1-11).

The part with the largest variance is cut in two through its centroid, across its first principal axis, until no
part's variance exceeds the threshold.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ropetrace.types import FloatArray, coordinate_buffer

_TIE = 1e-7
"""Points this close to the cutting plane, in standard deviations along the axis, lie on it."""

_EQUAL = 1e-6
"""Relative difference below which two eigenvalues, or a skewness and zero, are taken to be equal."""

_STEEP_NORMAL, _LARGE_COORDINATE = 0.78693, 0.10371
"""Limits of direction cosines that the directions of grids do not meet: (4, 0, 3) / 5 would meet 0.8."""


_RIM = 0.95
"""Part of the radius beyond which the round profile is too steep to say anything."""

_WIDE = 1.5
"""A slice whose variance across the rope exceeds that of a tube of its diameter this much is no single tube."""

_SKEWED = 7.0
"""Three times what the skewness of sqrt(n) normal values is by chance: more is a tail."""

_CUTS = 4
"""How often a tail is cut off, at most."""

_FEWEST_FOR_FIT = 8
"""Points that a slice must have for its profile to be fitted."""


@dataclass(frozen=True, slots=True, eq=False)
class Slices:
    """The parts of a cloud, in no particular order.

    Parameters
    ----------
    centroids : (M, 3) float array
        Mean of each part's points, metres (equation 2).
    covariances : (M, 3, 3) float array
        Covariance of each part's points, divided by their count, m^2 (equation 3 takes its trace).
    counts : (M,) int array
        Points of each part.
    capped : bool
        Whether the cap on parts stopped the slicing before the threshold was reached.
    starts : (M,) int array
        Where each part begins in the sorted points: part m is ``points[:, starts[m]:starts[m] + counts[m]]``.
    """

    centroids: FloatArray
    covariances: FloatArray
    counts: NDArray[np.int64]
    capped: bool
    starts: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.counts)

    def kept(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> Slices:
        """Only the parts where the (M,) mask is true, or those of the given indices, in their order."""
        return Slices(
            self.centroids[keep],
            self.covariances[keep],
            self.counts[keep],
            self.capped,
            self.starts[keep],
        )


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


def axis_points(
    points: FloatArray,
    slices: Slices,
    tangents: FloatArray,
    radius: float,
    surface_offset: tuple[float, float, float] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Points on the rope's axis below the centroids of ordered slices of its visible surface (equation 11).

    Three things keep a centroid off the axis, and are taken back:

    - The mean of a bent slice lies inside the bend: for a slice whose points have the variance s^2 along the rope, by
      s^2/2 times the curve's second derivative.
    - The camera sees the near side only. A point seen at u to the side of the axis of a cylinder of radius r lies
      sqrt(r^2 - u^2) before it, r pi/4 in the mean; the slice's own points say how they are spread, so that lost edges
      and coarse pixels do not bias it.
    - Pixels seldom fall alike on both edges, so the centroid may lie up to half a pixel to the side. The round profile
      of the surface says where its middle is: the sideways shift that makes the points agree best on the axis' depth
      is taken as far as their scatter allows, against the quarter of a pixel that the pixels leave open.

    Parameters
    ----------
    points : (3, N) float array
        As `Slicer.slice` sorted them, metres, camera frame.
    slices : Slices
        In order along the rope, M >= 2.
    tangents : (M, 3) float array
        Unit vectors along the rope.
    radius : float
        Of the rope, metres.
    surface_offset : (x, y, z), optional
        The paper's constant vector v_c, added in the place of all this, metres.

    Returns
    -------
    nodes : (M, 3) float array
        Metres.
    widths : (M,) float array
        How wide the slices look to the camera, metres: the square of the width over which points spread evenly is
        twelve times their variance, and what the pixels' pitch takes from it.
    """
    nodes = np.empty_like(slices.centroids)
    widths = np.empty(len(nodes))
    _axis_points(
        (points[0], points[1], points[2]),
        slices.starts,
        slices.counts,
        slices.centroids,
        slices.covariances,
        tangents,
        radius,
        nodes,
        widths,
    )
    if surface_offset is not None:
        nodes = slices.centroids + np.array(surface_offset)
    return nodes, widths


@njit(cache=True, nogil=True)
def _axis_points(
    points: Any,
    starts: Any,
    counts: Any,
    centroids: Any,
    covariances: Any,
    tangents: Any,
    radius: float,
    nodes: Any,
    widths: Any,
) -> None:
    last = len(centroids) - 1
    away, side, bend = np.empty(3), np.empty(3), np.empty(3)
    for m in range(last + 1):
        c, t = centroids[m], tangents[m]
        size = np.sqrt(c[0] * c[0] + c[1] * c[1] + c[2] * c[2])
        slope = (c[0] * t[0] + c[1] * t[1] + c[2] * t[2]) / max(size, 1e-9)
        for k in range(3):
            away[k] = c[k] / max(size, 1e-9) - slope * t[k]
        # Where the rope points at the camera it has no visible half to correct for: fade out.
        sine = max(np.sqrt(away[0] ** 2 + away[1] ** 2 + away[2] ** 2), 0.1)
        before = after = 1.0
        if 0 < m < last:
            before, after = _distance(centroids[m - 1], c), _distance(c, centroids[m + 1])
        for k in range(3):
            away[k] /= sine
            bend[k] = 0.0
            if 0 < m < last:
                change = (centroids[m + 1, k] - c[k]) / after - (c[k] - centroids[m - 1, k]) / before
                bend[k] = 2 * change / (before + after)
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            side[k] = t[i] * away[j] - t[j] * away[i]
        along, across = _variance(covariances[m], t), _variance(covariances[m], side)
        # Rows of points p apart lose p^2 of the width's square; p^2 is the area that a point stands for.
        pitch = np.sqrt(12 * along) / max(counts[m], 1)
        widths[m] = (pitch + np.sqrt(pitch * pitch + 48 * across)) / 2
        depth, sideways = _profile(
            points, starts[m], starts[m] + counts[m], c, t, side, away, bend, along, across, radius
        )
        for k in range(3):
            nodes[m, k] = c[k] - 0.5 * along * bend[k] + depth * away[k] + sideways * side[k]


@njit(cache=True, nogil=True)
def _variance(covariance: Any, direction: Any) -> float:
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += direction[i] * covariance[i, j] * direction[j]
    return max(total, 0.0)


@njit(cache=True, nogil=True)
def _profile(
    points: Any,
    start: int,
    stop: int,
    c: Any,
    t: Any,
    side: Any,
    away: Any,
    bend: Any,
    along: float,
    across: float,
    radius: float,
) -> Any:
    """Where the axis lies from a slice's centroid: away from the camera, and to the side, metres.

    With u and w a point's coordinates to the side and away, and s = sqrt(r^2 - u^2), the axis is q = w + s away; if it
    lies u0 to the side, that is w + s + u0 u/s. The least-squares u0 is shrunk by the variance that it has. Where q has
    a long tail to the far side, the rope is waisted there, as between the links of a chain: the tail is cut off.
    """
    seen = min(np.sqrt(3 * across) / radius, 1.0)
    mean_depth = radius * (0.5 * (np.sqrt(1 - seen * seen) + np.arcsin(seen) / seen) if seen > 1e-3 else 1.0)
    if stop - start < _FEWEST_FOR_FIT or across > _WIDE * radius * radius / 3:
        # More than one strand, or a blob: no round profile to fit.
        return mean_depth, 0.0
    frame = (c[0], c[1], c[2], t[0], t[1], t[2], side[0], side[1], side[2], away[0], away[1], away[2])
    bend_side = 0.5 * (bend[0] * side[0] + bend[1] * side[1] + bend[2] * side[2])
    bend_away = 0.5 * (bend[0] * away[0] + bend[1] * away[1] + bend[2] * away[2])
    curve = (bend_side, bend_away, along)
    farthest = np.inf
    n, sq, sqq, sqqq, sg, sgg, sqg = _profile_sums(points, start, stop, frame, curve, radius, mean_depth, farthest)
    for _ in range(_CUTS):
        if n < _FEWEST_FOR_FIT:
            return mean_depth, 0.0
        mean = sq / n
        variance = max(sqq / n - mean * mean, 0.0)
        third = sqqq / n - 3 * mean * sqq / n + 2 * mean**3
        if third <= _SKEWED / np.sqrt(n) * variance**1.5:
            break
        farthest = mean_depth + mean + np.sqrt(variance)
        n, sq, sqq, sqqq, sg, sgg, sqg = _profile_sums(points, start, stop, frame, curve, radius, mean_depth, farthest)
    if n < _FEWEST_FOR_FIT:
        return mean_depth, 0.0
    vgg = sgg - sg * sg / n
    vqg = sqg - sq * sg / n
    vqq = sqq - sq * sq / n
    if vgg <= 0:
        return mean_depth, 0.0
    scatter = max(vqq - vqg * vqg / vgg, 0.0) / (n - 2)
    pixel = 12 * np.sqrt(along * across) / (stop - start)
    # The pixels leave a quarter of their pitch open, as a standard deviation, and never more than half of it.
    limit = np.sqrt(pixel) / 2
    shift = min(max(-vqg / (vgg + scatter / (pixel / 16 + 1e-18)), -limit), limit)
    return mean_depth + (sq + shift * sg) / n, shift


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _profile_sums(
    points: Any, start: int, stop: int, frame: Any, curve: Any, radius: float, origin: float, farthest: float
) -> Any:
    """Count, and sums of q, q^2, q^3, g, g^2 and q g, g = u/s; q counts from the origin, and no farther than told."""
    x, y, z = points
    cx, cy, cz, tx, ty, tz, sx, sy, sz, ax, ay, az = frame
    bend_side, bend_away, along = curve
    inside = (_RIM * radius) ** 2
    least = (1 - _RIM * _RIM) * radius * radius
    n = sq = sqq = sqqq = sg = sgg = sqg = 0.0
    for i in range(np.uintp(start), np.uintp(stop)):
        dx, dy, dz = x[i] - cx, y[i] - cy, z[i] - cz
        v = tx * dx + ty * dy + tz * dz
        curved = v * v - along
        u = sx * dx + sy * dy + sz * dz - bend_side * curved
        s = np.sqrt(max(radius * radius - u * u, least))
        q = ax * dx + ay * dy + az * dz - bend_away * curved + s
        weight = 1.0 if (u * u < inside) & (q < farthest) else 0.0
        q = weight * (q - origin)
        g = weight * u / s
        n += weight
        sq += q
        sqq += q * q
        sqqq += q * q * q
        sg += g
        sgg += g * g
        sqg += q * g
    return n, sq, sqq, sqqq, sg, sgg, sqg


@njit(cache=True, nogil=True)
def _distance(a: Any, b: Any) -> float:
    return np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


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
