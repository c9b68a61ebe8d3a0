"""Noise: each model's statistics against its formula, its kernels against NumPy, the same bytes from a seed."""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
import pytest
from numpy.typing import NDArray

from ropetrace.errors import ConfigError
from ropetrace.sim.noise import (
    NOISE_MODELS,
    FlyingPixels,
    LostEdges,
    SensorNoise,
    apply_noise,
    in_steps,
    kinect_axial,
    noise_model,
)
from ropetrace.sim.pixel_random import NORMAL_QUANTILES, keys, normal, pixel_bits, uniform
from ropetrace.sim.raycaster import RayCaster, Window
from ropetrace.sim.scene import Capsules, Plane, Scene
from ropetrace.sim.triangulation import KinectV1, Stereo, grazing_angle, shadowed
from ropetrace.types import FloatArray, Intrinsics

NATIVE = Intrinsics(640, 480, 580.0, 580.0, 319.5, 239.5)
CAMERA = Intrinsics(300, 200, 260.0, 260.0, 149.5, 99.5)
Image = NDArray[np.float32]


def wall(distance: float, camera: Intrinsics = CAMERA) -> Image:
    return np.full((camera.height, camera.width), distance, np.float32)


def whole(camera: Intrinsics) -> Window:
    return 0, camera.height, 0, camera.width


def noisy(noise: SensorNoise, depth: Image, camera: Intrinsics = CAMERA, seed: int = 0) -> FloatArray:
    return noise.apply(depth, camera, np.random.default_rng(seed), whole(camera)).astype(float)


def view(camera: Intrinsics, planes: tuple[Plane, ...] = ()) -> tuple[Image, Window]:
    """A wavy rope, and what stands behind it."""
    y = np.linspace(-0.25, 0.25, 30)
    curve = np.stack([0.1 * np.sin(9 * y), y, 1 + 0.1 * np.cos(7 * y)], axis=1)
    image = RayCaster(camera).render(Scene(Capsules.along(curve, 0.01), planes))
    return image.depth, image.window


# --- random numbers of pixels ---


def bits_twin(key: np.uint64, index: NDArray[np.int64]) -> NDArray[np.uint64]:
    bits = key + (index.astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(bits ^ (bits >> np.uint64(31)))


def normal_twin(key: np.uint64, index: NDArray[np.int64]) -> FloatArray:
    bits = bits_twin(key, index)
    cell = (bits >> np.uint64(53)).astype(int)
    part = ((bits >> np.uint64(11)) & np.uint64((1 << 42) - 1)).astype(float) / 2.0**42
    return NORMAL_QUANTILES[cell] * (1 - part) + NORMAL_QUANTILES[cell + 1] * part


def test_the_random_numbers_of_pixels_equal_their_twins() -> None:
    key = keys(np.random.default_rng(3), 2)[1]
    index = np.arange(0, 10**6, 997)
    np.testing.assert_array_equal([pixel_bits(key, k) for k in index], bits_twin(key, index))
    np.testing.assert_allclose([normal(key, k, NORMAL_QUANTILES) for k in index], normal_twin(key, index), atol=1e-12)
    # The first number of SplitMix64 from seed 0, as published.
    assert int(pixel_bits(np.uint64(0), 0)) == 0xE220A8397B1DCDAF


def test_the_deviates_are_normal_and_without_correlation() -> None:
    from scipy import stats

    index = np.arange(400_000)
    first, second = keys(np.random.default_rng(0), 2)
    a, b = normal_twin(first, index), normal_twin(second, index)
    assert stats.kstest(a, "norm").pvalue > 0.01
    assert a.std() == pytest.approx(1, abs=0.005)
    assert stats.kurtosis(a) == pytest.approx(0, abs=0.03)
    for other in (b, np.roll(a, 1), np.roll(a, 640)):
        assert abs(np.corrcoef(a, other)[0, 1]) < 0.006
    assert 0 <= min(uniform(first, k) for k in range(1000)) < 0.01
    assert NORMAL_QUANTILES[-1] == pytest.approx(3.8, abs=0.01)


# --- Kinect v1 ---


@pytest.mark.parametrize("z", [0.6, 1.0, 2.0, 4.0])
def test_kinect_on_a_wall_has_the_published_deviation_and_steps(z: float) -> None:
    seen = noisy(KinectV1(shadow=False), wall(z))
    assert (seen > 0).mean() > 0.95  # what is shown from beyond the border is lost
    inner = seen[seen > 0]
    axial, step = 0.0012 + 0.0019 * (z - 0.4) ** 2, z * z / (8 * 43.5)
    assert inner.std() == pytest.approx(math.hypot(axial, step / math.sqrt(12)), rel=0.03)
    assert inner.mean() == pytest.approx(z, abs=1.5 * axial**2 / z + 0.02 * axial)
    steps = 8 * 43.5 / inner
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)
    if z == 1.0:
        assert np.diff(np.unique(inner)).min() == pytest.approx(2.87e-3, rel=0.03)


