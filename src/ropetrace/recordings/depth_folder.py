"""Plain folders of ``depth_*.png`` and ``intrinsics.json``: no stamps and no colour."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from ropetrace.errors import FrameError
from ropetrace.recordings import images
from ropetrace.recordings.base import RecordingInfo, StampStatistics, natural_key, read_camera, read_file, stamp_at
from ropetrace.recordings.rgbd_folder import note_bad_images
from ropetrace.types import BadFrame, Event, RgbdFrame


class DepthFolder:
    """A recording in a plain folder; see `ropetrace.recordings.base.Recording`.

    Parameters
    ----------
    path : Path
        The folder.
    rate : float
        Frames per second; the first frame has stamp 0.

    Raises
    ------
    RecordingError
        If ``intrinsics.json`` is missing or unusable.
    """

    kind = "depth image folder"

    def __init__(self, path: Path, rate: float) -> None:
        self.path = path
        self.problems: list[str] = []
        self.intrinsics, self.depth_unit_m = read_camera(path / "intrinsics.json")
        self._rate = rate
        self._files = sorted(path.glob("depth_*.png"), key=lambda file: natural_key(file.name))

    @property
    def frame_count(self) -> int:
        """Depth images in the folder."""
        return len(self._files)

    def frames(self, start: int = 0, limit: int | None = None) -> Iterator[Event]:
        """See `Recording.frames`."""
        stop = None if limit is None else start + limit
        for index, file in islice(enumerate(self._files), start, stop):
            stamp = stamp_at(index, self._rate)
            try:
                depth = images.decode_depth(read_file(file))
                yield RgbdFrame(stamp, depth, self.depth_unit_m, self.intrinsics)
            except FrameError as error:
                yield BadFrame(stamp, f"{file.name}: {error}")

    def info(self) -> RecordingInfo:
        """See `Recording.info`."""
        statistics = StampStatistics()
        for index in range(len(self._files)):
            statistics.add(stamp_at(index, self._rate))
        note_bad_images(self.path, self._files, "depth", self.problems)
        size = (self.intrinsics.width, self.intrinsics.height)
        return RecordingInfo(
            self.path,
            self.kind,
            (statistics.stream("depth", "16-bit grey PNG", *size),),
            statistics.duration,
            self.intrinsics,
            "every PNG chunk has a CRC",
            tuple(self.problems),
        )
