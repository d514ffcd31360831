"""Versions that keep their states: which they are, how one is loaded, and what becomes of a damaged
one.
"""

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from dengine import DataEngine, Dataset, Policy
from dengine.errors import StoreError
from dengine.experiments.baselines import AgreeingNeighbours
from dengine.store import SqlStore, StoredDecision, verify_history
from dengine.store.records import KEEP, keeps_state
from tests.support.driving import learn
from tests.support.stores import decision, execute, report


def put(store: SqlStore, versions: int) -> None:
    for version in range(1, versions + 1):
        store.versions.put(report(version), version, {"w": np.full(20, version, np.float32)})


def kept(store: SqlStore) -> list[int]:
    return [row.report.version for row in store.versions.all() if row.kept]


def test_the_newest_the_first_and_ever_fewer_of_the_older_ones_keep_their_states(
    store: SqlStore,
) -> None:
    put(store, 34)
    assert kept(store) == [1, 10, 20, 30, 31, 32, 33, 34]


def test_what_is_kept_grows_with_the_logarithm_of_what_was_trained() -> None:
    names: set[int] = set()
    most = {}
    for newest in range(1, 20_001):
        names = {version for version in names | {newest} if keeps_state(version, newest, KEEP)}
        most[newest] = len(names)
    assert names >= {1, 10_000, 19_000, 19_900, 19_990, 19_996, 20_000}
    assert max(most.values()) == most[20_000] == 34


def test_a_new_state_takes_the_room_of_those_that_are_not_kept_any_more(tmp_path: Path) -> None:
    file = tmp_path / "a.db"
    state = np.random.default_rng(0).random(2**17)  # 1 MiB
    with SqlStore(str(file), keep_versions=2) as store:
        for version in range(1, 10):
            store.versions.put(report(version), version, {"w": state})
        assert kept(store) == [1, 8, 9]
    assert 3 * 2**20 < file.stat().st_size < 3.6 * 2**20


@pytest.mark.parametrize("samples", [200, 600, 1000, 1900])
def test_traces_fill_the_pages_of_a_file(samples: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    file = tmp_path / "a.db"
    items = [
        StoredDecision(
            decision(f"part {i}"), rng.random((1, samples), dtype=np.float32), i, False, float(i)
        )
        for i in range(200)
    ]
    with SqlStore(str(file)) as store:
        store.apply_records(items)
    with closing(sqlite3.connect(file)) as connection:
        query = "SELECT sum(pgsize) FROM dbstat WHERE name = 'trace'"
        (n_bytes,) = connection.execute(query).fetchone()
    assert n_bytes < 1.4 * sum(item.trace.nbytes for item in items)


def test_a_version_is_loaded_by_its_number(store: SqlStore) -> None:
    put(store, 12)
    for version in (1, 10, 12):
        result = store.versions.load(version)
        assert (result.version, result.last_seq, result.state["w"].tolist()) == (
            version,
            version,
            [float(version)] * 20,
        )
    result.state["w"][:] = 0  # an array of its own
    assert store.versions.load(12).state["w"][0] == 12
    for version in (2, 13, 0):
        with pytest.raises(
            StoreError,
            match=rf"got {version}, which is not kept; load one of these: 1, 8, 9, 10, 11, 12",
        ):
            store.versions.load(version)


def test_every_retrain_is_listed_for_ever(store: SqlStore) -> None:
    with pytest.raises(StoreError, match="load one of these: none"):
        store.versions.load(1)
    put(store, 7)
    store.versions.put(report(7, accepted=False), 9, None)
    rows = store.versions.all()
    listed = [(row.report.version, row.report.accepted, row.kept) for row in rows]
    kept_ones = [(version, True, version != 2) for version in range(1, 8)]
    assert listed == [*kept_ones, (7, False, False)]
    assert [row.time for row in rows] == sorted(row.time for row in rows)
    assert [row.n_bytes > 0 for row in rows] == [row.kept for row in rows]


def test_a_store_may_keep_all_or_more_and_never_so_few_that_none_is_left_to_fall_back_on(
    tmp_path: Path,
) -> None:
    with SqlStore(str(tmp_path / "a.db"), keep_versions=None) as store:
        put(store, 12)
        assert len(kept(store)) == 12
    with SqlStore(str(tmp_path / "b.db"), keep_versions=8) as store:
        put(store, 12)
        assert kept(store) == [1, 5, 6, 7, 8, 9, 10, 11, 12]
        assert verify_history(str(tmp_path / "b.db")).ok
    for keep in (1, 0, True, 2.5):
        with pytest.raises(StoreError, match="keep_versions of 2 or more"):
            SqlStore(str(tmp_path / "c.db"), keep_versions=keep)


def damage(file: Path, *versions: int) -> None:
    execute(
        file,
        *(
            f"UPDATE model_version SET state = zeroblob(length(state)) WHERE version = {version}"
            for version in versions
        ),
    )


def test_an_engine_goes_on_with_the_version_before_and_numbers_the_next_as_if_nothing_was(
    data, tmp_path: Path
) -> None:
    file = tmp_path / "engine.db"
    with DataEngine("pca", store=file, retrain_every=30) as engine:
        learn(engine, data, range(100))
        assert engine.version == 3
    damage(file, 3)
    with DataEngine.open(str(file)) as engine:
        assert engine.version == 2
        assert engine.model is not None
        decision = engine.decide(data.X[101])
        assert decision.model_version == 2
        assert (
            engine.report(decision.id, True).version == 4
        )  # with the labels that came after version 2
        assert [event.kind for event in engine.store.events.newest()] == ["damaged"]
    with DataEngine.open(str(file)) as engine:
        assert engine.version == 4


def test_a_model_that_is_refitted_is_not_refitted_without_a_trace_that_is_damaged(
    data: Dataset, tmp_path: Path
) -> None:
    """Fitted on the others, its references would lie elsewhere: the engine verifies, and learns
    anew.
    """
    file = tmp_path / "engine.db"
    baseline = AgreeingNeighbours(Policy(0.1, 0.9))
    with DataEngine(model=baseline, store=file, retrain_every=40) as engine:
        learn(engine, data, range(50))
        assert engine.version == 1
    execute(file, "UPDATE trace SET data = zeroblob(400) WHERE rowid = 7")
    with DataEngine.open(str(file), model=AgreeingNeighbours(Policy(0.1, 0.9))) as engine:
        assert (engine.version, engine.model) == (0, None)
        assert [event.kind for event in engine.store.events.newest()] == ["damaged"]
        engine.report(engine.decide(data.X[60]).id, bool(data.y[60]))
        assert engine.version == 2
