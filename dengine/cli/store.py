"""`dengine verify` and `dengine import-labels`: a store's history checked, and a cell program's labels taken into it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from . import options
from .output import imported_line, progress, show, write_json

if TYPE_CHECKING:
    from ..store.verification import HistoryReport

SHOWN = 20  # faults that a screen shows


@click.command(epilog=options.example("dengine verify engine.db"))
@options.store_argument
@click.option("--cell", metavar="ID", help="Of this cell alone.  [default: of all cells]")
@click.option(
    "--expect",
    metavar="DIGEST",
    help="A digest that an earlier check showed: the history must still hold it, or it was cut off or made anew.",
)
@options.json_option
@click.pass_context
def verify(context: click.Context, store: str, cell: str | None, expect: str | None, as_json: bool) -> None:
    """Check that a store's history is what was written.

    Every row is held against its sum, and every entry of the ledger against its rows; what was changed, is missing or was
    never chained is named, with exit code 1. Nothing is written, and engines may go on meanwhile.
    """
    from ..store.verification import count_rows, verify_history

    with progress("rows", count_rows(store, cell), quiet=as_json) as advance:
        report = verify_history(store, cell, expect, advance)
    if as_json:
        write_json({"verb": "verify", "store": store, "ok": report.ok, "cells": report.cells, "faults": report.faults})
    else:
        show(*_lines(report))
    if not report.ok:
        context.exit(1)


def _lines(report: HistoryReport) -> list[str]:
    lines = [
        f"Cell {cell.cell_id}: {cell.entries:,} entries over {cell.rows:,} rows, newest digest {cell.digest or 'none'}"
        for cell in report.cells
    ]
    for fault in report.faults[:SHOWN]:
        where = " ".join(word for word in (fault.cell_id and f"cell {fault.cell_id}:", fault.table, fault.key) if word)
        lines.append(f"{where} {fault.what}.")
    if len(report.faults) > SHOWN:
        lines.append(f"And {len(report.faults) - SHOWN} more; --json shows all.")
    if report.ok:
        return [*lines, "All is as it was written. Keep the digest elsewhere, and ask for it with --expect next time."]
    return [*lines, f"Faults: {len(report.faults)}. This history is not as it was written."]


@click.command("import-labels", epilog=options.example("dengine import-labels cell.csv --store engine.db"))
@click.argument("journal", metavar="JOURNAL", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--store", required=True, metavar="FILE|URL", help="The store that the cell's model was exported from.")
@click.option("--any-model", is_flag=True, help="Take a journal of a model that the store does not know as its export.")
@options.cell_options()
@options.json_option
def import_labels(journal: Path, store: str, any_model: bool, as_json: bool) -> None:
    """Take a cell program's labels back into the store.

    JOURNAL is the CSV file that the program wrote. Each line counts once, however often it is imported.
    """
    from ..export.cell_journal import import_journal

    report = import_journal(store, journal, any_model=any_model)
    if as_json:
        write_json({"verb": "import-labels", "store": store, "journal": journal} | asdict(report))
        return
    show(imported_line(report, store))
