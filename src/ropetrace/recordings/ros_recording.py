"""A recording of ROS messages as frames, whatever kind of file holds them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from ropetrace.errors import FrameError, RecordingError
from ropetrace.recordings import ros_messages
from ropetrace.recordings.base import DEFAULT_PAIR_GAP, RecordingInfo, StampStatistics, note, printable
from ropetrace.recordings.pairing import Pairing
from ropetrace.recordings.ros_messages import CAMERA, CLOUD, COMPRESSED, IMAGE, MessageSource, RawMessage
from ropetrace.recordings.ros_topics import Choice, choose_topics, listed
from ropetrace.types import BadFrame, CloudFrame, Event, Intrinsics, RgbdFrame

Waiting = tuple[RawMessage, str | None]
"""A depth image, and what is wrong with its camera."""


class RosRecording:
    """See `ropetrace.recordings.base.Recording`.

    Parameters
    ----------
    source : MessageSource
        The file.
    depth_topic, color_topic, cloud_topic : str, optional
        Topics to use in place of those found. An empty `color_topic` leaves colour out.
    max_pair_gap : float
        Colour farther than this from a depth image is not paired with it, seconds.

    Raises
    ------
    RecordingError
        If the topics cannot be found, or the camera is missing or impossible.
    """

    def __init__(
        self,
        source: MessageSource,
        depth_topic: str | None = None,
        color_topic: str | None = None,
        cloud_topic: str | None = None,
        max_pair_gap: float = DEFAULT_PAIR_GAP,
    ) -> None:
        self.path: Path = source.path
        self.kind: str = source.kind
        self._source = source
        self._max_gap_ns = round(max_pair_gap * 1e9)
        self._topics = source.topics()
        if not self._topics:
            damage = "; ".join(source.problems[:2])
            raise RecordingError(f"{self.path}: a {self.kind} without any readable message{damage and ': ' + damage}")
        self._first = self._first_messages()
        self._choice = choose_topics(
            str(self.path),
            topics=self._topics,
            first=self._first,
            depth=depth_topic,
            color=color_topic,
            cloud=cloud_topic,
        )
        self.intrinsics: Intrinsics | None = None if self._choice.cloud else self._camera(self._choice)
        for topic, row in self._topics.items():
            if row.type in (IMAGE, COMPRESSED) and row.count and topic not in self._first:
                note(self.problems, f"none of the {row.count} images of {topic} can be read")
        self._note_frames_of_reference()

    @property
    def problems(self) -> list[str]:
        """The damage found so far."""
        return self._source.problems

    @property
    def frame_count(self) -> int | None:
        """Messages of the depth or cloud topic, as the file itself counts them."""
        return self._topics[self._choice.cloud or self._choice.depth or ""].count

    def _first_messages(self) -> dict[str, RawMessage]:
        """The first message of every topic of images and cameras."""
        missing = {
            name for name, row in self._topics.items() if row.type in (IMAGE, COMPRESSED, CAMERA) and row.count != 0
        }
        found: dict[str, RawMessage] = {}
        for message in self._source.messages(missing.copy()) if missing else ():
            if message.topic in missing:
                missing.remove(message.topic)
                # A copy of its own: the chunk that it lies in need not stay in memory.
                found[message.topic] = RawMessage(
                    message.topic, message.type, message.encoding, message.log_time_ns, bytes(message.data)
                )
            if not missing:
                break
        return found

    def _camera(self, choice: Choice) -> Intrinsics:
        assert choice.camera is not None
        assert choice.depth is not None
        if choice.depth not in self._first or choice.camera not in self._first:
            missing = choice.depth if choice.depth not in self._first else choice.camera
            raise RecordingError(f"{self.path}: no message of {missing} can be read; it holds {listed(self._topics)}")
        try:
            intrinsics = ros_messages.camera(self._first[choice.camera])
        except FrameError as error:
            raise RecordingError(f"{self.path}: {choice.camera}: {error}") from None
        try:
            width, height, _ = ros_messages.image_size(self._first[choice.depth])
        except FrameError:
            return intrinsics  # the first image is damaged: it will be a bad frame
        if (width, height) != (intrinsics.width, intrinsics.height):
            raise RecordingError(
                f"{self.path}: {choice.camera} is for {intrinsics.width}x{intrinsics.height}, the images of "
                f"{choice.depth} are {width}x{height}: record the camera_info of this very topic"
            )
        return intrinsics

    def _note_frames_of_reference(self) -> None:
        """Colour that is not seen from where depth is seen from would give points the wrong colour."""
        depth, color = self._first.get(self._choice.depth or ""), self._first.get(self._choice.color or "")
        if depth is None or color is None:
            return
        try:
            frames = ros_messages.stamp_and_frame(depth)[1], ros_messages.stamp_and_frame(color)[1]
        except FrameError:
            return
        if all(frames) and frames[0] != frames[1]:
            note(
                self.problems,
                f"depth is in the frame {frames[0]!r} and colour in {frames[1]!r}: colour is not registered "
                "to depth, points may get a neighbour's colour; record aligned depth",
            )

    def frames(self, start: int = 0, limit: int | None = None) -> Iterator[Event]:
        """See `Recording.frames`."""
        stop = None if limit is None else start + limit
        if self._choice.cloud:
            clouds = self._source.messages({self._choice.cloud})
            for message in islice(clouds, start, stop):
                yield self._cloud_frame(message)
            return
        for stamp, waiting, color in islice(self._pairs(), start, stop):
            yield self._rgbd_frame(stamp, *waiting, color)

    def _pairs(self) -> Iterator[tuple[int, Waiting, RawMessage | str | None]]:
        """Stamps, depth images, and their colour or why it is missing; None in a recording without colour."""
        choice, pairing = self._choice, Pairing[Waiting, RawMessage](self._max_gap_ns)
        changed: str | None = None
        wanted = {topic for topic in (choice.depth, choice.color, choice.camera) if topic}
        for message in self._source.messages(wanted):
            if message.topic == choice.camera:
                changed = self._camera_change(message)
                continue
            try:
                stamp = ros_messages.stamp_and_frame(message)[0]
            except FrameError:
                stamp = message.log_time_ns  # decoding it will say what is wrong
            if message.topic == choice.depth and not choice.color:
                yield stamp, (message, changed), None
            elif message.topic == choice.depth:
                yield from pairing.add_depth(stamp, (message, changed), len(message.data))
            else:
                yield from pairing.add_color(stamp, message, len(message.data))
        yield from pairing.finish()

    def _camera_change(self, message: RawMessage) -> str | None:
        """What is wrong with frames after a CameraInfo that is not the one of the recording."""
        try:
            camera = ros_messages.camera(message)
        except FrameError as error:
            return f"its camera_info is unusable: {error}"
        return None if camera == self.intrinsics else f"camera_info changed to {camera} within the recording"

    def _rgbd_frame(self, stamp: int, depth: RawMessage, changed: str | None, color: RawMessage | str | None) -> Event:
        assert self.intrinsics is not None
        try:
            if changed:
                raise FrameError(changed)
            if isinstance(color, str):
                raise FrameError(color)
            image, unit = ros_messages.depth_image(depth)
            pixels = None if color is None else ros_messages.color_image(color)
            return RgbdFrame(stamp, image, unit, self.intrinsics, pixels)
        except FrameError as error:
            return BadFrame(stamp, f"{depth.topic}: {error}")

    def _cloud_frame(self, message: RawMessage) -> Event:
        stamp = message.log_time_ns
        try:
            stamp = ros_messages.stamp_and_frame(message)[0]
            return CloudFrame(stamp, *ros_messages.cloud(message))
        except FrameError as error:
            return BadFrame(stamp, f"{message.topic}: {error}")

    def info(self) -> RecordingInfo:
        """See `Recording.info`."""
        statistics: dict[str, StampStatistics] = {}
        for message in self._source.messages():
            try:
                has_header = message.type in (IMAGE, COMPRESSED, CAMERA, CLOUD)
                stamp = ros_messages.stamp_and_frame(message)[0] if has_header else message.log_time_ns
            except FrameError:
                stamp = message.log_time_ns
            statistics.setdefault(message.topic, StampStatistics()).add(stamp)
        choice = self._choice
        used = [topic for topic in (choice.depth, choice.color, choice.camera, choice.cloud) if topic]
        rows = []
        for topic in [*used, *sorted(self._topics.keys() - set(used))]:
            width, height, encoding = None, None, self._topics[topic].type
            if topic in self._first and self._topics[topic].type != CAMERA:
                try:
                    width, height, pixels = ros_messages.image_size(self._first[topic])
                    encoding = f"{encoding} {printable(pixels)}"
                except FrameError as error:
                    encoding = f"{encoding} (unreadable: {error})"
            rows.append(statistics.get(topic, StampStatistics()).stream(topic, encoding, width, height))
        main = statistics.get(used[0])
        return RecordingInfo(
            self.path,
            self.kind,
            tuple(rows),
            main.duration if main else None,
            self.intrinsics,
            self._source.checksums,
            tuple(self.problems),
        )
