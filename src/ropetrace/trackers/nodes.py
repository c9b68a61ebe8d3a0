"""Trackers that move a fixed number of nodes from frame to frame: their start, their loss, and what they report.

They start from the slicing tracker's centreline, or from given nodes, and know no length beforehand. What they fit is
the visible surface, which lies before the axis by pi r / 4 in the mean, as the half of a round rope that a camera sees
from afar: they keep their nodes on the surface and report them this much farther away, across the rope.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from ropetrace.centerline import SHORTEST_STEP, make_waypoints
from ropetrace.config import RopeConfig
from ropetrace.errors import ConfigError
from ropetrace.ordering import runs_backwards
from ropetrace.trackers.base import Lap, Mask, no_lap
from ropetrace.trackers.clouds import (
    arc_lengths,
    distances_to_chain,
    evenly_along,
    nearest_distances,
    nearest_nodes,
    voxel_grid,
)
from ropetrace.trackers.doubts import KINK, Doubts, sharpest_turn
from ropetrace.trackers.registration import Fit, RegistrationError
from ropetrace.trackers.slicing import SlicingTracker, thinned
from ropetrace.types import BadFrame, Cloud, Estimate, FloatArray, Frame, Status, Waypoints

RESTART_AFTER = 3
"""After this many lost frames in a row the nodes are forgotten: the next frame starts from the slicing tracker."""

_MOST_VOXELS = 4000
"""Of more, every k-th is used."""

_FEW = 20
"""Fewer points than this make no rope, however they lie."""

_NEAR = 3.0
"""A node with no point this close, in diameters, has lost the rope;"""

_FEWEST_NEAR = 0.1
"""with fewer of the nodes near points than this share, the rope is lost."""

_ASTRAY = 2.0
"""Where half of the points lie farther than this from the curve, in diameters, it is lost."""

_UNSETTLED = 0.5
"""Nodes that still move by more than this in the last iteration, in diameters, have not found the rope."""

_HIDDEN = 1.5
"""A node with no point this close is hidden, and a point this far from the curve is not explained: diameters."""

_UNEXPLAINED = 0.1
"""A larger share of points that the curve does not explain is worth telling."""

_LENGTH_CHANGE = 0.15
"""A rope whose length differs by more than this share from what it was at the start is partly hidden, or not alone."""

_CROWDED = 0.6
"""Nodes whose distances, relative to those at the start, are less than this part of the rope's mean have crowded."""

_CROWD = 5
"""Distances in a row that are looked at for that."""


