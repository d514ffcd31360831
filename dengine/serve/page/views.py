"""What each view shows, read from the store: the newest part, one part, the map, how it is doing, the history."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from enum import StrEnum
from typing import TypeVar
from urllib.parse import urlencode

import numpy as np
from numpy.typing import NDArray

from ...experiments.figures import is_probability
from ...history.explain import Explanation, Records, as_it_stood, explain
from ...history.status import Course, Status, Watch, course, status, watch
from ...records import Action, Reason, Source
from ...store.records import Correction, Event, Key, StoredDecision
from ...store.views import LABELS, HistoryFilter, PastRetrain
from .charts import Mark, PartMap, TraceView, number
from .looking import Looking

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
    "does.accept": "The part goes on without the check.",
    "does.reject": "The part goes back to the bin.",
    "does.verify": "The part goes to the check.",
    "label.good": "good",
    "label.bad": "bad",
    "label.none": "not known",
    "came.good": "It was good.",
    "came.bad": "It was bad.",
    "came.none": "Nothing is known of it yet.",
    "mode.short.decides": "Decides",
    "mode.short.learns": "Learning",
    "mode.short.shadow": "Verifying all",
    "mode.short.safe": "Safe mode",
    "how.verdict.kept": "Tolerance kept",
    "how.verdict.open": "Not decided yet",
    "how.verdict.broken": "Tolerance broken",
    "how.bad.by.every": "Every outcome is known.",
    "how.bad.by.audits": "Estimated by audits.",
    "how.bad.by.none": "Only stops are known so far; audits would bound it.",
}
RECENT = 14  # parts in the strip of the newest
BADS, AMONG = 10, 200  # newest bad parts that are drawn, of so many newest labels
FRESH = 10  # new labels, after which the bad parts are looked up again


@dataclass(frozen=True)
class PartView:
    """One part.  bads : (n, C, T) some bad ones.  corrections : of its label, oldest first."""

    found: Explanation
    bads: NDArray[np.float32]
    corrections: tuple[Correction, ...]

    @property
    def past(self) -> StoredDecision:
        """The decision as it was recorded."""
        return self.found.decision

    @property
    def trace(self) -> TraceView:
        """What its picture is drawn from."""
        return TraceView(self.found.trace, self.found.spec, self.found.envelope, self.bads)


@dataclass(frozen=True)
class NowView:
    """What happens now.  part : the newest, None before the first.  recent : the newest decisions, newest first."""

    part: PartView | None
    recent: tuple[StoredDecision, ...]


def now_view(looking: Looking) -> NowView:
    """Read what happens now."""
    recent = looking.store.decisions(HistoryFilter(), RECENT)[::-1]
    return NowView(part_view(looking, recent[0].decision.id) if recent else None, tuple(recent))


def part_view(looking: Looking, decision_id: str) -> PartView | None:
    """Read one part; None for an id that is unknown."""
    past = looking.store.past_decision(decision_id)
    if past is None:
        return None
    corrections = looking.store.corrections()
    own = tuple(each for each in corrections if each.decision_id == decision_id)
    # What was known then does not change, but for corrections: the evidence of a part is read once.
    found = looking.kept(
        ("explained", decision_id), (past, len(corrections)), lambda: explain(decision_id, Records(looking.store))
    )
    return PartView(found, _bads(looking, found.trace.shape), own)


def _bads(looking: Looking, shape: tuple[int, ...]) -> NDArray[np.float32]:
    engine = looking.service.engine
    fits = (engine.version, engine.new_labels // FRESH)
    newest: NDArray[np.float32] = looking.kept("bads", fits, lambda: _newest_bads(looking))
    return newest if newest.shape[1:] == shape else np.zeros((0, *shape), np.float32)


def _newest_bads(looking: Looking) -> NDArray[np.float32]:
    labelled = looking.store.labelled(AMONG)
    bads: NDArray[np.float32] = labelled.traces[labelled.labels == 0][-BADS:]
    return bads


def part_name(past: StoredDecision) -> str:
    """The part's number, or the beginning of its decision's id where it has none."""
    return past.decision.part if past.decision.part is not None else past.decision.id[:12]


def moment(seconds: float | None) -> str:
    """Day and time of day, by the server's clock; seconds since 1970."""
    return "–" if seconds is None else f"{datetime.fromtimestamp(seconds):%Y-%m-%d %H:%M:%S}"


