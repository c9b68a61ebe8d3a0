"""The motion guard: time of a step, and limits broken in a mass of commands, which must be none.

    python benchmarks/guard.py --steps 1000000 --faults 100000

Each line of the mass run is an arm and a period: sequences of random wishes, up to 100 times the limits, from random
poses, a third of the joints within reach of an end of their range or at it. Then wishes with faults: 1 % with
something not finite, 2 % stale, future stamps, clock jumps, wrong shapes, jumps and noise of the measured position.
What is counted is found from the commands and the definitions alone (`violations` in tests/test_limits.py). Last, what
it costs the other joints when one is at its end.
"""

from __future__ import annotations

import argparse
import math
import os
import sys

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from ropetrace.control.arm import JointLimits
from ropetrace.control.limits import MotionGuard
from ropetrace.control.tool_limits import ToolLimits
from ropetrace.types import FloatArray
from test_limits import FR3, HOME, PANDA, Rig, motions, violations

ARMS = {"panda": PANDA, "fr3": FR3}
PERIODS = (1 / 1000, 1 / 240, 1 / 30)
LENGTH = 1000
"""Steps of a sequence."""


def pose(rng: np.random.Generator, limits: JointLimits) -> FloatArray:
    """Anywhere, but a third of the joints close to an end of their range or at it."""
    distance = 10 ** rng.uniform(-7, 0, 7) * (rng.random(7) < 0.8)
    ends = np.where(rng.random(7) < 0.5, limits.upper - distance, limits.lower + distance)
    return np.where(rng.random(7) < 1 / 3, ends, rng.uniform(limits.lower, limits.upper))


def wish(rng: np.random.Generator, limits: JointLimits) -> FloatArray:
    """Up to 100 times the limits."""
    direction = rng.choice([-1.0, 1.0], 7) if rng.random() < 0.2 else rng.uniform(-1, 1, 7)
    return limits.velocity * direction * 10 ** rng.uniform(-3, 2)


def count_up(totals: dict[str, int], more: dict[str, int]) -> None:
    for name, count in more.items():
        totals[name] = totals.get(name, 0) + count


def mass(limits: JointLimits, period: float, steps: int, seed: int) -> dict[str, int]:
    """Limits broken in random sequences."""
    rng = np.random.default_rng(seed)
    totals: dict[str, int] = {}
    commands, places = np.empty((LENGTH, 7)), np.empty((LENGTH, 7))
    for _ in range(math.ceil(steps / LENGTH)):
        start = q = pose(rng, limits)
        guard = MotionGuard(limits, start, period)
        now, left, wanted = 0.0, 0, HOME
        for step in range(LENGTH):
            if not left:
                left, wanted = rng.integers(1, rng.choice([2, 10, 500])), wish(rng, limits)
            left -= 1
            now += period
            command = guard.step(now, q, wanted, now)
            assert command.reason is None, command.text
            commands[step], places[step] = command.velocity, q
            q = q + period * command.velocity
        count_up(totals, violations(limits, period, motions(start, commands, places, period), commands))
    return totals


def spoil(rng: np.random.Generator, given: dict[str, Any], last: float | None, period: float) -> bool:
    """Put one fault into what the guard is given, or none; whether it must brake.

    The clock jumps from the last time that the guard could read.
    """
    kind = rng.random()
    if kind < 0.01:
        name = rng.choice(["now", "measured", "desired", "stamp"])
        bad = rng.choice([np.nan, np.inf, -np.inf])
        given[name] = np.where(rng.random(np.shape(given[name])) < 0.5, bad, given[name])
        return not np.isfinite(given[name]).all()
    if kind < 0.03:
        given["stamp"] = given["now"] - rng.choice([0.11, 1, 1e9])
    elif kind < 0.04:
        given["stamp"] = given["now"] + rng.choice([0.03, 1, 1e9])
    elif kind < 0.05 and last is not None:
        given["now"] = last + rng.choice([-1e6, -1, -2 * period, -period, 0, 6 * period, 1e6])
        given["stamp"] = given["now"]
    elif kind < 0.06:
        shape = rng.choice([0, 1, 6, 8, 49])
        given[rng.choice(["measured", "desired"])] = np.zeros((7, 7) if shape == 49 else shape)
    elif kind < 0.07:
        given["hold"] = "the rope is lost"
    elif kind < 0.071:
        given["measured"] = given["measured"] + rng.choice([0.3, -3, 1e300])
    elif kind < 0.1:
        given["measured"] = given["measured"] + rng.uniform(-0.04, 0.04, 7)
        return False
    return kind < 0.04 or (kind < 0.05 and last is not None) or 0.05 <= kind < 0.071


