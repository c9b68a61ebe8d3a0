"""Watches the stamps of a live camera beside the times at which its frames come."""

from __future__ import annotations

from ropetrace.live.camera import Capture

MOST_NS = 1_000_000_000
"""A frame that is older than this when it comes, or from the future, has a stamp of a wrong clock; and a clock that
goes so far astray between two frames has jumped. Nanoseconds."""


class ClockWatch:
    """Counts what the stamps do that a clock would not.

    Attributes
    ----------
    frames : int
        Frames so far.
    """

    def __init__(self) -> None:
        self.frames = 0
        self._back = 0
        self._jumps = 0
        self._largest_ns = 0
        self._untrue = 0
        self._known = False
        self._last: Capture | None = None

    def add(self, capture: Capture) -> None:
        """Watch one more frame."""
        self.frames += 1
        self._known |= capture.moment_ns is not None
        self._untrue += capture.moment_ns is not None and not _plausible(capture)
        if self._last is not None:
            step = capture.event.stamp_ns - self._last.event.stamp_ns
            jump = step - (capture.arrival_ns - self._last.arrival_ns)
            self._back += step <= 0
            if abs(jump) > MOST_NS:
                self._jumps += 1
                self._largest_ns = max(self._largest_ns, abs(jump))
        self._last = capture

    def moment(self, capture: Capture) -> int:
        """When the frame was taken, on the clock of `time.monotonic_ns`; its arrival where that is not known."""
        if capture.moment_ns is None or not _plausible(capture):
            return capture.arrival_ns
        return capture.moment_ns

    def lines(self) -> list[str]:
        """What people must know of the clock; none if it is as it should be."""
        lines = []
        if self.frames and not self._known:
            lines.append("clock     the camera's clock is not this machine's: latency counts from the frames' arrival")
        if self._jumps:
            lines.append(
                f"clock     the stamps jumped {self._jumps} times, by {self._largest_ns / 1e9:.1f} s at most: "
                "velocities are wrong there"
            )
        if self._back:
            lines.append(f"clock     {self._back} stamps repeat the one before or run back")
        if self._untrue:
            lines.append(
                f"clock     {self._untrue} stamps are of the future or over {MOST_NS / 1e9:.0f} s old: "
                "their latency counts from their arrival"
            )
        return lines


def _plausible(capture: Capture) -> bool:
    return capture.moment_ns is not None and 0 <= capture.arrival_ns - capture.moment_ns <= MOST_NS
