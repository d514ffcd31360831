"""The command line: real commands on small data."""

import json
import shlex
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import click
import joblib
import numpy as np
import pytest
from click.testing import CliRunner, Result

from dengine import DataEngine, __version__
from dengine.cli import main
from dengine.importing import import_labelled
from dengine.store import MemoryStore

POLICY = ["--alpha", "0.2", "--lower-bound", "0.8"]


def dengine(*words: object) -> Result:
    return CliRunner().invoke(main, [str(word) for word in words])


def succeed(*words: object) -> str:
    result = dengine(*words)
    assert result.exit_code == 0, result.output
    return result.stdout


def document(*words: object) -> dict:
    result = dengine(*words, "--json")
    assert result.exit_code == 0, result.output
    assert result.stderr == ""
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """160 traces of 40 samples in two easy shapes."""
    rng = np.random.default_rng(0)
    y = rng.random(160) < 0.6
    X = np.where(y[:, None], np.linspace(0, 5, 40), np.linspace(5, 0, 40)) + rng.normal(0, 0.3, (160, 40))
    path = tmp_path_factory.mktemp("data") / "easy.npz"
    np.savez(path, X=X.astype(np.float32), y=y.astype(np.int8))
    return path


@pytest.fixture(scope="module")
def trained(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    store = tmp_path_factory.mktemp("store") / "engine.db"
    succeed("train", "--data", data, "--store", store, "--reducer", "pca", *POLICY)
    return store


def seconds(*command: str) -> float:
    """The best of three fresh processes: a busy machine only adds."""

    def once() -> float:
        begin = time.perf_counter()
        subprocess.run([sys.executable, *command], check=True, capture_output=True)
        return time.perf_counter() - begin

    return min(once() for _ in range(3))


def test_help_answers_within_600_ms() -> None:
    assert seconds("-c", "from dengine.cli import main; main(['--help'])") < 0.6


def test_importing_dengine_takes_less_than_300_ms() -> None:
    assert seconds("-c", "import dengine") - seconds("-c", "pass") < 0.3


def test_help_imports_nothing_heavy() -> None:
    code = "import sys, dengine.cli; print({'numpy', 'torch', 'pandas', 'rich', 'sklearn'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout == "set()\n"


def test_version_is_the_packages() -> None:
    assert succeed("--version").strip() == f"dengine {__version__}"


VERBS = sorted(main.commands)


def example_of(verb: str) -> list[str]:
    lines = succeed(verb, "--help").rstrip().splitlines()
    assert lines[-2].strip() == "Example:"
    return shlex.split(lines[-1])


@pytest.mark.parametrize("verb", VERBS)
def test_every_help_ends_in_a_command_that_parses(verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cell.csv").touch()  # the journal that an example takes back in
    monkeypatch.chdir(tmp_path)
    program, named, *words = example_of(verb)
    assert (program, named) == ("dengine", verb)
    with click.Context(main) as parent:
        main.commands[verb].make_context(verb, words, parent=parent)  # UsageError for an option that does not exist


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_speaks_json_and_explains_each_option(verb: str) -> None:
    options = [p for p in main.commands[verb].params if isinstance(p, click.Option)]
    assert "--json" in {name for option in options for name in option.opts}
    unexplained = {o.name for o in options if not o.help} - {"kind", "cycles"}  # these two say it all by name and default
    assert not unexplained


def test_replay_prints_a_table_and_writes_csv_and_pictures(data: Path, tmp_path: Path) -> None:
    out = succeed("replay", "--data", data, "--reducer", "pca", *POLICY, "--repeats", 2, "--out", tmp_path)
    assert "pooled" in out
    assert "retrains, the worst in" in out
    assert len((tmp_path / "replays.csv").read_text().splitlines()) == 3
    assert {p.name for p in tmp_path.glob("*.png")} == {"curves.png", "map_pca.png"}


def test_replay_as_json_is_one_document_that_repeats_under_its_seed(data: Path) -> None:
    words = ["replay", "--data", data, "--reducer", "pca", *POLICY, "--repeats", 2, "--samples", 30, "--cycles", 120]
    first, second = (document(*words)["rows"][0] for _ in range(2))
    assert first["certain"] > 0
    assert first["cycles"] == 240
    for name in ("certain", "accepted", "false_positive", "precision"):
        assert first[name] == second[name]


def test_replaying_two_at_a_time_decides_the_same(data: Path) -> None:
    words = ["replay", "--data", data, "--reducer", "pca", *POLICY, "--repeats", 2, "--cycles", 120]
    with joblib.parallel_config(backend="threading"):  # processes would spend 20 s on importing torch
        alone, beside = (document(*words, "--n-jobs", n)["rows"][0] for n in (1, 2))
    assert (alone["certain"], alone["accepted"]) == (beside["certain"], beside["accepted"])


def test_a_json_document_has_null_where_nothing_was_accepted(data: Path) -> None:
    row = document("replay", "--data", data, "--reducer", "pca", "--repeats", 1, "--cycles", 20)["rows"][0]
    assert row["precision"] is None
    assert row["promise_kept"] is None


def test_in_order_plays_the_stream_once(data: Path) -> None:
    shown = document("replay", "--data", data, "--reducer", "pca", "--in-order", "--cycles", 60)
    assert shown["in_order"] is True
    assert shown["rows"][0]["replays"] == 1
    assert dengine("replay", "--data", data, "--in-order", "--repeats", 3).exit_code == 2


def test_compare_has_a_row_a_recipe_files_included(data: Path, tmp_path: Path) -> None:
    recipe = tmp_path / "often.toml"
    recipe.write_text('reducer = "pca"\nretrain_every = 20\n')
    words = ["compare", "--data", data, "--reducers", f"pca,{recipe}", *POLICY, "--repeats", 1, "--cycles", 100]
    shown = document(*words, "--out", tmp_path / "out")
    assert [row["recipe"] for row in shown["rows"]] == ["pca", "often"]
    assert {row["lower_bound"] for row in shown["rows"]} == {0.8}
    assert (tmp_path / "out" / "curves.png").is_file()


def test_a_trained_store_holds_every_label_and_an_answering_version(trained: Path, data: Path) -> None:
    shown = document("status", trained)
    assert shown["labels"] == shown["sources"]["verification"] == 160
    assert shown["reasons"]["no_model"] == 160
    assert shown["last_version"] == 1
    assert shown["worst_retrain_s"] > 0
    with np.load(data) as file, DataEngine.open(trained) as engine:
        assert engine.decide(file["X"][0]).predicted != "verify"


def test_status_is_a_table_for_people(trained: Path) -> None:
    out = succeed("status", trained)
    for name in ("reducer", "decisions", "reasons", "quarantined", "labels", "version", "worst retrain"):
        assert name in out


def test_the_same_file_twice_counts_no_label_twice(trained: Path, data: Path) -> None:
    again = document("train", "--data", data, "--store", trained)
    assert again["import"] == {"imported": 0, "quarantined": 0, "known": 160, "resumed": True}
    assert document("status", trained)["labels"] == 160


def test_bad_traces_are_kept_and_never_trained_on(data: Path) -> None:
    with np.load(data) as file:
        X, y = file["X"].copy(), file["y"]
    X[0, 3], X[1] = np.nan, 7.0
    store = MemoryStore()
    report = import_labelled(store, (X, y), "pca")
    assert (report.imported, report.quarantined) == (158, 2)
    assert len(store.labelled().labels) == 158
    assert store.status()["reasons"] == store.status()["reasons"] | {"not_finite": 1, "constant": 1}


def test_equal_traces_in_one_file_are_events_of_their_own() -> None:
    X, y = np.tile(np.linspace(0, 1, 20), (6, 1)), np.array([1, 1, 0, 1, 1, 1])
    store = MemoryStore()
    assert import_labelled(store, (X, y), "pca").imported == 6
    assert import_labelled(store, (X, y)).known == 6


def test_an_interrupted_import_goes_on_where_it_stopped(data: Path) -> None:
    with np.load(data) as file:
        X, y = file["X"], file["y"]
    store = MemoryStore()
    import_labelled(store, (X[:70], y[:70]), "pca")
    report = import_labelled(store, (X, y))
    assert (report.imported, report.known) == (90, 70)
    np.testing.assert_array_equal(store.labelled().labels, y)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--samples", "30"], "Expected 40 samples, got 30"),
        (["--alpha", "0.5"], "alpha 0.2"),
        (["--seed", "9"], "seed 0"),
    ],
)
def test_a_used_store_refuses_another_contract(trained: Path, data: Path, words: list[str], said: str) -> None:
    extra = ["--reducer", "pca", "--lower-bound", "0.8"] if "--alpha" in words else []
    result = dengine("train", "--data", data, "--store", trained, *words, *extra)
    assert result.exit_code == 1
    assert said in result.stderr


