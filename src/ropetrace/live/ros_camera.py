"""The camera of a running ROS graph: ROS 2 by rclpy or Zenoh, ROS 1 by rospy."""

from __future__ import annotations

import atexit
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from typing import TYPE_CHECKING

from ropetrace.errors import RecordingError, RosError, import_extra
from ropetrace.live.camera import CameraGoneError, Capture
from ropetrace.recordings.ros_messages import CLOUD, IMAGE, ros2_type
from ropetrace.ros.graph import MAX_FUTURE, RosNode
from ropetrace.ros.joining import domain_of_environment
from ropetrace.ros.live_camera import CameraTopics, LiveCamera, camera_info_beside
from ropetrace.ros.zenoh_session import ROUTER, START_ROUTER, Connection, router_answers

if TYPE_CHECKING:
    from ropetrace.ros.rclpy_graph import RclpyNode
    from ropetrace.ros.zenoh_graph import ZenohNode

PRESENT_SECONDS = 3.0
"""A camera from which nothing has come for this long after the graph was joined is not there."""

_MOST_LISTED = 12


@dataclass(frozen=True, slots=True)
class Graph:
    """A way into a ROS graph.

    Parameters
    ----------
    kind : str
        What a camera there is, for people.
    join : callable
        Joins the graph; raises a RosError if that cannot be.
    published : callable
        What is published there, and its type as ROS 2 names it; raises a RosError if nobody can tell.
    leaves : bool
        Whether the node leaves when the camera is gone: rospy can join but once.
    where : str
        Where this graph is, for people.
    """

    kind: str
    join: Callable[[], RosNode]
    published: Callable[[RosNode], dict[str, str]]
    leaves: bool
    where: str


class RosCamera:
    """What a camera publishes: depth images with their colour, or clouds. See `ropetrace.live.Camera`.

    Images go without colour if none at all comes within the first two seconds.

    Parameters
    ----------
    graph : Graph
        Where.
    topics : CameraTopics
        What is read.
    color : bool, optional
        Whether images have their colour; None: if any comes.

    Attributes
    ----------
    lost : int
        Frames that came faster than they were read, or nearly all at once. Those before the first do not count.
    """

    def __init__(self, graph: Graph, topics: CameraTopics, color: bool | None = None) -> None:
        self.kind = graph.kind
        self.lost = 0
        self._graph = graph
        self._topics = topics
        self._color = color
        self._node: RosNode | None = None
        self._camera: LiveCamera | None = None
        self._first: Capture | None = None
        self._skipped: int | None = None

    def connect(self) -> None:
        try:
            if self._camera is None:
                self._node = self._graph.join()
                self._camera = LiveCamera(
                    self._node, self._topics, self._color is not False, self._color is None, in_order=True
                )
            while self._camera.take() is not None:
                """What is left from before."""
            self._skipped = None
            self._await_first()
        except RosError as error:
            self.disconnect()
            raise CameraGoneError(str(error)) from None
        except BaseException:
            self.disconnect()
            raise

    def fetch(self, timeout: float) -> Capture | None:
        if self._first is not None:
            first, self._first = self._first, None
            self._count_lost()
            return first
        assert self._node is not None
        end = time.monotonic() + timeout
        while (capture := self._next()) is None and (left := end - time.monotonic()) > 0:
            self._node.wait(left)
        if capture is not None:
            self._count_lost()
        return capture

    def disconnect(self) -> None:
        self._first = None
        if self._graph.leaves and self._node is not None:
            self._node.close()
            self._node = self._camera = None

    def _count_lost(self) -> None:
        assert self._camera is not None
        skipped = self._camera.skipped
        if self._skipped is not None:
            self.lost += skipped - self._skipped
        self._skipped = skipped

    def _next(self) -> Capture | None:
        assert self._camera is not None
        seen = self._camera.take()
        if seen is None:
            return None
        now_ns = time.monotonic_ns()
        age_ns = time.time_ns() - seen.event.stamp_ns
        # The clocks of several machines agree no better: a stamp of so short a future is of now.
        if -MAX_FUTURE * 1e9 <= age_ns < 0:
            age_ns = 0
        return Capture(seen.event, now_ns, now_ns - age_ns)

    def _await_first(self) -> None:
        """Wait until the camera has shown that it is there."""
        assert self._node is not None
        assert self._camera is not None
        end = time.monotonic() + PRESENT_SECONDS
        while (left := end - time.monotonic()) > 0:
            self._first = self._next()
            if self._first is not None or self._camera.waiting:
                return
            self._node.wait(left)
        silent = f"nothing came on {self._camera.name} for {PRESENT_SECONDS:.0f} s"
        advice = self._camera.problem() or self._advice(self._camera.name, self._graph.published(self._node))
        raise CameraGoneError(f"{silent}: {advice}")

    def _advice(self, wanted: str, published: dict[str, str]) -> str:
        if wanted in published:
            return "it is published, but silent: look at the camera's driver"
        found = sorted(topic for topic, kind in published.items() if kind in (IMAGE, CLOUD))
        if not found:
            return f"there are no images and no clouds {self._graph.where}: start the camera's driver"
        rows = [f"{topic} ({published[topic].rpartition('/')[2]})" for topic in found[:_MOST_LISTED]]
        more = f" and {len(found) - _MOST_LISTED} more" if len(found) > _MOST_LISTED else ""
        return f"there are {', '.join(rows)}{more}: choose with --depth-topic or --cloud-topic"


