"""The one loop: decide, report, retrain, run, open. Real reducers, real stores, real executors."""

import sqlite3
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from dengine import (
    Action,
    DataEngine,
    Dataset,
    Decision,
    Outcome,
    Policy,
    Reason,
    Recipe,
    ReplayCell,
    Source,
    TraceError,
    TraceSpec,
)
from dengine.errors import ReportError, SettingError, StoreError
from dengine.folds import audited, content_hash
from dengine.model.compiled import CompiledPredictor
from dengine.store import MemoryStore, SqlStore
from tests.support.driving import Counting

RECIPE = Recipe("pca", radius=0.5, policy=Policy(alpha=0.1, lower_bound=0.9), retrain_every=40)
AUDITING = RECIPE.with_policy(audit_rate=0.3)


def make(recipe: Recipe = RECIPE, **options) -> DataEngine:
    return DataEngine(recipe=recipe, replaying=True, **options)


def play(engine: DataEngine, data: Dataset, part: slice = slice(None), **options) -> list:
    order = np.arange(len(data))[part]
    return list(engine.run(ReplayCell(data, order, **options), len(order)))


def evidence(d: Decision) -> tuple:
    """All of a decision but its id, which is new in every run."""
    return (d.action, d.predicted, d.lower, d.upper, d.n_success, d.n_failure, d.embedding, d.model_version, d.reason)


def good(data: Dataset, n: int = 1) -> np.ndarray:
    return data.X[np.flatnonzero(data.y == 1)[-n]]


def bad(data: Dataset, n: int = 1) -> np.ndarray:
    return data.X[np.flatnonzero(data.y == 0)[-n]]


@pytest.fixture
def trained(data: Dataset) -> DataEngine:
    engine = make()
    play(engine, data, slice(0, 150), confirm=True)
    assert engine.version > 0
    return engine


# --------------------------------------------------------------------------------------------- decide and report


def test_a_cell_starts_on_the_check_and_earns_its_way_off_it(data: Dataset) -> None:
    cycles = play(make(), data)
    first, last = cycles[:40], cycles[-50:]
    assert {c.decision.action for c in first} == {Action.VERIFY}
    assert {c.decision.reason for c in first} == {Reason.NO_MODEL}
    assert all((c.decision.lower, c.decision.upper, c.decision.embedding) == (0.0, 1.0, None) for c in first)
    assert sum(c.decision.action is Action.ACCEPT for c in last) > 25
    wrong = [c for c, y in zip(cycles, data.y, strict=True) if c.decision.action is Action.ACCEPT and not y]
    assert len(wrong) <= 1


def test_each_action_asks_its_own_question_of_the_cell_exactly_once(data: Dataset) -> None:
    class Counting(ReplayCell):
        def __init__(self, *args) -> None:
            super().__init__(*args)
            self.calls: list[list[str]] = []

        def insert(self):
            self.calls.append([])
            return super().insert()

        def verify(self):
            self.calls[-1].append("verify")
            return super().verify()

        def proceed(self):
            self.calls[-1].append("accept")
            return super().proceed()

        def reject(self):
            self.calls[-1].append("reject")

    cell = Counting(data)
    recipe = replace(RECIPE, fraction=0.3, reject_fraction=0.1)
    cycles = list(make(recipe).run(cell, len(data)))
    assert cell.calls == [[str(c.decision.action)] for c in cycles]
    assert {c.decision.action for c in cycles} == set(Action)


def test_silence_after_an_accept_is_no_label_and_a_confirmation_is(data: Dataset) -> None:
    silent, confirmed = play(make(), data), play(make(), data, confirm=True)
    accepted = [c for c in silent if c.outcome is Outcome.UNKNOWN]
    assert accepted
    assert all(c.success is None and c.source is None for c in accepted)
    known = [c for c in confirmed if c.outcome is Outcome.CONFIRMED]
    assert known
    assert all(c.success is True and c.source is Source.CONFIRMED for c in known)


def test_a_stop_is_a_failure_with_its_own_source_and_is_counted(trained: DataEngine, data: Dataset) -> None:
    decision = trained.decide(good(data))
    assert decision.action is Action.ACCEPT
    trained.report(decision.id, success=False)
    assert trained.store.get_decision(decision.id).source is Source.STOP
    alike = trained.decide(good(data) + np.float32(1e-3))
    assert (alike.n_success, alike.n_failure) == (decision.n_success, decision.n_failure + 1)


