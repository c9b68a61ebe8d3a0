"""The ray caster: equal to rays followed one by one, and exact on surfaces with a formula; and the noise on top."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ropetrace.sim.camera import NEAR, NO_LABEL, Capsules, Plane, RayCaster, Rendering, Scene
from ropetrace.sim.noise import kinect_axial
from ropetrace.types import FloatArray, Intrinsics

CAMERA = Intrinsics(48, 36, 41.0, 43.0, 23.3, 17.1)
BALL = Capsules.along(np.array([[0.02, -0.01, 1.0], [0.02, -0.01, 1.0]]), 0.2, (90, 160, 30), 7)


def rays() -> FloatArray:
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    return np.stack([(columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy, np.ones(rows.shape)], axis=-1)


def distance_to_axes(points: FloatArray, capsules: Capsules) -> FloatArray:
    """Signed distance of (..., 3) points to the nearest capsule's surface."""
    best = np.full(points.shape[:-1], np.inf)
    for a, b, radius in zip(capsules.starts, capsules.ends, capsules.radii, strict=True):
        step = b - a
        part = np.clip((points - a) @ step / max(step @ step, 1e-300), 0, 1)
        best = np.minimum(best, np.linalg.norm(points - a - part[..., None] * step, axis=-1) - radius)
    return best


def traced(capsules: Capsules) -> FloatArray:
    """Depth by sphere tracing: from the camera on, as far as no surface can be, again and again."""
    directions = rays()
    sizes = np.linalg.norm(directions, axis=-1)
    z = np.full(sizes.shape, 1e-6)
    for _ in range(4000):
        gap = distance_to_axes(z[..., None] * directions, capsules)
        z = np.minimum(z + np.maximum(gap, 0) / sizes, 20.0)
        if (np.abs(gap[z < 20]) < 1e-9).all():
            break
    return np.where(z < 20, z, 0)


def random_capsules(rng: np.random.Generator, count: int) -> Capsules:
    starts = rng.uniform([-0.8, -0.6, 0.6], [0.8, 0.6, 2.5], (count, 3))
    ends = starts + rng.normal(0, 0.4, (count, 3)) * [1, 1, 0.5]
    ends[:, 2] = np.maximum(ends[:, 2], 0.5)
    ends[0] = starts[0]
    return Capsules(
        starts,
        ends,
        rng.uniform(0.02, 0.3, count),
        rng.integers(0, 256, (count, 3)).astype(np.uint8),
        np.arange(count).astype(np.int16),
    )


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4))
def test_depth_equals_sphere_tracing(seed: int, count: int) -> None:
    capsules = random_capsules(np.random.default_rng(seed), count)
    image = RayCaster(CAMERA).render(Scene(capsules))
    expected = traced(capsules)
    grazing = np.abs(distance_to_axes(np.maximum(expected, 1e-6)[..., None] * rays(), capsules)) > 1e-6
    seen, should = image.depth > 0, (expected > 0) & ~grazing
    # Sphere tracing cannot tell a ray that grazes a surface from one that meets it.
    assert (seen != should).mean() < 0.005
    both = seen & should
    np.testing.assert_allclose(image.depth[both], expected[both], atol=1e-4)
    np.testing.assert_array_equal(image.label >= 0, seen)


def test_a_ball_has_the_depth_of_its_formula() -> None:
    image = RayCaster(CAMERA).render(Scene(BALL))
    rows, columns = np.nonzero(image.depth)
    assert len(rows) > 100
    points = rays()[rows, columns] * image.depth[rows, columns][:, None]
    np.testing.assert_allclose(np.linalg.norm(points - BALL.starts[0], axis=1), 0.2, atol=1e-6)
    assert (points[:, 2] < BALL.starts[0, 2]).all()
    assert set(np.unique(image.label)) == {NO_LABEL, 7}


def test_nearer_hides_farther_whatever_comes_first() -> None:
    rng = np.random.default_rng(3)
    capsules = random_capsules(rng, 6)
    order = rng.permutation(6)
    turned = Capsules(
        capsules.starts[order],
        capsules.ends[order],
        capsules.radii[order],
        capsules.colors[order],
        capsules.labels[order],
    )
    caster = RayCaster(CAMERA)
    first = caster.render(Scene(capsules))
    depth, label, color = first.depth.copy(), first.label.copy(), first.color.copy()
    again = caster.render(Scene(turned))
    np.testing.assert_array_equal(again.depth, depth)
    np.testing.assert_array_equal(again.label, label)
    np.testing.assert_array_equal(again.color, color)


def test_a_plane_has_the_depth_of_its_formula() -> None:
    plane = Plane((0.1, -0.2, 1.0), 1.5, (10, 20, 30), 3)
    image = RayCaster(CAMERA).render(Scene(Capsules.none(), (plane,)))
    np.testing.assert_allclose(image.depth, 1.5 / (rays() @ np.array(plane.normal)), rtol=1e-6)
    assert (image.label == 3).all()


