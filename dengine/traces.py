"""Where a trace enters: its shape is checked, its type cast, its faults and its hash found.

A wrong shape is a caller's bug and raises. A NaN, a dead or saturated sensor is the world's fault: the part is verified.
"""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from .errors import DataError, TraceError, expect, listed
from .folds import CLAMP, QUANTUM, hash_weights
from .limits import ForceLimits
from .records import FITS, REASONS, Reason, TraceSpec

# What clocks are called, in the languages of recorders. Any word of a name, as in `header.stamp` or `Relative Time`;
# and names that say it only by themselves, as `ms`.
CLOCKS = {
    *("time", "times", "timestamps", "datetime", "stamp", "elapsed", "epoch", "clock", "date", "datum", "uhrzeit"),
    *("zeit", "temps", "heure", "tiempo", "hora", "tempo", "ora", "tijd", "tid", "czas", "čas", "время", "idő", "aika"),
    *("時間", "时间", "時刻", "时刻", "시간"),
}
ALONE = {
    *("t", "ms", "us", "µs", "ns", "sec", "secs", "second", "seconds", "msec", "usec", "nsec", "nsecs", "nanosec"),
    *("millis", "micros", "nanos", "milliseconds", "microseconds", "nanoseconds", "sekunden", "x value"),
}
AFTER_T = {f"t {word}" for word in (*ALONE, "s", "rel", "abs", "start")}
AFTER_NAME = re.compile(r"\s*([\[({<].*|(/|\bin )\s*[a-zµμ]{1,4}|\.\d+)$", re.IGNORECASE)  # a unit, or pandas' number
WORDS = re.compile(r"[A-Z]+(?![a-zµ])|[A-Z]?[^\W\d_A-Z]+")
NOT_FINITE, CONSTANT, SATURATED, TOO_LARGE = (
    REASONS.index(r) for r in (Reason.NOT_FINITE, Reason.CONSTANT, Reason.SATURATED, Reason.TOO_LARGE)
)
LARGEST = 1e18  # a sample: squares of larger ones overflow float32, or their sum over a trace does


def as_trace(trace: Any, spec: TraceSpec | None) -> NDArray[np.float32]:
    """One trace, (T,) or (channels, T) of any real dtype, as (C, T) float32; TraceError where it breaks the contract.

    A DataFrame is (T, channels), rows are samples: the contract's `columns`, or all but those of time. A Series is one
    channel. A length other than the contract's is dealt with as its `fit` says.
    """
    x = _as_real(trace if isinstance(trace, np.ndarray) else _without_frame(trace, spec))
    x = x[None, :] if x.ndim == 1 else x
    if x.ndim != 2 or x.size == 0:
        raise TraceError(f"Expected one trace, (samples,) or (channels, samples), got shape {np.shape(trace)}.")
    if spec is not None:
        x = _as_agreed(x, spec)
    elif len(x) > x.shape[1] and _is_frame(trace):
        got = f"{x.shape[1]} rows of {len(x)} columns; pass one row, as a Series, if each is a trace"
        raise TraceError(f"Expected a DataFrame of one trace, a row a sample, a column a channel, got {got}.")
    elif len(x) > x.shape[1]:
        got = f"{len(x)} channels of {x.shape[1]} samples, which looks transposed"
        do = f"turn it, trace.T, or agree on TraceSpec(samples={x.shape[1]}, channels={len(x)}) first if it is meant"
        raise TraceError(f"Expected (channels, samples), got {got}; {do}.")
    x = np.ascontiguousarray(x)
    return x if x.flags.writeable else x.copy()  # torch warns of what it could write to, a memory-mapped array for one


def as_traces(X: ArrayLike, spec: TraceSpec | None = None) -> NDArray[np.float32]:
    """Many traces, (n, T) or (n, channels, T), as (n, C, T) float32; TraceError where they break the contract.

    A length other than the contract's is dealt with as its `fit` says.
    """
    x = _as_real(X)
    x = x[:, None, :] if x.ndim == 2 else x
    if x.ndim != 3 or 0 in x.shape[1:]:
        raise TraceError(f"Expected traces (n, samples) or (n, channels, samples), got shape {np.shape(X)}.")
    if spec is not None:
        x = _as_agreed(x, spec)
    return np.ascontiguousarray(x)


