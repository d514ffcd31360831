"""Baselines in the same loop: what each promises to the engine, and what its method says
by hand.
"""

import copy
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom

from dengine import Action, DataEngine, Policy, Recipe, replay, wilson_interval
from dengine.errors import SettingError
from dengine.experiments.baselines import (
    BASELINES,
    Baseline,
    make_baseline,
)
from dengine.model import Model
from dengine.records import Reason
from training.published import PUBLISHED, guaranteed_threshold, risk_bound

LOOSE = Policy(alpha=0.5, lower_bound=0.8)
QUICK: dict[str, dict[str, Any]] = {
    "minirocket": {"n_kernels": 168},
    "gp": {"n_components": 2},
}
LEARN_AT_ONCE = ("knn", "wskde")  # those that take labels in between two trainings

every_baseline = pytest.mark.parametrize("name", [*BASELINES, *PUBLISHED])
learning_baseline = pytest.mark.parametrize(
    "name", [name for name in [*BASELINES, *PUBLISHED] if name not in ("always", "never")]
)


def new(name: str, policy: Policy = LOOSE, seed: int = 0, **params: Any) -> Baseline:
    if name == "minirocket":
        pytest.importorskip("aeon")
    return make_baseline(PUBLISHED.get(name, name), policy, seed, **QUICK.get(name, {}) | params)


@pytest.fixture
def traces(make_data: Any) -> tuple[np.ndarray, np.ndarray]:
    """160 traces (n, 1, T) of two shapes; the first 120 are for training."""
    data = make_data(160, 60, failures=0.4)
    return data.X[:, None, :], data.y


@every_baseline
def test_a_baseline_meets_the_model_contract_repeats_by_its_seed_and_is_right_on_easy_traces(
    name: str, traces: Any
) -> None:
    X, y = traces
    baseline = new(name).fit(X[:120], y[:120])
    assert isinstance(baseline, Model)
    (lower, upper), counts, actions = (
        baseline.predict_interval(X[120:]),
        baseline.count(X[120:]),
        baseline.decide(X[120:]),
    )
    assert {item.shape for item in (lower, upper, *counts, actions)} == {(40,)}
    assert ((lower >= 0) & (lower <= upper) & (upper <= 1)).all()
    assert all(n.dtype.kind == "i" and n.min() >= 0 for n in counts)
    assert all(isinstance(action, Action) for action in actions)
    np.testing.assert_array_equal(
        (lower, upper), new(name).fit(X[:120], y[:120]).predict_interval(X[120:])
    )
    assert [baseline.decide(x[None])[0] for x in X[120:130]] == list(actions[:10])
    assert [baseline.predict_interval(x[None])[0][0] for x in X[120:130]] == pytest.approx(
        lower[:10], abs=1e-6
    )
    if name not in ("always", "never"):
        for action, label, fewest in ((Action.ACCEPT, 1, 5), (Action.REJECT, 0, 3)):
            decided = y[120:][actions == action]
            assert len(decided) >= fewest
            assert (decided == label).all()


@learning_baseline
@pytest.mark.parametrize("labels", [np.ones(60), np.zeros(60)], ids=["successes", "failures"])
def test_labels_of_one_class_verify_everything(name: str, labels: np.ndarray, traces: Any) -> None:
    X = traces[0]
    assert set(new(name).add(X[0], 1).decide(X[:5])) == {Action.VERIFY}  # before its first training
    baseline = new(name).fit(X[:60], labels)
    baseline.add(X[60], 1)
    assert set(baseline.decide(X[120:])) == {Action.VERIFY}
    assert list(baseline.predict_interval(X[120:])[0]) == [0.0] * 40


@every_baseline
def test_what_a_copy_learns_stays_with_it_and_a_label_counts_at_once_where_the_method_learns_at_once(
    name, traces
) -> None:
    X, y = traces
    baseline = new(name, **({"k": 1} if name == "knn" else {})).fit(X[:120], y[:120])
    before, successor = baseline.predict_interval(X[120:]), copy.deepcopy(baseline)
    for x, label in zip(X[120:], y[120:], strict=True):
        successor.add(x, 1 - label)
    assert np.array_equal(successor.predict_interval(X[120:]), before) == (
        name not in LEARN_AT_ONCE
    )
    successor.fit(X[40:], 1 - y[40:])
    baseline.predict_interval(X[:5])  # what it said last is remembered
    np.testing.assert_array_equal(baseline.predict_interval(X[120:]), before)


