"""Where an engine remembers: the `Store` protocol, and `MemoryStore`, which forgets when the process ends.

    store = open_store("engine.db")      # SqlStore; `open_store(None)` is a MemoryStore

The database behind `SqlStore` lives in `sql_store.py`, so that importing this module costs numpy and no more.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from dengine.errors import ReportError, StoreError
from dengine.records import Action, Decision, Reason, RetrainReport, Source


@dataclass(frozen=True, slots=True)
class StoredDecision:
    """What a report needs to know of a decision.

    trace : (C, T) float32.
    content_hash : signed 64 bit; equal traces share it.
    quarantined : kept, but never given to training.
    success, source : the label, if one was reported.
    """

    id: str
    action: Action
    predicted: Action
    audit: bool
    reason: Reason
    model_version: int
    trace: NDArray[np.float32]
    content_hash: int
    quarantined: bool
    success: bool | None
    source: Source | None


@dataclass(frozen=True, slots=True)
class Labelled:
    """Labelled traces without the quarantined ones, oldest label first.

    seq : (n,) label sequence numbers, increasing.
    traces : (n, C, T); (0, 0, 0) where there is none.
    labels : (n,) 1 success, 0 failure.
    hashes : (n,) content hashes.
    """

    seq: NDArray[np.int64]
    traces: NDArray[np.float32]
    labels: NDArray[np.int8]
    hashes: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class AddedPoints:
    """References added to a model version after its swap, in label order; points : (n, d), (0, 0) if there is none."""

    seq: NDArray[np.int64]
    points: NDArray[np.float32]
    labels: NDArray[np.int8]
    hashes: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class ModelVersion:
    """A model that was swapped in.

    last_seq : newest label that its references hold.
    state : weights, references, training ids: plain arrays by name.
    """

    version: int
    last_seq: int
    state: dict[str, NDArray[Any]]


@runtime_checkable
class Store(Protocol):
    """What an engine needs of its memory. Everything belongs to one cell, `cell_id`."""

    cell_id: str

    def settings(self) -> dict[str, str]:
        """What `save_settings` was given; {} for a new store."""

    def save_settings(self, settings: Mapping[str, str]) -> None:
        """Replace the settings by these."""

    def put_decision(
        self, decision: Decision, trace: NDArray[np.float32], content_hash: int, quarantined: bool
    ) -> None:
        """Take a decision and its trace, (C, T) or (T,), without waiting for the disk."""

    def flush(self) -> None:
        """Return when every decision so far is committed."""

    def get_decision(self, decision_id: str) -> StoredDecision | None:
        """Return the decision with its trace, queued ones included; None where it is unknown."""

    def put_label(
        self, decision_id: str, success: bool, source: Source, model_version: int, point: NDArray[np.float32] | None
    ) -> int:
        """Commit a label, with its decision, before returning its sequence number 1, 2, ...

        point : (d,) where the trace joined the references of `model_version`; None where it did not.
        """

    def put_labelled(
        self,
        decisions: Sequence[Decision],
        traces: NDArray[np.float32],
        hashes: NDArray[np.int64],
        labels: NDArray[np.int8],
        source: Source,
    ) -> NDArray[np.int64]:
        """Import labelled traces, all or none; returns their sequence numbers."""

    def put_version(self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None) -> None:
        """Record a retrain; a dropped candidate has no state."""

    def last_version(self) -> ModelVersion | None:
        """Return the newest accepted version."""

    def retrains(self) -> list[RetrainReport]:
        """Return every retrain, oldest first."""

    def labelled(self, limit: int | None = None) -> Labelled:
        """Return the newest `limit` labelled traces, all where it is None."""

    def points_since(self, seq: int, model_version: int) -> AddedPoints:
        """Return the points of `model_version` that came with labels after `seq`."""

    def status(self) -> dict[str, Any]:
        """Count decisions, labels and versions."""

    def close(self) -> None:
        """Flush and let go."""


def open_store(store: str | os.PathLike[str] | Store | None) -> Store:
    """Return the store that a user named: nothing (memory), a file or URL (database), or a store as it is."""
    if store is None:
        return MemoryStore()
    if isinstance(store, str | os.PathLike):
        from dengine.sql_store import SqlStore  # SQLAlchemy is imported where it is used

        return SqlStore(os.fspath(store))
    if not isinstance(store, Store):
        raise StoreError(f"Expected None, a file, a URL or a Store, got {type(store).__name__}; see `Store`.")
    return store


# What every store says and checks alike.


def unknown_decision(decision_id: str, hint: str = "") -> ReportError:
    """Return the error for a report on a decision that the store does not hold."""
    return ReportError(
        f"Expected the id of a stored decision, got {decision_id!r}, which this cell's store does not hold; "
        f"report the `Decision.id` that `decide` returned, to the same store and cell_id.{hint}"
    )


def already_reported(decision_id: str, first: tuple[bool, Source], second: tuple[bool, Source]) -> ReportError:
    """Return the error for a second label; it names the first, which stands."""
    said, says = (f"{'success' if success else 'failure'} from {source.value}" for success, source in (first, second))
    same = first[0] == second[0]
    advice = "nothing more needs reporting" if same else "if the first was wrong, look at how the part was checked"
    return ReportError(
        f"Expected one report a decision, got a second on {decision_id!r}: {said} was reported first and stands, "
        f"now came {says}; {advice}."
    )


def as_channels(trace: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a float32 copy of a trace, (T,) or (C, T) -> (C, T); the caller's buffer may change afterwards."""
    copy = np.array(trace, dtype=np.float32, order="C", ndmin=2)
    if copy.ndim != 2:
        raise StoreError(f"Expected a trace of shape (C, T), got {copy.shape}; store one trace at a time.")
    return copy


