"""Which nodes of a chain the camera can see: behind the measured depth, or behind the rope itself."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ropetrace.types import FloatArray, Intrinsics, RgbdFrame

_UNMEASURED = 0.02
"""A node where no depth is measured counts as this far behind the surface, metres (CDCPD)."""

_NEAREST = 0.01
"""Nodes nearer to the camera's plane than this are not in the image, metres."""


def hidden_by_chain(nodes: FloatArray, width: float) -> NDArray[np.bool_]:
    """Which nodes another stretch of the chain covers in the camera's view.

    TrackDLO paints the edges from near to far, `width` wide: a node is covered whose place is painted before its own
    edges are. Here the width is in metres at the edge, not in pixels, and the test is by the angle between the views,
    so that clouds without an image have it too. Edges within a width along the chain do not cover a node.

    Parameters
    ----------
    nodes : (M, 3) float array
        Along the rope, metres, camera frame.
    width : float
        Of the painted edges, metres.

    Returns
    -------
    (M,) bool array
    """
    hidden = np.zeros(len(nodes), np.bool_)
    _hidden_by_chain(np.ascontiguousarray(nodes), width, hidden)
    return hidden


def depth_behind(nodes: FloatArray, frame: RgbdFrame) -> FloatArray:
    """How far each node lies behind the depth that is measured in its pixel, (M,), metres: max(0, z - depth).

    0.02 m where no depth is measured or the node is outside the image.

    Parameters
    ----------
    nodes : (M, 3) float array
        Metres, camera frame.
    frame : RgbdFrame
        The measured depth.
    """
    columns, rows = _pixels(nodes, frame.intrinsics)
    inside = (nodes[:, 2] > _NEAREST) & (columns >= 0) & (columns < frame.depth.shape[1])
    inside &= (rows >= 0) & (rows < frame.depth.shape[0])
    behind = np.full(len(nodes), _UNMEASURED)
    measured = frame.depth[rows[inside].astype(int), columns[inside].astype(int)] * float(frame.depth_unit_m)
    gap = np.maximum(nodes[inside, 2] - measured, 0)
    behind[inside] = np.where(np.isfinite(measured) & (measured > 0), gap, _UNMEASURED)
    return behind


def off_mask(nodes: FloatArray, points: FloatArray, camera: Intrinsics) -> FloatArray:
    """How far each node's pixel lies from the rope's, (M,), 0 on them to 1 at the image's farthest corner.

    CDCPD has a distance transform of the mask, scaled to its largest value in the image: here that is looked for in the
    four corners alone.

    Parameters
    ----------
    nodes : (M, 3) float array
        Metres, camera frame.
    points : (N, 3) float array
        The rope's, N >= 1, metres, camera frame.
    camera : Intrinsics
        Of the image.
    """
    corners = np.array([[u, v] for u in (0.0, camera.width - 1) for v in (0.0, camera.height - 1)])
    mask = np.stack(_pixels(points, camera), axis=1)
    places = np.stack(_pixels(nodes, camera), axis=1)
    distances = _nearest_pixels(np.concatenate([corners, places]), mask)
    return np.minimum(distances[4:] / max(float(distances[:4].max()), 1.0), 1.0)


def _pixels(points: FloatArray, camera: Intrinsics) -> tuple[FloatArray, FloatArray]:
    """Columns and rows of the pixels that points fall in, as floats; far outside where they are behind the camera."""
    z = np.maximum(points[:, 2], _NEAREST)
    return np.round(camera.fx * points[:, 0] / z + camera.cx), np.round(camera.fy * points[:, 1] / z + camera.cy)


@njit(cache=True, nogil=True)
def _nearest_pixels(places: Any, mask: Any) -> Any:
    distances = np.empty(len(places))
    for i in range(len(places)):
        least = np.inf
        for j in range(len(mask)):
            least = min(least, (mask[j, 0] - places[i, 0]) ** 2 + (mask[j, 1] - places[i, 1]) ** 2)
        distances[i] = np.sqrt(least)
    return distances


@njit(cache=True, nogil=True, error_model="numpy")
def _hidden_by_chain(nodes: Any, width: float, hidden: Any) -> None:
    count = len(nodes)
    arc = np.zeros(count)
    ranges = np.empty(count)
    for m in range(count):
        ranges[m] = np.sqrt(np.sum(nodes[m] ** 2))
        if m > 0:
            arc[m] = arc[m - 1] + np.sqrt(np.sum((nodes[m] - nodes[m - 1]) ** 2))
    for m in range(count):
        for j in range(count - 1):
            if arc[j + 1] > arc[m] - width and arc[j] < arc[m] + width:
                continue
            if (ranges[j] + ranges[j + 1]) / 2 >= ranges[m]:
                continue
            # The nearest place on the edge to the node's line of sight, both seen from the camera.
            square = product = 0.0
            for axis in range(3):
                view = nodes[m, axis] / ranges[m]
                start = nodes[j, axis] / ranges[j]
                along = nodes[j + 1, axis] / ranges[j + 1] - start
                square += along * along
                product += along * (view - start)
            part = min(max(product / square, 0.0), 1.0) if square > 0.0 else 0.0
            apart = 0.0
            for axis in range(3):
                start = nodes[j, axis] / ranges[j]
                along = nodes[j + 1, axis] / ranges[j + 1] - start
                apart += (nodes[m, axis] / ranges[m] - start - part * along) ** 2
            if np.sqrt(apart) * ranges[j] < width / 2:
                hidden[m] = True
                break
