"""The tracker of Schulman et al.: its steps against plain NumPy, what it follows, and what it survives."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

from helpers import RED_TEXT, SHAPES, seen
from ropetrace.config import RopeConfig
from ropetrace.config_methods import SchulmanConfig
from ropetrace.errors import ConfigError
from ropetrace.evaluation.methods import SWINGING, TUNED, case_tracker
from ropetrace.evaluation.metrics import distances_to_curve, symmetric_mean
from ropetrace.sim.impulse_chain import ImpulseChain
from ropetrace.trackers import make_tracker
from ropetrace.trackers.schulman import SchulmanTracker
from ropetrace.trackers.schulman_em import maximise, responsibilities
from ropetrace.types import BadFrame, CloudFrame, Estimate, FloatArray, RgbdFrame, Status

ROPE = RopeConfig(0.012, RED_TEXT)
SHORT = SchulmanConfig(nodes=30)
SHORT_ROPE = replace(ROPE, schulman=SHORT)
HANGING = SHAPES["hanging"]


def example_sets(features: int, seed: int = 0) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Points, nodes, deviations, visibilities and prior deviations."""
    rng = np.random.default_rng(seed)
    prior = np.array([0.02, 0.02, 0.02, 0.4, 0.08, 0.08])[:features]
    nodes = rng.normal(0, 0.05, (7, features))
    points = np.concatenate([nodes + rng.normal(0, 0.02, nodes.shape), rng.normal(0, 0.3, (4, features))])
    visible = np.ones(7)
    visible[2] = 0.0
    visible[3] = 0.4
    return points, nodes, prior * rng.uniform(0.5, 1.5, nodes.shape), visible, prior


def plain_responsibilities(
    points: FloatArray, nodes: FloatArray, deviations: FloatArray, visible: FloatArray, prior: FloatArray, far: int
) -> FloatArray:
    gaps = (points[None] - nodes[:, None]) / deviations[:, None]
    shares = visible[:, None] * np.exp(-0.5 * np.sum(gaps**2, axis=2)) / np.prod(deviations, axis=1)[:, None]
    outlier = np.exp(-0.5 * len(prior)) / np.prod(prior)
    # The points that are far stand as columns that are the outliers' alone.
    shares = np.hstack([shares, np.zeros((len(nodes), far))])
    shares = np.vstack([shares, np.full(shares.shape[1], outlier)])
    shares /= shares.sum(axis=0)
    for _ in range(2):
        rows = shares.sum(axis=1, keepdims=True)
        shares = np.divide(shares, rows, out=np.zeros_like(shares), where=rows > 0)
        shares[:-1][visible < 1e-3] = 0
        shares /= shares.sum(axis=0)
    return np.asarray(shares[:-1, : len(points)])


@pytest.mark.parametrize(("features", "far"), [(3, 0), (6, 0), (3, 50)])
def test_the_e_step_equals_plain_numpy(features: int, far: int) -> None:
    sets = example_sets(features)
    shares = responsibilities(*sets, far=far)
    assert np.allclose(shares, plain_responsibilities(*sets, far), rtol=1e-10, atol=1e-14)


def test_shares_are_shares() -> None:
    points, nodes, deviations, visible, prior = example_sets(3)
    points[-1] = 100.0
    shares = responsibilities(points, nodes, deviations, visible, prior)
    assert (shares >= 0).all()
    assert (shares.sum(axis=0) <= 1 + 1e-12).all()
    assert (shares[2] == 0).all()  # hidden
    assert (shares[:, -1] == 0).all()  # an outlier beyond doubt


def test_the_m_step_equals_plain_numpy() -> None:
    points, nodes, deviations, visible, prior = example_sets(6)
    shares = responsibilities(points, nodes, deviations, visible, prior)
    pulls = maximise(points, nodes, shares, prior, 10.0, deviations)
    gaps = points[None] - nodes[:, None]
    squares = np.einsum("kn,knf->kf", shares, gaps**2)
    expected = np.sqrt((squares + 10 * prior**2) / (shares.sum(axis=1)[:, None] + 10))
    assert np.allclose(deviations, expected, atol=1e-9)
    assert np.allclose(pulls, np.einsum("kn,knf->kf", shares, gaps[..., :3]), atol=1e-9)


