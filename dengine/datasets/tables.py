"""Tables: a folder of CSV files, one an insertion; or a wide one, a row an insertion, as CSV, Parquet or a DataFrame.

Columns `FZ_0 … FZ_999` of a wide table are a channel FZ, `0 … 999` or `x1 … x1000` one without need of a name; further
channels have as many.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, listed
from ..files import must_fit, reading
from ..traces import is_time
from . import labels
from .dataset import Asked, Collected, Dataset, Fault, Recorded, UnreadableError, as_dataset
from .text import floats, header_of, numbers, read_recording, read_table

if TYPE_CHECKING:
    import pandas as pd

FORCE = "FZ_Base"  # what a UR cell calls the force along the insertion
NUMBERED = re.compile(r"(.*?)[_\-. \[]*(\d+)\]?")


def read_folder(folder: Path, name: str, asked: Asked) -> Dataset:
    """The recordings below a folder, `run_2.csv` before `run_10.csv`; DataError where none can be read."""
    skipped = None if asked.labels is None else Path(asked.labels).resolve()
    paths = [p for p in folder.rglob("*") if p.suffix.lower() == ".csv" and (p.is_file() or p.is_symlink())]
    seen = {p.relative_to(folder): p for p in paths if p.resolve() != skipped}
    named = {p.as_posix(): path for p, path in seen.items() if not any(word.startswith(".") for word in p.parts)}
    if not named:
        raise DataError(f"Expected CSV files, one an insertion, in the folder {folder}, found none.")
    ordered = {name: named[name] for name in sorted(named, key=natural)}
    if asked.labels is None and asked.part != "part":
        raise DataError(f"Expected a file of labels with a column {asked.part}: a folder's names tell no parts' numbers.")
    told = labels.named(asked.label) if asked.labels is None else labels.listed(asked.labels, asked.part, list(named))
    found = Collected(name, asked.channels or _usual_channel(ordered, folder))
    labels.collect(_recordings(ordered, found, timed=asked.rate_hz is None), told, found)
    return as_dataset(found, asked)


def natural(name: str) -> list[tuple[int, int, str]]:
    """A key that sorts numbers in a name by their size."""
    words = re.split(r"(\d+)", name.lower())
    return [(0, int(word), "") if word.isdecimal() else (1, 0, word) for word in words if word]


def _usual_channel(paths: dict[str, Path], folder: Path) -> tuple[str, ...]:
    """The force, or the only channel that there is."""
    headers = Counter(_header(path) for path in paths.values() if os.access(path, os.R_OK))
    if not headers or any(FORCE.lower() in map(str.lower, header) for header in headers):
        return (FORCE,)
    usual = headers.most_common(1)[0][0]
    if len(usual) != 1:
        have = ", ".join(usual) or "none"
        raise DataError(f"Expected the channel to be named, as in channel={FORCE!r}; the columns of {folder} are {have}.")
    return usual


def _header(path: Path) -> tuple[str, ...]:
    """The channels' names in a file's first line."""
    with path.open("rb") as file:
        line = file.readline(2**20).decode("utf-8-sig", errors="replace").rstrip("\r\n")
    try:
        return tuple(name for name in header_of(line)[0] if name and not is_time(name))
    except UnreadableError:  # said when the whole file is read
        return ()


def _recordings(paths: dict[str, Path], found: Collected, timed: bool) -> Iterator[tuple[str, Any, float | None]]:
    for name, path in paths.items():
        try:
            yield name, *read_recording(path, found.channels, timed)
        except (OSError, UnreadableError) as error:
            found.faults.append(Fault(name, getattr(error, "line", 0), str(error)))
            yield name, None, None


def read_csv(path: Path, name: str, asked: Asked) -> Dataset:
    """One wide CSV file with a header."""
    import pandas as pd

    try:
        table = read_table(path)
        told = pd.Series([word for word in table.header if not word.isdecimal()], dtype=object)
        if 2 * (len(told) - len(floats(told)[1])) > len(table.header) > 2:
            raise DataError(f"Expected a header in {path}, its first line is of numbers; call it FZ_0, FZ_1, ..., label.")
        if not table.rows:
            raise DataError(f"Expected rows that can be read in {path}, found none.")
        frame = pd.DataFrame(table.rows, columns=table.header)
    except UnreadableError as error:
        raise DataError(f"Cannot read {path}: {error.fault(path.name)}.") from error
    return from_frame(frame, asked, name, path.name, table.faults, table.lines)


def read_parquet(path: Path, name: str, asked: Asked) -> Dataset:
    """One Parquet file, by pyarrow."""
    import pandas as pd

    with reading(path, "a Parquet file", "pyarrow", "files"):
        parquet: Any = import_module("pyarrow.parquet")  # untyped
        with parquet.ParquetFile(path) as file:
            about = file.metadata
        groups = (about.row_group(i).total_byte_size for i in range(about.num_row_groups))
        must_fit(max(float(sum(groups)), 8.0 * about.num_rows * about.num_columns), path)  # as claimed, or the cells alone
        frame = pd.read_parquet(path)
    return from_frame(frame, asked, name, path.name)


def from_frame(
    frame: pd.DataFrame,
    asked: Asked,
    name: str = "data",
    source: str = "row",
    faults: list[Fault] | None = None,
    lines: list[int] | None = None,
) -> Dataset:
    """A wide table in memory. lines : where each row stands in its file; None: rows count from 1.

    An empty cell before others is a NaN: the engine finds it, and the part is verified. A row whose last cells are empty is
    a shorter trace. A row with text in it, or no label, is a fault.
    """
    frame = frame.set_axis([str(name) for name in frame.columns], axis=1)
    twice = frame.columns[frame.columns.duplicated()]
    if len(twice):
        raise DataError(f"Expected each column once in {source}, {twice[0]} is there more often.")
    label = _label_column(frame, asked)
    if asked.part != "part" and asked.part not in frame:
        raise DataError(f"Expected a column {asked.part} of parts' numbers, found {listed(frame.columns)}.")
    wrong: dict[int, str] = {}
    channels, traces = _traces(frame.drop(columns=[c for c in (label, asked.part) if c in frame]), asked, wrong)
    found = Collected(name, tuple(n for n in channels if n), list(faults or []))
    lines = lines or list(range(1, len(frame) + 1))
    for i, (word, part) in enumerate(zip(frame[label].tolist(), _parts(frame, asked.part), strict=True)):
        try:
            if i in wrong:
                raise UnreadableError(wrong[i])
            found.read.append(Recorded(traces[i], labels.label_of(word), f"{source}, line {lines[i]}", part))
        except UnreadableError as error:
            found.faults.append(Fault(source, lines[i], error.what))
    return as_dataset(found, asked)


def _traces(frame: pd.DataFrame, asked: Asked, wrong: dict[int, str]) -> tuple[tuple[str, ...], list[NDArray[np.float32]]]:
    """The channels' names, and of each row (C, T): a row whose last cells are empty is a shorter trace."""
    columns = _sample_columns(list(frame.columns), asked)
    found = [numbers(frame[names]) for names in columns.values()]
    for what in (what for _, faults in found for what in faults.items()):
        wrong.setdefault(*what)
    block = np.stack([values for values, _ in found], axis=1)
    known: NDArray[np.bool_] = np.asarray(~np.isnan(block).all(axis=1))
    ends = np.where(known.any(axis=1), block.shape[2] - np.argmax(known[:, ::-1], axis=1), block.shape[2])
    return tuple(columns), [row[:, :end] for row, end in zip(block, ends.tolist(), strict=True)]


