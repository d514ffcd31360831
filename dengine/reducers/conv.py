"""The learned 1-D conv embedding: convolutional features that read no label, and heads that read all but their own.

    >>> reducer = ConvReducer(folds=5, seed=0).fit(X, y)      # X (n, T) or (n, C, T), y (n,) 1 = success, 0 = failure
    >>> reducer.embed(X).shape                                # (n, K, d): every trace in each of the K spaces

    trace ──► statistics of 10 segments ─────────────────┐
    (C, T)    mean, deviation, minimum, maximum          ├─► standardise ─► head k ─► axis 1: P(success)
          └─► conv, 4 filters ─► ReLU ─► mean, 3 regions ┘      (P,)               └► axis 2: principal direction

Why so. A label counts only in a space that never saw it (honest counting), so a network trained on labels exists K
times, each on fewer of the few labels there are. Features learned without labels are shared by all K spaces, honest by
construction, and cost one pass; only the last layer is cross-fitted. That layer is convex: Newton's method ends it in a
few steps at one place, so a retrain does not shuffle the plane, and a warm start changes the time it takes, not the map.
Training the filters on the labels too, by SGD, was measured and gained nothing on two data sets.

`objective="supervised"` is the above. `objective="label_free"` never reads a label: one space, a plane trained by
UMAP's loss on the same features. Sources: features.py and heads.py; stacking's cross-fitting: Wolpert (1992), Neural
Networks 5; Chernozhukov et al. (2018), Econometrics Journal 21.
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
from .features import TraceFeatures
from .heads import CrossFittedScores, NeighbourPlane, Stop

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
MIN_TRACES = 20
CHUNK = 64  # traces embedded at a time: what they need stays in the cache


class ConvEmbedding(nn.Module):
    """(B, C, T) raw traces -> (B, K, d): what answers in the engine, and what export saves."""

    def __init__(self, features: TraceFeatures, head: nn.Module) -> None:
        super().__init__()
        self.features = features
        self.head = head

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T) float32 -> (B, K, d) float32."""
        out: Tensor = self.head(self.features(x))
        return out


