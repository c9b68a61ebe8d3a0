"""Who is let in to `ropetrace tune`, and the page that they are sent."""

from __future__ import annotations

import sys
from collections.abc import Callable
from http import HTTPStatus
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs, urlsplit

from ropetrace.listening import Door, Refusal
from ropetrace.recordings.base import printable

_MOST_BROWSERS = 20
"""More at once are turned away."""

_MOST_TOLD = 20
"""Refusals that are told on the terminal, each once: an old page asks again every other second."""

_HEADERS = {
    "Content-Type": "text/html; charset=utf-8",
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class Entrance:
    """Answers each request before a WebSocket is opened.

    Parameters
    ----------
    door : Door
        Knows who may enter.
    count_browsers : callable
        How many are in.
    """

    def __init__(self, door: Door, count_browsers: Callable[[], int]) -> None:
        self._door = door
        self._count_browsers = count_browsers
        self._told: set[str] = set()

    def answer(self, connection: Any, request: Any) -> Any:
        """The page, a refusal, or None to go on to the WebSocket; `process_request` of websockets."""
        try:
            address = urlsplit(request.path)
            opens_socket = address.path == "/socket"
            refusal = self._refusal(request.headers, parse_qs(address.query), opens_socket)
        except ValueError:
            return connection.respond(HTTPStatus.BAD_REQUEST, "this is no address\n")
        if refusal is not None:
            self._tell(f"refused   {connection.remote_address[0]}: {printable(refusal.reason)}")
            return connection.respond(refusal.status, f"{refusal.reason}\n")
        if opens_socket:
            if self._count_browsers() >= _MOST_BROWSERS:
                return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many pages are open\n")
            return None
        if address.path != "/":
            return connection.respond(HTTPStatus.NOT_FOUND, "there is one page here: /\n")
        return _page(connection)

    def _refusal(self, headers: Any, query: dict[str, list[str]], opens_socket: bool) -> Refusal | None:
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        host = hosts[0] if len(hosts) == 1 else ""
        refusal = self._door.refusal(host, origins, query.get("key", [""])[0])
        if refusal is None and opens_socket and not origins:
            return Refusal(HTTPStatus.FORBIDDEN, "a browser tells its origin")
        return refusal

    def _tell(self, line: str) -> None:
        if line not in self._told and len(self._told) < _MOST_TOLD:
            self._told.add(line)
            print(line, file=sys.stderr)


def _page(connection: Any) -> Any:
    response = connection.respond(HTTPStatus.OK, files("ropetrace").joinpath("tune.html").read_text("utf-8"))
    del response.headers["Content-Type"]
    response.headers.update(_HEADERS)
    return response
