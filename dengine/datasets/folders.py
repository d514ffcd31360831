"""Folders of recordings: a file for each insertion. `load_dataset` calls `find_recordings`,
`are_tables` and `read_folder`.
"""

from __future__ import annotations

import itertools
import os
import re
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache, partial
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from ..errors import DataError, listed
from ..traces import is_time_column
from . import label_names, labels, listings, units
from .assembly import as_dataset
from .cells import fields_beside, split_cells
from .clocks import (
    is_rate_column,
    place_of_clock,
)
from .collector import Recording, RecordingCollector
from .columns import (
    FORCE,
    MIN_NUMBERED,
    TRIED,
    cells_of,
    choose_channels,
    count_labels,
    label_hints,
    look_like_labels,
    natural_key,
    numbered_columns,
    read_nothing,
    usual_label_columns,
    with_label_error,
)
from .containers import (
    JSON,
    NPZ,
    PACKED,
    PARQUET,
    binary_kind,
    open_text,
    suffix_of,
    unpack_errors,
)
from .dataset import Dataset, LoadOptions, UnlabelledError, UnreadableError
from .encodings import decode, missing_name
from .headers import TextCells
from .long_tables import long_table_advice
from .numerals import UndecidedError, is_numeral
from .recordings import read_recording
from .text import SUFFIXES as TEXTS
from .text import TextTable, read_table

NUMBERED_SHARE = 0.75  # of a wide table's columns are numbered
FEW_LISTINGS = 5  # text files for each archive, as lists of its labels
FEW_ROWS = 5  # a text file of as few tells of a recording, and is none
NUMBER_IN_NAME = re.compile(r"(?<![^\W_])([^\W\d_]+[-_ ]?)(\d+)(?![^\W_])")  # SN0008, part_42
MAX_REPEATED = 0.2  # of the numbers of parts stand in several names
HIDDEN = (".", "~$")  # begin the names of files that no user wrote, as Excel's locks
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
    of_suffix = {suffix: [p for p in named.values() if suffix_of(p) == suffix] for suffix in counts}
    # Beside these, CSV files list labels, or one of these lists those of many CSV files.
    most = max(counts[suffix] for suffix in TEXTS)
    chosen = [suffix for suffix in NO_TEXTS if most <= FEW_LISTINGS * counts[suffix] > 0]
    if not chosen:
        usual = [suffix for suffix in counts if suffix in TEXTS]
        heads = {suffix: _longest_head(of_suffix[suffix], options) for suffix in counts}
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


