"""What becomes of parts: silence, confirmation, late stops, safe mode, parts that come twice, the
certificate.
"""

import time
from dataclasses import replace
from itertools import takewhile
from unittest.mock import Mock

import numpy as np
import pytest

from dengine import (
    Action,
    DataEngine,
    Dataset,
    Decision,
    Policy,
    Reason,
    Recipe,
    ReplayCell,
    Source,
    load_dataset,
)
from dengine.decision.certificate import Outcomes
from dengine.engine import feedback
from dengine.errors import ReportError, StoreError
from dengine.folds import part_hash
from dengine.history.status import status
from dengine.model.neighbours import repeats_note
from dengine.store.records import Change, NewLabel
from dengine.store.verification import verify_history
from tests.support.driving import drive as play
from tests.support.driving import rule_state
from tests.support.stores import execute

LOCAL = Policy(alpha=0.1, lower_bound=0.9)
POOLED = replace(LOCAL, guarantee="pooled", stops="all")


def make(policy: Policy, **options) -> DataEngine:
    every = options.pop("retrain_every", 40)
    recipe = Recipe("pca", radius=0.5, retrain_every=every, policy=policy)
    return DataEngine(recipe=recipe, replaying=True, **options)


def outcomes(engine: DataEngine, **options) -> Outcomes:
    return engine.store.decisions.tally(**options).outcomes


@pytest.fixture(scope="module")
def stream(make_data):
    return make_data(500, samples=60, seed=3)


def accepted(engine: DataEngine, data: Dataset) -> Decision:
    """The first of the good traces that is accepted; those before it are reported."""
    while True:
        for x in data.X[data.y == 1]:
            decision = engine.decide(x)
            if decision.action is Action.ACCEPT:
                return decision
            engine.report(decision.id, True)


def spoiled(stream: Dataset) -> Dataset:
    """What was good, and is bad now."""
    good = np.flatnonzero(stream.y == 1)[:60]
    return Dataset(stream.X[good] + np.float32(0.01), np.zeros(60, np.int8))


def beyond(engine: DataEngine) -> list[int]:
    """Members of LB's own level that the rule counts beyond those of which the store has labels,
    and the bad ones.
    """
    n, bad = engine.model.rule.evidence.level_counts_since_alarm[0, 0].sum(0).tolist()
    reached = [item.success for item in engine.store.labels.outcomes_since(0) if item.lower >= 0.9]
    return [n - len(reached), bad - reached.count(False)]


def test_where_all_stops_are_known_silence_until_the_next_decision_confirms_a_part(
    stream,
):
    engine = make(replace(LOCAL, stops="all"))
    cycles = play(engine, stream, 0, 200)
    assert any(c.retrain for c in cycles if c.decision.action is Action.ACCEPT)  # of these alone

    def source(decision: Decision):
        engine.flush()
        return engine.find(decision.id).source

    silent = accepted(engine, stream)
    assert source(silent) is None  # nothing is known of it yet
    stopped = accepted(engine, stream)
    assert source(silent) is Source.CONFIRMED
    engine.report(stopped.id, False)
    engine.decide(stream.X[0])
    assert source(stopped) is Source.STOP
    for x in stream.X[stream.y == 1][:12]:
        engine.decide(x + np.float32(0.02))
    engine.retrain(wait=False)  # it stores the confirmations that wait first
    assert engine.store.versions.newest().last_seq == engine.store.labels.outcomes_since(0)[-1].seq


def test_silence_says_nothing_by_default(stream):
    engine = make(LOCAL)
    play(engine, stream, 0, 200)
    assert engine.store.decisions.counts()["sources"]["confirmed"] == 0
    assert outcomes(engine).accepted > 30
    certificate = engine.certificate()
    assert certificate.accepted.upper == 1.0
    assert "an audit rate" in certificate.sentence


