"""Two hundred recordings, three of them broken: killed half way and resumed, and how much two cores help.

    python benchmarks/batch.py

The recordings are of the demo's rope. `ropetrace batch` is killed (SIGKILL to it and its workers) when half of
the results are there, and started again: no result that was finished is made a second time, and the table says what
became of each. Then all of them with one and with two jobs, in turns. The times depend on what else the machine does.
"""

from __future__ import annotations

import argparse
import csv
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from ropetrace import demo
from ropetrace.config import format_color
from ropetrace.recorder import Recorder
from ropetrace.sim.camera import Capsules, RayCaster, Scene
from ropetrace.types import Intrinsics, RgbdFrame

CAMERA = Intrinsics(320, 240, 290.0, 290.0, 159.5, 119.5)
BROKEN = (3, 77, 150)


def make_recordings(folder: Path, count: int, frames: int) -> None:
    """Recordings in ten folders; the broken ones are no MCAP, cut off after 4000 bytes, and of 0 bytes."""
    caster = RayCaster(CAMERA)
    images = []
    for index in range(frames):
        image = caster.render(Scene(Capsules.along(demo.rope_curve(index / 30), demo.DIAMETER / 2, demo.COLOR)))
        images.append((np.round(image.depth * 1000).astype(np.uint16), image.color.copy()))
    for number in range(count):
        path = folder / f"day{number % 10}" / f"{number:03d}.mcap"
        path.parent.mkdir(parents=True, exist_ok=True)
        with Recorder(path) as recorder:
            for index, (depth, color) in enumerate(images):
                stamp = 10**18 + number * 10**10 + round(index * 1e9 / 30)
                recorder.write(RgbdFrame(stamp, depth, 0.001, CAMERA, color))
    for number, size in zip(BROKEN, (None, 4000, 0), strict=True):
        path = folder / f"day{number % 10}" / f"{number:03d}.mcap"
        path.write_bytes(b"no recording at all" if size is None else path.read_bytes()[:size])


def command(recordings: Path, out: Path, jobs: int) -> list[str]:
    rope = ["--diameter", f"{demo.DIAMETER}", "--color", format_color(demo.COLOR)]
    return [sys.executable, "-m", "ropetrace", "batch", f"{recordings}/**", "-o", str(out), *rope, "-j", str(jobs)]


def results(out: Path) -> dict[Path, int]:
    """When each result was written."""
    return {path: path.stat().st_mtime_ns for path in out.glob("day*/*.csv")}


def kill_and_resume(recordings: Path, out: Path, count: int) -> None:
    process = subprocess.Popen(command(recordings, out, 2), start_new_session=True)
    while len(results(out)) < count // 2:
        if process.poll() is not None:
            sys.exit(f"the batch ended by itself, with exit code {process.returncode} and {len(results(out))} results")
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    before = results(out)
    done = subprocess.run(command(recordings, out, 2), capture_output=True, text=True, check=False)
    after = results(out)
    again = [path for path in before if before[path] != after[path]]
    print(f"killed with {len(before)} results; resumed, exit code {done.returncode}:")
    print(done.stdout + done.stderr, end="")
    print(f"results {len(after)} of {count}; made a second time: {len(again)}")


def print_times(recordings: Path, folder: Path, turns: int) -> None:
    seconds: dict[int, list[float]] = {1: [], 2: []}
    busy: dict[int, float] = {}
    for turn in range(turns):
        for jobs, spent in seconds.items():
            out = folder / f"timed{turn}{jobs}"
            started = time.perf_counter()
            subprocess.run(command(recordings, out, jobs), capture_output=True, check=False)
            spent.append(time.perf_counter() - started)
            with (out / "summary.csv").open(newline="") as file:
                busy[jobs] = sum(float(row["seconds"]) for row in csv.DictReader(file)) / jobs / spent[-1]
            shutil.rmtree(out)
    one, two = min(seconds[1]), min(seconds[2])
    print(f"1 job: {one:.1f} s, 2 jobs: {two:.1f} s (best of {turns}): {one / two:.2f} times as fast")
    print(f"of that time the workers tracked {busy[1]:.0%} and {busy[2]:.0%}; the rest is the start")
    print(f"all times: {seconds}, load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--turns", type=int, default=2)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_recordings(folder / "recordings", options.count, options.frames)
        kill_and_resume(folder / "recordings", folder / "out", options.count)
        print_times(folder / "recordings", folder, options.turns)


if __name__ == "__main__":
    main()
