"""The motion of a rope that does not stretch: what is measured along it is noise, but for its sliding as a whole."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def make_inextensible(points: Any, velocities: Any, accelerations: Any, seen: Any) -> None:
    """Correct velocities and accelerations along a rope until no part of it stretches, in place; each (N, 3), N >= 2.

    The distance of neighbours stays what it is if their relative velocity is across the step between them, and if their
    relative acceleration along it is -|relative velocity|^2 over the distance. Both are met by moving the points'
    values along the rope: the correction is summed up from the start, and its mean over the points that are seen, (N,)
    bool, left at zero, so that the rope slides along itself as it did.
    """
    count = len(points)
    steps = np.zeros((count + 1, 3))
    slide, push = np.zeros(count), np.zeros(count)
    for n in range(count - 1):
        size = 0.0
        for c in range(3):
            steps[n + 1, c] = points[n + 1, c] - points[n, c]
            size += steps[n + 1, c] ** 2
        size = np.sqrt(size)
        stretch = along = across = 0.0
        for c in range(3):
            steps[n + 1, c] /= max(size, 1e-12)
            stretch += (velocities[n + 1, c] - velocities[n, c]) * steps[n + 1, c]
            along += (accelerations[n + 1, c] - accelerations[n, c]) * steps[n + 1, c]
        for c in range(3):
            across += (velocities[n + 1, c] - velocities[n, c] - stretch * steps[n + 1, c]) ** 2
        slide[n + 1] = slide[n] - stretch
        push[n + 1] = push[n] - along - across / max(size, 1e-12)
    steps[0], steps[count] = steps[1], steps[count - 1]
    if seen.any():
        slide -= slide[seen].mean()
        push -= push[seen].mean()
    for n in range(count):
        size = 0.0
        for c in range(3):
            size += (steps[n, c] + steps[n + 1, c]) ** 2
        size = max(np.sqrt(size), 1e-12)
        for c in range(3):
            tangent = (steps[n, c] + steps[n + 1, c]) / size
            velocities[n, c] += slide[n] * tangent
            accelerations[n, c] += push[n] * tangent
