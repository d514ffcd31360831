"""`dengine status`: what a store holds, and what can be said of the parts that went on without a check.

How an engine is doing, as `dengine status` shows it: a table of two spans, JSON, a picture.

The same screen again and again, until Ctrl-C.

`dengine cells`: who shares a database.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..errors import without_password
from .options import cell_options, example, force_option, json_option, out_file_option
from .output import Asked, certificate_record, console, duration, interruptible, show, when, write_json

if TYPE_CHECKING:
    from ..decision.certificate import Certificate
    from ..history.status import Judged, Span, Status
    from ..recipe import Recipe
    from ..records import RetrainReport
    from ..store.base import Event, Evidence, Store
    from ..store.peers import CellSummary

WORDS = {"kept": "keeps to", "broken": "is beyond", "open": "may be beyond"}


def doing_record(doing: Status) -> dict[str, Any]:
    """As JSON has it."""
    spans = {"newest": asdict(doing.newest), "ever": asdict(doing.ever)}
    detectors = None if doing.watch is None else asdict(doing.watch)
    return {
        "doing": spans | {"last": doing.last, "alpha": doing.recipe.policy.alpha, "watch": detectors},
        "waiting": {
            "new_labels": doing.new_labels,
            "retrain_every": doing.recipe.retrain_every,
            "verified": doing.ever.unlabelled,
            "accepted": doing.unreported,
        },
    }


def doing_table(doing: Status, store: str) -> Any:
    """A column each for the newest decisions and for all, and what is on its way."""
    from rich.table import Table

    newest, ever, alpha = doing.newest, doing.ever, doing.recipe.policy.alpha
    table = Table(title=f"{without_password(store)}: how it is doing", title_justify="left")
    table.add_column(style="bold", no_wrap=True)
    table.add_column(f"last {newest.decisions:,}", overflow="fold")
    table.add_column("since birth", overflow="fold")
    for row in zip(_rows(newest, alpha), _rows(ever, alpha), strict=True):
        (name, new), (_, old) = row
        table.add_row(name, new, old)
    table.add_section()
    for name, text in _whole(doing):
        table.add_row(name, text, "")
    return table


def _rows(span: Span, alpha: float) -> Iterator[tuple[str, str]]:
    yield "from", when(span.first)
    yield "verified", _of(span.verified, span)
    yield "accepted", _of(span.accepted, span)
    yield "of them bad", _bad(span, alpha) if span.accepted else "none was accepted"
    yield "rejected", _of(span.rejected, span)
    yield "audits", _of(span.audits, span)
    yield "would accept", _would(span.would_accept, "bad")
    yield "would reject", _would(span.would_reject, "good")
    yield "novel", _of(span.novel, span)
    yield "safe mode", _of(span.safe_mode, span)
    yield "bad traces", f"{span.quarantined:,}" + (f", and {span.errors:,} model errors" if span.errors else "")
    dropped = sum(span.dropped.values())
    yield "retrains", f"{span.retrains:,}, {dropped:,} dropped"
    yield "dropped for", "\n".join(f"{n}: {reason.removeprefix('dropped: ')}" for reason, n in span.dropped.items()) or "-"


def _of(some: int, span: Span) -> str:
    return f"{some:,}" + (f" ({100 * some / span.decisions:.1f} %)" if span.decisions else "")


def _bad(span: Span, alpha: float) -> str:
    """Known bad accepts, with what they say of all."""
    bad = span.bad_accepts
    if not bad.by:
        return f"{span.stops:,} known; of the others nothing is"
    lead = f"{bad.wrong:,} of {bad.known:,}{' audited' if bad.by == 'audits' else ''}"
    stops = f", beside {span.stops:,} stops" if bad.by == "audits" and span.stops else ""
    between = f"{100 * bad.lower:.1f} to {100 * bad.upper:.1f} % at alpha {alpha:g}"
    return f"{lead}{stops}: {between}, {WORDS[bad.verdict]} {100 * bad.tolerance:g} %"


def _would(said: Judged, wrong: str) -> str:
    """What checks said of parts that the model was certain of."""
    if not said.n:
        return "none was checked"
    between = f"{100 * said.lower:.1f} to {100 * said.upper:.1f} % at 95 %"
    held = f"{WORDS[said.verdict]} {100 * said.tolerance:g} %"
    return f"{said.n:,} checked, {said.wrong:,} of them {wrong}: {between}, {held}"


def _whole(doing: Status) -> Iterator[tuple[str, str]]:
    """What is of now, and of no span."""
    yield "labels waiting", f"{doing.new_labels:,} new, a retrain is due at {doing.recipe.retrain_every:,}"
    yield "never reported", f"{doing.ever.unlabelled:,} verified, {doing.unreported:,} accepted"
    if doing.watch is not None:
        of = (("accepts", doing.watch.accepts), ("rejects", doing.watch.rejects), ("novelty", doing.watch.novelty))
        yield "way to an alarm", ", ".join(f"{name} {100 * share:.0f} %" for name, share in of)


def drawn(store: Store, recipe: Recipe, last: int, out: Path) -> Path:
    """Draw the picture of a store into a file."""
    from ..experiments.figures import save
    from ..experiments.pictures import status_picture
    from ..history.status import course

    return save(status_picture(course(store, recipe, last), f"{store.cell_id}: {recipe.name}"), out, force=True)


STEP = 0.05  # seconds between two looks for Ctrl-C


def redraw(read: Callable[[], Sequence[Any]], seconds: float) -> None:
    """Show what `read` gives, and again every so many seconds; Ctrl-C is how it ends, so that is no failure.

    On a terminal the screen is drawn anew; elsewhere each look follows the one before.
    """
    with interruptible() as asked:
        if not sys.stdout.isatty():
            while not asked():
                show(*read())
                _wait(seconds, asked)
            return
        from rich.console import Group
        from rich.live import Live

        with Live(Group(*read()), console=console(), screen=True, auto_refresh=False) as live:
            while not asked():
                live.update(Group(*read()), refresh=True)
                _wait(seconds, asked)
    show(*read())  # the last look stays when the screen is given back


def _wait(seconds: float, asked: Asked) -> None:
    end = time.monotonic() + seconds
    while not asked() and (left := end - time.monotonic()) > 0:
        time.sleep(min(STEP, left))


@click.command(epilog=example("dengine cells engine.db"))
@click.argument("store", metavar="STORE")
@json_option
def cells(store: str, as_json: bool) -> None:
    """List the cells of a store, and what each has done.

    STORE is a file or URL, as given to `dengine train` or `dengine run`. Cells of one product share labels and versions;
    a cell without a product shares nothing. Other verbs name one of them by --cell.
    """
    from ..store.base import must_be_there
    from ..store.peers import list_cells

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


RECENT = 200  # labels
GUARANTEES = {
    "local": "local: of the ball around each part, at one look",
    "pooled": "pooled: of all accepted parts together, however often one looks",
}
STOPS = {
    "some": "of some bad parts: silence after an accept says nothing",
    "all": "of all bad parts: an accepted part that no stop follows counts as good",
}
SHADOW = "all of what it is certain of: the shadow mode, in which it only says what it would have done"


@click.command(epilog=example("dengine status engine.db --last 500"))
@click.argument("store", metavar="STORE")
@cell_options()
@click.option(
    "--last", type=click.IntRange(1), default=500, show_default=True, help="The newest so many decisions, looked at apart."
)
@click.option(
    "--watch",
    type=click.FloatRange(0.1),
    is_flag=False,
    flag_value=5.0,
    metavar="[SECONDS]",
    help="Show it again every so many seconds, 5 if none are given, until Ctrl-C; after STORE.",
)
@out_file_option
@force_option
@json_option
def status(store: str, last: int, watch: float | None, out: Path | None, force: bool, as_json: bool) -> None:
    """Say how an engine is doing, and what its store holds.

    STORE is the file or URL that the engine remembers in, as given to `dengine train` or `dengine run`. The interval of bad
    accepted parts is of one look; what is certified holds however often one looks.
    """
    if watch is not None and as_json:
        raise click.UsageError("--watch and --json exclude each other.")
    if out is not None:
        from ..files import check_output

        check_output(out, force)
    if watch is not None:
        redraw(lambda: _screen(store, last, out), watch)
        return
    held = _read(store, last, out)
    if as_json:
        files = [] if out is None else [out]
        write_json({"verb": "status", "store": store} | _record(held) | doing_record(held.doing) | {"files": files})
        return
    show(*_tables(store, held), *([] if out is None else [f"Wrote {out}"]))


def _screen(store: str, last: int, out: Path | None) -> list[Any]:
    return _tables(store, _read(store, last, out))


def _tables(store: str, held: Held) -> list[Any]:
    groups = (_settings_rows(held), _count_rows(held), _promise_rows(held), _retrain_rows(held.retrains), _event_rows(held))
    return [doing_table(held.doing, store), _table_of_status("What it is", [row for rows in groups for row in rows])]


@dataclass(frozen=True)
class Held:
    """What was read of a store.

    counts : `Store.status`.  novel, recent : traces that were novel among those that the newest labels tell of, and how
        many they tell of: verified, audited and accepted parts.  mode : the newest event of the safe mode, if any.
    doing : over the newest decisions, and since its birth.
    """

    settings: dict[str, str]
    recipe: Recipe
    counts: dict[str, Any]
    retrains: list[RetrainReport]
    certificate: Certificate
    novel: int
    recent: int
    mode: Event | None
    doing: Status

    @property
    def shadow(self) -> bool:
        """Whether every part is verified, by the user's will."""
        return self.recipe.policy.audit_rate == 1.0

    @property
    def safe_mode(self) -> str:
        """Why everything is verified; "" where it is not."""
        return self.doing.safe_mode


