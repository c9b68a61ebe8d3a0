"""Scenes that are simulated from a short description: a rope, a wind, a camera, and what stands about.

A scenario is a TOML file; the package ships some (`scenario_names`). World frame: z up, metres, seconds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ropetrace.config import Vector, from_table, read_toml
from ropetrace.errors import ConfigError
from ropetrace.evaluation.metrics import resample
from ropetrace.sim.camera import DepthCamera
from ropetrace.sim.curtain import CurtainSettings
from ropetrace.sim.curve import CurveRope, CurveSettings
from ropetrace.sim.noise import noise_model
from ropetrace.sim.rope import STEPS_PER_PERIOD, TIMESTEP, EndsAt, RopeModel, RopeSimulation, RopeState, Wind
from ropetrace.sim.scene import Boxes, Capsules, Plane, Scene, check_camera_outside, inverse_pose, looking_at
from ropetrace.sim.visibility import visible_fraction
from ropetrace.types import FloatArray, RgbdFrame, moved

ROPE, SECOND_ROPE, CLUTTER = 0, 1, 2
"""Labels of what is in a scene."""

ROPE_COLOR = (200, 40, 30)
_CLUTTER_COLOR = (150, 150, 140)
ROBOT_COLOR = (225, 225, 220)


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """The `[camera]` table of a scenario."""

    width: int = 640
    height: int = 480
    fov_degrees: float = 60.0
    """Horizontal field of view."""
    rate: float = 30.0
    """Frames per second."""
    position: Vector = (0.0, -1.0, 0.675)
    look_at: Vector = (0.0, 0.0, 0.675)
    noise: str = "none"
    """One of `ropetrace.sim.noise.NOISE_MODELS`."""
    exposure: float = 0.0
    latency: float = 0.0
    motion_blur: bool = False
    depth_unit: float | None = 0.001
    """Metres in a step of uint16 depth."""
    exact_depth: bool = False
    """Depth in float32 metres, without steps, in the place of `depth_unit`; an RGB-D folder cannot hold it."""

    def camera(self, seed: int) -> DepthCamera:
        """The camera."""
        return DepthCamera(
            self.width,
            self.height,
            math.radians(self.fov_degrees),
            self.rate,
            looking_at(self.position, self.look_at),
            noise_model(self.noise),
            self.exposure,
            self.latency,
            self.motion_blur,
            None if self.exact_depth else self.depth_unit,
            seed,
        )


@dataclass(frozen=True, slots=True)
class MotionSettings:
    """The `[motion]` table of a scenario: what moves the rope but the wind."""

    anchor: Vector = (0.0, 0.0, 0.95)
    """Where the rope hangs from, or its start where both ends are held."""
    lift: float = 0.0
    """The rope is let go with its end this much higher than it hangs."""
    far_end: Vector | None = None
    """Hold both ends: where the other one is."""
    sway: Vector = (0.0, 0.0, 0.0)
    """Amplitude with which the held far end moves to and fro."""
    sway_frequency: float = 0.5
    """Hz."""

    def __post_init__(self) -> None:
        for name in ("anchor", "far_end", "sway", "sway_frequency"):
            if getattr(self, name) is not None and not np.isfinite(getattr(self, name)).all():
                raise ConfigError(f"motion.{name} = {getattr(self, name)}: expected finite numbers")
        if self.far_end is None and any(self.sway):
            raise ConfigError("motion.sway moves a held end: give motion.far_end, or leave it out")
        most = 1 / (STEPS_PER_PERIOD * TIMESTEP)
        if not 0 <= self.sway_frequency <= most:
            raise ConfigError(f"motion.sway_frequency = {self.sway_frequency}: expected 0 to {most:g} Hz")

    def ends(self) -> EndsAt | None:
        """Where both ends are held at a time, if they are."""
        if self.far_end is None:
            return None
        near, far, sway = np.array(self.anchor), np.array(self.far_end), np.array(self.sway)

        def ends(time: float) -> FloatArray:
            return np.stack([near, far + sway * math.sin(2 * math.pi * self.sway_frequency * time)])

        return ends


@dataclass(frozen=True, slots=True)
class ClutterSettings:
    """The `[clutter]` table of a scenario: what else the camera sees. Nothing collides: the rope passes through it."""

    wall: float | None = None
    """A wall at this y."""
    floor: float | None = None
    """A floor at this z."""
    boxes: tuple[tuple[float, float, float, float, float, float], ...] = ()
    """Boxes: the centre x, y, z and the edges; in front of the rope they hide it."""
    robot: tuple[tuple[float, float, float, float, float, float, float], ...] = ()
    """Links of a robot: capsules from x, y, z to x, y, z with a radius."""
    second_rope: Vector | None = None
    """Another rope of the same kind and colour, that moves as the first does, this far from it."""
    rope_color: bool = False
    """Boxes and robot have the rope's colour."""

    def __post_init__(self) -> None:
        for name in ("wall", "floor", "boxes", "robot", "second_rope"):
            value = getattr(self, name)
            if value is not None and not np.isfinite(value).all():
                raise ConfigError(f"clutter.{name} = {value}: expected finite numbers")
        if any(min(box[3:]) <= 0 for box in self.boxes):
            raise ConfigError("clutter.boxes: the last three numbers of a box are its edges, above 0")
        if any(link[6] <= 0 for link in self.robot):
            raise ConfigError("clutter.robot: the last number of a link is its radius, above 0")


