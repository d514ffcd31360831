"""Figures that pages repeat from the results are those of docs/results."""

import hashlib
import json
from pathlib import Path

import pandas as pd
import pytest


@pytest.fixture(scope="module")
def means(repo: Path) -> pd.DataFrame:
    """The means of each set and method at alpha 0.1 and LB 90 %."""
    replays = pd.read_csv(repo / "docs" / "results" / "replays.csv")
    replays = replays.query("interval == 'wilson' and alpha == 0.1 and lower_bound == 0.9")
    return replays.groupby(["set", "recipe"]).mean(numeric_only=True)


def rows_of(page: Path, head: str) -> list[list[str]]:
    """The cells of the page's table with this head, without its head."""
    _, _, table = page.read_text("utf-8").partition(f"{head}\n")
    lines = table.partition("\n\n")[0].splitlines()[1:]
    return [[cell.strip(" `") for cell in line.strip("|").split("|")] for line in lines]


def test_the_readmes_table_of_reducers_has_the_figures_of_the_results(
    repo: Path, means: pd.DataFrame
) -> None:
    rows = rows_of(repo / "README.md", "| reducer | what it is | certain | bad accepted |")
    assert rows
    for reducer, _, certain, bad in rows:
        mean = means.loc[("insertion", reducer)]
        assert (certain, bad) == (f"{mean['certain']:.0f}", f"{mean['false_positive']:.1f}")


def test_the_table_of_streams_that_change_has_the_figures_of_the_results(
    repo: Path, means: pd.DataFrame
) -> None:
    page = repo / "docs" / "explanation" / "drift.md"
    rows = rows_of(
        page, "| stream | certain | accepted | of these bad | rejected | of these good |"
    )
    assert rows
    for stream, *figures in rows:
        mean = means.loc[(stream, "conv")]
        assert figures == [
            f"{mean['certain']:.0f}",
            f"{mean['accepted']:.0f}",
            f"{mean['false_positive']:.1f}",
            f"{mean['rejected']:.0f}",
            f"{mean['false_negative']:.1f}",
        ]


def test_each_published_file_of_the_evidence_is_the_one_that_its_manifest_names(repo: Path) -> None:
    manifest = json.loads((repo / "docs" / "results" / "manifest.json").read_text("utf-8"))
    assert manifest["parts"]
    for name, part in manifest["parts"].items():
        for file, digest in part["files"].items():
            content = (repo / file).read_bytes()
            assert hashlib.sha256(content).hexdigest() == digest, f"{file} is not of {name}"
