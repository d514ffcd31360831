"""A folder of NumPy archives, one for each insertion, as a recorder writes them.

An archive has arrays of one length, one for each channel and perhaps the times, or one array
(C, T). Its label is in its name, in a scalar array `y`, or in a file of labels. `load_dataset`
calls `read_archive_each` for a folder of which `hold_one_each` is true.
"""

from __future__ import annotations

import zipfile
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, listed
from ..files import read_archive, read_errors
from ..traces import is_time_column
from . import label_names, labels, listings
from .assembly import as_dataset
from .clocks import UNSURE_RATE, rate_of_scalar
from .collector import Reading, Recording, RecordingCollector
from .columns import choose_channels
from .dataset import Dataset, Fault, LoadOptions, UnreadableError
from .recordings import rows_to_trace

if TYPE_CHECKING:
    import pandas as pd

LABEL = "y"


def find_whole(named: Mapping[str, Path]) -> tuple[dict[str, Path], list[Fault]]:
    """Return the archives of a folder that can be unpacked, and the faults of the others.

    A single archive is kept untried. Raises DataError if all are damaged.
    """
    if len(named) == 1:
        return dict(named), []
    whole = dict[str, Path]()
    faults = list[Fault]()
    for name, path in named.items():
        try:
            read_archive(path, (), name=path.name)
            with read_errors(path.name, "an .npz file"), zipfile.ZipFile(path) as archive:
                if (member := archive.testzip()) is not None:
                    raise ValueError(f"{member} in it is damaged")
            whole[name] = path
        except DataError as error:
            faults.append(Fault(name, 0, str(error).rstrip(".")))
    if not whole:
        raise DataError(f"{faults[0].message}.")
    return whole, faults


def hold_one_each(named: Mapping[str, Path], options: LoadOptions) -> bool:
    """Return whether each archive of a folder holds one insertion, as the first and last tell.

    These two have arrays of the same names, and the first a label of one value if any, and traces
    of one row, or of several channels beside such a label or one in its name. False for a single
    archive. Raises DataError if one of the two cannot be read.
    """
    paths = list(named.values())
    if len(paths) < 2:
        return False
    arrays, names = read_archive(paths[0])
    if set(names) != set(read_archive(paths[-1], ())[1]):
        return False
    label = arrays.get(options.label or LABEL)
    traces = [x for x in arrays.values() if x.dtype.kind in "iuf" and x.size > 1]
    if (label is not None and label.size > 1) or not traces:
        return False
    dimensions = max(np.squeeze(x).ndim for x in traces)
    has_label = label is not None
    with suppress(UnreadableError):
        label_names.labels_in_names(None, options.words).find(next(iter(named)))
        has_label = True
    return dimensions == 1 or (dimensions == 2 and has_label)


def read_archive_each(named: Mapping[str, Path], name: str, options: LoadOptions) -> Dataset:
    """Read a folder of archives, one for each insertion.

    Parameters
    ----------
    named : mapping of str to Path
    name : str
        Name of the data set.
    options : LoadOptions

    Returns
    -------
    Dataset
        In the natural order of the names; an archive that cannot be read is among its faults.

    Raises
    ------
    DataError
        If no recording can be read, most have no label, or the channel is not named.
    """
    all_arrays = (read_archive(path)[0] for path in named.values())
    fitting = next((arrays for arrays in all_arrays if not _other_length(arrays, options)), None)
    frame = _to_frame(fitting or read_archive(next(iter(named.values())))[0], options)
    available = [column for column in frame.columns if not is_time_column(column)]
    several = f"{options.channels[0]}_0" if options.channels else ""
    channels = tuple(column for column in available if several and column.startswith(several[:-1]))
    if several not in available:
        channels = choose_channels(available, options)
    collector = RecordingCollector(name, channels)

    def read(path: Path) -> Recording:
        """Return the trace of an archive, with the rate that it states or its times tell."""
        arrays, _ = read_archive(path)
        if why := _other_length(arrays, options):
            raise UnreadableError(why)
        rows = _to_frame(arrays, options)
        missing = [column for column in channels if column not in rows]
        if missing:
            raise UnreadableError(f"Expected arrays {listed(missing)}, got {listed(arrays)}")
        places = [rows.columns.get_loc(column) for column in channels]
        timed = rows_to_trace(rows, places, options, collector.notes)
        unit = (str(arrays["unit"]),) * len(channels) if "unit" in arrays else ()
        rate = _stated_rate(arrays)
        if rate and not options.rate_hz:
            reading = Reading(clock="none, an array tells the rate")
            timed = timed._replace(rate_hz=rate, reading=reading)
        return timed._replace(rate_hz=None if options.rate_hz else timed.rate_hz, units=unit)

    collector.order = "by name, numbers by size"
    labels.collect_recordings(named, read, _label_source(named, options), collector)
    return as_dataset(collector, options)


