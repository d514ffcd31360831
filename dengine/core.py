"""The module that answers: trace -> embedding -> judgement. What the engine asks is what an export saves."""

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


def build_core(spaces: Spaces, scale: NDArray[np.float32], judge: Judge) -> Core | EmbeddedCore:
    """The fastest form that the reducer and the interval allow."""
    module = spaces.module()
    if module is None:
        return EmbeddedCore(spaces, scale, judge if isinstance(judge, TableJudge) else script(judge))
    if isinstance(judge, TableJudge):
        return Core(script(module), torch.from_numpy(scale), judge).eval()
    core: Core = script(Core(module, torch.from_numpy(scale), judge).eval())
    return core
