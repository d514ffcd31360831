"""How text files are written: their encoding, delimiter, header, units and marks in numbers.

Each value follows from a count over the lines that were looked at. If two values fit, it is `?`.
"""

import codecs
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from itertools import chain, product
from operator import itemgetter
from statistics import fmean, mode
from typing import NamedTuple

import numpy as np

from ...errors import DataError, listed
from ..dataset import Faults
from ..description import UNKNOWN, Stated, Strings, TextForm, as_option
from ..read.files import caught, natural_key
from ..read.text import BLANK, COMMENT, LATIN, header_names, split_line, to_utf8, to_utf8_or_latin
from ..table import pattern_of
from ..units import is_unit
from .clock import EVEN
from .columns import MOST_WORDS, NUMBER, Proposal, most_frequent

DELIMITERS = ";\t|, "
BLANKS_LEAD = 1.15  # by which blanks must be the better delimiter, since cells may hold some
GROUPS = ("", ".", ",", "'", "’", "\u202f", "\xa0", " ")  # marks between groups of digits
LIKELY = 0.95  # of the numbers that the marks of a text must read; the others are damaged
SAME_DIGITS = str.maketrans("23456789", "11111111")  # for numbers of one form
MOST_BYTES = 2_000_000  # of a file that are read
MOST_LINES = 200  # by which the delimiter and the first row of samples are found
MOST_NAMES = 20  # columns without a header that get a name each
DIGITS = re.compile(r"\d+")
MARK = re.compile("[.,]")  # of decimals, or between groups of digits
RULE = re.compile("[-=]*")  # a cell of a line that is drawn below the header
HALF = 0.5  # a header has no more units among its names
# Lines with a decimal comma: no whole number is written 05, nor stands between other delimiters.
FRACTION = re.compile(r"-?\d+,0\d+|(?=.*[;\t|])(.*[;\t|])?\s*-?\d+,\d+\s*([;\t|].*)?")
WHOLE = re.compile(r"-?\d+(\.0*)?(e\+00)?")
UNIT_WORDS = re.compile(
    r"(?i)[\[(]?(hh:mm(:ss)?|dd\.mm\.yyyy|[\d.]+ ?[mu]?s|[mun]?s(ec(ond)?s?)?|min|h)[\])]?"
)
Rows = Sequence[Strings]


class Look(NamedTuple):
    """The first lines of a file.

    form : of the file. width : cells of a row. line : the header, "" if the user stated its number.
    rows : the cells of the samples. is_closed : whether the last cell of each row is empty.
    """

    form: TextForm
    width: int
    line: str
    rows: Rows
    is_closed: bool


def look(content: bytes, stated: Stated) -> Look:
    """Return how a text file is written, and the cells of its samples.

    Only its first 2 million characters are looked at. The result has the text form (encoding,
    delimiter, lines of the header, of the units and of the first samples), the number of cells in a
    row, the line of the header ("" for none), the cells of each line from the first row of samples
    on, also of lines of another form, and whether the last cell of each row is empty. The
    delimiter, which is the one that best splits the lines into numbers, and the first row follow
    from the first 200 lines; of equally good delimiters the one with more cells is taken. If none
    splits the usual line into cells, there is a single column, and the delimiter is a semicolon, or
    the stated one. The decimal mark and the mark of thousands are not looked for: the text form has
    the defaults. `content` has the bytes of the file. Raises DataError if it is empty or no text,
    or if the line of its header is not certain, and LookupError for a stated encoding that Python
    does not know.

    stated : keys that the user gave. `text.encoding` and `text.delimiter` are taken, and so is
    `text.header`: a text selects the first line above the samples that begins with it, if there is
    one, and a number is taken as the line of the header, whose text is then "", since it may differ
    from file to file. With any `text.header`, also a number, a doubt about the header is no error.
    """
    encoding, text = decode(content, stated.get("text.encoding", ""))
    lines = text.rstrip("\n").split("\n")
    if not text.strip():
        raise DataError("Expected a text, got an empty file.")
    scores = (
        _share_of_numbers(lines[:MOST_LINES], mark)
        for mark in stated.get("text.delimiter", DELIMITERS)
    )
    _, width, delimiter = max(scores, key=itemgetter(0, 1))
    rows = [[*map(str.strip, split_line(line, delimiter))] for line in lines]
    data = _first_row(rows[:MOST_LINES], width)
    is_closed = not any(row[-1] for row in rows[data:] if len(row) == width)
    header, units = _head_lines(rows[:data], width - is_closed, stated)
    beginning = stated.get("text.header")
    if isinstance(beginning, str):
        found = (i for i, line in enumerate(lines[:data], 1) if line.startswith(beginning))
        header = next(found, header)
    title = "".join(lines[header - 1 : header])
    if isinstance(beginning, int):
        header = beginning
        title = ""  # the line may differ from file to file
    form = TextForm(encoding, delimiter, header=header, units=units, data=data + 1)
    return Look(form, width, title, rows[data:], is_closed)


