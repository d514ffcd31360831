"""What is done to a store by hand: `dengine correct`, `forget`, `rollback`, `policy`, `retrain`, `verify` and others."""

from __future__ import annotations

import getpass
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from . import options
from .options import POLICY, Known, verb
from .output import certificate_record, facts, progress, rows_of, tell

if TYPE_CHECKING:
    from ..engine.corrections import Changed
    from ..engine.engine import DataEngine
    from ..store.verification import HistoryReport

LABELS = {"good": True, "bad": False}
SHOWN = 20  # faults that a screen shows


def _login() -> str:
    """The login name; "" where the system has none for this user."""
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):  # in a container a number may have no name
        return ""


shadow_option = click.option(
    "--shadow",
    type=click.Choice(["on", "off"]),
    callback=lambda context, option, state: None if state is None else state == "on",
    help="Verify every part, and let the model only say what it would have done; or let it decide again.",
)
interval_option = click.option("--interval", type=Known("interval"), help="The confidence interval.")
author_option = click.option("--author", default=_login, help="Who says so, for the record.  [default: the login name]")


def on_store(command: Callable[..., Any]) -> Callable[..., Any]:
    """Which store's engine is changed, by whom, and whether what it names may be imported."""
    return options.store_argument(options.allow_import_option(author_option(command)))


def _changed(store: str, author: str, allow_import: bool, change: Callable[[DataEngine], Changed]) -> None:
    """Open the store's engine, change something, and say what happened."""
    from ..engine.engine import DataEngine
    from ..store.opening import UNHURRIED

    with DataEngine.open(store, wait=UNHURRIED, allow_import=allow_import) as engine:
        changed = change(engine)
        certificate, policy = engine.certificate(), engine.policy
    recorded = "" if changed.event is None else f" Event {changed.event}, by {author or 'nobody named'}."
    record = {"store": store, "author": author, "changed": changed.event is not None} | asdict(changed)
    tell(record | {"policy": policy, "certificate": certificate_record(certificate)}, f"{changed.text}{recorded}")


@verb("dengine report engine.db import-d684ff7e4dbab839-0 bad")
@on_store
@click.argument("part", metavar="PART|ID")
@click.argument("label", metavar="good|bad", type=click.Choice(list(LABELS)))
def report(store: str, part: str, label: str, author: str, allow_import: bool) -> None:
    """Report what became of a part.

    It is named by its number, where one decision was made on it, or by that decision's id. An accepted part that was bad
    is a system stop; a rejected one that was looked at afterwards is an inspection, which trains. A label that is
    wrong is put right by `dengine correct`.
    """
    from ..engine.corrections import Changed
    from ..history.explain import find_decision_id

    def change(engine: DataEngine) -> Changed:
        id_ = find_decision_id(engine.store, part)
        if (known := engine.find(id_)) is not None and known.success is LABELS[label]:
            return Changed("report", f"Decision {id_} was {label} already; nothing changed.", None, engine.version)
        engine.report(id_, LABELS[label])
        engine.store.put_event("report", f"decision {id_} was {label}", author=author)
        return Changed("report", f"Decision {id_} was {label}.", engine.store.events(1)[-1].number, engine.version)

    _changed(store, author, allow_import, change)


@verb("dengine correct engine.db import-d684ff7e4dbab839-0 bad")
@on_store
@click.argument("part", metavar="PART|ID")
@click.argument("label", metavar="good|bad", type=click.Choice(list(LABELS)))
def correct(store: str, part: str, label: str, author: str, allow_import: bool) -> None:
    """Say that a label was wrong: the part was good, or bad.

    The part is named as for `dengine report`; from now on its decision counts so. The label as it was reported stays
    in the store, and so does what was decided; the correction is a later row. A forgotten label counts again by it.
    """
    from ..history.explain import find_decision_id

    def change(engine: DataEngine) -> Changed:
        return engine.correct(find_decision_id(engine.store, part), LABELS[label], author)

    _changed(store, author, allow_import, change)


@verb("dengine forget engine.db import-ad72a2e9751fbf6f-0 --reason 'the fixture was bent'")
@on_store
@click.argument("decisions", metavar="ID...", nargs=-1, required=True)
@click.option("--reason", default="", help="Why, for the record.")
def forget(store: str, decisions: tuple[str, ...], reason: str, author: str, allow_import: bool) -> None:
    """Leave labels out of all that is learned and counted.

    Nothing is deleted: traces and labels stay in the store, and `dengine correct` brings one back. All are forgotten, or,
    where one is unknown or has no label, none.
    """
    _changed(store, author, allow_import, lambda engine: engine.forget(*decisions, author=author, reason=reason))


@verb("dengine rollback engine.db 1")
@on_store
@click.argument("version", metavar="VERSION", type=int)
def rollback(store: str, version: int, author: str, allow_import: bool) -> None:
    """Let an earlier model version answer again, as a new one.

    Labels that came since are among its references, and corrections count.
    """
    _changed(store, author, allow_import, lambda engine: engine.rollback(version, author))


