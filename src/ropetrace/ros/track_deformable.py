"""The paper's node track_deformable: images or clouds in, the centreline out."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from ropetrace.config import RopeConfig
from ropetrace.results.ros_estimates import DIAGNOSTICS, PATH, estimate_status, header, topic_of
from ropetrace.results.ros_packed import pack_path, pack_poses
from ropetrace.ros.graph import MAX_FUTURE, Publisher, RosNode
from ropetrace.ros.live_camera import CameraTopics, LiveCamera, Seen
from ropetrace.ros.messages import POSES
from ropetrace.ros.reporting import Reporter
from ropetrace.trackers import make_tracker
from ropetrace.tracking import estimates_of
from ropetrace.types import Estimate, Status

if TYPE_CHECKING:
    from ropetrace.ros.robot_filter import RobotFilter


class TrackDeformable:
    """Tracks what a camera sends, and publishes for each rope ``centerline``, ``poses`` and ``status``.

    A lost frame is a path without poses. A frame that comes while another is worked on replaces the one that waits.

    Parameters
    ----------
    node : RosNode
        Of the graph.
    config : RopeConfig
        Of the rope.
    topics : CameraTopics
        What is read.
    robot : RobotFilter, optional
        Takes the arm out of the images.
    """

    def __init__(
        self,
        node: RosNode,
        config: RopeConfig,
        topics: CameraTopics | None = None,
        robot: RobotFilter | None = None,
    ) -> None:
        self._node = node
        self._tracker = make_tracker(config)
        self._camera = LiveCamera(node, topics or CameraTopics(), config.asks_for_color)
        self._robot = robot
        self._reporter = Reporter(node)
        self._outputs: dict[int, dict[str, Publisher]] = {}
        self._output(0)
        self._frames = 0

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Track until told to stop."""
        while not should_stop():
            self._node.wait(0.1)
            self.step()

    def step(self) -> None:
        """Track the newest frame, if there is a new one."""
        seen = self._camera.take()
        problem = self._camera.problem()
        if seen is not None:
            self._reporter.heard()
            self._frames += 1
            if self._robot is not None:
                seen = replace(seen, event=self._robot.clear(seen.event))
                problem = "; ".join(filter(None, [problem, self._robot.fault]))
            self._publish(seen, problem)
            return
        self._reporter.tell_silence(self._camera.name, problem)

    def _publish(self, seen: Seen, problem: str) -> None:
        estimates = estimates_of(seen.event, self._tracker, sorted(self._outputs))
        untimely = from_the_future(seen.event.stamp_ns, time.time_ns())
        for estimate in estimates:
            told = with_reason(estimate, untimely) if untimely else estimate
            outputs = self._output(told.rope)
            outputs["centerline"].put_packed(pack_path(told.stamp_ns, seen.frame_id, told.waypoints))
            outputs["poses"].put_packed(pack_poses(told.stamp_ns, seen.frame_id, told.waypoints))
            outputs["status"].put(estimate_status(header(told.stamp_ns, seen.frame_id), told))
        reasons = [reason for estimate in estimates for reason in estimate.reasons]
        worst = max((estimate.status for estimate in estimates), key=list(Status).index)
        if (untimely or problem) and worst is Status.OK:
            worst = Status.DEGRADED
        self._reporter.tell(
            worst,
            "; ".join(filter(None, [problem, untimely, *reasons])) or "tracking",
            {
                "frames": str(self._frames),
                "skipped": str(self._camera.skipped),
                "latency": repr((time.time_ns() - seen.event.stamp_ns) / 1e9),
            },
        )

    def _output(self, rope: int) -> dict[str, Publisher]:
        if rope not in self._outputs:
            self._outputs[rope] = {
                name: self._node.publisher(topic_of(rope, name), kind)
                for name, kind in (("centerline", PATH), ("poses", POSES), ("status", DIAGNOSTICS))
            }
        return self._outputs[rope]


def from_the_future(stamp_ns: int, now_ns: int) -> str:
    """What is wrong with a stamp that is ahead of this machine's clock; empty if it is not."""
    ahead = (stamp_ns - now_ns) / 1e9
    if ahead <= MAX_FUTURE:
        return ""
    return f"the stamp is {ahead:.3f} s in the future: the clocks of whoever sends it and of this machine differ"


def with_reason(estimate: Estimate, reason: str) -> Estimate:
    """The estimate, degraded for one more reason."""
    status = Status.DEGRADED if estimate.status is Status.OK else estimate.status
    return replace(estimate, status=status, reasons=(*estimate.reasons, reason))
