"""From what is known of the rope to what the joints are told: motion, tracer, limits of the tool, guard."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ropetrace.control.arm import Arm
from ropetrace.control.limits import Command, GuardOptions, MotionGuard, finite_number
from ropetrace.control.tool_limits import ToolLimits
from ropetrace.control.tracing import RopeTracer, Step, TracingSettings
from ropetrace.motion import MotionEstimator
from ropetrace.types import Estimate, FloatArray, Motion, Status, moved

LOST_AFTER = 3
"""Frames in a row without the rope after which the arm is told to stop; a trajectory that gets too old stops it too."""

UNKNOWN = "the rope's motion is not known"
"""Reason of a hold until there are two frames, and after one that does not fit those before."""


class Control(NamedTuple):
    """One control step.

    Attributes
    ----------
    step : Step or None
        What the tracer wanted; None where it was not asked: the rope's motion or the arm's position is not known.
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
        Of the guard. Its `max_age` is from the stamp of the newest frame to the end of the last command that rests on
        it: the guard itself is given a period less.
    tool_limits : ToolLimits, optional
        By default 1.7 m/s, 2.5 rad/s and no walls. They make the joints' velocities shorter as a whole: where the tool
        turns too fast, it also slows down along the rope.

    Raises
    ------
    ConfigError
        If an option is impossible, or `max_age` is not longer than a period.
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
        options = guard_options or GuardOptions()
        self.guard = MotionGuard(arm.limits, position, period, replace(options, max_age=options.max_age - period))
        self.tool_limits = tool_limits or ToolLimits(period=period)
        self._base_from_camera = np.array(base_from_camera, float)
        self._motion = motion
        self._stamp: float | None = None
        self._lost = 0

    def see(self, estimate: Estimate) -> None:
        """Take an estimate of the tracker, camera frame, as soon as there is one."""
        if estimate.status is Status.LOST or not np.isfinite(estimate.waypoints.positions).all():
            self._lost += 1
            return
        self._lost = 0
        self._motion.update(estimate.stamp_ns, estimate.waypoints)
        known = self._motion.stamp_ns
        # A frame that does not fit is passed over: for as long as they are fresh, the ones before it serve.
        self._stamp = (estimate.stamp_ns if known is None else known) * 1e-9

    def act(self, now: Any, q: Any) -> Control:
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
        stamp, joints, time = self._stamp, self.guard.locate(now, q), finite_number(now)
        if stamp is None or time is None or joints is None:
            # A bad time or position is a graver reason to the guard.
            return Control(None, self.guard.step(now, q, None, now if stamp is None else stamp, UNKNOWN))
        options = self.guard.options
        if not -options.max_future <= time - stamp <= options.max_age:
            return Control(None, self.guard.step(now, q, None, stamp))
        prediction = self._motion.predict(max(time - stamp, 0.0))
        if prediction is None:
            return Control(None, self.guard.step(now, q, None, stamp, UNKNOWN))
        # What overflows becomes no wish, at which the guard brakes.
        with np.errstate(all="ignore"):
            step, wish = self._wish(time, joints, *prediction)
        hold = str(step.phase) if step.phase.ended else None
        if self._lost >= LOST_AFTER:
            hold = f"the rope is lost: {self._lost} frames without it"
        return Control(step, self.guard.step(now, q, wish, stamp, hold))

    def _wish(self, now: float, q: FloatArray, positions: FloatArray, motion: Motion) -> tuple[Step, FloatArray]:
        """What the tracer wants, and as much of it as the tool and each joint can do."""
        turn = self._base_from_camera[:3, :3].T
        step = self.tracer.step(
            now,
            q,
            moved(positions, self._base_from_camera),
            motion.velocities @ turn,
            motion.accelerations @ turn,
        )
        pose, jacobian = self.arm.kinematics(q)
        wish = self.tool_limits.scale(jacobian, pose[:3, 3], step.velocity)
        if np.isfinite(wish).all():
            # Joint by joint: the guard would slow all of them down to the pace of the slowest.
            wish = np.clip(wish, *self.guard.velocity_bounds(q))
        return step, wish
