"""Nobody runs Windows here: what it lacks is hidden from dengine's modules, which do their work
without.

`tests/support/without_posix` says what is hidden; there is a lock as Windows has it.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("uvicorn", reason='the server is not installed: pip install "dengine[serve]"')

from sqlalchemy import make_url

from dengine.store import journal
from dengine.store.journal import journal_path
from tests.support.serving import REPO, WAIT

HIDING = f"{REPO / 'tests' / 'support' / 'without_posix'}{os.pathsep}{REPO}"
EVERY_MODULE = """
import importlib, pkgutil
import dengine
def refused(name):
    raise ImportError(name)
for module in pkgutil.walk_packages(dengine.__path__, "dengine.", onerror=refused):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
from dengine import replay
from dengine.store import journal, owned_file
assert not hasattr(owned_file.os, "pread") and not hasattr(journal.os, "O_NOFOLLOW")
"""
# A link in a journal's place, a token's file, a child of the process that has the cell, and a verb as it is typed.
FILES = """
import runpy, subprocess, sys
from pathlib import Path
from dengine import DataEngine
from dengine.errors import StoreError
from dengine.serve.auth import read_tokens
folder = Path(sys.argv[1])
try:
    DataEngine("pca", store=folder / "linked.db")
except StoreError as error:
    print(" ".join(str(error).split()))
print(len(read_tokens(folder / "token")), "token")
engine = DataEngine("pca", store=folder / "engine.db")
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], close_fds=False)
engine.close()
DataEngine.open(folder / "engine.db").close()
child.kill()
child.wait()
print("opened")
sys.argv[1:] = ["status", str(folder / "engine.db")]
runpy.run_module("dengine", run_name="__main__")
"""
REPORTING = """
import sys, time
from dengine import DataEngine
from dengine.testing import toy_traces
X, y = toy_traces(40)
engine = DataEngine("pca", retrain_every=30, store=sys.argv[1])
for i in range(40):
    decision = engine.decide(X[i])
    engine.report(decision.id, bool(y[i]))
    print(decision.id, int(y[i]), flush=True)
print("done", flush=True)
time.sleep(600)
"""
# Opens the store while another process has it, says why it is refused, and again once a line comes.
SECOND = """
import sys
from dengine import DataEngine
from dengine.errors import StoreError
try:
    DataEngine.open(sys.argv[1])
    print("nobody has it", flush=True)
except StoreError as error:
    print(" ".join(str(error).split()), flush=True)
ids = sys.stdin.readline().split()
engine = DataEngine.open(sys.argv[1])
print(*[engine.find(id_).success for id_ in ids])
"""


@pytest.fixture(autouse=True)
def hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", HIDING)


def python(*words: object, code: int = 0) -> str:
    """What a Python command prints, on either stream."""
    done = subprocess.run(
        [sys.executable, *map(str, words)], capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == code, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout + done.stderr


def test_names_that_differ_in_capitals_alone_have_a_journal_each_where_files_do_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(journal, "IGNORES_CASE", True)
    url = make_url("sqlite:///line.db")
    names = ["a", "A", "%41", "b:B", "B:b", "é", "É"]
    results = [journal_path(url, name).name for name in names]
    assert len({item.lower() for item in results}) == len(names)
    assert results[0] == "line.db.a.journal"
    assert not set('<>:"/\\|?*') & set("".join(results))


@pytest.mark.slow
def test_the_store_and_the_process_that_retrains_keep_their_contract() -> None:
    tests = (
        "tests/contract/test_store.py",
        "tests/unit/test_incoming.py",
        "tests/e2e/test_retraining_process.py",
    )
    text = python("-m", "pytest", "-q", "-p", "no:cacheprovider", *(REPO / test for test in tests))
    assert "passed" in text or "[100%]" in text


def test_a_killed_engine_gives_its_cell_free_and_loses_no_label(tmp_path: Path) -> None:
    pipes = dict.fromkeys(("stdin", "stdout"), subprocess.PIPE)
    commands = [
        [sys.executable, "-c", code, tmp_path / "engine.db"] for code in (REPORTING, SECOND)
    ]
    with subprocess.Popen(commands[0], stdout=subprocess.PIPE, text=True) as process:
        lines = [line.split() for line in iter(process.stdout.readline, "done\n")]
        with subprocess.Popen(commands[1], text=True, **pipes) as second:
            refused = second.stdout.readline()
            process.kill()
            process.wait(WAIT)
            answers, _ = second.communicate(" ".join(id_ for id_, _ in lines) + "\n", timeout=WAIT)
    assert f"process {process.pid} on " in refused
    assert len(lines) == 40
    assert (second.returncode, answers.split()[-40:]) == (
        0,
        [str(label == "1") for _, label in lines],
    )


def test_every_module_imports_and_files_of_the_system_are_used_as_elsewhere(tmp_path: Path) -> None:
    """A link in a journal's place is refused, a token's bits say nothing of who may read it, and a
    child process does not keep the cell.
    """
    (tmp_path / "mine").write_bytes(b"my notes")
    (tmp_path / "linked.db.cell.journal").symlink_to(tmp_path / "mine")
    (tmp_path / "token").write_text("t" * 32, encoding="utf-8")
    (tmp_path / "token").chmod(0o666)
    text = python("-c", EVERY_MODULE + FILES, tmp_path)
    assert "Could not use the journal" in text
    assert "\n1 token\nopened\n" in text
    assert "What it is" in text  # of a status
    assert (tmp_path / "mine").read_bytes() == b"my notes"


def test_the_verbs_do_their_work(tmp_path: Path, make_data) -> None:
    data = make_data(60, samples=80)
    np.savez(tmp_path / "parts.npz", X=data.X, y=data.y)
    store = tmp_path / "engine.db"
    commands = [
        ("train", "--data", tmp_path / "parts.npz", "--store", store, "--reducer", "pca"),
        ("status", store),
        ("history", store, "--last", 3),
        ("verify", store),
        ("data", store),
        ("backup", store, "--out", tmp_path / "copy.db"),
        (
            "run",
            "--cell",
            "replay",
            "--data",
            tmp_path / "parts.npz",
            "--cycles",
            5,
            "--store",
            tmp_path / "run.db",
        ),
        ("export", store, "--out", tmp_path / "model.ts"),
        (
            "replay",
            "--data",
            tmp_path / "parts.npz",
            "--reducer",
            "pca",
            "--repeats",
            1,
            "--cycles",
            40,
        ),
    ]
    words = json.dumps([[str(word) for word in command] for command in commands])
    results = json.loads(python("-m", "tests.support.verbs", words).splitlines()[-1])
    assert [result for result in results if result["exit_code"] != 0] == []
