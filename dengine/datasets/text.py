"""Text files of numbers in the dialects that people's tools write: .csv, .tsv, .txt, .dat, .lvm.

`read_table` reads a file as a table of texts: it finds the delimiter, the header, the row of units
and the number format. `read_recording` makes a trace of one file, and `rows_to_trace`
of rows of any table.
"""

from __future__ import annotations

import csv
import itertools
import json
import os
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import excerpt, listed
from ..traces import is_time_column
from . import units
from .clocks import (
    DATE_FORM,
    EMPTY_CELLS,
    MAX_MISSING,
    MONTHS,
    NO_CLOCK,
    SUMMER_TIME,
    TIMESTAMP,
    WORD_DATE,
    Clock,
    check_even,
    check_rows,
    clock_of,
    floats,
    in_order_of_time,
    is_rising,
    join_date_and_time,
    lost_rows_text,
    place_of_clock,
    rate_contradiction,
    rate_in_preamble,
    rate_of,
    resample_evenly,
    rising_columns,
    same_time_text,
    shows_lost_rows,
    start_of,
    varies_all_along,
)
from .containers import as_texts, read_content, read_frame
from .curves import IN_LINE, UNQUOTED, write_curves
from .dataset import Fault, LoadOptions, Reading, Recording, UnreadableError
from .encodings import decode
from .numerals import is_numeral, write_as_python
from .scales import factors_in_columns, lines_of_factors

if TYPE_CHECKING:
    import pandas as pd

SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".lvm")
BESIDE = (".txt", ".json", ".ini", ".yaml", ".yml", ".meta", ".info", ".log")
SMALL = 2**14  # bytes of a file that tells of a recording
NUMBER_PREFIX = re.compile(r"\s*[+-]?\d*\.?\d*(?:(?<=\d)[eE][+-]?\d+)?")  # of a damaged number
# Of equally good ones the first is taken. " ": any blanks; "": one column.
DELIMITERS = ("\t", ";", "|", ",", " ", "")
SAMPLED_LINES = 30  # from the end, by which the delimiter is found
SAMPLED_CELLS = 40  # of each of these lines
# A word between blanks; a unit in brackets belongs to the name before it.
WORD = re.compile(r'"((?:[^"]|"")*)"|([^ \t"]+(?: +[\[(][^\])]*[\])])?)')
MIN_TIMES = 8  # in a header that names samples by their times, beside other columns
SUMMARY_SHARE = 10  # samples for each row of a summary below them, at least
REMARK = re.compile(r"^\s*(#+|%+|//+|\*+|--+|;+)\s*")  # by which programs mark a comment
# What a line outside the table is about: no number, no path.
FIELD_KEY = re.compile(r"[^\W\d][^\d:;=\\]{0,40}")
FIELD_MARK = re.compile(r"\s*[:;=\t,|]\s*")  # the first of them stands before the value
CELL_MARK = re.compile(r"[;,\t|]")
ROW_COUNT = re.compile(r"\(\d+ [^\W\d].*\)")  # what a database's client writes below a table
LABVIEW_END = "***End_of_Header***"
# A line alone behind the valid rows of a log, as //END: what stands below it is of former parts.
END_MARK = re.compile(
    r"\W*(eof|(data|file|log|records?)[ _-]?end|ende?([ _-]?(of|der)?[ _-]?(the |valid |all )*"
    r"(data|file|log|records?|recording|measurements?|samples|table|daten|datei|messung))?)\W*",
    re.IGNORECASE,
)
INFLUX_COLUMNS = {"result", "table"}  # in the header of each of InfluxDB's tables
COMMENT_COLUMNS = ("comment", "comments", "kommentar", "remark")
RATE_ABOVE = "none, a line above the header states the rate"
COUNTER_NAME = re.compile(
    r"(sample|index|idx|no|nr|n|i|row|point|count|number|nummer|zeile|messpunkt|punkt)"
    r"([se]|er|[ _-]?(no|nr|id|idx|number|\d{1,3}))?\.?",
    re.IGNORECASE,
)
SETTING = re.compile(r"(?:.*\W)?\d[\d.,]* ?k?Hz|")  # SR: 400 Hz, in a line that is no header
# In it no delimiter is looked for.
ONE_CELL = re.compile(
    rf"{IN_LINE}|(?:{WORD_DATE})(?: +\d\d?:\d\d(?::\d\d(?:[.,]\d+)?)?)?"
    rf"|(?:{DATE_FORM}) +\d\d?:\d\d(?::\d\d(?:\.\d+)?)?(?: *(?:UTC|[AaPp][Mm])\b)?"
)
DELIMITER_LINE = re.compile(r'"?sep=(.)"?', re.IGNORECASE)  # Excel's first line
# A cell of a row of units, beside the units that `units.parse` knows.
UNIT_CELL = re.compile(r"\[.*\]|\(.*\)|°C?|%|-|[\d.,]+ ?[mµun]?s|[\d.,]+ ?k?Hz|")
NUMBER_AND_UNIT = re.compile(
    r"(?P<number>(?:[-+−] *)?\d[\d.,]*([eE][-+]?\d+)?) *(?P<unit>[^\W\d][^\d:,;]*)"
)
# What stands where there is no number, as Bad Input, #N/A or C's 1.#QNAN: it has no digit, or a
# word before its first one, but for a code in brackets. A damaged number, as 12x5, is none.
STATUS = re.compile(r"\s*(?:\D+|\D*[^\W\d]{2}.*|\[-?\d+\] *[^\W\d]{2}.*|-?1\.#[A-Z]+)")
# What a spreadsheet makes of numbers, in its language: 01. Mrz of 1.3, Mrz 75 of 3.75.
MONTH_WORD = (
    rf"(?:{'|'.join(' '.join(MONTHS).split())}|mrt|maa|maj|sty|lut|kwi|cze|lip|sie|wrz|paz|paź"
    r"|lis|gru)[^\W\d_]{0,2}\.?"
)
SPREADSHEET_DATE = re.compile(
    rf"\s*(?:\d\d?[-./ ]+{MONTH_WORD}(?:[-./ ]+\d{{2,4}})?|{MONTH_WORD}[-./ ]+\d{{2,4}}"
    rf"|\d\d?月(?:\d\d?日)?|(?:{DATE_FORM})(?:[T ]\d\d?:\d\d(?::\d\d)?)?)\s*",
    re.IGNORECASE,
)
MOST = 0.8  # of a column's cells are numbers: the others are lost samples
# How a row of units states times of day: hh:mm:ss, HH:MM:SS.fff or mm:ss,0.
TIME_FORMAT = re.compile(r"(h{1,2}:)?m{1,2}:s{1,2}([.,:](f+|s+|m+|z+|x+|0+))?", re.IGNORECASE)


class TextCells(NamedTuple):
    """The cells of a text.

    header : list of str
        Names of the columns.
    line : int
        Line of the header, from 1.
    units : list of str
        Unit of each column, "" where the row of units states none.
    rows : dict of int to list of str
        The data rows by their line, without remarks, as a line //END or the header again.
    delimiter : str
    fields : dict of str to str
        What lines above the header and below the samples state, as `Result;OK` or `# Operator: A`.
    n_remarks : int
        Number of the lines that were left out below the header, or of all if it is not known.
    blocks : dict of int to str
        The lines of the header where it comes again, and the first, each with the time X0 that
        LabVIEW states above it, else ""; empty for one block.
    notes : tuple of str
        What users should know.
    """

    header: list[str]
    line: int
    units: list[str]
    rows: dict[int, list[str]]
    delimiter: str
    fields: dict[str, str]
    n_remarks: int = 0
    blocks: Mapping[int, str] = {}
    notes: tuple[str, ...] = ()


class TextTable(NamedTuple):
    """A text file as a table.

    frame : DataFrame
        Its index is the line of each row.
    faults : list of Fault
        What is wrong with lines that were left out.
    line : int
        Line of the header, from 1.
    units : list of str
        Unit of each column, "" where unknown.
    decimal : str
        The decimal mark that its cells prove, "" where they prove none.
    numbers : str
        As in `Reading`.
    fields : mapping of str to str
        As in `TextCells`.
    n_remarks : int
    blocks : mapping of int to str
        Both as in `TextCells`.
    rate_hz : float, optional
        That a line above the header states, or of a wide table whose samples have times.
    offer : str
        A note on a line above the header that may state the rate; "" for none.
    clock : str
        What tells the rate, as in `Reading`.
    notes : tuple of str
        What users should know, as of units that were converted.
    cut_line : int
        Line of the last row if it is cut off, which is among the faults; 0 for none.
    factors : mapping of str to float
        Of the lines above the samples, as in `Recording`.
    preamble : str
        The lines above the samples, with the header.
    column_of : mapping of int to str
        The column of the file that each row was, if rows and columns were exchanged.
    wrong : mapping of int to UnreadableError
        What is wrong in such a row, with the line of the file.
    """

    frame: pd.DataFrame
    faults: list[Fault]
    line: int
    units: list[str]
    decimal: str
    numbers: str = ""
    fields: Mapping[str, str] = {}
    n_remarks: int = 0
    blocks: Mapping[int, str] = {}
    rate_hz: float | None = None
    offer: str = ""
    clock: str = RATE_ABOVE
    notes: tuple[str, ...] = ()
    cut_line: int = 0
    factors: Mapping[str, float] = {}
    preamble: str = ""
    column_of: Mapping[int, str] = {}
    wrong: Mapping[int, UnreadableError] = {}


