"""Read a text file as a `Table`, exactly as `[text]` says.

pandas' C parser reads plain files. Where it meets anything odd, the standard `csv` module reads the
file again, and names the cell that does not fit.
"""

import csv
import io
import re
from collections.abc import Container
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from ..description import ANY, Strings, TextForm
from ..table import Cells, Table, UnreadableError

COMMENT = re.compile(r"^[#%]+\s*")
LATIN = "cp1252"  # reads nearly any text
BLANK = " "


def read_text(
    content: bytes, source: str, form: TextForm, words: Container[str] | None = None
) -> Table:
    """Return the table of a text file.

    Parameters
    ----------
    content : bytes
        Content of the file.
    source : str
        Name of the file, for errors.
    form : TextForm
        How the file is written: the section `[text]` of a description.
    words : container of str, optional
        The columns whose cells are read as texts. The cells of any other column are numbers if the
        file is plain and pandas reads them all as numbers; bools if all are True or False, in any
        of the spellings that pandas knows; otherwise texts. A file is not plain if a row has a
        wrong number of cells, a line or a last cell is empty, a cell has a line break, `form.drop`
        (how lines begin that are left out) is not empty, or a word of `form.missing` (words for a
        missing number) ends in a digit. None: all columns.

    Returns
    -------
    Table
        Its `damage` has an error for each line with a wrong number of cells, whose row has empty
        cells. Empty lines and those that begin with a text of `form.drop` are left out, so that it
        may have no rows.

    Raises
    ------
    UnreadableError
        If nothing but line ends stands where the samples begin, if the file has another encoding or
        a zero byte, has no line that begins with the text stated as `form.header`, or has neither
        header nor stated names, or if all rows have a wrong number of cells.
    LookupError
        If Python does not know the encoding.
    """
    content = to_utf8(content, form.encoding)
    header = form.header
    above = 0
    if isinstance(header, str):
        beginning = header.encode(errors="replace")
        numbers = (i for i, line in enumerate(io.BytesIO(content), 1) if line.startswith(beginning))
        header = above = next(numbers, 0)
        if not above:
            raise UnreadableError(f"Expected a header that begins with {form.header!r}, got none")
    first = form.data + above
    units = form.units and form.units + above
    end = content.rstrip(b"\n").count(b"\n") + 2
    if first >= end or not content.strip():
        raise UnreadableError("Expected rows of samples, got none", first if content.strip() else 0)
    top = [line.decode() for line in content.split(b"\n", first)[:first]]
    names = _names(top, header, form)
    cells = split_line("".join(top[units - 1 : units]), form.delimiter)
    stated = dict(zip(names, map(str.strip, cells), strict=False))
    table = Table(
        source,
        dict.fromkeys(names, np.empty(0)),
        np.arange(first, end),
        stated,
        top[: (header or first) - 1],
        header,
    )
    return _read_plain(content, table, form, words) or _read_strictly(content, table, form)


def to_utf8(content: bytes, encoding: str) -> bytes:
    """Return the bytes of a text in UTF-8, with plain line feeds and without a byte order mark.

    `encoding` is the encoding of `content`. Raises UnreadableError, with the line (1 if the
    encoding does not say where, or if lines end with a carriage return alone), if a byte does not
    fit the encoding or if the text has a zero byte, and LookupError for an encoding that Python
    does not know.
    """
    try:
        content = content.decode(encoding).removeprefix("\ufeff").encode("utf-8", "replace")
        bad = content.find(b"\0")
    except UnicodeError as error:  # some encodings do not say where
        bad = getattr(error, "start", 0)
    if bad >= 0:
        raise UnreadableError(
            f"Expected a text in {encoding}, got the byte 0x{content[bad]:02x}; state "
            "text.encoding",
            line=content.count(b"\n", 0, bad) + 1,
        )
    return content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")


def to_utf8_or_latin(content: bytes, encoding: str) -> tuple[str, bytes]:
    """Return the encoding of a text, the given one or else cp1252, and its bytes as `to_utf8` does.

    cp1252 is tried if the text is not in `encoding`. Raises UnreadableError if it is in neither or
    has a zero byte, and LookupError for an encoding that Python does not know.
    """
    with suppress(UnreadableError):
        return encoding, to_utf8(content, encoding)
    return LATIN, to_utf8(content, LATIN)


def split_line(line: str, delimiter: str) -> list[str]:
    """Return the cells of one line; a blank as delimiter stands for any run of blanks.

    Quotes mean nothing then, nor in a line with a cell that is too long for the `csv` module. With
    another delimiter blanks around a cell stay. An empty line has no cells.
    """
    with suppress(csv.Error):
        return line.split() if delimiter == BLANK else next(csv.reader([line], delimiter=delimiter))
    return line.split(delimiter)


def header_names(cells: Strings) -> list[str]:
    """Return the names of columns in a header; empty cells become `column1`, `column2`, ...

    Blanks around a name are left out. A name that repeats gets a number, like `X.2`.
    """
    names = [cell.strip() or f"column{i}" for i, cell in enumerate(cells, 1)]
    return [
        f"{name}.{n}" if (n := names[:i].count(name)) > 1 else name
        for i, name in enumerate(names, 1)
    ]


