"""Arrays: archives of NumPy (.npz), HDF5 files, pairs (X, y) in memory, lists of traces of any length."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DataError, TraceError
from ..files import UNREADABLE, must_fit, read_archive
from ..traces import as_trace, is_time, spec_of
from .dataset import Asked, Dataset, Fault, UnreadableError, make_dataset
from .folders import FORCE, leave_out_other_rates
from .labels import label_of
from .lengths import Collected, Recorded, as_dataset, refit
from .text import rate_of, seconds_of

USED = ("X", "y", "scale", "rate_hz", "unit", "cause", "channels")


def read_npz(path: Path, name: str, asked: Asked) -> Dataset:
    """`X`, `y`, and what is known beside them: `scale`, `rate_hz`, `unit`, `cause`, `channels`, and the parts' numbers."""
    found, have = read_archive(path, (*USED, asked.part))
    try:
        return _from_arrays(found, have, path, name, asked)
    except (ValueError, TypeError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"Cannot read {path} as an .npz file of plain arrays: {error}.") from error


def read_hdf5(path: Path, name: str, asked: Asked) -> Dataset:
    """The same as data sets of an HDF5 file, by h5py."""
    if find_spec("h5py") is None:
        raise DataError('Expected h5py for HDF5 files, it is not installed: pip install "dengine[files]".')
    import h5py

    try:
        with h5py.File(path, "r") as file:
            have: list[str] = []
            file.visititems(lambda key, item: have.append(key) if isinstance(item, h5py.Dataset) else None)
            wanted = [key for key in have if key in (*USED, asked.part)]
            must_fit(sum(float(file[key].nbytes) for key in wanted), path)
            texts = {key for key in wanted if file[key].dtype.kind == "O"}
            found = {key: np.asarray(file[key].asstr()[()], np.str_) if key in texts else file[key][()] for key in wanted}
            return _from_arrays(found, have, path, name, asked)
    except UNREADABLE as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"Cannot read {path} as an HDF5 file: {error}.") from error


def _from_arrays(found: Mapping[str, Any], have: Sequence[str], path: Path, name: str, asked: Asked) -> Dataset:
    listed = ", ".join(have) or "none"
    if not {"X", "y"} <= set(found):
        raise DataError(f"Expected arrays X and y in {path}, found {listed}.")
    if asked.part != "part" and asked.part not in found:
        raise DataError(f"Expected an array {asked.part} in {path}, found {listed}.")
    X = found["X"]
    if "scale" in found:
        X = X.astype(np.float32) * found["scale"].astype(np.float32)
    rate, unit = float(found.get("rate_hz", 500.0)), str(found.get("unit", "N"))
    channels = tuple(map(str, np.atleast_1d(found["channels"]))) if "channels" in found else ()
    beside: dict[str, Any] = {"part": found.get(asked.part), "cause": found.get("cause"), "channels": channels}
    return refit(make_dataset(X, _labels(found["y"]), name=name, rate_hz=rate, unit=unit, **beside), asked)


def from_pair(X: Any, y: Any, asked: Asked) -> Dataset:
    """Traces in memory and their labels: one array, or a list of arrays, Series or DataFrames of any length."""
    if isinstance(X, list | tuple) or (isinstance(X, np.ndarray) and X.dtype.kind == "O" and X.ndim == 1):
        traces = list(X)
        if traces and not all(np.isscalar(each) for each in traces):
            return _from_list(traces, list(y), asked)
    return refit(make_dataset(X, _labels(y)), asked)


def _labels(y: Any) -> Any:
    """Labels as they came; words as 1 and 0."""
    try:
        words = np.asarray(y)
    except (ValueError, TypeError) as error:
        raise DataError(f"Expected a label for each trace, 1 (success) or 0 (failure), got others: {error}.") from error
    if words.dtype.kind not in "OUS" or words.ndim != 1:
        return words
    text = words.astype(np.str_) if words.dtype.kind == "S" else words
    try:
        return np.array([label_of(word) for word in text.tolist()], dtype=np.int8)
    except UnreadableError as error:
        raise DataError(f"{error.what}.") from error


def _from_list(traces: list[Any], labels: list[Any], asked: Asked) -> Dataset:
    if len(traces) != len(labels):
        raise DataError(f"Expected a label for each trace, got {len(traces)} traces and {len(labels)} labels.")
    has_force = any(FORCE in getattr(trace, "columns", ()) for trace in traces)
    found = Collected("data", asked.channels or ((FORCE,) if has_force else ()), [])
    for number, (trace, word) in enumerate(zip(traces, labels, strict=True), start=1):
        try:
            picked = _picked(trace, found.channels)
            x, label, rate = as_trace(picked, None), label_of(word), None if asked.rate_hz else _rate(trace)
            if found.read and len(x) != len(found.read[0].trace):
                raise UnreadableError(f"Expected {len(found.read[0].trace)} channel(s), as the first has, got {len(x)}")
        except (TraceError, UnreadableError) as error:
            found.faults.append(Fault("data", number, str(error).rstrip(".")))
            continue
        found.channels = found.channels or spec_of(x, picked).columns
        found.read.append(Recorded(x, label, f"trace {number}", None, rate))
    leave_out_other_rates(found)
    return as_dataset(found, asked)


def _rate(trace: Any) -> float | None:
    """Of a DataFrame of pandas, from its timestamps."""
    names = [name for name in trace.columns if is_time(str(name))] if hasattr(trace, "iloc") and trace.ndim == 2 else []
    return rate_of(seconds_of(trace[names[0]], str(names[0]))) if names else None


def _picked(trace: Any, channels: tuple[str, ...]) -> Any:
    """The named columns of a DataFrame; everything else as it is."""
    if not channels or not hasattr(trace, "columns"):
        return trace
    missing = [name for name in channels if name not in trace.columns]
    if missing:
        raise UnreadableError(f"Expected a column {missing[0]}, got {', '.join(map(str, trace.columns))[:100]}")
    return trace[list(channels)]
