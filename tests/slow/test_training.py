"""The scripts in training/: what they say of themselves is so, and small data does not break them."""

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[2] / "training"
SCRIPTS = sorted(FOLDER.glob("*.py"))
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


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """60 traces of 40 samples in two easy shapes."""
    rng = np.random.default_rng(0)
    y = rng.random(60) < 0.6
    X = np.where(y[:, None], np.linspace(0, 5, 40), np.linspace(5, 0, 40)) + rng.normal(0, 0.3, (60, 40))
    path = tmp_path_factory.mktemp("data") / "tiny.npz"
    np.savez(path, X=X.astype(np.float32), y=y.astype(np.int8))
    return path


def load(name: str) -> ModuleType:
    if name in ("make_insertion", "show_scenarios"):
        pytest.importorskip("mujoco")
    return importlib.import_module(name)


def test_a_comparison_of_60_cycles_has_a_table_and_a_csv(run: Run, tiny: Path, tmp_path: Path) -> None:
    words = ["report", "--data", tiny, "--reducers", "pca", "--seeds", "0:2", "--n-jobs", 1, "--out", tmp_path]
    out = run("compare_reducers", *words)
    assert "pca" in out
    assert len((tmp_path / "report_tiny.csv").read_text().splitlines()) == 1 + 2 * 2


def test_a_comparison_plays_nothing_twice_that_it_kept(run: Run, tiny: Path, tmp_path: Path) -> None:
    words = ["report", "--data", tiny, "--reducers", "pca,never", "--seeds", "0:2", "--policies", "0.1:0.9", "--n-jobs", 1]
    first, second = (run("compare_reducers", *words, "--out", tmp_path, "--keep", tmp_path / "kept") for _ in range(2))
    assert "4 of 4" in first
    assert "of 4" not in second
    assert first[first.index("report:") :] == second[second.index("report:") :]  # times and all


def test_a_rival_without_a_bound_says_so_in_its_row(run: Run, tiny: Path, tmp_path: Path) -> None:
    words = ["report", "--data", tiny, "--reducers", "pca,never,always,river", "--seeds", "0:1", "--policies", "0.1:0.9"]
    table = (line for line in run("compare_reducers", *words, "--n-jobs", 1, "--out", tmp_path).splitlines() if "|" in line)
    bounds = {line.split("|")[1].strip().split(":")[0]: line.split("|")[2].strip() for line in table}
    assert bounds["never"] == "none"
    assert bounds["river"] == "none: threshold swept"
    assert bounds["pca"] == "Wilson, at one look"
    assert bounds["always"].startswith("no error")


def test_choosing_among_tries_that_are_never_certain_says_so(run: Run, tiny: Path, tmp_path: Path) -> None:
    words = ["choose", "--data", tiny, "--cycles", 10, "--reducers", "pca", "--seeds", "0:1", "--n-jobs", 1]
    assert "Chosen of pca: none" in run("compare_reducers", *words, "--out", tmp_path)


def test_an_exported_model_is_said_in_kilobytes(run: Run, tiny: Path, tmp_path: Path) -> None:
    out = run("export_model", "--data", tiny, "--reducer", "pca", "--out", tmp_path / "m.ts")
    assert " kB, 60 labelled references" in out
    assert (tmp_path / "m.ts.sha256").is_file()


@pytest.fixture(scope="module")
def causes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """200 traces of 120 samples, bad ones for one of two causes: as many as leave some to hold out."""
    rng = np.random.default_rng(0)
    cause = rng.choice(["none", "rim", "slip"], 200, p=[0.5, 0.3, 0.2])
    x = np.linspace(0, 1, 120)
    shapes = {"none": 5 * x, "rim": 5 * (x > 0.3), "slip": 5 * x * (1 - x)}
    X = np.stack([shapes[each] for each in cause]) + rng.normal(0, 0.3, (200, 120))
    path = tmp_path_factory.mktemp("data") / "causes.npz"
    np.savez(path, X=X.astype(np.float32), y=(cause == "none").astype(np.int8), cause=cause)
    return path


def test_the_encoder_goes_on_from_its_last_run(causes: Path) -> None:
    from dengine import ModelPrediction, Recipe, load_dataset

    model = ModelPrediction.from_recipe(Recipe.load("conv"))
    history, (before, after) = load("train_encoder").train(model, load_dataset(causes), 70)
    assert [row["step"] for row in history] == [0, 30, 60, 70]
    assert history[-1]["held-out loss"] < history[0]["held-out loss"]
    assert before.shape == after.shape
    assert not np.array_equal(before, after)


