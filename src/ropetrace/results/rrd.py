"""Results as a recording of the Rerun viewer."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping
from pathlib import Path

from ropetrace.errors import OutputError
from ropetrace.results.base import Closing, WholeFile
from ropetrace.types import Cloud, Estimate, FloatArray, Frame
from ropetrace.viewer import ArmView, RerunLog, default_blueprint, new_recording

PIECE_BYTES = 1 << 16
"""What is written at once: as much as a pipe holds."""

FLUSH_SECONDS = 0.2
"""What a process that is killed may lose. To flush each frame would make the file half as large again."""


class RrdWriter(Closing):
    """Everything that `ropetrace.viewer` shows, for ``rerun run.rrd``. To look at, not to archive.

    Raises
    ------
    OutputError
        If the file cannot be created or written.
    """

    def __init__(
        self,
        path: Path,
        *,
        overwrite: bool,
        frame_name: str,
        metadata: Mapping[str, str],
        frame_from_camera: FloatArray | None = None,
        arm: bool = False,
    ) -> None:
        self._error: OutputError | None = None
        self._closed = False
        self._flushed = time.monotonic()
        self._file = WholeFile(path, overwrite)
        with self._file.closed_on_error():
            # Rerun writes to a pipe, never to the file: when the disk is full its own writer may wait for
            # ever, and the end of the process with it (seen with 0.41).
            source, sink = os.pipe()
            self._thread = threading.Thread(target=self._store, args=(source,), name="rrd", daemon=True)
            self._thread.start()
            try:
                self._recording = new_recording()
                self._recording.save(f"/dev/fd/{sink}", default_blueprint(arm))
            finally:
                os.close(sink)
            self._log = RerunLog(
                self._recording, frame_name=frame_name, frame_from_camera=frame_from_camera, metadata=metadata
            )

    def write(
        self,
        index: int,
        estimate: Estimate,
        frame: Frame | None = None,
        cloud: Cloud | None = None,
        arm: ArmView | None = None,
    ) -> None:
        if self._error is not None:
            raise self._error
        self._log.log(index, estimate, frame, cloud, arm)
        if time.monotonic() - self._flushed >= FLUSH_SECONDS:
            # This waits for the disk, too: else Rerun's queue would take all memory where the disk is slow.
            self._recording.flush()
            self._flushed = time.monotonic()

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        self._recording.flush()
        self._recording.disconnect()
        self._thread.join()
        self._file.close()
        if self._error is not None:
            raise self._error

    def _store(self, source: int) -> None:
        """Carry what comes out of the pipe to the file; after an error, only out of the pipe."""
        with open(source, "rb", buffering=0) as pipe:
            while data := pipe.read(PIECE_BYTES):
                if self._error is None:
                    try:
                        self._file.append(data)
                    except OutputError as error:
                        self._error = error
