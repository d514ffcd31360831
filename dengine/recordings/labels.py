"""What a recording's label is: in its file's name, in a file of labels, or in a table's column.

Words, in any case: true ok pass passed good success successful yes io 1; false nok ng fail failed bad failure no nio 0; and
a word of the first kind after a not, as in `run_7_not_ok.csv`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from ..errors import DataError
from .dataset import Fault, UnreadableError
from .text import read_lines, split_line

GOOD = ("true", "ok", "pass", "passed", "good", "success", "successful", "yes", "io", "1")
BAD = ("false", "nok", "ng", "fail", "failed", "bad", "failure", "no", "nio", "0")
NOT = r"((?:not|non|no|nicht)[_\-. ]*)?"
WORD = re.compile(f"{NOT}({'|'.join(GOOD + BAD)})", re.IGNORECASE)
IN_NAME = re.compile(rf"(?:^|[_\-. ]){WORD.pattern}$", re.IGNORECASE)
LABEL_COLUMNS = ("y", "label", "labels", "success", "result", "verdict", "class", "status", "ok", "outcome")
FILE_COLUMNS = ("file", "filename", "file_name", "name", "path", "recording", "source")


def label_of(word: Any) -> int:
    """1 or 0; UnreadableError for a word that is neither."""
    text = str(word).strip().lower().removesuffix(".0")
    found = WORD.fullmatch(text)
    if found is None:
        raise UnreadableError(f"Expected a label, as True/False, OK/NOK, pass/fail or 1/0, got {str(word)[:20]!r}")
    return int((found[2] in GOOD) != bool(found[1]))


@dataclass(frozen=True)
class Named:
    """A label in the name: at the end of the file's, or as its folder's; or what a pattern's group finds in the path."""

    pattern: re.Pattern[str] | None = None

    def label(self, name: str) -> tuple[int, str | None]:
        """Of the file with this path, seen from the folder; and its part's number, which a name does not tell."""
        if self.pattern is None:
            return _usual(PurePosixPath(name)), None
        match = self.pattern.search(name)
        if match is None or match[1] is None:
            raise UnreadableError(f"Expected a label where the pattern {self.pattern.pattern} finds it, found none")
        return label_of(match[1]), None


def _usual(path: PurePosixPath) -> int:
    """What the name ends with, or its folder is called: in good/1.csv the 1 is a number, and in 1/x_OK.csv the 1 is too."""
    found, folder = IN_NAME.search(path.stem), path.parent.name
    by_name = None if found is None else label_of(found[0].lstrip("_-. "))
    by_folder = label_of(folder) if WORD.fullmatch(folder) and not folder.isdecimal() else None
    if by_folder is not None and (found is None or found[2].isdecimal()):
        return by_folder
    if by_name is None:
        raise UnreadableError("Expected a label at the end of the name, as in 0001_True.csv or 0001_NOK.csv, found none")
    if by_folder not in (None, by_name):
        raise UnreadableError(f"Expected one label, its name and its folder {folder} contradict each other")
    return by_name


def named(pattern: str | None) -> Named:
    """DataError for a pattern that is no regular expression with one group."""
    if pattern is None:
        return Named()
    try:
        compiled = re.compile(pattern)
    except re.error as error:
        raise DataError(f"Expected a regular expression for the label, got {pattern!r}: {error}.") from error
    if compiled.groups != 1:
        raise DataError(f"Expected one group in the label's pattern, as in '_(OK|NOK)_', got {pattern!r}.")
    return Named(compiled)


@dataclass
class Listed:
    """Labels, and parts' numbers, from a file: a row a recording."""

    source: str
    rows: Mapping[str, tuple[int, str, str | None]]  # file -> line, word, part
    seen: set[str] = field(default_factory=set)

    def label(self, name: str) -> tuple[int, str | None]:
        """Of the file with this path, listed by its path, its name or its name without suffix."""
        path = PurePosixPath(name)
        key = next((key for key in (name, path.name, path.stem) if key in self.rows), None)
        if key is None:
            raise UnreadableError(f"Expected a row of {self.source} that names it, found none")
        self.seen.add(key)
        line, word, part = self.rows[key]
        try:
            return label_of(word), part
        except UnreadableError as error:
            raise UnreadableError(f"{error.what} in {self.source}, line {line}") from error

    def unused(self) -> list[Fault]:
        """Rows that name no recording."""
        lost = [(line, key) for key, (line, _, _) in self.rows.items() if key not in self.seen]
        return [Fault(self.source, line, f"Expected the name of a recording, found no file {key}") for line, key in lost]


def listed(path: str | os.PathLike[str], part: str) -> tuple[Listed, list[Fault]]:
    """A labels file: CSV with a column of files and one of labels. DataError where it cannot be read as one."""
    source = Path(path).name
    try:
        header, lines, delimiter = read_lines(Path(path))
    except (OSError, UnreadableError) as error:
        raise DataError(f"Cannot read the labels in {path}: {error}.") from error
    of_file, of_label = _column(header, FILE_COLUMNS, 0, path), _column(header, LABEL_COLUMNS, 1, path)
    of_part = header.index(part) if part in header else None
    rows: dict[str, tuple[int, str, str | None]] = {}
    faults = []
    for number, line in lines:
        words = split_line(line, delimiter)
        if len(words) != len(header):
            faults.append(Fault(source, number, f"Expected {len(header)} columns, got {len(words)}"))
        elif words[of_file] in rows:
            faults.append(Fault(source, number, f"Expected each file once, {words[of_file]} came before"))
        else:
            rows[words[of_file]] = number, words[of_label], None if of_part is None else words[of_part] or None
    return Listed(source, rows), faults


def _column(header: Sequence[str], known: Sequence[str], otherwise: int, path: str | os.PathLike[str]) -> int:
    lower = [name.lower() for name in header]
    for name in known:
        if name in lower:
            return lower.index(name)
    if len(header) == 2:
        return otherwise
    raise DataError(f"Expected a column {known[0]} in {path}, got {', '.join(header)}; call it so.")
