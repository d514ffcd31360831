"""Features of traces, which read no label: one set serves every fold. And what was computed of them, kept by trace.

A retrain computes features of new traces alone: they cost most, and do not change from one to the next.
"""

import copy
from collections.abc import Callable, Sequence
from hashlib import sha1
from itertools import combinations
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ..errors import SettingError
from .base import Floats

# Weights (m, P), biases (m,) of scores on features as they were -> those that say the same on features as they are.
Carry = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
CLIP = 4.0  # deviations; an outlier may not carry a score by itself
TAPS = 9  # of MiniRocket's kernels; 84 = 9 choose 3 ways to place its three 2s among -1s


class Features(nn.Module):
    """(B, C, T) raw traces -> (B, P) standardised features; holds every constant it needs, and reads no label.

    A kind of features gives `raw` and `learn_filters`.
    """

    shift: Tensor
    scale: Tensor
    offset: Tensor
    gain: Tensor

    def __init__(self, channels: int, samples: int, n_features: int) -> None:
        super().__init__()
        if samples < 2:
            raise SettingError(f"Expected at least 2 samples, got {samples} (n_features = {channels * samples}).")
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
        """(B, C, T) -> (B, n_out), standardised."""
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
        if len(X) > 1000:  # more tell no more
            X = X[torch.from_numpy(rng.permutation(len(X))[:1000])]
        wide = X.double()
        centre, deviation = wide.mean((0, 2)), wide.std((0, 2), unbiased=False)
        scale = 1.0 / torch.where(deviation > 0, deviation, 1.0)
        self.scale.copy_(scale[:, None])
        self.shift.copy_((-centre * scale)[:, None])
        some = X[torch.from_numpy(rng.permutation(len(X))[:256])]
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


def rocket_kernels() -> Tensor:
    """(84, 9): every way to place three 2s among -1s; each kernel sums to zero, so offsets do not matter."""
    places = torch.tensor(list(combinations(range(TAPS), 3)))
    return torch.full((84, TAPS), -1.0).scatter_(1, places, 2.0)


def dilations_of(samples: int, n: int) -> list[int]:
    """At most n spreads of a kernel, from 1 to the length of a trace."""
    widest = np.log2((samples - 1) / (TAPS - 1)) if samples > TAPS else 0.0
    return [int(d) for d in np.unique(np.floor(2.0 ** np.linspace(0.0, widest, n)))]


class KeptFeatures:
    """A row of features (P,) a trace, found by its key; `compute` gives those of traces (n, C, T), (n, P)."""

    def __init__(self, width: int) -> None:
        self.places: dict[bytes, int] = {}
        self.features = torch.empty(0, width)  # one tensor for all: one each would pickle them all with each

    def __len__(self) -> int:
        return len(self.features)

    def __deepcopy__(self, memo: dict[int, Any]) -> "KeptFeatures":
        """The same rows, shared: neither what finds them nor they are ever changed in place."""
        return copy.copy(self)

    def of(self, traces: Floats, compute: Callable[[Tensor], Tensor], keys: Sequence[bytes] | None = None) -> Tensor:
        """(n, C, T) -> (n, P); what is not among these traces is forgotten, as it has left the window."""
        keys = keys_of(traces) if keys is None else keys
        missing = {key: i for i, key in enumerate(keys) if key not in self.places}
        if missing:
            self.places = self.places | {key: len(self) + j for j, key in enumerate(missing)}
            self.features = torch.cat([self.features, compute(torch.from_numpy(traces[list(missing.values())]))])
        self.features = self.features[[self.places[key] for key in keys]]
        self.places = {key: i for i, key in enumerate(keys)}
        return self.features


def keys_of(traces: Floats) -> list[bytes]:
    """What each trace (n, C, T) is found by: the fastest digest of its exact samples; a fold's hash is of rounded ones."""
    return [sha1(trace, usedforsecurity=False).digest() for trace in traces]
