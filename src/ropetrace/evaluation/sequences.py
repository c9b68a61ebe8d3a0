"""What a run of many frames amounts to: statistics, failures, swaps of the ends, and recovery. No frame is left out.

A frame's error is NaN where there was no estimate, and its status is None where there was not even an answer (a frame
that was dropped, or a reading before the first frame was done).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ropetrace.types import FloatArray, Status

BoolArray = NDArray[np.bool_]

RADII = 3.0
"""A curve further than this many radii of the rope from the truth is not on the rope."""


@dataclass(frozen=True, slots=True)
class ErrorStatistics:
    """An error over a run. A frame without an estimate counts as the penalty, in every one of the figures.

    Parameters
    ----------
    count : int
        Frames, those without an estimate included.
    missing : int
        Frames without an estimate.
    penalty : float
        The error that each of them was given.
    mean, std, median, p95, worst : float
        Over all frames. `std` is sqrt(mean((e - mean)^2)), and `p95` the 95th percentile.
    """

    count: int
    missing: int
    penalty: float
    mean: float
    std: float
    median: float
    p95: float
    worst: float

    @classmethod
    def of(cls, errors: FloatArray | Sequence[float], penalty: float) -> Self:
        """The statistics of one error a frame.

        Parameters
        ----------
        errors : (F,) float array
            Magnitudes; NaN or infinite where there is no estimate.
        penalty : float
            The error of a frame without an estimate, in the same unit: the rope's length for a distance, pi for an
            angle. It must be stated, since no figure that leaves these frames out can be compared.

        Raises
        ------
        ValueError
            If there are no frames, an error is negative, or the penalty is not a positive number.
        """
        values = np.asarray(errors, dtype=float)
        if values.ndim != 1 or not len(values):
            raise ValueError(f"errors: shape {values.shape}, expected (F,) with F >= 1")
        if not (math.isfinite(penalty) and penalty > 0):
            raise ValueError(f"penalty = {penalty} must be a positive number: losing the rope is not free")
        found = np.isfinite(values)
        if (values[found] < 0).any():
            raise ValueError("errors: one is negative; take the magnitude of a signed error")
        values = np.where(found, values, penalty)
        return cls(
            count=len(values),
            missing=int(np.count_nonzero(~found)),
            penalty=penalty,
            mean=float(values.mean()),
            std=float(values.std()),
            median=float(np.median(values)),
            p95=float(np.percentile(values, 95)),
            worst=float(values.max()),
        )

    def describe(self, unit: str = "", scale: float = 1.0) -> str:
        """One line, with each figure times the scale: ``describe("mm", 1000)`` for metres."""

        def shown(value: float) -> str:
            return f"{value * scale:.4g}{unit and ' ' + unit}"

        line = (
            f"mean {shown(self.mean)}, std {shown(self.std)}, median {shown(self.median)}, p95 {shown(self.p95)}, "
            f"worst {shown(self.worst)}; {self.count} frames, {self.missing} without an estimate"
        )
        return f"{line}, each counted as {shown(self.penalty)}" if self.missing else line

    def __str__(self) -> str:
        return self.describe()


@dataclass(frozen=True, slots=True)
class EndSwaps:
    """How often the estimate's start went from one true end of the rope to the other.

    Parameters
    ----------
    count : int
        Swaps.
    frames : int
        Frames with an estimate.
    """

    count: int
    frames: int

    @property
    def per_thousand_frames(self) -> float:
        """1000 count / frames; NaN without an estimate."""
        return 1000 * self.count / self.frames if self.frames else math.nan


def end_swaps(reversals: Sequence[bool | None]) -> EndSwaps:
    """Count the changes of direction along a run.

    Parameters
    ----------
    reversals : sequence of bool or None
        `metrics.is_reversed` of each frame. A frame without an estimate (None) is no swap, but its neighbours are
        compared across it; nor does it count as a frame, or a tracker would swap the less the more it loses.
    """
    known = [value for value in reversals if value is not None]
    return EndSwaps(sum(a != b for a, b in itertools.pairwise(known)), len(known))


def frames_without_estimate(statuses: Sequence[Status | None]) -> int:
    """How many frames are lost or have no answer at all."""
    return sum(status is None or status is Status.LOST for status in statuses)


def good_frames(statuses: Sequence[Status | None], symmetric_means: FloatArray, radius: float) -> BoolArray:
    """Frames that found the rope: the status is not lost, and the symmetric mean is below 3 radii.

    Parameters
    ----------
    statuses : sequence of F Status or None
    symmetric_means : (F,) float array
        `metrics.symmetric_mean` of each frame, metres; NaN is not good.
    radius : float
        Of the rope, metres.

    Returns
    -------
    (F,) bool array
    """
    found = np.array([status is not None and status is not Status.LOST for status in statuses], dtype=bool)
    return np.asarray(found & (_one_each(symmetric_means, found) < RADII * radius))


def loss_rate(good: BoolArray) -> float:
    """Share of all frames that did not find the rope (`good_frames`), 0 to 1."""
    return float(1 - np.mean(good))


def false_ok_rate(statuses: Sequence[Status | None], frechet_distances: FloatArray, radius: float) -> float:
    """Share of all frames that claim to be good and are not: P(status = OK and not F <= 3 radii), 0 to 1.

    Parameters
    ----------
    statuses : sequence of F Status or None
    frechet_distances : (F,) float array
        `metrics.discrete_frechet` of each frame, metres. It depends on the direction: give the distance of the reversed
        estimate where only the shape is judged.
    radius : float
        Of the rope, metres.
    """
    claimed = np.array([status is Status.OK for status in statuses], dtype=bool)
    return float(np.mean(claimed & ~(_one_each(frechet_distances, claimed) <= RADII * radius)))


def times_to_recover(stamps_ns: NDArray[np.int64], visible: BoolArray, good: BoolArray) -> FloatArray:
    """From each reappearance of the rope to the first good frame after it.

    A reappearance is a visible frame after one that is not; a rope in view from the first frame on does not reappear.

    Parameters
    ----------
    stamps_ns : (F,) int array
        Stamps of the frames, nanoseconds, in order.
    visible : (F,) bool array
        Whether the rope can be seen.
    good : (F,) bool array
        See `good_frames`.

    Returns
    -------
    (E,) float array
        Seconds, one a reappearance: 0 if its first frame is good, infinite if the rope hides again, or the run ends,
        before there is a good frame.

    Raises
    ------
    ValueError
        If the arrays differ in length or the stamps run back.
    """
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    visible, good = _one_each(visible, stamps).astype(bool), _one_each(good, stamps).astype(bool)
    if (np.diff(stamps) < 0).any():
        raise ValueError("stamps_ns: a stamp runs back")
    times = []
    for first in np.flatnonzero(visible[1:] & ~visible[:-1]) + 1:
        hidden = np.flatnonzero(~visible[first:])
        last = first + hidden[0] if len(hidden) else len(stamps)
        found = np.flatnonzero(good[first:last])
        times.append((stamps[first + found[0]] - stamps[first]) / 1e9 if len(found) else math.inf)
    return np.array(times, dtype=float)


def bootstrap_interval(
    figures: FloatArray | Sequence[float], confidence: float = 0.95, resamples: int = 10_000, seed: int = 0
) -> tuple[float, float]:
    """Confidence interval of the mean over runs, by the percentile bootstrap: runs are drawn with replacement.

    The frames of a run depend on each other, so runs are drawn and not frames. Few runs give too narrow an interval:
    of three, it is about their smallest and largest figure. The same seed gives the same interval.

    Parameters
    ----------
    figures : (R,) float array
        One figure a run, R >= 2: say, the mean error.
    confidence : float
        0 to 1.
    resamples, seed : int
        Draws, and the seed of the generator.

    Returns
    -------
    low, high : float

    Raises
    ------
    ValueError
        With fewer than two runs, or a figure that is not finite.
    """
    values = np.asarray(figures, dtype=float)
    if values.ndim != 1 or len(values) < 2 or not np.isfinite(values).all():
        raise ValueError(f"figures: {values} must be finite numbers of two runs or more")
    draws = np.random.default_rng(seed).integers(0, len(values), (resamples, len(values)))
    low, high = np.percentile(values[draws].mean(axis=1), [50 * (1 - confidence), 50 * (1 + confidence)])
    return float(low), float(high)


def _one_each(values: NDArray[Any], frames: NDArray[Any]) -> NDArray[Any]:
    array = np.asarray(values)
    if array.shape != frames.shape or array.ndim != 1:
        raise ValueError(f"one value a frame is needed: shapes {array.shape} and {frames.shape} differ")
    return array
