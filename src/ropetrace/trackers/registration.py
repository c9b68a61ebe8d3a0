"""Registration by expectation and maximisation: what CPD, GLTP, SPR, TrackDLO and CDCPD have in common.

The nodes y_m are the centres of a mixture of Gaussians of one variance sigma^2, the points x_n its samples, and a share
mu of the points belongs to none. The nodes move by T = Y + G W, with a kernel G that makes neighbours move alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from ropetrace.types import FloatArray

SMALLEST_VARIANCE = 1e-8
"""sigma^2 does not fall below this, m^2: a tenth of a millimetre, less than any depth camera's noise."""

_FARTHEST_EXPONENT = 40.0
"""Shares e^-40 times that of the nearest node are left out."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Where nodes came to lie.

    Parameters
    ----------
    nodes : (M, 3) float array
        On the visible surface, metres, camera frame.
    variance : float
        sigma^2 at the end, m^2.
    step : float
        Mean distance that the nodes went in the last iteration, metres.
    iterations : int
        How many there were.
    hidden : int
        Nodes that the method took for hidden.
    """

    nodes: FloatArray
    variance: float
    step: float
    iterations: int
    hidden: int = 0


class RegistrationError(Exception):
    """The equations of a registration have no finite solution; no caller of a tracker sees it."""


def first_variance(points: FloatArray, weights: FloatArray, nodes: FloatArray) -> float:
    """sigma^2 before anything is known: the mean squared distance of all points and nodes, over three, m^2.

    Parameters
    ----------
    points : (N, 3) float array
        Metres.
    weights : (N,) float array
        What each counts.
    nodes : (M, 3) float array
        Metres.
    """
    share = weights / weights.sum()
    mean = share @ points
    spread = share @ np.sum((points - mean) ** 2, axis=1) + np.mean(np.sum((nodes - mean) ** 2, axis=1))
    return float(max(spread / 3, SMALLEST_VARIANCE))


def register(
    points: FloatArray,
    weights: FloatArray,
    nodes: FloatArray,
    variance: float,
    kernel: FloatArray,
    *,
    smoothness: float,
    outliers: float,
    max_iterations: int,
    tolerance: float,
    variance_tolerance: float = 0.0,
    topology: float = 0.0,
    alignment: FloatArray | None = None,
    annealing: float = 1.0,
    pull: FloatArray | None = None,
    targets: FloatArray | None = None,
    factors: FloatArray | None = None,
    density: float | None = None,
    arc: FloatArray | None = None,
) -> Fit:
    """Move the nodes to the points.

    With responsibilities P (see `expect`), each iteration solves

        (diag(P1) G + lambda sigma^2 I + tau sigma^2 H G + diag(a) G) W
            = P X - (diag(P1) + tau sigma^2 H) Y + diag(a) (Z - Y)

    and sets T = Y + G W and sigma^2 = [tr(X' diag(P'1) X) - 2 tr((P X)' T) + tr(T' diag(P1) T)] / (3 1'P1).

    Parameters
    ----------
    points : (N, 3) float array
        X, metres.
    weights : (N,) float array
        What each point counts.
    nodes : (M, 3) float array
        Y, metres.
    variance : float
        sigma^2 at the start, m^2.
    kernel : (M, M) float array
        G.
    smoothness : float
        lambda.
    outliers : float
        mu.
    max_iterations : int
        More are not made.
    tolerance : float
        It ends when the nodes' mean step is below this, metres,
    variance_tolerance : float
        or sigma^2 changes by less than this, m^2.
    topology : float
        tau.
    alignment : (M, M) float array, optional
        H: see `ropetrace.trackers.embedding`.
    annealing : float
        lambda and tau are multiplied by this after each iteration.
    pull : (M,) float array, optional
        a, how strongly each node is drawn to its target.
    targets : (M, 3) float array, optional
        Z, metres.
    factors : (M,) float array, optional
        Share of the points that each node expects, relative to the others.
    density : float, optional
        Of the outliers, 1/m^3, over the nodes' factors; M / N if not given.
    arc : (M,) float array, optional
        Places along the rope, metres: measure distances along it, as `expect` says.

    Raises
    ------
    RegistrationError
        If the equations have no finite solution.
    """
    count = len(nodes)
    middle = points.mean(axis=0)
    points, start = points - middle, nodes - middle
    density = count / len(points) if density is None else density
    factors = np.ones(count) if factors is None else factors
    arc = np.empty(0) if arc is None else arc
    bend = np.zeros((count, count)) if alignment is None else topology * alignment
    bend_kernel, bend_start = bend @ kernel, bend @ start
    fixed = np.zeros((count, count)) if pull is None else pull[:, None] * kernel
    wish = np.zeros((count, 3)) if pull is None or targets is None else pull[:, None] * (targets - nodes)
    moved, step, iterations = start, np.inf, 0
    sums, moments = np.empty(count), np.empty((count, 3))
    for iteration in range(max_iterations):
        outside = (2 * np.pi * variance) ** 1.5 * outliers / (1 - outliers) * density
        total, spread = expect(points, weights, moved, variance, outside, factors, arc, sums, moments)
        if not total > 0:
            raise RegistrationError("no point belongs to a node")
        stiff = variance * annealing**iteration
        matrix = sums[:, None] * kernel + stiff * bend_kernel + fixed
        matrix[np.diag_indices(count)] += smoothness * stiff
        right = moments - sums[:, None] * start - stiff * bend_start + wish
        if not solve(matrix, right):
            raise RegistrationError("the equations are singular")
        before, moved = moved, start + kernel @ right
        last = variance
        variance = (spread - 2 * np.sum(moments * moved) + sums @ np.sum(moved**2, axis=1)) / (3 * total)
        if not np.isfinite(variance):
            raise RegistrationError("the nodes run away")
        variance = max(float(variance), SMALLEST_VARIANCE)
        step = float(np.sqrt(np.sum((moved - before) ** 2, axis=1)).mean())
        iterations = iteration + 1
        if step < tolerance or abs(variance - last) < variance_tolerance:
            break
    return Fit(moved + middle, variance, step, iterations)


