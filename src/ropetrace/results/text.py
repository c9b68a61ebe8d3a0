"""Results as CSV: one row a waypoint."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ropetrace.results.base import COLUMNS, FLOAT_COLUMNS, Closing, WholeFile, float_rows
from ropetrace.types import Cloud, Estimate, Frame


class CsvWriter(Closing):
    """One row a waypoint; an estimate without waypoints is one row with empty cells, and what is not known is empty.

    Numbers have the fewest digits that read back as exactly the same double, so that a CSV, a Parquet and an
    NPZ file of one run are equal to the last bit. An estimate reaches the system in one write, whole. Metadata
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
            self._file.append(f"{start},{estimate.status}{',' * len(FLOAT_COLUMNS)},{estimate.rope},,\n".encode())
            return
        rows = (
            f"{start}{number},{estimate.status},{','.join(map(repr, row))},{estimate.rope},{told}\n"
            for number, (row, told) in enumerate(zip(float_rows(estimate).tolist(), _told(estimate), strict=True))
        )
        self._file.append("".join(rows).replace(",nan", ",").encode())

    def close(self) -> None:
        self._file.close()


def _told(estimate: Estimate) -> list[str]:
    """The cells of each waypoint for what the tracker tells of it, empty where it does not."""
    silent = [""] * len(estimate.waypoints)
    seen = silent if estimate.seen is None else [str(int(value)) for value in estimate.seen]
    sigma = silent if estimate.position_sigma is None else [repr(value) for value in estimate.position_sigma.tolist()]
    return [",".join(pair) for pair in zip(seen, sigma, strict=True)]
