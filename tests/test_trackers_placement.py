"""Where along a rope the strands of a frame belong."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import at_equal_length
from ropetrace.trackers import placement
from ropetrace.trackers.placement import Expected, Placed, place
from ropetrace.trackers.strands import Strand
from ropetrace.types import FloatArray

DIAMETER = 0.012
SIGMA = 0.015

quick = settings(max_examples=60, deadline=None)
seeds = st.integers(0, 2**32 - 1)


def wave(length: float = 0.6) -> FloatArray:
    """A rope in three bends, (601, 3), metres."""
    s = np.linspace(0, 1, 601)
    turn = 0.9 * np.sin(7 * s) + 0.4 * s
    steps = np.stack([np.sin(turn), np.cos(turn), 0.2 * np.cos(5 * s)], axis=1)[:-1]
    steps *= length / np.linalg.norm(steps, axis=1).sum()
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]) + [0.0, -0.3, 1.0]


CURVE = wave()
LENGTH = 0.6


def expected(
    curve: FloatArray, sigma: float = SIGMA, tips: tuple[bool, bool] = (True, True), length: float = LENGTH
) -> Expected:
    return Expected(at_equal_length(curve, 51), np.full(51, sigma), length, tips)


def cut(curve: FloatArray, start: float, end: float, length: float = LENGTH) -> Strand:
    """A stretch of a curve, seen from `start` to `end`, metres along it; its ends are clear where the curve's are."""
    fine = at_equal_length(curve, 1201)
    places = np.linspace(start, end, max(int((end - start) / DIAMETER), 2) + 1) / length * 1200
    nodes = np.stack([np.interp(places, np.arange(1201), fine[:, k]) for k in range(3)], axis=1)
    return Strand.through(nodes, (0.0, 0.0), (start < 1e-9, end > length - 1e-9), np.full(len(nodes), DIAMETER))


def moved(strand: Strand, by: FloatArray) -> Strand:
    return Strand.through(strand.nodes + by, strand.reach, strand.clear, strand.widths)


def shaken(strand: Strand, rng: np.random.Generator) -> Strand:
    """All of it up to 5 mm off in each direction, and each node 0.5 mm."""
    return moved(strand, rng.uniform(-0.005, 0.005, 3) + rng.normal(0, 0.0005, strand.nodes.shape))


def cuts(rng: np.random.Generator, count: int) -> list[tuple[float, float]]:
    """Stretches of at least 4 diameters, with gaps of at least 2 between them, in order."""
    while True:
        ends = np.sort(rng.uniform(0, LENGTH, 2 * count)).reshape(count, 2)
        ends[0, 0] = rng.choice([0.0, ends[0, 0]])
        ends[-1, 1] = rng.choice([LENGTH, ends[-1, 1]])
        long = (ends[:, 1] - ends[:, 0] > 4 * DIAMETER).all()
        if long and (ends[1:, 0] - ends[:-1, 1] > 2 * DIAMETER).all():
            return [(float(start), float(end)) for start, end in ends]


@quick
@given(seeds, st.integers(1, 4))
def test_strands_that_are_cut_out_of_a_rope_are_put_back(seed: int, count: int) -> None:
    """Whatever their order and direction, and a little off."""
    rng = np.random.default_rng(seed)
    where = cuts(rng, count)
    strands = [shaken(cut(CURVE, *ends), rng) for ends in where]
    is_forwards = rng.random(count) < 0.5
    given_strands = [strand if way else strand.reversed() for strand, way in zip(strands, is_forwards, strict=True)]
    order = rng.permutation(count)
    placed = place([given_strands[k] for k in order], [expected(CURVE)], DIAMETER)
    assert [int(order[one.index]) for one in placed] == list(range(count))
    assert [one.is_forwards for one in placed] == is_forwards.tolist()
    for one, (start, end), strand in zip(placed, where, strands, strict=True):
        assert one.rope == 0
        assert one.start == pytest.approx(start, abs=DIAMETER)
        assert one.end == pytest.approx(end, abs=1.5 * DIAMETER)
        np.testing.assert_allclose(one.strand.nodes, strand.nodes)


@quick
@given(seeds)
def test_a_clear_end_near_the_ropes_end_is_put_to_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    strand = moved(cut(CURVE, 0.0, float(rng.uniform(0.1, 0.4))), np.array([0.0, rng.uniform(-0.02, 0.02), 0.0]))
    (one,) = place([strand], [expected(CURVE)], DIAMETER)
    assert one.start == 0.0
    assert one.is_forwards


@pytest.mark.parametrize("at_start", [True, False])
def test_beyond_an_end_that_was_never_seen_a_rope_may_reach_on(at_start: bool) -> None:
    """The rope is known but for 15 cm at one end, which the strand shows."""
    known = (0.15, LENGTH) if at_start else (0.0, LENGTH - 0.15)
    part = cut(CURVE, *known).nodes
    rope = expected(part, tips=(not at_start, at_start), length=known[1] - known[0])
    shown = (0.05, 0.4) if at_start else (0.2, 0.55)
    (one,) = place([cut(CURVE, *shown)], [rope], DIAMETER)
    assert one.start == pytest.approx(shown[0] - known[0], abs=DIAMETER)


