"""Cross-fitted logistic heads over features that read no label: head k is trained outside fold k.

`FeatureEmbedding` is features and heads as one module: what answers in the engine, and what export saves. `FeatureReducer`
fits, warm-starts, stores and restores it; a kind of reducer gives its features.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import check_is_fitted
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  # torch's own name for it

from ..errors import SettingError
from ..folds import content_fold
from .base import FitReport, Floats, Ints, Reducer, StopRule, binary_labels, one_class_outside, own_places, part, seed_of
from .features import Carry, Features, KeptFeatures, keys_of

MIN_TRACES = 20  # that an engine's first model is trained on
FIRST_STEPS = 3  # of the heads, however late: without any, a first model would hold all parts for alike
CHUNK = 64  # traces embedded at a time: what they need stays in the cache
SECOND_AXIS = 0.04  # range of the second coordinate: seen in a picture, small against a radius of 0.05


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
        self.done = bool(d.abs().max() < 1e-5)

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
        for head in (h for h in heads if not h.done):
            head.step()
        step += 1
    return step


class FeatureEmbedding(nn.Module):
    """(B, C, T) raw traces -> (B, K, d): a linear layer at the end of the features and the heads are one matrix."""

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


class FeatureReducer(Reducer):
    """Trace -> point, by features and cross-fitted logistic heads: axis 1 is a probability, its own unit.

    A kind has parameters `n_components` (d, 1 or 2), `folds` (K), `l2`, `max_iter` and `random_state` at least.
    `n_iter_` : steps of the last fit.  `holdout_losses_` (K,) : the heads' leave-one-out log losses, each on rows outside
    its fold; `holdout_loss_` is their mean.  `note_` : what the fit has to tell.
    """

    uses_labels = True
    own_unit = True  # a radius of 0.05 is five in a hundred, never rescaled
    train_traces = 4000  # that train the heads in one fit, so that it ends in time however many references there are
    n_components: int
    folds: int
    l2: float
    max_iter: int
    random_state: Any
    net_: FeatureEmbedding
    kept_: KeptFeatures

    @property
    def n_spaces(self) -> int:
        return int(self.folds)

    def make_features(self, channels: int, samples: int) -> Features:
        """The features of traces (C, T)."""
        raise NotImplementedError

    def fit(
        self, X: ArrayLike, y: ArrayLike | None = None, *, folds: Ints | None = None, stop: StopRule | None = None
    ) -> Self:
        """Fit afresh.

        folds : (n,) permanent folds; None: by content.  stop : asked before each step; None: until done.
        Raises SettingError where a setting is out of range, or a head would see one class alone.
        """
        self.check()
        traces = self.check_traces(X, reset=True)
        labels = binary_labels(y, len(traces), type(self).__name__)
        self._start(traces)
        self._fit_heads(traces, labels, content_fold(traces, self.folds) if folds is None else folds, stop)
        return self

    def train(self, X: Floats, y: Ints, folds: Ints, stop: StopRule | None = None) -> Floats:
        """Fit the heads from their present weights, on features that the first training set; see `Reducer.train`."""
        if len(X) < MIN_TRACES:
            raise SettingError(f"Expected at least {MIN_TRACES} traces, got {len(X)}; verify more parts first.")
        g = self._fit_heads(self._begun(X), binary_labels(y, len(X), type(self).__name__), folds, stop)
        with torch.inference_mode():
            return own_places(in_chunks(self.net_.head, g).numpy(), folds)

    def look_ahead(self, X: Floats) -> int:
        """Compute the features of traces that a store brings: in the first retrain it would take too long."""
        if len(X) < MIN_TRACES:
            return 0
        with torch.no_grad():
            return len(self.raw_features(self._begun(X)))

    def _begun(self, X: Floats) -> Floats:
        """The traces, checked, once there are features for them: the first ones that come set these."""
        if "net_" not in vars(self):
            self.check()
            self._start(self.check_traces(X, reset=True))
        return self.check_traces(X)

    def _start(self, traces: Floats) -> None:
        """Learn what stays where it is from now on: the scales of the channels and the filters. No label is read."""
        self._build(*self.trace_shape_)
        self.net_.features.learn(torch.from_numpy(traces), np.random.default_rng(seed_of(self.random_state)))
        self.n_fits_ = 0

    def _fit_heads(self, traces: Floats, labels: Ints, folds: Ints, stop: StopRule | None) -> Tensor:
        """Train head k on rows outside fold k, from the present weights; returns the standardised features (n, P)."""
        folds = np.asarray(folds, dtype=np.int64)
        if folds.shape != labels.shape or folds.min() < 0 or folds.max() >= self.folds:
            raise SettingError(f"Expected {len(labels)} folds from 0 to {self.folds - 1}, got {folds!r}.")
        head, keys = self.net_.head, keys_of(traces)
        with torch.no_grad():
            g, carry = self.net_.features.standardise(self.raw_features(traces, keys))
            head.carry_over(carry)  # a warm start begins where the last fit ended
            rows = torch.arange(len(g))
            if len(g) > self.train_traces:  # a draw that is blind to labels, another at each fit
                rng = np.random.default_rng([seed_of(self.random_state) or 0, self.n_fits_])
                rows = torch.from_numpy(rng.permutation(len(g))[: self.train_traces])
            y, k = torch.from_numpy(labels)[rows], torch.from_numpy(folds)[rows]
            least = 0 if self.n_fits_ else FIRST_STEPS
            self.n_iter_ = head.train_on(g[rows], y, k, self.l2, self.max_iter, stop, least)
            self.net_.fold()
        self._observe(head.losses.numpy(), head.kept.nonzero().flatten().tolist())
        self.n_fits_ += 1
        return g

    def raw_features(self, traces: Floats, keys: Sequence[bytes] | None = None) -> Tensor:
        """(n, C, T) -> (n, P), not standardised, computed once a trace.  keys : `keys_of` the traces, where known."""
        return self.kept_.of(traces, partial(in_chunks, self.net_.features.raw), keys)

    def _observe(self, losses: NDArray[Any], kept: list[int]) -> None:
        self.holdout_losses_ = np.array(losses, dtype=np.float64)
        self.holdout_loss_ = float(self.holdout_losses_.mean())
        heads = ", ".join(str(k) for k in kept)
        self.note_ = f"kept the earlier weights of head {heads}: new ones did worse than the base rate" if kept else ""

    @property
    def report(self) -> FitReport:
        check_is_fitted(self, "net_")
        return FitReport(self.n_iter_, self.holdout_loss_, self.note_)

    def embed(self, X: ArrayLike) -> Floats:
        traces = self.check_traces(X)
        with torch.inference_mode():
            out: Floats = in_chunks(self.net_, torch.from_numpy(traces)).numpy()
        return out

    def module(self) -> nn.Module:
        check_is_fitted(self, "net_")
        return self.net_

    def get_state(self) -> dict[str, NDArray[Any]]:
        check_is_fitted(self, "net_")
        own = {"shape": np.array(self.trace_shape_), "n_fits": np.array(self.n_fits_), "n_steps": np.array(self.n_iter_)}
        own["holdout_losses"] = np.array(self.holdout_losses_)
        return own | {f"net.{name}": value.numpy().copy() for name, value in self.net_.state_dict().items()}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        self.check()
        channels, samples = (int(v) for v in state["shape"])
        self.trace_shape_, self.n_features_in_ = (channels, samples), channels * samples
        self._build(channels, samples)
        self.net_.load_state_dict({name: torch.from_numpy(np.array(value)) for name, value in part(state, "net.").items()})
        self.net_.fold()
        self.n_fits_, self.n_iter_ = int(state["n_fits"]), int(state["n_steps"])
        self._observe(state["holdout_losses"], [])
        return self

    def check(self) -> None:
        """Raise SettingError for a parameter out of its range."""
        for name in ("n_components", "folds", "max_iter"):
            if not isinstance(getattr(self, name), int | np.integer):
                raise SettingError(f"Expected {name} to be an integer, got {getattr(self, name)!r}.")
        for fits, expected, value in (
            (self.n_components in (1, 2), "n_components 1 or 2", self.n_components),
            (self.l2 > 0, "l2 > 0, or separable labels have no solution", self.l2),
            (self.folds >= 2, "folds >= 2 where labels are used", self.folds),
            (self.max_iter >= 1, "max_iter >= 1", self.max_iter),
        ):
            if not fits:
                raise SettingError(f"Expected {expected}, got {value!r}.")

    def _build(self, channels: int, samples: int) -> None:
        features = self.make_features(channels, samples)
        head = CrossFittedScores(features.n_out, self.folds, self.n_components)
        self.net_ = FeatureEmbedding(features, head).eval()
        self.kept_ = KeptFeatures(len(features.gain))  # of other filters nothing must be read again


def in_chunks(f: Any, x: Tensor) -> Tensor:
    """The function over x, `CHUNK` traces at a time."""
    return torch.cat([f(x[i : i + CHUNK]) for i in range(0, max(1, len(x)), CHUNK)])
