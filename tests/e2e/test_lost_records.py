"""Records that a journal lost after they were acknowledged: an alarm until it is acknowledged."""

import json
import os
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
Damage = Callable[[Path, Path], None]


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
    shutil.copytree(left, tmp_path, dirs_exist_ok=True)
    return tmp_path / "engine.db"


def marks(file: Path) -> list[int]:
    """Where the records begin that the store lacks: two of each part."""
    content = file.read_bytes()
    begins = [found.start() for found in re.finditer(re.escape(journal.MARK), content)]
    return begins[-2 * IN_JOURNAL :]


def cut(file: Path, head: Path) -> None:
    os.truncate(file, marks(file)[-5])


def zero_end(file: Path, head: Path) -> None:
    size = file.stat().st_size
    cut(file, head)
    os.truncate(file, size)


def cut_in_a_record(file: Path, head: Path) -> None:
    os.truncate(file, marks(file)[-5] + 30)


def flip_bits(file: Path, head: Path) -> None:
    content = bytearray(file.read_bytes())
    for begin in marks(file)[3:8]:
        content[begin + 40] ^= 1
    file.write_bytes(content)


def duplicate(file: Path, head: Path) -> None:
    content, begins = file.read_bytes(), marks(file)
    old = content[begins[8] : begins[13]]
    new = content[begins[6] : begins[8]]
    file.write_bytes(content.replace(old, new.ljust(len(old), b"\0")))


def empty(file: Path, head: Path) -> None:
    os.truncate(file, 0)


def delete(file: Path, head: Path) -> None:
    file.unlink()


def damage_header_and_cut(file: Path, head: Path) -> None:
    cut(file, head)
    content = file.read_bytes()
    file.write_bytes(content.replace(b"n_drained", b"n_drainee", 1))


@pytest.mark.parametrize(
    ("damage", "loss"),
    [
        (cut, "5 records"),
        (zero_end, "5 records"),
        (cut_in_a_record, "5 records"),
        (flip_bits, "5 records"),
        (duplicate, "5 records"),
        (empty, f"{2 * IN_JOURNAL} records"),
        (delete, f"{2 * IN_JOURNAL} records"),
        (damage_header_and_cut, "not as it was written"),
    ],
)
def test_records_that_a_journal_lost_are_an_alarm_until_somebody_acknowledges_it(
    store: Path, damage: Damage, loss: str
) -> None:
    damage(Path(f"{store}.cell.journal"), Path(f"{store}.cell.journal.head"))
    if Path(f"{store}.cell.journal").exists():  # before an engine has opened it
        (fault,) = verify_history(str(store)).faults
        assert loss in fault.problem
    for _ in range(2):  # it lasts over a restart
        with DataEngine.open(str(store)) as engine:
            alarm = engine.status().alarm
            assert loss in alarm
            assert "UTC" in alarm
            assert "dengine verify STORE --acknowledge" in alarm
    (fault,) = verify_history(str(store)).faults
    assert (fault.table, loss in fault.problem) == ("event", True)
    assert dengine("verify", store).exit_code == 1
    assert document("verify", store, "--acknowledge", "--author", "Kim")["ok"]
    with DataEngine.open(str(store)) as engine:
        assert engine.status().alarm == ""
        assert engine.store.events.newest(1)[-1].author == "Kim"


def swap(file: Path, head: Path) -> None:
    """Two decisions change their places."""
    content, begins = file.read_bytes(), marks(file)
    first, between, second = (content[begins[i] : begins[j]] for i, j in ((4, 5), (5, 8), (8, 9)))
    file.write_bytes(content.replace(first + between + second, second + between + first))


def damage_header(file: Path, head: Path) -> None:
    file.write_bytes(file.read_bytes().replace(b"drained", b"drainee", 1))


@pytest.mark.parametrize("damage", [swap, damage_header])
def test_damage_by_which_no_record_is_lost_is_an_alarm_too(store: Path, damage: Damage) -> None:
    damage(Path(f"{store}.cell.journal"), Path(f"{store}.cell.journal.head"))
    with DataEngine.open(str(store)) as engine:
        status = engine.status()
        assert "not as it was written" in status.alarm
        assert status.labels == IN_STORE + IN_JOURNAL


def nothing(file: Path, head: Path) -> None:
    pass


def older_head(file: Path, head: Path) -> None:
    shutil.copy(f"{head}.old", head)


def no_head(file: Path, head: Path) -> None:
    head.unlink()


def damaged_head(file: Path, head: Path) -> None:
    head.write_bytes(head.read_bytes().replace(b'"n_synced":', b'"n_synced":9'))


def unfinished_record(file: Path, head: Path) -> None:
    """What a process was writing as it was killed."""
    written = file.read_bytes().rstrip(b"\0")
    file.write_bytes(written + journal.MARK + b"\x20\0\0\0 half of a rec")


def of_an_earlier_release(file: Path, head: Path) -> None:
    """Header and head have no numbers and no checksums."""
    content = file.read_bytes()
    end = len(journal.MAGIC)
    fields = journal._unpack_fields(content[end : journal.HEADER])
    fields = {name: fields[name] for name in ("owner", "drained", "newest")}
    header = content[:end] + json.dumps(fields).encode()
    file.write_bytes(header.ljust(journal.HEADER, b"\0") + content[journal.HEADER :])
    head.write_bytes(json.dumps(fields["newest"]).ljust(256).encode())


@pytest.mark.parametrize(
    "change", [nothing, older_head, no_head, damaged_head, unfinished_record, of_an_earlier_release]
)
def test_what_a_killed_process_or_an_earlier_release_left_is_no_alarm(
    store: Path, change: Damage
) -> None:
    change(Path(f"{store}.cell.journal"), Path(f"{store}.cell.journal.head"))
    assert verify_history(str(store)).ok
    for _ in range(2):
        with DataEngine.open(str(store)) as engine:
            status = engine.status()
            assert (status.alarm, status.labels) == ("", IN_STORE + IN_JOURNAL)
    assert verify_history(str(store)).ok
