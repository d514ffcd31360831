"""`DecisionMaker` converts a trace as the `TraceSpec` in force demands, turns it into a
`StoredDecision` (the model's decision, an id, a version and a time) and hands it to the outbox.
`engine.DataEngine` calls its methods in order.

The functions below it check what a caller passes, a part's number and an id that was decided
before, and make a VERIFY without a trace.
"""

import uuid
from contextlib import suppress
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from ..decision.decider import DecisionConditions, Verdict, decider_without_model
from ..errors import NotTakenError, StoreError, TraceConflictError, TraceError, expect, log
from ..folds import part_hash
from ..records import (
    ACTIONS,
    LONGEST,
    REASONS,
    Action,
    Decision,
    Reason,
    TraceArray,
    TraceSpec,
    as_id,
    is_name,
    is_whole,
)
from ..store.records import StoredDecision
from ..traces import as_trace, infer_trace_spec
from .guard import NOT_PRECOMPUTED, guarded
from .live_model import LiveModel
from .settings import read_peers_trace_spec


class DecisionMaker:
    """Makes decisions under the settings in force, gives them ids, and records them.

    Parameters
    ----------
    live : LiveModel
        Holds the model that decides; its outbox takes the decisions. Its settings are read at each
        decision; the first trace without a fault sets the `TraceSpec` in them.
    """

    def __init__(self, live: LiveModel) -> None:
        self._settings = live.settings
        self._live = live
        self._outbox = live.outbox
        self._has_seen_trace = False  # a finite one, since the engine was made or opened
        self._run = uuid.uuid4().hex[:12]
        self._count = count(1)

    def set_trace_spec(self, spec: TraceSpec) -> TraceSpec:
        """Set the `TraceSpec` (shape, rate and unit of all traces); return the one in force.

        If a `TraceSpec` is in force already, it stays. It only gets from `spec` a rate, units and
        columns (names of channels) that were unknown; a `spec` of another shape is ignored. If none
        is in force and another cell of the product (robot cells that share labels and versions) has
        set one, its `TraceSpec` is taken in the same way; if it cannot be read, that is logged and
        `spec` is set.

        A change is saved in the store; if the store does not take it, it is saved with a later
        trace; this is logged. Raises SettingError if the force limits (an operator's limits of the
        signal) do not fit the `TraceSpec`; then nothing changes. Saving raises it, too, if another
        cell of the product has settings that contradict these; the new `TraceSpec` then stays in
        force here and is not saved.
        """
        store = self._outbox.store
        present = self._settings.now
        agreed = present.trace
        try:
            if agreed is None and store.product is not None:
                agreed = self._outbox.call_store(lambda: read_peers_trace_spec(store))
        except StoreError:  # the cell's own first trace stands
            log.exception("the product's TraceSpec cannot be read")
        spec = spec if agreed is None else agreed.completed(spec)
        if spec != present.trace:
            self._settings.change(replace(present, trace=spec))
            self._settings.save()
        return spec

    def convert(self, trace: ArrayLike) -> TraceArray:
        """Return a trace as float32 (channels, samples), in the shape of the `TraceSpec`.

        The `TraceSpec` in force is the shape, rate and unit of all traces. A trace of another
        length is fitted if it says how. If none is in force, a trace without a fault (such as NaN,
        or samples that are all equal) sets it; but if another cell of the product (robot cells that
        share labels and versions) has set one, that one is taken, and the trace must fit it. If a
        `TraceSpec` is in force, but the store did not take the settings, saving them is tried
        again; a failure is logged. Until the first version is trained, the first finite trace makes
        the untrained model compile its code for this shape; a failure of this is logged, too.

        A trace with a fault is returned like any other, but sets no `TraceSpec`. The array that is
        returned may share its memory with `trace`. Raises TraceError for a wrong shape, for values
        that are no real numbers, or too few samples of a first trace, and SettingError for the
        reasons of `set_trace_spec`.
        """
        settings = self._settings.now
        x = as_trace(trace, settings.trace)
        if settings.trace is None:
            spec, is_sound = infer_trace_spec(x)
            if is_sound and self.set_trace_spec(spec) != spec:  # a peer's trace came first
                return as_trace(trace, self._settings.now.trace)
        elif self._settings.is_unsaved:
            self._settings.save()
        has_spec = self._settings.now.trace is not None
        if not self._has_seen_trace and has_spec and np.isfinite(x).all():
            self._has_seen_trace = True
            if not self._live.version:  # what will answer is compiled before there is much to do
                guarded(NOT_PRECOMPUTED, self._live.template.precompute, x[None])
        return x

    def find_earlier(self, decision_id: str, part: str | None, trace: Any) -> Decision | None:
        """Return the decision that the store already has for an id, or None for a new id.

        The id comes from the caller, and `part` is the part's number, which is not compared with
        that of a stored decision. If the id cannot be looked up, this is logged, and a new VERIFY
        for this `part` with `Reason.NO_STORE` is returned. It is not recorded, because the id may
        have a decision already; `trace` is not looked at. A report for this id then raises
        StoreError, until a later call can look the id up.

        Raises
        ------
        TraceConflictError
            If the stored decision was made on another trace.
        TraceError
            If the id has a decision, and `trace` does not have the shape of the `TraceSpec` in
            force or holds values that are no real numbers.
        """
        try:
            earlier = self._outbox.find_earlier(decision_id)
        except StoreError as error:
            log.warning(
                "whether %r was decided before cannot be looked up; it is verified: %s",
                decision_id,
                error,
            )
            return verify_decision(decision_id, part, self._live.version, Reason.NO_STORE)
        if earlier is None:
            return None
        return check_same_trace(earlier, trace, self._settings.now.trace)

    def record(
        self,
        x: TraceArray,
        part: str | None,
        decision_id: str | None,
        verify_reason: Reason | None = None,
    ) -> StoredDecision:
        """Decide on one trace and record the decision, without waiting for the disk.

        Any thread may call it, unless the store is in memory.

        Parameters
        ----------
        x : array of float32, shape (C, T)
            The trace, as `convert` returned it; the record holds a copy.
        part : str or None
            Number of the part; None if it has none.
        decision_id : str, optional
            An id that the caller chose, and that has no decision yet (`find_earlier`); None: a new
            one.
        verify_reason : Reason, optional
            Verify (send the part to the check) for this reason, without asking the model and
            without checking the force limits (an operator's limits of the signal). If the store is
            damaged, or its journal (the file on the local disk that gets each record first) cannot
            be written, `Reason.NO_STORE` takes its place, also if None is passed. A fault of the
            trace, like a NaN, takes the place of both.

        Returns
        -------
        StoredDecision
            The record with its number among the decisions of the robot cell. If another thread has
            recorded a decision for the id meanwhile, that decision is returned. Before the first
            training the decision is VERIFY, `Reason.NO_MODEL`. If the model raises, or returns
            bounds that are not 0 <= lower <= upper <= 1, that is logged, and the decision is
            VERIFY, `Reason.MODEL_ERROR`. In both cases a fault of the trace, or a force limit that
            it leaves, decides instead.
        """
        if self._outbox.verify_all_reason:
            verify_reason = Reason.NO_STORE
        return self._outbox.record_decision(self._decide(x, part, verify_reason, decision_id))

    def sync(self, stored: StoredDecision) -> StoredDecision:
        """Wait until a decision and all earlier records are on disk; return the valid decision.

        If that takes longer than the store's time limit, or a write fails, nothing is raised: an
        ACCEPT or REJECT is replaced by a VERIFY (check the part) with `Reason.NO_STORE`, which is
        returned, and which is not on disk yet. But if the first decision (`stored`) has reached the
        disk meanwhile, it stays valid and is returned. A VERIFY is returned as it is, even if it is
        not on disk.
        """
        decision = stored.decision
        try:
            self._outbox.sync()
        except NotTakenError:
            # A decision that lets a part go on unchecked must outlive this process, or its id would
            # have two answers.
            if decision.action is not Action.VERIFY:
                return self._outbox.replace_decision(
                    self._decide(stored.trace, decision.part, Reason.NO_STORE, decision.id)
                )
        return stored

    def record_timeout(self, trace: ArrayLike, part: Any, decision_id: Any) -> Decision:
        """Record that the caller waits no more: return a VERIFY with `Reason.LATE`.

        Any thread may call it, also while another thread uses the engine. It returns once the
        decision is on disk, when a write fails, or when the store's time limit is over; the last
        two are not raised. A fault of the trace or the store is the reason instead of LATE. If the
        id has a decision already, that decision is returned, whatever it is. If the id cannot be
        looked up, the result is a VERIFY with `Reason.NO_STORE` that is not recorded. With a store
        in memory, or while no `TraceSpec` (shape of all traces) is in force, the VERIFY is not
        recorded either, and the trace of a new id is not looked at: only the thread that uses the
        engine may do that.

        Raises TraceError for an invalid part number, an id that belongs to another trace, and a
        trace that does not fit the `TraceSpec` in force or holds values that are no real numbers,
        and ReportError for an invalid id. Rule and model learn nothing of the decision.
        """
        id_ = as_id(decision_id)
        number = as_part(part)
        earlier = self.find_earlier(id_, number, trace)
        if earlier is not None:
            return earlier
        spec = self._settings.now.trace
        if spec is None or not self._outbox.is_thread_safe:
            return verify_decision(id_, number, self._live.version, Reason.LATE)
        stored = self.record(as_trace(trace, spec), number, id_, Reason.LATE)
        with suppress(NotTakenError):
            self._outbox.sync()
        return check_same_trace(stored, trace, spec)

    def _decide(
        self,
        x: TraceArray,
        part: str | None,
        verify_reason: Reason | None,
        decision_id: str | None,
    ) -> StoredDecision:
        """Decide on one trace; return the decision as a record that is not stored yet.

        A trace with a fault, like a NaN, is verified for that reason, and its record is
        quarantined: it is never trained on. Otherwise, with a `verify_reason` the decision is
        VERIFY for this reason, and the force limits (an operator's limits of the signal) are not
        checked. Without it a trace outside a force limit is verified or rejected, as the limit
        says, also without a model in force, and if it raises. Else, without a model the decision is
        VERIFY, `Reason.NO_MODEL`. If the model raises, or returns bounds that are not 0 <= lower <=
        upper <= 1, that is logged, and the decision is VERIFY, `Reason.MODEL_ERROR`. Without a
        `decision_id` it gets a new id.

        The decision is marked as an audit if the model would accept or reject the part and it is
        verified all the same. Its version is the one in force, also if no model was asked. The
        record has a copy of the trace, the time by the store's clock, and the hash of the part's
        number; for an unknown part that is a hash of the samples.
        """
        part_hash_ = 0 if part is None else part_hash(part)
        # Without a TraceSpec the trace has a fault, and is decided all the same.
        conditions = self._settings.conditions or DecisionConditions(
            TraceSpec(samples=x.shape[1], channels=x.shape[0])
        )
        model = self._live.answering
        if verify_reason is not None:
            verdict = _verify(x, replace(conditions, force_limits=()), verify_reason)
        elif model is None:
            verdict = _verify(x, conditions, Reason.NO_MODEL)
        else:
            try:
                verdict = model.decide_one(x, part_hash_, conditions)
                lower, upper = verdict[5:7]
                if not 0.0 <= lower <= upper <= 1.0:  # true of NaN as well
                    raise ValueError(
                        f"Expected bounds 0 <= lower <= upper <= 1, got {lower} and {upper}."
                    )
            except Exception:  # no exception inside a model reaches the cell
                log.exception("the model failed on a trace; the part is verified")
                verdict = _verify(x, conditions, Reason.MODEL_ERROR)
        (
            fault, content, action, predicted, reason,
            lower, upper, n_success, n_failure, embedding, propensity,
        ) = verdict  # fmt: skip
        decision = Decision(
            id=decision_id or f"{self._run}-{next(self._count)}",
            action=ACTIONS[action],
            predicted=ACTIONS[predicted],
            lower=lower,
            upper=upper,
            n_success=n_success,
            n_failure=n_failure,
            embedding=None if fault else tuple(map(tuple, embedding.tolist())) or None,
            model_version=self._live.version,
            reason=REASONS[reason],
            audit=action == 0 and predicted != 0,
            propensity=propensity,
            part=part,
        )
        # The caller may change his own array.
        return StoredDecision(
            decision, x.copy(), part_hash_ or content, fault != 0, self._outbox.store.clock()
        )


