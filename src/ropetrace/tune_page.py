"""The server of `ropetrace tune`: sends its page, and what it shows, to the browsers that may have it."""

from __future__ import annotations

import hmac
import json
import os
import secrets
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from http import HTTPStatus
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any, Self
from urllib.parse import parse_qs, urlsplit

from ropetrace.errors import ConfigError, OutputError, RopetraceError, import_extra
from ropetrace.recordings.base import printable
from ropetrace.serving_gate import authority, is_loopback, is_loopback_name, listen
from ropetrace.tune_message import message_of
from ropetrace.tuning import Look, Tuning
from ropetrace.types import BadFrame

_MOST_BYTES = 65_536
"""The longest message that is taken from a browser."""

_MOST_BROWSERS = 20
"""More at once are turned away."""

_HANDSHAKE = 2.0
"""Browsers open connections in advance; one that asks for nothing is closed after this, seconds."""

_FAREWELL = 2.0
"""How long a browser may take to close its connection, seconds."""

_STUCK = 10.0
"""A browser that has not taken a message after this long is cut off, seconds."""

_SHORTEST_STEP = 1 / 15
"""Between two frames that are sent to one browser, seconds."""

_RETRY_SECONDS = 1.0
"""How often a source that failed is begun anew."""

_PACE_SECONDS = 2.0
"""The frames of this long make the rate that is shown."""

_GLANCE_SECONDS = 0.25
"""How often it is asked whether there is something to do."""

_LONGEST_END = 5.0
"""How long the frame that is looked at may take to the end, seconds; the compiler is not waited for."""

_INTERNAL_ERROR = 1011
"""The code with which a WebSocket is closed for a fault of ours."""

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


def refusal(host: str, origin: str | None, token: str, given: str, *, on_loopback: bool) -> str | None:
    """Why a request is refused, or None.

    A foreign page that is open in the same browser can send requests here, but not without an `origin` of its own; nor,
    on loopback, can one whose name is made to point here, for its `host` is not a name of loopback. Further out a
    machine may have any name, and the token alone decides.
    """
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        name = ""
    if not name or (on_loopback and not is_loopback_name(name)):
        return f"the host {host!r} is no name of this machine's loopback" if on_loopback else f"{host!r} is no host"
    if origin is not None and origin != f"http://{host}":
        return f"the origin {origin!r} is foreign"
    if not hmac.compare_digest(token.encode(), given.encode()):
        return "the token is missing or wrong"
    return None


@dataclass(eq=False)
class SettingsFile:
    """Where settings are saved.

    Parameters
    ----------
    path : Path
        The file.

    Attributes
    ----------
    was_saved : bool
        Whether `save` has written it.
    """

    path: Path
    _written: bytes | None = None

    @property
    def was_saved(self) -> bool:
        return self._written is not None

    def is_of_others(self) -> bool:
        """Whether there is a file that is not what was saved last."""
        try:
            return self.path.read_bytes() != self._written
        except FileNotFoundError:
            return False
        except OSError:
            return self.path.exists()

    def save(self, text: str) -> None:
        """Write settings, whole or not at all.

        Raises
        ------
        OutputError
            If they cannot be written.
        """
        content = f"# ropetrace {version('ropetrace')}, tuned by eye\n{text}".encode()
        part = self.path.with_name(self.path.name + ".part")
        try:
            part.write_bytes(content)
            os.replace(part, self.path)
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {error.strerror}") from None
        self._written = content


@dataclass(frozen=True, slots=True, eq=False)
class _Shown:
    """What all browsers are shown; `change` is the last request that counts in it."""

    change: int
    look: Look | None = None
    busy: str = ""
    rate: float = 0.0


@dataclass(slots=True, eq=False)
class _Seat:
    """One browser: whether it is there, and has shown what it was sent last; and what it asked for last.

    `change` is the place of its last request among all, `serial` its own number of it, `version` that of the state that
    was sent last, and `sent` are the looks of which it shows one.
    """

    is_open: bool = True
    is_ready: bool = True
    change: int = 0
    serial: int = 0
    version: int = 0
    sent: deque[Look] = field(default_factory=lambda: deque(maxlen=2))


