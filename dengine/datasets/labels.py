"""What a recording's label is: in its file's name, in a file of labels, or in a table's column.

Words, in any case: true ok pass passed good success successful yes io 1; false nok ng fail failed bad failure no nio 0; and
a word of the first kind after a not, as in `run_7_not_ok.csv`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from .dataset import Fault, UnreadableError
from .lengths import Collected, Recorded
from .text import read_table

GOOD = ("true", "ok", "pass", "passed", "good", "success", "successful", "yes", "io", "1")
BAD = ("false", "nok", "ng", "fail", "failed", "bad", "failure", "no", "nio", "0")
COPY = re.compile(r"([ _-]+(copy|kopie))?( ?\(\d+\))?$", re.IGNORECASE)  # what a file manager adds to a name
NOT = r"((?:not|non|no|nicht)[_\-. ]*)?"
WORD = re.compile(f"{NOT}({'|'.join(GOOD + BAD)})", re.IGNORECASE)
IN_NAME = re.compile(rf"(?:^|[_\-. ]){WORD.pattern}$", re.IGNORECASE)
LABEL_COLUMNS = ("y", "label", "labels", "success", "result", "verdict", "class", "status", "ok", "outcome")
FILE_COLUMNS = ("file", "filename", "file_name", "name", "path", "recording", "source", "insertion")


def label_of(word: Any) -> int:
    """1 or 0; UnreadableError for a word that is neither."""
    text = str(word).strip().lower().removesuffix(".0")
    found = WORD.fullmatch(text)
    if found is None:
        raise UnreadableError(f"Expected a label, as True/False, OK/NOK, pass/fail or 1/0, got {str(word)[:20]!r}")
    return int((found[2] in GOOD) != bool(found[1]))


class Named:
    """A label in the name: at the end of the file's, or as its folder's; or what a pattern's group finds in the path.

    DataError for a pattern that is no regular expression with one group.
    """

    def __init__(self, pattern: str | None = None) -> None:
        try:
            self.pattern = None if pattern is None else re.compile(pattern)
        except re.error as error:
            raise DataError(f"Expected a regular expression for the label, got {pattern!r}: {error}.") from error
        if self.pattern is not None and self.pattern.groups != 1:
            raise DataError(f"Expected one group in the label's pattern, as in '_(OK|NOK)_', got {pattern!r}.")

    def label(self, name: str) -> tuple[int, str | None]:
        """Of the file with this path, seen from the folder; and its part's number, which a name does not tell."""
        if self.pattern is None:
            return _usual(PurePosixPath(name)), None
        match = self.pattern.search(name)
        if match is None or match[1] is None:
            raise UnreadableError(f"Expected a label where the pattern {self.pattern.pattern} finds it, found none")
        return label_of(match[1]), None

    def advice(self) -> str:
        return "give the pattern of it in the path (label='_(OK|NOK)'), or a file of labels"


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


class Listed:
    """Labels, and parts' numbers, from a file. rows : line, file, word and part of each.  names : of all recordings."""

    def __init__(self, source: str, rows: Iterable[tuple[int, str, str, str | None]], names: Sequence[str]) -> None:
        self.source, self.rows, self.used = source, list(rows), set[int]()
        self._rows: dict[str, list[tuple[int, str, str, str | None]]] = {}
        self._names: dict[str, list[str]] = {}
        for row in self.rows:
            self._rows.setdefault(_words(row[1])[-1], []).append(row)
        for name in names:
            self._names.setdefault(_words(name)[-1], []).append(name)

    def label(self, name: str) -> tuple[int, str | None]:
        """Of the file with this path, listed by its path, its end, or longer by a folder; without suffix, in any case."""
        rows = [row for row in self._rows.get(_words(name)[-1], ()) if _alike(row[1], name)]
        if not rows:
            raise UnreadableError(f"Expected a row of {self.source} that names it, found none")
        self.used.update(line for line, *_ in rows)
        line, file, word, part = max(rows, key=lambda row: (_words(row[1]) == _words(name), len(_words(row[1]))))
        others = [other for other in self._names[_words(name)[-1]] if other != name and _alike(file, other)]
        if others and _words(file) != _words(name):
            raise UnreadableError(f"Expected its folder in {self.source}, line {line}, which names {others[0]} too")
        try:
            return label_of(word), part
        except UnreadableError as error:
            raise UnreadableError(f"{error.what} in {self.source}, line {line}") from error

    def advice(self) -> str:
        files = ", ".join(file for _, file, *_ in self.rows[:3])
        return f"{self.source} names {files or 'no files'}: call its columns file and label, and the files as they are"