def _stated_rate(arrays: Mapping[str, NDArray[Any]]) -> float | None:
    """Return the rate in hertz that an array of one number states; None without one."""
    named = ((name, x) for name, x in arrays.items() if not UNSURE_RATE.fullmatch(name.lower()))
    rates = (rate_of_scalar(name, x) for name, x in named)
    return next(filter(None, rates), None)


def _other_length(arrays: Mapping[str, NDArray[Any]], options: LoadOptions) -> str:
    """Return what is wrong if a stated channel has another length than the samples; "" if all fit.

    So it is if arrays of times have, and none of the samples' length is there. Times do not count
    where the rate is known without them.
    """
    frame = _to_frame(arrays, options)
    lengths = {
        name: len(x)
        for name, x in arrays.items()
        if x.ndim == 1 and x.size > 1 and x.dtype.kind in "iufMm"
    }
    clocks = {name for name in lengths if name == options.time or is_time_column(name)}
    if options.rate_hz or _stated_rate(arrays) or options.time == "none" or clocks & {*frame}:
        clocks = set()
    others = [name for name in (*options.channels, *clocks) if name in lengths]
    others = [name for name in others if lengths[name] != len(frame)]
    if not others:
        return ""
    actual = {**{str(name): len(frame) for name in frame.columns[:1]}, **lengths}
    names = dict.fromkeys([*others, *map(str, frame.columns[:1])])
    texts = ", ".join(f"{name} has {actual[name]}" for name in names)
    return f"Expected arrays of one length, {texts} values"


def _to_frame(arrays: Mapping[str, NDArray[Any]], options: LoadOptions) -> pd.DataFrame:
    """Return the arrays of numbers or times that have an archive's most frequent length, a column
    each.

    An array (C, T), or (T, C) with C < T, has C columns, `X_0`, `X_1`, ..., or those that an array
    of C texts names.
    """
    import pandas as pd

    texts = {len(x): x for x in arrays.values() if x.ndim == 1 and x.dtype.kind in "US"}
    columns = dict[str, NDArray[Any]]()
    for name, x in arrays.items():
        x = np.squeeze(x)
        if x.dtype.kind not in "iufMm" or x.size < 2 or name == options.label:
            continue
        rows = x if x.ndim == 1 else x if x.shape[0] < x.shape[-1] else x.T
        if x.ndim == 1:
            columns[name] = rows
            continue
        names = texts.get(len(rows), [f"{name}_{c}" for c in range(len(rows))])
        columns |= dict(zip(map(str, names), rows, strict=True))
    lengths = Counter(len(x) for x in columns.values())
    length = max(lengths, key=lambda n: (lengths[n], n), default=0)
    return pd.DataFrame({name: x for name, x in columns.items() if len(x) == length})


def _label_source(named: Mapping[str, Path], options: LoadOptions) -> labels.LabelSource:
    """Return the source of the labels: a file of them, an array if the first archive has it, or the
    names.

    Unless the user states the array, the names must not contradict the file or the array.
    """
    others = []
    if options.label is None:
        others = [label_names.labels_in_names(None, options.words)]
    if options.labels is not None:
        listing = listings.labels_in_file(options.labels, list(named), options)
        return labels.labels_that_agree(listing, others, listing.trust)
    array = options.label or LABEL
    if array not in read_archive(next(iter(named.values())), ())[1]:
        return label_names.labels_in_names(options.label, options.words)
    notes = Counter[str]()
    column = labels.LabelColumn(array, options.words, notes)
    place = f"its array {array}"

    def find(name: str) -> labels.SourcedLabel:
        """Return the label in an archive's array."""
        try:
            cells = read_archive(named[name], (array,))[0].get(array, np.array([]))
        except DataError as error:
            raise UnreadableError(str(error).rstrip(".")) from error
        return column.find(np.atleast_1d(cells).tolist(), place)

    source = labels.LabelSource(find, "name the array of labels (label)", place, notes=notes)
    return labels.labels_that_agree(source, others, f"name the one to trust: label={array!r}")
