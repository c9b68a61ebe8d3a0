"""A rope as a whole: its nodes at equal arc length, seen or not, and how a frame's strands change them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ropetrace.centerline import SHORTEST_STEP, spline_at
from ropetrace.trackers.clouds import evenly_along, interpolated
from ropetrace.trackers.hidden import fill_hidden
from ropetrace.trackers.placement import SAME_LENGTH, Expected, Placed
from ropetrace.trackers.sight import nearest_hidden
from ropetrace.trackers.strands import Strand
from ropetrace.types import FloatArray, Frame, Waypoints

_FEWEST_NODES, _MOST_NODES = 12, 200
"""Of a rope; in between there is one a diameter."""

_SURPRISES = 2.0
"""Standard deviation of the expected nodes, in distances that nodes have lately been off,"""

_LEAST_SIGMA, _FIRST_SIGMA = 0.5, 2.0
"""between these, diameters,"""

_CALMING = 0.9
"""Part of the largest distance that is left with each frame, if no larger one comes."""

_LEAST_DRIFT, _DRIFT = 0.05, 0.3
"""and what it grows by while a node is not seen: as fast as the rope has lately moved, between these, m/s,"""

_LEASH = 1.0
"""but by no more than this part of the way along the rope to what is seen,"""

MOST_SIGMA = 0.3
"""up to this, metres."""

_MEMORY = 0.15
"""How long a node that is seen keeps its velocity, seconds,"""

_HIDDEN_MEMORY = 0.06
"""and one that is hidden: nobody knows what holds it."""

_FRESH = 0.7
"""Weight of the newest difference in the velocity of a node that is seen."""

_JOIN = 6.0
"""Strands that are closer than this along the rope, in diameters, are one: what lies between them is straight."""

_SLIP, _SLIP_SHARE = 3.0, 0.02
"""By how much what lies between them may differ from the way along the rope: diameters and parts of its length."""

_SLOWEST_LEARNING = 10
"""Whole views over which the length is averaged."""


_SHORTER = 10.0
"""A clear end that is seen this close to where an end was taken to be, in diameters, is that end."""

_PER_AXIS = 0.4
"""Standard deviation of what is hidden along each axis, in parts of what it is expected within (measured)."""

_FARTHEST = 1e3
"""How far a rope is continued straight on, metres."""


class Laid(NamedTuple):
    """A strand that is laid along a rope: its place k is `start` + `scale` arc k. At a tip it shows an end of it."""

    strand: Strand
    start: float
    scale: float
    at_tip: bool

    @property
    def end(self) -> float:
        return self.start + self.scale * self.strand.length


@dataclass(slots=True, eq=False)
class WholeRope:
    """What is known of a rope: M nodes at equal arc length.

    Parameters
    ----------
    nodes, velocities : (M, 3) float array
        Metres, m/s.
    unseen : (M,) float array
        For how long each has not been seen, seconds.
    adrift : (M,) float array
        For how long it has not been known where each is: it may be seen, but nobody knows which part of the rope it is.
    length : float
        Metres.
    tips : (start, end)
        Which of its ends have been seen.
    views : int
        How often both ends and all between them were seen, at most `_SLOWEST_LEARNING`.
    doubts : list of str
        What was wrong with its start, until a view of the whole rope in which nothing overlaps.
    first : list of Laid
        The strands that it began with.
    surprise : float
        How far nodes that are seen have lately been from where they were expected, metres.
    speed : float
        How fast they have lately moved, m/s.
    waypoints : Waypoints, optional
        That were told last.
    other_length_for : float
        How long a strand from end to end has had another length, seconds.
    """

    nodes: FloatArray
    velocities: FloatArray
    unseen: FloatArray
    adrift: FloatArray
    length: float
    tips: tuple[bool, bool]
    views: int
    doubts: list[str]
    first: list[Laid]
    surprise: float
    speed: float
    waypoints: Waypoints | None = None
    other_length_for: float = 0.0

    @classmethod
    def begun(cls, laid: list[Laid], diameter: float, doubts: list[str]) -> WholeRope:
        """A rope from the first view of it."""
        nothing = np.empty((0, 3))
        rope = cls(nothing, nothing, np.empty(0), np.empty(0), 0.0, (False, False), 0, doubts, laid, diameter, _DRIFT)
        rope.begin_again(laid, diameter)
        return rope

    def begin_again(self, laid: list[Laid], diameter: float) -> None:
        """Forget the length and the nodes: these strands, from end to end, are the rope."""
        chain = np.concatenate([one.strand.chain for one in laid])
        self.length = laid[-1].end
        count = int(np.clip(round(self.length / diameter) + 1, _FEWEST_NODES, _MOST_NODES))
        self.nodes = evenly_along(chain, count)
        self.velocities = np.zeros_like(self.nodes)
        places = self.places
        seen = np.any([(places >= one.start) & (places <= one.end + 1e-9) for one in laid], axis=0)
        self.unseen = np.zeros(count)
        self.adrift = np.where(seen, 0.0, MOST_SIGMA / _DRIFT)
        self.tips = laid[0].strand.clear[0], laid[-1].strand.clear[1]
        self.views = int(len(laid) == 1 and all(self.tips))

    @property
    def spacing(self) -> float:
        """Arc length between nodes, metres."""
        return self.length / (len(self.nodes) - 1)

    @property
    def places(self) -> FloatArray:
        """Of the nodes along the rope, (M,), metres."""
        return np.linspace(0, self.length, len(self.nodes))

    def expected(self, elapsed: float, diameter: float) -> Expected:
        """Where it is expected this many seconds later."""
        ahead = _MEMORY * (1 - np.exp(-elapsed / _MEMORY))
        known = np.clip(_SURPRISES * self.surprise, _LEAST_SIGMA * diameter, _FIRST_SIGMA * diameter)
        drift = np.clip(self.speed, _LEAST_DRIFT, _DRIFT) * (self.adrift + elapsed)
        sigma = np.minimum(known + np.minimum(drift, _LEASH * self.away_from(self.adrift == 0)), MOST_SIGMA)
        return Expected(self.nodes + ahead * self.velocities, sigma, self.length, self.tips)

    def away_from(self, seen: NDArray[np.bool_]) -> FloatArray:
        """How far along the rope each node is from the next that is seen, (M,), metres; infinite if none is."""
        places = self.places
        if not seen.any():
            return np.full(len(places), np.inf)
        shown = places[seen]
        after = np.searchsorted(shown, places)
        right = np.abs(shown[np.minimum(after, len(shown) - 1)] - places)
        left = np.abs(places - shown[np.maximum(after - 1, 0)])
        return np.asarray(np.minimum(left, right))

    def span(self, start: float, end: float) -> None:
        """Reach from `start` to `end`, metres along the rope as it was: it is longer or shorter than was known."""
        places = self.places
        count = int(np.clip(round((end - start) / self.spacing) + 1, _FEWEST_NODES, _MOST_NODES))
        anew = np.linspace(start, end, count)
        first = self.nodes[0] + (self.nodes[0] - self.nodes[1]) * (_FARTHEST / self.spacing)
        last = self.nodes[-1] + (self.nodes[-1] - self.nodes[-2]) * (_FARTHEST / self.spacing)
        knots = np.array([-_FARTHEST, *places, self.length + _FARTHEST])
        self.nodes = interpolated(anew, knots, np.array([first, *self.nodes, last]))
        self.velocities = interpolated(anew, places, self.velocities)
        self.unseen, self.adrift = (np.interp(anew, places, times) for times in (self.unseen, self.adrift))
        self.length = end - start

    def learn(self, length: float) -> None:
        """Take the length of a view of the whole rope, metres."""
        self.views = min(self.views + 1, _SLOWEST_LEARNING)
        self.length += (length - self.length) / self.views


def laid_along(placed: list[Placed], rope: Expected, diameter: float) -> list[Laid]:
    """Strands of one rope, joined where they follow closely, and stretched to the ends of the rope that they show."""
    trains: list[list[Placed]] = []
    for one in placed:
        if trains and _follows(trains[-1][-1], one, rope, diameter):
            trains[-1].append(one)
        else:
            trains.append([one])
    return [_laid(train, rope) for train in trains]


def _follows(before: Placed, after: Placed, rope: Expected, diameter: float) -> bool:
    """Whether the rope leads straight from one strand to the next."""
    chord = float(np.linalg.norm(after.strand.nodes[0] - before.strand.nodes[-1]))
    between = after.start + after.strand.reach[0] - before.end + before.strand.reach[1]
    return chord < _JOIN * diameter and abs(between - chord) < _SLIP * diameter + _SLIP_SHARE * rope.length


def _laid(train: list[Placed], rope: Expected) -> Laid:
    strand = train[0].strand
    starts = [train[0].start]
    for one in train[1:]:
        strand = strand.joined(one.strand)
        starts.append(one.start - (strand.length - one.strand.length))
    start = float(np.average(starts, weights=[one.strand.length for one in train]))
    at_start, at_end = train[0].shows_ends[0], train[-1].shows_ends[1]
    if at_start and at_end and abs(strand.length / rope.length - 1) < 2 * SAME_LENGTH:
        return Laid(strand, 0.0, rope.length / strand.length, True)
    if at_start and at_end:
        # It cannot be both: what it is nearer to, it is.
        at_start = abs(start) <= abs(start + strand.length - rope.length)
        at_end = not at_start
    if at_start:
        start = 0.0
    elif at_end:
        start = rope.length - strand.length
    else:
        start = min(start, rope.length - strand.length) if rope.tips[1] else start
        start = max(start, 0.0) if rope.tips[0] else start
    return Laid(strand, start, 1.0, at_start or at_end)


def advance(
    rope: WholeRope, laid: list[Laid], expected: Expected, frame: Frame, elapsed: float, diameter: float
) -> None:
    """Take what a frame shows of a rope.

    Parameters
    ----------
    rope : WholeRope
        Is changed.
    laid : list of Laid
        What is seen of it; changed where the rope turns out to be longer than was known.
    expected : Expected
        The rope in this frame.
    frame : RgbdFrame or CloudFrame
        Where it is seen.
    elapsed : float
        Seconds since the frame before.
    diameter : float
        Of the rope, metres.
    """
    if laid and not all(rope.tips):
        _reach_on(rope, laid, diameter)
        expected = rope.expected(elapsed, diameter)
    measured, seen = expected.nodes.copy(), np.zeros(len(rope.nodes), np.bool_)
    adrift = rope.adrift.copy()
    places = rope.places
    for one in laid:
        chain, knots = _knots(one)
        inside = (places >= knots[0] - 1e-9) & (places <= knots[-1] + 1e-9)
        measured[inside] = spline_at(knots, chain, places[inside])
        seen |= inside
        if inside.any():
            # A strand is as sure as its surest node, and as an end of the rope that it shows.
            adrift[inside] = 0.0 if one.at_tip else adrift[inside].min()
    if seen.all():
        nodes = measured
    else:
        targets, pushed = nearest_hidden(frame, expected.nodes, diameter)
        nodes = fill_hidden(expected.nodes, seen, measured, pushed, targets, rope.spacing, diameter)
    if elapsed > 0:
        difference = (nodes - rope.nodes) / elapsed
        follows = seen & (rope.unseen == 0)
        rope.velocities = np.where(
            follows[:, None],
            rope.velocities + _FRESH * (difference - rope.velocities),
            np.where(seen[:, None], rope.velocities, difference * np.exp(-elapsed / _HIDDEN_MEMORY)),
        )
    follows = seen & (rope.unseen == 0)
    if follows.any():
        off = float(np.sqrt(np.mean(np.sum((nodes - expected.nodes)[follows] ** 2, axis=1))))
        rope.surprise = max(off, _CALMING * rope.surprise)
        speed = float(np.sqrt(np.mean(np.sum(rope.velocities[follows] ** 2, axis=1))))
        rope.speed = max(speed, _CALMING * rope.speed)
    rope.nodes = nodes
    rope.unseen = np.where(seen, 0.0, rope.unseen + elapsed)
    rope.adrift = np.where(seen, adrift, adrift + elapsed)
    if len(laid) == 1 and all(laid[0].strand.clear) and laid[0].start == 0 and abs(laid[0].end - rope.length) < 1e-9:
        rope.learn(laid[0].strand.length)


def _reach_on(rope: WholeRope, laid: list[Laid], diameter: float) -> None:
    """Let a rope reach as far as it is seen at the ends that had not been seen, and end where they are seen to end."""
    ends = [0.0, rope.length]
    tips = list(rope.tips)
    for k, (place, clear) in enumerate(
        ((laid[0].start, laid[0].strand.clear[0]), (laid[-1].end, laid[-1].strand.clear[1]))
    ):
        beyond = place - ends[k] if k else ends[k] - place
        if not tips[k] and (beyond > 0 or (clear and beyond > -_SHORTER * diameter)):
            ends[k], tips[k] = place, clear
    if abs(ends[0]) + abs(ends[1] - rope.length) > 0:
        rope.span(ends[0], ends[1])
        laid[:] = [one._replace(start=one.start - ends[0]) for one in laid]
    rope.tips = tips[0], tips[1]


def _knots(laid: Laid) -> tuple[FloatArray, FloatArray]:
    """The points of a laid strand from end to end, and their places along the rope."""
    strand = laid.strand
    before = [0.0] if strand.reach[0] > SHORTEST_STEP else []
    after = [strand.length] if strand.reach[1] > SHORTEST_STEP else []
    return strand.chain, laid.start + laid.scale * np.concatenate([before, strand.arc, after])


def chain_of(rope: WholeRope, laid: list[Laid]) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """The whole rope: what is seen as it is seen, and the nodes between; places along it; which points are seen."""
    places = rope.places
    chains: list[FloatArray] = []
    knots: list[FloatArray] = []
    seen: list[NDArray[np.bool_]] = []

    def add(points: FloatArray, at: FloatArray, are_seen: bool) -> None:
        chains.append(points)
        knots.append(at)
        seen.append(np.full(len(points), are_seen))

    last = -rope.spacing
    for one in laid:
        chain, at = _knots(one)
        keep = at > (last + rope.spacing / 3 if chains else -np.inf)
        if np.count_nonzero(keep) < 2:
            continue
        between = (places > last + rope.spacing / 2) & (places < at[keep][0] - rope.spacing / 2)
        add(rope.nodes[between], places[between], False)
        add(chain[keep], at[keep], True)
        last = float(at[-1])
    rest = places > last + rope.spacing / 2
    add(rope.nodes[rest], places[rest], False)
    points = np.concatenate(chains)
    distinct = np.concatenate([[True], np.linalg.norm(np.diff(points, axis=0), axis=1) > SHORTEST_STEP])
    return points[distinct], np.concatenate(knots)[distinct], np.concatenate(seen)[distinct]


def told_of_waypoints(
    at: FloatArray, arc: FloatArray, is_seen: NDArray[np.bool_], rope: WholeRope, places: FloatArray
) -> tuple[NDArray[np.bool_], FloatArray]:
    """Which waypoints are seen, and the standard deviation along each axis of those that are not, metres.

    Parameters
    ----------
    at : (W,) float array
        Where the waypoints are along the chain, metres.
    arc, is_seen, places : (K,) arrays
        Where the chain's points are along it; which are seen; and where they are along the rope.
    """
    after = np.clip(np.searchsorted(arc, at, side="right"), 1, len(arc) - 1)
    seen = is_seen[after] & is_seen[after - 1]
    unseen = np.interp(np.interp(at, arc, places), rope.places, rope.unseen)
    if not seen.any():
        return seen, _PER_AXIS * np.minimum(_DRIFT * unseen, MOST_SIGMA)
    shown = at[seen]
    right = np.clip(np.searchsorted(shown, at), 0, len(shown) - 1)
    away = np.minimum(np.abs(at - shown[right]), np.abs(at - shown[np.maximum(right - 1, 0)]))
    return seen, _PER_AXIS * np.minimum(np.minimum(_DRIFT * unseen, MOST_SIGMA), away)
