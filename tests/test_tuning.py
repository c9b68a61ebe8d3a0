"""The state behind the page of `ropetrace tune`, without a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers import RED_TEXT
from ropetrace import demo
from ropetrace.config import RopeConfig, SegmentationConfig
from ropetrace.errors import ConfigError, FrameError, RecordingError
from ropetrace.picture import pixels_of
from ropetrace.recordings import Recording, open_recording
from ropetrace.tuning import Tuning
from ropetrace.types import BadFrame


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("tuning") / "recording"
    demo.make_recording(folder)
    return open_recording(folder)


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
    corners = tuning.box_corners()
    assert corners is not None
    np.testing.assert_allclose(corners[[0, 1, -1]], [[0, 0, -10], [0, 0, -7], [1, 2, -7]])
    assert Tuning(recording).box_corners() is None


def test_a_colour_of_a_pixel_is_refused(recording: Recording) -> None:
    with pytest.raises(ConfigError, match="click on the rope"):
        Tuning(recording, RopeConfig(0.012, segmentation=SegmentationConfig(color_pixel=(1, 2))))


def test_a_bad_frame_is_lost_and_cannot_be_clicked(recording: Recording) -> None:
    tuning = Tuning(recording, RopeConfig(0.012, RED_TEXT))
    tuning.event = BadFrame(0, "torn")
    assert tuning.look().estimates[0].status == "lost"
    assert not len(tuning.look().slices)
    for act in (tuning.measure, lambda: tuning.click(1, 1)):
        with pytest.raises(FrameError, match="torn"):
            act()


def test_what_is_saved_reads_back(recording: Recording, tmp_path: Path) -> None:
    tuning = Tuning(recording, RopeConfig(0.012, RED_TEXT))
    tuning.change({"segmentation.box_min": [-1, -0.2, 0.5], "segmentation.box_max": [1, 1, 2]})
    path = tmp_path / "rope.toml"
    path.write_text(tuning.config.to_toml())
    assert RopeConfig.from_toml(path) == tuning.config
