"""Takes an arm out of the images of a live camera, by where its joints were at each image's stamp."""

from __future__ import annotations

from collections import deque

from ropetrace.control.arm import Arm
from ropetrace.errors import FrameError
from ropetrace.ros import messages
from ropetrace.ros.graph import RosNode
from ropetrace.self_filter import without_robot
from ropetrace.sim.scene import inverse_pose
from ropetrace.types import Event, FloatArray, RgbdFrame, moved

MOST_APART_NS = 50_000_000
"""Joints that are further than this from an image's stamp do not tell where the arm was in it, nanoseconds."""

_KEPT = 256
"""Readings of joints that wait for their image: a quarter of a second at 1 kHz."""


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
        self._unusable = ""
        self._recent: deque[messages.JointReading] = deque(maxlen=_KEPT)

    def clear(self, event: Event) -> Event:
        """The image without depth where the arm is; others as they are."""
        self._learn_joints()
        if not isinstance(event, RgbdFrame):
            return event
        try:
            position = self._position(event.stamp_ns)
        except FrameError as error:
            self.fault = f"the arm is left in the image: {error}"
            return event
        self.fault = ""
        starts, ends, radii = self._arm.capsules(position)
        pose = self._camera_from_base
        return without_robot(event, moved(starts, pose), moved(ends, pose), radii)

    def _learn_joints(self) -> None:
        """Others than the arm may publish on the topic, such as a gripper."""
        for message in self._joints.take():
            try:
                self._recent.append(messages.joint_reading(message, self._arm.joint_names))
            except FrameError as error:
                self._unusable = str(error)
            else:
                self._unusable = ""

    def _position(self, stamp_ns: int) -> FloatArray:
        """The joints at a time, between the two readings beside it."""
        near = [one for one in self._recent if abs(one.stamp_ns - stamp_ns) <= MOST_APART_NS]
        if not near:
            topic = self._joints.topic
            raise FrameError(self._joints.problem() or self._unusable or f"nothing on {topic} is of its time")
        before = max((one for one in near if one.stamp_ns <= stamp_ns), key=lambda one: one.stamp_ns, default=None)
        after = min((one for one in near if one.stamp_ns >= stamp_ns), key=lambda one: one.stamp_ns, default=None)
        if before is None or after is None or before.stamp_ns == after.stamp_ns:
            nearest = before or after
            assert nearest is not None
            return nearest.position
        share = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
        return before.position + share * (after.position - before.position)
