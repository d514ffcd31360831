"""Where a recording's label and part number stand: its path, its columns, a line, or a listing."""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from ...errors import DataError, listed, shortened
from ..description import LabelSource, PartSource, TextForm
from ..table import ANY, Table, UnreadableError
from .files import read_file
from .frames import read_objects, read_parquet
from .text import header_names, read_text, split_line, to_utf8

DELIMITERS = (",", ";", "\t", "|")
SUFFIX = re.compile(r"\.[A-Za-z]\w{0,7}$")


@dataclass(frozen=True, slots=True)
class Place:
    """Where a recording stands: its path as seen from the folder, or its column, and its table."""

    path: str
    table: Table

    @property
    def stem(self) -> str:
        """The path without the file's suffixes."""
        return without_suffix(self.path)


def without_suffix(path: str) -> str:
    """Return a path without the suffix of its file, and without `.gz` behind it."""
    return SUFFIX.sub("", path.removesuffix(".gz"))


def part_of(source: PartSource, place: Place) -> str:
    """Return the number of the part; "" if none is stated.

    Raises UnreadableError if the recording does not state it.
    """
    if source.column:
        words = [place.table.one_word(column) for column in source.column]
        if not all(words):
            raise UnreadableError("Expected a part's number, got an empty cell", column=words[0])
        return " ".join(words)
    if source.path:
        return group_of(source.path, place.stem, "part.path")
    return line_word(source.line, place.table, "part.line") if source.line else ""


def group_of(pattern: str, path: str, where: str) -> str:
    """Return the group of a regular expression that is found in a path.

    Raises UnreadableError if it is not found, and DataError if it is no expression with one group.
    """
    try:
        expression = re.compile(pattern)
    except re.error as error:
        raise DataError(f"Expected a regular expression in {where}: {error}.") from error
    if expression.groups != 1:
        raise DataError(f"Expected one group in {where}, got {expression.groups}: {pattern}.")
    match = expression.search(path)
    if match is None:
        raise UnreadableError(f"Expected {where} {pattern} in the path, it is not found")
    return str(match[1])


def line_word(beginning: str, table: Table, where: str) -> str:
    """Return what stands in the line above the header that begins so.

    The rest of the line loses blanks, marks like `;`, `:` and `=`, and quotes around it. Raises
    UnreadableError if there is no such line.
    """
    for line in table.above:
        text = line.lstrip("#%* \t\"'")
        if text.startswith(beginning):
            rest = text[len(beginning) :].strip(" \t;,:=\"'")
            return re.split(r"[;\t,]", rest)[0].strip(" \"'")
    raise UnreadableError(f"Expected a line above the header that begins with {beginning}; {where}")


@dataclass(frozen=True, slots=True)
class Listing:
    """A file that lists recordings or parts, by the column that is the key.

    rows : mapping of str to list of dicts
        For each key its rows, by column.
    """

    name: str
    rows: Mapping[str, Sequence[Mapping[str, str]]]

    def find(self, place: Place, part: str) -> tuple[str, Sequence[Mapping[str, str]]]:
        """Return the key of a recording, and its rows.

        The key is the part's number, the path, the file's name, or one of these without a suffix.
        Whole numbers match by their value. Raises UnreadableError if there is none.
        """
        name = PurePosixPath(place.path).name
        keys = [part, place.path, name, place.stem, without_suffix(name)]
        for key in keys:
            if key and key in self.rows:
                return key, self.rows[key]
        number = part or without_suffix(name)
        if number.isdigit():
            same = [key for key in self.rows if key.isdigit() and int(key) == int(number)]
            if len(same) == 1:
                return same[0], self.rows[same[0]]
        raise UnreadableError(f"Expected {part or name} in {self.name}, it is not listed")


