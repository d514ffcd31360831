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

Sources: features.py and logistic.py; stacking's cross-fitting: Wolpert (1992), Neural Networks 5; Chernozhukov et al.
(2018), Econometrics Journal 21.
"""

from __future__ import annotations

from typing import Any

from ..errors import SettingError
from .features import ConvFeatures, Features
from .scored import FeatureReducer


class ConvReducer(FeatureReducer):
    """Trace -> point, by convolutional features and cross-fitted heads.

    n_components : d, 1 or 2; the first axis is the predicted probability of success, the second is there to be seen.
    folds : K. More folds train each head on more of the labels; the time to embed hardly grows.
    segments, filters, regions : sizes of the features, fewer on traces too short for them; see features.py.
    l2 : ridge of the heads, in units of one label each.
    max_iter : Newton steps of the heads in one fit, at most.
    random_state : of the patches drawn; None draws others at each fit.
    """

    def __init__(
        self,
        *,
        n_components: int = 2,
        folds: int = 5,
        segments: int = 10,
        filters: int = 4,
        regions: int = 3,
        l2: float = 1.0,
        max_iter: int = 12,
        random_state: Any = 0,
    ) -> None:
        self.n_components = n_components
        self.folds = folds
        self.segments = segments
        self.filters = filters
        self.regions = regions
        self.l2 = l2
        self.max_iter = max_iter
        self.random_state = random_state

    def make_features(self, channels: int, samples: int) -> Features:
        """Segment statistics and learned filters."""
        return ConvFeatures(channels, samples, self.segments, self.filters, self.regions)

    def check(self) -> None:
        """Raise SettingError for a parameter out of its range."""
        super().check()
        for name in ("segments", "filters", "regions"):
            if getattr(self, name) < 1:
                raise SettingError(f"Expected {name} >= 1, got {getattr(self, name)!r}.")
