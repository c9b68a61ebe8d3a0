"""One browser of `ropetrace tune`: takes what it asks for, and sends it the newest that there is to show."""

from __future__ import annotations

import json
import sys
import threading
import time
from contextlib import suppress
from typing import Any

from ropetrace.errors import RopetraceError, import_extra
from ropetrace.recordings.base import printable
from ropetrace.tune_board import Answer, Board
from ropetrace.tune_look import Look
from ropetrace.tune_requests import Requests

_STUCK = 10.0
"""A browser that has not taken a message after this long is cut off, seconds."""

_SHORTEST_STEP = 1 / 15
"""Between two frames that are sent to one browser, seconds."""

_INTERNAL_ERROR = 1011
"""The code with which a WebSocket is closed for a fault of ours."""


class Seat:
    """Sits a browser before the board.

    It is sent one frame at a time: the next one goes out when it has shown the last.

    Parameters
    ----------
    connection : websockets.sync.server.ServerConnection
        Its WebSocket.
    board : Board
        What it is shown.
    requests : Requests
        What does what it asks for.
    """

    def __init__(self, connection: Any, board: Board, requests: Requests) -> None:
        self._connection = connection
        self._board = board
        self._requests = requests
        self._gone = import_extra("websockets.exceptions", "tune").ConnectionClosed
        self._is_open = True
        self._has_shown = True
        self._version = 0
        # The number of its last request among all, and its own number of it; together, for they are read together.
        self._last = (0, 0)
        # One of these it shows.
        self._sent: tuple[Look, ...] = ()

    def serve(self) -> None:
        """Do what the browser asks for, until it goes."""
        # A browser that is gone without a word must hold up neither its sender nor the end.
        self._connection.socket.settimeout(_STUCK)
        sender = threading.Thread(target=self._send_newest, daemon=True)
        sender.start()
        try:
            with suppress(self._gone):
                for text in self._connection:
                    self._take(text)
        finally:
            with self._board.news:
                self._is_open = False
                self._board.news.notify_all()
            sender.join()

    def _take(self, text: str | bytes) -> None:
        serial = 0
        try:
            asked = json.loads(text)
            if asked["do"] == "shown":
                self._go_on()
                return
            serial = int(asked["serial"])
            answer = self._requests.do(asked, self._sent)
        except RopetraceError as error:
            answer = Answer(trouble=str(error))
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
            answer = Answer(trouble="this page and its server do not fit: load it again")
        with self._board.news:
            self._last = self._board.answer(answer), serial

    def _go_on(self) -> None:
        with self._board.news:
            self._has_shown = True
            self._board.news.notify_all()

    def _send_newest(self) -> None:
        try:
            with suppress(self._gone):
                self._send_all()
        except Exception as error:
            # Without what sends, the page would stand still without a word.
            print(f"closed    a page: {type(error).__name__}: {printable(str(error))}", file=sys.stderr)
            self._connection.close(_INTERNAL_ERROR)

    def _send_all(self) -> None:
        when = 0.0
        while self._wait_for_news():
            time.sleep(max(when + _SHORTEST_STEP - time.monotonic(), 0.0))
            self._version, shown, text = self._board.newest()
            when = time.monotonic()
            if shown.look is not None:
                self._sent = (*self._sent[-1:], shown.look)
            change, serial = self._last
            self._connection.send(f'{{"done": {serial if shown.change >= change else 0}, "state": {text}}}')

    def _wait_for_news(self) -> bool:
        """Wait until there is something to send, and the browser takes it; false if it has gone."""
        board = self._board
        with board.news:
            board.news.wait_for(lambda: not self._is_open or (self._has_shown and board.version > self._version))
            self._has_shown = False
            return self._is_open
