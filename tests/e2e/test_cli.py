"""The command line: real commands on small data."""

import os
import re
import shlex
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
import zlib
from importlib.util import find_spec
from pathlib import Path

import click
import joblib
import numpy as np
import pytest

from dengine import DataEngine, load_dataset
from dengine.cli import main
from dengine.cli.output import INTERRUPTED, WIDE, duration, size
from dengine.datasets.importing import import_labelled
from dengine.store import MemoryStore
from tests.support.command_line import dengine, document, succeed
from tests.support.driving import Counting

POLICY = ["--alpha", "0.2", "--lower-bound", "0.8"]
KNOWN = [*POLICY, "--guarantee", "pooled", "--stops", "all"]


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


VERBS = sorted(main.commands)
ENDLESS = ("serve",)  # it goes on until it is told to end, and speaks through what it serves
LESS = {  # so that an example takes seconds; its own options are all read
    "compare": ["--repeats", 1, "--cycles", 150],
    "costs": ["--alphas", 0.5, "--lower-bounds", 0.8, "--cycles", 100, "--n-jobs", 1],
    "replay": ["--repeats", 1, "--cycles", 150],
    "run": ["--cycles", 10],
    "simulate": ["--n", 4],
}


def example_of(verb: str) -> list[str]:
    lines = succeed(verb, "--help").rstrip().splitlines()
    assert lines[-2].strip() == "Example:"
    return shlex.split(lines[-1])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What examples name: a trained engine.db of the bundled set, and cell.csv, a journal of two of its traces."""
    folder = tmp_path_factory.mktemp("examples")
    succeed("train", "--data", "insertion", "--store", folder / "engine.db", "--reducer", "conv", "--retrains", 1)
    traces = load_dataset("insertion")
    lines = [
        f"part,p{i},{traces.y[i]},,verify,verify,uncertain,0.5,0.9,4,1,{','.join(f'{x:.9g}' for x in traces.X[i] + 1)}"
        for i in range(2)
    ]
    checked = [f"{line},{zlib.crc32(line.encode()):08x}" for line in lines]
    (folder / "cell.csv").write_text("\n".join(["# dengine 3 0123", *checked, ""]))
    return folder


@pytest.mark.parametrize("verb", ENDLESS)
def test_the_example_of_a_verb_without_an_end_listens_and_ends_when_it_is_told_to(verb: str, tmp_path: Path) -> None:
    pytest.importorskip("uvicorn")
    words = [*example_of(verb), "--port", "0"]  # of two, the last counts
    started = [sys.executable, "-m", *words]
    with subprocess.Popen(started, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        said = process.stdout.readline()
        process.terminate()
        assert process.wait(120) == 0
    assert "is served at http://127.0.0.1:" in said


@pytest.mark.parametrize("verb", [verb for verb in VERBS if verb not in ENDLESS])
def test_every_help_ends_in_a_command_that_works(
    verb: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if verb in ("run", "simulate"):
        pytest.importorskip("mujoco")
    makes_its_own = {"run", "train"}
    for file in () if verb in makes_its_own else folder.iterdir():
        shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    program, named, *words = example_of(verb)
    assert (program, named) == ("dengine", verb)
    succeed(named, *words, *LESS.get(verb, []))


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_speaks_json_and_explains_each_option(verb: str) -> None:
    options = [p for p in main.commands[verb].params if isinstance(p, click.Option)]
    assert ("--json" in {name for option in options for name in option.opts}) == (verb not in ENDLESS)
    assert not {option.name for option in options if not option.help}


def test_h_lists_every_verb_with_its_whole_sentence() -> None:
    shown = succeed("-h")
    assert shown == succeed("--help")
    assert all(f"  {verb} " in shown for verb in VERBS)
    assert not [line for line in shown.splitlines()[1:] if line.endswith("...")]


def test_python_m_dengine_is_the_command() -> None:
    done = subprocess.run([sys.executable, "-m", "dengine", "-h"], check=True, capture_output=True, text=True)
    assert done.stdout == succeed("-h").replace("Usage: main", "Usage: dengine")


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


def test_a_trained_store_holds_every_label_and_an_answering_version(trained: Path, data: Path) -> None:
    shown = document("status", trained)
    assert shown["labels"] == shown["sources"]["verification"] == 160
    assert shown["reasons"]["no_model"] == 160
    assert shown["version"] == 1
    assert shown["retrains"][-1]["report"]["seconds"] > 0
    with np.load(data) as file, DataEngine.open(trained) as engine:
        assert engine.decide(file["X"][0]).predicted != "verify"


def test_the_same_file_twice_counts_no_label_twice(trained: Path, data: Path) -> None:
    again = document("train", "--data", data, "--store", trained)
    nothing = {"imported": 0, "quarantined": 0, "known": 160, "resumed": True, "cut": 0, "contradicted": 0}
    assert again["import"] == nothing
    assert document("status", trained)["labels"] == 160
    assert "Nothing new" in succeed("train", "--data", data, "--store", trained)


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
        (["--reducer", "pca", "--alpha", "0.5", "--lower-bound", "0.8"], "alpha 0.2"),
        (["--reducer", "pca", *POLICY, "--guarantee", "pooled"], "guarantee local"),
        (["--reducer", "pca", *POLICY, "--novelty", "0"], "novelty 1.5"),
        (["--seed", "9"], "seed 0"),
    ],
)
def test_a_used_store_refuses_another_contract(trained: Path, data: Path, words: list[str], said: str) -> None:
    result = dengine("train", "--data", data, "--store", trained, *words)
    assert result.exit_code == 1
    assert said in result.stderr


def test_run_verifies_less_in_the_end_and_resumes_after_its_last_part(data: Path, tmp_path: Path) -> None:
    words = ["run", "--cell", "replay", "--data", data, "--store", tmp_path / "e.db", "--out", tmp_path]
    first = document(*words, "--reducer", "pca", *POLICY, "--cycles", 110)
    assert first["stretches"][0]["verified_share"] == 1.0
    assert first["stretches"][-1]["verified_share"] < 1.0
    assert (tmp_path / "run.png").is_file()
    assert len((tmp_path / "run.csv").read_text().splitlines()) == 111
    second = document(*words, "--cycles", 30, "--force")
    assert "resumed" in second["title"]
    assert document("status", tmp_path / "e.db")["ever"]["decisions"] == 140
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


@pytest.mark.parametrize(
    "words",
    [
        ["replay", "--data", "DATA", "--reducer", "pca", *POLICY, "--repeats", "2"],
        ["compare", "--data", "DATA", "--reducers", "a_recipe_of_a_rather_long_name.toml,pca", "--repeats", "1"],
        ["run", "--cell", "replay", "--data", "DATA", "--reducer", "pca", *POLICY, "--cycles", "150"],
        ["run", "--cell", "replay", "--data", "DATA", "--reducer", "pca", *POLICY, "--stops", "all", "--cycles", "150"],
        ["replay", "--data", "DATA", "--reducer", "pca", *KNOWN, "--repeats", "1"],
        ["status", "STORE"],
    ],
)
def test_what_a_verb_prints_fits_80_columns_uncut(
    words: list[str], data: Path, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a_recipe_of_a_rather_long_name.toml").write_text('reducer = "pca"\n')
    shutil.copy(trained, tmp_path / "engine.db")
    monkeypatch.chdir(tmp_path)
    known = {"DATA": str(data), "STORE": "engine.db"}
    out = succeed(*(known.get(word, word) for word in words))
    assert max(map(len, out.splitlines())) <= WIDE == 80
    assert "\u2026" not in out  # how rich marks what it has cut


def test_the_caption_says_in_words_what_its_letters_mean(data: Path) -> None:
    out = " ".join(succeed("replay", "--data", data, "--reducer", "pca", "--repeats", 1, "--cycles", 60).split())
    for words in (
        "FP (bad parts accepted)",
        "FN (good parts rejected)",
        "precision: the share of accepted parts that were good",
        "NPV, below it: the share of rejected parts that were bad",
        "pooled, that is, counted over the parts of all replays together",
    ):
        assert words in out


@pytest.mark.parametrize(("seconds", "said"), [(1.8e-4, "180 µs"), (0.0046, "4.6 ms"), (0.352, "352 ms"), (4.61, "4.6 s")])
def test_times_are_as_a_person_writes_them(seconds: float, said: str) -> None:
    assert duration(seconds) == said


@pytest.mark.parametrize(("n_bytes", "said"), [(812, "812 B"), (296_123, "296 kB"), (1.4e6, "1.4 MB"), (4.4e9, "4.4 GB")])
def test_sizes_are_as_a_person_writes_them(n_bytes: float, said: str) -> None:
    assert size(n_bytes) == said


@pytest.mark.parametrize(
    "words", [["run", "--cycles", "3", "--store", "e.db"], ["simulate", "--n", "3", "--out", "traces.npz"]]
)
def test_without_mujoco_nothing_is_begun_and_the_error_names_what_to_install(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without(name: str, package: str | None = None) -> object:
        return None if name == "mujoco" else find_spec(name, package)

    monkeypatch.setattr("dengine.cli.options.find_spec", without)
    monkeypatch.chdir(tmp_path)
    result = dengine(*words)
    assert result.exit_code == 1
    assert result.stdout == ""
    assert len(result.stderr.splitlines()) == 1
    assert 'pip install "dengine[sim]"' in result.stderr
    assert not list(tmp_path.iterdir())


def test_a_recording_runs_without_mujoco(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dengine.cli.options.find_spec", lambda name: None)
    succeed("run", "--cell", "replay", "--data", data, "--reducer", "pca", "--cycles", 5)


OWN_REDUCER = """
from sklearn.base import BaseEstimator, TransformerMixin

