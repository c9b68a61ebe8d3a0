"""RealSense cameras, by the software device of pyrealsense2: no camera is needed."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from helpers import RED_TEXT, SHAPES, seen
from ropetrace.config import RopeConfig
from ropetrace.errors import MissingExtraError, RecordingError
from ropetrace.live import CameraGoneError, LiveRecording, realsense
from ropetrace.live.realsense import RealSenseCamera, find_realsense
from ropetrace.trackers import SlicingTracker
from ropetrace.types import Intrinsics, RgbdFrame, Status

CAMERA = Intrinsics(320, 240, 290.0, 290.0, 159.5, 119.5)
PICTURE = seen(SHAPES["hanging"], camera=CAMERA)
COLOR = np.asarray(PICTURE.color)
DEPTH = np.round(PICTURE.depth * 1000).astype(np.uint16)


@pytest.fixture
def rs() -> Any:
    return pytest.importorskip("pyrealsense2", exc_type=ImportError)


class SoftwareCamera:
    """What a pipeline does, of frames that are made here at 50 Hz; `sideways` is from the depth camera to the other."""

    def __init__(self, rs: Any, sideways: float = 0.0, domain: str = "system_time") -> None:
        self._rs, self._domain = rs, domain
        device = rs.software_device()
        sensors = [device.add_sensor(name) for name in ("Stereo Module", "RGB Camera")]
        sensors[0].add_read_only_option(rs.option.depth_units, 0.001)
        profiles = [
            self._profile(sensors[0], rs.stream.depth, rs.format.z16, 2, 0),
            self._profile(sensors[1], rs.stream.color, rs.format.rgb8, 3, 1),
        ]
        beside = rs.extrinsics()
        beside.rotation, beside.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [sideways, 0, 0]
        profiles[0].register_extrinsics_to(profiles[1], beside)
        self._syncer = rs.syncer()
        for sensor, profile in zip(sensors, profiles, strict=True):
            sensor.open(profile)
            sensor.start(self._syncer)
        self.try_wait_for_frames = self._syncer.try_wait_for_frames
        self.gone = threading.Event()
        self._device, self._sensors, self._profiles = device, sensors, profiles
        self._thread = threading.Thread(target=self._feed)
        self._thread.start()

    def _profile(self, sensor: Any, kind: Any, encoding: Any, pixel_bytes: int, uid: int) -> Any:
        stream, camera = self._rs.video_stream(), self._rs.intrinsics()
        camera.width, camera.height, camera.fx, camera.fy = CAMERA.width, CAMERA.height, CAMERA.fx, CAMERA.fy
        camera.ppx, camera.ppy, camera.model = CAMERA.cx, CAMERA.cy, self._rs.distortion.none
        stream.type, stream.fmt, stream.bpp, stream.uid = kind, encoding, pixel_bytes, uid
        stream.index, stream.width, stream.height, stream.fps = 0, CAMERA.width, CAMERA.height, 30
        stream.intrinsics = camera
        return sensor.add_video_stream(stream).as_video_stream_profile()

    def _feed(self) -> None:
        number = 0
        while not self.gone.wait(0.02):
            number += 1
            stamp = time.time() * 1e3
            for sensor, profile, pixels in zip(self._sensors, self._profiles, (DEPTH, COLOR), strict=True):
                frame = self._rs.software_video_frame()
                frame.pixels, frame.profile, frame.frame_number, frame.timestamp = pixels, profile, number, stamp
                frame.bpp = pixels.strides[1]
                frame.stride = pixels.strides[0]
                frame.domain = getattr(self._rs.timestamp_domain, self._domain)
                frame.depth_units = 0.001
                sensor.on_video_frame(frame)

    def stop(self) -> None:
        self.gone.set()
        self._thread.join()
        for sensor in self._sensors:
            sensor.stop()
            sensor.close()


def read(rs: Any, count: int, **options: Any) -> Iterator[tuple[RgbdFrame, LiveRecording]]:
    recording = LiveRecording("realsense:", RealSenseCamera(rs, lambda: SoftwareCamera(rs, **options)))
    for event in recording.frames(limit=count):
        assert isinstance(event, RgbdFrame)
        yield event, recording


def test_frames_are_what_the_camera_sees(rs: Any) -> None:
    tracker = SlicingTracker(RopeConfig(0.012, RED_TEXT))
    kept = []
    for frame, recording in read(rs, 4):
        assert frame.intrinsics == CAMERA == recording.intrinsics
        assert frame.depth_unit_m == 0.001
        # With two cameras in one place the SDK still moves some pixels by a row, over others.
        for row, column in np.argwhere(frame.depth != DEPTH):
            assert frame.depth[row, column] in (0, *DEPTH[row - 1 : row + 2, column])
        assert np.count_nonzero(frame.depth) > 0.98 * np.count_nonzero(DEPTH)
        np.testing.assert_array_equal(frame.color, COLOR)
        assert tracker.update(frame).status is Status.OK
        assert abs(time.time_ns() - frame.stamp_ns) < 10**9
        assert 0 <= recording.age() < 0.5
        assert not any("clock" in line for line in recording.lines())
        kept.append(frame)
    assert len({frame.stamp_ns for frame in kept}) == 4
    assert not np.shares_memory(kept[0].depth, kept[1].depth)


def test_depth_is_aligned_to_colour(rs: Any) -> None:
    """Seen from a camera 5 cm beside it, what is z away moves by f 0.05 / z."""
    frame, _ = next(read(rs, 1, sideways=0.05))
    before, after = (np.nonzero(depth)[1].mean() for depth in (DEPTH, frame.depth))
    assert after - before == pytest.approx(CAMERA.fx * 0.05 / np.median(PICTURE.depth[DEPTH > 0]), abs=0.7)


def test_a_clock_of_its_own_is_told(rs: Any) -> None:
    for _, recording in read(rs, 2, domain="hardware_clock"):
        assert 0 <= recording.age() < 0.5
        assert "latency counts from the frames' arrival" in recording.lines()[1]


def test_a_camera_that_fails_is_gone() -> None:
    class Pipeline:
        def try_wait_for_frames(self, timeout_ms: int) -> None:
            raise RuntimeError("Device\ndisconnected")

        def stop(self) -> None:
            raise RuntimeError("stop() cannot be called before start()")

    module = SimpleNamespace(align=lambda stream: None, stream=SimpleNamespace(color=0))
    camera = RealSenseCamera(module, Pipeline)
    camera.connect()
    with pytest.raises(CameraGoneError, match="Device disconnected"):
        camera.fetch(0.1)
    camera.disconnect()

    def busy() -> None:
        raise RuntimeError("failed to open usb interface: 0, error: RS2_USB_STATUS_BUSY")

    with pytest.raises(CameraGoneError, match=r"the RealSense camera does not start: .*STATUS_BUSY"):
        RealSenseCamera(module, busy).connect()


def fake_module(*serials: str) -> Any:
    devices = [SimpleNamespace(get_info=lambda _, serial=serial: serial) for serial in serials]
    return SimpleNamespace(
        align=lambda stream: None,
        stream=SimpleNamespace(color=0),
        camera_info=SimpleNamespace(serial_number=0),
        context=lambda: SimpleNamespace(query_devices=lambda: devices),
    )


@pytest.mark.parametrize(
    ("connected", "wanted", "words"),
    [
        ((), "", "no RealSense camera is connected: plug it in"),
        ((), "123", "no RealSense camera of that serial number: none is connected"),
        (("123",), "456", "no RealSense camera of that serial number: connected are 123"),
        (("123", "456"), "", "connected are 123, 456: choose one, such as realsense:123"),
    ],
)
def test_the_door_refuses(monkeypatch: pytest.MonkeyPatch, connected: tuple[str, ...], wanted: str, words: str) -> None:
    monkeypatch.setattr(realsense, "import_extra", lambda module, extra: fake_module(*connected))
    with pytest.raises(RecordingError, match=words):
        find_realsense(wanted)


@pytest.mark.parametrize("wanted", ["", "123"])
def test_the_door_opens(monkeypatch: pytest.MonkeyPatch, wanted: str) -> None:
    monkeypatch.setattr(realsense, "import_extra", lambda module, extra: fake_module("123"))
    assert isinstance(find_realsense(wanted), RealSenseCamera)


def test_no_camera_is_connected_to_this_machine(rs: Any) -> None:
    if not len(rs.context().query_devices()):
        with pytest.raises(RecordingError, match="no RealSense camera is connected"):
            find_realsense("")


def test_what_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(words: str) -> ModuleType:
        raise MissingExtraError(words)

    for said, expected in (
        ("(libusb-1.0.so.0: cannot open shared object file)", "apt install libusb-1.0-0"),
        ("pip install 'ropetrace[realsense]'", r"ropetrace\[realsense\]"),
    ):
        monkeypatch.setattr(realsense, "import_extra", lambda module, extra, said=said: missing(said))
        with pytest.raises(MissingExtraError, match=expected):
            find_realsense("")
