"""Results as Parquet: the rows of the CSV, typed and compressed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ropetrace.errors import import_extra
from ropetrace.results.base import FLOAT_COLUMNS, Closing, float_rows
from ropetrace.results.checkpoint import Checkpoint
from ropetrace.types import Cloud, Estimate, Frame

arrow: Any = import_extra("pyarrow", "parquet")
arrow_parquet: Any = import_extra("pyarrow.parquet", "parquet")


class ParquetWriter(Closing):
    """One row a waypoint; an estimate without waypoints is one row with nulls, and what is unknown is nulls.

    The metadata are key-values of the schema, `frame_name` among them.

    Raises
    ------
    OutputError
        If the file cannot be created or written.
    """

    def __init__(self, path: Path, *, overwrite: bool, frame_name: str, metadata: Mapping[str, str]) -> None:
        self._schema = arrow.schema(
            [
                ("frame", arrow.int64()),
                ("stamp_ns", arrow.int64()),
                ("ahead_ns", arrow.int64()),
                ("waypoint", arrow.int32()),
                ("status", arrow.string()),
                *((name, arrow.float64()) for name in FLOAT_COLUMNS),
                ("rope", arrow.int32()),
                ("seen", arrow.bool_()),
                ("tracker_sigma", arrow.float64()),
            ],
            metadata={**metadata, "frame_name": frame_name},
        )
        self._batches: list[Any] = []
        self._closed = False
        self._checkpoint = Checkpoint(path, overwrite, self._save)

    def write(self, index: int, estimate: Estimate, frame: Frame | None = None, cloud: Cloud | None = None) -> None:
        count = len(estimate.waypoints)
        rows = max(count, 1)
        numbers = np.arange(count, dtype=np.int32) if count else arrow.nulls(1, arrow.int32())
        values = float_rows(estimate) if count else np.full((1, len(FLOAT_COLUMNS)), np.nan)
        self._batches.append(
            arrow.record_batch(
                [
                    np.full(rows, index, np.int64),
                    np.full(rows, estimate.stamp_ns, np.int64),
                    np.full(rows, estimate.ahead_ns, np.int64),
                    numbers,
                    arrow.array([str(estimate.status)] * rows),
                    # `from_pandas` is what makes a NaN a null.
                    *(arrow.array(column, from_pandas=True) for column in np.ascontiguousarray(values.T)),
                    np.full(rows, estimate.rope, np.int32),
                    _column(estimate.seen, rows, arrow.bool_()),
                    _column(estimate.position_sigma, rows, arrow.float64()),
                ],
                schema=self._schema,
            )
        )
        self._checkpoint.write_if_due()

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._checkpoint.write(last=True)

    def _save(self, file: BinaryIO) -> None:
        # One contiguous batch: many small ones cost more memory and time at every checkpoint that follows.
        table = arrow.Table.from_batches(self._batches, self._schema).combine_chunks()
        arrow_parquet.write_table(table, file)
        self._batches = table.to_batches()


def _column(values: NDArray[Any] | None, rows: int, kind: Any) -> Any:
    """The values of `rows` waypoints; nulls where there are none."""
    return arrow.nulls(rows, kind) if values is None or not len(values) else arrow.array(values, kind)
