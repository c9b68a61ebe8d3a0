"""The paper's three nodes, each a process of its own, let the simulated arm trace the rope as in case study 2.

    python benchmarks/ros_tracing.py --condition 30fps --minutes 10
    python benchmarks/ros_tracing.py --condition 60fps --minutes 10

This process is the camera and the arm, in real time: images and joints go out over Zenoh, joint commands come back. The
rope sways in each of case study 2's winds for a ninth of the time; whenever the arm has come to the end it is put back
and begins anew. The arm is left in the image. Printed are the tracings and the errors of the tool; beside them those
inside one process and without a clock, with the tracker's own latency and with that of the nodes; the time from an
image's stamp to the arrival of the first joint command that rests on it, and how much of it the simulated camera takes;
and the memory and processor time of each node.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ropetrace.evaluation.case1 import CONDITIONS, FREQUENCIES, Condition, measure_compute_time
from ropetrace.evaluation.case2 import CONTROL_RATE, TOOL_TURN, Case2Settings, ToolErrors, run_tracing, tool_errors
from ropetrace.evaluation.tables import markdown_table
from ropetrace.recordings.ros_frames import DEPTH_TOPIC
from ropetrace.recordings.ros_messages import CAMERA, decoded, stamp_and_frame
from ropetrace.results.ros_estimates import DIAGNOSTICS, NANOSECONDS
from ropetrace.ros.live_camera import camera_info_beside
from ropetrace.ros.messages import JOINTS, TIME
from ropetrace.ros.simulated_cell import CellSettings, SimulatedCell, cell_config
from ropetrace.ros.zenoh_graph import ZenohNode
from ropetrace.ros.zenoh_session import Connection, open_router
from ropetrace.sim.arm import RESPONSE

ROUTER = "tcp/127.0.0.1:17448"
NODES = ("track_deformable", "trajectory_tracker", "kinematic_system")

READING_EVERY = round(0.1 * CONTROL_RATE)
"""Steps between two readings of the tool, as in case study 2."""

LONGEST = 20.0
"""A tracing that takes longer has failed, seconds."""

WARM_UP = 10.0
"""As in case study 2, seconds."""

MEMORY_EVERY = 5.0
"""Seconds."""

_CONDITIONS = {condition.name: condition for condition in CONDITIONS}

PHASES = ("approaching", "tracing", "done", "fell off", "stuck")


@dataclass
class Wind:
    """What was seen in one wind."""

    frequency: float
    readings: list[ToolErrors] = field(default_factory=list)
    outcomes: list[str] = field(default_factory=list)
    traced: list[float] = field(default_factory=list)
    latencies: list[float] = field(default_factory=list)
    camera: list[float] = field(default_factory=list)
    told: list[str] = field(default_factory=list)


class Watcher:
    """Sees the arm through a cell's steps, and puts it back when it has come to an end."""

    def __init__(self, node: ZenohNode, cell: SimulatedCell, wind: Wind) -> None:
        self._cell = cell
        self._wind = wind
        self._commands = node.subscription("/ropetrace/joint_commands", JOINTS, depth=1000)
        self._basis = node.subscription("/ropetrace/command_basis", TIME, depth=1000)
        self._told = node.subscription("/diagnostics", DIAGNOSTICS, depth=100)
        self._shown = node.subscription(camera_info_beside(DEPTH_TOPIC), CAMERA, depth=100)
        self._arrivals: dict[int, int] = {}
        self._images: dict[int, int] = {}
        self._known: set[int] = set()
        self._phase = ""
        self._since = 0.0
        self._put_back = 0.0
        self._step = 0
        self._farthest = 0.0

    def tick(self, now: float) -> None:
        """One step of the cell."""
        self._latency()
        for message in self._told.take():
            status = decoded(message).status[0]
            phase = status.message.removeprefix("braking: ")
            if status.name == "ropetrace: kinematic_system" and phase in PHASES:
                self._enter(phase, now)
            elif status.level:
                told = re.sub(r"[0-9][0-9.]*", "#", status.message)
                self._wind.told.append(f"{status.name.removeprefix('ropetrace: ')}: {told}")
        if self._phase == "tracing":
            if self._step % READING_EVERY == 0:
                self._read()
            self._step += 1
        if self._phase in PHASES[:2] and now - self._since > LONGEST:
            self._end("too slow", now)
        elif self._phase not in PHASES[:2] and now - self._put_back > LONGEST:
            self._end("never began", now)

    def _enter(self, phase: str, now: float) -> None:
        before, self._phase = self._phase, phase
        if phase == before:
            return
        if phase in PHASES[:2] and before not in PHASES[:2]:
            self._since = now
        if phase == "tracing":
            self._step, self._farthest = 0, 0.0
        elif phase in PHASES[2:] and before in PHASES[:2]:
            self._end(phase, now)

    def _end(self, outcome: str, now: float) -> None:
        self._see(tool_errors(self._cell.simulated, self._cell.moving))
        self._wind.outcomes.append(outcome)
        self._wind.traced.append(self._farthest)
        self._phase, self._put_back, self._farthest = "", now, 0.0
        self._cell.put_back()

    def _read(self) -> None:
        errors = tool_errors(self._cell.simulated, self._cell.moving)
        self._wind.readings.append(errors)
        self._see(errors)

    def _see(self, errors: ToolErrors) -> None:
        if errors.linear < 0.05:
            self._farthest = max(self._farthest, errors.place)

    def _latency(self) -> None:
        """From each image's stamp to the first command that rests on it, and to where the camera hands it on."""
        self._wind.camera += [(one.log_time_ns - stamp_and_frame(one)[0]) / 1e6 for one in self._shown.take()]
        for message in self._commands.take():
            self._arrivals[stamp_and_frame(message)[0]] = message.log_time_ns
        for message in self._basis.take():
            body = decoded(message)
            image = body.time_ref.sec * NANOSECONDS + body.time_ref.nanosec
            if image not in self._known:
                self._known.add(image)
                self._images[image] = stamp_and_frame(message)[0]
        for image, command in list(self._images.items()):
            arrived = self._arrivals.get(command)
            if arrived is not None:
                self._wind.latencies.append((arrived - image) / 1e6)
                del self._images[image]
        while len(self._arrivals) > 2000:
            del self._arrivals[next(iter(self._arrivals))]


