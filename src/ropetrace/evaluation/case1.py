"""Case study 1 (section 6.2): a tracker against the truth of a rope that sways in a wind.

Every 0.1 s of simulated time the newest centreline *available at that moment* is compared with the rope as it is then.
Availability is simulated, not taken from the wall clock: a frame's centreline is there when its exposure has ended, the
frame has been transported, and the tracker has worked on it for a time that was measured once. So a run repeats bit for
bit, and the machine's load does not count.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ropetrace.centerline import make_waypoints
from ropetrace.config import RopeConfig, format_color
from ropetrace.errors import ConfigError
from ropetrace.evaluation.methods import case_tracker, check_method
from ropetrace.evaluation.metrics import coverage, symmetric_mean
from ropetrace.evaluation.paper_errors import angular_errors, linear_errors
from ropetrace.motion import MotionEstimator, make_motion
from ropetrace.sim.rope import TIMESTEP, Wind
from ropetrace.sim.scenario import ROPE_COLOR, CameraSettings, Scenario, SimulatedScene, Truth
from ropetrace.tracking import ahead_of_time, with_motion
from ropetrace.types import Estimate, FloatArray

FREQUENCIES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6)
"""Of the wind, Hz."""

RESONANCE = 0.8
"""Hz."""

_COVERED = 0.010
"""Within this distance the true curve is covered, metres."""


@dataclass(frozen=True, slots=True)
class Condition:
    """One of the paper's two camera conditions.

    Parameters
    ----------
    name : str
        In tables and file names.
    width, height : int
        Pixels.
    rate : float
        Frames per second of simulated time.
    speed : float
        Simulated seconds in a real one: slower, and the tracker has more time for each frame.
    """

    name: str
    width: int
    height: int
    rate: float
    speed: float


CONDITIONS = (Condition("30fps", 480, 360, 30.0, 1.0), Condition("60fps", 1280, 720, 60.0, 0.1))
"""Real time, and a tenth of it."""


@dataclass(frozen=True, slots=True)
class Case:
    """A camera condition, a frequency of the wind, Hz, and which repetition where there are several, from 0."""

    condition: Condition
    frequency: float
    repeat: int | None = None

    @property
    def name(self) -> str:
        """Such as 30fps_0.8, or 30fps_0.8_1 for the first of several."""
        return f"{self.condition.name}_{self.frequency!r}" + ("" if self.repeat is None else f"_{self.repeat + 1}")

    @property
    def work(self) -> float:
        """More takes longer."""
        return self.condition.rate * self.condition.width * self.condition.height


@dataclass(frozen=True, slots=True)
class Case1Settings:
    """What is run; the defaults are the paper's."""

    duration: float = 300.0
    """Seconds of simulated time in which readings are taken."""
    warm_up: float = 10.0
    """Seconds before that, in which the swing grows."""
    interval: float = 0.1
    """Seconds between readings."""
    noise: str = "none"
    """Of the depth camera: Gazebo's had none."""
    method: str = "slicing"
    """Of `ropetrace.evaluation.methods.CASE_METHODS`."""
    predict: Literal["none", "now"] = "none"
    """`now`: whoever reads asks for the centreline of that moment, predicted from what is available then; `none`: takes
    the newest as it is, as the paper does."""
    phase: float | None = None
    """When frames are taken, in frame intervals after a reading; 0 is the worst, since a frame of the very moment of a
    reading comes too late for it. None is a camera that nobody synchronises: its clock is slow by one frame interval in
    the whole run (0.01 % in 300 s), so that every phase comes equally often."""
    latency: float | None = None
    """From the arrival of a frame to its centreline, seconds; None is measured."""
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.duration <= 1e5 or not 0 <= self.warm_up <= 1e4:
            raise ConfigError(f"duration = {self.duration}, warm_up = {self.warm_up}: expected seconds")
        steps = self.interval / TIMESTEP
        if steps < 1 or abs(steps - round(steps)) > 1e-6:
            raise ConfigError(f"interval = {self.interval} s: expected a multiple of the step, {TIMESTEP:.6f} s")
        if self.phase is not None and not 0 <= self.phase < 1:
            raise ConfigError(f"phase = {self.phase}: expected 0 to 1 frame intervals")
        if self.latency is not None and not 0 <= self.latency <= 10:
            raise ConfigError(f"latency = {self.latency} s: expected 0 to 10 s")
        check_method(self.method)

    @property
    def readings(self) -> int:
        """Readings in a case."""
        return round(self.duration / self.interval)


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """The readings of one case, in order. Arrays of (R,); NaN where there was no estimate.

    Parameters
    ----------
    time : float
        Simulated seconds.
    age : float
        From the frame's stamp to the reading, seconds.
    status : str
        Of the estimate.
    linear, angular : float
        The paper's errors: means over the waypoints, metres and radians.
    symmetric : float
        Metres.
    coverage : float
        Share of the true curve within 10 mm.
    linear_at_stamp, angular_at_stamp : float
        The same errors against the rope as it was at the frame's stamp: without the age.
    moved : float
        How far the true curve moved since then: mean distance of the one to the other, metres.
    speed : float
        Mean speed of the links, m/s.
    linear_floor, angular_floor : float
        The errors of a perfect curve: a spline through the true joints, against the ten straight links.
    """

    time: FloatArray
    age: FloatArray
    status: NDArray[np.str_]
    linear: FloatArray
    angular: FloatArray
    symmetric: FloatArray
    coverage: FloatArray
    linear_at_stamp: FloatArray
    angular_at_stamp: FloatArray
    moved: FloatArray
    speed: FloatArray
    linear_floor: FloatArray
    angular_floor: FloatArray

    @classmethod
    def of(cls, rows: list[dict[str, Any]]) -> Readings:
        """From a list of rows."""
        return cls(**{item.name: np.array([row[item.name] for row in rows]) for item in fields(cls)})


