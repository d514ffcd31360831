"""`dengine history`: the decisions of a store, and what happened between them; `dengine explain`: why one came out so."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..errors import percent
from ..records import plain
from .options import Known, Naming, cell_options, example, force_option, json_option, out_file_option
from .output import duration, facts, show, when, write_json

if TYPE_CHECKING:
    from ..history.envelope import Envelope, Excess
    from ..history.explain import Explanation, Neighbour
    from ..history.status import Happened
    from ..store.records import Event, StoredDecision
    from ..store.views import PastRetrain

AGO = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}
COLUMNS = ("time (UTC)", "decision", "part", "action", "model", "bound", "good", "bad", "reason", "v", "label")
RIGHT = ("good", "bad", "v")
WIDEST = 120  # columns
PART = COLUMNS.index("part")
SHORTEST = 5  # characters of a part's number that are shown
TOLD = {"verification": "verified"}  # in fewer columns
SHORT = "%y-%m-%d %H:%M:%S"


class Moment(click.ParamType):  # type: ignore[type-arg]  # click made it generic in 8.3
    """A time: how long ago (90s, 30m, 12h, 7d), or when (2026-03-01, 2026-03-01T14:30), in UTC if it does not say."""

    name = "TIME"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Seconds since 1970."""
        ago = re.fullmatch(r"(\d+(?:\.\d+)?)([smhd])", value)
        if ago:
            return time.time() - float(ago[1]) * AGO[ago[2]]
        try:
            moment = datetime.fromisoformat(value)
        except ValueError:
            self.fail(f"expected 30m, 12h, 7d or 2026-03-01T14:30, got {value!r}.", param, ctx)
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


@click.command(epilog=example("dengine history engine.db --last 20 --events"))
@click.argument("store", metavar="STORE")
@cell_options()
@click.option("--last", type=click.IntRange(1), default=50, show_default=True, help="The newest so many that are meant.")
@click.option("--action", type=Known("action"), help="Only what was decided so.")
@click.option(
    "--model",
    "predicted",
    type=Known("action"),
    help="Only what the model alone would have done so, as in an audit or in the shadow mode.",
)
@click.option("--reason", type=Known("reason"), cls=Naming, metavar="REASON", help="Only for this one: {reason}.")
@click.option("--label", type=Known("label"), help="Only what turned out so, or was never reported.")
@click.option("--since", type=Moment(), help="Only from then on: 30m, 12h, 7d ago, or 2026-03-01T14:30, in UTC.")
@click.option("--until", type=Moment(), help="Only before then, likewise.")
@click.option("--events", is_flag=True, help="With the retrains and events that happened meanwhile.")
@json_option
def history(store: str, events: bool, as_json: bool, **asked: Any) -> None:
    """Show the decisions of a store, newest last.

    STORE is the file or URL that an engine remembers in. In the table good and bad are the labels that were counted, bound
    is what they say of the success rate, v the model's version, and label what the part turned out to be. `dengine explain`
    says more of one.
    """
    from ..history.status import beside, interleaved
    from ..history.status import history as read
    from ..store.base import open_store

    opened = open_store(store, must_exist=True)
    try:
        found = list(read(opened, **asked))
        since = asked["since"] if asked["since"] is not None or not found else found[0].time
        others = beside(opened, since, asked["until"]) if events else None
    finally:
        opened.close()
    if as_json:
        listed = {} if others is None else {"retrains": others.retrains, "events": others.events}
        decisions = [plain(past) | {"label": past.label} for past in found]
        write_json({"verb": "history", "store": store, "decisions": decisions} | listed)
        return
    happened: Iterator[Happened] = iter(found) if others is None else interleaved(found, others)
    for line in lines(list(happened)):
        click.echo(line)


def lines(happened: Sequence[Happened]) -> list[str]:
    """A table of at most WIDEST columns; retrains and events are lines of their own among the decisions."""
    from ..store.records import StoredDecision

    if not happened:
        return ["No decision of that kind."]
    rows = [_cells(each) for each in happened if isinstance(each, StoredDecision)]
    widths = [max(map(len, column)) for column in zip(COLUMNS, *rows, strict=True)]
    # What is too wide is taken from the parts' numbers, from their beginning: ids are needed whole.
    too_wide = sum(widths) + 2 * (len(widths) - 1) - WIDEST
    widths[PART] = min(widths[PART], max(SHORTEST, widths[PART] - max(0, too_wide)))
    for row in rows:
        row[PART] = row[PART] if len(row[PART]) <= widths[PART] else "~" + row[PART][1 - widths[PART] :]
    waiting = iter(rows)
    body = [
        _line(next(waiting), widths) if isinstance(each, StoredDecision) else _told(each)[: WIDEST - 1] for each in happened
    ]
    return [_line(COLUMNS, widths), "  ".join("-" * width for width in widths), *body]


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    pairs = zip(COLUMNS, cells, widths, strict=True)
    return "  ".join(text.rjust(n) if name in RIGHT else text.ljust(n) for name, text, n in pairs).rstrip()


