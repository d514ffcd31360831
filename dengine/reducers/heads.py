"""Features and heads as one module: what answers in the engine, and what export saves.

Cross-fitted logistic heads: features -> probabilities of success, head k from outside fold k.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  # torch's own name for it

from .base import StopRule, one_class_outside
from .features import Carry, Features

SECOND_AXIS = 0.04  # range of the second coordinate: seen in a picture, small against a radius of 0.05
CONVERGED = 1e-5  # largest change of a weight


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
        return self.places(F.linear(g, self.weight, self.bias))

    def places(self, scores: Tensor) -> Tensor:
        """(B, K*d) -> (B, K, d)."""
        return torch.sigmoid(scores).mul_(self.unit).view(-1, self.folds, self.dim)

    def carry_over(self, carry: Carry) -> None:
        """Give the scores they had, on features that are standardised anew."""
        weight, bias = carry(self.weight, self.bias)
        self.weight.copy_(weight)
        self.bias.copy_(bias)

    def train_on(
        self, g: Tensor, y: Tensor, folds: Tensor, l2: float, max_iter: int, stop: StopRule | None, least: int = 0
    ) -> int:
        """At most `max_iter` Newton steps from the present weights, the first `least` however late; returns how many.

        Sets `losses` (K,), each head's leave-one-out log loss. A head that says held-out labels worse than their base rate
        does, and worse than its earlier weights, keeps those (`kept` names it): its own gate, outside fold k, since a
        common one would let fold k's labels choose head k.
        """
        g = torch.cat([g.double(), torch.ones(len(g), 1, dtype=torch.float64)], 1)
        heads = [self._head(k, g, y, folds != k, l2) for k in range(self.folds)]
        steps = _interleave(heads, max_iter, stop, least)
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
        classes = len(torch.unique(y[outside]))
        if classes < 2:
            raise one_class_outside(k, int(outside.sum()), classes)
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


def _interleave(heads: Sequence[_NewtonHead], max_iter: int, stop: StopRule | None, least: int) -> int:
    """A step of every head in turn, so that a deadline finds them all equally far."""
    step = 0
    while step < max_iter and not all(h.done for h in heads):
        if stop is not None and stop.exhausted(step, least):
            break
        for head in heads:
            if not head.done:
                head.step()
        step += 1
    return step


class FeatureEmbedding(nn.Module):
    """(B, C, T) raw traces -> (B, K, d).

    A linear layer at the end of the features and the heads are one matrix here, `fold` says which.
    """

    weight: Tensor
    bias: Tensor

    def __init__(self, features: Features, head: CrossFittedScores) -> None:
        super().__init__()
        self.features = features
        self.head = head
        self.register_buffer("weight", torch.zeros(len(head.weight), len(features.gain)), persistent=False)
        self.register_buffer("bias", torch.zeros_like(head.bias), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T) float32 -> (B, K, d) float32."""
        out: Tensor = self.head.places(nn.functional.linear(self.features.clipped(x), self.weight, self.bias))
        return out

    def fold(self) -> None:
        """Set the matrix from what features and heads are now."""
        weight, bias = self.features.folded(self.head.weight, self.head.bias)
        self.weight.copy_(weight)
        self.bias.copy_(bias)
