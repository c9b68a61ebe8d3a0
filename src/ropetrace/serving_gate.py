"""The one port of `ropetrace serve`: it lets through to Rerun who may look, and nobody who would write.

Rerun's own servers answer to any name and to pages of other ports of this machine, take pictures from everybody who can
reach them, and send the browser to the internet for a font. See docs/serve.md for what was measured.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hmac
import http.client
import io
import ipaddress
import re
import secrets
import socket
import threading
from collections import deque
from collections.abc import AsyncIterator
from dataclasses import dataclass
from email.message import Message
from http import HTTPStatus
from urllib.parse import parse_qs, quote, urlsplit

from ropetrace.errors import ConfigError, OutputError
from ropetrace.results.feed import Address

READ_PATH = "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages"
"""What the page asks for to be sent the pictures."""

HEAD_SECONDS = 10.0
"""How long a browser, or Rerun, may take for the head of a message."""

STUCK_SECONDS = 10.0
"""A browser that takes nothing for this long is cut off."""

WAITING_BYTES = 24 << 20
"""What may wait for a browser that is slow; more is thrown away at once, and it goes on with what comes then. It must
hold what Rerun keeps for those who come late."""

PIECE_BYTES = 1 << 16

MOST_CONNECTIONS = 100
"""More at once are turned away: a page takes some ten while it loads, and one to look on."""

MOST_VIEWERS = 10
"""More are turned away: `WAITING_BYTES` may wait for each."""

CONTENT_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; worker-src 'self' blob:; connect-src 'self' data: blob:; frame-ancestors 'none'"
)
"""The page loads nothing from elsewhere, tells nothing to anybody else, and stands in no page of others."""


@dataclass(frozen=True)
class Request:
    """The head of a request."""

    method: str
    target: str
    headers: Message

    @classmethod
    def parse(cls, head: bytes) -> Request:
        """From the bytes up to the empty line; ValueError if that is no HTTP/1.1."""
        line, _, rest = head.partition(b"\r\n")
        method, target, protocol = line.decode("ascii").split(" ")
        if not protocol.startswith("HTTP/1.") or not target.startswith("/"):
            raise ValueError("this is not a request of a browser")
        return cls(method, target, http.client.parse_headers(io.BytesIO(rest)))

    @property
    def host(self) -> str:
        """What the browser calls us, with the port; empty if it does not say, or says two things."""
        hosts = self.headers.get_all("Host") or []
        return hosts[0] if len(hosts) == 1 else ""

    @property
    def path(self) -> str:
        return urlsplit(self.target).path

    @property
    def query(self) -> dict[str, list[str]]:
        return parse_qs(urlsplit(self.target).query)

    def cookie(self, name: str) -> str:
        """The value of a cookie; empty if there is none. Those of other servers of this machine may be anything."""
        cookies = "; ".join(self.headers.get_all("Cookie") or [])
        found = re.search(rf"(?:^|;)\s*{re.escape(name)}=([^;]*)", cookies)
        return found[1].strip() if found else ""

    def forwarded(self, host: str) -> bytes:
        """The head as it goes on to another server; the connection ends with the answer."""
        dropped = {"host", "connection", "origin", "cookie", "referer"}
        lines = [f"{self.method} {self.target} HTTP/1.1", f"Host: {host}", "Connection: close"]
        lines += [f"{name}: {value}" for name, value in self.headers.items() if name.lower() not in dropped]
        return "\r\n".join([*lines, "", ""]).encode("latin-1")


class Gate:
    """Takes browsers in at an address of this machine.

    An address of loopback is open to all programs of this machine, and to browsers that call it by its own name: so a
    foreign page cannot get in by a name that it made point here. Any other address is open to those who have the key.

    Parameters
    ----------
    host : str
        An address of this machine, or its name; 0.0.0.0 and :: are all of them.
    port : int
        0: any that is free.

    Attributes
    ----------
    port : int
    key : str
        What the address must have; empty on loopback.

    Raises
    ------
    ConfigError
        If there is no such address.
    OutputError
        If the port is taken.
    """

    def __init__(self, host: str, port: int) -> None:
        self._socket = listen(host, port)
        self.port = int(self._socket.getsockname()[1])
        self._host = host
        self.key = "" if is_loopback(self._socket) else secrets.token_urlsafe(16)
        self._connections = 0
        self._viewers = 0
        self._page: Address = ("", 0)
        self._stream: Address = ("", 0)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._end: asyncio.Event | None = None
        self._thread: threading.Thread | None = None

    @property
    def url(self) -> str:
        """What people open."""
        return f"http://{authority(self._socket, self._host)}/" + (f"?key={self.key}" if self.key else "")

    def open(self, page: Address, stream: Address) -> None:
        """Let browsers in, to Rerun's server of the page and its server of the pictures."""
        self._page, self._stream = page, stream
        started = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run(started)), name="gate", daemon=True)
        self._thread.start()
        started.wait()

    def close(self) -> None:
        """Cut everybody off; a second call does nothing."""
        if self._thread is None or self._loop is None or self._end is None:
            self._socket.close()
            return
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join()

    async def _run(self, started: threading.Event) -> None:
        self._loop, self._end = asyncio.get_running_loop(), asyncio.Event()
        server = await asyncio.start_server(self._meet, sock=self._socket, limit=PIECE_BYTES)
        started.set()
        await self._end.wait()
        server.close()

    async def _meet(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer one request; a browser makes a connection for each."""
        self._connections += 1
        try:
            # Whoever goes away in the middle is no trouble; nor is the end of the gate.
            with contextlib.suppress(OSError, asyncio.IncompleteReadError, asyncio.CancelledError):
                if self._connections > MOST_CONNECTIONS:
                    writer.write(_answer(HTTPStatus.SERVICE_UNAVAILABLE, "too many connections"))
                else:
                    await self._serve(reader, writer)
                await asyncio.wait_for(writer.drain(), STUCK_SECONDS)
                writer.close()
                await asyncio.wait_for(writer.wait_closed(), STUCK_SECONDS)
        finally:
            # What is closed alone waits for ever for whoever takes nothing.
            writer.transport.abort()
            self._connections -= 1

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            async with asyncio.timeout(HEAD_SECONDS):
                request = Request.parse(await reader.readuntil(b"\r\n\r\n"))
            answer = self.answer(request)
        except (ValueError, asyncio.LimitOverrunError, http.client.HTTPException):
            answer = _answer(HTTPStatus.BAD_REQUEST, "this is not a request of a browser")
        if answer is not None:
            writer.write(answer)
        elif request.method != "POST":
            await self._pass_on(request, self._page, reader, writer)
        elif self._viewers >= MOST_VIEWERS:
            writer.write(_answer(HTTPStatus.SERVICE_UNAVAILABLE, f"{MOST_VIEWERS} viewers are looking on already"))
        else:
            self._viewers += 1
            try:
                await self._pass_on(request, self._stream, reader, writer)
            finally:
                self._viewers -= 1

    def answer(self, request: Request) -> bytes | None:
        """What a request is told by the gate itself: where to go, or why not; None if it may go on to Rerun.

        ValueError if its names are none.
        """
        origins = request.headers.get_all("Origin") or []
        name = urlsplit(f"//{request.host}").hostname
        if not name or (not self.key and not is_loopback_name(name)):
            return _answer(HTTPStatus.MISDIRECTED_REQUEST, f"{request.host!r} is no name of this machine's loopback")
        if any(origin != f"http://{request.host}" for origin in origins):
            return _answer(HTTPStatus.FORBIDDEN, f"the origin {origins[0]!r} is foreign")
        cookie = f"ropetrace_{self.port}"
        given = request.query.get("key", [""])[0] or request.cookie(cookie)
        if not hmac.compare_digest(given.encode(), self.key.encode()) and self.key:
            return _answer(HTTPStatus.FORBIDDEN, "the key is missing or wrong: open the address that serve printed")
        if request.method == "POST" and request.path == READ_PATH:
            return None
        if request.method not in ("GET", "HEAD"):
            return _answer(HTTPStatus.METHOD_NOT_ALLOWED, "here one may only look")
        if request.path == "/" and "url" not in request.query:
            stream = quote(f"rerun+http://{request.host}/proxy", safe="")
            keep = f"Set-Cookie: {cookie}={self.key}; Path=/; HttpOnly; SameSite=Lax\r\n" if self.key else ""
            return _answer(
                HTTPStatus.FOUND, "", f"Location: /?url={stream}&hide_welcome_screen&persist=false\r\n{keep}"
            )
        return None

    async def _pass_on(
        self, request: Request, address: Address, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Carry bytes between the browser and Rerun until one of them ends; TimeoutError if one takes nothing."""
        try:
            from_rerun, to_rerun = await asyncio.open_connection(*address, limit=PIECE_BYTES)
        except OSError:
            writer.write(_answer(HTTPStatus.BAD_GATEWAY, "the server of the pictures has ended"))
            return
        try:
            to_rerun.write(request.forwarded(f"{address[0]}:{address[1]}"))
            # The page's requests have no body; that of the stream ends when the browser does.
            ways = [
                asyncio.create_task(_carry(reader, to_rerun)),
                asyncio.create_task(_bring(from_rerun, writer, is_stream=request.method == "POST")),
            ]
            try:
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for way in ways:
                    way.cancel()
                ends = await asyncio.gather(*ways, return_exceptions=True)
            if any(isinstance(end, TimeoutError) for end in ends):
                raise TimeoutError
        finally:
            to_rerun.close()


async def _bring(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, is_stream: bool) -> None:
    """Carry an answer, with our headers added."""
    async with asyncio.timeout(HEAD_SECONDS):
        head = await reader.readuntil(b"\r\n\r\n")
    added = f"Connection: close\r\nContent-Security-Policy: {CONTENT_POLICY}\r\nReferrer-Policy: no-referrer\r\n\r\n"
    writer.write(head[:-2] + added.encode("ascii"))
    if is_stream and b"transfer-encoding: chunked" in head.lower():
        await _bring_messages(reader, writer)
    else:
        await _carry(reader, writer)


async def _bring_messages(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Carry the messages of a stream, and leave some out for a browser that is slow.

    Rerun itself waits for the slowest, and lets all others wait with it: so it must never wait for us.
    """
    waiting: deque[bytes] = deque()
    size = 0
    changed = asyncio.Event()

    async def fetch() -> None:
        nonlocal size
        async for message in _messages(reader):
            if size + len(message) > WAITING_BYTES:
                waiting.clear()
                size = 0
            waiting.append(message)
            size += len(message)
            changed.set()

    fetching = asyncio.create_task(fetch())
    fetching.add_done_callback(lambda _: changed.set())
    try:
        while waiting or not fetching.done():
            if waiting:
                message = waiting.popleft()
                size -= len(message)
                writer.writelines((b"%x\r\n" % len(message), message, b"\r\n"))
                await asyncio.wait_for(writer.drain(), STUCK_SECONDS)
            else:
                changed.clear()
                await changed.wait()
        writer.write(b"0\r\n\r\n")
    finally:
        fetching.cancel()
        await asyncio.gather(fetching, return_exceptions=True)


async def _messages(reader: asyncio.StreamReader) -> AsyncIterator[bytes]:
    """The messages of gRPC-web, a byte of flags and four of length before each, out of the chunks of HTTP."""
    buffer = bytearray()
    while size := int((await reader.readuntil(b"\r\n")).partition(b";")[0], 16):
        buffer += await reader.readexactly(size)
        await reader.readexactly(2)
        while len(buffer) >= 5 and len(buffer) >= (end := 5 + int.from_bytes(buffer[1:5], "big")):
            yield bytes(buffer[:end])
            del buffer[:end]


async def _carry(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Carry bytes until the end; TimeoutError if nobody takes them."""
    while data := await reader.read(PIECE_BYTES):
        writer.write(data)
        await asyncio.wait_for(writer.drain(), STUCK_SECONDS)


def _answer(status: HTTPStatus, text: str, headers: str = "") -> bytes:
    body = f"{text}\n".encode() if text else b""
    return (
        f"HTTP/1.1 {status.value} {status.phrase}\r\n{headers}Content-Type: text/plain; charset=utf-8\r\n"
        f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    ).encode() + body


def is_loopback_name(name: str) -> bool:
    """Whether a name can only mean this machine's loopback; a foreign page can make any other point here."""
    try:
        return ipaddress.ip_address(name).is_loopback
    except ValueError:
        return name == "localhost" or name.endswith(".localhost")


def _address_of(listening: socket.socket) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    return ipaddress.ip_address(listening.getsockname()[0].partition("%")[0])


def is_loopback(listening: socket.socket) -> bool:
    """Whether a socket takes connections from this machine alone."""
    return _address_of(listening).is_loopback


def authority(listening: socket.socket, host: str) -> str:
    """What people call the place of a socket that listens on `host`: a name and the port."""
    name = socket.gethostname() if _address_of(listening).is_unspecified else host
    return f"{f'[{name}]' if ':' in name else name}:{listening.getsockname()[1]}"


def listen(host: str, port: int, option: str = "--host") -> socket.socket:
    """A socket that listens at an address of this machine, or at all of them: 0.0.0.0 for IPv4, :: for both.

    Parameters
    ----------
    host : str
        The address, or its name.
    port : int
        0: any that is free.
    option : str
        What the user gives the address by.

    Raises
    ------
    ConfigError
        If there is no such address.
    OutputError
        If the port is taken.
    """
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