def faults(limits: JointLimits, period: float, steps: int, seed: int) -> dict[str, int]:
    """Limits broken in sequences with faults, and faults at which the guard did not brake."""
    rng = np.random.default_rng(seed)
    totals: dict[str, int] = {"not braked": 0, "faults": 0}
    for _ in range(math.ceil(steps / LENGTH)):
        rig = Rig(period, limits, pose(rng, limits))
        resting, wanted, now, last = rng.random() < 0.3, wish(rng, limits), 0.0, None
        for _ in range(LENGTH):
            if rng.random() < 0.05:
                wanted = wish(rng, limits) * (not resting or rng.random() < 0.1)
            measured = rig.q + 0.002 * rng.normal(size=7)
            given: dict[str, Any] = {
                "now": now + period,
                "measured": measured,
                "stamp": now - 0.03,
                "desired": wanted,
                "hold": None,
            }
            brake = spoil(rng, given, last, period)
            command = rig.step(**given)
            if math.isfinite(given["now"]):
                now = last = float(given["now"])
            else:
                now += period
            totals["faults"] += brake
            totals["not braked"] += brake and command.reason is None
        commands = np.array(rig.commands)
        count_up(totals, violations(limits, period, motions(rig.start, commands, rig.measured, period), commands))
    return totals


def show_times() -> None:
    """A new wish each step, as a controller's, of which some lead to the ends of the joints' ranges."""
    print("microseconds a step, 7 joints       p50     p99   p99.9     max")
    rng = np.random.default_rng(0)
    tool = ToolLimits(low=[-1, -1, 0], high=[1, 1, 1])
    for period in (1 / 240, 1 / 1000):
        rig = Rig(period)
        times: dict[str, list[float]] = {"step": [], "velocity_bounds": [], "ToolLimits.scale": []}
        for step in range(60_000):
            if step % round(1 / period) == 0:
                wanted = wish(rng, PANDA)
                jacobian, place = rng.normal(size=(6, 7)), rng.uniform(-0.5, 0.5, 3)
            desired = wanted + 0.01 * rng.normal(size=7)
            marks = [time.perf_counter()]
            rig.guard.velocity_bounds(rig.q)
            marks.append(time.perf_counter())
            tool.scale(jacobian, place, desired)
            marks.append(time.perf_counter())
            rig.now += period
            command = rig.guard.step(rig.now, rig.q, desired, rig.now)
            marks.append(time.perf_counter())
            rig.q = rig.q + period * command.velocity
            for name, duration in zip(("velocity_bounds", "ToolLimits.scale", "step"), np.diff(marks), strict=True):
                times[name].append(1e6 * duration)
        for name, values in times.items():
            row = np.percentile(values[100:], [50, 99, 99.9, 100])
            print(f"{name:17}{1 / period:7.0f} Hz    " + "".join(f"{value:8.1f}" for value in row))


def show_freezing(count: int = 2000) -> None:
    """Speed along a random wish of norm 0.5 rad/s after 0.5 s, as a share of the wish."""
    print("\nspeed along a wish, share of it     mean   stopped")
    rng = np.random.default_rng(4)
    poses: dict[str, Callable[[], FloatArray]] = {
        "any pose": lambda: rng.uniform(PANDA.lower, PANDA.upper),
        "one joint at its end": lambda: np.where(np.arange(7) == rng.integers(7), PANDA.upper, HOME),
    }
    for name, draw in poses.items():
        for bounded in (False, True):
            shares = []
            for _ in range(count):
                rig = Rig(start=draw())
                wanted = rng.normal(size=7)
                wanted *= 0.5 / np.linalg.norm(wanted)
                for _ in range(120):
                    low, high = rig.guard.velocity_bounds(rig.q) if bounded else (wanted, wanted)
                    velocity = rig.step(np.minimum(np.maximum(wanted, low), high)).velocity
                shares.append(velocity @ wanted / 0.25)
            how = "in bounds" if bounded else "as it is"
            print(f"{name:21} {how:10}{np.mean(shares):8.3f}{np.mean(np.array(shares) < 0.01):10.1%}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--steps", type=int, default=100_000, help="of the mass run, for each arm and period")
    parser.add_argument("--faults", type=int, default=20_000, help="steps with faults, for each arm and period")
    options = parser.parse_args()
    show_times()
    broken = 0
    for title, work, count in (("mass run", mass, options.steps), ("faults", faults, options.faults)):
        print(f"\n{title}: {count} steps of 7 joints each, numbers that break a limit")
        for name, limits in ARMS.items():
            for seed, period in enumerate(PERIODS):
                begin = time.perf_counter()
                totals = work(limits, period, count, seed)
                broken += sum(totals.values()) - totals.get("faults", 0)
                text = ", ".join(f"{number} {what}" for what, number in totals.items())
                print(f"{name:6} 1/{1 / period:.0f} s: {text}  ({time.perf_counter() - begin:.0f} s)", flush=True)
    show_freezing()
    if broken:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
