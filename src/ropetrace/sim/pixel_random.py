"""Random numbers that belong to a pixel: a hash of a key and the pixel's number.

What a pixel draws depends on nothing else: not on the part of the image that is worked on, nor on the order of work.
The hash is SplitMix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014), taken at
the pixel's place of the sequence.
"""

from __future__ import annotations

from statistics import NormalDist
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ropetrace.types import FloatArray

_CELLS = 2048


def keys(rng: np.random.Generator, count: int) -> NDArray[np.uint64]:
    """Keys of `count` independent fields of random numbers, (count,)."""
    return rng.integers(0, 2**64, count, dtype=np.uint64)


def _normal_quantiles() -> FloatArray:
    """The normal distribution's inverse at 2049 even probabilities, with the ends where the variance is 1.

    Between two of them the deviate is spread evenly; the ends come out at 3.8.
    """
    inner = np.array([NormalDist().inv_cdf(k / _CELLS) for k in range(1, _CELLS)])
    variance = (inner[1:] ** 2 + inner[1:] * inner[:-1] + inner[:-1] ** 2).sum() / 3
    # The two outer cells hold what is left: 2 (e^2 + e a + a^2) / 3, a the last inner quantile, e the end.
    a, left = inner[-1], 1.5 * (_CELLS - variance)
    end = (-a + np.sqrt(a * a - 4 * (a * a - left))) / 2
    return np.concatenate([[-end], inner, [end]])


NORMAL_QUANTILES = _normal_quantiles()
"""For `normal`: (2049,)."""

FARTHEST_NORMAL = float(NORMAL_QUANTILES[-1])
"""No deviate is larger."""


@njit(cache=True, nogil=True, error_model="numpy")
def pixel_bits(key: Any, index: int) -> Any:
    """64 random bits."""
    bits = key + (np.uint64(index) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))


@njit(cache=True, nogil=True, error_model="numpy")
def uniform(key: Any, index: int) -> float:
    """Even between 0 (included) and 1 (not)."""
    return np.float64(pixel_bits(key, index) >> np.uint64(11)) * 2.0**-53


@njit(cache=True, nogil=True, error_model="numpy")
def normal(key: Any, index: int, quantiles: Any) -> float:
    """Normal with mean 0 and deviation 1, by the tabulated inverse of its distribution."""
    bits = pixel_bits(key, index)
    cell = np.int64(bits >> np.uint64(53))
    part = np.float64((bits >> np.uint64(11)) & np.uint64((1 << 42) - 1)) * 2.0**-42
    return quantiles[cell] + part * (quantiles[cell + 1] - quantiles[cell])
