"""Read the recordings of a folder, a file or a DataFrame, exactly as a description says.

Files are split into one table for each part, each table becomes a `Recording`, and the recordings
a `Dataset`. What does not follow the description becomes a `Fault`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...errors import DataError, instead, listed
from ...records import FITS, Floats, TraceArray
from ...traces import can_fit_length, fit_length
from ..checks import check_description, without_repeats
from ..dataset import Dataset, Faults, Progress, make_dataset, unit_text
from ..description import ANY, ORDERS, Channel, Description, RowMeanings, TextForm
from ..table import Recording, Table, UnreadableError, as_word
from ..units import bare, conversion, unit_in
from .bags import read_bag
from .clock import check_steps, times_of
from .files import (
    caught,
    find_files,
    first_of,
    is_unsorted,
    natural_key,
    read_file,
    sort_key,
    unread_note,
)
from .frames import read_frame
from .places import LabelReader, listing_table, part_of, read_labels, stem_of
from .split import split, table_of
from .windows import cut

FRAME = "table"  # what a DataFrame is called in messages
ROUNDING = 0.01  # of a step: float64 misses a date by less
WORDS = {1: "good", 0: "bad", None: "not checked"}


def recording_of(
    table: Table, description: Description, labels: Sequence[LabelReader]
) -> Recording | None:
    """Return the recording of a part; None if it has no label, because it was not checked.

    The description says how the table of a part is read. Rows that its section `[rows]` drops, by a
    word in some column, are left out, then rows are sorted by time if `time.sort` is set, and their
    times are checked (`check_steps`); samples of rows that `[rows]` calls invalid are NaN. The
    `length` of the recording is the number of rows kept. A reader of a listing, a file with a row
    for each recording or part, adds the key that it found to its `used`. The times and samples of a
    part that was not checked must be readable, too, but may be of any length. If the description
    says nothing of part numbers, a part that was cut out of a long recording (`[windows]`) has as
    part number its key in the listing of such parts, or its number from 1 if a trigger, a condition
    on a signal, cuts.

    Parameters
    ----------
    table : Table
        The table of the part.
    description : Description
    labels : sequence of LabelReader
        A reader for the source of labels, then for each source that must agree with it.

    Raises
    ------
    UnreadableError
        If the table does not follow the description, is damaged, or has too few or too many samples
        for a trace, by its section `[traces]`.
    DataError
        If a format of times in the description is invalid.
    """
    clock = description.time
    table = kept_rows(table.whole(), description.rows)
    seconds = times_of(table, clock, description.text) if clock.column else None
    samples = [samples_of(table, *item, description.text) for item in description.channels.items()]
    lengths = [*map(len, samples if seconds is None else [*samples, seconds])]
    if len({*lengths}) > 1:
        raise UnreadableError(f"Expected channels and times of one length, got {lengths}")
    if seconds is not None:
        if clock.sort:
            rows = np.argsort(seconds, kind="stable")
            with instead(UnreadableError, "Expected columns of one length", IndexError):
                table = table.take(rows)
            seconds = seconds[rows]
            samples = [values[rows] for values in samples]
        check_steps(seconds, clock, table)
    for column, about in description.rows.items():
        is_lost = np.array(about.kinds(table.words(column))) == "invalid"
        samples = [np.where(is_lost, np.nan, values) for values in samples]
    part = part_of(description.part, table)
    if not part and description.is_cut:
        part = table.path
    label = label_of(labels, table, part)
    if label is None:
        return None
    rank = rank_of(table, seconds, description)
    return Recording(
        table.source,
        fitted(np.stack(samples), seconds, description),
        label,
        part,
        lengths[0],
        rank,
    )


def rank_of(table: Table, seconds: Floats | None, description: Description) -> Any:
    """Return what recordings are sorted by, as `order` of the description says: `Recording.rank`.

    `table` has the samples of a part, and `seconds`, shape (n,), their times; None without a clock.
    The result is the `natural_key` of the path, without words for labels, if `order` is "path"; the
    first time if it is "time"; "" if it is "name", or "time" without a clock; and the `sort_key` of
    the first word of the column if it is a column. Raises UnreadableError if `order` is a column
    that is missing, has lists or no rows, or whose first word is empty or has a date that cannot be
    sorted (`is_unsorted`).
    """
    order = description.order
    if order == "path":
        return natural_key(stem_of(description, table.path))
    if order not in ORDERS:
        word = table.one_word(order, "first")
        table.refuse(
            np.array([not word or is_unsorted(word)]),
            "a word to sort by, dates with the year in front",
            order,
        )
        return sort_key(word)
    return "" if order == "name" or seconds is None else seconds[0]


@instead(UnreadableError, "Expected columns of one length", IndexError, ValueError)
def kept_rows(table: Table, rows: RowMeanings) -> Table:
    """Return a table of the rows that are samples; rows of lost samples stay, unchanged.

    A word is the text of a cell, and lost samples are read as NaN later. A column takes its words
    from the rows that the columns before it keep; a column of a single cell drops no rows. Raises
    UnreadableError for a word whose meaning is not stated, and for a column that is missing, has
    lists or is of another length.

    rows : for each column, the words that keep a row, drop it, or mark its samples as lost; `*` is
    any other word.
    """
    for column, about in rows.items():
        kinds = np.array(about.kinds(table.words(column)), dtype=np.str_)
        table.refuse(
            kinds == "",
            f"one of the words {listed(sorted(about.keep + about.drop + about.invalid))}",
            column,
        )
        if len(kinds) != 1:
            table = table.take(kinds != "drop")
    return table


def samples_of(table: Table, column: str, channel: Channel, form: TextForm) -> Floats:
    """Return the samples of a channel, converted to its unit and times its factor, shape (n,).

    The cells of `column` are in the unit that the file states for it, or else in the unit in its
    name, or else in the channel's unit. `form` says how numbers are written, and which words stand
    for a lost sample, which is NaN. Raises UnreadableError if the file and the channel state units
    that cannot be converted (an empty unit fits any); if the column is missing; or if a cell is no
    number, is infinite or is too large for float32. A unit of another quantity in the name is
    ignored.
    """
    values = table.numbers(column, form)
    unit = table.units.get(column)
    factor = conversion(unit or unit_in(column.rstrip(ANY)), channel.unit)
    if factor is None and unit:
        raise UnreadableError(
            f"Expected the unit {channel.unit}, or one that converts to it, got {bare(unit)}",
            form.units + table.header * isinstance(form.header, str),
            column,
        )
    # A name may have another quantity, as `U [V]` of a force.
    return values * ((factor or 1.0) * channel.factor)


def label_of(labels: Sequence[LabelReader], table: Table, part: str) -> int | None:
    """Return the label of a part, 1 good or 0 bad; None if it was not checked.

    `labels` has a reader for the source of labels (a column, a path, a line or a listing), and for
    each source that must agree with it; `table` and `part` are the table and the number of the
    part. The reader of a listing, a file with a row for each part or recording, adds the key of the
    part that it found to its `used`. Raises UnreadableError if a source has no label for the part,
    a word without a stated meaning or contradictory rows, or if the sources do not agree, also if
    only one of them says that it was not checked. Raises it also if another file had the key in a
    listing before, unless the key is the number of the part, which several files may have.
    """
    by_source = [reader.label(table, part) for reader in labels]
    for i, label in enumerate(by_source):
        if label != by_source[0]:
            raise UnreadableError(
                f"Expected labels that agree, [label] says {WORDS[by_source[0]]}, [[check]] {i} "
                f"says {WORDS[label]}",
                column=labels[i].source.column,
            )
    return by_source[0]


def read_recordings(
    source: Any, description: Description, progress: Progress | None = None
) -> Dataset:
    """Read the recordings that a description describes.

    Recordings are files or tables with the samples of parts; the description says how they are
    read.

    Parameters
    ----------
    source : Path or DataFrame
        A folder, a file or a table.
    description : Description
    progress : callable, optional
        Called with 1 after each file, also one that cannot be read; once for a ROS bag or a table.

    Returns
    -------
    Dataset
        Its traces are in the order that `order` of the description states; equal ones stay in the
        order of the files. A recording that does not follow the description or repeats another is
        left out, and one of its `faults` says why, also of a file that cannot be read; of
        recordings with equal samples and different labels none is kept. One whose part was not
        checked counts in `unlabelled`. `notes` says if rows of a listing of labels, a file, name no
        recording, or there are fewer recordings than when the description was made.

    Raises
    ------
    DataError
        If the description does not pass `check_description`, no file is found or a pattern in
        `files` is malformed, a bag or a listing of labels cannot be read, no recording is left, or
        `make_dataset` refuses the traces, like those with more channels than samples. If a trigger
        begins the parts, also if the listing of labels has fewer rows than there are parts.
    SettingError
        If `windows.trigger`, the condition at which long recordings are cut, is malformed.
    ValueError
        If the index of the DataFrame is named like one of its columns.
    """
    check_description(description)
    faults: Faults = []
    name, base, files = files_of(source, description, faults)
    labels = [
        read_labels(label, lambda name: listing_table(base / name, description.text))
        for label in description.labels
    ]
    parts = list[Recording | None]()  # None: without a label
    for file in files:
        with caught(faults, file.source if isinstance(file, Table) else file):
            for part in parts_of(file, description, base):
                with caught(faults, part.source):
                    parts.append(recording_of(part, description, labels))
        if progress is not None:
            progress(1)
    n_found = len(parts) + len(faults)
    n_listed = len(labels[0].listing)
    by_number = description.windows.trigger and not description.part.column
    if by_number and 0 < n_listed < n_found:  # else later parts would have the labels of others
        raise DataError(
            f"Expected a row of {description.label.listing} for each of {n_found} starts of the "
            f"trigger, got {n_listed}."
        )
    n_unlabelled = parts.count(None)
    labelled = sorted(filter(None, parts), key=lambda recording: recording.rank)
    recordings, repeats = without_repeats(labelled)
    faults += repeats
    if not recordings:
        raise DataError(
            f"Expected recordings in {name}, none is left: {len(faults)} have faults, "
            f"{n_unlabelled} no label.{first_of(faults)}"
        )
    n_seen = description.seen.recordings
    notes = [unread_note(source, description), *(label.unused_note() for label in labels)]
    if n_found < n_seen:
        notes.append(f"The description was made for {n_seen} recordings, now there are {n_found}.")
    return replace(
        dataset_of(recordings, description),
        name=name,
        faults=tuple(faults),
        notes=tuple(filter(None, notes)),
        unlabelled=n_unlabelled,
    )


def files_of(
    source: Any, description: Description, faults: Faults
) -> tuple[str, Path, Sequence[str | Table]]:
    """Return the name of a data set, its folder, and what to read: files in it, or a table.

    The data set has the name of the folder, or of the file without its suffix. The description says
    how the recordings in the files are read. All files of a ROS bag are read here, into one table;
    a fault of each damaged one is appended to `faults`. A DataFrame gives one table, called
    "table", and the current folder. Raises DataError if there is no file, a pattern in `files` is
    malformed, or the bag cannot be read (see `read_bag`), SettingError if `windows.trigger` of a
    bag, the condition at which a part begins, is malformed, and ValueError if the index of the
    DataFrame is named like one of its columns.
    """
    if not isinstance(source, Path):
        return FRAME, Path(), [read_frame(source, FRAME)]
    is_folder = source.is_dir()
    name = source.resolve().name if is_folder else source.stem
    base = source if is_folder else source.parent
    files = find_files(source, description)
    if description.layout != "mcap":
        return name, base, files
    title = files[0] if len(files) == 1 else name
    return name, base, [read_bag(base, files, title, description, faults)]


def parts_of(file: str | Table, description: Description, base: Path) -> Iterator[Table]:
    """Yield the tables of the parts in a file, or in a table that was read already.

    The description says how files are read. Each table into which `split` divides the file is one
    part, or, if the section `[windows]` is stated, a long recording that is cut into parts. A table
    is left out if a column that the section `[rows]` names has a single cell in it, with a word to
    drop (`is_dropped`); if all are left out, nothing is yielded or raised. `base` is the folder of
    the file, and of the listing in `[windows]`, a file with the parts' starts and ends. Raises
    UnreadableError or DataError if the file cannot be read, UnreadableError if `split` yields no
    table, DataError if it cannot be split, or one of its recordings cannot be cut (those before it
    are yielded), SettingError if `windows.trigger`, the condition at which a part begins, is
    malformed, and LookupError for an encoding that Python does not know.
    """
    if not isinstance(file, Table):
        file = table_of(read_file(base / file), file, description)
    part = None
    for part in split(file, description):
        if not is_dropped(part, description.rows):
            yield from cut(part, description, base) if description.is_cut else [part]
    if part is None:
        raise UnreadableError(
            f"Expected parts, found none in the columns {listed(file.columns)}", file.header
        )


def is_dropped(part: Table, rows: RowMeanings) -> bool:
    """Return whether a column in `rows` has a single cell for a part, with a word to drop.

    `part` has the samples of one workpiece, or a long recording of several. `rows` says by column
    what words keep or drop a row; `*` is any other word. The whole part is left out then, for
    example a row with the samples of another signal, in a table with a row for each part. A column
    that the part lacks, or a word without a meaning, drops nothing.
    """
    return any(
        len(cells) == 1 and rows[name].kinds(map(as_word, cells)) == ["drop"]
        for name, cells in part.columns.items()
        if name in rows
    )


def dataset_of(recordings: Sequence[Recording], description: Description) -> Dataset:
    """Return the data set of recordings, at least one, in the given order.

    `ordered` is False if the label changes exactly once from one recording to the next, since the
    recordings are then sorted by label. `fit` is "strict" if the recordings were resampled at the
    stated rate of their clock, since live traces then come at this rate; otherwise it is
    `traces.lengths` of the description, "pad" for "pad-all". `fit` says what happens to live traces
    of another length, as `traces.lengths` does for recordings. `limit`, the range of the sensor, is
    that of the first channel, None if it is not known. `part` is None if no recording has a part
    number. Raises DataError if `make_dataset` refuses the traces.
    """
    X, labels, parts, sources, lengths = (
        np.array([getattr(recording, key) for recording in recordings])
        for key in ("trace", "label", "part", "source", "length")
    )
    channels = [*description.channels.values()]
    fit = description.traces.lengths.removesuffix("-all")
    return make_dataset(
        X,
        labels,
        rate_hz=description.time.rate_hz or None,
        unit=unit_text([channel.unit for channel in channels]),
        limit=channels[0].limit or None,
        part=parts if parts.any() else None,
        channels=tuple(description.channels),
        source=sources,
        fit="strict" if fit == "resample" and description.time.column else fit,
        lengths=lengths,
        ordered=np.count_nonzero(np.diff(labels)) != 1,
    )


def fitted(samples: Floats, seconds: Floats | None, description: Description) -> TraceArray:
    """Return the trace (C, T) of samples (C, n), brought to T samples as `[traces]` says.

    This section of the description has T, `samples`, and what happens to another length, `lengths`.
    `seconds`, shape (n,), has the times of the samples; None without a clock. With `resample` and
    times, the samples are interpolated at the stated rate from the first time on. A longer
    recording loses its end; one that ends up to one step early is accepted, and its last sample
    repeated. Otherwise it is fitted like a live trace (`can_fit_length`, `fit_length`): `strict`
    takes only T samples, `cut` drops the end, `pad` drops the end or repeats the last sample, and
    `resample` interpolates evenly, both if there are half to twice T samples. `pad-all` is like
    `pad`, but takes any length but 0.

    Raises
    ------
    UnreadableError
        If the recording is too short, or too long, to be fitted without making up data.
    """
    about = description.traces
    rate = description.time.rate_hz
    n = samples.shape[1]
    kind = FITS.index(about.lengths.removesuffix("-all"))
    wrong = f"Expected {about.samples} samples, got {n}"
    if about.lengths == "resample" and seconds is not None:
        seconds = seconds - seconds[0]
        times = np.arange(about.samples) / rate
        wrong += f", which last {seconds[-1]:.4g} s and not {times[-1]:.4g} s"
        if times[-1] <= seconds[-1] + (1 + ROUNDING) / rate:
            return np.array([np.interp(times, seconds, row) for row in samples], np.float32)
    elif can_fit_length(n, about.samples, kind) or (about.lengths == "pad-all" and n > 0):
        return fit_length(torch.from_numpy(samples.astype(np.float32)), about.samples, kind).numpy()
    raise UnreadableError(f"{wrong}; see traces.lengths, which is {about.lengths}")
