"""The server of `ropetrace tune`: looks at frames, and shows what the settings make of them to the browsers."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from ropetrace.errors import RopetraceError, import_extra
from ropetrace.listening import Door
from ropetrace.tune_board import Board, Shown
from ropetrace.tune_entrance import Entrance
from ropetrace.tune_look import Look
from ropetrace.tune_requests import Requests, SavedSettings
from ropetrace.tune_seat import Seat
from ropetrace.tuning import Tuning

_MOST_BYTES = 65_536
"""The longest message that is taken from a browser."""

_HANDSHAKE = 2.0
"""Browsers open connections in advance; one that asks for nothing is closed after this, seconds."""

_FAREWELL = 2.0
"""How long a browser may take to close its connection, seconds."""

_RETRY_SECONDS = 1.0
"""How often a source that failed is begun anew."""

_PACE_SECONDS = 2.0
"""The frames of this long make the rate that is shown."""

_GLANCE_SECONDS = 0.25
"""How often it is asked whether there is something to do."""

_LONGEST_END = 5.0
"""How long the frame that is looked at may take to the end, seconds; the compiler is not waited for."""


class TunePage:
    """Serves the page as long as it is entered, to browsers that have the key in its address.

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
    board : Board
        What the browsers are shown, and the `Tuning` behind it.
    door : Door
        Where it listens; `door.url` is the address to open.
    file : SavedSettings
        What its button has saved.

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
    `run` reads frames and looks at them, in the thread that calls it. Each browser has two threads of its own: see
    `ropetrace.tune_seat.Seat`.
    """

    def __init__(self, open_tuning: Callable[[], Tuning], out: Path, bind: str = "127.0.0.1", port: int = 0) -> None:
        serve = import_extra("websockets.sync.server", "tune").serve
        self.board = Board(out)
        self.file = SavedSettings(out)
        self.door = Door(bind, port, option="--bind", always_locked=True)
        self._open_tuning = open_tuning
        self._requests = Requests(self.board, self.file)
        self._stopping = False
        self._server = serve(
            self._seat,
            sock=self.door.socket,
            process_request=Entrance(self.door, lambda: len(self._server.connections)).answer,
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

    def _seat(self, connection: Any) -> None:
        Seat(connection, self.board, self._requests).serve()

    def stop(self) -> None:
        """End `run`."""
        with self.board.news:
            self._stopping = True
            self.board.news.notify_all()

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
        if looking.is_alive() and self.board.tuning is not None:
            self.board.tuning.close()
        if errors:
            raise errors[0]

    def run(self) -> None:
        """Look at frames until `stop`.

        Raises
        ------
        RopetraceError
            If the source cannot be opened.
        """
        self.board.show(Shown(0, busy="Opening the source"))
        tuning = self.board.tuning = self._open_tuning()
        busy = "Click on the rope. What passes is shown when the compiler is done: half a minute, the first time"
        try:
            self.board.show(Shown(0, tuning.glance(), busy))
            self._look_on(tuning)
        finally:
            tuning.close()

    def _look_on(self, tuning: Tuning) -> None:
        board, pace = self.board, _Pace()
        looked = -1
        while not self._stopping:
            with board.news:
                if not tuning.wants_frame and looked == board.change:
                    board.news.wait(_GLANCE_SECONDS)
                    continue
                change = board.change
            # The first look is at the frame that the glance was at.
            works = tuning.take() if looked >= 0 and tuning.wants_frame else True
            look, trouble = _looked(tuning)
            board.show(Shown(change, look, rate=pace.rate(time.monotonic())), trouble)
            looked = change
            if not works:
                with board.news:
                    board.news.wait(_RETRY_SECONDS)


class _Pace:
    """How often something happens."""

    def __init__(self) -> None:
        self._times: deque[float] = deque()

    def rate(self, now: float) -> float:
        """Times a second, with one more at `now`, seconds; 0 until that can be told."""
        times = self._times
        times.append(now)
        while now - times[0] > _PACE_SECONDS:
            times.popleft()
        span = now - times[0]
        return (len(times) - 1) / span if span > _PACE_SECONDS / 2 else 0.0


def _looked(tuning: Tuning) -> tuple[Look, str]:
    """What the settings make of the frame; or the frame alone, and why nothing can be made of it."""
    try:
        return tuning.look(), ""
    except RopetraceError as error:
        return tuning.glance(), str(error)
