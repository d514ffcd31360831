"""Where a recording's label and part number stand: its path, its columns, a line, or a listing."""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from ...errors import DataError, instead, listed, shortened
from ..description import ANY, LabelSource, PartSource, TextForm
from ..table import Table, UnreadableError
from .files import natural_key, read_file
from .frames import join, read_objects, read_parquet
from .text import header_names, read_text, split_line, to_utf8

DELIMITERS = (",", ";", "\t", "|")
SUFFIX = re.compile(r"\.[A-Za-z]\w{0,7}(\.gz)?$")
MARKS = " \t;,:=\"'"  # around the words of a line
Row = Mapping[str, str]


def without_suffix(path: str) -> str:
    """Return a path without the suffix of its file, and without `.gz` behind it."""
    return SUFFIX.sub("", path)


@dataclass(frozen=True, slots=True)
class Place:
    """Where a recording stands: its path as seen from the folder, or its column, and its table."""

    path: str
    table: Table

    def group(self, pattern: str) -> str:
        """Return the group of a regular expression in the path without the file's suffix.

        Raises UnreadableError if it is not found, DataError if it is no expression with one group.
        """
        with instead(DataError, f"Expected a regular expression, got {pattern}", re.error):
            expression = re.compile(pattern)
        if expression.groups != 1:
            raise DataError(f"Expected one group in {pattern}, got {expression.groups}.")
        match = expression.search(without_suffix(self.path))
        if match is None or match[1] is None:
            raise UnreadableError(f"Expected {pattern} in the path, it is not found")
        return str(match[1])

    def line_word(self, beginning: str) -> str:
        """Return the cell behind the beginning of a line above the header.

        Raises UnreadableError if no line begins so.
        """
        for line in self.table.above:
            text = line.lstrip(f"#%*{MARKS}")
            if text.startswith(beginning):
                return re.split(r"[;\t,]", text[len(beginning) :].strip(MARKS))[0].strip(MARKS)
        raise UnreadableError(f"Expected a line above the header that begins with {beginning}")


def part_of(source: PartSource, place: Place) -> str:
    """Return the number of the part; "" if none is stated.

    Raises UnreadableError if the recording does not state it.
    """
    if source.path:
        words = [place.group(source.path)]
    elif source.line:
        words = [place.line_word(source.line)]
    else:
        words = [place.table.one_word(column) for column in source.column]
    if not all(words):
        column = source.column[words.index("")] if source.column else ""
        raise UnreadableError("Expected a part's number, got an empty one", column=column)
    return " ".join(words)


@dataclass(frozen=True, slots=True)
class Listing:
    """A file that lists recordings or parts.

    rows : for each key its rows, by column. numbers : the keys that are whole numbers, by value.
    """

    name: str
    rows: Mapping[str, Sequence[Row]]
    numbers: Mapping[int, Sequence[str]]

    def key_of(self, place: Place, part: str) -> str:
        """Return the key of a recording; raise UnreadableError if there is none.

        It is the part's number, the path, the file's name, or one of these without a suffix. Whole
        numbers match by their value.
        """
        path = PurePosixPath(place.path)
        stem = without_suffix(path.name)
        keys = [part, place.path, path.name, without_suffix(place.path), stem]
        number = part or stem
        same = self.numbers.get(int(number), ()) if number.isdecimal() else ()
        keys += same if len(same) == 1 else ()
        for key in keys:
            if key and key in self.rows:
                return key
        raise UnreadableError(f"Expected {part or path.name} in {self.name}, it is not listed")


def listing_table(path: Path, columns: Sequence[str], form: TextForm) -> Table:
    """Return the table of a listing, whose cells are words.

    A text is parted by the first of `, ; tab |` that parts its header into these columns. Raises
    UnreadableError if it cannot be read, or lacks a column.
    """
    content = read_file(path)
    suffix = path.suffix.lower()
    if suffix == ".parquet":
        return read_parquet(content, path.name)
    if suffix in (".json", ".jsonl"):
        return join(read_objects(content, path.name, form))
    header = to_utf8(content, form.encoding).decode().partition("\n")[0]
    heads = {mark: header_names(split_line(header, mark)) for mark in DELIMITERS}
    fitting = [mark for mark, head in heads.items() if {*columns} <= {*head}]
    mark = max(fitting or heads, key=lambda mark: len(heads[mark]))
    if not fitting:
        message = f"Expected columns {listed(columns)}, got {listed(heads[mark])}"
        raise UnreadableError(message, 1)
    plain = TextForm(form.encoding, mark)
    return read_text(content, path.name, plain, lambda _: False, lambda _: True)


