"""The compiled module that answers: trace -> embedding -> counts -> action. What the engine asks is what export saves.

`Predictor` is the model's part, encoder, references and rule; `DecisionModule` puts the trace gate before it and the
audits' coin behind it. Both compile to TorchScript.
"""

import copy
from dataclasses import dataclass
from functools import reduce
from itertools import chain
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ..decision.rule import RadiusNeighbours, script
from ..folds import COIN_BITS, MIX, audit_salt
from ..records import REASONS, Reason, TraceSpec
from ..reducers.base import Reducer
from ..traces import TraceGate

Predicted = tuple[int, float, float, int, int, Tensor]
One = tuple[int, int, float, float, int, int, Tensor]
Many = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
FIELDS = ("action", "reason", "lower", "upper", "n_success", "n_failure", "embedding")


class Predictor(nn.Module):
    """Encoder, scale, references and rule as one module; compiles where the rule does.

    encoder : (B, C, T) -> (B, K, d).
    scale : (K,) what each space is divided by.
    """

    scale: Tensor

    def __init__(self, encoder: nn.Module, scale: Tensor, neighbours: RadiusNeighbours) -> None:
        super().__init__()
        self.encoder = encoder
        self.register_buffer("scale", scale[:, None])
        self.scaled = bool((scale != 1.0).any())
        self.neighbours = neighbours

    @torch.jit.export
    def embed(self, x: Tensor) -> Tensor:
        """(C, T) one trace -> (K, d), scaled."""
        z: Tensor = self.encoder(x.unsqueeze(0))[0]
        return z / self.scale if self.scaled else z

    @torch.jit.export
    def add(self, x: Tensor, label: float, space: int) -> None:
        """Make one labelled trace (C, T) a reference of `space`."""
        self.neighbours.ring.put(self.embed(x)[space], label, space)

    @torch.jit.export
    def n_references(self) -> int:
        """References held."""
        return self.neighbours.ring.size()

    def forward(self, x: Tensor) -> Predicted:
        """(C, T) one trace -> action, lower, upper, n_success, n_failure, scaled embedding (K, d)."""
        z = self.embed(x)
        action, lower, upper, n_success, n_failure = self.neighbours(z)
        return action, lower, upper, n_success, n_failure, z


class PythonPredictor:
    """The same around a reducer that has no module, UMAP for one."""

    def __init__(self, reducer: Reducer, scale: NDArray[np.float32], neighbours: nn.Module) -> None:
        self.reducer = reducer
        self.scale = torch.from_numpy(scale)[:, None]
        self.neighbours = neighbours

    def embed(self, x: Tensor) -> Tensor:
        """(C, T) one trace -> (K, d), scaled."""
        return torch.from_numpy(self.reducer.embed(x[None].numpy())[0]) / self.scale

    def __call__(self, x: Tensor) -> Predicted:
        """(C, T) one trace -> action, lower, upper, n_success, n_failure, scaled embedding (K, d)."""
        z = self.embed(x)
        return (*self.neighbours(z), z)


@dataclass(frozen=True)
class CompiledPredictor:
    """The predictor that answers, and the structure of what it was compiled from (None: it was not compiled whole)."""

    predictor: Any
    structure: tuple[Any, ...] | None = None


def compile_predictor(
    reducer: Reducer, scale: NDArray[np.float32], neighbours: RadiusNeighbours, like: CompiledPredictor | None = None
) -> CompiledPredictor:
    """The fastest form that the reducer and the rule allow; a copy of `like` where that has the same structure."""
    module, compiles = reducer.module(), neighbours.rule.scriptable
    if module is None:
        return CompiledPredictor(PythonPredictor(reducer, scale, script(neighbours) if compiles else neighbours))
    if not compiles:
        return CompiledPredictor(Predictor(script(module), torch.from_numpy(scale), neighbours).eval())
    eager = Predictor(module, torch.from_numpy(scale), neighbours).eval()
    structure = _structure(eager)
    if like is None or like.structure != structure:
        return CompiledPredictor(script(eager), structure)
    return CompiledPredictor(_with_tensors_of(eager, copy.deepcopy(like.predictor)), structure)


def _with_tensors_of(eager: Predictor, scripted: Any) -> Any:
    """A scripted module with another one's tensors, shared, not copied: 1 ms where scripting takes 20, and warm already."""
    for name, tensor in chain(eager.named_buffers(), eager.named_parameters()):
        *path, leaf = name.split(".")
        setattr(reduce(getattr, path, scripted), leaf, tensor)
    return scripted


def _structure(eager: Predictor) -> tuple[Any, ...]:
    """All that scripting reads of a module but its tensors' values: classes, plain attributes, shapes."""
    plain = (bool, int, float, str, list)
    return tuple(
        (
            name,
            type(module).__qualname__,
            sorted((key, repr(value)) for key, value in vars(module).items() if isinstance(value, plain)),
            [
                (key, tuple(t.shape))
                for key, t in chain(module._buffers.items(), module._parameters.items())
                if t is not None
            ],
        )
        for name, module in eager.named_modules()
    )


class DecisionModule(nn.Module):
    """The whole decision, raw trace in, action out: gate, predictor and audits. What the cell controller runs.

    Actions are positions in `Action` (0 verify, 1 accept, 2 reject), reasons in `Reason`.

    `decide(trace)` answers on one trace in scalars; `forward(traces)` on a batch in tensors; both in the order of `FIELDS`.
    `learn(trace, success)` makes a verified trace a reference: bounded, in its own fold's space, the oldest one leaving
    first whatever its label. It does not retrain the encoder.
    """

    def __init__(
        self, spec: TraceSpec, predictor: Predictor, n_spaces: int, dim: int, audit_rate: float, seed: int
    ) -> None:
        super().__init__()
        self.gate = TraceGate(spec)
        self.predictor = predictor
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
        action, lower, upper, n_success, n_failure, z = self.predictor(x)
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
        """Add one verified trace to the references; returns how many there are. A faulty trace is not learned from."""
        x = self.as_trace(trace)
        fault, content = self.gate(x)
        if fault == 0:
            self.predictor.add(x, 1.0 if success else 0.0, self.toss(content) % self.n_spaces)
        return self.predictor.n_references()

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
