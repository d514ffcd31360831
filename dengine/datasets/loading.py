"""`load_dataset`, which reads recordings from whatever holds them, and the readers of .npz files,
stores and arrays in memory.

It finds out what a source is and calls its reader: in `tables`, in `bags`, or below.
"""

import os
import re
import zipfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib.resources import files
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, instead, listed
from ..files import is_database, read_archive, read_errors
from ..records import stored_trace_spec
from ..traces import as_trace, as_traces, is_time_column, spec_of
from . import units
from .archives import find_whole, hold_one_each, read_archive_each
from .assembly import (
    UNKNOWN_RATE,
    as_dataset,
    assumed_unit_notes,
    describe_ends,
    guess_unit,
    leave_out_repeats,
    odd_labels_note,
    refit,
    unknown_unit_note,
)
from .bags import is_stream, read_bag
from .clocks import clock_of, rate_of, rate_of_scalar, stated_rate
from .collector import Reading, Recording, RecordingCollector, describe_reading
from .columns import FORCE
from .containers import HEAD, JSON, NPZ, PARQUET, binary_kind, is_text, suffix_of
from .dataset import (
    Dataset,
    LoadOptions,
    UnknownWordError,
    UnlabelledError,
    UnreadableError,
    expect_data,
    make_dataset,
    split_names,
    split_unit,
)
from .folders import are_tables, find_recordings, read_folder, read_heads
from .labels import LabelColumn, label_of, parse_label_map
from .listings import listing_to_trust, read_ordered_labels
from .tables import from_frame, read_tables
from .text import SUFFIXES as TEXTS
from .triggers import Trigger
from .wide_tables import without_trailing_nan

BUNDLED = {"insertion": "insertion.npz"}
ARRAYS = ("X", "y", "scale", "rate_hz", "unit", "cause", "channels")  # beside the parts' numbers
# Options about how a text file is written.
TEXT_FORMAT = ("columns", "decimal", "thousands", "encoding")
# What `dengine simulate` writes beside them, for `experiments`.
SIMULATED = ("height_mm", "cycle", "conditions", "condition_names", "seed", "scenario", "simulated")
Files = Mapping[str, Path]
TABLES = (*TEXTS, *JSON, *PARQUET)
MIN_PADDING = 5  # zeros at the end of a trace that are no measurement
FORMS = ".npz, .csv, .tsv, .txt, .dat, .json, .jsonl, .parquet or .mcap"
LABEL_MAP = re.compile(r"\blabel_map=['\"]")  # in an error, before the pairs to type


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
    time: str | None = None,
    unit: str | None = None,
    label_map: Mapping[str, Any] | str | None = None,
    columns: str | Sequence[str] | None = None,
    decimal: str | None = None,
    thousands: str | None = None,
    encoding: str | None = None,
    channels: str | Sequence[str] | None = None,
) -> Dataset:
    """Read a data set from recordings as people have them.

    Parameters
    ----------
    source : str, path, Dataset, DataFrame or pair (X, y), default "insertion"
        The name of a bundled set; a folder of CSV files or archives, one for each insertion, or of
        tables or archives of one form, which are one set; a wide table, with a row for each
        insertion, or a long one, with a row for each sample, as .csv, .parquet or a DataFrame; one
        long recording as .mcap, or a rosbag2 folder of them; an .npz file with X (n, T) or
        (n, C, T), multiplied by the number `scale` if there is one, and y (n,), or with arrays that
        `channel` and `label` name; the SQLite file of a store, for its labelled traces; a
        `Dataset`; or a pair (X, y), in which X may be a list of traces of any length.
    samples : int, optional
        Samples of each trace: the first so many, or with `fit="resample"` the points at which the
        whole trace is interpolated.
    part : str, default "part"
        Name of the array or column of parts' numbers, texts or whole numbers, or of columns that
        tell them together, "day,number"; for a folder a column or a line of its files, a regular
        expression whose one group finds it in a file's name, or a column of `labels`. Without a
        `part` every trace is a part of its own. In a long table it says which rows are one
        insertion.
    channel : str or sequence of str, optional
        "FZ_Base", or several, "FZ_Base,FX_Base", which give (n, C, T). None: FZ_Base, or the only
        channel that there is.
    label : str, optional
        For a folder, a regular expression with one group that finds the label in a file's path, or
        the name of a column of the files, or of a line above or below their samples. None:
        True/False, OK/NOK, pass/fail, good/bad,
        success/failure or i.O./n.i.O. at the end of the file's name except for numbers, or of a
        folder's; else a column with the name of a label. For a table the name of the column, for an
        .npz file of the array; with `labels` the column of that file. If the name means the bad
        outcome, as `failed`, true, yes and 1 are bad. A label that is not stated so must not
        contradict another one, of a name, a column or the file of `labels`.
    labels : path, optional
        For a folder, a CSV file with a column of file names and one of labels; for a long table, of
        parts and labels; for an .npz file, of labels with a row for each trace.
    fit : {"strict", "cut", "pad", "resample", "pad-all"}, optional
        What happens to traces of another length, as in `TraceSpec`; "pad-all" also pads recordings
        shorter than half, which the others leave out, and cuts those longer than twice. None:
        strict for recordings of one length; cut if all have the `samples` stated; else pad to the
        median length.
    rate_hz : float, optional
        Sampling rate, instead of that by timestamps or of a line above the header. Without any of
        these the rate is unknown.
    trigger : Trigger or str, optional
        When an insertion begins in one long recording, see `as_trigger`. Its channels are FX ...
        MZ, by default FZ; `label` is the topic that gives labels, and a file of `labels` names
        insertions by their number; `samples` is two seconds by default. Instead of a trigger, a
        file of `labels` may say from when to when each part ran.
    topic : str, optional
        Topic of the wrench of a long recording, if there are several.
    time : str, optional
        Column of times, of a long table, or of recordings whose clock has another name.
    unit : str, optional
        Unit of the samples, one for all channels or "kN, mm". Samples whose own unit is known are
        converted to it.
    label_map : mapping or str, optional
        Meaning of other label words, "heil=good,Riss=bad". "1=good,0=bad" if names end in numbers
        that are labels. "0=" is the word of a part not checked yet, "=good" an empty cell.
    columns : str or sequence of str, optional
        Names of the columns of text files without a header, or with another one: "time,fx,fz", or
        "c0..c498,label" for many.
    decimal, thousands : str, optional
        Marks in the numbers of text files, "," or ".". None: the cells of each file prove them.
    encoding : str, optional
        Encoding of the text files that are not UTF-8, as "cp932". None: Windows-1252, or an error
        if that looks wrong.
    channels : str or sequence of str, optional
        Another name of `channel`.

    Returns
    -------
    Dataset
        A recording that cannot be read, or cannot be fitted without making up data, is one of its
        `faults`. A missing number is NaN, which the engine finds. Its `spec` is that of live traces
        of the same shape.

    Raises
    ------
    DataError
        If nothing can be read, or an option does not apply to the source.
    SettingError
        For a trigger that is none.
    """
    expect_data(channel is None or channels is None, "channel or channels", (channel, channels))
    options = LoadOptions(
        samples=samples,
        part=part,
        channels=split_names(channel if channels is None else channels),
        label=label,
        labels=labels,
        fit=fit,
        rate_hz=rate_hz,
        trigger=trigger,
        topic=topic,
        time=time,
        unit=unit,
        words=parse_label_map(label_map),
        columns=split_names(columns),
        decimal=decimal,
        thousands=thousands,
        encoding=encoding,
    )
    try:
        return _load(source, options)
    except DataError as error:
        if not label_map or "label_map=" not in str(error):
            raise
        raise DataError(_with_own_words(str(error), label_map)) from error


