"""Motion capture seen past a curtain: frames, the truth, and what of it is seen. Used by persistence.py.

As in mocap.py a tube round each curve is seen by a camera with a Kinect's noise. Before it a board as wide as a share
of the rope, seen from the camera, goes to and fro over all of it. It comes in from beside the rope, so that the first
frames see the whole of it, and crosses it in two seconds; both tips are hidden in turn.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ropetrace import RgbdFrame
from ropetrace.evaluation.metrics import at_equal_arc_length
from ropetrace.sim.camera import Capsules, RayCaster, Scene
from ropetrace.sim.noise import kinect_axial
from ropetrace.sim.scenario import ROPE_COLOR
from ropetrace.sim.scene import Boxes
from ropetrace.sim.visibility import visible_samples
from ropetrace.suite.recorded import CAMERA, mocap_curves
from ropetrace.types import FloatArray

RADIUS = 0.006
EVERY = 3
"""Of the 100 frames a second: 33 are used."""

NODES = 101
"""Places of the rope that are compared."""

_BEFORE = 0.15
"""From the rope's nearest point to the curtain, metres."""

_COMES_IN, _THERE_AND_BACK = 0.9, 4.0
"""Seconds of the curtain."""

_BESIDE = 0.02
"""Between the curtain and the rope at first, metres."""

_CURTAIN_COLOR = (60, 90, 160)
_WALL_COLOR = (150, 150, 140)


def curtain(curves: FloatArray, share: float, time: float) -> Boxes:
    """The board at a time, seconds; `share` of the rope's mean width in the view."""
    if share == 0:
        return Boxes.none()
    nearest = float(curves[..., 2].min()) - _BEFORE
    places = curves[..., 0] / curves[..., 2] * nearest
    left, right = places.min(axis=1), places.max(axis=1)
    width = share * float((right - left).mean())
    first, last = float(left.min()) + width / 2, float(right.max()) - width / 2
    if time < _COMES_IN:
        centre = first - (width + _BESIDE) * (1 + np.cos(np.pi * time / _COMES_IN)) / 2
    else:
        centre = first + (last - first) * (1 - np.cos(2 * np.pi * (time - _COMES_IN) / _THERE_AND_BACK)) / 2
    return Boxes.one((centre, 0.0, nearest), (width, 4.0, 0.005), _CURTAIN_COLOR, 2)


def views(
    rope: int, sequence: int, share: float, wall: bool = False
) -> Iterator[tuple[RgbdFrame, FloatArray, NDArray[np.bool_]]]:
    """Frames of a sequence behind a curtain; the true curve, metres, camera frame; and which of its nodes are seen.

    There are `NODES` of them at equal arc length.

    Parameters
    ----------
    rope, sequence, share
        Of the motion capture; and of the rope's width that the curtain hides, 0 for no curtain.
    wall : bool
        Whether there is one half a metre behind the rope.
    """
    times, curves = mocap_curves(rope, sequence, EVERY)
    rng = np.random.default_rng(1000 * rope + sequence)
    caster = RayCaster(CAMERA)
    back = float(curves[..., 2].max()) + 0.5
    walls = Boxes.one((0.0, 0.0, back), (20.0, 20.0, 0.01), _WALL_COLOR, 3) if wall else Boxes.none()
    for time, curve in zip(times, curves, strict=True):
        scene = Scene(Capsules.along(curve, RADIUS, ROPE_COLOR), boxes=curtain(curves, share, time) + walls)
        image = caster.render(scene)
        seen = visible_samples(scene, CAMERA, at_equal_arc_length(curve, NODES), RADIUS)
        depth = kinect_axial(image.depth, rng)
        yield RgbdFrame(round(time * 1e9), depth, 0.001, CAMERA, image.color.copy()), curve, seen
