"""Ropes, cameras and clouds for the tests of the tracker, and where the real recordings lie."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from ropetrace.sim.camera import Capsules, Plane, RayCaster, Scene
from ropetrace.sim.noise import kinect_axial
from ropetrace.types import FloatArray, Intrinsics, RgbdFrame

SMALL = Intrinsics(480, 360, 415.7, 415.7, 239.5, 179.5)
LARGE = Intrinsics(1280, 720, 1108.5, 1108.5, 639.5, 359.5)
RED = (200, 40, 30)
RED_TEXT = "#c8281e"

DATA = Path(os.environ.get("ROPETRACE_DATA", Path(__file__).parents[2] / "shared" / "data"))
needs_data = pytest.mark.skipif(
    not (DATA / "MANIFEST.json").is_file(), reason=f"no recorded data in {DATA}: set ROPETRACE_DATA to their folder"
)


def seen(
    curve: FloatArray,
    radius: float = 0.006,
    camera: Intrinsics = SMALL,
    stamp_ns: int = 0,
    noise: np.random.Generator | None = None,
    planes: tuple[Plane, ...] = (),
    more: Capsules | None = None,
) -> RgbdFrame:
    """What a camera sees of a red tube along a curve; exact float depth, or what a Kinect makes of it."""
    capsules = Capsules.along(curve, radius, RED)
    image = RayCaster(camera).render(Scene(capsules if more is None else capsules + more, planes))
    if noise is None:
        return RgbdFrame(stamp_ns, image.depth, 1.0, camera, image.color)
    return RgbdFrame(stamp_ns, kinect_axial(image.depth, noise), 0.001, camera, image.color)


def straight(middle: tuple[float, float, float], direction: tuple[float, float, float], length: float) -> FloatArray:
    """The two ends of a straight rope."""
    half = np.array(direction) / np.linalg.norm(direction) * length / 2
    return np.array([np.array(middle) - half, np.array(middle) + half])


def _parametric(function: Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]) -> FloatArray:
    curve = np.stack(np.broadcast_arrays(*function(np.linspace(0, 1, 2001))), axis=1)
    return curve - curve.mean(axis=0) + [0.0, 0.0, 1.0]


def _hairpin() -> FloatArray:
    """Two straight legs of 30 cm, 4 cm apart, and the half circle that joins them."""
    turn = np.linspace(0, np.pi, 400)
    leg = np.linspace(0, 0.3, 800)
    x = np.concatenate([np.full(800, -0.02), -0.02 * np.cos(turn), np.full(800, 0.02)])
    y = np.concatenate([leg, 0.3 + 0.02 * np.sin(turn), leg[::-1]])
    return np.stack([x, y - 0.15, np.ones_like(x)], axis=1)


def _crossing_loop() -> FloatArray:
    """A straight run, a loop of 8 cm radius, and a straight run on: the strands cross 2.4 cm above each other."""
    turn = np.linspace(0, 2 * np.pi, 1000)
    run = np.linspace(-0.3, 0, 600)
    x = np.concatenate([run, 0.08 * np.sin(turn), -run[::-1]])
    y = np.concatenate([np.zeros(600), 0.08 * (1 - np.cos(turn)), np.zeros(600)])
    z = np.concatenate([np.ones(600), 1 + 0.024 * turn / (2 * np.pi), np.full(600, 1.024)])
    return np.stack([x, y, z], axis=1)


SHAPES: dict[str, FloatArray] = {
    "hanging": _parametric(lambda t: (0.05 * np.sin(np.pi * t), 0.6 * t, 0.03 * t)),
    "s": _parametric(lambda t: (0.1 * np.sin(2 * np.pi * t), 0.5 * t, 0 * t)),
    "hairpin": _hairpin(),
    "crossing loop": _crossing_loop(),
    "figure 8": _parametric(
        lambda t: (
            0.25 * np.sin(2 * np.pi * (0.06 + 0.88 * t)),
            0.12 * np.sin(4 * np.pi * (0.06 + 0.88 * t)),
            0.015 * np.sin(2 * np.pi * (0.06 + 0.88 * t) + 1),
        )
    ),
    "helix": _parametric(lambda t: (0.08 * np.cos(8 * np.pi * t), 0.4 * t, 0.08 * np.sin(8 * np.pi * t))),
    "flat spiral": _parametric(
        lambda t: ((0.04 + 0.14 * t) * np.cos(6 * np.pi * t), (0.04 + 0.14 * t) * np.sin(6 * np.pi * t), 0 * t)
    ),
    "horizontal": _parametric(lambda t: (0.7 * t, 0 * t, 0.05 * t)),
    "open circle": _parametric(
        lambda t: (0.15 * np.cos(2 * np.pi * 0.93 * t), 0.15 * np.sin(2 * np.pi * 0.93 * t), 0 * t)
    ),
}
"""Curves about a metre before the camera, (K, 3), metres."""


def at_equal_length(curve: FloatArray, count: int) -> FloatArray:
    """Points at equal parts of a curve's length."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    places = np.linspace(0, length[-1], count)
    return np.stack([np.interp(places, length, curve[:, axis]) for axis in range(3)], axis=1)


def worst_at_equal_length(estimate: FloatArray, truth: FloatArray) -> float:
    """The largest distance of points at equal parts of both lengths, either way round: sees a wrong order."""
    a, b = at_equal_length(estimate, 200), at_equal_length(truth, 200)
    return float(min(np.linalg.norm(a - b, axis=1).max(), np.linalg.norm(a - b[::-1], axis=1).max()))


def same_set(a: FloatArray, b: FloatArray, tolerance: float = 1e-9) -> bool:
    """Whether two sets of points are the same in some order."""
    if len(a) != len(b):
        return False
    if not len(a):
        return True
    distances = np.linalg.norm(a[:, None] - b[None], axis=2)
    return bool(distances.min(axis=0).max() <= tolerance and distances.min(axis=1).max() <= tolerance)


def random_rotation(rng: np.random.Generator) -> FloatArray:
    """A rotation matrix, evenly distributed."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def rope_cloud(rng: np.random.Generator, count: int, radius: float = 0.006) -> FloatArray:
    """(3, N) points in general position round a random smooth curve about a metre away."""
    t = rng.random(count)
    waves = rng.normal(0, 0.1, (3, 3))
    curve = sum(waves[k][:, None] * np.cos((k + 1) * np.pi * t) for k in range(3))
    return np.asarray(curve + rng.normal(0, radius / 2, (3, count)) + np.array([[0.0], [0.0], [1.0]]))


Indices = NDArray[np.int64]
