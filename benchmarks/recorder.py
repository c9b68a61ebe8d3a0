"""What a kill takes from a recording, and what recording costs, beside the default writers of `mcap` and rosbags.

    python benchmarks/recorder.py            # prints the tables; --folder chooses the disk

Every writer is given the same messages: 640x480 depth with a Kinect's noise and noisy colour, or small frames of 64x48,
at 30 Hz. It is killed (SIGKILL to it and its children) at a random moment; a frame is acknowledged when the call that
wrote it has returned, and counts as readable if our reader, which takes truncated files, gives it back, or, in the last
column, if the `mcap` library's does after `ropetrace recover`. BackgroundRecorder acknowledges a frame when its
Recorder has written it. `ropetrace record sim:swing` is killed too, with and without a rope to track: there a frame is
acknowledged when the terminal has told of it, and frames that are missing between others are counted as well. The times
depend on this machine; the counts do not.
"""

from __future__ import annotations

import argparse
import fcntl
import io
import os
import pty
import random
import re
import select
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from mcap.reader import make_reader
from mcap.writer import Writer as LibraryWriter
from PIL import Image
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from ropetrace.errors import RopetraceError
from ropetrace.recorder import BackgroundRecorder, Recorder
from ropetrace.recordings import open_recording
from ropetrace.recordings.mcap_recover import recover
from ropetrace.recordings.ros_frames import frame_messages
from ropetrace.recordings.ros_messages import typestore
from ropetrace.sim.noise import kinect_axial
from ropetrace.types import BadFrame, Intrinsics, RgbdFrame

CAMERAS = {
    "640x480": Intrinsics(640, 480, 580, 580, 319.5, 239.5),
    "64x48": Intrinsics(64, 48, 58, 58, 31.5, 23.5),
}
PERIOD = 1 / 30
Write = Callable[[RgbdFrame], int | None]
"""Takes a frame; gives how many are acknowledged, where it is not all."""


def make_frames(size: str, count: int) -> list[RgbdFrame]:
    """Different frames of a slope with noise."""
    camera, rng = CAMERAS[size], np.random.default_rng(0)
    columns, rows = np.meshgrid(np.linspace(0, 1, camera.width), np.linspace(0, 1, camera.height))
    frames = []
    for index in range(count):
        depth = kinect_axial((0.8 + 0.5 * rows + 0.1 * np.sin(9 * columns + index)).astype(np.float32), rng)
        shade = 100 + 60 * columns[:, :, None] + np.array([20, 0, -20])
        color = np.clip(shade + rng.integers(-6, 7, (*depth.shape, 3)), 0, 255).astype(np.uint8)
        frames.append(RgbdFrame(10**18 + round(index * PERIOD * 1e9), depth, 0.001, camera, color))
    return frames


@contextmanager
def recorder(path: Path) -> Iterator[Write]:
    with Recorder(path) as writer:
        yield writer.write


@contextmanager
def background(path: Path) -> Iterator[Write]:
    with BackgroundRecorder(Recorder(path)) as writer:

        def write(frame: RgbdFrame) -> int:
            writer.put(frame)
            return writer.recorder.frames

        yield write


@contextmanager
def library(path: Path) -> Iterator[Write]:
    """The `mcap` package, as it is by default."""
    with path.open("wb") as stream:
        writer: Any = LibraryWriter(stream)
        writer.start(profile="ros2")
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}

        def write(frame: RgbdFrame) -> None:
            for message in frame_messages(frame):
                if message.type not in schemas:
                    text, _ = typestore("cdr").generate_msgdef(message.type, ros_version=2)
                    schemas[message.type] = writer.register_schema(message.type, "ros2msg", text.encode())
                if message.topic not in channels:
                    channels[message.topic] = writer.register_channel(message.topic, "cdr", schemas[message.type])
                writer.add_message(channels[message.topic], message.log_time_ns, bytes(message.data), 0)

        yield write
        writer.finish()


@contextmanager
def _rosbags(path: Path, plugin: StoragePlugin) -> Iterator[Write]:
    with RosbagsWriter(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}

        def write(frame: RgbdFrame) -> None:
            for message in frame_messages(frame):
                if message.topic not in connections:
                    store = typestore("cdr")
                    connections[message.topic] = writer.add_connection(message.topic, message.type, typestore=store)
                writer.write(connections[message.topic], message.log_time_ns, message.data)

        yield write


