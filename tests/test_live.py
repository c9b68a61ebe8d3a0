"""Live sources: the newest frame wins, and whatever a camera does is told and harmless."""

from __future__ import annotations

import itertools
import re
import signal
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from helpers import RED_TEXT, SHAPES, seen
from ropetrace import cli_source
from ropetrace.config import RopeConfig
from ropetrace.errors import ConfigError, RecordingError
from ropetrace.live import Camera, CameraGoneError, Capture, LiveRecording, scheme_of
from ropetrace.live import stream as live_stream
from ropetrace.live.simulated import SimulatedCamera
from ropetrace.motion import make_motion
from ropetrace.recordings import open_recording
from ropetrace.trackers import SlicingTracker
from ropetrace.tracking import track_recording
from ropetrace.types import BadFrame, Estimate, Event, Intrinsics, RgbdFrame, Status

TINY = Intrinsics(8, 6, 7.0, 7.0, 3.5, 2.5)
PERIOD = 0.01
SECOND = 10**9

Script = Callable[[int], Event | Exception | None]


def tiny(stamp_ns: int, camera: Intrinsics = TINY) -> RgbdFrame:
    return RgbdFrame(stamp_ns, np.ones((camera.height, camera.width), np.float32), 1.0, camera)


def steady(index: int) -> RgbdFrame:
    return tiny(round(index * PERIOD * SECOND))


class ScriptedCamera:
    """A camera whose script says for each fetch what comes: a frame, nothing, or an error."""

    kind = "scripted camera"

    def __init__(self, script: Script, period: float = PERIOD, absent: int = 0) -> None:
        self.connected = self.disconnected = self.fetched = 0
        self.absent = absent
        self._script, self._period = script, period

    def connect(self) -> None:
        if self.connected and self.absent:
            self.absent -= 1
            raise CameraGoneError("not on the bus")
        self.connected += 1

    def fetch(self, timeout: float) -> Capture | None:
        time.sleep(self._period)
        self.fetched += 1
        event = self._script(self.fetched - 1)
        if isinstance(event, Exception):
            raise event
        return None if event is None else Capture(event, time.monotonic_ns())

    def disconnect(self) -> None:
        self.disconnected += 1


def live(camera: Camera, silence: float = 5.0, give_up: float = 60.0) -> LiveRecording:
    return LiveRecording("test:", camera, silence=silence, give_up=give_up)


def wait_for(condition: Callable[[], object]) -> None:
    end = time.monotonic() + 300
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.001)


