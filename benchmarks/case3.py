"""Case study 3: a dropped pipe in simulation, and the same evaluation on real motion.

    python benchmarks/case3.py --out /tmp/case3 --repeats 1
    python benchmarks/case3.py --mocap --sequences 2

The first writes case3.csv, case3.md and case3.png. The second renders the motion capture of
../shared/data/deform_mocap (or $ROPETRACE_DATA) for the same camera and prints a row for each sequence.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

import numpy as np

from ropetrace.evaluation.case3 import (
    HEIGHTS,
    Case3Settings,
    Tracked,
    choose_cases,
    run_case,
)
from ropetrace.evaluation.case3_mocap import run_motion_capture
from ropetrace.evaluation.case3_report import means_table, summary_table, write_report
from ropetrace.evaluation.methods import TUNED

DATA = Path(os.environ.get("ROPETRACE_DATA", Path(__file__).parents[2] / "shared" / "data"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--methods", default=f"slicing,schulman,{TUNED}")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--heights", default=",".join(f"{height * 1e3:g}" for height in HEIGHTS), help="mm")
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--marker-offset", type=float, default=0.0, help="mm")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--mocap", action="store_true", help="real motion in the place of the pipe")
    parser.add_argument("--sequences", type=int, default=2, help="of each rope")
    options = parser.parse_args()
    methods = options.methods.split(",")
    if options.mocap:
        motion_capture(methods, options.sequences)
        return
    settings = Case3Settings(duration=options.seconds, marker_offset=options.marker_offset / 1e3)
    heights = [float(height) / 1e3 for height in options.heights.split(",")]
    results = {}
    for case in choose_cases(methods, heights, options.repeats):
        start = time.perf_counter()
        results[case] = run_case(case, settings)
        print(f"{case.name}: {_shown(results[case])}, {time.perf_counter() - start:.1f} s", flush=True)
    print(summary_table(results), means_table(results), sep="\n\n")
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        print(*write_report(options.out, results, settings), sep="\n")


def motion_capture(methods: list[str], sequences: int) -> None:
    """A row for each rope, sequence and method."""
    for rope in (1, 2):
        for sequence in range(sequences):
            for method in methods:
                file = DATA / "deform_mocap" / f"DLO{rope}_clean.npz"
                tracked = run_motion_capture(file, sequence, method, Case3Settings())
                print(f"DLO{rope} {sequence} {method}: {_shown(tracked)}", flush=True)


def _shown(tracked: Tracked) -> str:
    return (
        f"linear {np.nanmean(tracked.linear) * 1e3:.2f} mm, symmetric {np.nanmean(tracked.symmetric) * 1e3:.2f} mm, "
        f"{np.count_nonzero(~np.isfinite(tracked.linear))} of {len(tracked.linear)} frames missing, "
        f"{np.mean(tracked.status == 'degraded'):.0%} degraded"
    )


if __name__ == "__main__":
    main()
