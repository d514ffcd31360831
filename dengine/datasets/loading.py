"""One door for all that holds labelled traces: `load_dataset`."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable, Sequence
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DataError
from ..files import is_database
from ..records import trace_in
from .arrays import from_pair, read_hdf5, read_npz
from .bags import is_stream, read_bag
from .dataset import Asked, Dataset, make_dataset, names_of
from .folders import read_folder
from .lengths import refit
from .tables import from_frame, read_csv, read_parquet
from .triggers import Trigger

BUNDLED = {"insertion": "insertion.npz"}
Reader = Callable[[Path, str, Asked], Dataset]
TABLES: dict[str, Reader] = {".csv": read_csv, ".parquet": read_parquet, ".pq": read_parquet}
READERS: dict[str, Reader] = {**TABLES, ".h5": read_hdf5, ".hdf5": read_hdf5}  # other zip files are read as .npz


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
    if not is_stream(source):
        asked.refuse("what is no .mcap file, nor a bag", "trigger", "topic", why="it is cut into insertions already")
    if isinstance(source, Dataset):
        asked.refuse("a Dataset", "label", "labels")
        return refit(source, asked)
    if isinstance(source, tuple):
        asked.refuse("a pair (X, y)", "label", "labels")
        return from_pair(*source, asked) if len(source) == 2 else _refuse(source)
    if hasattr(source, "columns"):
        asked.refuse("a DataFrame", "labels")
        return from_frame(source, asked)
    if str(source) in BUNDLED:
        asked.refuse("a bundled set", "label", "labels")
        with as_file(files("dengine") / "data" / BUNDLED[str(source)]) as path:
            return read_npz(path, str(source), asked)
    return _read(Path(source), asked) if isinstance(source, str | os.PathLike) else _refuse(source)


def _read(path: Path, asked: Asked) -> Dataset:
    if is_stream(path):
        return read_bag(path, path.stem, asked)
    if path.is_dir():
        return read_folder(path, asked)
    if not path.is_file():
        raise DataError(
            f"Expected a data set among {', '.join(BUNDLED)}, a file (.npz, .csv, .parquet, .h5, .mcap), a store, or a "
            f"folder of CSV files; {path} is neither."
        )
    suffix = path.suffix.lower()
    if is_database(path):
        asked.refuse("a store", "label", "labels")
        return _read_store(path, asked)
    if suffix not in (".npz", *READERS) and not zipfile.is_zipfile(path):
        raise DataError(f"Expected a file .npz, .csv, .parquet, .h5 or .mcap, got {path}; save it as one of these.")
    asked.refuse(f"a file {suffix}", "labels", *([] if suffix in TABLES else ["label"]))
    return READERS.get(suffix, read_npz)(path, path.stem, asked)


def _read_store(path: Path, asked: Asked) -> Dataset:
    """Every labelled trace of a store, in the order of the labels, as they count now, without bad and forgotten ones."""
    from ..store.base import open_store

    store = open_store(path, must_exist=True)
    try:
        held, spec = store.labelled(), trace_in(store.settings())
    finally:
        store.close()
    if spec is None or not len(held.labels):
        raise DataError(f"Expected a store with labelled traces, {path} has none; record some first, as in shadow mode.")
    about: dict[str, Any] = {"rate_hz": spec.rate_hz, "unit": spec.unit, "channels": tuple(spec.columns), "fit": spec.fit}
    X = held.traces[:, 0] if spec.channels == 1 else held.traces
    again = len(np.unique(held.hashes)) < len(held.hashes)
    part = held.hashes.astype(np.str_) if again else None  # as they count: a part that came again has one vote
    return refit(make_dataset(X, held.labels, part=part, name=path.stem, **about), asked)


def _refuse(source: Any) -> Dataset:
    raise DataError(f"Expected a name, a path, a Dataset, a DataFrame or a pair (X, y), got {type(source).__name__}.")
