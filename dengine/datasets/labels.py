"""What a recording's label is: in its file's name, in a file of labels, or in a table's column.

Words, in any case: true ok pass passed good success successful yes io gut 1; false nok ng fail failed bad failure no nio
schlecht 0; and a word of the first kind after a not, as in `run_7_not_ok.csv`.
"""

import os
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from ..errors import DataError, instead
from .dataset import Collected, Fault, Recorded, UnknownWordError, UnreadableError, must
from .text import SUFFIXES, Timed, read_table

GOOD = ("true", "ok", "pass", "passed", "good", "success", "successful", "yes", "io", "gut", "1")
BAD = ("false", "nok", "ng", "fail", "failed", "bad", "failure", "no", "nio", "schlecht", "0")
COPY = re.compile(r"([ _-]+(copy|kopie))?( ?\(\d+\))?$", re.IGNORECASE)  # what a file manager adds to a name
LAST = re.compile(r"(?:^|[_\- ])([^\d_\- ]\D*)$")  # words without a number, at the end of a name
NOT = r"((?:not|non|no|nicht)[_\-. ]*)?"
WORD = re.compile(f"{NOT}({'|'.join(GOOD + BAD)})", re.IGNORECASE)
IN_NAME = re.compile(rf"(?:^|[_\-. ]){WORD.pattern}$", re.IGNORECASE)
GERMAN = ("ergebnis", "bewertung", "urteil")
LABEL_COLUMNS = ("y", "label", "labels", "success", "result", "verdict", "class", "status", "ok", "outcome", *GERMAN)
FILE_COLUMNS = ("file", "filename", "file_name", "name", "path", "recording", "source", "insertion", "datei", "dateiname")

Words = Mapping[str, bool]
NONE: Words = {}
Known = tuple[int, str | None]  # a recording's label, and its part's number


class Labels(NamedTuple):
    """Where the labels of recordings come from.

    find : of a recording's name, its path as seen from the folder; UnreadableError where it has none.
    advice : what to do where most have none.  faults : of the file that lists them.
    """

    find: Callable[[str], Known]
    advice: str
    faults: Sequence[Fault] = ()


def label_of(word: Any, words: Words = NONE) -> int:
    """1 or 0; words : of one's own, in lower case, and whether they are good. UnknownWordError for what is no label."""
    text = str(word).strip().lower()
    if text in words:
        return int(words[text])
    found = WORD.fullmatch(text.removesuffix(".0"))
    if found is None:
        raise UnknownWordError(str(word).strip())
    return int((found[2] in GOOD) != bool(found[1]))


def meanings(told: Mapping[str, Any] | str | None) -> dict[str, bool]:
    """`"i.O.=good,n.i.O.=bad"`, or a dict of words and labels: each word, in lower case, and whether it is good."""
    pairs = told.items() if isinstance(told, Mapping) else [pair.rpartition("=")[::2] for pair in (told or "").split(",")]
    words = {str(word).strip().lower(): str(label).strip().lower() for word, label in pairs if told}
    for word, label in words.items():
        must(bool(word) and WORD.fullmatch(label) is not None, "word=good or word=bad, with commas between", told)
    return {word: bool(label_of(label)) for word, label in words.items()}


def named(pattern: str | None = None, words: Words = NONE) -> Labels:
    """A label in the name: at the end of the file's, or as its folder's; or what a pattern's group finds in the path.

    words : as of `label_of`.
    DataError for a pattern that is no regular expression with one group.
    """
    with instead(DataError, f"Expected a regular expression for the label, got {pattern!r}", re.error):
        expression = None if pattern is None else re.compile(pattern)
    must(expression is None or expression.groups == 1, "one group in the label's pattern, as in '_(OK|NOK)_'", pattern)

    def find(name: str) -> Known:
        if expression is None:
            return _usual(PurePosixPath(name), words), None
        match = expression.search(name)
        if match is None or match[1] is None:
            raise UnreadableError(f"Expected a label where the pattern {pattern} finds it, found none")
        return label_of(match[1], words), None

    return Labels(find, "give the pattern of it in the path (label='_(OK|NOK)'), or a file of labels")


def _usual(path: PurePosixPath, words: Words) -> int:
    """What the name ends with, or a folder that it is in is called: in good/1.csv, and in 1/x_OK.csv, the 1 is a number."""
    ends = [name.lower() for name in (path.stem, *path.parent.parts)]
    for word in sorted(words, key=len, reverse=True):
        if any(re.search(rf"(?:^|[_\- ]){re.escape(word)}$", end) for end in ends):
            return int(words[word])
    found = IN_NAME.search(COPY.sub("", path.stem))
    folder = next((name for name in reversed(path.parent.parts) if WORD.fullmatch(name) and not name.isdecimal()), "")
    by_name = None if found is None else label_of(found[0].lstrip("_-. "))
    by_folder = label_of(folder) if folder else None
    if by_folder is not None and (found is None or found[2].isdecimal()):
        return by_folder
    if by_name is None:
        what = "Expected a label at the end of the name, as in 0001_True.csv or 0001_NOK.csv, found none"
        said = map(LAST.search, (COPY.sub("", path.stem), *reversed(path.parent.parts)))
        last = next(filter(None, said), None)
        raise UnreadableError(what) if last is None else UnknownWordError(last[1], what)
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


