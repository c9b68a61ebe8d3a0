"""Ropes that move by a formula, and an arm that does what it is told: for the tests and the benchmark of the tracer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ropetrace.control.arm import Arm
from ropetrace.control.controller import Control, TracingController
from ropetrace.control.limits import GuardOptions
from ropetrace.control.tool_limits import ToolLimits
from ropetrace.control.tracing import TracingSettings
from ropetrace.types import Estimate, FloatArray, Motion, Status, Waypoints, moved

PERIOD = 1 / 240
START = np.array([1.376, -0.506, -0.794, -2.794, -2.487, 1.946, 0.078])
"""A Panda with its tool at `TOP`, X down, Z along the base's X."""
TOP = np.array([0.45, 0.2, 0.35])
CAMERA_AXIS = np.array([-1.0, 0.0, 0.0])
"""The camera faces the arm, the rope between them."""

Rope = Callable[[float], FloatArray]
"""From the time to waypoints, (W, 3), base frame."""


def hanging(
    length: float = 0.45, count: int = 46, swing: float = 0.0, rate: float = 0.8, drift: Any = (0.0, 0.0, 0.0)
) -> Rope:
    """Down from `TOP`; its end swings by so much to either side, m, at a rate, Hz; it drifts, m/s, from time 10 on."""
    arcs = np.linspace(0, length, count)

    def rope(time: float) -> FloatArray:
        aside = swing * (arcs / length) ** 2 * np.sin(2 * np.pi * rate * time)
        return TOP + np.outer(arcs, [0, 0, -1.0]) + np.outer(aside, [0.3, 1.0, 0]) + np.array(drift) * (time - 10.0)

    return rope


def velocities(rope: Rope, time: float) -> FloatArray:
    """By differences; zero where the number of waypoints changes."""
    if len({len(rope(time + 1e-3 * k)) for k in (-1, 0, 1)}) > 1:
        return np.zeros_like(rope(time))
    return (rope(time + 1e-4) - rope(time - 1e-4)) / 2e-4


def accelerations(rope: Rope, time: float) -> FloatArray:
    """By differences; zero where the number of waypoints changes."""
    if len({len(rope(time + 1e-3 * k)) for k in (-1, 0, 1)}) > 1:
        return np.zeros_like(rope(time))
    return (rope(time + 1e-3) - 2 * rope(time) + rope(time - 1e-3)) / 1e-6


def waypoints(positions: FloatArray) -> Waypoints:
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return Waypoints(positions, np.tile([0, 0, 0, 1.0], (len(positions), 1)), np.r_[0, np.cumsum(steps)])


def distance(point: FloatArray, positions: FloatArray) -> float:
    """From a point to a polyline, metres."""
    starts, steps = positions[:-1], np.diff(positions, axis=0)
    part = np.einsum("ij,ij->i", point - starts, steps) / np.maximum(np.einsum("ij,ij->i", steps, steps), 1e-18)
    return float(np.linalg.norm(starts + np.clip(part, 0, 1)[:, None] * steps - point, axis=1).min())


def camera_pose(axis: FloatArray = CAMERA_AXIS) -> FloatArray:
    """base_from_camera of a camera that looks along an axis, 1.5 m before the rope."""
    x = np.cross([0.0, 0.0, 1.0], axis)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(axis, x), axis], axis=1)
    pose[:3, 3] = TOP - 1.5 * axis
    return pose


class KnownMotion:
    """Predicts what will be."""

    def __init__(self, rope: Rope, camera_from_base: FloatArray) -> None:
        self.rope, self.camera_from_base = rope, camera_from_base
        self.stamp_ns: int | None = None

    def update(self, stamp_ns: int, waypoints: Waypoints) -> Motion | None:
        self.stamp_ns = stamp_ns
        return None

    def predict(self, ahead: float) -> tuple[FloatArray, Motion] | None:
        if self.stamp_ns is None:
            return None
        time, turn = self.stamp_ns * 1e-9 + ahead, self.camera_from_base[:3, :3].T
        positions = moved(self.rope(time), self.camera_from_base)
        none = np.zeros_like(positions)
        velocity, acceleration = velocities(self.rope, time) @ turn, accelerations(self.rope, time) @ turn
        return positions, Motion(velocity, acceleration, none, none, none)

    def reset(self) -> None:
        self.stamp_ns = None


class Loop:
    """A controller, its clock, a camera of 30 frames a second, 10 ms late, and an arm that does what it is told."""

    def __init__(
        self,
        arm: Arm,
        rope: Rope,
        settings: TracingSettings | None = None,
        start: FloatArray = START,
        camera_axis: FloatArray = CAMERA_AXIS,
        options: GuardOptions | None = None,
    ) -> None:
        self.arm, self.rope = arm, rope
        base_from_camera = camera_pose(camera_axis)
        self.camera_from_base: FloatArray = np.asarray(np.linalg.inv(base_from_camera), np.float64)
        motion = KnownMotion(rope, self.camera_from_base)
        limits = ToolLimits(angular=10.0, period=PERIOD)
        settings = settings or TracingSettings(lead=PERIOD / 2)
        self.controller = TracingController(arm, start, base_from_camera, motion, PERIOD, settings, options, limits)
        self.start = self.q = np.array(start)
        self.step_count = 0
        self.commands: list[FloatArray] = []
        self.measured: list[Any] = []
        self.errors: list[float] = []
        """From the tool to the rope, metres, after each step of a tracing."""
        self.blind = False

    @property
    def now(self) -> float:
        return 10.0 + self.step_count * PERIOD

    def estimate(self, stamp: float, status: Status = Status.OK) -> Estimate:
        seen = waypoints(moved(self.rope(stamp), self.camera_from_base))
        return Estimate(round(stamp * 1e9), status, waypoints=seen)

    def act(self, now: Any, measured: Any) -> Control:
        control = self.controller.act(now, measured)
        self.commands.append(control.command.velocity)
        self.measured.append(measured)
        self.q = self.q + PERIOD * control.command.velocity
        return control

    def step(self) -> Control:
        self.step_count += 1
        if self.step_count % 8 == 1 and not self.blind:
            self.controller.see(self.estimate(self.now - 0.01))
        control = self.act(self.now, self.q)
        if control.step is not None and control.step.phase == "tracing":
            self.errors.append(distance(self.tool[:3, 3], self.rope(self.now + PERIOD)))
        return control

    def run(self, seconds: float = 20.0) -> Control:
        """Until the task ends."""
        for _ in range(round(seconds / PERIOD)):
            control = self.step()
            if control.step is not None and control.step.phase.ended:
                break
        return control

    @property
    def tool(self) -> FloatArray:
        """base_from_tool."""
        return self.arm.forward(self.q)
