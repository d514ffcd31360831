"""The module that answers: trace -> embedding -> judgement. What the engine asks is what an export saves."""

import copy
from dataclasses import dataclass
from functools import reduce
from itertools import chain
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from .judge import Judge, TableJudge, script
from .reducers.base import Spaces

Judged = tuple[int, float, float, int, int, Tensor]


class Core(nn.Module):
    """Encoder, scale and judge as one module; scripts where the judge does.

    encoder : (B, C, T) -> (B, K, d).
    scale : (K,) what each space is divided by.
    """

    scale: Tensor

    def __init__(self, encoder: nn.Module, scale: Tensor, judge: Judge) -> None:
        super().__init__()
        self.encoder = encoder
        self.register_buffer("scale", scale[:, None])
        self.scaled = bool((scale != 1.0).any())
        self.judge = judge

    @torch.jit.export
    def embed(self, x: Tensor) -> Tensor:
        """(C, T) one trace -> (K, d), scaled."""
        z: Tensor = self.encoder(x.unsqueeze(0))[0]
        return z / self.scale if self.scaled else z

    @torch.jit.export
    def hold(self, x: Tensor, label: float, space: int) -> None:
        """Make one labelled trace (C, T) a reference of `space`."""
        self.judge.ring.put(self.embed(x)[space], label, space)

    @torch.jit.export
    def held(self) -> int:
        """References held."""
        return self.judge.ring.size()

    def forward(self, x: Tensor) -> Judged:
        """(C, T) one trace -> action, lower, upper, n_success, n_failure, scaled embedding (K, d)."""
        z = self.embed(x)
        action, lower, upper, n_success, n_failure = self.judge(z)
        return action, lower, upper, n_success, n_failure, z


class EmbeddedCore:
    """The same around a reducer that has no module, UMAP for one."""

    def __init__(self, spaces: Spaces, scale: NDArray[np.float32], judge: nn.Module) -> None:
        self.spaces = spaces
        self.scale = torch.from_numpy(scale)[:, None]
        self.judge = judge

    def embed(self, x: Tensor) -> Tensor:
        """(C, T) one trace -> (K, d), scaled."""
        return torch.from_numpy(self.spaces.embed(x[None].numpy())[0]) / self.scale

    def __call__(self, x: Tensor) -> Judged:
        """(C, T) one trace -> action, lower, upper, n_success, n_failure, scaled embedding (K, d)."""
        z = self.embed(x)
        return (*self.judge(z), z)


@dataclass(frozen=True)
class Answering:
    """The module that answers, and the structure of what it was scripted from (None: it was not scripted)."""

    core: Core | EmbeddedCore
    structure: tuple[Any, ...] | None = None


def build_core(spaces: Spaces, scale: NDArray[np.float32], judge: Judge, like: Answering | None = None) -> Answering:
    """The fastest form that the reducer and the interval allow; a copy of `like` where that has the same structure."""
    module = spaces.module()
    if module is None:
        return Answering(EmbeddedCore(spaces, scale, judge if isinstance(judge, TableJudge) else script(judge)))
    if isinstance(judge, TableJudge):
        return Answering(Core(script(module), torch.from_numpy(scale), judge).eval())
    eager = Core(module, torch.from_numpy(scale), judge).eval()
    structure = _structure(eager)
    if like is None or like.structure != structure:
        return Answering(script(eager), structure)
    return Answering(_with_tensors_of(eager, copy.deepcopy(like.core)), structure)


def _with_tensors_of(eager: Core, scripted: Any) -> Any:
    """A scripted module with another one's tensors, shared, not copied: 1 ms where scripting takes 20, and warm already."""
    for name, tensor in chain(eager.named_buffers(), eager.named_parameters()):
        *path, leaf = name.split(".")
        setattr(reduce(getattr, path, scripted), leaf, tensor)
    return scripted


def _structure(eager: Core) -> tuple[Any, ...]:
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
