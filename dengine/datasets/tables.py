"""Recordings in tables: folders of text files, and tables as text, Parquet or a DataFrame.

A folder has a file for each insertion, or tables of many. A wide table has a row for each
insertion: columns `FZ_0 ... FZ_999` are the samples of a channel FZ, `0 ... 999` or `x1 ... x1000`
those of a channel without a name. A long table has a row for each sample, as historians export it,
and a column of parts. `load_dataset` calls `read_folder`, `read_tables` and `from_frame`.
"""

from __future__ import annotations

import itertools
import os
import re
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, listed
from ..traces import is_time_column
from . import labels, units
from .clocks import (
    ANY_ORDER,
    HEAD,
    MAX_GAP,
    NO_CLOCK,
    clock_of,
    floats,
    holds_dates,
    is_rising,
    place_of_clock,
    rate_in_preamble,
    rate_of,
    seconds_of,
)
from .containers import (
    JSON,
    NPZ,
    PACKED,
    PARQUET,
    binary_kind,
    number_rows,
    open_text,
    suffix_of,
)
from .curves import expand_curves
from .dataset import (
    MAX_LABEL_WORDS,
    Dataset,
    Fault,
    LoadOptions,
    Reading,
    Recording,
    RecordingCollector,
    UnknownWordError,
    UnlabelledError,
    UnreadableError,
    as_dataset,
    label_map_of,
)
from .encodings import decode, missing_name
from .numerals import UndecidedError, is_numeral
from .text import SUFFIXES as TEXTS
from .text import (
    TextCells,
    TextTable,
    cut_note,
    fields_beside,
    is_mostly_numbers,
    parse_numbers,
    read_recording,
    read_table,
    rows_to_trace,
    split_cells,
)

if TYPE_CHECKING:
    import pandas as pd

FORCE = "FZ_Base"  # what a UR cell calls the force along the insertion
# FZ_0, or FZ_0ms, FZ_4ms, ...
NUMBER_LAST = re.compile(r"(?P<channel>.*?)[_\-. \[]*(?P<number>\d+)(?P<unit> ?[mµu]s)?\]?")
NUMBER_FIRST = re.compile(
    r"[A-Za-z]{0,6}[_\-. ]?(?P<number>\d+)[_\-. ]+(?P<channel>\D.*)"
)  # s000_fz
# Added to a long table; no file has these names.
SECONDS_COLUMN = "\0seconds"
ROW_COLUMN = "\0row"  # number of the row, in place of the times that the user does not trust
RUN_COLUMN = "\0run"  # number of the rows of a part that stand together and in the order of time
LIST_CELL = re.compile(r"[\[(]\s*[-+]?[\d.]+[\s,]")  # a list as text
MIN_NUMBERED = 8  # columns of a channel; a single recording has fewer numbered ones
NUMBERED_SHARE = 0.75  # of a wide table's columns are numbered
NEAR = 0.01  # of the largest number: numbers that differ by less are rounded in two ways
FEW_LISTINGS = 5  # text files for each archive, as lists of its labels
FEW_ROWS = 5  # a text file of as few tells of a recording, and is none
HIDDEN = (".", "~$")  # begin the names of files that no user wrote, as Excel's locks
TRIED = 20  # recordings, on which advice about a column is tried
MIN_RUN = 8  # rows on average that stand together in a table that is in the order of its parts
FEW_AGAIN = 0.2  # of the parts' numbers: if fewer come again, these are single faults
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
# A folder that states the value of a column for the tables in it, as Spark and Hive name it.
PARTITION = re.compile(r"([^/=]+)=([^/]*)/")
NO_PARTITION = "__HIVE_DEFAULT_PARTITION__"
NO_TEXTS = (*PARQUET, NPZ)
SUFFIXES = (*TEXTS, *NO_TEXTS, *JSON)


def find_recordings(folder: Path, options: LoadOptions) -> dict[str, Path]:
    """Return the files of recordings in a folder and those inside it, by their path in it.

    They are the Parquet and .npz files, unless there are more than five times as many text files,
    else the text files of the most frequent suffix; several suffixes if they are equally frequent.
    A suffix whose first file has at most `FEW_ROWS` rows, as notes beside a recording have, counts
    only if all suffixes are like that. One that is not in `SUFFIXES` counts if it is more frequent
    and its first file is a table of numbers. `run_2.csv` comes before `run_10.csv`. Hidden files
    and the file of labels are left out; names are those without .gz. Raises DataError if there is
    none.
    """
    label_file = None if options.labels is None else Path(options.labels).resolve()
    paths = {
        path.relative_to(folder): path
        for path in sorted(folder.rglob("*"), reverse=True)  # x.csv replaces x.csv.gz
        if path.is_file() or path.is_symlink()
    }
    named = {
        labels.normalized(inner.as_posix()).removesuffix(PACKED): path
        for inner, path in paths.items()
        if path.resolve() != label_file and not any(word.startswith(HIDDEN) for word in inner.parts)
    }
    counts = Counter(map(suffix_of, named.values()))
    firsts = {suffix_of(path): path for path in named.values()}
    # Beside these, CSV files list labels, or one of these lists those of many CSV files.
    most = max(counts[suffix] for suffix in TEXTS)
    chosen = [suffix for suffix in NO_TEXTS if most <= FEW_LISTINGS * counts[suffix] > 0]
    if not chosen:
        usual = [suffix for suffix in counts if suffix in TEXTS]
        heads = {suffix: _first_rows(firsts[suffix], options) for suffix in counts}
        # Files of a few lines beside each recording tell of it.
        tables = [suffix for suffix in usual if len(heads[suffix].rows) > FEW_ROWS]
        most = max((counts[suffix] for suffix in tables or usual), default=0)
        unusual = [
            suffix
            for suffix in counts
            if suffix not in SUFFIXES
            and counts[suffix] >= most + bool(tables)
            and _is_of_numbers(heads[suffix])
        ]
        chosen = [suffix for suffix in tables or usual if counts[suffix] == most]
        if unusual:
            chosen = [max(unusual, key=counts.__getitem__)]
    n_json = max(counts[suffix] for suffix in JSON)
    if n_json > FEW_LISTINGS * sum(counts[suffix] for suffix in chosen):  # else they tell of these
        chosen = [suffix for suffix in JSON if counts[suffix] == n_json]
    if not chosen:
        raise DataError(_no_recordings(folder, firsts))
    names = [name for name, path in named.items() if suffix_of(path) in chosen]
    return {name: named[name] for name in sorted(names, key=natural_key)}


def _no_recordings(folder: Path, firsts: Mapping[str, Path]) -> str:
    """Return the message of an error: a folder has no files that are read; what its files are.

    firsts : the first file of each suffix.
    """
    entries = listed(sorted(path.name for path in folder.iterdir()))
    forms = f"CSV files, one an insertion, or tables ({', '.join(SUFFIXES)})"
    actual = f"none among {entries}; save them as such" if entries else "none"
    kinds = []
    for path in firsts.values():
        with suppress(OSError), path.open("rb") as file:
            kinds += [f"{path.name} is {kind}" for kind in [binary_kind(file.read(2**12))] if kind]
    details = "".join(f". {kind}" for kind in kinds[:3])
    return f"Expected {forms}, in the folder {folder}, found {actual}{details}."