def _with_own_words(message: str, label_map: Mapping[str, Any] | str) -> str:
    """Return an error's message in which the label map to type begins with the user's own pairs."""
    pairs = label_map
    if isinstance(pairs, Mapping):
        words = parse_label_map(pairs)
        verdicts = {True: "good", False: "bad", None: ""}
        pairs = ",".join(f"{word}={verdicts[good]}" for word, good in words.items())
    return LABEL_MAP.sub(lambda match: f"{match[0]}{pairs.rstrip(',')},", message)


def _load(source: Any, options: LoadOptions) -> Dataset:
    """Load a data set as `load_dataset` does, whose options these are."""
    title, accepted, read = _find_reader(source, options)
    optional = ("label", "labels", "trigger", "topic", "time", *TEXT_FORMAT)
    stated = [name for name in optional if getattr(options, name) not in (None, ())]
    unused = [name for name in stated if name not in accepted]
    if unused:
        options_text = " or ".join(unused)
        raise DataError(f"Expected no {options_text} for {title}, which has none; leave it out.")
    data = read()
    if isinstance(source, Dataset):
        return data
    data = replace(data, notes=(*data.notes, *_not_finite_note(data)))
    if "first" in data.reading:
        return data
    trace = as_traces(data.X)[0]
    first = describe_ends("trace 1", trace, data.channels, split_unit(data.unit, len(trace)))
    return replace(data, reading={**data.reading, "first": first})


def _not_finite_note(data: Dataset) -> list[str]:
    """Return a note on the recordings in which a sample is no finite number, if there are any."""
    is_missing = ~np.isfinite(data.X.reshape(len(data), -1))
    rows = np.flatnonzero(is_missing.any(axis=1))
    if not len(rows):
        return []
    names = [f"trace {i + 1}" for i in rows] if data.source is None else data.source[rows]
    text = f"{int(is_missing.sum())} samples are not finite, for cells are empty or hold no number"
    return [f"{text}, in {len(rows)} of {len(data)} recordings: {listed(names)}."]