def open_ros(
    address: str, depth_topic: str | None = None, color_topic: str | None = None, cloud_topic: str | None = None
) -> RosCamera:
    """The camera of a ROS graph: ``ros2:``, ``ros2:tcp/HOST:PORT`` (a Zenoh router) or ``ros1:``.

    Parameters
    ----------
    address : str
        Which graph. The domain is that of ROS_DOMAIN_ID, the master that of ROS_MASTER_URI.
    depth_topic, color_topic, cloud_topic : str, optional
        In the place of a RealSense's. The camera_info is the one beside the depth images. An empty `color_topic`
        leaves colour out; any other must come.

    Raises
    ------
    RecordingError
        If both images and clouds are asked for, or the address is none.
    ConfigError
        If a topic's name, the endpoint or ROS_DOMAIN_ID is impossible.
    MissingExtraError
        If the package that speaks to this graph is not installed.
    """
    if cloud_topic and (depth_topic or color_topic):
        raise RecordingError(f"{address}: give a cloud topic, or depth and colour topics, but not both")
    default = CameraTopics()
    depth = depth_topic or default.depth
    topics = CameraTopics(depth, color_topic or default.color, camera_info_beside(depth), cloud_topic or None)
    return RosCamera(_graph(address), topics, None if color_topic is None else bool(color_topic))


def _graph(address: str) -> Graph:
    scheme, _, place = address.partition(":")
    if scheme == "ros2":
        return _zenoh(place) if place or find_spec("rclpy") is None else _rclpy()
    if place:
        raise RecordingError(f"{address}: give ros1: alone, and the master in ROS_MASTER_URI")
    return _rospy()


def _name() -> str:
    """Of a node that is the only one of its name."""
    return f"ropetrace_camera_{os.getpid()}"


def _zenoh(router: str) -> Graph:
    import_extra("zenoh", "ros2")
    from ropetrace.ros.zenoh_graph import ZenohNode

    connection = Connection(router=router or ROUTER, domain=domain_of_environment())

    def join() -> ZenohNode:
        if not router_answers(connection.router):
            place = "or give its place: ros2:tcp/HOST:PORT"
            raise RosError(f"no router at {connection.router}: {START_ROUTER}, {place}")
        return ZenohNode(_name(), connection)

    def published(node: RosNode) -> dict[str, str]:
        assert isinstance(node, ZenohNode)
        return node.topics()

    where = f"at {connection.router} with ROS_DOMAIN_ID={connection.domain}"
    return Graph("ROS 2 camera", join, published, leaves=True, where=where)


def _rclpy() -> Graph:
    from ropetrace.ros.rclpy_graph import RclpyNode

    def join() -> RclpyNode:
        return RclpyNode(_name())

    def published(node: RosNode) -> dict[str, str]:
        assert isinstance(node, RclpyNode)
        return node.topics()

    return Graph("ROS 2 camera", join, published, leaves=True, where=f"with ROS_DOMAIN_ID={domain_of_environment()}")


def _rospy() -> Graph:
    from ropetrace.ros.rospy_graph import master_uri, published_topics

    uri = master_uri()
    _rospy_node()

    def published(_: RosNode) -> dict[str, str]:
        return {topic: ros2_type(kind) for topic, kind in published_topics(uri, _name())}

    return Graph("ROS 1 camera", _rospy_node, published, leaves=False, where=f"at {uri}")


@cache
def _rospy_node() -> RosNode:
    """The node of this process, which rospy has but once."""
    from ropetrace.ros.rospy_graph import RospyNode

    node = RospyNode(_name())
    atexit.register(node.close)
    return node