def _verify(x: TraceArray, conditions: DecisionConditions, reason: Reason) -> Verdict:
    """Decide without a model: VERIFY for `reason`, unless a fault or a force limit decides; such a
    limit may also reject.
    """
    return decider_without_model(conditions, reason).forward(torch.from_numpy(x))


def check_same_trace(stored: StoredDecision, trace: Any, spec: TraceSpec | None) -> Decision:
    """Return the decision of a record, if `trace` is the trace that it was made on.

    `stored` must have its trace. The samples must be equal as float32, after the trace was
    converted as `spec` demands (`as_trace`); a NaN equals a NaN.

    Raises
    ------
    TraceConflictError
        For another trace.
    TraceError
        For a trace that does not fit `spec`, and for values that are no real numbers.
    """
    if not np.array_equal(as_trace(trace, spec), stored.trace, equal_nan=True):
        raise TraceConflictError(
            f"Expected the trace that decision {stored.decision.id!r} was made on, got another; "
            "give it an id of its own."
        )
    return stored.decision


def verify_decision(decision_id: str, part: str | None, version: int, reason: Reason) -> Decision:
    """Return a decision to check the part (VERIFY); neither model nor trace was looked at.

    `part` is the part's number, and `version` that of the model. The decision counts no labels, and
    has the bounds 0 and 1 of the success probability, no embedding, and 1 as its `propensity`, the
    probability of a check. What the model would have done, `predicted`, is VERIFY, too; so it is no
    audit (a check of a part that the model would accept or reject). Nothing is recorded.
    """
    return Decision(
        id=decision_id,
        action=Action.VERIFY,
        predicted=Action.VERIFY,
        lower=0.0,
        upper=1.0,
        n_success=0,
        n_failure=0,
        embedding=None,
        model_version=version,
        reason=reason,
        audit=False,
        propensity=1.0,
        part=part,
    )


def as_part(part: Any) -> str | None:
    """Convert a part's number to text, so that 7 and "7" are one part; None stays None.

    Raises
    ------
    TraceError
        For anything but None, an integer (Python's or NumPy's) of at most LONGEST characters (200,
        with its sign), and a text of 1 to LONGEST printable characters. True, False and floats such
        as 7.0 are refused.
    """
    if part is None:
        return None
    largest = 10**LONGEST - 1
    text = str(part) if is_whole(part, -largest, largest) else part
    expect(
        is_name(text),
        f"a part's number, a whole number or a text of 1 to {LONGEST} characters that print",
        part,
        "strip what a scanner added, or pass None",
        TraceError,
    )
    return str(text)
