"""The outline of a rope in an image: which things are thin, and how wide they are, finer than the pixels."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ropetrace.centerline import chain_tangents
from ropetrace.config import DIAMETER_RANGE, SegmentationConfig, default_variance_threshold, parse_color
from ropetrace.ordering import NodeGraph, order_path
from ropetrace.segmentation import BRIGHTEST, DARKEST, LINEAR_OF_SRGB, ColorGate
from ropetrace.slicing import Slicer
from ropetrace.things import Things, connected, depth_in_metres, measured
from ropetrace.types import FloatArray, RgbdFrame, Slices

Mask = NDArray[np.bool_]

_HOLES = 2
"""Half the size of the holes in what passes a gate that noise makes, pixels."""

_EDGE = 2
"""Pixels of the rope's colour this close to one with depth count as seen: depth is lost at edges."""

_SLENDER = 8.0
"""A thing this many times longer than wide is thin."""

_WIDEST = 0.06
"""Wider things are not proposed for ropes, metres."""

_FEWEST_PIXELS = 60
_NARROWEST = 1.9
"""Things of fewer pixels, or fewer across, are noise or the blurred outlines of others."""

_BLUR = 3
"""How far the blurred edge of the rope reaches beyond the pixels that pass the gate, pixels."""

_SHADES = (DARKEST, BRIGHTEST)
"""Light on the rope's middle relative to full light."""

_TURNED = np.linspace(0.5, 1.05, 12)
"""Light on the rope's edges, relative to that on its middle nearby, that is tried."""

_BLACK = 0.002
"""Darker than this, in linear light, is no surface but nothing."""

_NOISE = 3e-4
"""Mixtures that miss a pixel's colour by this much more than the best one explain it as well: linear light, squared."""

_FEWEST_SLICES = 5
"""Fewer slices than this in an image are no rope."""

_MOST_SLICES = 400

_SURFACE = 0.98
"""How far the nearer part of the surface lies before the axis, in radii."""


def gate_of(color: str | None) -> ColorGate | None:
    """The gate of a colour with the tolerance that a rope's settings have by default."""
    return None if color is None else ColorGate.around_color(parse_color(color), SegmentationConfig().color_tolerance)


def silhouette_of(image: RgbdFrame, depth: FloatArray, gate: ColorGate | None) -> Mask:
    """The pixels, (H, W), of what passes the gate: with depth, and those beside it that lost theirs."""
    if gate is None or image.color is None:
        return depth > 0
    passes = gate.accepts(image.color)
    seen = passes & ndimage.binary_dilation(passes & (depth > 0), np.ones((3, 3)), _EDGE)
    # A surface that passes in half of its pixels is no net of threads.
    return seen | ndimage.binary_closing(seen, np.ones((3, 3)), _HOLES)


def thin_ones(things: Things) -> Mask:
    """Which things, (K,), are as thin as a rope, and none of the blurred outlines of others."""
    widths, low, high = things.widths, DIAMETER_RANGE[0], _WIDEST
    thin = (things.slenderness >= _SLENDER) & (low <= widths) & (widths <= high) & (things.pixels >= _FEWEST_PIXELS)
    thin[0] = False
    return np.asarray(thin & (widths >= _NARROWEST * things.pixel_sizes))


def slice_widths(image: RgbdFrame, color: str | None) -> FloatArray:
    """How wide the longest thin thing of a colour is, slice by slice.

    The outline, and the blur around it, is cut into slices as a rope's points are. The area that the rope covers in a
    slice, counted in parts of pixels, by the slice's length is its width.

    Parameters
    ----------
    image : RgbdFrame
        Must have colour if one is given.
    color : str, optional
        Of the rope in full light. Without it everything with depth counts, and edges that lost theirs are missed.

    Returns
    -------
    (M, 5) float array
        Width, its standard uncertainty because of blurred edges, and pixel size there, metres; column and row of the
        middle, pixels. Empty if nothing thin is seen.
    """
    camera, depth = image.intrinsics, depth_in_metres(image)
    silhouette = silhouette_of(image, depth, gate_of(color))
    things = measured(connected(silhouette), depth, camera)
    lengths = np.where(thin_ones(things), things.lengths, 0.0)
    if not lengths.any():
        return np.empty((0, 5))
    thing = things.labels == int(np.argmax(lengths))
    if color is None:
        ribbon, cover, unsure = thing, thing.astype(float), np.zeros(thing.shape)
    else:
        ribbon = ndimage.binary_dilation(thing, np.ones((3, 3)), _BLUR)
        cover, unsure = _cover(image, color, silhouette, ribbon)
    rows, columns = np.nonzero(ribbon)
    # On the plane one metre ahead.
    points = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(len(rows))])
    width = 4 * float(ndimage.distance_transform_edt(ribbon)[ribbon].mean() - 0.5) / camera.fx
    slices = Slicer(default_variance_threshold(width), None, _MOST_SLICES).slice(points)
    if len(slices) < _FEWEST_SLICES:
        return np.empty((0, 5))
    # The first and the last end somewhere within the ribbon.
    slices = slices.kept(order_path(NodeGraph.of(slices.centroids, slices.covariances))[1:-1])
    tangents = chain_tangents(slices.centroids)
    columns = np.rint(points[0] * camera.fx + camera.cx).astype(int)
    rows = np.rint(points[1] * camera.fy + camera.cy).astype(int)
    covers = _of_slices(cover[rows, columns], slices, np.sum)
    doubts = _of_slices(unsure[rows, columns], slices, np.sum)
    far = np.where(thing & (depth > 0), depth, np.nan)[rows, columns]
    depths = _of_slices(far, slices, _front)
    pixel_area = 1 / (camera.fx * camera.fy)
    along = np.einsum("mi,mij,mj->m", tangents, slices.covariances, tangents)
    x, y = slices.centroids[:, 0], slices.centroids[:, 1]
    # The plane is seen aslant away from its middle, where it shows things wider than they are.
    aslant = np.sqrt(1 + (tangents[:, 0] * y - tangents[:, 1] * x) ** 2)
    angles = covers * pixel_area / np.sqrt(12 * along + pixel_area / 2) / aslant
    # The outline is that of the axis, which lies behind the surface that has the depth.
    distances = depths / (1 - _SURFACE * angles / 2)
    middles = [x * camera.fx + camera.cx, y * camera.fy + camera.cy]
    doubtful = angles * distances * doubts / np.maximum(covers, 1e-9)
    table = np.column_stack([angles * distances, doubtful, distances / camera.fx, *middles])
    return np.asarray(table[np.isfinite(depths) & (angles > 0)])


