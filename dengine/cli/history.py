"""`dengine history`: the decisions of a store, and what happened between them; `dengine explain`: why one came out so."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from datetime import UTC, datetime
from heapq import merge
from typing import TYPE_CHECKING, Any

import click

from ..errors import percent
from . import options
from .options import Known, verb
from .output import Out, duration, facts, listed, tell, when

if TYPE_CHECKING:
    from ..history.explain import Explanation
    from ..store.records import Event, StoredDecision, StoredVersion

AGO = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}
WIDEST = 120  # columns
SHORTEST = 10  # characters of a part's number that are shown, its last
SHORT = "%Y-%m-%d %H:%M:%S"
MOST = 5  # excesses that are named
NEIGHBOUR = ("decision_id", "part", "success", "source", "distance", "space", "inside")


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


MODEL = "Only what the model alone would have done so, as in an audit or in the shadow mode."


@verb("dengine history engine.db --last 20 --events")
@options.store_argument
@click.option("--last", type=options.COUNT, default=50, show_default=True, help="The newest so many that are meant.")
@click.option("--action", type=Known("action"), help="Only what was decided so.")
@click.option("--model", "predicted", type=Known("action"), help=MODEL)
@click.option("--reason", type=Known("reason"), help="Only what was decided for this one.")
@click.option("--label", type=Known("label"), help="Only what turned out so, or was never reported.")
@click.option("--part", metavar="NUMBER", help="Only of the part with this number.")
@click.option("--since", type=Moment(), help="Only from then on: 30m, 12h, 7d ago, or 2026-03-01T14:30, in UTC.")
@click.option("--until", type=Moment(), help="Only before then, likewise.")
@click.option("--events", is_flag=True, help="With the retrains and events that happened meanwhile.")
def history(store: str, events: bool, **asked: Any) -> None:
    """Show the decisions of a store, newest last.

    STORE is the file or URL that an engine remembers in. In the table good and bad are the labels that were counted, bound
    is what they say of the success rate, v the model's version, and label what the part turned out to be. `dengine explain`
    says more of one.
    """
    from ..history.status import history as read
    from ..history.status import read_retrains_and_events
    from ..representation import to_jsonable
    from ..store.opening import open_store

    with closing(open_store(store, must_exist=True)) as opened:
        found = list(read(opened, **asked))
        since = asked["since"] if asked["since"] is not None or not found else found[0].time
        others = read_retrains_and_events(opened, since, asked["until"]) if events else {}
    record = {"store": store, "decisions": [to_jsonable(past) | {"label": past.label} for past in found]} | others
    tell(record, _table(merge(*others.values(), found, key=lambda each: each.time)))


def _label(past: StoredDecision) -> str:
    source = "" if past.source is None else f" {past.source.value}".replace("verification", "verified")
    return "-" if past.success is None else f"{past.label}{source}"


COLUMNS: dict[str, Callable[[StoredDecision], str]] = {  # "<" or ">": to which side; and the title
    "<time (UTC)": lambda past: when(past.time, SHORT),
    "<decision": lambda past: past.decision.id,
    "<part": lambda past: (past.decision.part or "-")[-SHORTEST:],
    "<action": lambda past: past.decision.action.value,
    "<model": lambda past: "" if past.decision.predicted is past.decision.action else past.decision.predicted.value,
    "<bound": lambda past: f"{past.decision.lower:.2f}-{past.decision.upper:.2f}".replace("nan-nan", "-"),
    ">good": lambda past: str(past.decision.n_success),
    ">bad": lambda past: str(past.decision.n_failure),
    "<reason": lambda past: past.decision.reason.value,
    ">v": lambda past: str(past.decision.model_version),
    "<label": _label,
}


def _table(happened: Iterable[StoredDecision | StoredVersion | Event]) -> str:
    """A table; retrains and events are lines of their own among the decisions."""
    from ..store.records import StoredDecision

    rows = [
        [cell(each) for cell in COLUMNS.values()] if isinstance(each, StoredDecision) else _told(each)[: WIDEST - 1]
        for each in happened
    ]
    if not rows:
        return "No decision of that kind."
    titles = [name[1:] for name in COLUMNS]
    widths = [max(map(len, column)) for column in zip(titles, *(row for row in rows if isinstance(row, list)), strict=True)]
    sides = "  ".join(f"{{:{name[0]}{width}}}" for name, width in zip(COLUMNS, widths, strict=True))
    lines = [titles, ["-" * width for width in widths], *rows]
    return "\n".join(line if isinstance(line, str) else sides.format(*line).rstrip() for line in lines)


def _told(each: StoredVersion | Event) -> str:
    from ..store.records import Event

    if isinstance(each, Event):
        return f"{when(each.time, SHORT)}  * {each.kind}: {' '.join(each.text.split())}"
    report = each.report
    what = f"retrain to version {report.version}" if report.accepted else f"retrain {each.number}"
    return f"{when(each.time, SHORT)}  * {what}, {report.n_traces} traces, {duration(report.seconds)}: {report.reason}"


@verb("dengine explain engine.db last --out why.png")
@options.store_argument
@click.argument("decision", metavar="PART|ID")
@click.option("--neighbours", type=click.IntRange(0), default=10, show_default=True, help="Nearest references, shown.")
@options.picture_option
def explain(store: str, decision: str, neighbours: int, out: Out | None) -> None:
    """Say why a decision came out as it did.

    It is named by its id, as `dengine history STORE` lists it, by its part's number, or by the word last. Counts,
    bound and action are shown as they were recorded; neighbours are found again by the version that answered, where the
    store keeps it.
    The picture shows the trace with its neighbours and with the band that 95 % of the known successes lie in.
    """
    from ..errors import ReportError
    from ..experiments.figures import explained_picture
    from ..history.explain import explain as explained
    from ..history.status import history
    from ..representation import to_jsonable
    from ..store.opening import open_store

    with closing(open_store(store, must_exist=True)) as opened:
        if decision == "last":
            newest = next(history(opened, last=1), None)
            if newest is None:
                raise ReportError(f"Expected a decision in {store}, there is none yet; let an engine decide first.")
            decision = newest.decision.id
        found = explained(opened, decision, neighbours)
    record, past = {"store": store} | to_jsonable(found), found.decision
    tables = [facts(f"{past.decision.id}: {past.decision.action.value}, {past.decision.reason.value}", _rows(found))]
    if found.envelope is not None and found.envelope.excesses:
        columns = ("", "from", "to", "in widths")
        tables.append(facts("Where it leaves the band, the farthest first", _excesses(found), columns))
    if found.neighbours:
        title = f"Nearest references of version {past.decision.model_version}; the ball's radius is {found.radius:.3g}"
        tables.append(listed(title, found.neighbours, *NEIGHBOUR))
    tell(record, *tables, out=out, made=lambda: {"": explained_picture(found)})


def _rows(found: Explanation) -> Iterator[tuple[str, str]]:
    past, band = found.decision, found.envelope
    version = past.decision.model_version
    yield "decided", f"{when(past.time)}, by " + (f"version {version}" if version else "no model")
    if past.decision.part is not None:
        yield "part", past.decision.part
    yield from (("" if i else "why", sentence) for i, sentence in enumerate(found.sentences))
    yield from (("" if i else "found again", note) for i, note in enumerate(found.notes))
    if band is None:
        yield "envelope", "too few successes of this shape are known yet"
        return
    usual = f"of 95 % of them fewer than {percent(band.usual, '.0f')} do"
    yield "envelope", f"{percent(band.outside, '.0f')} of its samples leave the band of {band.n:,} successes; {usual}"
    if band.not_finite:
        yield "", f"{band.not_finite} samples are NaN or infinite"


def _excesses(found: Explanation) -> Iterator[tuple[str, ...]]:
    names = found.spec.columns or [f"channel {i + 1}" for i in range(found.spec.channels)]
    for each in found.envelope.excesses[:MOST] if found.envelope else ():
        times = (f"{each.from_s:.3f} s", f"{each.to_s:.3f} s")
        yield names[each.channel], *times, f"{each.widths:.1f} {'above' if each.above else 'below'}"
