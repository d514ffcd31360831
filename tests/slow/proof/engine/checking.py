"""One history, played and recounted: `check_history` returns a row of what was done and compared."""

import tempfile
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

from dengine.errors import StoreError

from .histories import CASES, History
from .ledger import Ledger
from .recount import Recount

Row = dict[str, Any]
# Of every 20 histories: 3 of each case of a single cell, 1 of each with several.
ORDER = [name for name, case in CASES.items() for _ in range(3 if case.n_cells == 1 else 1)]
COUNTS = (  # columns of a row, beside those of `describe`
    "decisions",
    "late reports",
    "second reports",
    "restarts",
    "killed",
    "rollbacks",
    "releases",
    "looks",
)


def check_history(name: str, seed: int) -> Row:
    """Play a history and compare everything with the recount.

    Parameters
    ----------
    name : str
        In `CASES`.
    seed : int

    Returns
    -------
    row : dict
        case, seed, how often what happened, comparisons, open (counts that were not compared, since
        a label lay at the very radius), faults (how many), and fault, the first one.
    """
    case = CASES[name]
    compared: Counter[str] = Counter()
    faults: list[str] = []

    def recount(history: History) -> Recount:
        ledger = Ledger(history.path, case.policy, history.diary.restarts)
        return Recount(case, seed, ledger, history.diary)

    def look(history: History, cell: int) -> None:
        history.engines[cell].flush()
        looked = recount(history)
        looked.check_look(history.engines[cell], cell, history.now)
        compared.update(looked.compared)
        faults.extend(f"look at {history.now:g}: {fault}" for fault in looked.faults)

    with (
        tempfile.TemporaryDirectory() as folder,
        History(case, seed, Path(folder), look) as history,
    ):
        try:
            history.play()
        except Exception as error:  # a restart changed something, or the engine failed
            faults.append(f"{type(error).__name__}: {error}"[:200])
        for engine in history.engines:
            with suppress(StoreError):  # of one that could not be opened again
                engine.flush()
        whole = recount(history)
        whole.check_all()
        compared.update(whole.compared)
        faults += whole.faults
        row = describe(name, seed, whole, history)
    n_open = compared.pop("counts at the radius, not compared", 0)
    return row | {
        "comparisons": compared.total(),
        "open": n_open,
        "faults": len(faults),
        "fault": faults[0] if faults else "",
    }


def describe(name: str, seed: int, recount: Recount, history: History) -> Row:
    """Return what happened in a history."""
    parts = recount.ledger.parts
    actions = Counter(part.row["action"] for part in parts)
    late_stops = [
        part
        for part in parts
        if part.is_confirmed_by_silence
        and part.value_at(recount.ledger.end) is False
        and part.next_decided < recount.ledger.end
    ]
    row: Row = {"case": name, "seed": seed}
    row |= {key: history.diary.counts.get(key, 0) for key in COUNTS}
    return row | {
        "accepted": actions["accept"],
        "rejected": actions["reject"],
        "audited": sum(part.row["audit"] for part in parts),
        "labels": sum(part.label is not None for part in parts),
        "late stops": sum(part.reported > part.next_decided for part in late_stops),
        "overdue": sum(
            part.row["action"] == "verify" and part.overdue < part.reported for part in parts
        ),
        "corrected": sum(
            moment_value[1] is not None for part in parts for moment_value in part.corrections
        ),
        "forgotten": sum(
            moment_value[1] is None for part in parts for moment_value in part.corrections
        ),
        "versions": len(recount.ledger.versions),
        "parts in safe mode": sum(part.row["reason"] == "safe_mode" for part in parts),
    }