class FirstAndLast(TransformerMixin, BaseEstimator):
    def fit(self, X, y=None):
        self.n_features_in_ = X.shape[1]
        return self
    def transform(self, X):
        return X[:, [0, -1]]
"""


def test_a_store_goes_on_with_a_reducer_of_this_folder(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "his.py").write_text(OWN_REDUCER)
    monkeypatch.chdir(tmp_path)
    for words in (["--reducer", "his:FirstAndLast"], ["--retrains", 1]):  # made, and opened again
        monkeypatch.setattr(sys, "path", [folder for folder in sys.path if folder != str(tmp_path)])
        monkeypatch.delitem(sys.modules, "his", raising=False)
        out = succeed("train", "--data", data, "--store", "e.db", *words)
        assert "his" in sys.modules
        assert sys.path[-1] == str(tmp_path)  # last: a module of this folder shadows nothing
        assert "FirstAndLast answers" in out or "Nothing new" in out
    assert "his:FirstAndLast" in succeed("status", "e.db")
    rows = document(
        "compare", "--data", data, "--reducers", "pca,his:FirstAndLast", *POLICY, "--repeats", 1, "--out", "out"
    )
    assert [(row["recipe"], row["certain"] > 0) for row in rows["rows"]] == [("pca", True), ("FirstAndLast", True)]
    assert (tmp_path / "out" / "map_FirstAndLast.png").is_file()
    monkeypatch.delitem(sys.modules, "his")


def test_a_reducer_that_is_not_there_makes_no_store(data: Path, tmp_path: Path) -> None:
    words = ["run", "--cell", "replay", "--data", data, "--store", tmp_path / "e.db", "--cycles", 5]
    result = dengine(*words, "--reducer", "nowhere:Nothing")
    assert result.exit_code == 1
    assert "nowhere:Nothing" in result.stderr
    assert not list(tmp_path.iterdir())


def test_status_of_a_handed_in_model_names_it_and_shows_no_number_without_effect(tmp_path: Path) -> None:
    with DataEngine(model=Counting(), store=tmp_path / "e.db") as engine:
        engine.decide(np.linspace(0, 1, 40))
    out = succeed("status", tmp_path / "e.db")
    assert "Counting, decides by its own rule" in out
    assert not {"reducer", "policy", "guarantee", "neighbours", "novelty"} & {
        line.split()[1] for line in out.splitlines() if "│" in line
    }


def test_status_says_what_the_engine_decides_by(trained: Path) -> None:
    out = succeed("status", trained)
    for said in ("alpha 0.2, LB 80 %", "local", "radius of 0.2", "every 50 new labels", "450 ms", "40 samples at 500 Hz"):
        assert said in out


# ------------------------------------------------------------------ guarantees, the certificate, novelty, safe mode


def test_a_replays_row_names_its_guarantee_and_what_is_known_of_stops(data: Path) -> None:
    words = ["replay", "--data", data, "--reducer", "pca", "--repeats", 1, "--cycles", 120]
    local, pooled = document(*words, *POLICY)["rows"][0], document(*words, *KNOWN)["rows"][0]
    assert (local["guarantee"], local["stops"]) == ("local", "some")
    assert (pooled["guarantee"], pooled["stops"]) == ("pooled", "all")
    assert pooled["novel"] >= 0 == pooled["safe_mode"]
    out = " ".join(succeed(*words, *KNOWN).split())
    assert "pooled, all" in out
    assert "Guarantee pooled" in out


def test_compare_shows_the_guarantee_of_every_recipe(data: Path, tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_text('reducer = "pca"\n[policy]\nguarantee = "pooled"\nstops = "all"\n')
    words = ["compare", "--data", data, "--reducers", f"pca,{own}", *POLICY, "--repeats", 1, "--cycles", 80]
    rows = document(*words)["rows"]
    assert [(row["recipe"], row["guarantee"]) for row in rows] == [("pca", "local"), ("own", "pooled")]
    out = " ".join(succeed(*words).split())
    assert "Guarantee local" in out
    assert "Guarantee pooled" in out


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--guarantee", "global"], 2, "'global' is not one of 'local', 'pooled'"),
        (["--stops", "most"], 2, "'most' is not one of 'all', 'some'"),
        (["--audit-rate", "1"], 2, "1.0 is not in the range 0.0<=x<1.0"),
        (["--novelty", "-1"], 2, "-1.0 is not in the range x>=0.0"),
        (["--novelty", "inf"], 1, "0 turns it off"),
        (["--part", "serial"], 1, "Expected an array serial"),
    ],
)
def test_a_wrong_setting_says_what_was_expected(data: Path, words: list[str], code: int, said: str) -> None:
    result = dengine("replay", "--data", data, "--reducer", "pca", "--cycles", 20, "--repeats", 1, *words)
    assert result.exit_code == code
    assert said in result.stderr


@pytest.fixture(scope="module")
def changing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """700 easy parts in order with numbers of their own; from the 301st to the 400th the sensor is hit by a wave."""
    rng = np.random.default_rng(1)
    y = rng.random(700) < 0.6
    X = np.where(y[:, None], np.linspace(0, 5, 40), np.linspace(5, 0, 40)) + rng.normal(0, 0.3, (700, 40))
    X[300:400] = 2 * X[300:400] + 8 * np.sin(2 * np.arange(40))
    path = tmp_path_factory.mktemp("changing") / "changing.npz"
    np.savez(path, X=X.astype(np.float32), y=y.astype(np.int8), serial=np.array([f"p{i}" for i in range(700)]))
    return path


@pytest.fixture(scope="module")
def alarmed(changing: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """A store whose engine was put into safe mode, and the run's document."""
    store = tmp_path_factory.mktemp("alarmed") / "engine.db"
    words = ["run", "--cell", "replay", "--data", changing, "--part", "serial", "--store", store, "--reducer", "pca"]
    shown = document(*words, *KNOWN, "--audit-rate", 0.1, "--cycles", 320)
    return store, shown


