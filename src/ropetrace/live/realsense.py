"""RealSense cameras, through pyrealsense2: depth that is aligned to colour."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ropetrace.errors import FrameError, MissingExtraError, RecordingError, import_extra
from ropetrace.live.camera import CameraGoneError, Capture
from ropetrace.recordings.base import one_line
from ropetrace.types import BadFrame, Event, Intrinsics, RgbdFrame


def find_realsense(serial: str) -> RealSenseCamera:
    """The camera with this serial number, or the only one if it is empty.

    Raises
    ------
    RecordingError
        If it is not connected, or there are several to choose from.
    MissingExtraError
        If pyrealsense2, or the libusb that it needs, is not installed.
    """
    rs = _pyrealsense2()
    context = rs.context()
    found = _serials(rs, context)
    listed = f"connected are {', '.join(found)}" if found else "none is connected"
    if serial and serial not in found:
        raise RecordingError(f"realsense:{serial}: there is no RealSense camera of that serial number: {listed}")
    if not found:
        raise RecordingError("realsense: no RealSense camera is connected: plug it in, and see that you may use it")
    if not serial and len(found) > 1:
        raise RecordingError(f"realsense: {listed}: choose one, such as realsense:{found[0]}")
    chosen = serial or found[0]
    return RealSenseCamera(rs, lambda: _start(rs, context, chosen))


class RealSenseCamera:
    """A RealSense camera with the resolution and rate that are its defaults.

    Parameters
    ----------
    rs : module
        pyrealsense2.
    start : callable
        Starts the camera: returns what has `try_wait_for_frames` and `stop`, as `pyrealsense2.pipeline` has; raises a
        RuntimeError or a CameraGoneError if it is not there.
    """

    kind = "RealSense camera"

    def __init__(self, rs: Any, start: Callable[[], Any]) -> None:
        self._rs = rs
        self._start = start
        self._align = rs.align(rs.stream.color)
        self._pipeline: Any = None

    def connect(self) -> None:
        try:
            self._pipeline = self._start()
        except RuntimeError as error:
            raise CameraGoneError(f"the {self.kind} does not start: {one_line(error)}") from None

    def fetch(self, timeout: float) -> Capture | None:
        try:
            came, frames = self._pipeline.try_wait_for_frames(round(timeout * 1e3))
            arrival_ns = time.monotonic_ns()
            if not came or not frames.get_depth_frame() or not frames.get_color_frame():
                return None
            aligned = self._align.process(frames)
        except RuntimeError as error:
            raise CameraGoneError(one_line(error)) from None
        depth = aligned.get_depth_frame()
        event = _event(depth, aligned.get_color_frame())
        moment_ns = None
        if depth.get_frame_timestamp_domain() != self._rs.timestamp_domain.hardware_clock:
            moment_ns = time.monotonic_ns() - (time.time_ns() - event.stamp_ns)
        return Capture(event, arrival_ns, moment_ns)

    def disconnect(self) -> None:
        # A camera that is gone cannot be stopped.
        with contextlib.suppress(RuntimeError):
            self._pipeline.stop()
        self._pipeline = None


def _pyrealsense2() -> Any:
    try:
        return import_extra("pyrealsense2", "realsense")
    except MissingExtraError as error:
        if "libusb" in str(error):
            raise MissingExtraError("pyrealsense2 needs the system's libusb: apt install libusb-1.0-0") from error
        raise


def _serials(rs: Any, context: Any) -> list[str]:
    return [str(device.get_info(rs.camera_info.serial_number)) for device in context.query_devices()]


def _start(rs: Any, context: Any, serial: str) -> Any:
    # The pipeline itself would wait for a camera that is not there, for 15 s.
    if serial not in _serials(rs, context):
        raise CameraGoneError(f"RealSense {serial} is not connected")
    config = rs.config()
    config.enable_device(serial)
    config.enable_stream(rs.stream.depth)
    config.enable_stream(rs.stream.color, rs.format.rgb8)
    pipeline = rs.pipeline(context)
    pipeline.start(config)
    return pipeline


def _event(depth: Any, color: Any) -> Event:
    """A frame with arrays of its own, of depth that is aligned to colour."""
    stamp_ns = round(depth.get_timestamp() * 1e6)
    camera = depth.profile.as_video_stream_profile().get_intrinsics()
    try:
        return RgbdFrame(
            stamp_ns,
            np.array(depth.get_data()),
            round(depth.get_units(), 8),
            Intrinsics(camera.width, camera.height, camera.fx, camera.fy, camera.ppx, camera.ppy),
            np.array(color.get_data()),
        )
    except FrameError as error:
        return BadFrame(stamp_ns, str(error))
