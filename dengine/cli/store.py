"""`dengine verify` and `dengine dump`: a store's history checked, and taken out for analysis."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .options import example, json_option
from .output import progress, show, write_json

if TYPE_CHECKING:
    from ..store.verification import HistoryReport

SHOWN = 20  # faults that a screen shows
cell_option = click.option("--cell", metavar="ID", help="Of this cell alone.  [default: of all cells]")


@click.command(epilog=example("dengine verify engine.db"))
@click.argument("store", metavar="STORE")
@cell_option
@click.option(
    "--expect",
    metavar="DIGEST",
    help="A digest that an earlier check showed: the history must still hold it, or it was cut off or made anew.",
)
@json_option
@click.pass_context
def verify(context: click.Context, store: str, cell: str | None, expect: str | None, as_json: bool) -> None:
    """Check that a store's history is what was written.

    Every row is held against its sum, and every entry of the ledger against
    its rows; what was changed, is missing or was never chained is named, with
    exit code 1. Nothing is written, and engines may go on meanwhile.
    """
    from ..store.verification import count_rows, verify_history

    with progress("rows", count_rows(store, cell), quiet=as_json) as advance:
        report = verify_history(store, cell, expect, advance)
    if as_json:
        write_json({"verb": "verify", "store": store, "ok": report.ok} | _record(report))
    else:
        show(*_lines(report))
    if not report.ok:
        context.exit(1)


def _record(report: HistoryReport) -> dict[str, Any]:
    return {"cells": list(report.cells), "faults": list(report.faults)}


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


@click.command(epilog=example("dengine dump engine.db --out tables"))
@click.argument("store", metavar="STORE")
@cell_option
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path),
    help="The folder to write, new or of an earlier dump: a folder a cell, a Parquet file a table.",
)
@json_option
def dump(store: str, cell: str | None, out: Path, as_json: bool) -> None:
    """Write all that a store holds to Parquet files.

    Decisions come with their traces; labels, versions without their states,
    events, settings and the ledger as they are. Nothing changes in the store,
    and engines may go on meanwhile.
    """
    from ..store.dump import dump_store
    from ..store.verification import count_rows

    with progress("rows", count_rows(store, cell), quiet=as_json) as advance:
        made = dump_store(store, out, cell, advance)
    if as_json:
        write_json({"verb": "dump", "store": store, "out": str(out), "rows": made.rows})
        return
    show(f"Wrote {sum(made.rows.values()):,} rows to {out}, in {len(made.rows)} Parquet files.")
