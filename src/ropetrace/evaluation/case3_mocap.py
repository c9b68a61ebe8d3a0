"""Case study 3's evaluation on real motion: recorded motion capture, whose depth is rendered."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ropetrace.config import RopeConfig, format_color
from ropetrace.errors import RecordingError
from ropetrace.evaluation.case3 import COLOR, Case3Settings, MarkerTrack, Tracked, camera_of, judged
from ropetrace.evaluation.methods import case_tracker
from ropetrace.sim.scene import Capsules, Scene
from ropetrace.suite.recorded import MARKER_RATE, curves_through
from ropetrace.types import RgbdFrame


def run_motion_capture(
    file: Path, sequence: int, method: str, settings: Case3Settings, radius: float = 0.006, every: int = 3
) -> Tracked:
    """A sequence of the motion capture of shared/data/deform_mocap, tracked and judged.

    The markers of each instant are joined by a spline; a tube round it is seen by the settings' camera with its noise.
    They are judged by themselves, as they were measured. Their clock is that of the rendered frames, so that none is
    looked for.

    Parameters
    ----------
    file : Path
        Such as DLO1_clean.npz: an array ``markers`` of (sequences, frames, M, 3), metres, 100 Hz.
    sequence : int
        Which.
    method : str
        As in `Case3`.
    settings : Case3Settings
        Those of the camera, and the seconds that are skipped, count.
    radius : float
        Of the tube, metres.
    every : int
        Of the recorded instants, every such is a frame.

    Raises
    ------
    RecordingError
        If the file cannot be read or does not hold the sequence.
    """
    try:
        with np.load(file, allow_pickle=False) as pack:
            recorded = np.asarray(pack["markers"][sequence], float)
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise RecordingError(f"{file}, sequence {sequence}: cannot be read: {error}") from None
    middle = (recorded.min(axis=(0, 1)) + recorded.max(axis=(0, 1))) / 2
    # The camera looks along y at the middle of all there is.
    seen = (recorded - middle)[..., [0, 2, 1]] * [1, -1, 1] + [0, 0, settings.distance]
    times = np.arange(len(seen)) / MARKER_RATE
    curves = curves_through(seen)
    camera = camera_of(settings, settings.seed + sequence, None)

    def frames() -> Iterable[RgbdFrame]:
        for index in range(0, len(seen), every):
            tube = Scene(Capsules.along(curves[index], radius, COLOR))
            yield camera.expose(lambda _, tube=tube: tube, float(times[index]), index)  # type: ignore[misc]

    config = RopeConfig(2 * radius, format_color(COLOR))
    return judged(frames(), MarkerTrack(times, seen), case_tracker(method, config, False), config, settings, None)