def _find_reader(
    source: Any, options: LoadOptions
) -> tuple[str, Sequence[str], Callable[[], Dataset]]:
    """Find the reader of a source.

    Returns what to call the source in errors, the names of the optional options that apply to it,
    and a function that reads it. Here no more is read than tells the kind of files. Raises
    DataError for a source of an unknown kind.
    """
    if isinstance(source, Dataset):
        return "a Dataset", (), partial(refit, source, options)
    if isinstance(source, tuple) and len(source) == 2:
        return "a pair (X, y)", (), partial(_from_pair, *source, options)
    if hasattr(source, "columns"):
        return "a DataFrame", ("label", "labels", "time"), partial(from_frame, source, options)
    if not isinstance(source, str | os.PathLike):
        wanted = "a name, a path, a Dataset, a DataFrame or a pair (X, y)"
        raise DataError(f"Expected {wanted}, got {type(source).__name__}.")
    if str(source) in BUNDLED:
        path = Path(str(files("dengine"))) / "data" / BUNDLED[str(source)]
        return "a bundled set", (), partial(_read_npz, {path.name: path}, str(source), options)
    accepted, read = _find_file_reader(Path(source), options)
    return str(source), accepted, read


def _find_file_reader(
    path: Path, options: LoadOptions
) -> tuple[Sequence[str], Callable[[], Dataset]]:
    """Find the reader of a file or folder by its suffix and its content.

    It reads a bag, a folder with a recording in each file, a store, or tables or archives of many
    recordings. Returns the optional options that apply, and a function that reads it. Raises
    DataError if it is none of these.
    """
    name = path.resolve().name if path.is_dir() else path.stem
    if is_stream(path):
        return ("label", "labels", "trigger", "topic"), partial(read_bag, path, name, options)
    named = {path.name: path}
    if path.is_dir():
        named = find_recordings(path, options)
        heads = read_heads(named, options)
        if not are_tables(named, heads, options):
            read = partial(read_folder, path, named, heads, name, options)
            return ("label", "labels", "time", *TEXT_FORMAT), read
    if len(named) == 1:
        path = next(iter(named.values()))
        name = path.stem
        named = {path.name: path}
    if not path.exists() or not all(file.is_file() for file in named.values()):
        wanted = f"a data set among {', '.join(BUNDLED)}, a file {FORMS}, a store"
        raise DataError(f"Expected {wanted}, or a folder of CSV files, got {path}.")
    if path.is_file() and is_database(path):
        return (), partial(_read_store, path, name, options)
    if any(map(holds_table, named.values())):
        read = partial(read_tables, named, name, options)
        return ("label", "labels", "time", *TEXT_FORMAT), read
    if path.is_dir() or path.suffix.lower() == NPZ or _is_archive(path):
        return ("label", "labels", "time"), partial(_read_archives_of_set, named, name, options)
    with path.open("rb") as file:
        kind = binary_kind(file.read(HEAD))
    raise DataError(f"Expected a text file, or one {FORMS}, got {path}, {kind}.")


def holds_table(path: Path) -> bool:
    """Return whether a file is read as a table: by its suffix, or because it is a text."""
    return suffix_of(path) in TABLES or (path.suffix.lower() != NPZ and is_text(path))


def _is_archive(path: Path) -> bool:
    """Return whether a file is a zip archive that has arrays of NumPy in it."""
    if not zipfile.is_zipfile(path):
        return False
    with suppress(zipfile.BadZipFile, OSError), zipfile.ZipFile(path) as archive:
        return any(name.endswith(".npy") for name in archive.namelist())
    return False


def _read_store(path: Path, name: str, options: LoadOptions) -> Dataset:
    """Read the labelled traces of a store, in the order of their labels, with corrections applied.

    Quarantined and forgotten ones are left out. Raises DataError if the store contradicts its
    ledger, or has no labelled traces.
    """
    from ..store.opening import opening

    with opening(path, must_exist=True) as store:
        if integrity_error := store.database.check_integrity(0, since=0):
            wanted = f"{path} as its ledger has it"
            do = "see `dengine verify`, and restore a copy"
            raise DataError(f"Expected {wanted}, {integrity_error}; {do}.")
        labelled = store.labelled()
        spec = stored_trace_spec(store.settings())
    store.close()
    if spec is None or not len(labelled.labels):
        do = "record some first, as in shadow mode"
        raise DataError(f"Expected a store with labelled traces, {path} has none; {do}.")
    X = labelled.traces[:, 0] if spec.channels == 1 else labelled.traces
    has_repeats = len(np.unique(labelled.hashes)) < len(labelled.hashes)
    # As the store counts: a part that came again has one vote.
    part = labelled.hashes.astype(np.str_) if has_repeats else None
    data = make_dataset(
        X,
        labelled.labels,
        part=part,
        name=name,
        rate_hz=spec.rate_hz,
        unit=spec.unit if isinstance(spec.unit, str) else ", ".join(spec.unit or ()),
        channels=tuple(spec.columns),
        fit=spec.fit,
    )
    return refit(data, options)


