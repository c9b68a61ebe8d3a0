"""The noise of depth cameras that triangulate: the Kinect v1 and a stereo camera like RealSense's D435.

Both see along two lines of sight, a baseline apart along the image's x, and measure a disparity. It is what is noisy
and what is counted in steps, so that the error grows with the square of the distance. What one of the two cannot see
has no depth: a shadow to the left of what stands in front.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ropetrace.errors import ConfigError
from ropetrace.sim.pixel_random import FARTHEST_NORMAL, NORMAL_QUANTILES, keys, normal
from ropetrace.sim.raycaster import Window, grown
from ropetrace.types import FloatArray, Intrinsics

_KINECT_FOCAL = 580.0
"""Focal length of the Kinect v1's depth camera, pixels of its own 640x480 image."""
_KINECT_BASELINE = 0.075
"""From its infrared projector to its camera, metres: f b = 43.5 px m."""
_KINECT_STEPS = 8.0
"""Steps of its disparity in a pixel."""
_KINECT_NEAREST, _KINECT_FARTHEST = 0.4, 4.5
_KINECT_STEEPEST = math.radians(80.0)
"""Surfaces seen at a larger angle from head-on give no return."""
_SAME_SURFACE = math.tan(math.radians(85.0))
"""Neighbours between which the surface would be steeper than this belong to two surfaces."""


@dataclass(frozen=True, slots=True)
class KinectV1:
    """Axial and lateral noise, steps of disparity and shadow of the first Kinect.

    With z the depth in metres and t the angle between the ray and the surface's normal:

    - axial: normal, deviation 0.0012 + 0.0019 (z - 0.4)^2 m, and beyond 60 degrees 0.0001 t^2 / (sqrt(z) (pi/2 - t)^2)
      more; lateral: a pixel shows what lies a normal deviate of 0.8 + 0.035 t / (pi/2 - t) px beside it in both
      directions, in pixels of the Kinect's own 640x480 image, f = 580 px (Nguyen, Izadi and Lovell, "Modeling Kinect
      sensor noise for improved 3D reconstruction and tracking", 3DIMPVT 2012);
    - disparity f b / z, f b = 43.5 px m, is counted in steps of 1/8 px: 2.87 mm at 1 m, growing with z^2 (Khoshelham
      and Oude Elberink, "Accuracy and resolution of Kinect depth data for indoor mapping applications", Sensors 2012);
    - the projector's shadow, f b (1/z_front - 1/z_behind) px wide;
    - no return beyond 80 degrees, nearer than 0.4 m or farther than 4.5 m.

    The axial deviation was measured on a sensor that counts in steps, so that both together overstate the noise, by a
    tenth at 1 m. Which pixel a surface is seen in changes from pixel to pixel without correlation, as the model has it.

    Parameters
    ----------
    shadow : bool
        Whether there is the projector's shadow.
    """

    shadow: bool = True

    def reach(self, camera: Intrinsics) -> int:
        """The largest lateral shift, pixels."""
        widest = 0.8 + 0.035 * _KINECT_STEEPEST / (math.pi / 2 - _KINECT_STEEPEST)
        return math.ceil(FARTHEST_NORMAL * widest * max(camera.fx, camera.fy) / _KINECT_FOCAL + 0.5)

    def apply(
        self, depth: NDArray[np.float32], camera: Intrinsics, rng: np.random.Generator, window: Window
    ) -> NDArray[np.float32]:
        """See `noise.SensorNoise.apply`."""
        lens = (camera.fx, camera.fy, camera.cx, camera.cy)
        angle = grazing_angle(depth, camera, window)
        lit = shadowed(depth, camera.fx * _KINECT_BASELINE, window) if self.shadow else depth
        out = np.zeros(depth.shape, np.float32)
        _see_as_kinect(
            lit, angle, lens, keys(rng, 3), NORMAL_QUANTILES, out, *grown(window, self.reach(camera), depth.shape)
        )
        return out


