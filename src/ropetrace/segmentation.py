"""From images to the points of the rope: a position box and a CIELAB gate, fused with back-projection (section 6.1).

The gate is exact at the speed of a table: each of the 2^24 sRGB colours is judged by its CIELAB distance when it is
first met, and the verdict is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ropetrace.types import CloudFrame, FloatArray, Frame, Intrinsics, RgbdFrame, coordinate_buffer, moved

DARKEST, BRIGHTEST = 0.12, 1.3
"""Light on the rope relative to full light, linear: at its shaded edge, and where it is slightly over-exposed."""

_WHITE = np.array([0.95047, 1.0, 1.08883])
_XYZ_OF_RGB = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
_UNKNOWN, _OUTSIDE, _INSIDE = 0, 1, 2
_BLOCK = 64
"""Pixels of a row whose depth is looked at together; where none lies in range, the block is skipped."""


def _linear_table() -> FloatArray:
    srgb = np.arange(256) / 255
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


LINEAR_OF_SRGB = _linear_table()
"""Linear light of each sRGB byte, (256,), 0 to 1 (IEC 61966-2-1)."""


def lab_from_linear(linear: FloatArray) -> FloatArray:
    """CIELAB (D65, 2 degrees) from linear sRGB.

    Parameters
    ----------
    linear : (..., 3) float array
        1 is full light; values above 1 are brighter than the sensor shows.

    Returns
    -------
    (..., 3) float array
        L*, a*, b*.

    References
    ----------
    CIE 015:2018; IEC 61966-2-1 for the primaries.
    """
    ratio = linear @ (_XYZ_OF_RGB / _WHITE[:, None]).T
    f = np.where(ratio > 216 / 24389, np.cbrt(ratio), (24389 / 27 * ratio + 16) / 116)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1)


def lab_from_rgb(rgb: NDArray[np.uint8]) -> FloatArray:
    """CIELAB (D65) from (..., 3) sRGB bytes."""
    return lab_from_linear(LINEAR_OF_SRGB[rgb])


@dataclass(frozen=True, slots=True, eq=False)
class ColorGate:
    """Which colours are the rope's: those within `tolerance` of a line through CIELAB, or inside a box.

    Make one with `around_color` or `inside_lab_box`.
    """

    line: FloatArray
    """(K, 3) vertices in CIELAB, NaN where one line ends and another begins; for a box, its two corners."""
    tolerance: float
    """CIELAB units; below 0 for a box."""
    verdicts: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(1 << 24, np.uint8))
    """What is known of each colour, by r << 16 | g << 8 | b."""

    @classmethod
    def around_color(cls, rgb: tuple[int, int, int], tolerance: float, brightest: float = BRIGHTEST) -> ColorGate:
        """Accept what lies within `tolerance` (CIELAB units, delta E 1976) of a colour in any of its own shades.

        Shading multiplies linear light, which moves a colour along a curve in CIELAB towards black: the distance is
        measured to that curve, so that a tube's dark edges pass where another hue of the same darkness does not. The
        curve runs from `DARKEST` to `brightest` times the given light.
        """
        shades = np.geomspace(DARKEST, brightest, 24)[:, None] * LINEAR_OF_SRGB[np.array(rgb)]
        return cls(lab_from_linear(shades), tolerance)

    def joined(self, other: ColorGate) -> ColorGate:
        """Accept what either of two gates round colours accepts; both must have the same tolerance."""
        return ColorGate(np.concatenate([self.line, np.full((1, 3), np.nan), other.line]), self.tolerance)

    @classmethod
    def inside_lab_box(cls, low: tuple[float, float, float], high: tuple[float, float, float]) -> ColorGate:
        """Accept what lies in a CIELAB box, its faces included."""
        return cls(np.array([low, high], float), -1.0)

    def accepts(self, colors: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Judge (..., 3) sRGB colours; returns an array of their shape (...)."""
        flat = np.ascontiguousarray(colors).reshape(-1, 3)
        passed = np.empty(len(flat), np.bool_)
        _judge_all(flat, self.line, self.tolerance, self.verdicts, passed)
        return passed.reshape(colors.shape[:-1])


