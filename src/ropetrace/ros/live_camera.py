"""The frames of a live camera: the newest depth image with its colour and its camera, or the newest cloud."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass

from ropetrace.errors import ConfigError, FrameError
from ropetrace.recordings import ros_messages
from ropetrace.recordings.pairing import missing_color
from ropetrace.recordings.ros_frames import COLOR_TOPIC, DEPTH_TOPIC
from ropetrace.recordings.ros_messages import CAMERA, CLOUD, IMAGE, RawMessage
from ropetrace.ros.graph import RosNode, Subscription, check_topic
from ropetrace.types import BadFrame, CloudFrame, Event, Intrinsics, RgbdFrame

MOST_APART_NS = 20_000_000
"""Between a depth image and its colour, nanoseconds."""

LONGEST_WAIT_NS = 200_000_000
"""A depth image whose colour has not come for this long is given up, nanoseconds."""

_KEPT = 4
"""Images of each kind that wait for their partners."""


@dataclass(frozen=True, slots=True)
class CameraTopics:
    """Where the camera publishes; the defaults are those of a RealSense.

    Raises
    ------
    ConfigError
        If a name is no full name of a topic.
    """

    depth: str = DEPTH_TOPIC
    """sensor_msgs/Image, seen from the colour camera."""
    color: str = COLOR_TOPIC
    """sensor_msgs/Image; not read where the rope is not known by its colour."""
    camera: str = "/camera/aligned_depth_to_color/camera_info"
    """sensor_msgs/CameraInfo of the depth images."""
    cloud: str | None = None
    """sensor_msgs/PointCloud2, in the place of the images."""

    def __post_init__(self) -> None:
        names = [self.cloud] if self.cloud is not None else [self.depth, self.color, self.camera]
        for name in names:
            check_topic(name)
        if len(set(names)) < len(names):
            raise ConfigError(f"topics: {', '.join(names)}: each has a topic of its own")


@dataclass(frozen=True, slots=True)
class Seen:
    """A frame, and the frame of reference that its message names."""

    event: Event
    frame_id: str


class LiveCamera:
    """Gives the newest frame there is; older ones are skipped.

    Parameters
    ----------
    node : RosNode
        Reads the topics.
    topics : CameraTopics
        Which.
    wants_color : bool
        Whether images need their colour.

    Attributes
    ----------
    skipped : int
        Images that were passed over for newer ones, of those that were looked at.
    """

    def __init__(self, node: RosNode, topics: CameraTopics, wants_color: bool) -> None:
        self.skipped = 0
        self._cloud = None if topics.cloud is None else node.subscription(topics.cloud, CLOUD)
        self._color: Subscription | None = None
        self._subscriptions = [self._cloud] if self._cloud is not None else []
        if self._cloud is None:
            self._depth = node.subscription(topics.depth, IMAGE, _KEPT)
            self._camera = node.subscription(topics.camera, CAMERA)
            self._subscriptions += [self._depth, self._camera]
            if wants_color:
                self._color = node.subscription(topics.color, IMAGE, _KEPT)
                self._subscriptions.append(self._color)
        self._intrinsics: Intrinsics | None = None
        self._camera_fault = f"no camera_info yet on {topics.camera}"
        self._depths: deque[tuple[int, RawMessage]] = deque(maxlen=_KEPT)
        self._colors: deque[tuple[int, RawMessage]] = deque(maxlen=_KEPT)

    @property
    def name(self) -> str:
        """The topic without which there is no frame."""
        return self._subscriptions[0].topic

    def problem(self) -> str:
        """Which topics have the wrong type, in words; empty if none."""
        return "; ".join(filter(None, (subscription.problem() for subscription in self._subscriptions)))

    def newest(self) -> Seen | None:
        """The newest whole frame since the last call; a `BadFrame` where one cannot be used."""
        if self._cloud is not None:
            message = self._cloud.newest()
            return None if message is None else _cloud_frame(message)
        self._learn_camera()
        for read, kept in ((self._depth, self._depths), (self._color, self._colors)):
            for message in [] if read is None else read.take():
                try:
                    kept.append((ros_messages.stamp_and_frame(message)[0], message))
                except FrameError as error:
                    return Seen(BadFrame(message.log_time_ns, str(error)), "")
        if self._color is None:
            return self._leave(len(self._depths) - 1, None) if self._depths else None
        for place in reversed(range(len(self._depths))):
            color = self._color_of(self._depths[place][0])
            if color is not None and abs(color[0] - self._depths[place][0]) <= MOST_APART_NS:
                return self._leave(place, color[1])
        return self._given_up()

    def _learn_camera(self) -> None:
        message = self._camera.newest()
        if message is None:
            return
        try:
            self._intrinsics = ros_messages.camera(message)
        except FrameError as error:
            self._intrinsics, self._camera_fault = None, f"{message.topic}: {error}"

    def _color_of(self, stamp_ns: int) -> tuple[int, RawMessage] | None:
        return min(self._colors, key=lambda color: abs(color[0] - stamp_ns), default=None)

    def _leave(self, place: int, color: RawMessage | None) -> Seen:
        """The depth image at a place in the queue; those before it are skipped."""
        self.skipped += place
        for _ in range(place):
            self._depths.popleft()
        stamp_ns, depth = self._depths.popleft()
        frame_id = ros_messages.stamp_and_frame(depth)[1]
        try:
            if self._intrinsics is None:
                raise FrameError(self._camera_fault)
            image, unit = ros_messages.depth_image(depth)
            pixels = None if color is None else ros_messages.color_image(color)
            return Seen(RgbdFrame(stamp_ns, image, unit, self._intrinsics, pixels), frame_id)
        except FrameError as error:
            return Seen(BadFrame(stamp_ns, f"{depth.topic}: {error}"), frame_id)

    def _given_up(self) -> Seen | None:
        """A depth image that has waited for its colour for too long."""
        if not self._depths or time.time_ns() - self._depths[0][1].log_time_ns < LONGEST_WAIT_NS:
            return None
        stamp_ns, depth = self._depths.popleft()
        color = self._color_of(stamp_ns)
        reason = missing_color(None if color is None else abs(color[0] - stamp_ns), MOST_APART_NS)
        return Seen(BadFrame(stamp_ns, f"{depth.topic}: {reason}"), ros_messages.stamp_and_frame(depth)[1])


def _cloud_frame(message: RawMessage) -> Seen:
    try:
        stamp_ns, frame_id = ros_messages.stamp_and_frame(message)
    except FrameError as error:
        return Seen(BadFrame(message.log_time_ns, str(error)), "")
    try:
        return Seen(CloudFrame(stamp_ns, *ros_messages.cloud(message)), frame_id)
    except FrameError as error:
        return Seen(BadFrame(stamp_ns, f"{message.topic}: {error}"), frame_id)
