"""The command line: real commands on small data."""

import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dengine import DataEngine, Dataset, backup_store, load_dataset
from dengine.cli import main
from dengine.cli.output import INTERRUPTED, print_parts, table_of_rows
from dengine.datasets import importing
from dengine.datasets.importing import import_labelled
from dengine.engine.trainer import Retrainer
from tests.support.command_line import (
    dengine,
    document,
    example_of,
    line_of,
    refused,
    succeed,
    well,
)
from tests.support.driving import easy_parts
from tests.support.exports import cell_journal

POLICY = ["--alpha", "0.2", "--lower-bound", "0.8"]
KNOWN = [*POLICY, "--guarantee", "pooled", "--stops", "all"]
VERBS = sorted(main.commands)
LESS = {  # so that an example takes seconds; its own options are all read
    "compare": "--reducers pca --repeats 1 --cycles 60",
    "costs": "--alphas 0.5 --lower-bounds 0.8 --cycles 100 --n-jobs 1",
    "replay": "--repeats 1 --cycles 60 --reducer pca",
    "run": "--cycles 6",
    "simulate": "--n 4",
    "train": "--data small.npz --reducer pca",
}
OWN_REDUCERS = """
import os, signal
from sklearn.decomposition import PCA

class Interrupting(PCA):
    fits = 0
    def fit(self, X, y=None):
        Interrupting.fits += 1
        if Interrupting.fits == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return super().fit(X, y)
"""


def save(path: Path, data: Dataset, **more: object) -> Path:
    np.savez(path, X=data.X, y=data.y, **more)
    return path


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """160 traces of 40 samples in two easy shapes, and their labels."""
    return save(tmp_path_factory.mktemp("data") / "easy.npz", easy_parts(160, 0))


def n_rows(table: Path) -> int:
    return len(table.read_text().splitlines()) - 1


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory):
    store = tmp_path_factory.mktemp("store") / "engine.db"
    succeed("train", "--data", data, "--store", store, "--reducer", "pca", *POLICY)
    return store


