"""What reducers by features share: features that read no label, heads that read all but their own.

A kind gives its features and its heads; here they are fitted, warm-started, embedded with, stored and restored.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self, cast

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.utils.validation import check_is_fitted
from torch import Tensor, nn

from ..errors import SettingError, TraceError
from .base import content_fold
from .features import Features
from .heads import CrossFittedScores, Head, Stop

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
MIN_TRACES = 20
TRAIN_TRACES = 4000  # that train the heads in one fit, so that it ends in time however many references there are
CHUNK = 64  # traces embedded at a time: what they need stays in the cache


class FeatureEmbedding(nn.Module):
    """(B, C, T) raw traces -> (B, K, d): what answers in the engine, and what export saves."""

    def __init__(self, features: Features, head: nn.Module) -> None:
        super().__init__()
        self.features = features
        self.head = head

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T) float32 -> (B, K, d) float32."""
        out: Tensor = self.head(self.features(x))
        return out


class FeatureReducer(TransformerMixin, BaseEstimator):  # type: ignore[misc]  # scikit-learn ships no types
    """Trace -> point, by features and heads; a kind has parameters `dim`, `folds`, `l2` and `seed` at least.

    `n_steps_` counts the steps of the last fit. `holdout_loss_` is its held-out log loss: head k's is the leave-one-out
    loss on rows outside fold k (`holdout_losses_` (K,)). `note_` says what the fit has to tell, a head that kept its
    earlier weights for one.
    """

    takes_traces = True
    single_tolerance = 1e-4
    dim: int
    folds: int
    l2: float
    seed: int
    net_: FeatureEmbedding
    _fitted_features: Tensor | None

    @property
    def n_spaces(self) -> int:
        """K."""
        return int(self.folds)

    @property
    def natural_scale(self) -> bool:
        """Whether axis 1 has a unit of its own, probability: a radius of 0.05 is five in a hundred, never rescaled."""
        return True

    def make_features(self, channels: int, samples: int) -> Features:
        """The features of traces (C, T)."""
        raise NotImplementedError

    def make_head(self, n_features: int) -> Head:
        """What turns features (B, P) into points (B, K, d)."""
        return CrossFittedScores(n_features, self.folds, self.dim)

    def fit(self, X: ArrayLike, y: ArrayLike | None = None, *, folds: Ints | None = None, stop: Stop | None = None) -> Self:
        """Fit, or go on from the weights of an earlier fit.

        X : (n, T) or (n, C, T).  y : (n,) 1 = success, 0 = failure.  folds : (n,) permanent folds; None: by content.
        stop : asked before each step; None: until done.
        Raises SettingError where a setting is out of range, or a head would see one class alone.
        """
        self.check()
        traces = _traces(X)
        if len(traces) < MIN_TRACES:
            raise SettingError(f"Expected at least {MIN_TRACES} traces, got {len(traces)}; verify more parts first.")
        if not hasattr(self, "net_"):
            self._build(traces.shape[1], traces.shape[2])
            self.net_.features.learn(torch.from_numpy(traces), np.random.default_rng(self.seed))
            self.n_fits_ = 0
        self._match(traces)
        with torch.no_grad():
            g, ratio, shift = self.net_.features.standardise(self.raw_features(traces))
            cast(Head, self.net_.head).carry_over(ratio, shift)  # a warm start begins where the last fit ended
        self._fitted_features = g  # spares `embed_fitted` the pass over the traces
        self.fit_head(g, traces, y, folds, stop)
        self.n_fits_ += 1
        return self

    def raw_features(self, traces: Floats) -> Tensor:
        """(n, C, T) -> (n, P), not standardised."""
        return in_chunks(self.net_.features.raw, torch.from_numpy(traces))

    def fit_head(self, g: Tensor, traces: Floats, y: ArrayLike | None, folds: Ints | None, stop: Stop | None) -> None:
        """Train head k on rows outside fold k, from the present weights."""
        labels = _labels(y, len(g))
        folds = content_fold(traces, self.folds) if folds is None else np.asarray(folds, dtype=np.int64)
        if folds.shape != labels.shape or folds.min() < 0 or folds.max() >= self.folds:
            raise SettingError(f"Expected {len(labels)} folds from 0 to {self.folds - 1}, got {folds!r}.")
        head = cast(CrossFittedScores, self.net_.head)
        rows = torch.from_numpy(self._sample(len(g)))
        with torch.no_grad():
            y_, folds_ = torch.from_numpy(labels)[rows], torch.from_numpy(folds)[rows]
            self.n_steps_ = head.train_on(g[rows], y_, folds_, self.l2, stop)
        self._tell(head.losses.numpy(), head.kept.nonzero().flatten().tolist())

    def _sample(self, n: int) -> Ints:
        """Rows that train the heads: all, or of many a draw that is blind to labels and another at each fit."""
        if n <= TRAIN_TRACES:
            return np.arange(n)
        return np.random.default_rng([self.seed, self.n_fits_]).permutation(n)[:TRAIN_TRACES]

    def _tell(self, losses: NDArray[Any], kept: list[int]) -> None:
        self.holdout_losses_ = np.array(losses, dtype=np.float64)
        self.holdout_loss_ = float(self.holdout_losses_.mean())
        heads = ", ".join(str(k) for k in kept)
        self.note_ = f"kept the earlier weights of head {heads}: new ones did worse than the base rate" if kept else ""

    def embed(self, X: ArrayLike) -> Floats:
        """(n, K, d) float32: every trace in every space."""
        check_is_fitted(self, "net_")
        traces = _traces(X)
        self._match(traces)
        with torch.inference_mode():
            out: Floats = in_chunks(self.net_, torch.from_numpy(traces)).numpy()
        return out

    def embed_own(self, X: ArrayLike, folds: Ints) -> Floats:
        """(n, d) float32: row i in space folds[i]. The features are most of the work and shared, so all K are computed."""
        return self._own(self.embed(X), folds)

    def embed_fitted(self, X: ArrayLike, folds: Ints) -> Floats:
        """(n, d) float32: `embed_own` of the very traces of the last fit, from the features that it computed."""
        check_is_fitted(self, "net_")
        g, self._fitted_features = self._fitted_features, None
        if g is None or len(g) != len(np.asarray(X)):
            return self.embed_own(X, folds)
        with torch.inference_mode():
            return self._own(in_chunks(self.net_.head, g).numpy(), folds)

    def transform(self, X: ArrayLike) -> Floats:
        """(n, d): the mean over the K spaces, for pictures; never counted in."""
        return np.asarray(self.embed(X).mean(axis=1))

    def module(self) -> nn.Module:
        """The embedding, (B, C, T) -> (B, K, d), ready to be scripted and frozen."""
        check_is_fitted(self, "net_")
        return self.net_

    def get_state(self) -> dict[str, NDArray[Any]]:
        """Plain arrays: all that answers and goes on training, bit for bit."""
        check_is_fitted(self, "net_")
        own = {"shape": np.array(self.shape_), "n_fits": np.array(self.n_fits_), "n_steps": np.array(self.n_steps_)}
        own["holdout_losses"] = np.array(self.holdout_losses_)
        return own | {f"net.{name}": value.numpy().copy() for name, value in self.net_.state_dict().items()}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        """Become what `get_state` was taken from; the parameters must be the same."""
        self.check()
        channels, samples = (int(v) for v in state["shape"])
        self._build(channels, samples)
        net = {name[4:]: torch.from_numpy(np.array(value)) for name, value in state.items() if name.startswith("net.")}
        self.net_.load_state_dict(net)
        self.n_fits_, self.n_steps_ = int(state["n_fits"]), int(state["n_steps"])
        self._tell(state["holdout_losses"], [])
        return self

    def check(self) -> None:
        """Raise SettingError for a parameter out of its range."""
        if self.dim not in (1, 2):
            raise SettingError(f"Expected dim 1 or 2, got {self.dim!r}.")
        if self.n_spaces > 1 and self.l2 <= 0:
            raise SettingError(f"Expected l2 > 0, got {self.l2!r}; without a ridge separable labels have no solution.")
        if self.natural_scale and self.folds < 2:
            raise SettingError(f"Expected folds >= 2 where labels are used, got {self.folds!r}.")

    def _own(self, Z: Floats, folds: Ints) -> Floats:
        """(n, K, d) -> (n, d), row i of space folds[i]."""
        own = np.asarray(folds) if self.n_spaces > 1 else np.zeros(len(Z), dtype=np.int64)
        return np.ascontiguousarray(Z[np.arange(len(Z)), own])

    def _build(self, channels: int, samples: int) -> None:
        features = self.make_features(channels, samples)
        self.shape_ = (channels, samples)
        self._fitted_features = None
        self.net_ = FeatureEmbedding(features, self.make_head(len(features.gain))).eval()

    def _match(self, traces: Floats) -> None:
        if traces.shape[1:] != self.shape_:
            channels, samples = self.shape_
            raise TraceError(
                f"Expected traces of {channels} channels x {samples} samples, got {traces.shape[1]} x {traces.shape[2]}; "
                "resample, or fit a fresh clone."
            )

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.target_tags.required = self.natural_scale
        return tags


def in_chunks(f: Any, x: Tensor) -> Tensor:
    """The function over x, `CHUNK` traces at a time."""
    return torch.cat([f(x[i : i + CHUNK]) for i in range(0, max(1, len(x)), CHUNK)])


def _traces(X: ArrayLike) -> Floats:
    """(n, C, T) float32, contiguous, from (n, T) or (n, C, T)."""
    traces = np.ascontiguousarray(X, dtype=np.float32)
    traces = traces[:, None, :] if traces.ndim == 2 else traces
    if traces.ndim != 3:
        raise TraceError(f"Expected traces (n, T) or (n, C, T), got {np.shape(X)}.")
    return traces


def _labels(y: ArrayLike | None, n: int) -> Ints:
    if y is None:
        raise SettingError('The supervised objective uses labels: expected y, got None; or choose objective="label_free".')
    labels = np.asarray(y)
    if labels.shape != (n,) or not np.isin(labels, (0, 1)).all():
        raise SettingError(f"Expected {n} labels, 1 = success or 0 = failure, got shape {labels.shape}.")
    return labels.astype(np.int64)
