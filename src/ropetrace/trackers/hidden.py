"""The nodes of a rope that is seen in part: one banded least-squares problem.

What is seen stays where it is seen. What is hidden stays where it was expected, as far as its length, its bending and
the free space that the camera sees allow.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ropetrace.types import FloatArray

_SEEN = 0.001
"""Standard deviation of a node that is seen, metres."""

_EXPECTED = 0.03
"""Standard deviation of a hidden node from where it was expected, per frame, metres."""

_PUSHED = 0.015
"""Standard deviation of a node from the place it is pushed to out of free space, metres."""

_STRETCH = 3e-4
"""Standard deviation of the distance of two neighbours, metres."""

_STIFFNESS = 8.0
"""A hidden stretch bends back to where it was expected over this many diameters."""

_MOST_STEPS = 6
_SETTLED = 1e-5
"""The iteration ends when no coordinate moves by more than this, metres."""

_BAND = 9
"""A node's coordinates depend on those of the next two nodes."""


def fill_hidden(
    expected: FloatArray,
    seen: NDArray[np.bool_],
    measured: FloatArray,
    pushed: NDArray[np.bool_],
    targets: FloatArray,
    spacing: float,
    diameter: float,
) -> FloatArray:
    """The nodes of a rope, (M, 3), metres, that fit what is seen, what was expected, and the rope itself.

    The sum of squares of five kinds of residuals, each over its standard deviation, is made least by Gauss and Newton's
    method: of seen nodes from where they are measured; of hidden ones from where they were expected; of those that were
    expected in free space from the places they are pushed to; of neighbours from their distance along the rope; and the
    second differences, whose weight is such that a stretch bends back over `_STIFFNESS` diameters.

    Parameters
    ----------
    expected : (M, 3) float array
        Metres.
    seen : (M,) bool array
        Which nodes are seen.
    measured : (M, 3) float array
        Where those are, metres; the others' rows count for nothing.
    pushed : (M,) bool array
        Which nodes are pushed.
    targets : (M, 3) float array
        Where to, metres.
    spacing : float
        Arc length between nodes, metres.
    diameter : float
        Of the rope, metres.
    """
    nodes = np.where(seen[:, None], measured, expected)
    anchors = np.where(seen, 1 / _SEEN**2, 1 / _EXPECTED**2)
    pushes = np.where(pushed & ~seen, 1 / _PUSHED**2, 0.0)
    bending = (_STIFFNESS * diameter / spacing) ** 4 / _EXPECTED**2
    _fill(nodes, nodes.copy(), anchors, targets, pushes, spacing, 1 / _STRETCH**2, bending)
    return nodes


@njit(cache=True, nogil=True)
def _fill(
    nodes: Any, anchor: Any, anchors: Any, targets: Any, pushes: Any, spacing: float, stretch: float, bending: float
) -> None:
    size = 3 * len(nodes)
    matrix, right = np.empty((size, _BAND)), np.empty(size)
    for _ in range(_MOST_STEPS):
        matrix[:] = 0.0
        for i in range(len(nodes)):
            for k in range(3):
                matrix[3 * i + k, 0] = anchors[i] + pushes[i]
                right[3 * i + k] = anchors[i] * (anchor[i, k] - nodes[i, k])
                right[3 * i + k] += pushes[i] * (targets[i, k] - nodes[i, k])
        _add_bending(nodes, bending, matrix, right)
        _add_stretch(nodes, spacing, stretch, matrix, right)
        _solve(matrix, right)
        most = 0.0
        for i in range(len(nodes)):
            for k in range(3):
                nodes[i, k] += right[3 * i + k]
                most = max(most, abs(right[3 * i + k]))
        if most < _SETTLED:
            break


@njit(cache=True, nogil=True)
def _add_bending(nodes: Any, weight: float, matrix: Any, right: Any) -> None:
    factors = (1.0, -2.0, 1.0)
    for i in range(1, len(nodes) - 1):
        for k in range(3):
            second = nodes[i - 1, k] - 2 * nodes[i, k] + nodes[i + 1, k]
            for a in range(3):
                row = 3 * (i - 1 + a) + k
                right[row] -= factors[a] * weight * second
                for b in range(a + 1):
                    matrix[row, 3 * (a - b)] += factors[a] * factors[b] * weight


@njit(cache=True, nogil=True)
def _add_stretch(nodes: Any, spacing: float, weight: float, matrix: Any, right: Any) -> None:
    along = np.empty(3)
    for i in range(len(nodes) - 1):
        size = 0.0
        for k in range(3):
            along[k] = nodes[i + 1, k] - nodes[i, k]
            size += along[k] ** 2
        size = np.sqrt(size)
        if size < 1e-9:
            continue
        for k in range(3):
            along[k] /= size
        for k in range(3):
            right[3 * i + k] += weight * (size - spacing) * along[k]
            right[3 * i + 3 + k] -= weight * (size - spacing) * along[k]
            for m in range(3):
                both = weight * along[k] * along[m]
                if m <= k:
                    matrix[3 * i + k, k - m] += both
                    matrix[3 * i + 3 + k, k - m] += both
                matrix[3 * i + 3 + k, 3 + k - m] -= both


@njit(cache=True, nogil=True)
def _solve(matrix: Any, right: Any) -> None:
    """Solve a symmetric banded system by Cholesky's method, in place: row i holds column i - j at j."""
    size = len(right)
    for i in range(size):
        for j in range(min(_BAND - 1, i), -1, -1):
            column = i - j
            value = matrix[i, j]
            for q in range(max(0, i - _BAND + 1), column):
                value -= matrix[i, i - q] * matrix[column, column - q]
            matrix[i, j] = value / matrix[column, 0] if j else np.sqrt(max(value, 1e-12))
    for i in range(size):
        for q in range(max(0, i - _BAND + 1), i):
            right[i] -= matrix[i, i - q] * right[q]
        right[i] /= matrix[i, 0]
    for i in range(size - 1, -1, -1):
        for q in range(i + 1, min(size, i + _BAND)):
            right[i] -= matrix[q, q - i] * right[q]
        right[i] /= matrix[i, 0]
