"""What a simulated camera looks at: capsules, boxes and planes, and poses to see them from. Metres.

A scene is given in the world frame; a camera's pose is ``world_from_camera``, a (4, 4) rigid transform, whose camera
frame is the optical one (x right, y down, z forward). Without a pose the two frames are one.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ropetrace.errors import ConfigError
from ropetrace.types import FloatArray, moved

NEAR = 0.01
"""Surfaces nearer to the camera's plane than this are not seen, metres."""

FAR = 1000.0
"""Surfaces farther from the camera's plane than this are not seen, metres: an endless floor ends here."""

Color = tuple[int, int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Capsules:
    """Cylinders with round ends; a sphere is a capsule whose two ends coincide.

    Parameters
    ----------
    starts, ends : (C, 3) float array
        Ends of the axes, metres.
    radii : (C,) float array
        Metres.
    colors : (C, 3) uint8 array
        sRGB in full light.
    labels : (C,) int16 array
        What the label image shows for each.
    """

    starts: FloatArray
    ends: FloatArray
    radii: FloatArray
    colors: NDArray[np.uint8]
    labels: NDArray[np.int16]

    def __len__(self) -> int:
        return len(self.radii)

    @classmethod
    def between(
        cls,
        starts: FloatArray,
        ends: FloatArray,
        radius: float | FloatArray,
        color: Color = (200, 40, 30),
        label: int = 0,
    ) -> Capsules:
        """Capsules of one colour and label, and one radius or (C,) radii, from (C, 3) starts to (C, 3) ends."""
        count = len(starts)
        return cls(
            np.ascontiguousarray(starts, dtype=float),
            np.ascontiguousarray(ends, dtype=float),
            np.broadcast_to(np.asarray(radius, float), (count,)).copy(),
            np.tile(np.array(color, np.uint8), (count, 1)),
            np.full(count, label, np.int16),
        )

    @classmethod
    def along(cls, curve: FloatArray, radius: float, color: Color = (200, 40, 30), label: int = 0) -> Capsules:
        """A tube with round ends along a polyline of (K, 3) points."""
        return cls.between(curve[:-1], curve[1:], radius, color, label)

    @classmethod
    def sphere(
        cls, center: tuple[float, float, float], radius: float, color: Color = (200, 40, 30), label: int = 0
    ) -> Capsules:
        """One sphere."""
        point = np.array([center], float)
        return cls.between(point, point, radius, color, label)

    @classmethod
    def none(cls) -> Capsules:
        """No capsules."""
        return cls.along(np.zeros((1, 3)), 1.0)

    def __add__(self, other: Capsules) -> Capsules:
        return Capsules(
            np.concatenate([self.starts, other.starts]),
            np.concatenate([self.ends, other.ends]),
            np.concatenate([self.radii, other.radii]),
            np.concatenate([self.colors, other.colors]),
            np.concatenate([self.labels, other.labels]),
        )

    def transformed(self, target_from_source: FloatArray) -> Capsules:
        """The same capsules in another frame, by a (4, 4) rigid transform."""
        return Capsules(
            _moved(self.starts, target_from_source),
            _moved(self.ends, target_from_source),
            self.radii,
            self.colors,
            self.labels,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """Boxes in any orientation.

    Parameters
    ----------
    centers : (B, 3) float array
        Metres.
    rotations : (B, 3, 3) float array
        ``world_from_box``: the columns are the box's axes.
    half_sizes : (B, 3) float array
        Half the edges, metres.
    colors : (B, 3) uint8 array
        sRGB in full light.
    labels : (B,) int16 array
        What the label image shows for each.
    """

    centers: FloatArray
    rotations: FloatArray
    half_sizes: FloatArray
    colors: NDArray[np.uint8]
    labels: NDArray[np.int16]

    def __len__(self) -> int:
        return len(self.centers)

    @classmethod
    def one(
        cls,
        center: tuple[float, float, float],
        size: tuple[float, float, float],
        color: Color,
        label: int,
        rotation: FloatArray | None = None,
    ) -> Boxes:
        """One box of the given edges; axis-aligned without a (3, 3) rotation."""
        return cls(
            np.array([center], float),
            np.ascontiguousarray(np.eye(3) if rotation is None else rotation, dtype=float)[None],
            np.array([size], float) / 2,
            np.array([color], np.uint8),
            np.array([label], np.int16),
        )

    @classmethod
    def none(cls) -> Boxes:
        """No boxes."""
        return cls(
            np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty(0, np.int16)
        )

    def __add__(self, other: Boxes) -> Boxes:
        return Boxes(
            np.concatenate([self.centers, other.centers]),
            np.concatenate([self.rotations, other.rotations]),
            np.concatenate([self.half_sizes, other.half_sizes]),
            np.concatenate([self.colors, other.colors]),
            np.concatenate([self.labels, other.labels]),
        )

    def transformed(self, target_from_source: FloatArray) -> Boxes:
        """The same boxes in another frame, by a (4, 4) rigid transform."""
        return Boxes(
            _moved(self.centers, target_from_source),
            np.ascontiguousarray(target_from_source[:3, :3] @ self.rotations),
            self.half_sizes,
            self.colors,
            self.labels,
        )


@dataclass(frozen=True, slots=True)
class Plane:
    """An endless wall or floor, seen from both sides: the points x with ``normal . x = distance``.

    The normal may have any length but 0; the distance counts in its lengths.
    """

    normal: tuple[float, float, float]
    distance: float
    color: Color
    label: int

    def transformed(self, target_from_source: FloatArray) -> Plane:
        """The same plane in another frame, by a (4, 4) rigid transform."""
        normal = target_from_source[:3, :3] @ np.array(self.normal)
        return Plane(
            (float(normal[0]), float(normal[1]), float(normal[2])),
            float(self.distance + normal @ target_from_source[:3, 3]),
            self.color,
            self.label,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What the camera looks at. Solids are seen from outside only."""

    capsules: Capsules
    planes: tuple[Plane, ...] = ()
    boxes: Boxes = field(default_factory=Boxes.none)

    def transformed(self, target_from_source: FloatArray) -> Scene:
        """The same scene in another frame, by a (4, 4) rigid transform."""
        return Scene(
            self.capsules.transformed(target_from_source),
            tuple(plane.transformed(target_from_source) for plane in self.planes),
            self.boxes.transformed(target_from_source),
        )

    def seen_from(self, world_from_camera: FloatArray | None) -> Scene:
        """The scene in the frame of a camera; None is a camera at the world's origin that looks along its z."""
        return self if world_from_camera is None else self.transformed(inverse_pose(world_from_camera))


def inverse_pose(target_from_source: FloatArray) -> FloatArray:
    """``source_from_target`` of a (4, 4) rigid transform."""
    inverse = np.eye(4)
    inverse[:3, :3] = target_from_source[:3, :3].T
    inverse[:3, 3] = -inverse[:3, :3] @ target_from_source[:3, 3]
    return inverse


def looking_at(
    position: tuple[float, float, float],
    target: tuple[float, float, float],
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> FloatArray:
    """``world_from_camera``, (4, 4), of a camera that looks at a point, with `up` upwards in its image.

    Raises
    ------
    ConfigError
        If the target is the camera's own position or lies straight up or down of it.
    """
    forward = np.subtract(target, position).astype(float)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9 * max(1.0, float(np.linalg.norm(forward))):
        raise ConfigError(
            f"a camera at {position} cannot look at {target} with {up} upwards: "
            "choose a target elsewhere or another direction for up"
        )
    pose = np.eye(4)
    pose[:3, 2] = forward / np.linalg.norm(forward)
    pose[:3, 0] = right / np.linalg.norm(right)
    pose[:3, 1] = np.cross(pose[:3, 2], pose[:3, 0])
    pose[:3, 3] = position
    return pose


def check_camera_outside(scene: Scene, world_from_camera: FloatArray | None = None) -> None:
    """Refuse a camera inside a capsule or a box, or within `NEAR` of one, where it could not see the surface.

    Raises
    ------
    ConfigError
        The message names the first such primitive.
    """
    seen = scene.seen_from(world_from_camera)
    capsules, boxes = seen.capsules, seen.boxes
    axis = capsules.ends - capsules.starts
    along = -np.einsum("ij,ij->i", capsules.starts, axis) / np.maximum(np.einsum("ij,ij->i", axis, axis), 1e-300)
    nearest = capsules.starts + np.clip(along, 0, 1)[:, None] * axis
    gaps = np.linalg.norm(nearest, axis=1) - capsules.radii
    camera_box = np.einsum("bij,bi->bj", boxes.rotations, -boxes.centers)
    outside = np.abs(camera_box) - boxes.half_sizes
    box_gaps = np.where(
        (outside <= 0).all(axis=1), outside.max(axis=1, initial=-np.inf), np.linalg.norm(np.maximum(outside, 0), axis=1)
    )
    for kind, distances, labels in (("capsule", gaps, capsules.labels), ("box", box_gaps, boxes.labels)):
        close = np.flatnonzero(distances < NEAR)
        if len(close):
            index, gap = int(close[0]), float(distances[close[0]])
            place = f"{-gap * 1e3:.1f} mm inside" if gap < 0 else f"only {gap * 1e3:.1f} mm from"
            raise ConfigError(
                f"the camera is {place} {kind} {index} (label {labels[index]}): "
                f"move it at least {NEAR * 1e3:.0f} mm away from every surface"
            )


def _moved(points: FloatArray, target_from_source: FloatArray) -> FloatArray:
    return np.ascontiguousarray(moved(points, target_from_source))