def split_cells(text: str, columns: Sequence[str] = (), channels: Sequence[str] = ()) -> TextCells:
    """Split a text into cells; blank lines are left out.

    A first line sep=; states the delimiter, which is found otherwise. What stands above LabVIEW's
    first header is left out. Raises UnreadableError for a cell of more than 131,072 characters,
    LabVIEW's blocks of different columns, and numbers without a header; the header of an empty text
    is empty.

    columns : names of the columns, if the file has no header or another one.
    channels : names that the header has, as users state them, if several lines may be it.
    """
    lines = {i: line for i, line in enumerate(text.splitlines(), start=1) if line.strip()}
    lines = {
        i: UNQUOTED.sub(r'"\g<0>"', line) if "[" in line else line for i, line in lines.items()
    }
    end = _end_of_head(lines)
    top = {i: line for i, line in lines.items() if i <= end}
    lines = {i: line for i, line in lines.items() if i > end}
    stated = DELIMITER_LINE.fullmatch(next(iter(lines.values()), "").strip())
    if stated:
        del lines[min(lines)]
    try:
        delimiter = stated[1] if stated else _find_delimiter(list(lines.values()))
        split = {i: _split_line(line, delimiter) for i, line in (top | lines).items()}
    except csv.Error as error:
        raise UnreadableError(f"Expected separated values, got others: {error}") from error
    rows = _under_one_header({i: row for i, row in split.items() if i > end and any(row)})
    _check_blocks_of_labview(rows)
    if _is_horizontal(rows.values()):
        rows = dict(enumerate(map(list, zip(*rows.values(), strict=True)), start=1))
    cells = None if columns else _beside_settings(rows, delimiter)
    if cells is None:
        named_rows = _names_and_units_of_keys(rows)
        cells = _find_header(named_rows, delimiter, list(columns), channels)
    first = min(cells.rows, default=0)
    above = {i: split[i] for i in top} | {i: row for i, row in rows.items() if i < first}
    below = {i: rows.get(i, row) for i, row in cells.rows.items()}  # with LabVIEW's comments
    blocks, heads = _find_blocks(cells.line, above, below)
    remarks, stale = _remarks(cells, heads)
    out = remarks | stale
    last = max(cells.rows.keys() - out, default=0)
    begin = cells.line or first  # without a header of its own
    outside = [line for i, line in lines.items() if i < begin or (i > last and i not in stale)]
    return cells._replace(
        rows={i: row for i, row in cells.rows.items() if i not in out},
        fields=cells.fields | _fields_in(outside),
        n_remarks=len(out) + (0 if cells.line else len(above)),
        blocks=blocks,
        notes=(
            *_tables_in(list(above.values())),
            *(["Rows below a line that marks the end, as //END, are left out"] if stale else []),
        ),
    )


def _tables_in(above: Sequence[list[str]]) -> list[str]:
    """Return a note on each table among the rows above the header that is read.

    It has names and, below them, eight rows of numbers or more.
    """
    notes = []
    n_rows = width = 0
    for row in reversed(above):
        if 0 in _numeric_columns(row):
            n_rows = n_rows + 1 if len(row) == width else 1
            width = len(row)
            continue
        if n_rows >= MIN_TIMES and len(row) == width > 1 and not any(map(_is_value, row)):
            text = f"Not read: {n_rows} rows of another table, which has the columns"
            notes.append(f"{text} {listed(row)}")
        n_rows = 0
    return notes


def _end_of_head(lines: Mapping[int, str]) -> int:
    """Return the line of the last ***End_of_Header*** above LabVIEW's first samples, 0 for none."""
    end = 0
    for i, line in lines.items():
        if line.startswith(LABVIEW_END):
            end = i
        elif end and not (line[0].isalpha() or line[0] in '*"'):
            break
    return end


def _check_blocks_of_labview(rows: Mapping[int, list[str]]) -> None:
    """Raise UnreadableError if LabVIEW's blocks have different columns, given those from the first
    header on.
    """
    headers = {next(iter(rows), 0): next(iter(rows.values()), [])}
    for (_, row), (line, below) in itertools.pairwise(rows.items()):
        if row[0].startswith(LABVIEW_END):
            headers[line] = below
    for line, header in headers.items():
        if header != (first := next(iter(headers.values()))):
            actual = f"{len(headers)} blocks: line {min(headers)} has {listed(first)}, this one"
            do = "write each block into a file of its own"
            raise UnreadableError(
                f"Expected blocks of the same columns, got {actual} {listed(header)}; {do}", line
            )


def _find_blocks(
    line: int, above: Mapping[int, list[str]], below: Mapping[int, list[str]]
) -> tuple[dict[int, str], set[int]]:
    """Return X0 by the line of each header (`TextCells.blocks`; {} for one block), and the lines
    of the heads of later blocks.

    A head is the header, the lines above it whose first cell, digits aside, stands above the first
    header too, and the lines below it, as of units, that equal those of the first.

    line : of the first header, 0 if unknown. above : rows before the first data. below : the rest.
    """
    rows = list(below.values())
    lines = list(below)
    n_filled = {i: sum(map(bool, row)) for i, row in above.items()}
    line = line or max(above, key=lambda i: (n_filled[i], i), default=0)
    names = above.get(line, [])
    first_head = list(above.values())
    keys = {_head_key(row) for row in above.values()} - {""}
    blocks = {line: _x0_in(first_head)}
    heads = set[int]()

    def is_in_head(row: list[str]) -> bool:
        """Return whether a row above a header belongs to the head, and is no data."""
        is_data = _is_value(row[0]) == _is_value(rows[0][0])
        is_data = is_data and _numeric_columns(row) == _numeric_columns(rows[0])
        return row in first_head or (_head_key(row) in keys and not is_data)

    for k in [k for k, row in enumerate(rows) if row == names]:
        start = k
        while start and is_in_head(rows[start - 1]):
            start -= 1
        stop = k + 1
        while stop < len(rows) and rows[stop] in first_head:
            stop += 1
        blocks[lines[k]] = _x0_in(rows[start:k])
        heads.update(lines[start:stop])
    return blocks if len(blocks) > 1 else {}, heads


def _head_key(row: Sequence[str]) -> str:
    """Return the first cell of a row with 0 for its numbers, "" for one without letters."""
    key = re.sub(r"\d+", "0", row[0].lower())
    return key if any(map(str.isalpha, key)) else ""


def _x0_in(head: Iterable[Sequence[str]]) -> str:
    """Return the time of the first sample that LabVIEW states in the head of a block, or ""."""
    return next((row[1] for row in head if row[0] == "X0" and len(row) > 1), "")


def _under_one_header(rows: dict[int, list[str]]) -> dict[int, list[str]]:
    """Return the rows of InfluxDB's tables, one below the other, with the columns of all of them.

    Each has a header with the columns result and table. Other rows, and those of tables with equal
    headers, are returned as they are.
    """
    headers = [row for row in rows.values() if {*row} >= INFLUX_COLUMNS]
    names = list(dict.fromkeys(name for header in headers for name in header))
    if all(header == names for header in headers):
        return rows
    united = dict[int, list[str]]()
    header = headers[0]
    for i, row in rows.items():
        header = row if row in headers else header
        cells = dict(zip(header, row, strict=False))
        united[i] = names if row is header else [cells.get(name, "") for name in names]
    return united


def _is_horizontal(rows: Collection[Sequence[str]]) -> bool:
    """Return whether a text has a line of times and one of samples for each channel.

    Each begins with a name, the first with that of a clock, and goes on with numbers.
    """
    n = {len(row) for row in rows}
    if len(n) != 1 or not 1 < len(rows) < min(n):
        return False
    is_named = all(row[0] and not _numeric_columns(row[:1]) for row in rows)
    is_number = all(len(_numeric_columns(row)) == min(n) - 1 for row in rows)
    return is_named and is_number and is_time_column(next(iter(rows))[0])


def _names_and_units_of_keys(rows: dict[int, list[str]]) -> dict[int, list[str]]:
    """Return the rows of a text without those of keys above samples, but for the names and units.

    So Yokogawa's recorders write: a key such as "TraceName", "VUnit" or "Date" and its value for
    each channel stand above samples that leave the column of the keys empty. Other rows are
    returned as they are.
    """
    keys = {row[0].lower(): i for i, row in reversed(rows.items()) if row[0]}
    has_samples = rows and not any(row[0] for row in list(rows.values())[-SAMPLED_LINES:])
    names = max((i for key, i in keys.items() if key.endswith("name")), default=0)
    if not (has_samples and names) or any(map(_is_value, keys)):
        return rows
    units_line = min((i for key, i in keys.items() if key.endswith("unit")), default=names)
    kept = {i: row for i, row in rows.items() if not row[0]}
    return {i: ["", *rows[i][1:]] for i in (names, units_line)} | kept


