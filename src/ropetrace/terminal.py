"""What the commands share on a terminal."""

from __future__ import annotations

import sys
from typing import Any

INTERRUPTED = 130
"""Exit code after Ctrl-C."""


def progress_bar(total: int | None, unit: str) -> Any:
    """A tqdm bar with its rate, a context manager; it shows nothing when piped."""
    from tqdm import tqdm

    return tqdm(total=total, unit=unit, disable=not sys.stderr.isatty(), leave=False)
