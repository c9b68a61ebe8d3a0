"""Several trackers on the same frames: one run of a method on a case, and the figures that it amounts to.

A run starts its tracker afresh, and the tracker starts by itself from the first frame. What a tracker raises ends its
run and is kept with it; the frames that are left count as frames without an estimate, like those that are lost.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ropetrace.config import RopeConfig
from ropetrace.errors import FrameError
from ropetrace.evaluation.metrics import (
    at_equal_arc_length,
    coverage,
    curve_length,
    discrete_frechet,
    is_reversed,
    node_errors,
    symmetric_mean,
    tip_errors,
)
from ropetrace.evaluation.sequences import (
    ErrorStatistics,
    end_swaps,
    false_ok_rate,
    frames_without_estimate,
)
from ropetrace.suite import Case, Truth
from ropetrace.trackers import Tracker, make_tracker
from ropetrace.types import Estimate, Event, FloatArray, Status

COVERED = 0.010
"""Within this distance the true curve is covered, metres."""

_VERTICES = 128
"""Of the curves that are kept for pictures and for the distances between methods."""

_LOOKED_AT = 30
"""About so many frames of a run are searched for those that differ most."""

_WARM_UP = 2
"""First frames whose time is not counted: they wait for the compiler, or for its cache."""


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A method on a case, frame by frame; what is not known is NaN.

    Parameters
    ----------
    stamp_ns : (F,) int64 array
        Stamps of the frames, nanoseconds.
    status : (F,) str array
        `ropetrace.Status`; empty from the frame on at which the method failed.
    seconds : (F,) float array
        Of the tracker for the frame.
    length : (F,) float array
        Of the estimate, metres.
    true_length, visible : (F,) float array
        Of the rope, metres, and the share of it that the camera sees.
    symmetric, node, frechet, tip_start, tip_end : (F,) float array
        `metrics.symmetric_mean`, mean of `metrics.node_errors`, `metrics.discrete_frechet` and `metrics.tip_errors`,
        metres. The last four depend on the direction: that of most of the run's frames is taken for right.
    covered : (F,) float array
        `metrics.coverage` at 10 mm; 0 without an estimate.
    flipped : (F,) int64 array
        1 where the estimate runs against the direction that is taken for right, 0 where it does not, -1 without one.
    curve, truth : (F, 128, 3) float32 array
        Estimate and truth at equal arc length, metres, camera frame.
    failure : () str array
        What the method raised; empty if nothing.
    """

    stamp_ns: NDArray[np.int64]
    status: NDArray[np.str_]
    seconds: FloatArray
    length: FloatArray
    true_length: FloatArray
    visible: FloatArray
    symmetric: FloatArray
    node: FloatArray
    frechet: FloatArray
    tip_start: FloatArray
    tip_end: FloatArray
    covered: FloatArray
    flipped: NDArray[np.int64]
    curve: NDArray[np.float32]
    truth: NDArray[np.float32]
    failure: NDArray[np.str_]

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @property
    def has_truth(self) -> bool:
        """Whether every frame has its truth."""
        return len(self) > 0 and bool(np.isfinite(self.true_length).all())

    @property
    def statuses(self) -> list[Status | None]:
        """None from the frame on at which the method failed."""
        return [Status(status) if status else None for status in self.status.tolist()]


