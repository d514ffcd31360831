"""The decision on one trace, in one module: `Decider` checks faults and force limits, asks the
predictor, and draws audits, under the settings in `DecisionConditions`. `VerifyAll` is the
predictor for the time without a model. The engine asks a `Decider`, and an exported file contains
one.

    >>> decider = Decider(predictor, DecisionConditions(TraceSpec(1000), audit_rate=0.02), (5, 2))
    >>> fault, content, action, *_ = decider(torch.from_numpy(x), part=0)

The engine adds an id, a model version and a time to what a `Decider` returns. As exported files
contain the same module, they decide alike. TorchScript compiles it if it can compile the predictor;
a predictor that is plain Python is asked through the same lines.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor, nn

from ..folds import COIN_BITS, MIX, audit_salt
from ..limits import ForceLimits
from ..records import REASONS, ActionCode, Reason, TraceSpec
from ..traces import ForceLimitsGate, TraceGate

# fault, content hash, action, predicted action, reason, lower, upper, n_success, n_failure,
# embedding, propensity; see `Decider.forward`.
Verdict = tuple[int, int, int, int, int, float, float, int, int, Tensor, float]
# action, reason, lower, upper, n_success, n_failure, embedding; what a predictor returns.
Predicted = tuple[int, int, float, float, int, int, Tensor]


@dataclass(frozen=True, slots=True)
class DecisionConditions:
    """What a decision depends on besides the trace and the model.

    Attributes
    ----------
    trace : TraceSpec
        Shape and rate of the traces; its `limit` is the sensor's range.
    force_limits : tuple of ForceLimits
        The operator's limits.
    audit_rate : float
        Probability with which a certain decision is verified all the same.
    seed : int
        Seed of the audit draw, which is a fixed function of seed and trace.
    """

    trace: TraceSpec
    force_limits: tuple[ForceLimits, ...] = ()
    audit_rate: float = 0.0
    seed: int = 0


class Decider(nn.Module):
    """Decides on one trace: is it faulty, within the operator's limits, certain, audited?

    Parameters
    ----------
    predictor : nn.Module
        `forward(x, part)` returns what the model predicts, as `Predicted`; `embed(x)` returns the
        embedding alone.
    conditions : DecisionConditions
        Copied into buffers, so that one compiled module serves all conditions.
    embedding_shape : pair of int
        (K, d) of the embedding; (0, 0) for a predictor without one.
    """

    sensor_limit: Tensor
    audit_rate: Tensor
    audit_salt: Tensor

    def __init__(
        self,
        predictor: nn.Module,
        conditions: DecisionConditions,
        embedding_shape: tuple[int, int] = (0, 0),
    ) -> None:
        super().__init__()
        spec = conditions.trace
        self.predictor: Any = predictor
        self.gate = trace_gate(spec.channels, spec.samples)
        self.limits = ForceLimitsGate(conditions.force_limits, spec)
        self.n_spaces, self.dim = embedding_shape
        self.audit_reason = REASONS.index(Reason.AUDIT)
        self.outside_reason = REASONS.index(Reason.OUTSIDE)
        self.coin_range = float(2**COIN_BITS)
        self.mix = MIX
        self.shift = 63 - COIN_BITS
        self.mask = 2**COIN_BITS - 1
        limit = float("inf") if spec.limit is None else spec.limit
        self.register_buffer("sensor_limit", torch.tensor(limit, dtype=torch.float64))
        self.register_buffer("audit_rate", torch.tensor(conditions.audit_rate, dtype=torch.float64))
        self.register_buffer("audit_salt", torch.tensor(audit_salt(conditions.seed)))

    def forward(self, x: Tensor, part: int = 0) -> Verdict:
        """Decide whether the part of one trace is verified (by a slow check), accepted or rejected.

        First come faults of the trace (like a NaN), then the force limits (an operator's limits of
        the signal), then the model, then the audit draw, by which some parts that the model would
        accept or reject are verified all the same. The model predicts only if the trace has no
        fault and is within the limits; outside the limits it only embeds, and the limit says
        whether the part is verified or rejected. What the model raises is raised here.

        Parameters
        ----------
        x : Tensor of float32, shape (C, T)
            The trace, contiguous.
        part : int, default 0
            Hash of the number of the part that the trace is of, 0 if unknown: then the content hash
            (of the samples) stands for the part. References (labelled points) of this part do not
            count.

        Returns
        -------
        fault : int
            Position in `Reason` of what is wrong with the trace, 0 if nothing. A faulty trace is
            verified.
        content : int
            Content hash of the trace (`folds.content_hash`).
        action, predicted : int
            `ActionCode`s (0 verify, 1 accept, 2 reject): what to do, and what the model alone would
            do. They differ if the part is audited, and if a force limit rejects. `predicted` is
            VERIFY if the model did not predict.
        reason : int
            Position in `Reason`: the fault of a faulty trace, OUTSIDE if a force limit decides,
            AUDIT if the part is audited, and otherwise the model's reason.
        lower, upper : float
            Bound on the success probability; (0, 1) without a prediction.
        n_success, n_failure : int
            Labels of each kind within the model's radius around the embedding; 0 without a
            prediction.
        embedding : Tensor of float32, shape (K, d)
            A point in each of the K embedding spaces, also if a force limit decides; NaN for a
            faulty trace.
        propensity : float
            Probability, fixed beforehand, that this part is verified: the audit rate if the model
            would accept or reject it, 0 if a force limit rejects, otherwise 1.
        """
        fault, content = self.check(x)
        if fault != 0:
            nothing = torch.full((self.n_spaces, self.dim), float("nan"))
            return fault, content, 0, 0, fault, 0.0, 1.0, 0, 0, nothing, 1.0
        action = self.limits(x)
        if action != self.limits.within:
            z = self.predictor.embed(x)
            propensity = float(action == ActionCode.VERIFY.value)
            return 0, content, action, 0, self.outside_reason, 0.0, 1.0, 0, 0, z, propensity
        own_part = part if part != 0 else content
        predicted, reason, lower, upper, n_success, n_failure, z = self.predictor(x, own_part)
        action = predicted
        propensity = 1.0
        if predicted != ActionCode.VERIFY.value:
            propensity = float(self.audit_rate.item())
            if propensity > 0.0 and self.is_audited(content, propensity):
                action = ActionCode.VERIFY.value
                reason = self.audit_reason
        return (
            0, content, action, predicted, reason,
            lower, upper, n_success, n_failure, z, propensity,
        )  # fmt: skip

    @torch.jit.export
    def check(self, x: Tensor) -> tuple[int, int]:
        """Return (fault, content hash) of a trace (C, T); nothing is predicted.

        The fault is a position in `Reason`, 0 if the trace has none.
        """
        checked: tuple[int, int] = self.gate(x, float(self.sensor_limit.item()))
        return checked

    def is_audited(self, content: int, rate: float) -> bool:
        """Return whether a trace with this content hash is audited: verified although certain.

        That is a fixed function of hash and seed, true for a share `rate` of all hashes: for none
        at 0, for all at 1. A hash that is audited at a rate is audited at each higher rate, too.
        """
        return self.toss(content ^ int(self.audit_salt.item())) < int(rate * self.coin_range)

    @torch.jit.export
    def toss(self, value: int) -> int:
        """Return a pseudo-random integer from 0 to 2**30 - 1 that is a fixed function of the value.

        It is the number that `folds.toss` returns for this value. The arithmetic is on tensors
        because tensors of int64 wrap around, compiled or not.
        """
        h = torch.tensor(value)
        h = (h ^ (h >> 32)) * self.mix
        h = (h ^ (h >> 32)) * self.mix
        return int(((h >> self.shift) & self.mask).item())


class VerifyAll(nn.Module):
    """A predictor for the time without a model: every part is verified, for one reason.

    Parameters
    ----------
    reason : Reason
        Why.
    """

    def __init__(self, reason: Reason) -> None:
        super().__init__()
        self.reason = REASONS.index(reason)

    def forward(self, x: Tensor, part: int = 0) -> Predicted:
        """Return VERIFY with the reason, the bound (0, 1), no labels and an empty embedding.

        Trace and part have no effect.
        """
        return 0, self.reason, 0.0, 1.0, 0, 0, self.embed(x)

    def embed(self, x: Tensor) -> Tensor:
        """Return an empty embedding, shape (0, 0)."""
        return torch.empty(0, 0)


@lru_cache(16)
def decider_without_model(conditions: DecisionConditions, reason: Reason) -> Decider:
    """Return a decider that verifies every part for `reason`; a force limit may still reject.

    A fault of the trace, or leaving a force limit, is the reason instead. The 16 deciders that were
    used last are cached, so the same arguments give the same object.
    """
    return Decider(VerifyAll(reason), conditions)


@lru_cache(16)
def trace_gate(channels: int, samples: int) -> TraceGate:
    """Return the module that checks traces (C, T) of this shape for faults and hashes them.

    It is cached (the 16 shapes that were used last): it has no state, so all deciders share it.
    """
    return TraceGate(channels * samples)
