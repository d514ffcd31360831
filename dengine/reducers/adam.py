"""Adam, as the encoder trains with it: Kingma and Ba (2015), Adam: a method for stochastic optimization, ICLR, algorithm 1.

`torch.optim`'s gives the same numbers (a test compares them), but loads the compiler of torch at its first use: 2 s in the
middle of a cell's cycle, where a slice of training has 0.45 s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

BETA_1, BETA_2 = 0.9, 0.999  # what a step leaves of the means of gradients and of their squares
EPSILON = 1e-8


class Adam:
    """Steps down the gradients of parameters, each group at its own rate.

    groups : of parameters and a rate each.
    """

    def __init__(self, groups: Sequence[tuple[Sequence[Tensor], float]]) -> None:
        self._rates = [(parameter, rate) for parameters, rate in groups for parameter in parameters]
        self._means = [torch.zeros_like(parameter) for parameter, _ in self._rates]
        self._squares = [torch.zeros_like(parameter) for parameter, _ in self._rates]
        self._steps = 0

    @torch.no_grad()
    def step(self) -> None:
        """One step by the gradients that are there; they are taken away."""
        self._steps += 1
        unbiased, of_squares = 1.0 - BETA_1**self._steps, 1.0 - BETA_2**self._steps
        for (parameter, rate), mean, square in zip(self._rates, self._means, self._squares, strict=True):
            assert parameter.grad is not None  # for the type checker: every parameter is part of the loss
            mean.lerp_(parameter.grad, 1.0 - BETA_1)
            square.lerp_(parameter.grad.square(), 1.0 - BETA_2)
            parameter.addcdiv_(mean, (square / of_squares).sqrt_().add_(EPSILON), value=-rate / unbiased)
            parameter.grad = None

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Moments and steps as plain arrays."""
        kinds = {"mean": self._means, "square": self._squares}
        moments = {f"{kind}.{i}": m.numpy().copy() for kind, some in kinds.items() for i, m in enumerate(some)}
        return moments | {"steps": np.array(self._steps)}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from what `get_state` gave."""
        for kind, some in (("mean", self._means), ("square", self._squares)):
            for i, moment in enumerate(some):
                moment.copy_(torch.from_numpy(np.array(state[f"{kind}.{i}"])))
        self._steps = int(state["steps"])
