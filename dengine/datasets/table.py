"""`Table`, columns of cells as a file holds them, and `Recording`, what one part's samples are.

Reading a cell as a number is strict: what does not follow the description raises
`UnreadableError`, which names the line and the column, and becomes a `Fault`.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, instead, listed, shortened
from ..records import Floats, TraceArray
from .description import Strings, TextForm

Cells = NDArray[Any]
LARGEST = 3.4028235e38  # of a sample, which is a float32
# A minus sign that typographers use, which Excel writes in some languages.
MINUS = "−"


class UnreadableError(DataError):
    """A file or a recording that does not follow the description.

    line : of the file; 0 if the error is not of one line. column : "" if it is not of one column.
    """

    def __init__(self, message: str, line: int = 0, column: str = "") -> None:
        super().__init__(message)
        self.line = line
        self.column = column


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of cells.

    Parameters
    ----------
    source : str
        Name in messages: the file, with the row or the part if the file has several.
    columns : mapping of str to array, shape (rows,)
        Numbers, times, or texts as objects. In a file of a single part a column with one cell holds
        for all rows.
    lines : sequence or array of int
        Line in the file of each row, or one line for all rows; empty: not known.
    units : mapping of str to str
        Units that the file states for its columns.
    above : sequence of str
        Lines above the header.
    header : int
        Line of the header; 0 for none.
    damage : sequence of UnreadableError
        Errors of lines with a wrong number of cells, whose rows have empty cells; or of the part as
        a whole.
    origin : mapping of str to sequence of str
        For a column that was put together from others: the column of the file for each cell.
    path : str
        The path of the file that names the part, relative to the folder; or the name of its column
        or window.
    """

    source: str
    columns: Mapping[str, Cells]
    lines: Sequence[int] | Cells = ()
    units: Mapping[str, str] = field(default_factory=dict)
    above: Strings = ()
    header: int = 0
    damage: Sequence[UnreadableError] = ()
    origin: Mapping[str, Strings] = field(default_factory=dict)
    path: str = ""

    def column(self, name: str) -> Cells:
        """Return the cells of a column, an array of shape (rows,), or (1,) if one holds for all.

        Raises UnreadableError if there is no column of this name.
        """
        if name not in self.columns:
            raise UnreadableError(
                f"Expected a column {name}, got {listed(self.columns) or 'none'}", self.header, name
            )
        return self.columns[name]

    def whole(self) -> "Table":
        """Return the table itself; raise its first damage if it has any."""
        if self.damage:
            raise self.damage[0]
        return self

    def take(self, rows: Any) -> "Table":
        """Return a table of the rows that a slice or an array of positions or booleans selects.

        Their line numbers are selected, too. A column of one cell, and a single line number, hold
        for all rows and stay, even if no row is selected; so do `damage`, `origin` and all else.
        """
        columns = {name: c[rows] if len(c) > 1 else c for name, c in self.columns.items()}
        lines = np.asarray(self.lines)
        return replace(self, columns=columns, lines=lines[rows] if len(lines) > 1 else lines)

    def words(self, name: str) -> Cells:
        """Return the cells of a column as texts, without blanks around them.

        The shape is (rows,), or (1,) if one cell holds for all rows. A whole float has no decimal
        point: 1.0 is "1", but the text "1.0" stays "1.0". NaN and None are "". Raises
        UnreadableError if there is no such column, or its cells are lists.
        """
        cells = self.column(name).tolist()
        with instead(UnreadableError, f"Expected texts or numbers in {name}", TypeError):
            words = {cell: as_word(cell) for cell in {*cells}}
        return np.array([words[cell] for cell in cells], dtype=object)

    def numbers(self, name: str, form: TextForm) -> Floats:
        """Return a column as numbers, float64 of shape (rows,); a missing number is NaN.

        The shape is (1,) if one cell holds for all rows. `form` says how numbers are written, with
        the decimal mark, the mark of thousands and the words for a missing number; a column of
        numbers does not need it. Raises UnreadableError if there is no such column, and for a cell
        that is no number of this form, is infinite, or is too large for float32. An empty cell or
        None is such a cell, unless "" is among the words for a missing number.
        """
        cells = self.column(name)
        if cells.dtype.kind not in "iuf":
            pattern = pattern_of(form.decimal, form.thousands)
            cells = np.array([_number(cell, form, pattern) for cell in cells.tolist()])
        values = cells.astype(np.float64)
        groups = f" and groups by {form.thousands!r}" if form.thousands else ""
        self.refuse(
            np.abs(values) > LARGEST, f"a number with the decimal mark {form.decimal}{groups}", name
        )
        return values

    def refuse(self, is_bad: Cells, wanted: str, name: str) -> None:
        """Raise UnreadableError for the first row in which `is_bad` is True; if none is, return.

        is_bad : bool, one for each cell of the column. wanted : what was expected, for the message.
        name : the column whose cell the message shows. The error has the line, 0 if it is unknown,
        and the column: `name`, or the file's column of this cell if the column was put together
        from several (`origin`).
        """
        if is_bad.any():
            row = int(is_bad.argmax())
            cell = shortened(self.columns[name].tolist()[row])
            column = self.origin[name][row] if name in self.origin else name
            raise UnreadableError(f"Expected {wanted}, got {cell}", self.line(row), column)

    def line(self, row: int) -> int:
        """Return the line of a row; 0 if it is not known."""
        row = row if len(self.lines) > 1 else 0
        return int(self.lines[row]) if row < len(self.lines) else 0

    def one_word(self, name: str, at: str) -> str:
        """Return the one word, like a label or part number, that a column has for a recording.

        The table holds the rows of the recording. The word is "" for an empty cell. Raises
        UnreadableError if there is no such column or no row, if the cells are lists, or if the
        words of the rows differ and `at` is "same".

        at : "same" if all rows must have this word, "first" or "last" for the row whose
        word is returned, also if it is empty.
        """
        words = self.words(name)
        if not len(words):
            raise UnreadableError(f"Expected a word in column {name}, got no rows", column=name)
        if at == "same":
            self.refuse(words != words[0], f"one word in all rows, {words[0]!r}", name)
        return str(words[-1 if at == "last" else 0])


