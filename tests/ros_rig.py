"""What the tests of live ROS share: a router on a port of its own, processes and their sockets, and waiting."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ropetrace.ros.zenoh_session import Connection, open_router


def free_port() -> int:
    """A port of this machine at which nothing listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


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


def until(condition: Callable[[], object], seconds: float = 20.0) -> None:
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
