"""The rope's physics: how fast it runs, and how it stands beside known figures.

    python benchmarks/physics.py [--seconds 300]

Time of a rope of ten links in a wind of 0.8 Hz, read at 60 Hz; the sweep of the wind's frequency beside that of an
earlier trial with another implementation; the free swing beside a hanging chain's; energy; and what a smaller step of
integration changes. One core.
"""

from __future__ import annotations

import argparse
import math
import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"

import time
from itertools import pairwise

import numpy as np

from ropetrace.sim import rope as rope_module
from ropetrace.sim.rope import GRAVITY, RopeModel, RopeSimulation, Wind
from ropetrace.types import FloatArray

TRIAL = {
    0.0: (0.0, 0.0, 0.0),
    0.1: (0.057, 0.034, 0.015),
    0.2: (0.060, 0.072, 0.030),
    0.4: (0.075, 0.177, 0.075),
    0.6: (0.123, 0.437, 0.180),
    0.7: (0.191, 0.829, 0.329),
    0.8: (0.283, 1.49, 0.564),
    0.9: (0.183, 1.00, 0.380),
    1.0: (0.111, 0.654, 0.243),
    1.2: (0.060, 0.407, 0.141),
    1.4: (0.044, 0.337, 0.105),
    1.6: (0.042, 0.354, 0.101),
}
"""Tip amplitude, highest speed and rms speed of the links at each frequency, by the trial."""


def speed(seconds: float) -> None:
    """Time of a long run."""
    for rate in (0, 60):
        start = time.perf_counter()
        simulation = RopeSimulation(RopeModel(), wind=Wind(0.8))
        for frame in range(round(seconds * rate)):
            simulation.advance(frame / rate)
            simulation.state()
        simulation.advance(seconds)
        took = time.perf_counter() - start
        read = f"read at {rate} Hz" if rate else "not read"
        print(f"{seconds:g} s of physics, {read}: {took:.2f} s, {seconds / took:.0f} times real time", flush=True)


def steady(frequency: float) -> tuple[float, float, float]:
    """Tip amplitude, highest and rms speed of the links from 20 s on, over 20 s."""
    simulation = RopeSimulation(RopeModel(), wind=Wind(frequency))
    tips, speeds = [], []
    for step in range(20 * 240):
        simulation.advance(20 + step / 240)
        state = simulation.state()
        tips.append(abs(state.polyline[-1, 0]))
        speeds.append(np.linalg.norm(state.velocities, axis=1))
    return max(tips), float(np.max(speeds)), float(np.sqrt(np.mean(np.square(speeds))))


def path(step: float, seconds: float = 10.0) -> FloatArray:
    """Joints at 10 Hz with another step."""
    kept, rope_module.TIMESTEP = rope_module.TIMESTEP, step
    try:
        simulation = RopeSimulation(RopeModel(damping=2e-5), wind=Wind(0.8))
        states = []
        for reading in range(1, round(10 * seconds)):
            simulation.advance(reading / 10)
            states.append(simulation.state().polyline)
    finally:
        rope_module.TIMESTEP = kept
    return np.array(states)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=300.0)
    options = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    speed(options.seconds)

    print("\nf Hz   tip amplitude m   highest speed m/s   rms speed m/s   (trial)")
    for frequency, trial in TRIAL.items():
        ours = steady(frequency)
        print(
            f"{frequency:4.1f}   {ours[0]:.3f} ({trial[0]:.3f})     {ours[1]:.3f} ({trial[1]:.3f})       "
            f"{ours[2]:.3f} ({trial[2]:.3f})",
            flush=True,
        )

    simulation = RopeSimulation(RopeModel(damping=2e-5), lift=5e-4)
    swing = []
    for reading in range(60 * 20):
        simulation.advance(reading / 20)
        swing.append(simulation.state().polyline[-1, 0])
    spectrum = np.abs(np.fft.rfft(np.hanning(len(swing)) * swing, 64 * len(swing)))
    chain = 1.2024 * math.sqrt(GRAVITY / RopeModel().length) / (2 * math.pi)
    print(f"\nfree swing {np.argmax(spectrum) / (64 * len(swing) / 20):.4f} Hz; a hanging chain's is {chain:.4f} Hz")

    simulation = RopeSimulation(RopeModel(damping=0.0), lift=0.05)
    energies = []
    for reading in range(200):
        simulation.advance(reading / 10)
        energies.append(simulation.energy())
    print(f"energy without wind and damping, 20 s: {np.ptp(energies) / abs(energies[0]):.1e} of it is lost or gained")

    print("\nstep        largest change of a joint in 10 s to half the step   ratio")
    halvings = [path(1 / (240 * 2**k)) for k in range(5)]
    before = math.nan
    for k, (coarse, fine) in enumerate(pairwise(halvings)):
        change = float(np.linalg.norm(fine - coarse, axis=2).max())
        print(f"1/{240 * 2**k:<5d} s   {change * 1e3:8.4f} mm {'':37s} {before / change:.2f}")
        before = change


if __name__ == "__main__":
    main()
