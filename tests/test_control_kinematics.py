"""From the tool's velocity to the joints': equations 23-28 as printed, at singular poses, and within bounds."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import LinearConstraint, linprog, minimize

from ropetrace.control.arm import Arm, JointLimits
from ropetrace.control.kinematics import (
    GREATEST_DAMPING,
    THRESHOLD,
    damped_pseudoinverse,
    jacobian_derivatives,
    joint_limit_gradient,
    joint_limit_measure,
    joint_velocities,
    joint_velocities_within,
    manipulability,
    manipulability_gradient,
    secondary_velocity,
)
from ropetrace.types import FloatArray

seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module")
def panda() -> Arm:
    pytest.importorskip("pinocchio")
    return Arm.named("panda")


def random_joints(arm: Arm, count: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform(arm.limits.lower, arm.limits.upper, (count, arm.count))


def some_limits(count: int) -> JointLimits:
    ones = np.ones(count)
    return JointLimits(-2 * ones, np.linspace(1, 3, count), ones, ones, ones)


def chain_jacobian(q: FloatArray, seed: int) -> FloatArray:
    """Of an arm of joints with random axes and offsets: (6, n)."""
    rng = np.random.default_rng(seed)
    turn, place = np.eye(3), np.zeros(3)
    axes, places = [], []
    for angle in q:
        place = place + turn @ rng.normal(0, 0.3, 3)
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        axes.append(turn @ axis)
        places.append(place)
        cross = np.cross(np.eye(3), axis)
        turn = turn @ (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)
    tool = place + turn @ [0.1, 0.2, 0.3]
    return np.concatenate([np.cross(axes, tool - places), axes], axis=1).T


def slopes(function: Callable[[FloatArray], object], q: FloatArray, step: float = 1e-6) -> FloatArray:
    """Central differences by each joint, stacked at the first axis."""
    changes = np.eye(len(q)) * step
    return np.array([(np.asarray(function(q + one)) - np.asarray(function(q - one))) / (2 * step) for one in changes])


def adjugate(matrix: FloatArray) -> FloatArray:
    """The transposed cofactors, one minor at a time."""
    count = len(matrix)
    minors = [
        [np.linalg.det(np.delete(np.delete(matrix, i, 0), j, 1)) * (-1) ** (i + j) for j in range(count)]
        for i in range(count)
    ]
    return np.transpose(minors)


def rank_of_four(rng: np.random.Generator, count: int = 7) -> FloatArray:
    return np.asarray(rng.normal(size=(6, 4)) @ rng.normal(size=(4, count)))


# --- equations 24 to 27 and 23 ---


@settings(max_examples=30, deadline=None)
@given(seeds, st.integers(1, 9))
def test_derivatives_of_the_jacobian_are_its_differences(seed: int, count: int) -> None:
    q = np.random.default_rng(seed).uniform(-3, 3, count)
    expected = slopes(lambda angles: chain_jacobian(angles, seed), q)
    np.testing.assert_allclose(jacobian_derivatives(chain_jacobian(q, seed)), expected, atol=1e-8)


def test_manipulability_and_its_gradient_as_printed(panda: Arm) -> None:
    for q in random_joints(panda, 100):
        jacobian = panda.jacobian(q)
        square = jacobian @ jacobian.T
        measure = np.sqrt(np.linalg.det(square))
        assert manipulability(jacobian) == pytest.approx(measure, abs=1e-12)
        if measure < 1e-3:
            continue
        turned = [change @ jacobian.T for change in jacobian_derivatives(jacobian)]
        printed = [np.trace(adjugate(square) @ (one + one.T)) / (2 * measure) for one in turned]
        inverse = [measure * np.trace(np.linalg.inv(square) @ one) for one in turned]
        gradient = manipulability_gradient(jacobian)
        np.testing.assert_allclose(gradient, printed, atol=1e-9)
        np.testing.assert_allclose(gradient, inverse, atol=1e-9)
        np.testing.assert_allclose(gradient, slopes(lambda a: manipulability(panda.jacobian(a)), q), atol=1e-7)


def test_manipulability_of_the_ready_pose(panda: Arm) -> None:
    ready = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])
    assert manipulability(panda.jacobian(ready)) == pytest.approx(0.0801518, abs=1e-6)


def test_singular_poses_are_finite(panda: Arm) -> None:
    straight = panda.jacobian(np.zeros(7))
    rng = np.random.default_rng(0)
    for jacobian in (straight, np.zeros((6, 7)), rank_of_four(rng), rank_of_four(rng, 6), np.full((6, 7), 1e-200)):
        assert 0 <= manipulability(jacobian) < 1e-12
        assert np.isfinite(manipulability_gradient(jacobian)).all()
        assert np.isfinite(damped_pseudoinverse(jacobian)).all()
        assert np.isfinite(joint_velocities(jacobian, np.ones(6), np.ones(jacobian.shape[1]))).all()


def test_the_gradient_leads_out_of_a_singular_pose(panda: Arm) -> None:
    jacobian = panda.jacobian(np.zeros(7))
    gradient = manipulability_gradient(jacobian)
    assert manipulability(jacobian) < 1e-12
    ahead = manipulability(panda.jacobian(1e-3 * gradient))
    assert ahead == pytest.approx(1e-3 * gradient @ gradient, rel=0.01)
    assert ahead > 1e-9


def test_an_arm_of_too_few_joints_has_no_manipulability() -> None:
    jacobian = chain_jacobian(np.array([0.3, -0.4, 1.0]), 1)
    assert manipulability(jacobian) == 0
    np.testing.assert_array_equal(manipulability_gradient(jacobian), np.zeros(3))


def test_joint_limits_as_printed() -> None:
    limits = some_limits(7)
    for q in np.random.default_rng(0).uniform(-3, 4, (50, 7)):
        terms = [
            ((2 * angle - (high + low)) / (2 * (high - low))) ** 2
            for angle, low, high in zip(q, limits.lower, limits.upper, strict=True)
        ]
        assert joint_limit_measure(q, limits) == pytest.approx(-sum(terms) / 2, abs=1e-14)
        expected = slopes(lambda a: joint_limit_measure(a, limits), q)
        np.testing.assert_allclose(joint_limit_gradient(q, limits), expected, atol=1e-8)
    assert joint_limit_measure((limits.lower + limits.upper) / 2, limits) == 0
    assert joint_limit_measure(limits.upper, limits) == pytest.approx(-7 / 8)


def test_the_secondary_velocity_weighs_both_gradients(panda: Arm) -> None:
    for q in random_joints(panda, 20):
        jacobian = panda.jacobian(q)
        expected = 3 * manipulability_gradient(jacobian) + 0.5 * joint_limit_gradient(q, panda.limits)
        velocity = secondary_velocity(q, jacobian, panda.limits, k_s=3, k_jl=0.5)
        np.testing.assert_allclose(velocity, expected, atol=1e-14)


# --- equation 28 ---


def test_the_inverse_is_exact_away_from_singular_poses(panda: Arm) -> None:
    for q in random_joints(panda, 100):
        jacobian = panda.jacobian(q)
        exact = np.linalg.pinv(jacobian)
        np.testing.assert_allclose(damped_pseudoinverse(jacobian, greatest_damping=0), exact, rtol=1e-9, atol=1e-9)
        if np.linalg.svd(jacobian)[1][-1] > THRESHOLD:
            np.testing.assert_allclose(damped_pseudoinverse(jacobian), exact, atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(seeds, st.floats(1e-9, 1))
def test_damping_is_bounded_and_continuous(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    left, right = np.linalg.qr(rng.normal(size=(6, 6)))[0], np.linalg.qr(rng.normal(size=(7, 7)))[0]
    sizes = np.array([2, 1.5, 1, 0.5, 0.3, size])
    inverse = damped_pseudoinverse(left @ np.c_[np.diag(sizes), np.zeros(6)] @ right.T)
    damping = max(GREATEST_DAMPING**2 * (1 - (size / THRESHOLD) ** 2), 0)
    assert left[:, 5] @ (inverse.T @ right[:, 5]) == pytest.approx(size / (size**2 + damping), rel=1e-6)
    assert np.linalg.norm(inverse, 2) < 30


@settings(max_examples=50, deadline=None)
@given(seeds, st.integers(3, 9))
def test_the_secondary_wish_does_not_move_the_tool(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    jacobian = chain_jacobian(rng.uniform(-3, 3, count), seed) if seed % 3 else rank_of_four(rng, count)
    twist, wish = rng.normal(size=6), rng.normal(0, 5, count)
    alone = joint_velocities(jacobian, twist, np.zeros(count))
    both = joint_velocities(jacobian, twist, wish)
    np.testing.assert_allclose(jacobian @ both, jacobian @ alone, atol=1e-9)
    np.testing.assert_allclose(alone, damped_pseudoinverse(jacobian) @ twist, rtol=1e-9, atol=1e-9)


def test_equation_28_as_printed_where_nothing_is_damped(panda: Arm) -> None:
    rng = np.random.default_rng(0)
    for q in random_joints(panda, 100):
        jacobian, twist, wish = panda.jacobian(q), rng.normal(size=6), rng.normal(size=7)
        if np.linalg.svd(jacobian)[1][-1] > THRESHOLD:
            inverse = np.linalg.pinv(jacobian)
            printed = inverse @ twist + (np.eye(7) - inverse @ jacobian) @ wish
            np.testing.assert_allclose(joint_velocities(jacobian, twist, wish), printed, atol=1e-10)


# --- within the bounds of the joints ---


def nothing_else(jacobian: FloatArray, twist: FloatArray) -> FloatArray:
    return joint_velocities(jacobian, twist, np.zeros(jacobian.shape[1]))


@settings(max_examples=300, deadline=None)
@given(seeds, st.integers(3, 9), st.floats(-3, 3), st.floats(-3, 3), st.floats(0, 0.6), st.booleans())
@example(seed=5647, count=9, fast=0.0, wishful=2.0, blocked=0.3, singular=False)
def test_velocities_are_inside_and_keep_their_direction(
    seed: int, count: int, fast: float, wishful: float, blocked: float, singular: bool
) -> None:
    rng = np.random.default_rng(seed)
    jacobian = rank_of_four(rng, count) if singular else chain_jacobian(rng.uniform(-3, 3, count), seed)
    twist, wish = rng.normal(size=6) * 10**fast, rng.normal(size=count) * 10**wishful
    lower = -rng.uniform(0, 2, count) * (rng.random(count) >= blocked)
    upper = rng.uniform(0, 2, count) * (rng.random(count) >= blocked)
    velocities, scale = joint_velocities_within(jacobian, twist, wish, lower, upper)
    assert np.isfinite(velocities).all()
    assert (lower <= velocities).all()
    assert (velocities <= upper).all()
    assert 0 <= scale <= 1
    tolerance = 1e-9 * max(1, float(np.abs(jacobian).max()))
    np.testing.assert_allclose(jacobian @ velocities, scale * jacobian @ nothing_else(jacobian, twist), atol=tolerance)
    plain = joint_velocities(jacobian, twist, wish)
    if (lower <= plain).all() and (plain <= upper).all():
        np.testing.assert_array_equal(velocities, plain)
        assert scale == 1


@pytest.mark.parametrize("kind", ["regular", "redundant", "singular", "too few"])
def test_the_scale_is_the_largest_and_the_wish_is_kept_best(kind: str) -> None:
    rng = np.random.default_rng(1)
    scaled = 0
    for _ in range(40):
        count = {"redundant": 8, "too few": 4}.get(kind, 7)
        jacobian = rank_of_four(rng) if kind == "singular" else chain_jacobian(rng.uniform(-3, 3, count), 7)
        twist, wish = rng.normal(size=6) * 10 ** rng.uniform(-1, 1), rng.normal(size=count) * 10 ** rng.uniform(-1, 1)
        lower, upper = -rng.uniform(0.1, 2, count), rng.uniform(0.1, 2, count)
        velocities, scale = joint_velocities_within(jacobian, twist, wish, lower, upper)
        scaled += scale < 1

        primary = nothing_else(jacobian, twist)
        rank = np.linalg.matrix_rank(jacobian, 1e-9)
        null = np.linalg.svd(jacobian)[2][rank:].T
        table = np.c_[primary, null]
        free = [(None, None)] * null.shape[1]
        best = linprog(-np.eye(len(free) + 1)[0], np.r_[table, -table], np.r_[upper, -lower], bounds=[(0, 1), *free]).x[
            0
        ]
        assert scale == pytest.approx(best, rel=1e-6)
        if scale < 1 or not free:
            continue
        nearest = minimize(
            lambda z, wanted: np.sum((z - wanted) ** 2),
            np.zeros(len(free)),
            (null.T @ wish,),
            method="SLSQP",
            constraints=LinearConstraint(null, lower - primary, upper - primary),
            options={"ftol": 1e-14},
        ).x
        np.testing.assert_allclose(null.T @ velocities, nearest, atol=1e-5)
    assert 5 < scaled < 38


def test_the_wish_gives_way_before_the_twist() -> None:
    jacobian = np.concatenate([np.eye(6), [[1.0], [0], [0], [0], [0], [0]]], axis=1)
    twist, bounds = np.array([1.5, 0, 0, 0, 0, 0]), np.ones(7)
    velocities, scale = joint_velocities_within(jacobian, twist, np.eye(7)[0] * 4, -bounds, bounds)
    np.testing.assert_allclose(velocities, [1, 0, 0, 0, 0, 0, 0.5], atol=1e-12)
    assert scale == 1
    velocities, scale = joint_velocities_within(jacobian, 2 * twist, np.eye(7)[0] * 4, -bounds, bounds)
    np.testing.assert_allclose(velocities, [1, 0, 0, 0, 0, 0, 1], atol=1e-12)
    assert scale == pytest.approx(2 / 3, abs=1e-12)


def test_no_pose_of_the_panda_breaks_a_speed_limit(panda: Arm) -> None:
    rng = np.random.default_rng(2)
    speed = panda.limits.velocity
    slowed = 0
    for q in random_joints(panda, 10_000):
        direction = rng.normal(size=3)
        twist = np.r_[0.1 * direction / np.linalg.norm(direction), np.zeros(3)]
        jacobian = panda.jacobian(q)
        wish = secondary_velocity(q, jacobian, panda.limits, 1, 1)
        velocities, scale = joint_velocities_within(jacobian, twist, wish, -speed, speed)
        assert (np.abs(velocities) <= speed).all()
        slowed += scale < 1
    assert slowed < 100


def test_a_joint_at_rest_blocks_only_what_needs_it(panda: Arm) -> None:
    rng = np.random.default_rng(3)
    for q in random_joints(panda, 50):
        jacobian = panda.jacobian(q)
        blocked = rng.integers(7)
        bounds = np.where(np.arange(7) == blocked, 0.0, 1e6)
        velocities, scale = joint_velocities_within(jacobian, rng.normal(size=6), np.zeros(7), -bounds, bounds)
        assert velocities[blocked] == 0
        assert scale == 1


def test_enormous_numbers_stop_the_arm() -> None:
    jacobian, bounds = chain_jacobian(np.linspace(-1, 1, 7), 0), np.ones(7)
    for twist, wish in ((np.full(6, 1e308), np.ones(7)), (np.ones(6), np.full(7, 1.7e308))):
        velocities, scale = joint_velocities_within(jacobian, twist, wish, -bounds, bounds)
        assert (np.abs(velocities) <= bounds).all()
        assert 0 <= scale <= 1


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("place", range(5))
def test_no_number_no_velocity(bad: float, place: int) -> None:
    arguments: list[Any] = [chain_jacobian(np.linspace(-1, 1, 7), 0), np.ones(6), np.ones(7), -np.ones(7), np.ones(7)]
    arguments[place].flat[3] = bad
    with pytest.raises(ValueError, match="finite"):
        joint_velocities_within(*arguments)
    if place < 3:
        with pytest.raises(ValueError, match="finite"):
            joint_velocities(*arguments[:3])


def test_what_does_not_fit_is_refused() -> None:
    jacobian, twist, seven = np.ones((6, 7)), np.ones(6), np.ones(7)
    with pytest.raises(ValueError, match=re.escape("the Jacobian has shape (7, 6): expected (6, n)")):
        joint_velocities(jacobian.T, twist, twist)
    with pytest.raises(ValueError, match=re.escape("twist has shape (3,): expected (6,)")):
        joint_velocities(jacobian, np.ones(3), seven)
    with pytest.raises(ValueError, match=re.escape("secondary has shape (6,): expected (7,)")):
        joint_velocities(jacobian, twist, twist)
    with pytest.raises(ValueError, match=re.escape("upper has shape (6,): expected (7,)")):
        joint_velocities_within(jacobian, twist, seven, -seven, twist)
    with pytest.raises(ValueError, match=re.escape("q has shape (6,): expected (7,)")):
        secondary_velocity(twist, jacobian, some_limits(7), 1, 1)
    for lower, upper in ((0.1 * seven, seven), (-seven, -0.1 * seven)):
        with pytest.raises(ValueError, match="lower <= 0 <= upper"):
            joint_velocities_within(jacobian, twist, seven, lower, upper)
