"""`SettingTable`: the settings of a store's cell, as its engine saved them, and those of the other
cells of its product. `SqlStore` has one.
"""

import sqlalchemy as sa

from ..errors import StoreError
from .cell_table import CellTable
from .peers import check_peer_settings
from .records import Settings
from .schema import PRODUCT, RESERVED, SETTING, insert_settings, lock, read_settings


class SettingTable(CellTable):
    """Reads and replaces the settings of a robot cell.

    It takes what `CellTable` takes.
    """

    def read(self) -> dict[str, str]:
        """Return the settings that were saved last, by key; {} for a new robot cell.

        Those that the store itself keeps (`RESERVED`) are left out.
        """
        with self._database.reading() as connection:
            return read_settings(connection, self._database.cell_id)

    def save(self, settings: Settings) -> None:
        """Commit new settings in the place of all present ones.

        The settings that the store itself keeps (`RESERVED`) stay. Raise SettingError if those of
        another robot cell of the product contradict them, or a recipe of the two cannot be read,
        and StoreError for a key in `RESERVED` and if the database fails; then nothing is changed.
        """
        self._database.write(lambda connection: self.replace(connection, settings))

    def replace(self, connection: sa.Connection, settings: Settings) -> None:
        """Replace all settings of the robot cell by new ones; nothing is committed.

        `connection` must be in a write transaction. `settings` holds texts by name; a present
        setting that it lacks is deleted. The settings that the store itself keeps (`RESERVED`)
        stay; raise StoreError if `settings` has one of them. Raise SettingError if another cell of
        the product (robot cells that share labels and versions) would embed traces differently
        (`check_peer_settings`), or if its recipe (settings of its engine) or the new one cannot be
        read. After these errors nothing is changed. A product stays locked (`lock`) until the
        transaction ends.
        """
        for key in sorted(settings.keys() & RESERVED):
            raise StoreError(
                f"Expected settings of the engine, got {key!r}, which is the store's; rename it."
            )
        if self._scope.product is not None:
            lock(connection, PRODUCT, self._scope.product)
            for name, peer_settings in self._read_peers(connection).items():
                check_peer_settings(settings, peer_settings, name, self._scope.product)
        connection.execute(
            sa.delete(SETTING).where(self._own(SETTING), SETTING.c.key.not_in(RESERVED))
        )
        insert_settings(connection, self._database.cell_id, settings)

    def of_peers(self) -> dict[str, dict[str, str]]:
        """Return the settings of the product's other robot cells, by cell; {} without a product.

        A cell without settings is left out.
        """
        with self._database.reading() as connection:
            return self._read_peers(connection)

    def _read_peers(self, connection: sa.Connection) -> dict[str, dict[str, str]]:
        """Return the settings, by cell, of the product's other robot cells that have some."""
        return {
            name: settings
            for name in self._scope.cells(connection)[1:]
            if (settings := read_settings(connection, name))
        }
