"""Correct, forget, roll back, another policy: what counts at once, what is kept, what opening the
store again gives.
"""

import sqlite3
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

from dengine import Action, DataEngine, Dataset, Reason, Recipe
from dengine.errors import SettingError
from dengine.folds import fold_of
from tests.support.driving import RECIPE, Counting, evidence, make
from tests.support.driving import drive as play


class Remembering(Counting):
    """A baseline that holds the labels which it was given."""

    def fit(self, X, y) -> None:
        self.y = np.array(y)

    def add(self, x, y) -> None:
        self.y = np.append(self.y, y)


POOLED = RECIPE.with_policy(guarantee="pooled", stops="all", audit_rate=0.1)
N = 200


def asked(engine: DataEngine, data: Dataset) -> list:
    """What the model says of every trace, without a trace of the asking."""
    return [] if engine.version == 0 else engine.model.predict_many(data.X)


def state(engine: DataEngine) -> tuple:
    """All that decides what an engine does next."""
    stored = engine.store.labels.with_traces(engine.recipe.window)
    rule = engine.model and {name: t.tolist() for name, t in engine.model.rule.state_dict().items()}
    numbers = engine.model and sorted(engine.model.index.column("numbers").tolist())
    return (
        (
            engine.version,
            engine.state.new_labels,
            engine.safe_mode,
            engine.policy,
            engine.certificate(),
            rule,
        ),
        (stored.seq.tolist(), stored.labels.tolist(), numbers),
    )


def again(engine: DataEngine, place: Path, **options) -> DataEngine:
    """An engine opened on a copy of the store, as the first one is now."""
    engine.flush()
    if engine.store.database.is_in_memory:  # in memory, where nobody owns it
        return DataEngine.open(engine.store, replaying=True, **options)
    target = place / f"copy-{len(list(place.iterdir()))}.db"
    with (
        closing(sqlite3.connect(place / "engine.db")) as old,
        closing(sqlite3.connect(target)) as new,
    ):
        old.backup(new)
    return DataEngine.open(target, replaying=True, **options)


def labelled(engine: DataEngine, seq: int) -> str:
    """The id of the decision whose label has this number."""
    return next(past.decision.id for past in engine.history() if past.label_seq == seq)


def break_stop_sensor(engine: DataEngine, data: Dataset) -> list[str]:
    """Every accepted part is stopped, until safe mode begins: their ids."""
    stopped = []
    for x in data.X[data.y == 1]:
        decision = engine.decide(x)
        if decision.action is Action.ACCEPT:
            engine.report(decision.id, False)
            stopped.append(decision.id)
        if engine.safe_mode:
            return stopped
    raise AssertionError("no safe mode began")


def test_a_label_is_corrected_and_forgotten_for_the_very_next_decision_and_comes_back(
    data: Dataset,
) -> None:
    engine = make()
    cycle = next(c for c in reversed(play(engine, data, 0, 150, confirm=True)) if c.success)
    name, probe, n = (
        cycle.decision.id,
        data.X[cycle.index] + np.float32(1e-4),
        len(engine.model.index),
    )
    before, spaces = engine.decide(probe), engine.model.index.column("spaces").copy()
    text = engine.correct(name, False, author="kim")
    after = engine.decide(probe)
    assert (after.n_success, after.n_failure) == (before.n_success - 1, before.n_failure + 1)
    assert (after.embedding, after.model_version) == (before.embedding, before.model_version)
    assert engine.model.index.column("spaces").tolist() == spaces.tolist()
    assert set(spaces) == set(fold_of(engine.model.index.column("parts"), engine.model.n_spaces))
    assert "counts as a failure, was a success" in text.text
    event = engine.store.events.newest(1)[0]
    assert (event.number, event.kind, event.author) == (text.event, "correct", "kim")
    assert event.data == {"decisions": {name: {"was": True, "now": False}}}
    text = engine.forget(name, author="kim", reason="another part lay in the fixture")
    after = engine.decide(probe)
    assert (after.n_success, after.n_failure) == (before.n_success - 1, before.n_failure)
    assert len(engine.model.index) == n - 1
    assert text.text == f"The label of {name} is forgotten: another part lay in the fixture."
    assert engine.store.decisions.get(name).trace.shape == (1, data.X.shape[1])
    engine.correct(name, True)
    assert evidence(engine.decide(probe)) == evidence(before)


