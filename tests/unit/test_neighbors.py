"""Counting around a query: exact, whatever the order, in every space, scripted or not."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dengine.decision.policy import LARGEST_RADIUS
from dengine.decision.references import FEWEST_PARTS, RadiusIndex, label_agreement


def points(n: int, d: int = 2, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(0, 1, (n, d)).astype(np.float32), rng.integers(0, 2, n)


def distances(Z: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Squared, in float32, one dimension after the other: the arithmetic that the index
    promises.
    """
    out = np.zeros(len(Z), dtype=np.float32)
    for j in range(Z.shape[1]):
        out += np.square(Z[:, j] - q[j])
    return out


def brute(Z: np.ndarray, y: np.ndarray, q: np.ndarray, radius: float) -> tuple[int, int]:
    inside = distances(Z, q) <= np.float32(radius * radius)
    return int(y[inside].sum()), int((1 - y[inside]).sum())


def filled(
    Z: np.ndarray, y: np.ndarray, spaces: np.ndarray | None = None, capacity: int = 10_000
) -> RadiusIndex:
    index = RadiusIndex(Z.shape[1], capacity)
    index.add(Z, y, spaces)
    return index


def count(index: RadiusIndex, query: np.ndarray, radius: float) -> tuple[int, int]:
    """Successes and failures around a query (K, d)."""
    z = torch.from_numpy(query.astype(np.float32))
    return index.count_near(index.squared_distances(z), radius)


def test_the_surface_of_the_ball_counts() -> None:
    index = filled(np.array([[3.0, 4.0], [0.0, 5.0], [0.0, 5.001]]), np.array([1, 0, 1]))
    assert count(index, np.zeros((1, 2)), radius=5.0) == (1, 1)


@settings(deadline=None)
@given(st.integers(1, 30), st.integers(1, 12), st.integers(1, 30), st.integers(0, 10))
def test_a_restored_ring_of_any_capacity_holds_the_newest_points_that_fit_and_goes_on(
    n: int, capacity: int, other: int, more: int
) -> None:
    Z, y = points(n + more)
    numbers = np.arange(1, n + more + 1)
    index = RadiusIndex(2, capacity)
    index.add(Z[:n], y[:n], parts=numbers[:n] % 4, numbers=numbers[:n])
    for size in (capacity, other):
        restored = RadiusIndex.from_state(index.get_state(), size)
        for i in range(n, n + more):
            restored.add_one(torch.from_numpy(Z[i]), float(y[i]), 0, int(numbers[i]) % 4, i + 1)
        kept = min(min(n, capacity, size) + more, size)
        assert sorted(restored.column("numbers")) == numbers[n + more - kept :].tolist()
        slots = restored.column("numbers") - 1
        np.testing.assert_array_equal(restored.column("points"), Z[slots])
        np.testing.assert_array_equal(restored.column("labels"), y[slots])
        np.testing.assert_array_equal(restored.column("parts"), (slots + 1) % 4)
        if size == capacity:  # each in the slot that it would have without the restoring
            np.testing.assert_array_equal(slots % size, np.arange(kept))


@settings(deadline=None)
@given(
    K=st.integers(1, 4), d=st.integers(1, 5), radius=st.floats(0.1, 3.0), seed=st.integers(0, 2**16)
)
def test_counts_over_k_spaces_are_the_sum_of_the_counts_in_each(
    K: int, d: int, radius: float, seed: int
) -> None:
    Z, y = points(80, d, seed)
    spaces = np.random.default_rng(seed).integers(0, K, 80)
    queries = np.random.default_rng(seed + 1).normal(0, 1, (6, K, d)).astype(np.float32)
    index = filled(Z, y, spaces)
    for query in queries:
        item = [brute(Z[spaces == k], y[spaces == k], query[k], radius) for k in range(K)]
        assert count(index, query, radius) == tuple(np.sum(item, axis=0))


@pytest.mark.parametrize("radius", [0.5, LARGEST_RADIUS])
def test_a_query_beyond_all_measure_has_no_neighbours_however_large_the_ball(radius: float) -> None:
    Z, y = points(50)
    for query in (np.inf, np.nan, 1e30):  # squared, the last overflows float32
        assert count(filled(Z, y), np.full((1, 2), query), radius) == (0, 0)


def repeats(n_parts: int, times: int, agree: float, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Points in no order, labels 80 % good; each is its part's common draw with probability
    `agree`, else its own.
    """
    rng = np.random.default_rng(seed)
    part = np.repeat(np.arange(1, n_parts + 1), times)
    common, custom = rng.random(n_parts) < 0.8, rng.random(n_parts * times) < 0.8
    labels = np.where(rng.random(n_parts * times) < agree, common[part - 1], custom).astype(np.int8)
    return rng.normal(size=(len(part), 2)).astype(np.float32), labels, part % 3, part


@pytest.mark.parametrize(
    ("parts", "agree", "least", "most"),
    [(80, 1.0, 0.9, 1.0), (300, 0.0, 0.0, 0.1), (FEWEST_PARTS - 1, 0.0, 1.0, 1.0)],
)
def test_agreement_is_what_it_was_planted_as_and_one_where_few_parts_came_again(
    parts, agree, least, most
) -> None:
    points, labels, spaces, part = repeats(parts, 5, agree)
    assert least <= label_agreement(points, labels, spaces, part) <= most
    assert label_agreement(points, labels, spaces, np.zeros_like(part)) == 1.0  # of no known part


@pytest.mark.parametrize(("n_parts", "n_spaces"), [(60, 3), (FEWEST_PARTS, 5)])
def test_the_bound_lies_above_the_truth_in_nearly_all_draws(n_parts: int, n_spaces: int) -> None:
    # Both labels of a pair are the common draw with probability agree squared: that is their
    # correlation.
    draws = [repeats(n_parts, 4, agree=0.6, seed=seed) for seed in range(40)]
    bounds = [
        label_agreement(points, labels, part % n_spaces, part) for points, labels, _, part in draws
    ]
    assert np.mean(np.array(bounds) >= 0.6**2) >= 0.85


@pytest.mark.parametrize(("agreement", "votes"), [(1.0, (1, 0)), (0.0, (6, 0)), (0.2, (3, 0))])
def test_m_points_of_a_part_are_worth_m_over_one_plus_m_minus_one_times_its_agreement(
    agreement: float, votes
) -> None:
    index = RadiusIndex(dim=1)
    index.add(np.zeros((6, 1)), np.ones(6), parts=np.full(6, 7))
    index.agreement.fill_(agreement)
    assert count(index, np.zeros((1, 1)), radius=1.0) == votes