@pytest.mark.parametrize(
    ("name", "params", "words"),
    [
        ("nope", {}, "baseline among knn, always"),
        ("training.published:Nope", {}, "module:Class that can be imported here"),
        ("training.published:ScaledComponents", {}, "module:Class of one, got"),
        ("knn", {"n": 3}, "baseline knn has no parameter n; it has k"),
        ("knn", {"k": 0}, "k to be an integer of at least 1, got 0"),
        ("wskde", {"bandwidth": -1.0}, "bandwidth to be a number above 0, got -1.0"),
        ("gp", {"amplitude": 1.0}, "amplitude above 1, got 1.0"),
    ],
)
def test_a_wrong_setting_is_named(name: str, params: dict[str, Any], words: str) -> None:
    with pytest.raises(SettingError, match=words):
        make_baseline(PUBLISHED.get(name, name), LOOSE, 0, **params)


def test_neighbours_decide_only_where_all_k_agree() -> None:
    X = np.array([0.0, 1.0, 2.0, 10.0, 11.0, 12.0, 13.0])[:, None, None]
    baseline = new("knn", k=3).fit(X, [1, 1, 1, 0, 0, 0, 1])
    asked = np.array([1.0, 11.0, 12.5])[:, None, None]
    assert list(baseline.decide(asked)) == [Action.ACCEPT, Action.REJECT, Action.VERIFY]
    assert [list(counts) for counts in baseline.count(asked)] == [[3, 0, 1], [0, 3, 2]]
    np.testing.assert_allclose(baseline.predict_interval(asked), [[1.0, 0.0, 1 / 3]] * 2)


def test_traces_of_the_same_bytes_and_another_shape_get_a_prediction_of_their_own() -> None:
    baseline = new("always")
    for shape in ((2, 1, 5), (1, 2, 5), (1, 1, 10)):
        assert baseline.predict(np.zeros(shape)).lower.shape == shape[:1]
        assert baseline.decide(np.zeros(shape)).shape == shape[:1]


def test_a_narrow_kernel_counts_a_label_at_the_very_place_twice(traces: Any) -> None:
    # The published effective sample size in two dimensions is 2 sum w: Wilson's interval of twice
    # the counts.
    X, y = traces
    baseline = new("wskde", bandwidth=1e-5).fit(X[:120], y[:120])
    good = X[:120][y[:120] == 1][:1]
    assert [int(n[0]) for n in baseline.count(good)] == [2, 0]
    np.testing.assert_allclose(
        np.ravel(baseline.predict_interval(good)), wilson_interval(2, 0, LOOSE.alpha), atol=1e-6
    )


@pytest.mark.parametrize(("wrong", "n", "delta"), [(0, 20, 0.1), (3, 50, 0.05), (49, 50, 0.2)])
def test_the_risk_bound_inverts_the_binomial_tail(wrong: int, n: int, delta: float) -> None:
    assert binom.cdf(wrong, n, risk_bound(wrong, n, delta)) == pytest.approx(delta, rel=1e-9)


def test_the_threshold_parts_the_confident_from_the_wrong() -> None:
    assert risk_bound(0, 0, 0.1) == risk_bound(5, 5, 0.1) == 1.0
    assert guaranteed_threshold(np.empty(0), np.empty(0, dtype=bool), 0.1, 0.1) == np.inf
    confidence = np.linspace(0.5, 1.0, 256)
    wrong = confidence < 0.75
    result = guaranteed_threshold(confidence, wrong, 0.1, 0.1)
    beyond = confidence >= result
    assert 0.7 < result <= 0.76
    assert (
        risk_bound(int(wrong[beyond].sum()), int(beyond.sum()), 0.1 / 8) < 0.1
    )  # log2(256) = 8 looks


def test_a_risk_above_the_tolerance_is_vouched_for_in_no_more_than_delta_of_all_sets() -> None:
    rng = np.random.default_rng(1)
    results = [
        guaranteed_threshold(rng.random(200), rng.random(200) < 0.12, 0.1, 0.2) < np.inf
        for _ in range(500)
    ]
    assert np.mean(results) <= 0.2


@every_baseline
def test_a_baseline_plays_in_the_engines_loop(name: str) -> None:
    engine = DataEngine(recipe=Recipe(retrain_every=50), model=new(name), seed=0, replaying=True)
    played = replay("insertion", engine, cycles=150)
    assert (played.version[50:] >= 1).all()  # it answers after the first retrain
    assert all(report.accepted for report in played.retrains)  # and no training failed
    assert set(played.reason) <= {Reason.NO_MODEL, Reason.UNCERTAIN, Reason.CERTAIN}
    assert (played.action[:50] == "verify").all()
    assert (
        name not in ("always", "never")
        or (played.action[50:] == {"always": "verify", "never": "accept"}[name]).all()
    )
