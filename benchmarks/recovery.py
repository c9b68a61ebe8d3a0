"""How long trackers take to find the rope again after something happened: hidden, frames dropped, the camera bumped.

    python benchmarks/recovery.py --methods slicing,trackdlo --sequences 5

The rope moves on meanwhile: motion capture of two ropes, and the simulated `swing` of the suite, each with the noise
that it has there. After a second in full view one of these happens:

- hidden: a board comes in, hides all of the rope for 2 s, and leaves;
- dropped: 20 frames are not given to the tracker;
- bumped: from one frame to the next all points, and the truth with them, are 5 cm further right, and stay so.

The time runs from the rope's return (the first frame that sees 95 % of it again; the first after the gap; that of the
bump) to the first of 5 frames in a row whose mean error at equal arc length is below 1.5 diameters, in the direction of
the last estimate before the event. Asked for: 0.5 s.

- right before: runs whose last frame before the event was as good as that; those that were not cannot recover to it;
- in 0.5 s, never: of all runs; mean, worst: seconds, of those that recovered;
- false ok: frames from the event to the recovery that are `ok` though their mean is above 3 diameters, of how many.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import numpy as np
from numpy.typing import NDArray

from occluded import NODES, RADIUS
from persistence import ROPES, chosen_methods, false_ok, lost_errors, rope_config
from ropetrace import RgbdFrame
from ropetrace.evaluation.metrics import at_equal_arc_length, is_reversed, node_errors
from ropetrace.evaluation.runner import process_pool
from ropetrace.evaluation.tables import markdown_table
from ropetrace.sim.camera import Capsules, RayCaster, Scene
from ropetrace.sim.noise import apply_noise, in_steps, kinect_axial, noise_model
from ropetrace.sim.scenario import ROPE_COLOR, SimulatedScene
from ropetrace.sim.scene import Boxes
from ropetrace.sim.visibility import visible_fraction
from ropetrace.suite import ScenarioCase, open_case
from ropetrace.suite.recorded import CAMERA, mocap_curves
from ropetrace.trackers import make_tracker
from ropetrace.types import Estimate, FloatArray, Intrinsics

EVENTS = ("hidden", "dropped", "bumped")
TARGET = 0.5
"""Asked for, seconds."""

START = 1.0
"""When it happens, seconds."""

HIDDEN_SECONDS = 2.0
SWEEP_SECONDS = 0.25
"""That the board takes to come in, and to leave."""

DROPPED_FRAMES = 20
BUMP = (0.05, 0.0, 0.0)
SEEN_AGAIN = 0.95
GOOD_DIAMETERS, GOOD_FRAMES = 1.5, 5

_SWING_SECONDS = 6.0
_SWING_STEP = 0.13
"""The swing is entered this much later each time, seconds."""

_BEFORE, _BESIDE = 0.15, 0.05
"""From the board to the rope's nearest point, and how much it is wider than all places of the rope, metres."""

_BOARD_COLOR = (60, 90, 160)

Noise = Callable[[NDArray[np.float32], np.random.Generator], NDArray[np.uint16]]
"""What a sensor makes of exact depth in metres: millimetres."""


@dataclass(frozen=True, slots=True)
class Task:
    """A method, an event, and the rope that it happens to: "mocap" with rope and sequence, or "swing", as rope 0."""

    method: str
    event: str
    rope: int
    sequence: int

    @property
    def motion(self) -> str:
        """For reports."""
        return "mocap" if self.rope else "swing"


@dataclass(frozen=True, slots=True, eq=False)
class MovingRope:
    """A rope in front of a camera.

    Parameters
    ----------
    times : (F,) float array
        Seconds.
    curves : (F, K, 3) float array
        Its axis, metres, camera frame.
    radius : float
        Metres.
    camera : Intrinsics
    noise : Noise
    """

    times: FloatArray
    curves: FloatArray
    radius: float
    camera: Intrinsics
    noise: Noise


@dataclass(frozen=True, slots=True)
class View:
    """A frame, its true curve, (K, 3), metres, and the share of the rope that it sees."""

    frame: RgbdFrame
    curve: FloatArray
    seen: float


@dataclass(frozen=True, slots=True)
class Recovery:
    """What came of a task.

    Parameters
    ----------
    seconds : float
        Infinite if it never recovered.
    right_before : bool
    false_ok, frames : int
        From the event to the recovery, or to the end.
    """

    seconds: float
    right_before: bool
    false_ok: int
    frames: int


