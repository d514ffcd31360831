"""Where a recording's label and part number stand: in its path, in its columns, in a line above the
header, or in a listing, which is a file with a row for each recording or part.
"""

import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from ...errors import DataError, instead, listed, shortened
from ..dataset import Fault
from ..description import LabelSource, PartSource, TextForm
from ..table import Table, UnreadableError
from .files import natural_key, read_file
from .frames import read_parquet
from .text import read_text, to_utf8

DELIMITERS = (",", ";", "\t", "|")
SUFFIX = re.compile(r"\.[A-Za-z]\w{0,7}(\.gz)?$")  # of a file
MARKS = " \t;,:=\"'"  # around the words of a line


def without_suffix(path: str) -> str:
    """Return a path without the suffix of its file, and without `.gz` behind it."""
    return SUFFIX.sub("", path)


def path_word(path: str, pattern: str) -> str:
    """Return the group of a regular expression in a path without the file's suffix.

    Raises UnreadableError if it is not found, DataError if it is no expression with one group.
    """
    wanted = f"Expected a regular expression with one group, got {pattern}"
    with instead(DataError, wanted, re.error):
        expression = re.compile(pattern)
    if expression.groups != 1:
        raise DataError(f"{wanted}.")
    match = expression.search(without_suffix(path))
    if match is None or match[1] is None:
        raise UnreadableError(f"Expected {pattern} in the path, it is not found")
    return str(match[1])


def line_word(lines: Sequence[str], beginning: str) -> str:
    """Return the cell behind the beginning of the first line above the header that has it.

    Raises UnreadableError if no line begins so.
    """
    for line in lines:
        text = line.lstrip(f"#%*{MARKS}")
        if text.startswith(beginning):
            return re.split(r"[;\t,]", text[len(beginning) :].strip(MARKS))[0].strip(MARKS)
    raise UnreadableError(f"Expected a line above the header that begins with {beginning}")


def words_of(
    source: PartSource | LabelSource, table: Table, columns: Sequence[str], at: str = "same"
) -> list[str]:
    """Return the words of a source of parts or labels, of which these are the columns.

    A path or a line has one word, and without these there is one for each column. Raises
    UnreadableError if one is not there, and DataError for a path that is no expression with one
    group.
    """
    if source.path:
        return [path_word(table.path, source.path)]
    if source.line:
        return [line_word(table.above, source.line)]
    return [table.one_word(column, at) for column in columns]


def part_of(source: PartSource, table: Table) -> str:
    """Return the number of the part, of several columns with blanks between; "" if none is stated.

    Raises UnreadableError if the recording does not have what is stated.
    """
    words = words_of(source, table, source.column)
    if not all(words):
        raise UnreadableError("Expected a part's number, got an empty one")
    return " ".join(words)


def listing_table(path: Path, form: TextForm) -> Table:
    """Return the table of a listing, a .parquet file or a text, whose cells are words.

    A text is parted by the one of `, ; tab |` that its header has most of. Raises UnreadableError,
    or for a .parquet file DataError, if it cannot be read or a row has another number of cells.
    """
    content = read_file(path)
    if path.suffix == ".parquet":
        return read_parquet(content, path.name)
    header = to_utf8(content, form.encoding).decode().partition("\n")[0]
    plain = TextForm(form.encoding, max(DELIMITERS, key=header.count))
    return read_text(content, path.name, plain).whole()


@contextmanager
def in_listing(name: str) -> Iterator[None]:
    """Context manager that raises DataError, with its name, for a listing that cannot be read."""
    try:
        yield
    except UnreadableError as error:
        fault = Fault(f"the listing {name}", error.line, str(error).rstrip("."))
        raise DataError(f"Cannot use {fault}.") from error


@dataclass(frozen=True, slots=True)
class LabelReader:
    """Finds the label of a recording in one source.

    listing : the words of each key of its listing, if it has one. used : keys that were asked for.
    """

    source: LabelSource
    listing: defaultdict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    used: set[str] = field(default_factory=set)

    def words(self, table: Table, part: str) -> Sequence[str]:
        """Return the words that stand for the label of a recording, like "ok".

        If the source is a listing, a file that lists the labels of all recordings, they are the
        words of all rows with the key of the recording. The key is the first of these that is
        listed: the number of the part, the path, the file name, the path without suffix, the file
        name without suffix. It is added to `used`. Any other source gives one word.

        Raises
        ------
        UnreadableError
            If there are no words for the recording.
        DataError
            If `source.path` is no regular expression with one group.
        """
        source = self.source
        path = table.path
        if not source.listing:
            return words_of(source, table, [source.column or source.topic], source.at)
        name = PurePosixPath(path).name
        names = filter(None, (part, path, name, without_suffix(path), without_suffix(name)))
        keys = [key for key in map(as_key, names) if key in self.listing]
        if not keys:
            raise UnreadableError(f"Expected {part or name} in {source.listing}, it is not listed")
        self.used.add(keys[0])
        return self.listing[keys[0]]

    def label(self, table: Table, part: str) -> int | None:
        """Return 1 for good, 0 for bad, None for not checked; adds to `used` as `words` does.

        Raises UnreadableError if there is no label, several, or a word of unknown meaning.
        """
        source = self.source
        words = self.words(table, part)
        line = 0 if source.listing or source.path else table.line(0)
        labels = {self.meaning(word, line) for word in words}
        if len(labels) > 1:
            message = f"Expected one label for {part or table.path}, got {listed(sorted(words))}"
            raise UnreadableError(message, line, source.column)
        return labels.pop()

    def meaning(self, word: str, line: int = 0) -> int | None:
        """Return what a word means; raise UnreadableError for an unknown one."""
        source = self.source
        meanings: dict[str, int | None] = dict.fromkeys(source.unchecked)
        meanings |= dict.fromkeys(source.bad, 0) | dict.fromkeys(source.good, 1)
        if word not in meanings:
            message = f"Expected a label among {listed(meanings)}, got {shortened(word)}"
            raise UnreadableError(message, line, source.column)
        return meanings[word]

    def unused_note(self) -> str:
        """Return a note on the rows of the listing that name no recording; "" if all do."""
        unused = sorted(self.listing.keys() - self.used, key=natural_key)
        n = f"{len(unused)} of {len(self.listing)} rows of {self.source.listing}"
        return f"{n} name no recording: {listed(unused)}." if unused else ""


def as_key(word: str) -> str:
    """Return the key in a listing: whole numbers match by their value, and paths in any writing."""
    return word.lstrip("0") or "0" if word.isdecimal() else word.replace("\\", "/")


def read_labels(base: Path, source: LabelSource, form: TextForm) -> LabelReader:
    """Return the reader of a source of labels; its listing stands in the folder `base`.

    The listing is read here. Raises DataError if it cannot be read or lacks its two columns, or
    these are not stated.
    """
    reader = LabelReader(source)
    if source.listing:
        columns = (source.key, source.column)
        if not all(columns):
            raise DataError("Expected label.key and label.column, two columns of label.listing.")
        with in_listing(source.listing):
            table = listing_table(base / source.listing, form)
            for key, word in zip(*map(table.words, columns), strict=True):
                reader.listing[as_key(key)].append(word)
    return reader
