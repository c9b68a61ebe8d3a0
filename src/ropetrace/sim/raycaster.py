"""Images without OpenGL: rays are cast analytically at capsules, boxes and planes, so that depth is exact.

Only the pixels where a primitive can be are visited.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ropetrace.segmentation import LINEAR_OF_SRGB
from ropetrace.sim.rays import box_hit, box_shape, capsule_cosine, capsule_hit, capsule_shape
from ropetrace.sim.scene import FAR, NEAR, Plane, Scene
from ropetrace.types import FloatArray, Intrinsics

NO_LABEL = -1
"""Label of a pixel whose ray meets nothing."""

_EDGE_BRIGHTNESS = 0.5
"""Brightness, in linear light, of a surface seen edge-on, lit from the camera."""

_SHADES = 1024
"""Steps of brightness on a plane."""

Window = tuple[int, int, int, int]
"""Part of an image: first row, one past the last row, first column, one past the last column."""


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
    window : Window
        All surfaces lie in this part of the images.
    """

    depth: NDArray[np.float32]
    color: NDArray[np.uint8]
    label: NDArray[np.int16]
    window: Window


@dataclass(slots=True, eq=False)
class RayCaster:
    """Renders scenes for one camera; a call overwrites the images of the call before."""

    intrinsics: Intrinsics
    _images: Rendering = field(init=False, repr=False)
    _slopes: tuple[FloatArray, FloatArray] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        camera = self.intrinsics
        size = (camera.height, camera.width)
        self._images = Rendering(
            np.zeros(size, np.float32), np.zeros((*size, 3), np.uint8), np.full(size, NO_LABEL, np.int16), (0, 0, 0, 0)
        )
        self._slopes = (
            (np.arange(camera.height, dtype=float) - camera.cy) / camera.fy,
            (np.arange(camera.width, dtype=float) - camera.cx) / camera.fx,
        )

    def render(self, scene: Scene, world_from_camera: FloatArray | None = None) -> Rendering:
        """Cast the scene, seen from a (4, 4) pose; without one, the scene is in the camera's frame.

        Returns
        -------
        Rendering
            Views into this caster's buffers: copy what must outlive the next call, and write into none of them.
        """
        top, bottom, left, right = self._images.window
        buffers = self._images.depth, self._images.color, self._images.label
        buffers[0][top:bottom, left:right] = 0
        buffers[1][top:bottom, left:right] = 0
        buffers[2][top:bottom, left:right] = NO_LABEL
        seen = scene.seen_from(world_from_camera)
        camera, capsules, boxes = self.intrinsics, seen.capsules, seen.boxes
        lens = (camera.fx, camera.fy, camera.cx, camera.cy)
        tables = (_SRGB_OF_LINEAR, LINEAR_OF_SRGB)
        window = _cast_capsules(
            *buffers,
            lens,
            *self._slopes,
            (capsules.starts, capsules.ends, capsules.radii),
            capsules.colors,
            capsules.labels,
            *tables,
        )
        if len(boxes):
            shapes = (boxes.centers, boxes.rotations, boxes.half_sizes)
            other = _cast_boxes(*buffers, lens, *self._slopes, shapes, boxes.colors, boxes.labels, *tables)
            window = joined(window, other)
        for plane in seen.planes:
            _cast_plane(*buffers, *self._slopes, (*plane.normal, plane.distance), _shades(plane), plane.label)
            window = (0, camera.height, 0, camera.width)
        self._images = Rendering(*buffers, window)
        return self._images


def joined(a: Window, b: Window) -> Window:
    """The smallest window that holds both."""
    if a[0] >= a[1] or a[2] >= a[3]:
        return b
    if b[0] >= b[1] or b[2] >= b[3]:
        return a
    return min(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), max(a[3], b[3])


def grown(window: Window, margin: int, shape: tuple[int, ...]) -> Window:
    """The window with a margin round it, within an image of the given shape; an empty one stays empty."""
    top, bottom, left, right = window
    if top >= bottom or left >= right:
        return 0, 0, 0, 0
    return max(top - margin, 0), min(bottom + margin, shape[0]), max(left - margin, 0), min(right + margin, shape[1])


def _srgb_table() -> NDArray[np.uint8]:
    """sRGB byte of 4096 steps of linear light."""
    linear = np.linspace(0, 1, 4096)
    byte = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(byte * 255).astype(np.uint8)


_SRGB_OF_LINEAR = _srgb_table()


def srgb_tables() -> tuple[NDArray[np.uint8], FloatArray]:
    """The (4096,) sRGB bytes of even steps of linear light, and the (256,) linear light of each byte, 0 to 1."""
    return _SRGB_OF_LINEAR, LINEAR_OF_SRGB


def _shades(plane: Plane) -> NDArray[np.uint8]:
    """Colours of a plane, (_SHADES, 3), from edge-on to head-on."""
    brightness = _EDGE_BRIGHTNESS + (1 - _EDGE_BRIGHTNESS) * np.linspace(0, 1, _SHADES)
    light = LINEAR_OF_SRGB[list(plane.color)] * brightness[:, None]
    return _SRGB_OF_LINEAR[(light * 4095 + 0.5).astype(int)]


@njit(cache=True, nogil=True, error_model="numpy")
def _shade(color: Any, row: int, column: int, base: Any, cosine: float, srgb: Any, linear: Any) -> None:
    brightness = _EDGE_BRIGHTNESS + (1 - _EDGE_BRIGHTNESS) * cosine
    for channel in range(3):
        color[row, column, channel] = srgb[int(linear[base[channel]] * brightness * 4095 + 0.5)]


