"""What is shown of one part: the decision, its evidence, its trace among others, and what became of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...explaining import Explanation, Records, explain
from ...records import Reason
from ...store.records import Correction
from ...store.views import HistoryFilter, PastDecision
from .looking import Looking
from .trace_chart import TraceView
from .words import Words

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
    def past(self) -> PastDecision:
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
    recent: tuple[PastDecision, ...]


def now_view(looking: Looking) -> NowView:
    """Read what happens now."""
    recent = looking.store.decisions(HistoryFilter(), RECENT)[::-1]
    return NowView(part_view(looking, recent[0].id) if recent else None, tuple(recent))


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


def part_name(past: PastDecision) -> str:
    """The part's number, or the beginning of its decision's id where it has none."""
    return past.part if past.part is not None else past.id[:12]


def why(found: Explanation, w: Words) -> Iterator[str]:
    """Why the decision came out so, in the reader's language."""
    past, bound = found.decision, found.bound
    yield w(f"why.{past.reason.value}", predicted=w(f"action.{past.predicted.value}"))
    if bound is None:
        return
    n = bound.n_success + bound.n_failure
    counted = {"n": w.number(n), "good": w.number(bound.n_success), "bad": w.number(bound.n_failure)}
    yield w("why.counted", **counted) if n else w("why.nobody")
    yield w("why.bound", lower=w.percent(bound.lower, 1), upper=w.percent(bound.upper, 1))
    if past.reason is not Reason.UNCERTAIN:
        return
    if bound.accept_at is not None:
        yield w("why.accept", at=w.percent(bound.accept_at, 1), value=w.percent(bound.lower, 1))
    if bound.reject_at is not None:
        yield w("why.reject", at=w.percent(bound.reject_at, 1), value=w.percent(bound.upper, 1))
    if bound.successes_needed:
        yield w("why.needed", n=w.number(bound.successes_needed))


def story(view: PartView, w: Words) -> Iterator[tuple[float, str]]:
    """What happened to the part: time, and words."""
    past = view.past
    did = {"action": w(f"action.{past.action.value}"), "reason": w(f"reason.{past.reason.value}")}
    key = "part.decided" if past.model_version else "part.decided.none"
    yield past.time, w(key, version=past.model_version, **did)
    first = view.corrections[0].was if view.corrections else past.success
    if past.label_time is not None and past.source is not None:
        yield past.label_time, w("part.labelled", label=_label(first, w), source=w(f"source.{past.source.value}"))
    for each in view.corrections:
        author = each.author or w("part.nobody")
        yield each.time, w("part.corrected", was=_label(each.was, w), now=_label(each.success, w), author=author)


def _label(success: bool | None, w: Words) -> str:
    return w("part.forgotten") if success is None else w("label.good" if success else "label.bad")
