"""Where a recording's label and part number stand: in its path, in its columns, in a line above the
header, or in a listing, which is a file with a row for each recording or part.
"""

import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from operator import eq
from pathlib import Path

from ...errors import DataError, listed, shortened
from ..dataset import Fault
from ..description import Description, LabelSource, PartSource, Strings, TextForm
from ..table import Table, UnreadableError
from .files import natural_key, read_file
from .frames import read_parquet
from .text import read_text, to_utf8_or_latin

ListingReader = Callable[[str], Table]  # returns the table of the listing of a name
DELIMITERS = ",;\t|"
MARKS = " \t;,:：=\"'"  # around the words of a line


def stem_of(description: Description, path: str) -> str:
    """Return a path without its suffix, and without the words in it that are labels or checks.

    Of each match of a regular expression for labels, `source.path`, the text of its group is
    removed.
    """
    path = without_suffix(path)
    for source in description.labels:
        if source.path:
            for match in reversed([*re.finditer(source.path, path)]):
                # Both are -1 if the group has no match: the path stays.
                path = path[: match.start(1)] + path[match.end(1) :]
    return path


def without_suffix(path: str) -> str:
    """Return a path without the suffix of its file, and without `.gz` behind it.

    A suffix is a point, a letter, and up to seven more letters, digits or `_`; so `run_0.5` has
    none.
    """
    return re.sub(r"\.[A-Za-z]\w{0,7}(\.gz)?$", "", path)


def path_word(path: str, pattern: str) -> str:
    """Return what the group of a regular expression matches in a path without the file's suffix.

    The first match in the path counts. Raises UnreadableError if `pattern` or its group does not
    match.
    """
    match = re.search(pattern, without_suffix(path))
    if match is None or match[1] is None:
        raise UnreadableError(f"Expected {pattern} in the path, it is not found")
    return match[1]


def line_word(lines: Strings, beginning: str) -> str:
    """Return the word behind `beginning` in a line that begins with it, "" if nothing is there.

    If several lines begin with it, those are used in which it fills the whole first cell; if there
    are none of these, all. Comment marks, quotes and delimiters before `beginning` are skipped. So
    are blanks, tabs, quotes and `; , : =` behind it; then the word is the rest of the line, or what
    stands before a comma with a blank behind it, without such marks at its end. Raises
    UnreadableError if no line begins with the text, or if the words of several differ.

    lines : the lines above the header of a file.
    """
    words: set[str] = set()
    for end in ("(?=[\"' ]*([;:：=\t,]|  |$))", ""):
        pattern = (
            f"(?m)^[#%*{MARKS}]*{re.escape(beginning)}{end}[{MARKS}]*(?P<word>([^,\n]|,(?! ))*)"
        )
        found = re.finditer(pattern, "\n".join(lines))
        words = words or {match["word"].rstrip(MARKS) for match in found}
    if len(words) != 1:
        raise UnreadableError(
            f"Expected one word behind {beginning} in the lines above the header, got "
            f"{listed(words) or 'no such line'}"
        )
    return words.pop()


def words_of(
    source: PartSource | LabelSource, table: Table, columns: Strings, at: str = "same"
) -> list[str]:
    """Return the words that a source of labels or of part numbers has for a recording.

    A word is a text like "ok" or a part number, and `source` says where it stands. If it states a
    regular expression for the path of the file, or the beginning of a line above the header, that
    gives one word. Otherwise each of `columns` of the recording's table gives one, "" for an empty
    cell: that of all rows if `at` is "same", or of the "first" or "last" row. Raises
    UnreadableError if a column, the line or a match in the path is missing, if a column has lists
    or no rows, if the words of the rows differ and `at` is "same", or if several lines with this
    beginning have different words.
    """
    if source.path:
        return [path_word(table.path, source.path)]
    if source.line:
        return [line_word(table.above, source.line)]
    return [table.one_word(column, at) for column in columns]


def part_of(source: PartSource, table: Table) -> str:
    """Return the part number of a recording; "" if `source` states nothing.

    `source` says where the number stands: in columns of the recording's table, in the path of its
    file or in a line above the header. The words of several columns are joined by blanks. Raises
    UnreadableError if a stated column, line or match in the path is missing or its word is empty,
    if the words of the recording's rows, or of several lines with the stated beginning, differ, or
    if a column has lists or no rows.
    """
    words = words_of(source, table, source.column)
    if not all(words):
        raise UnreadableError("Expected a part's number, got an empty one")
    return " ".join(words)


