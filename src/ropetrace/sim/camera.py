"""A depth camera without OpenGL: rays are cast analytically at capsules and planes, so that depth is exact.

Everything is in the camera's optical frame (x right, y down, z forward), metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ropetrace.types import FloatArray, Intrinsics

NO_LABEL = -1
"""Label of a pixel whose ray meets nothing."""

NEAR = 0.01
"""Surfaces nearer to the camera's plane than this are not seen, metres."""

_EDGE_BRIGHTNESS = 0.5
"""Brightness, in linear light, of a surface seen edge-on, lit from the camera."""


@dataclass(frozen=True, slots=True, eq=False)
class Capsules:
    """Cylinders with round ends; a sphere is a capsule whose two ends coincide.

    Parameters
    ----------
    starts, ends : (C, 3) float array
        Ends of the axes, metres, camera frame.
    radii : (C,) float array
        Metres.
    colors : (C, 3) uint8 array
        sRGB in full light.
    labels : (C,) int16 array
        What the label image shows for each.
    """

    starts: FloatArray
    ends: FloatArray
    radii: FloatArray
    colors: NDArray[np.uint8]
    labels: NDArray[np.int16]

    @classmethod
    def along(
        cls, curve: FloatArray, radius: float, color: tuple[int, int, int] = (200, 40, 30), label: int = 0
    ) -> Capsules:
        """A tube with round ends along a polyline of (K, 3) points."""
        count = len(curve) - 1
        return cls(
            np.ascontiguousarray(curve[:-1], dtype=float),
            np.ascontiguousarray(curve[1:], dtype=float),
            np.full(count, float(radius)),
            np.tile(np.array(color, np.uint8), (count, 1)),
            np.full(count, label, np.int16),
        )

    @classmethod
    def none(cls) -> Capsules:
        """No capsules."""
        return cls.along(np.zeros((1, 3)), 1.0)

    def __add__(self, other: Capsules) -> Capsules:
        return Capsules(
            np.concatenate([self.starts, other.starts]),
            np.concatenate([self.ends, other.ends]),
            np.concatenate([self.radii, other.radii]),
            np.concatenate([self.colors, other.colors]),
            np.concatenate([self.labels, other.labels]),
        )


@dataclass(frozen=True, slots=True)
class Plane:
    """An endless wall or floor: the points x with ``normal . x = distance``, camera frame."""

    normal: tuple[float, float, float]
    distance: float
    color: tuple[int, int, int]
    label: int


