"""Distances of curves: equal to brute force, and blind to nothing that the paper's measure misses."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ropetrace.evaluation.metrics import coverage, distances_to_curve, resample, symmetric_mean
from ropetrace.types import FloatArray

LINE = np.array([[0.0, 0, 1], [1.0, 0, 1]])
seeds = st.integers(0, 2**32 - 1)


def brute_force(points: FloatArray, curve: FloatArray) -> FloatArray:
    """The nearest of many places on the curve: too far by no more than the second number."""
    t = np.linspace(0, 1, 2001)[:, None]
    places = np.concatenate([a + t * (b - a) for a, b in itertools.pairwise(curve)])
    return np.asarray(np.linalg.norm(points[:, None] - places[None], axis=2).min(axis=1))


@settings(max_examples=40, deadline=None)
@given(seeds, st.integers(2, 6), st.integers(1, 20))
def test_distances_equal_brute_force(seed: int, vertices: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    curve = rng.normal(0, 1, (vertices, 3))
    if vertices > 3:
        curve[2] = curve[1]  # a vertex twice
    points = np.concatenate([rng.normal(0, 2, (count, 3)), curve])
    step = np.linalg.norm(np.diff(curve, axis=0), axis=1).max() / 2000
    found, expected = distances_to_curve(points, curve), brute_force(points, curve)
    assert (found <= expected + 1e-12).all()
    assert (found >= expected - step).all()
    np.testing.assert_allclose(found[count:], 0, atol=1e-12)


def test_distances_beside_and_beyond_a_line() -> None:
    points = np.array([[0.5, 0.3, 1.4], [-3.0, 4.0, 1.0], [1.0, 0.0, 3.0]])
    np.testing.assert_allclose(distances_to_curve(points, LINE), [0.5, 5.0, 2.0], atol=1e-6)


def test_resampled_points_lie_at_equal_length() -> None:
    curve = np.array([[0.0, 0, 0], [3, 0, 0], [3, 4, 0]])
    points = resample(curve, 0.9)
    assert len(points) == 9
    np.testing.assert_allclose(points[[0, -1]], curve[[0, -1]])
    places = np.linspace(0, 7, 9)
    np.testing.assert_allclose(points[:, 0], np.minimum(places, 3))
    np.testing.assert_allclose(points[:, 1], np.maximum(places - 3, 0))
    assert len(resample(curve, 100.0)) == 2


def test_symmetric_mean_of_parallel_lines_and_of_itself() -> None:
    assert symmetric_mean(LINE + [0, 0.003, 0], LINE) == pytest.approx(0.003)
    assert symmetric_mean(LINE, LINE) == pytest.approx(0, abs=1e-15)


def test_a_tenth_of_the_rope_is_not_a_good_track() -> None:
    part = np.array([[0.0, 0.001, 1], [0.1, 0.001, 1]])
    assert distances_to_curve(resample(part, 0.001), LINE).mean() == pytest.approx(0.001)
    # 0.9 m of the truth lie up to 0.9 m away: 0.405 m on average.
    assert symmetric_mean(part, LINE) == pytest.approx((0.001 + 0.405) / 2, rel=0.01)
    assert coverage(part, LINE, 0.01) == pytest.approx(0.11, abs=0.002)


def test_symmetric_mean_does_not_depend_on_direction_order_or_vertices() -> None:
    rng = np.random.default_rng(0)
    a = np.cumsum(rng.normal(0, 0.1, (6, 3)), axis=0)
    b = a + rng.normal(0, 0.01, a.shape)
    once = symmetric_mean(a, b)
    assert symmetric_mean(b, a) == pytest.approx(once)
    assert symmetric_mean(a[::-1], b) == pytest.approx(once, rel=1e-3)
    assert symmetric_mean(resample(a, 1e-4), b) == pytest.approx(once, rel=1e-2)


def test_coverage_counts_length_within_the_threshold() -> None:
    half = np.array([[0.0, 0, 1], [0.5, 0, 1]])
    assert coverage(half, LINE, 0.0001) == pytest.approx(0.5, abs=0.002)
    assert coverage(LINE, half, 0.0001) == 1.0
    assert coverage(LINE + [0, 0.011, 0], LINE, 0.01) == 0.0