def _read(store: str, last: int, out: Path | None) -> Held:
    from ..errors import StoreError
    from ..store.base import open_store

    opened = open_store(store, must_exist=True)
    try:
        settings = opened.settings()
        if "recipe" not in settings:
            raise StoreError(f"Expected a store that an engine has used, {store} is empty.")
        held = _held(opened, settings, last)
        if out is not None:
            drawn(opened, held.recipe, last, out)
        return held
    finally:
        opened.close()


def _held(store: Store, settings: dict[str, str], last: int) -> Held:
    from ..history.status import safe_mode_event
    from ..history.status import status as status_of
    from ..recipe import Recipe

    recipe, counts = Recipe.from_toml(settings["recipe"]), store.status()
    newest = _newest(store, counts["labels"])
    return Held(
        settings=settings,
        recipe=recipe,
        counts=counts,
        retrains=store.retrains(),
        certificate=recipe.policy.certificate(store.outcomes(int(settings.get("policy_since", 0)))),
        novel=int(newest.novel.sum()),
        recent=len(newest.seq) + int(newest.silent.sum()),
        mode=safe_mode_event(store),
        doing=status_of(store, last, watching=True),
    )


def _newest(store: Store, labels: int) -> Evidence:
    """What became of the decisions with the newest labels, RECENT at most."""
    from ..store.base import is_shared
    from ..store.records import Evidence

    known = store.evidence_since(0 if is_shared(store) else labels - RECENT)  # numbered from 1, or over a whole product
    return Evidence(*(getattr(known, field.name)[-RECENT:] for field in fields(known)))


