"""What is known of a frame."""

from __future__ import annotations

from dataclasses import dataclass

from ropetrace.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What is true of a frame.

    Parameters
    ----------
    polyline : (K, 3) float array
        The rope's axis from its start to its end, metres, camera frame.
    visible_fraction : float
        Share of the rope's length that the camera sees, 0 to 1.
    """

    polyline: FloatArray
    visible_fraction: float
