"""The ray caster: equal to rays followed one by one, and exact on surfaces with a formula."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from helpers import random_rotation
from ropetrace.errors import ConfigError
from ropetrace.sim.raycaster import NO_LABEL, RayCaster, Rendering
from ropetrace.sim.scene import (
    FAR,
    NEAR,
    Boxes,
    Capsules,
    Plane,
    Scene,
    check_camera_outside,
    inverse_pose,
    looking_at,
)
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


# --- boxes, planes, poses ---


def random_pose(rng: np.random.Generator) -> FloatArray:
    pose = np.eye(4)
    pose[:3, :3] = random_rotation(rng)
    pose[:3, 3] = rng.normal(0, 1, 3)
    return pose


def slabs(center: FloatArray, rotation: FloatArray, half: FloatArray) -> FloatArray:
    """Depth of a box, by the three pairs of its faces."""
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = rays() @ rotation
        origin = -center @ rotation
        first, last = (-half - origin) / steps, (half - origin) / steps
    entry = np.minimum(first, last).max(axis=-1)
    leave = np.maximum(first, last).min(axis=-1)
    return np.where((entry <= leave) & (entry > NEAR), entry, 0)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_boxes_equal_their_slabs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    center, half = rng.uniform([-0.8, -0.6, -0.3], [0.8, 0.6, 2.5]), rng.uniform(0.05, 0.4, 3)
    rotation = random_rotation(rng)
    size = (float(2 * half[0]), float(2 * half[1]), float(2 * half[2]))
    boxes = Boxes.one((float(center[0]), float(center[1]), float(center[2])), size, (9, 9, 9), 5, rotation)
    image = RayCaster(CAMERA).render(Scene(Capsules.none(), boxes=boxes))
    expected = slabs(center, rotation, half)
    seen = image.depth > 0
    assert (seen != (expected > 0)).sum() <= 1
    np.testing.assert_allclose(image.depth[seen], expected[seen], rtol=2e-7)
    np.testing.assert_array_equal(image.label, np.where(seen, 5, NO_LABEL))


def test_a_box_faces_the_camera_in_full_color() -> None:
    boxes = Boxes.one((0, 0, 1.1), (0.2, 0.1, 0.2), (200, 150, 100), 2)
    image = RayCaster(CAMERA).render(Scene(Capsules.none(), boxes=boxes + Boxes.none()))
    np.testing.assert_allclose(image.depth[image.depth > 0], 1.0, rtol=1e-7)
    assert np.abs(image.color[17, 23].astype(int) - (200, 150, 100)).max() <= 1
    top, bottom, left, right = image.window
    outside = np.ones(image.depth.shape, bool)
    outside[top:bottom, left:right] = False
    assert outside.sum() > 1000
    assert not image.depth[outside].any()


def test_planes_equal_their_formula_in_depth_and_color() -> None:
    """A wall and a tilted floor: the nearer one, lit by the cosine, darker in linear light."""
    planes = (Plane((0.1, 0.0, 1.0), 1.5, (200, 180, 90), 1), Plane((0.0, 2.0, -0.2), 0.5, (30, 90, 250), 2))
    image = RayCaster(CAMERA).render(Scene(Capsules.none(), planes))
    slopes = np.stack([rays() @ np.array(plane.normal) for plane in planes])
    z = np.array([1.5, 0.5])[:, None, None] / slopes
    z[z <= NEAR] = np.inf
    nearest = z.argmin(axis=0)
    assert 100 < nearest.sum() < nearest.size - 100
    np.testing.assert_array_equal(image.label, nearest + 1)
    np.testing.assert_allclose(image.depth, z.min(axis=0), rtol=1e-7)
    sizes = np.array([np.linalg.norm(plane.normal) for plane in planes])[:, None, None] * np.linalg.norm(rays(), axis=2)
    light = 0.5 + 0.5 * np.take_along_axis(np.abs(slopes) / sizes, nearest[None], axis=0)[0]
    colors = np.array([plane.color for plane in planes])[nearest] / 255
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4) * light[..., None]
    expected = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055) * 255
    assert np.abs(image.color - expected).max() < 2


def test_an_endless_floor_ends_at_the_farthest_distance() -> None:
    image = RayCaster(CAMERA).render(Scene(Capsules.none(), (Plane((0.0, 1.0, 0.0), 30.0, (9, 9, 9), 1),)))
    assert (image.depth[:17] == 0).all()
    assert image.depth.max() <= FAR
    level = Intrinsics(48, 35, 41.0, 41.0, 23.5, 17.0)
    image = RayCaster(level).render(Scene(Capsules.none(), (Plane((0.0, 1.0, 0.0), 0.3, (9, 9, 9), 1),)))
    assert (image.depth[17] == 0).all()
    assert (image.depth[18:] > 0).all()


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_scene_in_the_world_looks_as_it_does_in_the_camera(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = Scene(
        random_capsules(rng, 3),
        (Plane((0.1, -0.2, 1.0), 2.5, (10, 20, 30), 9),),
        Boxes.one((0.3, 0.1, 1.5), (0.3, 0.2, 0.4), (9, 90, 9), 8, random_rotation(rng)),
    )
    near = RayCaster(CAMERA).render(scene)
    pose = random_pose(rng)
    far = RayCaster(CAMERA).render(scene.transformed(pose), pose)
    assert (near.label != far.label).sum() <= 3
    same = (near.label == far.label) & (near.depth > 0)
    # A ray that grazes a capsule turns rounding of the pose into a micrometre.
    np.testing.assert_allclose(near.depth[same], far.depth[same], atol=1e-5)


def test_pixels_lie_on_the_surfaces_that_they_name() -> None:
    """Back-projected, a large image of a rope lies on the rope to the rounding of float32."""
    camera = Intrinsics(640, 480, 554.0, 554.0, 319.5, 239.5)
    y = np.linspace(-0.3, 0.3, 12)
    rope = Capsules.along(np.stack([0.1 * np.sin(8 * y), y, 1 + 0.2 * np.cos(6 * y)], axis=1), 0.0075)
    image = RayCaster(camera).render(Scene(rope))
    rows, columns = np.nonzero(image.depth)
    z = image.depth[rows, columns].astype(float)
    points = np.stack([(columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z], axis=1)
    assert len(points) > 2500
    assert np.abs(distance_to_axes(points, rope)).max() < 1e-7


def test_looking_at_puts_the_target_in_the_middle() -> None:
    pose = looking_at((1.0, -2.0, 0.5), (0.2, 0.1, 0.9))
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    target = inverse_pose(pose) @ [0.2, 0.1, 0.9, 1.0]
    np.testing.assert_allclose(target[:2], 0, atol=1e-12)
    assert target[2] > 0
    assert pose[2, 1] < 0  # the image's y points down in the world
    with pytest.raises(ConfigError, match="upwards"):
        looking_at((0.0, 0.0, 1.0), (0.0, 0.0, 3.0))


@pytest.mark.parametrize(
    ("position", "message"),
    [
        ((0.0, 0.0, 0.5), r"7.5 mm inside capsule 1 \(label 4\)"),
        ((0.012, 0.0, 0.5), r"only 4.5 mm from capsule 1 \(label 4\)"),
        ((0.55, 0.0, 0.0), r"50.0 mm inside box 0 \(label 6\)"),
        ((0.5, 0.0, 0.105), r"only 5.0 mm from box 0"),
    ],
)
def test_a_camera_in_the_rope_is_refused(position: tuple[float, float, float], message: str) -> None:
    rope = Capsules.along(np.array([[0, 0, 1.0], [0, 0, 0.7], [0, 0, 0.2]]), 0.0075, label=4)
    scene = Scene(rope, boxes=Boxes.one((0.5, 0, 0), (0.2, 0.2, 0.2), (9, 9, 9), 6))
    pose = np.eye(4)
    pose[:3, 3] = position
    with pytest.raises(ConfigError, match=message):
        check_camera_outside(scene, pose)
    pose[:3, 3] = (0.3, 0.3, 0.3)
    check_camera_outside(scene, pose)
    check_camera_outside(Scene(Capsules.none()))