def example_chain(anchored: bool, path: FloatArray) -> ImpulseChain:
    return ImpulseChain(
        path,
        0.006,
        step=0.015,
        linear_damping=0.75,
        angular_damping=1.0,
        stiffness=1e-5,
        limit=0.4,
        gravity=np.zeros(3),
        anchored=anchored,
    )


@pytest.mark.parametrize("anchored", [False, True])
def test_a_chain_lies_on_its_path_and_keeps_its_length(anchored: bool) -> None:
    turn = np.linspace(0, 1.5, 21)
    path = 0.3 * np.stack([np.sin(turn), 1 - np.cos(turn), 0.2 * turn], axis=1)
    chain = example_chain(anchored, path)
    assert np.allclose(chain.path, path, atol=1e-6)
    assert np.allclose(chain.centres, (path[1:] + path[:-1]) / 2, atol=1e-6)
    rng = np.random.default_rng(0)
    for _ in range(20):
        assert chain.push(rng.normal(0, 0.05, (20, 3)), 2)
    steps = np.linalg.norm(np.diff(chain.path, axis=0), axis=1)
    assert np.allclose(steps, chain.link_length, rtol=1e-9)
    assert np.allclose(chain.path[0], path[0]) == anchored


def test_an_impulse_on_all_links_moves_the_whole_chain() -> None:
    chain = example_chain(False, np.linspace([0, 0, 1], [0, 0.5, 1], 21).astype(float))
    assert chain.push(np.tile([0.1, 0, 0], (20, 1)), 1)
    assert np.allclose(chain.velocities, [0.1, 0, 0], atol=1e-6)
    # Each second leaves a quarter of the velocity.
    assert chain.push(np.zeros((20, 3)), round(1 / 0.015))
    assert np.allclose(chain.velocities, [0.025, 0, 0], atol=0.002)


def test_a_chain_that_is_torn_says_so() -> None:
    chain = example_chain(False, np.linspace([0, 0, 1], [0, 0.5, 1], 21).astype(float))
    assert not chain.push(np.full((20, 3), np.nan), 2)


def swing(frames: int, speed: float = 0.3, curve: FloatArray = HANGING) -> list[tuple[RgbdFrame, FloatArray]]:
    """A rope that goes to and fro across the view, at 30 Hz, m/s at most."""
    shapes = [curve + [speed / 3 * np.sin(3 * index / 30), 0, 0] for index in range(frames)]
    return [(seen(shape, stamp_ns=round(index / 30 * 1e9)), shape) for index, shape in enumerate(shapes)]


def test_it_settles_on_a_rope_at_rest() -> None:
    tracker = SchulmanTracker(SHORT_ROPE, nodes=HANGING[::200] + [0.02, 0.01, 0.01])
    frame = seen(HANGING)
    for index in range(40):
        estimate = tracker.update(RgbdFrame(index, frame.depth, 1.0, frame.intrinsics, frame.color))
    assert estimate.status is Status.OK, estimate.reasons
    assert symmetric_mean(estimate.waypoints.positions, HANGING) < 0.003
    cloud = tracker.cloud()
    assert len(cloud.points) == estimate.point_count
    assert set(cloud.node) == set(range(29))


@pytest.mark.parametrize("settings", [SHORT, SWINGING])
def test_it_follows_a_slow_swing(settings: SchulmanConfig) -> None:
    tracker = SchulmanTracker(replace(ROPE, schulman=replace(settings, anchored=False)))
    errors = []
    for frame, curve in swing(45):
        estimate = tracker.update(frame)
        assert estimate.status is Status.OK, estimate.reasons
        assert len(estimate.nodes) == settings.nodes - 1
        errors.append(distances_to_curve(estimate.nodes, curve).mean())
    assert np.mean(errors[5:]) < 0.005


