"""Features of traces, computed once each: what costs most in a retrain does not change from one to the next.

>>> kept = KeptFeatures(width)
>>> kept.of(traces, compute).shape     # (n, width); only what was not there is computed
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from hashlib import sha1
from typing import Any

import torch
from torch import Tensor

from .base import Floats


class KeptFeatures:
    """A row of features (P,) a trace, found by its key.

    compute : traces (n, C, T) -> features (n, P).
    """

    def __init__(self, width: int) -> None:
        self.places: dict[bytes, int] = {}
        self.features = torch.empty(0, width)  # one tensor for all: one each would pickle them all with each

    def __len__(self) -> int:
        return len(self.features)

    def __deepcopy__(self, memo: dict[int, Any]) -> KeptFeatures:
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
