"""What the store in memory shows to whoever looks back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..records import RetrainReport
from .records import DecidedTrace, Labelled, as_label
from .views import (
    HistoryFilter,
    Key,
    PastDecision,
    PastLabel,
    PastRetrain,
    Stretch,
    Tally,
    stretch_of,
    tally_of,
)


class MemoryViews:
    """`StoreViews` in plain dicts; decisions that were forgotten are not among them."""

    _open: dict[str, DecidedTrace]
    _done: dict[str, DecidedTrace]
    _label_of: dict[str, Any]
    _labels: list[Any]
    _retrains: list[RetrainReport]
    _retrained: list[tuple[float, int]]  # when each of them was, and the newest label that it knew of

    if TYPE_CHECKING:  # the store's own

        def counted(self, label: Any) -> int: ...
        def labelled(self, limit: int | None = None) -> Labelled: ...

    def _every(self) -> list[PastDecision]:
        found = [self._past(item) for kept in (self._done, self._open) for item in kept.values()]
        return sorted(found, key=lambda past: past.key)

    def _past(self, item: DecidedTrace) -> PastDecision:
        decision, label = item.decision, self._label_of.get(item.decision.id)
        return PastDecision(
            id=decision.id,
            time=item.time,
            part=item.part,
            action=decision.action,
            predicted=decision.predicted,
            lower=decision.lower,
            upper=decision.upper,
            n_success=decision.n_success,
            n_failure=decision.n_failure,
            reason=decision.reason,
            audit=decision.audit,
            propensity=decision.propensity,
            model_version=decision.model_version,
            content_hash=item.content_hash,
            quarantined=item.quarantined,
            success=None if label is None else as_label(self.counted(label)),
            source=None if label is None else label.given.source,
            label_seq=None if label is None else label.seq,
            label_time=None if label is None else label.time,
        )

    def decisions(
        self, where: HistoryFilter, limit: int, beyond: Key | None = None, newest: bool = True
    ) -> list[PastDecision]:
        """Return the newest (or oldest) `limit` decisions that are meant, oldest first."""
        found = [past for past in self._every() if where.takes(past)]
        if newest:
            found = [past for past in found if beyond is None or past.key < beyond]
            return found[max(0, len(found) - limit) :]
        return [past for past in found if beyond is None or past.key > beyond][:limit]

    def past_decision(self, decision_id: str) -> PastDecision | None:
        """Return one decision; None where it is unknown or forgotten."""
        item = self._open.get(decision_id) or self._done.get(decision_id)
        return None if item is None else self._past(item)

    def past_labels(self, after: int, upto: int | None = None, points: bool = False) -> list[PastLabel]:
        """Return the labels after number `after`, up to `upto`, oldest first; points : with them."""
        return [self._past_label(row, points) for row in self._labels[max(0, after) : upto]]

    def _past_label(self, row: Any, points: bool) -> PastLabel:
        given, past = row.given, self._past(row.item)
        return PastLabel(
            seq=row.seq,
            time=row.time,
            decision_id=past.id,
            success=given.success,
            source=given.source,
            model_version=given.model_version,
            content_hash=past.content_hash,
            quarantined=past.quarantined,
            silent=given.silent,
            point=given.point if points else None,
            decided=past.time,
            lower=past.lower,
            upper=past.upper,
            novel=past.reason == "novel",
        )

    def past_retrains(self) -> list[PastRetrain]:
        """Return every retrain, oldest first."""
        both = zip(self._retrained, self._retrains, strict=True)
        return [PastRetrain(i, time, last_seq, report) for i, ((time, last_seq), report) in enumerate(both, start=1)]

    def labelled_upto(self, seq: int, limit: int) -> Labelled:
        """Return the newest `limit` labelled traces among the labels up to number `seq`."""
        every = self.labelled()
        here = slice(max(0, int((every.seq <= seq).sum()) - limit), int((every.seq <= seq).sum()))
        return Labelled(every.seq[here], every.traces[here], every.labels[here], every.hashes[here])

    def tally(self, last: int | None = None) -> Tally:
        """Count the newest `last` decisions, all where it is None."""
        every = self._every()
        return tally_of(every if last is None else every[max(0, len(every) - last) :])

    def stretches(self, n: int) -> list[Stretch]:
        """Cut all decisions into `n` stretches of one length at most, oldest first; the newest may be shorter."""
        every = self._every()
        length = max(1, -(-len(every) // n))
        return [stretch_of(every[start : start + length]) for start in range(0, len(every), length)]
