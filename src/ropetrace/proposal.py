"""What a rope's colour and diameter probably are, from the first frames of a recording; a guess says how sure it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ropetrace.config import RopeConfig, SegmentationConfig, format_color, parse_color
from ropetrace.errors import ConfigError, FrameError
from ropetrace.outline import Mask, gate_of, silhouette_of, slice_widths, thin_ones
from ropetrace.segmentation import LINEAR_OF_SRGB, ColorGate
from ropetrace.things import connected, depth_in_metres, measured, surfaces
from ropetrace.types import Frame, RgbdFrame

_LOOKED_AT = 5
"""Of the frames given, this many are looked at, evenly spread from the first to the last."""

_ROPE = 20.0
"""A thing this many times longer than wide is as long as a rope must be."""

_MOST_CANDIDATES = 12

_LEAST_LIKENESS = 0.3
"""Less like a rope than this is not proposed."""

_STILL = 0.4
"""What a thing that stands still counts beside one that moves."""

_MOVED = 0.3
"""A thing moves if this share of its pixels, in the first and the last frame, is not common to both."""

_SECOND = 0.6
"""A second thing of this part of the largest one's length is worth telling."""

_NEAR_CLICK = 4
"""How far from a click the thing that is meant may lie, pixels."""

_DEPTH_SCALE = 0.015
"""Standard uncertainty of a depth camera's scale, and so of every width that it measures."""

_COLOR_EDGE, _DEPTH_EDGE = 0.1, 0.7
"""Standard uncertainty of a width because of blurred edges of colour, or lost ones of depth, pixels."""

_FEWEST_SLICES = 5

_PHASE = 0.41
"""Standard deviation of a width in whole pixels, where all of a rope's edges fall alike on the grid, pixels."""

_COARSE = 4.0
"""A rope that is fewer pixels wide is measured badly."""

_MOSTLY = 0.5
"""Less of what passes than this may not be the rope."""

_WIDTH_SPREAD = 0.4
"""Standard deviation of the logarithm of a thing's rough width about the diameter that is given."""

_UNEVEN = 0.15
"""A rope whose width varies by more than this part of it is told of."""

_RATIO, _SIGMAS = 1.3, 3.0
"""A given diameter is contradicted where it is wrong by more than both of these."""


@dataclass(frozen=True, slots=True)
class ColorCandidate:
    """A colour, and what passes its gate.

    Parameters
    ----------
    color : str
        In full light, ``#rrggbb``.
    likeness : float
        How much what passes is like a rope, 0 to 1: the thin things' share of it, less where they are short.
    length, second, width : float
        Length of the longest thin thing and of the next, and width of the longest, roughly, metres; 0 where there is
        none.
    moves : bool
        Whether it moves from the first frame to the last.
    thin_share : float
        Share of the passing surface that belongs to thin things, 0 to 1.
    """

    color: str
    likeness: float
    length: float
    second: float
    width: float
    moves: bool
    thin_share: float

    def text(self) -> str:
        """For people."""
        if not self.length:
            return f"{self.color}: nothing thin"
        return (
            f"{self.color}: {self.length:.2f} m long, about {self.width * 1e3:.0f} mm wide, "
            f"{'moves' if self.moves else 'stands still'}, {self.thin_share:.0%} of what passes is thin"
        )


@dataclass(frozen=True, slots=True)
class ColorProposal:
    """The colour to gate with.

    Parameters
    ----------
    color : str
        In full light, ``#rrggbb``: `RopeConfig.color`.
    confidence : float
        0 to 1: how much it is like a rope, and how far ahead of the next. No probability.
    reasons : tuple of str
        Why this one, and what to doubt, a sentence each.
    others : tuple of ColorCandidate
        The next best.
    """

    color: str
    confidence: float
    reasons: tuple[str, ...]
    others: tuple[ColorCandidate, ...] = ()