@dataclass(eq=False)
class TunePage:
    """Serves the page as long as it is entered, to browsers that have the token in its address.

    Parameters
    ----------
    open_tuning : callable
        Makes what the page shows and changes; called by `run`, so that the page can say what it waits for.
    out : Path
        Where its button saves the settings; no request can name another.
    bind : str
        The address that is listened on; any but this machine's own opens the page to others.
    port : int
        0 for any that is free.

    Attributes
    ----------
    tuning : Tuning, optional
        None as long as the source is not open.
    url : str
        The address to open, with its token.
    open_to_others : bool
        Whether other machines may get in.

    Raises
    ------
    MissingExtraError
        If websockets is not installed.
    ConfigError
        If there is no such address.
    OutputError
        If the port is taken.

    Notes
    -----
    `run` reads frames and looks at them, in the thread that calls it. A thread for each browser does what it asks for;
    another sends it the newest that there is, one frame at a time: the next one goes out when the browser has shown
    the last.
    """

    open_tuning: Callable[[], Tuning]
    out: Path
    bind: str = "127.0.0.1"
    port: int = 0
    token: str = field(default_factory=lambda: secrets.token_urlsafe(16))
    tuning: Tuning | None = None

    def __post_init__(self) -> None:
        serve = import_extra("websockets.sync.server", "tune").serve
        self._closed = import_extra("websockets.exceptions", "tune").ConnectionClosed
        self.file = SettingsFile(self.out)
        self._news = threading.Condition()
        self._acting = threading.Lock()
        self._shown = _Shown(0, busy="One moment")
        self._version = 1
        self._change = 0
        self._said: list[str] = []
        self._trouble = ""
        self._asks_to_replace = False
        self._stopping = False
        self._encoding = threading.Lock()
        self._encoded = (0, "")
        listening = listen(self.bind, self.port, "--bind")
        self.port = listening.getsockname()[1]
        self.open_to_others = not is_loopback(listening)
        self.url = f"http://{authority(listening, self.bind)}/?token={self.token}"
        self._server = serve(
            self._talk,
            sock=listening,
            process_request=self._answer,
            open_timeout=_HANDSHAKE,
            close_timeout=_FAREWELL,
            max_size=_MOST_BYTES,
            compression=None,
            server_header=None,
        )
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()
        self._server.shutdown()
        self._thread.join()

    def stop(self) -> None:
        """End `run`."""
        with self._news:
            self._stopping = True
            self._news.notify_all()

    # --- what is shown ---

    def run_until_interrupted(self) -> None:
        """`run` in a thread of its own, until Ctrl-C, which is the ordinary end.

        An interrupt reaches the main thread alone: while that only sleeps, no lock stays taken, and the compiler, whose
        callbacks swallow it, is not in its way.

        Raises
        ------
        RopetraceError
            If the source cannot be opened.
        """
        errors: list[Exception] = []

        def look() -> None:
            try:
                self.run()
            except Exception as error:
                errors.append(error)

        looking = threading.Thread(target=look, name="looking", daemon=True)
        looking.start()
        with suppress(KeyboardInterrupt):
            while looking.is_alive():
                time.sleep(_GLANCE_SECONDS)
        self.stop()
        looking.join(_LONGEST_END)
        if looking.is_alive() and self.tuning is not None:
            self.tuning.close()
        if errors:
            raise errors[0]

    def run(self) -> None:
        """Look at frames until `stop`.

        Raises
        ------
        RopetraceError
            If the source cannot be opened.
        """
        self._show(_Shown(0, busy="Opening the source"))
        tuning = self.tuning = self.open_tuning()
        try:
            self._show(
                _Shown(
                    0,
                    tuning.glance(),
                    "Click on the rope. What passes is shown when the compiler is done: half a minute, the first time",
                )
            )
            self._look_on(tuning)
        finally:
            tuning.close()

    def _look_on(self, tuning: Tuning) -> None:
        times: deque[float] = deque()
        looked = -1
        while not self._stopping:
            with self._news:
                if not tuning.wants_frame and looked == self._change:
                    self._news.wait(_GLANCE_SECONDS)
                    continue
                change = self._change
            # The first look is at the frame that the glance was at.
            works = tuning.take() if looked >= 0 and tuning.wants_frame else True
            look, trouble = _looked(tuning)
            now = time.monotonic()
            times.append(now)
            while now - times[0] > _PACE_SECONDS:
                times.popleft()
            rate = (len(times) - 1) / (now - times[0]) if now - times[0] > _PACE_SECONDS / 2 else 0.0
            self._show(_Shown(change, look, rate=rate), trouble)
            looked = change
            if not works:
                with self._news:
                    self._news.wait(_RETRY_SECONDS)

    def _show(self, shown: _Shown, trouble: str = "") -> None:
        with self._news:
            if shown.change < self._shown.change:
                return
            self._shown = shown
            self._trouble = trouble or self._trouble
            self._version += 1
            self._news.notify_all()

    def _text_of_newest(self) -> tuple[int, _Shown, str]:
        """The newest that there is to show: its version, and its JSON, which is made once for all browsers."""
        with self._encoding:
            with self._news:
                number, shown, tuning = self._version, self._shown, self.tuning
                state: dict[str, Any] = {
                    "busy": shown.busy,
                    "said": self._said,
                    "trouble": self._trouble,
                    "out": str(self.out),
                    "asks_to_replace": self._asks_to_replace,
                    "rate": shown.rate,
                }
            if self._encoded[0] != number:
                if tuning is not None:
                    state |= {"source": tuning.name, "live": tuning.is_live, "frozen": tuning.frozen}
                    state |= {"first": tuning.first, "end": tuning.end}
                if tuning is not None and shown.look is not None:
                    state["look"] = message_of(shown.look, tuning.is_live)
                self._encoded = number, json.dumps(state)
            return number, shown, self._encoded[1]

    # --- one browser ---

    def _talk(self, connection: Any) -> None:
        """What a browser asks for, one thing after the other."""
        # A browser that is gone without a word must hold up neither its sender nor the end.
        connection.socket.settimeout(_STUCK)
        seat = _Seat()
        sender = threading.Thread(target=self._send_newest, args=(connection, seat), daemon=True)
        sender.start()
        try:
            with suppress(self._closed):
                for text in connection:
                    self._take(seat, text)
        finally:
            with self._news:
                seat.is_open = False
                self._news.notify_all()
            sender.join()

    def _send_newest(self, connection: Any, seat: _Seat) -> None:
        try:
            with suppress(self._closed):
                self._send_all(connection, seat)
        except Exception as error:
            # Without what sends, the page would stand still without a word.
            print(f"closed    a page: {type(error).__name__}: {printable(str(error))}", file=sys.stderr)
            connection.close(_INTERNAL_ERROR)

    def _send_all(self, connection: Any, seat: _Seat) -> None:
        """Send what is newest, whenever the browser has shown what was sent before, until the browser goes."""
        when = 0.0
        while True:
            with self._news:
                self._news.wait_for(lambda: not seat.is_open or (seat.is_ready and self._version > seat.version))
                if not seat.is_open:
                    return
                seat.is_ready = False
            time.sleep(max(when + _SHORTEST_STEP - time.monotonic(), 0.0))
            seat.version, shown, text = self._text_of_newest()
            when = time.monotonic()
            if shown.look is not None:
                seat.sent.append(shown.look)
            done = seat.serial if shown.change >= seat.change else 0
            connection.send(f'{{"done": {done}, "state": {text}}}')

    def _take(self, seat: _Seat, text: str | bytes) -> None:
        """Do what a message asks for, and look again."""
        serial = 0
        said: list[str] = []
        trouble, asks = "", False
        try:
            asked = json.loads(text)
            if asked["do"] == "shown":
                with self._news:
                    seat.is_ready = True
                    self._news.notify_all()
                return
            serial = int(asked["serial"])
            with self._acting:
                said = self._do(asked, seat)
        except _AlreadyThereError as error:
            trouble, asks = str(error), True
        except RopetraceError as error:
            trouble = str(error)
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
            trouble = "this page and its server do not fit: load it again"
        with self._news:
            self._said, self._trouble, self._asks_to_replace = said, trouble, asks
            self._change += 1
            seat.change, seat.serial = self._change, serial
            tuning = self.tuning
            if tuning is not None and (self._shown.busy or isinstance(tuning.event, BadFrame)):
                # Whoever clicks while the kernels compile, or a camera is waited for, sees at once what was found.
                self._show(replace(self._shown, change=self._change, look=tuning.glance()))
            self._news.notify_all()

    def _do(self, asked: Mapping[str, Any], seat: _Seat) -> list[str]:
        """One thing that a page asks for; what is to be said of it."""
        tuning, look = self.tuning, self._shown.look
        if tuning is None or look is None:
            raise ConfigError("the source is not open yet")
        match asked["do"]:
            case "click":
                event = next((sent.event for sent in tuple(seat.sent) if sent.index == asked["index"]), None)
                return tuning.click(int(asked["column"]), int(asked["row"]), event)
            case "measure":
                return tuning.measure()
            case "box":
                tuning.put_box_round(look.cloud.points)
            case "set":
                tuning.change(asked["settings"])
            case "go":
                return [] if tuning.go_to(int(asked["index"])) else ["there is no such frame"]
            case "freeze":
                tuning.frozen = bool(asked["frozen"])
            case "save":
                return self._save(tuning, bool(asked["replace"]))
            case _:
                raise ValueError
        return []

    def _save(self, tuning: Tuning, may_replace: bool) -> list[str]:
        if not tuning.knows_diameter:
            raise ConfigError("the diameter is not known yet: click on the rope, or set it")
        if self.file.is_of_others() and not may_replace:
            raise _AlreadyThereError(f"{self.out} is there already: press 'replace' to write over it")
        self.file.save(tuning.config.to_toml())
        return [f"saved: ropetrace track {tuning.name} --config {self.out}"]

    # --- who is let in ---

    def _answer(self, connection: Any, request: Any) -> Any:
        """The page, a refusal, or None to go on to the WebSocket."""
        try:
            address = urlsplit(request.path)
        except ValueError:
            return connection.respond(HTTPStatus.BAD_REQUEST, "this is no address\n")
        given = parse_qs(address.query).get("token", [""])[0]
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        opens_socket = address.path == "/socket"
        host, origin = hosts[0] if len(hosts) == 1 else "", origins[0] if origins else None
        why = refusal(host, origin, self.token, given, on_loopback=not self.open_to_others)
        if why is None and opens_socket and not origins:
            why = "a browser tells its origin"
        if why is not None:
            print(f"refused   {connection.remote_address[0]}: {printable(why)}", file=sys.stderr)
            return connection.respond(HTTPStatus.FORBIDDEN, f"{why}\n")
        if opens_socket:
            if len(self._server.connections) >= _MOST_BROWSERS:
                return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many pages are open\n")
            return None
        if address.path != "/":
            return connection.respond(HTTPStatus.NOT_FOUND, "there is one page here: /\n")
        return _page()


class _AlreadyThereError(OutputError):
    """A file of somebody else would be written over."""


def _looked(tuning: Tuning) -> tuple[Look, str]:
    """What the settings make of the frame; or the frame alone, and why nothing can be made of it."""
    try:
        return tuning.look(), ""
    except RopetraceError as error:
        return tuning.glance(), str(error)


def _page() -> Any:
    headers = import_extra("websockets.datastructures", "tune").Headers(_HEADERS)
    body = files("ropetrace").joinpath("tune.html").read_bytes()
    headers["Content-Length"] = str(len(body))
    return import_extra("websockets.http11", "tune").Response(HTTPStatus.OK, "OK", headers, body)
