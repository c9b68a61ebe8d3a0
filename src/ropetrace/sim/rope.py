"""Ropes that move: chains of capsules in MuJoCo, hanging in a wind, dropped, or held at both ends (section 6.2).

World frame: z up, metres, seconds, kilograms. Gravity is 9.81 m/s^2.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.linalg

from ropetrace.errors import ConfigError, import_extra
from ropetrace.types import FloatArray

GRAVITY = 9.81
"""m/s^2."""

TIMESTEP = 1 / 480
"""Of the integration, seconds: divides the frame times of 30 and 60 Hz cameras."""

STEPS_PER_PERIOD = 40
"""A wind must blow at least this many steps from one period to the next, or its sine is not resolved."""

SETTLE_SWINGS = 10.0
"""How long a rope that is held at both ends is given to come to rest before time 0, in units of sqrt(length / g)."""

MOST_LINKS = 400
"""MuJoCo's reader of XML takes no deeper nesting than 500."""


@dataclass(frozen=True, slots=True)
class RopeModel:
    """A chain of pill-shaped links with ball joints; the defaults are the paper's rope.

    Parameters
    ----------
    links : int
        How many.
    link_length : float
        Tip to tip, metres.
    radius : float
        Metres.
    link_mass : float
        Kilograms. In the wind of `Wind` it changes nothing but the weight of the joints' damping.
    damping : float
        Of each ball joint, N m s/rad.
    stiffness : float
        Of each ball joint, N m/rad, towards the straight rope; 0 for a rope, more for a pipe.
    top : {"pinned", "clamped", "free"}
        How the first link hangs from the anchor: by a ball joint, rigidly, or not at all.
    smooth : bool
        Draw each link as long as it is, so that the rope is one tube; as pills, links touch at their tips only.
    """

    links: int = 10
    link_length: float = 0.055
    radius: float = 0.0075
    link_mass: float = 0.010
    damping: float = 2e-4
    stiffness: float = 0.0
    top: Literal["pinned", "clamped", "free"] = "pinned"
    smooth: bool = False

    def __post_init__(self) -> None:
        if not 1 <= self.links <= MOST_LINKS:
            raise ConfigError(f"links = {self.links}: expected 1 to {MOST_LINKS}")
        if self.top not in ("pinned", "clamped", "free"):
            raise ConfigError(f"top = {self.top!r}: expected 'pinned', 'clamped' or 'free'")
        for name, least, most in (
            ("link_length", 1e-4, 10.0),
            ("radius", 1e-4, 0.5),
            ("link_mass", 1e-6, 100.0),
        ):
            if not least <= getattr(self, name) <= most:
                raise ConfigError(f"{name} = {getattr(self, name)}: expected {least:g} to {most:g}")
        for name in ("damping", "stiffness"):
            if not 0 <= getattr(self, name) < 1e6:
                raise ConfigError(f"{name} = {getattr(self, name)}: expected 0 or more")
        if not self.smooth and 2 * self.radius >= self.link_length:
            raise ConfigError(
                f"a pill of radius {self.radius} is longer than link_length = {self.link_length}: "
                "make the links longer or thinner, or smooth = true"
            )

    @property
    def length(self) -> float:
        """Of the whole rope, metres."""
        return self.links * self.link_length


@dataclass(frozen=True, slots=True)
class Wind:
    """A wind that blows to and fro: u(t) = speed sin(2 pi frequency t) direction.

    It pushes every link at its centre of mass with F = m k (u - v), as Gazebo's wind plugin does with k = 1 1/s.

    Parameters
    ----------
    frequency : float
        Hz; at 0 there is no wind at all.
    speed : float
        m/s.
    coupling : float
        k, 1/s.
    direction : (x, y, z)
        Unit vector, world frame.
    """

    frequency: float = 0.0
    speed: float = 1.0
    coupling: float = 1.0
    direction: tuple[float, float, float] = (1.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.frequency) and self.frequency >= 0):
            raise ConfigError(f"wind frequency = {self.frequency}: expected 0 Hz or more")
        if self.frequency * STEPS_PER_PERIOD * TIMESTEP > 1:
            raise ConfigError(
                f"wind frequency = {self.frequency} Hz: a step of {TIMESTEP * 1e3:.2f} ms resolves "
                f"{1 / (STEPS_PER_PERIOD * TIMESTEP):g} Hz at most"
            )
        if not (math.isfinite(self.speed) and 0 <= self.coupling < 100):
            raise ConfigError(f"wind speed = {self.speed}, coupling = {self.coupling}: expected m/s and 0 to 100 1/s")
        if not abs(math.hypot(*self.direction) - 1) <= 1e-6:
            raise ConfigError(f"wind direction = {self.direction}: expected a unit vector")

    def velocity(self, time: float) -> FloatArray:
        """Of the air, (3,), m/s."""
        return self.speed * math.sin(2 * math.pi * self.frequency * time) * np.array(self.direction)


