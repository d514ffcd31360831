"""What becomes of parts: silence, confirmation, late stops, safe mode, parts that come twice, the
certificate.
"""

import re
import shutil
import sqlite3
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

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
    Source,
    load_dataset,
)
from dengine.engine import feedback
from dengine.errors import ReportError, StoreError
from dengine.folds import content_hash, fold_of, part_hash
from dengine.history.status import status
from dengine.model.neighbours import repeats_note
from dengine.store import SqlStore
from dengine.store.records import NewLabel
from dengine.store.verification import verify_history
from tests.support.driving import drive as play

LOCAL = Policy(alpha=0.1, lower_bound=0.9)
POOLED = replace(LOCAL, guarantee="pooled", stops="all")
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


def beyond(engine: DataEngine) -> list[int]:
    """Members of LB's own level that the rule counts beyond those of which the store has labels,
    and the bad ones.
    """
    records = engine.store.labels.outcomes_since(0)
    n, bad = engine.model.rule.evidence.level_counts_since_alarm[0, 0].sum(0).tolist()
    reached = [item.success for item in records if item.lower >= 0.9]
    return [n - len(reached), bad - reached.count(False)]


def test_where_all_stops_are_known_silence_until_the_next_decision_confirms_a_part(
    stream: Dataset,
) -> None:
    engine = make(replace(LOCAL, stops="all"))
    cycles = play(engine, stream, 0, 200)
    assert any(
        c.retrain is not None for c in cycles if c.decision.action is Action.ACCEPT
    )  # of confirmed parts alone

    def source(decision: Decision) -> Source | None:
        engine.flush()
        return engine.store.decisions.get(decision.id).source

    silent = accepted(engine, stream)
    assert source(silent) is None  # nothing is known of it yet
    stopped = accepted(engine, stream)
    assert source(silent) is Source.CONFIRMED
    engine.report(stopped.id, False)
    engine.decide(stream.X[0])
    assert source(stopped) is Source.STOP
    with pytest.raises(ReportError, match="stop"):
        engine.report(stopped.id, False)


def test_silence_says_nothing_by_default(stream: Dataset) -> None:
    engine = make(LOCAL)
    play(engine, stream)
    assert engine.store.decisions.counts()["sources"]["confirmed"] == 0
    assert engine.store.decisions.tally().outcomes.accepted > 100
    certificate = engine.certificate()
    assert (certificate.accepted.upper, "audit_rate" in certificate.sentence) == (1.0, True)


@pytest.mark.parametrize(
    ("later", "killed", "away"), [(1, False, False), (60, False, True), (1, True, False)]
)
def test_a_stop_that_comes_however_late_takes_its_confirmation_back_everywhere(
    stream: Dataset, tmp_path: Path, monkeypatch, later: int, killed: bool, away: bool
) -> None:
    engine = make(POOLED, store=str(tmp_path / "late.db"))
    play(engine, stream, 0, 300)
    stopped = accepted(engine, stream)
    play(engine, stream, 300, 300 + later)
    if killed:
        engine.store.flush()
        engine.store.close()  # the confirmation was still in memory
        engine = DataEngine.open(tmp_path / "late.db", replaying=True)
        engine.decide(stream.X[0])
    engine.flush()
    assert engine.store.decisions.get(stopped.id).source is Source.CONFIRMED
    if away:
        monkeypatch.setattr(
            engine.store, "apply_records", lambda records: (_ for _ in ()).throw(StoreError("away"))
        )
    engine.report(stopped.id, False)
    monkeypatch.undo()
    while engine.state.store_fault:
        time.sleep(0.01)
    engine.decide(stream.X[1])
    engine.flush()
    assert beyond(engine) == [0, 0]
    stored, labels = engine.store.decisions.get(stopped.id), engine.model.index.column("labels")
    assert (stored.success, engine.store.labels.with_traces().labels[stored.label_seq - 1]) == (
        False,
        0,
    )
    (past,) = [past for past in engine.history() if past.decision.id == stopped.id]
    assert {stored.source, past.source, engine.find(stopped.id).source} == {Source.STOP}
    status = engine.status()
    assert (
        status.sources["stop"]
        == status.ever.false_accepts
        == engine.store.decisions.tally().outcomes.false_accepts
    )
    with pytest.raises(
        ReportError,
        match="failure from stop was reported first and stands, now came failure from stop",
    ):
        engine.report(stopped.id, False)
    assert labels[engine.model.index.column("numbers") == stored.label_seq].tolist() == [0]
    assert (
        engine.certificate().accepted.n_bad
        == engine.store.decisions.tally().outcomes.false_accepts
        > 0
    )
    engine.close()
    with DataEngine.open(tmp_path / "late.db", replaying=True) as engine:
        assert (engine.find(stopped.id).source, engine.find(stopped.id).success) == (
            Source.STOP,
            False,
        )


