"""A store in a folder, or a file, that cannot be written is read; who would write to it
is refused.
"""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from dengine import DataEngine, Dataset
from tests.support.driving import learn
from tests.support.serving import REPO

AS_A_USER = [
    "setpriv",
    "--bounding-set=-dac_override,-dac_read_search",
    "--inh-caps=-all",
    "--ambient-caps=-all",
]
# What is there: all that a closed store leaves, what a killed process leaves, and that without its
# index of the log.
LEFT = {"closed": ("",), "killed": ("", "-wal", "-shm"), "copied with its log": ("", "-wal")}
LOCKED = {"a folder": (0o555, 0o644), "a file": (0o755, 0o444), "both": (0o555, 0o444)}
CASES = [(left, locked) for left in LEFT for locked in LOCKED]
CASE_NAMES = [f"{locked} of what was {left}" for left, locked in CASES]


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


class Reading(NamedTuple):
    """What verbs printed of a locked store, and its files before and after them."""

    results: list[dict[str, Any]]
    before: dict[str, bytes]
    after: dict[str, bytes]


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


def dengine(*commands: Sequence[object]) -> list[dict[str, Any]]:
    """Verbs, typed by somebody whom permission bits bind; the result of each."""
    words = json.dumps([[str(word) for word in command] for command in commands])
    results: list[dict[str, Any]] = json.loads(python("-m", "tests.support.verbs", words))
    return results


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory, make_data) -> dict[str, Path]:
    """A store in each state."""
    data: Dataset = make_data(60, samples=80)
    place = tmp_path_factory.mktemp("made")
    with DataEngine("pca", retrain_every=30, store=str(place / "engine.db")) as engine:
        learn(engine, data, range(60))
        engine.store.flush()
        for name in ("killed", "copied with its log"):
            (place / name).mkdir()
            for suffix in LEFT[name]:
                shutil.copyfile(place / f"engine.db{suffix}", place / name / f"engine.db{suffix}")
    (place / "closed").mkdir()
    shutil.copyfile(place / "engine.db", place / "closed" / "engine.db")
    return {name: place / name for name in LEFT}


@contextmanager
def archived(stores: dict[str, Path], place: Path) -> Iterator[dict[str, Path]]:
    """A copy of a store for each of the `CASES`, locked until the end of the block."""
    copies: dict[str, Path] = {}
    for left, locked in CASES:
        folder = place / f"{locked} of what was {left}"
        shutil.copytree(stores[left], folder)
        mode_of_folder, mode_of_files = LOCKED[locked]
        for file in folder.iterdir():
            file.chmod(mode_of_files)
        folder.chmod(mode_of_folder)
        copies[folder.name] = folder / "engine.db"
    yield copies
    for copy in copies.values():
        copy.parent.chmod(0o755)


def content(store: Path) -> dict[str, bytes]:
    """The files of a store but the index of its log, which readers write to."""
    files = [file for file in store.parent.iterdir() if not file.name.endswith("-shm")]
    return {file.name: file.read_bytes() for file in files}


@pytest.fixture(scope="module")
def read(stores: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Reading]:
    """What verbs printed of each locked copy; one process runs them all."""
    place = tmp_path_factory.mktemp("read")
    with archived(stores, place) as copies:
        before = {name: content(store) for name, store in copies.items()}
        commands = [
            command
            for name, store in copies.items()
            for command in (
                ("status", store, "--json"),
                ("data", store),
                ("history", store, "--last", 1, "--json"),
                ("explain", store, "last", "--json"),
                ("verify", store, "--json"),
                ("policy", store, "--json"),
                ("backup", store, "--out", place / f"{name}.db", "--json"),
                ("policy", store, "--alpha", "0.2"),
            )
        ]
        results = iter(dengine(*commands))
        return {
            name: Reading(list(islice(results, 8)), before[name], content(store))
            for name, store in copies.items()
        }


@pytest.fixture(scope="module")
def written(stores: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What became of a write to each locked copy."""
    with archived(stores, tmp_path_factory.mktemp("written")) as copies:
        lines = python("-c", WRITE, *map(str, copies.values())).splitlines()
        return dict(zip(copies, lines, strict=True))


def test_a_journal_that_may_not_be_read_makes_no_backup_and_verify_says_so(
    stores: dict[str, Path], tmp_path: Path
) -> None:
    store, journal = tmp_path / "engine.db", tmp_path / "engine.db.cell.journal"
    shutil.copy(stores["closed"] / "engine.db", store)
    journal.write_bytes(b"another user's")
    journal.chmod(0o000)
    verified, refused = dengine(
        ["verify", store, "--json"], ["backup", store, "--out", tmp_path / "copy.db"]
    )
    assert '"waiting": null' in verified["output"]
    assert refused["exit_code"] == 1
    assert "read it as the user that its cell runs as" in " ".join(refused["output"].split())
    assert not (tmp_path / "copy.db").exists()


@pytest.mark.parametrize("name", CASE_NAMES)
def test_what_only_reads_reads_it_and_leaves_it_as_it_is(
    name: str, read: dict[str, Reading]
) -> None:
    *results, refused = read[name].results
    assert all(result["exit_code"] == 0 for result in results), results
    status, data, newest, explained, verified, policy, copied = (
        result["output"] for result in results
    )
    assert '"decisions": 60' in status
    assert "60" in data
    (id_,) = [
        line.split('"')[3] for line in newest.splitlines() if line.strip().startswith('"id":')
    ]
    assert id_ in explained
    assert '"ok": true' in verified
    assert '"lower_bound"' in policy
    assert '"labels": 60' in copied
    if not name.startswith("a folder"):  # else SQLite brings the log into it
        assert read[name].after == read[name].before
    assert refused["exit_code"] == 1
    assert "writable" in refused["output"]
    assert not refused["unforeseen"]


@pytest.mark.parametrize("name", CASE_NAMES)
def test_a_write_to_it_is_refused_or_kept_and_never_lost(
    name: str, written: dict[str, str]
) -> None:
    assert written[name] == "1" or "writable" in written[name]
