"""From the tool's wanted velocity to the joints' (section 5.2, equations 23-28), and within the joints' bounds.

J is the geometric Jacobian of `Arm`: (6, n), rows 0-2 in m/rad, rows 3-5 in rad/rad. Its singular values mix the two:
they, and what is decided by them, stand for an arm of about a metre's reach, where 1 m/s and 1 rad/s are alike.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from ropetrace.types import FloatArray

if TYPE_CHECKING:
    from ropetrace.control.arm import JointLimits

THRESHOLD = 0.04
"""Singular value below which the inverse is damped. At random poses of a Panda a quarter are below it."""

GREATEST_DAMPING = 0.02
"""Damping at a singular pose: 0.1 m/s then asks a Panda's joints for 1.1 times their speed at the very worst."""

_RANK = 1e-10
"""Singular values smaller than this, relative to the largest, count as zero."""

_DEPENDENT = 1e-12
"""Squared length below which what is left of a direction in the null space is rounding."""

_ROUNDING = 1e-12
"""Bounds that are broken by less than this, relative to the velocities, hold."""

_MOST_MARGIN = 1e-6
"""More of the scale than this is not given away to rounding, before the whole motion is slowed down as one."""


def jacobian_derivatives(jacobian: FloatArray) -> FloatArray:
    """How the Jacobian changes with each joint: the dJ/dq_i of equation 25.

    With z_j the axis of joint j and v_j the velocity that it gives the tool (column j of J, lower and upper half),
    column j of dJ/dq_i is [z_i x v_j; z_i x z_j] for i <= j and [z_j x v_i; 0] for i > j.

    Parameters
    ----------
    jacobian : (6, n) float array
        Of revolute joints.

    Returns
    -------
    (n, 6, n) float array
        dJ/dq_i at index i.
    """
    derivatives = np.empty((np.shape(jacobian)[-1], 6, np.shape(jacobian)[-1]))
    _jacobian_derivatives(_jacobian(jacobian), derivatives)
    return derivatives


def manipulability(jacobian: FloatArray) -> float:
    """Yoshikawa's measure of manipulability, sqrt(det(J J^T)) (equation 24).

    As the product of the singular values: never the root of a determinant that rounding made negative. 0 for an arm of
    fewer than six joints.

    Parameters
    ----------
    jacobian : (6, n) float array
    """
    return float(_manipulability(_jacobian(jacobian)))


def manipulability_gradient(jacobian: FloatArray) -> FloatArray:
    """Gradient of the measure of manipulability by the joints, (n,) (equation 25).

    With the singular values s_m and vectors u_m, v_m of J, equation 25 is the sum over m of
    (product of the other s) u_m^T dJ/dq_i v_m. Nothing is divided, so that it needs no damping: at a singular pose,
    where equation 25 is 0/0, it is the slope away from the pose to one of its sides.

    Parameters
    ----------
    jacobian : (6, n) float array
        Of revolute joints.
    """
    gradient = np.empty(np.shape(jacobian)[-1])
    _manipulability_gradient(_jacobian(jacobian), gradient)
    return gradient


def joint_limit_measure(q: FloatArray, limits: JointLimits) -> float:
    """How near the joints are to the ends of their ranges: 0 in the middle, -1/8 for each at an end (equation 26).

    Parameters
    ----------
    q : (n,) float array
        Joint angles, rad.
    limits : JointLimits
    """
    offset = (2 * q - (limits.upper + limits.lower)) / (2 * (limits.upper - limits.lower))
    return float(-0.5 * np.sum(offset**2))


def joint_limit_gradient(q: FloatArray, limits: JointLimits) -> FloatArray:
    """Gradient of `joint_limit_measure`, (n,), 1/rad (equation 27).

    Parameters
    ----------
    q : (n,) float array
        Joint angles, rad.
    limits : JointLimits
    """
    return np.asarray((limits.upper + limits.lower - 2 * q) / (2 * (limits.upper - limits.lower) ** 2))


