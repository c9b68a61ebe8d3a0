"""Settings: what is derived, what is refused and in which words, and the way to TOML and back."""

from __future__ import annotations

import dataclasses
import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ropetrace.config import (
    CenterlineConfig,
    OrderingConfig,
    RopeConfig,
    SegmentationConfig,
    SlicingConfig,
    default_variance_threshold,
    parse_color,
    parse_length,
)
from ropetrace.errors import ConfigError, RopetraceError

UNIT_QUATERNION = (0.0, 0.0, 0.0, 1.0)


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "rope.toml"
    path.write_text(text, encoding="utf-8")
    return path


def refused(tmp_path: Path, text: str) -> str:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        RopeConfig.from_toml(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    return message.removeprefix(f"{path}: ")


# --- lengths and colours ---


@pytest.mark.parametrize(
    ("text", "metres"),
    [
        ("12mm", 0.012),
        ("1.2cm", 0.012),
        (" 1.2 cm ", 0.012),
        ("0.012", 0.012),
        ("0.012m", 0.012),
        ("1.2e-2", 0.012),
        ("1.2e1mm", 0.012),
        ("12000um", 0.012),
        ("0.5in", 0.0127),
        (".5cm", 0.005),
        (0.012, 0.012),
        (1, 1.0),
    ],
)
def test_lengths(text: str | float, metres: float) -> None:
    assert parse_length(text) == metres


@given(st.integers(1, 10**6))
def test_millimetres_round_correctly(count: int) -> None:
    assert parse_length(f"{count}mm") == float(f"{count}e-3")
    assert parse_length(f"{count} um") == float(f"{count}e-6")


@pytest.mark.parametrize(
    "text", ["", "mm", "12 miles", "12mmm", "1,2cm", "1e", "nan", "inf", "1e+mm", "--1mm", "1 2mm"]
)
def test_what_is_no_length(text: str) -> None:
    with pytest.raises(ConfigError, match="is not a length: write it like 12mm"):
        parse_length(text)


@pytest.mark.parametrize(
    "text", ["#c8281e", "c8281e", "#C8281E", " #c8281e ", "200,40,30", " 200 , 40 , 30 ", "200, 40,30"]
)
def test_colors(text: str) -> None:
    assert parse_color(text) == (200, 40, 30)


def test_short_color() -> None:
    assert parse_color("#f80") == (255, 136, 0)


@pytest.mark.parametrize(
    "text", ["", "red", "#12345", "#1234567", "256,0,0", "1,2", "1,2,3,4", "-1,2,3", "#gggggg", "1;2;3"]
)
def test_what_is_no_color(text: str) -> None:
    with pytest.raises(ConfigError, match="is not a colour"):
        parse_color(text)


# --- what follows from the diameter ---


@given(st.floats(0.0005, 0.5))
def test_resolved_fills_everything_and_is_final(diameter: float) -> None:
    config = RopeConfig(diameter=diameter).resolved()
    assert config.slicing.variance_threshold is not None
    assert 0 < config.slicing.variance_threshold < 1
    assert config.ordering.max_gap is not None
    assert config.ordering.max_gap >= 10 * diameter
    assert config.centerline.spacing is not None
    assert 0.002 <= config.centerline.spacing <= 0.01
    assert config.resolved() == config


def test_resolved_keeps_what_is_given() -> None:
    config = RopeConfig(
        diameter=0.01,
        slicing=SlicingConfig(variance_threshold=3e-4),
        ordering=OrderingConfig(max_gap=0.5),
        centerline=CenterlineConfig(spacing=0.003),
    )
    assert config.resolved() == config


def test_the_threshold_is_the_variance_of_a_seen_slice() -> None:
    """Points spread evenly over the image of a cylinder's slice 2.5 diameters long."""
    rng = np.random.default_rng(0)
    radius = 0.006
    across = rng.uniform(-radius, radius, 400_000)
    along = rng.uniform(-2.5 * radius, 2.5 * radius, 400_000)
    points = np.stack([across, along, np.sqrt(radius**2 - across**2)])
    assert default_variance_threshold(2 * radius) == pytest.approx(np.trace(np.cov(points)), rel=5e-3)


def test_pose() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        quaternion = rng.standard_normal(4)
        quaternion /= np.linalg.norm(quaternion)
        position = rng.uniform(-2, 2, 3)
        pose = tuple(float(value) for value in (*position, *quaternion))
        transform = RopeConfig(diameter=0.01, camera_pose=pose).world_from_camera()  # type: ignore[arg-type]
        np.testing.assert_allclose(transform[:3, :3], Rotation.from_quat(quaternion).as_matrix(), atol=1e-14)
        np.testing.assert_array_equal(transform[:, 3], [*position, 1])
    np.testing.assert_array_equal(RopeConfig(diameter=0.01).world_from_camera(), np.eye(4))


def test_a_rounded_quaternion_still_gives_a_rotation() -> None:
    config = RopeConfig(diameter=0.01, camera_pose=(0, 0, 0, 0.5, -0.5, 0.5, -0.5004))
    rotation = config.world_from_camera()[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)


# --- what is refused ---

NAN, INF = math.nan, math.inf
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"diameter": 0.0}, "diameter = 0 m: expected 0.5 mm to 500 mm"),
    ({"diameter": -0.01}, "diameter"),
    ({"diameter": NAN}, "diameter = nan"),
    ({"diameter": INF}, "diameter = inf"),
    ({"diameter": 12.0}, "a number without a unit is in metres"),
    ({"diameter": "12mm"}, "diameter = '?12mm"),
    ({"diameter": None}, "diameter = None"),
    ({"color": "reddish"}, "is not a colour"),
    ({"camera_pose": (0, 0, 0, 0, 0, 0, 0)}, "camera_pose .* unit quaternion"),
    ({"camera_pose": (0, 0, NAN, *UNIT_QUATERNION)}, "camera_pose"),
    ({"camera_pose": (0, 0, 0, 0, 0, 0, 1.1)}, "camera_pose"),
    ({"color": "#fff", "segmentation": SegmentationConfig(color_pixel=(1, 1))}, "give one of them"),
    (
        {"color": "#fff", "segmentation": SegmentationConfig(lab_min=(0, 0, 0), lab_max=(1, 1, 1))},
        "give one of them",
    ),
    (
        {"segmentation": SegmentationConfig(box_min=(0, 0, 0), box_max=(1, 1, 1), box_frame="world")},
        "needs camera_pose",
    ),
]


