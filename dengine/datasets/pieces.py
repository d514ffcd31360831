"""Curves that come in pieces: a row for each message or block, in which a counter tells its place.

So brokers, controllers and databases cut long curves. `join_pieces` makes one row of each curve.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..errors import DataError, listed
from . import labels, units
from .clocks import EMPTY_CELLS, floats
from .collector import RecordingCollector
from .curves import curve_columns, split_curve
from .dataset import Fault, LoadOptions
from .text import TextTable

if TYPE_CHECKING:
    import pandas as pd

# Words in the name of a counter of pieces, and in that of one which may count whole curves.
PIECE = re.compile(
    r"(chunk|piece|frag|fragment|seg|segment|block|blk|packet|paket|telegramm?|page|slice|teilstück"
    r"|abschnitt)s?",
    re.IGNORECASE,
)
COUNTER = re.compile(
    r"seq|sequence|index|idx|part|teil|offset|start|no|nr|number|counter|pos|position|frame|msg"
    r"|message",
    re.IGNORECASE,
)
# The name of a column that states how many pieces there are.
TOTAL = re.compile(r".*(s|total|count|number|anzahl|num|of|n)|(n|num|total)[\W_].*", re.IGNORECASE)
MOST = 0.8  # of parts have equally many pieces: then fewer are too few


def join_pieces(
    tables: Mapping[str, TextTable], options: LoadOptions, collector: RecordingCollector
) -> Mapping[str, TextTable]:
    """Return tables in which the pieces of each part's curves are joined; a note says so.

    In most parts a counter column numbers them from 0 or 1, or states their sample offset. With a
    vague name, as `seq`, it must state offsets, or most pieces must continue the one before; else
    the rows stay apart, and a note says so. A part with a missing piece or several labels is left
    out as a fault. Pieces may be in several tables. A joined row stands where the part's first did,
    with each column's first filled cell. Other tables are returned as they are.

    Raises DataError if the pieces are numbered within another column than `options.part`.
    """
    import pandas as pd

    first = next(iter(tables.values())).frame
    words = {str(name): units.words_in(str(name)) for name in first}
    sure = [name for name in words if any(map(PIECE.fullmatch, words[name]))]
    counters = sure + [name for name in words if any(map(COUNTER.fullmatch, words[name]))]
    if not counters or not all(table.frame.columns.is_unique for table in tables.values()):
        return tables
    curve_names = curve_columns(first)
    counters = [name for name in dict.fromkeys(counters) if name not in curve_names]
    if not counters or not curve_names:
        return tables
    frame = pd.concat({source: table.frame for source, table in tables.items()})
    curves = [[split_curve(cell, is_short=True) for cell in frame[name]] for name in curve_names]
    others = [name for name in words if name not in (*curve_names, *counters, options.part)]
    for counter, part in itertools.product(counters, [options.part, *others]):
        if part == counter or part not in frame:
            continue
        pieces = _find_pieces(frame, curves, part, counter, options)
        if pieces is None:
            continue
        is_sure = counter in sure if part == options.part else len(pieces.counters) > 1
        if not is_sure and not pieces.are_continued:
            if part == options.part:
                do = f"if they are pieces of one curve, call column {counter} piece"
                collector.notes[f"Rows of one {part} are read as a curve each; {do}"] = 1
            continue
        if part != options.part:
            wanted = f"the column of parts whose pieces column {counter} counts"
            raise DataError(f"Expected {wanted}, as in part={part!r}.")
        for rows, why in pieces.faults:
            source, line = frame.index[min(rows)]
            collector.faults.append(Fault(source, line, why))
        n_pieces = sum(map(len, pieces.whole))
        text = f"{len(pieces.whole)} curves are joined of {n_pieces} pieces, in the order of column"
        again = f"; {pieces.n_repeated} came twice" if pieces.n_repeated else ""
        collector.notes[f"{text} {counter}{again}"] = 1
        whole = _join_rows(frame.drop(columns=pieces.counters), curve_names, curves, pieces.whole)
        sources = [source for source in tables if source in whole.index]
        return {source: tables[source]._replace(frame=whole.loc[source]) for source in sources}
    return tables


class _Pieces(NamedTuple):
    """Which rows of a table are the pieces of one curve.

    whole : list of list of int
        Positions of the rows of each part, in the order of its pieces.
    faults : list of (list of int, str)
        Those of the other parts, and what is wrong.
    are_continued : bool
        Whether the counter counts samples, or most pieces begin where the one before ends.
    n_repeated : int
        Number of pieces that were left out, because they came twice.
    counters : list of str
        The columns that tell the place of a piece, and how many there are.
    """

    whole: list[list[int]]
    faults: list[tuple[list[int], str]]
    are_continued: bool
    n_repeated: int
    counters: list[str]


def _find_pieces(
    frame: pd.DataFrame,
    curves: Sequence[Sequence[Sequence[Any] | None]],
    part: str,
    counter: str,
    options: LoadOptions,
) -> _Pieces | None:
    """Return each part's pieces by `counter`; None unless most parts have several and are whole.

    curves : the samples in each row, of each curve.
    """
    numbers, wrong = floats(frame[counter])
    if wrong or np.isnan(numbers).any() or (numbers % 1).any() or numbers.min() not in (0, 1):
        return None
    places = (numbers - numbers.min()).astype(int)
    rows_of_part = dict[str, list[int]]()
    for row in np.argsort(places, kind="stable").tolist():
        rows = rows_of_part.setdefault(str(frame[part].iloc[row]), [])
        last = rows[-1] if rows and places[rows[-1]] == places[row] else None
        if last is None or any(list(x[row] or ()) != list(x[last] or ()) for x in curves):
            rows.append(row)
    lengths = np.array([len(samples or ()) for samples in curves[0]])
    counted = {
        text: rows
        for text, rows in rows_of_part.items()
        if (places[rows] == range(len(rows))).all()
        or (places[rows] == np.cumsum(lengths[rows]) - lengths[rows]).all()
    }
    if 2 * sum(len(rows) > 1 for rows in counted.values()) <= len(rows_of_part):
        return None
    total, n_of_part = _stated_numbers(frame, rows_of_part, counted)
    usual, n_usual = Counter(map(len, counted.values())).most_common(1)[0]
    least = usual if n_usual >= MOST * len(rows_of_part) else 1
    label = _label_column(frame, options)
    whole = list[list[int]]()
    faults = list[tuple[list[int], str]]()
    for text, rows in rows_of_part.items():
        n = n_of_part.get(text, max(least, len(rows)))
        words = {str(cell) for cell in frame[label].iloc[rows]} if label else set()
        words = {word for word in words if word.lower() not in EMPTY_CELLS}
        if text not in counted or len(rows) != n:
            actual = f"{listed(map(str, numbers[rows].astype(int)))} by column {counter}"
            faults.append((rows, f"Expected all {n} pieces of {part} {text}, got {actual}"))
        elif len(words) > 1:
            actual = listed(sorted(words))
            faults.append((rows, f"Expected one label of {part} {text}, its pieces have {actual}"))
        else:
            whole.append(rows)
    if 2 * len(whole) <= len(rows_of_part):
        return None
    n_repeated = len(frame) - sum(map(len, rows_of_part.values()))
    is_by_samples = any(places[rows].max() > len(rows) for rows in whole)
    are_continued = is_by_samples or _are_continued(curves[0], whole)
    return _Pieces(whole, faults, are_continued, n_repeated, [counter, *total])


def _label_column(frame: pd.DataFrame, options: LoadOptions) -> str | None:
    """Return the column of labels that the user stated, or that has the name of one; else None."""
    columns = list(frame.columns)
    place = labels.column_among(columns, labels.LABEL_COLUMNS)
    if options.label is None and place is not None:
        return str(columns[place])
    return options.label if options.label in columns else None


def _stated_numbers(
    frame: pd.DataFrame,
    rows_of_part: Mapping[str, list[int]],
    counted: Mapping[str, list[int]],
) -> tuple[list[str], dict[str, int]]:
    """Return the column that states how many pieces there are, in a list, and this by part.

    It must be right for most parts. Both are empty without such a column.

    counted : the parts that seem whole, as `rows_of_part` has them.
    """
    for name in filter(TOTAL.fullmatch, frame.columns):
        numbers, wrong = floats(frame[name])
        n_right = sum((numbers[rows] == len(rows)).all() for rows in counted.values())
        if not wrong and 2 * n_right > len(rows_of_part):
            first = {text: numbers[rows[0]] for text, rows in rows_of_part.items()}
            return [name], {text: int(n) for text, n in first.items() if n > 0}
    return [], {}


def _are_continued(samples: Sequence[Sequence[Any] | None], whole: Sequence[Sequence[int]]) -> bool:
    """Return whether pieces begin where the one before ends, rather than where all begin."""
    from_end = []
    from_start = []
    for rows in whole:
        for row, after in itertools.pairwise(rows):
            with suppress(
                TypeError, ValueError, IndexError, StopIteration
            ):  # samples that are no numbers
                before = list(samples[row] or ())
                begin = float(next(iter(samples[after] or ())))
                from_end.append(abs(begin - float(before[-1])))
                from_start.append(abs(begin - float(before[0])))
    return bool(from_end) and 2 * np.median(from_end) < np.median(from_start)


def _join_rows(
    frame: pd.DataFrame,
    names: Sequence[str],
    curves: Sequence[Sequence[Sequence[Any] | None]],
    whole: Sequence[Sequence[int]],
) -> pd.DataFrame:
    """Return a table with one row for each list of rows, in the order of the first of each.

    names, curves : columns of samples, and the samples in each row.
    """
    in_order = sorted(whole, key=min)
    joined = frame.iloc[[min(rows) for rows in in_order]].copy()
    for name in frame.columns.difference(names):
        cells = frame[name].tolist()
        filled = (
            [cells[i] for i in rows if str(cells[i]).lower() not in EMPTY_CELLS]
            for rows in in_order
        )
        joined[name] = [next(iter(values), "") for values in filled]
    for name, samples in zip(names, curves, strict=True):
        pieces = ([samples[row] or ["no samples"] for row in rows] for rows in in_order)
        joined[name] = [list(itertools.chain.from_iterable(lists)) for lists in pieces]
    return joined
