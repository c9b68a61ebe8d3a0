"""What real depth cameras do to exact depth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def kinect_axial(
    depth: NDArray[np.float32], rng: np.random.Generator, lost_edges: float = 0.5, step: float = 0.001
) -> NDArray[np.uint16]:
    """Axial noise, missing returns at edges and quantisation, as a Kinect shows them.

    The noise is normal with the standard deviation 1.2 mm + 1.9 mm/m^2 (z - 0.4 m)^2 (Nguyen, Izadi and Lovell,
    "Modeling Kinect sensor noise for improved 3D reconstruction and tracking", 3DIMPVT 2012, their equation for
    surfaces seen head on).

    Parameters
    ----------
    depth : (H, W) float32 array
        Exact planar depth, metres; 0 is no surface.
    rng : numpy.random.Generator
        The source of the noise.
    lost_edges : float
        Share of the pixels next to a step in depth (5 cm or more, or to nothing) that give no return.
    step : float
        Quantisation, metres.

    Returns
    -------
    (H, W) uint16 array
        Depth in units of `step`; 0 where there is no return.
    """
    rows, columns = np.flatnonzero(depth.any(axis=1)), np.flatnonzero(depth.any(axis=0))
    noisy = np.zeros(depth.shape, np.uint16)
    if not len(rows):
        return noisy
    # Only the window that holds surfaces is worked on: a rope fills little of an image.
    window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    z = depth[window].astype(float)
    around = np.pad(z, 1)
    steps = [
        np.abs(other - z) > 0.05 for other in (around[:-2, 1:-1], around[2:, 1:-1], around[1:-1, :-2], around[1:-1, 2:])
    ]
    edge = np.logical_or.reduce(steps)
    seen = (z > 0) & ~(edge & (rng.random(z.shape) < lost_edges))
    z += rng.standard_normal(z.shape) * (0.0012 + 0.0019 * (z - 0.4) ** 2)
    noisy[window] = np.where(seen, np.clip(np.round(z / step), 0, 65535), 0).astype(np.uint16)
    return noisy
