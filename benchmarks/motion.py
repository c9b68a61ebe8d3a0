"""Velocities and predictions of the waypoints against the truth, for every method of motion.

    python benchmarks/motion.py

(a) Motion capture as in mocap.py, 33 frames a second with a Kinect-like noise: the centreline that is predicted 40 ms
ahead against the true curve of that time. Every frame counts; one without a prediction counts as it was seen.
(b) A simulated rope in a wind at its resonance, 0.8 Hz: velocities against those of the joints.
(c) The same rope at rest: what velocities and accelerations are left, beside the sigma that is reported.
(d) The time of an update and of a prediction with 100 waypoints.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mocap import RADIUS, frames
from ropetrace import RopeConfig, make_tracker
from ropetrace.config import format_color
from ropetrace.evaluation.metrics import is_reversed, node_errors, symmetric_mean
from ropetrace.motion import METHODS
from ropetrace.sim.rope import Wind
from ropetrace.sim.scenario import ROPE_COLOR, CameraSettings, Scenario, SimulatedScene
from ropetrace.suite.recorded import data_folder, mocap_curves
from ropetrace.types import FloatArray, Motion, Waypoints

AHEAD = 0.04
"""Of the predictions of motion capture, seconds: four of its samples."""

RATE = 100
"""Samples of motion capture a second."""

WARM_UP = 10
"""Frames until velocities are measured in the simulation."""


def captured(sequences: int) -> list[tuple[FloatArray, list[tuple[int, Waypoints, int]]]]:
    """Per sequence of both ropes: its true curves at 100 Hz, and the waypoints of every third with its index."""
    result = []
    for rope in (1, 2):
        for sequence in range(sequences):
            times, curves = mocap_curves(rope, sequence, 1)
            tracker = make_tracker(RopeConfig(diameter=2 * RADIUS, color="#c8281e"))
            seen = []
            images = frames(curves[::3], times[::3], 1000 * rope + sequence)
            for index, frame in zip(range(0, len(curves), 3), images, strict=True):
                waypoints = tracker.update(frame).waypoints
                if len(waypoints):
                    seen.append((frame.stamp_ns, waypoints, index))
            result.append((curves, seen))
    return result


def prediction_errors(method: str, recording: list[tuple[FloatArray, list[tuple[int, Waypoints, int]]]]) -> FloatArray:
    """Per frame: symmetric mean and node error, as seen and as predicted, metres; squared normalised error."""
    rows = []
    for curves, seen in recording:
        estimator = METHODS[method](2 * RADIUS)
        for stamp, waypoints, index in seen:
            estimator.update(stamp, waypoints)
            then = index + round(AHEAD * RATE)
            if then >= len(curves):
                break
            truth = curves[then][::-1] if is_reversed(waypoints.positions, curves[index]) else curves[then]
            prediction = estimator.predict(AHEAD)
            line = waypoints.positions if prediction is None else prediction[0]
            score = np.nan
            if prediction is not None:
                matched = _at_equal_length(truth, len(line))
                score = float(np.mean(((line - matched) / prediction[1].position_sigma) ** 2))
            rows.append(
                (
                    symmetric_mean(waypoints.positions, truth, 0.002),
                    symmetric_mean(line, truth, 0.002),
                    node_errors(waypoints.positions, truth).mean(),
                    node_errors(line, truth).mean(),
                    score,
                )
            )
    return np.array(rows)


def _at_equal_length(curve: FloatArray, count: int) -> FloatArray:
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    places = np.linspace(0, length[-1], count)
    return np.stack([np.interp(places, length, curve[:, axis]) for axis in range(3)], axis=1)


Observed = list[tuple[int, Waypoints, FloatArray]]
"""Stamp, waypoints and their true velocities, (W, 3), m/s, of each frame; camera frame."""


def simulated(frequency: float, noise: str, seconds: float) -> tuple[Observed, float]:
    """A rope in a wind, and its diameter."""
    camera = CameraSettings(480, 360, noise=noise, exact_depth=noise == "none")
    scene = SimulatedScene(replace(Scenario(), duration=seconds, wind=Wind(frequency), camera=camera))
    diameter = 2 * scene.scenario.rope.radius
    tracker = make_tracker(RopeConfig(diameter, format_color(ROPE_COLOR)))
    camera_from_world = scene.world_from_camera[:3, :3].T
    seen: Observed = []
    for frame, truth in scene.frames():
        waypoints = tracker.update(frame).waypoints
        if not len(waypoints):
            continue
        # A straight link's centre moves as the mean of its joints; the first joint is pinned.
        joints = [np.zeros(3)]
        for link in truth.state.velocities:
            joints.append(2 * link - joints[-1])
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth.polyline, axis=0), axis=1))])
        moving = np.array(joints) @ camera_from_world.T
        if is_reversed(waypoints.positions, truth.polyline):
            length, moving = length[-1] - length[::-1], moving[::-1]
        places = waypoints.arc_length / waypoints.length * length[-1]
        velocities = np.stack([np.interp(places, length, moving[:, axis]) for axis in range(3)], axis=1)
        seen.append((frame.stamp_ns, waypoints, velocities))
    return seen, diameter


def followed(method: str, seen: Observed, diameter: float) -> list[tuple[Motion, FloatArray]]:
    """The motion of each frame after the first, and the true velocities."""
    estimator = METHODS[method](diameter)
    motions = [(estimator.update(stamp, waypoints), truth) for stamp, waypoints, truth in seen]
    return [(motion, truth) for motion, truth in motions[WARM_UP:] if motion is not None]


def rms(vectors: FloatArray) -> float:
    """Root mean square length of vectors, (N, 3)."""
    return float(np.sqrt(np.mean(np.sum(np.square(vectors), axis=1))))


def timed(method: str, seconds: int) -> tuple[FloatArray, FloatArray]:
    """Microseconds of each update and prediction of a rope of 0.6 m that swings, 100 waypoints."""
    places = np.linspace(0, 0.594, 100)
    estimator = METHODS[method](2 * RADIUS)
    spent: tuple[list[float], list[float]] = ([], [])
    rng = np.random.default_rng(0)
    for index in range(30 * seconds):
        bend = 0.1 * np.sin(5 * index / 30 - 3 * places) * places
        positions = np.stack([bend, places, 1 + 0 * places], axis=1) + rng.normal(0, 2e-4, (100, 3))
        waypoints = Waypoints(positions, np.tile([0.0, 0, 0, 1], (100, 1)), places)
        calls: tuple[Callable[[], object], ...] = (
            lambda index=index, waypoints=waypoints: estimator.update(index * 33_333_333, waypoints),  # type: ignore[misc]
            lambda: estimator.predict(AHEAD),
        )
        for call, times in zip(calls, spent, strict=True):
            start = time.perf_counter()
            call()
            times.append((time.perf_counter() - start) * 1e6)
    return np.array(spent[0][30:]), np.array(spent[1][30:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--sequences", type=int, default=10, help="sequences of each rope of motion capture")
    parser.add_argument("--seconds", type=int, default=20, help="of each simulation")
    parser.add_argument("--quick", action="store_true", help="one sequence and 5 s")
    options = parser.parse_args()
    sequences, seconds = (1, 5) if options.quick else (options.sequences, options.seconds)

    if data_folder().is_dir():
        recording = captured(sequences)
        print("(a) predicted 40 ms ahead, motion capture; mm")
        print("method      frames error      what       mean  median     p95   worst  NEES_median NEES_mean")
        for method in METHODS:
            rows = prediction_errors(method, recording)
            for column, (error, what) in enumerate(
                (error, what) for error in ("symmetric", "node") for what in ("as_seen", "predicted")
            ):
                values = rows[:, column] * 1e3
                figures = (values.mean(), np.median(values), np.percentile(values, 95), values.max())
                nees = f"{np.nanmedian(rows[:, 4]):12.2f} {np.nanmean(rows[:, 4]):9.2f}" if what == "predicted" else ""
                print(
                    f"{method:11s} {len(rows):6d} {error:10s} {what:9s}" + "".join(f"{v:8.2f}" for v in figures), nees
                )
    else:
        print(f"(a) left out: no recorded data in {data_folder()}, set ROPETRACE_DATA to their folder")

    for title, frequency in (("(b) swing at 0.8 Hz", 0.8), ("(c) at rest", 0.0)):
        print(f"\n{title}; velocities m/s, accelerations m/s^2")
        print("noise      method      rms_true  rms_error    p95  worst  sigma_v  rms_acceleration  sigma_a")
        for noise in ("none", "kinect_v1"):
            seen, diameter = simulated(frequency, noise, seconds)
            for method in METHODS:
                motions = followed(method, seen, diameter)
                off = np.concatenate([motion.velocities - truth for motion, truth in motions])
                size = np.linalg.norm(off, axis=1)
                print(
                    f"{noise:10s} {method:11s} {rms(np.concatenate([truth for _, truth in motions])):8.4f} "
                    f"{rms(off):10.4f} {np.percentile(size, 95):6.3f} {size.max():6.3f} "
                    f"{rms(np.concatenate([motion.velocity_sigma for motion, _ in motions])):8.4f} "
                    f"{rms(np.concatenate([motion.accelerations for motion, _ in motions])):17.3f} "
                    f"{rms(np.concatenate([motion.acceleration_sigma for motion, _ in motions])):8.3f}"
                )

    print(f"\n(d) microseconds with 100 waypoints, {os.cpu_count()} cores")
    print("method      update_p50 update_p99 predict_p50 predict_p99")
    for method in METHODS:
        update, predict = timed(method, 60 if not options.quick else 10)
        spent = [*np.percentile(update, [50, 99]), *np.percentile(predict, [50, 99])]
        print(f"{method:11s}" + "".join(f"{value:11.1f}" for value in spent))


if __name__ == "__main__":
    main()
