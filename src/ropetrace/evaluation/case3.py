"""Case study 3 (section 6.4): trackers of a pipe that is dropped, against markers as motion capture gives them.

The pipe hangs from a clamp and is let go with its free end lifted. A stereo camera sees it; eight markers along it are
measured by another system, on a clock of its own. The paper measures "almost identical to Case Study 1": from each
waypoint to the true curve, which here is a spline through the markers. Waypoints that cannot be projected onto it, as
they lie beyond the first or the last marker, are left out. Beside it, the distance in both directions, since the
paper's does not see what a tracker misses.

Frames and centrelines are compared at the frames' stamps: no latency is simulated, and nothing depends on the machine.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ropetrace.config import OrderingConfig, RopeConfig, format_color
from ropetrace.errors import ConfigError
from ropetrace.evaluation.clocks import clock_offset
from ropetrace.evaluation.methods import case_tracker, check_method
from ropetrace.evaluation.metrics import coverage, distances_to_curve, projections
from ropetrace.sim.camera import DepthCamera
from ropetrace.sim.noise import noise_model
from ropetrace.sim.pipe import PipeModel, PipeSimulation
from ropetrace.sim.rope import TIMESTEP
from ropetrace.sim.scene import Capsules, Scene, inverse_pose, looking_at
from ropetrace.trackers import Tracker
from ropetrace.types import Estimate, FloatArray, RgbdFrame, moved

HEIGHTS = tuple(index * 0.005 for index in range(10))
"""From which the free end is dropped, metres."""

REPEATS = 3
"""Drops from each height."""

COLOR = (200, 40, 30)
_COVERED = 0.010
_MARKED_STEP = 0.002
"""Arc length between samples of the curve through the markers, metres."""

_SPEED_SPAN = 1 / 15
"""Speeds are means over this time, seconds, so that the markers' noise adds little."""

_ANCHOR = (0.0, 0.0, 0.35)


@dataclass(frozen=True, slots=True)
class Case3:
    """A drop that a method tracks.

    Parameters
    ----------
    height : float
        How far the free end is lifted, metres.
    repeat : int
        Which of the drops, from 0.
    method : str
        Of `ropetrace.evaluation.methods.CASE_METHODS`.
    """

    height: float
    repeat: int
    method: str

    @property
    def name(self) -> str:
        """Such as slicing_15mm_1 for the first of several."""
        return f"{self.method}_{self.height * 1e3:g}mm_{self.repeat + 1}"

    @property
    def work(self) -> float:
        """More takes longer: every method does, next to slicing."""
        return float(self.method != "slicing")


@dataclass(frozen=True, slots=True)
class Case3Settings:
    """What is run; numbers without a word on them are the paper's."""

    duration: float = 15.0
    """Seconds that are recorded."""
    skip: float = 2.0
    """Seconds at the start that are not judged."""
    rate: float = 30.0
    """Frames a second."""
    width: int = 848
    height: int = 480
    fov_degrees: float = 89.2
    """Of a RealSense D435 in that mode; the paper does not name its camera."""
    distance: float = 1.0
    """From the camera to the pipe, metres; not in the paper."""
    noise: str = "stereo"
    markers: int = 8
    marker_spacing: float = 0.077
    """Metres of arc length; the first is at the swinging end."""
    marker_noise: float = 0.0002
    """Deviation along each axis, metres: that of good motion capture."""
    marker_offset: float = 0.0
    """How far markers stand off the axis, sideways to the camera's view, metres. 0 is a system that is told its
    markers' places on the pipe; the radius and half a marker, some 17 mm, is one that is not."""
    marker_rate: float = 120.0
    """Hz; the paper has 30."""
    clock_range: float = 0.25
    """The clock of the markers is off by an unknown constant of at most so much, seconds, which is found anew in each
    recording."""
    azimuth_deviation: float = 0.1
    """Drops differ in the plane of the swing, by this about the one across the camera's view, radians."""
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.skip < self.duration <= 1e4:
            raise ConfigError(f"skip = {self.skip}, duration = {self.duration}: expected seconds, skip the less")
        if self.markers < 3 or not self.marker_spacing > 0:
            raise ConfigError(f"markers = {self.markers}, {self.marker_spacing} m apart: expected 3 or more")
        if not 0 <= self.clock_range <= 1:
            raise ConfigError(f"clock_range = {self.clock_range}: expected 0 to 1 s")
        noise_model(self.noise)


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """One case, judged. Arrays of (F,), a row for each frame after the skipped ones; NaN where there is no estimate.

    Parameters
    ----------
    time : float
        Of the camera's clock, seconds.
    status : str
        Of the estimate.
    linear : float
        The paper's error: mean distance of the waypoints that project onto the curve of the markers to it, metres.
    to_markers : float
        Mean distance of the markers to the tracked curve, metres.
    symmetric : float
        Half the sum of `linear` and the mean distance of the markers' curve to the tracked one, metres.
    coverage : float
        Share of the markers' curve within 10 mm of the tracked one.
    speed : float
        Of the fastest marker, m/s.
    clock_error : float
        Found offset of the markers' clock less the true one, seconds, () array; NaN where nothing moved and none was
        looked for.
    """

    time: FloatArray
    status: NDArray[np.str_]
    linear: FloatArray
    to_markers: FloatArray
    symmetric: FloatArray
    coverage: FloatArray
    speed: FloatArray
    clock_error: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class MarkerTrack:
    """What a motion-capture system recorded.

    Parameters
    ----------
    times : (S,) float array
        By its own clock, seconds.
    positions : (S, M, 3) float array
        Camera frame, metres; markers in order along the rope.
    """

    times: FloatArray
    positions: FloatArray

    def at(self, times: FloatArray) -> FloatArray:
        """Positions at other times of the same clock, (T, M, 3), by a cubic spline; those of the ends beyond them."""
        return CubicSpline(self.times, self.positions)(np.clip(times, self.times[0], self.times[-1]))


