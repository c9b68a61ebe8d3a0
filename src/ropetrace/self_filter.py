"""The robot taken out of its own camera's image, by where its joints say that it is.

Behind a rope that a robot works on there is often the robot. Where the colour gate lets nothing of it through, it
still bleeds into the rope's edges: such pixels have the rope's colour and the robot's depth, and are known by that.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numba import njit

from ropetrace.types import FloatArray, RgbdFrame

MARGIN = 0.015
"""How far from the links' shapes pixels are still taken for the robot's, metres: the shapes are rough."""

_NEAR = 0.05
"""A link nearer to the camera's plane than this may be anywhere in the image, metres."""


def without_robot(
    frame: RgbdFrame, starts: FloatArray, ends: FloatArray, radii: FloatArray, margin: float = MARGIN
) -> RgbdFrame:
    """The frame without depth where the robot is.

    Parameters
    ----------
    frame : RgbdFrame
        Not changed.
    starts, ends : (K, 3) float array
        Ends of the axes of the capsules that the links look like, metres, camera frame, at the frame's stamp: see
        `control.arm.Arm.capsules`.
    radii : (K,) float array
        Metres.
    margin : float
        Metres. Less than the distance from the tool to what it holds.
    """
    depth = np.array(frame.depth)
    lens = frame.intrinsics
    _clear(
        depth,
        frame.depth_unit_m,
        (lens.fx, lens.fy, lens.cx, lens.cy),
        np.ascontiguousarray(starts, dtype=float),
        np.ascontiguousarray(ends, dtype=float),
        np.asarray(radii, dtype=float) + margin,
    )
    return replace(frame, depth=depth)


@njit(cache=True, nogil=True)
def _clear(depth: Any, unit: float, lens: Any, starts: Any, ends: Any, radii: Any) -> None:
    fx, fy, cx, cy = lens
    rows, columns = depth.shape
    axis = np.empty(3)
    for k in range(len(radii)):
        left, right, top, bottom = _box(starts[k], ends[k], radii[k], lens, columns, rows)
        size = 0.0
        for c in range(3):
            axis[c] = ends[k, c] - starts[k, c]
            size += axis[c] ** 2
        for row in range(top, bottom):
            for column in range(left, right):
                z = depth[row, column] * unit
                if not 0 < z < np.inf:
                    continue
                x, y = (column - cx) / fx * z - starts[k, 0], (row - cy) / fy * z - starts[k, 1]
                away = z - starts[k, 2]
                along = x * axis[0] + y * axis[1] + away * axis[2]
                part = min(max(along / size, 0.0), 1.0) if size > 0 else 0.0
                x -= part * axis[0]
                y -= part * axis[1]
                away -= part * axis[2]
                if x * x + y * y + away * away <= radii[k] * radii[k]:
                    depth[row, column] = 0


@njit(cache=True, nogil=True)
def _box(start: Any, end: Any, radius: float, lens: Any, columns: int, rows: int) -> tuple[int, int, int, int]:
    """The pixels that a capsule may cover: left, right, top, bottom."""
    fx, fy, cx, cy = lens
    near = min(start[2], end[2]) - radius
    if near < _NEAR:
        if max(start[2], end[2]) + radius < 0:
            return 0, 0, 0, 0
        return 0, columns, 0, rows
    far = max(start[2], end[2]) + radius
    low_x, high_x = min(start[0], end[0]) - radius, max(start[0], end[0]) + radius
    low_y, high_y = min(start[1], end[1]) - radius, max(start[1], end[1]) + radius
    left = fx * low_x / (near if low_x < 0 else far) + cx
    right = fx * high_x / (far if high_x < 0 else near) + cx
    top = fy * low_y / (near if low_y < 0 else far) + cy
    bottom = fy * high_y / (far if high_y < 0 else near) + cy
    return (
        int(min(max(left, 0.0), columns)),
        int(min(max(right + 2, 0.0), columns)),
        int(min(max(top, 0.0), rows)),
        int(min(max(bottom + 2, 0.0), rows)),
    )