def decode(content: bytes, stated: str) -> tuple[str, str]:
    """Return the encoding of a text, and its first 2 million characters, with plain line feeds.

    The `stated` encoding is used unless it is "". Otherwise it is UTF-16 if the text begins with
    its byte order mark, else UTF-8, or cp1252 if this fails. A byte order mark is left out. Raises
    UnreadableError if the text is in none of them or contains a zero character, and LookupError for
    a stated encoding that Python does not know.
    """
    is_wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    if stated:
        encoding, text = stated, to_utf8(content, stated)
    else:
        encoding, text = to_utf8_or_latin(content, "utf-16" if is_wide else "utf-8")
    return encoding, text.decode()[:MOST_BYTES]


def _share_of_numbers(lines: Strings, delimiter: str) -> tuple[float, int, str]:
    """Return the score of a delimiter, the most frequent number of cells, and the delimiter.

    The score says how well the delimiter splits the lines into numbers. It is the share of lines
    with the most frequent number of cells, times the share of numbers among their cells that are
    not empty, plus 0.01; it is divided by 1.15 if the delimiter is a blank, since cells may have
    blanks in them, and rounded to two decimals, so that near scores are equal. The first third of
    the lines, which may be text above the samples, and empty lines are left out. The result is a
    score of 0 and a single cell if the most frequent number is below 2, if all these cells are
    empty, or if the delimiter is a comma and any line, also of the first third, has a decimal
    comma: a line like `RUN;5,4` with another delimiter beside the number, or like `5,04`, with a 0
    behind the comma, if it has only the number.
    """
    rows = [split_line(line, delimiter) for line in lines[len(lines) // 3 :] if line.strip()]
    width = mode([*map(len, rows), 0])
    same = [row for row in rows if len(row) == width]
    cells = [cell for row in same for cell in row if cell.strip()]
    is_decimal = delimiter == "," and any(map(FRACTION.fullmatch, lines))
    if width < 2 or not cells or is_decimal:
        return 0.0, 1, delimiter
    share = len([*filter(NUMBER.fullmatch, cells)]) / len(cells) * len(same) / len(rows) + 0.01
    return round(share / (BLANKS_LEAD if delimiter == BLANK else 1), 2), width, delimiter


def _first_row(rows: Rows, width: int) -> int:
    """Return the index of the first row of samples, from 0; 0 if there is none.

    `rows` has the cells of each line, of which `width` is the usual number. A row has enough
    numbers if it has `width` cells, and among them at least one number and 60 % of the median of
    the numbers per row. The median leaves out the first third of the rows; a row of another width
    counts as 0. The first of four successive rows with enough numbers, or of fewer at the end, is
    the first row of samples. Rows directly above belong to the samples, too, if they have `width`
    cells and their first cell differs only by a number and is not empty: `0.0,,` above `0.1,5,` (a
    lost sample), but not `time,force,`. If the row found has 20 or more numbers that rise evenly
    (`is_numbering`), and the row below it does not, it names columns, and the row below is the
    first.
    """
    counts = [len([*filter(NUMBER.fullmatch, row)]) * (len(row) == width) for row in rows]
    least = max(0.6 * float(np.median(counts[len(counts) // 3 :])), 1)
    first = next((i for i in range(len(rows)) if min(counts[i : i + 4]) >= least), 0)
    forms = [NUMBER.sub("0", row[0]) if len(row) == width else "" for row in rows]
    while first and "" < forms[first - 1] == forms[first]:
        first -= 1
    is_header = [is_numbering(row) for row in rows[first : first + 2]] == [True, False]
    return first + is_header


def is_numbering(cells: Strings) -> bool:
    """Return whether at least 20 cells are numbers that increase evenly; others are ignored.

    They increase in equal steps (within 1 %).
    """
    numbers = [*filter(NUMBER.fullmatch, cells)]
    with suppress(ValueError):  # two marks in a number, or none at all
        steps = np.diff([float(number.replace(",", ".")) for number in numbers])
        return len(numbers) >= MOST_NAMES and 0 < steps.max() <= (1 + EVEN) * steps.min()
    return False


def _head_lines(rows: Rows, width: int, stated: Stated) -> tuple[int, int]:
    """Return the lines, from 1, of the header and of the units above the samples; 0 for none.

    A candidate for either is a line of at least `width` cells, the number of columns, of which one
    is neither empty nor a row of dashes. The header is the last candidate; but if more than half of
    its cells are units, and there is an earlier candidate, it is the line of the units, and the one
    before it the header. Raises DataError if several candidates may be the header: if the one
    before the last has nothing but units; or if the last has a unit, or a name twice, and the one
    before no empty cell. No error is raised if `stated`, the keys that the user gave, has
    `text.header` (its value is not used here).

    rows : the cells of the lines above the samples.
    """
    heads = [
        i
        for i, row in enumerate(rows, 1)
        if len(row) >= width and not all(map(RULE.fullmatch, row))
    ]
    header = max(heads, default=0)
    units = 0
    if len(heads) > 1:
        above, last = (rows[i - 1] for i in heads[-2:])
        names = [*filter(None, last)]
        share = _share_of_units(names)
        is_odd = share or len({*names}) < len(names)
        if share > HALF:
            header, units = heads[-2:]
        elif "text.header" not in stated and (
            _share_of_units(above) == 1 or (is_odd and all(above))
        ):
            raise DataError(
                f"Expected one line of names, lines {listed(heads)} may be; state text.header, and "
                "text.units for a line of units."
            )
    return header, units


def _share_of_units(row: Strings) -> float:
    """Return the share of units among the cells that are not empty, of which one is needed."""
    return fmean(is_unit(word) or bool(UNIT_WORDS.fullmatch(word)) for word in row if word)


def propose_form(p: Proposal, contents: Mapping[str, bytes], faults: Faults) -> Strings:
    """Set `[text]` in `p` to the text form of most files; return the names of these files.

    `p` is the description so far, and `[text]` its section on how text files are written. Files
    with another delimiter, number of columns or header are left out: they move from `p.names` to
    `p.others`. If two of them have the same form, or the name of one differs by a number only from
    that of a file in the result (stated listings aside), `exclude` (the patterns of files that are
    no recordings) is set to `?` (the user must answer), with a note that asks whether they are
    recordings. For a file that is no text, or whose header is not certain, a fault (why it cannot
    be read) is appended to `faults`, and it stays in `p.names`; if more than half are such, nothing
    is set, and the result is empty. Of equally frequent forms that of the file with the most cells
    counts. Keys that the user stated stay. Raises LookupError for a stated encoding that Python
    does not know.

    contents : the contents of the files that are looked at, by name.
    """
    looks = dict[str, Look]()
    for name, content in contents.items():
        with caught(faults, name):
            looks[name] = look(content, p.stated)
    if not looks or 2 * len(looks) < len(contents):
        return []  # the few may be listings; the faults say what is wrong
    forms = {name: (item.form.delimiter, item.width, item.line) for name, item in looks.items()}
    usual = most_frequent(
        [(forms[name], len(item.rows) * item.width) for name, item in looks.items()]
    )
    same = [name for name, form in forms.items() if form == usual]
    odd = sorted(forms.keys() - same, key=natural_key)
    p.set_aside(odd)
    odd = [name for name in odd if name not in p.description.listings]
    without_numbers = partial(DIGITS.sub, "0")
    if len({*map(forms.get, odd)}) < len(odd) or (
        {*map(without_numbers, odd)} & {*map(without_numbers, same)}
    ):
        p.put(
            "exclude",
            UNKNOWN,
            f"are {listed(odd)} recordings of another form? If not, state a pattern, like "
            f"{as_option('exclude', odd[:2])}; if so, see files, or, if only names of columns "
            "differ, state text.header, the number of their line, and text.names",
        )
    _propose_keys(p, [looks[name] for name in same])
    return same


def _propose_keys(p: Proposal, looks: Sequence[Look]) -> None:
    """Set the keys of `[text]` in `p` to the form of the first of these files.

    `p` is the description so far, and `[text]` its section on how text files are written. If the
    header stands at different lines, or the user stated a text for it, `text.header` becomes the
    text of its line, and `text.units` and `text.data`, the lines of the units and of the first
    samples, are counted from it. If any file is read as cp1252, the first such file counts instead,
    and a note says that the encoding is guessed. `_column_names` gives `text.names`, the names of
    the columns in place of a header; it is empty if the user stated a header other than 0.
    `propose_marks` sets the decimal mark and the mark of thousands. Stated keys stay.

    looks : how each of the files, which are of one form, is written, and the cells of its samples.
    """
    usual = next((item for item in looks if item.form.encoding == LATIN), looks[0])
    form = usual.form
    above = int(form.header)
    is_moved = {item.form.header for item in looks} != {above}
    if above and isinstance(p.stated.get("text.header", "" if is_moved else 0), str):
        units = form.units and form.units - above
        form = replace(form, header=usual.line, units=units, data=form.data - above)
    if form.encoding == LATIN:
        p.put("text.encoding", LATIN, f"{LATIN} reads any text: look at the letters below")
    names = () if p.stated.get("text.header") else _column_names(usual)
    for key, value in (asdict(form) | {"names": names}).items():
        p.put(f"text.{key}", value)
    cells = {*chain.from_iterable(row for item in looks for row in item.rows)}
    propose_marks(p, [*filter(NUMBER.fullmatch, cells)])


def _column_names(usual: Look) -> Strings:
    """Return the names of columns for `text.names`; empty if the header names each column.

    `#` or `%` at the beginning of the header is skipped. If it lacks the last column, and this is
    empty in all rows, the names are those of the header and one like `column3`. One name too many
    at the end is left out if it is empty or LabVIEW's `Comment`. Without a header, or if it has
    another number of cells than there are columns, the names are `c0`, `c1`, ...; for 20 columns or
    more it is `x*`, which names all of them. Such a table may have a part in each row: if its first
    column has 2 to 12 different words, all whole numbers, it is named `class`, before `x*`.

    usual : how a typical file is written, and the cells of its samples.
    """
    width = usual.width
    cells = split_line(COMMENT.sub("", usual.line.lstrip(BLANK)), usual.form.delimiter)
    if len(cells) == width:
        return []
    if usual.is_closed and len(cells) == width - 1:
        return header_names([*cells, ""])
    if len(cells) == width + 1 and cells[width].strip().lower() in ("", "comment"):
        return header_names(cells[:width])
    if width < MOST_NAMES:
        return [f"c{i}" for i in range(width)]
    firsts = {row[0] for row in usual.rows if row}
    is_class = 1 < len(firsts) <= MOST_WORDS and all(map(WHOLE.fullmatch, firsts))
    return ["class", "x*"] if is_class else ["x*"]


def propose_marks(p: Proposal, cells: Collection[str]) -> None:
    """Set in `p` the decimal mark and the mark of thousands with which most numbers can be read.

    `p` is the description so far. `1.043,5` can only be read with a decimal comma. The decimal mark
    is `?` (the user must answer), with a note, if point and comma read equally many numbers, or if
    more than 5 % of the numbers cannot be read at all; but not if no number has a point or comma.
    The mark of thousands is `?`, with a note, if it is a point or comma, and any number has this
    mark and not the other one: `7,286` may be a fraction. It is "" if such a mark lets no further
    number be read. If the decimal mark is stated, only this one is tried. Stated keys stay.

    cells : the different texts in the samples that are numbers with any of these marks.
    """
    counts = Counter(cell.translate(SAME_DIGITS) for cell in cells)
    n_read = {
        marks: sum(n for cell, n in counts.items() if pattern_of(*marks).fullmatch(cell))
        for marks in product(p.stated.get("text.decimal", ".,"), GROUPS)
        if marks[0] != marks[1]
    }
    most = max(n_read.values())
    marks, groups = zip(*(key for key, n in n_read.items() if n == most), strict=True)
    p.put("text.decimal", marks[0])
    p.put("text.thousands", groups[0])
    marked = [*filter(MARK.search, cells)]
    if any({*".,"} & {*cell} == {groups[0]} for cell in marked):
        p.put("text.thousands", UNKNOWN, "'.' or ',', or '' if there is none")
    if marked and (len({*marks}) > 1 or most < LIKELY * len(cells)):
        p.put("text.decimal", UNKNOWN, f"'.' or ','; {min(marked)} may be a fraction or a thousand")