def as_hash(content_hash: int) -> int:
    """Return a content hash as a signed 64-bit integer, which is what a database holds."""
    value = int(content_hash)
    if not -(2**63) <= value < 2**63:
        raise StoreError(f"Expected a content hash of signed 64 bits, got {value}; view it as int64.")
    return value


def as_point(point: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
    """Return a float32 copy of an embedded point, (d,)."""
    if point is None:
        return None
    copy = np.array(point, dtype=np.float32, order="C")
    if copy.ndim != 1:
        raise StoreError(f"Expected a point of shape (d,), got {copy.shape}; flatten it before it is stored.")
    return copy


def check_state(report: RetrainReport, state: Mapping[str, NDArray[Any]] | None) -> dict[str, NDArray[Any]] | None:
    """Copy a version's arrays; an accepted version needs them, and none may hold Python objects (a pickle)."""
    if state is None:
        if report.accepted:
            raise StoreError(f"Expected the arrays of accepted version {report.version}, got None; pass its state.")
        return None
    copies = {name: np.array(values) for name, values in state.items()}
    for name, values in copies.items():
        if values.dtype.hasobject:
            raise StoreError(f"Expected plain arrays, got dtype {values.dtype} for {name!r}; store numbers or strings.")
    return copies


def check_import(
    decisions: Sequence[Decision], traces: NDArray[Any], hashes: NDArray[Any], labels: NDArray[Any]
) -> NDArray[np.float32]:
    """Return the traces of an import as (n, C, T) float32, once every part of it has n rows."""
    traces = np.asarray(traces, dtype=np.float32)
    traces = traces[:, None, :] if traces.ndim == 2 else traces
    lengths = (len(decisions), len(traces), len(hashes), len(labels))
    if traces.ndim != 3 or len(set(lengths)) != 1:
        raise StoreError(
            f"Expected n decisions, traces (n, C, T), hashes and labels, got {lengths} of them and traces of shape "
            f"{traces.shape}; give one of each a part."
        )
    twice = [name for name, times in Counter(decision.id for decision in decisions).items() if times > 1]
    if twice:
        raise duplicate_id(twice[0])
    return traces


def duplicate_id(decision_id: str) -> StoreError:
    """Return the error for two decisions of one id; the first stands."""
    return StoreError(
        f"Expected a new decision id, got {decision_id!r}, which this cell's store holds already; "
        "the first decision stands, give every decision an id of its own."
    )


@dataclass(frozen=True, slots=True)
class _Label:
    seq: int
    decision_id: str
    success: bool
    source: Source
    model_version: int
    point: NDArray[np.float32] | None
    trace: NDArray[np.float32]
    content_hash: int


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
        self._open: dict[str, tuple[Decision, NDArray[np.float32], int, bool]] = {}  # decisions without a label
        self._done: dict[str, tuple[Decision, NDArray[np.float32], int, bool]] = {}  # and with one
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

    def put_decision(
        self, decision: Decision, trace: NDArray[np.float32], content_hash: int, quarantined: bool
    ) -> None:
        """Keep a decision with a copy of its trace."""
        if decision.id in self._open or decision.id in self._done:
            raise duplicate_id(decision.id)
        self._open[decision.id] = (decision, as_channels(trace), as_hash(content_hash), bool(quarantined))
        self._count(decision, bool(quarantined))
        if len(self._open) > self.KEEP_UNLABELLED:
            del self._open[next(iter(self._open))]

    def _count(self, decision: Decision, quarantined: bool) -> None:
        now = self._clock()
        self._kinds[decision.action, decision.reason, quarantined] += 1
        self._times = (now if self._times[0] is None else self._times[0], now)

    def flush(self) -> None:
        """Nothing waits here."""

    def get_decision(self, decision_id: str) -> StoredDecision | None:
        """Return the decision with its trace; None where it is unknown or forgotten."""
        kept = self._open.get(decision_id) or self._done.get(decision_id)
        if kept is None:
            return None
        label = self._label_of.get(decision_id)
        return stored_decision(*kept) if label is None else stored_decision(*kept, label.success, label.source)

    def put_label(
        self, decision_id: str, success: bool, source: Source, model_version: int, point: NDArray[np.float32] | None
    ) -> int:
        kept = self._open.get(decision_id)
        if kept is None:
            raise self._refusal(decision_id, bool(success), source)
        _, trace, content_hash, quarantined = kept
        seq = len(self._labels) + 1
        label = _Label(
            seq, decision_id, bool(success), source, int(model_version), as_point(point), trace, content_hash
        )
        self._done[decision_id] = self._open.pop(decision_id)
        self._labels.append(label)
        self._label_of[decision_id] = label
        if not quarantined:
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
            traces=stack([row.trace for row in rows], (0, 0, 0)),
            labels=np.array([row.success for row in rows], dtype=np.int8),
            hashes=np.array([row.content_hash for row in rows], dtype=np.int64),
        )

    def points_since(self, seq: int, model_version: int) -> AddedPoints:
        after = self._labels[max(0, seq) :]
        rows = [(row, row.point) for row in after if row.point is not None and row.model_version == model_version]
        return AddedPoints(
            seq=np.array([row.seq for row, _ in rows], dtype=np.int64),
            points=stack([point for _, point in rows], (0, 0)),
            labels=np.array([row.success for row, _ in rows], dtype=np.int8),
            hashes=np.array([row.content_hash for row, _ in rows], dtype=np.int64),
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def stored_decision(
    decision: Decision,
    trace: NDArray[np.float32],
    content_hash: int,
    quarantined: bool,
    success: bool | None = None,
    source: Source | None = None,
) -> StoredDecision:
    """Return what a report needs, with a trace of its own."""
    return StoredDecision(
        decision.id,
        decision.action,
        decision.predicted,
        decision.audit,
        decision.reason,
        decision.model_version,
        trace.copy(),
        content_hash,
        quarantined,
        success,
        source,
    )


def stack(rows: Sequence[NDArray[np.float32]], empty: tuple[int, ...]) -> NDArray[np.float32]:
    """Return rows of one shape as one array; none of them as `empty`."""
    if not rows:
        return np.zeros(empty, dtype=np.float32)
    shapes = {row.shape for row in rows}
    if len(shapes) > 1:
        raise mixed_shapes(shapes)
    return np.stack(rows)


def mixed_shapes(shapes: set[tuple[int, ...]]) -> StoreError:
    """Return the error for traces or points that do not fit together."""
    return StoreError(
        f"Expected one shape in a cell's store, found {sorted(shapes)}; give each kind of trace a cell_id of its own."
    )


def summary(
    cell_id: str,
    kinds: Sequence[tuple[str, str, bool, int]],
    sources: Mapping[str, int],
    retrains: Sequence[RetrainReport],
    times: tuple[float | None, float | None],
    write_failures: int = 0,
) -> dict[str, Any]:
    """Return the status of a store from its counts; kinds : (action, reason, quarantined, how many)."""
    actions: Counter[str] = Counter()
    reasons: Counter[str] = Counter()
    for action, reason, _, n in kinds:
        actions[action] += n
        reasons[reason] += n
    versions = [report.version for report in retrains if report.accepted]
    return {
        "cell_id": cell_id,
        "decisions": sum(actions.values()),
        "actions": {action.value: actions[action.value] for action in Action},
        "reasons": {reason.value: reasons[reason.value] for reason in Reason},
        "quarantined": sum(n for _, _, quarantined, n in kinds if quarantined),
        "labels": sum(sources.values()),
        "sources": {source.value: sources.get(source.value, 0) for source in Source},
        "retrains": len(retrains),
        "versions": len(versions),
        "last_version": versions[-1] if versions else None,
        "first_time": times[0],
        "last_time": times[1],
        "write_failures": write_failures,
    }
