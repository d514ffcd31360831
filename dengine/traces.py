"""Where a trace enters: its shape is checked, its type cast, its faults and its hash found.

A wrong shape is a caller's bug and raises. A NaN, a dead sensor or a saturated one is the world's fault: it gets a
reason, the part is verified, and the cell goes on.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from .errors import TraceError
from .folds import CLAMP, QUANTUM, hash_weights
from .records import REASONS, Reason, TraceSpec

NOT_FINITE, CONSTANT, SATURATED = (REASONS.index(r) for r in (Reason.NOT_FINITE, Reason.CONSTANT, Reason.SATURATED))


def as_trace(trace: ArrayLike, spec: TraceSpec | None) -> NDArray[np.float32]:
    """One trace, (T,) or (channels, T) of any real dtype, as (C, T) float32; TraceError where it breaks the contract."""
    x = _as_real(trace)
    x = x[None, :] if x.ndim == 1 else x
    if x.ndim != 2 or x.size == 0:
        raise TraceError(f"Expected one trace, (samples,) or (channels, samples), got shape {np.shape(trace)}.")
    if spec is not None:
        _check(x.shape, spec)
    x = np.ascontiguousarray(x)
    return x if x.flags.writeable else x.copy()  # torch warns of what it could write to, a memory-mapped array for one


def as_traces(X: ArrayLike, spec: TraceSpec | None = None) -> NDArray[np.float32]:
    """Many traces, (n, T) or (n, channels, T), as (n, C, T) float32; TraceError where they break the contract."""
    x = _as_real(X)
    x = x[:, None, :] if x.ndim == 2 else x
    if x.ndim != 3 or 0 in x.shape[1:]:
        raise TraceError(f"Expected traces (n, samples) or (n, channels, samples), got shape {np.shape(X)}.")
    if spec is not None:
        _check(x.shape[1:], spec)
    return np.ascontiguousarray(x)


def spec_of(x: NDArray[np.float32]) -> TraceSpec:
    """The contract that a first trace (C, T) sets."""
    return TraceSpec(samples=x.shape[1], channels=x.shape[0])


def _as_real(values: ArrayLike) -> NDArray[np.float32]:
    array: NDArray[Any] = np.asarray(values)
    if array.dtype == np.float32:
        return array  # as a controller sends it: the guard below costs a tenth of a decision
    if array.dtype.kind not in "fiub":
        raise TraceError(f"Expected real numbers, got dtype {array.dtype}; convert the trace to float32.")
    with np.errstate(over="ignore"):  # beyond float32 becomes an infinity, which is found and reported as one
        return array.astype(np.float32, copy=False)


def _check(shape: tuple[int, ...], spec: TraceSpec) -> None:
    channels, samples = shape
    if channels != spec.channels:
        raise TraceError(
            f"Expected {spec.channels} channel(s), got {channels}; pass (channels, samples), all channels of the contract."
        )
    if samples != spec.samples:
        seconds = spec.samples / spec.rate_hz
        raise TraceError(
            f"Expected {spec.samples} samples, got {samples}; resample the trace to {spec.rate_hz:g} Hz x {seconds:g} s."
        )


class TraceGate(nn.Module):
    """A trace's faults and its content hash, scripted: one implementation for the engine and the exported file."""

    weights: Tensor

    def __init__(self, spec: TraceSpec) -> None:
        super().__init__()
        self.limit = float("inf") if spec.limit is None else float(spec.limit)
        self.clamp = float(CLAMP)
        self.quantum = float(QUANTUM)
        self.not_finite, self.constant, self.saturated = NOT_FINITE, CONSTANT, SATURATED
        self.register_buffer("weights", torch.from_numpy(hash_weights(spec.channels * spec.samples)))

    def forward(self, x: Tensor) -> tuple[int, int]:
        """(C, T) float32 -> position in `Reason` (0: no fault), int64 content hash (`folds.content_hash`)."""
        lowest, highest = torch.aminmax(x)
        low, high = float(lowest.item()), float(highest.item())  # a NaN anywhere comes out of aminmax as NaN
        reason = 0
        if not (low > -float("inf") and high < float("inf")):
            reason = self.not_finite
            x = torch.nan_to_num(x, 0.0, 0.0, 0.0)
        elif low == high:
            reason = self.constant
        elif max(high, -low) >= self.limit:
            reason = self.saturated
        if not max(high, -low) <= self.clamp:  # a NaN among them tells nothing of the others
            x = x.clamp(-self.clamp, self.clamp)
        steps = (x.flatten() * self.quantum).floor_().to(torch.int64)  # exact in float32: the quantum is a power of two
        return reason, int(torch.dot(steps, self.weights).item())
