"""How text files are written: their encoding, delimiter, header, units and marks in numbers.

Each value follows from a count over the lines that were looked at; where two fit, it is `?`.
"""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
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
MOST_LINES = 400  # of a file that are looked at
MOST_NAMES = 20  # columns without a header that get a name each
MOST_CLASSES = 12  # whole numbers in the first column of a matrix that are its classes
UNIT_WORDS = re.compile(
    r"(?i)[\[(]?(hh:mm(:ss)?|dd\.mm\.yyyy|[\d.]+ ?[mu]?s|s|ms|us|ns|min|h)[\])]?"
)
# A number with one mark M that can only be the decimal one.
DECIMAL = r"[-+−]?(?:[^.,]*M(\d{0,2}|\d{4,})([eE].*)?|0?M\d+.*|\d{4,}M.*|.*[.,]\d{3}M.*)"
Row = Sequence[str]


@dataclass(frozen=True, slots=True)
class Look:
    """The first lines of a file, and where its samples are.

    header, units, data : lines, counted from 1; 0 for none.
    width : cells of a row.
    """

    lines: Row
    encoding: str
    delimiter: str
    header: int
    units: int
    data: int
    width: int

    @property
    def form(self) -> tuple[str, int]:
        """What files of one form have in common: the delimiter, and the cells of a row."""
        return self.delimiter, self.width

    @property
    def places(self) -> tuple[int, int, int]:
        """The lines of the header, the units and the first samples."""
        return self.header, self.units, self.data

    @property
    def names(self) -> list[str]:
        """The names in the header."""
        if not self.header:
            return []
        line = self.lines[self.header - 1]
        line = COMMENT.sub("", line.strip() if self.delimiter == BLANK else line)
        return header_names(split_line(line, self.delimiter))

    @property
    def rows(self) -> list[list[str]]:
        """The cells of the lines of samples."""
        return [split_line(line, self.delimiter) for line in self.lines[self.data - 1 :]]


def look(content: bytes, stated: Stated) -> Look | None:
    """Return how a file is written, by its first lines; None if it is no text."""
    encoding, text = decode(content, stated.get("text.encoding"))
    lines = text.splitlines()[:MOST_LINES]
    if "\0" in text or not any(map(str.strip, lines)):
        return None
    candidates = (stated["text.delimiter"],) if "text.delimiter" in stated else DELIMITERS
    shares = {mark: _share_of_numbers(lines, mark) for mark in candidates}
    rated = {
        m: round(share / (BLANKS_LEAD if m == BLANK else 1), 2) for m, (share, _) in shares.items()
    }
    delimiter = max(rated, key=lambda mark: rated[mark])
    share, width = shares[delimiter]
    if share == 0:  # a single column
        delimiter, width = ",", 1
    rows = [split_line(line, delimiter) if line.strip() else [] for line in lines]
    data = _first_row(rows, width)
    above = [i for i in range(data) if _is_like_header(rows[i], width, delimiter)]
    units = above.pop() + 1 if len(above) > 1 and _are_units(rows[above[-1]]) else 0
    header = above[-1] + 1 if above else 0
    return Look(lines, encoding, delimiter, header, units, data + 1, width)


def decode(content: bytes, stated: str | None) -> tuple[str, str]:
    """Return the encoding of a text and its first part: what is stated, else UTF-8 or 16."""
    head = content[:HEAD_BYTES]
    head = head[: head.rfind(b"\n") + 1] or head
    if stated:
        return stated, head.decode(stated, "replace")
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16", content[: len(head) // 2 * 2].decode("utf-16", "replace")
    try:
        return "utf-8", head.decode("utf-8-sig")
    except UnicodeDecodeError:
        return "cp1252", head.decode("cp1252", "replace")


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
    return _count_numbers(cells) / len(cells) * len(same) / len(rows) + 0.01, width


def _count_numbers(cells: Row) -> int:
    """Return how many cells are numbers."""
    return sum(1 for cell in cells if NUMBER.fullmatch(cell))


