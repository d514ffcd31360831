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
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ..description import TextForm
from ..table import Cells, Table, UnreadableError

COMMENT = re.compile(r"^[#%]+\s*")
BLANK = " "
REST = "*"  # at the end of the last name: it stands for all columns that remain
Columns = dict[str, Cells]
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
    table, body = _parts(to_utf8(content, form.encoding), source, form)
    numbers, words = ({*filter(test, body.names)} for test in (is_numeric, is_word))
    columns = _read_plain(body, form, numbers, words)
    if columns is not None:
        return replace(table, columns=columns, lines=range(body.first, body.first + body.n))
    rows = _rows(body, form)
    n = len(body.names)
    wanted = f"Expected {n} cells, as there are columns"
    damage = {i: f"{wanted}, got {len(row)}" for i, row in rows if len(row) != n}
    if damage and (not keep_damaged or len(damage) == len(rows)):
        line, message = next(iter(damage.items()))
        raise UnreadableError(message, line)
    texts = np.array([[""] * n if i in damage else row for i, row in rows], dtype=object)
    columns = dict(zip(body.names, texts.reshape(-1, n).T, strict=True))
    return replace(table, columns=columns, lines=[i for i, _ in rows], damage=damage)


class Body(NamedTuple):
    """The n lines of samples in a file, `content[start:end]` from line `first` on."""

    content: bytes
    start: int
    end: int
    first: int
    n: int
    names: Sequence[str]


def _parts(content: bytes, source: str, form: TextForm) -> tuple[Table, Body]:
    """Return what stands above the samples, as a table without columns, and the samples."""
    if not content.strip():
        raise UnreadableError("Expected rows of samples, the file is empty")
    header, units, data = _places(content, form)
    heads = content.split(b"\n", data)[:data]
    top = [line.decode() for line in heads]
    start, end = sum(len(line) + 1 for line in heads[:-1]), len(content.rstrip(b"\n"))
    if len(heads) < data or start >= end:
        raise UnreadableError("Expected rows of samples, got none", data)
    names = _names(top, header, form)
    cells = split_line(top[units - 1], form.delimiter) if 0 < units < data else ()
    stated = dict(zip(names, map(str.strip, cells), strict=False))
    table = Table(source, {}, (), stated, top[: (header or data) - 1], header)
    return table, Body(content, start, end, data, content.count(b"\n", start, end) + 1, names)


def to_utf8(content: bytes, encoding: str) -> bytes:
    """Return a text in UTF-8 with plain line ends, without a mark at its beginning.

    Raises UnreadableError, with the line, if it is not in its encoding.
    """
    is_utf8 = codecs.lookup(encoding).name == "utf-8"
    if not (is_utf8 and content.isascii()):
        try:
            text = content.decode("utf-8-sig" if is_utf8 else encoding)
        except UnicodeDecodeError as error:
            message = f"Expected a text in {encoding}, got the byte 0x{content[error.start]:02x}"
            raise _at(content, error.start, f"{message}; state text.encoding") from error
        content = text.encode("utf-8", "replace")
    if b"\r" in content:
        content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"\0" in content:
        raise _at(content, content.index(b"\0"), "Expected a text, got a zero byte")
    return content


def _at(content: bytes, place: int, message: str) -> UnreadableError:
    """Return an error at a byte of a file."""
    return UnreadableError(message, content.count(b"\n", 0, place) + 1)


def _places(content: bytes, form: TextForm) -> tuple[int, int, int]:
    """Return the lines of the header, of the units and of the first samples; 0 for none."""
    if not isinstance(form.header, str):
        return form.header, form.units, form.data
    begin = form.header.encode()
    at = 0 if content.startswith(begin) else content.find(b"\n" + begin) + 1
    if not at and not content.startswith(begin):
        raise UnreadableError(f"Expected a header that begins with {form.header!r}, got none")
    line = content.count(b"\n", 0, at) + 1
    return line, form.units and line + form.units, line + form.data


