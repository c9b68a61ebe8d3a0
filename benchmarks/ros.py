"""From a camera's images to the rope's path over live ROS 2: how long it takes, on this machine.

    python benchmarks/ros.py

A camera of 480x360 at 30 frames a second, in this process, shows case study 2's rope in a wind of 0.8 Hz;
track_deformable runs in a process of its own; a third session reads the paths. Latency is from a frame's stamp, which
is when its first message is handed to Zenoh, to the path's arrival.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from ropetrace.evaluation.case1 import CONDITIONS, Case1Settings, scenario
from ropetrace.recordings.ros_frames import frame_messages
from ropetrace.recordings.ros_messages import stamp_and_frame
from ropetrace.results.ros_estimates import PATH
from ropetrace.ros.graph import Publisher
from ropetrace.ros.simulated_cell import cell_config
from ropetrace.ros.zenoh_graph import ZenohNode
from ropetrace.ros.zenoh_session import Connection, open_router
from ropetrace.sim.scenario import SimulatedScene
from ropetrace.types import RgbdFrame

ROUTER = "tcp/127.0.0.1:17447"
RATE = 30.0


def frames(count: int) -> list[RgbdFrame]:
    """A swinging rope, without an arm."""
    simulated = SimulatedScene(scenario(CONDITIONS[0], 0.8, Case1Settings()))
    first = round(5 * RATE)
    camera = simulated.camera
    return [camera.expose(simulated.scene_at, camera.stamp(first + n), first + n) for n in range(count)]


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--frames", type=int, default=900)
    count = parser.parse_args().frames
    shown = frames(150)
    router = open_router(ROUTER)
    connection = Connection(router=ROUTER)
    with tempfile.TemporaryDirectory() as folder:
        settings = Path(folder) / "rope.toml"
        settings.write_text(cell_config().to_toml(), encoding="utf-8")
        command = [sys.executable, "-m", "ropetrace", "node", "track_deformable"]
        tracker = subprocess.Popen([*command, "--config", str(settings), "--router", ROUTER])
        try:
            with ZenohNode("camera", connection) as camera, ZenohNode("reader", connection) as reader:
                paths = reader.subscription("/ropetrace/centerline", PATH, depth=count + 1000)
                publishers: dict[str, Publisher] = {}

                def send(index: int) -> float:
                    """Seconds that sending took."""
                    frame = replace(shown[_to_and_fro(index, len(shown))], stamp_ns=time.time_ns())
                    packed = frame_messages(frame)
                    start = time.perf_counter()
                    for message in packed:
                        if message.topic not in publishers:
                            publishers[message.topic] = camera.publisher(message.topic, message.type)
                        publishers[message.topic].put_packed(bytes(message.data))
                    return time.perf_counter() - start

                while not paths.take():
                    send(0)
                    time.sleep(0.2)
                sending = []
                due = time.perf_counter()
                for index in range(60 + count):
                    if index == 60:
                        paths.take()
                    sending.append(send(index))
                    due += 1 / RATE
                    time.sleep(max(due - time.perf_counter(), 0.0))
                time.sleep(0.5)
                found = [(message.log_time_ns - stamp_and_frame(message)[0]) / 1e6 for message in paths.take()]
        finally:
            tracker.terminate()
            tracker.wait()
            router.close()
    p50, p99 = np.percentile(found, [50, 99])
    sent50, sent99 = np.percentile(np.array(sending[60:]) * 1e3, [50, 99])
    print(f"{len(found)} paths of {count} frames; image to path: p50 {p50:.1f} ms, p99 {p99:.1f} ms")
    print(f"handing a frame's four messages to Zenoh: p50 {sent50:.2f} ms, p99 {sent99:.2f} ms")


def _to_and_fro(index: int, count: int) -> int:
    """Places in a list that is shown forwards and backwards: nothing jumps."""
    place = index % (2 * count - 2)
    return min(place, 2 * count - 2 - place)


if __name__ == "__main__":
    main()
