"""A benchmark for trackers of ropes: named cases of a few seconds, each with its truth in every frame.

The cases are scenario files (`ropetrace.sim.scenario`), rendered when they are asked for: the same version gives the
same bytes. Recordings that no one may redistribute add cases where they are present; see `ropetrace.suite.recorded`.

>>> case = open_case("loop")
>>> frame, truth = next(case.frames())
>>> truth.polyline.shape
(101, 3)
"""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources
from typing import Protocol

from ropetrace.config import format_color
from ropetrace.errors import ConfigError
from ropetrace.sim.scenario import ROPE_COLOR, Scenario, SimulatedScene, load_scenario
from ropetrace.suite import recorded
from ropetrace.suite.truth import Truth
from ropetrace.types import Event

__all__ = ["SCENARIOS", "SUITE_VERSION", "Case", "ScenarioCase", "Truth", "cases", "open_case"]

SUITE_VERSION = "1"
"""Changes with every change of a case: figures of different versions are not comparable."""

SCENARIOS = (
    "still",
    "swing",
    "fast_swing",
    "tip_hidden",
    "middle_hidden",
    "occlusion_25",
    "occlusion_50",
    "occlusion_75",
    "loop",
    "crossing",
    "coil",
    "hairpin",
    "clutter",
    "two_ropes",
    "noise_kinect_v1",
    "noise_stereo",
)
"""The cases that every installation has, in the order of reports."""


class Case(Protocol):
    """A recording with what a tracker is told of the rope. It can be sent to another process.

    Attributes
    ----------
    name, description : str
        For reports.
    diameter : float
        Of the rope, metres.
    color : str, optional
        The rope's colour in full light; None where the frames have none.
    """

    @property
    def name(self) -> str: ...
    @property
    def description(self) -> str: ...
    @property
    def diameter(self) -> float: ...
    @property
    def color(self) -> str | None: ...

    def frames(self, limit: int | None = None) -> Iterator[tuple[Event, Truth | None]]:
        """Every frame with what is true of it, None where that is not known; may be called again."""
        ...


@dataclass(frozen=True, slots=True)
class ScenarioCase:
    """A case that is simulated.

    Parameters
    ----------
    name : str
        One of `SCENARIOS`.
    scenario : Scenario
        What is simulated.
    """

    name: str
    scenario: Scenario

    @property
    def description(self) -> str:
        """For reports."""
        return self.scenario.description

    @property
    def diameter(self) -> float:
        """Of the rope, metres."""
        return 2 * self.scenario.rope.radius

    @property
    def color(self) -> str:
        """The rope's colour in full light."""
        return format_color(ROPE_COLOR)

    def frames(self, limit: int | None = None) -> Iterator[tuple[Event, Truth]]:
        """Every frame with what is true of it."""
        for frame, truth in itertools.islice(SimulatedScene(self.scenario).frames(), limit):
            yield frame, Truth(truth.polyline, truth.visible_fraction)


def cases() -> tuple[str, ...]:
    """The cases of this installation: the scenarios, and the recordings that are present."""
    return SCENARIOS + recorded.names()


def open_case(name: str) -> Case:
    """A case by its name.

    Raises
    ------
    ConfigError
        If there is none of that name here; the message names the nearest.
    """
    if name in SCENARIOS:
        with resources.as_file(resources.files(__package__).joinpath("scenarios", f"{name}.toml")) as path:
            return ScenarioCase(name, load_scenario(str(path)))
    if name in recorded.names():
        return recorded.open_case(name)
    close = difflib.get_close_matches(name, cases(), 1)
    hint = f"; did you mean {close[0]}?" if close else ""
    raise ConfigError(f"unknown case {name!r}: choose of {', '.join(cases())}{hint}")
