"""An elastic pipe that is clamped at one end, lifted, and let go (section 6.4).

World frame: z up, metres, seconds, kilograms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from ropetrace.errors import ConfigError, import_extra
from ropetrace.sim.rope import GRAVITY, TIMESTEP
from ropetrace.types import FloatArray

_STEEPEST = 1.5
"""Largest angle by which the fastest mode of the chain of links may turn in a step, radians: 2 is the limit."""


@dataclass(frozen=True, slots=True)
class PipeModel:
    """A tube as a chain of stiff links; the size is the paper's, the material that of a soft PVC hose.

    It swings at 1.25 Hz: as a beam without weight it would at 1.0, and as a rope at 0.7.

    Parameters
    ----------
    length, radius, wall : float
        Metres; the wall is its thickness.
    modulus : float
        Young's, Pa.
    density : float
        Of the wall, kg/m^3.
    retardation : float
        How long the material takes to give way: the bending moment is EI (curvature + retardation d curvature/dt),
        seconds. 3 ms damps the swing by 0.6 % of the critical.
    tilt : float
        Direction of the clamp, from straight down (0) to horizontal (pi/2), radians.
    links : int
        How many.
    """

    length: float = 0.70
    radius: float = 0.0125
    wall: float = 0.0025
    modulus: float = 15e6
    density: float = 1250.0
    retardation: float = 0.003
    tilt: float = 0.0
    links: int = 20

    def __post_init__(self) -> None:
        for name in ("length", "radius", "wall", "modulus", "density"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"{name} = {getattr(self, name)}: expected more than 0")
        if self.wall > self.radius:
            raise ConfigError(f"wall = {self.wall}: thicker than the radius, {self.radius}")
        if not 0 <= self.retardation < 1 or not 0 <= self.tilt <= math.pi / 2:
            raise ConfigError(f"retardation = {self.retardation}, tilt = {self.tilt}: expected 0 to 1 s and 0 to pi/2")
        if not 2 <= self.links <= 60:
            raise ConfigError(f"links = {self.links}: expected 2 to 60")

    @property
    def bending_stiffness(self) -> float:
        """EI, N m^2."""
        return self.modulus * math.pi / 4 * (self.radius**4 - (self.radius - self.wall) ** 4)

    @property
    def mass_per_length(self) -> float:
        """kg/m."""
        return self.density * math.pi * (self.radius**2 - (self.radius - self.wall) ** 2)

    @property
    def link_length(self) -> float:
        """Metres."""
        return self.length / self.links

    @property
    def steps(self) -> int:
        """Steps of the integration in one of `rope.TIMESTEP`: the fastest mode turns by sqrt(EI / mass) 4 / link^2."""
        fastest = math.sqrt(self.bending_stiffness / self.mass_per_length) * 4 / self.link_length**2
        return math.ceil(fastest * TIMESTEP / _STEEPEST)


class PipeSimulation:
    """A pipe in time. The same arguments give the same bytes.

    Parameters
    ----------
    model : PipeModel
        The pipe.
    anchor : (x, y, z)
        The clamp, metres.
    lift : float
        At time 0 the pipe, pulled across its clamp's direction until its free end is this much higher than at rest, is
        let go; metres.
    azimuth : float
        Of the plane in which it is pulled, from x towards y, radians.

    Raises
    ------
    ConfigError
        If it cannot be lifted so far.
    MissingExtraError
        If MuJoCo is not installed.
    """

    def __init__(
        self,
        model: PipeModel,
        anchor: tuple[float, float, float] = (0.0, 0.0, 0.0),
        lift: float = 0.0,
        azimuth: float = 0.0,
    ) -> None:
        self._mujoco = mujoco = import_extra("mujoco", "sim")
        self.model = model
        self._physics = mujoco.MjModel.from_xml_string(_mjcf(model, anchor, azimuth))
        self._data = mujoco.MjData(self._physics)
        angles = lifted_angles(model, lift)
        self._data.qpos[0::2] = -np.diff(angles, prepend=model.tilt)
        self._done = 0
        mujoco.mj_forward(self._physics, self._data)

    def advance(self, time: float) -> None:
        """Go on to a time, to the nearest `rope.TIMESTEP`; not back.

        Raises
        ------
        ConfigError
            If the time is past, or the pipe became unstable.
        """
        target = round(time / TIMESTEP)
        if target < self._done:
            raise ConfigError(f"the pipe is at {self._done * TIMESTEP:.4f} s and does not go back to {time:.4f} s")
        self._mujoco.mj_step(self._physics, self._data, (target - self._done) * self.model.steps)
        self._done = target
        if not (np.isfinite(self._data.qpos).all() and np.abs(self._data.qpos).max() < 10):
            raise ConfigError(f"the pipe became unstable before {time:.3f} s: take fewer links, or a softer material")
        self._mujoco.mj_kinematics(self._physics, self._data)

    def axis(self) -> FloatArray:
        """From the clamp to the free end, (links + 1, 3), metres: a copy."""
        tops = self._data.xpos[1:]
        down = -self._data.xmat[-1].reshape(3, 3)[:, 2]
        return np.concatenate([tops, [tops[-1] + self.model.link_length * down]])


def lifted_angles(model: PipeModel, lift: float) -> FloatArray:
    """Angle of each link from straight down, (links,), radians, where the pipe is pulled up and rests.

    The pull acts at the free end, across the direction of the clamp.

    Raises
    ------
    ConfigError
        If no pull lifts the end so far.
    """
    rest = _end_height(model, _resting(model, 0.0))

    def too_high(pull: float) -> float:
        return _end_height(model, _resting(model, pull)) - rest - lift

    if lift == 0:
        return _resting(model, 0.0)
    most = model.mass_per_length * model.length * GRAVITY
    while too_high(most) < 0:
        most *= 2
        if most > 1e3 * model.mass_per_length * model.length * GRAVITY:
            raise ConfigError(f"lift = {lift} m: no pull across the clamp lifts a pipe of {model.length:g} m so far")
    return _resting(model, float(brentq(too_high, 0.0, most, xtol=1e-12)))


def _end_height(model: PipeModel, angles: FloatArray) -> float:
    return -model.link_length * float(np.cos(angles).sum())


def _resting(model: PipeModel, pull: float) -> FloatArray:
    """Angles at which the energy of bending, weight and pull is least, by Newton's method.

    The angle between a link and the next has the spring EI/l; that between the clamp and the first link, half a link
    away from its middle, twice as much.
    """
    count, length = model.links, model.link_length
    weight = model.mass_per_length * length**2 * GRAVITY * (np.arange(count, 0, -1) - 0.5)
    springs = np.full(count, model.bending_stiffness / length)
    springs[0] *= 2
    change = np.eye(count) - np.eye(count, k=-1)
    bending = change.T @ np.diag(springs) @ change
    clamp = np.zeros(count)
    clamp[0] = springs[0] * model.tilt
    across, along = pull * length * math.cos(model.tilt), pull * length * math.sin(model.tilt)
    angles = np.full(count, model.tilt)
    for _ in range(200):
        sines, cosines = np.sin(angles), np.cos(angles)
        slope = bending @ angles - clamp + weight * sines - across * cosines - along * sines
        curvature = bending + np.diag(np.maximum(weight * cosines + across * sines - along * cosines, 0.0))
        step = np.linalg.solve(curvature, slope)
        angles = angles - step * min(1.0, 0.3 / max(float(np.abs(step).max()), 1e-300))
        if np.abs(step).max() < 1e-13:
            break
    return angles


def _mjcf(model: PipeModel, anchor: tuple[float, float, float], azimuth: float) -> str:
    """The pipe as MuJoCo's XML: it does not twist, so that two hinges make a joint; links run along -z."""
    length = model.link_length
    mass = model.mass_per_length * length
    # Of a thin tube, about its middle.
    mean = model.radius - model.wall / 2
    across, along = mass * (length**2 / 12 + mean**2 / 2), mass * mean**2
    inertia = f'<inertial pos="0 0 {-length / 2!r}" mass="{mass!r}" diaginertia="{across!r} {across!r} {along!r}"/>'
    body = ""
    for link in reversed(range(model.links)):
        stiffness = model.bending_stiffness / length * (1 if link else 2)
        bend = f'type="hinge" stiffness="{stiffness!r}" damping="{stiffness * model.retardation!r}"'
        joints = f'<joint axis="0 1 0" {bend}/><joint axis="1 0 0" {bend}/>'
        place = f'pos="0 0 {-length!r}"'
        if link == 0:
            place = f'pos="{" ".join(map(repr, map(float, anchor)))}" euler="0 {-model.tilt!r} {azimuth!r}"'
        body = f"<body {place}>{joints}{inertia}{body}</body>"
    return (
        '<mujoco><compiler angle="radian" eulerseq="XYZ"/>'
        f'<option timestep="{TIMESTEP / model.steps!r}" integrator="implicitfast" gravity="0 0 {-GRAVITY!r}">'
        '<flag contact="disable" autoreset="disable"/></option>'
        f"<worldbody>{body}</worldbody></mujoco>"
    )
