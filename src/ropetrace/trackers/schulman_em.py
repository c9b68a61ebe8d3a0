"""The two steps of Schulman et al. (ICRA 2013): which node explains which point, and what the points ask of the nodes.

Throughout: N points and K nodes with F features each, x, y, z in metres and perhaps L*, a*, b* in hundreds of units.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ropetrace.types import FloatArray

_SEEN = 1e-3
"""A node less visible than this explains nothing."""

_ROUNDS = 2
"""Of normalising rows and columns."""


def responsibilities(
    points: FloatArray,
    nodes: FloatArray,
    deviations: FloatArray,
    visible: FloatArray,
    prior: FloatArray,
    far: int = 0,
) -> FloatArray:
    """E-step: which share of each point each node explains.

    p_kn = v_k prod_f exp(-(c_nf - m_kf)^2 / 2 sigma_kf^2) / sigma_kf, and one row more for outliers, all of whose
    deviations are the prior's and whose distance is one deviation in every feature. Each column is brought to the sum
    1; then, twice, each row and each column. Rows of nodes that are not visible are 0.

    Parameters
    ----------
    points : (N, F) float array
        Features of the cloud: x, y, z and perhaps L*, a*, b*.
    nodes : (K, F) float array
        The same of the nodes.
    deviations : (K, F) float array
        sigma.
    visible : (K,) float array
        v, 0 to 1.
    prior : (F,) float array
        Deviations of the outliers.
    far : int
        Points that were left out because they are outliers beyond doubt; they count in the sum of the outliers' row.

    Returns
    -------
    (K, N) float array
        Without the outliers.
    """
    shares = np.empty((len(nodes), len(points)))
    _share(points, nodes, deviations, visible, prior, float(far), shares)
    return shares


def maximise(
    points: FloatArray,
    nodes: FloatArray,
    shares: FloatArray,
    prior: FloatArray,
    prior_weight: float,
    deviations: FloatArray,
) -> FloatArray:
    """M-step but for the simulation.

    sigma_kf^2 = (sum_n p_kn (c_nf - m_kf)^2 + nu d_f^2) / (sum_n p_kn + nu).

    Parameters
    ----------
    points, nodes, shares, prior : float array
        As in `responsibilities`; the shares are what it returned.
    prior_weight : float
        nu: as many points as the prior counts for.
    deviations : (K, F) float array
        sigma: overwritten.

    Returns
    -------
    (K, 3) float array
        sum_n p_kn (c_n - m_k), metres.
    """
    pulls = np.empty((len(nodes), 3))
    _maximise(points, nodes, shares, prior, prior_weight, deviations, pulls)
    return pulls


@njit(cache=True, nogil=True)
def _share(points: Any, nodes: Any, deviations: Any, visible: Any, prior: Any, far: float, shares: Any) -> None:
    count, features = points.shape
    outliers = np.empty(count)
    rest = np.exp(-0.5 * features)
    for f in range(features):
        rest /= prior[f]
    for k in range(len(nodes)):
        weight = visible[k]
        for f in range(features):
            weight /= deviations[k, f]
        for n in range(count):
            exponent = 0.0
            for f in range(features):
                exponent += ((points[n, f] - nodes[k, f]) / deviations[k, f]) ** 2
            shares[k, n] = weight * np.exp(-0.5 * exponent)
    outliers[:] = rest
    _columns_to_one(shares, outliers)
    for _ in range(_ROUNDS):
        for k in range(len(nodes)):
            total = shares[k].sum()
            if visible[k] < _SEEN or total <= 0.0:
                shares[k] = 0.0
            else:
                shares[k] /= total
        outliers /= max(outliers.sum() + far, 1e-300)
        _columns_to_one(shares, outliers)


@njit(cache=True, nogil=True)
def _columns_to_one(shares: Any, outliers: Any) -> None:
    for n in range(shares.shape[1]):
        total = outliers[n]
        for k in range(len(shares)):
            total += shares[k, n]
        for k in range(len(shares)):
            shares[k, n] /= total
        outliers[n] /= total


@njit(cache=True, nogil=True)
def _maximise(
    points: Any, nodes: Any, shares: Any, prior: Any, prior_weight: float, deviations: Any, asked: Any
) -> None:
    features = points.shape[1]
    squares, pulls = np.empty(features), np.empty(features)
    for k in range(len(nodes)):
        total = 0.0
        squares[:], pulls[:] = 0.0, 0.0
        for n in range(len(points)):
            share = shares[k, n]
            if share < 1e-12:
                continue
            total += share
            for f in range(features):
                gap = points[n, f] - nodes[k, f]
                squares[f] += share * gap * gap
                pulls[f] += share * gap
        for f in range(features):
            deviations[k, f] = np.sqrt((squares[f] + prior_weight * prior[f] ** 2) / (total + prior_weight))
        for f in range(3):
            asked[k, f] = pulls[f]
