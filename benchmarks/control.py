"""The control step: its time, and 10^5 of them with all that can go wrong, in which no limit may be broken.

    python benchmarks/control.py --steps 100000

A Panda traces a rope that swings; its motion is predicted by the default estimator at every step.
"Choice to joints" is the part from the choice of the waypoint to the joints' velocities, `RopeTracer.step` alone. The
mass run is of the tracer, the guard and an arm that does what it is told; what is spoilt, and what is counted, is in
tests/test_controller.py (`spoil`) and tests/test_limits.py (`violations`): limits from their definitions alone.
"""

from __future__ import annotations

import argparse
import os
import sys

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"

import gc
import math
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from ropetrace.control.arm import Arm
from ropetrace.control.limits import Reason
from ropetrace.control.tracing import Phase, Step
from ropetrace.motion import make_motion
from test_controller import spoil
from test_limits import motions, violations
from tracing_rig import PERIOD, START, Loop, hanging

LENGTH = 480
"""Steps of a sequence."""


def show_times(arm: Arm, runs: int) -> None:
    """Of both parts, over whole tracings."""
    print("microseconds a step                    p50     p99   p99.9     max")
    for count in (75, 100):
        whole: list[float] = []
        choice: list[float] = []
        for _ in range(runs):
            loop = Loop(arm, hanging(count=count, swing=0.1))
            motion = make_motion("arc_length", 0.012)
            assert motion is not None
            loop.controller._motion = motion
            inner, outer = loop.controller.tracer.step, loop.controller.act

            def timed_step(*given: object, inner: object = inner) -> Step:
                begin = time.perf_counter()
                step: Step = inner(*given)  # type: ignore[operator]
                choice.append(1e6 * (time.perf_counter() - begin))  # noqa: B023
                return step

            loop.controller.tracer.step = timed_step  # type: ignore[method-assign, assignment]
            gc.disable()
            while True:
                loop.step_count += 1
                if loop.step_count % 8 == 1:
                    loop.controller.see(loop.estimate(loop.now - 0.01))
                begin = time.perf_counter()
                control = outer(loop.now, loop.q)
                whole.append(1e6 * (time.perf_counter() - begin))
                loop.q = loop.q + PERIOD * control.command.velocity
                if control.step is not None and control.step.phase.ended:
                    break
            gc.enable()
            assert control.step.phase is Phase.DONE
        for name, values in (("choice to joints", choice), ("act", whole)):
            row = np.percentile(values[20:], [50, 99, 99.9, 100])
            print(f"{count:4} waypoints, {name:18}" + "".join(f"{value:8.1f}" for value in row))


def show_braking(arm: Arm) -> None:
    """From the newest frame's stamp to the first command that brakes, of frames that cease at any time."""
    delays = []
    for phase in range(24):
        loop = Loop(arm, hanging(swing=0.1))
        for _ in range(120):
            loop.step()
        loop.blind = True
        stamp = loop.now - 0.01 - PERIOD * phase / 24
        loop.controller.see(loop.estimate(stamp))
        while loop.step().command.reason is not Reason.STALE:
            pass
        delays.append(1e3 * (loop.now - stamp))
    print(f"\nbraking begins {min(delays):.1f} to {max(delays):.1f} ms after the newest stamp")


def mass(arm: Arm, steps: int, chance: float) -> dict[str, int]:
    """Limits broken in sequences with faults; a third of them begin at ends of ranges or at singular poses."""
    rng = np.random.default_rng(round(1000 * chance))
    limits = arm.limits
    totals = {"braked": 0, "tracing": 0}
    for number in range(math.ceil(steps / LENGTH)):
        start = START
        if number % 3 == 0:
            ends = np.where(rng.random(7) < 0.5, limits.lower, limits.upper)
            singular = np.clip(np.zeros(7), limits.lower, limits.upper)
            odd = singular if rng.random() < 0.5 else rng.uniform(limits.lower, limits.upper)
            start = np.where(rng.random(7) < 0.3, ends, odd)
        loop = Loop(arm, hanging(swing=rng.uniform(0, 0.3)), start=start)
        for _ in range(LENGTH):
            control = spoil(rng, loop, chance)
            totals["braked"] += control.command.reason is not None
            totals["tracing"] += control.step is not None and control.step.phase is Phase.TRACING
            if loop.controller.tracer.phase.ended:
                loop.controller.tracer.reset()
            if control.command.reason is Reason.TRACKING and loop.controller.guard.at_rest:
                loop.controller.guard.reset(loop.q)
        commands = np.array(loop.commands)
        for name, count in violations(
            limits, PERIOD, motions(loop.start, commands, loop.measured, PERIOD), commands
        ).items():
            totals[name] = totals.get(name, 0) + count
    return totals


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--steps", type=int, default=100_000, help="of the mass run, for each share of faults")
    parser.add_argument("--tracings", type=int, default=10, help="whose steps are timed, for each count of waypoints")
    options = parser.parse_args()
    arm = Arm.named("panda")
    show_times(arm, options.tracings)
    show_braking(arm)
    broken = 0
    print(f"\n{options.steps} steps with faults, numbers that break a limit")
    for chance in (0.01, 0.1):
        begin = time.perf_counter()
        totals = mass(arm, options.steps, chance)
        broken += sum(count for name, count in totals.items() if name not in ("braked", "tracing"))
        text = ", ".join(f"{count} {name}" for name, count in totals.items())
        print(f"{chance:4.0%} each: {text}  ({time.perf_counter() - begin:.0f} s)", flush=True)
    if broken:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
