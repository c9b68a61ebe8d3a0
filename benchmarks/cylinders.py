"""Noise-free tubes of 15 mm at 1 m: the error of the method itself.

    python benchmarks/cylinders.py

Straight tubes in many positions and directions (the pixel grid cuts each differently) and curved ones, at two
resolutions. The truth reaches to the tips of the tube's round ends.
"""

from __future__ import annotations

import numpy as np

from ropetrace import Intrinsics, RgbdFrame, RopeConfig, make_tracker
from ropetrace.evaluation.metrics import distances_to_curve, resample, symmetric_mean
from ropetrace.sim.camera import Capsules, RayCaster, Scene
from ropetrace.types import FloatArray

RADIUS = 0.0075
CAMERAS = {
    "480x360": Intrinsics(480, 360, 415.7, 415.7, 239.5, 179.5),
    "1280x720": Intrinsics(1280, 720, 1108.5, 1108.5, 639.5, 359.5),
}


def straight(angle: float, offset: float, depth_angle: float = 0.0) -> FloatArray:
    """A tube's axis of 0.5 m: angle from the vertical in the image, angle out of the image plane, sideways offset."""
    direction = np.array(
        [np.sin(angle) * np.cos(depth_angle), np.cos(angle) * np.cos(depth_angle), np.sin(depth_angle)]
    )
    side = np.array([np.cos(angle), -np.sin(angle), 0.0])
    middle = np.array([0.0, 0.0, 1.0]) + offset * side
    return np.stack([middle - 0.25 * direction, middle + 0.25 * direction])


def arc(radius: float, offset: float) -> FloatArray:
    """Half a circle of the given radius."""
    angle = np.linspace(0, np.pi, 200)
    return np.stack([radius * np.cos(angle) + offset, radius * np.sin(angle) - 0.1, np.ones(200)], axis=1)


def errors(curve: FloatArray, camera: Intrinsics) -> tuple[float, float]:
    """Symmetric mean, and the mean distance of waypoints to the axis, metres."""
    image = RayCaster(camera).render(Scene(Capsules.along(curve, RADIUS)))
    frame = RgbdFrame(0, image.depth, 1.0, camera, image.color)
    line = make_tracker(RopeConfig(2 * RADIUS, "#c8281e")).update(frame).waypoints.positions
    first, last = curve[0] - curve[1], curve[-1] - curve[-2]
    tips = [curve[0] + RADIUS * first / np.linalg.norm(first), curve[-1] + RADIUS * last / np.linalg.norm(last)]
    truth = resample(np.concatenate([[tips[0]], curve, [tips[1]]]), 0.001)
    return symmetric_mean(line, truth), float(distances_to_curve(line, truth).mean())


def main() -> None:
    rng = np.random.default_rng(0)
    pixel = 1 / 415.7
    shapes: dict[str, list[FloatArray]] = {
        "straight, vertical, centred": [straight(0.0, 0.0)],
        "straight, vertical, any sub-pixel place": [straight(0.0, k / 20 * pixel) for k in range(20)],
        "straight, tilted by 2 to 88 degrees": [
            straight(np.radians(rng.uniform(2, 88)), rng.uniform(-0.05, 0.05)) for _ in range(20)
        ],
        "straight, up to 45 degrees out of the image": [
            straight(rng.uniform(0, np.pi), 0.0, np.radians(rng.uniform(0, 45))) for _ in range(20)
        ],
        "half circles of 8 to 20 cm radius": [arc(rng.uniform(0.08, 0.2), rng.uniform(-0.02, 0.02)) for _ in range(20)],
    }
    print("camera    shape                                          symmetric_mm  worst  one_way_mm")
    for name, camera in CAMERAS.items():
        for shape, curves in shapes.items():
            rows = np.array([errors(curve, camera) for curve in curves]) * 1e3
            print(f"{name:9s} {shape:46s} {rows[:, 0].mean():11.3f} {rows[:, 0].max():7.3f} {rows[:, 1].mean():11.3f}")


if __name__ == "__main__":
    main()
