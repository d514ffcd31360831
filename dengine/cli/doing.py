"""How an engine is doing, as `dengine status` shows it: a table of two spans, JSON, a picture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..wording import without_password
from .output import when

if TYPE_CHECKING:
    from ..recipe import Recipe
    from ..standing import BadAccepts, Span, Standing, Watch, WouldHave
    from ..store.base import Store

WORDS = {"kept": "keeps to", "broken": "is beyond", "open": "may be beyond"}


@dataclass(frozen=True)
class Doing:
    """What is shown.  watch : the safe mode's detectors, None without them.  alpha : of the interval.  last : asked for."""

    standing: Standing
    watch: Watch | None
    alpha: float
    last: int


def doing_record(doing: Doing) -> dict[str, Any]:
    """As JSON has it."""
    spans = {name: _span_record(getattr(doing.standing, name)) for name in ("newest", "ever")}
    detectors = None if doing.watch is None else asdict(doing.watch)
    return {"doing": spans | {"last": doing.last, "alpha": doing.alpha, "watch": detectors}} | {
        "waiting": asdict(doing.standing.waiting)
    }


def _span_record(span: Span) -> dict[str, Any]:
    shares = {f"{name}_share": span.share(getattr(span, name)) for name in ("verified", "novel")}
    judged = ("bad_accepts", "would_accept", "would_reject")
    verdicts = {name: asdict(said := getattr(span, name)) | {"verdict": said.verdict} for name in judged}
    return asdict(span) | shares | verdicts


def doing_table(doing: Doing, store: str) -> Any:
    """A column each for the newest decisions and for all, and what is on its way."""
    from rich.table import Table

    newest, ever = doing.standing.newest, doing.standing.ever
    table = Table(title=f"{without_password(store)}: how it is doing", title_justify="left")
    table.add_column(style="bold", no_wrap=True)
    table.add_column(f"last {newest.decisions:,}", overflow="fold")
    table.add_column("since birth", overflow="fold")
    for row in zip(_rows(newest, doing.alpha), _rows(ever, doing.alpha), strict=True):
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
    yield "of them bad", _bad(span.bad_accepts, alpha) if span.accepted else "none was accepted"
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
    share = span.share(some)
    return f"{some:,}" + ("" if share is None else f" ({100 * share:.1f} %)")


def _bad(bad: BadAccepts, alpha: float) -> str:
    """Known bad accepts, with what they say of all."""
    if not bad.by:
        return f"{bad.stops:,} known; of the others nothing is"
    lead = f"{bad.bad:,} of {bad.known:,}{' audited' if bad.by == 'audits' else ''}"
    stops = f", beside {bad.stops:,} stops" if bad.by == "audits" and bad.stops else ""
    between = f"{100 * bad.lower:.1f} to {100 * bad.upper:.1f} % at alpha {alpha:g}"
    return f"{lead}{stops}: {between}, {WORDS[bad.verdict]} {100 * bad.tolerance:g} %"


def _would(said: WouldHave, wrong: str) -> str:
    """What checks said of parts that the model was certain of."""
    if not said.n:
        return "none was checked"
    between = f"{100 * said.lower:.1f} to {100 * said.upper:.1f} % at 95 %"
    held = f"{WORDS[said.verdict]} {100 * said.tolerance:g} %"
    return f"{said.n:,} checked, {said.wrong:,} of them {wrong}: {between}, {held}"


def _whole(doing: Doing) -> Iterator[tuple[str, str]]:
    """What is of now, and of no span."""
    waiting = doing.standing.waiting
    yield "labels waiting", f"{waiting.new_labels:,} new, a retrain is due at {waiting.retrain_every:,}"
    yield "never reported", f"{waiting.verified:,} verified, {waiting.accepted:,} accepted"
    if doing.watch is not None:
        of = (("accepts", doing.watch.accepts), ("rejects", doing.watch.rejects), ("novelty", doing.watch.novelty))
        yield "way to an alarm", ", ".join(f"{name} {100 * share:.0f} %" for name, share in of)


def drawn(store: Store, recipe: Recipe, last: int, out: Path) -> Path:
    """Draw the picture of a store into a file."""
    from ..experiments.look import save
    from ..experiments.status_picture import status_picture
    from ..standing import course

    return save(status_picture(course(store, recipe, last), f"{store.cell_id}: {recipe.name}"), out)
