"""The one loop: decide, report, retrain, run, open. Real reducers, real stores, real executors."""

import subprocess
import sys
from collections import Counter
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from threading import Event
from time import sleep
from unittest.mock import Mock

import numpy as np
import pytest

from dengine import (
    Action,
    DataEngine,
    Dataset,
    Reason,
    ReplayCell,
    Source,
    TraceSpec,
)
from dengine.engine import trainer
from dengine.errors import SettingError, StoreError
from dengine.reducers import ConvReducer
from dengine.store import SqlStore
from tests.support.driving import RECIPE, Counting, evidence, learn, make
from tests.support.driving import drive as play


def good(data: Dataset, n: int = 1) -> np.ndarray:
    return data.X[np.flatnonzero(data.y == 1)[-n]]


@pytest.fixture
def trained(data):
    engine = make()
    play(engine, data, 0, 90, confirm=True)
    return engine


def state(engine: DataEngine) -> tuple[int, ...]:
    """What a report changes: how many labels are stored, counted and new, and the version."""
    n_stored = engine.store.decisions.counts()["labels"]
    return n_stored, len(engine.model.index), engine.state.new_labels, engine.version


def test_each_action_asks_its_own_question_of_the_cell_exactly_once(data):
    asked: list[str] = []

    class Listening(ReplayCell):
        def __getattribute__(self, name: str):
            asked.extend({"verify", "proceed", "reject"} & {name})
            return super().__getattribute__(name)

    engine = make(replace(RECIPE, radius=0.4))
    actions = [cycle.decision.action for cycle in engine.run(Listening(data), len(data))]
    assert [name.replace("proceed", "accept") for name in asked] == actions
    assert {*actions} == set(Action)


@pytest.mark.parametrize("lacks", ["reject", "insert verify proceed reject"])
def test_a_cell_without_one_of_its_four_methods_is_refused_before_the_first_part(lacks):
    methods = {"insert", "verify", "proceed", "reject"} - {*lacks.split()}
    half = type("Half", (), dict.fromkeys(methods, pytest.fail))()
    message = f"Expected a cell with the methods .*got Half without {' and '.join(lacks.split())};"
    with pytest.raises(SettingError, match=message):
        make().run(half, 1)


def test_an_engine_that_was_opened_for_reading_neither_decides_nor_learns_nor_disturbs(data):
    engine = make()
    id_ = play(engine, data, 0, 10)[-1].decision.id
    reader = DataEngine.open(engine.store, reading=True)
    decide, report = partial(reader.decide, data.X[11]), partial(reader.report, id_, True)
    for call in (reader.poll, reader.retrain, decide, report):
        with pytest.raises(StoreError, match="opened for reading"):
            call()
    engine.decide(data.X[11])
    assert engine.store.decisions.counts()["decisions"] == 11


def test_a_trace_that_comes_again_has_no_vote_on_itself(trained, data):
    decision = trained.decide(good(data))
    trained.report(decision.id, success=False)
    assert decision.action is Action.ACCEPT
    assert trained.find(decision.id).source is Source.STOP
    for by, n_failure in ((0, 0), (1e-3, 1)):
        votes = trained.decide(good(data) + np.float32(by))
        assert votes.n_success == decision.n_success
        assert votes.n_failure == decision.n_failure + n_failure


