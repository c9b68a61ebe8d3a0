"""Where an arm's joints are by now, from what it said last and what it was told since."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from operator import itemgetter

import numpy as np

from ropetrace.results.ros_estimates import NANOSECONDS
from ropetrace.ros.graph import MAX_FUTURE
from ropetrace.ros.messages import JointReading
from ropetrace.types import FloatArray

JOINTS_FRESH = 0.1
"""The arm brakes while its joints' newest positions are older than this, seconds."""

LONGEST_RESPONSE = 0.05
"""Of an arm, seconds."""


class CommandedMotion:
    """How far the joints had been sent by each moment of late: they hold each command until the next.

    Their own velocity would not do: by it they would seem to run away wherever messages are lost while they turn round.

    Parameters
    ----------
    rate : float
        Commands in a second, at most.
    response : float
        How much later the joints do what they are told, seconds.
    """

    def __init__(self, rate: float, response: float = 0.0) -> None:
        self._response = response
        kept = math.ceil((JOINTS_FRESH + LONGEST_RESPONSE) * rate) + 2
        self._commands: deque[tuple[float, FloatArray, FloatArray]] = deque(maxlen=kept)

    def command(self, now: float, velocity: FloatArray) -> None:
        """They are told this, (n,), rad/s, at a time in seconds since 1970."""
        if self._commands and self._commands[-1][0] >= now:
            self.forget()  # the clock was set back
        way = self._way_at(now) if self._commands else np.zeros(len(velocity))
        self._commands.append((now, way, velocity))

    def forget(self) -> None:
        """It is another arm."""
        self._commands.clear()

    def carried_on(self, now: float, reading: JointReading) -> FloatArray | None:
        """Where they are by now if they did what they were told, (n,), rad; None if the reading is not of now.

        Parameters
        ----------
        now : float
            Seconds since 1970.
        reading : JointReading
            What the arm told last.
        """
        age = now - reading.stamp_ns / NANOSECONDS
        if not -MAX_FUTURE <= age <= JOINTS_FRESH:
            return None
        if not self._commands or age <= 0:
            return reading.position
        return reading.position + self._way_at(now - self._response) - self._way_at(now - self._response - age)

    def _way_at(self, time: float) -> FloatArray:
        """How far they had been sent by a time, (n,), rad; where it is not known any more, as far as is known."""
        begun, way, velocity = self._commands[max(bisect_right(self._commands, time, key=itemgetter(0)) - 1, 0)]
        return way + max(time - begun, 0.0) * velocity
