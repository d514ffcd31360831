"""How text files are written: their encoding, delimiter, header, units and marks in numbers.

Each value follows from a count over the lines that were looked at; where two fit, it is `?`.
"""

import codecs
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ..description import UNKNOWN
from ..read.text import BLANK, COMMENT, header_names, split_line
from ..units import is_unit
from .columns import NUMBER, Proposal, Stated

DELIMITERS = (";", "\t", "|", ",", BLANK)
BLANKS_LEAD = 1.15  # by which blanks must be the better delimiter, since cells may hold some
GROUPS = "'’\u202f\xa0 "  # marks between groups of digits that are no decimal mark
HEAD_BYTES = 400_000
MOST_LINES = 200  # of a file that are looked at
MOST_NAMES = 20  # columns without a header that get a name each
MOST_CLASSES = 12  # whole numbers in the first column of a matrix that are its classes
WHOLE = re.compile(r"-?\d+(\.0*)?(e\+00)?")
UNIT_WORDS = re.compile(
    r"(?i)[\[(]?(hh:mm(:ss)?|dd\.mm\.yyyy|[\d.]+ ?[mu]?s|s|ms|us|ns|min|h)[\])]?"
)
# Numbers in which a mark can only be the decimal one.
DECIMAL = {
    mark: re.compile(
        rf"[-+−]?([^.,]*{m}(\d{{0,2}}|\d{{4,}})|0?{m}\d+|\d{{4,}}{m}\d*|.*[^\d{m}]\d{{3}}{m}\d*)"
        r"([eE].*)?"
    )
    for mark, m in ((".", r"\."), (",", ","))
}
Rows = Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class Look:
    """The first lines of a file.

    width : cells of a row. places : the lines of the header, the units and the first samples, from
    1; 0 for none. header : that line. names : in it. rows : the cells of the samples.
    """

    encoding: str
    delimiter: str
    width: int
    places: tuple[int, int, int]
    header: str
    names: Sequence[str]
    rows: Rows

    @property
    def form(self) -> tuple[str, int]:
        """The delimiter and the number of columns, by which files are alike."""
        return self.delimiter, self.width


def look(content: bytes, stated: Stated) -> Look | None:
    """Return how a file is written, by its first lines; None if it is no text."""
    encoding, text = decode(content, stated.get("text.encoding", ""))
    lines = text.splitlines()[:MOST_LINES]
    if "\0" in text or not text.strip():
        return None
    marks = [stated["text.delimiter"]] if "text.delimiter" in stated else DELIMITERS
    share, width, delimiter = max((*_share_of_numbers(lines, mark), mark) for mark in marks)
    if share == 0:  # a single column
        delimiter, width = ",", 1
    rows = [split_line(line, delimiter) if line.strip() else [] for line in lines]
    data = _first_row(rows, width)
    heads = [i for i in range(data) if len(rows[i]) >= width and any(map(str.strip, rows[i]))]
    units = heads.pop() + 1 if len(heads) > 1 and _are_units(rows[heads[-1]]) else 0
    header = lines[heads[-1]] if heads else ""
    names = header_names(split_line(COMMENT.sub("", header.lstrip()), delimiter))
    places = (heads[-1] + 1 if heads else 0, units, data + 1)
    return Look(encoding, delimiter, width, places, header, names, rows[data:])


