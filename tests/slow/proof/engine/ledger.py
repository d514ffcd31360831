"""What a store holds, read by plain SQL: `Ledger`, with a `Part` for each decision.

    >>> ledger = Ledger(Path("engine.db"), case.policy, diary.restarts)
    >>> ledger.parts[0].value_at(ledger.end)

Moments are `Moment`s: the time of a call by the clock of the store, and where in the call. A
decision first confirms earlier parts, then decides, then checks become overdue. A report or a
correction is known when its call is over.

What is documented of outcomes is written here once more, see `docs/explanation/promise.md`:

- With `stops="all"` the next decision of the cell confirms an accepted part that nobody reported. A
  line stop that comes later takes this back.
- A check that was not reported within `label_within` later decisions counts as wrong until it is.
- A corrected label counts as corrected, a forgotten one nowhere.
- A part with a constant trace teaches nothing. A rejected part that was inspected teaches the
  model, and not the rule.
"""

import itertools
import json
import sqlite3
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dengine import Policy

Moment = tuple[float, int]
Row = dict[str, Any]  # of a table
CONFIRMED, DECIDED, OVERDUE, TOLD = range(4)  # where in a call
NEVER: Moment = (float("inf"), TOLD)
Floats = NDArray[np.float64]


@dataclass
class Part:
    """A decision with all that is stored of it.

    Attributes
    ----------
    cell : int
    row : dict
        Of the table `decision`.
    trace : array of float64, shape (T,)
    decided : Moment
    next_decided : Moment
        When the cell's next decision began; NEVER for the newest one.
    gone_on : Moment
        When it was clear that an accepted part went on: with the next decision, or a restart.
    overdue : Moment
        When its check would be overdue.
    is_confirmed_by_silence : bool
        Whether the next decision confirms it if nobody reported it until then.
    label : dict or None
        Of the table `label`.
    corrections : list of (Moment, bool or None)
        Oldest first; None: forgotten.
    """

    cell: int
    row: Row
    trace: Floats
    decided: Moment
    is_confirmed_by_silence: bool
    next_decided: Moment = NEVER
    gone_on: Moment = NEVER
    overdue: Moment = NEVER
    label: Row | None = None
    corrections: list[tuple[Moment, bool | None]] = field(default_factory=list)

    @property
    def reported(self) -> Moment:
        """When its label was stored; NEVER without one."""
        return NEVER if self.label is None else (self.label["time"], TOLD)

    def learned(self, at: Moment) -> Moment:
        """Return when the outcome that counts at a moment was learned; NEVER if there is none.

        The next decision confirms a part before it is itself decided.
        """
        if self.is_confirmed_by_silence and self.next_decided < at:
            return min(self.next_decided, self.reported)
        return self.reported if self.reported < at else NEVER

    def value_at(self, at: Moment) -> bool | None:
        """Return the label that counts just before a moment; None without one, or if forgotten."""
        if self.learned(at) == NEVER:
            return None
        value: bool | None = True
        if self.label is not None and self.reported < at:
            value = bool(self.label["success"])
        for moment, corrected in self.corrections:
            if moment < at:
                value = corrected
        return value

    def is_forgotten(self, at: Moment) -> bool:
        """Return whether it had a label that is forgotten at a moment."""
        return self.learned(at) != NEVER and self.value_at(at) is None

    @property
    def teaches(self) -> bool:
        """Whether its trace has no fault."""
        return not self.row["quarantined"]


class Ledger:
    """All parts, versions and events of a store.

    Parameters
    ----------
    path : Path
    policy : Policy
    restarts : list of (float, int)
        Time and cell of each restart.

    Attributes
    ----------
    parts : list of Part
        Of all cells, by cell and number.
    versions : list of dict
        Rows of the accepted versions, by number, with `arrays`, their states.
    events : dict of (str, int) to dict
        Data of each rollback and release, by kind and the version that it made.
    end : Moment
        After everything.
    """

    end: Moment = (float("inf"), CONFIRMED)

    def __init__(self, path: Path, policy: Policy, restarts: list[tuple[float, int]]) -> None:
        with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as connection:
            connection.row_factory = sqlite3.Row

            def read(table: str, order: str) -> list[Row]:
                query = f"SELECT * FROM {table} ORDER BY cell_id, {order}"
                return [dict(row) for row in connection.execute(query)]

            decisions = read("decision", "number")
            traces = {(r["cell_id"], r["decision_id"]): r["data"] for r in read("trace", "entry")}
            labels = {(r["cell_id"], r["decision_id"]): r for r in read("label", "seq")}
            corrections = read("correction", "number")
            self.versions = sorted(
                (row for row in read("model_version", "retrain") if row["accepted"]),
                key=lambda row: row["version"],
            )
            self.events = {}
            for row in read("event", "number"):
                if row["kind"] in ("rollback", "release"):
                    data = json.loads(row["data"])
                    self.events[row["kind"], data["now"]] = data
        self.parts = []
        for row in decisions:
            cell = int(row["cell_id"].split()[1])
            trace = np.frombuffer(traces[row["cell_id"], row["id"]], "<f4").astype(np.float64)
            silence = policy.stops == "all" and row["action"] == "accept"
            part = Part(cell, row, trace, (row["time"], DECIDED), silence)
            part.label = labels.pop((row["cell_id"], row["id"]), None)
            self.parts.append(part)
        self.labels_without_decision = len(labels)
        by_id = {part.row["id"]: part for part in self.parts}
        for row in sorted(corrections, key=lambda row: row["number"]):
            value = None if row["success"] is None else bool(row["success"])
            by_id[row["decision_id"]].corrections.append(((row["time"], TOLD), value))
        self._set_moments(policy, restarts)

    def _set_moments(self, policy: Policy, restarts: list[tuple[float, int]]) -> None:
        """Set of each part what depends on later decisions and restarts."""
        for cell in {part.cell for part in self.parts}:
            parts = self.of_cell(cell)
            for part, following in itertools.pairwise(parts):
                part.next_decided = (following.row["time"], CONFIRMED)
            for i, part in enumerate(parts):
                part.gone_on = part.next_decided
                for time, restarted in restarts:
                    if restarted == cell and time > part.decided[0]:
                        part.gone_on = min(part.gone_on, (time, CONFIRMED))
                if i + policy.label_within < len(parts):
                    later = parts[i + policy.label_within]
                    part.overdue = (later.row["time"], OVERDUE)

    def of_cell(self, cell: int) -> list[Part]:
        """Return the parts of a cell, oldest first."""
        return [part for part in self.parts if part.cell == cell]

    def silent_before(self, cell: int) -> dict[str, int]:
        """Return, for each label that teaches the rule, how many accepted parts went on in silence.

        They are counted from the label before it, without the labelled part itself.
        """
        parts = self.of_cell(cell)
        silent = [
            part
            for part in parts
            if part.row["action"] == "accept"
            and not part.is_confirmed_by_silence
            and part.gone_on < part.reported
        ]
        labelled = [part for part in parts if self.teaches_rule(part)]
        labelled.sort(key=lambda part: part.learned(self.end))
        result = {}
        before = 0
        for part in labelled:
            now = part.learned(self.end)
            gone = sum(item.gone_on < now for item in silent)
            is_own = any(item is part for item in silent) and part.gone_on < now
            result[part.row["id"]] = gone - before - int(is_own)
            before = gone
        return result

    def teaches_rule(self, part: Part) -> bool:
        """Return whether the label of a part, once there is one, updates the rule."""
        has_label = part.learned(self.end) != NEVER
        return has_label and part.teaches and part.row["action"] != "reject"
