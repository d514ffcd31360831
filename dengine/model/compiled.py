"""The compiled module that answers: trace -> embedding -> counts -> action. What the engine asks is what export saves.

`Predictor` is the model's part, encoder, references and rule; it compiles to TorchScript, and `export.module` puts the
trace gate before it and the audits' coin behind it.
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

from ..decision.novelty import NoveltyGate
from ..decision.rule import RadiusNeighbours, script
from ..records import REASONS, Reason
from ..reducers.base import Reducer

Predicted = tuple[int, int, float, float, int, int, Tensor]
NOVEL = REASONS.index(Reason.NOVEL)


class Predictor(nn.Module):
    """Encoder, scale, novelty, references and rule as one module; compiles where the rule does.

    encoder : (B, C, T) -> (B, K, d).
    scale : (K,) what each space is divided by.
    """

    scale: Tensor

    def __init__(self, encoder: nn.Module, scale: Tensor, novelty: NoveltyGate, neighbours: RadiusNeighbours) -> None:
        super().__init__()
        self.encoder = encoder
        self.register_buffer("scale", scale[:, None])
        self.scaled = bool((scale != 1.0).any())
        self.novelty = novelty
        self.neighbours: RadiusNeighbours = neighbours
        self.novel = NOVEL

    @torch.jit.export
    def embed(self, x: Tensor) -> Tensor:
        """(C, T) one trace -> (K, d), scaled."""
        z: Tensor = self.encoder(x.unsqueeze(0))[0]
        return z / self.scale if self.scaled else z

    @torch.jit.export
    def add(self, point: Tensor, label: float, space: int, part: int) -> None:
        """Make one labelled point (d,) of a part a reference of `space`."""
        self.neighbours.ring.put(point, label, space, part)

    @torch.jit.export
    def n_references(self) -> int:
        """References held."""
        return self.neighbours.ring.size()

    @torch.jit.export
    def tell(self, lower: float, upper: float, success: bool, silent: int, novel: bool) -> None:
        """Tell the rule what became of a part."""
        self.neighbours.rule.observe(silent, novel)
        self.neighbours.rule.tell(lower, upper, success)

    @torch.jit.export
    def safe_mode(self) -> int:
        """Position in `SAFE_MODE` of the rule."""
        return int(self.neighbours.rule.safe_mode())

    def forward(self, x: Tensor, part: int = 0) -> Predicted:
        """(C, T) one trace -> action, reason, lower, upper, n_success, n_failure, scaled embedding (K, d).

        part : the hash of its part, which has no vote on itself; 0 for an unknown one.
        """
        z = self.embed(x)
        if self.novelty(x):
            return 0, self.novel, 0.0, 1.0, 0, 0, z
        action, lower, upper, n_success, n_failure = self.neighbours(z, part)
        return action, self.neighbours.reason(action), lower, upper, n_success, n_failure, z


class PythonPredictor:
    """The same around a reducer that has no module, UMAP for one."""

    def __init__(self, reducer: Reducer, scale: NDArray[np.float32], novelty: Any, neighbours: Any) -> None:
        self.reducer = reducer
        self.scale = torch.from_numpy(scale)[:, None]
        self.novelty = novelty
        self.neighbours = neighbours

    def embed(self, x: Tensor) -> Tensor:
        """(C, T) one trace -> (K, d), scaled."""
        return torch.from_numpy(self.reducer.embed(x[None].numpy())[0]) / self.scale

    def __call__(self, x: Tensor, part: int = 0) -> Predicted:
        """`Predictor.forward`."""
        z = self.embed(x)
        if self.novelty(x):
            return 0, NOVEL, 0.0, 1.0, 0, 0, z
        action, *counted = self.neighbours(z, part)
        return (action, self.neighbours.reason(action), *counted, z)


@dataclass(frozen=True)
class CompiledPredictor:
    """The predictor that answers, and the structure of what it was compiled from (None: it was not compiled whole)."""

    predictor: Any
    structure: tuple[Any, ...] | None = None


def compile_predictor(
    reducer: Reducer,
    scale: NDArray[np.float32],
    novelty: NoveltyGate,
    neighbours: RadiusNeighbours,
    like: CompiledPredictor | None = None,
) -> CompiledPredictor:
    """The fastest form that the reducer and the rule allow; a copy of `like` where that has the same structure."""
    module, compiles = reducer.module(), neighbours.rule.scriptable
    if module is None:
        answering = script(neighbours) if compiles else neighbours
        return CompiledPredictor(PythonPredictor(reducer, scale, script(novelty), answering))
    if not compiles:
        return CompiledPredictor(Predictor(script(module), torch.from_numpy(scale), script(novelty), neighbours).eval())
    eager = Predictor(module, torch.from_numpy(scale), novelty, neighbours).eval()
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
