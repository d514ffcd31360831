"""The 1-D conv embedding: an encoder that reads no label, and heads that read all but their own fold's.

    >>> reducer = ConvReducer(folds=5).fit(X, y)     # X (n, T) or (n, C, T), y (n,) 1 = success, 0 = failure
    >>> reducer.embed(X).shape                       # (n, K, d): every trace in each of the K spaces

    x (B, C, T) -> means of a few samples each, one scale a channel                              (B, C, L)
      -> conv, F kernels of 9 taps at each of D dilations, at P places                           (B, D, P, F)
      -> a ramp from 0 to 1 around a threshold, its mean over R regions, plus twice that over all (B, D*R*F)
      -> principal components and heads; see features.py                                         (B, K, d)

A network trained on labels would exist K times, each on few labels. The encoder is drawn, not trained, and shared by all K
spaces. As in MiniRocket the kernels have fixed weights, and thresholds are drawn from what they give on the first traces.
Instead of a hard share of positive values it counts by a ramp two deviations wide, which measured better
(docs/explanation/measured.md).

Sources: Dempster, Schmidt and Webb (2021), MiniRocket, KDD, arXiv:2012.08791, for kernels, dilations and thresholds; Tan,
Dempster, Bergmeir and Webb (2022), MultiRocket, Data Min. Knowl. Disc. 36, for several channels. Cross-fitting: Wolpert
(1992), Neural Networks 5; Chernozhukov et al. (2018), Econometrics Journal 21.
"""

from collections.abc import Mapping
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ..errors import expect
from .base import Floats
from .features import LEARNED, TAPS, FeatureReducer, Features, dilations_of, rocket_kernels

WHOLE = 2.0  # weight of the mean over the whole trace beside that over a region: where it does not matter when


