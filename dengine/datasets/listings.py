"""Labels in a file that lists recordings or parts, with a row each.

`labels_in_file` returns the source of these labels, `read_ordered_labels` labels in the order of
the rows.
"""

import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, NamedTuple

from ..errors import DataError, listed
from .collector import MAX_LABEL_WORDS
from .containers import PACKED
from .dataset import Fault, LoadOptions, UnknownWordError, UnlabelledError, UnreadableError
from .labels import (
    FILE_SUFFIX,
    LABEL_COLUMNS,
    LISTS,
    LabelColumn,
    LabelSource,
    SourcedLabel,
    column_among,
    labels_that_agree,
    means_bad,
    normalized,
    propose_columns,
)
from .text import SUFFIXES, read_table

if TYPE_CHECKING:
    import pandas as pd

LEADING_ZEROS = re.compile(r"(?<=_)0+(?=\d)")
AGAIN = re.compile(r"(.*\w)(?:[._-]\d| ?\(\d+\))((?:\.[^\W\d]\w*)?)")  # SN12.1, SN12 (2).csv
# A long number as a spreadsheet saves it, without its last digits: 2,40311E+11.
SHORTENED = re.compile(r"\d([.,]\d{0,8})?[eE]\+(09|[1-9]\d)")


class _LabelRow(NamedTuple):
    """The rows of a file of labels that name one recording.

    lines, labels : their lines, and the label in each.
    words : those of the path in `file`, see `_path_words`.
    part : number of the part, if there is a column of them.
    """

    lines: tuple[int, ...]
    words: tuple[str, ...]
    file: str
    labels: tuple[str, ...]
    part: str | None

    def place_in(self, source: str) -> str:
        """Return where the rows are in a file of this name, for an error."""
        return f"{source}, line{'s' if len(self.lines) > 1 else ''} {listed(self.lines)}"


def labels_in_file(
    path: str | os.PathLike[str],
    names: Sequence[str],
    options: LoadOptions,
    frame: "pd.DataFrame | None" = None,
) -> LabelSource:
    """Return a source of labels in a CSV file with a column of files and one of labels.

    A row names a recording by its full path, by the end of it, or by a path with more leading
    folders. The suffix may be left out, and case is ignored. A file without a header, whose first
    line names a .csv, has files and labels in this order. A column of files that has another name
    is found by the names of recordings in it. A recording may have several rows of one label;
    of rows with different paths that match it, only the one with its full path counts, or else the
    longest path. A row that matches several recordings labels only one whose full path it gives;
    for the others `find` raises UnreadableError.

    Parameters
    ----------
    path : path
    names : sequence of str
        Names of all recordings. A row of the file that names none of them is a fault of the source.
    options : LoadOptions
        `label` and `part` are columns of the file. If `label` is None, the columns whose names are
        those of labels (`LABEL_COLUMNS`) must not contradict each other.
    frame : DataFrame, optional
        The rows of the file, by their lines, if it was read before.

    Raises
    ------
    DataError
        If the file cannot be read as one of labels.
    """
    source = Path(path).name
    rows, faults, column, header = _read_label_rows(path, options, names, frame)
    notes = Counter[str]()
    if any(len(row.lines) > 1 for row in rows):
        notes[f"{source} names recordings more than once: their labels must be equal"] = 1
    label_column = LabelColumn(column, options.words, notes)
    name_words = {name: _path_words(name) for name in names}
    matches = _matching_rows(rows, name_words)
    n_names = Counter(row for matching in matches.values() for row in matching)
    group_of = _measured_again(matches)
    for row in rows:
        if not n_names[row]:
            why = ", a number that a spreadsheet has shortened" * bool(
                SHORTENED.fullmatch(row.file)
            )
            message = f"Expected the name of a recording, found no file {row.file}{why}"
            faults.append(Fault(source, row.lines[0], message))

    def find(name: str) -> SourcedLabel:
        """Return the label and the part in the row that names a recording most exactly."""
        if name in group_of:
            wanted = f"a row of {source} for each of {listed(group_of[name])}"
            raise UnreadableError(f"Expected {wanted}, found one: it may be that of any of them")
        if not matches[name]:
            raise UnreadableError(f"Expected a row of {source} that names it, found none")
        path_words = name_words[name]
        row = max(matches[name], key=lambda row: (row.words == path_words, len(row.words)))
        where = row.place_in(source)
        if n_names[row] > 1 and row.words != path_words:
            message = f"Expected its folder in {where}, which names {n_names[row]} recordings"
            raise UnreadableError(message)
        return _label_of_row(row, label_column, where)

    notes.update(_leading_zeros_note(source, [row for row in rows if n_names[row]]))
    files = ", ".join(row.file for row in rows[:3]) or "no files"
    has_files = column_among(header, LISTS["file_columns"]) is not None
    do = "" if has_files else "call its columns file and label, and "
    do = f"{do}write the files as they are, as {listed(names[:1])}"
    advice = f"{source} names {files}: {do}"
    listing = LabelSource(
        find, advice, source, faults, notes=notes, trust=listing_to_trust(source, column)
    )
    if options.label is not None:
        return listing
    others = [
        replace(
            labels_in_file(path, names, replace(options, label=name), frame),
            place=f"column {name}",
        )
        for name in header
        if name != column and name.lower() in LABEL_COLUMNS
    ]
    return labels_that_agree(listing, others, listing.trust)