@dataclass(frozen=True, slots=True)
class DiameterProposal:
    """The diameter as it was measured.

    Parameters
    ----------
    diameter, sigma : float
        And its standard uncertainty, metres.
    pixels : float
        How many pixels the rope is wide.
    slices : int
        How many stretches of rope were measured, in all frames.
    reasons : tuple of str
        What to doubt, a sentence each.
    """

    diameter: float
    sigma: float
    pixels: float
    slices: int
    reasons: tuple[str, ...] = ()

    def text(self) -> str:
        """For people."""
        return f"{self.diameter * 1e3:.1f} mm +/- {self.sigma * 1e3:.1f} mm"


def propose_color(frames: Sequence[Frame], diameter: float | None = None) -> ColorProposal:
    """The colour of the largest thin thing, moving things first.

    Every surface of one colour that is long and thin in the first or the last frame is a candidate; its gate is tried
    on frames in between, and what passes is judged.

    Parameters
    ----------
    frames : sequence of frames
        The first 10 to 30 of a recording: images with colour.
    diameter : float, optional
        Of the rope, metres, where it is known.

    Raises
    ------
    ConfigError
        If nothing is like a rope.
    FrameError
        If there are no images with colour.
    """
    images = _spread(_images(frames, needs_color=True))
    ends = images if len(images) == 1 else [images[0], images[-1]]
    longest_first = sorted((thin for image in ends for thin in _thin_colors(image)), key=lambda thin: -thin[0])
    seeds = _different([color for _, color in longest_first])
    candidates = [_judge(color, images) for color in seeds[:_MOST_CANDIDATES]]
    ranked = sorted(candidates, key=lambda candidate: -_rank(candidate, diameter))
    if not ranked or ranked[0].likeness < _LEAST_LIKENESS:
        why = f"nothing in the first {len(frames)} frames is of one colour, thin and long like a rope"
        if seeds:
            why = f"the thin things ({', '.join(seeds[:3])}) do not differ enough in colour from larger ones"
        raise ConfigError(
            f"no colour can be proposed: {why}: give --color '#rrggbb', or --color @COLUMN,ROW of a pixel on the rope, "
            "and a position box where that passes too much"
        )
    best_one, others = ranked[0], ranked[1:4]
    margin = 1 - _rank(others[0], diameter) / _rank(best_one, diameter) if others else 1.0
    reasons = [best_one.text()]
    if others and margin < 0.5:
        reasons.append(f"nearly as good is {others[0].text()}")
    return ColorProposal(best_one.color, best_one.likeness * margin, tuple(reasons), tuple(others))


def propose_color_at(frame: Frame, column: int, row: int) -> ColorProposal:
    """The colour, in full light, of the thing under a pixel: of all its surface that looks alike.

    Raises
    ------
    ConfigError
        If the pixel is outside the image or nothing near it has depth.
    FrameError
        If the frame is no image with colour.
    """
    (image,) = _images([frame], needs_color=True)
    camera = image.intrinsics
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        raise ConfigError(f"the pixel {column},{row} lies outside the {camera.width}x{camera.height} image")
    labels = surfaces(image)
    rows, columns = np.nonzero(labels)
    away = (rows - row) ** 2 + (columns - column) ** 2
    if not len(away) or away.min() > _NEAR_CLICK**2:
        raise ConfigError(f"no pixel near {column},{row} has depth: choose one in the middle of the rope")
    nearest = int(np.argmin(away))
    label = labels[rows[nearest], columns[nearest]]
    color = _full_light(image, labels == label)
    judged = _judge(color, [image])
    reasons = [judged.text()]
    if judged.likeness < _LEAST_LIKENESS:
        reasons.append("what has this colour is not like a rope: something else is there, or background passes as well")
    return ColorProposal(color, judged.likeness, tuple(reasons))


