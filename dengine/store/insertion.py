"""`RecordInsertion`: commits the records of a cell's journal to its store: decisions, labels,
events. Records may come twice, and may contradict what is stored; nothing is guessed, and none is
lost: one that cannot be stored becomes an event, "dead letter". `SqlStore` has one.
"""

from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa

from ..errors import StoreError, log
from .connections import ROW_ERRORS, Database
from .corrections import CorrectionTable
from .journal import Record
from .queries import WITH_TRACES
from .records import (
    FORGOTTEN,
    LABEL_TEXTS,
    LATE_STOP,
    Event,
    LabelNumbers,
    NewLabel,
    StoredDecision,
    as_text,
    decision_row,
    new_event,
    to_row,
    trace_row,
)
from .schema import DECISION, EVENT, LABEL, TRACE


class RecordInsertion:
    """Inserts records into the tables of a robot cell.

    Parameters
    ----------
    database : Database
    corrections : CorrectionTable
    """

    def __init__(self, database: Database, corrections: CorrectionTable) -> None:
        self._database = database
        self._corrections = corrections

    def commit(self, records: Sequence[Record]) -> LabelNumbers:
        """Commit records (decisions, labels, events); return the numbers of their labels.

        The result is a list of pairs (decision id, label number), also for labels that are stored
        already; apart from that, a record that is stored already changes nothing. In place of a
        record that contradicts the store, like another label of a labelled decision, or a label
        whose decision is not stored, a dead letter is stored: an event that names the record and
        says why (its trace and other values are not in it), and that is logged. A label that became
        a dead letter has no pair. A label of a quarantined trace is quarantined, too (kept out of
        training).

        A late stop is a report that an accepted part was bad, after the part had counted as good.
        It corrects the label of the part to failure, with an event, and has a pair with the number
        of this label; if the label counts as a failure already, it changes nothing. If a person has
        withdrawn the label, the late stop becomes a dead letter.

        The records are committed in one transaction. But if the database refuses a value, they are
        halved, each half in a transaction of its own, until the refused record is alone; it becomes
        a dead letter, too. Raise StoreError if the database fails in another way; halves that were
        committed before stay.
        """
        try:
            return self._database.write(lambda connection: self._insert(connection, records))
        except StoreError as error:
            if not isinstance(error.__cause__, ROW_ERRORS):
                raise
            if len(records) > 1:  # the database refuses one of them
                half = len(records) // 2
                return self.commit(records[:half]) + self.commit(records[half:])
            text = f"{_describe(records[0])}, which the database refused: {error.__cause__}"
        self._database.write(lambda connection: self._insert_events(connection, [], [text]))
        return []

    def _insert(self, connection: sa.Connection, records: Sequence[Record]) -> LabelNumbers:
        """Insert the records that are not stored yet; nothing is committed.

        Records are decisions, labels and events; no two decisions among them may have one id. The
        first label of a decision is inserted. A second one that repeats success and source of the
        first changes nothing. In place of a record that contradicts the store, or of a label whose
        decision is not stored, an event is stored, a "dead letter", which is also logged as an
        error. A late stop (a report that an accepted part was bad, after it had counted as good)
        corrects the label of that part, with an event, unless it is a failure already; if a person
        has withdrawn the label, the late stop becomes a dead letter. A new label keeps its number
        if all stored numbers are smaller, and otherwise gets the next one (`Database.insert`). It
        is quarantined (kept out of training) if its decision is.

        Return one pair (decision id, number) for each decision that has a label among the records,
        unless that becomes a dead letter: the number of its first label, whether that is new, was
        stored before, or is corrected by a late stop.
        """
        events = [record for record in records if isinstance(record, Event)]
        decisions = [record for record in records if isinstance(record, StoredDecision)]
        labels = [record for record in records if isinstance(record, NewLabel)]
        problems = self._insert_decisions(connection, decisions)
        stored = self._corrections.stored_labels(
            connection, [label.decision_id for label in labels]
        )
        new: dict[str, NewLabel] = {}
        labelled: dict[str, None] = {}  # decisions that have the label that is reported
        late_stops: dict[str, None] = {}
        for label in labels:
            id_ = label.decision_id
            row: Any = stored.get(id_)
            # The label that the decision has: of these records, or of the store.
            first = new.get(id_) if row is None or row.seq is None else row
            problem = _find_problem(label, row, first)
            if problem:
                problems.append(problem)
                continue
            labelled[id_] = None
            if first is None:
                new[id_] = label
            # A late stop, unless a correction says the same already.
            elif first.success != label.success and row.corrected != 0:
                late_stops[id_] = None
        rows = [
            to_row(label) | {"quarantined": stored[label.decision_id].quarantined}
            for label in new.values()
        ]
        numbers = {id_: row.seq for id_, row in stored.items()}
        new_numbers = self._database.insert(connection, LABEL.c.seq, rows)
        numbers |= zip(new, new_numbers, strict=True)
        self._insert_events(connection, events, problems)
        for id_ in late_stops:
            event = new_event(
                "late stop",
                f"decision {as_text(id_)} counts as a failure, was a success: its stop came after "
                "its confirmation",
                self._database.clock(),
            )
            self._corrections.insert(connection, event, False, {id_: True})
        return [(id_, numbers[id_]) for id_ in labelled]

    def _insert_decisions(
        self, connection: sa.Connection, decisions: Sequence[StoredDecision]
    ) -> list[str]:
        """Insert the decisions that are not stored yet, with their traces; nothing is committed.

        Return a text, which names the difference, for each decision whose id is stored with other
        values, in columns or trace. A decision that is stored with the same values is passed over.
        The stored values are not changed. No two of the decisions may have one id. New ones get the
        next numbers of the robot cell, in their order; their attribute `number` is not used.
        """
        query = sa.select(*DECISION.c, *TRACE.c["decision_id", "channels", "samples", "data"])
        stored = self._database.rows_by_id(
            connection,
            query.select_from(WITH_TRACES),
            [item.decision.id for item in decisions],
        )
        new = []
        problems = []
        for item in decisions:
            row = stored.get(item.decision.id)
            if row is None:
                new.append(item)
                continue
            different = [
                name
                for name, value in (decision_row(item) | trace_row(item)).items()
                if row._mapping[name] != value
            ]
            if different:
                problems.append(
                    f"{_describe(item)}, of which the store holds another: "
                    f"{', '.join(different)} differ"
                )
        self._database.insert(connection, DECISION.c.number, [decision_row(item) for item in new])
        if new:
            connection.execute(
                sa.insert(TRACE),
                [{"cell_id": self._database.cell_id} | trace_row(item) for item in new],
            )
        return problems

    def _insert_events(
        self, connection: sa.Connection, events: Sequence[Event], problems: Sequence[str]
    ) -> None:
        """Insert events, and one "dead letter" for each problem, which is also logged as an error.

        A problem is a text that says why a record cannot be stored; a "dead letter" is the event
        that is stored in its place. An event is left out if the robot cell has stored one with the
        same time, kind and text. A "dead letter" gets the present time and is always inserted.
        Nothing is committed.
        """
        new = []
        if events:
            query = sa.select(*EVENT.c["time", "kind", "text"]).where(
                self._database.own(EVENT), EVENT.c.time.in_([event.time for event in events])
            )
            stored = {tuple(row) for row in connection.execute(query)}
            new = [event for event in events if (event.time, event.kind, event.text) not in stored]
        for problem in problems:
            log.error("dead letter: %s", problem)
            new.append(new_event("dead letter", problem, self._database.clock()))
        self._database.insert(connection, EVENT.c.number, [to_row(event) for event in new])


