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

from ..errors import ReportError
from ..records import Action, Decision, Reason, RetrainReport, Source
from .checks import (
    already_reported,
    as_channels,
    as_hash,
    as_point,
    check_import,
    check_state,
    duplicate_id,
    unknown_decision,
)
from .records import (
    AddedPoints,
    DecidedTrace,
    Evidence,
    Labelled,
    ModelVersion,
    StoredDecision,
    stack,
    stored_decision,
    summary,
)


@dataclass(frozen=True, slots=True)
class _Label:
    seq: int
    item: DecidedTrace
    success: bool
    source: Source
    model_version: int
    point: NDArray[np.float32] | None


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
        self._kinds: Counter[tuple[Action, Reason, bool]] = Counter()
        self._times: tuple[float | None, float | None] = (None, None)

    def settings(self) -> dict[str, str]:
        return dict(self._settings)

    def save_settings(self, settings: Mapping[str, str]) -> None:
        self._settings = dict(settings)

    def put_decision(self, decision: Decision, trace: NDArray[np.float32], content_hash: int, quarantined: bool) -> None:
        """Keep a decision with a copy of its trace."""
        if decision.id in self._open or decision.id in self._done:
            raise duplicate_id(decision.id)
        item = DecidedTrace(decision, as_channels(trace), as_hash(content_hash), bool(quarantined), self._clock())
        self._open[decision.id] = item
        self._kinds[decision.action, decision.reason, item.quarantined] += 1
        self._times = (item.time if self._times[0] is None else self._times[0], item.time)
        if len(self._open) > self.KEEP_UNLABELLED:
            del self._open[next(iter(self._open))]

    def flush(self) -> None:
        """Nothing waits here."""

    def get_decision(self, decision_id: str) -> StoredDecision | None:
        """Return the decision with its trace; None where it is unknown or forgotten."""
        kept = self._open.get(decision_id) or self._done.get(decision_id)
        if kept is None:
            return None
        label = self._label_of.get(decision_id)
        return stored_decision(kept) if label is None else stored_decision(kept, label.success, label.source)

    def put_label(
        self, decision_id: str, success: bool, source: Source, model_version: int, point: NDArray[np.float32] | None
    ) -> int:
        kept = self._open.get(decision_id)
        if kept is None:
            raise self._refusal(decision_id, bool(success), source)
        seq = len(self._labels) + 1
        label = _Label(seq, kept, bool(success), source, int(model_version), as_point(point))
        self._done[decision_id] = self._open.pop(decision_id)
        self._labels.append(label)
        self._label_of[decision_id] = label
        if not kept.quarantined:
            self._train.append(label)
        return seq

    def _refusal(self, decision_id: str, success: bool, source: Source) -> ReportError:
        first = self._label_of.get(decision_id)
        if first is not None:
            return already_reported(decision_id, (first.success, first.source), (success, source))
        hint = f" In memory only the newest {self.KEEP_UNLABELLED:,} unreported decisions stay; a database keeps all."
        return unknown_decision(decision_id, hint)

    def put_labelled(
        self,
        decisions: Sequence[Decision],
        traces: NDArray[np.float32],
        hashes: NDArray[np.int64],
        labels: NDArray[np.int8],
        source: Source,
    ) -> NDArray[np.int64]:
        traces = check_import(decisions, traces, hashes, labels)
        for decision in decisions:
            if decision.id in self._open or decision.id in self._done:
                raise duplicate_id(decision.id)
        first = len(self._labels) + 1
        for decision, trace, content_hash, label in zip(decisions, traces, hashes, labels, strict=True):
            self.put_decision(decision, trace, int(content_hash), False)
            self.put_label(decision.id, bool(label), source, decision.model_version, None)
        return np.arange(first, len(self._labels) + 1, dtype=np.int64)

    def put_version(self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None) -> None:
        """Record a retrain; only the newest accepted state is kept."""
        copies = check_state(report, state)
        self._retrains.append(report)
        if report.accepted and copies is not None:
            self._version = ModelVersion(report.version, int(last_seq), copies)

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
            labels=np.array([row.success for row in rows], dtype=np.int8),
            hashes=np.array([row.item.content_hash for row in rows], dtype=np.int64),
        )

    def points_since(self, seq: int, model_version: int) -> AddedPoints:
        after = self._labels[max(0, seq) :]
        rows = [(row, row.point) for row in after if row.point is not None and row.model_version == model_version]
        return AddedPoints(
            seq=np.array([row.seq for row, _ in rows], dtype=np.int64),
            points=stack([point for _, point in rows], (0, 0)),
        )

    def evidence_since(self, seq: int) -> Evidence:
        after = [row for row in self._labels[max(0, seq) :] if not row.item.quarantined]
        return Evidence(
            seq=np.array([row.seq for row in after], dtype=np.int64),
            lower=np.array([row.item.decision.lower for row in after], dtype=np.float64),
            upper=np.array([row.item.decision.upper for row in after], dtype=np.float64),
            success=np.array([row.success for row in after], dtype=bool),
        )

    def status(self) -> dict[str, Any]:
        """Count decisions, labels and versions; forgotten decisions are counted too."""
        return summary(
            self.cell_id,
            [(action.value, reason.value, quarantined, n) for (action, reason, quarantined), n in self._kinds.items()],
            Counter(label.source.value for label in self._labels),
            self._retrains,
            self._times,
        )

    def close(self) -> None:
        """Nothing to let go of."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