@verb("dengine policy engine.db --alpha 0.05 --lower-bound 0.95")
@on_store
@options.gathered("settings", options.given, POLICY | {"interval": interval_option, "shadow": shadow_option})
def policy(store: str, settings: dict[str, Any], author: str, allow_import: bool) -> None:
    """Show the policy in force, or decide by another one.

    What is not given stays as it is. Earlier decisions keep the bounds they were decided by. What the rule learned,
    and the certificate, start anew: a tolerance that is chosen after the data was seen needs fresh evidence. The shadow
    mode lasts over restarts; `dengine status` counts what the model would have done, and how much of that was wrong.
    """
    if settings:
        _changed(store, author, allow_import, lambda engine: engine.set_policy(replace(engine.policy, **settings), author))
        return
    from ..engine.engine import DataEngine

    with DataEngine.open(store, reading=True, allow_import=allow_import) as engine:  # the cell may run meanwhile
        now = engine.policy
    tell({"store": store, "changed": False, "policy": now}, facts(f"{store}: the policy in force", rows_of(now)))


@verb("dengine retrain engine.db")
@on_store
def retrain(store: str, author: str, allow_import: bool) -> None:
    """Train now, on the store's labels as they count.

    A candidate that fails its gate is dropped and recorded, and the version before goes on answering.
    """
    from ..engine.engine import DataEngine
    from ..experiments.tables import retrain_line
    from ..store.opening import UNHURRIED

    with DataEngine.open(store, wait=UNHURRIED, allow_import=allow_import) as engine:
        report = engine.retrain()
        text = f"trained by hand on {report.n_traces} traces: {report.reason}"
        engine.store.put_event("retrain", text, asdict(report), author)
    answers = f"Version {report.version} answers." if report.version else "No version answers yet."
    tell({"store": store, "author": author, "retrain": report}, f"{answers} {retrain_line([report])}")
    if not report.accepted:
        raise click.ClickException(f"The retrain was {report.reason}.")


NO_JOURNAL = (
    "The journal of cell {} is not here: what it held is not in this check, and newest entries that were "
    "cut off do not show. A copy that dengine backup made lacks nothing."
)
WAITING = "The journal of cell {} holds {:,} records that its engine, or the next one, brings into the store."
EXPECT = "A digest that an earlier check showed: the history must still hold it, or it was cut off or made anew."


@verb("dengine verify engine.db")
@click.argument("store", metavar="STORE")
@click.option("--cell", metavar="ID", help="Of this cell alone.  [default: of all cells]")
@click.option("--expect", metavar="DIGEST", help=EXPECT)
@click.pass_context
def verify(context: click.Context, store: str, cell: str | None, expect: str | None) -> None:
    """Check that a store's history is what was written.

    Every row is held against its sum, and every entry of the ledger against its rows; what was changed, is missing or was
    never chained is named, with exit code 1. Nothing is written, and engines may go on meanwhile.
    """
    from ..store.verification import verify_history

    with progress("rows", None) as advance:
        report = verify_history(store, cell, expect, advance)
    tell({"store": store, "ok": report.ok, "cells": report.cells, "faults": report.faults}, *_lines(report))
    if not report.ok:
        context.exit(1)


def _lines(report: HistoryReport) -> list[str]:
    lines = []
    for cell in report.cells:
        digest = cell.digest or "none"
        lines.append(f"Cell {cell.cell_id}: {cell.entries:,} entries over {cell.rows:,} rows, newest digest {digest}")
        if cell.waiting is None:
            lines.append(NO_JOURNAL.format(cell.cell_id))
        elif cell.waiting:
            lines.append(WAITING.format(cell.cell_id, cell.waiting))
    for fault in report.faults[:SHOWN]:
        where = " ".join(word for word in (fault.cell_id and f"cell {fault.cell_id}:", fault.table, fault.key) if word)
        lines.append(f"{where} {fault.problem}.")
    if len(report.faults) > SHOWN:
        lines.append(f"And {len(report.faults) - SHOWN} more; --json shows all.")
    if report.ok:
        return [*lines, "All is as it was written. Keep the digest elsewhere, and ask for it with --expect next time."]
    return [*lines, f"Faults: {len(report.faults)}. This history is not as it was written."]


@verb("dengine backup engine.db --out copy.db")
@click.argument("store", metavar="STORE")
@click.option("--out", metavar="FILE", required=True, type=options.FILE, help="The copy; a file that is not there yet.")
def backup(store: str, out: Path) -> None:
    """Copy a store while it is in use.

    The copy is one file with all cells and with what their journals hold, which a plain copy of the file
    lacks. It opens, and is checked by `dengine verify`, wherever it lies.
    """
    from ..store.backup import backup_store

    report = backup_store(store, out)
    text = f"{out}: {report.decisions:,} decisions and {report.labels:,} labels"
    lines = [f"{text}; {report.from_journals:,} records came from journals that lie beside the store."]
    lines += [
        f"No journal of cell {cell} lies beside {store}: what it held, if anything, is not in the copy."
        for cell in report.without_journal
    ]
    tell({"store": store, "out": out} | asdict(report), *lines, f"Check it: dengine verify {out}")


@verb("dengine import-labels cell.csv --store engine.db")
@click.argument("journal", metavar="JOURNAL", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@options.store_option("The store that the cell's model was exported from.", "--cell", required=True)
@click.option("--any-model", is_flag=True, help="Take a journal of a model that the store does not know as its export.")
def import_labels(journal: Path, store: str, any_model: bool) -> None:
    """Take a cell program's labels back into the store.

    JOURNAL is the CSV file that the program wrote. Each line counts once, however often it is imported. Where a line was
    changed or is missing, those before it are taken; the others are set aside, with exit code 1.
    """
    from ..export.cell_journal import import_journal

    report = import_journal(store, journal, any_model=any_model)
    table = facts(f"{journal} into {store}", rows_of(report, "set_aside"))
    tell({"store": store, "journal": journal} | asdict(report), table)
    if report.set_aside:
        raise click.ClickException(report.set_aside)