def moving_rope(rope: int, sequence: int) -> MovingRope:
    """The rope of a task."""
    if rope:
        times, curves = mocap_curves(rope, sequence)
        return MovingRope(times, curves, RADIUS, CAMERA, kinect_axial)
    return swing(sequence * _SWING_STEP)


def swing(skipped: float) -> MovingRope:
    """The suite's `swing`, but longer, from a time on, seconds."""
    case = open_case("swing")
    assert isinstance(case, ScenarioCase)
    simulated = SimulatedScene(dataclasses.replace(case.scenario, duration=_SWING_SECONDS))
    camera, noise = simulated.camera.intrinsics, noise_model(case.scenario.camera.noise)
    times = np.arange(simulated.scenario.frame_count) / case.scenario.camera.rate

    def noisy(depth: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.uint16]:
        return in_steps(apply_noise(noise, depth, camera, rng)[0], 0.001)

    def curve_at(time: float) -> FloatArray:
        simulated.scene_at(time)
        return simulated.truth().polyline

    curves = np.array([curve_at(skipped + time) for time in times])
    return MovingRope(times, curves, case.scenario.rope.radius, camera, noisy)


def views(rope: MovingRope, event: str, seed: int) -> Iterator[View]:
    """The frames of a rope to which an event happens at `START`; dropped ones are left out."""
    rng = np.random.default_rng(seed)
    caster = RayCaster(rope.camera)
    first = int(np.searchsorted(rope.times, START))
    for index, (time, place) in enumerate(zip(rope.times, rope.curves, strict=True)):
        if event == "dropped" and first <= index < first + DROPPED_FRAMES:
            continue
        curve = place + BUMP if event == "bumped" and index >= first else place
        boxes = board(rope.curves, time) if event == "hidden" else Boxes.none()
        scene = Scene(Capsules.along(curve, rope.radius, ROPE_COLOR), boxes=boxes)
        image = caster.render(scene)
        seen = visible_fraction(scene, rope.camera, at_equal_arc_length(curve, NODES), rope.radius)
        frame = RgbdFrame(round(time * 1e9), rope.noise(image.depth, rng), 0.001, rope.camera, image.color.copy())
        yield View(frame, curve, seen)


def board(curves: FloatArray, time: float) -> Boxes:
    """It hides every place of the curves from `START` on for `HIDDEN_SECONDS`."""
    nearest = float(curves[..., 2].min()) - _BEFORE
    places = curves[..., 0] / curves[..., 2] * nearest
    left, right = float(places.min()) - _BESIDE, float(places.max()) + _BESIDE
    outside = max(START - time, time - START - HIDDEN_SECONDS, 0.0) / SWEEP_SECONDS
    away = (right - left) * (1 - math.cos(math.pi * min(outside, 1.0))) / 2
    return Boxes.one(((left + right) / 2 - away, 0.0, nearest), (right - left, 4.0, 0.005), _BOARD_COLOR, 2)


def begin_and_return(shown: Sequence[View], event: str) -> tuple[int, int]:
    """The first frame in which the event acts, and the first in which the rope is back."""
    times = np.array([view.frame.stamp_ns for view in shown]) / 1e9
    if event != "hidden":
        first = int(np.searchsorted(times, START - 1e-6))
        return first, first
    begin = int(np.searchsorted(times, START - SWEEP_SECONDS))
    leaves, gone = START + HIDDEN_SECONDS, START + HIDDEN_SECONDS + SWEEP_SECONDS
    seen = np.array([view.seen for view in shown])
    return begin, int(np.argmax((times > leaves) & ((seen >= SEEN_AGAIN) | (times > gone))))


def recover(task: Task) -> Recovery:
    """Run a tracker over an event."""
    rope = moving_rope(task.rope, task.sequence)
    diameter = 2 * rope.radius
    tracker = make_tracker(rope_config(task.method, diameter))
    shown = list(views(rope, task.event, 1000 * task.rope + task.sequence))
    estimates = [tracker.update(view.frame) for view in shown]
    begin, back = begin_and_return(shown, task.event)
    means = mean_errors(estimates, shown, begin)
    good = means < GOOD_DIAMETERS * diameter
    found = first_in_a_row(good[back:], GOOD_FRAMES)
    seconds = math.inf if found is None else (shown[back + found].frame.stamp_ns - shown[back].frame.stamp_ns) / 1e9
    meanwhile = slice(begin, None if found is None else back + found)
    wrong = false_ok([estimate.status for estimate in estimates[meanwhile]], means[meanwhile], diameter)
    return Recovery(seconds, bool(good[begin - 1]), int(wrong.sum()), len(wrong))


