"""Decisions for whoever waits no more: verify, on the disk before it is said, though the engine's thread is busy."""

from __future__ import annotations

import logging

from numpy.typing import ArrayLike

from .agreeing import TraceAgreement
from .backlog import OwnedStore
from .contracts import as_agreed
from .deciding import as_part, decided_before, unasked
from .errors import StoreError
from .labels import as_id
from .records import Decision, Reason
from .store.records import DecidedTrace, StoredDecision, stored_decision

log = logging.getLogger("dengine")


class LateDecisions(TraceAgreement):
    """The part of `DataEngine` that another thread than its own may call."""

    def decide_late(self, trace: ArrayLike, part: str | int | None = None, *, decision_id: str) -> Decision:
        """VERIFY, `Reason.LATE`, in any thread: what `decide` in the engine's own would say comes too late.

        It is on the disk when this returns, and `decide` answers the same from then on. An id that has a decision keeps it;
        where both come to it at once, the first to record one. What is wrong with a trace is said as ever.
        In memory, which belongs to the engine's thread, and before the first trace has set the contract, `decide` has to
        record it, with `late`. Errors as of `decide`.
        """
        self._keeper.check()
        id_ = as_id(decision_id)
        if (known := self._known(id_)) is None:
            number = as_part(part)
            if self.trace is None or not isinstance(self.store, OwnedStore):
                return unasked(id_, number, self.version, Reason.LATE)
            reason = Reason.NO_STORE if self._keeper.away else Reason.LATE
            x = as_agreed(trace, self.trace, False)
            known = self._record(self._maker.unasked(x, number, self.version, reason, id_))
        self._keeper.secure()
        return decided_before(known, trace, self.trace)

    def _record(self, item: DecidedTrace) -> StoredDecision:
        """Record a decision; returns what its id has now: of two threads the first's."""
        known = stored_decision(item)
        first = self._keeper.recent.add(known)
        if first is known:
            self._keeper.decided(item)
        return first

    def _known(self, decision_id: str) -> StoredDecision | None:
        try:
            return None if self._keeper.recent.is_new(decision_id) else self._keeper.find(decision_id)
        except StoreError as error:  # the store is away: what was decided lately is known all the same
            log.warning("whether %r was decided before cannot be looked up: %s", decision_id, error)
            return None
