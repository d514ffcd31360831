"""One recording: the trace of a file, `read_recording`, or of a table's rows, `rows_to_trace`."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import listed
from ..traces import is_time_column
from . import units
from .cells import CELL_MARK, fields_beside
from .clocks import (
    MAX_LOST,
    MAX_MISSING,
    NO_CLOCK,
    SUMMER_TIME,
    Clock,
    check_even,
    check_rows,
    clock_of,
    floats,
    in_order_of_time,
    is_rate_column,
    lost_rows_text,
    place_of_clock,
    rate_contradiction,
    rate_in_cell,
    rate_of,
    resample_evenly,
    rising_columns,
    same_time_text,
    shows_lost_rows,
    start_of,
    varies_all_along,
)
from .collector import Reading, Recording
from .dataset import Fault, LoadOptions, UnreadableError
from .headers import COUNTER_NAME, is_value
from .scales import factors_in_columns
from .text import RATE_ABOVE, TextTable, parse_numbers, read_table

if TYPE_CHECKING:
    import pandas as pd

# A word for a sample beyond the range of its sensor or amplifier, as OVERFLOW, OL or +++++++.
OVER_RANGE = re.compile(
    r"over|ov[fl]|\bo\.?[lvf]\b|exceed|range|satur|clip|[üu]e?ber(lauf|last|steuer|schr)|bereich"
    r"|d[ée]passement|fuori scala|^[+>]+$",
    re.IGNORECASE,
)
SUMMARY_SHARE = 10  # samples for each row of a summary below them, at least


def read_recording(
    path: Path,
    channels: Sequence[str],
    options: LoadOptions,
    notes: Counter[str],
    decimal: str | None = None,
) -> Recording:
    """Read the channels of a file that holds one recording, in the order of `channels`.

    `notes` is added to; `decimal` is the mark that is taken if the user stated none. Raises
    UnreadableError, with the line if it is known, for a cell, a row, a clock or a text that cannot
    be read, a channel that is not there, and no samples.
    """
    table = read_table(path, replace(options, channels=tuple(channels)), decimal)
    part = _part_in(table, path, options, notes)
    table = _of_one_signal(table, channels)
    header = list(table.frame.columns)
    places = [column_place(name, header, table.line, table.preamble) for name in channels]
    for fault in table.faults:
        if fault.line != table.cut_line:
            raise UnreadableError(fault.message, fault.line)
        notes[cut_note(fault)] += 1
    if table.frame.empty:
        raise UnreadableError("Expected samples below the header, found none", table.line)
    is_name = (table.frame.to_numpy(dtype=object) == np.array(header, dtype=object)).any(axis=1)
    for line, *cells in table.frame[is_name].itertuples():
        if not any(is_value(str(cell)) for cell in cells):
            do = "write the rows below it into a file of their own"
            raise UnreadableError(f"Expected one header, got another: {listed(cells)}; {do}", line)
    frame, kept = _beside_their_clock(table.frame, places)
    places = [kept.index(place) for place in places]
    table = table._replace(frame=frame, units=[table.units[i] for i in kept])
    header = list(frame.columns)
    notes.update(table.notes)
    rows = _without_unfilled(_without_summary(frame, options, notes), places, options, notes)
    channel_units = tuple(
        table.units[i] or units.split(str(header[i]))[1] or units.of_field(rows, len(places))
        for i in places
    )
    joined = _check_blocks(rows, table, options) if table.blocks else ""
    try:
        timed = rows_to_trace(rows, places, options, notes, table.units, table.rate_hz)
    except UnreadableError as error:
        error.args = (f"{error}; it has {joined}",) if joined else error.args
        raise
    if joined:
        notes[f"The file has {joined}: they are joined in one recording"] += 1
    if table.offer and not (timed.reading.clock or options.rate_hz):
        notes[table.offer] += 1
    n_out = len(frame) - len(rows) + table.n_remarks
    left_out = (
        f"header in line {table.line}" if table.line > 1 else "",
        f"{n_out} left out" if n_out else "",
        timed.reading.rows,
    )
    reading = timed.reading._replace(rows=", ".join(filter(None, left_out)), numbers=table.numbers)
    others = [i for i in range(len(header)) if i not in places]
    start = None
    with suppress(UnreadableError):
        place = place_of_clock(rows, options.time)
        start = None if place is None else start_of(rows.iloc[:, place])
    return timed._replace(
        units=channel_units,
        start=start,
        part=part,
        reading=reading,
        factors={**table.factors, **factors_in_columns(rows.iloc[:, others])},
    )


def _part_in(table: TextTable, path: Path, options: LoadOptions, notes: Counter[str]) -> str | None:
    """Return the part that a recording states, or None.

    If `options.part` is no column and has a group, as SN([0-9]+), it is a pattern: its group is
    searched for in the name of the file, then in those of its folder and the file. Else it names a
    column, a line of the file, or a line of a small file beside it, or lists several, which are
    joined.

    None with a note if this is missing or empty. None without a note if `options.part` is the
    default, or a file of labels is given. Raises UnreadableError for a column of several parts.
    """
    if options.part == "part" or options.labels is not None:
        return None
    fields = {**table.fields, **fields_beside(path)}
    columns = {*fields, *table.frame}
    if "(" in options.part and options.part not in columns:
        in_folder = f"{path.parent.name}/{path.stem}"
        match = re.search(options.part, path.stem) or re.search(options.part, in_folder)
        part = match and match[1]
        if not part:
            notes[f"No part is where {options.part} finds it: each such file is one"] += 1
        return part or None
    names = [options.part] if options.part in columns else options.part_columns[1:]
    texts = list[str]()
    for name in names:
        cells = table.frame[name] if name in table.frame else [fields.get(name, "")]
        filled = sorted({str(cell).strip() for cell in cells} - {""})
        if len(filled) > 1:
            raise UnreadableError(f"Expected one part in column {name}, got {listed(filled)}")
        texts += filled
    if len(texts) == len(names) > 0:
        return "_".join(texts)
    notes[f"No {options.part} is stated: the recording is a part of its own"] += 1
    return None


def _check_blocks(rows: pd.DataFrame, table: TextTable, options: LoadOptions) -> str:
    """Return a text on the blocks of a recording, as "3 blocks of 500 rows under one header".

    It is "" for one block. Raises UnreadableError if the blocks overlap in time, by the clock, or
    without one by LabVIEW's X0.
    """
    places = rows.index.searchsorted(list(table.blocks)[1:])
    blocks = [block for block in np.split(np.arange(len(rows)), places) if len(block)]
    sizes = sorted({len(block) for block in blocks})
    if len(blocks) < 2:
        return ""
    up_to = "up to " if len(sizes) > 1 else ""
    text = f"{len(blocks)} blocks of {up_to}{sizes[-1]} rows, each under the same header"
    clock = None
    with suppress(UnreadableError):
        clock = clock_of(rows, options.time, table.units)
    starts = set(table.blocks.values())
    overlaps = options.time != NO_CLOCK and "" not in starts and len(starts) < len(table.blocks)
    if clock is not None and not np.isnan(clock.seconds).any():
        times = [clock.seconds[block] for block in blocks]
        spans = sorted((block.min(), block.max()) for block in times)
        overlaps = any(a[1] > b[0] for a, b in itertools.pairwise(spans))
    if overlaps:
        do = "write each into a file of its own: the last one is usually the final measurement"
        raise UnreadableError(
            f"Expected one recording, got {text}, and their times overlap; {do}",
            int(rows.index[blocks[1][0]]),
        )
    return text


def cut_note(fault: Fault) -> str:
    """Return the note on a file whose last row is cut off and left out."""
    return f"The last row is cut off, and left out: {fault.source}, line {fault.line}"


def _of_one_signal(table: TextTable, channels: Sequence[str]) -> TextTable:
    """Return a table with a row for each value of each signal as that of one of them.

    Such a table has a column of names, among them the channel, and one other that changes, holds
    numbers in most rows, and is no clock. The latter gets the channel's name. Any other table, and
    that of several channels, is returned as it is.
    """
    frame = table.frame
    is_signal = len(channels) == 1 and frame.columns.is_unique
    if not is_signal or units.find_columns(channels[0], list(frame.columns)):
        return table
    tags = [name for name in frame if (frame[name] == channels[0]).any()]
    if len(tags) != 1:
        return table
    rows = frame[frame[tags[0]] == channels[0]]
    values = [
        name
        for name in rows
        if not is_time_column(name)
        and 2 * len(floats(rows[name])[1]) < len(rows)
        and len({*rows[name]}) > 1
    ]
    if len(values) != 1:
        return table
    return table._replace(frame=rows.rename(columns={values[0]: channels[0]}))


def _beside_their_clock(
    frame: pd.DataFrame, places: Sequence[int]
) -> tuple[pd.DataFrame, list[int]]:
    """Return a recording with the clock of the channels at `places`, without clocks of others.

    Only clocks of one name are several, as in Time;Way;Time;Force, where each stands to the left of
    its channels. Rows at the end in which this clock and these channels are empty are left out;
    all other columns stay. The second value is the place in `frame` of each column that is kept.
    Raises UnreadableError if the channels at `places` have different clocks.
    """
    names = [str(name).lower() for name in frame.columns]
    clocks = [i for i, name in enumerate(names) if is_time_column(name) and names.count(name) > 1]
    nearest = {max((i for i in clocks if i < place), default=-1) for place in places}
    kept = list(range(len(names)))
    if clocks and nearest != {-1}:
        if len(nearest) > 1:
            raise UnreadableError("Expected channels beside one clock, got several clocks")
        kept = [i for i in kept if i not in clocks or i in nearest]
        cells = frame.iloc[:, [*nearest, *places]]
        is_used = (cells.astype(str).apply(lambda column: column.str.strip()) != "").any(axis=1)
        frame = frame.iloc[: int(np.flatnonzero(is_used)[-1]) + 1] if is_used.any() else frame
    return frame.iloc[:, kept], kept


def _without_summary(
    frame: pd.DataFrame, options: LoadOptions, notes: Counter[str]
) -> pd.DataFrame:
    """Return a recording without rows at an end of it that are no samples, as `Max;48.2`.

    Such rows have no time. They are left out, with a note, only if all other rows have a time
    and are at least ten times as many. Without a clock the first column of numbers to which this
    applies takes its place; then one of the cells left out must hold text.
    """
    place = None
    with suppress(UnreadableError):
        place = place_of_clock(frame, options.time)
    for i in range(frame.shape[1]) if place is None else [place]:
        cells = frame.iloc[:, i].astype(str).tolist()
        are_values = [cell != "" and is_value(cell) for cell in cells]
        n_samples = sum(are_values)
        n_out = len(cells) - n_samples
        first = are_values.index(True) if n_samples else 0
        has_words = place is not None or any(set(cells) - set(cells[first : first + n_samples]))
        if not (has_words and 0 < n_out <= n_samples / SUMMARY_SHARE):
            continue
        if all(are_values[first : first + n_samples]):
            what = "time" if place is not None else f"number in column {frame.columns[i]}"
            where = "first" if first else "last"
            text = f"The {where} {n_out} rows have no {what}: they are no samples, and left out"
            notes[text] += 1
            return frame.iloc[first : first + n_samples]
    return frame


def _without_unfilled(
    frame: pd.DataFrame, places: Sequence[int], options: LoadOptions, notes: Counter[str]
) -> pd.DataFrame:
    """Return a recording without rows behind the last sample in which time and channels are 0.

    A buffer of a controller that was not filled has such rows; a note says that they are left out.
    """
    place = None
    with suppress(UnreadableError):
        place = place_of_clock(frame, options.time)
    if place is None or place in places:
        return frame
    values = np.stack([floats(frame.iloc[:, i])[0] for i in (place, *places)])
    used = np.flatnonzero((values != 0).any(axis=0))
    n = int(used[-1]) + 1 if len(used) else 0
    if n < len(frame) and n > 1 and values[0, n - 1] > 0:
        notes["The last rows are 0, and so is their time: they are no samples, and left out"] += 1
        return frame.iloc[:n]
    return frame


def rows_to_trace(
    rows: pd.DataFrame,
    places: Sequence[int],
    options: LoadOptions,
    notes: Counter[str],
    units_row: Sequence[str] = (),
    rate_hz: float | None = None,
) -> Recording:
    """Convert the rows of a table, one for each sample, to a trace with its rate.

    Parameters
    ----------
    rows : DataFrame, T rows
    places : sequence of int
        Positions of the columns of the C channels.
    options : LoadOptions
        A stated rate is taken instead of a clock's, which still shows missing rows. With
        `fit="resample"` the samples are interpolated at even times. Both are needed for
        a clock whose steps vary all along, with pauses; see `clocks.varies_all_along`.
    notes : Counter
        Counts what users should know; it is added to.
    units_row : sequence of str
        Unit of each column, if there is a row of units.
    rate_hz : float, optional
        Rate that the file states above the rows, for rows without a clock, or with one that is too
        coarse to tell it.

    Returns
    -------
    Recording
        In the order of the times, where these can be trusted; see `clocks.in_order_of_time`. An
        empty cell is NaN, which the engine finds. The rate is None if the user states one, or
        nothing tells it; there are no units.

    Raises
    ------
    UnreadableError
        For a cell that is no number, for rows that are missing or out of order, and, unless a rate
        is stated, for a clock that cannot be read or is not even enough.
    """
    is_again = _repeated_rows(rows, places, options)
    if is_again.any():
        rows = rows[~is_again]
        timed = rows_to_trace(rows, places, options, notes, units_row, rate_hz)
        return timed._replace(repeated=int(is_again.sum()))
    rows, values = _measured(rows, places, options, notes, units_row)
    trace = np.ascontiguousarray(values.T)
    try:
        clock = clock_of(rows, options.time, units_row)
    except UnreadableError as error:
        if options.rate_hz is None or error.line:
            raise
        return Recording(trace)  # a stated rate needs no clock
    if clock is None:
        if options.rate_hz is None and rate_hz is not None:
            return Recording(trace, rate_hz, reading=Reading(clock=RATE_ABOVE))
        if options.rate_hz is None and (name := _rate_column(rows, places)):
            rate_hz = rate_in_cell(name, rows[name].iloc[0])
            reading = Reading(clock=f"none, column {name} states the rate")
            return Recording(trace, rate_hz, reading=reading)
        if options.rate_hz is None:
            _offer_clock(rows, places, notes)
        return Recording(trace, goes_back=_column_that_goes_back(rows, options))
    try:
        return _trace_by_clock(trace, rows, clock, options, notes, rate_hz)
    except UnreadableError as error:
        same_time = same_time_text(trace, clock, rows.index)
        raise UnreadableError(f"{error}{same_time}", error.line) from error


def _rate_column(rows: pd.DataFrame, places: Sequence[int]) -> str:
    """Return the column of a recording that states its rate, by its name and one value; else "".

    places : positions of the channels.
    """
    for name in rows.columns.delete(list(places)):
        cells = set(rows[name]) if is_rate_column(str(name)) else set()
        if len(cells) == 1 and rate_in_cell(str(name), *cells):
            return str(name)
    return ""


def _trace_by_clock(
    trace: NDArray[np.float32],
    rows: pd.DataFrame,
    clock: Clock,
    options: LoadOptions,
    notes: Counter[str],
    rate_hz: float | None,
) -> Recording:
    """Return the trace (C, T) of rows by their clock, as `rows_to_trace` does."""
    if clock.is_continued:
        notes[f"The clock {clock.name} counts from 0 again: its times go on there"] += 1
    if SUMMER_TIME in clock.form:
        notes[f"Column {clock.name} holds {clock.form}"] = 1
    order, clock = in_order_of_time(rows, clock, options.time)
    if (order != np.arange(len(rows))).any():
        notes["Rows are put in the order of their times"] += 1
        trace = np.ascontiguousarray(trace[:, order])
        rows = rows.iloc[order]
    rate_hz = options.rate_hz or rate_hz
    if options.fit == "resample" and rate_hz is not None and varies_all_along(clock):
        even = f"put at even times, {rate_hz:g} Hz, linearly between their own"
        notes[f"Rows come when values change, by column {clock.name}: they are {even}"] += 1
        reading = Reading(clock=f"column {clock.name} ({clock.form}), at the stated rate")
        even_trace = resample_evenly(trace, clock, rate_hz)
        return Recording(even_trace, rate_hz, reading=reading, length=trace.shape[1])
    check_rows(clock, rows.index, options.time)
    confirmed = clock._replace(note="")  # on its unit
    if rate_hz is not None and not rate_contradiction(confirmed, rate_hz):
        clock = confirmed
    if options.rate_hz is None and rate_hz is not None and not shows_lost_rows(clock):
        clock_text = f"{RATE_ABOVE}; {lost_rows_text(clock)}"
        if not rate_contradiction(clock, rate_hz):
            return Recording(trace, rate_hz, reading=Reading(clock=clock_text))
    return _trace_at_rate(trace, clock, rows.index, options, notes)


def _measured(
    rows: pd.DataFrame,
    places: Sequence[int],
    options: LoadOptions,
    notes: Counter[str],
    units_row: Sequence[str],
) -> tuple[pd.DataFrame, NDArray[np.float32]]:
    """Return the rows of a recording and their samples (T, C), with a note on lost samples.

    A text in place of a number is a lost sample. With `fit="resample"` these are interpolated, and
    left out at the ends. Raises UnreadableError for a damaged number, if too many samples are lost,
    and if more than `MAX_LOST` on end are to be interpolated.
    """
    values, wrong, lost = parse_numbers(rows.iloc[:, places])
    is_few = len(lost) <= MAX_MISSING * len(rows) + 1 < len(rows)
    if damaged := wrong.keys() - (lost.keys() if is_few else {}):
        line = min(damaged)
        count = f", and {len(lost)} of {len(rows)} rows are such" if line in lost else ""
        raise UnreadableError(f"{wrong[line]}{count}", line)
    if not lost:
        return rows, values
    is_lost = rows.index.isin(list(lost))
    runs = np.flatnonzero(np.diff(np.pad(is_lost.astype(np.int8), 1))).reshape(-1, 2)
    first, n_longest = max(((a, b - a) for a, b in runs), key=itemgetter(1))
    is_resampled = options.fit == "resample"
    if is_resampled and n_longest > MAX_LOST:
        line = rows.index[first]
        do = f"fit='resample' interpolates {MAX_LOST} at most; fit='strict' keeps them as NaN"
        raise UnreadableError(f"{wrong[line]}, in {n_longest} rows on end; {do}", line)
    do = "in recordings with more on end than fit='resample' interpolates"
    if n_longest <= MAX_LOST:
        do = f"fit='resample' interpolates these, {MAX_LOST} on end at most"
    for cell in lost.values():
        text = f"Samples are lost where a text is in place of a number, {cell!r}"
        is_over = OVER_RANGE.search(cell) is not None
        text += ", for the range of the sensor was exceeded" if is_over else ""
        if is_resampled:
            notes[f"{text}: they are interpolated"] += 1
        else:
            notes[f"{text}: they are NaN" + ("" if is_over else f"; {do}")] += 1
    if is_resampled:
        _interpolate(values, is_lost, _times(rows, options, units_row))
        kept = np.flatnonzero(~is_lost)
        ends = slice(kept[0], kept[-1] + 1)
        return rows.iloc[ends], values[ends]
    return rows, values


def _interpolate(
    values: NDArray[np.float32], is_lost: NDArray[np.bool_], times: NDArray[np.float64]
) -> None:
    """Put samples (T, C) that are lost, and NaN, between those before and after them, in place."""
    order = np.argsort(times)
    for column in values.T:
        is_gap = is_lost & np.isnan(column)
        known = order[~is_gap[order]]
        column[is_gap] = np.interp(times[is_gap], times[known], column[known])


def _times(
    rows: pd.DataFrame, options: LoadOptions, units_row: Sequence[str]
) -> NDArray[np.float64]:
    """Return the time of each row, by its clock, or its number if that does not tell it."""
    with suppress(UnreadableError):
        clock = clock_of(rows, options.time, units_row)
        if clock is not None and not np.isnan(clock.seconds).any():
            return clock.seconds
    return np.arange(len(rows), dtype=np.float64)


def _trace_at_rate(
    trace: NDArray[np.float32],
    clock: Clock,
    lines: pd.Index,
    options: LoadOptions,
    notes: Counter[str],
) -> Recording:
    """Return a trace (C, T) with the rate by its clock, or without one if the rate is stated.

    With `fit="resample"` it is interpolated at even times; else a note says that rows are missing.

    lines : line in the file of each sample.
    """
    if options.rate_hz is not None:
        clock_text = f"none, the rate is stated; {lost_rows_text(clock)}"
        if contradiction := rate_contradiction(clock, options.rate_hz):
            notes[contradiction] += 1
        return Recording(trace, reading=Reading(clock=clock_text))
    reading = Reading(clock=f"column {clock.name} ({clock.form})")
    rate = rate_of(clock, lines)
    if clock.note:
        notes[clock.note] += 1
    if options.fit == "resample":
        trace = resample_evenly(trace, clock, rate)
    else:
        n_missing = check_even(clock, rate)
        if n_missing > 1:
            text = f"Rows are missing by column {clock.name}: later samples stand too early"
            notes[f"{text}; fit='resample' puts all at even times"] += 1
            reading = reading._replace(rows="rows are missing")
    return Recording(trace, rate, reading=reading)


def column_of_count(rows: pd.DataFrame, time: str | None) -> pd.Series | None:
    """Return the column that tells the rows of a recording apart, or None.

    It is the clock, also if the user does not trust it, else a running number, as `Sample`.

    rows : without the columns of channels.
    """
    place = None
    with suppress(UnreadableError):
        place = place_of_clock(rows, None if time == NO_CLOCK else time)
    if place is not None:
        return rows.iloc[:, place]
    cells = (rows.iloc[:, i] for i, name in enumerate(rows) if COUNTER_NAME.fullmatch(str(name)))
    return next((column for column in cells if (floats(column)[0] % 1 == 0).all()), None)


def _repeated_rows(
    rows: pd.DataFrame, places: Sequence[int], options: LoadOptions
) -> NDArray[np.bool_]:
    """Return which rows of a recording came before, with all their cells, shape (n,).

    None without a `column_of_count`, or if its values do not tell the others apart: then
    rows may be equal by chance.
    """
    is_again: NDArray[np.bool_] = rows.duplicated().to_numpy()
    others = rows.drop(columns=rows.columns[places])
    count = column_of_count(others, options.time) if is_again.any() else None
    if count is None or not count[~is_again].is_unique:
        is_again = np.zeros(len(rows), dtype=np.bool_)
    return is_again


def _column_that_goes_back(rows: pd.DataFrame, options: LoadOptions) -> str:
    """Return the name of a clock that the user does not trust if it goes back, else ""."""
    if options.time != NO_CLOCK:
        return ""
    with suppress(UnreadableError):
        clock = clock_of(rows)
        return clock.name if clock is not None and (np.diff(clock.seconds) < 0).any() else ""
    return ""


def _offer_clock(rows: pd.DataFrame, places: Sequence[int], notes: Counter[str]) -> None:
    """Add a note on the first column, other than a channel, that rises steadily: it may be the
    clock.

    The first 200 rows tell whether it rises. A column that has the name of a counter of samples, as
    `Index`, and rises by 1 in all rows is passed over.

    places : positions of the channels.
    """
    for i in rising_columns(rows):
        name = str(rows.columns[i])
        is_counter = COUNTER_NAME.fullmatch(name) is not None
        is_counter = is_counter and bool((np.diff(floats(rows.iloc[:, i])[0]) == 1).all())
        if i not in places and not is_counter:
            rises = f"column {name} rises steadily: time={name!r} if it is one"
            notes[f"No clock is known; {rises}"] += 1
            return


def column_place(name: str, header: Sequence[str], line: int = 1, preamble: str = "") -> int:
    """Return the position of a column in a header, found by `units.find_columns`.

    Raises UnreadableError, with the header's line, if there is none or several.

    preamble : the first lines of the file, for the error, in which the column may stand.
    """
    places = units.find_columns(name, header)
    columns = listed(header)
    if not places:
        message = f"Expected a column {name}, got {columns}"
        for i, text in enumerate(preamble.splitlines(), start=1):
            cells = [cell.strip(" \"'") for cell in CELL_MARK.split(text)]
            if i != line and units.find_columns(name, cells):
                do = "if that line is the header, name the columns as it does (columns)"
                raise UnreadableError(f"{message}; {name} stands in line {i}: {do}", line)
        raise UnreadableError(message, line)
    if len(places) > 1:
        names = list(header)
        do = "name it as it stands"
        if len({header[i] for i in places}) < len(places):
            for n, i in enumerate(places, start=1):
                bare = units.split(names[i])[0]
                names[i] = names[i].replace(bare, f"{bare}_{n}", 1)
            do = f"name them anew, columns={','.join(names)!r}, and the channel"
        choice = " or ".join(f"channel={names[i]!r}" for i in places)
        message = f"Expected a column {name}, got it twice or more in {columns}; {do}, {choice}"
        raise UnreadableError(message, line)
    return places[0]
