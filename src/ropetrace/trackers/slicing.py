"""The paper's tracker: segmentation, slicing, ordering, centreline. The shape of each frame stands for itself.

Rastegarpanah, Howard and Stolkin, "Tracking linear deformable objects using slicing method", Robotica 40 (2022).
"""

from __future__ import annotations

from functools import reduce

import numpy as np

from ropetrace.axis import axis_points
from ropetrace.centerline import chain_tangents, extend_to_tips, make_waypoints
from ropetrace.config import RopeConfig, SegmentationConfig, parse_color
from ropetrace.errors import FrameError
from ropetrace.ordering import (
    NodeGraph,
    end_scores,
    order_greedy,
    order_path,
    runs_backwards,
    starts_at_end,
)
from ropetrace.segmentation import ColorGate, PositionBox, Segmenter
from ropetrace.slicing import Slicer
from ropetrace.trackers.base import Lap, Mask, no_lap
from ropetrace.trackers.doubts import Doubts
from ropetrace.trackers.strands import distinct, gaps_in_view, reach_of
from ropetrace.types import (
    BadFrame,
    Cloud,
    Estimate,
    FloatArray,
    Frame,
    RgbdFrame,
    Slices,
    Status,
    Waypoints,
    colors_of,
)


class SlicingTracker:
    """Tracks one rope by slicing.

    Parameters
    ----------
    config : RopeConfig
        Settings; what is None is derived from the diameter.
    mask : array or callable, optional
        Replaces the colour gate; the position box still holds.
    """

    def __init__(self, config: RopeConfig, mask: Mask | None = None) -> None:
        self.config = config.resolved()
        self._mask = mask
        self._segmenter = Segmenter(
            _color_gate(self.config),
            _position_box(self.config),
            self.config.diameter if self.config.segmentation.reject_flying_pixels else None,
        )
        slicing = self.config.slicing
        assert slicing.variance_threshold is not None
        self.slicer = Slicer(slicing.variance_threshold, slicing.min_points, slicing.max_nodes)
        self.seen_diameter = 0.0
        self.reset()

    def reset(self) -> None:
        """Forget the frames so far."""
        self._chain: FloatArray | None = None
        self._waypoints: Waypoints | None = None
        self._doubts = Doubts(self.config.diameter)
        self._points: FloatArray = np.empty((3, 0))
        self._slices: Slices | None = None
        if self.config.segmentation.color_pixel is not None:
            self._segmenter.gate = None

    def update(self, frame: Frame | BadFrame, lap: Lap = no_lap) -> Estimate:
        """The estimate of one frame; of a bad frame, that it is lost.

        Raises
        ------
        FrameError
            If colour is asked for and the frame has none, or the mask does not fit the frame.
        """
        self._points, self._slices = np.empty((3, 0)), None
        if isinstance(frame, BadFrame):
            return Estimate.lost(frame.stamp_ns, frame.reason)
        reasons = self._doubts.of_stamp(frame.stamp_ns)

        points, count, stride = self.rope_points(frame)
        lap("segmentation")
        if count == 0:
            return Estimate.lost(frame.stamp_ns, "no points of the rope's colour and place")
        if stride > 1:
            reasons.append(thinned(count, stride))
        return self.estimate(frame.stamp_ns, points, count, stride, reasons, lap)

    def estimate(
        self, stamp_ns: int, points: FloatArray, count: int, stride: int, reasons: list[str], lap: Lap = no_lap
    ) -> Estimate:
        """What `update` makes of the points that `rope_points` gave, and of the reasons to doubt them.

        Parameters
        ----------
        stamp_ns : int
            Of the frame, nanoseconds.
        points, count, stride
            As `rope_points` gave them; the points, (3, N), are sorted in place.
        reasons : list of str
            What is doubtful so far.
        lap : callable
            Told of the end of each stage.
        """
        slices = self.slicer.slice(points)
        lap("slicing")
        if slices.capped:
            reasons.append(too_many(self.slicer.max_nodes))
        if len(slices) < 2:
            return Estimate.lost(stamp_ns, too_little(points.shape[1], len(slices)), count)

        slices, trouble = self._in_order(slices)
        reasons += trouble
        lap("ordering")
        slices = slices.kept(distinct(slices.centroids))
        if len(slices) < 2:
            return Estimate.lost(stamp_ns, _scattered(points.shape[1]), count)

        tangents = chain_tangents(slices.centroids)
        nodes, widths = axis_points(points, slices, tangents, self.config.radius, self.config.slicing.surface_offset)
        self.seen_diameter = float(np.median(widths))
        reasons += self._doubts.of_shape(nodes, widths)
        chain = extend_to_tips(nodes, reach_of(slices, tangents))
        assert self.config.centerline.spacing is not None
        waypoints = make_waypoints(chain, self.config.centerline.spacing, self._waypoints)
        lap("centerline")

        reasons += self._doubts.of_length(waypoints.length, sound=not reasons)
        self._slices, self._chain, self._waypoints = slices, slices.centroids, waypoints
        status = Status.DEGRADED if reasons else Status.OK
        return Estimate(stamp_ns, status, tuple(reasons), nodes, waypoints, count, stride)

    def cloud(self) -> Cloud:
        """The points of the last frame and their nodes: a copy."""
        node = np.full(self._points.shape[1], -1, np.int32)
        if self._slices is not None:
            for index, (start, count) in enumerate(zip(self._slices.starts, self._slices.counts, strict=True)):
                node[start : start + count] = index
        return Cloud(self._points.T.copy(), node)

    def rope_points(self, frame: Frame) -> tuple[FloatArray, int, int]:
        """The points to use, (3, N); how many passed the gates; and the stride that took these from them."""
        mask = self._mask(frame) if callable(self._mask) else self._mask
        mask = None if mask is None else np.asarray(mask)
        shape = frame.depth.shape if isinstance(frame, RgbdFrame) else (len(frame.points),)
        if mask is not None and (mask.shape != shape or mask.dtype != np.bool_):
            raise FrameError(f"the mask is {mask.dtype} of shape {mask.shape}: expected bool of shape {shape}")
        if mask is None and self.config.asks_for_color:
            self._require_color(frame)
        found = self._segmenter.segment(frame, mask)
        count = found.shape[1]
        stride = -(-count // self.config.slicing.max_points) if count else 1
        self._points = found if stride == 1 else np.ascontiguousarray(found[:, ::stride])
        return self._points, count, stride

    def _require_color(self, frame: Frame) -> None:
        color = colors_of(frame)
        if color is None:
            raise FrameError("a colour is asked for, but the frame has none: leave out the colour, or record it")
        pixel = self.config.segmentation.color_pixel
        if self._segmenter.gate is None and pixel is not None:
            if color.ndim != 3:
                raise FrameError("segmentation.color_pixel needs images; this is a point cloud")
            column, row = pixel
            if row >= color.shape[0] or column >= color.shape[1]:
                raise FrameError(
                    f"segmentation.color_pixel = {pixel} lies outside the {color.shape[1]}x{color.shape[0]} image"
                )
            patch = color[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].reshape(-1, 3)
            r, g, b = (int(value) for value in np.median(patch, axis=0))
            # The pixel may lie in the rope's shade, so brighter ones must pass as well.
            self._segmenter.gate = ColorGate.around_color(
                (r, g, b), self.config.segmentation.color_tolerance, brightest=3.0
            )

    def _in_order(self, slices: Slices) -> tuple[Slices, list[str]]:
        """The slices along the rope from its start, without those that do not belong to it, and what to mistrust."""
        ordering = self.config.ordering
        graph = NodeGraph.of(slices.centroids, slices.covariances)
        surface = bool(np.median(graph.touching) >= SURFACE_NEIGHBOURS)
        if ordering.method == "greedy":
            order = order_greedy(slices.centroids, int(np.argmax(end_scores(slices.centroids, ordering.first_point))))
        else:
            order = order_path(graph)
        gaps = graph.gaps[order[:-1], order[1:]]
        assert ordering.max_gap is not None
        trouble = []
        ends = np.flatnonzero(gaps > ordering.max_gap)
        if len(ends):
            in_view = gaps_in_view(graph, order, slices.centroids[order])
            ends = ends[in_view[ends] > ordering.max_gap]
        if len(ends):
            pieces = np.split(order, ends + 1)
            longest = max(pieces, key=lambda piece: int(slices.counts[piece].sum()))
            trouble.append(
                f"{len(order) - len(longest)} of {len(order)} nodes lie beyond a gap of "
                f"{gaps[ends].min() * 1e3:.0f} mm and are left out: something else of that colour, or a hidden part"
            )
            order, gaps = longest, graph.gaps[longest[:-1], longest[1:]]
        bridged = gaps.max(initial=0.0)
        if bridged > BRIDGE_DIAMETERS * self.config.diameter:
            trouble.append(f"a gap of {bridged * 1e3:.0f} mm is bridged")
        if surface:
            trouble.append(A_SURFACE)
        slices = slices.kept(order)
        if len(slices) > 1 and self._runs_backwards(slices.centroids):
            slices = slices.kept(np.arange(len(slices))[::-1])
        return slices, trouble

    def _runs_backwards(self, chain: FloatArray) -> bool:
        ordering = self.config.ordering
        if ordering.follow_previous and self._chain is not None:
            return runs_backwards(chain, self._chain)
        if ordering.method == "greedy":
            return False  # it started where equation 12 says
        return starts_at_end(chain, ordering.first_point)


BRIDGE_DIAMETERS = 3.0
"""A gap of more diameters than this in the chain is worth telling; a strand that crosses hides one."""

_FEW = 20
"""Fewer points than this make no rope, however they lie."""

SURFACE_NEIGHBOURS = 4
"""Where the typical slice touches this many others, the points are a wall or a table, not a rope."""


A_SURFACE = "the points form a surface, not a rope: background passes the colour or the position box"


def thinned(count: int, stride: int) -> str:
    """That of so many points every k-th was used."""
    return f"{count} points passed, one in {stride} is used: narrow the colour or the position box"


def too_many(most: int) -> str:
    """That the cap on slices was met."""
    return f"more than {most} slices: background is taken for rope, or the diameter is too small"


def too_little(points: int, slices: int) -> str:
    if slices == 1 and points >= _FEW:
        return (
            f"{points} points make a single slice: the diameter (or slicing.variance_threshold) is too large for them"
        )
    return _scattered(points)


def _scattered(points: int) -> str:
    return f"too few points ({points})" if points < _FEW else "the points do not hang together"


def _color_gate(config: RopeConfig) -> ColorGate | None:
    segmentation: SegmentationConfig = config.segmentation
    if config.color is not None:
        gates = [
            ColorGate.around_color(parse_color(color), segmentation.color_tolerance)
            for color in (config.color, *segmentation.more_colors)
        ]
        return reduce(ColorGate.joined, gates)
    if segmentation.lab_min is not None and segmentation.lab_max is not None:
        return ColorGate.inside_lab_box(segmentation.lab_min, segmentation.lab_max)
    return None


def _position_box(config: RopeConfig) -> PositionBox | None:
    segmentation = config.segmentation
    if segmentation.box_min is None or segmentation.box_max is None:
        return None
    low, high = np.array(segmentation.box_min), np.array(segmentation.box_max)
    if segmentation.box_frame == "camera":
        return PositionBox(low, high)
    return PositionBox(low, high, config.world_from_camera())
