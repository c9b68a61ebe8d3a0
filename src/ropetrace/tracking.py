"""A tracker run over a recording: where clocks, writers and pictures meet the pure core."""

from __future__ import annotations

import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from ropetrace.centerline import waypoints_through
from ropetrace.errors import FrameError
from ropetrace.motion import MotionEstimator
from ropetrace.results.base import uninterrupted
from ropetrace.trackers.base import Lap, Tracker, no_lap
from ropetrace.types import BadFrame, Cloud, Estimate, Event, FloatArray, Frame, Status, moved


class Sink(Protocol):
    """What takes the estimates of a run: a writer of results, the live viewer, a picture."""

    def write(self, index: int, estimate: Estimate, frame: Frame | None, cloud: Cloud | None) -> None:
        """Take the estimate of one rope in one frame; those of a frame follow one another, with the same cloud."""


@runtime_checkable
class RopesTracker(Tracker, Protocol):
    """A tracker that may follow several ropes."""

    def update_all(self, frame: Frame | BadFrame, lap: Lap = no_lap) -> tuple[Estimate, ...]:
        """As `update`, with an estimate for each rope: at least one, in the order of their `rope`."""


MOST_KEPT = 100_000
"""Figures of each kind that a summary keeps: those of the last hour at 30 frames a second, since some runs last."""


def _figures() -> deque[float]:
    return deque(maxlen=MOST_KEPT)


@dataclass(slots=True)
class RopeSummary:
    """What a run came to for one rope."""

    statuses: Counter[Status] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    points: deque[float] = field(default_factory=_figures)
    nodes: deque[float] = field(default_factory=_figures)
    lengths: deque[float] = field(default_factory=_figures)

    def add(self, estimate: Estimate) -> None:
        """Count one estimate."""
        self.statuses[estimate.status] += 1
        self.reasons.update(_kind(reason) for reason in estimate.reasons)
        if estimate.status is not Status.LOST:
            self.points.append(estimate.point_count)
            self.nodes.append(len(estimate.nodes))
            self.lengths.append(estimate.waypoints.length)

    @property
    def found(self) -> int:
        """Estimates that are not lost."""
        return self.statuses.total() - self.statuses[Status.LOST]

    @property
    def counts(self) -> str:
        """The statuses for people."""
        return ", ".join(f"{self.statuses[status]} {status}" for status in Status)

    def lines(self) -> list[str]:
        """The reasons and sizes for people."""
        lines = [f"          {count} x {reason}" for reason, count in self.reasons.most_common(5)]
        if self.nodes:
            lines += [
                f"points    {np.median(self.points):.0f} a frame (median)",
                f"nodes     {np.median(self.nodes):.0f} a frame (median)",
                f"length    {np.median(self.lengths):.3f} m (median), "
                f"{min(self.lengths):.3f} to {max(self.lengths):.3f} m",
            ]
        return lines