def _read_archives_of_set(named: Files, name: str, options: LoadOptions) -> Dataset:
    """Read archives, one for each insertion or of many; those that are damaged are faults."""
    whole, faults = find_whole(named)
    read = read_archive_each if hold_one_each(whole, options) else _read_npz
    try:
        data = read(whole, name, options)
    except DataError as error:
        if not faults:
            raise
        raise DataError(f"{error} Not read: {listed(faults)}.") from error
    return replace(data, faults=(*faults, *data.faults))


def _read_npz(named: Files, name: str, options: LoadOptions) -> Dataset:
    """Read archives: `X`, `y`, and the other arrays of `ARRAYS` that are there.

    Without an `X` the channels are arrays (n, T) by their names. A file of labels goes before `y`,
    which must not contradict it. Several archives are of one form, or hold different arrays of one
    set. If only another axis is as long as the labels, it is the axis of the parts. Raises
    DataError if arrays are missing or do not fit together.
    """
    label = label_column = options.label or "y"
    arrays, all_names, _ = _read_archives(named, options)
    stored, _, turned = _read_archives(named, options, every=True)
    if options.labels is not None:
        label = "y"
        keys = _keys_of_traces(stored)
        label_words, label_column = read_ordered_labels(options.labels, options, keys)
        if label in arrays and options.label is None:
            _check_same_labels(arrays[label], label_words, label_column, options)
        arrays[label] = np.array(label_words)
    arrays |= _arrays_by_meaning(named, stored, arrays, label, options)
    channels = () if "X" in arrays else options.channels
    traces = channels or ("X",)
    if not {label, *traces} <= set(arrays):
        raise DataError(f"Expected {_missing_arrays(named, options)}")
    if options.part != "part" and options.part not in arrays:
        wanted = f"an array {options.part} in {', '.join(named)}"
        raise DataError(f"Expected {wanted}, found {listed(all_names)}.")
    with read_errors(name, "an .npz file of plain arrays"):
        blocks = {key: _parts_first(arrays[key], arrays[label]) for key in traces}
        turned |= _turned_notes(arrays, blocks)
        _check_rows(blocks, arrays, stored, label, options)
        X = np.stack([*blocks.values()], axis=1) if len(channels) > 1 else blocks[traces[0]]
        if "scale" in arrays:
            X = X.astype(np.float32) * arrays["scale"].astype(np.float32)
        about: dict[str, Any] = {key: arrays.get(key) for key in ("cause", "rates")}
        about["rate_hz"] = float(arrays["rate_hz"]) if "rate_hz" in arrays else None
        names = tuple(map(str, arrays.get("channels", ())))
        about["unit"] = _unit_in(arrays) or guess_unit(names or channels)
        if len(channels) == 1 and X.ndim == 3:  # it is the name of an array of several channels
            channels = ()
            options = replace(options, channels=())
        about |= {"channels": channels or names, "part": arrays.get(options.part)}
        X, lengths = _without_padding(X, stored)
        data = _from_arrays(X, arrays[label], options, name, label_column, **about)
        data = _refit_without_padding(data, options, has_unit="unit" in arrays)
    read = {label, *traces, options.part, *lengths, *ARRAYS, *SIMULATED, *arrays}
    notes = (*data.notes, *(note for key, note in turned.items() if key in read))
    assumed = () if options.unit or _unit_in(arrays) else assumed_unit_notes(data.channels)
    return replace(data, notes=(*notes, *assumed, *_archive_notes(data, all_names, read)))