class NodeTracker(ABC):
    """Keeps nodes on one rope from frame to frame. A method says how they move: `_fit`.

    Parameters
    ----------
    config : RopeConfig
        Settings; what is None is derived from the diameter.
    count : int
        Nodes.
    voxel : float
        Edge of the cells whose centroids stand for the cloud, metres.
    mask : array or callable, optional
        Replaces the colour gate; the position box still holds.
    nodes : (count, 3) float array, optional
        Where to start, on the axis, along the rope, metres, camera frame.

    Raises
    ------
    ConfigError
        If the given nodes have another shape or are not finite.
    """

    def __init__(
        self, config: RopeConfig, count: int, voxel: float, mask: Mask | None = None, nodes: FloatArray | None = None
    ) -> None:
        self.config = config.resolved()
        self._count, self._voxel = count, voxel
        self._slicing = SlicingTracker(config, mask)
        self._given = None if nodes is None else _checked(nodes, count)
        self.reset()

    def reset(self) -> None:
        """Forget the frames so far; given nodes are where it starts again."""
        self._slicing.reset()
        self._doubts = Doubts(self.config.diameter)
        self._points: FloatArray = np.empty((3, 0))
        self._found: FloatArray | None = None
        self._waypoints: Waypoints | None = None
        self._last: FloatArray | None = None
        self._losses = 0
        self._surface: FloatArray | None = None
        self._variance: float | None = None
        """Of the last fit, m^2; None after a start and a loss: that frame is looked at as widely as the first."""
        if self._given is not None:
            self._start_from(self._given)

    def update(self, frame: Frame | BadFrame, lap: Lap = no_lap) -> Estimate:
        """The estimate of one frame; of a bad frame, that it is lost.

        Raises
        ------
        FrameError
            If colour is asked for and the frame has none, or the mask does not fit the frame.
        """
        self._points, self._found = np.empty((3, 0)), None
        if isinstance(frame, BadFrame):
            return Estimate.lost(frame.stamp_ns, frame.reason)
        reasons = self._doubts.of_stamp(frame.stamp_ns)
        points, count, stride = self._slicing.rope_points(frame)
        cloud, weights = voxel_grid(points, self._voxel)
        lap("segmentation")
        self._points = points
        if stride > 1:
            reasons.append(thinned(count, stride))
        if len(cloud) > _MOST_VOXELS:
            skip = -(-len(cloud) // _MOST_VOXELS)
            reasons.append(f"{len(cloud)} voxels, one in {skip} is used: background passes, or the voxels are small")
            cloud, weights = np.ascontiguousarray(cloud[::skip]), weights[::skip]
        if count < _FEW or len(cloud) < 2:
            return self._lose(frame, f"too few points ({count})" if count else _NOTHING, count)

        if self._surface is None:
            trouble = self._start(frame.stamp_ns, points, count, stride)
            lap("start")
            if self._surface is None:
                return self._lose(frame, trouble[0], count)
            reasons += trouble
        assert self._surface is not None
        try:
            fit = self._fit(cloud, weights, self._surface, frame)
        except RegistrationError as error:
            return self._lose(frame, f"the registration failed: {error}", count)
        lap("registration")
        self._variance = fit.variance
        trouble, is_lost = self._judge(fit, cloud, weights)
        if is_lost:
            return self._lose(frame, trouble[0], count)
        reasons += trouble
        return self._report(frame, fit.nodes, reasons, count, stride, lap)

    def cloud(self) -> Cloud:
        """The points of the last frame, each with the node that is nearest: a copy."""
        points = self._points.T.copy()
        if self._found is None:
            return Cloud(points, np.full(len(points), -1, np.int32))
        return Cloud(points, nearest_nodes(points, self._found).astype(np.int32))

    def _begin(self, nodes: FloatArray) -> None:
        """Start with these nodes, (count, 3), on the surface, metres. Methods that keep more of a start extend it."""
        self._surface, self._variance = nodes, None

    @abstractmethod
    def _fit(self, points: FloatArray, weights: FloatArray, nodes: FloatArray, frame: Frame) -> Fit:
        """Where the nodes of the frame before lie in this one.

        Parameters
        ----------
        points : (N, 3) float array
            Of the voxels, metres.
        weights : (N,) float array
            How many points each stands for, over their mean.
        nodes : (count, 3) float array
            Of the frame before, on the surface, metres.
        frame : RgbdFrame or CloudFrame
            What the points are from.

        Raises
        ------
        RegistrationError
            If it comes to nothing.
        """

    def _start(self, stamp_ns: int, points: FloatArray, count: int, stride: int) -> list[str]:
        """Begin with the centreline of the slicing tracker; what is wrong with it."""
        estimate = self._slicing.estimate(stamp_ns, points, count, stride, [])
        if estimate.status is Status.LOST:
            return list(estimate.reasons)
        chain = estimate.waypoints.positions
        if self.config.ordering.follow_previous and self._last is not None and runs_backwards(chain, self._last):
            chain = chain[::-1]
        self._start_from(evenly_along(chain, self._count))
        return [f"the start is doubtful: {reason}" for reason in estimate.reasons]

    def _start_from(self, axis: FloatArray) -> None:
        self._length = float(arc_lengths(axis)[-1])
        self._strides = np.maximum(_steps(axis), SHORTEST_STEP)
        self._begin(axis - self._depth_of_axis(axis))

    def _lose(self, frame: Frame, reason: str, count: int) -> Estimate:
        self._losses += 1
        self._variance = None
        if self._losses >= RESTART_AFTER:
            self._surface = None
        return Estimate.lost(frame.stamp_ns, reason, count)

    def _judge(self, fit: Fit, points: FloatArray, weights: FloatArray) -> tuple[list[str], bool]:
        """What is wrong with a fit, and whether it has lost the rope."""
        diameter = self.config.diameter
        if not np.isfinite(fit.nodes).all():
            return ["the registration failed: the nodes run away"], True
        if fit.step > _UNSETTLED * diameter:
            return [f"the nodes still move by {fit.step * 1e3:.0f} mm after {fit.iterations} iterations"], True
        gaps = nearest_distances(fit.nodes, points)
        near = int(np.count_nonzero(gaps < _NEAR * diameter + self._voxel))
        if near < max(_FEWEST_NEAR * len(gaps), 3):
            return [f"only {near} of {len(gaps)} nodes have points within {_NEAR:.0f} diameters"], True
        off = distances_to_chain(points, fit.nodes)
        usual = _weighted_median(off, weights)
        if usual > _ASTRAY * diameter:
            return [f"half of the points lie farther than {usual * 1e3:.0f} mm from the curve"], True

        trouble = []
        reach = _HIDDEN * diameter + self._voxel / 2
        hidden = max(fit.hidden, int(np.count_nonzero(gaps > reach)))
        if hidden:
            trouble.append(f"{hidden} of {len(gaps)} nodes are hidden")
        unexplained = float(weights[off > reach].sum() / weights.sum())
        if unexplained > _UNEXPLAINED:
            share = f"{unexplained * 100:.0f} %"
            trouble.append(f"{share} of the points lie farther than {reach * 1e3:.0f} mm from the curve")
        if sharpest_turn(fit.nodes) > KINK:
            trouble.append("the curve turns back sharply: the order there may be wrong")
        spread = np.convolve(_steps(fit.nodes) / self._strides, np.full(_CROWD, 1 / _CROWD), "valid")
        if spread.min() < _CROWDED * spread.mean():
            trouble.append("the nodes crowd together: what is reported there may be shorter than the rope")
        length = float(arc_lengths(fit.nodes)[-1])
        if abs(length - self._length) > _LENGTH_CHANGE * self._length:
            trouble.append(
                f"the length is {length:.3f} m and was {self._length:.3f} m at the start: "
                "a part is hidden, or something is added"
            )
        return trouble, False

    def _report(
        self, frame: Frame, surface: FloatArray, reasons: list[str], count: int, stride: int, lap: Lap
    ) -> Estimate:
        nodes = surface + self._depth_of_axis(surface)
        chain = nodes[np.concatenate([[True], _steps(nodes) > SHORTEST_STEP])]
        if len(chain) < 2:
            return self._lose(frame, "the nodes have collapsed", count)
        assert self.config.centerline.spacing is not None
        waypoints = make_waypoints(chain, self.config.centerline.spacing, self._waypoints)
        lap("centerline")
        self._surface, self._found, self._last, self._waypoints = surface, nodes, nodes, waypoints
        self._losses = 0
        status = Status.DEGRADED if reasons else Status.OK
        return Estimate(frame.stamp_ns, status, tuple(reasons), nodes, waypoints, count, stride)

    def _depth_of_axis(self, nodes: FloatArray) -> FloatArray:
        """From the visible surface to the axis: pi r / 4 away from the camera, across the rope, (M, 3), metres."""
        tangents = np.gradient(nodes, axis=0)
        tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), SHORTEST_STEP)
        views = nodes / np.maximum(np.linalg.norm(nodes, axis=1, keepdims=True), SHORTEST_STEP)
        away = views - np.sum(views * tangents, axis=1, keepdims=True) * tangents
        # Where the rope points at the camera there is no visible half: the offset fades out.
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 0.1)
        return np.asarray(np.pi / 4 * self.config.radius * away)


_NOTHING = "no points of the rope's colour and place"


def _checked(nodes: FloatArray, count: int) -> FloatArray:
    array = np.array(nodes, dtype=float)
    if array.shape != (count, 3) or not np.isfinite(array).all():
        raise ConfigError(f"nodes of shape {array.shape}: expected ({count}, 3), all of them finite")
    if not arc_lengths(array)[-1] > 0:
        raise ConfigError("nodes: they all coincide")
    return array


def _steps(nodes: FloatArray) -> FloatArray:
    """Distances of neighbours, (M - 1,), metres."""
    return np.asarray(np.linalg.norm(np.diff(nodes, axis=0), axis=1))


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(reached, reached[-1] / 2)])