def _matching_rows(
    rows: Iterable[_LabelRow], name_words: Mapping[str, tuple[str, ...]]
) -> dict[str, list[_LabelRow]]:
    """Return the rows of a listing whose path agrees with each recording's, as far as both go, from
    the file on.
    """
    rows_by_file = defaultdict[str, list[_LabelRow]](list)
    for row in rows:
        rows_by_file[row.words[0]].append(row)

    def is_end(row: _LabelRow, path_words: tuple[str, ...]) -> bool:
        return all(a == b for a, b in zip(row.words, path_words, strict=False))

    return {
        name: [row for row in rows_by_file[path_words[0]] if is_end(row, path_words)]
        for name, path_words in name_words.items()
    }


def _measured_again(matches: Mapping[str, Sequence[_LabelRow]]) -> dict[str, list[str]]:
    """Return recordings that may be repeated measurements of one row of a listing.

    SN12, SN12.1 and SN12 (2) are repeats if only SN12 has a row: the row may be of any of them.
    Each name in such a group is a key; its value is the list of all names in the group.

    matches : the rows that match each recording.
    """
    group_of = dict[str, list[str]]()
    for name, rows in matches.items():
        match = AGAIN.fullmatch(name)
        first = match[1] + match[2] if match else ""
        if not rows and matches.get(first):
            group_of[name] = group_of.setdefault(first, [first])
            group_of[name].append(name)
    return group_of


def _leading_zeros_note(source: str, rows: Sequence[_LabelRow]) -> dict[str, int]:
    """Return a note, and how many times, on the rows of a file that leave leading zeros out.

    It is empty without such rows.
    """
    without = [
        row
        for row in rows
        if row.file.isdecimal() and row.file not in re.split(r"[\W_]+", row.words[0])
    ]
    if not without:
        return {}
    first = without[0]
    return {f"{source} names {first.file}, read as {first.words[0]}, without zeros": len(without)}


def _label_of_row(row: _LabelRow, column: LabelColumn, where: str) -> SourcedLabel:
    """Return the label that a row's words mean together, with the number of its part.

    Raises UnknownWordError, which says where it stands, for a word of unknown meaning, else
    UnlabelledError if no word is a label yet, or SeveralLabelsError if labels differ.
    """
    try:
        for word in row.labels:
            with suppress(UnlabelledError):
                column.label_of(word)
    except UnknownWordError as error:
        error.args = (f"{error} in {where}",)
        raise
    return column.find(row.labels, where)._replace(part=row.part, column=column.name)


def listing_to_trust(file: str, column: str) -> str:
    """Return what to do, for an error, if another source contradicts a file of labels."""
    return f"name the column to trust, label={column!r} of {file}, or leave it out (labels)"


