"""The scripts in training/: what they say of themselves is so, and small data does not
break them.
"""

import importlib
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest

from dengine import ConvReducer, load_dataset
from dengine.errors import DataError
from dengine.testing import toy_traces

FOLDER = Path(__file__).resolve().parents[2] / "training"
Run = Callable[..., str]


@pytest.fixture(autouse=True)
def _beside_the_scripts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))  # as `python training/NAME.py` has it


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a script's main in this process; what it printed."""

    def run_script(name: str, *words: object) -> str:
        monkeypatch.setattr(sys, "argv", [f"training/{name}.py", *map(str, words)])
        load(name).main()
        return capsys.readouterr().out

    return run_script


def load(name: str) -> ModuleType:
    return importlib.import_module(name)


def test_the_evidence_plays_nothing_twice_and_compares_by_pairs(run: Run, tmp_path: Path) -> None:
    words = ["--seeds=0:3", "--only=conv,knn", "--sets=opposite,screw driving", "--cycles=150"]
    words += ["--n-jobs=1", f"--out={tmp_path}", f"--keep={tmp_path / 'kept'}"]
    first = run("evidence", *words)
    second = run("evidence", *words)
    assert "Without screw driving" in first
    assert "\n12 replays are left" in first
    assert "\n0 replays are left" in second

    folder = tmp_path / "evidence"
    replays = pd.read_csv(folder / "replays.csv")
    certain = replays[replays["alpha"] == 0.1].pivot_table("certain", "seed", "recipe")
    mean_difference = (certain["knn"] - certain["conv"]).mean()
    differences = pd.read_csv(folder / "differences.csv")
    row = differences.query("alpha == 0.1 and recipe == 'knn'").iloc[0]
    assert row["certain_more"] == pytest.approx(mean_difference, abs=1e-3)
    assert row["certain_low"] < row["certain_more"] < row["certain_high"]
    page = (folder / "index.md").read_text(encoding="utf-8")
    assert "| opposite | 150 | " in page

    for name in ("index.md", "curves.png", "net_seconds.png", "differences.csv"):
        (folder / name).unlink()
    run("evidence", "--tables-only", "--out", tmp_path)
    assert (folder / "index.md").read_text(encoding="utf-8") == page
    assert (folder / "net_seconds.png").stat().st_size > 0


def test_a_row_of_the_evidence_gives_way_where_another_commit_plays_its_condition() -> None:
    evidence = load("evidence")
    settings = {"set": "drift", "interval": "wilson", "alpha": 0.1, "lower_bound": 0.9}
    old_rows = [
        settings | {"recipe": method, "seed": seed, "commit": "a"}
        for method in ("pca", "conv")
        for seed in (1, 2)
    ]
    new = pd.DataFrame([settings | {"recipe": "conv", "seed": 2, "commit": "b"}])
    merged = evidence.merge_replays(pd.DataFrame(old_rows), new)[["recipe", "seed", "commit"]]
    assert merged.to_numpy().tolist() == [["conv", 2, "b"], ["pca", 1, "a"], ["pca", 2, "a"]]


def test_screw_driving_steps_are_joined_on_one_grid_and_the_last_value_is_repeated(
    run: Run, tmp_path: Path
) -> None:
    steps = [([0.0, 0.0024, 0.0036], [0.0, 0.2, 0.3]), ([0.0036, 0.0048], [0.3, 0.5])]
    graphs = [{"graph": {"time values": time, "torque values": torque}} for time, torque in steps]
    with pytest.raises(SystemExit, match=r"Expected files Ch_\*.json"):
        run("make_screw_driving", tmp_path)
    for cycle, part, result in ((7, "a", "NOK"), (5, "a", "OK"), (6, "b", "OK")):
        written = {"cycle": cycle, "id code": part, "result": result, "tightening steps": graphs}
        (tmp_path / f"Ch_{cycle:012d}.json").write_text(json.dumps(written), encoding="utf-8")
    completed = run("make_screw_driving", tmp_path, "--samples", 7, "--out", tmp_path / "out.npz")
    assert "3 runs of 2 workpieces, 2 OK and 1 NOK" in completed
    data = load_dataset(tmp_path / "out.npz")
    np.testing.assert_allclose(data.X, [[0.0, 0.1, 0.2, 0.3, 0.5, 0.5, 0.5]] * 3, atol=1e-6)
    assert (data.y.tolist(), data.unit, round(data.rate_hz)) == ([1, 1, 0], "N·m", 833)
    with np.load(tmp_path / "out.npz") as stored:
        assert (stored["workpiece"].tolist(), stored["nth_run"].tolist()) == (
            ["a", "b", "a"],
            [0, 0, 1],
        )


