"""Baselines in the same loop: what each promises to the engine, and what its method says
by hand.
"""

import copy
from typing import Any

import numpy as np
import pytest

from dengine import Action, DataEngine, Policy, Recipe, replay
from dengine.errors import SettingError
from dengine.experiments.baselines import (
    BASELINES,
    Baseline,
    make_baseline,
)
from dengine.model import Model
from dengine.records import Reason
from training.published import PUBLISHED, guaranteed_threshold

LOOSE = Policy(alpha=0.5, lower_bound=0.8)
QUICK: dict[str, dict[str, Any]] = {
    "minirocket": {"n_kernels": 168},
    "gp": {"n_components": 2},
}
CONSTANT = {"always": "verify", "never": "accept"}

NAMES = [*BASELINES, *PUBLISHED]
every_baseline = pytest.mark.parametrize("name", NAMES)
learning_baseline = pytest.mark.parametrize("name", [n for n in NAMES if n not in CONSTANT])


def new(name: str, policy: Policy = LOOSE, seed: int = 0, **params: Any) -> Baseline:
    if name == "minirocket":
        pytest.importorskip("aeon")
    return make_baseline(PUBLISHED.get(name, name), policy, seed, **QUICK.get(name, {}) | params)


@pytest.fixture
def traces(make_data):
    """160 traces (n, 1, T) of two shapes: the first 120 are known, the others are asked about."""
    data = make_data(160, 60, failures=0.4)
    return data.X[:, None], data.y


@pytest.fixture
def known(traces):
    return [values[:120] for values in traces]


@pytest.fixture
def asked(traces):
    return traces[0][120:]


@every_baseline
def test_a_baseline_meets_the_model_contract_and_repeats_by_its_seed(name, known, asked):
    baseline, again = (new(name).fit(*known) for _ in range(2))
    assert isinstance(baseline, Model)
    lower, upper = baseline.predict_interval(asked)
    assert lower.shape == upper.shape == (40,)
    assert ((lower >= 0) & (lower <= upper) & (upper <= 1)).all()
    for n in baseline.count(asked):
        assert n.shape == (40,)
        assert n.dtype.kind == "i"
        assert n.min() >= 0
    np.testing.assert_array_equal((lower, upper), again.predict_interval(asked))
    actions = baseline.decide(asked)
    assert [baseline.decide(x[None])[0] for x in asked[:10]] == list(actions[:10])


@learning_baseline
def test_a_baseline_is_right_on_easy_traces(name, traces, known, asked):
    actions, labels = new(name).fit(*known).decide(asked), traces[1][120:]
    accepted, rejected = (labels[actions == item] for item in (Action.ACCEPT, Action.REJECT))
    assert len(accepted) >= 5
    assert accepted.all()
    assert len(rejected) >= 3
    assert not rejected.any()


@learning_baseline
@pytest.mark.parametrize("label", [1, 0])
def test_labels_of_one_class_verify_everything(name, label, traces, asked):
    X = traces[0]
    untrained = new(name).add(X[0], 1)
    trained = new(name).fit(X[:60], np.full(60, label)).add(X[60], 1)
    for baseline in (untrained, trained):
        assert {*baseline.decide(asked)} == {Action.VERIFY}
        assert not baseline.predict_interval(asked)[0].any()


@learning_baseline
def test_what_a_copy_learns_stays_with_it(name, traces, known):
    X, y = traces
    baseline = new(name).fit(*known)
    before, successor = baseline.predict_interval(X), copy.deepcopy(baseline)
    successor.add(X[120], 1 - y[120]).fit(X[40:], 1 - y[40:])
    baseline.predict_interval(X[:5])  # what it said last is remembered
    np.testing.assert_array_equal(baseline.predict_interval(X), before)


@pytest.mark.parametrize("name", ["knn", "wskde"])
def test_a_label_counts_at_once_where_the_method_learns_at_once(name, traces, known, asked):
    X, y = traces
    baseline = new(name).fit(*known)
    before = baseline.predict_interval(asked)
    for x, label in zip(X, 1 - y, strict=True):
        baseline.add(x, label)
    assert not np.array_equal(baseline.predict_interval(asked), before)


@pytest.mark.parametrize(
    ("name", "params", "words"),
    [
        ("nope", {}, "baseline among knn, always"),
        ("training.published:Nope", {}, "module:Class that can be imported here"),
        ("training.published:ScaledComponents", {}, "module:Class of one, got"),
        ("knn", {"n": 3}, "baseline knn has no parameter n; it has k"),
        ("knn", {"k": 0}, "k to be an integer of at least 1, got 0"),
    ],
)
def test_a_wrong_setting_is_named(name, params, words):
    with pytest.raises(SettingError, match=words):
        new(name, **params)


def test_neighbours_decide_only_where_all_k_agree():
    X = np.array([0.0, 1.0, 2.0, 10.0, 11.0, 12.0, 13.0])[:, None, None]
    baseline = new("knn", k=3).fit(X, [1, 1, 1, 0, 0, 0, 1])
    asked = np.array([1.0, 11.0, 12.5])[:, None, None]
    assert list(baseline.decide(asked)) == [Action.ACCEPT, Action.REJECT, Action.VERIFY]
    np.testing.assert_array_equal(baseline.count(asked), [[3, 0, 1], [0, 3, 2]])


def test_a_risk_above_the_tolerance_is_vouched_for_in_no_more_than_delta_of_all_sets():
    draws = np.random.default_rng(1).random((500, 2, 200))
    thresholds = [guaranteed_threshold(draw[0], draw[1] < 0.12, 0.1, 0.2) for draw in draws]
    assert np.isfinite(thresholds).mean() <= 0.2


@every_baseline
def test_a_baseline_plays_in_the_engines_loop(name):
    engine = DataEngine(recipe=Recipe(retrain_every=50), model=new(name), seed=0, replaying=True)
    played = replay("insertion", engine, cycles=150)
    assert (played.version[50:] >= 1).all()  # it answers after the first retrain
    assert all(report.accepted for report in played.retrains)  # and no training failed
    assert {*played.reason} <= {Reason.NO_MODEL, Reason.UNCERTAIN, Reason.CERTAIN}
    if name in CONSTANT:
        assert {*played.action[50:]} == {CONSTANT[name]}
