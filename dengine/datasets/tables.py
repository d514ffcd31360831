"""Recordings in tables as text, Parquet or a DataFrame, which are wide or long.

A wide table has a row for each insertion: columns `FZ_0 ... FZ_999` are the samples of a channel
FZ, `0 ... 999` or `x1 ... x1000` those of a channel without a name. A long table has a row for each
sample and a column of parts. `load_dataset` calls `read_tables` and `from_frame`.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import DataError, listed
from . import labels, listings
from .assembly import as_dataset
from .clocks import rate_in_cell
from .collector import Recording, RecordingCollector
from .columns import MIN_NUMBERED, numbered_columns
from .containers import (
    number_rows,
)
from .dataset import Dataset, Fault, LoadOptions, UnreadableError
from .long_tables import concatenate_long, cut_by_windows, from_long, long_table_advice, unwrap_ring
from .recordings import cut_note
from .text import TextTable, read_table, with_part
from .wide_tables import place_of_part, turn_table, wide_rows, with_samples_in_columns

if TYPE_CHECKING:
    import pandas as pd

LIST_CELL = re.compile(r"[\[(]\s*[-+]?[\d.]+[\s,]")  # a list as text
# A folder that states the value of a column for the tables in it, as Spark and Hive name it.
PARTITION = re.compile(r"([^/=]+)=([^/]*)/")
NO_PARTITION = "__HIVE_DEFAULT_PARTITION__"


def read_tables(named: Mapping[str, Path], name: str, options: LoadOptions) -> Dataset:
    """Read text and Parquet files that are tables of one form, one after the other.

    One that cannot be read or has no rows is a fault. Raises DataError if this leaves none, or may
    leave parts incomplete, or if their columns or units differ.
    """
    collector = RecordingCollector(name, ())
    tables: dict[str, TextTable] = {}
    unread: list[Fault] = []
    for source, path in named.items():
        try:
            table = read_table(path, options)
            if table.frame.empty:
                end = f"the header in line {table.line} is its last row"
                why = str(next(iter(table.faults), end)).rstrip(".")
                raise UnreadableError(f"Expected rows that can be read, found none: {why}")
        except (OSError, UnreadableError) as error:
            line = getattr(error, "line", 0)
            unread.append(Fault(source, line, str(error).rstrip(".")))
            continue
        for key, value in PARTITION.findall(source):
            is_used = key in (options.label, *options.part_columns)
            is_used = is_used or key.lower() in labels.LABEL_COLUMNS
            if is_used and key not in table.frame:
                table.frame[key] = "" if value == NO_PARTITION else value
        collector.faults += [replace(fault, source=source) for fault in table.faults]
        tables[source] = table
        collector.notes.update(table.notes)
        others = (str(other) for other in path.parent.glob("*.csv") if other not in named.values())
        collector.label_file = next(others, collector.label_file)
    if unread:
        _check_parts_are_whole(named, tables, unread, options)
        collector.faults += unread
    first = next(iter(tables))
    for source, table in tables.items():
        units_of = dict(zip(tables[first].frame.columns, tables[first].units, strict=False))
        for column, unit in zip(table.frame.columns, table.units, strict=False):
            if unit != (other := units_of.get(column, unit)):
                wanted = f"the same unit of {column} in {first} and in {source}"
                actual = f"{other or 'none'} and {unit or 'none'}"
                raise DataError(f"Expected {wanted}, got {actual}; convert one.")
    return _from_tables(tables, options, collector)


def _check_parts_are_whole(
    named: Mapping[str, Path],
    tables: Mapping[str, TextTable],
    unread: Sequence[Fault],
    options: LoadOptions,
) -> None:
    """Raise DataError if no file is left, or parts may have had rows in a file that is not.

    They may if parts lie in several files, or no two files in a row are left that show where parts
    end; so do windows that count from the start of a recording whose first file is lost.
    """
    why = f"Cannot read {named[unread[0].source]}: {unread[0]}"
    if not tables:
        raise DataError(f"{why}.")
    parts_of = {
        source: set(map(str, table.frame[options.part]))
        for source, table in tables.items()
        if options.part in table.frame
    }
    in_order = list(named)
    pairs = [pair for pair in itertools.pairwise(in_order) if {*pair} <= {*tables}]
    n_files = Counter(itertools.chain.from_iterable(parts_of.values()))
    has_rows = any(len(parts_of[source]) < len(tables[source].frame) for source in parts_of)
    has_several = any(len(parts) > 1 for parts in parts_of.values())
    lost = "parts have rows in several files"
    is_lost = max(n_files.values(), default=1) > 1
    if has_rows and has_several and not (is_lost or pairs):
        is_lost, lost = True, "parts may have rows in several files"
    if not parts_of and options.labels is not None and unread[0].source == in_order[0]:
        is_lost, lost = True, "it is the first file, in which the recording begins"
    if is_lost:
        raise DataError(f"{why}; {lost}: mend it, or move it away with the parts that it may have.")


def from_frame(frame: pd.DataFrame, options: LoadOptions) -> Dataset:
    """Make a data set of a DataFrame, a wide or a long table; its rows count from 1 in faults.

    Raises DataError if a column holds lists or occurs twice, or columns that are needed are missing
    or not named.
    """
    table = TextTable(number_rows(frame), [], 0, [], "")
    return _from_tables({"row": table}, options, RecordingCollector("data", ()))


def _from_tables(
    tables: Mapping[str, TextTable], options: LoadOptions, collector: RecordingCollector
) -> Dataset:
    """Make a data set of tables of one form, wide or long.

    They are taken as long if the options name a column of times or a file of labels. Raises
    DataError if their columns differ or hold lists, and for a long table without these options.

    tables : by the names of their files, or "row" for a DataFrame; the index is the line.
    """
    tables = {
        source: table._replace(frame=_join_part_columns(table.frame, options, source))
        for source, table in tables.items()
    }
    _note_headers(tables, collector)
    tables, options = with_samples_in_columns(tables, options, collector)
    turned = {source: turn_table(table, options, source) for source, table in tables.items()}
    if any(table is not tables[source] for source, table in turned.items()):
        tables = turned
        options = replace(options, time=None)
    frames = {source: table.frame for source, table in tables.items()}
    first = next(iter(frames))
    options = _without_rate_column(frames[first], options)
    for source, frame in frames.items():
        _check_columns(frame, source)
        if differing := listed(sorted(_column_forms(frame) ^ _column_forms(frames[first]))):
            wanted = f"the same columns in {first} and in {source}"
            constant = [name for name in frame if len(set(frame[name])) == 1]
            do = ""
            if constant:
                do = f"; if a file is one recording, name its label's column: label={constant[0]!r}"
            raise DataError(f"Expected {wanted}, only one of them has {differing}{do}.")
    if options.labels is not None and options.time is None and _is_wide(frames[first], options):
        return _join_listing(tables, options, collector)
    if options.time is not None or options.labels is not None:
        cut_lines = {(source, table.cut_line) for source, table in tables.items()}
        cut = [fault for fault in collector.faults if (fault.source, fault.line) in cut_lines]
        collector.faults = [fault for fault in collector.faults if fault not in cut]
        collector.notes.update(map(cut_note, cut))
        frames = {key: unwrap_ring(frame, options, collector) for key, frame in frames.items()}
        frame, is_repeated = concatenate_long(frames, options)
        frame, windows = cut_by_windows(frame, tables[first], options, collector)
        return from_long(frame, is_repeated, options, collector, first, tables[first], windows)
    if advice := long_table_advice(frames[first], options, collector.label_file):
        columns = listed(frames[first].columns)
        actual = f"a row a sample: {columns}"
        raise DataError(f"Expected a row an insertion, got {actual}; a long table needs {advice}.")
    for source, table in tables.items():
        for line, part, read in wide_rows(table, options, collector, source):
            column = table.column_of.get(line)
            where = f"{source}, column {column}" if column else place_of_part(source, part)
            collector.add(where, read, 0 if column else line)
    _leave_out_repeated_rows(collector)
    return as_dataset(collector, options)


def _without_rate_column(frame: pd.DataFrame, options: LoadOptions) -> LoadOptions:
    """Return options without a column of times that states the rate of each row of a wide table."""
    is_rate = rate_in_cell(options.time or "", 1) is not None
    return replace(options, time=None) if is_rate and _is_wide(frame, options) else options


def _note_headers(tables: Mapping[str, TextTable], collector: RecordingCollector) -> None:
    """Add a note on each table in which the header comes again."""
    for source, table in tables.items():
        if lines := list(table.blocks)[1:]:
            text = f"The header of {source} comes again, and is left out there: line"
            collector.notes[f"{text} {listed(lines)}"] = 1


def _is_wide(frame: pd.DataFrame, options: LoadOptions) -> bool:
    """Return whether a table has columns of samples, and a row for most parts."""
    n_parts = frame[options.part].nunique() if options.part in frame else len(frame)
    return len(frame) < 2 * n_parts and _largest_channel(frame) >= MIN_NUMBERED


def _join_part_columns(frame: pd.DataFrame, options: LoadOptions, source: str) -> pd.DataFrame:
    """Join the columns of parts by `with_part`; raise DataError if some of them are missing."""
    missing = [name for name in options.part_columns[1:] if name not in frame]
    if options.part not in frame and 0 < len(missing) < len(options.part_columns) - 1:
        wanted = f"columns {options.part} of parts' numbers in {source}"
        actual = f"{listed(missing)} is none of {listed(frame.columns)}"
        raise DataError(f"Expected {wanted}, {actual}.")
    return with_part(frame, options)


def _leave_out_repeated_rows(collector: RecordingCollector) -> None:
    """Leave out the rows of wide tables that repeat a row of another file, as of an upload again.

    Part, label and all samples are equal; a note names these rows.
    """
    file_of = dict[tuple[Any, ...], str]()
    repeated = list[str]()
    kept = list[Recording]()
    for recording in collector.recordings:
        file = recording.source.rpartition(", ")[0]
        content = (recording.part, recording.label, recording.trace.tobytes())
        if file_of.setdefault(content, file) != file and np.ptp(recording.trace) > 0:
            repeated.append(recording.source)
        else:
            kept.append(recording)
    if repeated:
        collector.recordings = kept
        text = f"{len(repeated)} rows repeat one of another file, and are left out"
        collector.notes[f"{text}: {listed(repeated)}"] = 1


def _largest_channel(frame: pd.DataFrame) -> int:
    """Return the number of columns of the channel that has most numbered columns; 0 for none."""
    return max(map(len, numbered_columns(frame.columns).values()), default=0)


def _join_listing(
    tables: Mapping[str, TextTable], options: LoadOptions, collector: RecordingCollector
) -> Dataset:
    """Make a data set of wide tables whose labels are in a file, by the numbers of parts.

    The second row of part 7 is called "7 (2)". Raises DataError if a table has no column of parts.
    """
    read_of_part = dict[str, Callable[[], Recording]]()
    n_rows = Counter[str]()
    for source, table in tables.items():
        if options.part not in table.frame:
            samples = max(numbered_columns(table.frame.columns).values(), key=len)
            others = table.frame.drop(columns=[name for _, name in samples])
            likely = _column_in_listing(others, str(options.labels))
            wanted = f"the column of parts that the file of labels names, as in part={likely!r}"
            raise DataError(f"Expected {wanted}, found {listed(others.columns)}.")
        for _, part, read in wide_rows(table, options, collector, source):
            n_rows[part] += 1
            read_of_part[part if n_rows[part] == 1 else f"{part} ({n_rows[part]})"] = read
    listed_by = replace(options, part="part")
    listing = listings.labels_in_file(str(options.labels), list(read_of_part), listed_by)
    labels.collect_recordings(read_of_part, lambda read: read(), listing, collector)
    return as_dataset(collector, options)


def _column_in_listing(frame: pd.DataFrame, listing: str) -> str:
    """Return the column with most values that a listing names too, without leading zeros."""
    rows = read_table(Path(listing), LoadOptions(), as_text=True).frame
    names = {str(cell).lstrip("0") for cell in rows.to_numpy(dtype=object).ravel()}
    n_named = {
        column: sum(str(cell).lstrip("0") in names for cell in frame[column]) for column in frame
    }
    return max(n_named, key=n_named.__getitem__, default="Serial")


def _check_columns(frame: pd.DataFrame, source: str) -> None:
    """Raise DataError if a column of a table holds lists, by its first cell, or two columns have
    one name.
    """
    for name in frame.columns:
        is_single = (frame.columns == name).sum() == 1 and len(frame) > 0
        cell = frame[name].iloc[0] if is_single else None
        is_text = isinstance(cell, str) and LIST_CELL.match(cell) is not None
        if is_text or isinstance(cell, list | tuple | np.ndarray):
            wanted = f"a number or a text a cell in {source}"
            do = "give a trace a row, its samples a column each"
            do = f"{do}, or load_dataset((X, y)) with the lists as X"
            raise DataError(f"Expected {wanted}, column {name} holds lists; {do}.")
    repeated = frame.columns[frame.columns.duplicated()]
    if len(repeated):
        message = f"Expected each column once in {source}, {repeated[0]} is there more often."
        raise DataError(message)


def _column_forms(frame: pd.DataFrame) -> set[str]:
    """Return the columns of a table, with one name for all numbered columns of a channel."""
    channel_of = {
        name: channel
        for channel, columns in numbered_columns(frame.columns).items()
        if len(columns) > 1
        for _, name in columns
    }
    return {channel_of.get(name, name) for name in frame.columns}
