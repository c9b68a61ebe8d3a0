"""The state behind the page of `ropetrace tune`, without a browser."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers import DATA, RED_TEXT, needs_data
from ropetrace import demo
from ropetrace.config import RopeConfig, SegmentationConfig
from ropetrace.errors import ConfigError, FrameError, RecordingError
from ropetrace.picture import backdrop, pixels_of
from ropetrace.recordings import Recording, RecordingInfo, open_recording
from ropetrace.recordings.base import NO_COLOR
from ropetrace.trackers import make_tracker
from ropetrace.tune_advice import advice, remedy_of
from ropetrace.tune_look import box_corners
from ropetrace.tune_message import message_of
from ropetrace.tuning import Tuning
from ropetrace.types import BadFrame, Cloud, CloudFrame, Event, Intrinsics, RgbdFrame, Status
from test_live import ScriptedCamera, live, tiny


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("tuning") / "recording"
    demo.make_recording(folder)
    return open_recording(folder)


class Frames:
    """A recording of frames that are at hand."""

    kind = "frames"
    path = Path("frames")
    intrinsics = None

    def __init__(self, *events: Event) -> None:
        self._events = events
        self.frame_count = len(events)
        self.problems: list[str] = []

    def frames(self, start: int = 0, limit: int | None = None) -> Iterator[Event]:
        return iter(self._events[start : None if limit is None else start + limit])

    def info(self) -> RecordingInfo:
        raise NotImplementedError


def first_frame(recording: Recording) -> RgbdFrame:
    frame = next(iter(recording.frames()))
    assert isinstance(frame, RgbdFrame)
    return frame


def on_the_rope(index: int = 0) -> tuple[int, int]:
    """The pixel of the middle of the demo's rope."""
    middle = demo.rope_curve(index / demo.RATE)[200:201]
    column, row = np.round(pixels_of(middle, demo.CAMERA))[0].astype(int)
    return int(column), int(row)


def test_a_click_sets_the_colour_and_measures_the_diameter(recording: Recording) -> None:
    tuning = Tuning(recording)
    assert tuning.look().estimates[0].status != "ok"
    said = tuning.click(*on_the_rope())
    assert tuning.config.diameter == pytest.approx(demo.DIAMETER, rel=0.05)
    assert any("diameter" in text for text in said)
    look = tuning.look()
    assert look.estimates[0].status == "ok"
    assert len(look.cloud.points) < 5000


def test_a_click_keeps_a_diameter_that_is_known(recording: Recording) -> None:
    tuning = Tuning(recording)
    tuning.change({"diameter": 0.02})
    tuning.click(*on_the_rope())
    assert tuning.config.diameter == 0.02
    tuning.measure()
    assert tuning.config.diameter == pytest.approx(demo.DIAMETER, rel=0.05)


def test_a_click_takes_the_place_of_a_box_in_colour(recording: Recording) -> None:
    box = SegmentationConfig(lab_min=(0, -10, -10), lab_max=(100, 10, 10))
    tuning = Tuning(recording, RopeConfig(0.012, segmentation=box))
    tuning.click(*on_the_rope())
    assert tuning.config.segmentation.lab_min is None
    assert tuning.look().estimates[0].status == "ok"


def test_a_click_outside_changes_nothing(recording: Recording) -> None:
    tuning = Tuning(recording, RopeConfig(0.012, RED_TEXT))
    with pytest.raises(ConfigError, match="outside"):
        tuning.click(5000, 0)
    assert tuning.config == RopeConfig(0.012, RED_TEXT)


def test_frames_end_where_the_recording_does(recording: Recording) -> None:
    tuning = Tuning(recording, RopeConfig(0.012, RED_TEXT))
    assert not tuning.go_to(-1)
    assert not tuning.go_to(demo.FRAMES)
    assert tuning.go_to(demo.FRAMES - 1)
    assert tuning.look().index == demo.FRAMES - 1


def test_a_part_of_a_recording(recording: Recording) -> None:
    tuning = Tuning(recording, start=10, limit=5)
    assert tuning.index == 10
    assert not tuning.go_to(9)
    assert tuning.go_to(14)
    assert not tuning.go_to(15)


def test_no_frame_at_all(recording: Recording) -> None:
    with pytest.raises(RecordingError, match="no frame 45"):
        Tuning(recording, start=demo.FRAMES)


def test_a_look_depends_on_nothing_before(recording: Recording) -> None:
    tuning = Tuning(recording, RopeConfig(0.012, RED_TEXT))
    tuning.go_to(20)
    direct = tuning.look().estimates[0].nodes
    for index in (0, 44, 20):
        tuning.go_to(index)
        again = tuning.look().estimates[0].nodes
    np.testing.assert_array_equal(direct, again)