def test_colour_and_clouds_are_taken_as_they_come() -> None:
    frame, curve = swing(1)[0]
    rows, columns = np.nonzero(frame.depth)
    z = frame.depth[rows, columns].astype(float)
    lens = frame.intrinsics
    points = np.stack([(columns - lens.cx) / lens.fx * z, (rows - lens.cy) / lens.fy * z, z], axis=1)
    assert frame.color is not None
    colors = frame.color[rows, columns]
    points[3] = np.nan
    lines = []
    for colored in (colors, None):
        tracker = SchulmanTracker(SHORT_ROPE if colored is not None else replace(SHORT_ROPE, color=None))
        for index in range(3):
            estimate = tracker.update(CloudFrame(index, points, colored))
        assert symmetric_mean(estimate.waypoints.positions, curve) < 0.003
        lines.append(estimate.nodes)
    assert not np.array_equal(lines[0], lines[1])


def test_the_same_frames_give_the_same_bytes_and_reset_forgets() -> None:
    frames = [frame for frame, _ in swing(6)]
    tracker = SchulmanTracker(SHORT_ROPE)
    first = [tracker.update(frame).nodes for frame in frames]
    tracker.reset()
    again = [tracker.update(frame).nodes for frame in frames]
    other = [SchulmanTracker(SHORT_ROPE).update(frame).nodes for frame in frames[:1]]
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert np.array_equal(first[0], other[0])


def test_the_budget_is_kept() -> None:
    """By a clock that goes on by 4 ms whenever it is asked: 1 + n askings for n iterations."""
    ticks = itertools.count()
    settings = replace(SHORT, budget=0.030)
    timed = SchulmanTracker(replace(ROPE, schulman=settings), clock=lambda: 0.004 * next(ticks))
    counted = SchulmanTracker(replace(ROPE, schulman=replace(SHORT, iterations=6)))
    frame = swing(1)[0][0]
    before = next(ticks)
    estimate = timed.update(frame)
    # After iteration n, 4 n ms are gone, and the next takes 4 ms: 24 + 4 <= 30 goes on, 28 + 4 > 30 does not.
    assert next(ticks) - before - 1 == 1 + 7
    six = counted.update(frame)
    assert not np.array_equal(estimate.nodes, six.nodes)
    seven = SchulmanTracker(replace(ROPE, schulman=replace(SHORT, iterations=7))).update(frame)
    assert np.array_equal(estimate.nodes, seven.nodes)
    before = next(ticks)
    SchulmanTracker(SHORT_ROPE, clock=lambda: next(ticks)).update(frame)
    assert next(ticks) == before + 1


def test_a_rope_that_leaps_is_lost_and_found_again() -> None:
    tracker = SchulmanTracker(SHORT_ROPE)
    for frame, _ in swing(3):
        assert tracker.update(frame).status is Status.OK
    away = HANGING + [0.35, 0.0, 0.1]
    frames = [seen(away, stamp_ns=round((index + 3) / 30 * 1e9)) for index in range(8)]
    estimates = [tracker.update(frame) for frame in frames]
    assert [estimate.status is Status.LOST for estimate in estimates[:4]] == [True] * 3 + [False]
    assert all(not len(estimate.nodes) for estimate in estimates[:3])
    assert symmetric_mean(estimates[-1].waypoints.positions, away) < 0.004


def test_after_an_absence_it_goes_on() -> None:
    tracker = SchulmanTracker(SHORT_ROPE)
    frames = [frame for frame, _ in swing(12)]
    for frame in frames[:3]:
        start = tracker.update(frame).waypoints.positions[0]
    for frame in frames[3:8]:
        empty = RgbdFrame(frame.stamp_ns, np.zeros_like(frame.depth), 1.0, frame.intrinsics, frame.color)
        estimate = tracker.update(empty)
        assert estimate.status is Status.LOST
        assert "no points" in estimate.reasons[0]
    for frame in frames[8:]:
        estimate = tracker.update(frame)
        assert estimate.status is not Status.LOST
    assert np.linalg.norm(estimate.waypoints.positions[0] - start) < 0.1


