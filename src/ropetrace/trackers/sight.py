"""What a depth image says of places where a rope may be: hidden by something nearer, or free.

A cloud has no image: there nothing is known to be hidden, and nothing to be free.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ropetrace.types import FloatArray, Frame, RgbdFrame

_LOOK = 4.0
"""How far beyond an end something nearer is looked for, diameters: sensors lose the depth next to an edge."""

_EDGE = 1.0
"""An end this close to the image's edge, in diameters, may be cut off by it."""

_NEARER = 0.01
"""What hides a rope is nearer to the camera by a diameter and this, metres."""

_SHADOW = 6
"""A pixel without depth that has something nearer this close, in pixels, may be its shadow."""

_FARTHEST_PIXELS, _PIXEL_STEP = 80, 4
"""How far from a free place another is looked for, and in which steps."""

_WAYS = 16
"""Directions that are tried."""


_BEHIND, _PAST, _FREE = 0, 1, 2
"""What places are looked for: behind something, before something, or where a rope would be seen."""


def is_clear(frame: Frame, end: FloatArray, before: FloatArray, diameter: float) -> bool:
    """Whether a strand that ends there ends before the camera's eyes: nothing nearer lies just beyond it.

    False at the image's edge, and where something nearer is: the strand may go on behind it. A cloud hides nothing that
    is known: there every end is clear.

    Parameters
    ----------
    frame : RgbdFrame or CloudFrame
        What the strand was seen in.
    end, before : (3,) float array
        The end, and a point of the strand before it, metres, camera frame.
    diameter : float
        Of the rope, metres.
    """
    if not isinstance(frame, RgbdFrame):
        return True
    return bool(_is_clear(frame.depth, float(frame.depth_unit_m), _lens(frame), end, before, diameter))


def is_behind(frame: Frame, places: FloatArray, diameter: float) -> NDArray[np.bool_]:
    """Which places, (M, 3), metres, lie behind something that the camera sees: none in a cloud."""
    return _marked(frame, places, diameter, _BEHIND)


def sees_past(frame: Frame, places: FloatArray, diameter: float) -> NDArray[np.bool_]:
    """At which places, (M, 3), metres, the camera sees something farther away for sure."""
    return _marked(frame, places, diameter, _PAST)


def looked_through(frame: Frame, places: FloatArray, diameter: float) -> NDArray[np.bool_]:
    """At which places, (M, 3), metres, the camera would see a rope, and sees something farther, or nothing."""
    return _marked(frame, places, diameter, _FREE)


