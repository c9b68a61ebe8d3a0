"""What the tests of live ROS share: a router on a port of its own, processes and their sockets, and waiting."""

from __future__ import annotations

import os
import secrets
import socket
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from ropetrace.recordings.ros_frames import frame_messages
from ropetrace.results.ros_estimates import typestore
from ropetrace.ros.graph import RosNode, Subscription
from ropetrace.ros.zenoh_session import Connection, open_router
from ropetrace.types import Frame

STARTED = 300.0
"""Whatever a test waits for is there within this, seconds: nodes compile their kernels, and the machine may be busy."""


def free_port() -> int:
    """A port of this machine at which nothing listens, and that Linux gives to nobody who asks for any port."""
    while True:
        port = 10_000 + secrets.randbelow(22_000)
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


def free_endpoint() -> str:
    """An endpoint of this machine at which nothing listens."""
    return f"tcp/127.0.0.1:{free_port()}"


@contextmanager
def routed() -> Iterator[Connection]:
    """A router, and how it is reached."""
    endpoint = free_endpoint()
    router = open_router(endpoint)
    try:
        yield Connection(router=endpoint)
    finally:
        router.close()


@contextmanager
def publishing(join: Callable[[], RosNode], frame: Callable[[], Frame], under: str = "") -> Iterator[None]:
    """A camera of its own node that publishes frames, 50 a second, under a prefix of the usual topics."""
    stop = threading.Event()

    def run() -> None:
        with join() as node:
            made: dict[str, Any] = {}
            while not stop.wait(0.02):
                for message in frame_messages(frame()):
                    if message.topic not in made:
                        made[message.topic] = node.publisher(under + message.topic, message.type)
                    made[message.topic].put_packed(bytes(message.data))

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


class LocalPublisher:
    """Hands its messages to the subscriptions of its node."""

    def __init__(self, node: LocalNode, topic: str, type_name: str) -> None:
        self._node, self._topic, self._type = node, topic, type_name

    def put(self, message: Any) -> None:
        self.put_packed(bytes(typestore().serialize_cdr(message, self._type)))

    def put_packed(self, data: bytes) -> None:
        for read in self._node.reads[self._topic]:
            if read.type == self._type:
                read.receive(data, "cdr")


class LocalNode:
    """A node without a graph: who publishes by it is heard by who reads by it, at once."""

    name = "local"

    def __init__(self) -> None:
        self.reads: defaultdict[str, list[Subscription]] = defaultdict(list)
        self._arrived = threading.Event()

    def __enter__(self) -> LocalNode:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Nothing is open."""

    def publisher(self, topic: str, type_name: str, depth: int = 5) -> LocalPublisher:
        return LocalPublisher(self, topic, type_name)

    def subscription(self, topic: str, type_name: str, depth: int = 1) -> Subscription:
        self.reads[topic].append(Subscription(topic, type_name, depth, self._arrived))
        return self.reads[topic][-1]

    def wait(self, seconds: float) -> None:
        self._arrived.wait(seconds)
        self._arrived.clear()

    def show(self, frame: Frame, *left_out: str) -> None:
        """Publish a frame but for some topics."""
        for message in frame_messages(frame):
            if message.topic not in left_out:
                self.publisher(message.topic, message.type).put_packed(bytes(message.data))


def until(condition: Callable[[], object], seconds: float = STARTED) -> None:
    """Wait for a condition."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"not within {seconds} s"
        time.sleep(0.01)


def children_of(pid: int) -> list[int]:
    """The processes that a process has started, and that run."""
    with open(f"/proc/{pid}/task/{pid}/children", encoding="ascii") as file:
        return [int(child) for child in file.read().split() if runs(int(child))]


def runs(pid: int) -> bool:
    """Whether a process is there, and is more than an exit code that nobody has asked for."""
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8", errors="replace") as file:
            return file.read().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def listening(pid: int) -> list[tuple[str, str]]:
    """Protocol and address of every socket of a process that takes connections or datagrams."""
    inodes = set()
    for entry in os.scandir(f"/proc/{pid}/fd"):
        try:
            link = os.readlink(entry.path)
        except OSError:
            continue
        if link.startswith("socket:["):
            inodes.add(link[8:-1])
    found = []
    for table in ("tcp", "tcp6", "udp", "udp6"):
        with open(f"/proc/{pid}/net/{table}", encoding="ascii") as rows:
            next(rows)
            for row in rows:
                cells = row.split()
                if cells[9] in inodes and (cells[3] == "0A" or table.startswith("udp")):
                    address = cells[1].rpartition(":")[0]
                    host = (
                        ".".join(str(byte) for byte in reversed(bytes.fromhex(address)))
                        if len(address) == 8
                        else address
                    )
                    found.append((table.rstrip("6"), host))
    return found
