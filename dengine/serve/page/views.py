"""What each view shows, read from the store: the newest part, one part, the map, how it is doing, the history."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from typing import NamedTuple, TypeVar
from urllib.parse import urlencode

import numpy as np
from numpy.typing import NDArray

from ...experiments.figures import is_probability
from ...history.explain import Explanation, as_it_stood, explain
from ...history.status import Course, Status, Watch, course, status, watch
from ...records import Action, Reason, Source
from ...store.records import Correction, Event, Key, StoredDecision
from ...store.views import LABELS, HistoryFilter, PastRetrain
from .charts import Mark, PartMap, number
from .looking import Looking

T = TypeVar("T")
LABEL = {True: "good", False: "bad", None: "forgotten"}
SOURCE = {
    Source.VERIFICATION: "check",
    Source.AUDIT: "audit",
    Source.STOP: "system stop",
    Source.CONFIRMED: "confirmed later",
}
WORDS = {
    **{f"action.{each.value}": each.value.capitalize() for each in Action},
    **{f"reason.{each.value}": each.value.replace("_", " ") for each in Reason},
    "reason.not_finite": "samples missing",
    "reason.constant": "dead sensor",
    "reason.saturated": "sensor at its limit",
    "reason.no_model": "no model yet",
    "reason.no_store": "store away",
    "reason.late": "too late",
    "label.good": "good",
    "label.bad": "bad",
    "label.none": "not known",
}
RECENT = 14  # parts in the strip of the newest
BADS, AMONG = 10, 200  # newest bad parts that are drawn, of so many newest labels
FRESH = 10  # new labels, after which the bad parts are looked up again
KNOWN, NEWEST = 250, 10  # parts on the map: the newest known ones, and the newest of all
NAMED = 1000  # newest decisions whose parts' numbers are looked up
PACE = 30  # newest parts, by which parts an hour are counted
PAGE = 50  # decisions on a page of the history
FILTERS = (("action", "Decision", tuple(Action)), ("reason", "Reason", tuple(Reason)), ("label", "Label", tuple(LABELS)))


def part_name(past: StoredDecision) -> str:
    """The part's number, or the beginning of its decision's id where it has none."""
    return past.decision.part if past.decision.part is not None else past.decision.id[:12]


def moment(seconds: float | None, form: str = "%Y-%m-%d %H:%M:%S") -> str:
    """Day and time of day, by the server's clock; seconds since 1970."""
    return "–" if seconds is None else f"{datetime.fromtimestamp(seconds):{form}}"


def clock(seconds: float | None) -> str:
    """The time of day."""
    return moment(seconds, "%H:%M:%S")


def duration(seconds: float) -> str:
    """90 s, 12 min, 3.4 h."""
    if abs(seconds) < 120:
        return f"{number(seconds)} s"
    return f"{number(seconds / 60)} min" if abs(seconds) < 7200 else f"{number(seconds / 3600, 1)} h"


class PartView(NamedTuple):
    """One part.  bads : (n, C, T) some bad ones.  corrections : of its label, oldest first."""

    found: Explanation
    bads: NDArray[np.float32]
    corrections: tuple[Correction, ...]

    @property
    def past(self) -> StoredDecision:
        """The decision as it was recorded."""
        return self.found.decision


class NowView(NamedTuple):
    """What happens now.  part : the newest, None before the first.  recent : the newest decisions, newest first."""

    part: PartView | None
    recent: list[StoredDecision]


def now_view(looking: Looking) -> NowView:
    """Read what happens now."""
    recent = looking.store.decisions(HistoryFilter(), RECENT)[::-1]
    return NowView(part_view(looking, recent[0].decision.id) if recent else None, recent)


