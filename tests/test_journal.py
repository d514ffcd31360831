"""A cell's journal comes back into the store once, bad traces into quarantine."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from dengine import Dataset, Policy, Recipe, TraceSpec, load_exported
from dengine.cli.export import export, import_labels
from dengine.engine import DataEngine
from dengine.errors import DataError
from dengine.folds import content_hash, part_hash
from dengine.importing import import_journal, read_journal
from dengine.records import Reason

HEAD = "# dengine 2 0123\n"


def new_store(data: Dataset, path: Path, **policy: Any) -> str:
    """An engine's store, after its first retrain."""
    recipe = Recipe(reducer="pca", retrain_every=1000, policy=Policy(alpha=0.1, lower_bound=0.9, **policy))
    with DataEngine.from_recipe(recipe, str(path), replaying=True) as engine:
        for x, y in zip(data.X, data.y, strict=True):
            engine.report(engine.decide(x).id, bool(y))
        engine.retrain()
    return str(path)


@pytest.fixture
def store(data: Dataset, tmp_path: Path) -> str:
    return new_store(data, tmp_path / "engine.db")


def write(path: Path, X: np.ndarray, y: np.ndarray) -> Path:
    rows = [f"{label}," + ",".join(f"{v:.9g}" for v in x) for x, label in zip(X, y, strict=True)]
    path.write_text("# dengine 0123\n" + "\n".join(rows) + "\n")
    return path


def test_each_line_counts_once(store: str, make_data: Callable[..., Dataset], tmp_path: Path) -> None:
    new = make_data(30, seed=4)
    new.X[3, 5] = np.nan
    part = write(tmp_path / "cell.csv", new.X[:20], new.y[:20])
    first = import_journal(store, part)
    whole = import_journal(store, write(part, new.X, new.y))
    assert (first.imported, first.quarantined, first.known) == (19, 1, 0)
    assert (whole.imported, whole.quarantined, whole.known) == (10, 0, 20)
    with DataEngine.open(store) as engine:
        assert engine.retrain().n_traces == 200 + 29


