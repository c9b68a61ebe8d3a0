"""Cases made of recordings that are not shipped: they are found in the folder `data_folder`, or are not there.

`mocap_1` and `mocap_2` are the motion capture of two shaken ropes (roahmlab/DEFORM), seen by a rendered camera: real
motion, an ideal sensor with a Kinect's published noise. `real_d435` are six depth images of a real rope on a table
(jingyi-xiang/bcpd-dlo-tracking), of which no truth is known.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from ropetrace.config import format_color
from ropetrace.evaluation.metrics import resample
from ropetrace.recordings import open_recording
from ropetrace.sim.camera import Capsules, RayCaster, Scene
from ropetrace.sim.noise import kinect_axial
from ropetrace.sim.scenario import ROPE_COLOR
from ropetrace.sim.visibility import visible_fraction
from ropetrace.suite.truth import Truth
from ropetrace.types import Event, FloatArray, Intrinsics, RgbdFrame

CAMERA = Intrinsics(640, 480, 615.0, 615.0, 319.5, 239.5)
"""That sees the motion capture."""

DISTANCE = 1.25
"""From that camera to the middle of the motion, metres."""

MARKER_RATE = 100.0
"""Of the motion capture, Hz."""

_EVERY = 3
_FRAMES = 100
_REAL_RATE = 5.0


def data_folder() -> Path:
    """Where the recordings are: $ROPETRACE_DATA, or shared/data beside a source checkout."""
    return Path(os.environ.get("ROPETRACE_DATA", Path(__file__).parents[4] / "shared" / "data"))


def names() -> tuple[str, ...]:
    """The cases whose recordings are present."""
    files = {
        "mocap_1": "deform_mocap/DLO1_clean.npz",
        "mocap_2": "deform_mocap/DLO2_clean.npz",
        "real_d435": "bcpd_rope_d435/intrinsics.json",
    }
    return tuple(name for name, file in files.items() if (data_folder() / file).is_file())


def open_case(name: str) -> MocapCase | RealCase:
    """One of `names`."""
    return RealCase() if name == "real_d435" else MocapCase(int(name.removeprefix("mocap_")))


def curves_through(markers: FloatArray) -> FloatArray:
    """Splines through the markers along a rope at each instant, (F, M, 3), metres: (F, 300, 3), metres."""
    places = np.linalg.norm(np.diff(markers, axis=1), axis=2).mean(axis=0)
    knots = np.concatenate([[0.0], np.cumsum(places)])
    return np.asarray(CubicSpline(knots, markers, axis=1)(np.linspace(0, knots[-1], 300)))


def mocap_curves(rope: int, sequence: int, every: int = _EVERY) -> tuple[FloatArray, FloatArray]:
    """Splines through the markers of the motion capture, seen by a camera that looks at their middle along y.

    Parameters
    ----------
    rope : int
        1 or 2.
    sequence : int
        Which recording of it, from 0.
    every : int
        Use every k-th of the 100 frames a second.

    Returns
    -------
    times : (F,) float array
        Seconds.
    curves : (F, 300, 3) float array
        Metres, camera frame.
    """
    with np.load(data_folder() / "deform_mocap" / f"DLO{rope}_clean.npz") as pack:
        markers = pack["markers"][sequence][::every].astype(float)
    curves = curves_through(markers)
    centred = curves - (curves.min(axis=(0, 1)) + curves.max(axis=(0, 1))) / 2
    camera = np.stack([centred[..., 0], -centred[..., 2], centred[..., 1] + DISTANCE], axis=-1)
    return np.arange(len(markers)) * every / MARKER_RATE, camera


@dataclass(frozen=True, slots=True)
class MocapCase:
    """Three seconds of a shaken rope, held at both ends.

    Parameters
    ----------
    rope : int
        1 or 2.
    """

    rope: int
    diameter: float = 0.012
    color: str = format_color(ROPE_COLOR)

    @property
    def name(self) -> str:
        """For reports."""
        return f"mocap_{self.rope}"

    @property
    def description(self) -> str:
        """For reports."""
        return f"Motion capture of shaken rope {self.rope}, rendered with a Kinect's noise"

    def frames(self, limit: int | None = None) -> Iterator[tuple[Event, Truth]]:
        """Every frame with what is true of it."""
        rng = np.random.default_rng(self.rope)
        caster = RayCaster(CAMERA)
        times, curves = mocap_curves(self.rope, 0)
        for time, curve in itertools.islice(zip(times, curves, strict=True), min(limit or _FRAMES, _FRAMES)):
            scene = Scene(Capsules.along(curve, self.diameter / 2, ROPE_COLOR))
            image = caster.render(scene)
            seen = visible_fraction(scene, CAMERA, resample(curve, 0.001), self.diameter / 2)
            depth = kinect_axial(image.depth, rng)
            yield RgbdFrame(round(time * 1e9), depth, 0.001, CAMERA, image.color.copy()), Truth(curve, seen)


@dataclass(frozen=True, slots=True)
class RealCase:
    """A real rope on a table, one end of which is lifted; only the rope has depth."""

    name: str = "real_d435"
    description: str = "Six depth images of a real rope by a RealSense D435; no truth"
    diameter: float = 0.006
    color: None = None

    def frames(self, limit: int | None = None) -> Iterator[tuple[Event, None]]:
        """Every frame; what is true of it is not known."""
        for event in open_recording(data_folder() / "bcpd_rope_d435", rate=_REAL_RATE).frames(limit=limit):
            yield event, None
