"""One door for all that holds labelled traces, `load_dataset`; and what is read from arrays."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DataError, TraceError
from ..files import is_database, must_fit, read_archive, reading
from ..records import trace_in
from ..traces import as_trace, is_time, spec_of
from .bags import is_stream, read_bag
from .dataset import Asked, Collected, Dataset, Fault, Recorded, UnreadableError, as_dataset, make_dataset, names_of, refit
from .labels import label_of
from .tables import FORCE, from_frame, read_csv, read_folder, read_parquet
from .text import rate_of, seconds_of
from .triggers import Trigger

BUNDLED = {"insertion": "insertion.npz"}
USED = ("X", "y", "scale", "rate_hz", "unit", "cause", "channels")  # arrays, beside that of the parts' numbers
Reader = Callable[[Path, str, Asked], Dataset]
TABLES: dict[str, Reader] = {".csv": read_csv, ".parquet": read_parquet, ".pq": read_parquet}


def load_dataset(
    source: Any = "insertion",
    samples: int | None = None,
    part: str = "part",
    *,
    channel: str | Sequence[str] | None = None,
    label: str | None = None,
    labels: str | os.PathLike[str] | None = None,
    fit: str | None = None,
    rate_hz: float | None = None,
    trigger: Trigger | str | None = None,
    topic: str | None = None,
) -> Dataset:
    """A data set from recordings as people have them.

    source : the name of a bundled set; a folder of CSV files, one an insertion; a wide table, a row an insertion, as .csv,
        .parquet or a DataFrame; one long recording as .mcap, or a rosbag2 folder of them; an .npz or HDF5 file with
        X (n, T) or (n, C, T), times the number `scale` where one is stored, and y (n,); the SQLite file of a store, for the
        labelled traces in it; a `Dataset`; a pair (X, y), where X may be a list of traces of any length.
    samples : of each trace, the first so many; with `fit="resample"` the points that the whole is put on.
    part : the name of the array, or column, of parts' numbers, texts or whole numbers; for a folder a column of `labels`.
        Where there is no `part`, every trace is a part of its own.
    channel : "FZ_Base", or several, "FZ_Base,FX_Base", which give (n, C, T). Not given: FZ_Base, or the only one there is.
    label : for a folder, a regular expression with one group that finds the label in a file's path; not given: True/False,
        OK/NOK, pass/fail, good/bad, success/failure or 1/0 at the end of its name, or as its folder's. For a table, the
        name of the column.
    labels : for a folder, a CSV file with a column of file names and one of labels.
    fit : what becomes of traces of another length, as in `TraceSpec`. Not given: recordings of one length stay as they
        are (strict); of several lengths, "pad" to their median; where all have the `samples` asked for, "cut".
    rate_hz : instead of what the timestamps tell, which are then not looked at.
    trigger : of one long recording, when an insertion begins, a `Trigger` or its text (`as_trigger`).  topic : of its
        wrench, where there are several. Its channels are FX ... MZ, FZ if not given; its `label` is the topic that tells
        them, and its file of `labels` names the insertions by number. Not given, `samples` is two seconds.

    A recording that cannot be read, or not honestly be fitted, becomes a `Fault` in `faults`, and the others are kept. A
    number that is missing is a NaN, which the engine finds. `spec` is the contract for live traces of the same form.
    Raises DataError where nothing can be read, or the options do not fit what is there.
    """
    asked = Asked(samples, part, names_of(channel), label, labels, fit, rate_hz, trigger, topic)
    what, takes, read = _reader(source, asked)
    told = {"label": label, "labels": labels, "trigger": trigger, "topic": topic}
    idle = [name for name, value in told.items() if value is not None and name not in takes]
    if idle:
        why = "only one long recording is cut" if "trigger" in idle or "topic" in idle else "it has its labels"
        raise DataError(f"Expected no {' or '.join(idle)} for {what}: {why}; leave it out.")
    return read()


def _reader(source: Any, asked: Asked) -> tuple[str, Sequence[str], Callable[[], Dataset]]:
    """What a source is called, which of the options about labels and triggers say something to it, and what reads it."""
    if isinstance(source, Dataset):
        return "a Dataset", (), partial(refit, source, asked)
    if isinstance(source, tuple) and len(source) == 2:
        return "a pair (X, y)", (), partial(_from_pair, *source, asked)
    if hasattr(source, "columns"):
        return "a DataFrame", ("label",), partial(from_frame, source, asked)
    if not isinstance(source, str | os.PathLike):
        got = type(source).__name__
        raise DataError(f"Expected a name, a path, a Dataset, a DataFrame or a pair (X, y), got {got}.")
    if str(source) in BUNDLED:
        path = Path(str(files("dengine"))) / "data" / BUNDLED[str(source)]
        return "a bundled set", (), partial(_read_npz, path, str(source), asked)
    path = Path(source)
    takes, read = _reader_of_files(path)
    return str(path), takes, partial(read, path, path.resolve().name if path.is_dir() else path.stem, asked)


def _reader_of_files(path: Path) -> tuple[Sequence[str], Reader]:
    suffix = path.suffix.lower()
    if is_stream(path):
        return ("label", "labels", "trigger", "topic"), read_bag
    if path.is_dir():
        return ("label", "labels"), read_folder
    if not path.is_file():
        raise DataError(
            f"Expected a data set among {', '.join(BUNDLED)}, a file (.npz, .csv, .parquet, .h5, .mcap), a store, or a "
            f"folder of CSV files; {path} is neither."
        )
    if is_database(path):
        return (), _read_store
    if suffix in TABLES:
        return ("label",), TABLES[suffix]
    if suffix in (".h5", ".hdf5"):
        return (), _read_hdf5
    if suffix == ".npz" or zipfile.is_zipfile(path):
        return (), _read_npz
    raise DataError(f"Expected a file .npz, .csv, .parquet, .h5 or .mcap, got {path}; save it as one of these.")


def _read_store(path: Path, name: str, asked: Asked) -> Dataset:
    """Every labelled trace of a store, in the order of the labels, as they count now, without bad and forgotten ones."""
    from ..store.opening import opening

    with opening(path, must_exist=True) as store:
        held, spec = store.labelled(), trace_in(store.settings())
    store.close()
    if spec is None or not len(held.labels):
        raise DataError(f"Expected a store with labelled traces, {path} has none; record some first, as in shadow mode.")
    about: dict[str, Any] = {"rate_hz": spec.rate_hz, "unit": spec.unit, "channels": tuple(spec.columns), "fit": spec.fit}
    X = held.traces[:, 0] if spec.channels == 1 else held.traces
    again = len(np.unique(held.hashes)) < len(held.hashes)
    part = held.hashes.astype(np.str_) if again else None  # as they count: a part that came again has one vote
    return refit(make_dataset(X, held.labels, part=part, name=name, **about), asked)


def _read_npz(path: Path, name: str, asked: Asked) -> Dataset:
    """`X`, `y`, and what is known beside them: `scale`, `rate_hz`, `unit`, `cause`, `channels`, and the parts' numbers."""
    found, have = read_archive(path, (*USED, asked.part))
    with reading(path, "an .npz file of plain arrays"):
        return _from_arrays(found, have, path, name, asked)


