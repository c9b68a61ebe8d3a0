"""The things in an RGB-D image: connected parts of one surface and one colour, and how long and wide each is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from ropetrace.segmentation import lab_from_rgb
from ropetrace.types import FloatArray, Intrinsics, RgbdFrame

Labels = NDArray[np.int32]

_DEPTH_STEP = 0.03
"""Neighbours whose depth differs by more than this part of it are on two surfaces."""

_COLOR_STEP = 6.0
"""Neighbours of one colour differ by no more than this once the brighter is as dark as the other, CIELAB units."""

_LIGHT_STEP = 3.0 ** (1 / 3)
"""The most by which the cube root of light changes from a pixel of a surface to the next, as a ratio."""


@dataclass(frozen=True, slots=True, eq=False)
class Things:
    """The measures of labelled parts of an image; row k belongs to label k, and label 0 is what is no thing.

    Parameters
    ----------
    labels : (H, W) int32 array
        The part that each pixel belongs to.
    pixels : (K,) int array
        How many pixels each has.
    areas : (K,) float array
        Surface that faces the camera, m^2.
    widths : (K,) float array
        Metres: four times the mean distance of its pixels to its edge, as it is for a ribbon.
    pixel_sizes : (K,) float array
        What a pixel covers at its distance, metres.
    """

    labels: Labels
    pixels: NDArray[np.int64]
    areas: FloatArray
    widths: FloatArray
    pixel_sizes: FloatArray

    @property
    def lengths(self) -> FloatArray:
        """(K,): the length of the ribbon of this area and width, metres."""
        return self.areas / np.maximum(self.widths, 1e-9)

    @property
    def slenderness(self) -> FloatArray:
        """(K,): length by width. A disc has 1.8, a square 2.3, a ribbon its true ratio."""
        return self.lengths / np.maximum(self.widths, 1e-9)


def depth_in_metres(frame: RgbdFrame) -> FloatArray:
    """Depth, (H, W), metres; 0 where there is none."""
    depth = frame.depth * float(frame.depth_unit_m)
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0.0)


def surfaces(frame: RgbdFrame) -> Labels:
    """Labels, (H, W), of the connected surfaces of one colour, whatever the light on them; 0 has no depth.

    The frame must have colour. Neighbouring pixels, of the eight, belong together if neither their depth nor their
    colour nor the light on them leaps. Colours are compared as the gate does it: both in the same light.
    """
    assert frame.color is not None
    lab = lab_from_rgb(frame.color)
    # The cube root of the light: what light scales in CIELAB, but for the darkest colours.
    light = (lab[..., 0] + 16) / 116
    labels = np.empty(frame.depth.shape, np.int32)
    _connect(depth_in_metres(frame), light, lab[..., 1] / light, lab[..., 2] / light, labels)
    return labels


def connected(mask: NDArray[np.bool_]) -> Labels:
    """Labels, (H, W), of the parts of a mask that hang together, diagonals included; 0 is outside."""
    return np.asarray(ndimage.label(mask, np.ones((3, 3)))[0], np.int32)


def measured(labels: Labels, depth: FloatArray, camera: Intrinsics) -> Things:
    """Measure labelled parts of an image.

    Parameters
    ----------
    labels : (H, W) int32 array
        0 is no part.
    depth : (H, W) float array
        Metres, 0 where there is none: such a pixel counts at the mean depth of its part.
    camera : Intrinsics
        Of the image.
    """
    flat, far = labels.ravel(), depth.ravel()
    pixels = np.bincount(flat)
    seen = np.bincount(flat, far > 0)
    depths = np.bincount(flat, far) / np.maximum(seen, 1)
    focal = float(np.sqrt(camera.fx * camera.fy))
    inner = np.ones(labels.shape, bool)
    for here, there in (((slice(1, None),), (slice(-1),)), ((slice(None), slice(1, None)), (slice(None), slice(-1)))):
        differ = labels[here] != labels[there]
        inner[here] &= ~differ
        inner[there] &= ~differ
    to_edge = np.zeros(labels.shape)
    window = _window(labels > 0)
    to_edge[window] = ndimage.distance_transform_edt(inner[window]) + 0.5
    pixel_sizes = depths / focal
    widths = 4 * np.bincount(flat, to_edge.ravel()) / np.maximum(pixels, 1) * pixel_sizes
    return Things(labels, pixels, pixels * pixel_sizes**2, widths, pixel_sizes)


def _window(mask: NDArray[np.bool_]) -> tuple[slice, slice]:
    """The smallest window that holds a mask, and a pixel around it."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return slice(0), slice(0)
    return slice(max(rows[0] - 1, 0), rows[-1] + 2), slice(max(columns[0] - 1, 0), columns[-1] + 2)


@njit(cache=True, nogil=True)
def _root(parents: Any, index: int) -> int:
    while parents[index] != index:
        parents[index] = parents[parents[index]]
        index = parents[index]
    return index


@njit(cache=True, nogil=True)
def _connect(depth: Any, light: Any, red: Any, blue: Any, labels: Any) -> None:
    """Union-find over the links between neighbours. `light` is the cube root of the light, `red` and `blue` are a* and
    b* divided by it."""
    height, width = depth.shape
    parents = np.arange(height * width)
    for row in range(height):
        for column in range(width):
            here = depth[row, column]
            if here <= 0:
                continue
            for down, aside in ((0, 1), (1, -1), (1, 0), (1, 1)):
                i, j = row + down, column + aside
                if i >= height or j < 0 or j >= width or depth[i, j] <= 0:
                    continue
                if abs(depth[i, j] - here) > _DEPTH_STEP * min(here, depth[i, j]):
                    continue
                dark, bright = min(light[row, column], light[i, j]), max(light[row, column], light[i, j])
                if bright > _LIGHT_STEP * dark:
                    continue
                across, along = red[row, column] - red[i, j], blue[row, column] - blue[i, j]
                if dark * np.sqrt(across * across + along * along) > _COLOR_STEP:
                    continue
                a, b = _root(parents, row * width + column), _root(parents, i * width + j)
                if a < b:
                    parents[b] = a
                else:
                    parents[a] = b
    names = np.zeros(height * width, np.int32)
    count = 0
    for row in range(height):
        for column in range(width):
            labels[row, column] = 0
            if depth[row, column] > 0:
                root = _root(parents, row * width + column)
                if names[root] == 0:
                    count += 1
                    names[root] = count
                labels[row, column] = names[root]
