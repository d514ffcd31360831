"""The cells of a text file: its delimiter, its blocks, and the lines that are no data.

`split_cells` splits a text; `fields_beside` reads what a small file beside a recording states.
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
from functools import cache
from pathlib import Path

from ..errors import listed
from ..traces import is_time_column
from . import units
from .clocks import DATE_FORM, WORD_DATE
from .curves import IN_LINE, UNQUOTED
from .dataset import UnreadableError
from .encodings import decode
from .headers import (
    FIELD_MARK,
    MIN_TIMES,
    TextCells,
    ends_in_comment,
    find_header,
    has_unit,
    is_value,
    numeric_columns,
    pad_units,
    without_trailing_empty,
)

BESIDE = (".txt", ".json", ".ini", ".yaml", ".yml", ".meta", ".info", ".log")
SMALL = 2**14  # bytes of a file that tells of a recording
MIN_FULL_ROWS = 8  # that show where the columns of fixed width end
# Of equally good ones the first is taken. " ": any blanks; "": one column.
DELIMITERS = ("\t", ";", "|", ",", " ", "")
SAMPLED_LINES = 30  # from the end, by which the delimiter is found
SAMPLED_CELLS = 40  # of each of these lines
# A word between blanks; a unit in brackets belongs to the name before it.
WORD = re.compile(r'"((?:[^"]|"")*)"|([^ \t"]+(?: +[\[(][^\])]*[\])])?)')
REMARK = re.compile(r"^\s*(#+|%+|//+|\*+|--+|;+)\s*")  # by which programs mark a comment
# What a line outside the table is about: no number, no path.
FIELD_KEY = re.compile(r"[^\W\d][^\d:;=\\]{0,40}")
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
# In it no delimiter is looked for.
ONE_CELL = re.compile(
    rf"{IN_LINE}|(?:{WORD_DATE})(?: +\d\d?:\d\d(?::\d\d(?:[.,]\d+)?)?)?"
    rf"|(?:{DATE_FORM}) +\d\d?:\d\d(?::\d\d(?:\.\d+)?)?(?: *(?:UTC|[AaPp][Mm])\b)?"
)
DELIMITER_LINE = re.compile(r'"?sep=(.)"?', re.IGNORECASE)  # Excel's first line


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
    n_cut = _cut_touching(lines, split) if delimiter == " " else 0
    rows = _under_one_header({i: row for i, row in split.items() if i > end and any(row)})
    _check_blocks_of_labview(rows)
    if _is_horizontal(rows.values()):
        rows = dict(enumerate(map(list, zip(*rows.values(), strict=True)), start=1))
    cells = None if columns else _beside_settings(rows, delimiter)
    if cells is None:
        named_rows = _names_and_units_of_keys(rows)
        cells = find_header(named_rows, delimiter, list(columns), channels)
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
            *["Rows in which cells touch or are empty are cut where the columns end"] * n_cut,
        ),
    )


def _cut_touching(lines: Mapping[int, str], split: dict[int, list[str]]) -> int:
    """Cut cells that touch in a text of fixed-width columns; return the number of rows cut.

    Fortran writes 44.17010026.13 where 10026.13 fills its column. The full rows are those with the
    largest number of cells that `MIN_FULL_ROWS` numeric rows have. Nothing is cut unless all of
    them have the same ends of columns. A row with fewer cells is cut at these ends if each piece is
    like that of the first full row (a word, or a number of as many decimals), or is empty, or has
    the stars of an overflow alone.

    lines : the text of each line. split : the cells of each line, changed in place.
    """
    numeric = [i for i in lines if 2 * len(numeric_columns(split[i])) >= len(split[i])]
    widths = Counter(len(split[i]) for i in numeric)
    n = max((width for width, n_rows in widths.items() if n_rows >= MIN_FULL_ROWS), default=0)
    full = [i for i in numeric if len(split[i]) == n]
    all_ends = {tuple(word.end() for word in WORD.finditer(lines[i])) for i in full}
    if len(all_ends) != 1:
        return 0
    ends = all_ends.pop()
    first_full = split[full[0]]
    n_cut = 0

    def form(cell: str) -> tuple[bool, int]:
        """Return whether a cell is a number or a time, and its number of decimals."""
        return is_value(cell), len(cell.replace(",", ".").partition(".")[2])

    for i, line in lines.items():
        is_short = len(split[i]) < n and "\t" not in line
        if not (is_short and len(line.rstrip()) <= ends[-1] <= len(line)):
            continue
        pieces = [line[begin:end].lstrip() for begin, end in itertools.pairwise((0, *ends))]
        are_cells = all(
            not any(map(str.isspace, piece)) and (not piece.strip("*") or form(piece) == form(cell))
            for piece, cell in zip(pieces, first_full, strict=True)
        )
        if are_cells and numeric_columns(pieces):
            split[i] = pieces
            n_cut += 1
    return n_cut


def _tables_in(above: Sequence[list[str]]) -> list[str]:
    """Return a note on each table among the rows above the header that is read.

    It has names and, below them, eight rows of numbers or more.
    """
    notes = []
    n_rows = width = 0
    for row in reversed(above):
        if 0 in numeric_columns(row):
            n_rows = n_rows + 1 if len(row) == width else 1
            width = len(row)
            continue
        if n_rows >= MIN_TIMES and len(row) == width > 1 and not any(map(is_value, row)):
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
        is_data = is_value(row[0]) == is_value(rows[0][0])
        is_data = is_data and numeric_columns(row) == numeric_columns(rows[0])
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
    is_named = all(row[0] and not numeric_columns(row[:1]) for row in rows)
    is_number = all(len(numeric_columns(row)) == min(n) - 1 for row in rows)
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
    if not (has_samples and names) or any(map(is_value, keys)):
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
    samples = {i: without_trailing_empty(row[n:]) for i, row in rows.items()}
    has_header = numeric_columns(next(iter(samples.values()), [])) != {0, 1}
    if has_header or by_key.keys().isdisjoint(("source", "sample interval")):
        return None
    stated = [by_key.get(f"{axis} units", "") for axis in ("horizontal", "vertical")]
    names = ["Time", by_key.get("source") or "Value"]
    return TextCells(names, 0, pad_units(stated, 2), samples, delimiter, fields)


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
        is_comment = REMARK.match(row[0]) is not None and not numeric_columns(row)
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
    """Return the delimiter that splits lines best, "" if each line is a single value.

    The score of a delimiter is the product of three factors: the share of numbers, times and empty
    cells; the share of lines with the most frequent number of cells; and 1 if one of the top lines
    looks like a header of that many cells, else 0.5. Of the scores within 2 % of the best, the
    first of `DELIMITERS` wins. If all scores are 0, as for lines of a single text, it is the first
    of tab, semicolon, vertical bar and comma for which the most frequent number of cells
    exceeds 1; "," if there is none.
    """

    @cache
    def plain(line: str) -> str:
        """Return a line without a comment's mark, with 0 for a cell with delimiters in it."""
        return units.COMMENT_MARK.sub("", ONE_CELL.sub("0", line))

    top = lines[: min(100, len(lines) - 1)]
    sample = [plain(line) for line in lines[-SAMPLED_LINES:]]

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
        n_values = sum(is_value(cell) or has_unit(cell) for cell in cells)
        headers = (without_trailing_empty(_split_line(plain(line), delimiter)) for line in top)
        has_header = any(
            2 * sum(map(is_value, row[:SAMPLED_CELLS])) <= min(len(row), SAMPLED_CELLS)
            for row in headers
            if len(row) - ends_in_comment(row) in (n_names, width)
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