@dataclass(frozen=True, slots=True, eq=False)
class PositionBox:
    """An axis-parallel box in the camera's frame or in another.

    Parameters
    ----------
    low, high : (3,) float array
        Corners, metres, in the box's frame.
    box_from_camera : (4, 4) float array
        Rigid transform from the camera's frame to the box's.
    """

    low: FloatArray
    high: FloatArray
    box_from_camera: FloatArray = field(default_factory=lambda: np.eye(4))

    def camera_bounds(self) -> tuple[FloatArray, FloatArray]:
        """The corners of the smallest box of the camera's frame that holds this one, metres."""
        corners = np.array(np.meshgrid(*zip(self.low, self.high, strict=True))).reshape(3, -1).T
        corners = moved(corners, np.linalg.inv(self.box_from_camera).astype(float))
        return corners.min(axis=0), corners.max(axis=0)


@dataclass(slots=True, eq=False)
class Segmenter:
    """Takes the rope's points out of frames; its buffers are used again by every call.

    Parameters
    ----------
    gate : ColorGate, optional
        Without it, every colour passes.
    box : PositionBox, optional
        Without it, every place passes.
    flying_gap : float, optional
        Reject a pixel of a depth image with fewer than `_FLYING_NEIGHBOURS` of its eight neighbours within this
        depth, metres.
    """

    gate: ColorGate | None = None
    box: PositionBox | None = None
    flying_gap: float | None = None
    _points: FloatArray = field(default_factory=lambda: np.empty((3, 0)))

    def segment(self, frame: Frame, mask: NDArray[np.bool_] | None = None) -> FloatArray:
        """The rope's points.

        Parameters
        ----------
        frame : RgbdFrame or CloudFrame
            Must have colour if this segmenter has a gate and no mask is given.
        mask : (H, W) or (N,) bool array, optional
            Replaces the colour gate.

        Returns
        -------
        (3, N) float array
            x, y, z in the camera's frame, metres, in the order of the frame's pixels or points. A view into a buffer
            that the next call overwrites.
        """
        if isinstance(frame, RgbdFrame):
            return self._segment_image(frame, mask)
        return self._segment_cloud(frame, mask)

    def _reserve(self, count: int) -> FloatArray:
        if self._points.shape[1] < count:
            self._points = coordinate_buffer(count)
        return self._points

    def _segment_image(self, frame: RgbdFrame, mask: NDArray[np.bool_] | None) -> FloatArray:
        camera, unit = frame.intrinsics, frame.depth_unit_m
        box, bounds = self._box_slabs()
        rows, columns = _pixel_window(camera, bounds)
        gate = self.gate if mask is None and frame.color is not None else None
        points = self._reserve(camera.width * camera.height)
        depth = np.ravel(frame.depth)
        count = _scan(
            depth,
            depth.view(np.uint16 if depth.dtype == np.uint16 else np.uint32),
            camera.width,
            unit,
            _raw_range(frame.depth.dtype, unit, bounds),
            (rows, columns),
            (camera.fx, camera.fy, camera.cx, camera.cy),
            _NO_BYTES if gate is None or frame.color is None else np.ravel(frame.color),
            _NO_FLAGS if mask is None else np.ravel(mask),
            _NO_LINE if gate is None else gate.line,
            0.0 if gate is None else gate.tolerance,
            _NO_VERDICTS if gate is None else gate.verdicts,
            box,
            -1.0 if self.flying_gap is None else self.flying_gap / unit,
            points,
        )
        return points[:, :count]

    def _segment_cloud(self, frame: CloudFrame, mask: NDArray[np.bool_] | None) -> FloatArray:
        box, _ = self._box_slabs()
        gate = self.gate if mask is None and frame.colors is not None else None
        points = self._reserve(len(frame.points))
        count = _segment_cloud(
            np.asarray(frame.points, dtype=float),
            _NO_COLORS if gate is None or frame.colors is None else np.ascontiguousarray(frame.colors),
            _NO_FLAGS if mask is None else np.ascontiguousarray(mask),
            _NO_LINE if gate is None else gate.line,
            0.0 if gate is None else gate.tolerance,
            _NO_VERDICTS if gate is None else gate.verdicts,
            box,
            points,
        )
        return points[:, :count]

    def _box_slabs(self) -> tuple[Any, tuple[FloatArray, FloatArray] | None]:
        if self.box is None:
            return _EVERYWHERE, None
        slabs = np.column_stack([self.box.box_from_camera[:3], self.box.low, self.box.high])
        return tuple(tuple(slab) for slab in slabs.tolist()), self.box.camera_bounds()


