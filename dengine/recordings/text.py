"""Text files of separated values: their delimiter, their header, their lines; and the line that cannot be read."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from .dataset import UnreadableError

LARGEST = 256 * 2**20  # bytes of one text file
NOTHING = {"", "nan", "na", "n/a", "null", "none", "-nan"}  # a cell without a number: kept as NaN
Lines = list[tuple[int, str]]


def read_text(path: Path) -> str:
    """A file's text; UnreadableError for one that is empty, too large, or not UTF-8."""
    size = path.stat().st_size
    if size > LARGEST:
        raise UnreadableError(f"Expected at most {LARGEST // 2**20} MB, got {size // 2**20} MB; split it, or write Parquet")
    raw = path.read_bytes()
    if not raw.strip():
        raise UnreadableError("Expected a header and rows, it is empty")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise UnreadableError(
            f"Expected UTF-8 text, got the byte 0x{raw[error.start]:02x}; save it as UTF-8", line
        ) from error


def read_lines(path: Path) -> tuple[list[str], Lines, str]:
    """A file's header, its other lines with their numbers, without blank ones, and its delimiter."""
    lines = [(number, line) for number, line in enumerate(read_text(path).splitlines(), start=1) if line.strip()]
    delimiter = delimiter_of(lines[0][1] if lines else "")
    names = named_columns(lines[0][1], delimiter) if lines else []
    if not names:
        raise UnreadableError("Expected a header, the first line names no column", 1)
    return names, lines[1:], delimiter


def read_header(path: Path) -> list[str]:
    """The names in a file's first line; none where it has no such line."""
    with path.open("rb") as file:
        line = file.readline(2**20).decode("utf-8-sig", errors="replace")
    try:
        return named_columns(line, delimiter_of(line)) if line.strip() else []
    except UnreadableError:  # said when the whole file is read
        return []


def delimiter_of(line: str) -> str:
    """The one of comma, semicolon and tab that a header has most of."""
    return max(",;\t", key=line.count)


def split_line(line: str, delimiter: str) -> list[str]:
    """Its words, without blanks and quotes around them; a delimiter between quotes is part of a word."""
    try:
        words = next(csv.reader([line.rstrip("\r\n").replace("\0", "")], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error as error:  # a field of megabytes
        raise UnreadableError(f"Expected separated values, got a line of {len(line)} characters: {error}") from error
    return [word.strip().strip('"') for word in words]


def fitting(words: list[str], n: int) -> list[str]:
    """A line's words where they are n, but for empty ones that a comma at its end makes; UnreadableError elsewhere."""
    if len(words) < n or any(words[n:]):
        raise UnreadableError(f"Expected {n} columns, got {len(words)}")
    return words[:n]


def named_columns(line: str, delimiter: str) -> list[str]:
    """A header's names, without the empty ones that a comma at its end makes."""
    names = split_line(line, delimiter)
    while names and not names[-1]:
        names.pop()
    return names


def decimal_of(text: str, delimiter: str) -> str:
    """A comma where the columns are separated otherwise and numbers are written with one, as a German Excel does."""
    return "," if delimiter != "," and "," in text[text.find("\n") :] else "."


def find_fault(text: str, header: Sequence[str], wanted: Sequence[int], delimiter: str, decimal: str) -> None:
    """UnreadableError that names the first line with too few or too many columns, or no number where one is wanted."""
    for number, line in enumerate(text.splitlines()[1:], start=2):
        if not line.strip():
            continue
        try:
            words = fitting(split_line(line, delimiter), len(header))
        except UnreadableError as error:
            raise UnreadableError(error.what, number) from None
        for place in wanted:
            if not is_number(words[place].replace(decimal, ".")):
                raise UnreadableError(f"Expected a number in column {header[place]}, got {words[place][:20]!r}", number)


def is_number(word: str) -> bool:
    """Whether a cell holds a number, or says that it holds none."""
    if word.lower() in NOTHING:
        return True
    try:
        float(word)
    except ValueError:
        return False
    return True
