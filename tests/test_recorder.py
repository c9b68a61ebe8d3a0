"""Recording: nothing that was acknowledged is lost by a kill, and nobody waits for a disk that is slow or full."""

from __future__ import annotations

import dataclasses
import fcntl
import math
import os
import pty
import random
import re
import resource
import select
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from recordings_samples import contents
from ropetrace import cli_record, terminal
from ropetrace.errors import FrameError, OutputError, RecordingError
from ropetrace.live import CameraGoneError, LiveRecording
from ropetrace.recorder import BackgroundRecorder, Recorder
from ropetrace.recordings import open_recording
from ropetrace.recordings.mcap_parts import read_summary
from ropetrace.recordings.mcap_recover import recover
from ropetrace.results import open_writer
from ropetrace.results.base import WholeFile
from ropetrace.types import BadFrame, CloudFrame, Estimate, Frame, Intrinsics, RgbdFrame
from test_cli import Run, rope_frames, run, write_mcap
from test_live import Script, ScriptedCamera, quick_scenario, tiny

__all__ = ["run"]

CAMERA = Intrinsics(64, 48, 60, 60, 31.5, 23.5)


def noise_frame(index: int, kind: Any = np.uint16, unit: float = 0.001, color: bool = True) -> RgbdFrame:
    """A frame that no compression makes small; the same for the same index."""
    rng = np.random.default_rng(index)
    depth = rng.integers(0, 5000, (48, 64)).astype(kind)
    pixels = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8) if color else None
    return RgbdFrame(10**18 + index * 33_333_333, depth, unit, CAMERA, pixels)


def noise_cloud(index: int, kind: Any, color: bool) -> CloudFrame:
    rng = np.random.default_rng(index)
    points = rng.standard_normal((50, 3)).astype(kind)
    points[7] = np.nan
    return CloudFrame(index + 1, points, rng.integers(0, 256, (50, 3), dtype=np.uint8) if color else None)


def read(path: Path) -> list[Frame]:
    return [frame for frame in open_recording(path).frames() if isinstance(frame, RgbdFrame | CloudFrame)]


def assert_whole(path: Path) -> None:
    """For other tools too: every checksum and every index."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert sum(1 for _ in reader.iter_messages()) == summary.statistics.message_count
    recording = open_recording(path)
    assert recording.info().problems == ()


@contextmanager
def file_limit(size: int) -> Iterator[None]:
    """No file grows beyond this many bytes, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def small_file_system(path: Path, kibibytes: int) -> Iterator[Path]:
    """A disk that is soon full."""
    path.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={kibibytes}k", "ropetrace-test", str(path)]
    if os.geteuid() != 0 or subprocess.run(mount, check=False, capture_output=True).returncode != 0:
        pytest.skip("only root may mount a small file system")
    try:
        yield path
    finally:
        subprocess.run(["umount", "--lazy", str(path)], check=True)


def wait_until(holds: Callable[[], bool]) -> None:
    """Fails after five minutes."""
    deadline = time.monotonic() + 300
    while not holds():
        assert time.monotonic() < deadline, "it never came to that"
        time.sleep(0.01)


@pytest.mark.parametrize("color", [True, False])
@pytest.mark.parametrize(("kind", "unit"), [(np.uint16, 0.001), (np.float32, 1.0)])
def test_images_come_back_bit_by_bit(tmp_path: Path, kind: Any, unit: float, color: bool) -> None:
    frames = [noise_frame(index, kind, unit, color) for index in range(5)]
    with Recorder(tmp_path / "a.mcap") as recorder:
        for frame in frames:
            recorder.write(frame)
    assert recorder.frames == 5
    assert contents(read(tmp_path / "a.mcap")) == contents(frames)
    assert_whole(tmp_path / "a.mcap")


def test_frames_that_repeat_a_stamp_come_back(tmp_path: Path) -> None:
    frames = [dataclasses.replace(noise_frame(index), stamp_ns=10**18) for index in range(3)]
    with Recorder(tmp_path / "a.mcap") as recorder:
        for frame in frames:
            recorder.write(frame)
    assert contents(read(tmp_path / "a.mcap")) == contents(frames)