def read_listing(
    base: Path, name: str, key: str, columns: Sequence[str], form: TextForm
) -> Listing:
    """Read a listing beside the recordings.

    A text file is parted by the one of `, ; tab |` that parts its header into these columns.

    Raises
    ------
    DataError
        If it cannot be read, or lacks a column.
    """
    path = base / name
    content = read_file(path)
    suffix = path.suffix.lower()
    try:
        if suffix == ".parquet":
            table = read_parquet(content, name)
        elif suffix in (".json", ".jsonl"):
            table = joined(read_objects(content, name, form), name)
        else:
            delimiter = _delimiter_of(content, form, {key, *columns})
            plain = TextForm(form.encoding, delimiter)
            table = read_text(content, name, plain, lambda _: False, {key, *columns}.__contains__)
        cells = {column: table.words(column) for column in {key, *columns}}
    except UnreadableError as error:
        line = f", line {error.line}" if error.line else ""
        raise DataError(f"{error}, in the listing {name}{line}.") from error
    rows = defaultdict(list)
    for i, word in enumerate(cells[key]):
        rows[PurePosixPath(word.replace("\\", "/")).as_posix()].append(
            {column: str(values[i]) for column, values in cells.items()}
        )
    return Listing(name, rows)


def _delimiter_of(content: bytes, form: TextForm, columns: set[str]) -> str:
    """Return the delimiter that parts the header of a listing into columns; DataError if none."""
    header = to_utf8(content, form.encoding).decode().partition("\n")[0]
    found: list[str] = []
    for delimiter in DELIMITERS:
        found = max(found, header_names(split_line(header, delimiter)), key=len)
        if columns <= {*header_names(split_line(header, delimiter))}:
            return delimiter
    missing = sorted(columns - {*found})
    raise UnreadableError(f"Expected columns {listed(missing)}, got {listed(found)}", 1)


def joined(tables: Sequence[Table], source: str) -> Table:
    """Return one table of tables with a row each, in the columns of the first."""
    import numpy as np

    columns = {}
    for name in tables[0].columns if tables else ():
        cells = np.empty(len(tables), dtype=object)
        cells[:] = [table.columns[name][0] if name in table.columns else None for table in tables]
        columns[name] = cells
    return Table(source, columns, [table.line(0) for table in tables])


@dataclass(slots=True)
class LabelReader:
    """Finds the label of a recording in one source, and says which words of a listing were used."""

    source: LabelSource
    listing: Listing | None
    used: set[str]

    def label(self, place: Place, part: str, word: str | None = None) -> int | None:
        """Return 1 for good, 0 for bad, None for not checked.

        Raises UnreadableError if there is no label, several, or a word of unknown meaning.

        word : of a topic, if that is the source.
        """
        source = self.source
        words = {word} if word is not None else {*self.words(place, part)}
        meanings = {self._meaning(text) for text in words}
        if len(meanings) > 1:
            message = f"Expected one label for {part or place.path}, got {listed(sorted(words))}"
            raise UnreadableError(message, column=source.column)
        return meanings.pop()

    def words(self, place: Place, part: str) -> Sequence[str]:
        """Return the words for a recording."""
        source = self.source
        if self.listing is not None:
            key, rows = self.listing.find(place, part)
            self.used.add(key)
            return [row[source.column] for row in rows]
        if source.path:
            return [group_of(source.path, place.stem, "label.path")]
        if source.line:
            return [line_word(source.line, place.table, "label.line")]
        return [place.table.one_word(source.column, source.at)]

    def _meaning(self, word: str) -> int | None:
        """Return what a word means; raise UnreadableError for an unknown one."""
        source = self.source
        for meaning, words in ((1, source.good), (0, source.bad), (None, source.unchecked)):
            if word in words:
                return meaning
        for meaning, words in ((1, source.good), (0, source.bad), (None, source.unchecked)):
            if ANY in words:
                return meaning
        known = f"good {listed(source.good)}, bad {listed(source.bad)}"
        known += f", unchecked {listed(source.unchecked)}" if source.unchecked else ""
        message = f"Expected a label of the words {known}; got {shortened(word)}"
        raise UnreadableError(message, column=source.column)
