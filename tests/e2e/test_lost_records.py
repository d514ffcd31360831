"""Records that a journal lost after they were acknowledged: an alarm until it is acknowledged."""

import json
import re
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from dengine import DataEngine, Dataset
from dengine.store import journal
from dengine.store.verification import verify_history
from tests.support.command_line import dengine, document
from tests.support.driving import learn

IN_STORE, IN_JOURNAL = 6, 10  # parts


@pytest.fixture(scope="module")
def left(data: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a killed process leaves whose newest labels are in its journal alone.

    Beside it is `engine.db.cell.journal.head.old`, the head before the newest labels.
    """
    folder, left = tmp_path_factory.mktemp("running"), tmp_path_factory.mktemp("left")
    store = folder / "engine.db"
    with DataEngine("pca", retrain_every=1000, store=str(store)) as engine:
        learn(engine, data, range(IN_STORE))
        engine.store.flush()
        with closing(sqlite3.connect(store, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            learn(engine, data, range(IN_STORE, IN_STORE + IN_JOURNAL // 2))
            shutil.copy(f"{store}.cell.journal.head", left / "engine.db.cell.journal.head.old")
            learn(engine, data, range(IN_STORE + IN_JOURNAL // 2, IN_STORE + IN_JOURNAL))
            for file in folder.iterdir():
                shutil.copy(file, left)
            other.execute("ROLLBACK")
    return left


@pytest.fixture
def store(left: Path, tmp_path: Path) -> Path:
    """A copy of what a killed process left."""
    return Path(shutil.copytree(left, tmp_path / "cell")) / "engine.db"


# A journal from its content, and where the records begin that the store lacks: two of each part.
Damage = Callable[[bytes, list[int]], bytes]


def flip_bits(content: bytes, at: list[int]) -> bytes:
    changed = bytearray(content)
    for begin in at[3:8]:
        changed[begin + 40] ^= 1
    return bytes(changed)


def duplicate(content: bytes, at: list[int]) -> bytes:
    """Two records stand in the place of five others, too."""
    old, twice = content[at[8] : at[13]], content[at[6] : at[8]]
    return content.replace(old, twice.ljust(len(old), b"\0"))


def swap(content: bytes, at: list[int]) -> bytes:
    """Two decisions change their places."""
    first, between, second = (content[at[i] : at[j]] for i, j in ((4, 5), (5, 8), (8, 9)))
    return content.replace(first + between + second, second + between + first)


ALL = f"{2 * IN_JOURNAL} records"
DAMAGES: dict[str, tuple[Damage, str]] = {
    "cut": (lambda content, at: content[: at[-5]], "5 records"),
    "zeros at the end": (
        lambda content, at: content[: at[-5]].ljust(len(content), b"\0"),
        "5 records",
    ),
    "cut in a record": (lambda content, at: content[: at[-5] + 30], "5 records"),
    "flipped bits": (flip_bits, "5 records"),
    "records twice": (duplicate, "5 records"),
    "empty": (lambda content, at: b"", ALL),
    "header, and cut": (
        lambda content, at: content[: at[-5]].replace(b"n_drained", b"n_drainee", 1),
        "not as it was written",
    ),
    # By these no record is lost.
    "swapped": (swap, "not as it was written"),
    "header": (
        lambda content, at: content.replace(b"drained", b"drainee", 1),
        "not as it was written",
    ),
    "deleted": (None, ALL),
}


@pytest.mark.parametrize("kind", DAMAGES)
def test_records_that_a_journal_lost_are_an_alarm_until_somebody_acknowledges_it(
    store: Path, kind: str
) -> None:
    damage, loss = DAMAGES[kind]
    file = Path(f"{store}.cell.journal")
    content = file.read_bytes()
    at = [found.start() for found in re.finditer(re.escape(journal.MARK), content)]
    if damage is None:
        file.unlink()
    else:
        file.write_bytes(damage(content, at[-2 * IN_JOURNAL :]))
        (fault,) = verify_history(str(store)).faults  # before an engine has opened it
        assert loss in fault.problem
    for _ in range(2):  # it lasts over a restart
        with DataEngine.open(store) as engine:
            status = engine.status()
            assert all(
                words in status.alarm
                for words in (loss, "UTC", "dengine verify STORE --acknowledge")
            )
            assert kind not in ("swapped", "header") or status.labels == IN_STORE + IN_JOURNAL
    (fault,) = verify_history(str(store)).faults
    assert (fault.table, loss in fault.problem) == ("event", True)
    assert dengine("verify", store).exit_code == 1
    assert document("verify", store, "--acknowledge", "--author", "Kim")["ok"]
    with DataEngine.open(store) as engine:
        assert engine.status().alarm == ""
        assert engine.store.events.newest(1)[-1].author == "Kim"


def of_an_earlier_release(file: Path, head: Path) -> None:
    """Header and head have no numbers and no checksums."""
    content = file.read_bytes()
    end = len(journal.MAGIC)
    fields = journal._unpack_fields(content[end : journal.HEADER])
    fields = {name: fields[name] for name in ("owner", "drained", "newest")}
    header = content[:end] + json.dumps(fields).encode()
    file.write_bytes(header.ljust(journal.HEADER, b"\0") + content[journal.HEADER :])
    head.write_bytes(json.dumps(fields["newest"]).ljust(256).encode())


CHANGES: dict[str, Callable[[Path, Path], object]] = {
    "nothing": lambda file, head: None,
    "an older head": lambda file, head: shutil.copy(f"{head}.old", head),
    "no head": lambda file, head: head.unlink(),
    "a damaged head": lambda file, head: head.write_bytes(
        head.read_bytes().replace(b'"n_synced":', b'"n_synced":9')
    ),
    "a record that a process was writing as it was killed": lambda file, head: file.write_bytes(
        file.read_bytes().rstrip(b"\0") + journal.MARK + b"\x20\0\0\0 half of a rec"
    ),
    "what an earlier release wrote": of_an_earlier_release,
}


@pytest.mark.parametrize("kind", CHANGES)
def test_what_a_killed_process_or_an_earlier_release_left_is_no_alarm(
    store: Path, kind: str
) -> None:
    CHANGES[kind](Path(f"{store}.cell.journal"), Path(f"{store}.cell.journal.head"))
    assert verify_history(str(store)).ok
    for _ in range(2):
        with DataEngine.open(store) as engine:
            status = engine.status()
            assert (status.alarm, status.labels) == ("", IN_STORE + IN_JOURNAL)
    assert verify_history(str(store)).ok