@dataclass(frozen=True, slots=True, eq=False)
class RopeState:
    """Where a rope is.

    Parameters
    ----------
    time : float
        Seconds.
    polyline : (N + 1, 3) float array
        The paper's true curve: the start, the joints, the end; metres, world frame.
    centres : (N, 3) float array
        Centres of the links, metres.
    rotations : (N, 3, 3) float array
        Of the links: X along the rope. At rest, hanging, Y and Z are as equations 16 and 17 give them for the camera
        axis that the simulation was told.
    velocities : (N, 3) float array
        Of the centres, m/s.
    """

    time: float
    polyline: FloatArray
    centres: FloatArray
    rotations: FloatArray
    velocities: FloatArray


_HOLD = 'solref="0.01 1" solimp="0.99 0.999 0.001"'
"""How firmly the ends are held: they follow some 10 ms behind. Firmer, and the light links shake."""

EndsAt = Callable[[float], FloatArray]
"""Where the two ends of a rope are held at a time: (2, 3), metres, world frame."""


class RopeSimulation:
    """A rope in time. The same arguments give the same bytes.

    Parameters
    ----------
    model : RopeModel
        The rope.
    anchor : (x, y, z)
        Where it hangs from, metres, world frame.
    wind : Wind, optional
        Without it the air does nothing, not even brake.
    lift : float
        The straight rope starts turned about its top, in the wind's plane (x, z), until its end is this much higher
        than it hangs, at rest, and is then let go; metres.
    ends : callable, optional
        Hold both ends: where they are at each time. The rope comes to rest before time 0.
    camera_axis : (x, y, z)
        Viewing axis of the camera, world frame, for the Y and Z axes of the links.

    Raises
    ------
    ConfigError
        If the arguments do not fit, or the rope is too stiff or its links too short for the step.
    MissingExtraError
        If MuJoCo is not installed.
    """

    def __init__(
        self,
        model: RopeModel,
        anchor: tuple[float, float, float] = (0.0, 0.0, 0.0),
        wind: Wind | None = None,
        *,
        lift: float = 0.0,
        ends: EndsAt | None = None,
        camera_axis: tuple[float, float, float] = (0.0, 1.0, 0.0),
    ) -> None:
        if not 0 <= lift <= 2 * model.length:
            raise ConfigError(
                f"lift = {lift} m: a rope of {model.length:g} m can be lifted by 0 to {2 * model.length:g} m"
            )
        if lift and model.top == "clamped":
            raise ConfigError("a clamped rope cannot be lifted: its first link does not turn")
        if not np.isfinite(anchor).all():
            raise ConfigError(f"anchor = {anchor}: expected three finite numbers of metres")
        if ends is not None and (model.top != "pinned" or lift):
            raise ConfigError("a rope that is held at both ends is neither clamped nor free nor lifted")
        link_from_body = _link_axes(np.asarray(camera_axis, float))
        start = np.asarray(anchor, float) if ends is None else _held(ends, 0.0, model)[0]
        mujoco = import_extra("mujoco", "sim")
        self.model = model
        self._mujoco = mujoco
        self._wind = wind if wind is not None and wind.frequency > 0 else None
        self._ends = ends
        self._link_from_body = link_from_body
        self._physics = mujoco.MjModel.from_xml_string(_mjcf(model, start, ends is not None))
        self._data = mujoco.MjData(self._physics)
        self._links = slice(1, 1 + model.links)
        self._masses = self._physics.body_mass[self._links, None].copy()
        self._step = 0
        self._fit_to_step()
        if lift:
            self._turn_about_top(math.acos(1 - lift / model.length))
        if ends is not None:
            self._settle(ends)
        mujoco.mj_forward(self._physics, self._data)

    def _turn_about_top(self, angle: float) -> None:
        """Turn the straight rope towards +x."""
        half = -angle / 2
        quaternion = [math.cos(half), 0.0, math.sin(half), 0.0]
        first = 3 if self.model.top == "free" else 0
        self._data.qpos[first : first + 4] = quaternion

    def _fit_to_step(self) -> None:
        """Choose the integrator, or refuse the rope, by the fastest motions of the chain that hangs straight."""
        mujoco, physics, data, model = self._mujoco, self._physics, self._data, self.model
        count = model.links - (model.top != "pinned" or self._ends is not None)
        if count == 0:
            return
        # Round its own axis a thin link is so light that springs and damping would overrun the step: it is made heavier
        # for the springs, and damped so that it stops within a few steps. A rope that bends in a plane does not twist.
        physics.dof_armature[physics.nv - 3 * count + 2 :: 3] = model.stiffness * (TIMESTEP / 1.5) ** 2
        mujoco.mj_forward(physics, data)
        mass = np.zeros((physics.nv, physics.nv))
        mujoco.mj_fullM(physics, data, mass)
        first = physics.nv - 3 * count
        bend, twist = mass[first::3, first::3], mass[first + 2 :: 3, first + 2 :: 3]
        # A link's slope is the sum of the angles above it; gravity pulls each link straight by what hangs on it.
        weight = model.link_mass * GRAVITY * model.link_length * (np.arange(count, 0, -1) - 0.5)
        slope = np.tril(np.ones((count, count)))
        springs = model.stiffness * np.eye(count)
        fastest = TIMESTEP * math.sqrt(_largest(springs + slope.T * weight @ slope, bend))
        if fastest > 1.8:
            raise ConfigError(
                f"a rope of {model.links} links of {model.link_length:g} m, {model.link_mass:g} kg and stiffness "
                f"{model.stiffness:g} swings too fast for the step of {TIMESTEP * 1e3:.2f} ms: take fewer, longer or "
                "thicker links, or less stiffness"
            )
        unit = TIMESTEP * _largest(np.eye(count), twist)
        physics.dof_damping[first + 2 :: 3] = min(model.damping, 1.0 / unit)
        if model.damping * TIMESTEP * _largest(np.eye(count), bend) > 2.0:
            physics.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST

    def _settle(self, ends: EndsAt) -> None:
        """Bring the hanging rope's end to where it is held, and wait until it rests."""
        first, last = _held(ends, 0.0, self.model)
        hanging = first - [0.0, 0.0, self.model.length]
        # Straight up, the rope would not know to which side to bend.
        straight_up = np.linalg.norm((last - first)[:2]) < 0.05 * self.model.length
        bow = np.array([0.2 * self.model.length if straight_up else 0.0, 0.0, 0.0])
        slowness = math.sqrt(self.model.length / GRAVITY)
        steps = math.ceil(SETTLE_SWINGS * slowness / TIMESTEP)
        forces = self._data.xfrc_applied[self._links, :3]
        for step in range(steps):
            part = min(2 * step / steps, 1.0)
            self._data.mocap_pos[0] = first
            self._data.mocap_pos[1] = hanging + (1 - math.cos(math.pi * part)) / 2 * (last - hanging)
            self._data.mocap_pos[1] += math.sin(math.pi * part) * bow
            # Still and thick air.
            self._refresh()
            forces[:] = self._masses * (-3 / slowness) * self._velocities()
            self._mujoco.mj_step(self._physics, self._data)
        forces[:] = 0
        self._data.qvel[:] = 0
        self._data.time = 0

    @property
    def time(self) -> float:
        """Seconds since the start."""
        return self._step * TIMESTEP

    def advance(self, time: float) -> None:
        """Go on to a time, to the nearest step; not back.

        Raises
        ------
        ConfigError
            If the time is past.
        """
        target = round(time / TIMESTEP)
        if target < self._step:
            raise ConfigError(f"the simulation is at {self.time:.4f} s and does not go back to {time:.4f} s")
        mujoco, physics, data = self._mujoco, self._physics, self._data
        wind, forces = self._wind, self._data.xfrc_applied[self._links, :3]
        for step in range(self._step, target):
            now = step * TIMESTEP
            if wind is not None:
                self._refresh()
                forces[:] = self._masses * wind.coupling * (wind.velocity(now) - self._velocities())
            if self._ends is not None:
                data.mocap_pos[:] = _held(self._ends, now + TIMESTEP, self.model)
            mujoco.mj_step(physics, data)
            self._step = step + 1
        if not all(np.isfinite(array).all() and np.abs(array).max(initial=0) < 1e6 for array in (data.qpos, data.qvel)):
            raise ConfigError(
                f"the rope became unstable before {self.time:.3f} s: take fewer, longer or heavier links, less "
                "stiffness or less damping"
            )
        # After a step MuJoCo's positions and velocities are still those before it.
        self._refresh()

    def _refresh(self) -> None:
        self._mujoco.mj_kinematics(self._physics, self._data)
        self._mujoco.mj_comPos(self._physics, self._data)
        self._mujoco.mj_comVel(self._physics, self._data)

    def _velocities(self) -> FloatArray:
        """Of the links' centres of mass, (N, 3): MuJoCo gives them about the centre of mass of the whole rope."""
        motion = self._data.cvel[self._links]
        arm = self._data.xipos[self._links] - self._data.subtree_com[1]
        turn = motion[:, :3]
        result = motion[:, 3:].copy()
        result[:, 0] += turn[:, 1] * arm[:, 2] - turn[:, 2] * arm[:, 1]
        result[:, 1] += turn[:, 2] * arm[:, 0] - turn[:, 0] * arm[:, 2]
        result[:, 2] += turn[:, 0] * arm[:, 1] - turn[:, 1] * arm[:, 0]
        return result

    def state(self) -> RopeState:
        """Where the rope is now: copies."""
        rotations = self._data.xmat[self._links].reshape(-1, 3, 3)
        tops = self._data.xpos[self._links]
        end = tops[-1] - self.model.link_length * rotations[-1, :, 2]
        return RopeState(
            self.time,
            np.concatenate([tops, end[None]]),
            self._data.xipos[self._links].copy(),
            rotations @ self._link_from_body,
            self._velocities(),
        )

    def capsule_axes(self) -> tuple[FloatArray, FloatArray]:
        """Starts and ends of the links' capsule axes, each (N, 3), metres, world frame."""
        rotations = self._data.xmat[self._links].reshape(-1, 3, 3)
        tops = self._data.xpos[self._links]
        inset = 0.0 if self.model.smooth else self.model.radius
        down = -rotations[:, :, 2]
        return tops + inset * down, tops + (self.model.link_length - inset) * down

    def energy(self) -> float:
        """Kinetic and potential energy, joules; gravity's is 0 at the world's origin."""
        # The integrator leaves the mass matrix of one of its stages.
        self._mujoco.mj_crb(self._physics, self._data)
        self._mujoco.mj_energyPos(self._physics, self._data)
        self._mujoco.mj_energyVel(self._physics, self._data)
        return float(self._data.energy.sum())


