"""The store in memory: plain dicts, gone when the process ends."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import islice
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ..records import Action, Decision, Reason, Source
from .checks import check_import, check_parts, duplicate_id
from .counting import count_outcomes, summary
from .intake import check_decision, decided_trace
from .memory_history import MemoryHistory, StoredLabel
from .memory_views import MemoryViews
from .records import (
    FORGOTTEN,
    STATUS_EVENTS,
    AddedPoints,
    DecidedTrace,
    Evidence,
    Labelled,
    NewLabel,
    Outcomes,
    StoredDecision,
    checked_label,
    imported_labels,
    refuse_repeats,
    stack,
    stored_decision,
)


class MemoryStore(MemoryHistory, MemoryViews):
    """The contract of `Store` in plain dicts, for replays and trials: nothing outlives the process.

    Of decisions that were never reported only the newest 10,000 are kept, trace and all; an older one is counted
    and then forgotten, and a report on it is a `ReportError`. Labelled ones are kept for good.
    """

    KEEP_UNLABELLED = 10_000

    def __init__(self, cell_id: str = "cell", clock: Callable[[], float] = time.time) -> None:
        """Open an empty store; `clock` gives the time of a decision in seconds."""
        super().__init__()
        self.cell_id = cell_id
        self._clock = clock
        self._settings: dict[str, str] = {}
        self._open: dict[str, DecidedTrace] = {}  # decisions without a label
        self._done: dict[str, DecidedTrace] = {}  # and with one
        self._labels: list[StoredLabel] = []  # label seq stands at index seq - 1
        self._label_of: dict[str, StoredLabel] = {}
        self._train: list[StoredLabel] = []  # not quarantined
        self._silent: Counter[int] = Counter()  # by the version that answered when the label came
        self._kinds: Counter[tuple[Action, Reason, bool]] = Counter()
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
        item = decided_trace(decision, trace, content_hash, quarantined, self._clock(), part)
        if self._holds(decision.id):
            raise duplicate_id(decision.id)
        self._open[decision.id] = item
        self._kinds[decision.action, decision.reason, item.quarantined] += 1
        self.count(item, None, 1)
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
        if label is None:
            return stored_decision(kept)
        return stored_decision(kept, self._said.get(decision_id, label.given.success), label.given.source)

    def decision_ids(self) -> list[str]:
        """Return the ids of every decision, in any order."""
        return [*self._open, *self._done]

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
        label = StoredLabel(len(self._labels) + 1, self._clock(), item, given)
        self._labels.append(label)
        self._label_of[given.decision_id] = label
        self.count(item, None, -1)
        self.count(item, int(given.success), 1)
        if not item.quarantined:
            self._train.append(label)
            self._silent[given.model_version] += given.silent

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
            check_decision(decision)
            if self._holds(decision.id):
                raise duplicate_id(decision.id)
        first, given = len(self._labels) + 1, imported_labels(decisions, labels, source)
        for decision, trace, hash_, label, part in zip(decisions, traces, hashes, given, numbers, strict=True):
            self.put_decision(decision, trace, int(hash_), False, part)
            self._take(label)  # at once, or the import would be forgotten
        return np.arange(first, first + len(given), dtype=np.int64)

    def labelled(
        self, limit: int | None = None, *, first: int = 1, last: int | None = None, corrected_to: int | None = None
    ) -> Labelled:
        said, most = self.said_to(corrected_to), len(self._labels) if last is None else last
        newest = (row for row in reversed(self._train) if first <= row.seq <= most and self.counted(row, said) != FORGOTTEN)
        rows = list(islice(newest, limit))[::-1]
        return Labelled(
            seq=np.array([row.seq for row in rows], dtype=np.int64),
            traces=stack([row.item.trace for row in rows], (0, 0, 0)),
            labels=np.array([self.counted(row, said) for row in rows], dtype=np.int8),
            hashes=np.array([row.item.content_hash for row in rows], dtype=np.int64),
        )

    def points_since(self, seq: int, model_version: int) -> AddedPoints:
        after = [(row.seq, row.given) for row in self._labels[max(0, seq) :]]
        rows = [(n, given.point) for n, given in after if given.point is not None and given.model_version == model_version]
        return AddedPoints(
            seq=np.array([n for n, _ in rows], dtype=np.int64),
            points=stack([point for _, point in rows], (0, 0)),
        )

    def evidence_since(self, seq: int, since_version: int = 0) -> Evidence:
        after = [row for row in self._labels[max(0, seq) :] if not row.item.quarantined]
        after = [
            row for row in after if row.item.decision.model_version >= since_version and self.counted(row) != FORGOTTEN
        ]
        return Evidence(
            seq=np.array([row.seq for row in after], dtype=np.int64),
            lower=np.array([row.item.decision.lower for row in after], dtype=np.float64),
            upper=np.array([row.item.decision.upper for row in after], dtype=np.float64),
            success=np.array([self.counted(row) for row in after], dtype=bool),
            novel=np.array([row.item.decision.reason is Reason.NOVEL for row in after], dtype=bool),
            silent=np.array([row.given.silent for row in after], dtype=np.int64),
        )

    def unreported_accepts(self, since_version: int = 0) -> list[str]:
        """Return the ids of accepted decisions without a label, oldest first; forgotten ones are not among them."""
        waiting = [item for item in self._open.values() if item.decision.action is Action.ACCEPT and not item.quarantined]
        waiting = [item for item in waiting if item.decision.model_version >= since_version]
        return [item.decision.id for item in sorted(waiting, key=lambda item: item.time)]  # a stable sort

    def silent_total(self, since_version: int = 0) -> int:
        return sum(n for version, n in self._silent.items() if version >= since_version)

    def outcomes(self, since_version: int = 0) -> Outcomes:
        """Count what became of what the model was certain of; forgotten decisions are counted too."""
        return count_outcomes((*kind[:4], n) for kind, n in self._became.items() if kind[4] >= since_version)

    def status(self) -> dict[str, Any]:
        """Count decisions, labels and versions; forgotten decisions are counted too."""
        return summary(
            self.cell_id,
            [(action.value, reason.value, quarantined, n) for (action, reason, quarantined), n in self._kinds.items()],
            Counter(label.given.source.value for label in self._labels if self.counted(label) != FORGOTTEN),
            self._retrains,
            self._times,
            max((label.time for label in self._labels), default=None),
            self.events(STATUS_EVENTS),
            corrected=self._corrected(),
        )

    def close(self) -> None:
        """Nothing to let go of."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
