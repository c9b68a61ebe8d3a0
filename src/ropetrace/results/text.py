"""Results as CSV: one row a waypoint."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ropetrace.results.base import COLUMNS, FLOAT_COLUMNS, Closing, WholeFile, float_rows
from ropetrace.types import Cloud, Estimate, Frame


class CsvWriter(Closing):
    """One row a waypoint; a frame without waypoints is one row with empty cells, and an unknown motion is empty cells.

    Numbers have the fewest digits that read back as exactly the same double, so that a CSV, a Parquet and an
    NPZ file of one run are equal to the last bit. A frame reaches the system in one write, whole. Metadata
    are not kept: a comment line would trip what reads plain CSV.

    Raises
    ------
    OutputError
        If the file cannot be created or written.
    """

    def __init__(self, path: Path, *, overwrite: bool, frame_name: str, metadata: Mapping[str, str]) -> None:
        self._file = WholeFile(path, overwrite)
        with self._file.closed_on_error():
            self._file.append((",".join(COLUMNS) + "\n").encode())

    def write(self, index: int, estimate: Estimate, frame: Frame | None = None, cloud: Cloud | None = None) -> None:
        start = f"{index},{estimate.stamp_ns},{estimate.ahead_ns},"
        if not len(estimate.waypoints):
            self._file.append(f"{start},{estimate.status}{',' * len(FLOAT_COLUMNS)}\n".encode())
            return
        rows = (
            f"{start}{number},{estimate.status},{','.join(map(repr, row))}\n"
            for number, row in enumerate(float_rows(estimate).tolist())
        )
        self._file.append("".join(rows).replace(",nan", ",").encode())

    def close(self) -> None:
        self._file.close()