def _of_slices(values: FloatArray, slices: Slices, statistic: Callable[[FloatArray], float]) -> FloatArray:
    """A statistic, (M,), of the values, (N,), of each slice's points."""
    ends = slices.starts + slices.counts
    return np.array([statistic(values[start:end]) for start, end in zip(slices.starts, ends, strict=True)])


def _front(depths: FloatArray) -> float:
    """The depth of the nearer ones: where colour and depth do not fit, others are of what lies behind."""
    known = depths[np.isfinite(depths)]
    return float(np.percentile(known, 20)) if len(known) else np.nan


def _cover(image: RgbdFrame, color: str, silhouette: Mask, ribbon: Mask) -> tuple[FloatArray, FloatArray]:
    """How much of each pixel of a ribbon round the rope, (H, W), the rope covers, 0 to 1; and how unsure that is.

    A pixel on a blurred edge is a mixture, in linear light, of the rope in some shade and of what lies behind. The
    shades that explain the pixel leave a range, the middle of which is taken; what lies behind is the mean of the
    surroundings.
    """
    assert image.color is not None
    near = ndimage.binary_dilation(silhouette, np.ones((3, 3)), _BLUR)
    linear = LINEAR_OF_SRGB[image.color]
    behind = np.where(near, 0.0, 1.0)
    size = 4 * _BLUR + 5
    share = ndimage.uniform_filter(behind, size)
    surroundings = np.stack([ndimage.uniform_filter(linear[..., k] * behind, size) for k in range(3)], axis=2)
    here, back = linear[ribbon], surroundings[ribbon] / np.maximum(share[ribbon], 1e-9)[:, None]
    rope = LINEAR_OF_SRGB[np.array(parse_color(color))]
    shades = linear @ rope / max(float(rope @ rope), 1e-9)
    inner = np.clip(ndimage.maximum_filter(np.where(silhouette, shades, 0.0), 2 * _BLUR - 1)[ribbon], *_SHADES)
    parts, misfits = np.empty((2, len(_TURNED), len(here)))
    for part, misfit, turned in zip(parts, misfits, _TURNED, strict=True):
        step = (turned * inner)[:, None] * rope - back
        part[:] = np.clip(np.sum((here - back) * step, axis=1) / np.maximum(np.sum(step**2, axis=1), 1e-9), -0.2, 1.0)
        misfit[:] = np.sum((here - back - part[:, None] * step) ** 2, axis=1)
    explains = misfits <= misfits.min(axis=0) + _NOISE
    least, most = np.where(explains, parts, np.inf).min(axis=0), np.where(explains, parts, -np.inf).max(axis=0)
    # Before nothing at all there is nothing to mix with.
    covered = np.where(back.max(axis=1) > _BLACK, (least + most) / 2, most)
    cover = np.zeros(ribbon.shape)
    unsure = np.zeros(ribbon.shape)
    cover[ribbon] = np.where(share[ribbon] > 0, covered, silhouette[ribbon])
    unsure[ribbon] = (most - least) / np.sqrt(12)
    # Two pixels inside the outline, only the rope is seen.
    inside = ndimage.binary_erosion(silhouette, np.ones((3, 3)), 2) & ribbon
    cover[inside], unsure[inside] = 1.0, 0.0
    return cover, unsure