def test_a_trace_that_comes_again_has_no_vote_on_itself(trained: DataEngine, data: Dataset) -> None:
    decision = trained.decide(good(data))
    trained.report(decision.id, success=False)
    again = trained.decide(good(data))
    assert (again.n_success, again.n_failure) == (decision.n_success, decision.n_failure)


def test_a_report_is_counted_at_once_and_retrains_every_so_many_labels(data: Dataset) -> None:
    engine = make()
    reports = []
    for x, y in zip(data.X[:120], data.y[:120], strict=True):
        decision = engine.decide(x)
        if decision.action is Action.VERIFY:
            reports.append(engine.report(decision.id, bool(y)))
    made = [i + 1 for i, report in enumerate(reports) if report is not None]
    assert made == list(range(40, len(reports) + 1, 40))
    assert [r.version for r in reports if r is not None] == list(range(1, len(made) + 1))
    assert all(
        r.accepted and r.reason == "accepted" and r.n_traces == n for r, n in zip(filter(None, reports), made, strict=True)
    )


def test_a_decision_carries_the_evidence_that_made_it(trained: DataEngine, data: Dataset) -> None:
    d = trained.decide(good(data))
    assert (d.lower, d.upper) == pytest.approx(RECIPE.policy.bound(d.n_success, d.n_failure), abs=1e-12)
    assert d.action is d.predicted is RECIPE.policy.action(d.lower, d.upper)
    assert np.shape(d.embedding) == (1, 2)
    assert (d.model_version, d.audit, d.propensity, d.reason) == (trained.version, False, 0.0, Reason.CERTAIN)


def test_the_callers_buffer_may_be_reused_after_decide(data: Dataset) -> None:
    engine, buffer = make(), np.zeros(100, dtype=np.float32)
    ids = []
    for x in data.X[:3]:
        buffer[:] = x
        ids.append(engine.decide(buffer).id)
    for name, x in zip(ids, data.X[:3], strict=True):
        np.testing.assert_array_equal(engine.store.get_decision(name).trace[0], x)


# ------------------------------------------------------------------------------------------------------- audits


def test_an_audit_verifies_what_was_certain_and_says_what_was_predicted(data: Dataset) -> None:
    cycles = play(make(AUDITING, seed=5), data)
    audits = [c for c in cycles if c.decision.audit]
    assert audits
    for c in audits:
        assert (c.decision.action, c.decision.reason, c.source) == (Action.VERIFY, Reason.AUDIT, Source.AUDIT)
        assert c.decision.predicted in (Action.ACCEPT, Action.REJECT)
        assert c.success is not None
    assert all(c.decision.predicted is c.decision.action for c in cycles if not c.decision.audit)


def test_propensity_is_the_audit_rate_where_certain_and_one_elsewhere(data: Dataset) -> None:
    for c in play(make(AUDITING), data):
        certain = c.decision.predicted is not Action.VERIFY
        assert c.decision.propensity == (0.3 if certain else 1.0)


def test_the_audit_coin_is_a_function_of_trace_and_seed_alone(data: Dataset) -> None:
    cycles = play(make(AUDITING, seed=5), data)
    coin = audited(content_hash(data.X), 0.3, 5)
    certain = np.array([c.decision.predicted is not Action.VERIFY for c in cycles])
    np.testing.assert_array_equal([c.decision.audit for c in cycles], coin & certain)


# -------------------------------------------------------------------------------------------------- bad traces


FAULTS = [
    (Reason.NOT_FINITE, lambda x: np.where(np.arange(len(x)) == 7, np.nan, x)),
    (Reason.NOT_FINITE, lambda x: np.where(np.arange(len(x)) == 7, np.inf, x)),
    (Reason.CONSTANT, lambda x: np.full_like(x, 3.0)),
    (Reason.SATURATED, lambda x: np.where(np.arange(len(x)) == 7, -200.0, x)),
]