@dataclass(frozen=True, slots=True)
class Scenario:
    """A simulated recording, described.

    Raises
    ------
    ConfigError
        If a value is impossible, before anything runs.
    """

    description: str = ""
    duration: float = 10.0
    """Seconds."""
    seed: int = 0
    rope: RopeModel = field(default_factory=RopeModel)
    wind: Wind = field(default_factory=Wind)
    motion: MotionSettings = field(default_factory=MotionSettings)
    camera: CameraSettings = field(default_factory=CameraSettings)
    clutter: ClutterSettings = field(default_factory=ClutterSettings)
    curtain: CurtainSettings = field(default_factory=CurtainSettings)
    curve: CurveSettings = field(default_factory=CurveSettings)

    def __post_init__(self) -> None:
        if not 0 < self.duration <= 86400:
            raise ConfigError(f"duration = {self.duration}: expected more than 0, and 86400 seconds at most")
        motion = self.motion
        if motion.far_end is not None:
            # The ends are farthest apart where the sway turns round.
            far, sway = np.subtract(motion.far_end, motion.anchor), np.array(motion.sway)
            apart = max(float(np.linalg.norm(far + sway)), float(np.linalg.norm(far - sway)))
            if apart > self.rope.length:
                raise ConfigError(
                    f"motion.far_end gets {apart:.3f} m from motion.anchor, and the rope is {self.rope.length:g} m long"
                )
        if self.curve.radius is not None and (motion != MotionSettings() or self.wind != Wind()):
            raise ConfigError("a rope that is led along a curve takes no motion and no wind: leave out those tables")
        if self.curve.arc > self.rope.length:
            raise ConfigError(
                f"the arc of curve takes {self.curve.arc:.3f} m, and the rope is {self.rope.length:g} m long"
            )

    @property
    def frame_count(self) -> int:
        """Frames in the recording."""
        return max(round(self.duration * self.camera.rate), 1)


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What is true of a frame.

    Parameters
    ----------
    state : RopeState
        The rope at the frame's stamp, world frame.
    polyline : (N + 1, 3) float array
        Start, joints and end, metres, camera frame.
    link_quaternions : (N, 4) float array
        Orientation of the links, ``xyzw``, camera frame.
    visible_fraction : float
        Share of the rope's length that the camera sees, 0 to 1.
    """

    state: RopeState
    polyline: FloatArray
    link_quaternions: FloatArray
    visible_fraction: float


class SimulatedScene:
    """A scenario in time.

    Parameters
    ----------
    scenario : Scenario
        What is simulated.

    Attributes
    ----------
    robot : Capsules
        The robot's links, world frame. Those of the scenario stand still; whoever moves an arm sets its own.

    Raises
    ------
    ConfigError
        If the camera is inside something.
    MissingExtraError
        If MuJoCo is not installed.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.camera = scenario.camera.camera(scenario.seed)
        assert self.camera.world_from_camera is not None
        self.world_from_camera = self.camera.world_from_camera
        self._camera_from_world = inverse_pose(self.world_from_camera)
        self.rope = _rope(scenario, self.world_from_camera[:3, 2])
        clutter = scenario.clutter
        self._planes = tuple(
            Plane(normal, place, _CLUTTER_COLOR, CLUTTER)
            for normal, place in (((0.0, 1.0, 0.0), clutter.wall), ((0.0, 0.0, 1.0), clutter.floor))
            if place is not None
        )
        self._boxes = Boxes.none()
        for x, y, z, width, depth, height in clutter.boxes:
            color = ROPE_COLOR if clutter.rope_color else _CLUTTER_COLOR
            self._boxes += Boxes.one((x, y, z), (width, depth, height), color, CLUTTER)
        self.robot = Capsules.none()
        for link in clutter.robot:
            ends = np.array(link[:6]).reshape(2, 1, 3)
            color = ROPE_COLOR if clutter.rope_color else ROBOT_COLOR
            self.robot += Capsules.between(ends[0], ends[1], link[6], color, CLUTTER)
        check_camera_outside(Scene(Capsules.none(), boxes=self._curtain(math.inf)), self.world_from_camera)
        check_camera_outside(self.scene(), self.world_from_camera)

    def scene(self) -> Scene:
        """What there is to see now, world frame."""
        starts, ends = self.rope.capsule_axes()
        capsules = Capsules.between(starts, ends, self.scenario.rope.radius, ROPE_COLOR, ROPE)
        if self.scenario.clutter.second_rope is not None:
            aside = np.array(self.scenario.clutter.second_rope)
            capsules += Capsules.between(
                starts + aside, ends + aside, self.scenario.rope.radius, ROPE_COLOR, SECOND_ROPE
            )
        return Scene(capsules + self.robot, self._planes, self._boxes + self._curtain(self.rope.time))

    def _curtain(self, time: float) -> Boxes:
        return self.scenario.curtain.boxes(time, _CLUTTER_COLOR, CLUTTER)

    def truth(self) -> Truth:
        """What is true now."""
        state = self.rope.state()
        turn = self._camera_from_world[:3, :3]
        samples = resample(state.polyline, 0.001)
        seen = visible_fraction(
            self.scene(),
            self.camera.intrinsics,
            samples,
            self.scenario.rope.radius,
            ROPE,
            self.world_from_camera,
        )
        return Truth(
            state,
            moved(state.polyline, self._camera_from_world),
            np.asarray(Rotation.from_matrix(turn @ state.rotations).as_quat()),
            seen,
        )

    def scene_at(self, time: float) -> Scene:
        """Go on to a time, and what there is to see then."""
        self.rope.advance(max(time, 0.0))
        return self.scene()

    def frames(self) -> Iterator[tuple[RgbdFrame, Truth]]:
        """The recording, frame by frame, each with what is true at its stamp."""
        for index in range(self.scenario.frame_count):
            stamp = self.camera.stamp(index)
            if self.camera.motion_blur and self.camera.exposure > 0:
                # The exposure is centred on the stamp; the truth at the stamp comes half way through it.
                yield self._blurred_frame(stamp, index)
            else:
                frame = self.camera.expose(self.scene_at, stamp, index)
                yield frame, self.truth()

    def _blurred_frame(self, stamp: float, index: int) -> tuple[RgbdFrame, Truth]:
        truths: list[Truth] = []

        def scene_at(time: float) -> Scene:
            if not truths and time >= stamp:
                self.rope.advance(stamp)
                truths.append(self.truth())
            return self.scene_at(time)

        frame = self.camera.expose(scene_at, stamp, index)
        return frame, truths[0]


