"""Finds how a text file writes its numbers, 1043.5, 1,043.5, 1.043,5, 1 043,5 or 1'043.5, and
rewrites them for Python.

A file has one number format. It is found from all cells of its numeric columns: cells such as
0,004, 1.043,5 or 1,043,500 prove which mark is the decimal one, 1.043 alone does not. A file in
which no cell proves it, though its values depend on it, is not read until the user states the mark.
`write_as_python` rewrites the cells of a text file in the format that Python reads.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from .dataset import UnreadableError

if TYPE_CHECKING:
    import pandas as pd

MARKS = ".,"  # that may be the decimal mark
SPACES = r"'’\s"  # marks that can only group thousands; \s includes the narrow and the fixed blank
EXPONENT = r"(?:[eE][+\-−]?\d+)?"
SIGN = r"(?:[+\-−][^\S\n]*)?"  # loggers write "-   0.41"
NUMERAL = re.compile(
    rf"{SIGN}(?:\d+(?:[.,]\d*)?|[.,]\d+|\d{{1,3}}([.,{SPACES}])\d{{3}}(?:\1\d{{3}})*(?:[.,]\d*)?)"
    rf"{EXPONENT}"
)
SAMPLED_CELLS = 50  # of a column, by which it is found whether it is numeric
# Cells as 1,043 that prove thousands: if these were three decimals, one of so many would end in a
# zero, but for a chance of 0.9 ** 44, 1 %.
MIN_GROUPED = 44
UNUSUAL = re.compile(r"[,−'’]|[^\S\n]")  # a column without any of these is as Python writes it


class UndecidedError(UnreadableError):
    """A file whose values depend on its number format, which no cell proves."""


def is_numeral(cell: str) -> bool:
    """Return whether a cell is a number in any of the formats."""
    return NUMERAL.fullmatch(cell) is not None


def is_numeric(cells: Sequence[str]) -> bool:
    """Return whether most cells of a sample of a column are numbers; empty ones do not count."""
    step = max(1, len(cells) // SAMPLED_CELLS)
    sample = [cell for cell in cells[::step] if cell]
    return bool(sample) and 2 * sum(map(is_numeral, sample)) > len(sample)


def _other_mark(mark: str) -> str:
    """Return "," for "." and "." for ","."""
    return MARKS.replace(mark, "")


def _proof_pattern(mark: str) -> re.Pattern[str]:
    """Compile the pattern of cells, one on each line, that prove a mark to be the decimal one."""
    m = re.escape(mark)
    other = re.escape(_other_mark(mark))
    alone = rf"(?:0\d*|\d{{4,}}){m}\d*|{m}\d+|\d+{m}(?:\d{{0,2}}|\d{{4,}})|\d+{m}\d+[eE][+\-−]?\d+"
    after_thousands = rf"\d{{1,3}}(?:(?:[{other}'’]|[^\S\n])\d{{3}})+{m}\d*"  # 1,043.5
    millions = rf"\d{{1,3}}(?:{other}\d{{3}}){{2,}}"  # 1,043,500
    cell = rf"(?:{alone}|{after_thousands}|{millions})"
    return re.compile(rf"^{SIGN}{cell}{EXPONENT}$", re.MULTILINE)


def _ambiguous_pattern(mark: str) -> re.Pattern[str]:
    """Compile the pattern of cells, one on each line, as 1,043.

    In them a mark may be the decimal one or group thousands.
    """
    return re.compile(rf"^{SIGN}[1-9]\d{{0,2}}{re.escape(mark)}\d{{3}}$", re.MULTILINE)


PROOFS = {mark: _proof_pattern(mark) for mark in MARKS}
AMBIGUOUS = {mark: _ambiguous_pattern(mark) for mark in MARKS}
SMALL = re.compile(rf"^{SIGN}[1-9]\d{{0,2}}$", re.MULTILINE)
LARGE = re.compile(rf"^{SIGN}[1-9]\d{{3,}}$", re.MULTILINE)


def _proves(mark: str, text: str) -> bool:
    """Return whether a column's cells, one on each line, prove a mark to be the decimal one."""
    has_marks = any(m in text for m in MARKS)  # cheaper than the pattern
    return has_marks and PROOFS[mark].search(text) is not None


def _looks_grouped(text: str, mark: str) -> bool:
    """Return whether a mark seems to group the thousands in a column's cells, one on each line.

    It does if all numbers of four digits and more have it, at least 44 of them, there are smaller
    ones, which do not have it, and no cell proves it to be the decimal mark.
    """
    if mark not in text or PROOFS[mark].search(text):
        return False
    if LARGE.search(text) or not SMALL.search(text):
        return False
    return len(AMBIGUOUS[mark].findall(text)) >= MIN_GROUPED