def as_labels(y: ArrayLike) -> NDArray[np.int64]:
    """Labels (n,) as 1 (success) and 0 (failure); DataError where there is anything else among them."""
    labels = np.asarray(y)
    if not np.isin(labels, (0, 1)).all():
        raise DataError("Expected labels 1 (success) and 0 (failure), got others; turn them into these before they count.")
    return labels.astype(np.int64)


def spec_of(x: NDArray[np.float32], trace: Any = None) -> TraceSpec:
    """The contract that a first trace (C, T) sets; as it came, a DataFrame gives the channels their names."""
    columns = tuple(map(str, _channels(trace))) if _is_frame(trace) else ()
    return TraceSpec(samples=x.shape[1], channels=x.shape[0], columns=columns)


def fitted(x: Tensor, samples: int, fit: int) -> Tensor:
    """Traces (..., T) float32 of another length as (..., samples); `fit` is the position in `FITS`, not that of strict.

    Cut and pad keep the samples' times from the start, resample stretches the whole. A trace that is too short to be cut,
    or that has under half or over twice the samples wanted, is not made up: it keeps its first samples, and the missing
    ones, at least the last, are NaN, which `TraceGate` finds. Compiled into an exported decision as it stands here.
    """
    have = x.size(-1)
    last = have - 1
    honest = fits(have, samples, fit)
    if fit != 3 or not honest:
        taken = x.index_select(-1, torch.arange(samples).clamp(max=last))
        if not honest:
            taken[..., min(have, samples - 1) :].fill_(float("nan"))
        return taken
    at = torch.arange(samples, dtype=torch.float64) * (last / max(samples - 1, 1))
    left = at.floor().to(torch.int64).clamp(max=last)
    low = x.index_select(-1, left).to(torch.float64)
    high = x.index_select(-1, (left + 1).clamp(max=last)).to(torch.float64)
    return (low + (high - low) * (at - left)).to(torch.float32)


def fits(have: int, samples: int, fit: int) -> bool:
    """Whether a trace of so many samples can honestly be brought to others; `fit` is the position in `FITS`."""
    if fit == 0:
        return have == samples
    if fit == 1:
        return have >= samples
    return 2 * have >= samples and have <= 2 * samples


def is_time(name: str) -> bool:
    """Whether a column of this name says when, and is no channel: `%time`, `t [ms]`, `Zeit/s`, `header.stamp`, `t_ms`."""
    words = [word.lower() for word in WORDS.findall(AFTER_NAME.sub("", name.strip()))]
    if not CLOCKS.isdisjoint(words) or any("zeit" in word or word.endswith(("time", "stamp")) for word in words):
        return True
    return " ".join(words) in ALONE | AFTER_T


def _is_frame(trace: Any) -> bool:
    return hasattr(trace, "columns") and hasattr(trace, "to_numpy")


def _without_frame(trace: Any, spec: TraceSpec | None) -> Any:
    """A DataFrame's channels as (C, T), whatever package it is of; everything else as it is."""
    if not _is_frame(trace):
        return trace
    have = list(trace.columns)
    if spec is not None and spec.columns:
        missing = [name for name in spec.columns if name not in have]
        if missing:
            raise TraceError(f"Expected the columns {', '.join(spec.columns)}, got {listed(have)}.")
        return trace[list(spec.columns)].to_numpy().T
    names = _channels(trace)
    if not names or (spec is not None and len(names) != spec.channels):
        wanted = "at least one channel" if spec is None else f"{spec.channels} channel(s)"
        do = "pass the right ones, or name them, TraceSpec(columns=...)"
        raise TraceError(f"Expected a DataFrame with {wanted}, a column each, got the columns {listed(have)}; {do}.")
    return trace[names].to_numpy().T


def _channels(frame: Any) -> list[Any]:
    """The columns of a DataFrame that are not of time."""
    dated = {name for name in frame.columns if str(frame[name].dtype).lower().startswith(("date", "time"))}
    return [name for name in frame.columns if name not in dated and not is_time(str(name))]


