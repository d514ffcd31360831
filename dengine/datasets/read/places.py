"""Where a recording's label and part number stand: its path, its columns, a line, or a listing."""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from ...errors import DataError, listed, shortened
from ..description import ANY, LabelSource, PartSource, TextForm
from ..table import Table, UnreadableError
from .files import natural_key, read_file
from .frames import join, read_objects, read_parquet
from .text import header_names, read_text, split_line, to_utf8

DELIMITERS = (",", ";", "\t", "|")
SUFFIX = re.compile(r"\.[A-Za-z]\w{0,7}(\.gz)?$")
MARKS = " \t;,:=\"'"  # around the words of a line


@dataclass(frozen=True, slots=True)
class Place:
    """Where a recording stands: its path as seen from the folder, or its column, and its table."""

    path: str
    table: Table

    def group(self, pattern: str) -> str:
        """Return the group of a regular expression in the path without the file's suffix.

        Raises UnreadableError if it is not found, DataError if it is no expression with one group.
        """
        try:
            expression = re.compile(pattern)
        except re.error as error:
            raise DataError(f"Expected a regular expression, got {pattern}: {error}.") from error
        if expression.groups != 1:
            raise DataError(f"Expected one group in {pattern}, got {expression.groups}.")
        match = expression.search(SUFFIX.sub("", self.path))
        if match is None:
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
        return place.group(source.path)
    if source.line:
        return place.line_word(source.line)
    words = [place.table.one_word(column) for column in source.column]
    if not all(words):
        raise UnreadableError(
            "Expected a part's number, got an empty cell", column=source.column[0]
        )
    return " ".join(words)


@dataclass(frozen=True, slots=True)
class Listing:
    """A file that lists recordings or parts: the words of one column, by those of another.

    words : for each key those of its rows. used : the keys that were asked for.
    """

    name: str
    words: Mapping[str, Sequence[str]]
    used: set[str] = field(default_factory=set)

    def find(self, place: Place, part: str) -> Sequence[str]:
        """Return the words for a recording.

        Its key is the part's number, the path, the file's name, or one of these without a suffix.
        Whole numbers match by their value. Raises UnreadableError if there is none.
        """
        path = PurePosixPath(place.path)
        stem = SUFFIX.sub("", path.name)
        keys = [part, place.path, path.name, SUFFIX.sub("", place.path), stem]
        number = part or stem
        if number.isdecimal():
            same = [key for key in self.words if key.isdecimal() and int(key) == int(number)]
            keys += same if len(same) == 1 else []
        key = next((key for key in keys if key and key in self.words), None)
        if key is None:
            raise UnreadableError(f"Expected {part or path.name} in {self.name}, it is not listed")
        self.used.add(key)
        return self.words[key]


def listing_table(path: Path, columns: Sequence[str], form: TextForm) -> Table:
    """Return the table of a listing, whose cells are words.

    A text is parted by the first of `, ; tab |` that parts its header into these columns. Raises
    UnreadableError if it cannot be read, or lacks a column.
    """
    content = read_file(path)
    if path.suffix.lower() == ".parquet":
        return read_parquet(content, path.name)
    if path.suffix.lower() in (".json", ".jsonl"):
        return join(read_objects(content, path.name, form))
    header = to_utf8(content, form.encoding).decode().partition("\n")[0]
    heads = {mark: header_names(split_line(header, mark)) for mark in DELIMITERS}
    fitting = [mark for mark, head in heads.items() if {*columns} <= {*head}]
    if not fitting:
        found = max(heads.values(), key=len)
        raise UnreadableError(f"Expected columns {listed(columns)}, got {listed(found)}", 1)
    plain = TextForm(form.encoding, max(fitting, key=lambda mark: len(heads[mark])))
    return read_text(content, path.name, plain, lambda _: False, lambda _: True)


def read_listing(path: Path, key: str, column: str, form: TextForm) -> Listing:
    """Return the listing in a file; raise DataError if it cannot be read, or lacks a column."""
    try:
        table = listing_table(path, (key, column), form)
        pairs = list(zip(table.words(key), table.words(column), strict=True))
    except UnreadableError as error:
        line = f", line {error.line}" if error.line else ""
        raise DataError(f"{error}, in the listing {path.name}{line}.") from error
    words = defaultdict(list)
    for name, word in pairs:
        words[name.replace("\\", "/")].append(str(word))
    return Listing(path.name, words)


@dataclass(frozen=True, slots=True)
class LabelReader:
    """Finds the label of a recording in one source.

    listing : that of the source, if it has one.
    """

    source: LabelSource
    listing: Listing | None = None

    def words(self, place: Place, part: str) -> Sequence[str]:
        """Return the words for a recording; raise UnreadableError if there is none."""
        if self.listing is not None:
            return self.listing.find(place, part)
        if self.source.path:
            return [place.group(self.source.path)]
        if self.source.line:
            return [place.line_word(self.source.line)]
        column = self.source.column or self.source.topic
        return [place.table.one_word(column, self.source.at)]

    def label(self, place: Place, part: str) -> int | None:
        """Return 1 for good, 0 for bad, None for not checked.

        Raises UnreadableError if there is no label, several, or a word of unknown meaning.
        """
        words = self.words(place, part)
        meanings = {self.meaning(text) for text in words}
        if len(meanings) > 1:
            message = f"Expected one label for {part or place.path}, got {listed(sorted(words))}"
            raise UnreadableError(message, column=self.source.column)
        return meanings.pop()

    def meaning(self, word: str) -> int | None:
        """Return what a word means; raise UnreadableError for an unknown one."""
        source = self.source
        meanings = ((1, source.good), (0, source.bad), (None, source.unchecked))
        for mark in (word, ANY):
            for meaning, words in meanings:
                if mark in words:
                    return meaning
        known = f"{listed(source.good)} (good), {listed(source.bad)} (bad)"
        message = f"Expected a label among {known}, got {shortened(word)}"
        raise UnreadableError(message, column=source.column)

    def unused_note(self) -> str:
        """Return a note on the rows of the listing that name no recording; "" if all do."""
        listing = self.listing
        unused = sorted({*listing.words} - listing.used, key=natural_key) if listing else []
        if listing is None or not unused:
            return ""
        n = f"{len(unused)} of {len(listing.words)}"
        return f"{n} rows of {listing.name} name no recording: {listed(unused)}."


def read_labels(base: Path, source: LabelSource, form: TextForm) -> LabelReader:
    """Return the reader of a source of labels; its listing stands in the folder `base`.

    Raises DataError if the listing cannot be read.
    """
    if not source.listing:
        return LabelReader(source)
    if not source.key or not source.column:
        raise DataError("Expected label.key and label.column, two columns of label.listing.")
    listing = read_listing(base / source.listing, source.key, source.column, form)
    return LabelReader(source, listing)