def _parts(frame: pd.DataFrame, column: str) -> list[str | None]:
    """Parts' numbers as text; None where there is none."""
    if column not in frame:
        return [None] * len(frame)
    words = frame[column].astype("object").where(frame[column].notna(), "").tolist()
    return [str(part).removesuffix(".0").strip() or None for part in words]


def _label_column(frame: pd.DataFrame, asked: Asked) -> str:
    if asked.label is not None:
        if asked.label not in frame:
            raise DataError(f"Expected a column {asked.label} of labels, found {listed(frame.columns)}.")
        return asked.label
    lower = {c.lower(): c for c in frame.columns}
    for known in labels.LABEL_COLUMNS:
        if known in lower:
            return str(lower[known])
    if any(is_time(c) for c in frame.columns):
        raise DataError(f"Expected a row an insertion, got {listed(frame.columns)}, as in one recording; give its folder.")
    raise DataError(f"Expected a column of labels, y or label, found {listed(frame.columns)}; name it: label='...'.")


def _sample_columns(names: list[str], asked: Asked) -> dict[str, list[str]]:
    """Channel -> its columns, in the order of their numbers: where one is missing, what comes after it would be shifted."""
    groups: dict[str, list[tuple[int, str]]] = {}
    for name in names:
        found = NUMBERED.fullmatch(name)
        if found:
            groups.setdefault(found[1], []).append((int(found[2]), name))
    several = {name: sorted(those) for name, those in groups.items() if len(those) > 1}
    if not several:
        raise DataError(f"Expected samples in numbered columns, as FZ_0, FZ_1, ..., found {listed(names)}.")
    for those in several.values():
        steps = np.diff([number for number, _ in those])
        for i in np.flatnonzero(steps != np.median(steps))[:1].tolist():
            after = f"after {those[i][1]} comes {those[i + 1][1]}"
            raise DataError(f"Expected columns that are numbered one by one, {after}.")
    missing = [name for name in asked.channels if name not in several]
    if missing:
        raise DataError(f"Expected the channel {missing[0]}, in columns {missing[0]}_0 and so on, found {listed(several)}.")
    if not asked.channels and FORCE not in several and len(several) > 1:
        one = next(iter(several))
        raise DataError(f"Expected the channel to be named, as in channel={one!r}; there are {listed(several)}.")
    chosen = asked.channels or ((FORCE,) if FORCE in several else tuple(several))
    if len({len(several[name]) for name in chosen}) > 1:
        each = ", ".join(f"{name} {len(several[name])}" for name in chosen)
        raise DataError(f"Expected as many samples of each channel, got {each}.")
    return {name: [column for _, column in several[name]] for name in chosen}