def listed(path: str | os.PathLike[str], part: str, names: Sequence[str], words: Words = NONE) -> Labels:
    """A labels file: CSV with a column of files and one of labels. DataError where it cannot be read as one.

    A recording is listed by its path, its end, or longer by a folder; without suffix, in any case.
    part : the column of parts' numbers.  names : of all recordings.  words : as of `label_of`.
    A file without a header, which names a .csv in its first line, has files, labels in this order. A column of files that
    is called otherwise is known by the recordings' names in it.
    """
    source, (rows, faults) = Path(path).name, _rows(path, part, names)
    ends = defaultdict[str, list[_Row]](list)  # by the file's name alone
    for row in rows:
        ends[row.words[0]].append(row)
    alike = {
        name: [row for row in ends[_words(name)[0]] if all(a == b for a, b in zip(row.words, _words(name), strict=False))]
        for name in names
    }
    times = Counter(row for each in alike.values() for row in each)
    lost = [row for row in rows if not times[row]]
    faults += [Fault(source, row.line, f"Expected the name of a recording, found no file {row.file}") for row in lost]

    def find(name: str) -> Known:
        if not alike[name]:
            raise UnreadableError(f"Expected a row of {source} that names it, found none")
        row = max(alike[name], key=lambda row: (row.words == _words(name), len(row.words)))
        if times[row] > 1 and row.words != _words(name):
            raise UnreadableError(f"Expected its folder in {source}, line {row.line}, which names {times[row]} recordings")
        try:
            return label_of(row.label, words), row.part
        except UnknownWordError as error:
            error.args = (f"{error} in {source}, line {row.line}",)
            raise

    few = ", ".join(row.file for row in rows[:3]) or "no files"
    return Labels(find, f"{source} names {few}: call its columns file and label, and the files as they are", faults)


def in_order(path: str | os.PathLike[str], part: str) -> list[str]:
    """The words of a file of labels, of an array's traces in turn; DataError where its rows are numbered otherwise."""
    rows, faults = _rows(path, part)
    numbers = [int(row.file) for row in rows if row.file.isdecimal()]
    if faults or (numbers and numbers != list(range(numbers[0], numbers[0] + len(rows)))):
        got = faults[0] if faults else numbers[:9]
        raise DataError(f"Expected a label of each trace in {path}, in their order, got {got}.")
    return [row.label for row in rows]


def _rows(path: str | os.PathLike[str], part: str, names: Sequence[str] = ()) -> tuple[list[_Row], list[Fault]]:
    try:
        table, faults, *_ = read_table(Path(path))
    except (OSError, UnreadableError) as error:
        raise DataError(f"Cannot read the labels in {path}: {error}.") from error
    header, cells = list(table.columns), dict(zip(table.index, table.to_numpy().tolist(), strict=True))
    if header[0].lower().endswith(SUFFIXES):
        header, cells = ["file", "label", *header[2:]], {1: header, **cells}
    ends = {_words(name)[0] for name in names}
    named = [i for i in range(len(header)) if any(_words(row[i])[0] in ends for row in cells.values())]
    of_file, of_label = _columns(header, path, named)
    if part != "part" and part not in header:
        raise DataError(f"Expected a column {part} of parts' numbers in {path}, got {', '.join(header)}.")
    rows: dict[tuple[str, ...], _Row] = {}
    for line, said in cells.items():
        number = said[header.index(part)] if part in header else ""
        row = _Row(line, _words(said[of_file]), said[of_file], said[of_label], number or None)
        if rows.setdefault(row.words, row) is not row:
            faults.append(Fault(Path(path).name, line, f"Expected each file once, {row.file} came before"))
    return list(rows.values()), faults


def _words(path: str) -> tuple[str, ...]:
    """A path's file and folders, from its end, in lower case, without suffix, as Windows or another system writes it."""
    words = [word for word in path.lower().replace("\\", "/").split("/") if word not in ("", ".")] or [""]
    file = words.pop()
    return next((file.removesuffix(end) for end in SUFFIXES if file.endswith(end)), file), *reversed(words)


def column_among(header: Sequence[str], known: Sequence[str]) -> int | None:
    """Where the first of some known names stands in a header, in any case; None where none does."""
    lower = [name.lower() for name in header]
    return next((lower.index(name) for name in known if name in lower), None)


def _columns(header: Sequence[str], path: str | os.PathLike[str], named: Sequence[int]) -> tuple[int, int]:
    """Where files and labels are; of two columns the first and the second, or the other.  named : those with recordings."""
    of_file, of_label = column_among(header, FILE_COLUMNS), column_among(header, LABEL_COLUMNS)
    of_file = named[0] if of_file is None and len(named) == 1 else of_file
    if len(header) == 2:
        of_file = of_file if of_file is not None else 0 if of_label is None else 1 - of_label
        of_label = 1 - of_file
    if of_file is None or of_label is None:
        wanted = FILE_COLUMNS[0] if of_file is None else "label"
        raise DataError(f"Expected a column {wanted} in {path}, got {', '.join(header)}; call it so.")
    return of_file, of_label


def collect(places: Mapping[str, Any], read: Callable[[Any], Timed], labels: Labels, found: Collected) -> Collected:
    """Add recordings by name, with their labels. read : what is at a place: (C, T), and a rate where it has timestamps."""
    unlabelled: list[str] = []
    found.faults.extend(labels.faults)

    def recorded(name: str, place: Any) -> Recorded:
        try:
            label, part = labels.find(name)
        except UnreadableError as error:
            unlabelled.extend([] if isinstance(error, UnknownWordError) else [name])
            raise
        timed = read(place)
        return Recorded(timed.trace, label, name, part, timed.rate_hz, timed.units)

    for name, place in places.items():
        found.take(name, partial(recorded, name, place))
    if len(unlabelled) > len(places) / 2:
        none = f"{len(unlabelled)} of {len(places)} have none, {unlabelled[-1]} for one"
        raise DataError(f"Expected a label for each recording, {none}; {labels.advice}.")
    return found
