"""What a node says to people."""

from __future__ import annotations

import contextlib
import sys


def say(text: str) -> None:
    """Print a line on stderr; if nobody reads that any more, the node goes on without it."""
    with contextlib.suppress(OSError):
        # In one piece: several nodes may write to the same terminal.
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()
