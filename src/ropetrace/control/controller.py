"""From what is known of the rope to what the joints are told: motion, tracer, limits of the tool, guard."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ropetrace.control.arm import Arm
from ropetrace.control.limits import Command, GuardOptions, MotionGuard, ToolLimits
from ropetrace.control.tracing import RopeTracer, Step, TracingSettings
from ropetrace.motion import MotionEstimator
from ropetrace.types import Estimate, FloatArray, Status, moved

LOST_AFTER = 3
"""Frames in a row without the rope after which the arm is told to stop; a trajectory that gets too old stops it too."""


class Control(NamedTuple):
    """One control step.

    Attributes
    ----------
    step : Step or None
        What the tracer wanted; None where nothing is known of the rope's motion.
    command : Command
        What the joints are told.
    """

    step: Step | None
    command: Command


class TracingController:
    """Traces a rope with an arm: estimates in at the camera's rate, joint velocities out at the arm's.

    Parameters
    ----------
    arm : Arm
        Which.
    position : (n,) float array
        Where it stands still at the start, rad.
    base_from_camera : (4, 4) float array
        The camera's pose in the base's frame.
    motion : MotionEstimator
        Predicts the rope to each step's time. It belongs to the controller from now on.
    period : float
        Of the control loop, seconds.
    settings : TracingSettings
        Of the tracer.
    guard_options : GuardOptions
        Of the guard.
    tool_limits : ToolLimits, optional
        By default 1.7 m/s, 2.5 rad/s and no walls.
    """

    def __init__(
        self,
        arm: Arm,
        position: FloatArray,
        base_from_camera: FloatArray,
        motion: MotionEstimator,
        period: float,
        settings: TracingSettings | None = None,
        guard_options: GuardOptions | None = None,
        tool_limits: ToolLimits | None = None,
    ) -> None:
        self.arm = arm
        self.tracer = RopeTracer(arm, settings or TracingSettings(), base_from_camera[:3, 2])
        self.guard = MotionGuard(arm.limits, position, period, guard_options)
        self.tool_limits = tool_limits or ToolLimits(period=period)
        self._base_from_camera = base_from_camera
        self._motion = motion
        self._stamp: float | None = None
        self._lost = 0

    def see(self, estimate: Estimate) -> None:
        """Take an estimate of the tracker, camera frame, as soon as there is one."""
        if estimate.status is Status.LOST:
            self._lost += 1
            return
        self._lost = 0
        self._stamp = estimate.stamp_ns * 1e-9
        self._motion.update(estimate.stamp_ns, estimate.waypoints)

    def act(self, now: float, q: FloatArray) -> Control:
        """One control step.

        Parameters
        ----------
        now : float
            Seconds, on the clock of the estimates' stamps.
        q : (n,) float array
            Measured joint angles, rad.

        Returns
        -------
        Control
            A command whatever comes in: where something is wrong it brakes, and says why.
        """
        age = math.inf if self._stamp is None else now - self._stamp
        usable = age + self.guard.options.max_future >= 0 and age <= self.guard.options.max_age
        prediction = self._motion.predict(max(age, 0.0)) if usable else None
        if prediction is None or not self._sound(q):
            hold = "the rope's motion is not known" if self._stamp is None or usable else None
            return Control(None, self.guard.step(now, q, None, now if self._stamp is None else self._stamp, hold))
        positions, motion = prediction
        turn = self._base_from_camera[:3, :3].T
        step = self.tracer.step(
            now,
            q,
            moved(positions, self._base_from_camera),
            motion.velocities @ turn,
            motion.accelerations @ turn,
        )
        hold = str(step.phase) if step.phase.ended else None
        if self._lost >= LOST_AFTER:
            hold = f"the rope is lost: {self._lost} frames without it"
        pose, jacobian = self.arm.kinematics(q)
        wish = self.tool_limits.scale(jacobian, pose[:3, 3], step.velocity)
        if np.isfinite(wish).all():
            # Joint by joint: the guard would slow all of them down to the pace of the slowest.
            wish = np.clip(wish, *self.guard.velocity_bounds(q))
        assert self._stamp is not None
        return Control(step, self.guard.step(now, q, wish, self._stamp, hold))

    def _sound(self, q: FloatArray) -> bool:
        values = np.asarray(q)
        return values.shape == (self.arm.count,) and values.dtype.kind in "fiu" and bool(np.isfinite(values).all())