def split_line(line: str, delimiter: str) -> list[str]:
    """Return the cells of one line; a blank as delimiter stands for any run of blanks."""
    if delimiter == BLANK:
        return line.split()
    return next(csv.reader([line], delimiter=delimiter), [])


def header_names(cells: Sequence[str]) -> list[str]:
    """Return the columns' names: those that repeat get a number, like `X.2`, empty ones too."""
    names = [cell.strip() or f"column{i}" for i, cell in enumerate(cells, 1)]
    counts = [names[:i].count(name) for i, name in enumerate(names)]
    return [f"{name}.{n + 1}" if n else name for name, n in zip(names, counts, strict=True)]


def _names(top: Sequence[str], header: int, form: TextForm) -> list[str]:
    """Return the names of the columns: as stated, or those of the header among the lines on top."""
    if not form.names and not 0 < header < len(top):
        raise UnreadableError("Expected a header, or text.names; got neither", header)
    if not form.names:
        line = top[header - 1]
        line = COMMENT.sub("", line.strip() if form.delimiter == BLANK else line)
        return header_names(split_line(line, form.delimiter))
    *names, last = form.names
    if not last.endswith(REST):
        return [*form.names]
    n = len(split_line(top[-1], form.delimiter)) - len(names)
    return [*names, *(f"{last[: -len(REST)]}{i}" for i in range(n))]


def _read_plain(body: Body, form: TextForm, numbers: set[str], words: set[str]) -> Columns | None:
    """Return the columns by pandas' parser; None if anything in them is not plain."""
    import pandas as pd

    content, start, _, _, n, names = body
    has_groups = form.thousands and content.find(form.thousands.encode(), start) >= 0
    if form.drop or has_groups or len({*names}) < len(names):
        return None
    file = io.BytesIO(content)
    file.seek(start)
    missing = {name: [*form.missing] for name in numbers} if form.missing else None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", pd.errors.DtypeWarning)
            frame = pd.read_csv(
                file,
                sep=r"\s+" if form.delimiter == BLANK else form.delimiter,
                header=None,
                names=[*names],
                decimal=form.decimal,
                dtype=dict.fromkeys(words, "category"),
                keep_default_na=False,
                na_values=missing,
            )
    except (ValueError, OverflowError):  # a row of too many cells, among others
        return None
    is_whole = len(frame) == n and isinstance(frame.index, pd.RangeIndex)
    if not is_whole or _is_cut(body, frame, form.delimiter):
        return None
    return _cells_of(frame, numbers - words, words, bool(missing))


def _is_cut(body: Body, frame: Any, delimiter: str) -> bool:
    """Return whether a line may have fewer cells than there are columns."""
    if delimiter == BLANK or b'"' in body.content:
        return bool(frame[body.names[-1]].isin(["", np.nan]).any())
    n_marks = body.content.count(delimiter.encode(), body.start, body.end)
    return n_marks != body.n * (len(body.names) - 1)


def _cells_of(frame: Any, numbers: set[str], words: set[str], may_miss: bool) -> Columns | None:
    """Return the columns of a DataFrame; None if a number among them is none, or not finite."""
    columns: Columns = dict.fromkeys(frame.columns, np.empty(0))
    for name in words:
        cells = frame.pop(name).array
        texts = np.array([*map(str.strip, cells.categories)], dtype=object)
        columns[name] = texts[cells.codes]
    for name in numbers:
        values = columns[name] = frame.pop(name).to_numpy()
        is_number = values.dtype.kind in "iuf"
        if not is_number or not (np.isfinite(values) | (np.isnan(values) & may_miss)).all():
            return None
    return columns


def _rows(body: Body, form: TextForm) -> list[tuple[int, list[str]]]:
    """Return the cells of each line with its number, without lines that are empty or dropped."""
    lines = enumerate(body.content[body.start : body.end].decode().split("\n"), body.first)
    kept = ((i, line) for i, line in lines if line.strip() and not line.startswith(form.drop))
    return [(i, split_line(line, form.delimiter)) for i, line in kept]
