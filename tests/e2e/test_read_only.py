"""A store in a folder, or a file, that cannot be written is read; who would write to it
is refused.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from dengine import DataEngine
from tests.support.driving import learn
from tests.support.serving import REPO

AS_A_USER = [
    "setpriv",
    "--bounding-set=-dac_override,-dac_read_search",
    "--inh-caps=-all",
    "--ambient-caps=-all",
]
# What is there: all that a closed store leaves, and what a killed process leaves.
LEFT = {"closed": ("",), "killed": ("", "-wal", "-shm")}
LOCKED = {"a folder": (0o555, 0o644), "a file": (0o755, 0o444), "both": (0o555, 0o444)}
CASES = [(left, locked) for left in LEFT for locked in LOCKED]


# Writes an event to each store; prints a line that says why this is refused, or how many there are
# then.
WRITE = """
import sys
from dengine.errors import StoreError
from dengine.store import open_store
for path in sys.argv[1:]:
    try:
        with open_store(path) as store:
            store.events.put("note", "kept")
        with open_store(path) as store:
            print([event.kind for event in store.events.newest()].count("note"))
    except StoreError as error:
        print(" ".join(str(error).split()))
"""


def python(*words: str) -> str:
    """What a new Python prints that permission bits bind."""
    bound: list[str] = []
    if os.geteuid() == 0:
        bound = AS_A_USER
        if (
            shutil.which("setpriv") is None
            or subprocess.run([*bound, "true"], capture_output=True, check=False).returncode
        ):
            pytest.skip("permission bits do not bind root, and setpriv cannot take its rights away")
    environment = os.environ | {"PYTHONPATH": str(REPO), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [*bound, sys.executable, *words]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def stores(tmp_path_factory, make_data):
    """The folder of a store in each state."""
    data, place = make_data(60, samples=80), tmp_path_factory.mktemp("made")
    with DataEngine("pca", retrain_every=30, store=place / "engine.db") as engine:
        learn(engine, data, range(60))
        engine.flush()
        for name, suffixes in LEFT.items():
            (place / name).mkdir()
            for suffix in suffixes:
                shutil.copyfile(place / f"engine.db{suffix}", place / name / f"engine.db{suffix}")
    shutil.copyfile(place / "engine.db", place / "closed" / "engine.db")
    return {name: place / name for name in LEFT}


@pytest.fixture
def locked(stores, tmp_path):
    """A copy of a store for each of the `CASES`, which cannot be written."""
    copies = []
    for left, kind in CASES:
        folder = shutil.copytree(stores[left], tmp_path / f"{kind} of what was {left}")
        mode_of_folder, mode_of_files = LOCKED[kind]
        for file in folder.iterdir():
            file.chmod(mode_of_files)
        folder.chmod(mode_of_folder)
        copies.append(folder / "engine.db")
    yield copies
    for copy in copies:
        copy.parent.chmod(0o755)


def dengine(*commands: str) -> list[dict[str, Any]]:
    """Verbs, typed by somebody whom permission bits bind; the result of each."""
    words = json.dumps([shlex.split(command) for command in commands])
    return json.loads(python("-m", "tests.support.verbs", words))


def content(store: Path) -> dict[str, bytes]:
    """The files of a store but the index of its log, which readers write to."""
    files = [file for file in store.parent.iterdir() if not file.name.endswith("-shm")]
    return {file.name: file.read_bytes() for file in files}


def test_a_journal_that_may_not_be_read_makes_no_backup_and_verify_says_so(stores, tmp_path):
    store, journal = tmp_path / "engine.db", tmp_path / "engine.db.cell.journal"
    shutil.copy(stores["closed"] / "engine.db", store)
    journal.write_bytes(b"another user's")
    journal.chmod(0o000)
    copy = tmp_path / "copy.db"
    verified, refused = dengine(f"verify {store} --json", f"backup {store} --out {copy}")
    assert '"waiting": null' in verified["output"]
    assert refused["exit_code"] == 1
    assert "read it as the user that its cell runs as" in " ".join(refused["output"].split())
    assert not copy.exists()


# Of verbs that only read, and what they print; of the last, which would write, why it does not.
VERBS = """
status STORE --json                  "decisions": 60
data STORE                           60
history STORE --last 1 --json        "id": "
explain STORE last --json            "id": "
verify STORE --json                  "ok": true
policy STORE --json                  "lower_bound"
backup STORE --out COPY --json       "labels": 60
policy STORE --alpha 0.2             writable
"""


def test_what_only_reads_reads_it_and_leaves_it_as_it_is(locked, tmp_path):
    before, commands = [content(store) for store in locked], []
    verbs = [re.split("  +", line) for line in VERBS.strip().splitlines()]
    for i, store in enumerate(locked):
        for command, _ in verbs:
            words = command.replace("STORE", f"'{store}'").replace("COPY", f"{tmp_path}/{i}.db")
            commands.append(words)
    results = iter(dengine(*commands))
    for store, files in zip(locked, before, strict=True):
        for command, expected in verbs:
            result = next(results)
            assert expected in result["output"], (store, command)
            assert result["exit_code"] == (expected == "writable")
            assert not result["unforeseen"]
        if not store.parent.name.startswith("a folder"):  # else SQLite brings the log into it
            assert content(store) == files


def test_a_write_to_it_is_refused_or_kept_and_never_lost(locked):
    for line in python("-c", WRITE, *map(str, locked)).splitlines():
        assert line == "1" or "writable" in line
