"""`EventTable`: what happened to the engines of a store's cell, for people to read. `SqlStore` has
one.
"""

from collections.abc import Mapping
from typing import Any

import sqlalchemy as sa

from ..errors import StoreError, log
from .cell_table import CellTable
from .records import (
    ACKNOWLEDGED,
    Event,
    as_text,
    from_row,
    new_event,
    open_losses,
    to_row,
)
from .schema import EVENT


class EventTable(CellTable):
    """Reads and writes the events of a robot cell.

    It takes what `CellTable` takes.
    """

    def put(
        self, kind: str, text: str, data: Mapping[str, Any] | None = None, author: str = ""
    ) -> int:
        """Commit an event with the present time, and return its number.

        An event is a row of the store's log: what happened besides decisions and labels. In `kind`,
        `text` and `author` a NUL and half a surrogate pair become escapes.

        Parameters
        ----------
        kind : str
            A word for the kind of the event.
        text : str
            What happened, for people.
        data : mapping or None
            The same for machines, with values that JSON has.
        author : str, default ""
            Who did it; "" for the engine itself.

        Returns
        -------
        int

        Raises
        ------
        StoreError
            For data that JSON does not have, and if the database fails.
        """
        event = new_event(kind, text, self._database.clock(), data, author)
        (number,) = self._database.write(
            lambda connection: self._database.insert(connection, EVENT.c.number, [to_row(event)])
        )
        return number

    def record_damage(self, text: str) -> None:
        """Commit an event of kind "damaged" with this text, unless the cell has the same already.

        If the store cannot be written, the text is logged instead, and nothing is raised. Raise
        StoreError if it cannot be read.
        """
        query = sa.select(EVENT.c.number).where(
            self._own(EVENT), EVENT.c.kind == "damaged", EVENT.c.text == as_text(text)
        )
        if not self._read(query.limit(1)):
            try:
                self.put("damaged", text)
            except StoreError as error:  # a store that can only be read is read all the same
                log.warning("%s (%s)", text, error)

    def newest(self, limit: int | None = None) -> list[Event]:
        """Return the newest events (rows of the store's log) of the robot cell, oldest first.

        Parameters
        ----------
        limit : int or None
            Number of events; None: all.

        Returns
        -------
        list of Event

        Raises
        ------
        StoreError
            For a stored value that cannot be read, and if the database fails.
        """
        query = (
            sa.select(EVENT).where(self._own(EVENT)).order_by(EVENT.c.number.desc()).limit(limit)
        )
        return [from_row(Event, row._mapping) for row in self._read(query)[::-1]]

    def acknowledge_losses(self, author: str = "") -> None:
        """End the alarm about lost data by an event of kind ACKNOWLEDGED.

        An event of kind DATA_LOST (records are lost) is an alarm until a later event of kind
        ACKNOWLEDGED. Without an alarm nothing is written.

        Parameters
        ----------
        author : str
            Who acknowledges the loss.

        Raises
        ------
        StoreError
            If the database fails.
        """
        if losses := open_losses(self.newest()):
            self.put(ACKNOWLEDGED, f"{len(losses)} losses of data", author=author)
