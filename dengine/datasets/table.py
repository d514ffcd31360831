"""`Table`, columns of cells as a file holds them, and `Recording`, what one part's samples are.

Reading a cell as a number is strict: what does not follow the description raises
`UnreadableError`, which names the line and the column, and becomes a `Fault`.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, listed, shortened
from .description import TextForm

# A minus sign that typographers use, which Excel writes in some languages.
MINUS = str.maketrans({"−": "-"})


class UnreadableError(DataError):
    """A file or a recording that does not follow the description.

    line : of the file, 0 if it is the whole.
    column : "" if it is none.
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
        The file, as seen from the folder.
    columns : mapping of str to array, shape (rows,)
        Numbers, times, or texts as objects. In a file of a single part a column of one cell holds
        for all rows.
    lines : sequence of int
        Line of each row in the file.
    units : mapping of str to str
        Units that the file states for its columns.
    above : sequence of str
        Lines above the header.
    """

    source: str
    columns: Mapping[str, NDArray[Any]]
    lines: Sequence[int]
    units: Mapping[str, str] = field(default_factory=dict)
    above: Sequence[str] = ()

    def column(self, name: str) -> NDArray[Any]:
        """Return a column; raise UnreadableError if there is none of this name."""
        if name not in self.columns:
            found = listed(self.columns) if self.columns else "none"
            raise UnreadableError(f"Expected a column {name}, got {found}", column=name)
        return self.columns[name]

    def take(self, rows: Any) -> "Table":
        """Return a table of some rows: a slice, or an array of positions or booleans."""
        lines = self.lines[rows] if isinstance(rows, slice) else np.asarray(self.lines)[rows]
        columns = {name: c[rows] if len(c) > 1 else c for name, c in self.columns.items()}
        return Table(self.source, columns, lines, self.units, self.above)

    def words(self, name: str) -> NDArray[Any]:
        """Return a column as texts, shape (rows,), without blanks around them.

        Whole numbers have no decimal point: 1.0 is "1". NaN and None are "".
        """
        import pandas as pd

        codes, cells = pd.factorize(self.column(name), use_na_sentinel=False)
        texts = np.array([as_word(cell) for cell in cells.tolist()], dtype=object)
        return np.asarray(texts[codes])

    def numbers(self, name: str, form: TextForm) -> NDArray[np.float64]:
        """Return a column as numbers, shape (rows,); a missing one is NaN.

        Raises UnreadableError for a cell that is no finite number of this form, and no word for a
        missing one.
        """
        cells = self.column(name)
        if cells.dtype.kind in "iuf":
            values = cells.astype(np.float64)
            bad = np.flatnonzero(np.isinf(values))
        elif (plain := _plain_numbers(cells, form)) is not None:
            return plain
        else:
            number = number_pattern(form)
            values = np.empty(len(cells))
            bad = np.empty(0, dtype=np.int64)
            for i, cell in enumerate(cells.tolist()):
                text = "" if cell is None else str(cell).strip()
                if number.fullmatch(text):
                    values[i] = to_number(text, form)
                elif text in form.missing or (cell is None and "null" in form.missing):
                    values[i] = np.nan
                else:
                    bad = np.array([i])
                    break
        if len(bad):
            i = int(bad[0])
            marks = f" with the decimal mark {form.decimal}"
            marks += f" and groups by {form.thousands!r}" if form.thousands else ""
            message = f"Expected a number{marks}, got {shortened(cells[i])}"
            raise UnreadableError(message, self.line(i), name)
        return values

    def line(self, row: int) -> int:
        """Return the line of a row; 0 if it is not known."""
        return int(self.lines[row]) if row < len(self.lines) else 0

    def one_word(self, name: str, at: str = "same") -> str:
        """Return the word of a column that holds for a recording; see `LabelSource.at`.

        Raises UnreadableError if it changes although it must be the same.
        """
        words = self.words(name)
        if not len(words):
            raise UnreadableError(f"Expected a word in column {name}, got no rows", column=name)
        if at == "same":
            other = np.flatnonzero(words != words[0])
            if len(other):
                i = int(other[0])
                message = f"Expected one word in all rows, got {words[0]!r} and {words[i]!r}"
                raise UnreadableError(message, self.line(i), name)
        return str(words[-1 if at == "last" else 0])


@dataclass(slots=True)
class Recording:
    """The samples of one part, as a file holds them.

    Parameters
    ----------
    source : str
        The file, or the file and row.
    samples : array of float64, shape (C, n)
    seconds : array of float64, shape (n,), optional
        Time of each sample since the first.
    start : float
        Time of the first sample in seconds, by the clock's own zero; NaN without a clock.
    part : str
        Number of the part; "" if none is stated.
    label : int or None
        1 good, 0 bad, None not checked.
    order : str
        Word of the column by which the recordings are put in order.
    lines : sequence of int
        Line of each sample; empty if they are not known.
    """

    source: str
    samples: NDArray[np.float64]
    seconds: NDArray[np.float64] | None = None
    start: float = np.nan
    part: str = ""
    label: int | None = None
    order: str = ""
    lines: Sequence[int] = ()

    def sort(self) -> None:
        """Put the samples in the order of their times, in place."""
        if self.seconds is None:
            return
        order = np.argsort(self.seconds, kind="stable")
        self.lines = np.asarray(self.lines)[order].tolist() if len(self.lines) else ()
        self.start += float(self.seconds[order[0]])
        self.seconds = self.seconds[order] - self.seconds[order[0]]
        self.samples = self.samples[:, order]


def as_word(cell: Any) -> str:
    """Return a cell as a text: "" for NaN and None, no decimal point for whole numbers."""
    if cell is None or cell != cell:
        return ""
    if isinstance(cell, float) and cell.is_integer():
        return str(int(cell))
    return str(cell).strip()


def _plain_numbers(cells: NDArray[Any], form: TextForm) -> NDArray[np.float64] | None:
    """Return texts as numbers if all are plain ones, without groups; None if one may not be."""
    texts = cells.tolist()
    if form.thousands or not all(isinstance(text, str) for text in texts):
        return None
    joined = "\n".join(texts)
    if not joined.isascii() or "_" in joined or (form.decimal != "." and "." in joined):
        return None
    try:
        values = np.array(joined.replace(form.decimal, ".").split("\n"), dtype=np.float64)
    except ValueError:
        return None
    return values if np.isfinite(values).all() else None


def number_pattern(form: TextForm) -> re.Pattern[str]:
    """Return the pattern of a number with the marks of a form."""
    mark = re.escape(form.thousands)
    groups = rf"|\d{{1,3}}(?:{mark}\d{{3}})+" if form.thousands else ""
    decimal = re.escape(form.decimal)
    return re.compile(
        rf"[-+−]?(?:(?:\d+{groups})(?:{decimal}\d*)?|{decimal}\d+)(?:[eE][-+]?\d+)?", re.ASCII
    )


def to_number(text: str, form: TextForm) -> float:
    """Return the number of a text that `number_pattern` matches."""
    if form.thousands:
        text = text.replace(form.thousands, "")
    return float(text.replace(form.decimal, ".").translate(MINUS))
