"""Depth views rendered round real motion capture: the rope's shape against the truth.

    python benchmarks/mocap.py --sequences 10

The markers of ../shared/data/deform_mocap (or $ROPETRACE_DATA) are joined by a spline, which is the true curve; a tube
of 12 mm round it is seen by a 640x480 camera 1.25 m away, with a Kinect-like noise. Semi-synthetic: real motion, an
ideal sensor with a published noise.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np

from ropetrace import RgbdFrame, RopeConfig, Status, make_tracker
from ropetrace.evaluation.metrics import coverage, distances_to_curve, resample, symmetric_mean
from ropetrace.sim.camera import Capsules, RayCaster, Scene
from ropetrace.sim.noise import kinect_axial
from ropetrace.suite.recorded import CAMERA, mocap_curves
from ropetrace.types import FloatArray

RADIUS = 0.006


def frames(curves: FloatArray, times: FloatArray, seed: int, noise: bool = True) -> Iterator[RgbdFrame]:
    """What the camera sees of each curve."""
    rng = np.random.default_rng(seed)
    caster = RayCaster(CAMERA)
    for curve, time in zip(curves, times, strict=True):
        image = caster.render(Scene(Capsules.along(curve, RADIUS)))
        stamp = round(time * 1e9)
        if noise:
            yield RgbdFrame(stamp, kinect_axial(image.depth, rng), 0.001, CAMERA, image.color.copy())
        else:
            yield RgbdFrame(stamp, image.depth.copy(), 1.0, CAMERA, image.color.copy())


def measure(rope: int, sequence: int, every: int, noise: bool = True) -> list[tuple[float, float, float, bool, Status]]:
    """Per frame: symmetric mean, coverage within 10 mm, paper's one-way error, swapped ends, status."""
    times, curves = mocap_curves(rope, sequence, every)
    tracker = make_tracker(RopeConfig(diameter=2 * RADIUS, color="#c8281e"))
    rows = []
    first_end: int | None = None
    for frame, curve in zip(frames(curves, times, 1000 * rope + sequence, noise), curves, strict=True):
        estimate = tracker.update(frame)
        line = estimate.waypoints.positions
        if len(line) < 2:
            rows.append((np.nan, 0.0, np.nan, False, estimate.status))
            continue
        end = int(np.linalg.norm(line[0] - curve[0]) > np.linalg.norm(line[0] - curve[-1]))
        first_end = end if first_end is None else first_end
        truth = resample(curve, 0.001)
        rows.append(
            (
                symmetric_mean(line, truth),
                coverage(line, truth, 0.010),
                float(distances_to_curve(line, truth).mean()),
                end != first_end,
                estimate.status,
            )
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--sequences", type=int, default=10, help="sequences of each rope")
    parser.add_argument("--every", type=int, default=3, help="use every k-th frame of the 100 Hz (3: 33 fps)")
    parser.add_argument("--exact", action="store_true", help="without sensor noise")
    options = parser.parse_args()
    print("rope sequence frames symmetric_mm worst_mm one_way_mm coverage worst swaps lost degraded")
    total = []
    for rope in (1, 2):
        for sequence in range(options.sequences):
            rows = measure(rope, sequence, options.every, not options.exact)
            total += rows
            _print(f"{rope} {sequence}", rows)
    _print("all -", total)


def _print(name: str, rows: list[tuple[float, float, float, bool, Status]]) -> None:
    symmetric, covered, one_way = (np.array([row[k] for row in rows], float) for k in (0, 1, 2))
    statuses = [row[4] for row in rows]
    print(
        name,
        len(rows),
        f"{np.nanmean(symmetric) * 1e3:.3f} {np.nanmax(symmetric) * 1e3:.2f} {np.nanmean(one_way) * 1e3:.3f}",
        f"{covered.mean():.4f} {covered.min():.3f}",
        sum(row[3] for row in rows),
        statuses.count(Status.LOST),
        statuses.count(Status.DEGRADED),
        flush=True,
    )


if __name__ == "__main__":
    main()
