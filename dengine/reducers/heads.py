"""From features to an embedding: cross-fitted probabilities, or a plane that keeps neighbours.

`CrossFittedScores` reads labels and has K spaces; `NeighbourPlane` reads none and has one. Each holds its network and
its training, and each can go on from where it was.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  # torch's own name for it

from ..errors import SettingError

SECOND_AXIS = 0.04  # range of the second coordinate: seen in a picture, small against a radius of 0.05
NEWTON_STEPS = 12
CONVERGED = 1e-5  # largest change of a weight
PLANE_STEPS = 300
GRAPH_ROWS = 2000  # all pairwise distances of 2000 rows take 30 ms


class Stop(Protocol):
    """What ends a fit before it is done: asked before each step."""

    def exhausted(self, step: int) -> bool:
        """Whether step number `step`, from 0, may no longer begin."""
        ...


class CrossFittedScores(nn.Module):
    """(B, P) features -> (B, K, d): axis 1 the success probability of logistic head k, axis 2 a principal direction.

    Head k is trained on rows outside fold k. A probability is the natural axis for counting: what is sure lies close
    together, and a radius of 0.05 means "parts as promising as this one, give or take five in a hundred".
    """

    weight: Tensor
    bias: Tensor
    unit: Tensor
    losses: Tensor
    kept: Tensor

    def __init__(self, n_features: int, folds: int, dim: int) -> None:
        super().__init__()
        self.folds, self.dim = folds, dim
        # Axis 2 is the same in every space; its copies cost less than an op to spread it.
        self.register_buffer("weight", torch.zeros(folds * dim, n_features))
        self.register_buffer("bias", torch.zeros(folds * dim))
        self.register_buffer("unit", torch.tensor([1.0, SECOND_AXIS][:dim]).repeat(folds))
        self.register_buffer("losses", torch.zeros(folds, dtype=torch.float64))
        self.register_buffer("kept", torch.zeros(folds, dtype=torch.bool))

    def forward(self, g: Tensor) -> Tensor:
        """(B, P) -> (B, K, d)."""
        z = torch.sigmoid(F.linear(g, self.weight, self.bias)).mul_(self.unit)  # (B, K*d)
        return z.view(-1, self.folds, self.dim)

    def carry_over(self, ratio: Tensor, shift: Tensor) -> None:
        """Give the scores they had when features were ratio * g + shift: standardised anew, not moved."""
        self.bias += self.weight @ shift
        self.weight *= ratio

    def train_on(self, g: Tensor, y: Tensor, folds: Tensor, l2: float, stop: Stop | None) -> int:
        """Newton steps from the present weights; returns how many.

        Sets `losses` (K,), each head's leave-one-out log loss. A head that says held-out labels worse than their base rate
        does, and worse than its earlier weights, keeps those (`kept` names it): its own gate, outside fold k, since a
        common one would let fold k's labels choose head k.
        """
        g = torch.cat([g.double(), torch.ones(len(g), 1, dtype=torch.float64)], 1)
        heads = [self._head(k, g, y, folds != k, l2) for k in range(self.folds)]
        steps = _interleave(heads, stop)
        for k, head in enumerate(heads):
            self.losses[k] = head.leave_one_out_loss()
            self.kept[k] = bool(self.losses[k] > max(head.first_loss, head.base_rate_loss()))
            if self.kept[k]:
                continue
            self.weight[k * self.dim], self.bias[k * self.dim] = head.w[:-1].float(), head.w[-1].float()
        if self.dim == 2:
            self._turn(g[:, :-1])
        return steps

    def _head(self, k: int, g: Tensor, y: Tensor, outside: Tensor, l2: float) -> "_NewtonHead":
        # Fold k never trains head k, or its labels would count themselves.
        if len(torch.unique(y[outside])) < 2:
            raise SettingError(
                f"Expected both classes outside fold {k}, got {int(outside.sum())} traces of one; "
                "collect more labels before the first fit."
            )
        row = k * self.dim
        start = torch.cat([self.weight[row], self.bias[row : row + 1]]).double()
        return _NewtonHead(g[outside], y[outside].double(), start, l2)

    def _turn(self, g: Tensor) -> None:
        """The second axis: the first principal direction of the features, no label read, its sign as it was."""
        centred = g - g.mean(0)
        sizes, axes = torch.linalg.eigh(centred.T @ centred / len(g))
        direction = 2.0 * axes[:, -1] / sizes[-1].clamp(min=1e-12).sqrt()  # of one deviation at both sides, in the sigmoid
        self.weight[1::2] = (direction if direction @ self.weight[1].double() >= 0 else -direction).float()
        self.bias[1::2] = 0.0  # the features are centred


class _NewtonHead:
    """Ridge logistic regression, one damped Newton step at a time: convex, so it ends at one place wherever it starts.

    g (n, P+1) features with a column of ones, y (n,) labels, w (P+1,) start; minimises log loss + l2/2 |w|^2.
    """

    def __init__(self, g: Tensor, y: Tensor, w: Tensor, l2: float) -> None:
        self.g, self.y, self.w = g, y, w
        self.ridge = torch.full_like(w, l2)
        self.ridge[-1] = 1e-3  # the base rate is not shrunk
        self.done = False
        self.first_loss = float(F.binary_cross_entropy_with_logits(g @ w, y))

    def loss(self, w: Tensor) -> Tensor:
        return F.binary_cross_entropy_with_logits(self.g @ w, self.y, reduction="sum") + 0.5 * (self.ridge * w) @ w

    def hessian(self, p: Tensor) -> Tensor:
        curvature = (p * (1.0 - p)).clamp(min=1e-3)  # saturated rows keep some: the step stays finite
        return (self.g * curvature[:, None]).T @ self.g + torch.diag(self.ridge)

    def step(self) -> None:
        p = torch.sigmoid(self.g @ self.w)
        d = torch.linalg.solve(self.hessian(p), self.g.T @ (p - self.y) + self.ridge * self.w)
        before = self.loss(self.w)
        for _ in range(6):
            if self.loss(self.w - d) <= before:
                self.w = self.w - d
                break
            d = d / 2.0
        # Each head stops on its own: a common test would let fold k's labels choose head k's last step.
        self.done = bool(d.abs().max() < CONVERGED)

    def base_rate_loss(self) -> float:
        """Mean log loss of the labels' own mean: what knowing nothing of a trace costs."""
        return float(F.binary_cross_entropy(self.y.mean().expand_as(self.y), self.y))

    def leave_one_out_loss(self) -> float:
        """Mean log loss of every row by the head without it, to first order: Rad and Maleki (2020), JRSS B 82(4)."""
        s = self.g @ self.w
        p = torch.sigmoid(s)
        lever = (torch.linalg.solve(self.hessian(p), self.g.T).T * self.g).sum(1)  # (n,)
        v = p * (1.0 - p)
        left_out = s + lever * (p - self.y) / (1.0 - lever * v).clamp(min=0.05)
        return float(F.binary_cross_entropy_with_logits(left_out, self.y))