def test_what_is_forgotten_trains_nothing_any_more_and_what_is_corrected_trains_as_it_is_now(
    data: Dataset,
) -> None:
    engine = make()
    cycles = play(engine, data, 0, 1)
    engine.correct(cycles[0].decision.id, not cycles[0].success)  # before there is a model
    cycles += play(engine, data, 1, 100, confirm=True)
    assert engine.store.versions.load(1).state["labels"][0] == (not cycles[0].success)
    engine.forget(*(c.decision.id for c in cycles[:5]))
    engine.correct(cycles[5].decision.id, not cycles[5].success)
    engine.retrain()
    trained = engine.store.versions.newest().state
    assert trained["trained_on"].tolist() == list(range(6, 101))
    assert trained["labels"][0] == (not cycles[5].success)


def test_the_rule_is_told_again_and_safe_mode_follows_the_labels_as_they_are_now(
    data: Dataset,
) -> None:
    engine = make(RECIPE.with_policy(stops="all"))
    play(engine, data, 0, 120, confirm=True)
    engine.forget(*break_stop_sensor(engine, data), reason="the stop sensor was broken")
    assert engine.safe_mode == ""
    assert [e.kind for e in engine.store.events.newest(3)] == [
        "safe mode",
        "forget",
        "safe mode ended",
    ]


def test_forgetting_never_makes_the_certificate_better(data: Dataset) -> None:
    engine = make(RECIPE.with_policy(stops="all"))
    cycles = play(engine, data, confirm=True)
    stopped = []
    for x in data.X[np.flatnonzero(data.y == 1)][:3]:
        stopped.append(engine.decide(x))
        engine.report(stopped[-1].id, False)
    assert {decision.action for decision in stopped} == {Action.ACCEPT}
    before = engine.certificate().accepted
    engine.forget(stopped[0].id)
    assert engine.certificate().accepted == before
    engine.forget(next(c.decision.id for c in cycles if c.decision.action is Action.ACCEPT))
    assert engine.certificate().accepted.upper > before.upper
    engine.correct(stopped[1].id, True)
    assert engine.certificate().accepted.n_bad == before.n_bad


def test_a_part_that_came_twice_is_corrected_where_it_was_meant(data: Dataset) -> None:
    engine = make()
    play(engine, data, 0, 80, confirm=True)
    twice = [engine.decide(data.X[150], part="SN-1") for _ in range(2)]
    engine.report(twice[0].id, True)
    engine.report(twice[1].id, True)
    engine.correct(twice[0].id, False)
    assert engine.model.index.column("labels")[-2:].tolist() == [0, 1]
    engine.forget(twice[1].id)
    assert engine.model.index.column("labels")[-1] == 0
    assert int(engine.model.index.repeats) == 0


def test_a_full_ring_loses_the_forgotten_reference_and_keeps_the_age_of_the_others(
    tmp_path: Path, data: Dataset
) -> None:
    engine = make(replace(RECIPE, window=60), store=tmp_path / "engine.db")
    play(engine, data, 0, 130, confirm=True)
    oldest = int(engine.store.labels.with_traces(60).seq[0])
    engine.forget(labelled(engine, oldest + 10), labelled(engine, oldest + 20))
    play(engine, data, 130, 139, confirm=True)
    with again(engine, tmp_path) as reopened:
        assert asked(reopened, data) == asked(engine, data)
        np.testing.assert_array_equal(
            reopened.model.index.column("points"), engine.model.index.column("points")
        )
        assert state(reopened) == state(engine)


