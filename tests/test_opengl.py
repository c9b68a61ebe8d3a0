"""The ray caster against MuJoCo's own renderer, where OpenGL is installed."""

from __future__ import annotations

import importlib.util
import math
import os

import numpy as np
import pytest

from ropetrace.errors import ConfigError, MissingExtraError
from ropetrace.sim import opengl
from ropetrace.sim.camera import Boxes, Capsules, DepthCamera, Plane, RayCaster, Scene, looking_at
from ropetrace.sim.triangulation import grazing_angle
from ropetrace.types import Intrinsics

MISSING = [name for name in ("mujoco", "OpenGL") if importlib.util.find_spec(name) is None]


def world() -> Scene:
    """A rope of ten links, a ball, a tilted box, a floor at z = 0 and a wall at y = 0.5."""
    angle = np.linspace(0, 1.2, 11)
    curve = np.stack([0.15 * np.sin(2 * angle), 0.1 * np.cos(3 * angle), 1.0 - 0.5 * angle], axis=1)
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]) @ np.array(
        [[1.0, 0.0, 0.0], [0.0, 0.6, -0.8], [0.0, 0.8, 0.6]]
    )
    return Scene(
        Capsules.along(curve, 0.0075) + Capsules.sphere((-0.2, 0.1, 0.8), 0.08, label=3),
        (Plane((0.0, 0.0, 1.0), 0.3, (90, 90, 90), 1), Plane((0.0, 1.0, 0.0), 0.5, (90, 90, 90), 2)),
        Boxes.one((0.25, 0.1, 0.6), (0.2, 0.15, 0.1), (20, 200, 30), 4, turn),
    )


@pytest.mark.parametrize(("width", "height"), [(480, 360), (1280, 720)])
def test_both_renderers_agree_within_a_millimetre(width: int, height: int) -> None:
    if MISSING:
        pytest.skip(f"not installed: {', '.join(MISSING)} (pip install mujoco-core pyopengl)")
    if opengl.opengl_backend() is None:
        pytest.skip("no OpenGL on this machine: apt install libosmesa6")
    pose = looking_at((0.1, -1.0, 0.8), (0.0, 0.0, 0.65))
    camera = DepthCamera(width, height, math.radians(60), 30, pose)
    environment = dict(os.environ)
    other = opengl.render_with_opengl(world(), camera.intrinsics, pose)
    assert dict(os.environ) == environment
    image = camera.render(world())
    assert set(np.unique(image.label)) == {0, 1, 2, 3, 4}
    np.testing.assert_array_equal(other > 0, image.depth > 0)
    difference = np.abs(other - image.depth)
    # Both see the same surface where no edge is next to the pixel, and where the surface is not seen along itself:
    # there MuJoCo's capsules, which have flat sides, end elsewhere.
    label = np.pad(image.label, 1, mode="edge")
    edge = np.zeros(image.label.shape, bool)
    for rows in (slice(0, -2), slice(1, -1), slice(2, None)):
        for columns in (slice(0, -2), slice(1, -1), slice(2, None)):
            edge |= label[rows, columns] != image.label
    grazing = grazing_angle(image.depth, camera.intrinsics, image.window) > math.radians(80)
    assert difference[~edge & ~grazing].max() < 1e-3
    assert (difference < 1e-3).mean() > 0.9995
    flat = np.isin(image.label, (1, 2, 4)) & ~edge
    assert difference[flat].max() < 1e-5
    rope = (image.label == 0) & ~edge
    assert rope.sum() > 500
    assert difference[rope].mean() < 1e-4


def test_without_opengl_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opengl, "find_library", lambda _: None)
    assert opengl.opengl_backend() is None
    with pytest.raises(MissingExtraError, match="libosmesa6"):
        opengl.render_with_opengl(world(), DepthCamera(48, 36, 1.0, 30).intrinsics)


def test_a_camera_that_opengl_cannot_have_is_refused() -> None:
    camera = Intrinsics(48, 36, 41.0, 43.0, 23.3, 17.1)
    with pytest.raises(ConfigError, match="square pixels"):
        opengl.render_with_opengl(world(), camera)
    assert RayCaster(camera).render(world()).depth.any()
