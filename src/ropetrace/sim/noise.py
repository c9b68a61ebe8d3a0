"""What real depth cameras do to exact depth: noise that acts on metres, one after the other.

The sensors are in `triangulation`; here are the edges, the chain, and the names.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ropetrace.errors import ConfigError
from ropetrace.sim.pixel_random import NORMAL_QUANTILES, keys, normal, uniform
from ropetrace.sim.raycaster import Window, grown
from ropetrace.sim.triangulation import KinectV1, Stereo
from ropetrace.types import Intrinsics


def kinect_axial(
    depth: NDArray[np.float32], rng: np.random.Generator, lost_edges: float = 0.5, step: float = 0.001
) -> NDArray[np.uint16]:
    """Axial noise, missing returns at edges and quantisation, as a Kinect shows them.

    The noise is normal with the standard deviation 1.2 mm + 1.9 mm/m^2 (z - 0.4 m)^2 (Nguyen, Izadi and Lovell,
    "Modeling Kinect sensor noise for improved 3D reconstruction and tracking", 3DIMPVT 2012, their equation for
    surfaces seen head on).

    Parameters
    ----------
    depth : (H, W) float32 array
        Exact planar depth, metres; 0 is no surface.
    rng : numpy.random.Generator
        The source of the noise.
    lost_edges : float
        Share of the pixels next to a step in depth (5 cm or more, or to nothing) that give no return.
    step : float
        Quantisation, metres.

    Returns
    -------
    (H, W) uint16 array
        Depth in units of `step`; 0 where there is no return.
    """
    rows, columns = np.flatnonzero(depth.any(axis=1)), np.flatnonzero(depth.any(axis=0))
    noisy = np.zeros(depth.shape, np.uint16)
    if not len(rows):
        return noisy
    # Only the window that holds surfaces is worked on: a rope fills little of an image.
    window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    z = depth[window].astype(float)
    around = np.pad(z, 1)
    steps = [
        np.abs(other - z) > 0.05 for other in (around[:-2, 1:-1], around[2:, 1:-1], around[1:-1, :-2], around[1:-1, 2:])
    ]
    edge = np.logical_or.reduce(steps)
    seen = (z > 0) & ~(edge & (rng.random(z.shape) < lost_edges))
    z += rng.standard_normal(z.shape) * (0.0012 + 0.0019 * (z - 0.4) ** 2)
    noisy[window] = np.where(seen, np.clip(np.round(z / step), 0, 65535), 0).astype(np.uint16)
    return noisy


class SensorNoise(Protocol):
    """One thing that a sensor does to exact depth. Several act one after the other: `apply_noise`."""

    def reach(self, camera: Intrinsics) -> int:
        """How many pixels beyond a surface it can show returns."""
        ...

    def apply(
        self, depth: NDArray[np.float32], camera: Intrinsics, rng: np.random.Generator, window: Window
    ) -> NDArray[np.float32]:
        """Depth as the sensor reports it.

        Parameters
        ----------
        depth : (H, W) float32 array
            Planar depth, metres; 0 is no surface. It is left as it is.
        camera : Intrinsics
            Of the image.
        rng : numpy.random.Generator
            The source of the noise. What is drawn for a pixel does not depend on the window.
        window : Window
            All surfaces lie in this part of the image.

        Returns
        -------
        (H, W) float32 array
            Metres; 0 where there is no return.
        """
        ...


def apply_noise(
    noise: tuple[SensorNoise, ...],
    depth: NDArray[np.float32],
    camera: Intrinsics,
    rng: np.random.Generator,
    window: Window | None = None,
) -> tuple[NDArray[np.float32], Window]:
    """Apply each noise in turn; without a window, to the whole image.

    Returns
    -------
    depth : (H, W) float32 array
        Metres; 0 where there is no return. The array given, if there is no noise at all.
    window : Window
        All returns lie in it.
    """
    window = (0, camera.height, 0, camera.width) if window is None else window
    for one in noise:
        depth = one.apply(depth, camera, rng, window)
        window = grown(window, one.reach(camera), depth.shape)
    return depth, window


def in_steps(depth: NDArray[np.float32], unit: float, window: Window | None = None) -> NDArray[np.uint16]:
    """Depth counted in steps of `unit` metres, (H, W) uint16; what is too far to be counted gives no return, 0."""
    top, bottom, left, right = (0, depth.shape[0], 0, depth.shape[1]) if window is None else window
    counted = np.zeros(depth.shape, np.uint16)
    _count(depth, 1 / unit, counted, top, bottom, left, right)
    return counted


def noise_model(name: str) -> tuple[SensorNoise, ...]:
    """The noise of a kind of sensor, by its name: see `NOISE_MODELS`.

    Raises
    ------
    ConfigError
        If there is none of that name.
    """
    if name not in NOISE_MODELS:
        raise ConfigError(f"unknown noise model {name!r}: choose one of {', '.join(NOISE_MODELS)}")
    return NOISE_MODELS[name]


@dataclass(frozen=True, slots=True)
class LostEdges:
    """A share of the pixels at a step in depth gives no return.

    A heuristic: the shares of real sensors vary with the surface and the light.

    Parameters
    ----------
    share : float
        0 to 1.
    step : float
        Neighbours (4 of them) whose depth differs by more than this, in metres, or where there is nothing, make an
        edge. The border of the image makes none.
    """

    share: float = 0.5
    step: float = 0.05

    def __post_init__(self) -> None:
        _check_edges("LostEdges", self.share, self.step)

    def reach(self, camera: Intrinsics) -> int:
        """It adds no returns."""
        return 0

    def apply(
        self, depth: NDArray[np.float32], camera: Intrinsics, rng: np.random.Generator, window: Window
    ) -> NDArray[np.float32]:
        """See `SensorNoise.apply`."""
        out = np.zeros(depth.shape, np.float32)
        _lose_edges(depth, self.share, self.step, keys(rng, 1)[0], out, *window)
        return out


@dataclass(frozen=True, slots=True)
class FlyingPixels:
    """A share of the pixels at a step between two surfaces lies anywhere between them, evenly.

    Time-of-flight sensors, and the interpolation in stereo sensors, mix the two surfaces in a pixel at the edge. The
    even distribution is a heuristic.

    Parameters
    ----------
    share : float
        0 to 1. Of the pixels on both sides of the step.
    step : float
        Neighbours (4 of them) whose depth differs by more than this, metres, make a step. Where there is nothing
        behind, nothing is mixed.
    """

    share: float = 0.3
    step: float = 0.05

    def __post_init__(self) -> None:
        _check_edges("FlyingPixels", self.share, self.step)

    def reach(self, camera: Intrinsics) -> int:
        """It adds no returns."""
        return 0

    def apply(
        self, depth: NDArray[np.float32], camera: Intrinsics, rng: np.random.Generator, window: Window
    ) -> NDArray[np.float32]:
        """See `SensorNoise.apply`."""
        out = np.zeros(depth.shape, np.float32)
        chosen, place = keys(rng, 2)
        _fly(depth, self.share, self.step, chosen, place, out, *window)
        return out


@dataclass(frozen=True, slots=True)
class WhiteNoise:
    """Normal noise along the ray's depth, of one deviation everywhere: no sensor's, but comparable between papers.

    Parameters
    ----------
    sigma : float
        Standard deviation, metres.
    """

    sigma: float = 0.001

    def reach(self, camera: Intrinsics) -> int:
        """It adds no returns."""
        return 0

    def apply(
        self, depth: NDArray[np.float32], camera: Intrinsics, rng: np.random.Generator, window: Window
    ) -> NDArray[np.float32]:
        """See `SensorNoise.apply`."""
        out = np.zeros(depth.shape, np.float32)
        _add_white(depth, self.sigma, keys(rng, 1)[0], NORMAL_QUANTILES, out, *window)
        return out


def _check_edges(name: str, share: float, step: float) -> None:
    if not 0 <= share <= 1:
        raise ConfigError(f"{name}: share = {share} must lie between 0 and 1")
    if not step > 0:
        raise ConfigError(f"{name}: step = {step} must be a positive number of metres")


NOISE_MODELS: dict[str, tuple[SensorNoise, ...]] = {
    "none": (),
    "kinect_v1": (KinectV1(),),
    "stereo": (Stereo(),),
    "kinect_v1_edges": (LostEdges(0.5), KinectV1()),
    "stereo_edges": (FlyingPixels(0.3), LostEdges(0.2), Stereo()),
    "white_1mm": (WhiteNoise(0.001),),
}
"""Noise by its name: each sensor with clean edges and with those that cost real ones returns; and 1 mm everywhere."""


@njit(cache=True, nogil=True, error_model="numpy")
def _neighbours(depth: Any, row: int, column: int) -> Any:
    """Depth of the pixels above, below, left and right; the pixel's own beyond the border."""
    height, width = depth.shape
    z = depth[row, column]
    return (
        depth[row - 1, column] if row > 0 else z,
        depth[row + 1, column] if row < height - 1 else z,
        depth[row, column - 1] if column > 0 else z,
        depth[row, column + 1] if column < width - 1 else z,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _lose_edges(
    depth: Any, share: float, step: float, key: Any, out: Any, top: int, bottom: int, left: int, right: int
) -> None:
    for row in range(top, bottom):
        for column in range(left, right):
            z = depth[row, column]
            if z == 0:
                continue
            edge = False
            for other in _neighbours(depth, row, column):
                edge = edge or other == 0 or abs(other - z) > step
            if not (edge and uniform(key, row * depth.shape[1] + column) < share):
                out[row, column] = z


@njit(cache=True, nogil=True, error_model="numpy")
def _fly(
    depth: Any,
    share: float,
    step: float,
    chosen: Any,
    place: Any,
    out: Any,
    top: int,
    bottom: int,
    left: int,
    right: int,
) -> None:
    for row in range(top, bottom):
        for column in range(left, right):
            z = depth[row, column]
            if z == 0:
                continue
            near = far = z
            for other in _neighbours(depth, row, column):
                if other > 0:
                    near, far = min(near, other), max(far, other)
            index = row * depth.shape[1] + column
            if far - near > step and uniform(chosen, index) < share:
                z = near + (far - near) * uniform(place, index)
            out[row, column] = z


@njit(cache=True, nogil=True, error_model="numpy")
def _count(depth: Any, per_metre: float, out: Any, top: int, bottom: int, left: int, right: int) -> None:
    for row in range(top, bottom):
        for column in range(left, right):
            steps = np.rint(depth[row, column] * per_metre)
            out[row, column] = np.uint16(steps) if 0 < steps < 65535.5 else np.uint16(0)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_white(
    depth: Any, sigma: float, key: Any, quantiles: Any, out: Any, top: int, bottom: int, left: int, right: int
) -> None:
    for row in range(top, bottom):
        for column in range(left, right):
            z = depth[row, column]
            if z > 0:
                out[row, column] = max(z + sigma * normal(key, row * depth.shape[1] + column, quantiles), 0.0)