_NO_BYTES = np.empty(0, np.uint8)
_NO_COLORS = np.empty((0, 3), np.uint8)
_NO_FLAGS = np.empty(0, np.bool_)
_NO_LINE = np.empty((0, 3))
_NO_VERDICTS = np.empty(0, np.uint8)
_EVERYWHERE = ((0.0, 0.0, 0.0, 0.0, -np.inf, np.inf),) * 3
_FLYING_NEIGHBOURS = 3


def _pixel_window(
    camera: Intrinsics, bounds: tuple[FloatArray, FloatArray] | None
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Rows and columns (first, one past the last) that the box can project to."""
    if bounds is None:
        return (0, camera.height), (0, camera.width)
    low, high = bounds
    if high[2] <= 0:
        return (0, 0), (0, 0)
    near = max(low[2], 1e-6)
    window = []
    for axis, focal, centre, size in (
        (1, camera.fy, camera.cy, camera.height),
        (0, camera.fx, camera.cx, camera.width),
    ):
        first = low[axis] / (near if low[axis] < 0 else high[2])
        last = high[axis] / (near if high[axis] > 0 else high[2])
        window.append(
            (
                int(np.clip(np.floor(focal * first + centre), 0, size)),
                int(np.clip(np.ceil(focal * last + centre) + 1, 0, size)),
            )
        )
    return window[0], window[1]


def _raw_range(dtype: np.dtype[Any], unit: float, bounds: tuple[FloatArray, FloatArray] | None) -> Any:
    """Smallest and largest depth in range, as the unsigned integers that the depth image's bits are read as.

    The bits of positive floats order like the floats; negative floats, infinity and NaN lie above them.
    """
    low, high = (0.0, np.inf) if bounds is None else (bounds[0][2] / unit, bounds[1][2] / unit)
    if dtype == np.uint16:
        return np.uint16(np.clip(np.floor(low), 1, 65535)), np.uint16(np.clip(np.ceil(high), 1, 65535))
    limits = np.finfo(np.float32)
    ends = np.clip([low * (1 - 1e-6), high * (1 + 1e-6)], limits.tiny, limits.max).astype(np.float32)
    bits = ends.view(np.uint32)
    return bits[0], bits[1]


@njit(cache=True, nogil=True)
def _within(r: int, g: int, b: int, line: Any, tolerance: float) -> bool:
    """Judge one sRGB colour by its place in CIELAB."""
    linear = (LINEAR_OF_SRGB[r], LINEAR_OF_SRGB[g], LINEAR_OF_SRGB[b])
    f = np.empty(3)
    for row in range(3):
        ratio = (
            _XYZ_OF_RGB[row, 0] * linear[0] + _XYZ_OF_RGB[row, 1] * linear[1] + _XYZ_OF_RGB[row, 2] * linear[2]
        ) / _WHITE[row]
        f[row] = np.cbrt(ratio) if ratio > 216 / 24389 else (24389 / 27 * ratio + 16) / 116
    lab = (116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2]))
    if tolerance < 0:
        for axis in range(3):
            if not line[0, axis] <= lab[axis] <= line[1, axis]:
                return False
        return True
    for index in range(len(line) - 1):
        along = 0.0
        size = 0.0
        for axis in range(3):
            step = line[index + 1, axis] - line[index, axis]
            along += step * (lab[axis] - line[index, axis])
            size += step * step
        part = min(max(along / size, 0.0), 1.0) if size > 0 else 0.0
        distance = 0.0
        for axis in range(3):
            gap = lab[axis] - line[index, axis] - part * (line[index + 1, axis] - line[index, axis])
            distance += gap * gap
        if distance <= tolerance * tolerance:
            return True
    return False


@njit(cache=True, nogil=True)
def _key(r: Any, g: Any, b: Any) -> Any:
    return (np.uint32(r) << np.uint32(16)) | (np.uint32(g) << np.uint32(8)) | np.uint32(b)


@njit(cache=True, nogil=True)
def _judge(key: Any, line: Any, tolerance: float) -> Any:
    """The verdict on a colour, worked out: about a microsecond, once a colour."""
    inside = _within((key >> 16) & 255, (key >> 8) & 255, key & 255, line, tolerance)
    return _INSIDE if inside else _OUTSIDE


@njit(cache=True, nogil=True)
def _judge_all(colors: Any, line: Any, tolerance: float, verdicts: Any, passed: Any) -> None:
    for index in range(len(colors)):
        key = _key(colors[index, 0], colors[index, 1], colors[index, 2])
        if verdicts[key] == _UNKNOWN:
            verdicts[key] = _judge(key, line, tolerance)
        passed[index] = verdicts[key] == _INSIDE


@njit(cache=True, nogil=True)
def _in_box(x: float, y: float, z: float, box: Any) -> bool:
    """Whether a point lies in a box of three slabs (a, b, c, d, low, high): low <= a x + b y + c z + d <= high."""
    inside = True
    for a, b, c, d, low, high in box:
        place = a * x + b * y + c * z + d
        inside &= (low <= place) & (place <= high)
    return inside


@njit(cache=True, nogil=True)
def _flies(depth: Any, width: int, row: int, column: int, gap: float) -> bool:
    """Whether too few of a pixel's neighbours lie within the gap of its depth."""
    here = float(depth[row * width + column])
    near = -1
    for other_row in range(max(row - 1, 0), min(row + 2, len(depth) // width)):
        for other_column in range(max(column - 1, 0), min(column + 2, width)):
            near += abs(float(depth[other_row * width + other_column]) - here) <= gap
    return near < _FLYING_NEIGHBOURS


@njit(cache=True, nogil=True)
def _scan(
    depth: Any,
    bits: Any,
    width: int,
    unit: float,
    raw_range: Any,
    window: Any,
    lens: Any,
    color: Any,
    mask: Any,
    line: Any,
    tolerance: float,
    verdicts: Any,
    box: Any,
    flying_gap: float,
    points: Any,
) -> Any:
    (top, bottom), (left, right) = window
    fx, fy, cx, cy = lens
    low, high = raw_range
    span = type(low)(high - low)
    gated, masked, boxed = len(color) > 0, len(mask) > 0, box[0][4] > -np.inf
    per_fx, per_fy = 1 / fx, 1 / fy
    xs, ys, zs = points[0], points[1], points[2]
    count = np.uintp(0)
    for row in range(top, bottom):
        y_of_z = (row - cy) * per_fy
        for start in range(left, right, _BLOCK):
            # Unsigned indices and a constant length let the compiler turn the minimum over a block of unsigned
            # differences into a few vector instructions; most of an image is skipped by it.
            first = np.uintp(row * width + start)
            size = np.uintp(min(_BLOCK, right - start))
            nearest = type(low)(bits[first] - low)
            if size == _BLOCK:
                for index in range(np.uintp(_BLOCK)):
                    nearest = min(nearest, type(low)(bits[first + index] - low))
            else:
                for index in range(size):
                    nearest = min(nearest, type(low)(bits[first + index] - low))
            if nearest > span:
                continue
            for index in range(size):
                pixel = first + index
                if type(low)(bits[pixel] - low) > span:
                    continue
                if masked and not mask[pixel]:
                    continue
                z = depth[pixel] * unit
                x = (start + float(index) - cx) * per_fx * z
                y = y_of_z * z
                if boxed and not _in_box(x, y, z, box):
                    continue
                if gated:
                    channel = np.uintp(3) * pixel
                    key = _key(color[channel], color[channel + np.uintp(1)], color[channel + np.uintp(2)])
                    if verdicts[key] == _UNKNOWN:
                        verdicts[key] = _judge(key, line, tolerance)
                    if verdicts[key] == _OUTSIDE:
                        continue
                if flying_gap >= 0 and _flies(depth, width, row, start + int(index), flying_gap):
                    continue
                xs[count] = x
                ys[count] = y
                zs[count] = z
                count += np.uintp(1)
    return count


@njit(cache=True, nogil=True)
def _segment_cloud(
    cloud: Any,
    colors: Any,
    flags: Any,
    line: Any,
    tolerance: float,
    verdicts: Any,
    box: Any,
    points: Any,
) -> Any:
    gated, masked = len(colors) > 0, len(flags) > 0
    count = 0
    for index in range(len(cloud)):
        x, y, z = cloud[index, 0], cloud[index, 1], cloud[index, 2]
        if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
            continue
        if masked and not flags[index]:
            continue
        if not _in_box(x, y, z, box):
            continue
        if gated:
            key = _key(colors[index, 0], colors[index, 1], colors[index, 2])
            if verdicts[key] == _UNKNOWN:
                verdicts[key] = _judge(key, line, tolerance)
            if verdicts[key] == _OUTSIDE:
                continue
        points[0, count] = x
        points[1, count] = y
        points[2, count] = z
        count += 1
    return count
