"""Global-local topology preservation: coherent point drift whose nodes keep their place among their neighbours.

Ge, Fan and Ding, "Non-rigid point set registration with global-local topology preservation", CVPR workshops (2014).
"""

from __future__ import annotations

from ropetrace.config import RopeConfig
from ropetrace.trackers.base import Mask
from ropetrace.trackers.embedding import linear_alignment
from ropetrace.trackers.kernels import gaussian_kernel
from ropetrace.trackers.nodes import NodeTracker
from ropetrace.trackers.registration import Fit, first_variance, register
from ropetrace.types import FloatArray, Frame


class GltpTracker(NodeTracker):
    """Tracks one rope by GLTP; the embedding is that of the frame's first nodes, the variance goes on between frames.

    Parameters
    ----------
    config : RopeConfig
        Settings; those of `config.gltp` are the method's.
    mask : array or callable, optional
        Replaces the colour gate.
    nodes : (config.gltp.nodes, 3) float array, optional
        Where to start, on the axis, metres, camera frame.
    """

    def __init__(self, config: RopeConfig, mask: Mask | None = None, nodes: FloatArray | None = None) -> None:
        super().__init__(config, config.gltp.nodes, config.gltp.voxel, mask, nodes)

    def _fit(self, points: FloatArray, weights: FloatArray, nodes: FloatArray, frame: Frame) -> Fit:
        settings = self.config.gltp
        return register(
            points,
            weights,
            nodes,
            first_variance(points, weights, nodes) if self._variance is None else self._variance,
            gaussian_kernel(nodes, settings.beta),
            smoothness=settings.smoothness,
            topology=settings.topology,
            alignment=linear_alignment(nodes, settings.neighbors),
            outliers=settings.outliers,
            max_iterations=settings.max_iterations,
            tolerance=settings.tolerance,
        )
