"""The node on rclpy, against a stand-in that has rclpy's documented interface: no real rclpy has been tried.

Messages go from publisher to subscription within the process, as bytes. What rclpy would refuse, the stand-in refuses.
"""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from enum import IntEnum
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ropetrace.errors import ConfigError, MissingExtraError, RosError
from ropetrace.live.ros_camera import open_ros
from ropetrace.recordings.ros_messages import CAMERA, IMAGE, decoded
from ropetrace.results.ros_estimates import make
from ropetrace.ros.rclpy_graph import RclpyNode
from ropetrace.types import Intrinsics, RgbdFrame
from ros_rig import publishing, until

STRING = "std_msgs/msg/String"
KNOWN = (STRING, IMAGE, CAMERA)


class Reliability(IntEnum):
    RELIABLE = 1
    BEST_EFFORT = 2


class SignalHandlerOptions(IntEnum):
    NO = 0
    ALL = 3


class ExternalShutdownException(Exception):  # noqa: N818
    """As rclpy's."""


class ShutdownException(Exception):  # noqa: N818
    """As rclpy's."""


class QoSProfile:
    def __init__(self, *, depth: int, reliability: Reliability) -> None:
        self.depth, self.reliability = depth, Reliability(reliability)


class Context:
    def __init__(self) -> None:
        self.running = False

    def ok(self) -> bool:
        return self.running

    def try_shutdown(self) -> None:
        self.running = False


class Publisher:
    def __init__(self, node: Node, kind: type, topic: str, qos: QoSProfile) -> None:
        self.node, self.kind, self.topic, self.qos = node, kind, topic, qos

    def publish(self, message: bytes) -> None:
        if not isinstance(message, bytes | self.kind):
            raise TypeError(f"Expected {self.kind}, got {type(message)}")
        assert isinstance(message, bytes), "a message of rclpy's own classes"
        for node in Graph.nodes:
            for read in node.reads:
                fits = not (
                    self.qos.reliability is Reliability.BEST_EFFORT and read.qos.reliability is Reliability.RELIABLE
                )
                if (read.topic, read.kind) == (self.topic, self.kind) and fits:
                    node.waiting.append((read.callback, message))


class Node:
    def __init__(self, name: str, context: Context) -> None:
        if not context.ok():
            raise RuntimeError("the context is not initialized")
        self.name, self.context = name, context
        self.publishers: list[Publisher] = []
        self.reads: list[SimpleNamespace] = []
        self.waiting: list[tuple[Callable[[bytes], None], bytes]] = []
        self.timers: list[SimpleNamespace] = []
        Graph.nodes.append(self)

    def create_publisher(self, msg_type: type, topic: str, qos_profile: QoSProfile) -> Publisher:
        self.publishers.append(Publisher(self, msg_type, topic, qos_profile))
        return self.publishers[-1]

    def create_subscription(
        self, msg_type: type, topic: str, callback: Callable[[bytes], None], qos_profile: QoSProfile, *, raw: bool
    ) -> None:
        assert raw, "messages of rclpy's own classes"
        self.reads.append(SimpleNamespace(kind=msg_type, topic=topic, callback=callback, qos=qos_profile))

    def create_timer(self, timer_period_sec: float, callback: Callable[[], None]) -> None:
        due = time.monotonic() + timer_period_sec
        self.timers.append(SimpleNamespace(period=timer_period_sec, callback=callback, due=due))

    def get_publishers_info_by_topic(self, topic_name: str, no_mangle: bool = False) -> list[SimpleNamespace]:
        return [
            SimpleNamespace(
                node_name=node.name,
                topic_type=made.kind.__doc__,
                endpoint_gid=list(id(made).to_bytes(16, "little")),
                qos_profile=made.qos,
            )
            for node in Graph.nodes
            for made in node.publishers
            if made.topic == topic_name
        ]

    def get_topic_names_and_types(self, no_demangle: bool = False) -> list[tuple[str, list[str]]]:
        ends: list[Any] = [end for node in Graph.nodes for end in [*node.publishers, *node.reads]]
        topics = {end.topic for end in ends}
        return [(topic, sorted({end.kind.__doc__ for end in ends if end.topic == topic})) for topic in topics]

    def destroy_node(self) -> None:
        Graph.nodes.remove(self)


class SingleThreadedExecutor:
    def __init__(self, *, context: Context) -> None:
        self.context = context
        self.nodes: list[Node] = []
        self.closed = False

    def add_node(self, node: Node) -> bool:
        assert node.context is self.context
        self.nodes.append(node)
        return True

    def spin(self) -> None:
        while not self.closed:
            if not self.context.ok():
                raise ExternalShutdownException
            for node in self.nodes:
                while node.waiting:
                    callback, data = node.waiting.pop(0)
                    callback(data)
                for timer in node.timers:
                    if time.monotonic() >= timer.due:
                        timer.due += timer.period
                        timer.callback()
            time.sleep(0.002)

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        self.closed = True
        return True


class Graph:
    nodes: list[Node] = []  # noqa: RUF012
    signals: list[SignalHandlerOptions] = []  # noqa: RUF012


def init(
    *,
    args: list[str] | None = None,
    context: Context,
    domain_id: int | None = None,
    signal_handler_options: SignalHandlerOptions | None = None,
) -> None:
    assert args == [], "the command line is ropetrace's, not rclpy's"
    assert signal_handler_options is not None
    Graph.signals.append(signal_handler_options)
    context.running = True