def test_a_check_that_is_not_reported_in_time_counts_as_a_wrong_decision_until_it_is(
    stream: Dataset, tmp_path
) -> None:
    engine, owed = (
        make(
            replace(POOLED, stops="some", audit_rate=0.3, label_within=20),
            store=tmp_path / "owed.db",
        ),
        {},
    )
    for i, (x, y) in enumerate(zip(stream.X, stream.y, strict=True)):
        decision = engine.decide(x)
        if decision.audit and i % 3 == 0:
            owed[decision.id] = bool(y)
        elif decision.action is Action.VERIFY:
            engine.report(decision.id, bool(y))
    overdue = engine.store.decisions.tally(within=20).outcomes.overdue_audited_accepts
    assert overdue > 3 > engine.store.decisions.tally().outcomes.overdue_audited_accepts == 0
    assert (
        engine.certificate().accepted.n_bad
        == overdue + engine.store.decisions.tally().outcomes.audited_accepts_bad
    )
    assert beyond(engine) == [overdue, overdue]
    engine.close()
    shutil.copytree(tmp_path, tmp_path / "other")
    engine = DataEngine.open(tmp_path / "owed.db", replaying=True)
    assert beyond(engine) == [overdue, overdue]
    for id_, success in owed.items():
        engine.report(id_, success)
    engine.flush()
    engine.decide(stream.X[0])  # what was told before is told anew once the labels are stored
    assert beyond(engine) == [0, 0]
    assert (
        engine.certificate().accepted.n_bad
        == engine.store.decisions.tally().outcomes.audited_accepts_bad
    )
    engine = DataEngine.open(tmp_path / "other" / "owed.db", replaying=True)
    engine.set_policy(replace(engine.policy, alpha=0.2))
    engine.report(
        *next(iter(owed.items()))
    )  # the rule is told anew, of nothing that was owed under another policy
    engine.flush()
    engine.decide(stream.X[0])
    assert engine.model.rule.evidence.level_totals.sum() == 0


HISTORIES = {
    "local": replace(LOCAL, stops="all"),
    "pooled": POOLED,
    "pooled, audits": replace(POOLED, stops="some", audit_rate=0.3),
    "cost": replace(POOLED, guarantee="cost", prices=(5.0, 40.0, 30.0)),
    "cost, audits": replace(
        POOLED, guarantee="cost", stops="some", audit_rate=0.3, prices=(5.0, 40.0, 30.0)
    ),
}


def learned(engine: DataEngine, probes: np.ndarray) -> tuple:
    """What an engine's rule was told, and what it says of some traces."""
    rule = {name: value.tolist() for name, value in engine.model.rule.state_dict().items()}
    return (
        rule,
        engine.model.predict_many(probes),
        engine.safe_mode,
        engine.state.new_labels,
        engine.version,
    )


