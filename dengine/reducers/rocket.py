"""MiniRocket's idea as a reducer: fixed convolution kernels, the share of positive values, cross-fitted heads.

    x (B, C, T) -> 84 kernels of length 9, each at D dilations -> share of outputs over a bias     (B, 84*D)
                -> standardise -> head k: P(success), from outside fold k                           (B, K, d)

No kernel is learned; a bias is a quantile of what its kernel gives on the first traces, labels unread. So features are
computed once a trace, and a retrain is the heads' convex fit. The strongest cheap rival.
Source: Dempster, Schmidt and Webb (2021), MiniRocket, KDD; arXiv:2012.08791. Here with one bias a kernel and dilation.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812  # torch's own name for it

from .features import FeatureReducer, Features, dilations_of, rocket_kernels


class RocketFeatures(Features):
    """(B, C, T) raw traces -> (B, 84*D) standardised shares of positive values."""

    kernel: Tensor
    bias: Tensor

    def __init__(self, channels: int, samples: int, dilations: int) -> None:
        kernels, spread = rocket_kernels(), dilations_of(samples, dilations)
        super().__init__(channels, samples, len(kernels) * len(spread))
        self.dilations = spread
        self.register_buffer("kernel", kernels[:, None, :].repeat(1, channels, 1))  # (84, C, 9)
        self.register_buffer("bias", torch.zeros(len(spread), len(kernels), 1))

    def raw(self, x: Tensor) -> Tensor:
        """(B, C, T) -> (B, 84*D), not standardised."""
        x = torch.addcmul(self.shift, x, self.scale)
        shares: list[Tensor] = []
        for i, dilation in enumerate(self.dilations):
            shares.append((self.convolve(x, dilation) > self.bias[i]).to(torch.float32).mean(2))
        return torch.cat(shares, 1)

    def convolve(self, x: Tensor, dilation: int) -> Tensor:
        """(B, C, T) -> (B, 84, T), zeros beyond the ends."""
        return F.conv1d(x, self.kernel, dilation=dilation, padding=4 * dilation)

    def learn_filters(self, x: Tensor, rng: np.random.Generator) -> None:
        """Set each bias to a quantile of the kernel's output on one trace drawn at random; low-discrepancy quantiles."""
        golden = (np.sqrt(5.0) + 1.0) / 2.0
        rows = torch.arange(self.kernel.size(0))
        for i, dilation in enumerate(self.dilations):
            drawn = torch.from_numpy(rng.integers(len(x), size=len(rows)))
            own = self.convolve(x[drawn], dilation)[rows, rows]  # (84, T): drawn trace j through kernel j
            places = (np.arange(1, len(rows) + 1) + i * len(rows)) * golden % 1.0
            order = torch.from_numpy((places * (own.size(1) - 1)).astype(np.int64))
            self.bias[i] = own.sort(1).values.gather(1, order[:, None])


@dataclass(eq=False, repr=False, kw_only=True)
class RocketReducer(FeatureReducer):
    """Trace -> point, by MiniRocket's features and cross-fitted logistic heads.

    dilations : D, kernels' spreads between 1 and the length of the trace.
    n_components, folds, l2, max_iter, random_state : as in `ConvReducer`.
    """

    dilations: int = 3

    def make_features(self, channels: int, samples: int) -> Features:
        return RocketFeatures(channels, samples, self.dilations)