@pytest.mark.parametrize(("reason", "damage"), FAULTS)
def test_a_bad_trace_is_verified_with_its_reason_kept_and_never_trained_on(reason, damage, data: Dataset) -> None:
    engine = make(trace=TraceSpec(samples=100, limit=150.0))
    play(engine, data, slice(0, 100))
    version, held = engine.version, len(engine.model.index)
    x = damage(good(data).astype(np.float64))
    decision = engine.decide(x)
    assert (decision.action, decision.reason, decision.embedding) == (Action.VERIFY, reason, None)
    assert engine.report(decision.id, success=True) is None
    stored = engine.store.get_decision(decision.id)
    assert stored.quarantined
    np.testing.assert_array_equal(stored.trace[0], x.astype(np.float32))
    assert stored.success is True
    assert (len(engine.model.index), engine.version) == (held, version)
    assert content_hash(x[None])[0] not in engine.store.labelled().hashes
    report = engine.retrain()
    assert report.n_traces == len(engine.store.labelled().labels)


def test_bad_traces_alone_never_set_off_a_retrain(data: Dataset) -> None:
    engine = make()
    for _ in range(60):
        decision = engine.decide(np.full(100, 1.0))
        assert engine.report(decision.id, success=False) is None
    assert engine.store.retrains() == []


def test_the_first_trace_sets_the_contract_and_a_wrong_shape_raises(data: Dataset) -> None:
    engine = make()
    engine.decide(data.X[0])
    assert engine.trace == TraceSpec(samples=100)
    with pytest.raises(TraceError, match="Expected 100 samples, got 99"):
        engine.decide(data.X[0][:99])
    with pytest.raises(TraceError, match=r"Expected 1 channel\(s\), got 2"):
        engine.decide(np.stack([data.X[0], data.X[0]]))
    assert engine.store.status()["decisions"] == 1
    assert engine.decide(data.X[1]).action is Action.VERIFY


@pytest.mark.parametrize(("samples", "channels"), [(152, 1), (800, 1), (60, 3)])
def test_other_lengths_and_several_channels_go_the_whole_way(samples: int, channels: int, make_data) -> None:
    data = make_data(150, samples=samples, channels=channels)
    engine = make()
    actions = Counter(c.decision.action for c in play(engine, data))
    assert engine.trace == TraceSpec(samples=samples, channels=channels)
    assert actions[Action.ACCEPT] > 20


def test_a_finite_trace_beyond_all_measure_is_verified(data: Dataset) -> None:
    for recipe in (RECIPE, replace(RECIPE, fraction=0.2)):
        engine = make(recipe)
        play(engine, data, slice(0, 150))
        for scale in (1e15, 1e30):
            assert engine.decide(good(data) * np.float32(scale)).action is Action.VERIFY


# ------------------------------------------------------------------------------------------------- failing models


class Failing:
    """A rival that learns and then fails, at whatever it is told to."""

    def __init__(self, *at: str) -> None:
        self.at = at

    def _maybe(self, name: str) -> None:
        if name in self.at:
            raise RuntimeError(f"{name} failed")

    def fit(self, X, y):
        self._maybe("fit")

    def add(self, x, y):
        self._maybe("add")

    def count(self, X):
        return np.zeros(len(X), int), np.zeros(len(X), int)

    def predict_interval(self, X):
        self._maybe("predict_interval")
        return np.zeros(len(X)), np.ones(len(X))

    def decide(self, X):
        return np.full(len(X), Action.VERIFY, dtype=object)


def test_an_exception_inside_the_model_becomes_verify_and_is_recorded(data: Dataset) -> None:
    engine = make(model=Failing("predict_interval"))
    cycles = play(engine, data, slice(0, 90))
    assert Counter(c.decision.reason for c in cycles) == {Reason.NO_MODEL: 40, Reason.MODEL_ERROR: 50}
    assert {c.decision.action for c in cycles} == {Action.VERIFY}
    assert engine.store.status()["reasons"]["model_error"] == 50


def test_a_model_that_cannot_take_a_label_loses_neither_it_nor_the_cell(data: Dataset) -> None:
    engine = make(model=Failing("add"))
    cycles = play(engine, data, slice(0, 130))
    assert len(cycles) == 130
    assert len(engine.store.labelled().labels) == 130
    assert engine.version == 3


def test_a_reducer_that_fails_on_a_trace_loses_no_label(data: Dataset) -> None:
    engine = make(replace(RECIPE, retrain_every=1000))
    play(engine, data, slice(0, 60))
    engine.retrain()

    class Broken:
        def __call__(self, x):
            raise RuntimeError("out of memory")

        embed = __call__

    engine.model._compiled = CompiledPredictor(Broken())
    decision = engine.decide(data.X[60])
    assert decision.reason is Reason.MODEL_ERROR
    engine.report(decision.id, bool(data.y[60]))
    assert len(engine.store.labelled().labels) == 61
    assert engine.retrain().n_traces == 61