def rosbags_sqlite(path: Path) -> Any:
    return _rosbags(path, StoragePlugin.SQLITE3)


def rosbags_mcap(path: Path) -> Any:
    return _rosbags(path, StoragePlugin.MCAP)


WRITERS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "Recorder": (".mcap", recorder),
    "BackgroundRecorder": (".mcap", background),
    "mcap": (".mcap", library),
    "rosbags, MCAP": ("", rosbags_mcap),
    "rosbags, SQLite": ("", rosbags_sqlite),
}


def be_killed(name: str, size: str, path: Path) -> None:
    """Record until killed; tells how many frames are acknowledged."""
    frames = make_frames(size, 30)
    with WRITERS[name][1](path) as write:
        for index in range(10**9):
            due = time.monotonic() + PERIOD
            frame = frames[index % len(frames)]
            stamp = 10**18 + round(index * PERIOD * 1e9)
            written = write(RgbdFrame(stamp, frame.depth, 0.001, frame.intrinsics, frame.color))
            print(index + 1 if written is None else written, flush=True)
            time.sleep(max(due - time.monotonic(), 0))


def kill_once(name: str, size: str, folder: Path) -> tuple[int, int, int | None]:
    """Frames that were acknowledged, that can be read, and that the library reads after `recover`."""
    path = folder / f"killed{WRITERS[name][0]}"
    shutil.rmtree(path, ignore_errors=True)
    path.unlink(missing_ok=True)
    process = subprocess.Popen(
        [sys.executable, __file__, "--be-killed", name, size, str(path)],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    with process:
        acknowledged = int(process.stdout.readline())
        time.sleep(random.uniform(0.5, 3))
        os.killpg(process.pid, signal.SIGKILL)
        acknowledged = max([acknowledged, *map(int, process.stdout.read().split())])
    try:
        events = list(open_recording(path).frames())
        readable = sum(not isinstance(event, BadFrame) for event in events)
    except RopetraceError:
        readable = 0
    if not name.endswith("Recorder"):
        return acknowledged, readable, None
    recover(path)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        found = sum(1 for _ in reader.iter_messages(topics=["/camera/aligned_depth_to_color/image_raw"]))
    return acknowledged, readable, found


def print_kills(folder: Path, count: int) -> None:
    print(f"{count} kills each             acknowledged   lost   lost at worst   library, after recover, lost")
    for size in CAMERAS:
        for name in WRITERS:
            kills = [kill_once(name, size, folder) for _ in range(count)]
            lost = [max(acknowledged - readable, 0) for acknowledged, readable, _ in kills]
            later = [max(acknowledged - found, 0) for acknowledged, _, found in kills if found is not None]
            total = sum(kill[0] for kill in kills)
            print(
                f"{size:8s} {name:19s} {total:11d} {sum(lost):6d} {max(lost):12d}"
                + (f" {sum(later):20d}" if later else f"{'':21s}")
            )


def kill_command(path: Path, rope: list[str]) -> tuple[int, list[int]]:
    """Frames that the terminal told of, and the stamps of those that can be read."""
    path.unlink(missing_ok=True)
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("4H", 40, 100, 0, 0))
    process = subprocess.Popen(
        [sys.executable, "-m", "ropetrace", "record", "sim:swing", "--out", str(path), *rope],
        stdout=subprocess.DEVNULL,
        stderr=theirs,
        start_new_session=True,
    )
    os.close(theirs)
    shown, end = b"", float("inf")
    with process, suppress(OSError):
        while process.poll() is None and time.monotonic() < end:
            if select.select([ours], [], [], 0.1)[0]:
                shown += os.read(ours, 65536)
            if end == float("inf") and re.search(rb"[1-9]frame \[", shown):
                end = time.monotonic() + random.uniform(0.5, 3)
        os.killpg(process.pid, signal.SIGKILL)
        while more := os.read(ours, 65536):
            shown += more
    os.close(ours)
    stamps = [event.stamp_ns for event in open_recording(path).frames() if not isinstance(event, BadFrame)]
    return max(map(int, re.findall(rb"(\d+)frame \[", shown))), stamps


