"""The real rope of ../shared/data/bcpd_rope_d435: distance of its points to the centreline, frame by frame.

    python benchmarks/real_rope.py

There is no truth but a tracker's; so the points speak: those of the rope's near side lie a radius from the axis.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from ropetrace import BadFrame, RopeConfig, make_tracker, open_recording
from ropetrace.evaluation.metrics import distances_to_curve

DATA = Path(os.environ.get("ROPETRACE_DATA", Path(__file__).parents[2] / "shared" / "data"))


def main() -> None:
    if not DATA.is_dir():
        raise SystemExit(f"no recorded data in {DATA}: set ROPETRACE_DATA to their folder")
    tracker = make_tracker(RopeConfig(diameter=0.006))
    print("frame  status  points  nodes  length_m  mean_mm  p95_mm  moved_start_mm  moved_end_mm")
    before: np.ndarray | None = None
    for index, frame in enumerate(open_recording(DATA / "bcpd_rope_d435", rate=5).frames()):
        if isinstance(frame, BadFrame):
            raise SystemExit(frame.reason)
        estimate = tracker.update(frame)
        line = estimate.waypoints.positions
        distance = distances_to_curve(tracker.cloud().points, line) * 1e3
        ends = line[[0, -1]]
        moved = np.zeros(2) if before is None else np.linalg.norm(ends - before, axis=1) * 1e3
        before = ends
        print(
            f"{index:5d}  {estimate.status:6s}  {estimate.point_count:6d}  {len(estimate.nodes):5d}"
            f"  {estimate.waypoints.length:8.3f}  {distance.mean():7.2f}  {np.percentile(distance, 95):6.2f}"
            f"  {moved[0]:14.1f}  {moved[1]:12.1f}"
        )


if __name__ == "__main__":
    main()