def clock(seconds: float | None) -> str:
    """The time of day."""
    return "–" if seconds is None else f"{datetime.fromtimestamp(seconds):%H:%M:%S}"


def duration(seconds: float) -> str:
    """90 s, 12 min, 3.4 h."""
    if abs(seconds) < 120:
        return f"{number(seconds)} s"
    return f"{number(seconds / 60)} min" if abs(seconds) < 7200 else f"{number(seconds / 3600, 1)} h"


def story(view: PartView) -> Iterator[tuple[float, str]]:
    """What happened to the part: time, and words."""
    past = view.past
    by = f" by model {past.decision.model_version}" if past.decision.model_version else ", before the first model"
    yield past.time, f"{past.decision.action.value.capitalize()} ({WORDS[f'reason.{past.decision.reason.value}']}){by}"
    first = view.corrections[0].was if view.corrections else past.success
    if past.label_time is not None and past.source is not None:
        yield past.label_time, f"known to be {LABEL[first]}, by {SOURCE[past.source]}"
    for each in view.corrections:
        yield each.time, f"corrected from {LABEL[each.was]} to {LABEL[each.success]} by {each.author or 'somebody'}"


KNOWN = 250  # newest known parts that are drawn
NEWEST = 10  # newest parts that are drawn beside them
NAMED = 1000  # newest decisions whose parts' numbers are looked up


def map_view(looking: Looking) -> PartMap | None:
    """Read the map; None before the first model, and for one that keeps no references."""
    engine = looking.service.engine
    version, recipe = engine.version, looking.recipe
    if version == 0:
        return None
    recent = looking.store.decisions(HistoryFilter(), NAMED)
    names = {past.decision.id: part_name(past) for past in recent}
    known = looking.kept(
        "known parts", (version, engine.new_labels, len(looking.store.corrections())), lambda: _known(looking, version)
    )
    if known is None:
        return None
    newest = _newest(looking, recent[-NEWEST:], version)
    shown = {mark.id for mark in newest}
    marks = [*(replace(mark, name=names.get(mark.id, mark.name)) for mark in known if mark.id not in shown), *newest]
    radius = recipe.radius if recipe.fraction is None and newest else None
    return PartMap(version, tuple(marks), radius, is_probability(recipe)) if marks else None


def _known(looking: Looking, version: int) -> tuple[Mark, ...] | None:
    answering = as_it_stood(looking.store, version, looking.recipe, None)
    if answering is None:
        return None
    points, labels = np.asarray(answering.index.points), np.asarray(answering.index.labels)
    found = []
    for slot, behind in enumerate(answering.labels_of_references()):
        if behind is not None:
            x, y = _plane(points[slot])
            name = behind.decision_id
            found.append((behind.seq, Mark(name, name[:12], x, y, "good" if labels[slot] else "bad")))
    return tuple(mark for _, mark in sorted(found, key=lambda each: each[0])[-KNOWN:])


def _newest(looking: Looking, recent: list[StoredDecision], version: int) -> list[Mark]:
    found = []
    for past in recent:
        stored = looking.store.get_decision(past.decision.id) if past.decision.model_version == version else None
        if stored is None or stored.decision.embedding is None:
            continue
        x, y = _plane(np.asarray(stored.decision.embedding).mean(axis=0))
        last = past is recent[-1]
        found.append(Mark(past.decision.id, part_name(past), x, y, past.label, past.decision.action.value, last))
    return found


def _plane(point: np.ndarray) -> tuple[float, float]:
    """The first two dimensions, (d,) -> x, y; 0 where a reducer has but one."""
    return float(point[0]), float(point[1]) if len(point) > 1 else 0.0


LAST = 500  # parts that are looked at apart
PACE = 30  # newest parts, by which parts an hour are counted
EVENTS = 12