@pytest.mark.parametrize(("change", "message"), REFUSED)
def test_impossible_rope(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        RopeConfig(**({"diameter": 0.012} | change))
    assert isinstance(caught.value, RopetraceError)


@pytest.mark.parametrize(
    ("section", "change", "message"),
    [
        (SegmentationConfig, {"color_tolerance": 0}, "color_tolerance = 0: expected 0 to 200"),
        (SegmentationConfig, {"color_tolerance": NAN}, "color_tolerance"),
        (SegmentationConfig, {"color_tolerance": 201}, "color_tolerance"),
        (SegmentationConfig, {"color_pixel": (-1, 3)}, "color_pixel"),
        (SegmentationConfig, {"lab_min": (0, 0, 0)}, "lab_min and segmentation.lab_max go together"),
        (SegmentationConfig, {"box_max": (0, 0, 0)}, "box_min and segmentation.box_max go together"),
        (SegmentationConfig, {"box_min": (0, 0, 1), "box_max": (1, 1, 1)}, "must lie below"),
        (SegmentationConfig, {"box_min": (0, 0, NAN), "box_max": (1, 1, 1)}, "must lie below"),
        (SegmentationConfig, {"box_min": (0, 0, 0), "box_max": (1, 1, INF)}, "must lie below"),
        (
            SegmentationConfig,
            {"lab_min": (0, 0, 0), "lab_max": (1, 1, 1), "color_pixel": (1, 1)},
            "both set the colour",
        ),
        (SlicingConfig, {"variance_threshold": 0.0}, "a variance in m\\^2 above 0"),
        (SlicingConfig, {"variance_threshold": -1e-4}, "variance_threshold = -0.0001"),
        (SlicingConfig, {"variance_threshold": NAN}, "variance_threshold = nan"),
        (SlicingConfig, {"variance_threshold": 1.0}, "variance_threshold"),
        (SlicingConfig, {"min_points": 0}, "min_points = 0: expected 1 to 1 000 000"),
        (SlicingConfig, {"surface_offset": (0, 0, NAN)}, "surface_offset"),
        (SlicingConfig, {"surface_offset": (0, 0, -7.5)}, "surface_offset"),
        (SlicingConfig, {"max_nodes": 3}, "max_nodes = 3: expected 4 to 4096"),
        (SlicingConfig, {"max_nodes": 5000}, "max_nodes"),
        (SlicingConfig, {"max_points": 99}, "max_points"),
        (OrderingConfig, {"first": "point"}, "first_point go together"),
        (OrderingConfig, {"first_point": (0, 0, 0)}, "first_point go together"),
        (OrderingConfig, {"max_gap": 0.0}, "max_gap = 0.0: expected a length above 0"),
        (OrderingConfig, {"max_gap": INF}, "max_gap"),
        (CenterlineConfig, {"spacing": 0.0}, "spacing = 0.0: expected"),
        (CenterlineConfig, {"spacing": NAN}, "spacing = nan"),
    ],
)
def test_impossible_setting(section: type[Any], change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        section(**change)


def test_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        RopeConfig(diameter=0.01).diameter = 0.02  # type: ignore[misc]


def test_asks_for_color() -> None:
    assert not RopeConfig(diameter=0.01).asks_for_color
    assert RopeConfig(diameter=0.01, color="#fff").asks_for_color
    assert RopeConfig(diameter=0.01, segmentation=SegmentationConfig(color_pixel=(1, 1))).asks_for_color
    box = SegmentationConfig(lab_min=(0, 0, 0), lab_max=(1, 1, 1))
    assert RopeConfig(diameter=0.01, segmentation=box).asks_for_color


# --- TOML ---


def test_reads_a_file(tmp_path: Path) -> None:
    config = RopeConfig.from_toml(
        written(
            tmp_path,
            """
            diameter = "12 mm"
            color = "#c8281e"
            camera_pose = [0.1, 0, 1, 0, 0, 0, 1]
            [segmentation]
            box_min = [-0.5, -0.5, 0.4]
            box_max = [0.5, 1, 2]
            reject_flying_pixels = true
            [slicing]
            min_points = 30
            [ordering]
            method = "greedy"
            max_gap = "8cm"
            [centerline]
            spacing = "5 mm"
            """,
        )
    )
    assert config == RopeConfig(
        diameter=0.012,
        color="#c8281e",
        camera_pose=(0.1, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        segmentation=SegmentationConfig(box_min=(-0.5, -0.5, 0.4), box_max=(0.5, 1.0, 2.0), reject_flying_pixels=True),
        slicing=SlicingConfig(min_points=30),
        ordering=OrderingConfig(method="greedy", max_gap=0.08),
        centerline=CenterlineConfig(spacing=0.005),
    )


def test_overrides_count_where_they_are_given(tmp_path: Path) -> None:
    path = written(tmp_path, 'diameter = 0.01\ncolor = "#fff"\n')
    config = RopeConfig.from_toml(path, diameter="25mm", color=None)
    assert (config.diameter, config.color) == (0.025, "#fff")


def test_an_override_may_stand_for_what_the_file_lacks(tmp_path: Path) -> None:
    assert RopeConfig.from_toml(written(tmp_path, ""), diameter=0.02).diameter == 0.02


vectors = st.tuples(*[st.floats(-2, 2)] * 3)
positive = st.floats(1e-3, 1.0)


@settings(max_examples=80, deadline=None)
@given(
    st.floats(0.0005, 0.5),
    st.none() | st.sampled_from(["#c8281e", "200,40,30"]),
    st.none() | vectors,
    st.none() | st.floats(1e-9, 0.1),
    st.none() | vectors.map(lambda v: (v[0] / 3, v[1] / 3, v[2] / 3)),
    st.none() | vectors,
    st.none() | positive,
    st.booleans(),
)
def test_there_and_back(
    tmp_path_factory: pytest.TempPathFactory,
    diameter: float,
    color: str | None,
    corner: tuple[float, float, float] | None,
    threshold: float | None,
    offset: tuple[float, float, float] | None,
    first: tuple[float, float, float] | None,
    gap: float | None,
    flag: bool,
) -> None:
    high = None if corner is None else (corner[0] + 0.5, corner[1] + 1e-3, corner[2] + 1)
    config = RopeConfig(
        diameter=diameter,
        color=color,
        segmentation=SegmentationConfig(box_min=corner, box_max=high, reject_flying_pixels=flag),
        slicing=SlicingConfig(variance_threshold=threshold, surface_offset=offset),
        ordering=OrderingConfig(
            first="up" if first is None else "point", first_point=first, follow_previous=flag, max_gap=gap
        ),
    )
    path = tmp_path_factory.mktemp("toml") / "rope.toml"
    for settings_written in (config, config.resolved()):
        path.write_text(settings_written.to_toml(), encoding="utf-8")
        assert RopeConfig.from_toml(path) == settings_written
        assert RopeConfig.from_toml(path).to_toml() == settings_written.to_toml()


def test_numpy_numbers_are_written_as_numbers() -> None:
    corner = tuple(np.array([-0.5, -0.5, 0.5]))
    config = RopeConfig(
        diameter=np.float64(0.012),
        segmentation=SegmentationConfig(box_min=corner, box_max=(1, 1, 2), color_pixel=tuple(np.array([3, 4]))),
        slicing=SlicingConfig(min_points=np.int64(7)),  # type: ignore[arg-type]
    )
    table = tomllib.loads(config.to_toml())
    assert table["diameter"] == 0.012
    assert table["segmentation"]["box_min"] == [-0.5, -0.5, 0.5]
    assert table["segmentation"]["color_pixel"] == [3, 4]
    assert table["slicing"]["min_points"] == 7


def test_single_precision_is_a_number_too() -> None:
    assert RopeConfig(diameter=np.float32(0.0125)).diameter == pytest.approx(0.0125)  # type: ignore[arg-type]


@pytest.mark.parametrize("text", ['a"b', "back\\slash", "two\nlines", "tab\t", "bell\a", "ümlaut", "delete\x7f"])
def test_any_text_is_escaped(text: str) -> None:
    assert tomllib.loads(RopeConfig(diameter=0.01, method=text).to_toml())["method"] == text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "diameter is missing"),
        ("diameter = 0.01\ncolour = '#fff'", "unknown setting colour: did you mean color?"),
        (
            "diameter = 0.01\n[slicing]\nmin_point = 3",
            "unknown setting slicing.min_point: did you mean slicing.min_points?",
        ),
        ("diameter = 0.01\nmax_gap = 3", "unknown setting max_gap: did you mean ordering.max_gap?"),
        ("diameter = 0.01\n[slicing]\nmax_gap = 3", "did you mean ordering.max_gap?"),
        ("diameter = 0.01\nxyzzy = 3", "unknown setting xyzzy; known here: diameter, color, method"),
        ("diameter = 0.01\nslicing = 3", "slicing is a table: write [slicing]"),
        ("diameter = true", "diameter = True: expected a number"),
        ("diameter = 1979-05-27", "diameter = datetime.date(1979, 5, 27): expected a number"),
        ("diameter = '12 miles'", "'12 miles' is not a length"),
        ("diameter = nan", "diameter = nan: expected 0.5 mm to 500 mm"),
        ("diameter = [0.01]", "diameter = [0.01]: expected a number"),
        ("diameter = 0.01\ncolor = 3", "color = 3: expected a text"),
        ("diameter = 0.01\n[slicing]\nmin_points = 3.0", "slicing.min_points = 3.0: expected a whole number"),
        ("diameter = 0.01\n[slicing]\nmin_points = true", "slicing.min_points = True: expected a whole number"),
        ("diameter = 0.01\n[slicing]\nmax_nodes = 2", "slicing.max_nodes = 2: expected 4 to 4096"),
        ("diameter = 0.01\n[ordering]\nmethod = 'best'", "ordering.method = 'best': expected one of 'path', 'greedy'"),
        (
            "diameter = 0.01\n[motion]\nmethod = 'best'",
            "motion.method = 'best': expected one of 'arc_length', 'closest', 'none'",
        ),
        ("diameter = 0.01\n[ordering]\nfollow_previous = 1", "ordering.follow_previous = 1: expected true or false"),
        ("diameter = 0.01\n[segmentation]\nbox_min = [1, 2]", "segmentation.box_min = [1, 2]: expected 3 numbers"),
        ("diameter = 0.01\n[segmentation]\nbox_min = 1", "segmentation.box_min = 1: expected 3 numbers"),
        ("diameter = 0.01\n[segmentation]\nbox_min = ['a', 1, 2]", "segmentation.box_min = 'a': expected a number"),
        (
            "diameter = 0.01\n[segmentation]\ncolor_pixel = [1.5, 2]",
            "segmentation.color_pixel = 1.5: expected a whole number",
        ),
        ("diameter == 1", "not a TOML file"),
        ("diameter = 1" + "0" * 400, "diameter"),
        ("diameter = 1" + "0" * 5000, "not a TOML file"),
        ("diameter = " + "[" * 20000, "not a TOML file"),
    ],
)
def test_a_bad_file_is_refused_in_words(tmp_path: Path, text: str, message: str) -> None:
    assert message in refused(tmp_path, text)


@pytest.mark.parametrize("method", ["arc_length", "closest", "none"])
def test_the_method_of_motion_is_kept(tmp_path: Path, method: str) -> None:
    (tmp_path / "rope.toml").write_text(f'diameter = 0.01\n[motion]\nmethod = "{method}"\n')
    config = RopeConfig.from_toml(tmp_path / "rope.toml")
    assert config.motion.method == method
    (tmp_path / "again.toml").write_text(config.to_toml())
    assert RopeConfig.from_toml(tmp_path / "again.toml") == config
    assert RopeConfig(diameter=0.01).motion.method == "arc_length"


def test_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        RopeConfig.from_toml(tmp_path / "absent.toml")
    with pytest.raises(ConfigError, match="not a file"):
        RopeConfig.from_toml(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b'diameter = 0.01\ncolor = "\xe9"')
    with pytest.raises(ConfigError, match="not a TOML file"):
        RopeConfig.from_toml(tmp_path / "latin.toml")