def secondary_velocity(q: FloatArray, jacobian: FloatArray, limits: JointLimits, k_s: float, k_jl: float) -> FloatArray:
    """Joint velocities away from singular poses and from the ends of the joints' ranges (equation 23).

    Parameters
    ----------
    q : (n,) float array
        Joint angles, rad.
    jacobian : (6, n) float array
        At q.
    limits : JointLimits
    k_s, k_jl : float
        Weights of the gradients of manipulability and of the joints' limits.

    Returns
    -------
    (n,) float array
        rad/s.
    """
    matrix = _jacobian(jacobian)
    count = matrix.shape[1]
    velocities = np.empty(count)
    _secondary_velocity(
        _vector("q", q, count),
        matrix,
        _vector("limits.lower", limits.lower, count),
        _vector("limits.upper", limits.upper, count),
        float(k_s),
        float(k_jl),
        velocities,
    )
    return velocities


def damped_pseudoinverse(
    jacobian: FloatArray, threshold: float = THRESHOLD, greatest_damping: float = GREATEST_DAMPING
) -> FloatArray:
    """The pseudo-inverse, damped where the pose is nearly singular.

    Each singular value s below the threshold s0 is inverted as s / (s^2 + d^2), d^2 = d0^2 (1 - (s / s0)^2), after
    Nakamura and Chiaverini: continuous, and bounded where 1 / s is not. All others are inverted exactly.

    Parameters
    ----------
    jacobian : (6, n) float array
    threshold : float
        s0. It compares metres with radians: see the head of this module.
    greatest_damping : float
        d0. 0 for the exact pseudo-inverse.

    Returns
    -------
    (n, 6) float array
    """
    matrix = _jacobian(jacobian)
    inverse = np.empty(matrix.shape[::-1])
    _damped_pseudoinverse(matrix, float(threshold), float(greatest_damping), inverse)
    return inverse


def joint_velocities(
    jacobian: FloatArray,
    twist: FloatArray,
    secondary: FloatArray,
    threshold: float = THRESHOLD,
    greatest_damping: float = GREATEST_DAMPING,
) -> FloatArray:
    """Joint velocities for a wanted twist of the tool, and for a secondary wish as far as that is free (equation 28).

    J^+ is `damped_pseudoinverse`. I - J^+ J would let the wish disturb the twist where it is damped: the wish is
    projected on the true null space of J instead, which is the same where nothing is damped.

    Parameters
    ----------
    jacobian : (6, n) float array
    twist : (6,) float array
        Velocity, m/s, and angular velocity, rad/s, along the axes of the Jacobian.
    secondary : (n,) float array
        Wanted joint velocities, rad/s (equation 23).
    threshold, greatest_damping : float
        See `damped_pseudoinverse`.

    Returns
    -------
    (n,) float array
        rad/s.

    Raises
    ------
    ValueError
        If shapes do not fit or a number is not finite.
    """
    matrix = _jacobian(jacobian)
    primary, null, wish = _parts(
        matrix,
        _vector("twist", twist, 6),
        _vector("secondary", secondary, matrix.shape[1]),
        float(threshold),
        float(greatest_damping),
    )
    return np.asarray(_velocities(primary, null, wish, 1.0))


