"""`CellTable`: what the table objects of a store have in common; each is in a file of its own."""

from .connections import Database


class CellTable:
    """Reads or writes one subject of a store, for one robot cell.

    Parameters
    ----------
    database : Database
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._read = database.read
        self._own = database.own
        self._scope = database.scope