class RandomHistory:
    """A cell whose checks come late or never, whose people correct, and which is opened again now
    and then.

    compared : how often a copy of its store was opened while checks were overdue, and was as the
    engine that ran.
    """

    def __init__(self, policy: Policy, folder: Path, probes: np.ndarray, seed: int) -> None:
        (folder / "running").mkdir()
        self.rng, self.folder, self.probes, self.compared = (
            np.random.default_rng(seed),
            folder,
            probes,
            0,
        )
        self.engine = make(replace(policy, label_within=8), store=folder / "running" / "e.db")
        self.owed: dict[str, bool] = {}
        self.labelled: list[str] = []
        self.steps = {
            self.report_late: 0.05,
            self.correct: 0.02,
            self.forget: 0.01,
            self.change_policy: 0.01,
            self.roll_back: 0.02,
            self.compare: 0.05,
            self.reopen: 0.02,
        }

    def play(self, x: np.ndarray, success: bool) -> None:
        """One part, and what happens by chance after it."""
        decision = self.engine.decide(x)
        if decision.action is Action.ACCEPT and not success and self.rng.random() < 0.8:
            self.report(decision.id, False)
        elif decision.action is Action.VERIFY and self.rng.random() < 0.7:
            self.report(decision.id, success)
        elif decision.action is Action.VERIFY:
            self.owed[decision.id] = success
        for step, often in self.steps.items():
            if self.labelled and self.rng.random() < often:
                step()

    def report(self, id_: str, success: bool) -> None:
        self.engine.report(id_, success)
        self.labelled.append(id_)

    def report_late(self) -> None:
        if self.owed:
            late = str(self.rng.choice(list(self.owed)))
            self.report(late, self.owed.pop(late))

    def correct(self) -> None:
        self.engine.correct(str(self.rng.choice(self.labelled)), bool(self.rng.random() < 0.5))

    def forget(self) -> None:
        self.engine.forget(str(self.rng.choice(self.labelled)))

    def change_policy(self) -> None:
        self.engine.set_policy(
            replace(self.engine.policy, label_within=int(self.rng.integers(1, 20)))
        )

    def roll_back(self) -> None:
        if self.engine.version > 1:
            self.engine.rollback(
                int(self.rng.integers(max(1, self.engine.version - 2), self.engine.version))
            )

    def compare(self) -> None:
        self.engine.flush()
        if self.engine.model is not None:
            copied = self.folder / f"copy {self.rng.integers(10**9)}"
            shutil.copytree(self.folder / "running", copied)
            with DataEngine.open(copied / "e.db", replaying=True) as again:
                assert learned(again, self.probes) == learned(self.engine, self.probes)
            self.compared += (
                self.engine.store.decisions.overdue_to(self.engine.recipe.policy.label_within) > 0
            )

    def reopen(self) -> None:
        self.engine.close()
        self.engine = DataEngine.open(self.folder / "running" / "e.db", replaying=True)


# With audits there are overdue checks of either kind; without them the long run is the same again.
REPEATED = ("pooled", "cost")


@pytest.mark.parametrize(
    "policy",
    [
        pytest.param(policy, id=name, marks=[pytest.mark.slow] * (name in REPEATED))
        for name, policy in HISTORIES.items()
    ],
)
def test_in_random_histories_with_overdue_checks_a_reopened_engine_is_the_one_that_ran(
    stream: Dataset, tmp_path: Path, policy: Policy
) -> None:
    history = RandomHistory(policy, tmp_path, stream.X[:20], seed=1)
    for x, success in zip(stream.X[:160], stream.y.tolist(), strict=False):
        history.play(x, success == 1)
    assert history.compared > 0
    history.engine.close()


def test_a_cell_stays_healthy_on_a_store_of_an_earlier_dengine_whose_labels_do_not_know_of_overdue_checks(
    stream: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        feedback, "NewLabel", lambda *given, overdue_to, seq: NewLabel(*given, seq=seq)
    )
    engine, checks = make(replace(POOLED, label_within=50), store=tmp_path / "e.db"), 0
    for x, success in zip(stream.X, stream.y.tolist(), strict=True):
        decision = engine.decide(x)
        checks += decision.action is Action.VERIFY
        if not success if decision.action is Action.ACCEPT else checks % 10:
            engine.report(decision.id, bool(success))
    engine.close()
    monkeypatch.undo()
    with closing(sqlite3.connect(tmp_path / "e.db")) as earlier:
        earlier.execute("ALTER TABLE label DROP COLUMN overdue_to")
    assert verify_history(str(tmp_path / "e.db")).ok
    with DataEngine.open(tmp_path / "e.db", replaying=True) as engine:
        assert engine.safe_mode == ""
        assert engine.store.decisions.overdue_to(50) > 0
        answers = [item.seq for item in engine.store.labels.outcomes_since(0, 0, 450)]
        assert answers[-5:] == sorted(answers[-5:])  # not last, in one burst
        engine.report(engine.decide(stream.X[0]).id, True)
    assert verify_history(str(tmp_path / "e.db")).ok


