"""The subcommands that change, check or copy a store by hand: `report`, `correct`, `forget`,
`rollback`, `release`, `policy`, `retrain`, `verify`, `backup`, `restore` and `import-labels`.

Those up to `retrain` change a store's engine, or show its policy; `verify` checks the store's
history, `backup` copies it, `restore` puts a copy in place, and `import-labels` takes the labels of
an exported cell.
"""

from __future__ import annotations

import getpass
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from . import options
from .options import POLICY, NameChoice, verb
from .output import certificate_record, field_rows, print_result, progress_bar, table_of_rows

if TYPE_CHECKING:
    from ..engine.corrections import Changed
    from ..engine.engine import DataEngine
    from ..store.verification import HistoryReport

LABELS = {"good": True, "bad": False}
MOST_FAULTS = 20  # that are shown


def _login_name() -> str:
    """Return the login name of the user who runs the command, "" if the system has none."""
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):  # in a container a user's number may have no name
        return ""


shadow_option = click.option(
    "--shadow",
    type=click.Choice(["on", "off"]),
    callback=lambda context, option, state: None if state is None else state == "on",
    help=(
        "on: verify every part, and only record what the model would have done. off: let it decide."
    ),
)
interval_option = click.option(
    "--interval", type=NameChoice("interval"), help="The confidence interval."
)
author_option = click.option(
    "--author",
    default=_login_name,
    show_default=False,
    help="Who makes the change, for the record.  [default: the login name]",
)


part_argument = click.argument("part", metavar="PART|ID")
label_argument = click.argument("label", metavar="good|bad", type=click.Choice(list(LABELS)))


def store_options(command: options.Command) -> options.Command:
    """Add STORE, `--cell`, `--author` and `--allow-import`, for a subcommand that changes an
    engine.

    Returns the command with these options; STORE and the robot cell reach it as one address,
    `store`. The author is the login name if none is given, or "" if the system has none.
    """
    return options.store_argument(options.allow_import_option(author_option(command)))


def _change_and_print(
    change: Callable[[DataEngine, str], Changed], store: str, author: str, allow_import: bool
) -> None:
    """Open the store's engine, call `change` with it and the author, and print what changed.

    `change` returns a `Changed`, whose text is printed after the engine was closed, with the number
    of the event that records the change; the text may say that nothing changed. With `--json` a
    document is printed instead, which also has the policy (the settings of decisions) and the
    certificate (the bounds on the shares of wrong decisions) after the change. `allow_import`
    permits to import the reducer (which maps traces to points) or decision rule, module:Class, that
    the store names. The engine waits up to 10 s for the disk or database. Raises the errors of
    `DataEngine.open` (StoreError if an engine runs on the robot cell), those of
    `DataEngine.certificate`, and whatever `change` raises; nothing is printed then. An error of
    `certificate` comes after the change, which stays.
    """
    from ..engine.engine import DataEngine
    from ..store.opening import LONG_WAIT

    with DataEngine.open(store, wait=LONG_WAIT, allow_import=allow_import) as engine:
        changed = change(engine, author)
        certificate = engine.certificate()
    event = ""
    if changed.event is not None:
        event = f" Event {changed.event}, by {author or 'nobody named'}."
    print_result(
        {"store": store, "author": author, "changed": changed.event is not None}
        | asdict(changed)
        | {"policy": engine.policy, "certificate": certificate_record(certificate)},
        f"{changed.text}{event}",
    )