@pytest.mark.parametrize("message", ["singular matrix\nand more", ""])
def test_a_candidate_that_cannot_be_trained_is_dropped_and_recorded(data: Dataset, message: str) -> None:
    class Untrainable(Failing):
        def fit(self, X, y):
            raise ValueError(message)

    engine = make(model=Untrainable())
    cycles = play(engine, data, slice(0, 90))
    reports = [c.retrain for c in cycles if c.retrain is not None]
    assert [r.accepted for r in reports] == [False, False]
    assert all(r.reason.startswith("dropped: ValueError") and "and more" not in r.reason for r in reports)
    assert engine.store.retrains() == reports
    assert (engine.version, {c.decision.model_version for c in cycles}) == (0, {0})


def test_a_dropped_candidate_leaves_the_old_version_answering(data: Dataset) -> None:
    engine = make()
    play(engine, data, slice(0, 120))
    version, before = engine.version, evidence(engine.decide(good(data)))
    engine.model.spaces.n_components = 500  # what the next one starts from cannot be trained
    report = engine.retrain()
    assert (report.accepted, report.version) == (False, version)
    assert "PCA to 500 dimensions" in report.reason
    assert evidence(engine.decide(good(data))) == before
    assert [r.accepted for r in engine.store.retrains()][-1] is False


def test_version_numbers_count_the_accepted_retrains(data: Dataset) -> None:
    engine = make(replace(RECIPE, retrain_every=1000))
    assert (engine.retrain().accepted, engine.version) == (False, 0)  # nothing to learn from
    play(engine, data, slice(0, 60))
    assert [engine.retrain().version for _ in range(3)] == [1, 2, 3]
    assert engine.decide(data.X[70]).model_version == 3
    assert [(r.version, r.accepted) for r in engine.store.retrains()] == [(0, False), (1, True), (2, True), (3, True)]


# ---------------------------------------------------------------------------------------------------- wrong reports


def test_a_report_on_an_unknown_id_is_an_error_and_changes_nothing(trained: DataEngine) -> None:
    before = trained.store.status()
    with pytest.raises(ReportError, match="'nobody', which is unknown"):
        trained.report("nobody", True)
    assert trained.store.status() == before


@pytest.mark.parametrize("second", [True, False])
def test_a_second_report_is_an_error_and_the_first_stands(trained: DataEngine, data: Dataset, second: bool) -> None:
    decision = trained.decide(np.roll(good(data), 15))
    assert decision.action is Action.VERIFY
    trained.report(decision.id, True)
    counts, labels, held = trained.new_labels, len(trained.store.labelled().labels), len(trained.model.index)
    with pytest.raises(ReportError, match="success from verification was reported first and stands"):
        trained.report(decision.id, second)
    assert trained.store.get_decision(decision.id).success is True
    assert (trained.new_labels, len(trained.store.labelled().labels), len(trained.model.index)) == (counts, labels, held)


def test_a_report_on_a_rejected_part_is_an_error(data: Dataset) -> None:
    engine = make(replace(RECIPE, fraction=0.3, reject_fraction=0.1))
    play(engine, data)
    decision = engine.decide(bad(data))
    assert decision.action is Action.REJECT
    labels = len(engine.store.labelled().labels)
    with pytest.raises(ReportError, match="was a reject; the part went back to the bin"):
        engine.report(decision.id, False)
    assert len(engine.store.labelled().labels) == labels


def test_a_stop_whose_decision_was_lost_is_accepted_with_its_trace(trained: DataEngine, data: Dataset) -> None:
    labels = len(trained.store.labelled().labels)
    trained.report("from-a-lost-process", success=False, trace=good(data))
    stored = trained.store.get_decision("from-a-lost-process")
    assert (stored.decision.action, stored.success, stored.source) == (Action.ACCEPT, False, Source.STOP)
    np.testing.assert_array_equal(stored.trace[0], good(data))
    assert len(trained.store.labelled().labels) == labels + 1
    with pytest.raises(ReportError, match="reported first"):
        trained.report("from-a-lost-process", success=False, trace=good(data))


