"""Slicing: equal to equations 1-10 written out, and blind to where, how and in which order the points come."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers import SMALL, random_rotation, rope_cloud, same_set, seen, straight
from ropetrace.axis import axis_points
from ropetrace.config import default_variance_threshold
from ropetrace.slicing import Slicer
from ropetrace.types import FloatArray, Slices

THRESHOLD = default_variance_threshold(0.012)
seeds = st.integers(0, 2**32 - 1)
quick = settings(max_examples=60, deadline=None)


def cut(points: FloatArray, threshold: float = THRESHOLD, min_points: int | None = 1, max_nodes: int = 4000) -> Slices:
    return Slicer(threshold, min_points, max_nodes).slice(np.array(points, order="C"))


def parts_of(points: FloatArray, threshold: float = THRESHOLD, min_points: int | None = 1) -> list[list[int]]:
    """The indices of each part's points; for clouds without equal points."""
    index = {point.tobytes(): place for place, point in enumerate(np.ascontiguousarray(points.T))}
    rows = np.array(points, order="C")
    slices = Slicer(threshold, min_points, 4000).slice(rows)
    order = [index[point.tobytes()] for point in np.ascontiguousarray(rows.T)]
    assert sorted(order) == list(range(len(order)))
    parts = [order[start : start + count] for start, count in zip(slices.starts, slices.counts, strict=True)]
    for part, centroid, covariance in zip(parts, slices.centroids, slices.covariances, strict=True):
        np.testing.assert_allclose(centroid, points[:, part].mean(axis=1), atol=1e-12)
        expected = np.cov(points[:, part], bias=True) if len(part) > 1 else np.zeros((3, 3))
        np.testing.assert_allclose(covariance, expected, atol=1e-14)
    return parts


def as_sets(parts: list[list[int]]) -> set[frozenset[int]]:
    return {frozenset(part) for part in parts}


def literal(points: FloatArray, threshold: float, min_points: int) -> list[list[int]]:
    """Equations 1-10 as they are printed, for clouds in general position."""
    parts = [list(range(points.shape[1]))]
    traces = [float(np.trace(np.cov(points, bias=True)))]
    while max(traces) > threshold:
        widest = int(np.argmax(traces))
        part = np.array(parts.pop(widest))
        traces.pop(widest)
        cloud = points[:, part]
        offsets = cloud - cloud.mean(axis=1, keepdims=True)
        axis = np.linalg.eigh(np.cov(cloud, bias=True))[1][:, -1]
        side = axis @ offsets >= 0
        for half in (part[side], part[~side]):
            parts.append(half.tolist())
            traces.append(float(np.trace(np.cov(points[:, half], bias=True))) if len(half) > 1 else 0.0)
    return [part for part in parts if len(part) >= min_points]


# --- equal to the paper ---


@quick
@given(seeds, st.integers(2, 900), st.floats(0.2, 8), st.integers(1, 6))
def test_equals_the_equations_written_out(seed: int, count: int, scale: float, min_points: int) -> None:
    points = rope_cloud(np.random.default_rng(seed), count)
    expected = literal(points, THRESHOLD * scale, min_points)
    assert as_sets(parts_of(points, THRESHOLD * scale, min_points)) == as_sets(expected)


@quick
@given(seeds, st.integers(1, 600), st.integers(1, 5))
def test_partition(seed: int, count: int, min_points: int) -> None:
    points = rope_cloud(np.random.default_rng(seed), count)
    everything = parts_of(points)
    assert sorted(index for part in everything for index in part) == list(range(count))
    kept = parts_of(points, min_points=min_points)
    assert as_sets(kept) == {frozenset(part) for part in everything if len(part) >= min_points}
    slices = cut(points)
    assert np.trace(slices.covariances, axis1=1, axis2=2).max(initial=0) <= THRESHOLD * (1 + 1e-6)


def test_a_higher_threshold_makes_no_more_parts() -> None:
    rng = np.random.default_rng(5)
    for _ in range(40):
        points = rope_cloud(rng, 500)
        counts = [len(cut(points, THRESHOLD * factor)) for factor in (0.3, 0.5, 0.8, 1.0, 1.5, 3, 10, 1e4)]
        assert counts == sorted(counts, reverse=True)
        assert counts[-1] == 1


