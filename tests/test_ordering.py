"""The order of the nodes: found on every shape, from nodes in any order, and kept from frame to frame."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from helpers import SHAPES, at_equal_length
from ropetrace.ordering import NodeGraph, end_scores, order_greedy, order_path, runs_backwards
from ropetrace.types import FloatArray

RADIUS = 0.006
SPACING = 0.03


def nodes_along(
    curve: FloatArray, rng: np.random.Generator, noise: float = 0.0, spacing: float = SPACING
) -> tuple[FloatArray, FloatArray]:
    """Centroids and covariances of even slices of a tube, in order, with a random phase."""
    length = float(np.linalg.norm(np.diff(curve, axis=0), axis=1).sum())
    count = int(length / spacing * rng.uniform(0.9, 1.1))
    fine = at_equal_length(curve, 8 * count + 1)
    centroids = fine[4::8] + rng.normal(0, noise, (count, 3))
    tangents = fine[8::8] - fine[:-8:8]
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    along = tangents[:, :, None] * tangents[:, None, :]
    covariances = along * (length / count) ** 2 / 12 + (np.eye(3) - along) * RADIUS**2 / 4
    return centroids, covariances


def is_in_order(order: NDArray[np.int64], shuffle: NDArray[np.int64]) -> bool:
    found = shuffle[order]
    right = np.arange(len(shuffle))
    return bool((found == right).all() or (found == right[::-1]).all())


def share_in_order(name: str, noise: float, cases: int = 60) -> float:
    rng = np.random.default_rng(17)
    good = 0
    for _ in range(cases):
        centroids, covariances = nodes_along(SHAPES[name], rng, noise)
        shuffle = rng.permutation(len(centroids))
        order = order_path(NodeGraph.of(centroids[shuffle], covariances[shuffle]))
        assert sorted(order) == list(range(len(centroids)))
        good += is_in_order(order, shuffle)
    return good / cases


@pytest.mark.parametrize("name", SHAPES)
def test_every_shape_is_ordered(name: str) -> None:
    assert share_in_order(name, 0.0) == 1.0


@pytest.mark.parametrize("name", SHAPES)
def test_every_shape_is_ordered_under_noise(name: str) -> None:
    assert share_in_order(name, 0.002) == 1.0


@pytest.mark.parametrize("name", SHAPES)
def test_the_order_of_the_input_does_not_matter(name: str) -> None:
    rng = np.random.default_rng(3)
    centroids, covariances = nodes_along(SHAPES[name], rng, 0.004)
    first = order_path(NodeGraph.of(centroids, covariances))
    for _ in range(20):
        shuffle = rng.permutation(len(centroids))
        again = shuffle[order_path(NodeGraph.of(centroids[shuffle], covariances[shuffle]))]
        assert (again == first).all() or (again == first[::-1]).all()


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_few_nodes(count: int) -> None:
    centroids = np.array([[0.0, 0, 1], [0.03, 0, 1], [0.06, 0, 1], [0.09, 0.001, 1]])[[2, 0, 3, 1][:count]]
    order = order_path(NodeGraph.of(centroids, np.tile(np.eye(3) * 1e-5, (count, 1, 1))))
    x = centroids[order, 0]
    assert sorted(order) == list(range(count))
    assert (np.diff(x) > 0).all() or (np.diff(x) < 0).all()


def test_coincident_nodes_are_ordered_somehow() -> None:
    centroids = np.zeros((12, 3))
    assert sorted(order_path(NodeGraph.of(centroids, np.zeros((12, 3, 3))))) == list(range(12))
    assert sorted(order_greedy(centroids, 5)) == list(range(12))


# --- the graph ---


def test_graph_equals_its_twin() -> None:
    rng = np.random.default_rng(2)
    centroids, covariances = nodes_along(SHAPES["s"], rng, 0.003)
    graph = NodeGraph.of(centroids, covariances)
    steps = centroids[None] - centroids[:, None]
    sizes = np.linalg.norm(steps, axis=2)
    np.fill_diagonal(sizes, 1)
    units = steps / sizes[..., None]
    reach = np.sqrt(3 * np.einsum("ijk,ikl,ijl->ij", units, covariances, units))
    gaps = np.maximum(sizes - reach - reach.T, 0)
    off = ~np.eye(len(centroids), dtype=bool)
    np.testing.assert_allclose(graph.gaps[off], gaps[off], atol=1e-12)
    np.testing.assert_allclose(graph.directions[off], units[off], atol=1e-12)
    np.fill_diagonal(sizes, np.inf)
    costs = (sizes + 3 * gaps) / np.median(sizes.min(axis=0))
    np.testing.assert_allclose(graph.costs[off], costs[off], rtol=1e-12)
    np.testing.assert_array_equal(graph.touching, ((gaps < 0.2 * sizes) & off).sum(axis=1))
    assert np.isinf(graph.costs.diagonal()).all()


def test_touching_tells_a_rope_from_a_surface() -> None:
    rng = np.random.default_rng(2)
    rope = NodeGraph.of(*nodes_along(SHAPES["hanging"], rng, 0.001))
    assert np.median(rope.touching) == 2
    x, y = np.meshgrid(np.arange(10) * SPACING, np.arange(10) * SPACING)
    wall = np.stack([x.ravel(), y.ravel(), np.ones(100)], axis=1)
    flat = np.tile(np.diag([SPACING**2 / 12, SPACING**2 / 12, 0]), (100, 1, 1))
    assert np.median(NodeGraph.of(wall, flat).touching) >= 4


# --- the paper's rule ---


def plain_greedy(centroids: FloatArray, start: int, farthest_first: bool = False) -> list[int]:
    """Equations 13 and 14 by their text: the closest, then the closest straight on; as printed: the farthest."""
    path = [start]
    while len(path) < len(centroids):
        best, best_score = -1, -np.inf
        for i in range(len(centroids)):
            if i in path:
                continue
            step = centroids[i] - centroids[path[-1]]
            size = float(np.linalg.norm(step))
            score = np.log(size) if farthest_first else -np.log(size)
            if len(path) > 1:
                before = centroids[path[-1]] - centroids[path[-2]]
                score += before @ step / (np.linalg.norm(before) * size)
            if score > best_score:
                best, best_score = i, score
        path.append(best)
    return path


@pytest.mark.parametrize("name", SHAPES)
def test_greedy_is_the_papers_text(name: str) -> None:
    rng = np.random.default_rng(1)
    centroids, _ = nodes_along(SHAPES[name], rng, 0.002)
    rng.shuffle(centroids)
    start = int(np.argmax(end_scores(centroids)))
    assert order_greedy(centroids, start).tolist() == plain_greedy(centroids, start)


@pytest.mark.parametrize("name", ["hanging", "s", "horizontal"])
def test_greedy_orders_simple_shapes_where_the_printed_maximum_cannot(name: str) -> None:
    rng = np.random.default_rng(4)
    for _ in range(10):
        centroids, _ = nodes_along(SHAPES[name], rng, 0.001)
        shuffle = rng.permutation(len(centroids))
        start = int(np.argmax(end_scores(centroids[shuffle])))
        assert is_in_order(order_greedy(centroids[shuffle], start), shuffle)
        assert not is_in_order(np.array(plain_greedy(centroids[shuffle], start, farthest_first=True)), shuffle)


# --- which end is the first ---


def test_end_scores_are_equation_12() -> None:
    centroids = np.random.default_rng(0).normal(0, 1, (20, 3))
    expected = [sum(np.linalg.norm(a - b) for b in centroids) - a[1] for a in centroids]
    np.testing.assert_allclose(end_scores(centroids), expected, rtol=1e-12)
    point = (0.3, -2.0, 1.0)
    expected = [sum(np.linalg.norm(a - b) for b in centroids) - np.linalg.norm(a - point) for a in centroids]
    np.testing.assert_allclose(end_scores(centroids, point), expected, rtol=1e-12)


def test_the_upper_end_of_a_hanging_rope_is_first() -> None:
    centroids, _ = nodes_along(SHAPES["hanging"], np.random.default_rng(0))
    assert np.argmax(end_scores(centroids)) == 0
    assert np.argmax(end_scores(centroids[::-1])) == len(centroids) - 1
    below = tuple(float(v) for v in centroids[-1] + [0, 0.1, 0])
    assert np.argmax(end_scores(centroids, (below[0], below[1], below[2]))) == len(centroids) - 1


@pytest.mark.parametrize("name", SHAPES)
def test_a_reversed_chain_runs_backwards_even_if_it_moved(name: str) -> None:
    rng = np.random.default_rng(0)
    before, _ = nodes_along(SHAPES[name], rng)
    for _ in range(20):
        now, _ = nodes_along(SHAPES[name], rng, 0.003)
        now = now + rng.normal(0, 0.02, 3)
        assert not runs_backwards(now, before)
        assert runs_backwards(now[::-1], before)


def test_no_swap_while_a_rope_turns_all_the_way_round_through_horizontal() -> None:
    rng = np.random.default_rng(0)
    previous: FloatArray | None = None
    for angle in np.radians(np.arange(90, 90 + 720, 3.0)):
        along = np.array([np.cos(angle), np.sin(angle), 0.0])
        count = int(rng.integers(18, 24))
        chain = np.linspace(-0.3, 0.3, count)[:, None] * along + [0, 0, 1] + rng.normal(0, 0.003, (count, 3))
        if previous is not None:
            assert not runs_backwards(chain, previous)
            assert runs_backwards(chain[::-1].copy(), previous)
        previous = chain
