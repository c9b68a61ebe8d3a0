"""Topics and nodes of ROS 2 as rmw_zenoh has them: key expressions, attachments, and tokens that make them known.

A message goes to ``<domain>/<topic>/<type as DDS names it>/<hash of the type>``, in CDR, with an attachment that
numbers it. Who publishes or reads declares a token under ``@ros2_lv``; ``ros2 topic list`` is made of these.
"""

from __future__ import annotations

import re
import struct
import threading
import time
from functools import cache
from typing import Any, Literal

from ropetrace.errors import import_extra
from ropetrace.results.ros_estimates import typestore
from ropetrace.ros.graph import Subscription, check_topic
from ropetrace.ros.zenoh_session import Connection, open_session

ADMIN_SPACE = "@ros2_lv"
NO_HASH = "TypeHashNotSupported"
"""What Humble has in the place of a type's hash."""

_LISTING_SECONDS = 0.5
"""How long `ZenohNode.topics` waits for answers."""


def dds_type(name: str) -> str:
    """``std_msgs/msg/String`` as DDS names it: ``std_msgs::msg::dds_::String_``."""
    package, kind, message = name.split("/")
    return f"{package}::{kind}::dds_::{message}_"


def ros_type(name: str) -> str:
    """The inverse of `dds_type`; a name of another form stays as it is."""
    match = re.fullmatch(r"(\w+)::(\w+)::dds_::(\w+)_", name)
    return name if match is None else "/".join(match.groups())


@cache
def type_hash(name: str, humble: bool) -> str:
    """The RIHS01 hash of a type's definition (REP 2016), or what Humble has in its place."""
    return NO_HASH if humble else str(typestore().hash_rihs01(name))


def topic_key(domain: int, topic: str, type_name: str, humble: bool = False) -> str:
    """The key expression of a topic's messages."""
    return f"{domain}/{topic.strip('/')}/{dds_type(type_name)}/{type_hash(type_name, humble)}"


def node_token(domain: int, session: str, node: str) -> str:
    """The token of a node, the only one of its session: its number is 0."""
    return f"{ADMIN_SPACE}/{domain}/{session}/0/0/NN/%/%/{node}"


def topic_token(
    domain: int,
    session: str,
    entity: int,
    kind: Literal["MP", "MS"],
    node: str,
    topic: str,
    type_name: str,
    depth: int,
    humble: bool = False,
) -> str:
    """The token of a publisher (MP) or a subscription (MS) that is best effort and keeps the last `depth` messages.

    The policies are the numbers of rmw/types.h, and are left out where they are rmw_zenoh's defaults: reliable,
    volatile, the last 42.
    """
    kept = "" if depth == 42 else str(depth)
    return (
        f"{ADMIN_SPACE}/{domain}/{session}/0/{entity}/{kind}/%/%/{node}/{topic.replace('/', '%')}/"
        f"{dds_type(type_name)}/{type_hash(type_name, humble)}/2::,{kept}:,:,:,,"
    )


def attachment(sequence: int, source_ns: int, gid: bytes) -> bytes:
    """What rmw_zenoh attaches to a message, since its version 0.2.4 of Jazzy.

    Parameters
    ----------
    sequence : int
        Of the message among those of its publisher, from 1.
    source_ns : int
        When it was published, nanoseconds since 1970.
    gid : bytes
        The publisher's, 16 bytes.
    """
    return struct.pack("<qqB16s", sequence, source_ns, 16, gid)


def publisher_id(token: str) -> bytes:
    """The GID of a publisher, 16 bytes: XXH3-128 of its token, the lower half first, as rmw_zenoh has it.

    Raises
    ------
    MissingExtraError
        If xxhash is not installed.
    """
    return import_extra("xxhash", "ros2").xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


class ZenohPublisher:
    """A `graph.Publisher`; made by `ZenohNode.publisher`."""

    def __init__(self, publisher: Any, name: str, type_name: str) -> None:
        self._publisher = publisher
        self._type = type_name
        self._gid = publisher_id(name)
        self._sequence = 0

    def put(self, message: Any) -> None:
        """Send a message; whoever does not keep up loses it."""
        self.put_packed(bytes(typestore().serialize_cdr(message, self._type)))

    def put_packed(self, data: bytes) -> None:
        """Send a message that is CDR already."""
        self._sequence += 1
        self._publisher.put(data, attachment=attachment(self._sequence, time.time_ns(), self._gid))


