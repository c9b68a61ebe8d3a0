"""Writes frames to MCAP as the ROS 2 messages that ROS tools and Foxglove read."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from ropetrace.errors import FrameError, OutputError
from ropetrace.recordings.mcap_append import McapAppender
from ropetrace.recordings.ros_frames import frame_messages
from ropetrace.types import Intrinsics, RgbdFrame


class McapFrameWriter:
    """Writes frames into a new MCAP file, losslessly; what was written before a crash stays readable.

    Every chunk has a CRC, and so has the file. Depth goes to ``/camera/aligned_depth_to_color/image_raw`` as
    16UC1 (uint16 millimetres) or 32FC1 (float32 metres), colour to ``/camera/color/image_raw`` as rgb8, each
    with its ``camera_info``.

    Parameters
    ----------
    path : path
        The file; must not exist.
    intrinsics : Intrinsics
        The camera.
    depth_unit_m : float
        Metres in one unit of depth: ROS has 0.001 for uint16 and 1 for float32, and no other.

    Raises
    ------
    OutputError
        If the file exists or cannot be made, or the unit is none of the two.
    """

    def __init__(self, path: str | Path, intrinsics: Intrinsics, depth_unit_m: float) -> None:
        self.path = Path(path)
        self.intrinsics = intrinsics
        self.depth_unit_m = depth_unit_m
        kinds: dict[float, type] = {0.001: np.uint16, 1.0: np.float32}
        if depth_unit_m not in kinds:
            raise OutputError(
                f"{self.path}: depth_unit_m = {depth_unit_m}: ROS images hold uint16 millimetres (0.001) "
                "or float32 metres (1); convert depth to metres, or write an RGB-D folder"
            )
        self._depth_type = kinds[depth_unit_m]
        self._file = McapAppender(self.path, overwrite=False, metadata={})

    def write(self, frame: RgbdFrame) -> None:
        """Add a frame.

        Raises
        ------
        OutputError
            If the frame's camera, unit or type of depth is not the file's, its stamp does not fit a ROS
            header, or the disk refuses.
        """
        if frame.intrinsics != self.intrinsics or frame.depth_unit_m != self.depth_unit_m:
            raise OutputError(f"{self.path}: the frame's camera or depth unit is not the recording's")
        if frame.depth.dtype != self._depth_type:
            raise OutputError(
                f"{self.path}: depth is {frame.depth.dtype}; with depth_unit_m = {self.depth_unit_m} "
                f"ROS images hold {np.dtype(self._depth_type)}"
            )
        try:
            self._file.append(frame_messages(frame))
        except FrameError as error:
            raise OutputError(f"{self.path}: {error}") from None

    def close(self) -> None:
        """Write the index and close the file; may be called again.

        Raises
        ------
        OutputError
            If the disk refuses.
        """
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
