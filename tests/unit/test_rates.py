"""What decisions were worth: rates, errors with an interval, seconds."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import accuracy_score, precision_score

from dengine import wilson_interval
from dengine.errors import SettingError
from dengine.experiments.metrics import Costs, pooled_error
from tests.support.replays import replay_of


@given(
    st.lists(
        st.tuples(st.sampled_from(["accept", "reject", "verify"]), st.booleans()),
        min_size=1,
        max_size=60,
    )
)
def test_the_rates_are_those_of_scikit_learn_over_what_was_decided(cycles) -> None:
    action, truth = np.array([a for a, _ in cycles]), np.array([t for _, t in cycles])
    accepted, certain = action == "accept", action != "verify"
    result, expected = (
        replay_of(action, truth).summary(),
        dict.fromkeys(("accuracy", "precision", "npv"), math.nan),
    )
    if certain.any():
        expected["accuracy"] = accuracy_score(truth[certain], accepted[certain])
    if accepted.any():
        expected["precision"] = precision_score(truth[certain], accepted[certain])
    if (action == "reject").any():
        expected["npv"] = precision_score(~truth[certain], ~accepted[certain])
    assert {name: result[name] for name in expected} == pytest.approx(expected, nan_ok=True)


TWENTY = replay_of(["accept"] * 400, np.arange(400) % 20 != 0)


def test_different_traces_have_nearly_wilsons_interval_and_shuffles_of_the_same_make_it_no_narrower() -> (
    None
):
    error, often = pooled_error([TWENTY]), pooled_error([TWENTY] * 30)
    assert (error.decided, error.wrong, error.traces, error.rate) == (400, 20, 400, 0.05)
    assert (error.lower, error.upper) == pytest.approx(wilson_interval(20, 380), abs=1e-3)
    assert (often.rate, often.decided) == (error.rate, 30 * 400)
    assert (often.lower, often.upper) == pytest.approx((error.lower, error.upper), abs=1e-9)


def test_no_error_leaves_what_as_many_different_traces_leave() -> None:
    error = pooled_error([replay_of(["accept"] * 50, [True] * 50)] * 30)
    assert (error.rate, error.lower) == (0.0, 0.0)
    assert error.upper == pytest.approx(wilson_interval(0, 50)[1])


def test_rejects_are_a_side_of_their_own() -> None:
    first = replay_of(["reject", "reject", "reject", "accept"], [True, False, False, False])
    assert pooled_error([first], "rejected").rate == pytest.approx(1 / 3)
    assert pooled_error([first]).rate == 1.0
    with pytest.raises(SettingError, match="accepted or rejected, got 'reject'"):
        pooled_error([first], "reject")


def test_the_interval_covers_the_true_share_of_other_parts() -> None:
    """Of 300 worlds of 200 parts, each shuffled into five replays that accept three in four: 95 %
    up to noise.
    """
    rng, share, covered = np.random.default_rng(0), 0.1, 0
    for _ in range(300):
        truth = rng.random(200) >= share
        orders = [rng.permutation(200) for _ in range(5)]
        replays = [
            replay_of(np.where(rng.random(200) < 0.75, "accept", "verify"), truth[o], index=o)
            for o in orders
        ]
        error = pooled_error(replays)
        covered += error.lower <= share <= error.upper
    assert 0.95 - 3 * math.sqrt(0.05 * 0.95 / 300) <= covered / 300


def test_what_is_saved_are_checks_less_stops_and_good_parts_done_again() -> None:
    assert Costs().saved(100) == 500
    assert Costs().saved(100, 2, 3) == 500 - 2 * 120 - 3 * 47.5
    assert Costs(escape=0, false_reject=0).saved(100, 2, 3) == 500


def test_an_accept_is_worth_the_risk_up_to_check_by_escape() -> None:
    costs = Costs(check=5, escape=600)
    assert costs.saved(600, false_positive=600 * costs.worst_accept) == pytest.approx(0.0)
    assert Costs(check=5, escape=2).worst_accept == Costs(check=5, escape=0).worst_accept == 1.0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("check", 0),
        ("escape", -1),
        ("false_reject", math.inf),
        ("escape", math.nan),
        ("check", "5"),
    ],
)
def test_a_cost_that_is_none_is_refused_by_its_name(name: str, value: Any) -> None:
    with pytest.raises(SettingError, match=name):
        Costs(**{name: value})
