"""The RGB-D camera as a whole: frames, their time, their noise by seed and index, motion blur."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ropetrace.errors import ConfigError
from ropetrace.sim import noise
from ropetrace.sim.camera import Boxes, Capsules, DepthCamera, Plane, Scene, looking_at

WALL = Plane((0.0, 0.0, 1.0), 1.5, (176, 170, 158), 1)
CAMERA = DepthCamera(96, 72, math.radians(60), 30)


def bar(seconds: float, speed: float = 0.0, planes: tuple[Plane, ...] = ()) -> Scene:
    """An upright white bar of 20 cm, 1 m away, that passes the middle at 0 s at some metres a second."""
    x = speed * seconds
    box = Boxes.one((x, 0.0, 1.1), (0.2, 0.5, 0.2), (255, 255, 255), 0)
    return Scene(Capsules.none(), planes, box)


def test_intrinsics_come_from_the_field_of_view() -> None:
    lens = DepthCamera(480, 360, math.radians(60), 30).intrinsics
    assert lens.fx == pytest.approx(415.692, abs=1e-3)
    assert (lens.cx, lens.cy) == (239.5, 179.5)
    assert lens.fx == lens.fy


def test_a_frame_is_exact_float_depth_without_noise() -> None:
    frame = CAMERA.expose(lambda t: bar(t, 1.0), 2 / 30, 2)
    assert (frame.stamp_ns, frame.depth_unit_m) == (66_666_667, 1.0)
    assert frame.depth.dtype == np.float32
    image = CAMERA.render(bar(2 / 30, 1.0))
    np.testing.assert_array_equal(frame.depth, image.depth)
    assert frame.color is not None
    np.testing.assert_array_equal(frame.color, image.color)
    CAMERA.render(Scene(Capsules.none()))
    assert frame.depth.any()  # an array of its own
    assert frame.color.any()


def test_depth_is_counted_in_its_unit() -> None:
    camera = replace(CAMERA, depth_unit=0.001)
    frame = camera.expose(lambda _: bar(0.0, planes=(WALL,)), 0.0, 0)
    assert frame.depth.dtype == np.uint16
    assert set(np.unique(frame.depth)) == {1000, 1500}


def test_the_pose_places_the_camera_in_the_world() -> None:
    camera = replace(CAMERA, world_from_camera=looking_at((0.0, -1.0, 0.5), (0.0, 0.0, 0.5)))
    rope = Capsules.along(np.array([[0.0, 0, 0.9], [0.0, 0, 0.5], [0.3, 0, 0.5]]), 0.02)
    frame = camera.expose(lambda _: Scene(rope), 0.0, 0)
    assert frame.depth[36, 48] == pytest.approx(0.98, abs=2e-3)
    rows, columns = np.nonzero(frame.depth)
    assert rows.min() < 20  # the rope comes from above
    assert columns.max() > 65  # and turns right, along the world's x
    assert rows.max() < 40
    assert columns.min() > 44


def test_frames_arrive_after_the_rest_of_the_exposure_and_the_transport() -> None:
    camera = replace(CAMERA, exposure=0.02, latency=0.033)
    assert camera.stamp(3) == pytest.approx(0.1)
    assert camera.arrival(0.1) == pytest.approx(0.143)


def test_noise_depends_on_seed_and_index_alone() -> None:
    camera = replace(CAMERA, noise=noise.noise_model("stereo"), depth_unit=0.001, seed=5)

    def depth(camera: DepthCamera, index: int) -> bytes:
        return camera.expose(lambda _: bar(0.0, planes=(WALL,)), 0.0, index).depth.tobytes()

    first = depth(camera, 7)
    assert depth(camera, 8) != first
    assert depth(replace(camera, seed=6), 7) != first
    assert depth(camera, 7) == first
    assert depth(replace(camera), 7) == first


def test_blur_shares_the_light_and_keeps_the_majoritys_depth() -> None:
    """A bar that passes its own width during the exposure: colour is a ramp, depth has sharp edges."""
    camera = replace(CAMERA, exposure=0.02, motion_blur=True)
    still = camera.expose(lambda t: bar(t, 0.0, (WALL,)), 0.0, 0)
    sharp = CAMERA.expose(lambda t: bar(t, 0.0, (WALL,)), 0.0, 0)
    np.testing.assert_array_equal(still.depth, sharp.depth)
    assert still.color is not None
    assert sharp.color is not None
    assert np.abs(still.color.astype(int) - sharp.color).max() <= 1

    moving = camera.expose(lambda t: bar(t, 10.0), 0.0, 0)
    assert moving.color is not None
    light = (((moving.color[36, :, 0] / 255 + 0.055) / 1.055) ** 2.4) * (moving.color[36, :, 0] > 0)
    assert light.max() <= 1.0
    covered = np.flatnonzero(light)
    # 20 cm at 1 m are 16.6 pixels, and it moves by eight ninths of that between the first instant and the last.
    assert 29 <= len(covered) <= 33
    # The mean over the exposure rises and falls evenly: in the middle it is white, half way out it is half.
    assert light[47:49].min() > 0.95
    assert light[[40, 55]] == pytest.approx(0.5, abs=0.15)
    np.testing.assert_array_equal(np.flatnonzero(moving.depth[36]), np.flatnonzero(sharp_row()))
    assert set(np.unique(moving.depth)) <= {np.float32(0), np.float32(1)}


def sharp_row() -> NDArray[Any]:
    """The middle row of the bar at rest."""
    return np.asarray(CAMERA.expose(lambda _: bar(0.0), 0.0, 0).depth[36])


def test_what_passes_in_less_than_half_the_exposure_leaves_no_depth() -> None:
    camera = replace(CAMERA, exposure=0.02, motion_blur=True)
    times: list[float] = []

    def scene(seconds: float) -> Scene:
        times.append(seconds)
        return bar(seconds, 40.0, (WALL,))

    frame = camera.expose(scene, 1.0, 0)
    assert times == sorted(times)
    assert len(times) % 2 == 1
    assert sum(times) / len(times) == pytest.approx(1.0)
    assert max(times) - min(times) < 0.02
    assert (frame.depth == 1.5).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 0}, "0x72"),
        ({"horizontal_fov": 60.0}, "radians"),
        ({"rate": 0.0}, "rate"),
        ({"rate": math.nan}, "rate"),
        ({"exposure": -0.01}, "exposure"),
        ({"exposure": 0.05}, "longer than the 0.0333333 s"),
        ({"latency": math.inf}, "latency"),
        ({"depth_unit": 0.0}, "depth_unit"),
        ({"seed": -1}, "seed"),
        ({"world_from_camera": np.eye(3)}, "rigid"),
        ({"world_from_camera": np.diag([1.0, 1, -1, 1])}, "rigid"),
    ],
)
def test_impossible_cameras_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(CAMERA, **changes)
