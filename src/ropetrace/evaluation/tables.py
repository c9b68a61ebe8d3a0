"""What the reports of all experiments are made of: tables in Markdown and CSV, and figures as PNG."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ropetrace.evaluation.case1 import Condition
from ropetrace.evaluation.run_folder import replace_files


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose columns also line up where it is not rendered."""
    widths = [max(len(row[k]) for row in [header, *rows]) for k in range(len(header))]
    lines = [" | ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in [header, *rows]]
    lines.insert(1, " | ".join("-" * (width - 1) + ":" for width in widths))
    return "\n".join(f"| {line} |" for line in lines)


def csv_cells(values: Any) -> list[str]:
    """Of an array: what is missing is empty, and reading a number back gives the same bits."""
    if values.dtype.kind == "U":
        return list(map(str, values))
    return ["" if math.isnan(value) else repr(value) for value in values.tolist()]


def spread(mean: float, std: float) -> str:
    """Mean and standard deviation."""
    return f"{mean:.3f} ± {std:.3f}"


def condition_title(condition: Condition) -> str:
    """Such as 30 fps, 480x360, real time."""
    speed = "real time" if condition.speed == 1 else f"{condition.speed:.0%} of real time"
    return f"{condition.rate:g} fps, {condition.width}x{condition.height}, {speed}"


def write_parts(folder: Path, name: str, readings: str, report: str, figure: bytes) -> list[Path]:
    """Write NAME.csv, NAME.md and NAME.png, each as a whole; gives their paths.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    parts = {".csv": readings.encode(), ".md": report.encode(), ".png": figure}
    return replace_files(folder, {name + suffix: data for suffix, data in parts.items()})


def png(sheet: Any) -> bytes:
    """Of a Matplotlib figure: the same figure gives the same bytes."""
    stream = io.BytesIO()
    sheet.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()