def joint_velocities_within(
    jacobian: FloatArray,
    twist: FloatArray,
    secondary: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    threshold: float = THRESHOLD,
    greatest_damping: float = GREATEST_DAMPING,
) -> tuple[FloatArray, float]:
    """Equation 28 within bounds on the joints' velocities: saturation in the null space (beyond the paper).

    Where `joint_velocities` breaks a bound, the joint that breaks it most is held at it and the others take over its
    part, as in Flacco, De Luca and Khatib (2012, 2015): first the secondary wish gives way, as little as it can. Where
    no joint is left to take over, the twist is slowed down by the largest factor that can be done, its direction kept.
    A joint is let go again where that serves (a dual active set), and the joints that block each other say exactly how
    large the factor is, so that the result is the optimum: the largest factor, then the joint velocities nearest to
    those of equation 28 at that factor.

    Parameters
    ----------
    jacobian : (6, n) float array
    twist : (6,) float array
        Velocity, m/s, and angular velocity, rad/s, along the axes of the Jacobian.
    secondary : (n,) float array
        Wanted joint velocities, rad/s.
    lower, upper : (n,) float array
        Bounds of the joints' velocities, rad/s, lower <= 0 <= upper.
    threshold, greatest_damping : float
        See `damped_pseudoinverse`. What is kept in direction is the twist of equation 28: where that is damped, not all
        of the wanted one.

    Returns
    -------
    velocities : (n,) float array
        rad/s: finite and inside the bounds, whatever was asked.
    scale : float
        0 to 1, the part of the twist that is done. 0, with all joints at rest, also where numbers overflow.

    Raises
    ------
    ValueError
        If shapes do not fit, a number is not finite, or the bounds exclude 0.
    """
    matrix = _jacobian(jacobian)
    count = matrix.shape[1]
    velocities, scale = _within(
        matrix,
        _vector("twist", twist, 6),
        _vector("secondary", secondary, count),
        _vector("lower", lower, count),
        _vector("upper", upper, count),
        float(threshold),
        float(greatest_damping),
    )
    return velocities, scale


def _jacobian(values: FloatArray) -> FloatArray:
    matrix = np.ascontiguousarray(values, dtype=np.float64)
    if matrix.ndim != 2 or matrix.shape[0] != 6 or not matrix.shape[1]:
        raise ValueError(f"the Jacobian has shape {matrix.shape}: expected (6, n)")
    return matrix


def _vector(name: str, values: FloatArray, count: int) -> FloatArray:
    vector = np.ascontiguousarray(values, dtype=np.float64)
    if vector.shape != (count,):
        raise ValueError(f"{name} has shape {vector.shape}: expected ({count},)")
    return vector


@njit(cache=True, nogil=True)
def _cross(a: Any, b: Any, result: Any) -> None:
    result[0] = a[1] * b[2] - a[2] * b[1]
    result[1] = a[2] * b[0] - a[0] * b[2]
    result[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True, nogil=True)
def _jacobian_derivatives(jacobian: Any, derivatives: Any) -> None:
    count = jacobian.shape[1]
    for i in range(count):
        for j in range(count):
            column = derivatives[i, :, j]
            first, second = min(i, j), max(i, j)
            _cross(jacobian[3:, first], jacobian[:3, second], column[:3])
            if i <= j:
                _cross(jacobian[3:, i], jacobian[3:, j], column[3:])
            else:
                column[3:] = 0.0


@njit(cache=True, nogil=True)
def _manipulability(jacobian: Any) -> float:
    if jacobian.shape[1] < 6:
        return 0.0
    return np.prod(np.linalg.svd(jacobian)[1])


@njit(cache=True, nogil=True)
def _manipulability_gradient(jacobian: Any, gradient: Any) -> None:
    count = jacobian.shape[1]
    gradient[:] = 0.0
    if count < 6:
        return
    left, sizes, right = np.linalg.svd(jacobian)
    slopes = np.zeros((6, count))
    for m in range(6):
        others = 1.0
        for k in range(6):
            if k != m:
                others *= sizes[k]
        for r in range(6):
            for j in range(count):
                slopes[r, j] += others * left[r, m] * right[m, j]
    derivatives = np.empty((count, 6, count))
    _jacobian_derivatives(jacobian, derivatives)
    for i in range(count):
        for r in range(6):
            for j in range(count):
                gradient[i] += derivatives[i, r, j] * slopes[r, j]


@njit(cache=True, nogil=True)
def _secondary_velocity(
    q: Any, jacobian: Any, lower: Any, upper: Any, k_s: float, k_jl: float, velocities: Any
) -> None:
    _manipulability_gradient(jacobian, velocities)
    for i in range(len(q)):
        limit_slope = (upper[i] + lower[i] - 2 * q[i]) / (2 * (upper[i] - lower[i]) ** 2)
        velocities[i] = k_s * velocities[i] + k_jl * limit_slope


