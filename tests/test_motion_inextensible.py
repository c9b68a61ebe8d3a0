"""The rope does not stretch: `make_inextensible` against rigid motions and random ones."""

from __future__ import annotations

import numpy as np
import pytest

from ropetrace.motion.inextensible import make_inextensible
from ropetrace.types import FloatArray


def helix(count: int = 40) -> FloatArray:
    angle = np.linspace(0, 4, count)
    return np.stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), 0.1 * angle], axis=1)


def test_a_rigid_motion_is_left_as_it_is() -> None:
    points, turn, shift = helix(), np.array([0.3, -1.0, 2.0]), np.array([0.5, 0.1, -0.4])
    velocities = np.cross(turn, points) + shift
    accelerations = np.cross(turn, np.cross(turn, points)) + [1.0, 2.0, 3.0]
    given = velocities.copy(), accelerations.copy()
    make_inextensible(points, velocities, accelerations, np.ones(len(points), np.bool_))
    np.testing.assert_allclose(velocities, given[0], atol=1e-12)
    np.testing.assert_allclose(accelerations, given[1], atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_a_straight_rope_keeps_its_lengths(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = np.linspace([0.0, 0.0, 1.0], [0.3, 0.4, 1.0], 30)
    along = np.array([0.6, 0.8, 0.0])
    velocities, accelerations = rng.normal(0, 0.5, (2, 30, 3))
    slid = (velocities @ along).mean(), (accelerations @ along).mean()
    across = velocities - (velocities @ along)[:, None] * along
    make_inextensible(points, velocities, accelerations, np.ones(len(points), np.bool_))
    steps, relative = np.diff(points, axis=0), np.diff(velocities, axis=0)
    np.testing.assert_allclose((steps * relative).sum(axis=1), 0, atol=1e-12)
    # The second derivative of the squared distance.
    pushed = (steps * np.diff(accelerations, axis=0)).sum(axis=1) + (relative**2).sum(axis=1)
    np.testing.assert_allclose(pushed, 0, atol=1e-12)
    np.testing.assert_allclose([(velocities @ along).mean(), (accelerations @ along).mean()], slid, atol=1e-12)
    np.testing.assert_allclose(velocities - (velocities @ along)[:, None] * along, across, atol=1e-12)


def test_noise_along_a_curve_is_taken_out() -> None:
    rng = np.random.default_rng(1)
    points = helix()
    truth = np.cross([0.0, 1.0, 0.5], points)
    tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    velocities = truth + rng.normal(0, 0.2, (40, 1)) * tangents
    before = np.abs(velocities - truth).mean()
    make_inextensible(points, velocities, np.zeros_like(points), np.ones(len(points), np.bool_))
    assert np.abs(velocities - truth).mean() < 0.3 * before


def test_points_that_coincide_do_no_harm() -> None:
    points = np.zeros((5, 3))
    velocities, accelerations = np.ones((2, 5, 3))
    make_inextensible(points, velocities, accelerations, np.ones(len(points), np.bool_))
    assert np.isfinite(velocities).all()
    assert np.isfinite(accelerations).all()