def test_a_report_is_counted_at_once_and_retrains_every_so_many_labels(data):
    engine, n = make(replace(RECIPE, retrain_every=20)), 0
    for x, y in zip(data.X[:90], data.y[:90] == 1, strict=True):
        decision = engine.decide(x)
        if decision.action is Action.VERIFY:
            n += 1
            report = engine.report(decision.id, y)
            assert (report is None) == (n % 20 != 0)
            if report:
                assert (report.version, report.n_traces, report.accepted) == (n // 20, n, True)
    assert engine.version == n // 20 > 1


# Of the seventh sample, or of all of a trace.
@pytest.mark.parametrize(
    "line",
    [
        "not_finite nan",
        "not_finite inf",
        "too_large 3e38",
        "too_large -3e38",
        "too_large 1.1e18",
        "saturated -200",
        "constant 0",
    ],
)
def test_a_bad_trace_is_verified_with_its_reason_kept_and_never_trained_on(line, data):
    reason, sample = line.split()
    engine = make(trace=TraceSpec(samples=100, limit=None if reason == "too_large" else 150.0))
    play(engine, data, 0, 41)
    (n, *before), x = state(engine), good(data).astype(np.float64)
    x[... if reason == "constant" else 7] = float(sample)
    decision = engine.decide(x)
    assert (decision.action, decision.reason, decision.embedding) == (Action.VERIFY, reason, None)
    assert engine.report(decision.id, success=True) is None
    stored = engine.store.decisions.get(decision.id)
    assert (stored.quarantined, stored.success) == (True, True)
    np.testing.assert_array_equal(stored.trace[0], x.astype(np.float32))
    assert state(engine) == (n + 1, *before)
    for scale in (1e15, 1e30):  # finite and beyond all measure
        assert engine.decide(good(data) * np.float32(scale)).action is Action.VERIFY


@pytest.mark.parametrize(
    ("at", "later"), [("add", Reason.UNCERTAIN), ("predict_interval", Reason.MODEL_ERROR)]
)
def test_a_model_that_fails_at_a_label_or_a_trace_loses_neither_it_nor_the_cell(
    data, at, later, monkeypatch
):
    monkeypatch.setattr(Counting, at, Mock(side_effect=RuntimeError))
    engine = make(model=Counting())
    reasons = Counter(c.decision.reason for c in play(engine, data, 0, 130))
    assert reasons == {Reason.NO_MODEL: 40, later: 90}
    counts = engine.store.decisions.counts()
    assert (counts["labels"], counts["actions"]["verify"], engine.version) == (130, 130, 3)


def test_a_dropped_candidate_leaves_the_old_version_answering_and_three_are_an_alarm(
    data, tmp_path
):
    with make(store=tmp_path / "e.db") as engine:
        play(engine, data, 0, 60)
        version, before = engine.version, evidence(engine.decide(good(data)))
        engine.model.spaces.n_components = 500  # what the next one starts from cannot be trained
        for _ in range(3):
            assert engine.state.retrain_fault == engine.status().alarm == ""
            report = engine.retrain()
            assert (report.accepted, report.version) == (False, version)
            assert evidence(engine.decide(good(data))) == before
        text = engine.status().alarm
        assert text.startswith("The last 3 retrains were dropped, so nothing new is learned; ")
        assert "PCA needs more than 500 traces" in text
    with DataEngine.open(tmp_path / "e.db", replaying=True) as engine:
        assert engine.state.retrain_fault == engine.status().alarm == text
        assert engine.retrain().accepted
        assert engine.state.retrain_fault == engine.status().alarm == ""


@pytest.mark.parametrize("where", ["insert", "verify", "proceed"])
def test_an_exception_of_the_cell_propagates_after_everything_known_is_written(
    where, data, tmp_path, monkeypatch
):
    real, cycles = getattr(ReplayCell, where), []

    def failing(self):
        if self.position >= 89 - (where == "insert"):
            raise ConnectionError("gripper lost")
        return real(self)

    monkeypatch.setattr(ReplayCell, where, failing)
    with make(store=tmp_path / "engine.db") as engine:
        with pytest.raises(ConnectionError, match="gripper lost"):
            cycles.extend(engine.run(ReplayCell(data), 200))  # keeps what came before the exception
        with SqlStore(tmp_path / "engine.db") as other:  # beside the engine, which is still open
            counts = other.decisions.counts()
    assert counts["labels"] == sum(c.success is not None for c in cycles) > 40
    assert counts["decisions"] >= len(cycles) + (where != "insert")


def test_an_engine_that_was_opened_goes_on_as_one_that_never_closed(data, tmp_path):
    url, recipe = tmp_path / "broken.db", RECIPE
    with make(recipe, seed=3) as engine:
        whole = play(engine, data, 0, 150)
    with make(recipe, store=url, seed=3) as engine:
        parts = play(engine, data, 0, 30)
    for first, last in ((30, 93), (93, 150)):
        with DataEngine.open(url) as engine:
            assert (engine.recipe, engine.seed, engine.trace) == (recipe, 3, TraceSpec(samples=100))
            parts += play(engine, data, first, last)
    assert [evidence(c.decision) for c in parts] == [evidence(c.decision) for c in whole]
    with pytest.raises(StoreError, match=r"not empty; use DataEngine\.open"):
        make(store=url)
    with pytest.raises(StoreError, match="make a DataEngine with it"):
        DataEngine.open(SqlStore())


# That one in a process of its own does so too is in test_retraining_process.py.
def test_a_retrain_beside_the_cell_ends_where_one_in_line_ends(data):
    said = []
    with ThreadPoolExecutor(1) as pool:
        for executor in (None, pool):
            engine = make(replace(RECIPE, retrain_every=80), executor=executor)
            ids = [engine.decide(x).id for x in data.X[:100]]
            for name, y in zip(ids, data.y[:100] == 1, strict=True):
                engine.report(name, y)  # the eightieth sets the retrain off
            while engine.state.is_retraining:
                engine.poll()
            assert (engine.version, len(engine.model.index)) == (1, 100)
            said.append([evidence(engine.decide(x)) for x in data.X[100:]])
    assert said[0] == said[1]


def test_a_second_thread_in_an_engine_is_refused(data):
    entered, leave = Event(), Event()

    class Slow(Counting):
        def predict_interval(self, X):
            entered.set()
            assert leave.wait(60)
            return super().predict_interval(X)

    engine = DataEngine(model=Slow())
    learn(engine, data, [0])
    engine.retrain()
    with ThreadPoolExecutor(1) as pool:
        deciding = pool.submit(engine.decide, data.X[1])
        assert entered.wait(60)
        with pytest.raises(StoreError, match="another thread"):
            engine.decide(data.X[2])
        leave.set()
        assert deciding.result().action is Action.VERIFY


class Slowing(ConvReducer):
    """Takes, by a clock of its own, 0.02 s for a step and 0.2 s for what comes after the steps."""

    now = 0.0

    def train_step(self, *arguments):
        Slowing.now += 0.02
        return super().train_step(*arguments)

    def estimate_statistics(self, x):
        Slowing.now += 0.2
        super().estimate_statistics(x)


def test_a_retrain_leaves_the_time_that_the_last_one_needed_after_its_steps(data):
    recipe = replace(RECIPE, reducer=Slowing(folds=2), retrain_every=1000, budget=0.45)
    engine = DataEngine(recipe=recipe, clock=lambda: Slowing.now)
    learn(engine, data, range(30))
    first, second = engine.retrain(), engine.retrain()
    assert first.seconds > 0.45 >= second.seconds
    assert second.n_steps == first.n_steps - 4


def test_a_training_counts_as_hung_only_from_when_a_discarded_one_is_done(monkeypatch):
    monkeypatch.setattr(trainer, "HUNG", 0.05)
    discarded, waiting = Future(), Future()
    executor = Mock(submit=Mock(side_effect=[discarded, waiting]))
    retrainer = trainer.Retrainer(trainer.TrainingWindow(10), None, None, executor)
    assert retrainer.start(Mock())
    discarded.set_running_or_notify_cancel()
    assert retrainer.discard()
    assert retrainer.start(Mock())
    sleep(0.1)
    discarded.set_result(None)
    assert retrainer.collect() is None
    assert retrainer.future is waiting


def test_a_training_that_ends_right_after_the_timeout_is_taken_and_a_failure_has_no_duration(
    monkeypatch,
):
    monkeypatch.setattr(trainer, "N_REMEMBERED", 1)
    slow, executor = trainer.Trained(None, "accepted", last_seconds=0.6), Mock()
    executor.submit().result.side_effect = [TimeoutError, slow, OSError, OSError]
    retrainer = trainer.Retrainer(trainer.TrainingWindow(10), 1.0, None, executor)
    for reason in ("accepted", "dropped: OSError: "):
        retrainer.start(Mock())
        assert retrainer.collect(wait=1.0).reason == reason
    retrainer.start(Mock())
    assert executor.submit.call_args.args[3] == 0.4  # seconds, since the slow one needed 0.6


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", ["DataEngine()", "next(DataEngine(executor=Pool(1)).run(ReplayCell('insertion'), 1))"]
)
def test_an_engine_that_retrains_itself_and_a_run_have_loaded_what_a_retrain_imports(words):
    imports = "from concurrent.futures import ThreadPoolExecutor as Pool; from dengine import *"
    words = f"{imports}; import sys; {words}; assert 'torch._dynamo' in sys.modules"
    subprocess.check_call([sys.executable, "-c", words])