def _words(path: str) -> list[str]:
    """A path's folders and file, in lower case, without suffix, as Windows or another system writes it."""
    words = [word for word in path.lower().replace("\\", "/").split("/") if word not in ("", ".")] or [""]
    return [*words[:-1], words[-1].removesuffix(".csv")]


def _alike(one: str, other: str) -> bool:
    """Whether one of two paths is the end of the other."""
    pairs = zip(reversed(_words(one)), reversed(_words(other)), strict=False)
    return all(a == b for a, b in pairs)


def listed(path: str | os.PathLike[str], part: str, names: Sequence[str]) -> tuple[Listed, list[Fault]]:
    """A labels file: CSV with a column of files and one of labels. DataError where it cannot be read as one.

    names : of all recordings.  A file without a header, which names a .csv in its first line, has them in this order.
    """
    source = Path(path).name
    try:
        table = read_table(Path(path))
        cells = table.frame(as_text=True).to_numpy().tolist()
    except (OSError, UnreadableError) as error:
        raise DataError(f"Cannot read the labels in {path}: {error}.") from error
    header, lines = table.header, table.lines
    if header[0].lower().endswith(".csv"):
        cells, lines, header = [header, *cells], [1, *lines], ["file", "label", *header[2:]]
    of_file, of_label = _columns(header, path)
    if part != "part" and part not in header:
        raise DataError(f"Expected a column {part} of parts' numbers in {path}, got {', '.join(header)}.")
    of_part = header.index(part) if part in header else None
    rows: dict[str, tuple[int, str, str, str | None]] = {}
    for number, row in zip(lines, cells, strict=True):
        words = [str(word).strip() for word in row]
        key = "/".join(_words(words[of_file]))
        if key in rows:
            table.faults.append(Fault(source, number, f"Expected each file once, {words[of_file]} came before"))
        else:
            rows[key] = number, words[of_file], words[of_label], None if of_part is None else words[of_part] or None
    return Listed(source, rows.values(), names), table.faults


def _columns(header: Sequence[str], path: str | os.PathLike[str]) -> tuple[int, int]:
    """Where the files and where the labels are; of two columns, the first and the second, or the one that is left."""
    of_file, of_label = _place(header, FILE_COLUMNS), _place(header, LABEL_COLUMNS)
    if len(header) == 2:
        of_file = of_file if of_file is not None else 0 if of_label is None else 1 - of_label
        of_label = 1 - of_file
    if of_file is None or of_label is None:
        wanted = FILE_COLUMNS[0] if of_file is None else "label"
        raise DataError(f"Expected a column {wanted} in {path}, got {', '.join(header)}; call it so.")
    return of_file, of_label


def _place(header: Sequence[str], known: Sequence[str]) -> int | None:
    lower = [name.lower() for name in header]
    return next((lower.index(name) for name in known if name in lower), None)


class Labels(Protocol):
    """Where the labels of recordings come from."""

    def label(self, name: str) -> tuple[int, str | None]: ...  # and the part's number; UnreadableError where there is none

    def advice(self) -> str: ...  # what to do where most recordings have no label


def collect(read: Iterable[tuple[str, NDArray[np.float32] | None, float | None]], labels: Labels, found: Collected) -> None:
    """Add recordings with their labels: of each its name, (C, T) and rate; a trace of None is a fault already."""
    total = unlabelled = 0
    for name, trace, rate in read:
        total += 1
        try:
            label, part = labels.label(name)
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
            f"{labels.advice()}."
        )
    if isinstance(labels, Listed):
        lost = [(line, file) for line, file, *_ in labels.rows if line not in labels.used]
        said = "Expected the name of a recording, found no file"
        found.faults.extend(Fault(labels.source, line, f"{said} {file}") for line, file in lost)
