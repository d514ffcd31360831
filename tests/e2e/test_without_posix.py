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
SECOND = "import sys; from dengine import DataEngine; DataEngine.open(sys.argv[1])"


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


def test_every_module_imports() -> None:
    python("-c", EVERY_MODULE)


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
    store = tmp_path / "engine.db"
    command = [sys.executable, "-c", REPORTING, str(store)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        lines = []
        for line in process.stdout:
            if line == "done\n":
                break
            lines.append(line.split())
        refused = python("-c", SECOND, store, code=1)
        process.kill()
        process.wait(WAIT)
    assert f"process {process.pid} on " in refused
    assert "StoreError" in refused
    assert len(lines) == 40
    text = "engine = DataEngine.open(sys.argv[1]); print(*[engine.find(each).success for each in sys.argv[2:]])"
    result = python(
        "-c",
        f"import sys; from dengine import DataEngine; {text}",
        store,
        *(id_ for id_, _ in lines),
    )
    assert result.split()[-40:] == [str(label == "1") for _, label in lines]


def test_a_child_process_does_not_keep_the_cell(tmp_path: Path) -> None:
    text = (
        "import subprocess, sys; from dengine import DataEngine; engine = DataEngine('pca', store=sys.argv[1]); "
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'], close_fds=False); "
        "engine.close(); DataEngine.open(sys.argv[1]).close(); child.kill(); child.wait(); print('opened')"
    )
    assert "opened" in python("-c", text, tmp_path / "engine.db")


def test_a_link_in_the_journals_place_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine").write_bytes(b"my notes")
    (tmp_path / "engine.db.cell.journal").symlink_to(tmp_path / "mine")
    text = "import sys; from dengine import DataEngine; DataEngine('pca', store=sys.argv[1])"
    assert "Could not use the journal" in python("-c", text, tmp_path / "engine.db", code=1)
    assert (tmp_path / "mine").read_bytes() == b"my notes"


def test_a_tokens_file_is_read_whose_bits_say_nothing_of_who_may_read_it(tmp_path: Path) -> None:
    (tmp_path / "token").write_text("t" * 32, encoding="utf-8")
    (tmp_path / "token").chmod(0o666)
    text = "import sys; from pathlib import Path; from dengine.serve.auth import read_tokens; "
    assert "1 token" in python(
        "-c", f"{text}print(len(read_tokens(Path(sys.argv[1]))), 'token')", tmp_path / "token"
    )


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
    python("-m", "dengine", "status", store)  # as it is typed
