"""The frame that the rope gives the tool (equations 16 and 17), and the rotation to it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ropetrace.types import FloatArray

STEEP = 0.2
"""Sine of the angle between rope and view below which equation 16 is too ill-conditioned to be used alone."""


def waypoint_frame(
    tangent: FloatArray, camera_axis: FloatArray, tool: FloatArray, from_camera: bool = False
) -> FloatArray:
    """The frame of a waypoint, (3, 3), from its X axis and the camera's axis (equations 16 and 17, as unit vectors).

    With `from_camera` Y and Z are reversed. Where the rope points along the view the rule gives no frame: there the
    tool (3, 3) keeps what it has, turned onto the rope without twist, and in between the two are blended.
    """
    frame = np.empty((3, 3))
    frame_onto(np.array(tangent, float), np.array(camera_axis, float), from_camera, np.array(tool, float), frame)
    return frame


def rotation_vector(target: FloatArray, current: FloatArray) -> FloatArray:
    """The rotation that turns one frame (3, 3) into another, as axis times angle, (3,), rad, 0 to pi."""
    vector = np.empty(3)
    rotation_onto(np.array(target, float), np.array(current, float), vector)
    return vector


@njit(cache=True, nogil=True, error_model="numpy")
def frame_onto(tangent: Any, axis: Any, from_camera: bool, tool: Any, frame: Any) -> float:
    """Columns X, Y = X x Z_C, Z = X x Y, made unit vectors; returns the sine of the angle to the view."""
    sign = -1.0 if from_camera else 1.0
    along = sine = size = same = across = 0.0
    for k in range(3):
        along += tangent[k] * tangent[k]
    along = np.sqrt(along)
    for k in range(3):
        frame[k, 0] = tangent[k] / along if along > 0 else np.nan
        same += frame[k, 0] * tool[k, 0]
        across += frame[k, 0] * tool[k, 1]
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        frame[k, 1] = sign * (frame[a, 0] * axis[b] - frame[b, 0] * axis[a])
        sine += frame[k, 1] ** 2
    sine = np.sqrt(sine)
    if sine < STEEP:
        # The tool's Y turned by the smallest rotation from its X to the rope, times 1 + cosine so as not to divide.
        for k in range(3):
            a, b = (k + 1) % 3, (k + 2) % 3
            carried = tool[k, 1] - across * frame[k, 0] + tool[a, 2] * frame[b, 0] - tool[b, 2] * frame[a, 0]
            if same < -1 + 1e-6:
                carried = tool[k, 1] - across * frame[k, 0]
            frame[k, 2] = carried
            size += carried * carried
        for k in range(3):
            frame[k, 2] /= np.sqrt(size)
            frame[k, 1] += (STEEP - sine) * frame[k, 2]
    size = 0.0
    for k in range(3):
        size += frame[k, 1] ** 2
    size = np.sqrt(size)
    for k in range(3):
        # Rule and tool may oppose each other exactly: then the tool's.
        frame[k, 1] = frame[k, 2] if size < 1e-9 else frame[k, 1] / size
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        frame[k, 2] = frame[a, 0] * frame[b, 1] - frame[b, 0] * frame[a, 1]
    return sine


@njit(cache=True, nogil=True, error_model="numpy")
def rotation_onto(target: Any, current: Any, vector: Any) -> None:
    turn = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                turn[i, j] += target[i, k] * current[j, k]
    sine = 0.0
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        vector[k] = 0.5 * (turn[b, a] - turn[a, b])
        sine += vector[k] ** 2
    sine = np.sqrt(sine)
    cosine = 0.5 * (turn[0, 0] + turn[1, 1] + turn[2, 2] - 1.0)
    angle = np.arctan2(sine, cosine)
    if sine > 1e-9:
        for k in range(3):
            vector[k] *= angle / sine
        return
    if not cosine <= 0:
        return
    # Half a turn: the axis is the column of (turn + I) / 2 that is longest.
    most = 0
    for k in range(1, 3):
        if turn[k, k] > turn[most, most]:
            most = k
    size = np.sqrt(max(0.5 * (turn[most, most] + 1.0), 1e-12))
    for k in range(3):
        vector[k] = np.pi * 0.5 * (turn[k, most] + (1.0 if k == most else 0.0)) / size
