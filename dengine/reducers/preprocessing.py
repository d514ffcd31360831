"""What every network reads of a trace: averaged, standardised, with its differences in time.
`TorchReducer` puts the module `Preprocessor` before its network. `averaging` chooses how many
samples become one; the reducers rocket and umap use it as well.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  # PyTorch's own documentation calls it so

MIN_FRAMES = 200  # samples of an averaged trace
MIN_EXPLAINED_VARIANCE = 0.8  # share of the variance that averaging keeps
STATISTICS_TRACES = 256  # from which scales and the averaging are read
CLIP = 8.0  # standard deviations
FLOOR = 1e-6  # added to a standard deviation, for a channel that never moved


class Preprocessor(nn.Module):
    """Average traces, standardise channels, append differences: (B, C, T) -> (B, 2 * C, L).

    Channel ``2 * c`` of the result is channel c of the trace, channel ``2 * c + 1`` its differences
    in time. Both are clipped at eight standard deviations, so that one huge sample does not carry
    an embedding.

    Parameters
    ----------
    channels, samples : int
        C and T of the raw traces.
    average : int
        Samples that are averaged to one; see `averaging`.
    """

    mean: Tensor
    scale: Tensor
    difference_scale: Tensor

    def __init__(self, channels: int, samples: int, average: int) -> None:
        super().__init__()
        self.average = average
        self.skipped = samples % average  # at the start: the end of an insertion tells most
        self.channels = 2 * channels
        self.samples = samples // average
        self.clip = CLIP
        self.register_buffer("mean", torch.zeros(channels, 1))
        self.register_buffer("scale", torch.ones(channels, 1))
        self.register_buffer("difference_scale", torch.ones(channels, 1))

    def learn(self, traces: Tensor) -> None:
        """Set the mean and scale of each channel, and the scale of its differences, in place.

        Only the first 256 of the traces (n, C, T) are read. First `average` neighbouring samples
        are averaged to one. Then `forward` standardises a channel x to (x - mean) * scale, clipped
        at ±8, and multiplies the differences in time of the result by `difference_scale`. A scale
        is 1 / (standard deviation + 1e-6), so that a channel that never moved has a finite scale.
        """
        averaged = self.average_samples(traces[:STATISTICS_TRACES]).double()
        self.mean.copy_(averaged.mean((0, 2))[:, None])
        self.scale.copy_(1.0 / (averaged.std((0, 2), correction=0)[:, None] + FLOOR))
        differences = self.standardise(averaged.float()).double().diff(dim=2)
        self.difference_scale.copy_(1.0 / (differences.std((0, 2), correction=0)[:, None] + FLOOR))

    def forward(self, x: Tensor) -> Tensor:
        """Average and standardise traces, append differences in time: (B, C, T) -> (B, 2 * C, L).

        First `average` neighbouring samples are averaged to one, so that L is T // `average`; if T
        is no multiple of `average`, the first samples are left out. Channel 2 c of the result is
        channel c, less `mean` and times `scale`, which `learn` sets. Channel 2 c + 1 holds the
        differences of channel 2 c in time, times `difference_scale`; the first is 0. All values are
        clipped at ±8. Before `learn` nothing is scaled or shifted.
        """
        x = self.standardise(self.average_samples(x))
        differences = (x[:, :, 1:] - x[:, :, :-1]) * self.difference_scale
        differences = differences.clamp(-self.clip, self.clip)
        return torch.stack([x, F.pad(differences, [1, 0])], 2).flatten(1, 2)

    def average_samples(self, x: Tensor) -> Tensor:
        """Raw traces (B, C, T) -> averaged (B, C, L); no sample is standardised yet.

        If T is no multiple of `average`, the first samples are left out. If `average` is 1, x
        itself is returned.
        """
        return F.avg_pool1d(x[:, :, self.skipped :], self.average) if self.average > 1 else x

    def standardise(self, x: Tensor) -> Tensor:
        """Averaged traces x (B, C, L) -> standardised and clipped (B, C, L).

        The values of each channel are (x - mean) * scale, clipped at ±8. Before `learn` the mean is
        0 and the scale 1.
        """
        return ((x - self.mean) * self.scale).clamp(-self.clip, self.clip)


def averaging(traces: Tensor, min_frames: int = MIN_FRAMES) -> int:
    """Choose how many samples to average to one.

    Parameters
    ----------
    traces : Tensor of float32, shape (n, C, T)
        At least one; at most 256 of them, evenly spaced, are read.
    min_frames : int, default 200
        Smallest number of samples of an averaged trace.

    Returns
    -------
    int
        The largest number that leaves at least `min_frames` samples, and at least 80 % of the
        variance of each channel, taken over all traces and samples; 1 if there is none, because the
        traces are short or oscillate.
    """
    traces = traces[:: 1 + (len(traces) - 1) // STATISTICS_TRACES]
    samples = traces.size(2)
    centred = traces.double() - traces.double().mean((0, 2), keepdim=True)
    variance = centred.square().mean((0, 2))
    for average in range(samples // min_frames, 1, -1):
        n_means = samples // average
        used = centred[:, :, samples - n_means * average :]
        means = used.reshape(len(traces), -1, n_means, average).mean(3)
        if (means.square().mean((0, 2)) >= MIN_EXPLAINED_VARIANCE * variance).all():
            return average
    return 1
