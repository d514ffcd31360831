"""What the history shows: decisions that fit the filters, a page at a time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import TypeVar
from urllib.parse import urlencode

from ...records import Action, Reason
from ...store.views import LABELS, HistoryFilter, Key, PastDecision
from .looking import Looking

PAGE = 50
FILTERS = {"action": tuple(Action), "reason": tuple(Reason), "label": tuple(LABELS)}

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
    decisions: tuple[PastDecision, ...]
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
        older = urlencode([*query.asked, ("before", f"{page[0].time!r},{page[0].id}")])
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
