"""A bank of Kalman filters for the points of a rope that share one clock: the kernels of `arc_length`.

State of each point and axis: position, velocity, acceleration. The acceleration decays with the time constant
`DECAY` (Singer, 1970): a pure constant-acceleration model overshoots whenever the motion turns. The filters of the bank
differ in one number, the agility: the density of the white jerk in units of the measurement noise. The noise itself is
measured: each filter's innovations, normalised by what it expects, give the scale, and how well they then fit gives its
weight. So nothing has to be tuned to a rope or a camera.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

DECAY = 0.3
"""Time constant of the acceleration, seconds."""

AGILITIES = np.geomspace(3e2, 1e6, 8)
"""Root of the density of the white jerk over the standard deviation of a measured position, s^-5/2."""

MEMORY = 0.1
"""Share of the evidence that is forgotten with each frame."""

PRIOR_COUNT = 3.0
"""Frames that the noise assumed at the start counts for."""

FIRST_VELOCITY, FIRST_ACCELERATION = 3.0, 30.0
"""Standard deviations of what is not known yet, m/s and m/s^2."""

NEIGHBOURS = 5.0
"""How far along the rope evidence is shared, in points."""

OUTLIER = 4.0
"""A point further than this many standard deviations from where it is expected is left out ..."""

HARDEST = 50.0
"""... unless a change of its acceleration by this much, m/s^2, explains it: a jerk of the hand does."""


@njit(cache=True, nogil=True)
def transition(dt: float) -> tuple[float, float, float, float]:
    """Over a time: position from velocity and from acceleration, velocity and acceleration from acceleration."""
    fade = -np.expm1(-dt / DECAY)
    return dt, DECAY * (dt - DECAY * fade), DECAY * fade, 1.0 - fade


@njit(cache=True, nogil=True)
def advance(states: Any, spreads: Any, dt: float) -> None:
    """Predict every filter.

    states (K, N, 3, 3): filter, point, derivative, axis. spreads (K, N, 6): the covariance in units of the measurement
    variance, as pp, pv, pa, vv, va, aa. The jerk's part is that without decay, which is never too small.
    """
    f01, f02, f12, f22 = transition(dt)
    for k in range(len(states)):
        jerk = AGILITIES[k] ** 2
        for n in range(states.shape[1]):
            x, p = states[k, n], spreads[k, n]
            for c in range(3):
                x[0, c] += f01 * x[1, c] + f02 * x[2, c]
                x[1, c] += f12 * x[2, c]
                x[2, c] *= f22
            pp, pv, pa, vv, va, aa = p[0], p[1], p[2], p[3], p[4], p[5]
            p[0] = pp + 2 * f01 * pv + 2 * f02 * pa + f01 * f01 * vv + 2 * f01 * f02 * va + f02 * f02 * aa
            p[1] = pv + f01 * vv + f02 * va + f12 * (pa + f01 * va + f02 * aa)
            p[2] = f22 * (pa + f01 * va + f02 * aa)
            p[3] = vv + 2 * f12 * va + f12 * f12 * aa
            p[4] = f22 * (va + f12 * aa)
            p[5] = f22 * f22 * aa
            p[0] += jerk * dt**5 / 20
            p[1] += jerk * dt**4 / 8
            p[2] += jerk * dt**3 / 6
            p[3] += jerk * dt**3 / 3
            p[4] += jerk * dt**2 / 2
            p[5] += jerk * dt


@njit(cache=True, nogil=True)
def outliers(means: Any, covariances: Any, points: Any, unseen: Any, floor: float, measured: Any) -> int:
    """Clear the mask `measured` (N,) where a point is not where the filters together allow it; how many.

    unseen (N,) is the time since each was measured, seconds; `floor`, metres, is never too far.
    """
    count = 0
    for n in range(len(points)):
        if not measured[n]:
            continue
        away = allowed = 0.0
        for c in range(3):
            away += (points[n, c] - means[n, 0, c]) ** 2
            allowed += OUTLIER**2 * covariances[n, c, 0]
        if away > allowed + (floor + HARDEST / 2 * unseen[n] ** 2) ** 2:
            measured[n] = False
            count += 1
    return count


@njit(cache=True, nogil=True)
def correct(states: Any, spreads: Any, evidence: Any, surprise: Any, count: float, points: Any, measured: Any) -> float:
    """Update every filter with the points (N, 3) that are measured.

    evidence (K, N, 3) sums squared innovations over what is expected of them in units of the measurement variance,
    surprise (K, N) the logarithms of that expectation, both forgetting; they are what `weigh` looks at. Returns the
    frames that both amount to.
    """
    squares = np.empty((len(points), 3))
    for k in range(len(states)):
        for n in range(len(points)):
            if not measured[n]:
                squares[n, 0] = -1.0
                continue
            x, p = states[k, n], spreads[k, n]
            expected = p[0] + 1.0
            g0, g1, g2 = p[0] / expected, p[1] / expected, p[2] / expected
            for c in range(3):
                off = points[n, c] - x[0, c]
                x[0, c] += g0 * off
                x[1, c] += g1 * off
                x[2, c] += g2 * off
                squares[n, c] = off * off / expected
            pv, pa = p[1], p[2]
            p[0] /= expected
            p[1] /= expected
            p[2] /= expected
            p[3] -= g1 * pv
            p[4] -= g1 * pa
            p[5] -= g2 * pa
            surprise[k, n] = (1 - MEMORY) * surprise[k, n] + np.log(expected)
        _share(squares)
        for n in range(len(points)):
            for c in range(3):
                evidence[k, n, c] = (1 - MEMORY) * evidence[k, n, c] + squares[n, c]
    return (1 - MEMORY) * count + 1.0


@njit(cache=True, nogil=True)
def _share(squares: Any) -> None:
    """Average along the rope, there and back; what is not measured (negative) takes its neighbours' values."""
    keep = np.exp(-1.0 / NEIGHBOURS)
    count = len(squares)
    first = 0
    while first < count and squares[first, 0] < 0:
        first += 1
    if first == count:
        squares[:] = 0.0
        return
    there = np.empty((count, 3))
    running = squares[first].copy()
    for n in range(count):
        if squares[n, 0] >= 0:
            for c in range(3):
                running[c] = keep * running[c] + (1 - keep) * squares[n, c]
        there[n] = running
    for n in range(count - 1, -1, -1):
        if squares[n, 0] >= 0:
            for c in range(3):
                running[c] = keep * running[c] + (1 - keep) * squares[n, c]
        for c in range(3):
            squares[n, c] = 0.5 * (there[n, c] + running[c])


