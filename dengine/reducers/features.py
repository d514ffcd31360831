"""Features of traces, computed once each: what costs most in a retrain does not change from one to the next.

>>> kept = KeptFeatures(width)
>>> kept.of(traces, compute).shape     # (n, width); only what was not there is computed

Label-free features of a trace: segment statistics, and a convolution whose filters are learned from patches.

    x (B, C, T) -> the trace itself, S segments: mean, deviation, minimum, maximum        (B, 4*C*S)
                -> conv, F filters a twentieth of the trace long -> ReLU -> mean over R regions  (B, F*R)

The filters are the principal components of the patches, whitened: what a linear convolutional autoencoder with one
hidden layer converges to (Baldi and Hornik, 1989, Neural Networks 2; PCANet: Chan et al., 2015, IEEE TIP 24), so the
closed form replaces its training. No label is read anywhere here: one set of features serves every fold.
"""

import copy
from collections.abc import Callable, Sequence
from hashlib import sha1
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ..errors import SettingError
from .base import Floats

# Weights (m, P), biases (m,) of scores on features as they were -> those that say the same on features as they are.
Carry = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
PATCH_TRACES = 256
PATCHES = 5000  # enough for a covariance of 50 x 50, and 10 ms of work
PATCH_SHARE = 20  # a patch is this part of a trace: a contact event, not a sample's noise
LEARN_TRACES = 1000  # that set channel scales: more tell no more
CLIP = 4.0  # deviations; an outlier may not carry a score by itself


class Features(nn.Module):
    """(B, C, T) raw traces -> (B, P) standardised features; holds every constant it needs, and reads no label.

    A kind of features gives `raw` and `learn_filters`.
    """

    shift: Tensor
    scale: Tensor
    offset: Tensor
    gain: Tensor

    def __init__(self, channels: int, n_features: int) -> None:
        super().__init__()
        # A channel becomes scale * x + shift, a feature gain * f + offset: one pass each.
        self.register_buffer("shift", torch.zeros(channels, 1))
        self.register_buffer("scale", torch.ones(channels, 1))
        self.register_buffer("offset", torch.zeros(n_features))
        self.register_buffer("gain", torch.ones(n_features))

    @property
    def n_out(self) -> int:
        """P, features that come out."""
        return len(self.gain)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T) -> (B, P), standardised."""
        return self.clipped(x)

    def clipped(self, x: Tensor) -> Tensor:
        """(B, C, T) -> (B, P), each feature centred, scaled and clipped."""
        f = torch.addcmul(self.offset, self.raw(x), self.gain)
        return f.clamp_(-4.0, 4.0)  # CLIP: a scripted method reads no global

    @torch.jit.unused
    def folded(self, weight: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
        """Weights (m, n_out), biases (m,) of scores on these features -> (m, P), (m,) on the clipped ones."""
        return weight, bias

    def raw(self, x: Tensor) -> Tensor:
        """(B, C, T) -> (B, P), not standardised."""
        raise NotImplementedError

    def learn_filters(self, x: Tensor, rng: np.random.Generator) -> None:
        """Set what a kind learns from traces (n, C, T), their channels scaled."""
        raise NotImplementedError

    def learn(self, X: Tensor, rng: np.random.Generator) -> None:
        """Set channel scales and filters from traces (n, C, T); done once, so that the map stays where it is."""
        if len(X) > LEARN_TRACES:
            X = X[torch.from_numpy(rng.permutation(len(X))[:LEARN_TRACES])]
        wide = X.double()
        centre, deviation = wide.mean((0, 2)), wide.std((0, 2), unbiased=False)
        scale = 1.0 / torch.where(deviation > 0, deviation, 1.0)
        self.scale.copy_(scale[:, None])
        self.shift.copy_((-centre * scale)[:, None])
        some = X[torch.from_numpy(rng.permutation(len(X))[:PATCH_TRACES])]
        self.learn_filters(torch.addcmul(self.shift, some, self.scale), rng)

    def standardise(self, raw: Tensor) -> tuple[Tensor, Carry]:
        """Set the features' mean and deviation from raw ones (n, P); returns them standardised, (n, P), and a `Carry`."""
        gain, offset = self.gain.clone(), self.offset.clone()
        wide = raw.double()
        deviation = wide.std(0, unbiased=False)
        floor = 1e-3 * deviation.median() + 1e-12  # a feature that never moved must not explode when it does
        self.gain.copy_(1.0 / (deviation + floor))
        self.offset.copy_(-wide.mean(0) / (deviation + floor))
        ratio = gain / self.gain
        shift = offset - ratio * self.offset  # before, a feature was ratio * f + shift
        standard = torch.addcmul(self.offset, raw, self.gain).clamp(-CLIP, CLIP)
        return standard, lambda weight, bias: (weight * ratio, bias + weight @ shift)