def _beside_settings(rows: dict[int, list[str]], delimiter: str) -> TextCells | None:
    """Return the samples of an oscilloscope that writes its settings beside them, without a header.

    So Tektronix writes: "Source" or "Sample Interval" and its value are in the first columns of the
    first rows, times and samples in the last two columns of all. The channel is named as the
    source, "Value" if none is stated. None for any other text.
    """
    last = next(reversed(rows.values()), [])
    n = next((i for i, cell in enumerate(last) if cell), 0)
    fields = {row[0].strip(": "): row[1] for row in rows.values() if 1 < n < len(row) and row[0]}
    by_key = {key.lower(): value for key, value in fields.items()}
    samples = {i: _without_trailing_empty(row[n:]) for i, row in rows.items()}
    has_header = _numeric_columns(next(iter(samples.values()), [])) != {0, 1}
    if has_header or by_key.keys().isdisjoint(("source", "sample interval")):
        return None
    stated = [by_key.get(f"{axis} units", "") for axis in ("horizontal", "vertical")]
    names = ["Time", by_key.get("source") or "Value"]
    return TextCells(names, 0, _pad_units(stated, 2), samples, delimiter, fields)


def _remarks(cells: TextCells, heads: Collection[int]) -> tuple[set[int], set[int]]:
    """Return the line numbers of rows below the header that are no data, and of stale rows.

    Five kinds of rows are no data: the heads of blocks; marks of the end, as `//END`; rows that
    begin with a comment mark and have no numbers; rows in which only the first cell is filled, with
    a word or as `(90 rows affected)`; and, behind all data, rows of a name and a value, as
    `Result;OK`, in a table of more columns. In a table of one column only the first two count.

    Others are stale if they stand below a mark of the end, up to the head of the next block.
    """
    remarks = set(heads)
    below = set[int]()
    is_below = False
    for i, row in cells.rows.items():
        if i in heads:
            is_below = False
        elif END_MARK.fullmatch(" ".join(filter(None, row))):
            is_below = True
            remarks.add(i)
        elif is_below:
            below.add(i)
    is_at_end = True
    for i, row in reversed(cells.rows.items()):
        words = list(filter(None, row))
        is_word = words == row[:1] and not any(map(str.isdigit, row[0]))
        is_word |= words == row[:1] and ROW_COUNT.fullmatch(row[0]) is not None
        is_comment = REMARK.match(row[0]) is not None and not _numeric_columns(row)
        is_field = is_at_end and len(words) == 2 and (i in below or len(cells.header) > 2)
        is_field = is_field and FIELD_KEY.fullmatch(row[0]) is not None
        if len(cells.header) > 1 and (is_word or is_comment or is_field):
            remarks.add(i)
        elif i not in remarks | below:
            is_at_end = False
    return remarks, below - remarks


def _fields_in(lines: Iterable[str]) -> dict[str, str]:
    """Return the values that lines outside the table state, by name; of a name the first counts.

    A line is read as name and value: `Result: OK`, `# Result = OK` or `Result;OK`. The marks
    between them are `: ; = , |` and tab. A value ends at the next mark: it is 12 in
    `Start: 12:30:05`, and 3 in `Force: 3,5`. A name has no digits and at most 41 characters; empty
    values are passed over.

    If the next line has as many cells (between `; , |` or tabs), each cell is also read as the name
    of the cell below it. A line of three or more names is read in this way alone.
    """
    texts = [REMARK.sub("", line.strip().strip("\"'")) for line in lines]
    rows = [[cell.strip(" \"'") for cell in CELL_MARK.split(text)] for text in texts]
    fields = dict[str, str]()
    for text, row, below in zip(texts, rows, [*rows, []][1:], strict=True):
        is_above = 1 < len(row) == len(below)
        are_names = is_above and len(row) > 2 and all(map(FIELD_KEY.fullmatch, row))
        name, *values = (cell.strip(" \"'") for cell in FIELD_MARK.split(text))
        value = next(filter(None, values), "")
        if FIELD_KEY.fullmatch(name) and value and not are_names:
            fields.setdefault(name, value)
        for key, cell in zip(row, below, strict=True) if is_above else ():
            if FIELD_KEY.fullmatch(key) and cell:
                fields.setdefault(key, cell)
    return fields


def fields_beside(path: Path) -> dict[str, str]:
    """Return what a small file beside a recording states, as `result.txt` or a .json of its name.

    It has the same name with another suffix, or both are alone in a folder. Files that cannot be
    read are passed over.
    """
    others = [path.with_suffix(suffix) for suffix in BESIDE if suffix != path.suffix.lower()]
    with suppress(OSError, UnreadableError):
        with os.scandir(path.parent) as entries:  # not all: there may be thousands
            inside = [Path(entry.path) for entry in itertools.islice(entries, 3)]
        if len(inside) == 2:
            others += [
                other for other in inside if other.suffix.lower() in BESIDE and other != path
            ]
        for other in others:
            if other.is_file() and other.stat().st_size < SMALL:
                text, _ = decode(other.read_bytes())
                if other.suffix.lower() == ".json":  # a line for each field, however it was written
                    with suppress(ValueError):
                        text = json.dumps(json.loads(text), indent=1, ensure_ascii=False)
                return _fields_in(text.splitlines())
    return {}


