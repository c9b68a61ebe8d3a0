"""What the settings that are tuned make of one frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ropetrace.config import RopeConfig
from ropetrace.types import BadFrame, Cloud, Estimate, Event, FloatArray, lacks_color, moved

TUNED = (
    "diameter",
    "color",
    "segmentation.color_tolerance",
    "segmentation.box_min",
    "segmentation.box_max",
    "slicing.variance_threshold",
    "slicing.min_points",
)
"""The settings that can be changed."""


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """What the settings make of one frame.

    Parameters
    ----------
    index : int
        The frame's place in the recording, or in the frames that were taken from a live source.
    event : RgbdFrame, CloudFrame or BadFrame
        The frame.
    config : RopeConfig
        The settings.
    knows_diameter : bool
        Whether the diameter was given, set or measured.
    cloud : Cloud
        What passes; where too much does, every k-th point of it.
    slices : (K, 3) float array
        The centroids of its slices, metres, camera frame.
    estimates : tuple of Estimate
        One a rope; none as long as nobody has looked.
    age : float, optional
        Of a live frame when it was tracked, seconds; None for a frame that is held, or was recorded.
    """

    index: int
    event: Event
    config: RopeConfig
    knows_diameter: bool
    cloud: Cloud
    slices: FloatArray
    estimates: tuple[Estimate, ...]
    age: float | None = None

    @property
    def has_color(self) -> bool:
        """Whether there is anything for a colour gate to look at."""
        return not isinstance(self.event, BadFrame) and not lacks_color(self.event)

    @property
    def is_gated(self) -> bool:
        """Whether anything is kept out, or could not be for want of colour."""
        return self.config.asks_for_color or self.config.segmentation.box_min is not None or not self.has_color


def box_corners(config: RopeConfig) -> FloatArray | None:
    """The corners of the position box in the camera's frame, (8, 3), metres; the last axis changes fastest."""
    low, high = config.segmentation.box_min, config.segmentation.box_max
    if low is None or high is None:
        return None
    corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij")).reshape(3, -1).T
    if config.segmentation.box_frame == "world":
        corners = moved(corners, np.linalg.inv(config.world_from_camera()).astype(float))
    return corners