def read_ordered_labels(
    path: str | os.PathLike[str], options: LoadOptions, keys: Mapping[str, Sequence[str]]
) -> tuple[list[str], str]:
    """Return the label words of a file that lists the traces of an array, in the traces' order.

    Its rows are numbered in that order, or name traces by one of the `keys`; those that it does not
    name get an empty word, unless the keys are numbers from 0 or 1. The name of the column of
    labels comes second. Raises DataError if the file cannot be read, or its rows are in
    an order that is not known.

    keys : texts of each trace, as serial numbers, by the names of their arrays.
    """
    rows, faults, column, _ = _read_label_rows(path, options)
    label_of_key = {row.file: row.labels[0] for row in rows if len(row.lines) == 1}
    for texts in keys.values():
        if len(texts) == len(rows) and set(texts) == set(label_of_key):
            return [label_of_key[text] for text in texts], column
        if label_of_key and set(label_of_key) < set(texts) and not {"0", "1"} & set(texts):
            return [label_of_key.get(text, "") for text in texts], column
    numbers = [int((re.findall(r"\d+", row.words[0]) or [-1])[-1]) for row in rows]
    in_order = numbers == list(range(numbers[0], numbers[0] + len(rows))) if numbers else False
    in_order = in_order and len(label_of_key) == len(rows)
    if faults or not in_order:
        texts = [row.file for row in rows[:9]]
        actual = faults[0] if faults else f"[{listed(texts)}]"
        wanted = f"a label of each trace in {path}, numbered in their order"
        do = f" or by an array of them ({listed(keys)})" if keys else ""
        raise DataError(f"Expected {wanted}{do}, got {actual}.")
    return [row.labels[0] for row in rows], column


def _read_label_rows(
    path: str | os.PathLike[str],
    options: LoadOptions,
    names: Sequence[str] = (),
    frame: "pd.DataFrame | None" = None,
) -> tuple[list[_LabelRow], list[Fault], str, list[str]]:
    """Return the rows of a file of labels, file by file, and the faults of its other lines.

    The name of the column of labels and those of all columns come last. `options` name the columns
    of labels and parts; `names`, those of recordings, help to find the column of files. Raises
    DataError if the file cannot be read, or a column cannot be found.
    """
    try:
        table = read_table(Path(path), replace(options, columns=()), as_text=True)
    except (OSError, UnreadableError) as error:
        raise DataError(f"Cannot read the labels in {path}: {error}.") from error
    frame = table.frame if frame is None else frame
    header = list(frame.columns)
    rows_by_line = zip(frame.index, frame.to_numpy().tolist(), strict=True)
    cells = {line: row for line, row in rows_by_line if any(row)}
    files = {_path_words(name)[0] for name in names}
    # No header, but the first row.
    if header[0].lower().endswith(SUFFIXES) or _path_words(header[0])[0] in files:
        cells = {1: header, **cells}
        header = ["file", "label", *header[2:]]
    columns = [list(dict.fromkeys(column)) for column in zip(*cells.values(), strict=True)]
    n_names = [sum(_path_words(cell)[0] in files for cell in column) for column in columns]
    with_names = {i: n for i, n in enumerate(n_names) if n}
    full_names = {
        i: _names_with(column, names) or _names_in_folders(column, names)
        for i, column in enumerate(columns)
        if not with_names
    }
    n_named = max(map(len, full_names.values()), default=0)
    place, texts, names_of_texts = _names_in_two_columns(
        cells, names if full_names else (), more_than=n_named
    )
    if texts:
        full_names = {place: names_of_texts}
        n_named = len(names_of_texts)
    with_names = with_names or {i: n_named for i, x in full_names.items() if len(x) == n_named > 0}
    if names and not with_names:
        _check_not_shortened(dict(zip(header, columns, strict=False)), path)
    with_labels = [
        i
        for i, column in enumerate(columns)
        if LabelColumn(header[i], options.words, Counter()).has_labels(column)
    ]
    most = min(MAX_LABEL_WORDS, len(cells) / 2)
    with_words = {i: column for i, column in enumerate(columns) if 2 <= len(column) <= most}
    of_file, of_label = _label_file_columns(
        header, path, with_names, with_labels, with_words, options, names
    )
    part = options.part
    if part != "part" and part not in header:
        wanted = f"a column {part} of parts' numbers in {path}"
        raise DataError(f"Expected {wanted}, got {', '.join(header)}.")
    rows: dict[tuple[str, ...], _LabelRow] = {}
    for line, values in cells.items():
        number = values[header.index(part)] if part in header else ""
        file = texts.get(line, values[of_file])
        words = _path_words(full_names.get(of_file, {}).get(file, file))
        row = rows.get(words, _LabelRow((), words, file, (), number or None))
        lines = (*row.lines, line)
        rows[words] = row._replace(lines=lines, labels=(*row.labels, values[of_label]))
    return list(rows.values()), table.faults, header[of_label], header