def create_node(
    node_name: str, *, context: Context, use_global_arguments: bool = True, start_parameter_services: bool = True
) -> Node:
    return Node(node_name, context)


CLASSES = {name: type(name.rpartition("/")[2], (), {"__doc__": name}) for name in KNOWN}


def get_message(identifier: str) -> type:
    if identifier not in CLASSES:
        raise ModuleNotFoundError(f"No module named {identifier.split('/', 1)[0]!r}")
    return CLASSES[identifier]


@pytest.fixture(autouse=True)
def rclpy(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    modules: dict[str, dict[str, Any]] = {
        "rclpy": {"init": init, "create_node": create_node},
        "rclpy.qos": {"QoSProfile": QoSProfile, "ReliabilityPolicy": Reliability},
        "rclpy.signals": {"SignalHandlerOptions": SignalHandlerOptions},
        "rclpy.context": {"Context": Context},
        "rclpy.executors": {
            "SingleThreadedExecutor": SingleThreadedExecutor,
            "ExternalShutdownException": ExternalShutdownException,
            "ShutdownException": ShutdownException,
        },
        "rosidl_runtime_py": {},
        "rosidl_runtime_py.utilities": {"get_message": get_message},
    }
    for name, held in modules.items():
        module = ModuleType(name)
        module.__dict__.update(held)
        module.__spec__ = SimpleNamespace(name=name)  # type: ignore[assignment]
        monkeypatch.setitem(sys.modules, name, module)
    yield
    assert Graph.nodes == [], "a node that was not closed"
    assert not [thread for thread in threading.enumerate() if thread.name == "rclpy"]


def test_messages_go_through_as_bytes_and_only_the_last_are_kept() -> None:
    with RclpyNode("a") as one, RclpyNode("b") as two:
        publisher, read = one.publisher("/text", STRING), two.subscription("/text", STRING, depth=2)
        for number in range(5):
            publisher.put(make(STRING, str(number)))
        publisher.put_packed(b"\x00\x01\x00\x00\x02\x00\x00\x005\x00")
        two.wait(20.0)
        until(lambda: not Graph.nodes[1].waiting)
        until(lambda: len(read._messages) == 2)
        taken = read.take()
    assert [decoded(message).data for message in taken] == ["4", "5"]
    assert {(message.topic, message.type, message.encoding) for message in taken} == {("/text", STRING, "cdr")}


def test_it_fits_reliable_and_best_effort_peers_and_leaves_the_signals_alone() -> None:
    before = signal.getsignal(signal.SIGINT)
    with RclpyNode("a") as node:
        node.publisher("/text", STRING, depth=7)
        node.subscription("/other", STRING, depth=3)
        made, read = Graph.nodes[0].publishers[0], Graph.nodes[0].reads[0]
        assert (made.qos.reliability, made.qos.depth) == (Reliability.RELIABLE, 7)
        assert (read.qos.reliability, read.qos.depth) == (Reliability.BEST_EFFORT, 3)
    assert Graph.signals[-1] is SignalHandlerOptions.NO
    assert signal.getsignal(signal.SIGINT) is before


def test_a_topic_of_another_type_is_told_until_it_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ropetrace.ros.rclpy_graph.LOOK_EVERY", 0.01)

    with RclpyNode("reader") as reader:
        read = reader.subscription("/depth", IMAGE)
        with RclpyNode("camera") as camera:
            camera.publisher("/depth", STRING)
            until(read.problem)
            assert (
                read.problem()
                == "/depth of node camera is std_msgs/msg/String, expected sensor_msgs/msg/Image: not read"
            )
            assert reader.topics() == {"/depth": STRING}
        until(lambda: not read.problem())
        assert reader.topics() == {}


def test_what_cannot_be() -> None:
    with RclpyNode("a") as node:
        with pytest.raises(ConfigError, match="no full name of a topic"):
            node.publisher("text", STRING)
        with pytest.raises(ConfigError, match="no full name of a topic"):
            node.subscription("/1", STRING)
        with pytest.raises(RosError, match="this ROS 2 does not know trajectory_msgs/msg/Nope"):
            node.subscription("/a", "trajectory_msgs/msg/Nope")


def test_an_rclpy_that_does_not_start_is_one_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(**_: Any) -> None:
        raise RuntimeError("failed to initialize rcl: no middleware")

    monkeypatch.setattr(sys.modules["rclpy"], "init", broken)
    with pytest.raises(RosError, match=r"rclpy does not start: .*no middleware"):
        RclpyNode("a")


def test_without_rclpy_it_says_what_to_source(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rclpy.qos", None)
    with pytest.raises(MissingExtraError, match=r"source the setup\.bash"):
        RclpyNode("a")


def test_the_live_source_takes_rclpy_where_it_can_be_imported() -> None:
    lens = Intrinsics(4, 3, 5.0, 6.0, 1.5, 1.0)
    depth = np.arange(12, dtype=np.uint16).reshape(3, 4)
    camera = open_ros("ros2:", color_topic="")
    with publishing(lambda: RclpyNode("camera"), lambda: RgbdFrame(time.time_ns(), depth, 0.001, lens, None)):
        camera.connect()
        capture = camera.fetch(10.0)
        camera.disconnect()
    assert capture is not None
    assert isinstance(capture.event, RgbdFrame), capture.event
    np.testing.assert_array_equal(capture.event.depth, depth)