def _rope(scenario: Scenario, camera_axis: FloatArray) -> RopeSimulation | CurveRope:
    """What moves the rope: physics, or the curve that it is led along."""
    axis = (float(camera_axis[0]), float(camera_axis[1]), float(camera_axis[2]))
    if scenario.curve.radius is not None:
        return CurveRope(scenario.curve, scenario.rope, axis)
    motion = scenario.motion
    return RopeSimulation(
        scenario.rope,
        motion.anchor,
        scenario.wind,
        lift=motion.lift,
        ends=motion.ends(),
        camera_axis=axis,
    )


def scenario_names() -> list[str]:
    """The scenarios that the package ships."""
    files = resources.files(__package__).joinpath("scenarios").iterdir()
    return sorted(file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml"))


def load_scenario(name: str) -> Scenario:
    """A scenario of the package by its name, or any by the path of its TOML file.

    Raises
    ------
    ConfigError
        If there is none, or it is wrong; the message names the setting.
    """
    path = Path(name)
    if path.suffix == ".toml":
        table = read_toml(path)
    elif name in scenario_names():
        with resources.as_file(resources.files(__package__).joinpath("scenarios", f"{name}.toml")) as file:
            table = read_toml(file)
    else:
        raise ConfigError(f"unknown scenario {name!r}: give a .toml file or one of {', '.join(scenario_names())}")
    try:
        return from_table(Scenario, table)
    except ConfigError as error:
        raise ConfigError(f"scenario {name}: {error}") from None