def listing_table(path: Path, form: TextForm) -> Table:
    """Return the table of a listing, which is a Parquet file or a text file.

    A listing has a row for each recording or part, for example with its label. It is a Parquet file
    if its name ends in `.parquet`; a text whose name ends in `.gz` is unpacked. The first line of a
    text has the names of the columns; the delimiter is the first of `, ; tab |` that is most
    frequent in it. Cells of a text stay texts. Of `form` only the encoding is used; a text that is
    not in it is read as cp1252. Raises UnreadableError if the file cannot be read, if a text has a
    zero byte, an empty first line or nothing below it, or if a row of a text has another number of
    cells; DataError for a damaged Parquet file or without pyarrow; and LookupError for an encoding
    that Python does not know. A Parquet file may have no rows.
    """
    content = read_file(path)
    if path.suffix.lower() == ".parquet":
        return read_parquet(content, path.name)
    _, text = to_utf8_or_latin(content, form.encoding)
    header = text.decode().partition("\n")[0]
    plain = TextForm(delimiter=max(DELIMITERS, key=header.count))
    return read_text(text, path.name, plain).whole()


@contextmanager
def in_listing(name: str) -> Iterator[None]:
    """Context manager that raises DataError in place of an UnreadableError in its block.

    The message names the listing (a file with a row for each recording or part), `name`, and the
    line.
    """
    try:
        yield
    except UnreadableError as error:
        fault = Fault(f"the listing {name}", error.line, str(error).rstrip("."))
        raise DataError(f"Cannot use {fault}.") from error


@dataclass(frozen=True, slots=True)
class LabelReader:
    """Finds the label of a recording in one source.

    source : where the label stands. listing : by key (`as_key`) the different words, each with the
    line of its first row, 0 if unknown; empty if the source is no listing. files : its keys by the
    file name in them, as `folders_of` writes it. used : the keys that were found, each with the
    path of the first recording that has it.
    """

    source: LabelSource
    listing: Mapping[str, Mapping[str, int]]
    files: Mapping[str, list[str]]
    used: dict[str, str] = field(default_factory=dict)

    def word(self, table: Table, part: str) -> str:
        """Return the word that stands for the label of a recording, like "ok".

        `table` is the table of the recording, and `part` its part number. If the source is no
        listing (a file with a row for each recording or part), `words_of` says where the word
        stands. In a listing it is the word of all rows with the key of the recording (`key_of`),
        which is added to `used`. A word is "" if its cell is empty.

        Raises
        ------
        UnreadableError
            If the column, line, match in the path, or key is missing, or a column has lists or no
            rows. If the words differ in several such lines, in rows of the listing with the key or,
            if `source.at` is "same", in the recording's rows. If the key is not the part's number,
            and was found for another path before.
        """
        source = self.source
        path = table.path
        if not source.listing:
            return words_of(source, table, [source.column or source.topic], source.at)[0]
        key = self.key_of(path, part)
        if self.used.setdefault(key, path) != path and key != as_key(part):
            raise UnreadableError(
                f"Expected one file for {key} in {source.listing}, got {self.used[key]} before"
            )
        words = sorted(self.listing[key])
        if len(words) > 1:
            raise UnreadableError(
                f"Expected one label for {part or path} in {source.listing}, got {listed(words)}"
            )
        return words[0]

    def key_of(self, path: str, part: str) -> str:
        """Return the key of a recording in the listing, by its path and the number of its part.

        The key is the first of these that is listed: the number of the part, the path, the file
        name, the path without suffix, the file name without suffix; they are compared as `as_key`
        writes them, so 0012 is 12. If none is listed, the key is the only listed one with the same
        file name and, as far as both have them, the same folders (`folders_of`), like
        `D:/Data/P7.tdms` for `P007.csv`. Raises UnreadableError if there is none, or several.
        """
        name = path.rpartition("/")[2]
        names = filter(None, (part, path, name, without_suffix(path), without_suffix(name)))
        for key in map(as_key, names):
            if key in self.listing:
                return key
        folders = folders_of(path)
        alike = [
            key for key in self.files.get(folders[0], ()) if all(map(eq, folders, folders_of(key)))
        ]
        if len(alike) == 1:  # of several none is certain
            return alike[0]
        raise UnreadableError(
            f"Expected {part or name} in {self.source.listing}, it is not listed; it has "
            f"{listed(sorted(self.listing)[:2])}; if its name contains the key, state part.path"
        )

    def label(self, table: Table, part: str) -> int | None:
        """Return the label of a recording: 1 good, 0 bad, None not checked.

        `table` is the table of the recording, and `part` its part number. If the source is a
        listing (a file with a row for each recording or part), the key of the recording that was
        found in it is added to `used`, the keys found so far, also if an error follows. The word
        that stands for the label is compared exactly with the words that `source` states for each
        meaning; if a word is stated for several, good comes before bad, and bad before not checked.
        Raises what `word` raises, and UnreadableError if the word, which may be empty, has no
        stated meaning.
        """
        source = self.source
        word = self.word(table, part)
        if word not in source.meanings:
            message = f"Expected a label among {listed(source.meanings)}, got {shortened(word)}"
            if source.listing:
                line = self.listing[self.key_of(table.path, part)][word]
                raise UnreadableError(f"{message} in {source.listing}, line {line}")
            line = 0 if source.path or source.line else table.line(-(source.at == "last"))
            raise UnreadableError(message, line, source.column)
        return source.meanings[word]

    def unused_note(self) -> str:
        """Return a sentence on rows of the listing that name no recording, "" if there is none.

        A listing is a file with a row for each recording or part. These are the rows whose key is
        not in `used`, the keys that were looked up, also if their recording failed before its label
        was looked up. The sentence has up to eight keys, and counts keys: rows with the same key
        count once.
        """
        unused = sorted(self.listing.keys() - self.used.keys(), key=natural_key)
        if not unused:
            return ""
        return (
            f"{len(unused)} of {len(self.listing)} rows of {self.source.listing} name no recording "
            f"that was read: {listed(unused)}."
        )


