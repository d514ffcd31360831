"""What decisions were worth: rates, errors with an interval, seconds."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import accuracy_score

from dengine import wilson_interval
from dengine.errors import SettingError
from dengine.experiments.metrics import Costs, pooled_error
from tests.support.replays import replay_of


@given(
    st.lists(st.tuples(st.sampled_from(["accept", "reject", "verify"]), st.booleans()), min_size=1)
)
def test_the_rates_are_those_of_scikit_learn_over_what_was_decided(cycles):
    action, truth = np.array([a for a, _ in cycles]), np.array([t for _, t in cycles])
    result, (good, accepted) = replay_of(action, truth).summary(), (truth, action == "accept")
    decided = action != "verify"
    for name, chosen in (
        ("accuracy", decided),
        ("precision", accepted),
        ("npv", decided & ~accepted),
    ):
        expected = accuracy_score(good[chosen], accepted[chosen]) if chosen.any() else math.nan
        assert result[name] == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize("n_wrong", [0, 20])
def test_different_traces_have_nearly_wilsons_interval_and_shuffles_of_the_same_make_it_no_narrower(
    n_wrong,
):
    played = replay_of(["accept"] * 400, np.arange(400) >= n_wrong)
    error, often = pooled_error([played]), pooled_error([played] * 30)
    assert (error.decided, error.wrong, error.traces) == (400, n_wrong, 400)
    interval = pytest.approx(wilson_interval(n_wrong, 400 - n_wrong), abs=1e-3)
    assert (error.lower, error.upper) == interval == (often.lower, often.upper)
    assert (often.rate, often.decided) == (error.rate, 30 * 400)


def test_rejects_are_a_side_of_their_own():
    first = replay_of(["reject", "reject", "reject", "accept"], [True, False, False, False])
    assert pooled_error([first], "rejected").rate == pytest.approx(1 / 3)
    assert pooled_error([first]).rate == 1.0
    with pytest.raises(SettingError, match="accepted or rejected, got 'reject'"):
        pooled_error([first], "reject")


def test_the_interval_covers_the_true_share_of_other_parts():
    """Of 300 worlds of 200 parts, each shuffled into five replays that accept three in four: 95 %
    up to noise.
    """
    rng, share, covered = np.random.default_rng(0), 0.1, 0
    for _ in range(300):
        truth, replays = rng.random(200) >= share, []
        for _ in range(5):
            order = rng.permutation(200)
            actions = np.where(rng.random(200) < 0.75, "accept", "verify")
            replays.append(replay_of(actions, truth[order], index=order))
        error = pooled_error(replays)
        covered += error.lower <= share <= error.upper
    assert 0.95 - 3 * math.sqrt(0.05 * 0.95 / 300) <= covered / 300


def test_what_is_saved_are_checks_less_stops_and_good_parts_done_again():
    assert Costs().saved(100) == 500
    assert Costs().saved(100, 2, 3) == 500 - 2 * 120 - 3 * 47.5
    assert Costs(escape=0, false_reject=0).saved(100, 2, 3) == 500


def test_an_accept_is_worth_the_risk_up_to_check_by_escape():
    costs = Costs(check=5, escape=600)
    assert costs.saved(600, false_positive=600 * costs.worst_accept) == pytest.approx(0.0)
    assert Costs(check=5, escape=2).worst_accept == Costs(check=5, escape=0).worst_accept == 1.0


@pytest.mark.parametrize(
    ("name", "value"), [("check", 0), ("escape", -1), ("false_reject", math.inf), ("check", "5")]
)
def test_a_cost_that_is_none_is_refused_by_its_name(name, value):
    with pytest.raises(SettingError, match=name):
        Costs(**{name: value})
