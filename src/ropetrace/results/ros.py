"""Results as MCAP with ROS 2 messages, for Foxglove, RViz and ``ros2 bag``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ropetrace.errors import FrameError, OutputError
from ropetrace.recordings.mcap_append import McapAppender
from ropetrace.recordings.ros_frames import FRAME_ID
from ropetrace.recordings.ros_messages import RawMessage
from ropetrace.results.base import Closing
from ropetrace.results.ros_estimates import (
    CLOUD,
    DIAGNOSTICS,
    LAST_STAMP,
    PATH,
    TRAJECTORY,
    estimate_status,
    header,
    topic_of,
    typestore,
    waypoint_cloud,
)
from ropetrace.results.ros_packed import pack_path, pack_trajectory
from ropetrace.types import Cloud, Estimate, Frame

METADATA = "ropetrace"
"""The record of metadata that tells how the results were made."""


class McapWriter(Closing):
    """The messages of `EstimateMessages` for each rope of a frame, in a file.

    Each estimate is a chunk of its own, with a checksum, and reaches the system before `write` returns: a process that
    is killed loses none that was written. The metadata are the record ``ropetrace``, `frame_name` among them.

    Raises
    ------
    OutputError
        If the file cannot be created or written, or a time does not fit a ROS time: before 1970, after 2038.
    """

    def __init__(self, path: Path, *, overwrite: bool, frame_name: str, metadata: Mapping[str, str]) -> None:
        self._path = path
        self._messages = EstimateMessages(frame_name)
        self._file = McapAppender(path, overwrite, {METADATA: {**metadata, "frame_name": frame_name}})
        try:
            self._file.begin()
        except BaseException:
            self._file.close()
            raise

    def write(self, index: int, estimate: Estimate, frame: Frame | None = None, cloud: Cloud | None = None) -> None:
        try:
            messages = self._messages.of(estimate)
        except FrameError as error:
            raise OutputError(f"{self._path}: frame {index}: {error}") from None
        self._file.append(messages)

    def close(self) -> None:
        self._file.close()


class EstimateMessages:
    """A `PATH`, a `TRAJECTORY` and a `DIAGNOSTICS` message for the rope of an estimate, and a `CLOUD`.

    The cloud is of the waypoints, with what the tracker tells of each as a field of its own: it begins with the first
    estimate of which the tracker tells something. Each further rope has topics of its own. A lost frame is a path
    without poses, which clears the curve in a viewer, and a motion that is not known is a trajectory without points.
    The messages are logged at the frame's stamp, among the images that they come from; the stamp in the path's, the
    motion's and the cloud's header is the time for which they hold.

    Parameters
    ----------
    frame_name : str
        The frame of the positions: ``camera`` is the camera's optical frame.
    """

    def __init__(self, frame_name: str) -> None:
        self._frame_id = FRAME_ID if frame_name == "camera" else frame_name
        self._with_cloud: set[int] = set()

    def of(self, estimate: Estimate) -> list[RawMessage]:
        """The messages of an estimate.

        Raises
        ------
        FrameError
            If a time does not fit a ROS time: before 1970, after 2038.
        """
        stamp_ns, rope = estimate.stamp_ns, estimate.rope
        held_ns = stamp_ns + estimate.ahead_ns
        for name, time_ns in (("stamp", stamp_ns), ("predicted time", held_ns)):
            if not 0 <= time_ns <= LAST_STAMP:
                raise FrameError(f"the {name} does not fit a ROS time: before 1970, or after 2038")
        frame_id, waypoints = self._frame_id, estimate.waypoints
        status = estimate_status(header(stamp_ns, frame_id), estimate)
        messages = [
            ("centerline", PATH, pack_path(held_ns, frame_id, waypoints)),
            ("motion", TRAJECTORY, pack_trajectory(held_ns, frame_id, waypoints, estimate.motion)),
            ("status", DIAGNOSTICS, typestore().serialize_cdr(status, DIAGNOSTICS)),
        ]
        if estimate.seen is not None or estimate.position_sigma is not None:
            self._with_cloud.add(rope)
        if rope in self._with_cloud:
            cloud = waypoint_cloud(header(held_ns, frame_id), estimate)
            messages.append(("waypoints", CLOUD, typestore().serialize_cdr(cloud, CLOUD)))
        return [RawMessage(topic_of(rope, topic), kind, "cdr", stamp_ns, data) for topic, kind, data in messages]
