"""What a node needs of a ROS graph, whichever way it is spoken to."""

from __future__ import annotations

import re
import threading
import time
from collections import deque
from types import TracebackType
from typing import Any, Protocol, Self

from ropetrace.errors import ConfigError
from ropetrace.recordings.ros_messages import MAX_MESSAGE_BYTES, RawMessage

MAX_FUTURE = 0.02
"""A stamp further ahead of this machine's clock than this is told, seconds."""

LONGEST_BRAKING = 2.0
"""For which a node that is told to end goes on until what it moves is at rest, seconds."""

_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


def check_topic(name: str) -> str:
    """The name of a topic, if it can be one.

    Raises
    ------
    ConfigError
        If it is not a full name such as /camera/depth/image_raw.
    """
    if not _TOPIC.fullmatch(name):
        raise ConfigError(f"{name!r} is no full name of a topic: expected one such as /camera/depth/image_raw")
    return name


class Publisher(Protocol):
    """Sends messages of one type; never waits for who reads them."""

    def put(self, message: Any) -> None:
        """Send a message of `results.ros_estimates.typestore`; whoever does not keep up loses it."""

    def put_packed(self, data: bytes) -> None:
        """Send a message that is CDR already."""


class Subscription:
    """The last messages of a topic. Made by `RosNode.subscription`.

    Parameters
    ----------
    topic, type_name : str
        What is read.
    depth : int
        Messages that are kept.
    arrived : Event
        Is set by each message.

    Attributes
    ----------
    topic, type : str
        What is read.
    others : dict of str to str
        Who publishes something else under this name, in words, each by a key of the graph's own.
    displaced : int
        Messages that made room for newer ones before they were taken.
    """

    def __init__(self, topic: str, type_name: str, depth: int, arrived: threading.Event) -> None:
        self.topic = topic
        self.type = type_name
        self.others: dict[str, str] = {}
        self.displaced = 0
        self._lock = threading.Lock()
        self._messages: deque[RawMessage] = deque(maxlen=depth)
        self._arrived = arrived

    def take(self) -> list[RawMessage]:
        """The messages since the last call, oldest first; ``log_time_ns`` is when each came."""
        with self._lock:
            taken = list(self._messages)
            self._messages.clear()
        return taken

    def newest(self) -> RawMessage | None:
        """The last message since the last call."""
        taken = self.take()
        return taken[-1] if taken else None

    def problem(self) -> str:
        """Who publishes something else under this name, in words; empty if nobody does."""
        return "; ".join(list(self.others.values()))

    def receive(self, data: bytes, encoding: str) -> None:
        """Keep a message that came; called by threads of the graph."""
        if len(data) <= MAX_MESSAGE_BYTES:
            with self._lock:
                self.displaced += len(self._messages) == self._messages.maxlen
                self._messages.append(RawMessage(self.topic, self.type, encoding, time.time_ns(), data))
            self._arrived.set()


class RosNode(Protocol):
    """A node of a ROS graph; a context manager, which leaves the graph at its end.

    Attributes
    ----------
    name : str
        Of the node.
    """

    @property
    def name(self) -> str: ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def close(self) -> None:
        """Leave the graph."""

    def publisher(self, topic: str, type_name: str, depth: int = 5) -> Publisher:
        """Publish messages of a type, named as ROS 2 names it.

        Raises
        ------
        ConfigError
            If the topic's name is impossible.
        """
        ...

    def subscription(self, topic: str, type_name: str, depth: int = 1) -> Subscription:
        """Read a topic: the last `depth` messages are kept.

        Raises
        ------
        ConfigError
            If the topic's name is impossible.
        """
        ...

    def wait(self, seconds: float) -> None:
        """Wait until a message of any subscription has come since the last call, or for this long."""
