"""`dengine status`: how an engine is doing by its store, what the store holds, and who shares it."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..errors import percent
from . import options
from .output import certificate_record, duration, facts, interruptible, show, when, write_json

if TYPE_CHECKING:
    from ..history.status import Judged, Span, Status
    from ..recipe import Recipe
    from ..store.peers import CellSummary

STEP = 0.05  # seconds between two looks for Ctrl-C
Rows = Iterator[tuple[str, str]]
WORDS = {"kept": "keeps to", "broken": "is beyond", "open": "may be beyond"}
GUARANTEES = {
    "local": "local: of the ball around each part, at one look",
    "pooled": "pooled: of all accepted parts together, however often one looks",
}
STOPS = {
    "some": "of some bad parts: silence after an accept says nothing",
    "all": "of all bad parts: an accepted part that no stop follows counts as good",
}
SHADOW = "all of what it is certain of: the shadow mode, in which it only says what it would have done"


LAST = "The newest so many decisions, looked at apart."
WATCH = "Show it again every so many seconds, 5 if none are given, until Ctrl-C; after STORE."
WATCHING: dict[str, Any] = {"type": click.FloatRange(0.1), "is_flag": False, "flag_value": 5.0, "metavar": "[SECONDS]"}


@click.command(epilog=options.example("dengine status engine.db --last 500"))
@options.store_argument
@options.cell_options()
@click.option("--last", type=options.COUNT, default=500, show_default=True, help=LAST)
@click.option("--watch", **WATCHING, help=WATCH)
@options.out_file_option
@options.force_option
@options.json_option
def status(store: str, last: int, watch: float | None, out: Path | None, force: bool, as_json: bool) -> None:
    """Say how an engine is doing, and what its store holds.

    STORE is the file or URL that the engine remembers in, as given to `dengine train` or `dengine run`. Where it holds
    several cells and none is named, they are listed; cells of one product share labels and versions. The interval of bad
    accepted parts is of one look; what is certified holds however often one looks.
    """
    if watch is not None and as_json:
        raise click.UsageError("--watch and --json exclude each other.")
    if out is not None:
        from ..files import check_output

        check_output(out, force)
    if cells := _several(store):
        if as_json:
            write_json({"verb": "status", "store": store, "cells": cells})
            return
        show(_cells_table(store, cells), "Name one of them, --cell NAME, and how it is doing is shown.")
        return
    found = _read(store, last, out)
    files = [] if out is None else [out]
    if as_json:
        from ..records import plain

        said = plain(found) | {"certificate": certificate_record(found.certificate)}
        write_json({"verb": "status", "store": store} | said | {"files": files})
        return
    show(*_tables(store, found), *(f"Wrote {path}" for path in files))
    with interruptible() as asked:  # Ctrl-C is how watching ends, so that is no failure
        while watch is not None:
            end = time.monotonic() + watch
            while (left := end - time.monotonic()) > 0:
                if asked():
                    return
                time.sleep(min(STEP, left))
            tables = _tables(store, _read(store, last, out))
            if sys.stdout.isatty():
                click.clear()
            show(*tables)


def _read(store: str, last: int, out: Path | None) -> Status:
    """The status, and its picture where one is asked for."""
    from ..history.status import course
    from ..history.status import status as status_of
    from ..store.base import open_store

    with closing(open_store(store, must_exist=True)) as opened:
        found = status_of(opened, last, watching=True)
        if out is not None:
            from ..experiments.figures import save, status_picture

            title = f"{found.cell}: {found.recipe.name}"
            save(status_picture(course(opened, found.recipe, last), title), out, force=True)
        return found


def _several(store: str) -> list[CellSummary]:
    """The cells of a database that holds others than the one that is meant where none is named; else none."""
    from ..store.base import must_be_there
    from ..store.peers import list_cells
    from ..store.records import CellAddress

    if isinstance(store, CellAddress):
        return []
    must_be_there(store)
    found = list_cells(store)
    return found if len(found) > 1 or found[0].cell_id != "cell" else []


def _cells_table(store: str, found: list[CellSummary]) -> Any:
    columns: dict[str, Callable[[CellSummary], str]] = {
        "cell": lambda cell: cell.cell_id,
        "product": lambda cell: cell.product or "-",
        "decisions": lambda cell: f"{cell.decisions:,}",
        "labels": lambda cell: f"{cell.labels:,}",
        "version": lambda cell: "-" if cell.version is None else str(cell.version),
        "last seen (UTC)": lambda cell: when(cell.last_seen, "%Y-%m-%d %H:%M:%S"),
    }
    if any(cell.owner for cell in found):
        columns["owner"] = lambda cell: cell.owner or "-"
    return facts(store, [tuple(cell_of(each) for cell_of in columns.values()) for each in found], tuple(columns))


def _tables(store: str, found: Status) -> list[Any]:
    """A column each for the newest decisions and for all; and what is of now."""
    alpha = found.recipe.policy.alpha
    spans = zip(_span_rows(found.newest, alpha), _span_rows(found.ever, alpha), strict=True)
    columns = ("", f"last {found.newest.decisions:,}", "since birth")
    doing = facts(f"{store}: how it is doing", [(name, new, old) for (name, new), (_, old) in spans], columns)
    now = [*_settings_rows(found), *_count_rows(found), *_promise_rows(found), *_retrain_rows(found)]
    now += [("newest events", f"{when(each.time)} {each.kind}: {each.text}") for each in reversed(found.events)]
    return [doing, facts("What it is", now)]


def _span_rows(span: Span, alpha: float) -> Rows:
    yield "from", when(span.first)
    yield "verified", _of(span.verified, span.decisions)
    yield "accepted", _of(span.accepted, span.decisions)
    yield "of them bad", _bad(span, alpha) if span.accepted else "none was accepted"
    yield "rejected", _of(span.rejected, span.decisions)
    yield "audits", _of(span.audits, span.decisions)
    yield "would accept", _would(span.would_accept, "bad")
    yield "would reject", _would(span.would_reject, "good")
    yield "novel", _of(span.novel, span.decisions)
    yield "safe mode", _of(span.safe_mode, span.decisions)
    yield "bad traces", f"{span.quarantined:,}" + (f", and {span.errors:,} model errors" if span.errors else "")
    yield "retrains", f"{span.retrains:,}, {sum(span.dropped.values()):,} dropped"
    yield "dropped for", "\n".join(f"{n}: {reason.removeprefix('dropped: ')}" for reason, n in span.dropped.items()) or "-"


def _of(some: int, of: int) -> str:
    return f"{some:,}" + (f" ({percent(some / of)})" if of else "")


def _bad(span: Span, alpha: float) -> str:
    """Known bad accepts, with what they say of all."""
    bad = span.bad_accepts
    if not bad.by:
        return f"{span.stops:,} known; of the others nothing is"
    lead = f"{bad.wrong:,} of {bad.known:,}{' audited' if bad.by == 'audits' else ''}"
    stops = f", beside {span.stops:,} stops" if bad.by == "audits" and span.stops else ""
    return f"{lead}{stops}: {_held(bad, f'alpha {alpha:g}')}"


def _would(said: Judged, wrong: str) -> str:
    """What checks said of parts that the model was certain of."""
    return f"{said.n:,} checked, {said.wrong:,} of them {wrong}: {_held(said, '95 %')}" if said.n else "none was checked"


def _held(said: Judged, level: str) -> str:
    """An interval, held against what is tolerated."""
    between = f"{100 * said.lower:.1f} to {percent(said.upper)} at {level}"
    return f"{between}, {WORDS[said.verdict]} {percent(said.tolerance, 'g')}"


def _settings_rows(found: Status) -> Rows:
    recipe, policy = found.recipe, found.recipe.policy
    if found.model is not None:  # reducer and numbers of the recipe have no effect: to show them would be a lie
        yield "model", f"{found.model}, decides by its own rule"
    else:
        yield "reducer", f"{recipe.name}, seed {found.settings.get('seed', '0')}"
        yield "policy", f"alpha {policy.alpha:g}, LB {percent(policy.lower_bound, 'g')}, {policy.interval} interval"
        yield "guarantee", GUARANTEES.get(policy.guarantee, policy.guarantee)
        yield "neighbours", _neighbours(recipe)
        yield "novelty", f"verified beyond {recipe.novelty:g} times the usual distance" if recipe.novelty else "off"
    yield "stops known", STOPS[policy.stops]
    yield "audits", SHADOW if found.shadow else f"{percent(policy.audit_rate, 'g')} of what it is certain of"
    schedule = f"every {recipe.retrain_every} new labels, within {duration(recipe.budget)}"
    yield "retrain", f"{schedule}, on the newest {recipe.window:,}"
    yield "trace", _contract(found)


def _neighbours(recipe: Recipe) -> str:
    if recipe.fraction is None:
        return f"within a radius of {recipe.radius:g}, in the unit of the scaled embedding"
    judged = "" if recipe.reject_fraction is None else f"; a rejection is judged by {percent(recipe.reject_fraction, 'g')}"
    return f"the nearest {percent(recipe.fraction, 'g')} of the references{judged}"


def _contract(found: Status) -> str:
    spec = found.trace
    if spec is None:
        return "none yet: the first trace sets it"
    channels = "" if spec.channels == 1 else f"{spec.channels} channels of "
    limit = "" if spec.limit is None else f", sensor limit {spec.limit:g} {spec.unit}"
    seconds = duration(spec.samples / spec.rate_hz)
    return f"{channels}{spec.samples} samples at {spec.rate_hz:g} Hz ({seconds}), in {spec.unit}{limit}"


def _count_rows(found: Status) -> Rows:
    yield "cell", found.cell
    if found.product is not None:
        yield "product", f"{found.product}: labels and versions are shared with its other cells"
    yield "decisions", f"{found.ever.decisions}: {_listed(found.actions)}"
    yield "reasons", _listed(found.reasons)
    yield "quarantined", str(found.ever.quarantined)
    yield "labels", f"{found.labels}: {_listed(found.sources)}"
    yield "labels waiting", f"{found.new_labels:,} new, a retrain is due at {found.recipe.retrain_every:,}"
    yield "never reported", f"{found.ever.unlabelled:,} verified, {found.unreported:,} accepted"
    if found.corrected or found.forgotten:
        yield "put right", f"{found.corrected} labels corrected, {found.forgotten} more forgotten"
    yield "first, last", f"{when(found.ever.first)} to {when(found.ever.last)}"
    if found.write_failures:
        yield "write failures", str(found.write_failures)


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{n} {name}" for name, n in counts.items() if n) or "none"


def _promise_rows(found: Status) -> Rows:
    novel, decisions = found.ever.novel, found.ever.decisions
    recent = f"of the newest {found.recent:,} that labels tell of, {_of(found.recent_novel, found.recent)}"
    share = f" ({percent(novel / decisions)})" if decisions else ""
    yield "novel", f"{novel:,} of {decisions:,} decisions{share}; {recent}"
    since = when(found.safe_mode_time)
    mode = f"on since {since}, every part is verified: {found.safe_mode}" if found.safe_mode else f"off, ended {since}"
    yield "safe mode", "off" if found.safe_mode_time is None else mode
    if (watch := found.watch) is not None:
        way = (("accepts", watch.accepts), ("rejects", watch.rejects), ("novelty", watch.novelty))
        yield "way to an alarm", ", ".join(f"{name} {percent(share, '.0f')}" for name, share in way)
    yield "accepted", f"{found.certificate.sentence} {found.certificate.advice}"
    yield "rejected", found.certificate.sentence_on_rejects


def _retrain_rows(found: Status) -> Rows:
    reports = [each.report for each in found.retrains]
    dropped = [each for each in reports if not each.accepted]
    yield "version", str(found.version) if found.version else "none yet: every part is verified"
    yield "retrains", f"{len(reports)}, {len(dropped)} dropped"
    if dropped:
        yield "last drop", dropped[-1].reason
    if reports:
        last, worst = reports[-1], max(reports, key=lambda each: each.seconds)
        yield "last retrain", f"{duration(last.seconds)} on {last.n_traces} traces, {last.n_steps} steps"
        yield "worst retrain", f"{duration(worst.seconds)}, to version {worst.version}"