def test_a_stop_that_comes_however_late_takes_its_confirmation_back_everywhere(
    stream, tmp_path, monkeypatch
):
    with make(POOLED, store=tmp_path / "late.db") as engine:
        play(engine, stream, 0, 200)
        id_ = accepted(engine, stream).id
        play(engine, stream, 200, 260)
        engine.flush()
        assert engine.find(id_).source is Source.CONFIRMED
        with monkeypatch.context() as patch:  # while the store is away
            patch.setattr(engine.store, "apply_records", Mock(side_effect=StoreError("away")))
            engine.report(id_, False)
        while engine.state.store_fault:
            time.sleep(0.01)
        engine.decide(stream.X[1])
        engine.flush()
        assert beyond(engine) == [0, 0]
        number, index = engine.store.decisions.get(id_).label_seq, engine.model.index
        assert engine.store.labels.with_traces().labels[number - 1] == 0
        assert index.column("labels")[index.column("numbers") == number].tolist() == [0]
        status, n_bad = engine.status(), outcomes(engine).false_accepts
        assert status.sources["stop"] == status.ever.false_accepts == n_bad > 0
        assert engine.certificate().accepted.n_bad == n_bad
        with pytest.raises(ReportError, match="failure from stop was reported first and stands"):
            engine.report(id_, False)
    with DataEngine.open(tmp_path / "late.db", replaying=True) as engine:
        assert (engine.find(id_).source, engine.find(id_).success) == (Source.STOP, False)


# With audits there are overdue checks of either kind; without them the long run is the same again.


def test_a_cell_stays_healthy_on_a_store_of_an_earlier_dengine_whose_labels_do_not_know_of_overdue_checks(
    stream, tmp_path, monkeypatch
):
    def earlier(*given, overdue_to, seq):
        return NewLabel(*given, seq=seq)

    store = f"{tmp_path}/e.db"
    with monkeypatch.context() as patch:
        patch.setattr(feedback, "NewLabel", earlier)
        with make(replace(POOLED, label_within=50), store=store) as engine:
            decisions = [engine.decide(x) for x in stream.X[:10]]  # of which nothing is reported
            play(engine, stream, 0, 250)
    execute(store, "ALTER TABLE label DROP COLUMN overdue_to")
    assert verify_history(store).ok
    with DataEngine.open(store, replaying=True) as engine:
        assert engine.safe_mode == ""
        assert engine.store.decisions.overdue_to(50) >= len(decisions)
        answers = [item.seq for item in engine.store.labels.outcomes_since(0, 0, 200)]
        assert answers[-5:] == sorted(answers[-5:])  # not last, in one burst
        engine.report(engine.decide(stream.X[0]).id, True)
    assert verify_history(store).ok


def test_a_callback_that_raises_costs_no_label(stream):
    engine = make(POOLED, on_safe_mode=Mock(side_effect=RuntimeError))
    play(engine, stream, 0, 200)
    play(engine, spoiled(stream))
    assert engine.safe_mode
    counts, known = engine.store.decisions.counts(), outcomes(engine)
    assert counts["labels"] == counts["actions"]["verify"] + known.false_accepts + known.confirmed


@pytest.mark.parametrize("guarantee", ["local", pytest.param("pooled", marks=pytest.mark.slow)])
def test_safe_mode_begins_with_a_recorded_reason_and_a_call_and_ends_when_fresh_evidence_keeps_the_tolerance(
    stream, make_data, guarantee
):
    heard: list[str] = []
    engine = make(replace(LOCAL, guarantee=guarantee, stops="all"), on_safe_mode=heard.append)
    play(engine, stream, 0, 200)
    cycles = play(engine, spoiled(stream))
    reason = "accepted parts failed more often than the tolerance"
    assert heard == [reason] == [e.text for e in engine.store.events.newest()]
    assert engine.safe_mode == reason == cycles[-1].safe_mode
    assert sum(c.decision.action is Action.ACCEPT for c in cycles) <= 7
    _, *after = [c.decision for c in cycles if c.safe_mode]  # the first raised the alarm
    assert {decision.action for decision in after} == {Action.VERIFY}
    assert Reason.SAFE_MODE in {decision.reason for decision in after}
    recovery = engine.status(watching=True).watch.recovery
    assert f" of {len(after) + 1} parts since the alarm count as evidence, " in recovery
    assert recovery.endswith("if this goes on, safe mode does not end")
    fresh = ReplayCell(make_data(800, samples=60, seed=9))  # the bad ones were learned
    for _ in takewhile(lambda _: engine.safe_mode, engine.run(fresh, 800)):
        assert heard == [reason]
    assert (heard, engine.store.events.newest()[-1].kind) == ([reason, ""], "safe mode ended")
    assert engine.status(watching=True).watch.recovery == ""


