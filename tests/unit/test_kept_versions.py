"""Versions that keep their states: which they are, how one is loaded, and what becomes of a damaged
one.
"""

import numpy as np
import pytest

from dengine import DataEngine, Policy
from dengine.errors import StoreError
from dengine.experiments.baselines import AgreeingNeighbours
from dengine.store import SqlStore, verify_history
from tests.support.driving import learn
from tests.support.stores import execute, report


def put(store: SqlStore, versions: int) -> None:
    for version in range(1, versions + 1):
        store.versions.put(report(version), version, {"w": np.full(20, version, np.float32)})


def kept(store: SqlStore) -> list[int]:
    return [row.report.version for row in store.versions.all() if row.kept]


def test_every_retrain_is_listed_for_ever_and_what_is_kept_is_loaded_by_its_number(
    store,
):
    put(store, 34)
    store.versions.put(report(34, accepted=False), 35, None)
    rows, numbers = store.versions.all(), [1, 10, 20, 30, 31, 32, 33, 34]
    listed = [(row.report.version, row.report.accepted, row.kept) for row in rows]
    expected = [(version, True, version in numbers) for version in range(1, 35)]
    assert listed == [*expected, (34, False, False)]
    assert [row.time for row in rows] == sorted(row.time for row in rows)
    assert [row.n_bytes > 0 for row in rows] == [row.kept for row in rows]
    for version in numbers:
        result = store.versions.load(version)
        assert (result.version, result.last_seq) == (version, version)
        assert result.state["w"].tolist() == [float(version)] * 20
    result.state["w"][:] = 0  # an array of its own
    assert store.versions.load(34).state["w"][0] == 34
    for version in (2, 35, 0):
        message = f"got {version}, which is not kept; load one of these: 1, 10, 20, 30, 31"
        with pytest.raises(StoreError, match=message):
            store.versions.load(version)


def test_a_store_may_keep_all_or_more_and_never_so_few_that_none_is_left_to_fall_back_on(
    tmp_path,
):
    for keep, numbers in ((None, list(range(1, 13))), (8, [1, 5, 6, 7, 8, 9, 10, 11, 12])):
        file = f"{tmp_path}/{keep}.db"
        with SqlStore(file, keep_versions=keep) as store:
            put(store, 12)
            assert kept(store) == numbers
            assert verify_history(file).ok
    for keep in (1, True, 2.5):
        with pytest.raises(StoreError, match="keep_versions of 2 or more"):
            SqlStore(f"{tmp_path}/c.db", keep_versions=keep)


def test_an_engine_goes_on_with_the_version_before_and_numbers_the_next_as_if_nothing_was(
    data, tmp_path
):
    file = tmp_path / "engine.db"
    with DataEngine("pca", store=file, retrain_every=30) as engine:
        learn(engine, data, range(100))
        assert engine.version == 3
    execute(file, "UPDATE model_version SET state = zeroblob(length(state)) WHERE version = 3")
    with DataEngine.open(file) as engine:
        decision = engine.decide(data.X[101])
        assert engine.version == decision.model_version == 2
        # It trains on the labels that came after version 2.
        assert engine.report(decision.id, True).version == 4
        assert [event.kind for event in engine.store.events.newest()] == ["damaged"]
    with DataEngine.open(file) as engine:
        assert engine.version == 4


def test_a_model_that_is_refitted_is_not_refitted_without_a_trace_that_is_damaged(data, tmp_path):
    """Fitted on the others, its references would lie elsewhere: the engine verifies, and learns
    anew.
    """
    file, baseline = tmp_path / "engine.db", AgreeingNeighbours(Policy(0.1, 0.9))
    with DataEngine(model=baseline, store=file, retrain_every=40) as engine:
        learn(engine, data, range(50))
        assert engine.version == 1
    execute(file, "UPDATE trace SET data = zeroblob(400) WHERE rowid = 7")
    with DataEngine.open(file, model=AgreeingNeighbours(Policy(0.1, 0.9))) as engine:
        assert (engine.version, engine.model) == (0, None)
        assert [event.kind for event in engine.store.events.newest()] == ["damaged"]
        learn(engine, data, [60])
        assert engine.version == 2