@pytest.fixture
def own_folder(tmp_path, monkeypatch):
    """A folder with reducers of one's own, in which the command is called."""
    (tmp_path / "his.py").write_text(OWN_REDUCERS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield tmp_path
    sys.modules.pop("his", None)


def test_python_m_dengine_shows_the_help_and_imports_nothing_heavy():
    command = [sys.executable, "-X", "importtime", "-m", "dengine", "-h"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    # Where lines break depends on the length of the program's name.
    assert done.stdout.split() == succeed("-h").replace("Usage: main", "Usage: dengine").split()
    imported = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "dengine.cli.options" in imported
    assert not {"numpy", "torch", "pandas", "rich", "sklearn"} & imported


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What examples name: a trained engine.db of a part of the bundled set, backup.db, its copy, and
    cell.csv, a journal of two of its traces.
    """
    folder, parts = tmp_path_factory.mktemp("examples"), load_dataset("insertion")
    save(folder / "parts.npz", replace(parts, X=parts.X[:200], y=parts.y[:200], cause=None))
    words = f"--data {folder}/parts.npz --store {folder}/engine.db --reducer pca"
    succeed("train", *words.split())
    line = "part,p{},{},,verify,verify,uncertain,0.5,0.9,4,1,{}"
    lines = (line.format(i, parts.y[i], ",".join(map(str, parts.X[i] + 1))) for i in range(2))
    (folder / "cell.csv").write_bytes(cell_journal(*lines))
    backup_store(folder / "engine.db", folder / "backup.db")
    return folder


# The example of serve is what `tests.support.serving.started` types.
@pytest.mark.parametrize("verb", [verb for verb in VERBS if verb != "serve"])
def test_every_help_ends_in_a_command_that_works(verb, folder, tmp_path, monkeypatch, make_data):
    if verb == "simulate":
        pytest.importorskip("mujoco")
    for file in () if verb in ("run", "train") else folder.iterdir():  # these two make a store
        shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    if verb == "train":
        save(tmp_path / "small.npz", make_data(60))
    program, named, *words = example_of(verb)
    assert (program, named) == ("dengine", verb)
    succeed(named, *words, *LESS.get(verb, "").split())


def test_replay_prints_a_table_with_its_words_and_writes_csv_and_pictures(data, tmp_path):
    asked = f"replay --data {data} --reducer pca --repeats 2 --cycles 100".split() + POLICY
    shown = line_of(*asked, "--out", tmp_path, "--explain")
    for words in ("retrains, the worst in", "FP: bad parts accepted", "pca (local)"):
        assert words in shown
    assert n_rows(tmp_path / "replays.csv") == 2
    assert {p.name for p in tmp_path.glob("*.png")} == {"curves.png", "map_pca.png"}
    row = document(*asked, "--check-seconds", 9)["rows"][0]
    assert row["saved_s"] == 9 * row["certain"] > 0
    row = document(*asked[:5], "--in-order", "--cycles", 20)["rows"][0]
    assert row["replays"] == 1
    assert row["precision"] is row["promise_kept"] is None  # nothing was accepted


def test_a_trained_store_holds_every_label_once_and_an_answering_version(trained, data):
    again = document("train", "--data", data, "--store", trained)["import"]
    assert (again["imported"], again["repeated"], again["resumed"]) == (0, 160, True)
    shown, text = document("status", trained), line_of("status", trained)
    assert (shown["labels"], shown["sources"]["verification"]) == (160, 160)
    for words in ("alpha 0.2, lower bound 0.8", "rate unknown, unit unknown"):
        assert words in text
    with DataEngine.open(trained) as engine:
        assert engine.decide(easy_parts(1, 0).X[0]).predicted != "verify"


def test_training_goes_on_after_retrains_without_a_step(tmp_path, monkeypatch):
    data, store = save(tmp_path / "easy.npz", easy_parts(20, 0)), tmp_path / "e.db"
    words = f"train --data {data} --store {store}".split()
    with monkeypatch.context() as busy:
        # The attribute `data` of `dengine.cli` is the verb, not the module.
        busy.setattr(sys.modules["dengine.cli.data"], "MOST_EMPTY_RETRAINS", 2)
        busy.setattr(Retrainer, "_step_seconds", lambda retrainer: -1.0)
        text = refused(*words, "--reducer", "conv")
        assert "60 training steps are missing: 2 retrains in a row had no time" in text
        assert "It was accepted; 60 steps to go;" in line_of("retrain", store)
    again = document(*words)  # nothing is new, and all steps are missing
    assert (again["import"]["imported"], again["retrain"]["accepted"]) == (0, True)
    assert "nothing was done" in line_of(*words)


def test_training_on_too_few_labels_says_so(tmp_path):
    data = save(tmp_path / "easy.npz", easy_parts(10, 0))
    text = refused("train", "--data", data, "--store", tmp_path / "e.db")
    assert "Expected at least 20 traces, got 10" in text


def test_run_verifies_less_in_the_end_and_resumes_after_its_last_part(data, tmp_path):
    store = tmp_path / "e.db"
    words = f"run --cell replay --data {data} --store {store} --out {tmp_path} --force".split()
    first = document(*words, "--reducer", "pca", *POLICY, "--cycles", 110)
    shares = [part["verified_share"] for part in first["stretches"]]
    assert shares[0] == 1.0 > shares[-1]
    assert (tmp_path / "run.png").is_file()
    assert n_rows(tmp_path / "run.csv") == 110
    assert "resumed" in document(*words, "--reducer", "pca", "--cycles", 30)["title"]
    # Only what was typed is named.
    assert "got alpha 0.01; leave them out" in refused(*words, "--alpha", 0.01, "--cycles", 9)
    with DataEngine.open(store) as engine:
        assert engine.status().ever.decisions == 140
        hashes = engine.store.labels.with_traces().hashes.tolist()
    assert len(hashes) == len({*hashes})
    assert re.search(r"--cycles of at most 2\d, got 60", refused(*words, "--cycles", 60))


def test_a_table_prints_every_text_as_it_is_and_cuts_none(capsys):
    long = "x" * 200
    print_parts(table_of_rows("old [1] [/red]", [["0:100::60", long], [long, "0:100::60"]]))
    printed = capsys.readouterr().out
    assert "old [1] [/red]" in printed
    assert (printed.count("0:100::60"), printed.count("x")) == (2, 400)


FAILING = """status missing.db; replay --data missing.npz; replay --recipe missing.toml --data DATA; data DATA --set traces.samples=x
replay --data DATA --cycles 5000; replay --data DATA --channel FX; simulate --n 1 --out x.npz --scenario missing
run --cell replay --data DATA --store e.db --reducer nowhere:Nothing"""


def test_a_foreseen_failure_is_one_line_and_exit_code_1(data, own_folder):
    for words in re.split("; |\n", FAILING):
        result = dengine(*words.replace("DATA", str(data)).split(), "--json")
        assert [path.name for path in own_folder.iterdir()] == ["his.py"]
        assert (result.exit_code, result.stdout, result.stderr.count("\n")) == (1, "", 1)
        assert result.stderr.startswith("Error: Expected")


def test_a_wrong_call_is_exit_code_2_and_says_what_was_expected():
    for line in WRONG.strip().splitlines():
        words, expected = re.split("  +", line)
        result = dengine(*words.split())
        assert result.exit_code == 2, words
        assert expected in " ".join(result.stderr.split())


def test_without_mujoco_nothing_is_begun_and_the_error_names_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr("dengine.cli.options.find_spec", lambda name: None)
    monkeypatch.chdir(tmp_path)
    for words in ("run --cell simulated --cycles 3 --store e.db", "simulate --n 3 --out x.npz"):
        assert 'pip install "dengine[sim]"' in dengine(*words.split()).stderr
        assert not list(tmp_path.iterdir())


def test_a_run_and_its_status_say_when_safe_mode_began_when_it_ended_and_what_is_certified(
    tmp_path,
):
    parts, store = easy_parts(700, 1, wave=slice(300, 400)), tmp_path / "engine.db"
    data = save(tmp_path / "changing.npz", parts, serial=parts.part)
    stated = "--set part.column=serial --set channels.X=N --set label.good=1 --set label.bad=0"
    succeed("data", data, *stated.split(), "--save")
    words = f"run --data {data} --store {store} --reducer pca".split()
    shown = document(*words, *KNOWN, "--audit-rate", 0.1, "--cycles", 320)
    (change,) = shown["safe_mode_changes"]
    assert 300 < change["cycle"] <= 320
    assert change["reason"] == shown["safe_mode"] == "too many traces were novel"
    assert shown["stretches"][-1]["safe_mode"] == 320 - change["cycle"] + 1
    text, certificate = line_of("status", store), shown["certificate"]
    assert document("status", store)["certificate"] == certificate
    assert certificate["sentence"] in text
    assert certificate["sentence_on_rejects"] in text
    assert re.search(r"safe mode too many .* safe mode time \d{4}-\d\d-\d\d ", text)
    ended = well(*words[:-2], "--cycles", 380)  # the store knows its reducer
    assert re.search(r"(?m)^After cycle \d+: safe mode ended\.$", ended.stdout)
    assert "safe mode too" not in line_of("status", store)


def test_an_interrupted_replay_reports_what_was_finished(data, own_folder):
    words = f"replay --data {data} --reducer his:Interrupting --cycles 60 --repeats 50 --out out"
    result = dengine(*words.split(), *POLICY)
    assert result.exit_code == INTERRUPTED
    assert "Interrupted: 2 of 50 replays were finished; the table shows those." in result.stderr
    assert "2 replays" in result.stdout
    assert n_rows(own_folder / "out" / "replays.csv") == 2
    assert (own_folder / "out" / "curves.png").is_file()


def test_an_interrupted_run_keeps_every_cycle_that_it_names(data, own_folder):
    words = f"run --cell replay --data {data} --cycles 160 --store e.db --reducer his:Interrupting"
    result = dengine(*words.split(), "--lower-bound", 0.99, "--out", "out")
    assert result.exit_code == INTERRUPTED
    done = int(re.search(r"Interrupted: (\d+) of 160 cycles were done", result.stderr)[1])
    rest = f"Everything up to cycle {done} is in e.db; the same command with --cycles {160 - done}"
    assert f"{rest} and another folder for --out continues there." in result.stderr
    rest = f"run --data {data} --cycles {160 - done} --store e.db --allow-import --out".split()
    assert "run.csv exists" in dengine(*rest, "out").stderr
    assert document("status", "e.db")["ever"]["decisions"] == done  # no part was played
    succeed(*rest, "rest")
    assert [n_rows(Path(name, "run.csv")) for name in ("out", "rest")] == [done, 160 - done]


WRONG = """
nonsense                          No such command
replay --guarantee global         'global' is not one of 'local', 'pooled'
replay --reducer missing          'missing' is not one of 'conv', 'umap', 'umap-learn', 'pca',
replay --audit-rate 1             1.0 is not in the range 0.0<=x<1.0
replay --in-order --repeats 3     leave --repeats out
compare --reducers ,              at least one value
compare --alphas 0.1,2            2.0 is not in the range
compare --alphas 0.1 --alpha 0.1  --alpha gives one value
compare --reducers pca,pca        a name of its own
compare --intervals wald          'wald' is not one of 'wilson', 'binomial'
train                             Missing option
costs --data missing.npz --escape 20 --false-reject 10 --alpha 0.1  use --alphas
"""


def test_an_interrupted_import_says_how_far_it_came_and_goes_on_there(tmp_path, monkeypatch):
    easy = easy_parts(160, 0)
    easy.X[0, 3], easy.X[1], easy.X[2:8] = np.nan, 7.0, easy.X[2]  # bad, and equal ones
    data, store = save(tmp_path / "easy.npz", easy), tmp_path / "e.db"

    def interrupted(*args):
        os.kill(os.getpid(), signal.SIGINT)
        return import_labelled(*args)

    words = f"train --data {data} --store {store} --reducer pca".split()
    with monkeypatch.context() as patched:
        patched.setattr(importing, "CHUNK", 70)
        patched.setattr(importing, "import_labelled", interrupted)
        result = dengine(*words)
    assert result.exit_code == INTERRUPTED
    done = re.search(r"Interrupted: (\d+) of 160 traces\s+are in", result.stderr)[1]
    assert document("status", store)["labels"] == int(done)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    succeed(*words)
    with DataEngine.open(store) as engine:
        kept = engine.store.labels.with_traces().labels
    assert kept.tolist() == easy.y[2:].tolist()  # bad ones are kept, and never trained on
