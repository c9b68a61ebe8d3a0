"""What case study 2 amounts to: all readings as a table, a summary beside the paper's figures, and its Figure 6."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from ropetrace.control.tracing import TracingSettings
from ropetrace.errors import import_extra
from ropetrace.evaluation.case1 import CONDITIONS, Case, Condition
from ropetrace.evaluation.case2 import CONTROL_RATE, Case2Settings, Tracing
from ropetrace.evaluation.tables import condition_title, csv_cells, markdown_table, png, spread, write_parts
from ropetrace.types import FloatArray

COLUMNS = {"time_s": "time", "place": "place", "visible": "visible", "linear_m": "linear", "angular_rad": "angular"}
"""Of the CSV, after condition, frequency_hz, tracing and outcome; each with its field of `Tracing`."""

PAPER_WORST = {"30fps": ((25.8, 31.8), (0.249, 0.177)), "60fps": ((7.02, 6.58), (0.186, 0.142))}
"""The paper's worst cases: linear, millimetres, and angular, radians. It does not say at which frequency."""

Results = Mapping[Case, Tracing]


@dataclass(frozen=True, slots=True)
class Group:
    """The tracings of one condition and frequency.

    Parameters
    ----------
    condition : Condition
        The camera.
    frequency : float
        Of the wind, Hz.
    tracings : sequence of Tracing
        One at least.
    """

    condition: Condition
    frequency: float
    tracings: Sequence[Tracing]

    @property
    def completed(self) -> int:
        """How many reached the end of the rope."""
        return sum(tracing.completed for tracing in self.tracings)

    @property
    def linear(self) -> FloatArray:
        """All readings, millimetres: those of failures too."""
        return np.concatenate([tracing.linear for tracing in self.tracings]) * 1e3

    @property
    def angular(self) -> FloatArray:
        """All readings, radians."""
        return np.concatenate([tracing.angular for tracing in self.tracings])


def groups(results: Results) -> list[Group]:
    """The tracings by condition and frequency, in the order of the cases."""
    found: dict[tuple[Condition, float], list[Tracing]] = {}
    for case, tracing in results.items():
        found.setdefault((case.condition, case.frequency), []).append(tracing)
    return [Group(*key, tracings) for key, tracings in found.items()]


def write_report(
    folder: Path, results: Results, settings: Case2Settings, compute_times: Mapping[str, float]
) -> list[Path]:
    """Write case2.csv, case2.md and case2.png; the same results give the same bytes.

    Raises
    ------
    OutputError
        If a file cannot be written.
    MissingExtraError
        If Matplotlib is not installed.
    """
    return write_parts(
        folder, "case2", csv_text(results), report_text(results, settings, compute_times), figure(results)
    )


def csv_text(results: Results) -> str:
    """A row for each reading. Reading a number back gives the same bits."""
    lines = [",".join(["condition", "frequency_hz", "tracing", "outcome", *COLUMNS])]
    for case, tracing in results.items():
        columns = [csv_cells(getattr(tracing, name)) for name in COLUMNS.values()]
        outcome = '"' + str(tracing.outcome).replace('"', '""') + '"'
        start = f"{case.condition.name},{case.frequency!r},{_number(case)},{outcome}"
        lines += [",".join([start, *row]) for row in zip(*columns, strict=True)]
    return "\n".join(lines) + "\n"


def _number(case: Case) -> int:
    """Which tracing, from 1."""
    return 1 + (case.repeat or 0)


def summary_table(results: Results) -> str:
    """A row for each condition and frequency, in Markdown that is aligned for a terminal."""
    header = (
        "camera", "wind, Hz", "completed", "traced", "readings", "linear, mm", "worst", "angular, rad", "worst",
        "duration, s",
    )  # fmt: skip
    rows = [
        (
            group.condition.name,
            f"{group.frequency:g}",
            f"{group.completed} of {len(group.tracings)}",
            f"{np.mean([tracing.traced for tracing in group.tracings]):.1%}",
            str(len(group.linear)),
            *_statistics(group.linear, 2),
            *_statistics(group.angular, 3),
            f"{np.mean([tracing.duration for tracing in group.tracings]):.2f}",
        )
        for group in groups(results)
    ]
    return markdown_table(header, rows)


def _statistics(errors: FloatArray, digits: int) -> tuple[str, str]:
    """Mean with its standard deviation, and the worst; of no readings there is nothing to say."""
    return (spread(errors.mean(), errors.std()), f"{errors.max():.{digits}f}") if len(errors) else ("", "")


def worst_table(results: Results) -> str:
    """Our worst frequency in each condition beside the paper's worst case."""
    rows = []
    for condition in CONDITIONS:
        linear, angular = (_worst(results, condition, name) for name in ("linear", "angular"))
        if linear is None or angular is None:
            continue
        paper = ["{:g} ± {:g}".format(*figures) for figures in PAPER_WORST[condition.name]]
        rows.append(
            (
                condition.name,
                f"{linear[0]:g}",
                spread(*linear[1:]),
                paper[0],
                f"{angular[0]:g}",
                spread(*angular[1:]),
                paper[1],
            )
        )
    header = ("camera", "at, Hz", "linear, mm", "paper's worst", "at, Hz", "angular, rad", "paper's worst")
    return markdown_table(header, rows)


