"""A Zenoh session as rmw_zenoh opens it: a peer that finds the others through a router, heard on this machine only."""

from __future__ import annotations

import json
import socket
from dataclasses import dataclass
from typing import Any, Literal

from ropetrace.errors import ConfigError, RosError, import_extra

ROUTER = "tcp/127.0.0.1:7447"
"""Where the router of rmw_zenoh listens."""

START_ROUTER = "start one with `ropetrace node router`, or `ros2 run rmw_zenoh_cpp rmw_zenohd`"
"""What to do where no router answers."""

MOST_DOMAINS = 232
"""The greatest ROS_DOMAIN_ID."""

_MOST_QUEUED = 16
"""Parcels of 64 kB that wait for a receiver, the most that Zenoh permits. With its 2, of three small messages that are
sent at once the last was lost in one case of twelve, and one joint command in 270, on a busy machine."""

_MOST_WAIT_US = 5_000
"""The longest that a large message waits for a receiver that does not keep up before it is dropped, microseconds."""


@dataclass(frozen=True, slots=True)
class Connection:
    """How the ROS graph is reached.

    Parameters
    ----------
    router : str
        A Zenoh endpoint. Where none answers, the session goes on asking for it.
    mode : str
        ``peer``: data goes straight from node to node, as rmw_zenoh does it; the router only makes them known to each
        other. ``client``: all of it goes through the router, and nothing listens here.
    listen : str
        Where a peer is reached: a port of this machine's own that the system chooses.
    multicast : bool
        Look for others on the local network by UDP multicast too: this listens beyond this machine.
    domain : int
        ROS_DOMAIN_ID, 0 to 232.
    shared_memory : bool
        Hand on large messages to nodes on this machine by shared memory. Zenoh 1.10 keeps 16 MB of each node that has
        ended.
    humble : bool
        Speak with Humble, which has no hashes of types.

    Raises
    ------
    ConfigError
        If a value is impossible.
    """

    router: str = ROUTER
    mode: Literal["peer", "client"] = "peer"
    listen: str = "tcp/127.0.0.1:0"
    multicast: bool = False
    domain: int = 0
    humble: bool = False
    shared_memory: bool = False

    def __post_init__(self) -> None:
        if self.mode not in ("peer", "client"):
            raise ConfigError(f"mode = {self.mode!r}: expected 'peer' or 'client'")
        if not 0 <= self.domain <= MOST_DOMAINS:
            raise ConfigError(f"domain = {self.domain}: expected 0 to {MOST_DOMAINS}, as ROS_DOMAIN_ID")
        for name in ("router", "listen"):
            _host_and_port(name, getattr(self, name))


def open_session(connection: Connection) -> Any:
    """Open a session.

    Returns
    -------
    zenoh.Session

    Raises
    ------
    RosError
        If Zenoh refuses: an address that is not of this machine, or taken; a client whose router does not answer.
    MissingExtraError
        If Zenoh is not installed.
    """
    listen = [connection.listen] if connection.mode == "peer" else []
    return _opened(connection.mode, [connection.router], listen, connection.multicast, connection.shared_memory)


def open_router(endpoint: str = ROUTER) -> Any:
    """Be the router, where no rmw_zenohd runs.

    Raises
    ------
    RosError
        If the endpoint cannot be listened at.
    MissingExtraError
        If Zenoh is not installed.
    """
    _host_and_port("router", endpoint)
    return _opened("router", [], [endpoint])


def router_answers(endpoint: str = ROUTER) -> bool:
    """Whether anything takes a connection at a TCP endpoint."""
    host, port = _host_and_port("router", endpoint)
    try:
        socket.create_connection((host, port), timeout=1.0).close()
    except OSError:
        return False
    return True


def _opened(
    mode: str, connect: list[str], listen: list[str], multicast: bool = False, shared_memory: bool = False
) -> Any:
    zenoh = import_extra("zenoh", "ros2")
    # As the default files of rmw_zenoh have it: the router tells the peers of each other, one of two connects.
    gossip = {
        "enabled": True,
        "target": {"router": ["router", "peer"], "peer": ["router"]},
        "autoconnect_strategy": {"peer": {"to_router": "always", "to_peer": "greater-zid"}},
    }
    drop = {"max_wait_before_drop_fragments": _MOST_WAIT_US}
    settings = {
        "mode": mode,
        "connect": {"endpoints": connect},
        "listen": {"endpoints": listen},
        "scouting": {"multicast": {"enabled": multicast}, "gossip": gossip},
        "routing": {"router": {"peers_failover_brokering": False}},
        "timestamping": {"enabled": True},
        "transport": {
            "link": {"tx": {"queue": {"size": {"data": _MOST_QUEUED}, "congestion_control": {"drop": drop}}}},
            "shared_memory": {"enabled": shared_memory},
        },
    }
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
    except zenoh.ZError as error:
        where = ", ".join(connect + listen)
        raise RosError(f"no Zenoh session ({mode}, {where}): {str(error).splitlines()[0]}") from None


def _host_and_port(name: str, endpoint: str) -> tuple[str, int]:
    """The parts of an endpoint such as tcp/127.0.0.1:7447."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if protocol != "tcp" or not host or not port.isdecimal() or int(port) > 65535:
        raise ConfigError(f"{name} = {endpoint!r}: expected an endpoint such as {ROUTER}")
    return host.strip("[]"), int(port)