def test_settings_that_change_what_passes(recording: Recording) -> None:
    tuning = Tuning(recording, RopeConfig(0.012, RED_TEXT))
    whole = tuning.look().estimates[0].point_count
    tuning.change({"segmentation.box_min": [-1, -0.2, 0.5], "segmentation.box_max": [1, 1, 2]})
    assert 0 < tuning.look().estimates[0].point_count < 0.9 * whole
    tuning.change({"segmentation.box_min": None, "segmentation.box_max": None})
    assert tuning.config.segmentation.box_min is None
    assert tuning.look().estimates[0].point_count == whole
    tuning.change({"color": "#e8483e", "segmentation.color_tolerance": 1.0})
    assert tuning.look().estimates[0].status == "lost"
    tuning.change({"segmentation.color_tolerance": 25.0})
    assert tuning.look().estimates[0].status == "ok"


def test_the_variance_sets_the_slices(recording: Recording) -> None:
    tuning = Tuning(recording, RopeConfig(0.012, RED_TEXT))
    count = len(tuning.look().slices)
    threshold = tuning.config.resolved().slicing.variance_threshold
    assert threshold is not None
    tuning.change({"slicing.variance_threshold": 8 * threshold})
    assert len(tuning.look().slices) < 0.6 * count
    tuning.change({"slicing.variance_threshold": None})
    assert len(tuning.look().slices) == count


@pytest.mark.parametrize(
    "settings",
    [
        {"diameter": -1.0},
        {"diameter": None},
        {"diameter": float("nan")},
        {"diameter": []},
        {"color": 5},
        {"segmentation.box_min": [0, 0, 0]},
        {"segmentation.color_tolerance": "much"},
        {"slicing.min_points": 0.5},
        {"method": "cpd"},
        {"segmentation": {}},
    ],
)
def test_what_is_impossible_changes_nothing(recording: Recording, settings: dict[str, Any]) -> None:
    tuning = Tuning(recording, RopeConfig(0.012, RED_TEXT))
    with pytest.raises(ConfigError):
        tuning.change({"segmentation.color_tolerance": 30.0, **settings})
    assert tuning.config == RopeConfig(0.012, RED_TEXT)


def test_other_settings_are_kept(recording: Recording) -> None:
    config = RopeConfig(0.012, RED_TEXT, method="slicing", camera_pose=(1, 2, 3, 0, 0, 0, 1))
    tuning = Tuning(recording, config)
    tuning.change({"diameter": 0.013})
    assert (tuning.config.method, tuning.config.camera_pose) == ("slicing", config.camera_pose)
    assert tuning.look().estimates[0].status == "ok"


def test_the_box_in_the_frame_of_the_camera(recording: Recording) -> None:
    box = SegmentationConfig(box_min=(0, 0, 0), box_max=(1, 2, 3), box_frame="world")
    tuning = Tuning(recording, RopeConfig(0.012, segmentation=box, camera_pose=(0, 0, 10, 0, 0, 0, 1)))
    corners = box_corners(tuning.config)
    assert corners is not None
    np.testing.assert_allclose(corners[[0, 1, -1]], [[0, 0, -10], [0, 0, -7], [1, 2, -7]])
    assert box_corners(RopeConfig(0.012)) is None


def test_a_colour_of_a_pixel_is_refused(recording: Recording) -> None:
    with pytest.raises(ConfigError, match="click on the rope"):
        Tuning(recording, RopeConfig(0.012, segmentation=SegmentationConfig(color_pixel=(1, 2))))


def test_a_bad_frame_is_lost_and_cannot_be_clicked() -> None:
    tuning = Tuning(Frames(BadFrame(0, "torn")), RopeConfig(0.012, RED_TEXT))
    assert tuning.look().estimates[0].status == "lost"
    assert not len(tuning.look().slices)
    with pytest.raises(FrameError, match="torn"):
        tuning.measure()
    with pytest.raises(FrameError, match="torn"):
        tuning.click(1, 1)


def test_what_is_saved_reads_back(recording: Recording, tmp_path: Path) -> None:
    tuning = Tuning(recording, RopeConfig(0.012, RED_TEXT))
    tuning.change({"segmentation.box_min": [-1, -0.2, 0.5], "segmentation.box_max": [1, 1, 2]})
    path = tmp_path / "rope.toml"
    path.write_text(tuning.config.to_toml())
    assert RopeConfig.from_toml(path) == tuning.config


# --- sources without colour, and clouds ---


