"""The cells of a database, and the settings that cells of one product must agree on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from ..errors import SettingError, StoreError, without_password
from ..recipe import Recipe
from .connections import advice, make_engine
from .schema import DECISION, LABEL, OWNER_KEY, PRODUCT_KEY, SETTING, VERSION

EMBEDDING = ("reducer", "params", "folds", "window", "novelty")  # of a recipe: what a version's arrays were made by


@dataclass(frozen=True, slots=True)
class CellSummary:
    """One cell of a database.

    version : number of the newest accepted version that it may answer by, its product's or its own; None before the first.
    last_seen : time of its newest decision or label, in seconds.
    owner : the engine that drives it, where the store knows one.
    """

    cell_id: str
    product: str | None
    decisions: int
    labels: int
    version: int | None
    last_seen: float | None
    owner: str | None


def must_agree(mine: Mapping[str, str], peer: Mapping[str, str], name: str, product: str) -> None:
    """SettingError where two cells of a product, by what `Store.settings` gives of each, would embed a trace differently.

    name : of the peer.  A policy, a radius, a schedule or a budget may differ: a version's arrays do not depend on them.
    """
    if "recipe" not in mine or "recipe" not in peer:
        return
    have, asked = _embedding(peer), _embedding(mine)
    either = ("trace",) if None in (have["trace"], asked["trace"]) else ()  # the first trace of any cell sets the contract
    other = [key for key in have if key not in either and have[key] != asked[key]]
    if other:
        stored, got = (", ".join(f"{key} {values[key]}" for key in other) for values in (have, asked))
        raise SettingError(
            f"Expected the settings of product {product!r}, as cell {name!r} has them ({stored}), got {got}; "
            "cells that share labels share what embeds them: give the same, or name another product."
        )


def _embedding(settings: Mapping[str, str]) -> dict[str, Any]:
    recipe = Recipe.from_toml(settings["recipe"])
    own = {key: getattr(recipe, key) for key in EMBEDDING}
    return own | {key: settings.get(key) for key in ("seed", "trace", "model", "described")}


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
            version=max(
                (
                    number
                    for other, number in versions.items()
                    if other == name or (products[name] is not None and products[name] == products.get(other))
                ),
                default=None,
            ),
            last_seen=max((row[name][1] for row in (decisions, labels) if name in row), default=None),
            owner=settings.get((name, OWNER_KEY)),
        )
        for name in names
    ]


def _counts(connection: sa.Connection, table: sa.Table) -> dict[str, tuple[int, float]]:
    query = sa.select(table.c.cell_id, sa.func.count(), sa.func.max(table.c.time)).group_by(table.c.cell_id)
    return {row[0]: (row[1], row[2]) for row in connection.execute(query)}
