"""The paper's Algorithm 1: right where the rope moves across itself, wrong where it moves along itself."""

from __future__ import annotations

import numpy as np
import pytest

from ropetrace.motion.closest import ClosestMotion
from ropetrace.types import FloatArray, Motion, Waypoints

DT = 1 / 30


def line(start: FloatArray, count: int = 40) -> Waypoints:
    """A straight rope along x with waypoints 6 mm apart."""
    places = np.linspace(0, 0.006 * (count - 1), count)
    return Waypoints(start + places[:, None] * [1.0, 0, 0], np.tile([0.0, 0, 0, 1], (count, 1)), places)


def run(starts: FloatArray, dt: float = DT) -> tuple[ClosestMotion, list[Motion | None]]:
    estimator = ClosestMotion()
    return estimator, [estimator.update(round(i * dt * 1e9), line(start)) for i, start in enumerate(starts)]


def test_a_constant_velocity_across_the_rope_is_exact_from_the_second_frame() -> None:
    velocity = np.array([0.0, 0.04, -0.05])
    estimator, motions = run(np.arange(6)[:, None] * DT * velocity)
    assert motions[0] is None
    for motion in motions[1:]:
        assert motion is not None
        np.testing.assert_allclose(motion.velocities, np.tile(velocity, (40, 1)), atol=1e-6)
        np.testing.assert_allclose(motion.accelerations, 0, atol=1e-4)
    prediction = estimator.predict(0.1)
    assert prediction is not None
    np.testing.assert_allclose(prediction[0], line((5 * DT + 0.1) * velocity).positions, atol=1e-6)


def test_an_acceleration_across_the_rope_is_found() -> None:
    time = np.arange(40) * DT
    _, motions = run(0.5 * time[:, None] ** 2 * [0.0, 0.3, 0])
    assert motions[-1] is not None
    np.testing.assert_allclose(motions[-1].accelerations[:, 1], 0.3, rtol=0.1)
    np.testing.assert_allclose(motions[-1].velocities[:, 1], 0.3 * time[-1], rtol=0.05)


def test_a_rope_that_moves_along_itself_seems_to_stand_still() -> None:
    """The weakness that `ArcLengthMotion` is for: by whole spacings, most waypoints find another's place."""
    _, motions = run(np.arange(6)[:, None] * [0.006, 0, 0])
    assert motions[-1] is not None
    np.testing.assert_allclose(motions[-1].velocities[:-6], 0, atol=1e-9)


def test_sigmas_shrink_with_frames_and_grow_with_the_prediction() -> None:
    estimator, motions = run(np.zeros((30, 3)))
    first, last = motions[1], motions[-1]
    assert first is not None
    assert last is not None
    assert (last.velocity_sigma <= first.velocity_sigma).all()
    ahead = [estimator.predict(t) for t in (0.0, 0.02, 0.1)]
    sigmas = [prediction[1].position_sigma[0, 0] for prediction in ahead if prediction is not None]
    assert len(sigmas) == 3
    assert sigmas == sorted(sigmas)
    assert sigmas[0] < sigmas[-1]


def test_a_jump_or_a_pause_starts_again() -> None:
    estimator = ClosestMotion()
    origin = np.zeros(3)
    assert estimator.update(0, line(origin)) is None
    assert estimator.update(33_000_000, line(origin)) is not None
    assert estimator.update(66_000_000, line(origin + [0, 2.0, 0])) is None
    assert estimator.predict(0.04) is None
    motion = estimator.update(99_000_000, line(origin + [0, 2.0, 0]))
    assert motion is not None
    np.testing.assert_allclose(motion.velocities, 0, atol=1e-9)
    assert estimator.update(500_000_000, line(origin + [0, 2.1, 0])) is None
    motion = estimator.update(533_000_000, line(origin + [0, 2.1, 0]))
    assert motion is not None
    np.testing.assert_allclose(motion.velocities, 0, atol=1e-9)


def test_a_stamp_that_repeats_or_runs_back_adds_nothing() -> None:
    estimator = ClosestMotion()
    for stamp, y in ((0, 0.0), (10, 0.001)):
        motion = estimator.update(stamp * 1_000_000, line(np.array([0, y, 0])))
    assert motion is not None
    for stamp in (10, 5):
        assert estimator.update(stamp * 1_000_000, line(np.array([0, 0.5, 0]))) is None
    motion = estimator.update(20_000_000, line(np.array([0, 0.002, 0])))
    assert motion is not None
    np.testing.assert_allclose(motion.velocities[:, 1], 0.1, rtol=1e-6)


def test_no_waypoints_and_no_numbers() -> None:
    estimator = ClosestMotion()
    assert estimator.update(0, Waypoints.none()) is None
    assert estimator.predict(0.1) is None
    with pytest.raises(ValueError, match="finite"):
        estimator.update(0, line(np.array([np.nan, 0, 0])))
    estimator.update(0, line(np.zeros(3)))
    estimator.update(1_000_000, line(np.zeros(3)))
    estimator.reset()
    assert estimator.predict(0.1) is None
