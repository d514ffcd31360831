"""The features of `RocketReducer`: convolution kernels that are drawn, not trained. `RocketEncoder`
computes them from raw traces, `compute_raw_features` those of many traces at once; the other
functions draw the kernels and place them.

    x (B, C, T) -> means of a few samples each, channels of one scale            (B, C, L)
    tower 1     -> F kernels of 9 inputs at each of D dilations, at P places     (D, F, P * B)
                -> a ramp from 0 to 1 around a threshold
                -> its mean over R regions, plus twice that over all regions     (B, D * F * R)
    tower 2     -> G groups of 8 kernels at each dilation, at Q places of the
                   trace and of its differences                                  (2D * G, 8, Q * B)
                -> how often each kernel of a group answers most, and least      (B, 4D * G * 8)

As in MiniRocket, the kernels of tower 1 have fixed weights, and their thresholds are drawn from
what they give on the first traces. Instead of the share of positive values, a ramp two deviations
wide is averaged. Tower 1 tells how large a force is, and when. In tower 2 kernels compete, as in
Hydra. A kernel that answers nearly most counts in part, so that rounding does not decide who wins
where a trace is flat. Tower 2 tells which shapes are frequent.

A convolution is computed as a matrix product, at the places alone. A module reads no global
constant in a method that TorchScript compiles, so constants are copied to attributes.

References
----------
Dempster, Schmidt and Webb (2021), MiniRocket, KDD, arXiv:2012.08791: kernels, dilations and
thresholds. Dempster, Schmidt and Webb (2023), Hydra, Data Min. Knowl. Disc. 37: competing kernels.
Tan, Dempster, Bergmeir and Webb (2022), MultiRocket, Data Min. Knowl. Disc. 36: several channels
and differences.
"""

from itertools import combinations, pairwise

import numpy as np
import torch
from numpy.random import Generator
from torch import Tensor, nn

from ..errors import SettingError
from .base import Floats, Ints

TAPS = 9  # of a kernel; MiniRocket has 84 = 9 choose 3 ways to place three 2s among -1s
GROUP_SIZE = 8  # kernels that compete with each other
COMPETITION_WIDTH = 1.0  # deviations below the largest answer at which a kernel counts no more
MAX_PLACES = 600, 100  # of each tower: on traces that oscillate, fewer places tell less
WHOLE_TRACE_WEIGHT = 2.0  # of the mean over the whole trace: kernels also count where time does not
FEATURE_CLIP = 4.0  # deviations; an outlier may not carry a score by itself
SCALE_TRACES = 256  # from which the scales of the channels are read
FILTER_TRACES = 64  # from which thresholds and widths of ramps are read
CHUNK = 32  # traces that are computed at once: what they need stays in the cache


