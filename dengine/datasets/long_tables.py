"""Tables with a row for each sample, as historians export them, and a column of parts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, listed
from . import labels, listings, units
from .assembly import as_dataset
from .clocks import (
    ANY_ORDER,
    HEAD,
    MAX_GAP,
    NO_CLOCK,
    SUMMER_TIME,
    Clock,
    floats,
    holds_dates,
    is_rate_column,
    is_rising,
    place_of_clock,
    same_time_text,
    seconds_of,
    times_of,
)
from .collector import Recording, RecordingCollector
from .columns import (
    MAX_STATIONS,
    STATION,
    TRIED,
    channel_hint,
    check_labels,
    choose_channels,
    choose_label_column,
    compared_columns,
    count_labels,
    label_hint,
    look_like_labels,
    numbered_columns,
    single_units,
    unit_columns,
    with_label_error,
)
from .dataset import Dataset, Fault, LoadOptions, UnreadableError, expect_data
from .recordings import column_of_count, rows_to_trace
from .scales import factors_in_columns
from .text import TextTable, days_in, is_mostly_numbers
from .windows import Windows, read_windows

if TYPE_CHECKING:
    import pandas as pd

# Added to a long table; no file has these names.
SECONDS_COLUMN = "\0seconds"
ROW_COLUMN = "\0row"  # number of the row, in place of the times that the user does not trust
RUN_COLUMN = "\0run"  # number of the rows of a part that stand together and in the order of time
SAME_STEP = 0.05  # of the step: two steps that differ by less are the same
NEAR = 0.01  # of the largest number: numbers that differ by less are rounded in two ways
MIN_RUN = 8  # rows on average that stand together in a table that is in the order of its parts
FEW_AGAIN = 0.2  # of the parts' numbers: if fewer come again, these are single faults


def unwrap_ring(
    frame: pd.DataFrame, options: LoadOptions, collector: RecordingCollector
) -> pd.DataFrame:
    """Return the rows of a ring buffer that wrapped, the oldest first; a note says so.

    In such a file one column of dates, or of a running number, goes back once, and ends below
    where it began. Other tables are returned as they are.
    """
    import pandas as pd

    for name in frame.columns.difference([options.part, *options.channels], sort=False):
        oldest = _oldest_row(frame[name]) if (frame.columns == name).sum() == 1 else 0
        if not oldest:
            continue
        line = frame.index[oldest]
        note = f"Column {name} goes back in line {line}, as in a ring buffer that wrapped: the rows"
        note = f"{note} from there on are put first"
        if options.part in frame:
            parts = frame[options.part].astype(str)
            if parts.iloc[0] == parts.iloc[-1]:
                note = f"{note}, and part {parts.iloc[0]} is joined of its two pieces"
            note = f"{note}; the beginning of part {parts.iloc[oldest]} may be overwritten"
        collector.notes[note] = 1
        collector.order = f"as the rows from line {line} on, by column {name}"
        return pd.concat([frame.iloc[oldest:], frame.iloc[:oldest]])
    return frame


def _oldest_row(column: pd.Series) -> int:
    """Return the position of the oldest row of a ring buffer by a column of it; 0 if it is none.

    Dates fall there alone, and not where summer time ends. Other numbers rise from row to row, and
    the first is the next after the last: a counter that started anew would not go on so.
    """
    with suppress(UnreadableError):
        ends, has_dates = times_of(column.iloc[[0, -1]])
        gap = ends[0] - ends[1]
        if not (gap > 0 or (gap == 0 and has_dates)):
            return 0
        times, _ = times_of(column)
        steps = np.diff(times)
        falls = np.flatnonzero(steps < 0)
        if len(falls) != 1 or np.isnan(times).any():
            return 0
        if has_dates:
            is_ring = SUMMER_TIME not in seconds_of(column, str(column.name))[-1]
        else:
            is_ring = gap <= MAX_GAP * np.median(steps) and (steps != 0).all()
        return int(falls[0]) + 1 if is_ring else 0
    return 0


def concatenate_long(
    tables: Mapping[str, pd.DataFrame], options: LoadOptions
) -> tuple[pd.DataFrame, NDArray[np.bool_]]:
    """Return long tables as one, in their order, and a mask of its repeated rows.

    A part's number in two files means two parts: both are prefixed with their file's name. It is
    one part if its rows are scattered over the files, as Spark writes them, if it ends one file
    and begins the next, and if exports overlap. These have the same dates and, in most cells of all
    parts, nearly the same numbers; their rows in later files are the repeated ones.
    """
    import pandas as pd

    frame = pd.concat(tables.values())
    if len(tables) == 1 or options.part not in frame:
        return frame, np.zeros(len(frame), dtype=np.bool_)
    time = _time_column(frame, options)
    files = np.repeat(list(tables), [len(table) for table in tables.values()])
    if _are_spread(frame, files, time, options):
        seconds = np.asarray(seconds_of(frame[time].reset_index(drop=True), time)[0])
        order = np.lexsort((seconds, pd.factorize(frame[options.part])[0]))
        return frame.iloc[order], np.zeros(len(frame), dtype=np.bool_)
    parts = frame[options.part].astype(str).to_numpy()
    first_files = files
    if time in frame and holds_dates(frame[time]):
        keys = [parts, frame[time].astype(str).to_numpy()]
        numbers = frame.drop(columns=[options.part, time]).apply(pd.to_numeric, errors="coerce")
        differences = (numbers - numbers.groupby(keys).transform("first")).abs()
        is_near = (differences <= numbers.abs().max() * NEAR).loc[:, numbers.notna().any()]
        owners = pd.Series(files).groupby(keys).transform("first").to_numpy()
        if is_near[owners != files].mean(axis=None) > 0.5:  # else of two stations
            first_files = owners
    is_repeated = first_files != files
    file_of = dict[str, str]()  # of each part of the file before
    last = ""
    full_names = list[str]()
    for source in tables:
        in_file = files == source
        own_parts = parts[in_file].tolist()
        repeated = dict(
            zip(parts[in_file & is_repeated], first_files[in_file & is_repeated], strict=True)
        )
        file_of = {
            part: file_of[last] if part == last == own_parts[0] else repeated.get(part, source)
            for part in own_parts
        }
        full_names += [f"{file_of[part]}/{part}" for part in own_parts]
        last = own_parts[-1]
    part = frame[options.part].astype(str).where(frame[options.part].notna())
    full_name = pd.Series(full_names, frame.index)
    is_ambiguous = full_name.groupby(part.to_numpy()).transform("nunique") > 1
    return frame.assign(**{options.part: part.where(~is_ambiguous, full_name)}), is_repeated


def _are_spread(
    frame: pd.DataFrame, files: NDArray[np.str_], time: str, options: LoadOptions
) -> bool:
    """Return whether the rows of one part lie in several files.

    For most of the first parts in several files, all times rise steadily once sorted, and those of
    no single file do. Those may, by the same step, if the whole has no gap: two stations that
    alternate have a larger step each, and a part that was measured again has a gap.
    """
    if time not in frame:
        return False
    clock = frame[[options.part, time]].assign(file=files).dropna()
    n_files = clock.groupby(options.part)["file"].nunique()
    tried = n_files.index[n_files > 1][:TRIED]
    clock = clock[clock[options.part].isin(tried)].reset_index(drop=True)
    clock["seconds"] = seconds_of(clock[time], time)[0]
    spread = list[bool]()
    for _, rows in clock.groupby(options.part):
        whole = np.sort(rows["seconds"])
        steps = np.diff(whole)
        pieces = [np.sort(own["seconds"]) for _, own in rows.groupby("file")]
        own_steps = [float(np.median(np.diff(piece))) for piece in pieces if is_rising(piece)]
        is_gapless = bool((steps <= 1.5 * np.median(steps)).all())
        is_joined = is_gapless and np.isclose(own_steps, np.median(steps), rtol=SAME_STEP).all()
        spread.append(is_rising(whole) and bool(not own_steps or is_joined))
    return 2 * sum(spread) > len(spread)


def from_long(
    frame: pd.DataFrame,
    is_repeated: NDArray[np.bool_],
    options: LoadOptions,
    collector: RecordingCollector,
    source: str,
    first: TextTable,
    windows: Windows | None = None,
) -> Dataset:
    """Make a data set of a long table: the rows of a part, by their times, are one insertion.

    Its label is in a column, or in a file of parts. Raises DataError if the column of parts or of
    times is not found.

    is_repeated : which rows are in another file, too: their label is compared with that of the
        part, but their samples are left out, and a note of the collector says so.
    first : the first of the tables that `frame` is of, for the units of columns.
    windows : those of the file of labels, by which `cut_by_windows` found the parts.
    """
    column_units = dict(zip(first.frame.columns, first.units, strict=False))
    frame, time = _with_times(frame, options, collector.label_file, source)
    if time != ROW_COLUMN:
        options = replace(options, time=time)
    label = None if options.labels is not None else choose_label_column(frame, options)
    label_columns = [*([label] if label else []), *compared_columns(frame, label, options)]
    all_rows = {str(part): rows for part, rows in frame.groupby(options.part, sort=False)}
    label_source = _label_source_of_parts(all_rows, label_columns, options, windows)
    if is_repeated.any():
        text = "Parts are in two files at the same times: they count once"
        collector.notes[text] = frame[options.part][is_repeated].nunique()
        frame = frame[~is_repeated]
    frame, n_repeated = _without_repeats(frame, options)
    frame = _pivot_signals(frame, [options.part, time, *label_columns], options)
    others = [
        name for name in frame.columns if name not in (*options.part_columns, time, *label_columns)
    ]
    check = partial(check_labels, all_rows, label_source, collector.name)
    collector.channels = _channels_of_long(frame, others, options, check)
    seconds, form = _times_of_long(frame[time], column_units.get(time, ""), collector)
    rows_of_part = _rows_by_part(frame, seconds, options)
    stations = [name for name in others if name not in collector.channels]
    has_dates = holds_dates(frame[time])
    _check_numbers_once(
        rows_of_part, stations, first.date or (time if has_dates else ""), options.part
    )
    _check_single_station(rows_of_part, stations, collector.channels, options.part)
    if not has_dates:
        _check_together(rows_of_part, collector, has_clock=time != ROW_COLUMN)
    places = [frame.columns.get_loc(name) for name in collector.channels]
    stated_units = unit_columns(frame[others]) if len(places) == 1 else {}

    def read(rows: pd.DataFrame) -> Recording:
        """Return the rows of a part as a trace, in the order of their times."""
        rows = rows.sort_values(SECONDS_COLUMN, kind="stable")
        start = float(rows[SECONDS_COLUMN].iloc[0])
        rows = rows.drop(columns=[SECONDS_COLUMN, RUN_COLUMN, ROW_COLUMN], errors="ignore")
        units_row = [column_units.get(name, "") for name in rows.columns]
        timed = rows_to_trace(rows, places, options, collector.notes, units_row)
        channel_units = single_units(stated_units, rows.index) or tuple(
            column_units.get(name) or units.split(name)[1] or units.of_field(rows, len(places))
            for name in collector.channels
        )
        reading = timed.reading._replace(
            numbers=first.numbers,
            clock=timed.reading.clock.replace(ANY_ORDER, form),  # a part's rows may not tell it
        )
        factors = {**first.factors, **factors_in_columns(rows.drop(columns=[*collector.channels]))}
        return timed._replace(
            units=channel_units,
            start=start,
            reading=reading,
            factors=factors,
            repeated=n_repeated[str(rows[options.part].iloc[0])],
        )

    labels.collect_recordings(rows_of_part, read, label_source, collector)
    collector.order_by_start(apart=True, has_dates=has_dates)
    return as_dataset(collector, options)


def _with_times(
    frame: pd.DataFrame, options: LoadOptions, label_file: str, source: str
) -> tuple[pd.DataFrame, str]:
    """Return a long table and its column of times; the numbers of its rows if the user trusts none.

    Raises DataError if the column of parts or of times is not found.
    """
    time = _time_column(frame, options)
    if time == NO_CLOCK and time not in frame:
        time = ROW_COLUMN
        frame = frame.assign(**{time: np.arange(len(frame))})
    if options.part not in frame or time not in frame:
        wanted = f"a row a sample in {source}, with columns of parts (part) and times (time)"
        names = long_table_advice(frame, options, label_file)
        advice = f"; name {names}" if names else ""
        raise DataError(f"Expected {wanted}, found {listed(frame.columns)}{advice}.")
    return frame, time


def _without_repeats(
    frame: pd.DataFrame, options: LoadOptions
) -> tuple[pd.DataFrame, Counter[str]]:
    """Return a long table without rows that came before, as messages that were delivered twice, and
    how many these are of each part.

    All their cells are equal, but for columns that rise all along, as the number or the time that a
    database gives each row. A part keeps all if two of its other rows share a time; so do all parts
    if more of them do so than have repeats, or without a column of times or a running number: then
    rows may be equal by chance.
    """
    no_clocks = [options.part, ROW_COLUMN, *options.channels]
    count = column_of_count(frame.drop(columns=no_clocks, errors="ignore"), options.time)
    if count is None:
        return frame, Counter()
    keys = [options.part, str(count.name)]
    cells = frame
    if frame.duplicated(keys).any():
        others = frame.columns.difference([*keys, *options.channels], sort=False)
        cells = frame.drop(columns=[name for name in others if _rises_all_along(frame[name])])
    is_filled = cells[keys].mask(cells[keys] == "").notna().all(axis=1)
    is_again = cells.duplicated().to_numpy() & is_filled.to_numpy()
    rest = cells[~is_again]
    texts = [name for name in rest if name not in keys and not is_mostly_numbers(rest[name])]
    parts = frame[options.part]
    ambiguous = parts[~is_again][rest.duplicated([*keys, *texts]).to_numpy()]
    is_again = is_again & ~parts.isin(ambiguous).to_numpy()
    if parts[is_again].nunique() < ambiguous.nunique():  # a coarse clock
        return frame, Counter()
    return frame[~is_again], Counter(frame[options.part][is_again].astype(str))


def _rises_all_along(column: pd.Series) -> bool:
    """Return whether the numbers or dates of a column rise from each row to the next."""
    with suppress(UnreadableError):
        return bool((np.diff(times_of(column)[0]) > 0).all())
    return False


def _times_of_long(
    column: pd.Series, unit: str, collector: RecordingCollector
) -> tuple[NDArray[np.float64], str]:
    """Return the times of a long table in seconds, and their form as in `Clock`.

    Notes of the collector say so if dates may have the day or the month first, or if summer time
    ends.
    """
    seconds, _, _, form = seconds_of(column, str(column.name), unit)
    if form == ANY_ORDER:
        text = f"Column {column.name} has {form}: they are read month first"
        collector.notes[f"{text}, which matters for the order of the parts alone"] = 1
    if SUMMER_TIME in form:
        collector.notes[f"Column {column.name} holds {form}"] = 1
    return seconds, form


def _channels_of_long(
    frame: pd.DataFrame,
    names: Sequence[str],
    options: LoadOptions,
    check_labels: Callable[[], object],
) -> tuple[str, ...]:
    """Return the channels of a long table, among those columns `names` that hold numbers.

    A column without a name is none: R writes row numbers so. If they must be named, DataError is
    raised, which also says what `check_labels` finds wrong.
    """
    named = [name for name in names if name and not is_rate_column(name)]
    try:
        return choose_channels([name for name in named if is_mostly_numbers(frame[name])], options)
    except DataError as error:
        raise with_label_error(error, check_labels) from error


def _rows_by_part(
    frame: pd.DataFrame, seconds: NDArray[np.float64], options: LoadOptions
) -> dict[str, pd.DataFrame]:
    """Return the rows of each part of a long table, by its number, in order of first appearance.

    The rows have two more columns: `SECONDS_COLUMN`, their times, and `RUN_COLUMN`, the number of
    the run that they are in. A run ends where the next row is of another part or earlier.
    """
    part = frame[options.part]
    is_new = (part != part.shift()).to_numpy() | np.r_[False, np.diff(seconds) < 0]
    with_seconds = frame.assign(**{SECONDS_COLUMN: seconds, RUN_COLUMN: np.cumsum(is_new)})
    groups = with_seconds.groupby(options.part, sort=False)
    return {str(part): rows for part, rows in groups}


def _check_numbers_once(
    rows_of_part: Mapping[str, pd.DataFrame], columns: Sequence[str], dates: str, part_column: str
) -> None:
    """Raise DataError if many parts share a number, as where each shift counts from 1 again.

    Many are two or more, and at least `FEW_AGAIN` of all numbers. `_line_of_next` tells which
    numbers are used again. The error proposes a column that makes them unique, if one does.

    rows_of_part : as `_rows_by_part` returns them.
    columns : names of columns that may make the numbers unique.
    dates : name of a column of dates, whose days are tried first; "" for none.
    """
    lines = {part: _line_of_next(rows) for part, rows in rows_of_part.items()}
    again = [part for part, line in lines.items() if line]
    if len(again) < 2 or len(again) < FEW_AGAIN * len(rows_of_part):
        return
    wanted = f"one recording for each part, {len(again)} of {len(rows_of_part)} numbers come again"
    do = "add a column of days (or stations), and join it: part='day,number'"
    whole = [name for name in columns if _are_whole(rows_of_part[again[0]][name])]
    for name in filter(None, [dates, *whole]):
        keys = (days_in(rows[name]) for rows in rows_of_part.values())
        if all(map(_are_single, rows_of_part.values(), keys)):
            do = f"make them unique, part='{name},{part_column}'"
            break
    raise DataError(f"Expected {wanted} later, as {again[0]} in line {lines[again[0]]}; {do}.")


def _are_single(rows: pd.DataFrame, keys: pd.Series) -> bool:
    """Return whether a part's number was used once with each key, and a key is of all its rows."""
    is_of_runs = keys.nunique() <= rows[RUN_COLUMN].nunique()
    return is_of_runs and not any(_line_of_next(group) for _, group in rows.groupby(keys))


