"""Which colour image belongs to which depth image: the nearest stamp, within a bound."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from statistics import median_low
from typing import Generic, TypeVar

BUFFERED = 64
"""Messages of each stream that wait for their partner at most."""

BUFFERED_BYTES = 256 * 2**20
"""Bytes of each stream that wait for their partner at most."""

_KNOWN = 11
"""Colour images by whose stamps their usual distance is known; half of them must be there."""

Depth = TypeVar("Depth")
Color = TypeVar("Color")


def nearest(stamps_ns: Sequence[int], stamp_ns: int) -> int | None:
    """The index of the stamp nearest to `stamp_ns` in a rising sequence; the earlier of two equally near."""
    if not stamps_ns:
        return None
    right = bisect_left(stamps_ns, stamp_ns)
    if right == 0:
        return 0
    if right == len(stamps_ns) or stamp_ns - stamps_ns[right - 1] <= stamps_ns[right] - stamp_ns:
        return right - 1
    return right


class ColorReach:
    """How far from a depth image its colour may be: not as far as that of the frame beside it, when its own is lost.

    Parameters
    ----------
    max_gap_ns : int
        However far apart colour images are, nanoseconds.
    """

    def __init__(self, max_gap_ns: int) -> None:
        self._max_gap_ns = max_gap_ns
        self._stamps: deque[int] = deque(maxlen=_KNOWN)

    def learn(self, stamp_ns: int) -> None:
        """A colour image has come."""
        if self._stamps and stamp_ns < self._stamps[-1]:
            self._stamps.clear()
        self._stamps.append(stamp_ns)

    @property
    def reach_ns(self) -> int:
        """By the colour images that came last, nanoseconds."""
        return reach_of(list(self._stamps), self._max_gap_ns)


def reach_of(stamps_ns: Sequence[int], max_gap_ns: int) -> int:
    """Three quarters of the usual time between rising stamps, but `max_gap_ns` at most or where few are known.

    Over two steps each, since stamps of arrival may come in pairs.
    """
    if len(stamps_ns) < _KNOWN // 2:
        return max_gap_ns
    step = median_low(later - one for one, later in zip(stamps_ns, stamps_ns[2:], strict=False)) // 2
    return min(max_gap_ns, 3 * step // 4)


def reach_around(stamps_ns: Sequence[int], index: int, max_gap_ns: int) -> int:
    """`reach_of` the stamps about one place in a rising sequence."""
    return reach_of(stamps_ns[max(index - _KNOWN // 2, 0) : index + _KNOWN // 2 + 1], max_gap_ns)


def missing_color(gap_ns: int | None, max_gap_ns: int) -> str:
    """Why a depth image has no colour, for people."""
    found = "there is none" if gap_ns is None else f"the nearest is {gap_ns / 1e6:g} ms away"
    return f"no colour image within {max_gap_ns / 1e6:g} ms of this depth image ({found})"


class Pairing(Generic[Depth, Color]):
    """Pairs two streams that arrive interleaved, in buffers of bounded size.

    A depth image waits until a colour image of its own stamp or a later one has come (then no nearer one can
    follow), until the buffer is full, or until the stream ends. Depth images leave in the order in which they
    came. Where the clock is set back, images from before are not paired with images from after.

    Parameters
    ----------
    max_gap_ns : int
        Stamps farther apart than this are not paired, nor those beyond `ColorReach`, nanoseconds.
    """

    def __init__(self, max_gap_ns: int) -> None:
        self._max_gap_ns = max_gap_ns
        self._reach = ColorReach(max_gap_ns)
        self._depths: deque[tuple[int, Depth, int]] = deque()
        self._colors: deque[tuple[int, Color, int]] = deque()
        self._last_depth_ns: int | None = None

    def add_color(self, stamp_ns: int, color: Color, size: int) -> Iterator[tuple[int, Depth, Color | str]]:
        """Take a colour image of `size` bytes; yields what can leave."""
        if self._colors and stamp_ns < self._colors[-1][0] - self._max_gap_ns:
            yield from self.finish()
            self._colors.clear()
        self._colors.append((stamp_ns, color, size))
        self._reach.learn(stamp_ns)
        yield from self._leaving()
        while _overfull(self._colors):
            self._colors.popleft()

    def add_depth(self, stamp_ns: int, depth: Depth, size: int) -> Iterator[tuple[int, Depth, Color | str]]:
        """Take a depth image of `size` bytes; yields stamp, depth, and colour or why there is none."""
        if self._last_depth_ns is not None and stamp_ns < self._last_depth_ns - self._max_gap_ns:
            yield from self.finish()
            # Colour may have seen the clock go back before depth did; then it is of the new time already.
            if self._colors and self._colors[-1][0] > stamp_ns + self._max_gap_ns:
                self._colors.clear()
        self._last_depth_ns = stamp_ns
        self._depths.append((stamp_ns, depth, size))
        yield from self._leaving()

    def finish(self) -> Iterator[tuple[int, Depth, Color | str]]:
        """No more will come; yields what is left."""
        while self._depths:
            yield self._leave()

    def _leaving(self) -> Iterator[tuple[int, Depth, Color | str]]:
        while self._depths:
            stamp = self._depths[0][0]
            if not _overfull(self._depths) and not any(color[0] >= stamp for color in self._colors):
                return
            yield self._leave()

    def _leave(self) -> tuple[int, Depth, Color | str]:
        stamp, depth, _ = self._depths.popleft()
        # Of images that repeat a stamp the last belongs to the depth image that has just come.
        best = min(reversed(self._colors), key=lambda color: (abs(color[0] - stamp), color[0]), default=None)
        gap = None if best is None else abs(best[0] - stamp)
        reach = self._reach.reach_ns
        if best is None or gap is None or gap > reach:
            return stamp, depth, missing_color(gap, reach)
        return stamp, depth, best[1]


def _overfull(buffer: Iterable[tuple[int, object, int]]) -> bool:
    sizes = [size for _, _, size in buffer]
    return len(sizes) > BUFFERED or (len(sizes) > 1 and sum(sizes) > BUFFERED_BYTES)