@dataclass(frozen=True, slots=True)
class Stereo:
    """Noise, steps of disparity and shadow of a stereo camera; the defaults are those of RealSense's D435.

    The disparity is f b / z with f the focal length of the device's own mode of the image's width, 430 px at 848. Its
    error is normal with a deviation of `subpixel`, so that depth has z^2 subpixel / (f b): 3.7 mm at 1 m and 848 pixels
    (Grunnet-Jepsen, Sweetser and Woodfill, "Tuning depth cameras for best performance", Intel RealSense D400 series,
    whose f is half the image's width over the tangent of half its field of view). The matching window makes the errors
    of neighbours alike: each is the mean of independent errors over `matching_window` pixels squared. The disparity is
    counted in 1/32 px, and no larger than 126 px, which is the nearest distance. What the right camera cannot see has
    no return.

    The image may have a narrower field of view than the device, whose depth errors it keeps.

    Parameters
    ----------
    subpixel : float
        Deviation of the disparity, pixels.
    baseline : float
        Metres.
    focal_share : float
        Focal length as a share of the image's width.
    matching_window : int
        Width of the window of pixels that is matched; odd.
    disparity_step : float
        Pixels.
    largest_disparity : float
        Pixels.
    shadow : bool
        Whether what only the left camera sees is lost.
    """

    subpixel: float = 0.08
    baseline: float = 0.05
    focal_share: float = 430 / 848
    matching_window: int = 3
    disparity_step: float = 1 / 32
    largest_disparity: float = 126.0
    shadow: bool = True

    def __post_init__(self) -> None:
        for name in ("baseline", "focal_share", "disparity_step", "largest_disparity"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"Stereo: {name} = {getattr(self, name)} must be positive")
        if not self.subpixel >= 0:
            raise ConfigError(f"Stereo: subpixel = {self.subpixel} must not be negative")
        if self.matching_window < 1 or self.matching_window % 2 == 0:
            raise ConfigError(f"Stereo: matching_window = {self.matching_window} must be odd: 1, 3, 5, ...")

    def reach(self, camera: Intrinsics) -> int:
        """It adds no returns."""
        return 0

    def deviation(self, z: FloatArray, width: int) -> FloatArray:
        """Deviation of depth z, metres, before it is counted in steps, for images of that width."""
        return z**2 * self.subpixel / (self.focal_share * width * self.baseline)

    def apply(
        self, depth: NDArray[np.float32], camera: Intrinsics, rng: np.random.Generator, window: Window
    ) -> NDArray[np.float32]:
        """See `noise.SensorNoise.apply`."""
        seen = shadowed(depth, camera.fx * self.baseline, window) if self.shadow else depth
        out = np.zeros(depth.shape, np.float32)
        _see_as_stereo(
            seen,
            self.focal_share * camera.width * self.baseline,
            self.subpixel,
            self.matching_window,
            self.disparity_step,
            self.largest_disparity,
            keys(rng, 1)[0],
            NORMAL_QUANTILES,
            out,
            *window,
        )
        return out


def shadowed(depth: NDArray[np.float32], focal_baseline: float, window: Window) -> NDArray[np.float32]:
    """Depth without what a second view, a baseline to the right, cannot see.

    Parameters
    ----------
    depth : (H, W) float32 array
        Metres; 0 is no surface.
    focal_baseline : float
        Focal length of the image times the baseline, pixels times metres.
    window : Window
        All surfaces lie in it.

    Returns
    -------
    (H, W) float32 array
    """
    out = np.zeros(depth.shape, np.float32)
    _cast_shadow(depth, focal_baseline, out, *window)
    return out


def grazing_angle(depth: NDArray[np.float32], camera: Intrinsics, window: Window) -> NDArray[np.float32]:
    """Angle between the ray and the surface's normal, (H, W), radians; 0 where there is no surface.

    The inverse depth of a plane is linear in the image, and its gradient gives the normal: exact on planes. A neighbour
    beyond a step in depth does not count; where none is left along x or y, the surface is taken to be flat that way.
    """
    out = np.zeros(depth.shape, np.float32)
    _measure_angle(depth, (camera.fx, camera.fy, camera.cx, camera.cy), out, *window)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _cast_shadow(depth: Any, focal_baseline: float, out: Any, top: int, bottom: int, left: int, right: int) -> None:
    for row in range(top, bottom):
        # Columns in the second view: from the right on, what lies right of a column met before is hidden behind it.
        leftmost = np.inf
        for column in range(right - 1, left - 1, -1):
            z = depth[row, column]
            if z > 0:
                seen_at = column - focal_baseline / z
                if seen_at <= leftmost:
                    leftmost = seen_at
                    out[row, column] = z


@njit(cache=True, nogil=True, error_model="numpy")
def _gradient(before: float, here: float, after: float, steepest: float) -> float:
    """Gradient of inverse depth over one pixel, from the neighbours on the same surface. 0 is no surface."""
    has_before = before > 0 and abs(here - before) < steepest * before
    has_after = after > 0 and abs(here - after) < steepest * after
    if has_before and has_after:
        return (after - before) / 2
    if has_before:
        return here - before
    if has_after:
        return after - here
    return 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _invert_row(depth: Any, row: int, left: int, right: int, out: Any) -> None:
    """Inverse depth of a row from `left` - 1 to `right`, 0 where there is no surface or no image."""
    out[:] = 0.0
    if 0 <= row < depth.shape[0]:
        for column in range(max(left - 1, 0), min(right + 1, depth.shape[1])):
            z = depth[row, column]
            out[column - left + 1] = 1 / np.float64(z) if z > 0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _arccosine(x: float) -> float:
    """Of 0 to 1, to 2e-8, faster than libm's: Abramowitz and Stegun, "Handbook of Mathematical Functions", 4.4.46."""
    tail = -0.0170881256 + x * (0.0066700901 - x * 0.0012624911)
    head = 1.5707963050 + x * (-0.2145988016 + x * (0.0889789874 + x * (-0.0501743046 + x * (0.0308918810 + x * tail))))
    return np.sqrt(1.0 - x) * head


