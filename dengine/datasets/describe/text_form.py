"""How text files are written: their encoding, delimiter, header, units and marks in numbers.

Each value follows from a count over the lines that were looked at; where two fit, it is `?`.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..description import UNKNOWN
from ..read.text import BLANK, COMMENT, header_names, split_line
from ..units import is_unit

ENCODINGS = ("utf-8", "utf-16", "cp1252")
DELIMITERS = (";", "\t", "|", ",", BLANK)
# A number with any decimal mark and any mark of groups.
NUMBER = re.compile(
    r"\s*[-+−]?(?=[.,]?\d)(\d{1,3}([ '’\u202f\xa0.,]\d{3})+|\d*)([.,]\d*)?([eE][-+]?\d+)?\s*"
)
MOST_LINES = 400  # of a file that are looked at
MOST_NAMES = 40  # columns without a header that get a name each
UNIT_WORDS = re.compile(
    r"(?i)[\[(]?(hh:mm(:ss)?|dd\.mm\.yyyy|[\d.]+ ?[mu]?s|s|ms|us|ns|min|h)[\])]?"
)


@dataclass(frozen=True, slots=True)
class Look:
    """The first lines of a file, and where its samples are.

    header, units, data : lines, counted from 1; 0 for none.
    width : cells of a row.
    """

    name: str
    lines: Sequence[str]
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

    def rows(self) -> list[list[str]]:
        """Return the cells of the lines of samples."""
        return [split_line(line, self.delimiter) for line in self.lines[self.data - 1 :]]


def look(content: bytes, name: str, stated: Mapping[str, Any]) -> Look | None:
    """Return how a file is written, by its first lines; None if it is no text with numbers."""
    encoding, text = decode(content, stated.get("text.encoding"))
    lines = text.splitlines()[:MOST_LINES]
    if "\0" in text or not any(map(str.strip, lines)):
        return None
    candidates = (stated["text.delimiter"],) if "text.delimiter" in stated else DELIMITERS
    shares = {d: _share_of_numbers(lines, d) for d in candidates}
    delimiter = max(shares, key=lambda d: round(shares[d][0], 2))
    share, width = shares[delimiter]
    if share == 0:  # a single column
        delimiter, width = ",", 1
    rows = [split_line(line, delimiter) if line.strip() else [] for line in lines]
    data = _first_row(rows, width)
    above = [i for i in range(data) if _is_like_header(rows[i], width, delimiter)]
    units = 0
    if len(above) > 1 and _are_units(rows[above[-1]]):
        units = above.pop() + 1
    header = above[-1] + 1 if above else 0
    return Look(name, lines, encoding, delimiter, header, units, data + 1, width)


def decode(content: bytes, stated: str | None = None) -> tuple[str, str]:
    """Return the encoding of a text and its first part: UTF-8 or 16, else what is stated."""
    head = content[:400_000]
    head = head[: head.rfind(b"\n") + 1] or head
    if stated:
        return stated, head.decode(stated, "replace")
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16", content[: len(head) // 2 * 2].decode("utf-16", "replace")
    try:
        return "utf-8", head.decode("utf-8-sig")
    except UnicodeDecodeError:
        return "cp1252", head.decode("cp1252", "replace")


def _share_of_numbers(lines: Sequence[str], delimiter: str) -> tuple[float, int]:
    """Return how well a delimiter parts lines into rows of numbers, and the cells of a row.

    The share is that of the lines with the usual number of cells, times that of numbers in their
    cells; a single cell scores 0. The first third of the lines may be a preamble.
    """
    rows = [split_line(line, delimiter) for line in lines[len(lines) // 3 :] if line.strip()]
    widths = Counter(map(len, rows))
    width = widths.most_common(1)[0][0] if widths else 0
    same = [row for row in rows if len(row) == width]
    cells = [cell for row in same for cell in row if cell.strip()]
    if width < 2 or not cells:
        return 0.0, width
    numbers = sum(1 for cell in cells if NUMBER.fullmatch(cell))
    return numbers / len(cells) * len(same) / len(rows) + 0.01, width


def _first_row(rows: Sequence[Sequence[str]], width: int) -> int:
    """Return the first row of samples: as many numbers as usual, as have those behind it."""
    counts = [
        sum(1 for cell in row if NUMBER.fullmatch(cell)) if len(row) == width else 0 for row in rows
    ]
    usual = np.median(counts[len(counts) // 3 :])
    dense = [count >= max(0.6 * usual, 1) for count in counts]
    for i in range(len(rows)):
        if all(dense[i : i + 4]):
            return i
    return 0


def _is_like_header(row: Sequence[str], width: int, delimiter: str) -> bool:
    """Return whether a row above the samples has as many cells as they, or one more.

    So it is where a mark of comments, or a delimiter at its end, makes another cell.
    """
    extra = width + 1 if delimiter == BLANK or (row and not row[-1].strip()) else width
    is_wider = len(row) > width and all(map(str.strip, row[: width + 1]))
    return any(map(str.strip, row)) and (len(row) in (width, extra) or is_wider)


def _are_units(row: Sequence[str]) -> bool:
    """Return whether the cells of a row that are filled are units."""
    cells = [cell.strip() for cell in row if cell.strip()]
    return bool(cells) and all(is_unit(cell) or UNIT_WORDS.fullmatch(cell) for cell in cells)


def describe_form(looks: Sequence[Look], notes: dict[str, str]) -> dict[str, Any]:
    """Return the keys of `[text]` for files of one form, and put the evidence into `notes`."""
    encodings = Counter(one.encoding for one in looks)
    places = Counter((one.header, one.units, one.data) for one in looks)
    header, units, data = places.most_common(1)[0][0]
    usual = next(one for one in looks if (one.header, one.units, one.data) == (header, units, data))
    others = [name for name in encodings if name != "utf-8"]
    values: dict[str, Any] = {"text.encoding": others[0] if others else "utf-8"}
    if "cp1252" in encodings:
        notes["text.encoding"] = "not UTF-8; cp1252 reads any text: look at the letters below"
    values["text.delimiter"] = usual.delimiter
    is_relative = len(places) > 1 and header > 0
    if is_relative:
        line = usual.lines[header - 1]
        first = split_line(line, usual.delimiter)[0]
        notes["text.header"] = "it stands at another line in each file"
        header, units, data = (
            line[: line.index(first) + len(first)],
            units and units - header,
            data - header,
        )
    values |= {"text.header": header, "text.units": units, "text.data": data}
    names = _missing_names(usual)
    if names:
        values["text.names"] = names
        notes["text.names"] = (
            "no header names each column" if usual.header else "there is no header"
        )
    cells = {cell.strip() for one in looks for row in one.rows() for cell in row}
    numbers = {cell for cell in cells if NUMBER.fullmatch(cell)}
    values |= marks(numbers, usual.delimiter, notes)
    return values


def _missing_names(usual: Look) -> list[str]:
    """Return names for the columns where the header does not give one for each; else none."""
    if not usual.header:
        n = usual.width
        return [f"c{i}" for i in range(n)] if n < MOST_NAMES else ["c*"]
    line = usual.lines[usual.header - 1]
    line = COMMENT.sub("", line.strip() if usual.delimiter == BLANK else line)
    found = header_names(split_line(line, usual.delimiter))
    return found[: usual.width] if len(found) > usual.width else []


def marks(cells: Iterable[str], delimiter: str, notes: dict[str, str]) -> dict[str, Any]:
    """Return the decimal mark and that of groups, which numbers prove.

    A mark is a decimal one where other than three digits follow it, it follows a 0 or more than
    three digits, or stands behind the other mark: `0,004` and `1.043,5` prove a comma, `1.043`
    proves nothing. Where both fit, the decimal mark is `?`.
    """
    cells = [*cells]
    seen = {mark: [cell for cell in cells if mark in cell] for mark in ".,"}
    proof = {mark: sum(map(_is_decimal(mark), seen[mark])) for mark in ".,"}
    blank = next(
        (m for m in "'’\u202f\xa0 " if any(re.search(rf"\d\{m}\d{{3}}", c) for c in cells)), ""
    )
    for decimal, other in (".,", ",."):
        groups = any(cell.count(other) > 1 for cell in seen[other])
        if (proof[decimal] and proof[decimal] > 20 * proof[other]) or (groups and not proof[other]):
            return {"text.decimal": decimal, "text.thousands": other if seen[other] else blank}
    if not seen["."] and not seen[","]:
        return {"text.decimal": ".", "text.thousands": blank}
    if proof["."] or proof[","]:
        notes["text.decimal"] = "both marks are used for decimals, in other files or columns"
    else:
        example = min(seen["."] or seen[","])
        notes["text.decimal"] = f"'.' or ','; {example} may be a fraction or a thousand"
    return {"text.decimal": UNKNOWN, "text.thousands": blank}


def _is_decimal(mark: str) -> Any:
    """Return a function that says whether a number proves that a mark is the decimal one."""
    m = re.escape(mark)
    pattern = re.compile(
        rf"[-+−]?(?:[^.,]*{m}(?:\d{{0,2}}|\d{{4,}})(?:[eE].*)?|0?{m}\d+.*|\d{{4,}}{m}.*|.*[.,]\d{{3}}{m}.*)"
    )
    return lambda cell: cell.count(mark) == 1 and pattern.fullmatch(cell) is not None
