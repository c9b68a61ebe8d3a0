"""The whole graph, each node a process of its own: it works, and outlives the end of any of them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path

import pytest

pytest.importorskip("zenoh")
pytest.importorskip("mujoco")
pytest.importorskip("pinocchio")

from ropetrace.cli_node import Commands, Images, Reach, Robot, Router
from ropetrace.errors import ConfigError
from ropetrace.recordings.ros_messages import RawMessage, decoded
from ropetrace.results.ros_estimates import DIAGNOSTICS, PATH, TRAJECTORY
from ropetrace.ros.graph import Subscription
from ropetrace.ros.kinematic_system import ArmSettings
from ropetrace.ros.live_camera import CameraTopics
from ropetrace.ros.messages import JOINTS, NUMBERS
from ropetrace.ros.simulated_cell import cell_config
from ropetrace.ros.supervise import end_all
from ropetrace.ros.zenoh_graph import ZenohNode
from ropetrace.ros.zenoh_session import Connection, open_router
from ros_rig import STARTED, children_of, free_endpoint, runs, until

NODES = ("sim", "track_deformable", "trajectory_tracker", "kinematic_system")


class Graph:
    """The processes by name."""

    def __init__(self, folder: Path) -> None:
        self.router = free_endpoint()
        self.log = folder / "log.txt"
        self._settings = folder / "rope.toml"
        self._settings.write_text(cell_config().to_toml())
        self.running: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str) -> None:
        told = [] if name in ("router", "sim") else ["--config", str(self._settings)]
        command = [sys.executable, "-m", "ropetrace", "node", name, "--router", self.router, *told]
        with self.log.open("ab") as log:
            self.running[name] = subprocess.Popen(command, stderr=log)

    def kill(self, name: str) -> None:
        process = self.running.pop(name)
        process.kill()
        process.wait()

    def end(self) -> dict[str, int]:
        for process in self.running.values():
            process.send_signal(signal.SIGINT)
        return {name: process.wait(timeout=STARTED) for name, process in self.running.items()}


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    made = Graph(tmp_path)
    try:
        for name in ("router", *NODES):
            made.start(name)
        yield made
    finally:
        for process in made.running.values():
            process.kill()
            process.wait()


def five_come(read: Subscription) -> None:
    """Wait for as many messages."""
    got: list[RawMessage] = []

    def all_came() -> bool:
        got.extend(read.take())
        return len(got) >= 5

    until(all_came)


def test_the_graph_traces_the_rope_and_outlives_each_of_its_nodes(graph: Graph) -> None:
    with ZenohNode("watcher", Connection(router=graph.router)) as watcher:
        reads = {
            "path": watcher.subscription("/ropetrace/centerline", PATH, depth=1000),
            "motion": watcher.subscription("/ropetrace/motion", TRAJECTORY, depth=1000),
            "command": watcher.subscription("/ropetrace/velocity_commands", NUMBERS, depth=1000),
            "joints": watcher.subscription("/joint_states", JOINTS, depth=1000),
        }

        def flows() -> None:
            """Everything comes: five new messages of each topic, and a path with poses."""
            for read in reads.values():
                read.take()
            for read in reads.values():
                five_come(read)
            until(lambda: any(len(decoded(message).poses) > 50 for message in reads["path"].take()))

        flows()
        until(lambda: "kinematic_system: ok" in graph.log.read_text())
        for name in (*NODES, "router"):
            graph.kill(name)
            time.sleep(1.5)
            graph.start(name)
            flows()
        # Whoever comes after a router that was started anew is found, too.
        graph.kill("trajectory_tracker")
        graph.start("trajectory_tracker")
        flows()
    assert set(graph.end().values()) == {0}
    text = graph.log.read_text()
    assert "Traceback" not in text, text
    assert text.count("ended") == len(NODES), "the router says nothing"


def test_all_starts_the_graph_and_ctrl_c_ends_it(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    command = [sys.executable, "-m", "ropetrace", "node", "all", "--simulate", "--router", endpoint]
    log = tmp_path / "log.txt"
    with log.open("wb") as out:
        process = subprocess.Popen(command, stderr=out)
    try:
        until(lambda: "kinematic_system: ok" in log.read_text())
        children = children_of(process.pid)
        assert len(children) == 5
        os.kill(children[-1], signal.SIGKILL)
        until(lambda: "it is started again" in log.read_text())
        until(lambda: len(children_of(process.pid)) == 5)
        children = children_of(process.pid)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=STARTED) == 0
    finally:
        process.kill()
        process.wait()
    assert not any(runs(child) for child in children)
    assert "Traceback" not in log.read_text(), log.read_text()


def test_no_node_outlives_all_even_if_that_is_killed(tmp_path: Path) -> None:
    """Some run by then, others are still starting."""
    command = [sys.executable, "-m", "ropetrace", "node", "all", "--simulate", "--router", free_endpoint()]
    log = tmp_path / "log.txt"
    with log.open("wb") as out:
        process = subprocess.Popen(command, stderr=out)
    try:
        until(lambda: "router: listening" in log.read_text())
        children = children_of(process.pid)
        assert len(children) == 5
    finally:
        process.kill()
        process.wait()
    until(lambda: not any(runs(child) for child in children))


UNTIL_TOLD = """
import signal, sys, time
stop = []
signal.signal(signal.SIGTERM, lambda *_: stop.append(1))
print(flush=True)
while not stop:
    time.sleep(0.01)