def test_a_lost_stop_is_never_called_an_audit(data: Dataset) -> None:
    engine = make(RECIPE.with_policy(audit_rate=0.999))
    for i, x in enumerate(data.X[:20]):
        engine.report(f"lost-{i}", success=False, trace=x)
        stored = engine.store.get_decision(f"lost-{i}")
        assert (stored.source, stored.decision.audit, stored.decision.reason) == (Source.STOP, False, Reason.CERTAIN)


def test_a_lost_success_is_not_taken_since_only_stops_speak_for_themselves(trained: DataEngine, data: Dataset) -> None:
    with pytest.raises(ReportError, match="a system stop whose decision was lost can be reported with its trace"):
        trained.report("lost", success=True, trace=good(data))


# ------------------------------------------------------------------------------------------------------- the cell


@pytest.mark.parametrize("where", ["insert", "verify", "proceed"])
def test_an_exception_of_the_cell_propagates_after_everything_known_is_written(where, data, tmp_path: Path) -> None:
    real = getattr(ReplayCell, where)

    def failing(self):
        if self.position >= 119 or (where == "insert" and self.position == 118):
            raise ConnectionError("gripper lost")
        return real(self)

    Broken = type("Broken", (ReplayCell,), {where: failing})
    engine = make(store=str(tmp_path / "engine.db"))
    cycles = []
    with pytest.raises(ConnectionError, match="gripper lost"):
        cycles.extend(engine.run(Broken(data), 200))  # keeps what came before the exception
    known = sum(c.success is not None for c in cycles)
    with SqlStore(str(tmp_path / "engine.db")) as other:  # beside the engine, which is still open
        assert other.status()["labels"] == known > 50
        assert other.status()["decisions"] >= len(cycles) + (where != "insert")
    engine.close()


# ------------------------------------------------------------------------------------------------------------ open


def test_an_engine_on_a_store_that_is_not_empty_names_open(data: Dataset, tmp_path: Path) -> None:
    url = str(tmp_path / "engine.db")
    with make(store=url) as engine:
        engine.decide(data.X[0])
    with pytest.raises(StoreError, match=r"not empty; use DataEngine\.open"):
        make(store=url)


def test_opening_an_unused_store_names_the_way_to_make_one() -> None:
    with pytest.raises(StoreError, match="make a DataEngine with it"):
        DataEngine.open(MemoryStore())


REOPENED = [  # every reducer with its own recipe: tests/contracts
    pytest.param(RECIPE, id="pca"),
    pytest.param(RECIPE.with_policy(interval="jeffreys"), id="pca-jeffreys"),
    pytest.param(replace(RECIPE, window=64), id="pca-small-window"),
]


@pytest.mark.parametrize("recipe", REOPENED)
def test_open_goes_on_with_the_same_version_and_decisions_bit_for_bit(recipe, data: Dataset, tmp_path: Path) -> None:
    url = str(tmp_path / "engine.db")
    with make(recipe, store=url, seed=3) as engine:
        play(engine, data, slice(0, 130))  # labels since the last retrain included
        assert engine.version > 0
        assert engine.new_labels > 0
        version, new_labels = engine.version, engine.new_labels
        before = [evidence(engine.decide(x)) for x in data.X[130:150]]
    with DataEngine.open(url) as engine:
        assert (engine.version, engine.new_labels, engine.recipe, engine.seed) == (version, new_labels, recipe, 3)
        assert engine.trace == TraceSpec(samples=100)
        assert [evidence(engine.decide(x)) for x in data.X[130:150]] == before


def test_an_engine_that_was_opened_goes_on_as_one_that_never_closed(data: Dataset, tmp_path: Path) -> None:
    urls = [str(tmp_path / name) for name in ("whole.db", "broken.db")]
    with make(store=urls[0]) as engine:
        whole = play(engine, data)
    with make(store=urls[1]) as engine:
        parts = play(engine, data, slice(0, 93))
    with DataEngine.open(urls[1]) as engine:
        parts += play(engine, data, slice(93, 155))
    with DataEngine.open(urls[1]) as engine:
        parts += play(engine, data, slice(155, None))
    assert [evidence(c.decision) for c in parts] == [evidence(c.decision) for c in whole]


def test_open_before_the_first_retrain_keeps_the_labels(data: Dataset, tmp_path: Path) -> None:
    url = str(tmp_path / "engine.db")
    with make(store=url) as engine:
        play(engine, data, slice(0, 30))
    with DataEngine.open(url) as engine:
        assert (engine.version, engine.new_labels) == (0, 30)
        play(engine, data, slice(30, 40))
        assert engine.version == 1