def test_a_trained_encoder_beats_the_base_rate_and_starts_conv(run: Run, tmp_path: Path) -> None:
    X, y = toy_traces(120)
    np.savez(tmp_path / "toy.npz", X=X, y=y)
    out = tmp_path / "encoder"
    words = ["--data", tmp_path / "toy.npz", "--epochs", 5, "--held-out", 0.25, "--out", out]
    printed = run("train_encoder", *words)
    assert f"Wrote {out}/encoder.pt" in printed

    curve = pd.read_csv(out / "curve.csv")
    rate = y.mean()
    base_rate = -(rate * np.log(rate) + (1 - rate) * np.log(1 - rate))
    assert curve["epoch"].tolist() == [1, 2, 3, 4, 5]
    assert curve["log_loss"].min() < 0.8 * base_rate
    assert (out / "curve.png").stat().st_size > 0

    # The loss of the first step is that of the initial weights.
    fresh = ConvReducer(folds=2, fit_steps=1, random_state=0).fit(X, y)
    started = ConvReducer(
        folds=2, fit_steps=1, random_state=0, checkpoint=str(out / "encoder.pt")
    ).fit(X, y)
    assert started.loss_ < 0.8 * fresh.loss_


def test_a_trace_with_a_nan_is_refused_before_the_training(run: Run, tmp_path: Path) -> None:
    X, y = toy_traces(60)
    X[3, 0, 5] = np.nan
    np.savez(tmp_path / "toy.npz", X=X, y=y)
    with pytest.raises(DataError, match="1 with NaN"):
        run("train_encoder", "--data", tmp_path / "toy.npz", "--out", tmp_path / "encoder")
    assert not (tmp_path / "encoder").exists()


def test_the_posterior_of_an_oscillation_tells_the_share_of_good_parts(tmp_path: Path) -> None:
    sets = load("evidence_sets")
    data = sets.load_set("oscillation", seed=3)
    posterior = load("ideal_score").oscillation_posterior(data.X[:, None])
    for low, high in ((0.0, 0.1), (0.1, 0.5), (0.5, 0.9), (0.9, 1.0)):
        chosen = (posterior >= low) & (posterior <= high)
        error = 4 * np.sqrt(0.25 / chosen.sum())
        assert data.y[chosen].mean() == pytest.approx(posterior[chosen].mean(), abs=error)
    assert ((posterior > 0.5) == data.y).mean() > 0.97


def test_a_training_replaces_its_section_of_a_card_and_no_other(run: Run, tmp_path: Path) -> None:
    X, y = toy_traces(60)
    np.savez(tmp_path / "toy.npz", X=X, y=y)
    card = tmp_path / "card.md"
    card.write_text("## model.ts\n\nBefore.\n\n## encoder.pt\n\nOld.\n\n## Later\n\nAfter.\n")
    for _ in range(2):
        run("train_encoder", "--data", tmp_path / "toy.npz", "--epochs", 1, "--out", tmp_path)
    text = card.read_text(encoding="utf-8")
    headings = [line for line in text.splitlines() if line.startswith("## ")]
    assert headings == ["## model.ts", "## encoder.pt", "## Later"]
    assert "Before." in text
    assert "After." in text
    assert "Old." not in text