def _find_problem(label: NewLabel, row: Any, first: Any) -> str:
    """Return in words why the store cannot take a label; "" if it can.

    `row` is the stored row of its decision, or None. `first` is the label that the decision has, or
    None; it is this row or a `NewLabel`. It is a problem if there is no row, or if its content hash
    or time is not that which the label names for its decision. A second label is a problem, unless
    it repeats success and source of the first, or is a late stop: it reports a line stop of an
    accepted part that had counted as good until then, for the next part came without a report. A
    late stop is a problem if a person has withdrawn the first label.
    """
    if row is None:
        return f"{_describe(label)}, which the store does not hold"
    if (row.content_hash, row.time) != (label.content_hash, label.decided):
        return f"{_describe(label)}, of which the store holds another decision"
    if first is None:
        return ""
    earlier = (first.success, first.source)
    reported = (label.success, label.source)
    is_late_stop = (earlier, reported) == LATE_STOP and row.corrected != FORGOTTEN
    if earlier == reported or is_late_stop:
        return ""
    return f"a second label: {_describe(label)}, which has one"


def _describe(record: Record) -> str:
    """Return in a few words what a record is, for the text of an event about it.

    The event ("dead letter") says that the record could not be stored. The words name a decision or
    a label by the decision's id, and an event by its text.
    """
    if isinstance(record, Event):
        return f"an event, {record.text!r}"
    if isinstance(record, StoredDecision):
        return f"a decision, {record.decision.id!r}"
    return (
        f"a label, {LABEL_TEXTS[record.success]} from {record.source.value}, on "
        f"{record.decision_id!r}"
    )
