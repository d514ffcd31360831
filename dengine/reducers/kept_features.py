"""Features of traces, computed once each: what costs most in a retrain does not change from one to the next."""

from __future__ import annotations

from collections.abc import Callable
from hashlib import blake2b

import torch
from torch import Tensor

from .base import Floats


class KeptFeatures:
    """A row of features (P,) a trace, found by the trace's exact samples: a fold's hash is of rounded ones.

    compute : traces (n, C, T) -> features (n, P).
    """

    def __init__(self, width: int) -> None:
        self.places: dict[bytes, int] = {}
        self.features = torch.empty(0, width)  # one tensor for all: one each would pickle them all with each

    def __len__(self) -> int:
        return len(self.features)

    def of(self, traces: Floats, compute: Callable[[Tensor], Tensor]) -> Tensor:
        """(n, C, T) -> (n, P); what is not among these traces is forgotten, as it has left the window."""
        keys = _keys(traces)
        self._add(traces, keys, len(traces), compute)
        self.features = self.features[[self.places[key] for key in keys]]
        self.places = {key: i for i, key in enumerate(keys)}
        return self.features

    def add(self, traces: Floats, most: int, compute: Callable[[Tensor], Tensor]) -> int:
        """Compute those of at most so many new traces; returns how many are still missing."""
        return self._add(traces, _keys(traces), most, compute)

    def _add(self, traces: Floats, keys: list[bytes], most: int, compute: Callable[[Tensor], Tensor]) -> int:
        missing = {key: i for i, key in enumerate(keys) if key not in self.places}
        new = dict(list(missing.items())[:most])
        if new:
            self.places |= {key: len(self) + j for j, key in enumerate(new)}
            self.features = torch.cat([self.features, compute(torch.from_numpy(traces[list(new.values())]))])
        return len(missing) - len(new)


def _keys(traces: Floats) -> list[bytes]:
    return [blake2b(trace, digest_size=16).digest() for trace in traces]
