"""Parameters of the tracker of Schulman et al.: as published (ICRA 2013, and the sources they refer to), and tuned."""

from __future__ import annotations

from dataclasses import dataclass

from ropetrace.errors import ConfigError


@dataclass(frozen=True, slots=True)
class SchulmanSettings:
    """Parameters; the defaults are the published ones, in metres where they have 100 units a metre.

    Raises
    ------
    ConfigError
        If a value is impossible.
    """

    nodes: int = 100
    """Points of the path; the rope has one link less."""
    iterations: int | None = 10
    """A frame."""
    budget: float | None = None
    """Seconds a frame in the place of `iterations`: as published, it goes on until the next cloud arrives."""
    voxel: float = 0.02
    """The cloud is thinned to the mean point of each cube of this edge, metres."""
    position_deviation: float = 0.02
    """Prior deviation d of a point from its link along each axis, metres."""
    color_deviation: tuple[float, float, float] = (0.4, 0.08, 0.08)
    """The same of L*, a* and b*, in hundreds of CIELAB units. Frames without colour are told by their places alone."""
    prior_weight: float = 10.0
    """nu: as many points as the prior of the deviations counts for."""
    gain: float = 1.0
    """k_p: what a metre between a link and its points adds to its velocity in each iteration, m/s."""
    damping: float = 0.0
    """k_d: the part of a link's velocity that each iteration takes away."""
    step: float = 0.015
    """Of the simulation, seconds of its own time."""
    steps: int = 2
    """In an iteration."""
    linear_damping: float = 0.75
    angular_damping: float = 1.0
    """Of the links, as Bullet counts it: see `ImpulseChain`."""
    joint_stiffness: float = 1e-5
    """N m/rad: 0.1 with 1 kg a link and 100 units a metre. Bullet's spring damping of 1 is none."""
    joint_limit: float = 0.4
    """Radians."""
    gravity: float = 0.1
    """m/s^2."""
    visibility_margin: float = 0.03
    """A link is hidden where the depth image shows something nearer than it by more than this, metres."""
    anchored: bool = False
    """Whether the first waypoint of the start is held where it is: for a rope that is known to hang from there."""
    restart_after: int = 3
    """So many lost frames in a row, and it starts again from the slicing tracker."""

    def __post_init__(self) -> None:
        if not 3 <= self.nodes <= 401:
            raise ConfigError(f"nodes = {self.nodes}: expected 3 to 401")
        if (self.iterations is None) == (self.budget is None):
            raise ConfigError("give either iterations or budget, and None for the other")
        for name in ("iterations", "steps", "restart_after"):
            value = getattr(self, name)
            if value is not None and not 1 <= value <= 100_000:
                raise ConfigError(f"{name} = {value}: expected 1 or more")
        for name in ("budget", "voxel", "position_deviation", "prior_weight", "gain", "step", "joint_limit"):
            value = getattr(self, name)
            if value is not None and not 0 < value < 1e6:
                raise ConfigError(f"{name} = {value}: expected more than 0")
        for name in ("damping", "linear_damping", "angular_damping"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"{name} = {getattr(self, name)}: expected 0 to 1")
        for name in ("joint_stiffness", "gravity", "visibility_margin"):
            if not 0 <= getattr(self, name) < 1e6:
                raise ConfigError(f"{name} = {getattr(self, name)}: expected 0 or more")
        if not all(0 < deviation < 1e6 for deviation in self.color_deviation):
            raise ConfigError(f"color_deviation = {self.color_deviation}: expected more than 0")


SWINGING = SchulmanSettings(nodes=45, voxel=0.01, damping=0.25, steps=1, linear_damping=0.95, anchored=True)
"""Tuned by benchmarks/schulman.py for the swinging rope of case study 1, which hangs from its first waypoint."""
