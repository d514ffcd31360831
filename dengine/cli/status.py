"""`dengine status`: how an engine is doing by its store, what the store holds, and who shares it."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import click

from ..errors import percent
from . import options
from .options import verb
from .output import Out, as_json, certificate_record, duration, facts, show, tell, when

if TYPE_CHECKING:
    from ..history.status import Judged, Span, Status

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


@verb("dengine status engine.db --last 500")
@options.store_argument
@click.option("--last", type=options.COUNT, default=500, show_default=True, help=LAST)
@click.option("--watch", **WATCHING, help=WATCH)
@options.picture_option
def status(store: str, last: int, watch: float | None, out: Out | None) -> None:
    """Say how an engine is doing, and what its store holds.

    STORE is the file or URL that the engine remembers in, as given to `dengine train` or `dengine run`. Where it holds
    several cells and none is named, they are listed; cells of one product share labels and versions. The interval of bad
    accepted parts is of one look; what is certified holds however often one looks.
    """
    if watch is not None and as_json():
        raise click.UsageError("--watch and --json exclude each other.")
    from ..files import check_output
    from ..records import plain
    from ..store.opening import must_be_there
    from ..store.peers import list_cells
    from ..store.records import CellAddress, address

    if out is not None:
        check_output(out.path, out.force)
    if not isinstance(store, CellAddress):
        must_be_there(store)
        first, *others = cells = list_cells(store)
        if others:
            columns = [name.replace("_id", "").replace("_", " ") for name in asdict(first)]
            rows = [tuple(map(_cell, asdict(each).items())) for each in cells]
            said = "Name one of them, --cell NAME, and how it is doing is shown."
            tell({"store": store, "cells": cells}, facts(store, rows, columns), said)
            return
        store = address(store, first.cell_id)
    found, picture = _read(store, last, out)
    record = {"store": store} | plain(found) | {"certificate": certificate_record(found.certificate)}
    tell(record, *_tables(store, found), out=out, made=lambda: picture)
    with suppress(KeyboardInterrupt):  # Ctrl-C is how watching ends, so that is no failure
        while watch is not None:
            time.sleep(watch)
            found, picture = _read(store, last, out)
            if out is not None:
                replace(out, force=True).write(picture)
            if sys.stdout.isatty():
                click.clear()
            show(*_tables(store, found))


def _read(store: str, last: int, out: Out | None) -> tuple[Status, dict[str, Any]]:
    """The status, and its picture where one is asked for."""
    from ..experiments.figures import status_picture
    from ..history.status import course
    from ..history.status import status as status_of
    from ..store.opening import open_store

    with closing(open_store(store, must_exist=True)) as opened:
        found = status_of(opened, last, watching=True)
        if out is None:
            return found, {}
        return found, {"": status_picture(course(opened, found.recipe, last), f"{found.cell}: {found.recipe.name}")}


def _cell(named: tuple[str, Any]) -> str:
    name, value = named
    if name == "last_seen":
        return when(value)
    return "-" if value is None else f"{value:,}" if isinstance(value, int) else value


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
    of = span.decisions
    yield "from", when(span.first)
    yield "verified", _of(span.verified, of)
    yield "accepted", _of(span.accepted, of)
    yield "of them bad", _bad(span, alpha) if span.accepted else "none was accepted"
    yield "rejected", _of(span.rejected, of)
    yield "audits", _of(span.audits, of)
    for name, said, wrong in (("accept", span.would_accept, "bad"), ("reject", span.would_reject, "good")):
        checked = f"{said.n:,} checked, {said.wrong:,} of them {wrong}: {_held(said, '95 %')}"
        yield f"would {name}", checked if said.n else "none was checked"
    yield "novel", _of(span.novel, of)
    yield "safe mode", _of(span.safe_mode, of)
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
    audited = bad.by == "audits"
    stops = f", beside {span.stops:,} stops" if audited and span.stops else ""
    return f"{bad.wrong:,} of {bad.known:,}{' audited' if audited else ''}{stops}: {_held(bad, f'alpha {alpha:g}')}"


def _held(said: Judged, level: str) -> str:
    """An interval, held against what is tolerated."""
    between = f"{100 * said.lower:.1f} to {percent(said.upper)} at {level}"
    return f"{between}, {WORDS[said.verdict]} {percent(said.tolerance, 'g')}"


def _settings_rows(found: Status) -> Rows:
    recipe, policy, spec = found.recipe, found.recipe.policy, found.trace
    if found.model is not None:  # reducer and numbers of the recipe have no effect: to show them would be a lie
        yield "model", f"{found.model}, decides by its own rule"
    else:
        yield "reducer", f"{recipe.name}, seed {found.settings.get('seed', '0')}"
        yield "policy", f"alpha {policy.alpha:g}, LB {percent(policy.lower_bound, 'g')}, {policy.interval} interval"
        yield "guarantee", GUARANTEES.get(policy.guarantee, policy.guarantee)
        if recipe.fraction is None:
            yield "neighbours", f"within a radius of {recipe.radius:g}, in the unit of the scaled embedding"
        else:
            rejects = recipe.reject_fraction or recipe.fraction
            shares = f"{percent(recipe.fraction, 'g')}, to reject {percent(rejects, 'g')}"
            yield "neighbours", f"the nearest {shares}, of the references"
        yield "novelty", f"verified beyond {recipe.novelty:g} times the usual distance" if recipe.novelty else "off"
    yield "stops known", STOPS[policy.stops]
    yield "audits", SHADOW if found.shadow else f"{percent(policy.audit_rate, 'g')} of what it is certain of"
    schedule = f"every {recipe.retrain_every} new labels, within {duration(recipe.budget)}"
    yield "retrain", f"{schedule}, on the newest {recipe.window:,}"
    if spec is None:
        yield "trace", "none yet: the first trace sets it"
    else:
        limit = "" if spec.limit is None else f", sensor limit {spec.limit:g} {spec.unit}"
        length = f"{spec.samples} samples at {spec.rate_hz:g} Hz ({duration(spec.samples / spec.rate_hz)})"
        yield "trace", f"{spec.channels} x {length}, in {spec.unit}{limit}"


def _count_rows(found: Status) -> Rows:
    yield "cell", found.cell
    if found.product is not None:
        yield "product", f"{found.product}: labels and versions are shared with its other cells"
    yield "decisions", f"{found.ever.decisions}: {_listed(found.actions)}"
    yield "reasons", _listed(found.reasons)
    yield "labels", f"{found.labels}: {_listed(found.sources)}"
    yield "labels waiting", f"{found.new_labels:,} new, a retrain is due at {found.recipe.retrain_every:,}"
    yield "never reported", f"{found.ever.unlabelled:,} verified, {found.unreported:,} accepted"
    if found.corrected or found.forgotten:
        yield "put right", f"{found.corrected} labels corrected, {found.forgotten} more forgotten"
    yield "newest", when(found.ever.last)
    if found.write_failures:
        yield "write failures", str(found.write_failures)


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{n} {name}" for name, n in counts.items() if n) or "none"


def _promise_rows(found: Status) -> Rows:
    yield "novel", f"of the newest {found.recent:,} that labels tell of, {_of(found.recent_novel, found.recent)}"
    since = when(found.safe_mode_time)
    mode = f"on since {since}, every part is verified: {found.safe_mode}" if found.safe_mode else f"off, ended {since}"
    yield "safe mode", "off" if found.safe_mode_time is None else mode
    if found.watch is not None:
        yield "way to an alarm", ", ".join(f"{name} {percent(share, '.0f')}" for name, share in asdict(found.watch).items())
    yield "accepted", f"{found.certificate.sentence} {found.certificate.advice}"
    yield "rejected", found.certificate.sentence_on_rejects


def _retrain_rows(found: Status) -> Rows:
    yield "version", str(found.version) if found.version else "none yet: every part is verified"
    if reports := [each.report for each in found.retrains]:
        last, worst = reports[-1], max(reports, key=lambda each: each.seconds)
        yield "last retrain", f"{duration(last.seconds)} on {last.n_traces} traces, {last.n_steps} steps: {last.reason}"
        yield "worst retrain", f"{duration(worst.seconds)}, to version {worst.version}"
