"""Time per frame, all stages from the raw images to the waypoints with their quaternions, on one thread.

    python benchmarks/speed.py            # prints the tables, writes docs/figures/speed.png

Times are given as ratios to copying the frame's depth and colour buffers in the same run, frame by frame in turn, since
the machine's speed varies. Every frame is another one, as from a camera, so neither the copy nor the tracker finds its
input in the processor's cache; `--same` uses one frame over and over.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
import tracemalloc
from pathlib import Path

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import numpy as np

from ropetrace import CloudFrame, Intrinsics, RgbdFrame, RopeConfig, make_tracker
from ropetrace.config import SegmentationConfig, SlicingConfig
from ropetrace.errors import import_extra
from ropetrace.sim.camera import Capsules, Plane, RayCaster, Scene
from ropetrace.types import FloatArray

CAMERA = Intrinsics(1280, 720, 1108.5, 1108.5, 639.5, 359.5)
RADIUS = 0.0075
FIGURES = Path(__file__).parents[1] / "docs" / "figures"
BOX = SegmentationConfig(box_min=(-0.55, -0.45, 0.7), box_max=(0.55, 0.45, 1.3))
STAGES = ("segmentation", "slicing", "ordering", "centerline")


def rope_curve(phase: float) -> FloatArray:
    """A waving rope of about 1.1 m, 1 m away."""
    s = np.linspace(0, 1, 300)
    return np.stack([0.22 * np.sin(5 * s + phase), -0.3 + 0.6 * s, 1 + 0.08 * np.cos(7 * s + phase)], axis=1)


def make_frames(count: int) -> list[RgbdFrame]:
    """Different frames of a waving rope before a wall, with noise in depth and colour."""
    rng = np.random.default_rng(0)
    caster = RayCaster(CAMERA)
    frames = []
    for index in range(count):
        image = caster.render(
            Scene(Capsules.along(rope_curve(0.1 * index), RADIUS), (Plane((0.0, 0.0, 1.0), 1.6, (150, 150, 140), 1),))
        )
        depth = np.round(image.depth * 1000 + rng.standard_normal(image.depth.shape)).astype(np.uint16)
        noise = rng.integers(-6, 7, image.color.shape, dtype=np.int16)
        color = np.clip(image.color + noise, 0, 255).astype(np.uint8)
        frames.append(RgbdFrame(index * 16_666_667, depth, 0.001, CAMERA, color))
    return frames


def per_frame(frames: list[RgbdFrame], config: RopeConfig, rounds: int) -> None:
    """Print the time per frame beside that of a copy of its buffers."""
    tracker = make_tracker(config)
    depth, color = np.empty_like(frames[0].depth), np.empty((*frames[0].depth.shape, 3), np.uint8)
    copies, totals = [], []
    stages: dict[str, list[float]] = {stage: [] for stage in STAGES}
    points = 0
    for frame in frames:
        points = tracker.update(frame).point_count
    for index in range(rounds):
        frame = frames[index % len(frames)]
        assert frame.color is not None
        start = time.perf_counter()
        np.copyto(depth, frame.depth)
        np.copyto(color, frame.color)
        copies.append(time.perf_counter() - start)
        frame = frames[(index + len(frames) // 2) % len(frames)]
        start = last = time.perf_counter()

        def lap(stage: str) -> None:
            nonlocal last
            now = time.perf_counter()
            stages[stage].append(now - last)
            last = now

        tracker.update(frame, lap)
        totals.append(time.perf_counter() - start)
    copy = float(np.median(copies))
    print(f"  rope points {points}, frames {rounds}")
    print("  what           p50 ms   p99 ms   p50 / copy")
    for name, seconds in [("copy", copies), *stages.items(), ("whole frame", totals)]:
        p50, p99 = np.percentile(seconds, [50, 99])
        print(f"  {name:13s} {p50 * 1e3:7.3f}  {p99 * 1e3:7.3f}   {p50 / copy:6.2f}")


def allocated(frames: list[RgbdFrame], config: RopeConfig) -> tuple[float, float]:
    """Peak of memory allocated within one warm frame, and what of it the estimate keeps, kB."""
    tracker = make_tracker(config)
    for frame in frames[:5]:
        tracker.update(frame)
    tracemalloc.start()
    kept = []
    peaks = []
    for frame in frames[5:15]:
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        estimate = tracker.update(frame)
        peaks.append(tracemalloc.get_traced_memory()[1] - before)
        kept.append(
            estimate.nodes.nbytes
            + estimate.waypoints.positions.nbytes
            + estimate.waypoints.quaternions.nbytes
            + estimate.waypoints.arc_length.nbytes
        )
    tracemalloc.stop()
    return float(np.median(peaks)) / 1e3, float(np.median(kept)) / 1e3


def visible_surface(count: int, rng: np.random.Generator) -> FloatArray:
    """Points on the near half of the rope's surface, (count, 3)."""
    curve = rope_curve(0.0)
    tangents = np.gradient(curve, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    at = rng.integers(0, len(curve), count)
    jitter = rng.uniform(-0.5, 0.5, (count, 1)) * np.linalg.norm(curve[1] - curve[0])
    view = -curve[at] / np.linalg.norm(curve[at], axis=1, keepdims=True)
    near = view - np.sum(view * tangents[at], axis=1, keepdims=True) * tangents[at]
    near /= np.linalg.norm(near, axis=1, keepdims=True)
    side = np.cross(tangents[at], near)
    across = rng.uniform(-1, 1, (count, 1))
    return curve[at] + tangents[at] * jitter + RADIUS * (across * side + np.sqrt(1 - across**2) * near)


def scaling(largest: int) -> list[tuple[int, float]]:
    """Number of rope points, and time of a whole frame, p50."""
    rng = np.random.default_rng(1)
    rows = []
    count = 1000
    while count <= largest:
        frame = CloudFrame(0, visible_surface(count, rng))
        tracker = make_tracker(RopeConfig(2 * RADIUS, slicing=SlicingConfig(max_points=10_000_000)))
        for _ in range(3):
            tracker.update(frame)
        seconds = []
        for _ in range(max(7, min(200, 2_000_000 // count))):
            start = time.perf_counter()
            tracker.update(frame)
            seconds.append(time.perf_counter() - start)
        rows.append((count, float(np.median(seconds))))
        count = round(count * 10**0.5 / 10) * 10
    return rows


def start_up() -> tuple[float, float]:
    """Seconds from the start of Python to the first estimate: on a fresh machine, and with the compiler's cache."""
    program = (
        "import numpy as np; from ropetrace import CloudFrame, Intrinsics, RgbdFrame, RopeConfig, make_tracker;"
        "d = np.zeros((480, 640), np.uint16); d[100:400, 318:326] = 1000; c = np.full((480, 640, 3), 200, np.uint8);"
        "t = make_tracker(RopeConfig(0.012, '#c8c8c8'));"
        "e = t.update(RgbdFrame(0, d, 0.001, Intrinsics(640, 480, 600, 600, 319.5, 239.5), c)); assert len(e.nodes) > 3"
    )
    seconds = []
    with tempfile.TemporaryDirectory() as cache:
        for _ in range(2):
            start = time.perf_counter()
            subprocess.run([sys.executable, "-c", program], check=True, env={**os.environ, "NUMBA_CACHE_DIR": cache})
            seconds.append(time.perf_counter() - start)
    return seconds[0], seconds[1]


def plot(rows: list[tuple[int, float]], path: Path) -> None:
    """Time against the number of points, with N log N through the point where the fixed costs no longer count."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    counts, seconds = np.array(rows).T
    reference = counts * np.log(counts)
    figure, axes = plt.subplots(figsize=(6, 4))
    axes.loglog(counts, seconds * 1e3, "o-", label="whole frame")
    anchor = min(int(np.searchsorted(counts, 30_000)), len(counts) - 1)
    axes.loglog(counts, reference / reference[anchor] * seconds[anchor] * 1e3, "k:", label="N log N")
    axes.set_xlabel("rope points")
    axes.set_ylabel("time per frame, ms (p50, one thread)")
    axes.grid(which="both", alpha=0.3)
    axes.legend()
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rounds", type=int, default=1000, help="frames to time")
    parser.add_argument("--largest", type=int, default=1_000_000, help="largest cloud")
    parser.add_argument("--same", action="store_true", help="one frame over and over, which stays in the cache")
    options = parser.parse_args()
    import_extra("matplotlib", "sim")
    frames = make_frames(40)
    timed = frames[:1] if options.same else frames
    boxed = RopeConfig(2 * RADIUS, "#c8281e", segmentation=BOX)
    print("1280x720, position box and colour")
    per_frame(timed, boxed, options.rounds)
    print("1280x720, colour alone")
    per_frame(timed, RopeConfig(2 * RADIUS, "#c8281e"), options.rounds)
    peak, kept = allocated(frames, boxed)
    print(f"memory allocated in a frame: {peak:.0f} kB at the peak, of which the estimate keeps {kept:.0f} kB")
    first, second = start_up()
    print(f"start of Python to the first estimate: {first:.1f} s on a fresh machine, {second:.1f} s with the cache")
    rows = scaling(options.largest)
    print("rope points   p50 ms   ns per point")
    for count, seconds in rows:
        print(f"  {count:9d} {seconds * 1e3:8.3f}   {seconds / count * 1e9:8.1f}")
    plot(rows, FIGURES / "speed.png")
    print(f"plot: {FIGURES / 'speed.png'}")


if __name__ == "__main__":
    main()
