"""Tables with a row, or a column, for each insertion."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, listed
from ..traces import is_time_column
from . import label_names, labels, units
from .clocks import (
    NO_CLOCK,
    clock_of,
    is_rising,
    rate_in_cell,
    rate_of,
)
from .collector import MAX_LABEL_WORDS, Reading, Recording, RecordingCollector
from .columns import (
    MAX_STATIONS,
    MIN_NUMBERED,
    NUMBER_LAST,
    choose_label_column,
    compared_columns,
    count_labels,
    numbered_columns,
    sample_columns,
    unit_columns,
)
from .curves import expand_curves
from .dataset import Fault, LoadOptions, UnreadableError
from .pieces import join_pieces
from .scales import may_scale, operation, stated_factors
from .text import SPREADSHEET_DATE, TextTable, is_mostly_numbers, parse_numbers

if TYPE_CHECKING:
    import pandas as pd


def with_samples_in_columns(
    tables: Mapping[str, TextTable], options: LoadOptions, collector: RecordingCollector
) -> tuple[Mapping[str, TextTable], LoadOptions]:
    """Return tables with a column for each sample where a cell holds a curve, and their options.

    Pieces of a curve are joined. Rows whose curves or clocks contradict each other are faults.
    Raises DataError if no row is left, or the column of times that the user stated is not there.
    """
    result = dict[str, TextTable]()
    plain = list[str]()
    tables = join_pieces(tables, options, collector)
    for source, table in tables.items():
        expanded = expand_curves(table.frame, options)
        if expanded.frame is table.frame:
            plain.append(source)
            continue
        part_of = dict(zip(table.frame.index, _parts_of_rows(table.frame, options), strict=True))
        for line, why in expanded.wrong.items():
            collector.faults.append(Fault(place_of_part(source, part_of[line]), line, why))
        collector.notes.update(expanded.notes)
        if expanded.frame.empty:
            continue
        _check_clock(table.frame, expanded.frame, options.time, source, collector)
        if expanded.unread:
            collector.notes[f"Not read: the columns {listed(expanded.unread)}"] = 1
        if expanded.rate_hz is not None:
            clock = f"column {expanded.clock}, in which each cell has all times"
            table = table._replace(rate_hz=expanded.rate_hz, clock=clock)
        wrong = {line: UnreadableError(why) for line, why in expanded.damaged.items()}
        numbers = table.numbers.replace("whole numbers", "curves in cells")
        frame = expanded.frame
        result[source] = table._replace(frame=frame, units=[], numbers=numbers, wrong=wrong)
    if len(plain) == len(tables):
        return tables, options
    why = "Expected a curve in a cell, as in other files, got none or an empty one"
    collector.faults += [Fault(source, 0, why) for source in plain]
    if not result:
        raise DataError(f"Cannot read {collector.faults[-1]}.")
    return result, replace(options, time=None)


def place_of_part(source: str, part: str) -> str:
    """Return the file of a row, with its part if that is known, for a fault."""
    return f"{source}, part {part}" if part else source


def _check_clock(
    frame: pd.DataFrame,
    expanded: pd.DataFrame,
    time: str | None,
    source: str,
    collector: RecordingCollector,
) -> None:
    """Add a note if a stated column of times has one value for each curve, and states no rate.

    Raises DataError if it is not there. `expanded` is the table without its columns of curves.
    """
    if time not in (None, NO_CLOCK, *frame):
        wanted = f"a column {time} of times in {source}"
        raise DataError(f"Expected {wanted}, found {listed(frame.columns)}.")
    if time in expanded and rate_in_cell(str(time), 1) is None:
        text = f"Column {time} has one value for each curve, and is no clock of samples"
        collector.notes[text] = 1


def turn_table(table: TextTable, options: LoadOptions, source: str) -> TextTable:
    """Transpose a table with a column for each part to a wide one, with a row for each part.

    Such a table has times in its first column, eight or more columns of numbers beside it, and
    labels in the names of these, in a row without a time, or in a listing. Any other table, as one
    of serials and numbered samples, is returned as it is. The index of the new rows counts the
    columns. Raises DataError if a spreadsheet made dates of numbers.
    """
    import pandas as pd

    frame = table.frame
    has_parts = options.part in frame.columns[1:]
    if not frame.columns.is_unique or frame.shape[1] <= MIN_NUMBERED or has_parts:
        return table
    first = str(frame.columns[0])
    numbers = frame.apply(pd.to_numeric, errors="coerce")
    is_sample = numbers.iloc[:, 0].notna()
    times = numbers[is_sample].iloc[:, 0]
    if not is_rising(times.to_numpy(dtype=np.float64)) or not numbers[is_sample].any().all():
        return table
    about = frame[~is_sample].set_index(first).T
    in_names = label_names.labels_in_names(None, options.words)
    parts, channel_units = _names_and_units(list(map(str, frame.columns[1:])), table.units[1:])
    label_counts = count_labels(parts, in_names)
    has_names = label_counts[None] < len(about) / 2
    unique = about.loc[:, about.columns.duplicated(keep=False) ^ True]
    rows = [
        name
        for name in unique
        if labels.LabelColumn(str(name), options.words, Counter()).has_labels(unique[name])
    ]
    if not (has_names or rows):  # words whose meaning the error asks for
        few = min(MAX_LABEL_WORDS, len(about) / 2)
        rows = [name for name in unique if 2 <= unique[name].nunique() <= few]
    is_listed = options.labels is not None and (
        is_time_column(first) or not numbered_columns(frame.columns)
    )
    if not (has_names or rows or is_listed or options.label in about):
        return table
    wrong = _wrong_in_columns(frame[is_sample].iloc[:, 1:], source)
    samples = frame[is_sample].iloc[:, 1:].T.set_axis(list(map(str, range(len(times)))), axis=1)
    wide = pd.concat([about, samples], axis=1).assign(**{options.part: parts})
    if any(channel_units):
        wide["unit"] = channel_units
    if has_names and not rows:
        wide["label"] = [_word_in_name(name, in_names) for name in parts]
    elif rows and options.label is None:
        wide = wide.rename(columns={rows[0]: "label"})
    rate = None
    with suppress(UnreadableError):
        clock = clock_of(frame[is_sample].iloc[:, :1], first, table.units)
        rate = None if clock is None else rate_of(clock, times.index)
    wide = wide.set_axis(range(2, len(wide) + 2))
    clock_text = "the first column, a column for each part"
    table = table._replace(frame=wide, units=[], rate_hz=rate, clock=clock_text)
    return table._replace(column_of=dict(enumerate(frame.columns[1:], start=2)), wrong=wrong)


def _names_and_units(
    columns: Sequence[str], row_of_units: Sequence[str]
) -> tuple[Sequence[str], list[str]]:
    """Return the parts that columns are named after, and the unit of each, "" without one.

    A unit stands in a row of units or in the name, as in `P-1001 (N)`, from which it is taken.
    """
    bare = [units.split(name)[0] for name in columns]
    in_names = [units.split(name)[1] for name in columns]
    if not all(in_names) or len(set(bare)) < len(bare):
        return columns, list(row_of_units)
    return bare, in_names


def _wrong_in_columns(samples: pd.DataFrame, source: str) -> dict[int, UnreadableError]:
    """Return what is wrong in each column of samples, by its place in the file from 2.

    Raises DataError if a spreadsheet made dates of numbers.
    """
    _, of_lines, _ = parse_numbers(samples)
    for line, message in of_lines.items():
        if any(map(SPREADSHEET_DATE.fullmatch, map(str, samples.loc[line]))):
            raise DataError(f"Cannot read {Fault(source, line, message)}.")
    wrong = {}
    for place, name in enumerate(samples.columns if of_lines else (), start=2):
        _, of_lines, _ = parse_numbers(samples[[name]])
        if of_lines:
            line = min(of_lines)
            wrong[place] = UnreadableError(of_lines[line], line)
    return wrong


def _word_in_name(name: str, source: labels.LabelSource) -> str:
    """Return the word that is the label in a name, else its last word; "" if that is a number."""
    with suppress(UnreadableError):
        return source.find(name).word
    return re.split(r"[\s_]", name)[-1].strip("0123456789")


def wide_rows(
    table: TextTable, options: LoadOptions, collector: RecordingCollector, source: str
) -> list[tuple[int, str, Callable[[], Recording]]]:
    """Return line, part and a reader of each row of a wide table; set the collector's channels.

    An empty cell before others is NaN, which the engine finds. A row whose last cells are empty is
    a shorter trace. The reader raises UnreadableError for a row with text among its samples, with
    an unknown label, or with labels that contradict each other, and UnlabelledError for one without
    a label yet; no label is read if the options name a file of them. Raises DataError if the
    columns of labels, parts or samples are not found, and if each part has several rows, one per
    signal.
    """
    frame = table.frame
    label_columns = list[str]()
    if options.labels is None:
        label_column = choose_label_column(frame, options)
        label_columns = [label_column, *compared_columns(frame, label_column, options)]
    parts = _parts_of_rows(frame, options)
    others = [name for name in frame.columns if name not in (*label_columns, *options.part_columns)]
    columns = sample_columns(others, options)
    all_columns = [name for names in columns.values() for name in names]
    values, odd_cells, _ = parse_numbers(frame[all_columns])
    traces = values.reshape(len(frame), len(columns), -1)
    collector.channels = tuple(filter(None, columns))
    _check_single_signal(frame, others, options)
    unread = [name for name in others if name and name not in all_columns]
    stated = _stated_in_rows(frame[unread], table)
    unread = [name for name in unread if name not in stated.columns]
    in_rows = frame[[name for name in unread if may_scale(name)]].to_dict("index")
    _note_unread(
        frame[unread],
        list(columns),
        collector,
        is_whole=not (values % 1 > 0).any(),
        kind="rows" if table.column_of else "columns",
    )
    label_cells = [
        labels.LabelColumn(name, options.words, collector.notes) for name in label_columns
    ]
    unit_of = dict(zip(frame.columns, table.units, strict=False))
    channel_units = tuple(_unit_of_columns(*item, unit_of) for item in columns.items())
    if table.offer and not options.rate_hz:
        collector.notes[table.offer] = 1

    def read(line: int, trace: NDArray[np.float32], words: Sequence[Any], part: str) -> Recording:
        """Return a row as a recording; raise UnreadableError for a bad cell or label."""
        if line in odd_cells or line in table.wrong:
            raise table.wrong.get(line) or UnreadableError(odd_cells[line])
        rate = None if options.rate_hz else stated.rate_of.get(line)
        place = f"column {table.column_of[line]}" if table.column_of else f"line {line}"
        is_stated = len(columns) == 1 and line in stated.unit_of
        recording = Recording(
            without_trailing_nan(trace),
            rate,
            (stated.unit_of[line],) if is_stated else channel_units,
            reading=Reading(numbers=table.numbers, clock="" if rate is None else stated.clock),
            source=f"{source}, {place}",
            part=part or None,
            factors={**table.factors, **stated_factors(in_rows.get(line, {}))},
        )
        if not words:
            return recording
        finders = {
            f"column {column.name}": partial(column.find, [word])
            for column, word in zip(label_cells, words, strict=True)
        }
        do = f"name the column to trust: label={label_columns[0]!r}"
        label = labels.agreed_label(finders, do, collector.notes)
        reading = recording.reading
        reading = label.reading._replace(numbers=reading.numbers, clock=reading.clock)
        return recording._replace(label=label.label, reading=reading)

    words = frame[label_columns].to_numpy(dtype=object).tolist()
    rows = zip(frame.index, traces, words, parts, strict=True)
    return [(row[0], row[3], partial(read, *row)) for row in rows]


def _note_unread(
    frame: pd.DataFrame,
    channels: Sequence[str],
    collector: RecordingCollector,
    *,
    is_whole: bool,
    kind: str,
) -> None:
    """Add a note on the columns that were not read, but for the factors of whole numbers.

    Of these `as_dataset` says what it did with them.

    kind : "columns", or "rows" if these are the columns of a table that was transposed.
    """
    n = len(channels)
    unread = [
        _describe_column(frame, name)
        for name in frame
        if not (is_whole and any(operation(name, channel, n) for channel in channels))
    ]
    if unread:
        collector.notes[f"Not read: the {kind} {listed(unread)}"] = 1


class StatedByRow(NamedTuple):
    """What columns of a wide table state of its rows.

    unit_of, rate_of : dict
        Unit and sampling rate in hertz, by the line of the row.
    clock : str
        What tells the rates, as in `Reading`.
    columns : list of str
        The columns that were read for this.
    """

    unit_of: dict[int, str]
    rate_of: dict[int, float]
    clock: str
    columns: list[str]


def _step_in_names(names: Iterable[str]) -> float | None:
    """Return the seconds between samples that the names of columns state, as FZ_0ms, FZ_4ms, ..."""
    matches = [match for match in map(NUMBER_LAST.fullmatch, names) if match and match["unit"]]
    matches = [match for match in matches if match["channel"] == matches[0]["channel"]]
    if len(matches) < MIN_NUMBERED:
        return None
    second = units.seconds_in(matches[0]["unit"].strip()) or 0.0
    return (int(matches[1]["number"]) - int(matches[0]["number"])) * second


def _stated_in_rows(frame: pd.DataFrame, table: TextTable) -> StatedByRow:
    """Return the units and rates that columns of a table state, as `torqueUnit` or `fs`.

    A column counts if each of its cells that is not empty states one. If the table has a rate, it
    is that of all rows.
    """
    filled = {str(name): cells[cells.notna() & (cells != "")] for name, cells in frame.items()}
    in_units = unit_columns(frame)
    unit_of = next(iter(in_units.values()), {})
    rate_hz, clock = table.rate_hz, table.clock
    if step := _step_in_names(table.frame.columns):
        rate_hz, clock = 1.0 / step, "times in the names of the columns"
    if rate_hz is not None:
        rate_of = dict.fromkeys(table.frame.index, rate_hz)
        return StatedByRow(unit_of, rate_of, clock, list(in_units))
    for name, cells in filled.items():
        rates = {line: rate_in_cell(name, cell) for line, cell in cells.items()}
        rate_of = {line: rate for line, rate in rates.items() if rate is not None}
        if len(rate_of) == len(cells) > 0:
            clock = f"none, column {name} states the rate"
            return StatedByRow(unit_of, rate_of, clock, [name, *in_units])
    return StatedByRow(unit_of, {}, "", list(in_units))


def _parts_of_rows(frame: pd.DataFrame, options: LoadOptions) -> list[str]:
    """Return the part's number of each row of a wide table, "" without one.

    Raises DataError if the column of parts that the user stated is not there.
    """
    if options.part in frame:
        cells = frame[options.part].astype(object).fillna("")
        return [str(cell).removesuffix(".0").strip() for cell in cells]
    if options.part != "part":
        wanted = f"a column {options.part} of parts' numbers"
        raise DataError(f"Expected {wanted}, found {listed(frame.columns)}.")
    return [""] * len(frame)


def _unit_of_columns(channel: str, names: Sequence[str], unit_of: Mapping[str, str]) -> str:
    """Return the unit of a wide table's channel, by its columns or its name; "" without one.

    Raises DataError if its columns have several.
    """
    first_column = {unit_of.get(name, ""): name for name in reversed(names)}
    if len(first_column) > 1:
        actual = ", ".join(f"{name} in {unit or 'none'}" for unit, name in first_column.items())
        do = "export the table in one unit"
        raise DataError(f"Expected one unit of the columns of {channel}, got {actual}; {do}.")
    return next(iter(first_column)) or units.split(channel)[1]


def _describe_column(frame: pd.DataFrame, name: str) -> str:
    """Return the name of a column for a note, with its values if these are 2 to 12 and equally
    frequent: `station (A, B, 100 times each)`.
    """
    counts = frame[name].value_counts()
    if not 2 <= len(counts) <= MAX_STATIONS or counts.min() < counts.max():
        return name
    return f"{name} ({listed(counts.index)}, {counts.iloc[0]} times each)"


def _check_single_signal(frame: pd.DataFrame, names: Sequence[str], options: LoadOptions) -> None:
    """Raise DataError if each part has a row for each of a few texts of a column, its signals.

    names : columns that are no labels and no parts' numbers.
    """
    if options.part not in frame or not frame[options.part].duplicated().any():
        return
    for name in names:
        texts = frame[name].nunique()
        if not 2 <= texts <= MAX_STATIONS or is_mostly_numbers(frame[name]):
            continue
        counts = frame.groupby(options.part)[name].agg(["nunique", "size"])
        if (counts == texts).all(axis=None):
            values = listed(frame[name].unique())
            wanted = f"a row for each part, a part has one for each {name} ({values})"
            raise DataError(f"Expected {wanted}; keep the rows of one in the table.")


def without_trailing_nan(trace: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a trace (C, T) without the last samples that are NaN in all channels.

    A trace of nothing but NaN is returned whole.
    """
    measured = np.flatnonzero(~np.isnan(trace).all(axis=0))
    return trace[:, : measured[-1] + 1] if len(measured) else trace