def _line_of_next(rows: pd.DataFrame) -> int:
    """Return the line in which a part's number was used again; 0 if it was used once.

    It was used again if its rows stand in several runs, other parts between them, and each pause is
    longer than all of its rows would take at their median step.
    """
    starts = np.flatnonzero(rows[RUN_COLUMN].diff().to_numpy() > 1)
    steps = np.abs(np.diff(rows[SECONDS_COLUMN].to_numpy()))
    is_again = len(starts) > 0 and steps[starts - 1].min() > len(rows) * np.median(steps)
    return int(rows.index[starts[0]]) if is_again else 0


def _check_together(
    rows_of_part: Mapping[str, pd.DataFrame], collector: RecordingCollector, *, has_clock: bool
) -> None:
    """Raise DataError if parts of a table, whose clock begins anew in each, stand in it twice.

    That is so if all parts stand in few runs of many rows, and one in several without a gap in
    time: a number that was given again, whose times go on, would be one long recording.
    """
    n_runs = {part: rows[RUN_COLUMN].nunique() for part, rows in rows_of_part.items()}
    if not has_clock:
        if names := listed(f"{part} ({n} places)" for part, n in n_runs.items() if n > 1):
            text = "Rows of a part are in several places of the file, and are joined in this order"
            collector.notes[f"{text}: {names}"] = 1
        return
    times = [rows[SECONDS_COLUMN] for rows in rows_of_part.values()]
    if np.median([part_times.min() for part_times in times]) > min(map(max, times)):
        return  # one clock of all parts
    n_rows = sum(map(len, rows_of_part.values()))
    part = max(n_runs, key=n_runs.__getitem__, default="")
    if not n_runs or n_runs[part] < 2 or n_rows < MIN_RUN * sum(n_runs.values()):
        return
    steps = np.diff(np.sort(rows_of_part[part][SECONDS_COLUMN].to_numpy()))
    if steps.max() > MAX_GAP * np.median(steps):
        return  # a fault of that part
    lines = listed(run.index[0] for _, run in rows_of_part[part].groupby(RUN_COLUMN))
    wanted = f"the rows of each part together, part {part} begins in lines {lines}"
    do = "make the parts' numbers unique"
    runs = rows_of_part[part][RUN_COLUMN].unique().tolist()
    if runs == [1, max(rows[RUN_COLUMN].max() for rows in rows_of_part.values())]:
        do = f"put the rows in order if the file is a ring buffer that wrapped, else {do}"
    raise DataError(f"Expected {wanted}, other parts between; {do}.")


