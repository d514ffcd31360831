"""What a cell asks of its product's other cells, and the list of all cells of a database."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

import sqlalchemy as sa

from ..errors import StoreError
from .fleet import CellSummary, must_agree
from .sql_engine import advice, make_engine
from .sql_scope import cells_of, lock_product
from .sql_tables import DECISION, LABEL, OWNER_KEY, PRODUCT_KEY, RESERVED, SETTING, VERSION

if TYPE_CHECKING:
    from .sql_queue import SqlDatabase


class ProductShare:
    """What `SqlStore` reads of its product; of a cell without one there is nothing to read."""

    cell_id: str
    _database: SqlDatabase

    @property
    def product(self) -> str | None:
        """What the cell makes; None: it shares nothing."""
        return self._database.scope.product

    def sisters_settings(self) -> dict[str, dict[str, str]]:
        """The settings of the product's other cells, by cell."""
        with self._database.transaction(write=False) as connection:
            return self._sisters(connection)

    def _sisters(self, connection: sa.Connection) -> dict[str, dict[str, str]]:
        product = self._database.scope.product
        if product is None:
            return {}
        query = sa.select(SETTING).where(SETTING.c.cell_id.in_(cells_of(product)), SETTING.c.cell_id != self.cell_id)
        found: dict[str, dict[str, str]] = {}
        for row in connection.execute(query.where(SETTING.c.key.not_in(RESERVED)).order_by(SETTING.c.cell_id)):
            found.setdefault(row.cell_id, {})[row.key] = row.value
        return found

    def _refuse_disagreement(self, connection: sa.Connection, settings: Mapping[str, str]) -> None:
        """SettingError where a sister embeds otherwise; the product stays locked, so that no sister comes in between."""
        product = self._database.scope.product
        if product is None:
            return
        self._database.scope.lock_cell(connection)
        lock_product(connection, product)
        for name, theirs in self._sisters(connection).items():
            must_agree(settings, theirs, name, product)


@contextmanager
def _reading(url: str) -> Iterator[sa.Connection]:
    engine = make_engine(url)
    try:
        with engine.connect() as connection:
            yield connection
    except (sa.exc.SQLAlchemyError, OSError) as error:
        raise StoreError(
            f"Could not read {without_password(url)}: {getattr(error, 'orig', None) or error}. {advice(error)}"
        ) from error
    finally:
        engine.dispose()


def without_password(url: str) -> str:
    """A file or URL as it may be shown."""
    return sa.make_url(url).render_as_string(hide_password=True) if "://" in url else url


def cell_names(url: str) -> list[str]:
    """The cells of a database, none where it holds no store; it is read and never made."""
    with _reading(url) as connection:
        found = sa.inspect(connection)
        columns = found.get_columns(SETTING.name) if found.has_table(SETTING.name) else []
        if {column["name"] for column in columns} != set(SETTING.c.keys()):
            return []
        return list(connection.execute(sa.select(SETTING.c.cell_id).distinct().order_by(SETTING.c.cell_id)).scalars())


def must_have_cell(url: str, cell_id: str) -> None:
    """StoreError for a cell that a database does not hold; a database without cells says what it is when it is opened."""
    names: list[str] = []
    with suppress(StoreError):
        names = cell_names(url)
    if names and cell_id not in names:
        held = ", ".join(map(str, names))
        raise StoreError(f"Expected a cell of this store, got {cell_id!r}; it holds {held}. Name one of them: --cell NAME.")


def list_cells(url: str) -> list[CellSummary]:
    """Every cell of a database, by name. StoreError where it holds none."""
    names = cell_names(url)
    if not names:
        raise StoreError(
            f"Expected a store that engines have used, {make_engine(url).url.render_as_string()} holds no cell."
        )
    with _reading(url) as connection:
        settings = {(row.cell_id, row.key): row.value for row in connection.execute(sa.select(SETTING))}
        decisions = _counts(connection, DECISION)
        labels = _counts(connection, LABEL)
        accepted = sa.select(VERSION.c.cell_id, sa.func.max(VERSION.c.version)).where(VERSION.c.accepted == sa.true())
        versions = {row[0]: row[1] for row in connection.execute(accepted.group_by(VERSION.c.cell_id))}
    products = {name: settings.get((name, PRODUCT_KEY)) for name in names}
    return [
        CellSummary(
            cell_id=name,
            product=products[name],
            decisions=decisions.get(name, (0, None))[0],
            labels=labels.get(name, (0, None))[0],
            version=max((versions[n] for n in _kin(name, products) if n in versions), default=None),
            last_seen=max((row[name][1] for row in (decisions, labels) if name in row), default=None),
            owner=settings.get((name, OWNER_KEY)),
        )
        for name in names
    ]


def _kin(name: str, products: Mapping[str, str | None]) -> list[str]:
    product = products[name]
    return [name] if product is None else [other for other, made in products.items() if made == product]


def _counts(connection: sa.Connection, table: sa.Table) -> dict[str, tuple[int, float]]:
    query = sa.select(table.c.cell_id, sa.func.count(), sa.func.max(table.c.time)).group_by(table.c.cell_id)
    return {row[0]: (row[1], row[2]) for row in connection.execute(query)}
