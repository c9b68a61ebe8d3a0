"""`ropetrace tune`: words for people, no logic."""

from __future__ import annotations

import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, arg

from ropetrace.cli_source import Source, TrackedRope
from ropetrace.errors import OutputError
from ropetrace.live import scheme_of

if TYPE_CHECKING:
    from ropetrace.tuning import Tuning


@dataclass(frozen=True)
class Tune:
    """Find the settings by eye, in a page in the browser, and save them as a TOML file: for a recording, or live."""

    source: OmitArgPrefixes[Source]
    rope: OmitArgPrefixes[TrackedRope]
    out: Annotated[Path, arg(aliases=["-o"], metavar="FILE")] = Path("rope.toml")
    """Where the page saves the settings."""
    bind: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1"
    """Listen on this address; any but 127.0.0.1 lets other machines in, if they have the key in the page's address.
    It is not encrypted."""
    port: Annotated[int, arg(metavar="N")] = 0
    """Listen on this port; 0: any that is free."""

    def run(self) -> int:
        from ropetrace.tune_page import TunePage

        if self.out.is_dir() or not self.out.absolute().parent.is_dir():
            raise OutputError(f"--out {self.out}: give a file in a folder that exists")
        opened = None if scheme_of(self.source.recording) else self._open()
        # An interrupt is the ordinary end, also before the page runs.
        with (
            suppress(KeyboardInterrupt),
            TunePage(lambda: opened or self._open(), self.out, self.bind, self.port) as page,
        ):
            if page.door.open_to_others:
                print(f"warning   {self.bind} may be reached by other machines, and is not encrypted", file=sys.stderr)
            print(f"page      {page.door.url}\nopen it in a browser; Ctrl-C ends it", flush=True)
            page.run_until_interrupted()
        print(f"settings  {self.out}" if page.file.was_saved else "nothing was saved")
        return 0

    def _open(self) -> Tuning:
        from ropetrace.tuning import Tuning

        recording = self.source.open()
        config = None if self.rope == TrackedRope() else self.rope.settings(self.source.first_frames)
        return Tuning(recording, config, self.source.part.start, self.source.part.limit)