def test_a_run_says_when_safe_mode_began_and_what_is_certified(alarmed: tuple[Path, dict]) -> None:
    _, shown = alarmed
    (change,) = shown["safe_mode_changes"]
    assert 300 < change["cycle"] <= 320
    assert change["reason"] == shown["safe_mode"] == "too many traces were novel"
    assert shown["stretches"][-1]["novel"] > 0
    assert shown["stretches"][-1]["safe_mode"] == 320 - change["cycle"] + 1
    assert shown["certificate"]["sentence"].startswith("Of ")
    assert shown["certificate"]["accepted"]["upper"] <= 1.0


def test_status_shows_the_certificate_the_safe_mode_and_the_newest_events(alarmed: tuple[Path, dict]) -> None:
    store, shown = alarmed
    out = " ".join(succeed("status", store).replace("│", " ").split())
    for said in (
        "pooled: of all accepted parts together",
        "of all bad parts: an accepted part that no stop follows counts as good",
        shown["certificate"]["sentence"],
        shown["certificate"]["advice"],
        shown["certificate"]["sentence_on_rejects"],
        "10 % of what it is certain of",
        "every part is verified: too many traces were novel",
        "safe mode: too many traces were novel",
    ):
        assert said in out
    assert re.search(r"safe mode on since \d{4}-\d\d-\d\d ", out)
    assert re.search(r"novel \d+ of 320 decisions \(\d+\.\d %\); of the newest \d+ that labels tell of, \d+ \(", out)


