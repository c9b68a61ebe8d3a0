"""What every tracker is: frames in, estimates out, one at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ropetrace.types import BadFrame, Cloud, Estimate, Frame

Mask = NDArray[np.bool_] | Callable[[Frame], NDArray[np.bool_]]
"""True where the rope is: (H, W) for an image, (N,) for a cloud; or a function that makes one of a frame."""

Lap = Callable[[str], None]
"""Called with a stage's name when the stage has ended, so that whoever owns a clock can time it."""


def no_lap(stage: str) -> None:
    """Times nothing."""


class Tracker(Protocol):
    """Turns frames into estimates. It knows nothing of files or viewers, nor of clocks unless it is given a budget."""

    def update(self, frame: Frame | BadFrame, lap: Lap = no_lap) -> Estimate:
        """The estimate of one frame; of a bad frame, that it is lost.

        Parameters
        ----------
        frame : RgbdFrame, CloudFrame or BadFrame
            The next frame.
        lap : callable
            Told of the end of each stage.

        Raises
        ------
        FrameError
            If the frame lacks what the settings ask for, such as colour.
        """

    def cloud(self) -> Cloud:
        """The points of the last frame and their nodes: a copy."""

    def reset(self) -> None:
        """Forget the frames so far."""