class ConvFeatures(Features):
    """Segment statistics of the trace, and of learned filters over it.

    channels, samples : C and T.  segments, filters, regions : S, F and R of the module's docstring, S and R at most.
    """

    kernel: Tensor
    bias: Tensor
    regions: Tensor

    def __init__(self, channels: int, samples: int, segments: int, filters: int, regions: int) -> None:
        if samples < 2:
            raise SettingError(f"Expected at least 2 samples, got {samples} (n_features = {channels * samples}).")
        patch = max(2, samples // PATCH_SHARE)
        stride = max(1, patch // 4)
        frames = (samples - patch) // stride + 1
        # A short trace has fewer segments and regions: a deviation wants two samples, a region four and a frame.
        segments = min(segments, samples // 2)
        regions = max(1, min(regions, samples // 4, frames))
        super().__init__(channels, 4 * channels * segments + filters * regions)
        self.channels, self.segments = channels, segments
        self.length = samples // segments
        self.head = samples - segments * self.length  # left out at the start: the end of an insertion tells most
        self.patch, self.stride = patch, stride
        per_region = frames // regions
        # Frames start late enough for the last one to end with the trace.
        self.skip = samples - self.patch - (regions * per_region - 1) * self.stride
        self.register_buffer("regions", torch.eye(regions).repeat_interleave(per_region, 1))  # (R, L), ones
        self.register_buffer("kernel", torch.zeros(filters, channels, self.patch))
        self.register_buffer("bias", torch.zeros(filters))

    def raw(self, x: Tensor) -> Tensor:
        """(B, C, T) -> (B, P), not standardised."""
        x = torch.addcmul(self.shift, x, self.scale)
        pieces = x[:, :, self.head :].reshape(x.size(0), self.channels * self.segments, self.length)  # (B, C*S, T/S)
        # Sums for means and norms for deviations: `gain` takes a constant factor out, and they cost half.
        total = pieces.sum(2)
        centred = torch.add(pieces, total.unsqueeze(2), alpha=-1.0 / self.length)
        deviation = torch.linalg.vector_norm(centred, dim=2)
        return torch.cat([total, deviation, pieces.amin(2), pieces.amax(2), self.filtered(x[:, :, self.skip :])], 1)

    def filtered(self, x: Tensor) -> Tensor:
        """(B, C, T') -> (B, R*F): the filters' outputs over each region, summed where positive."""
        if x.size(0) == 1:  # one trace at a time, as a cell decides: a third of the time of conv1d
            frames = x[0].unfold(1, self.patch, self.stride).transpose(0, 1).flatten(1)  # (L, C*patch)
            h = torch.addmm(self.bias, frames, self.kernel.flatten(1).t())  # (L, F)
        else:
            h = nn.functional.conv1d(x, self.kernel, self.bias, stride=self.stride).transpose(1, 2)  # (B, L, F)
        n_out = self.regions.size(0) * self.kernel.size(0)  # R*F, said: no traces have no size to guess it from
        return torch.matmul(self.regions, torch.relu_(h)).reshape(x.size(0), n_out)

    def learn_filters(self, x: Tensor, rng: np.random.Generator) -> None:
        """Whitened principal components of the patches, overlapping, of traces (n, C, T)."""
        patches = x.unfold(2, self.patch, self.stride)  # (n, C, L, patch)
        patches = patches.transpose(1, 2).flatten(2).flatten(0, 1)  # (n * L, C * patch)
        patches = patches[torch.from_numpy(rng.permutation(len(patches))[:PATCHES])].double()
        mean = patches.mean(0)
        _, sizes, axes = torch.linalg.svd(patches - mean, full_matrices=False)
        n_filters = self.kernel.size(0)
        sizes = sizes / len(patches) ** 0.5
        # A direction without variance would be amplified noise: it keeps a filter of zeros.
        gain = torch.where(sizes > 1e-4 * sizes[0].clamp(min=1e-12), 1.0 / sizes.clamp(min=1e-12), 0.0)
        kernel = torch.zeros(n_filters, patches.size(1), dtype=torch.float64)
        found = min(n_filters, len(sizes))
        kernel[:found] = _signed(axes[:found]) * gain[:found, None]
        self.kernel.copy_(kernel.view_as(self.kernel))
        self.bias.copy_(-kernel @ mean)


def _signed(axes: Tensor) -> Tensor:
    """Rows (F, m) turned so that each one's largest entry is positive: the sign of an eigenvector is an accident."""
    largest = axes.gather(1, axes.abs().argmax(1, keepdim=True))
    return axes * torch.where(largest < 0, -1.0, 1.0)


class KeptFeatures:
    """A row of features (P,) a trace, found by its key.

    compute : traces (n, C, T) -> features (n, P).
    """

    def __init__(self, width: int) -> None:
        self.places: dict[bytes, int] = {}
        self.features = torch.empty(0, width)  # one tensor for all: one each would pickle them all with each

    def __len__(self) -> int:
        return len(self.features)

    def __deepcopy__(self, memo: dict[int, Any]) -> "KeptFeatures":
        """The same rows, shared: neither what finds them nor they are ever changed in place."""
        return copy.copy(self)

    def of(self, traces: Floats, compute: Callable[[Tensor], Tensor], keys: Sequence[bytes] | None = None) -> Tensor:
        """(n, C, T) -> (n, P); what is not among these traces is forgotten, as it has left the window.

        keys : `keys_of` the traces, where they are known.
        """
        keys = keys_of(traces) if keys is None else keys
        self.add(traces, keys, len(traces), compute)
        self.features = self.features[[self.places[key] for key in keys]]
        self.places = {key: i for i, key in enumerate(keys)}
        return self.features

    def add(self, traces: Floats, keys: Sequence[bytes], most: int, compute: Callable[[Tensor], Tensor]) -> int:
        """Compute those of at most so many new traces; returns how many are still missing."""
        missing = {key: i for i, key in enumerate(keys) if key not in self.places}
        new = dict(list(missing.items())[:most])
        if new:
            self.places = self.places | {key: len(self) + j for j, key in enumerate(new)}
            self.features = torch.cat([self.features, compute(torch.from_numpy(traces[list(new.values())]))])
        return len(missing) - len(new)


def keys_of(traces: Floats) -> list[bytes]:
    """What each trace (n, C, T) is found by: a digest of its exact samples, where a fold's hash is of rounded ones.

    SHA-1 is the fastest in the standard library where the processor has instructions for it, and no secret is kept.
    """
    return [sha1(trace, usedforsecurity=False).digest() for trace in traces]
