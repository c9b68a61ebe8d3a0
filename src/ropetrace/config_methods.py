"""The settings of the trackers other than slicing: published defaults, and what differs from them.

Common to those that register nodes to the cloud: `nodes`, how many; `voxel`, the edge of the cells whose centroids
stand for the cloud, metres; `outliers`, mu, the share of points that are expected to belong to no node;
`max_iterations` of expectation and maximisation a frame; `tolerance`, the mean step of the nodes below which they have
settled, metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from numbers import Real
from typing import Any

from ropetrace.errors import ConfigError

_LENGTH = {"unit": "length"}


@dataclass(frozen=True, slots=True)
class SchulmanConfig:
    """Expectation-maximisation with a physics simulation (Schulman, Lee, Ho and Abbeel, "Tracking deformable objects
    with point clouds", ICRA 2013).

    Defaults are those of the paper and the sources that it refers to, in metres where they have 100 units a metre.
    """

    nodes: int = 100
    """Points of the path; the rope has one link less."""
    iterations: int = 10
    """A frame."""
    budget: float | None = None
    """Seconds a frame, in the place of `iterations`: as published, it goes on until the next cloud arrives. What it
    finds then depends on the machine and its load."""
    voxel: float = field(default=0.02, metadata=_LENGTH)
    position_deviation: float = field(default=0.02, metadata=_LENGTH)
    """Prior deviation d of a point from its link along each axis, metres."""
    color_deviation: tuple[float, float, float] = (0.4, 0.08, 0.08)
    """The same of L*, a* and b*, in hundreds of CIELAB units. Frames without colour are told by their places alone."""
    prior_weight: float = 10.0
    """nu: as many points as the prior of the deviations counts for."""
    gain: float = 1.0
    """k_p: what a metre between a link and its points adds to its velocity in each iteration, m/s."""
    damping: float = 0.0
    """k_d: the part of a link's velocity that each iteration takes away."""
    step: float = 0.015
    """Of the simulation, seconds of its own time."""
    steps: int = 2
    """In an iteration."""
    linear_damping: float = 0.75
    angular_damping: float = 1.0
    """Of the links, as Bullet counts it: the share of the velocity that a second takes away."""
    joint_stiffness: float = 1e-5
    """N m/rad: 0.1 with 1 kg a link and 100 units a metre. Bullet's spring damping of 1 is none."""
    joint_limit: float = 0.4
    """Radians."""
    gravity: float = 0.1
    """m/s^2."""
    visibility_margin: float = field(default=0.03, metadata=_LENGTH)
    """A link is hidden where the depth image shows something nearer than it by more than this, metres."""
    anchored: bool = False
    """Whether the first waypoint of the start is held where it is: for a rope that is known to hang from there."""
    restart_after: int = 3
    """So many lost frames in a row, and it starts again from the slicing tracker."""

    def __post_init__(self) -> None:
        if self.budget is not None:
            _require_between("schulman", "budget", self.budget, 1e-4, 60)
        for deviation in self.color_deviation:
            _require_between("schulman", "color_deviation", deviation, 1e-6, 1e6)
        _check(
            "schulman",
            self,
            {
                "nodes": (3, 401),
                "iterations": (1, 100_000),
                "position_deviation": (1e-6, 1e3),
                "prior_weight": (1e-6, 1e6),
                "gain": (1e-6, 1e6),
                "damping": (0, 1),
                "step": (1e-6, 10),
                "steps": (1, 100_000),
                "linear_damping": (0, 1),
                "angular_damping": (0, 1),
                "joint_stiffness": (0, 1e6),
                "joint_limit": (1e-6, 1e3),
                "gravity": (0, 1e3),
                "visibility_margin": (0, 1e3),
                "restart_after": (1, 100_000),
            },
        )


@dataclass(frozen=True, slots=True)
class CpdConfig:
    """Coherent point drift (Myronenko and Song, "Point set registration: coherent point drift", PAMI 2010).

    Defaults are those of the authors' Matlab code, but for `voxel` and `tolerance`: it has no voxels, and stops when
    the likelihood changes by less than 1e-5 of itself.
    """

    nodes: int = 45
    voxel: float = field(default=0.008, metadata=_LENGTH)
    beta: float = 2.0
    """Width of the Gaussian kernel, in units of the cloud's RMS distance from its mean, as the paper normalises it."""
    smoothness: float = 3.0
    """lambda, weight of the regularisation, in the same units."""
    outliers: float = 0.1
    max_iterations: int = 150
    tolerance: float = field(default=1e-4, metadata=_LENGTH)

    def __post_init__(self) -> None:
        _check("cpd", self, {"beta": (1e-3, 1e3), "smoothness": (0, 1e6)})


@dataclass(frozen=True, slots=True)
class GltpConfig:
    """Global-local topology preservation (Ge, Fan and Ding, "Non-rigid point set registration with global-local
    topology preservation", CVPRW 2014), as it is used on ropes; that has 20 nodes a rope.
    """

    nodes: int = 45
    voxel: float = field(default=0.008, metadata=_LENGTH)
    beta: float = field(default=0.8, metadata=_LENGTH)
    """Width of the Gaussian kernel, metres."""
    smoothness: float = 1.0
    """lambda, weight of the coherence."""
    topology: float = 10.0
    """tau, weight of the local linear embedding."""
    neighbors: int = 6
    """Of each node, half of them on each side along the rope."""
    outliers: float = 0.1
    max_iterations: int = 50
    tolerance: float = field(default=2e-4, metadata=_LENGTH)

    def __post_init__(self) -> None:
        _check("gltp", self, {"beta": (1e-3, 1e3), "smoothness": (0, 1e6), "topology": (0, 1e6), "neighbors": (2, 50)})


@dataclass(frozen=True, slots=True)
class SprConfig:
    """Structure preserved registration (Tang, Fan, Lin and Tomizuka, "State estimation for deformable objects by point
    registration and dynamic simulation", IROS 2017; Tang and Tomizuka, IJRR 2022).

    Defaults are those of the authors' demonstration on a rope, but for `outliers`, which are 0 there and 0.1 in their
    library, and for the end: it makes 150 iterations always.
    """

    nodes: int = 45
    voxel: float = field(default=0.008, metadata=_LENGTH)
    beta: float = 2.0
    """Width of the Gaussian kernel, in units of the cloud's RMS distance from its mean, as the paper normalises it."""
    smoothness: float = 3.0
    """lambda at the first iteration of a frame, in the same units."""
    topology: float = 500.0
    """tau, weight of the modified local linear embedding, at the first iteration of a frame."""
    annealing: float = 0.97
    """Both weights are multiplied by this after each iteration."""
    neighbors: int = 20
    """Of each node, half of them on each side along the rope."""
    outliers: float = 0.1
    max_iterations: int = 150
    tolerance: float = field(default=1e-4, metadata=_LENGTH)

    def __post_init__(self) -> None:
        _check(
            "spr",
            self,
            {
                "beta": (1e-3, 1e3),
                "smoothness": (0, 1e6),
                "topology": (0, 1e6),
                "annealing": (0.5, 1),
                "neighbors": (5, 50),
            },
        )


@dataclass(frozen=True, slots=True)
class TrackDloConfig:
    """TrackDLO (Xiang, Dinkel, Zhao, Gao, Coltin, Smith and Bretl, "TrackDLO: tracking deformable linear objects under
    occlusion with motion coherence", RA-L 2023). Defaults are those of the authors' launch file.
    """

    nodes: int = 45
    voxel: float = field(default=0.008, metadata=_LENGTH)
    near: float = field(default=0.1, metadata=_LENGTH)
    """Points farther than this from every node are dropped, metres."""
    visible_within: float = field(default=0.008, metadata=_LENGTH)
    """tau_vis: a node with no point this close is hidden, metres. A rope that moves by more from one frame to the next
    counts as hidden: 0.05 suits a swinging one better."""
    bridged: float = field(default=0.06, metadata=_LENGTH)
    """d_vis: hidden stretches no longer than this between visible nodes count as visible, metres."""
    visibility: float = 50.0
    """k_vis: how fast a node's share of the points falls with the distance from the nearest one, 1/m."""
    beta: float = field(default=0.35, metadata=_LENGTH)
    """Width of the geodesic kernel, metres."""
    smoothness: float = 50_000.0
    """lambda of the registration of all nodes."""
    prior: float = 3.0
    """alpha, weight of the places that the visible nodes and the spacing give."""
    visible_beta: float = field(default=3.0, metadata=_LENGTH)
    """Width of the Gaussian kernel in the registration of the visible nodes, metres."""
    visible_smoothness: float = 1.0
    """lambda of the registration of the visible nodes."""
    visible_topology: float = 10.0
    """tau of the registration of the visible nodes."""
    neighbors: int = 6
    """Of each node, half of them on each side along the rope."""
    outliers: float = 0.1
    max_iterations: int = 50
    tolerance: float = field(default=2e-4, metadata=_LENGTH)

    def __post_init__(self) -> None:
        _check(
            "trackdlo",
            self,
            {
                "near": (1e-3, 10),
                "visible_within": (1e-4, 10),
                "bridged": (0, 10),
                "visibility": (0, 1e6),
                "beta": (1e-3, 1e3),
                "smoothness": (0, 1e9),
                "prior": (0, 1e6),
                "visible_beta": (1e-3, 1e3),
                "visible_smoothness": (0, 1e6),
                "visible_topology": (0, 1e6),
                "neighbors": (2, 50),
            },
        )


@dataclass(frozen=True, slots=True)
class CdcpdConfig:
    """Constrained deformable coherent point drift (Wang, McConachie and Berenson, "Tracking partially-occluded
    deformable objects while enforcing geometric constraints", ICRA 2021; the second version's local embedding).

    Defaults are those of the authors' second version, but for `prediction`, which is 10 there: their nodes are
    predicted by the grippers, and here by nothing but where they were.
    """

    nodes: int = 45
    voxel: float = field(default=0.02, metadata=_LENGTH)
    box: tuple[float, float, float] = (0.1, 0.2, 0.1)
    """Points farther than this outside the last nodes' bounding box along x, y or z are dropped, metres."""
    beta: float = field(default=1.0, metadata=_LENGTH)
    """Width of the Gaussian kernel, metres."""
    smoothness: float = 0.5
    """alpha, weight of the coherence."""
    topology: float = 1.0
    """gamma, weight of the local linear embedding of the first shape."""
    neighbors: int = 8
    """Of each node, half of them on each side along the rope."""
    prediction: float = 0.1
    """zeta, weight of the predicted places, which are those of the frame before."""
    visibility: float = 1000.0
    """k_vis: how fast a node's share falls with its depth behind the measured one, 1/m, where it is off the mask."""
    stretch: float = 1.1
    """lambda_s: neighbours are never farther apart than this times their first mean distance."""
    crossing_within: float = field(default=0.02, metadata=_LENGTH)
    """Strands that were closer than this may not pass through each other, metres."""
    crossing_clearance: float = field(default=0.01, metadata=_LENGTH)
    """How far apart they are held on the sides they were on, metres."""
    outliers: float = 0.1
    max_iterations: int = 100
    variance_tolerance: float = 1e-4
    """The iterations end when sigma^2 changes by less than this, m^2: long before the nodes have settled, which serves
    hidden parts and costs fast ones."""

    def __post_init__(self) -> None:
        for extent in self.box:
            _require_between("cdcpd", "box", extent, 1e-3, 10)
        _check(
            "cdcpd",
            self,
            {
                "beta": (1e-3, 1e3),
                "smoothness": (0, 1e6),
                "topology": (0, 1e6),
                "neighbors": (2, 50),
                "prediction": (0, 1e6),
                "variance_tolerance": (0, 1),
                "visibility": (0, 1e6),
                "stretch": (1, 10),
                "crossing_within": (0, 1),
                "crossing_clearance": (0, 1),
            },
        )


_COMMON: dict[str, tuple[float, float]] = {
    "nodes": (8, 400),
    "voxel": (5e-4, 0.5),
    "outliers": (0, 0.99),
    "max_iterations": (1, 10_000),
    "tolerance": (0, 0.1),
}


def _check(table: str, settings: Any, limits: dict[str, tuple[float, float]]) -> None:
    for name, (low, high) in (_COMMON | limits).items():
        if hasattr(settings, name):
            _require_between(table, name, getattr(settings, name), low, high)


def _require_between(table: str, name: str, value: Any, low: float, high: float) -> None:
    if not (isinstance(value, Real) and math.isfinite(value) and low <= float(value) <= high):
        raise ConfigError(f"{table}.{name} = {value}: expected {low:g} to {high:g}")