def cut_by_windows(
    frame: pd.DataFrame, first: TextTable, options: LoadOptions, collector: RecordingCollector
) -> tuple[pd.DataFrame, Windows | None]:
    """Return the rows of a long table that are in the windows of the file of labels, with a column
    of parts, and the windows.

    A table that has parts, or whose file of labels has no windows, is returned unchanged. Windows
    that cannot be used are faults of the collector. Raises DataError if there is no column
    of times, or the windows are of other times or none can be used.
    """
    windows = None if options.part in frame else read_windows(collector.name, options)
    if windows is None:
        return frame, None
    name = _time_column(frame, options)
    if name not in frame:
        wanted = f"the column of times (time), with which {windows.file} cuts the table"
        raise DataError(f"Expected {wanted}, found {listed(frame.columns)}.")
    column_units = dict(zip(first.frame.columns, first.units, strict=False))
    times = _times_for_windows(frame[name], column_units.get(name, ""), windows)
    known = np.flatnonzero(~np.isnan(times))
    expect_data(len(known) >= 2, f"dates and times in column {name}", frame[name].iloc[0])
    windows.check_inside(times[known], collector.name)
    step = float(np.median(np.diff(np.sort(times[known]))))
    parts = np.full(len(frame), None, dtype=object)
    for part, window in zip(windows.names, windows.cut(times[known], step), strict=True):
        fault = window.fault
        if not fault and max(window.late, window.early) > MAX_GAP * step:
            wanted = "rows from the start of its window to its end"
            fault = f"Expected {wanted}, lost {window.late:.3g} s before and {window.early:.3g} s"
            fault = f"{fault} behind those that are there"
        if fault:
            collector.faults.append(Fault(part, 0, fault))
        else:
            parts[known[window.positions]] = part
    is_inside = np.array([part is not None for part in parts])
    expect_data(bool(is_inside.any()), f"rows in windows of {windows.file}", collector.faults[:1])
    counted = "dates, UTC without a zone," if windows.since_1970 else "seconds of the recording"
    collector.notes[f"{windows.file} is read as {counted} and tells which rows are a part"] = 1
    return frame.assign(**{options.part: parts})[is_inside], windows