def test_statuss_document_has_all_of_it(alarmed: tuple[Path, dict]) -> None:
    store, shown = alarmed
    held = document("status", store)
    assert (held["recipe"]["policy"]["guarantee"], held["recipe"]["policy"]["stops"]) == ("pooled", "all")
    assert held["certificate"] == shown["certificate"]
    assert held["safe_mode"] == "too many traces were novel"
    assert held["safe_mode_time"] == held["events"][-1]["time"]
    assert held["ever"]["novel"] == held["reasons"]["novel"] == sum(part["novel"] for part in shown["stretches"])
    assert 0 < held["ever"]["novel_share"] < held["recent_novel"] / held["recent"] < 1


def test_a_safe_mode_that_ended_is_off_and_the_run_says_both(changing: Path, tmp_path: Path) -> None:
    store = tmp_path / "engine.db"
    words = ["run", "--cell", "replay", "--data", changing, "--part", "serial", "--store", store, "--reducer", "pca"]
    result = dengine(*words, *KNOWN, "--cycles", 700)
    assert result.exit_code == 0, result.output
    said = re.findall(r"^After cycle \d+: safe mode.*$", result.stdout, flags=re.M)
    assert len(said) >= 2
    assert "safe mode, every part is" in said[0]
    assert said[-1].endswith("safe mode ended.")
    assert "too many traces were novel" in result.stderr
    assert "safe: cycles of safe mode" in " ".join(result.stdout.split())
    assert "confidence, however often one looks" in " ".join(result.stdout.split())
    assert "off, ended" in succeed("status", store)
    held = document("status", store)
    assert held["safe_mode"] == ""
    assert held["safe_mode_time"] is not None


