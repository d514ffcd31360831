"""The scripts in training/: what they say of themselves is so, and small data does not
break them.
"""

import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from sklearn.metrics import log_loss

from dengine import ConvReducer, load_dataset
from dengine.testing import toy_traces

FOLDER = Path(__file__).resolve().parents[2] / "training"
Run = Callable[..., str]


@pytest.fixture(autouse=True)
def _beside_the_scripts(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))  # as `python training/NAME.py` has it


@pytest.fixture
def run(monkeypatch, capsys):
    """Runs a script's main in this process; what it printed."""

    def run_script(name: str, words: str = "") -> str:
        monkeypatch.setattr(sys, "argv", [f"training/{name}.py", *shlex.split(words)])
        import_module(name).main()
        return capsys.readouterr().out

    return run_script


def test_the_evidence_plays_nothing_twice_and_compares_by_pairs(run, tmp_path):
    words = "--seeds=0:3 --only=conv,knn --sets='opposite,screw driving' --cycles=150 --n-jobs=1"
    words += f" --out={tmp_path} --keep={tmp_path}/kept"
    first = run("evidence", words)
    assert "Without screw driving" in first
    assert "\n12 replays are left" in first
    assert "\n0 replays are left" in run("evidence", words)

    folder = tmp_path / "evidence"
    replays = pd.read_csv(folder / "replays.csv").query("alpha == 0.1")
    certain = replays.pivot_table("certain", "seed", "recipe")
    differences = pd.read_csv(folder / "differences.csv")
    row = differences.query("alpha == 0.1 and recipe == 'knn'").iloc[0]
    mean_difference = (certain["knn"] - certain["conv"]).mean()
    assert row["certain_more"] == pytest.approx(mean_difference, abs=1e-3)
    assert row["certain_low"] < row["certain_more"] < row["certain_high"]

    page = (folder / "index.md").read_text("utf-8")
    assert "| opposite | 150 | " in page
    (folder / "index.md").unlink()
    run("evidence", f"--tables-only --out {tmp_path}")
    assert (folder / "index.md").read_text("utf-8") == page


def test_a_row_of_the_evidence_gives_way_where_another_commit_plays_its_condition():
    settings = {"set": "drift", "interval": "wilson", "alpha": 0.1, "lower_bound": 0.9}
    old = pd.DataFrame(
        {"recipe": ["pca", "pca", "conv", "conv"], "seed": [1, 2] * 2, "commit": "a"}
    )
    new = pd.DataFrame({"recipe": ["conv"], "seed": 2, "commit": "b"})
    merge = import_module("evidence").merge_replays
    merged = merge(old.assign(**settings), new.assign(**settings))[["recipe", "seed", "commit"]]
    assert merged.to_numpy().tolist() == [["conv", 2, "b"], ["pca", 1, "a"], ["pca", 2, "a"]]


def test_screw_driving_steps_are_joined_on_one_grid_and_the_last_value_is_repeated(run, tmp_path):
    steps = [([0.0, 0.0024, 0.0036], [0.0, 0.2, 0.3]), ([0.0036, 0.0048], [0.3, 0.5])]
    graphs = [{"graph": {"time values": time, "torque values": torque}} for time, torque in steps]
    for cycle, part, result in ((7, "a", "NOK"), (5, "a", "OK"), (6, "b", "OK")):
        written = {"cycle": cycle, "id code": part, "result": result, "tightening steps": graphs}
        (tmp_path / f"Ch_{cycle:012d}.json").write_text(json.dumps(written))
    completed = run("make_screw_driving", f"{tmp_path} --samples 7 --out {tmp_path}/out.npz")
    assert "3 runs of 2 workpieces, 2 OK and 1 NOK" in completed
    data = load_dataset(tmp_path / "out.npz")
    np.testing.assert_allclose(data.X, [[0.0, 0.1, 0.2, 0.3, 0.5, 0.5, 0.5]] * 3, atol=1e-6)
    assert (data.y.tolist(), data.unit, round(data.rate_hz)) == ([1, 1, 0], "N·m", 833)