def _check_not_shortened(
    columns: Mapping[str, Sequence[str]], path: str | os.PathLike[str]
) -> None:
    """Raise DataError if a column of a file holds nothing but long numbers in short, 2,40311E+11.

    columns : the texts of each; none of them names a recording.
    """
    for name, column in columns.items():
        texts = list(filter(None, column))
        if texts and all(map(SHORTENED.fullmatch, texts)):
            actual = f"got {listed(texts[:3])}: a spreadsheet has shortened its numbers"
            do = "they name no recording; export the list anew, with this column as text"
            raise DataError(f"Expected whole numbers in column {name} of {path}, {actual}, {do}.")


def _path_words(path: str) -> tuple[str, ...]:
    """Return a path's file, then its folders from the nearest on, in lower case.

    Of suffixes only those of text files (`SUFFIXES`) and .npz are removed, so `part_3.7` stays.
    Backslashes of Windows are read as slashes; empty words and "." are left out.
    """
    words = normalized(path).lower().replace("\\", "/").split("/")
    words = [word for word in words if word not in ("", ".")] or [""]
    file = words.pop().removesuffix(PACKED)
    suffix = next((suffix for suffix in (*SUFFIXES, ".npz") if file.endswith(suffix)), "")
    return file.removesuffix(suffix), *reversed(words)


def _names_in_two_columns(
    cells: Mapping[int, Sequence[str]], names: Sequence[str], *, more_than: int
) -> tuple[int, dict[int, str], dict[str, str]]:
    """Find two columns of a listing that name files together, as serial number and run.

    The texts of the first column repeat, and more than half of them stand in names of files. It is
    joined with each other column, as `4700_1`; the two by which `_names_with` finds most files are
    taken. Returns the position of the first column, the joined text of each line, and the file of
    each such text; (0, {}, {}) if no two columns name more than `more_than` files.

    cells : the cells of each row, by its line. names : the files.
    """
    best: tuple[int, dict[int, str], dict[str, str]] = (0, {}, {})
    columns = list(zip(*cells.values(), strict=True))
    words_of_names = [_words_between(PurePosixPath(name).name) for name in names]
    for i, column in enumerate(columns):
        texts = set(column) - {""}
        n_in_names = sum(any(_words_between(t) in w for w in words_of_names) for t in texts)
        if len(texts) == len(column) or 2 * n_in_names <= len(texts):
            continue
        for j in range(len(columns)):
            pairs = {line: f"{row[i]}_{row[j]}" for line, row in cells.items()}
            name_of = _names_with(list(dict.fromkeys(pairs.values())), names) if j != i else {}
            if len(name_of) > max(more_than, len(best[2])):
                best = (i, pairs, name_of)
    return best


def _words_between(text: str) -> str:
    """Return the words of a text in lower case, between underscores: `_sn_4700_` for `SN-4700`.

    It is `_` for a text without words.
    """
    return re.sub(r"[\W_]+", "_", f"_{normalized(text).lower()}_")