@verb("dengine report engine.db import-d684ff7e4dbab839-0 bad")
@store_options
@part_argument
@label_argument
def report(part: str, label: str, **changing: Any) -> None:
    """Report whether a part was good or bad.

    Name the part by its number, or by the id of its decision. The number is enough if the part has
    one decision, or one that is no reject; otherwise it is refused, and so is a part that is not in
    the store. For an accepted part, bad is a line stop (the part stopped the line), and good a
    confirmation. For a rejected part the label is that of an inspection: the engine trains on it,
    but the rule that accepts and rejects does not learn from it. An event in the store's log
    records the report. A retrain that is due then runs. The label that the decision has already,
    reported or corrected, changes nothing. Another label is refused with exit code 1, unless it is
    a line stop after a confirmation, and so is any label after `dengine forget`, which withdraws
    labels; `dengine correct` puts either right. Only the newest 20 decisions on the part are looked
    at. The subcommand is refused while an engine runs on the robot cell. A store that names a
    reducer or rule of your own, module:Class, needs --allow-import.
    """
    from ..engine.corrections import Changed
    from ..history.explain import find_decision_id

    def change(engine: DataEngine, author: str) -> Changed:
        """Report the label and record an event; if the decision has that label already, do nothing,
        and return a `Changed` without an event that says so.
        """
        id_ = find_decision_id(engine.store, part)
        stored = engine.find(id_)
        if stored is not None and stored.success is LABELS[label]:
            return Changed(
                "report",
                f"Decision {id_} was {label} already; nothing changed.",
                None,
                engine.version,
            )
        engine.report(id_, LABELS[label])
        event = engine.store.events.put("report", f"decision {id_} was {label}", author=author)
        return Changed("report", f"Decision {id_} was {label}.", event, engine.version)

    _change_and_print(change, **changing)


@verb("dengine correct engine.db import-d684ff7e4dbab839-0 good")
@store_options
@part_argument
@label_argument
def correct(part: str, label: str, **changing: Any) -> None:
    """Correct a wrong label: the part was good, or bad.

    The part is named by its number, or by the id of its decision, as for `dengine report`. From now
    on its decision counts with the corrected label. The label as it was reported stays in the
    store, and so does the decision; the correction is a later row, and an event in the store's log.
    A label that `dengine forget` withdrew counts again. If the corrected label counts already,
    nothing changes. An unknown decision, and one without a label, is refused with exit code 1. The
    subcommand is refused while an engine runs on the robot cell.
    """
    from ..history.explain import find_decision_id

    _change_and_print(
        lambda engine, author: engine.correct(
            find_decision_id(engine.store, part), LABELS[label], author
        ),
        **changing,
    )


@verb("dengine forget engine.db import-ad72a2e9751fbf6f-0 --reason 'the fixture was bent'")
@store_options
@click.argument("decisions", metavar="ID...", nargs=-1, required=True)
@click.option("--reason", default="", show_default=False, help="Why, for the record.")
def forget(decisions: tuple[str, ...], reason: str, **changing: Any) -> None:
    """Leave labels out of everything that is learned and counted.

    Nothing is deleted: traces and labels stay in the store, and `dengine correct` brings a label
    back. If one of the decisions is unknown or has no label, none is forgotten, and the exit code
    is 1. A pinned version that was trained with one of them is released. The subcommand is refused
    while an engine runs on the robot cell.
    """
    _change_and_print(
        lambda engine, author: engine.forget(*decisions, author=author, reason=reason), **changing
    )


@verb("dengine rollback engine.db 1")
@store_options
@click.argument("version", type=int)
def rollback(version: int, **changing: Any) -> None:
    """Use an earlier model version again, as a new version.

    Labels that came since are among its references, and corrections count. It is pinned: no
    automatic retrain replaces it, until `dengine release` or `dengine retrain`, or until a label
    that it was trained with is forgotten. A version that is not kept is refused; the message has
    the numbers of the versions that are kept. The subcommand is refused while an engine runs on the
    robot cell.
    """
    _change_and_print(lambda engine, author: engine.rollback(version, author), **changing)


@verb("dengine release engine.db")
@store_options
def release(**changing: Any) -> None:
    """Let retrains replace the version that `rollback` pinned.

    If none is pinned, nothing changes. The subcommand is refused while an engine runs on the robot
    cell.
    """
    _change_and_print(lambda engine, author: engine.release(author), **changing)