KINDS = {
    "play": st.integers(5, 45),
    **dict.fromkeys(("correct", "forget", "rollback"), st.integers(0, 10_000)),
    "lower_bound": st.sampled_from([0.85, 0.9, 0.95]),
    "audit_rate": st.sampled_from([0.02, 0.2]),
    "stops": st.sampled_from(["some", "all"]),
}
STEPS = st.lists(
    st.one_of(*(st.tuples(st.just(kind), of) for kind, of in KINDS.items())), min_size=2, max_size=8
)


def step(engine: DataEngine, data: Dataset, kind: str, value) -> None:
    n = engine.store.decisions.counts()["labels"] + engine.store.decisions.counts()["forgotten"]
    if kind == "play":
        start = engine.store.decisions.counts()["decisions"]
        play(engine, data, start, start + value)
    elif kind in ("correct", "forget") and n:
        name = labelled(engine, 1 + value % n)
        engine.forget(name) if kind == "forget" else engine.correct(name, value % 3 != 0)
    elif kind == "rollback":
        kept = sorted(r.version for r in engine.store.versions.retrains() if r.accepted)[-5:]
        if kept:
            engine.rollback(kept[value % len(kept)])
    elif kind in ("lower_bound", "audit_rate", "stops"):
        engine.set_policy(replace(engine.policy, **{kind: value}))


@pytest.mark.parametrize(
    "recipe", [pytest.param(RECIPE, marks=pytest.mark.slow), POOLED], ids=["local", "pooled"]
)
@settings(max_examples=3, deadline=None, suppress_health_check=list(HealthCheck))
@given(steps=STEPS)
def test_an_engine_that_is_opened_again_goes_on_as_the_one_that_went_on(
    recipe, steps, make_data, tmp_path_factory
) -> None:
    data, place = make_data(480, seed=3), tmp_path_factory.mktemp("again")
    with make(recipe, store=place / "engine.db") as engine:
        play(engine, data, 0, 90)
        for item in steps:
            step(engine, data, *item)
        start = engine.store.decisions.counts()["decisions"]
        with again(engine, place) as reopened:
            assert asked(reopened, data) == asked(engine, data)
            assert state(reopened) == state(engine)
            rest = (start, start + 45)
            first, second = (play(item, data, *rest) for item in (engine, reopened))
            assert [evidence(c.decision) for c in first] == [evidence(c.decision) for c in second]
            assert state(reopened) == state(engine)


def test_a_late_stop_leaves_the_same_references_as_a_reopened_engine_has(data: Dataset) -> None:
    engine = make(RECIPE.with_policy(stops="all"))
    play(engine, data, 0, 120, confirm=True)
    accepted = [d for d in (engine.decide(x) for x in data.X[120:150]) if d.action is Action.ACCEPT]
    engine.report(accepted[3].id, False)
    engine.poll()
    reopened = again(engine, Path())
    assert asked(reopened, data) == asked(engine, data)


def test_a_transformer_that_is_fitted_again_is_fitted_on_what_it_saw(data: Dataset) -> None:
    """Its labels are corrected and forgotten afterwards; its places, and its references, stay where
    they were.
    """
    custom = LinearDiscriminantAnalysis()
    engine = DataEngine(custom, RECIPE.policy, retrain_every=40, replaying=True)
    cycles = play(engine, data, 0, 90, confirm=True)
    engine.correct(cycles[3].decision.id, not cycles[3].success)
    engine.forget(cycles[4].decision.id, cycles[5].decision.id)
    reopened = DataEngine.open(engine.store, reducer=custom, replaying=True)
    assert asked(reopened, data) == asked(engine, data)
    first = engine.store.versions.retrains()[0].version
    engine.rollback(first)
    reopened = DataEngine.open(engine.store, reducer=custom, replaying=True)
    assert asked(reopened, data) == asked(engine, data)


