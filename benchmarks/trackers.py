"""Time and error of every tracker on simulated ropes, beside the figures of a trial of the authors' own programs.

    python benchmarks/trackers.py                       # all methods on all motions
    python benchmarks/trackers.py --methods cpd,spr     # some

A rope of 0.7 m, 15 mm thick, 640x480 depth with 1 mm of noise, started from the true shape where a method takes one;
one thread. Errors are from the nodes (of slicing and persistent: from the waypoints) to the true curve, mm: the mean;
and of the waypoints at equal arc length, which sees a hidden end. Frames that are lost count for no error: they are
counted.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import time
from collections.abc import Iterator

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import numpy as np

from ropetrace.config import RopeConfig
from ropetrace.config_methods import SchulmanConfig, TrackDloConfig
from ropetrace.errors import RopetraceError
from ropetrace.evaluation.metrics import at_equal_arc_length, distances_to_curve, is_reversed, node_errors
from ropetrace.sim.camera import Capsules, RayCaster, Scene
from ropetrace.sim.rope import RopeModel
from ropetrace.sim.scenario import ROPE_COLOR, CameraSettings, ClutterSettings, Scenario, SimulatedScene, load_scenario
from ropetrace.trackers import METHODS, make_tracker
from ropetrace.types import FloatArray, Intrinsics, RgbdFrame, Status

NODES = 45
SELF_STARTING = ("slicing", "persistent")
"""Methods that take no nodes to start from."""
TRACKDLO_50 = "trackdlo-50mm"
"""TrackDLO with `visible_within` = 50 mm."""
SCHULMAN_45 = "schulman-45"
"""Schulman et al. with the trial's 45 nodes in the place of the published 100."""

NOISE = 0.001
ROPE = RopeModel(links=35, link_length=0.02, radius=0.0075, link_mass=0.004, smooth=True)
CAMERA = CameraSettings(position=(0.0, -0.9, 0.6), look_at=(0.0, 0.0, 0.6), exact_depth=True)
BOARD = ClutterSettings(boxes=((0.0, -0.2, 0.317, 0.8, 0.01, 0.24),))
"""Before the last fifth of the rope."""

TRIAL = {
    "slicing": {},
    "cpd": {"swing": (4.5, 0.52), "tip hidden": (5.0, 0.60), "loop": (6.0, 0.92)},
    "gltp": {"swing": (14.0, 0.84), "tip hidden": (10.0, 0.95), "loop": (5.0, 0.90)},
    "spr": {"swing": (19.0, 0.51), "tip hidden": (24.0, 0.60), "loop": (22.0, 0.91)},
    "trackdlo": {"swing": (46.0, 1.7), "tip hidden": (41.0, 8.7), "loop": (20.0, 0.66)},
    TRACKDLO_50: {"swing": (22.0, 0.77), "tip hidden": (17.0, 9.1), "loop": (20.0, 0.66)},
    "cdcpd": {"swing": (5.0, 2.2), "tip hidden": (5.0, 10.0), "loop": (7.0, 2.9)},
    SCHULMAN_45: {"swing": (5.0, 5.5), "tip hidden": (4.0, 16.0), "loop": (5.0, 3.9)},
}
"""ms and mm of the trial; of Schulman et al. with 10 iterations. Its errors are those after one constant shift along
the view, all with 45 nodes."""

View = tuple[RgbdFrame, FloatArray]


def swinging(count: int, speed: float = 1.0, clutter: ClutterSettings | None = None) -> Iterator[View]:
    """Frames of the rope in a wind to and fro at its resonance, once it swings, and the true curves."""
    scenario = dataclasses.replace(
        load_scenario("swing"),
        rope=ROPE,
        camera=dataclasses.replace(CAMERA, rate=30 / speed),
        clutter=clutter or ClutterSettings(),
        duration=(count + 90 / speed) * speed / 30,
    )
    yield from noisy(scenario, round(90 / speed))


def noisy(scenario: Scenario, skipped: int) -> Iterator[View]:
    """The frames of a scenario after the first ones, with normal noise in depth."""
    rng = np.random.default_rng(0)
    for index, (frame, truth) in enumerate(SimulatedScene(scenario).frames()):
        if index >= skipped:
            yield with_noise(frame, rng), truth.polyline


def with_noise(frame: RgbdFrame, rng: np.random.Generator) -> RgbdFrame:
    """The frame with normal noise where there is depth."""
    noise = rng.normal(0, NOISE, frame.depth.shape).astype(np.float32)
    return dataclasses.replace(frame, depth=np.where(frame.depth > 0, frame.depth + noise, np.float32(0)))


