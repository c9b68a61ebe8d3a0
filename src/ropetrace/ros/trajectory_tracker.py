"""The paper's node trajectory_tracker: centrelines in, how they move and where they are now out."""

from __future__ import annotations

import time
from collections.abc import Callable

from ropetrace.centerline import waypoints_through
from ropetrace.config import RopeConfig
from ropetrace.errors import ConfigError, FrameError
from ropetrace.motion import make_motion
from ropetrace.recordings.ros_messages import RawMessage, stamp_and_frame
from ropetrace.results.ros_estimates import PATH, TRAJECTORY, topic_of
from ropetrace.results.ros_packed import pack_path, pack_trajectory
from ropetrace.ros import messages
from ropetrace.ros.graph import RosNode
from ropetrace.ros.reporting import Reporter
from ropetrace.ros.track_deformable import from_the_future
from ropetrace.types import Status

LONGEST_PREDICTION = 0.5
"""A centreline older than this is not predicted to the present, seconds."""


class TrajectoryTracker:
    """Follows the first rope's ``centerline``, and publishes its ``motion`` and its ``predicted`` path of this moment.

    Of a path from the future nothing is published: the clocks of two machines differ.

    Parameters
    ----------
    node : RosNode
        Of the graph.
    config : RopeConfig
        Of the rope.

    Raises
    ------
    ConfigError
        If the config wants no motion.
    """

    def __init__(self, node: RosNode, config: RopeConfig) -> None:
        motion = make_motion(config.motion.method, config.diameter)
        if motion is None:
            raise ConfigError('trajectory_tracker needs the motion: take motion.method = "none" out of the config')
        self._motion = motion
        self._node = node
        self._paths = node.subscription(topic_of(0, "centerline"), PATH, depth=10)
        self._moving = node.publisher(topic_of(0, "motion"), TRAJECTORY)
        self._predicted = node.publisher(topic_of(0, "predicted"), PATH)
        self._reporter = Reporter(node)

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Follow until told to stop."""
        while not should_stop():
            self._node.wait(0.1)
            self.step()

    def step(self) -> None:
        """Follow every path that has come."""
        paths = self._paths.take()
        for message in paths:
            self._reporter.heard()
            try:
                self._reporter.tell(*self._follow(message))
            except FrameError as error:
                self._reporter.tell(Status.LOST, str(error))
        if not paths:
            self._reporter.tell_silence(self._paths.topic, self._paths.problem())

    def _follow(self, message: RawMessage) -> tuple[Status, str]:
        """Take one path; how it went."""
        stamp_ns, frame_id = stamp_and_frame(message)
        waypoints = messages.waypoints(message)
        if not len(waypoints):
            return Status.LOST, "the rope is lost"
        untimely = from_the_future(stamp_ns, time.time_ns())
        if untimely:
            return Status.DEGRADED, untimely
        motion = self._motion.update(stamp_ns, waypoints)
        if motion is None:
            return Status.DEGRADED, "the motion is not known yet"
        self._moving.put_packed(pack_trajectory(stamp_ns, frame_id, waypoints, motion))
        now_ns = time.time_ns()
        ahead = (now_ns - stamp_ns) / 1e9
        prediction = self._motion.predict(max(ahead, 0.0)) if ahead <= LONGEST_PREDICTION else None
        if prediction is None:
            return Status.DEGRADED, f"the path is {ahead:.2f} s old: too old to be predicted"
        self._predicted.put_packed(pack_path(now_ns, frame_id, waypoints_through(prediction[0], waypoints)))
        return Status.OK, "following"