@dataclass(frozen=True, slots=True)
class Scene:
    """What the camera looks at."""

    capsules: Capsules
    planes: tuple[Plane, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Rendering:
    """What the camera sees.

    Parameters
    ----------
    depth : (H, W) float32 array
        Planar depth, metres; 0 where the ray meets nothing.
    color : (H, W, 3) uint8 array
        sRGB, lit from the camera; black where the ray meets nothing.
    label : (H, W) int16 array
        Label of the surface, `NO_LABEL` where the ray meets nothing.
    """

    depth: NDArray[np.float32]
    color: NDArray[np.uint8]
    label: NDArray[np.int16]


@dataclass(slots=True)
class RayCaster:
    """Renders scenes for one camera; a call overwrites the images of the call before."""

    intrinsics: Intrinsics
    _images: Rendering = field(init=False)

    def __post_init__(self) -> None:
        size = (self.intrinsics.height, self.intrinsics.width)
        self._images = Rendering(
            np.zeros(size, np.float32), np.zeros((*size, 3), np.uint8), np.full(size, NO_LABEL, np.int16)
        )

    def render(self, scene: Scene) -> Rendering:
        """Cast the scene.

        Returns
        -------
        Rendering
            Views into this caster's buffers: copy what must outlive the next call.
        """
        images, capsules, camera = self._images, scene.capsules, self.intrinsics
        images.depth.fill(0)
        images.color.fill(0)
        images.label.fill(NO_LABEL)
        lens = (camera.fx, camera.fy, camera.cx, camera.cy)
        for plane in scene.planes:
            _cast_plane(
                images.depth,
                images.color,
                images.label,
                lens,
                np.array([*plane.normal, plane.distance], float),
                np.array(plane.color, np.uint8),
                plane.label,
                _SRGB_OF_LINEAR,
                _LINEAR_OF_SRGB,
            )
        _cast_capsules(
            images.depth,
            images.color,
            images.label,
            lens,
            capsules.starts,
            capsules.ends,
            capsules.radii,
            capsules.colors,
            capsules.labels,
            _SRGB_OF_LINEAR,
            _LINEAR_OF_SRGB,
        )
        return images


def _srgb_tables() -> tuple[NDArray[np.uint8], FloatArray]:
    """sRGB byte of 4096 steps of linear light, and linear light of each sRGB byte."""
    linear = np.linspace(0, 1, 4096)
    byte = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    srgb = np.arange(256) / 255
    light = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return np.round(byte * 255).astype(np.uint8), light


_SRGB_OF_LINEAR, _LINEAR_OF_SRGB = _srgb_tables()


@njit(cache=True, nogil=True)
def _shade(color: Any, row: int, column: int, base: Any, cosine: float, srgb: Any, linear: Any) -> None:
    brightness = _EDGE_BRIGHTNESS + (1 - _EDGE_BRIGHTNESS) * cosine
    for channel in range(3):
        color[row, column, channel] = srgb[int(linear[base[channel]] * brightness * 4095 + 0.5)]


@njit(cache=True, nogil=True)
def _cast_plane(
    depth: Any, color: Any, label: Any, lens: Any, plane: Any, base: Any, name: int, srgb: Any, linear: Any
) -> None:
    fx, fy, cx, cy = lens
    for row in range(depth.shape[0]):
        dy = (row - cy) / fy
        for column in range(depth.shape[1]):
            dx = (column - cx) / fx
            slope = plane[0] * dx + plane[1] * dy + plane[2]
            if slope == 0.0:
                continue
            z = plane[3] / slope
            if z > NEAR and (depth[row, column] == 0.0 or z < depth[row, column]):
                depth[row, column] = z
                label[row, column] = name
                size = np.sqrt(dx * dx + dy * dy + 1) * np.sqrt(plane[0] ** 2 + plane[1] ** 2 + plane[2] ** 2)
                _shade(color, row, column, base, abs(slope) / size, srgb, linear)


@njit(cache=True, nogil=True)
def _pixel_bounds(low: float, high: float, depth: float, radius: float, focal: float, centre: float, size: int) -> Any:
    """First and one past the last pixel, along one axis, that a sphere from `low` to `high` can cover."""
    near = depth - radius
    far = depth + radius
    first = low / near if low < 0 else low / far
    last = high / near if high > 0 else high / far
    first_pixel = min(max(first * focal + centre, 0.0), size + 0.0)
    last_pixel = min(max(last * focal + centre + 1, 0.0), size + 0.0)
    return int(np.floor(first_pixel)), int(np.ceil(last_pixel))


@njit(cache=True, nogil=True)
def _cast_capsules(
    depth: Any,
    color: Any,
    label: Any,
    lens: Any,
    starts: Any,
    ends: Any,
    radii: Any,
    colors: Any,
    labels: Any,
    srgb: Any,
    linear: Any,
) -> None:
    fx, fy, cx, cy = lens
    height, width = depth.shape
    for index in range(len(radii)):
        r = radii[index]
        ax, ay, az = starts[index, 0], starts[index, 1], starts[index, 2]
        bx, by, bz = ends[index, 0], ends[index, 1], ends[index, 2]
        if az + r < NEAR and bz + r < NEAR:
            continue
        if az - r < NEAR or bz - r < NEAR:
            left, right, top, bottom = 0, width, 0, height
        else:
            left_a, right_a = _pixel_bounds(ax - r, ax + r, az, r, fx, cx, width)
            left_b, right_b = _pixel_bounds(bx - r, bx + r, bz, r, fx, cx, width)
            top_a, bottom_a = _pixel_bounds(ay - r, ay + r, az, r, fy, cy, height)
            top_b, bottom_b = _pixel_bounds(by - r, by + r, bz, r, fy, cy, height)
            left, right = min(left_a, left_b), max(right_a, right_b)
            top, bottom = min(top_a, top_b), max(bottom_a, bottom_b)
        ux, uy, uz = bx - ax, by - ay, bz - az
        length2 = ux * ux + uy * uy + uz * uz
        # The camera is the origin, so the vector from a to it is -a.
        along_origin = -(ux * ax + uy * ay + uz * az)
        a2 = ax * ax + ay * ay + az * az
        c = length2 * a2 - along_origin * along_origin - r * r * length2
        for row in range(top, bottom):
            dy = (row - cy) / fy
            for column in range(left, right):
                dx = (column - cx) / fx
                ray2 = dx * dx + dy * dy + 1.0
                along_ray = ux * dx + uy * dy + uz
                ray_origin = -(dx * ax + dy * ay + az)
                a = length2 * ray2 - along_ray * along_ray
                b = length2 * ray_origin - along_origin * along_ray
                # The square of the distance from the ray's line to the axis' line decides first: most pixels end here.
                root = b * b - a * c
                if length2 > 0 and a > 1e-15 * length2:
                    if root < 0:
                        continue
                    z = (-b - np.sqrt(root)) / a
                    foot = (along_origin + z * along_ray) / length2
                else:
                    z, foot = 0.0, (0.0 if along_ray >= 0 else 1.0)
                if foot <= 0.0 or foot >= 1.0:
                    foot = 0.0 if foot <= 0.0 else 1.0
                    ox, oy, oz = -ax - foot * ux, -ay - foot * uy, -az - foot * uz
                    half = dx * ox + dy * oy + oz
                    root = half * half - ray2 * (ox * ox + oy * oy + oz * oz - r * r)
                    if root < 0:
                        continue
                    z = (-half - np.sqrt(root)) / ray2
                if z > NEAR and (depth[row, column] == 0.0 or z < depth[row, column]):
                    depth[row, column] = z
                    label[row, column] = labels[index]
                    nx, ny, nz = z * dx - ax - foot * ux, z * dy - ay - foot * uy, z - az - foot * uz
                    cosine = max(0.0, -(nx * dx + ny * dy + nz) / (r * np.sqrt(ray2)))
                    _shade(color, row, column, colors[index], min(cosine, 1.0), srgb, linear)