def cameras_running() -> int:
    return sum(thread.name == "camera" for thread in threading.enumerate())


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Cameras are looked for more often, and none is left running."""
    monkeypatch.setattr(live_stream, "RETRY_SECONDS", 0.05)
    yield
    assert cameras_running() == 0


def test_frames_come_in_order_and_closing_joins_the_thread() -> None:
    camera = ScriptedCamera(steady)
    frames = live(camera).frames()
    stamps = [next(frames).stamp_ns for _ in range(10)]
    assert stamps == sorted(set(stamps))
    assert cameras_running() == 1
    del frames
    assert cameras_running() == 0
    assert (camera.connected, camera.disconnected) == (1, 1)


def test_a_limit_ends_the_frames_and_the_camera_may_be_read_again() -> None:
    camera = ScriptedCamera(steady)
    recording = live(camera)
    assert len(list(recording.frames(limit=3))) == 3
    assert len(list(recording.frames(limit=2))) == 2
    assert camera.disconnected == 2
    assert recording.intrinsics == TINY
    recording.close()


def test_a_second_reader_ends_the_first() -> None:
    recording = live(ScriptedCamera(steady), silence=0.1)
    first = recording.frames()
    next(first)
    second = recording.frames()
    next(second)
    assert list(first) == []
    wait_for(lambda: isinstance(next(second), RgbdFrame))
    recording.close()
    assert list(second) == []


def test_a_slow_reader_gets_the_newest_and_the_others_are_counted() -> None:
    camera = ScriptedCamera(steady, period=0.002)
    recording = live(camera)
    taken: list[int] = []
    newest = 0
    for event in recording.frames(limit=8):
        taken.append(round(event.stamp_ns / SECOND / PERIOD))
        assert taken[-1] >= newest, "the newest frame wins"
        enough = camera.fetched + 8
        wait_for(lambda enough=enough: camera.fetched >= enough)  # type: ignore[misc]
        # The last one may be on its way, but not the one before it.
        newest = camera.fetched - 2
    assert recording.dropped >= 7 * 5
    assert recording.dropped == taken[-1] + 1 - len(taken), "every frame was taken or is counted"
    assert 0 < recording.dropped_at_start < recording.dropped
    late = int(re.findall(r"\d+", recording.lines()[0])[0])
    assert late == recording.dropped - recording.dropped_at_start


def test_whoever_wants_all_frames_is_given_them() -> None:
    recording = live(ScriptedCamera(steady, period=0.002))
    given: list[Event] = []
    recording.on_event = given.append
    taken = []
    for event in recording.frames(limit=5):
        assert given[-1].stamp_ns >= event.stamp_ns, "before anybody takes it"
        taken.append(event)
        enough = len(given) + 8
        wait_for(lambda enough=enough: len(given) >= enough)  # type: ignore[misc]
    assert [event.stamp_ns for event in given] == [steady(index).stamp_ns for index in range(len(given))]
    assert len(given) > 20
    assert all(any(event is other for other in given) for event in taken)


def test_a_camera_that_hangs_hands_on_nothing_after_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_stream, "CLOSE_SECONDS", 0.05)
    going_on = threading.Event()
    given: list[Event] = []

    def script(index: int) -> Event:
        if index == 3:
            going_on.wait(300)
        return steady(index)

    camera = ScriptedCamera(script)
    recording = live(camera)
    recording.on_event = given.append
    frames = recording.frames()
    next(frames)
    wait_for(lambda: camera.fetched == 4)
    recording.close()
    known = len(given)
    going_on.set()
    wait_for(lambda: camera.disconnected == 1)
    assert len(given) == known
    assert any("hangs and did not stop" in problem for problem in recording.problems)


def test_times_without_frames_are_told_one_by_one_and_then_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ropetrace.live.recording.MOST_GAPS", 2)
    recording = live(ScriptedCamera(lambda index: steady(index) if index % 8 == 0 else None), silence=0.03)
    frames = recording.frames()
    wait_for(lambda: isinstance(next(frames), RgbdFrame) and len(recording.problems) == 3)
    told = recording.problems[2]
    wait_for(lambda: isinstance(next(frames), RgbdFrame) and recording.problems[2] != told)
    recording.close()
    assert len(recording.problems) == 3
    assert all("gave no frame for" in problem for problem in recording.problems[:2])
    assert re.fullmatch(r"and \d+ more times without frames", recording.problems[2])


def test_a_fault_of_whoever_wants_all_frames_is_told() -> None:
    recording = live(ScriptedCamera(steady))
    recording.on_event = lambda event: 1 / 0
    with pytest.raises(RecordingError, match="ZeroDivisionError"):
        next(recording.frames())


def test_frames_that_nobody_takes_need_no_memory() -> None:
    camera = ScriptedCamera(lambda index: tiny(index, Intrinsics(400, 300, 300.0, 300.0, 199.5, 149.5)), period=0.001)
    frames = live(camera).frames()
    next(frames)
    tracemalloc.start()
    enough = camera.fetched + 30
    wait_for(lambda: camera.fetched >= enough)
    kept = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert kept < 3 * 400 * 300 * 4


def test_a_camera_that_goes_off_is_told_and_taken_up_again() -> None:
    def script(index: int) -> Event | Exception:
        return CameraGoneError("the cable was pulled") if index == 20 else steady(index)

    camera = ScriptedCamera(script, absent=10**6)
    recording = live(camera, silence=0.1)
    frames = recording.frames()
    events: list[Event] = []
    bad: list[BadFrame] = []
    # On a slow machine it may be silent before, too.
    while len(bad) < 2:
        events.append(next(frames))
        if isinstance(events[-1], BadFrame) and "is it still connected" not in events[-1].reason:
            bad.append(events[-1])
    camera.absent = 0
    wait_for(lambda: isinstance(next(frames), RgbdFrame))
    recording.close()
    assert re.search(r"gave no frame for \d+\.\d s: (not on the bus|the cable was pulled)", bad[0].reason)
    assert bad[0].stamp_ns > events[events.index(bad[0]) - 1].stamp_ns
    assert camera.connected == camera.disconnected == 2
    assert 1 <= len(recording.problems) < sum(isinstance(event, BadFrame) for event in events), "once each time"
    assert all("gave no frame for" in problem for problem in recording.problems)


def test_a_camera_that_falls_silent_is_started_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_stream, "RESTART_SECONDS", 0.2)
    camera = ScriptedCamera(lambda index: None if index >= 5 and camera.connected == 1 else steady(index))
    events = list(live(camera, silence=0.1).frames(limit=20))
    assert camera.connected >= 2
    assert any(isinstance(event, BadFrame) and "is it still connected" in event.reason for event in events)
    assert sum(isinstance(event, RgbdFrame) for event in events) > 5


def test_a_camera_off_for_two_seconds_gives_lost_estimates_and_then_good_ones() -> None:
    """With the default patience."""
    picture = seen(SHAPES["hanging"])

    statuses: list[Status] = []

    def script(index: int) -> Event | Exception:
        if len(statuses) >= 5 and camera.connected == 1:
            return CameraGoneError("the cable was pulled")
        return RgbdFrame(time.monotonic_ns(), picture.depth, 1.0, picture.intrinsics, picture.color)

    camera = ScriptedCamera(script, period=0.03, absent=40)
    recording = LiveRecording("test:", camera)
    tracker = SlicingTracker(RopeConfig(0.012, RED_TEXT))
    tracker.update(picture)  # compiling for longer than the camera is off would hide that it was
    tracker.reset()
    summary = track_recording(
        recording.frames(limit=20),
        tracker,
        age=recording.age,
        on_frame=lambda estimate: statuses.append(estimate.status),
    )
    assert statuses.count(Status.LOST) >= 1
    assert statuses[-5:] == [Status.OK] * 5
    assert len(summary.latency_seconds) == 20 - statuses.count(Status.LOST)
    assert re.search(r"no frame for \d+\.\d s", recording.problems[0])


@pytest.mark.parametrize("begun", [False, True])
def test_a_camera_that_gives_nothing_ends_with_an_error(begun: bool) -> None:
    camera = ScriptedCamera(lambda index: steady(index) if begun and index == 0 else None)
    recording = live(camera, silence=0.1, give_up=60.0 if begun else 0.35)
    frames = recording.frames()
    begin = time.monotonic()
    if begun:
        next(frames)
        recording._give_up = 0.35
    with pytest.raises(RecordingError, match=r"test:: the scripted camera gave no frame for \d+\.\d s"):
        list(frames)
    assert time.monotonic() - begin > 0.3
    assert len(recording.problems) == begun


def test_a_camera_that_hangs_is_told_and_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_stream, "CLOSE_SECONDS", 0.1)
    release = threading.Event()

    def script(index: int) -> Event:
        if index == 3:
            release.wait(300)
        return steady(index)

    camera = ScriptedCamera(script)
    recording = live(camera, silence=0.1)
    frames = recording.frames()
    next(frames)
    wait_for(lambda: camera.fetched == 4)
    recording._give_up = 0.3
    with pytest.raises(RecordingError, match="gave no frame"):
        list(frames)
    assert any("hangs and did not stop" in problem for problem in recording.problems)
    release.set()
    for thread in threading.enumerate():
        if thread.name == "camera":
            thread.join(300)


@pytest.mark.parametrize("returning", [False, True])
def test_a_camera_that_is_still_being_connected_is_let_go(returning: bool) -> None:
    reached, going_on = threading.Event(), threading.Event()

    class Slow(ScriptedCamera):
        def connect(self) -> None:
            if self.connected == returning:
                reached.set()
                assert going_on.wait(60)
            super().connect()

    camera = Slow(lambda index: CameraGoneError("the cable was pulled") if returning else steady(index))
    stream = live_stream.Stream(camera)
    assert reached.wait(60)
    threading.Timer(0.05, going_on.set).start()
    assert stream.close()
    assert camera.disconnected == camera.connected == 1 + returning


def test_a_camera_that_is_not_there_at_first_is_no_source() -> None:
    camera = ScriptedCamera(steady, absent=10**6)
    camera.connected = 1
    with pytest.raises(CameraGoneError, match="not on the bus"):
        next(live(camera).frames())


def test_a_fault_in_the_thread_is_one_typed_error() -> None:
    def script(index: int) -> Event | Exception:
        return ZeroDivisionError("in the driver") if index == 4 else steady(index)

    camera = ScriptedCamera(script)
    with pytest.raises(RecordingError, match="the scripted camera failed: ZeroDivisionError: in the driver") as raised:
        list(live(camera).frames())
    assert isinstance(raised.value.__cause__, ZeroDivisionError)
    assert camera.disconnected == 1


def test_our_own_errors_pass_as_they_are() -> None:
    with pytest.raises(ConfigError, match="the rope became unstable"):
        list(live(ScriptedCamera(lambda index: ConfigError("the rope became unstable"))).frames())


def test_stamps_of_the_future_that_run_back_are_told_and_harmless() -> None:
    picture = seen(SHAPES["hanging"])
    estimates: list[Estimate] = []

    def script(index: int) -> Event:
        stamp = time.monotonic_ns() + (10 * SECOND if 8 <= len(estimates) < 16 else 0)
        return RgbdFrame(stamp, picture.depth, 1.0, picture.intrinsics, picture.color)

    tracker, motion = SlicingTracker(RopeConfig(0.012, RED_TEXT)), make_motion("arc_length", 0.012)
    assert motion is not None
    recording = live(ScriptedCamera(script))
    # Compiling for longer than the stamps run ahead would hide that they do.
    track_recording(recording.frames(limit=2), tracker, motion=motion, predict="now", age=recording.age)
    tracker.reset()
    motion.reset()
    track_recording(
        recording.frames(limit=20),
        tracker,
        motion=motion,
        predict="now",
        age=recording.age,
        on_frame=estimates.append,
    )
    doubts = [estimate.reasons for estimate in estimates if estimate.status is not Status.OK]
    assert len(doubts) == 1
    assert "the stamp runs back by 9." in doubts[0][0]
    for estimate in estimates:
        assert estimate.status is not Status.LOST
        assert np.isfinite(estimate.waypoints.positions).all()
        assert 0 <= estimate.ahead_ns < 5 * SECOND
    said = "\n".join(recording.lines())
    assert "the stamps jumped 2 times, by 10.0 s at most" in said
    assert "1 stamps repeat the one before or run back" in said
    assert recording.problems == []


@pytest.mark.parametrize("off", [10.0, -10.0])
def test_a_latency_that_cannot_be_true_counts_from_the_arrival(off: float) -> None:
    class WrongClock(ScriptedCamera):
        def fetch(self, timeout: float) -> Capture | None:
            capture = super().fetch(timeout)
            assert capture is not None
            return Capture(capture.event, capture.arrival_ns, capture.arrival_ns + round(off * SECOND))

    recording = live(WrongClock(steady))
    for _ in recording.frames(limit=3):
        assert 0 <= recording.age() < 5
    assert "3 stamps are of the future or over 1 s old" in recording.lines()[-1]


def test_frames_of_changing_size() -> None:
    small, large = seen(SHAPES["hanging"]), seen(SHAPES["hanging"], camera=Intrinsics(640, 480, 554, 554, 319.5, 239.5))

    def script(index: int) -> Event:
        picture = large if index % 4 > 1 else small
        return RgbdFrame(time.monotonic_ns(), picture.depth, 1.0, picture.intrinsics, picture.color)

    estimates: list[Estimate] = []
    recording = live(ScriptedCamera(script))
    track_recording(recording.frames(limit=12), SlicingTracker(RopeConfig(0.012, RED_TEXT)), on_frame=estimates.append)
    assert {estimate.status for estimate in estimates} == {Status.OK}
    assert recording.intrinsics in (small.intrinsics, large.intrinsics)


def test_info_looks_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ropetrace.live.recording.INFO_SECONDS", 0.3)
    info = live(ScriptedCamera(steady)).info()
    (stream,) = info.streams
    assert (stream.encoding, stream.width, stream.height) == ("float32 depth", 8, 6)
    assert stream.rate_hz is not None
    assert 10 < stream.rate_hz <= 100.001
    assert stream.count > 3
    assert (info.kind, info.intrinsics, info.problems) == ("live scripted camera", TINY, ())


def test_a_start_is_refused() -> None:
    with pytest.raises(RecordingError, match="no beginning: leave out --start"):
        live(ScriptedCamera(steady)).frames(start=1)


def test_addresses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert scheme_of("sim:swing") == "sim"
    assert scheme_of(Path("realsense:")) == "realsense"
    assert scheme_of("recording.mcap") is None
    assert scheme_of("C:/recording") is None
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sim:swing").mkdir()
    assert scheme_of("sim:swing") is None


@pytest.mark.parametrize(
    ("address", "options", "error", "words"),
    [
        ("kinect:0", {}, RecordingError, "kinect: is no live source: give sim:SCENARIO"),
        ("sim:nope", {}, ConfigError, "unknown scenario 'nope': give"),
        ("sim:", {}, ConfigError, "unknown scenario ''"),
        ("sim:swing", {"rate": 30.0}, RecordingError, "leave out --rate"),
        ("sim:swing", {"depth_topic": "/depth"}, RecordingError, "leave the topics out"),
    ],
)
def test_the_door_refuses(address: str, options: dict[str, object], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        open_recording(address, **options)  # type: ignore[arg-type]


def test_the_command_line_refuses() -> None:
    with pytest.raises(ConfigError, match="leave out --start"):
        cli_source.Source(Path("sim:swing"), cli_source.Part(start=3)).open()
    with pytest.raises(ConfigError, match="never twice the same"):
        cli_source.Part().open(Path("sim:swing"))


def command(*arguments: str, interrupt: bool = False, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run ropetrace in a folder; with `interrupt`, Ctrl-C comes when results have begun to be written."""
    program = subprocess.Popen(
        [sys.executable, "-m", "ropetrace", *arguments],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    if interrupt:
        result = folder / arguments[-1]
        deadline = time.monotonic() + 300
        while time.monotonic() < deadline and not (result.exists() and result.stat().st_size > 20_000):
            time.sleep(0.05)
        program.send_signal(signal.SIGINT)
    out, err = program.communicate(timeout=300)
    return subprocess.CompletedProcess(arguments, program.returncode, out, err)


ROPE = ("--diameter", "15mm", "--color", "#c8281e")


def test_track_tells_what_was_dropped_and_the_latency(tmp_path: Path) -> None:
    done = command("track", "sim:swing", *ROPE, "--limit", "12", "--predict", "now", "--out", "r.mcap", folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "frames    12 (12 ok" in done.stdout
    assert re.search(r"latency   from the stamp to the estimate: p50 \d+\.\d ms, p99", done.stdout)
    assert re.search(r"dropped   \d+ frames that came while .* and \d+ during the first two", done.stdout)
    assert (tmp_path / "r.mcap").stat().st_size > 1000


def test_ctrl_c_is_how_a_live_run_ends(tmp_path: Path) -> None:
    done = command("track", "sim:swing", *ROPE, "--out", "r.csv", interrupt=True, folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "written   r.csv" in done.stdout
    rows = (tmp_path / "r.csv").read_text().splitlines()
    assert len({len(row.split(",")) for row in rows}) == 1, "the last row is whole"


def test_a_live_run_may_replace_its_results(tmp_path: Path) -> None:
    (tmp_path / "r.csv").write_text("old")
    done = command("track", "sim:swing", *ROPE, "--limit", "3", "--overwrite", "--out", "r.csv", folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "r.csv").read_text() != "old"


def test_the_simulator_keeps_its_rate_and_its_clock() -> None:
    recording = open_recording("sim:swing")
    assert isinstance(recording, LiveRecording)

    def kept() -> bool:
        """Thirty periods took a second, and the frames were new."""
        ages, stamps, begin = [], [], 0.0
        for event in itertools.islice(recording.frames(), 31):
            begin = begin or time.monotonic()
            ages.append(recording.age())
            stamps.append(event.stamp_ns)
        took = time.monotonic() - begin
        periods = np.diff(stamps) * 30 / SECOND
        assert periods == pytest.approx(np.maximum(np.round(periods), 1), abs=1e-6)
        assert min(ages) >= 0
        return bool(abs(took - 1) < 0.25 and np.round(periods.sum()) == 30 and np.median(ages) < 0.02)

    assert any(kept() for _ in range(5)), "a busy machine may not keep it at once"


def quick_scenario(folder: Path, rate: float, more: str = "") -> Path:
    path = folder / "quick.toml"
    path.write_text(
        f"duration = 0.05\n[wind]\nfrequency = 0.8\n[camera]\nwidth = 64\nheight = 48\nrate = {rate}\n{more}"
    )
    return path


def test_the_simulator_goes_on_past_its_duration(tmp_path: Path) -> None:
    path = quick_scenario(tmp_path, 100.0, "exposure = 0.004\nlatency = 0.02\nmotion_blur = true\n")
    recording = open_recording(f"sim:{path}")
    assert isinstance(recording, LiveRecording)
    ages = []
    events = []
    for event in recording.frames(limit=20):
        ages.append(recording.age())
        events.append(event)
    assert events[-1].stamp_ns >= 0.18 * SECOND
    assert min(ages) >= 0.022, "the exposure and the latency are part of it"


def test_a_simulator_on_a_slow_machine_goes_slower(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = SimulatedCamera(str(quick_scenario(tmp_path, 100.0)))
    expose = camera._expose

    def slow() -> RgbdFrame:
        time.sleep(0.04)
        return expose()

    monkeypatch.setattr(camera, "_expose", slow)
    recording = live(camera)
    stamps: list[int] = []
    recording.on_event = lambda event: stamps.append(event.stamp_ns)
    for _ in recording.frames(limit=6):
        assert recording.age() < 0.5
    assert len(stamps) >= 6
    assert np.diff(stamps).tolist() == pytest.approx([SECOND / 100] * (len(stamps) - 1))
    assert not any("jumped" in line for line in recording.lines())


def test_a_scenario_that_is_too_slow_for_a_camera_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"camera\.rate = 0\.5 is too slow for a live source"):
        open_recording(f"sim:{quick_scenario(tmp_path, 0.5)}")
