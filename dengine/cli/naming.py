"""Which cell of a store a verb means, and what that cell makes."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import click

Command = Callable[..., Any]


def cell_options(*names: str, product: bool = False) -> Callable[[Command], Command]:
    """`--cell`, or other names of it, and where asked for `--product`; the verb's `store` then says whose rows it means."""

    def with_options(command: Command) -> Command:
        @wraps(command)
        def named(store: str | None, cell_id: str | None, product: str | None = None, **others: Any) -> Any:
            from ..store.fleet import address

            if store is None and (cell_id or product):
                raise click.UsageError("A cell and its product are known to a store: name it, --store FILE|URL.")
            return command(store=None if store is None else address(store, cell_id, product), **others)

        if product:
            about = "What the cell makes: cells of one product share labels and versions.  [default: as the store says]"
            named = click.option("--product", metavar="NAME", help=about)(named)
        whose = "Whose rows of the store, where it holds several cells; see `dengine cells`.  [default: cell]"
        return click.option(*(names or ("--cell", "--cell-id")), "cell_id", metavar="NAME", help=whose)(named)

    return with_options