def decode(content: bytes, stated: str) -> tuple[str, str]:
    """Return the encoding of a text and its first part, "" if it is none.

    The encoding is what is stated, else UTF-16 by the mark at its beginning, UTF-8 or cp1252.
    """
    is_wide = content[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    encodings = ["utf-16"] if is_wide else ["utf-8", "cp1252"]
    for encoding in [stated] if stated else encodings:
        with suppress(UnicodeDecodeError):
            text = codecs.getincrementaldecoder(encoding)().decode(content[:HEAD_BYTES])
            return encoding, text.removeprefix("\ufeff")
    return "", ""


def _share_of_numbers(lines: Sequence[str], delimiter: str) -> tuple[float, int]:
    """Return how well a delimiter parts lines into rows of numbers, and the cells of a row.

    The share is that of the lines with the usual number of cells, times that of numbers in their
    cells; a single cell scores 0. The first third of the lines may be a preamble.
    """
    rows = [split_line(line, delimiter) for line in lines[len(lines) // 3 :] if line.strip()]
    width = Counter(map(len, rows)).most_common(1)[0][0] if rows else 0
    same = [row for row in rows if len(row) == width]
    cells = [cell for row in same for cell in row if cell.strip()]
    if width < 2 or not cells:
        return 0.0, width
    share = _count_numbers(cells) / len(cells) * len(same) / len(rows) + 0.01
    return round(share / (BLANKS_LEAD if delimiter == BLANK else 1), 2), width


def _count_numbers(cells: Sequence[str]) -> int:
    """Return how many cells are numbers."""
    return sum(1 for cell in cells if NUMBER.fullmatch(cell))


def _first_row(rows: Rows, width: int) -> int:
    """Return the first row of samples: as many numbers as usual, as have those behind it."""
    counts = [_count_numbers(row) if len(row) == width else 0 for row in rows]
    least = max(0.6 * float(np.median(counts[len(counts) // 3 :])), 1)
    return next((i for i in range(len(rows)) if min(counts[i : i + 4]) >= least), 0)


def _are_units(row: Sequence[str]) -> bool:
    """Return whether the cells of a row that are filled are units."""
    return all(is_unit(c) or UNIT_WORDS.fullmatch(c) for c in map(str.strip, row) if c)


def propose_form(p: Proposal, looks: Mapping[str, Look]) -> list[str]:
    """Find the keys of `[text]` for most of the files; return the files of another form.

    These have another delimiter, another number of columns, or no column in common with most.
    """
    form, _ = Counter(look.form for look in looks.values()).most_common(1)[0]
    alike = [look for look in looks.values() if look.form == form]
    places, _ = Counter(look.places for look in alike).most_common(1)[0]
    usual = next(look for look in alike if look.places == places)
    common = {*usual.names}
    same = [look for look in alike if not common or common & {*look.names}]
    encoding = min({look.encoding for look in same} - {"utf-8"}, default="utf-8")
    is_latin = encoding == "cp1252"
    note = "not UTF-8; cp1252 reads any text: look at the letters below" if is_latin else ""
    p.put("text.encoding", encoding, note)
    p.put("text.delimiter", usual.delimiter)
    header, units, data = usual.places
    names, text = _column_names(usual), "it stands at another line in each file"
    if header and any(look.places != places for look in same):
        first, mark, _ = usual.header.partition(usual.delimiter)
        p.put("text.header", first + mark, text)
        data, units = data - header, units and units - header
    else:
        p.put("text.header", header)
    p.put("text.units", units)
    p.put("text.data", data)
    p.put("text.names", names, "no header names each column" if names else "")
    cells = {cell.strip() for look in same for row in look.rows for cell in row}
    propose_marks(p, [*filter(NUMBER.fullmatch, cells)])
    return [name for name, look in looks.items() if look not in same]


def _column_names(usual: Look) -> list[str]:
    """Return names for the columns where the header does not give one for each; else none.

    In a matrix, whose rows are parts, a first column of few whole numbers is their class.
    """
    width = usual.width
    if usual.names:
        return [*usual.names[:width]] if len(usual.names) > width else []
    if width < MOST_NAMES:
        return [f"c{i}" for i in range(width)]
    firsts, seconds = ({row[i].strip() for row in usual.rows if len(row) > i} for i in (0, 1))
    is_class = 1 < len(firsts) <= min(MOST_CLASSES, len(seconds) - 1)
    return ["class", "x*"] if is_class and all(map(WHOLE.fullmatch, firsts)) else ["x*"]


def propose_marks(p: Proposal, cells: Collection[str]) -> None:
    """Find the decimal mark and that of groups, which numbers prove.

    A mark is a decimal one where other than three digits follow it, it follows a 0 or more than
    three digits, or stands behind the other mark: `0,004` and `1.043,5` prove a comma, `1.043`
    proves nothing. Where both fit, the decimal mark is `?`.
    """
    seen = {mark: [cell for cell in cells if mark in cell] for mark in ".,"}
    proofs = {mark: len([*filter(DECIMAL[mark].fullmatch, seen[mark])]) for mark in ".,"}
    text = "\n".join(cells)
    group = next((mark for mark in GROUPS if re.search(rf"\d{mark}\d{{3}}", text)), "")
    example = min(seen["."] + seen[","], default="")
    decimal, note = ".", ""
    if example:
        note = "both marks are used for decimals, in other files or columns"
        if not any(proofs.values()):
            note = f"'.' or ','; {example} may be a fraction or a thousand"
        decimal = UNKNOWN
    for mark, other in (".,", ",."):
        repeats = any(cell.count(other) > 1 for cell in seen[other])
        if proofs[mark] > 20 * proofs[other] or (repeats and not proofs[other]):
            decimal, note = mark, ""
            group = other if seen[other] else group
    p.put("text.decimal", decimal, note)
    p.put("text.thousands", group)