def test_run_verifies_less_in_the_end_and_resumes_after_its_last_part(data: Path, tmp_path: Path) -> None:
    words = ["run", "--cell", "replay", "--data", data, "--store", tmp_path / "e.db", "--out", tmp_path]
    first = document(*words, "--reducer", "pca", *POLICY, "--cycles", 110)
    assert first["stretches"][0]["verified_share"] == 1.0
    assert first["stretches"][-1]["verified_share"] < 1.0
    assert (tmp_path / "run.png").is_file()
    assert len((tmp_path / "run.csv").read_text().splitlines()) == 111
    second = document(*words, "--cycles", 30)
    assert "resumed" in second["title"]
    assert document("status", tmp_path / "e.db")["decisions"] == 140
    with sqlite3.connect(tmp_path / "e.db") as connection:
        (twice,) = connection.execute("select count(*) - count(distinct content_hash) from label").fetchone()
    assert twice == 0


def test_run_refuses_more_cycles_than_the_recording_has_left(data: Path) -> None:
    result = dengine("run", "--cell", "replay", "--data", data, "--cycles", 161, "--reducer", "pca")
    assert result.exit_code == 1
    assert "at most 160 cycles" in result.stderr


def test_everything_from_the_simulated_cell_is_called_simulated(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    words = ["run", "--cell", "simulated", "--cycles", 6, "--reducer", "pca", "--store", tmp_path / "e.db"]
    assert "simulated" in succeed(*words).lower()
    shown = document(*words)  # and the resumed run sees new parts
    assert shown["simulated"] is True
    assert shown["cell"]["parts_per_hour"] > 0
    with sqlite3.connect(tmp_path / "e.db") as connection:
        assert connection.execute("select count(distinct content_hash) from decision").fetchone() == (12,)


def test_simulate_writes_a_file_that_replay_reads(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    path = tmp_path / "traces.npz"
    shown = document("simulate", "--n", 4, "--out", path, "--seed", 3, "--n-jobs", 1)
    assert shown["simulated"] is True
    assert document("replay", "--data", path, "--reducer", "pca", "--repeats", 1)["rows"][0]["cycles"] == 4


@pytest.mark.parametrize(
    "words",
    [
        ["status", "missing.db"],
        ["replay", "--data", "missing.npz"],
        ["replay", "--reducer", "missing", "--data", "DATA"],
        ["replay", "--recipe", "missing.toml", "--data", "DATA"],
        ["replay", "--data", "DATA", "--cycles", "5000"],
        ["run", "--cell", "simulated", "--scenario", "missing", "--reducer", "pca"],
        ["simulate", "--n", "1", "--out", "x.npz", "--scenario", "missing"],
    ],
)
def test_a_foreseen_failure_is_one_line_and_exit_code_1(
    words: list[str], data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = dengine(*(data if word == "DATA" else word for word in words), "--json")
    assert not list(tmp_path.iterdir())
    assert result.exit_code == 1
    assert result.stdout == ""
    assert len(result.stderr.strip().splitlines()) == 1
    assert result.stderr.startswith("Error: Expected")


@pytest.mark.parametrize(
    "words",
    [
        ["nonsense"],
        ["replay", "--alpha", "2"],
        ["replay", "--lower-bound", "0.4"],
        ["replay", "--reducer", "pca", "--recipe", "x.toml"],
        ["compare", "--reducers", ","],
        ["run", "--cell", "elsewhere"],
        ["train"],
        ["status"],
    ],
)
def test_a_wrong_call_is_exit_code_2(words: list[str]) -> None:
    assert dengine(*words).exit_code == 2