def looped(count: int) -> Iterator[View]:
    """Frames of a rope in a loop that crosses itself, swaying a little, and the true curves."""
    camera = Intrinsics(640, 480, 554.3, 554.3, 319.5, 239.5)
    caster = RayCaster(camera)
    rng = np.random.default_rng(0)
    turn, run = np.linspace(0, 2 * np.pi, 200), np.linspace(-0.16, 0, 80)
    x = np.concatenate([run, 0.06 * np.sin(turn), -run[::-1]])
    y = np.concatenate([np.zeros(80), 0.06 * (1 - np.cos(turn)), np.zeros(80)])
    z = np.concatenate([np.full(80, 0.9), 0.9 + 0.024 * turn / (2 * np.pi), np.full(80, 0.924)])
    for index in range(count):
        sway = 0.03 * np.sin(2 * np.pi * 0.4 * index / 30)
        curve = np.stack([x + sway * np.cos(3 * y), y + 0.2 * sway * np.sin(6 * x), z + sway * x], axis=1)
        image = caster.render(Scene(Capsules.along(curve, ROPE.radius, ROPE_COLOR)))
        frame = RgbdFrame(index * 33_333_333, image.depth.copy(), 1.0, camera, image.color.copy())
        yield with_noise(frame, rng), curve


def run(method: str, views: list[View]) -> str:
    """A row of the table: ms and mm of one method on the frames."""
    config = RopeConfig(2 * ROPE.radius, "#{:02x}{:02x}{:02x}".format(*ROPE_COLOR), method=method.partition("-")[0])
    if method == TRACKDLO_50:
        config = dataclasses.replace(config, trackdlo=TrackDloConfig(visible_within=0.05))
    if method == SCHULMAN_45:
        config = dataclasses.replace(config, schulman=SchulmanConfig(nodes=NODES))
    start = at_equal_arc_length(views[0][1], NODES)
    tracker = make_tracker(config, nodes=None if method in SELF_STARTING else start)
    tracker.update(views[0][0])
    tracker.reset()
    seconds, off, along, statuses = [], [], [], []
    step = 0
    for frame, curve in views:
        before = time.process_time()
        estimate = tracker.update(frame)
        seconds.append(time.process_time() - before)
        statuses.append(estimate.status)
        if estimate.status is Status.LOST:
            continue
        nodes = estimate.waypoints.positions if method in SELF_STARTING else estimate.nodes
        off.append(distances_to_curve(nodes, curve).mean())
        # Which end is the start is for a method that starts by itself to choose, but once.
        if not step:
            step = -1 if method in SELF_STARTING and is_reversed(estimate.waypoints.positions, curve) else 1
        along.append(node_errors(estimate.waypoints.positions[::step], curve).mean())
    lost = statuses.count(Status.LOST)
    degraded = statuses.count(Status.DEGRADED)
    p50, p99 = np.percentile(np.array(seconds) * 1e3, [50, 99])
    mean = np.mean(off) * 1e3 if off else np.nan
    equal = np.mean(along) * 1e3 if along else np.nan
    return f"{p50:7.1f} {p99:7.1f}   {mean:7.2f}   {equal:7.1f}   {degraded:5d} {lost:5d}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--methods", help="separated by commas; all by default")
    parser.add_argument("--frames", type=int, default=120, help="of each motion")
    options = parser.parse_args()
    methods = options.methods.split(",") if options.methods else [*METHODS, TRACKDLO_50, SCHULMAN_45]
    motions = {
        "swing": list(swinging(options.frames)),
        "fast swing": list(swinging(options.frames, 2.5)),
        "tip hidden": list(swinging(options.frames, 1.0, BOARD)),
        "loop": list(looped(options.frames)),
    }
    for name, views in motions.items():
        shares = [np.count_nonzero(frame.depth) for frame, _ in views]
        print(f"{name}: {len(views)} frames, {np.mean(shares):.0f} pixels with depth")
        print("  method             p50 ms  p99 ms   mean mm  equal mm   degr.  lost   trial: ms / mm")
        for method in methods:
            try:
                row = run(method, views)
            except (RopetraceError, ImportError) as error:
                print(f"  {method:16s}   not run: {error}")
                continue
            trial = TRIAL.get(method, {}).get(name)
            print(f"  {method:16s}  {row}   {'' if trial is None else f'{trial[0]:g} / {trial[1]:g}'}")


if __name__ == "__main__":
    main()
