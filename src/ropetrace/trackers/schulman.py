"""Expectation-maximisation with a physics simulation: the tracker that the paper measures itself against.

Schulman, Lee, Ho and Abbeel, "Tracking deformable objects with point clouds", ICRA 2013. The cloud is explained by the
links of a simulated rope; what it asks of them acts as impulses in the simulation, which keeps the shape a rope's.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit

from ropetrace.centerline import SHORTEST_STEP, make_waypoints, sample_spline
from ropetrace.config import RopeConfig
from ropetrace.errors import ConfigError, import_extra
from ropetrace.ordering import runs_backwards
from ropetrace.segmentation import lab_from_rgb
from ropetrace.sim.impulse_chain import ImpulseChain
from ropetrace.trackers.base import Lap, Mask, no_lap
from ropetrace.trackers.clouds import (
    arc_lengths,
    distances_to_chain,
    evenly_along,
    nearest_distances,
    nearest_nodes,
    voxel_grid,
)
from ropetrace.trackers.doubts import Doubts, strands_overlap
from ropetrace.trackers.schulman_em import maximise, responsibilities
from ropetrace.trackers.slicing import SlicingTracker
from ropetrace.trackers.visibility import depth_behind
from ropetrace.types import (
    BadFrame,
    Cloud,
    Estimate,
    FloatArray,
    Frame,
    RgbdFrame,
    Status,
    Waypoints,
    colors_of,
)

_REACH = 10.0
"""Points farther from the rope than this, in deviations of the prior, are outliers beyond doubt."""

_STRAY, _OFF = 3.0, 1.0
"""Diameters from the points beyond which the rope is lost, or doubtful; but no less than 2 and 0.5 of the prior's
deviations, which is as sharp as the method sees."""

_UNEXPLAINED = 0.1
"""Share of the points off the rope, or of the rope without points, beyond which an estimate is doubtful."""

_LESS, _LATELY = 0.15, 31
"""A visible area less by more than this share than it was lately, in so many sound frames, is not the whole rope's. A
pixel sees an area as the square of its range."""

_JUDGED, _COLORED = 1000, 5000
"""Points that the judgement looks at, and among which voxels look for their colour, at most."""

_FEWEST = 20
"""Fewer points than this are no rope."""

_SHORTEST = 3.0
"""Nor is what is shorter than this, in diameters."""

_SAME_LENGTH, _PATIENCE = 0.15, 10
"""A start whose length differs by more than this share from the first is taken only after so many times
`restart_after`."""


class SchulmanTracker:
    """Tracks one rope whose length does not change, from a first shape on.

    Differences from the publication: MuJoCo in the place of Bullet, whose joints do not drift apart (Bullet pulls them
    together by 0.2 of their gap a step) and do not twist; no ground, and nothing collides; links stand on the rope's
    axis, as points are moved away from the camera by pi/4 of the radius, the mean depth of the visible half of a tube.

    Parameters
    ----------
    config : RopeConfig
        Settings; those of `config.schulman` are the method's. Gravity acts downwards in the world if `camera_pose` is
        given, and else downwards in the image.
    mask : array or callable, optional
        Replaces the colour gate; the position box still holds.
    nodes : (M, 3) float array, optional
        The first shape, in order along the rope from tip to tip, metres, camera frame; by default the slicing
        tracker's first centreline.
    clock : callable
        Seconds, by which `budget` is kept; without a budget it is never asked.

    Raises
    ------
    ConfigError
        If the nodes are no path.
    MissingExtraError
        If MuJoCo is not installed.
    """

    def __init__(
        self,
        config: RopeConfig,
        mask: Mask | None = None,
        nodes: FloatArray | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.config = config.resolved()
        self.settings = config.schulman
        import_extra("mujoco", "sim")
        self._clock = clock
        self._given = None if nodes is None else _checked_path(nodes)
        self._gravity = self._downwards() * self.settings.gravity
        self._starter = SlicingTracker(config, mask)
        self.reset()

    def _downwards(self) -> FloatArray:
        """Unit vector, camera frame."""
        if self.config.camera_pose is None:
            return np.array([0.0, 1.0, 0.0])
        return -self.config.world_from_camera()[2, :3]

    def reset(self) -> None:
        """Forget the frames so far."""
        self._starter.reset()
        self._doubts = Doubts(self.config.diameter)
        self._points: FloatArray = np.empty((3, 0))
        self._axis_points: FloatArray = np.empty((0, 3))
        self._chain: ImpulseChain | None = None
        self._path: FloatArray | None = None
        self._length: float | None = None
        self._colors: FloatArray | None = None
        self._deviations: FloatArray = np.empty((0, 0))
        self._waypoints: Waypoints | None = None
        self._lost_frames = 0
        self._area = 0.0
        self._areas: deque[float] = deque(maxlen=_LATELY)

    def update(self, frame: Frame | BadFrame, lap: Lap = no_lap) -> Estimate:
        """The estimate of one frame; of a bad frame, that it is lost.

        Raises
        ------
        FrameError
            If colour is asked for and the frame has none, or the mask does not fit the frame.
        """
        started = 0.0 if self.settings.budget is None else self._clock()
        if isinstance(frame, BadFrame):
            self._points = np.empty((3, 0))
            return self._lost(frame, frame.reason, 0)
        reasons = self._doubts.of_stamp(frame.stamp_ns)
        points, count, stride = self._starter.rope_points(frame)
        self._points = points.copy()  # the slicing tracker sorts its own
        lap("segmentation")
        if stride > 1:
            reasons.append(f"{count} points passed, one in {stride} is used: narrow the colour or the position box")

        if count < _FEWEST:
            trouble = f"too few points ({count})" if count else "no points of the rope's colour and place"
            return self._lost(frame, trouble, count)
        if self._chain is None or self._lost_frames >= self.settings.restart_after:
            reasons += self._start(frame)
        chain = self._chain
        if chain is None:
            return self._lost(frame, reasons[-1], count)
        lap("start")
        if not self._fit(frame, chain, stride, started):
            self._chain = None
            return self._lost(frame, "the simulation became unstable and starts again", count)
        lap("fit")
        lost, doubts = self._judge(chain)
        if lost is not None:
            return self._lost(frame, lost, count)
        reasons += doubts
        self._lost_frames = 0
        nodes, self._path = chain.centres, chain.path
        line = np.concatenate([self._path[:1], nodes, self._path[-1:]])
        assert self.config.centerline.spacing is not None
        self._waypoints = make_waypoints(line, self.config.centerline.spacing, self._waypoints)
        lap("centerline")
        status = Status.DEGRADED if reasons else Status.OK
        return Estimate(frame.stamp_ns, status, tuple(reasons), nodes, self._waypoints, count, stride)

    def cloud(self) -> Cloud:
        """The points of the last frame and their nodes: a copy."""
        points = self._points.T.copy()
        if self._chain is None or self._lost_frames:
            return Cloud(points, np.full(len(points), -1, np.int32))
        return Cloud(points, nearest_nodes(self._axis_points, self._chain.centres).astype(np.int32))

    def _lost(self, frame: Frame | BadFrame, reason: str, count: int) -> Estimate:
        self._lost_frames += 1
        return Estimate.lost(frame.stamp_ns, reason, count)

    def _start(self, frame: Frame) -> list[str]:
        """Make a rope, if there is a shape to start from; what is wrong with that shape."""
        settings = self.settings
        path, trouble = self._first_shape(frame)
        if path is None:
            return trouble
        self._length = float(arc_lengths(path)[-1]) if self._length is None else self._length
        self._chain = ImpulseChain(
            _resampled(path, settings.nodes),
            self.config.radius,
            step=settings.step,
            linear_damping=settings.linear_damping,
            angular_damping=settings.angular_damping,
            stiffness=settings.joint_stiffness,
            limit=settings.joint_limit,
            gravity=self._gravity,
            anchored=settings.anchored,
        )
        self._colors, self._deviations = None, np.empty((0, 0))
        self._lost_frames = 0
        return trouble

    def _first_shape(self, frame: Frame) -> tuple[FloatArray | None, list[str]]:
        """A path to start from, (M, 3), if there is one, and what is wrong with it."""
        if self._given is not None and self._length is None:
            return self._given, []
        found = self._starter.update(frame)
        trouble = [f"the start is doubtful: {reason}" for reason in found.reasons]
        path = found.waypoints.positions
        if len(path) < 2:
            return None, [f"no shape to start from: {found.reasons[0]}"]
        length = float(arc_lengths(path)[-1])
        if length < _SHORTEST * self.config.diameter:
            return None, [f"what is seen is only {length * 1e3:.0f} mm long"]
        known = length if self._length is None else self._length
        patient = self._lost_frames < _PATIENCE * self.settings.restart_after
        if patient and abs(length - known) > _SAME_LENGTH * known:
            return None, [f"what is seen is {length:.3f} m long, and the rope is {known:.3f} m"]
        if self._path is not None and runs_backwards(path, self._path):
            path = np.ascontiguousarray(path[::-1])
        return path, trouble

    def _fit(self, frame: Frame, chain: ImpulseChain, stride: int, started: float) -> bool:
        """All iterations of a frame: E-step, M-step, simulation. False if the simulation became unstable."""
        settings = self.settings
        ranges = np.maximum(np.linalg.norm(self._points, axis=0), 1e-9)
        on_axis = self._points * (1 + np.pi / 4 * self.config.radius / ranges)
        self._axis_points = np.ascontiguousarray(on_axis.T)
        cloud, _ = voxel_grid(on_axis, settings.voxel)
        nodes = chain.centres
        reach = _REACH * settings.position_deviation
        low, high = nodes.min(axis=0) - reach, nodes.max(axis=0) + reach
        near = np.all((cloud > low) & (cloud < high), axis=1)
        far = int(np.count_nonzero(~near))
        if far == len(cloud):
            return True
        inside = np.all((self._axis_points > low) & (self._axis_points < high), axis=1)
        self._area = float(np.sum(ranges[inside] ** 2)) * stride
        features, means = cloud[near], nodes
        prior = np.full(3, settings.position_deviation)
        colors = self._colors_at(features, frame)
        if colors is not None:
            if self._colors is None:
                self._colors = colors[nearest_nodes(nodes, features)]
            features, means = np.hstack([features, colors]), np.hstack([nodes, self._colors])
            prior = np.concatenate([prior, settings.color_deviation])
        if self._deviations.shape != means.shape:
            self._deviations = np.tile(prior, (len(nodes), 1))
        before, longest, done = started, 0.0, 0
        while True:
            shares = responsibilities(features, means, self._deviations, self._visible(frame, means), prior, far)
            pulls = maximise(features, means, shares, prior, settings.prior_weight, self._deviations)
            if not chain.push(settings.gain * pulls - settings.damping * chain.velocities, settings.steps):
                return False
            means[:, :3] = chain.centres
            done += 1
            if settings.budget is None:
                if done == settings.iterations:
                    return True
                continue
            now = self._clock()
            longest, before = max(longest, now - before if done > 1 else 0.0), now
            if now - started + longest > settings.budget:
                return True

    def _visible(self, frame: Frame, nodes: FloatArray) -> FloatArray:
        """Of each node, (K,), 0 or 1. What hides points of a cloud is not known; where there is no depth, nothing."""
        if not isinstance(frame, RgbdFrame):
            return np.ones(len(nodes))
        return np.asarray(depth_behind(nodes[:, :3], frame) < self.settings.visibility_margin, float)

    def _colors_at(self, places: FloatArray, frame: Frame) -> FloatArray | None:
        """Colour of the point nearest to each place, (V, 3), in hundreds of CIELAB units, if the frame has any."""
        image = colors_of(frame)
        if image is None:
            return None
        some = slice(None, None, -(-self._points.shape[1] // _COLORED))
        nearest = nearest_nodes(places, self._axis_points[some])
        x, y, z = self._points[:, some][:, nearest]
        if isinstance(frame, RgbdFrame):
            lens = frame.intrinsics
            columns, rows = np.rint(lens.fx * x / z + lens.cx), np.rint(lens.fy * y / z + lens.cy)
            colors = image[rows.astype(np.int64), columns.astype(np.int64)]
        else:
            indices = np.zeros(self._points.shape[1], np.int64)
            _find(self._points, np.asarray(frame.points, float), indices)
            colors = image[indices[some][nearest]]
        return lab_from_rgb(colors) / 100

    def _judge(self, chain: ImpulseChain) -> tuple[str | None, list[str]]:
        """Why the rope is lost, if it is, and what is doubtful about it if it is not."""
        diameter, deviation = self.config.diameter, self.settings.position_deviation
        off, stray = max(_OFF * diameter, 0.5 * deviation), max(_STRAY * diameter, 2 * deviation)
        points = self._axis_points[:: -(-len(self._axis_points) // _JUDGED)]
        from_points = distances_to_chain(points, chain.path)
        from_nodes = nearest_distances(chain.centres, points)
        near = from_points[from_points < _REACH * deviation]
        if not len(near):
            return f"no points within {_REACH * deviation:.2f} m of the rope", []
        residual = max(float(np.median(near)), float(np.median(from_nodes)))
        if residual > stray:
            return f"the rope is {residual / diameter:.1f} diameters from the points", []
        doubts = []
        if residual > off:
            doubts.append(f"the rope is {residual / diameter:.1f} diameters from the points")
        unexplained, unseen = float(np.mean(from_points > 2 * off)), float(np.mean(from_nodes > 2 * off))
        if unexplained > _UNEXPLAINED:
            doubts.append(f"{unexplained:.0%} of the points are not where the rope is")
        if unseen > _UNEXPLAINED:
            doubts.append(f"{unseen:.0%} of the rope has no points: a part is hidden, or it lags behind")
        if strands_overlap(chain.path, diameter):
            doubts.append("strands overlap in the camera's view: the order there may be wrong")
        usual = float(np.median(self._areas)) if self._areas else self._area
        if self._area < (1 - _LESS) * usual:
            doubts.append(f"only {self._area / usual:.0%} of the area of lately is seen: a part is hidden")
        if not doubts:
            self._areas.append(self._area)
        return None, doubts


def _checked_path(nodes: FloatArray) -> FloatArray:
    path = np.array(nodes, float)
    if path.ndim != 2 or path.shape[1] != 3 or not np.isfinite(path).all():
        raise ConfigError(f"nodes of shape {path.shape}: expected (M, 3) finite coordinates, M >= 2")
    path = path[np.concatenate([[True], np.linalg.norm(np.diff(path, axis=0), axis=1) > SHORTEST_STEP])]
    if len(path) < 2:
        raise ConfigError("nodes: fewer than two different points are no rope")
    return path


def _resampled(path: FloatArray, count: int) -> FloatArray:
    """Points of a spline through the path at equal arc length, (count, 3)."""
    fine = sample_spline(path, float(arc_lengths(path)[-1]) / (10 * count))[0]
    return evenly_along(fine, count)


@njit(cache=True, nogil=True)
def _find(some: Any, all_points: Any, places: Any) -> None:
    """Where points, (3, N), stand among those that they were taken from, in the same order."""
    at = 0
    for n in range(some.shape[1]):
        while at < len(all_points) - 1 and not (
            all_points[at, 0] == some[0, n] and all_points[at, 1] == some[1, n] and all_points[at, 2] == some[2, n]
        ):
            at += 1
        places[n] = at
        at = min(at + 1, len(all_points) - 1)
