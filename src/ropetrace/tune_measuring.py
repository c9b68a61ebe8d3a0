"""What a frame shows of its settings: the colour at a click, the diameter, a box. There is no state here."""

from __future__ import annotations

import dataclasses
from contextlib import suppress

import numpy as np

from ropetrace.config import RopeConfig, format_color
from ropetrace.errors import ConfigError
from ropetrace.picture import backdrop, pixels_of
from ropetrace.proposal import propose_color_at, propose_diameter
from ropetrace.trackers import make_tracker
from ropetrace.trackers.slicing import SlicingTracker
from ropetrace.types import CloudFrame, FloatArray, Frame, RgbdFrame, Status, moved

_NEAR_CLICK = 6.0
"""How far from a click the point of a cloud lies that is meant, pixels,"""

_ONE_THING = 0.01
"""and the others that make its colour, metres."""

_SETTLED = 0.02
"""A diameter that is measured on slices is found when it changes by less than this share."""

_MOST_ROUNDS = 12

_LOST_EDGES = (1.0, 1.25, 1.6, 2.0)
"""Depth alone loses the edges of a rope: it may be this many times as thick as it looks."""

_BOX_MARGIN = 0.05
"""Between what passes and the box round it, metres."""


def color_at(frame: Frame, column: int, row: int) -> tuple[str, list[str]]:
    """The colour in full light of the thing at a pixel, and what is to be said of it.

    A cloud's pixels are those of `ropetrace.picture.backdrop`.

    Raises
    ------
    ConfigError
        If there is nothing at that pixel.
    """
    if isinstance(frame, CloudFrame):
        return _color_in_cloud(frame, column, row), []
    proposal = propose_color_at(frame, column, row)
    return proposal.color, list(proposal.reasons)


def diameter_in(frame: Frame, config: RopeConfig) -> tuple[float, list[str]]:
    """The diameter of what the settings let pass of a frame, metres, and what is to be said of it.

    Raises
    ------
    ConfigError, FrameError
        If it cannot be measured.
    """
    if isinstance(frame, CloudFrame):
        diameter = _diameter_of_slices(frame, config)
        return diameter, [f"diameter {diameter * 1e3:.1f} mm, as the slices of the points show it: doubt it by a third"]
    size = propose_diameter([frame], config.color)
    said = [f"diameter {size.text()}", *size.reasons]
    if config.color is not None:
        return size.diameter, said
    diameter = _with_lost_edges(frame, config, size.diameter)
    return diameter, [*said, f"depth loses a rope's edges: {diameter * 1e3:.1f} mm is taken; set it if you know it"]


def box_round(points: FloatArray, config: RopeConfig) -> tuple[list[float], list[float]]:
    """The lowest and the highest corner of a box, in the frame of the settings' position box.

    Parameters
    ----------
    points : (N, 3) float array
        What it is to hold, metres, camera frame; a few that lie apart may stay outside.
    config : RopeConfig
        Says which frame that is.

    Raises
    ------
    ConfigError
        If there are no points.
    """
    if not len(points):
        raise ConfigError("nothing passes that a box could be put round")
    if config.segmentation.box_frame == "world":
        points = moved(points, config.world_from_camera())
    low, high = np.percentile(points, [1, 99], axis=0)
    return np.round(low - _BOX_MARGIN, 3).tolist(), np.round(high + _BOX_MARGIN, 3).tolist()


def _color_in_cloud(frame: CloudFrame, column: int, row: int) -> str:
    """The colour in full light of the points about the one at a pixel: the median of the brighter half."""
    assert frame.colors is not None
    camera = backdrop(frame)[1]
    ahead = np.isfinite(frame.points).all(axis=1) & (frame.points[:, 2] > 0)
    points = frame.points[ahead].astype(float)
    away = np.linalg.norm(pixels_of(points, camera) - [column, row], axis=1)
    if not len(away) or away.min() > _NEAR_CLICK:
        raise ConfigError(f"there is no point near {column},{row}: choose one on the rope")
    near = frame.colors[ahead][np.linalg.norm(points - points[np.argmin(away)], axis=1) <= _ONE_THING]
    bright = near[np.argsort(near.sum(axis=1), kind="stable")[len(near) // 2 :]]
    return format_color(np.median(bright, axis=0).astype(int))


def _diameter_of_slices(frame: CloudFrame, config: RopeConfig) -> float:
    """The diameter at which the slices are as wide as it says."""
    diameter = config.diameter
    with suppress(ConfigError):  # thinner or thicker than any rope
        for _ in range(_MOST_ROUNDS):
            tracker = SlicingTracker(dataclasses.replace(config, diameter=diameter))
            tracker.update(frame)
            before, diameter = diameter, tracker.seen_diameter
            if abs(diameter - before) < _SETTLED * before:
                return diameter
    raise ConfigError("the points show no diameter: set it with its slider")


def _with_lost_edges(frame: RgbdFrame, config: RopeConfig, diameter: float) -> float:
    """The thinnest that a rope may be that looks this thick without colour, and is then followed well."""
    for times in _LOST_EDGES:
        tracker = make_tracker(dataclasses.replace(config, diameter=times * diameter))
        if tracker.update(frame).status is Status.OK:
            return times * diameter
    return diameter
