"""The whole decision as one module that compiles to TorchScript: what an exported file is, and a cell program runs.

It decides as `DataEngine.decide` does and learns as `DataEngine.report` does, between two retrains.
"""

import torch
from torch import Tensor, nn

from ..folds import COIN_BITS, MIX, audit_salt
from ..limits import ForceLimits
from ..model.neighbours import NOVEL, Predictor
from ..records import FITS, REASONS, Reason, TraceSpec
from ..traces import ForceLimitsGate, TraceGate, fit_length

One = tuple[int, int, float, float, int, int, Tensor]
FIELDS = ("action", "reason", "lower", "upper", "n_success", "n_failure", "embedding")
METHODS = ("forward", "decide", "learn", "stop", "settle", "safe_mode", "restore", "predicted", "drop", "n_references")
AUDIT, OUTSIDE = REASONS.index(Reason.AUDIT), REASONS.index(Reason.OUTSIDE)
NOBODY = -1  # waits for a label


class DecisionModule(nn.Module):
    """Gate, predictor and audits: raw trace in, action out, as positions in `Action` and `Reason`.

    A labelled trace becomes a reference, bounded, in its own fold's space, the oldest one leaving first whatever its label,
    and the rule is told. Encoder and novelty stay. With `stops_all` the next `decide` confirms an accepted part.

    Of the decision that waits for its label: waits, its action or NOBODY; alone, what the model alone would have done; own
    and content, the hashes of part and trace; novel, lower, upper, place (K, d). silent: accepted parts since the last
    label of which nothing was heard. All of it is saved with the module.
    """

    place: Tensor

    def __init__(
        self, spec: TraceSpec, predictor: Predictor, n_spaces: int, dim: int,
        audit_rate: float, seed: int, stops_all: bool = False, windows: tuple[ForceLimits, ...] = (),
    ) -> None:  # fmt: skip
        super().__init__()
        self.predictor, self.limit, self.windows = predictor, TraceGate(spec).limit, ForceLimitsGate(windows, spec)
        self.channels, self.samples, self.fit = spec.channels, spec.samples, FITS.index(spec.fit)
        self.n_spaces, self.dim = n_spaces, dim
        self.audit_below, self.salt, self.audit_rate = int(audit_rate * 2**COIN_BITS), audit_salt(seed), float(audit_rate)
        self.mix, self.shift, self.mask = MIX, 63 - COIN_BITS, 2**COIN_BITS - 1
        self.stops_all = stops_all
        self.audit_reason, self.novel_reason, self.outside_reason, self.nobody = AUDIT, NOVEL, OUTSIDE, NOBODY
        # Plain attributes: a scripted float that is assigned to an element of a tensor goes through float32.
        self.waits, self.alone, self.own, self.content, self.silent = NOBODY, 0, 0, 0, 0
        self.novel, self.lower, self.upper = False, 0.0, 1.0
        self.register_buffer("place", torch.zeros(n_spaces, dim))

    @torch.jit.export
    def decide(self, trace: Tensor, part: int = 0) -> One:
        """One trace, (T,) or (C, T) of any real dtype -> action, reason, lower, upper, n_success, n_failure, (K, d).

        part : the hash of its part's number (`folds.part_hash`); 0 for an unknown one.
        """
        x = self.as_trace(trace)
        self.settle()
        fault, content = self.predictor.gate.check(x, self.limit)
        one, alone = self.look(x, part, fault, content)
        action, reason, lower, upper, _, _, z = one
        self.wait(action if fault == 0 else self.nobody, alone, part, content, reason, lower, upper, z)
        return one

    def forward(self, trace: Tensor, part: int = 0) -> One:
        """`decide`, by the name that a plain `torch.jit.load` calls a module by."""
        return self.decide(trace, part)

    def look(self, x: Tensor, part: int, fault: int, content: int) -> tuple[One, int]:
        """(C, T) and what the gate says -> the decision, which changes nothing; what the model alone would have done."""
        if fault != 0:
            return (0, fault, 0.0, 1.0, 0, 0, torch.full((self.n_spaces, self.dim), float("nan"))), 0
        outside = self.windows(x)
        if outside != 0:
            return (2 * (outside - 1), self.outside_reason, 0.0, 1.0, 0, 0, self.predictor.embed(x)), 0
        alone, reason, lower, upper, n_success, n_failure, z = self.predictor(x, part if part != 0 else content)
        action = alone
        if alone != 0 and self.audit_below > 0 and self.toss(content ^ self.salt) < self.audit_below:
            action, reason = 0, self.audit_reason
        return (action, reason, lower, upper, n_success, n_failure, z), alone

    def wait(
        self, action: int, alone: int, part: int, content: int, reason: int, lower: float, upper: float, z: Tensor
    ) -> None:
        """Make this the decision that waits for its label."""
        self.waits, self.alone, self.lower, self.upper = action, alone, lower, upper
        self.own, self.content, self.novel = part if part != 0 else content, content, reason == self.novel_reason
        self.place.copy_(z)

    @torch.jit.export
    def learn(self, trace: Tensor, success: bool, part: int = 0) -> int:
        """What became of a part; returns how many references there are. A faulty trace is not learned from.

        A trace that is not the one decided last is looked at first: its bound must be one from before its label was known.
        """
        x = self.as_trace(trace)
        fault, content = self.predictor.gate.check(x, self.limit)
        if fault == 0:
            own = part if part != 0 else content
            if self.waits != self.nobody and self.own == own and self.content == content:
                self.take(success)
            else:  # what waits goes on waiting
                z, alone = self.look(x, part, fault, content)
                looked = self.looked(z[0], alone)
                self.count(z[2], z[3], z[1] == self.novel_reason, z[6], own, success, alone, looked)
        return self.n_references()

    @torch.jit.export
    def stop(self, trace: Tensor, part: int = 0) -> int:
        """An accepted part was bad and stopped the system."""
        return self.learn(trace, False, part)

    @torch.jit.export
    def settle(self) -> bool:
        """The next trace comes: an accepted part of which nothing was heard went on. Whether that confirmed it."""
        if self.waits != 1:
            return False
        if self.stops_all:
            self.take(True)
            return True
        self.silent += 1
        self.waits = self.nobody
        return False

    @torch.jit.export
    def drop(self) -> None:
        """Nothing will be known of the part that was decided last, and its silence is none: it did not go on."""
        self.waits = self.nobody

    @torch.jit.export
    def restore(self, trace: Tensor, part: int, action: int, reason: int, lower: float, upper: float) -> None:
        """In the place of `decide`: a decision that was made before, as a journal has it, waits for its label again."""
        x = self.as_trace(trace)
        self.settle()
        fault, content = self.predictor.gate.check(x, self.limit)
        waits = action if fault == 0 else self.nobody
        alone = 0 if reason == self.outside_reason else action
        if reason == self.audit_reason:
            alone = self.predictor.neighbours.rule.action(lower, upper)
        self.wait(waits, alone, part, content, reason, lower, upper, self.predictor.embed(x))

    @torch.jit.export
    def predicted(self) -> int:
        """What the model alone would have done with the trace decided last: something else than was done in audits only."""
        return self.alone

    @torch.jit.export
    def safe_mode(self) -> int:
        """Why everything is verified at present: the position in `SAFE_MODES`, 0 where it is not."""
        return self.predictor.neighbours.rule.safe_mode()

    @torch.jit.export
    def n_references(self) -> int:
        """References held."""
        return self.predictor.neighbours.references.size()

    def take(self, success: bool) -> None:
        """What became of the part that was decided last."""
        looked = self.looked(self.waits, self.alone)
        self.count(self.lower, self.upper, self.novel, self.place, self.own, success, self.alone, looked)
        self.waits = self.nobody

    def looked(self, action: int, alone: int) -> float:
        """`Decision.inclusion_probability`."""
        if action != 0:
            return 0.0
        return 1.0 if alone == 0 else self.audit_rate

    def count(
        self, lower: float, upper: float, novel: bool, z: Tensor, own: int, success: bool, alone: int, looked: float
    ) -> None:
        """Tell the rule of a part, and make it a reference."""
        around, space = self.predictor.neighbours, self.toss(own) % self.n_spaces
        around.rule.observe(self.silent, novel)
        around.rule.update(lower, upper, success, alone, looked)
        around.references.put(z[space], 1.0 if success else 0.0, space, own)
        self.silent = 0

    def as_trace(self, trace: Tensor) -> Tensor:
        """(C, T) float32 of the contract's length; raises for another shape, which is a caller's bug."""
        x = trace.unsqueeze(0) if trace.dim() == 1 else trace
        length = x.size(-1) == self.samples or (self.fit != 0 and x.numel() > 0)
        if x.dim() != 2 or x.size(0) != self.channels or not length:
            raise ValueError(f"Expected one trace of {self.channels} x {self.samples} samples, got shape {trace.size()}.")
        x = x.to(torch.float32).contiguous()
        return x if x.size(1) == self.samples else fit_length(x, self.samples, self.fit)

    def toss(self, content: int) -> int:
        """`folds.toss` of one hash: 64-bit integers that wrap around."""
        h = (content ^ (content >> 32)) * self.mix
        h = (h ^ (h >> 32)) * self.mix
        return int((h >> self.shift) & self.mask)
