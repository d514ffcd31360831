"""Wide tables, a row an insertion: CSV, Parquet, or a DataFrame; samples in numbered columns, and one column of labels.

Columns `FZ_0 … FZ_999` are a channel FZ, `0 … 999` or `x1 … x1000` one without need of a name; further channels have
as many. Or a column a channel, whose cells are lists of numbers, as Parquet keeps them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, listed
from ..files import UNREADABLE, must_fit
from ..traces import is_time
from .dataset import Asked, Dataset, Fault, UnreadableError
from .folders import FORCE
from .labels import LABEL_COLUMNS, label_of
from .lengths import Collected, Recorded, as_dataset
from .text import is_number, numbers, read_table

if TYPE_CHECKING:
    import pandas as pd

NUMBERED = re.compile(r"(.*?)[_\-. \[]*(\d+)\]?")


def read_csv(path: Path, name: str, asked: Asked) -> Dataset:
    """One CSV file with a header."""
    try:
        table = read_table(path)
        if 2 * sum(is_number(word) and not word.isdecimal() for word in table.header) > len(table.header) > 2:
            raise DataError(f"Expected a header in {path}, its first line is of numbers; call it FZ_0, FZ_1, ..., label.")
        if not table.rows:
            raise DataError(f"Expected rows that can be read in {path}, found none.")
        frame = table.frame().set_axis(table.header, axis=1)
    except UnreadableError as error:
        raise DataError(f"Cannot read {path}: {error.fault(path.name)}.") from error
    return from_frame(frame, asked, name, path.name, table.faults, table.lines)


def read_parquet(path: Path, name: str, asked: Asked) -> Dataset:
    """One Parquet file, by pyarrow."""
    import pandas as pd

    if find_spec("pyarrow") is None:
        raise DataError('Expected pyarrow for Parquet files, it is not installed: pip install "dengine[files]".')
    parquet: Any = import_module("pyarrow.parquet")  # untyped
    try:
        with parquet.ParquetFile(path) as file:
            about = file.metadata
        groups = (about.row_group(i).total_byte_size for i in range(about.num_row_groups))
        must_fit(max(float(sum(groups)), 8.0 * about.num_rows * about.num_columns), path)  # as claimed, or the cells alone
        frame = pd.read_parquet(path)
    except UNREADABLE as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"Cannot read {path} as a Parquet file: {error}.") from error
    return from_frame(frame, asked, name, path.name)


def from_frame(
    frame: pd.DataFrame,
    asked: Asked,
    name: str = "data",
    source: str = "row",
    faults: list[Fault] | None = None,
    lines: list[int] | None = None,
) -> Dataset:
    """A table in memory. lines : where each row stands in its file; None: rows count from 1.

    An empty cell before others is a NaN: the engine finds it, and the part is verified. A row whose last cells are empty is
    a shorter trace. A row with text in it, or no label, is a fault.
    """
    levels = [each if isinstance(each, tuple) else (each,) for each in frame.columns]  # FZ and 0 are FZ_0
    frame = frame.set_axis(["_".join(str(word) for word in words if word != "") for words in levels], axis=1)
    twice = frame.columns[frame.columns.duplicated()]
    if len(twice):
        raise DataError(f"Expected each column once in {source}, {twice[0]} is there more often.")
    label = _label_column(frame, asked)
    if asked.part != "part" and asked.part not in frame:
        raise DataError(f"Expected a column {asked.part} of parts' numbers, found {listed(frame.columns)}.")
    wrong: dict[int, str] = {}
    channels, traces = _traces(frame.drop(columns=[c for c in (label, asked.part) if c in frame]), asked, wrong)
    y, parts = _labels(frame[label], wrong), _parts(frame, asked.part)
    lines = lines or list(range(1, len(frame) + 1))
    left_out = [Fault(source, lines[i], what) for i, what in sorted(wrong.items())]
    found = Collected(name, tuple(n for n in channels if n), [*(faults or []), *left_out])
    for i in (i for i in range(len(frame)) if i not in wrong):
        found.read.append(Recorded(traces[i], int(y[i]), f"{source}, line {lines[i]}", parts[i], None))
    return as_dataset(found, asked)


def _traces(frame: pd.DataFrame, asked: Asked, wrong: dict[int, str]) -> tuple[tuple[str, ...], list[NDArray[np.float32]]]:
    """The channels' names, and of each row (C, T): a row whose last cells are empty is a shorter trace."""
    lists = {c: [c] for c in frame.columns if any(isinstance(cell, list | np.ndarray) for cell in frame[c])}
    if lists:
        chosen = _chosen(lists, asked)
        return chosen, [_of_lists(row, i, wrong) for i, row in enumerate(frame[list(chosen)].to_numpy())]
    columns = _sample_columns(list(frame.columns), asked)
    found = [numbers(frame[names]) for names in columns.values()]
    for what in (what for _, faults in found for what in faults.items()):
        wrong.setdefault(*what)
    block = np.stack([values for values, _ in found], axis=1)
    known: NDArray[np.bool_] = np.asarray(~np.isnan(block).all(axis=1))
    ends = np.where(known.any(axis=1), block.shape[2] - np.argmax(known[:, ::-1], axis=1), block.shape[2])
    return tuple(columns), [row[:, :end] for row, end in zip(block, ends.tolist(), strict=True)]


