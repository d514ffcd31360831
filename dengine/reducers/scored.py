"""What reducers by features share: features that read no label, heads that read all but their own fold's.

A kind gives its features; here they are fitted, warm-started, embedded with, stored and restored.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import check_is_fitted
from torch import Tensor, nn

from ..errors import SettingError
from ..folds import content_fold
from .base import FitReport, Floats, Ints, Reducer, StopRule, binary_labels, own_places, seed_of
from .features import Features, KeptFeatures
from .heads import CrossFittedScores, FeatureEmbedding

MIN_TRACES = 20  # that an engine's first model is trained on
FIRST_STEPS = 3  # of the heads, however late: without any, a first model would hold all parts for alike
CHUNK = 64  # traces embedded at a time: what they need stays in the cache


class FeatureReducer(Reducer):
    """Trace -> point, by features and cross-fitted logistic heads: axis 1 is a probability, its own unit.

    A kind has parameters `n_components` (d, 1 or 2), `folds` (K), `l2`, `max_iter` and `random_state` at least.
    `n_iter_` counts the steps of the last fit. `holdout_loss_` is its held-out log loss: head k's is the leave-one-out
    loss on rows outside fold k (`holdout_losses_` (K,)). `note_` says what the fit has to tell, a head that kept its
    earlier weights for one.
    """

    uses_labels = True
    own_unit = True  # a radius of 0.05 is five in a hundred, never rescaled
    train_traces = 4000  # that train the heads in one fit, so that it ends in time however many references there are
    keeps_features = False  # whether a trace's features stay what they are from one training to the next
    n_components: int
    folds: int
    l2: float
    max_iter: int
    random_state: Any
    net_: FeatureEmbedding
    kept_: KeptFeatures

    @property
    def n_spaces(self) -> int:
        """K."""
        return int(self.folds)

    def make_features(self, channels: int, samples: int) -> Features:
        """The features of traces (C, T)."""
        raise NotImplementedError

    def fit(
        self, X: ArrayLike, y: ArrayLike | None = None, *, folds: Ints | None = None, stop: StopRule | None = None
    ) -> Self:
        """Fit afresh.

        X : (n, T) or (n, C, T).  y : (n,) of two classes, the larger one being the success.
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
        if not self.keeps_features or len(X) < MIN_TRACES:
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
        head = self.net_.head
        with torch.no_grad():
            g, carry = self.net_.features.standardise(self._features_to_train_on(traces))
            head.carry_over(carry)  # a warm start begins where the last fit ended
            rows = torch.from_numpy(self._sample(len(g)))
            y, k = torch.from_numpy(labels)[rows], torch.from_numpy(folds)[rows]
            least = 0 if self.n_fits_ else FIRST_STEPS
            self.n_iter_ = head.train_on(g[rows], y, k, self.l2, self.max_iter, stop, least)
            self.net_.fold()
        self._tell(head.losses.numpy(), head.kept.nonzero().flatten().tolist())
        self.n_fits_ += 1
        return g

    def raw_features(self, traces: Floats) -> Tensor:
        """(n, C, T) -> (n, P), not standardised; where a kind keeps them, computed once a trace."""
        return self.kept_.of(traces, self._computed) if self.keeps_features else self._computed(torch.from_numpy(traces))

    def _features_to_train_on(self, traces: Floats) -> Tensor:
        """`raw_features`; a kind whose features are trained takes over here what they have learned."""
        return self.raw_features(traces)

    def _computed(self, traces: Tensor) -> Tensor:
        return in_chunks(self.net_.features.raw, traces)

    def _sample(self, n: int) -> Ints:
        """Rows that train the heads: all, or of many a draw that is blind to labels and another at each fit."""
        if n <= self.train_traces:
            return np.arange(n)
        return np.random.default_rng([seed_of(self.random_state) or 0, self.n_fits_]).permutation(n)[: self.train_traces]

    def _tell(self, losses: NDArray[Any], kept: list[int]) -> None:
        self.holdout_losses_ = np.array(losses, dtype=np.float64)
        self.holdout_loss_ = float(self.holdout_losses_.mean())
        heads = ", ".join(str(k) for k in kept)
        self.note_ = f"kept the earlier weights of head {heads}: new ones did worse than the base rate" if kept else ""

    @property
    def report(self) -> FitReport:
        """Newton steps, held-out loss, and which heads kept their weights."""
        check_is_fitted(self, "net_")
        return FitReport(self.n_iter_, self.holdout_loss_, self.note_)

    def embed(self, X: ArrayLike) -> Floats:
        """(n, T) or (n, C, T) -> (n, K, d) float32: every trace in every space."""
        traces = self.check_traces(X)
        with torch.inference_mode():
            out: Floats = in_chunks(self.net_, torch.from_numpy(traces)).numpy()
        return out

    def transform(self, X: ArrayLike) -> Floats:
        """(n, T) or (n, C, T) -> (n, d): the mean over the K spaces, for pictures; never counted in.

        Each trace alone, as a cell decides: in a batch its last bits would depend on what is beside it.
        """
        traces = torch.from_numpy(self.check_traces(X))
        alone = (traces[i : i + 1] for i in range(max(1, len(traces))))
        with torch.inference_mode():
            return np.asarray(torch.cat([self.net_(x).mean(1) for x in alone]).numpy())

    def module(self) -> nn.Module:
        """The embedding, (B, C, T) -> (B, K, d), ready to be scripted and frozen."""
        check_is_fitted(self, "net_")
        return self.net_

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Plain arrays: all that answers and goes on training, bit for bit."""
        check_is_fitted(self, "net_")
        own = {"shape": np.array(self.trace_shape_), "n_fits": np.array(self.n_fits_), "n_steps": np.array(self.n_iter_)}
        own["holdout_losses"] = np.array(self.holdout_losses_)
        return own | {f"net.{name}": value.numpy().copy() for name, value in self.net_.state_dict().items()}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        """Become what `get_state` was taken from; the parameters must be the same."""
        self.check()
        channels, samples = (int(v) for v in state["shape"])
        self.trace_shape_, self.n_features_in_ = (channels, samples), channels * samples
        self._build(channels, samples)
        net = {name[4:]: torch.from_numpy(np.array(value)) for name, value in state.items() if name.startswith("net.")}
        self.net_.load_state_dict(net)
        self.net_.fold()
        self.n_fits_, self.n_iter_ = int(state["n_fits"]), int(state["n_steps"])
        self._tell(state["holdout_losses"], [])
        return self

    def check(self) -> None:
        """Raise SettingError for a parameter out of its range."""
        for name in ("n_components", "folds", "max_iter"):
            if not isinstance(getattr(self, name), int | np.integer):
                raise SettingError(f"Expected {name} to be an integer, got {getattr(self, name)!r}.")
        if self.n_components not in (1, 2):
            raise SettingError(f"Expected n_components 1 or 2, got {self.n_components!r}.")
        if self.l2 <= 0:
            raise SettingError(f"Expected l2 > 0, got {self.l2!r}; without a ridge separable labels have no solution.")
        if self.folds < 2:
            raise SettingError(f"Expected folds >= 2 where labels are used, got {self.folds!r}.")
        if self.max_iter < 1:
            raise SettingError(f"Expected max_iter >= 1, got {self.max_iter!r}.")

    def _build(self, channels: int, samples: int) -> None:
        features = self.make_features(channels, samples)
        head = CrossFittedScores(features.n_out, self.folds, self.n_components)
        self.net_ = FeatureEmbedding(features, head).eval()
        self.kept_ = KeptFeatures(len(features.gain))  # of other filters nothing must be read again


def in_chunks(f: Any, x: Tensor) -> Tensor:
    """The function over x, `CHUNK` traces at a time."""
    return torch.cat([f(x[i : i + CHUNK]) for i in range(0, max(1, len(x)), CHUNK)])
