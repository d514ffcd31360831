"""The layout of files and tables, and the parts in them."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...errors import DataError, listed
from ..dataset import Fault
from ..description import ANY, UNKNOWN, Channel, Description, LabelSource, TextForm
from ..read.frames import join
from ..read.places import Place
from ..read.split import split
from ..table import Table
from . import labels
from .cells import MOST_WORDS, Notes, Tables, columns_of
from .clock import NAME as CLOCK_NAME

PART_NAME = re.compile(
    r"(?i)part|serial|episode|teil|werkst|barcode|dmc|trial|piece|sample_?id"
    r"|^(id|run|sn|cycle|shot|nr|no)$|_(id|run|cycle|sn|nr)$"
)
LEAST_NUMBERED = 20  # columns with numbers behind one name that are the samples of a part
LEAST_RUN = 8  # rows of a part
LEAST_PARTS = 8  # columns of parts beside each other
MOST_PARTS = 240
Files = Sequence[Tables]  # the tables of each file


def layout_of(start: Description, files: Files) -> str:
    """Return how parts are laid out: in files, rows or columns.

    Raises DataError for a table of results without samples.
    """
    first = files[0][0]
    kind = start.format
    if kind in ("json", "jsonl") and (len(files) == 1 or len(files[0]) > 1):
        return "wide" if max(map(len, first.columns.values())) > 1 else "long"
    if kind == "ts" or numbered_columns(first) or _has_lists(first):
        return "wide"
    stated = [first.words(name) for name in start.part.column if name in first.columns]
    if max(map(len, map(set, stated)), default=0) > 1 or run_columns(
        [tables[0] for tables in files]
    ):
        return "long"
    if len(files) > 1:
        return "files"
    _refuse_results(first)
    return "columns" if _has_curves(first) else "long"


def _has_curves(table: Table) -> bool:
    """Return whether most columns are parts: their names are alike but for numbers, or verdicts."""
    names = [name for name in table.columns if not CLOCK_NAME.search(name)]
    shapes = Counter(re.sub(r"\d+", "0", name) for name in names)
    are_alike = max(shapes.values(), default=0) > len(names) / 2
    are_verdicts = len(names) > 1 and bool(labels.in_paths(names))
    return are_verdicts or (are_alike and len(names) >= LEAST_PARTS)


def numbered_columns(table: Table) -> list[str]:
    """Return the patterns of columns with numbers behind one name."""
    counts = Counter(f"{m[1]}*" for name in table.columns if (m := re.fullmatch(r"(.*?)\d+", name)))
    return [pattern for pattern, n in counts.items() if n >= LEAST_NUMBERED]


def _has_lists(table: Table) -> bool:
    """Return whether cells of a column are lists."""
    cells = [column[0] for column in table.columns.values() if len(column)]
    return any(isinstance(cell, list | np.ndarray) and len(cell) > 1 for cell in cells)


def run_columns(tables: Tables) -> list[str]:
    """Return the columns that have one word for each of several runs of rows.

    In a column of parts no word returns, also in another file, and its runs are of 8 rows or more
    in the mean. First stand those with the name of a part, then those with most runs.
    """
    columns = []
    for column in columns_of(tables, TextForm()).values():
        n_runs = [int((words[1:] != words[:-1]).sum()) + 1 for words in column.words]
        n_rows = sum(map(len, column.words))
        is_part = PART_NAME.search(column.name) is not None
        is_clock = (CLOCK_NAME.search(column.name) and not is_part) or column.time_forms
        is_fraction = any(re.search(r"\d[.,]\d", word) for word in [*column.counts][:3])
        is_unique = len(column.counts) == sum(n_runs) and "" not in column.counts
        is_long = n_rows >= LEAST_RUN * sum(n_runs) and sum(n > 1 for n in n_runs) > len(tables) / 2
        if is_unique and is_long and not is_fraction and not is_clock:
            columns.append((not is_part, -sum(n_runs), column.name))
    return [name for *_, name in sorted(columns)]


def _refuse_results(table: Table) -> None:
    """Raise DataError for a table with a row for each result, and no samples."""
    for column in columns_of([table], TextForm()).values():
        few = column.odd and len(column.counts) < MOST_WORDS
        source = labels.with_meanings(LabelSource(), column.counts if few else ())
        edges = np.flatnonzero(column.words[0][1:] != column.words[0][:-1]) if few else np.empty(0)
        in_runs = len(edges) > 1 and int(np.gcd.reduce(np.diff(edges))) >= LEAST_RUN
        if source.good and source.bad and UNKNOWN not in source.good + source.bad and not in_runs:
            actual = f"a row for each result, with its verdict in {column.name}, and no curve"
            raise DataError(f"Expected the samples of each part in {table.source}, got {actual}.")


def part_columns(files: Files, notes: Notes) -> list[str]:
    """Return the column that tells the parts of a long table apart; `?` if several may.

    It has the name of a part, or is the only one whose words have numbers in them.
    """
    tables = [tables[0] if len(tables) == 1 else join(tables) for tables in files]
    candidates = run_columns(tables)
    named = [name for name in candidates if PART_NAME.search(name)]
    numbered = [name for name in candidates if re.search(r"\d", str(tables[0].words(name)[0]))]
    best = named[:1] or numbered
    if len(best) == 1:
        notes |= {"part.column": f"one of {listed(named)}"} if len(named) > 1 else {}
        return best
    notes["part.column"] = f"one, or several, of {listed(candidates or tables[0].columns)}"
    return [UNKNOWN]


def places_of(files: Files, description: Description, is_cut: bool) -> dict[str, Place]:
    """Return where each part stands that was looked at, by its source.

    is_cut : whether files were read in part, so that the last part may be cut.
    """
    patterns = numbered_columns(files[0][0])
    if description.layout == "columns":
        clock = [name for name in files[0][0].columns if CLOCK_NAME.search(name)]
        description = description.with_values({"time.column": clock})
        curves = [name for name in files[0][0].columns if name not in clock]
        stem = re.split(r"\d", curves[0])[0]
        is_common = all(name.startswith(stem) for name in curves)
        patterns = [f"{stem}{ANY}" if is_common else ANY]
    if description.layout in ("wide", "columns") and not description.channels:
        description = replace(description, channels=tuple(map(Channel, patterns)))
    places = dict[str, Place]()
    faults: list[Fault] = []
    for tables in files:
        parts = list(split(tables, tables[0].source, description, faults))
        is_long = description.layout == "long" and len(parts) > 1
        parts = parts[:-1] if is_cut and is_long else parts
        for source, path, table in parts[: MOST_PARTS - len(places)]:
            places[source] = Place(path, table)
    return places
