"""What to do next on the page of `ropetrace tune`: each trouble that shows in a frame, and its remedy, in words."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ropetrace.config import RopeConfig
from ropetrace.errors import ConfigError, FrameError
from ropetrace.proposal import propose_diameter
from ropetrace.things import depth_in_metres
from ropetrace.trackers.slicing import A_SURFACE, SlicingTracker
from ropetrace.tune_look import Look
from ropetrace.types import BadFrame, CloudFrame, Frame, RgbdFrame, Status, lacks_color

_OTHER = 1.5
"""A diameter that is wrong by more than this factor is told of."""

_CLOSE_STRANDS = "if no strands lie close together here, the diameter is too small: set a larger one"
_HIDDEN = "nothing, if something is in front of it; else raise the colour tolerance"

_REMEDIES = (
    ("as wide as a tube of", "press 'measure', or set the diameter"),
    ("make a single slice", "the diameter is too large: press 'measure', or set it"),
    (A_SURFACE, "lower the colour tolerance, or put a box round the rope"),
    ("is used: narrow", "lower the colour tolerance, or put a box round the rope"),
    ("background is taken for rope", "lower the colour tolerance, or press 'measure'"),
    (
        "slices are left out",
        "if parts of the rope are not green, raise the colour tolerance; if other things are, lower it, or use the box",
    ),
    ("something else of that colour is left out", "lower the colour tolerance, or put a box round the rope"),
    ("is taken for rope", "lower the colour tolerance, or put a box round the rope"),
    ("too few points", "raise the colour tolerance, or click on the rope again"),
    ("do not hang together", "raise the colour tolerance, or click on the rope again"),
    ("is bridged", "if parts of the rope are not green, raise the colour tolerance"),
    ("too short for a rope", "if parts of the rope are not green, click on it again; else press 'measure'"),
    ("curve turns back sharply", _CLOSE_STRANDS),
    ("strands overlap", _CLOSE_STRANDS),
    ("of the rope is hidden", _HIDDEN),
    (" m lately: a part is hidden", _HIDDEN),
    ("is the recording in millimetres", "give the depth its true unit in the recording"),
)
"""Words of a reason, and what to do about it; what is to be mended first comes first."""


@dataclass(frozen=True, slots=True)
class Advice:
    """What to do next.

    Parameters
    ----------
    kind : str
        "do": something is missing yet. "wrong": something is to be mended. "good": nothing is.
    text : str
        In a sentence or two.
    """

    kind: Literal["do", "wrong", "good"]
    text: str


def remedy_of(reason: str) -> str | None:
    """What to do about a reason to doubt an estimate, or None where nothing can be done on the page."""
    return next((remedy for words, remedy in _REMEDIES if words in reason), None)


def advice(look: Look, is_live: bool) -> Advice:
    """The one thing to do next.

    Parameters
    ----------
    look : Look
        What the settings make of a frame.
    is_live : bool
        Whether other frames come by themselves.
    """
    if isinstance(look.event, BadFrame):
        if is_live:
            return Advice("wrong", "The camera gives no frames. The page goes on by itself when it returns.")
        return Advice("wrong", "This frame is damaged: go to another one.")
    if not look.is_gated and not look.knows_diameter:
        return Advice("do", "Click on the rope in the image. The wheel zooms in on a thin one.")
    if not look.estimates:
        return Advice("do", "One moment.")
    if not len(look.cloud.points):
        return Advice("wrong", _why_nothing_passes(look.config, look.event))
    if A_SURFACE in look.estimates[0].reasons:
        return Advice("wrong", _how_to_narrow(look))
    if not look.knows_diameter:
        return Advice("do", "Press 'measure' for the diameter, or set it with its slider.")
    return _of_status(look, is_live)


def _of_status(look: Look, is_live: bool) -> Advice:
    others = "Watch it while the rope moves" if is_live else "Look at some other frames"
    if all(estimate.status is Status.OK for estimate in look.estimates):
        return Advice("good", f"The rope is followed. {others}, then save.")
    if look.age is None and (thickness := _another_thickness(look)) is not None:
        return Advice("wrong", thickness)
    reasons = [reason for estimate in look.estimates for reason in estimate.reasons]
    remedies = [remedy for words, remedy in _REMEDIES if any(words in reason for reason in reasons)]
    if not remedies:
        return Advice("wrong", f"The estimate is doubtful: {reasons[0]}.")
    if set(remedies) == {_HIDDEN}:
        return Advice("good", f"The rope is followed, and a part of it is hidden. {others}, then save.")
    return Advice("wrong", f"The estimate is doubtful: {remedies[0]}.")


def _another_thickness(look: Look) -> str | None:
    """That the rope looks far thicker or thinner than the diameter, if it does; takes some 50 ms."""
    if not isinstance(look.event, RgbdFrame) or look.config.color is None:
        return None
    try:
        seen = propose_diameter([look.event], look.config.color).diameter
    except (ConfigError, FrameError):
        return None
    if 1 / _OTHER < look.config.diameter / seen < _OTHER:
        return None
    return (
        f"The rope looks {seen * 1e3:.1f} mm thick, and the diameter is {look.config.diameter * 1e3:.1f} mm: "
        "press 'measure'."
    )


def _why_nothing_passes(config: RopeConfig, frame: Frame) -> str:
    if not _count_with_depth(frame):
        return "Nothing in this frame has depth: the camera is covered, too near, or looks at glass or into the sun."
    if config.asks_for_color and lacks_color(frame):
        return (
            "This frame has no colour, and the settings ask for one. Switch the colour of the camera on; or end this, "
            "and begin without a colour."
        )
    low, high = config.segmentation.box_min, config.segmentation.box_max
    if low is not None and high is not None:
        no_box = dataclasses.replace(config.segmentation, box_min=None, box_max=None)
        count = SlicingTracker(dataclasses.replace(config, segmentation=no_box)).rope_points(frame)[1]
        if count:
            return (
                f"Nothing passes: {count} points would, but lie outside the position box. Widen it, or press 'no box'."
            )
    if config.color is None:
        return "Nothing has the colours of the CIELAB box: click on the rope to take its colour in its place."
    return (
        f"Nothing passes the colour gate: nothing here is within {config.segmentation.color_tolerance:g} of "
        f"{config.color}. Click on the rope again, or raise the colour tolerance."
    )


def _how_to_narrow(look: Look) -> str:
    assert not isinstance(look.event, BadFrame)
    share = look.estimates[0].point_count / max(_count_with_depth(look.event), 1)
    if not look.config.asks_for_color:
        return (
            f"{share:.0%} of all points pass, not the rope alone. "
            + ("Click on the rope, or put" if look.has_color else "There is no colour to tell it by: put")
            + " a position box round it so that the table and the wall stay outside."
        )
    return (
        f"The gate takes more than the rope: {share:.0%} of all points pass. Lower the colour tolerance until the rope "
        "alone is green. If something else has its colour, put a position box round the rope."
    )


def _count_with_depth(frame: Frame) -> int:
    if isinstance(frame, CloudFrame):
        return int(np.count_nonzero(np.isfinite(frame.points).all(axis=1)))
    return int(np.count_nonzero(depth_in_metres(frame) > 0))
