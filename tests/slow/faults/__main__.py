"""Fault by fault: what is lost, what is decided wrongly, what reaches the cell, and how long it waits.

    python -m tests.slow.faults --trials 3 --kills 20
    . .ci/postgres.sh && python -m tests.slow.faults --kills 200 --others 100 --postgres "$DENGINE_TEST_POSTGRES"

--program names a built dengine-cell, whose journal is then tried too (`dengine export --cpp`). A trial of a fault plays a
cell before, in and after it, opens the store again, and compares labels with what was acknowledged and decisions with those
of the engine before. Exit code 1 if anything was lost, decided otherwise, or raised.
"""

from __future__ import annotations

import argparse
import logging
import shutil
import sys
import tempfile
import uuid
from collections.abc import Callable
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.table import Table

from . import kills
from .harness import Outcome, Place
from .kinds import ON_DISKS, ON_POSTGRES, ON_SQLITE

Fault = Callable[[Outcome, Place], None]


def title(fault: Fault) -> str:
    """A fault in words: its docstring's first sentence."""
    return (fault.__doc__ or "").split(".")[0].split(":")[0]


def tried(fault: Fault, place: Callable[[], Place], trials: int, console: Console) -> Outcome:
    """Inject a fault so often, each time in a place of its own."""
    outcome = Outcome()
    for _ in range(trials):
        try:
            fault(outcome, place())
        except Exception as error:  # the trial itself ended: that is counted, and the next fault is tried
            outcome.tell(error)
    for text in outcome.told[:3]:
        console.print(f"  {text}", style="red", highlight=False)
    return outcome


def faults(arguments: argparse.Namespace) -> list[tuple[str, str, Fault, int]]:
    """Where, what in words, the fault, and how many trials."""
    found = [("SQLite", title(each), each, arguments.trials) for each in (*ON_SQLITE, *ON_DISKS)]
    killed = {
        "SIGKILL of the cell": partial(kills.kill_cells, times=arguments.kills),
        "SIGKILL, mostly as a version is stored": partial(kills.kill_cells, times=arguments.others, child=kills.often),
        "SIGKILL while the store is locked": partial(kills.kill_cells, times=arguments.others, child=kills.in_outage),
        "SIGKILL of an import": partial(kills.kill_imports, times=arguments.others),
        "SIGKILL of an export": partial(kills.kill_exports, times=arguments.others),
    }
    if arguments.program is not None:
        programs = partial(kills.kill_programs, times=arguments.others, program=arguments.program)
        killed["SIGKILL of the C++ program"] = programs
    found += [("SQLite", words, fault, 1) for words, fault in killed.items()]
    if arguments.postgres:
        found += [("PostgreSQL", title(each), each, arguments.trials) for each in ON_POSTGRES]
        found.append(("PostgreSQL", "SIGKILL of the cell", killed["SIGKILL of the cell"], 1))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=3, help="of each fault but the kills")
    parser.add_argument("--kills", type=int, default=20, help="of the cell")
    parser.add_argument(
        "--others", type=int, default=10, help="of a version's commit, an outage, imports, exports, programs"
    )
    parser.add_argument("--postgres", default="", metavar="URL", help="a server on which cells may be made")
    parser.add_argument("--program", type=Path, help="a built dengine-cell")
    parser.add_argument("--only", default="", help="faults whose words hold this")
    parser.add_argument("--out", type=Path, help="write the table there, as Markdown")
    arguments = parser.parse_args()
    logging.disable(logging.CRITICAL)  # faults are what is asked for here
    console, folder = Console(), Path(tempfile.mkdtemp(prefix="dengine-faults-"))
    columns = ("store", "fault", "times", "labels", "lost", "wrong", "raised", "longest wait")
    rows = []
    for where, words, fault, trials in faults(arguments):
        if arguments.only not in words:
            continue
        url = arguments.postgres if where == "PostgreSQL" else ""
        console.print(f"{where}: {words}", highlight=False)

        def place(url: str = url) -> Place:
            name = uuid.uuid4().hex[:12]
            return Place(url, name) if url else Place(str(folder / f"{name}.db"))

        seen = tried(fault, place, trials, console)
        counts = (seen.injected, seen.labels, seen.lost, seen.wrong, seen.raised)
        rows.append((where, words, *map(str, counts), f"{1000 * seen.longest:.0f} ms" if seen.longest else "-"))
    shutil.rmtree(folder)
    table = Table(*columns)
    for row in rows:
        table.add_row(*row)
    console.print(table)
    if arguments.out is not None:
        lines = ["| " + " | ".join(row) + " |" for row in (columns, ["---"] * len(columns), *rows)]
        arguments.out.write_text("\n".join(lines) + "\n", encoding="utf-8")
    sys.exit(any(row[4:7] != ("0", "0", "0") for row in rows))


if __name__ == "__main__":
    main()