def test_a_retrain_that_is_asked_for_while_confirmations_wait_stores_them_first(
    stream: Dataset,
) -> None:
    engine = make(POOLED)
    play(engine, stream, 0, 300)
    for x in stream.X[stream.y == 1][:12]:
        engine.decide(x + np.float32(0.02))
    engine.retrain(wait=False)
    assert beyond(engine) == [0, 0]
    assert engine.store.versions.newest().last_seq == engine.store.labels.outcomes_since(0)[-1].seq


def test_a_callback_that_raises_costs_no_label(stream: Dataset) -> None:
    def angry(reason: str) -> None:
        raise RuntimeError(reason)

    engine = make(POOLED, on_safe_mode=angry)
    play(engine, stream, 0, 300)
    play(engine, spoiled(stream))
    assert engine.safe_mode
    status = engine.store.decisions.counts()
    outcomes = engine.store.decisions.tally().outcomes
    assert (
        status["labels"]
        == status["actions"]["verify"] + outcomes.false_accepts + outcomes.confirmed
    )


@pytest.mark.parametrize("guarantee", ["local", pytest.param("pooled", marks=pytest.mark.slow)])
def test_safe_mode_begins_with_a_recorded_reason_and_a_call_and_ends_when_fresh_evidence_keeps_the_tolerance(
    stream: Dataset, make_data, guarantee: str
) -> None:
    heard: list[str] = []
    engine = make(replace(LOCAL, guarantee=guarantee, stops="all"), on_safe_mode=heard.append)
    play(engine, stream)
    cycles = play(engine, spoiled(stream))
    reason = "accepted parts failed more often than the tolerance"
    assert heard == [reason] == [e.text for e in engine.store.events.newest()]
    assert engine.safe_mode == reason == cycles[-1].safe_mode
    first = next(i for i, c in enumerate(cycles) if c.safe_mode)
    assert sum(c.decision.action is Action.ACCEPT for c in cycles) <= 7
    assert {c.decision.action for c in cycles[first + 1 :]} == {Action.VERIFY}
    assert Reason.SAFE_MODE in {c.decision.reason for c in cycles[first + 1 :]}
    recovery = engine.status(watching=True).watch.recovery
    n_parts = len(cycles) - first  # with the part that raised the alarm
    assert re.fullmatch(
        rf"\d+ of {n_parts} parts since the alarm are evidence, \d+ wrong: like this it does not end",
        recovery,
    )
    play(engine, make_data(800, samples=60, seed=9))  # more than the bad ones, which are learned
    assert (engine.safe_mode, heard[-1], engine.store.events.newest()[-1].kind) == (
        "",
        "",
        "safe mode ended",
    )
    assert engine.status(watching=True).watch.recovery == ""


def test_traces_of_one_part_share_a_fold_whatever_they_look_like(stream: Dataset) -> None:
    store = SqlStore()
    engine = make(LOCAL, store=store)
    for x in stream.X[:10]:
        engine.report(engine.decide(x, part="A-17").id, True)
    hashes = store.labels.with_traces().hashes
    for text, records in (
        ("", 0xCBF29CE484222325),
        ("a", 0xAF63DC4C8601EC8C),
        ("foobar", 0x85944171F73967E8),
    ):
        assert part_hash(text) % 2**64 == records  # FNV-1a: the vectors of its authors' reference
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


@pytest.mark.parametrize("numbered", [False, True])
def test_parts_that_were_each_reported_three_times_teach_as_much_as_once(
    make_data, numbered: bool
) -> None:
    data, certain = make_data(400, samples=60, seed=5), []
    for times in (1, 3):
        engine = make(replace(LOCAL, shadow=True))
        for i in np.tile(np.arange(200), times):
            engine.report(
                engine.decide(data.X[i], part=int(i) if numbered else None).id, bool(data.y[i])
            )
        engine.retrain()
        certain.append(sum(engine.decide(x).predicted is not Action.VERIFY for x in data.X[200:]))
    assert min(certain) > max(certain) - 20 > 80


def test_an_event_and_the_status_tell_where_nearly_every_trace_is_novel(stream: Dataset) -> None:
    engine = make(LOCAL)
    play(engine, stream, 0, 200)
    assert engine.store.events.newest() == []
    for x in stream.X[:200]:
        engine.decide(3 * x)
    assert [event.kind for event in engine.store.events.newest()] == ["novelty"]
    assert "novel" in status(engine.store, last=200).alarm


