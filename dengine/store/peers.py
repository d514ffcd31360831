"""Lists the cells of a database, and checks that cells of one product have matching settings.
`list_cells` returns a `CellSummary` per cell, `check_cell_exists` refuses an unknown cell, and
`check_peer_settings` refuses settings that would embed traces differently than another cell of the
product does. The command line and `SqlStore` use them.
"""

from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa

from ..errors import SettingError, StoreError
from ..recipe import Recipe
from .connections import reading
from .queries import Scope
from .records import Settings
from .schema import DECISION, LABEL, PRODUCT_KEY, SETTING, read_cells

# Settings of a recipe on which the arrays of a version depend.
EMBEDDING = ("reducer", "params", "folds", "window", "novelty")


@dataclass(frozen=True, slots=True)
class CellSummary:
    """One cell of a database.

    Attributes
    ----------
    cell_id : str
    product : str or None
        What the cell makes; None if it shares nothing with other cells.
    decisions, labels : int
        Their numbers.
    version : int or None
        Number of the newest version that was put in force, its product's or its own; None before
        the first.
    last_seen : float or None
        Time of its newest decision or label, in seconds since 1970; None before the first decision.
    """

    cell_id: str
    product: str | None
    decisions: int
    labels: int
    version: int | None
    last_seen: float | None


def check_peer_settings(
    settings: Settings, peer_settings: Settings, name: str, product: str
) -> None:
    """Check that two robot cells of a product would embed a trace in the same way.

    A product is robot cells that share labels and versions (trained models). The settings on which
    the arrays of a version depend must be equal: `reducer`, its `params`, `folds` (number of
    embedding spaces), `window` (number of traces that are used) and `novelty` (factor of the limit
    beyond which a trace is novel) of the `Recipe` (all settings of an engine), the seed, the
    `TraceSpec` (what traces look like), and the name and description of an object that a user
    passed as reducer or model. The policy and the rest of the `Recipe`, like the radius and the
    time limit of a retrain, may differ. Nothing is compared if one of the cells has no recipe yet.
    The `TraceSpec` is compared only if both cells have one.

    Parameters
    ----------
    settings, peer_settings : mapping of str to str
        The stored settings of this cell and of the other one, the peer.
    name : str
        The peer's cell_id, for the error.
    product : str
        Name of the product, for the error.

    Raises
    ------
    SettingError
        If one of the compared settings differs, and for a stored recipe that cannot be read.
    """
    if "recipe" not in settings or "recipe" not in peer_settings:
        return
    peer_values = _embedding_settings(peer_settings)
    values = _embedding_settings(settings)
    if None in (values["trace"], peer_values["trace"]):
        # The first trace of any cell sets the product's trace spec.
        values["trace"] = peer_values["trace"]
    different = [key for key in values if values[key] != peer_values[key]]
    if different:
        expected = ", ".join(f"{key} {peer_values[key]}" for key in different)
        actual = ", ".join(f"{key} {values[key]}" for key in different)
        raise SettingError(
            f"Expected the settings of product {product!r}, as cell {name!r} has them "
            f"({expected}), got {actual}; cells that share labels share what embeds them: give the "
            "same, or name another product."
        )


def _embedding_settings(settings: Settings) -> dict[str, Any]:
    """Return the settings on which an embedding depends, by name, of a cell's stored settings.

    They are those in EMBEDDING, seed, trace, model and described. Those that are not stored are
    None; the recipe must be. Raise SettingError for a recipe that cannot be read.
    """
    recipe = Recipe.from_toml(settings["recipe"])
    return {key: getattr(recipe, key) for key in EMBEDDING} | {
        key: settings.get(key) for key in ("seed", "trace", "model", "described")
    }


def check_cell_exists(url: str, cell_id: str) -> None:
    """Raise a StoreError if a database has no such robot cell, or cannot be read as a store.

    `url` is a file, or a URL of SQLite or PostgreSQL.
    """
    with reading(url) as connection:
        names = read_cells(connection)
    if cell_id not in names:
        raise StoreError(
            f"Expected a cell of this store, got {cell_id!r}; it holds {', '.join(names)}. Name "
            "one of them: --cell NAME."
        )


def list_cells(url: str) -> list[CellSummary]:
    """Return a summary of every robot cell of a database, sorted by cell_id.

    It has the cell's product (robot cells of one product share labels and versions), its numbers of
    decisions and labels, the newest version of the model that was put in force in the cell or its
    product, and the time of the newest decision or label. Forgotten labels (withdrawn by a person)
    count, and so do labels of quarantined traces, which are never trained on. Records that a
    journal, a cell's log on disk, holds and the database does not hold yet do not count. Raise
    StoreError if the database is not there, is no store or cannot be read. No row is written (see
    `reading`).
    """
    summaries = []
    with reading(url) as connection:
        settings = connection.execute(sa.select(SETTING)).all()
        products = {row.cell_id: row.value for row in settings if row.key == PRODUCT_KEY}
        for name in sorted({row.cell_id for row in settings}):
            (n_decisions, last_decision), (n_labels, last_label) = (
                connection.execute(
                    sa.select(sa.func.count(), sa.func.max(table.c.time)).where(
                        table.c.cell_id == name
                    )
                ).one()
                for table in (DECISION, LABEL)
            )
            product = products.get(name)
            summary = CellSummary(
                cell_id=name,
                product=product,
                decisions=n_decisions,
                labels=n_labels,
                version=Scope(name, product).newest_version(connection) or None,
                last_seen=max(last_decision, last_label or 0.0) if n_decisions else None,
            )
            summaries.append(summary)
    return summaries