def _as_real(values: ArrayLike) -> NDArray[np.float32]:
    try:
        array: NDArray[Any] = np.asarray(values)
    except (ValueError, TypeError) as error:
        raise TraceError(f"Expected real numbers, in rows of one length, got others: {error}.") from error
    if array.dtype == np.float32:
        return array  # as a controller sends it: the guard below costs a tenth of a decision
    if array.dtype.kind not in "fiub":
        raise TraceError(f"Expected real numbers, got dtype {array.dtype}; convert the trace to float32.")
    with np.errstate(over="ignore"):  # beyond float32 becomes an infinity, which is found and reported as one
        return array.astype(np.float32, copy=False)


def _as_agreed(x: NDArray[np.float32], spec: TraceSpec) -> NDArray[np.float32]:
    """(..., C, T) with the contract's channels and samples."""
    channels, samples = x.shape[-2:]
    if channels != spec.channels:
        turned = "; it looks transposed: turn it, trace.T" if (samples, channels) == (spec.channels, spec.samples) else ""
        raise TraceError(f"Expected {spec.channels} channel(s), got {channels}; pass (channels, samples){turned}.")
    if samples == spec.samples:
        return x
    if spec.fit == "strict":
        form = f"{spec.rate_hz:g} Hz x {spec.samples / spec.rate_hz:g} s"
        do = f"resample the trace to {form}, or start a new store with TraceSpec(samples={spec.samples}, fit='pad')"
        raise TraceError(f"Expected {spec.samples} samples, got {samples}; {do}.")
    return np.asarray(fitted(torch.from_numpy(np.array(x, order="C")), spec.samples, FITS.index(spec.fit)))


RARE, FAR, MOST = 0.1, 64.0, 1e15  # of `without_extremes`


def without_extremes(traces: NDArray[np.float32]) -> NDArray[np.float32]:
    """Clip what lies absurdly far out, so that one labelled trace cannot spoil a training.

    Parameters
    ----------
    traces : array of float32, shape (n, C, T)

    Returns
    -------
    array of float32, shape (n, C, T)
        The traces themselves where nothing had to be clipped. Each channel has a limit of its own, a
        power of four, at least 64 times what nine in ten traces keep, and at most 1e15, whose squares
        float32 can sum.
    """
    if not len(traces):
        return traces
    peaks = np.maximum(traces.max(axis=2), -traces.min(axis=2)).astype(np.float64)  # (n, C)
    usual = np.quantile(peaks, 1.0 - RARE, axis=0, method="lower")
    with np.errstate(divide="ignore"):  # a channel that is silent in nearly all has the largest limit
        limits = np.where(usual > 0.0, 4.0 ** np.ceil(np.log2(FAR * usual) / 2.0), MOST).clip(max=MOST)
    if (peaks <= limits).all():
        return traces
    return np.clip(traces, -limits[:, None], limits[:, None]).astype(np.float32)


class TraceGate(nn.Module):
    """A trace's faults and its content hash, scripted: one implementation for the engine and the exported file."""

    quantum: Tensor
    weights: Tensor

    def __init__(self, spec: TraceSpec) -> None:
        super().__init__()
        self.limit = float("inf") if spec.limit is None else float(spec.limit)
        self.clamp = float(CLAMP)
        self.not_finite, self.constant, self.saturated = NOT_FINITE, CONSTANT, SATURATED
        self.too_large, self.largest = TOO_LARGE, LARGEST
        self.register_buffer("quantum", torch.tensor(QUANTUM))  # a plain number becomes one at each product
        self.register_buffer("weights", torch.from_numpy(hash_weights(spec.channels * spec.samples)))

    def forward(self, x: Tensor) -> tuple[int, int]:
        """(C, T) float32 -> position in `Reason` (0: no fault), int64 content hash (`folds.content_hash`)."""
        return self.check(x, self.limit)

    @torch.jit.export
    def check(self, x: Tensor, limit: float) -> tuple[int, int]:
        """The same by another limit of the sensor's range."""
        lowest, highest = torch.aminmax(x)
        low, high = float(lowest.item()), float(highest.item())  # a NaN anywhere comes out of aminmax as NaN
        reason = 0
        if not (low > -float("inf") and high < float("inf")):
            reason = self.not_finite
            x = torch.nan_to_num(x, 0.0, 0.0, 0.0)
        elif low == high:
            reason = self.constant
        elif max(high, -low) >= limit:
            reason = self.saturated
        elif max(high, -low) > self.largest:
            reason = self.too_large
        if not max(high, -low) <= self.clamp:  # a NaN among them tells nothing of the others
            x = x.clamp(-self.clamp, self.clamp)
        steps = (x.view(-1) * self.quantum).floor_().to(torch.int64)  # exact in float32: the quantum is a power of two
        return reason, int(torch.dot(steps, self.weights).item())