def _interleave(heads: Sequence[_NewtonHead], stop: Stop | None) -> int:
    """A step of every head in turn, so that a deadline finds them all equally far."""
    step = 0
    while step < NEWTON_STEPS and not all(h.done for h in heads):
        if stop is not None and stop.exhausted(step):
            break
        for head in heads:
            if not head.done:
                head.step()
        step += 1
    return step


class NeighbourPlane(nn.Module):
    """(B, P) features -> (B, 1, d): a linear part and a small network, trained to keep neighbours near. No label is read.

    The loss is UMAP's, over edges of the nearest-neighbour graph against random pairs (McInnes et al., 2018), minimised
    over a network's weights instead of over the points (parametric UMAP: Sainburg et al., 2021, Neural Computation 33).
    """

    def __init__(self, n_features: int, hidden: int, dim: int) -> None:
        super().__init__()
        self.linear = nn.Linear(n_features, dim)
        self.inner = nn.Linear(n_features, hidden)
        self.outer = nn.Linear(hidden, dim)

    def forward(self, g: Tensor) -> Tensor:
        """(B, P) -> (B, 1, d)."""
        z: Tensor = self.linear(g) + self.outer(torch.relu(self.inner(g)))
        return z.unsqueeze(1)

    def start(self, g: Tensor, generator: torch.Generator) -> None:
        """Begin at the principal components, scaled to one deviation: the same traces give the same map."""
        wide = (g - g.mean(0)).double()
        _, sizes, axes = torch.linalg.svd(wide, full_matrices=False)
        dim = self.linear.out_features
        unit = axes[:dim] / (sizes[:dim, None] / len(g) ** 0.5).clamp(min=1e-6)
        with torch.no_grad():
            for layer in (self.inner, self.outer):
                layer.weight.copy_(torch.randn(layer.weight.shape, generator=generator) / layer.in_features**0.5)
                layer.bias.zero_()
            self.outer.weight.zero_()
            self.linear.weight.copy_(unit)
            self.linear.bias.copy_(-unit.float() @ g.mean(0))

    def carry_over(self, ratio: Tensor, shift: Tensor) -> None:
        """Keep the points where they were when features were ratio * g + shift: standardised anew, not moved."""
        for layer in (self.linear, self.inner):
            layer.bias.add_(layer.weight @ shift)
            layer.weight.mul_(ratio)

    def train_on(
        self, g: Tensor, neighbours: int, batch: int, generator: torch.Generator, stop: Stop | None
    ) -> tuple[int, float]:
        """Adam over edges. Returns (steps, mean loss of the last quarter of them)."""
        edges = neighbour_edges(g, neighbours, generator)  # (E, 2)
        optimiser = torch.optim.Adam(self.parameters(), lr=3e-3)
        losses: list[float] = []
        for step in range(PLANE_STEPS):
            if stop is not None and stop.exhausted(step):
                break
            i, j = edges[torch.randint(len(edges), (batch,), generator=generator)].T
            away = torch.randint(len(g), (4 * batch,), generator=generator)
            z, z_near, z_away = self(g[i])[:, 0], self(g[j])[:, 0], self(g[away])[:, 0]  # (batch, d), (4*batch, d)
            near = (z - z_near).square().sum(1)
            far = (z.repeat(4, 1) - z_away).square().sum(1)
            # q = 1 / (1 + d^2), the low-dimensional similarity: -log q for edges, -log(1 - q) for random pairs
            loss = torch.log1p(near).mean() + (torch.log1p(far) - torch.log(far + 1e-3)).mean()
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]  # torch ships none for it
            optimiser.step()
            losses.append(float(loss.detach()))
        return len(losses), float(np.mean(losses[-max(1, len(losses) // 4) :])) if losses else float("nan")


def neighbour_edges(g: Tensor, neighbours: int, generator: torch.Generator) -> Tensor:
    """(E, 2) pairs of rows of g (n, P), each row with its nearest; among `GRAPH_ROWS` rows drawn at random, if more."""
    rows = torch.randperm(len(g), generator=generator)[:GRAPH_ROWS]
    k = min(neighbours, len(rows) - 1)
    nearest = torch.cdist(g[rows], g[rows]).topk(k + 1, largest=False).indices[:, 1:]  # (m, k), itself left out
    return torch.stack([rows.repeat_interleave(k), rows[nearest].flatten()], 1)


Head = CrossFittedScores | NeighbourPlane