def camera_of(settings: Case3Settings, seed: int, pose: FloatArray | None) -> DepthCamera:
    """The camera that the settings describe, with a seed for its noise and a pose, world from camera."""
    field_of_view = math.radians(settings.fov_degrees)
    noise = noise_model(settings.noise)
    return DepthCamera(
        settings.width, settings.height, field_of_view, settings.rate, pose, noise, depth_unit=0.001, seed=seed
    )


def run_case(case: Case3, settings: Case3Settings) -> Tracked:
    """One drop in simulation, tracked and judged; the same arguments give the same bytes.

    Raises
    ------
    ConfigError
        If a setting is impossible.
    """
    pose = looking_at((0.0, -settings.distance, 0.0), (0.0, 0.0, 0.0))
    camera_from_world = inverse_pose(pose)
    # Of all methods the same.
    rng = np.random.default_rng([settings.seed, round(case.height * 1e6), case.repeat])
    model = PipeModel()
    azimuth = float(rng.normal(0.0, settings.azimuth_deviation))
    offset = float(rng.uniform(-settings.clock_range, settings.clock_range))
    phase, marker_phase = rng.uniform(0, 1, 2)
    camera = camera_of(settings, int(rng.integers(2**31)), pose)

    frame_times = _whole_steps((np.arange(round(settings.duration * settings.rate)) + phase) / settings.rate)
    sample = np.arange(math.ceil((settings.duration + 2 * settings.clock_range) * settings.marker_rate))
    marker_times = _whole_steps((sample + marker_phase) / settings.marker_rate)
    pipe = PipeSimulation(model, _ANCHOR, case.height, azimuth)
    axes = _axes_at(pipe, np.union1d(frame_times, marker_times))

    arc = np.asarray(model.length - np.arange(settings.markers) * settings.marker_spacing, np.float64)
    places = moved(np.concatenate([_along(axes[time], arc) for time in marker_times]), camera_from_world)
    places = places.reshape(len(marker_times), settings.markers, 3)
    sideways = _sideways(places) * settings.marker_offset
    noise = rng.normal(0.0, settings.marker_noise, places.shape)
    markers = MarkerTrack(marker_times + offset, places + sideways + noise)

    def frames() -> Iterable[RgbdFrame]:
        for index, time in enumerate(frame_times):
            tube = Scene(Capsules.along(axes[time], model.radius, COLOR))
            yield camera.expose(lambda _, tube=tube: tube, float(time), index)  # type: ignore[misc]

    anchor = moved(np.array([_ANCHOR]), camera_from_world)[0]
    config = RopeConfig(
        2 * model.radius,
        format_color(COLOR),
        ordering=OrderingConfig(first="point", first_point=(float(anchor[0]), float(anchor[1]), float(anchor[2]))),
    )
    return judged(frames(), markers, case_tracker(case.method, config), config, settings, offset)


