"""Segmentation: equal to a few lines of NumPy, and colours judged by CIELAB as it is published."""

from __future__ import annotations

import colorsys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from helpers import random_rotation
from ropetrace.config import SegmentationConfig
from ropetrace.segmentation import ColorGate, PositionBox, Segmenter, lab_from_linear, lab_from_rgb
from ropetrace.types import CloudFrame, FloatArray, Intrinsics, RgbdFrame

DEFAULT_TOLERANCE = SegmentationConfig().color_tolerance


# --- twins ---


def linear_from_srgb(srgb: FloatArray) -> FloatArray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: FloatArray) -> FloatArray:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def independent_lab(rgb: NDArray[Any]) -> FloatArray:
    """From the chromaticities of the primaries and of D65, and the formula with delta = 6/29."""
    primaries = np.array([[0.64, 0.33, 0.03], [0.30, 0.60, 0.10], [0.15, 0.06, 0.79]]).T
    white = np.array([0.3127, 0.3290, 0.3583]) / 0.3290
    xyz_of_rgb = primaries * np.linalg.solve(primaries, white)
    t = linear_from_srgb(rgb / 255) @ xyz_of_rgb.T / white
    delta = 6 / 29
    f = np.where(t > delta**3, np.cbrt(t), t / (3 * delta**2) + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1)


