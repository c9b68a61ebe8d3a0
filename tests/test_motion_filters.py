"""The bank of filters against plain NumPy: a Kalman filter with matrices, a mixture, a banded solver."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from ropetrace.motion import filters
from ropetrace.types import FloatArray

seeds = st.integers(0, 2**32 - 1)
MODELS = len(filters.AGILITIES)
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Where the six numbers of a spread stand in its matrix."""


def matrix_of(spread: FloatArray) -> FloatArray:
    matrix = np.empty((3, 3))
    for value, (row, column) in zip(spread, UPPER, strict=True):
        matrix[row, column] = matrix[column, row] = value
    return matrix


def spread_of(matrix: FloatArray) -> FloatArray:
    return np.array([matrix[place] for place in UPPER])


def random_bank(seed: int, count: int) -> tuple[FloatArray, FloatArray]:
    """States (K, N, 3, 3) and spreads (K, N, 6) that are covariances."""
    rng = np.random.default_rng(seed)
    roots = rng.normal(0, 1, (MODELS, count, 3, 3))
    covariances = roots @ roots.transpose(0, 1, 3, 2) + 0.01 * np.eye(3)
    spreads = np.array([[spread_of(matrix) for matrix in row] for row in covariances])
    return rng.normal(0, 1, (MODELS, count, 3, 3)), spreads


def transition_matrix(dt: float) -> FloatArray:
    f01, f02, f12, f22 = filters.transition(dt)
    return np.array([[1, f01, f02], [0, 1, f12], [0, 0, f22]])


