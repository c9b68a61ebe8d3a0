"""`ropetrace tune`: words for people, no logic."""

from __future__ import annotations

import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, arg

from ropetrace.cli_source import Source, TrackedRope
from ropetrace.errors import ConfigError, OutputError

LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class Tune:
    """Find the settings by eye, in a page in the browser, and save them as a TOML file."""

    source: OmitArgPrefixes[Source]
    rope: OmitArgPrefixes[TrackedRope]
    out: Annotated[Path, arg(aliases=["-o"], metavar="FILE")] = Path("rope.toml")
    """Where the page saves the settings."""
    bind: Annotated[str, arg(metavar="ADDRESS")] = LOOPBACK
    """Listen on this address; any but 127.0.0.1 lets other machines in, if they have the token of the page's address.
    It is not encrypted."""
    port: Annotated[int, arg(metavar="N")] = 0
    """Listen on this port; 0: any that is free."""
    overwrite: bool = False
    """Replace a file of settings that exists."""

    def run(self) -> int:
        from ropetrace.tune_page import TunePage
        from ropetrace.tuning import Tuning

        if not 0 <= self.port <= 65535:
            raise ConfigError(f"--port {self.port}: expected 0 to 65535")
        if self.out.exists() and not self.overwrite:
            raise OutputError(f"{self.out} exists already: choose another name or give --overwrite")
        part = self.source.part
        recording = part.open(self.source.recording)
        config = None if self.rope == TrackedRope() else self.rope.settings(self.source.first_frames)
        tuning = Tuning(recording, config, part.start, part.limit)
        if self.bind != LOOPBACK:
            print(f"warning   {self.bind} may be reached by other machines, and is not encrypted", file=sys.stderr)
        # An interrupt is the ordinary end.
        with suppress(KeyboardInterrupt), TunePage(tuning, self.out, self.bind, self.port) as page:
            print(f"page      {page.url}\nopen it in a browser; Ctrl-C ends it", flush=True)
            page.wait()
        print(f"settings  {self.out}" if self.out.exists() else "nothing was saved")
        return 0
