"""Why a decision came out so: what is found again is what was counted, and what is said is true."""

import json
import re
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dengine import Action, DataEngine, Dataset, Policy, Reason, Recipe, SqlStore, TraceSpec
from dengine.errors import ReportError, StoreError
from dengine.history.envelope import envelope_of
from dengine.history.explain import Explanation, explain
from dengine.history.sentences import WHY
from dengine.representation import to_jsonable
from tests.support.driving import Counting, drive, easy_parts
from tests.support.stores import execute

LOCAL = Policy(alpha=0.1, lower_bound=0.9, audit_rate=0.1)
POOLED = replace(LOCAL, guarantee="pooled", stops="all")
RECIPES = {
    "local": Recipe.load("pca").with_settings(policy=LOCAL, retrain_every=40),
    "watched": Recipe.load("pca").with_settings(
        policy=replace(LOCAL, stops="all"), retrain_every=40
    ),
    "pooled": Recipe.load("pca").with_settings(policy=POOLED, retrain_every=40),
    "full block": replace(
        Recipe.load("pca").with_policy(alpha=0.2, lower_bound=0.8), window=60, retrain_every=25
    ),
    "folds": replace(
        Recipe.load("conv").with_policy(alpha=0.2, lower_bound=0.8),
        retrain_every=60,
        folds=2,
        max_steps=8,
    ),
}


def played(
    store: SqlStore | Path | None, data: Dataset, recipe: Recipe, **options: Any
) -> DataEngine:
    """An engine that has gone through the data, part by part; a folder: with a file in it."""
    file = store / "engine.db" if isinstance(store, Path) else store
    engine = DataEngine(recipe=recipe, store=file, replaying=True, **options)
    drive(engine, data)
    engine.flush()
    return engine


def said_of(found: Explanation) -> str:
    return " ".join((*found.sentences, *found.notes))


SLOW = [
    pytest.param(name, marks=pytest.mark.slow)
    for name in RECIPES
    if name not in ("local", "pooled")
]  # 10 s each


@pytest.mark.parametrize("name", ["local", "pooled", *SLOW])
def test_what_is_counted_again_is_what_was_counted_then_decision_by_decision(
    name: str, make_data, tmp_path: Path
) -> None:
    data = make_data(200, samples=60)
    with played(tmp_path, data, RECIPES[name]) as engine:
        balls = 0
        for past in list(engine.history())[::6]:
            explanation = engine.explain(past.decision.id, neighbours=1000)
            assert explanation.decision == past
            bound = explanation.bound
            if bound is not None:
                balls += 1
                near = [item.success for item in explanation.neighbours if item.inside]
                assert (near.count(True), near.count(False)) == (bound.n_success, bound.n_failure)
                accepted = (
                    bound.accept_threshold is not None and bound.lower >= bound.accept_threshold
                )
                assert accepted == (past.decision.predicted is Action.ACCEPT), past
        assert balls > 15


def test_the_neighbours_are_the_nearest_others_and_their_labels_are_theirs(
    store: SqlStore, make_data
) -> None:
    once = make_data(120, samples=60)
    rows = np.r_[0:120, 0:60]
    with played(store, Dataset(once.X[rows], once.y[rows]), RECIPES["local"]) as engine:
        (past,) = engine.history(last=1, action="accept")
        explanation = engine.explain(past.decision.id, neighbours=15)
        distances = [item.distance for item in explanation.neighbours]
        assert distances == sorted(distances)
        assert explanation.radius == pytest.approx(engine.recipe.radius)
        asked = engine.store.decisions.get(past.decision.id)
        for item in explanation.neighbours:
            stored = engine.store.decisions.get(item.decision_id)
            assert item.inside == (item.distance <= explanation.radius)
            assert (stored.success, stored.source) == (item.success, item.source)
            # The same part, which came before, has no vote.
            assert stored.content_hash != asked.content_hash
            np.testing.assert_array_equal(item.trace, stored.trace)
            z = engine.model.predictor.embed(torch.from_numpy(np.array(stored.trace)))
            offset = z[item.space].numpy() - asked.decision.embedding[item.space]
            assert np.linalg.norm(offset) == pytest.approx(item.distance, abs=1e-3)