def _times_for_windows(column: pd.Series, unit: str, windows: Windows) -> NDArray[np.float64]:
    """Return the times of rows as the windows count, shape (n,): in seconds since 1970, since the
    zero of the clock, or since the first row if the clock holds dates and the windows none.

    Raises DataError if the windows are dates and the clock has none.
    """
    name = str(column.name)
    times, since_1970 = times_of(column)
    seconds, _, _, _ = seconds_of(column, name, unit)
    if since_1970:
        return times if windows.since_1970 else seconds
    if windows.since_1970:
        wanted = f"dates in column {name}, as {windows.file} has"
        do = "write the windows in the times of the table"
        raise DataError(f"Expected {wanted}, got {column.iloc[0]}; {do}.")
    counts, _ = floats(column)  # since zero, in the unit of the clock
    zero: float = counts[0] * np.nanmedian(np.diff(seconds)) / np.nanmedian(np.diff(counts))
    return seconds + zero


def _label_source_of_parts(
    rows_of_part: Mapping[str, pd.DataFrame],
    label_columns: Sequence[str],
    options: LoadOptions,
    windows: Windows | None,
) -> labels.LabelSource:
    """Return the source of the labels of a long table: a file of labels, or the first column.

    The other columns of labels are compared with it. `windows` are those of the file, if any.
    """
    sources = [_labels_of_parts(rows_of_part, name, options) for name in label_columns]
    if options.labels is not None:
        listed_by = replace(options, part="part")
        listing = (
            listings.labels_in_file(options.labels, list(rows_of_part), listed_by)
            if windows is None
            else windows.label_source()
        )
        return labels.labels_that_agree(listing, sources, listing.trust)
    do = f"name the column to trust: label={label_columns[0]!r}"
    return labels.labels_that_agree(sources[0], sources[1:], do)