@dataclass(slots=True)
class Summary:
    """What a run came to; prints itself."""

    frames: int = 0
    ropes: dict[int, RopeSummary] = field(default_factory=lambda: defaultdict(RopeSummary))
    stage_seconds: dict[str, deque[float]] = field(default_factory=lambda: defaultdict(_figures))
    latency_seconds: deque[float] = field(default_factory=_figures)
    interrupted: bool = False

    def add(self, *estimates: Estimate) -> None:
        """Count one frame, with the estimates of its ropes."""
        self.frames += 1
        for estimate in estimates:
            self.ropes[estimate.rope].add(estimate)

    @property
    def found(self) -> int:
        """Estimates that are not lost, of all ropes."""
        return sum(rope.found for rope in self.ropes.values())

    def lines(self) -> list[str]:
        """The summary for people."""
        if len(self.ropes) > 1:
            lines = [f"frames    {self.frames}"]
            for number, rope in sorted(self.ropes.items()):
                lines += [f"rope {number:<4d} {rope.counts}", *rope.lines()]
        else:
            rope = next(iter(self.ropes.values()), RopeSummary())
            lines = [f"frames    {self.frames} ({rope.counts})", *rope.lines()]
        if self.frames > MOST_KEPT:
            lines.append(f"          sizes, times and latency are of the last {MOST_KEPT} frames")
        if self.stage_seconds:
            lines.append("time      stage            p50 ms   p99 ms")
            first = 0.0
            for stage, seconds in self.stage_seconds.items():
                # The first two frames wait for the compiler, or for its cache: they are not like the others.
                kept = list(seconds)
                first += sum(kept[:2])
                p50, p99 = np.percentile(np.array(kept[2:] or kept) * 1e3, [50, 99])
                lines.append(f"          {stage:14s} {p50:8.3f} {p99:8.3f}")
            if self.frames <= MOST_KEPT:
                lines.append(
                    f"          without the first two frames, which took {first:.2f} s with the start of the kernels"
                )
        if self.latency_seconds:
            kept = list(self.latency_seconds)
            p50, p99 = np.percentile(np.array(kept[2:] or kept) * 1e3, [50, 99])
            lines.append(f"latency   from the stamp to the estimate: p50 {p50:.1f} ms, p99 {p99:.1f} ms")
        return lines


def _kind(reason: str) -> str:
    """A reason without its figures, so that like reasons are counted together."""
    return " ".join("#" if any(c.isdigit() for c in word) and len(word) < 12 else word for word in reason.split())