def _worst(results: Results, condition: Condition, name: str) -> tuple[float, float, float] | None:
    """Frequency, mean and standard deviation of the case with the greatest mean."""
    found = [
        (group.frequency, float(errors.mean()), float(errors.std()))
        for group in groups(results)
        if group.condition == condition and len(errors := getattr(group, name))
    ]
    return max(found, key=lambda case: case[1], default=None)


def limits_table(results: Results) -> str:
    """How near the arm came to what it must not do: a row for each condition and frequency."""
    header = (
        "camera", "wind, Hz", "manipulability", "joint's end, rad", "velocity", "acceleration", "jerk", "tool, m/s",
        "limited", "seen", "braked for",
    )  # fmt: skip
    rows = []
    for group in groups(results):
        tracings = group.tracings
        margin = np.min([tracing.margin for tracing in tracings], axis=0)
        seen = np.concatenate([tracing.visible for tracing in tracings])
        rows.append(
            (
                group.condition.name,
                f"{group.frequency:g}",
                f"{min(float(tracing.manipulability) for tracing in tracings):.4f}",
                f"{margin.min():.3f} (J{margin.argmin() + 1})",
                *(_peak(tracings, name) for name in ("velocity", "acceleration", "jerk")),
                f"{max(float(tracing.tool_speed) for tracing in tracings):.2f}",
                f"{np.mean([tracing.limited for tracing in tracings]):.1%}",
                f"{seen.min():.0%}" if len(seen) else "",
                "; ".join(str(tracing.braked) for tracing in tracings if str(tracing.braked)) or "nothing",
            )
        )
    return markdown_table(header, rows)


def _peak(tracings: Sequence[Tracing], name: str) -> str:
    """Greatest share of a limit, and whose."""
    shares = np.max([getattr(tracing, name) for tracing in tracings], axis=0)
    return f"{shares.max():.0%} (J{shares.argmax() + 1})"


def joints_table(results: Results) -> str:
    """The same for each joint, over all tracings."""
    tracings = list(results.values())
    margin = np.min([tracing.margin for tracing in tracings], axis=0)
    peaks = [np.max([getattr(t, name) for t in tracings], axis=0) for name in ("velocity", "acceleration", "jerk")]
    rows = [
        (f"J{joint + 1}", f"{margin[joint]:.3f}", *(f"{peak[joint]:.0%}" for peak in peaks))
        for joint in range(len(margin))
    ]
    return markdown_table(("joint", "from its end, rad", "velocity", "acceleration", "jerk"), rows)


def _gains_table(tracing: TracingSettings) -> str:
    names = {
        "gain_near": "lambda_0, 1/s",
        "gain_far": "lambda_inf, 1/s",
        "gain_slope": "lambda-dot_0, 1/s",
        "feed_forward": "beta",
        "waypoint_distance": "delta_p, m",
        "manipulability_gain": "k_s",
        "joint_limit_gain": "k_jl",
    }
    rows = []
    for item in fields(tracing):
        value = getattr(tracing, item.name)
        rows.append((item.name, names.get(item.name, ""), f"{value:.6g}" if isinstance(value, float) else str(value)))
    return markdown_table(("setting", "in the paper", "value"), rows)


def _failures(results: Results) -> Iterator[str]:
    failed = {case: tracing for case, tracing in results.items() if not tracing.completed}
    yield (
        f"{len(results) - len(failed)} of {len(results)} tracings were completed. The readings of a failure, up to it, "
        "count as all others do."
    )
    if failed:
        rows = [
            (
                case.condition.name,
                f"{case.frequency:g}",
                str(_number(case)),
                str(tracing.outcome),
                f"{float(tracing.traced):.1%}",
                str(len(tracing.time)),
            )
            for case, tracing in failed.items()
        ]
        yield markdown_table(("camera", "wind, Hz", "tracing", "outcome", "traced", "readings"), rows)


