"""The embedded sample: a short RGB-D recording of a swinging rope, made here, and tracked."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from ropetrace.errors import OutputError
from ropetrace.recordings.rgbd_folder import RgbdFolderWriter
from ropetrace.sim.camera import Capsules, Plane, RayCaster, Scene
from ropetrace.sim.noise import kinect_axial
from ropetrace.types import FloatArray, Intrinsics, RgbdFrame

CAMERA = Intrinsics(640, 480, 580.0, 580.0, 319.5, 239.5)
DIAMETER = 0.012
COLOR = (200, 40, 30)
FRAMES = 45
RATE = 30.0
_WALL = Plane((0.0, 0.0, 1.0), 1.5, (176, 170, 158), 1)
_LENGTH = 0.75


def rope_curve(seconds: float) -> FloatArray:
    """The true centreline at a time: (K, 3), metres, camera frame. A hanging rope with a wave running down it."""
    s = np.linspace(0, _LENGTH, 400)
    angle = 1.0 * (s / _LENGTH) * np.sin(2 * np.pi * (0.8 * seconds - 0.7 * s / _LENGTH))
    lean = 0.35 * (s / _LENGTH) * np.cos(2 * np.pi * 0.5 * seconds)
    steps = np.stack([np.sin(angle) * np.cos(lean), np.cos(angle) * np.cos(lean), np.sin(lean)], axis=1)
    curve = np.concatenate([np.zeros((1, 3)), np.cumsum((steps[1:] + steps[:-1]) / 2, axis=0) * (s[1] - s[0])])
    return curve + np.array([0.0, -0.36, 1.05])


def make_recording(folder: Path) -> None:
    """Write the sample as an RGB-D folder; whole or not at all.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    partial = folder.with_name(folder.name + ".partial")
    try:
        shutil.rmtree(partial, ignore_errors=True)
        rng = np.random.default_rng(0)
        caster = RayCaster(CAMERA)
        with RgbdFolderWriter(partial, CAMERA, 0.001) as writer:
            for index in range(FRAMES):
                image = caster.render(Scene(Capsules.along(rope_curve(index / RATE), DIAMETER / 2, COLOR), (_WALL,)))
                stamp_ns = round(index / RATE * 1e9)
                depth = kinect_axial(image.depth, rng)
                writer.write(RgbdFrame(stamp_ns, depth, 0.001, CAMERA, image.color))
        partial.rename(folder)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror or error}") from None
