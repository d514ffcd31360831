"""How a text file writes its numbers: 1043.5, 1,043.5, 1.043,5, 1 043,5 or 1'043.5.

A file has one number format. It is found from all cells of all its numeric columns: a cell such as
0,004 or 1.043,5 decides which mark is the decimal one; 1.043 alone does not. Where no cell decides and
the values would change, the file is not read until somebody says which it is.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from .dataset import UnreadableError

if TYPE_CHECKING:
    import pandas as pd

MARKS = ".,"  # that may be the decimal mark
SPACED = r"'’\s"  # that can only group thousands; \s holds the narrow and the fixed blank, too
EXPONENT = r"(?:[eE][+\-−]?\d+)?"
SIGN = r"[+\-−]?"
NUMERAL = re.compile(
    rf"{SIGN}(?:\d+(?:[.,]\d*)?|[.,]\d+|\d{{1,3}}([.,{SPACED}])\d{{3}}(?:\1\d{{3}})*(?:[.,]\d*)?)"
    rf"{EXPONENT}"
)
SAMPLED = 50  # cells of a column that tell whether it is one of numbers
ENOUGH = 44  # three decimals each: the chance that not one ends in a zero is 0.9 ** 44, 1 %
UNUSUAL = re.compile(r"[,−'’]|[^\S\n]")  # what a column has none of that is written as Python writes it


class UndecidedError(UnreadableError):
    """A file whose cells do not tell its number format, though its values depend on it."""


def is_numeral(cell: str) -> bool:
    """Whether a cell is a number in any of the formats."""
    return NUMERAL.fullmatch(cell) is not None


def is_numeric(cells: Sequence[str]) -> bool:
    """Whether most of a sample of a column's cells that are not empty are numbers in any of the formats."""
    some = [cell for cell in cells[:: max(1, len(cells) // SAMPLED)] if cell]
    return bool(some) and 2 * sum(map(is_numeral, some)) > len(some)


def _other(mark: str) -> str:
    return MARKS.replace(mark, "")


def _certain_pattern(mark: str) -> re.Pattern[str]:
    """Compile the pattern of cells, a line each, that prove a mark to be the decimal one."""
    m = re.escape(mark)
    other = re.escape(_other(mark))
    alone = rf"(?:0\d*|\d{{4,}}){m}\d*|{m}\d+|\d+{m}(?:\d{{0,2}}|\d{{4,}})|\d+{m}\d+[eE][+\-−]?\d+"
    behind = rf"\d{{1,3}}(?:(?:[{other}'’]|[^\S\n])\d{{3}})+{m}\d*"  # 1,043.5
    beside = rf"\d{{1,3}}(?:{other}\d{{3}}){{2,}}"  # 1,043,500
    return re.compile(rf"^{SIGN}(?:{alone}|{behind}|{beside}){EXPONENT}$", re.MULTILINE)


def _ambiguous_pattern(mark: str) -> re.Pattern[str]:
    """Compile the pattern of cells, a line each, in which a mark may be the decimal one or group thousands."""
    return re.compile(rf"^{SIGN}[1-9]\d{{0,2}}{re.escape(mark)}\d{{3}}$", re.MULTILINE)


DECIDING = {mark: _certain_pattern(mark) for mark in MARKS}
UNDECIDED = {mark: _ambiguous_pattern(mark) for mark in MARKS}
SMALL = re.compile(rf"^{SIGN}[1-9]\d{{0,2}}$", re.MULTILINE)
LARGE = re.compile(rf"^{SIGN}[1-9]\d{{3,}}$", re.MULTILINE)


def _decides(mark: str, text: str) -> bool:
    return mark in text and DECIDING[mark].search(text) is not None


def _looks_grouped(text: str, mark: str) -> bool:
    """Whether a mark groups the thousands of a column, for smaller numbers have none."""
    if mark not in text or DECIDING[mark].search(text) or LARGE.search(text) or not SMALL.search(text):
        return False
    return len(UNDECIDED[mark].findall(text)) >= ENOUGH


def decimal_of(columns: Sequence[tuple[str, str]], delimiter: str) -> str | None:
    """The decimal mark of a file, "." or ","; None where its values do not depend on it.

    columns : the name of each numeric column, and its cells, a line each. UndecidedError where the
    values depend on it and nothing decides; UnreadableError where a column contradicts the others.
    """
    certain = [mark for mark in MARKS if any(_decides(mark, text) for _, text in columns)]
    if len(certain) > 1:  # most cells count; the others are named one by one
        times = {mark: sum(len(DECIDING[mark].findall(text)) for _, text in columns) for mark in MARKS}
        certain = [max(MARKS, key=times.__getitem__)]
    grouped = {mark: name for name, text in columns for mark in MARKS if _looks_grouped(text, mark)}
    for mark in certain:
        if mark in grouped:
            what = f"Expected one number format: {grouped[mark]} has {mark!r} before thousands, other columns have it "
            do = f"state decimal={mark!r} if it is the decimal mark there too, or write the file in one format"
            raise UnreadableError(f"{what}before decimals; {do}")
        return mark
    if len(grouped) == 1:
        return _other(next(iter(grouped)))
    for mark in MARKS:
        for name, text in columns:
            found = UNDECIDED[mark].search(text)
            if found is None:
                continue
            if LARGE.search(text):  # without a mark of thousands: so this one is none
                return mark
            if mark == "." and delimiter in (",", " "):
                return mark  # who groups by points has decimal commas, and parts cells by something else
            both = f"{found[0].replace(mark, '.')} or {found[0].replace(mark, '')}"
            what = f"Expected a cell that tells the decimal mark, {found[0]} in column {name} may be {both}"
            raise UndecidedError(f"{what}; say which, decimal={mark!r} or thousands={mark!r}")
    return None


def as_python(
    frame: pd.DataFrame, delimiter: str, decimal: str | None, thousands: str | None
) -> tuple[str, dict[int, str]]:
    """Write a table's numbers as Python does, in place; returns the decimal mark, "" where none is
    told, and what is wrong, by the line.

    A number in another format than the file's is wrong.
    decimal, thousands : the marks, as somebody stated them; None: as the cells tell.
    """
    cell_lists = (frame.iloc[:, i].tolist() for i in range(frame.shape[1]))
    columns = {i: cells for i, cells in enumerate(cell_lists) if is_numeric(cells)}
    texts = {i: "\n".join(cells) for i, cells in columns.items()}
    if decimal is None and thousands in (".", ","):
        decimal = _other(str(thousands))
    if decimal is None:
        decimal = decimal_of([(frame.columns[i], text) for i, text in texts.items()], delimiter)
    told = decimal or ""
    decimal = decimal or "."
    group = rf"[{re.escape(_other(decimal))}{SPACED}]" if thousands is None else re.escape(thousands)
    whole = rf"[1-9]\d{{0,2}}(?P<mark>{group})\d{{3}}(?:(?P=mark)\d{{3}})*|\d*"
    tail = rf"(?P<tail>{re.escape(decimal)}\d*)?(?P<power>{EXPONENT})"
    number = re.compile(rf"(?P<sign>{SIGN})(?P<whole>{whole}){tail}")
    wrong = dict[int, str]()
    for i, cells in columns.items():
        if decimal == "." and not UNUSUAL.search(texts[i]):
            continue
        for k, cell in enumerate(cells):
            match = number.fullmatch(cell)
            if match is not None:
                digits = re.sub(r"\D", "", match["whole"])
                said = match["sign"] + digits + (match["tail"] or "").replace(decimal, ".") + match["power"]
                cells[k] = said.replace("−", "-")
            elif is_numeral(cell):
                what = f"Expected a number in column {frame.columns[i]} with {decimal!r} before decimals"
                wrong.setdefault(int(frame.index[k]), f"{what}, as the file has, got {cell!r}")
        frame.isetitem(i, cells)
    return told, wrong
