"""What case study 1 amounts to: all readings as a table, a summary beside the paper's figures, and its Figure 4."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ropetrace.errors import import_extra
from ropetrace.evaluation.case1 import CONDITIONS, RESONANCE, Case, Case1Settings, Readings
from ropetrace.evaluation.sequences import ErrorStatistics
from ropetrace.evaluation.tables import condition_title, csv_cells, markdown_table, png, spread, write_parts
from ropetrace.sim.rope import RopeModel
from ropetrace.types import FloatArray

LINEAR_PENALTY = RopeModel().length
"""What a reading without an estimate counts as: the rope's length, metres."""

ANGULAR_PENALTY = math.pi
"""The same for the angle, radians."""

COLUMNS = {
    "time_s": "time",
    "age_s": "age",
    "status": "status",
    "linear_m": "linear",
    "angular_rad": "angular",
    "symmetric_m": "symmetric",
    "coverage_10mm": "coverage",
    "linear_at_stamp_m": "linear_at_stamp",
    "angular_at_stamp_rad": "angular_at_stamp",
    "moved_m": "moved",
    "speed_m_s": "speed",
    "linear_floor_m": "linear_floor",
    "angular_floor_rad": "angular_floor",
}
"""Of the CSV, after condition and frequency_hz; each with its field of `Readings`."""


@dataclass(frozen=True, slots=True)
class PaperFigure:
    """A mean and a standard deviation that the text of the paper gives: millimetres, and hundredths of a radian."""

    linear: tuple[float, float]
    angular: tuple[float, float]


PAPER = {
    ("30fps", 0.0): PaperFigure((2.69, 0.0892), (1.55, 0.447)),
    ("30fps", RESONANCE): PaperFigure((12.1, 8.25), (9.91, 4.91)),
    ("60fps", 0.0): PaperFigure((1.45, 0.0127), (1.30, 0.116)),
    ("60fps", RESONANCE): PaperFigure((9.38, 5.57), (8.22, 3.00)),
}
"""By condition and frequency; the rest of the paper's curves is only drawn, in a figure that is not at hand."""

PAPER_MEANS = {"30fps": 9.70, "60fps": 7.02}
"""Mean linear error over the frequencies, millimetres."""

Results = Mapping[Case, Readings]


def write_report(
    folder: Path, results: Results, settings: Case1Settings, compute_times: Mapping[str, float]
) -> list[Path]:
    """Write case1.csv, case1.md and case1.png; the same results give the same bytes.

    Raises
    ------
    OutputError
        If a file cannot be written.
    MissingExtraError
        If Matplotlib is not installed.
    """
    return write_parts(
        folder,
        "case1",
        csv_text(results),
        report_text(results, settings, compute_times),
        figure(results, settings.method),
    )


def csv_text(results: Results) -> str:
    """A row for each reading; what is missing is empty. Reading a number back gives the same bits."""
    lines = [",".join(["condition", "frequency_hz", *COLUMNS])]
    for case, readings in results.items():
        columns = [csv_cells(getattr(readings, name)) for name in COLUMNS.values()]
        start = f"{case.condition.name},{case.frequency!r}"
        lines += [",".join([start, *row]) for row in zip(*columns, strict=True)]
    return "\n".join(lines) + "\n"


def summary_table(results: Results) -> str:
    """A row for each case, the paper's figures beside it, in Markdown that is aligned for a terminal."""
    header = (
        "camera", "wind, Hz", "readings", "missing", "linear, mm", "paper", "p95", "worst",
        "angular, 0.01 rad", "paper", "symmetric, mm", "within 10 mm",
    )  # fmt: skip
    rows = []
    for case, readings in results.items():
        linear, angular = _statistics(readings)
        paper = PAPER.get((case.condition.name, case.frequency))
        rows.append(
            (
                case.condition.name,
                f"{case.frequency:g}",
                str(linear.count),
                str(linear.missing),
                spread(linear.mean * 1e3, linear.std * 1e3),
                "" if paper is None else "{:g} ± {:g}".format(*paper.linear),
                f"{linear.p95 * 1e3:.2f}",
                f"{linear.worst * 1e3:.2f}",
                spread(angular.mean * 100, angular.std * 100),
                "" if paper is None else "{:g} ± {:g}".format(*paper.angular),
                f"{ErrorStatistics.of(readings.symmetric, LINEAR_PENALTY).mean * 1e3:.3f}",
                f"{readings.coverage.mean():.2%}",
            )
        )
    return markdown_table(header, rows)


