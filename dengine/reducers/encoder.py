"""The encoder: one wide 1-D convolution over the trace at several dilations, pooled, and a linear layer on top.

    x (B, C, T) -> means of a few samples each, one scale a channel                              (B, C, L)
      -> conv, F kernels of 9 taps at each of D dilations, at P places                           (B, D, P, F)
      -> a ramp from 0 to 1 around a threshold, its mean over R regions, plus twice that over all (B, D*R*F)
      -> standardised, clipped
      -> linear: W principal components of these, and W of the first traces' own               (B, 2*W)

As in MiniRocket the kernels have fixed weights, and thresholds are drawn from what they give on the first traces. No label
is read, so one encoder is honest for every fold. Instead of a hard share of positive values it counts by a ramp two
deviations wide, which measured better (docs/explanation/measured.md).

Sources: Dempster, Schmidt and Webb (2021), MiniRocket, KDD, arXiv:2012.08791, for kernels, dilations and thresholds; Tan,
Dempster, Bergmeir and Webb (2022), MultiRocket, Data Min. Knowl. Disc. 36, for several channels.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from .features import CLIP, TAPS, Carry, Features, dilations_of, rocket_kernels

WHOLE = 2.0  # weight of the mean over the whole trace beside that over a region: where it does not matter when
SHARE = 50.0  # variance of each half of the output together, so that the ridge of a head weighs them alike


class ConvEncoder(Features):
    """(B, C, T) raw traces -> (B, 2*W) features.

    channels, samples : C and T.  average : samples of one mean, `averaging`.  kernels, dilations, regions, width : F, D, R
    and W, fewer dilations on short traces.
    """

    taps: Tensor
    pool: Tensor
    kernel: Tensor
    threshold: Tensor
    slope: Tensor
    unit: Tensor
    mix: Tensor
    basis: Tensor
    centre: Tensor

    def __init__(
        self, channels: int, samples: int, average: int, kernels: int, dilations: int, regions: int, width: int
    ) -> None:
        frames = samples // average
        places = max(1, min(frames, 600) // regions) * regions  # on traces that oscillate fewer say less
        taps = _taps(frames, dilations, places)
        n_pooled = len(taps) * regions * kernels
        super().__init__(channels, samples, n_pooled)
        self.average, self.frames = average, frames
        self.head = samples - frames * average  # left out at the start: the end of an insertion tells most
        self.n_dilations, self.n_regions, self.n_kernels, self.n_places = len(taps), regions, kernels, places
        self.register_buffer("taps", torch.from_numpy(taps.ravel()))
        self.register_buffer("pool", _pool(regions, places // regions))
        self.register_buffer("kernel", torch.zeros(channels * TAPS, kernels))
        self.register_buffer("threshold", torch.zeros(len(taps), 1, kernels))
        self.register_buffer("mix", torch.zeros(n_pooled, width))
        self.register_buffer("slope", torch.ones(len(taps), 1, kernels))
        self.register_buffer("unit", torch.ones(n_pooled))
        self.register_buffer("basis", torch.zeros(n_pooled, 2 * width))
        self.register_buffer("centre", torch.zeros(2 * width))

    @property
    def n_out(self) -> int:
        """2*W, features that come out."""
        return len(self.centre)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T) -> (B, 2*W)."""
        return torch.addmm(self.centre, self.clipped(x), self.basis)

    @torch.jit.unused
    def folded(self, weight: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
        """The linear layer and scores on what it gives, as one."""
        wide = weight.double()
        return (wide @ self.basis.double().T).float(), (bias + wide @ self.centre.double()).float()

    def raw(self, x: Tensor) -> Tensor:
        """(B, C, T) -> (B, D*R*F), not standardised."""
        return self.pooled(self.averaged(x))

    def averaged(self, x: Tensor) -> Tensor:
        """(B, C, T) raw -> (B, C, L), one scale a channel."""
        if self.average > 1:
            x = nn.functional.avg_pool1d(x[:, :, self.head :], self.average)  # half the time of a mean over an axis
        return torch.addcmul(self.shift, x, self.scale)

    def pooled(self, a: Tensor) -> Tensor:
        """(B, C, L) -> (B, D*R*F): how far each kernel is above its threshold, in the mean over each region."""
        h = torch.bmm(self.windows(a), self.kernel * self.slope).add_(self.threshold)  # (D, B*P, F)
        h = nn.functional.hardtanh(h, 0.0, 1.0, inplace=True).view(-1, self.n_places, self.n_kernels)  # (D*B, P, F)
        h = torch.bmm(self.pool.expand(h.size(0), self.n_regions, self.n_places), h)  # (D*B, R, F)
        n_out = self.n_regions * self.n_kernels  # said: no traces have no size to guess it from
        h = h.view(self.n_dilations, a.size(0), n_out).transpose(0, 1)
        return h.reshape(a.size(0), self.n_dilations * n_out)

    def windows(self, a: Tensor) -> Tensor:
        """(B, C, L) -> (D, B*P, C*9): what each place of each dilation sees, so that a convolution is a product."""
        if a.size(0) * a.size(1) == 1:  # one trace at a time, as a cell decides: 40 us less
            row = torch.cat([a.flatten(), a.new_zeros(1)])  # taps beyond the ends read zeros
            return row.index_select(0, self.taps).view(self.n_dilations, self.n_places, 9)
        # Traces last: a tap then moves a row of them at once.
        rows = nn.functional.pad(a.permute(2, 1, 0).reshape(a.size(2), -1), [0, 0, 0, 1])
        seen = rows.index_select(0, self.taps).view(self.n_dilations, self.n_places, 9, a.size(1), a.size(0))
        return seen.permute(0, 4, 1, 3, 2).reshape(self.n_dilations, a.size(0) * self.n_places, a.size(1) * 9)

    def learn_filters(self, x: Tensor, rng: np.random.Generator) -> None:
        """Kernels, and thresholds from what they give on traces (n, C, T), their channels scaled."""
        # `x` is scaled already; averaging is linear, so the scale is taken out again.
        a = self.averaged((x - self.shift) / self.scale)
        self.kernel.copy_(_kernels(a.size(1), self.n_kernels, rng))
        h = torch.matmul(self.windows(a), self.kernel).transpose(1, 2).sort(2).values  # (D, F, n*P)
        # Low-discrepancy quantiles, as in MiniRocket; none at the very ends.
        quantiles = 0.05 + 0.9 * (np.arange(1, h[..., 0].numel() + 1) * (np.sqrt(5.0) + 1.0) / 2.0 % 1.0)
        place = torch.from_numpy((quantiles * (h.size(2) - 1)).astype(np.int64)).view(*h.shape[:2], 1)
        deviation = h.std(2, unbiased=False)
        self.slope.copy_((1.0 / (2.0 * deviation + 1e-6))[:, None])  # a ramp two deviations wide
        self.threshold.copy_(0.5 - h.gather(2, place).permute(0, 2, 1) * self.slope)
        pooled = self.pooled(a)
        self.unit.copy_(1.0 / (pooled.std(0, unbiased=False) + 1e-2))  # of outputs between 0 and 1
        self.mix.copy_(principal_axes((pooled - pooled.mean(0)) * self.unit, self.mix.size(1)))

    def standardise(self, raw: Tensor) -> tuple[Tensor, Carry]:
        """Set scale, principal axes and centre from pooled outputs (n, D*R*F); returns features (n, 2*W), and a `Carry`."""
        some = raw[:: 1 + (len(raw) - 1) // 2000]
        g, carry = super().standardise(some)
        before, centre = self.basis.double(), self.centre.clone()
        width = self.mix.size(1)
        # The first axes were of pooled * unit.
        halves = [principal_axes(g, width), (self.unit / self.gain)[:, None] * self.mix]
        scaled = [half * (SHARE / (g @ half).var(0, unbiased=False).sum().clamp(min=1e-9)).sqrt() for half in halves]
        self.basis.copy_(torch.cat(scaled, 1))
        self.centre.copy_(-(g.double().mean(0) @ self.basis.double()))
        back = torch.linalg.pinv(self.basis.double(), rtol=1e-4)  # (2*W, D*R*F)

        def carried(weight: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
            """The nearest scores that the new directions can give."""
            on_pooled, bias = carry((weight.double() @ before.T).float(), bias + weight @ centre)
            weight = (on_pooled.double() @ back.T).float()
            return weight, bias - weight @ self.centre

        g = g if len(some) == len(raw) else torch.addcmul(self.offset, raw, self.gain).clamp_(-CLIP, CLIP)
        return torch.addmm(self.centre, g, self.basis), carried


def averaging(traces: Tensor) -> int:
    """Samples of traces (n, C, T) to average: so many that 200 are left and a share 0.8 of the variance, or fewer."""
    samples = traces.size(2)
    centred = traces.double() - traces.double().mean((0, 2), keepdim=True)
    whole = centred.square().mean((0, 2))
    for average in range(samples // 200, 1, -1):
        frames = samples // average
        means = centred[:, :, samples - frames * average :].reshape(len(traces), -1, frames, average).mean(3)
        if bool((means.square().mean((0, 2)) >= 0.8 * whole).all()):
            return average
    return 1


def principal_axes(g: Tensor, width: int) -> Tensor:
    """(P, width) principal directions of features (n, P), the first ones; zeros where there are no more."""
    some = g[:: 1 + (len(g) - 1) // 1000].double()
    centred = some - some.mean(0)
    sizes, axes = torch.linalg.eigh(centred.T @ centred)
    n = min(width, int((sizes > 1e-9 * sizes[-1].clamp(min=1e-12)).sum()))
    found = torch.zeros(g.size(1), width)
    found[:, :n] = axes[:, axes.size(1) - n :].flip(1).float()
    return found


def _taps(frames: int, dilations: int, places: int) -> NDArray[np.int64]:
    """(D, P, 9) positions in the averaged trace; `frames`, one beyond its end, where there is none."""
    spread = np.array(dilations_of(frames, dilations), dtype=np.int64)
    middle = ((np.arange(places) + 0.5) / places * frames).astype(np.int64)
    taps = middle[:, None] + spread[:, None, None] * (np.arange(TAPS) - TAPS // 2)
    return np.where((taps < 0) | (taps >= frames), frames, taps)


def _pool(regions: int, per_region: int) -> Tensor:
    """(R, P): the mean over each region, and `WHOLE` times the mean over all."""
    own = torch.eye(regions).repeat_interleave(per_region, 1) / per_region
    return own + WHOLE / own.size(1)


def _kernels(channels: int, n: int, rng: np.random.Generator) -> Tensor:
    """(C*9, n) kernels of three 2s among -1s, of unit size, drawn at random; each reads a few of the channels."""
    every = rocket_kernels()
    kernels = every[torch.from_numpy(rng.permutation(max(n, len(every)))[:n] % len(every))]
    read = torch.zeros(channels, n)
    for row in range(n):
        some = rng.permutation(channels)[: int(2.0 ** rng.uniform(0.0, np.log2(channels + 1)))]
        read[torch.from_numpy(some), row] = len(some) ** -0.5
    return torch.flatten(read[:, None] * kernels.T / 18.0**0.5, 0, 1)
