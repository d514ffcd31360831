"""How text files are written: their encoding, delimiter, header, units and marks in numbers.

Each value follows from a count over the lines that were looked at; where two fit, it is `?`.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ..description import UNKNOWN
from ..read.text import BLANK, COMMENT, header_names, split_line
from ..units import is_unit
from .cells import NUMBER, Notes, Stated, Values

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
Row = Sequence[str]


@dataclass(frozen=True, slots=True)
class Look:
    """The first lines of a file, and where its samples are.

    places : the lines of the header, the units and the first samples, from 1; 0 for none.
    width : cells of a row.
    """

    lines: Row
    encoding: str
    delimiter: str
    width: int
    places: tuple[int, int, int]

    @property
    def names(self) -> list[str]:
        """The names in the header."""
        header = self.places[0]
        line = COMMENT.sub("", self.lines[header - 1].lstrip()) if header else ""
        return header_names(split_line(line, self.delimiter)) if header else []

    @property
    def rows(self) -> list[list[str]]:
        """The cells of the lines of samples."""
        return [split_line(line, self.delimiter) for line in self.lines[self.places[2] - 1 :]]


def look(content: bytes, stated: Stated) -> Look | None:
    """Return how a file is written, by its first lines; None if it is no text."""
    encoding, text = decode(content, stated.get("text.encoding"))
    lines = text.splitlines()[:MOST_LINES]
    if "\0" in text or not text.strip():
        return None
    candidates = (stated["text.delimiter"],) if "text.delimiter" in stated else DELIMITERS
    shapes = {mark: _share_of_numbers(lines, mark) for mark in candidates}
    delimiter = max(shapes, key=lambda mark: shapes[mark][0])
    share, width = shapes[delimiter]
    if share == 0:  # a single column
        delimiter, width = ",", 1
    rows = [split_line(line, delimiter) if line.strip() else [] for line in lines]
    data = _first_row(rows, width)
    above = [i + 1 for i in range(data) if len(rows[i]) >= width and any(map(str.strip, rows[i]))]
    units = above.pop() if len(above) > 1 and _are_units(rows[above[-1] - 1]) else 0
    header = above[-1] if above else 0
    return Look(lines, encoding, delimiter, width, (header, units, data + 1))


def decode(content: bytes, stated: str | None) -> tuple[str, str]:
    """Return the encoding of a text and its first part: what is stated, else UTF-8 or 16."""
    head = content[:HEAD_BYTES]
    head = head[: head.rfind(b"\n") + 1] or head
    is_wide = content[:2] in (b"\xff\xfe", b"\xfe\xff")
    if is_wide:
        head = content[: len(head) // 2 * 2]
    encoding = stated or ("utf-16" if is_wide else "utf-8")
    with suppress(UnicodeDecodeError):
        return encoding, head.decode(encoding).removeprefix("\ufeff")
    encoding = stated or "cp1252"
    return encoding, head.decode(encoding, "replace")


def _share_of_numbers(lines: Row, delimiter: str) -> tuple[float, int]:
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


def _count_numbers(cells: Row) -> int:
    """Return how many cells are numbers."""
    return sum(1 for cell in cells if NUMBER.fullmatch(cell))


def _first_row(rows: Sequence[Row], width: int) -> int:
    """Return the first row of samples: as many numbers as usual, as have those behind it."""
    counts = [_count_numbers(row) if len(row) == width else 0 for row in rows]
    least = max(0.6 * float(np.median(counts[len(counts) // 3 :])), 1)
    return next((i for i in range(len(rows)) if min(counts[i : i + 4]) >= least), 0)


def _are_units(row: Row) -> bool:
    """Return whether the cells of a row that are filled are units."""
    cells = [cell.strip() for cell in row if cell.strip()]
    return all(is_unit(cell) or UNIT_WORDS.fullmatch(cell) for cell in cells)


def describe_form(looks: Mapping[str, Look], notes: Notes) -> tuple[Values, list[str]]:
    """Return the keys of `[text]` for most of the files, and the files of another form.

    These have another delimiter, another number of columns, or no column in common with most.
    """
    usual, same = _usual(looks)
    header, units, data = usual.places
    encoding = min({look.encoding for look in same} - {"utf-8"}, default="utf-8")
    if encoding == "cp1252":
        notes["text.encoding"] = "not UTF-8; cp1252 reads any text: look at the letters below"
    values: Values = {"text.encoding": encoding, "text.delimiter": usual.delimiter}
    values |= {"text.header": header, "text.units": units, "text.data": data}
    if len({look.places for look in same}) > 1 and header:
        notes["text.header"] = "it stands at another line in each file"
        first, mark, _ = usual.lines[header - 1].partition(usual.delimiter)
        values |= {"text.header": first + mark, "text.data": data - header}
        values["text.units"] = units and units - header
    if missing := _missing_names(usual):
        values["text.names"] = missing
        notes["text.names"] = "no header names each column"
    cells = {cell.strip() for look in same for row in look.rows for cell in row}
    values |= marks([cell for cell in cells if NUMBER.fullmatch(cell)], notes)
    return values, [name for name, look in looks.items() if look not in same]


def _usual(looks: Mapping[str, Look]) -> tuple[Look, list[Look]]:
    """Return a file like most, and those that are written in its form."""
    forms = Counter((look.delimiter, look.width) for look in looks.values())
    same = [x for x in looks.values() if (x.delimiter, x.width) == forms.most_common(1)[0][0]]
    places = Counter(look.places for look in same).most_common(1)[0][0]
    usual = next(look for look in same if look.places == places)
    names = {*usual.names}
    return usual, [look for look in same if not names or not names.isdisjoint(look.names)]


def _missing_names(usual: Look) -> list[str]:
    """Return names for the columns where the header does not give one for each; else none.

    In a matrix, whose rows are parts, a first column of few whole numbers is their class.
    """
    names, width = usual.names, usual.width
    if names or width < MOST_NAMES:
        numbered = [f"c{i}" for i in range(width)]
        return (names[:width] if len(names) > width else []) if names else numbered
    firsts, seconds = ({row[i].strip() for row in usual.rows if len(row) > i} for i in (0, 1))
    is_class = 1 < len(firsts) <= MOST_CLASSES and len(firsts) < len(seconds)
    return ["class", "x*"] if is_class and all(map(WHOLE.fullmatch, firsts)) else ["x*"]


def marks(cells: Iterable[str], notes: Notes) -> Values:
    """Return the decimal mark and that of groups, which numbers prove.

    A mark is a decimal one where other than three digits follow it, it follows a 0 or more than
    three digits, or stands behind the other mark: `0,004` and `1.043,5` prove a comma, `1.043`
    proves nothing. Where both fit, the decimal mark is `?`.
    """
    counts = {mark: _count_marks(cells, mark) for mark in ".,"}
    text = "\n".join(cells)
    group = next((mark for mark in GROUPS if re.search(rf"\d{mark}\d{{3}}", text)), "")
    for decimal, other in (".,", ",."):
        (_, proof, _), (n_other, against, repeats) = counts[decimal], counts[other]
        if proof > 20 * against or (repeats and not against):
            return {"text.decimal": decimal, "text.thousands": other if n_other else group}
    example = min(filter(re.compile("[.,]").search, cells), default="")
    text = "both marks are used for decimals, in other files or columns"
    if not counts["."][1] and not counts[","][1]:
        text = f"'.' or ','; {example} may be a fraction or a thousand"
    notes |= {"text.decimal": text} if example else {}
    return {"text.decimal": UNKNOWN if example else ".", "text.thousands": group}


def _count_marks(cells: Iterable[str], mark: str) -> tuple[int, int, int]:
    """Return how many numbers have a mark, prove that it is the decimal one, or have it twice."""
    seen = [cell for cell in cells if mark in cell]
    proofs = [cell for cell in seen if DECIMAL[mark].fullmatch(cell)]
    return len(seen), len(proofs), sum(cell.count(mark) > 1 for cell in seen)