@njit(cache=True, nogil=True)
def weigh(evidence: Any, surprise: Any, count: float, noise: Any, weights: Any) -> None:
    """The measurement variance that each filter finds, (K, N, 3), m^2, and the filters' weights (K, N)."""
    for n in range(evidence.shape[1]):
        most = -np.inf
        for k in range(len(evidence)):
            fit = -0.5 * 3 * surprise[k, n]
            for c in range(3):
                noise[k, n, c] = max(evidence[k, n, c] / count, 1e-18)
                fit -= 0.5 * count * np.log(noise[k, n, c])
            weights[k, n] = fit
            most = max(most, fit)
        total = 0.0
        for k in range(len(evidence)):
            weights[k, n] = np.exp(weights[k, n] - most)
            total += weights[k, n]
        for k in range(len(evidence)):
            weights[k, n] /= total


@njit(cache=True, nogil=True)
def mixture(states: Any, spreads: Any, noise: Any, weights: Any, means: Any, covariances: Any) -> None:
    """Mean (N, 3, 3) and covariance (N, 3 axes, 6) of the filters together."""
    means[:] = 0.0
    covariances[:] = 0.0
    for n in range(states.shape[1]):
        for k in range(len(states)):
            for d in range(3):
                for c in range(3):
                    means[n, d, c] += weights[k, n] * states[k, n, d, c]
        for k in range(len(states)):
            for c in range(3):
                off0 = states[k, n, 0, c] - means[n, 0, c]
                off1 = states[k, n, 1, c] - means[n, 1, c]
                off2 = states[k, n, 2, c] - means[n, 2, c]
                scale, w, out = noise[k, n, c], weights[k, n], covariances[n, c]
                out[0] += w * (scale * spreads[k, n, 0] + off0 * off0)
                out[1] += w * (scale * spreads[k, n, 1] + off0 * off1)
                out[2] += w * (scale * spreads[k, n, 2] + off0 * off2)
                out[3] += w * (scale * spreads[k, n, 3] + off1 * off1)
                out[4] += w * (scale * spreads[k, n, 4] + off1 * off2)
                out[5] += w * (scale * spreads[k, n, 5] + off2 * off2)


@njit(cache=True, nogil=True)
def jerk_density(noise: Any, weights: Any, density: Any) -> None:
    """Of the white jerk that the filters together expect, (N, 3), m^2/s^5."""
    density[:] = 0.0
    for k in range(len(noise)):
        for n in range(noise.shape[1]):
            for c in range(3):
                density[n, c] += weights[k, n] * noise[k, n, c] * AGILITIES[k] ** 2


@njit(cache=True, nogil=True)
def smoothing_factor(count: int, strength: float) -> Any:
    """Banded Cholesky factor (count, 4) of I + strength D'D, D the third differences: lower rows, diagonal first."""
    matrix = np.zeros((count, 4))
    weights = (-1.0, 3.0, -3.0, 1.0)
    for n in range(count):
        matrix[n, 0] = 1.0
    for first in range(count - 3):
        for i in range(4):
            for j in range(i + 1):
                matrix[first + i, i - j] += strength * weights[i] * weights[j]
    for n in range(count):
        for back in range(min(3, n), -1, -1):
            total = matrix[n, back]
            m = n - back
            for other in range(back + 1, min(3, n) + 1):
                if m - (n - other) >= 0 and other - back <= 3:
                    total -= matrix[n, other] * matrix[m, other - back]
            matrix[n, back] = np.sqrt(total) if back == 0 else total / matrix[m, 0]
    return matrix


@njit(cache=True, nogil=True)
def smooth(factor: Any, values: Any) -> None:
    """Solve with a `smoothing_factor`, in place: values (count, C)."""
    count = len(values)
    for n in range(count):
        for c in range(values.shape[1]):
            total = values[n, c]
            for back in range(1, min(3, n) + 1):
                total -= factor[n, back] * values[n - back, c]
            values[n, c] = total / factor[n, 0]
    for n in range(count - 1, -1, -1):
        for c in range(values.shape[1]):
            total = values[n, c]
            for ahead in range(1, min(3, count - 1 - n) + 1):
                total -= factor[n + ahead, ahead] * values[n + ahead, c]
            values[n, c] = total / factor[n, 0]