def test_numpy_settings_survive_the_store(data: Dataset, tmp_path: Path) -> None:
    url = str(tmp_path / "engine.db")
    policy = Policy(alpha=np.linspace(0.1, 0.2, 2)[0], lower_bound=np.float64(0.9))
    with DataEngine("pca", policy, radius=np.float32(0.5), store=url) as engine:
        engine.decide(data.X[0])
    with DataEngine.open(url) as engine:
        assert (engine.policy, engine.recipe.radius) == (Policy(0.1, 0.9), 0.5)


def test_a_wrong_setting_raises_when_the_engine_is_made_not_at_its_first_retrain() -> None:
    with pytest.raises(SettingError, match="radius > 0"):
        DataEngine("pca", radius=-1.0)
    with pytest.raises(SettingError, match="no parameter dims"):
        DataEngine(recipe=Recipe("pca", {"dims": 3}))


# ------------------------------------------------------------------------------------------------------- executors


class Slow(Counting):
    """Its training waits for leave."""

    may_finish = Event()

    def fit(self, X, y):
        assert Slow.may_finish.wait(30)
        super().fit(X, y)


def test_the_cell_goes_on_while_a_retrain_runs_and_its_labels_are_in_the_new_version(data: Dataset) -> None:
    Slow.may_finish.clear()
    with ThreadPoolExecutor(1) as pool:
        engine = make(model=Slow(), executor=pool)
        during = play(engine, data, slice(0, 55))
        assert {c.decision.model_version for c in during} == {0}
        assert all(c.retrain is None for c in during)
        Slow.may_finish.set()
        pool.shutdown(wait=True)
        report = engine.settle()
        (after,) = play(engine, data, slice(55, 56))
    assert (report.version, report.n_traces, report.accepted) == (1, 40, True)
    assert after.decision.model_version == 1
    assert (after.decision.n_success, after.decision.n_failure) == (40, 15)


@pytest.mark.parametrize("kind", ["thread", "spawned process"])
def test_a_retrain_beside_the_cell_ends_where_one_in_line_ends(kind: str, data: Dataset) -> None:
    def learn(engine: DataEngine) -> DataEngine:
        ids = [engine.decide(x).id for x in data.X[:100]]
        for name, y in zip(ids, data.y[:100], strict=True):
            engine.report(name, bool(y))  # the eightieth sets the retrain off, the others come in meanwhile
        return engine

    recipe = replace(RECIPE, retrain_every=80)
    inline = learn(make(recipe))
    pool = ThreadPoolExecutor(1) if kind == "thread" else ProcessPoolExecutor(1, mp_context=get_context("spawn"))
    with pool:
        beside = learn(make(recipe, executor=pool))
    beside.settle()  # swaps in what the pool has finished
    assert inline.version == beside.version == 1
    assert len(beside.model.index) == 100
    assert [evidence(beside.decide(x)) for x in data.X[100:]] == [evidence(inline.decide(x)) for x in data.X[100:]]


def test_a_worker_that_dies_is_recorded_and_the_old_version_goes_on(data: Dataset) -> None:
    class Dying(ThreadPoolExecutor):
        def submit(self, fn, /, *args, **kwargs):
            return super().submit(lambda: (_ for _ in ()).throw(MemoryError("killed")))

    with Dying(1) as pool:
        engine = make(executor=pool)
        play(engine, data, slice(0, 40))
        engine.close()
        assert [(r.accepted, r.reason) for r in engine.store.retrains()] == [(False, "dropped: MemoryError: killed")]


def test_closing_waits_for_a_retrain_and_keeps_it(data: Dataset, tmp_path: Path) -> None:
    url = str(tmp_path / "engine.db")
    with ThreadPoolExecutor(1) as pool, make(store=url, executor=pool) as engine:
        play(engine, data, slice(0, 45))
    with DataEngine.open(url) as engine:
        assert engine.version == 1
        assert len(engine.model.index) == 45


def test_a_decision_that_waits_is_on_the_disk_when_it_returns(data: Dataset, tmp_path: Path) -> None:
    engine = make(RECIPE, store=tmp_path / "engine.db")
    decision = engine.decide(data.X[0], wait=True)
    with sqlite3.connect(tmp_path / "engine.db") as other:
        assert other.execute("SELECT id FROM decision").fetchall() == [(decision.id,)]
    engine.close()
