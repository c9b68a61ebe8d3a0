"""Topics and nodes of an installed ROS 2, by rclpy: the messages go through it as bytes, in CDR."""

from __future__ import annotations

import importlib
import threading
from typing import Any

from ropetrace.errors import MissingExtraError, RosError
from ropetrace.recordings.base import one_line
from ropetrace.results.ros_estimates import typestore
from ropetrace.ros.graph import Subscription, check_topic

LOOK_EVERY = 1.0
"""How often the graph is asked who publishes something else, seconds."""


class RclpyPublisher:
    """A `graph.Publisher`; made by `RclpyNode.publisher`."""

    def __init__(self, publisher: Any, type_name: str) -> None:
        self._publisher = publisher
        self._type = type_name

    def put(self, message: Any) -> None:
        """Send a message; whoever does not keep up loses it."""
        self.put_packed(bytes(typestore().serialize_cdr(message, self._type)))

    def put_packed(self, data: bytes) -> None:
        """Send a message that is CDR already."""
        self._publisher.publish(data)


class RclpyNode:
    """A node of a ROS 2 graph by rclpy, whatever RMW_IMPLEMENTATION is: a `graph.RosNode`.

    It has a context of its own and a thread that takes messages, and handles no signals. It reads as best effort, which
    fits every publisher, and publishes reliably, which fits every reader, and keeps the last few messages; whether a
    reader that does not keep up holds up `put` is for the middleware to say.

    Parameters
    ----------
    name : str
        Of the node.

    Raises
    ------
    MissingExtraError
        If rclpy cannot be imported.
    RosError
        If rclpy refuses to start.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._qos = _module("rclpy.qos")
        self._get_message = _module("rosidl_runtime_py.utilities").get_message
        rclpy, signals = _module("rclpy"), _module("rclpy.signals")
        executors = _module("rclpy.executors")
        self._arrived = threading.Event()
        self._reads: list[Subscription] = []
        self._context = _module("rclpy.context").Context()
        try:
            rclpy.init(args=[], context=self._context, signal_handler_options=signals.SignalHandlerOptions.NO)
            self._node = rclpy.create_node(
                name, context=self._context, use_global_arguments=False, start_parameter_services=False
            )
            self._executor = executors.SingleThreadedExecutor(context=self._context)
        except Exception as error:
            self._context.try_shutdown()
            raise RosError(f"rclpy does not start: {one_line(error)}") from error
        self._node.create_timer(LOOK_EVERY, self._look)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, args=(executors,), name="rclpy", daemon=True)
        self._thread.start()

    def __enter__(self) -> RclpyNode:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the graph."""
        self._context.try_shutdown()
        self._thread.join()
        self._executor.shutdown()
        self._node.destroy_node()

    def publisher(self, topic: str, type_name: str, depth: int = 5) -> RclpyPublisher:
        """Publish messages of a type.

        Raises
        ------
        ConfigError
            If the topic's name is impossible.
        RosError
            If this type is not installed.
        """
        qos = self._qos.QoSProfile(depth=depth, reliability=self._qos.ReliabilityPolicy.RELIABLE)
        made = self._node.create_publisher(self._type(type_name), check_topic(topic), qos)
        return RclpyPublisher(made, type_name)

    def subscription(self, topic: str, type_name: str, depth: int = 1) -> Subscription:
        """Read a topic: the last `depth` messages are kept.

        Raises
        ------
        ConfigError
            If the topic's name is impossible.
        RosError
            If this type is not installed.
        """
        read = Subscription(check_topic(topic), type_name, depth, self._arrived)
        qos = self._qos.QoSProfile(depth=depth, reliability=self._qos.ReliabilityPolicy.BEST_EFFORT)
        # A callback that takes one argument: rclpy counts them.
        self._node.create_subscription(
            self._type(type_name), topic, lambda data: read.receive(data, "cdr"), qos, raw=True
        )
        self._reads.append(read)
        return read

    def wait(self, seconds: float) -> None:
        """Wait until a message of any subscription has come since the last call, or for this long."""
        self._arrived.wait(seconds)
        self._arrived.clear()

    def topics(self) -> dict[str, str]:
        """What is published, and its type; the first where several share a name."""
        found = {}
        for topic, _ in self._node.get_topic_names_and_types():
            publishers = self._node.get_publishers_info_by_topic(topic)
            if publishers:
                found[topic] = publishers[0].topic_type
        return found

    def _look(self) -> None:
        """Learn who publishes something else under a name that is read."""
        for read in list(self._reads):
            read.others = {
                bytes(info.endpoint_gid).hex(): (
                    f"{read.topic} of node {info.node_name} is {info.topic_type}, expected {read.type}: not read"
                )
                for info in self._node.get_publishers_info_by_topic(read.topic)
                if info.topic_type != read.type
            }

    def _spin(self, executors: Any) -> None:
        try:
            self._executor.spin()
        except (executors.ExternalShutdownException, executors.ShutdownException):
            """The end of the node."""

    def _type(self, name: str) -> Any:
        try:
            return self._get_message(name)
        except (ImportError, AttributeError, ValueError) as error:
            raise RosError(f"this ROS 2 does not know {name}: {one_line(error)}") from error


def _module(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingExtraError(
            f"this needs rclpy of ROS 2 ({error}): source the setup.bash of the ROS installation, with a Python of the "
            "version that it was built for"
        ) from error