def _labels_of_parts(
    rows_of_part: Mapping[str, pd.DataFrame], name: str, options: LoadOptions
) -> labels.LabelSource:
    """Return a source of the labels in column `name` of a long table, by the part's number."""
    notes = Counter[str]()
    column = labels.LabelColumn(name, options.words, notes)

    def find(part: str) -> labels.SourcedLabel:
        return column.find(rows_of_part[part][name])

    advice = "name the column of labels (label)"
    return labels.LabelSource(find, advice, f"column {name}", notes=notes)


def _check_single_station(
    rows_of_part: Mapping[str, pd.DataFrame],
    columns: Sequence[str],
    channels: Sequence[str],
    part_column: str,
) -> None:
    """Raise DataError if the rows of a part's number are those of several parts, made at the same
    times at different places.

    Such rows would be merged to one zigzag trace. A column, or the runs of rows in the order of
    time, tells them apart if the times of its values overlap, and each value by itself has times
    without gaps.

    columns : that may tell where a part was made. channels : whose values the error names.
    """
    for part, rows in rows_of_part.items():
        for name in columns:
            if 2 <= rows[name].nunique() <= MAX_STATIONS and _are_stations(rows, name):
                values = listed(sorted(map(str, rows[name].dropna().unique())))
                wanted = f"one recording for each part, part {part} has several values of {name}"
                do = f"make them unique, part='{name},{part_column}'"
                raise DataError(f"Expected {wanted} ({values}) at the same time; {do}.")
        runs = rows.groupby(RUN_COLUMN)
        if 2 <= runs.ngroups <= MAX_STATIONS and _are_stations(rows, RUN_COLUMN):
            lines = listed(run.index[0] for _, run in runs)
            wanted = f"one recording for each part, part {part} begins in lines {lines}"
            do = "make the parts' numbers unique"
            values = rows[[*channels]].apply(lambda cells: floats(cells)[0]).to_numpy().T
            clock = Clock("", rows[SECONDS_COLUMN].to_numpy(), "", "")
            same_time = same_time_text(values, clock, rows.index)
            raise DataError(f"Expected {wanted}, at the same times{same_time}; {do}.")


