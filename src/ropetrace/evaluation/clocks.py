"""The offset between two clocks, from one motion that two systems saw."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from ropetrace.types import FloatArray

_STILL = 0.001
"""What moves by less than this, as a deviation, tells no time, metres."""

_STEP = 0.002
"""Between the offsets that are tried, seconds; the best is refined by a parabola."""

_LEAST = 0.8
"""Signals that agree less than this, as a correlation, are not of one motion."""


def clock_offset(
    times: FloatArray, positions: FloatArray, other_times: FloatArray, other_positions: FloatArray, most: float
) -> float | None:
    """How far the second clock is ahead of the first, by cross-correlation.

    The signals are the positions along the direction in which the second moves most, each less its mean over what both
    have, and the offset is that of their largest correlation. A swing repeats itself: `most` must be less than half its
    period.

    Parameters
    ----------
    times, other_times : (T,), (S,) float array
        Of either clock, ascending, seconds.
    positions, other_positions : (T, 3), (S, 3) float array
        In the same frame, metres, of points that move alike, such as the mean of a cloud and that of the markers. Rows
        of NaN are left out.
    most : float
        Largest offset that is tried, seconds.

    Returns
    -------
    float or None
        Seconds; None where nothing moves, or the signals do not agree.
    """
    found = np.isfinite(positions).all(axis=1)
    times, positions = times[found], positions[found]
    inside = (times - most >= other_times[0]) & (times + most <= other_times[-1])
    if np.count_nonzero(inside) < 10:
        return None
    centred = other_positions - other_positions.mean(axis=0)
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    if np.std(centred @ direction) < _STILL:
        return None
    signal = positions[inside] @ direction
    signal = signal - signal.mean()
    other = CubicSpline(other_times, centred @ direction)
    offsets = np.arange(-round(most / _STEP) - 1, round(most / _STEP) + 2) * _STEP
    # Tried a step beyond the largest offset, so that it can be found itself.
    moved = other(times[inside] + offsets[:, None])
    moved = moved - moved.mean(axis=1, keepdims=True)
    scale = np.linalg.norm(signal) * np.linalg.norm(moved, axis=1)
    agreement = moved @ signal / np.maximum(scale, 1e-300)
    best = int(np.clip(np.argmax(agreement), 1, len(offsets) - 2))
    before, here, after = agreement[best - 1 : best + 2]
    if here < _LEAST:
        return None
    bend = before - 2 * here + after
    return float(offsets[best] + (_STEP * (before - after) / (2 * bend) if bend < 0 else 0.0))
