"""What the tests of live ROS 2 share: a router on a port of its own, and waiting."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ropetrace.ros.zenoh_session import Connection, open_router


def free_endpoint() -> str:
    """An endpoint of this machine at which nothing listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


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
