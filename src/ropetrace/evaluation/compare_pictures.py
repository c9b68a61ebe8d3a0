"""What the page of a comparison shows: errors over time as SVG, and frames with the curves of all methods as PNG."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence

import numpy as np
from PIL import Image, ImageDraw

from ropetrace.evaluation.compare import Run
from ropetrace.picture import backdrop, pixels_of
from ropetrace.trackers import METHODS
from ropetrace.types import FloatArray, Frame, Status

_COLORS = ("#2f8fff", "#ff9f1c", "#2fbf71", "#e0569b", "#9b6bff", "#19b5b5", "#c9a800", "#e5484d")
"""Distinct from each other, and from light and dark grounds."""

_WIDTH, _HEIGHT = 860, 250
_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 12, 10, 30
_LOWEST, _HIGHEST = 0.1, 1000.0
"""Of the errors' axis, millimetres."""
_TICK = 5
_PICTURE_WIDTH = 520
_MARGIN = 0.12
"""Round what is shown of a frame, as a share of it."""


def color_of(method: str) -> str:
    """Of a method's curves and lines, ``#rrggbb``: always the same for those that ship."""
    place = list(METHODS).index(method) if method in METHODS else sum(map(ord, method))
    return _COLORS[place % len(_COLORS)]


def error_chart(runs: Mapping[str, Run]) -> str:
    """The symmetric mean of each method over time, as SVG; the length of the curves where there is no truth.

    Errors have a logarithmic axis. Marks above the axes, a row a method, are frames without an estimate (full) or
    degraded ones (pale). The grey ground is the share of the rope that the camera does not see.
    """
    first = next(iter(runs.values()))
    times = (first.stamp_ns - first.stamp_ns[0]) / 1e9
    known = first.has_truth
    top = _TOP + (_TICK + 1) * len(runs) + 4
    low, high = (_LOWEST, _HIGHEST) if known else _length_range(list(runs.values()))

    def x(time: float) -> float:
        return _LEFT + (_WIDTH - _LEFT - _RIGHT) * time / max(float(times[-1]), 1e-9)

    def y(value: float) -> float:
        share = math.log(max(value, low) / low) / math.log(high / low) if known else (value - low) / (high - low)
        return _HEIGHT - _BOTTOM - (_HEIGHT - _BOTTOM - top) * min(max(share, 0.0), 1.0)

    title = "Symmetric mean error over time" if known else "Length over time"
    parts = [f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{title}">']
    if known and (first.visible < 0.995).any():
        base = _HEIGHT - _BOTTOM
        hidden = [f"{x(t):.1f},{base - (base - top) * (1 - v):.1f}" for t, v in zip(times, first.visible, strict=True)]
        parts.append(f'<polygon class="hidden" points="{x(0)},{base} {" ".join(hidden)} {x(times[-1]):.1f},{base}"/>')
    for value in (0.1, 1, 10, 100, 1000) if known else np.linspace(low, high, 4):
        parts.append(
            f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y(value):.1f}" y2="{y(value):.1f}"/>'
        )
        label = f"{value:g} mm" if known else f"{value:.2f} m"
        parts.append(f'<text x="{_LEFT - 6}" y="{y(value) + 4:.1f}" text-anchor="end">{label}</text>')
    for time in _ticks(float(times[-1])):
        parts.append(f'<text x="{x(time):.1f}" y="{_HEIGHT - 10}" text-anchor="middle">{time:g} s</text>')
    step = (x(times[-1]) - x(0)) / max(len(times) - 1, 1)
    for row, (method, run) in enumerate(runs.items()):
        color = color_of(method)
        values = run.symmetric * 1e3 if known else run.length
        for stretch in _stretches(values):
            points = " ".join(f"{x(times[k]):.1f},{y(values[k]):.1f}" for k in stretch)
            if len(stretch) == 1:
                points += f" {points}"
            parts.append(f'<polyline stroke="{color}" points="{points}"><title>{method}</title></polyline>')
        for index, status in enumerate(run.status.tolist()):
            if status != Status.OK:
                pale = ' opacity="0.3"' if status == Status.DEGRADED else ""
                parts.append(
                    f'<rect x="{x(times[index]) - step / 2:.1f}" y="{_TOP + row * (_TICK + 1)}" width="{step:.1f}" '
                    f'height="{_TICK}" fill="{color}"{pale}/>'
                )
    return "".join([*parts, "</svg>"])