def test_an_earlier_version_answers_again_as_a_new_one_with_what_came_since(data: Dataset) -> None:
    engine = make()
    cycles = play(engine, data, 0, 100, confirm=True)
    engine.correct(cycles[0].decision.id, not cycles[0].success)
    old, number, version = engine.model.spaces, engine.version - 1, engine.version
    text = engine.rollback(number, author="kim")
    assert (engine.version, text.version, text.kind) == (version + 1, version + 1, "rollback")
    assert engine.store.versions.retrains()[-1].reason == f"rolled back to version {number}"
    assert engine.store.events.newest(1)[0].data == {
        "to": number,
        "was": version,
        "now": version + 1,
    }
    assert engine.model.spaces is not old
    assert len(engine.model.index) == len(engine.store.labels.with_traces().seq)
    assert engine.state.new_labels == 0
    assert engine.decide(data.X[199]).model_version == version + 1
    first = engine.store.versions.load(number).state
    np.testing.assert_array_equal(engine.model.get_state()["scale"], first["scale"])
    np.testing.assert_array_equal(
        engine.model.index.column("points")[: first["points"].shape[1]], first["points"].T
    )
    assert engine.model.index.column("labels")[0] == (
        not cycles[0].success
    )  # as it was corrected since


@pytest.mark.parametrize("end", ["release", "retrain", "forget"])
def test_a_version_that_was_rolled_back_to_stays_until_somebody_ends_that(
    end: str, data: Dataset, tmp_path: Path
) -> None:
    with make(store=tmp_path / "engine.db") as made:
        cycles = play(made, data, 0, 100, confirm=True)
        made.rollback(1, author="kim")
        pinned, n = made.version, len(made.model.index)
        play(made, data, 100, 130, confirm=True)
    with DataEngine.open(tmp_path / "engine.db", replaying=True) as engine:
        cycles += play(engine, data, 130, 190, confirm=True)
        assert (engine.version, engine.state.new_labels) == (pinned, len(engine.model.index) - n)
        assert engine.state.new_labels > 2 * RECIPE.retrain_every
        unseen = next(c for c in cycles[::-1] if c.success is not None).decision.id
        assert "pinned" not in engine.forget(unseen).text  # the version was not trained with it
        engine.set_policy(replace(engine.policy, lower_bound=0.85))
        play(engine, data, 190, 200, confirm=True)
        assert (engine.version, engine.status().pinned) == (pinned + 1, 1)
        if end == "retrain":
            assert engine.retrain().version == pinned + 3  # after the version that is released
        else:
            change = engine.forget(cycles[0].decision.id) if end == "forget" else engine.release()
            assert "is pinned no more" in change.text.replace("which learned from this, ", "")
            assert engine.poll() is not None  # that is due
            assert engine.version == pinned + 3
        assert engine.status().pinned == 0


@pytest.mark.parametrize(
    ("part", "start", "reopens"),
    [(5, "from initial weights", True), (45, "from version 1", False)],
    ids=["first", "later"],
)
def test_after_forgetting_a_label_the_weights_are_as_if_it_had_been_another(
    part: int, start: str, reopens: bool, make_data, tmp_path: Path
) -> None:
    data = make_data(80)
    policy = replace(RECIPE.policy, alpha=0.001, lower_bound=0.999)  # that verifies them all
    recipe = replace(Recipe.load("conv"), policy=policy, retrain_every=30, max_steps=5, folds=2)
    predicted = []
    for label in (True, False):
        (place := tmp_path / str(label)).mkdir()
        with make(recipe, store=place / "engine.db") as engine:
            ids = [engine.decide(x).id for x in data.X[:62]]
            for i, id_ in enumerate(ids):
                engine.report(id_, label if i == part else bool(data.y[i]))
            assert engine.version == 2
            engine.forget(ids[part])
            with again(engine, place) if reopens else nullcontext(engine) as going:
                assert start in going.retrain().reason
                predicted.append(asked(going, data))
                corrected = ids[part - 1]
                going.correct(corrected, not going.find(corrected).success)
                assert "from" not in going.retrain().reason  # it goes on from its weights
    assert predicted[0] == predicted[1]


