"""Topics and nodes of ROS 1, by rospy: the messages go through it as bytes.

rospy registers a node once, and gives up its main thread to that. Here a thread of its own does it: it waits for
roscore, and then asks each second whether the master still knows all that this node publishes and reads.
"""

from __future__ import annotations

import _thread
import importlib
import logging
import os
import struct
import threading
import xmlrpc.client
from functools import cache
from http.client import HTTPConnection, HTTPException
from typing import Any
from urllib.parse import urlsplit

from ropetrace.errors import ConfigError, MissingExtraError, RosError
from ropetrace.recordings import ros_messages
from ropetrace.recordings.ros_messages import ros2_type
from ropetrace.results.ros_estimates import typestore
from ropetrace.ros.graph import LONGEST_BRAKING, Subscription, check_topic
from ropetrace.ros.saying import say

MASTER = "http://localhost:11311"
"""Where roscore listens, if ROS_MASTER_URI says nothing else."""

LOOPBACK = "127.0.0.1"

EVERY = 1.0
"""The master is asked what it knows of this node this often, seconds."""

LONGEST_ANSWER = 2.0
"""A master or a node that has not answered after this long is passed over, seconds."""

_READ_AT_ONCE = 2**20
"""Bytes; rospy's own 64 kB cost a turn of its loop for each, and an image has many."""

_START_ROSCORE = "start it, or set ROS_MASTER_URI"

_UNREACHABLE = (OSError, HTTPException, xmlrpc.client.Error)


def ros1_type(name: str) -> str:
    """``sensor_msgs/msg/Image`` as ROS 1 names it: ``sensor_msgs/Image``."""
    package, _, message = name.split("/")
    return f"{package}/{message}"


@cache
def definition(name: str) -> tuple[str, str]:
    """The text and the MD5 sum of a type's definition in ROS 1; the type is named as ROS 2 names it."""
    text, md5sum = ros_messages.typestore("ros1").generate_msgdef(name)
    return str(text), str(md5sum)


@cache
def has_header(name: str) -> bool:
    """Whether a message begins with a std_msgs/Header, which ROS 1 numbers."""
    fields = typestore().get_msgdef(name).fields
    return bool(fields) and fields[0][1][1] == "std_msgs/msg/Header"


def ros1_bytes(data: bytes, name: str, sequence: int) -> bytearray:
    """A message in CDR as ROS 1 has it.

    Parameters
    ----------
    data : bytes
        Of a type that ROS 1 has, too, but for the number in its headers and the case of some names.
    name : str
        Of the type, as ROS 2 names it.
    sequence : int
        Header.seq, where the message begins with a header; 0 in those within.
    """
    converted = bytearray(typestore().cdr_to_ros1(data, name))
    if has_header(name):
        struct.pack_into("<I", converted, 0, sequence & 0xFFFFFFFF)
    return converted


def master_uri() -> str:
    """Where roscore is expected: ROS_MASTER_URI, or this machine.

    Raises
    ------
    ConfigError
        If ROS_MASTER_URI is no address.
    """
    uri = os.environ.get("ROS_MASTER_URI") or MASTER
    try:
        parts = urlsplit(uri)
        sound = parts.scheme == "http" and parts.hostname and parts.port
    except ValueError:
        sound = False
    if not sound:
        raise ConfigError(f"ROS_MASTER_URI = {uri!r}: expected an address such as {MASTER}")
    return uri


def published_topics(uri: str, name: str) -> list[tuple[str, str]]:
    """What is published at a roscore, as a node of a name asks it, each with its type as ROS 1 names it.

    Raises
    ------
    RosError
        If no roscore answers there.
    """
    with _answering(uri) as master:
        try:
            _, _, topics = master.getPublishedTopics(f"/{name}", "")
        except _UNREACHABLE:
            raise RosError(f"no roscore at {uri}: {_START_ROSCORE}") from None
    return [(topic, kind) for topic, kind in topics]


class RospyPublisher:
    """A `graph.Publisher`; made by `RospyNode.publisher`."""

    def __init__(self, publisher: Any, kind: Any, type_name: str, closed: type[Exception]) -> None:
        self._publisher = publisher
        self._kind = kind
        self._type = type_name
        self._closed = closed
        self._sequence = 0

    def put(self, message: Any) -> None:
        """Send a message; whoever does not keep up loses it."""
        self._sequence += 1
        if self._publisher.get_num_connections():
            self._send(bytes(typestore().serialize_cdr(message, self._type)))

    def put_packed(self, data: bytes) -> None:
        """Send a message that is CDR already."""
        self._sequence += 1
        if self._publisher.get_num_connections():
            self._send(data)

    def _send(self, data: bytes) -> None:
        raw = self._kind()
        raw._buff = ros1_bytes(data, self._type, self._sequence)
        try:
            self._publisher.publish(raw)
        except self._closed:
            """The master has told the node to end; it is on its way out."""


