"""The store in memory: plain dicts, gone when the process ends."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ..records import Action, Decision, Reason, RetrainReport, Source
from .checks import (
    as_channels,
    as_hash,
    as_part,
    as_text,
    check_import,
    check_parts,
    check_state,
    duplicate_id,
)
from .records import (
    STATUS_EVENTS,
    AddedPoints,
    DecidedTrace,
    Event,
    Evidence,
    Labelled,
    ModelVersion,
    NewLabel,
    Outcomes,
    StoredDecision,
    checked_label,
    count_outcomes,
    imported_labels,
    refuse_repeats,
    stack,
    stored_decision,
    summary,
)


@dataclass(frozen=True, slots=True)
class _Label:
    seq: int
    time: float
    item: DecidedTrace
    given: NewLabel


class MemoryStore:
    """The contract of `Store` in plain dicts, for replays and trials: nothing outlives the process.

    Of decisions that were never reported only the newest 10,000 are kept, trace and all; an older one is counted
    and then forgotten, and a report on it is a `ReportError`. Labelled ones are kept for good.
    """

    KEEP_UNLABELLED = 10_000

    def __init__(self, cell_id: str = "cell", clock: Callable[[], float] = time.time) -> None:
        """Open an empty store; `clock` gives the time of a decision in seconds."""
        self.cell_id = cell_id
        self._clock = clock
        self._settings: dict[str, str] = {}
        self._open: dict[str, DecidedTrace] = {}  # decisions without a label
        self._done: dict[str, DecidedTrace] = {}  # and with one
        self._labels: list[_Label] = []  # label seq stands at index seq - 1
        self._label_of: dict[str, _Label] = {}
        self._train: list[_Label] = []  # not quarantined
        self._retrains: list[RetrainReport] = []
        self._version: ModelVersion | None = None
        self._events: list[Event] = []
        self._silent = 0
        self._kinds: Counter[tuple[Action, Reason, bool]] = Counter()
        self._became: Counter[tuple[Action, Action, bool, bool | None]] = Counter()  # action, predicted, audit, label
        self._times: tuple[float | None, float | None] = (None, None)

    def settings(self) -> dict[str, str]:
        return dict(self._settings)

    def save_settings(self, settings: Mapping[str, str]) -> None:
        self._settings = dict(settings)

    def put_decision(
        self,
        decision: Decision,
        trace: NDArray[np.float32],
        content_hash: int,
        quarantined: bool,
        part: str | None = None,
    ) -> None:
        """Keep a decision with a copy of its trace."""
        if self._holds(decision.id):
            raise duplicate_id(decision.id)
        values, hash_, number = as_channels(trace), as_hash(content_hash), as_part(part)
        item = DecidedTrace(decision, values, hash_, bool(quarantined), self._clock(), number)
        self._open[decision.id] = item
        self._kinds[decision.action, decision.reason, item.quarantined] += 1
        self._became[decision.action, decision.predicted, decision.audit, None] += 1
        self._times = (item.time if self._times[0] is None else self._times[0], item.time)
        if len(self._open) > self.KEEP_UNLABELLED:
            del self._open[next(iter(self._open))]

    def _holds(self, decision_id: str) -> bool:
        return decision_id in self._open or decision_id in self._done

    def flush(self) -> None:
        """Nothing waits here."""

    def get_decision(self, decision_id: str) -> StoredDecision | None:
        """Return the decision with its trace; None where it is unknown or forgotten."""
        kept = self._open.get(decision_id) or self._done.get(decision_id)
        if kept is None:
            return None
        label = self._label_of.get(decision_id)
        return stored_decision(kept) if label is None else stored_decision(kept, label.given.success, label.given.source)

    def put_label(
        self,
        decision_id: str,
        success: bool,
        source: Source,
        model_version: int,
        point: NDArray[np.float32] | None,
        *,
        silent: int = 0,
    ) -> int:
        return int(self.put_labels([NewLabel(decision_id, success, source, model_version, point, silent)])[0])

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

    def _take(self, given: NewLabel) -> None:
        item = self._done[given.decision_id] = self._open.pop(given.decision_id)
        label = _Label(len(self._labels) + 1, self._clock(), item, given)
        self._labels.append(label)
        self._label_of[given.decision_id] = label
        kind = (item.decision.action, item.decision.predicted, item.decision.audit)
        self._became[*kind, None] -= 1
        self._became[*kind, given.success] += 1
        if not item.quarantined:
            self._train.append(label)
            self._silent += given.silent

    def put_labelled(
        self,
        decisions: Sequence[Decision],
        traces: NDArray[np.float32],
        hashes: NDArray[np.int64],
        labels: NDArray[np.int8],
        source: Source,
        parts: Sequence[str | None] | None = None,
    ) -> NDArray[np.int64]:
        traces, numbers = check_import(decisions, traces, hashes, labels), check_parts(parts, len(decisions))
        for decision in decisions:
            if self._holds(decision.id):
                raise duplicate_id(decision.id)
        first, given = len(self._labels) + 1, imported_labels(decisions, labels, source)
        for decision, trace, hash_, label, part in zip(decisions, traces, hashes, given, numbers, strict=True):
            self.put_decision(decision, trace, int(hash_), False, part)
            self._take(label)  # at once, or the import would be forgotten
        return np.arange(first, first + len(given), dtype=np.int64)

    def put_version(self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None) -> int:
        """Record a retrain; only the newest accepted state is kept."""
        copies = check_state(report, state)
        self._retrains.append(report)
        if report.accepted and copies is not None:
            self._version = ModelVersion(report.version, int(last_seq), copies)
        return report.version

    def last_version(self) -> ModelVersion | None:
        """Return the newest accepted version, with arrays of its own."""
        last = self._version
        if last is None:
            return None
        return ModelVersion(last.version, last.last_seq, {name: values.copy() for name, values in last.state.items()})

    def retrains(self) -> list[RetrainReport]:
        return list(self._retrains)

    def labelled(self, limit: int | None = None) -> Labelled:
        rows = self._train if limit is None else self._train[max(0, len(self._train) - limit) :]
        return Labelled(
            seq=np.array([row.seq for row in rows], dtype=np.int64),
            traces=stack([row.item.trace for row in rows], (0, 0, 0)),
            labels=np.array([row.given.success for row in rows], dtype=np.int8),
            hashes=np.array([row.item.content_hash for row in rows], dtype=np.int64),
        )

    def points_since(self, seq: int, model_version: int) -> AddedPoints:
        after = [(row.seq, row.given) for row in self._labels[max(0, seq) :]]
        rows = [(n, given.point) for n, given in after if given.point is not None and given.model_version == model_version]
        return AddedPoints(
            seq=np.array([n for n, _ in rows], dtype=np.int64),
            points=stack([point for _, point in rows], (0, 0)),
        )

    def evidence_since(self, seq: int) -> Evidence:
        after = [row for row in self._labels[max(0, seq) :] if not row.item.quarantined]
        return Evidence(
            seq=np.array([row.seq for row in after], dtype=np.int64),
            lower=np.array([row.item.decision.lower for row in after], dtype=np.float64),
            upper=np.array([row.item.decision.upper for row in after], dtype=np.float64),
            success=np.array([row.given.success for row in after], dtype=bool),
            novel=np.array([row.item.decision.reason is Reason.NOVEL for row in after], dtype=bool),
            silent=np.array([row.given.silent for row in after], dtype=np.int64),
        )

    def unreported_accepts(self) -> list[str]:
        """Return the ids of accepted decisions without a label, oldest first; forgotten ones are not among them."""
        waiting = [item for item in self._open.values() if item.decision.action is Action.ACCEPT and not item.quarantined]
        return [item.decision.id for item in sorted(waiting, key=lambda item: item.time)]  # a stable sort

    def silent_total(self) -> int:
        return self._silent

    def outcomes(self) -> Outcomes:
        """Count what became of what the model was certain of; forgotten decisions are counted too."""
        return count_outcomes((*kind, n) for kind, n in self._became.items())

    def put_event(self, kind: str, text: str) -> None:
        self._events.append(Event(len(self._events) + 1, self._clock(), as_text(kind), as_text(text)))

    def events(self, limit: int | None = None) -> list[Event]:
        return self._events[0 if limit is None else max(0, len(self._events) - limit) :]

    def status(self) -> dict[str, Any]:
        """Count decisions, labels and versions; forgotten decisions are counted too."""
        return summary(
            self.cell_id,
            [(action.value, reason.value, quarantined, n) for (action, reason, quarantined), n in self._kinds.items()],
            Counter(label.given.source.value for label in self._labels),
            self._retrains,
            self._times,
            max((label.time for label in self._labels), default=None),
            self.events(STATUS_EVENTS),
        )

    def close(self) -> None:
        """Nothing to let go of."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