def _record(held: Held) -> dict[str, Any]:
    """As JSON has it."""
    counts, policy = held.counts, held.recipe.policy
    novel = {"decisions": counts["reasons"]["novel"], "share": _share(counts["reasons"]["novel"], counts["decisions"])}
    novel |= {"recent": held.novel, "recent_decisions": held.recent, "recent_share": _share(held.novel, held.recent)}
    mode = {"on": held.safe_mode != "", "reason": held.safe_mode, "since": held.mode.time if held.mode else None}
    worst = max((r.seconds for r in held.retrains), default=None)
    return counts | {
        "guarantee": policy.guarantee,
        "stops": policy.stops,
        "certificate": certificate_record(held.certificate),
        "novel": novel,
        "safe_mode": mode,
        "shadow": held.shadow,
        "settings": held.settings,
        "worst_retrain_s": worst,
        "all": [asdict(r) for r in held.retrains],
    }


def _share(some: int, of: int) -> float | None:
    return some / of if of else None


def _table_of_status(store: str, rows: list[tuple[str, str]]) -> Any:
    from rich.table import Table

    table = Table(title=without_password(store), show_header=False, title_justify="left")
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for row in rows:
        table.add_row(*map(without_password, row))
    return table


def _settings_rows(held: Held) -> Iterator[tuple[str, str]]:
    settings, recipe, seed = held.settings, held.recipe, held.settings.get("seed", "0")
    # Of a model that was handed in, reducer and numbers of the recipe have no effect: to show them would be a lie.
    handed_in = settings.get("model")
    yield from _own_rows(recipe, seed) if handed_in is None else [("model", f"{handed_in}, decides by its own rule")]
    yield "stops known", STOPS[recipe.policy.stops]
    yield "audits", SHADOW if held.shadow else f"{100 * recipe.policy.audit_rate:g} % of what it is certain of"
    yield (
        "retrain",
        (f"every {recipe.retrain_every} new labels, within {duration(recipe.budget)}, on the newest {recipe.window:,}"),
    )
    yield "trace", _contract(settings)


