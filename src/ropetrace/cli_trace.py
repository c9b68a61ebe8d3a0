"""The command that shows the whole system at work: words for people, no logic."""

from __future__ import annotations

import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

from ropetrace.cli_simulation import parse_duration
from ropetrace.errors import OutputError, RopetraceError, import_extra
from ropetrace.terminal import INTERRUPTED, INTERRUPTS, Interruption

FAILED = 1
"""Exit code of a tracing that did not reach the end of the rope."""


@dataclass(frozen=True)
class Trace:
    """Let a simulated arm trace a rope that sways in a wind, and watch it.

    The whole system at work: camera, tracker, motion, controller, arm. Ends with a table of the tool's errors.

    ropetrace trace
    """

    wind: Annotated[float, arg(metavar="HZ")] = 0.8
    """How often the wind turns in a second; 0.8 is the rope's resonance, 0 no wind."""
    condition: Literal["30fps", "60fps"] = "30fps"
    """30fps: 480x360 in real time; 60fps: 1280x720 in a tenth of real time."""
    noise: str = "none"
    """Of the depth camera: none, kinect_v1, stereo, kinect_v1_edges, stereo_edges."""
    latency: Annotated[str, arg(metavar="DURATION")] = "2ms"
    """From a frame's arrival to its centreline, in simulated time."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="FILE")] = None
    """Keep the view as a recording for the Rerun viewer: a new .rrd file."""
    view: bool = True
    """Show it live in the Rerun viewer, in real time; without a screen it goes on without."""
    overwrite: bool = False
    """Replace a recording that exists."""

    def run(self) -> int:
        for module, extra in (("mujoco", "sim"), ("pinocchio", "arm")):
            import_extra(module, extra)
        from ropetrace.evaluation.case1 import CONDITIONS
        from ropetrace.evaluation.case2 import Case2Settings, ClosedLoop, trace

        if self.out is not None and self.out.suffix.lower() != ".rrd":
            raise OutputError(f"--out {self.out}: the view is kept as an .rrd file")
        condition = {item.name: item for item in CONDITIONS}[self.condition]
        settings = Case2Settings(noise=self.noise, latency=parse_duration(self.latency))
        assert settings.latency is not None
        with ExitStack() as stack:
            sinks = self._sinks(stack, settings)
            print("the rope begins to swing, and the kernels are made ready ...")
            loop = ClosedLoop(condition, self.wind, settings, settings.latency)
            paced = any(sink.live for sink in sinks)
            show = _Show(loop, [sink.write for sink in sinks], condition.speed if paced else None)
            try:
                with Interruption():
                    loop.on_frame = _end_if_interrupted
                    while loop.time < loop.begin:
                        loop.see()
                    loop.on_frame = show
                    print("the arm traces it ...")
                    result = trace(loop)
            except KeyboardInterrupt:
                print("ropetrace: interrupted", file=sys.stderr)
                return INTERRUPTED
        print("\n".join(_table(result)))
        if self.out is not None:
            print(f"view      {self.out} (open it with: rerun {self.out})")
        if not result.completed:
            print(f"ropetrace: the tracing ended early: {result.outcome}", file=sys.stderr)
            return FAILED
        return 0

    def _sinks(self, stack: ExitStack, settings: Any) -> list[_Sink]:
        sinks = []
        pose = _camera_pose()
        if self.view:
            try:
                from ropetrace.results.live import LiveViewer

                viewer = stack.enter_context(LiveViewer(frame_name="world", frame_from_camera=pose, arm=True))
                sinks.append(_Sink(viewer.write, live=True))
            except RopetraceError as error:
                print(f"no live view: {error}")
        if self.out is not None:
            from ropetrace.results.rrd import RrdWriter

            if self.out.exists() and not self.overwrite:
                raise OutputError(f"{self.out} exists already: choose another name or give --overwrite")
            writer = stack.enter_context(
                RrdWriter(
                    self.out,
                    overwrite=self.overwrite,
                    frame_name="world",
                    metadata={"tracing": repr(settings.tracing)},
                    frame_from_camera=pose,
                    arm=True,
                )
            )
            sinks.append(_Sink(writer.write, live=False))
        return sinks


@dataclass(frozen=True)
class _Sink:
    """Where pictures go, and whether somebody is looking."""

    write: Any
    live: bool


def _end_if_interrupted(*_: Any) -> None:
    if INTERRUPTS:
        raise KeyboardInterrupt


class _Show:
    """Takes each frame of a closed loop to the viewers, at the pace of real time if somebody looks."""

    def __init__(self, loop: Any, writers: list[Any], speed: float | None) -> None:
        from ropetrace.motion import make_motion

        self._loop = loop
        self._writers = writers
        self._speed = speed
        self._motion = make_motion(loop.config.motion.method, loop.config.diameter)
        self._index = 0
        self._start: tuple[float, float] | None = None

    def __call__(self, frame: Any, estimate: Any) -> None:
        _end_if_interrupted()
        if not self._writers:
            return
        from ropetrace.tracking import in_world, with_motion
        from ropetrace.viewer import ArmView

        loop = self._loop
        capsules = loop.moving.capsules()
        arm = ArmView(
            capsules.starts, capsules.ends, capsules.radii, loop.moving.world_from_tool(), loop.tool_errors()[0]
        )
        assert self._motion is not None
        estimate = in_world(with_motion(estimate, self._motion), loop.simulated.world_from_camera)
        for write in self._writers:
            write(self._index, estimate, frame, None, arm)
        self._index += 1
        if self._speed is None:
            return
        if self._start is None:
            self._start = time.perf_counter(), loop.time
        ahead = (loop.time - self._start[1]) / self._speed - (time.perf_counter() - self._start[0])
        time.sleep(max(ahead, 0.0))


def _camera_pose() -> Any:
    from ropetrace.sim.scenario import CameraSettings

    return CameraSettings().camera(0).world_from_camera


def _table(result: Any) -> list[str]:
    """The errors of the tool along the rope."""
    import numpy as np

    lines = [f"outcome   {result.outcome}: {float(result.traced):.0%} of the rope in {float(result.duration):.1f} s"]
    if not len(result.time):
        return lines
    lines.append("part of the rope   readings   linear error, mm         angular error, rad")
    lines.append("                              mean   p95    worst      mean    p95     worst")

    def row(name: str, chosen: Any) -> str:
        linear, angular = result.linear[chosen] * 1e3, result.angular[chosen]
        cells = [linear.mean(), np.percentile(linear, 95), linear.max()]
        turns = [angular.mean(), np.percentile(angular, 95), angular.max()]
        return (
            f"{name:18s} {len(linear):8d}   "
            + " ".join(f"{value:6.2f}" for value in cells)
            + "    "
            + " ".join(f"{value:7.4f}" for value in turns)
        )

    for first in range(4):
        chosen = (result.place >= first / 4) & (result.place < (first + 1) / 4 + (first == 3))
        if chosen.any():
            lines.append(row(f"{first * 25} to {first * 25 + 25} %", chosen))
    lines.append(row("all", np.ones(len(result.time), bool)))
    lines.append(
        f"limits    joints at most {result.velocity.max():.0%} of their speed, {result.acceleration.max():.0%} of "
        f"their acceleration, {result.jerk.max():.0%} of their jerk; closest to an end {result.margin.min():.2f} rad; "
        f"tool {float(result.tool_speed):.2f} m/s"
    )
    return lines