def _read_hdf5(path: Path, name: str, asked: Asked) -> Dataset:
    """The same as data sets of an HDF5 file, by h5py."""
    with reading(path, "an HDF5 file", "h5py", "files"):
        import h5py

        with h5py.File(path, "r") as file:
            wanted = [key for key in (*USED, asked.part) if isinstance(file.get(key), h5py.Dataset)]
            must_fit(sum(float(file[key].nbytes) for key in wanted), path)
            texts = {key for key in wanted if file[key].dtype.kind == "O"}
            found = {key: np.asarray(file[key].asstr()[()], np.str_) if key in texts else file[key][()] for key in wanted}
            return _from_arrays(found, list(file), path, name, asked)


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


def _from_pair(X: Any, y: Any, asked: Asked) -> Dataset:
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
        text = words.astype(np.str_) if words.dtype.kind == "S" else words
    except (ValueError, TypeError) as error:  # UnicodeDecodeError too
        raise DataError(f"Expected a label for each trace, 1 (success) or 0 (failure), got others: {error}.") from error
    if words.dtype.kind not in "OUS" or words.ndim != 1:
        return words
    try:
        return np.array([label_of(word) for word in text.tolist()], dtype=np.int8)
    except UnreadableError as error:
        raise DataError(f"{error.what}.") from error


def _from_list(traces: list[Any], labels: list[Any], asked: Asked) -> Dataset:
    if len(traces) != len(labels):
        raise DataError(f"Expected a label for each trace, got {len(traces)} traces and {len(labels)} labels.")
    has_force = any(FORCE in getattr(trace, "columns", ()) for trace in traces)
    found = Collected("data", asked.channels or ((FORCE,) if has_force else ()))
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
        found.read.append(Recorded(x, label, f"trace {number}", rate_hz=rate))
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