def test_a_journal_reads_as_it_was_written(make_data: Callable[..., Dataset], tmp_path: Path) -> None:
    new = make_data(10, 40, 3)
    path = write(tmp_path / "cell.csv", new.X.reshape(10, -1), new.y)
    back = read_journal(path, TraceSpec(40, channels=3)).lines
    np.testing.assert_array_equal([line.trace for line in back], new.X)
    assert [line.label for line in back] == new.y.astype(bool).tolist()
    assert {line.reason for line in back} == {Reason.NO_MODEL}


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1,2,3", "Expected 100 samples in line 1 of .*, got 2; it is damaged, or of another cell"),
        ("2" + ",1" * 100, "Expected a label of 1 or 0 in line 1 of .*, got '2'"),
        ("1,x" + ",1" * 99, "line 1 of .* are no row of numbers: .*'x'"),
        ("", "no labels"),
        (HEAD + "1,P1,verify,verify,uncertain,0,1,0,0,7", "Expected 100 samples in line 2"),
        (HEAD + "1", "The decision in line 2"),
        (
            HEAD + "1,P1,think,verify,uncertain,0,1,0,0" + ",1" * 100,
            "The decision in line 2 .*'think' is not a valid Action",
        ),
        (HEAD + ",P1,verify,verify,uncertain,0,1,0,0" + ",1" * 100, "label of 1 or 0, or an accepted one, in line 2"),
        (HEAD + "0,P1,reject,reject,certain,0,0.1,0,9" + ",1" * 100, "label of 1 or 0, or an accepted one, in line 2"),
    ],
)
def test_a_line_that_does_not_fit_is_named(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "cell.csv"
    path.write_text(line + "\n")
    with pytest.raises(DataError, match=message):
        read_journal(path, TraceSpec(100))


def write_cell(path: Path, X: np.ndarray, lines: list[str]) -> Path:
    """A journal of the second form; `lines` are what comes before the samples."""
    rows = [f"{line}," + ",".join(f"{v:.9g}" for v in x) for x, line in zip(X, lines, strict=False)]
    path.write_text(HEAD + "\n".join(rows) + "\n")
    return path


CELL = [
    "1,P1,verify,verify,uncertain,0.25,0.75,5,5",
    ",P2,accept,accept,certain,0.925,1,30,0",
    "0,P3,accept,accept,certain,0.9375,1,31,0",
    "1,,accept,accept,certain,0.9375,1,31,0",
    "0,P4,verify,accept,audit,0.9375,1,31,0",
    "0,P1,verify,verify,novel,0,1,0,0",
    ",P5,accept,accept,certain,0.95,1,40,0",
]


@pytest.mark.parametrize("stops", ["some", "all"])
def test_a_journal_brings_bounds_parts_and_sources(
    data: Dataset, make_data: Callable[..., Dataset], tmp_path: Path, stops: Any
) -> None:
    path = new_store(data, tmp_path / "engine.db", stops=stops, guarantee="pooled", audit_rate=0.1)
    X = make_data(7, seed=4).X
    journal = write_cell(tmp_path / "cell.csv", X, CELL)
    for again in (False, True):  # the same file twice counts nothing twice
        report = import_journal(path, journal)
        n = 6 if stops == "all" else 5
        assert (report.imported, report.quarantined, report.known) == ((0, 0, n) if again else (n, 0, 0))
        with DataEngine.open(path) as engine:
            known, last = engine.store.evidence_since(200), engine.store.labelled(n)
            outcomes, sources = engine.store.outcomes(), engine.store.status()["sources"]
            members = engine.model.rule.state_dict()["members"].clone()
        lower, success = [0.25, 0.925, 0.9375, 0.9375, 0.9375, 0.0], [True, True, False, True, False, False]
        hashes = [part_hash(p) for p in ("P1", "P2", "P3", "", "P4", "P1")]
        hashes[3] = int(content_hash(X[3:4])[0])
        silent = [0, 0, 0, 0, 0, 0]
        if stops == "some":  # of the second nothing is known
            lower, success, hashes = (values[:1] + values[2:] for values in (lower, success, hashes))
            silent = [0, 1, 0, 0, 0]
        assert known.lower.tolist() == lower
        assert known.success.tolist() == success
        assert known.silent.tolist() == silent
        assert known.novel.tolist() == [False] * (n - 1) + [True]
        assert last.hashes.tolist() == hashes
        assert (outcomes.stops, outcomes.audited_accepts, outcomes.audited_accepts_bad) == (1, 1, 1)
        assert (outcomes.accepted, outcomes.confirmed) == ((3, 2) if stops == "all" else (4, 1))
        assert sources == {"verification": 202, "audit": 1, "stop": 1, "confirmed": outcomes.confirmed}
        assert int(members.sum()) > 0


@pytest.mark.parametrize("stops", ["some", "all"])
def test_a_journal_that_grew_adds_what_is_new(
    data: Dataset, make_data: Callable[..., Dataset], tmp_path: Path, stops: Any
) -> None:
    X, found = make_data(7, seed=4).X, {}
    new = new_store(data, tmp_path / "new.db", stops=stops, audit_rate=0.1)
    for cuts in ([7], [2, 3, 7], range(1, 8)):
        path = shutil.copy(new, str(tmp_path / f"{len(cuts)}.db"))
        for n in cuts:
            import_journal(path, write_cell(tmp_path / "cell.csv", X, CELL[:n]))
        with DataEngine.open(path) as engine:
            known = engine.store.evidence_since(200)
            found[len(cuts)] = (known.lower.tolist(), known.silent.tolist(), engine.store.outcomes())
            engine.decide(X[0])
            engine.report(engine.decide(make_data(1, seed=8, noise=9.0).X[0]).id, True)  # silence adds up: no StoreError
    assert found[1] == found[3] == found[7]


def test_the_verbs_export_and_import(store: str, make_data: Callable[..., Dataset], tmp_path: Path) -> None:
    out = tmp_path / "model.ts"
    done = CliRunner().invoke(export, [store, "--out", str(out)], catch_exceptions=False)
    assert "version 1 with 200 labelled references" in " ".join(done.output.split())
    assert load_exported(out).metadata["references"] == 200
    new = make_data(30, seed=4)
    journal = write(tmp_path / "cell.csv", new.X, new.y)
    done = CliRunner().invoke(import_labels, [str(journal), "--store", store, "--json"], catch_exceptions=False)
    assert '"imported": 30' in done.output
