r"""Fault by fault: what is lost, what is decided wrongly, what reaches the cell, how long it waits.

    python -m tests.slow.faults --trials 3 --kills 20
    . .ci/postgres.sh
    python -m tests.slow.faults --kills 200 --others 200 --ids 1000000 \
        --postgres "$DENGINE_TEST_POSTGRES"
    python -m tests.slow.faults --mutations

--program names a built dengine-cell, whose journal is then tried too (`dengine export --cpp`). A
trial of a fault plays a cell before, in and after it, opens the store again, and compares labels
with what was acknowledged and decisions with those of the engine before. Exit code 1 if anything
was lost, decided otherwise, or raised, or a call took over two seconds. --mutations breaks dengine
in each of `MUTATIONS`' ways in a copy of the tree, where the row that it names must fail.
"""

import argparse
import logging
import os
import shutil
import subprocess
import sys
import tempfile
import uuid
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from rich.console import Console

from tests.support.faults import copied

from . import kills
from .harness import WAIT, Outcome, Place
from .kinds import ON_DISKS, ON_POSTGRES, ON_SQLITE, SYNC, asked_again

Fault = Callable[[Outcome, Place], None]
COUNTS = ["times", "labels", "lost", "wrong", "raised"]
COLUMNS = ["store", "fault", *COUNTS, "longest wait in ms"]
STORE, ENGINE = "dengine/store/", "dengine/engine/"
MUTATIONS = (  # what is broken, the file, a text that stands there once, what then stands there, the row that fails
    ("nothing is synced", STORE + "journal.py", "            self._file.sync()\n", "", "A disk whose syncs fail"),
    ("a lost journal is not noticed", STORE + "journal.py", "if not self._file.in_place():", "if False:",
     "The journal deleted"),
    ("two engines may share a journal", STORE + "owned_file.py", "fcntl.LOCK_EX |", "fcntl.LOCK_SH |",
     "A second engine"),
    ("a sync may take ten seconds", STORE + "recording.py", "self.limit if seconds is None else seconds", "10.0",
     "A disk whose syncs hang"),
    ("labels are acknowledged at once", ENGINE + "engine.py", "            self._outbox.sync()  # before anything else",
     "            #", "A disk whose syncs fail"),
    ("what is written in part is taken for whole", STORE + "owned_file.py", "< len(content):", "< 0:",
     "The journal deleted while the store is away, on"),
    ("older labels are not checked", ENGINE + "learner.py", "check_integrity(0)", "check_integrity()", "A label older"),
    ("a link is another store", STORE + "journal.py", "database)).resolve()", "database)).absolute()", "A second engine"),
    ("what is in the journal is forgotten", STORE + "journalled.py", "self.store.apply_records(records)", "pass",
     "SIGKILL while the store is locked"),
    ("an id that cannot be looked up is new", STORE + "journalled.py", "return None if self._index.is_new(decision_id) else",
     "return None if self._index.is_new(decision_id) or self._drainer.fault else", "Ids asked for again"),
    ("what is in force is not checked", STORE + "ledger.py", "if chain == chained else", "if chain else",
     "A setting"),
    ("a deleted store is not noticed", STORE + "connections.py", "        if self._file is None:",
     "        if self._file:", "The store's file deleted"),
    ("any ledger holds any entry", STORE + "connections.py", "== [digest]", "!= [None]", "The store's file put back"),
    ("a fork may decide", STORE + "outbox.py", "        if os.getpid() != self._pid:\n", "        if False:\n",
     "A fork of the engine's process"),
    ("the newest version is the latest by the clock", STORE + "versions.py", ".order_by(VERSION.c.retrain.desc())",
     ".order_by(VERSION.c.time.desc())", "The clock set back"),
)  # fmt: skip


def title(fault: Fault) -> str:
    """A fault in words: its docstring's first sentence."""
    return (fault.__doc__ or "").split(".")[0].split(":")[0]


def faults(
    trials: int, kills_: int, others: int, program: Path | None = None, ids: int = 2000
) -> list[tuple[str, str, Fault, int]]:
    """Where, what in words, the fault, and how many trials."""
    killed = {
        "SIGKILL of the cell": partial(kills.kill_cells, times=kills_),
        "SIGKILL of the served cell": partial(kills.kill_cells, times=kills_, child=kills.serving),
        "SIGKILL, mostly as a version is stored": partial(
            kills.kill_cells, times=others, child=kills.often
        ),
        "SIGKILL while the store is locked": partial(
            kills.kill_cells, times=others, child=kills.in_outage
        ),
        "SIGKILL, and the write-ahead log cut or removed": partial(
            kills.kill_cells, times=others, damage=kills.cut_wal
        ),
        "SIGKILL while the store is locked, and a bit of the journal flipped": partial(
            kills.kill_cells, times=others, child=kills.in_outage, damage=kills.flip_journal
        ),
        "SIGKILL of an import": partial(kills.kill_imports, times=others),
        "SIGKILL of an export": partial(kills.kill_exports, times=others),
    }
    if program is not None:
        killed["SIGKILL of the C++ program"] = partial(
            kills.kill_programs, times=others, program=program
        )
    results = [("SQLite", title(fault), fault, trials) for fault in (*ON_SQLITE, *ON_DISKS)]
    results += [
        (
            "SQLite",
            f"{title(asked_again)}: {ids:,} others in the store",
            partial(asked_again, stored=ids),
            1,
        )
    ]
    results += [("SQLite", words, fault, 1) for words, fault in killed.items()]
    results += [("PostgreSQL", title(fault), fault, trials) for fault in ON_POSTGRES]
    return [
        *results,
        *(("PostgreSQL", words, fault, 1) for words, fault in list(killed.items())[:2]),
    ]


