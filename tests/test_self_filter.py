"""The robot taken out of the image: against the definition, pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest

from ropetrace.self_filter import MARGIN, without_robot
from ropetrace.sim.camera import Capsules, RayCaster, Scene
from ropetrace.types import FloatArray, Intrinsics, RgbdFrame

LENS = Intrinsics(160, 120, 140.0, 145.0, 79.5, 59.5)
ROPE = Capsules.along(np.array([[-0.3, 0.05, 1.0], [0.3, -0.05, 1.0]]), 0.01)
ARM = Capsules.between(
    np.array([[0.1, -0.5, 1.2], [0.0, 0.2, 1.15]]), np.array([[0.1, 0.1, 1.15], [0.0, 0.2, 1.15]]), 0.06
)


def exposed(scene: Scene, unit: float | None = None) -> RgbdFrame:
    image = RayCaster(LENS).render(scene)
    if unit is None:
        return RgbdFrame(0, image.depth.copy(), 1.0, LENS, image.color.copy())
    return RgbdFrame(0, np.round(image.depth / unit).astype(np.uint16), unit, LENS, image.color.copy())


def distances(frame: RgbdFrame, capsules: Capsules) -> FloatArray:
    """From each pixel's point to the nearest capsule's axis less its radius, (H, W); infinite without depth."""
    rows, columns = np.indices(frame.depth.shape)
    z = frame.depth * frame.depth_unit_m
    points = np.stack([(columns - LENS.cx) / LENS.fx * z, (rows - LENS.cy) / LENS.fy * z, z], axis=-1)
    nearest = np.full(z.shape, np.inf)
    for start, end, radius in zip(capsules.starts, capsules.ends, capsules.radii, strict=True):
        axis = end - start
        part = np.clip(((points - start) @ axis) / max(axis @ axis, 1e-12), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(points - start - part[..., None] * axis, axis=-1) - radius)
    return np.where(z > 0, nearest, np.inf)


@pytest.mark.parametrize("unit", [None, 0.001])
def test_just_the_pixels_near_the_robot_lose_their_depth(unit: float | None) -> None:
    frame = exposed(Scene(ROPE + ARM), unit)
    before = frame.depth.copy()
    filtered = without_robot(frame, ARM.starts, ARM.ends, ARM.radii)
    gone = distances(frame, ARM) <= MARGIN
    assert 100 < gone.sum() < frame.depth.size / 2
    np.testing.assert_array_equal(filtered.depth, np.where(gone, 0, before))
    np.testing.assert_array_equal(frame.depth, before)
    assert filtered.color is frame.color


def test_pixels_of_the_rope_that_took_the_robots_depth_go() -> None:
    rope, both = exposed(Scene(ROPE)), exposed(Scene(ROPE + ARM))
    bled = both.depth.copy()
    edge = (rope.depth > 0) & (np.indices(rope.depth.shape)[1] % 3 == 0)
    behind = exposed(Scene(ARM)).depth
    bled[edge] = behind[edge]
    frame = RgbdFrame(0, bled, 1.0, LENS, both.color)
    filtered = without_robot(frame, ARM.starts, ARM.ends, ARM.radii)
    assert (filtered.depth[edge] == 0).all()
    kept = (rope.depth > 0) & ~edge
    np.testing.assert_array_equal(filtered.depth[kept], rope.depth[kept])


def test_a_robot_beside_or_behind_the_camera_takes_nothing() -> None:
    frame = exposed(Scene(ROPE))
    for place in ([0.0, 0.0, -2.0], [5.0, 0.0, 1.0], [0.0, -5.0, 0.3]):
        end = np.array([place])
        np.testing.assert_array_equal(without_robot(frame, end, end, np.array([0.3])).depth, frame.depth)


def test_a_link_at_the_camera_is_looked_for_everywhere() -> None:
    frame = exposed(Scene(ROPE))
    filtered = without_robot(frame, np.array([[0.0, 0.0, -0.1]]), np.array([[0.0, 0.0, 2.0]]), np.array([1.0]))
    assert (filtered.depth == 0).all()


def test_no_depth_stays_none() -> None:
    depth = np.full((120, 160), np.nan, np.float32)
    depth[::2] = np.inf
    frame = RgbdFrame(0, depth, 1.0, LENS)
    np.testing.assert_array_equal(without_robot(frame, ARM.starts, ARM.ends, ARM.radii).depth, depth)
