"""Which columns of a table hold samples, labels, units or the part, by their names and cells; and
advice on them, for errors.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import DataError, listed
from ..traces import is_time_column
from . import labels, units
from .collector import MAX_LABEL_WORDS, Recording, RecordingCollector, label_map_of
from .dataset import LoadOptions, UnknownWordError, UnlabelledError, UnreadableError
from .headers import TextCells
from .text import is_mostly_numbers

if TYPE_CHECKING:
    import pandas as pd

FORCE = "FZ_Base"  # what a UR cell calls the force along the insertion
# FZ_0, or FZ_0ms, FZ_4ms, ...
NUMBER_LAST = re.compile(r"(?P<channel>.*?)[_\-. \[]*(?P<number>\d+)(?P<unit> ?[mµu]s)?\]?")
NUMBER_FIRST = re.compile(
    r"[A-Za-z]{0,6}[_\-. ]?(?P<number>\d+)[_\-. ]+(?P<channel>\D.*)"
)  # s000_fz
MIN_NUMBERED = 8  # columns of a channel; a single recording has fewer numbered ones
TRIED = 20  # recordings or parts, on which it is tried how a column is meant
MAX_STATIONS = 12  # more different values in the rows of a part are no stations
# What a column is called that tells where a part was made.
STATION = re.compile(
    r"(work_?)?station|machine|maschine|anlage|cell|zelle|line|linie|press|presse|robot|roboter"
    r"|spindle|spindel|nest|cavity|tool|head|lane",
    re.IGNORECASE,
)
UNIT_COLUMN = re.compile(
    r"(.*\W)?\w*(units?|einheit|uom|unit[éà]|unidad|単位|单位|단위)", re.IGNORECASE
)
UNIT_WORD = re.compile(r"[^\W\d_]{1,6}([ .·*/-]?[^\W\d_]{1,6}){0,2}")


def read_nothing(_place: Any) -> Recording:
    """Return an empty recording, where only labels are to be checked."""
    return Recording(np.zeros((1, 1), dtype=np.float32))


def check_labels(places: Mapping[str, Any], source: labels.LabelSource, name: str) -> None:
    """Raise DataError if most recordings have no label, or a word of unknown meaning.

    places, name : of the recordings, and of their data set.
    """
    collector = RecordingCollector(name, ())
    labels.collect_recordings(places, read_nothing, source, collector).check_label_words()


def with_label_error(error: DataError, check: Callable[[], object]) -> DataError:
    """Return an error about channels, with what `check` says is wrong with the labels, too."""
    try:
        check()
    except DataError as other:
        return DataError(f"{error} {other}")
    return error


def usual_label_columns(header: Sequence[str]) -> list[str]:
    """Return the columns of a file that have the name of a label and are no signal's."""
    usual = [name for name in labels.LABEL_COLUMNS if name not in labels.SIGNAL_COLUMNS]
    places = (labels.column_among(header, [name]) for name in usual)
    return [header[place] for place in places if place is not None]


def cells_of(cells: TextCells, name: str) -> list[str]:
    """Return the cells of a column, of those rows that have it, or the one value of a field."""
    if name not in cells.header:
        return [cells.fields[name]]
    i = cells.header.index(name)
    return [row[i] for row in cells.rows.values() if i < len(row)]


def count_labels(names: Iterable[str], source: labels.LabelSource) -> Counter[Any]:
    """Count the labels that a source finds for names.

    The keys are labels, words whose meaning is unknown, "" for an empty or unchecked label, and
    None for none, or for what cannot be read.
    """
    counts = Counter[Any]()
    for name in names:
        try:
            counts[source.find(name).label] += 1
        except UnknownWordError as error:
            counts[error.word] += 1
        except (UnreadableError, OSError) as error:
            counts["" if isinstance(error, UnlabelledError) else None] += 1
    return counts


def look_like_labels(counts: Counter[Any]) -> bool:
    """Return whether counts of `count_labels` are those of labels: most names have one.

    Known labels count, and words so few that a user can state their meaning.
    """
    words = set(+counts) - {None, ""}
    is_few = words <= {0, 1} or 2 <= len(words) <= MAX_LABEL_WORDS
    return counts.total() > 2 * counts[None] and is_few


