"""`VersionTable`: the retrains of a store's cell or product, and the arrays of their model
versions. `SqlStore` has one.
"""

import numpy as np
import sqlalchemy as sa

from ..errors import StoreError, VersionError, instead
from ..records import Arrays, RetrainReport
from .cell_table import CellTable
from .connections import Database
from .events import EventTable
from .ledger import state_sum
from .queries import Scope
from .records import (
    ModelVersion,
    Row,
    StoredVersion,
    check_state,
    from_npz,
    from_row,
    keeps_state,
    to_npz,
    to_row,
    without_rule,
)
from .schema import PRODUCT, VERSION, lock

KEPT = VERSION.c.state.is_not(None).label("kept")  # whether a version's arrays are there


class VersionTable(CellTable):
    """Stores and loads model versions.

    Parameters
    ----------
    database : Database
    events : EventTable
        Takes an event about a version that is damaged.
    keep : int or None
        Number of newest versions that keep their states; None: all.
    """

    def __init__(self, database: Database, events: EventTable, keep: int | None) -> None:
        super().__init__(database)
        self._events = events
        self._keep = keep
        # The rows of the cell, or of all cells of its product.
        self._shared = self._scope.shared(VERSION.c.cell_id)
        # The query for the versions that were put in force in the cell or its product, newest
        # first: `retrain`, the number among all retrains (those whose version was not put in force
        # are numbered, too), `version`, the number of the version, and `kept`, whether its state
        # (the stored arrays) is kept.
        self._accepted = (
            sa.select(*VERSION.c["retrain", "version"], KEPT)
            .where(self._shared, VERSION.c.accepted == sa.true())
            .order_by(VERSION.c.retrain.desc())
        )

    def put(
        self,
        report: RetrainReport,
        last_seq: int,
        state: Arrays | None,
        time: float | None = None,
    ) -> int:
        """Commit a retrain; if its version is accepted, delete states that are no longer kept.

        A state is the stored arrays of a version; `keeps_state` says which older versions keep
        theirs. In a product the states of all its cells are meant.

        Parameters
        ----------
        report : RetrainReport
        last_seq : int
            Number of the newest label that the retrain knew of.
        state : mapping of str to array, or None
            The version's arrays; None for a dropped candidate.
        time : float or None
            When the retrain ended, in seconds since 1970; None: now.

        Returns
        -------
        int
            The version's number. It is the number in the report, unless `report.accepted` is True
            and another robot cell of the product stored a version of this or a larger number
            meanwhile: then it is the next number.

        Raises
        ------
        StoreError
            If `report.accepted` is True and there are no arrays, for an array of Python objects,
            and if the database fails.
        """
        row = self.row(report, last_seq, state, self._database.clock() if time is None else time)
        return self._database.write(lambda connection: self.insert(connection, row))

    def row(
        self,
        report: RetrainReport,
        last_seq: int,
        state: Arrays | None,
        now: float,
    ) -> Row:
        """Return the row of a retrain for the table `model_version`, its arrays packed as npz.

        `last_seq` is the number of the newest label that the retrain knew of. `state` is None, or
        the arrays by name; `now` is the time of the row, in seconds since 1970. Raise StoreError if
        `report.accepted` is True (the version is to be put in force) and `state` is None, and for
        an array of Python objects.
        """
        arrays = check_state(report, state)
        blob = None if arrays is None else to_npz(arrays)
        return {
            "time": now,
            "last_seq": int(last_seq),
            "state": blob,
            "state_sum": state_sum(blob),
        } | to_row(report)

    def insert(self, connection: sa.Connection, row: Row) -> int:
        """Insert the row of a retrain; return the number of its version. Nothing is committed.

        A version is the model that a retrain made; both are numbered, apart. The retrain gets the
        next number of the robot cell or its product (robot cells that share labels and versions);
        the product is then locked until the transaction ends. `row["version"]` is the number that
        the caller wants for the version. If the version is not put in force (`accepted` of the row
        is False), it has that number, and nothing else is done. Otherwise it gets the larger of
        that number and the number after the newest version of cell and product. The states (stored
        arrays) of older versions of cell and product are then deleted, except those that
        `keeps_state` keeps: of the first version, of the `keep` newest (None: of all), and of ever
        fewer before these.
        """
        number: int = row["version"]
        if row["accepted"]:
            if self._scope.product is not None:
                lock(connection, PRODUCT, self._scope.product)
            # A peer's may have been stored before, or one that the engine dropped as too late.
            number = max(number, self._scope.newest_version(connection) + 1)
            dropped = [
                stored.retrain
                for stored in connection.execute(self._accepted.where(VERSION.c.state.is_not(None)))
                if not keeps_state(stored.version, number, self._keep)
            ]
            if dropped:
                connection.execute(
                    sa.update(VERSION)
                    .where(self._shared, VERSION.c.retrain.in_(dropped))
                    .values(state=None)
                )
        # Afterwards, so that the new state takes the room of those.
        self._database.insert(connection, VERSION.c.retrain, [row | {"version": number}])
        return number

    def newest_number(self) -> int:
        """Return the number of the newest version that was put in force; 0 before the first.

        Versions of all robot cells of the product count. Raise StoreError if the database fails.
        """
        with self._database.reading() as connection:
            return self._scope.newest_version(connection)

    def newest(self) -> ModelVersion | None:
        """Return the newest version that was put in force in the robot cell or its product.

        A product is robot cells that share labels and versions. The version, a trained model, comes
        with its arrays. If they are missing or damaged, an event (a row of the store's log) is
        written to the store (once for each such version), or logged if the store cannot be written,
        and the next older version whose arrays are kept and intact is returned.

        Returns
        -------
        ModelVersion or None
            None if there is no version yet, and if all arrays that are kept are damaged. The
            version of another cell is returned without the state of its decision rule, which
            learned from that cell's outcomes.

        Raises
        ------
        StoreError
            If the database fails.
        """
        for i, row in enumerate(self._read(self._accepted)):
            if not row.kept and i > 0:
                continue  # its state was deleted, which the newest's never is
            try:
                return self._load_retrain(row.retrain)
            except VersionError as error:
                self._events.record_damage(f"{error} The accepted version before it answers.")
        return None

    def load(self, version: int) -> ModelVersion:
        """Return a version that was put in force in the robot cell or its product, with its arrays.

        A version is a trained model, and a product is robot cells that share labels and versions.

        Parameters
        ----------
        version : int

        Returns
        -------
        ModelVersion
            The version of another cell is returned without the state of its decision rule, which
            learned from that cell's outcomes.

        Raises
        ------
        VersionError
            If no such version was put in force, or if its state, the stored arrays, was deleted
            since; the error names the versions whose states are kept. Also if its state is damaged.
        StoreError
            If the database fails.
        """
        retrains = {
            row.version: row.retrain for row in reversed(self._read(self._accepted)) if row.kept
        }
        if version not in retrains:
            others = ", ".join(map(str, retrains)) or "none"
            raise VersionError(
                f"Expected a held version, got {version}, which is not kept; load one of "
                f"these: {others}."
            )
        return self._load_retrain(retrains[version])

    def _load_retrain(self, retrain: int) -> ModelVersion:
        """Return the version that the retrain with this number made, with its arrays.

        There must be such a retrain. A version of another robot cell is returned without the state
        of its decision rule (which turns the bounds of a success probability into an action), for
        the rule learned from that cell's outcomes, and its `rule_last_seq` is 0: the rule includes
        no label. Raise VersionError if the state, the stored arrays, is missing or damaged.
        """
        query = sa.select(*VERSION.c["cell_id", "version", "last_seq", "state", "state_sum"]).where(
            self._shared, VERSION.c.retrain == retrain
        )
        row = self._read(query)[0]
        if row.state is None or state_sum(row.state) != row.state_sum:
            raise VersionError(
                f"Expected the state of version {row.version} as it was stored in "
                f"{self._database.name}, its bytes have changed; restore the store from a copy."
            )
        with instead(VersionError, f"Version {row.version} cannot be read", StoreError):
            state = from_npz(row.state, self._database.name)
        if row.cell_id != self._database.cell_id:  # a peer's outcomes are no evidence for this cell
            state = without_rule(state) | {"rule_last_seq": np.array(0)}
        return ModelVersion(row.version, row.last_seq, state)

    def all(self, cell_only: bool = False) -> list[StoredVersion]:
        """Return every retrain of the robot cell or its product, oldest first.

        A product is robot cells that share labels and versions. Retrains whose version (the trained
        model) was dropped, not put in force, are included, and so are the versions that a rollback
        (an earlier version is put in force again and pinned), a release (retrains may replace the
        pinned version again) or a change of the policy stored. No arrays are read.

        Parameters
        ----------
        cell_only : bool, default False
            Leave out the retrains of the product's other cells.

        Returns
        -------
        list of StoredVersion
            Each with the report, the time, the newest label that the retrain knew of, and whether
            the arrays of its version are kept, and their size; whether they are intact is not
            checked.

        Raises
        ------
        StoreError
            For a stored value that cannot be read, and if the database fails.
        """
        query = sa.select(
            *(column for column in VERSION.c if column.name != "state"),
            VERSION.c.retrain.label("number"),
            sa.func.coalesce(sa.func.length(VERSION.c.state), 0).label("n_bytes"),
            KEPT,
        )
        scope = Scope(self._database.cell_id) if cell_only else self._scope
        rows = self._read(query.where(scope.shared(VERSION.c.cell_id)).order_by(VERSION.c.retrain))
        return [
            from_row(StoredVersion, row._mapping, report=from_row(RetrainReport, row._mapping))
            for row in rows
        ]

    def retrains(self) -> list[RetrainReport]:
        """Return the report of every retrain of the robot cell or its product, oldest first.

        Raise StoreError as `all` does.
        """
        return [version.report for version in self.all()]