@verb("dengine policy engine.db --alpha 0.1 --lower-bound 0.9")
@store_options
@options.bundle_options(
    "settings",
    dict,
    POLICY | {"interval": interval_option, "shadow": shadow_option},
)
def policy(store: str, settings: dict[str, Any], author: str, allow_import: bool) -> None:
    """Show the policy in force, or change it.

    The policy is the settings of the decisions. Without options it is shown, even while an engine
    runs on the robot cell; a change is refused then. A change is recorded as an event in the
    store's log; settings that are in force already change nothing. A setting that is not given
    stays as it is, with one exception: --prices without --guarantee also changes the guarantee
    (what is promised of the decisions) from local or pooled to cost, and then the audit rate (the
    share of parts of which the model is certain and that are verified all the same) from 0 to 0.05,
    unless --audit-rate is given.

    Earlier decisions keep their bounds. The certificate, which bounds the share of wrong decisions,
    starts again after any change. The rule that decides also forgets what it learned, after a
    change of --alpha, --lower-bound, --interval, --guarantee, --stops or --prices, and, under the
    guarantees pooled and cost with --stops some, of --audit-rate: a tolerance (the share of wrong
    decisions that is allowed) that is chosen after the data was seen needs fresh evidence. A store
    whose engine needs a model or reducer that was handed in as an object is refused, with and
    without options. Shadow mode (--shadow on) lasts over restarts; `dengine status` counts what the
    model would have done, and how much of it was wrong.
    """
    if settings:
        _change_and_print(
            lambda engine, by: engine.set_policy(engine.policy.changed(**settings), by),
            store,
            author,
            allow_import,
        )
        return
    from ..engine.engine import DataEngine

    # Read-only: the cell may run meanwhile.
    with DataEngine.open(store, reading=True, allow_import=allow_import) as engine:
        in_force = engine.policy
    print_result(
        {"store": store, "changed": False, "policy": in_force},
        table_of_rows(f"{store}: the policy in force", field_rows(in_force)),
    )


@verb("dengine retrain engine.db")
@store_options
def retrain(store: str, author: str, allow_import: bool) -> None:
    """Train now, on the store's labels with all corrections.

    A version is a trained model. An event in the store's log records the training, also if its
    version is dropped. If `dengine rollback` pinned a version, so that no automatic retrain
    replaces it, this ends first, and has ended also if the new version is dropped. If the time that
    a retrain may take (the recipe's time budget) ends before the training does, the output says how
    many steps are to go, and the next retrain continues. If the training fails or has no label to
    train on, or the new version fails its tests or cannot be stored, it is dropped, the previous
    version stays in use, and the exit code is 1. The subcommand is refused while an engine runs on
    the robot cell.
    """
    from ..engine.engine import DataEngine
    from ..experiments.tables import retrain_line
    from ..store.opening import LONG_WAIT

    with DataEngine.open(store, wait=LONG_WAIT, allow_import=allow_import) as engine:
        report = engine.retrain()
        engine.store.events.put(
            "retrain",
            f"trained by hand on {report.n_traces} traces: {report.reason}",
            asdict(report),
            author,
        )
    answers = f"Version {report.version} answers." if report.version else "No version answers yet."
    remark = f" It was {report.reason}." if report.accepted else ""
    print_result(
        {"store": store, "author": author, "retrain": report},
        f"{answers} {retrain_line([report])}{remark}",
    )
    if not report.accepted:
        raise click.ClickException(f"The retrain was {report.reason}.")


