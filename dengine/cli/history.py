"""The subcommands `dengine history`, which lists the decisions of a store with the retrains and
events between them, and `dengine explain`, which says why one decision came out as it did.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from heapq import merge
from typing import TYPE_CHECKING, Any

import click

from ..errors import outward, percent
from . import options
from .options import NameChoice, verb
from .output import (
    Out,
    format_duration,
    format_time,
    print_result,
    table_of_records,
    table_of_rows,
)

if TYPE_CHECKING:
    from ..history.explain import Explanation
    from ..store.records import Event, StoredDecision, StoredVersion

TABLE_WIDTH = 120  # columns
SECONDS_OF = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}
PART_LENGTH = 10  # characters of a part's number that are shown, its last
SHORT_TIME = "%Y-%m-%d %H:%M:%S"
NEIGHBOUR_FIELDS = ("decision_id", "part", "success", "source", "distance", "space", "inside")


class Moment(click.ParamType):  # type: ignore[type-arg]  # click made it generic in 8.3
    """The type of an option that takes a time.

    How long ago it was (90s, 30m, 12h, 7d), or a date (2026-03-01, 2026-03-01T14:30), in UTC unless
    it has an offset.
    """

    name = "TIME"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the time in seconds since 1970; a usage error for a text that is no time.

        "30m" is 30 minutes before now (likewise s, h and d, also with decimals); otherwise the text
        is a date, with or without a time, in ISO 8601, which is in UTC if it has no offset. A date
        alone is its midnight. Dates may lie in the future.
        """
        ago = re.fullmatch(r"(\d+(?:\.\d+)?)([smhd])", value)
        if ago:
            return time.time() - float(ago[1]) * SECONDS_OF[ago[2]]
        try:
            moment = datetime.fromisoformat(value)
        except ValueError:
            self.fail(f"expected 30m, 12h, 7d or 2026-03-01T14:30, got {value!r}.", param, ctx)
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


@verb("dengine history engine.db --last 20 --events")
@options.store_argument
@click.option(
    "--last",
    type=options.COUNT,
    default=50,
    help="How many of the newest decisions are shown.",
)
@click.option("--action", type=NameChoice("action"), help="Only decisions with this action.")
@click.option(
    "--model",
    "predicted",
    type=NameChoice("action"),
    help=(
        "Only decisions where the model alone would have done this, as in an audit or in shadow "
        "mode."
    ),
)
@click.option("--reason", type=NameChoice("reason"), help="Only decisions with this reason.")
@click.option(
    "--label",
    type=NameChoice("label"),
    help="Only decisions with this label, or without a reported one.",
)
@click.option("--part", metavar="NUMBER", help="Only decisions on the part with this number.")
@click.option(
    "--since",
    type=Moment(),
    help="Only decisions since then: 30m, 12h, 7d ago, or 2026-03-01T14:30, in UTC.",
)
@click.option("--until", type=Moment(), help="Only decisions before then, given as for --since.")
@click.option("--events", is_flag=True, help="Show the retrains and events between them too.")
def history(store: str, events: bool, **criteria: Any) -> None:
    """Show the decisions of a store, newest last.

    STORE is the file or URL of an engine's store (its database), and must exist. The options choose
    which decisions. --events adds the retrains, and the events (what else happened, such as a
    corrected label), from the time of the first of these decisions on (if no decision fits, all),
    or from --since on, and before --until. In the table part has the last 10 characters of the
    part's number, model is what the model alone would have done, if that differs from the action,
    as in an audit (a random check of a part of which the model is certain) or in shadow mode (every
    part is checked), good and bad are the numbers of labels nearby that were counted, bound is the
    interval of the success probability that follows from them, v is the version of the model, and
    label is what the part turned out to be. If there is nothing to list, a sentence says so.
    `dengine explain` tells more about one decision.
    """
    from ..history.status import history as read_history
    from ..representation import to_jsonable
    from ..store.opening import open_store

    others: dict[str, list[Any]] = {}
    with open_store(store, must_exist=True) as opened:
        decisions = list(read_history(opened, **criteria))
        if events:
            others["retrains"] = opened.versions.all(cell_only=True)
            others["events"] = opened.events.newest()
    since = criteria["since"]
    if since is None:
        since = decisions[0].time if decisions else 0.0
    end = math.inf if criteria["until"] is None else criteria["until"]
    for name, items in others.items():
        others[name] = [item for item in items if since <= item.time < end]
    record = {
        "store": store,
        "decisions": [to_jsonable(decision) | {"label": decision.label} for decision in decisions],
    } | others
    in_order = merge(*others.values(), decisions, key=lambda item: item.time)
    print_result(record, _history_table(list(in_order)))


