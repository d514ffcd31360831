"""The layout of files and tables, and the parts in them."""

import re
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import replace

import numpy as np

from ...errors import DataError, listed
from ..description import ANY, UNKNOWN, Channel, LabelSource, TextForm
from ..read.split import OBJECTS, split
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


def layout_of(p: Proposal, files: Tables) -> str:
    """Return how parts are laid out, as `Description.layout` has it; `?` if nothing tells.

    It is `long` if a column has runs of equal words, which `part.column` then becomes in `p` (`?`
    if there are several), or if the stated column has several words. Nothing tells for a single
    table without such a column; `p.notes` then says what to state. Raises DataError for a table
    with one row for each verdict and no samples.
    """
    kind = p.description.format
    first = files[0]
    if kind in OBJECTS and len(files) > 1 and len(first.lines) == 1:
        return "files"
    if numbered_columns(first) or has_lists(first):
        return "npz" if kind == "npz" else "wide"
    columns = columns_of(files, TextForm())
    stated = [columns[name] for name in p.description.part.column if name in columns]
    if _propose_part(p, columns.values()) or any(len(c.counts) > 1 for c in stated):
        return "long"
    if len(files) > 1:
        return "files"
    _refuse_results(columns.values())
    p.notes["layout"] = f"columns, a part in each, or long: part.column is of {listed(columns)}"
    return UNKNOWN


def _propose_part(p: Proposal, columns: Collection[Column]) -> bool:
    """Propose `part.column`, and return whether any column has runs, see `_has_runs`.

    It is the first column with runs that is named like a part, or else the only column that has
    runs or such a name; `?` if there are several. Without runs nothing is proposed.
    """
    runs = [column.name for column in columns if _has_runs(column)]
    named = [column.name for column in columns if PART_NAME.search(column.name)]
    certain = [name for name in runs if name in named]
    best = certain or [*named, *runs]
    if runs:
        is_clear = certain or len(best) == 1
        note = f"one of {listed(best)}" if len(best) > 1 else ""
        p.put("part.column", best[0] if is_clear else UNKNOWN, note)
    return bool(runs)


def numbered_columns(table: Table) -> list[str]:
    """Return the patterns, like `x*`, of at least 20 columns with numbers behind one name."""
    counts = Counter(re.sub(r"\d+$", ANY, name) for name in table.columns)
    return [pattern for pattern, n in counts.items() if n >= LEAST_NUMBERED]


def has_lists(table: Table) -> bool:
    """Return whether the first cell of any column is a list of several items."""
    cells = [column[0] for column in table.columns.values() if len(column)]
    return any(isinstance(cell, list | np.ndarray) and len(cell) > 1 for cell in cells)


def _n_runs(column: Column) -> list[int]:
    """Return how many runs of equal words each table has."""
    return [int((words[1:] != words[:-1]).sum()) + 1 for words in column.words]


def _has_runs(column: Column) -> bool:
    """Return whether a column has one word for each of several runs of rows, as parts have.

    No word may come in two runs, the mean run has at least 8 rows, most tables have several, and
    the column is neither a clock nor one of fractions.
    """
    n_runs = _n_runs(column)
    is_unique = len(column.counts) == sum(n_runs) and "" not in column.counts
    is_long = column.counts.total() >= LEAST_RUN * sum(n_runs)
    if not is_unique or not is_long or sum(n > 1 for n in n_runs) <= len(n_runs) / 2:
        return False
    is_clock = CLOCK_NAME.search(column.name) and not PART_NAME.search(column.name)
    is_fraction = any(re.search(r"\d[.,]\d", word) for word in [*column.counts][:3])
    return not (is_clock or is_fraction or column.forms)


def _refuse_results(columns: Iterable[Column]) -> None:
    """Raise DataError for a table with a row for each result, and no samples.

    That is one with a column of known verdicts, good and bad, that changes within 8 rows.
    """
    for column in columns:
        edges = np.flatnonzero(column.words[0][1:] != column.words[0][:-1])
        is_short = min(np.diff(edges), default=LEAST_RUN) < LEAST_RUN
        source = labels.with_meanings(LabelSource(), column.counts if is_short else ())
        if labels.is_plain(source) and source.good and source.bad:
            actual = f"a row for each result, with its verdict in {column.name}, and no curve"
            where = column.tables[0].source
            do = "if the rows of parts are mixed, state part.column and time.sort=true"
            raise DataError(f"Expected the samples of each part in {where}, got {actual}; {do}.")


def parts_of(p: Proposal, files: Tables) -> list[Table]:
    """Return the tables of the parts that are looked at: the first 240 without damage.

    In the layout `long` the last part of each file is left out if a file was read only in part,
    since it may be cut. Raises DataError if the files do not split as the layout says.
    """
    description, layout = p.description, p.description.layout
    patterns = [ANY] if layout == "columns" else numbered_columns(files[0])
    if layout == "columns":
        clock = [*filter(CLOCK_NAME.search, files[0].columns)]
        description = description.with_values({"time.column": clock})
    if layout in ("wide", "columns") and not description.channels:
        description = replace(description, channels=dict.fromkeys(patterns, Channel()))
    parts = list[Table]()
    for table in files:
        of_file = [part for part in split(table, description) if not part.damage]
        is_cut = p.is_cut and layout == "long" and len(of_file) > 1
        parts += of_file[: len(of_file) - is_cut]
    return parts[:MOST_PARTS]