def test_kinect_has_a_range() -> None:
    for z in (0.39, 4.6):
        assert not noisy(KinectV1(), wall(z)).any()


@pytest.mark.parametrize("camera", [NATIVE, Intrinsics(1280, 720, 1108.5, 1108.5, 639.5, 359.5)])
def test_kinect_shifts_sideways_by_native_pixels(camera: Intrinsics) -> None:
    """A step in depth is seen as far away as the lateral noise reaches: 0.8 px of the Kinect's own image."""
    depth = wall(1.0, camera)
    half = camera.width // 2
    depth[:, half:] = 2.0
    seen = noisy(KinectV1(shadow=False), depth, camera)
    share = (seen > 1.5).sum(axis=0) / (seen > 0).sum(axis=0)
    # A shift is a whole number of pixels: a column k pixels from the step sees across it if the deviate is larger than
    # k - 1/2.
    across = NormalDist(0, 0.8 * camera.fx / 580).cdf
    expected = [across(column - half + 0.5) for column in range(camera.width)]
    np.testing.assert_allclose(share, expected, atol=0.08)
    assert share.sum() == pytest.approx(sum(expected), abs=0.5)
    assert (share * (1 - share)).sum() == pytest.approx(sum(p * (1 - p) for p in expected), abs=0.08)
    assert share[: half - 30].max() == 0
    assert share[half + 30 :].min() == 1


def test_kinect_loses_grazing_surfaces_and_is_worse_near_them() -> None:
    def tilted(degrees: float) -> Image:
        plane = Plane((math.sin(math.radians(degrees)), 0.0, math.cos(math.radians(degrees))), 1.0, (9, 9, 9), 0)
        narrow = Intrinsics(200, 200, 2000.0, 2000.0, 99.5, 99.5)
        depth = RayCaster(narrow).render(Scene(Capsules.none(), (plane,))).depth
        z = 1.0 / math.cos(math.radians(degrees))
        scaled = (depth / z).astype(np.float32)  # the same tilt, 1 m away in the middle
        middle = scaled[:, 95:105]
        angle = grazing_angle(scaled, narrow, whole(narrow))[:, 95:105]
        assert np.degrees(angle).mean() == pytest.approx(degrees, abs=1.5 if degrees == 0 else 0.1)
        seen = noisy(KinectV1(shadow=False), scaled, narrow)[:, 95:105]
        return np.asarray(np.where(seen > 0, seen - middle, np.nan), np.float32)

    assert np.isnan(tilted(84)).all()
    steep, flat = tilted(75), tilted(0)
    assert np.isfinite(steep).mean() > 0.95
    t = math.radians(75)
    axial = 0.0012 + 0.0019 * 0.36 + 0.0001 * t**2 / (math.pi / 2 - t) ** 2
    lateral = (0.8 + 0.035 * t / (math.pi / 2 - t)) / 580 * math.tan(t)
    expected = math.sqrt(axial**2 + lateral**2 + (1 / 348) ** 2 / 12)
    assert np.nanstd(steep) == pytest.approx(expected, rel=0.1)
    assert np.nanstd(flat) < 0.5 * np.nanstd(steep)


