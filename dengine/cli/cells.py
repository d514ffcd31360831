"""`dengine cells`: who shares a database."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import click

from .options import example, json_option
from .output import show, write_json

if TYPE_CHECKING:
    from ..store.fleet import CellSummary


@click.command(epilog=example("dengine cells engine.db"))
@click.argument("store", metavar="STORE")
@json_option
def cells(store: str, as_json: bool) -> None:
    """List the cells of a store, and what each has done.

    STORE is a file or URL, as given to `dengine train` or `dengine run`. Cells of one product share labels and versions;
    a cell without a product shares nothing. Other verbs name one of them by --cell.
    """
    from ..store.base import must_be_there
    from ..store.sql_fleet import list_cells, without_password

    must_be_there(store)
    found, name = list_cells(store), without_password(store)
    if as_json:
        write_json({"verb": "cells", "store": name, "cells": found})
        return
    show(_table(name, found))


def _table(store: str, found: list[CellSummary]) -> Any:
    from rich.table import Table

    table = Table(title=store, title_justify="left")
    for name in ("cell", "product"):
        table.add_column(name, overflow="fold")
    for name in ("decisions", "labels", "version"):
        table.add_column(name, justify="right")
    table.add_column("last seen (UTC)", no_wrap=True)
    owned = any(cell.owner for cell in found)
    if owned:
        table.add_column("owner", overflow="fold")
    for cell in found:
        counts = (f"{cell.decisions:,}", f"{cell.labels:,}", "-" if cell.version is None else str(cell.version))
        owner = [cell.owner or "-"] if owned else []
        table.add_row(cell.cell_id, cell.product or "-", *counts, _when(cell.last_seen), *owner)
    return table


def _when(seconds: float | None) -> str:
    return "-" if seconds is None else datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S")