def propose_diameter(frames: Sequence[Frame], color: str | None = None) -> DiameterProposal:
    """The diameter of the longest thin thing of a colour.

    Its outline in the colour image is measured slice by slice (`slice_widths`), at the rope's depth: depth itself is
    lost or wrong at the rope's edges. The standard uncertainty holds the scatter of the slices, the place of the edges
    on the pixel grid, their blur, and 1.5 % for the camera's scale of depth, which no recording can show.

    Parameters
    ----------
    frames : sequence of frames
        The first 10 to 30 of a recording: images.
    color : str, optional
        Of the rope in full light, ``#rrggbb``.

    Raises
    ------
    ConfigError
        If nothing thin is seen.
    FrameError
        If there are no images, or no colour where one is given.
    """
    images = _spread(_images(frames, needs_color=color is not None))
    by_image = [slices for image in images if len(slices := slice_widths(image, color))]
    slices = np.concatenate(by_image) if by_image else np.empty((0, 5))
    if len(slices) < _FEWEST_SLICES:
        what = "no thin thing is seen" if color is None else f"no thin thing of the colour {color} is seen"
        raise ConfigError(
            f"no diameter can be proposed: {what} in the first {len(frames)} frames: "
            "give --diameter, such as --diameter 12mm"
        )
    widths, pixel = slices[:, 0], float(np.median(slices[:, 2]))
    off = np.abs(widths - np.median(widths))
    sound = off <= max(3 * 1.4826 * float(np.median(off)), 1.5 * pixel)
    diameter = float(widths[sound].mean())
    uneven = 1.4826 * float(np.median(off)) / diameter
    # Where the rope crosses many columns and many rows, its edges fall on the grid in many ways.
    crossed = float(np.ptp(slices[sound, 3:], axis=0).min())
    sigma = np.sqrt(
        widths[sound].var() * len(by_image) / np.count_nonzero(sound)
        + (_PHASE * pixel / (1 + crossed)) ** 2
        + ((_DEPTH_EDGE if color is None else _COLOR_EDGE) * pixel) ** 2
        + slices[sound, 1].mean() ** 2
        + (_DEPTH_SCALE * diameter) ** 2
        + (widths.var() if uneven > _UNEVEN else widths[sound].var() / 4)
    )
    reasons = []
    if diameter < _COARSE * pixel:
        reasons.append(
            f"the rope is only {diameter / pixel:.1f} pixels wide: what lies behind may have lent it its depth"
        )
    if uneven > _UNEVEN:
        reasons.append(f"its width varies by {uneven:.0%}: strands overlap, or it is not one round rope")
    return DiameterProposal(diameter, float(sigma), diameter / pixel, int(np.count_nonzero(sound)), tuple(reasons))


def contradictions(config: RopeConfig, frames: Sequence[Frame]) -> list[str]:
    """What the first frames have against a rope's diameter and colour, a sentence each.

    Raises
    ------
    FrameError
        If there are no images, or no colour where one is given.
    """
    trouble = []
    seen = _judge(config.color, _spread(_images(frames, needs_color=config.color is not None)))
    if seen.thin_share < _MOSTLY:
        trouble.append(
            f"{1 - seen.thin_share:.0%} of the surface that passes is not thin like a rope: give another --color, or a "
            "position box"
        )
    if seen.second >= _SECOND * seen.length > 0:
        trouble.append(
            f"two thin things pass, {seen.length:.2f} m and {seen.second:.2f} m long: two ropes, or one whose middle "
            "is hidden; give a position box round the one that is meant"
        )
    try:
        found = propose_diameter(frames, config.color)
    except ConfigError as error:
        return [*trouble, str(error)]
    ratio = max(config.diameter / found.diameter, found.diameter / config.diameter)
    if ratio > _RATIO and abs(config.diameter - found.diameter) > _SIGMAS * found.sigma:
        trouble.append(
            f"what passes is {found.text()} thick, not {config.diameter * 1e3:.1f} mm: "
            f"if it is the rope, give --diameter {found.diameter * 1e3:.1f}mm"
        )
    return trouble


