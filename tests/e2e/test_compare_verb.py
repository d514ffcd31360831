"""`dengine compare` over grids, rivals and feedbacks, in this process; what it writes, and what it refuses."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from dengine import Dataset
from dengine.cli import main
from dengine.experiments.rivals import RIVALS


@pytest.fixture
def folder(data: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    np.savez(tmp_path / "mine.npz", X=data.X, y=data.y)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def compare(words: str) -> Result:
    return CliRunner().invoke(main, ["compare", "--data", "mine.npz", "--cycles", "60", *words.split()])


def done(words: str) -> str:
    result = compare(words)
    assert result.exit_code == 0, result.output
    return result.stdout


def test_the_papers_grid_writes_its_tables_its_figures_and_its_findings(folder: Path) -> None:
    shown = done("--reducers pca --paper --repeats 1 --out out")
    page = (folder / "out" / "tables.md").read_text(encoding="utf-8")
    assert page.count("| alpha / LB | 80 % | 90 % | 95 % |") == 2
    assert "[36.9 / 1019.8]" in page
    assert "[41.7 / 1325.6]" in page
    assert (folder / "out" / "grid_pca_wilson.png").stat().st_size > 10_000
    assert (folder / "out" / "grid_pca_binomial.png").stat().st_size > 10_000
    assert "the mean share of false positives stays below 1 - LB" in page
    assert "of 9 cells: the mean share of false positives" in " ".join(shown.split())
    assert "18 replays" in shown


def test_rivals_are_compared_under_their_names_and_leave_no_map(folder: Path) -> None:
    rows = json.loads(done("--reducers pca,always,never --repeats 2 --out out --json"))["rows"]
    assert {row["recipe"]: row["certain"] for row in rows}["always"] == 0
    never = next(row for row in rows if row["recipe"] == "never")
    assert never["accepted"] == 60 - 50  # all but those before the first retrain
    assert [path.name for path in (folder / "out").glob("map_*")] == ["map_pca.png"]


def test_feedbacks_and_guarantees_are_rows_of_their_own(folder: Path) -> None:
    words = "--reducers pca --repeats 1 --feedback stops,confirmed --guarantees local,pooled --stops all --out out --json"
    rows = json.loads(done(words))["rows"]
    assert [(row["guarantee"], row["confirm"]) for row in rows] == [
        ("local", False), ("local", True), ("pooled", False), ("pooled", True)
    ]  # fmt: skip
    assert (folder / "out" / "curves.png").is_file()


def test_kept_replays_are_not_played_again_and_it_says_so(folder: Path) -> None:
    words = "--reducers pca --repeats 2 --keep kept"
    assert "from an earlier run" not in done(words)
    assert "2 were there from an earlier run" in " ".join(done(words).split())
    assert len(list((folder / "kept").iterdir())) == 2


def test_the_costs_name_what_many_cores_would_take(folder: Path) -> None:
    costs = json.loads(done("--reducers pca --repeats 3 --json"))["costs"]
    assert costs["core_seconds"] > 0


def test_every_row_of_a_grid_can_be_told_from_the_others(folder: Path) -> None:
    shown = done("--reducers never --repeats 1 --alphas 0.1,0.5 --intervals wilson,binomial --feedback stops,confirmed")
    lines = " ".join(shown.split())
    for interval in ("wilson", "binomial"):
        for alpha in ("0.1", "0.5"):
            for known in ("stops alone", "good ones confirmed"):
                assert f"never (local, {interval}, alpha {alpha}, {known}): " in lines
    table = shown[: shown.index("certain: cycles")]
    assert (table.count("wilson"), table.count("binomial")) == (4, 4)


def test_the_retrains_that_were_dropped_are_counted_row_by_row(folder: Path) -> None:
    text = (
        "from sklearn.decomposition import PCA\n\nclass Late(PCA):\n    def fit(self, X, y=None):\n"
        "        if len(X) < 59:\n            raise ValueError('too few')\n        return super().fit(X)\n"
    )
    (folder / "late_of_test_compare.py").write_text(text, encoding="utf-8")
    rows = json.loads(done("--reducers late_of_test_compare:Late --repeats 2 --alphas 0.1,0.5 --json"))["rows"]
    assert [row["retrains_dropped"] for row in rows] == [2, 2]


@pytest.mark.parametrize("address", ["nonsense", "foo://host:1"])
def test_an_address_that_is_none_of_a_scheduler_says_what_is_expected(folder: Path, address: str) -> None:
    pytest.importorskip("distributed")
    result = compare(f"--reducers pca --repeats 1 --scheduler {address}")
    assert result.exit_code == 1
    assert "Expected --scheduler to be the address of a running dask scheduler" in result.output


def test_the_help_names_every_rival(folder: Path) -> None:
    shown = re.findall(r"\w+", compare("--help").output)
    assert [name for name in RIVALS if name not in shown] == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--alphas 0.1,2", "2.0 is not in the range"),
        ("--alphas ,", "at least one value"),
        ("--lower-bounds 0.4", "0.4 is not in the range"),
        ("--alphas 0.1 --alpha 0.1", "--alpha names one value"),
        ("--paper --lower-bound 0.9", "--lower-bound names one value"),
        ("--feedback silence", "'silence' is not one of"),
        ("--reducers pca,pca", "a name of its own"),
        ("--intervals wald", "'wald' is not one of 'wilson', 'binomial'"),
    ],
)
def test_a_wrong_list_is_a_wrong_call(folder: Path, words: str, said: str) -> None:
    result = compare(words)
    assert result.exit_code == 2
    assert said in " ".join(result.output.split())


def test_an_unknown_recipe_says_what_is_known(folder: Path) -> None:
    result = compare("--reducers nearest")
    assert result.exit_code == 1
    assert "Expected a recipe among" in result.output
