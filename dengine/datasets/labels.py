"""What a recording's label is: in its file's name, in a file of labels, or in a table's column.

Words, in any case: true ok pass passed good success successful yes io 1; false nok ng fail failed bad failure no nio 0; and
a word of the first kind after a not, as in `run_7_not_ok.csv`.
"""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from .dataset import Collected, Fault, Recorded, UnreadableError
from .text import read_table

GOOD = ("true", "ok", "pass", "passed", "good", "success", "successful", "yes", "io", "1")
BAD = ("false", "nok", "ng", "fail", "failed", "bad", "failure", "no", "nio", "0")
COPY = re.compile(r"([ _-]+(copy|kopie))?( ?\(\d+\))?$", re.IGNORECASE)  # what a file manager adds to a name
NOT = r"((?:not|non|no|nicht)[_\-. ]*)?"
WORD = re.compile(f"{NOT}({'|'.join(GOOD + BAD)})", re.IGNORECASE)
IN_NAME = re.compile(rf"(?:^|[_\-. ]){WORD.pattern}$", re.IGNORECASE)
LABEL_COLUMNS = ("y", "label", "labels", "success", "result", "verdict", "class", "status", "ok", "outcome")
FILE_COLUMNS = ("file", "filename", "file_name", "name", "path", "recording", "source", "insertion")

Known = tuple[int, str | None]  # a recording's label, and its part's number


class Labels(NamedTuple):
    """Where the labels of recordings come from.

    find : of a recording's name, its path as seen from the folder; UnreadableError where it has none.
    advice : what to do where most have none.  faults : of the file that lists them.
    """

    find: Callable[[str], Known]
    advice: str
    faults: Sequence[Fault] = ()


def label_of(word: Any) -> int:
    """1 or 0; UnreadableError for a word that is neither."""
    text = str(word).strip().lower().removesuffix(".0")
    found = WORD.fullmatch(text)
    if found is None:
        raise UnreadableError(f"Expected a label, as True/False, OK/NOK, pass/fail or 1/0, got {str(word)[:20]!r}")
    return int((found[2] in GOOD) != bool(found[1]))


def named(pattern: str | None = None) -> Labels:
    """A label in the name: at the end of the file's, or as its folder's; or what a pattern's group finds in the path.

    DataError for a pattern that is no regular expression with one group.
    """
    try:
        expression = None if pattern is None else re.compile(pattern)
    except re.error as error:
        raise DataError(f"Expected a regular expression for the label, got {pattern!r}: {error}.") from error
    if expression is not None and expression.groups != 1:
        raise DataError(f"Expected one group in the label's pattern, as in '_(OK|NOK)_', got {pattern!r}.")

    def find(name: str) -> Known:
        if expression is None:
            return _usual(PurePosixPath(name)), None
        match = expression.search(name)
        if match is None or match[1] is None:
            raise UnreadableError(f"Expected a label where the pattern {pattern} finds it, found none")
        return label_of(match[1]), None

    return Labels(find, "give the pattern of it in the path (label='_(OK|NOK)'), or a file of labels")


def _usual(path: PurePosixPath) -> int:
    """What the name ends with, or a folder that it is in is called: in good/1.csv, and in 1/x_OK.csv, the 1 is a number."""
    found = IN_NAME.search(COPY.sub("", path.stem))
    folder = next((name for name in reversed(path.parent.parts) if WORD.fullmatch(name) and not name.isdecimal()), "")
    by_name = None if found is None else label_of(found[0].lstrip("_-. "))
    by_folder = label_of(folder) if folder else None
    if by_folder is not None and (found is None or found[2].isdecimal()):
        return by_folder
    if by_name is None:
        raise UnreadableError("Expected a label at the end of the name, as in 0001_True.csv or 0001_NOK.csv, found none")
    if by_folder not in (None, by_name):
        raise UnreadableError(f"Expected one label, its name and its folder {folder} contradict each other")
    return by_name


class _Row(NamedTuple):
    """Of a file of labels. words : of the path that it names, see `_words`."""

    line: int
    words: tuple[str, ...]
    file: str
    label: str
    part: str | None