def _statistics(readings: Readings) -> tuple[ErrorStatistics, ErrorStatistics]:
    """Of the linear and of the angular error, every reading counted."""
    return (
        ErrorStatistics.of(readings.linear, LINEAR_PENALTY),
        ErrorStatistics.of(readings.angular, ANGULAR_PENALTY),
    )


def _phase(settings: Case1Settings) -> str:
    if settings.phase is None:
        return "at every phase to the readings equally often"
    return f"{settings.phase:g} frame intervals after a reading"


def _read(settings: Case1Settings) -> str:
    newest = "the newest centreline available at that moment"
    return newest if settings.predict == "none" else f"{newest}, predicted to that moment from its motion,"


def report_text(results: Results, settings: Case1Settings, compute_times: Mapping[str, float]) -> str:
    """The whole report, in Markdown."""
    parts = [
        "# Case study 1: a rope that sways in a wind",
        f"{settings.duration:g} s of simulated time a case after {settings.warm_up:g} s of warming up, a reading every "
        f"{settings.interval:g} s, none removed; sensor noise: {settings.noise}; frames come {_phase(settings)}; "
        f"tracker: {settings.method}; seed {settings.seed}.",
        f"Each reading compares {_read(settings)} with the rope as it is then. From a "
        "frame's arrival to its centreline, in simulated time ("
        + ("set by hand" if settings.latency is not None else "p99, measured once before the run")
        + "): "
        + ", ".join(f"{name} {seconds * 1e3:.4g} ms" for name, seconds in sorted(compute_times.items()))
        + ".",
        "## Errors",
        f"Mean ± standard deviation over the readings. A missing reading counts as {LINEAR_PENALTY:g} m and pi rad in "
        "every figure. Linear and angular are the paper's errors, which look from the waypoints to the truth alone; "
        "symmetric looks both ways, and the last column is the share of the true curve found within 10 mm.",
        *_another(settings.method),
        summary_table(results),
        *_found_alone(results),
        *_mean_errors(results),
        *_resonance(results),
    ]
    return "\n\n".join(parts) + "\n"


def _another(method: str) -> list[str]:
    """Whose the paper's figures are, beside those of another method."""
    if method == "slicing":
        return []
    return [
        "The paper's figures are those of its own method, slicing. Of Schulman et al. its text gives none: noticeably "
        "worse in both conditions, and at a tenth of real time as bad as slicing in real time, or worse."
    ]


def _found_alone(results: Results) -> list[str]:
    """The statistics of what was found, where something was not."""
    rows = []
    for case, readings in results.items():
        linear, angular = (errors[np.isfinite(errors)] for errors in (readings.linear, readings.angular))
        if len(linear) == len(readings.linear):
            continue
        rows.append(
            (
                case.condition.name,
                f"{case.frequency:g}",
                str(len(linear)),
                spread(linear.mean() * 1e3, linear.std() * 1e3) if len(linear) else "",
                spread(angular.mean() * 100, angular.std() * 100) if len(angular) else "",
            )
        )
    if not rows:
        return []
    header = ("camera", "wind, Hz", "found", "linear, mm", "angular, 0.01 rad")
    return ["Where readings are missing, those that were found, alone:", markdown_table(header, rows)]


def _mean_errors(results: Results) -> list[str]:
    """The mean over the frequencies, if all are there."""
    rows = []
    for condition in CONDITIONS:
        means = [_statistics(readings)[0].mean for case, readings in results.items() if case.condition == condition]
        if means:
            rows.append(
                (condition.name, str(len(means)), f"{np.mean(means) * 1e3:.3f}", f"{PAPER_MEANS[condition.name]:.2f}")
            )
    return [
        "Mean linear error over the cases, mm:",
        markdown_table(("camera", "cases", "ours", "paper (9 cases)"), rows),
    ]


