"""The layout of files and tables, and the parts in them."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...errors import DataError, listed
from ..dataset import Fault
from ..description import ANY, UNKNOWN, Channel, LabelSource, TextForm
from ..read.frames import join
from ..read.places import Place
from ..read.split import split
from ..table import Table
from . import labels
from .clock import NAME as CLOCK_NAME
from .columns import MOST_WORDS, Column, Proposal, Tables, columns_of

PART_NAME = re.compile(
    r"(?i)part|serial|episode|teil|werkst|barcode|dmc|trial|piece|sample_?id"
    r"|^(id|run|sn|cycle|shot|nr|no)$|_(id|run|cycle|sn|nr)$"
)
LEAST_NUMBERED = 20  # columns with numbers behind one name that are the samples of a part
LEAST_RUN = 8  # rows of a part
LEAST_PARTS = 8  # columns of parts beside each other
MOST_PARTS = 240
Files = Sequence[Tables]  # the tables of each file


def layout_of(p: Proposal, files: Files) -> str:
    """Return how parts are laid out: in files, rows or columns.

    Raises DataError for a table of results without samples.
    """
    first, kind = files[0][0], p.description.format
    stated = [c for c in p.description.part.column if c in first.columns]
    if kind in ("json", "jsonl") and (len(files) == 1 or len(files[0]) > 1):
        return "wide" if max(map(len, first.columns.values())) > 1 else "long"
    if kind == "ts" or numbered_columns(first) or _has_lists(first):
        return "wide"
    if any(len({*first.words(name)}) > 1 for name in stated):
        return "long"
    if run_columns([tables[0] for tables in files]):
        return "long"
    if len(files) > 1:
        return "files"
    _refuse_results(first)
    names = [name for name in first.columns if not CLOCK_NAME.search(name)]
    shapes = Counter(re.sub(r"\d+", "0", name) for name in names)
    are_alike = len(names) >= LEAST_PARTS and max(shapes.values()) > len(names) / 2
    are_verdicts = len(names) > 1 and labels.in_paths(names)
    return "columns" if are_alike or are_verdicts else "long"


def numbered_columns(table: Table) -> list[str]:
    """Return the patterns of columns with numbers behind one name."""
    counts = Counter(re.sub(r"\d+$", ANY, name) for name in table.columns)
    return [pattern for pattern, n in counts.items() if n >= LEAST_NUMBERED]


def _has_lists(table: Table) -> bool:
    """Return whether cells of a column are lists."""
    cells = [column[0] for column in table.columns.values() if len(column)]
    return any(isinstance(cell, list | np.ndarray) and len(cell) > 1 for cell in cells)


def run_columns(tables: Tables) -> list[str]:
    """Return the columns that may tell parts apart: those with the name of a part, or else all.

    In such a column no word returns, also in another file, and its runs are of 8 rows or more in
    the mean.
    """
    columns = [column for column in columns_of(tables, TextForm()).values() if _has_runs(column)]
    named = [column.name for column in columns if PART_NAME.search(column.name)]
    return named or [column.name for column in columns]


def _has_runs(column: Column) -> bool:
    """Return whether a column has one word for each of several runs of rows."""
    n_runs = [int((words[1:] != words[:-1]).sum()) + 1 for words in column.words]
    is_unique = len(column.counts) == sum(n_runs) and "" not in column.counts
    is_long = column.counts.total() >= LEAST_RUN * sum(n_runs)
    if not is_unique or not is_long or sum(n > 1 for n in n_runs) <= len(n_runs) / 2:
        return False
    is_clock = CLOCK_NAME.search(column.name) and not PART_NAME.search(column.name)
    is_fraction = any(re.search(r"\d[.,]\d", word) for word in [*column.counts][:3])
    return not (is_clock or is_fraction or column.forms)


def _refuse_results(table: Table) -> None:
    """Raise DataError for a table with a row for each result, and no samples."""
    for column in columns_of([table], TextForm()).values():
        words = column.counts if column.odd and len(column.counts) < MOST_WORDS else ()
        source = labels.with_meanings(LabelSource(), words)
        edges = np.flatnonzero(column.words[0][1:] != column.words[0][:-1]) if words else ()
        in_runs = len(edges) > 1 and int(np.gcd.reduce(np.diff(edges))) >= LEAST_RUN
        if labels.is_plain(source) and source.good and source.bad and not in_runs:
            actual = f"a row for each result, with its verdict in {column.name}, and no curve"
            raise DataError(f"Expected the samples of each part in {table.source}, got {actual}.")


def propose_parts(p: Proposal, files: Files) -> None:
    """Find the column that tells the parts of a long table apart; `?` if several may.

    It has the name of a part, or is the only one whose words have numbers in them.
    """
    tables = [tables[0] if len(tables) == 1 else join(tables) for tables in files]
    names = run_columns(tables)
    best = [c for c in names if re.search(r"\d", str(tables[0].words(c)[0]))]
    best = names[:1] if names and PART_NAME.search(names[0]) else best
    note = f"one of {listed(names)}" if len(names) > 1 else ""
    if len(best) == 1:
        p.put("part.column", best, note)
    else:
        note = f"one, or several, of {listed(names or tables[0].columns)}"
        p.put("part.column", UNKNOWN, note)


def places_of(p: Proposal, files: Files) -> dict[str, Place]:
    """Return where each part stands that was looked at, by its source.

    The last part of files that were read in part may be cut.
    """
    description, layout = p.description, p.description.layout
    first = files[0][0].columns
    patterns = numbered_columns(files[0][0])
    if layout == "columns":
        clock = [name for name in first if CLOCK_NAME.search(name)]
        curves = [name for name in first if name not in clock]
        stem = re.split(r"\d", curves[0])[0]
        patterns = [f"{stem}{ANY}" if all(name.startswith(stem) for name in curves) else ANY]
        description = description.with_values({"time.column": clock})
    if layout in ("wide", "columns") and not description.channels:
        description = replace(description, channels=tuple(map(Channel, patterns)))
    places = dict[str, Place]()
    faults: list[Fault] = []
    for tables in files:
        parts = list(split(tables, tables[0].source, description, faults))
        is_cut = p.is_cut and layout == "long" and len(parts) > 1
        for source, path, table in parts[: len(parts) - is_cut][: MOST_PARTS - len(places)]:
            places[source] = Place(path, table)
    return places
