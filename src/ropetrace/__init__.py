"""The live 3-D shape of a rope, cable or hose from the stream of an RGB-D camera."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ropetrace.config import RopeConfig
    from ropetrace.errors import RopetraceError
    from ropetrace.motion import make_motion
    from ropetrace.recordings import open_recording
    from ropetrace.trackers import make_tracker
    from ropetrace.types import BadFrame, CloudFrame, Estimate, Intrinsics, Motion, RgbdFrame, Status, Waypoints

_HOMES = {
    "BadFrame": "types",
    "CloudFrame": "types",
    "Estimate": "types",
    "Intrinsics": "types",
    "Motion": "types",
    "RgbdFrame": "types",
    "RopeConfig": "config",
    "RopetraceError": "errors",
    "Status": "types",
    "Waypoints": "types",
    "make_motion": "motion",
    "make_tracker": "trackers",
    "open_recording": "recordings",
}

__all__ = [
    "BadFrame",
    "CloudFrame",
    "Estimate",
    "Intrinsics",
    "Motion",
    "RgbdFrame",
    "RopeConfig",
    "RopetraceError",
    "Status",
    "Waypoints",
    "make_motion",
    "make_tracker",
    "open_recording",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that ``ropetrace --help`` does not wait for Numba."""
    if name in _HOMES:
        return getattr(import_module(f"ropetrace.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'ropetrace' has no attribute {name!r}")