class ConvEncoder(Features):
    """(B, C, T) raw traces -> (B, D*R*F) features.

    channels, samples : C and T.  average : samples of one mean, `averaging`.  kernels, dilations, regions : F, D and R,
    fewer dilations on short traces.
    """

    taps: Tensor
    pool: Tensor
    kernel: Tensor
    threshold: Tensor
    nothing: Tensor

    def __init__(self, channels: int, samples: int, average: int, kernels: int, dilations: int, regions: int) -> None:
        frames = samples // average
        places = max(1, min(frames, 600) // regions) * regions  # on traces that oscillate fewer say less
        taps = _taps(frames, dilations, places)
        super().__init__(channels, samples, len(taps) * regions * kernels)
        self.average, self.head = average, samples % average  # left out at the start: the end of an insertion tells most
        self.n_dilations, self.n_regions, self.n_kernels, self.n_places = len(taps), regions, kernels, places
        pool = torch.eye(regions).repeat_interleave(places // regions, 1) * (regions / places)
        self.register_buffer("taps", torch.from_numpy(taps.ravel()))
        self.whole = WHOLE / places
        # One a dilation, side by side: a product of 8 us, where spreading one takes 11.
        self.register_buffer("pool", (pool + self.whole).repeat(len(taps), 1, 1), persistent=False)
        self.register_buffer("kernel", torch.zeros(len(taps), channels * TAPS, kernels))
        self.register_buffer("threshold", torch.zeros(len(taps), 1, kernels))
        self.register_buffer("nothing", torch.zeros(1))

    def raw(self, x: Tensor) -> Tensor:
        """(B, C, T) -> (B, D*R*F): how far each kernel is above its threshold, in the mean over each region."""
        a = self.averaged(x)
        if x.size(0) == 1:  # one trace at a time, as a cell decides: nothing to put in order
            h = torch.baddbmm(self.threshold, self.windows_of_one(a), self.kernel).clamp_(0.0, 1.0)  # (D, P, F)
            return torch.bmm(self.pool, h).view(1, -1)
        h = torch.baddbmm(self.threshold.transpose(1, 2), self.kernel.transpose(1, 2), self.windows(a)).clamp_(0.0, 1.0)
        length = self.n_places // self.n_regions  # said: no traces have no size to guess it from
        h = h.view(self.n_dilations, self.n_kernels, self.n_regions, length, x.size(0)).sum(3)  # (D, F, R, B)
        h = h / length + self.whole * h.sum(2, keepdim=True)  # as `pool` has it
        return h.permute(3, 0, 2, 1).reshape(x.size(0), self.n_dilations * self.n_regions * self.n_kernels)

    def averaged(self, x: Tensor) -> Tensor:
        """(B, C, T) raw -> (B, C, L), one scale a channel."""
        if self.average > 1:
            x = x[..., self.head :] if self.head > 0 else x
            x = nn.functional.avg_pool2d(x, [1, self.average])  # half the time of a mean over an axis
        return torch.addcmul(self.shift, x, self.scale)

    def windows_of_one(self, a: Tensor) -> Tensor:
        """(1, C, L) -> (D, P, C*9): what each place of each dilation sees, so that a convolution is a product."""
        if a.size(1) == 1:  # 40 us less
            row = torch.cat([a.view(-1), self.nothing])  # taps beyond the ends read zeros
            return row.index_select(0, self.taps).view(self.n_dilations, self.n_places, 9)
        return self.windows(a).transpose(1, 2)

    def windows(self, a: Tensor) -> Tensor:
        """(B, C, L) -> (D, C*9, P*B): the same of many, traces last: a tap then moves a row of them at once."""
        rows = nn.functional.pad(a.permute(1, 2, 0), [0, 0, 0, 1])  # (C, L+1, B)
        taps = self.taps.view(self.n_dilations, self.n_places, 9).transpose(1, 2).reshape(-1)
        seen = rows.index_select(1, taps).view(a.size(1), self.n_dilations, 9, -1)
        return seen.transpose(0, 1).reshape(self.n_dilations, a.size(1) * 9, self.n_places * a.size(0))

    def learn_filters(self, x: Tensor, rng: np.random.Generator) -> None:
        """Draw kernels, and thresholds from what they give on traces (n, C, T), their channels scaled."""
        # `x` is scaled already; averaging is linear, so the scale is taken out again.
        seen = self.windows(self.averaged((x - self.shift) / self.scale))  # (D, C*9, P*n)
        kernels = _kernels(x.size(1), self.n_kernels, rng)
        # Low-discrepancy quantiles, as in MiniRocket; none at the very ends.
        n = self.n_dilations * self.n_kernels
        quantiles = 0.05 + 0.9 * (np.arange(1, n + 1) * (np.sqrt(5.0) + 1.0) / 2.0 % 1.0)
        for d, rows in enumerate(seen):
            given = (kernels.T @ rows).numpy()  # (F, P*n)
            own = quantiles[d * self.n_kernels : (d + 1) * self.n_kernels]
            places = (own * (given.shape[1] - 1)).astype(np.int64)
            chosen = [np.partition(each, place)[place] for each, place in zip(given, places, strict=True)]
            slope = 1.0 / (2.0 * torch.from_numpy(given.std(1)) + 1e-6)  # a ramp two deviations wide
            self.kernel[d] = kernels * slope
            self.threshold[d, 0] = 0.5 - torch.tensor(chosen) * slope


class ConvReducer(FeatureReducer):
    """Trace -> point, by a convolutional encoder and cross-fitted heads.

    n_components : d, 1 or 2; the first axis is the predicted probability of success, the second is there to be seen.
    folds : K. More folds train each head on more of the labels; the time to embed hardly grows.
    kernels, dilations, regions : sizes of the encoder, F, D and R.  width : principal components of what it gives.
    l2 : ridge of the heads, in units of one label each.
    max_iter : Newton steps of the heads in one fit, at most.
    random_state : of all that is drawn; None draws anew at each fit.
    """

    sizes = ("kernels", "dilations", "regions", "width")

    def __init__(
        self,
        *,
        n_components: int = 2,
        folds: int = 5,
        kernels: int = 28,
        dilations: int = 5,
        regions: int = 3,
        width: int = 128,
        l2: float = 1.0,
        max_iter: int = 20,
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
        expect(self.regions <= 16, "regions <= 16", self.regions)
        return ConvEncoder(channels, samples, self.average_, self.kernels, self.dilations, self.regions)

    def _start(self, traces: Floats) -> None:
        self.average_ = averaging(torch.from_numpy(traces))
        super()._start(traces)

    def get_state(self) -> dict[str, NDArray[Any]]:
        return super().get_state() | {"average": np.array(self.average_)}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        self.average_ = int(state["average"])
        return super().set_state(state)


def averaging(traces: Tensor) -> int:
    """Samples of traces (n, C, T) to average: so many that 200 are left and a share 0.8 of the variance, or fewer."""
    traces = traces[:: 1 + (len(traces) - 1) // LEARNED]
    samples = traces.size(2)
    centred = traces.double() - traces.double().mean((0, 2), keepdim=True)
    whole = centred.square().mean((0, 2))
    for average in range(samples // 200, 1, -1):
        frames = samples // average
        means = centred[:, :, samples - frames * average :].reshape(len(traces), -1, frames, average).mean(3)
        if bool((means.square().mean((0, 2)) >= 0.8 * whole).all()):
            return average
    return 1


def _taps(frames: int, dilations: int, places: int) -> NDArray[np.int64]:
    """(D, P, 9) positions in the averaged trace; `frames`, one beyond its end, where there is none."""
    spread = np.array(dilations_of(frames, dilations), dtype=np.int64)
    middle = ((np.arange(places) + 0.5) / places * frames).astype(np.int64)
    taps = middle[:, None] + spread[:, None, None] * (np.arange(TAPS) - TAPS // 2)
    return np.where((taps < 0) | (taps >= frames), frames, taps)


def _kernels(channels: int, n: int, rng: np.random.Generator) -> Tensor:
    """(C*9, n) kernels of three 2s among -1s, of unit size, drawn at random; each reads a few of the channels."""
    every = rocket_kernels()
    kernels = every[torch.from_numpy(rng.permutation(max(n, len(every)))[:n] % len(every))]
    read = torch.zeros(channels, n)
    for row in range(n):
        some = rng.permutation(channels)[: int(2.0 ** rng.uniform(0.0, np.log2(channels + 1)))]
        read[torch.from_numpy(some), row] = len(some) ** -0.5
    return torch.flatten(read[:, None] * kernels.T / 18.0**0.5, 0, 1)
