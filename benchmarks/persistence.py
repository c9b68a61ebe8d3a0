"""How well trackers keep a rope of which a moving curtain hides a part, on motion capture: the frames of `occluded`.

    python benchmarks/persistence.py --methods slicing,trackdlo --sequences 2 --shares 0,0.5

Errors are at equal arc length, in the direction of the rope that a run's first estimate has: later swaps of the ends
count in full, and so does a frame without an estimate, with the rope's true length in every node. Millimetres.

- mean, seen, hidden: over all nodes of all frames, over those that the camera sees, and over the others;
- p95, worst: of the frames' means; tips: mean of both ends; length %: as a magnitude, 100 where there is no estimate;
- swaps: how often the direction that fits better changes; false ok %: share of all frames that are `ok` though their
  mean is above 3 diameters; p50 ms: of an update, only indicative where runs are side by side.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import numpy as np
from numpy.typing import NDArray

import occluded
from ropetrace.config import RopeConfig, format_color
from ropetrace.config_methods import TrackDloConfig
from ropetrace.evaluation.metrics import curve_length, is_reversed, length_error, node_errors
from ropetrace.evaluation.runner import process_pool
from ropetrace.evaluation.sequences import end_swaps
from ropetrace.evaluation.tables import csv_cells, markdown_table
from ropetrace.sim.scenario import ROPE_COLOR
from ropetrace.trackers import METHODS, make_tracker
from ropetrace.types import FloatArray, Status
from trackers import TRACKDLO_50

DIAMETERS = 3.0
"""A frame whose mean error is above this many diameters is not ok."""

ROPES = (1, 2)
FIGURES = (
    "frames",
    "mean",
    "seen",
    "hidden",
    "p95",
    "worst",
    "swaps",
    "lost",
    "degraded",
    "ok",
    "false ok %",
    "tips",
    "length %",
    "p50 ms",
)
CSV_COLUMNS = (
    "method",
    "share",
    "rope",
    "sequence",
    "frame",
    "status",
    "mean_mm",
    "seen_mm",
    "hidden_mm",
    "seen_share",
    "tips_mm",
    "length_percent",
    "reversed",
    "ms",
)


@dataclass(frozen=True, slots=True)
class Task:
    """A method on a sequence behind a curtain; see `occluded.views`."""

    method: str
    share: float
    rope: int
    sequence: int
    wall: bool


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """What came of a task, or of several in a row: F frames of N nodes.

    Parameters
    ----------
    errors : (F, N) float array
        Metres.
    seen : (F, N) bool array
        Which nodes the camera sees.
    statuses : list of F Status
    reversals : list of F bool or None
        Whether the direction against that of the run's start fits better; None without an estimate.
    lengths : (F,) float array
        How much the length is wrong, as a share of the true one, 0 or more.
    seconds : (F,) float array
        Of the update.
    swaps : int
        Changes of direction.
    """

    errors: FloatArray
    seen: NDArray[np.bool_]
    statuses: list[Status]
    reversals: list[bool | None]
    lengths: FloatArray
    seconds: FloatArray
    swaps: int


def rope_config(method: str, diameter: float) -> RopeConfig:
    """Settings of a method, or of `TRACKDLO_50`; the diameter in metres."""
    color = format_color(ROPE_COLOR)
    if method == TRACKDLO_50:
        return RopeConfig(diameter, color, method="trackdlo", trackdlo=TrackDloConfig(visible_within=0.05))
    return RopeConfig(diameter, color, method=method)


def chosen_methods(names: str | None) -> list[str]:
    """Of names that are separated by commas; all without any.

    Raises
    ------
    SystemExit
        If one is none.
    """
    known = [*METHODS, TRACKDLO_50]
    methods = names.split(",") if names else known
    if unknown := [method for method in methods if method not in known]:
        raise SystemExit(f"unknown methods {', '.join(unknown)}: choose of {', '.join(known)}")
    return methods


def track(task: Task) -> Run:
    """Run a tracker over a sequence."""
    tracker = make_tracker(rope_config(task.method, 2 * occluded.RADIUS))
    errors, seen, lengths, seconds = [], [], [], []
    statuses: list[Status] = []
    reversals: list[bool | None] = []
    backwards: bool | None = None
    for frame, curve, visible in occluded.views(task.rope, task.sequence, task.share, task.wall):
        before = time.perf_counter()
        estimate = tracker.update(frame)
        seconds.append(time.perf_counter() - before)
        line = estimate.waypoints.positions
        if backwards is None:
            backwards = is_reversed(line, curve)
        truth = curve[::-1] if backwards else curve
        found = len(line) >= 2
        errors.append(node_errors(line, truth, occluded.NODES) if found else lost_errors(curve))
        seen.append(visible[::-1] if backwards else visible)
        lengths.append(abs(length_error(line, truth)) if found else 1.0)
        statuses.append(estimate.status)
        reversals.append(is_reversed(line, truth))
    return Run(
        np.array(errors),
        np.array(seen),
        statuses,
        reversals,
        np.array(lengths),
        np.array(seconds),
        end_swaps(reversals).count,
    )


def lost_errors(curve: FloatArray) -> FloatArray:
    """Of a frame without an estimate, (N,), metres: the rope's true length in every node."""
    return np.full(occluded.NODES, curve_length(curve))