def _are_stations(rows: pd.DataFrame, name: str) -> bool:
    """Return whether the values of a column stand for several recordings that overlap in time.

    The rows of each value must rise or fall in time throughout. That is enough if a time occurs
    twice; else each value must have times without gaps, and their spans must overlap.

    rows : of one part, with `SECONDS_COLUMN`. name : the column.
    """
    times = rows[SECONDS_COLUMN].to_numpy()
    runs = [run for _, run in rows.groupby(name)[SECONDS_COLUMN]]
    all_steps = [np.diff(run.to_numpy()) for run in runs]
    if not all(len(steps) and ((steps > 0).all() or (steps < 0).all()) for steps in all_steps):
        return False
    if len(np.unique(times)) < len(times):
        return True
    # From here on each time occurs once, as in one recording with a state in a column.
    if any(np.abs(steps).max() > MAX_GAP * np.median(np.abs(steps)) for steps in all_steps):
        return False
    latest_start = max(run.min() for run in runs)
    earliest_end = min(run.max() for run in runs)
    if latest_start >= earliest_end:
        return False
    overlap_is_long = 2 * (earliest_end - latest_start) >= times.max() - times.min()
    if not overlap_is_long and is_rising(np.sort(times)):
        return False
    # In a file in the order of time, numbers may be a signal that changes from row to row.
    steps = np.diff(times)
    is_in_order = bool((steps > 0).all() or (steps < 0).all())
    is_number = not floats(rows[name])[1]
    return not (is_in_order and is_number and STATION.fullmatch(name) is None)