def frame_picture(frame: Frame, curves: Mapping[str, FloatArray], truth: FloatArray | None) -> bytes:
    """The part of a frame where the rope is, with the curves of all methods, as PNG.

    Where curves lie on each other, the first of them shows as the border of those after it.

    Parameters
    ----------
    frame : RgbdFrame or CloudFrame
        The ground.
    curves : mapping of method to (K, 3) float array
        Metres, camera frame; NaN where there is no estimate.
    truth : (K, 3) float array, optional
        The true curve, drawn thin and white.
    """
    ground, camera = backdrop(frame)
    lines = {method: pixels_of(curve[np.isfinite(curve).all(axis=1)], camera) for method, curve in curves.items()}
    true = None if truth is None or not np.isfinite(truth).all() else pixels_of(truth, camera)
    shown = [line for line in [*lines.values(), true] if line is not None and len(line)]
    left, top, right, bottom = _window(shown, ground.size)
    zoom = 2 * _PICTURE_WIDTH / (right - left)
    size = (2 * _PICTURE_WIDTH, round((bottom - top) * zoom))
    picture = ground.resize(size, Image.Resampling.BILINEAR, (left, top, right, bottom))
    draw = ImageDraw.Draw(picture)
    for row, (method, line) in enumerate(lines.items()):
        width = 5 + 3 * (len(lines) - 1 - row)
        _draw(draw, (line - [left, top]) * zoom, color_of(method), width)
    if true is not None:
        _draw(draw, (true - [left, top]) * zoom, "#ffffff", 2)
    stream = io.BytesIO()
    small = picture.resize((_PICTURE_WIDTH, size[1] // 2), Image.Resampling.LANCZOS)
    small.quantize(128, dither=Image.Dither.NONE).save(stream, format="png", optimize=True)
    return stream.getvalue()


def _draw(draw: ImageDraw.ImageDraw, line: FloatArray, color: str, width: int) -> None:
    if len(line) > 1:
        draw.line([(u, v) for u, v in line.tolist()], fill=color, width=width, joint="curve")


def _window(lines: Sequence[FloatArray], size: tuple[int, int]) -> tuple[float, float, float, float]:
    """What is shown of an image of this width and height, in the proportions 4:3: left, top, right, bottom."""
    width, height = size
    if not lines:
        return 0.0, 0.0, float(width), float(height)
    points = np.clip(np.concatenate(lines), 0, [width, height])
    low, high = points.min(axis=0), points.max(axis=0)
    wide, tall = ((high - low) * (1 + 2 * _MARGIN) + 20).tolist()
    wide, tall = max(wide, tall * 4 / 3), max(tall, wide * 3 / 4)
    shrink = min(1.0, width / wide, height / tall)
    wide, tall = wide * shrink, tall * shrink
    middle = ((low + high) / 2).tolist()
    left = max(min(middle[0] - wide / 2, width - wide), 0.0)
    top = max(min(middle[1] - tall / 2, height - tall), 0.0)
    return left, top, min(left + wide, float(width)), min(top + tall, float(height))


def _stretches(values: FloatArray) -> list[list[int]]:
    """Indices of finite values that follow each other."""
    finite = np.flatnonzero(np.isfinite(values))
    if not len(finite):
        return []
    return [part.tolist() for part in np.split(finite, np.flatnonzero(np.diff(finite) > 1) + 1)]


def _ticks(end: float) -> list[float]:
    """Round times from 0 on, eight at most."""
    step = 10 ** math.floor(math.log10(max(end, 1e-3) / 8))
    step *= next(factor for factor in (1, 2, 5, 10, 20) if end <= 8 * factor * step)
    return [round(k * step, 6) for k in range(int(end / step + 1e-9) + 1)]


def _length_range(runs: Sequence[Run]) -> tuple[float, float]:
    """Of the axis of lengths, metres."""
    lengths = np.concatenate([run.length for run in runs])
    lengths = lengths[np.isfinite(lengths)]
    if not len(lengths):
        return 0.0, 1.0
    low, high = float(lengths.min()), float(lengths.max())
    room = max(0.1 * (high - low), 0.02 * high, 1e-6)
    return max(low - room, 0.0), high + room
