"""Traces as they come in: shapes and types are converted, and faults are found. The engine, the
readers of data sets and exported models check traces by this module.

`as_trace` and `as_traces` convert what a caller gives to float32 arrays by a `TraceSpec`. A wrong
shape is the caller's bug and raises TraceError. `TraceGate` finds what is wrong with a trace of the
right shape, a NaN, a dead or a saturated sensor, and `ForceLimitsGate` whether it leaves the
operator's limits: such a part is verified or rejected. Both are scripted into exported files.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from .errors import DataError, SettingError, TraceError, expect, listed
from .folds import CLAMP, QUANTUM, hash_weights
from .limits import ForceLimits
from .records import FITS, REASONS, ActionCode, Ints, Reason, TraceArray, TraceSpec

NOT_FINITE = REASONS.index(Reason.NOT_FINITE)
CONSTANT = REASONS.index(Reason.CONSTANT)
SATURATED = REASONS.index(Reason.SATURATED)
TOO_LARGE = REASONS.index(Reason.TOO_LARGE)
LARGEST = 1e18  # of a sample; in float32 the squares of larger ones overflow, or their sum does
MIN_SAMPLES = 10  # of a first trace


def as_trace(trace: Any, trace_spec: TraceSpec | None) -> TraceArray:
    """Convert one trace to float32 of shape (channels, samples).

    Parameters
    ----------
    trace : array, shape (samples,) or (channels, samples)
        Of any real dtype, or booleans. Without an axis of channels it has one channel. A value too
        large for float32 becomes an infinity.
    trace_spec : TraceSpec or None
        What the trace must look like. Another length is fitted as `trace_spec.fit` says (cut, pad
        or resample; strict allows none), into a copy. None: any shape with no more channels than
        samples, and with at least one sample.

    Returns
    -------
    array of float32, shape (C, T)
        Contiguous and writeable. It shares its memory with `trace` if that is such an array, and
        its length is not fitted. `trace` is never changed.

    Raises
    ------
    TraceError
        For a trace of another shape, for a length that `trace_spec.fit` does not allow, for rows
        of different lengths, and for values that are no real numbers. NaN and infinities pass;
        `TraceGate` finds them.
    """
    x = _with_channels(trace, 2, "one trace, (samples,) or (channels, samples)")
    channels, samples = x.shape
    if trace_spec is not None:
        x = _match_spec(x, trace_spec)
    elif channels > samples:
        raise TraceError(
            f"Expected (channels, samples), got {channels} channels of {samples} samples, which "
            f"looks transposed; turn it, trace.T, or agree on TraceSpec(samples={samples}, "
            f"channels={channels}) first if it is meant."
        )
    x = np.ascontiguousarray(x)
    return x if x.flags.writeable else x.copy()  # torch warns of read-only, memory-mapped arrays


def as_traces(X: ArrayLike, trace_spec: TraceSpec | None = None) -> TraceArray:
    """Convert many traces to float32 of shape (n, channels, samples).

    Parameters
    ----------
    X : array, shape (n, samples) or (n, channels, samples)
        Of any real dtype, or booleans. n may be 0, but not the other axes. (n, samples) has one
        channel. A value too large for float32 becomes an infinity.
    trace_spec : TraceSpec, optional
        What the traces must look like; another length is fitted as `trace_spec.fit` says (cut, pad
        or resample; strict allows none). None: any shape, also one with more channels than samples.

    Returns
    -------
    array of float32, shape (n, C, T)
        Contiguous; it may share its memory with X, if that is float32 already, and is then
        read-only if X is.

    Raises
    ------
    TraceError
        For another shape, a length that `trace_spec.fit` does not allow, traces of different
        lengths, or values that are no real numbers. NaN and infinities pass.
    """
    x = _with_channels(X, 3, "traces (n, samples) or (n, channels, samples)")
    if trace_spec is not None:
        x = _match_spec(x, trace_spec)
    return np.ascontiguousarray(x)


def as_labels(y: ArrayLike) -> Ints:
    """Convert labels, shape (n,), to int64: 1 for success, 0 for failure; booleans are accepted.

    Floats 1.0 and 0.0 are accepted, too. The result is a new array of the same shape, empty for no
    labels. Raises DataError if there is any other value, such as NaN, -1 or the text "1".
    """
    labels = np.asarray(y)
    if not np.isin(labels, (0, 1)).all():
        raise DataError(
            "Expected labels 1 (success) and 0 (failure), got others; turn them into these before "
            "they count."
        )
    return labels.astype(np.int64)


def fit_length(x: Tensor, samples: int, fit: int) -> Tensor:
    """Fit traces of another length to a number of samples.

    The function is compiled by TorchScript into exported files.

    Parameters
    ----------
    x : Tensor of float32, shape (..., T)
    samples : int
        The length to return; the caller has checked with `can_fit_length` that it is possible.
    fit : int
        1 "cut", 2 "pad" or 3 "resample", the position in `FITS`. The first two keep each sample's
        time from the start: both drop the end of a longer trace, and "pad" repeats the last sample
        of a shorter one. "resample" interpolates the whole trace linearly; its first and its last
        sample stay the first and the last.

    Returns
    -------
    Tensor of float32, shape (..., samples)
        A copy, also if the length is the same. Nothing is checked here.
    """
    last = x.size(-1) - 1
    if fit != 3:
        return x.index_select(-1, torch.arange(samples).clamp(max=last))
    position = torch.arange(samples, dtype=torch.float64) * (last / max(samples - 1, 1))
    left = position.floor().to(torch.int64).clamp(max=last)
    low = x.index_select(-1, left).to(torch.float64)
    high = x.index_select(-1, (left + 1).clamp(max=last)).to(torch.float64)
    return (low + (high - low) * (position - left)).to(torch.float32)


def can_fit_length(length: int, samples: int, fit: int) -> bool:
    """Return whether a trace of `length` samples may be fitted to a length of `samples`.

    `fit` is a position in `FITS`: 0 "strict" allows only the same length, 1 "cut" the same or a
    greater length, 2 "pad" and 3 "resample" allow half to twice `samples`, both included.
    """
    if fit == 0:
        return length == samples
    if fit == 1:
        return length >= samples
    return 2 * length >= samples and length <= 2 * samples


def _with_channels(values: ArrayLike, ndim: int, wanted: str) -> TraceArray:
    """Convert numbers or booleans to float32, with an axis of channels before the samples.

    A float32 array is not copied, and a value too large for float32 becomes an infinity. The result
    has `ndim` axes; if only the axis of channels is missing, there is one channel. Raises
    TraceError, whose message says that `wanted` was expected, for another number of axes, and for
    no channel or sample. Raises TraceError for values that are no real numbers and for rows of
    different lengths, too.
    """
    try:
        x: NDArray[Any] = np.asarray(values)
    except (ValueError, TypeError) as error:
        raise TraceError(
            f"Expected real numbers, in rows of one length, got others: {error}."
        ) from error
    if x.dtype.kind not in "fiub":
        raise TraceError(
            f"Expected real numbers, got dtype {x.dtype}; convert the trace to float32."
        )
    # Controllers send float32: they are spared the guard, which costs a tenth of a decision.
    if x.dtype != np.float32:
        with np.errstate(over="ignore"):  # an overflow is an infinity, which `TraceGate` finds
            x = x.astype(np.float32)
    if x.ndim == ndim - 1:
        x = np.expand_dims(x, -2)
    if x.ndim != ndim or 0 in x.shape[-2:]:
        raise TraceError(f"Expected {wanted}, got shape {np.shape(values)}.")
    return x


def _match_spec(x: TraceArray, trace_spec: TraceSpec) -> TraceArray:
    """Return traces (..., C, T) fitted to the number of samples of a `TraceSpec`.

    Traces of that length are returned as they are; of others a fitted copy is returned, as
    `trace_spec.fit` says (cut, pad or resample; strict allows none). Raises TraceError for another
    number of channels and for a length that cannot be fitted so: cut takes no shorter traces, pad
    and resample take those of half to twice that number of samples.
    """
    channels, samples = x.shape[-2:]
    if channels != trace_spec.channels:
        raise TraceError(
            f"Expected {trace_spec.channels} channel(s), got {channels}; pass (channels, samples)."
        )
    n = trace_spec.samples
    if samples == n:
        return x
    fit = FITS.index(trace_spec.fit)
    if not can_fit_length(samples, n, fit):
        raise TraceError(
            f"Expected {n} samples, got {samples}, which fit={trace_spec.fit!r} does not allow; "
            f"resample the trace to {n} samples, or choose another fit for a new store."
        )
    return np.asarray(fit_length(torch.from_numpy(np.array(x, order="C")), n, fit))


# Of `clip_extremes`.
RARE = 0.1
FAR = 64.0
MOST = 1e15


def clip_extremes(traces: TraceArray) -> TraceArray:
    """Clip samples that are far larger than usual, so that no single trace spoils a training.

    Parameters
    ----------
    traces : array of float32, shape (n, C, T)
        Finite.

    Returns
    -------
    array of float32, shape (n, C, T)
        The same array if nothing was clipped or n is 0, else a copy. Each channel has its own limit
        for the absolute value of a sample. The peak of a trace is the greatest absolute value in
        the channel. The limit is the least power of four that is at least 64 times the 90 %
        quantile of the peaks (of the two nearest peaks the lower), but at most 1e15, so that
        float32 can sum squares. If that quantile is 0, the limit is 1e15.
    """
    if not len(traces):
        return traces
    peaks = np.maximum(traces.max(axis=2), -traces.min(axis=2)).astype(np.float64)  # (n, C)
    usual = np.quantile(peaks, 1.0 - RARE, axis=0, method="lower")
    with np.errstate(divide="ignore"):  # a channel that is zero in nearly all: the largest limit
        powers = 4.0 ** np.ceil(np.log2(FAR * usual) / 2.0)
    limits = np.where(usual > 0.0, powers, MOST).clip(max=MOST)
    if (peaks <= limits).all():
        return traces
    return np.clip(traces, -limits[:, None], limits[:, None]).astype(np.float32)


class TraceGate(nn.Module):
    """Finds the faults of a trace and its content hash.

    The engine and exported files run this one module, scripted.

    Parameters
    ----------
    size : int
        Number of samples of a trace, all channels together.
    """

    quantum: Tensor
    weights: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.clamp = CLAMP
        self.not_finite = NOT_FINITE
        self.constant = CONSTANT
        self.saturated = SATURATED
        self.too_large = TOO_LARGE
        self.largest = LARGEST
        # A buffer, for a plain number would become a tensor at each product.
        self.register_buffer("quantum", torch.tensor(QUANTUM))
        self.register_buffer("weights", torch.from_numpy(hash_weights(size)))

    def forward(self, x: Tensor, limit: float = float("inf")) -> tuple[int, int]:
        """Find the first fault of a trace, and hash its samples; `limit` is the sensor's range.

        Parameters
        ----------
        x : Tensor of float32, shape (C, T)
            Contiguous, with `size` samples in all. It is not changed.
        limit : float
            Range of the sensor, like `TraceSpec.limit`; infinity: no range is checked.

        Returns
        -------
        reason : int
            Position in `REASONS`, the tuple of all `Reason`, of the first fault found: not finite,
            constant (all samples of all channels are equal), saturated (a sample at or beyond
            ±`limit`) or too large (beyond 1e18); 0 if there is none.
        content_hash : int
            Hash of the samples, 64 bits, by which equal traces are known; it is equal to that of
            `folds.content_hash`. A faulty trace has one, too: NaN and infinities count as 0.
        """
        lowest, highest = torch.aminmax(x)
        low = float(lowest.item())  # NaN if there is one anywhere in the trace
        high = float(highest.item())
        size = max(high, -low)
        reason = 0
        if not (low > -float("inf") and high < float("inf")):
            reason = self.not_finite
            x = torch.nan_to_num(x, 0.0, 0.0, 0.0)
        elif low == high:
            reason = self.constant
        elif size >= limit:
            reason = self.saturated
        elif size > self.largest:
            reason = self.too_large
        if not size <= self.clamp:  # true of NaN as well
            x = x.clamp(-self.clamp, self.clamp)
        # Exact in float32, for the quantum is a power of two.
        steps = (x.view(-1) * self.quantum).floor_().to(torch.int64)
        return reason, int(torch.dot(steps, self.weights).item())


def check_rate(force_limits: Sequence[ForceLimits], trace_spec: TraceSpec | None) -> None:
    """Raise SettingError if a force limit is in seconds and the rate of the traces is unknown.

    Force limits are an operator's limits of a channel within a stretch of time, which is always in
    seconds, or of the values of another channel, `along`; only the latter need no rate. If
    `trace_spec` is None, the rate is unknown, too: the `TraceSpec` will be inferred from the first
    trace, which does not tell its rate.
    """
    in_seconds = [limits for limits in force_limits if limits.along is None]
    if in_seconds and (trace_spec is None or trace_spec.rate_hz is None):
        raise SettingError(
            "Expected the rate of the traces, because force limits are in seconds "
            f"({listed(in_seconds)}), got an unknown one; state time.rate_hz of recordings, or "
            "start with TraceSpec(samples=..., rate_hz=...)."
        )


WITHIN_LIMITS = -1  # in place of an `ActionCode`


class ForceLimitsGate(nn.Module):
    """Finds whether a trace leaves the operator's limits.

    The engine and exported files run this one module, scripted. It compares in float32, the times
    included. A channel is named by its index or by the name of its column.

    Parameters
    ----------
    force_limits : sequence of ForceLimits
    trace_spec : TraceSpec
        Shape of the traces, their rate and the names of their columns.

    Raises
    ------
    SettingError
        If no trace can keep a limit: its channel does not exist, or no sample is in its stretch of
        time; and for a limit in seconds while the rate is unknown.
    """

    limits: Tensor
    channels: Tensor
    action: Tensor
    time: Tensor

    def __init__(self, force_limits: Sequence[ForceLimits], trace_spec: TraceSpec) -> None:
        super().__init__()
        self.within = WITHIN_LIMITS
        check_rate(force_limits, trace_spec)
        rate = trace_spec.rate_hz or 1.0  # if it is unknown, no limit reads the times
        time = torch.tensor([[i / rate for i in range(trace_spec.samples)]])
        rows: dict[Any, int] = {None: trace_spec.channels}  # time is the row behind the channels
        rows |= {i: i for i in range(trace_spec.channels)}
        rows |= {name: i for i, name in enumerate(trace_spec.columns)}
        shape = f"{trace_spec.channels} x {trace_spec.samples} samples"
        shape += f" at {rate:g} Hz" if trace_spec.rate_hz else ""
        wanted = f"force limits on some of {shape} {listed(trace_spec.columns)}".rstrip()
        for item in force_limits:
            start, end = torch.tensor([item.start, item.end])
            has_samples = item.along is not None or bool(((time >= start) & (time <= end)).any())
            expect(has_samples and {item.channel, item.along} <= rows.keys(), wanted, str(item))
        limits = [(item.start, item.end, item.low, item.high) for item in force_limits]
        channels = [(rows[item.channel], rows[item.along]) for item in force_limits]
        action = [ActionCode.REJECT if item.reject else ActionCode.VERIFY for item in force_limits]
        self.register_buffer("limits", torch.tensor(limits, dtype=torch.float32).reshape(-1, 4, 1))
        self.register_buffer("channels", torch.tensor(channels, dtype=torch.int64).reshape(-1, 2))
        self.register_buffer("action", torch.tensor(action, dtype=torch.int64))
        self.register_buffer("time", time)  # (1, T)

    def forward(self, x: Tensor) -> int:
        """Check whether a trace, float32 (C, T), keeps the operator's limits of its channels.

        Returns WITHIN_LIMITS (-1) if it keeps all limits, or if there are none; else the
        `ActionCode`: 2 (REJECT) if it leaves a limit with `reject`, otherwise 0 (VERIFY, the part
        is checked). A limit bounds the values of a channel in a stretch, from `start` to `end` of
        the time, or of the channel `along`; a trace that has no sample in the stretch leaves the
        limit. A value that is NaN leaves no limit; a sample whose value in the channel `along` is
        NaN lies in no stretch.
        """
        if self.limits.size(0) == 0:
            return self.within
        start, end, low, high = self.limits.unbind(1)  # (W, 1) each
        values, where = torch.cat([x, self.time])[self.channels].unbind(1)  # (W, T) each
        inside = (where >= start) & (where <= end)
        broken = inside & ((values < low) | (values > high))
        kept = inside.any(1) & ~broken.any(1)
        return int(torch.where(kept, self.within, self.action).max().item())


def infer_trace_spec(x: TraceArray) -> tuple[TraceSpec, bool]:
    """Infer the `TraceSpec` of all traces from the shape of the first one.

    Only samples and channels are taken from the trace. All other fields have the defaults of
    `TraceSpec`, so that rate and unit are unknown.

    Parameters
    ----------
    x : array of float32, shape (C, T)
        The trace after `as_trace`.

    Returns
    -------
    trace_spec : TraceSpec
    is_faultless : bool
        Whether the trace has no fault: all samples are finite, none is beyond 1e18, and they are
        not all equal. The `TraceSpec` of a faulty trace should not be kept.

    Raises
    ------
    TraceError
        For a trace of fewer than 10 samples per channel.
    """
    channels, samples = x.shape
    if samples < MIN_SAMPLES:
        raise TraceError(
            f"Expected a first trace of {MIN_SAMPLES} samples or more, for it sets the TraceSpec "
            f"of all that follow, got {channels} x {samples}; record longer, or start with "
            f"DataEngine(trace=TraceSpec(samples={samples}, channels={channels})) if it is meant."
        )
    reason, _ = TraceGate(x.size)(torch.from_numpy(x))
    return TraceSpec(samples, channels=channels), reason == 0
