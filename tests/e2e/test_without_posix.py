"""Nobody runs Windows here: what it lacks is hidden from dengine's modules, which do their work
without.

`tests/support/without_posix` says what is hidden; there is a lock as Windows has it.
"""

import json
import os
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("uvicorn", reason='the server is not installed: pip install "dengine[serve]"')

from sqlalchemy import make_url

from dengine.store import journal
from dengine.store.journal import journal_path
from tests.support.serving import REPO, WAIT

HIDING = f"{REPO / 'tests' / 'support' / 'without_posix'}{os.pathsep}{REPO}"
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
# Imports every module, and opens the store while another process has it, and again once a line comes. Then: a link in a
# journal's place, a token's file, a child of the process that has the cell, verbs, and a verb as it is typed.
SECOND = """
import importlib, json, pkgutil, runpy, subprocess, sys
from pathlib import Path
import dengine
def refused(name):
    raise ImportError(name)
for module in pkgutil.walk_packages(dengine.__path__, "dengine.", onerror=refused):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
from dengine import DataEngine
from dengine.errors import StoreError
from dengine.serve.auth import read_tokens
from dengine.store import journal, owned_file
from tests.support.verbs import run
assert not hasattr(owned_file.os, "pread") and not hasattr(journal.os, "O_NOFOLLOW")
folder = Path(sys.argv[1])
def why_not(open_, *words, **named):
    try:
        open_(*words, **named)
    except StoreError as error:
        return " ".join(str(error).split())
print(why_not(DataEngine.open, folder / "engine.db"), flush=True)
ids = sys.stdin.readline().split()
with DataEngine.open(folder / "engine.db") as engine:
    print(*[engine.find(id_).success for id_ in ids])
print(why_not(DataEngine, "pca", store=folder / "linked.db"))
print(len(read_tokens(folder / "token")), "token")
engine = DataEngine("pca", store=folder / "other.db")
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], close_fds=False)
engine.close()
DataEngine.open(folder / "other.db").close()
child.kill()
child.wait()
print(json.dumps([run(words.split()) for words in sys.argv[2].splitlines()]))
sys.argv[1:] = ["status", str(folder / "other.db")]
runpy.run_module("dengine", run_name="__main__")
"""
VERBS = """
train --data FOLDER/parts.npz --store FOLDER/trained.db --reducer pca
status FOLDER/trained.db
history FOLDER/trained.db --last 3
verify FOLDER/trained.db
data FOLDER/trained.db
backup FOLDER/trained.db --out FOLDER/copy.db
run --cell replay --data FOLDER/parts.npz --cycles 5 --store FOLDER/run.db
export FOLDER/trained.db --out FOLDER/model.ts
replay --data FOLDER/parts.npz --reducer pca --repeats 1 --cycles 40
"""


def python(*words: object, **options: Any) -> subprocess.Popen[str]:
    """A Python command in a process, from whose modules of dengine is hidden what Windows lacks."""
    pipes = dict.fromkeys(("stdin", "stdout"), subprocess.PIPE)
    environment = os.environ | {"PYTHONPATH": HIDING}
    command = [sys.executable, *map(str, words)]
    return subprocess.Popen(command, text=True, env=environment, **pipes, **options)


def test_names_that_differ_in_capitals_alone_have_a_journal_each_where_files_do_not(monkeypatch):
    monkeypatch.setattr(journal, "IGNORES_CASE", True)
    url = make_url("sqlite:///line.db")
    results = [journal_path(url, name).name.lower() for name in ("a", "A", "%41", "b:B", "B:b")]
    assert len(set(results)) == len(results)
    assert not set('<>:"/\\|?*') & set("".join(results))


@pytest.mark.slow
def test_the_store_and_the_process_that_retrains_keep_their_contract():
    tests = (
        "tests/contract/test_store.py",
        "tests/unit/test_incoming.py",
        "tests/e2e/test_retraining_process.py",
    )
    with python("-m", "pytest", "-q", "-p", "no:cacheprovider", *tests, cwd=REPO) as process:
        text, _ = process.communicate(timeout=600)
    assert process.returncode == 0, text[-3000:]
    assert "passed" in text or "[100%]" in text


@pytest.fixture(scope="module")
def cell(tmp_path_factory, make_data):
    """What two processes printed, of which the first is killed while it has the cell."""
    folder, data = tmp_path_factory.mktemp("cell"), make_data(60, samples=80)
    np.savez(folder / "parts.npz", X=data.X, y=data.y)
    (folder / "mine").write_bytes(b"my notes")
    (folder / "linked.db.cell.journal").symlink_to(folder / "mine")
    (folder / "token").write_text("t" * 32, encoding="utf-8")
    (folder / "token").chmod(0o666)
    verbs = VERBS.strip().replace("FOLDER", str(folder))
    with python("-c", REPORTING, folder / "engine.db") as first:
        labels = [line.split() for line in iter(first.stdout.readline, "done\n")]
        with python("-c", SECOND, folder, verbs) as second:
            refusal = second.stdout.readline()
            first.kill()
            first.wait(WAIT)
            text, _ = second.communicate(" ".join(id_ for id_, _ in labels) + "\n")
    assert second.returncode == 0, text[-3000:]
    assert f"process {first.pid} on " in refusal
    return SimpleNamespace(folder=folder, labels=labels, lines=text.splitlines())


def test_a_killed_engine_gives_its_cell_free_and_loses_no_label(cell):
    assert len(cell.labels) == 40
    assert cell.lines[0].split() == [str(label == "1") for _, label in cell.labels]


def test_every_module_imports_and_files_of_the_system_are_used_as_elsewhere(cell):
    """A link in a journal's place is refused, a token's bits say nothing of who may read it, and a
    child process does not keep the cell.
    """
    assert "Could not use the journal" in cell.lines[1]
    assert cell.lines[2] == "1 token"
    assert (cell.folder / "mine").read_bytes() == b"my notes"


def test_the_verbs_do_their_work(cell):
    results = json.loads(cell.lines[3])
    assert len(results) == 9
    assert [result for result in results if result["exit_code"] != 0] == []
    assert "What it is" in "".join(cell.lines[4:])  # of a status, as it is typed
