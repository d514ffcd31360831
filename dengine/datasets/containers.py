"""What a file of a table is by its first bytes: text, packed text, Parquet, or something else.

`open_text` opens a text file, unpacked if it is packed by gzip, and refuses what is no text by its
kind. `read_frame` reads the tables that are no lines of text: Parquet, and JSON.
"""

from __future__ import annotations

import gzip
import json
import re
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

from ..errors import instead, shortened
from ..files import UNREADABLE, damage_of, read_errors
from .dataset import UnreadableError

if TYPE_CHECKING:
    import pandas as pd

NPZ = ".npz"
PARQUET = (".parquet", ".pq")
JSON = (".json", ".jsonl", ".ndjson")
PACKED = ".gz"
GZIP = b"\x1f\x8b"
PARQUET_MAGIC = b"PAR1"
JSON_STRING = re.compile(r'"(?:\\.|[^"\\])*"')
# First bytes -> what such a file is, and what to do.
KINDS = {
    b"PK\x03\x04": ("a workbook or a zip archive", "save the sheet as CSV, or unpack it"),
    b"\xd0\xcf\x11\xe0": ("a workbook", "save the sheet as CSV"),
    b"BZh": ("packed by bzip2", "unpack it"),
    b"\xfd7zXZ": ("packed by xz", "unpack it"),
    b"7z\xbc\xaf": ("packed by 7-Zip", "unpack it"),
    b"ARROW1": ("an Arrow file (Feather)", "save it as Parquet or CSV"),
    b"\x89HDF": ("an HDF5 file", "save it as CSV or .npz"),
    b"MATLAB": ("a MATLAB file", "save it as CSV or .npz"),
    b"\x93NUMPY": ("a single NumPy array", "save it as .npz, with its labels"),
    b"TDSm": ("a TDMS file", "export it as text"),
    b"MDF ": ("an MDF file", "export it as text"),
    b"SQLite": ("a database", "export the table as CSV"),
    b"%PDF": ("a PDF", "export the table as CSV"),
    b"PAR1": ("a Parquet file", "name it .parquet"),
}
LARGEST = 128 * 2**20  # bytes of one text file
HEAD = 4096  # bytes that tell what a file is
CONTROL = bytes({*range(1, 32)} - {*b"\t\n\v\f\r\x1a\x1b"})  # no text has many of these
MOST_CONTROL = 0.02  # of the bytes of a text


def suffix_of(path: Path) -> str:
    """Return the suffix of a file in lower case: `.csv` for `7_OK.csv` and `7_OK.csv.gz`."""
    suffix = path.suffix.lower()
    return Path(path.stem).suffix.lower() if suffix == PACKED else suffix


def binary_kind(head: bytes) -> str:
    """Return what a file is that is no text and what to do, by its first bytes; "" for a text.

    Zeros in every second byte alone are those of UTF-16, and those at the end of a buffer's.
    """
    for first, (kind, do) in KINDS.items():
        if head.startswith(first):
            return f"{kind}; {do}"
    head = head.rstrip(b"\0")
    fewer, more = sorted((head[::2].count(0), head[1::2].count(0)))
    is_wide = head[:2] in (b"\xff\xfe", b"\xfe\xff") or (5 * more > len(head) > 50 * fewer)
    n_control = len(head) - len(head.translate(None, CONTROL))
    is_text = is_wide or (n_control <= MOST_CONTROL * len(head) and b"\0" not in head)
    return "" if is_text else "a binary file of an unknown kind; export it as text"


def open_text(path: Path) -> IO[bytes]:
    """Open the bytes of a text file, unpacked if gzip packed them.

    Raises OSError, also for a damaged file, and UnreadableError if it is no text.
    """
    with path.open("rb") as file:
        is_packed = file.read(2) == GZIP
    # The caller closes it.
    opened = cast("IO[bytes]", gzip.open(path) if is_packed else path.open("rb"))  # noqa: SIM115
    try:
        if kind := binary_kind(opened.read(HEAD)):
            raise UnreadableError(f"Expected text, it is {kind}")
        opened.seek(0)
    except BaseException:
        opened.close()
        raise
    return opened


@contextmanager
def unpack_errors() -> Iterator[None]:
    """Context manager that raises UnreadableError for a packed file that is damaged."""
    message = "Cannot unpack it"
    with instead(UnreadableError, message, zlib.error, gzip.BadGzipFile):
        try:
            yield
        except EOFError as error:
            raise UnreadableError(f"{message}, the file is cut off") from error


def read_content(path: Path) -> bytes:
    """Return the bytes of a text file as `open_text` gives them.

    Raises UnreadableError, also for more than 128 MB and a packed file that is damaged.
    """
    with unpack_errors(), open_text(path) as file:
        content = file.read(LARGEST + 1)
    if len(content) > LARGEST:
        wanted = f"at most {LARGEST // 2**20} MB"
        raise UnreadableError(f"Expected {wanted}, got more; split it, or write Parquet")
    return content


