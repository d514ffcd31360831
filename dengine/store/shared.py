"""The contract of a store whose cell shares what it learns with the other cells of its product."""

from __future__ import annotations

from typing import Protocol, TypeGuard

from .base import Store
from .fleet import News
from .records import Labelled


class SharedStore(Store, Protocol):
    """A `Store` of a cell that has a product.

    Labels as traces to train on, and versions, are then those of all the product's cells: `labelled`, `last_version`,
    `retrains`, and the numbers that `put_labels` and `put_version` give. What became of decisions stays the cell's own.
    """

    product: str | None

    def news_since(self, seq: int, limit: int) -> News:
        """Return labels of the product after `seq`, at most `limit`, and the number of its newest version."""

    def own_labelled(self) -> Labelled:
        """Return this cell's own labelled traces, all of them, oldest first."""

    def sisters_settings(self) -> dict[str, dict[str, str]]:
        """Return the settings of the product's other cells, by cell."""


def is_shared(store: Store) -> TypeGuard[SharedStore]:
    """Whether a store's cell has a product."""
    return getattr(store, "product", None) is not None
