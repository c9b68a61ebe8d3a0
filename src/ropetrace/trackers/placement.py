"""Where along a rope the strands of a frame belong: by the rope's prediction, its length, and what is seen of its ends.

A strand is laid as a whole, since its own order and length are sure: at an offset along the rope, one way round or the
other. Offsets come from the places of the prediction that its points are near, and from its clear ends, which must be
the rope's. All strands are then placed together: the choice that explains most length, in which no two lie upon each
other and none is farther from the next than the rope between them is long.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from ropetrace.trackers.strands import Strand
from ropetrace.types import FloatArray

_WORST = 9.0
"""A strand's misfit, squared and in standard deviations, saturates here: farther off is no worse."""

SAME_LENGTH = 0.03
"""A strand from end to end whose length differs by a smaller part from the rope's is the rope."""

_SPREAD_COST = 1.4
"""What it costs to lie where the rope is e times less sure than where it is surest, in misfit."""

_TOO_FAR = 6.0
"""A strand without a clear end of the rope that misfits by more is not placed."""

_FARTHEST = 7.4
"""And one with a clear end is not, either, if it misfits by more than this: some four standard deviations."""

_CLEAR_END_LOST = 2.3
"""What it costs if an end that is clear lies in the middle of the rope, in misfit: colour and depth have holes, too."""

_NEAR_TIP, _NEAR_TIP_SHARE, _NEAR_TIP_SIGMAS = 5.0, 0.05, 3.0
"""How far from the rope's end a clear end may be placed and still be taken for it: diameters, parts of the length, and
standard deviations of the prediction there. It is then put there."""

_SHORT, _LONG = 4.0, 12.0
"""Shorter and longer strands are charged for such ends as if they were this long, diameters."""

_AT_TIP = 1e-6
"""A strand that is laid this close to an end of the rope ends there, metres."""

_SLACK, _SLACK_SHARE = 2.0, 0.02
"""By how much strands may lie upon each other, or be farther apart than the rope allows: diameters and parts of the
length."""

_OFFSETS = 8
"""Of a strand that are kept."""

_NEAR_PLACES = 6
"""Of the prediction that a point may be near."""

_VOTERS = 12
"""Points of a strand that propose offsets, at most about."""

