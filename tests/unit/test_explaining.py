"""Why a decision came out so: what is found again is what was counted, and what is said is true."""

import math
from dataclasses import asdict, replace
from itertools import count
from typing import Any

import numpy as np
import pytest
import torch

from dengine import Action, DataEngine, Dataset, Policy, Reason, Recipe, SqlStore, TraceSpec
from dengine.errors import ReportError, StoreError
from dengine.experiments.baselines import make_baseline
from dengine.history.envelope import envelope_of
from dengine.history.explain import Explanation, explain
from tests.support.driving import drive, easy_parts
from tests.support.stores import execute

LOCAL = Policy(alpha=0.1, lower_bound=0.9, audit_rate=0.1)
POOLED = replace(LOCAL, guarantee="pooled", stops="all")
PCA, LOOSE = Recipe.load("pca"), Recipe.load("conv").with_policy(alpha=0.2, lower_bound=0.8)
RECIPES = {
    "local": PCA.with_settings(policy=LOCAL, retrain_every=40),
    "pooled": PCA.with_settings(policy=POOLED, retrain_every=40),
    "full block": PCA.with_settings(policy=LOOSE.policy, window=60, retrain_every=25),
    "folds": LOOSE.with_settings(retrain_every=60, folds=2, max_steps=8),
}
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("local", "full block", "folds")]


def played(store: Any, data: Dataset, recipe: Recipe, **options: Any) -> DataEngine:
    """An engine that has gone through the data, part by part."""
    engine = DataEngine(recipe=recipe, store=store, replaying=True, **options)
    drive(engine, data)
    engine.flush()
    return engine


def said_of(found: Explanation) -> str:
    return " ".join((*found.sentences, *found.notes))


@pytest.mark.parametrize("name", ["pooled", *SLOW])
def test_what_is_counted_again_is_what_was_counted_then_decision_by_decision(name, make_data):
    with played(None, make_data(200, samples=60), RECIPES[name]) as engine:
        balls = 0
        for past in list(engine.history())[::9]:
            explanation = engine.explain(past.decision.id, neighbours=1000)
            assert explanation.decision == past
            bound = explanation.bound
            if bound is not None:
                balls += 1
                near = [item.success for item in explanation.neighbours if item.inside]
                assert (near.count(True), near.count(False)) == (bound.n_success, bound.n_failure)
                threshold = math.inf if bound.accept_threshold is None else bound.accept_threshold
                predicted = past.decision.predicted
                assert (bound.lower >= threshold) == (predicted is Action.ACCEPT), past
        assert balls > 10


def test_the_neighbours_are_the_nearest_others_and_their_labels_are_theirs(make_data):
    once = make_data(120, samples=60)
    rows = np.r_[0:120, 0:60]
    with played(None, Dataset(once.X[rows], once.y[rows]), RECIPES["local"]) as engine:
        (past,) = engine.history(last=1, action="accept")
        explanation, asked = engine.explain(past.decision.id), engine.find(past.decision.id)
        neighbours = explanation.neighbours
        assert neighbours == tuple(sorted(neighbours, key=lambda item: item.distance))
        for item in neighbours:
            stored = engine.find(item.decision_id)
            assert item.inside == (item.distance <= engine.recipe.radius)
            assert item.success == stored.success
            # The same part, which came before, has no vote.
            assert not np.array_equal(stored.trace, asked.trace)
            z = engine.model.predictor.embed(torch.from_numpy(np.array(stored.trace)))
            offset = z[item.space].numpy() - asked.decision.embedding[item.space]
            assert np.linalg.norm(offset) == pytest.approx(item.distance, abs=1e-3)


def test_of_a_version_that_is_not_kept_the_record_is_shown_and_no_neighbours(make_data, tmp_path):
    file = f"{tmp_path}/engine.db"
    with played(file, make_data(100, samples=60), RECIPES["pooled"]) as engine:
        past = next(engine.history(reason="uncertain"))
        assert engine.explain(past.decision.id).neighbours
    execute(file, "UPDATE model_version SET state = NULL")
    with SqlStore(file) as store:
        explanation = explain(store, past.decision.id)
    assert explanation.neighbours == ()
    assert "is not kept any more" in said_of(explanation)
    assert explanation.bound.lower == past.decision.lower  # as recorded
    assert explanation.bound.accept_threshold is None


