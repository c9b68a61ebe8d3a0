"""Writes a simulated recording, and the truth beside it."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ropetrace.errors import OutputError
from ropetrace.recordings.mcap_file import McapFrameWriter
from ropetrace.recordings.rgbd_folder import RgbdFolderWriter
from ropetrace.results.base import check_place, uninterrupted, writing
from ropetrace.results.checkpoint import Checkpoint
from ropetrace.sim.scenario import Scenario, SimulatedScene, Truth

_NO_FOLDERS = (".bag", ".db3", ".npy", ".npz", ".ply", ".pcd", ".png", ".csv", ".parquet", ".rrd", ".mp4")
"""Endings of files that are not written here; whoever gives one does not mean a folder."""

_FOLDER_CONTENT = ("depth", "rgb", "depth.txt", "rgb.txt", "camera.json")


class Recorder:
    """A scenario on its way to disk. Everything that can be wrong is refused before anything is written.

    Parameters
    ----------
    scenario : Scenario
        What is simulated.
    out : Path
        The recording: a new .mcap file, or a new folder (RGB-D, as in the TUM data sets).
    overwrite : bool
        Replace what is there.

    Raises
    ------
    ConfigError
        If the scenario is impossible.
    OutputError
        If `out` cannot hold it.
    """

    def __init__(self, scenario: Scenario, out: Path, overwrite: bool = False) -> None:
        self.out = out
        self.truth_path = truth_path(out)
        self.frames_done = 0
        self._simulated = SimulatedScene(scenario)
        self._overwrite = overwrite
        self._truth = _TruthTable(scenario, self._simulated.world_from_camera)
        unit = self._simulated.camera.depth_unit
        if not _is_mcap(out):
            if out.suffix.lower() in _NO_FOLDERS:
                raise OutputError(f"{out}: a recording is an .mcap file or a folder; {out.suffix} is not written")
            if unit is None:
                raise OutputError(
                    f"{out}: the scenario's camera gives float depth (exact_depth = true), which the PNG images of a "
                    f"folder cannot hold: give {out.name}.mcap"
                )
        elif unit not in (None, 0.001):
            raise OutputError(
                f"{out}: depth_unit = {unit}: MCAP holds millimetres (0.001) or exact_depth; or write a folder"
            )
        self._check_place()

    def _check_place(self) -> None:
        if _is_mcap(self.out):
            for path in (self.out, self.truth_path):
                check_place(path)
                if path.exists() and not self._overwrite:
                    raise OutputError(f"{path} exists already: choose another name or give --overwrite")
            return
        with writing(self.out):
            if self.out.exists() and not self.out.is_dir():
                raise OutputError(f"{self.out} is a file: give the name of a folder, or of an .mcap file")
            if not self.out.exists() or not any(self.out.iterdir()):
                return
            if not self._overwrite:
                raise OutputError(f"{self.out} is not empty: choose another name or give --overwrite")
            if not self.truth_path.exists():
                raise OutputError(f"{self.out} holds no simulated recording (no {self.truth_path.name}): it is kept")

    def _clear(self) -> None:
        """Take away what is to be replaced."""
        with writing(self.out):
            if _is_mcap(self.out):
                self.out.unlink(missing_ok=True)
                self.truth_path.unlink(missing_ok=True)
                return
            for name in (*_FOLDER_CONTENT, self.truth_path.name):
                path = self.out / name
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path)
                else:
                    path.unlink(missing_ok=True)

    def run(self, on_frame: Callable[[], object] = lambda: None) -> None:
        """Write all frames. Interrupted, what was written is whole: as many truths as frames.

        Parameters
        ----------
        on_frame : callable
            Is told of every frame.
        """
        if self._overwrite:
            self._clear()
        camera = self._simulated.camera
        unit = 1.0 if camera.depth_unit is None else camera.depth_unit
        with (McapFrameWriter if _is_mcap(self.out) else RgbdFolderWriter)(self.out, camera.intrinsics, unit) as writer:
            checkpoint = Checkpoint(self.truth_path, False, self._truth.save)
            try:
                for frame, truth in self._simulated.frames():
                    with uninterrupted():
                        writer.write(frame)
                        self._truth.add(frame.stamp_ns, truth)
                        self.frames_done += 1
                    checkpoint.write_if_due()
                    on_frame()
            finally:
                checkpoint.write(last=True)


def truth_path(recording: Path) -> Path:
    """Where the truth of a simulated recording is: beside a file, in a folder."""
    return recording.with_name(recording.name + ".truth.npz") if _is_mcap(recording) else recording / "truth.npz"


def _is_mcap(path: Path) -> bool:
    return path.suffix.lower() == ".mcap"


class _TruthTable:
    """What is true of every frame, as arrays."""

    def __init__(self, scenario: Scenario, world_from_camera: NDArray[np.float64]) -> None:
        self._links = scenario.rope.links
        self._scenario = json.dumps(dataclasses.asdict(scenario), indent=1)
        self._world_from_camera = world_from_camera
        self._stamps: list[int] = []
        self._truths: list[Truth] = []

    def add(self, stamp_ns: int, truth: Truth) -> None:
        self._stamps.append(stamp_ns)
        self._truths.append(truth)

    def save(self, file: BinaryIO) -> None:
        links, truths = self._links, self._truths
        np.savez(
            file,
            stamp_ns=np.array(self._stamps, np.int64),
            polyline=np.array([truth.polyline for truth in truths]).reshape(-1, links + 1, 3),
            link_quaternions=np.array([truth.link_quaternions for truth in truths]).reshape(-1, links, 4),
            link_centres=np.array([truth.state.centres for truth in truths]).reshape(-1, links, 3),
            link_velocities=np.array([truth.state.velocities for truth in truths]).reshape(-1, links, 3),
            visible_fraction=np.array([truth.visible_fraction for truth in truths], float),
            world_from_camera=self._world_from_camera,
            scenario=np.array(self._scenario),
        )