def part_view(looking: Looking, decision_id: str) -> PartView | None:
    """Read one part; None for an id that is unknown."""
    store, engine = looking.store, looking.service.engine
    past = store.past_decision(decision_id)
    if past is None:
        return None
    corrections = store.corrections()
    # What was known then does not change, but for corrections: the evidence of a part is read once.
    fits = past, len(corrections)
    found = looking.kept(("explained", decision_id), fits, lambda: explain(store, decision_id))

    def newest_bads() -> NDArray[np.float32]:
        labelled = store.labelled(AMONG)
        bads: NDArray[np.float32] = labelled.traces[labelled.labels == 0][-BADS:]
        return bads

    bads = looking.kept("bads", (engine.version, engine.new_labels // FRESH), newest_bads)
    if bads.shape[1:] != found.trace.shape:
        bads = np.zeros((0, *found.trace.shape), np.float32)
    return PartView(found, bads, tuple(each for each in corrections if each.decision_id == decision_id))


def story(view: PartView) -> Iterator[tuple[float, str]]:
    """What happened to the part: time, and words."""
    past, decision = view.past, view.past.decision
    by = f" by model {decision.model_version}" if decision.model_version else ", before the first model"
    yield past.time, f"{decision.action.value.capitalize()} ({WORDS[f'reason.{decision.reason.value}']}){by}"
    first = view.corrections[0].was if view.corrections else past.success
    if past.label_time is not None and past.source is not None:
        yield past.label_time, f"known to be {LABEL[first]}, by {SOURCE[past.source]}"
    for each in view.corrections:
        yield each.time, f"corrected from {LABEL[each.was]} to {LABEL[each.success]} by {each.author or 'somebody'}"


def map_view(looking: Looking) -> PartMap | None:
    """Read the map; None before the first model, and for one that keeps no references."""
    store, engine, recipe = looking.store, looking.service.engine, looking.recipe
    version = engine.version
    if version == 0:
        return None
    recent = store.decisions(HistoryFilter(), NAMED)
    names = {past.decision.id: part_name(past) for past in recent}
    fits = version, engine.new_labels, len(store.corrections())
    known = looking.kept("known parts", fits, lambda: _known(looking, version))
    if known is None:
        return None
    newest = []
    for past in recent[-NEWEST:]:
        stored = store.get_decision(past.decision.id) if past.decision.model_version == version else None
        if stored is not None and (at := stored.decision.embedding) is not None:
            place, action = _plane(np.asarray(at).mean(axis=0)), past.decision.action.value
            newest.append(Mark(past.decision.id, part_name(past), *place, past.label, action, past is recent[-1]))
    shown = {mark.id for mark in newest}
    marks = [*(replace(mark, name=names.get(mark.id, mark.name)) for mark in known if mark.id not in shown), *newest]
    radius = recipe.radius if recipe.fraction is None and newest else None
    return PartMap(tuple(marks), radius, is_probability(recipe)) if marks else None


def _known(looking: Looking, version: int) -> list[Mark] | None:
    """The newest parts behind a version's references, oldest first."""
    answering = as_it_stood(looking.store, version, looking.recipe, None)
    if answering is None:
        return None
    points, labels = np.asarray(answering.index.points), np.asarray(answering.index.labels)
    behind = [(label.seq, slot, label.decision_id) for slot, label in enumerate(answering.labels_of_references()) if label]
    return [
        Mark(id_, id_[:12], *_plane(points[slot]), "good" if labels[slot] else "bad")
        for _, slot, id_ in sorted(behind)[-KNOWN:]
    ]


def _plane(point: np.ndarray) -> tuple[float, float]:
    """The first two dimensions, (d,) -> x, y; 0 where a reducer has but one."""
    return float(point[0]), float(point[1]) if len(point) > 1 else 0.0


@dataclass(frozen=True)
class HowView:
    """How it is doing.  course : None before the first decision.  pace : parts an hour, None before the second."""

    doing: Status
    watch: Watch | None
    course: Course | None
    pace: float | None
    events: list[Event]

    @property
    def left_out(self) -> int:
        """Checks that were left out."""
        return self.doing.ever.accepted + self.doing.ever.rejected

    @property
    def retrained(self) -> PastRetrain | None:
        """The newest accepted retrain."""
        return next((each for each in reversed(self.doing.retrains) if each.report.accepted), None)


def how_view(looking: Looking, last: int = 500) -> HowView:
    """Read how it is doing.  last : parts that are looked at apart."""
    store, recipe, engine = looking.store, looking.recipe, looking.service.engine
    doing, tally = status(store, last), store.tally(PACE)
    seconds = 0.0 if tally.first is None or tally.last is None else tally.last - tally.first
    return HowView(
        doing=doing,
        watch=looking.kept("watch", (engine.version, engine.new_labels, recipe), lambda: watch(store, recipe)),
        course=course(store, recipe, last) if doing.ever.decisions else None,
        pace=3600.0 * (tally.count() - 1) / seconds if seconds > 0 else None,
        events=store.events(12)[::-1],
    )


def mode_of(looking: Looking) -> tuple[str, str]:
    """How decisions are made now, decides, learns, shadow or safe, and why a safe mode began."""
    engine = looking.service.engine
    if why := engine.safe_mode:
        return "safe", why
    return "shadow" if engine.shadow else "learns" if engine.version == 0 else "decides", ""


@dataclass(frozen=True)
class HistoryQuery:
    """What was asked for; what does not make sense of it is left out.  asked : the words of it that make sense."""

    where: HistoryFilter
    beyond: Key | None
    asked: tuple[tuple[str, str], ...]

    def get(self, name: str) -> str:
        """What was asked for by a name; "" for nothing."""
        return dict(self.asked).get(name, "")


class HistoryView(NamedTuple):
    """A page of decisions, newest first.  older : the query of the next page, "" where there is none."""

    query: HistoryQuery
    decisions: list[StoredDecision]
    older: str


def history_query(words: Mapping[str, str]) -> HistoryQuery:
    """Read a query's words: action, reason, label, since, until (as a date and time of the server), before."""
    where = HistoryFilter(
        action=_read(words.get("action"), Action),
        reason=_read(words.get("reason"), Reason),
        label=words["label"] if words.get("label") in LABELS else None,
        since=_read(words.get("since"), _seconds),
        until=_read(words.get("until"), _seconds),
    )
    names = ("action", "reason", "label", "since", "until")
    asked = tuple((name, words[name]) for name in names if getattr(where, name) is not None)
    return HistoryQuery(where, _read(words.get("before"), _key), asked)


def _read(text: str | None, kind: Callable[[str], T]) -> T | None:
    """A word of a query; None where it makes no sense."""
    try:
        return kind(text) if text else None
    except (ValueError, OverflowError, OSError):  # OSError: a date that no clock knows
        return None


def _seconds(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


def _key(text: str) -> Key:
    time, id_ = text.split(",", 1)
    return float(time), id_


def history_view(looking: Looking, query: HistoryQuery) -> HistoryView:
    """Read a page."""
    page = looking.store.decisions(query.where, PAGE, query.beyond)
    older = [*query.asked, ("before", f"{page[0].time!r},{page[0].decision.id}")] if len(page) == PAGE else []
    return HistoryView(query, page[::-1], urlencode(older))
