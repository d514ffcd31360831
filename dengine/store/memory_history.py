"""What a store in memory keeps of an engine's history: versions, events, and the corrections of people."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from numpy.typing import NDArray

from ..records import Action, RetrainReport
from .checks import as_data, as_text, check_state, nothing_to_correct, unknown_decision
from .kept_versions import KEEP, StoredVersion, keeps_state, not_kept
from .records import FORGOTTEN, Change, Correction, DecidedTrace, Event, ModelVersion, NewLabel


@dataclass(frozen=True, slots=True)
class StoredLabel:
    """A label in memory, with its decision."""

    seq: int
    time: float
    item: DecidedTrace
    given: NewLabel


class MemoryHistory:
    """The part of `MemoryStore` that is about its history. Of versions it keeps the states that a database keeps."""

    _clock: Callable[[], float]
    _open: dict[str, DecidedTrace]
    _labels: list[StoredLabel]
    _label_of: dict[str, StoredLabel]
    _settings: dict[str, str]

    def __init__(self) -> None:
        self._retrains: list[RetrainReport] = []
        self._retrained: list[tuple[float, int]] = []  # when each of them was, and the newest label that it knew of
        self._listed: list[StoredVersion] = []
        self._states: dict[int, ModelVersion] = {}  # those that `keeps_state` keeps, the newest last
        self._events: list[Event] = []
        self._corrections: list[Correction] = []
        self._said: dict[str, bool | None] = {}  # by decision, what its newest correction says
        # Action, predicted, audit, label or FORGOTTEN, version
        self._became: Counter[tuple[Action, Action, bool, int | None, int]] = Counter()

    # Model versions

    def put_version(self, report: RetrainReport, last_seq: int, state: Mapping[str, NDArray[Any]] | None) -> int:
        """Record a retrain; of older versions few keep their states, as in a database. A dropped candidate has none."""
        copies, now = check_state(report, state), self._clock()
        self._retrains.append(report)
        self._retrained.append((now, int(last_seq)))
        n_bytes = sum(values.nbytes for values in (copies or {}).values())
        kept = report.accepted and copies is not None
        self._listed.append(StoredVersion(report.version, now, report.accepted, report.reason, n_bytes, kept))
        if report.accepted and copies is not None:
            held = self._states | {report.version: ModelVersion(report.version, int(last_seq), copies)}
            self._states = {n: held[n] for n in held if keeps_state(n, report.version, KEEP)}
        return report.version

    def last_version(self) -> ModelVersion | None:
        """Return the newest accepted version, with arrays of its own."""
        return _copied(self._states[next(reversed(self._states))]) if self._states else None

    def load_version(self, version: int) -> ModelVersion:
        """Return an accepted version by its number, with arrays of its own; StoreError where its state is not kept."""
        if version not in self._states:
            raise not_kept(version, self._states)
        return _copied(self._states[version])

    def kept_version(self, version: int) -> ModelVersion | None:
        """Return an accepted version; None where it is not kept."""
        return _copied(self._states[version]) if version in self._states else None

    def versions(self) -> list[StoredVersion]:
        """Return every retrain, oldest first, and whether its state is kept."""
        return [row if not row.kept or row.version in self._states else _thinned(row) for row in self._listed]

    def retrains(self) -> list[RetrainReport]:
        return list(self._retrains)

    # Events

    def put_event(self, kind: str, text: str, data: Mapping[str, Any] | None = None, author: str = "") -> None:
        self.record(Change(kind, text, data, author))

    def events(self, limit: int | None = None) -> list[Event]:
        return self._events[0 if limit is None else max(0, len(self._events) - limit) :]

    # Corrections

    def record(self, change: Change) -> int:
        """Keep what a person changed, all or none, together with its event."""
        number, now, author = len(self._events) + 1, self._clock(), as_text(change.author)
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
        before = self.counted(label)
        was = None if before == FORGOTTEN else bool(before)
        made = (len(self._corrections) + 1, event.time, label.item.decision.id, success, was, event.author, event.number)
        self._corrections.append(Correction(*made, newest_seq=len(self._labels), seq=label.seq))
        self._said[label.item.decision.id] = success
        self.count(label.item, before, -1)
        self.count(label.item, self.counted(label), 1)

    def corrections(self, after: int = 0) -> list[Correction]:
        return self._corrections[max(0, after) :]

    def counted(self, label: StoredLabel, said: Mapping[str, bool | None] | None = None) -> int:
        """A label as it counts: 0, 1 or FORGOTTEN."""
        success = (self._said if said is None else said).get(label.item.decision.id, label.given.success)
        return FORGOTTEN if success is None else int(success)

    def said_to(self, corrected_to: int | None) -> dict[str, bool | None]:
        """By decision, what its newest correction says of those up to this number."""
        if corrected_to is None:
            return self._said
        return {each.decision_id: each.success for each in self._corrections[: max(0, corrected_to)]}

    def count(self, item: DecidedTrace, label: int | None, n: int) -> None:
        """Count `n` more decisions of this kind and label."""
        made = item.decision
        self._became[made.action, made.predicted, made.audit, label, made.model_version] += n

    def _corrected(self) -> dict[str, int]:
        forgotten = sum(success is None for success in self._said.values())
        return {"forgotten": forgotten, "corrected": len(self._said) - forgotten}


def _thinned(row: StoredVersion) -> StoredVersion:
    return replace(row, n_bytes=0, kept=False)


def _copied(version: ModelVersion) -> ModelVersion:
    copies = {name: values.copy() for name, values in version.state.items()}
    return ModelVersion(version.version, version.last_seq, copies)