_SEARCH_STEPS = 2000
"""Choices that are looked at in one frame, at most."""


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """A rope as it is expected in the frame.

    Parameters
    ----------
    nodes : (M, 3) float array
        At equal arc length from its start to its end, metres, camera frame.
    sigma : (M,) float array
        How far they may be off, metres.
    length : float
        Of the rope, metres.
    tips : (start, end)
        Which of its ends have been seen; the rope may reach on beyond the others.
    """

    nodes: FloatArray
    sigma: FloatArray
    length: float
    tips: tuple[bool, bool]

    @property
    def spacing(self) -> float:
        """Between the nodes, metres."""
        return self.length / (len(self.nodes) - 1)

    @property
    def places(self) -> FloatArray:
        """Of the nodes along the rope, (M,), metres."""
        return np.linspace(0, self.length, len(self.nodes))

    def sigma_at(self, place: float) -> float:
        """How far the rope may be off at a place along it, metres."""
        return float(np.interp(place, self.places, self.sigma))


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A strand along a rope.

    Parameters
    ----------
    strand : Strand
        In the rope's direction.
    is_forwards : bool
        Whether the given strand had this direction already.
    rope, index : int
        Which rope, and which of the given strands.
    start : float
        Where along the rope it begins, metres.
    shows_ends : (start, end)
        Whether its start and its end are those of the rope.
    gain : float
        Length that is explained, weighed by the fit, metres.
    """

    strand: Strand
    is_forwards: bool
    rope: int
    index: int
    start: float
    shows_ends: tuple[bool, bool]
    gain: float

    @property
    def end(self) -> float:
        """Where along the rope it ends, metres."""
        return self.start + self.strand.length


def place(strands: Sequence[Strand], ropes: Sequence[Expected], diameter: float) -> list[Placed]:
    """The strands that belong to a rope, by ropes and along them; the others belong to none.

    Parameters
    ----------
    strands : sequence of Strand
        Of the frame.
    ropes : sequence of Expected
        All that are followed.
    diameter : float
        Of the ropes, metres.
    """
    options = [
        sorted(
            (option for number, rope in enumerate(ropes) for option in _options(strand, index, rope, number, diameter)),
            key=lambda option: -option.gain,
        )
        for index, strand in enumerate(strands)
    ]
    chosen = _best_choice([some for some in options if some], ropes, diameter)
    return sorted(chosen, key=lambda placed: (placed.rope, placed.start + placed.end))


def near_tip(rope: Expected, diameter: float) -> tuple[float, float]:
    """How far from the rope's start and end a clear end may be placed and is still taken for it, metres.

    0 for an end that has never been seen.
    """
    base = _NEAR_TIP * diameter + _NEAR_TIP_SHARE * rope.length
    start, end = (base + _NEAR_TIP_SIGMAS * float(rope.sigma[k]) if rope.tips[k] else 0.0 for k in (0, -1))
    return start, end


def _options(strand: Strand, index: int, rope: Expected, number: int, diameter: float) -> list[Placed]:
    """Ways to lay a strand along a rope."""
    length = strand.length
    at_ends = _offsets_at_ends(strand, rope)
    found = np.empty((_OFFSETS + len(at_ends), 3))
    count = _offsets(strand.nodes, strand.arc, rope.nodes, rope.sigma, rope.spacing, rope.length, at_ends, found)
    ways: list[Placed] = []
    for misfit, offset, sign in found[:count]:
        laid = strand if sign > 0 else strand.reversed()
        start = float(offset if sign > 0 else offset - length)
        shift = _to_tip(laid, start, rope, diameter)
        if shift is None and (misfit > _TOO_FAR or length < _room(rope, start + length / 2)):
            continue
        fit = misfit
        if shift:
            start += shift
            fit = _misfit(laid.nodes, laid.arc, 1.0, start, rope.nodes, rope.sigma, rope.spacing, rope.length)
        if fit > _FARTHEST or length > _longest(rope, diameter):
            continue
        ends = _shown_ends(laid, start, rope)
        lost = sum(np.array(laid.clear) & ~np.array(ends) & np.array(rope.tips))
        charged = min(max(length, _SHORT * diameter), _LONG * diameter)
        gain = length * (_WORST - fit) - lost * _CLEAR_END_LOST * charged
        known = any(way.is_forwards == (sign > 0) and abs(way.start - start) < rope.spacing / 2 for way in ways)
        if gain > 0 and not known:
            ways.append(Placed(laid, bool(sign > 0), number, index, start, ends, float(gain)))
    return ways


def _longest(rope: Expected, diameter: float) -> float:
    """What a strand of a rope can be long, metres: no more than the rope, once both its ends have been seen."""
    return (1 + 2 * SAME_LENGTH) * rope.length + _SLACK * diameter if all(rope.tips) else np.inf


def _to_tip(strand: Strand, start: float, rope: Expected, diameter: float) -> float | None:
    """The shift that puts a clear end of a strand to the end of the rope that it is near, metres; None without one."""
    tips = near_tip(rope, diameter)
    shifts = (-start, rope.length - start - strand.length)
    near = [shift for shift, clear, tip in zip(shifts, strand.clear, tips, strict=True) if clear and abs(shift) < tip]
    return min(near, key=abs, default=None)


def _shown_ends(strand: Strand, start: float, rope: Expected) -> tuple[bool, bool]:
    """Which ends of a strand that is laid there are those of the rope."""
    after = rope.length - start - strand.length
    if all(strand.clear) and abs(start) < _AT_TIP and abs(after) < 2 * SAME_LENGTH * rope.length:
        return True, True
    return strand.clear[0] and abs(start) < _AT_TIP, strand.clear[1] and abs(after) < _AT_TIP


def _room(rope: Expected, place: float) -> float:
    """How far along itself the rope may be off at a place, beyond what it is at its surest, metres."""
    return rope.sigma_at(min(max(place, 0.0), rope.length)) - float(rope.sigma.min())


def _offsets_at_ends(strand: Strand, rope: Expected) -> FloatArray:
    """Offsets and signs, (E, 2), that put a clear end of the strand to an end of the rope that has been seen."""
    at_start = [(0.0, 1.0)] * strand.clear[0] + [(strand.length, -1.0)] * strand.clear[1]
    at_end = [(rope.length - strand.length, 1.0)] * strand.clear[1] + [(rope.length, -1.0)] * strand.clear[0]
    return np.array(at_start * rope.tips[0] + at_end * rope.tips[1]).reshape(-1, 2)


def _best_choice(options: list[list[Placed]], ropes: Sequence[Expected], diameter: float) -> list[Placed]:
    """One way at most of each strand, such that none contradicts another and the gain is the largest."""
    options = sorted(options, key=lambda some: -some[0].gain)
    most = np.concatenate([np.cumsum([some[0].gain for some in options][::-1])[::-1], [0.0]])
    best: tuple[float, list[Placed]] = (0.0, [])
    steps = 0

    def search(at: int, gained: float, chosen: list[Placed]) -> None:
        nonlocal best, steps
        steps += 1
        if gained > best[0]:
            best = gained, chosen
        if at == len(options) or gained + most[at] <= best[0] or steps > _SEARCH_STEPS:
            return
        for option in options[at]:
            if not any(_contradict(option, other, ropes, diameter) for other in chosen):
                search(at + 1, gained + option.gain, [*chosen, option])
        search(at + 1, gained, chosen)

    search(0, 0.0, [])
    return best[1]


def _contradict(first: Placed, second: Placed, ropes: Sequence[Expected], diameter: float) -> bool:
    """Whether two strands of one rope lie upon each other, or are farther apart than the rope between them is long."""
    if first.rope != second.rope:
        return False
    before, after = (first, second) if first.start + first.end < second.start + second.end else (second, first)
    slack = _SLACK * diameter + _SLACK_SHARE * ropes[first.rope].length
    between = after.start - before.end
    if between < -slack:
        return True
    apart = float(np.linalg.norm(after.strand.nodes[0] - before.strand.nodes[-1]))
    return apart - after.strand.reach[0] - before.strand.reach[1] > max(between, 0.0) + slack


@njit(cache=True, nogil=True)
def _near_places(point: Any, nodes: Any, sigma: Any, places: Any, distances: Any) -> int:
    """Places of a chain, in nodes, that a point is nearest to among their neighbours; the nearest first."""
    segments = len(nodes) - 1
    parts, squares = np.empty(segments), np.empty(segments)
    for m in range(segments):
        size = along = 0.0
        for k in range(3):
            step = nodes[m + 1, k] - nodes[m, k]
            size += step * step
            along += step * (point[k] - nodes[m, k])
        part = min(max(along / max(size, 1e-18), 0.0), 1.0)
        square = 0.0
        for k in range(3):
            square += (point[k] - nodes[m, k] - part * (nodes[m + 1, k] - nodes[m, k])) ** 2
        parts[m], squares[m] = part, square / (sigma[m] + part * (sigma[m + 1] - sigma[m])) ** 2
    count = 0
    for m in range(segments):
        if squares[m] > _WORST or (m > 0 and squares[m - 1] < squares[m]):
            continue
        if m < segments - 1 and squares[m + 1] <= squares[m]:
            continue
        at = min(count, len(places) - 1)
        if count == len(places) and distances[at] <= squares[m]:
            continue
        while at > 0 and distances[at - 1] > squares[m]:
            distances[at], places[at] = distances[at - 1], places[at - 1]
            at -= 1
        distances[at], places[at] = squares[m], m + parts[m]
        count = min(count + 1, len(places))
    return count


@njit(cache=True, nogil=True)
def _misfit(
    points: Any, arc: Any, sign: float, offset: float, nodes: Any, sigma: Any, spacing: float, length: float
) -> float:
    """Mean of the saturated squared distances of a strand, laid at offset + sign arc, from the expected rope.

    Where nobody knows where the rope is, everything fits. So spread costs, as in a normal density, against the surest
    node's.
    """
    least = sigma[0]
    for m in range(len(sigma)):
        least = min(least, sigma[m])
    total = 0.0
    for i in range(len(points)):
        place = offset + sign * arc[i]
        inside = min(max(place, 0.0), length) / spacing
        m = min(int(inside), len(nodes) - 2)
        part = inside - m
        square = (place - inside * spacing) ** 2
        for k in range(3):
            square += (points[i, k] - nodes[m, k] - part * (nodes[m + 1, k] - nodes[m, k])) ** 2
        spread = sigma[m] + part * (sigma[m + 1] - sigma[m])
        square /= spread * spread
        total += _WORST * square / (_WORST + square) + _SPREAD_COST * np.log(spread / least)
    return total / len(points)


@njit(cache=True, nogil=True)
def _offsets(
    points: Any, arc: Any, nodes: Any, sigma: Any, spacing: float, length: float, at_ends: Any, found: Any
) -> int:
    """Fill in rows of misfit, offset and sign, the best first; those at the ends are as given, the rest refined."""
    places, distances = np.empty(_NEAR_PLACES), np.empty(_NEAR_PLACES)
    step = max(1, len(points) // _VOTERS)
    most = 2 * _NEAR_PLACES * (len(points) // step + 1)
    offsets, signs, misfits = np.empty(most), np.empty(most), np.empty(most)
    votes = 0
    for i in range(0, len(points), step):
        for c in range(_near_places(points[i], nodes, sigma, places, distances)):
            for sign in (1.0, -1.0):
                offsets[votes], signs[votes] = places[c] * spacing - sign * arc[i], sign
                misfits[votes] = _misfit(points, arc, sign, offsets[votes], nodes, sigma, spacing, length)
                votes += 1
    count = 0
    for e in range(len(at_ends)):
        found[count, 0] = _misfit(points, arc, at_ends[e, 1], at_ends[e, 0], nodes, sigma, spacing, length)
        found[count, 1], found[count, 2] = at_ends[e]
        count += 1
    for vote in np.argsort(misfits[:votes]):
        if count == len(found):
            break
        offset, sign, misfit = offsets[vote], signs[vote], misfits[vote]
        known = False
        for other in range(len(at_ends), count):
            known = known or (found[other, 2] == sign and abs(found[other, 1] - offset) < 2 * spacing)
        if known:
            continue
        width = spacing / 2
        for _ in range(8):
            back = _misfit(points, arc, sign, offset - width, nodes, sigma, spacing, length)
            on = _misfit(points, arc, sign, offset + width, nodes, sigma, spacing, length)
            if min(back, on) >= misfit:
                width *= 0.4
            elif back <= on:
                offset, misfit = offset - width, back
            else:
                offset, misfit = offset + width, on
        for other in range(len(at_ends), count):
            known = known or (found[other, 2] == sign and abs(found[other, 1] - offset) < 0.7 * spacing)
        if not known:
            found[count, 0], found[count, 1], found[count, 2] = misfit, offset, sign
            count += 1
    return count
