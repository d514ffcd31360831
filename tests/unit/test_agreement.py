"""How far the labels of one part go together, and what its repeats are worth in a ball."""

import numpy as np
import pytest

from dengine.decision.references import FEWEST_PARTS, RadiusIndex, label_agreement


def repeats(n_parts: int, times: int, agree: float, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Points in no order, labels 80 % good; each is its part's common draw with probability `agree`, else its own."""
    rng = np.random.default_rng(seed)
    part = np.repeat(np.arange(1, n_parts + 1), times)
    common, own = rng.random(n_parts) < 0.8, rng.random(n_parts * times) < 0.8
    labels = np.where(rng.random(n_parts * times) < agree, common[part - 1], own).astype(np.int8)
    return rng.normal(size=(len(part), 2)).astype(np.float32), labels, part % 3, part


def test_labels_of_a_part_that_always_agree_leave_it_one_vote() -> None:
    assert label_agreement(*repeats(80, 5, agree=1.0)) > 0.9


def test_labels_that_go_their_own_ways_are_nearly_independent() -> None:
    assert label_agreement(*repeats(300, 5, agree=0.0)) < 0.1


def test_the_bound_lies_above_the_truth_in_nearly_all_draws() -> None:
    # Both labels of a pair are the common draw with probability agree squared: that is their correlation.
    bounds = [label_agreement(*repeats(60, 4, agree=0.6, seed=seed)) for seed in range(40)]
    assert np.mean(np.array(bounds) >= 0.6**2) >= 0.85


def test_few_repeated_parts_say_nothing() -> None:
    assert label_agreement(*repeats(FEWEST_PARTS - 1, 5, agree=0.0)) == 1.0


def test_points_of_no_known_part_say_nothing() -> None:
    points, labels, spaces, part = repeats(80, 5, agree=0.0)
    assert label_agreement(points, labels, spaces, np.zeros_like(part)) == 1.0


@pytest.mark.parametrize(("agreement", "votes"), [(1.0, (1, 0)), (0.0, (6, 0)), (0.2, (3, 0))])
def test_m_points_of_a_part_are_worth_m_over_one_plus_m_minus_one_times_its_agreement(
    agreement: float, votes: tuple[int, int]
) -> None:
    index = RadiusIndex(dim=1)
    index.add(np.zeros((6, 1)), np.ones(6), parts=np.full(6, 7))
    index.ring.agreement.fill_(agreement)
    n_success, n_failure = index.count(np.zeros((1, 1)), radius=1.0)
    assert (int(n_success[0]), int(n_failure[0])) == votes


def test_parts_that_came_once_have_their_vote_whatever_others_did() -> None:
    index = RadiusIndex(dim=1)
    index.add(np.zeros((7, 1)), [1, 1, 1, 1, 0, 1, 0], parts=[5, 5, 5, 1, 2, 0, 0])
    n_success, n_failure = index.count(np.zeros((1, 1)), radius=1.0)
    assert (int(n_success[0]), int(n_failure[0])) == (3, 2)