class ForceLimitsGate(nn.Module):
    """An operator's windows, scripted, for the engine and the exported file; SettingError where traces cannot hold them."""

    limits: Tensor
    channels: Tensor
    action: Tensor
    time: Tensor

    def __init__(self, windows: Sequence[ForceLimits], spec: TraceSpec) -> None:
        super().__init__()
        time = torch.tensor([[i / spec.rate_hz for i in range(spec.samples)]])
        known: dict[Any, int] = {None: spec.channels}  # time stands behind the channels
        known |= {name: i for names in (range(spec.channels), spec.columns) for i, name in enumerate(names)}
        form = f"{spec.channels} x {spec.samples} samples at {spec.rate_hz:g} Hz {listed(spec.columns)}".rstrip()
        for each in windows:
            start, end = torch.tensor([each.start, each.end])  # between two samples nothing would pass
            there = each.along is not None or bool(((time >= start) & (time <= end)).any())
            expect(there and {each.channel, each.along} <= known.keys(), f"a window on some of {form}", str(each))
        self.watches = len(windows) > 0
        rows = [(each.start, each.end, each.low, each.high) for each in windows]
        pairs = [(known[each.channel], known[each.along]) for each in windows]
        self.register_buffer("limits", torch.tensor(rows, dtype=torch.float32).reshape(-1, 4, 1))
        self.register_buffer("channels", torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2))
        self.register_buffer("action", torch.tensor([1 + each.reject for each in windows], dtype=torch.int64))
        self.register_buffer("time", time)  # (1, T)

    def forward(self, x: Tensor) -> int:
        """(C, T) float32 -> 0 within every window, 1 outside of one, 2 outside of one that rejects."""
        if not self.watches:
            return 0
        start, end, low, high = self.limits.unbind(1)  # (W, 1)
        values, where = torch.cat([x, self.time])[self.channels].unbind(1)  # (W, T)
        there = (where >= start) & (where <= end)
        kept = there.any(1) & ~(there & ((values < low) | (values > high))).any(1)
        return int(torch.where(kept, 0, self.action).max().item())


LEAST = 10  # samples of a trace that sets a contract: 20 ms at 500 Hz, and a picture of nothing


def as_agreed(trace: Any, spec: TraceSpec | None, may_start_over: bool) -> NDArray[np.float32]:
    """`as_trace`; may_start_over : the contract was set by the first trace, and no label was reported on it yet."""
    try:
        return as_trace(trace, spec)
    except TraceError as error:
        if not may_start_over or spec is None:
            raise
        form = f"{error} The contract, {spec.channels} x {spec.samples}, was set by the first trace"
        do = f"if that trace was the wrong one, start over with a new store and {_contract(trace)}"
        raise TraceError(f"{form}, and nothing was learned by it yet: {do}.") from error


def _contract(trace: Any) -> str:
    """How to agree on the form of a trace."""
    *channels, samples = np.shape(trace)
    return f"DataEngine(trace=TraceSpec(samples={samples}, channels={channels[0] if channels else 1}))"


def first_contract(x: NDArray[np.float32], trace: Any) -> tuple[TraceSpec, bool]:
    """The contract that a first trace (C, T), before it was cast `trace`, would set; and whether it is fit to set it.

    TraceError for one of fewer than LEAST samples.
    """
    spec = spec_of(x, trace)
    if spec.samples < LEAST:
        wanted = f"a first trace of {LEAST} samples or more, for it sets the contract of all that follow"
        do = f"record longer, or start with {_contract(x)} if it is meant"
        raise TraceError(f"Expected {wanted}, got {spec.channels} x {spec.samples}; {do}.")
    return spec, TraceGate(spec)(torch.from_numpy(x))[0] == 0