def _own_rows(recipe: Recipe, seed: str) -> Iterator[tuple[str, str]]:
    policy = recipe.policy
    yield "reducer", f"{recipe.name}, seed {seed}"
    yield "policy", f"alpha {policy.alpha:g}, LB {100 * policy.lower_bound:g} %, {policy.interval} interval"
    yield "guarantee", GUARANTEES.get(policy.guarantee, policy.guarantee)
    yield "neighbours", _neighbours(recipe)
    yield "novelty", "off" if not recipe.novelty else f"verified beyond {recipe.novelty:g} times the usual distance"


def _neighbours(recipe: Recipe) -> str:
    if recipe.fraction is None:
        return f"within a radius of {recipe.radius:g}, in the unit of the scaled embedding"
    judged = "" if recipe.reject_fraction is None else f"; a rejection is judged by {100 * recipe.reject_fraction:g} %"
    return f"the nearest {100 * recipe.fraction:g} % of the references{judged}"


def _contract(settings: dict[str, str]) -> str:
    from ..records import trace_in

    spec = trace_in(settings)
    if spec is None:
        return "none yet: the first trace sets it"
    channels = "" if spec.channels == 1 else f"{spec.channels} channels of "
    limit = "" if spec.limit is None else f", sensor limit {spec.limit:g} {spec.unit}"
    seconds = duration(spec.samples / spec.rate_hz)
    return f"{channels}{spec.samples} samples at {spec.rate_hz:g} Hz ({seconds}), in {spec.unit}{limit}"


def _count_rows(held: Held) -> Iterator[tuple[str, str]]:
    counts = held.counts
    yield "cell", counts["cell_id"]
    if "product" in counts:
        yield "product", f"{counts['product']}: labels and versions are shared with its other cells"
    yield "decisions", f"{counts['decisions']}: {_listed(counts['actions'])}"
    yield "reasons", _listed(counts["reasons"])
    yield "quarantined", str(counts["quarantined"])
    yield "labels", f"{counts['labels']}: {_listed(counts['sources'])}"
    if counts["corrected"] or counts["forgotten"]:
        yield "put right", f"{counts['corrected']} labels corrected, {counts['forgotten']} more forgotten"
    yield "first, last", " to ".join(when(counts[key]) for key in ("first_time", "last_time"))
    if counts["write_failures"]:
        yield "write failures", str(counts["write_failures"])


def _promise_rows(held: Held) -> Iterator[tuple[str, str]]:
    novel, decisions = held.counts["reasons"]["novel"], held.counts["decisions"]
    recent = f"; of the newest {held.recent:,} that labels tell of, {held.novel:,}{_percent(held.novel, held.recent)}"
    yield "novel", f"{novel:,} of {decisions:,} decisions{_percent(novel, decisions)}{recent}"
    yield "safe mode", _mode(held)
    yield "accepted", f"{held.certificate.sentence} {held.certificate.advice}"
    yield "rejected", held.certificate.sentence_on_rejects


def _percent(some: int, of: int) -> str:
    return f" ({100 * some / of:.1f} %)" if of else ""


def _mode(held: Held) -> str:
    if held.mode is None:
        return "off"
    since = when(held.mode.time)
    return f"on since {since}, every part is verified: {held.safe_mode}" if held.safe_mode else f"off, ended {since}"


def _event_rows(held: Held) -> Iterator[tuple[str, str]]:
    for i, event in enumerate(reversed(held.counts["events"])):
        yield "newest events" if i == 0 else "", f"{when(event['time'])} {event['kind']}: {event['text']}"


def _retrain_rows(retrains: list[RetrainReport]) -> Iterator[tuple[str, str]]:
    dropped = [r for r in retrains if not r.accepted]
    answering = max((r.version for r in retrains if r.accepted), default=None)
    yield "version", "none yet: every part is verified" if answering is None else str(answering)
    yield "retrains", f"{len(retrains)}, {len(dropped)} dropped"
    if dropped:
        yield "last drop", dropped[-1].reason
    if retrains:
        last, worst = retrains[-1], max(retrains, key=lambda r: r.seconds)
        yield "last retrain", f"{duration(last.seconds)} on {last.n_traces} traces, {last.n_steps} steps"
        yield "worst retrain", f"{duration(worst.seconds)}, to version {worst.version}"


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{n} {name}" for name, n in counts.items() if n) or "none"
