"""The layout of files and tables, and the parts in them."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...errors import DataError, listed
from ..dataset import Fault
from ..description import ANY, UNKNOWN, Channel, Description
from ..read.frames import join
from ..read.split import split
from ..table import Table
from . import labels
from .clock import NAME as CLOCK_NAME
from .columns import PART_NAME

LEAST_NUMBERED = 20  # columns with numbers behind one name that are the samples of a part
LEAST_RUN = 8  # rows of a part
LEAST_PARTS = 8  # columns of parts beside each other
MOST_VIEWS = 240
Tables = Sequence[Sequence[Table]]  # of each file


def layout_of(kind: str, files: Tables, stated: Mapping[str, Any]) -> str:
    """Return how parts are laid out: in files, rows, columns or arrays.

    Raises DataError for a table of results without samples.
    """
    first = files[0][0]
    if kind in ("json", "jsonl") and (len(files) == 1 or len(files[0]) > 1):
        return "wide" if any(len(column) > 1 for column in first.columns.values()) else "long"
    if kind == "ts" or numbered_columns(first) or _has_lists(first):
        return "wide"
    stated_part = np.atleast_1d(stated.get("part.column", [])).tolist()
    changes = any(len({*first.words(name)}) > 1 for name in stated_part if name in first.columns)
    if changes or run_columns([tables[0] for tables in files]):
        return "long"
    if len(files) > 1:
        return "files"
    _refuse_results(first)
    names = [name for name in first.columns if not CLOCK_NAME.search(name)]
    shapes = Counter(re.sub(r"\d+", "0", name) for name in names)
    alike = max(shapes.values(), default=0) > len(names) / 2
    are_parts = len(names) >= LEAST_PARTS and (alike or labels.path_sources(names))
    return "columns" if are_parts else "long"


def numbered_columns(table: Table) -> dict[str, int]:
    """Return the patterns of columns with numbers behind one name, with how many there are."""
    counts = Counter(f"{m[1]}*" for name in table.columns if (m := re.fullmatch(r"(.*?)\d+", name)))
    return {pattern: n for pattern, n in counts.items() if n >= LEAST_NUMBERED}


def _has_lists(table: Table) -> bool:
    """Return whether cells of a column are lists."""
    cells = [column[0] for column in table.columns.values() if len(column)]
    return any(isinstance(cell, list | np.ndarray) and len(cell) > 1 for cell in cells)


def run_columns(tables: Sequence[Table]) -> list[str]:
    """Return the columns that have one word for each of several runs of rows.

    In a column of parts no word returns, and its runs are of 8 rows or more in the mean. First
    stand those with the name of a part, then those with most runs.
    """
    found = []
    for name in tables[0].columns:
        runs = [_runs(table, name) for table in tables if name in table.columns]
        is_part = PART_NAME.search(name) is not None
        if sum(n > 1 for n in runs) > len(runs) / 2 and (is_part or not CLOCK_NAME.search(name)):
            found.append((not is_part, -sum(runs), name))
    return [name for *_, name in sorted(found)]


def _runs(table: Table, name: str) -> int:
    """Return the number of runs of equal words in a column; 0 if it is none of parts."""
    words = table.words(name)
    n = int((words[1:] != words[:-1]).sum()) + 1
    is_fraction = any(re.search(r"\d[.,]\d", str(word)) for word in words[:3])
    is_part = len(words) >= LEAST_RUN * n and len({*words}) == n and not is_fraction
    return n if is_part and "" not in words else 0


def _refuse_results(table: Table) -> None:
    """Raise DataError for a table with a row for each result, and no samples."""
    for name, column in table.columns.items():
        words = table.words(name) if column.dtype.kind == "O" else np.empty(0)
        different = {*words.tolist()}
        known = labels.with_meanings(labels.LabelSource(), different if len(different) < 12 else [])
        edges = np.flatnonzero(words[1:] != words[:-1])
        in_runs = len(edges) > 1 and int(np.gcd.reduce(np.diff(edges))) >= LEAST_RUN
        if known.good and known.bad and UNKNOWN not in known.good + known.bad and not in_runs:
            actual = f"a row for each result, with its verdict in {name}, and no curve"
            raise DataError(f"Expected the samples of each part in {table.source}, got {actual}.")


def part_columns(files: Tables, notes: dict[str, str]) -> list[str]:
    """Return the column that tells the parts of a long table apart; `?` if several may."""
    tables = [tables[0] if len(tables) == 1 else join(tables) for tables in files]
    found = run_columns(tables)
    named = [name for name in found if PART_NAME.search(name)] or found
    if len(named) > 1:
        notes["part.column"] = f"one of {listed(named)}"
    if len(named) == 1 or (named and PART_NAME.search(named[0])):
        return named[:1]
    notes["part.column"] = f"one, or several, of {listed(named or tables[0].columns)}"
    return [UNKNOWN]


def views_of(
    files: Tables, description: Description, is_cut: bool
) -> tuple[dict[str, Table], dict[str, str]]:
    """Return the table of each part that was looked at, and the path that names it, by its source.

    is_cut : whether files were read in part, so that the last part may be cut.
    """
    patterns = numbered_columns(files[0][0])
    if description.layout == "columns":
        names = [name for name in files[0][0].columns if not CLOCK_NAME.search(name)]
        stem = re.match(r"\D*", names[0])
        is_stem = stem and all(name.startswith(stem[0]) for name in names)
        patterns = {f"{stem[0]}{ANY}" if is_stem and stem else ANY: 1}
    guessed = description
    if description.layout in ("wide", "columns") and not description.channels:
        channels = tuple(Channel(pattern) for pattern in patterns)
        clock = tuple(name for name in files[0][0].columns if CLOCK_NAME.search(name))
        time = (
            description.time if description.layout == "wide" else _with_columns(description, clock)
        )
        guessed = Description(
            layout=description.layout, channels=channels, part=description.part, time=time
        )
    views, paths = dict[str, Table](), dict[str, str]()
    faults: list[Fault] = []
    for tables in files:
        found = list(split(tables, tables[0].source, guessed, faults))
        found = found[:-1] if is_cut and description.layout == "long" and len(found) > 1 else found
        for source, path, table in found[: MOST_VIEWS - len(views)]:
            views[source] = table
            paths[source] = path
    return views, paths


def _with_columns(description: Description, columns: tuple[str, ...]) -> Any:
    """Return the clock of a description with other columns."""
    return description.with_values({"time.column": list(columns)}).time