def test_repeats_that_nobody_names_are_noticed_and_named_ones_or_parts_of_their_own_are_not(
    make_data,
) -> None:
    X, drawn = load_dataset("insertion").X, np.random.default_rng(0)
    for n in (100, 200) * 10:
        assert repeats_note(X[drawn.permutation(len(X))[:n], None], np.arange(n)) == ""
    base, rng = make_data(60, samples=60, seed=4, noise=0.1), np.random.default_rng(0)
    X = np.repeat(base.X, 5, 0)
    X = (X + rng.normal(0, 0.01, X.shape)).astype(np.float32)
    y, part = np.repeat(base.y, 5), np.repeat(np.arange(60).astype(str), 5)
    order = rng.permutation(300)
    for parts, text in ((None, True), (part[order], False)):
        engine = make(Policy(alpha=0.01, lower_bound=0.99))  # that verifies them all
        cycles = play(engine, Dataset(X[order], y[order], part=parts))
        last = [c.retrain for c in cycles if c.retrain is not None][-1]
        assert ("give their numbers" in last.reason) is text
        assert ("same number each time it comes" in engine.status().alarm) is text


def rejected(engine: DataEngine, data: Dataset) -> list[Decision]:
    """Of the bad traces those that are rejected; nothing is reported."""
    decisions = [engine.decide(x) for x in data.X[data.y == 0]]
    return [decision for decision in decisions if decision.action is Action.REJECT]


def told(engine: DataEngine) -> dict[str, list]:
    """What the rule has learned."""
    return {name: value.tolist() for name, value in engine.model.rule.state_dict().items()}


@pytest.mark.parametrize(
    "policy", [replace(LOCAL, stops="all"), replace(LOCAL, audit_rate=0.2), POOLED]
)
def test_a_report_on_a_rejected_part_is_kept_and_trains_and_the_rule_is_not_told(
    policy: Policy, stream: Dataset, tmp_path: Path
) -> None:
    with make(policy, store=tmp_path / "engine.db") as engine:
        play(engine, stream, 0, 300)
        bad = replace(stream, X=stream.X + np.float32(0.001))
        result = rejected(engine, bad)
        assert len(result) > 3
        engine.poll()
        engine.flush()
        before = told(engine)
        n, labels = engine.store.decisions.counts()["labels"], engine.state.new_labels
        engine.report(result[0].id, True)
        engine.report(result[1].id, False)
        assert told(engine) == before
        assert engine.state.new_labels == labels + 2
        status = engine.status()
        assert (status.sources["inspection"], status.labels, status.ever.false_rejects) == (
            2,
            n + 2,
            1,
        )
        match = engine.find(result[0].id)
        assert (match.success, match.source) == (True, Source.INSPECTION)
        assert {result[0].id} == {
            past.decision.id
            for past in engine.history(label="good")
            if past.source is Source.INSPECTION
        }
        assert "turned out good (inspection)" in " ".join(engine.explain(result[0].id).sentences)
        with pytest.raises(ReportError, match="success from inspection was reported first"):
            engine.report(result[0].id, False)
        assert "failure" in engine.correct(result[0].id, False, "kim").text
        assert engine.status().ever.false_rejects == 0
        engine.correct(result[0].id, True, "kim")
        probe = [engine.decide(x).action for x in stream.X[:40]]
        engine.flush()
        rule = told(engine)
    with DataEngine.open(tmp_path / "engine.db", replaying=True) as engine:
        assert engine.find(result[0].id).source is Source.INSPECTION
        assert engine.status().ever.false_rejects == 1
        assert told(engine) == rule
        assert [engine.decide(x).action for x in stream.X[:40]] == probe


def test_false_rejects_bound_the_certificate_from_below_and_are_an_alarm_where_they_are_many(
    stream: Dataset,
) -> None:
    engine = make(replace(LOCAL, audit_rate=0.3))
    play(engine, stream, 0, 300)
    result = rejected(engine, stream)
    n = engine.status().certificate.rejected.n
    assert "rejected parts were good" not in engine.status().alarm
    for decision in result:
        engine.report(decision.id, True)
    status = engine.status()
    assert status.certificate.rejected.upper >= len(result) / n
    assert (
        f"{len(result)} of the {status.newest.rejected} newest rejected parts were good: more than 10.0%."
        in status.alarm
    )