@verb("dengine verify engine.db")
@click.argument("store")
@click.option("--cell", metavar="ID", help="Check this cell alone.  [default: all cells]")
@click.option(
    "--expect",
    metavar="DIGEST",
    help=(
        "A digest that an earlier check showed. If the history does not hold it any more, it was "
        "cut off or made anew."
    ),
)
@click.option(
    "--acknowledge",
    is_flag=True,
    help="End the alarms about lost data. They stay in the event log.",
)
@author_option
@click.pass_context
def verify(
    context: click.Context,
    store: str,
    cell: str | None,
    expect: str | None,
    acknowledge: bool,
    author: str,
) -> None:
    """Check that a store's history is what was written.

    Every row is compared with its checksum, and every entry of the ledger, a chain of digests over
    the rows, with its rows. The subcommand lists what is wrong, at most 20 faults (--json: all):
    damage of an SQLite file; rows, settings and entries that were changed, added or removed;
    damaged or missing records of a journal (the file on a cell's disk that gets each record before
    the store does); data that was lost and that nobody has acknowledged; and a digest, --expect,
    that the history does not hold. If there are any, the exit code is 1. For each cell it shows the
    number of entries and rows, and the newest digest: keep it elsewhere for --expect. It also says
    if a cell's journal is missing or cannot be read, or holds records that the store lacks; none of
    these alone is a fault. The subcommand writes rows only with --acknowledge, after which it
    checks again (an SQLite file is set to WAL mode if it is not). Engines may run meanwhile.
    """
    from ..store.sql import SqlStore
    from ..store.verification import verify_history

    with progress_bar("rows", None) as advance:
        report = verify_history(store, cell, expect, advance)
        if acknowledge:
            for item in report.cells:
                with SqlStore(store, item.cell_id) as opened:
                    opened.events.acknowledge_losses(author)
            report = verify_history(store, cell, expect, advance)
    print_result(
        {"store": store, "ok": report.ok, "cells": report.cells, "faults": report.faults},
        *_verification_lines(report),
    )
    if not report.ok:
        context.exit(1)


def _verification_lines(report: HistoryReport) -> Iterator[str]:
    """Yield the lines that say what a check of a store's history found.

    For each robot cell they say how many rows it has, how many entries its ledger (a chain of
    digests over the rows), and the newest digest. They also say if the cell's journal, the file
    that gets each record before the store does, is not here or cannot be read, or holds records
    that the store lacks. Then come the differences that were found (`report.faults`), at most 20,
    how many more there are, and whether everything is as it was written.
    """
    for cell in report.cells:
        yield (
            f"Cell {cell.cell_id}: {cell.entries:,} entries over {cell.rows:,} rows, newest digest "
            f"{cell.digest or 'none'}"
        )
        if cell.waiting is None:
            yield (
                f"The journal of cell {cell.cell_id} is not here: its records are not in this "
                "check, and it does not show if the newest entries were cut off. A copy that "
                "dengine backup made lacks nothing."
            )
        elif cell.waiting:
            yield (
                f"The journal of cell {cell.cell_id} holds {cell.waiting:,} records that are not "
                "in the store yet; its engine, or the next one, moves them there."
            )
    for fault in report.faults[:MOST_FAULTS]:
        cell_text = fault.cell_id and f"cell {fault.cell_id}:"
        yield " ".join(filter(None, (cell_text, fault.table, fault.key, f"{fault.problem}.")))
    if len(report.faults) > MOST_FAULTS:
        yield f"And {len(report.faults) - MOST_FAULTS} more; --json shows all."
    if report.ok:
        yield (
            "Everything is as it was written. Keep the digest elsewhere, and give it to --expect "
            "next time."
        )
    else:
        yield f"Faults: {len(report.faults)}. This history is not as it was written."