def _first_row(rows: Sequence[Row], width: int) -> int:
    """Return the first row of samples: as many numbers as usual, as have those behind it."""
    counts = [_count_numbers(row) if len(row) == width else 0 for row in rows]
    usual = np.median(counts[len(counts) // 3 :])
    dense = [count >= max(0.6 * usual, 1) for count in counts]
    return next((i for i in range(len(rows)) if all(dense[i : i + 4])), 0)


def _is_like_header(row: Row, width: int, delimiter: str) -> bool:
    """Return whether a row above the samples has as many cells as they, or one more.

    So it is where a mark of comments, or a delimiter at its end, makes another cell.
    """
    extra = width + 1 if delimiter == BLANK or (row and not row[-1].strip()) else width
    is_wider = len(row) > width and all(map(str.strip, row[: width + 1]))
    return any(map(str.strip, row)) and (len(row) in (width, extra) or is_wider)


def _are_units(row: Row) -> bool:
    """Return whether the cells of a row that are filled are units."""
    cells = [cell.strip() for cell in row if cell.strip()]
    return bool(cells) and all(is_unit(cell) or UNIT_WORDS.fullmatch(cell) for cell in cells)


def describe_form(looks: Sequence[Look], notes: Notes) -> Values:
    """Return the keys of `[text]` for files of one form, and put the evidence into `notes`."""
    places = Counter(look.places for look in looks)
    header, units, data = places.most_common(1)[0][0]
    usual = next(look for look in looks if look.places == (header, units, data))
    encodings = sorted({look.encoding for look in looks} - {"utf-8"})
    values: Values = {"text.encoding": encodings[0] if encodings else "utf-8"}
    if "cp1252" in encodings:
        notes["text.encoding"] = "not UTF-8; cp1252 reads any text: look at the letters below"
    values["text.delimiter"] = usual.delimiter
    values |= {"text.header": header, "text.units": units, "text.data": data}
    if len(places) > 1 and header:
        notes["text.header"] = "it stands at another line in each file"
        line = usual.lines[header - 1]
        first = split_line(line, usual.delimiter)[0]
        beginning = line[: line.index(first) + len(first)]
        values |= {"text.header": beginning, "text.data": data - header}
        values["text.units"] = units and units - header
    if names := _missing_names(usual):
        values["text.names"] = names
        no_header = "no header names each column" if header else "there is no header"
        notes["text.names"] = no_header
    cells = {cell.strip() for look in looks for row in look.rows for cell in row}
    return values | marks([cell for cell in cells if NUMBER.fullmatch(cell)], notes)


def _missing_names(usual: Look) -> list[str]:
    """Return names for the columns where the header does not give one for each; else none.

    In a matrix, whose rows are parts, a first column of few whole numbers is their class.
    """
    if usual.header:
        return usual.names[: usual.width] if len(usual.names) > usual.width else []
    if usual.width < MOST_NAMES:
        return [f"c{i}" for i in range(usual.width)]
    firsts, seconds = ({row[i].strip() for row in usual.rows if len(row) > 1} for i in (0, 1))
    are_whole = all(re.fullmatch(r"-?\d+(\.0*)?(e\+00)?", cell) for cell in firsts)
    is_class = are_whole and 1 < len(firsts) <= MOST_CLASSES and len(firsts) < len(seconds)
    return ["class", "x*"] if is_class else ["x*"]


def marks(cells: Iterable[str], notes: Notes) -> Values:
    """Return the decimal mark and that of groups, which numbers prove.

    A mark is a decimal one where other than three digits follow it, it follows a 0 or more than
    three digits, or stands behind the other mark: `0,004` and `1.043,5` prove a comma, `1.043`
    proves nothing. Where both fit, the decimal mark is `?`.
    """
    cells = [*cells]
    seen = {mark: [cell for cell in cells if mark in cell] for mark in ".,"}
    proof = dict[str, int]()
    for mark, some in seen.items():
        pattern = re.compile(DECIMAL.replace("M", re.escape(mark)))
        proof[mark] = sum(cell.count(mark) == 1 and bool(pattern.fullmatch(cell)) for cell in some)
    blank = next((m for m in GROUPS if any(re.search(rf"\d{m}\d{{3}}", c) for c in cells)), "")
    for decimal, other in (".,", ",."):
        groups = any(cell.count(other) > 1 for cell in seen[other])
        if (proof[decimal] and proof[decimal] > 20 * proof[other]) or (groups and not proof[other]):
            return {"text.decimal": decimal, "text.thousands": other if seen[other] else blank}
    if not seen["."] and not seen[","]:
        return {"text.decimal": ".", "text.thousands": blank}
    text = "both marks are used for decimals, in other files or columns"
    if not proof["."] and not proof[","]:
        example = min(seen["."] or seen[","])
        text = f"'.' or ','; {example} may be a fraction or a thousand"
    notes["text.decimal"] = text
    return {"text.decimal": UNKNOWN, "text.thousands": blank}