# --- invariances, in general position ---


@quick
@given(seeds, st.integers(2, 800))
def test_general_position_invariances(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    points = rope_cloud(rng, count)
    nodes = cut(points).centroids
    assert same_set(cut(points[:, rng.permutation(count)]).centroids, nodes)
    rotation, shift = random_rotation(rng), rng.uniform(-3, 3, 3)
    assert same_set(cut(rotation @ points + shift[:, None]).centroids, nodes @ rotation.T + shift)
    assert same_set(cut(points * [[-1], [1], [1]]).centroids, nodes * [-1, 1, 1])
    assert same_set(cut(np.repeat(points, 2, axis=1)).centroids, nodes)
    scale = float(rng.uniform(0.01, 100))
    assert same_set(cut(points * scale, THRESHOLD * scale**2).centroids, nodes * scale, 1e-9 * max(scale, 1))


def test_a_repeated_call_gives_the_same_and_nothing_of_a_longer_cloud_before_it() -> None:
    rng = np.random.default_rng(1)
    slicer = Slicer(THRESHOLD, None, 400)
    short = rope_cloud(rng, 300)
    first = slicer.slice(short.copy())
    centroids, counts = first.centroids.copy(), first.counts.copy()
    slicer.slice(rope_cloud(rng, 5000))
    again = slicer.slice(short.copy())
    np.testing.assert_array_equal(again.centroids, centroids)
    np.testing.assert_array_equal(again.counts, counts)


# --- invariances, on grids, where points lie on the cutting planes ---


def image_grid(rng: np.random.Generator) -> FloatArray:
    """A straight or a bent rope on a pixel grid, depth in whole millimetres."""
    if rng.random() < 0.5:
        angle = rng.choice([0, np.pi / 2, np.pi / 4, rng.uniform(0, np.pi)])
        middle = (float(rng.integers(-50, 50)) / 415.7, float(rng.integers(-50, 50)) / 415.7, 1.0)
        curve = straight(middle, (np.cos(angle), np.sin(angle), 0.0), float(rng.uniform(0.05, 0.4)))
    else:
        turn = np.linspace(0, rng.uniform(1, 6), 60)
        curve = np.stack([0.1 * np.cos(turn), 0.1 * np.sin(turn), np.full(60, 1.0)], axis=1)
    depth = np.round(seen(curve, float(rng.uniform(0.004, 0.012))).depth * 1000)
    if rng.random() < 0.4:
        depth[depth > 0] = np.round(rng.uniform(500, 1500))
    rows, columns = np.nonzero(depth)
    z = depth[rows, columns].astype(float) * 0.001
    return np.stack([(columns - SMALL.cx) / SMALL.fx * z, (rows - SMALL.cy) / SMALL.fy * z, z])


def lattice(rng: np.random.Generator) -> FloatArray:
    """An axis-aligned block, plate or line of points, some with equal sides, some sheared along the lattice."""
    sizes = rng.integers(1, [24, 8, 5])
    if rng.random() < 0.3:
        sizes[:] = rng.integers(2, 8)
    rng.shuffle(sizes)
    spacing = rng.choice([0.001, 0.002, 0.005, 0.003], 3) if rng.random() < 0.5 else np.full(3, 0.002)
    index = np.stack(np.meshgrid(*(np.arange(size) for size in sizes), indexing="ij")).reshape(3, -1)
    if rng.random() < 0.3:
        index[1] += index[0]
    if rng.random() < 0.3:
        index[2] -= 2 * index[0]
    if rng.random() < 0.3:
        index = index[:, rng.random(index.shape[1]) < 0.9]
    if rng.random() < 0.3:
        index = np.concatenate([index, index + np.array([[40], [int(rng.integers(-9, 9))], [0]])], axis=1)
    return np.asarray(index * spacing[:, None]).astype(float)


@pytest.mark.parametrize("kind", ["image_grid", "lattice"])
def test_grids_are_cut_alike_wherever_they_lie_and_in_whatever_order(kind: str) -> None:
    make, cases = {"image_grid": (image_grid, 100), "lattice": (lattice, 400)}[kind]
    rng = np.random.default_rng(11)
    for case in range(cases):
        points = make(rng)
        count = points.shape[1]
        if not count:
            continue
        threshold = float(rng.choice([THRESHOLD, THRESHOLD / 4, 4e-6, 1e-7]))
        nodes = cut(points, threshold).centroids
        for _ in range(3):
            shuffled = cut(points[:, rng.permutation(count)], threshold).centroids
            assert same_set(shuffled, nodes), f"{kind} {case}: another order"
            shift = rng.uniform(-5, 5, 3)
            moved = cut(points + shift[:, None], threshold).centroids
            assert same_set(moved, nodes + shift), f"{kind} {case}: another place"


def test_a_square_lattice_in_the_plane_of_a_3_4_5_triangle() -> None:
    """Its normal is (0.8, 0, 0.6) exactly, its two larger variances are equal, and points lie on each cutting plane."""
    rng = np.random.default_rng(9)
    index = np.stack(np.meshgrid(np.arange(5), np.arange(5), indexing="ij")).reshape(2, -1)
    points = 0.005 * np.stack([0.6 * index[0], 1.0 * index[1], -0.8 * index[0]])
    nodes = cut(points).centroids
    for _ in range(100):
        assert same_set(cut(points[:, rng.permutation(25)]).centroids, nodes)
        shift = rng.uniform(-5, 5, 3)
        assert same_set(cut(points + shift[:, None]).centroids, nodes + shift)


def test_equal_axes_are_cut_alike_far_from_the_first_point() -> None:
    """Clusters whose two largest variances differ by a few millionths, and a first point far away."""
    rng = np.random.default_rng(2)
    for case in range(60):
        side = int(rng.choice([5, 7, 9]))
        index = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij")).reshape(2, -1) - side // 2
        stretch = 1 + 10 ** rng.uniform(-5.5, -2)
        cluster = np.stack([index[0] * 0.004 * stretch, index[1] * 0.004, 0 * index[0] + 0.0])
        far = np.array([[float(10 ** rng.uniform(0, 3))], [0.3], [0.7]])
        points = np.concatenate([cluster + far, cluster], axis=1)
        nodes = cut(points, 1e-4).centroids
        for _ in range(4):
            shuffled = cut(points[:, rng.permutation(points.shape[1])], 1e-4).centroids
            assert same_set(shuffled, nodes), f"{case}: {far[0, 0]:.0f} m, stretch {stretch - 1:.1e}"


@pytest.mark.parametrize("distance", [1e3, 1e6, 1e9, 1e15, 1e38])
def test_one_point_far_away_costs_the_others_no_digits(distance: float) -> None:
    points = rope_cloud(np.random.default_rng(4), 800)
    stray = np.array([[distance], [0.0], [1.0]])
    alone = cut(points).centroids
    for cloud in (np.concatenate([stray, points], axis=1), np.concatenate([points, stray], axis=1)):
        slices = cut(cloud, min_points=1)
        near = slices.centroids[np.abs(slices.centroids[:, 0]) < 10]
        # The stray takes part in the first cut, so the parts may differ: none may be lost or merged.
        assert abs(len(near) - len(alone)) <= 4
        assert np.linalg.norm(near - near.mean(axis=0), axis=1).max() > 0.05


# --- whatever comes, it ends ---

SPAN = np.linspace(0, 0.5, 400)
HARD = {
    "none": np.empty((3, 0)),
    "one": np.zeros((3, 1)),
    "two": np.array([[0, 0.1], [0, 0], [1, 1]], float),
    "three": np.array([[0, 0.1, 0.2], [0, 0, 0], [1, 1, 1]], float),
    "coincident": np.ones((3, 500)),
    "nearly coincident": 1 + 1e-16 * np.arange(1500).reshape(3, 500),
    "two places": np.repeat([[0.0, 1.0], [0.0, 1.0], [1.0, 1.0]], 200, axis=1),
    "collinear": np.stack([SPAN, 2 * SPAN, 1 - SPAN]),
    "coplanar": np.stack([np.repeat(SPAN[::20], 20), np.tile(SPAN[::20], 20), np.ones(400)]),
    "huge": np.stack([SPAN, SPAN**2, SPAN**3]) * 1e150,
    "overflowing": np.stack([SPAN, SPAN**2, SPAN**3]) * 1e200,
    "largest": np.array([[1, -1, 1, -1] * 5, [1, 1, -1, -1] * 5, [1, 1, 1, -1] * 5]) * 1.7e308,
    "tiny": np.stack([SPAN, SPAN**2, SPAN**3]) * 1e-170,
    "subnormal": np.stack([SPAN, SPAN**2, SPAN**3]) * 1e-308,
    "one stray": np.concatenate([np.ones((3, 50)), np.array([[1e300], [0], [0]])], axis=1),
}


@pytest.mark.parametrize("threshold", [THRESHOLD, 1e-20, 5e-324])
@pytest.mark.parametrize("name", HARD)
def test_ends_on_every_finite_input(name: str, threshold: float) -> None:
    points = HARD[name]
    for min_points in (None, 1, 3):
        slices = cut(points, threshold, min_points)
        assert slices.counts.sum() <= points.shape[1]
        if min_points == 1:
            assert slices.counts.sum() == points.shape[1]
            assert (slices.counts > 0).all()


def test_coincident_points_make_one_part_under_any_threshold() -> None:
    assert cut(np.ones((3, 500)), 5e-324).counts.tolist() == [500]
    assert sorted(cut(HARD["two places"], 5e-324).counts.tolist()) == [200, 200]


@pytest.mark.parametrize("max_nodes", [4, 5, 17])
def test_the_cap_holds_and_is_told(max_nodes: int) -> None:
    points = rope_cloud(np.random.default_rng(3), 2000)
    capped = cut(points, 1e-6, max_nodes=max_nodes)
    assert (len(capped), capped.capped, int(capped.counts.sum())) == (max_nodes, True, 2000)
    assert not cut(points, 1.0, max_nodes=max_nodes).capped


def test_a_cap_that_is_just_enough_is_no_cap() -> None:
    points = rope_cloud(np.random.default_rng(3), 900)
    enough = len(cut(points))
    assert not cut(points, max_nodes=enough).capped
    assert cut(points, max_nodes=enough - 1).capped


def test_by_default_leftovers_are_dropped_and_the_rope_is_kept() -> None:
    rng = np.random.default_rng(8)
    rope = rope_cloud(rng, 3000)
    strays = rng.uniform(-2, 2, (3, 12))
    kept = [index for part in parts_of(np.concatenate([rope, strays], axis=1), min_points=None) for index in part]
    assert max(kept) < 3000
    assert len(kept) > 2900


# --- from the visible surface to the axis (equation 11) ---


def as_slices(parts: list[FloatArray]) -> tuple[FloatArray, Slices]:
    """Points (3, N) and their slices, from the (3, n) points of each part."""
    counts = np.array([part.shape[1] for part in parts])
    covariances = np.array([np.cov(part, bias=True) for part in parts])
    centroids = np.array([part.mean(axis=1) for part in parts])
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    return np.concatenate(parts, axis=1), Slices(centroids, covariances, counts, False, starts)


def half_tube(half_width: float, radius: float, length: float, turn: float) -> tuple[FloatArray, FloatArray]:
    """Evenly seen points of a straight tube 100 m before the camera, and its tangent; `turn` is about the view."""
    across, along = np.meshgrid(np.linspace(-half_width, half_width, 401), np.linspace(-length / 2, length / 2, 51))
    depth = 100 - np.sqrt(radius**2 - across**2)
    c, s = np.cos(turn), np.sin(turn)
    x, y = c * across - s * along, s * across + c * along
    return np.stack([x.ravel(), y.ravel(), depth.ravel()]), np.array([-s, c, 0.0])


@pytest.mark.parametrize("share", [1.0, 0.8, 0.4])
@pytest.mark.parametrize("turn", [0.0, 0.7, np.pi / 2])
def test_the_axis_lies_below_the_surface_however_much_of_it_is_seen(share: float, turn: float) -> None:
    radius = 0.01
    part, tangent = half_tube(share * radius, radius, 0.02, turn)
    points, slices = as_slices([part, part + 0.02 * tangent[:, None]])
    nodes, _ = axis_points(points, slices, np.stack([tangent] * 2), radius)
    assert abs(nodes[0, 2] - 100) < 0.005 * radius
    np.testing.assert_allclose(nodes[:, :2], slices.centroids[:, :2], atol=1e-6)


def test_a_constant_offset_takes_the_place_of_the_geometry() -> None:
    rng = np.random.default_rng(0)
    points, slices = as_slices([rng.random((3, 9)) for _ in range(5)])
    tangents = np.tile([1.0, 0, 0], (5, 1))
    nodes, _ = axis_points(points, slices, tangents, 0.01, (0.001, -0.002, 0.003))
    np.testing.assert_allclose(nodes, slices.centroids + [0.001, -0.002, 0.003], rtol=0, atol=1e-15)


@pytest.mark.parametrize("tilt", [0.0, 1e-9, 0.01, 0.1])
def test_a_tube_that_points_at_the_camera_moves_its_nodes_by_little_more_than_a_radius(tilt: float) -> None:
    tangent = np.array([np.sin(tilt), 0, np.cos(tilt)])
    heap = np.random.default_rng(0).normal(0, 0.003, (3, 400))
    points, slices = as_slices([heap + [[0], [0], [1.0]], heap + [[0], [0], [1.03]]])
    nodes, _ = axis_points(points, slices, np.stack([tangent] * 2), 0.006)
    assert np.linalg.norm(nodes - slices.centroids, axis=1).max() <= 1.3 * 0.006


@pytest.mark.parametrize("count", [1, 2, 3])
def test_slices_of_hardly_any_points_have_nodes_near_them(count: int) -> None:
    rng = np.random.default_rng(0)
    for heap in (np.zeros((3, count)), rng.normal(0, 0.002, (3, count)), np.outer([0, 0, 1], np.arange(count) * 0.001)):
        points, slices = as_slices(
            [heap + [[0.03 * k], [0], [1]] for k in range(4)]
            if count > 1
            else [np.repeat(heap, 2, axis=1) + [[0.03 * k], [0], [1]] for k in range(4)]
        )
        nodes, _ = axis_points(points, slices, np.tile([1.0, 0, 0], (4, 1)), 0.006)
        assert np.linalg.norm(nodes - slices.centroids, axis=1).max() <= 1.5 * 0.006


def test_a_bend_is_taken_back() -> None:
    """Slices of an arc whose mean lies inside the bend come back to the arc, to the next order."""
    bend, slice_length = 0.1, 0.03
    places = np.arange(0, 0.3, slice_length)
    fine = np.linspace(-slice_length / 2, slice_length / 2, 301)
    parts, tangents = [], []
    for place in places:
        angle = (place + fine) / bend
        parts.append(np.stack([bend * np.cos(angle), bend * np.sin(angle), np.full_like(fine, 5.0)]))
        tangents.append([-np.sin(place / bend), np.cos(place / bend), 0.0])
    points, slices = as_slices(parts)
    nodes, _ = axis_points(points, slices, np.array(tangents), 1e-9)
    before = np.abs(np.linalg.norm(slices.centroids[1:-1, :2], axis=1) - bend).max()
    after = np.abs(np.linalg.norm(nodes[1:-1, :2], axis=1) - bend).max()
    assert before > 3e-4
    assert after < before / 20


@pytest.mark.parametrize("cut_off", [0.25, 0.5, 0.75])
def test_a_profile_with_one_edge_cut_off_is_not_taken_further_off(cut_off: float) -> None:
    """Pixels that fall unlike on the two edges: the node lies no farther from the axis than the centroid did."""
    radius, pixel = 0.0075, 0.0024
    across = np.arange(-radius + cut_off * pixel, radius, pixel)
    grid, along = np.meshgrid(across, np.arange(-0.018, 0.018, pixel))
    depth = 1 - np.sqrt(radius**2 - grid**2)
    part = np.stack([grid.ravel(), along.ravel(), depth.ravel()])
    points, slices = as_slices([part + [[0], [0.036 * k], [0]] for k in (-1, 0, 1)])
    nodes, _ = axis_points(points, slices, np.tile([0.0, 1.0, 0.0], (3, 1)), radius)
    assert abs(nodes[1, 0]) <= abs(slices.centroids[1, 0]) + 1e-5
    assert abs(nodes[1, 2] - 1) < 0.0006
