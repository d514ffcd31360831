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


def brute(Z: np.ndarray, y: np.ndarray, q: np.ndarray, radius: float) -> np.ndarray:
    """Squared distances in float32, one dimension after the other: the index promises that."""
    distances = sum(np.square(Z[:, j] - q[j]) for j in range(Z.shape[1]))
    return np.bincount(y[distances <= np.float32(radius * radius)], minlength=2)[::-1]


def filled(Z: np.ndarray, y: np.ndarray, spaces: np.ndarray | None = None) -> RadiusIndex:
    index = RadiusIndex(Z.shape[1])
    index.add(Z, y, spaces)
    return index


def count(index: RadiusIndex, query: np.ndarray, radius: float) -> tuple[int, int]:
    """Successes and failures around a query (K, d)."""
    z = torch.from_numpy(query.astype(np.float32))
    return index.count_near(index.squared_distances(z), radius)


def test_the_surface_of_the_ball_counts():
    index = filled(np.array([[3.0, 4.0], [0.0, 5.0], [0.0, 5.001]]), np.array([1, 0, 1]))
    assert count(index, np.zeros((1, 2)), radius=5.0) == (1, 1)


@settings(deadline=None)
@given(st.integers(1, 30), st.integers(1, 12), st.integers(1, 30), st.integers(0, 10))
def test_a_restored_ring_of_any_capacity_holds_the_newest_points_that_fit_and_goes_on(
    n, capacity, other, more
):
    Z, y = points(n + more)
    numbers = np.arange(1, n + more + 1)
    index = RadiusIndex(2, capacity)
    index.add(Z[:n], y[:n], parts=numbers[:n] % 4, numbers=numbers[:n])
    for size in (capacity, other):
        restored = RadiusIndex.from_state(index.get_state(), size)
        for i in range(n, n + more):
            restored.add_one(torch.from_numpy(Z[i]), float(y[i]), 0, (i + 1) % 4, i + 1)
        slots = restored.column("numbers") - 1
        kept = min(min(n, capacity, size) + more, size)
        assert {*slots} == {*range(n + more - kept, n + more)}
        for name, values in (("points", Z), ("labels", y), ("parts", numbers % 4)):
            np.testing.assert_array_equal(restored.column(name), values[slots])


@settings(deadline=None)
@given(st.integers(1, 4), st.integers(1, 5), st.floats(0.1, 3.0), st.integers(0, 2**16))
def test_counts_over_k_spaces_are_the_sum_of_the_counts_in_each(K, d, radius, seed):
    Z, y = points(80, d, seed)
    rng = np.random.default_rng(seed)
    spaces = rng.integers(0, K, 80)
    index = filled(Z, y, spaces)
    for query in rng.normal(size=(6, K, d)).astype(np.float32):
        counts = [brute(Z[spaces == k], y[spaces == k], query[k], radius) for k in range(K)]
        assert count(index, query, radius) == tuple(np.sum(counts, axis=0))


@pytest.mark.parametrize("radius", [0.5, LARGEST_RADIUS])
def test_a_query_beyond_all_measure_has_no_neighbours_however_large_the_ball(radius):
    Z, y = points(50)
    for query in (np.inf, np.nan, 1e30):  # squared, the last overflows float32
        assert count(filled(Z, y), np.full((1, 2), query), radius) == (0, 0)


def test_a_point_without_axes_is_a_value_error():
    with pytest.raises(ValueError, match=r"Expected points \(n, 1\).* got \(\), \(\)"):
        RadiusIndex(1).add(0.5, 1)


def agreement_of(n_parts: int, agree: float, n_spaces: int = 3, seed: int = 0) -> float:
    """The bound for points in no order, four of a part, with labels that are 80 % good; each is its
    part's common draw with probability `agree`, else its own.
    """
    rng = np.random.default_rng(seed)
    part = np.repeat(np.arange(1, n_parts + 1), 4)
    common, custom, is_common = rng.random(n_parts), rng.random(len(part)), rng.random(len(part))
    labels = np.where(is_common < agree, common[part - 1], custom) < 0.8
    points = rng.normal(size=(len(part), 2)).astype(np.float32)
    return label_agreement(points, labels.astype(np.int8), part % n_spaces, part)


@pytest.mark.parametrize(
    ("n_parts", "agree", "least", "most"),
    [(80, 1.0, 0.9, 1.0), (300, 0.0, 0.0, 0.1), (FEWEST_PARTS - 1, 0.0, 1.0, 1.0)],
)
def test_agreement_is_what_it_was_planted_as_and_one_where_few_parts_came_again(
    n_parts, agree, least, most
):
    assert least <= agreement_of(n_parts, agree) <= most


@pytest.mark.parametrize(("n_parts", "n_spaces"), [(60, 3), (FEWEST_PARTS, 5)])
def test_the_bound_lies_above_the_truth_in_nearly_all_draws(n_parts, n_spaces):
    # Both labels of a pair are the common draw with probability agree squared: that is their
    # correlation.
    bounds = [agreement_of(n_parts, 0.6, n_spaces, seed) for seed in range(40)]
    assert np.mean(np.array(bounds) >= 0.6**2) >= 0.85


@pytest.mark.parametrize(("agreement", "votes"), [(1.0, (1, 0)), (0.0, (6, 0)), (0.2, (3, 0))])
def test_m_points_of_a_part_are_worth_m_over_one_plus_m_minus_one_times_its_agreement(
    agreement, votes
):
    index = RadiusIndex(dim=1)
    index.add(np.zeros((6, 1)), np.ones(6), parts=np.full(6, 7))
    index.agreement.fill_(agreement)
    assert count(index, np.zeros((1, 1)), radius=1.0) == votes
