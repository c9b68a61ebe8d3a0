"""How nodes lie among their neighbours: local linear embedding, as matrices that punish a change of it.

Neighbours are those along the rope, not in space: strands that touch are not tied to each other.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ropetrace.types import FloatArray

RIDGE = 1e-3
"""Added to the diagonal of a neighbourhood's Gram matrix, in parts of its trace: it is singular for more than three."""

_FLAT = 1e-9
"""A direction in which a neighbourhood has much less than this part of its squared extent is none; r is this part."""


def linear_weights(nodes: FloatArray, neighbors: int) -> FloatArray:
    """The weights L that best give each node from its neighbours, y_i = sum_j L_ij y_j; rows sum to one.

    Row i is C^-1 1 made to sum to one, with C the Gram matrix of the neighbours as seen from y_i, and `RIDGE` of its
    trace on its diagonal (Roweis and Saul, "Nonlinear dimensionality reduction by locally linear embedding", 2000).
    With three coordinates the inverse of a (3, 3) matrix does.

    Parameters
    ----------
    nodes : (M, 3) float array
        Along the rope, metres.
    neighbors : int
        Half of them on each side; at the ends there are fewer.

    Returns
    -------
    (M, M) float array
        L.
    """
    weights = np.zeros((len(nodes), len(nodes)))
    _linear_weights(np.ascontiguousarray(nodes), max(neighbors // 2, 1), weights)
    return weights


def linear_alignment(nodes: FloatArray, neighbors: int) -> FloatArray:
    """H = (I - L)' (I - L): tr(T' H T) is how badly the `linear_weights` of the nodes suit others, T.

    Parameters
    ----------
    nodes : (M, 3) float array
        Along the rope, metres.
    neighbors : int
        Half of them on each side.
    """
    residual = np.eye(len(nodes)) - linear_weights(nodes, neighbors)
    return np.asarray(residual.T @ residual)


def modified_alignment(nodes: FloatArray, neighbors: int) -> FloatArray:
    """The alignment matrix of the modified local linear embedding, with several weight vectors a neighbourhood.

    Phi = sum_i [-1; W_i] [-1; W_i]' over node i and its neighbours, with W_i = (1 - a) w 1' + V H (Zhang and Wang,
    "MLLE: modified locally linear embedding using multiple weights", NIPS 2006): V spans the null space of the
    neighbours' offsets G_i (3, k), s vectors; w are the ridged weights of `linear_weights`; a = |V'1| / sqrt(s); H is
    the Householder matrix with H V'1 = a 1. As H H = I, the sum needs of V only the projector
    V V' = I - G' (G G' + r I)^-1 G, and s = tr(V V'). Here r is so small that it matters in flat neighbourhoods only,
    where it keeps the null space from leaping. But for the ridge, tr(T' Phi T) is 0 for affine images T of the nodes.

    Parameters
    ----------
    nodes : (M, 3) float array
        Along the rope, metres.
    neighbors : int
        Half of them on each side; at the ends there are fewer.

    Returns
    -------
    (M, M) float array
        Phi.
    """
    alignment = np.zeros((len(nodes), len(nodes)))
    _modified_alignment(np.ascontiguousarray(nodes), max(neighbors // 2, 1), alignment)
    return alignment


@njit(cache=True, nogil=True)
def _neighborhood(nodes: Any, i: int, reach: int) -> Any:
    """The indices of a node's neighbours, and their offsets from it, (k, 3)."""
    first, last = max(i - reach, 0), min(i + reach, len(nodes) - 1)
    indices = np.empty(last - first, np.int64)
    offsets = np.empty((last - first, 3))
    count = 0
    for j in range(first, last + 1):
        if j != i:
            indices[count] = j
            for axis in range(3):
                offsets[count, axis] = nodes[j, axis] - nodes[i, axis]
            count += 1
    return indices, offsets


@njit(cache=True, nogil=True, error_model="numpy")
def _ridged_weights(offsets: Any) -> Any:
    """(C + r I)^-1 1 made to sum to one; by Woodbury's formula (1 - G' (r I + G G')^-1 G 1) / r."""
    trace = np.sum(offsets * offsets)
    if not trace > 0.0:
        return np.full(len(offsets), 1.0 / len(offsets))
    ridge = RIDGE * trace
    inner = np.zeros((3, 3))
    whole = np.zeros(3)
    for j in range(len(offsets)):
        for a in range(3):
            whole[a] += offsets[j, a]
            for b in range(3):
                inner[a, b] += offsets[j, a] * offsets[j, b]
    for a in range(3):
        inner[a, a] += ridge
    solution = _inverse_times(inner, whole)
    weights = np.empty(len(offsets))
    for j in range(len(offsets)):
        weights[j] = 1.0
        for a in range(3):
            weights[j] -= offsets[j, a] * solution[a]
    return weights / np.sum(weights)


@njit(cache=True, nogil=True, error_model="numpy")
def _inverse_times(m: Any, v: Any) -> Any:
    """A (3, 3) matrix's inverse times a vector, by Cramer's rule."""
    result = np.empty(3)
    determinant = (
        m[0, 0] * (m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1])
        - m[0, 1] * (m[1, 0] * m[2, 2] - m[1, 2] * m[2, 0])
        + m[0, 2] * (m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0])
    )
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        result[k] = 0.0
        for row in range(3):
            c, d = (row + 1) % 3, (row + 2) % 3
            result[k] += v[row] * (m[c, a] * m[d, b] - m[c, b] * m[d, a])
        result[k] /= determinant
    return result


@njit(cache=True, nogil=True)
def _linear_weights(nodes: Any, reach: int, weights: Any) -> None:
    for i in range(len(nodes)):
        indices, offsets = _neighborhood(nodes, i, reach)
        row = _ridged_weights(offsets)
        for j in range(len(indices)):
            weights[i, indices[j]] = row[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _softened_rows(offsets: Any) -> Any:
    """Q', (3, k), with Q Q' = G' (G G' + r I)^-1 G for the offsets G', (k, 3).

    Q is the upper part of the orthonormal factor of [G'; sqrt(r) I], by Gram and Schmidt.
    """
    count = len(offsets)
    rows = np.zeros((3, count + 3))
    for a in range(3):
        rows[a, :count] = offsets[:, a]
        rows[a, count + a] = np.sqrt(_FLAT * np.sum(offsets * offsets))
    for a in range(3):
        size = np.sqrt(np.sum(rows[a] * rows[a]))
        rows[a] /= max(size, 1e-300)
        for b in range(a + 1, 3):
            rows[b] -= np.sum(rows[a] * rows[b]) * rows[a]
    return rows[:, :count]


@njit(cache=True, nogil=True, error_model="numpy")
def _modified_alignment(nodes: Any, reach: int, alignment: Any) -> None:
    for i in range(len(nodes)):
        indices, offsets = _neighborhood(nodes, i, reach)
        count = len(indices)
        rows = _softened_rows(offsets)
        several = count - np.sum(rows * rows)
        # V V' 1
        ones = np.ones(count)
        for b in range(3):
            ones -= np.sum(rows[b]) * rows[b]
        share = np.sqrt(np.sum(ones) / max(several, 1e-9))
        if not share > 1e-6:
            continue
        weights = _ridged_weights(offsets)
        totals = (1 - share) * several * weights + ones / share
        alignment[i, i] += several
        for j in range(count):
            alignment[i, indices[j]] -= totals[j]
            alignment[indices[j], i] -= totals[j]
            for k in range(count):
                value = (1.0 if j == k else 0.0) + (1 - share) ** 2 * several * weights[j] * weights[k]
                value += (1 - share) / share * (weights[j] * ones[k] + ones[j] * weights[k])
                for b in range(3):
                    value -= rows[b, j] * rows[b, k]
                alignment[indices[j], indices[k]] += value
