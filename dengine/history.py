"""The decisions of a store, as they were recorded, and what happened between them.

    for past in history(store, last=50, action="accept", label="bad"):
        print(past.id, past.lower, past.reason)

Read page by page along the time of the decisions, without their traces.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from itertools import chain
from typing import TypeVar

from .errors import SettingError
from .records import Action, Reason
from .store.base import Store
from .store.records import Event
from .store.views import LABELS, HistoryFilter, Key, PastDecision, PastRetrain

PAGE = 500  # decisions read at a time

Happened = PastDecision | PastRetrain | Event
Name = TypeVar("Name", bound=StrEnum)


def history(
    store: Store,
    last: int | None = None,
    action: Action | str | None = None,
    reason: Reason | str | None = None,
    label: str | None = None,
    since: float | None = None,
    until: float | None = None,
    predicted: Action | str | None = None,
) -> Iterator[PastDecision]:
    """The decisions of a store, newest last, one after the other as they are read.

    last : the newest so many of those that are meant; None: all.
    action, reason : an `Action` and a `Reason`, or their values.  label : good, bad or none.
    predicted : an `Action` or its value: what the model alone would have done, as in an audit or in the shadow mode.
    since, until : times in seconds since 1970; the first included, the last not.
    Raises SettingError for a value that is none of these.
    """
    if last is not None and last < 1:
        raise SettingError(f"Expected last to be 1 or more, got {last!r}; leave it out for all decisions.")
    if label is not None and label not in LABELS:
        raise SettingError(f"Expected label to be one of {', '.join(LABELS)}, got {label!r}.")
    where = HistoryFilter(_named(Action, action), _named(Reason, reason), label, since, until, _named(Action, predicted))
    return _forward(store, where) if last is None else iter(_newest(store, where, last))


def _named(kind: type[Name], value: Name | str | None) -> Name | None:
    try:
        return None if value is None else kind(value)
    except ValueError:
        known = ", ".join(kind)
        raise SettingError(f"Expected {kind.__name__.lower()} to be one of {known}, got {value!r}.") from None


def _forward(store: Store, where: HistoryFilter) -> Iterator[PastDecision]:
    beyond: Key | None = None
    while page := store.decisions(where, PAGE, beyond, newest=False):
        yield from page
        beyond = page[-1].key


def _newest(store: Store, where: HistoryFilter, last: int) -> list[PastDecision]:
    pages: list[list[PastDecision]] = []
    beyond: Key | None = None
    left = last
    while left and (page := store.decisions(where, min(PAGE, left), beyond)):
        pages.append(page)
        beyond, left = page[0].key, left - len(page)
    return list(chain.from_iterable(reversed(pages)))


@dataclass(frozen=True, slots=True)
class Beside:
    """What happened beside the decisions, oldest first."""

    retrains: tuple[PastRetrain, ...]
    events: tuple[Event, ...]


def beside(store: Store, since: float | None = None, until: float | None = None) -> Beside:
    """The retrains and events of a store between two times in seconds; None: from its beginning, to now."""

    def meant(time: float) -> bool:
        return (since is None or time >= since) and (until is None or time < until)

    retrains = tuple(each for each in store.past_retrains() if meant(each.time))
    return Beside(retrains, tuple(each for each in store.events() if meant(each.time)))


def interleaved(decisions: list[PastDecision], others: Beside) -> Iterator[Happened]:
    """All of it in the order in which it happened; what has the same time keeps that order too."""
    return heapq.merge(others.retrains, others.events, decisions, key=lambda each: each.time)
