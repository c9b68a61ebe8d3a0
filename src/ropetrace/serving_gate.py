"""The one port of `ropetrace serve`: it lets through to Rerun who may look, and nobody who would write.

Rerun's own servers answer to any name and to pages of other ports of this machine, take pictures from everybody who can
reach them, and send the browser to the internet for a font. See docs/serve.md for what was measured.
"""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import io
import re
import threading
from collections import deque
from collections.abc import AsyncIterator
from dataclasses import dataclass
from email.message import Message
from http import HTTPStatus
from urllib.parse import parse_qs, quote, urlsplit

from ropetrace.listening import Door
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

    Parameters
    ----------
    host, port
        As for `ropetrace.listening.Door`.

    Attributes
    ----------
    door : Door
        On loopback it asks for no key.

    Raises
    ------
    ConfigError
        If there is no such address.
    OutputError
        If the port is taken.
    """

    def __init__(self, host: str, port: int) -> None:
        self.door = Door(host, port)
        self._connections = 0
        self._viewers = 0
        self._page: Address = ("", 0)
        self._stream: Address = ("", 0)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._end: asyncio.Event | None = None
        self._thread: threading.Thread | None = None

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
            self.door.socket.close()
            return
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join()

    async def _run(self, started: threading.Event) -> None:
        self._loop, self._end = asyncio.get_running_loop(), asyncio.Event()
        server = await asyncio.start_server(self._meet, sock=self.door.socket, limit=PIECE_BYTES)
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
        cookie = f"ropetrace_{self.door.port}"
        given = request.query.get("key", [""])[0] or request.cookie(cookie)
        refusal = self.door.refusal(request.host, request.headers.get_all("Origin") or [], given)
        if refusal is not None:
            return _answer(refusal.status, refusal.reason)
        if request.method == "POST" and request.path == READ_PATH:
            return None
        if request.method not in ("GET", "HEAD"):
            return _answer(HTTPStatus.METHOD_NOT_ALLOWED, "here one may only look")
        if request.path == "/" and "url" not in request.query:
            stream = quote(f"rerun+http://{request.host}/proxy", safe="")
            keep = f"Set-Cookie: {cookie}={self.door.key}; Path=/; HttpOnly; SameSite=Lax\r\n" if self.door.key else ""
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
                # In pieces: a slow link may take long over a whole message.
                for start in range(0, len(message), PIECE_BYTES):
                    piece = message[start : start + PIECE_BYTES]
                    writer.writelines((b"%x\r\n" % len(piece), piece, b"\r\n"))
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