def test_each_reason_is_explained_by_what_it_rests_on(make_data):
    data = make_data(120, samples=60)
    traces = np.repeat(data.X[:1], 4, axis=0)
    traces[0, 20:40] += 60.0
    traces[1], traces[2, 7], traces[3, 30] = 4.0, np.nan, 200.0
    with played(None, data, RECIPES["local"], trace=TraceSpec(60, limit=200.0)) as engine:
        ids = [engine.decide(x).id for x in traces]
        for reason in ("audit", "no_model"):
            ids += [past.decision.id for past in engine.history(last=1, reason=reason)]
        explanations = [engine.explain(id_) for id_ in ids]
    novelty = explanations[0].novelty
    assert max(asdict(novelty).values()) > 1.0
    words = [
        f"in level {novelty.level:.2f} times the limit",
        "every sample has the same value: a dead sensor",
        "1 of 60 samples are NaN or infinite",
        "the trace touched the sensor's range",
        "the model alone would have",
        "no model had been trained yet",
    ]
    for explanation, text in zip(explanations, words, strict=True):
        assert text in said_of(explanation)


def test_safe_mode_says_why_everything_was_verified():
    data = replace(easy_parts(200, 1, wave=slice(170, 200)), part=None)
    with played(None, data, PCA.with_settings(policy=POOLED)) as engine:
        usual = engine.decide(data.X[0] + np.float32(0.001))
        assert usual.reason is Reason.SAFE_MODE
        assert "an alarm: too many traces were novel" in said_of(engine.explain(usual.id))


def test_a_baseline_has_its_own_numbers_and_no_neighbours(make_data):
    model = make_baseline("never", LOCAL, seed=0)
    with DataEngine(model=model, retrain_every=30, replaying=True) as engine:
        drive(engine, make_data(60, samples=60))
        (past,) = engine.history(last=1, action="accept")
        explanation = engine.explain(past.decision.id)
    assert "NeverVerify gives 0 successes, 0 failures, bound 1.000" in said_of(explanation)
    assert explanation.neighbours == ()
    assert explanation.envelope is not None


def test_an_unknown_id_says_where_the_ids_are():
    with DataEngine("pca") as engine, pytest.raises(ReportError, match="`dengine history STORE`"):
        engine.explain("x")
    with pytest.raises(StoreError, match="Expected a store that an engine has used"):
        explain(SqlStore(), "x")


def test_the_envelope_counts_the_samples_that_leave_it_and_needs_twenty_successes():
    X = np.random.default_rng(0).normal(0.0, 1.0, (200, 2, 50)).astype(np.float32)
    trace = np.median(X, axis=0)
    trace[1, 20:24], trace[0, 40], trace[0, 3] = 6.0, -5.0, np.nan  # a NaN lies nowhere
    result = envelope_of(X, trace)
    assert result.outside == pytest.approx(5 / 100)
    assert ((result.low <= X) & (result.high >= X)).mean() == pytest.approx(0.95, abs=0.01)
    assert envelope_of(X[:19], trace) is None


def test_a_decision_is_explained_by_the_policy_that_was_in_force_when_it_was_made(
    make_data, tmp_path
):
    store = SqlStore(f"{tmp_path}/e.db", clock=count(1).__next__)
    changes = [{"lower_bound": 0.95}, {"shadow": True}, {"alpha": 0.3}]
    with played(store, make_data(120, samples=60), RECIPES["local"]) as engine:
        (past,) = engine.history(last=1, action="accept")
        trace = engine.find(past.decision.id).trace
        policies, ids = [engine.policy], [past.decision.id]
        for change in changes:
            engine.set_policy(replace(engine.policy, **change))
            policies.append(engine.policy)
            ids.append(engine.decide(trace).id)
    with DataEngine.open(tmp_path / "e.db", replaying=True) as engine:
        explanations = [engine.explain(id_) for id_ in ids]
    assert [explanation.policy for explanation in explanations] == policies
    assert [item.bound.accept_threshold for item in explanations[:2]] == [0.9, 0.95]
