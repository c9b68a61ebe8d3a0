"""The errors that a caller may want to catch. Each message says what is wrong, where, and what to do."""

from __future__ import annotations

import importlib
from types import ModuleType


class RopetraceError(Exception):
    """The base of every error that ropetrace raises for bad input."""


class ConfigError(RopetraceError):
    """A setting is unknown or impossible."""


class RecordingError(RopetraceError):
    """A recording cannot be read, or not as it was asked for."""


class FrameError(RopetraceError):
    """One frame is unusable; the frames around it may be sound."""


class OutputError(RopetraceError):
    """A result cannot be written."""


class RosError(RopetraceError):
    """The live ROS graph cannot be joined as it was asked for."""


class MissingExtraError(RopetraceError):
    """A feature needs an optional dependency that is not installed."""


def import_extra(module: str, extra: str) -> ModuleType:
    """Import an optional dependency.

    Parameters
    ----------
    module : str
        The module's dotted name.
    extra : str
        The extra of ropetrace that installs it.

    Raises
    ------
    MissingExtraError
        If the module is not installed; the message names the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(
            f"this needs the package {module.partition('.')[0]!r} ({error}): pip install 'ropetrace[{extra}]'"
        ) from error