def _names(top: Strings, header: int, form: TextForm) -> list[str]:
    """Return the names of the columns: those of `form.names`, otherwise the cells of the header.

    A last name `x*` of `form.names` becomes `x0`, `x1`, ..., as many as the first line of samples
    has cells left, even if this line is left out of the table (`form.drop`). In the header `#` or
    `%` at the beginning is skipped, an empty cell is called by its number, like `column1`, and a
    name that repeats gets a number, like `X.2`. Raises UnreadableError if there are neither names
    nor a header.

    top : the lines from the first to the first row of samples. header : the number of the header's
    line, 0 for none. form : how the file is written, the section `[text]` of a description.
    """
    names = [*form.names]
    if names and names[-1].endswith(ANY):
        rest = names.pop().removesuffix(ANY)
        n = len(split_line(top[-1], form.delimiter)) - len(names)
        names += [f"{rest}{i}" for i in range(n)]
    elif not names:
        line = "".join(top[:-1][header - 1 : header]).lstrip(BLANK)
        names = header_names(split_line(COMMENT.sub("", line), form.delimiter))
    if not names:
        raise UnreadableError("Expected a header, or text.names; got neither", header)
    return names


def _read_plain(
    content: bytes, table: Table, form: TextForm, words: Container[str] | None
) -> Table | None:
    """Return a copy of the table with its columns, read by pandas; None if the file is not plain.

    A file is not plain if a row has a wrong number of cells, a line or a last cell is empty, a cell
    has a line break, or `form.drop` (how lines begin that are left out) is not empty, even if no
    line begins so. If a word of `form.missing`, the words for a missing number, ends in a digit,
    all columns have texts. A column of True and False has bools; any other that pandas does not
    read as numbers has texts.

    table : has the names of the columns, which are empty, and the lines of the rows. words : the
    columns whose cells are read as texts; None: all.
    """
    import pandas as pd

    if form.drop:
        return None
    if any(word[-1:].isdigit() for word in form.missing):
        words = None  # pandas would read them as numbers
    texts = [name for name in table.columns if words is None or name in words]
    try:
        frame = pd.read_csv(
            io.BytesIO(content),
            sep=r"\s+" if form.delimiter == BLANK else form.delimiter,
            header=None,
            skiprows=table.lines[0] - 1,
            names=[*table.columns],
            decimal=form.decimal,
            dtype=dict.fromkeys(texts, "category"),
            keep_default_na=False,
            low_memory=False,  # so a column has numbers or texts, not both
        )
    except (ValueError, OverflowError):  # a row of too many cells, among others
        return None
    is_whole = len(frame) == len(table.lines) and isinstance(frame.index, pd.RangeIndex)
    if not is_whole or frame.iloc[:, -1].isin(["", np.nan]).any():  # the end of a cut row
        return None
    return replace(table, columns={name: _cells_of(cells) for name, cells in frame.items()})


def _cells_of(cells: Any) -> Cells:
    """Return the cells of a column of pandas: its numbers or bools, or the words of categories."""
    if cells.dtype == "category":  # equal words are one object
        cells = np.array(cells.array.categories, dtype=object)[cells.array.codes]
    return np.asarray(cells)


def _read_strictly(content: bytes, table: Table, form: TextForm) -> Table:
    """Return the table with all cells as texts, without empty and dropped lines.

    A line that has only blanks or tabs is empty, too, also if a tab is the delimiter. So are lines
    that have only delimiters at the end of the file.

    `content` is as `to_utf8` returns it. Of `table` the names of the columns and the first line
    number are read: reading begins at this line. Lines that begin with a text of `form.drop` are
    dropped. If no line is left, the result has no rows. An error for each line with a wrong number
    of cells is in `damage` of the result, and its row has empty cells. Raises UnreadableError if
    all lines have a wrong number of cells.
    """
    n = len(table.columns)
    lines = content.decode().split("\n")
    blanks = f" \t{form.delimiter}"  # all that a spreadsheet's empty rows at the end have
    while lines and not lines[-1].strip(blanks):
        lines.pop()
    rows = {
        i: split_line(line, form.delimiter)
        for i, line in enumerate(lines, 1)
        if i >= table.lines[0] and line.strip() and not line.startswith(form.drop)
    }
    damage = [
        UnreadableError(
            f"Expected {n} cells, as there are columns, got {len(row)}: mend the line, or see "
            "text.drop",
            i,
        )
        for i, row in rows.items()
        if len(row) != n
    ]
    if damage and len(damage) == len(rows):
        raise damage[0]
    whole = [row if len(row) == n else [""] * n for row in rows.values()]
    cells = np.array(whole, dtype=object).reshape(-1, n).T
    return replace(
        table,
        columns=dict(zip(table.columns, cells, strict=True)),
        lines=np.array([*rows]),
        damage=damage,
    )
