"""The nodes on ROS 1, against Debian's own roscore, rospy, messages, rostopic and rosbag."""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("pinocchio")

from ropetrace.errors import ConfigError
from ropetrace.evaluation.case1 import CONDITIONS, Case1Settings, scenario
from ropetrace.recordings import open_recording
from ropetrace.recordings.ros1_bag import Ros1Bag
from ropetrace.recordings.ros_messages import CAMERA, CLOUD, IMAGE, RawMessage, decoded
from ropetrace.results.ros_estimates import typestore
from ropetrace.ros import messages
from ropetrace.ros.messages import NUMBERS
from ropetrace.ros.rospy_graph import definition, master_uri, ros1_bytes, ros1_type
from ropetrace.ros.simulated_cell import cell_config
from ropetrace.sim.scenario import SimulatedScene
from ropetrace.types import BadFrame, RgbdFrame
from ros_rig import STARTED, children_of, free_port, listening, runs, until
from ros_twins import published

DEBIAN_PYTHON, DEBIAN_PACKAGES = "/usr/bin/python3", "/usr/lib/python3/dist-packages"


@cache
def missing() -> str:
    """Why ROS 1 cannot be tried here; empty if it can."""
    for tool in ("roscore", "rostopic", "rosnode", "rosbag"):
        if shutil.which(tool) is None:
            return f"{tool} is not installed: apt-get install ros-core python3-rospy"
    for python, wanted in (
        (DEBIAN_PYTHON, "rospy, sensor_msgs, nav_msgs, geometry_msgs, diagnostic_msgs, trajectory_msgs"),
        (sys.executable, "rospy"),
    ):
        script = f"import sys; sys.path.append({DEBIAN_PACKAGES!r}); import {wanted}"
        result = subprocess.run([python, "-c", script], capture_output=True, text=True, check=False)
        if result.returncode:
            return f"{python}: {result.stderr.splitlines()[-1]}"
    return ""


pytestmark = pytest.mark.skipif(bool(missing()), reason=f"ROS 1: {missing()}")


class Core:
    """A roscore on a port of its own, and what runs beside it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._port = free_port()
        self.uri = f"http://localhost:{self._port}"
        self.env = {
            **{name: value for name, value in os.environ.items() if name not in ("ROS_IP", "ROS_HOSTNAME")},
            "ROS_MASTER_URI": self.uri,
            "ROS_HOME": str(folder / "home"),
            "ROS_LOG_DIR": str(folder / "log"),
        }
        # Debian's packages come last, so that NumPy and all else are our own.
        site = folder / "site"
        site.mkdir()
        (site / "sitecustomize.py").write_text(f"import sys\nsys.path.append({DEBIAN_PACKAGES!r})\n")
        self.our_env = {**self.env, "PYTHONPATH": str(site)}
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        with (self._folder / "roscore.txt").open("ab") as log:
            # It ends with whoever started it, even if that is killed.
            command = ["setpriv", "--pdeathsig", "TERM", "roscore", "-p", str(self._port)]
            self._process = subprocess.Popen(
                command, env={**self.env, "ROS_IP": "127.0.0.1"}, stdout=log, stderr=log, start_new_session=True
            )
        until(lambda: self.tool("rostopic", "list", check=False))

    def stop(self) -> None:
        """As by Ctrl-C; it takes its rosmaster and rosout with it."""
        if self._process is not None:
            self._process.send_signal(signal.SIGINT)
            self._process.wait(timeout=STARTED)
            self._process = None

    @contextmanager
    def hanging(self) -> Iterator[None]:
        """Its rosmaster takes connections, but answers none."""
        assert self._process is not None
        children = children_of(self._process.pid)
        for child in children:
            os.kill(child, signal.SIGSTOP)
        try:
            yield
        finally:
            for child in children:
                os.kill(child, signal.SIGCONT)

    def tool(self, *command: str, check: bool = True) -> str:
        """What one of ROS' own commands says."""
        result = subprocess.run(
            command, env=self.env, capture_output=True, text=True, timeout=STARTED, check=False, cwd=self._folder
        )
        assert not check or result.returncode == 0, result.stderr
        return result.stdout

    def came(self, topic: str) -> str:
        """A message of a topic, as rostopic shows it, within the time that a node takes to start."""
        return self.tool("rostopic", "echo", "-n1", topic)

    def came_with(self, topic: str, words: str, times: int = 1) -> str:
        """The first message of a topic in which these words are, so many times at least."""
        shown = ""

        def came() -> bool:
            nonlocal shown
            shown = self.came(topic)
            return shown.count(words) >= times

        until(came)
        return shown

    @contextmanager
    def node(self, *told: str) -> Iterator[tuple[subprocess.Popen[bytes], Path]]:
        """One of our nodes as a process, and its log."""
        log = self._folder / f"{told[0]}-{time.monotonic_ns()}.txt"
        with log.open("wb") as out:
            process = subprocess.Popen(
                [sys.executable, "-m", "ropetrace", "node", *told], env=self.our_env, stderr=out, stdout=out
            )
        try:
            yield process, log
        finally:
            process.kill()
            process.wait()

    @contextmanager
    def debian(self, script: str, *told: str) -> Iterator[subprocess.Popen[str]]:
        """A process of Debian's Python that knows nothing of ropetrace; it is killed at the end."""
        process = subprocess.Popen(
            [DEBIAN_PYTHON, "-c", script, *told], env=self.env, stdout=subprocess.PIPE, text=True, cwd=self._folder
        )
        try:
            yield process
        finally:
            process.kill()
            process.communicate()


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Core]:
    made = Core(tmp_path_factory.mktemp("ros1"))
    try:
        made.start()
        yield made
    finally:
        made.stop()


