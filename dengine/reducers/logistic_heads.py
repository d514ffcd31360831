"""Cross-fitted logistic heads for `RocketReducer`: `fit_heads` fits K logistic regressions with a
ridge penalty at once, head k on the rows outside fold k. It also returns their leave-one-out
logits, by which `RocketReducer` weighs its towers: the logit of a row there is of a head that was
not trained on that row.

References
----------
Rad and Maleki (2020), A scalable estimate of the out-of-sample prediction error via approximate
leave-one-out cross-validation, JRSS B 82(4).
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812  # PyTorch's own documentation calls it so

from .base import StopRule

BIAS_RIDGE = 1e-3  # the base rate is hardly shrunk
TOLERANCE = 2e-4  # of a weight: a head whose next step would be smaller has converged
HALVINGS = 6  # of a step that raises the objective


class HeadsFit(NamedTuple):
    """K fitted classifier heads: logistic regressions, each trained without one fold.

    Attributes
    ----------
    w : Tensor of float64, shape (K, W + 1)
        Weights, the bias last.
    left_out : Tensor of float64, shape (K, n)
        Leave-one-out logit of each row by each head, of use only if the row trains the head; the
        logit of the base rate for a head that was replaced by it.
    n_steps : int
        Newton steps that were taken.
    """

    w: Tensor
    left_out: Tensor
    n_steps: int


@dataclass(frozen=True, eq=False)
class RidgeProblem:
    """K ridge logistic regressions on the same features, each on rows of its own.

    Attributes
    ----------
    g32, g : Tensor of float32 and of float64, shape (n, W + 1)
        Features, with a column of ones.
    y : Tensor of float64, shape (n,)
        Labels, 1 or 0.
    mask : Tensor of float64, shape (K, n)
        1 for the rows that train head k, else 0.
    ridge : Tensor of float64, shape (K, W + 1)
        Ridge of each weight.
    """

    g32: Tensor
    g: Tensor
    y: Tensor
    mask: Tensor
    ridge: Tensor

    @classmethod
    def from_features(cls, g: Tensor, y: Tensor, outside: Tensor, l2: float) -> Self:
        """Return the problem for features g (n, W), labels y (n,) and masks `outside` (K, n).

        The problem is to fit K logistic regressions with a ridge penalty, called heads; nothing is
        fitted here. Head k is trained on the rows that mask k selects: those outside fold k, one of
        K groups of rows. A column of ones is appended to the features, for the bias. `l2` is the
        ridge of every weight but the bias, whose ridge is 0.001 (`BIAS_RIDGE`).
        """
        g32 = torch.cat([g, torch.ones(len(g), 1)], 1)
        ridge = torch.full((len(outside), g32.size(1)), l2, dtype=torch.float64)
        ridge[:, -1] = BIAS_RIDGE
        return cls(g32, g32.double(), y.double(), outside.double(), ridge)

    def objective(self, w: Tensor) -> Tensor:
        """Compute the objective of heads w (K, W + 1), in nats: (K,).

        It is the sum of log losses over the rows that train the head, plus half the ridge times the
        square of each weight.
        """
        return summed_loss(w @ self.g.T, self.y, self.mask) + 0.5 * (self.ridge * w * w).sum(1)

    def gradient(self, w: Tensor, p: Tensor) -> Tensor:
        """Compute the gradient of `objective` at heads w (K, W + 1): (K, W + 1).

        `p` (K, n) are the probabilities that these heads give; they are not computed here.
        """
        return (self.mask * (p - self.y)) @ self.g + self.ridge * w

    def cholesky_of_hessian(self, k: int, p: Tensor) -> Tensor:
        """Return the lower Cholesky factor of the Hessian of classifier head k.

        The factor is float64 (W + 1, W + 1), for W features and the bias. Head k is logistic
        regression k of this problem, and the Hessian is that of its objective (`objective`): the
        sum of the log losses over the rows that train it, plus the ridge penalty. `p` (n,) are the
        probabilities that head k gives. The product of features is computed in float32, since a
        Newton step may be inexact. Raises torch.linalg.LinAlgError if the Hessian is not positive
        definite, or has a NaN.
        """
        curvature = (self.mask[k] * p * (1.0 - p)).float()
        product = (self.g32 * curvature[:, None]).T @ self.g32  # a step need not be exact
        factor: Tensor = torch.linalg.cholesky(product.double() + torch.diag(self.ridge[k]))
        return factor


def fit_heads(
    g: Tensor,
    y: Tensor,
    outside: Tensor,
    w: Tensor,
    l2: float,
    max_iter: int,
    stop: StopRule,
    min_steps: int = 0,
) -> HeadsFit:
    """Fit K classifier heads, ridge logistic regressions, by Newton's method with a line search.

    Head k, trained without the labels of fold k (one of K groups of rows), minimises the sum of its
    log losses plus ``l2 / 2 * |w| ** 2``; the ridge of the bias is 0.001. This is convex, so a head
    ends at the same weights wherever it starts, unless the steps are limited. A step that raises
    the loss of a head, ridge included, is halved. If six sizes of the step raise it, the head stays
    where it is, and has ended, unless the factor of its Hessian was from an earlier step. A head
    has converged when its next step would change no weight by more than about 0.0002. The Cholesky
    factor of its Hessian is used again after a step whose largest change is at most a quarter of
    that of the step before, and at most 0.3; otherwise it is computed anew.

    If the leave-one-out loss of a head is above the loss of its base rate, the share of successes
    among its rows, the head is replaced by the base rate; a head whose rows are all of one class
    stays. This is decided for each head alone, since a common decision would let the labels of fold
    k influence head k.

    Parameters
    ----------
    g : Tensor of float32, shape (n, W)
        Features.
    y : Tensor of int64, shape (n,)
        Labels, 1 or 0.
    outside : Tensor of bool, shape (K, n)
        Which rows train head k.
    w : Tensor of float64, shape (K, W + 1)
        Weights from which the heads start, the bias last; the tensor is not changed.
    l2 : float
        Ridge.
    max_iter : int
        Largest number of steps.
    stop : StopRule
        Limit on the steps, by their number or by a deadline. It is asked before each step, which
        all heads take together. If it has a deadline, its `late` (whether the deadline ended the
        fit) and `last_step` (when the last step began) are set. The steps also end when all heads
        have converged, or after `max_iter`.
    min_steps : int, default 0
        Number of first steps that are taken even after the deadline of `stop`.

    Returns
    -------
    HeadsFit
        `w` (K, W + 1) are the weights, in a new tensor. `left_out` (K, n) is the logit of each row
        by each head as if it were fitted without the row (or of the base rate, if that replaced the
        head), of use only if the row trains the head. `n_steps` is the number of steps.

    Raises
    ------
    torch.linalg.LinAlgError
        If the Hessian of a head is not positive definite, for example if a feature is NaN.
    """
    problem = RidgeProblem.from_features(g, y, outside, l2)
    # Every head takes part in every product, whether it has converged or not: a product of another
    # shape rounds differently, and would so let the labels of fold k reach head k. For the same
    # reason each head decides alone when its factor is computed anew.
    converged = torch.zeros(len(w), dtype=torch.bool)
    loss = problem.objective(w)
    step = 0
    factors = torch.stack(
        [problem.cholesky_of_hessian(k, torch.sigmoid(w[k] @ problem.g.T)) for k in range(len(w))]
    )
    stale = converged
    last_size = torch.ones(len(w), dtype=torch.float64)
    while step < max_iter and not converged.all():
        if stop.exhausted(step, min_steps):
            break
        p = torch.sigmoid(w @ problem.g.T)
        for k in stale.nonzero().flatten().tolist():
            factors[k] = problem.cholesky_of_hessian(k, p[k])
        change = torch.cholesky_solve(problem.gradient(w, p)[..., None], factors)[..., 0]
        change[converged] = 0.0
        for _ in range(HALVINGS):
            new_loss = problem.objective(w - change)
            rises = new_loss > loss + 1e-9 * loss.abs()
            if not rises.any():
                break
            change[rises] /= 2.0
        change[rises] = 0.0
        w = w - change
        loss = torch.where(rises, loss, new_loss)
        step += 1
        size = change.abs().amax(1)
        next_size = size * (size / last_size).clamp(max=1.0)  # about that of the next step
        # A head whose step failed with an old factor has not converged.
        converged |= (next_size < TOLERANCE) & (stale | (step == 1) | ~rises)
        # A step with an old factor costs a tenth: a new one only where the old one is of no use.
        stale = ~converged & (rises | (size > (last_size / 4.0).clamp(max=0.3)))
        last_size = size
    left_out = leave_one_out(problem, w @ problem.g.T, factors)
    return HeadsFit(*base_rate_if_better(w, left_out, problem.y, problem.mask), step)


def base_rate_if_better(
    w: Tensor, left_out: Tensor, y: Tensor, mask: Tensor
) -> tuple[Tensor, Tensor]:
    """Replace each classifier head that does worse than its base rate by the base rate.

    A head is a logistic regression. Its base rate is the share of successes among all rows that
    train it. A head does worse if its leave-one-out log loss is larger than the log loss of the
    base rate, which is slightly too small, because it is no leave-one-out loss. A head whose rows
    are all of one class is kept.

    Parameters
    ----------
    w : Tensor of float64, shape (K, W + 1)
        Weights of the heads, the bias last; the tensor is not changed.
    left_out : Tensor of float64, shape (K, n)
        Leave-one-out logits of the heads; the tensor is not changed.
    y : Tensor of float64, shape (n,)
        Labels, 1 or 0.
    mask : Tensor of float64, shape (K, n)
        1 for the rows that train head k, else 0.

    Returns
    -------
    w, left_out : Tensor
        New tensors like the arguments. For a head that was replaced, the bias and all of its row of
        `left_out` are the logit of the base rate, and the other weights are 0.
    """
    rate = torch.logit((mask @ y) / mask.sum(1))[:, None].expand_as(left_out)
    # Of rows of one class, the rate has an infinite logit and a loss of NaN: the head stays.
    worse = masked_loss(left_out, y, mask) > masked_loss(rate, y, mask)
    w = torch.where(worse[:, None], 0.0, w)
    w[worse, -1] = rate[worse, 0]
    return w, torch.where(worse[:, None], rate, left_out)


def leave_one_out(problem: RidgeProblem, logits: Tensor, factors: Tensor) -> Tensor:
    """Approximate the logit that each classifier head would give each row if fitted without it.

    A head is a logistic regression of `problem`. The result is its logit plus ``h (p - y) / (1 - h
    p (1 - p))``, where p is the probability that it predicts, y the label, and h the leverage of
    the row, its squared length in the metric of the inverse Hessian. A divisor below 0.05 is
    replaced by 0.05.

    Parameters
    ----------
    problem : RidgeProblem
        Holds features and labels.
    logits : Tensor of float64, shape (K, n)
        Logits by the fitted heads.
    factors : Tensor of float64, shape (K, W + 1, W + 1)
        Cholesky factors of the heads' Hessians, over W features and the intercept.

    Returns
    -------
    Tensor of float64, shape (K, n)
        For rows that train the head it is exact to first order, unless the divisor was replaced.
        For other rows it is of no use.

    References
    ----------
    Rad and Maleki (2020).
    """
    p = torch.sigmoid(logits)
    inverses = torch.cholesky_inverse(factors).float()
    x = problem.g32
    leverage = torch.stack([((x @ inverse) * x).sum(1) for inverse in inverses])
    return logits + leverage * (p - problem.y) / (1.0 - leverage * p * (1.0 - p)).clamp(min=0.05)


def masked_loss(logits: Tensor, y: Tensor, mask: Tensor) -> Tensor:
    """Compute mean log losses, in nats, over the rows that each mask selects.

    logits (..., K, n), labels y (n,), mask (K, n) of 1 and 0. Returns (..., K), NaN for a mask
    that selects no row.
    """
    return summed_loss(logits, y, mask) / mask.sum(1)


def summed_loss(logits: Tensor, y: Tensor, mask: Tensor) -> Tensor:
    """Sum log losses, in nats, over the rows that each mask selects; 0 for a mask without rows.

    The arguments are those of `masked_loss`: logits (..., K, n), labels y (n,), mask (K, n) of 1
    and 0. Returns (..., K).
    """
    return (mask * (F.softplus(logits) - y * logits)).sum(-1)