def _longest_head(paths: Sequence[Path], options: LoadOptions) -> TextCells:
    """Return the first rows of the first file, or of one of the next if they have more."""
    heads = [_first_rows(path, options) for path in paths[: -FEW_LISTINGS - 1 : -1]]
    return max(heads, key=lambda cells: min(len(cells.rows), FEW_ROWS + 1))


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
        raise with_label_error(error, partial(_check_words_in_names, named, options)) from error
    step = max(len(paths) // TRIED, 1)
    sample = {path: _first_rows(path, options) for path in paths[::step]}
    usual_header, _ = Counter(tuple(cells.header) for cells in sample.values()).most_common(1)[0]
    first = next(cells for cells in sample.values() if tuple(cells.header) == usual_header)
    kinds = {(*cells.header, *cells.fields): cells for cells in (*sample.values(), first)}
    fields = dict.fromkeys([*first.fields, *itertools.chain.from_iterable(kinds)])
    heads = FolderHeads(first.header, Counter(), {}, list(fields))
    usual = usual_label_columns(heads.label_places)
    for places, cells in kinds.items():
        for name in places:
            is_verdict = labels.is_verdict(name, cells_of(cells, name), options.words)
            if name not in usual and is_verdict:
                heads.verdicts[name] = set()
    for path in paths:
        cells = sample.get(path) or _first_rows(path, options)
        rows = list(cells.rows.values())
        heads.channel_choices[_columns_without_clock(cells.header, rows, options)] += 1
        for name in [name for name in heads.verdicts if {name} & {*cells.header, *cells.fields}]:
            column = labels.LabelColumn(name, options.words, Counter())
            try:
                heads.verdicts[name].add(column.find(cells_of(cells, name)).label)
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
    later. Raises DataError if no file can be read.
    """
    path = next(iter(named.values()))
    if suffix_of(path) in (*NO_TEXTS, *JSON):
        return True
    header = heads.header
    if options.time is not None and options.has_part(header):
        return True
    numbered = [names for names in numbered_columns(header).values() if len(names) >= MIN_NUMBERED]
    if sum(map(len, numbered)) > NUMBERED_SHARE * len(header):
        return True
    if options.labels is not None:
        return False
    with suppress(DataError):
        source = label_names.labels_in_names(options.label, options.words)
        for name in named:
            source.find(name)
        return False
    if len(named) > 1 and not options.has_part(header) and _has_label_column(named, heads, options):
        return False
    has_label = labels.column_among(header, labels.LABEL_COLUMNS) is not None
    if len(named) == 1 or options.time is not None:
        return True
    if (not has_label and not options.has_part(header)) or _have_one_part(named, options):
        return False
    return bool(long_table_advice(_first_readable(named, options)[1].frame, options, ""))


def _have_one_part(named: Mapping[str, Path], options: LoadOptions) -> bool:
    """Return whether the column of parts that the user stated has one value in each file."""
    names = [options.part] if options.part != "part" else []
    paths = list(named.values())[:: max(len(named) // TRIED, 1)]
    heads = [_first_rows(path, options) for path in paths if names]
    return bool(heads) and all(
        names[0] in cells.header and len(set(cells_of(cells, names[0]))) == 1 for cells in heads
    )


def _first_readable(named: Mapping[str, Path], options: LoadOptions) -> tuple[str, TextTable]:
    """Return the name and the table of the first file that can be read.

    Raises DataError if none can.
    """
    last_error: Exception = DataError("")
    for name, path in named.items():
        try:
            return name, read_table(path, options)
        except (UnreadableError, OSError) as error:
            last_error = error
    raise DataError(f"Cannot read {path}: {last_error}.") from last_error


def _check_encoding(paths: Sequence[Path], options: LoadOptions) -> None:
    """Raise DataError with advice if no file can be decoded.

    Also if some files have a name of the options, as of a channel, only in another encoding.
    """
    columns = (options.label, *options.part_columns, options.time)
    names = [*options.channels, *options.words, *filter(None, columns)]
    if not all(map(str.isascii, names)):
        for path in paths[:: max(len(paths) // TRIED, 1)]:
            with suppress(OSError, UnreadableError):
                if advice := missing_name(_first_lines(path), names, options.encoding):
                    raise DataError(f"Cannot read {path}: {advice}.")
    error: UnreadableError | None = None
    for path in (paths[0], paths[len(paths) // 2], paths[-1], *paths):
        try:
            with suppress(OSError):
                decode(_first_lines(path), options.encoding)
            return
        except UnreadableError as caught:
            error = caught
    raise DataError(f"Cannot read {paths[0]}: {error}.")


def _first_lines(path: Path) -> bytes:
    """Return the complete lines among the first 256 KiB of a file.

    Raises OSError, and UnreadableError for one that is no text or damaged.
    """
    with unpack_errors(), open_text(path) as file:
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
    if options.labels is None:
        _check_part(heads, options)
    others = _of_other_channels(named, options.channels, options)
    named = {name: path for name, path in named.items() if name not in others}
    source, label_columns = _label_source(named, heads, options)
    collect = partial(_collect_folder, folder, named, heads, source, options)
    try:
        channels = options.channels or _usual_channels(heads, options, label_columns)
    except DataError as error:
        check = partial(collect, read_nothing, RecordingCollector(name, ()))
        raise with_label_error(error, check) from error
    if beside := [] if options.channels else _of_other_channels(named, channels, options):
        wanted = f"the channel to be named, as in channel={units.likely_channel(channels)!r}"
        raise DataError(f"Expected {wanted}; other files have others, as {beside[0]}.")
    if not others:
        _check_headers(heads, channels)
    collector = RecordingCollector(name, channels)
    in_order = sorted(named, key=lambda name: natural_key(source.without_label(name)))
    collector.ordered = sorted(named, key=natural_key) == in_order
    collector.order = "by name, numbers by size"
    collector.notes.update(_unread_files_notes(folder, named, others, options))
    if options.part == "part":
        _note_repeated_numbers(named, collector.notes)
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


def _check_part(heads: FolderHeads, options: LoadOptions) -> None:
    """Raise DataError if no column, no line and no pattern tells the part, as the user stated."""
    if options.part == "part" or options.has_part(heads.label_places):
        return
    with suppress(re.error):
        if re.compile(options.part).groups == 1:
            return
    names = options.part_columns[1:] or (options.part,)
    missing = listed(name for name in names if name not in heads.label_places)
    wanted = f"a file of labels with a column {missing}, or such a column or line in each file"
    do = "or give a pattern of the names, as 'SN(\\d+)'"
    raise DataError(f"Expected {wanted}, found {listed(heads.label_places)}; {do}.")


def _note_repeated_numbers(names: Iterable[str], notes: Counter[str]) -> None:
    """Add a note if a few files of a folder share a number that may be that of a part.

    A number stands behind a word in a file's name, as 0008 in SN0008_0807.csv and SN0008_0815.csv.
    There is a note for a word if some of its numbers, but fewer than `MAX_REPEATED` of them, occur
    in several files of one folder. It names the first of these.
    """
    files_of = defaultdict[str, defaultdict[tuple[str, str], list[str]]](partial(defaultdict, list))
    for name in names:
        path = PurePosixPath(name)
        for word, number in NUMBER_IN_NAME.findall(path.stem):
            files_of[word][str(path.parent), number].append(path.name)
    for word, files in files_of.items():
        repeated = [group for group in files.values() if len(group) > 1]
        if 0 < len(repeated) < MAX_REPEATED * len(files):
            do = f"part='{word}(\\d+)' takes them as of one part"
            notes[f"One number stands in the names of {listed(repeated[0])}: {do}"] = 1


def _of_other_channels(
    named: Mapping[str, Path], channels: Sequence[str], options: LoadOptions
) -> list[str]:
    """Return the files of other channels than a single one, where each channel has its own file.

    Such a file has not that channel, and its name is that of another file but for the channel, as
    F0000CH2.CSV beside F0000CH1.CSV.
    """
    channel = "".join(channels).lower()
    names = {name.lower() for name in named}
    if len(channels) != 1 or not any(channel in name.rpartition("/")[2] for name in names):
        return []
    others = []
    for name, path in named.items():
        folder, slash, file = name.lower().rpartition("/")
        header = [] if channel in file else _first_rows(path, options).header
        owns = [own.lower() for own in header if own and own.lower() in file]
        beside = {f"{folder}{slash}{file.replace(own, channel)}" for own in owns}
        if beside & names and not units.find_columns(channels[0], header):
            others.append(name)
    return others


def _leave_out_copies(collector: RecordingCollector) -> None:
    """Make faults of copies by a file manager, as `5_ok - Copy.csv` and `Copy of 5_ok.csv`.

    A copy has the samples and the label of the recording whose name is the same without what was
    added.
    """
    recordings = {recording.source: recording for recording in collector.recordings}
    reasons = {}
    for i, recording in enumerate(collector.recordings):
        path = PurePosixPath(recording.source)
        stem = labels.COPY_PREFIX.sub("", label_names.COPY_SUFFIX.sub("", path.stem))
        name = str(path.with_stem(stem or path.stem))
        original = recordings.get(name, recording)
        is_copy = original is not recording and original.label == recording.label
        if is_copy and np.array_equal(original.trace, recording.trace, equal_nan=True):
            reasons[i] = f"Expected each recording once, it is a copy of {name}"
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


def _check_words_in_names(named: Mapping[str, Path], options: LoadOptions) -> None:
    """Raise DataError if the names of a folder's files have label words of unknown meaning."""
    if options.labels is None:
        collector = RecordingCollector("the files' names", ())
        source = label_names.labels_in_names(options.label, options.words)
        with suppress(DataError):
            labels.collect_recordings(named, read_nothing, source, collector)
        collector.check_label_words()


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
    in_names = label_names.labels_in_names(None, options.words)
    if options.labels is not None:
        listing = listings.labels_in_file(options.labels, list(named), options)
        columns = _verdict_columns(named, heads, options)
        if options.label is not None:
            return listing, columns
        sources = [labels.labels_in_column(named, column, options) for column in columns]
        # Numbers among the user's words are the listing's, not the numbers of files.
        words = {word: good for word, good in options.words.items() if not word.isdecimal()}
        sources.append(label_names.labels_in_names(None, words))
        return labels.labels_that_agree(listing, sources, listing.trust), columns
    if options.label in heads.label_places:
        return labels.labels_in_column(named, options.label, options), [options.label]
    if options.label is not None:
        return label_names.labels_in_names(options.label, options.words), []
    columns = _verdict_columns(named, heads, options)
    has_names = not set(count_labels(named, in_names)) <= {None, ""}
    if not has_names:
        columns = columns or usual_label_columns(heads.label_places)[:1]
    sources = [labels.labels_in_column(named, column, options) for column in columns]
    if has_names or not columns:
        sources = [in_names, *sources]
    do = f"name the one to trust: label={listed(columns[:1])!r}, or a pattern of the path (label)"
    fills_in = has_names or len(columns) > 1  # files of other languages have other columns
    return labels.labels_that_agree(sources[0], sources[1:], do, fills_in=fills_in), columns


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
    for name in usual_label_columns(heads.label_places):
        counts = count_labels(sample, labels.labels_in_column(named, name, options))
        if counts[0] + counts[1]:
            columns.append(name)
    return columns + [name for name, values in heads.verdicts.items() if values == {0, 1}]


def _has_label_column(named: Mapping[str, Path], heads: FolderHeads, options: LoadOptions) -> bool:
    """Return whether the files have a column of labels that can be read in the first file.

    Its cells there may be empty, or a word of unknown meaning.
    """
    with suppress(DataError):
        _, columns = _label_source(named, heads, options)
        if columns:
            source = labels.labels_in_column(named, columns[0], options)
            return count_labels([_first_readable(named, options)[0]], source)[None] == 0
    return False


def _label_file_advice(folder: Path, named: Mapping[str, Path], options: LoadOptions) -> str | None:
    """Return advice, for an error, to give a file of labels that is in the folder.

    Such a file names other files in the last of its first 100 lines, and has labels for most
    recordings. None if there is none.
    """
    stems = {name.lower() for path in named.values() for name in (path.stem, path.parent.name)}
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
            source = listings.labels_in_file(path, list(named), options)
            if look_like_labels(count_labels(named, source)):
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
        (count_labels(named, source), f"{condition}, say so: {do}")
        for condition, do, source in label_names.suggest_label_sources(list(named), options.words)
    ]
    counts, advice = max(suggestions, key=lambda suggestion: -suggestion[0][None])
    if look_like_labels(counts) and counts[0] and counts[1]:
        return advice
    sample = dict(list(named.items())[:: max(len(named) // TRIED, 1)])
    counts_by_column = {
        column: count_labels(sample, labels.labels_in_column(sample, column, options))
        for column in header
        if column and not is_time_column(column)
    }
    likely = [
        column
        for column, counts in counts_by_column.items()
        if not counts[None] and look_like_labels(counts) and len(+counts) > 1
    ]
    if not likely:
        return None
    cells = {column: Counter[str]() for column in likely}
    for path in sample.values():
        for column in likely:
            with suppress(UnreadableError, OSError):
                cells[column].update(set(labels.read_cells(path, column, options)))
    return f"if a column tells them, name it: {label_hints(cells, options)}"


def _common_decimal_mark(paths: Sequence[Path], options: LoadOptions) -> str | None:
    """Return the decimal mark that files of a folder prove; None if none does, or both are proven.

    Files that cannot be read are passed over.
    """
    marks = set[str]()
    for path in paths:
        with suppress(UnreadableError, OSError):
            marks |= {read_table(path, options).decimal} - {""}
    return marks.pop() if len(marks) == 1 else None


def _unread_files_notes(
    folder: Path, named: Mapping[str, Path], others: Sequence[str], options: LoadOptions
) -> list[str]:
    """Return notes on the tables and text files of another suffix than the recordings, and on the
    files of other channels.
    """
    notes = []
    if others:
        notes.append(f"Not read, for they have other channels: {listed(others)}")
    suffix = suffix_of(next(iter(named.values())))
    label_file = None if options.labels is None else Path(options.labels).resolve()
    paths = [path for path in folder.rglob("*") if path.is_file() and suffix_of(path) != suffix]
    firsts = {suffix_of(path): path for path in paths}
    tables = {
        other
        for other, path in firsts.items()
        if other in SUFFIXES or (other not in JSON and _is_of_numbers(_first_rows(path, options)))
    }
    texts = (path for path in paths if suffix_of(path) in tables)
    unread = sorted(path.name for path in texts if path.resolve() != label_file)
    if unread:
        notes.append(f"Not read, for most files are {suffix}: {listed(unread)}")
    return notes


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
        cells = split_cells(text, options.columns, options.channels)
        return cells._replace(fields=cells.fields | fields_beside(path))
    return TextCells([], 0, [], {}, "", {})


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
    others = (name for i, name in enumerate(header) if name and i != clock)
    return tuple(name for name in others if not (is_time_column(name) or is_rate_column(name)))
