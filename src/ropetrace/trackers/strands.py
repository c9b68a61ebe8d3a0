"""Strands: stretches of rope that are seen without a break and without doubt about their order."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from ropetrace.axis import axis_points
from ropetrace.centerline import SHORTEST_STEP, chain_tangents, extend_to_tips
from ropetrace.ordering import NodeGraph, order_path
from ropetrace.slicing import Slicer
from ropetrace.trackers.clouds import arc_lengths
from ropetrace.trackers.sight import is_clear
from ropetrace.types import FloatArray, Frame, Slices

Offset = tuple[float, float, float] | None

BREAK = 1.5
"""A strand ends where the next slice is farther away than this, in diameters, less what the slices fill."""

_ALONG_VIEW = 0.3
"""How much a gap along the view counts: a rope that leads away from the camera hides its own next stretch."""

_OVERLAP, _APART, _LATER = 1.2, 6.0, 3.5
"""Slices closer than this in the view, and in space, but farther apart along the path, may hold two stretches of rope:
diameters. Which way the path goes on there is a guess."""


_BEYOND = 6.0
"""A strand that ends this close before another stretch, in diameters, may go on under it."""


_SPREADING = 0.4
"""How much farther aside that stretch may be for each metre ahead: the last slices of a strand do not point well."""


@dataclass(frozen=True, slots=True, eq=False)
class Strand:
    """A stretch of rope.

    Parameters
    ----------
    nodes : (K, 3) float array
        On the axis, K >= 2, neighbours distinct, metres, camera frame.
    arc : (K,) float array
        Where they are along the strand, metres from its very end: `reach` before the first node.
    length : float
        Of the whole strand, metres.
    reach : (start, end)
        How far it goes on beyond its first and last node, metres.
    clear : (start, end)
        Whether it is seen to end there; if not, it may go on behind something.
    widths : (K,) float array
        How wide it looks, metres.
    """

    nodes: FloatArray
    arc: FloatArray
    length: float
    reach: tuple[float, float]
    clear: tuple[bool, bool]
    widths: FloatArray

    @classmethod
    def through(
        cls, nodes: FloatArray, reach: tuple[float, float], clear: tuple[bool, bool], widths: FloatArray
    ) -> Strand:
        """The strand with these nodes and ends."""
        arc = arc_lengths(nodes) + reach[0]
        return cls(nodes, arc, float(arc[-1] + reach[1]), reach, clear, widths)

    @property
    def widest_gap(self) -> float:
        """The longest way between two of its nodes, beyond what is usual, metres."""
        steps = np.diff(self.arc)
        return float(steps.max() - np.median(steps))

    @property
    def chain(self) -> FloatArray:
        """Its points from end to end, metres."""
        return extend_to_tips(self.nodes, self.reach)

    def reversed(self) -> Strand:
        """The same from its end to its start."""
        return Strand(
            self.nodes[::-1],
            self.length - self.arc[::-1],
            self.length,
            self.reach[::-1],
            self.clear[::-1],
            self.widths[::-1],
        )

    def joined(self, after: Strand) -> Strand:
        """This strand and another that begins where it ends, with the straight way between their nodes."""
        return Strand.through(
            np.concatenate([self.nodes, after.nodes]),
            (self.reach[0], after.reach[1]),
            (self.clear[0], after.clear[1]),
            np.concatenate([self.widths, after.widths]),
        )


def sliced_apart(points: FloatArray, slices: Slices, slicer: Slicer, gap: float) -> Slices:
    """The slices of each piece of a cloud that lies apart from the others, cut by itself.

    Parameters
    ----------
    points : (3, N) float array
        As the slicing sorted them, metres; they are sorted anew.
    slices : Slices
        Of the whole cloud.
    slicer : Slicer
        Cuts.
    gap : float
        Pieces with more free space than this between all of their slices are apart, metres.
    """
    if len(slices) < 2:
        return slices
    graph = NodeGraph.of(slices.centroids, slices.covariances)
    count, piece = connected_components(graph.gaps <= gap, directed=False)
    if count == 1:
        return slices
    clouds = []
    for number in range(count):
        ranges = zip(slices.starts[piece == number], slices.counts[piece == number], strict=True)
        clouds.append(np.concatenate([points[:, start : start + size] for start, size in ranges], axis=1))
    parts, at = [], 0
    for cloud in clouds:
        part = slicer.slice(cloud)
        points[:, at : at + cloud.shape[1]] = cloud
        parts.append(replace(part, starts=part.starts + at))
        at += cloud.shape[1]
    return Slices(
        np.concatenate([part.centroids for part in parts]),
        np.concatenate([part.covariances for part in parts]),
        np.concatenate([part.counts for part in parts]),
        any(part.capped for part in parts),
        np.concatenate([part.starts for part in parts]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """The slices of a frame in order along the cheapest way through all of them.

    Parameters
    ----------
    slices : Slices
        In that order.
    gaps : (M - 1,) float array
        Free space to the next slice, metres; what of it lies along the view counts little.
    unsure : (M,) bool array
        Where another stretch of the path comes close in the view.
    touching : int
        How many others the typical slice touches: 2 on a rope, more on a surface.
    """

    slices: Slices
    gaps: FloatArray
    unsure: NDArray[np.bool_]
    touching: int


def path_through(slices: Slices, diameter: float) -> Path:
    """The path through all slices of a frame, at least one; the diameter of the rope in metres."""
    graph = NodeGraph.of(slices.centroids, slices.covariances)
    order = order_path(graph)
    slices = slices.kept(order)
    keep = distinct(slices.centroids)
    if not keep.all():
        order, slices = order[keep], slices.kept(keep)
    unsure = np.zeros(len(slices), np.bool_)
    _mark_unsure(slices.centroids, arc_lengths(slices.centroids), diameter, unsure)
    return Path(slices, gaps_in_view(graph, order, slices.centroids), unsure, int(np.median(graph.touching)))


def distinct(chain: FloatArray) -> NDArray[np.bool_]:
    """Which nodes of a chain do not coincide with the one before."""
    steps = np.diff(chain, axis=0)
    return np.concatenate([[True], np.einsum("ij,ij->i", steps, steps) > SHORTEST_STEP**2])


def gaps_in_view(graph: NodeGraph, order: NDArray[np.int64], centroids: FloatArray) -> FloatArray:
    """The gaps along a path, (M - 1,), metres; what of a gap lies along the view counts little.

    Parameters
    ----------
    graph : NodeGraph
        Of all slices.
    order : (M,) int array
        The path.
    centroids : (M, 3) float array
        In the order of the path, metres, camera frame.
    """
    directions = graph.directions[order[:-1], order[1:]]
    views = (centroids[:-1] + centroids[1:]) / 2
    views /= np.maximum(np.linalg.norm(views, axis=1, keepdims=True), 1e-9)
    along = np.sum(directions * views, axis=1)
    return np.asarray(graph.gaps[order[:-1], order[1:]] * np.sqrt(1 - (1 - _ALONG_VIEW**2) * along**2))


def strands_of(
    path: Path, points: FloatArray, frame: Frame, diameter: float, surface_offset: Offset = None
) -> list[Strand]:
    """The strands of a path, in its order; slices that belong to no stretch for sure are left out.

    Parameters
    ----------
    path : Path
        Through the slices of the frame.
    points : (3, N) float array
        As the slicing sorted them, metres, camera frame.
    frame : RgbdFrame or CloudFrame
        Where they are from.
    diameter : float
        Of the rope, metres.
    surface_offset : (x, y, z), optional
        As in `axis_points`, metres.
    """
    ends = np.flatnonzero(path.gaps > BREAK * diameter) + 1
    strands = []
    for piece in np.split(np.arange(len(path.slices)), ends):
        sure = ~path.unsure[piece]
        for run in np.split(piece, np.flatnonzero(np.diff(sure)) + 1):
            if len(run) > 1 and not path.unsure[run[0]]:
                strand = strand_of(path.slices.kept(run), points, frame, diameter, surface_offset)
                others = np.delete(path.slices.centroids, run, axis=0)
                clear = (
                    strand.clear[0] and not _leads_to(others, strand.nodes[0], strand.nodes[1], diameter),
                    strand.clear[1] and not _leads_to(others, strand.nodes[-1], strand.nodes[-2], diameter),
                )
                strands.append(replace(strand, clear=clear))
    return strands


def _leads_to(others: FloatArray, end: FloatArray, before: FloatArray, diameter: float) -> bool:
    """Whether other slices lie where a strand that ends there would go on: it may go on under them."""
    outward = (end - before) / np.linalg.norm(end - before)
    view = end / max(float(np.linalg.norm(end)), 1e-9)
    steps = others - end
    steps = steps - (steps @ view)[:, None] * view
    ahead = steps @ outward
    aside = np.linalg.norm(steps - ahead[:, None] * outward, axis=1)
    return bool(((ahead > 0) & (ahead < _BEYOND * diameter) & (aside < _OVERLAP * diameter + _SPREADING * ahead)).any())


def strand_of(
    slices: Slices, points: FloatArray, frame: Frame, diameter: float, surface_offset: Offset = None
) -> Strand:
    """The strand that two or more slices in order are; the rest as in `strands_of`."""
    tangents = chain_tangents(slices.centroids)
    nodes, widths = axis_points(points, slices, tangents, diameter / 2, surface_offset)
    reach = reach_of(slices, tangents)
    chain = extend_to_tips(nodes, reach)
    clear = (is_clear(frame, chain[0], chain[1], diameter), is_clear(frame, chain[-1], chain[-2], diameter))
    return Strand.through(nodes, reach, clear, widths)


def reach_of(slices: Slices, tangents: FloatArray) -> tuple[float, float]:
    """How far the first and the last slice go on beyond their centroids: half the length of an even spread, metres."""
    first = tangents[0] @ slices.covariances[0] @ tangents[0]
    last = tangents[-1] @ slices.covariances[-1] @ tangents[-1]
    return float(np.sqrt(3 * max(first, 0.0))), float(np.sqrt(3 * max(last, 0.0)))


@njit(cache=True, nogil=True)
def _mark_unsure(centroids: Any, arc: Any, diameter: float, unsure: Any) -> None:
    for i in range(len(centroids)):
        square = 0.0
        for k in range(3):
            square += centroids[i, k] ** 2
        for j in range(i):
            if arc[i] - arc[j] < _LATER * diameter:
                break
            apart = along = 0.0
            for k in range(3):
                step = centroids[i, k] - centroids[j, k]
                apart += step * step
                along += step * centroids[i, k]
            if apart < (_APART * diameter) ** 2 and apart - along * along / square < (_OVERLAP * diameter) ** 2:
                unsure[i] = unsure[j] = True
