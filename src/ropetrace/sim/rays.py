"""Where a ray from the camera meets a capsule or a box: exact, in float64.

Rays start at the origin and run along ``(dx, dy, 1)``, so that the parameter along the ray is the planar depth. A
primitive is a tuple of floats, which a compiler keeps in registers; a ray that misses has depth 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ropetrace.sim.scene import NEAR


@njit(cache=True, nogil=True, error_model="numpy")
def capsule_shape(start: Any, end: Any, radius: float) -> Any:
    """What `capsule_hit` needs of a capsule: start, axis, its length squared, and the terms free of the ray."""
    ax, ay, az = start[0], start[1], start[2]
    ux, uy, uz = end[0] - ax, end[1] - ay, end[2] - az
    length2 = ux * ux + uy * uy + uz * uz
    # The camera is the origin, so the vector from the start to it is minus the start.
    along_origin = -(ux * ax + uy * ay + uz * az)
    a2 = ax * ax + ay * ay + az * az
    constant = length2 * a2 - along_origin * along_origin - radius * radius * length2
    return ax, ay, az, ux, uy, uz, length2, along_origin, constant, radius


@njit(cache=True, nogil=True, error_model="numpy")
def capsule_hit(shape: Any, dx: float, dy: float) -> Any:
    """Depth where the ray enters the capsule (0: it misses), and the place on the axis abreast of it, 0 to 1."""
    ax, ay, az, ux, uy, uz, length2, along_origin, constant, r = shape
    ray2 = dx * dx + dy * dy + 1.0
    along_ray = ux * dx + uy * dy + uz
    ray_origin = -(dx * ax + dy * ay + az)
    a = length2 * ray2 - along_ray * along_ray
    b = length2 * ray_origin - along_origin * along_ray
    # The square of the distance from the ray's line to the axis' line decides first: most pixels end here.
    root = b * b - a * constant
    if length2 > 0 and a > 1e-15 * length2:
        if root < 0:
            return 0.0, 0.0
        z = (-b - np.sqrt(root)) / a
        foot = (along_origin + z * along_ray) / length2
    else:
        z, foot = 0.0, (0.0 if along_ray >= 0 else 1.0)
    if foot <= 0.0 or foot >= 1.0:
        foot = 0.0 if foot <= 0.0 else 1.0
        ox, oy, oz = -ax - foot * ux, -ay - foot * uy, -az - foot * uz
        half = dx * ox + dy * oy + oz
        root = half * half - ray2 * (ox * ox + oy * oy + oz * oz - r * r)
        if root < 0:
            return 0.0, 0.0
        z = (-half - np.sqrt(root)) / ray2
    if z <= NEAR:
        return 0.0, 0.0
    return z, foot


@njit(cache=True, nogil=True, error_model="numpy")
def capsule_cosine(shape: Any, dx: float, dy: float, z: float, foot: float) -> float:
    """Cosine between the surface's normal and the ray, at a hit."""
    ax, ay, az, ux, uy, uz, _, _, _, r = shape
    nx, ny, nz = z * dx - ax - foot * ux, z * dy - ay - foot * uy, z - az - foot * uz
    cosine = -(nx * dx + ny * dy + nz) / (r * np.sqrt(dx * dx + dy * dy + 1.0))
    return min(max(cosine, 0.0), 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def box_shape(center: Any, rotation: Any, half_size: Any) -> Any:
    """What `box_hit` needs of a box: its axes (columns of the rotation), the camera in its frame, its half sizes."""
    camera = [0.0, 0.0, 0.0]
    for axis in range(3):
        for k in range(3):
            camera[axis] -= rotation[k, axis] * center[k]
    x = (rotation[0, 0], rotation[1, 0], rotation[2, 0], camera[0], half_size[0])
    y = (rotation[0, 1], rotation[1, 1], rotation[2, 1], camera[1], half_size[1])
    z = (rotation[0, 2], rotation[1, 2], rotation[2, 2], camera[2], half_size[2])
    return x, y, z


@njit(cache=True, nogil=True, error_model="numpy")
def box_hit(shape: Any, dx: float, dy: float) -> Any:
    """Depth where the ray enters the box (0: it misses), and the cosine between the face's normal and the ray."""
    entry, leave, facing = -np.inf, np.inf, 0.0
    for rx, ry, rz, origin, half in shape:
        step = rx * dx + ry * dy + rz
        if step == 0.0:
            if abs(origin) > half:
                return 0.0, 0.0
            continue
        side = half if step > 0 else -half
        first = (-side - origin) / step
        last = (side - origin) / step
        if first > entry:
            entry, facing = first, abs(step)
        leave = min(leave, last)
    if entry > leave or entry <= NEAR:
        return 0.0, 0.0
    return entry, facing / np.sqrt(dx * dx + dy * dy + 1.0)
