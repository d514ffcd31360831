"""What a file of a table is by its first bytes: text, packed text, Parquet, or something else.

`open_text` opens a text file, unpacked if it is packed by gzip, and refuses what is no text by its
kind. `read_frame` reads the tables that are no lines of text: Parquet, and JSON.
"""

from __future__ import annotations

import gzip
import json
import zlib
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

from ..errors import instead
from ..files import read_errors
from .dataset import UnreadableError

if TYPE_CHECKING:
    import pandas as pd

NPZ = ".npz"
PARQUET = (".parquet", ".pq")
JSON = (".json", ".jsonl", ".ndjson")
PACKED = ".gz"
GZIP = b"\x1f\x8b"
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


def read_content(path: Path) -> bytes:
    """Return the bytes of a text file as `open_text` gives them.

    Raises UnreadableError, also for more than 128 MB and a packed file that is damaged.
    """
    with (
        instead(UnreadableError, "Cannot unpack it", EOFError, zlib.error),
        open_text(path) as file,
    ):
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


def read_frame(path: Path, content: bytes = b"") -> pd.DataFrame | None:
    """Read a Parquet or JSON file as a table; its rows count from 1. None for another suffix.

    JSON is a list of objects, an object on each line, one list of objects in an object, an object
    with lists of numbers, which is a single row, or an object that gives each name a label or an
    object. An index that has a name is a column of the table.

    content : of the file, if it was read. Raises DataError for a file that is none of these.
    """
    import pandas as pd

    frame = None
    if suffix_of(path) in PARQUET:
        with read_errors(path, "a Parquet file", "pyarrow", "files"):
            frame = pd.read_parquet(path)
        if any(frame.index.names):
            frame = frame.reset_index()
    elif suffix_of(path) in JSON:
        with read_errors(path, "a list of JSON objects"):
            rows = _json_rows((content or path.read_bytes()).decode("utf-8-sig"))
            frame = pd.json_normalize(rows)
    if frame is not None and frame.empty:
        raise UnreadableError("Expected columns and rows, it is empty")
    return None if frame is None else number_rows(frame)


def _json_rows(text: str) -> list[dict[str, Any]]:
    """Return the rows in a JSON text; ValueError if there are none."""
    rows: Any = None
    with suppress(ValueError):
        rows = json.loads(text)
    if rows is None:
        rows = [json.loads(line) for line in text.splitlines() if line.strip()]
    if isinstance(rows, dict):
        items = [value[0] for value in rows.values() if isinstance(value, list) and value]
        if any(isinstance(item, int | float) for item in items):
            return [rows]
        lists = [value for value in rows.values() if isinstance(value, list)]
        if lists and any(isinstance(value, str) for value in rows.values()):
            pieces = next(name for name, value in rows.items() if value in lists)
            do = 'write one list of its samples, as in "force": [0.1, 0.2]'
            raise ValueError(f"it is one part in {len(rows[pieces])} pieces, {pieces}; {do}")
        named = [
            {"file": name, **(value if isinstance(value, dict) else {"label": value})}
            for name, value in rows.items()
        ]
        rows = lists[0] if len(lists) == 1 else named
    if not rows or not all(isinstance(row, dict) and row for row in rows):
        raise ValueError("it is none")
    return list(rows)


def number_rows(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a table whose columns have texts as names and whose rows count from 1."""
    return frame.set_axis(list(map(str, frame.columns)), axis=1).set_axis(range(1, len(frame) + 1))


def as_texts(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a table whose cells are texts as in a CSV file: "" for none, and 7 for 7.0."""

    def text(cell: Any) -> str:
        cell = cell.decode("utf-8", "replace") if isinstance(cell, bytes) else cell
        return f"{cell:.15g}" if isinstance(cell, float) else str(cell).strip()

    return frame.astype(object).where(frame.notna(), "").map(text)