def test_strands_of_two_ropes_are_told_apart() -> None:
    other = wave()[::-1] * [-1, 1, 1] + [0.25, 0.1, 0.05]
    strands = [cut(other, 0.35, LENGTH), cut(CURVE, 0.0, 0.25).reversed(), cut(other, 0.0, 0.3), cut(CURVE, 0.3, 0.5)]
    placed = place(strands, [expected(CURVE), expected(other)], DIAMETER)
    assert [(one.rope, one.index, one.is_forwards) for one in placed] == [
        (0, 1, False),
        (0, 3, True),
        (1, 2, True),
        (1, 0, True),
    ]
    assert [one.start for one in placed] == pytest.approx([0.0, 0.3, 0.0, 0.35], abs=DIAMETER)


@quick
@given(seeds)
def test_two_ropes_that_cross_keep_their_strands(seed: int) -> None:
    """Four arms from one crossing: which belong together, the prediction knows."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.5, 1.2)
    ropes = []
    for turn in (angle, -angle):
        way = np.array([np.sin(turn), np.cos(turn), 0.0])
        ropes.append(np.linspace(-LENGTH / 2 * way, LENGTH / 2 * way, 601) + [0.0, 0.0, 1.0])
    strands = [shaken(cut(rope, *ends), rng) for rope in ropes for ends in ((0.0, 0.25), (0.35, LENGTH))]
    order = rng.permutation(4)
    placed = place([strands[k] for k in order], [expected(rope) for rope in ropes], DIAMETER)
    assert [(one.rope, int(order[one.index])) for one in placed] == [(0, 0), (0, 1), (1, 2), (1, 3)]


ENDS = [(False, False), (True, False), (False, True), (True, True)]


def far_away(clear: tuple[bool, bool]) -> Strand:
    strand = cut(CURVE, 0.1, 0.3)
    return Strand.through(strand.nodes + [0.5, 0.0, 0.0], strand.reach, clear, strand.widths)


@pytest.mark.parametrize("clear", ENDS)
def test_what_is_far_from_every_rope_is_not_placed(clear: tuple[bool, bool]) -> None:
    assert place([far_away(clear)], [expected(CURVE)], DIAMETER) == []


@pytest.mark.parametrize("clear", ENDS)
def test_what_is_far_from_a_rope_that_is_seen_is_not_placed(clear: tuple[bool, bool]) -> None:
    (one,) = place([far_away(clear), cut(CURVE, 0.2, 0.5)], [expected(CURVE)], DIAMETER)
    assert one.index == 1


def test_without_strands_or_ropes_nothing_is_placed() -> None:
    assert place([], [expected(CURVE)], DIAMETER) == []
    assert place([cut(CURVE, 0.1, 0.3)], [], DIAMETER) == []


def contradicts(before: Placed, after: Placed) -> bool:
    """Whether two strands of a rope lie upon each other, or farther apart than the rope between them is long."""
    slack = placement._SLACK * DIAMETER + placement._SLACK_SHARE * LENGTH
    between = after.start - before.end
    chord = float(np.linalg.norm(after.strand.nodes[0] - before.strand.nodes[-1]))
    return between < -slack - 1e-9 or chord > max(between, 0.0) + slack + 1e-9


@quick
@given(seeds, st.integers(2, 7))
def test_no_strand_is_placed_twice_and_none_contradicts_another(seed: int, count: int) -> None:
    """Even of strands that cannot all be the rope's: copies and foreign ones, with any ends clear."""
    rng = np.random.default_rng(seed)
    strands = []
    for _ in range(count):
        start = rng.uniform(0, LENGTH - 0.06)
        strand = moved(cut(CURVE, start, rng.uniform(start + 0.05, LENGTH)), rng.normal(0, 0.02, 3))
        clear = (bool(rng.integers(2)), bool(rng.integers(2)))
        strand = Strand.through(strand.nodes, strand.reach, clear, strand.widths)
        strands.append(strand if rng.integers(2) else strand.reversed())
    placed = place(strands, [expected(CURVE, 0.05)], DIAMETER)
    assert len({one.index for one in placed}) == len(placed) > 0
    for before, after in itertools.pairwise(placed):
        assert not contradicts(before, after)


def test_of_a_strand_and_its_copy_at_another_place_the_one_that_fits_is_placed() -> None:
    right = cut(CURVE, 0.2, 0.4)
    copy = moved(right, np.array([0.03, 0.0, 0.0]))
    (one,) = place([copy, right], [expected(CURVE)], DIAMETER)
    assert one.index == 1


def test_a_longer_strand_is_not_given_up_for_two_that_fit_better_in_its_place() -> None:
    long = moved(cut(CURVE, 0.0, 0.5), np.array([0.004, 0.0, 0.0]))
    short = [cut(CURVE, 0.1, 0.2), cut(CURVE, 0.3, 0.4)]
    placed = place([*short, long], [expected(CURVE)], DIAMETER)
    assert [one.index for one in placed] == [2]
