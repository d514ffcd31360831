"""The published results are whole, and pages that `training/list_figures.py` does not compare with
them have their figures.
"""

import hashlib
import json

import pandas as pd

STREAMS = "| stream | certain | accepted | bad accepted | rejected | good rejected |\n"
FIGURES = "{certain:.0f} {accepted:.0f} {false_positive:.1f} {rejected:.0f} {false_negative:.1f}"


def test_the_table_of_streams_that_change_has_the_figures_of_the_results(repo):
    replays = pd.read_csv(repo / "docs" / "results" / "replays.csv")
    replays = replays.query("interval == 'wilson' and alpha == 0.1 and lower_bound == 0.9")
    means = replays.query("recipe == 'conv'").groupby("set").mean(numeric_only=True)
    page = (repo / "docs" / "explanation" / "drift.md").read_text("utf-8")
    _, *rows = page.split(STREAMS)[1].split("\n\n")[0].splitlines()
    for row in rows:
        stream, *figures = row.strip("| ").replace("`", "").split(" | ")
        assert figures == FIGURES.format(**means.loc[stream]).split()


def test_each_published_file_of_the_evidence_is_the_one_that_its_manifest_names(repo):
    manifest = json.loads((repo / "docs" / "results" / "manifest.json").read_text("utf-8"))
    assert manifest["parts"]
    for name, part in manifest["parts"].items():
        for file, digest in part["files"].items():
            content = (repo / file).read_bytes()
            assert hashlib.sha256(content).hexdigest() == digest, f"{file} is not of {name}"