def _names_with(texts: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Return for texts, for example serial numbers, the one file in whose name each stands.

    It must stand there as one or more whole words, in upper or lower case; folders do not count.
    If it stands in none, but in one without leading zeros, which Excel removes, it is this one. A
    text that stands in no name, or in several, is left out. The result is empty if the texts stand
    in no more than half as many files as there are texts.
    """
    name_of = {}
    words_of_name = {name: _words_between(PurePosixPath(name).name) for name in names}
    bare_words = {name: LEADING_ZEROS.sub("", words) for name, words in words_of_name.items()}
    for text in texts:
        wanted = _words_between(text)
        if wanted == "_":  # it has no words
            continue
        matches = [name for name, words in words_of_name.items() if wanted in words]
        if not matches and FILE_SUFFIX.search(text):  # of another file, as a bag
            wanted = _words_between(FILE_SUFFIX.sub("", text.replace("\\", "/").rpartition("/")[2]))
            matches = [name for name, words in words_of_name.items() if wanted in words]
        bare = [] if matches else [n for n, w in bare_words.items() if wanted in w]
        if len(bare) == 1:
            matches = bare
        if len(matches) == 1:
            name_of[text] = matches[0]
    return name_of if 2 * len(set(name_of.values())) > len(texts) else {}


def _names_in_folders(texts: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Return for texts that name a folder, by the end of its path, the one recording inside it.

    The result is empty if a text names folders of several, or most name none.
    """
    inside = defaultdict[tuple[str, ...], list[str]](list)
    for name in names:
        for folder in PurePosixPath(name).parents:
            inside[_path_words(str(folder))].append(name)
    name_of = dict[str, str]()
    for text in filter(None, texts):
        wanted = _path_words(text)
        matches = [
            name
            for words, held in inside.items()
            if words != ("",) and all(a == b for a, b in zip(wanted, words, strict=False))
            for name in held
        ]
        if len(matches) > 1:
            return {}
        for name in matches:
            name_of[text] = name
    return name_of if 2 * len(name_of) > len(texts) else {}


def _label_file_columns(
    header: Sequence[str],
    path: str | os.PathLike[str],
    with_names: Mapping[int, int],
    with_labels: Sequence[int],
    with_words: Mapping[int, Sequence[str]],
    options: LoadOptions,
    names: Sequence[str],
) -> tuple[int, int]:
    """Return the positions of the column of files and of the column of labels.

    They are found by their names; the first else by `_columns_of_files`. Of two columns, the one
    that is not of files has the labels; if both have other names, files come first. Of more
    columns, the only one whose name means the bad outcome has the labels, else the only one of
    `with_labels`, or of `with_words`. Raises DataError if one is not found.

    with_names : how many recordings are named in each column in which some are.
    with_labels : the columns of labels alone.
    with_words : the words of those that have few, whose meaning may be asked for.
    options : `label` and `part` are the columns of labels and of parts, if the user stated them.
    names : of the recordings, for the error.
    """
    column = options.label
    of_label = column_among(header, LABEL_COLUMNS if column is None else (column.lower(),))
    if column is not None and of_label is None:
        wanted = f"a column {column} of labels in {path}"
        raise DataError(f"Expected {wanted}, got {', '.join(header)}; leave it out (label).")
    of_files = _columns_of_files(header, with_names, with_labels, options.part)
    of_file = of_files[0] if len(of_files) == 1 else None
    if len(header) == 2:
        if of_file is None:
            of_file = 0 if of_label is None else 1 - of_label
        of_label = 1 - of_file
    bad_columns = [i for i, column in enumerate(header) if i != of_file and means_bad(column)]
    for likely in (bad_columns, with_labels, with_words):
        others = [i for i in likely if i != of_file]
        if of_label is None and len(others) == 1:
            of_label = others[0]
    if of_file is not None and of_label is not None:
        return of_file, of_label
    hints = []
    if of_file is None:
        choice = " or ".join(f"part={header[i]!r}" for i in of_files)
        in_file = f"write their names into a column file, as {listed(names[:2])}"
        hints.append(f"name that of recordings, {choice}" if of_files else in_file)
    if of_label is None:
        labels_in = {header[i]: words for i, words in with_words.items() if i not in of_files}
        do = f", {propose_columns(labels_in)}" if labels_in else " (label)"
        hints.append(f"name that of labels{do}")
    wanted = f"a column that names recordings and one of labels in {path}"
    raise DataError(f"Expected {wanted}, got {', '.join(header)}; {', and '.join(hints)}.")


def _columns_of_files(
    header: Sequence[str], with_names: Mapping[int, int], with_labels: Sequence[int], part: str
) -> list[int]:
    """Return the positions of the columns that may name recordings: one, or several alike, or none.

    It is the one called so, if recordings are named in it or in no column; else that in which most
    are named. If these are several, or none, it is the column of parts.

    with_names, with_labels : as in `_label_file_columns`.
    """
    # A column `insertion` of success and failure has labels.
    of_labels_alone = {*with_labels} - {*with_names}
    candidates = ["" if i in of_labels_alone else name for i, name in enumerate(header)]
    of_file = column_among(candidates, LISTS["file_columns"])
    if of_file is not None and (of_file in with_names or not with_names):
        return [of_file]
    most = [i for i, n in with_names.items() if n == max(with_names.values())]
    return [header.index(part)] if len(most) != 1 and part in header else most
