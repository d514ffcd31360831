"""From one trace to a recorded decision: the gate, the model, the audits' coin; and what a report on it means."""

from __future__ import annotations

import logging
import uuid
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from .decision.rule import script
from .errors import ReportError
from .folds import audited
from .model.base import NOTHING_KNOWN, EngineModel, Prediction
from .records import REASONS, Action, Decision, Reason, Source, TraceSpec
from .traces import TraceGate

log = logging.getLogger("dengine")


class DecisionMaker:
    """Makes decisions on traces of one contract, with ids of its own.

    audit_rate, seed : of the audits' coin, a fixed function of the trace.
    """

    def __init__(self, audit_rate: float, seed: int) -> None:
        self.audit_rate = audit_rate
        self.seed = seed
        self._run, self._count = uuid.uuid4().hex[:12], 0

    def agree_on(self, trace: TraceSpec) -> None:
        """Set the contract that the gate checks."""
        self._gate = script(TraceGate(trace))

    def decide(self, x: NDArray[np.float32], model: EngineModel | None, version: int) -> tuple[Decision, int, bool]:
        """(C, T) -> the decision, the trace's content hash, and whether the trace is faulty."""
        fault, hash_ = self._gate(torch.from_numpy(x))
        prediction, reason = (NOTHING_KNOWN, REASONS[fault]) if fault else _predict(x, model)
        return self._record(prediction, reason, hash_, version), hash_, bool(fault)

    def lost_accept(self, x: NDArray[np.float32], decision_id: str, version: int) -> tuple[Decision, int, bool]:
        """The decision behind a system stop whose own row was lost: an accept, on no evidence that is known."""
        fault, hash_ = self._gate(torch.from_numpy(x))
        decision = self._record(replace(NOTHING_KNOWN, action=Action.ACCEPT), Reason.CERTAIN, hash_, version)
        # The part went on unchecked, whatever the audits' coin says.
        went_on = replace(decision, id=decision_id, action=Action.ACCEPT, reason=Reason.CERTAIN, audit=False)
        return went_on, hash_, bool(fault)

    def _record(self, predicted: Prediction, reason: Reason, hash_: int, version: int) -> Decision:
        certain, rate = predicted.action is not Action.VERIFY, self.audit_rate
        audit = certain and rate > 0.0 and bool(audited(np.array([hash_]), rate, self.seed)[0])
        self._count += 1
        return Decision(
            id=f"{self._run}-{self._count}",
            action=Action.VERIFY if audit else predicted.action,
            predicted=predicted.action,
            lower=predicted.lower,
            upper=predicted.upper,
            n_success=predicted.n_success,
            n_failure=predicted.n_failure,
            embedding=predicted.embedding,
            model_version=version,
            reason=Reason.AUDIT if audit else reason,
            audit=audit,
            propensity=rate if certain else 1.0,
        )


def _predict(x: NDArray[np.float32], model: EngineModel | None) -> tuple[Prediction, Reason]:
    if model is None:
        return NOTHING_KNOWN, Reason.NO_MODEL
    try:
        prediction = model.predict_one(x)
    except Exception:  # no exception inside a model reaches the cell: it becomes VERIFY, recorded
        log.exception("the model failed on a trace; the part is verified")
        return NOTHING_KNOWN, Reason.MODEL_ERROR
    return prediction, Reason.UNCERTAIN if prediction.action is Action.VERIFY else Reason.CERTAIN


def source_of(decision_id: str, action: Action, audit: bool, success: bool) -> Source:
    """Where a label on a decision comes from; ReportError for a rejected part, which went back to the bin."""
    if action is Action.REJECT:
        raise ReportError(
            f"Decision {decision_id!r} was a reject; the part went back to the bin and has no label to report."
        )
    if action is Action.VERIFY:
        return Source.AUDIT if audit else Source.VERIFICATION
    return Source.CONFIRMED if success else Source.STOP