@njit(cache=True, nogil=True)
def _decompose(jacobian: Any, threshold: float, greatest_damping: float) -> Any:
    """Left and right singular vectors, the damped inverses of the singular values, and the rank."""
    left, sizes, right = np.linalg.svd(jacobian)
    inverses = np.zeros(len(sizes))
    rank = 0
    for m in range(len(sizes)):
        if sizes[m] > _RANK * sizes[0]:
            rank = m + 1
            damping = 0.0
            if sizes[m] < threshold:
                damping = greatest_damping**2 * (1 - (sizes[m] / threshold) ** 2)
            inverses[m] = 1 / (sizes[m] + damping / sizes[m])
    return left, inverses, right, rank


@njit(cache=True, nogil=True)
def _damped_pseudoinverse(jacobian: Any, threshold: float, greatest_damping: float, inverse: Any) -> None:
    left, inverses, right, rank = _decompose(jacobian, threshold, greatest_damping)
    inverse[:] = 0.0
    for m in range(rank):
        for i in range(inverse.shape[0]):
            for r in range(6):
                inverse[i, r] += inverses[m] * right[m, i] * left[r, m]


@njit(cache=True, nogil=True)
def _parts(jacobian: Any, twist: Any, secondary: Any, threshold: float, greatest_damping: float) -> Any:
    """What the twist asks of the joints, (n,), a basis of the null space, (n, k), and the wish in it, (k,)."""
    if not (np.isfinite(jacobian).all() and np.isfinite(twist).all() and np.isfinite(secondary).all()):
        raise ValueError("the Jacobian, the twist or the secondary velocity is not finite")
    count = jacobian.shape[1]
    left, inverses, right, rank = _decompose(jacobian, threshold, greatest_damping)
    primary = np.zeros(count)
    for m in range(rank):
        part = 0.0
        for r in range(6):
            part += left[r, m] * twist[r]
        for i in range(count):
            primary[i] += inverses[m] * part * right[m, i]
    null = np.ascontiguousarray(right[rank:].T)
    wish = np.zeros(count - rank)
    for k in range(count - rank):
        for i in range(count):
            wish[k] += null[i, k] * secondary[i]
    return primary, null, wish


@njit(cache=True, nogil=True)
def _velocities(primary: Any, null: Any, free: Any, scale: float) -> Any:
    velocities = np.empty(len(primary))
    for i in range(len(primary)):
        velocities[i] = scale * primary[i]
        for k in range(len(free)):
            velocities[i] += null[i, k] * free[k]
    return velocities


@njit(cache=True, nogil=True)
def _within(
    jacobian: Any, twist: Any, secondary: Any, lower: Any, upper: Any, threshold: float, greatest_damping: float
) -> Any:
    for i in range(len(lower)):
        if not (lower[i] <= 0 <= upper[i] and np.isfinite(lower[i]) and np.isfinite(upper[i])):
            raise ValueError("the bounds of the joints' velocities must be finite, lower <= 0 <= upper")
    primary, null, wish = _parts(jacobian, twist, secondary, threshold, greatest_damping)
    velocities = _velocities(primary, null, wish, 1.0)
    if not np.isfinite(velocities).all():
        return np.zeros(len(primary)), 0.0
    if ((velocities >= lower) & (velocities <= upper)).all():
        return velocities, 1.0

    scale, margin = 1.0, _ROUNDING
    free = wish.copy()
    done, limit = _nearest(primary, null, wish, lower, upper, scale, free)
    while not done and limit >= 0 and margin < _MOST_MARGIN:
        if limit >= scale * (1 - margin):
            limit = scale * (1 - margin)
            margin *= 10
        scale = limit
        done, limit = _nearest(primary, null, wish, lower, upper, scale, free)
    if not done:
        free[:] = 0.0
        for i in range(len(primary)):
            if primary[i] != 0:
                scale = min(scale, (upper[i] if primary[i] > 0 else lower[i]) / primary[i])
    velocities = _velocities(primary, null, free, scale)
    return np.minimum(np.maximum(velocities, lower), upper), scale