class RocketEncoder(nn.Module):
    """Compute both groups of features, tower 1 and 2, from raw traces: (B, C, T) -> (B, P).

    Parameters
    ----------
    channels, samples : int
        C and T.
    average : int
        Samples that are averaged to one; see `averaging`.
    kernels, dilations, regions : int
        F, D and R of the first tower; short traces have fewer dilations.
    groups : int
        G, groups of competing kernels; 0 leaves the second tower out.

    Attributes
    ----------
    towers : list of slice
        Columns of each tower among the P features; one slice if `groups` is 0.

    Raises
    ------
    SettingError
        For fewer than 2 samples.

    Notes
    -----
    All kernels are 0 until `learn` draws them, or until a state is restored.
    """

    shift: Tensor
    scale: Tensor
    offset: Tensor
    gain: Tensor
    taps: Tensor
    region_mean: Tensor
    region_mix: Tensor
    kernel: Tensor
    threshold: Tensor
    competing_kernel: Tensor
    zero: Tensor
    place_mean: Tensor

    def __init__(
        self,
        channels: int,
        samples: int,
        average: int,
        kernels: int,
        dilations: int,
        regions: int,
        groups: int,
    ) -> None:
        super().__init__()
        if samples < 2:
            raise SettingError(
                f"Expected at least 2 samples, got {samples} (n_features = {channels * samples})."
            )
        frames = samples // average
        places = max(1, min(frames, MAX_PLACES[0]) // regions) * regions
        sparse_places = min(frames, MAX_PLACES[1])
        taps = tap_positions(frames, dilations, places)
        widths = len(taps) * regions * kernels, 4 * len(taps) * groups * GROUP_SIZE
        ends = np.cumsum([0, *(widths if groups else widths[:1])]).tolist()
        self.towers = [slice(first, end) for first, end in pairwise(ends)]
        self.average = average
        self.skipped = samples % average  # at the start: the end of an insertion tells most
        self.n_dilations = len(taps)
        self.n_regions = regions
        self.n_kernels = kernels
        self.n_groups = groups
        self.group_size = GROUP_SIZE
        self.kernel_size = TAPS
        self.n_sparse_places = sparse_places
        self.feature_clip = FEATURE_CLIP
        self.n_dense_taps = taps.size  # of the first tower
        if groups:  # the differences stand behind the trace
            sparse = tap_positions(frames, dilations, sparse_places)
            of_differences = np.where(sparse < frames - 1, frames + sparse, 2 * frames - 1)
            taps = np.concatenate([taps.ravel(), sparse.ravel(), of_differences.ravel()])
        self.whole_weight = WHOLE_TRACE_WEIGHT / regions
        self.region_length = places // regions
        learned = {
            # A channel becomes scale * x + shift, a feature gain * f + offset: one pass each.
            "shift": torch.zeros(channels, 1),
            "scale": torch.ones(channels, 1),
            "offset": torch.zeros(ends[-1]),
            "gain": torch.ones(ends[-1]),
            "taps": torch.from_numpy(taps.ravel()),
            "kernel": torch.zeros(self.n_dilations, kernels, channels * TAPS),
            "threshold": torch.zeros(self.n_dilations, kernels, 1),
            "competing_kernel": torch.zeros(
                2 * self.n_dilations, groups * GROUP_SIZE, channels * TAPS
            ),
        }
        constants = {
            "region_mean": torch.full((self.region_length,), 1.0 / self.region_length),
            "region_mix": torch.eye(regions) + self.whole_weight,
            "place_mean": torch.full((sparse_places,), 1.0 / sparse_places),
            "zero": torch.zeros(1, channels, 1),
        }
        for name, value in (learned | constants).items():
            self.register_buffer(name, value, persistent=name in learned)

    def forward(self, x: Tensor) -> Tensor:
        """Raw traces (B, C, T) -> standardised, clipped features (B, P)."""
        return self.scale_features(self.raw_features(x))

    def raw_features(self, x: Tensor) -> Tensor:
        """Compute unscaled features (B, P) of raw traces (B, C, T): of tower 1, then of tower 2.

        A tower is a group of features from convolution kernels. The features of tower 1 are from 0
        to 3: the mean over a region, a stretch of the trace, plus twice the mean over the whole
        trace, of a kernel's outputs, which are limited to 0 to 1 (`ramp_features`). In tower 2
        kernels compete in groups of 8; its features say how often each kernel of a group has the
        largest, and how often the smallest output (`competition_features`). If `groups` is 0, there
        is no tower 2. `scale_features` standardises the features.
        """
        values = self.read_taps(self.average_samples(x))
        n_dense = self.n_dense_taps
        batch = x.size(0)
        dense = self.as_windows(values.narrow(1, 0, n_dense), self.n_dilations)
        ramps = self.ramp_features(dense, batch)
        if self.n_groups == 0:
            return ramps
        n_sparse = values.size(1) - n_dense
        sparse = self.as_windows(values.narrow(1, n_dense, n_sparse), 2 * self.n_dilations)
        return torch.cat([ramps, self.competition_features(sparse, batch)], 1)

    def scale_features(self, raw: Tensor) -> Tensor:
        """Standardise unscaled features (B, P) and clip them at ±4 deviations: a new tensor (B, P).

        Each becomes `offset` + `gain` times the feature; before `learn_feature_scales` these are 0
        and 1. `raw` is not changed.
        """
        scaled = torch.addcmul(self.offset, raw, self.gain)
        return scaled.clamp_(-self.feature_clip, self.feature_clip)

    def average_samples(self, x: Tensor) -> Tensor:
        """Average samples and scale channels: raw traces (B, C, T) -> (B, C, L).

        Each `average` neighbouring samples become their mean, and a channel x then becomes `scale`
        * x + `shift`, which `learn` sets. If T is no multiple of `average`, the first samples are
        left out. The scaled values are clipped at ±1e6.
        """
        if self.average > 1:
            # In half the time of a mean over an axis.
            x = nn.functional.avg_pool2d(x[..., self.skipped :], [1, self.average])
        # Without the limits products of huge values would overflow.
        return torch.addcmul(self.shift, x, self.scale).clamp_(-1e6, 1e6)

    def read_taps(self, x: Tensor) -> Tensor:
        """Read all inputs of the kernels from averaged traces (B, C, L): (C, number of taps, B).

        A tap is an input of a kernel at one place in the trace, and L is the number of averaged
        samples. The traces are first put into rows of L samples, then the L - 1 differences of
        successive samples, then a 0, which stands for what lies beyond the ends; for each tap, the
        buffer `taps` has its index into such a row. The taps of tower 1 (the first group of
        features) come first, then those of tower 2 in the trace, then in its differences. The batch
        is the last axis, so that reading a tap copies a row.
        """
        batch = x.size(0)
        differences = x[:, :, 1:] - x[:, :, :-1]
        rows = torch.cat([x, differences, self.zero.expand(batch, -1, -1)], 2)
        if rows.size(0) * rows.size(1) == 1:  # one trace at a time, as a cell decides
            return rows.view(-1).index_select(0, self.taps).view(1, -1, 1)
        return rows.permute(1, 2, 0).contiguous().index_select(1, self.taps)

    def as_windows(self, values: Tensor, n: int) -> Tensor:
        """Arrange inputs of n dilations, `values` (C, n * 9 * P, B), as (n, C * 9, P * B).

        P is the number of places in a trace at which the kernels are applied, and 9 the number of
        inputs of a kernel in each of C channels. A column of the result, a window, holds all inputs
        of a kernel at one place of one of B traces, so that a convolution is a matrix product.
        """
        channels = values.size(0)
        taps = self.kernel_size
        columns = values.size(1) // (n * taps) * values.size(2)
        if channels == 1:
            return values.reshape(n, taps, columns)
        by_dilation = values.reshape(channels, n, taps, columns).transpose(0, 1)
        return by_dilation.reshape(n, channels * taps, columns)

    def ramp_features(self, windows: Tensor, batch: int) -> Tensor:
        """Compute the features of tower 1, ramps of kernels: (B, D * F * R).

        Tower 1 is the first of two groups of features. `windows` (D, C * 9, P * B) are the inputs
        of F kernels, 9 in each of C channels, at each of D dilations and P places of `batch` = B
        traces (see `as_windows`). R regions divide the trace. The output of a kernel at a place
        goes through a ramp, which rises from 0 to 1 around the kernel's threshold and is flat
        beyond. A feature is the mean of the ramp over a region, plus twice its mean over the whole
        trace. In the order of the features, dilations vary slowest and regions fastest.
        """
        h = torch.baddbmm(self.threshold, self.kernel, windows).clamp_(0.0, 1.0)  # (D, F, P * B)
        if batch == 1:  # one product whose columns are the regions takes four times as long
            means = torch.mv(h.view(-1, self.region_length), self.region_mean)
            return torch.mm(means.view(-1, self.n_regions), self.region_mix).view(1, -1)
        h = h.view(self.n_dilations, self.n_kernels, self.n_regions, self.region_length, batch)
        h = h.sum(3) / self.region_length  # (D, F, R, B)
        h = h + self.whole_weight * h.sum(2, keepdim=True)  # as `region_mix` does
        return h.reshape(self.n_dilations * self.n_kernels * self.n_regions, batch).t()

    def competition_features(self, windows: Tensor, batch: int) -> Tensor:
        """Compute the features of tower 2, competing kernels: (B, 4D * G * 8).

        Tower 2 is the second of two groups of features. `windows` (2D, C * 9, Q * B) are the inputs
        from `batch` = B traces, see `as_windows`: D dilations of the trace, then D of its
        differences in time. G groups of 8 kernels compete at each of Q places. The first half of
        the features tells of each kernel how often its output is the largest of its group, the
        second half how often it is the smallest. "How often" is the root of the mean over the
        places of a score: 1 for the winner, 1 - distance for an output that is less than 1 away
        from it, else 0.
        """
        n_groups = 2 * self.n_dilations * self.n_groups
        size = self.group_size
        h = torch.bmm(self.competing_kernel, windows)
        h = h.view(n_groups, size, self.n_sparse_places * batch)
        wins = torch.empty(2, n_groups, size, h.size(2))
        torch.sub(h, h.amax(1, keepdim=True) - 1.0, out=wins[0])
        torch.sub(h.amin(1, keepdim=True) + 1.0, h, out=wins[1])
        wins.clamp_(min=0.0)
        if batch == 1:
            means = torch.mv(wins.view(-1, self.n_sparse_places), self.place_mean)
            return means.sqrt_().view(1, -1)
        sums = wins.view(2 * n_groups * size, self.n_sparse_places, batch).sum(1)
        return sums.mul_(1.0 / self.n_sparse_places).sqrt_().t()

    def learn(self, X: Tensor, rng: Generator) -> None:
        """Set channel scales, kernels and thresholds, in place, from traces X (n, C, T).

        `rng` draws the convolution kernels, and the traces that are read: at most 256 for the
        scales, and 64 of these for the thresholds. A channel x is then scaled to scale * x + shift,
        with mean 0 and standard deviation 1; one that never moves is only shifted. Call this method
        once: a second call sets all of these anew, and the features of every trace change. `gain`
        and `offset`, which scale the features, are not set here; `learn_feature_scales` sets them.
        """
        if len(X) > SCALE_TRACES:
            X = X[torch.from_numpy(rng.permutation(len(X))[:SCALE_TRACES])]
        double = X.double()
        mean = double.mean((0, 2))
        deviation = double.std((0, 2), unbiased=False)
        scale = 1.0 / torch.where(deviation > 0, deviation, 1.0)
        self.scale.copy_(scale[:, None])
        self.shift.copy_((-mean * scale)[:, None])
        sample = X[torch.from_numpy(rng.permutation(len(X))[:FILTER_TRACES])]
        self.learn_filters(torch.addcmul(self.shift, sample, self.scale), rng)

    def learn_filters(self, x: Tensor, rng: Generator) -> None:
        """Draw the kernels, and set their scales and thresholds from their outputs on traces.

        `x`, float32 (n, C, T), are traces whose channels the caller has scaled by `shift` and
        `scale`, which must be set before. It writes `kernel`, `threshold` and, if there are groups
        of competing kernels, `competing_kernel`. `rng` draws the kernels of the two towers (groups
        of features): MiniRocket's for tower 1, normal weights less their mean for tower 2. It also
        draws the channels that each kernel reads.

        Only tower 1 has thresholds; they are quantiles of a kernel's outputs, from 5 to 95 %. Its
        kernels are scaled so that the ramp around the threshold, on which the answer of a kernel
        rises from 0 to 1, is two standard deviations of the outputs wide. `threshold` holds 0.5
        minus the threshold in this scale; it is added to the scaled output. The kernels of tower 2
        are scaled so that all outputs of a dilation together have the standard deviation 1.
        """
        # `x` is scaled already; averaging is linear, so the scale is taken out again.
        values = self.read_taps(self.average_samples((x - self.shift) / self.scale))  # (C, taps, n)
        kernels = draw_kernels(x.size(1), self.n_kernels, rocket_kernels(), rng)
        # Low-discrepancy quantiles, as in MiniRocket; none at the very ends.
        n = self.n_dilations * self.n_kernels
        quantiles = 0.05 + 0.9 * (np.arange(1, n + 1) * (np.sqrt(5.0) + 1.0) / 2.0 % 1.0)
        quantiles = quantiles.reshape(self.n_dilations, self.n_kernels)
        dense = self.as_windows(values[:, : self.n_dense_taps], self.n_dilations)
        for d, windows in enumerate(dense):  # (C * 9, P * n)
            answers = (kernels @ windows).numpy()
            ranks = (quantiles[d] * (answers.shape[1] - 1)).astype(np.int64)
            thresholds = [
                np.partition(row, rank)[rank] for row, rank in zip(answers, ranks, strict=True)
            ]
            slope = 1.0 / (2.0 * torch.from_numpy(answers.std(1)) + 1e-6)  # two deviations wide
            self.kernel[d] = kernels * slope[:, None]
            self.threshold[d, :, 0] = 0.5 - torch.tensor(thresholds) * slope
        if self.n_groups:
            sparse = self.as_windows(values[:, self.n_dense_taps :], 2 * self.n_dilations)
            for d, windows in enumerate(sparse):  # (C * 9, Q * n)
                weights = rng.standard_normal((self.competing_kernel.size(1), TAPS))
                weights -= weights.mean(1, keepdims=True)  # so that offsets do not matter
                kernels = draw_kernels(
                    x.size(1), len(weights), torch.from_numpy(weights).float(), rng
                )
                width = COMPETITION_WIDTH * (kernels @ windows).std() + 1e-6
                self.competing_kernel[d] = kernels / width

    def learn_feature_scales(self, raw: Tensor) -> None:
        """Set `gain` and `offset` so that `offset + gain * raw` is standardised.

        Both are changed in place. They are computed from the unscaled features `raw` (n, P), each
        of which gets the mean 0 and the standard deviation 1. But all features of tower 2 (the
        second group of features) are divided by the same number, the root mean square of their
        standard deviations. A floor is added to each deviation, 0.001 of the median deviation plus
        1e-12, so that a feature that never varied does not become huge.
        """
        deviation, mean = torch.std_mean(raw.double(), 0, unbiased=False)
        for tower in self.towers[1:]:  # of shares, those that vary more tell more
            deviation[tower] = deviation[tower].square().mean().sqrt()
        # Or a feature that never varied would explode.
        deviation += 1e-3 * deviation.median() + 1e-12
        self.gain.copy_(1.0 / deviation)
        self.offset.copy_(-mean / deviation)


def compute_raw_features(encoder: RocketEncoder, traces: Floats) -> Tensor:
    """Compute the unscaled features of traces (n, C, T): float32 (n, P), P features of each.

    Gradients are not switched off here. The encoder computes 32 traces at a time, and the last
    batch is filled up with traces of zeros. So the features of a trace are the same to the bit,
    whatever other traces it comes with.
    """
    features = []
    for chunk in torch.split(torch.from_numpy(traces), CHUNK):
        full = nn.functional.pad(chunk, [0, 0, 0, 0, 0, CHUNK - len(chunk)])
        features.append(encoder.raw_features(full)[: len(chunk)])
    return torch.cat(features)


def rocket_kernels() -> Tensor:
    """Return MiniRocket's kernels (84, 9): every way to place three 2s among -1s.

    Each kernel sums to zero, so that offsets do not matter.
    """
    places = torch.tensor(list(combinations(range(TAPS), 3)))
    return torch.full((84, TAPS), -1.0).scatter_(1, places, 2.0)


def tap_positions(frames: int, dilations: int, places: int) -> Ints:
    """Return the frame that each tap of a kernel reads, int64 (D, 9, P), for P places in a trace.

    A trace has `frames` frames, means of a few samples; a tap is one of the nine inputs of a
    kernel. The places are spaced evenly over the trace, and a kernel reads four inputs on each side
    of its place, a dilation apart. The dilations are spaced evenly in their logarithm, from 1 to
    that at which a kernel spans the trace, and rounded down. `dilations` is the largest D; D is
    smaller if some are then equal, as for short traces. With ``dilations=1`` the only dilation is
    1. For a tap beyond the ends of the trace the position is ``2 * frames - 1``, at which
    `RocketEncoder.read_taps` finds a zero.
    """
    widest = np.log2((frames - 1) / (TAPS - 1)) if frames > TAPS else 0.0  # spans the trace
    steps = np.unique(np.floor(2.0 ** np.linspace(0.0, widest, dilations))).astype(np.int64)
    middle = ((np.arange(places) + 0.5) / places * frames).astype(np.int64)
    taps = middle + steps[:, None, None] * (np.arange(TAPS) - TAPS // 2)[:, None]
    return np.where((taps < 0) | (taps >= frames), 2 * frames - 1, taps)


def draw_kernels(channels: int, n: int, choices: Tensor, rng: Generator) -> Tensor:
    """Draw n kernels from `choices` (N, 9), and the channels that each reads: float32 (n, C * 9).

    `rng` draws them. C is `channels`. Each of the N choices is drawn n / N times, rounded up or
    down, so none twice unless n exceeds N. A kernel reads one to all channels; a small number of
    channels is more likely. Its nine weights are the same in all channels that it reads, and 0 in
    the others. Each row of the result has the norm 1.
    """
    kernels = choices[torch.from_numpy(rng.permutation(max(n, len(choices)))[:n] % len(choices))]
    weights = torch.zeros(n, channels)
    for row in range(n):
        selected = rng.permutation(channels)[: int(2.0 ** rng.uniform(0.0, np.log2(channels + 1)))]
        weights[row, torch.from_numpy(selected)] = len(selected) ** -0.5
    units = kernels / kernels.square().sum(1, keepdim=True).sqrt()
    return torch.flatten(weights[:, :, None] * units[:, None], 1)
