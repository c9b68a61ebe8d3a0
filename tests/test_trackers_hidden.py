"""The nodes of a rope that is seen in part: what is seen stays, what is hidden is as long as it must be."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from helpers import random_rotation
from ropetrace.trackers import hidden
from ropetrace.trackers.doubts import sharpest_turn
from ropetrace.trackers.hidden import fill_hidden
from ropetrace.types import FloatArray

DIAMETER = 0.015
SPACING = 0.015

quick = settings(max_examples=30, deadline=None)
seeds = st.integers(0, 2**32 - 1)


def random_rope(rng: np.random.Generator, count: int) -> FloatArray:
    """A smooth curve about a metre away, its nodes at equal distances, (count, 3), metres."""
    turns = np.cumsum(rng.normal(0, 0.12, count - 1))
    slopes = 0.5 * np.sin(rng.uniform(0, 6) + np.linspace(0, 2, count - 1))
    steps = np.stack([np.cos(slopes) * np.sin(turns), np.cos(slopes) * np.cos(turns), np.sin(slopes)], axis=1)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps * SPACING, axis=0)]) + [0.0, 0.0, 1.0]


def random_hidden(rng: np.random.Generator, count: int) -> NDArray[np.bool_]:
    """Which nodes are hidden: one stretch, which may be at an end, and some node is seen."""
    first, last = np.sort(rng.choice(count + 1, 2, replace=False))
    places = np.arange(count)
    return (places >= first) & (places < min(last, first + count - 2))


def dense_reference(
    expected: FloatArray,
    seen: NDArray[np.bool_],
    measured: FloatArray,
    pushed: NDArray[np.bool_],
    targets: FloatArray,
) -> FloatArray:
    """The least squares of the docstring by Gauss and Newton's method, with the whole Jacobian written out."""
    count = len(expected)
    anchor = np.where(seen[:, None], measured, expected)
    each = np.eye(3 * count).reshape(count, 3, 3 * count)
    bend = (hidden._STIFFNESS * DIAMETER / SPACING) ** 2 / hidden._EXPECTED
    nodes = anchor.copy()
    for _ in range(hidden._MOST_STEPS):
        residuals, rows = [], []
        for i in range(count):
            sigma = hidden._SEEN if seen[i] else hidden._EXPECTED
            residuals.append((nodes[i] - anchor[i]) / sigma)
            rows.append(each[i] / sigma)
            if pushed[i] and not seen[i]:
                residuals.append((nodes[i] - targets[i]) / hidden._PUSHED)
                rows.append(each[i] / hidden._PUSHED)
        for i in range(1, count - 1):
            residuals.append(bend * (nodes[i - 1] - 2 * nodes[i] + nodes[i + 1]))
            rows.append(bend * (each[i - 1] - 2 * each[i] + each[i + 1]))
        for i in range(count - 1):
            step = nodes[i + 1] - nodes[i]
            length = np.linalg.norm(step)
            residuals.append(np.array([length - SPACING]) / hidden._STRETCH)
            rows.append((step / length)[None] @ (each[i + 1] - each[i]) / hidden._STRETCH)
        move = np.linalg.lstsq(np.concatenate(rows), -np.concatenate(residuals))[0]
        nodes = nodes + move.reshape(count, 3)
        if np.abs(move).max() < hidden._SETTLED:
            break
    return nodes