def test_a_wall_hides_and_is_hidden() -> None:
    wall = Plane((0.0, 0.0, 1.0), 0.9, (10, 20, 30), 3)
    image = RayCaster(CAMERA).render(Scene(BALL, (wall,)))
    alone = RayCaster(CAMERA).render(Scene(BALL))
    front = (alone.depth > 0) & (alone.depth < 0.9)
    assert 0 < front.sum() < (alone.depth > 0).sum()
    np.testing.assert_array_equal(image.label, np.where(front, 7, 3))
    behind = Plane((0.0, 0.0, 1.0), -2.0, (10, 20, 30), 3)
    assert (RayCaster(CAMERA).render(Scene(Capsules.none(), (behind,))).depth == 0).all()


def test_nothing_is_seen_of_what_lies_behind_or_at_the_camera() -> None:
    behind = Capsules.along(np.array([[0, 0, -1.0], [0.5, 0, -2.0]]), 0.1)
    assert (RayCaster(CAMERA).render(Scene(behind)).depth == 0).all()
    through = Capsules.along(np.array([[0.3, 0, -1.0], [0.3, 0, 3.0]]), 0.1)
    depth = RayCaster(CAMERA).render(Scene(through)).depth
    assert depth.any()
    assert depth[depth > 0].min() > NEAR


def test_light_falls_from_the_camera() -> None:
    """Full colour where a surface faces the camera, half of it in linear light at the rim."""

    def linear(srgb: NDArray[np.uint8]) -> FloatArray:
        share = srgb / 255
        return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)

    camera = Intrinsics(401, 401, 400.0, 400.0, 200.0, 200.0)
    ball = Capsules.along(np.array([[0, 0, 1.0], [0, 0, 1.0]]), 0.3, (200, 150, 100))
    image = RayCaster(camera).render(Scene(ball))
    assert image.color[200, 200].tolist() == [200, 150, 100]
    rim = image.color[200, np.flatnonzero(image.depth[200])[0]]
    np.testing.assert_allclose(linear(rim) / linear(np.array([200, 150, 100], np.uint8)), 0.5, atol=0.06)
    assert (image.color[image.depth == 0] == 0).all()


def test_a_call_overwrites_the_images_of_the_one_before() -> None:
    caster = RayCaster(CAMERA)
    assert caster.render(Scene(BALL)).depth.any()
    empty: Rendering = caster.render(Scene(Capsules.none()))
    assert not empty.depth.any()
    assert not empty.color.any()
    assert (empty.label == NO_LABEL).all()


def test_capsules_join() -> None:
    both = BALL + Capsules.along(np.array([[0.0, 0, 1], [0.1, 0, 1], [0.2, 0, 1]]), 0.01)
    assert (len(both.radii), both.labels.tolist()) == (3, [7, 0, 0])
    assert len((Capsules.none() + Capsules.none()).radii) == 0


# --- noise ---


def wall(distance: float) -> NDArray[np.float32]:
    return np.full((200, 300), distance, np.float32)


@pytest.mark.parametrize(("distance", "deviation"), [(0.4, 0.0012), (1.4, 0.0031), (2.4, 0.0088)])
def test_axial_noise_has_the_published_deviation(distance: float, deviation: float) -> None:
    noisy = kinect_axial(wall(distance), np.random.default_rng(0), lost_edges=0)
    metres = noisy * 0.001
    assert metres.mean() == pytest.approx(distance, abs=1e-4)
    assert metres.std() == pytest.approx(np.hypot(deviation, 0.001 / np.sqrt(12)), rel=0.03)


def test_edges_are_lost_at_the_rate_asked_for() -> None:
    depth = np.zeros((60, 400), np.float32)
    depth[20:40, 50:350] = 1.0
    edge = np.zeros(depth.shape, bool)
    edge[[20, 39], 50:350] = True
    edge[20:40, [50, 349]] = True
    for share in (0.0, 0.5, 1.0):
        noisy = kinect_axial(depth, np.random.default_rng(1), share)
        assert (noisy[edge] == 0).mean() == pytest.approx(share, abs=0.07)
        assert (noisy[(depth > 0) & ~edge] > 0).all()
        assert (noisy[depth == 0] == 0).all()


def test_noise_repeats_with_its_seed_and_leaves_its_input_alone() -> None:
    depth = wall(1.0)
    a = kinect_axial(depth, np.random.default_rng(5))
    np.testing.assert_array_equal(a, kinect_axial(depth, np.random.default_rng(5)))
    assert (a != kinect_axial(depth, np.random.default_rng(6))).any()
    assert (depth == 1.0).all()
    assert not kinect_axial(np.zeros((4, 5), np.float32), np.random.default_rng(0)).any()


def test_depth_is_counted_in_steps() -> None:
    coarse = kinect_axial(wall(1.0), np.random.default_rng(0), 0, step=0.01)
    assert coarse.dtype == np.uint16
    assert abs(int(np.median(coarse)) - 100) <= 1
    assert kinect_axial(wall(100.0), np.random.default_rng(0)).max() == 65535