def mean_errors(estimates: Sequence[Estimate], shown: Sequence[View], begin: int) -> FloatArray:
    """Of each frame, (F,), metres, in the direction of the last estimate before frame `begin`, or the first after it.

    A frame without an estimate counts with the rope's true length.
    """
    lines = [estimate.waypoints.positions for estimate in estimates]
    nearest = [*range(begin - 1, -1, -1), *range(begin, len(lines))]
    directions = (is_reversed(lines[index], shown[index].curve) for index in nearest)
    backwards = next((direction for direction in directions if direction is not None), False)

    def mean_error(line: FloatArray, curve: FloatArray) -> float:
        if len(line) < 2:
            return float(lost_errors(curve).mean())
        return float(node_errors(line, curve[::-1] if backwards else curve, NODES).mean())

    return np.array([mean_error(line, view.curve) for line, view in zip(lines, shown, strict=True)])


def first_in_a_row(good: NDArray[np.bool_], count: int) -> int | None:
    """Where the first `count` true values in a row begin."""
    if len(good) < count:
        return None
    rows = np.lib.stride_tricks.sliding_window_view(good, count).all(axis=1)
    return int(rows.argmax()) if rows.any() else None


def recover_all(tasks: Sequence[Task], jobs: int) -> dict[Task, Recovery]:
    """Side by side. A run that fails is named on stderr and left out."""
    results = {}
    with process_pool(min(jobs, len(tasks))) as pool:
        futures = {task: pool.submit(recover, task) for task in tasks}
        for task, future in futures.items():
            if (error := future.exception()) is None:
                results[task] = future.result()
            else:
                print(f"{task} failed: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
    return results


def summary(results: dict[Task, Recovery]) -> str:
    """A table with a row a method, event and motion."""
    rows = []
    for key, group in itertools.groupby(results, key=lambda task: (task.method, task.event, task.motion)):
        rows.append([*key, *figures([results[task] for task in group])])
    header = ["method", "event", "motion", "runs", "right before", f"in {TARGET:g} s", "never", "mean s", "worst s"]
    return markdown_table([*header, "false ok"], rows)


def figures(members: Sequence[Recovery]) -> list[str]:
    """The cells of a row of `summary`."""
    seconds = np.array([member.seconds for member in members])
    recovered = seconds[np.isfinite(seconds)]
    return [
        str(len(members)),
        str(sum(member.right_before for member in members)),
        str(np.count_nonzero(seconds <= TARGET)),
        str(len(seconds) - len(recovered)),
        f"{recovered.mean():.2f}" if len(recovered) else "-",
        f"{recovered.max():.2f}" if len(recovered) else "-",
        f"{sum(member.false_ok for member in members)} of {sum(member.frames for member in members)}",
    ]


def per_run(results: dict[Task, Recovery]) -> str:
    """A table with a row a run."""
    rows = [
        [
            task.method,
            task.event,
            task.motion,
            str(task.rope),
            str(task.sequence),
            f"{result.seconds:.2f}",
            "yes" if result.right_before else "no",
            f"{result.false_ok} of {result.frames}",
        ]
        for task, result in results.items()
    ]
    header = ["method", "event", "motion", "rope", "sequence", "seconds", "right before", "false ok"]
    return markdown_table(header, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--methods", help="separated by commas; all by default")
    parser.add_argument("--events", default=",".join(EVENTS), help="separated by commas")
    parser.add_argument("--sequences", type=int, default=5, help="of each rope, and swings")
    parser.add_argument("--jobs", type=int, default=2, help="runs side by side")
    parser.add_argument("--per-run", action="store_true", help="a row of every run, too")
    options = parser.parse_args()
    events = options.events.split(",")
    if unknown := set(events) - set(EVENTS):
        parser.error(f"unknown events {', '.join(sorted(unknown))}: choose of {', '.join(EVENTS)}")
    tasks = [
        Task(method, event, rope, sequence)
        for method in chosen_methods(options.methods)
        for event in events
        for rope in (*ROPES, 0)
        for sequence in range(options.sequences)
    ]
    results = recover_all(tasks, options.jobs)
    print(summary(results), flush=True)
    if options.per_run:
        print(f"\n{per_run(results)}")


if __name__ == "__main__":
    main()
