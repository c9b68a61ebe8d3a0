"""What case study 3 amounts to: all frames as a table, a summary beside the paper's means, and its Figure 8."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ropetrace.errors import import_extra
from ropetrace.evaluation.case3 import Case3, Case3Settings, Tracked
from ropetrace.evaluation.methods import TUNED
from ropetrace.evaluation.sequences import ErrorStatistics
from ropetrace.evaluation.tables import csv_cells, markdown_table, png, spread, write_parts
from ropetrace.sim.pipe import PipeModel
from ropetrace.types import FloatArray

PENALTY = PipeModel().length
"""What a frame without an estimate counts as: the pipe's length, metres."""

PAPER_MEANS = {"slicing": 30.3, "schulman": 33.0, TUNED: 33.0}
"""Mean linear error over all drops of the real pipe, millimetres."""

COLUMNS = {
    "time_s": "time",
    "status": "status",
    "linear_m": "linear",
    "to_markers_m": "to_markers",
    "symmetric_m": "symmetric",
    "coverage_10mm": "coverage",
    "speed_m_s": "speed",
}
"""Of the CSV, after method, height_m and repeat; each with its field of `Tracked`."""

Results = Mapping[Case3, Tracked]


def write_report(folder: Path, results: Results, settings: Case3Settings) -> list[Path]:
    """Write case3.csv, case3.md and case3.png; the same results give the same bytes.

    Raises
    ------
    OutputError
        If a file cannot be written.
    MissingExtraError
        If Matplotlib is not installed.
    """
    return write_parts(folder, "case3", csv_text(results), report_text(results, settings), figure(results))


def csv_text(results: Results) -> str:
    """A row for each frame; what is missing is empty. Reading a number back gives the same bits."""
    lines = [",".join(["method", "height_m", "repeat", *COLUMNS])]
    for case, tracked in results.items():
        columns = [csv_cells(getattr(tracked, name)) for name in COLUMNS.values()]
        start = f"{case.method},{case.height!r},{case.repeat + 1}"
        lines += [",".join([start, *row]) for row in zip(*columns, strict=True)]
    return "\n".join(lines) + "\n"


def report_text(results: Results, settings: Case3Settings) -> str:
    """The whole report, in Markdown."""
    parts = [
        "# Case study 3: a pipe that is dropped",
        f"{settings.duration:g} s a drop, the first {settings.skip:g} s skipped, {settings.rate:g} frames a second of "
        f"{settings.width}x{settings.height}, sensor noise: {settings.noise}; {settings.markers} markers "
        f"{settings.marker_spacing * 1e3:g} mm apart from the swinging end on, {settings.marker_rate:g} Hz, deviation "
        f"{settings.marker_noise * 1e3:g} mm, {settings.marker_offset * 1e3:g} mm off the axis; seed {settings.seed}. "
        "Simulated: an elastic pipe and a modelled sensor, no latency, and a camera whose pose is known exactly.",
        "## Errors",
        f"Mean ± standard deviation over the frames of all drops from a height. A missing frame counts as "
        f"{PENALTY * 1e3:g} mm in every figure. Linear is the paper's error: from the waypoints that project onto the "
        "curve through the markers to it; symmetric looks both ways, and the last column is the share of that curve "
        "found within 10 mm.",
        summary_table(results),
        "Mean linear error over the drops, mm; the paper's were measured on a real pipe:",
        means_table(results),
        *_clocks(results),
    ]
    return "\n\n".join(parts) + "\n"


def summary_table(results: Results) -> str:
    """A row for each method and height, in Markdown that is aligned for a terminal."""
    header = (
        "method", "drop, mm", "frames", "missing", "linear, mm", "p95", "worst", "symmetric, mm", "from markers, mm",
        "within 10 mm", "fastest, m/s",
    )  # fmt: skip
    rows = []
    for method, height in dict.fromkeys((case.method, case.height) for case in results):
        chosen = [tracked for case, tracked in results.items() if (case.method, case.height) == (method, height)]
        linear, symmetric, back = (
            ErrorStatistics.of(_joined(chosen, name), PENALTY) for name in ("linear", "symmetric", "to_markers")
        )
        rows.append(
            (
                method,
                f"{height * 1e3:g}",
                str(linear.count),
                str(linear.missing),
                spread(linear.mean * 1e3, linear.std * 1e3),
                f"{linear.p95 * 1e3:.2f}",
                f"{linear.worst * 1e3:.2f}",
                f"{symmetric.mean * 1e3:.3f}",
                f"{back.mean * 1e3:.3f}",
                f"{_joined(chosen, 'coverage').mean():.2%}",
                f"{_joined(chosen, 'speed').max():.2f}",
            )
        )
    return markdown_table(header, rows)


