"""`CorrectionTable`: corrections of labels, and the other changes that people make, each with its
event. `SqlStore` has one.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import sqlalchemy as sa

from ..errors import StoreError
from .cell_table import CellTable
from .connections import Database
from .queries import CORRECTION_OF_LABEL, WITH_LABELS, corrected_label
from .records import (
    FORGOTTEN,
    Change,
    Correction,
    Event,
    Row,
    from_row,
    new_event,
    nothing_to_correct,
    to_row,
    unknown_decision,
)
from .schema import CORRECTION, DECISION, EVENT, LABEL
from .settings import SettingTable
from .versions import VersionTable


class CorrectionTable(CellTable):
    """Commits changes of people, and reads the corrections of labels.

    Parameters
    ----------
    database : Database
    settings : SettingTable
    versions : VersionTable
    """

    def __init__(self, database: Database, settings: SettingTable, versions: VersionTable) -> None:
        super().__init__(database)
        self._settings = settings
        self._versions = versions

    def apply(self, change: Change) -> int:
        """Commit a person's change and its event in one transaction; return the event's number.

        The event is the change's row in the store's log. The change may correct labels, or withdraw
        them (they are then forgotten, and count nowhere), store a model version, and replace the
        engine's settings. A correction is a row of its own; the label stays as it was reported. If
        the version is to be put in force (it is accepted), the stored arrays of older versions that
        are not kept any more are deleted. If anything fails, nothing is written. A label that
        already has the new value gets a correction, too. An id that is given twice gets one
        correction. If nothing is to be changed, only the event is committed.

        Raises
        ------
        ReportError
            For a decision that is unknown or has no label.
        SettingError
            If the new settings contradict those of another robot cell of the product (the cells
            share labels and models), or the recipe in either (how the model is made) cannot be
            read.
        StoreError
            For data of the event that JSON does not have, for a setting that only the store itself
            may write (`schema.RESERVED`), for an accepted version without arrays, for an array of
            Python objects, if another cell of the product stored a version meanwhile, and if the
            database fails.
        """
        now = float(self._database.clock())
        event = new_event(change.kind, change.text, now, change.data, change.author)
        version = None if change.version is None else self._versions.row(*change.version, now)

        def add_rows(connection: sa.Connection) -> int:
            """Insert the event and everything that it changes; return the event's number."""
            labels = self._labels_to_correct(connection, change.decisions)
            number = self.insert(connection, event, change.success, labels)
            if version is not None:
                stored = self._versions.insert(connection, version)
                if stored != version["version"]:
                    raise StoreError(
                        f"Expected version {version['version']} to be the next, a peer of the "
                        f"product stored {stored - 1} meanwhile; try it again."
                    )
            if change.settings is not None:
                self._settings.replace(connection, change.settings)
            return number

        return self._database.write(add_rows)

    def _labels_to_correct(
        self, connection: sa.Connection, ids: Sequence[str]
    ) -> dict[str, bool | None]:
        """Return the label of each of these decisions, by id, as corrected by now.

        It is True for success, False for failure, and None if a person withdrew it. Raise
        ReportError for a decision that is not this cell's, is unknown, or has no label.
        """
        stored = self.stored_labels(connection, ids)
        values = {0: False, 1: True, FORGOTTEN: None}
        labels = {}
        for id_ in ids:
            if id_ not in stored:
                raise unknown_decision(id_)
            corrected = stored[id_].corrected
            if corrected is None:
                raise nothing_to_correct(id_)
            labels[id_] = values[corrected]
        return labels

    def newest_number(self) -> int:
        """Return the number of the robot cell's or product's newest correction; 0: none yet."""
        with self._database.reading() as connection:
            return self._scope.newest(connection, CORRECTION.c.number)

    def after(self, after: int = 0) -> list[Correction]:
        """Return corrections of labels, oldest first; a label that was corrected twice has two.

        A correction changes or withdraws a label, and is a row of its own.

        Parameters
        ----------
        after : int, default 0
            Only corrections whose number is above this one.

        Returns
        -------
        list of Correction
            Of the robot cell, or of all cells of its product (which share labels); each with the
            number of the label, as `seq`.

        Raises
        ------
        StoreError
            For a stored value that cannot be read, and if the database fails.
        """
        query = (
            sa.select(*CORRECTION.c, *LABEL.c["seq", "content_hash"])
            .select_from(CORRECTION.join(LABEL, CORRECTION_OF_LABEL))
            .where(self._scope.shared(CORRECTION.c.cell_id), CORRECTION.c.number > int(after))
        )
        return [
            from_row(Correction, row._mapping)
            for row in self._read(query.order_by(CORRECTION.c.number))
        ]

    def insert(
        self,
        connection: sa.Connection,
        event: Event,
        success: bool | None,
        labels: Mapping[str, bool | None],
    ) -> int:
        """Insert an event, and a correction for each decision in `labels`; nothing is committed.

        A correction is a row that changes or withdraws a label, which itself stays as it was
        reported. Without labels only the event is inserted. With labels the cell's product (the
        cells with which it shares labels), if it has one, is locked until the transaction ends.

        Parameters
        ----------
        connection : sqlalchemy.Connection
            In a write transaction.
        event : Event
            What happened; the corrections have its author and time, too.
        success : bool or None
            The new label of all decisions; None: the labels are withdrawn.
        labels : mapping of str to bool or None
            Label until now of each decision, by id; None if it was withdrawn before.

        Returns
        -------
        int
            Number of the event.
        """
        (number,) = self._database.insert(connection, EVENT.c.number, [to_row(event)])
        if labels:
            newest = self._scope.next_number(connection, LABEL.c.seq) - 1
            common: Row = {
                "event": number,
                "author": event.author,
                "time": event.time,
                "success": success,
                "newest_seq": newest,
            }
            self._database.insert(
                connection,
                CORRECTION.c.number,
                [common | {"decision_id": id_, "was": was} for id_, was in labels.items()],
            )
        return number

    def stored_labels(self, connection: sa.Connection, ids: Sequence[str]) -> dict[str, Any]:
        """Return, by id, a row for each of the given decisions that the robot cell has stored.

        Of the decision a row has id, content_hash (a hash of the trace, or of the part's number),
        quarantined (whether its trace is kept out of training) and time. Of its label it has
        success and source as they were reported, its number `seq`, and `corrected`, the label after
        corrections: 0, 1, or FORGOTTEN (2) if a person withdrew it. These four are None without a
        label. Ids that are not stored are left out.
        """
        query = sa.select(
            *DECISION.c["id", "content_hash", "quarantined", "time"],
            *LABEL.c["success", "source", "seq"],
            corrected_label().label("corrected"),
        )
        return self._database.rows_by_id(connection, query.select_from(WITH_LABELS), ids)
