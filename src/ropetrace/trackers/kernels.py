"""How alike the nodes of a chain move: kernels of their distance, in space or along the rope."""

from __future__ import annotations

import numpy as np

from ropetrace.types import FloatArray


def gaussian_kernel(nodes: FloatArray, width: float) -> FloatArray:
    """G_ij = exp(-|y_i - y_j|^2 / (2 width^2)), (M, M) (Myronenko and Song, 2010).

    Parameters
    ----------
    nodes : (M, 3) float array
        Metres.
    width : float
        beta, metres.
    """
    squared = np.sum((nodes[:, None] - nodes[None]) ** 2, axis=2)
    return np.asarray(np.exp(-squared / (2 * width**2)))


def geodesic_kernel(arc: FloatArray, width: float) -> FloatArray:
    """G_ij = e^(-sqrt(2) d / width) (sqrt(2) width + 2 d) / (4 width^2), d = |s_i - s_j| (Xiang et al., 2023).

    Parameters
    ----------
    arc : (M,) float array
        Places of the nodes along the rope, metres.
    width : float
        beta, metres.
    """
    apart = np.abs(arc[:, None] - arc[None])
    return np.asarray(np.exp(-np.sqrt(2) * apart / width) * (np.sqrt(2) * width + 2 * apart) / (4 * width**2))