def rope_config(settings: Case1Settings) -> RopeConfig:
    """What the tracker is told: the diameter and the colour."""
    return RopeConfig(0.015, format_color(ROPE_COLOR), settings.method)


def scenario(condition: Condition, frequency: float, settings: Case1Settings) -> Scenario:
    """The paper's rope in a wind of the given frequency, seen under a condition."""
    exact = settings.noise == "none"
    return Scenario(
        duration=settings.warm_up + settings.duration,
        seed=settings.seed,
        wind=Wind(frequency),
        camera=CameraSettings(
            condition.width, condition.height, rate=condition.rate, noise=settings.noise, exact_depth=exact
        ),
    )


def measure_compute_time(condition: Condition, settings: Case1Settings, frames: int = 200) -> float:
    """The tracker's time for a frame of the resonant rope, p99 on this machine, in simulated seconds.

    Simulated time goes slower than real time by the condition's speed, so that a tenth of real time divides it by ten.
    """
    if settings.latency is not None:
        return settings.latency
    simulated = SimulatedScene(scenario(condition, RESONANCE, settings))
    config = rope_config(settings)
    tracker = case_tracker(settings.method, config)
    motion = make_motion(config.motion.method, config.diameter)
    assert motion is not None
    seconds = []
    for index in range(frames + 5):
        frame = simulated.camera.expose(simulated.scene_at, simulated.camera.stamp(index), index)
        start = time.perf_counter()
        estimate = tracker.update(frame)
        if settings.predict == "now":
            with_motion(estimate, motion)
        seconds.append(time.perf_counter() - start)
    return float(np.percentile(seconds[5:], 99)) * condition.speed


def schedule(arrivals: FloatArray, compute_time: float) -> list[tuple[int, float]]:
    """Which frames a tracker works on, and when each is done: it takes the newest that has arrived when it is free.

    Parameters
    ----------
    arrivals : (F,) float array
        When each frame arrives, ascending, seconds.
    compute_time : float
        For a frame, seconds.

    Returns
    -------
    list of (frame index, time at which its estimate is available)
    """
    done = []
    free = -np.inf
    index = 0
    while index < len(arrivals):
        # What arrived while the tracker was busy is passed over, but for the newest.
        newest = max(int(np.searchsorted(arrivals, free, side="right")) - 1, index)
        free = max(arrivals[newest], free) + compute_time
        done.append((newest, float(free)))
        index = newest + 1
    return done


