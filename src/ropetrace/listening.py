"""A port of this machine that browsers come to, and which of them may enter."""

from __future__ import annotations

import errno
import hmac
import ipaddress
import secrets
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from http import HTTPStatus
from urllib.parse import urlsplit

from ropetrace.errors import ConfigError, OutputError


@dataclass(frozen=True)
class Refusal:
    """Why a browser may not enter, and the status of HTTP that says so."""

    status: HTTPStatus
    reason: str


class Door:
    """A socket that listens at an address of this machine, and who may enter there.

    A foreign page that is open in the same browser can send requests here, but not without an origin of its own; nor,
    on loopback, can one whose name was made to point here, for that is not a name of loopback. Further out a machine
    may have any name, and the key alone decides.

    Parameters
    ----------
    host : str
        The address, or its name; 0.0.0.0 is all of them of IPv4, :: all of both kinds.
    port : int
        0: any that is free.
    option : str
        What the user gives the address by.
    always_locked : bool
        Whether the key is asked for on loopback, too, which is open to all programs of this machine.

    Attributes
    ----------
    socket : socket.socket
        To be closed by whoever takes connections from it.
    port : int
    open_to_others : bool
        Whether other machines may get in.
    key : str
        What the address must have; empty where none is asked for.
    url : str
        What people open.

    Raises
    ------
    ConfigError
        If there is no such address.
    OutputError
        If the port is taken.
    """

    def __init__(self, host: str, port: int, *, option: str = "--host", always_locked: bool = False) -> None:
        self.socket = _listen(host, port, option)
        place, self.port = self.socket.getsockname()[:2]
        address = ipaddress.ip_address(place.partition("%")[0])
        self.open_to_others = not address.is_loopback
        self.key = secrets.token_urlsafe(16) if self.open_to_others or always_locked else ""
        name = socket.gethostname() if address.is_unspecified else host
        query = f"?key={self.key}" if self.key else ""
        self.url = f"http://{f'[{name}]' if ':' in name else name}:{self.port}/{query}"

    def refusal(self, host: str, origins: Sequence[str], key: str) -> Refusal | None:
        """Why a request is refused; None if it may come in.

        Parameters
        ----------
        host : str
            What the browser calls us, with the port; empty if it does not say.
        origins : sequence of str
            The pages that it says it asks for.
        key : str
            What it gives as the key.

        Raises
        ------
        ValueError
            If `host` cannot be one.
        """
        name = urlsplit(f"//{host}").hostname
        if not name:
            return Refusal(HTTPStatus.MISDIRECTED_REQUEST, f"{host!r} is no host")
        if not self.open_to_others and not _is_loopback_name(name):
            reason = f"the host {host!r} is no name of this machine's loopback"
            return Refusal(HTTPStatus.MISDIRECTED_REQUEST, reason)
        for origin in origins:
            if origin != f"http://{host}":
                return Refusal(HTTPStatus.FORBIDDEN, f"the origin {origin!r} is foreign")
        if self.key and not hmac.compare_digest(key.encode(), self.key.encode()):
            return Refusal(HTTPStatus.FORBIDDEN, "the key is missing or wrong: open the address that was printed")
        return None


def _is_loopback_name(name: str) -> bool:
    """Whether a name can only mean this machine's loopback; a foreign page can make any other point here."""
    try:
        return ipaddress.ip_address(name).is_loopback
    except ValueError:
        return name == "localhost" or name.endswith(".localhost")


def _listen(host: str, port: int, option: str) -> socket.socket:
    if not 0 <= port <= 65535:
        raise ConfigError(f"--port {port}: expected 0 to 65535")
    try:
        family, _, _, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE if host else 0
        )[0]
    except (OSError, UnicodeError) as error:
        raise ConfigError(f"{option} {host}: there is no such address ({error}): give one of this machine's") from None
    both = family == socket.AF_INET6 and address[0] == "::" and socket.has_dualstack_ipv6()
    try:
        return socket.create_server(address[:2], family=family, dualstack_ipv6=both)
    except OSError as error:
        what = f"{host}:{port}: cannot be listened on: {error.strerror or error}"
        if error.errno == errno.EADDRINUSE:
            raise OutputError(f"{what}: end what runs there, or give another --port (0: any that is free)") from None
        raise ConfigError(f"{what}: give an address of this machine to {option}") from None