def print_command_kills(folder: Path, count: int) -> None:
    print(f"\n{count} kills of ropetrace record  told of   lost   missing between others")
    rope = ["--diameter", "15mm", "--color", "#c8281e"]
    for name, options in (("frames alone", []), ("tracked", rope)):
        kills = [kill_command(folder / "killed.mcap", options) for _ in range(count)]
        missing = sum(round(step / 1e9 / PERIOD) - 1 for _, stamps in kills for step in np.diff(stamps))
        lost = sum(max(told - len(stamps), 0) for told, stamps in kills)
        print(f"{name:28s} {sum(told for told, _ in kills):7d} {lost:6d} {missing:8d}")


def print_speed(folder: Path, count: int) -> None:
    """Writing as fast as it goes, and at 30 Hz."""
    frames = make_frames("640x480", 30)
    raw = count * (frames[0].depth.nbytes + 640 * 480 * 3) / 1e6
    print(
        f"\n{count} frames of 640x480        MB/s  of raw   p50 ms   p99 ms   max ms"
        "    at 30 Hz: p50 ms  p99 ms  max ms"
    )
    for name, (ending, make) in WRITERS.items():
        rows = []
        for period in (0.0, PERIOD):
            path = folder / f"speed{ending}"
            shutil.rmtree(path, ignore_errors=True)
            path.unlink(missing_ok=True)
            spent = []
            started = time.perf_counter()
            with make(path) as write:
                for index in range(count):
                    due = time.perf_counter() + period
                    frame = frames[index % len(frames)]
                    before = time.perf_counter()
                    write(RgbdFrame(10**18 + index, frame.depth, 0.001, frame.intrinsics, frame.color))
                    spent.append(time.perf_counter() - before)
                    time.sleep(max(due - time.perf_counter(), 0))
            seconds = time.perf_counter() - started
            size = sum(file.stat().st_size for file in ([path] if path.is_file() else path.iterdir())) / 1e6
            rows.append((raw / seconds, size / raw, *np.percentile(np.array(spent[3:]) * 1e3, [50, 99, 100])))
        fast, steady = rows
        print(
            f"{name:27s} {fast[0]:6.0f} {fast[1] * 100:6.0f} % {fast[2]:8.2f} {fast[3]:8.2f} {fast[4]:8.2f}"
            f" {steady[2]:20.2f} {steady[3]:7.2f} {steady[4]:7.2f}"
        )


def print_compressions() -> None:
    """What lossless compressions make of depth and of colour."""
    (frame,) = make_frames("640x480", 1)
    assert frame.color is not None

    def png(pixels: Any) -> bytes:
        stream = io.BytesIO()
        Image.fromarray(pixels).save(stream, "png", compress_level=1)
        return stream.getvalue()

    ways: dict[str, Callable[[Any], bytes]] = {
        "LZ4": lambda pixels: bytes(lz4.frame.compress(pixels.tobytes())),
        "Zstandard 1": lambda pixels: bytes(zstandard.compress(pixels.tobytes(), 1)),
        "Zstandard 3": lambda pixels: bytes(zstandard.compress(pixels.tobytes(), 3)),
        "PNG 1": png,
    }
    print("\n640x480, of raw, ms    depth         colour")
    for name, compress in ways.items():
        cells = []
        for pixels in (frame.depth, frame.color):
            spent = []
            for _ in range(7):
                before = time.perf_counter()
                size = len(compress(pixels))
                spent.append((time.perf_counter() - before) * 1e3)
            cells.append(f"{size / pixels.nbytes * 100:4.0f} % {np.median(spent):6.2f}")
        print(f"{name:20s} {'   '.join(cells)}")


def print_sync(folder: Path) -> None:
    """How long the disk takes for half a second of frames: what a power cut may take beyond that half second."""
    frames = make_frames("640x480", 15)
    spent = []
    with Recorder(folder / "sync.mcap") as writer:
        for _ in range(10):
            for frame in frames:
                writer.write(frame)
            before = time.perf_counter()
            writer._file.sync()
            spent.append((time.perf_counter() - before) * 1e3)
    print(f"\nfdatasync of half a second of frames: median {np.median(spent):.1f} ms, max {max(spent):.1f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="of the disk that is measured")
    parser.add_argument("--kills", type=int, default=8)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--be-killed", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.be_killed:
        name, size, path = options.be_killed
        be_killed(name, size, Path(path))
        return
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        print_kills(Path(folder), options.kills)
        print_command_kills(Path(folder), options.kills)
        print_speed(Path(folder), options.frames)
        print_compressions()
        print_sync(Path(folder))


if __name__ == "__main__":
    main()
