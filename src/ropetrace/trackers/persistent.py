"""The rope as a whole, kept from frame to frame: also where it is hidden, crosses itself, or lies beside others.

Each frame is sliced as in the paper. The slices make strands, which `placement` lays along the rope as it is expected
by its motion; where the rope is seen, the estimate is what slicing makes of it. What is hidden is kept where it was
going, as far as the rope's length, its bending, and the free space in the depth image allow (`hidden`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ropetrace.centerline import make_waypoints
from ropetrace.config import RopeConfig
from ropetrace.ordering import runs_backwards, starts_at_end
from ropetrace.trackers.base import Lap, Mask, no_lap
from ropetrace.trackers.clouds import arc_lengths, evenly_along, interpolated, nearest_distances, nearest_nodes
from ropetrace.trackers.doubts import KINK, Doubts, sharpest_turn
from ropetrace.trackers.placement import SAME_LENGTH, Expected, Placed, place
from ropetrace.trackers.sight import is_behind, looked_through, sees_past
from ropetrace.trackers.slicing import (
    A_SURFACE,
    BRIDGE_DIAMETERS,
    SURFACE_NEIGHBOURS,
    SlicingTracker,
    thinned,
    too_little,
    too_many,
)
from ropetrace.trackers.strands import BREAK, Path, Strand, path_through, sliced_apart, strand_of, strands_of
from ropetrace.trackers.whole_rope import (
    MOST_SIGMA,
    Laid,
    WholeRope,
    advance,
    chain_of,
    laid_along,
    told_of_waypoints,
)
from ropetrace.types import BadFrame, Cloud, Estimate, FloatArray, Frame, Status

_OTHER_LENGTH_AFTER = 0.3
"""A clear strand of another length that is seen for longer than this is what the rope is, seconds."""

_MISSING = 3.0
"""A node that is farther than this from all that is seen is missing, diameters;"""

_SEEN_MISSING = 0.7
"""and a rope has got shorter if the camera looks through at least this share of the places where it is missing."""

_AGREES = 1.5
"""A strand that may hold a wrong turn must lie this close to where the rope is expected, in standard deviations."""

_LONGEST_PAUSE = 10.0
"""A longer pause between two frames counts as this, seconds: clocks leap."""

_LONGEST_FRAME = 0.1
"""A frame speaks for no more than this of another length, seconds."""

_ASTRAY_AFTER = 0.2
"""When most of what is seen has belonged to no rope for this long, the ropes may be anywhere near, seconds."""

_WHOLLY_HIDDEN = 1.0
"""How long a rope that is behind something in all its length is still told of, seconds."""

_LOOKED_THROUGH = 0.5
"""Where the camera looks through a larger share of its nodes, it is somewhere else."""

_BEHIND = 0.7
"""Share of a gap that something nearer must hide for the rope to go on beyond it."""

_SEEN_PAST = 0.3
"""Where the camera sees past a larger share of a gap, no rope goes over it."""

_SMALLEST_GAP = 0.5
"""Where there may be several ropes, one goes over a gap that is wider than this, in diameters, only straight on."""

_STRAIGHT = 0.3
"""Cosine of the sharpest turn into and out of a gap that nothing hides."""

_FREE = 0.2
"""A larger share of the rope that should be seen and is not is worth telling."""

_ODD = 4.0
"""A strand that belongs to no rope is worth telling if it is longer than this, diameters."""

MOST_ROPES = 32
"""Where all ropes that are seen are looked for, no more than this are taken up: none is ever given up again."""

_NEW_ROPE = 10.0
"""A strand that belongs to no rope must be this long to be another, diameters."""

_POSITION_SIGMA = 0.15
"""Standard deviation of what is seen along each axis, diameters: most of it is where along the rope a point is."""


@dataclass(slots=True, eq=False)
class _View:
    """A frame, sliced."""

    frame: Frame
    points: FloatArray
    count: int
    stride: int
    reasons: list[str]
    path: Path | None = None
    strands: list[Strand] = field(default_factory=list)


class PersistentTracker:
    """Follows ropes through occlusion, crossings and one another.

    Parameters
    ----------
    config : RopeConfig
        Settings; what is None is derived from the diameter.
    mask : array or callable, optional
        Replaces the colour gate; the position box still holds.
    """

    def __init__(self, config: RopeConfig, mask: Mask | None = None) -> None:
        self.config = config.resolved()
        self._slicing = SlicingTracker(config, mask)
        self.reset()

    def reset(self) -> None:
        """Forget the frames so far."""
        self._slicing.reset()
        self._doubts = Doubts(self.config.diameter)
        self._ropes: list[WholeRope] = []
        self._stamp_ns: int | None = None
        self._astray = self._odd_for = 0.0
        self._points: FloatArray = np.empty((3, 0))
        self._found: FloatArray | None = None

    def update(self, frame: Frame | BadFrame, lap: Lap = no_lap) -> Estimate:
        """The estimate of the first rope in one frame; of a bad frame, that it is lost.

        Raises
        ------
        FrameError
            If colour is asked for and the frame has none, or the mask does not fit the frame.
        """
        return self.update_all(frame, lap)[0]

    def update_all(self, frame: Frame | BadFrame, lap: Lap = no_lap) -> tuple[Estimate, ...]:
        """The estimates of all ropes in one frame; otherwise as `update`."""
        self._points, self._found = np.empty((3, 0)), None
        if isinstance(frame, BadFrame):
            return self._all_lost(frame.stamp_ns, frame.reason)
        view = self._look_at(frame, lap)
        elapsed = self._elapsed(frame.stamp_ns)
        estimates = self._go_on(view, elapsed) if self._ropes else self._start(view)
        lap("centerline")
        return estimates

    def cloud(self) -> Cloud:
        """The points of the last frame, each with the node of the first rope that is near: a copy."""
        points = self._points.T.copy()
        if self._found is None:
            return Cloud(points, np.full(len(points), -1, np.int32))
        near = nearest_distances(points, self._found) < 2 * self.config.diameter
        return Cloud(points, np.where(near, nearest_nodes(points, self._found), -1).astype(np.int32))

    def _look_at(self, frame: Frame, lap: Lap) -> _View:
        reasons = self._doubts.of_stamp(frame.stamp_ns)
        points, count, stride = self._slicing.rope_points(frame)
        self._points = points
        if stride > 1:
            reasons.append(thinned(count, stride))
        lap("segmentation")
        view = _View(frame, points, count, stride, reasons)
        slices = self._slicing.slicer.slice(points)
        if self.config.ropes != 1:
            # One cut through several ropes can run along one of them.
            slices = sliced_apart(points, slices, self._slicing.slicer, BREAK * self.config.diameter)
        lap("slicing")
        if slices.capped:
            reasons.append(too_many(self._slicing.slicer.max_nodes))
        if len(slices) < 2:
            return view
        diameter = self.config.diameter
        view.path = path_through(slices, diameter)
        if view.path.touching >= SURFACE_NEIGHBOURS:
            reasons.append(A_SURFACE)
        if self._ropes:
            view.strands = strands_of(view.path, points, frame, diameter, self.config.slicing.surface_offset)
            if view.strands:
                reasons += self._doubts.of_widths(np.concatenate([strand.widths for strand in view.strands]))
        lap("ordering")
        return view

    def _elapsed(self, stamp_ns: int) -> float:
        """Seconds since the frame before; 0 where the stamps do not say."""
        before, self._stamp_ns = self._stamp_ns, stamp_ns
        return 0.0 if before is None else min(max((stamp_ns - before) * 1e-9, 0.0), _LONGEST_PAUSE)

    # --- the first view of a rope ---

    def _start(self, view: _View) -> tuple[Estimate, ...]:
        path = view.path
        pieces = [] if path is None else self._pieces(path, view.frame)
        if path is None or not pieces:
            few = too_little(view.points.shape[1], 0 if path is None else len(path.slices))
            return self._all_lost(view.frame.stamp_ns, few, view.count)
        wanted = MOST_ROPES if self.config.ropes == "auto" else self.config.ropes
        left_out = len(path.slices) - sum(len(run) for piece in pieces[:wanted] for run in piece)
        if left_out:
            view.reasons.append(
                f"{left_out} of {len(path.slices)} slices are left out: something else of that colour, or a hidden part"
            )
        offset = self.config.slicing.surface_offset
        for piece in pieces[:wanted]:
            strands = [
                strand_of(path.slices.kept(run), view.points, view.frame, self.config.diameter, offset) for run in piece
            ]
            doubts = []
            if any(path.unsure[run].any() for run in piece):
                doubts.append("strands overlapped when the rope was first seen: the order there may be wrong")
            self._ropes.append(self._begun(strands, doubts))
        view.reasons += self._doubts.of_widths(np.concatenate([rope.first[0].strand.widths for rope in self._ropes]))
        return self._reports(view, [rope.first for rope in self._ropes])

    def _pieces(self, path: Path, frame: Frame) -> list[list[NDArray[np.int64]]]:
        """Ropes that the path may be, the largest first: each in runs of slices between which it is not seen.

        The path goes on over a gap if that is short, or if something nearer hides it.
        """
        diameter, slices = self.config.diameter, path.slices
        least = BREAK if self.config.ropes == 1 else _SMALLEST_GAP
        pieces: list[list[NDArray[np.int64]]] = [[]]
        for run in np.split(np.arange(len(slices)), np.flatnonzero(path.gaps > least * diameter) + 1):
            if run[0] and not self._goes_on(path, int(run[0]), frame):
                pieces.append([])
            pieces[-1].append(run)
        pieces = [[run for run in piece if len(run) > 1] for piece in pieces]
        if self.config.ropes == "auto":
            pieces = [piece for piece in pieces if sum(map(len, piece)) >= _NEW_ROPE]
        pieces.sort(key=lambda piece: -sum(int(slices.counts[run].sum()) for run in piece))
        return [piece for piece in pieces if piece]

    def _goes_on(self, path: Path, after: int, frame: Frame) -> bool:
        """Whether the rope goes on over the gap before a slice."""
        diameter, centroids = self.config.diameter, path.slices.centroids
        max_gap = self.config.ordering.max_gap
        assert max_gap is not None
        between = evenly_along(centroids[after - 1 : after + 1], 9)[1:-1]
        if is_behind(frame, between, diameter).mean() > _BEHIND:
            return True
        if path.gaps[after - 1] > max_gap or sees_past(frame, between, diameter).mean() > _SEEN_PAST:
            return False
        if after < 2 or after > len(centroids) - 2:
            return True
        step = centroids[after] - centroids[after - 1]
        straight = [
            float(side @ step) > _STRAIGHT * float(np.linalg.norm(side) * np.linalg.norm(step))
            for side in (centroids[after - 1] - centroids[after - 2], centroids[after + 1] - centroids[after])
        ]
        return all(straight)

    def _begun(self, strands: Sequence[Strand], doubts: list[str]) -> WholeRope:
        """A rope of strands that follow each other, from the end that the settings call its start."""
        chain = np.concatenate([strand.chain for strand in strands])
        if starts_at_end(chain, self.config.ordering.first_point):
            strands = [strand.reversed() for strand in strands[::-1]]
        laid: list[Laid] = []
        for strand in strands:
            gap = float(np.linalg.norm(strand.chain[0] - laid[-1].strand.chain[-1])) if laid else 0.0
            laid.append(Laid(strand, laid[-1].end + gap if laid else 0.0, 1.0, True))
        return WholeRope.begun(laid, self.config.diameter, doubts)

    # --- all further frames ---

    def _go_on(self, view: _View, elapsed: float) -> tuple[Estimate, ...]:
        diameter = self.config.diameter
        expected = [rope.expected(elapsed, diameter) for rope in self._ropes]
        if self._astray > _ASTRAY_AFTER:
            expected = [replace(rope, sigma=np.full(len(rope.sigma), MOST_SIGMA)) for rope in expected]
        placed = self._placed(view, expected, elapsed)
        used = {one.index for one in placed}
        odd = [strand for index, strand in enumerate(view.strands) if index not in used]
        length, odd_length = (sum(strand.length for strand in some) for some in ([one.strand for one in placed], odd))
        self._astray = self._astray + elapsed if odd_length > length else 0.0
        if odd_length > _ODD * diameter:
            view.reasons.append(f"{odd_length:.2f} m of something else of that colour is left out")
        self._add_rope(odd, elapsed, view)
        laid = []
        for number, (rope, there) in enumerate(zip(self._ropes, expected, strict=False)):
            its = laid_along([one for one in placed if one.rope == number], there, diameter)
            advance(rope, its, there, view.frame, elapsed, diameter)
            laid.append(its)
        laid += [rope.first for rope in self._ropes[len(laid) :]]
        return self._reports(view, laid)

    def _placed(self, view: _View, expected: list[Expected], elapsed: float) -> list[Placed]:
        whole = self._whole(view) if len(expected) == 1 else None
        if whole is None or view.path is None:
            self._ropes[0].other_length_for = 0.0
            return place(view.strands, expected, self.config.diameter)
        # A rope that is seen from end to end needs no prediction but to tell its ends apart.
        rope = self._ropes[0]
        is_forwards = not runs_backwards(whole.nodes, expected[0].nodes)
        if not is_forwards:
            whole = whole.reversed()
        if abs(whole.length - rope.length) > SAME_LENGTH * rope.length + 2 * self.config.diameter:
            if rope.views and not self._has_that_length(rope, whole, view, elapsed):
                return place(view.strands, expected, self.config.diameter)
            rope.begin_again([Laid(whole, 0.0, 1.0, True)], self.config.diameter)
            expected[0] = rope.expected(0.0, self.config.diameter)
        elif view.path.unsure.any() and not _agrees(whole, expected[0]):
            return place(view.strands, expected, self.config.diameter)
        rope.other_length_for = 0.0
        if not view.path.unsure.any():
            rope.doubts = []
        view.strands = [whole]
        return [Placed(whole, is_forwards, 0, 0, 0.0, (True, True), whole.length)]

    def _has_that_length(self, rope: WholeRope, whole: Strand, view: _View, elapsed: float) -> bool:
        """Whether a rope has long been seen from end to end at another length, and nothing hides what is missing."""
        if view.path is None or view.path.unsure.any():
            return False
        if whole.length < rope.length:
            missing = rope.nodes[nearest_distances(rope.nodes, whole.nodes) > _MISSING * self.config.diameter]
            if not len(missing) or looked_through(view.frame, missing, self.config.diameter).mean() < _SEEN_MISSING:
                rope.other_length_for = 0.0
                return False
        rope.other_length_for += min(elapsed, _LONGEST_FRAME)
        return rope.other_length_for > _OTHER_LENGTH_AFTER

    def _whole(self, view: _View) -> Strand | None:
        """All that is seen as one strand, if it has no break and both ends are clear."""
        diameter = self.config.diameter
        if view.path is None or (view.path.gaps > BREAK * diameter).any():
            return None
        if view.path.unsure.any():
            strand = strand_of(view.path.slices, view.points, view.frame, diameter, self.config.slicing.surface_offset)
        else:
            strand = view.strands[0]
        return strand if all(strand.clear) else None

    def _add_rope(self, odd: list[Strand], elapsed: float, view: _View) -> None:
        """Another rope, if one is still looked for and a strand has belonged to none for a while."""
        wanted = MOST_ROPES if self.config.ropes == "auto" else self.config.ropes
        longest = max(odd, key=lambda strand: strand.length, default=None)
        is_new = longest is not None and longest.length > _NEW_ROPE * self.config.diameter
        self._odd_for = self._odd_for + elapsed if is_new else 0.0
        if longest is None or self._odd_for <= _ASTRAY_AFTER:
            return
        if len(self._ropes) >= wanted:
            if self.config.ropes == "auto":
                view.reasons.append(f"{MOST_ROPES} ropes are followed already: no more are taken up")
            return
        self._odd_for = 0.0
        self._ropes.append(self._begun([longest], []))

    # --- what is told ---

    def _reports(self, view: _View, laid: list[list[Laid]]) -> tuple[Estimate, ...]:
        estimates = [
            self._report(view, number, rope, its)
            for number, (rope, its) in enumerate(zip(self._ropes, laid, strict=True))
        ]
        if self.config.ropes != "auto":
            for number in range(len(estimates), self.config.ropes):
                reason = f"only {len(self._ropes)} of {self.config.ropes} ropes have been seen"
                estimates.append(Estimate.lost(view.frame.stamp_ns, reason, rope=number))
        return tuple(estimates)

    def _report(self, view: _View, number: int, rope: WholeRope, laid: list[Laid]) -> Estimate:
        diameter, stamp_ns = self.config.diameter, view.frame.stamp_ns
        reasons = view.reasons + rope.doubts
        if not laid:
            hidden = is_behind(view.frame, rope.nodes, diameter).any() and (
                looked_through(view.frame, rope.nodes, diameter).mean() < _LOOKED_THROUGH
            )
            if not hidden or rope.unseen.min() > _WHOLLY_HIDDEN:
                return Estimate.lost(stamp_ns, _nothing(view), view.count, rope=number)
        chain, places, is_seen = chain_of(rope, laid)
        assert self.config.centerline.spacing is not None
        waypoints = make_waypoints(chain, self.config.centerline.spacing, rope.waypoints)
        rope.waypoints = waypoints
        if number == 0:
            self._found = rope.nodes
        arc = arc_lengths(chain)
        seen, sigma = told_of_waypoints(waypoints.arc_length * (arc[-1] / waypoints.length), arc, is_seen, rope, places)
        reasons = reasons + self._doubts_of(rope, laid, chain, view.frame)
        return Estimate(
            stamp_ns,
            Status.DEGRADED if reasons else Status.OK,
            tuple(reasons),
            rope.nodes,
            waypoints,
            view.count,
            view.stride,
            seen=seen,
            position_sigma=np.hypot(sigma, _POSITION_SIGMA * diameter),
            rope=number,
        )

    def _doubts_of(self, rope: WholeRope, laid: list[Laid], chain: FloatArray, frame: Frame) -> list[str]:
        diameter, trouble = self.config.diameter, []
        if not all(rope.tips):
            trouble.append("an end has not been seen yet: the rope may be longer")
        starts = [one.start for one in laid] + [rope.length]
        ends = [0.0] + [one.end for one in laid]
        gaps = np.maximum(np.array(starts) - ends, 0.0)
        if gaps.max() > BRIDGE_DIAMETERS * diameter:
            trouble.append(
                f"{gaps.sum() / rope.length * 100:.0f} % of the rope is hidden, for {rope.unseen.max():.1f} s at most"
            )
            free = looked_through(frame, rope.nodes[rope.unseen > 0], diameter)
            if np.count_nonzero(free) > _FREE * len(rope.nodes):
                trouble.append(
                    "where the rope is expected there is nothing: it is somewhere else, or has lost its colour"
                )
        bridged = max((float(one.strand.widest_gap) for one in laid), default=0.0)
        if bridged > BRIDGE_DIAMETERS * diameter:
            trouble.append(f"a gap of {bridged * 1e3:.0f} mm is bridged")
        if sharpest_turn(chain) > KINK:
            trouble.append("the curve turns back sharply: the order there may be wrong")
        trouble += self._doubts.of_distance(chain)
        return trouble

    def _all_lost(self, stamp_ns: int, reason: str, count: int = 0) -> tuple[Estimate, ...]:
        ropes = self.config.ropes
        number = max(len(self._ropes), 1 if ropes == "auto" else ropes)
        return tuple(Estimate.lost(stamp_ns, reason, count, rope=rope) for rope in range(number))


def _agrees(strand: Strand, rope: Expected) -> bool:
    """Whether a strand from end to end lies where the rope is expected, but for a tenth of it."""
    at = strand.arc * (rope.length / strand.length)
    there = interpolated(at, rope.places, rope.nodes)
    off = np.linalg.norm(strand.nodes - there, axis=1) / np.interp(at, rope.places, rope.sigma)
    return bool(np.percentile(off, 90) < _AGREES)


def _nothing(view: _View) -> str:
    if not view.count:
        return "no points of the rope's colour and place"
    if view.strands:
        return "nothing of that colour lies where the rope can be"
    return too_little(view.points.shape[1], 0 if view.path is None else len(view.path.slices))