def test_a_hidden_part_is_told() -> None:
    tracker = SchulmanTracker(SHORT_ROPE)
    for frame, _ in swing(5):
        tracker.update(frame)
    depth = frame.depth.copy()
    rows = np.flatnonzero(depth.any(axis=1))
    depth[rows[0] : rows[0] + len(rows) // 3] = 0
    statuses = [
        tracker.update(RgbdFrame(frame.stamp_ns + index + 1, depth, 1.0, frame.intrinsics, frame.color)).status
        for index in range(5)
    ]
    assert Status.OK not in statuses


def bad_frames() -> dict[str, CloudFrame]:
    rng = np.random.default_rng(0)
    return {
        "empty": CloudFrame(0, np.empty((0, 3))),
        "one point": CloudFrame(0, np.ones((1, 3))),
        "nan": CloudFrame(0, np.full((500, 3), np.nan)),
        "all alike": CloudFrame(0, np.tile([0.1, 0.1, 1.0], (500, 1))),
        "at the camera": CloudFrame(0, np.zeros((500, 3))),
        "huge": CloudFrame(0, rng.normal(0, 1e12, (500, 3))),
        "a wall": CloudFrame(0, np.stack([*rng.uniform(-1, 1, (2, 300_000)), np.ones(300_000)], axis=1)),
        "a fog": CloudFrame(0, rng.uniform([-1, -1, 0.5], [1, 1, 2], (300_000, 3))),
    }


@pytest.mark.parametrize("name", bad_frames())
def test_bad_clouds_raise_nothing(name: str) -> None:
    config = replace(SHORT_ROPE, color=None)
    frame = bad_frames()[name]
    depth = swing(1)[0][0]
    rope = RgbdFrame(0, depth.depth, 1.0, depth.intrinsics)

    def checked(estimate: Estimate) -> Estimate:
        assert np.isfinite(estimate.waypoints.positions).all()
        assert (estimate.status is Status.LOST) == (not len(estimate.nodes))
        return estimate

    first = SchulmanTracker(config)
    for index in range(2):
        estimate = checked(first.update(replace(frame, stamp_ns=index)))
        assert estimate.status is not Status.OK
    first.cloud()

    later = SchulmanTracker(config)
    assert checked(later.update(rope)).status is Status.OK
    for index in range(4):
        assert checked(later.update(replace(frame, stamp_ns=index + 1))).status is not Status.OK
    assert later.update(BadFrame(5, "torn")).reasons == ("torn",)
    assert len(later.cloud().points) == 0
    for index in range(60):
        estimate = checked(later.update(replace(rope, stamp_ns=10 + index)))
        if estimate.status is Status.OK:
            break
    assert symmetric_mean(estimate.waypoints.positions, HANGING) < 0.005


def test_its_settings_have_a_table(tmp_path: Path) -> None:
    path = tmp_path / "rope.toml"
    path.write_text(
        'diameter = "12mm"\nmethod = "schulman"\n'
        '[schulman]\nnodes = 30\nvoxel = "1cm"\nbudget = 0.03\nanchored = true\n'
    )
    config = RopeConfig.from_toml(path)
    assert config.schulman == SchulmanConfig(nodes=30, voxel=0.01, budget=0.03, anchored=True)
    path.write_text(config.to_toml())
    assert RopeConfig.from_toml(path) == config
    tracker = make_tracker(config)
    for frame, _ in swing(2):
        assert len(tracker.update(frame).nodes) == 29
    path.write_text("diameter = 0.012\n[schulman]\nnode = 30\n")
    with pytest.raises(ConfigError, match=r"unknown setting schulman\.node: did you mean schulman\.nodes\?"):
        RopeConfig.from_toml(path)
    assert "[schulman]" not in RopeConfig(0.012, method="cpd").to_toml()


def test_the_tuned_preset_is_told_whether_the_rope_hangs() -> None:
    for anchored in (True, False):
        tracker = case_tracker(TUNED, replace(ROPE, method="cpd"), anchored)
        assert isinstance(tracker, SchulmanTracker)
        assert tracker.settings == replace(SWINGING, anchored=anchored)


def test_settings_that_are_impossible_are_refused() -> None:
    for change in ({"nodes": 2}, {"iterations": 0}, {"budget": 0.0}, {"gain": 0.0}, {"damping": 1.5}):
        with pytest.raises(ConfigError, match=f"schulman.{next(iter(change))} = "):
            SchulmanConfig(**change)  # type: ignore[arg-type]
    for nodes in (np.zeros((5, 3)), np.full((5, 3), np.nan), np.zeros((5, 2))):
        with pytest.raises(ConfigError, match="nodes"):
            SchulmanTracker(ROPE, nodes=nodes)