def report_text(results: Results, settings: Case2Settings, compute_times: Mapping[str, float]) -> str:
    """The whole report, in Markdown."""
    placement = settings.placement
    parts = [
        "# Case study 2: an arm traces a rope that sways in a wind",
        f"Tracings of each condition and frequency: {settings.tracings}, begun at different phases of the swing after "
        f"{settings.warm_up:g} s of warming up; a reading every {settings.interval:g} s from the moment at which the "
        "tool reaches the first waypoint to the end of the task, none removed. The way to the first waypoint is not in "
        f"the readings. Sensor noise: {settings.noise}; tracker: {settings.method}; arm: {settings.arm}, its base at "
        f"{placement.base} m, turned by {placement.yaw_degrees:g}°; tool: {settings.tracing.approach}; seed "
        f"{settings.seed}.",
        f"At each of {CONTROL_RATE:g} control steps a second the rope is predicted to that very moment from the frames "
        "whose centrelines are available then. From a frame's arrival to its centreline, in simulated time ("
        + ("set by hand" if settings.latency is not None else "p99, measured once before the run")
        + "): "
        + ", ".join(f"{name} {seconds * 1e3:.4g} ms" for name, seconds in sorted(compute_times.items()))
        + ". The arm follows its commands through servos with inertia; gripper and rope do not touch each other.",
        "## Errors",
        "From the tool to the true rope, mean ± standard deviation over the readings of all tracings; "
        "*traced* is the share of the rope's true length that the tool came past.",
        summary_table(results),
        "Our worst case of each condition beside the paper's. The paper gives the figures of its worst cases alone, "
        "and does not say at which frequency they were:",
        worst_table(results),
        *_failures(results),
        "## Limits",
        "The worst of the tracings, from the start of the arm on: least manipulability (equation 24), least "
        "distance of a joint to an end of its range, greatest commanded velocity, acceleration and jerk in shares of "
        "the joints' limits, and the tool's greatest speed. *Limited* is the mean share of the control steps in which "
        "the joints could not be given all that the tracer wished, *seen* the least share of the rope that was in the "
        "camera's view, and *braked for* counts the control steps in which the guard stopped the arm before the end.",
        limits_table(results),
        "Each joint, over all tracings:",
        joints_table(results),
        "## Gains",
        "The paper's Table II is lost. Used were:",
        _gains_table(settings.tracing),
    ]
    return "\n\n".join(parts) + "\n"


def figure(results: Results) -> bytes:
    """The paper's Figure 6 as a PNG: mean and standard deviation against frequency, a column for each condition.

    The errors span two decades, so the axis is logarithmic. Beside the frequencies stand the worst cases, ours and the
    paper's, which names no frequency.
    """
    import_extra("matplotlib", "sim")
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, NullFormatter

    found = groups(results)
    conditions = [condition for condition in CONDITIONS if any(group.condition == condition for group in found)]
    frequencies = sorted({group.frequency for group in found})
    aside = frequencies[-1] + 0.35
    sheet = Figure(figsize=(1.0 + 4.4 * len(conditions), 6.4), dpi=150, layout="constrained")
    axes = sheet.subplots(2, len(conditions), squeeze=False, sharex=True, sharey="row")
    style = {"capsize": 3, "markersize": 5, "linewidth": 1.4, "elinewidth": 1.0}
    for column, condition in enumerate(conditions):
        for row, (kind, label) in enumerate((("linear", "mm"), ("angular", "rad"))):
            axis = axes[row, column]
            axis.set_yscale("log", nonpositive="clip")
            ours = [
                (group.frequency, errors.mean(), errors.std())
                for group in found
                if group.condition == condition and len(errors := getattr(group, kind))
            ]
            if ours:
                axis.errorbar(*np.array(ours).T, fmt="o-", color="#1f5fa8", label="ropetrace", **style)
                worst = max(ours, key=lambda case: case[1])
                axis.errorbar([aside - 0.05], [worst[1]], [worst[2]], fmt="o", color="#1f5fa8", **style)
            paper = PAPER_WORST[condition.name][row]
            axis.errorbar([aside + 0.05], [paper[0]], [paper[1]], fmt="s", color="#c8281e", label="the paper", **style)
            axis.axvline(aside - 0.17, color="#bbbbbb", linewidth=0.8)
            axis.grid(color="#dddddd", linewidth=0.6)
            axis.set_axisbelow(True)
            axis.spines[["top", "right"]].set_visible(False)
            axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.yaxis.set_minor_formatter(NullFormatter())
            if column == 0:
                axis.set_ylabel(f"{kind} error, {label}")
        axes[0, column].set_title(f"({'ab'[column]}) {condition_title(condition)}", fontsize=10)
        axes[1, column].set_xlabel("frequency of the wind, Hz")
        axes[1, column].set_xticks([*frequencies, aside], [*(f"{value:g}" for value in frequencies), "worst"])
    for row, kind in enumerate(("linear", "angular")):
        # Bars that reach down to zero or below end at the axis: they must not stretch it.
        means = [float(np.mean(getattr(group, kind))) for group in found if len(getattr(group, kind))]
        tops = [sum(PAPER_WORST[condition.name][row]) for condition in conditions]
        means += [PAPER_WORST[condition.name][row][0] for condition in conditions]
        axes[row, 0].set_ylim(10 ** math.floor(math.log10(max(min(means) / 2, 1e-6))), 1.3 * max(*tops, *means))
    axes[0, 0].legend(frameon=False, loc="upper left", title="mean ± standard deviation", alignment="left")
    return png(sheet)
