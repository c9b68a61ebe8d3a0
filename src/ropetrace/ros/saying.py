"""What a node says to people."""

from __future__ import annotations

import contextlib
import sys


def say(text: str) -> None:
    """Print a line on stderr; if nobody reads that any more, the node goes on without it."""
    with contextlib.suppress(OSError):
        print(text, file=sys.stderr, flush=True)
