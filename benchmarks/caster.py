"""Frames a second of the simulated camera on one core: the ray caster, and each noise on top.

    python benchmarks/caster.py

A rope of ten links at 1 m, alone and before a wall above a floor. Rendering is the exact images; a frame is all that
`DepthCamera.expose` does: images, noise, depth in millimetres, copies. p50 and p99 of many.
"""

from __future__ import annotations

import argparse
import math
import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"

import time
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from ropetrace.sim.camera import Capsules, DepthCamera, Plane, Scene, looking_at
from ropetrace.sim.noise import NOISE_MODELS, noise_model
from ropetrace.sim.visibility import visible_fraction
from ropetrace.types import FloatArray

POSE = looking_at((0.0, -1.0, 0.675), (0.0, 0.0, 0.675))
WALL = Plane((0.0, 1.0, 0.0), 0.5, (176, 170, 158), 1)
FLOOR = Plane((0.0, 0.0, 1.0), 0.3, (120, 110, 100), 2)
RADIUS = 0.0075


def rope(seconds: float) -> FloatArray:
    """(11, 3) joints of a rope of 0.55 m that hangs from 0.95 m and swings."""
    angle = 0.5 * math.sin(2 * math.pi * 0.8 * seconds) * np.linspace(0.3, 1, 10)
    steps = 0.055 * np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], axis=1)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]) + [0, 0, 0.95]


def milliseconds(work: Callable[[int], object], count: int) -> FloatArray:
    """Time of each call, after a few that do not count."""
    for index in range(3):
        work(index)
    times = np.empty(count)
    for index in range(count):
        start = time.perf_counter()
        work(index)
        times[index] = time.perf_counter() - start
    return times * 1e3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--frames", type=int, default=300)
    options = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    scenes: dict[str, tuple[Plane, ...]] = {"rope": (), "rope, wall, floor": (WALL, FLOOR)}
    print("camera    scene              work                   p50 ms   p99 ms  frames/s")
    for width, height in ((480, 360), (1280, 720)):
        for name, planes in scenes.items():

            def scene_at(seconds: float, planes: tuple[Plane, ...] = planes) -> Scene:
                return Scene(Capsules.along(rope(seconds), RADIUS), planes)

            camera = DepthCamera(width, height, math.radians(60), 60, POSE)
            works: dict[str, Callable[[int], object]] = {
                "rendering": lambda k, camera=camera, at=scene_at: camera.render(at(k / 60))  # type: ignore[misc]
            }
            for model in NOISE_MODELS:
                unit = None if model == "none" else 0.001
                noisy = DepthCamera(
                    width, height, math.radians(60), 60, POSE, noise_model(model), depth_unit=unit, seed=1
                )
                works[f"frame, {model}"] = lambda k, camera=noisy, at=scene_at: camera.expose(at, k / 60, k)  # type: ignore[misc]
            blurred = DepthCamera(width, height, math.radians(60), 60, POSE, exposure=0.008, motion_blur=True)
            works["frame, motion blur"] = lambda k, camera=blurred, at=scene_at: camera.expose(at, k / 60, k)  # type: ignore[misc]
            for work, function in works.items():
                times = milliseconds(function, options.frames)
                p50, p99 = np.percentile(times, [50, 99])
                print(
                    f"{f'{width}x{height}':9s} {name:18s} {work:22s} {p50:6.2f} {p99:8.2f} {1e3 / p50:9.0f}", flush=True
                )
    joints = rope(0.3)
    points = np.concatenate([np.linspace(a, b, 20, endpoint=False) for a, b in pairwise(joints)])
    scene = Scene(Capsules.along(joints, RADIUS), (WALL, FLOOR))
    lens = DepthCamera(1280, 720, math.radians(60), 60).intrinsics
    times = milliseconds(lambda _: visible_fraction(scene, lens, points, RADIUS, 0, POSE), options.frames)
    print(f"visible fraction, {len(points)} samples: p50 {np.median(times):.2f} ms")


if __name__ == "__main__":
    main()