def expect(
    points: FloatArray,
    weights: FloatArray,
    nodes: FloatArray,
    variance: float,
    outside: float,
    factors: FloatArray,
    arc: FloatArray,
    sums: FloatArray,
    moments: FloatArray,
) -> tuple[float, float]:
    """The E-step: how much of each point belongs to each node.

    p_mn = w_n f_m exp(-d_mn^2 / (2 sigma^2)) / (sum_k f_k exp(-d_kn^2 / (2 sigma^2)) + c)

    d_mn is the distance of point and node. With `arc` it is measured along the rope (Xiang et al., 2023): of the
    nearest node and the nearer of its two neighbours as it is; of a node beyond them as that of the one of the two that
    comes first on the way, and the way from there along the rope.

    Parameters
    ----------
    points : (N, 3) float array
        Metres.
    weights : (N,) float array
        w.
    nodes : (M, 3) float array
        Metres.
    variance : float
        sigma^2, m^2.
    outside : float
        c, the outliers' part.
    factors : (M,) float array
        f.
    arc : (M,) or (0,) float array
        Places of the nodes along the rope, metres.
    sums : (M,) float array
        Takes P1.
    moments : (M, 3) float array
        Takes P X.

    Returns
    -------
    total, spread : float
        1'P1, and tr(X' diag(P'1) X).
    """
    total, spread = _expect(
        points, weights, np.ascontiguousarray(nodes.T), 0.5 / variance, outside, factors, arc, sums, moments
    )
    return float(total), float(spread)


def solve(matrix: FloatArray, right: FloatArray) -> bool:
    """Solve A x = b in place by Gaussian elimination with partial pivoting.

    For the few dozen nodes of a rope this is as fast as LAPACK, and wakes none of its threads.

    Parameters
    ----------
    matrix : (M, M) float array
        A; destroyed.
    right : (M, K) float array
        b; becomes x.

    Returns
    -------
    bool
        Whether there is a finite solution.
    """
    return bool(_solve(matrix, right))


@njit(cache=True, nogil=True, error_model="numpy")
def _expect(
    points: Any,
    weights: Any,
    nodes: Any,
    sharpness: float,
    outside: float,
    factors: Any,
    arc: Any,
    sums: Any,
    moments: Any,
) -> Any:
    count = nodes.shape[1]
    xs, ys, zs = nodes[0], nodes[1], nodes[2]
    shares = np.empty(count)
    sums[:] = 0.0
    moments[:] = 0.0
    total = spread = 0.0
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        for m in range(count):
            shares[m] = (x - xs[m]) ** 2 + (y - ys[m]) ** 2 + (z - zs[m]) ** 2
        best = 0
        for m in range(count):
            if shares[m] < shares[best]:
                best = m
        nearest = shares[best]
        if len(arc) > 0:
            _along_rope(shares, arc, best)
        whole = outside * np.exp(nearest * sharpness) if outside > 0.0 else 0.0
        for m in range(count):
            behind = (shares[m] - nearest) * sharpness
            shares[m] = factors[m] * np.exp(-behind) if behind < _FARTHEST_EXPONENT else 0.0
            whole += shares[m]
        scale = weights[n] / whole
        if not scale > 0.0:
            continue
        belongs = 0.0
        for m in range(count):
            if shares[m] > 0.0:
                share = shares[m] * scale
                sums[m] += share
                moments[m, 0] += share * x
                moments[m, 1] += share * y
                moments[m, 2] += share * z
                belongs += share
        total += belongs
        spread += belongs * (x * x + y * y + z * z)
    return total, spread


@njit(cache=True, nogil=True)
def _along_rope(squared: Any, arc: Any, best: int) -> None:
    """Turn squared distances in space into those along the rope, beyond the two nodes that a point lies between."""
    last = len(squared) - 1
    other = best + 1 if best == 0 or (best < last and squared[best + 1] < squared[best - 1]) else best - 1
    low, high = min(best, other), max(best, other)
    from_low, from_high = np.sqrt(squared[low]), np.sqrt(squared[high])
    for m in range(low):
        squared[m] = (arc[low] - arc[m] + from_low) ** 2
    for m in range(high + 1, last + 1):
        squared[m] = (arc[m] - arc[high] + from_high) ** 2


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(matrix: Any, right: Any) -> bool:
    count = len(matrix)
    for k in range(count):
        pivot = k
        for i in range(k + 1, count):
            if abs(matrix[i, k]) > abs(matrix[pivot, k]):
                pivot = i
        if not abs(matrix[pivot, k]) > 0.0:
            return False
        if pivot != k:
            for j in range(k, count):
                matrix[k, j], matrix[pivot, j] = matrix[pivot, j], matrix[k, j]
            for j in range(right.shape[1]):
                right[k, j], right[pivot, j] = right[pivot, j], right[k, j]
        for i in range(k + 1, count):
            factor = matrix[i, k] / matrix[k, k]
            if factor != 0.0:
                for j in range(k + 1, count):
                    matrix[i, j] -= factor * matrix[k, j]
                for j in range(right.shape[1]):
                    right[i, j] -= factor * right[k, j]
    for k in range(count - 1, -1, -1):
        for j in range(right.shape[1]):
            value = right[k, j]
            for i in range(k + 1, count):
                value -= matrix[k, i] * right[i, j]
            right[k, j] = value / matrix[k, k]
            if not np.isfinite(right[k, j]):
                return False
    return True
