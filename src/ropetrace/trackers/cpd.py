"""Coherent point drift: nodes that move to the points, neighbours alike.

Myronenko and Song, "Point set registration: coherent point drift", IEEE PAMI 32 (2010).
"""

from __future__ import annotations

import numpy as np

from ropetrace.config import RopeConfig
from ropetrace.trackers.base import Mask
from ropetrace.trackers.kernels import gaussian_kernel
from ropetrace.trackers.nodes import NodeTracker
from ropetrace.trackers.registration import Fit, first_variance, register
from ropetrace.types import FloatArray, Frame


class CpdTracker(NodeTracker):
    """Tracks one rope by coherent point drift from the nodes of the frame before; see `register` for the equations.

    Each frame begins with the widest variance. The paper brings both sets to zero mean and unit scale; here the cloud's
    scale alone is taken, into the parameters, since a hidden part would move and shrink the nodes otherwise.

    Parameters
    ----------
    config : RopeConfig
        Settings; those of `config.cpd` are the method's.
    mask : array or callable, optional
        Replaces the colour gate.
    nodes : (config.cpd.nodes, 3) float array, optional
        Where to start, on the axis, metres, camera frame.
    """

    def __init__(self, config: RopeConfig, mask: Mask | None = None, nodes: FloatArray | None = None) -> None:
        super().__init__(config, config.cpd.nodes, config.cpd.voxel, mask, nodes)

    def _fit(self, points: FloatArray, weights: FloatArray, nodes: FloatArray, frame: Frame) -> Fit:
        settings = self.config.cpd
        scale = cloud_scale(points, weights)
        return register(
            points,
            weights,
            nodes,
            first_variance(points, weights, nodes),
            gaussian_kernel(nodes, settings.beta * scale),
            smoothness=settings.smoothness / scale**2,
            outliers=settings.outliers,
            density=len(nodes) / len(points) / scale**3,
            max_iterations=settings.max_iterations,
            tolerance=settings.tolerance,
        )


def cloud_scale(points: FloatArray, weights: FloatArray) -> float:
    """RMS distance of the points, (N, 3), from their mean, metres: the unit of a normalised cloud."""
    share = weights / weights.sum()
    return float(max(np.sqrt(share @ np.sum((points - share @ points) ** 2, axis=1)), 1e-3))
