"""Structure preserved registration: coherent point drift whose nodes keep the structure of their neighbourhoods.

Tang, Fan, Lin and Tomizuka, "State estimation for deformable objects by point registration and dynamic simulation",
IROS (2017); Tang and Tomizuka, "Track deformable objects from point clouds with structure preserved registration",
IJRR 41 (2022).
"""

from __future__ import annotations

from ropetrace.config import RopeConfig
from ropetrace.trackers.base import Mask
from ropetrace.trackers.cpd import cloud_scale
from ropetrace.trackers.embedding import modified_alignment
from ropetrace.trackers.kernels import gaussian_kernel
from ropetrace.trackers.nodes import NodeTracker
from ropetrace.trackers.registration import Fit, first_variance, register
from ropetrace.types import FloatArray, Frame


class SprTracker(NodeTracker):
    """Tracks one rope by structure preserved registration, with weights that decay from iteration to iteration.

    It differs from `GltpTracker` in the embedding, which has several weight vectors for each node, and begins each
    frame with the widest variance; scales are those of `CpdTracker`.

    Parameters
    ----------
    config : RopeConfig
        Settings; those of `config.spr` are the method's.
    mask : array or callable, optional
        Replaces the colour gate.
    nodes : (config.spr.nodes, 3) float array, optional
        Where to start, on the axis, metres, camera frame.
    """

    def __init__(self, config: RopeConfig, mask: Mask | None = None, nodes: FloatArray | None = None) -> None:
        super().__init__(config, config.spr.nodes, config.spr.voxel, mask, nodes)

    def _fit(self, points: FloatArray, weights: FloatArray, nodes: FloatArray, frame: Frame) -> Fit:
        settings = self.config.spr
        scale = cloud_scale(points, weights)
        return register(
            points,
            weights,
            nodes,
            first_variance(points, weights, nodes),
            gaussian_kernel(nodes, settings.beta * scale),
            smoothness=settings.smoothness / scale**2,
            topology=settings.topology / scale**2,
            alignment=modified_alignment(nodes, settings.neighbors),
            annealing=settings.annealing,
            outliers=settings.outliers,
            density=len(nodes) / len(points) / scale**3,
            max_iterations=settings.max_iterations,
            tolerance=settings.tolerance,
        )
