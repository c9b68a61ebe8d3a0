"""What the registering trackers share, each kernel beside a plain twin."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.ndimage import distance_transform_edt
from scipy.optimize import minimize

from ropetrace.evaluation.metrics import distances_to_curve
from ropetrace.trackers.clouds import (
    arc_lengths,
    distances_to_chain,
    evenly_along,
    nearest_distances,
    nearest_nodes,
    voxel_grid,
    walk,
)
from ropetrace.trackers.constraints import close_strands, nearest_feasible
from ropetrace.trackers.embedding import RIDGE, linear_alignment, linear_weights, modified_alignment
from ropetrace.trackers.kernels import gaussian_kernel, geodesic_kernel
from ropetrace.trackers.registration import (
    RegistrationError,
    expect,
    first_variance,
    register,
    solve,
)
from ropetrace.trackers.trackdlo import bridged, laid_along
from ropetrace.trackers.visibility import depth_behind, hidden_by_chain, off_mask
from ropetrace.types import FloatArray, Intrinsics, RgbdFrame

CAMERA = Intrinsics(80, 60, 70.0, 70.0, 39.5, 29.5)


def chain(count: int = 20, seed: int = 0) -> FloatArray:
    """A smooth chain a metre away, (count, 3), metres."""
    s = np.linspace(0, 1, count)
    a, b, c = np.random.default_rng(seed).uniform(0.02, 0.08, 3)
    return np.stack([a * np.sin(4 * s), 0.4 * s - 0.2, 1 + b * np.cos(3 * s) + c * s**3], axis=1)


def cloud(count: int, seed: int = 0) -> FloatArray:
    rng = np.random.default_rng(seed)
    return chain()[rng.integers(0, 20, count)] + rng.normal(0, 0.01, (count, 3))


# --- expectation and the solution of its equations ---


def plain_expect(
    points: FloatArray,
    weights: FloatArray,
    nodes: FloatArray,
    variance: float,
    outside: float,
    factors: FloatArray,
    arc: FloatArray,
) -> FloatArray:
    """The responsibilities, (M, N)."""
    distances = np.linalg.norm(points[None] - nodes[:, None], axis=2)
    if len(arc):
        for n, column in enumerate(distances.T.copy()):
            best = int(np.argmin(column))
            beside = [m for m in (best - 1, best + 1) if 0 <= m < len(nodes)]
            other = min(beside, key=lambda m: column[m])
            low, high = min(best, other), max(best, other)
            for m in range(len(nodes)):
                if m < low:
                    distances[m, n] = arc[low] - arc[m] + column[low]
                elif m > high:
                    distances[m, n] = arc[m] - arc[high] + column[high]
    shares = factors[:, None] * np.exp(-(distances**2) / (2 * variance))
    return np.asarray(weights * shares / (shares.sum(axis=0) + outside))


@pytest.mark.parametrize("along", [False, True])
@pytest.mark.parametrize("variance", [1e-1, 1e-3, 4e-5])
def test_expectation_equals_its_twin(along: bool, variance: float) -> None:
    rng = np.random.default_rng(1)
    points, nodes = cloud(300), chain()
    weights, factors = rng.uniform(0.2, 2, 300), rng.uniform(0.1, 1, 20)
    arc = arc_lengths(nodes) if along else np.empty(0)
    sums, moments = np.empty(20), np.empty((20, 3))
    total, spread = expect(points, weights, nodes, variance, 0.01, factors, arc, sums, moments)
    shares = plain_expect(points, weights, nodes, variance, 0.01, factors, arc)
    np.testing.assert_allclose(sums, shares.sum(axis=1), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(moments, shares @ points, rtol=1e-9, atol=1e-12)
    assert total == pytest.approx(shares.sum())
    assert spread == pytest.approx(np.sum(shares.sum(axis=0) * np.sum(points**2, axis=1)))


def test_far_points_belong_to_the_nearest_node_unless_there_are_outliers() -> None:
    far = np.array([[0.0, 50.0, 1.0]])
    sums, moments = np.empty(20), np.empty((20, 3))
    none = np.empty(0)
    total, _ = expect(far, np.ones(1), chain(), 1e-6, 0.0, np.ones(20), none, sums, moments)
    assert total == pytest.approx(1)
    assert sums[-1] == pytest.approx(1)
    total, _ = expect(far, np.ones(1), chain(), 1e-6, 1e-9, np.ones(20), none, sums, moments)
    assert total == 0


def test_solve_equals_lapack() -> None:
    rng = np.random.default_rng(0)
    for count in (1, 2, 45):
        matrix, right = rng.normal(size=(count, count)), rng.normal(size=(count, 3))
        expected = np.linalg.solve(matrix, right)
        assert solve(matrix.copy(), right)
        np.testing.assert_allclose(right, expected, rtol=1e-6, atol=1e-9)
    assert not solve(np.zeros((3, 3)), np.ones((3, 3)))
    assert not solve(np.full((3, 3), np.nan), np.ones((3, 3)))


def test_kernels() -> None:
    nodes = chain()
    arc = arc_lengths(nodes)
    gauss, geodesic = gaussian_kernel(nodes, 0.3), geodesic_kernel(arc, 0.3)
    for i, j in ((0, 0), (3, 11), (19, 2)):
        d = np.linalg.norm(nodes[i] - nodes[j])
        assert gauss[i, j] == pytest.approx(np.exp(-(d**2) / (2 * 0.3**2)))
        along = sum(np.linalg.norm(nodes[k + 1] - nodes[k]) for k in range(min(i, j), max(i, j)))
        expected = np.exp(-np.sqrt(2) * along / 0.3) * (np.sqrt(2) * 0.3 + 2 * along) / (4 * 0.3**2)
        assert geodesic[i, j] == pytest.approx(expected)
    assert np.linalg.eigvalsh(geodesic).min() > 0


def test_the_first_variance_is_the_mean_squared_distance_over_three() -> None:
    points, nodes = cloud(50), chain()
    expected = np.mean(np.sum((points[:, None] - nodes[None]) ** 2, axis=2)) / 3
    assert first_variance(points, np.ones(50), nodes) == pytest.approx(expected)


def test_registration_recovers_a_bend() -> None:
    nodes = chain(30)
    bent = nodes + np.stack([0.03 * np.sin(6 * nodes[:, 1]), 0 * nodes[:, 1], 0.02 * nodes[:, 1]], axis=1)
    dense = evenly_along(bent, 600)
    fit = register(
        dense, np.ones(600), nodes, first_variance(dense, np.ones(600), nodes), gaussian_kernel(nodes, 0.2),
        smoothness=1.0, outliers=0.1, max_iterations=150, tolerance=1e-5,
    )  # fmt: skip
    assert distances_to_curve(fit.nodes, bent).max() < 0.001
    assert fit.step < 1e-5


def test_registration_without_a_point_in_reach_is_refused() -> None:
    nodes = chain()
    with pytest.raises(RegistrationError, match="no point belongs"):
        register(
            np.array([[0.0, 90.0, 1.0], [0.0, 91.0, 1.0]]), np.ones(2), nodes, 1e-6, gaussian_kernel(nodes, 0.2),
            smoothness=1.0, outliers=0.1, max_iterations=5, tolerance=1e-5,
        )  # fmt: skip


# --- embeddings ---


def neighborhood(i: int, count: int, reach: int) -> list[int]:
    return [j for j in range(max(i - reach, 0), min(i + reach, count - 1) + 1) if j != i]


def plain_weights(nodes: FloatArray, i: int, others: list[int]) -> FloatArray:
    offsets = nodes[others] - nodes[i]
    gram = offsets @ offsets.T
    weights = np.linalg.solve(gram + RIDGE * np.trace(gram) * np.eye(len(others)), np.ones(len(others)))
    return np.asarray(weights / weights.sum())


@pytest.mark.parametrize("neighbors", [2, 6, 8])
def test_linear_weights_equal_their_twin(neighbors: int) -> None:
    nodes = chain()
    weights = linear_weights(nodes, neighbors)
    expected = np.zeros((20, 20))
    for i in range(20):
        others = neighborhood(i, 20, neighbors // 2)
        expected[i, others] = plain_weights(nodes, i, others)
    np.testing.assert_allclose(weights, expected, atol=1e-9)
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-12)
    residual = np.eye(20) - weights
    np.testing.assert_allclose(linear_alignment(nodes, neighbors), residual.T @ residual, atol=1e-12)


def test_embeddings_reproduce_affine_maps() -> None:
    """As far as they reproduce the nodes themselves: but for the ridge, exactly."""
    rng = np.random.default_rng(0)
    nodes = chain(30)
    mapped = nodes @ rng.normal(size=(3, 3)) + rng.normal(size=3)
    bent = nodes + 0.05 * np.sin(40 * nodes[:, [1]]) * [1, 0, 1]
    weights = linear_weights(nodes, 6)
    linear = np.linalg.lstsq(nodes[1:] - nodes[0], mapped[1:] - mapped[0])[0]
    np.testing.assert_allclose(mapped - weights @ mapped, (nodes - weights @ nodes) @ linear, atol=1e-9)
    assert np.linalg.norm(nodes - weights @ nodes, axis=1)[3:-3].max() < 0.05 * arc_lengths(nodes)[1]
    for alignment in (linear_alignment(nodes, 6), modified_alignment(nodes, 20)):
        assert np.linalg.eigvalsh(alignment).min() > -1e-9
        np.testing.assert_allclose(alignment @ np.ones(30), 0, atol=1e-9)
        assert np.trace(mapped.T @ alignment @ mapped) < 0.02 * np.trace(bent.T @ alignment @ bent)


@pytest.mark.parametrize("neighbors", [10, 20])
def test_the_modified_alignment_equals_that_of_explicit_weight_vectors(neighbors: int) -> None:
    nodes = chain(30) + np.random.default_rng(0).normal(0, 0.02, (30, 3))
    expected = np.zeros((30, 30))
    for i in range(30):
        others = neighborhood(i, 30, neighbors // 2)
        basis = null_space((nodes[others] - nodes[i]).T)
        several = basis.shape[1]
        assert several == len(others) - 3
        ones = basis.T @ np.ones(len(others))
        share = np.linalg.norm(ones) / np.sqrt(several)
        turn = share * np.ones(several) - ones
        house = np.eye(several) - (2 * np.outer(turn, turn) / (turn @ turn) if turn @ turn > 1e-20 else 0)
        columns = (1 - share) * np.outer(plain_weights(nodes, i, others), np.ones(several)) + basis @ house
        np.testing.assert_allclose(columns.sum(axis=0), 1, atol=1e-9)
        whole = np.concatenate([-np.ones((1, several)), columns])
        expected[np.ix_([i, *others], [i, *others])] += whole @ whole.T
    np.testing.assert_allclose(modified_alignment(nodes, neighbors), expected, atol=1e-6)


def test_a_straight_chain_is_no_difficulty() -> None:
    straight = np.linspace(0, 1, 20)[:, None] * [0.0, 1.0, 0.0] + [0, 0, 1.0]
    for alignment in (linear_alignment(straight, 6), modified_alignment(straight, 10)):
        assert np.isfinite(alignment).all()
        np.testing.assert_allclose(alignment @ np.ones(20), 0, atol=1e-9)
    assert np.isfinite(modified_alignment(np.ones((20, 3)), 6)).all()


# --- clouds and chains ---


@pytest.mark.parametrize("edge", [0.003, 0.02, 5.0])
def test_the_voxel_grid_equals_its_twin(edge: float) -> None:
    points = cloud(1000) - [0.0, 0.0, 1.0]
    cells: dict[tuple[int, ...], list[FloatArray]] = {}
    for point in points:
        cells.setdefault(tuple(int(v) for v in np.floor(point / edge)), []).append(point)
    keys = sorted(cells)
    centroids, weights = voxel_grid(points.T.copy(), edge)
    np.testing.assert_allclose(centroids, [np.mean(cells[key], axis=0) for key in keys], atol=1e-12)
    counts = np.array([len(cells[key]) for key in keys])
    np.testing.assert_allclose(weights, counts / counts.mean())
    shuffled, _ = voxel_grid(points[::-1].T.copy(), edge)
    np.testing.assert_allclose(shuffled, centroids, atol=1e-12)


def test_the_voxel_grid_leaves_out_what_is_no_place() -> None:
    points = np.array([[0.0, np.nan, 1e300, np.inf], [0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0]])
    np.testing.assert_array_equal(voxel_grid(points, 0.01)[0], [[0, 0, 1]])
    assert len(voxel_grid(np.empty((3, 0)), 0.01)[0]) == 0


def test_distances_equal_their_twins() -> None:
    points, nodes = cloud(100), chain()
    apart = np.linalg.norm(points[:, None] - nodes[None], axis=2)
    np.testing.assert_allclose(nearest_distances(nodes, points), apart.min(axis=0), atol=1e-12)
    np.testing.assert_array_equal(nearest_nodes(points, nodes), apart.argmin(axis=1))
    np.testing.assert_allclose(distances_to_chain(points, nodes), distances_to_curve(points, nodes), atol=1e-12)


def test_places_at_equal_arc_length() -> None:
    nodes = chain()
    even = evenly_along(nodes, 200)
    np.testing.assert_array_equal(even[[0, -1]], nodes[[0, -1]])
    steps = np.linalg.norm(np.diff(even, axis=0), axis=1)
    assert steps == pytest.approx(arc_lengths(nodes)[-1] / 199, rel=0.01)


def test_a_walk_keeps_its_strides_and_stays_on_the_polyline() -> None:
    line = chain(60)
    strides = np.random.default_rng(0).uniform(0.01, 0.04, 40)
    places = walk(line, strides)
    assert 2 < len(places) < 41
    np.testing.assert_allclose(np.linalg.norm(np.diff(places, axis=0), axis=1), strides[: len(places) - 1], rtol=1e-9)
    assert distances_to_curve(places, line).max() < 1e-12
    assert np.linalg.norm(places[-1] - line[-1]) < strides[len(places) - 1]
    np.testing.assert_array_equal(walk(line[:1], strides), line[:1])


# --- visibility ---


def test_a_strand_hides_the_one_behind_it() -> None:
    s = np.linspace(-0.2, 0.2, 41)
    near = np.stack([s, 0 * s, np.full(41, 0.8)], axis=1)
    bridge = np.array([[0.3, -0.1, 0.9], [0.3, -0.3, 1.0], [0.0, -0.3, 1.0]])
    far = np.stack([0 * s, s, np.full(41, 1.0)], axis=1)
    nodes = np.concatenate([near, bridge, far])
    hidden = hidden_by_chain(nodes, 0.03)
    expected = np.concatenate([np.zeros(44, bool), np.abs(far[:, 1]) / 1.0 * 0.8 < 0.015])
    np.testing.assert_array_equal(hidden, expected)
    assert not hidden_by_chain(chain(), 0.03).any()


def test_depth_behind_the_measured_surface() -> None:
    depth = np.full((60, 80), 1.0, np.float32)
    depth[:, 40:] = 0
    frame = RgbdFrame(0, depth, 1.0, CAMERA)
    nodes = np.array([[-0.2, 0, 1.1], [-0.2, 0, 0.9], [0.2, 0, 1.1], [9.0, 0, 1.0], [0.0, 0.0, -1.0]])
    np.testing.assert_allclose(depth_behind(nodes, frame), [0.1, 0, 0.02, 0.02, 0.02], atol=1e-6)


def test_the_distance_to_the_mask_is_that_of_a_distance_transform() -> None:
    points = np.array([[x, y, 1.0] for x in np.arange(-0.1, 0.1, 0.01) for y in (-0.01, 0.0, 0.01)])
    columns, rows = np.round(70 * points[:, 0] + 39.5).astype(int), np.round(70 * points[:, 1] + 29.5).astype(int)
    mask = np.zeros((60, 80), bool)
    mask[rows, columns] = True
    distances = distance_transform_edt(~mask)
    nodes = np.array([[0.0, 0.0, 1.0], [0.2, 0.1, 1.0], [-0.3, -0.2, 1.0], [0.05, 0.3, 1.0]])
    at = np.round(70 * nodes[:, :2] + [39.5, 29.5]).astype(int)
    expected = distances[at[:, 1], at[:, 0]] / distances.max()
    np.testing.assert_allclose(off_mask(nodes, points, CAMERA), expected, atol=1e-9)


def test_short_gaps_are_bridged() -> None:
    seen = np.array([1, 1, 0, 0, 1, 0, 0, 0, 0, 1, 0], bool)
    arc = np.linspace(0, 0.2, 11)
    expected = np.array([1, 1, 1, 1, 1, 0, 0, 0, 0, 1, 0], bool)
    np.testing.assert_array_equal(bridged(seen, arc, 0.0601), expected)


@pytest.mark.parametrize(
    ("visible", "expected"),
    [
        (range(10), range(10)),
        ([0, 1, 2, 3], [0, 1, 2, 3]),
        ([6, 7, 8, 9], [6, 7, 8, 9]),
        ([0, 1, 2, 7, 8, 9], [0, 1, 2, 7, 8, 9]),
        ([3, 4, 5, 6], [3, 4, 5, 6]),
        ([2, 3, 4, 6, 7], [2, 3, 4]),
    ],
)
def test_nodes_are_laid_from_the_ends_that_are_seen(visible: list[int], expected: list[int]) -> None:
    nodes = np.stack([0 * np.arange(10.0), 0.02 * np.arange(10.0), np.ones(10)], axis=1)
    indices = np.array(visible)
    moved = np.abs(indices - 3.0)
    places, laid = laid_along(nodes[indices], indices, np.full(9, 0.02 * (1 - 1e-9)), moved)
    np.testing.assert_array_equal(np.flatnonzero(laid), expected)
    np.testing.assert_allclose(places[laid], nodes[laid], atol=1e-7)


# --- constraints ---


def test_the_nearest_feasible_chain_is_that_of_a_general_solver() -> None:
    rng = np.random.default_rng(0)
    for _ in range(3):
        wanted = np.cumsum(rng.normal(0, 0.02, (6, 3)), axis=0)
        found = nearest_feasible(wanted, 0.02)
        steps = np.linalg.norm(np.diff(found, axis=0), axis=1)
        assert steps.max() <= 0.02 + 1e-5

        def slack(y: FloatArray) -> FloatArray:
            return np.asarray(1 - np.sum(np.diff(y.reshape(6, 3), axis=0) ** 2, axis=1) / 0.02**2)

        best = minimize(
            lambda y, wanted=wanted: 1e4 * np.sum((y - wanted.ravel()) ** 2),
            np.tile(wanted.mean(axis=0), 6),
            method="SLSQP",
            constraints={"type": "ineq", "fun": slack},
            options={"ftol": 1e-12, "maxiter": 500},
        )
        np.testing.assert_allclose(found, best.x.reshape(6, 3), atol=2e-4)
    nodes = chain()
    np.testing.assert_array_equal(nearest_feasible(nodes, 1.0), nodes)


def test_strands_do_not_pass_through_each_other() -> None:
    """A hairpin whose legs are told to change sides."""
    leg = np.linspace(0, 0.2, 14)
    turn = np.linspace(0, np.pi, 6)[1:-1]
    x = np.concatenate([np.full(14, -0.008), -0.008 * np.cos(turn), np.full(14, 0.008)])
    y = np.concatenate([leg, 0.2 + 0.008 * np.sin(turn), leg[::-1]])
    nodes = np.stack([x, y, np.ones_like(x)], axis=1)
    strands = close_strands(nodes, 0.02)
    assert len(strands.edges) > 5
    np.testing.assert_allclose(strands.directions[0], [1, 0, 0], atol=1e-9)
    gaps = strands.edges[:, 1] - strands.edges[:, 0]
    assert gaps.min() >= 2
    crossed = nodes * [-1, 1, 1]
    found = nearest_feasible(crossed, 0.05, strands, 0.01)
    for (i, j), (s, t), v in zip(strands.edges, strands.places, strands.directions, strict=True):
        apart = (1 - t) * found[j] + t * found[j + 1] - (1 - s) * found[i] - s * found[i + 1]
        assert apart @ v >= 0.01 - 1e-5
    assert len(close_strands(chain(), 0.02).edges) == 0