def _cells(past: StoredDecision) -> list[str]:
    source = "" if past.source is None else f" {TOLD.get(past.source.value, past.source.value)}"
    return [
        when(past.time, SHORT),
        past.decision.id,
        past.decision.part or "-",
        past.decision.action.value,
        "" if past.decision.predicted is past.decision.action else past.decision.predicted.value,
        "-" if math.isnan(past.decision.lower) else f"{past.decision.lower:.2f}-{past.decision.upper:.2f}",
        str(past.decision.n_success),
        str(past.decision.n_failure),
        past.decision.reason.value,
        str(past.decision.model_version),
        "-" if past.success is None else f"{past.label}{source}",
    ]


def _told(each: PastRetrain | Event) -> str:
    from ..store.records import Event

    if isinstance(each, Event):
        return f"{when(each.time, SHORT)}  * {each.kind}: {' '.join(each.text.split())}"
    report = each.report
    what = f"retrain to version {report.version}" if report.accepted else f"retrain {each.number}"
    return f"{when(each.time, SHORT)}  * {what}, {report.n_traces} traces, {duration(report.seconds)}: {report.reason}"


MOST = 5  # excesses that are named


@click.command(epilog=example("dengine explain engine.db last --out why.png"))
@click.argument("store", metavar="STORE")
@cell_options()
@click.argument("decision", metavar="DECISION")
@click.option(
    "--neighbours", type=click.IntRange(0), default=10, show_default=True, help="Nearest references that are shown."
)
@out_file_option
@force_option
@json_option
def explain(store: str, decision: str, neighbours: int, out: Path | None, force: bool, as_json: bool) -> None:
    """Say why a decision came out as it did.

    DECISION is its id, as `dengine history STORE` lists it, or the word last. Counts, bound and action are shown as they
    were recorded; neighbours are found again by the version that answered where the store keeps it, and it says by which.
    The picture shows the trace with its neighbours and with the band that 95 % of the known successes lie in.
    """
    from ..engine.engine import explain_stored
    from ..errors import ReportError
    from ..history.status import history
    from ..store.base import open_store

    opened = open_store(store, must_exist=True)
    try:
        if decision == "last":
            newest = next(history(opened, last=1), None)
            if newest is None:
                raise ReportError(f"Expected a decision in {store}, there is none yet; let an engine decide first.")
            decision = newest.decision.id
        found = explain_stored(opened, decision, neighbours)
    finally:
        opened.close()
    files = [] if out is None else [_drawn(found, out, force)]
    if as_json:
        write_json({"verb": "explain", "store": store} | found.record() | {"files": files})
        return
    show(*_tables(found), *(f"Wrote {path}" for path in files))


def _drawn(found: Explanation, out: Path, force: bool) -> Path:
    from ..experiments.figures import save
    from ..experiments.pictures import explained_picture

    return save(explained_picture(found), out, force=force)


def _tables(found: Explanation) -> Iterator[Any]:
    past = found.decision
    yield facts(f"{past.decision.id}: {past.decision.action.value}, {past.decision.reason.value}", _rows(found))
    if found.neighbours:
        title = f"Nearest references of version {found.neighbours_version}; the ball's radius is {found.radius:.3g}"
        yield facts(title, map(_neighbour, found.neighbours), ("decision", "part", "label", "distance", "fold", "ball"))


def _rows(found: Explanation) -> Iterator[tuple[str, str]]:
    past = found.decision
    yield (
        "decided",
        f"{when(past.time)}, by "
        + (f"version {past.decision.model_version}" if past.decision.model_version else "no model"),
    )
    if past.decision.part is not None:
        yield "part", past.decision.part
    for i, sentence in enumerate(found.said):
        yield "" if i else "why", sentence
    for i, note in enumerate(found.notes):
        yield "" if i else "found again", note
    yield from _envelope_rows(found.envelope, found)


def _envelope_rows(band: Envelope | None, found: Explanation) -> Iterator[tuple[str, str]]:
    if band is None:
        yield "envelope", "too few successes of this shape are known yet"
        return
    usual = f"of 95 % of them fewer than {percent(band.usual, '.0f')} do"
    yield "envelope", f"{percent(band.outside, '.0f')} of its samples leave the band of {band.n:,} successes; {usual}"
    if band.not_finite:
        yield "", f"{band.not_finite} samples are NaN or infinite"
    farthest = sorted(band.excesses, key=lambda each: -each.widths)
    for i, each in enumerate(farthest[:MOST]):
        yield "" if i else "leaves it", _excess(each, found)
    if len(farthest) > MOST:
        yield "", f"and {len(farthest) - MOST} times less far"


def _excess(each: Excess, found: Explanation) -> str:
    spec = found.spec
    name = spec.columns[each.channel] if spec.columns else f"channel {each.channel + 1}"
    where = f"{name}, " if spec.channels > 1 else ""
    side = "above" if each.above else "below"
    if each.first == each.last:
        return f"{where}at {each.from_s:.3f} s (sample {each.first}) {side}, by {each.widths:.1f} band widths"
    times = f"{each.from_s:.3f} to {each.to_s:.3f} s (samples {each.first} to {each.last})"
    return f"{where}{times} {side}, by up to {each.widths:.1f} band widths"


def _neighbour(each: Neighbour) -> tuple[str, ...]:
    label = f"{'good' if each.success else 'bad'}{'' if each.source is None else f', {each.source.value}'}"
    ball = "inside" if each.inside else "outside"
    return each.decision_id or "not known", each.part or "-", label, f"{each.distance:.3f}", str(each.space), ball