def plain_accepts(gate: ColorGate, colors: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Distance to the gate's polyline, or place in its box."""
    lab = lab_from_rgb(colors)
    if gate.tolerance < 0:
        return np.asarray(((lab >= gate.line[0]) & (lab <= gate.line[1])).all(axis=-1))
    best = np.full(lab.shape[:-1], np.inf)
    for a, b in zip(gate.line[:-1], gate.line[1:], strict=True):
        step = b - a
        part = np.clip((lab - a) @ step / max(step @ step, 1e-300), 0, 1)
        best = np.minimum(best, np.linalg.norm(lab - a - part[..., None] * step, axis=-1))
    return np.asarray(best <= gate.tolerance)


def plain_segment(
    frame: RgbdFrame,
    gate: ColorGate | None = None,
    box: PositionBox | None = None,
    gap: float | None = None,
    mask: NDArray[np.bool_] | None = None,
) -> FloatArray:
    camera = frame.intrinsics
    z = np.where(np.isfinite(frame.depth), frame.depth, np.nan).astype(float) * frame.depth_unit_m
    rows, columns = np.mgrid[: camera.height, : camera.width]
    points = np.stack([(columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z])
    keep = np.isfinite(z) & (z > 0)
    if mask is not None:
        keep &= mask
    elif gate is not None and frame.color is not None:
        keep &= plain_accepts(gate, frame.color)
    if box is not None:
        transform = box.box_from_camera
        placed = np.einsum("ij,jhw->ihw", transform[:3, :3], np.where(keep, points, 0)) + transform[:3, 3, None, None]
        keep &= ((placed >= box.low[:, None, None]) & (placed <= box.high[:, None, None])).all(axis=0)
    if gap is not None:
        near = np.zeros(z.shape, int)
        around = np.pad(z, 1, constant_values=np.nan)
        for row in range(3):
            for column in range(3):
                if (row, column) != (1, 1):
                    near += np.abs(around[row : row + z.shape[0], column : column + z.shape[1]] - z) <= gap
        keep &= near >= 3
    return points[:, keep]


def random_frame(rng: np.random.Generator, kind: type, width: int, height: int) -> RgbdFrame:
    """Smooth depth with holes and every kind of bad value, and colours from a short list."""
    camera = Intrinsics(
        width,
        height,
        float(rng.uniform(0.5, 2) * width),
        float(rng.uniform(0.5, 2) * width),
        float(rng.uniform(0.2, 0.8) * width),
        float(rng.uniform(0.2, 0.8) * height),
    )
    metres = rng.uniform(0.3, 3, (height, width))
    if rng.random() < 0.5:
        metres = 1 + 0.2 * np.sin(np.arange(width) / 9) + 0.02 * rng.standard_normal((height, width))
    metres[rng.random((height, width)) < rng.choice([0.1, 0.95])] = 0
    palette = rng.integers(0, 256, (20, 3)).astype(np.uint8)
    color = palette[rng.integers(0, 20, (height, width))]
    if kind is np.uint16:
        return RgbdFrame(0, (metres * 1000).astype(np.uint16), 0.001, camera, color)
    unit = float(rng.choice([1.0, 0.001, 0.25]))
    depth = (metres / unit).astype(np.float32)
    bad = rng.random((height, width))
    for share, value in ((0.01, np.nan), (0.02, np.inf), (0.03, -np.inf), (0.04, -1.0), (0.05, -0.0)):
        depth[(bad < share) & (bad >= share - 0.01)] = value
    return RgbdFrame(0, depth, unit, camera, color)


def random_box(rng: np.random.Generator) -> PositionBox:
    low = rng.uniform([-1, -1, -0.5], [0.2, 0.2, 1.5])
    transform = np.eye(4)
    if rng.random() < 0.5:
        transform[:3, :3], transform[:3, 3] = random_rotation(rng), rng.uniform(-0.5, 0.5, 3)
    return PositionBox(low, low + rng.uniform(0.1, 2, 3), transform)


# --- the scan ---


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([np.uint16, np.float32]), st.integers(1, 200), st.integers(1, 12))
def test_equals_its_twin(seed: int, kind: type, width: int, height: int) -> None:
    rng = np.random.default_rng(seed)
    frame = random_frame(rng, kind, width, height)
    assert frame.color is not None
    gate = None
    if rng.random() < 0.5:
        r, g, b = (int(v) for v in frame.color[0, 0])
        gate = ColorGate.around_color((r, g, b), float(rng.uniform(5, 80)), 1.3)
    box = random_box(rng) if rng.random() < 0.6 else None
    gap = float(rng.choice([0.0105, 0.1005])) if rng.random() < 0.4 else None
    mask = rng.random((height, width)) < 0.7 if rng.random() < 0.3 else None
    found = Segmenter(gate, box, gap).segment(frame, mask)
    np.testing.assert_allclose(found, plain_segment(frame, gate, box, gap, mask), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("kind", [np.uint16, np.float32])
def test_a_sharp_box_takes_exactly_its_points(kind: type) -> None:
    """Boxes of a pixel or two, at every place of the image and beyond it: no window may cut a point off."""
    rng = np.random.default_rng(3)
    frame = random_frame(rng, kind, 150, 40)
    for _ in range(300):
        centre = rng.uniform([-1.2, -0.4, 0.1], [1.2, 0.4, 3])
        size = rng.uniform(0.001, 0.4, 3)
        box = PositionBox(centre - size, centre + size)
        found = Segmenter(None, box).segment(frame)
        np.testing.assert_allclose(found, plain_segment(frame, None, box), rtol=1e-13)


def test_the_faces_of_the_box_belong_to_it() -> None:
    camera = Intrinsics(3, 1, 1.0, 1.0, 1.0, 0.0)
    frame = RgbdFrame(0, np.full((1, 3), 1000, np.uint16), 0.001, camera)
    exact = PositionBox(np.array([-1.0, 0.0, 1.0]), np.array([1.0, 0.5, 1.0 + 1e-9]))
    assert Segmenter(None, exact).segment(frame).shape == (3, 3)


def test_images_that_are_not_contiguous() -> None:
    rng = np.random.default_rng(8)
    frame = random_frame(rng, np.uint16, 64, 48)
    assert frame.color is not None
    gate = ColorGate.around_color((120, 130, 140), 60)
    expected = plain_segment(frame, gate)
    assert 0 < expected.shape[1] < 64 * 48
    wide = np.zeros((48, 128), np.uint16)
    wide[:, ::2] = frame.depth
    bgr = np.ascontiguousarray(frame.color[..., ::-1])
    views = RgbdFrame(0, wide[:, ::2], 0.001, frame.intrinsics, bgr[..., ::-1])
    assert not views.depth.flags.c_contiguous
    np.testing.assert_allclose(Segmenter(gate).segment(views), expected, rtol=1e-13)
    flipped = RgbdFrame(0, frame.depth[::-1].copy()[::-1], 0.001, frame.intrinsics, np.asfortranarray(frame.color))
    np.testing.assert_allclose(Segmenter(gate).segment(flipped), expected, rtol=1e-13)
    mask = np.asfortranarray(rng.random((48, 64)) < 0.5)
    np.testing.assert_allclose(Segmenter(gate).segment(frame, mask), plain_segment(frame, mask=mask), rtol=1e-13)


def test_images_that_cannot_be_written_to() -> None:
    frame = random_frame(np.random.default_rng(8), np.float32, 64, 48)
    expected = Segmenter().segment(frame).copy()
    assert frame.color is not None
    for array in (frame.depth, frame.color):
        array.setflags(write=False)
    np.testing.assert_array_equal(Segmenter().segment(frame), expected)
    assert Segmenter(ColorGate.around_color((0, 0, 0), 200)).segment(frame).shape == expected.shape


@pytest.mark.parametrize("value", [0.0, -0.0, -1.0, np.nan, -np.nan, np.inf, -np.inf, -1e-30])
def test_what_is_no_depth(value: float) -> None:
    camera = Intrinsics(70, 2, 50.0, 50.0, 35.0, 1.0)
    depth = np.full((2, 70), value, np.float32)
    assert Segmenter().segment(RgbdFrame(0, depth, 1.0, camera)).shape == (3, 0)
    depth[1, 69] = 1.5
    np.testing.assert_allclose(Segmenter().segment(RgbdFrame(0, depth, 1.0, camera)), [[34 / 50 * 1.5], [0.0], [1.5]])


def test_the_largest_depth_is_a_depth() -> None:
    camera = Intrinsics(2, 1, 1.0, 1.0, 0.0, 0.0)
    whole = RgbdFrame(0, np.array([[65535, 1]], np.uint16), 0.001, camera)
    np.testing.assert_allclose(Segmenter().segment(whole)[2], [65.535, 0.001])
    single = RgbdFrame(0, np.array([[np.finfo(np.float32).max, 1e-30]], np.float32), 1.0, camera)
    assert Segmenter().segment(single).shape == (3, 2)


def test_a_call_overwrites_the_one_before_but_forgets_none_of_its_own() -> None:
    rng = np.random.default_rng(2)
    segmenter = Segmenter()
    for width in (10, 150, 30):
        frame = random_frame(rng, np.uint16, width, 9)
        np.testing.assert_allclose(segmenter.segment(frame), plain_segment(frame), rtol=1e-13)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([np.float32, np.float64]), st.integers(0, 300))
def test_a_cloud_equals_its_twin(seed: int, kind: type, count: int) -> None:
    rng = np.random.default_rng(seed)
    points: NDArray[Any] = rng.uniform(-1, 2, (count, 3)).astype(kind)
    points[rng.random((count, 3)) < 0.02] = rng.choice([np.nan, np.inf, -np.inf])
    colors = rng.integers(0, 256, (count, 3)).astype(np.uint8)
    frame = CloudFrame(0, points, colors)
    gate = ColorGate.around_color((200, 40, 30), 60) if rng.random() < 0.5 else None
    box = random_box(rng) if rng.random() < 0.5 else None
    mask = rng.random(count) < 0.5 if rng.random() < 0.3 else None
    keep = np.isfinite(points).all(axis=1)
    if mask is not None:
        keep &= mask
    elif gate is not None:
        keep &= plain_accepts(gate, colors)
    if box is not None:
        placed = np.where(keep[:, None], points, 0).astype(float) @ box.box_from_camera[:3, :3].T
        placed += box.box_from_camera[:3, 3]
        keep &= ((placed >= box.low) & (placed <= box.high)).all(axis=1)
    np.testing.assert_array_equal(Segmenter(gate, box).segment(frame, mask), points[keep].astype(float).T)


def test_camera_bounds_hold_the_box_and_touch_it() -> None:
    rng = np.random.default_rng(6)
    for _ in range(50):
        box = random_box(rng)
        low, high = box.camera_bounds()
        inside = box.low + rng.random((3000, 3)) ** rng.choice([0.1, 1, 3], (3000, 3)) * (box.high - box.low)
        camera_from_box = np.linalg.inv(box.box_from_camera)
        seen = inside @ camera_from_box[:3, :3].T + camera_from_box[:3, 3]
        assert (seen >= low - 1e-12).all()
        assert (seen <= high + 1e-12).all()
        assert (seen.min(axis=0) - low < 0.35 * (high - low)).all()
        assert (high - seen.max(axis=0) < 0.35 * (high - low)).all()


# --- colour ---


@pytest.mark.parametrize(
    ("rgb", "lab"),
    [  # Lindbloom's calculator and scikit-image's documentation, D65, 2 degrees
        ((255, 255, 255), (100.0, 0.0, 0.0)),
        ((0, 0, 0), (0.0, 0.0, 0.0)),
        ((255, 0, 0), (53.2408, 80.0925, 67.2032)),
        ((0, 255, 0), (87.7347, -86.1827, 83.1793)),
        ((0, 0, 255), (32.2970, 79.1875, -107.8602)),
        ((255, 255, 0), (97.1393, -21.5537, 94.4780)),
        ((0, 255, 255), (91.1132, -48.0875, -14.1312)),
        ((255, 0, 255), (60.3242, 98.2343, -60.8249)),
        ((128, 128, 128), (53.5850, 0.0, 0.0)),
    ],
)
def test_published_lab_values(rgb: tuple[int, int, int], lab: tuple[float, float, float]) -> None:
    np.testing.assert_allclose(lab_from_rgb(np.array(rgb, np.uint8)), lab, atol=0.01)


def test_lab_equals_an_independent_formula() -> None:
    colors = np.random.default_rng(0).integers(0, 256, (5000, 3)).astype(np.uint8)
    np.testing.assert_allclose(lab_from_rgb(colors), independent_lab(colors), atol=0.03)
    assert lab_from_rgb(colors.reshape(50, 100, 3)).shape == (50, 100, 3)


def test_light_beyond_full_light_goes_on() -> None:
    lab = lab_from_linear(np.array([[1.0, 1.0, 1.0], [1.3, 1.3, 1.3]]))
    assert lab[1, 0] == pytest.approx(116 * 1.3 ** (1 / 3) - 16)


@settings(max_examples=40, deadline=None)
@given(st.tuples(*[st.integers(0, 255)] * 3), st.floats(0.5, 100), st.integers(0, 2**32 - 1))
def test_gate_table_equals_direct_judgement(rgb: tuple[int, int, int], tolerance: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    gate = ColorGate.around_color(rgb, tolerance)
    near = np.clip(np.array(rgb) * rng.uniform(0.2, 1.2, (200, 1)) + rng.normal(0, 20, (200, 3)), 0, 255)
    colors = np.concatenate([rng.integers(0, 256, (200, 3)), near]).astype(np.uint8)
    expected = plain_accepts(gate, colors)
    np.testing.assert_array_equal(gate.accepts(colors), expected)
    np.testing.assert_array_equal(gate.accepts(colors), expected)  # now from the table


def test_lab_box_includes_its_faces_and_nothing_beyond() -> None:
    rng = np.random.default_rng(1)
    colors = rng.integers(0, 256, (3000, 3)).astype(np.uint8)
    gate = ColorGate.inside_lab_box((20, 10, -10), (70, 60, 60))
    expected = plain_accepts(gate, colors)
    assert 0 < expected.sum() < 3000
    np.testing.assert_array_equal(gate.accepts(colors.reshape(30, 100, 3)).ravel(), expected)
    white = np.array([[255, 255, 255]], np.uint8)
    lab = lab_from_rgb(white)[0]
    assert ColorGate.inside_lab_box(tuple(lab - 1), tuple(lab + 1e-6)).accepts(white)[0]
    assert not ColorGate.inside_lab_box(tuple(lab - 2), tuple(lab - 1e-3)).accepts(white)[0]


HUES = [
    tuple(round(255 * v) for v in colorsys.hsv_to_rgb(hue, saturation, value))
    for hue in np.linspace(0, 1, 24, endpoint=False)
    for saturation in (1.0, 0.7, 0.3, 0.0)
    for value in (1.0, 0.8, 0.5, 0.25)
]


@pytest.mark.parametrize("darkest", [0.5])
def test_every_shade_down_to_half_brightness_passes(darkest: float) -> None:
    """Darkened in linear light, as a tube's edge is, or in sRGB values, as a picture editor does."""
    shares = np.linspace(darkest, 1, 26)[:, None]
    for rgb in HUES:
        gate = ColorGate.around_color((rgb[0], rgb[1], rgb[2]), DEFAULT_TOLERANCE)
        color = np.array(rgb) / 255
        linear = np.round(255 * srgb_from_linear(shares * linear_from_srgb(color))).astype(np.uint8)
        srgb = np.round(255 * shares * color).astype(np.uint8)
        assert gate.accepts(linear).all(), f"{rgb} in linear light"
        assert gate.accepts(srgb).all(), f"{rgb} in sRGB"


def test_other_hues_of_the_same_darkness_do_not_pass() -> None:
    """Saturated hues a sixth of the circle apart or more, at every darkness down to half brightness."""
    for hue in np.linspace(0, 1, 24, endpoint=False):
        full = colorsys.hsv_to_rgb(hue, 1.0, 0.9)
        r, g, b = (round(255 * v) for v in full)
        gate = ColorGate.around_color((r, g, b), DEFAULT_TOLERANCE)
        for turn in (1 / 6, 1 / 4, 1 / 3, 1 / 2):
            other = np.array(colorsys.hsv_to_rgb((hue + turn) % 1, 1.0, 0.9))
            for share in (1.0, 0.8, 0.65, 0.5):
                shaded = np.round(255 * srgb_from_linear(share * linear_from_srgb(other))).astype(np.uint8)
                assert not gate.accepts(shaded[None])[0], f"hue {hue:.2f} takes {hue + turn:.2f} at {share}"


def test_grey_does_not_pass_for_a_saturated_rope() -> None:
    greys = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
    gate = ColorGate.around_color((200, 40, 30), DEFAULT_TOLERANCE)
    assert not gate.accepts(greys[30:]).any()


def test_a_joined_gate_accepts_what_either_accepts() -> None:
    rng = np.random.default_rng(0)
    colors = rng.integers(0, 256, (5000, 3), dtype=np.uint8)
    red, blue = (ColorGate.around_color(rgb, DEFAULT_TOLERANCE) for rgb in ((200, 40, 30), (30, 60, 200)))
    both = red.joined(blue)
    assert (both.accepts(colors) == (red.accepts(colors) | blue.accepts(colors))).all()
    assert red.accepts(colors).any()
    assert blue.accepts(colors).any()