def listed(path: str | os.PathLike[str], part: str, names: Sequence[str]) -> Labels:
    """A labels file: CSV with a column of files and one of labels. DataError where it cannot be read as one.

    A recording is listed by its path, its end, or longer by a folder; without suffix, in any case.
    part : the column of parts' numbers.  names : of all recordings.
    A file without a header, which names a .csv in its first line, has files, labels in this order.
    """
    source = Path(path).name
    rows, faults = _rows(path, part)
    by_file, by_name = defaultdict[str, list[_Row]](list), defaultdict[str, list[str]](list)
    for row in rows:
        by_file[row.words[0]].append(row)
    for each in names:
        by_name[_words(each)[0]].append(each)

    def find(name: str) -> Known:
        words = _words(name)
        found = [row for row in by_file[words[0]] if _alike(row.words, words)]
        if not found:
            raise UnreadableError(f"Expected a row of {source} that names it, found none")
        row = max(found, key=lambda row: (row.words == words, len(row.words)))
        others = [other for other in by_name[words[0]] if other != name and _alike(row.words, _words(other))]
        if others and row.words != words:
            raise UnreadableError(f"Expected its folder in {source}, line {row.line}, which names {others[0]} too")
        try:
            return label_of(row.label), row.part
        except UnreadableError as error:
            raise UnreadableError(f"{error.what} in {source}, line {row.line}") from error

    lost = [row for row in rows if not any(_alike(row.words, _words(name)) for name in by_name[row.words[0]])]
    faults += [Fault(source, row.line, f"Expected the name of a recording, found no file {row.file}") for row in lost]
    few = ", ".join(row.file for row in rows[:3]) or "no files"
    return Labels(find, f"{source} names {few}: call its columns file and label, and the files as they are", faults)


def _words(path: str) -> tuple[str, ...]:
    """A path's file and folders, from its end, in lower case, without suffix, as Windows or another system writes it."""
    words = [word for word in path.lower().replace("\\", "/").split("/") if word not in ("", ".")] or [""]
    return words.pop().removesuffix(".csv"), *reversed(words)


def _alike(one: Sequence[str], other: Sequence[str]) -> bool:
    """Whether one of two paths, as `_words`, is the end of the other."""
    return all(a == b for a, b in zip(one, other, strict=False))


def _rows(path: str | os.PathLike[str], part: str) -> tuple[list[_Row], list[Fault]]:
    try:
        table = read_table(Path(path))
    except (OSError, UnreadableError) as error:
        raise DataError(f"Cannot read the labels in {path}: {error}.") from error
    header, cells, lines = table.header, table.rows, table.lines
    if header[0].lower().endswith(".csv"):
        cells, lines, header = [header, *cells], [1, *lines], ["file", "label", *header[2:]]
    of_file, of_label = _columns(header, path)
    if part != "part" and part not in header:
        raise DataError(f"Expected a column {part} of parts' numbers in {path}, got {', '.join(header)}.")
    rows: dict[tuple[str, ...], _Row] = {}
    for line, said in zip(lines, cells, strict=True):
        words = _words(said[of_file])
        if words in rows:
            what = f"Expected each file once, {said[of_file]} came before"
            table.faults.append(Fault(Path(path).name, line, what))
        else:
            number = said[header.index(part)] if part in header else ""
            rows[words] = _Row(line, words, said[of_file], said[of_label], number or None)
    return list(rows.values()), table.faults


def _columns(header: Sequence[str], path: str | os.PathLike[str]) -> tuple[int, int]:
    """Where the files and where the labels are; of two columns, the first and the second, or the one that is left."""
    lower = [name.lower() for name in header]
    of_file, of_label = (
        next((lower.index(name) for name in known if name in lower), None) for known in (FILE_COLUMNS, LABEL_COLUMNS)
    )
    if len(header) == 2:
        of_file = of_file if of_file is not None else 0 if of_label is None else 1 - of_label
        of_label = 1 - of_file
    if of_file is None or of_label is None:
        wanted = FILE_COLUMNS[0] if of_file is None else "label"
        raise DataError(f"Expected a column {wanted} in {path}, got {', '.join(header)}; call it so.")
    return of_file, of_label


def collect(read: Iterable[tuple[str, NDArray[np.float32] | None, float | None]], labels: Labels, found: Collected) -> None:
    """Add recordings with their labels: of each its name, (C, T) and rate; a trace of None is a fault already."""
    total = unlabelled = 0
    found.faults.extend(labels.faults)
    for name, trace, rate in read:
        total += 1
        try:
            label, part = labels.find(name)
        except UnreadableError as error:
            unlabelled += 1
            if trace is not None:  # one reason a file is enough
                found.faults.append(error.fault(name))
            continue
        if trace is not None:
            found.read.append(Recorded(trace, label, name, part, rate))
    if unlabelled > total / 2:
        raise DataError(
            f"Expected a label for each recording, {unlabelled} of {total} have none, {found.faults[-1].source} for one; "
            f"{labels.advice}."
        )