def nearest_hidden(frame: Frame, places: FloatArray, diameter: float) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Where a rope that is not seen at these places may be instead: the nearest places that are hidden.

    Parameters
    ----------
    frame : RgbdFrame or CloudFrame
        Of a cloud nothing is known: no place moves.
    places : (M, 3) float array
        Metres, camera frame.
    diameter : float
        Of the rope, metres.

    Returns
    -------
    targets : (M, 3) float array
        At the same depth, metres.
    moved : (M,) bool array
        Which places are free, and have a hidden one near.
    """
    targets, moved = places.copy(), np.zeros(len(places), np.bool_)
    if isinstance(frame, RgbdFrame):
        _nearest_hidden(frame.depth, float(frame.depth_unit_m), _lens(frame), diameter, targets, moved)
    return targets, moved


def _marked(frame: Frame, places: FloatArray, diameter: float, kind: int) -> NDArray[np.bool_]:
    found = np.zeros(len(places), np.bool_)
    if isinstance(frame, RgbdFrame):
        _mark(frame.depth, float(frame.depth_unit_m), _lens(frame), np.ascontiguousarray(places), diameter, kind, found)
    return found


def _lens(frame: RgbdFrame) -> tuple[float, float, float, float]:
    camera = frame.intrinsics
    return camera.fx, camera.fy, camera.cx, camera.cy


@njit(cache=True, nogil=True)
def _is_clear(depth: Any, unit: float, lens: Any, end: Any, before: Any, diameter: float) -> bool:
    fx, fy, cx, cy = lens
    height, width = depth.shape
    outward, side = np.empty(3), np.empty(3)
    size = reach = 0.0
    for k in range(3):
        outward[k] = end[k] - before[k]
        size += outward[k] ** 2
        reach += end[k] ** 2
    size, reach = max(np.sqrt(size), 1e-9), max(np.sqrt(reach), 1e-9)
    for k in range(3):
        outward[k] /= size
    across = 0.0
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        side[k] = (outward[a] * end[b] - outward[b] * end[a]) / reach
        across += side[k] ** 2
    for k in range(3):
        side[k] /= max(np.sqrt(across), 1e-9)
    place = np.empty(3)
    for step in range(1, int(2 * _LOOK) + 1):
        ahead = 0.5 * step * diameter
        for way in range(-2, 3):
            aside = 0.35 * way * max(ahead, 0.7 * diameter)
            for k in range(3):
                place[k] = end[k] + ahead * outward[k] + aside * side[k]
            if place[2] <= 0.01:
                return False
            column, row = int(np.rint(fx * place[0] / place[2] + cx)), int(np.rint(fy * place[1] / place[2] + cy))
            if not (0 <= column < width and 0 <= row < height):
                if ahead <= _EDGE * diameter:
                    return False
                continue
            measured = depth[row, column] * unit
            if 0 < measured < min(place[2], end[2]) - diameter - _NEARER:
                return False
    return True


@njit(cache=True, nogil=True)
def _may_hide(depth: Any, unit: float, column: int, row: int, place: float, diameter: float) -> bool:
    """Whether a rope at this depth in this pixel, metres, would not be seen."""
    height, width = depth.shape
    if not (0 <= column < width and 0 <= row < height):
        return True
    measured = depth[row, column] * unit
    if measured > 0:
        return measured < place + diameter
    for i in range(max(row - _SHADOW, 0), min(row + _SHADOW + 1, height)):
        for j in range(max(column - _SHADOW, 0), min(column + _SHADOW + 1, width)):
            if 0 < depth[i, j] * unit < place - diameter:
                return True
    return False


@njit(cache=True, nogil=True)
def _mark(depth: Any, unit: float, lens: Any, places: Any, diameter: float, kind: int, found: Any) -> None:
    fx, fy, cx, cy = lens
    height, width = depth.shape
    for m in range(len(places)):
        x, y, z = places[m, 0], places[m, 1], max(places[m, 2], 0.01)
        column, row = int(np.rint(fx * x / z + cx)), int(np.rint(fy * y / z + cy))
        if kind == _FREE:
            found[m] = not _may_hide(depth, unit, column, row, z, diameter)
        elif 0 <= column < width and 0 <= row < height:
            measured = depth[row, column] * unit
            found[m] = 0 < measured < z - diameter if kind == _BEHIND else measured > z + diameter
        else:
            found[m] = False


@njit(cache=True, nogil=True)
def _nearest_hidden(depth: Any, unit: float, lens: Any, diameter: float, places: Any, moved: Any) -> None:
    fx, fy, cx, cy = lens
    for m in range(len(places)):
        z = places[m, 2]
        if z <= 0.01:
            continue
        u, v = fx * places[m, 0] / z + cx, fy * places[m, 1] / z + cy
        if _may_hide(depth, unit, int(np.rint(u)), int(np.rint(v)), z, diameter):
            continue
        for distance in range(_PIXEL_STEP, _FARTHEST_PIXELS + 1, _PIXEL_STEP):
            right = down = 0.0
            for way in range(_WAYS):
                c, s = np.cos(2 * np.pi * way / _WAYS), np.sin(2 * np.pi * way / _WAYS)
                if _may_hide(depth, unit, int(np.rint(u + distance * c)), int(np.rint(v + distance * s)), z, diameter):
                    right += c
                    down += s
            size = np.sqrt(right * right + down * down)
            if size > 1e-6:
                places[m, 0] = (u + distance * right / size - cx) * z / fx
                places[m, 1] = (v + distance * down / size - cy) * z / fy
                moved[m] = True
                break
