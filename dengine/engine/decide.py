"""`DecisionMaker` turns a trace into a `StoredDecision`: the model's decision, an id, a version and
a time. `EngineCore` owns one and hands its results to the outbox.

The functions below it check what a caller passes, a part's number and an id that was decided
before, and make a VERIFY without a trace.
"""

import logging
import uuid
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import torch

from ..decision.decider import DecisionConditions, Verdict, decider_without_model
from ..errors import TraceConflictError, TraceError, expect
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
    is_name,
)
from ..store.records import StoredDecision
from ..traces import convert_trace, infer_trace_spec
from .settings import SettingsInForce

log = logging.getLogger("dengine")


class DecisionMaker:
    """Makes decisions under the settings in force, and gives them ids.

    Parameters
    ----------
    settings : SettingsInForce
        Read at each decision.
    clock : callable
        The store's clock, in seconds.
    """

    def __init__(self, settings: SettingsInForce, clock: Callable[[], float]) -> None:
        self._settings = settings
        self._clock = clock
        self._first_conditions: DecisionConditions | None = None
        self._run = uuid.uuid4().hex[:12]
        self._count = count(1)

    def infer_trace_spec(self, x: TraceArray, trace: Any) -> TraceSpec | None:
        """Infer the trace contract from a first trace.

        It is also kept, so that this trace can be decided before a contract is set.

        Parameters
        ----------
        x : array of float32, shape (C, T)
            The trace.
        trace : object
            The trace as the caller passed it; a DataFrame names the channels.

        Returns
        -------
        TraceSpec or None
            None if the trace has a fault, so that a later one must set the contract.

        Raises
        ------
        TraceError
            For a trace of fewer samples than a first trace must have.
        """
        spec, is_sound = infer_trace_spec(x, trace)
        self._first_conditions = DecisionConditions(spec)
        return spec if is_sound else None

    def decide(
        self,
        x: TraceArray,
        part: str | None,
        model: EngineModel | None,
        version: int,
        verify_reason: Reason | None = None,
        decision_id: str | None = None,
    ) -> StoredDecision:
        """Decide on one trace and return the record of it, which is not recorded yet; any thread
        may call it.

        A trace contract must be in force, or `infer_trace_spec` must have been called before.

        Parameters
        ----------
        x : array of float32, shape (C, T)
            The trace; the record holds a copy.
        part : str or None
            Number of the part.
        model : EngineModel or None
            The model that answers; None before the first training: then the decision is VERIFY,
            `Reason.NO_MODEL`, unless the trace has a fault or is outside a force limit.
        version : int
            Number of the model's version.
        verify_reason : Reason, optional
            Verify for this reason, without asking the model and without force limits; a fault of
            the trace comes before it.
        decision_id : str, optional
            An id of the caller's; None: a new one.

        Returns
        -------
        StoredDecision
            The record for the store, with number 0. It is quarantined if the trace has a fault. A
            model that raises, or returns impossible bounds, is logged, and the decision is VERIFY
            with `Reason.MODEL_ERROR`, unless the trace has a fault or is outside a force limit.
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
            model_version=version,
            reason=REASONS[reason],
            audit=action == 0 and predicted != 0,
            propensity=propensity,
            part=part,
        )
        # The caller may change his own array.
        return StoredDecision(decision, x.copy(), part_hash_ or content, fault != 0, self._clock())

    def lost_accept(
        self, x: TraceArray, part: str | None, version: int, decision_id: str
    ) -> StoredDecision:
        """Return the record of the ACCEPT behind a line stop whose decision was lost; nothing is
        recorded.

        The decision has this id, `Reason.CERTAIN`, and no evidence: no labels and the bound (0, 1).
        Its propensity is the present audit rate, 1 in shadow mode.
        """
        stored = self.decide(x, part, None, version, None, decision_id)
        decision = replace(
            stored.decision,
            action=Action.ACCEPT,
            predicted=Action.ACCEPT,
            reason=Reason.CERTAIN,
            propensity=self._settings.audited_share,
        )
        return replace(stored, decision=decision)


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
        For a trace that the contract `spec` does not allow.
    """
    x = convert_trace(trace, spec, False)
    if not np.array_equal(x, stored.trace, equal_nan=True):
        wanted = f"the trace that decision {stored.decision.id!r} was made on"
        raise TraceConflictError(f"Expected {wanted}, got another; give it an id of its own.")
    return stored.decision


def verify_decision(decision_id: str, part: str | None, version: int, reason: Reason) -> Decision:
    """Return a VERIFY decision for which neither model nor trace was looked at.

    It has no labels, the bound (0, 1), no embedding and propensity 1; nothing is recorded.
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
    wanted = f"a part's number, a whole number or a text of 1 to {LONGEST} characters that print"
    expect(is_name(text), wanted, part, "strip what a scanner added, or pass None", TraceError)
    return str(text)