@given(st.floats(0, 2))
def test_the_transition_solves_the_equation_of_motion(dt: float) -> None:
    system = np.array([[0, 1, 0], [0, 0, 1], [0, 0, -1 / filters.DECAY]])
    np.testing.assert_allclose(transition_matrix(dt), expm(system * dt), rtol=1e-9, atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(seeds, st.floats(1e-4, 0.25))
def test_advance_is_the_prediction_of_a_kalman_filter(seed: int, dt: float) -> None:
    states, spreads = random_bank(seed, 3)
    new_states, new_spreads = states.copy(), spreads.copy()
    filters.advance(new_states, new_spreads, dt)
    step = transition_matrix(dt)
    white_jerk = np.array(
        [
            [dt**5 / 20, dt**4 / 8, dt**3 / 6],
            [dt**4 / 8, dt**3 / 3, dt**2 / 2],
            [dt**3 / 6, dt**2 / 2, dt],
        ]
    )
    for k, agility in enumerate(filters.AGILITIES):
        for n in range(3):
            np.testing.assert_allclose(new_states[k, n], step @ states[k, n], rtol=1e-9, atol=1e-12)
            expected = step @ matrix_of(spreads[k, n]) @ step.T + agility**2 * white_jerk
            np.testing.assert_allclose(matrix_of(new_spreads[k, n]), expected, rtol=1e-9, atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_correct_is_the_update_of_a_kalman_filter(seed: int) -> None:
    states, spreads = random_bank(seed, 5)
    points = np.random.default_rng(seed + 1).normal(0, 1, (5, 3))
    measured = np.array([True, True, False, True, False])
    new_states, new_spreads = states.copy(), spreads.copy()
    evidence, surprise = np.zeros((MODELS, 5, 3)), np.zeros((MODELS, 5))
    count = filters.correct(new_states, new_spreads, evidence, surprise, 2.0, points, measured)
    assert count == pytest.approx(2 * (1 - filters.MEMORY) + 1)
    sees = np.array([[1.0, 0, 0]])
    for k in range(MODELS):
        for n in range(5):
            if not measured[n]:
                np.testing.assert_array_equal(new_states[k, n], states[k, n])
                np.testing.assert_array_equal(new_spreads[k, n], spreads[k, n])
                assert surprise[k, n] == 0
                continue
            covariance = matrix_of(spreads[k, n])
            expected = (sees @ covariance @ sees.T + 1).item()
            gain = covariance @ sees.T / expected
            off = points[n] - states[k, n, 0]
            np.testing.assert_allclose(new_states[k, n], states[k, n] + gain * off, rtol=1e-9, atol=1e-12)
            rest = (np.eye(3) - gain @ sees) @ covariance
            np.testing.assert_allclose(matrix_of(new_spreads[k, n]), rest, rtol=1e-9, atol=1e-12)
            assert surprise[k, n] == pytest.approx(np.log(expected))


def evidence_of(innovations: FloatArray, measured: FloatArray) -> FloatArray:
    """What one frame of innovations (N, 3) adds to the evidence of the first filter."""
    count = len(innovations)
    states, spreads = np.zeros((MODELS, count, 3, 3)), np.zeros((MODELS, count, 6))
    evidence, surprise = np.zeros((MODELS, count, 3)), np.zeros((MODELS, count))
    filters.correct(states, spreads, evidence, surprise, 0.0, innovations, measured)
    return np.asarray(evidence[0])


def test_evidence_is_shared_with_neighbours_and_bridges_gaps() -> None:
    everywhere = np.ones(60, bool)
    np.testing.assert_allclose(evidence_of(np.full((60, 3), 2.0), everywhere), 4.0)
    spike = np.zeros((60, 3))
    spike[30] = 1.0
    shared = evidence_of(spike, everywhere)[:, 0]
    assert shared.argmax() == 30
    assert shared.sum() == pytest.approx(1, rel=0.01)
    assert shared[25] == pytest.approx(shared[35], rel=0.01)
    assert 0.1 < shared[35] / shared[30] < 0.3
    hidden = everywhere.copy()
    hidden[:20] = hidden[40:] = False
    far = spike * 1e6
    far[30] = 0
    np.testing.assert_array_equal(evidence_of(far, hidden), 0.0)
    np.testing.assert_allclose(evidence_of(np.full((60, 3), 2.0), hidden), 4.0)
    np.testing.assert_array_equal(evidence_of(far, np.zeros(60, bool)), 0.0)


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_the_mixture_has_the_mean_and_covariance_of_its_parts(seed: int) -> None:
    states, spreads = random_bank(seed, 4)
    rng = np.random.default_rng(seed)
    noise = rng.uniform(0.5, 2, (MODELS, 4, 3))
    weights = rng.dirichlet(np.ones(MODELS), 4).T.copy()
    means, covariances = np.ones((4, 3, 3)), np.ones((4, 3, 6))
    filters.mixture(states, spreads, noise, weights, means, covariances)
    np.testing.assert_allclose(means, np.einsum("kn,kndc->ndc", weights, states), atol=1e-12)
    for n in range(4):
        for c in range(3):
            expected = np.zeros((3, 3))
            for k in range(MODELS):
                off = states[k, n, :, c] - means[n, :, c]
                expected += weights[k, n] * (noise[k, n, c] * matrix_of(spreads[k, n]) + np.outer(off, off))
            np.testing.assert_allclose(matrix_of(covariances[n, c]), expected, rtol=1e-9, atol=1e-12)


def test_the_filter_that_expects_what_comes_has_the_weight_and_finds_the_noise() -> None:
    """White noise round a point at rest: the calmest filter; round a point that is shaken: an agile one."""
    rng = np.random.default_rng(0)
    chosen, found = [], []
    for shaken in (0.0, 0.05):
        states, spreads = np.zeros((MODELS, 8, 3, 3)), np.tile([1.0, 0, 0, 1, 0, 1], (MODELS, 8, 1))
        evidence, surprise = np.full((MODELS, 8, 3), 3e-6), np.zeros((MODELS, 8))
        noise, weights = np.full((MODELS, 8, 3), 1e-6), np.full((MODELS, 8), 1 / MODELS)
        count = 3.0
        for index in range(60):
            filters.advance(states, spreads, 1 / 30)
            points = shaken * np.sin(index / 2) + rng.normal(0, 1e-3, (8, 3))
            count = filters.correct(states, spreads, evidence, surprise, count, points, np.ones(8, bool))
            filters.weigh(evidence, surprise, count, noise, weights)
        np.testing.assert_allclose(weights.sum(axis=0), 1)
        chosen.append(int(weights.mean(axis=1).argmax()))
        found.append(np.sqrt(noise[chosen[-1]].mean()))
    assert chosen[0] == 0
    assert chosen[1] >= 3
    np.testing.assert_allclose(found, 1e-3, rtol=0.5)


def test_weights_are_the_likelihoods() -> None:
    rng = np.random.default_rng(1)
    evidence, surprise, count = rng.uniform(1, 2, (MODELS, 2, 3)), rng.uniform(0, 3, (MODELS, 2)), 7.0
    noise, weights = np.empty((MODELS, 2, 3)), np.empty((MODELS, 2))
    filters.weigh(evidence, surprise, count, noise, weights)
    np.testing.assert_allclose(noise, evidence / count)
    fit = np.exp(-1.5 * surprise) * np.prod((evidence / count) ** (-count / 2), axis=2)
    np.testing.assert_allclose(weights, fit / fit.sum(axis=0))


def test_no_evidence_at_all_is_no_certainty() -> None:
    noise, weights = np.empty((MODELS, 2, 3)), np.empty((MODELS, 2))
    filters.weigh(np.zeros((MODELS, 2, 3)), np.full((MODELS, 2), 1e4), 10.0, noise, weights)
    assert (noise > 0).all()
    np.testing.assert_allclose(weights, 1 / MODELS)


def test_what_is_too_far_is_left_out() -> None:
    means, covariances = np.zeros((5, 3, 3)), np.zeros((5, 3, 6))
    covariances[2, :, 0] = 0.1**2 / 3
    points = np.zeros((5, 3))
    points[:, 0] = [0.005, 0.02, 0.3, 0.02, 5.0]
    unseen = np.array([0.0, 0.0, 0.0, 0.1, 0.0])
    measured = np.array([True, True, True, True, False])
    assert filters.outliers(means, covariances, points, unseen, 0.006, measured) == 1
    assert measured.tolist() == [True, False, True, True, False]


def test_the_jerk_density_is_that_of_the_weighted_filters() -> None:
    noise, weights = np.full((MODELS, 1, 3), 2.0), np.zeros((MODELS, 1))
    weights[[1, 4], 0] = 0.25, 0.75
    density = np.ones((1, 3))
    filters.jerk_density(noise, weights, density)
    np.testing.assert_allclose(density, 2 * (0.25 * filters.AGILITIES[1] ** 2 + 0.75 * filters.AGILITIES[4] ** 2))


@settings(max_examples=30, deadline=None)
@given(seeds, st.integers(1, 60), st.floats(0, 1e5))
def test_smoothing_solves_its_equations(seed: int, count: int, strength: float) -> None:
    values = np.random.default_rng(seed).normal(0, 1, (count, 3))
    matrix = np.eye(count)
    if count > 3:
        third = np.diff(np.eye(count), 3, axis=0)
        matrix += strength * third.T @ third
    smoothed = values.copy()
    filters.smooth(filters.smoothing_factor(count, strength), smoothed)
    np.testing.assert_allclose(smoothed, np.linalg.solve(matrix, values), rtol=1e-6, atol=1e-8)


def test_smoothing_leaves_parabolas_alone() -> None:
    s = np.linspace(-1, 1, 50)
    parabola = np.stack([1 + 0 * s, s, s**2], axis=1)
    smoothed = parabola.copy()
    filters.smooth(filters.smoothing_factor(50, 1e4), smoothed)
    np.testing.assert_allclose(smoothed, parabola, atol=1e-9)