def _is_of_numbers(head: TextCells) -> bool:
    """Return whether the head of a text is a table: most of its rows have numbers, and as many
    cells as the header.
    """
    rows = [row for row in head.rows.values() if len(row) == len(head.header)]
    n_numbers = sum(any(map(is_numeral, row)) for row in rows)
    return len(head.rows) > FEW_ROWS and 2 * n_numbers > len(head.rows)


class FolderHeads(NamedTuple):
    """What the heads of a folder's text files tell, each of which is read once.

    header : list of str
        Columns of the first file that has those of most, as a sample of 20 files or more tells.
    channel_choices : Counter
        The columns of a file that are no clock, with the number of files that have these.
    verdicts : dict
        The labels in all heads for each column or field whose head is one verdict in each file.
    fields : list of str
        What lines above the header of that file state, as `TextCells.fields`, and what files with
        another header have.
    """

    header: list[str]
    channel_choices: Counter[tuple[str, ...]]
    verdicts: dict[str, set[int]]
    fields: list[str]

    @property
    def label_places(self) -> list[str]:
        """The columns and the fields above the header, in which a label may stand."""
        return [*self.header, *(name for name in self.fields if name not in self.header)]


def read_heads(named: Mapping[str, Path], options: LoadOptions) -> FolderHeads:
    """Read the first rows of each text file; of Parquet and .npz files nothing is read.

    Raises DataError if the files cannot be decoded by `options.encoding`.
    """
    paths = [path for path in named.values() if suffix_of(path) not in (*NO_TEXTS, *JSON)]
    if not paths:
        return FolderHeads([], Counter(), {}, [])
    try:
        _check_encoding(paths, options)
    except DataError as error:
        raise _with_label_error(error, partial(_check_words_in_names, named, options)) from error
    step = max(len(paths) // TRIED, 1)
    sample = {path: _first_rows(path, options) for path in paths[::step]}
    usual_header, _ = Counter(tuple(cells.header) for cells in sample.values()).most_common(1)[0]
    first = next(cells for cells in sample.values() if tuple(cells.header) == usual_header)
    kinds = {(*cells.header, *cells.fields): cells for cells in (*sample.values(), first)}
    fields = dict.fromkeys([*first.fields, *itertools.chain.from_iterable(kinds)])
    heads = FolderHeads(first.header, Counter(), {}, list(fields))
    usual = _usual_label_columns(heads.label_places)
    for places, cells in kinds.items():
        for name in places:
            is_verdict = labels.is_verdict(name, _cells_of(cells, name), options.words)
            if name not in usual and is_verdict:
                heads.verdicts[name] = set()
    for path in paths:
        cells = sample.get(path) or _first_rows(path, options)
        rows = list(cells.rows.values())
        heads.channel_choices[_columns_without_clock(cells.header, rows, options)] += 1
        for name in [name for name in heads.verdicts if {name} & {*cells.header, *cells.fields}]:
            column = labels.LabelColumn(name, options.words, Counter())
            try:
                heads.verdicts[name].add(column.find(_cells_of(cells, name)).label)
            except UnlabelledError:
                continue
            except UnreadableError:
                del heads.verdicts[name]
    return heads


def are_tables(named: Mapping[str, Path], heads: FolderHeads, options: LoadOptions) -> bool:
    """Return whether a folder's files are to be read as tables of many insertions, not as one
    recording each.

    The first file's type and columns tell, with the names of all and the user's options. True for
    Parquet and .npz files, unread: whether an archive holds one insertion, `hold_one_each` tells
    later. Raises DataError if the first file cannot be read.
    """
    path = next(iter(named.values()))
    if suffix_of(path) in (*NO_TEXTS, *JSON):
        return True
    header = heads.header
    if options.time is not None and options.part in header:
        return True
    numbered = [names for names in _numbered_columns(header).values() if len(names) >= MIN_NUMBERED]
    if sum(map(len, numbered)) > NUMBERED_SHARE * len(header):
        return True
    if options.labels is not None:
        return False
    with suppress(DataError):
        source = labels.labels_in_names(options.label, options.words)
        for name in named:
            source.find(name)
        return False
    if len(named) > 1 and options.part not in header and _has_label_column(named, heads, options):
        return False
    has_label = labels.column_among(header, labels.LABEL_COLUMNS) is not None
    if len(named) == 1 or options.time is not None:
        return True
    if not has_label and options.part not in header:
        return False
    return bool(_long_table_advice(read_table(path, options).frame, options, ""))


def _check_encoding(paths: Sequence[Path], options: LoadOptions) -> None:
    """Raise DataError with advice if neither first, middle nor last file can be decoded.

    Also if some files have a name of the options, as of a channel, only in another encoding.
    """
    columns = (options.label, options.part, options.time)
    names = [*options.channels, *options.words, *filter(None, columns)]
    if not all(map(str.isascii, names)):
        for path in paths[:: max(len(paths) // TRIED, 1)]:
            with suppress(OSError):
                if advice := missing_name(_first_lines(path), names, options.encoding):
                    raise DataError(f"Cannot read {path}: {advice}.")
    error: UnreadableError | None = None
    for path in (paths[0], paths[len(paths) // 2], paths[-1]):
        try:
            with suppress(OSError):
                decode(_first_lines(path), options.encoding)
            return
        except UnreadableError as caught:
            error = caught
    raise DataError(f"Cannot read {paths[0]}: {error}.")


def _first_lines(path: Path) -> bytes:
    """Return the complete lines among the first 256 KiB of a file. Raises OSError."""
    with open_text(path) as file:
        return file.read(2**18).rpartition(b"\n")[0]


def read_folder(
    folder: Path,
    named: Mapping[str, Path],
    heads: FolderHeads,
    name: str,
    options: LoadOptions,
) -> Dataset:
    """Read a folder with a file for each insertion.

    Parameters
    ----------
    folder : Path
    named : mapping of str to Path
        The files, from `find_recordings`.
    heads : FolderHeads
        Of the files.
    name : str
        Name of the data set.
    options : LoadOptions

    Returns
    -------
    Dataset
        In the natural order of the names. `ordered` is False if their labels change that order.

    Raises
    ------
    DataError
        If no recording can be read, or most have no label; the error then says what to try.
    """
    if options.labels is None and options.part != "part":
        wanted = f"a file of labels with a column {options.part}"
        raise DataError(f"Expected {wanted}: a folder's names tell no parts' numbers.")
    source, label_columns = _label_source(named, heads, options)
    collect = partial(_collect_folder, folder, named, heads, source, options)
    try:
        channels = options.channels or _usual_channels(heads, options, label_columns)
    except DataError as error:
        check = partial(collect, _read_nothing, RecordingCollector(name, ()))
        raise _with_label_error(error, check) from error
    _check_headers(heads, channels)
    collector = RecordingCollector(name, channels)
    in_order = sorted(named, key=lambda name: natural_key(source.without_label(name)))
    collector.ordered = sorted(named, key=natural_key) == in_order
    collector.order = "by name, numbers by size"
    collector.notes.update(_unread_files_note(folder, named, options))
    common_mark = cache(partial(_common_decimal_mark, list(named.values()), options))

    def read(path: Path) -> Recording:
        """Read a recording; if its decimal mark is undecided, by that of the other files."""
        notes = Counter[str]()
        try:
            recording = read_recording(path, collector.channels, options, notes)
        except UndecidedError:
            notes.clear()
            mark = common_mark()
            if mark is None:
                raise
            recording = read_recording(path, collector.channels, options, notes, mark)
        collector.notes.update(notes)
        return recording

    collect(read, collector)
    _leave_out_copies(collector)
    collector.order_by_start()
    return as_dataset(collector, options)


def _leave_out_copies(collector: RecordingCollector) -> None:
    """Make faults of copies by a file manager, as `5_ok - Copy.csv` and `Copy of 5_ok.csv`.

    A copy has the samples of the recording whose name is the same without what was added.
    """
    traces = {recording.source: recording.trace for recording in collector.recordings}
    reasons = {}
    for i, recording in enumerate(collector.recordings):
        path = PurePosixPath(recording.source)
        stem = labels.COPY_PREFIX.sub("", labels.COPY_SUFFIX.sub("", path.stem))
        original = str(path.with_stem(stem or path.stem))
        is_other = original != recording.source and original in traces
        if is_other and np.array_equal(traces[original], recording.trace, equal_nan=True):
            reasons[i] = f"Expected each recording once, it is a copy of {original}"
    collector.leave_out(reasons)


def _collect_folder(
    folder: Path,
    named: Mapping[str, Path],
    heads: FolderHeads,
    source: labels.LabelSource,
    options: LoadOptions,
    read: Callable[[Path], Recording],
    collector: RecordingCollector,
) -> None:
    """Read the recordings of a folder with their labels into a collector.

    Raises DataError, with advice, if most have no label, or a word whose meaning is unknown.
    """
    try:
        labels.collect_recordings(named, read, source, collector).check_label_words()
    except DataError as error:
        advice = None
        if not (options.label or options.labels):
            advice = _label_file_advice(folder, named, options)
            if advice is None and not collector.unknown_words:
                advice = _label_advice(named, heads.label_places, options)
        if advice is None:
            raise
        raise DataError(f"{str(error).rpartition(';')[0]}; {advice}.") from error


def _read_nothing(_place: Any) -> Recording:
    """Return an empty recording, where only labels are to be checked."""
    return Recording(np.zeros((1, 1), dtype=np.float32))


def _check_labels(places: Mapping[str, Any], source: labels.LabelSource, name: str) -> None:
    """Raise DataError if most recordings have no label, or a word of unknown meaning.

    places, name : of the recordings, and of their data set.
    """
    collector = RecordingCollector(name, ())
    labels.collect_recordings(places, _read_nothing, source, collector).check_label_words()


def _check_words_in_names(named: Mapping[str, Path], options: LoadOptions) -> None:
    """Raise DataError if the names of a folder's files have label words of unknown meaning."""
    if options.labels is None:
        collector = RecordingCollector("the files' names", ())
        source = labels.labels_in_names(options.label, options.words)
        with suppress(DataError):
            labels.collect_recordings(named, _read_nothing, source, collector)
        collector.check_label_words()


def _with_label_error(error: DataError, check: Callable[[], object]) -> DataError:
    """Return an error about channels, with what `check` says is wrong with the labels, too."""
    try:
        check()
    except DataError as other:
        return DataError(f"{error} {other}")
    return error


def _label_source(
    named: Mapping[str, Path], heads: FolderHeads, options: LoadOptions
) -> tuple[labels.LabelSource, list[str]]:
    """Return the source of a folder's labels, and the columns of its files that tell labels.

    The source is the file of labels if one is given, else what `options.label` states (a column, or
    a pattern of the names), else the names, with columns for files whose names tell no label. If no
    name tells one, it is a column. Unless `options.label` is given, the source is compared with all
    others: its `find` raises SeveralLabelsError for a recording whose labels contradict each other.

    All columns are returned, also if the source is another one. Only where `options.label` is the
    source it is that column alone, or none for a pattern.
    """
    in_names = labels.labels_in_names(None, options.words)
    if options.labels is not None:
        listing = labels.labels_in_file(options.labels, list(named), options)
        columns = _verdict_columns(named, heads, options)
        if options.label is not None:
            return listing, columns
        sources = [labels.labels_in_column(named, column, options) for column in columns]
        # Numbers among the user's words are the listing's, not the numbers of files.
        words = {word: good for word, good in options.words.items() if not word.isdecimal()}
        sources.append(labels.labels_in_names(None, words))
        return labels.labels_that_agree(listing, sources, listing.trust), columns
    if options.label in heads.label_places:
        return labels.labels_in_column(named, options.label, options), [options.label]
    if options.label is not None:
        return labels.labels_in_names(options.label, options.words), []
    columns = _verdict_columns(named, heads, options)
    has_names = not set(_count_labels(named, in_names)) <= {None, ""}
    if not has_names:
        columns = columns or _usual_label_columns(heads.label_places)[:1]
    sources = [labels.labels_in_column(named, column, options) for column in columns]
    if has_names or not columns:
        sources = [in_names, *sources]
    do = f"name the one to trust: label={listed(columns[:1])!r}, or a pattern of the path (label)"
    fills_in = has_names or len(columns) > 1  # files of other languages have other columns
    return labels.labels_that_agree(sources[0], sources[1:], do, fills_in=fills_in), columns


def _usual_label_columns(header: Sequence[str]) -> list[str]:
    """Return the columns of a file that have the name of a label and are no signal's."""
    usual = [name for name in labels.LABEL_COLUMNS if name not in labels.SIGNAL_COLUMNS]
    places = (labels.column_among(header, [name]) for name in usual)
    return [header[place] for place in places if place is not None]


def _verdict_columns(
    named: Mapping[str, Path], heads: FolderHeads, options: LoadOptions
) -> list[str]:
    """Return the columns of a folder's files that tell labels.

    They have the name of a label and labels in them, or any name and one verdict in the first rows
    of each file, good in some and bad in others. A number or yes is a verdict only if the column's
    name means the bad outcome, or is `ok`.
    """
    sample = list(named)[:: max(len(named) // TRIED, 1)]
    columns = []
    for name in _usual_label_columns(heads.label_places):
        counts = _count_labels(sample, labels.labels_in_column(named, name, options))
        if counts[0] + counts[1]:
            columns.append(name)
    return columns + [name for name, values in heads.verdicts.items() if values == {0, 1}]


def _cells_of(cells: TextCells, name: str) -> list[str]:
    """Return the cells of a column, of those rows that have it, or the one value of a field."""
    if name not in cells.header:
        return [cells.fields[name]]
    i = cells.header.index(name)
    return [row[i] for row in cells.rows.values() if i < len(row)]


def _has_label_column(named: Mapping[str, Path], heads: FolderHeads, options: LoadOptions) -> bool:
    """Return whether the files have a column of labels that can be read in the first file.

    Its cells there may be empty, or a word of unknown meaning.
    """
    with suppress(DataError):
        _, columns = _label_source(named, heads, options)
        if columns:
            source = labels.labels_in_column(named, columns[0], options)
            return _count_labels([next(iter(named))], source)[None] == 0
    return False


def _count_labels(names: Iterable[str], source: labels.LabelSource) -> Counter[Any]:
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


def _look_like_labels(counts: Counter[Any]) -> bool:
    """Return whether counts of `_count_labels` are those of labels: most names have one.

    Known labels count, and words so few that a user can state their meaning.
    """
    words = set(+counts) - {None, ""}
    is_few = words <= {0, 1} or 2 <= len(words) <= MAX_LABEL_WORDS
    return counts.total() > 2 * counts[None] and is_few


def _label_file_advice(folder: Path, named: Mapping[str, Path], options: LoadOptions) -> str | None:
    """Return advice, for an error, to give a file of labels that is in the folder.

    Such a file names other files in the last of its first 100 lines, and has labels for most
    recordings. None if there is none.
    """
    stems = {path.stem.lower() for path in named.values()}
    forms = (*TEXTS, *PARQUET, *JSON)
    for path in sorted(path for path in folder.rglob("*") if path.suffix.lower() in forms):
        cells = _first_rows(path, LoadOptions())
        last_row = cells.rows[max(cells.rows)] if cells.rows else cells.header
        words = {word.lower().removesuffix(path.suffix) for word in last_row}
        if path.suffix.lower() not in TEXTS:  # whose rows are no lines
            words = stems - {path.stem.lower()} if path.stem.lower() not in stems else set()
        if words.isdisjoint(stems - {path.stem.lower()}):
            continue
        with suppress(DataError):
            source = labels.labels_in_file(path, list(named), options)
            if _look_like_labels(_count_labels(named, source)):
                return f"{path.name} names files: give it, labels={str(path)!r}"
    return None


def _label_advice(
    named: Mapping[str, Path], header: Sequence[str], options: LoadOptions
) -> str | None:
    """Return advice, for an error, how the user can say where the labels of recordings are.

    Other ways to read names are tried on all recordings, then each column on a sample of them. None
    if no way finds labels for most.

    header : columns of the first file.
    """
    suggestions = [
        (_count_labels(named, source), f"{condition}, say so: {do}")
        for condition, do, source in labels.suggest_label_sources(list(named), options.words)
    ]
    counts, advice = max(suggestions, key=lambda suggestion: -suggestion[0][None])
    if _look_like_labels(counts) and counts[0] and counts[1]:
        return advice
    sample = dict(list(named.items())[:: max(len(named) // TRIED, 1)])
    counts_by_column = {
        column: _count_labels(sample, labels.labels_in_column(sample, column, options))
        for column in header
        if column and not is_time_column(column)
    }
    likely = [
        column
        for column, counts in counts_by_column.items()
        if not counts[None] and _look_like_labels(counts) and len(+counts) > 1
    ]
    if not likely:
        return None
    cells = {column: Counter[str]() for column in likely}
    for path in sample.values():
        for column in likely:
            with suppress(UnreadableError, OSError):
                cells[column].update(set(labels.read_cells(path, column, options)))
    return f"if a column tells them, name it: {_label_hints(cells, options)}"


def _label_hints(cells: Mapping[str, Counter[Any]], options: LoadOptions) -> str:
    """Return the options, for an error, that name a column of labels among several.

    If only one has labels, they also say what its other words mean.

    cells : how often each word is in each column.
    """
    names = labels.columns_with_labels(cells, options.words)
    if len(names) == 1:
        return _label_hint(names[0], cells[names[0]], options)
    return labels.propose_columns(cells, options.words)


def _label_hint(column: str, cells: Counter[Any], options: LoadOptions) -> str:
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


def _common_decimal_mark(paths: Sequence[Path], options: LoadOptions) -> str | None:
    """Return the decimal mark that files of a folder prove; None if none does, or both are proven.

    Files that cannot be read are passed over.
    """
    marks = set[str]()
    for path in paths:
        with suppress(UnreadableError, OSError):
            marks |= {read_table(path, options).decimal} - {""}
    return marks.pop() if len(marks) == 1 else None


def _unread_files_note(folder: Path, named: Mapping[str, Path], options: LoadOptions) -> list[str]:
    """Return a note on the tables and text files of another suffix than the recordings, or none."""
    suffix = suffix_of(next(iter(named.values())))
    label_file = None if options.labels is None else Path(options.labels).resolve()
    paths = [path for path in folder.rglob("*") if path.is_file() and suffix_of(path) != suffix]
    firsts = {suffix_of(path): path for path in paths}
    tables = {
        other
        for other, path in firsts.items()
        if other in SUFFIXES or (other not in JSON and _is_of_numbers(_first_rows(path, options)))
    }
    others = (path for path in paths if suffix_of(path) in tables)
    unread = sorted(path.name for path in others if path.resolve() != label_file)
    return [f"Not read, for most files are {suffix}: {listed(unread)}"] if unread else []


def _first_rows(path: Path, options: LoadOptions) -> TextCells:
    """Return the header and rows of a text file: up to 100 lines of 256 KiB, and the last KiB.

    Behind 100 lines the numbers of lines are wrong, and the last row may be cut off. The header is
    empty if they cannot be read: the error comes when the whole file is read.
    """
    with suppress(UnreadableError, OSError, EOFError, zlib.error), open_text(path) as file:
        content = file.read(2**18)
        lines = content.split(b"\n")[:100]
        start = len(b"\n".join(lines))
        end = file.seek(0, os.SEEK_END)
        # In UTF-16 a line may begin in mid-character.
        if start < end and b"\0" not in content[:400]:
            file.seek(max(start, end - 2**10))
            lines += file.read().split(b"\n")[1:]
        text, _ = decode(b"\n".join(lines), options.encoding)
        cells = split_cells(text, options.columns)
        return cells._replace(fields=cells.fields | fields_beside(path))
    return TextCells([], 0, [], {}, "", {})


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key by which names are ordered in lower case, and their numbers by size."""
    words = re.split(r"(\d+)", name.lower())
    return [(0, int(word), "") if word.isdecimal() else (1, 0, word) for word in words if word]


def _usual_channels(
    heads: FolderHeads, options: LoadOptions, label_columns: Sequence[str]
) -> tuple[str, ...]:
    """Return `FZ_Base` if a file has it or none has channels, else the only channel of most files.

    Raises DataError if the most frequent choice of channels is of several, or of none.

    label_columns : the columns that tell labels, which are no channels.
    """
    choices = Counter[tuple[str, ...]]()
    for names, n in heads.channel_choices.items():
        choices[tuple(name for name in names if name not in label_columns)] += n
    lower = {name.lower() for channels in choices for name in channels}
    if not lower or FORCE.lower() in lower:
        return (FORCE,)
    return choose_channels(choices.most_common(1)[0][0], options)


def _check_headers(heads: FolderHeads, channels: Sequence[str]) -> None:
    """Raise DataError if a fifth of the files has other channels, as many as those with the stated.

    Then a setting of the recorder was changed, as its language.
    """
    n_files = heads.channel_choices.total()
    is_channel = [any(name in names for names in heads.channel_choices) for name in heads.header]
    columns = [f"c{i}" if is_one else f"x{i}" for i, is_one in enumerate(is_channel)]
    chosen = [column for column, is_one in zip(columns, is_channel, strict=True) if is_one]
    columns = ["time" if column == "x0" else column for column in columns]
    for name in channels:
        places_in = {names: units.find_columns(name, names) for names in heads.channel_choices}
        known, place = next(((names, x[0]) for names, x in places_in.items() if x), ((), 0))
        for names, n in heads.channel_choices.items():
            is_other = not places_in[names] and 0 < len(names) == len(known) == len(chosen)
            if is_other and 5 * n >= n_files:
                actual = f"{n} of {n_files} files have {listed(names)} instead"
                do = f"columns={','.join(columns)!r}, channel={chosen[place]!r}"
                wanted = f"the channel {name} in each file"
                raise DataError(f"Expected {wanted}, {actual}; name the columns of all, {do}.")


def _columns_without_clock(
    header: list[str], rows: list[list[str]], options: LoadOptions
) -> tuple[str, ...]:
    """Return the names of a file's columns that are no clock, given its header and some rows.

    Columns of labels are still among them; those without a name are not.
    """
    import pandas as pd

    complete = [row for row in rows if len(row) == len(header)]
    clock = None
    with suppress(UnreadableError):
        frame = pd.DataFrame(complete, columns=header, dtype=object)
        clock = place_of_clock(frame, options.time)
    return tuple(
        name for i, name in enumerate(header) if name and i != clock and not is_time_column(name)
    )


def read_tables(named: Mapping[str, Path], name: str, options: LoadOptions) -> Dataset:
    """Read text and Parquet files that are tables of one form, one after the other.

    Raises DataError if one cannot be read or has no rows, or their columns or units differ.
    """
    collector = RecordingCollector(name, ())
    tables: dict[str, TextTable] = {}
    for source, path in named.items():
        try:
            table = read_table(path, options)
        except UnreadableError as error:
            fault = Fault(path.name, error.line, str(error).rstrip("."))
            raise DataError(f"Cannot read {path}: {fault}.") from error
        if table.frame.empty:
            raise DataError(f"Expected rows that can be read in {path}, found none.")
        for key, value in PARTITION.findall(source):
            is_used = key in (options.label, options.part) or key.lower() in labels.LABEL_COLUMNS
            if is_used and key not in table.frame:
                table.frame[key] = "" if value == NO_PARTITION else value
        collector.faults += [replace(fault, source=source) for fault in table.faults]
        tables[source] = table
        collector.notes.update(table.notes)
        others = (str(other) for other in path.parent.glob("*.csv") if other not in named.values())
        collector.label_file = next(others, collector.label_file)
    first = next(iter(tables))
    for source, table in tables.items():
        units_of = dict(zip(tables[first].frame.columns, tables[first].units, strict=False))
        for column, unit in zip(table.frame.columns, table.units, strict=False):
            if unit != (other := units_of.get(column, unit)):
                wanted = f"the same unit of {column} in {first} and in {source}"
                actual = f"{other or 'none'} and {unit or 'none'}"
                raise DataError(f"Expected {wanted}, got {actual}; convert one.")
    return _from_tables(tables, options, collector)


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
    tables, options = _with_samples_in_columns(tables, options, collector)
    turned = {source: _turned(table, options) for source, table in tables.items()}
    if any(table is not tables[source] for source, table in turned.items()):
        tables = turned
        options = replace(options, time=None)
    frames = {source: table.frame for source, table in tables.items()}
    first = next(iter(frames))
    for source, frame in frames.items():
        _check_columns(frame, source)
        if differing := listed(sorted(_column_forms(frame) ^ _column_forms(frames[first]))):
            wanted = f"the same columns in {first} and in {source}"
            constant = [name for name in frame if len(set(frame[name])) == 1]
            do = ""
            if constant:
                do = f"; if a file is one recording, name its label's column: label={constant[0]!r}"
            raise DataError(f"Expected {wanted}, only one of them has {differing}{do}.")
    has_rows_of_parts = options.part in frames[first] and frames[first][options.part].is_unique
    is_wide = has_rows_of_parts or options.part not in frames[first]
    is_wide = is_wide and _largest_channel(frames[first]) >= MIN_NUMBERED
    if options.labels is not None and options.time is None and is_wide:
        return _join_listing(tables, options, collector)
    if options.time is not None or options.labels is not None:
        cut_lines = {(source, table.cut_line) for source, table in tables.items()}
        cut = [fault for fault in collector.faults if (fault.source, fault.line) in cut_lines]
        collector.faults = [fault for fault in collector.faults if fault not in cut]
        collector.notes.update(map(cut_note, cut))
        frame, is_repeated = _concatenate_long(frames, options)
        return _from_long(frame, is_repeated, options, collector, first, tables[first])
    if advice := _long_table_advice(frames[first], options, collector.label_file):
        columns = listed(frames[first].columns)
        actual = f"a row a sample: {columns}"
        raise DataError(f"Expected a row an insertion, got {actual}; a long table needs {advice}.")
    for source, table in tables.items():
        for line, _, read in _wide_rows(table, options, collector, source):
            collector.add(source, read, line)
    _leave_out_repeated_rows(collector)
    return as_dataset(collector, options)


def _leave_out_repeated_rows(collector: RecordingCollector) -> None:
    """Leave out the rows of wide tables that repeat a row of another file, as of an upload again.

    Part, label and all samples are equal; a note names these rows.
    """
    file_of = dict[tuple[Any, ...], str]()
    repeated = list[str]()
    kept = list[Recording]()
    for recording in collector.recordings:
        file = recording.source.rpartition(", line ")[0]
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
    return max(map(len, _numbered_columns(frame.columns).values()), default=0)


def _join_listing(
    tables: Mapping[str, TextTable], options: LoadOptions, collector: RecordingCollector
) -> Dataset:
    """Make a data set of wide tables whose labels are in a file, by the numbers of parts.

    Raises DataError if a table has no column of these, or two rows have one number.
    """
    read_of_part = dict[str, Callable[[], Recording]]()
    for source, table in tables.items():
        if options.part not in table.frame:
            samples = max(_numbered_columns(table.frame.columns).values(), key=len)
            others = table.frame.drop(columns=[name for _, name in samples])
            likely = next((name for name in others if others[name].is_unique), "Serial")
            wanted = f"the column of parts that the file of labels names, as in part={likely!r}"
            raise DataError(f"Expected {wanted}, found {listed(others.columns)}.")
        for _, part, read in _wide_rows(table, options, collector, source):
            if part in read_of_part:
                wanted = f"one row for each part, as {options.labels} lists them"
                raise DataError(f"Expected {wanted}, got {part} twice.")
            read_of_part[part] = read
    listed_by = replace(options, part="part")
    listing = labels.labels_in_file(str(options.labels), list(read_of_part), listed_by)
    labels.collect_recordings(read_of_part, lambda read: read(), listing, collector)
    return as_dataset(collector, options)


def _with_samples_in_columns(
    tables: Mapping[str, TextTable], options: LoadOptions, collector: RecordingCollector
) -> tuple[Mapping[str, TextTable], LoadOptions]:
    """Return tables with a column for each sample where a cell holds a curve, and their options.

    Raises DataError if the clocks of the curves contradict them or each other.
    """
    result = dict[str, TextTable]()
    for source, table in tables.items():
        try:
            frame, rate, name, unread = expand_curves(table.frame, options)
        except UnreadableError as error:
            raise DataError(f"Cannot read {Fault(source, error.line, str(error))}.") from error
        if frame is table.frame:
            return tables, options
        if options.labels is not None:
            wanted = f"a column of labels beside the curves in the cells of {source}"
            raise DataError(f"Expected {wanted}, got a file of labels; join it to the table.")
        if unread:
            collector.notes[f"Not read: the columns {listed(unread)}"] = 1
        if rate is not None:
            clock = f"column {name}, in which each cell has all times"
            table = table._replace(rate_hz=rate, clock=clock)
        numbers = table.numbers.replace("whole numbers", "curves in cells")
        result[source] = table._replace(frame=frame, units=[], numbers=numbers)
    return result, replace(options, time=None)


def _turned(table: TextTable, options: LoadOptions) -> TextTable:
    """Return a table with a column for each part as a wide table, with a row for each part.

    Such a table has times in its first column, eight or more columns of numbers beside it, and
    labels in the names of these, or in a row without a time. Any other table is returned as it is.
    The index of the new rows counts the columns.
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
    in_names = labels.labels_in_names(None, options.words)
    label_counts = _count_labels(frame.columns[1:], in_names)
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
    has_listing = options.labels is not None
    if not (has_names or rows or has_listing or options.label in about):
        return table
    samples = frame[is_sample].iloc[:, 1:].T.set_axis(list(map(str, range(len(times)))), axis=1)
    wide = pd.concat([about, samples], axis=1).assign(**{options.part: frame.columns[1:]})
    if has_names and not rows:
        wide["label"] = [_word_in_name(name, in_names) for name in frame.columns[1:]]
    elif options.label is None:
        wide = wide.rename(columns={rows[0]: "label"})
    rate = None
    with suppress(UnreadableError):
        clock = clock_of(frame[is_sample].iloc[:, :1], first, table.units)
        rate = None if clock is None else rate_of(clock, times.index)
    wide = wide.set_axis(range(2, len(wide) + 2))
    clock_text = "the first column, a column for each part"
    return table._replace(frame=wide, units=[], rate_hz=rate, clock=clock_text)


def _word_in_name(name: str, source: labels.LabelSource) -> str:
    """Return the word that is the label in a name, else its last word; "" if that is a number."""
    with suppress(UnreadableError):
        return source.find(name).word
    return re.split(r"[\s_]", name)[-1].strip("0123456789")


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
        for channel, columns in _numbered_columns(frame.columns).items()
        if len(columns) > 1
        for _, name in columns
    }
    return {channel_of.get(name, name) for name in frame.columns}


def _wide_rows(
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
        label_column = _label_column(frame, options)
        label_columns = [label_column, *_compared_columns(frame, label_column, options)]
    parts = _parts_of_rows(frame, options)
    others = [name for name in frame.columns if name not in (*label_columns, options.part)]
    columns = _sample_columns(others, options)
    all_columns = [name for names in columns.values() for name in names]
    values, wrong, _ = parse_numbers(frame[all_columns])
    traces = values.reshape(len(frame), len(columns), -1)
    collector.channels = tuple(filter(None, columns))
    _check_single_signal(frame, others, options)
    unread = [name for name in others if name and name not in all_columns]
    stated = _stated_in_rows(frame[unread], table)
    unread = [name for name in unread if name not in stated.columns]
    if unread := [_describe_column(frame, name) for name in unread]:
        collector.notes[f"Not read: the columns {listed(unread)}"] = 1
    label_cells = [
        labels.LabelColumn(name, options.words, collector.notes) for name in label_columns
    ]
    unit_of = dict(zip(frame.columns, table.units, strict=False))
    channel_units = tuple(_unit_of_columns(*item, unit_of) for item in columns.items())
    if table.offer and not options.rate_hz:
        collector.notes[table.offer] = 1

    def read(line: int, trace: NDArray[np.float32], words: Sequence[Any], part: str) -> Recording:
        """Return a row as a recording; raise UnreadableError for a bad cell or label."""
        if line in wrong:
            raise UnreadableError(wrong[line])
        rate = None if options.rate_hz else stated.rate_of.get(line)
        is_stated = len(columns) == 1 and line in stated.unit_of
        recording = Recording(
            without_trailing_nan(trace),
            rate,
            (stated.unit_of[line],) if is_stated else channel_units,
            reading=Reading(numbers=table.numbers, clock="" if rate is None else stated.clock),
            source=f"{source}, line {line}",
            part=part or None,
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


def _unit_columns(frame: pd.DataFrame) -> dict[str, dict[int, str]]:
    """Return the column that states units, with the unit of each line that it is filled in.

    The result is empty if no column does, and if several do, for these are of several signals.
    """
    result = {
        str(name): cells[cells.notna() & (cells != "")].astype(str).to_dict()
        for name, cells in frame.items()
        if UNIT_COLUMN.fullmatch(str(name))
    }
    result = {
        name: cells
        for name, cells in result.items()
        if cells and all(map(units.parse, cells.values()))
    }
    return result if len(result) == 1 else {}


def _step_in_names(names: Iterable[str]) -> float | None:
    """Return the seconds between samples that the names of columns state, as FZ_0ms, FZ_4ms, ..."""
    matches = [match for match in map(NUMBER_LAST.fullmatch, names) if match and match["unit"]]
    matches = [match for match in matches if match["channel"] == matches[0]["channel"]]
    if len(matches) < MIN_NUMBERED:
        return None
    second = units.seconds_in(matches[0]["unit"].strip()) or 0.0
    return (int(matches[1]["number"]) - int(matches[0]["number"])) * second


def _single_units(
    stated_units: Mapping[str, Mapping[int, str]], lines: Iterable[int]
) -> tuple[str, ...]:
    """Return the unit that `_unit_columns` has for these lines, alone; empty if it has none.

    Raises UnreadableError if it has several.
    """
    for name, unit_of in stated_units.items():
        unit = tuple(dict.fromkeys(unit_of[line] for line in lines if line in unit_of))
        if len(unit) > 1:
            actual = f"{listed(unit)} in column {name}"
            raise UnreadableError(f"Expected one unit of a recording, got {actual}")
        return unit
    return ()


def _stated_in_rows(frame: pd.DataFrame, table: TextTable) -> StatedByRow:
    """Return the units and rates that columns of a table state, as `torqueUnit` or `fs`.

    A column counts if each of its cells that is not empty states one. If the table has a rate, it
    is that of all rows.
    """
    filled = {str(name): cells[cells.notna() & (cells != "")] for name, cells in frame.items()}
    in_units = _unit_columns(frame)
    unit_of = next(iter(in_units.values()), {})
    rate_hz, clock = table.rate_hz, table.clock
    if step := _step_in_names(table.frame.columns):
        rate_hz, clock = 1.0 / step, "times in the names of the columns"
    if rate_hz is not None:
        rate_of = dict.fromkeys(table.frame.index, rate_hz)
        return StatedByRow(unit_of, rate_of, clock, list(in_units))
    for name, cells in filled.items():
        rates = {line: _stated_rate(name, cell) for line, cell in cells.items()}
        rate_of = {line: rate for line, rate in rates.items() if rate is not None}
        if len(rate_of) == len(cells) > 0:
            clock = f"none, column {name} states the rate"
            return StatedByRow(unit_of, rate_of, clock, [name, *in_units])
    return StatedByRow(unit_of, {}, "", list(in_units))


def _stated_rate(name: str, cell: object) -> float | None:
    """Return the rate in hertz that a cell of a column states, as 500 of `Sample Rate (Hz)`."""
    quantity, unit = units.split(name.rpartition(".")[2])
    return rate_in_preamble(f"{quantity}: {cell} {unit}")[0]


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


def _concatenate_long(
    tables: Mapping[str, pd.DataFrame], options: LoadOptions
) -> tuple[pd.DataFrame, NDArray[np.bool_]]:
    """Return long tables as one, in their order, and which of its rows repeat a file before.

    The same part's number in two files means two parts: both get their file's name before the
    number. But a part that ends one file and begins the next is one part, and so is one that has
    rows of the same date and nearly the same numbers in both, as exports that overlap have: these
    rows are the repeated ones.
    """
    import pandas as pd

    frame = pd.concat(tables.values())
    if len(tables) == 1 or options.part not in frame:
        return frame, np.zeros(len(frame), dtype=np.bool_)
    time = _time_column(frame, options)
    files = np.repeat(list(tables), [len(table) for table in tables.values()])
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


def _from_long(
    frame: pd.DataFrame,
    is_repeated: NDArray[np.bool_],
    options: LoadOptions,
    collector: RecordingCollector,
    source: str,
    first: TextTable,
) -> Dataset:
    """Make a data set of a long table: the rows of a part, by their times, are one insertion.

    Its label is in a column, or in a file of parts. Raises DataError if the column of parts or of
    times is not found.

    is_repeated : which rows are in another file, too: their label is compared with that of the
        part, but their samples are left out, and a note of the collector says so.
    first : the first of the tables that `frame` is of, for the units of columns.
    """
    column_units = dict(zip(first.frame.columns, first.units, strict=False))
    frame, time = _with_times(frame, options, collector.label_file, source)
    if time != ROW_COLUMN:
        options = replace(options, time=time)
    label = None if options.labels is not None else _label_column(frame, options)
    label_columns = [*([label] if label else []), *_compared_columns(frame, label, options)]
    all_rows = {str(part): rows for part, rows in frame.groupby(options.part, sort=False)}
    label_source = _label_source_of_parts(all_rows, label_columns, options)
    if is_repeated.any():
        text = "Parts are in two files at the same times: they count once"
        collector.notes[text] = frame[options.part][is_repeated].nunique()
        frame = frame[~is_repeated]
    frame = _pivot_signals(frame, [options.part, time, *label_columns], options)
    others = [name for name in frame.columns if name not in (options.part, time, *label_columns)]
    check = partial(_check_labels, all_rows, label_source, collector.name)
    collector.channels = _channels_of_long(frame, others, options, check)
    seconds, form = _times_of_long(frame[time], column_units.get(time, ""), collector)
    rows_of_part = _rows_by_part(frame, seconds, options)
    no_stations = {options.part, time, *label_columns, *collector.channels}
    _check_single_station(rows_of_part, [name for name in others if name not in no_stations])
    has_dates = holds_dates(frame[time])
    if not has_dates:
        _check_together(rows_of_part)
    places = [frame.columns.get_loc(name) for name in collector.channels]
    stated_units = _unit_columns(frame[others]) if len(places) == 1 else {}

    def read(rows: pd.DataFrame) -> Recording:
        """Return the rows of a part as a trace, in the order of their times."""
        rows = rows.sort_values(SECONDS_COLUMN, kind="stable")
        start = float(rows[SECONDS_COLUMN].iloc[0])
        rows = rows.drop(columns=[SECONDS_COLUMN, RUN_COLUMN, ROW_COLUMN], errors="ignore")
        units_row = [column_units.get(name, "") for name in rows.columns]
        timed = rows_to_trace(rows, places, options, collector.notes, units_row)
        channel_units = _single_units(stated_units, rows.index) or tuple(
            column_units.get(name) or units.split(name)[1] for name in collector.channels
        )
        clock = timed.reading.clock.replace(ANY_ORDER, form)  # a part's rows may not tell it
        reading = timed.reading._replace(numbers=first.numbers, clock=clock)
        return timed._replace(units=channel_units, start=start, reading=reading)

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
        names = _long_table_advice(frame, options, label_file)
        advice = f"; name {names}" if names else ""
        raise DataError(f"Expected {wanted}, found {listed(frame.columns)}{advice}.")
    return frame, time


def _times_of_long(
    column: pd.Series, unit: str, collector: RecordingCollector
) -> tuple[NDArray[np.float64], str]:
    """Return the times of a long table in seconds, and their form as in `Clock`.

    A note of the collector says so if dates may have the day or the month first.
    """
    seconds, _, _, form = seconds_of(column, str(column.name), unit)
    if form == ANY_ORDER:
        text = f"Column {column.name} has {form}: they are read month first"
        collector.notes[f"{text}, which matters for the order of the parts alone"] = 1
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
    named = filter(None, names)
    try:
        return choose_channels([name for name in named if is_mostly_numbers(frame[name])], options)
    except DataError as error:
        raise _with_label_error(error, check_labels) from error


def _rows_by_part(
    frame: pd.DataFrame, seconds: NDArray[np.float64], options: LoadOptions
) -> dict[str, pd.DataFrame]:
    """Return the rows of each part of a long table, by its number, in order of first appearance.

    The rows have two more columns: `SECONDS_COLUMN`, their times, and `RUN_COLUMN`, the number of
    the run that they are in. A run ends where the next row is of another part or earlier. Raises
    DataError if many parts' numbers were used again later.
    """
    part = frame[options.part]
    is_new = (part != part.shift()).to_numpy() | np.r_[False, np.diff(seconds) < 0]
    with_seconds = frame.assign(**{SECONDS_COLUMN: seconds, RUN_COLUMN: np.cumsum(is_new)})
    groups = with_seconds.groupby(options.part, sort=False)
    rows_of_part = {str(part): rows for part, rows in groups}
    _check_numbers_once(rows_of_part)
    return rows_of_part


def _check_numbers_once(rows_of_part: Mapping[str, pd.DataFrame]) -> None:
    """Raise DataError if many parts' numbers were used again, as where each shift counts from 1.

    Many are two or more, and at least a fifth of all (`FEW_AGAIN`); fewer are not looked at here. A
    number was used again if its rows stand in several runs, other parts between them, and each
    pause is longer than all of its rows would take at their median step.
    """
    again = []
    for part, rows in rows_of_part.items():
        starts = np.flatnonzero(rows[RUN_COLUMN].diff().to_numpy() > 1)
        steps = np.abs(np.diff(rows[SECONDS_COLUMN].to_numpy()))
        if len(starts) and steps[starts - 1].min() > len(rows) * np.median(steps):
            again.append((part, rows.index[starts[0]]))
    if len(again) < 2 or len(again) < FEW_AGAIN * len(rows_of_part):
        return
    part, line = again[0]
    wanted = f"one recording for each part, {len(again)} of {len(rows_of_part)} numbers come again"
    do = "make the parts' numbers unique, as day (or station) and number in one column"
    raise DataError(f"Expected {wanted} later, as {part} in line {line}; {do}.")


def _check_together(rows_of_part: Mapping[str, pd.DataFrame]) -> None:
    """Raise DataError if parts of a table, whose clock begins anew in each, stand in it twice.

    That is so if all parts stand in few runs of many rows, and one in several without a gap in
    time: a number that was given again, whose times go on, would be one long recording.
    """
    times = [rows[SECONDS_COLUMN] for rows in rows_of_part.values()]
    if np.median([part_times.min() for part_times in times]) > min(map(max, times)):
        return  # one clock of all parts
    n_runs = {part: rows[RUN_COLUMN].nunique() for part, rows in rows_of_part.items()}
    n_rows = sum(map(len, rows_of_part.values()))
    part = max(n_runs, key=n_runs.__getitem__, default="")
    if not n_runs or n_runs[part] < 2 or n_rows < MIN_RUN * sum(n_runs.values()):
        return
    steps = np.diff(np.sort(rows_of_part[part][SECONDS_COLUMN].to_numpy()))
    if steps.max() > MAX_GAP * np.median(steps):
        return  # a fault of that part
    lines = listed(run.index[0] for _, run in rows_of_part[part].groupby(RUN_COLUMN))
    wanted = f"the rows of each part together, part {part} begins in lines {lines}"
    raise DataError(f"Expected {wanted}, other parts between; make the parts' numbers unique.")


def _label_source_of_parts(
    rows_of_part: Mapping[str, pd.DataFrame], label_columns: Sequence[str], options: LoadOptions
) -> labels.LabelSource:
    """Return the source of the labels of a long table: a file of labels, or the first column.

    The other columns of labels are compared with it.
    """
    sources = [_labels_of_parts(rows_of_part, name, options) for name in label_columns]
    if options.labels is not None:
        listed_by = replace(options, part="part")
        listing = labels.labels_in_file(options.labels, list(rows_of_part), listed_by)
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


def _compared_columns(frame: pd.DataFrame, label: str | None, options: LoadOptions) -> list[str]:
    """Return the other columns of a table that have the name of a label and nothing but labels.

    The list is empty if the user names the column of labels.

    label : the column of labels; None for a file of them.
    """
    if options.label is not None:
        return []
    columns = []
    for name in sorted({*_usual_label_columns(list(frame.columns))} - {label}):
        column = labels.LabelColumn(name, options.words, Counter())
        if column.has_labels(frame[name].unique().tolist()):
            columns.append(name)
    return columns


def _check_single_station(rows_of_part: Mapping[str, pd.DataFrame], columns: Sequence[str]) -> None:
    """Raise DataError if the rows of a part's number are those of several parts, made at the same
    times at different places.

    Such rows would be merged to one zigzag trace. A column, or the runs of rows in the order of
    time, tells them apart if the times of its values overlap, and each value by itself has times
    without gaps.

    columns : that may tell where a part was made.
    """
    for part, rows in rows_of_part.items():
        for name in columns:
            if 2 <= rows[name].nunique() <= MAX_STATIONS and _are_stations(rows, name):
                values = listed(sorted(map(str, rows[name].dropna().unique())))
                wanted = f"one recording for each part, part {part} has several values of {name}"
                do = f"make the parts' numbers unique, as {name} and number in one column"
                raise DataError(f"Expected {wanted} ({values}) at the same time; {do}.")
        runs = rows.groupby(RUN_COLUMN)
        if 2 <= runs.ngroups <= MAX_STATIONS and _are_stations(rows, RUN_COLUMN):
            lines = listed(run.index[0] for _, run in runs)
            wanted = f"one recording for each part, part {part} begins in lines {lines}"
            do = "make the parts' numbers unique"
            raise DataError(f"Expected {wanted}, at the same times; {do}.")


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
        wanted = f"the channel to be named, as in channel={signals[0]!r}"
        raise DataError(f"Expected {wanted}; there are {have}.")
    # pivot_table would average.
    wide = rows.pivot(index=keys, columns=tag, values=values[0])  # noqa: PD010
    # A pivot sorts S10 before S9: restore the order of the parts.
    order = {part: i for i, part in enumerate(rows[keys[0]].unique())}
    wide = wide.reset_index()
    wide = wide.sort_values(keys[0], key=lambda parts: parts.map(order), kind="stable")
    return wide.set_axis(range(1, len(wide) + 1))


def _long_table_advice(frame: pd.DataFrame, options: LoadOptions, label_file: str) -> str:
    """Return advice which columns to name, if a table looks as if it had a row for each sample.

    "" if it does not, or the user named them all.

    label_file : path of a file that may list the labels of parts.
    """
    frame = frame.loc[:, ~frame.columns.duplicated(keep=False)]
    if max(map(len, _numbered_columns(frame.columns).values()), default=0) > 2:
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
            hints.append(_label_hint(label, Counter(frame[label].astype(str)), options))
        else:
            hints.append(_parts_file_advice(frame[part], label_file, options))
    if not hints:
        return ""
    hints += _channel_hint([name for name in others if name not in few], frame, options)
    which = "the columns that tell which part it is, when, and the label"
    return f"{which}, as in {', '.join(hints)}"


def _channel_hint(names: Sequence[str], frame: pd.DataFrame, options: LoadOptions) -> list[str]:
    """Return a hint to name the channel, in a list, if several columns may be it; else none."""
    numeric = [name for name in filter(None, names) if is_mostly_numbers(frame[name])]
    if "_field" in frame:  # InfluxDB's, of the signals
        numeric = list(map(str, frame["_field"].unique()))
    if options.channels or FORCE in numeric or len(numeric) < 2:
        return []
    return [f"channel={_likely_channel(numeric)!r}"]


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
        source = labels.labels_in_file(label_file, names, listed_by)
        if _look_like_labels(_count_labels(names, source)):
            return f"labels={label_file!r}, a file of parts and labels"
    return "and a CSV file of parts and labels (labels)"


def _likely_channel(names: Sequence[str]) -> str:
    """Return the first of some channels whose name is that of a force, else the first."""
    return next((name for name in names if units.FORCE_NAME.fullmatch(name)), names[0])


def choose_channels(available: Sequence[str], options: LoadOptions) -> tuple[str, ...]:
    """Return the channels that the user stated, else the force, else the only one available.

    Raises DataError for a channel that is not available, and if none was stated where several, or
    none, are.
    """
    default = (FORCE,) if FORCE in available else tuple(available)
    chosen = options.channels or default
    missing = [name for name in chosen if name not in available]
    if missing or not chosen:
        wanted = f"the channel {listed(missing) or 'of the samples'}"
        raise DataError(f"Expected {wanted}, found {listed(available) or 'none'}.")
    if not options.channels and len(chosen) > 1:
        single = [name for name in chosen if chosen.count(name) == 1] or chosen
        wanted = f"the channel to be named, as in channel={_likely_channel(single)!r}"
        raise DataError(f"Expected {wanted}; there are {listed(available)}.")
    return chosen


def without_trailing_nan(trace: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a trace (C, T) without the last samples that are NaN in all channels.

    A trace of nothing but NaN is returned whole.
    """
    measured = np.flatnonzero(~np.isnan(trace).all(axis=0))
    return trace[:, : measured[-1] + 1] if len(measured) else trace


def _label_column(frame: pd.DataFrame, options: LoadOptions) -> str:
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
        for columns in _numbered_columns(frame.columns).values()
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
        do = f"name it: {_label_hints(likely, options)}"
    columns = listed(others or frame.columns)
    raise DataError(f"Expected a column of labels, y or label, found {columns}; {do}.")


def _numbered_columns(names: Iterable[str]) -> dict[str, list[tuple[int, str]]]:
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


def _sample_columns(names: list[str], options: LoadOptions) -> dict[str, list[str]]:
    """Return the columns of each channel of a wide table, in the order of their numbers.

    The channels are those that the user stated, else the force, else the only one. Raises DataError
    if no column is numbered, a channel is not there or must be named, the numbers of any channel
    are unevenly spaced, or the chosen channels have different numbers of samples.
    """
    channels = {
        channel: sorted(columns)
        for channel, columns in _numbered_columns(names).items()
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
