"""A chain of capsules that is moved by impulses: the simulator inside the tracker of Schulman et al., on MuJoCo.

Its time and its masses are not those of any real rope: it only keeps the shape one that a rope can take.
"""

from __future__ import annotations

import numpy as np

from ropetrace.errors import import_extra
from ropetrace.types import FloatArray

LINK_MASS = 1.0
"""Kilograms, as published. It cancels but for the joints' springs: impulses are given as changes of velocity."""

_FASTEST = 20.0
"""A chain with a faster link has become unstable, m/s."""

_TURN, _MOST_PARTS = 0.1, 16
"""No joint turns by more than this in a part of a step, radians. A chain that needs more parts has become unstable."""


class ImpulseChain:
    """Capsules along a path, whose joints have springs that pull straight; nothing collides.

    A joint is a pair of hinges across the link: a ball joint without the twist, of which a cloud shows nothing, and for
    a third of the time. The first link is free, or hangs from a ball joint.

    Each link's velocity decays by the factor (1 - linear_damping)^step a step, and its angular velocity likewise, as
    Bullet damps bodies: an angular damping of 1 takes all of what the joints do not give back. Where joints turn fast,
    as when a rope is pushed together, a step is divided.

    Parameters
    ----------
    path : (K + 1, 3) float array
        Ends of the K links, as equally far apart as may be, metres.
    radius : float
        Metres.
    step : float
        Of the integration, seconds.
    linear_damping, angular_damping : float
        0 to 1.
    stiffness : float
        Of each joint, N m/rad.
    limit : float
        Largest angle of a hinge, radians.
    gravity : (3,) float array
        In the frame of the path, m/s^2.
    anchored : bool
        Whether the first end of the path is held where it is, by a ball joint without limit.

    Raises
    ------
    MissingExtraError
        If MuJoCo is not installed.
    """

    def __init__(
        self,
        path: FloatArray,
        radius: float,
        *,
        step: float,
        linear_damping: float,
        angular_damping: float,
        stiffness: float,
        limit: float,
        gravity: FloatArray,
        anchored: bool,
    ) -> None:
        self._mujoco = mujoco = import_extra("mujoco", "sim")
        steps = np.diff(path, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        self.link_length = float(lengths.mean())
        self._step = step
        self._damping = (linear_damping, angular_damping)
        xml = _mjcf(len(steps), self.link_length, radius, step, stiffness, limit, gravity, anchored)
        self._physics = mujoco.MjModel.from_xml_string(xml)
        self._data = mujoco.MjData(self._physics)
        self._links = slice(1, 1 + len(steps))
        self._joints = slice(3 if anchored else 6, None)
        self._inertia = self._physics.body_inertia[1, [0, 2]].copy()
        turn, angles = _turns(steps / np.maximum(lengths, 1e-12)[:, None])
        if anchored:
            self._data.qpos[:] = np.concatenate([turn, angles.ravel()])
            self._physics.body_pos[1] = path[0]
        else:
            self._data.qpos[:] = np.concatenate([path[0], turn, angles.ravel()])
        mujoco.mj_fwdPosition(self._physics, self._data)
        mujoco.mj_fwdVelocity(self._physics, self._data)

    @property
    def centres(self) -> FloatArray:
        """Of the links, (K, 3), metres: a copy."""
        return self._data.xipos[self._links].copy()

    @property
    def path(self) -> FloatArray:
        """The ends of the links, (K + 1, 3), metres: a copy."""
        tops = self._data.xpos[self._links]
        axis = self._data.xmat[-1].reshape(3, 3)[:, 2]
        return np.concatenate([tops, [tops[-1] + self.link_length * axis]])

    @property
    def velocities(self) -> FloatArray:
        """Of the links' centres, (K, 3), m/s of the simulation's own time."""
        motion = self._data.cvel[self._links]
        arm = self._data.xipos[self._links] - self._data.subtree_com[1]
        return motion[:, 3:] + np.cross(motion[:, :3], arm)

    def push(self, changes: FloatArray, steps: int) -> bool:
        """Change the links' velocities, as far as the joints allow, and go on.

        Parameters
        ----------
        changes : (K, 3) float array
            What would be added to the velocity of each link if it were free, m/s.
        steps : int
            Of the integration; the impulse acts in the first.

        Returns
        -------
        bool
            False if the chain has become unstable; it must not be used again.
        """
        if not np.isfinite(changes).all():
            return False
        impulse = changes
        for _ in range(steps):
            fastest = np.abs(self._data.qvel[self._joints]).max(initial=0.0)
            if not fastest * self._step < _TURN * _MOST_PARTS:
                return False
            parts = int(fastest * self._step / _TURN) + 1
            for _ in range(parts):
                if not self._advance(impulse, self._step / parts):
                    return False
                impulse = np.zeros_like(changes)
        velocities = self.velocities
        return bool(np.isfinite(velocities).all() and np.abs(velocities).max() < _FASTEST)

    def _advance(self, changes: FloatArray, step: float) -> bool:
        """One step of the integration."""
        mujoco, physics, data = self._mujoco, self._physics, self._data
        physics.opt.timestep = step
        linear, angular = ((1 - (1 - damping) ** step) / step for damping in self._damping)
        across, along = self._inertia
        spin = data.cvel[self._links, :3]
        axes = data.xmat[self._links].reshape(-1, 3, 3)[:, :, 2]
        roll = np.sum(spin * axes, axis=1, keepdims=True) * axes
        data.xfrc_applied[self._links, :3] = LINK_MASS * (changes / step - linear * self.velocities)
        data.xfrc_applied[self._links, 3:] = -angular * (across * spin + (along - across) * roll)
        # The parts of mj_step without its checks, which write a file of warnings when a chain becomes unstable.
        mujoco.mj_fwdAcceleration(physics, data)
        mujoco.mj_fwdConstraint(physics, data)
        if not np.isfinite(data.qacc).all():
            return False
        mujoco.mj_Euler(physics, data)
        mujoco.mj_fwdPosition(physics, data)
        mujoco.mj_fwdVelocity(physics, data)
        return True


def _turns(directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How the links lie: quaternion wxyz of the first, (4,), and the angles of the pair of hinges of each other one.

    The first turns z by the shortest way to the link's direction; a pair by a about x, then b about y, turns it to
    (sin b, -sin a cos b, cos a cos b) in the frame of the link before.

    Parameters
    ----------
    directions : (K, 3) float array
        Unit vectors along the links.

    Returns
    -------
    (4,) float array, (K - 1, 2) float array
        The angles in radians.
    """
    x, y, z = directions[0]
    turn = np.array([1 + z, -y, x, 0.0]) if z > -1 + 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])
    turn /= np.linalg.norm(turn)
    w, a, b, _ = turn
    frame = np.array(
        [
            [1 - 2 * b * b, 2 * a * b, 2 * w * b],
            [2 * a * b, 1 - 2 * a * a, -2 * w * a],
            [-2 * w * b, 2 * w * a, 1 - 2 * (a * a + b * b)],
        ]
    )
    angles = np.empty((len(directions) - 1, 2))
    for index, direction in enumerate(directions[1:]):
        x, y, z = frame.T @ direction
        first, second = np.arctan2(-y, z), np.arcsin(np.clip(x, -1.0, 1.0))
        angles[index] = first, second
        sa, ca, sb, cb = np.sin(first), np.cos(first), np.sin(second), np.cos(second)
        frame = frame @ np.array([[cb, 0.0, sb], [sa * sb, ca, -sa * cb], [-ca * sb, sa, ca * cb]])
    return turn, angles


def _mjcf(
    links: int,
    length: float,
    radius: float,
    step: float,
    stiffness: float,
    limit: float,
    gravity: FloatArray,
    anchored: bool,
) -> str:
    """The chain as MuJoCo's XML; links run along their z axes."""
    hinge = f'type="hinge" stiffness="{stiffness!r}" limited="true" range="{-limit!r} {limit!r}"'
    joint = f'<joint axis="1 0 0" {hinge}/><joint axis="0 1 0" {hinge}/>'
    first = '<joint type="ball"/>' if anchored else "<freejoint/>"
    geometry = (
        f'<geom type="capsule" size="{radius!r}" mass="{LINK_MASS!r}" contype="0" conaffinity="0" '
        f'fromto="0 0 0 0 0 {length!r}"/>'
    )
    body = ""
    for link in reversed(range(links)):
        place = length if link else 0.0
        body = f'<body pos="0 0 {place!r}">{joint if link else first}{geometry}{body}</body>'
    pull = " ".join(repr(float(part)) for part in gravity)
    return (
        f'<mujoco><compiler angle="radian"/><option timestep="{step!r}" integrator="Euler" gravity="{pull}">'
        '<flag contact="disable" eulerdamp="disable" autoreset="disable"/></option>'
        f"<worldbody>{body}</worldbody></mujoco>"
    )
