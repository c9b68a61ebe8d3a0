"""`ropetrace serve`: words for people, no logic."""

from __future__ import annotations

import sys
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, arg

from ropetrace.cli_source import Source, TrackedRope
from ropetrace.cli_track import Results, pose_of, prediction, track
from ropetrace.errors import OutputError
from ropetrace.terminal import INTERRUPTS

if TYPE_CHECKING:
    from ropetrace.config import RopeConfig
    from ropetrace.recordings import Recording
    from ropetrace.serving import ViewServer


@dataclass(frozen=True)
class Serve:
    """Track the rope and show it live in any browser, for as long as you like.

    ropetrace serve sim:swing --diameter 15mm --color '#c8281e'
    """

    source: OmitArgPrefixes[Source]
    rope: OmitArgPrefixes[TrackedRope]
    results: OmitArgPrefixes[Results]
    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1"
    """Listen on this address; any but 127.0.0.1 lets other machines in, if they have the key in the address that is
    printed. It is not encrypted."""
    port: Annotated[int, arg(metavar="N")] = 9090
    """Listen on this port; 0: any that is free."""

    def run(self) -> int:
        from ropetrace.serving import ViewServer

        config = self.rope.settings(self.source.first_frames)
        predict = prediction(self.results.predict, config)
        pose = pose_of(config, self.results.frame)
        recording = self.source.open()
        with ViewServer(self.host, self.port, frame_name=self.results.frame, frame_from_camera=pose) as view:
            self._tell(view)
            try:
                return self._track(view, recording, config, predict)
            except KeyboardInterrupt:
                # The ordinary end, also where no frame has come yet; the second one is in earnest.
                if len(INTERRUPTS) > 1:
                    raise
                return 0

    def _track(
        self, view: ViewServer, recording: Recording, config: RopeConfig, predict: float | Literal["now"]
    ) -> int:
        from ropetrace.live import LiveRecording

        code = track(
            recording,
            config,
            list(self.results.out),
            predict=predict,
            start=self.source.part.start,
            limit=self.source.part.limit,
            mask=self.results.mask,
            frame=self.results.frame,
            overwrite=self.results.overwrite,
            extra_sinks=[_View(view, needed=not self.results.out)],
            inputs=[path for path in (self.rope.config, self.results.mask) if path is not None],
            served=True,
        )
        if view.skipped:
            print(f"view      skipped {view.skipped} frames to keep up")
        if not INTERRUPTS and not isinstance(recording, LiveRecording) and view.problem is None:
            print("the recording is over; the view stays until Ctrl-C", flush=True)
            with suppress(KeyboardInterrupt):
                view.wait()
                raise OutputError(f"{view.problem}: start it again")
        return code

    def _tell(self, view: ViewServer) -> None:
        if view.open_to_others:
            print(
                f"warning   {self.host} lets other machines in: nobody is asked for a password, whoever has the key in "
                "the address may look, and nothing is encrypted",
                file=sys.stderr,
            )
        print(f"view      {view.url}\nopen it in any browser; Ctrl-C ends it", flush=True)


class _View:
    """The view as a sink. If it ends, so does the run; but not where results are written."""

    def __init__(self, view: ViewServer, needed: bool) -> None:
        self._view = view
        self._needed = needed
        self._told = False

    def write(self, index: int, estimate: Any, frame: Any, cloud: Any) -> None:
        problem = self._view.problem
        if problem is not None:
            if self._needed:
                raise OutputError(f"{problem}: start it again")
            if not self._told:
                self._told = True
                print(f"warning   {problem}; the tracking goes on, and the results are written", file=sys.stderr)
        self._view.write(index, estimate, frame, cloud)
