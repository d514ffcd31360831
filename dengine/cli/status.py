"""`dengine status`: how an engine is doing by its store, what the store holds, and who shares it."""

from contextlib import closing
from dataclasses import asdict, fields, replace
from typing import TYPE_CHECKING, Any

import click

from ..errors import percent
from . import options
from .options import verb
from .output import certificate_record, duration, facts, heading, listed, rows_of, tell, when, written

if TYPE_CHECKING:
    from ..history.status import ErrorEstimate, Span, Status

WORDS = {"kept": "keeps to", "broken": "is beyond", "open": "may be beyond"}
# Parts of the shadow mode are no audits, though they have their reason.
TITLES = {"false_accepts": "accepted, and bad", "audits": "certain but checked"}
APART = ("newest", "ever", "recipe", "trace", "certificate", "retrains", "events", "settings", "last")
ELSEWHERE = ("retraining", "store_lag")  # of an engine that runs
LAST = "The newest so many decisions, looked at apart."


@verb("dengine status engine.db --last 500")
@options.store_argument
@click.option("--last", type=options.COUNT, default=500, show_default=True, help=LAST)
@options.check_option
def status(store: str, last: int, check_seconds: float) -> None:
    """Say how an engine is doing, and what its store holds.

    STORE is the file or URL that the engine remembers in, as given to `dengine train` or `dengine run`. Where it holds
    several cells and none is named, they are listed; cells of one product share labels and versions. The interval of bad
    accepted parts is of one look; what is certified holds however often one looks.
    """
    from ..history.status import status as status_of
    from ..representation import to_jsonable
    from ..store.opening import open_store
    from ..store.peers import list_cells
    from ..store.records import CellAddress, address

    if not isinstance(store, CellAddress):
        first, *others = cells = list_cells(store)
        if others:
            said = "Name one of them, --cell NAME, and how it is doing is shown."
            tell({"store": store, "cells": cells}, listed(store, cells, *asdict(first)), said)
            return
        store = address(store, first.cell_id)
    with closing(open_store(store, must_exist=True)) as opened:
        found = status_of(opened, last, watching=True)
    n, checked = found.ever.would_accept.n + found.ever.would_reject.n, found.ever.verified
    saved = f"{duration(n * check_seconds)} of checks at {duration(check_seconds)}"
    would = [f"It would have decided {n:,} of the {checked:,} parts that were verified: {saved}."] if n else []
    record = {"store": store} | to_jsonable(found) | {"certificate": certificate_record(found.certificate)}
    tell(record, *_tables(store, found), *would)


def _tables(store: str, found: "Status") -> list[Any]:
    """A column each for the newest decisions and for all; and what is of now."""
    columns, both = ("", f"last {found.newest.decisions:,}", "since birth"), (found.newest, found.ever)
    # what is bad comes first
    names = sorted((each.name for each in fields(found.ever)), key=lambda name: name != "false_accepts")
    spans = [[TITLES.get(name, heading(name)), *(_of_span(name, span) for span in both)] for name in names]
    now = [("look at", found.alarm)] if found.alarm else []
    shown = found
    if not found.recipe.policy.audit_rate:
        shown = replace(found, reasons=_without_audits(found.reasons), sources=_without_audits(found.sources))
    now += [("cell", found.cell), *rows_of(shown, "cell", *APART, *ELSEWHERE)]
    if found.model is None:  # of one that was handed in the recipe has no effect: to show it would be a lie
        now += rows_of(found.recipe)
    now += [("trace", "none yet: the first trace sets it" if found.trace is None else written("", found.trace))]
    now += [("accepted", found.certificate.sentence), ("rejected", found.certificate.sentence_on_rejects)]
    if reports := [each.report for each in found.retrains]:
        now += [("last retrain", written("", reports[-1]))]
        now += [("worst retrain", written("", max(reports, key=lambda each: each.seconds)))]
    now += [("newest events", f"{when(each.time)} {each.kind}: {each.text}") for each in reversed(found.events)]
    return [facts(f"{store}: overview", spans, columns), facts("What it is", now)]


def _without_audits(counts: dict[str, int]) -> dict[str, int]:
    return {TITLES["audits"] if name == "audit" else name: n for name, n in counts.items()}


def _of_span(name: str, span: "Span") -> str:
    value = getattr(span, name)
    if name in ("first", "last"):
        return when(value)
    if name == "bad_accepts" and not span.accepted:
        return "none was accepted"
    if name == "would_accept" and value.n_known and span.bad_accepts.basis == value.basis:
        return "as bad accepts, below"  # the same parts
    stops = span.false_accepts if name == "bad_accepts" else 0
    return _held(value, stops) if hasattr(value, "verdict") else written(name, value)


def _held(said: "ErrorEstimate", stops: int) -> str:
    """An interval of the share of wrong ones, held against what is tolerated; first the stops that no share tells."""
    first = f"{stops:,} stop{'s' * (stops > 1)}; " if stops and said.basis != "every outcome" else ""
    if not said.n_known and said.verdict == "open":
        return first + ("else unknown" if stops else "none is known")
    between = f"{100 * said.lower:.1f} to {percent(said.upper)}"
    by = f"{said.n_wrong:,} of {said.n_known:,} by {said.basis}: " if said.n_known else ""
    return f"{first}{by}{between}, {WORDS[said.verdict]} {percent(said.tolerance, 'g')}"
