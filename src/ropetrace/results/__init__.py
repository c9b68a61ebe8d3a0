"""Writers of results, one file a format. `open_writer` chooses by the ending of the path."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import cast

from ropetrace.errors import OutputError
from ropetrace.results.base import ResultWriter, check_place
from ropetrace.types import FloatArray

__all__ = ["FORMATS", "ResultWriter", "check_outputs", "open_writer"]

FORMATS = MappingProxyType(
    {
        ".csv": ("ropetrace.results.text", "CsvWriter"),
        ".parquet": ("ropetrace.results.parquet", "ParquetWriter"),
        ".npz": ("ropetrace.results.arrays", "NpzWriter"),
        ".mcap": ("ropetrace.results.ros", "McapWriter"),
        ".rrd": ("ropetrace.results.rrd", "RrdWriter"),
    }
)
"""The endings that `open_writer` takes, each with the class that writes it."""

GROWING = frozenset({".parquet", ".npz"})
"""Those whose writer keeps all results in memory until the end, and writes them anew at each checkpoint."""

NO_METADATA: Mapping[str, str] = MappingProxyType({})
"""What is kept beside the results where nothing is given."""


def check_outputs(paths: Sequence[Path], overwrite: bool, inputs: Sequence[Path] = ()) -> None:
    """Refuse what `open_writer` would refuse, before any of several files is made.

    Parameters
    ----------
    paths : sequence of Path
        Where results will be written.
    overwrite : bool
        Whether files that are there already may be replaced.
    inputs : sequence of Path
        What is being read, files or folders: no output may be one of them or lie inside one, whatever `overwrite` says.

    Raises
    ------
    OutputError
        The message names the path.
    """
    places = [path.resolve() for path in paths]
    for path, place in zip(paths, places, strict=True):
        _check_ending(path)
        check_place(path)
        if places.count(place) > 1:
            raise OutputError(f"{path} is given twice as an output")
        if not path.exists():
            continue
        for source in inputs:
            if source.exists() and (path.samefile(source) or (source.is_dir() and source.resolve() in place.parents)):
                raise OutputError(f"{path} is, or belongs to, the input {source}: choose another name")
        if not overwrite:
            raise OutputError(f"{path} exists already: choose another name or give --overwrite")


def _check_ending(path: Path) -> None:
    if path.suffix.lower() not in FORMATS:
        raise OutputError(f"{path}: cannot tell the format from the ending {path.suffix!r}: use {', '.join(FORMATS)}")


def open_writer(
    path: str | Path,
    *,
    overwrite: bool = False,
    frame_name: str = "camera",
    metadata: Mapping[str, str] = NO_METADATA,
    frame_from_camera: FloatArray | None = None,
) -> ResultWriter:
    """Create a file for results.

    Parameters
    ----------
    path : path
        Its ending chooses the format: one of `FORMATS`.
    overwrite : bool
        Whether a file that is there already may be replaced.
    frame_name : str
        The frame of the positions that will be written: ``camera`` is the camera's optical frame.
    metadata : mapping of str to str
        Kept in the file beside the results (CSV has no room for it), such as the resolved configuration.
    frame_from_camera : (4, 4) float array, optional
        The camera's pose in the frame `frame_name`, if that is not ``camera``: where `.rrd` shows the images.

    Raises
    ------
    OutputError
        If the ending is unknown, the file exists and `overwrite` is not set, or it cannot be made.
    MissingExtraError
        If the format needs an extra that is not installed.
    """
    path = Path(path)
    _check_ending(path)
    module, name = FORMATS[path.suffix.lower()]
    writer = getattr(importlib.import_module(module), name)
    extra = {"frame_from_camera": frame_from_camera} if path.suffix.lower() == ".rrd" else {}
    return cast(
        ResultWriter,
        writer(path, overwrite=overwrite, frame_name=frame_name, metadata=metadata, **extra),
    )
