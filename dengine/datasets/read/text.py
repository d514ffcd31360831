"""Read a text file as a `Table`, exactly as `[text]` says.

pandas' C parser reads plain files. Where it meets anything odd, the standard `csv` module reads the
file again, and names the cell that does not fit.
"""

import codecs
import csv
import io
import re
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from ..description import TextForm
from ..table import Cells, Table, UnreadableError

COMMENT = re.compile(r"^[#%]+\s*")
BLANK = " "
REST = "*"  # at the end of the last name: it stands for all columns that remain
Test = Callable[[str], bool]


def read_text(
    content: bytes,
    source: str,
    form: TextForm,
    is_numeric: Test,
    is_word: Test,
    keep_damaged: bool = False,
) -> Table:
    """Return the table of a text file.

    Parameters
    ----------
    content : bytes
    source : str
        Name of the file.
    form : TextForm
    is_numeric : callable
        Whether the cells of a column, by its name, are numbers; in a plain file they come as such.
    is_word : callable
        Whether the cells of a column are kept as they are. Of others, only their number counts.
    keep_damaged : bool
        Whether lines of another number of cells are the table's `damage`, instead of an error.

    Returns
    -------
    Table

    Raises
    ------
    UnreadableError
        If the file is empty, in another encoding, has no such header, or a row of another number
        of cells.
    """
    content = to_utf8(content, form.encoding)
    header = form.header
    above = 0
    if isinstance(header, str):
        begin = header.encode()
        lines = enumerate(io.BytesIO(content), 1)
        header = above = next((i for i, line in lines if line.startswith(begin)), 0)
        if not header:
            raise UnreadableError(f"Expected a header that begins with {form.header!r}, got none")
    first = form.data + above
    units = form.units and form.units + above
    end = content.rstrip(b"\n").count(b"\n") + 2
    if first >= end or not content.strip():
        line = first if content.strip() else 0
        raise UnreadableError("Expected rows of samples, got none", line)
    top = [line.decode() for line in content.split(b"\n", first)[:first]]
    names = _names(top, header, form)
    cells = split_line("".join(top[units - 1 : units]), form.delimiter)
    stated = dict(zip(names, map(str.strip, cells), strict=False))
    columns = dict.fromkeys(names, np.empty(0))
    table = Table(source, columns, range(first, end), stated, top[: (header or first) - 1], header)
    words = {*filter(is_word, names)}
    numbers = {*filter(is_numeric, names)} - words
    plain = {} if form.drop else _read_plain(content, table, form, numbers, words)
    if plain:
        return replace(table, columns={**columns, **plain})
    return _read_strictly(content, table, form, keep_damaged)


def to_utf8(content: bytes, encoding: str) -> bytes:
    """Return a text in UTF-8 with plain line ends, without a mark at its beginning.

    Raises UnreadableError, with the line, if it is not in its encoding, or has a zero byte.
    """
    is_utf8 = codecs.lookup(encoding).name == "utf-8"
    try:
        if not (is_utf8 and content.isascii()):
            text = content.decode("utf-8-sig" if is_utf8 else encoding)
            content = text.encode("utf-8", "replace")
        bad = content.find(b"\0")
    except UnicodeDecodeError as error:
        bad = error.start
    if bad >= 0:
        message = f"Expected a text in {encoding}, got the byte 0x{content[bad]:02x}"
        line = content.count(b"\n", 0, bad) + 1
        raise UnreadableError(f"{message}; state text.encoding", line)
    return content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")


def split_line(line: str, delimiter: str) -> list[str]:
    """Return the cells of one line; a blank as delimiter stands for any run of blanks.

    Quotes mean nothing in a line with a cell that is too long for the `csv` module.
    """
    with suppress(csv.Error):
        return line.split() if delimiter == BLANK else next(csv.reader([line], delimiter=delimiter))
    return line.split(delimiter)


def header_names(cells: Sequence[str]) -> list[str]:
    """Return the columns' names: those that repeat get a number, like `X.2`, empty ones too."""
    names = [cell.strip() or f"column{i}" for i, cell in enumerate(cells, 1)]
    places = [names[: i + 1].count(name) for i, name in enumerate(names)]
    return [f"{name}.{n}" if n > 1 else name for name, n in zip(names, places, strict=True)]


def _names(top: Sequence[str], header: int, form: TextForm) -> list[str]:
    """Return the names of the columns: as stated, or those of the header among the lines on top."""
    names = [*form.names]
    if names and names[-1].endswith(REST):
        rest = names.pop()[: -len(REST)]
        n = len(split_line(top[-1], form.delimiter)) - len(names)
        names += [f"{rest}{i}" for i in range(n)]
    elif not names:
        line = "".join(top[:-1][header - 1 : header]).lstrip(BLANK)
        names = header_names(split_line(COMMENT.sub("", line), form.delimiter))
    if not names:
        raise UnreadableError("Expected a header, or text.names; got neither", header)
    return names


def _read_plain(
    content: bytes, table: Table, form: TextForm, numbers: set[str], words: set[str]
) -> dict[str, Cells]:
    """Return the columns of numbers and words by pandas' parser; none if anything is not plain."""
    import pandas as pd

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", pd.errors.DtypeWarning)
            frame = pd.read_csv(
                io.BytesIO(content),
                sep=r"\s+" if form.delimiter == BLANK else form.delimiter,
                header=None,
                skiprows=table.lines[0] - 1,
                names=[*table.columns],
                decimal=form.decimal,
                dtype=dict.fromkeys(words, "category"),
                keep_default_na=False,
            )
    except (ValueError, OverflowError):  # a row of too many cells, among others
        return {}
    is_whole = len(frame) == len(table.lines) and isinstance(frame.index, pd.RangeIndex)
    if not is_whole or frame.iloc[:, -1].isin(["", np.nan]).any():  # the end of a cut row
        return {}
    columns = {name: frame.pop(name).to_numpy() for name in numbers}
    if not all(x.dtype.kind in "iuf" and np.isfinite(x).all() for x in columns.values()):
        return {}
    for name in words:
        cells = frame.pop(name).array
        columns[name] = np.array(cells.categories, dtype=object)[cells.codes]  # each text once
    return columns


def _read_strictly(content: bytes, table: Table, form: TextForm, keep_damaged: bool) -> Table:
    """Return the table with the cells of a text, without lines that are empty or dropped."""
    names = [*table.columns]
    lines = enumerate(content.decode().split("\n"), 1)
    rows = {
        i: split_line(line, form.delimiter)
        for i, line in lines
        if i in table.lines and line.strip() and not line.startswith(form.drop)
    }
    n = len(names)
    wanted = f"Expected {n} cells, as there are columns"
    damage = {i: f"{wanted}, got {len(row)}" for i, row in rows.items() if len(row) != n}
    if damage and (not keep_damaged or len(damage) == len(rows)):
        line = min(damage)
        raise UnreadableError(damage[line], line)
    cells = [[""] * n if i in damage else row for i, row in rows.items()]
    columns = dict(zip(names, np.array(cells, dtype=object).reshape(-1, n).T, strict=True))
    return replace(table, columns=columns, lines=[*rows], damage=damage)
