"""Training the encoder without labels: two views of a trace must look alike, and different traces must not.

    >>> training = EncoderTraining(encoder, seed=0)
    >>> training.run(traces, held_out, StopRule(max_steps=30))      # warm: the next run goes on where this one ended

A step draws 64 traces, distorts each twice, and lowers the VICReg loss of the two embeddings behind a projector: the mean
squared distance of the pairs, a hinge that keeps every dimension's deviation above 1, and the squared covariances of
dimensions, so that nothing collapses and nothing is said twice. No label is read, so it is honest for every fold. Whether
a training may answer is asked of traces that it never saw, by the same loss.

Source: Bardes, Ponce and LeCun (2022), VICReg, ICLR, arXiv:2105.04906.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  # torch's own name for it

from .base import StopRule
from .encoder import ConvEncoder

BETA_1, BETA_2 = 0.9, 0.999  # what a step leaves of the means of gradients and of their squares
PROJECTED = 128  # dimensions of the projector
INVARIANCE, VARIANCE, COVARIANCE = 25.0, 25.0, 1.0  # weights of the loss, as in its paper
FEWEST = 8  # held-out traces that can say whether a training did well
WORSE = 1.1  # times the held-out loss that a training may have, against the one that answers


class Adam:
    """Steps down the gradients of parameters, each group at its own rate.  groups : of parameters and a rate each.

    `torch.optim`'s gives the same numbers (a test compares them), but loads the compiler of torch at its first use: 2 s in
    the middle of a cell's cycle. Source: Kingma and Ba (2015), ICLR, algorithm 1.
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
            parameter.addcdiv_(mean, (square / of_squares).sqrt_().add_(1e-8), value=-rate / unbiased)
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