def test_a_trained_encoder_beats_the_base_rate_starts_conv_and_has_its_section_of_the_card(
    run, tmp_path
):
    X, y = toy_traces(120)
    np.savez(tmp_path / "toy.npz", X=X, y=y)
    card = tmp_path / "card.md"
    card.write_text("## model.ts\n\nBefore.\n\n## encoder.pt\n\nOld.\n\n## Later\n\nAfter.\n")
    words = f"--data {tmp_path}/toy.npz --epochs 5 --held-out 0.25 --out {tmp_path}"
    assert f"Wrote {tmp_path}/encoder.pt" in run("train_encoder", words)
    curve = pd.read_csv(tmp_path / "curve.csv")
    assert curve["epoch"].tolist() == [1, 2, 3, 4, 5]
    assert curve["log_loss"].min() < 0.8 * log_loss(y, np.full(len(y), y.mean()))
    text = card.read_text("utf-8")
    assert re.findall(r"## (\S+)", text) == ["model.ts", "encoder.pt", "Later"]
    assert [word in text for word in ("Before.", "Old.", "After.")] == [True, False, True]
    # The loss of the first step is that of the initial weights.
    fresh, started = (
        ConvReducer(folds=2, fit_steps=1, random_state=0, checkpoint=checkpoint).fit(X, y)
        for checkpoint in ("", str(tmp_path / "encoder.pt"))
    )
    assert started.loss_ < 0.8 * fresh.loss_


CHANGED = """
README.md                   | 992 |
docs/explanation/faults.md  | 25,826 |
docs/explanation/proof.md   | informative | 330 | 341 |
docs/explanation/speed.md   0.704 s
docs/results/index.md       | insertion | 1503 | 992 |
"""


def test_every_figure_that_a_file_holds_is_as_in_the_file_and_a_changed_one_is_found(
    run, tmp_path, monkeypatch, capsys
):
    with pytest.raises(SystemExit, match="0"):
        run("list_figures")
    assert " 0 wrong" in capsys.readouterr().out
    shutil.copytree(FOLDER.parent / "docs", tmp_path / "docs")
    shutil.copy(FOLDER.parent / "README.md", tmp_path)
    monkeypatch.setattr(import_module("list_figures"), "DOCS", tmp_path / "docs")
    for line in CHANGED.strip().splitlines():
        name, text = line.split(maxsplit=1)
        content = (tmp_path / name).read_text("utf-8")
        assert text in content, f"{name} does not show {text}"
        before, figure, after = content.partition(text)
        (tmp_path / name).write_text(before + re.sub(r"\d(?=\D*$)", "0", figure) + after, "utf-8")
    with pytest.raises(SystemExit, match="1"):
        run("list_figures")
    printed = capsys.readouterr().out
    for line in CHANGED.strip().splitlines():
        assert f"{line.split()[0].split('/')[-1]}:" in printed


def test_a_part_of_the_evidence_is_played_at_its_commit_once_and_its_files_are_in_the_manifest(
    run, tmp_path, monkeypatch
):
    evidence = import_module("make_evidence")
    writes = "-c open('{out}/table.csv','a').write('x\\n')"
    part = evidence.Part(writes, {"table.csv": "docs/table.csv"})
    monkeypatch.setattr(evidence, "PARTS", {"one": part, "two": evidence.Part("-c 1/0", {})})
    repository, out, elsewhere = (tmp_path / name for name in ("repository", "out", "elsewhere"))
    monkeypatch.setattr(evidence, "REPO", repository)
    commit = "git add . && git -c user.name=a -c user.email=a@b commit -qm changed"
    begin = f"mkdir -p dengine/data docs/results && touch dengine/data/insertion.npz && git init -q && {commit}"
    repository.mkdir()
    subprocess.run(begin, cwd=repository, shell=True, check=True)
    (out / "one").mkdir(parents=True)
    finished = "one                  finished"
    for _ in range(2):
        assert finished in run("make_evidence", f"--out {out} --only one")
    assert (out / "one" / "table.csv").read_text() == "x\n"
    with pytest.raises(SystemExit, match="'two' failed"):
        run("make_evidence", f"--out {out}")

    run("make_evidence", f"--out {out} --publish")
    manifest = json.loads((repository / "docs/results/manifest.json").read_text())
    digest = evidence.digest(repository / "docs" / "table.csv")
    assert manifest["parts"].keys() == {"one"}
    assert manifest["parts"]["one"]["files"] == {"docs/table.csv": digest}

    subprocess.run(f"touch dengine/code.py && {commit}", cwd=repository, shell=True, check=True)
    with pytest.raises(SystemExit, match="give another --out"):
        run("make_evidence", f"--out {out} --commit HEAD")
    assert finished in run("make_evidence", f"--out {elsewhere} --continue --list")
    assert json.loads((elsewhere / "manifest.json").read_text())["checkout"] == manifest["checkout"]
