"""From one trace to a recorded decision: the gate, the model, the audits' coin; and what a report on it means."""

import logging
import uuid
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..decision.scripting import script
from ..errors import TraceConflictError, TraceError, expect
from ..folds import audited, part_hash
from ..model.base import EngineModel, Prediction
from ..records import LONGEST, REASONS, Action, Decision, Reason, TraceSpec, is_name
from ..store.records import StoredDecision
from ..traces import TraceGate, convert_trace, infer_trace_spec
from .settings import SettingsInForce

log = logging.getLogger("dengine")


class DecisionMaker:
    """Makes decisions on traces of one contract, with ids of its own.

    settings : of the audits' coin, a fixed function of the trace, and of the contract where there is one.
    clock : of the store, in seconds.
    """

    def __init__(self, settings: SettingsInForce, clock: Callable[[], float]) -> None:
        self._settings, self._clock = settings, clock
        if settings.now.trace is not None:
            self.agree_on(settings.now.trace)
        self._run, self._count = uuid.uuid4().hex[:12], count(1)

    def agree_on(self, trace: TraceSpec) -> None:
        """Set the contract that the gate checks."""
        gate = TraceGate(trace)
        self._gate, self._limit = (
            script(gate).forward,
            gate.limit,
        )  # once: a scripted module looks its methods up each time

    def first_contract(self, x: NDArray[np.float32], trace: Any) -> TraceSpec | None:
        """The contract that a first trace (C, T) sets; None for a bad one: it is verified, and the contract stays open."""
        spec, fit = infer_trace_spec(x, trace)
        self._gate = TraceGate(spec)  # a bad one needs it as well: to say what is bad
        return spec if fit else None

    def decide(
        self,
        x: NDArray[np.float32],
        part: str | None,
        model: EngineModel | None,
        version: int,
        unasked: Reason | None = None,
        decision_id: str | None = None,
    ) -> StoredDecision:
        """(C, T) of a part with this number -> what goes into the store; in any thread.

        unasked : why the part is verified whatever the model says; None: it is asked, where there is one.
        """
        number, said = None if part is None else part_hash(part), None
        windows = self._settings.outside if unasked is None else None
        if model is not None and unasked is None:
            try:
                fault, content, said = model.look(x, number, self._gate, self._limit)
                if (
                    said is not None and not 0.0 <= said.lower <= said.upper <= 1.0
                ):  # a NaN is refused too
                    raise ValueError(
                        f"Expected bounds 0 <= lower <= upper <= 1, got {said.lower} and {said.upper}."
                    )
            except (
                Exception
            ):  # no exception inside a model reaches the cell: it becomes VERIFY, recorded
                log.exception("the model failed on a trace; the part is verified")
                said, unasked = None, Reason.MODEL_ERROR
        if said is None:
            fault, content = self._gate(torch.from_numpy(x))
            reason = REASONS[fault] if fault else unasked or Reason.NO_MODEL
            said = Prediction(Action.VERIFY, 0.0, 1.0, 0, 0, None, reason)
        outside = 0 if fault or windows is None else windows(torch.from_numpy(x))
        if outside:  # its place is kept, and nothing else of what the model says of it
            said = Prediction(Action.VERIFY, 0.0, 1.0, 0, 0, said.embedding, Reason.OUTSIDE)
        certain, rate = said.action is not Action.VERIFY, self._settings.audited_share
        audit = (
            certain
            and rate > 0.0
            and bool(audited(np.array([content]), rate, self._settings.now.seed)[0])
        )
        decision = Decision(
            id=decision_id or f"{self._run}-{next(self._count)}",
            action=Action.REJECT if outside == 2 else Action.VERIFY if audit else said.action,
            predicted=said.action,
            lower=said.lower,
            upper=said.upper,
            n_success=said.n_success,
            n_failure=said.n_failure,
            embedding=said.embedding,
            model_version=version,
            reason=Reason.AUDIT if audit else said.reason,
            audit=audit,
            propensity=rate if certain else float(outside != 2),
            part=part,
        )
        hash_ = content if number is None else number
        return StoredDecision(
            decision, x.copy(), hash_, fault != 0, self._clock()
        )  # the caller may change his own

    def lost_accept(
        self, x: NDArray[np.float32], part: str | None, version: int, decision_id: str
    ) -> StoredDecision:
        """The decision behind a system stop whose own row was lost: an accept without a check, on no known evidence."""
        item, accept = self.decide(x, part, None, version, None, decision_id), Action.ACCEPT
        rate = self._settings.audited_share
        made = replace(
            item.decision, action=accept, predicted=accept, reason=Reason.CERTAIN, propensity=rate
        )
        return replace(item, decision=made)


def decided_before(known: StoredDecision, trace: Any, spec: TraceSpec | None) -> Decision:
    """The decision that this id has already; TraceError where it was made on another trace."""
    x = convert_trace(trace, spec, False)
    if not np.array_equal(x, known.trace, equal_nan=True):
        own = f"the trace that decision {known.decision.id!r} was made on"
        raise TraceConflictError(f"Expected {own}, got another; give it an id of its own.")
    return known.decision


def unasked(decision_id: str, part: str | None, version: int, reason: Reason) -> Decision:
    """A decision on which no model was asked."""
    verify = Action.VERIFY
    return Decision(
        decision_id, verify, verify, 0.0, 1.0, 0, 0, None, version, reason, False, 1.0, part
    )


def as_part(part: Any) -> str | None:
    """A part's number as text; TraceError for what is neither a text nor a whole number, or does not fit a line."""
    if part is None:
        return None
    whole = isinstance(part, int | np.integer) and not isinstance(part, bool)
    text = str(part) if whole and abs(int(part)) < 10**LONGEST else part
    wanted = f"a part's number, a whole number or a text of 1 to {LONGEST} characters that print"
    expect(is_name(text), wanted, part, "strip what a scanner added, or pass None", TraceError)
    return str(text)
