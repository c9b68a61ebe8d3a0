"""What the commands share on a terminal."""

from __future__ import annotations

import sys
from typing import Any

NOTHING_FOUND, BAD_INPUT, DAMAGED, INTERRUPTED = 1, 2, 3, 130
"""Exit codes: no frame gave an estimate; what was given is wrong; part of the recording was lost; after Ctrl-C."""

INTERRUPTS: list[int] = []
"""Signals that came. The exception alone is not enough: raised inside the compiler's callbacks it is swallowed."""


def progress_bar(total: int | None, unit: str) -> Any:
    """A tqdm bar with its rate, a context manager; it shows nothing when piped."""
    from tqdm import tqdm

    return tqdm(total=total, unit=unit, disable=not sys.stderr.isatty(), leave=False)