def _largest(matrix: FloatArray, mass: FloatArray) -> float:
    """Largest eigenvalue of ``mass^-1 matrix``."""
    return float(scipy.linalg.eigh(matrix, mass, eigvals_only=True, subset_by_index=[len(mass) - 1] * 2)[0])


def _held(ends: EndsAt, time: float, model: RopeModel) -> FloatArray:
    """Where the ends are held, (2, 3), checked."""
    places = np.asarray(ends(time), float)
    if places.shape != (2, 3) or not np.isfinite(places).all():
        raise ConfigError(f"the held ends at {time:.3f} s are not two points of finite coordinates")
    apart = float(np.linalg.norm(places[1] - places[0]))
    if apart > model.length:
        raise ConfigError(f"the held ends are {apart:.3f} m apart at {time:.3f} s: the rope is {model.length:g} m long")
    return places


def _link_axes(camera_axis: FloatArray) -> FloatArray:
    """Columns X, Y, Z of a hanging link's frame in its body's frame, whose z axis points up."""
    x = np.array([0.0, 0.0, -1.0])
    y = np.cross(x, camera_axis)
    if not 1e-6 <= np.linalg.norm(y) < math.inf:
        raise ConfigError(f"camera_axis = {camera_axis}: a camera that looks along a hanging rope gives it no frame")
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def _mjcf(model: RopeModel, start: FloatArray, held: bool) -> str:
    """The rope as MuJoCo's XML: a chain that hangs down from its start."""
    inset = 0.0 if model.smooth else model.radius
    geometry = (
        f'<geom type="capsule" size="{model.radius!r}" mass="{model.link_mass!r}" contype="0" conaffinity="0" '
        f'fromto="0 0 {-inset!r} 0 0 {inset - model.link_length!r}"/>'
    )
    joint = f'<joint type="ball" damping="{model.damping!r}" stiffness="{model.stiffness!r}"/>'
    first = {"pinned": joint, "clamped": "", "free": "<freejoint/>"}[model.top]
    body = ""
    for link in reversed(range(model.links)):
        place = " ".join(map(repr, start.tolist())) if link == 0 else f"0 0 {-model.link_length!r}"
        tip = f'<site name="end" pos="0 0 {-model.link_length!r}"/>' if link == model.links - 1 else ""
        body = f'<body name="link{link}" pos="{place}">{joint if link else first}{geometry}{tip}{body}</body>'
    holds = ties = ""
    if held:
        end = start - [0.0, 0.0, model.length]
        body = body.replace(first, "<freejoint/>", 1)
        holds = "".join(
            f'<body name="hold{k}" mocap="true" pos="{" ".join(map(repr, place.tolist()))}"><site name="hold{k}"/>'
            "</body>"
            for k, place in enumerate((start, end))
        )
        body = body.replace("<freejoint/>", '<freejoint/><site name="start"/>', 1)
        ties = (
            f'<equality><connect site1="start" site2="hold0" {_HOLD}/>'
            f'<connect site1="end" site2="hold1" {_HOLD}/></equality>'
        )
    integrator = "implicitfast" if held else "RK4"
    return (
        f'<mujoco><option timestep="{TIMESTEP!r}" integrator="{integrator}" gravity="0 0 {-GRAVITY!r}">'
        '<flag contact="disable" energy="disable" autoreset="disable"/></option>'
        f"<worldbody>{body}{holds}</worldbody>{ties}</mujoco>"
    )
