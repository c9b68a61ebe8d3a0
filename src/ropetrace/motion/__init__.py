"""Velocities, accelerations and predictions of the waypoints (section 5.1). Arrays in, arrays out.

A method is found by its name: ``arc_length`` is the default, ``closest`` the paper's Algorithm 1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from ropetrace.errors import ConfigError
from ropetrace.motion.arc_length import ArcLengthMotion
from ropetrace.motion.closest import ClosestMotion
from ropetrace.types import FloatArray, Motion, Waypoints


class MotionEstimator(Protocol):
    """Follows the waypoints of one rope from frame to frame."""

    @property
    def stamp_ns(self) -> int | None:
        """Of the frame that predictions start from, nanoseconds: the last one that gave a motion; None without one."""

    def update(self, stamp_ns: int, waypoints: Waypoints) -> Motion | None:
        """Take the waypoints of a frame.

        A frame that is lost is simply not given. A stamp that repeats or runs back adds nothing, unless it stays so.

        Parameters
        ----------
        stamp_ns : int
            Of the frame, nanoseconds.
        waypoints : Waypoints
            W of them, in a frame that does not move.

        Returns
        -------
        Motion or None
            Of these waypoints; None where it is not known: at the first frame, after a pause, in a frame that does not
            fit the ones before.

        Raises
        ------
        ValueError
            If a coordinate is not a finite number.
        """

    def predict(self, ahead: float) -> tuple[FloatArray, Motion] | None:
        """Where the waypoints of the last frame that gave a motion are at a later time.

        Parameters
        ----------
        ahead : float
            Seconds after that frame's stamp, `stamp_ns`.

        Returns
        -------
        positions : (W, 3) float array
            Metres.
        motion : Motion
            At that time.

        Or None while there is none.
        """

    def reset(self) -> None:
        """Forget the frames so far."""


METHODS: dict[str, Callable[[float], MotionEstimator]] = {"arc_length": ArcLengthMotion, "closest": ClosestMotion}
"""By name; each takes the rope's diameter, metres."""


def make_motion(method: str, diameter: float) -> MotionEstimator | None:
    """The estimator of a name for a rope of a diameter in metres; None for ``none``.

    Raises
    ------
    ConfigError
        If there is no such method.
    """
    if method == "none":
        return None
    if method not in METHODS:
        raise ConfigError(f"unknown motion method {method!r}: choose of {', '.join([*METHODS, 'none'])}")
    return METHODS[method](diameter)