@njit(cache=True, nogil=True, error_model="numpy")
def _measure_angle(depth: Any, lens: Any, out: Any, top: int, bottom: int, left: int, right: int) -> None:
    fx, fy, cx, cy = lens
    steepest_x, steepest_y = _SAME_SURFACE / fx, _SAME_SURFACE / fy
    inverse = np.empty((3, right - left + 2))
    _invert_row(depth, top - 1, left, right, inverse[(top - 1) % 3])
    _invert_row(depth, top, left, right, inverse[top % 3])
    for row in range(top, bottom):
        _invert_row(depth, row + 1, left, right, inverse[(row + 1) % 3])
        above, here, below = inverse[(row - 1) % 3], inverse[row % 3], inverse[(row + 1) % 3]
        dy = (row - cy) / fy
        for k in range(1, right - left + 1):
            if here[k] == 0:
                continue
            dx = (left + k - 1 - cx) / fx
            gx = fx * _gradient(here[k - 1], here[k], here[k + 1], steepest_x)
            gy = fy * _gradient(above[k], here[k], below[k], steepest_y)
            gz = here[k] - dx * gx - dy * gy
            cosine = here[k] / np.sqrt((gx * gx + gy * gy + gz * gz) * (dx * dx + dy * dy + 1))
            out[row, left + k - 1] = _arccosine(min(cosine, 1.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _see_as_kinect(
    depth: Any,
    angle: Any,
    lens: Any,
    noise_keys: Any,
    quantiles: Any,
    out: Any,
    top: int,
    bottom: int,
    left: int,
    right: int,
) -> None:
    height, width = depth.shape
    scale_x, scale_y = lens[0] / _KINECT_FOCAL, lens[1] / _KINECT_FOCAL
    steps = _KINECT_STEPS * _KINECT_FOCAL * _KINECT_BASELINE
    for row in range(top, bottom):
        for column in range(left, right):
            index = row * width + column
            tilt = min(np.float64(angle[row, column]), _KINECT_STEEPEST)
            lateral = 0.8 + 0.035 * tilt / (np.pi / 2 - tilt)
            source_column = column + np.int64(np.rint(lateral * scale_x * normal(noise_keys[0], index, quantiles)))
            source_row = row + np.int64(np.rint(lateral * scale_y * normal(noise_keys[1], index, quantiles)))
            if not (0 <= source_row < height and 0 <= source_column < width):
                continue
            z = np.float64(depth[source_row, source_column])
            tilt = np.float64(angle[source_row, source_column])
            if z < _KINECT_NEAREST or z > _KINECT_FARTHEST or tilt > _KINECT_STEEPEST:
                continue
            deviation = 0.0012 + 0.0019 * (z - 0.4) ** 2
            if tilt > np.pi / 3:
                deviation += 0.0001 / np.sqrt(z) * (tilt / (np.pi / 2 - tilt)) ** 2
            z += deviation * normal(noise_keys[2], index, quantiles)
            out[row, column] = steps / np.rint(steps / z)


@njit(cache=True, nogil=True, error_model="numpy")
def _see_as_stereo(
    depth: Any,
    focal_baseline: float,
    subpixel: float,
    size: int,
    step: float,
    largest: float,
    key: Any,
    quantiles: Any,
    out: Any,
    top: int,
    bottom: int,
    left: int,
    right: int,
) -> None:
    half = size // 2
    padded_width = depth.shape[1] + size - 1
    # Sums along the rows of the window are kept for `size` rows; their sum is that of the window. Each pixel of the
    # image with its margin has a number of its own, so that the noise does not depend on the part worked on.
    rows = np.zeros((size, right - left))
    white = np.empty(right - left + size - 1)
    for padded_row in range(top, bottom + size - 1):
        for k in range(len(white)):
            white[k] = normal(key, padded_row * padded_width + left + k, quantiles)
        for k in range(right - left):
            total = 0.0
            for j in range(size):
                total += white[k + j]
            rows[padded_row % size, k] = total
        row = padded_row - 2 * half
        if row < top:
            continue
        for k in range(right - left):
            z = np.float64(depth[row, left + k])
            if z == 0:
                continue
            total = 0.0
            for j in range(size):
                total += rows[j, k]
            disparity = np.rint((focal_baseline / z + subpixel * total / size) / step) * step
            if 0 < disparity <= largest:
                out[row, left + k] = focal_baseline / disparity
