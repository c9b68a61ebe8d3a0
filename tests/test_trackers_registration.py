"""The trackers that register nodes: accuracy, invariance, honest statuses, loss and restart, whatever the frames."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers import SHAPES, random_rotation, rope_cloud, seen
from ropetrace.config import RopeConfig
from ropetrace.config_methods import CdcpdConfig, CpdConfig, GltpConfig, SprConfig, TrackDloConfig
from ropetrace.errors import ConfigError
from ropetrace.evaluation.metrics import at_equal_arc_length, distances_to_curve, node_errors
from ropetrace.sim.camera import Capsules, RayCaster, Scene
from ropetrace.trackers import METHODS, Tracker, make_tracker
from ropetrace.trackers.nodes import RESTART_AFTER, NodeTracker
from ropetrace.types import BadFrame, CloudFrame, Estimate, FloatArray, Intrinsics, RgbdFrame, Status

NAMES = ["cpd", "gltp", "spr", "trackdlo", "cdcpd"]
TABLES: dict[str, Any] = {
    "cpd": CpdConfig,
    "gltp": GltpConfig,
    "spr": SprConfig,
    "trackdlo": TrackDloConfig,
    "cdcpd": CdcpdConfig,
}
FAST: dict[str, dict[str, Any]] = {"trackdlo": {"visible_within": 0.05}}
"""What suits a rope that moves by more than a centimetre from frame to frame."""

CAMERA = Intrinsics(640, 480, 554.3, 554.3, 319.5, 239.5)
DIAMETER = 0.015

Views = list[tuple[RgbdFrame, FloatArray]]


def made(name: str, nodes: FloatArray | None = None, **settings: Any) -> Tracker:
    config = RopeConfig(DIAMETER, method=name)
    if settings:
        config = dataclasses.replace(config, **{name: TABLES[name](**settings)})
    return make_tracker(config, nodes=nodes)


def swinging_curve(seconds: float) -> FloatArray:
    """A rope of 0.7 m that hangs at (0, -0.35, 0.9) and swings at 0.8 Hz, (701, 3), metres."""
    s = np.linspace(0, 1, 701)
    phase = 2 * np.pi * 0.8 * seconds
    turn = 0.2 * np.sin(phase) + 0.25 * s * np.sin(phase - 1.5 * s)
    steps = np.stack([np.sin(turn) * 0.95, np.cos(turn), np.sin(turn) * np.sqrt(1 - 0.95**2)], axis=1)[:-1]
    start = np.array([[0.0, -0.35, 0.9]])
    return np.concatenate([start, start + np.cumsum(steps, axis=0) * 0.7 / len(steps)])


def view(curve: FloatArray, index: int, hidden_rows: int = 0) -> RgbdFrame:
    """640x480 depth with 1 mm of noise, without its last rows."""
    depth = RayCaster(CAMERA).render(Scene(Capsules.along(curve, DIAMETER / 2))).depth
    noise = np.random.default_rng(index).normal(0, 0.001, depth.shape).astype(np.float32)
    depth = np.where(depth > 0, depth + noise, np.float32(0))
    depth[len(depth) - hidden_rows :] = 0
    return RgbdFrame(index * 33_333_333, depth, 1.0, CAMERA)


@pytest.fixture(scope="module")
def swing() -> Views:
    curves = [swinging_curve(index / 30) for index in range(40)]
    return [(view(curve, index), curve) for index, curve in enumerate(curves)]


def assert_sound(estimate: Estimate) -> None:
    """What holds of every estimate, whatever the frame."""
    assert (estimate.status is Status.OK) == (not estimate.reasons)
    if estimate.status is Status.LOST:
        assert len(estimate.nodes) == len(estimate.waypoints) == 0
        return
    assert len(estimate.nodes) == 45
    for array in (estimate.nodes, estimate.waypoints.positions, estimate.waypoints.quaternions):
        assert np.isfinite(array).all()
    assert (np.diff(estimate.waypoints.arc_length) > 0).all()


def update(tracker: Tracker, frame: RgbdFrame | CloudFrame) -> Estimate:
    estimate = tracker.update(frame)
    assert_sound(estimate)
    assert estimate.stamp_ns == frame.stamp_ns
    cloud = tracker.cloud()
    if estimate.status is not Status.LOST:
        assert len(cloud.points) == -(-estimate.point_count // estimate.point_stride)
    assert cloud.node.max(initial=-1) < max(len(estimate.nodes), 1)
    return estimate


# --- accuracy ---


@pytest.mark.parametrize(
    ("name", "settings", "most", "most_along"),
    [
        ("cpd", {}, 0.52, 10),
        ("gltp", {}, 0.84, 10),
        ("spr", {}, 0.51, 10),
        ("trackdlo", {}, 1.7, 20),
        ("trackdlo", {"visible_within": 0.05}, 0.77, 5),
        ("cdcpd", {}, 2.2, 20),
    ],
)
def test_a_swinging_rope_is_found_as_well_as_in_the_trial(
    swing: Views, name: str, settings: dict[str, Any], most: float, most_along: float
) -> None:
    """From the nodes to the curve, and at equal arc length: means in mm."""
    tracker = made(name, at_equal_arc_length(swing[0][1], 45), **settings)
    off, along = [], []
    for frame, curve in swing:
        estimate = update(tracker, frame)
        assert estimate.status is not Status.LOST, estimate.reasons
        off.append(distances_to_curve(estimate.nodes, curve).mean() * 1e3)
        along.append(node_errors(estimate.waypoints.positions, curve).mean() * 1e3)
    assert np.mean(off) <= most
    assert np.mean(along) <= most_along


@pytest.mark.parametrize("name", NAMES)
def test_it_starts_by_itself_from_the_upper_end(swing: Views, name: str) -> None:
    tracker = made(name, **FAST.get(name, {}))
    for frame, curve in swing[:3]:
        estimate = update(tracker, frame)
        assert estimate.status is not Status.LOST
        assert np.linalg.norm(estimate.nodes[0] - curve[0]) < 0.015
        assert estimate.waypoints.length == pytest.approx(0.7, abs=0.03)
    reversed_start = dataclasses.replace(
        RopeConfig(DIAMETER, method=name).ordering, first="point", first_point=(0, 1, 1)
    )
    tracker = make_tracker(RopeConfig(DIAMETER, method=name, ordering=reversed_start))
    assert np.linalg.norm(update(tracker, swing[0][0]).nodes[-1] - swing[0][1][0]) < 0.015


@pytest.mark.parametrize("name", NAMES)
def test_nodes_lie_on_the_axis_not_on_the_surface(name: str) -> None:
    curve = SHAPES["s"]
    tracker = make_tracker(RopeConfig(0.03, method=name))
    estimate = update(tracker, seen(curve, 0.015, CAMERA))
    off = estimate.nodes[3:-3, 2] - np.interp(estimate.nodes[3:-3, 1], curve[:, 1], curve[:, 2])
    assert abs(off.mean()) < 0.001


# --- invariance and determinism ---


def cloud_frame(points: FloatArray, index: int = 0) -> CloudFrame:
    return CloudFrame(index * 33_333_333, np.ascontiguousarray(points))


def smooth_rope(seed: int, count: int = 1500) -> tuple[FloatArray, FloatArray]:
    """Points round a hanging rope, (count, 3), and 45 nodes along it."""
    rng = np.random.default_rng(seed)
    curve = swinging_curve(0.3)
    return curve[rng.integers(0, len(curve), count)] + rng.normal(0, 0.003, (count, 3)), at_equal_arc_length(curve, 45)


@pytest.mark.parametrize("name", NAMES)
def test_turning_the_camera_turns_the_nodes(name: str) -> None:
    points, nodes = smooth_rope(1)
    wide: dict[str, Any] = {"box": (9.0, 9.0, 9.0)} if name == "cdcpd" else {}
    rotation = random_rotation(np.random.default_rng(2))
    plain = update(made(name, nodes, voxel=5e-4, **wide), cloud_frame(points)).nodes
    turned = update(made(name, nodes @ rotation.T, voxel=5e-4, **wide), cloud_frame(points @ rotation.T)).nodes
    np.testing.assert_allclose(turned, plain @ rotation.T, atol=2e-5)


@pytest.mark.parametrize("name", NAMES)
def test_the_order_of_the_points_does_not_matter(name: str) -> None:
    points, nodes = smooth_rope(3)
    shuffled = points[np.random.default_rng(0).permutation(len(points))]
    a, b = made(name, nodes), made(name, nodes)
    for index in range(3):
        moved = [0.005 * index, 0.0, 0.002 * index]
        one, other = update(a, cloud_frame(points + moved, index)), update(b, cloud_frame(shuffled + moved, index))
        np.testing.assert_allclose(other.nodes, one.nodes, atol=1e-8)


@pytest.mark.parametrize("name", NAMES)
def test_the_same_frames_give_the_same_bytes(swing: Views, name: str) -> None:
    tracker = made(name)
    first = [update(tracker, frame) for frame, _ in swing[:4]]
    tracker.reset()
    again = [update(tracker, frame) for frame, _ in swing[:4]]
    for a, b in zip(first, again, strict=True):
        assert a.nodes.tobytes() == b.nodes.tobytes()
        assert a.waypoints.quaternions.tobytes() == b.waypoints.quaternions.tobytes()
        assert a.reasons == b.reasons


# --- bad input ---


def bad_frames() -> dict[str, CloudFrame]:
    rng = np.random.default_rng(0)
    rope = rope_cloud(rng, 2000).T
    half_bad = rope.copy()
    half_bad[::2] = np.nan
    return {
        "empty": cloud_frame(np.empty((0, 3))),
        "all NaN": cloud_frame(np.full((500, 3), np.nan)),
        "infinite": cloud_frame(np.full((500, 3), np.inf)),
        "half NaN": cloud_frame(half_bad),
        "huge": cloud_frame(rope * 1e200),
        "kilometres": cloud_frame(rope * 1e3),
        "one point": cloud_frame(np.ones((1, 3))),
        "one place": cloud_frame(np.ones((800, 3))),
        "a line": cloud_frame(np.linspace(0, 1, 500)[:, None] * [0.0, 1.0, 0.0] + [0, 0, 1.0]),
        "noise": cloud_frame(rng.uniform(-1, 1, (3000, 3)) + [0, 0, 2.0]),
        "wall of 300 000": cloud_frame(np.c_[rng.uniform(-1, 1, (300_000, 2)), np.ones(300_000)]),
        "rope of 300 000": cloud_frame(rope_cloud(rng, 300_000).T),
    }


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("first", ["rope", "bad"])
def test_bad_clouds_raise_nothing(name: str, first: str) -> None:
    for frame in bad_frames().values():
        tracker = made(name)
        if first == "rope":
            update(tracker, cloud_frame(smooth_rope(4)[0]))
        for _ in range(2):
            update(tracker, frame)
    for kind in ("empty", "all NaN", "infinite", "huge", "one point"):
        assert update(made(name), bad_frames()[kind]).status is Status.LOST


@pytest.mark.parametrize("name", NAMES)
def test_a_first_frame_without_a_rope_is_waited_out(swing: Views, name: str) -> None:
    tracker = made(name)
    nothing = RgbdFrame(0, np.zeros((480, 640), np.float32), 1.0, CAMERA)
    assert update(tracker, nothing).reasons == ("no points of the rope's colour and place",)
    assert tracker.update(BadFrame(1, "torn")).reasons == ("torn",)
    assert update(tracker, swing[1][0]).status is not Status.LOST


# --- loss ---


@pytest.mark.parametrize("name", NAMES)
def test_a_rope_that_leaves_is_lost_and_found_again(swing: Views, name: str) -> None:
    tracker = made(name, **FAST.get(name, {}))
    for frame, _ in swing[:2]:
        update(tracker, frame)
    empty = np.zeros((480, 640), np.float32)
    for index in range(2, 2 + RESTART_AFTER):
        assert update(tracker, RgbdFrame(index * 33_333_333, empty, 1.0, CAMERA)).status is Status.LOST
    curve = swing[30][1] + [0.2, 0.0, 0.1]
    for index in (30, 31, 32):
        estimate = update(tracker, view(curve, index))
        assert estimate.status is not Status.LOST
        assert distances_to_curve(estimate.nodes, curve).mean() < 0.003
        assert np.linalg.norm(estimate.nodes[0] - curve[0]) < 0.02


@pytest.mark.parametrize("name", NAMES)
def test_a_rope_that_leaps_is_told_and_found_again(swing: Views, name: str) -> None:
    """Public implementations crash there."""
    tracker = made(name)
    for frame, _ in swing[:2]:
        update(tracker, frame)
    leapt = swing[2][1][::-1] * [-1, 1, 1] + [0.25, 0.0, 0.3]
    estimates = [update(tracker, view(leapt, index)) for index in range(2, 8 + RESTART_AFTER)]
    for estimate in estimates:
        if estimate.status is Status.OK:
            assert distances_to_curve(estimate.nodes, leapt).mean() < 0.005
    assert distances_to_curve(estimates[-1].nodes, leapt).mean() < 0.005


@pytest.mark.parametrize("name", NAMES)
def test_a_hidden_end_is_told(swing: Views, name: str) -> None:
    tracker = made(name, at_equal_arc_length(swing[0][1], 45))
    update(tracker, swing[0][0])
    for index in range(1, 8):
        estimate = update(tracker, view(swing[index][1], index, hidden_rows=190))
        assert estimate.status is not Status.OK


def test_trackdlo_keeps_a_hidden_end_at_its_length(swing: Views) -> None:
    tracker = made("trackdlo", at_equal_arc_length(swing[0][1], 45), visible_within=0.05)
    for index in range(20):
        estimate = update(tracker, view(swing[index][1], index, hidden_rows=150 if index else 0))
        assert estimate.waypoints.length == pytest.approx(0.7, rel=0.05)
        assert node_errors(estimate.waypoints.positions, swing[index][1]).mean() < 0.03


def test_cdcpd_does_not_stretch(swing: Views) -> None:
    tracker = made("cdcpd", at_equal_arc_length(swing[0][1], 45), stretch=1.02)
    for frame, _ in swing[:10]:
        steps = np.linalg.norm(np.diff(update(tracker, frame).nodes, axis=0), axis=1)
        assert steps.max() < 1.03 * 0.7 / 44


# --- settings ---


def test_methods_and_their_classes() -> None:
    assert [name for name in METHODS if name in NAMES] == NAMES
    for name in NAMES:
        tracker = made(name)
        assert isinstance(tracker, NodeTracker)
        assert type(tracker).__name__ == METHODS[name]
    with pytest.raises(ConfigError, match=r"method = 'track_dlo': expected one of .*; did you mean trackdlo?"):
        make_tracker(RopeConfig(DIAMETER, method="track_dlo"))


@pytest.mark.parametrize(
    "nodes",
    [np.zeros((44, 3)), np.zeros((45, 2)), np.full((45, 3), np.nan), np.ones((45, 3))],
    ids=["count", "shape", "NaN", "coincide"],
)
def test_nodes_that_are_no_start_are_refused(nodes: FloatArray) -> None:
    with pytest.raises(ConfigError, match="nodes"):
        made("cpd", nodes)
    with pytest.raises(ConfigError, match="takes no nodes"):
        make_tracker(RopeConfig(DIAMETER), nodes=np.ones((45, 3)))


@pytest.mark.parametrize("name", NAMES)
def test_tables_are_read_and_written_where_they_count(tmp_path: Path, name: str) -> None:
    path = tmp_path / "rope.toml"
    path.write_text(f'diameter = "15mm"\nmethod = "{name}"\n[{name}]\nnodes = 30\nvoxel = "5 mm"\n')
    config = RopeConfig.from_toml(path)
    assert getattr(config, name) == TABLES[name](nodes=30, voxel=0.005)
    written = config.resolved().to_toml()
    assert [other for other in NAMES if f"[{other}]" in written] == [name]
    path.write_text(written)
    assert RopeConfig.from_toml(path) == config.resolved()
    assert not any(f"[{other}]" in RopeConfig(0.015).to_toml() for other in NAMES)
    kept = dataclasses.replace(config, method="slicing")
    path.write_text(kept.to_toml())
    assert RopeConfig.from_toml(path) == kept


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "change", [{"nodes": 7}, {"voxel": 0.0}, {"outliers": 1.0}, {"max_iterations": 0}, {"beta": np.nan}]
)
def test_impossible_settings_are_refused(name: str, change: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=f"{name}.{next(iter(change))} = .*: expected"):
        TABLES[name](**change)
    with pytest.raises(ConfigError, match=r"cdcpd\.box"):
        CdcpdConfig(box=(0.1, 0.0, 0.1))


def test_an_unknown_setting_of_a_method_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rope.toml"
    path.write_text("diameter = 0.01\n[spr]\nanealing = 0.9\n")
    with pytest.raises(ConfigError, match=r"unknown setting spr.anealing: did you mean spr.annealing?"):
        RopeConfig.from_toml(path)


def test_a_mask_is_asked_once_a_frame(swing: Views) -> None:
    asked = []

    def mask(frame: Any) -> Any:
        asked.append(frame.stamp_ns)
        return frame.depth > 0

    tracker = make_tracker(RopeConfig(DIAMETER, method="cpd"), mask)
    for frame, _ in swing[:3]:
        assert update(tracker, frame).status is Status.OK
    assert asked == [frame.stamp_ns for frame, _ in swing[:3]]