@pytest.mark.parametrize("color", [True, False])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_clouds_come_back_bit_by_bit(tmp_path: Path, kind: Any, color: bool) -> None:
    frames = [noise_cloud(index, kind, color) for index in range(3)]
    with Recorder(tmp_path / "a.mcap") as recorder:
        for frame in frames:
            recorder.write(frame)
    for found, frame in zip(read(tmp_path / "a.mcap"), frames, strict=True):
        assert isinstance(found, CloudFrame)
        assert found.stamp_ns == frame.stamp_ns
        assert found.points.dtype == kind
        np.testing.assert_array_equal(found.points, frame.points)
        np.testing.assert_array_equal(found.colors, frame.colors)
    assert_whole(tmp_path / "a.mcap")


def test_another_unit_becomes_metres_without_loss(tmp_path: Path) -> None:
    frame = RgbdFrame(1, np.arange(64 * 48, dtype=np.uint16).reshape(48, 64) * 21, 0.0002, CAMERA)
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.write(frame)
    (found,) = read(tmp_path / "a.mcap")
    assert isinstance(found, RgbdFrame)
    assert found.depth_unit_m == 1
    np.testing.assert_array_equal(np.rint(found.depth / 0.0002), frame.depth)


KILLED = """
import sys
from pathlib import Path
from typing import Any
from test_recorder import noise_frame
from ropetrace.recorder import BackgroundRecorder, Recorder
recorder = Recorder(sys.argv[1])
background = BackgroundRecorder(recorder) if sys.argv[2] == "behind" else None
index = 0
while True:
    if background is None:
        recorder.write(noise_frame(index))
    else:
        background.put(noise_frame(index))
    index += 1
    print(recorder.frames, flush=True)
"""


@pytest.mark.parametrize("attempt", range(2))
@pytest.mark.parametrize("how", ["write", "behind"])
def test_kill_minus_nine_loses_no_acknowledged_frame(tmp_path: Path, how: str, attempt: int) -> None:
    path = tmp_path / "a.mcap"
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, path, how],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
        start_new_session=True,
    )
    assert process.stdout is not None
    with process:
        acknowledged = 0
        while not acknowledged:
            acknowledged = int(process.stdout.readline())
        end = time.monotonic() + random.uniform(0.05, 0.6)
        while time.monotonic() < end:
            acknowledged = int(process.stdout.readline())
        os.killpg(process.pid, signal.SIGKILL)
        acknowledged = max([acknowledged, *map(int, process.stdout.read().split())])
    killed = read(path)
    assert len(killed) >= acknowledged > 0
    assert contents(killed) == contents([noise_frame(index) for index in range(len(killed))])
    recover(path)
    assert_whole(path)
    assert contents(read(path)) == contents(killed)
    assert recover(path).was_whole


def test_a_file_that_is_cut_anywhere_is_finished(tmp_path: Path) -> None:
    frames = [noise_frame(index) for index in range(4)]
    path, sizes = tmp_path / "a.mcap", []
    with Recorder(path) as recorder:
        for frame in frames:
            recorder.write(frame)
            recorder.write_estimate(Estimate.lost(frame.stamp_ns, "nothing"))
            sizes.append(recorder.size)
    data = path.read_bytes()
    cuts = {sizes[0], *random.sample(range(sizes[0], len(data)), 30), *range(sizes[-1] - 20, len(data), 97)}
    for cut in cuts:
        path.write_bytes(data[:cut])
        before = read(path)
        recover(path)
        assert contents(read(path)) == contents(before)
        assert len(before) >= sum(size <= cut for size in sizes)
        assert_whole(path)
    path.write_bytes(data[: sizes[-1]] + bytes(5000))
    recover(path)
    assert path.read_bytes() == data, "zeros, as a power cut leaves them, are no frames"