def test_of_a_safe_mode_whose_beginning_is_not_recorded_no_recovery_is_told(stream):
    engine = make(replace(LOCAL, stops="all"))
    play(engine, stream, 0, 200)
    play(engine, spoiled(stream))
    assert engine.status(watching=True).watch.recovery
    # As if the earlier safe mode had ended, and the engine was killed as this one began.
    engine.store.corrections.apply(Change("safe mode ended", "fresh evidence"))
    assert engine.safe_mode
    assert engine.status(watching=True).watch.recovery == ""


def test_a_parts_hash_never_changes():
    fnv = {"": 0xCBF29CE484222325, "a": 0xAF63DC4C8601EC8C, "foobar": 0x85944171F73967E8}
    for text, expected in fnv.items():  # FNV-1a: the vectors of its authors' reference
        assert part_hash(text) % 2**64 == expected


def test_the_status_tells_where_nearly_every_trace_is_novel(stream):
    engine = make(LOCAL)
    play(engine, stream, 0, 120)
    for x in stream.X[:200]:
        engine.decide(3 * x)
    assert "novel" in status(engine.store, last=200).alarm


def test_repeats_that_nobody_names_are_noticed_and_named_ones_or_parts_of_their_own_are_not(
    make_data,
):
    X, rng = load_dataset("insertion").X[:200, None], np.random.default_rng(0)
    assert repeats_note(X, np.arange(len(X))) == ""
    base, part = make_data(60, samples=60, seed=4, noise=0.1), rng.permutation(300) // 5
    X = (base.X[part] + rng.normal(0, 0.01, (300, 60))).astype(np.float32)
    for parts in (None, part.astype(str)):
        engine = make(Policy(alpha=0.01, lower_bound=0.99))  # that verifies them all
        play(engine, Dataset(X, base.y[part], part=parts))
        last = engine.store.versions.retrains()[-1]
        assert ("give their numbers" in last.reason) is (parts is None)
        assert ("same number each time it comes" in engine.status().alarm) is (parts is None)


@pytest.mark.parametrize("policy", [replace(LOCAL, audit_rate=0.2), POOLED])
def test_a_report_on_a_rejected_part_is_kept_and_trains_and_the_rule_is_not_told(
    policy, stream, tmp_path
):
    with make(policy, store=tmp_path / "engine.db") as engine:
        play(engine, stream, 0, 300)
        decisions = [engine.decide(x + np.float32(0.001)) for x in stream.X[stream.y == 0]]
        good, bad, *_ = [d.id for d in decisions if d.action is Action.REJECT]
        engine.poll()
        engine.flush()
        before, labels = rule_state(engine), (engine.status().labels, engine.state.new_labels)
        engine.report(good, True)
        engine.report(bad, False)
        assert rule_state(engine) == before
        status = engine.status()
        assert (status.labels - 2, engine.state.new_labels - 2) == labels
        assert (status.sources["inspection"], status.ever.false_rejects) == (2, 1)
        with pytest.raises(ReportError, match="success from inspection was reported first"):
            engine.report(good, False)
        engine.correct(good, False)
        assert engine.status().ever.false_rejects == 0
        engine.flush()
        rule = rule_state(engine)
    with DataEngine.open(tmp_path / "engine.db", replaying=True) as engine:
        assert (engine.find(good).success, engine.find(good).source) == (False, Source.INSPECTION)
        assert rule_state(engine) == rule


def test_false_rejects_bound_the_certificate_from_below_and_are_an_alarm_where_they_are_many(
    stream,
):
    engine = make(replace(LOCAL, audit_rate=0.3))
    play(engine, stream, 0, 200)
    decisions = [engine.decide(x) for x in stream.X[stream.y == 0]]
    ids = [decision.id for decision in decisions if decision.action is Action.REJECT]
    n = engine.status().certificate.rejected.n
    assert "rejected parts were good" not in engine.status().alarm
    for id_ in ids:
        engine.report(id_, True)
    status = engine.status()
    assert status.certificate.rejected.upper >= len(ids) / n
    alarm = f"{len(ids)} of the {status.newest.rejected} newest rejected parts were good"
    assert alarm in status.alarm