@dataclass(frozen=True, slots=True)
class Figures:
    """What a run amounts to. Frames without an estimate count with the penalty, the rope's true length.

    Parameters
    ----------
    frames : int
        All of them, which every share and every mean is over.
    p50_ms, p99_ms : float
        Time of a frame, without the first two.
    symmetric, node, tip_start, tip_end : ErrorStatistics, optional
        Metres; None without truth.
    covered : float
        Mean share of the true curve within 10 mm.
    length_error : float
        Mean of |L / L_true - 1|, 1 where there is no estimate.
    swaps, lost, degraded : int
        Swaps of the ends, frames without an estimate, frames that are `degraded`.
    false_ok : float
        Share of the frames that are `ok` though the Fréchet distance is more than 3 radii.
    length_median, length_std : float
        Of the estimates' lengths, metres, over the frames that have one.
    failure : str
        What the method raised; empty if nothing.
    """

    frames: int
    p50_ms: float
    p99_ms: float
    symmetric: ErrorStatistics | None
    node: ErrorStatistics | None
    tip_start: ErrorStatistics | None
    tip_end: ErrorStatistics | None
    covered: float
    length_error: float
    swaps: int
    lost: int
    degraded: int
    false_ok: float
    length_median: float
    length_std: float
    failure: str

    @classmethod
    def of(cls, run: Run, radius: float) -> Figures:
        """The figures of a run.

        Parameters
        ----------
        run : Run
            Of one frame at least.
        radius : float
            Of the rope, metres.
        """
        timed = run.seconds[_WARM_UP:] if len(run) > _WARM_UP else run.seconds
        timed = timed[np.isfinite(timed)] * 1e3
        p50, p99 = np.percentile(timed, [50, 99]).tolist() if len(timed) else (math.nan, math.nan)
        found = run.length[np.isfinite(run.length)]
        known = run.has_truth
        penalty = float(run.true_length.mean()) if known else 1.0

        def statistics(errors: FloatArray) -> ErrorStatistics | None:
            return ErrorStatistics.of(errors, penalty) if known else None

        missed = np.abs(run.length / run.true_length - 1)
        return cls(
            frames=len(run),
            p50_ms=p50,
            p99_ms=p99,
            symmetric=statistics(run.symmetric),
            node=statistics(run.node),
            tip_start=statistics(run.tip_start),
            tip_end=statistics(run.tip_end),
            covered=float(run.covered.mean()) if known else math.nan,
            length_error=float(np.where(np.isfinite(missed), missed, 1.0).mean()) if known else math.nan,
            swaps=end_swaps([None if flip < 0 else bool(flip) for flip in run.flipped.tolist()]).count,
            lost=frames_without_estimate(run.statuses),
            degraded=int(np.count_nonzero(run.status == Status.DEGRADED)),
            false_ok=false_ok_rate(run.statuses, run.frechet, radius) if known else math.nan,
            length_median=float(np.median(found)) if len(found) else math.nan,
            length_std=float(found.std()) if len(found) else math.nan,
            failure=str(run.failure),
        )


def run_method(
    case: Case, config: RopeConfig, limit: int | None = None, on_frame: Callable[[], object] = lambda: None
) -> Run:
    """A method on a case. It raises nothing that the method raises.

    Parameters
    ----------
    case : Case
        The frames.
    config : RopeConfig
        Its `method` is run.
    limit : int, optional
        Frames to use at most.
    on_frame : callable
        Is called after each frame.
    """
    follower = _Follower(config)
    frames: list[_Frame] = []
    for event, truth in case.frames(limit):
        began = time.perf_counter()
        estimate = follower.update(event)
        seconds = math.nan if estimate is None else time.perf_counter() - began
        line = np.empty((0, 3)) if estimate is None else estimate.waypoints.positions.copy()
        frames.append(_Frame(event.stamp_ns, None if estimate is None else estimate.status, seconds, line, truth))
        on_frame()
    return _measured(frames, follower.failure)


def run_of_failure(
    case: Case, failure: str, limit: int | None = None, on_frame: Callable[[], object] = lambda: None
) -> Run:
    """The run of a method of which nothing is known but why it failed; for the rest see `run_method`."""
    frames = []
    for event, truth in case.frames(limit):
        frames.append(_Frame(event.stamp_ns, None, math.nan, np.empty((0, 3)), truth))
        on_frame()
    return _measured(frames, failure)


class _Follower:
    """A tracker that may fail."""

    def __init__(self, config: RopeConfig) -> None:
        self.failure = ""
        self._tracker: Tracker | None = None
        try:
            self._tracker = make_tracker(config)
        except Exception as error:
            self._failed(error)

    def update(self, event: Event) -> Estimate | None:
        """The estimate; None if the tracker failed, now or before."""
        if self._tracker is None:
            return None
        try:
            estimate = self._tracker.update(event)
            if not np.isfinite(estimate.waypoints.positions).all():
                raise ValueError("a waypoint is not finite")
        except FrameError as error:
            return Estimate.lost(event.stamp_ns, str(error))
        except Exception as error:
            self._failed(error)
            return None
        return estimate

    def _failed(self, error: Exception) -> None:
        self._tracker = None
        words = " ".join(str(error).split())
        self.failure = f"{type(error).__name__}: {words[:200]}" if words else type(error).__name__


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """What is known of a frame after the tracker had it."""

    stamp_ns: int
    status: Status | None
    seconds: float
    line: FloatArray
    truth: Truth | None