@dataclass(frozen=True, slots=True)
class Recording:
    """The trace of one part, and what is known of the part.

    Parameters
    ----------
    source : str
        The file, or the file and row.
    trace : array of float32, shape (C, T)
    label : int
        1 good, 0 bad.
    part : str
        Number of the part; "" if none is stated.
    length : int
        Number of samples as recorded.
    rank : object
        What recordings are sorted by, of one type for all: the time of the first sample, or the
        `natural_key` of a path or word, as `order` in the description says; "" for order `name`.
    """

    source: str
    trace: TraceArray
    label: int
    part: str
    length: int
    rank: Any


def as_word(cell: Any) -> str:
    """Return a cell as a text without blanks around it.

    NaN and None are "", and a whole float has no decimal point: 1.0 is "1". The text "1.0" stays.
    """
    if cell is None or cell != cell:
        return ""
    is_whole = isinstance(cell, float) and cell.is_integer()
    return str(int(cell) if is_whole else cell).strip()


@lru_cache
def pattern_of(decimal: str, thousands: str) -> re.Pattern[str]:
    """Return the regular expression of a number; a sign and an exponent are allowed.

    `decimal` is its decimal mark, and `thousands` the mark that may stand between groups of three
    digits; "" allows no groups. The digits before or behind the decimal mark may be missing, but
    not both. The minus sign U+2212 is accepted, too, but not in the exponent. Blanks may stand
    behind the sign. The pattern is for `fullmatch`, and has no blanks around the number. It is
    cached.
    """
    mark = re.escape(thousands)
    point = re.escape(decimal)
    groups = rf"[1-9]\d{{0,2}}(?:{mark}\d{{3}})+|" if mark else ""
    digits = rf"(?:(?:{groups}\d+)(?:{point}\d*)?|{point}\d+)"
    return re.compile(rf"(?:[-+{MINUS}] *)?{digits}(?:[eE][-+]?\d+)?", re.ASCII)


def _number(cell: Any, form: TextForm, pattern: re.Pattern[str]) -> float:
    """Return the number in a cell; NaN for a word of `form.missing`, infinity for any other text.

    A float is returned as it is. None is read as "", which is infinity unless `form.missing` has
    it. A number too large for float64 is infinity. `form` has the decimal mark and the mark of
    thousands, and `pattern` is the regular expression of a number with these.
    """
    if isinstance(cell, float):
        return cell
    text = "" if cell is None else str(cell).strip()
    if text in form.missing:
        return np.nan
    if not pattern.fullmatch(text):
        return np.inf
    text = text.replace(form.thousands, "").replace(form.decimal, ".")
    return float(text.replace(MINUS, "-").replace(" ", ""))