def plain(value: Any) -> Any:
    """A message of ours as JSON has it, its fields named as ROS 1 and 2 both have them."""
    if is_dataclass(value):
        kept = [item.name for item in fields(value) if item.name.islower() and item.name != "__msgtype__"]
        return {name.lower(): plain(getattr(value, name)) for name in kept}
    if isinstance(value, np.ndarray | list):
        return [plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


READ_BY_GENPY = """
import io, json, sys
import genpy, roslib.message
def plain(value):
    if isinstance(value, genpy.TVal):
        return {"sec": value.secs, "nanosec": value.nsecs}
    if isinstance(value, genpy.Message):
        return {slot.lower(): plain(getattr(value, slot)) for slot in value.__slots__ if slot != "seq"}
    return [plain(item) for item in value] if isinstance(value, (list, tuple, bytes)) else value
for line in sys.stdin:
    name, data = json.loads(line)
    data, kind = bytes.fromhex(data), roslib.message.get_message_class(name)
    message = kind().deserialize(data)
    again = io.BytesIO()
    message.serialize(again)
    seq = message.header.seq if kind._has_header else None
    print(json.dumps([kind._md5sum, seq, again.getvalue() == data, plain(message)]))
"""


def test_genpys_own_classes_read_every_message_that_is_published() -> None:
    sent = published()
    lines = [json.dumps([ros1_type(name), bytes(ros1_bytes(data, name, 7)).hex()]) for name, data in sent]
    result = subprocess.run(
        [DEBIAN_PYTHON, "-c", READ_BY_GENPY], input="\n".join(lines), capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    answers = [json.loads(line) for line in result.stdout.splitlines()]
    assert {name for name, _ in sent} >= {IMAGE, CAMERA, CLOUD}
    for (name, data), (md5sum, sequence, same, read) in zip(sent, answers, strict=True):
        assert definition(name)[1] == md5sum, name
        assert sequence == (None if name == NUMBERS else 7), name
        assert same, name
        assert read == plain(typestore().deserialize_cdr(data, name)), name


def test_our_reader_reads_what_is_published_as_ros1() -> None:
    for name, data in published():
        message = RawMessage("/topic", name, "ros1", 0, bytes(ros1_bytes(data, name, 1)))
        assert json.dumps(plain(decoded(message))).count("1700000000") >= (name != NUMBERS)


@pytest.mark.parametrize("uri", ["localhost:11311", "https://localhost:11311", "http://localhost", "http://h:x", "no"])
def test_a_master_that_cannot_be(uri: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_MASTER_URI", uri)
    with pytest.raises(ConfigError, match="expected an address such as http://localhost:11311"):
        master_uri()


FLOWING = ("/ropetrace/centerline", "/ropetrace/motion", "/ropetrace/joint_commands")
"""The first needs the camera's images, the second the first, the third the arm's joints."""


def flows(core: Core) -> None:
    """New readers get messages of all the nodes, and these have theirs of each other."""
    for topic, words in zip(FLOWING, ("position:", "translation:", "panda_joint7"), strict=True):
        core.came_with(topic, words)


def names_of(pid: int) -> dict[str, int]:
    """The nodes that `node all` runs, by what they are called."""
    found = {}
    for child in children_of(pid):
        words: list[str] = []
        with suppress(OSError):  # it may have ended
            words = Path(f"/proc/{child}/cmdline").read_bytes().decode().split("\0")
        # A child that has only just been made is still a copy of its parent.
        if "all" not in words and "node" in words:
            found[words[words.index("node") + 1]] = child
    return found


READER_THAT_STOPS = """
import sys, time
import rospy, sensor_msgs.msg
rospy.init_node("stops", anonymous=True)
rospy.Subscriber("/camera/color/image_raw", sensor_msgs.msg.Image, lambda _: print("reading", flush=True))
rospy.spin()
"""


def test_the_graph_on_debians_roscore(core: Core, tmp_path: Path) -> None:
    with ExitStack() as stack:
        everything, log = stack.enter_context(core.node("all", "--simulate"))
        until(lambda: "kinematic_system: ok" in log.read_text())
        assert set(names_of(everything.pid)) == {"sim", "track_deformable", "trajectory_tracker", "kinematic_system"}

        # ROS' own tools see it.
        flows(core)
        topics = core.tool("rostopic", "list").split()
        assert {*FLOWING, "/diagnostics", "/ropetrace/poses", "/ropetrace/velocity_commands"} <= set(topics)
        assert core.tool("rostopic", "type", "/ropetrace/centerline") == "nav_msgs/Path\n"
        assert core.tool("rostopic", "type", "/ropetrace/velocity_commands") == "std_msgs/Float64MultiArray\n"
        assert core.tool("rostopic", "type", "/camera/color/image_raw") == "sensor_msgs/Image\n"

        # A bag that rosbag has recorded is read by rosbag, and by us.
        bag = tmp_path / "all.bag"
        recorder = subprocess.Popen(
            ["rosbag", "record", "-a", "-O", str(bag)], env=core.env, stdout=subprocess.DEVNULL, start_new_session=True
        )
        active = bag.with_suffix(".bag.active")
        # Four seconds of frames with their colour; a busy machine starts rosbag late.
        until(lambda: active.exists() and active.stat().st_size > 60e6)
        os.killpg(recorder.pid, signal.SIGINT)
        assert recorder.wait(timeout=STARTED) == 0
        told = core.tool("rosbag", "info", str(bag))
        assert re.search(r"nav_msgs/Path +\[6227e2b7e9cce15051f669a5e197bbf7\]", told)
        assert "/ropetrace/motion" in told
        events = list(open_recording(bag).frames())
        whole = sum(isinstance(event, RgbdFrame) and event.color is not None for event in events)
        assert whole > 20
        # rosbag subscribes to one topic after the other, and leaves them so: an image at the edge can be alone.
        alone = [event for event in events if isinstance(event, BadFrame)]
        assert len(alone) < whole
        assert all("no colour image within" in event.reason for event in alone)
        paths = [messages.waypoints(message) for message in Ros1Bag(bag).messages(["/ropetrace/centerline"])]
        assert len(paths) > 20
        assert all(len(found) > 50 for found in paths)

        # Nothing listens beyond this machine.
        for pid in names_of(everything.pid).values():
            heard = listening(pid)
            assert heard
            assert {host for _, host in heard} == {"127.0.0.1"}

        # A reader that reads no more holds up nobody.
        reader = stack.enter_context(core.debian(READER_THAT_STOPS))
        assert reader.stdout is not None
        assert reader.stdout.readline() == "reading\n"
        reader.send_signal(signal.SIGSTOP)
        # Three seconds are 45 MB of images: more than the sockets hold.
        time.sleep(3)
        flows(core)
        reader.kill()

        def killed(*names: str) -> None:
            """Kill these; they are started again, and all flows."""
            old = {name: names_of(everything.pid)[name] for name in names}
            for pid in old.values():
                os.kill(pid, signal.SIGKILL)
            until(lambda: all(names_of(everything.pid).get(name, old[name]) != old[name] for name in names))
            flows(core)

        killed("sim", "trajectory_tracker")

        # A roscore that is started anew knows them all again, and whoever comes after that is found, too.
        before = len(log.read_text())
        core.stop()
        until(lambda: log.read_text()[before:].count(f"no roscore at {core.uri} any more") >= 4)
        core.start()
        flows(core)
        killed("track_deformable", "kinematic_system")

        # Ctrl-C ends them all, even while the master hangs.
        pids = list(names_of(everything.pid).values())
        with core.hanging():
            everything.send_signal(signal.SIGINT)
            assert everything.wait(timeout=STARTED) == 0
        assert not any(runs(pid) for pid in pids)
        text = log.read_text()
        assert "Traceback" not in text, text
        assert text.count(": ended\n") == 4, text


CAMERA_OF_DEBIAN = """
import base64, json, sys, time
import rospy, sensor_msgs.msg
with open(sys.argv[1]) as file:
    frame = json.load(file)
rospy.init_node("debians_camera")
made = {}
def send(topic, kind, stamp, **fields):
    if topic not in made:
        made[topic] = rospy.Publisher(topic, kind, queue_size=2)
    message = kind(**fields)
    message.header.stamp, message.header.frame_id = stamp, "debians_camera"
    made[topic].publish(message)
rows, columns = frame["rows"], frame["columns"]
depth, color = base64.b64decode(frame["depth"]), base64.b64decode(frame["color"])
while not rospy.is_shutdown():
    stamp = rospy.Time.from_sec(time.time())
    size = dict(width=columns, height=rows)
    send("/cam/camera_info", sensor_msgs.msg.CameraInfo, stamp, K=frame["k"], **size)
    image = sensor_msgs.msg.Image
    send("/cam/color", image, stamp, encoding="bgr8", step=3 * columns, data=color, **size)
    send("/cam/depth", image, stamp, encoding="16UC1", step=2 * columns, data=depth, **size)
    time.sleep(0.1)
"""

CAMERA_OF_THE_WRONG_TYPE = """
import rospy, sensor_msgs.msg
rospy.init_node("wrong_camera")
publisher = rospy.Publisher("/cam/depth", sensor_msgs.msg.PointCloud2, queue_size=2)
rospy.spin()
"""


def test_a_camera_that_speaks_debians_own_rospy(core: Core, tmp_path: Path) -> None:
    simulated = SimulatedScene(scenario(CONDITIONS[0], 0.0, Case1Settings()))
    frame = simulated.camera.expose(simulated.scene_at, simulated.camera.stamp(1), 1)
    assert frame.color is not None
    lens = frame.intrinsics
    millimetres = np.nan_to_num(frame.depth * frame.depth_unit_m * 1000).round().astype(np.uint16)
    shown = {
        "rows": lens.height,
        "columns": lens.width,
        "k": [lens.fx, 0, lens.cx, 0, lens.fy, lens.cy, 0, 0, 1.0],
        "depth": base64.b64encode(millimetres.tobytes()).decode(),
        "color": base64.b64encode(frame.color[:, :, ::-1].tobytes()).decode(),
    }
    (tmp_path / "frame.json").write_text(json.dumps(shown))
    settings = tmp_path / "rope.toml"
    settings.write_text(replace(cell_config(), camera_pose=None).to_toml())
    topics = ["--depth-topic", "/cam/depth", "--color-topic", "/cam/color", "--camera-topic", "/cam/camera_info"]
    with core.node("track_deformable", "--ros", "rospy", "--config", str(settings), *topics) as (tracker, log):
        with core.debian(CAMERA_OF_THE_WRONG_TYPE):
            wrong = "/cam/depth of node /wrong_camera is sensor_msgs/msg/PointCloud2, expected sensor_msgs/msg/Image"
            until(lambda: wrong in log.read_text())
        with core.debian(CAMERA_OF_DEBIAN, str(tmp_path / "frame.json")):
            until(lambda: "track_deformable: ok: tracking" in log.read_text())
            seen = core.came_with("/ropetrace/centerline", "position:", times=51)
            assert 'frame_id: "debians_camera"' in seen
        until(lambda: "lost: nothing came on /cam/depth" in log.read_text().rpartition("tracking")[2])
        tracker.send_signal(signal.SIGINT)
        assert tracker.wait(timeout=STARTED) == 0
        assert "Traceback" not in log.read_text(), log.read_text()


def test_a_node_waits_for_roscore_and_ends_when_it_is_told_to(tmp_path: Path) -> None:
    core = Core(tmp_path)
    told = ("trajectory_tracker", "--ros", "rospy", "--diameter", "12mm")
    try:
        with core.node(*told) as (waiting, log), core.node(*told) as (other, other_log):
            for text in (log, other_log):
                until(lambda text=text: "trajectory_tracker: running" in text.read_text())  # type: ignore[misc]
                until(lambda text=text: f"no roscore at {core.uri} yet: start it" in text.read_text())  # type: ignore[misc]
            other.send_signal(signal.SIGINT)
            assert other.wait(timeout=STARTED) == 0, "Ctrl-C while there is no roscore"
            core.start()
            until(lambda: "/ropetrace/motion" in core.tool("rostopic", "list"))
            assert log.read_text().count("no roscore") == 1
            # Another of its name takes its place.
            with core.node(*told) as (newer, newer_log):
                assert waiting.wait(timeout=STARTED) == 0
                assert "told to end by the ROS master" in log.read_text()
                until(lambda: "killed" in core.tool("rosnode", "kill", "/trajectory_tracker"))
                assert newer.wait(timeout=STARTED) == 0
            for text in (log, other_log, newer_log):
                assert "Traceback" not in text.read_text(), text.read_text()
    finally:
        core.stop()


BRAKING = """
import time
from ropetrace.ros import messages
from ropetrace.ros.rospy_graph import RospyNode
from ropetrace.ros.supervise import told_to_stop
import numpy as np
should_stop = told_to_stop()
with RospyNode("braking") as node:
    publisher, end = node.publisher("/velocities", messages.NUMBERS), None
    while end is None or time.monotonic() < end:
        publisher.put(messages.numbers(np.array([float(should_stop())])))
        if should_stop() and end is None:
            end = time.monotonic() + 1.5
        time.sleep(0.02)
"""

ARM_THAT_COUNTS = """
import os
import rospy, std_msgs.msg
braking = []
def came(message):
    if not braking:
        print("moving", flush=True)
    if message.data[0]:
        braking.append(message.data)
        if len(braking) == 20:
            os._exit(0)
rospy.init_node("arm")
rospy.Subscriber("/velocities", std_msgs.msg.Float64MultiArray, came)
rospy.spin()
"""


def test_what_a_node_says_while_it_brakes_is_heard_after_rosnode_kill(core: Core) -> None:
    with subprocess.Popen([sys.executable, "-c", BRAKING], env=core.our_env) as process:
        try:
            with core.debian(ARM_THAT_COUNTS) as arm:
                assert arm.stdout is not None
                assert arm.stdout.readline() == "moving\n"
                core.tool("rosnode", "kill", "/braking")
                assert arm.wait(timeout=STARTED) == 0
            assert process.wait(timeout=STARTED) == 0
            until(lambda: "/braking" not in core.tool("rosnode", "list").split())
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("environment", "heard"),
    [({}, "127.0.0.1"), ({"ROS_HOSTNAME": "localhost"}, "127.0.0.1"), ({"ROS_IP": "127.0.0.2"}, "127.0.0.2")],
)
def test_where_a_node_listens(core: Core, environment: dict[str, str], heard: str) -> None:
    script = (
        "import time\n"
        "from ropetrace.ros.rospy_graph import RospyNode\n"
        "node = RospyNode('quiet')\n"
        "node.publisher('/text', 'std_msgs/msg/String')\n"
        "time.sleep(600)\n"
    )
    with subprocess.Popen([sys.executable, "-c", script], env={**core.our_env, **environment}) as process:
        try:
            until(lambda: "/quiet" in core.tool("rosnode", "list"))
            # rospy opens its second port for the first reader.
            reader = ["rostopic", "echo", "-n1", "/text"]
            with subprocess.Popen(reader, env=core.env, stdout=subprocess.DEVNULL) as reading:
                try:
                    until(lambda: len(listening(process.pid)) == 2)
                finally:
                    reading.kill()
            assert listening(process.pid) == [("tcp", heard)] * 2
        finally:
            process.kill()
