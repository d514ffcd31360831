"""The model versions of a store in a database: stored, checked when they are loaded, and thinned out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray

from ..errors import StoreError
from ..records import RetrainReport
from . import sql_queries as ask
from .chain import state_sum
from .checks import check_state
from .fleet import without_rule
from .kept_versions import StoredVersion, VersionError, keeps_state, not_kept
from .records import ModelVersion
from .sql_queue import SqlDatabase
from .sql_rows import from_npz, version_row
from .sql_tables import VERSION


class SqlVersions:
    """What `SqlStore` does with versions; a class of its own, so that each file is one idea."""

    cell_id: str
    keep_versions: int | None
    _clock: Callable[[], float]
    _database: SqlDatabase
    _read: Callable[[sa.Select[Any]], Sequence[Any]]
    _note: Callable[[str, str], None]

    def put_version(self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None) -> int:
        """Commit a retrain, and let go of states that `keeps_state` does not keep; returns the version's number."""
        row = version_row(self.cell_id, report, int(last_seq), self._clock(), check_state(report, state))

        return self._database.write(lambda connection: self._add_version(connection, row))

    def _add_version(self, connection: sa.Connection, row: dict[str, Any]) -> int:
        retrain = self._database.next_number(connection, VERSION.c.retrain)
        number = self._database.scope.next_version(connection, row["version"], row["accepted"])
        connection.execute(sa.insert(VERSION), row | {"retrain": retrain, "version": number})
        if row["accepted"]:
            self._thin_out(connection, number)
        return number

    def _thin_out(self, connection: sa.Connection, newest: int) -> None:
        held = connection.execute(ask.held_states_query(self._database.scope)).all()
        gone = [row.retrain for row in held if not keeps_state(row.version, newest, self.keep_versions)]
        if gone:
            mine = self._database.scope.shared(VERSION.c.cell_id) & VERSION.c.retrain.in_(gone)
            connection.execute(sa.update(VERSION).where(mine).values(state=None))

    def last_version(self) -> ModelVersion | None:
        """Return the newest accepted version whose state is as it was stored; of a damaged one an event tells."""
        for i, row in enumerate(self._read(ask.accepted_query(self._database.scope))):
            if not row.kept and i > 0:
                continue  # thinned out, which the newest never is
            try:
                return self._loaded(row.retrain)
            except VersionError as error:
                self._note("damaged", f"{error} The accepted version before it answers.")
        return None

    def load_version(self, version: int) -> ModelVersion:
        """Return an accepted version by its number. StoreError where its state is not kept, or is damaged."""
        held = [row for row in self._read(ask.accepted_query(self._database.scope)) if row.kept]
        found = [row.retrain for row in held if row.version == version]
        if not found:
            raise not_kept(version, [row.version for row in held])
        return self._loaded(found[0])

    def kept_version(self, version: int) -> ModelVersion | None:
        """Return an accepted version; None where it is not kept, or is damaged."""
        try:
            return self.load_version(version)
        except VersionError:
            return None

    def _loaded(self, retrain: int) -> ModelVersion:
        row = self._read(ask.version_query(self._database.scope, retrain))[0]
        if row.state is None or (row.state_sum is not None and state_sum(row.state) != row.state_sum):
            raise VersionError(
                f"Expected the state of version {row.version} as it was stored in {self._database.name}, "
                "its bytes have changed; restore the store from a copy."
            )
        try:
            state = from_npz(row.state, self._database.name)
        except StoreError as error:
            raise VersionError(str(error)) from error
        if row.cell_id != self.cell_id:  # what a sister's parts taught its rule says nothing certain of this cell
            state = without_rule(state) | {"told_to": np.array(0)}
        return ModelVersion(row.version, row.last_seq, state)

    def versions(self) -> list[StoredVersion]:
        """Return every retrain, oldest first, and whether its state is kept."""
        rows = self._read(ask.versions_query(self._database.scope))
        return [
            StoredVersion(row.version, row.time, row.accepted, row.reason, row.n_bytes or 0, row.n_bytes is not None)
            for row in rows
        ]

    def retrains(self) -> list[RetrainReport]:
        """Return every retrain, oldest first."""
        return [RetrainReport(*row) for row in self._read(ask.retrain_query(self._database.scope))]
