"""How much of a rope a camera can see: exact rays to points of its centreline, no pixel grid."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ropetrace.sim.rays import box_hit, box_shape, capsule_hit, capsule_shape
from ropetrace.sim.scene import FAR, NEAR, Scene, inverse_pose
from ropetrace.types import FloatArray, Intrinsics, moved

_OWN_STRETCH = 3.0
"""How far along the rope, in radii, the surface that a ray meets may be from the sample it was sent to."""


def visible_samples(
    scene: Scene,
    camera: Intrinsics,
    points: FloatArray,
    radius: float,
    label: int = 0,
    world_from_camera: FloatArray | None = None,
) -> NDArray[np.bool_]:
    """Which samples of a rope's centreline the camera sees.

    A sample is seen if it projects into the image, lies in front of the camera, and the first surface on the ray to it
    is the rope's own, of the stretch round the sample: its place along the rope is within three radii. A ray that
    meets clutter first, or another part of the rope, does not count; neither does one along a rope that points at the
    camera within about 18 degrees, where the surface in front belongs to a nearer part.

    Parameters
    ----------
    scene : Scene
        All that can be in the way, the rope itself among it.
    camera : Intrinsics
        The image that the samples must project into.
    points : (K, 3) float array
        Samples of the centreline in order along the rope, in the scene's frame, metres. They must lie inside the
        rope's capsules.
    radius : float
        The rope's, metres.
    label : int
        The label of the rope's capsules.
    world_from_camera : (4, 4) float array, optional
        The camera's pose; without one the scene and the points are in the camera's frame.

    Returns
    -------
    (K,) bool array
    """
    seen = scene.seen_from(world_from_camera)
    if world_from_camera is not None:
        points = moved(points, inverse_pose(world_from_camera))
    planes = np.array([[*plane.normal, plane.distance] for plane in seen.planes], float).reshape(-1, 4)
    return _visible(
        np.ascontiguousarray(points, dtype=float),
        float(radius),
        label,
        (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height),
        (seen.capsules.starts, seen.capsules.ends, seen.capsules.radii, seen.capsules.labels),
        (seen.boxes.centers, seen.boxes.rotations, seen.boxes.half_sizes),
        planes,
    )


def visible_fraction(
    scene: Scene,
    camera: Intrinsics,
    points: FloatArray,
    radius: float,
    label: int = 0,
    world_from_camera: FloatArray | None = None,
) -> float:
    """Share of the samples that `visible_samples` finds: of the rope's length, if they lie at equal arc lengths."""
    return float(visible_samples(scene, camera, points, radius, label, world_from_camera).mean())


@njit(cache=True, nogil=True, error_model="numpy")
def _visible(points: Any, radius: float, label: int, lens: Any, capsules: Any, boxes: Any, planes: Any) -> Any:
    fx, fy, cx, cy, width, height = lens
    starts, ends, radii, labels = capsules
    centers, rotations, half_sizes = boxes
    count = len(points)
    arc = np.zeros(count)
    for k in range(1, count):
        arc[k] = arc[k - 1] + np.sqrt(((points[k] - points[k - 1]) ** 2).sum())
    visible = np.zeros(count, np.bool_)
    for sample in range(count):
        z = points[sample, 2]
        if z <= NEAR:
            continue
        dx, dy = points[sample, 0] / z, points[sample, 1] / z
        column, row = dx * fx + cx, dy * fy + cy
        if not (-0.5 <= column < width - 0.5 and -0.5 <= row < height - 0.5):
            continue
        first = FAR
        own = False
        for index in range(len(radii)):
            hit, _ = capsule_hit(capsule_shape(starts[index], ends[index], radii[index]), dx, dy)
            if 0.0 < hit < first:
                first, own = hit, labels[index] == label
        for index in range(len(centers)):
            hit, _ = box_hit(box_shape(centers[index], rotations[index], half_sizes[index]), dx, dy)
            if 0.0 < hit < first:
                first, own = hit, False
        for index in range(len(planes)):
            hit = planes[index, 3] / (planes[index, 0] * dx + planes[index, 1] * dy + planes[index, 2])
            if NEAR < hit < first:
                first, own = hit, False
        if own:
            place = _place_along(points, arc, first * dx, first * dy, first)
            visible[sample] = abs(place - arc[sample]) <= _OWN_STRETCH * radius
    return visible


@njit(cache=True, nogil=True, error_model="numpy")
def _place_along(points: Any, arc: Any, x: float, y: float, z: float) -> float:
    """Arc length of the place of a polyline that is nearest to a point."""
    best, place = np.inf, 0.0
    for k in range(max(len(points) - 1, 1)):
        after = min(k + 1, len(points) - 1)
        ux, uy, uz = (
            points[after, 0] - points[k, 0],
            points[after, 1] - points[k, 1],
            points[after, 2] - points[k, 2],
        )
        px, py, pz = x - points[k, 0], y - points[k, 1], z - points[k, 2]
        length2 = ux * ux + uy * uy + uz * uz
        part = min(max((ux * px + uy * py + uz * pz) / length2, 0.0), 1.0) if length2 > 0 else 0.0
        distance2 = (px - part * ux) ** 2 + (py - part * uy) ** 2 + (pz - part * uz) ** 2
        if distance2 < best:
            best, place = distance2, arc[k] + part * (arc[after] - arc[k])
    return place
