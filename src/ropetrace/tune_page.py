"""The page of `ropetrace tune`: what is sent to the browser, and the server that sends it to nobody else."""

from __future__ import annotations

import base64
import hmac
import io
import ipaddress
import json
import os
import secrets
import socket
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any, Self
from urllib.parse import parse_qs, urlsplit

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ropetrace.config import default_variance_threshold
from ropetrace.errors import ConfigError, OutputError, RopetraceError, import_extra
from ropetrace.picture import backdrop, pixels_of
from ropetrace.recordings.base import printable
from ropetrace.tuning import TUNED, Look, Tuning
from ropetrace.types import BadFrame, Cloud, Estimate, Event, FloatArray, Intrinsics, RgbdFrame

_MOST_POINTS = 4000
"""Points that are shown in space."""

_MOST_BYTES = 65_536
"""The longest message that is taken from a browser."""

_ANY = ("", "0.0.0.0", "::")
"""Addresses that stand for all of this machine's."""

_HANDSHAKE = 2.0
"""Browsers open connections in advance; one that asks for nothing is closed after this, seconds."""

_NO_IMAGE = Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5)
"""What a bad frame is shown as: nothing."""

_HEADERS = {
    "Content-Type": "text/html; charset=utf-8",
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Connection": "close",
}


def message_of(tuning: Tuning, look: Look) -> dict[str, Any]:
    """All that the page shows, ready for JSON; lengths in metres, places in the image in pixels."""
    picture, camera = _picture(look.event, look.cloud)
    corners = tuning.box_corners()
    return {
        "index": look.index,
        "first": tuning.first,
        "end": tuning.end,
        "width": camera.width,
        "height": camera.height,
        "camera": [camera.fx, camera.fy, camera.cx, camera.cy],
        "image": _data_url(picture, "JPEG"),
        "passing": _data_url(_passing(look.cloud, camera), "PNG"),
        "passed": look.estimates[0].point_count,
        "gated": tuning.config.asks_for_color or corners is not None or not _has_color(look.event),
        "points": _rounded(look.cloud.points[:: len(look.cloud.points) // _MOST_POINTS + 1]),
        "slices": _rounded(look.slices),
        "box": None if corners is None else _rounded(corners),
        "ropes": [_rope(estimate) for estimate in look.estimates],
        "settings": {name: _setting(tuning, name) for name in TUNED},
        "variance_threshold": default_variance_threshold(tuning.config.diameter),
    }


def _has_color(event: Event) -> bool:
    return isinstance(event, RgbdFrame) and event.color is not None


def _picture(event: Event, cloud: Cloud) -> tuple[Image.Image, Intrinsics]:
    if isinstance(event, BadFrame):
        return Image.new("RGB", (_NO_IMAGE.width, _NO_IMAGE.height)), _NO_IMAGE
    if isinstance(event, RgbdFrame) and event.color is not None:
        return Image.fromarray(event.color), event.intrinsics
    return backdrop(event, cloud)


def _passing(cloud: Cloud, camera: Intrinsics) -> Image.Image:
    """The pixels that pass, on nothing."""
    columns, rows = np.round(pixels_of(cloud.points, camera)).astype(int).T
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    passing: NDArray[np.uint8] = np.zeros((camera.height, camera.width, 4), np.uint8)
    passing[rows[inside], columns[inside]] = (0, 255, 210, 150)
    return Image.fromarray(passing)


def _data_url(picture: Image.Image, kind: str) -> str:
    stream = io.BytesIO()
    picture.save(stream, kind)
    return f"data:image/{kind.lower()};base64,{base64.b64encode(stream.getvalue()).decode()}"


def _rope(estimate: Estimate) -> dict[str, Any]:
    count = len(estimate.waypoints)
    return {
        "status": str(estimate.status),
        "reasons": list(estimate.reasons),
        "length": float(estimate.waypoints.length) if count else 0.0,
        "nodes": _rounded(estimate.nodes),
        "line": _rounded(estimate.waypoints.positions),
        "seen": [True] * count if estimate.seen is None else estimate.seen.tolist(),
    }


def _rounded(points: FloatArray) -> list[list[float]]:
    """To a hundredth of a millimetre, which is less to send."""
    return np.round(points, 5).tolist()


def _setting(tuning: Tuning, name: str) -> Any:
    section, _, key = name.rpartition(".")
    return getattr(getattr(tuning.config, section) if section else tuning.config, key)


def refusal(host: str, origin: str | None, token: str, given: str) -> str | None:
    """Why a request is refused, or None.

    A foreign page that is open in the same browser can send requests here, but not without an `origin` of its own; nor
    can one whose name is made to point here, for its `host` is a name, and not this machine's.
    """
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        name = ""
    if not (name in ("localhost", socket.gethostname().lower()) or _is_address(name)):
        return f"the host {host!r} is not this machine"
    if origin is not None and origin != f"http://{host}":
        return f"the origin {origin!r} is foreign"
    if not hmac.compare_digest(token.encode(), given.encode()):
        return "the token is missing or wrong"
    return None


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def save_settings(text: str, path: Path) -> None:
    """Write settings, whole or not at all.

    Raises
    ------
    OutputError
        If they cannot be written.
    """
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(f"# ropetrace {version('ropetrace')}, tuned by eye\n{text}", encoding="utf-8")
        os.replace(part, path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from None


@dataclass(eq=False)
class TunePage:
    """Serves the page as long as it is entered, to one browser at a time that has the token in its address.

    Parameters
    ----------
    tuning : Tuning
        What the page shows and changes.
    out : Path
        Where its button saves the settings; no request can name another.
    bind : str
        The address that is listened on; any but this machine's own opens the page to others.
    port : int
        0 for any that is free.

    Raises
    ------
    MissingExtraError
        If websockets is not installed.
    OutputError
        If the address cannot be listened on.
    """

    tuning: Tuning
    out: Path
    bind: str = "127.0.0.1"
    port: int = 0
    token: str = field(default_factory=lambda: secrets.token_urlsafe(16))
    _seat: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        serve = import_extra("websockets.sync.server", "tune").serve
        try:
            self._server = serve(
                self._talk,
                self.bind,
                self.port,
                process_request=self._answer,
                open_timeout=_HANDSHAKE,
                max_size=_MOST_BYTES,
                server_header=None,
            )
        except (OSError, OverflowError) as error:
            raise OutputError(f"{self.bind}:{self.port}: cannot be listened on: {error}") from None
        self.port = self._server.socket.getsockname()[1]
        # An interrupt reaches the main thread only, and so never the middle of what the server does.
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)

    @property
    def url(self) -> str:
        """The address to open, with its token."""
        host = socket.gethostname() if self.bind in _ANY else self.bind
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.port}/?token={self.token}"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._server.shutdown()
        self._thread.join()

    def wait(self) -> None:
        """Return when the server has ended, which is for an interrupt to bring about."""
        self._thread.join()

    def _answer(self, connection: Any, request: Any) -> Any:
        """The page, a refusal, or None to go on to the WebSocket."""
        address = urlsplit(request.path)
        given = parse_qs(address.query).get("token", [""])[0]
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        opens_socket = address.path == "/socket"
        why = refusal(hosts[0] if len(hosts) == 1 else "", origins[0] if origins else None, self.token, given)
        if why is None and opens_socket and not origins:
            why = "a browser tells its origin"
        if why is not None:
            print(f"refused   {connection.remote_address[0]}: {printable(why)}", file=sys.stderr)
            return connection.respond(HTTPStatus.FORBIDDEN, f"{why}\n")
        if opens_socket:
            return None
        if address.path != "/":
            return connection.respond(HTTPStatus.NOT_FOUND, "there is one page here: /\n")
        return _page()

    def _talk(self, connection: Any) -> None:
        """What the page asks for, one thing after the other."""
        if not self._seat.acquire(timeout=1):
            connection.close(1013, "another page is open")
            return
        try:
            self._send(connection, [], "")
            for text in connection:
                said, trouble = self._done(text)
                self._send(connection, said, trouble)
        finally:
            self._seat.release()

    def _done(self, text: str | bytes) -> tuple[list[str], str]:
        """Do what a message asks for; what is to be said of it, and what went wrong."""
        try:
            return _do(self.tuning, json.loads(text), self.out), ""
        except RopetraceError as error:
            return [], str(error)
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
            return [], "this page and its server do not fit: load it again"

    def _send(self, connection: Any, said: list[str], trouble: str) -> None:
        try:
            state: dict[str, Any] = message_of(self.tuning, self.tuning.look())
        except RopetraceError as error:
            state, trouble = {}, trouble or str(error)
        connection.send(json.dumps({**state, "said": said, "trouble": trouble, "out": self.out.name}))


def _do(tuning: Tuning, asked: Mapping[str, Any], out: Path) -> list[str]:
    """One thing that the page asks for; what is to be said of it."""
    match asked["do"]:
        case "click":
            return tuning.click(int(asked["column"]), int(asked["row"]))
        case "measure":
            return tuning.measure()
        case "set":
            tuning.change(asked["settings"])
            return []
        case "go":
            return [] if tuning.go_to(int(asked["index"])) else ["there is no such frame"]
        case "save":
            if not tuning.knows_diameter:
                raise ConfigError("the diameter is not known yet: click on the rope, or set it")
            save_settings(tuning.config.to_toml(), out)
            return [f"saved: ropetrace track RECORDING --config {out}"]
    raise ValueError


def _page() -> Any:
    headers = import_extra("websockets.datastructures", "tune").Headers(_HEADERS)
    body = files("ropetrace").joinpath("tune.html").read_bytes()
    headers["Content-Length"] = str(len(body))
    return import_extra("websockets.http11", "tune").Response(HTTPStatus.OK, "OK", headers, body)
