"""The layout of files and tables, and the parts in them."""

import re
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np

from ...errors import DataError, listed
from ..description import ANY, UNKNOWN, Channel, LabelSource, TextForm
from ..read.frames import join
from ..read.split import split
from ..table import Table
from . import labels
from .clock import NAME as CLOCK_NAME
from .columns import LEAST_RUN, Column, Proposal, Tables, columns_of

PART_NAME = re.compile(
    r"(?i)part|serial|episode|teil|werkst|barcode|dmc|trial|piece|sample_?id"
    r"|^(id|run|sn|cycle|shot|nr|no)$|_(id|run|cycle|sn|nr)$"
)
LEAST_NUMBERED = 20  # columns with numbers behind one name that are the samples of a part
MOST_PARTS = 240
Files = Sequence[Tables]  # the tables of each file


def layout_of(p: Proposal, files: Files) -> str:
    """Return how parts are laid out, `?` if nothing tells; find what tells rows apart.

    Raises DataError for a table of results without samples.
    """
    if _is_wide(p.description.format, files):
        return "npz" if p.description.format == "npz" else "wide"
    tables = [tables[0] if len(tables) == 1 else join(tables) for tables in files]
    columns = columns_of(tables, TextForm())
    stated = [columns[name] for name in p.description.part.column if name in columns]
    if _propose_part(p, columns.values()) or any(len(c.counts) > 1 for c in stated):
        return "long"
    if len(files) > 1:
        return "files"
    _refuse_results(columns.values())
    p.notes["layout"] = f"columns, a part in each, or long: part.column is of {listed(columns)}"
    return UNKNOWN


def _is_wide(kind: str, files: Files) -> bool:
    """Return whether a row, or an object, has all samples of a part."""
    first = files[0][0]
    is_json = kind in ("json", "jsonl") and (len(files) == 1 or len(files[0]) > 1)
    has_curves = is_json and max(map(len, first.columns.values())) > 1
    return kind == "ts" or has_curves or bool(numbered_columns(first)) or has_lists(first)


def _propose_part(p: Proposal, columns: Collection[Column]) -> bool:
    """Propose `part.column`, and return whether any column has runs, see `_has_runs`.

    It is the first column with runs that is named like a part. If none is, it is the only column
    with runs, or the only one of them with digits; `?` if there are several, or if a column that is
    named like a part has no runs. Without runs nothing is proposed.
    """
    runs = [column for column in columns if _has_runs(column)]
    numbered = [column for column in runs if re.search(r"\d", min(column.counts))]
    certain = [column for column in runs if PART_NAME.search(column.name)]
    named = [column for column in columns if PART_NAME.search(column.name)]
    best = certain or [*named, *(numbered or runs)]
    if runs:
        note = f"one of {listed(column.name for column in best)}" if len(best) > 1 else ""
        p.put("part.column", best[0].name if certain or len(best) == 1 else UNKNOWN, note)
    return bool(runs)


def numbered_columns(table: Table) -> list[str]:
    """Return the patterns of columns with numbers behind one name."""
    counts = Counter(re.sub(r"\d+$", ANY, name) for name in table.columns)
    return [pattern for pattern, n in counts.items() if n >= LEAST_NUMBERED]


def has_lists(table: Table) -> bool:
    """Return whether cells of a column are lists."""
    cells = [column[0] for column in table.columns.values() if len(column)]
    return any(isinstance(cell, list | np.ndarray) and len(cell) > 1 for cell in cells)


def _n_runs(column: Column) -> list[int]:
    """Return how many runs of equal words each table has."""
    return [int((words[1:] != words[:-1]).sum()) + 1 for words in column.words]


def _has_runs(column: Column) -> bool:
    """Return whether a column has one word for each of several runs of rows."""
    n_runs = _n_runs(column)
    is_unique = len(column.counts) == sum(n_runs) and "" not in column.counts
    is_long = column.counts.total() >= LEAST_RUN * sum(n_runs)
    if not is_unique or not is_long or sum(n > 1 for n in n_runs) <= len(n_runs) / 2:
        return False
    is_clock = CLOCK_NAME.search(column.name) and not PART_NAME.search(column.name)
    is_fraction = any(re.search(r"\d[.,]\d", word) for word in [*column.counts][:3])
    return not (is_clock or is_fraction or column.forms)


def _refuse_results(columns: Iterable[Column]) -> None:
    """Raise DataError for a table with a row for each result, and no samples."""
    for column in columns:
        is_short = column.counts.total() < LEAST_RUN * sum(_n_runs(column))
        source = labels.with_meanings(LabelSource(), column.counts if is_short else ())
        if labels.is_plain(source) and source.good and source.bad:
            actual = f"a row for each result, with its verdict in {column.name}, and no curve"
            where = column.tables[0].source
            do = "if the rows of parts are mixed, state part.column and time.sort=true"
            raise DataError(f"Expected the samples of each part in {where}, got {actual}; {do}.")


def parts_of(p: Proposal, files: Files) -> list[Table]:
    """Return the tables of the parts that are looked at.

    The last part of files that were read in part may be cut.
    """
    description, layout = p.description, p.description.layout
    patterns = [ANY] if layout == "columns" else numbered_columns(files[0][0])
    if layout == "columns":
        clock = [*filter(CLOCK_NAME.search, files[0][0].columns)]
        description = description.with_values({"time.column": clock})
    if layout in ("wide", "columns") and not description.channels:
        description = replace(description, channels=tuple(map(Channel, patterns)))
    parts = list[Table]()
    for tables in files:
        of_file = [part for part in split(tables, description) if not part.damage]
        is_cut = p.is_cut and layout == "long" and len(of_file) > 1
        parts += of_file[: len(of_file) - is_cut]
    return parts[:MOST_PARTS]