def _unit_in(arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return the unit that an archive states, or one for each channel; "" for none."""
    return ", ".join(map(str, np.atleast_1d(arrays.get("unit", "")).tolist()))


def _turned_notes(
    stored: Mapping[str, NDArray[Any]], turned: Mapping[str, NDArray[Any]]
) -> dict[str, str]:
    """Return a note by the name of each array whose first axis is another than it was stored with.

    turned : the arrays as `_parts_first` returns them.
    """
    return {
        key: f"Array {key} {stored[key].shape} is read as {len(x)} traces of {x.shape[-1]} samples,"
        f" for there are {len(x)} labels."
        for key, x in turned.items()
        if x.ndim > 1 and len(x) != len(stored[key])
    }


def _without_padding(
    X: NDArray[Any], stored: Mapping[str, NDArray[Any]]
) -> tuple[NDArray[Any], list[str]]:
    """Return traces (n, T) or (n, C, T) with NaN in place of zeros behind their ends, and a name.

    It is that of the array of whole numbers, shape (n,), that says how long each trace is: behind
    that all samples are 0. Without such an array the traces are returned as they are, and no name.
    """
    n, samples = len(X), X.shape[-1]
    for key, length in stored.items():
        if length.shape != (n,) or length.dtype.kind not in "iu" or X.dtype.kind != "f":
            continue
        is_behind = np.arange(samples) >= length[:, None]
        is_behind = is_behind.reshape(n, *[1] * (X.ndim - 2), samples)
        if length.min() >= MIN_PADDING < samples - length.min() and not (is_behind * X).any():
            return np.where(is_behind, np.nan, X), [key]
    return X, []


def _refit_without_padding(data: Dataset, options: LoadOptions, *, has_unit: bool) -> Dataset:
    """Return a data set as `refit` does, whose traces end before the NaN behind their last number.

    If some do, or have rates of their own, all are brought to one length as recordings are; those
    that cannot be are among its faults.
    """
    X: NDArray[np.float32] = as_traces(data.X)
    is_nan = np.all(np.isnan(X), axis=1)
    n_padded = int((is_nan[:, -1] & ~is_nan.all(axis=1)).sum())
    if not n_padded and data.rates is None:
        return refit(data, options, has_unit=has_unit)
    about = refit(data, replace(options, samples=None, fit=None), has_unit=has_unit)
    collector = RecordingCollector(data.name, about.channels)
    if n_padded:
        text = f"{n_padded} of {len(data)} traces end before their row"
        collector.notes[f"{text}, by NaN or an array of lengths"] = 1
    rates = [about.rate_hz] * len(data)
    if data.rates is not None and options.rate_hz is None:
        rates = data.rates.tolist()
    traces = as_traces(about.X)
    channel_units = tuple(split_unit(about.unit, traces.shape[1]))
    parts = [None] * len(data) if data.part is None else map(str, data.part)
    rows = zip(traces, data.y, parts, rates, strict=True)
    for i, (trace, label, part, rate) in enumerate(rows, start=1):
        recording = Recording(
            without_trailing_nan(trace),
            rate,
            channel_units,
            label=int(label),
            source=f"trace {i}",
            part=part,
        )
        collector.recordings.append(recording)
    fitted = as_dataset(collector, replace(options, unit=about.unit))
    reading = {**about.reading, "first": fitted.reading["first"]}
    general = (UNKNOWN_RATE, *unknown_unit_note(fitted.unit, fitted.channels))
    fitting_notes = [note for note in fitted.notes if note not in general]
    faults = (*about.faults, *fitted.faults)
    notes = (*about.notes, *fitting_notes)
    return replace(fitted, notes=notes, faults=faults, reading=reading)


def _arrays_by_meaning(
    named: Files,
    stored: Mapping[str, NDArray[Any]],
    arrays: Mapping[str, NDArray[Any]],
    label: str,
    options: LoadOptions,
) -> dict[str, NDArray[Any]]:
    """Return arrays that archives have under unusual names, each by its usual and its own name.

    The usual names are those of `ARRAYS`: `rate_hz`, of a number such as fs or dt or from an array
    of times; `channels` and `unit`, arrays of texts as long as the axis of the channels; and `X`,
    if the user names channels of it. Empty without labels.

    stored : all arrays. arrays : those that are there by the usual names. label : that of labels.
    """
    import pandas as pd

    if label not in arrays:
        return {}
    n = len(arrays[label])
    blocks = [key for key, x in stored.items() if x.ndim == 3]
    blocks = [key for key in ("X", *options.channels) if key in blocks] or blocks
    traces = [key for key in (*blocks, *options.channels, "X") if key in stored]
    lengths = set(stored[traces[0]].shape) - {n} if traces else set()
    result = dict[str, NDArray[Any]]()
    for key, x in stored.items():
        if x.ndim == 1 and len(x) in lengths and x.dtype.kind in "US":
            is_unit = all(units.parse(units.spelling(text)) for text in map(str, x.tolist()))
            result |= {"unit" if is_unit else "channels": x, key: x}
        elif rate := rate_of_scalar(key, x):
            result |= {"rate_hz": np.array(rate), key: x}
        elif x.shape == (n,) and x.dtype.kind in "iuf" and (stated_rate(key, 1.0) or (0, 0))[1]:
            rates = np.array([rate_of_scalar(key, number) for number in x], dtype=np.float64)
            result |= {"rates": rates, key: x}
        elif x.ndim == 1 and len(x) in lengths and is_time_column(key) and x.dtype.kind in "iuf":
            with suppress(UnreadableError):
                clock = clock_of(pd.DataFrame({key: x}))
                if clock is not None:
                    result |= {"rate_hz": np.array(rate_of(clock, pd.RangeIndex(len(x)))), key: x}
    names = set(map(str, result.get("channels", ())))
    if blocks and "X" not in arrays and options.channels and names.issuperset(options.channels):
        whole, *_ = _read_archives(named, replace(options, channels=(blocks[0],)))
        result |= {"X": whole[blocks[0]], blocks[0]: whole[blocks[0]]}
    return {key: x for key, x in result.items() if key not in arrays}


def _archive_notes(data: Dataset, names: Sequence[str], read: set[str]) -> list[str]:
    """Return notes for the user: zeros at the ends of traces, arrays not read, odd labels, no rate.

    names, read : its arrays, and those that are read.
    """
    notes = []
    X = as_traces(data.X)
    is_zero = (X == 0).all(axis=1)[:, ::-1]
    n_zeros = np.where(is_zero.all(axis=1), 0, is_zero.argmin(axis=1))
    if n_padded := int((n_zeros >= MIN_PADDING).sum()):
        text = f"{n_padded} of {len(data)} traces end in up to {int(n_zeros.max())} zeros"
        notes.append(f"{text}: if they are padded, cut them (samples), or leave the zeros out.")
    if unread := [name for name in names if name not in read]:
        notes.append(f"Not read: the arrays {listed(unread)}.")
    odd_labels = odd_labels_note(int(data.y.sum()), len(data))
    notes += [note for note in odd_labels if note not in data.notes]
    if data.rate_hz is None:
        notes.append(UNKNOWN_RATE)
    return [*notes, *unknown_unit_note(data.unit, data.channels)]


def _read_archives(
    named: Files, options: LoadOptions, every: bool = False
) -> tuple[dict[str, NDArray[Any]], list[str], dict[str, str]]:
    """Return the arrays of archives that the options and `ARRAYS` name, the names of all, and the
    `_turned_notes` on those of the first archive.

    Archives that hold different arrays are read as one. Those of one form are concatenated; an
    array that is not one of parts must be the same in all. With `every` all arrays are returned, to
    describe them: of equal names that of the first archive, and nothing is compared. The axes of
    the arrays are ordered by `_parts_first`. Raises DataError if archives do not fit together, or
    hold Python objects.
    """
    label = options.label or "y"
    wanted = None if every else (*ARRAYS, options.part, label, *options.channels)
    try:
        contents = [read_archive(path, wanted) for path in named.values()]
    except DataError as error:
        if "Object arrays" not in str(error):
            raise
        advice = _object_arrays_advice(next(iter(named.values())), options)
        raise DataError(f"{str(error).partition(':')[0]}: {advice}") from error
    first = next(iter(named))
    arrays = dict[str, NDArray[Any]]()
    all_names = list[str]()
    turned = dict[str, str]()
    for source, (stored, names) in zip(named, contents, strict=True):
        new = {key: _parts_first(x, stored.get(label)) for key, x in stored.items()}
        turned = turned if all_names else _turned_notes(stored, new)
        if set(all_names).isdisjoint(names):
            arrays = arrays | new
            all_names = all_names + names
            continue
        for key in () if every else sorted({*arrays, *new}):
            old = arrays.get(key, np.array("none"))
            other = new.get(key, np.array("none"))
            is_alike = old.ndim == other.ndim > 0 and old.shape[1:] == other.shape[1:]
            if is_alike and key != "channels":
                arrays[key] = np.concatenate([old, other])
            elif not np.array_equal(old, other):
                actual = f"{old.shape or old} and {other.shape or other}"
                raise DataError(f"Expected {key} alike in {first} and {source}, got {actual}.")
    return arrays, all_names, turned


def _object_arrays_advice(path: Path, options: LoadOptions) -> str:
    """Return advice how to make a table of an archive of Python objects, which is not read.

    Reading such objects, as traces of several lengths are stored, can run code.
    """
    _, names = read_archive(path, ())
    X = next((name for name in (*options.channels, "X") if name in names), names[0])
    y = next((name for name in (options.label, "y") if name in names), names[-1])
    steps = (
        "import numpy as np, pandas as pd",
        f"d = np.load({str(path)!r}, allow_pickle=True)",
        f"frame = pd.DataFrame([*d[{X!r}]]).assign(y=d[{y!r}].astype(str))",
        f"frame.to_csv({str(path.with_suffix('.csv'))!r}, index=False)",
    )
    why = "Python objects, which can run code when they are read"
    return f'{why}. If you trust it, make a table of it: python -c "{"; ".join(steps)}".'


def _parts_first(x: NDArray[Any], labels: NDArray[Any] | None) -> NDArray[Any]:
    """Return an array with the axis of the parts first, and of (n, T, C) as (n, C, T).

    The axis of the parts is the only one that is as long as the labels; if there is none, or there
    are several, it is taken to be the first. (n, T, C) is recognized by T > C. Without labels, or
    with fewer than two axes, the array is returned unchanged.
    """
    if labels is None or labels.ndim != 1 or x.ndim < 2:
        return x
    if len(x) != len(labels) and x.shape.count(len(labels)) == 1:
        x = np.moveaxis(x, x.shape.index(len(labels)), 0)
    return x.swapaxes(1, 2) if x.ndim == 3 and x.shape[1] > x.shape[2] else x


def _check_rows(
    blocks: Mapping[str, NDArray[Any]],
    arrays: Mapping[str, NDArray[Any]],
    stored: Mapping[str, NDArray[Any]],
    label: str,
    options: LoadOptions,
) -> None:
    """Raise DataError if traces, labels and parts have not as many rows as each other.

    blocks : the traces, with rows first. arrays : with the labels by the name `label`, and perhaps
    the parts. stored : all arrays, of which one may name the traces for a listing.
    """
    of_labels = label if options.labels is None else Path(options.labels).name
    rows = {key: len(block) for key, block in blocks.items()} | {of_labels: len(arrays[label])}
    rows |= {key: len(arrays[key]) for key in (options.part,) if key in arrays}
    n = next(iter(rows.values()))
    if set(rows.values()) == {n}:
        return
    actual = ", ".join(f"{name} has {n_rows}" for name, n_rows in rows.items())
    do = "export them again"
    keys = [name for name, texts in _keys_of_traces(stored).items() if len(texts) == n]
    if keys:
        do = f"{do}, or list the labels by {listed(keys)} in a CSV file, labels='labels.csv'"
    wanted = "as many rows of each array"
    raise DataError(f"Expected {wanted}, {actual}: nobody can tell which are missing; {do}.")


def _check_same_labels(
    stored: NDArray[Any], words: Sequence[str], column: str, options: LoadOptions
) -> None:
    """Raise DataError if the labels of an archive contradict those of a file of labels.

    A pair of which one is no known label is passed over.

    stored, words : the labels, one for each trace. column : of the file.
    """
    file = Path(str(options.labels)).name
    columns = (
        LabelColumn("y", options.words, Counter()),
        LabelColumn(column, options.words, Counter()),
    )
    rows = []
    for row, cells in enumerate(zip(stored.tolist(), words, strict=False), start=1):
        with suppress(UnreadableError):
            if columns[0].label_of(cells[0]) != columns[1].label_of(cells[1]):
                rows.append(row)
    if rows:
        wanted = f"the labels of {file} to be those of y"
        do = listing_to_trust(file, column)
        raise DataError(f"Expected {wanted}, traces {listed(rows)} have others; {do}.")


def _keys_of_traces(arrays: Mapping[str, NDArray[Any]]) -> dict[str, list[str]]:
    """Return the arrays of an archive that may name its traces, as texts that differ."""
    texts = {name: list(map(str, x.tolist())) for name, x in arrays.items() if x.ndim == 1}
    return {name: words for name, words in texts.items() if len(set(words)) == len(words) > 1}


def _missing_arrays(named: Files, options: LoadOptions) -> str:
    """Return the message of an error: the arrays X and y are missing, and which could be them.

    An array of two or three dimensions may hold the traces; one of one dimension, as long as an
    axis of the traces, the labels; so may a CSV file beside the archive, which is named then.
    """
    arrays, all_names, _ = _read_archives(named, options, every=True)
    traces = [name for name, x in arrays.items() if x.ndim in (2, 3) and len(x)]
    lengths = arrays[traces[0]].shape if traces else ()
    single = [name for name, x in arrays.items() if x.ndim == 1 and len(x) in lengths]
    label = ""
    if single:
        fewest_values = min(single, key=lambda name: len(set(arrays[name].tolist())))
        label = f"label={fewest_values!r}"
    elif traces:
        label = "a CSV file of labels in the order of the traces (labels)"
        keys = _keys_of_traces(arrays)
        for path in next(iter(named.values())).parent.glob("*.csv"):
            with suppress(DataError):
                if len(read_ordered_labels(path, options, keys)[0]) in lengths:
                    label = f"labels={str(path)!r}, in the order of the traces"
    shapes = ", ".join(f"{name} {arrays[name].shape}" for name in all_names) or "none"
    texts = [x for x in arrays.values() if x.ndim == 1 and len(x) in lengths[1:]]
    channel_names = [name for x in texts if x.dtype.kind in "US" for name in map(str, x.tolist())]
    if channel_names:
        shapes = f"{shapes}; channels are {listed(channel_names)}"
    channel = "" if "X" in all_names or not traces else f"channel={traces[0]!r} and "
    if options.channels and {*channel_names, *all_names}.issuperset(options.channels):
        channel = f"channel={','.join(options.channels)!r} and "
    example = f", or their names, as in {channel}{label}" if label else ""
    return f"arrays X and y in {listed(named)}{example}; found {shapes}."


def _from_pair(X: Any, y: Any, options: LoadOptions) -> Dataset:
    """Make a data set of traces in memory and their labels.

    The traces are one array, or a list of arrays, Series or DataFrames of any length.
    """
    is_list = isinstance(X, list | tuple)
    if is_list or (isinstance(X, np.ndarray) and X.dtype.kind == "O" and X.ndim == 1):
        traces = list(X)
        if traces and not all(np.isscalar(trace) for trace in traces):
            return _from_list(traces, list(y), options)
    return refit(_from_arrays(X, y, options), options, has_unit=False)


def _from_arrays(
    X: Any, y: Any, options: LoadOptions, name: str = "data", label: str = "y", **about: Any
) -> Dataset:
    """Make a data set of the traces that have a label; a note says how many have none.

    Words are converted to labels. Raises DataError if the meaning of a word is unknown, or if no
    trace has a label.

    label : the array or column that the labels are from.
    about : further fields of the `Dataset`.
    """
    collector = RecordingCollector(name, ())
    label_column = LabelColumn(label, options.words, collector.notes)

    def to_label(word: Any) -> float:
        """Return a label, NaN for an empty one, and 0 for an unknown word, which is counted."""
        try:
            return label_column.label_of(word)
        except UnlabelledError as error:
            collector.unlabelled_words[error.word] += 1
            return np.nan
        except UnknownWordError as error:
            collector.unknown_words[error.word] += 1
            collector.label_forms = error.forms
            return 0

    wanted = "a label for each trace, 1 (success) or 0 (failure)"
    with instead(DataError, f"Expected {wanted}", ValueError, TypeError):
        words = np.asarray(y)
        labels = np.array([to_label(word) for word in words.tolist()])
        X = np.atleast_1d(X)
    collector.check_label_words()
    numbers = np.arange(1, len(labels) + 1)
    about["notes"] = tuple(f"{note}." for note in collector.notes)
    if collector.unlabelled and len(labels) == len(X):
        is_labelled = ~np.isnan(labels)
        actual = f"{collector.unlabelled} that have no label yet"
        expect_data(bool(is_labelled.any()), f"labelled traces in {name}", actual)
        note = f"{collector.unlabelled_text(len(labels), 'traces')}: they are left out."
        about |= {"notes": (*about["notes"], note), "unlabelled": collector.unlabelled}
        for key in ("part", "cause", "rates"):
            if about.get(key) is not None:
                about[key] = np.asarray(about[key])[is_labelled]
        X = X[is_labelled]
        numbers = numbers[is_labelled]
        labels = labels[is_labelled]
        words = words[is_labelled]
    data = make_dataset(X, labels, name=name, **{"unit": "", **about})
    data, kept = _without_repeats(data, numbers)
    words = words[kept]
    has_rate = (data.rate_hz or data.rates is not None) and not options.rate_hz
    clock = "none, an array tells the rate" if has_rate else ""
    place = f"{'column' if options.labels else 'array'} {label}"
    readings = [Reading(place, str(word), clock) for word in words.tolist()]
    reading = describe_reading(readings, data.y.tolist(), "as the rows", rate_hz=options.rate_hz)
    return replace(data, reading=reading)


def _without_repeats(data: Dataset, numbers: NDArray[np.int64]) -> tuple[Dataset, list[int]]:
    """Return a data set without the traces that `leave_out_repeats` leaves out, and the positions
    of the others.

    numbers : by which notes and faults name the traces, shape (n,).
    """
    collector = RecordingCollector(data.name, data.channels)
    parts = [None] * len(data) if data.part is None else map(str, data.part)
    for number, trace, label, part in zip(numbers, as_traces(data.X), data.y, parts, strict=True):
        source = f"trace {number}"
        collector.recordings.append(Recording(trace, label=int(label), source=source, part=part))
    kept = leave_out_repeats(collector)
    columns = dict[str, Any]()
    for key in ("X", "y", "part", "cause", "rates"):
        column = getattr(data, key)
        columns[key] = None if column is None else column[kept]
    notes = (*data.notes, *(f"{note}." for note in collector.notes))
    return replace(data, faults=tuple(collector.faults), notes=notes, **columns), kept


def _from_list(traces: list[Any], labels: list[Any], options: LoadOptions) -> Dataset:
    """Make a data set of a list of arrays, Series or DataFrames of any length.

    A trace that cannot be read, or has other channels than the first, becomes a fault. Raises
    DataError if there are not as many labels, or no trace is left.
    """
    one_each = len(traces) == len(labels)
    expect_data(one_each, f"a label for each of {len(traces)} traces", len(labels))
    has_force = any(FORCE in getattr(trace, "columns", ()) for trace in traces)
    default = (FORCE,) if has_force else ()
    collector = RecordingCollector("data", options.channels or default)

    def read(number: int, trace: Any, word: Any) -> Recording:
        """Return a trace of the list as a recording; raise UnreadableError for a bad one."""
        columns = list(map(str, getattr(trace, "columns", ())))
        for name in collector.channels:
            if columns and name not in columns:
                raise UnreadableError(f"Expected a column {name}, got {listed(columns)}")
        selected = trace
        if columns and collector.channels:
            selected = trace[list(collector.channels)]
        x = as_trace(selected, None)
        label = label_of(word, options.words)
        if collector.recordings and len(x) != len(collector.recordings[0].trace):
            n = len(collector.recordings[0].trace)
            raise UnreadableError(f"Expected {n} channel(s), as the first has, got {len(x)}")
        collector.channels = collector.channels or spec_of(x, selected).columns
        clock = rate = None
        if hasattr(trace, "iloc") and trace.ndim == 2 and not options.rate_hz:
            # An index of numbers or times may be the clock.
            has_index = trace.index.dtype.kind in "fMm"
            clock = clock_of(trace.reset_index() if has_index else trace, options.time)
            rate = None if clock is None else rate_of(clock, trace.index)
        channel_units = tuple(units.split(name)[1] for name in collector.channels)
        text = "" if clock is None else f"column {clock.name} ({clock.form})"
        reading = Reading("array y", str(word), text)
        source = f"trace {number}"
        return Recording(x, rate, channel_units, reading=reading, label=label, source=source)

    for row in zip(count(1), traces, labels, strict=False):
        collector.add("data", partial(read, *row), row[0])
    return as_dataset(collector, options)