def _time_column(frame: pd.DataFrame, options: LoadOptions) -> str:
    """Return the column of times: the one that the user states, in upper or lower case, else by
    its name.

    A stated column that is not there is returned as stated. Without a clock's name it is the first
    column of dates; "" if there is none.
    """
    columns = [str(name) for name in frame.columns]
    if options.time:
        places = units.find_columns(options.time, columns)
        return columns[places[0]] if places else options.time
    head = frame.iloc[:HEAD]
    with suppress(UnreadableError):
        place = place_of_clock(head)
        if place is not None:
            return columns[place]
    return next((name for i, name in enumerate(columns) if holds_dates(head.iloc[:, i])), "")


def _pivot_signals(frame: pd.DataFrame, keys: list[str], options: LoadOptions) -> pd.DataFrame:
    """Pivot a table with a row for each value of each signal to one with a row for each sample.

    Such a table has a column of tags that names the signal of each row; the signals become columns.
    Any other table is returned unchanged. Raises DataError if the user does not name the channels
    among the tags.

    keys : columns of parts, times and, if there is one, labels.
    """
    channels = set(options.channels)
    has_several = frame.duplicated(keys[:2]).any()
    if not (has_several or channels):
        return frame
    others = [name for name in frame if name not in keys]
    texts = [name for name in others if not is_mostly_numbers(frame[name])]
    tags = [
        name
        for name in texts
        if not STATION.fullmatch(name) and not frame.duplicated([*keys[:2], name]).any()
    ]
    default = tags[0] if tags and has_several else None
    tag = next((name for name in tags if channels and channels <= {*frame[name]}), default)
    if tag is None:
        return frame
    signals = frame[tag].unique().tolist()
    is_named = bool(channels) and channels <= set(signals)
    rows = frame[frame[tag].isin(channels)] if is_named else frame
    # A column that is constant in each curve, as InfluxDB's number of its table, has no samples.
    is_constant = rows.groupby([tag, keys[0]])[others].nunique().max() <= 1
    values = [name for name in others if not is_constant[name] and is_mostly_numbers(rows[name])]
    if len(values) != 1:
        return frame
    if not is_named:
        have = f"{listed(signals)}, as column {tag} calls them"
        wanted = f"the channel to be named, as in channel={units.likely_channel(signals)!r}"
        raise DataError(f"Expected {wanted}; there are {have}.")
    # pivot_table would average.
    wide = rows.pivot(index=keys, columns=tag, values=values[0])  # noqa: PD010
    # A pivot sorts S10 before S9: restore the order of the parts.
    order = {part: i for i, part in enumerate(rows[keys[0]].unique())}
    wide = wide.reset_index()
    wide = wide.sort_values(keys[0], key=lambda parts: parts.map(order), kind="stable")
    return wide.set_axis(range(1, len(wide) + 1))


