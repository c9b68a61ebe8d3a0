"""Results as CSV: one row a waypoint."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ropetrace.results.base import COLUMNS, FLOAT_COLUMNS, Closing, WholeFile
from ropetrace.types import Cloud, Estimate, Frame


class CsvWriter(Closing):
    """One row a waypoint; a frame without waypoints is one row with empty cells.

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
        waypoints = estimate.waypoints
        start = f"{index},{estimate.stamp_ns},"
        if not len(waypoints):
            self._file.append(f"{start},{estimate.status}{',' * len(FLOAT_COLUMNS)}\n".encode())
            return
        values = np.column_stack((waypoints.arc_length, waypoints.positions, waypoints.quaternions)).tolist()
        rows = (f"{start}{number},{estimate.status},{','.join(map(repr, row))}\n" for number, row in enumerate(values))
        self._file.append("".join(rows).encode())

    def close(self) -> None:
        self._file.close()
