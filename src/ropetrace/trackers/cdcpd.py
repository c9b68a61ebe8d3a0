"""CDCPD: coherent point drift with the depth image for a witness, on a rope that neither stretches nor passes itself.

Chi and Berenson, "Occlusion-robust deformable object tracking without physics simulation", IROS (2019); Wang,
McConachie and Berenson, "Tracking partially-occluded deformable objects while enforcing geometric constraints",
ICRA (2021).
"""

from __future__ import annotations

import numpy as np

from ropetrace.config import RopeConfig
from ropetrace.trackers.base import Mask
from ropetrace.trackers.clouds import arc_lengths
from ropetrace.trackers.constraints import close_strands, nearest_feasible
from ropetrace.trackers.embedding import linear_alignment
from ropetrace.trackers.kernels import gaussian_kernel
from ropetrace.trackers.nodes import NodeTracker
from ropetrace.trackers.registration import Fit, RegistrationError, first_variance, register
from ropetrace.trackers.visibility import depth_behind, off_mask
from ropetrace.types import FloatArray, Frame, RgbdFrame

_NARROWER = 8.0
"""sigma^2 begins at the widest over this."""


class CdcpdTracker(NodeTracker):
    """Tracks one rope as CDCPD2 does, without grippers and obstacles: nothing predicts the nodes or holds them.

    The kernel and the embedding are those of the first shape. A node expects fewer points the farther it lies behind
    the measured depth and beside the rope's pixels, f_m = e^(-k_vis delta_m u_m); a cloud without an image has f = 1.
    Then `nearest_feasible` moves the nodes as little as the constraints allow.

    Parameters
    ----------
    config : RopeConfig
        Settings; those of `config.cdcpd` are the method's.
    mask : array or callable, optional
        Replaces the colour gate.
    nodes : (config.cdcpd.nodes, 3) float array, optional
        Where to start, on the axis, metres, camera frame. Their mean spacing bounds the stretch.
    """

    def __init__(self, config: RopeConfig, mask: Mask | None = None, nodes: FloatArray | None = None) -> None:
        super().__init__(config, config.cdcpd.nodes, config.cdcpd.voxel, mask, nodes)

    def _begin(self, nodes: FloatArray) -> None:
        super()._begin(nodes)
        settings = self.config.cdcpd
        self._kernel = gaussian_kernel(nodes, settings.beta)
        self._alignment = linear_alignment(nodes, settings.neighbors)
        self._longest = settings.stretch * float(arc_lengths(nodes)[-1]) / (len(nodes) - 1)

    def _fit(self, points: FloatArray, weights: FloatArray, nodes: FloatArray, frame: Frame) -> Fit:
        settings = self.config.cdcpd
        low, high = nodes.min(axis=0) - settings.box, nodes.max(axis=0) + settings.box
        inside = np.all((points >= low) & (points <= high), axis=1)
        points, weights = points[inside], weights[inside]
        if len(points) < 2:
            raise RegistrationError("no points in the box round the last nodes")
        factors = None
        if isinstance(frame, RgbdFrame):
            behind = depth_behind(nodes, frame)
            factors = np.exp(-settings.visibility * behind * off_mask(nodes, points, frame.intrinsics))
        fit = register(
            points,
            weights,
            nodes,
            first_variance(points, weights, nodes) / _NARROWER,
            self._kernel,
            smoothness=settings.smoothness,
            topology=settings.topology,
            alignment=self._alignment,
            pull=np.full(len(nodes), settings.prediction),
            targets=nodes,
            factors=factors,
            outliers=settings.outliers,
            max_iterations=settings.max_iterations,
            tolerance=0.0,
            variance_tolerance=settings.variance_tolerance,
        )
        strands = close_strands(nodes, settings.crossing_within)
        feasible = nearest_feasible(fit.nodes, self._longest, strands, settings.crossing_clearance)
        return Fit(feasible, fit.variance, fit.step, fit.iterations)
