"""The trackers, found by name."""

from __future__ import annotations

import difflib
from importlib import import_module

from ropetrace.config import RopeConfig
from ropetrace.errors import ConfigError
from ropetrace.trackers.base import Mask, Tracker
from ropetrace.trackers.persistent import PersistentTracker
from ropetrace.trackers.slicing import SlicingTracker
from ropetrace.types import FloatArray

METHODS = {
    "persistent": "PersistentTracker",
    "slicing": "SlicingTracker",
    "schulman": "SchulmanTracker",
    "cpd": "CpdTracker",
    "gltp": "GltpTracker",
    "spr": "SprTracker",
    "trackdlo": "TrackDloTracker",
    "cdcpd": "CdcpdTracker",
}
"""The trackers' classes, each in the module of its method's name."""

__all__ = ["METHODS", "Mask", "PersistentTracker", "SlicingTracker", "Tracker", "make_tracker"]


def make_tracker(config: RopeConfig, mask: Mask | None = None, nodes: FloatArray | None = None) -> Tracker:
    """The tracker that ``config.method`` names.

    Parameters
    ----------
    config : RopeConfig
        Settings; what is None is derived.
    mask : array or callable, optional
        Replaces the colour gate: see `ropetrace.trackers.base.Mask`.
    nodes : (M, 3) float array, optional
        Where to start, on the rope's axis, in order, metres, camera frame; M is the method's number of nodes. Without
        them a tracker starts from slicing. `slicing` and `persistent` take none.

    Raises
    ------
    ConfigError
        If no tracker has that name, or the nodes do not suit it.
    MissingExtraError
        If the method needs an optional dependency that is not installed.
    """
    if config.method not in METHODS:
        close = difflib.get_close_matches(config.method, METHODS, 1)
        hint = f"; did you mean {close[0]}?" if close else ""
        raise ConfigError(f"method = {config.method!r}: expected one of {', '.join(METHODS)}{hint}")
    if config.method in ("slicing", "persistent") and nodes is not None:
        raise ConfigError(f'method = "{config.method}" takes no nodes to start from')
    if config.method == "slicing":
        return SlicingTracker(config, mask)
    if config.method == "persistent":
        return PersistentTracker(config, mask)
    module = import_module(f"ropetrace.trackers.{config.method}")
    tracker: Tracker = getattr(module, METHODS[config.method])(config, mask, nodes)
    return tracker
