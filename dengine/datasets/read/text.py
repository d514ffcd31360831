"""Read a text file as a `Table`, exactly as `[text]` says.

pandas' C parser reads plain files. Where it meets anything odd, the standard `csv` module reads the
file again, and names the cell that does not fit.
"""

import codecs
import csv
import io
import re
from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..description import TextForm
from ..table import Table, UnreadableError

COMMENT = re.compile(r"^[#%]+\s*")
BLANK = " "
REST = "*"  # at the end of the last name: it stands for all columns that remain


def read_text(
    content: bytes,
    source: str,
    form: TextForm,
    is_numeric: Callable[[str], bool],
    is_word: Callable[[str], bool],
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
    if not content.strip():
        raise UnreadableError("Expected rows of samples, the file is empty")
    header, units, data = _places(content, form)
    top, body = _split_lines(content, data - 1)
    names = _names(top, header, body, form)
    unit_cells = split_line(top[units - 1], form.delimiter) if 0 < units <= len(top) else []
    stated_units = dict(zip(names, map(str.strip, unit_cells), strict=False))
    above = top[: (header or data) - 1]
    lines: Sequence[int] = range(data, data + body.count(b"\n") + 1)
    if form.drop:
        body, lines = _without_dropped(body, data, form)
    if not body.strip():
        raise UnreadableError("Expected rows of samples, got none", data)
    numeric = {name for name in names if is_numeric(name)}
    words = {name for name in names if is_word(name)}
    columns = _read_plain(body, names, form, numeric, words)
    if columns is None:
        columns, lines = _read_cells(body, names, form, lines)
    return Table(source, columns, lines, stated_units, above)


def to_utf8(content: bytes, encoding: str) -> bytes:
    """Return a text in UTF-8 with plain line ends, without a mark at its beginning.

    Raises UnreadableError, with the line, if it is not in its encoding.
    """
    is_utf8 = codecs.lookup(encoding).name == "utf-8"
    if not (is_utf8 and content.isascii()):
        try:
            text = content.decode("utf-8-sig" if is_utf8 else encoding)
        except UnicodeDecodeError as error:
            line = content[: error.start].count(b"\n") + 1
            byte = content[error.start]
            message = f"Expected a text in {encoding}, got the byte 0x{byte:02x}"
            raise UnreadableError(f"{message}; state text.encoding", line) from error
        content = text.encode("utf-8", "replace")
    if b"\r" in content:
        content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"\0" in content:
        line = content[: content.index(b"\0")].count(b"\n") + 1
        raise UnreadableError("Expected a text, got a zero byte", line)
    return content.rstrip(b"\n")


def _places(content: bytes, form: TextForm) -> tuple[int, int, int]:
    """Return the lines of the header, of the units and of the first samples; 0 for none."""
    if not isinstance(form.header, str):
        return form.header, form.units, form.data
    lines = content.decode().split("\n")
    for i, line in enumerate(lines, 1):
        if line.startswith(form.header):
            return i, form.units and i + form.units, i + form.data
    raise UnreadableError(f"Expected a header that begins with {form.header!r}, got none")


def _split_lines(content: bytes, n: int) -> tuple[list[str], bytes]:
    """Return the first n lines, and the rest."""
    start = 0
    for _ in range(n):
        start = content.find(b"\n", start) + 1
        if not start:
            return content.decode().split("\n"), b""
    return content[:start].decode().split("\n")[:-1], content[start:]


def split_line(line: str, delimiter: str) -> list[str]:
    """Return the cells of one line; a blank as delimiter stands for any run of blanks."""
    if delimiter == BLANK:
        return line.split()
    return next(csv.reader([line], delimiter=delimiter), [])


def header_names(cells: Sequence[str]) -> list[str]:
    """Return the columns' names: those that repeat get a number, like `X.2`, empty ones too."""
    names: list[str] = []
    for i, cell in enumerate(map(str.strip, cells), 1):
        name = cell or f"column{i}"
        n = sum(1 for earlier in cells[: i - 1] if earlier.strip() == name)
        names.append(f"{name}.{n + 1}" if n else name)
    return names


def _names(top: Sequence[str], header: int, body: bytes, form: TextForm) -> list[str]:
    """Return the names of the columns: as stated, or those of the header."""
    if form.names:
        names = list(form.names)
    elif 0 < header <= len(top):
        line = COMMENT.sub(
            "", top[header - 1].strip() if form.delimiter == BLANK else top[header - 1]
        )
        return header_names(split_line(line, form.delimiter))
    else:
        raise UnreadableError("Expected a header, or text.names; got neither", header)
    if names[-1].endswith(REST):
        first = body.partition(b"\n")[0].decode()
        n = len(split_line(first, form.delimiter)) - len(names) + 1
        stem = names.pop()[: -len(REST)]
        names += [f"{stem}{i}" for i in range(n)]
    return names


def _without_dropped(body: bytes, first: int, form: TextForm) -> tuple[bytes, list[int]]:
    """Return the lines that do not begin with what is dropped, and their numbers."""
    drop = tuple(text.encode() for text in form.drop)
    kept = [
        (i, line) for i, line in enumerate(body.split(b"\n"), first) if not line.startswith(drop)
    ]
    return b"\n".join(line for _, line in kept), [i for i, _ in kept]


def _read_plain(
    body: bytes,
    names: Sequence[str],
    form: TextForm,
    numeric: Collection[str],
    words: Collection[str],
) -> dict[str, NDArray[Any]] | None:
    """Return the columns by pandas' parser; None if anything in the file is not plain."""
    import pandas as pd

    if form.thousands or len({*names}) < len(names):
        return None
    types: dict[str, Any] = dict.fromkeys(words, "category")
    try:
        frame = pd.read_csv(
            io.BytesIO(body),
            sep=r"\s+" if form.delimiter == BLANK else form.delimiter,
            header=None,
            names=[*names],
            decimal=form.decimal,
            dtype=types,
            keep_default_na=False,
            na_values={name: [*form.missing] for name in numeric} if form.missing else None,
            skip_blank_lines=True,
            low_memory=False,
            encoding="utf-8",
        )
    except (ValueError, OverflowError):  # a row of too many cells, among others
        return None
    is_whole = isinstance(frame.index, pd.RangeIndex) and len(frame) == body.count(b"\n") + 1
    # A row that is cut short has no last cell.
    if not is_whole or frame[names[-1]].isna().any():
        return None
    columns = dict[str, NDArray[Any]]()
    for name in names:
        column = frame[name]
        if name in types:
            texts = np.array([as_text.strip() for as_text in column.cat.categories], dtype=object)
            columns[name] = texts[column.cat.codes.to_numpy()]
        elif name in numeric:
            values = column.to_numpy()
            lost = form.missing and values.dtype.kind == "f"
            is_plain = values.dtype.kind in "iuf"
            if not is_plain or not (np.isfinite(values) | (np.isnan(values) & bool(lost))).all():
                return None
            columns[name] = values
        else:
            columns[name] = np.empty(0)
    return columns


def _read_cells(
    body: bytes, names: Sequence[str], form: TextForm, lines: Sequence[int]
) -> tuple[dict[str, NDArray[Any]], list[int]]:
    """Return the columns as texts, and the line of each row, cell by cell.

    Raises UnreadableError for a row of another number of cells. Empty lines are passed over.
    """
    rows = []
    numbers = []
    text = body.decode()
    if form.delimiter == BLANK:
        rows = [line.split() for line in text.split("\n")]
        numbers = list(lines)
    else:
        reader = csv.reader(io.StringIO(text), delimiter=form.delimiter)
        previous = 0
        for row in reader:
            rows.append(row)
            numbers.append(lines[min(previous, len(lines) - 1)])
            previous = reader.line_num
    kept = [(number, row) for number, row in zip(numbers, rows, strict=True) if row]
    for number, row in kept:
        if len(row) != len(names):
            message = f"Expected {len(names)} cells, as there are columns, got {len(row)}"
            raise UnreadableError(message, number)
    cells = np.array([row for _, row in kept], dtype=object).reshape(len(kept), len(names))
    return dict(zip(names, cells.T, strict=True)), [number for number, _ in kept]
