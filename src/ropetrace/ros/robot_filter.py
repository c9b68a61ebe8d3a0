"""Takes an arm out of the images of a live camera, by where its joints were at each image's stamp."""

from __future__ import annotations

from collections import deque

from ropetrace.control.arm import Arm
from ropetrace.errors import FrameError
from ropetrace.recordings.ros_messages import RawMessage, stamp_and_frame
from ropetrace.ros import messages
from ropetrace.ros.graph import RosNode
from ropetrace.self_filter import without_robot
from ropetrace.sim.scene import inverse_pose
from ropetrace.types import Event, FloatArray, RgbdFrame, moved

MOST_APART_NS = 50_000_000
"""Joints that are further than this from an image's stamp do not tell where the arm was in it, nanoseconds."""

_KEPT = 256
"""Messages of joints that wait for their image: a quarter of a second at 1 kHz."""


class RobotFilter:
    """Knows where the arm is in an image.

    Parameters
    ----------
    node : RosNode
        Reads the joints.
    arm : Arm
        Which.
    joint_topic : str
        sensor_msgs/JointState of the arm.
    base_from_camera : (4, 4) float array
        The camera's pose in the frame of the arm's base.

    Attributes
    ----------
    fault : str
        Why the arm was left in the last image; empty if it was taken out.
    """

    def __init__(self, node: RosNode, arm: Arm, joint_topic: str, base_from_camera: FloatArray) -> None:
        self.fault = ""
        self._arm = arm
        self._camera_from_base = inverse_pose(base_from_camera)
        self._joints = node.subscription(joint_topic, messages.JOINTS, _KEPT)
        self._recent: deque[tuple[int, RawMessage]] = deque(maxlen=_KEPT)

    def clear(self, event: Event) -> Event:
        """The image without depth where the arm is; others as they are."""
        try:
            for message in self._joints.take():
                self._recent.append((stamp_and_frame(message)[0], message))
            if not isinstance(event, RgbdFrame):
                return event
            position = self._position(event.stamp_ns)
        except FrameError as error:
            self.fault = f"the arm is left in the image: {error}"
            return event
        self.fault = ""
        starts, ends, radii = self._arm.capsules(position)
        pose = self._camera_from_base
        return without_robot(event, moved(starts, pose), moved(ends, pose), radii)

    def _position(self, stamp_ns: int) -> FloatArray:
        """The joints at a time, between the two messages beside it."""
        near = [pair for pair in self._recent if abs(pair[0] - stamp_ns) <= MOST_APART_NS]
        if not near:
            problem = self._joints.problem() or f"nothing on {self._joints.topic} is of its time"
            raise FrameError(problem)
        before = max((pair for pair in near if pair[0] <= stamp_ns), key=lambda pair: pair[0], default=None)
        after = min((pair for pair in near if pair[0] >= stamp_ns), key=lambda pair: pair[0], default=None)
        names = self._arm.joint_names
        if before is None or after is None or before[0] == after[0]:
            nearest = before or after
            assert nearest is not None
            return messages.joint_values(nearest[1], names, "position")
        share = (stamp_ns - before[0]) / (after[0] - before[0])
        earlier, later = (messages.joint_values(pair[1], names, "position") for pair in (before, after))
        return earlier + share * (later - earlier)