def _measured(frames: Sequence[_Frame], failure: str) -> Run:
    """Compare every frame with its truth."""
    flips = [_flip(frame) for frame in frames]
    against = flips.count(1) > flips.count(0)
    columns: dict[str, list[Any]] = {item.name: [] for item in fields(Run)}
    for frame, flip in zip(frames, flips, strict=True):
        row: dict[str, Any] = {
            "stamp_ns": frame.stamp_ns,
            "status": "" if frame.status is None else str(frame.status),
            "seconds": frame.seconds,
            "length": curve_length(frame.line) if len(frame.line) > 1 else math.nan,
            "flipped": flip if flip < 0 else int(bool(flip) != against),
            "curve": _kept(frame.line),
            **_errors(frame.line[::-1] if against else frame.line, frame.truth),
        }
        for name, value in row.items():
            columns[name].append(value)
    columns.pop("failure")
    kinds = {"stamp_ns": np.int64, "status": np.str_, "flipped": np.int64, "curve": np.float32, "truth": np.float32}
    arrays: dict[str, Any] = {name: np.array(values, kinds.get(name, float)) for name, values in columns.items()}
    return Run(**arrays, failure=np.array(failure))


def _flip(frame: _Frame) -> int:
    """1 if the estimate runs from the true end to the true start, 0 if not, -1 if that is not known."""
    reverse = None if frame.truth is None else is_reversed(frame.line, frame.truth.polyline)
    return -1 if reverse is None else int(reverse)


def _errors(line: FloatArray, truth: Truth | None) -> dict[str, Any]:
    if truth is None:
        unknown = ("true_length", "visible", "symmetric", "node", "frechet", "tip_start", "tip_end", "covered")
        return {**dict.fromkeys(unknown, math.nan), "truth": _kept(np.empty((0, 3)))}
    start, end = tip_errors(line, truth.polyline)
    return {
        "true_length": curve_length(truth.polyline),
        "visible": truth.visible_fraction,
        "symmetric": symmetric_mean(line, truth.polyline),
        "node": float(node_errors(line, truth.polyline).mean()),
        "frechet": discrete_frechet(line, truth.polyline),
        "tip_start": start,
        "tip_end": end,
        "covered": coverage(line, truth.polyline, COVERED),
        "truth": _kept(truth.polyline),
    }


def _kept(line: FloatArray) -> FloatArray:
    return at_equal_arc_length(line, _VERTICES) if len(line) > 1 else np.full((_VERTICES, 3), math.nan)


def disagreements(first: Run, second: Run, frames: NDArray[np.int64] | None = None) -> FloatArray:
    """Symmetric mean distance between two methods in each frame, or some; metres, NaN where one has no estimate."""
    chosen = slice(None) if frames is None else frames
    return np.array(
        [
            symmetric_mean(one.astype(float), other.astype(float), 0.005)
            if np.isfinite(one).all() and np.isfinite(other).all()
            else math.nan
            for one, other in zip(first.curve[chosen], second.curve[chosen], strict=True)
        ]
    )


def telling_frames(runs: Sequence[Run], most: int = 3) -> list[int]:
    """The frames in which the methods differ most, in order; of one method, those in which it is most in error.

    A frame counts by the largest distance between two methods that have an estimate. The frames are a tenth of the run
    apart at least, so that they do not show the same moment again and again.
    """
    if not runs or not len(runs[0]):
        return []
    looked_at = np.arange(0, len(runs[0]), max(len(runs[0]) // _LOOKED_AT, 1))
    pairs = [disagreements(a, b, looked_at) for k, a in enumerate(runs) for b in runs[k + 1 :]]
    worst = np.nan_to_num(np.array(pairs or [runs[0].symmetric[looked_at]]), nan=0.0).max(axis=0)
    chosen: list[int] = []
    for index in looked_at[np.argsort(-worst, kind="stable")].tolist():
        if all(abs(index - other) >= max(len(runs[0]) // 10, 1) for other in chosen):
            chosen.append(index)
        if len(chosen) == most:
            break
    return sorted(chosen)