class ConvReducer(TransformerMixin, BaseEstimator):  # type: ignore[misc]  # scikit-learn ships no types
    """Trace -> point, by convolutional features and cross-fitted heads.

    dim : d, 1 or 2; the first axis is the predicted probability of success, the second is there to be seen.
    folds : K. More folds train each head on more of the labels; the time to embed hardly grows.
    objective : "supervised" (K spaces), or "label_free" (one space, no label read).
    segments, filters, regions : sizes of the features; see features.py.
    l2 : ridge of the heads, in units of one label each.
    neighbours, batch, hidden : of the label-free plane alone.
    seed : of the patches drawn, and of the plane's training.

    `n_steps_` counts the steps of the last fit. `holdout_loss_` is its held-out log loss: head k's is the leave-one-out
    loss on rows outside fold k (`holdout_losses_` (K,)), so that a gate that reads it sees no label of fold k.
    """

    net_: ConvEmbedding
    _fitted_features: Tensor | None

    takes_traces = True
    single_tolerance = 1e-4

    def __init__(
        self,
        *,
        dim: int = 2,
        folds: int = 5,
        objective: str = "supervised",
        segments: int = 10,
        filters: int = 4,
        regions: int = 3,
        l2: float = 1.0,
        neighbours: int = 15,
        batch: int = 256,
        hidden: int = 32,
        seed: int = 0,
    ) -> None:
        self.dim = dim
        self.folds = folds
        self.objective = objective
        self.segments = segments
        self.filters = filters
        self.regions = regions
        self.l2 = l2
        self.neighbours = neighbours
        self.batch = batch
        self.hidden = hidden
        self.seed = seed

    @property
    def n_spaces(self) -> int:
        """K; 1 where no label is read."""
        return int(self.folds) if self.objective == "supervised" else 1

    @property
    def natural_scale(self) -> bool:
        """Whether axis 1 has a unit of its own, probability: a radius of 0.05 is five in a hundred, never rescaled."""
        return self.objective == "supervised"

    def fit(self, X: ArrayLike, y: ArrayLike | None = None, *, folds: Ints | None = None, stop: Stop | None = None) -> Self:
        """Fit, or go on from the weights of an earlier fit.

        X : (n, T) or (n, C, T).  y : (n,) 1 = success, 0 = failure.  folds : (n,) permanent folds; None: by content.
        stop : asked before each step; None: until done.
        Raises SettingError where a setting is out of range, or a head would see one class alone.
        """
        self._check()
        traces = _traces(X)
        if len(traces) < MIN_TRACES:
            raise SettingError(f"Expected at least {MIN_TRACES} traces, got {len(traces)}; verify more parts first.")
        x = torch.from_numpy(traces)
        fresh = not hasattr(self, "net_")
        if fresh:
            self._build(traces.shape[1], traces.shape[2])
            self.net_.features.learn(x, np.random.default_rng(self.seed))
            self.n_fits_ = 0
        self._match(traces)
        with torch.no_grad():
            g = self.net_.features.standardise(_in_chunks(self.net_.features.raw, x))
        self._fitted_features = g  # spares `embed_fitted` the pass over the traces
        OBJECTIVES[self.objective](self, g, traces, y, folds, stop)
        self.n_fits_ += 1
        return self

    def _fit_scores(self, g: Tensor, traces: Floats, y: ArrayLike | None, folds: Ints | None, stop: Stop | None) -> None:
        labels = _labels(y, len(g))
        folds = content_fold(traces, self.folds) if folds is None else np.asarray(folds, dtype=np.int64)
        if folds.shape != labels.shape or folds.min() < 0 or folds.max() >= self.folds:
            raise SettingError(f"Expected {len(labels)} folds from 0 to {self.folds - 1}, got {folds!r}.")
        head = cast(CrossFittedScores, self.net_.head)
        with torch.no_grad():
            self.n_steps_, self.holdout_losses_ = head.train_on(
                g, torch.from_numpy(labels), torch.from_numpy(folds), self.l2, stop
            )
        self.holdout_loss_ = float(self.holdout_losses_.mean())

    def _fit_plane(self, g: Tensor, traces: Floats, y: ArrayLike | None, folds: Ints | None, stop: Stop | None) -> None:
        plane = cast(NeighbourPlane, self.net_.head)
        generator = torch.Generator().manual_seed(
            self.seed + 1_000_003 * self.n_fits_
        )  # other edges each time, the same again
        if self.n_fits_ == 0:
            plane.start(g, generator)
        self.n_steps_, self.holdout_loss_ = plane.train_on(g, self.neighbours, self.batch, generator, stop)
        self.holdout_losses_ = np.array([self.holdout_loss_])

    def embed(self, X: ArrayLike) -> Floats:
        """(n, K, d) float32: every trace in every space."""
        check_is_fitted(self, "net_")
        traces = _traces(X)
        self._match(traces)
        with torch.inference_mode():
            out: Floats = _in_chunks(self.net_, torch.from_numpy(traces)).numpy()
        return out

    def embed_own(self, X: ArrayLike, folds: Ints) -> Floats:
        """(n, d) float32: row i in space folds[i]. The features are most of the work and shared, so all K are computed."""
        return self._own(self.embed(X), folds)

    def embed_fitted(self, X: ArrayLike, folds: Ints) -> Floats:
        """(n, d) float32: `embed_own` of the very traces of the last fit, from the features that it computed."""
        check_is_fitted(self, "net_")
        g = self._fitted_features
        if g is None or len(g) != len(np.asarray(X)):
            return self.embed_own(X, folds)
        with torch.inference_mode():
            return self._own(_in_chunks(self.net_.head, g).numpy(), folds)

    def _own(self, Z: Floats, folds: Ints) -> Floats:
        """(n, K, d) -> (n, d), row i of space folds[i]."""
        own = np.asarray(folds) if self.n_spaces > 1 else np.zeros(len(Z), dtype=np.int64)
        return np.ascontiguousarray(Z[np.arange(len(Z)), own])

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
        self._check()
        channels, samples = (int(v) for v in state["shape"])
        self._build(channels, samples)
        net = {name[4:]: torch.from_numpy(np.array(value)) for name, value in state.items() if name.startswith("net.")}
        self.net_.load_state_dict(net)
        self.n_fits_, self.n_steps_ = int(state["n_fits"]), int(state["n_steps"])
        self.holdout_losses_ = np.array(state["holdout_losses"])
        self.holdout_loss_ = float(self.holdout_losses_.mean())
        return self

    def _build(self, channels: int, samples: int) -> None:
        features = TraceFeatures(channels, samples, self.segments, self.filters, self.regions)
        size = len(features.gain)
        head = (
            CrossFittedScores(size, self.folds, self.dim)
            if self.objective == "supervised"
            else NeighbourPlane(size, self.hidden, self.dim)
        )
        self.shape_ = (channels, samples)
        self._fitted_features = None
        self.net_ = ConvEmbedding(features, head).eval()

    def _check(self) -> None:
        if self.objective not in OBJECTIVES:
            raise SettingError(f"Expected an objective among {', '.join(OBJECTIVES)}, got {self.objective!r}.")
        if self.dim not in (1, 2):
            raise SettingError(f"Expected dim 1 or 2, got {self.dim!r}.")
        if self.objective == "supervised" and self.folds < 2:
            raise SettingError(f"Expected folds >= 2 where labels are used, got {self.folds!r}.")
        if self.l2 <= 0:
            raise SettingError(f"Expected l2 > 0, got {self.l2!r}; without a ridge separable labels have no solution.")
        sizes = {name: getattr(self, name) for name in ("segments", "filters", "regions", "neighbours", "batch", "hidden")}
        for name, value in sizes.items():
            if value < 1:
                raise SettingError(f"Expected {name} >= 1, got {value!r}.")

    def _match(self, traces: Floats) -> None:
        if traces.shape[1:] != self.shape_:
            channels, samples = self.shape_
            raise TraceError(
                f"Expected traces of {channels} channels x {samples} samples, got {traces.shape[1]} x {traces.shape[2]}; "
                "resample, or fit a fresh clone."
            )

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.target_tags.required = self.objective == "supervised"
        return tags


OBJECTIVES = {"supervised": ConvReducer._fit_scores, "label_free": ConvReducer._fit_plane}


def _traces(X: ArrayLike) -> Floats:
    """(n, C, T) float32, contiguous and finite, from (n, T) or (n, C, T)."""
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


def _in_chunks(f: Any, x: Tensor) -> Tensor:
    """The function over x, `CHUNK` traces at a time."""
    return torch.cat([f(x[i : i + CHUNK]) for i in range(0, max(1, len(x)), CHUNK)])
