"""Correct, forget, roll back, another policy: what counts at once, what is kept, what opening the
store again gives. That each count is the recount is in test_histories.py.
"""

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

from dengine import Action, DataEngine, Dataset, Reason, Recipe
from dengine.errors import SettingError, StoreError
from tests.support.driving import RECIPE, Counting, evidence, make, rule_state
from tests.support.driving import drive as play


class Remembering(Counting):
    """A baseline that holds the labels which it was given."""

    def fit(self, X, y):
        self.y = np.array(y)

    def add(self, x, y):
        self.y = np.append(self.y, y)


POOLED = RECIPE.with_policy(guarantee="pooled", stops="all", audit_rate=0.1)


def asked(engine: DataEngine, data: Dataset) -> list:
    """What the model says of every third trace, without a trace of the asking."""
    return engine.model.predict_many(data.X[::3])


def state(engine: DataEngine) -> tuple:
    """All that decides what an engine does next."""
    stored = engine.store.labels.with_traces(engine.recipe.window)
    return (
        (engine.version, engine.state.new_labels, engine.safe_mode, engine.policy),
        engine.certificate(),
        rule_state(engine),
        (stored.seq.tolist(), stored.labels.tolist()),
        sorted(engine.model.index.column("numbers").tolist()),
    )


def again(engine: DataEngine, **options) -> DataEngine:
    """An engine opened on a copy of the store, as the first one is now."""
    engine.flush()
    if engine.store.database.is_in_memory:  # in memory, where nobody owns it
        return DataEngine.open(engine.store, replaying=True, **options)
    place = Path(engine.store.database.url.database)
    target = place.with_name(f"copy-{len(list(place.parent.iterdir()))}.db")
    with closing(sqlite3.connect(place)) as old, closing(sqlite3.connect(target)) as new:
        old.backup(new)
    return DataEngine.open(target, replaying=True, **options)


def break_stop_sensor(engine: DataEngine, data: Dataset) -> list[str]:
    """Every accepted part is stopped, until safe mode begins: their ids."""
    stopped, good = [], iter(data.X[data.y == 1])
    while not engine.safe_mode:
        decision = engine.decide(next(good))
        if decision.action is Action.ACCEPT:
            engine.report(decision.id, False)
            stopped.append(decision.id)
    return stopped


def test_forgetting_never_makes_the_certificate_better(data):
    engine = make(RECIPE.with_policy(stops="all"))
    cycles = play(engine, data, confirm=True)
    stopped = [engine.decide(x) for x in data.X[data.y == 1][:3]]
    for decision in stopped:
        assert decision.action is Action.ACCEPT
        engine.report(decision.id, False)
    before = engine.certificate().accepted
    engine.forget(stopped[0].id)
    assert engine.certificate().accepted == before
    engine.forget(next(c.decision.id for c in cycles if c.decision.action is Action.ACCEPT))
    assert engine.certificate().accepted.upper > before.upper
    engine.correct(stopped[1].id, True)
    assert engine.certificate().accepted.n_bad == before.n_bad


@pytest.mark.parametrize("recipe", [RECIPE, replace(POOLED, window=60)], ids=["local", "pooled"])
def test_an_engine_that_is_opened_again_goes_on_as_the_one_that_went_on(
    recipe, make_data, tmp_path
):
    data = make_data(300, seed=3)
    with make(recipe, store=tmp_path / "engine.db") as engine:
        ids = [c.decision.id for c in play(engine, data, 0, 90) if c.success is not None]
        engine.correct(ids[3], True)
        engine.forget(ids[7], ids[-9])  # from a full window, too
        engine.set_policy(replace(engine.policy, lower_bound=0.85, audit_rate=0.2))
        play(engine, data, 90, 150)
        engine.rollback(1)
        engine.correct(ids[9], False)
        engine.set_policy(replace(engine.policy, stops="all"))
        play(engine, data, 150, 170)
        accepted = [d for d in map(engine.decide, data.X[170:200]) if d.action is Action.ACCEPT]
        engine.report(accepted[3].id, False)  # a late stop
        engine.poll()
        with again(engine) as reopened:
            for _ in range(2):
                assert asked(reopened, data) == asked(engine, data)
                points = [item.model.index.column("points") for item in (reopened, engine)]
                np.testing.assert_array_equal(*points)
                assert state(reopened) == state(engine)
                first, second = (play(item, data, 200, 245) for item in (engine, reopened))
                for c, other in zip(first, second, strict=True):
                    assert evidence(c.decision) == evidence(other.decision)


def test_a_transformer_that_is_fitted_again_is_fitted_on_what_it_saw(data):
    """Its labels are corrected and forgotten afterwards; its references stay where they were."""
    custom = LinearDiscriminantAnalysis()
    engine = DataEngine(custom, RECIPE.policy, retrain_every=20, replaying=True)
    first, *others = (c.decision.id for c in play(engine, data, 0, 50, confirm=True))
    engine.correct(first, not engine.find(first).success)
    engine.forget(*others[:2])
    assert asked(again(engine, reducer=custom), data) == asked(engine, data)
    engine.rollback(1)
    assert asked(again(engine, reducer=custom), data) == asked(engine, data)


