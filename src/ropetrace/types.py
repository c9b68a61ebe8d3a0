"""What flows between the rooms: frames in, estimates out. Frozen, checked where they are made.

Positions are metres in the camera's optical frame (x right, y down, z forward) unless a name says otherwise.
Quaternions are ``xyzw``. Stamps are integer nanoseconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ropetrace.errors import FrameError

MAX_IMAGE_PIXELS = 64_000_000
"""The largest image that is taken, in pixels: an 8K by 8K sensor. More is a damaged header or a bomb."""

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A pinhole camera. Pixel centres lie at whole coordinates, so the centre of the image is ((W-1)/2, (H-1)/2).

    Raises
    ------
    FrameError
        If a value is not finite, a size or focal length is not positive, or the principal point lies more than one
        image size outside the image.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1 or self.width * self.height > MAX_IMAGE_PIXELS:
            raise FrameError(
                f"intrinsics: the image size {self.width}x{self.height} is impossible "
                f"(1 to {MAX_IMAGE_PIXELS} pixels in all)"
            )
        for name in ("fx", "fy", "cx", "cy"):
            if not math.isfinite(getattr(self, name)):
                raise FrameError(f"intrinsics: {name} = {getattr(self, name)} is not a finite number")
        if self.fx <= 0 or self.fy <= 0:
            raise FrameError(f"intrinsics: the focal lengths fx = {self.fx}, fy = {self.fy} must be positive")
        if not (-self.width < self.cx < 2 * self.width and -self.height < self.cy < 2 * self.height):
            raise FrameError(
                f"intrinsics: the principal point ({self.cx}, {self.cy}) is far outside the "
                f"{self.width}x{self.height} image: they belong to another resolution"
            )


@dataclass(frozen=True, slots=True, eq=False)
class RgbdFrame:
    """A depth image with its camera, and the colour image that is registered to it, if there is one.

    Parameters
    ----------
    stamp_ns : int
        Time of the exposure, nanoseconds.
    depth : (H, W) uint16 or float32 array
        Planar depth in units of `depth_unit_m`. 0, negative, NaN and infinite depth mean "no point".
    depth_unit_m : float
        Metres in one unit of `depth`.
    intrinsics : Intrinsics
        The camera of both images.
    color : (H, W, 3) uint8 array, optional
        sRGB.

    Raises
    ------
    FrameError
        If shapes, types or the unit do not fit.
    """

    stamp_ns: int
    depth: NDArray[Any]
    depth_unit_m: float
    intrinsics: Intrinsics
    color: NDArray[np.uint8] | None = None

    def __post_init__(self) -> None:
        size = (self.intrinsics.height, self.intrinsics.width)
        if self.depth.ndim != 2 or self.depth.dtype not in (np.uint16, np.float32):
            raise FrameError(
                f"depth is {self.depth.dtype} of shape {self.depth.shape}: expected an (H, W) image, uint16 or float32"
            )
        if self.depth.shape != size:
            raise FrameError(
                f"depth is {self.depth.shape[1]}x{self.depth.shape[0]}, its intrinsics are for {size[1]}x{size[0]}"
            )
        if not (math.isfinite(self.depth_unit_m) and self.depth_unit_m > 0):
            raise FrameError(f"depth_unit_m = {self.depth_unit_m} must be a positive number of metres")
        if self.color is not None:
            if self.color.ndim != 3 or self.color.shape[2] != 3 or self.color.dtype != np.uint8:
                raise FrameError(
                    f"colour is {self.color.dtype} of shape {self.color.shape}: expected an (H, W, 3) image of uint8"
                )
            if self.color.shape[:2] != size:
                raise FrameError(
                    f"colour is {self.color.shape[1]}x{self.color.shape[0]} but depth is {size[1]}x{size[0]}: "
                    "record depth that is aligned (registered) to colour"
                )


@dataclass(frozen=True, slots=True, eq=False)
class CloudFrame:
    """A point cloud in the camera's optical frame.

    Parameters
    ----------
    stamp_ns : int
        Time of the exposure, nanoseconds.
    points : (N, 3) float array
        Metres. A point with a coordinate that is not finite is no point.
    colors : (N, 3) uint8 array, optional
        sRGB.

    Raises
    ------
    FrameError
        If the shapes or types do not fit.
    """

    stamp_ns: int
    points: NDArray[Any]
    colors: NDArray[np.uint8] | None = None

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3 or self.points.dtype.kind != "f":
            raise FrameError(
                f"points are {self.points.dtype} of shape {self.points.shape}: expected (N, 3) floating point"
            )
        if self.colors is not None and (self.colors.shape != self.points.shape or self.colors.dtype != np.uint8):
            raise FrameError(
                f"point colours are {self.colors.dtype} of shape {self.colors.shape}: "
                f"expected uint8 of shape {self.points.shape}"
            )


@dataclass(frozen=True, slots=True)
class BadFrame:
    """A frame that its source could not decode: an event of the stream, not its end."""

    stamp_ns: int
    reason: str


Frame = RgbdFrame | CloudFrame
"""What a tracker takes."""


Event = Frame | BadFrame
"""What a recording yields."""


def colors_of(frame: Frame) -> NDArray[np.uint8] | None:
    """The colours of an image, (H, W, 3), or of a cloud, (N, 3), if it has any."""
    return frame.colors if isinstance(frame, CloudFrame) else frame.color


def lacks_color(frame: Frame) -> bool:
    """Whether there is nothing for a colour gate to look at."""
    return colors_of(frame) is None


def moved(points: FloatArray, target_from_source: FloatArray) -> FloatArray:
    """Points, (N, 3), in another frame, by a (4, 4) rigid transform."""
    return points @ target_from_source[:3, :3].T + target_from_source[:3, 3]


class Status(StrEnum):
    """How far an estimate can be trusted."""

    OK = "ok"
    DEGRADED = "degraded"
    LOST = "lost"


@dataclass(frozen=True, slots=True, eq=False)
class Waypoints:
    """The centreline, sampled at equal arc length from its start to its end.

    Parameters
    ----------
    positions : (W, 3) float array
        Metres.
    quaternions : (W, 4) float array
        Orientation of the frame at each waypoint, ``xyzw``: its X axis points along the rope.
    arc_length : (W,) float array
        Metres from the first waypoint.
    """

    positions: FloatArray
    quaternions: FloatArray
    arc_length: FloatArray

    def __post_init__(self) -> None:
        count = len(self.positions)
        if self.positions.shape != (count, 3) or self.quaternions.shape != (count, 4):
            raise ValueError(f"waypoints: shapes {self.positions.shape}, {self.quaternions.shape} do not fit")
        if self.arc_length.shape != (count,):
            raise ValueError(f"waypoints: arc_length has shape {self.arc_length.shape}, expected ({count},)")

    def __len__(self) -> int:
        return len(self.positions)

    @classmethod
    def none(cls) -> Waypoints:
        """No waypoints at all: nothing is invented when nothing is seen."""
        return cls(np.empty((0, 3)), np.empty((0, 4)), np.empty(0))

    @property
    def length(self) -> float:
        """Length of the centreline, metres; 0 where there is none."""
        return float(self.arc_length[-1]) if len(self.arc_length) else 0.0

    def transformed(self, target_from_source: FloatArray) -> Waypoints:
        """The same waypoints in another frame.

        Parameters
        ----------
        target_from_source : (4, 4) float array
            Rigid transform.
        """
        from scipy.spatial.transform import Rotation

        if not len(self):
            return self
        rotation = Rotation.from_matrix(target_from_source[:3, :3])
        return Waypoints(
            moved(self.positions, target_from_source),
            np.asarray((rotation * Rotation.from_quat(self.quaternions)).as_quat()),
            self.arc_length,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """How waypoints move: arrays of (W, 3), a row for each waypoint, in the frame of the waypoints.

    Parameters
    ----------
    velocities : (W, 3) float array
        m/s, of the points of the rope that the waypoints are: what moves along the rope counts.
    accelerations : (W, 3) float array
        m/s^2.
    position_sigma, velocity_sigma, acceleration_sigma : (W, 3) float array
        Standard deviations of the waypoints' positions, velocities and accelerations along the axes of the frame.
    """

    velocities: FloatArray
    accelerations: FloatArray
    position_sigma: FloatArray
    velocity_sigma: FloatArray
    acceleration_sigma: FloatArray

    def __post_init__(self) -> None:
        shapes = {getattr(self, item.name).shape for item in fields(self)}
        if len(shapes) > 1 or self.velocities.ndim != 2 or self.velocities.shape[1] != 3:
            raise ValueError(f"motion: shapes {sorted(shapes)} do not fit, expected (W, 3)")

    def __len__(self) -> int:
        return len(self.velocities)

    def rotated(self, target_from_source: FloatArray) -> Motion:
        """The same motion in another frame that does not move, by a (4, 4) rigid transform."""
        turn = target_from_source[:3, :3]

        def spread(sigma: FloatArray) -> FloatArray:
            return np.asarray(np.sqrt(sigma**2 @ (turn**2).T))

        return Motion(
            self.velocities @ turn.T,
            self.accelerations @ turn.T,
            spread(self.position_sigma),
            spread(self.velocity_sigma),
            spread(self.acceleration_sigma),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """What a tracker says of one frame.

    Parameters
    ----------
    stamp_ns : int
        The frame's stamp.
    status : Status
        `LOST` has no nodes and no waypoints. `DEGRADED` has them, and `reasons` say what to mistrust.
    reasons : tuple of str
        Why the status is not `OK`; empty if it is.
    nodes : (M, 3) float array
        Points on the rope's axis in order along the rope, one a slice, metres.
    waypoints : Waypoints
        The centreline.
    point_count : int
        Points of the frame that the segmentation took for the rope.
    point_stride : int
        1 where all of them were used; k where the cap on points kept every k-th.
    motion : Motion, optional
        Of the waypoints; None where it is not known, as in the first frame.
    ahead_ns : int
        The waypoints and their motion are predicted for this long after the stamp, nanoseconds; nodes never are.
    seen : (W,) bool array, optional
        Which waypoints the camera saw in this frame; None where the method does not tell.
    position_sigma : (W,) float array, optional
        Standard deviation of each waypoint's position, the same in all directions, metres, at the stamp, as the
        tracker judges it; None where it does not tell. `Motion` has that of its filter.
    rope : int
        Which rope, 0 for the first.

    Raises
    ------
    ValueError
        If the arrays of a waypoint do not fit the waypoints, a `position_sigma` is no finite length, or `rope` is
        negative.
    """

    stamp_ns: int
    status: Status
    reasons: tuple[str, ...] = ()
    nodes: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    waypoints: Waypoints = field(default_factory=Waypoints.none)
    point_count: int = 0
    point_stride: int = 1
    motion: Motion | None = None
    ahead_ns: int = 0
    seen: NDArray[np.bool_] | None = None
    position_sigma: FloatArray | None = None
    rope: int = 0

    def __post_init__(self) -> None:
        count = len(self.waypoints)
        if self.motion is not None and len(self.motion) != count:
            raise ValueError(f"estimate: {count} waypoints, but the motion of {len(self.motion)}")
        if self.seen is not None and (self.seen.shape != (count,) or self.seen.dtype != np.bool_):
            raise ValueError(
                f"estimate: seen is {self.seen.dtype} of shape {self.seen.shape}: expected bool of shape ({count},)"
            )
        if self.position_sigma is not None:
            sigma = self.position_sigma
            if sigma.shape != (count,) or sigma.dtype != np.float64:
                raise ValueError(
                    f"estimate: position_sigma is {sigma.dtype} of shape {sigma.shape}: "
                    f"expected float64 of shape ({count},)"
                )
            if not (np.isfinite(sigma) & (sigma >= 0)).all():
                raise ValueError("estimate: a position_sigma is negative or not a finite number")
        if self.rope < 0:
            raise ValueError(f"estimate: rope = {self.rope} is negative")

    @classmethod
    def lost(cls, stamp_ns: int, reason: str, point_count: int = 0, rope: int = 0) -> Estimate:
        """Nothing to report, and why."""
        return cls(stamp_ns, Status.LOST, (reason,), point_count=point_count, rope=rope)


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """The points behind an estimate.

    Parameters
    ----------
    points : (N, 3) float array
        Metres.
    node : (N,) int32 array
        Index of each point's node in `Estimate.nodes`; -1 for none.
    """

    points: FloatArray
    node: NDArray[np.int32]

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3 or self.node.shape != self.points.shape[:1]:
            raise ValueError(f"cloud: shapes {self.points.shape}, {self.node.shape} do not fit")


@dataclass(frozen=True, slots=True, eq=False)
class Slices:
    """The parts of a cloud, in no particular order.

    Parameters
    ----------
    centroids : (M, 3) float array
        Mean of each part's points, metres (equation 2).
    covariances : (M, 3, 3) float array
        Covariance of each part's points, divided by their count, m^2 (equation 3 takes its trace).
    counts : (M,) int array
        Points of each part.
    capped : bool
        Whether the cap on parts stopped the slicing before the threshold was reached.
    starts : (M,) int array
        Where each part begins in the sorted points: part m is ``points[:, starts[m]:starts[m] + counts[m]]``.
    """

    centroids: FloatArray
    covariances: FloatArray
    counts: NDArray[np.int64]
    capped: bool
    starts: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.counts)

    def kept(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> Slices:
        """Only the parts where the (M,) mask is true, or those of the given indices, in their order."""
        return Slices(
            self.centroids[keep],
            self.covariances[keep],
            self.counts[keep],
            self.capped,
            self.starts[keep],
        )


def coordinate_buffer(count: int) -> FloatArray:
    """Room for `count` points as three rows: (3, `count` or a little more), not initialised.

    Rows that lie a whole number of memory pages apart would compete for the same places of the processor's cache, and
    image sizes make just such numbers: the rows are kept off that grid.
    """
    return np.empty((3, -(-count // 512) * 512 + 136))
