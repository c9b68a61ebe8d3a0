"""From the slices of a rope's visible surface to points on its axis (equation 11, from the geometry)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ropetrace.types import FloatArray, Slices

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
