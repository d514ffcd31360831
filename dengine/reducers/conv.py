"""The learned 1-D conv embedding: an encoder that reads no label, and heads that read all but their own fold's.

    >>> reducer = ConvReducer(folds=5).fit(X, y)     # X (n, T) or (n, C, T), y (n,) 1 = success, 0 = failure
    >>> reducer.embed(X).shape                       # (n, K, d): every trace in each of the K spaces

    trace ──► encoder: convolutions, ramps, means over ──► head k ──► axis 1: P(success), from outside fold k
    (C, T)    regions, a linear layer; label-free           (2*W,)  └► axis 2: principal direction

A network trained on labels would exist K times, each on few labels. The encoder is drawn, not trained, and shared by all K
spaces; only the last layer, convex, is cross-fitted.

Cross-fitting: Wolpert (1992), Neural Networks 5; Chernozhukov et al. (2018), Econometrics Journal 21.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray

from ..errors import SettingError
from .base import Floats
from .encoder import ConvEncoder, averaging
from .heads import FeatureReducer


class ConvReducer(FeatureReducer):
    """Trace -> point, by a convolutional encoder and cross-fitted heads.

    n_components : d, 1 or 2; the first axis is the predicted probability of success, the second is there to be seen.
    folds : K. More folds train each head on more of the labels; the time to embed hardly grows.
    kernels, dilations, regions, width : sizes of the encoder; see encoder.py.
    l2 : ridge of the heads, in units of one label each.
    max_iter : Newton steps of the heads in one fit, at most.
    random_state : of all that is drawn; None draws anew at each fit.
    """

    train_traces = 2000  # the encoder's features are more than another's

    def __init__(
        self,
        *,
        n_components: int = 2,
        folds: int = 5,
        kernels: int = 28,
        dilations: int = 5,
        regions: int = 3,
        width: int = 64,
        l2: float = 1.0,
        max_iter: int = 12,
        random_state: Any = 0,
    ) -> None:
        self.n_components = n_components
        self.folds = folds
        self.kernels = kernels
        self.dilations = dilations
        self.regions = regions
        self.width = width
        self.l2 = l2
        self.max_iter = max_iter
        self.random_state = random_state

    def make_features(self, channels: int, samples: int) -> ConvEncoder:
        sizes = (self.kernels, self.dilations, self.regions, self.width)
        return ConvEncoder(channels, samples, self.average_, *sizes)

    def _start(self, traces: Floats) -> None:
        self.average_ = averaging(torch.from_numpy(traces))
        super()._start(traces)

    def get_state(self) -> dict[str, NDArray[Any]]:
        return super().get_state() | {"average": np.array(self.average_)}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        self.average_ = int(state["average"])
        return super().set_state(state)

    def check(self) -> None:
        """Raise SettingError for a parameter out of its range."""
        super().check()
        for name in ("kernels", "dilations", "width", "regions"):
            value = getattr(self, name)
            if not isinstance(value, int | np.integer) or value < 1:
                raise SettingError(f"Expected {name} >= 1, an integer, got {value!r}.")
        if self.regions > 16:
            raise SettingError(f"Expected regions <= 16, got {self.regions!r}.")