def test_after_forgetting_a_label_the_weights_are_as_if_it_had_been_another(data, tmp_path):
    policy = replace(RECIPE.policy, alpha=0.001, lower_bound=0.999)  # that verifies them all
    recipe = Recipe("rocket", {"kernels": 6, "width": 8}, policy=policy, retrain_every=30)
    predicted = []
    for label in (True, False):
        with make(recipe, store=tmp_path / f"{label}.db") as engine:
            ids = [engine.decide(x).id for x in data.X[:62]]
            for i, id_ in enumerate(ids):
                engine.report(id_, label if i == 45 else bool(data.y[i]))
            engine.forget(ids[45])
            with again(engine) as reopened:
                assert "from version 1" in reopened.retrain().reason
                predicted.append(asked(reopened, data))
                reopened.correct(ids[44], not data.y[44])
                assert "from" not in reopened.retrain().reason  # it goes on from its weights
    assert predicted[0] == predicted[1]


def test_a_baseline_is_trained_anew_at_once_and_goes_back_to_traces_as_they_are_labelled_now(
    data,
):
    engine = DataEngine(model=Remembering(), retrain_every=40, replaying=True)
    cycles = play(engine, data, 0, 90, confirm=True)
    wrong, version = cycles[2], engine.version
    engine.correct(wrong.decision.id, not wrong.success)
    assert engine.version == version + 1
    for change in (lambda: engine.forget(cycles[11].decision.id), lambda: engine.rollback(1)):
        change()
        assert engine.model.y.tolist() == engine.store.labels.with_traces().labels.tolist()
    change = engine.correct(wrong.decision.id, wrong.success)  # its refit is an event, too
    kinds = {event.number: event.kind for event in engine.store.events.newest()}
    assert kinds[change.event] == change.kind == "correct"
    with pytest.raises(SettingError, match="alpha would have no effect"):
        engine.set_policy(replace(engine.policy, alpha=0.2))
    engine.set_policy(replace(engine.policy, audit_rate=0.5, stops="all"))  # the engine's own
    assert engine.policy.audit_rate == 0.5


def test_a_retrain_that_a_correction_needs_waits_for_the_store(data):
    engine = make()
    first, second, *_ = play(engine, data, 0, 60)
    engine.store.labels.outcomes_since = Mock(side_effect=[StoreError("gone"), []])
    engine.model.change_reference = Mock(side_effect=[False, True])
    with pytest.raises(StoreError):
        engine.forget(first.decision.id)
    engine.forget(second.decision.id)
    assert engine.version == 2


def test_the_audit_rate_alone_leaves_the_local_rule_as_it_is(data):
    engine = make(POOLED.with_policy(guarantee="local"))
    play(engine, data, 0, 170)
    rule, totals = engine.model.rule, engine.model.rule.evidence.level_totals.clone()
    engine.set_policy(replace(engine.policy, audit_rate=0.9))
    assert engine.model.rule is rule
    assert (rule.evidence.level_totals == totals).all()
    looked = [engine.decide(x) for x in data.X[170:] if not engine.safe_mode]
    certain = [d for d in looked if d.predicted is not Action.VERIFY]
    assert sum(d.audit for d in certain) > 0.6 * len(certain) > 0
    assert {d.propensity for d in certain} == {0.9}
    engine.set_policy(replace(engine.policy, lower_bound=0.85))
    certificate = engine.certificate()  # it speaks of the new bound from now on
    assert (certificate.accepted.n, certificate.tolerance) == (0, pytest.approx(0.15))
    assert int(engine.model.rule.evidence.level_totals.sum()) == 0


def test_another_audit_rate_begins_a_pooled_rule_of_a_user_anew(data):
    own = "dengine.decision.member_rules:PooledRule"
    engine = make(POOLED.with_policy(guarantee=own, stops="some"))
    play(engine, data, 0, 60)
    engine.set_policy(replace(engine.policy, audit_rate=0.5))
    assert engine.model.rule.evidence.inclusion_probability == 0.5


def test_safe_mode_outlasts_a_change_of_policy_and_ends_by_the_labels_as_they_are_now(
    tmp_path, data
):
    engine = make(RECIPE.with_policy(stops="all"), store=tmp_path / "engine.db")
    play(engine, data, 0, 120, confirm=True)
    stopped = break_stop_sensor(engine, data)
    with again(engine) as other:
        other.forget(*stopped)
        assert other.safe_mode == ""
        assert [e.kind for e in other.store.events.newest(2)] == ["forget", "safe mode ended"]
    why = engine.safe_mode
    engine.set_policy(replace(engine.policy, lower_bound=0.85))
    assert engine.safe_mode == why
    assert engine.decide(data.X[160]).reason in (Reason.SAFE_MODE, Reason.NOVEL)
    with again(engine) as reopened:
        assert reopened.safe_mode == why
    engine.correct(stopped[-1], True)  # told anew: it still began in safe mode
    assert engine.safe_mode == why
    engine.set_policy(replace(engine.policy, stops="some"))  # the paper's rule has no safe mode
    assert engine.safe_mode == ""
    assert engine.store.events.newest(1)[0].text == "the rule of the new policy has no safe mode"


def test_silence_under_an_earlier_policy_never_becomes_a_success(data):
    engine = make()
    play(engine, data, 0, 150)
    silent = len(engine.store.decisions.unreported_accepts())
    assert silent > 5
    engine.set_policy(replace(engine.policy, stops="all"))
    for item in (engine, again(engine)):
        item.decide(data.X[160])
        item.decide(data.X[161])
        item.flush()
        assert len(item.store.decisions.unreported_accepts()) >= silent
