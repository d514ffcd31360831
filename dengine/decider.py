"""The whole decision as one module: raw trace in, action out. What the cell controller runs.

It is put together from the very modules that the engine decides through, the trace gate and the core, and adds the
audits' coin. Positions: actions 0 verify, 1 accept, 2 reject; reasons as in `Reason`.
"""

import torch
from torch import Tensor, nn

from .core import Core
from .folds import COIN_BITS, MIX, audit_salt
from .records import Reason, TraceSpec
from .traces import TraceGate

One = tuple[int, int, float, float, int, int, Tensor]
Many = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
REASONS = tuple(Reason)
FIELDS = ("action", "reason", "lower", "upper", "n_success", "n_failure", "embedding")


class Decider(nn.Module):
    """Gate, core and audits.

    `decide(trace)` answers on one trace in scalars; `forward(traces)` on a batch in tensors; both in the order of `FIELDS`.
    `learn(trace, success)` makes a verified trace a reference: bounded, in its own fold's space, the oldest one leaving
    first whatever its label. It does not retrain the encoder.
    """

    def __init__(self, spec: TraceSpec, core: Core, n_spaces: int, dim: int, audit_rate: float, seed: int) -> None:
        super().__init__()
        self.gate = TraceGate(spec)
        self.core = core
        self.channels = spec.channels
        self.samples = spec.samples
        self.n_spaces = n_spaces
        self.dim = dim
        self.audit_below = int(audit_rate * 2**COIN_BITS)
        self.salt = audit_salt(seed)
        self.mix = MIX
        self.shift = 63 - COIN_BITS
        self.mask = 2**COIN_BITS - 1
        self.certain, self.uncertain, self.audit = (
            REASONS.index(r) for r in (Reason.CERTAIN, Reason.UNCERTAIN, Reason.AUDIT)
        )

    @torch.jit.export
    def decide(self, trace: Tensor) -> One:
        """One trace, (T,) or (C, T) of any real dtype -> action, reason, lower, upper, n_success, n_failure, (K, d)."""
        x = self.as_trace(trace)
        fault, content = self.gate(x)
        if fault != 0:
            return 0, fault, 0.0, 1.0, 0, 0, torch.full((self.n_spaces, self.dim), float("nan"))
        action, lower, upper, n_success, n_failure, z = self.core(x)
        reason = self.uncertain if action == 0 else self.certain
        if action != 0 and self.audit_below > 0 and self.toss(content ^ self.salt) < self.audit_below:
            action, reason = 0, self.audit
        return action, reason, lower, upper, n_success, n_failure, z

    def forward(self, traces: Tensor) -> Many:
        """(T,), (B, T) or (B, C, T) -> action, reason, lower, upper, n_success, n_failure: (B,); embedding (B, K, d)."""
        batch = traces.unsqueeze(0) if traces.dim() == 1 else traces
        n = batch.size(0)
        whole = torch.zeros(n, 4, dtype=torch.int64)
        bounds = torch.zeros(n, 2, dtype=torch.float64)
        embedding = torch.zeros(n, self.n_spaces, self.dim)
        for i in range(n):
            action, reason, lower, upper, n_success, n_failure, z = self.decide(batch[i])
            whole[i] = torch.tensor([action, reason, n_success, n_failure])
            bounds[i, 0].fill_(lower)  # assigned, or made a tensor, a scripted float goes through float32
            bounds[i, 1].fill_(upper)
            embedding[i] = z
        return whole[:, 0], whole[:, 1], bounds[:, 0], bounds[:, 1], whole[:, 2], whole[:, 3], embedding

    @torch.jit.export
    def learn(self, trace: Tensor, success: bool) -> int:
        """Add one verified trace to the references; returns how many are held. A faulty trace is not learned from."""
        x = self.as_trace(trace)
        fault, content = self.gate(x)
        if fault == 0:
            self.core.hold(x, 1.0 if success else 0.0, self.toss(content) % self.n_spaces)
        return self.core.held()

    def as_trace(self, trace: Tensor) -> Tensor:
        """(C, T) float32; raises for another shape, which is a caller's bug."""
        x = trace.unsqueeze(0) if trace.dim() == 1 else trace
        if x.dim() != 2 or x.size(0) != self.channels or x.size(1) != self.samples:
            raise ValueError(f"Expected one trace of {self.channels} x {self.samples} samples, got shape {trace.size()}.")
        return x.to(torch.float32).contiguous()

    def toss(self, content: int) -> int:
        """`folds.toss` of one hash: 64-bit integers that wrap around."""
        h = (content ^ (content >> 32)) * self.mix
        h = (h ^ (h >> 32)) * self.mix
        return int((h >> self.shift) & self.mask)