@njit(cache=True, nogil=True)
def _nearest(primary: Any, null: Any, wish: Any, lower: Any, upper: Any, scale: float, free: Any) -> Any:
    """The motion in the null space nearest to the wish at which all joints are inside their bounds.

    Goldfarb and Idnani's dual method: the bound that is broken most is made to hold, then the next, and one that holds
    the result back is let go. Where a bound can be met by none of this, the sum of it and the bounds in its way, each
    by its weight, is a bound on the scale alone.

    Returns whether there is such a motion, written to `free`, and else the limit of the scale.
    """
    count, size = null.shape
    held = np.empty(size, np.int64)
    signs, weights, shares = np.empty(size), np.empty(size), np.empty(size)
    basis, triangle = np.empty((size, size)), np.empty((size, size))
    normal, rest = np.empty(size), np.empty(size)
    number = 0
    free[:] = wish
    for _ in range(40 * count):
        worst, sign, excess, extent = -1, 1.0, 0.0, 0.0
        for i in range(count):
            value, spread = scale * primary[i], abs(scale * primary[i])
            for k in range(size):
                value += null[i, k] * free[k]
                spread += abs(null[i, k] * free[k])
            extent = max(extent, spread)
            if value - upper[i] > excess:
                worst, sign, excess = i, 1.0, value - upper[i]
            if lower[i] - value > excess:
                worst, sign, excess = i, -1.0, lower[i] - value
        if excess <= _ROUNDING * extent:
            return True, scale
        for k in range(size):
            normal[k] = sign * null[worst, k]
        weight = 0.0
        while True:
            _project(normal, null, held, signs, number, basis, triangle, rest, shares)
            length = 0.0
            for k in range(size):
                length += rest[k] * rest[k]
            step, leaving = np.inf, -1
            for m in range(number):
                if shares[m] > _DEPENDENT and weights[m] / shares[m] < step:
                    step, leaving = weights[m] / shares[m], m
            if length > _DEPENDENT:
                whole = excess / length
                if whole <= step:
                    step, leaving = whole, -1
            elif leaving < 0:
                room = sign * (upper[worst] if sign > 0 else lower[worst])
                demand = sign * primary[worst]
                for m in range(number):
                    i, share = held[m], max(-shares[m], 0.0)
                    room += share * signs[m] * (upper[i] if signs[m] > 0 else lower[i])
                    demand += share * signs[m] * primary[i]
                return False, room / demand if demand > 0 else -1.0
            else:
                length, rest[:] = 0.0, 0.0
            for k in range(size):
                free[k] -= step * rest[k]
            excess -= step * length
            weight += step
            for m in range(number):
                weights[m] -= step * shares[m]
            if leaving < 0:
                held[number], signs[number], weights[number] = worst, sign, weight
                number += 1
                break
            number -= 1
            for m in range(leaving, number):
                held[m], signs[m], weights[m] = held[m + 1], signs[m + 1], weights[m + 1]
    return False, -1.0


@njit(cache=True, nogil=True)
def _project(
    normal: Any, null: Any, held: Any, signs: Any, number: int, basis: Any, triangle: Any, rest: Any, shares: Any
) -> None:
    """Split a normal into shares of those that are held, and the rest, at right angles to them (Gram-Schmidt)."""
    for m in range(number):
        for k in range(len(normal)):
            basis[m, k] = signs[m] * null[held[m], k]
        _straighten(basis, m, basis[m], triangle[m])
        length = np.sqrt((basis[m] ** 2).sum())
        triangle[m, m] = length
        basis[m] /= length
    rest[:] = normal
    _straighten(basis, number, rest, shares)
    for row in range(number - 1, -1, -1):
        for m in range(row + 1, number):
            shares[row] -= triangle[m, row] * shares[m]
        shares[row] /= triangle[row, row]


@njit(cache=True, nogil=True)
def _straighten(basis: Any, number: int, vector: Any, parts: Any) -> None:
    """Take from a vector its parts along the first rows of an orthonormal basis; twice, against rounding."""
    parts[:number] = 0.0
    for _ in range(2):
        for row in range(number):
            part = 0.0
            for k in range(len(vector)):
                part += basis[row, k] * vector[k]
            parts[row] += part
            for k in range(len(vector)):
                vector[k] -= part * basis[row, k]