def shifted(a: Tensor, g: torch.Generator) -> Tensor:
    """Up to a twentieth earlier or later; what comes in repeats the end."""
    frames = a.size(2)
    most = max(1, frames // 20)
    by = torch.randint(-most, most + 1, (len(a), 1, 1), generator=g)
    return a.gather(2, (torch.arange(frames) + by).clamp(0, frames - 1).expand_as(a))


def masked(a: Tensor, g: torch.Generator) -> Tensor:
    """An eighth of the trace at its mean, in all channels."""
    frames = a.size(2)
    length = max(1, frames // 8)
    first = torch.randint(0, frames - length + 1, (len(a), 1, 1), generator=g)
    at = torch.arange(frames)
    return a.masked_fill((at >= first) & (at < first + length), 0.0)


AUGMENTATIONS: dict[str, Callable[[Tensor, torch.Generator], Tensor]] = {
    "shift": shifted,
    "scale": lambda a, g: a * (1.0 + 0.1 * torch.randn(*a.shape[:2], 1, generator=g)),  # each channel, by a tenth
    "offset": lambda a, g: a + 0.1 * torch.randn(*a.shape[:2], 1, generator=g),  # each channel, by a tenth of a deviation
    "jitter": lambda a, g: a + 0.05 * torch.randn(a.shape, generator=g),
    "mask": masked,
}


def vicreg_loss(one: Tensor, two: Tensor) -> Tensor:
    """The loss of two batches of embeddings, (B, d) each, of which row i is two views of trace i; B at least 2."""
    loss = INVARIANCE * F.mse_loss(one, two)
    for z in (one, two):
        centred = z - z.mean(0)
        deviation = (centred.var(0) + 1e-4).sqrt()
        covariance = centred.T @ centred / (len(z) - 1)
        crossed = covariance.square().sum() - covariance.diagonal().square().sum()
        loss = loss + VARIANCE / 2 * F.relu(1.0 - deviation).mean() + COVARIANCE / 2 * crossed / z.size(1)
    return loss


class _Learner(nn.Module):
    """The encoder's trained part and a projector: (B, C, L) averaged traces -> (B, 128)."""

    def __init__(self, encoder: ConvEncoder) -> None:
        super().__init__()
        self.encoder = encoder.requires_grad_(True)
        self.project = nn.Sequential(
            nn.Linear(encoder.mix.size(1), PROJECTED), nn.BatchNorm1d(PROJECTED), nn.ReLU(), nn.Linear(PROJECTED, PROJECTED)
        )

    def forward(self, a: Tensor, taps: Tensor, pool: Tensor) -> Tensor:
        out: Tensor = self.project(self.encoder.mixed(self.encoder.pooled(a, taps, pool)))
        return out

    def loss(self, a: Tensor, augmentations: tuple[str, ...], g: torch.Generator, places: tuple[Tensor, Tensor]) -> Tensor:
        """VICReg's loss of averaged traces (n, C, L), each distorted twice."""
        views = torch.cat([a, a])
        for name in augmentations:
            views = AUGMENTATIONS[name](views, g)
        return vicreg_loss(*self(views, *places).chunk(2))


@dataclass(frozen=True)
class Release:
    """What became of a training that wanted to answer.

    encoder : None: it does worse than the one that answers, and is given up.
    loss : held-out loss, NaN where too few traces are held out.
    moved : how far it moved their embedding, 0 to 1: one minus the linear centred kernel alignment.
    """

    encoder: ConvEncoder | None
    loss: float
    moved: float


class EncoderTraining:
    """Trains a copy of an encoder, apart from the one that answers, which takes it over when it is released.

    encoder : one that has learned its kernels and thresholds; it is copied.
    seed : of the projector, the batches and the distortions.
    augmentations : names in `AUGMENTATIONS`, in the order in which they distort.
    steps : taken so far, over all runs.
    """

    def __init__(self, encoder: ConvEncoder, seed: int, augmentations: tuple[str, ...] = tuple(AUGMENTATIONS)) -> None:
        self.seed, self.augmentations, self.steps = seed, augmentations, 0
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.learner = _Learner(copy.deepcopy(encoder))
        self.adam = self._optimiser()
        self.released = copy.deepcopy(self.learner)  # what answers, with the projector that it was trained behind
        self.released_at = 0
        self.held_out = torch.zeros(0, 1, 1)

    def _optimiser(self) -> Adam:
        encoder = self.learner.encoder
        linear = [encoder.mix, *self.learner.project.parameters()]
        # Kernels trained faster cost the principal axes what these were worth.
        return Adam([([encoder.kernel, encoder.threshold], 1e-4), (linear, 1e-3)])

    @property
    def waits(self) -> bool:
        """Whether steps were taken since the last release."""
        return self.steps > self.released_at

    @property
    def encoder(self) -> ConvEncoder:
        """The copy that is trained."""
        return self.learner.encoder

    def run(self, traces: Tensor, held_out: Tensor, stop: StopRule) -> int:
        """Train until the stop rule says so, from where the last run ended; returns steps taken.

        traces : (n, C, T) to train on.  held_out : (m, C, T) never trained on; the gate asks them.
        """
        if len(traces) < 2:
            return 0
        with torch.no_grad():
            averaged, self.held_out = self.encoder.averaged(traces), self.encoder.averaged(held_out)
        step, thin = (
            0,
            max(1, self.encoder.n_places // 33),
        )  # a step looks at about 33 places
        while not stop.exhausted(step):
            g = self._generator(self.steps)
            drawn = torch.randperm(len(averaged), generator=g)[:64]
            places = self.encoder.thinned(self.steps % thin, thin)
            loss = self.learner.loss(averaged[drawn], self.augmentations, g, places)
            loss.backward()  # type: ignore[no-untyped-call]  # torch's own
            self.adam.step()
            step, self.steps = step + 1, self.steps + 1
        return step

    def release(self) -> Release:
        """Hand the trained encoder over, where it does no worse on the held-out traces than the one that answers.

        One that is refused is given up: training goes on from what answers.
        """
        self.released_at, loss, moved = self.steps, float("nan"), float("nan")
        fine = all(bool(torch.isfinite(trained).all()) for trained in self.learner.parameters())
        if fine and len(self.held_out) >= FEWEST:
            loss = self.held_out_loss(self.learner)
            fine = loss <= WORSE * self.held_out_loss(self.released)
            moved = self._moved()
        if not fine:
            self.learner.load_state_dict(self.released.state_dict())
            self.adam = self._optimiser()
            return Release(None, loss, moved)
        self.released.load_state_dict(self.learner.state_dict())
        return Release(self.encoder, loss, moved)

    def _moved(self) -> float:
        """Kornblith, Norouzi, Lee and Hinton (2019), Similarity of neural network representations revisited, ICML."""
        with torch.no_grad():
            both = (self.released.encoder, self.encoder)
            pair = [each.mixed(each.pooled(self.held_out, each.taps, each.pool)) for each in both]
            a, b = (z - z.mean(0) for z in pair)
            alike = (a.T @ b).square().sum() / ((a.T @ a).norm() * (b.T @ b).norm()).clamp(min=1e-12)
        return float(1.0 - alike)

    def held_out_loss(self, learner: _Learner) -> float:
        """Of the held-out traces, always distorted alike."""
        with torch.no_grad():
            everywhere = self.encoder.thinned(0, 1)
            return float(learner.loss(self.held_out, self.augmentations, self._generator(-1), everywhere))

    def _generator(self, step: int) -> torch.Generator:
        # Of the step and the seed alone: a training that was stored goes on as it would have.
        return torch.Generator().manual_seed(2**32 * self.seed + step + 1)

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Plain arrays: network, projector, the optimiser's moments and the steps."""
        state = {name: value.detach().numpy().copy() for name, value in self.learner.state_dict().items()}
        state |= {f"adam.{name}": value for name, value in self.adam.get_state().items()}
        return state | {"steps": np.array(self.steps)}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> EncoderTraining:
        """Go on from what `get_state` gave."""
        self.adam.set_state({name[5:]: value for name, value in state.items() if name.startswith("adam.")})
        names = self.learner.state_dict()
        self.learner.load_state_dict({name: torch.from_numpy(np.array(state[name])) for name in names})
        self.released.load_state_dict(self.learner.state_dict())
        self.steps = self.released_at = int(state["steps"])
        return self
