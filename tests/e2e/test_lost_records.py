"""Records that a journal lost after they were acknowledged: an alarm until it is acknowledged."""

import re
import shutil
from pathlib import Path

import pytest

from dengine import DataEngine
from dengine.store import journal
from dengine.store.verification import verify_history
from tests.support.command_line import dengine, document
from tests.support.driving import learn
from tests.support.stores import held

IN_STORE, IN_JOURNAL = 6, 10  # parts


@pytest.fixture(scope="module")
def left(data, tmp_path_factory):
    """What a killed process leaves whose newest labels are in its journal alone.

    Beside it is `engine.db.cell.journal.head.old`, the head before the newest labels.
    """
    folder, left = tmp_path_factory.mktemp("running"), tmp_path_factory.mktemp("left")
    store = folder / "engine.db"
    with DataEngine("pca", retrain_every=1000, store=store) as engine:
        learn(engine, data, range(IN_STORE))
        engine.flush()
        with held(store):
            learn(engine, data, range(IN_STORE, IN_STORE + 5))
            shutil.copy(f"{store}.cell.journal.head", left / "engine.db.cell.journal.head.old")
            learn(engine, data, range(IN_STORE + 5, IN_STORE + IN_JOURNAL))
            shutil.copytree(folder, left, dirs_exist_ok=True)
    return left


@pytest.fixture
def store(left, tmp_path):
    """A copy of what a killed process left."""
    return f"{shutil.copytree(left, tmp_path / 'cell')}/engine.db"


ALL = f"{2 * IN_JOURNAL} records"
DAMAGES = {
    "cut": "5 records",
    "zeros at the end": "5 records",
    "cut in a record": "5 records",
    "flipped bits": "5 records",
    "records twice": "5 records",
    "empty": ALL,
    "header, and cut": "not as it was written",
    # By these no record is lost.
    "swapped": "not as it was written",
    "header": "not as it was written",
    "infinite header": "not as it was written",
    "deleted": ALL,
}


def damaged(kind: str, content: bytes) -> bytes:
    """A journal with a damage."""
    begins = [found.start() for found in re.finditer(re.escape(journal.MARK), content)]
    at = begins[-2 * IN_JOURNAL :]  # the records that the store lacks: two of each part
    cut = content[: at[-5]]
    if kind == "flipped bits":
        flipped = bytearray(content)
        for begin in at[3:8]:
            flipped[begin + 40] ^= 1
        return bytes(flipped)
    if kind == "records twice":  # two stand in the place of five others, too
        old, twice = content[at[8] : at[13]], content[at[6] : at[8]]
        return content.replace(old, twice.ljust(len(old), b"\0"))
    if kind == "swapped":  # two decisions change their places
        first, between, second = (content[at[i] : at[j]] for i, j in ((4, 5), (5, 8), (8, 9)))
        return content.replace(first + between + second, second + between + first)
    if kind == "cut in a record":
        return content[: at[-5] + 30]
    if kind == "zeros at the end":
        return cut.ljust(len(content), b"\0")
    if kind == "infinite header":  # without a checksum, as earlier releases wrote it
        return b'dengine journal 2\n{"newest": null, "drained": 1e999}'.ljust(256) + content[256:]
    if kind == "empty":
        return b""
    return (content if kind == "header" else cut).replace(b"drained", b"drainee", "header" in kind)


@pytest.mark.parametrize("kind", DAMAGES)
def test_records_that_a_journal_lost_are_an_alarm_until_somebody_acknowledges_it(store, kind):
    loss, file = DAMAGES[kind], Path(f"{store}.cell.journal")
    if kind == "deleted":
        file.unlink()
    else:
        file.write_bytes(damaged(kind, file.read_bytes()))
        (fault,) = verify_history(store).faults  # before an engine has opened it
        assert loss in fault.problem
    for _ in range(2):  # it lasts over a restart
        with DataEngine.open(store) as engine:
            status = engine.status()
            for words in (loss, "UTC", "dengine verify STORE --acknowledge"):
                assert words in status.alarm
            assert kind not in ("swapped", "header") or status.labels == IN_STORE + IN_JOURNAL
    (fault,) = verify_history(store).faults
    assert fault.table == "event"
    assert loss in fault.problem
    assert dengine("verify", store).exit_code == 1
    assert document("verify", store, "--acknowledge", "--author", "Kim")["ok"]
    with DataEngine.open(store) as engine:
        assert engine.status().alarm == ""
        assert engine.store.events.newest(1)[-1].author == "Kim"


@pytest.mark.parametrize(
    "kind", ["nothing", "an older head", "no head", "a damaged head", "a half"]
)
def test_what_a_killed_process_left_is_no_alarm(store, kind):
    file, head = Path(f"{store}.cell.journal"), Path(f"{store}.cell.journal.head")
    if kind == "an older head":
        shutil.copy(f"{head}.old", head)
    elif kind == "no head":
        head.unlink()
    elif kind == "a damaged head":
        head.write_bytes(head.read_bytes().replace(b'"n_synced":', b'"n_synced":9'))
    elif kind == "a half":  # of a record that was being written
        half = journal.MARK + b"\x20\0\0\0 half of a rec"
        file.write_bytes(file.read_bytes().rstrip(b"\0") + half)
    assert verify_history(store).ok
    for _ in range(2):
        with DataEngine.open(store) as engine:
            status = engine.status()
            assert (status.alarm, status.labels) == ("", IN_STORE + IN_JOURNAL)
    assert verify_history(store).ok