def test_every_figure_that_a_file_holds_is_as_in_the_file_and_a_changed_one_is_found(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    figures = load("list_figures")
    with pytest.raises(SystemExit, match="0"):
        run("list_figures")
    assert " 0 wrong" in capsys.readouterr().out

    copy = tmp_path / "docs"
    shutil.copytree(FOLDER.parent / "docs", copy)
    shutil.copy(FOLDER.parent / "README.md", tmp_path)
    monkeypatch.setattr(figures, "DOCS", copy)
    for page, text, other in (
        (tmp_path / "README.md", "| 992 |", "| 993 |"),
        (copy / "explanation" / "faults.md", "| 24,369 |", "| 24,396 |"),
        (
            copy / "explanation" / "proof.md",
            "| informative | 330 | 341 |",
            "| informative | 330 | 340 |",
        ),
        (copy / "explanation" / "speed.md", "0.357 s", "0.375 s"),
        (copy / "results" / "index.md", "| insertion | 1503 | 992 |", "| insertion | 1503 | 929 |"),
    ):
        content = page.read_text("utf-8")
        assert text in content, f"{page.name} does not show {text}"
        page.write_text(content.replace(text, other, 1), "utf-8")
        with pytest.raises(SystemExit, match="1"):
            figures.main()
        assert f"{page.name}:" in capsys.readouterr().out
        page.write_text(content, "utf-8")


def test_a_part_of_the_evidence_is_played_at_its_commit_once_and_its_files_are_in_the_manifest(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    evidence = load("make_evidence")
    writes = "-c open('{out}/table.csv','a').write('x\\n')"
    part = evidence.Part(writes, {"table.csv": "docs/table.csv"})
    monkeypatch.setattr(evidence, "PARTS", {"one": part, "two": evidence.Part("-c 1/0", {})})
    monkeypatch.setattr(evidence, "REPO", tmp_path / "repository")
    repository = tmp_path / "repository"
    (repository / "dengine" / "data").mkdir(parents=True)
    (repository / "dengine" / "data" / "insertion.npz").touch()
    (repository / "dengine" / "code.py").touch()
    for words in ("init -q", "add .", "-c user.name=a -c user.email=a@b commit -qm first"):
        subprocess.run(["git", *words.split()], cwd=repository, check=True)
    out = tmp_path / "out"
    (out / "one").mkdir(parents=True)
    for _ in range(2):
        assert "one                  finished" in run(
            "make_evidence", "--out", out, "--only", "one"
        )
    assert (out / "one" / "table.csv").read_text() == "x\n"
    with pytest.raises(SystemExit, match="'two' failed"):
        run("make_evidence", "--out", out)

    (repository / "docs" / "results").mkdir(parents=True)
    run("make_evidence", "--out", out, "--publish")
    manifest = json.loads((repository / "docs/results/manifest.json").read_text())
    assert list(manifest["parts"]) == ["one"]
    digest = manifest["parts"]["one"]["files"]["docs/table.csv"]
    assert digest == evidence.digest(repository / "docs" / "table.csv")

    (repository / "dengine" / "code.py").write_text("changed = 1\n")
    command = "git -c user.name=a -c user.email=a@b commit -qam second"
    subprocess.run(command.split(), cwd=repository, check=True)
    assert "one                  finished" in run("make_evidence", "--out", out, "--list")
    with pytest.raises(SystemExit, match="give another --out"):
        run("make_evidence", "--out", out, "--commit", "HEAD")
    elsewhere = tmp_path / "elsewhere"
    assert "one                  finished" in run(
        "make_evidence", "--out", elsewhere, "--continue", "--list"
    )
    assert (elsewhere / "one" / "table.csv").read_text() == "x\n"
    assert json.loads((elsewhere / "manifest.json").read_text())["checkout"] == manifest["checkout"]
    with pytest.raises(SystemExit, match="nowhere failed"):
        run("make_evidence", "--out", tmp_path / "other", "--commit", "nowhere")
