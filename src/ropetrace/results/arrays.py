"""Results as NPZ: plain NumPy arrays."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ropetrace.results.base import MOTION_ARRAYS, Closing, motion_rows
from ropetrace.results.checkpoint import Checkpoint
from ropetrace.types import Cloud, Estimate, Frame


class NpzWriter(Closing):
    """Arrays that ``numpy.load(path, allow_pickle=False)`` reads.

    One entry an estimate, E in all: ``frame``, ``stamp_ns``, ``ahead_ns``, ``status``, ``reasons`` (one a line),
    ``point_count`` and ``rope``. All estimates end to end: ``nodes (sum M, 3)``, ``positions (sum W, 3)``,
    ``quaternions (sum W, 4)``, ``arc_length (sum W,)``, the arrays of `Motion`, ``(sum W, 3)`` each, and ``seen`` (1 or
    0) and ``tracker_sigma``, ``(sum W,)``; NaN for what is not known. ``node_offset`` and ``waypoint_offset`` have
    E + 1 entries: the waypoints of estimate i are ``positions[waypoint_offset[i]:waypoint_offset[i + 1]]``.
    ``metadata`` is a JSON text, ``frame_name`` in it.

    Raises
    ------
    OutputError
        If the file cannot be created or written.
    """

    def __init__(self, path: Path, *, overwrite: bool, frame_name: str, metadata: Mapping[str, str]) -> None:
        self._metadata = json.dumps({**metadata, "frame_name": frame_name}, ensure_ascii=False)
        self._estimates: list[tuple[int, int, int, str, str, int, int]] = []
        self._node_offset = [0]
        self._waypoint_offset = [0]
        self._parts: dict[str, list[NDArray[Any]]] = {
            "nodes": [np.empty((0, 3))],
            "positions": [np.empty((0, 3))],
            "quaternions": [np.empty((0, 4))],
            "arc_length": [np.empty(0)],
            **{name: [np.empty((0, 3))] for name in MOTION_ARRAYS},
            "seen": [np.empty(0)],
            "tracker_sigma": [np.empty(0)],
        }
        self._closed = False
        self._checkpoint = Checkpoint(path, overwrite, self._save)

    def write(self, index: int, estimate: Estimate, frame: Frame | None = None, cloud: Cloud | None = None) -> None:
        waypoints = estimate.waypoints
        self._estimates.append(
            (
                index,
                estimate.stamp_ns,
                estimate.ahead_ns,
                str(estimate.status),
                "\n".join(estimate.reasons),
                estimate.point_count,
                estimate.rope,
            )
        )
        self._node_offset.append(self._node_offset[-1] + len(estimate.nodes))
        self._waypoint_offset.append(self._waypoint_offset[-1] + len(waypoints))
        self._parts["nodes"].append(estimate.nodes)
        self._parts["positions"].append(waypoints.positions)
        self._parts["quaternions"].append(waypoints.quaternions)
        self._parts["arc_length"].append(waypoints.arc_length)
        for name, part in zip(MOTION_ARRAYS, np.hsplit(motion_rows(estimate), len(MOTION_ARRAYS)), strict=True):
            self._parts[name].append(part)
        unknown = np.full(len(waypoints), np.nan)
        self._parts["seen"].append(unknown if estimate.seen is None else estimate.seen.astype(float))
        self._parts["tracker_sigma"].append(unknown if estimate.position_sigma is None else estimate.position_sigma)
        self._checkpoint.write_if_due()

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._checkpoint.write(last=True)

    def _save(self, file: BinaryIO) -> None:
        for name, parts in self._parts.items():
            self._parts[name] = [np.concatenate(parts)]
        per_estimate = zip(*self._estimates, strict=True) if self._estimates else ((),) * 7
        frame, stamp_ns, ahead_ns, status, reasons, point_count, rope = per_estimate
        np.savez(
            file,
            frame=np.array(frame, np.int64),
            stamp_ns=np.array(stamp_ns, np.int64),
            ahead_ns=np.array(ahead_ns, np.int64),
            status=np.array(status, np.str_),
            reasons=np.array(reasons, np.str_),
            point_count=np.array(point_count, np.int64),
            rope=np.array(rope, np.int64),
            node_offset=np.array(self._node_offset, np.int64),
            waypoint_offset=np.array(self._waypoint_offset, np.int64),
            metadata=np.array(self._metadata),
            allow_pickle=False,
            **{name: parts[0] for name, parts in self._parts.items()},
        )
