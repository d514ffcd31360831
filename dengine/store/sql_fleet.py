"""What a cell asks of its product's other cells, and the list of all cells of a database."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray

from ..errors import StoreError
from . import sql_queries as ask
from .fleet import RULE, CellSummary, News, must_agree, without_rule
from .records import Labelled, ModelVersion
from .sql_engine import advice, make_engine
from .sql_rows import CHUNK, from_npz, read_traces
from .sql_scope import Scope, cells_of, lock_product, newest_of
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

    def news_since(self, seq: int, limit: int) -> News:
        """Labels of the product after `seq`, at most `limit`, and its newest version's number."""
        scope = self._database.scope
        with self._database.transaction(write=False) as connection:
            rows = connection.execute(ask.news_query(scope, int(seq), limit)).all()
            labelled, newest = self._with_traces(connection, rows), 0
            if scope.product is not None:
                accepted = newest_of(scope.product, VERSION.c.version, VERSION.c.accepted == sa.true())
                newest = connection.execute(accepted).scalar() or 0
        return News(labelled, newest)

    def sisters_settings(self) -> dict[str, dict[str, str]]:
        """The settings of the product's other cells, by cell."""
        with self._database.transaction(write=False) as connection:
            return self._sisters(connection)

    def own_labelled(self) -> Labelled:
        """Return this cell's own labelled traces, all of them, oldest first."""
        own = Scope(self.cell_id)
        with self._database.transaction(write=False) as connection:
            return self._with_traces(connection, connection.execute(ask.newest_query(own, None)).all()[::-1], own)

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
        lock_product(connection, product)
        for name, theirs in self._sisters(connection).items():
            must_agree(settings, theirs, name, product)

    def _with_traces(self, connection: sa.Connection, rows: Sequence[Any], scope: Scope | None = None) -> Labelled:
        """Rows of `label`, oldest first, with their traces, read one after the other."""
        first, last = (rows[0].seq, rows[-1].seq) if rows else (1, 0)
        query = ask.trace_query(scope or self._database.scope, first, last)
        traces = read_traces(connection.execute(query.execution_options(yield_per=CHUNK)), len(rows))
        return Labelled(
            seq=np.array([row.seq for row in rows], dtype=np.int64),
            traces=traces,
            labels=np.array([row.success for row in rows], dtype=np.int8),
            hashes=np.array([row.content_hash for row in rows], dtype=np.int64),
        )

    def _newest_labels(self, connection: sa.Connection, limit: int | None) -> Sequence[Any]:
        """The newest labels that train, newest first. Of a product: by their numbers, or all would be read to be sorted."""
        scope, query = self._database.scope, ask.newest_query(self._database.scope, limit)
        if scope.product is not None and limit is not None:
            newest = connection.execute(newest_of(scope.product, LABEL.c.seq)).scalar() or 0
            rows = connection.execute(query.where(LABEL.c.seq > newest - 2 * limit)).all()
            if len(rows) == limit or newest <= 2 * limit:
                return rows
        return connection.execute(query).all()  # more than every second is quarantined

    def _with_own_rule(self, row: Any) -> ModelVersion:
        """A version with what this cell's own parts taught its rule: a sister's says nothing certain of this cell."""
        state = from_npz(row.state, self._database.name)
        if row.cell_id == self.cell_id:
            return ModelVersion(row.version, row.last_seq, state)
        with self._database.transaction(write=False) as connection:
            own = connection.execute(ask.version_query(Scope(self.cell_id))).first()
        rule: dict[str, NDArray[Any]] = {"told_to": np.array(0)}
        if own is not None:
            mine = from_npz(own.state, self._database.name)
            rule = {"told_to": np.array(own.last_seq)} | {k: v for k, v in mine.items() if k.startswith(RULE)}
        return ModelVersion(row.version, row.last_seq, without_rule(state) | rule)


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
        raise StoreError(
            f"Expected a cell of this store, got {cell_id!r}; it holds {', '.join(names)}. Name one of them: --cell NAME."
        )


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