def _split_line(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line, stripped of blanks and quotes (of double ones alone for " ").

    The delimiter " " means any blanks, but a name and a bracketed unit after it, as in "Force [N]",
    are one cell; "" means that the line is one cell.
    """
    if delimiter == "":
        return [line.strip().strip("\"'")]
    if delimiter == " ":
        return [quoted.replace('""', '"') or plain for quoted, plain in WORD.findall(line)]
    row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    return [cell.strip().strip("'") for cell in row]


def _find_delimiter(lines: Sequence[str]) -> str:
    """Return the delimiter that splits lines best.

    It gives the most cells that are numbers, times or empty, the same number of cells in each line,
    and a header with as many. Without such cells it is the first that splits most lines, of tab,
    semicolon, bar and comma; "," if none does.
    """
    plain = [units.COMMENT_MARK.sub("", ONE_CELL.sub("0", line)) for line in lines[:100]]
    top = plain[: len(lines) - 1]
    sample = [
        units.COMMENT_MARK.sub("", ONE_CELL.sub("0", line)) for line in lines[-SAMPLED_LINES:]
    ]

    def score(delimiter: str) -> float:
        """Return how well a delimiter splits the lines, from 0 to 1."""
        if delimiter not in ("", " ") and not any(delimiter in line for line in sample):
            return 0.0
        rows = [_split_line(line, delimiter) for line in sample]
        width, n_rows = Counter(map(len, rows)).most_common(1)[0]
        if width == 1 and delimiter:
            return 0.0
        # The rows of data alone may end in a delimiter.
        n_names = width if rows[0][-1:] != [""] else width - 1
        cells = [cell for row in rows if len(row) == width for cell in row[:SAMPLED_CELLS]]
        n_values = sum(_is_value(cell) or _has_unit(cell) for cell in cells)
        headers = (_without_trailing_empty(_split_line(line, delimiter)) for line in top)
        has_header = any(
            2 * sum(map(_is_value, row[:SAMPLED_CELLS])) <= min(len(row), SAMPLED_CELLS)
            for row in headers
            if len(row) - _ends_in_comment(row) in (n_names, width)
        )
        return n_values / len(cells) * n_rows / len(rows) * (1.0 if has_header else 0.5)

    scores = {delimiter: score(delimiter) for delimiter in DELIMITERS} if lines else {"": 0.0}
    best = max(scores.values())
    if best > 0:
        return next(delimiter for delimiter in DELIMITERS if scores[delimiter] > 0.98 * best)
    for delimiter in "\t;|," if sample else "":
        widths = Counter(len(_split_line(line, delimiter)) for line in sample)
        if widths.most_common(1)[0][0] > 1:
            return delimiter
    return ","


def _ends_in_comment(names: Sequence[str]) -> bool:
    """Return whether the last name of a header is that of a column of comments."""
    return bool(names) and names[-1].lower() in COMMENT_COLUMNS


def _has_unit(cell: str) -> bool:
    """Return whether a cell is a number with a known unit, as 56.5 N."""
    match = NUMBER_AND_UNIT.fullmatch(cell)
    return match is not None and units.parse(match["unit"]) is not None


def _is_value(cell: str) -> bool:
    """Return whether a cell is a number, a time, or empty."""
    is_number = is_numeral(cell)
    return is_number or TIMESTAMP.fullmatch(cell) is not None or cell.lower() in EMPTY_CELLS


def _without_trailing_empty(row: list[str]) -> list[str]:
    """Return a row without the empty cells ("") at its end."""
    n = len(row)
    while n and not row[n - 1]:
        n -= 1
    return row[:n]


def _is_unit(cell: str) -> bool:
    """Return whether a cell may stand in a row of units; empty ones may."""
    is_form = UNIT_CELL.fullmatch(cell) is not None or TIME_FORMAT.fullmatch(cell) is not None
    return is_form or units.parse(units.spelling(cell)) is not None


def _find_header(
    rows_by_line: dict[int, list[str]],
    delimiter: str,
    columns: list[str],
    channels: Sequence[str],
) -> TextCells:
    """Find the header, the row of units and the data among the rows of a text.

    What stands above the header is left out. Of several lines that may be the header, it is that
    with the stated channels, else that above a row of units. If two lines stand above the data and
    the first can be the header, it is the header, and the second is a damaged row; a first line in
    which a name occurs twice, as of groups of columns, or that states a field, cannot be. In a
    header of evenly rising times, as that of a wide table, these are replaced by 0, 1, 2, ...
    Raises UnreadableError for numbers without a header if no `columns` are given; without rows the
    header is empty.
    """
    lines = list(rows_by_line)
    rows = list(rows_by_line.values())
    if not columns and (last := _header_at_end(rows, channels)) is not None:
        return TextCells(rows[last], lines[last], [""] * len(rows[last]), {}, delimiter, {})
    last_rows = (rows if columns else rows[1:])[-20:]
    usual = Counter(map(_numeric_columns, last_rows)).most_common(1)
    numeric = usual[0][0] if usual else frozenset()
    data = _first_data(rows, last_rows, numeric)
    above = [_without_comment_mark(row, delimiter) for row in rows[: max(data, 1)]]
    above[-1:] = _without_names_among_units(above[-2:], numeric)
    is_units = [any(row) and all(map(_is_unit, row)) for row in above]
    header = max(data - 1 - (data > 1 and is_units[-1]), 0)
    titles = _titles_above_columns(above, len(rows[data])) if header > 1 else None
    chosen = _header_among(above, is_units, rows[data : data + 1], channels, titles)
    if chosen is not None:
        header = chosen
    elif header == 1 and len(rows[0]) >= len(rows[data]):
        if not (is_units[0] or _is_no_header(*rows[:2], *above[:2])):
            header = data = 0
    elif titles is not None and not (titles == header and is_units[-1]):
        header = data = titles
    if not columns and above and _numeric_columns(above[header]):
        header, data = _true_header(above, is_units, header, data)
    below = range(header + 1, min(data, len(above)))
    units_row = next((above[i] for i in below if is_units[i]), [])
    line = 0
    names = columns
    if columns and data:
        units_row = _units_of_columns(above, is_units, len(columns))
    if not columns:
        header, names, units_row = _names_in(above, header, units_row, rows[data : data + 2])
        line = lines[header] if lines else 0
        names = _without_times(names, rows, line)
        data = max(data, 1)
    data_rows = dict(zip(lines[data:], rows[data:], strict=True))
    n_narrower = sum(len(row) < len(names) for row in data_rows.values())
    if _ends_in_comment(names) and 2 * n_narrower > len(data_rows):
        names = names[:-1]  # LabVIEW's, which most of its rows leave out
        data_rows = {i: row[: len(names)] for i, row in data_rows.items()}
    return TextCells(names, line, _pad_units(units_row, len(names)), data_rows, delimiter, {})


def _header_at_end(rows: Sequence[list[str]], channels: Sequence[str]) -> int | None:
    """Return the position of a header with no row below it but units; None if there is none.

    It is the only row that names the stated channels, and has no numbers.
    """

    def is_header(row: list[str]) -> bool:
        named = all(units.find_columns(name, row) for name in channels)
        return named and not _numeric_columns(row)

    n = len(rows) - (len(rows) > 1 and all(map(_is_unit, rows[-1])))
    is_last = n > 1 and bool(channels) and is_header(rows[n - 1])
    return n - 1 if is_last and not any(map(is_header, rows[: n - 1])) else None


def _header_among(
    above: list[list[str]],
    is_units: list[bool],
    first: list[list[str]],
    channels: Sequence[str],
    titles: int | None,
) -> int | None:
    """Return the position of the header if lines that are neither units nor data stand below it.

    It is the last line with the stated channels, below which no numbers stand. Without any, and
    without `titles`, it is the line above the last row of units, as catman writes it above
    "Kanal 1" and "SR: 400 Hz", or above such a line of rates. Else the result is None.

    first : the first row of data, if there is any.
    """
    widths = {len(_without_trailing_empty(row)) for row in (*above[-1:], *first)}
    numbers = [i for i, row in enumerate(above) if _numeric_columns(row)]
    below_numbers = range(max(numbers, default=-1) + 1, len(above))
    names = []
    for i in below_numbers:
        words = _without_trailing_empty(above[i])
        if len(words) in widths and all(words) and not is_units[i]:
            names.append(i)
    if channels:
        for i in reversed(names):
            if all(units.find_columns(name, above[i]) for name in channels):
                return i
    if titles is not None or not above or (is_units[-1] and not _is_setting(above[-1])):
        return None
    for i in reversed(below_numbers):
        stated = _pad_units(above[i], len(above[i]))
        if is_units[i] and i - 1 in names and any(map(units.parse, stated)):
            return i - 1
    plain = [i for i in names if not _is_setting(above[i])]
    return max(plain, default=None) if _is_setting(above[-1]) else None


def _is_setting(row: Sequence[str]) -> bool:
    """Return whether all cells of a row state a rate, as "SR: 400 Hz" or 400 Hz, or are empty."""
    return any(row) and all(map(SETTING.fullmatch, row))


def _units_of_columns(above: list[list[str]], is_units: list[bool], n: int) -> list[str]:
    """Return the units that the lines above the data state for n columns that the user names.

    They are in a row of units, or in the names of a header that is not used.
    """
    for row, is_row_of_units in zip(reversed(above), reversed(is_units), strict=True):
        stated = row if is_row_of_units else [units.split(name)[1] for name in row]
        if len(_without_trailing_empty(row)) == n and any(map(units.parse, _pad_units(stated, n))):
            return stated
    return []


def _first_data(rows: list[list[str]], last_rows: list[list[str]], numeric: Collection[int]) -> int:
    """Return the index of the first row of data; 0 also if there is none.

    A row is data if it has numbers in most of the columns that are numeric in the last rows, a
    digit in a time column if these have one (`CH,,0001,0002` has none), and is no wider than these.
    """
    width = max(map(len, last_rows), default=0)
    clocks = _columns_of_times(last_rows) - set(numeric)
    for k, row in enumerate(rows):
        is_timed = any(any(map(str.isdigit, row[i])) for i in clocks if i < len(row))
        is_numeric = 2 * len(_numeric_columns(row) & set(numeric)) > len(numeric)
        if is_numeric and len(row) <= width and (is_timed or not clocks):
            return k
    return 0


def _columns_of_times(rows: Sequence[Sequence[str]]) -> set[int]:
    """Return the positions of the columns that have two digits or more in every row."""
    n = min(map(len, rows), default=0)
    return {i for i in range(n) if all(sum(map(str.isdigit, row[i])) > 1 for row in rows)}


def _is_no_header(
    first_row: list[str], second_row: list[str], first: list[str], second: list[str]
) -> bool:
    """Return whether the second of two lines above the data is the header, and the first is none.

    The first is a remark, names groups of columns, or states a field.

    first, second : the lines without a comment mark.
    """
    is_comment = units.COMMENT_MARK.match(first_row[0]) is not None
    groups = list(filter(None, first_row))
    has_groups = len(set(groups)) < len(groups)
    has_groups |= len(groups) < len(second) > len({*second}) and all(second)
    is_remark = is_comment and not _numeric_columns(second_row)
    return has_groups or is_remark or _is_field_above(first, second)


def _is_field_above(first: list[str], second: list[str]) -> bool:
    """Return whether the first of two lines is a title or a field, as `Result;OK`, above a header.

    Then the second is of names alone, and has more clocks and units than the first, or this has a
    value, or is but one cell.
    """
    words = _without_trailing_empty(first)
    names = _without_trailing_empty(second)
    is_field = len(words) == 1 or any(map(_is_value, words[1:]))
    is_field |= _n_measured(names) > _n_measured(words)
    has_mark = len(words) == 1 and len(FIELD_MARK.split(words[0])) > 1
    return is_field and (len(names) > 1 or has_mark) and not any(map(_is_value, names))


def _without_names_among_units(last: list[list[str]], numeric: Collection[int]) -> list[list[str]]:
    """Return the last row above the data, with units alone if it states those of the row above it.

    Graphtec's second row has units for most columns of numbers, and beside them names again, as
    `NO.,Time,ms,N,A1234` below `Number,Date&Time,ms,CH1,Alarm`. Any other row stays as it is.

    last : the last two rows above the data, or fewer.
    numeric : positions of the columns of numbers.
    """
    if len(last) < 2 or len(last[0]) != len(last[1]):
        return last[-1:]
    names, words = last
    measured = [i for i in numeric if i < len(words) and not COUNTER_NAME.fullmatch(names[i])]
    n_units = sum(words[i] != "" and _is_unit(words[i]) for i in measured)
    are_names = all(names) and len({*names}) == len(names) and not any(map(_is_value, names))
    is_more = n_units > sum(_is_unit(names[i]) for i in measured)
    if are_names and is_more and 2 * n_units > len(measured):
        return [[word if _is_unit(word) else "" for word in words]]
    return [words]


def _n_measured(names: Sequence[str]) -> int:
    """Return how many names of a row are those of clocks, or state a unit."""
    return sum(is_time_column(name) or units.split(name)[1] != "" for name in names)


def _names_in(
    above: list[list[str]], header: int, units_row: list[str], first: Sequence[Sequence[str]]
) -> tuple[int, list[str], list[str]]:
    """Return the position of the header above the data, the names in it, and the units.

    TwinCAT Scope writes two columns for each channel: the first, its clock, is named "Time" here.
    Its unit is ms if its first step is the stated SampleTime[ms].
    In other files with a row of groups above the header, a name that occurs twice gets the name of
    its group before it, except that of a clock.
    """
    names = above[header] if above else []
    if pairs := [row for row in above if _are_pairs(row)]:
        by_key = {row[0].lower(): row for row in reversed(pairs)}
        names = [name if i % 2 else "Time" for i, name in enumerate(pairs[0])]
        units_row = [unit if i % 2 else "" for i, unit in enumerate(by_key.get("unit", []))]
        units_row += [""] * (len(names) - len(units_row))
        steps = by_key.get("sampletime[ms]", [])
        for i in range(1, min(map(len, (names, steps, *first))), 2):
            with suppress(ValueError):
                times = [float(row[i - 1].replace(",", ".")) for row in first]
                is_confirmed = bool(np.isclose(times[-1] - times[0], float(steps[i])))
                units_row[i - 1] = "ms" if is_confirmed else ""
        return above.index(pairs[0]), names, units_row
    groups = above[header - 1] if header else []
    if len(groups) == len(names) > len({*names}):
        filled = [""]
        for group in groups:
            filled.append(group or filled[-1])
        names = [
            f"{group} {name}".strip()
            if names.count(name) > 1 and not is_time_column(name)
            else name
            for group, name in zip(filled[1:], names, strict=True)
        ]
    return header, names, units_row


def _without_times(names: list[str], rows: list[list[str]], line: int) -> list[str]:
    """Return the names of a header, of which evenly rising times are replaced by 0, 1, 2, ...

    Whole numbers may be names, and stay. Raises UnreadableError, with the header's line, if most of
    the names are other numbers, or times and numbers are in the same columns as in the row below:
    then there is no header.

    rows : all rows of the text, for advice.
    """
    numbered = _numeric_columns(names)
    if all(names[i].isdecimal() for i in numbered):
        return names
    is_even = MIN_TIMES <= len(numbered) < len(names)
    if is_even and _are_even(names[i] for i in sorted(numbered)):
        numbers = itertools.count()
        return [str(next(numbers)) if i in numbered else name for i, name in enumerate(names)]
    below = next((row for row in rows if row != names), [])
    # A time and a number, as in the row below it: the header is samples.
    is_like_below = numbered == _numeric_columns(below)
    is_like_below = is_like_below and bool(_columns_of_times([names, below]) - numbered)
    if is_like_below or 2 * len(numbered) > sum(map(bool, names)):
        message = f"Expected a header, its first line is of numbers; {_columns_advice(rows)}"
        raise UnreadableError(message, line)
    return names


def _are_pairs(row: Sequence[str]) -> bool:
    """Return whether a row has one word before a name of each channel, as `Name fx Name fz`.

    So TwinCAT Scope writes it: in the rows of samples a time stands before each value.
    """
    return len(row) > 2 and len(row) % 2 == 0 and row[0] != "" and len({*row[::2]}) == 1


def _titles_above_columns(above: Sequence[Sequence[str]], n: int) -> int | None:
    """Return how many rows of titles stand above those that tell something of each of n columns.

    Such rows, two or more, stand above the data in a table with a column for each part. The first
    must tell the columns apart. None for any other table.
    """
    is_full = [all(row[1:]) and len(row) == n for row in above]
    titles = max((i for i, is_row_full in enumerate(is_full, 1) if not is_row_full), default=0)
    if n <= MIN_TIMES or titles > len(above) - 2 or len({*above[titles]}) < n:
        return None
    return titles


def _true_header(
    above: list[list[str]], is_units: list[bool], header: int, data: int
) -> tuple[int, int]:
    """Return the positions of the header and of the first row of data.

    A row in which some cells are numbers, and one above it of as many names, is damaged data.

    above, is_units : the rows above the data, and whether they are of units.
    header, data : the positions found so far, which are returned where no such row is.
    """
    row = above[header]
    if len(_numeric_columns(row)) == len(row):
        return header, data
    for i, names in enumerate(above[:header]):
        if len(names) == len(row) and all(names) and not _numeric_columns(names):
            return i, i + 1 + is_units[i + 1]
    return header, data


def _are_even(cells: Iterable[str]) -> bool:
    """Return whether numbers as texts rise by steps that are equal to 1 %."""
    try:
        numbers = [float(cell.replace(",", ".")) for cell in cells]
    except ValueError:  # as 1.234,5, which is no time
        return False
    steps = np.diff(numbers)
    return bool(steps[0] > 0) and bool(np.ptp(steps) < 0.01 * steps[0])


def _numeric_columns(row: Sequence[str]) -> frozenset[int]:
    """Return the positions at which a row has numbers, or nan."""
    return frozenset(i for i, cell in enumerate(row) if is_numeral(cell) or cell.lower() == "nan")


def _without_comment_mark(row: list[str], delimiter: str) -> list[str]:
    """Return a header without the # or % by which another program takes it for a comment."""
    first = units.COMMENT_MARK.sub("", row[0])
    if not first and delimiter == " ":
        return row[1:]  # in `# time fx` the mark is a word of its own
    return [first, *row[1:]]


def _pad_units(units_row: list[str], n: int) -> list[str]:
    """Return a row of units without brackets, as n units, "" for each that is missing."""
    plain = [units.spelling(cell.strip("[](){} ")) for cell in units_row[:n]]
    return plain + [""] * (n - len(plain))


def _columns_advice(rows: list[list[str]]) -> str:
    """Return advice, for an error, on how to name the columns of a file without a header."""
    n = len(rows[0])
    complete = [row for row in rows[:200] if len(row) == n]
    first = [row[0].replace(",", ".") for row in complete]
    names = [f"c{i}" for i in range(n)]
    if n > MIN_TIMES:  # as a wide table
        is_labelled = {row[-1] for row in complete} == {"0", "1"}
        names = [f"c0..c{n - 2}", "label"] if is_labelled else [f"c0..c{n - 1}"]
    with suppress(ValueError):
        if is_rising(np.array(first, dtype=np.float64)):
            names[0] = names[0].replace("c0..", "time,c1..") if n > MIN_TIMES else "time"
    return f"write one above, or name its {n} columns, columns={','.join(names)!r}"


def read_table(
    path: Path,
    options: LoadOptions,
    decimal: str | None = None,
    *,
    as_text: bool = False,
) -> TextTable:
    """Read a text file as a table of texts, in which numbers are written as Python writes them.

    A Parquet or JSON file is read as the table that it holds.

    Parameters
    ----------
    path : Path
    options : LoadOptions
        How its text, numbers and columns are written, where the user stated it.
    decimal : str, optional
        Decimal mark, as of the other files of a folder, that is taken if the user stated none.
        None: as the cells prove.
    as_text : bool, default False
        Whether numbers stay texts as they are written; those of Parquet and JSON become texts.

    Returns
    -------
    TextTable
        Rows of too few or too many cells, or with numbers in another format, are left out, and are
        among its faults.

    Raises
    ------
    UnreadableError
        If the file is empty, cut off or too large, is no text or cannot be decoded, has no header,
        or its number format is undecided, or if it is no table in Parquet or JSON.
    """
    import pandas as pd

    if (stored := read_frame(path)) is not None:
        frame, odd_lines = stored
        faults = [Fault(path.name, i, message) for i, message in odd_lines.items()]
        table = TextTable(as_texts(frame) if as_text else frame, faults, 0, [], "")
        last = max(odd_lines, default=0)
        return table._replace(cut_line=last) if last > max(frame.index) else table
    text, encoding = decode(read_content(path), options.encoding)
    cells = split_cells(text, options.columns, options.channels)
    if not cells.header:
        raise UnreadableError("Expected a header and rows, it is empty")
    header = _without_trailing_empty(cells.header)  # a delimiter at its end
    if not header:
        raise UnreadableError("Expected a header, the first line names no column", cells.line)
    n = len(header)
    rows = _pad_rows(cells.rows, n)
    complete = {i: row[:n] for i, row in rows.items() if len(row) >= n and not any(row[n:])}
    wrong = {
        i: f"Expected {n} columns, got {len(row)}: {listed(row)}"
        for i, row in cells.rows.items()
        if i not in complete
    }
    cut_line = _find_cut_row(text, cells, complete, wrong)
    frame = pd.DataFrame(
        list(complete.values()), index=list(complete), columns=header, dtype=object
    )
    mark = numbers = ""
    notes = cells.notes
    if not as_text:
        write_curves(frame)
        cell_units = _take_units_off(frame, options)
        mark, group, odd_cells = write_as_python(
            frame, cells.delimiter, options.decimal or decimal, options.thousands
        )
        wrong |= odd_cells
        units_text, unit_notes = _convert_cells(frame, cell_units, cells.units)
        parts = (
            f"decimal mark {mark!r}" if mark else "whole numbers",
            f"thousands mark {group!r}" if group else "",
            f"{cells.delimiter!r} between cells" if cells.delimiter else "",
            "" if encoding == "utf-8-sig" else encoding,
            units_text,
        )
        numbers = ", ".join(filter(None, parts))
        notes += unit_notes
        join_date_and_time(frame)
    faults = [Fault(path.name, i, message) for i, message in sorted(wrong.items())]
    frame = frame.drop(index=[i for i in wrong if i in complete])
    column_units = cells.units[:n]
    begin = min(cells.rows, default=1)
    preamble = _lines_above(text, begin)
    _add_stated_units(column_units, header, _lines_above(text, cells.line or begin))
    about = (cells.fields, cells.n_remarks, cells.blocks, *rate_in_preamble(preamble), RATE_ABOVE)
    first = (frame, faults, cells.line, column_units, mark, numbers)
    return TextTable(*first, *about, notes, cut_line, lines_of_factors(preamble), preamble)


def _lines_above(text: str, line: int) -> str:
    """Return the lines of a text above a line, from 1; "" for line 0."""
    return "\n".join(text.splitlines()[: max(line - 1, 0)])


def _add_stated_units(column_units: list[str], header: Sequence[str], preamble: str) -> None:
    """Set the units that the text above a header states, in place, for columns without one."""
    without = [
        i
        for i, name in enumerate(header)
        if not (column_units[i] or units.split(name)[1] or is_time_column(name))
    ]
    stated = units.stated_in_preamble(preamble, header, without)
    for i, unit in zip(without, stated, strict=True):
        column_units[i] = unit


def _pad_rows(rows: dict[int, list[str]], n: int) -> dict[int, list[str]]:
    """Return rows of cells, with empty cells up to the n of the header where these are left out.

    They are left out if all rows of the usual number of cells end in an empty one.
    """
    width, _ = Counter(map(len, rows.values())).most_common(1)[0] if rows else (n, 0)
    if width >= n or any(row[-1] for row in rows.values() if len(row) == width):
        return rows
    padding = [""] * (n - width)
    return {i: row + padding if len(row) == width else row for i, row in rows.items()}


def _take_units_off(frame: pd.DataFrame, options: LoadOptions) -> dict[int, list[str]]:
    """Remove the units in a table's cells, as of `56.5 N`, in place.

    A column is changed if 80 % of its filled cells are a number with a known unit. A unit that no
    blank parts from the number counts only in a column with decimals: 0001A is a part's number.
    Returns, by the position of the column, the unit of each cell in its usual spelling, "" for one
    without. Raises UnreadableError, with the line, if the units of a column are of several
    dimensions, or a fifth of the numbers has a unit and others have none. The columns of parts and
    labels, and those that are not among the stated channels, are then left as they are.
    """
    cell_units = dict[int, list[str]]()
    for i, name in enumerate(frame.columns):
        cells = frame.iloc[:, i].tolist()
        sample = cells[:: max(1, len(cells) // SAMPLED_CELLS)]
        if not any(map(NUMBER_AND_UNIT.fullmatch, sample)):
            continue
        matches = [NUMBER_AND_UNIT.fullmatch(cell) for cell in cells]
        column = [units.spelling(match["unit"].strip()) if match else "" for match in matches]
        column = [unit if units.parse(unit) else "" for unit in column]
        has_decimals = any(
            unit and set(".,") & {*cell} for unit, cell in zip(column, cells, strict=True)
        )
        if not has_decimals:
            column = [unit if " " in cell else "" for unit, cell in zip(column, cells, strict=True)]
        n_filled = sum(map(bool, cells))
        is_bare = [not unit and is_numeral(cell) for unit, cell in zip(column, cells, strict=True)]
        n_units = sum(map(bool, column))
        if n_units < (1 - MOST) * n_filled or n_units + sum(is_bare) < MOST * n_filled:
            continue
        lines = dict(zip(reversed(column), reversed(frame.index), strict=True))  # the first of each
        lines.pop("", None)
        stated = sorted(lines, key=lines.__getitem__)
        dimensions = {parsed[0] for parsed in map(units.parse, stated) if parsed}
        if len(dimensions) > 1 or any(is_bare):
            is_channel = not options.channels or units.find_columns(name, options.channels)
            if name in (options.part, options.label) or not is_channel:
                continue
            other = next((u for u in stated if units.factor(u, stated[0]) is None), "no unit")
            line = lines.get(other) or frame.index[is_bare.index(True)]
            first = f"{stated[0]} in line {lines[stated[0]]}"
            wanted = f"units of one quantity in the cells of {name}, got {other}, and {first}"
            do = "export the column in one unit, or name another channel (channel)"
            raise UnreadableError(f"Expected {wanted}; {do}", int(line))
        cell_units[i] = column
        numbers = [
            match["number"] if unit and match else cell
            for match, unit, cell in zip(matches, column, cells, strict=True)
        ]
        frame.isetitem(i, numbers)
    return cell_units


def _convert_cells(
    frame: pd.DataFrame, cell_units: Mapping[int, Sequence[str]], column_units: list[str]
) -> tuple[str, tuple[str, ...]]:
    """Convert cells to one unit for each column, in place, and set that in `column_units`.

    If the column has several units, the numbers are converted to the unit without a prefix: N for N
    and kN. Returns a text for the reading that names the units, "" if no cell has one, and a note
    on each column that was converted.

    cell_units : from `_take_units_off`.
    """
    texts = []
    notes = []
    for i, cells in cell_units.items():
        name = frame.columns[i]
        stated = list(dict.fromkeys(filter(None, cells)))
        column_units[i] = stated[0]
        if len(stated) > 1:
            dimension, _ = units.parse(stated[0]) or ("", 1.0)  # each parses: it was taken off
            column_units[i] = dimension
            factors = {unit: units.factor(unit, dimension) or 1.0 for unit in stated}
            numbers, _ = floats(frame.iloc[:, i])
            scaled = [
                str(number * factors[unit]) if unit else cell
                for number, unit, cell in zip(numbers, cells, frame.iloc[:, i], strict=True)
            ]
            frame.isetitem(i, scaled)
            notes.append(
                f"Column {name} has {listed(stated)} in its cells: all are {dimension} now"
            )
        texts.append(f"units {listed(stated)} in the cells of {name}")
    return ", ".join(texts), tuple(notes)


def _find_cut_row(
    text: str, cells: TextCells, complete: Mapping[int, Sequence[str]], wrong: dict[int, str]
) -> int:
    """Return the line of the last row if it is cut off, by its cells or its last cell; else 0.

    complete : rows with all cells. wrong : what is wrong in others, to which the last may be added.
    """
    last = max(cells.rows, default=0)
    if text[-1:] != "\n" and last in complete and _is_last_cell_cut(list(complete.values())):
        wrong[last] = "Expected a last cell as those above, it is cut off"
    is_cut = last in wrong and len(cells.rows[last]) <= len(cells.header) and len(complete) > 1
    return last if is_cut else 0


def _is_last_cell_cut(rows: Sequence[Sequence[str]]) -> bool:
    """Return whether the last cell of rows is but the beginning of the word above it, or has fewer
    decimals than all above, as many each.

    False for fewer than three rows.
    """
    cells = [row[-1] for row in rows]
    if len(cells) > 2 and not any(map(str.isdigit, cells[-2])) and cells[-1] not in cells[:-1]:
        return cells[-2].startswith(cells[-1])
    decimals = [len(cell.replace(",", ".").partition(".")[2]) for cell in cells]
    return len(decimals) > 2 and len(set(decimals[:-1])) == 1 and decimals[-1] < decimals[0]


def is_mostly_numbers(cells: pd.Series) -> bool:
    """Return whether at least 80 % of a column's filled cells are numbers, or all are empty."""
    numbers, wrong = floats(cells)
    n_numbers = int((~np.isnan(numbers)).sum())
    return not wrong or n_numbers >= MOST * (n_numbers + len(wrong))


def parse_numbers(
    frame: pd.DataFrame,
) -> tuple[NDArray[np.float32], dict[int, str], dict[int, str]]:
    """Convert a table to numbers.

    Returns
    -------
    values : array of float32, shape (n, columns)
        Empty cells and those that are no numbers are NaN.
    wrong : dict of int to str
        A message for the index of each row that has a cell that is no number. It counts the dates
        that a spreadsheet made of numbers.
    lost : dict of int to str
        The cell of those rows in which all such cells are a `STATUS`.
    """
    values = np.empty(frame.shape)
    wrong = dict[int, str]()
    lost = dict[int, str]()
    damaged = set[int]()
    dates = Counter[int]()
    for i, name in enumerate(frame.columns):
        cells = frame.iloc[:, i]
        values[:, i], odd = floats(cells)
        for index in odd:
            cell = str(cells[index])
            prefix = NUMBER_PREFIX.match(cell)  # always matches: it may be empty
            actual = excerpt(cell, prefix.end() if prefix else 0)
            message = f"Expected a number in column {name}, got {actual}"
            is_date = SPREADSHEET_DATE.fullmatch(cell) is not None
            if NUMBER_AND_UNIT.fullmatch(cell) and not is_date:
                message = f"{message}; export plain numbers, without units"
            wrong.setdefault(index, message)
            if is_date:
                dates[index] += 1
                damaged.add(index)
            elif STATUS.fullmatch(cell):
                lost.setdefault(index, cell.strip())
            else:
                damaged.add(index)
    turned = "a spreadsheet turned numbers such as 1.3 into dates"
    for index in dates:
        count = f"{dates.total()} of {values.size} cells are dates"
        more = f", {turned}; export again, without opening it in one"
        more = more if dates.total() < values.size else ""
        wrong[index] = f"{wrong[index]}: {count}{more}"
    with np.errstate(over="ignore"):  # what overflows becomes an infinity, which the engine finds
        numbers = values.astype(np.float32)
    return numbers, wrong, {i: cell for i, cell in lost.items() if i not in damaged}


def read_recording(
    path: Path,
    channels: Sequence[str],
    options: LoadOptions,
    notes: Counter[str],
    decimal: str | None = None,
) -> Recording:
    """Read the channels of a file that holds one recording, in the order of `channels`.

    `notes` is added to; `decimal` is the mark that is taken if the user stated none. Raises
    UnreadableError, with the line if it is known, for a cell, a row, a clock or a text that cannot
    be read, a channel that is not there, and no samples.
    """
    table = read_table(path, replace(options, channels=tuple(channels)), decimal)
    table = _of_one_signal(table, channels)
    header = list(table.frame.columns)
    places = [column_place(name, header, table.line, table.preamble) for name in channels]
    for fault in table.faults:
        if fault.line != table.cut_line:
            raise UnreadableError(fault.message, fault.line)
        notes[cut_note(fault)] += 1
    if table.frame.empty:
        raise UnreadableError("Expected samples below the header, found none", table.line)
    is_name = (table.frame.to_numpy(dtype=object) == np.array(header, dtype=object)).any(axis=1)
    for line, *cells in table.frame[is_name].itertuples():
        if not any(_is_value(str(cell)) for cell in cells):
            do = "write the rows below it into a file of their own"
            raise UnreadableError(f"Expected one header, got another: {listed(cells)}; {do}", line)
    frame, kept = _beside_their_clock(table.frame, places)
    places = [kept.index(place) for place in places]
    table = table._replace(frame=frame, units=[table.units[i] for i in kept])
    header = list(frame.columns)
    notes.update(table.notes)
    rows = _without_unfilled(_without_summary(frame, options, notes), places, options, notes)
    channel_units = tuple(table.units[i] or units.split(str(header[i]))[1] for i in places)
    joined = _check_blocks(rows, table, options) if table.blocks else ""
    try:
        timed = rows_to_trace(rows, places, options, notes, table.units, table.rate_hz)
    except UnreadableError as error:
        error.args = (f"{error}; it has {joined}",) if joined else error.args
        raise
    if joined:
        notes[f"The file has {joined}: they are joined in one recording"] += 1
    if table.offer and not (timed.reading.clock or options.rate_hz):
        notes[table.offer] += 1
    n_out = len(frame) - len(rows) + table.n_remarks
    left_out = (
        f"header in line {table.line}" if table.line > 1 else "",
        f"{n_out} left out" if n_out else "",
        timed.reading.rows,
    )
    reading = timed.reading._replace(rows=", ".join(filter(None, left_out)), numbers=table.numbers)
    others = [i for i in range(len(header)) if i not in places]
    start = None
    with suppress(UnreadableError):
        place = place_of_clock(rows, options.time)
        start = None if place is None else start_of(rows.iloc[:, place])
    return timed._replace(
        units=channel_units,
        start=start,
        reading=reading,
        factors={**table.factors, **factors_in_columns(rows.iloc[:, others])},
    )


def _check_blocks(rows: pd.DataFrame, table: TextTable, options: LoadOptions) -> str:
    """Return a text on the blocks of a recording, as "3 blocks of 500 rows under one header".

    It is "" for one block. Raises UnreadableError if the blocks overlap in time, by the clock, or
    without one by LabVIEW's X0.
    """
    places = rows.index.searchsorted(list(table.blocks)[1:])
    blocks = [block for block in np.split(np.arange(len(rows)), places) if len(block)]
    sizes = sorted({len(block) for block in blocks})
    if len(blocks) < 2:
        return ""
    up_to = "up to " if len(sizes) > 1 else ""
    text = f"{len(blocks)} blocks of {up_to}{sizes[-1]} rows, each under the same header"
    clock = None
    with suppress(UnreadableError):
        clock = clock_of(rows, options.time, table.units)
    starts = set(table.blocks.values())
    overlaps = options.time != NO_CLOCK and "" not in starts and len(starts) < len(table.blocks)
    if clock is not None and not np.isnan(clock.seconds).any():
        times = [clock.seconds[block] for block in blocks]
        spans = sorted((block.min(), block.max()) for block in times)
        overlaps = any(a[1] > b[0] for a, b in itertools.pairwise(spans))
    if overlaps:
        do = "write each into a file of its own: the last one is usually the final measurement"
        raise UnreadableError(
            f"Expected one recording, got {text}, and their times overlap; {do}",
            int(rows.index[blocks[1][0]]),
        )
    return text


def cut_note(fault: Fault) -> str:
    """Return the note on a file whose last row is cut off and left out."""
    return f"The last row is cut off, and left out: {fault.source}, line {fault.line}"


def _of_one_signal(table: TextTable, channels: Sequence[str]) -> TextTable:
    """Return a table with a row for each value of each signal as that of one of them.

    Such a table has a column of names, among them the channel, and one other that changes, holds
    numbers in most rows, and is no clock. The latter gets the channel's name. Any other table, and
    that of several channels, is returned as it is.
    """
    frame = table.frame
    is_signal = len(channels) == 1 and frame.columns.is_unique
    if not is_signal or units.find_columns(channels[0], list(frame.columns)):
        return table
    tags = [name for name in frame if (frame[name] == channels[0]).any()]
    if len(tags) != 1:
        return table
    rows = frame[frame[tags[0]] == channels[0]]
    values = [
        name
        for name in rows
        if not is_time_column(name)
        and 2 * len(floats(rows[name])[1]) < len(rows)
        and len({*rows[name]}) > 1
    ]
    if len(values) != 1:
        return table
    return table._replace(frame=rows.rename(columns={values[0]: channels[0]}))


def _beside_their_clock(
    frame: pd.DataFrame, places: Sequence[int]
) -> tuple[pd.DataFrame, list[int]]:
    """Return a recording with the clock of the channels at `places`, without clocks of others.

    Only clocks of one name are several, as in Time;Way;Time;Force, where each stands to the left of
    its channels. Rows at the end in which this clock and these channels are empty are left out;
    all other columns stay. The second value is the place in `frame` of each column that is kept.
    Raises UnreadableError if the channels at `places` have different clocks.
    """
    names = [str(name).lower() for name in frame.columns]
    clocks = [i for i, name in enumerate(names) if is_time_column(name) and names.count(name) > 1]
    nearest = {max((i for i in clocks if i < place), default=-1) for place in places}
    kept = list(range(len(names)))
    if clocks and nearest != {-1}:
        if len(nearest) > 1:
            raise UnreadableError("Expected channels beside one clock, got several clocks")
        kept = [i for i in kept if i not in clocks or i in nearest]
        cells = frame.iloc[:, [*nearest, *places]]
        is_used = (cells.astype(str).apply(lambda column: column.str.strip()) != "").any(axis=1)
        frame = frame.iloc[: int(np.flatnonzero(is_used)[-1]) + 1] if is_used.any() else frame
    return frame.iloc[:, kept], kept


def _without_summary(
    frame: pd.DataFrame, options: LoadOptions, notes: Counter[str]
) -> pd.DataFrame:
    """Return a recording without rows at an end of it that are no samples, as `Max;48.2`.

    Such rows have no time. They are left out, with a note, only if all other rows have a time
    and are at least ten times as many. Without a clock the first column of numbers to which this
    applies takes its place; then one of the cells left out must hold text.
    """
    place = None
    with suppress(UnreadableError):
        place = place_of_clock(frame, options.time)
    for i in range(frame.shape[1]) if place is None else [place]:
        cells = frame.iloc[:, i].astype(str).tolist()
        is_value = [cell != "" and _is_value(cell) for cell in cells]
        n_samples = sum(is_value)
        n_out = len(cells) - n_samples
        first = is_value.index(True) if n_samples else 0
        has_words = place is not None or any(set(cells) - set(cells[first : first + n_samples]))
        if not (has_words and 0 < n_out <= n_samples / SUMMARY_SHARE):
            continue
        if all(is_value[first : first + n_samples]):
            what = "time" if place is not None else f"number in column {frame.columns[i]}"
            where = "first" if first else "last"
            text = f"The {where} {n_out} rows have no {what}: they are no samples, and left out"
            notes[text] += 1
            return frame.iloc[first : first + n_samples]
    return frame


def _without_unfilled(
    frame: pd.DataFrame, places: Sequence[int], options: LoadOptions, notes: Counter[str]
) -> pd.DataFrame:
    """Return a recording without rows behind the last sample in which time and channels are 0.

    A buffer of a controller that was not filled has such rows; a note says that they are left out.
    """
    place = None
    with suppress(UnreadableError):
        place = place_of_clock(frame, options.time)
    if place is None or place in places:
        return frame
    values = np.stack([floats(frame.iloc[:, i])[0] for i in (place, *places)])
    used = np.flatnonzero((values != 0).any(axis=0))
    n = int(used[-1]) + 1 if len(used) else 0
    if n < len(frame) and n > 1 and values[0, n - 1] > 0:
        notes["The last rows are 0, and so is their time: they are no samples, and left out"] += 1
        return frame.iloc[:n]
    return frame


def rows_to_trace(
    rows: pd.DataFrame,
    places: Sequence[int],
    options: LoadOptions,
    notes: Counter[str],
    units_row: Sequence[str] = (),
    rate_hz: float | None = None,
) -> Recording:
    """Convert the rows of a table, one for each sample, to a trace with its rate.

    Parameters
    ----------
    rows : DataFrame, T rows
    places : sequence of int
        Positions of the columns of the C channels.
    options : LoadOptions
        A stated rate is taken instead of a clock's, which still shows missing rows. With
        `fit="resample"` the samples are interpolated at even times. Both are needed for
        a clock whose steps vary all along, with pauses; see `clocks.varies_all_along`.
    notes : Counter
        Counts what users should know; it is added to.
    units_row : sequence of str
        Unit of each column, if there is a row of units.
    rate_hz : float, optional
        Rate that the file states above the rows, for rows without a clock, or with one that is too
        coarse to tell it.

    Returns
    -------
    Recording
        In the order of the times, where these can be trusted; see `clocks.in_order_of_time`. An
        empty cell is NaN, which the engine finds. The rate is None if the user states one, or
        nothing tells it; there are no units.

    Raises
    ------
    UnreadableError
        For a cell that is no number, for rows that are missing or out of order, and, unless a rate
        is stated, for a clock that cannot be read or is not even enough.
    """
    is_again = _repeated_rows(rows, places, options)
    if is_again.any():
        rows = rows[~is_again]
        timed = rows_to_trace(rows, places, options, notes, units_row, rate_hz)
        return timed._replace(repeated=int(is_again.sum()))
    rows, values = _measured(rows, places, options, notes)
    trace = np.ascontiguousarray(values.T)
    try:
        clock = clock_of(rows, options.time, units_row)
    except UnreadableError as error:
        if options.rate_hz is None or error.line:
            raise
        return Recording(trace)  # a stated rate needs no clock
    if clock is None:
        if options.rate_hz is None and rate_hz is not None:
            return Recording(trace, rate_hz, reading=Reading(clock=RATE_ABOVE))
        if options.rate_hz is None:
            _offer_clock(rows, places, notes)
        return Recording(trace, goes_back=_column_that_goes_back(rows, options))
    try:
        return _trace_by_clock(trace, rows, clock, options, notes, rate_hz)
    except UnreadableError as error:
        same_time = same_time_text(trace, clock, rows.index)
        raise UnreadableError(f"{error}{same_time}", error.line) from error


def _trace_by_clock(
    trace: NDArray[np.float32],
    rows: pd.DataFrame,
    clock: Clock,
    options: LoadOptions,
    notes: Counter[str],
    rate_hz: float | None,
) -> Recording:
    """Return the trace (C, T) of rows by their clock, as `rows_to_trace` does."""
    if clock.is_continued:
        notes[f"The clock {clock.name} counts from 0 again: its times go on there"] += 1
    if SUMMER_TIME in clock.form:
        notes[f"Column {clock.name} holds {clock.form}"] = 1
    order, clock = in_order_of_time(rows, clock, options.time)
    if (order != np.arange(len(rows))).any():
        notes["Rows are put in the order of their times"] += 1
        trace = np.ascontiguousarray(trace[:, order])
        rows = rows.iloc[order]
    rate_hz = options.rate_hz or rate_hz
    if options.fit == "resample" and rate_hz is not None and varies_all_along(clock):
        even = f"put at even times, {rate_hz:g} Hz, linearly between their own"
        notes[f"Rows come when values change, by column {clock.name}: they are {even}"] += 1
        reading = Reading(clock=f"column {clock.name} ({clock.form}), at the stated rate")
        even_trace = resample_evenly(trace, clock, rate_hz)
        return Recording(even_trace, rate_hz, reading=reading, length=trace.shape[1])
    check_rows(clock, rows.index, options.time)
    confirmed = clock._replace(note="")  # on its unit
    if rate_hz is not None and not rate_contradiction(confirmed, rate_hz):
        clock = confirmed
    if options.rate_hz is None and rate_hz is not None and not shows_lost_rows(clock):
        clock_text = f"{RATE_ABOVE}; {lost_rows_text(clock)}"
        if not rate_contradiction(clock, rate_hz):
            return Recording(trace, rate_hz, reading=Reading(clock=clock_text))
    return _trace_at_rate(trace, clock, rows.index, options, notes)


def _measured(
    rows: pd.DataFrame, places: Sequence[int], options: LoadOptions, notes: Counter[str]
) -> tuple[pd.DataFrame, NDArray[np.float32]]:
    """Return the rows of a recording and their samples (T, C), with a note on lost samples.

    A text in place of a number is a lost sample; with `fit="resample"` its row is left out. Raises
    UnreadableError for a damaged number, and if too many samples are lost.
    """
    values, wrong, lost = parse_numbers(rows.iloc[:, places])
    is_few = len(lost) <= MAX_MISSING * len(rows) + 1 < len(rows)
    if damaged := wrong.keys() - (lost.keys() if is_few else {}):
        line = min(damaged)
        count = f", and {len(lost)} of {len(rows)} rows are such" if line in lost else ""
        raise UnreadableError(f"{wrong[line]}{count}", line)
    do = "NaN; fit='resample' interpolates single ones"
    if lost and options.fit == "resample":
        do = "interpolated"
        is_measured = ~(rows.index.isin(list(lost)) & np.isnan(values).any(axis=1))
        rows = rows[is_measured]
        values = values[is_measured]
    for cell in lost.values():
        notes[
            f"Samples are lost where a text is in place of a number, {cell!r}: they are {do}"
        ] += 1
    return rows, values


def _trace_at_rate(
    trace: NDArray[np.float32],
    clock: Clock,
    lines: pd.Index,
    options: LoadOptions,
    notes: Counter[str],
) -> Recording:
    """Return a trace (C, T) with the rate by its clock, or without one if the rate is stated.

    With `fit="resample"` it is interpolated at even times; else a note says that rows are missing.

    lines : line in the file of each sample.
    """
    if options.rate_hz is not None:
        clock_text = f"none, the rate is stated; {lost_rows_text(clock)}"
        if contradiction := rate_contradiction(clock, options.rate_hz):
            notes[contradiction] += 1
        return Recording(trace, reading=Reading(clock=clock_text))
    reading = Reading(clock=f"column {clock.name} ({clock.form})")
    rate = rate_of(clock, lines)
    if clock.note:
        notes[clock.note] += 1
    if options.fit == "resample":
        trace = resample_evenly(trace, clock, rate)
    else:
        n_missing = check_even(clock, rate)
        if n_missing > 1:
            text = f"Rows are missing by column {clock.name}: later samples stand too early"
            notes[f"{text}; fit='resample' puts all at even times"] += 1
            reading = reading._replace(rows="rows are missing")
    return Recording(trace, rate, reading=reading)


def column_of_count(rows: pd.DataFrame, time: str | None) -> pd.Series | None:
    """Return the column that tells the rows of a recording apart, or None.

    It is the clock, also if the user does not trust it, else a running number, as `Sample`.

    rows : without the columns of channels.
    """
    place = None
    with suppress(UnreadableError):
        place = place_of_clock(rows, None if time == NO_CLOCK else time)
    if place is not None:
        return rows.iloc[:, place]
    cells = (rows.iloc[:, i] for i, name in enumerate(rows) if COUNTER_NAME.fullmatch(str(name)))
    return next((column for column in cells if (floats(column)[0] % 1 == 0).all()), None)


def _repeated_rows(
    rows: pd.DataFrame, places: Sequence[int], options: LoadOptions
) -> NDArray[np.bool_]:
    """Return which rows of a recording came before, with all their cells, shape (n,).

    None without a `column_of_count`, or if its values do not tell the others apart: then
    rows may be equal by chance.
    """
    is_again: NDArray[np.bool_] = rows.duplicated().to_numpy()
    others = rows.drop(columns=rows.columns[places])
    count = column_of_count(others, options.time) if is_again.any() else None
    if count is None or not count[~is_again].is_unique:
        is_again = np.zeros(len(rows), dtype=np.bool_)
    return is_again


def _column_that_goes_back(rows: pd.DataFrame, options: LoadOptions) -> str:
    """Return the name of a clock that the user does not trust if it goes back, else ""."""
    if options.time != NO_CLOCK:
        return ""
    with suppress(UnreadableError):
        clock = clock_of(rows)
        return clock.name if clock is not None and (np.diff(clock.seconds) < 0).any() else ""
    return ""


def _offer_clock(rows: pd.DataFrame, places: Sequence[int], notes: Counter[str]) -> None:
    """Add a note on the first column, other than a channel, that rises steadily: it may be the
    clock.

    The first 200 rows tell whether it rises. A column that has the name of a counter of samples, as
    `Index`, and rises by 1 in all rows is passed over.

    places : positions of the channels.
    """
    for i in rising_columns(rows):
        name = str(rows.columns[i])
        is_counter = COUNTER_NAME.fullmatch(name) is not None
        is_counter = is_counter and bool((np.diff(floats(rows.iloc[:, i])[0]) == 1).all())
        if i not in places and not is_counter:
            rises = f"column {name} rises steadily: time={name!r} if it is one"
            notes[f"No clock is known; {rises}"] += 1
            return


def column_place(name: str, header: Sequence[str], line: int = 1, preamble: str = "") -> int:
    """Return the position of a column in a header, found by `units.find_columns`.

    Raises UnreadableError, with the header's line, if there is none or several.

    preamble : the first lines of the file, for the error, in which the column may stand.
    """
    places = units.find_columns(name, header)
    columns = listed(header)
    if not places:
        message = f"Expected a column {name}, got {columns}"
        for i, text in enumerate(preamble.splitlines(), start=1):
            cells = [cell.strip(" \"'") for cell in CELL_MARK.split(text)]
            if i != line and units.find_columns(name, cells):
                do = "if that line is the header, name the columns as it does (columns)"
                raise UnreadableError(f"{message}; {name} stands in line {i}: {do}", line)
        raise UnreadableError(message, line)
    if len(places) > 1:
        names = list(header)
        do = "name it as it stands"
        if len({header[i] for i in places}) < len(places):
            for n, i in enumerate(places, start=1):
                bare = units.split(names[i])[0]
                names[i] = names[i].replace(bare, f"{bare}_{n}", 1)
            do = f"name them anew, columns={','.join(names)!r}, and the channel"
        choice = " or ".join(f"channel={names[i]!r}" for i in places)
        message = f"Expected a column {name}, got it twice or more in {columns}; {do}, {choice}"
        raise UnreadableError(message, line)
    return places[0]