@dataclass
class Process:
    """A node's process, and what it used."""

    name: str
    process: subprocess.Popen[bytes]
    memory: list[tuple[float, float]] = field(default_factory=list)

    def sample(self) -> None:
        """Note its memory now."""
        for line in Path(f"/proc/{self.process.pid}/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmRSS"):
                self.memory.append((time.monotonic(), int(line.split()[1]) / 1024))

    def cpu_seconds(self) -> float:
        """That it used so far."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / 100


@contextmanager
def nodes(settings: Path, shared_memory: bool) -> Iterator[list[Process]]:
    """The three nodes, running."""
    started = []
    try:
        for name in NODES:
            command = [sys.executable, "-m", "ropetrace", "node", name, "--config", str(settings), "--router", ROUTER]
            if shared_memory:
                command.append("--shared-memory")
            if name == "kinematic_system":
                command += [f"--rate={CONTROL_RATE:g}", f"--response={RESPONSE:g}", f"--tool-turn={TOOL_TURN:g}"]
            started.append(Process(name, subprocess.Popen(command, stderr=subprocess.DEVNULL)))
        yield started
    finally:
        for one in started:
            one.process.terminate()
        for one in started:
            one.process.wait()


def watch(frequency: float, condition: str, seconds: float, running: list[Process], shared_memory: bool) -> Wind:
    """Let the arm trace in one wind for some time."""
    wind = Wind(frequency)
    with ZenohNode("ropetrace_sim", Connection(router=ROUTER, shared_memory=shared_memory)) as node:
        cell = SimulatedCell(node, CellSettings(frequency, warm_up=WARM_UP, condition=condition))
        watcher = Watcher(node, cell, wind)
        end = time.monotonic() + seconds
        next_sample = 0.0

        def tick(now: float) -> None:
            nonlocal next_sample
            watcher.tick(now)
            if now >= next_sample:
                next_sample = now + MEMORY_EVERY
                for one in running:
                    one.sample()

        cell.run(lambda: time.monotonic() > end, tick)
    return wind


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--condition", choices=list(_CONDITIONS), default="30fps")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--shared-memory", action="store_true")
    parser.add_argument("--frequencies", type=float, nargs="+", default=FREQUENCIES)
    options = parser.parse_args()
    each = options.minutes * 60 / len(options.frequencies)
    with tempfile.TemporaryDirectory() as folder:
        settings = Path(folder) / "rope.toml"
        settings.write_text(cell_config().to_toml(), encoding="utf-8")
        router = open_router(ROUTER)
        try:
            with nodes(settings, options.shared_memory) as running:
                watch(
                    0.0, options.condition, 15.0, running, options.shared_memory
                )  # the kernels are compiled, or come from the cache
                for one in running:
                    one.memory.clear()
                before = [one.cpu_seconds() for one in running]
                began = time.monotonic()
                winds = []
                for frequency in options.frequencies:
                    winds.append(watch(frequency, options.condition, each, running, options.shared_memory))
                    print(_line(winds[-1]), flush=True)
                took = time.monotonic() - began
                used = [one.cpu_seconds() - start for one, start in zip(running, before, strict=True)]
                print()
                _report(winds, _CONDITIONS[options.condition], running, used, took)
        finally:
            router.close()


def _line(wind: Wind) -> str:
    done = wind.outcomes.count("done")
    failed = "".join(f", {outcome}" for outcome in wind.outcomes if outcome != "done")
    notes = "; ".join(f"{count} x {text}" for text, count in Counter(wind.told).items())
    return f"{wind.frequency:g} Hz: {done} of {len(wind.outcomes)} done{failed}; told: {notes or 'nothing'}"


def _report(winds: list[Wind], condition: Condition, running: list[Process], used: list[float], took: float) -> None:
    every = np.concatenate([wind.latencies for wind in winds])
    p50, p99, p999 = np.percentile(every, [50, 99, 99.9])
    settings = Case2Settings(self_filter=False)
    own = measure_compute_time(condition, settings.as_case1()) / condition.speed
    delays = {f"in process, {own * 1e3:.1f} ms": own, f"in process, {p50:.1f} ms": p50 / 1e3 - 0.5 / CONTROL_RATE}
    rows = []
    for wind in winds:
        row = [
            f"{wind.frequency:g}",
            f"{wind.outcomes.count('done')} of {len(wind.outcomes)}",
            f"{np.mean(wind.traced):.1%}" if wind.traced else "",
            str(len(wind.readings)),
            *_errors([errors.linear for errors in wind.readings], [errors.angular for errors in wind.readings]),
        ]
        for delay in delays.values():
            runs = [run_tracing(condition, wind.frequency, settings, delay, repeat) for repeat in range(3)]
            row.append(_errors(np.concatenate([run.linear for run in runs]), [0.0])[0])
            if not all(run.completed for run in runs):
                row[-1] += f" ({sum(run.completed for run in runs)} of 3)"
        rows.append(row)
    header = ("wind, Hz", "completed", "traced", "readings", "linear, mm", "worst", "angular, rad", *delays)
    print(markdown_table(header, rows))
    camera = np.percentile(np.concatenate([wind.camera for wind in winds]), [50, 99])
    print(
        f"image to joint command: p50 {p50:.1f} ms, p99 {p99:.1f} ms, p99.9 {p999:.1f} ms, greatest {every.max():.1f} "
        f"ms, {len(every)} images; the simulated camera's part: p50 {camera[0]:.1f} ms, p99 {camera[1]:.1f} ms"
    )
    for one, cpu in zip(running, used, strict=True):
        times, sizes = np.array(one.memory).T
        slope = np.polyfit((times - times[0]) / 60, sizes, 1)[0]
        early, late = sizes[: len(sizes) // 5 + 1].mean(), sizes[-(len(sizes) // 5 + 1) :].mean()
        print(
            f"{one.name}: {cpu / took:.0%} of a core; memory {early:.1f} MB in the first fifth, {late:.1f} MB in the "
            f"last, {slope:+.2f} MB a minute"
        )


def _errors(linear: Any, angular: Any) -> tuple[str, str, str]:
    """Mean and deviation in mm, the worst, mean and deviation in rad."""
    if not len(linear):
        return "", "", ""
    far, turned = np.array(linear) * 1e3, np.array(angular)
    return f"{far.mean():.3f} ± {far.std():.3f}", f"{far.max():.2f}", f"{turned.mean():.3f} ± {turned.std():.3f}"


if __name__ == "__main__":
    main()