def read_listing(
    base: Path, name: str, key: str, columns: Sequence[str], form: TextForm
) -> Listing:
    """Read some columns of a listing that stands in the folder `base`.

    Raises DataError if it cannot be read, or lacks a column.
    """
    columns = [*dict.fromkeys([key, *columns])]
    try:
        table = listing_table(base / name, columns, form)
        words = [table.words(column).tolist() for column in columns]
    except UnreadableError as error:
        line = f", line {error.line}" if error.line else ""
        raise DataError(f"{error}, in the listing {name}{line}.") from error
    rows: dict[str, list[Row]] = defaultdict(list)
    for cells in zip(*words, strict=True):
        rows[cells[0].replace("\\", "/")].append(dict(zip(columns, cells, strict=True)))
    numbers: dict[int, list[str]] = defaultdict(list)
    for word in filter(str.isdecimal, rows):
        numbers[int(word)].append(word)
    return Listing(name, rows, numbers)


@dataclass(frozen=True, slots=True)
class LabelReader:
    """Finds the label of a recording in one source.

    listing : that of the source, if it has one. used : its keys that were asked for.
    """

    source: LabelSource
    listing: Listing | None = None
    used: set[str] = field(default_factory=set)

    def words(self, place: Place, part: str) -> Sequence[str]:
        """Return the words for a recording; raise UnreadableError if there is none."""
        source = self.source
        if self.listing is not None:
            key = self.listing.key_of(place, part)
            self.used.add(key)
            return [row[source.column] for row in self.listing.rows[key]]
        if source.path:
            return [place.group(source.path)]
        if source.line:
            return [place.line_word(source.line)]
        return [place.table.one_word(source.column or source.topic, source.at)]

    def label(self, place: Place, part: str) -> int | None:
        """Return 1 for good, 0 for bad, None for not checked.

        Raises UnreadableError if there is no label, several, or a word of unknown meaning.
        """
        source = self.source
        words = self.words(place, part)
        line = 0 if self.listing or source.path else place.table.line(0)
        meanings = {self.meaning(text, line) for text in words}
        if len(meanings) > 1:
            message = f"Expected one label for {part or place.path}, got {listed(sorted(words))}"
            raise UnreadableError(message, line, source.column)
        return meanings.pop()

    def meaning(self, word: str, line: int = 0) -> int | None:
        """Return what a word means; raise UnreadableError for an unknown one."""
        source = self.source
        for mark in (word, ANY):
            for label, words in ((1, source.good), (0, source.bad), (None, source.unchecked)):
                if mark in words:
                    return label
        known = f"{listed(source.good)} (good), {listed(source.bad)} (bad)"
        message = f"Expected a label among {known}, got {shortened(word)}"
        raise UnreadableError(message, line, source.column)

    def unused_note(self) -> str:
        """Return a note on the rows of the listing that name no recording; "" if all do."""
        keys = self.listing.rows if self.listing else ()
        unused = sorted({*keys} - self.used, key=natural_key)
        if self.listing is None or not unused:
            return ""
        n = f"{len(unused)} of {len(keys)}"
        return f"{n} rows of {self.listing.name} name no recording: {listed(unused)}."


def read_labels(base: Path, source: LabelSource, form: TextForm) -> LabelReader:
    """Return the reader of a source of labels; its listing stands in the folder `base`.

    Raises DataError if the listing cannot be read.
    """
    if not source.listing:
        return LabelReader(source)
    if not source.key or not source.column:
        raise DataError("Expected label.key and label.column, two columns of label.listing.")
    columns = [source.column]
    return LabelReader(source, read_listing(base, source.listing, source.key, columns, form))