def frame_stamps(rate: float, count: int, settings: Case1Settings) -> FloatArray:
    """When the frames are taken, (count,), seconds: at whole steps of the simulation."""
    index = np.arange(count)
    phase = index / (rate * settings.duration) if settings.phase is None else np.full(count, settings.phase)
    return np.round((index + phase) / rate / TIMESTEP) * TIMESTEP


def run_case(condition: Condition, frequency: float, settings: Case1Settings, compute_time: float) -> Readings:
    """One case: all its readings, none removed.

    Parameters
    ----------
    condition : Condition
        The camera.
    frequency : float
        Of the wind, Hz.
    settings : Case1Settings
        The rest.
    compute_time : float
        From a frame's arrival to its centreline, simulated seconds: see `measure_compute_time`.
    """
    simulated = SimulatedScene(scenario(condition, frequency, settings))
    return Readings.of(list(_readings(simulated, settings, compute_time)))


def _readings(simulated: SimulatedScene, settings: Case1Settings, compute_time: float) -> Iterator[dict[str, Any]]:
    config = rope_config(settings)
    tracker = case_tracker(settings.method, config)
    motion = make_motion(config.motion.method, config.diameter) if settings.predict == "now" else None
    camera = simulated.camera
    moments = settings.warm_up + settings.interval * np.arange(1, settings.readings + 1)
    stamps = frame_stamps(camera.rate, simulated.scenario.frame_count, settings)
    done = schedule(np.array([camera.arrival(stamp) for stamp in stamps]), compute_time)
    waiting: list[tuple[float, float, Estimate, Truth]] = []
    newest: tuple[float, float, Estimate, Truth] | None = None
    at = 0
    for moment in moments:
        # Frames of this very moment come first: the rope does not go back in time.
        while at < len(done) and stamps[done[at][0]] <= moment + 1e-9:
            index, available = done[at]
            frame = camera.expose(simulated.scene_at, stamps[index], index)
            waiting.append((available, stamps[index], tracker.update(frame), simulated.truth()))
            at += 1
        simulated.rope.advance(moment)
        while waiting and waiting[0][0] <= moment + 1e-9:
            newest = waiting.pop(0)
            if motion is not None:
                newest = (*newest[:2], with_motion(newest[2], motion), newest[3])
        yield _reading(moment, newest, simulated.truth(), motion)


def _reading(
    moment: float,
    newest: tuple[float, float, Estimate, Truth] | None,
    truth: Truth,
    motion: MotionEstimator | None = None,
) -> dict[str, Any]:
    missing = float("nan")
    ideal = make_waypoints(truth.polyline, 0.0075)
    row: dict[str, Any] = {
        "time": moment,
        "age": missing,
        "status": "lost",
        "linear": missing,
        "angular": missing,
        "symmetric": missing,
        "coverage": 0.0,
        "linear_at_stamp": missing,
        "angular_at_stamp": missing,
        "moved": missing,
        "speed": float(np.linalg.norm(truth.state.velocities, axis=1).mean()),
        "linear_floor": float(linear_errors(ideal.positions, truth.polyline).mean()),
        "angular_floor": float(
            angular_errors(ideal.positions, ideal.quaternions, truth.polyline, truth.link_quaternions).mean()
        ),
    }
    if newest is None:
        return row
    _, stamp, estimate, then = newest
    row |= {"age": moment - stamp, "status": str(estimate.status)}
    line = estimate.waypoints
    if len(line) < 2:
        return row
    row |= {
        "linear_at_stamp": float(linear_errors(line.positions, then.polyline).mean()),
        "angular_at_stamp": float(
            angular_errors(line.positions, line.quaternions, then.polyline, then.link_quaternions).mean()
        ),
    }
    if motion is not None:
        line = ahead_of_time(estimate, motion, moment - stamp).waypoints
    return row | {
        "linear": float(linear_errors(line.positions, truth.polyline).mean()),
        "angular": float(
            angular_errors(line.positions, line.quaternions, truth.polyline, truth.link_quaternions).mean()
        ),
        "symmetric": symmetric_mean(line.positions, truth.polyline),
        "coverage": coverage(line.positions, truth.polyline, _COVERED),
        "moved": symmetric_mean(then.polyline, truth.polyline),
    }
