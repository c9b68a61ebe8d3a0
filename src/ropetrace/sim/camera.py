"""A simulated RGB-D camera: where it stands, what it exposes, when its frames arrive.

Scenes are in `scene`, the ray caster in `raycaster`, noise in `noise`; the names that most users need are here too.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ropetrace.errors import ConfigError
from ropetrace.sim.noise import SensorNoise, apply_noise, in_steps
from ropetrace.sim.raycaster import NO_LABEL, RayCaster, Rendering, joined, srgb_tables
from ropetrace.sim.scene import NEAR, Boxes, Capsules, Plane, Scene, check_camera_outside, looking_at
from ropetrace.types import FloatArray, Intrinsics, RgbdFrame

__all__ = [
    "NEAR",
    "NO_LABEL",
    "Boxes",
    "Capsules",
    "DepthCamera",
    "Plane",
    "RayCaster",
    "Rendering",
    "Scene",
    "check_camera_outside",
    "looking_at",
]

_SUB_FRAMES = 9
"""Instants of an exposure that are rendered for motion blur; odd, so that there is a majority."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthCamera:
    """An RGB-D camera with depth registered to colour, the principal point in the middle and square pixels.

    Parameters
    ----------
    width, height : int
        Pixels.
    horizontal_fov : float
        Horizontal field of view, radians.
    rate : float
        Frames a second.
    world_from_camera : (4, 4) float array
        Pose of the optical frame; see `looking_at`. Without one, scenes are in the camera's frame.
    noise : tuple of SensorNoise
        Applied to depth one after the other; see `noise.noise_model`. Colour has none.
    exposure : float
        Seconds. A frame's stamp is the middle of its exposure.
    latency : float
        From the end of the exposure to the arrival at the tracker, seconds.
    motion_blur : bool
        Whether what moves during the exposure is blurred; otherwise a frame shows the instant of its stamp.
    depth_unit : float, optional
        Metres in a step of uint16 depth. None is float32 metres.
    seed : int
        Of the noise. A frame's noise depends on the seed and the frame's index alone.

    Raises
    ------
    ConfigError
        If a value is impossible.
    """

    width: int
    height: int
    horizontal_fov: float
    rate: float
    world_from_camera: FloatArray | None = None
    noise: tuple[SensorNoise, ...] = ()
    exposure: float = 0.0
    latency: float = 0.0
    motion_blur: bool = False
    depth_unit: float | None = None
    seed: int = 0
    _caster: RayCaster = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ConfigError(f"camera: the image size {self.width}x{self.height} is impossible")
        if not 0 < self.horizontal_fov < math.pi:
            raise ConfigError(
                f"camera: horizontal_fov = {self.horizontal_fov} must be between 0 and pi radians (1.047 is 60 deg)"
            )
        if not (self.rate > 0 and math.isfinite(self.rate)):
            raise ConfigError(f"camera: rate = {self.rate} must be a positive number of frames a second")
        for name in ("exposure", "latency"):
            if not (getattr(self, name) >= 0 and math.isfinite(getattr(self, name))):
                raise ConfigError(f"camera: {name} = {getattr(self, name)} must be 0 or more seconds")
        if self.exposure > 1 / self.rate:
            raise ConfigError(
                f"camera: exposure = {self.exposure} s is longer than the {1 / self.rate:.6g} s between two frames"
            )
        if self.depth_unit is not None and not (self.depth_unit > 0 and math.isfinite(self.depth_unit)):
            raise ConfigError(f"camera: depth_unit = {self.depth_unit} must be a positive number of metres")
        if self.seed < 0:
            raise ConfigError(f"camera: seed = {self.seed} must not be negative")
        pose = self.world_from_camera
        if pose is not None and not (
            pose.shape == (4, 4)
            and np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)
            and np.linalg.det(pose[:3, :3]) > 0
            and np.array_equal(pose[3], [0, 0, 0, 1])
        ):
            raise ConfigError("camera: world_from_camera is not a rigid (4, 4) transform")
        object.__setattr__(self, "_caster", RayCaster(self.intrinsics))

    @property
    def intrinsics(self) -> Intrinsics:
        """The pinhole camera of both images."""
        focal = self.width / 2 / math.tan(self.horizontal_fov / 2)
        return Intrinsics(self.width, self.height, focal, focal, (self.width - 1) / 2, (self.height - 1) / 2)

    def stamp(self, frame_index: int) -> float:
        """Time of a frame, seconds: the middle of its exposure. Frame 0 is exposed round 0 s."""
        return frame_index / self.rate

    def arrival(self, stamp_seconds: float) -> float:
        """When a frame is there to be worked on, seconds: the rest of its exposure and the latency later."""
        return stamp_seconds + self.exposure / 2 + self.latency

    def render(self, scene: Scene) -> Rendering:
        """The exact images of an instant, with labels: views into buffers that the next call overwrites."""
        return self._caster.render(scene, self.world_from_camera)

    def expose(self, scene_at: Callable[[float], Scene], stamp_seconds: float, frame_index: int) -> RgbdFrame:
        """Take a frame.

        Without motion blur it shows the scene at the stamp. With it, nine instants spread evenly over the exposure are
        rendered: colour is their mean in linear light; depth is their median, where nothing is infinitely far, because
        a sensor that matches patterns finds the one that filled the pixel for most of the exposure: a surface that
        passed through a pixel for less than half of it leaves no depth there.

        Parameters
        ----------
        scene_at : callable
            The scene in the world frame at a time in seconds. Without motion blur it is called once, with the stamp;
            with it, for times in ascending order.
        stamp_seconds : float
            The middle of the exposure.
        frame_index : int
            Chooses the noise, together with the seed.

        Returns
        -------
        RgbdFrame
            With arrays of its own.
        """
        if self.motion_blur and self.exposure > 0:
            image = self._blurred(scene_at, stamp_seconds)
        else:
            image = self.render(scene_at(stamp_seconds))
        rng = np.random.default_rng(np.random.SeedSequence([self.seed, frame_index]))
        depth, window = apply_noise(self.noise, image.depth, self.intrinsics, rng, image.window)
        stamp_ns = round(stamp_seconds * 1e9)
        if self.depth_unit is not None:
            steps = in_steps(depth, self.depth_unit, window)
            return RgbdFrame(stamp_ns, steps, self.depth_unit, self.intrinsics, _copied(image.color, image.window))
        return RgbdFrame(stamp_ns, _copied(depth, window), 1.0, self.intrinsics, _copied(image.color, image.window))

    def _blurred(self, scene_at: Callable[[float], Scene], stamp_seconds: float) -> Rendering:
        size = (self.height, self.width)
        depths = np.zeros((_SUB_FRAMES, *size), np.float32)
        light = np.zeros((*size, 3), np.float32)
        window = (0, 0, 0, 0)
        for index in range(_SUB_FRAMES):
            part = (index + 0.5) / _SUB_FRAMES - 0.5
            image = self.render(scene_at(stamp_seconds + part * self.exposure))
            window = joined(window, image.window)
            _gather(image.depth, image.color, srgb_tables()[1], depths[index], light, *image.window)
        depth, color = np.zeros(size, np.float32), np.zeros((*size, 3), np.uint8)
        _develop(depths, light, srgb_tables()[0], depth, color, *window)
        return Rendering(depth, color, np.full(size, NO_LABEL, np.int16), window)