@quick
@given(seeds, st.integers(6, 24))
def test_it_equals_least_squares_with_the_whole_matrix(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    rope = random_rope(rng, count)
    seen = ~random_hidden(rng, count)
    measured = rope + rng.normal(0, 0.0005, rope.shape)
    expected = rope + rng.normal(0, 0.01, 3) + rng.normal(0, 0.001, rope.shape)
    pushed = rng.random(count) < 0.3
    targets = expected + rng.normal(0, 0.02, rope.shape)
    found = fill_hidden(expected, seen, measured, pushed, targets, SPACING, DIAMETER)
    np.testing.assert_allclose(found, dense_reference(expected, seen, measured, pushed, targets), atol=1e-7)


@quick
@given(seeds, st.integers(30, 120))
def test_what_is_seen_stays_and_the_length_is_kept(seed: int, count: int) -> None:
    """Where the rope has moved on by 1 cm since it was expected, and is to leave free space on another side."""
    rng = np.random.default_rng(seed)
    rope = random_rope(rng, count)
    seen = ~random_hidden(rng, count)
    expected = rope + 0.01 * random_rotation(rng)[0]
    pushed = rng.random(count) < 0.5
    targets = expected + 0.01 * random_rotation(rng)[0]
    found = fill_hidden(expected, seen, rope, pushed, targets, SPACING, DIAMETER)
    assert np.linalg.norm(found - rope, axis=1)[seen].max() < 0.007
    steps = np.linalg.norm(np.diff(found, axis=0), axis=1)
    assert abs(steps.sum() / (SPACING * (count - 1)) - 1) < 0.025
    assert np.abs(steps / SPACING - 1).max() < 0.1


def test_a_rope_that_is_where_it_was_expected_does_not_move() -> None:
    rope = np.linspace([0.0, 0.0, 1.0], [0.0, SPACING * 19, 1.0], 20)
    for first, last in ((0, 5), (8, 14), (15, 20), (0, 20)):
        seen = np.ones(20, np.bool_)
        seen[first:last] = False
        found = fill_hidden(rope, seen, rope, np.zeros(20, np.bool_), rope, SPACING, DIAMETER)
        np.testing.assert_allclose(found, rope, atol=1e-12)


def test_measurements_and_targets_of_other_nodes_count_for_nothing() -> None:
    rng = np.random.default_rng(4)
    rope = random_rope(rng, 30)
    seen = np.arange(30) < 18
    pushed = np.arange(30) > 25
    far = rope + 7.0
    found = [
        fill_hidden(rope, seen, np.where(seen[:, None], rope, rows), pushed, targets, SPACING, DIAMETER)
        for rows, targets in ((rope, rope), (far, np.where(pushed[:, None], rope, far)))
    ]
    np.testing.assert_array_equal(found[0], found[1])


def test_a_hidden_middle_bows_without_a_kink_where_the_seen_parts_came_closer() -> None:
    """By a fifth of the rope between them, in steps as from frame to frame."""
    count, gone = 51, slice(13, 38)
    rope = np.linspace([0.0, -0.375, 1.0], [0.0, 0.375, 1.0], count)
    closer = 0.2 * SPACING * 26
    seen = np.ones(count, np.bool_)
    seen[gone] = False
    found = rope.copy()
    found[gone, 0] += 0.001
    for part in np.linspace(0, 1, 30):
        measured = rope.copy()
        measured[gone.stop :, 1] -= part * closer
        found = fill_hidden(found, seen, measured, np.zeros(count, np.bool_), rope, SPACING, DIAMETER)
    between = found[gone.start - 1 : gone.stop + 1]
    assert abs(np.linalg.norm(np.diff(between, axis=0), axis=1).sum() / (26 * SPACING) - 1) < 0.03
    assert between[:, 0].max() > 0.08
    assert sharpest_turn(found) < np.radians(20)
    assert np.linalg.norm(found - measured, axis=1)[seen].max() < 0.005


def test_a_hidden_tip_follows_the_seen_part_and_stays_as_straight_as_it_was() -> None:
    rope = np.linspace([0.0, -0.2, 1.0], [0.0, -0.2 + SPACING * 29, 1.0], 30)
    seen = np.arange(30) < 20
    shift = np.array([0.05, 0.0, 0.0])
    found = rope
    for _ in range(20):
        found = fill_hidden(found, seen, rope + shift, np.zeros(30, np.bool_), rope, SPACING, DIAMETER)
    assert np.linalg.norm(found - rope - shift, axis=1).max() < 0.01


def test_what_is_pushed_moves_towards_its_target() -> None:
    rope = np.linspace([0.0, -0.2, 1.0], [0.0, -0.2 + SPACING * 29, 1.0], 30)
    seen = np.arange(30) < 20
    targets = rope + [0.03, 0.0, 0.0]
    found = fill_hidden(rope, seen, rope, ~seen, targets, SPACING, DIAMETER)
    assert found[-1, 0] > 0.01
    assert np.linalg.norm(found - rope, axis=1)[:15].max() < 0.003


@quick
@given(seeds)
def test_turning_and_moving_everything_turns_and_moves_the_nodes(seed: int) -> None:
    """Up to what the iteration, which ends by coordinates, leaves undone."""
    rng = np.random.default_rng(seed)
    rope = random_rope(rng, 30)
    seen = ~random_hidden(rng, 30)
    expected = rope + rng.normal(0, 0.01, 3)
    pushed = rng.random(30) < 0.3
    targets = expected + rng.normal(0, 0.01, 3)
    rotation, shift = random_rotation(rng), rng.uniform(-3, 3, 3)

    def turned(points: FloatArray) -> FloatArray:
        return points @ rotation.T + shift

    found = fill_hidden(expected, seen, rope, pushed, targets, SPACING, DIAMETER)
    other = fill_hidden(turned(expected), seen, turned(rope), pushed, turned(targets), SPACING, DIAMETER)
    np.testing.assert_allclose(other, turned(found), atol=2e-5)
