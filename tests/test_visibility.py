"""The share of a rope that a camera sees, on scenes where it can be said in advance."""

from __future__ import annotations

import numpy as np
import pytest

from helpers import SHAPES, SMALL, at_equal_length, random_rotation
from ropetrace.sim.scene import Boxes, Capsules, Plane, Scene
from ropetrace.sim.visibility import visible_fraction, visible_samples
from ropetrace.types import FloatArray

RADIUS = 0.0075


def line(count: int = 1001, half: float = 0.2) -> FloatArray:
    """Samples of a straight level rope, 1 m away."""
    x = np.linspace(-half, half, count)
    return np.stack([x, np.zeros(count), np.ones(count)], axis=1)


def rope(points: FloatArray, label: int = 0) -> Capsules:
    return Capsules.along(points, RADIUS, label=label)


def test_a_free_rope_is_seen_whole() -> None:
    points = line()
    assert visible_samples(Scene(rope(points[[0, -1]])), SMALL, points, RADIUS).all()
    assert visible_fraction(Scene(rope(points)), SMALL, points, RADIUS) == 1


def test_half_hidden_by_a_box() -> None:
    """A box 0.5 m away from x = 0 on covers just the half of the rope with x > 0."""
    points = line(1000)
    box = Boxes.one((0.25, 0, 0.6), (0.5, 0.3, 0.2), (9, 9, 9), 3)
    seen = visible_samples(Scene(rope(points[[0, -1]]), boxes=box), SMALL, points, RADIUS)
    np.testing.assert_array_equal(seen, points[:, 0] < 0)
    behind = Boxes.one((0.25, 0, 1.6), (0.5, 0.3, 0.2), (9, 9, 9), 3)
    assert visible_fraction(Scene(rope(points[[0, -1]]), boxes=behind), SMALL, points, RADIUS) == 1


def test_hidden_by_a_ball_of_known_shadow() -> None:
    """A ball of radius r at distance d hides a disc of half angle asin(r / d): 0.2 / 0.8 hides |x| < 0.258 m."""
    points = line(2001, 0.5)
    ball = Capsules.sphere((0.0, 0.0, 0.8), 0.15, label=2)
    fraction = visible_fraction(Scene(rope(points[[0, -1]]) + ball), SMALL, points, RADIUS)
    assert fraction == pytest.approx(1 - np.tan(np.arcsin(0.15 / 0.8)) / 0.5, abs=1e-3)


def test_hidden_by_a_wall_and_by_another_rope_but_not_by_its_own_label() -> None:
    points = line()
    scene = Scene(rope(points[[0, -1]]), (Plane((0.0, 0.0, 1.0), 0.9, (9, 9, 9), 1),))
    assert visible_fraction(scene, SMALL, points, RADIUS) == 0
    other = rope(points[[0, -1]] * [1, 1, 0.9], label=1)
    assert visible_fraction(Scene(rope(points[[0, -1]]) + other), SMALL, points, RADIUS) == 0
    assert visible_fraction(Scene(other), SMALL, points * [1, 1, 0.9], RADIUS, label=1) == 1


def test_out_of_the_image_and_behind_the_camera() -> None:
    points = line(4001, 1.0)
    seen = visible_samples(Scene(rope(points[[0, -1]])), SMALL, points, RADIUS)
    column = points[:, 0] * SMALL.fx + SMALL.cx
    np.testing.assert_array_equal(seen, (column >= -0.5) & (column < 479.5))
    backwards = points * [1, 1, -1]
    assert visible_fraction(Scene(rope(backwards[[0, -1]])), SMALL, backwards, RADIUS) == 0


@pytest.mark.parametrize("gap", [2 * RADIUS, 0.1])
def test_a_rope_hides_itself_where_it_crosses(gap: float) -> None:
    """The rear strand of a loop is hidden by the front one over the front one's width, even where they touch."""
    x = np.linspace(-0.2, 0.2, 801)
    rear = np.stack([x, 0 * x, np.ones(801)], axis=1)
    turn = np.array([[0.4, 0.0, 1.0], [0.4, 0.4, 1.0], [0.0, 0.4, 1 - gap]])
    front = np.stack([0 * x, -x, np.full(801, 1 - gap)], axis=1)
    points = np.concatenate([rear, turn, front])
    seen = visible_samples(Scene(rope(points)), SMALL, points, RADIUS)
    assert seen[-801:].all()
    hidden = np.abs(rear[~seen[:801], 0])
    # The tangent of the half angle of the front strand, at the rear strand's distance.
    half_width = np.tan(np.arcsin(RADIUS / (1 - gap)))
    assert hidden.max() == pytest.approx(half_width, abs=0.0006)
    assert len(hidden) == pytest.approx(2 * half_width / 0.0005, abs=2)


@pytest.mark.parametrize(("degrees", "expected"), [(90, 1.0), (45, 1.0), (25, 1.0), (10, 0.115)])
def test_a_slanted_rope_is_seen_unless_it_points_at_the_camera(degrees: float, expected: float) -> None:
    part = np.linspace(-0.1, 0.1, 401)[:, None]
    points = part * [np.sin(np.radians(degrees)), 0, np.cos(np.radians(degrees))] + [0, 0, 1]
    fraction = visible_fraction(Scene(rope(points[[0, -1]])), SMALL, points, RADIUS)
    assert fraction == pytest.approx(expected, abs=0.01)


def test_of_a_rope_along_the_ray_only_the_tip_is_seen() -> None:
    points = np.stack([np.zeros(401), np.zeros(401), np.linspace(0.8, 1.2, 401)], axis=1)
    seen = visible_samples(Scene(rope(points[[0, -1]])), SMALL, points, RADIUS)
    np.testing.assert_array_equal(seen, points[:, 2] <= 0.8 + 3 * RADIUS)


@pytest.mark.parametrize("name", ["s", "figure 8", "crossing loop", "helix"])
def test_the_world_may_turn(name: str) -> None:
    rng = np.random.default_rng(1)
    points = at_equal_length(SHAPES[name], 400)
    scene = Scene(rope(points), boxes=Boxes.one((0.05, 0, 0.7), (0.1, 0.1, 0.1), (9, 9, 9), 1, random_rotation(rng)))
    here = visible_samples(scene, SMALL, points, RADIUS)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = random_rotation(rng), (1, 2, 3)
    moved = points @ pose[:3, :3].T + pose[:3, 3]
    there = visible_samples(scene.transformed(pose), SMALL, moved, RADIUS, world_from_camera=pose)
    assert 0.3 < here.mean() < 1
    assert (here != there).sum() <= 1