def _images(frames: Sequence[Frame], needs_color: bool) -> list[RgbdFrame]:
    images = [frame for frame in frames if isinstance(frame, RgbdFrame)]
    if not images:
        raise FrameError("only depth images can be looked at for a proposal: give --diameter and --color yourself")
    if needs_color and any(image.color is None for image in images):
        raise FrameError("the frames have no colour: leave out --color")
    return images


def _spread(images: list[RgbdFrame]) -> list[RgbdFrame]:
    chosen = np.unique(np.linspace(0, len(images) - 1, _LOOKED_AT).round().astype(int))
    return [images[index] for index in chosen]


def _thin_colors(image: RgbdFrame) -> list[tuple[float, str]]:
    """Length, metres, and colour in full light of the thin surfaces of an image."""
    things = measured(surfaces(image), depth_in_metres(image), image.intrinsics)
    lengths = np.where(thin_ones(things), things.lengths, 0.0)
    longest = np.argsort(-lengths, kind="stable")[:_MOST_CANDIDATES]
    return [
        (float(lengths[label]), _full_light(image, things.labels == label)) for label in longest if lengths[label] > 0
    ]


def _full_light(image: RgbdFrame, surface: Mask) -> str:
    """The colour of a surface where it is bright but does not glare: the median of the fifth below the brightest."""
    assert image.color is not None
    core = ndimage.binary_erosion(surface)
    colors = image.color[core if np.count_nonzero(core) > 0.25 * np.count_nonzero(surface) else surface]
    order = np.argsort(LINEAR_OF_SRGB[colors].sum(axis=1), kind="stable")
    bright = colors[order[int(0.75 * len(order)) : max(int(0.95 * len(order)), 1)]]
    return format_color(np.median(bright if len(bright) else colors, axis=0).astype(int))


def _different(colors: list[str]) -> list[str]:
    """Without those that are shades of others: the brighter stays."""
    kept: list[str] = []
    gates: list[ColorGate] = []
    for color in sorted(dict.fromkeys(colors), key=lambda color: -sum(parse_color(color))):
        rgb = np.array(parse_color(color), np.uint8)
        if not any(gate.accepts(rgb) for gate in gates):
            kept.append(color)
            gates.append(ColorGate.around_color(parse_color(color), SegmentationConfig().color_tolerance / 2))
    return [color for color in dict.fromkeys(colors) if color in kept]


def _judge(color: str | None, images: list[RgbdFrame]) -> ColorCandidate:
    """What passes a colour's gate in some frames."""
    gate = gate_of(color)
    rows = []
    silhouettes = []
    for image in images:
        depth = depth_in_metres(image)
        silhouettes.append(silhouette_of(image, depth, gate))
        things = measured(connected(silhouettes[-1]), depth, image.intrinsics)
        thin = thin_ones(things)
        lengths = np.sort(np.concatenate([[0.0, 0.0], things.lengths[thin]]))
        longest = int(np.argmax(np.where(thin, things.lengths, 0.0)))
        width = things.widths[longest] if thin.any() else 0.0
        rows.append((lengths[-1], lengths[-2], width, things.areas[thin].sum() / max(things.areas[1:].sum(), 1e-12)))
    length, second, width, share = (float(value) for value in np.median(rows, axis=0))
    both, either = silhouettes[0] & silhouettes[-1], silhouettes[0] | silhouettes[-1]
    moves = np.count_nonzero(both) < (1 - _MOVED) * np.count_nonzero(either)
    likeness = share * min(length / max(width, 1e-9) / _ROPE, 1.0)
    return ColorCandidate(color or "any colour", likeness, length, second, width, bool(moves), share)


def _rank(candidate: ColorCandidate, diameter: float | None) -> float:
    """The order among candidates: like a rope, long, moving, and of the diameter if it is known."""
    fits = 1.0
    if diameter is not None and candidate.width:
        fits = float(np.exp(-0.5 * (np.log(candidate.width / diameter) / _WIDTH_SPREAD) ** 2))
    return candidate.likeness * candidate.length * (1.0 if candidate.moves else _STILL) * fits