def preloaded() -> dict[str, str]:
    """Build a library that stands between a program and its disk, which hangs or fails when a file
    says so; return the environment of a program that has it.
    """
    folder = Path(tempfile.mkdtemp(prefix="dengine-faults-"))
    source = Path(__file__).with_name("sync.c")
    subprocess.run(
        ["gcc", "-shared", "-fPIC", "-o", folder / "sync.so", source, "-ldl"], check=True
    )
    return os.environ | {
        "LD_PRELOAD": str(folder / "sync.so"),
        "DENGINE_SYNC": str(folder / "sync"),
    }


def tried(fault: Fault, place: Callable[[], Place], trials: int, console: Console) -> Outcome:
    """Inject a fault so often, each time in a place of its own."""
    outcome = Outcome()
    for _ in range(trials):
        try:
            fault(outcome, place())
        except (
            Exception
        ) as error:  # the trial itself ended: that is counted, and the next fault is tried
            outcome.tell(error)
    for text in outcome.told[:3]:
        console.print(f"  {text}", style="red", highlight=False)
    return outcome


def totals(kinds: pd.DataFrame) -> pd.DataFrame:
    """Return sums of the counts per store, over faults by SIGKILL and over the other faults.

    The column `kinds` is the number of kinds of fault in each sum.
    """
    what = np.where(kinds["fault"].str.startswith("SIGKILL"), "SIGKILL", "store, disk or process")
    groups = kinds.groupby(["store", what], sort=False)
    return groups[COUNTS].sum().assign(kinds=groups.size())


def mutated() -> bool:
    """Whether each of the `MUTATIONS` makes its row fail."""
    caught = []
    for name, file, before, after, row in MUTATIONS:
        with tempfile.TemporaryDirectory(prefix="dengine-mutation-") as folder:
            tree = copied(Path(folder))
            text = (tree / file).read_text(encoding="utf-8")
            (tree / file).write_text(text.replace(before, after), encoding="utf-8")
            command = [
                sys.executable,
                "-m",
                "tests.slow.faults",
                "--trials",
                "1",
                "--others",
                "5",
                "--only",
                row,
            ]
            around = os.environ | {"PYTHONPATH": folder}
            done = subprocess.run(
                command, cwd=tree, env=around, capture_output=True, text=True, check=False
            )
        rows = [line for line in done.stdout.splitlines() if line.startswith(f"| SQLite | {row}")]
        caught.append(
            text.count(before) == 1
            and any(line.split(" | ")[4:7] != ["0", "0", "0"] for line in rows)
        )
        print(
            "|",
            name,
            "|",
            *(rows or [done.stderr[-300:]]),
            "" if caught[-1] else "MISSED",
            flush=True,
        )
    return all(caught)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=3, help="of each fault but the kills")
    parser.add_argument("--kills", type=int, default=20, help="of the cell")
    parser.add_argument(
        "--others",
        type=int,
        default=10,
        help="of a version's commit, an outage, imports, exports, programs",
    )
    parser.add_argument(
        "--postgres", default="", metavar="URL", help="a server on which cells may be made"
    )
    parser.add_argument(
        "--ids", type=int, default=2000, help="in a store that is away as others are asked for"
    )
    parser.add_argument(
        "--mutations", action="store_true", help="show that rows can fail, and nothing else"
    )
    parser.add_argument("--program", type=Path, help="a built dengine-cell")
    parser.add_argument("--only", default="", help="faults whose words hold this")
    parser.add_argument("--out", type=Path, help="write the table there, as CSV")
    arguments = parser.parse_args()
    if arguments.mutations:
        sys.exit(not mutated())
    if "DENGINE_SYNC" not in os.environ:
        os.execve(
            sys.executable, [sys.executable, "-m", "tests.slow.faults", *sys.argv[1:]], preloaded()
        )
    logging.disable(logging.CRITICAL)  # faults are what is asked for here
    console, folder = Console(), SYNC.parent
    rows = []
    os.environ["XDG_STATE_HOME"] = str(
        folder / "state"
    )  # where PostgreSQL's cells have their journals
    how = arguments.trials, arguments.kills, arguments.others, arguments.program, arguments.ids
    for where, words, fault, trials in faults(*how):
        url = arguments.postgres if where == "PostgreSQL" else ""
        if arguments.only not in words or (where == "PostgreSQL" and not url):
            continue
        console.print(f"{where}: {words}", highlight=False)

        def place(url: str = url) -> Place:
            name = uuid.uuid4().hex[:12]
            return Place(url, name) if url else Place(str(folder / f"{name}.db"))

        seen = tried(fault, place, trials, console)
        if seen.versions:
            console.print(f"  {seen.versions} versions were swapped in", highlight=False)
        seen.must(seen.longest < 2 * WAIT, f"a call took {seen.longest:.1f} s")
        counts = (seen.injected, seen.labels, seen.lost, seen.wrong, seen.raised)
        rows.append((where, words, *counts, f"{1000 * seen.longest:.0f}" if seen.longest else ""))
        print("| " + " | ".join(map(str, rows[-1])) + " |", flush=True)
        kinds = pd.DataFrame(rows, columns=COLUMNS)
        if arguments.out is not None:
            kinds.to_csv(arguments.out, index=False)
    if rows:
        print(totals(kinds).to_string())
    shutil.rmtree(folder)
    sys.exit(not rows or any(row[4:7] != (0, 0, 0) for row in rows))


if __name__ == "__main__":
    main()