def test_of_a_version_that_is_not_kept_the_record_is_shown_and_no_neighbours(
    make_data, tmp_path: Path
) -> None:
    with played(tmp_path, make_data(200, samples=60), RECIPES["pooled"]) as engine:
        created = (past.decision for past in engine.history())
        old = next(
            item for item in created if item.model_version == 1 and item.reason is Reason.UNCERTAIN
        )
        first = engine.explain(old.id)
        assert "the references of version 1" in said_of(first)
    execute(tmp_path / "engine.db", "UPDATE model_version SET state = NULL WHERE version = 1")
    with SqlStore(str(tmp_path / "engine.db")) as store:
        again = explain(store, old.id)
    assert again.neighbours == () != first.neighbours
    assert "version 1, which answered, is not kept any more" in said_of(again)
    assert again.decision == first.decision
    assert (again.bound.n_success, again.bound.lower) == (
        first.bound.n_success,
        first.bound.lower,
    )  # as recorded
    assert (again.bound.accept_threshold, again.bound.reject_threshold) == (None, None)
    assert "the thresholds of that time are not kept" in said_of(again)


def test_each_reason_is_explained_by_what_it_rests_on(
    make_data: Callable[..., Dataset], tmp_path: Path
) -> None:
    data = make_data(260, samples=60)
    spec = TraceSpec(60, rate_hz=500.0, limit=200.0, unit="Nm")
    bump, dead, torn, loud = (np.array(data.X[0]) for _ in range(4))
    bump[20:40] += 60.0
    dead[:], torn[7], loud[30] = 4.0, np.nan, 200.0
    with played(tmp_path, data, RECIPES["local"], trace=spec) as engine:
        ids = {
            "novel": engine.decide(bump).id,
            "constant": engine.decide(dead).id,
            "not_finite": engine.decide(torn).id,
            "saturated": engine.decide(loud).id,
            "audit": next(iter(engine.history(last=1, reason="audit"))).decision.id,
            "no_model": next(iter(engine.history())).decision.id,
        }
        explained = {reason: engine.explain(id_) for reason, id_ in ids.items()}
    novel = explained["novel"]
    assert (novel.decision.decision.reason, novel.bound) == (Reason.NOVEL, None)
    assert max(asdict(novel.novelty).values()) > 1.0
    for reason, words in {
        "novel": [f"in level {novel.novelty.level:.2f} times the limit"],
        "constant": ["every sample has the same value: a dead sensor", "The trace is quarantined"],
        "not_finite": ["1 of 60 samples are NaN or infinite", "The trace is quarantined"],
        "saturated": ["the trace touched the sensor's range", "The trace is quarantined"],
        "audit": ["the model alone would have"],
        "no_model": ["no model had been trained yet", "the trace was not embedded"],
    }.items():
        text = said_of(explained[reason])
        assert [item for item in words if item not in text] == [], text


@pytest.mark.parametrize("size", [3.4e38, 1e18, 1e-30, 1e-45, np.nan, np.inf])
def test_a_trace_of_any_numbers_is_explained_as_json_has_it(size: float, make_data) -> None:
    x = make_data(1, 60).X[0]
    with DataEngine("pca") as engine:
        for trace in (np.where(np.arange(60) == 7, -size, x), np.resize([size, -size], 60)):
            trace[9] = size
            explanation = engine.explain(engine.decide(trace.astype(np.float32)).id)
            json.dumps(to_jsonable(explanation), allow_nan=False)


