"""The subcommand `dengine status`: how an engine is doing, as far as its store tells."""

from collections.abc import Iterator
from dataclasses import asdict, fields, replace
from typing import TYPE_CHECKING, Any

import click

from ..errors import outward, percent
from . import options
from .options import verb
from .output import (
    certificate_record,
    field_rows,
    format_duration,
    format_time,
    format_value,
    heading,
    print_result,
    table_of_records,
    table_of_rows,
)

if TYPE_CHECKING:
    from ..history.status import ErrorEstimate, Span, Status

VERDICTS = {"kept": "keeps to", "broken": "is beyond", "open": "may be beyond"}
# In shadow mode every part is verified: those are no audits, though they share the reason.
TITLES = {"false_accepts": "accepted, and bad", "audits": "certain but checked"}
# Fields of a status that have lines or tables of their own.
SHOWN_ELSEWHERE = (
    "newest",
    "ever",
    "recipe",
    "trace",
    "certificate",
    "retrains",
    "events",
    "settings",
    "last",
)
ONLY_WHILE_RUNNING = ("retraining", "store_lag")


@verb("dengine status engine.db --last 500")
@options.store_argument
@click.option(
    "--last",
    type=options.COUNT,
    default=500,
    help="How many of the newest decisions have a column of their own.",
)
@options.check_option
def status(store: str, last: int, check_seconds: float) -> None:
    """Show how an engine is doing, and what its store holds.

    STORE is the file or URL of the engine's store (its database), as given to `dengine train` or
    `dengine run`, and must exist. An engine may run on it meanwhile. If it holds several robot
    cells and none is named, they are only listed; cells of one product (the kind of part that they
    make) share labels and versions of the model. A damaged label or version that is read is
    recorded as an event in the store's log. The interval of bad accepted parts is valid if you look
    once; the certificate, an upper bound on their share, is valid however often you look. If the
    model would have accepted or rejected parts that were verified, like in shadow mode (every part
    is verified), a line says how much time that would have saved, at `--check-seconds` for each
    check.
    """
    from ..history.status import status as read_status
    from ..representation import to_jsonable
    from ..store.opening import open_store
    from ..store.peers import list_cells
    from ..store.records import CellAddress, address

    if not isinstance(store, CellAddress):
        cells = list_cells(store)
        if len(cells) > 1:
            print_result(
                {"store": store, "cells": cells},
                table_of_records(store, cells, *asdict(cells[0])),
                "Name one of them, --cell NAME, to see how it is doing.",
            )
            return
        store = address(store, cells[0].cell_id)
    with open_store(store, must_exist=True) as opened:
        report = read_status(opened, last, watching=True)
    record = {"store": store} | to_jsonable(report)
    record["certificate"] = certificate_record(report.certificate)
    parts = [_overview_table(store, report), table_of_rows("What it is", _present_rows(report))]
    n_certain = report.ever.would_accept.n + report.ever.would_reject.n
    if n_certain:
        seconds = format_duration(n_certain * check_seconds)
        parts.append(
            f"It would have decided {n_certain:,} of the {report.ever.verified:,} parts that were "
            f"verified: {seconds} of checks at {format_duration(check_seconds)}."
        )
    print_result(record, *parts)


def _overview_table(store: str, report: "Status") -> Any:
    """Return a rich Table of the counts and shares in a store's status, accepted bad parts first.

    It has a row for each field of a `Span`, with a column for the newest decisions, and one for all
    decisions since the store was made. `store`, its address, stands in the title.
    """
    spans = (report.newest, report.ever)
    names = [field.name for field in fields(report.ever)]
    names.sort(key=lambda name: name != "false_accepts")  # what is bad comes first
    rows = [
        [TITLES.get(name, heading(name)), *(_span_cell(name, span) for span in spans)]
        for name in names
    ]
    return table_of_rows(
        f"{store}: overview", rows, ("", f"last {report.newest.decisions:,}", "since birth")
    )