def judged(
    frames: Iterable[RgbdFrame],
    markers: MarkerTrack,
    tracker: Tracker,
    config: RopeConfig,
    settings: Case3Settings,
    true_offset: float | None,
) -> Tracked:
    """Track frames, bring the markers to their clock, and compare.

    Parameters
    ----------
    frames : iterable of RgbdFrame
        In order.
    markers : MarkerTrack
        Camera frame; their clock is `true_offset` ahead.
    tracker : Tracker
        Takes every frame.
    config : RopeConfig
        Tells the points of the rope, whose mean is what the clocks are compared by: it is the same for all methods.
    settings : Case3Settings
        `skip` and `clock_range` count.
    true_offset : float, optional
        Of the markers' clock, seconds, to judge what is found. None where the clocks are one: none is looked for.
    """
    times, centres, estimates = [], [], []
    witness = case_tracker("slicing", config)
    for frame in frames:
        times.append(frame.stamp_ns / 1e9)
        estimates.append(tracker.update(frame))
        witness.update(frame)
        points = witness.cloud().points
        centres.append(points.mean(axis=0) if len(points) else np.full(3, np.nan))
    stamps = np.array(times)
    offset = None
    if true_offset is not None:
        means = markers.positions.mean(axis=1)
        offset = clock_offset(stamps, np.array(centres), markers.times, means, settings.clock_range)
    shift = 0.0 if offset is None else offset
    missing = math.nan if offset is None or true_offset is None else offset - true_offset
    true = markers.at(stamps + shift)
    before, after = (markers.at(stamps + shift + side * _SPEED_SPAN / 2) for side in (-1, 1))
    speeds = np.linalg.norm(after - before, axis=2).max(axis=1) / _SPEED_SPAN
    rows = [
        {"time": time, "status": str(estimate.status), "speed": speed, **errors(estimate, places)}
        for time, estimate, places, speed in zip(stamps, estimates, true, speeds, strict=True)
        if time - stamps[0] >= settings.skip
    ]
    columns = {item.name: np.array([row[item.name] for row in rows]) for item in fields(Tracked)[:-1]}
    return Tracked(**columns, clock_error=np.array(missing))


def errors(estimate: Estimate, markers: FloatArray) -> dict[str, float]:
    """The errors of one frame, as in `Tracked`.

    Parameters
    ----------
    estimate : Estimate
        Of the frame.
    markers : (M, 3) float array
        At its stamp, in order along the rope, metres, camera frame.
    """
    line = estimate.waypoints.positions
    if len(line) < 2:
        return {"linear": math.nan, "to_markers": math.nan, "symmetric": math.nan, "coverage": 0.0}
    knots = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(markers, axis=0), axis=1))])
    count = max(round(knots[-1] / _MARKED_STEP), 1) + 1
    curve = CubicSpline(knots, markers, bc_type="natural")(np.linspace(0, knots[-1], count))
    found = projections(line, curve)
    place = found.segments + found.fractions
    between = (place > 0) & (place < count - 1)
    linear = float(found.distances[between].mean()) if between.any() else math.nan
    back = float(distances_to_curve(curve, line).mean())
    return {
        "linear": linear,
        "to_markers": float(distances_to_curve(markers, line).mean()),
        "symmetric": (linear + back) / 2,
        "coverage": coverage(line, curve, _COVERED),
    }


def choose_cases(methods: Iterable[str], heights: Iterable[float] = HEIGHTS, repeats: int = REPEATS) -> list[Case3]:
    """The cases of some methods and heights, in the order of the tables.

    Raises
    ------
    ConfigError
        If a method is unknown, or none is given.
    """
    chosen = [*dict.fromkeys(methods)]
    if not chosen:
        raise ConfigError("no method is chosen: give one at least, such as slicing")
    for method in chosen:
        check_method(method)
    return [Case3(height, repeat, method) for method in chosen for height in heights for repeat in range(repeats)]


def _whole_steps(times: FloatArray) -> FloatArray:
    """Times at which the simulation stops, seconds."""
    return np.round(times / TIMESTEP) * TIMESTEP


def _axes_at(pipe: PipeSimulation, times: FloatArray) -> dict[Any, FloatArray]:
    """The pipe's axis at each of some ascending times."""
    axes = {}
    for time in times:
        pipe.advance(float(time))
        axes[time] = pipe.axis()
    return axes


def _along(polyline: FloatArray, arc: FloatArray) -> FloatArray:
    """Points at lengths from the polyline's start, (len(arc), 3), metres."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(polyline, axis=0), axis=1))])
    return np.stack([np.interp(arc, lengths, polyline[:, axis]) for axis in range(3)], axis=1)


def _sideways(places: FloatArray) -> FloatArray:
    """Unit vectors across both the rope and the view at markers, (S, M, 3), camera frame."""
    across = np.cross(np.gradient(places, axis=1), places)
    return across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
