"""The 1-D conv embedding: an encoder that reads no label, and heads that read all but their own fold's.

    >>> reducer = RocketReducer(folds=5).fit(X, y)     # X (n, T) or (n, C, T), y (n,) 1 = success, 0 = failure
    >>> reducer.embed(X).shape                       # (n, K, d): every trace in each of the K spaces

    x (B, C, T) -> means of a few samples each, one scale a channel                              (B, C, L)
    tower 1     -> conv, F kernels of 9 taps at each of D dilations, at P places                 (B, D, F, P)
                -> a ramp from 0 to 1 around a threshold, its mean over R regions, plus twice that over all (B, D*F*R)
    tower 2     -> conv, G groups of 8 kernels at each dilation, at Q places of the trace and of its differences
                -> how often each of a group answers most, and least; roots                      (B, 4*D*G*8)
    products    -> of every two of the four leading principal components of tower 1              (B, 16)
    all three   -> principal components and heads, one logit of them; see features.py            (B, K, d)

A network trained on labels would exist K times, each on few labels. The encoder is drawn, not trained, and shared by all K
spaces. As in MiniRocket the kernels of tower 1 have fixed weights, and thresholds are drawn from what they give on the
first traces; instead of a hard share of positive values it counts by a ramp two deviations wide. It tells how large a force
is, and when. In tower 2 kernels compete, as in Hydra, but one that answers nearly most counts in part: so no rounding
decides who wins where a trace is flat. It tells which shapes are frequent. What was measured: docs/explanation/measured.md.

Sources: Dempster, Schmidt and Webb (2021), MiniRocket, KDD, arXiv:2012.08791, for kernels, dilations and thresholds; by the
same (2023), Hydra, Data Min. Knowl. Disc. 37, for competing kernels; Tan, Dempster, Bergmeir and Webb (2022), MultiRocket,
Data Min. Knowl. Disc. 36, for several channels and differences. Cross-fitting: Wolpert (1992), Neural Networks 5, which
also weighs the towers; Chernozhukov et al. (2018), Econometrics Journal 21.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ..errors import expect
from ..records import is_whole
from .base import Floats
from .features import TAPS, FeatureReducer, Features, dilations_of, rocket_kernels
from .preprocessing import averaging

WHOLE = 2.0  # weight of the mean over the whole trace beside that over a region: where it does not matter when
PLACES = 600, 100  # of each tower at most: on traces that oscillate fewer say less
RIVALS = 8  # kernels of a group
NEARLY = 1.0  # deviation of the answers: who answers so far below the most of its group counts no more, in between in part


class RocketEncoder(Features):
    """(B, C, T) raw traces -> (B, P) features of both towers.

    channels, samples : C and T.  average : samples of one mean, `averaging`.  kernels, dilations, regions : F, D and R,
    fewer dilations on short traces.  groups : G; 0: no second tower.
    """

    taps: Tensor
    even: Tensor
    mix: Tensor
    kernel: Tensor
    threshold: Tensor
    rival: Tensor
    nothing: Tensor
    share: Tensor

    def __init__(
        self, channels: int, samples: int, average: int, kernels: int, dilations: int, regions: int, groups: int
    ) -> None:
        frames = samples // average
        places, few = max(1, min(frames, PLACES[0]) // regions) * regions, min(frames, PLACES[1])
        taps = _taps(frames, dilations, places)
        widths = len(taps) * regions * kernels, 4 * len(taps) * groups * RIVALS
        super().__init__(channels, samples, *(widths if groups else widths[:1]))
        self.average, self.head = average, samples % average  # left out at the start: the end of an insertion tells most
        self.n_dilations, self.n_regions, self.n_kernels, self.n_places = len(taps), regions, kernels, places
        self.n_groups, self.n_few = groups, few
        self.n_taps = taps.size  # of the first tower
        if groups:  # the differences stand behind the trace
            sparse = _taps(frames, dilations, few)
            both = np.concatenate([sparse, np.where(sparse < frames - 1, frames + sparse, 2 * frames - 1)])
            taps = np.concatenate([taps.ravel(), both.ravel()])
        self.register_buffer("taps", torch.from_numpy(taps.ravel()))
        self.whole, self.length = WHOLE / regions, places // regions
        self.register_buffer("even", torch.full((self.length,), 1.0 / self.length), persistent=False)
        self.register_buffer("mix", torch.eye(regions) + self.whole, persistent=False)
        self.register_buffer("kernel", torch.zeros(self.n_dilations, kernels, channels * TAPS))
        self.register_buffer("threshold", torch.zeros(self.n_dilations, kernels, 1))
        self.register_buffer("rival", torch.zeros(2 * self.n_dilations, groups * RIVALS, channels * TAPS))
        self.register_buffer("nothing", torch.zeros(1, channels, 1), persistent=False)
        self.register_buffer("share", torch.full((few,), 1.0 / few), persistent=False)

    def raw(self, x: Tensor) -> Tensor:
        """(B, C, T) -> (B, P)."""
        a = self.averaged(x)
        seen, n, b = self.seen(a), self.n_taps, a.size(0)
        ramps = self.ramps(self.windows(seen.narrow(1, 0, n), self.n_dilations), b)
        if self.n_groups == 0:
            return ramps
        rivals = self.windows(seen.narrow(1, n, seen.size(1) - n), 2 * self.n_dilations)
        return torch.cat([ramps, self.counts(rivals, b)], 1)

    def averaged(self, x: Tensor) -> Tensor:
        """(B, C, T) raw -> (B, C, L), one scale a channel."""
        if self.average > 1:
            x = x[..., self.head :] if self.head > 0 else x
            x = nn.functional.avg_pool2d(x, [1, self.average])  # half the time of a mean over an axis
        return torch.addcmul(self.shift, x, self.scale)

    def seen(self, a: Tensor) -> Tensor:
        """(B, C, L) -> (C, taps, B): what each tap reads, traces last: it then moves a row of them at once."""
        rows = torch.cat([a, a[:, :, 1:] - a[:, :, :-1], self.nothing.expand(a.size(0), -1, -1)], 2)
        if rows.size(0) * rows.size(1) == 1:  # one trace at a time, as a cell decides: nothing to put in order
            return rows.view(-1).index_select(0, self.taps).view(1, -1, 1)
        return rows.permute(1, 2, 0).contiguous().index_select(1, self.taps)

    def windows(self, seen: Tensor, n: int) -> Tensor:
        """(C, n*9*P, B) -> (n, C*9, P*B): what each place of each dilation sees, so that a convolution is a product."""
        channels, places = seen.size(0), seen.size(1) // (n * 9) * seen.size(2)  # where n = 0, -1 could not be inferred
        if channels == 1:
            return seen.reshape(n, 9, places)
        return seen.reshape(channels, n, 9, places).transpose(0, 1).reshape(n, channels * 9, places)

    def ramps(self, windows: Tensor, b: int) -> Tensor:
        """(D, C*9, P*B) -> (B, D*F*R): how far each kernel is above its threshold, in the mean over each region."""
        h = torch.baddbmm(self.threshold, self.kernel, windows).clamp_(0.0, 1.0)  # (D, F, P*B)
        if b == 1:  # one product whose columns are the regions takes four times as long
            means = torch.mv(h.view(-1, self.length), self.even).view(-1, self.n_regions)
            return torch.mm(means, self.mix).view(1, -1)
        h = h.view(self.n_dilations, self.n_kernels, self.n_regions, self.length, b).sum(3) / self.length  # (D, F, R, B)
        h = h + self.whole * h.sum(2, keepdim=True)  # as `mix` has it
        return h.reshape(self.n_dilations * self.n_kernels * self.n_regions, b).t()

    def counts(self, windows: Tensor, b: int) -> Tensor:
        """(2D, C*9, Q*B) -> (B, 4*D*G*8): roots of how often a kernel answers most of its group, or least, by place."""
        # The 8 is RIVALS, the kernels of a group; the 1.0 is NEARLY, by which `learn_filters` has divided the kernels.
        h = torch.bmm(self.rival, windows).view(2 * self.n_dilations * self.n_groups, 8, self.n_few * b)
        won = torch.empty(2, h.size(0), 8, h.size(2))
        torch.sub(h, h.amax(1, keepdim=True) - 1.0, out=won[0])
        torch.sub(h.amin(1, keepdim=True) + 1.0, h, out=won[1])
        won.clamp_(min=0.0)
        if b == 1:
            return torch.mv(won.view(-1, self.n_few), self.share).sqrt_().view(1, -1)
        return won.view(2 * h.size(0) * 8, self.n_few, b).sum(1).mul_(1.0 / self.n_few).sqrt_().t()

    def learn_filters(self, x: Tensor, rng: np.random.Generator) -> None:
        """Draw kernels, thresholds and widths from what they give on traces (n, C, T), their channels scaled."""
        # `x` is scaled already; averaging is linear, so the scale is taken out again.
        seen = self.seen(self.averaged((x - self.shift) / self.scale))  # (C, taps, n)
        kernels = _kernels(x.size(1), self.n_kernels, rocket_kernels(), rng)
        # Low-discrepancy quantiles, as in MiniRocket; none at the very ends.
        n = self.n_dilations * self.n_kernels
        quantiles = 0.05 + 0.9 * (np.arange(1, n + 1) * (np.sqrt(5.0) + 1.0) / 2.0 % 1.0)
        for d, rows in enumerate(self.windows(seen[:, : self.n_taps], self.n_dilations)):  # (C*9, P*n)
            given = (kernels @ rows).numpy()
            own = quantiles[d * self.n_kernels : (d + 1) * self.n_kernels]
            places = (own * (given.shape[1] - 1)).astype(np.int64)
            chosen = [np.partition(each, place)[place] for each, place in zip(given, places, strict=True)]
            slope = 1.0 / (2.0 * torch.from_numpy(given.std(1)) + 1e-6)  # a ramp two deviations wide
            self.kernel[d] = kernels * slope[:, None]
            self.threshold[d, :, 0] = 0.5 - torch.tensor(chosen) * slope
        if self.n_groups:
            for d, rows in enumerate(self.windows(seen[:, self.n_taps :], 2 * self.n_dilations)):  # (C*9, Q*n)
                drawn = rng.standard_normal((self.rival.size(1), TAPS))
                drawn -= drawn.mean(1, keepdims=True)  # as all kernels: offsets do not matter
                rivals = _kernels(x.size(1), len(drawn), torch.from_numpy(drawn).float(), rng)
                self.rival[d] = rivals / (NEARLY * (rivals @ rows).std() + 1e-6)


@dataclass(eq=False, repr=False, kw_only=True)
class RocketReducer(FeatureReducer):
    """Trace -> point, by a convolutional encoder and cross-fitted heads.

    n_components : d, 1 or 2; the first axis is the predicted probability of success, the second is there to be seen.
    folds : K. More folds train each head on more of the labels; the time to embed hardly grows.
    kernels, dilations, regions : sizes of the first tower, F, D and R.  groups : G of the second; 0 leaves it out.
    width : principal components of what each gives.
    l2 : ridge of the heads, in units of one label each.
    max_iter : Newton steps of the heads in one fit, at most.
    random_state : of all that is drawn; None draws anew at each fit.
    """

    variances = 40.0, 5.0
    leading = 4
    sizes = ("kernels", "dilations", "regions", "width")

    kernels: int = 28
    dilations: int = 5
    regions: int = 3
    groups: int = 2
    width: int = 128
    l2: float = 0.5

    def make_features(self, channels: int, samples: int) -> RocketEncoder:
        expect(self.regions <= 16, "regions <= 16", self.regions)
        expect(is_whole(self.groups, 0, 64), "groups from 0 to 64, an integer", self.groups)
        sizes = self.kernels, self.dilations, self.regions, self.groups
        return RocketEncoder(channels, samples, self.average_, *sizes)

    def _start(self, traces: Floats) -> None:
        self.average_ = averaging(torch.from_numpy(traces))
        super()._start(traces)

    def get_state(self) -> dict[str, NDArray[Any]]:
        return super().get_state() | {"average": np.array(self.average_)}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> Self:
        self.average_ = int(state["average"])
        return super().set_state(state)


def _taps(frames: int, dilations: int, places: int) -> NDArray[np.int64]:
    """(D, 9, P) positions in the averaged trace of so many frames; 2 * frames - 1, where a zero stands, beyond its ends."""
    spread = np.array(dilations_of(frames, dilations), dtype=np.int64)
    middle = ((np.arange(places) + 0.5) / places * frames).astype(np.int64)
    taps = middle + spread[:, None, None] * (np.arange(TAPS) - TAPS // 2)[:, None]
    return np.where((taps < 0) | (taps >= frames), 2 * frames - 1, taps)


def _kernels(channels: int, n: int, every: Tensor, rng: np.random.Generator) -> Tensor:
    """(n, C*9): kernels (N, 9), drawn at random and of unit size; each reads a few of the channels."""
    kernels = every[torch.from_numpy(rng.permutation(max(n, len(every)))[:n] % len(every))]
    read = torch.zeros(n, channels)
    for row in range(n):
        some = rng.permutation(channels)[: int(2.0 ** rng.uniform(0.0, np.log2(channels + 1)))]
        read[row, torch.from_numpy(some)] = len(some) ** -0.5
    return torch.flatten(read[:, :, None] * (kernels / kernels.square().sum(1, keepdim=True).sqrt())[:, None], 1)
