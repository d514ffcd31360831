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
from ..model.base import EngineModel
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
)
from ..store.outbox import Outbox
from ..store.records import StoredDecision
from ..traces import convert_trace, infer_trace_spec
from .guard import NOT_PRECOMPUTED, guarded
from .labels import CellLabels
from .live_model import LiveModel
from .settings import SettingsInForce, read_peers_trace_spec


class DecisionMaker:
    """Makes decisions under the settings in force, gives them ids, and records them.

    Parameters
    ----------
    settings : SettingsInForce
        Read at each decision; the first trace without a fault sets the `TraceSpec` in them.
    live : LiveModel
        Holds the model that decides.
    labels : CellLabels
        Says whether anything was learned yet.
    outbox : Outbox
        Takes the decisions.

    Attributes
    ----------
    has_seen_trace : bool
        Whether a finite trace came since the engine was made or opened.
    """

    def __init__(
        self,
        settings: SettingsInForce,
        live: LiveModel,
        labels: CellLabels,
        outbox: Outbox,
    ) -> None:
        self.has_seen_trace = False
        self._settings = settings
        self._live = live
        self._labels = labels
        self._outbox = outbox
        self._first_conditions: DecisionConditions | None = None
        self._run = uuid.uuid4().hex[:12]
        self._count = count(1)

    def set_trace_spec(self, spec: TraceSpec, inferred: bool = False) -> TraceSpec:
        """Set the `TraceSpec` (shape, rate and unit of all traces); return the one in force.

        If a `TraceSpec` is in force already, it stays. It only gets from `spec` a rate, units and
        columns that were unknown; a `spec` of another shape is ignored. If none is in force and
        another cell of the product has set one, that one is taken in the same way; if it cannot be
        read, that is logged and `spec` is set.

        `inferred` says that `spec` comes from a first trace. The settings are saved in the store;
        if that fails, they are saved with a later trace. Raises SettingError if the force limits do
        not fit the `TraceSpec`.
        """
        store = self._outbox.store
        present = self._settings.now
        agreed = present.trace
        try:
            if agreed is None and store.product is not None:
                agreed = self._outbox.call_store(lambda: read_peers_trace_spec(store))
        except StoreError:  # the cell's own first trace stands
            log.exception("the product's contract of traces cannot be had")
        spec = spec if agreed is None else agreed.completed(spec)
        if spec != present.trace:
            inferred = inferred or present.inferred
            self._settings.change(replace(present, trace=spec, inferred=inferred))
            self._settings.save()
        return spec

    def convert(self, trace: ArrayLike) -> TraceArray:
        """Return a trace as float32 (channels, samples), converted as the `TraceSpec` demands.

        If no `TraceSpec` is in force, the one that another cell of the product has set is taken, or
        else the first trace without a fault sets it. Before the first training the first finite
        trace also lets the model compile its code for such traces. Settings that could not be saved
        before are saved.

        A trace with NaN, or another fault, is returned like any other. Raises TraceError for a
        wrong shape, or too few samples of a first trace, and SettingError if the force limits do
        not fit the `TraceSpec` that the trace sets.
        """
        settings = self._settings.now
        has_learned = self._live.version + self._labels.new_labels > 0
        x = convert_trace(trace, settings.trace, settings.inferred and not has_learned)
        spec = self._infer_trace_spec(x, trace) if settings.trace is None else None
        if spec is not None:
            if self.set_trace_spec(spec, inferred=True) != spec:  # a peer's trace came first
                return convert_trace(trace, self._settings.now.trace, False)
        elif self._settings.is_unsaved:
            self._settings.save()
        has_contract = self._settings.now.trace is not None
        if not self.has_seen_trace and has_contract and np.isfinite(x).all():
            self.has_seen_trace = True
            if not self._live.version:  # what will answer is compiled before there is much to do
                guarded(NOT_PRECOMPUTED, self._live.template.precompute, x[None])
        return x

    def _infer_trace_spec(self, x: TraceArray, trace: Any) -> TraceSpec | None:
        """Infer the `TraceSpec` from a first trace; return None if the trace has a fault.

        It is also kept for the conditions of the decision, so that a trace with a fault can be
        decided, too, although a later trace must set the `TraceSpec`. `trace` is `x` as the caller
        passed it; a DataFrame names the channels. Raises TraceError for a trace of fewer samples
        than a first trace must have.
        """
        spec, is_sound = infer_trace_spec(x, trace)
        self._first_conditions = DecisionConditions(spec)
        return spec if is_sound else None

    def find_earlier(self, decision_id: str, part: str | None, trace: Any) -> Decision | None:
        """Return the decision that the store already has for an id, or None for a new id.

        The id comes from the caller. If the store does not answer, the decision returned is a
        VERIFY for this `part` with `Reason.NO_STORE`: it is logged and not recorded, because the id
        may have a decision already, and `trace` is not looked at. A report for this id then raises
        StoreError, until a later call can look the id up.

        Raises
        ------
        TraceConflictError
            If the stored decision was made on another trace.
        TraceError
            If the id has a decision, and `trace` does not fit the `TraceSpec` in force.
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
        decision_id: str | None = None,
        verify_reason: Reason | None = None,
    ) -> StoredDecision:
        """Decide on one trace and hand the decision to the outbox, without waiting for the disk.

        Any thread may call it. A `TraceSpec` must be in force, or `convert` must have been called
        before.

        Parameters
        ----------
        x : array of float32, shape (C, T)
            The trace, as `convert` returned it; the record holds a copy.
        part : str or None
            Number of the part.
        decision_id : str, optional
            An id that the caller chose; None: a new one.
        verify_reason : Reason, optional
            Verify for this reason, without asking the model; see `_decide`. If the store is damaged
            or its journal cannot be written, the reason is `Reason.NO_STORE` whatever is passed.

        Returns
        -------
        StoredDecision
            The record with its number, which is 0 if it could not be recorded. Before the first
            training the decision is VERIFY, `Reason.NO_MODEL`, unless the trace has a fault or is
            outside a force limit.
        """
        if self._outbox.verify_all_reason:
            verify_reason = Reason.NO_STORE
        item = self._decide(x, part, self._live.answering, verify_reason, decision_id)
        return self._outbox.record_decision(item)

    def sync(self, stored: StoredDecision) -> StoredDecision:
        """Wait until a decision is on disk, and return the record that counts.

        If an ACCEPT or REJECT is not on disk within the store's time limit, a VERIFY with
        `Reason.NO_STORE` replaces it in the outbox and is returned; if it has reached the disk
        after all, it stays. A VERIFY stays as it is. Nothing is raised.
        """
        decision = stored.decision
        try:
            self._outbox.sync()
        except NotTakenError:
            # A decision that lets a part go on unchecked must outlive this process, or its id would
            # have two answers.
            if decision.action is not Action.VERIFY:
                item = self._decide(stored.trace, decision.part, None, Reason.NO_STORE, decision.id)
                return self._outbox.replace_decision(item)
        return stored

    def record_timeout(self, trace: ArrayLike, part: Any, decision_id: Any) -> Decision:
        """Record VERIFY, `Reason.LATE`, while another thread may use the engine, and return it.

        Any thread may call it. It returns once the decision is on disk, or when the store's time
        limit is over. If the id has a decision already, that decision is returned. If the store
        cannot look the id up, the result is a VERIFY with `Reason.NO_STORE` that is not recorded.
        With a store in memory, and before the first trace, the VERIFY is not recorded either: only
        the thread that uses the engine may do that.

        Raises TraceError for an invalid part number, an id that belongs to another trace, and a
        trace that does not fit the `TraceSpec` in force, ReportError for an invalid id, and
        StoreError for an engine that is closed or only reads.
        """
        self._outbox.check_usable()
        id_ = as_id(decision_id)
        number = as_part(part)
        earlier = self.find_earlier(id_, number, trace)
        if earlier is not None:
            return earlier
        spec = self._settings.now.trace
        if spec is None or not self._outbox.is_thread_safe:
            return verify_decision(id_, number, self._live.version, Reason.LATE)
        stored = self.record(convert_trace(trace, spec, False), number, id_, Reason.LATE)
        with suppress(NotTakenError):
            self._outbox.sync()
        return check_same_trace(stored, trace, spec)

    def _decide(
        self,
        x: TraceArray,
        part: str | None,
        model: EngineModel | None,
        verify_reason: Reason | None = None,
        decision_id: str | None = None,
    ) -> StoredDecision:
        """Decide on one trace by a model; return the decision as a record that is not stored yet.

        Without a model, and with a `verify_reason`, the decision is VERIFY. With a `verify_reason`
        the force limits are not checked, and only a fault of the trace replaces this reason. If the
        trace has a fault, the record is quarantined: it is never trained on. If the model raises or
        returns impossible bounds, that is logged, and the decision is VERIFY with
        `Reason.MODEL_ERROR`, unless the trace has a fault or is outside a force limit.
        """
        part_hash_ = 0 if part is None else part_hash(part)
        conditions = self._settings.conditions or self._first_conditions
        assert conditions is not None  # a trace has come
        if verify_reason is not None:
            unlimited = replace(conditions, force_limits=())
            verdict = _verify(x, unlimited, verify_reason)
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
        hash_ = part_hash_ or content
        return StoredDecision(decision, x.copy(), hash_, fault != 0, self._outbox.store.clock())

    def record_lost_accept(
        self, x: TraceArray, part: str | None, decision_id: str
    ) -> StoredDecision:
        """Record an ACCEPT for a line stop whose decision was lost, and return the record.

        The model is not asked: the decision has this id, `Reason.CERTAIN`, no labels and the bound
        (0, 1). Its `propensity`, the probability of a check, is the present audit rate, or 1 in
        shadow mode. The call does not wait for the disk.
        """
        stored = self._decide(x, part, None, decision_id=decision_id)
        decision = replace(
            stored.decision,
            action=Action.ACCEPT,
            predicted=Action.ACCEPT,
            reason=Reason.CERTAIN,
            propensity=self._settings.audited_share,
        )
        return self._outbox.record_decision(replace(stored, decision=decision))


def _verify(x: TraceArray, conditions: DecisionConditions, reason: Reason) -> Verdict:
    """Decide without a model: VERIFY for `reason`, unless a fault or a force limit decides."""
    verdict: Verdict = decider_without_model(conditions, reason)(torch.from_numpy(x))
    return verdict


def check_same_trace(stored: StoredDecision, trace: Any, spec: TraceSpec | None) -> Decision:
    """Return the decision of a record, if `trace` is the trace that it was made on.

    Raises
    ------
    TraceConflictError
        For another trace.
    TraceError
        For a trace that does not fit `spec`.
    """
    x = convert_trace(trace, spec, False)
    if not np.array_equal(x, stored.trace, equal_nan=True):
        raise TraceConflictError(
            f"Expected the trace that decision {stored.decision.id!r} was made on, got another; "
            "give it an id of its own."
        )
    return stored.decision


def verify_decision(decision_id: str, part: str | None, version: int, reason: Reason) -> Decision:
    """Return a VERIFY decision for which neither model nor trace was looked at.

    It has no labels, the bound (0, 1), no embedding, and 1 as its `propensity`, the probability of
    a check. Nothing is recorded.
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
    """Convert a part's number to text; None stays None.

    Raises
    ------
    TraceError
        For anything but a whole number of at most `LONGEST` digits, or a text of 1 to `LONGEST`
        printable characters.
    """
    if part is None:
        return None
    is_whole = isinstance(part, int | np.integer) and not isinstance(part, bool)
    text = str(part) if is_whole and abs(int(part)) < 10**LONGEST else part
    expect(
        is_name(text),
        f"a part's number, a whole number or a text of 1 to {LONGEST} characters that print",
        part,
        "strip what a scanner added, or pass None",
        TraceError,
    )
    return str(text)