class ZenohNode:
    """A node of a ROS 2 graph over Zenoh: a `graph.RosNode`.

    Parameters
    ----------
    name : str
        Of the node.
    connection : Connection
        How the graph is reached.

    Raises
    ------
    RosError
        If the graph cannot be reached so.
    MissingExtraError
        If Zenoh is not installed.
    """

    def __init__(self, name: str, connection: Connection | None = None) -> None:
        self.name = name
        self.connection = connection or Connection()
        self._zenoh = import_extra("zenoh", "ros2")
        self._session = open_session(self.connection)
        self._session_id = str(self._session.zid())
        self._arrived = threading.Event()
        self._entities = 0
        self._held: list[Any] = []
        token = node_token(self.connection.domain, self._session_id, name)
        self._held.append(self._session.liveliness().declare_token(token))

    def __enter__(self) -> ZenohNode:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the graph."""
        self._session.close()

    def publisher(self, topic: str, type_name: str, depth: int = 5) -> ZenohPublisher:
        """Publish messages of a type.

        Raises
        ------
        ConfigError
            If the topic's name is impossible.
        """
        domain, humble = self.connection.domain, self.connection.humble
        zenoh = self._zenoh
        declared = self._session.declare_publisher(
            topic_key(domain, check_topic(topic), type_name, humble),
            congestion_control=zenoh.CongestionControl.DROP,
            reliability=zenoh.Reliability.BEST_EFFORT,
            express=True,
        )
        name = self._token("MP", topic, type_name, depth)
        self._held += [declared, self._session.liveliness().declare_token(name)]
        return ZenohPublisher(declared, name, type_name)

    def subscription(self, topic: str, type_name: str, depth: int = 1) -> Subscription:
        """Read a topic: the last `depth` messages are kept.

        Raises
        ------
        ConfigError
            If the topic's name is impossible.
        """
        domain, humble = self.connection.domain, self.connection.humble
        read = Subscription(check_topic(topic), type_name, depth, self._arrived)
        publishers = f"{ADMIN_SPACE}/{domain}/*/*/*/MP/*/*/*/{topic.replace('/', '%')}/*/*/*"
        liveliness = self._session.liveliness()
        self._held += [
            self._session.declare_subscriber(
                topic_key(domain, topic, type_name, humble),
                lambda sample: read.receive(sample.payload.to_bytes(), "cdr"),
            ),
            liveliness.declare_token(self._token("MS", topic, type_name, depth)),
            liveliness.declare_subscriber(publishers, lambda sample: _meet(read, sample, humble), history=True),
        ]
        return read

    def topics(self) -> dict[str, str]:
        """What is published, and its type, as far as it is known half a second after the question."""
        found: dict[str, str] = {}

        def meet(sample: Any) -> None:
            parts = str(sample.key_expr).split("/")
            found[parts[9].replace("%", "/")] = ros_type(parts[10])

        # A one-shot query of a peer now and then ends before anybody has answered; a subscriber does not.
        publishers = f"{ADMIN_SPACE}/{self.connection.domain}/*/*/*/MP/*/*/*/*/*/*/*"
        with self._session.liveliness().declare_subscriber(publishers, meet, history=True):
            time.sleep(_LISTING_SECONDS)
        return found

    def wait(self, seconds: float) -> None:
        """Wait until a message of any subscription has come since the last call, or for this long."""
        self._arrived.wait(seconds)
        self._arrived.clear()

    def _token(self, kind: Literal["MP", "MS"], topic: str, type_name: str, depth: int) -> str:
        self._entities += 1
        connection = self.connection
        return topic_token(
            connection.domain,
            self._session_id,
            self._entities,
            kind,
            self.name,
            topic,
            type_name,
            depth,
            connection.humble,
        )


def _meet(read: Subscription, sample: Any, humble: bool) -> None:
    """A publisher of this topic came or went."""
    token = str(sample.key_expr)
    parts = token.split("/")
    node, found, found_hash = parts[8], ros_type(parts[10]), parts[11]
    if str(sample.kind).endswith("DELETE"):
        read.others.pop(token, None)
    elif found != read.type:
        read.others[token] = f"{read.topic} of node {node} is {found}, expected {read.type}: not read"
    elif found_hash != type_hash(read.type, humble):
        hint = "; Humble needs --humble" if found_hash == NO_HASH else ""
        read.others[token] = (
            f"{read.topic} of node {node} has another definition of {found} ({found_hash[:15]}...): not read{hint}"
        )
