"""Writes what a comparison amounts to: frames as CSV, tables as Markdown, and the page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ropetrace.errors import ConfigError
from ropetrace.evaluation.compare import Run
from ropetrace.evaluation.compare_page import page
from ropetrace.evaluation.compare_runs import Task
from ropetrace.evaluation.compare_tables import (
    Comparison,
    case_table,
    csv_text,
    markdown_text,
    overall_table,
)
from ropetrace.evaluation.run_folder import RunFolder, replace_files


def write_report(
    folder: RunFolder[Task, Run], tasks: Sequence[Task], title: str, timed: bool
) -> tuple[list[Path], str]:
    """Write compare.csv, compare.md and compare.html of finished runs; the same runs give the same bytes.

    Parameters
    ----------
    folder : RunFolder
        That has them.
    tasks : sequence of Task
        Every case with every method.
    title : str
        Of the report.
    timed : bool
        See `Comparison`.

    Returns
    -------
    paths : list of Path
        The three files.
    summary : str
        For the terminal: the table over all cases and the methods that failed.

    Raises
    ------
    ConfigError
        If a case has no frames.
    OutputError
        If a run cannot be read or a file cannot be written.
    """
    comparison = Comparison(
        title,
        {task.case.name: task.case for task in tasks},
        tuple(dict.fromkeys(task.config.method for task in tasks)),
        {task.key: folder.load(task) for task in tasks},
        timed,
    )
    for (case, _), run in comparison.runs.items():
        if not len(run):
            raise ConfigError(f"{case}: there are no frames to compare on: give a smaller --start")
    files = {"compare.csv": csv_text(comparison), "compare.md": markdown_text(comparison)}
    files["compare.html"] = page(comparison)
    paths = replace_files(folder.path, {name: text.encode() for name, text in files.items()})
    if len(comparison.cases) == 1 or not comparison.with_truth:
        summary = case_table(comparison, next(iter(comparison.cases))).markdown()
    else:
        summary = overall_table(comparison).markdown()
    return paths, "\n".join([summary, *(f"! {failure}" for failure in comparison.failures())])
