"""A dump: every table of a cell as Parquet, as the store holds it, and no folder of anything else touched."""

import os
import sqlite3
import uuid
from pathlib import Path

import numpy as np
import pytest

from dengine.errors import StoreError
from dengine.records import Action, Decision, Reason, RetrainReport, Source
from dengine.store import SqlStore, dump_store, verify_history
from dengine.store.dump import folder_name

pa = pytest.importorskip("pyarrow", reason="needs the extra files: pip install 'dengine[files]'")
pq = pytest.importorskip("pyarrow.parquet")
POSTGRES = os.environ.get("DENGINE_TEST_POSTGRES")
N, C, T = 1203, 2, 15  # more than a chunk


@pytest.fixture(
    params=[
        "sqlite",
        pytest.param(
            "postgres", marks=pytest.mark.skipif(not POSTGRES, reason="DENGINE_TEST_POSTGRES is unset: . .ci/postgres.sh")
        ),
    ]
)
def place(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, str]:
    return (str(tmp_path / "engine.db") if request.param == "sqlite" else str(POSTGRES)), uuid.uuid4().hex


def decision(name: str) -> Decision:
    return Decision(name, Action.VERIFY, Action.ACCEPT, 0.25, 1.0, 3, 1, ((0.5, 0.25),), 1, Reason.AUDIT, True, 0.02)


def write(store: SqlStore, n: int = N) -> np.ndarray:
    traces = np.random.default_rng(1).normal(size=(n, C, T)).astype(np.float32)
    names = [f"d{i:05d}" for i in range(n)]
    store.save_settings({"recipe": "a = 1"})
    store.put_labelled([decision(name) for name in names], traces, np.arange(n), np.arange(n) % 2, Source.VERIFICATION)
    store.put_decision(decision("late"), traces[0], 5, False, "SN-9")
    store.put_label("late", False, Source.AUDIT, 1, np.array([0.5, 2.0], np.float32), silent=3)
    store.put_version(RetrainReport(1, 0.25, 100, 60, True, "improved"), 5, {"w": np.zeros(5)})
    store.put_event("note", "wörtlich")
    return traces


def test_every_table_is_read_back_as_it_was_stored(place: tuple[str, str], tmp_path: Path) -> None:
    url, cell = place
    with SqlStore(url, cell, clock=lambda: 8.5) as store:
        traces = write(store)
        history = store.verify().cells[0]
        made = dump_store(url, tmp_path / "out", cell)
    tables = {path.stem: pq.read_table(path) for path in (tmp_path / "out" / cell).glob("*.parquet")}
    assert set(tables) == {"decision", "label", "model_version", "event", "correction", "setting", "ledger"}
    assert made.rows == {f"{cell}/{name}.parquet": table.num_rows for name, table in tables.items()}
    filled = [table for name, table in tables.items() if name != "correction"]
    assert {tuple(set(table["cell_id"].to_pylist())) for table in filled} == {(cell,)}

    decisions = tables["decision"]
    assert decisions.schema.field("trace").type == pa.list_(pa.float32(), C * T)
    found = np.stack(decisions["trace"].to_pylist()).astype(np.float32).reshape(-1, C, T)
    np.testing.assert_array_equal(found, np.concatenate([traces, traces[:1]]))
    last = decisions.slice(N).to_pylist()[0]
    assert (last["id"], last["part"], last["reason"], last["audit"]) == ("late", "SN-9", "audit", True)
    assert (last["lower"], last["upper"], last["time"], last["n_success"]) == (0.25, 1.0, 8.5, 3)
    assert (last["embedding"], last["content_hash"], len(last["trace_sum"])) == ("[[0.5, 0.25]]", 5, 32)

    labels = {row["decision_id"]: row for row in tables["label"].to_pylist()}
    assert [labels[f"d{i:05d}"]["success"] for i in range(4)] == [False, True, False, True]
    assert (labels["late"]["point"], labels["late"]["silent"], labels["late"]["source"]) == ([0.5, 2.0], 3, "audit")
    assert "state" not in tables["model_version"].column_names
    assert tables["model_version"].to_pylist()[0]["reason"] == "improved"
    assert tables["event"].to_pylist()[0]["text"] == "wörtlich"
    assert {row["key"]: row["value"] for row in tables["setting"].to_pylist()}["recipe"] == "a = 1"
    assert tables["ledger"].to_pylist()[-1]["digest"].hex() == history.digest
    assert len(tables["ledger"]) == history.entries