def test_a_baseline_is_trained_anew_at_once_and_goes_back_to_traces_as_they_are_labelled_now(
    data: Dataset,
) -> None:
    engine = DataEngine(model=Remembering(), retrain_every=40, replaying=True)
    cycles = play(engine, data, 0, 90, confirm=True)
    version = engine.version
    engine.correct(cycles[2].decision.id, not cycles[2].success)
    assert engine.version == version + 1
    engine.forget(cycles[11].decision.id)
    assert engine.model.y.tolist() == engine.store.labels.with_traces().labels.tolist()
    engine.rollback(1)
    assert engine.model.y.tolist() == engine.store.labels.with_traces().labels.tolist()
    again_ = DataEngine.open(engine.store, model=Remembering(), replaying=True)
    assert again_.model.y.tolist() == engine.model.y.tolist()
    with pytest.raises(SettingError, match="alpha would have no effect"):
        engine.set_policy(replace(engine.policy, alpha=0.2))
    engine.set_policy(
        replace(engine.policy, audit_rate=0.5, stops="all")
    )  # what the engine does itself
    assert engine.policy.audit_rate == 0.5


def test_the_audit_rate_alone_leaves_the_local_rule_as_it_is(data: Dataset) -> None:
    engine = make(POOLED.with_policy(guarantee="local"))
    play(engine, data, 0, 170)
    rule = engine.model.rule
    totals = rule.evidence.level_totals.clone()
    engine.set_policy(replace(engine.policy, audit_rate=0.9))
    assert engine.model.rule is rule
    assert (rule.evidence.level_totals == totals).all()
    looked = [engine.decide(x) for x in data.X[170:] if not engine.safe_mode]
    certain = [d for d in looked if d.predicted is not Action.VERIFY]
    assert sum(d.audit for d in certain) > 0.6 * len(certain) > 0
    assert {d.propensity for d in certain} == {0.9}
    engine.set_policy(
        replace(engine.policy, lower_bound=0.85)
    )  # of which the certificate speaks from now on
    assert (engine.certificate().accepted.n, engine.certificate().tolerance) == (
        0,
        pytest.approx(0.15),
    )
    assert int(engine.model.rule.evidence.level_totals.sum()) == 0


def test_safe_mode_outlasts_a_change_of_policy_until_fresh_evidence(
    tmp_path: Path, data: Dataset
) -> None:
    engine = make(RECIPE.with_policy(stops="all"), store=tmp_path / "engine.db")
    play(engine, data, 0, 120, confirm=True)
    stopped = break_stop_sensor(engine, data)
    why = engine.safe_mode
    engine.set_policy(replace(engine.policy, lower_bound=0.85))
    assert engine.safe_mode == why
    assert engine.decide(data.X[160]).reason in (Reason.SAFE_MODE, Reason.NOVEL)
    with again(engine, tmp_path) as reopened:
        assert reopened.safe_mode == why
    engine.correct(stopped[-1], True)  # told anew: it still began in safe mode
    assert engine.safe_mode == why
    engine.set_policy(replace(engine.policy, stops="some"))  # the paper's rule has no safe mode
    assert (engine.safe_mode, engine.store.events.newest(1)[0].text) == (
        "",
        "the rule of the new policy has no safe mode",
    )


def test_silence_under_an_earlier_policy_never_becomes_a_success(data: Dataset) -> None:
    engine = make()
    play(engine, data, 0, 150)
    silent = len(engine.store.decisions.unreported_accepts())
    assert silent > 5
    engine.set_policy(replace(engine.policy, stops="all"))
    reopened = DataEngine.open(engine.store, replaying=True)
    for item in (engine, reopened):
        item.decide(data.X[160])
        item.decide(data.X[161])
        item.flush()
        assert len(item.store.decisions.unreported_accepts()) >= silent