def decimal_of(columns: Sequence[tuple[str, str]], delimiter: str) -> str | None:
    """Find the decimal mark of a file by its cells.

    Parameters
    ----------
    columns : sequence of (name, text)
        The numeric columns; the text has a cell on each line.
    delimiter : str
        Between the cells of the file. Where it is a comma or a blank, an undecided point is taken
        as the decimal mark.

    Returns
    -------
    str or None
        "." or ","; None if the values do not depend on it. If some cells prove one mark and some
        the other, the one of most cells. If none proves one, the mark that groups no thousands, if
        the other one seems to, or thousands without a mark show that none are grouped.

    Raises
    ------
    UndecidedError
        If the values depend on it and no cell proves it.
    UnreadableError
        If a column groups its thousands by the mark that other columns have before decimals.
    """
    proven = [mark for mark in MARKS if any(_proves(mark, text) for _, text in columns)]
    if len(proven) > 1:  # the mark of most cells; those in the other format become faults
        counts = {
            mark: sum(len(PROOFS[mark].findall(text)) for _, text in columns) for mark in MARKS
        }
        proven = [max(MARKS, key=counts.__getitem__)]
    grouped = {mark: name for name, text in columns for mark in MARKS if _looks_grouped(text, mark)}
    if proven:
        mark = proven[0]
        if mark in grouped:
            actual = f"{grouped[mark]} has {mark!r} before thousands"
            message = f"Expected one number format: {actual}, other columns have it before decimals"
            do = f"state decimal={mark!r} if it is the decimal mark there too"
            raise UnreadableError(f"{message}; {do}, or write the file in one format")
        return mark
    if len(grouped) == 1:
        return _other_mark(next(iter(grouped)))
    for mark in MARKS:
        for name, text in columns:
            cell = AMBIGUOUS[mark].search(text)
            if cell is None:
                continue
            if LARGE.search(text):  # without a mark before thousands: so this one is the decimal
                return mark
            if mark == "." and delimiter in (",", " "):
                # Files that group by points have decimal commas, and other delimiters.
                return mark
            values = f"{cell[0].replace(mark, '.')} or {cell[0].replace(mark, '')}"
            actual = f"{cell[0]} in column {name} may be {values}"
            do = f"say which, decimal={mark!r} or thousands={mark!r}"
            message = f"Expected a cell that tells the decimal mark, {actual}; {do}"
            raise UndecidedError(message)
    return None


def write_as_python(
    frame: pd.DataFrame, delimiter: str, decimal: str | None, thousands: str | None
) -> tuple[str, str, dict[int, str]]:
    """Rewrite the numbers of a table of texts as Python writes them, in place.

    Parameters
    ----------
    frame : DataFrame of str
        Its index is the number of each line.
    delimiter : str
        Between the cells of the file.
    decimal, thousands : str or None
        Marks that the user stated; None: as the cells prove.

    Returns
    -------
    mark : str
        The decimal mark; "" if the values do not depend on it.
    group : str
        The mark before thousands; "" if there is none.
    wrong : dict of int to str
        What is wrong in a line: a number in another format than the file's, which stays as it is.

    Raises
    ------
    UnreadableError
        If the user stated no mark, and the decimal mark is undecided, or groups thousands in one of
        the columns.
    """
    cell_lists = (frame.iloc[:, i].tolist() for i in range(frame.shape[1]))
    columns = {i: cells for i, cells in enumerate(cell_lists) if is_numeric(cells)}
    texts = {i: "\n".join(cells) for i, cells in columns.items()}
    if decimal is None and thousands in (".", ","):
        decimal = _other_mark(str(thousands))
    if decimal is None:
        decimal = decimal_of([(frame.columns[i], text) for i, text in texts.items()], delimiter)
    mark = decimal or ""
    decimal = decimal or "."
    other = re.escape(_other_mark(decimal))
    group = rf"[{other}{SPACES}]" if thousands is None else re.escape(thousands)
    whole = rf"[1-9]\d{{0,2}}(?P<mark>{group})\d{{3}}(?:(?P=mark)\d{{3}})*|\d*"
    tail = rf"(?P<tail>{re.escape(decimal)}\d*)?(?P<power>{EXPONENT})"
    number = re.compile(rf"(?P<sign>{SIGN})(?P<whole>{whole}){tail}")
    wrong = dict[int, str]()
    groups = set[str]()
    for i, cells in columns.items():
        if decimal == "." and not UNUSUAL.search(texts[i]):
            continue
        wanted = f"a number in column {frame.columns[i]} with {decimal!r} before decimals"
        for k, cell in enumerate(cells):
            match = number.fullmatch(cell)
            if match is not None:
                groups.update(match["mark"] or "")
                digits = re.sub(r"\D", "", match["whole"])
                decimals = (match["tail"] or "").replace(decimal, ".")
                python = match["sign"].rstrip() + digits + decimals + match["power"]
                cells[k] = python.replace("−", "-")
            elif is_numeral(cell):
                message = f"Expected {wanted}, as the file has, got {cell!r}"
                wrong.setdefault(int(frame.index[k]), message)
        frame.isetitem(i, cells)
    return mark, next(iter(groups), ""), wrong