@verb("dengine backup engine.db --out copy.db")
@click.argument("store")
@click.option(
    "--out",
    required=True,
    type=options.FILE,
    help="The copy; a file that does not exist yet.",
)
def backup(store: str, out: Path) -> None:
    """Copy a store while it is in use.

    The copy is one file with all robot cells and with the records in the journals that lie beside
    the store; a plain copy of the file lacks these. A journal is the file on a cell's disk that
    gets each record before the store does. The copy can be opened, and checked by `dengine verify`,
    wherever it is. Damaged records of a journal are left out, and a record that contradicts the
    store becomes an event of kind "dead letter" in the copy. Cells without a journal are named. A
    store in PostgreSQL is refused (pg_dump copies it), and so are an --out that exists, a journal
    that cannot be read, and one with records, if the cell's ledger (a chain of digests over the
    rows) has another key than the file that DENGINE_LEDGER_KEY names.
    """
    from ..store.backup import backup_store

    report = backup_store(store, out)
    without_journal = [
        f"No journal of cell {cell} lies beside {store}: its records, if any, are not in the copy."
        for cell in report.without_journal
    ]
    print_result(
        {"store": store, "out": out} | asdict(report),
        f"{out}: {report.decisions:,} decisions and {report.labels:,} labels; "
        f"{report.from_journals:,} records came from journals that lie beside the store.",
        *without_journal,
        f"Check it: dengine verify {out}",
    )


@verb("dengine restore backup.db --store restored.db")
@click.argument("copy")
@click.option(
    "--store",
    required=True,
    type=options.FILE,
    help="Where the engine looks for its store; a file that does not exist yet.",
)
def restore(copy: str, store: Path) -> None:
    """Put a backup in the place of a store.

    COPY is what `dengine backup` wrote, on this or another machine. It is checked first. It is
    refused with exit code 1 if `dengine verify` would find a fault in it, even lost data alone that
    nobody has acknowledged, if its ledger (a chain of digests over the rows) has another key than
    the file that DENGINE_LEDGER_KEY names, or if --store exists. Beside --store each robot cell
    gets a journal, the file that gets each record before the store does. It names the newest entry
    of the cell's ledger, by which the next engine sees that the store is complete. A journal that
    is there already stays, and that engine takes from it what the copy lacks; if the journal names
    entries that the copy lacks, it raises an alarm. Records of journals beside COPY are added to
    the store. If a journal cannot be made, the exit code is 1, and the store stays.
    """
    from ..store.backup import restore_store

    cells = restore_store(copy, store)
    print_result(
        {"copy": copy, "store": store, "cells": cells},
        f"{store}: cells {', '.join(cell.cell_id for cell in cells)}, as they were written.",
        f"Check it: dengine verify {store}",
    )


@verb("dengine import-labels cell.csv --store engine.db")
@click.argument("journal", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@options.store_option("The store that the cell's model was exported from.", "--cell", required=True)
@click.option(
    "--any-model",
    is_flag=True,
    help="Accept a journal of a model that is not recorded as an export of this store.",
)
def import_labels(journal: Path, store: str, any_model: bool) -> None:
    """Import the labels of an exported model's program.

    An exported model decides in a robot cell without the engine, and the program that runs it
    writes JOURNAL, a CSV file. Each line counts once, however often it is imported; a label that
    contradicts the store's is counted, but not stored. If the policy in the store has --stops all
    (every bad accepted part stops the system), an accepted part without a report is imported as
    good, unless it is the last part; with --stops some it is imported without a label. Other parts
    without a label are left out. A part whose trace has a fault (like a NaN, or equal samples) is
    stored, but never used in training.

    If a line was changed or is missing, the lines before it are imported, the others are not, and
    the exit code is 1. A file that is no journal, has no accepted or labelled part, has a line that
    cannot be read, or belongs to another model (unless --any-model, or the store records no export)
    is refused as a whole. The subcommand is refused while an engine runs on the robot cell.
    """
    from ..export.cell_journal import import_journal

    report = import_journal(store, journal, any_model=any_model)
    print_result(
        {"store": store, "journal": journal} | asdict(report),
        table_of_rows(f"{journal} into {store}", field_rows(report, "set_aside")),
    )
    if report.set_aside:
        raise click.ClickException(report.set_aside)
