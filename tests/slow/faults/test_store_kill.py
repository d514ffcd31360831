"""A process that decides and reports is killed with SIGKILL at random moments; what it was promised must be there.

This proves safety against a crashed process. It says nothing about lost power: the operating system lives on and
writes what the process had handed it. For that, the store relies on SQLite's synchronous=FULL and an honest disk.
"""

import random
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from dengine.store import SqlStore

CHILD = """
import sys, uuid
import numpy as np
from dengine.records import Action, Decision, Reason, Source
from dengine.store import SqlStore

store = SqlStore(sys.argv[1])
while True:
    ids = [uuid.uuid4().hex for _ in range(3)]
    for name in ids:
        trace = np.full((1, 1000), int(name[:4], 16), dtype=np.float32)
        d = Decision(name, Action.VERIFY, Action.VERIFY, 0.0, 1.0, 0, 0, None, 0, Reason.NO_MODEL, False, 1.0)
        store.put_decision(d, trace, int(name[:8], 16), False)
    seq = store.put_label(ids[1], True, Source.VERIFICATION, 0, None)
    print(seq, ids[1], flush=True)
"""


def promised_until_killed(file: Path, seconds: float) -> list[tuple[int, str]]:
    """Run the child for `seconds` after its first report; return the reports it heard back from."""
    child = subprocess.Popen([sys.executable, "-c", CHILD, str(file)], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    with child.stdout as heard:
        first = heard.readline()
        time.sleep(seconds)
        child.kill()
        text = first + heard.read()
    assert child.wait() == -signal.SIGKILL
    whole = text[: text.rfind("\n") + 1]  # the last line may have been cut off
    return [(int(line.split()[0]), line.split()[1]) for line in whole.splitlines()]


def test_every_label_whose_report_returned_survives_sigkill(tmp_path: Path) -> None:
    file, rng, promised = tmp_path / "engine.db", random.Random(0), []
    for _ in range(6):
        promised += promised_until_killed(file, rng.uniform(0.0, 0.4))
        with sqlite3.connect(file) as connection:
            assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        check_kept(file, promised)
    assert len(promised) >= 6


def check_kept(file: Path, promised: list[tuple[int, str]]) -> None:
    with SqlStore(str(file)) as store:
        labelled = store.labelled()
        assert labelled.seq.tolist() == list(range(1, len(labelled.seq) + 1))
        kept = dict(zip(labelled.seq.tolist(), labelled.hashes.tolist(), strict=True))
        for seq, name in promised:
            assert kept[seq] == int(name[:8], 16)
            found = store.get_decision(name)
            assert found is not None
            assert found.success is True
            np.testing.assert_array_equal(found.trace, np.full((1, 1000), int(name[:4], 16), dtype=np.float32))