def as_key(word: str) -> str:
    """Return a word as a key of a listing, so that keys are equal if they mean the same.

    A whole number loses its leading zeros, and a `.0` at its end; letters become small, and a
    backslash becomes `/`. An `=` in front and quotes around the word are left out, so `="0012"`,
    like Excel writes a text, becomes `12`.
    """
    word = word.removeprefix("=").strip('"').replace("\\", "/").lower()
    return re.sub(r"^0*(\d+)(\.0+)?$", r"\1", word)


def folders_of(path: str) -> list[str]:
    """Return the file name of a path, then its folders from the inside out, to compare paths.

    The suffix of the file and a `./` in front are left out, letters become small, and each run of
    digits loses its leading zeros, so `./Data/P007.csv` gives `p7` and `data`. Decimals lose them,
    too: 0.05 becomes 0.5.
    """
    plain = re.sub(r"(?<![\d.])0+(?=\d)", "", as_key(without_suffix(path)))
    return plain.removeprefix("./").split("/")[::-1]


def read_labels(source: LabelSource, read_listing: ListingReader) -> LabelReader:
    """Return the reader of a source of labels, after reading its listing, if it has one.

    The source says where the labels stand, and a listing is a file with a row for each recording or
    part. `read_listing` is called with its name (see `listing_table`). Raises DataError if it
    cannot be read, or if `source.key` and `source.column`, the columns in it that name the
    recording or part and have the label, are not both stated and there, and LookupError for an
    encoding that Python does not know.
    """
    listing = defaultdict[str, dict[str, int]](dict)
    if source.listing:
        columns = (source.key, source.column)
        if not all(columns):
            raise DataError("Expected label.key and label.column, two columns of label.listing.")
        with in_listing(source.listing):
            table = read_listing(source.listing)
            for row, (key, word) in enumerate(zip(*map(table.words, columns), strict=True)):
                listing[as_key(key)].setdefault(word, table.line(row))
    files = defaultdict[str, list[str]](list)
    for key in listing:
        files[folders_of(key)[0]].append(key)
    return LabelReader(source, listing, files)