def false_ok(statuses: Sequence[Status], means: FloatArray, diameter: float) -> NDArray[np.bool_]:
    """Frames, (F,), that are ok though their mean error, metres, is above `DIAMETERS`."""
    claimed = np.array([status is Status.OK for status in statuses], dtype=bool)
    return np.asarray(claimed & (means > DIAMETERS * diameter))


def joined(runs: Sequence[Run]) -> Run:
    """Several runs as one."""
    return Run(
        np.concatenate([run.errors for run in runs]),
        np.concatenate([run.seen for run in runs]),
        [status for run in runs for status in run.statuses],
        [reversal for run in runs for reversal in run.reversals],
        np.concatenate([run.lengths for run in runs]),
        np.concatenate([run.seconds for run in runs]),
        sum(run.swaps for run in runs),
    )


def figures(run: Run) -> list[str]:
    """The cells of `FIGURES`."""
    means = run.errors.mean(axis=1)
    numbers = [
        run.errors.mean() * 1e3,
        mean_of(run.errors[run.seen]) * 1e3,
        mean_of(run.errors[~run.seen]) * 1e3,
        np.percentile(means, 95) * 1e3,
        means.max() * 1e3,
    ]
    statuses = [run.statuses.count(status) for status in (Status.LOST, Status.DEGRADED, Status.OK)]
    wrong = false_ok(run.statuses, means, 2 * occluded.RADIUS).mean() * 100
    return [
        str(len(means)),
        *("-" if np.isnan(number) else f"{number:.1f}" for number in numbers),
        str(run.swaps),
        *map(str, statuses),
        f"{wrong:.1f}",
        f"{tips(run.errors).mean() * 1e3:.1f}",
        f"{run.lengths.mean() * 100:.1f}",
        f"{np.median(run.seconds) * 1e3:.2f}",
    ]


def tips(errors: FloatArray) -> FloatArray:
    """Mean error of both ends, (F,), of errors (F, N)."""
    return np.asarray(errors[:, [0, -1]].mean(axis=1))


def mean_of(values: FloatArray) -> float:
    """NaN of none."""
    return float(values.mean()) if len(values) else float("nan")


def frame_rows(task: Task, run: Run) -> list[list[str]]:
    """The cells of `CSV_COLUMNS`, a row a frame; empty where there is nothing to tell."""
    pairs = list(zip(run.errors, run.seen, strict=True))
    columns = [
        run.errors.mean(axis=1) * 1e3,
        np.array([mean_of(errors[seen]) for errors, seen in pairs]) * 1e3,
        np.array([mean_of(errors[~seen]) for errors, seen in pairs]) * 1e3,
        run.seen.mean(axis=1),
        tips(run.errors) * 1e3,
        run.lengths * 100,
    ]
    name = [task.method, f"{task.share:g}", str(task.rope), str(task.sequence)]
    return [
        [*name, str(index), str(status), *numbers, "" if reversal is None else str(int(reversal)), milliseconds]
        for index, (status, reversal, milliseconds, *numbers) in enumerate(
            zip(run.statuses, run.reversals, csv_cells(run.seconds * 1e3), *map(csv_cells, columns), strict=True)
        )
    ]


def run_all(tasks: Sequence[Task], jobs: int) -> dict[Task, Run]:
    """Side by side. A run that fails is named on stderr and left out."""
    runs = {}
    with process_pool(min(jobs, len(tasks))) as pool:
        futures = {task: pool.submit(track, task) for task in tasks}
        for task, future in futures.items():
            if (error := future.exception()) is None:
                runs[task] = future.result()
            else:
                print(f"{task} failed: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
    return runs


def summary(runs: dict[Task, Run]) -> str:
    """A table with a row a method and share."""
    rows = []
    for (method, share), group in itertools.groupby(runs, key=lambda task: (task.method, task.share)):
        members = [runs[task] for task in group]
        rows.append([method, f"{share:g}", str(len(members)), *figures(joined(members))])
    return markdown_table(["method", "share", "runs", *FIGURES], rows)


def per_run(runs: dict[Task, Run]) -> str:
    """A table with a row a sequence."""
    rows = [
        [task.method, f"{task.share:g}", str(task.rope), str(task.sequence), *figures(run)]
        for task, run in runs.items()
    ]
    return markdown_table(["method", "share", "rope", "sequence", *FIGURES], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--methods", help="separated by commas; all by default")
    parser.add_argument("--sequences", type=int, default=10, help="of each rope")
    parser.add_argument("--shares", default="0,0.25,0.5", help="of the rope's width that the curtain hides")
    parser.add_argument("--wall", action="store_true", help="with a wall half a metre behind the rope")
    parser.add_argument("--jobs", type=int, default=2, help="runs side by side")
    parser.add_argument("--per-run", action="store_true", help="a row of every sequence, too")
    parser.add_argument("--csv", metavar="FILE", help="write a row of every frame")
    options = parser.parse_args()
    tasks = [
        Task(method, share, rope, sequence, options.wall)
        for method in chosen_methods(options.methods)
        for share in map(float, options.shares.split(","))
        for rope in ROPES
        for sequence in range(options.sequences)
    ]
    runs = run_all(tasks, options.jobs)
    print(summary(runs), flush=True)
    if options.per_run:
        print(f"\n{per_run(runs)}")
    if options.csv:
        with open(options.csv, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(CSV_COLUMNS)
            for task, run in runs.items():
                writer.writerows(frame_rows(task, run))


if __name__ == "__main__":
    main()
