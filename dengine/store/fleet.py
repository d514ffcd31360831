"""What cells of one product share, apart from the database: addresses, news, and the settings that must agree.

open_store(address("fleet.db", "cell-7", "gear-12"))
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from numpy.typing import NDArray

from ..errors import SettingError
from ..recipe import Recipe
from .records import Labelled

RULE = ("rule.", "untold", "told_to")  # beginnings of names in a version's state: what its maker's parts taught its rule
EMBEDDING = ("reducer", "params", "folds", "window", "novelty")  # of a recipe: what a version's arrays were made by


class CellAddress(str):
    """A store's file or URL, and whose rows of it: wherever the name of a store is taken, this is too.

    cell_id : the cell.  product : what it makes; None: as the store says, or nothing that is shared.
    """

    cell_id: str
    product: str | None

    def __new__(cls, url: str, cell_id: str, product: str | None = None) -> Self:
        made = super().__new__(cls, url)
        made.cell_id, made.product = cell_id, product
        return made


def address(store: str | os.PathLike[str], cell_id: str | None = None, product: str | None = None) -> str:
    """A store's file or URL with its cell and product, as far as they were given."""
    url = os.fspath(store)
    return url if cell_id is None and product is None else CellAddress(url, cell_id or "cell", product)


@dataclass(frozen=True, slots=True)
class News:
    """What became known in a product.

    labelled : labels of all its cells, this one's too, oldest first, as they count now.
    version : number of its newest accepted version; 0 before the first.  correction : of its newest one; 0 likewise.
    """

    labelled: Labelled
    version: int
    correction: int = 0


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


def without_rule(state: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """A version's arrays but for what its maker's own parts taught its rule."""
    return {name: values for name, values in state.items() if not name.startswith(RULE)}


def must_agree(mine: Mapping[str, str], sister: Mapping[str, str], name: str, product: str) -> None:
    """SettingError where two cells of a product, by what `Store.settings` gives of each, would embed a trace differently.

    name : of the sister.  A policy, a radius, a schedule or a budget may differ: a version's arrays do not depend on them.
    """
    if "recipe" not in mine or "recipe" not in sister:
        return
    have, asked = _embedding(sister), _embedding(mine)
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