def label_hints(cells: Mapping[str, Counter[Any]], options: LoadOptions) -> str:
    """Return the options, for an error, that name a column of labels among several.

    If only one has labels, they also say what its other words mean.

    cells : how often each word is in each column.
    """
    names = labels.columns_with_labels(cells, options.words)
    if len(names) == 1:
        return label_hint(names[0], cells[names[0]], options)
    return labels.propose_columns(cells, options.words)


def label_hint(column: str, cells: Counter[Any], options: LoadOptions) -> str:
    """Return the options, for an error, that name a column of labels and say what its words mean.

    cells : how often each is there. Those whose meaning is known need no label map.
    """
    label_column = labels.LabelColumn(column, options.words, Counter())
    unknown = Counter[str]()
    unlabelled = Counter[str]()
    meanings = set[int]()
    for cell, n in cells.items():
        try:
            meanings.add(label_column.label_of(cell))
        except UnknownWordError as error:
            unknown[error.word] += n
        except UnlabelledError as error:
            unlabelled[error.word] += n
    if not 1 <= len(unknown) <= MAX_LABEL_WORDS:
        return f"label={column!r}"
    label_map = label_map_of(unknown, meanings, unlabelled)
    or_else = "" if meanings else " or the other way round"
    return f"label={column!r}, label_map={label_map!r}{or_else}"


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key by which names are ordered in lower case, and their numbers by size."""
    words = re.split(r"(\d+)", name.lower())
    return [(0, int(word), "") if word.isdecimal() else (1, 0, word) for word in words if word]


def unit_columns(frame: pd.DataFrame) -> dict[str, dict[int, str]]:
    """Return the column that states units, with the unit of each line that it is filled in.

    In a column of units of a force or torque, any short word is one. The result is empty if no
    column states units, and if several do, for these are of several signals.
    """
    result = {
        str(name): cells[cells.notna() & (cells != "")].astype(str).to_dict()
        for name, cells in frame.items()
        if UNIT_COLUMN.fullmatch(str(name))
    }
    result = {
        name: cells
        for name, cells in result.items()
        if cells
        and (
            all(map(units.parse, cells.values()))
            or (units.is_force(name) and all(map(UNIT_WORD.fullmatch, cells.values())))
        )
    }
    return result if len(result) == 1 else {}


def single_units(
    stated_units: Mapping[str, Mapping[int, str]], lines: Iterable[int]
) -> tuple[str, ...]:
    """Return the unit that `unit_columns` has for these lines, alone; empty if it has none.

    Raises UnreadableError if it has several.
    """
    for name, unit_of in stated_units.items():
        unit = tuple(dict.fromkeys(unit_of[line] for line in lines if line in unit_of))
        if len(unit) > 1:
            actual = f"{listed(unit)} in column {name}"
            raise UnreadableError(f"Expected one unit of a recording, got {actual}")
        return unit
    return ()


def compared_columns(frame: pd.DataFrame, label: str | None, options: LoadOptions) -> list[str]:
    """Return the other columns of a table that have the name of a label and nothing but labels.

    The list is empty if the user names the column of labels.

    label : the column of labels; None for a file of them.
    """
    if options.label is not None:
        return []
    columns = []
    for name in sorted({*usual_label_columns(list(frame.columns))} - {label}):
        column = labels.LabelColumn(name, options.words, Counter())
        if column.has_labels(frame[name].unique().tolist()):
            columns.append(name)
    return columns


def channel_hint(names: Sequence[str], frame: pd.DataFrame, options: LoadOptions) -> list[str]:
    """Return a hint to name the channel, in a list, if several columns may be it; else none."""
    numeric = [name for name in filter(None, names) if is_mostly_numbers(frame[name])]
    if "_field" in frame:  # InfluxDB's, of the signals
        numeric = list(map(str, frame["_field"].unique()))
    if options.channels or FORCE in numeric or len(numeric) < 2:
        return []
    return [f"channel={units.likely_channel(numeric)!r}"]


def choose_channels(available: Sequence[str], options: LoadOptions) -> tuple[str, ...]:
    """Return the channels that the user stated, else the force, else the only one available.

    A stated one may be written in another case or without its unit. Raises DataError for a channel
    that is not available, and if none was stated where several, or none, are.
    """
    chosen = (FORCE,) if FORCE in available else tuple(available)
    if options.channels:
        places = {name: units.find_columns(name, available) for name in options.channels}
        chosen = tuple(available[at[0]] if len(at) == 1 else name for name, at in places.items())
    missing = [name for name in chosen if name not in available]
    if missing or not chosen:
        wanted = f"the channel {listed(missing) or 'of the samples'}"
        raise DataError(f"Expected {wanted}, found {listed(available) or 'none'}.")
    if not options.channels and len(chosen) > 1:
        single = [name for name in chosen if chosen.count(name) == 1] or chosen
        wanted = f"the channel to be named, as in channel={units.likely_channel(single)!r}"
        raise DataError(f"Expected {wanted}; there are {listed(available)}.")
    return chosen


def choose_label_column(frame: pd.DataFrame, options: LoadOptions) -> str:
    """Return the column of labels: the one that the user states, else by its name.

    Raises DataError, with advice, if there is none.
    """
    if options.label is not None:
        if options.label not in frame:
            wanted = f"a column {options.label} of labels"
            raise DataError(f"Expected {wanted}, found {listed(frame.columns)}.")
        return options.label
    place = labels.column_among(list(frame.columns), labels.LABEL_COLUMNS)
    if place is not None:
        return str(frame.columns[place])
    numbered = {
        name
        for columns in numbered_columns(frame.columns).values()
        if len(columns) > 1
        for _, name in columns
    }
    others = [name for name in frame.columns if name not in numbered]
    has_clock = any(is_time_column(name) for name in others)
    if options.time is None and not numbered and has_clock:
        do = "as in one recording; give a folder of such CSV files"
        raise DataError(f"Expected a row an insertion, got {listed(others)}, {do}.")
    cells = {name: Counter(frame[name].astype(str)) for name in others}
    likely = {name: n for name, n in cells.items() if 2 <= frame[name].nunique() <= MAX_LABEL_WORDS}
    do = "add one that is called so"
    if likely:
        do = f"name it: {label_hints(likely, options)}"
    columns = listed(others or frame.columns)
    raise DataError(f"Expected a column of labels, y or label, found {columns}; {do}.")


def numbered_columns(names: Iterable[str]) -> dict[str, list[tuple[int, str]]]:
    """Return the numbered columns of each channel, as (number, column).

    Names as `FZ_0` and as `s000_fz` are tried; the form that gives a channel most columns is taken.
    """
    forms = []
    for pattern in (NUMBER_LAST, NUMBER_FIRST):
        channels = dict[str, list[tuple[int, str]]]()
        for match in filter(None, map(pattern.fullmatch, names)):
            columns = channels.setdefault(match["channel"], [])
            columns.append((int(match["number"]), match[0]))
        forms.append(channels)
    return max(forms, key=lambda channels: max(map(len, channels.values()), default=0))


def sample_columns(names: list[str], options: LoadOptions) -> dict[str, list[str]]:
    """Return the columns of each channel of a wide table, in the order of their numbers.

    The channels are those that the user stated, else the force, else the only one. Raises DataError
    if no column is numbered, a channel is not there or must be named, the numbers of any channel
    are unevenly spaced, or the chosen channels have different numbers of samples.
    """
    channels = {
        channel: sorted(columns)
        for channel, columns in numbered_columns(names).items()
        if len(columns) > 1
    }
    if not channels:
        wanted = "samples in numbered columns, as FZ_0, FZ_1, ..."
        raise DataError(f"Expected {wanted}, found {listed(filter(None, names))}.")
    for columns in channels.values():
        steps = np.diff([number for number, _ in columns])
        odd = np.flatnonzero(steps != np.median(steps))
        if len(odd):
            i = int(odd[0])
            actual = f"after {columns[i][1]} comes {columns[i + 1][1]}"
            raise DataError(f"Expected columns that are numbered one by one, {actual}.")
    chosen = choose_channels(list(channels), options)
    if len({len(channels[name]) for name in chosen}) > 1:
        counts = ", ".join(f"{name} {len(channels[name])}" for name in chosen)
        raise DataError(f"Expected as many samples of each channel, got {counts}.")
    return {name: [column for _, column in channels[name]] for name in chosen}
