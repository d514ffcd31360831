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

from typing import cast

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ..errors import SettingError
from .feature_reducer import FeatureReducer, Floats, Ints
from .features import ConvFeatures, Features
from .heads import Head, NeighbourPlane, Stop

OBJECTIVES = ("supervised", "label_free")


class ConvReducer(FeatureReducer):
    """Trace -> point, by convolutional features and cross-fitted heads.

    dim : d, 1 or 2; the first axis is the predicted probability of success, the second is there to be seen.
    folds : K. More folds train each head on more of the labels; the time to embed hardly grows.
    objective : "supervised" (K spaces), or "label_free" (one space, no label read).
    segments, filters, regions : sizes of the features; see features.py.
    l2 : ridge of the heads, in units of one label each.
    neighbours, batch, hidden : of the label-free plane alone.
    seed : of the patches drawn, and of the plane's training.
    """

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
    def natural_scale(self) -> bool:
        """Whether labels give axis 1 a unit, probability; the label-free plane has none."""
        return self.objective == "supervised"

    @property
    def n_spaces(self) -> int:
        """K; 1 where no label is read."""
        return int(self.folds) if self.objective == "supervised" else 1

    def make_features(self, channels: int, samples: int) -> Features:
        """Segment statistics and learned filters."""
        return ConvFeatures(channels, samples, self.segments, self.filters, self.regions)

    def make_head(self, n_features: int) -> Head:
        """Cross-fitted scores, or a plane that keeps neighbours."""
        if self.objective == "supervised":
            return super().make_head(n_features)
        return NeighbourPlane(n_features, self.hidden, self.dim)

    def fit_head(self, g: Tensor, traces: Floats, y: ArrayLike | None, folds: Ints | None, stop: Stop | None) -> None:
        """Train the heads, or the plane, from the present weights."""
        if self.objective == "supervised":
            super().fit_head(g, traces, y, folds, stop)
            return
        plane = cast(NeighbourPlane, self.net_.head)
        # Other edges at each fit, and the same ones again under the same seed.
        generator = torch.Generator().manual_seed(self.seed + 1_000_003 * self.n_fits_)
        if self.n_fits_ == 0:
            plane.start(g, generator)
        self.n_steps_, loss = plane.train_on(g, self.neighbours, self.batch, generator, stop)
        self._tell(torch.tensor([loss]).numpy(), [])

    def check(self) -> None:
        """Raise SettingError for a parameter out of its range."""
        if self.objective not in OBJECTIVES:
            raise SettingError(f"Expected an objective among {', '.join(OBJECTIVES)}, got {self.objective!r}.")
        super().check()
        for name in ("segments", "filters", "regions", "neighbours", "batch", "hidden"):
            if getattr(self, name) < 1:
                raise SettingError(f"Expected {name} >= 1, got {getattr(self, name)!r}.")