class RospyNode:
    """A node of a ROS 1 graph: a `graph.RosNode`. A process has one, since rospy has one.

    It is heard on this machine only, unless ROS_IP or ROS_HOSTNAME say otherwise. Where no roscore answers at
    ROS_MASTER_URI this is said on stderr, and the node waits for it beside its work; it makes itself known again to one
    that was started anew. A node that the master tells to end, as `rosnode kill` does, or since another of its name has
    come, ends as by Ctrl-C.

    Parameters
    ----------
    name : str
        Of the node.

    Raises
    ------
    MissingExtraError
        If rospy cannot be imported.
    ConfigError
        If ROS_MASTER_URI is no address.
    RosError
        If this process has a node already.
    """

    _taken = False

    def __init__(self, name: str) -> None:
        self.name = name
        self._uri = master_uri()
        self._rospy = _import_rospy()
        if RospyNode._taken:
            raise RosError("rospy has one node in a process, and this process has one already")
        RospyNode._taken = True
        if not (os.environ.get("ROS_IP") or os.environ.get("ROS_HOSTNAME")):
            os.environ["ROS_IP"] = LOOPBACK
            os.environ.pop("ROS_HOSTNAME", None)
            if urlsplit(self._uri).hostname not in ("localhost", LOOPBACK, "::1"):
                self._say(f"reached from this machine only, but roscore is at {self._uri}: set ROS_IP to open it")
        self._arrived = threading.Event()
        self._closing = threading.Event()
        self._changed = threading.Event()
        self._registrar: Any = None
        self._reads: list[Subscription] = []
        self._sound: set[tuple[str, str]] = set()
        self._rospy.on_shutdown(self._told_to_end)
        self._watch = threading.Thread(target=self._stay_known, name="ros master", daemon=True)
        self._watch.start()

    def __enter__(self) -> RospyNode:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the graph."""
        if self._registrar is not None and not self._master_answers():
            # rospy would take leave of it, and wait for its answer without end.
            self._registrar.master_uri = None
            self._rospy.impl.registration.get_topic_manager().close_all()
        self._closing.set()
        self._changed.set()
        self._rospy.signal_shutdown("closed")
        # If the master has told the node to end, it is rospy's thread that takes leave of it.
        if self._rospy.core._shutdown_lock.acquire(timeout=LONGEST_ANSWER):
            self._rospy.core._shutdown_lock.release()
        self._watch.join(LONGEST_ANSWER)

    def publisher(self, topic: str, type_name: str, depth: int = 5) -> RospyPublisher:
        """Publish messages of a type, named as ROS 2 names it.

        Raises
        ------
        ConfigError
            If the topic's name is impossible.
        """
        kind = self._raw(type_name)
        made = self._rospy.Publisher(check_topic(topic), kind, queue_size=depth, tcp_nodelay=True)
        self._changed.set()
        return RospyPublisher(made, kind, type_name, self._rospy.ROSException)

    def subscription(self, topic: str, type_name: str, depth: int = 1) -> Subscription:
        """Read a topic: the last `depth` messages are kept.

        Raises
        ------
        ConfigError
            If the topic's name is impossible.
        """
        read = Subscription(check_topic(topic), type_name, depth, self._arrived)
        self._rospy.Subscriber(
            topic,
            self._raw(type_name),
            lambda message: read.receive(message._buff, "ros1"),
            buff_size=_READ_AT_ONCE,
            tcp_nodelay=True,
        )
        self._reads.append(read)
        self._changed.set()
        return read

    def wait(self, seconds: float) -> None:
        """Wait until a message of any subscription has come since the last call, or for this long."""
        self._arrived.wait(seconds)
        self._arrived.clear()

    def _raw(self, type_name: str) -> Any:
        """A class of rospy's for messages of a type that stay bytes."""
        text, md5sum = definition(type_name)
        held = {"_type": ros1_type(type_name), "_md5sum": md5sum, "_full_text": text, "__slots__": []}
        return type("Raw", (self._rospy.AnyMsg,), held)

    def _say(self, text: str) -> None:
        say(f"{self.name}: {text}")

    def _told_to_end(self) -> None:
        if not self._closing.is_set():
            self._say("told to end by the ROS master: rosnode kill, or another node of this name")
            _thread.interrupt_main()
            # rospy closes every publisher as soon as this returns, and the arm may be braking.
            self._closing.wait(LONGEST_BRAKING + 1)

    def _stay_known(self) -> None:
        """Join the graph when there is one, and see to it that the master knows this node until the end."""
        with _answering(self._uri) as master:
            missing_said = False
            while not self._closing.is_set():
                try:
                    _, _, (publishing, reading, _) = master.getSystemState(f"/{self.name}")
                except _UNREACHABLE:
                    if not missing_said:
                        since = "yet" if self._registrar is None else "any more"
                        self._say(f"no roscore at {self._uri} {since}: {_START_ROSCORE}; waiting for it")
                    missing_said = True
                else:
                    missing_said = False
                    if self._registrar is None:
                        self._registrar = self._join()
                    if self._registrar is not None:
                        self._register(self._registrar, publishing, reading)
                        self._meet(master, dict(publishing))
                self._changed.wait(EVERY)
                self._changed.clear()

    def _master_answers(self) -> bool:
        with _answering(self._uri) as master:
            try:
                master.getPid(f"/{self.name}")
            except _UNREACHABLE:
                return False
        return True

    def _join(self) -> Any:
        """Start rospy's node; its registrar, which from now on acts for this thread alone. None at the end.

        By itself it would register each new topic in the thread that makes it, and hold that up while there is no
        master.
        """
        rospy = self._rospy
        rospy.core.configure_logging = lambda *_, **__: None
        try:
            rospy.init_node(
                self.name, argv=[self.name], disable_signals=True, disable_rosout=True, disable_rostime=True
            )
        except rospy.ROSInitException:
            if not self._closing.is_set():
                raise
            return None
        listeners = rospy.impl.registration.get_registration_listeners()
        registrar = listeners.listeners[0]
        listeners.clear()
        return registrar

    def _register(self, registrar: Any, publishing: list[Any], reading: list[Any]) -> None:
        """Tell the master which topics of this node it does not know."""
        registration = self._rospy.impl.registration
        ours, manager = self._rospy.get_name(), registration.get_topic_manager()
        for known, topics, kind in (
            (dict(publishing), manager.get_publications(), registration.Registration.PUB),
            (dict(reading), manager.get_subscriptions(), registration.Registration.SUB),
        ):
            for topic, type_name in topics:
                if ours not in known.get(topic, ()):
                    registrar.reg_added(topic, type_name, kind)

    def _meet(self, master: Any, publishers: dict[str, list[str]]) -> None:
        """Learn who publishes something else under a name that this node reads."""
        sound = set()
        for read in list(self._reads):
            others = {}
            for node in publishers.get(read.topic, ()):
                try:
                    _, _, uri = master.lookupNode(self._rospy.get_name(), node)
                    if (uri, read.topic) not in self._sound:
                        found = self._published_at(uri)[read.topic]
                        if found not in ("*", ros1_type(read.type)):
                            what = f"{ros2_type(found)}, expected {read.type}"
                            others[node] = f"{read.topic} of node {node} is {what}: not read"
                            continue
                    sound.add((uri, read.topic))
                except (*_UNREACHABLE, KeyError):
                    """It has gone, and the master does not know that."""
            read.others = others
        self._sound = sound

    def _published_at(self, uri: str) -> dict[str, str]:
        """The topics of a node, with their types as ROS 1 names them."""
        with _answering(uri) as node:
            _, _, published = node.getPublications(self._rospy.get_name())
        return dict(published)


class _Transport(xmlrpc.client.Transport):
    """That does not wait for ever."""

    def make_connection(self, host: Any) -> HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = LONGEST_ANSWER
        return connection


def _answering(uri: str) -> Any:
    """A master or a node, asked by XML-RPC; a context manager."""
    return xmlrpc.client.ServerProxy(uri, transport=_Transport())


def _import_rospy() -> Any:
    """rospy, which is kept from taking over the logging of the process."""
    logger_class = logging.getLoggerClass()
    try:
        rospy = importlib.import_module("rospy")
    except ImportError as error:
        raise MissingExtraError(
            f"this needs rospy of ROS 1 ({error}): apt-get install ros-core python3-rospy, and a Python that sees it; "
            "docs/ros.md says how"
        ) from error
    logging.setLoggerClass(logger_class)
    for name in ("rospy", "rosout", "rosgraph", "xmlrpc"):
        logging.getLogger(name).addHandler(logging.NullHandler())
    return rospy
