"""The simulator as a camera: a scenario that goes on in real time, without an end."""

from __future__ import annotations

import time

from ropetrace.errors import ConfigError
from ropetrace.live.camera import Capture
from ropetrace.sim.scenario import SimulatedScene, load_scenario
from ropetrace.types import RgbdFrame

SLOWEST_RATE = 2.0
"""Frames a second: below, a source looks as if it had stopped."""


class SimulatedCamera:
    """A scenario in real time. Its stamps count from its beginning, and it goes on past its duration.

    A frame comes when its exposure and the camera's latency are over. Where the machine is too slow for that, the time
    of the scenario goes slower: no frame is left out, and stamps and pictures always agree.

    Parameters
    ----------
    scenario : str
        A name of the package, or the path of a TOML file.

    Raises
    ------
    ConfigError
        If there is no such scenario, it is wrong, or its camera is slower than `SLOWEST_RATE`.
    MissingExtraError
        If MuJoCo is not installed.
    """

    kind = "simulated camera"

    def __init__(self, scenario: str) -> None:
        self._scenario = load_scenario(scenario)
        if self._scenario.camera.rate < SLOWEST_RATE:
            raise ConfigError(
                f"scenario {scenario}: camera.rate = {self._scenario.camera.rate:g} is too slow for a live source: "
                f"give {SLOWEST_RATE:g} or more frames a second"
            )
        self._begin()
        self._expose()  # what must be compiled is compiled before the clock starts

    def _begin(self) -> None:
        self._simulated = SimulatedScene(self._scenario)
        self._index = 0
        self._start = 0.0

    def connect(self) -> None:
        self._begin()
        self._start = time.monotonic()

    def fetch(self, timeout: float) -> Capture | None:
        camera = self._simulated.camera
        stamp = camera.stamp(self._index)
        due = self._start + camera.arrival(stamp)
        # As late as may be: right after a frame the tracker works on it, and both want the interpreter.
        asleep = min(max(due - 2 * self._expose_seconds - time.monotonic(), 0.0), timeout)
        time.sleep(asleep)
        if asleep == timeout:
            return None
        frame = self._expose()
        wait = due - time.monotonic()
        time.sleep(max(wait, 0.0))
        if wait < -1 / camera.rate:
            self._start -= wait
        self._index += 1
        return Capture(frame, time.monotonic_ns(), round((self._start + stamp) * 1e9))

    def disconnect(self) -> None:
        pass

    def _expose(self) -> RgbdFrame:
        camera = self._simulated.camera
        begin = time.monotonic()
        frame = camera.expose(self._simulated.scene_at, camera.stamp(self._index), self._index)
        self._expose_seconds = min(time.monotonic() - begin, 0.5 / camera.rate)
        return frame