def _present_rows(report: "Status") -> Iterator[tuple[str, str]]:
    """Yield rows of a table, (title, text), on the present state of an engine, an alarm first.

    They are the robot cell; the fields of the status that are not empty, except those that other
    rows or another table show (`SHOWN_ELSEWHERE`) and those that only a running engine knows; the
    recipe (all settings of the engine); the `TraceSpec` (shape, rate and unit of traces); two
    sentences of the certificate, which bound the shares of the accepted and of the rejected parts
    that were decided wrongly; the last and the slowest retrain; and the newest events, with a row
    for each, the newest first. An alarm, or a retrain, has a row only if there is one. The recipe
    is left out if the model was handed in by the user, because the recipe has no effect on it. If
    the policy has no audits (checks of parts of which the model is certain), the counts with the
    name "audit" are called "certain but checked": they come from shadow mode, in which every part
    is verified.
    """
    if report.alarm:
        yield "look at", report.alarm
    yield "cell", report.cell
    shown = report
    if not report.recipe.policy.audit_rate:
        shown = replace(
            report, reasons=_without_audits(report.reasons), sources=_without_audits(report.sources)
        )
    yield from field_rows(shown, "cell", *SHOWN_ELSEWHERE, *ONLY_WHILE_RUNNING)
    if report.model is None:
        # The recipe has no effect on a model that was handed in.
        yield from field_rows(report.recipe)
    trace_text = "none yet: the first trace sets it"
    if report.trace is not None:
        trace_text = format_value("", report.trace)
        for name in ("rate_hz", "unit"):
            if getattr(report.trace, name) is None:
                trace_text += f", {heading(name)} unknown"
    yield "trace", trace_text
    yield "accepted", report.certificate.sentence
    yield "rejected", report.certificate.sentence_on_rejects
    retrains = [version.report for version in report.retrains]
    if retrains:
        slowest = max(retrains, key=lambda retrain: retrain.seconds)
        yield "last retrain", format_value("", retrains[-1])
        yield "worst retrain", format_value("", slowest)
    for event in reversed(report.events):
        yield "newest events", f"{format_time(event.time)} {event.kind}: {event.text}"


def _without_audits(counts: dict[str, int]) -> dict[str, int]:
    """Return counts with the key "audit" renamed to "certain but checked", in a new dict.

    For a policy without audits: what has that reason was verified in shadow mode. Without that key
    the counts are the same.
    """
    return {TITLES["audits"] if name == "audit" else name: n for name, n in counts.items()}


def _span_cell(name: str, span: "Span") -> str:
    """Return the text of a field of a `Span`: a time, a number, or a share of wrong decisions.

    A `Span` has the counts over the newest decisions, or over all, and `name` names its field. The
    text on a share has its interval, and says whether it keeps to the tolerance, the share that the
    policy allows (see `_error_cell`); it is "none was accepted" for the share of bad accepted parts
    if no part was accepted.
    """
    value = getattr(span, name)
    if name in ("first", "last"):
        return format_time(value)
    if name == "bad_accepts" and not span.accepted:
        return "none was accepted"
    return _error_cell(value) if hasattr(value, "verdict") else format_value(name, value)


def _error_cell(estimate: "ErrorEstimate") -> str:
    """Return a text on a share of wrong decisions: counts, interval, verdict.

    The verdict says whether the share keeps to the tolerance (the share that the policy allows), is
    beyond it, or may be beyond it (open). If the interval rests on no outcomes (`n_known` is 0),
    the counts are left out; if it then also begins at 0 and the verdict is open, the text is "none
    is known". Its lower end can then be above 0 only if bad accepted parts stopped the line. The
    interval is rounded outward to 0.1 %. `estimate` has the interval, the verdict, and the counts
    of the outcomes.
    """
    if not estimate.n_known and not estimate.lower and estimate.verdict == "open":
        return "none is known"
    basis = ""
    if estimate.n_known:
        basis = f"{estimate.n_wrong:,} of {estimate.n_known:,} by {estimate.basis}: "
    interval = "{:.1f} to {:.1f} %".format(*outward(100 * estimate.lower, 100 * estimate.upper, 1))
    verdict = f"{VERDICTS[estimate.verdict]} {percent(estimate.tolerance, 'g')}"
    return f"{basis}{interval}, {verdict}"