def test_a_trained_encoder_leaves_a_picture_a_card_a_model_and_its_weights(run: Run, causes: Path, tmp_path: Path) -> None:
    words = ["--data", causes, "--steps", 20, "--replays", "0:1", "--out", tmp_path]
    assert "held-out loss" in run("train_encoder", *words, "--weights", tmp_path / "deep" / "encoder.npz")
    names = {"training.png", "card.md", "model.ts", "model.ts.sha256", "deep"}
    assert names == {path.name for path in tmp_path.iterdir()}
    card = (tmp_path / "card.md").read_text(encoding="utf-8")
    for figure in (
        "20 steps",
        "| held-out loss |",
        "| neighbours agree |",
        "| auroc |",
        "certain of 200",
        "(training.png)",
    ):
        assert figure in card


def test_the_weights_of_a_trained_encoder_start_another_one(run: Run, causes: Path, tmp_path: Path) -> None:
    from dengine import ConvReducer, load_dataset
    from dengine.reducers.encoder import weights_of

    path, data = tmp_path / "encoder.npz", load_dataset(causes)
    run("train_encoder", "--data", causes, "--steps", 20, "--replays", "0:1", "--out", tmp_path, "--weights", path)
    encoder: Any = ConvReducer(start=str(path)).fit(data.X, data.y).net_.features
    started = weights_of(encoder)
    with np.load(path) as stored:
        assert set(stored.files) == set(started)
        assert all(np.array_equal(stored[name], value) for name, value in started.items())


def test_neighbours_agree_where_each_label_keeps_to_itself() -> None:
    agreement = load("train_encoder").neighbour_agreement
    places = np.array([[0.0], [1.0], [10.0], [11.0]], dtype=np.float32)
    assert agreement(places, np.array([0, 0, 1, 1])) == 1.0
    assert agreement(places, np.array([0, 1, 0, 1])) == 0.0


def test_traces_without_a_cause_have_no_panel_of_causes(tiny: Path) -> None:
    from dengine import load_dataset

    script, data = load("train_encoder"), load_dataset(tiny)
    row = {"training loss": 1.0, "held-out loss": 1.0, "neighbours agree": 0.5, "accuracy": 0.5}
    features = [np.random.default_rng(i).normal(size=(60, 5)).astype(np.float32) for i in range(2)]
    figure = script.picture([{"step": 0, **row}, {"step": 9, **row}], features, data)
    assert len(figure.axes) == 4


def test_a_cycles_benchmark_has_empty_cells_for_what_never_happened() -> None:
    benchmark = load("benchmark_cycle")
    nothing, some = np.array([]), np.array([0.0352])
    row = benchmark.row("decide and swap", nothing)
    assert [benchmark.written(row[key], "ms") for key in ("median", "worst", "target")] == ["", "", ""]
    assert benchmark.written(benchmark.row("retrain", some)["median"], "ms") == "35 ms"
    assert np.isnan(benchmark.ratio("UMAP / retrain", some, nothing, 6.0)["worst"])


def test_a_retrain_is_timed_until_it_is_committed(tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import time

    from dengine import Recipe, SqlStore, load_dataset

    put_version = SqlStore.put_version

    def slow(*words: Any) -> None:
        time.sleep(0.4)
        put_version(*words)

    monkeypatch.setattr(SqlStore, "put_version", slow)
    row = load("benchmark_scale").measure_store(load_dataset(tiny), Recipe.load("pca"), 60, 2, tmp_path)
    assert row["retrain_p50_s"] >= 0.4


def test_the_scale_benchmark_runs_on_stores_of_a_few_traces(run: Run, tiny: Path, tmp_path: Path) -> None:
    words = ["--data", tiny, "--sizes", "60", "--windows", "20,30", "--repeats", 1, "--umap-most", 0, "--out", tmp_path]
    out = run("benchmark_scale", *words, "--recipe", "pca")
    assert "kB" in out
    assert (tmp_path / "benchmark_scale.png").is_file()


def test_the_recipes_are_written_where_they_are_asked_for(run: Run, tmp_path: Path) -> None:
    run("write_recipes", "--out", tmp_path)
    shipped = FOLDER.parent / "models" / "recipes"
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {p.name: p.read_text() for p in shipped.glob("*.toml")}


def test_a_choice_by_cost_is_tried_on_the_parts_that_it_did_not_see(run: Run, tiny: Path, tmp_path: Path) -> None:
    words = ("--data", tiny, "--parts", 30, "--repeats", 2, "--escapes", "30,60", "--n-jobs", 1, "--out", tmp_path)
    said = run("check_cost_choice", *words)
    assert "2 sets of 30 parts, 2 shuffles, 4 choices" in said
    rows = (tmp_path / "cost_choice.csv").read_text(encoding="utf-8").splitlines()
    assert len(rows) == 1 + 2 * 4