def test_safe_mode_says_why_everything_was_verified(tmp_path: Path) -> None:
    data = replace(easy_parts(330, 1, wave=slice(300, 330)), part=None)
    policy = Policy(alpha=0.2, lower_bound=0.8, guarantee="pooled", stops="all")
    with played(tmp_path, data, Recipe.load("pca").with_settings(policy=policy)) as engine:
        assert engine.safe_mode == "too many traces were novel"
        usual = engine.decide(data.X[0] + np.float32(0.001))
        assert usual.reason is Reason.SAFE_MODE
        explanation = engine.explain(usual.id)
        assert "in safe mode, which began after an alarm: too many traces were novel" in said_of(
            explanation
        )
        assert "Nothing could pass, whatever the bound: too many traces were novel" in said_of(
            explanation
        )
        before = next(past for past in engine.history() if past.decision.reason is Reason.CERTAIN)
        assert "safe mode" not in said_of(engine.explain(before.decision.id))


def test_a_baseline_has_its_own_numbers_and_no_neighbours(
    make_data: Callable[..., Dataset], tmp_path: Path
) -> None:
    class Accepting(Counting):
        def predict_interval(self, X: Any) -> tuple[Any, Any]:
            return np.full(len(X), 0.8), np.full(len(X), 1.0)

        def decide(self, X: Any) -> Any:
            return np.full(len(X), Action.ACCEPT, dtype=object)

    with DataEngine(
        model=Accepting(), store=str(tmp_path / "engine.db"), retrain_every=30, replaying=True
    ) as engine:
        drive(engine, make_data(60, samples=60))
        (past,) = engine.history(last=1, action="accept")
        explanation = engine.explain(past.decision.id)
        assert re.search(
            r"Accepting gives 30 successes, \d failures, bound 0.800 to 1.000", said_of(explanation)
        )
        assert explanation.neighbours == ()
        assert explanation.envelope is not None


def test_an_unknown_id_says_where_the_ids_are(make_data: Callable[..., Dataset]) -> None:
    with DataEngine("pca") as engine:
        engine.decide(np.arange(30.0))
        with pytest.raises(
            ReportError, match=r"got 'x', which is unknown; `dengine history STORE` lists"
        ):
            engine.explain("x")
    with pytest.raises(StoreError, match="Expected a store that an engine has used"):
        explain(SqlStore(), "x")
    assert set(WHY) == set(Reason)


def test_the_envelope_counts_the_samples_that_leave_it_and_needs_twenty_successes() -> None:
    X = np.random.default_rng(0).normal(0.0, 1.0, (200, 2, 50)).astype(np.float32)
    trace = np.median(X, axis=0)
    trace[1, 20:25], trace[0, 40], trace[0, 3] = 6.0, -5.0, np.nan  # a NaN lies nowhere
    result = envelope_of(X, trace)
    assert result.outside == pytest.approx(6 / 100)
    share_inside = ((result.low <= X) & (result.high >= X)).mean()
    assert share_inside == pytest.approx(0.95, abs=0.01)
    assert envelope_of(X[:19], trace) is envelope_of(X, trace[:, :49]) is None


def test_a_decision_is_explained_by_the_policy_that_was_in_force_when_it_was_made(
    make_data, tmp_path: Path
) -> None:
    times = iter(np.arange(1e6) + 1e9)
    data, window = make_data(160, samples=60), "0:0.1:-1000:1000"
    engine = played(
        SqlStore(str(tmp_path / "e.db"), clock=lambda: float(next(times))),
        data,
        RECIPES["local"],
        trace=TraceSpec(60, rate_hz=500.0),
    )
    (past,) = engine.history(last=1, action="accept")
    trace, policies, ids = engine.find(past.decision.id).trace, [engine.policy], [past.decision.id]
    changes = [
        {"lower_bound": 0.95},
        {"shadow": True},
        {"shadow": False, "force_limits": (window,)},
        {"alpha": 0.3},
    ]
    for change in changes:
        engine.set_policy(replace(engine.policy, **change))
        policies.append(engine.policy)
        ids.append(engine.decide(trace).id)
    engine.close()
    with DataEngine.open(tmp_path / "e.db", replaying=True) as engine:
        assert [engine.explain(id_).policy for id_ in ids] == policies
        first = engine.explain(ids[0])
        assert first.bound.accept_threshold == 0.9
        assert "lower must be at least 0.9 (" in said_of(first)
        assert engine.explain(ids[1]).bound.accept_threshold == 0.95
