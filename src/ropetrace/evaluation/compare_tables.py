"""What a comparison amounts to, as tables of texts: the same for Markdown and for the page."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ropetrace.evaluation.compare import Figures, Run, disagreements
from ropetrace.evaluation.tables import markdown_table
from ropetrace.suite import Case

CSV_COLUMNS = {
    "stamp_ns": "stamp_ns",
    "status": "status",
    "seconds": "seconds",
    "symmetric_m": "symmetric",
    "node_m": "node",
    "covered": "covered",
    "tip_start_m": "tip_start",
    "tip_end_m": "tip_end",
    "frechet_m": "frechet",
    "length_m": "length",
    "true_length_m": "true_length",
    "visible": "visible",
    "flipped": "flipped",
}
"""Of the CSV, after case, method and frame; each with its field of `Run`."""

NONE = "–"
"""Where there is no figure."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table of texts.

    Parameters
    ----------
    header : tuple of str
        Of the columns; the first column names the rows.
    rows : list of lists of str
    numbers : list of lists of float, optional
        Behind each cell but the first, where less is better; NaN where there is none.
    """

    header: tuple[str, ...]
    rows: list[list[str]]
    numbers: list[list[float]] | None = None

    def markdown(self) -> str:
        """As Markdown."""
        return markdown_table(self.header, self.rows)


@dataclass(frozen=True)
class Comparison:
    """Methods on cases.

    Parameters
    ----------
    title : str
        What was compared on.
    cases : mapping of name to Case
        In the order of the report.
    methods : tuple of str
        In the order of the report.
    runs : mapping of (case, method) to Run
        One of each.
    timed : bool
        Whether times were measured on one thread with nothing else of ours running.
    """

    title: str
    cases: Mapping[str, Case]
    methods: tuple[str, ...]
    runs: Mapping[tuple[str, str], Run] = field(repr=False)
    timed: bool = False

    @cached_property
    def figures(self) -> dict[tuple[str, str], Figures]:
        """Of every run."""
        return {key: Figures.of(run, self.cases[key[0]].diameter / 2) for key, run in self.runs.items()}

    @cached_property
    def with_truth(self) -> list[str]:
        """The cases whose truth is known."""
        return [name for name in self.cases if self.runs[name, self.methods[0]].has_truth]

    @property
    def time_note(self) -> str:
        """How the times were measured."""
        if self.timed:
            return "Times: one thread, one process at a time, the first two frames of a run left out."
        return "Times are approximate (≈): runs were side by side; --timing measures them one at a time."

    def of_run(self, case: str) -> list[Run]:
        """The runs of a case, in the order of the methods."""
        return [self.runs[case, method] for method in self.methods]

    def failures(self) -> list[str]:
        """A sentence for each run whose method failed."""
        return [
            f"{method} failed on {case}, frame {np.flatnonzero(run.status == '')[0]}: {run.failure}"
            for (case, method), run in self.runs.items()
            if str(run.failure)
        ]


def _number(value: float, digits: int = 2, scale: float = 1.0) -> str:
    return NONE if not math.isfinite(value) else f"{value * scale:.{digits}f}"


def _millimetres(value: float) -> str:
    """Three significant figures or whole millimetres."""
    value *= 1e3
    return NONE if not math.isfinite(value) else f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def overall_table(comparison: Comparison) -> Table:
    """A row a method, over all cases with truth: means of the cases' figures, sums of what is counted."""
    header = ["method", *_time_header(comparison)]
    header += ["symmetric mm", "median case", "node mm", "covered %", "tips mm", "length %", "swaps"]
    header += ["lost", "degraded", "false OK %", "failed"]
    rows = []
    for method in comparison.methods:
        figures = [comparison.figures[case, method] for case in comparison.with_truth]
        seconds = np.concatenate([comparison.runs[case, method].seconds[2:] for case in comparison.cases])
        seconds = seconds[np.isfinite(seconds)]
        p50, p99 = np.percentile(seconds * 1e3, [50, 99]) if len(seconds) else (math.nan, math.nan)
        symmetric = [one.symmetric.mean for one in figures if one.symmetric]
        node = [one.node.mean for one in figures if one.node]
        tips = [tip.mean for one in figures for tip in (one.tip_start, one.tip_end) if tip]
        frames = max(sum(one.frames for one in figures), 1)
        rows.append(
            [
                method,
                _number(p50),
                _number(p99),
                _millimetres(_mean(symmetric)),
                _millimetres(float(np.median(symmetric)) if symmetric else math.nan),
                _millimetres(_mean(node)),
                _number(_mean([one.covered for one in figures]), 1, 100),
                _millimetres(_mean(tips)),
                _number(_mean([one.length_error for one in figures]), 1, 100),
                str(sum(one.swaps for one in figures)),
                str(sum(one.lost for one in figures)),
                str(sum(one.degraded for one in figures)),
                _number(sum(one.false_ok * one.frames for one in figures) / frames, 1, 100),
                str(sum(bool(comparison.figures[case, method].failure) for case in comparison.cases)),
            ]
        )
    return Table(tuple(header), rows)