def test_cells_of_any_name_have_folders_of_their_own(tmp_path: Path) -> None:
    cells = ["cell", "line 2/cell 7", "..", ".hidden", "Ü"]
    for cell in cells:
        with SqlStore(str(tmp_path / "a.db"), cell) as store:
            store.put_event("note", cell)
    dump_store(str(tmp_path / "a.db"), tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir() if path.is_dir()) == sorted(map(folder_name, cells))
    assert len(set(map(folder_name, cells))) == len(cells)
    for cell in cells:
        assert pq.read_table(tmp_path / "out" / folder_name(cell) / "event.parquet")["text"].to_pylist() == [cell]


def test_traces_of_several_shapes_are_lists_of_their_own_length(tmp_path: Path) -> None:
    with SqlStore(str(tmp_path / "a.db")) as store:
        store.put_decision(decision("a"), np.zeros((1, 3), np.float32), 1, True)
        store.put_decision(decision("b"), np.ones((2, 4), np.float32), 2, False)
    dump_store(str(tmp_path / "a.db"), tmp_path / "out")
    rows = pq.read_table(tmp_path / "out" / "cell" / "decision.parquet").to_pylist()
    assert [(row["channels"], row["samples"], row["trace"]) for row in rows] == [(1, 3, [0.0] * 3), (2, 4, [1.0] * 8)]


def test_a_decision_whose_trace_is_gone_is_there_without_it(tmp_path: Path) -> None:
    with SqlStore(str(tmp_path / "a.db")) as store:
        for name in "ab":
            store.put_decision(decision(name), np.zeros((1, 3), np.float32), 1, False)
    with sqlite3.connect(tmp_path / "a.db") as connection:
        connection.execute("DELETE FROM trace WHERE decision_id = 'a'")
    dump_store(str(tmp_path / "a.db"), tmp_path / "out")
    rows = pq.read_table(tmp_path / "out" / "cell" / "decision.parquet").to_pylist()
    assert [row["trace"] for row in rows] == [None, [0.0] * 3]


def test_an_earlier_dump_is_replaced_as_a_whole(tmp_path: Path) -> None:
    url, out = str(tmp_path / "a.db"), tmp_path / "out"
    with SqlStore(url, "one") as store:
        store.put_event("note", "first")
        dump_store(url, out)
    with SqlStore(url, "two") as store:
        store.put_event("note", "second")
    dump_store(url, out, "two")
    assert [path.name for path in out.iterdir() if path.is_dir()] == ["two"]
    assert sorted(path.name for path in tmp_path.iterdir() if path.name.startswith(".")) == []


@pytest.mark.parametrize("beside", [True, False], ids=["beside a dump", "alone"])
def test_a_folder_that_holds_something_else_is_refused_and_left_alone(beside: bool, tmp_path: Path) -> None:
    url, out = str(tmp_path / "a.db"), tmp_path / "out"
    SqlStore(url).close()
    if beside:
        dump_store(url, out)
    (out / "thesis").mkdir(parents=True)
    (out / "thesis" / "chapter.txt").write_text("years of work")
    before = sorted(str(path) for path in out.rglob("*"))
    with pytest.raises(StoreError, match=r"holds something else \(thesis/chapter.txt\)"):
        dump_store(url, out)
    assert sorted(str(path) for path in out.rglob("*")) == before


@pytest.mark.parametrize("kind", ["file", "link", "the store itself"])
def test_what_is_no_folder_is_refused_and_left_alone(kind: str, tmp_path: Path) -> None:
    url, out = tmp_path / "a.db", tmp_path / "out"
    SqlStore(str(url)).close()
    if kind == "file":
        out.write_text("notes")
    elif kind == "link":
        (tmp_path / "elsewhere").mkdir()
        out.symlink_to(tmp_path / "elsewhere")
    else:
        out = url
    with pytest.raises(StoreError, match="holds something else"):
        dump_store(str(url), out)
    assert out.is_symlink() == (kind == "link")
    assert verify_history(str(url)).ok


def test_a_dump_that_fails_leaves_the_earlier_one(tmp_path: Path) -> None:
    url, out = str(tmp_path / "a.db"), tmp_path / "out"
    with SqlStore(url) as store:
        store.put_event("note", "first")
    dump_store(url, out)
    before = {path: path.read_bytes() for path in out.rglob("*.parquet")}
    with pytest.raises(StoreError, match="Expected a cell"):
        dump_store(url, out, "nobody")
    assert {path: path.read_bytes() for path in out.rglob("*.parquet")} == before
    assert sorted(path.name for path in tmp_path.iterdir() if path.name.startswith(".")) == []
