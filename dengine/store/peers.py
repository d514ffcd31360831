"""The cells of a database, and the settings that cells of one product must agree on."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from ..errors import SettingError, StoreError
from ..recipe import Recipe
from .connections import reading
from .schema import DECISION, LABEL, PRODUCT_KEY, SETTING, VERSION

EMBEDDING = ("reducer", "params", "folds", "window", "novelty")  # of a recipe: what a version's arrays were made by


@dataclass(frozen=True, slots=True)
class CellSummary:
    """One cell of a database.

    version : number of the newest accepted version that it may answer by, its product's or its own; None before the first.
    last_seen : time of its newest decision or label, in seconds.
    """

    cell_id: str
    product: str | None
    decisions: int
    labels: int
    version: int | None
    last_seen: float | None


def must_agree(mine: Mapping[str, str], peer: Mapping[str, str], name: str, product: str) -> None:
    """SettingError where two cells of a product, by their settings, would embed a trace differently.

    name : of the peer.  A policy, a radius, a schedule or a budget may differ: a version's arrays do not depend on them.
    """
    if "recipe" not in mine or "recipe" not in peer:
        return
    have, asked = _embedding(peer), _embedding(mine)
    either = ("trace",) if None in (have["trace"], asked["trace"]) else ()  # the first trace of any cell sets the contract
    other = [key for key in have if key not in either and have[key] != asked[key]]
    if other:
        stored, got = (", ".join(f"{key} {values[key]}" for key in other) for values in (have, asked))
        do = "cells that share labels share what embeds them: give the same, or name another product"
        wanted = f"the settings of product {product!r}, as cell {name!r} has them ({stored})"
        raise SettingError(f"Expected {wanted}, got {got}; {do}.")


def _embedding(settings: Mapping[str, str]) -> dict[str, Any]:
    recipe = Recipe.from_toml(settings["recipe"])
    own = {key: getattr(recipe, key) for key in EMBEDDING}
    return own | {key: settings.get(key) for key in ("seed", "trace", "model", "described")}


def must_have_cell(url: str, cell_id: str) -> None:
    """StoreError for a cell that a database does not hold, and for what is no store."""
    with reading(url) as connection:
        names = sorted(connection.execute(sa.select(SETTING.c.cell_id).distinct()).scalars())
    if cell_id not in names:
        held = ", ".join(names)
        raise StoreError(f"Expected a cell of this store, got {cell_id!r}; it holds {held}. Name one of them: --cell NAME.")


def list_cells(url: str) -> list[CellSummary]:
    """Every cell of a database, by name. StoreError for what is no store."""
    accepted = sa.select(VERSION.c.cell_id, sa.func.max(VERSION.c.version)).where(VERSION.c.accepted == sa.true())
    with reading(url) as connection:
        settings = connection.execute(sa.select(*SETTING.c["cell_id", "key", "value"])).all()
        decisions, labels = (_counts(connection, table) for table in (DECISION, LABEL))
        versions = {row[0]: row[1] for row in connection.execute(accepted.group_by(VERSION.c.cell_id))}
    products = {cell_id: value for cell_id, key, value in settings if key == PRODUCT_KEY}
    shared = dict[str | None, int]()  # by product, its newest version
    for name, version in versions.items():
        shared[products.get(name)] = max(version, shared.get(products.get(name), 0))
    none = (0, None)
    return [
        CellSummary(
            cell_id=name,
            product=products.get(name),
            decisions=decisions.get(name, none)[0],
            labels=labels.get(name, none)[0],
            version=(shared if name in products else versions).get(products.get(name, name)),
            last_seen=max((row[name][1] for row in (decisions, labels) if name in row), default=None),
        )
        for name in sorted({row.cell_id for row in settings})
    ]


def _counts(connection: sa.Connection, table: sa.Table) -> dict[str, tuple[int, float]]:
    query = sa.select(table.c.cell_id, sa.func.count(), sa.func.max(table.c.time)).group_by(table.c.cell_id)
    return {row[0]: (row[1], row[2]) for row in connection.execute(query)}