def is_text(path: Path) -> bool:
    """Return whether a file can be read and is a text."""
    with suppress(OSError, EOFError, zlib.error, UnreadableError), open_text(path):
        return True
    return False


def read_frame(path: Path) -> tuple[pd.DataFrame, dict[int, str]] | None:
    """Read a Parquet or JSON file as a table; its rows count from 1. None for another suffix.

    JSON is a list of objects, an object on each line, one list of objects in an object, an object
    with lists of numbers, which is a single row, or an object that gives each name a label or an
    object. An index that has a name is a column of the table. Lines of objects that cannot be read
    are returned apart, each with what is wrong.

    Raises UnreadableError for a file that is none of these, and DataError if pyarrow is missing.
    """
    import pandas as pd

    wrong = dict[int, str]()
    if suffix_of(path) in PARQUET:
        with (
            read_errors(path, "a Parquet file", "pyarrow", "files"),
            instead(UnreadableError, "Expected a Parquet file", *UNREADABLE),
        ):
            content = path.read_bytes()
            if why := damage_of(content[:4], PARQUET_MAGIC, content.endswith(PARQUET_MAGIC)):
                raise ValueError(why)
            frame = pd.read_parquet(path)
        if any(frame.index.names):
            frame = frame.reset_index()
        frame = number_rows(frame)
    elif suffix_of(path) in JSON:
        with instead(UnreadableError, "Expected JSON, an object or a list of them", *UNREADABLE):
            content = path.read_bytes()
            kind = binary_kind(content[:HEAD])
            if kind and not content.startswith((b"[", b"{")):
                raise ValueError(f"it is {kind}")
            rows, wrong = _json_rows(content.decode("utf-8-sig"))
            frame = number_rows(pd.json_normalize(list(rows.values()))).set_axis(list(rows))
    else:
        return None
    if frame.empty:
        raise UnreadableError("Expected columns and rows, it is empty")
    return frame, wrong


def _json_rows(text: str) -> tuple[dict[int, dict[str, Any]], dict[int, str]]:
    """Return the rows in a JSON text by their numbers, and what is wrong with other lines.

    Raises ValueError if there are none.
    """
    try:
        rows = json.loads(text)
    except ValueError as error:
        in_lines, wrong = _json_lines(text)
        if len(in_lines) > len(wrong) or len(in_lines) == len(wrong) == 1:
            return in_lines, wrong
        why = "the file is cut off" if _is_open(text) else str(error)
        raise ValueError(why if text.strip() else "it is empty") from error
    if isinstance(rows, dict):
        items = [value[0] for value in rows.values() if isinstance(value, list) and value]
        if any(isinstance(item, int | float) for item in items):
            return {1: rows}, {}
        lists = [value for value in rows.values() if isinstance(value, list)]
        if lists and any(isinstance(value, str) for value in rows.values()):
            pieces = next(name for name, value in rows.items() if value in lists)
            if not any(lists):
                raise ValueError(f"the list {pieces} is empty")
            do = 'write one list of its samples, as in "force": [0.1, 0.2]'
            raise ValueError(f"it is one part in {len(rows[pieces])} pieces, {pieces}; {do}")
        named = [
            {"file": name, **(value if isinstance(value, dict) else {"label": value})}
            for name, value in rows.items()
        ]
        rows = lists[0] if len(lists) == 1 else named
    if not rows or not all(isinstance(row, dict) and row for row in rows):
        raise ValueError("it is none")
    return dict(enumerate(rows, start=1)), {}


def _json_lines(text: str) -> tuple[dict[int, dict[str, Any]], dict[int, str]]:
    """Return the objects in the lines of a text, and what is wrong with other lines."""
    rows = dict[int, dict[str, Any]]()
    wrong = dict[int, str]()
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
            if not isinstance(row, dict) or not row:
                raise ValueError(f"got {shortened(line)}")
            rows[number] = row
        except ValueError as error:
            why = "it is cut off" if _is_open(line) else str(error)
            wrong[number] = f"Expected an object in JSON, {why}"
    return rows, wrong


def _is_open(text: str) -> bool:
    """Return whether a JSON text begins with a bracket, and one never closes."""
    bare = JSON_STRING.sub("", text)
    n_open = sum(map(bare.count, "[{")) - sum(map(bare.count, "]}"))
    return text.lstrip()[:1] in ("[", "{") and n_open > 0


def number_rows(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a table whose columns have texts as names and whose rows count from 1."""
    return frame.set_axis(list(map(str, frame.columns)), axis=1).set_axis(range(1, len(frame) + 1))


def as_texts(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a table whose cells are texts as in a CSV file: "" for none, and 7 for 7.0."""

    def text(cell: Any) -> str:
        cell = cell.decode("utf-8", "replace") if isinstance(cell, bytes) else cell
        return f"{cell:.15g}" if isinstance(cell, float) else str(cell).strip()

    return frame.astype(object).where(frame.notna(), "").map(text)
