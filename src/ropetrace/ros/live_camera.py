"""The frames of a live camera: the newest depth image with its colour and its camera, or the newest cloud."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass

from ropetrace.errors import ConfigError, FrameError
from ropetrace.recordings import ros_messages
from ropetrace.recordings.pairing import BUFFERED_BYTES, ColorReach, missing_color
from ropetrace.recordings.ros_frames import COLOR_TOPIC, DEPTH_TOPIC
from ropetrace.recordings.ros_messages import CAMERA, CLOUD, IMAGE, RawMessage
from ropetrace.ros.graph import RosNode, Subscription, check_topic
from ropetrace.types import BadFrame, CloudFrame, Event, Intrinsics, RgbdFrame

MOST_APART_NS = 20_000_000
"""Between a depth image and its colour, and no more than `ColorReach`, nanoseconds."""

AT_ONCE_NS = 5_000_000
"""Colour as near as this is taken at once; any other only when colour as late as the depth image has come, since a
nearer one may follow. Nanoseconds."""

LONGEST_WAIT = 0.2
"""A depth image whose colour or camera has not come for this long is given up, seconds."""

COLOR_PATIENCE = 2.0
"""Where images may lack their colour, they are taken without when none has come for this long after the first depth
image, seconds."""

_KEPT = 4
"""Messages of each kind that wait to be looked at."""

_BACKLOG = 8
"""Images that wait while they are read in order; where more do, the newest is taken."""

_WAITING = 32
"""Images of each kind that wait for their partners at most; no more than `BUFFERED_BYTES` of them, but one."""


def camera_info_beside(image: str) -> str:
    """The topic of the camera of an image topic: ``/ns/camera_info`` beside ``/ns/image_raw``, as ROS has it."""
    return f"{image.rpartition('/')[0]}/camera_info"


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
    camera: str = camera_info_beside(DEPTH_TOPIC)
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
class _Image:
    """One that waits for its partner; since when, by a clock that nobody sets."""

    stamp_ns: int
    message: RawMessage
    since: float

    @property
    def overdue(self) -> bool:
        """Whether it has waited for as long as it may."""
        return time.monotonic() - self.since >= LONGEST_WAIT


@dataclass(frozen=True, slots=True)
class Seen:
    """A frame, and the frame of reference that its message names."""

    event: Event
    frame_id: str


class LiveCamera:
    """Gives the newest frame there is, and skips older ones; or one after another.

    Parameters
    ----------
    node : RosNode
        Reads the topics.
    topics : CameraTopics
        Which.
    wants_color : bool
        Whether images have their colour.
    may_lack_color : bool
        Whether images go without their colour as long as none at all has come.
    in_order : bool
        Give every frame, as far as its messages came and few wait: for whoever takes them at once.
    """

    def __init__(
        self,
        node: RosNode,
        topics: CameraTopics,
        wants_color: bool,
        may_lack_color: bool = False,
        in_order: bool = False,
    ) -> None:
        self._passed = 0
        self._in_order = in_order
        self._may_lack_color = may_lack_color
        self._first_depth: float | None = None
        self._cloud = None if topics.cloud is None else node.subscription(topics.cloud, CLOUD, _KEPT if in_order else 1)
        self._clouds: deque[RawMessage] = deque()
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
        self._depths: deque[_Image] = deque()
        self._colors: deque[_Image] = deque()
        self._reach = ColorReach(MOST_APART_NS)

    @property
    def name(self) -> str:
        """The topic without which there is no frame."""
        return self._subscriptions[0].topic

    @property
    def skipped(self) -> int:
        """Depth images or clouds that were passed over for newer ones, or made room for them."""
        return self._passed + self._subscriptions[0].displaced

    @property
    def waiting(self) -> int:
        """Depth images that wait for their colour or their camera."""
        return len(self._depths)

    def problem(self) -> str:
        """Which topics have the wrong type, in words; empty if none."""
        return "; ".join(filter(None, (subscription.problem() for subscription in self._subscriptions)))

    def take(self) -> Seen | None:
        """The newest whole frame since the last call, or the next one; a `BadFrame` where one cannot be used."""
        if self._cloud is not None:
            self._clouds.extend(self._cloud.take())
            while len(self._clouds) > _KEPT:
                self._clouds.popleft()
                self._passed += 1
            return _cloud_frame(self._clouds.popleft()) if self._clouds else None
        self._learn_camera()
        fault = self._learn_images(self._depth, self._depths)
        if self._color is not None:
            fault = self._learn_images(self._color, self._colors) or fault
        if fault is not None:
            return fault
        if not self._depths:
            return None
        if self._first_depth is None:
            self._first_depth = self._depths[0].since
        if self._intrinsics is None:
            return self._given_up(self._camera_fault)
        count = len(self._depths)
        places = range(count) if self._in_order and count <= _BACKLOG else range(count - 1, -1, -1)
        if self._color is None:
            return self._leave(places[0], None)
        if self._may_lack_color and not self._colors:
            patient = time.monotonic() - self._first_depth < COLOR_PATIENCE
            return None if patient else self._leave(places[0], None)
        self._may_lack_color = False
        for place in places:
            color = self._color_of(self._depths[place])
            if color is not None:
                return self._leave(place, color)
        gap_ns = min((abs(one.stamp_ns - self._depths[0].stamp_ns) for one in self._colors), default=None)
        return self._given_up(missing_color(gap_ns, self._reach.reach_ns))

    def _learn_camera(self) -> None:
        message = self._camera.newest()
        if message is None:
            return
        try:
            self._intrinsics = ros_messages.camera(message)
        except FrameError as error:
            self._intrinsics, self._camera_fault = None, f"{message.topic}: {error}"

    def _learn_images(self, read: Subscription, kept: deque[_Image]) -> Seen | None:
        """Take the images that have come; the last that says nothing of when it was taken."""
        fault = None
        for message in read.take():
            try:
                stamp_ns = ros_messages.stamp_and_frame(message)[0]
            except FrameError as error:
                fault = Seen(BadFrame(message.log_time_ns, str(error)), "")
                continue
            kept.append(_Image(stamp_ns, message, time.monotonic()))
            if kept is self._colors:
                self._reach.learn(stamp_ns)
        dropped = _cut(kept)
        if kept is self._depths:
            self._passed += dropped
        return fault

    def _color_of(self, depth: _Image) -> RawMessage | None:
        """The nearest colour image, if it is near enough and no nearer one is to be expected."""
        color = min(self._colors, key=lambda one: abs(one.stamp_ns - depth.stamp_ns), default=None)
        gap_ns = None if color is None else abs(color.stamp_ns - depth.stamp_ns)
        if color is None or gap_ns is None or gap_ns > self._reach.reach_ns:
            return None
        expected = gap_ns > AT_ONCE_NS and all(one.stamp_ns < depth.stamp_ns for one in self._colors)
        return None if expected and not depth.overdue else color.message

    def _leave(self, place: int, color: RawMessage | None) -> Seen:
        """The depth image at a place in the queue; those before it are skipped."""
        self._passed += place
        for _ in range(place):
            self._depths.popleft()
        taken = self._depths.popleft()
        stamp_ns, depth = taken.stamp_ns, taken.message
        while self._colors and self._colors[0].stamp_ns <= stamp_ns:
            self._colors.popleft()
        frame_id = ros_messages.stamp_and_frame(depth)[1]
        assert self._intrinsics is not None
        try:
            image, unit = ros_messages.depth_image(depth)
            pixels = None if color is None else ros_messages.color_image(color)
            return Seen(RgbdFrame(stamp_ns, image, unit, self._intrinsics, pixels), frame_id)
        except FrameError as error:
            return Seen(BadFrame(stamp_ns, f"{depth.topic}: {error}"), frame_id)

    def _given_up(self, reason: str) -> Seen | None:
        """The oldest depth image, if it has waited for its partners for too long."""
        oldest = self._depths[0]
        if len(self._depths) < _WAITING and not oldest.overdue:
            return None
        self._depths.popleft()
        told = f"{oldest.message.topic}: " + "; ".join(filter(None, (reason, self.problem())))
        return Seen(BadFrame(oldest.stamp_ns, told), ros_messages.stamp_and_frame(oldest.message)[1])


def _cut(waiting: deque[_Image]) -> int:
    """Drop the oldest of too many; how many."""
    dropped = 0
    size = sum(len(one.message.data) for one in waiting)
    while len(waiting) > _WAITING or (len(waiting) > 1 and size > BUFFERED_BYTES):
        size -= len(waiting.popleft().message.data)
        dropped += 1
    return dropped


def _cloud_frame(message: RawMessage) -> Seen:
    try:
        stamp_ns, frame_id = ros_messages.stamp_and_frame(message)
    except FrameError as error:
        return Seen(BadFrame(message.log_time_ns, str(error)), "")
    try:
        return Seen(CloudFrame(stamp_ns, *ros_messages.cloud(message)), frame_id)
    except FrameError as error:
        return Seen(BadFrame(stamp_ns, f"{message.topic}: {error}"), frame_id)