def test_a_store_whose_engine_was_never_alarmed_is_off_since_ever(trained: Path) -> None:
    held = document("status", trained)
    assert (held["safe_mode"], held["safe_mode_time"]) == ("", None)
    assert "Nothing can be said yet" in held["certificate"]["sentence"]
    assert (held["ever"]["novel"], held["recent"], held["recent_novel"]) == (0, 160, 0)


def test_parts_that_come_again_are_played_on_from_where_the_run_was(data: Path, tmp_path: Path) -> None:
    with np.load(data) as file:
        np.savez(tmp_path / "twice.npz", X=file["X"], y=file["y"], part=np.arange(160) % 80)
    words = ["run", "--cell", "replay", "--data", tmp_path / "twice.npz", "--store", tmp_path / "e.db"]
    document(*words, "--reducer", "pca", *KNOWN, "--cycles", 70)
    assert "from part 71" in document(*words, "--cycles", 10)["title"]
    assert document("status", tmp_path / "e.db")["ever"]["decisions"] == 80


def test_an_accepted_part_is_not_played_again_although_it_has_no_label_yet(data: Path, tmp_path: Path) -> None:
    with np.load(data) as file:
        good, bad = np.flatnonzero(file["y"] == 1), np.flatnonzero(file["y"] == 0)
        order = np.concatenate([np.random.default_rng(0).permutation(np.concatenate([good[:40], bad[:40]])), good[40:]])
        np.savez(tmp_path / "good_in_the_end.npz", X=file["X"][order], y=file["y"][order])
    words = ["run", "--cell", "replay", "--data", tmp_path / "good_in_the_end.npz", "--store", tmp_path / "e.db"]
    first = document(*words, "--reducer", "pca", *POLICY, "--stops", "all", "--cycles", len(order) - 2)
    last = first["stretches"][-1]
    assert last["accepted"] == last["last_cycle"] - last["first_cycle"] + 1
    assert f"from part {len(order) - 1}" in document(*words, "--cycles", 2)["title"]
    assert document("status", tmp_path / "e.db")["ever"]["decisions"] == len(order)


