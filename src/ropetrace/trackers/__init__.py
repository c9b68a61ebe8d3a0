"""The trackers, found by name."""

from __future__ import annotations

from ropetrace.config import RopeConfig
from ropetrace.errors import ConfigError
from ropetrace.trackers.base import Mask, Tracker
from ropetrace.trackers.slicing import SlicingTracker

METHODS = {"slicing": SlicingTracker}

__all__ = ["METHODS", "Mask", "SlicingTracker", "Tracker", "make_tracker"]


def make_tracker(config: RopeConfig, mask: Mask | None = None) -> Tracker:
    """The tracker that ``config.method`` names.

    Parameters
    ----------
    config : RopeConfig
        Settings; what is None is derived.
    mask : array or callable, optional
        Replaces the colour gate: see `ropetrace.trackers.base.Mask`.

    Raises
    ------
    ConfigError
        If no tracker has that name.
    """
    if config.method not in METHODS:
        raise ConfigError(f"method = {config.method!r}: expected one of {', '.join(METHODS)}")
    return METHODS[config.method](config, mask)
