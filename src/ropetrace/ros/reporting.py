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

SILENCE = 1.0
"""A topic on which nothing has come for this long is told, seconds."""


class Reporter:
    """Tells how a node is: on ``/diagnostics`` each second and at every change, and changes on stderr.

    Parameters
    ----------
    node : RosNode
        Of whom.
    """

    def __init__(self, node: RosNode) -> None:
        self._name = node.name
        self._publisher = node.publisher("/diagnostics", DIAGNOSTICS)
        self._kind = ""
        self._told = -EVERY
        self._heard = time.monotonic()

    def tell(self, status: Status, text: str, values: dict[str, str] | None = None) -> None:
        """Say it, if it is new or a second has passed; figures alone make nothing new."""
        now, kind = time.monotonic(), f"{status} {re.sub(r'[-+]?[0-9][0-9.e+-]*', '#', text)}"
        changed = kind != self._kind
        if not changed and now - self._told < EVERY:
            return
        if changed:
            say(f"{self._name}: {status}: {text}")
        self._kind, self._told = kind, now
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