def interrupted(folder: Path, ready: str, *words: object) -> tuple[int, str, str]:
    """A real process that gets SIGINT once `ready` is in its folder: exit code, stdout, stderr."""
    process = subprocess.Popen(
        [sys.executable, "-m", "dengine", *map(str, words)],
        cwd=folder,
        env=os.environ | {"COLUMNS": "80"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    until = time.monotonic() + 60
    while not (folder / ready).exists() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err


SIGNALLING_REDUCER = """
from pathlib import Path
from sklearn.decomposition import PCA

class Slow(PCA):
    def fit(self, X, y=None):
        seen = len(list(Path().glob("fit_*")))
        Path(f"fit_{seen}").touch()
        return super().fit(X, y)
"""


def test_an_interrupted_replay_reports_what_was_finished(data: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(SIGNALLING_REDUCER)
    words = ["--reducer", "mine:Slow", *POLICY, "--cycles", 120, "--repeats", 5000, "--out", "out"]
    code, out, err = interrupted(tmp_path, "fit_4", "replay", "--data", data, *words)
    assert code == INTERRUPTED
    finished = int(re.search(r"Interrupted: (\d+) of 5000 replays were finished; the table shows those\.", err)[1])
    assert finished >= 1
    assert f"{finished} replay" in out
    assert len((tmp_path / "out" / "replays.csv").read_text().splitlines()) == 1 + finished
    assert (tmp_path / "out" / "curves.png").is_file()


def test_an_interrupted_run_keeps_every_cycle_that_it_names(data: Path, tmp_path: Path) -> None:
    long = tmp_path / "long.npz"
    with np.load(data) as file:
        noise = np.random.default_rng(0).normal(0, 0.1, (50 * len(file["y"]), file["X"].shape[1]))
        np.savez(long, X=np.tile(file["X"], (50, 1)) + noise, y=np.tile(file["y"], 50))
    (tmp_path / "mine.py").write_text(SIGNALLING_REDUCER)
    words = ["--data", long, "--cycles", 8000, "--store", "e.db", "--reducer", "mine:Slow", "--lower-bound", "0.99"]
    code, out, err = interrupted(tmp_path, "fit_1", "run", "--cell", "replay", *words)
    assert code == INTERRUPTED
    done = int(re.search(r"Interrupted: (\d+) of 8000 cycles were done", err)[1])
    assert f"Everything up to cycle {done} is in e.db; the same command with --cycles {8000 - done}" in err
    assert f"1 to {done}" in out
    assert document("status", tmp_path / "e.db")["ever"]["decisions"] == done > 0


def test_an_interrupted_import_says_how_far_it_came(data: Path, tmp_path: Path) -> None:
    X = np.random.default_rng(0).normal(size=(20_000, 40)).astype(np.float32)
    np.savez(tmp_path / "many.npz", X=X, y=np.arange(len(X)) % 2)
    code, _, err = interrupted(tmp_path, "e.db", "train", "--data", "many.npz", "--store", "e.db", "--reducer", "pca")
    assert code == INTERRUPTED
    done = int(re.search(r"Interrupted: (\d+) of 20000 traces are in e\.db; the same command goes on", err)[1])
    assert document("status", tmp_path / "e.db")["labels"] == done


def test_an_import_that_was_interrupted_in_training_keeps_its_retrains(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dengine.engine.engine import DataEngine as Engine

    retrain = Engine.retrain

    def pressed(engine: Engine) -> object:
        os.kill(os.getpid(), signal.SIGINT)
        return retrain(engine)

    monkeypatch.setattr(Engine, "retrain", pressed)
    result = dengine("train", "--data", data, "--store", tmp_path / "e.db", "--reducer", "conv")
    assert result.exit_code == INTERRUPTED
    assert "Imported 160 labelled traces" in result.stdout
    assert "Interrupted after 1 of at most 10 retrains" in result.stderr
    assert document("status", tmp_path / "e.db")["version"] == 1
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