def _of_lists(cells: NDArray[Any], place: int, wrong: dict[int, str]) -> NDArray[np.float32]:
    """A row's channels, a list each, as (C, T)."""
    try:
        trace = np.stack([np.asarray(cell, dtype=np.float32) for cell in cells])
    except (TypeError, ValueError):
        trace = np.empty(0, dtype=np.float32)
    if trace.ndim != 2 or not trace.size:
        wrong[place] = "Expected a list of numbers in each channel, all of one length, got something else"
    return trace


def _parts(frame: pd.DataFrame, column: str) -> list[str | None]:
    """Parts' numbers as text; None where there is none."""
    if column not in frame:
        return [None] * len(frame)
    known = frame[column].notna()
    words = [str(part).removesuffix(".0").strip() for part in frame[column].tolist()]
    return [word or None if there else None for word, there in zip(words, known, strict=True)]


def _label_column(frame: pd.DataFrame, asked: Asked) -> str:
    if asked.label is not None:
        if asked.label not in frame:
            raise DataError(f"Expected a column {asked.label} of labels, found {listed(frame.columns)}.")
        return asked.label
    lower = {c.lower(): c for c in frame.columns}
    for known in LABEL_COLUMNS:
        if known in lower:
            return str(lower[known])
    if any(is_time(c) for c in frame.columns):
        raise DataError(f"Expected a row an insertion, got {listed(frame.columns)}, as in one recording; give its folder.")
    raise DataError(f"Expected a column of labels, y or label, found {listed(frame.columns)}; name it: label='...'.")


def _sample_columns(names: list[str], asked: Asked) -> dict[str, list[str]]:
    """Channel -> its columns, in the order of their numbers."""
    groups: dict[str, list[tuple[int, str]]] = {}
    for name in names:
        found = NUMBERED.fullmatch(name)
        if found:
            groups.setdefault(found[1], []).append((int(found[2]), name))
    several = {name: _in_order(sorted(those)) for name, those in groups.items() if len(those) > 1}
    if not several:
        raise DataError(f"Expected samples in numbered columns, as FZ_0, FZ_1, ..., found {listed(names)}.")
    chosen = _chosen(several, asked)
    sizes = {len(several[name]) for name in chosen}
    if len(sizes) > 1:
        each = ", ".join(f"{name} {len(several[name])}" for name in chosen)
        raise DataError(f"Expected as many samples of each channel, got {each}.")
    return {name: several[name] for name in chosen}


def _in_order(numbered: list[tuple[int, str]]) -> list[str]:
    """Names by their numbers; DataError where one is missing, or there twice: what comes after it would be shifted."""
    steps = np.diff([number for number, _ in numbered])
    uneven = np.flatnonzero(steps != np.median(steps))
    if len(uneven):
        before, after = (numbered[int(uneven[0]) + i][1] for i in (0, 1))
        raise DataError(f"Expected columns that are numbered one by one, after {before} comes {after}.")
    return [name for _, name in numbered]


def _chosen(have: Mapping[str, list[str]], asked: Asked) -> tuple[str, ...]:
    missing = [name for name in asked.channels if name not in have]
    if missing:
        raise DataError(f"Expected the channel {missing[0]}, in columns {missing[0]}_0 and so on, found {listed(have)}.")
    if asked.channels:
        return asked.channels
    if FORCE in have or len(have) == 1:
        return (FORCE,) if FORCE in have else tuple(have)
    raise DataError(f"Expected the channel to be named, as in channel={next(iter(have))!r}; there are {listed(have)}.")


def _labels(column: pd.Series, wrong: dict[int, str]) -> NDArray[np.int8]:
    y = np.zeros(len(column), dtype=np.int8)
    for i, word in enumerate(column.tolist()):
        try:
            y[i] = label_of(word)
        except UnreadableError as error:
            wrong.setdefault(i, error.what)
    return y