@dataclass(frozen=True)
class HowView:
    """How it is doing.  course : None before the first decision.  pace : parts an hour, None before the second."""

    doing: Status
    watch: Watch | None
    course: Course | None
    pace: float | None
    events: tuple[Event, ...]

    @property
    def left_out(self) -> int:
        """Checks that were left out."""
        return self.doing.ever.accepted + self.doing.ever.rejected

    @property
    def retrained(self) -> PastRetrain | None:
        """The newest accepted retrain."""
        return next((each for each in reversed(self.doing.retrains) if each.report.accepted), None)


def how_view(looking: Looking) -> HowView:
    """Read how it is doing."""
    store, recipe, engine = looking.store, looking.recipe, looking.service.engine
    doing = status(store, LAST)
    return HowView(
        doing=doing,
        watch=looking.kept("watch", (engine.version, engine.new_labels, recipe), lambda: watch(store, recipe)),
        course=course(store, recipe, LAST) if doing.ever.decisions else None,
        pace=_pace(looking),
        events=tuple(store.events(EVENTS)[::-1]),
    )


def _pace(looking: Looking) -> float | None:
    tally = looking.store.tally(PACE)
    if tally.first is None or tally.last is None or tally.last <= tally.first:
        return None
    return 3600.0 * (tally.count() - 1) / (tally.last - tally.first)


def mode_of(looking: Looking) -> tuple[str, str]:
    """How decisions are made now, decides, learns, shadow or safe, and why a safe mode began."""
    engine = looking.service.engine
    if why := engine.safe_mode:
        return "safe", why
    if engine.shadow:
        return "shadow", ""
    return ("learns" if engine.version == 0 else "decides"), ""


PAGE = 50
FILTERS = (("action", "Decision", tuple(Action)), ("reason", "Reason", tuple(Reason)), ("label", "Label", tuple(LABELS)))

Name = TypeVar("Name", bound=StrEnum)


@dataclass(frozen=True)
class HistoryQuery:
    """What was asked for; what does not make sense of it is left out.  asked : the words of it that make sense."""

    where: HistoryFilter
    beyond: Key | None
    asked: tuple[tuple[str, str], ...]

    def get(self, name: str) -> str:
        """What was asked for by a name; "" for nothing."""
        return dict(self.asked).get(name, "")


@dataclass(frozen=True)
class HistoryView:
    """A page of decisions, newest first.  older : the query of the next page, "" where there is none."""

    query: HistoryQuery
    decisions: tuple[StoredDecision, ...]
    older: str


def history_query(words: Mapping[str, str]) -> HistoryQuery:
    """Read a query's words: action, reason, label, since, until (as a date and time of the server), before."""
    action, reason = _named(Action, words.get("action")), _named(Reason, words.get("reason"))
    label = words.get("label") if words.get("label") in LABELS else None
    since, until = _moment(words.get("since")), _moment(words.get("until"))
    sound = {"action": action, "reason": reason, "label": label, "since": since, "until": until}
    asked = tuple((name, words[name]) for name, value in sound.items() if value is not None)
    return HistoryQuery(HistoryFilter(action, reason, label, since, until), _key(words.get("before")), asked)


def history_view(looking: Looking, query: HistoryQuery) -> HistoryView:
    """Read a page."""
    page = looking.store.decisions(query.where, PAGE, query.beyond)
    older = ""
    if len(page) == PAGE:
        older = urlencode([*query.asked, ("before", f"{page[0].time!r},{page[0].decision.id}")])
    return HistoryView(query, tuple(page[::-1]), older)


def _named(kind: type[Name], value: str | None) -> Name | None:
    return kind(value) if value in set(kind) else None


def _moment(value: str | None) -> float | None:
    try:
        return datetime.fromisoformat(value).timestamp() if value else None
    except (ValueError, OverflowError, OSError):  # no date, or none that a clock knows
        return None


def _key(value: str | None) -> Key | None:
    time, _, name = (value or "").partition(",")
    try:
        return (float(time), name) if name else None
    except ValueError:
        return None
