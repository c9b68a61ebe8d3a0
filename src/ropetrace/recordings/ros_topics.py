"""Which topics of a ROS recording are depth, colour, camera and cloud."""

from __future__ import annotations

import os
from dataclasses import dataclass

from ropetrace.errors import FrameError, RecordingError
from ropetrace.recordings.ros_messages import (
    CAMERA,
    CLOUD,
    COLOR_ENCODINGS,
    COMPRESSED,
    DEPTH_ENCODINGS,
    IMAGE,
    RawMessage,
    Topic,
    image_size,
)


@dataclass(frozen=True, slots=True)
class Choice:
    """The topics to read: `depth` and `camera`, and `color` if there is any; or `cloud`."""

    depth: str | None = None
    color: str | None = None
    camera: str | None = None
    cloud: str | None = None


def choose_topics(
    where: str,
    *,
    topics: dict[str, Topic],
    first: dict[str, RawMessage],
    depth: str | None,
    color: str | None,
    cloud: str | None,
) -> Choice:
    """The topics that were asked for, and the best of the others.

    Parameters
    ----------
    where : str
        The recording, for messages.
    topics : dict
        All topics by name.
    first : dict
        The first message of each topic of images, and of others as it happens.
    depth, color, cloud : str, optional
        Topics that were asked for. An empty `color` leaves colour out.

    Raises
    ------
    RecordingError
        If a topic is unknown or of the wrong type, nothing fits, or several fit equally well.
    """
    for topic, kinds in ((depth, (IMAGE, COMPRESSED)), (color, (IMAGE, COMPRESSED)), (cloud, (CLOUD,))):
        if topic and topic not in topics:
            raise RecordingError(f"{where}: there is no topic {topic!r}; it holds {listed(topics)}")
        if topic and topics[topic].type not in kinds:
            raise RecordingError(f"{where}: the topic {topic!r} is {topics[topic].type}, expected {' or '.join(kinds)}")
    if cloud and (depth or color):
        raise RecordingError(f"{where}: give a cloud topic, or depth and colour topics, but not both")
    if cloud:
        return Choice(cloud=cloud)
    encodings = {topic: _encoding(message) for topic, message in first.items() if message.type in (IMAGE, COMPRESSED)}
    if not depth:
        found = [topic for topic in encodings if _is_depth(topic, topics[topic].type, encodings[topic])]
        clouds = [topic for topic, row in topics.items() if row.type == CLOUD and row.count != 0]
        if not found and clouds:
            return Choice(cloud=_best(where, "cloud", dict.fromkeys(clouds, (0,))))
        if not found:
            raise RecordingError(
                f"{where}: no depth images (16UC1 or 32FC1) and no PointCloud2; it holds {listed(topics)}"
            )
        depth = _best(where, "depth", {topic: _depth_score(topic, topics[topic].type) for topic in found})
    if color is None:
        scores = {
            topic: _color_score(topic, topics[topic].type, depth)
            for topic in encodings
            if topic != depth and _is_color(topic, topics[topic].type, encodings[topic])
        }
        color = _best(where, "color", scores) if scores else None
    return Choice(depth=depth, color=color or None, camera=_camera_of(where, topics, depth, color))


def listed(topics: dict[str, Topic], most: int = 24) -> str:
    """The topics with their types, for messages."""
    rows = [f"{name} ({row.type or 'no type'})" for name, row in sorted(topics.items())]
    more = f" and {len(rows) - most} more" if len(rows) > most else ""
    return (", ".join(rows[:most]) + more) if rows else "no topics"


def _encoding(message: RawMessage) -> str:
    try:
        return image_size(message)[2]
    except FrameError:
        return ""


def _is_depth(topic: str, kind: str, encoding: str) -> bool:
    named = _names_depth(topic)
    if kind == COMPRESSED:
        return "compressedDepth" in encoding or (named and "jpeg" not in encoding)
    return encoding in ("16UC1", "32FC1") or (named and (encoding in DEPTH_ENCODINGS or encoding == ""))


def _names_depth(topic: str) -> bool:
    """Whether a topic is called depth; colour that is seen from the depth camera is not."""
    return "depth" in topic.lower().replace("color_to_depth", "").replace("rgb_to_depth", "")


def _is_color(topic: str, kind: str, encoding: str) -> bool:
    if kind == COMPRESSED:
        # JPEG of depth exists, and is neither depth nor colour.
        return not _names_depth(topic) and not encoding.startswith(("mono", "8UC1", "16UC1", "32FC1"))
    return encoding in COLOR_ENCODINGS


def _depth_score(topic: str, kind: str) -> tuple[int, ...]:
    """Depth in the view of the colour camera first, then what is called depth, then the uncompressed."""
    name = topic.lower()
    registered = any(word in name for word in ("aligned", "registered", "to_color", "to_rgb"))
    return ("aligned_depth_to_color" in name, registered, _names_depth(topic), kind == IMAGE)


def _color_score(topic: str, kind: str, depth: str) -> tuple[int, ...]:
    """Colour of the depth's own camera first, then what is called colour, then what is not compressed."""
    name = topic.lower()
    to_depth = "color_to_depth" in name or "rgb_to_depth" in name
    registered = to_depth != _depth_score(depth, "")[1]
    return (registered, _shared_folders(topic, depth), "color" in name or "rgb" in name, kind == IMAGE)


def _shared_folders(first: str, second: str) -> int:
    """How many leading names two topics share."""
    pairs = zip(first.strip("/").split("/"), second.strip("/").split("/"), strict=False)
    equal = [a == b for a, b in pairs]
    return equal.index(False) if False in equal else len(equal)


def _best(where: str, role: str, scores: dict[str, tuple[int, ...]]) -> str:
    top = max(scores.values())
    best = sorted(topic for topic, score in scores.items() if score == top)
    if len(best) > 1:
        raise RecordingError(
            f"{where}: several topics may be the {role}: {', '.join(best[:8])}; name one with --{role}-topic"
        )
    return best[0]


def _camera_of(where: str, topics: dict[str, Topic], depth: str, color: str | None) -> str:
    """The topic of the camera's intrinsics: beside the depth images, or the nearest by name."""
    cameras = [topic for topic, row in topics.items() if row.type == CAMERA and row.count != 0]
    if not cameras:
        raise RecordingError(
            f"{where}: no CameraInfo, and depth is useless without its camera: record the camera_info "
            f"topic of {depth} too; it holds {listed(topics)}"
        )
    # Compressed images are one name below the raw ones.
    for parent in (os.path.dirname(depth), os.path.dirname(os.path.dirname(depth))):
        if f"{parent}/camera_info" in cameras:
            return f"{parent}/camera_info"
    if color and _depth_score(depth, "")[1]:
        # Registered depth has the camera of the colour images.
        beside = f"{os.path.dirname(color)}/camera_info"
        if beside in cameras:
            return beside
    return _best(where, "camera", {camera: (_shared_folders(camera, depth),) for camera in cameras})