def _resonance(results: Results) -> list[str]:
    """Where the error at the resonance comes from."""
    linear_rows, angular_rows = [], []
    for case, readings in results.items():
        found = np.isfinite(readings.linear)
        if case.frequency != RESONANCE or not found.any():
            continue
        name = case.condition.name

        def mean(values: FloatArray, found: Any = found) -> float:
            return float(values[found].mean())

        linear, moved, own = mean(readings.linear), mean(readings.moved), mean(readings.linear_at_stamp)
        linear_rows.append(
            (
                name,
                f"{mean(readings.age) * 1e3:.2f}",
                f"{mean(readings.speed):.3f}",
                f"{mean(readings.age * readings.speed) * 1e3:.3f}",
                f"{moved * 1e3:.3f}",
                f"{own * 1e3:.3f}",
                f"{mean(readings.linear_floor) * 1e3:.3f}",
                f"{(linear - moved - own) * 1e3:+.3f}",
                f"{linear * 1e3:.3f}",
            )
        )
        angular, at_stamp, floor = (
            mean(values) * 100 for values in (readings.angular, readings.angular_at_stamp, readings.angular_floor)
        )
        angular_rows.append(
            (name, f"{floor:.3f}", f"{at_stamp - floor:+.3f}", f"{angular - at_stamp:+.3f}", f"{angular:.3f}")
        )
    if not linear_rows:
        return []
    return [
        f"## Where the error at the resonance ({RESONANCE:g} Hz) comes from",
        "Means over the readings found. While a centreline ages, the rope moves on: by at most its age times the speed "
        "of the links, and by `moved` as a curve (motion along itself does not count). The tracker's own error is that "
        "of the same centreline against the rope as it was at the frame's stamp: sensor, slicing and spline. The "
        "spline's part is what a spline through the true joints shows against the straight links; the sensor's is the "
        "difference to a run without noise. The rest is what the total has more or less than moved and own: errors "
        "that point different ways do not add up.",
        markdown_table(
            (
                "camera",
                "age, ms",
                "speed, m/s",
                "age x speed, mm",
                "moved, mm",
                "own, mm",
                "of it spline",
                "rest, mm",
                "linear, mm",
            ),
            linear_rows,
        ),
        "The angle, in 0.01 rad. The floor is owed to the truth, whose ten links are straight: it is the error of a "
        "perfect curve, a spline through the true joints.",
        markdown_table(("camera", "floor", "own beyond it", "age", "angular"), angular_rows),
    ]


def figure(results: Results, method: str) -> bytes:
    """The paper's Figure 4 of a method, as a PNG: mean and standard deviation by frequency, a column a condition."""
    import_extra("matplotlib", "sim")
    from matplotlib.figure import Figure
    from matplotlib.ticker import MultipleLocator

    conditions = [condition for condition in CONDITIONS if any(case.condition == condition for case in results)]
    sheet = Figure(figsize=(1.0 + 4.2 * len(conditions), 6.2), dpi=150, layout="constrained")
    axes = sheet.subplots(2, len(conditions), squeeze=False, sharex=True, sharey="row")
    for column, condition in enumerate(conditions):
        cases = [case for case in results if case.condition == condition]
        frequencies = [case.frequency for case in cases]
        statistics = [_statistics(results[case]) for case in cases]
        for row, (kind, label, scale) in enumerate((("linear", "mm", 1e3), ("angular", "0.01 rad", 1e2))):
            axis = axes[row, column]
            ours = np.array([(s[row].mean, s[row].std) for s in statistics]) * scale
            style = {"capsize": 3, "markersize": 5, "linewidth": 1.4, "elinewidth": 1.0}
            axis.errorbar(frequencies, *ours.T, fmt="o-", color="#1f5fa8", label=f"ropetrace, {method}", **style)
            paper = [(f, *getattr(figure, kind)) for (name, f), figure in PAPER.items() if name == condition.name]
            # A little to the side, so that both bars are seen.
            axis.errorbar(
                *(np.array(paper) + [0.02, 0, 0]).T, fmt="s", color="#c8281e", label="the paper, slicing", **style
            )
            top = max(axis.get_ylim()[1], 1e-9)
            axis.set_ylim(-0.02 * top, top)
            axis.grid(color="#dddddd", linewidth=0.6)
            axis.set_axisbelow(True)
            axis.spines[["top", "right"]].set_visible(False)
            if column == 0:
                axis.set_ylabel(f"{kind} error, {label}")
        axes[0, column].set_title(f"({'ab'[column]}) {condition_title(condition)}", fontsize=10)
        axes[1, column].set_xlabel("frequency of the wind, Hz")
        axes[1, column].xaxis.set_major_locator(MultipleLocator(0.2))
    axes[0, 0].legend(frameon=False, loc="upper left", title="mean ± standard deviation", alignment="left")
    return png(sheet)