def means_table(results: Results) -> str:
    """A row for each method: the mean over its drops, all weighing alike, beside the paper's."""
    rows = []
    for method in dict.fromkeys(case.method for case in results):
        chosen = [tracked for case, tracked in results.items() if case.method == method]
        linear, symmetric = (
            np.mean([ErrorStatistics.of(getattr(tracked, name), PENALTY).mean for tracked in chosen]) * 1e3
            for name in ("linear", "symmetric")
        )
        paper = PAPER_MEANS.get(method)
        shown = "" if paper is None else f"{paper:.1f}"
        rows.append((method, str(len(chosen)), f"{linear:.3f}", f"{symmetric:.3f}", shown))
    return markdown_table(("method", "drops", "linear", "symmetric", "paper (30 drops)"), rows)


def figure(results: Results) -> bytes:
    """In the form of the paper's Figure 8, as a PNG: mean and standard deviation of the error by drop height."""
    import_extra("matplotlib", "sim")
    from matplotlib.figure import Figure

    methods = list(dict.fromkeys(case.method for case in results))
    sheet = Figure(figsize=(7.2, 4.2), dpi=150, layout="constrained")
    axis = sheet.subplots()
    heights = sorted({case.height for case in results})
    width = 0.8 / len(methods)
    for index, method in enumerate(methods):
        places, means, deviations = [], [], []
        for place, height in enumerate(heights):
            chosen = [tracked for case, tracked in results.items() if (case.method, case.height) == (method, height)]
            if chosen:
                statistics = ErrorStatistics.of(_joined(chosen, "linear"), PENALTY)
                places.append(place + (index - (len(methods) - 1) / 2) * width)
                means.append(statistics.mean * 1e3)
                deviations.append(statistics.std * 1e3)
        color = _COLORS[index % len(_COLORS)]
        style = {"elinewidth": 1.0, "capthick": 1.0}
        axis.bar(places, means, 0.9 * width, yerr=deviations, capsize=2, color=color, label=method, error_kw=style)
    for name, mean, line in (
        ("slicing", PAPER_MEANS["slicing"], "--"),
        ("Schulman et al.", PAPER_MEANS["schulman"], ":"),
    ):
        axis.axhline(mean, color="#555555", linewidth=1.0, linestyle=line, label=f"the paper's mean, {name}")
    axis.set_xticks(range(len(heights)), [f"{height * 1e3:g}" for height in heights])
    axis.set_xlabel("drop height, mm")
    axis.set_ylabel("linear error, mm")
    axis.set_ylim(bottom=0)
    axis.grid(axis="y", color="#dddddd", linewidth=0.6)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)
    # Above the axes, where no bar reaches.
    axis.legend(frameon=False, fontsize=8, ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    return png(sheet)


_COLORS = ("#1f5fa8", "#c8281e", "#e0902f", "#3c8d40", "#7a4fa3", "#777777")


def _joined(chosen: list[Tracked], name: str) -> FloatArray:
    return np.concatenate([getattr(tracked, name) for tracked in chosen])


def _clocks(results: Results) -> list[str]:
    """How well the markers' clock was found."""
    found: list[Any] = [tracked.clock_error for tracked in results.values()]
    off = np.array(found, float)
    if not np.isfinite(off).any():
        return []
    worst = np.nanmax(np.abs(off)) * 1e3
    return [
        f"The offset of the markers' clock was found from the mean of the points and that of the markers in "
        f"{np.isfinite(off).sum()} of {len(off)} recordings, to {worst:.2f} ms or better; in the others too little "
        "moves for it to matter."
    ]
