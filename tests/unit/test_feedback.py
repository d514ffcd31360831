"""What becomes of parts: silence, confirmation, late stops, safe mode, parts that come twice, the certificate."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dengine import Action, DataEngine, Dataset, Decision, Policy, Reason, Recipe, Source
from dengine.errors import ReportError, StoreError, TraceError
from dengine.folds import content_hash, fold_of, part_hash
from dengine.store import MemoryStore
from tests.support.driving import drive as play

LOCAL = Policy(alpha=0.1, lower_bound=0.9)
POOLED = replace(LOCAL, guarantee="pooled")
RECIPE = Recipe("pca", radius=0.5, retrain_every=40)


def make(policy: Policy, **options) -> DataEngine:
    return DataEngine(recipe=replace(RECIPE, policy=policy), replaying=True, **options)


@pytest.fixture(scope="module")
def stream(make_data) -> Dataset:
    return make_data(500, samples=60, seed=3)


def accepted(engine: DataEngine, data: Dataset) -> Decision:
    """The first of the good traces that is accepted; those before it are reported."""
    for x in data.X[data.y == 1]:
        decision = engine.decide(x)
        if decision.action is Action.ACCEPT:
            return decision
        engine.report(decision.id, True)
    raise AssertionError("nothing was accepted")


def spoiled(stream: Dataset) -> Dataset:
    """What was good, and is bad now."""
    good = np.flatnonzero(stream.y == 1)[:60]
    return Dataset(stream.X[good] + np.float32(0.01), np.zeros(60, np.int8))


def test_where_all_stops_are_known_silence_until_the_next_decision_confirms_a_part(stream: Dataset) -> None:
    engine = make(replace(LOCAL, stops="all"))
    play(engine, stream, 0, 200)

    def source(decision: Decision) -> Source | None:
        engine.flush()
        return engine.store.get_decision(decision.id).source

    silent = accepted(engine, stream)
    assert source(silent) is None  # nothing is known of it yet
    stopped = accepted(engine, stream)
    assert source(silent) is Source.CONFIRMED
    engine.report(stopped.id, False)
    engine.decide(stream.X[0])
    assert source(stopped) is Source.STOP
    with pytest.raises(ReportError, match="confirmed"):
        engine.report(silent.id, False)  # its confirmation is stored


def test_silence_says_nothing_by_default(stream: Dataset) -> None:
    engine = make(LOCAL)
    play(engine, stream)
    assert engine.store.status()["sources"]["confirmed"] == 0
    assert engine.store.outcomes().accepted > 100


def test_confirmed_parts_set_off_retrains_though_nothing_is_reported(stream: Dataset) -> None:
    cycles = play(make(replace(LOCAL, stops="all")), stream)
    assert sum(c.retrain is not None for c in cycles if c.decision.action is Action.ACCEPT) >= 2


def test_a_late_stop_whose_write_failed_is_counted_once_when_it_is_told_again(stream: Dataset, monkeypatch) -> None:
    engine = make(replace(POOLED, stops="all"))
    play(engine, stream, 0, 300)
    decision = accepted(engine, stream)
    engine.decide(stream.X[0])  # takes it for confirmed
    whole = engine.store.take

    def full(records):
        if any(getattr(each, "label", None) and each.label.decision_id == decision.id for each in records):
            raise StoreError("the disk is full")
        return whole(records)

    monkeypatch.setattr(engine.store, "take", full)
    with pytest.raises(StoreError):
        engine.report(decision.id, False)
    monkeypatch.setattr(engine.store, "take", whole)
    engine.report(decision.id, False)
    evidence_ = engine.store.evidence_since(0)
    members = engine.model.rule.evidence.members[0, 0, 0].tolist()  # of LB's own level
    reached = evidence_.lower >= 0.9
    assert members == [int(reached.sum()), int((reached & ~evidence_.success).sum())]


def test_a_retrain_that_is_asked_for_while_confirmations_wait_stores_them_first(stream: Dataset) -> None:
    engine = make(replace(POOLED, stops="all"))
    play(engine, stream)
    for x in stream.X[stream.y == 1][:12]:
        engine.decide(x + np.float32(0.02))
    engine.start_retrain()
    known = engine.store.evidence_since(0)
    assert engine.model.rule.evidence.members[0, 0, 0, 0] == (known.lower >= 0.9).sum()
    assert engine.store.last_version().last_seq == known.seq[-1]


def test_a_callback_that_raises_costs_no_label(stream: Dataset) -> None:
    def angry(reason: str) -> None:
        raise RuntimeError(reason)

    engine = make(replace(POOLED, stops="all"), on_safe_mode=angry)
    play(engine, stream)
    play(engine, spoiled(stream))
    assert engine.safe_mode
    status = engine.store.status()
    outcomes = engine.store.outcomes()
    assert status["labels"] == status["actions"]["verify"] + outcomes.stops + outcomes.confirmed


def test_a_killed_engine_confirms_after_it_was_opened_what_had_gone_on(stream: Dataset, tmp_path: Path) -> None:
    url = str(tmp_path / "killed.db")
    engine = make(replace(LOCAL, stops="all"), store=url)
    play(engine, stream, 0, 200)
    decision = accepted(engine, stream)
    engine.decide(stream.X[0], wait=True)
    engine.store.close()  # the confirmation was still in memory
    with DataEngine.open(url, replaying=True) as again:
        again.decide(stream.X[1])
        again.flush()
        assert again.store.get_decision(decision.id).source is Source.CONFIRMED


def collapse(stream: Dataset, policy: Policy) -> tuple[DataEngine, list, list]:
    """An engine that learned a stream, and then one in which what was good is bad."""
    heard: list[str] = []
    engine = make(policy, on_safe_mode=heard.append)
    play(engine, stream)
    return engine, play(engine, spoiled(stream)), heard


@pytest.mark.parametrize("guarantee", ["local", "pooled"])
def test_safe_mode_begins_with_a_recorded_reason_a_call_and_a_mark_on_every_cycle(stream: Dataset, guarantee: str) -> None:
    engine, cycles, heard = collapse(stream, replace(LOCAL, guarantee=guarantee, stops="all"))
    reason = "accepted parts failed more often than the tolerance"
    assert heard == [reason] == [e.text for e in engine.store.events()]
    assert engine.safe_mode == reason == cycles[-1].safe_mode
    first = next(i for i, c in enumerate(cycles) if c.safe_mode)
    assert sum(c.decision.action is Action.ACCEPT for c in cycles) <= 7
    assert {c.decision.action for c in cycles[first + 1 :]} == {Action.VERIFY}
    assert Reason.SAFE_MODE in {c.decision.reason for c in cycles[first + 1 :]}


def test_safe_mode_ends_when_fresh_evidence_keeps_the_tolerance(stream: Dataset, make_data) -> None:
    engine, _, heard = collapse(stream, replace(POOLED, stops="all"))
    play(engine, make_data(400, samples=60, seed=9))
    assert heard[-1] == ""
    assert engine.safe_mode == ""
    assert engine.store.events()[-1].kind == "safe mode ended"


def test_the_part_hash_is_fnv_1a() -> None:
    for text, known in (("", 0xCBF29CE484222325), ("a", 0xAF63DC4C8601EC8C), ("foobar", 0x85944171F73967E8)):
        assert part_hash(text) % 2**64 == known  # the vectors of its authors' reference


def test_traces_of_one_part_share_a_fold_whatever_they_look_like(stream: Dataset) -> None:
    store = MemoryStore()
    engine = make(LOCAL, store=store)
    for x in stream.X[:10]:
        engine.report(engine.decide(x, part="A-17").id, True)
    hashes = store.labelled().hashes
    assert set(hashes.tolist()) == {part_hash("A-17")} != set(content_hash(stream.X[:10]).tolist())
    assert len(set(fold_of(hashes, 5).tolist())) == 1


def test_a_part_that_comes_often_has_one_vote_and_none_on_itself(stream: Dataset) -> None:
    engine = make(LOCAL)
    play(engine, stream, 0, 200)
    x, rng = stream.X[np.flatnonzero(stream.y == 1)[0]], np.random.default_rng(0)
    near = lambda: x + rng.normal(0, 0.01, x.shape).astype(np.float32)  # noqa: E731
    before = engine.decide(near(), part="other")
    for _ in range(30):
        engine.report(engine.decide(near(), part="often").id, True)
    engine.retrain()
    counted = engine.decide(near(), part="other")
    itself = engine.decide(near(), part="often")
    assert counted.n_success == itself.n_success + 1
    assert counted.n_success <= before.n_success + 1 + 8  # what the new embedding moves; not thirty


@pytest.mark.parametrize("part", ["", 1.5, True, b"7", ["7"], "a\0b", "\ud800"])
def test_what_is_no_number_of_a_part_is_refused(stream: Dataset, part: object) -> None:
    engine = make(LOCAL)
    with pytest.raises(TraceError, match="part's number"):
        engine.decide(stream.X[0], part=part)


def test_a_number_and_its_text_are_one_part(stream: Dataset) -> None:
    engine = make(LOCAL)
    assert engine.decide(stream.X[0], part=17).part == engine.decide(stream.X[1], part="17").part == "17"


def test_repeats_that_nobody_names_are_noticed_and_named_ones_are_not(make_data) -> None:
    base, rng = make_data(60, samples=60, seed=4, noise=0.1), np.random.default_rng(0)
    X = np.repeat(base.X, 5, 0)
    X = (X + rng.normal(0, 0.01, X.shape)).astype(np.float32)
    y, part = np.repeat(base.y, 5), np.repeat(np.arange(60).astype(str), 5)
    order = rng.permutation(300)
    for parts, said in ((None, True), (part[order], False)):
        engine = make(Policy(alpha=0.01, lower_bound=0.99))  # that verifies them all
        cycles = play(engine, Dataset(X[order], y[order], part=parts))
        last = [c.retrain for c in cycles if c.retrain is not None][-1]
        assert ("give their numbers" in last.reason) is said


def test_without_stops_or_audits_the_certificate_says_that_it_knows_nothing(stream: Dataset) -> None:
    engine = make(LOCAL)
    play(engine, stream)
    certificate = engine.certificate()
    assert certificate.accepted.upper == 1.0
    assert "audit_rate" in certificate.sentence
