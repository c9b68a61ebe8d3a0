"""What makes an estimate doubtful, in words: an honest status is worth more than a curve."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numba import njit

from ropetrace.trackers.clouds import closest_places
from ropetrace.types import FloatArray

TOO_THIN, TOO_WIDE = 0.6, 1.5
"""Between these, in diameters, a rope may look wide: lost edges and coarse pixels make it thinner, noise wider."""

_FARTHEST = 50.0
"""No depth camera sees a rope from this far, metres."""

KINK = np.radians(100)
"""No rope turns by more than this from one slice to the next."""

_FEW_SLICES = 5
"""Fewer slices than this are no rope's shape: a ball has as many."""

_LENGTH_CHANGE = 0.15
"""A rope whose length differs by more than this share from what it was lately is partly hidden, or not alone."""

_LATELY = 31
"""Frames whose lengths are remembered."""

_LEAP_SECONDS = 60.0
"""No camera pauses for longer between two frames of one recording."""

_OVERLAP = 1.5
"""Strands whose axes come closer in the view than this, in diameters, may share slices."""

_GONE = 2.5
"""A strand that has been this far from another in the view, in diameters, comes back if it overlaps it later."""


class Doubts:
    """Looks at the frames of one rope and says what is wrong with them; remembers stamps and lengths.

    Parameters
    ----------
    diameter : float
        Of the rope, metres.
    """

    def __init__(self, diameter: float) -> None:
        self._diameter = diameter
        self._stamp_ns: int | None = None
        self._lengths: deque[float] = deque(maxlen=_LATELY)

    def of_stamp(self, stamp_ns: int) -> list[str]:
        """Whether the stamp follows on the one before, nanoseconds."""
        previous, self._stamp_ns = self._stamp_ns, stamp_ns
        if previous is None:
            return []
        if stamp_ns - previous > _LEAP_SECONDS * 1e9:
            return [f"the stamp leaps ahead by {(stamp_ns - previous) / 1e9:.0f} s"]
        if stamp_ns > previous:
            return []
        if stamp_ns == previous:
            return ["the stamp repeats that of the frame before"]
        return [f"the stamp runs back by {(previous - stamp_ns) / 1e9:.3f} s"]

    def of_shape(self, nodes: FloatArray, widths: FloatArray) -> list[str]:
        """What does not look like one tube of the stated diameter.

        Parameters
        ----------
        nodes : (M, 3) float array
            On the axis, in order, metres, camera frame.
        widths : (M,) float array
            How wide the slices look, metres.
        """
        trouble = self.of_widths(widths)
        if len(nodes) < _FEW_SLICES:
            trouble.append(f"only {len(nodes)} slices: too short for a rope, or the diameter is too large")
        if strands_overlap(nodes, self._diameter):
            trouble.append("strands overlap in the camera's view: the order there may be wrong")
        elif sharpest_turn(nodes) > KINK:
            trouble.append("the curve turns back sharply: the order there may be wrong")
        return trouble + self.of_distance(nodes)

    def of_widths(self, widths: FloatArray) -> list[str]:
        """What is too thin or too wide for the rope, from how wide the slices look, (M,), metres."""
        seen = float(np.median(widths))
        if not TOO_THIN * self._diameter < seen < TOO_WIDE * self._diameter:
            return [
                f"the points are as wide as a tube of {seen * 1e3:.1f} mm, not of "
                f"{self._diameter * 1e3:.1f} mm: the diameter is wrong, or something else passes the colour or the box"
            ]
        if np.count_nonzero(widths > 2 * self._diameter) > 0.1 * len(widths):
            return ["parts are far wider than the rope: a hand, a knot or a branch is taken for rope"]
        return []

    def of_distance(self, nodes: FloatArray) -> list[str]:
        """Whether nodes, (M, 3), metres, camera frame, are farther away than cameras see."""
        away = float(np.median(nodes[:, 2]))
        return [f"the points are {away:.0f} m away: is the recording in millimetres?"] if away > _FARTHEST else []

    def of_length(self, length: float, sound: bool) -> list[str]:
        """Whether the length is not what it was lately, in the frames that had nothing else wrong with them."""
        usual = float(np.median(self._lengths)) if self._lengths else length
        if sound:
            self._lengths.append(length)
        if abs(length - usual) <= _LENGTH_CHANGE * usual:
            return []
        return [f"the length is {length:.3f} m and was {usual:.3f} m lately: a part is hidden, or something is added"]


def strands_overlap(chain: FloatArray, diameter: float) -> bool:
    """Whether two stretches of a chain that are not neighbours overlap in the camera's view, or nearly.

    There the slices of both run into each other, and the way through is a guess.

    Parameters
    ----------
    chain : (M, 3) float array
        Nodes on the axis in order, metres, camera frame.
    diameter : float
        Of the rope, metres.
    """
    return bool(_strands_overlap(chain, diameter))


def sharpest_turn(chain: FloatArray) -> float:
    """The largest turn at a node of a chain, radians; 0 for fewer than three nodes."""
    return float(_sharpest_turn(chain))


@njit(cache=True, nogil=True)
def _strands_overlap(chain: Any, diameter: float) -> bool:
    count = len(chain)
    views = np.empty((count, 3))
    ranges = np.empty(count)
    for i in range(count):
        ranges[i] = max(np.sqrt(np.sum(chain[i] ** 2)), 1e-9)
        views[i] = chain[i] / ranges[i]
    for i in range(count - 1):
        gone = False
        for j in range(i + 2, count - 1):
            near = min(ranges[i], ranges[i + 1], ranges[j], ranges[j + 1])
            apart = closest_places(views[i], views[i + 1], views[j], views[j + 1])[2] * near
            # A rope that leads away from the camera stays close to itself in the view without overlapping.
            if gone and apart < _OVERLAP * diameter:
                return True
            gone = gone or apart > _GONE * diameter
    return False


@njit(cache=True, nogil=True)
def _sharpest_turn(chain: Any) -> float:
    least = 1.0
    for i in range(1, len(chain) - 1):
        before = after = product = 0.0
        for k in range(3):
            u, v = chain[i, k] - chain[i - 1, k], chain[i + 1, k] - chain[i, k]
            before += u * u
            after += v * v
            product += u * v
        least = min(least, product / max(np.sqrt(before * after), 1e-300))
    return np.arccos(max(least, -1.0))