def _label_text(stored: StoredDecision) -> str:
    """Return a decision's label, and how it became known, as text: "good verified", "bad stop".

    A corrected label is shown as corrected, but with the source of the first report. The one
    exception: an accepted part that was reported as good and then corrected to bad has the source
    "stop" (the part stopped the line). The text is "-" if there is no label, or if a person
    withdrew it.
    """
    if stored.success is None:
        return "-"
    source = "" if stored.source is None else stored.source.value
    return f"{stored.label} {source.replace('verification', 'verified')}".rstrip()


def _model_text(stored: StoredDecision) -> str:
    """Return the action that the model alone would have taken, like "accept"; "" if that is the
    action of the decision.
    """
    predicted = stored.decision.predicted
    return "" if predicted is stored.decision.action else predicted.value


def _bound_text(stored: StoredDecision) -> str:
    """Return the interval of a decision's success probability as text, such as 0.81-0.97.

    It has two decimals and is rounded outward; "-" if the decision has no interval.
    """
    decision = stored.decision
    if math.isnan(decision.lower):
        return "-"
    return "{:.2f}-{:.2f}".format(*outward(decision.lower, decision.upper, 2))


# Alignment ("<" or ">") and title of a column -> its text.
COLUMNS: dict[str, Callable[[StoredDecision], str]] = {
    "<time (UTC)": lambda stored: format_time(stored.time, SHORT_TIME),
    "<decision": lambda stored: stored.decision.id,
    "<part": lambda stored: (stored.decision.part or "-")[-PART_LENGTH:],
    "<action": lambda stored: stored.decision.action.value,
    "<model": _model_text,
    "<bound": _bound_text,
    ">good": lambda stored: str(stored.decision.n_success),
    ">bad": lambda stored: str(stored.decision.n_failure),
    "<reason": lambda stored: stored.decision.reason.value,
    ">v": lambda stored: str(stored.decision.model_version),
    "<label": _label_text,
}


def _history_table(items: Sequence[StoredDecision | StoredVersion | Event]) -> str:
    """Return a table of decisions as text, in the order of the items.

    It has a row for each decision, with the columns in `COLUMNS`, from its time to its label.
    Retrains (`StoredVersion`) and events, which say what else happened, are lines between its rows,
    cut to 119 characters; the rows are not cut, but of a part's number they have only the last 10
    characters. Two lines of titles come first, also if no item is a decision. Without any item the
    text is a sentence that says so.
    """
    from ..store.records import StoredDecision

    if not items:
        return "No decision of that kind."
    decisions = [item for item in items if isinstance(item, StoredDecision)]
    columns = []
    for name, cell in COLUMNS.items():
        texts = [name[1:], *map(cell, decisions)]
        width = max(map(len, texts))
        texts.insert(1, "-" * width)
        columns.append([f"{text:{name[0]}{width}}" for text in texts])
    rows = ("  ".join(row).rstrip() for row in zip(*columns, strict=True))
    lines = (
        next(rows) if isinstance(item, StoredDecision) else _event_line(item) for item in items
    )
    return "\n".join([next(rows), next(rows), *lines])