def matrix_table(comparison: Comparison, name: str, figure: Callable[[Figures], float]) -> Table:
    """A row a case with truth, a column a method; the figure in millimetres.

    Parameters
    ----------
    name : str
        Of the figure, for the header.
    figure : callable
        Metres, of a run's figures.
    """
    numbers = [
        [figure(comparison.figures[case, method]) for method in comparison.methods] for case in comparison.with_truth
    ]
    rows = [[case, *map(_millimetres, values)] for case, values in zip(comparison.with_truth, numbers, strict=True)]
    for row in rows:
        for column, method in enumerate(comparison.methods, 1):
            row[column] += "*" if comparison.figures[row[0], method].failure else ""
    return Table((name, *comparison.methods), rows, numbers)


def case_table(comparison: Comparison, case: str) -> Table:
    """A row a method, of one case."""
    known = case in comparison.with_truth
    header = ["method", *_time_header(comparison)]
    if known:
        header += ["symmetric mm", "p95", "worst", "node mm", "covered %", "start mm", "end mm", "length %", "swaps"]
    else:
        header += ["length m", "± m"]
    header += ["ok", "degraded", "lost", *(["false OK %"] if known else []), "failed"]
    rows = []
    for method in comparison.methods:
        one = comparison.figures[case, method]
        row = [method, _number(one.p50_ms), _number(one.p99_ms)]
        if one.symmetric and one.node and one.tip_start and one.tip_end:
            row += [_millimetres(value) for value in (one.symmetric.mean, one.symmetric.p95, one.symmetric.worst)]
            row += [_millimetres(one.node.mean), _number(one.covered, 1, 100)]
            row += [_millimetres(one.tip_start.mean), _millimetres(one.tip_end.mean)]
            row += [_number(one.length_error, 1, 100), str(one.swaps)]
        else:
            row += [_number(one.length_median, 3), _number(one.length_std, 3)]
        row += [str(one.frames - one.degraded - one.lost), str(one.degraded), str(one.lost)]
        row += ([_number(one.false_ok, 1, 100)] if known else []) + ["yes" if one.failure else ""]
        rows.append(row)
    return Table(tuple(header), rows)


def disagreement_table(comparison: Comparison, case: str) -> Table:
    """The mean symmetric distance between each two methods, millimetres, over the frames in which both have one."""
    runs = comparison.of_run(case)
    rows = []
    for method, first in zip(comparison.methods, runs, strict=True):
        row = [method]
        for second in runs:
            apart = disagreements(first, second)
            apart = apart[np.isfinite(apart)]
            row.append("" if first is second else _millimetres(float(apart.mean()) if len(apart) else math.nan))
        rows.append(row)
    return Table(("mm apart", *comparison.methods), rows)


def symmetric_of(figures: Figures) -> float:
    """Its mean, metres; NaN without truth."""
    return figures.symmetric.mean if figures.symmetric else math.nan


def node_of(figures: Figures) -> float:
    """Mean error at equal arc length, metres; NaN without truth."""
    return figures.node.mean if figures.node else math.nan


def csv_text(comparison: Comparison) -> str:
    """A row a frame of every run; empty is what is not known."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["case", "method", "frame", *CSV_COLUMNS])
    for (case, method), run in comparison.runs.items():
        columns = [getattr(run, name).tolist() for name in CSV_COLUMNS.values()]
        for frame, row in enumerate(zip(*columns, strict=True)):
            cells = ["" if isinstance(value, float) and math.isnan(value) else value for value in row]
            writer.writerow([case, method, frame, *cells])
    return stream.getvalue()


def markdown_text(comparison: Comparison) -> str:
    """All tables."""
    parts = [f"# {comparison.title}", comparison.time_note]
    if comparison.with_truth:
        parts.append(
            "Frames without an estimate count with the rope's length as their error. Symmetric, node, covered, tips, "
            "length and false OK are means over the cases; swaps, lost, degraded and failed are sums."
        )
        parts.append(overall_table(comparison).markdown())
        parts.append("## Symmetric mean error by case, mm")
        parts.append(matrix_table(comparison, "case", symmetric_of).markdown())
        parts.append("## Error at equal arc length by case, mm")
        parts.append(matrix_table(comparison, "case", node_of).markdown())
    failures = comparison.failures()
    if failures:
        parts += ["## Failures (* in the tables)", "\n".join(f"- {failure}" for failure in failures)]
    for name, case in comparison.cases.items():
        parts += [f"## {name}", case.description + ".", case_table(comparison, name).markdown()]
        if name not in comparison.with_truth and len(comparison.methods) > 1:
            parts += ["Distance between the methods:", disagreement_table(comparison, name).markdown()]
    return "\n\n".join(parts) + "\n"


def _time_header(comparison: Comparison) -> tuple[str, str]:
    return ("p50 ms", "p99 ms") if comparison.timed else ("p50 ≈ms", "p99 ≈ms")


def _mean(values: list[float]) -> float:
    return sum(values) / len(values) if values else math.nan