def test_without_colour_a_click_measures_the_diameter(recording: Recording) -> None:
    frame = first_frame(recording)
    middle = round(1.4 / frame.depth_unit_m)
    depth = np.where(frame.depth < middle, frame.depth, 0).astype(frame.depth.dtype)
    tuning = Tuning(Frames(RgbdFrame(0, depth, frame.depth_unit_m, frame.intrinsics)))
    said = tuning.click(1, 1)
    assert "no colour" in said[0]
    assert tuning.config.color is None
    assert tuning.knows_diameter


def colored_cloud(recording: Recording) -> CloudFrame:
    """The demo's first frame as a cloud: the rope is red, all else is not."""
    frame = first_frame(recording)
    camera = frame.intrinsics
    rows, columns = np.nonzero(frame.depth)
    z = frame.depth[rows, columns] * frame.depth_unit_m
    points = np.stack([(columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z], axis=1)
    assert frame.color is not None
    return CloudFrame(0, points, frame.color[rows, columns])


def test_a_click_on_a_cloud_takes_its_colour_and_measures_its_slices(recording: Recording) -> None:
    cloud = colored_cloud(recording)
    tuning = Tuning(Frames(cloud))
    middle = demo.rope_curve(0)[200:201]
    column, row = np.round(pixels_of(middle, backdrop(cloud)[1]))[0].astype(int)
    tuning.click(int(column), int(row))
    tuning.change({"segmentation.color_tolerance": 30})
    tuning.measure()
    assert tuning.config.diameter == pytest.approx(demo.DIAMETER, rel=0.35)
    assert tuning.look().estimates[0].status != Status.LOST
    with pytest.raises(ConfigError, match="no point near"):
        tuning.click(-1000, 0)


@needs_data
def test_real_ropes_without_colour_are_followed_after_one_click() -> None:
    for name, rate in (("bcpd_rope_d435", 30), ("kinect_rope/data4.npz", None)):
        recording = open_recording(DATA / name, rate=rate)
        tuning = Tuning(recording)
        tuning.measure()
        tracker = make_tracker(tuning.config)
        statuses = [tracker.update(frame).status for frame in recording.frames()]
        assert Status.OK in statuses, name
        assert Status.LOST not in statuses, name


# --- advice ---


def advised(tuning: Tuning) -> tuple[str, str]:
    said = advice(tuning.look(), tuning.is_live)
    return said.kind, said.text


def test_what_to_do_is_said_from_the_first_click_to_the_last(recording: Recording) -> None:
    tuning = Tuning(recording)
    kind, text = advised(tuning)
    assert kind == "do"
    assert "Click on the rope" in text
    tuning.click(*on_the_rope())
    kind, text = advised(tuning)
    assert kind == "good"
    assert "save" in text


def test_a_gate_that_nothing_passes_is_told_apart_from_a_box_and_from_no_depth(recording: Recording) -> None:
    tuning = Tuning(recording, RopeConfig(0.012, RED_TEXT))
    tuning.change({"color": "#00ff00"})
    assert "raise the colour tolerance" in advised(tuning)[1]
    tuning.change({"color": RED_TEXT, "segmentation.box_min": [5, 5, 5], "segmentation.box_max": [6, 6, 6]})
    kind, text = advised(tuning)
    assert kind == "wrong"
    assert "lie outside the position box" in text
    frame = first_frame(recording)
    blind = RgbdFrame(0, np.zeros_like(frame.depth), frame.depth_unit_m, frame.intrinsics, frame.color)
    assert "has depth" in advised(Tuning(Frames(blind), RopeConfig(0.012, RED_TEXT)))[1]


def without_color(recording: Recording) -> RgbdFrame:
    frame = first_frame(recording)
    return RgbdFrame(10**9, frame.depth, frame.depth_unit_m, frame.intrinsics)


@pytest.mark.parametrize("is_live", [False, True])
def test_a_colour_that_no_frame_has_is_refused(recording: Recording, is_live: bool) -> None:
    frame = without_color(recording)
    source = live(ScriptedCamera(lambda index: frame)) if is_live else Frames(BadFrame(0, "torn"), frame)
    with pytest.raises(ConfigError, match=f"^{NO_COLOR}$"):
        Tuning(source, RopeConfig(0.012, RED_TEXT))
    tuning = Tuning(source, RopeConfig(0.012))
    tuning.close()


def test_a_frame_that_lost_its_colour_is_told(recording: Recording) -> None:
    tuning = Tuning(Frames(first_frame(recording), without_color(recording)), RopeConfig(0.012, RED_TEXT))
    tuning.change({"segmentation.box_min": [-5, -5, 0.1], "segmentation.box_max": [5, 5, 6]})
    assert advised(tuning)[0] == "good"
    tuning.go_to(1)
    kind, text = advised(tuning)
    assert kind == "wrong"
    assert text.startswith("This frame has no colour, and the settings ask for one.")
    assert message_of(tuning.look(), False)["advice"]["text"] == text
    with pytest.raises(FrameError, match="colour"):
        tuning.click(*on_the_rope())
    # What is doubtful for another reason is not measured with a colour that is not there.
    look = tuning.look()
    doubtful = dataclasses.replace(look.estimates[0], status=Status.DEGRADED, reasons=("odd",))
    some = Cloud(np.ones((9, 3)), np.full(9, -1, np.int32))
    assert advice(dataclasses.replace(look, cloud=some, estimates=(doubtful,)), False).text.endswith("doubtful: odd.")


def test_a_gate_that_takes_the_background_is_told_with_its_remedy(recording: Recording) -> None:
    tuning = Tuning(recording, RopeConfig(0.012, RED_TEXT))
    tuning.change({"segmentation.color_tolerance": 150})
    kind, text = advised(tuning)
    assert kind == "wrong"
    assert "takes more than the rope" in text
    assert "Lower the colour tolerance" in text
    frame = first_frame(recording)
    no_color = RgbdFrame(0, frame.depth, frame.depth_unit_m, frame.intrinsics)
    assert "no colour to tell it by: put a position box" in advised(Tuning(Frames(no_color), RopeConfig(0.012)))[1]


def test_a_wrong_diameter_is_told_with_its_remedy(recording: Recording) -> None:
    for wrong in (0.004, 0.05):
        tuning = Tuning(recording, RopeConfig(wrong, RED_TEXT))
        kind, text = advised(tuning)
        assert (kind, "'measure'" in text) == ("wrong", True), text
        tuning.measure()
        assert advised(tuning)[0] == "good"


def test_each_reason_of_a_look_gone_wrong_has_a_remedy(recording: Recording) -> None:
    for change in ({"segmentation.color_tolerance": 150}, {"diameter": 0.004}, {"diameter": 0.05}):
        tuning = Tuning(recording, RopeConfig(0.012, RED_TEXT))
        tuning.change(change)
        reasons = tuning.look().estimates[0].reasons
        assert reasons
        assert all(remedy_of(reason) for reason in reasons), reasons


def test_a_box_round_what_passes_keeps_it(recording: Recording) -> None:
    tuning = Tuning(recording, RopeConfig(0.012, RED_TEXT))
    before = tuning.look()
    tuning.put_box_round(before.cloud.points)
    assert tuning.look().estimates[0].point_count == before.estimates[0].point_count
    assert tuning.config.segmentation.box_max is not None
    with pytest.raises(ConfigError, match="nothing passes"):
        tuning.put_box_round(np.empty((0, 3)))


# --- live ---


def test_a_live_source_runs_until_it_is_held() -> None:
    tuning = Tuning(live(ScriptedCamera(lambda index: tiny(index * 10**7))), RopeConfig(0.012))
    try:
        assert tuning.wants_frame
        stamps = []
        for _ in range(3):
            assert tuning.take()
            stamps.append(tuning.event.stamp_ns)
        assert stamps == sorted(set(stamps))
        assert tuning.look().age is not None
        tuning.frozen = True
        assert not tuning.wants_frame
        assert tuning.look().age is None
        assert tuning.go_to(7)
        assert tuning.wants_frame
        assert tuning.take()
        assert not tuning.wants_frame
        assert tuning.event.stamp_ns > stamps[-1]
    finally:
        tuning.close()


def test_frames_of_changing_size() -> None:
    small = Intrinsics(6, 4, 7.0, 7.0, 2.5, 1.5)
    camera = ScriptedCamera(lambda index: tiny(index * 10**7) if index % 2 else tiny(index * 10**7, small))
    tuning = Tuning(live(camera), RopeConfig(0.012))
    try:
        sizes = set()
        for _ in range(40):
            tuning.take()
            look = tuning.look()
            assert isinstance(look.event, RgbdFrame)
            sizes.add(look.event.depth.shape)
            if len(sizes) == 2:
                break
        assert len(sizes) == 2
    finally:
        tuning.close()


def test_a_camera_that_fails_makes_a_bad_frame_and_is_begun_anew() -> None:
    camera = ScriptedCamera(lambda index: ValueError("driver") if index == 1 else tiny(index * 10**7))
    tuning = Tuning(live(camera), RopeConfig(0.012))
    try:
        while tuning.take():
            pass
        assert isinstance(tuning.event, BadFrame)
        assert "driver" in tuning.event.reason
        assert advised(tuning)[0] == "wrong"
        while not tuning.take():
            pass
        assert isinstance(tuning.event, RgbdFrame)
    finally:
        tuning.close()


def test_a_live_source_has_no_limit() -> None:
    with pytest.raises(ConfigError, match="--limit"):
        Tuning(live(ScriptedCamera(tiny)), limit=3)
