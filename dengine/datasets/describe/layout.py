"""The layout of files and tables, and the parts in them."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

from ...errors import DataError, listed
from ..description import ANY, UNKNOWN, Channel, TextForm, as_option
from ..read.split import OBJECTS, longest_list, split
from ..table import Table
from .clock import CLOCK_NAME, are_even
from .columns import LEAST_RUN, Column, Proposal, Tables, columns_of

PART_NAME = re.compile(
    r"(?i)part(?!ition)|serial|serien|matricola|episode|teil(?!schritt|enummer|e?typ)"
    r"|werkst(?!.*tr(ä|ae?)ger)|barcode|dmc|trial|piece"
    r"|sample_?id"
    r"|^(id|run|sn|cycle|shot|nr|no|dut|uut|workpiece|pr(ü|ue)fling)$|cycle.?(no|nr|id)$"
    r"|(?<!order)(?<!batch)(?<!shift)(?<!lot)_(id|run|cycle|sn|nr)$"
)
NUMBER = re.compile(r"\d+(\.\d+)?(e-?\d+)?(?=[\])]?( ?[\[(][^\d\[(]+[\])])?$)")  # as in `F_0.5 [N]`
LEAST_NUMBERED = 20  # columns with numbers behind one name that are the samples of a part
MOST_PARTS = 240
RESULTS = (  # what a table without curves is told
    "A row for each part, with its label, but no curve is a table of results: nothing can be read"
)


def layout_of(p: Proposal, files: Tables) -> str:
    """Return how the files hold parts, as `Description.layout` names it; `?` if it is not certain.

    A part is a workpiece, `p` is the description so far, and `files` has the table of each file
    that is looked at. The first of these rules that applies decides. Several JSON or .ts files, of
    which the first has one row, are `files` (a part in each), unless this row has 20 or more
    columns like `x0`, `x1`. Such columns (unless a clock with equal steps stands beside them, see
    `is_even_clock`), or lists of two items or more in the first row of the first table, make it
    `wide` (a part in each row), or `npz` for an .npz file; but if `text.names` is `x*` alone, for
    no header names the columns, they give `?`, with a note. It is `long` (a sample in each row) if
    a column of the first table may tell the parts apart (`may_tell_parts`), or if a file has
    several words in a stated `part.column`, the column that tells the parts apart. Several files,
    of which `p.names` may have more than were looked at, are `files`. A single one gives `?`, with
    a note on what to state.

    For `long`, `part.column` is set in `p` (`_propose_part_column`). Raises DataError if the lists
    in 8 rows or more have fewer than 8 items, like the vectors of a force and a torque, and
    UnreadableError if cells of columns that are looked at are lists.
    """
    kind = p.description.format
    wide = "npz" if kind == "npz" else "wide"
    first = files[0]
    clocks = columns_of(files[:1], p.description.text).values()
    if numbered_columns(first) and not any(map(is_even_clock, clocks)):
        if p.description.text.names != ("x*",):
            return wide
        p.notes["layout"] = (
            "no header names the columns. wide: a part in each row; files: in each file; long: "
            "below each other, with part.column"
        )
        return UNKNOWN
    if kind in OBJECTS and len(p.names) > 1 and len(first.lines) == 1:
        return "files"
    longest = longest_list(first)
    if 1 < longest < LEAST_RUN <= len(first.lines):
        raise DataError(
            f"Expected numbers or curves in the cells of {first.source}, got lists of {longest}: "
            "make a column of each item."
        )
    if longest > 1:
        return wide
    columns = columns_of(files, TextForm())
    runs = [*filter(may_tell_parts, columns.values())]
    stated = columns.keys() & {*p.description.part.column}
    if runs or not all(columns[name].fixed for name in stated):
        _propose_part_column(p, columns.values(), runs)
        return "long"
    if len(p.names) > 1:  # of large files only the first one is looked at
        return "files"
    p.notes["layout"] = (
        f"columns, a part in each; or long: part.column is of {listed(columns)}, and with "
        f"time.sort=true if the rows of parts are mixed. {RESULTS}"
    )
    return UNKNOWN


def _propose_part_column(p: Proposal, columns: Iterable[Column], runs: Sequence[Column]) -> None:
    """Set `part.column` in `p`, unless it is stated, to the column that tells the parts apart.

    This clears `part.path` and `part.line`, also stated ones. It is the only one of `runs` that is
    named like a part's number, has one run (successive rows with one word) of each word in all
    files together, and at least a quarter as many runs as any of them; if there are none or
    several, `part.column` becomes `?`, with a note.

    columns : those of the files. runs : those that may tell the parts apart (`may_tell_parts`).
    """
    # The number of a part changes about as often as any other word.
    least = max((c.n_runs for c in runs), default=0) / 4
    likely = [
        c.name for c in runs if PART_NAME.search(c.name) and len(c.counts) == c.n_runs >= least
    ]
    named = [c.name for c in columns if PART_NAME.search(c.name) or has_long_runs(c)]
    note = f"one of {listed(named)}, or several, like {as_option('part.column', named[:2])}"
    if len(p.names) > 1:
        note += "; or layout=files: each file is a part"
    p.put("part.column", *(likely if len(likely) == 1 else (UNKNOWN, f"{note}. {RESULTS}")))


def is_even_clock(column: Column) -> bool:
    """Return whether a column is named like a clock and increases in 8 equal steps or more.

    All its cells are numbers, and a step may differ from the usual one by 1 %. If so, the rows are
    samples, not parts.
    """
    is_long = CLOCK_NAME.search(column.name) and len(column.steps) >= LEAST_RUN
    return bool(is_long and column.usual_step and are_even(column.steps, column.usual_step))


def has_long_runs(column: Column) -> bool:
    """Return whether a run, one word in successive rows, has 8 rows or more on average.

    False if a cell is empty, or if no table has more than one word.
    """
    return (
        not column.fixed
        and column.counts.total() >= LEAST_RUN * column.n_runs
        and "" not in column.counts
    )


def may_tell_parts(column: Column) -> bool:
    """Return whether a column may tell which part a row belongs to.

    A run is a stretch of successive rows with one word. The runs must have 8 rows or more on
    average, and each word must have only one run in all tables together, or, if the column is named
    like a part's number (`part`, `serial`, `id`, ...), in each table. False if a cell is empty, if
    each table has one word in all its rows, and for a column that is not named like a part's
    number, but holds times or is named like them. Raises UnreadableError if cells are lists.
    """
    if not has_long_runs(column):
        return False
    if PART_NAME.search(column.name):
        return all(len(words) == len({*words}) for words in column.runs)
    is_clock = CLOCK_NAME.search(column.name) or column.forms
    return not is_clock and len(column.counts) == column.n_runs


def numbered_columns(table: Table) -> list[str]:
    """Return a pattern like `x*` for each name that 20 columns or more share, like `x0`, `x1`.

    The number may be a fraction, and a bracket or a unit in brackets may stand behind it.
    """
    patterns = Counter(NUMBER.sub(ANY, name) for name in table.columns)
    return [pattern for pattern in patterns if patterns[pattern] >= LEAST_NUMBERED]


def parts_of(p: Proposal, files: Tables) -> list[Table]:
    """Return the tables of the parts, also of damaged ones, by the layout in `p.description`.

    `p` has the description so far, which is not changed, and the layout says how files hold parts.
    `files` has the table of each file that is looked at, at least one. In the layout `long` a file
    holds several parts, one below the other; if any file was read only to some row, the last of
    several parts of each file is left out, since it may be cut. In `columns` each column is a part;
    if channels are stated, only each column that fits the first of them. But columns whose words
    tell which rows are samples (`[rows]`), a stated `time.column`, and columns that are named like
    a clock in the first file, are no parts. Damage is for example a line with a wrong number of
    cells. Raises DataError if a file of the layout `long` does not have the columns in
    `part.column`, if none is stated, or if their cells are lists; and UnreadableError if the
    columns like `x0`, `x1` of one channel differ in length.
    """
    description = p.description
    patterns = numbered_columns(files[0])
    if description.layout == "columns":
        patterns = [ANY]
        clock = [*description.time.column, *filter(CLOCK_NAME.search, files[0].columns)]
        description = description.with_values({"time.column": clock})
    if not description.channels:
        description = replace(description, channels=dict.fromkeys(patterns, Channel()))
    parts = list[Table]()
    for table in files:
        of_file = [*split(table, description)]
        is_cut = p.is_cut and description.layout == "long" and len(of_file) > 1
        parts += of_file[: len(of_file) - is_cut]
    return parts
