"""The trackers that the experiments set side by side, by their names."""

from __future__ import annotations

from dataclasses import replace

from ropetrace.config import RopeConfig
from ropetrace.config_methods import SchulmanConfig
from ropetrace.errors import ConfigError
from ropetrace.trackers import METHODS, Tracker, make_tracker

TUNED = "schulman_tuned"
"""The method of Schulman et al. with the parameters that were tuned for case study 1; "schulman" has the published."""

SWINGING = SchulmanConfig(nodes=45, voxel=0.01, damping=0.25, steps=1, linear_damping=0.95, anchored=True)
"""Those parameters, for a swinging rope that hangs from its first waypoint: chosen by benchmarks/schulman.py."""

CASE_METHODS = (*METHODS, TUNED)
"""Every tracker, and `TUNED`."""


def check_method(method: str) -> None:
    """Refuse a method that is none of `CASE_METHODS`.

    Raises
    ------
    ConfigError
        If it is not.
    """
    if method not in CASE_METHODS:
        raise ConfigError(f"unknown method {method!r}: choose of {', '.join(CASE_METHODS)}")


def case_tracker(method: str, config: RopeConfig, anchored: bool = True) -> Tracker:
    """The tracker of a method, whatever `config` names.

    Parameters
    ----------
    method : str
        Of `CASE_METHODS`.
    config : RopeConfig
        Settings of the rope.
    anchored : bool
        Whether the rope hangs from its start, which only `TUNED` is told.

    Raises
    ------
    ConfigError
        If there is none of that name.
    MissingExtraError
        If it needs an optional dependency that is not installed.
    """
    check_method(method)
    if method == TUNED:
        return make_tracker(replace(config, method="schulman", schulman=replace(SWINGING, anchored=anchored)))
    return make_tracker(replace(config, method=method))
