"""The store in memory: plain dicts, gone when the process ends."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..records import Action, Decision, Reason, RetrainReport
from .base import Store
from .journal import Record, TakenLabel
from .records import (
    FORGOTTEN,
    KEEP,
    NO_TRACE,
    STATUS_EVENTS,
    AddedPoints,
    Change,
    Correction,
    Event,
    Evidence,
    Key,
    Labelled,
    ModelVersion,
    NewLabel,
    News,
    Outcomes,
    StoredDecision,
    StoredVersion,
    as_data,
    as_label,
    as_text,
    check_state,
    checked_decision,
    checked_label,
    duplicate_id,
    keeps_state,
    mixed_shapes,
    not_kept,
    nothing_to_correct,
    refuse_repeats,
    unknown_decision,
)
from .views import HistoryFilter, PastLabel, Stretch, Tally, count_outcomes, stretch_of, summary, tally_of


@dataclass(frozen=True, slots=True)
class StoredLabel:
    """A label in memory, with its decision."""

    seq: int
    time: float
    item: StoredDecision
    given: NewLabel


class MemoryStore(Store):
    """The contract of `Store` in plain dicts, for replays and trials: nothing outlives the process.

    Of decisions that were never reported only the newest 10,000 are kept, trace and all; an older one is counted
    and then forgotten, and a report on it is a `ReportError`. Labelled ones are kept for good. Of versions it keeps the
    states that a database keeps. It has no product, no journal, and answers at once.
    """

    KEEP_UNLABELLED = 10_000

    def __init__(self, cell_id: str = "cell", clock: Callable[[], float] = time.time) -> None:
        """Open an empty store; `clock` gives the time of a decision in seconds."""
        self.cell_id = cell_id
        self.product: str | None = None
        self.wait: float | None = None
        self.clock = clock
        self.before_use: Callable[[], None] = lambda: None
        self._settings: dict[str, str] = {}
        self._open: dict[str, StoredDecision] = {}  # decisions without a label
        self._done: dict[str, StoredDecision] = {}  # and with one
        self._labels: list[StoredLabel] = []  # label seq stands at index seq - 1
        self._label_of: dict[str, StoredLabel] = {}
        self._train: list[StoredLabel] = []  # not quarantined
        self._silent: Counter[int] = Counter()  # by the version that answered when the label came
        self._kinds: Counter[tuple[Action, Reason, bool]] = Counter()
        self._times: tuple[float | None, float | None] = (None, None)
        self._retrains: list[StoredVersion] = []
        self._states: dict[int, ModelVersion] = {}  # those that `keeps_state` keeps, the newest last
        self._events: list[Event] = []
        self._corrections: list[Correction] = []
        self._said: dict[str, bool | None] = {}  # by decision, what its newest correction says
        # Action, predicted, audit, label or FORGOTTEN, version
        self._became: Counter[tuple[Action, Action, bool, int | None, int]] = Counter()

    def settings(self) -> dict[str, str]:
        return dict(self._settings)

    def save_settings(self, settings: Mapping[str, str]) -> None:
        self._settings = dict(settings)

    def put_decision(self, decision: Decision, trace: NDArray[np.float32], content_hash: int, quarantined: bool) -> None:
        self._put(checked_decision(decision, trace, content_hash, quarantined, self.clock()))

    def _put(self, item: StoredDecision) -> None:
        decision = item.decision
        if self._holds(decision.id):
            raise duplicate_id(decision.id)
        self._open[decision.id] = item
        self._kinds[decision.action, decision.reason, item.quarantined] += 1
        self._count(item, None, 1)
        self._times = (item.time if self._times[0] is None else self._times[0], item.time)
        if len(self._open) > self.KEEP_UNLABELLED:
            del self._open[next(iter(self._open))]

    def _holds(self, decision_id: str) -> bool:
        return decision_id in self._open or decision_id in self._done

    def get_decision(self, decision_id: str, trace: bool = True) -> StoredDecision | None:
        kept = self._open.get(decision_id) or self._done.get(decision_id)
        return None if kept is None else replace(self._known(kept), trace=kept.trace.copy() if trace else NO_TRACE)

    def decision_ids(self) -> list[str]:
        return [*self._open, *self._done]

    def put_labels(self, labels: Sequence[NewLabel]) -> NDArray[np.int64]:
        given = [checked_label(label) for label in labels]
        known = {label.decision_id for label in given if self._holds(label.decision_id)}
        kept = {name: self._label_of[name].given for name in known if name in self._label_of}
        hint = f" In memory only the newest {self.KEEP_UNLABELLED:,} unreported decisions stay; a database keeps all."
        refuse_repeats(given, known, {name: (first.success, first.source) for name, first in kept.items()}, hint)
        first = len(self._labels) + 1
        for label in given:
            self._take(label)
        return np.arange(first, first + len(given), dtype=np.int64)

    def take(self, records: Sequence[Record]) -> list[tuple[str, int]]:
        arrived = []
        for record in records:
            if isinstance(record, StoredDecision):
                self._put(record)
            elif isinstance(record, TakenLabel):
                arrived.append((record.label.decision_id, int(self.put_labels([record.label])[0])))
            else:
                self._events.append(replace(record, number=len(self._events) + 1))
        return arrived

    def _take(self, given: NewLabel) -> None:
        item = self._done[given.decision_id] = self._open.pop(given.decision_id)
        label = StoredLabel(len(self._labels) + 1, self.clock(), item, given)
        self._labels.append(label)
        self._label_of[given.decision_id] = label
        self._count(item, None, -1)
        self._count(item, int(given.success), 1)
        if not item.quarantined:
            self._train.append(label)
            self._silent[given.model_version] += given.silent

    def labelled(
        self,
        limit: int | None = None,
        *,
        first: int = 1,
        last: int | None = None,
        corrected_to: int | None = None,
        own: bool = False,
    ) -> Labelled:
        said = self._said
        if corrected_to is not None:
            said = {each.decision_id: each.success for each in self._corrections[: max(0, corrected_to)]}
        most = len(self._labels) if last is None else last
        newest = (row for row in reversed(self._train) if first <= row.seq <= most)
        rows = list(islice((row for row in newest if self._counted(row, said) != FORGOTTEN), limit))[::-1]
        return self._with_traces(rows, said)

    def _with_traces(self, rows: Sequence[StoredLabel], said: Mapping[str, bool | None]) -> Labelled:
        traces = [row.item.trace for row in rows]
        if len(shapes := {trace.shape for trace in traces}) > 1:
            raise mixed_shapes(shapes)
        return Labelled(
            seq=np.array([row.seq for row in rows], dtype=np.int64),
            traces=np.stack(traces) if rows else np.zeros((0, 0, 0), dtype=np.float32),
            labels=np.array([self._counted(row, said) for row in rows], dtype=np.int8),
            hashes=np.array([row.item.content_hash for row in rows], dtype=np.int64),
        )

    def news_since(self, seq: int, limit: int) -> News:
        after = (row for row in self._train if row.seq > seq and self._counted(row) != FORGOTTEN)
        labelled = self._with_traces(list(islice(after, limit)), self._said)
        return News(labelled, max(self._states, default=0), len(self._corrections))

    def points_since(self, seq: int, model_version: int) -> AddedPoints:
        after = [(row.seq, row.given) for row in self._labels[max(0, seq) :]]
        return AddedPoints.of(
            (n, given.point) for n, given in after if given.point is not None and given.model_version == model_version
        )

    def evidence_since(self, seq: int, since_version: int = 0) -> Evidence:
        found = []
        for row in self._labels[max(0, seq) :]:
            made, label = row.item.decision, self._counted(row)
            if not row.item.quarantined and made.model_version >= since_version and label != FORGOTTEN:
                found.append((row.seq, made.lower, made.upper, label, made.reason is Reason.NOVEL, row.given.silent))
        return Evidence.of(found)

    def unreported_accepts(self, since_version: int = 0) -> list[str]:
        """Return the ids of accepted decisions without a label, oldest first; forgotten ones are not among them."""
        waiting = [item for item in self._open.values() if item.decision.action is Action.ACCEPT and not item.quarantined]
        return [item.decision.id for item in waiting if item.decision.model_version >= since_version]  # as they came

    def silent_total(self, since_version: int = 0) -> int:
        return sum(n for version, n in self._silent.items() if version >= since_version)

    def outcomes(self, since_version: int = 0) -> Outcomes:
        """Count what became of what the model was certain of; forgotten decisions are counted too."""
        return count_outcomes((*kind[:4], n) for kind, n in self._became.items() if kind[4] >= since_version)

    def status(self) -> dict[str, Any]:
        """Count decisions, labels and versions; forgotten decisions are counted too."""
        forgotten = sum(success is None for success in self._said.values())
        return summary(
            self.cell_id,
            [(action.value, reason.value, quarantined, n) for (action, reason, quarantined), n in self._kinds.items()],
            Counter(label.given.source.value for label in self._labels if self._counted(label) != FORGOTTEN),
            self.retrains(),
            self._times,
            max((label.time for label in self._labels), default=None),
            self.events(STATUS_EVENTS),
            corrected=len(self._said) - forgotten,
            forgotten=forgotten,
        )

    def close(self) -> None:
        """Nothing to let go of."""

    # Model versions

    def put_version(self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None) -> int:
        """Record a retrain; of older versions few keep their states, as in a database. A dropped candidate has none."""
        copies, now = check_state(report, state), self.clock()
        self._retrains.append(StoredVersion(len(self._retrains) + 1, now, int(last_seq), report))
        if report.accepted and copies is not None:
            held = self._states | {report.version: ModelVersion(report.version, int(last_seq), copies)}
            self._states = {n: held[n] for n in held if keeps_state(n, report.version, KEEP)}
        return report.version

    def last_version(self) -> ModelVersion | None:
        return _copied(self._states[next(reversed(self._states))]) if self._states else None

    def load_version(self, version: int) -> ModelVersion:
        if version not in self._states:
            raise not_kept(version, self._states)
        return _copied(self._states[version])

    def versions(self, own: bool = False) -> list[StoredVersion]:
        found = []
        for each in self._retrains:
            kept = self._states.get(each.report.version) if each.report.accepted else None
            n_bytes = 0 if kept is None else sum(values.nbytes for values in kept.state.values())
            found.append(replace(each, n_bytes=n_bytes, kept=kept is not None))
        return found

    # Events

    def events(self, limit: int | None = None) -> list[Event]:
        return self._events[0 if limit is None else max(0, len(self._events) - limit) :]

    # Corrections

    def record(self, change: Change) -> int:
        number, now, author = len(self._events) + 1, self.clock(), as_text(change.author)
        event = Event(number, now, as_text(change.kind), as_text(change.text), as_data(change.data), author)
        for name in change.decisions:
            if name not in self._label_of:
                raise nothing_to_correct(name) if name in self._open else unknown_decision(name)
        if change.version is not None:
            self.put_version(*change.version)
        self._events.append(event)
        for name in change.decisions:
            self._correct(self._label_of[name], change.success, event)
        if change.settings is not None:
            self._settings = dict(change.settings)
        return number

    def _correct(self, label: StoredLabel, success: bool | None, event: Event) -> None:
        before = self._counted(label)
        was = None if before == FORGOTTEN else bool(before)
        made = (len(self._corrections) + 1, event.time, label.item.decision.id, success, was, event.author, event.number)
        self._corrections.append(Correction(*made, newest_seq=len(self._labels), seq=label.seq))
        self._said[label.item.decision.id] = success
        self._count(label.item, before, -1)
        self._count(label.item, self._counted(label), 1)

    def corrections(self, after: int = 0) -> list[Correction]:
        return self._corrections[max(0, after) :]

    def _counted(self, label: StoredLabel, said: Mapping[str, bool | None] | None = None) -> int:
        """A label as it counts: 0, 1 or FORGOTTEN."""
        success = (self._said if said is None else said).get(label.item.decision.id, label.given.success)
        return FORGOTTEN if success is None else int(success)

    def _count(self, item: StoredDecision, label: int | None, n: int) -> None:
        """Count `n` more decisions of this kind and label."""
        made = item.decision
        self._became[made.action, made.predicted, made.audit, label, made.model_version] += n

    # Looking back; decisions that were forgotten are not among them

    def _every(self) -> list[StoredDecision]:
        found = [replace(self._known(item), trace=NO_TRACE) for kept in (self._done, self._open) for item in kept.values()]
        return sorted(found, key=lambda past: past.key)

    def _known(self, item: StoredDecision) -> StoredDecision:
        """A decision with its label as it counts."""
        label = self._label_of.get(item.decision.id)
        if label is None:
            return item
        said = as_label(self._counted(label))
        return replace(item, success=said, source=label.given.source, label_seq=label.seq, label_time=label.time)

    def decisions(
        self, where: HistoryFilter, limit: int, beyond: Key | None = None, newest: bool = True
    ) -> list[StoredDecision]:
        found = [past for past in self._every() if where.takes(past)]
        if newest:
            found = [past for past in found if beyond is None or past.key < beyond]
            return found[max(0, len(found) - limit) :]
        return [past for past in found if beyond is None or past.key > beyond][:limit]

    def past_labels(self, after: int, upto: int | None = None, points: bool = False) -> list[PastLabel]:
        found = []
        for row in self._labels[max(0, after) : upto]:
            of, item = row.given, row.item
            known = (row.seq, row.time, of.decision_id, of.success, of.source, of.model_version, item.content_hash)
            bound = (item.time, item.decision.lower, item.decision.upper, item.decision.reason is Reason.NOVEL)
            found.append(PastLabel(*known, item.quarantined, of.silent, of.point if points else None, *bound))
        return found

    def tally(self, last: int | None = None) -> Tally:
        every = self._every()
        return tally_of(every if last is None else every[max(0, len(every) - last) :])

    def stretches(self, n: int) -> list[Stretch]:
        every = self._every()
        length = max(1, -(-len(every) // n))
        return [stretch_of(every[start : start + length]) for start in range(0, len(every), length)]


def _copied(version: ModelVersion) -> ModelVersion:
    return replace(version, state={name: values.copy() for name, values in version.state.items()})