def _event_line(item: StoredVersion | Event) -> str:
    """Return the line of an event or a retrain: its time in UTC, what happened, and why.

    The line of a retrain also has the number of traces and the duration; it names the version of
    the model that came into use, or, if the retrain was dropped (its model is not used), the number
    of the retrain. The text of an event is put on one line. A longer line is cut to 120 characters,
    of which the last three are "...".
    """
    from ..store.records import Event

    if isinstance(item, Event):
        text = f"{item.kind}: {' '.join(item.text.split())}"
    else:
        report = item.report
        title = f"retrain {item.number}"
        if report.accepted:
            title = f"retrain to version {report.version}"
        duration = format_duration(report.seconds)
        text = f"{title}, {report.n_traces} traces, {duration}: {report.reason}"
    line = f"{format_time(item.time, SHORT_TIME)}  * {text}"
    return line if len(line) <= TABLE_WIDTH else f"{line[: TABLE_WIDTH - 3]}..."


@verb("dengine explain engine.db last --out why.png")
@options.store_argument
@click.argument("decision", metavar="PART|ID")
@click.option(
    "--neighbours",
    type=click.IntRange(0),
    default=10,
    help="How many of the nearest references are shown.",
)
@options.picture_option
def explain(store: str, decision: str, neighbours: int, out: Out | None) -> None:
    """Explain why a decision came out as it did.

    The decision is named by its id, as `dengine history STORE` lists it, by its part's number, or
    by the word last, for the newest. If a part has several decisions that are no rejects (a reject
    sorts the part out without a check), or several rejects and nothing else, its number is refused
    with exit code 1; the message has their ids. Only the newest 20 decisions on the part are looked
    at. A decision that is not in the store is refused, too, and so is one whose trace is damaged,
    or the trace of one of its neighbours, the labelled traces of other parts nearest to it. The
    counts of labels nearby, the bound (the interval of the success probability) and the action are
    shown as they were recorded. Neighbours are searched again with the version (the trained model)
    that decided, if the store still has it. The picture of --out shows the trace with its
    neighbours and with the band that holds the middle 95 % of the known good traces. Damaged
    labels, and damaged traces of this band, are left out, and an event in the store's log records
    this.
    """
    from ..errors import ReportError
    from ..experiments.figures import explained_picture
    from ..history.explain import explain as explain_decision
    from ..history.status import history
    from ..representation import to_jsonable
    from ..store.opening import open_store

    with open_store(store, must_exist=True) as opened:
        if decision == "last":
            newest = next(history(opened, last=1), None)
            if newest is None:
                raise ReportError(
                    f"Expected a decision in {store}, there is none yet; let an engine decide "
                    "first."
                )
            decision = newest.decision.id
        explanation = explain_decision(opened, decision, neighbours)
    explained = explanation.decision.decision
    title = f"{explained.id}: {explained.action.value}, {explained.reason.value}"
    tables = [table_of_rows(title, _explanation_rows(explanation))]
    if explanation.neighbours:
        title = (
            f"Nearest references of version {explained.model_version}; the radius of the "
            f"neighbourhood is {explanation.radius:.3g}"
        )
        tables.append(table_of_records(title, explanation.neighbours, *NEIGHBOUR_FIELDS))
    print_result(
        {"store": store} | to_jsonable(explanation),
        *tables,
        out=out,
        make_files=lambda: {"": explained_picture(explanation)},
    )


def _explanation_rows(explanation: Explanation) -> Iterator[tuple[str, str]]:
    """Yield rows of a table, (title, text), that explain a decision.

    They say when the decision was made and by which version of the model, or that there was no
    model, on which part (if it has a number), and why. Then come the notes, which say with which
    version its neighbours (the nearest labelled traces) were searched again, or why none are shown.
    The last row is the share of samples that leave the envelope, the band of the known good traces,
    or says that there are too few of these. Of several sentences, or notes, only the first has a
    title.
    """
    decision = explanation.decision.decision
    version = decision.model_version
    decider = f"version {version}" if version else "no model"
    yield "decided", f"{format_time(explanation.decision.time)}, by {decider}"
    if decision.part is not None:
        yield "part", decision.part
    for i, sentence in enumerate(explanation.sentences):
        yield "" if i else "why", sentence
    for i, sentence in enumerate(explanation.notes):
        yield "" if i else "found again", sentence
    envelope = explanation.envelope
    if envelope is None:
        yield "envelope", "too few successes of this shape are known yet"
        return
    yield (
        "envelope",
        f"{percent(envelope.outside, '.0f')} of its samples leave the band of {envelope.n:,} "
        "successes",
    )