time.sleep(float(sys.argv[1]))
"""


def test_the_router_ends_when_all_others_have_ended() -> None:
    """Wherever it stands in the list: one that was started again is its last."""
    running = {}
    for name, seconds in (("sim", 0.2), ("router", 0.0), ("kinematic_system", 0.4)):
        command = [sys.executable, "-c", UNTIL_TOLD, str(seconds)]
        running[name] = subprocess.Popen(command, stdout=subprocess.PIPE)
    still_there: list[str] = []

    def watch() -> None:
        until(lambda: not runs(running["router"].pid))
        still_there.extend(name for name in ("sim", "kinematic_system") if runs(running[name].pid))

    try:
        for process in running.values():
            assert process.stdout is not None
            process.stdout.readline()
        thread = threading.Thread(target=watch)
        thread.start()
        end_all(running)
        thread.join()
    finally:
        for process in running.values():
            process.kill()
            process.communicate()
    assert still_there == []
    assert [process.returncode for process in running.values()] == [0, 0, 0]


def test_a_node_whose_stderr_nobody_reads_goes_on(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    command = [sys.executable, "-m", "ropetrace", "node", "trajectory_tracker", "--diameter", "12mm"]
    with subprocess.Popen([*command, "--router", endpoint], stderr=subprocess.PIPE) as process:
        try:
            assert process.stderr is not None
            assert b"no router" in process.stderr.readline()
            process.stderr.close()
            with open_router(endpoint), ZenohNode("watcher", Connection(router=endpoint)) as watcher:
                heard = watcher.subscription("/diagnostics", DIAGNOSTICS, depth=100)
                # What it tells here it has told on stderr, too.
                until(lambda: any("nothing came" in decoded(one).status[0].message for one in heard.take()))
            assert process.poll() is None
            process.terminate()
            assert process.wait(timeout=STARTED) == 0
        finally:
            process.kill()


def test_a_node_whose_supervisor_is_gone_before_it_starts_ends() -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as gone:
        gone.wait()
    command = [sys.executable, "-m", "ropetrace", "node", "router", "--router", free_endpoint()]
    environment = {**os.environ, "ROPETRACE_SUPERVISOR": str(gone.pid)}
    result = subprocess.run(command, env=environment, timeout=STARTED, check=False)
    assert result.returncode == 143


def test_the_way_to_ros(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("ROS_MASTER_URI", raising=False)
    if find_spec("rclpy") or find_spec("rospy"):
        pytest.skip("a ROS is installed for this Python")
    assert Reach().way() == "zenoh"
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "rospy.py").touch()
    assert Reach().way() == "zenoh"
    monkeypatch.setenv("ROS_MASTER_URI", "http://localhost:11311")
    assert Reach().way() == "rospy"
    assert Reach(domain=3).way() == "zenoh", "what is said of Zenoh alone says Zenoh"
    assert Reach("zenoh", mode="client").way() == "zenoh"
    (tmp_path / "rclpy.py").touch()
    assert Reach().way() == "rclpy"
    assert Reach("rospy").way() == "rospy"


def test_the_command_line_has_the_defaults_of_the_nodes() -> None:
    images = Images()
    assert CameraTopics() == CameraTopics(
        images.depth_topic, images.color_topic, images.camera_topic, images.cloud_topic
    )
    assert ArmSettings() == ArmSettings(**asdict(Robot()), **asdict(Commands()))
    reach = Reach()
    told = (reach.router, reach.mode, reach.listen, reach.multicast, 0, reach.humble, reach.shared_memory)
    assert Connection() == Connection(*told)
    assert Router().router == reach.router


def test_a_client_waits_for_its_router(capsys: pytest.CaptureFixture[str]) -> None:
    reach = Reach("zenoh", router=free_endpoint(), mode="client")
    asked = iter([False, True])
    assert reach.node("early", lambda: next(asked)) is None
    with closing(open_router(reach.router)):
        node = reach.node("early", lambda: False)
        assert node is not None
        node.close()
    assert capsys.readouterr().err.count("early: no router at") == 1


def test_a_domain_of_the_environment_that_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "five")
    with pytest.raises(ConfigError, match="ROS_DOMAIN_ID"):
        Reach(router=free_endpoint()).node("node", lambda: False)


@pytest.mark.parametrize(
    ("told", "said"),
    [
        (["kinematic_system", "--diameter", "15mm"], "camera_pose"),
        (["all", "--diameter", "15mm"], "camera_pose"),
        (["track_deformable", "--diameter", "15mm", "--self-filter"], "--self-filter needs camera_pose"),
        (["track_deformable", "--diameter", "15mm", "--self-filter", "--cloud-topic", "/c"], "leave out --cloud-topic"),
        (["all", "--simulate", "--self-filter", "--cloud-topic", "/c"], "leave out --cloud-topic"),
        (["all", "--simulate", "--diameter", "15mm"], "--diameter: --simulate brings its own rope"),
        (["all", "--simulate", "--arm", "fr3"], "--arm: --simulate brings its own"),
        (["all", "--simulate", "--joint-topic", "/j"], "--joint-topic: --simulate brings its own"),
        (["all", "--diameter", "15mm", "--wind", "0.8"], "--wind is for --simulate"),
        (["track_deformable"], "diameter is missing"),
        (["track_deformable", "--diameter", "15mm", "--depth-topic", "depth"], "no full name of a topic"),
        (["trajectory_tracker", "--diameter", "15mm", "--domain", "999"], "0 to 232"),
        (["router", "--router", "tcp/203.0.113.1:7447"], "no Zenoh session"),
        (["sim", "--ros", "rospy", "--router", "tcp/127.0.0.1:1"], "--router is for --ros zenoh alone"),
        (["sim", "--ros", "rclpy", "--multicast"], "--multicast is for --ros zenoh alone"),
        (["all", "--simulate", "--ros", "rclpy", "--domain", "3"], "rclpy takes ROS_DOMAIN_ID"),
        (["sim", "--ros", "rospy"], "this needs rospy of ROS 1"),
    ],
)
def test_what_is_wrong_is_one_line(told: list[str], said: str) -> None:
    if "this needs rospy" in said and find_spec("rospy"):
        pytest.skip("rospy is installed for this Python")
    result = subprocess.run(
        [sys.executable, "-m", "ropetrace", "node", *told], capture_output=True, text=True, timeout=STARTED, check=False
    )
    assert result.returncode == 2
    assert said in result.stderr.splitlines()[-1]
    assert "Traceback" not in result.stderr