def long_table_advice(frame: pd.DataFrame, options: LoadOptions, label_file: str) -> str:
    """Return advice which columns to name, if a table looks as if it had a row for each sample.

    "" if it does not, or the user named them all.

    label_file : path of a file that may list the labels of parts.
    """
    frame = frame.loc[:, ~frame.columns.duplicated(keep=False)]
    if max(map(len, numbered_columns(frame.columns).values()), default=0) > 2:
        return ""
    has_parts = options.part in frame and frame[options.part].duplicated().any()
    part = options.part if has_parts else ""
    time = _time_column(frame, options)
    if part and not time:
        others = [name for name in frame.columns if name != part]
        time = next((name for name in others if _rises_within_parts(frame, part, name)), "")
    if not (time or part):
        return ""
    rows = frame.mask(frame == "").bfill()  # a label may stand in a part's last row alone
    others = [name for name in frame.columns if name not in (time, part)]
    changes = _steady_columns(rows[others], any_order=not part)
    few = list(changes)
    hints = []
    if not part:
        if not few:
            return ""
        part = max(few, key=changes.__getitem__)
        hints.append(f"part={part!r}")
    if not options.time:
        hints.append(f"time={time!r}" if time else "the column of times (time)")
    if not (options.label or options.labels):
        is_other = {name: name.lower() not in labels.LABEL_COLUMNS for name in few}
        cells = {name: frame[name].astype(str).unique().tolist() for name in few}
        known = labels.columns_with_labels(cells, options.words)
        likeliness = {name: (is_other[name], name not in known, changes[name]) for name in few}
        label = min(few, key=likeliness.__getitem__, default=part)
        if label != part:
            hints.append(label_hint(label, Counter(frame[label].astype(str)), options))
        else:
            hints.append(_parts_file_advice(frame[part], label_file, options))
    if not hints:
        return ""
    hints += channel_hint([name for name in others if name not in few], frame, options)
    which = "the columns that tell which part it is, when, and the label"
    return f"{which}, as in {', '.join(hints)}"


def _steady_columns(rows: pd.DataFrame, *, any_order: bool) -> dict[str, int]:
    """Return how often the value of a column changes, for those that may be of parts or labels.

    They change once or more, and in at most a fifth of the rows. If there is none, with
    `any_order` the values of columns without fractions are counted, for rows in any order.
    """
    most = len(rows) / 5
    changes = {name: int((rows[name] != rows[name].shift()).sum()) for name in rows}
    few = {name: n for name, n in changes.items() if 2 <= n <= most}
    if few or not any_order:
        return few
    values = {name: rows[name].nunique() for name in rows if _are_whole(rows[name])}
    return {name: n for name, n in values.items() if 2 <= n <= most}


def _are_whole(cells: pd.Series) -> bool:
    """Return whether a column has texts or whole numbers, as those of parts, and no fractions."""
    numbers, wrong = floats(cells)
    return bool(wrong) or bool((numbers == np.rint(numbers)).all())


def _rises_within_parts(frame: pd.DataFrame, part: str, name: str) -> bool:
    """Return whether the numbers or times of a column rise from row to row of each part."""
    with suppress(ValueError, TypeError):
        values, wrong, *_ = seconds_of(frame[name], name)
        is_same_part = (frame[part] == frame[part].shift()).to_numpy()
        steps = np.diff(values)[is_same_part[1:]]
        return not wrong and bool(is_same_part.any()) and bool((steps > 0).all())
    return False


def _parts_file_advice(parts: pd.Series, label_file: str, options: LoadOptions) -> str:
    """Return advice, for an error, to give a file of parts and labels.

    It names `label_file` if that has labels for most parts.
    """
    names = [str(part) for part in parts.unique()]
    with suppress(DataError):
        listed_by = replace(options, part="part", label=None)
        source = listings.labels_in_file(label_file, names, listed_by)
        if look_like_labels(count_labels(names, source)):
            return f"labels={label_file!r}, a file of parts and labels"
    return "and a CSV file of parts and labels (labels)"
