"""An arm in MuJoCo that is driven by joint velocities, as a real one is through its velocity interface.

Each joint has a servo that turns the errors of velocity and of its integral into a torque, limited to the joint's
effort; gravity is made up for by the arm. So commands are followed with a delay of some milliseconds, and not exactly.
"""

from __future__ import annotations

import numpy as np

from ropetrace.control.arm import Arm
from ropetrace.errors import ConfigError, import_extra
from ropetrace.sim.scenario import CLUTTER, ROBOT_COLOR
from ropetrace.sim.scene import Capsules
from ropetrace.types import FloatArray, moved

ARM_TIMESTEP = 1 / 960
"""Of the integration, seconds."""

RESPONSE = 0.005
"""Time constant with which the servos bring a joint to its velocity, seconds."""

INTEGRAL_TIME = 0.02
"""With which they make up for the position that was lost meanwhile, seconds."""


class ArmSimulation:
    """An arm in time. The same arguments give the same bytes. It touches nothing: there are no contacts.

    Parameters
    ----------
    arm : Arm
        Its URDF must give masses.
    position : (n,) float array
        Where it stands at time 0, rad.
    world_from_base : (4, 4) float array
        Where it stands in the world.

    Raises
    ------
    ConfigError
        If MuJoCo cannot build the arm, or the position is impossible.
    MissingExtraError
        If MuJoCo is not installed.
    """

    def __init__(self, arm: Arm, position: FloatArray, world_from_base: FloatArray) -> None:
        mujoco = import_extra("mujoco", "sim")
        self.arm = arm
        self.world_from_base = np.array(world_from_base, float)
        self._mujoco = mujoco
        try:
            spec = mujoco.MjSpec.from_file(str(arm.path))
            spec.option.timestep = ARM_TIMESTEP
            spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
            spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
            for body in spec.bodies:
                body.gravcomp = 1
            for name in arm.joint_names:
                for kind in ("velocity", "position"):
                    servo = spec.add_actuator()
                    servo.name, servo.target, servo.trntype = f"{name}_{kind}", name, mujoco.mjtTrn.mjTRN_JOINT
                    if kind == "velocity":
                        servo.set_to_velocity(kv=1.0)
                    else:
                        servo.set_to_intvelocity(kp=1.0)
            self._physics = spec.compile()
        except ValueError as error:
            raise ConfigError(f"{arm.path}: MuJoCo cannot build it: {error}") from None
        physics = self._physics
        self._data = mujoco.MjData(physics)
        self._joints = np.array([physics.joint(name).qposadr[0] for name in arm.joint_names])
        self._dofs = np.array([physics.joint(name).dofadr[0] for name in arm.joint_names])
        self.restart(position)
        mass = np.zeros((physics.nv, physics.nv))
        mujoco.mj_fullM(physics, self._data, mass)
        gains = np.diag(mass)[self._dofs] / RESPONSE
        physics.actuator_gainprm[0::2, 0] = gains
        physics.actuator_biasprm[0::2, 2] = -gains
        physics.actuator_gainprm[1::2, 0] = gains / INTEGRAL_TIME
        physics.actuator_biasprm[1::2, 1] = -gains / INTEGRAL_TIME

    def restart(self, position: FloatArray) -> None:
        """Stand still at a position, at time 0.

        Raises
        ------
        ConfigError
            If the position is impossible.
        """
        arm = self.arm
        start = np.asarray(position, float)
        if start.shape != (arm.count,) or not np.isfinite(start).all():
            raise ConfigError(f"the arm {arm.name} has {arm.count} joints: a position of {start} is none of it")
        outside = np.flatnonzero((start < arm.limits.lower) | (start > arm.limits.upper))
        if len(outside):
            joint = outside[0]
            raise ConfigError(
                f"the arm {arm.name} cannot start with joint {joint + 1} at {start[joint]:g} rad: its range is "
                f"{arm.limits.lower[joint]:g} to {arm.limits.upper[joint]:g} rad"
            )
        self._mujoco.mj_resetData(self._physics, self._data)
        self._data.qpos[self._joints] = start
        self._data.act[:] = start
        self._mujoco.mj_forward(self._physics, self._data)
        self._step = 0

    @property
    def time(self) -> float:
        """Seconds since the start."""
        return self._step * ARM_TIMESTEP

    @property
    def position(self) -> FloatArray:
        """Joint angles, (n,), rad: a copy."""
        return np.array(self._data.qpos[self._joints])

    @property
    def velocity(self) -> FloatArray:
        """Of the joints, (n,), rad/s: a copy."""
        return np.array(self._data.qvel[self._dofs])

    def advance(self, time: float, velocity: FloatArray) -> None:
        """Go on to a time, to the nearest step, with a command that is held.

        Parameters
        ----------
        time : float
            Seconds since the start. One that is past changes nothing.
        velocity : (n,) float array
            Of the joints, rad/s.

        Raises
        ------
        ValueError
            If the velocity is not n finite numbers.
        """
        command = np.asarray(velocity, float)
        if command.shape != (self.arm.count,) or not np.isfinite(command).all():
            raise ValueError(f"velocity = {velocity}: expected {self.arm.count} finite numbers, rad/s")
        self._data.ctrl[:] = np.repeat(command, 2)
        for _ in range(self._step, round(time / ARM_TIMESTEP)):
            self._mujoco.mj_step(self._physics, self._data)
            self._step += 1

    def world_from_tool(self) -> FloatArray:
        """The tool's pose, (4, 4)."""
        return self.world_from_base @ self.arm.forward(self.position)

    def capsules(self) -> Capsules:
        """The links' shapes for a camera, world frame."""
        starts, ends, radii = self.arm.capsules(self.position)
        pose = self.world_from_base
        return Capsules.between(moved(starts, pose), moved(ends, pose), radii, ROBOT_COLOR, CLUTTER)