def track_recording(
    frames: Iterable[Event],
    tracker: Tracker,
    sinks: Iterable[Sink] = (),
    *,
    motion: MotionEstimator | Callable[[], MotionEstimator | None] | None = None,
    predict: float | Literal["now"] = 0.0,
    first_index: int = 0,
    world_from_camera: FloatArray | None = None,
    wants_cloud: bool = False,
    age: Callable[[], float] | None = None,
    on_frame: Callable[[Estimate], None] | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Summary:
    """Track every frame and hand the estimates on.

    Parameters
    ----------
    frames : iterable
        Such as `Recording.frames`.
    tracker : Tracker or RopesTracker
        Takes them.
    sinks : iterable of Sink
        Each is given every estimate.
    motion : MotionEstimator or callable, optional
        Gives the waypoints their velocities and accelerations. Where there are several ropes: what makes an estimator,
        called once for each.
    predict : float or "now"
        Hand on the centreline of this many seconds after the frame's stamp, or of the moment at which it is handed on,
        by `age`: then the results depend on how fast this machine was.
    first_index : int
        Index of the first frame in its recording.
    world_from_camera : (4, 4) float array, optional
        Hand the estimates on in the world's frame.
    wants_cloud : bool
        Whether the sinks are given the points and their nodes.
    age : callable, optional
        Seconds since the stamp of the frame that was read last, for a live source; kept in the summary. Without it,
        frames count as if they came at their stamps.
    on_frame : callable, optional
        Told of the first estimate of each frame, for a progress bar.
    should_stop : callable
        Asked before each frame; the run then ends as if it was interrupted.

    Returns
    -------
    Summary
        With the times of every stage. An interruption by the user ends the run and is told there.

    Raises
    ------
    OutputError
        If a sink cannot write.
    ValueError
        If there are several ropes and `motion` is the estimator of one.
    """
    sinks = list(sinks)
    summary = Summary()
    motions = _Motions(motion)
    iterator = iter(frames)
    index = first_index
    try:
        while True:
            if should_stop():
                raise KeyboardInterrupt
            watch = _Stopwatch(summary.stage_seconds)
            event = next(iterator, None)
            if event is None:
                break
            watch.lap("read")
            came = time.perf_counter()
            seconds_old = age or partial(_seconds_since, came)
            estimates = estimates_of(event, tracker, sorted(summary.ropes) or [0], watch.lap)
            if motion is not None:
                estimates = tuple(
                    _moving(estimate, motions.of(estimate.rope), predict, seconds_old) for estimate in estimates
                )
                watch.lap("motion")
            if world_from_camera is not None:
                estimates = tuple(in_world(estimate, world_from_camera) for estimate in estimates)
            if age is not None and not isinstance(event, BadFrame):
                summary.latency_seconds.append(age())
            cloud = tracker.cloud() if wants_cloud and not isinstance(event, BadFrame) else None
            if cloud is not None and world_from_camera is not None:
                cloud = Cloud(moved(cloud.points, world_from_camera), cloud.node)
            watch.lap("")
            # A frame is in all results and in the summary, or in none.
            with uninterrupted():
                for sink in sinks:
                    for estimate in estimates:
                        sink.write(index, estimate, None if isinstance(event, BadFrame) else event, cloud)
                summary.add(*estimates)
            if sinks:
                watch.lap("write")
            if on_frame is not None:
                on_frame(estimates[0])
            index += 1
    except KeyboardInterrupt:
        summary.interrupted = True
    return summary


class _Motions:
    """An estimator of motion for each rope: the one that is given, or what the given function makes."""

    def __init__(self, motion: MotionEstimator | Callable[[], MotionEstimator | None] | None) -> None:
        self._motion = motion
        self._of_rope: dict[int, MotionEstimator | None] = {}

    def of(self, rope: int) -> MotionEstimator | None:
        if rope not in self._of_rope:
            if not callable(self._motion) and self._of_rope:
                raise ValueError(f"rope {rope} needs an estimator of motion of its own: give what makes one")
            self._of_rope[rope] = self._motion() if callable(self._motion) else self._motion
        return self._of_rope[rope]


def _moving(
    estimate: Estimate,
    motion: MotionEstimator | None,
    predict: float | Literal["now"],
    seconds_old: Callable[[], float],
) -> Estimate:
    """The estimate with its motion, predicted if that is asked for."""
    if motion is None:
        return estimate
    estimate = with_motion(estimate, motion)
    if not predict:
        return estimate
    return ahead_of_time(estimate, motion, seconds_old() if predict == "now" else predict)


def _seconds_since(came: float) -> float:
    return time.perf_counter() - came


def with_motion(estimate: Estimate, motion: MotionEstimator) -> Estimate:
    """The estimate with the motion of its waypoints, which the estimator is told of."""
    if not len(estimate.waypoints):
        return estimate
    return replace(estimate, motion=motion.update(estimate.stamp_ns, estimate.waypoints))


def ahead_of_time(estimate: Estimate, motion: MotionEstimator, ahead: float) -> Estimate:
    """The estimate that `motion` took last, `ahead` seconds later; as it is where its motion is not known."""
    prediction = None if estimate.motion is None else motion.predict(ahead)
    if prediction is None:
        return estimate
    positions, moving = prediction
    return replace(
        estimate,
        waypoints=waypoints_through(positions, estimate.waypoints),
        motion=moving,
        ahead_ns=round(ahead * 1e9),
    )


def in_world(estimate: Estimate, world_from_camera: FloatArray) -> Estimate:
    """The estimate with its positions, orientations and motion in the world's frame."""
    motion = estimate.motion
    return replace(
        estimate,
        nodes=moved(estimate.nodes, world_from_camera),
        waypoints=estimate.waypoints.transformed(world_from_camera),
        motion=None if motion is None else motion.rotated(world_from_camera),
    )


def estimates_of(event: Event, tracker: Tracker, ropes: list[int], lap: Lap = no_lap) -> tuple[Estimate, ...]:
    """The estimate of each rope; `ropes` are those so far, all lost in a frame that cannot be used."""
    try:
        if isinstance(tracker, RopesTracker):
            return tracker.update_all(event, lap)
        return (tracker.update(event, lap),)
    except FrameError as error:
        return tuple(Estimate.lost(event.stamp_ns, str(error), rope=rope) for rope in ropes)


class _Stopwatch:
    """Adds the time since the last lap to a stage's list; a stage without a name is not kept."""

    def __init__(self, stages: dict[str, deque[float]]) -> None:
        self._stages = stages
        self._since = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        if stage:
            self._stages[stage].append(now - self._since)
        self._since = now
