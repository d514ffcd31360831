"""Curves in single cells of a table: a row for each part, and all of its samples in one cell.

Databases and test benches write such cells: a list as Parquet and JSON have it, or a text as
`[0.1, 0.2, 0.3]`, `0.1;0.2;0.3` or `0,1 0,2 0,3`. `expand_curves` makes a wide table of them.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import excerpt
from ..traces import is_time_column
from . import units
from .clocks import clock_of, rate_of
from .dataset import LoadOptions

if TYPE_CHECKING:
    import pandas as pd

MIN_SAMPLES = 8  # of a curve; a list of fewer numbers is of something else
SAME_RATE = 0.03  # by which the rates of curves may differ
NUMBER = r"(?:[-+−]?\.?\d[\d.eE+\-−]*|nan|null|NaN|None)"
ITEMS = rf"{NUMBER}(?:(?:\s*[,;|]\s*|\s+){NUMBER}){{{MIN_SAMPLES - 1},}}"
BRACKETED = rf"[\[({{]\s*{ITEMS}\s*[\])}}]"
CURVE = re.compile(rf"\s*(?:{BRACKETED}|{ITEMS}[;|,]?)\s*")
# The same with fewer numbers, but not one with a comma, which may be the decimal mark of one.
SHORT = re.compile(rf"(?!\s*\d+,\d+\s*$){CURVE.pattern.replace(f'{{{MIN_SAMPLES - 1},}}', '*')}")
UNQUOTED = re.compile(rf'(?<!")\[\s*{ITEMS}\s*\](?!")')  # its commas would be delimiters
# A curve in a line of text: in quotes or brackets, or between delimiters of another kind.
BETWEEN = "|".join(
    rf"(?:^|(?<={mark})){NUMBER}(?:[{others}]{NUMBER}){{{MIN_SAMPLES - 1},}}(?={mark})"
    rf"|(?<={mark}){NUMBER}(?:[{others}]{NUMBER}){{{MIN_SAMPLES - 1},}}$"
    for mark, others in ((";", ", |"), (",", "; |"), ("\t", ",; |"), (r"\|", ",; "))
)
IN_LINE = rf'"\s*(?:{BRACKETED}|{ITEMS}[;|,]?)\s*"|{BRACKETED}|{BETWEEN}'


def split_curve(cell: Any, *, is_short: bool = False) -> list[Any] | None:
    """Return the samples in a cell, those of a text as texts with a decimal point.

    None if the cell is neither a list of plain items nor a text of eight numbers or more, or with
    `is_short` of fewer.
    """
    if isinstance(cell, list | tuple | np.ndarray):
        is_flat = len(cell) > 0 and not isinstance(cell[0], list | tuple | np.ndarray | dict)
        return list(cell) if is_flat else None
    if not isinstance(cell, str) or (SHORT if is_short else CURVE).fullmatch(cell) is None:
        return None
    text = cell.strip(" \t[](){};|,")
    if re.search(r"[;|\t]", text):
        items = re.split(r"\s*[;|\t]\s*", text)
    elif re.search(r",\s", text) or not re.search(r"\s", text):
        items = re.split(r"\s*,\s*", text)
    else:
        items = text.split()
    if not any("." in item for item in items):
        items = [item.replace(",", ".") for item in items]
    return [item.replace("−", "-") for item in items]


def write_curves(frame: pd.DataFrame) -> None:
    """Write the curves of a table of texts as `[0.1, 0.2]`, in place, as no number is written."""
    for i in range(frame.shape[1]):
        cells = frame.iloc[:, i].tolist()
        if split_curve(next(filter(None, cells), "")) is not None:
            curves = map(split_curve, cells)
            texts = [
                cell if curve is None else f"[{', '.join(curve)}]"
                for cell, curve in zip(cells, curves, strict=True)
            ]
            frame.isetitem(i, texts)


def curve_columns(frame: pd.DataFrame) -> list[str]:
    """Return the columns of a table whose first filled cell is a curve, or a list of numbers."""
    return [
        str(name)
        for name in frame.columns[~frame.columns.duplicated(keep=False)]
        if split_curve(next((c for c in frame[name] if not _is_empty(c)), None)) is not None
    ]


class Expanded(NamedTuple):
    """A table with a numbered column for each sample of its curves.

    frame : DataFrame
        The same object if no column has curves of eight samples or more.
    rate_hz : float or None
        By a column of curves that are clocks; None without one.
    clock : str
        The name of that column; "" without one.
    unread : list of str
        Columns of curves that were left out.
    wrong : dict
        Why rows were left out, by their lines.
    damaged : dict
        Why other rows are no samples, by their lines.
    notes : list of str
        Which columns are read as one.
    """

    frame: pd.DataFrame
    rate_hz: float | None = None
    clock: str = ""
    unread: Sequence[str] = ()
    wrong: Mapping[int, str] = {}
    damaged: Mapping[int, str] = {}
    notes: Sequence[str] = ()


def expand_curves(frame: pd.DataFrame, options: LoadOptions) -> Expanded:
    """Return a table with a numbered column for each sample of its curves, FZ_0, FZ_1, ...

    Only the stated channels are expanded, if all of them are curves. A shorter curve is filled with
    NaN. A row whose curves differ in length, or whose clock differs from those of most by more than
    3 %, is left out.
    """
    import pandas as pd

    curves = {name: [split_curve(cell) for cell in frame[name]] for name in curve_columns(frame)}
    renamed = _join_renamed(curves)
    clocks = [name for name in curves if name == options.time or is_time_column(name)]
    longest = {name: max(len(c) for c in cells if c is not None) for name, cells in curves.items()}
    channels = [name for name, n in longest.items() if name not in clocks and n >= MIN_SAMPLES]
    if not channels:
        return Expanded(frame)
    stated = [units.find_columns(name, channels) for name in options.channels]
    if stated and all(stated):
        channels = [channels[places[0]] for places in stated]
    others = frame.drop(columns=list(renamed))
    lists = [str(name) for name, cells in others.items() if any(map(_is_list, cells))]
    blocks = [others.drop(columns=[*curves, *lists])]
    damaged = dict[int, str]()
    for name in channels:
        block, odd = _samples_of(curves[name], name)
        damaged |= {frame.index[i]: why for i, why in odd.items()}
        columns = [f"{name}_{k}" for k in range(longest[name])]
        blocks.append(pd.DataFrame(block, index=frame.index, columns=columns))
    rate = None
    has_clock = bool(clocks) and options.rate_hz is None
    compared = [*clocks[:has_clock], *(channels if stated and all(stated) else channels[:1])]
    wrong = dict[int, str]()
    for i, line in enumerate(frame.index):
        in_row = {name: curves[name][i] for name in compared}
        lengths = {name: len(curve) for name, curve in in_row.items() if curve is not None}
        if len(set(lengths.values())) > 1:
            actual = ", ".join(f"{name} has {n}" for name, n in lengths.items())
            wrong[line] = f"Expected lists of one length, {actual} values"
    if has_clock:
        clock_cells = dict(zip(frame.index, curves[clocks[0]], strict=True))
        cells = {line: x for line, x in clock_cells.items() if line not in wrong and x is not None}
        rate, odd_rates = _rate_of_curves(cells, clocks[0])
        wrong |= odd_rates
    unread = [
        name for name in {**curves, **dict.fromkeys(lists)} if name not in (*channels, *clocks[:1])
    ]
    wide = pd.concat(blocks, axis=1).drop(index=list(wrong))
    clock = clocks[0] if rate else ""
    return Expanded(wide, rate, clock, unread, wrong, damaged, [*renamed.values()])


def _join_renamed(curves: dict[str, list[Any]]) -> dict[str, str]:
    """Join columns of curves that differ only by a unit that one of them names.

    Where no row has both, it is one channel that was renamed; case is ignored. `curves` is changed:
    the joined curves get the name with the unit. Returns a note by each name that is gone.
    """
    notes = dict[str, str]()
    for name, other in itertools.permutations([*curves], 2):
        plain, unit = units.split(name)
        if not unit or other.casefold() != plain.casefold() or other in notes:
            continue
        if any(a and b for a, b in zip(curves[name], curves[other], strict=True)):
            continue
        counts = [sum(map(bool, curves[column])) for column in (other, name)]
        text = f"{other} ({counts[0]} rows) and {name} ({counts[1]}) are read as one channel"
        curves[name] = [a or b for a, b in zip(curves[name], curves.pop(other), strict=True)]
        notes[other] = text
    return notes


def _is_empty(cell: Any) -> bool:
    """Return whether a cell of a table is empty, or no text and no list."""
    return cell == "" if isinstance(cell, str) else not _is_list(cell)


def _is_list(cell: Any) -> bool:
    """Return whether a cell of a table is a list, but no text."""
    return hasattr(cell, "__len__") and not isinstance(cell, str)


def _samples_of(
    curves: Sequence[Sequence[Any] | None], name: str
) -> tuple[NDArray[np.float64], dict[int, str]]:
    """Return the samples of a column's curves, shape (n, samples of the longest), and by its place
    what is wrong with a curve that is empty or has an item that is no number. NaN stands for null.
    """
    samples = np.full((len(curves), max(0 if c is None else len(c) for c in curves)), np.nan)
    damaged = dict[int, str]()
    for i, curve in enumerate(curves):
        if curve is None or not len(curve):
            damaged[i] = f"Expected a curve in column {name}, it is empty"
            continue
        for k, item in enumerate(curve):
            try:
                samples[i, k] = np.nan if item in (None, "null", "None") else float(item)
            except (TypeError, ValueError):
                what = f"a number as item {k + 1} of the curve in column {name}"
                damaged.setdefault(i, f"Expected {what}, got {excerpt(str(item))}")
    return samples, damaged


def _rate_of_curves(
    clocks: Mapping[int, Sequence[Any]], name: str
) -> tuple[float | None, dict[int, str]]:
    """Return the median rate by the clocks of curves, and what is wrong with other rows.

    These have a rate that differs by more than 3 %. The rate is None if none can be read.

    clocks : the times in each row that has some, by its line.
    """
    import pandas as pd

    rates = dict[int, float]()
    for line, times in clocks.items():
        clock = clock_of(pd.DataFrame({name: times}), name)
        if clock is not None:
            rates[line] = rate_of(clock, pd.RangeIndex(len(times)))
    if not rates:
        return None, {}
    usual = float(np.median(list(rates.values())))
    wanted = f"times in column {name} at {usual:g} Hz, as in most rows"
    do = "state rate_hz=... if the times are wrong"
    return usual, {
        line: f"Expected {wanted}, got {rate:g} Hz; {do}"
        for line, rate in rates.items()
        if abs(rate - usual) > SAME_RATE * usual
    }
