"""`dengine compare` over grids, rivals and feedbacks, in this process; what it writes, and what it refuses."""

import re
from pathlib import Path

import numpy as np
import pytest

from dengine import Dataset
from dengine.experiments.rivals import RIVALS
from tests.support.command_line import dengine, document, said, succeed


@pytest.fixture(autouse=True)
def folder(data: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    np.savez(tmp_path / "mine.npz", X=data.X, y=data.y)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def words(asked: str) -> list[str]:
    return ["compare", "--data", "mine.npz", "--cycles", "60", *asked.split()]


def test_the_papers_grid_writes_its_tables_its_figures_and_its_findings(folder: Path) -> None:
    shown = said(*words("--reducers pca --paper --repeats 1 --out out"))
    page = (folder / "out" / "tables.md").read_text(encoding="utf-8")
    assert page.count("| alpha / LB | 80 % | 90 % | 95 % |") == 2
    assert "[36.9 / 1019.8]" in page
    assert {each.name for each in (folder / "out").glob("grid_*")} == {"grid_pca_wilson.png", "grid_pca_binomial.png"}
    assert "of 9 cells: the mean share of false positives" in shown
    assert "18 replays" in shown


def test_rivals_are_compared_under_their_names_which_the_help_says_and_leave_no_map(folder: Path) -> None:
    found = document(*words("--reducers pca,always,never --repeats 2 --out out"))
    rows = {row["recipe"]: row for row in found["rows"]}
    assert rows["always"]["certain"] == 0
    assert set(RIVALS) <= set(re.findall(r"\w+", succeed("compare", "--help")))
    assert rows["never"]["accepted"] == 60 - 50  # all but those before the first retrain
    assert [path.name for path in (folder / "out").glob("map_*")] == ["map_pca.png"]
    assert found["costs"]["core_seconds"] > 0


def test_every_row_of_a_grid_can_be_told_from_the_others() -> None:
    asked = "--reducers never --repeats 1 --intervals wilson,binomial --guarantees local,pooled --stops all"
    shown = succeed(*words(f"{asked} --feedback stops,confirmed"))
    lines = " ".join(shown.split())
    for guarantee in ("local", "pooled"):
        for interval in ("wilson", "binomial"):
            for known in ("stops alone", "good ones confirmed"):
                assert f"never ({guarantee}, {interval}, {known}): " in lines
    assert shown[: shown.index("Means a replay")].count("binomial") == 4


def test_an_address_that_is_none_of_a_scheduler_says_what_is_expected() -> None:
    pytest.importorskip("distributed")
    result = dengine(*words("--reducers pca --repeats 1 --scheduler nonsense"))
    assert result.exit_code == 1
    assert "Expected --scheduler to be the address of a running dask scheduler" in result.output


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        ("--alphas 0.1,2", "2.0 is not in the range"),
        ("--alphas 0.1 --alpha 0.1", "--alpha names one value"),
        ("--reducers pca,pca", "a name of its own"),
        ("--intervals wald", "'wald' is not one of 'wilson', 'binomial'"),
        ("--reducers nearest", "'nearest' is not one of 'conv'"),
    ],
)
def test_a_wrong_list_says_what_was_expected(asked: str, expected: str) -> None:
    result = dengine(*words(asked))
    assert result.exit_code == 2
    assert expected in " ".join(result.output.split())
