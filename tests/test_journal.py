"""A cell's journal comes back into the store once, bad traces into quarantine."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from dengine import Dataset, Recipe, TraceSpec, load_exported
from dengine.cli.export import export, import_labels
from dengine.engine import DataEngine
from dengine.errors import DataError
from dengine.importing import import_journal, read_journal


@pytest.fixture
def store(data: Dataset, tmp_path: Path) -> str:
    path = str(tmp_path / "engine.db")
    with DataEngine.from_recipe(Recipe(reducer="pca", retrain_every=1000), path, replaying=True) as engine:
        for x, y in zip(data.X, data.y, strict=True):
            engine.report(engine.decide(x).id, bool(y))
        engine.retrain()
    return path


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
    back = read_journal(path, TraceSpec(40, channels=3))
    np.testing.assert_array_equal(back.X, new.X)
    np.testing.assert_array_equal(back.y, new.y)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1,2,3", "1 or 0 and 100 samples in line 1"),
        ("2" + ",1" * 100, "got '2'"),
        ("1,x", "no row of numbers"),
        ("", "no labels"),
    ],
)
def test_a_line_that_does_not_fit_is_named(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "cell.csv"
    path.write_text(line)
    with pytest.raises(DataError, match=message):
        read_journal(path, TraceSpec(100))


def test_the_verbs_export_and_import(store: str, make_data: Callable[..., Dataset], tmp_path: Path) -> None:
    out = tmp_path / "model.ts"
    done = CliRunner().invoke(export, [store, "--out", str(out)], catch_exceptions=False)
    assert "version 1 with 200 labelled references" in " ".join(done.output.split())
    assert load_exported(out).metadata["references"] == 200
    new = make_data(30, seed=4)
    journal = write(tmp_path / "cell.csv", new.X, new.y)
    done = CliRunner().invoke(import_labels, [str(journal), "--store", store, "--json"], catch_exceptions=False)
    assert '"imported": 30' in done.output
