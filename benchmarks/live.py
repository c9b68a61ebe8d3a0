"""The simulator as a live camera: its rate, what is dropped, and the latency from the stamp to the estimate.

    python benchmarks/live.py            # prints a table

The clock of the simulated camera is this machine's, so the latency is exact. The first frames, in which kernels start,
do not count.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from ropetrace import RopeConfig, make_motion, make_tracker
from ropetrace.live import LiveRecording
from ropetrace.live.simulated import SimulatedCamera
from ropetrace.types import BadFrame

WARM_UP = 6


@dataclass(frozen=True)
class Result:
    """What a run came to: frames a second, dropped frames, and latencies in seconds."""

    rate: float
    dropped: int
    latencies: list[float]


def scenario(folder: Path, width: int, height: int, rate: float, noise: str) -> Path:
    """The swinging rope before a camera of this kind."""
    path = folder / f"swing_{width}_{rate:g}_{noise}.toml"
    exact = "true" if noise == "none" else "false"
    path.write_text(
        f"duration = 1.0\n[wind]\nfrequency = 0.8\n[camera]\nwidth = {width}\nheight = {height}\nrate = {rate}\n"
        f'noise = "{noise}"\nexact_depth = {exact}\n'
    )
    return path


def run(path: Path, config: RopeConfig, seconds: float, rate: float, delay: float) -> Result:
    """Track for some seconds, with a pause after each frame."""
    recording = LiveRecording(f"sim:{path}", SimulatedCamera(str(path)))
    tracker, motion = make_tracker(config), make_motion("arc_length", config.diameter)
    assert motion is not None
    latencies, begin, end, dropped = [], 0.0, 0.0, 0
    for index, event in enumerate(islice(recording.frames(), WARM_UP + round(seconds * rate))):
        assert not isinstance(event, BadFrame)
        estimate = tracker.update(event)
        if len(estimate.waypoints):
            motion.update(estimate.stamp_ns, estimate.waypoints)
        latencies.append(recording.age())
        end = time.monotonic()
        if index == WARM_UP - 1:
            begin, dropped = end, recording.dropped
        time.sleep(delay)
    taken = len(latencies) - WARM_UP
    return Result(taken / (end - begin), recording.dropped - dropped, latencies[WARM_UP:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=20.0, help="how long a run is, in frames of the camera")
    options = parser.parse_args()
    print("method       camera                          tracked   dropped   latency ms: p50    p99    max")
    with tempfile.TemporaryDirectory() as folder:
        for width, height, rate, noise, delay in (
            (480, 360, 30.0, "none", 0.0),
            (1280, 720, 60.0, "none", 0.0),
            (1280, 720, 60.0, "kinect_v1_edges", 0.0),
            (480, 360, 30.0, "none", 0.05),
        ):
            path = scenario(Path(folder), width, height, rate, noise)
            for method in ("persistent", "slicing"):
                config = dataclasses.replace(RopeConfig(0.015, "#c8281e"), method=method)
                result = run(path, config, options.seconds, rate, delay)
                p50, p99 = np.percentile(np.array(result.latencies) * 1e3, [50, 99])
                name = f"{width}x{height} {rate:g} fps {noise}" + (f", {delay * 1e3:g} ms late" if delay else "")
                print(
                    f"{method:12s} {name:32s} {result.rate:5.2f} fps   {result.dropped:5d} "
                    f"{p50:17.2f} {p99:6.2f} {max(result.latencies) * 1e3:6.2f}"
                )


if __name__ == "__main__":
    main()