def test_what_cannot_be_finished_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        for index in range(4):
            recorder.write(noise_frame(index))
            if index == 0:
                first = recorder.size
        with pytest.raises(OutputError, match="being written by another"):
            recover(path)
        data = bytearray(path.read_bytes())
    data[first + 200] ^= 1
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=f"damaged at byte {first}, and whole frames follow"):
        recover(path)
    assert path.read_bytes() == data
    path.write_bytes(data[: first // 2])
    with pytest.raises(RecordingError, match="no whole frame"):
        recover(path)
    path.write_bytes(b"something else altogether")
    with pytest.raises(RecordingError, match="not an MCAP"):
        recover(path)
    with pytest.raises(RecordingError, match="no such file"):
        recover(tmp_path / "none.mcap")


@pytest.mark.parametrize("compression", [CompressionType.LZ4, CompressionType.NONE, CompressionType.ZSTD])
def test_files_that_others_wrote_are_never_changed(run: Run, tmp_path: Path, compression: CompressionType) -> None:
    path = tmp_path / "in" / "a.mcap"
    path.parent.mkdir()
    with path.open("wb") as stream:
        writer: Any = Writer(stream, chunk_size=1000, compression=compression)
        writer.start()
        channel = writer.register_channel("/a", "json", writer.register_schema("a", "jsonschema", b"{}"))
        for index in range(100):
            writer.add_message(channel, index, b"%d" % index * 100, index)
        writer.finish()
    data = path.read_bytes()
    assert recover(path).was_whole
    damaged = bytearray(data)
    damaged[3000] ^= 1
    for left in (data[:-2000], bytes(damaged[:-500]), data[:30]):
        path.write_bytes(left)
        code, _, err = run("recover", "in/a.mcap")
        assert (code, err.count("\n")) == (2, 1)
        assert "in/a.mcap: not written by ropetrace: nothing was changed" in err
        assert "`ropetrace record in/a.mcap --out copy.mcap`" in err
        assert path.read_bytes() == left


def test_a_message_index_that_is_damaged_is_not_copied(tmp_path: Path) -> None:
    path, sizes = tmp_path / "a.mcap", []
    with Recorder(path) as recorder:
        for index in range(3):
            recorder.write(noise_frame(index))
            sizes.append(recorder.size)
    whole = path.read_bytes()
    data = bytearray(whole[: sizes[-1]])
    data[-1] ^= 1  # the place of a message in its chunk
    path.write_bytes(data)
    recover(path)
    assert path.read_bytes() == whole
    data[sizes[1] - 1] ^= 1
    path.write_bytes(data)
    with pytest.raises(RecordingError, match="and whole frames follow"):
        recover(path)
    assert path.read_bytes() == data


def test_the_index_may_be_larger_than_any_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        for index in range(40):
            recorder.write(noise_frame(index))
        start = recorder.size
    assert (tmp_path / "a.mcap").stat().st_size - start < 130 * 40 + 10_000, "what a day of 30 Hz is told to cost"
    for module in ("mcap_parts", "mcap_source"):
        monkeypatch.setattr(f"ropetrace.recordings.{module}.MAX_MESSAGE_BYTES", 4000, raising=False)
    with (tmp_path / "a.mcap").open("rb") as stream:
        problems: list[str] = []
        assert read_summary(stream, (tmp_path / "a.mcap").stat().st_size, problems) is not None
    assert problems == []


def test_a_full_disk_ends_the_recording_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with file_limit(100_000), BackgroundRecorder(Recorder(path)) as background:
        for index in range(30):
            background.put(noise_frame(index))
        deadline = time.monotonic() + 10
        while background.failure is None and time.monotonic() < deadline:
            time.sleep(0.01)
        assert not background.offer(noise_frame(30))
        background.write(30, Estimate.lost(1, "nothing"))
    assert "File too large" in str(background.failure)
    written = background.recorder.frames
    assert 0 < written < 30
    assert background.dropped == 31 - written
    assert background.dropped_estimates == 1
    assert contents(read(path)) == contents([noise_frame(index) for index in range(written)])
    recover(path)
    assert_whole(path)


def test_a_disk_that_fails_late_ends_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(file: WholeFile) -> None:
        if file.size < 100_000:
            return
        raise OutputError("a.mcap: cannot be written: Input/output error")

    monkeypatch.setattr("ropetrace.recorder.SYNC_SECONDS", 0.01)
    monkeypatch.setattr(WholeFile, "sync", fail)
    recorder = Recorder(tmp_path / "a.mcap")

    def fill() -> None:
        for index in range(1000):
            recorder.write(noise_frame(index))
            time.sleep(0.002)

    with pytest.raises(OutputError, match="Input/output error"):
        fill()
    with pytest.raises(OutputError, match="Input/output error"):
        recorder.close()
    assert len(read(tmp_path / "a.mcap")) == recorder.frames


def test_a_disk_that_fails_after_the_last_frame_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The system tells of it once, and only whoever asks first."""
    told = threading.Event()

    def fail_once(file: WholeFile) -> None:
        if not told.is_set():
            told.set()
            raise OutputError("a.mcap: cannot be written: Input/output error")

    monkeypatch.setattr("ropetrace.recorder.SYNC_SECONDS", 0.01)
    monkeypatch.setattr(WholeFile, "sync", fail_once)
    background = BackgroundRecorder(Recorder(tmp_path / "a.mcap"))
    told.wait(10)
    with pytest.raises(OutputError, match="Input/output error"):
        background.close()
    background.close()


def test_what_comes_after_the_end_is_counted_and_nobody_waits(tmp_path: Path) -> None:
    background = BackgroundRecorder(Recorder(tmp_path / "a.mcap"))
    background.put(noise_frame(0))
    background.close()
    background.put(noise_frame(1))
    assert not background.offer(noise_frame(2))
    background.write(3, Estimate.lost(1, "nothing"))
    assert (background.recorder.frames, background.dropped, background.dropped_estimates) == (1, 2, 1)


def test_the_disk_is_made_to_take_it_twice_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    monkeypatch.setattr(WholeFile, "sync", lambda file: calls.append(threading.current_thread().name))
    started = time.monotonic()
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.write(noise_frame(0))
        wait_until(lambda: len(calls) >= 3)
        assert time.monotonic() - started > 0.9
        assert set(calls) == {"recorder sync"}


def test_what_does_not_fit_the_queue_is_dropped_and_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on, write = threading.Event(), Recorder.write

    def slow(recorder: Recorder, frame: Frame) -> None:
        go_on.wait(10)
        write(recorder, frame)

    monkeypatch.setattr(Recorder, "write", slow)
    frame_bytes = 64 * 48 * 5
    with BackgroundRecorder(Recorder(tmp_path / "a.mcap"), limit=3 * frame_bytes) as background:
        started = time.monotonic()
        taken = [background.offer(noise_frame(index)) for index in range(10)]
        assert time.monotonic() - started < 1, "nobody waits"
        go_on.set()
        background.put(noise_frame(10))
    assert taken == [True] * 3 + [False] * 7
    assert background.dropped == 7
    assert contents(read(tmp_path / "a.mcap")) == contents([noise_frame(index) for index in (0, 1, 2, 10)])


def test_frames_of_another_camera_are_refused(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.write(noise_frame(0))
        with pytest.raises(FrameError, match="not that of the first frame"):
            recorder.write(noise_frame(1, color=False))
        with pytest.raises(FrameError, match="ROS time"):
            recorder.write(RgbdFrame(-1, noise_frame(1).depth, 0.001, CAMERA, noise_frame(1).color))
        recorder.write(noise_frame(2))
    assert contents(read(tmp_path / "a.mcap")) == contents([noise_frame(0), noise_frame(2)])
    with BackgroundRecorder(Recorder(tmp_path / "b.mcap")) as background:
        background.put(noise_frame(0))
        background.put(noise_frame(1, color=False))
    assert background.failure is None
    assert sum(background.refused.values()) == 1


def test_a_file_that_exists_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"mine")
    with pytest.raises(OutputError, match="exists already"):
        Recorder(path)
    assert path.read_bytes() == b"mine"
    with Recorder(path, overwrite=True) as recorder:
        recorder.write(noise_frame(0))
        with pytest.raises(OutputError, match="being written by another"):
            Recorder(path, overwrite=True)
        with pytest.raises(OutputError, match="being written by another"):
            open_writer(path, overwrite=True)
    assert len(read(path)) == 1


@pytest.mark.parametrize("ending", [".csv", ".mcap", ".rrd"])
def test_a_second_writer_destroys_nothing(tmp_path: Path, ending: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if ending == ".rrd":
        pytest.importorskip("rerun")
    path = tmp_path / f"a{ending}"
    with open_writer(path) as writer:
        writer.write(0, Estimate.lost(1, "nothing"))
        before = path.read_bytes()
        with pytest.raises(OutputError, match="being written by another"):
            open_writer(path, overwrite=True)
        assert path.read_bytes() == before
    before, flock = path.read_bytes(), fcntl.flock
    found = []

    def lock(file: Any, operation: int) -> None:
        flock(file, operation)
        found.append((path.read_bytes(), fcntl.fcntl(file, fcntl.F_GETFL) & os.O_ACCMODE))

    monkeypatch.setattr(fcntl, "flock", lock)
    open_writer(path, overwrite=True).close()
    assert found == [(before, os.O_WRONLY)], "locked before it is emptied, in a way that NFS takes"


def test_without_a_frame_the_old_recording_stays(tmp_path: Path) -> None:
    path, lost = tmp_path / "a.mcap", Estimate.lost(1, "nothing")
    with Recorder(path) as recorder:
        recorder.write_estimate(lost)
        with pytest.raises(FrameError, match="ROS time"):
            recorder.write(RgbdFrame(-1, noise_frame(1).depth, 0.001, CAMERA))
    assert not path.exists()
    path.write_bytes(b"old")
    with Recorder(path, overwrite=True) as recorder:
        for _ in range(1000):
            recorder.write_estimate(lost)
        with pytest.raises(FrameError, match="1000 estimates wait"):
            recorder.write_estimate(lost)
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"old"
    with Recorder(path, overwrite=True) as recorder:
        recorder.write_estimate(lost)
        recorder.write(noise_frame(0))
    assert len(messages(path)) == 3
    assert_whole(path)


# The commands


def messages(path: Path) -> list[tuple[str, int, bytes]]:
    with path.open("rb") as stream:
        return [
            (channel.topic, message.log_time, message.data)
            for _, channel, message in make_reader(stream).iter_messages()
            if channel.topic.startswith("/ropetrace")
        ]


def test_record_with_a_rope_has_the_results_of_track(run: Run, tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "in.mcap", rope_frames())
    rope = ("--diameter", "12mm", "--color", "#c8281e")
    assert run("track", source, *rope, "--out", "track.mcap")[0] == 0
    code, out, _ = run("record", source, *rope, "--out", "record.mcap")
    assert code == 0
    assert "recorded  8 frames" in out
    assert messages(tmp_path / "record.mcap") == messages(tmp_path / "track.mcap") != []
    assert contents(read(tmp_path / "record.mcap")) == contents(rope_frames())
    assert_whole(tmp_path / "record.mcap")
    assert run("recover", "record.mcap") == (0, "record.mcap is whole: 64 messages; nothing was changed\n", "")
    (tmp_path / "record.mcap").write_bytes((tmp_path / "record.mcap").read_bytes()[:-1000])
    code, out, _ = run("recover", "record.mcap")
    assert code == 0
    assert "finished" in out


def test_record_refuses_in_one_line(run: Run, tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "in.mcap", rope_frames(2))
    for arguments, words in (
        (("in.mcap", "--out", "out.csv"), "out.csv: a recording is an .mcap file"),
        (("in.mcap", "--out", "in.mcap", "--overwrite"), "belongs to, the input"),
        (("in.mcap", "--out", "none/out.mcap"), "does not exist"),
        (("in.mcap", "--out", "out.mcap", "--color", "#c8281e"), "diameter is missing"),
        (("none", "--out", "out.mcap"), "cannot be read"),
        (("in.mcap", "--out", "out.mcap", "--start", 9), "no frame was recorded"),
    ):
        code, _, err = run("record", *arguments)
        assert (code, err.count("\n")) == (1 if "no frame" in words else 2, 1)
        assert words in err
    assert [path.name for path in tmp_path.iterdir()] == ["in.mcap"]
    assert len(read(source)) == 2


def test_record_overwrites_when_a_frame_has_come(run: Run, tmp_path: Path) -> None:
    write_mcap(tmp_path / "in.mcap", rope_frames(2))
    old = write_mcap(tmp_path / "out.mcap", rope_frames(3)).read_bytes()
    code, _, err = run("record", "in.mcap", "--out", "out.mcap", "--overwrite", "--start", 9)
    assert (code, err) == (1, "ropetrace: no frame was recorded\n")
    assert (tmp_path / "out.mcap").read_bytes() == old
    assert run("record", "in.mcap", "--out", "out.mcap", "--overwrite")[0] == 0
    assert len(read(tmp_path / "out.mcap")) == 2


def test_an_interrupt_before_the_first_frame_is_told(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_mcap(tmp_path / "in.mcap", rope_frames(2))

    def interrupted(*arguments: Any) -> Iterator[Frame]:
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr("ropetrace.recordings.ros_recording.RosRecording.frames", interrupted)
    code, out, err = run("record", "in.mcap", "--out", "out.mcap")
    assert (code, err) == (130, "ropetrace: interrupted; no frame was recorded\n")
    assert "written" not in out
    assert not (tmp_path / "out.mcap").exists()


def test_estimates_of_a_file_wait_for_the_disk(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = write_mcap(tmp_path / "in.mcap", rope_frames())
    write = Recorder.write_estimate

    def slow(recorder: Recorder, estimate: Estimate) -> None:
        time.sleep(0.05)
        write(recorder, estimate)

    monkeypatch.setattr(Recorder, "write_estimate", slow)
    monkeypatch.setattr("ropetrace.recorder.QUEUE_ESTIMATES", 1)
    monkeypatch.setattr("ropetrace.trackers.make_tracker", lambda config: Slow(0.0))
    code, out, _ = run("record", source, "--out", "out.mcap", "--diameter", "12mm")
    assert code == 0
    assert "lost      " not in out
    assert sum(topic.endswith("status") for topic, _, _ in messages(tmp_path / "out.mcap")) == 8


def test_estimates_that_are_lost_are_told(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = Recorder.write_estimate

    def slow(recorder: Recorder, estimate: Estimate) -> None:
        time.sleep(0.2)
        write(recorder, estimate)

    monkeypatch.setattr(Recorder, "write_estimate", slow)
    monkeypatch.setattr("ropetrace.recorder.QUEUE_ESTIMATES", 1)
    monkeypatch.setattr("ropetrace.trackers.make_tracker", lambda config: Slow(0.0))
    set_camera(monkeypatch, noise_frame, period=0.005)
    code, out, err = run("record", "sim:", "--out", "out.mcap", "--diameter", "12mm", "--limit", 20)
    assert "recorded  20 frames" in out
    assert number("estimates that the disk was too slow", out) > 0
    assert (code, err) == (3, "ropetrace: part of the estimates is not in the recording (see above)\n")


def test_stamps_that_do_not_fit_are_one_reason(tmp_path: Path) -> None:
    with BackgroundRecorder(Recorder(tmp_path / "a.mcap")) as background:
        for index in range(1, 6):
            background.put(dataclasses.replace(noise_frame(index), stamp_ns=-index))
            background.put_estimate(Estimate.lost(-index, "nothing"))
    assert background.refused == {"the stamp does not fit a ROS time: before 1970, or after 2038": 10}


def test_record_tells_what_is_missing(run: Run, tmp_path: Path) -> None:
    data = write_mcap(tmp_path / "in.mcap", rope_frames(4)).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    code, out, err = run("record", "cut.mcap", "--out", "out.mcap")
    assert code == 3
    assert "damage" in out
    assert "part of the frames" in err
    assert_whole(tmp_path / "out.mcap")


def test_record_on_a_full_disk_says_so(run: Run, tmp_path: Path) -> None:
    with Recorder(tmp_path / "in.mcap") as recorder:
        for index in range(20):
            recorder.write(noise_frame(index))
    with file_limit(100_000):
        code, out, err = run("record", "in.mcap", "--out", "out.mcap")
    assert code == 2
    assert "lost" in out
    assert err == "ropetrace: out.mcap: cannot be written: File too large; what was recorded before is kept\n"
    assert len(read(tmp_path / "out.mcap")) >= 3


SLOW = """
import sys, time
from ropetrace import cli
from ropetrace.recordings.ros_recording import RosRecording
frames = RosRecording.frames
def slow(*arguments):
    for frame in frames(*arguments):
        time.sleep(0.05)
        yield frame
RosRecording.frames = slow
sys.argv = ["ropetrace", "record", "in.mcap", "--out", "out.mcap"]
cli.main()
"""


OWN_TERMINAL = """
import fcntl, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
"""


@pytest.mark.parametrize("number", terminal.ENDINGS)
def test_ctrl_c_leaves_a_whole_file(tmp_path: Path, number: signal.Signals) -> None:
    with Recorder(tmp_path / "in.mcap") as recorder:
        for index in range(200):
            recorder.write(noise_frame(index))
    process = subprocess.Popen(
        [sys.executable, "-c", SLOW], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    out = tmp_path / "out.mcap"
    deadline = time.monotonic() + 300
    while (not out.exists() or out.stat().st_size < 50_000) and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(number)
    _, err = process.communicate(timeout=300)
    assert process.returncode == 130
    assert err == "ropetrace: interrupted; what was recorded until then is kept\n"
    found = read(out)
    assert contents(found) == contents([noise_frame(index) for index in range(len(found))])
    assert 2 <= len(found) < 200
    assert_whole(out)


def test_a_terminal_that_is_gone_leaves_a_whole_file(tmp_path: Path) -> None:
    """As when ``ssh`` breaks off: nothing more can be told."""
    with Recorder(tmp_path / "in.mcap") as recorder:
        for index in range(200):
            recorder.write(noise_frame(index))
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", OWN_TERMINAL + SLOW],
        cwd=tmp_path,
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        start_new_session=True,
    )
    os.close(theirs)
    out = tmp_path / "out.mcap"

    def is_begun() -> bool:
        if select.select([ours], [], [], 0)[0]:
            os.read(ours, 65536)
        return out.exists() and out.stat().st_size > 50_000

    wait_until(is_begun)
    os.close(ours)
    assert process.wait(60) == 130
    found = read(out)
    assert contents(found) == contents([noise_frame(index) for index in range(len(found))])
    assert 2 <= len(found) < 200
    assert_whole(out)


def test_ctrl_c_while_a_frame_is_tracked_waits_for_it(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An exception out of a callback of the compiler would be swallowed there, or become a SystemError."""
    told: list[int] = []
    monkeypatch.setattr(terminal, "INTERRUPTS", told)
    monkeypatch.setattr(cli_record, "INTERRUPTS", told)

    class Interrupted(Slow):
        def update(self, frame: Frame | BadFrame, lap: Any = None) -> Estimate:
            signal.raise_signal(signal.SIGINT)
            return super().update(frame, lap)

    monkeypatch.setattr("ropetrace.trackers.make_tracker", lambda config: Interrupted(0.0))
    write_mcap(tmp_path / "in.mcap", rope_frames())
    code, out, err = run("record", "in.mcap", "--out", "out.mcap", "--diameter", "12mm")
    assert (code, err) == (130, "ropetrace: interrupted; what was recorded until then is kept\n")
    assert "frames    1 (" in out
    assert sum(topic.endswith("status") for topic, _, _ in messages(tmp_path / "out.mcap")) == 1


# Live cameras


class Slow:
    """A tracker that finds nothing; by default in three frames' time of a camera of 30 Hz."""

    def __init__(self, seconds: float = 0.1) -> None:
        self._seconds = seconds

    def update(self, frame: Frame | BadFrame, lap: Any = None) -> Estimate:
        time.sleep(self._seconds)
        return Estimate.lost(frame.stamp_ns, "not looked for")

    def cloud(self) -> None:
        return None

    def reset(self) -> None: ...


def set_camera(monkeypatch: pytest.MonkeyPatch, script: Script, **options: Any) -> None:
    """Have ``sim:`` be this camera."""
    monkeypatch.setattr("ropetrace.live.simulated.SimulatedCamera", lambda name: ScriptedCamera(script, **options))


def number(words: str, text: str) -> int:
    """The figure before these words."""
    found = re.search(rf"(\d+) {words}", text)
    assert found is not None, text
    return int(found[1])


def test_a_camera_is_recorded_whole_while_the_tracker_is_busy(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ropetrace.trackers.make_tracker", lambda config: Slow())
    scenario = quick_scenario(tmp_path, 30.0)
    code, out, _ = run("record", f"sim:{scenario}", "--out", "out.mcap", "--diameter", "12mm", "--limit", 60)
    assert code == 0
    stamps = [frame.stamp_ns for frame in read(tmp_path / "out.mcap")]
    assert len(stamps) == 60
    np.testing.assert_allclose(np.diff(stamps), 1e9 / 30, atol=2)
    tracked = [stamp for topic, stamp, _ in messages(tmp_path / "out.mcap") if topic.endswith("status")]
    assert 3 <= len(tracked) < 40
    assert set(tracked) <= set(stamps)
    assert tracked[-1] > 0.6 * stamps[-1], "the newest frame is tracked, not the next one"
    assert f"frames    {len(tracked)} (" in out
    assert number("frames that came while the tracker was busy", out) == 60 - len(tracked)
    assert_whole(tmp_path / "out.mcap")


def test_a_camera_that_is_faster_than_the_disk_is_told(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = Recorder.write

    def slow(recorder: Recorder, frame: Frame) -> None:
        time.sleep(0.02)
        write(recorder, frame)

    monkeypatch.setattr(Recorder, "write", slow)
    monkeypatch.setattr("ropetrace.recorder.BackgroundRecorder", partial(BackgroundRecorder, limit=3 * 64 * 48 * 5))
    set_camera(monkeypatch, noise_frame, period=0.001)
    code, out, err = run("record", "sim:", "--out", "out.mcap", "--limit", 80)
    assert code == 3
    assert "part of the frames is not in the recording" in err
    recorded, lost = number("frames, ", out), number("frames and 0 estimates that the disk was too slow", out)
    assert recorded + lost == 80
    assert lost > 20
    assert recorded == len(read(tmp_path / "out.mcap")) >= 3


def test_a_camera_that_goes_off_for_good_leaves_what_was_recorded(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def script(index: int) -> Frame | Exception:
        return noise_frame(index) if index < 20 else CameraGoneError("the cable was pulled")

    set_camera(monkeypatch, script, absent=10**6)
    defaults = LiveRecording.__init__.__kwdefaults__
    assert defaults is not None
    monkeypatch.setitem(defaults, "give_up", 0.3)
    code, out, err = run("record", "sim:", "--out", "out.mcap")
    assert code == 2
    assert "recorded  20 frames" in out
    assert re.fullmatch(r"ropetrace: sim:: .* gave no frame for \d\.\d s: .*; what was recorded before is kept\n", err)
    assert contents(read(tmp_path / "out.mcap")) == contents([noise_frame(index) for index in range(20)])
    assert_whole(tmp_path / "out.mcap")


def test_frames_of_another_size_are_left_out_and_told(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_camera(monkeypatch, lambda index: tiny(index) if index % 10 == 5 else noise_frame(index))
    code, out, err = run("record", "sim:", "--out", "out.mcap", "--limit", 30)
    assert code == 3
    assert "recorded  27 frames" in out
    assert "refused   3 x its camera, size, unit or colour is not that of the first frame" in out
    assert "part of the frames is not in the recording" in err
    assert len(read(tmp_path / "out.mcap")) == 27


def test_a_clock_that_jumps_loses_no_frame(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def script(index: int) -> Frame:
        jump = -3600 * 10**9 if index >= 10 else 0
        return dataclasses.replace(noise_frame(index), stamp_ns=noise_frame(index).stamp_ns + jump)

    set_camera(monkeypatch, script)
    code, out, _ = run("record", "sim:", "--out", "out.mcap", "--limit", 20)
    assert code == 0
    assert "jumped 1 times, by 3600." in out
    assert contents(read(tmp_path / "out.mcap")) == contents([script(index) for index in range(20)])
    assert_whole(tmp_path / "out.mcap")


def test_a_disk_that_fills_up_ends_the_recording_of_a_camera(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_camera(monkeypatch, noise_frame)
    with small_file_system(tmp_path / "disk", 256) as disk:
        code, out, err = run("record", "sim:", "--out", disk / "out.mcap")
        assert code == 2
        reason = f"{disk}/out.mcap: cannot be written: No space left on device"
        assert err == f"ropetrace: {reason}; what was recorded before is kept\n"
        found = read(disk / "out.mcap")
        assert number("frames, ", out) == len(found) >= 5
        assert contents(found) == contents([noise_frame(index) for index in range(len(found))])


@pytest.mark.parametrize("rope", [(), ("--diameter", "12mm")])
def test_kill_minus_nine_loses_no_frame_that_the_terminal_told_of(tmp_path: Path, rope: tuple[str, ...]) -> None:
    path = tmp_path / "out.mcap"
    acknowledged = killed_on_a_terminal(f"sim:{quick_scenario(tmp_path, 100.0)}", path, rope, random.uniform(0.1, 1))
    found = read(path)
    assert len(found) >= acknowledged > 0
    np.testing.assert_allclose(np.diff([frame.stamp_ns for frame in found]), 1e7, atol=2)


def killed_on_a_terminal(source: str, path: Path, rope: tuple[str, ...], seconds: float) -> int:
    """Record, kill it these seconds after the terminal told of a frame; how many it told of."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("4H", 40, 100, 0, 0))
    command = [sys.executable, "-m", "ropetrace", "record", source, "--out", str(path), *rope]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=theirs, start_new_session=True)
    os.close(theirs)
    shown = b""

    def told() -> int:
        return max(map(int, re.findall(rb"(\d+)frame \[", shown)), default=0)

    with process:
        end, deadline = math.inf, time.monotonic() + 300
        while process.poll() is None and time.monotonic() < min(end, deadline):
            if select.select([ours], [], [], 0.1)[0]:
                shown += os.read(ours, 65536)
            if end == math.inf and told():
                end = time.monotonic() + seconds
        os.killpg(process.pid, signal.SIGKILL)
    with suppress(OSError):  # the terminal is gone when all is read
        while more := os.read(ours, 65536):
            shown += more
    os.close(ours)
    return told()
