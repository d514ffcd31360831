"""What every network sees of a trace: averaged, standardised, with its differences beside it."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  # PyTorch's own documentation calls it so

FRAMES = 200  # samples that an averaged trace has at least
EXPLAINED = 0.8  # share of the variance that averaging keeps at least
TRACES = 256  # traces that the statistics are read from
CLIP = 8.0  # standard deviations
FLOOR = 1e-6  # added to a standard deviation, for a channel that never moved


class Preprocessor(nn.Module):
    """Average traces, standardise each channel, and append the differences: (B, C, T) -> (B, 2 * C, L).

    Channel ``2 * c`` of the result is channel c of the trace, channel ``2 * c + 1`` its differences in time. Both are
    clipped at eight standard deviations, so that one huge sample does not carry an embedding.

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
        self.skipped = samples % average  # at the start: the end of an insertion says most
        self.channels = 2 * channels
        self.samples = samples // average
        self.clip = CLIP
        self.register_buffer("mean", torch.zeros(channels, 1))
        self.register_buffer("scale", torch.ones(channels, 1))
        self.register_buffer("difference_scale", torch.ones(channels, 1))

    @torch.jit.unused
    def learn(self, traces: Tensor) -> None:
        """Set the statistics of each channel from traces (n, C, T); labels are not needed."""
        averaged = self.averaged(traces[:TRACES]).double()
        self.mean.copy_(averaged.mean((0, 2))[:, None])
        self.scale.copy_(1.0 / (averaged.std((0, 2), correction=0)[:, None] + FLOOR))
        differences = self.standardised(averaged.float()).double().diff(dim=2)
        self.difference_scale.copy_(1.0 / (differences.std((0, 2), correction=0)[:, None] + FLOOR))

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T) raw -> (B, 2 * C, L)."""
        x = self.standardised(self.averaged(x))
        differences = ((x[:, :, 1:] - x[:, :, :-1]) * self.difference_scale).clamp(-self.clip, self.clip)
        return torch.stack([x, F.pad(differences, [1, 0])], 2).flatten(1, 2)

    def averaged(self, x: Tensor) -> Tensor:
        """(B, C, T) -> (B, C, L)."""
        return F.avg_pool1d(x[:, :, self.skipped :], self.average) if self.average > 1 else x

    def standardised(self, x: Tensor) -> Tensor:
        """(B, C, L) -> (B, C, L)."""
        return ((x - self.mean) * self.scale).clamp(-self.clip, self.clip)


def averaging(traces: Tensor, frames: int = FRAMES) -> int:
    """Choose how many samples to average to one.

    Parameters
    ----------
    traces : Tensor of float32, shape (n, C, T)
    frames : int, default 200
        Samples that an averaged trace has at least.

    Returns
    -------
    int
        The largest number that leaves so many samples and 80 % of the variance; 1 where an oscillation would be lost.
    """
    traces = traces[:: 1 + (len(traces) - 1) // TRACES]
    samples = traces.size(2)
    centred = traces.double() - traces.double().mean((0, 2), keepdim=True)
    variance = centred.square().mean((0, 2))
    for average in range(samples // frames, 1, -1):
        n_means = samples // average
        means = centred[:, :, samples - n_means * average :].reshape(len(traces), -1, n_means, average).mean(3)
        if bool((means.square().mean((0, 2)) >= EXPLAINED * variance).all()):
            return average
    return 1
