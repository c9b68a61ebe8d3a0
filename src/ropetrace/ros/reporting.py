"""What a node is at, for people and for ``/diagnostics``."""

from __future__ import annotations

import re
import time

from ropetrace.results.ros_estimates import DIAGNOSTICS, diagnostics, header
from ropetrace.ros.graph import RosNode
from ropetrace.ros.saying import say
from ropetrace.types import Status

EVERY = 1.0
"""Between two messages that say the same, seconds."""

AGAIN = 0.1
"""After which a change is told once more, seconds: a message may be lost."""

SILENCE = 1.0
"""A topic on which nothing has come for this long is told, seconds."""


class Reporter:
    """Tells how a node is: on ``/diagnostics`` each second and at every change, and changes on stderr.

    What comes and goes many times a second is on stderr once a second.

    Parameters
    ----------
    node : RosNode
        Of whom.
    """

    def __init__(self, node: RosNode) -> None:
        self._name = node.name
        self._publisher = node.publisher("/diagnostics", DIAGNOSTICS)
        self._kind = self._said_last = ""
        self._due = 0.0
        self._said: dict[str, float] = {}
        self._heard = time.monotonic()

    def tell(self, status: Status, text: str, values: dict[str, str] | None = None) -> None:
        """Say it, if it is new or a second has passed; figures alone make nothing new."""
        now, kind = time.monotonic(), f"{status} {re.sub(r'[-+]?[0-9][0-9.e+-]*', '#', text)}"
        if kind != self._said_last and now - self._said.get(kind, -EVERY) >= EVERY:
            say(f"{self._name}: {status}: {text}")
            self._said = {one: when for one, when in self._said.items() if now - when < EVERY} | {kind: now}
            self._said_last = kind
        changed, self._kind = kind != self._kind, kind
        if changed or now >= self._due:
            self._due = now + (AGAIN if changed else EVERY)
            held = header(time.time_ns(), "")
            self._publisher.put(diagnostics(held, f"ropetrace: {self._name}", status, text, values or {}))

    def heard(self) -> None:
        """Note that what the node lives on has come."""
        self._heard = time.monotonic()

    def tell_silence(self, topic: str, problem: str) -> None:
        """Say that nothing comes on a topic, or why, if nothing was heard for `SILENCE`."""
        silent = time.monotonic() - self._heard
        if silent > SILENCE:
            self.tell(Status.LOST, problem or f"nothing came on {topic} for {silent:.1f} s")