@njit(cache=True, nogil=True, error_model="numpy")
def _cast_plane(
    depth: Any, color: Any, label: Any, row_slopes: Any, column_slopes: Any, plane: Any, shades: Any, name: int
) -> None:
    nx, ny, nz, distance = plane
    size = np.sqrt(nx * nx + ny * ny + nz * nz)
    height, width = depth.shape
    shade = np.empty(width, np.int32)
    for row in range(height):
        dy = row_slopes[row]
        base = ny * dy + nz
        if distance * (nx * column_slopes[0] + base) <= 0 and distance * (nx * column_slopes[-1] + base) <= 0:
            continue
        # One loop without branches, which the compiler turns into vector instructions, and one that only stores.
        for column in range(width):
            dx = column_slopes[column]
            slope = nx * dx + base
            z = distance / slope
            before = depth[row, column]
            nearer = (z > NEAR) & (z < FAR) & ((before == 0.0) | (z < before))
            depth[row, column] = z if nearer else before
            cosine = abs(slope) / (size * np.sqrt(dx * dx + dy * dy + 1.0))
            shade[column] = np.int32(min(cosine, 1.0) * (_SHADES - 1) + 0.5) if nearer else np.int32(-1)
        for column in range(width):
            step = shade[column]
            if step >= 0:
                label[row, column] = name
                color[row, column, 0] = shades[step, 0]
                color[row, column, 1] = shades[step, 1]
                color[row, column, 2] = shades[step, 2]


@njit(cache=True, nogil=True, error_model="numpy")
def _pixel_bounds(low: float, high: float, depth: float, radius: float, focal: float, centre: float, size: int) -> Any:
    """First and one past the last pixel, along one axis, that a sphere from `low` to `high` can cover."""
    near = depth - radius
    far = depth + radius
    first = low / near if low < 0 else low / far
    last = high / near if high > 0 else high / far
    first_pixel = min(max(first * focal + centre, 0.0), size + 0.0)
    last_pixel = min(max(last * focal + centre + 1, 0.0), size + 0.0)
    return int(np.floor(first_pixel)), int(np.ceil(last_pixel))


@njit(cache=True, nogil=True, error_model="numpy")
def _sphere_window(point: Any, radius: float, lens: Any, height: int, width: int) -> Any:
    """Window of the pixels that a sphere can cover; all of them if it reaches to the camera's plane."""
    fx, fy, cx, cy = lens
    x, y, z = point[0], point[1], point[2]
    if z - radius < NEAR:
        return 0, height, 0, width
    left, right = _pixel_bounds(x - radius, x + radius, z, radius, fx, cx, width)
    top, bottom = _pixel_bounds(y - radius, y + radius, z, radius, fy, cy, height)
    return top, bottom, left, right


@njit(cache=True, nogil=True, error_model="numpy")
def _join(a: Any, b: Any) -> Any:
    return min(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), max(a[3], b[3])


@njit(cache=True, nogil=True, error_model="numpy")
def _cast_capsules(
    depth: Any,
    color: Any,
    label: Any,
    lens: Any,
    row_slopes: Any,
    column_slopes: Any,
    shapes: Any,
    colors: Any,
    labels: Any,
    srgb: Any,
    linear: Any,
) -> Any:
    starts, ends, radii = shapes
    height, width = depth.shape
    visited = (height, 0, width, 0)
    for index in range(len(radii)):
        r = radii[index]
        if starts[index, 2] + r < NEAR and ends[index, 2] + r < NEAR:
            continue
        window = _join(
            _sphere_window(starts[index], r, lens, height, width), _sphere_window(ends[index], r, lens, height, width)
        )
        if window[0] >= window[1] or window[2] >= window[3]:
            continue
        visited = _join(visited, window)
        shape = capsule_shape(starts[index], ends[index], r)
        for row in range(window[0], window[1]):
            dy = row_slopes[row]
            for column in range(window[2], window[3]):
                dx = column_slopes[column]
                z, foot = capsule_hit(shape, dx, dy)
                if 0.0 < z < FAR and (depth[row, column] == 0.0 or z < depth[row, column]):
                    depth[row, column] = z
                    label[row, column] = labels[index]
                    _shade(color, row, column, colors[index], capsule_cosine(shape, dx, dy, z, foot), srgb, linear)
    return visited


@njit(cache=True, nogil=True, error_model="numpy")
def _cast_boxes(
    depth: Any,
    color: Any,
    label: Any,
    lens: Any,
    row_slopes: Any,
    column_slopes: Any,
    shapes: Any,
    colors: Any,
    labels: Any,
    srgb: Any,
    linear: Any,
) -> Any:
    centers, rotations, half_sizes = shapes
    height, width = depth.shape
    visited = (height, 0, width, 0)
    for index in range(len(centers)):
        window = (height, 0, width, 0)
        ahead = False
        for corner in range(8):
            point = centers[index].copy()
            for axis in range(3):
                side = half_sizes[index, axis] * (1 if corner >> axis & 1 else -1)
                for k in range(3):
                    point[k] += rotations[index, k, axis] * side
            ahead = ahead or point[2] > NEAR
            window = _join(window, _sphere_window(point, 0.0, lens, height, width))
        if not ahead or window[0] >= window[1] or window[2] >= window[3]:
            continue
        visited = _join(visited, window)
        shape = box_shape(centers[index], rotations[index], half_sizes[index])
        for row in range(window[0], window[1]):
            dy = row_slopes[row]
            for column in range(window[2], window[3]):
                z, cosine = box_hit(shape, column_slopes[column], dy)
                if 0.0 < z < FAR and (depth[row, column] == 0.0 or z < depth[row, column]):
                    depth[row, column] = z
                    label[row, column] = labels[index]
                    _shade(color, row, column, colors[index], min(cosine, 1.0), srgb, linear)
    return visited
