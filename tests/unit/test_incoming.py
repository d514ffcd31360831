"""A version that was trained beside the cell comes in by steps: none of them waits for the store or
for many labels.
"""

from concurrent.futures import ThreadPoolExecutor
from threading import Event

import pytest

from dengine import DataEngine
from tests.support.driving import RECIPE, Counting, evidence, learn


class Slow(Counting):
    """Needs a second for each label, by a clock of its own."""

    now = 0.0

    def add(self, x, y):
        super().add(x, y)
        Slow.now += 1.0


class Held(ThreadPoolExecutor):
    """Takes work and begins it when it is told to."""

    def __init__(self) -> None:
        super().__init__(1)
        self.go = Event()
        super().submit(self.go.wait, 30)


@pytest.fixture
def engine(data):
    """Forty labels set a retrain off beside it, sixteen came in meanwhile, and it has ended; nobody
    has looked yet.
    """
    pool = Held()
    engine = DataEngine(model=Slow(), recipe=RECIPE, executor=pool, clock=lambda: Slow.now)
    learn(engine, data, range(56))
    assert engine.state.is_retraining
    assert not engine.state.is_swapping
    pool.go.set()
    pool.shutdown(wait=True)
    return engine


def test_a_decision_brings_a_version_in_by_one_step_of_one_label_at_most(engine, data):
    # It is taken and made ready, sixteen labels come in, and it is stored and answers.
    seconds, versions = [], []
    for x in data.X[100:119]:
        before = Slow.now
        decision = engine.decide(x)
        seconds.append(Slow.now - before)
        versions.append(decision.model_version)
    assert seconds == [0.0] * 2 + [1.0] * 16 + [0.0]
    assert versions == [0] * 18 + [1]
    assert (decision.n_success, decision.n_failure) == (40, 16)
    assert not engine.state.is_swapping


def test_settle_brings_a_version_in_to_the_end_and_briefly_by_one_step(engine):
    assert engine.poll(brief=True) is None
    assert engine.state.is_swapping
    report = engine.poll()
    assert (report.version, report.n_traces, report.accepted, engine.version) == (1, 40, True, 1)


def test_a_cell_that_never_pauses_gets_its_version(data, tmp_path):
    pool = Held()
    store = tmp_path / "engine.db"
    with DataEngine(model=Counting(), recipe=RECIPE, executor=pool, store=store) as engine:
        learn(engine, data, range(56))
        pool.go.set()
        pool.shutdown(wait=True)
        learn(engine, data, range(56, 156))  # at each moment the store lacks a label
        assert engine.version > 0


def test_whenever_an_engine_that_swaps_by_steps_is_closed_the_opened_one_decides_the_same(
    data, tmp_path
):
    probe = data.X[180:]
    for n in (55, 83, 97, 121):
        with ThreadPoolExecutor(1) as pool:
            engine = DataEngine(recipe=RECIPE, executor=pool, store=tmp_path / f"{n}.db")
            for i in range(n):
                learn(engine, data, [i])
                engine.poll(brief=True)
            engine.close()
        with DataEngine.open(tmp_path / f"{n}.db") as first:
            expected = [evidence(first.decide(x)) for x in probe]
            assert len(first.model.index) == n
        with DataEngine.open(tmp_path / f"{n}.db") as second:
            assert [evidence(second.decide(x)) for x in probe] == expected