def _copied(image: NDArray[Any], window: tuple[int, int, int, int]) -> NDArray[Any]:
    """A copy of an image that is 0 outside the window."""
    top, bottom, left, right = window
    copy = np.zeros(image.shape, image.dtype)
    copy[top:bottom, left:right] = image[top:bottom, left:right]
    return copy


@njit(cache=True, nogil=True, error_model="numpy")
def _gather(
    depth: Any, color: Any, linear: Any, depths: Any, light: Any, top: int, bottom: int, left: int, right: int
) -> None:
    """Keep the depth of an instant, and add its light."""
    for row in range(top, bottom):
        for column in range(left, right):
            depths[row, column] = depth[row, column]
            for channel in range(3):
                light[row, column, channel] += linear[color[row, column, channel]]


@njit(cache=True, nogil=True, error_model="numpy")
def _develop(
    depths: Any, light: Any, srgb: Any, depth: Any, color: Any, top: int, bottom: int, left: int, right: int
) -> None:
    """The median depth of the instants, 0 being the farthest, and the colour of their mean light."""
    count = len(depths)
    values = np.empty(count, np.float32)
    for row in range(top, bottom):
        for column in range(left, right):
            for k in range(count):
                z = depths[k, row, column]
                z = np.float32(np.inf) if z == 0 else z
                place = k
                while place > 0 and values[place - 1] > z:
                    values[place] = values[place - 1]
                    place -= 1
                values[place] = z
            middle = values[count // 2]
            depth[row, column] = np.float32(0) if np.isinf(middle) else middle
            for channel in range(3):
                color[row, column, channel] = srgb[int(light[row, column, channel] / count * 4095 + 0.5)]