def test_the_grazing_angle_is_exact_on_planes_and_spheres() -> None:
    plane = Plane((0.5, -0.3, 1.0), 1.5, (9, 9, 9), 0)
    depth = RayCaster(CAMERA).render(Scene(Capsules.none(), (plane,))).depth
    rows, columns = np.mgrid[:200, :300]
    rays = np.stack([(columns - 149.5) / 260, (rows - 99.5) / 260, np.ones(rows.shape)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    normal_ = np.array(plane.normal) / np.linalg.norm(plane.normal)
    angle = grazing_angle(depth, CAMERA, whole(CAMERA))
    np.testing.assert_allclose(angle, np.arccos(np.abs(rays @ normal_)), atol=2e-3)
    ball = RayCaster(CAMERA).render(Scene(Capsules.sphere((0.1, 0, 1.0), 0.3))).depth
    points = rays / rays[..., 2:] * ball[..., None]
    outward = (points - [0.1, 0, 1.0]) / 0.3
    expected = np.arccos(np.clip(-(outward * rays).sum(axis=-1), 0, 1))
    angle = grazing_angle(ball, CAMERA, whole(CAMERA))
    inside = (ball > 0) & (expected < 1.2)
    assert np.abs(angle - expected)[inside].max() < 0.03
    assert (angle[ball == 0] == 0).all()


# --- stereo ---


@pytest.mark.parametrize(("z", "width"), [(0.5, 848), (1.0, 848), (3.0, 848), (1.0, 480), (1.0, 1280)])
def test_stereo_on_a_wall_has_the_formulas_deviation(z: float, width: int) -> None:
    camera = Intrinsics(width, 200, 500.0, 500.0, (width - 1) / 2, 99.5)
    seen = noisy(Stereo(), wall(z, camera), camera)
    focal_baseline = 430 / 848 * width * 0.05
    expected = z * z / focal_baseline * math.hypot(0.08, (1 / 32) / math.sqrt(12))
    assert (seen > 0).all()
    assert seen.std() == pytest.approx(expected, rel=0.04)
    assert seen.mean() == pytest.approx(z, abs=0.1 * expected)
    if (z, width) == (1.0, 848):
        assert Stereo().deviation(np.array(1.0), 848) == pytest.approx(3.7e-3, abs=3e-5)
    disparity = 32 * focal_baseline / seen
    np.testing.assert_allclose(disparity, np.round(disparity), atol=2e-3)


def test_stereo_errors_are_alike_within_the_matching_window() -> None:
    """The mean of 3 by 3 independent errors: neighbours share 6 of 9, the next 3 of 9, then none."""
    error = noisy(Stereo(disparity_step=1e-6), wall(1.0)) - 1.0
    for shift, expected in ((1, 2 / 3), (2, 1 / 3), (3, 0.0)):
        for a, b in ((error[:, shift:], error[:, :-shift]), (error[shift:], error[:-shift])):
            assert np.corrcoef(a.ravel(), b.ravel())[0, 1] == pytest.approx(expected, abs=0.03)


def test_stereo_equals_its_twin() -> None:
    depth, window = view(CAMERA, (Plane((0.1, 0.0, 1.0), 1.4, (9, 9, 9), 1),))
    noise = Stereo(matching_window=5, shadow=False)
    key = keys(np.random.default_rng(4), 1)[0]
    white = normal_twin(key, np.arange(204 * 304)).reshape(204, 304)
    summed = np.lib.stride_tricks.sliding_window_view(white, (5, 5)).sum(axis=(2, 3))
    focal_baseline = 430 / 848 * 300 * 0.05
    z = np.where(depth > 0, depth, 1).astype(float)
    disparity = np.round((focal_baseline / z + 0.08 * summed / 5) * 32) / 32
    expected = np.where((depth > 0) & (disparity > 0) & (disparity <= 126), focal_baseline / disparity, 0)
    seen = noise.apply(depth, CAMERA, np.random.default_rng(4), window)
    assert (np.abs(seen - expected) > 1e-6).mean() < 1e-4  # a sum may round to the other step


def test_stereo_is_blind_nearer_than_its_largest_disparity() -> None:
    nearest = 430 / 848 * 300 * 0.05 / 126
    assert not noisy(Stereo(), wall(nearest * 0.97)).any()
    assert noisy(Stereo(), wall(nearest * 1.03)).all()


def test_the_shadow_lies_left_of_what_stands_in_front() -> None:
    depth = wall(2.0)
    depth[50:150, 100:140] = 1.0
    lost = shadowed(depth, 43.5, whole(CAMERA)) == 0
    # f b (1 / 1 - 1 / 2) = 21.75 px, cut to whole pixels.
    np.testing.assert_array_equal(np.flatnonzero(lost[100]), np.arange(79, 100))
    assert not lost[:50].any()
    assert not lost[150:].any()
    empty = depth.copy()
    empty[depth == 2.0] = 0
    np.testing.assert_array_equal(shadowed(empty, 43.5, whole(CAMERA)), empty)


def test_the_shadow_equals_its_twin() -> None:
    depth, window = view(CAMERA, (Plane((0.3, 0.0, 1.0), 1.4, (9, 9, 9), 1),))
    z = np.where(depth > 0, depth, np.nan).astype(float)
    seen_at = np.arange(300) - 20.0 / z
    least = np.fmin.accumulate(np.where(np.isnan(seen_at), np.inf, seen_at)[:, ::-1], axis=1)[:, ::-1]
    expected = np.where(seen_at <= least, depth, 0)
    np.testing.assert_array_equal(shadowed(depth, 20.0, window), expected)
    assert (expected != depth).sum() > 50


# --- edges ---


def test_edges_are_lost_at_their_share() -> None:
    depth = np.zeros((200, 300), np.float32)
    depth[20:180, 20:280] = 2.0
    depth[60:140, 100:200] = 1.0
    near = np.pad(depth, 1, mode="edge")
    edge = np.zeros(depth.shape, bool)
    for other in (near[:-2, 1:-1], near[2:, 1:-1], near[1:-1, :-2], near[1:-1, 2:]):
        edge |= (depth > 0) & (np.abs(other - depth) > 0.05)
    for share in (0.0, 0.4, 1.0):
        seen = noisy(LostEdges(share), depth)
        assert (seen[edge] == 0).mean() == pytest.approx(share, abs=0.04)
        np.testing.assert_array_equal(seen[~edge], depth[~edge])
    np.testing.assert_array_equal(noisy(LostEdges(1.0), wall(1.0)), wall(1.0))  # the border of the image is no edge


def test_flying_pixels_lie_evenly_between_front_and_back() -> None:
    depth = wall(2.0)
    depth[20:180, 100:200] = 1.0
    depth[:, 280:] = 0
    seen = noisy(FlyingPixels(0.3), depth)
    step = np.zeros(depth.shape, bool)
    step[20:180, [99, 100, 199, 200]] = True
    step[[19, 20, 179, 180], 100:200] = True
    flying = seen[step & (seen != depth)]
    assert len(flying) / step.sum() == pytest.approx(0.3, abs=0.05)
    assert 1.0 < flying.min() < 1.05
    assert 1.95 < flying.max() < 2.0
    assert flying.mean() == pytest.approx(1.5, abs=0.06)
    np.testing.assert_array_equal(seen[~step], depth[~step])


# --- all ---


@pytest.mark.parametrize("name", NOISE_MODELS)
@pytest.mark.parametrize("camera", [CAMERA, NATIVE])
def test_noise_repeats_with_its_seed_whatever_the_window(name: str, camera: Intrinsics) -> None:
    depth, window = view(camera)
    before = depth.copy()
    noise = noise_model(name)
    small, seen_in = apply_noise(noise, depth, camera, np.random.default_rng(1), window)
    large, _ = apply_noise(noise, depth, camera, np.random.default_rng(1))
    np.testing.assert_array_equal(small, large)
    np.testing.assert_array_equal(in_steps(small, 0.001, seen_in), in_steps(large, 0.001))
    np.testing.assert_array_equal(depth, before)
    assert seen_in != whole(camera)
    if noise:
        assert (small != depth).any()
        assert (apply_noise(noise, depth, camera, np.random.default_rng(2), window)[0] != small).any()
        nothing = apply_noise(noise, np.zeros_like(depth), camera, np.random.default_rng(1), (0, 0, 0, 0))[0]
        assert not nothing.any()


def test_steps_are_rounded_and_what_cannot_be_counted_is_lost() -> None:
    depth = np.array([[0.0, 0.0014, 1.2344, 65.535, 65.6, np.inf]], np.float32)
    np.testing.assert_array_equal(in_steps(depth, 0.001), [[0, 1, 1234, 65535, 0, 0]])
    assert in_steps(depth, 0.001, (0, 1, 2, 4)).tolist() == [[0, 0, 1234, 65535, 0, 0]]


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ConfigError, match="'kinect': choose one of none, kinect_v1, stereo"):
        noise_model("kinect")
    with pytest.raises(ConfigError, match="share"):
        LostEdges(1.5)
    with pytest.raises(ConfigError, match="step"):
        FlyingPixels(0.5, 0.0)
    with pytest.raises(ConfigError, match="odd"):
        Stereo(matching_window=4)
    with pytest.raises(ConfigError, match="baseline"):
        Stereo(baseline=0)
    with pytest.raises(ConfigError, match="subpixel"):
        Stereo(subpixel=-1)


# --- the noise of the first recordings ---


@pytest.mark.parametrize(("distance", "deviation"), [(0.4, 0.0012), (1.4, 0.0031), (2.4, 0.0088)])
def test_axial_noise_has_the_published_deviation(distance: float, deviation: float) -> None:
    seen = kinect_axial(wall(distance), np.random.default_rng(0), lost_edges=0)
    metres = seen * 0.001
    assert metres.mean() == pytest.approx(distance, abs=1e-4)
    assert metres.std() == pytest.approx(np.hypot(deviation, 0.001 / np.sqrt(12)), rel=0.03)


def test_axial_noise_loses_edges_at_the_rate_asked_for() -> None:
    depth = np.zeros((60, 400), np.float32)
    depth[20:40, 50:350] = 1.0
    edge = np.zeros(depth.shape, bool)
    edge[[20, 39], 50:350] = True
    edge[20:40, [50, 349]] = True
    for share in (0.0, 0.5, 1.0):
        seen = kinect_axial(depth, np.random.default_rng(1), share)
        assert (seen[edge] == 0).mean() == pytest.approx(share, abs=0.07)
        assert (seen[(depth > 0) & ~edge] > 0).all()
        assert (seen[depth == 0] == 0).all()


def test_axial_noise_repeats_with_its_seed_and_leaves_its_input_alone() -> None:
    depth = wall(1.0)
    a = kinect_axial(depth, np.random.default_rng(5))
    np.testing.assert_array_equal(a, kinect_axial(depth, np.random.default_rng(5)))
    assert (a != kinect_axial(depth, np.random.default_rng(6))).any()
    assert (depth == 1.0).all()
    assert not kinect_axial(np.zeros((4, 5), np.float32), np.random.default_rng(0)).any()


def test_axial_noise_is_counted_in_steps() -> None:
    coarse = kinect_axial(wall(1.0), np.random.default_rng(0), 0, step=0.01)
    assert coarse.dtype == np.uint16
    assert abs(int(np.median(coarse)) - 100) <= 1
    assert kinect_axial(wall(100.0), np.random.default_rng(0)).max() == 65535
