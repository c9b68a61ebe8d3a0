"""TrackDLO: hidden nodes follow the visible ones along the rope, at the spacing they had at the start.

Xiang, Dinkel, Zhao, Gao, Coltin, Smith and Bretl, "TrackDLO: tracking deformable linear objects under occlusion with
motion coherence", IEEE RA-L 8 (2023).
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ropetrace.config import RopeConfig
from ropetrace.trackers.base import Mask
from ropetrace.trackers.clouds import arc_lengths, nearest_distances, walk
from ropetrace.trackers.embedding import linear_alignment
from ropetrace.trackers.kernels import gaussian_kernel, geodesic_kernel
from ropetrace.trackers.nodes import NodeTracker
from ropetrace.trackers.registration import (
    Fit,
    RegistrationError,
    first_variance,
    register,
)
from ropetrace.trackers.visibility import hidden_by_chain
from ropetrace.types import FloatArray, Frame

_FEWEST_VISIBLE = 3


class TrackDloTracker(NodeTracker):
    """Tracks one rope as TrackDLO does.

    1. Points far from every node are dropped, and the visible nodes found (`visible_nodes`).
    2. The visible nodes are registered by GLTP, with nearly rigid coherence.
    3. Along the polyline through them, nodes are laid at their first spacing (`laid_along`).
    4. All nodes are registered, drawn to those places, with distances and the kernel measured along the rope, and
       hidden nodes expecting fewer points: f_m = e^(-k_vis d_m) / sum, with d_m the distance to the nearest point.

    Parameters
    ----------
    config : RopeConfig
        Settings; those of `config.trackdlo` are the method's.
    mask : array or callable, optional
        Replaces the colour gate.
    nodes : (config.trackdlo.nodes, 3) float array, optional
        Where to start, on the axis, metres, camera frame. Their spacing is kept.
    """

    def __init__(self, config: RopeConfig, mask: Mask | None = None, nodes: FloatArray | None = None) -> None:
        super().__init__(config, config.trackdlo.nodes, config.trackdlo.voxel, mask, nodes)

    def _begin(self, nodes: FloatArray) -> None:
        super()._begin(nodes)
        self._arc = arc_lengths(nodes)
        self._kernel = geodesic_kernel(self._arc, self.config.trackdlo.beta)

    def _fit(self, points: FloatArray, weights: FloatArray, nodes: FloatArray, frame: Frame) -> Fit:
        settings = self.config.trackdlo
        near = nearest_distances(points, nodes) <= settings.near
        points, weights = points[near], weights[near]
        if len(points) < 2:
            raise RegistrationError(f"no points within {settings.near:g} m of the nodes")
        variance = first_variance(points, weights, nodes) if self._variance is None else self._variance
        gaps = nearest_distances(nodes, points)
        seen = (gaps <= settings.visible_within) & ~hidden_by_chain(nodes, self.config.diameter)
        visible = np.flatnonzero(bridged(seen, self._arc, settings.bridged))
        if len(visible) < _FEWEST_VISIBLE:
            raise RegistrationError(f"{len(visible)} of {len(nodes)} nodes are visible")
        guide = register(
            points,
            weights,
            nodes[visible],
            variance,
            gaussian_kernel(nodes[visible], settings.visible_beta),
            smoothness=settings.visible_smoothness,
            topology=settings.visible_topology,
            alignment=linear_alignment(nodes[visible], settings.neighbors),
            outliers=settings.outliers,
            max_iterations=settings.max_iterations,
            tolerance=settings.tolerance,
        ).nodes
        moved = np.linalg.norm(guide - nodes[visible], axis=1)
        targets, laid = laid_along(guide, visible, np.diff(self._arc), moved)
        factors = np.exp(-settings.visibility * np.where(gaps <= settings.visible_within, 0.0, gaps))
        if not factors.sum() > 0:
            raise RegistrationError("all nodes are far from the points")
        fit = register(
            points,
            weights,
            nodes,
            variance,
            self._kernel,
            smoothness=settings.smoothness,
            pull=np.where(laid, settings.prior, 0.0),
            targets=np.where(laid[:, None], targets, nodes),
            factors=factors / factors.sum(),
            density=1 / len(points),
            arc=self._arc,
            outliers=settings.outliers,
            max_iterations=settings.max_iterations,
            tolerance=settings.tolerance,
        )
        return replace(fit, hidden=len(nodes) - len(visible))


def bridged(seen: NDArray[np.bool_], arc: FloatArray, longest: float) -> NDArray[np.bool_]:
    """Which nodes count as visible: those seen, and stretches no longer than `longest` metres between two of them.

    Parameters
    ----------
    seen : (M,) bool array
        Which nodes are seen.
    arc : (M,) float array
        Their places along the rope, metres.
    longest : float
        d_vis, from seen node to seen node, metres.
    """
    visible = seen.copy()
    indices = np.flatnonzero(seen)
    for first, last in pairwise(indices):
        if arc[last] - arc[first] <= longest:
            visible[first:last] = True
    return visible


def laid_along(
    guide: FloatArray, visible: NDArray[np.int64], strides: FloatArray, moved: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Places at the first spacing along the polylines through the visible nodes.

    From the rope's start, if it is visible, as far as the nodes are without a gap; so from its end; the mean where both
    give a place. If neither is visible, both ways from the visible node that moved least.

    Parameters
    ----------
    guide : (V, 3) float array
        Where the visible nodes lie now, metres.
    visible : (V,) int array
        Their indices, ascending.
    strides : (M - 1,) float array
        The first distances of neighbours, metres.
    moved : (V,) float array
        How far the visible nodes went in this frame, metres.

    Returns
    -------
    places : (M, 3) float array
        Metres; 0 where there is none.
    laid : (M,) bool array
        Which nodes have a place.
    """
    last = len(strides)
    runs = np.split(np.arange(len(visible)), np.flatnonzero(np.diff(visible) > 1) + 1)
    totals, counts = np.zeros((last + 1, 3)), np.zeros(last + 1)

    def lay(vertices: NDArray[np.int64], step: int) -> None:
        first = int(visible[vertices[0]])
        ahead = strides[first:] if step > 0 else strides[:first][::-1]
        for index, place in enumerate(walk(guide[vertices], ahead)):
            totals[first + step * index] += place
            counts[first + step * index] += 1

    if visible[0] == 0:
        lay(runs[0], 1)
    if visible[-1] == last:
        lay(runs[-1][::-1], -1)
    if not counts.any():
        still = int(np.argmin(moved))
        run = next(run for run in runs if run[0] <= still <= run[-1])
        lay(run[run >= still], 1)
        lay(run[run <= still][::-1], -1)
    laid = counts > 0
    return np.where(laid[:, None], totals / np.maximum(counts, 1)[:, None], 0.0), laid
