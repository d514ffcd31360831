"""Propose what recordings are, by looking at some of them: the only place that infers anything.

A value is written only if a rule proves it, with its evidence as a comment; else it is `?`, with
the candidates. `load_dataset` then reads exactly what the description says.
"""

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import DataError, listed
from ..checks import check_forms
from ..dataset import Faults, expect_data
from ..description import UNKNOWN, Clock, Description, Stated, Strings, flat, is_open
from ..read.bags import BAG
from ..read.files import (
    FOREIGN,
    SUFFIXES,
    as_source,
    caught,
    match_files,
    names_in,
    natural_key,
    read_file,
    suffix_of,
)
from ..read.frames import read_frame
from ..read.places import without_suffix
from ..read.split import table_of
from ..read.text import read_text
from ..table import Table
from .bags import propose_bag
from .columns import Proposal, Tables, most_frequent
from .labels import WORD
from .layout import MOST_PARTS, layout_of, parts_of
from .roles import propose_roles
from .text_form import MOST_BYTES, propose_form

MOST_FILES = 60  # that are read
MOST_ROWS = 50_000
MOST_PIECES = 4  # of a part's curve, in files with numbers behind their names
FEW = 5  # times as many files of another suffix make a suffix unlikely
LEAST_PARTS = 10  # that have such pieces


def describe(source: Any, stated: Stated | None = None) -> Description:
    """Propose a description of recordings, by looking at some of them.

    Recordings are files or tables with the samples of parts; a description says how they are read:
    which files and columns have the samples, times, part numbers and labels.

    Parameters
    ----------
    source : path or DataFrame
        A folder, a file or a table of recordings.
    stated : mapping, optional
        Keys whose values are known, like `{"label.column": "verdict"}`, or sections with such keys.
        They are kept, but a key with the value `?` counts as not stated, `ignored` (the columns
        without a use) is proposed anew, and `[rows]`, which says by the words in a column which
        rows are samples, may get further columns and words. The proposals for the other keys follow
        from them.

    Returns
    -------
    Description
        A key has the value `?` if no rule proves a value. `open_keys` lists these keys, and `notes`
        has the evidence and the possible values by key. While `files`, `layout` (how files hold
        parts) or `part.column` is `?`, the keys that depend on it are not proposed.

    Raises
    ------
    DataError
        If there is no file, or none that can be read and holds samples, or if the package that
        reads such files is not installed. Also if a stated value is wrong: an unknown key or a
        value of the wrong type, a column of times or of `[rows]`, a channel or, in the layout
        `long`, a `part.column` that does not exist (those of a ROS bag are not checked), a place of
        the labels at which no recording has one, a malformed pattern of files, or settings in
        `[text]` or `[time]` that no file can be read with.
    SettingError
        If a stated `windows.trigger`, which cuts long recordings, is malformed.
    ValueError
        If the index of a DataFrame is named like one of its columns.
    """
    source = as_source(source)
    stated = {key: value for key, value in flat(stated or {}).items() if not is_open(value)}
    p = Proposal(stated, Description().with_values(stated))
    check_forms(Clock(), p.description.text)
    if not isinstance(source, Path):
        p.put("format", "frame")
        propose_tables(p, [read_frame(source, "table")])
    elif choose_files(p, source):
        if p.description.format == "mcap":
            p.put("layout", "mcap")
            propose_bag(p)
        else:
            propose_tables(p, read_tables(p))
    return replace(p.description, notes=p.notes)


def choose_files(p: Proposal, root: Path) -> bool:
    """Set in `p` which files are the recordings, and their format; return whether that is clear.

    `p` is the description so far; keys that the user stated stay. If `root` is a file, it is the
    only one. In a folder they are the files that match the stated patterns `files`. If none are
    stated, they are the files with the only likely ending, as a rule one that several files have
    (`likely_endings`). If several endings are likely, `files` is set to `?` (the user must answer)
    with a note that lists them, a note on `channels` says that the channels follow from `files`,
    and the result is False. If it is True, `p.base` is the folder, `p.names` has these files, and
    `p.others` the other files with a suffix of recordings, like `.json` (`names_in`). `files`
    becomes patterns that match `p.names`, like `*.csv`, and `format` that of the first file's
    suffix, `text` for an unknown one. Files that the stated patterns `exclude` match are among the
    others. Raises DataError if there is no file of recordings, a stated pattern is
    malformed, or, without stated patterns, a likely ending is of a format that dengine does not
    read (`FOREIGN`).
    """
    stated = p.description.files
    excluded = match_files(root, p.description.exclude)
    names = [name for name in names_in(root, stated) if name not in excluded]
    if not names:
        raise DataError(
            f"Expected files of recordings, {listed(SUFFIXES)}, in {root}, got none; state files "
            "for texts with another suffix, as in --set 'files=*.data'."
        )
    if not stated:
        endings = likely_endings(names)
        expect_data(
            {*endings}.isdisjoint(FOREIGN),
            f"files that dengine reads in {root}",
            endings,
            "state files, or see the page 'Recordings that dengine does not read'",
        )
        if len(endings) > 1:
            p.put("files", UNKNOWN, f"one of {listed(f'**/*{ending}' for ending in endings)}")
            p.notes["channels"] = "they follow from files"
            return False
        names = [name for name in names if suffix_of(name) == endings[0]]
    p.base = root if root.is_dir() else root.parent
    p.names = names
    p.others = sorted({*names_in(root, ())}.difference(names), key=natural_key)
    p.put("files", globs(names))
    p.put("format", SUFFIXES.get(suffix_of(names[0]), "text"))
    return True


def likely_endings(names: Strings) -> Strings:
    """Return the endings of these file names of which one may tell recordings from other files.

    They are the suffixes that more than a fifth as many files have as the most frequent one, and
    `.mcap` even if only one file has it; beside such a file they need two. Those that dengine does
    not read (`FOREIGN`) count only if more files have them than any other. If there is only one,
    the endings of signals (`signal_endings`), if the files have such, come before it.
    """
    counts = Counter(map(suffix_of, names))
    most = max(counts.values())
    readable = max(counts[suffix] for suffix in SUFFIXES)
    least = 2 if BAG in counts else 1  # a single file beside a bag is a listing
    likely = [
        suffix
        for suffix, n in counts.items()
        if suffix == BAG or (n >= least and n * FEW > most and (suffix in SUFFIXES or n > readable))
    ]
    return [*signal_endings(names), *likely] if len(likely) == 1 else likely


def signal_endings(names: Strings) -> Strings:
    """Return the endings of signals, like `Kraft.csv`, if there is a file for each part and signal.

    Otherwise there are none. Such an ending is what stands behind the last `-`, `_` or blank of a
    name, and the part is what stands before: `1_Kraft.csv` and `1_Weg.csv` are two signals of one
    part. There must be at least two parts and two endings, and each part must have a file with each
    ending. If any ending is a word like `ok` or `pending`, none counts. If any has a digit, they
    count only if there are 2 to 4 endings and 10 parts or more: they are then numbered pieces of a
    part's curve.
    """
    words = [re.split(r"[-_ ](?=[^-_ /]+$)", name) for name in names]
    n_parts = len({name[0] for name in words})
    endings = sorted({name[-1] for name in words})
    is_grid = n_parts * len(endings) == len(names) and min(n_parts, len(endings)) > 1
    no_signal = rf"(?i)\b({WORD})\."
    if len(endings) > MOST_PIECES or n_parts < LEAST_PARTS:
        no_signal += r"|\d"
    return endings if is_grid and not re.search(no_signal, " ".join(endings)) else []


def globs(names: Strings) -> list[str]:
    """Return patterns that match the files, one for each suffix; for a single file its path.

    They are like `*.csv`, or `**/*.csv` if any file is in a subfolder, and sorted. The suffix has
    `.gz` behind it if the file has, and its capital letters stay.
    """
    folders = "**/" if "/" in "".join(names) else ""
    endings = {name.removeprefix(without_suffix(name)) for name in names}
    return sorted(f"{folders}*{end}" for end in endings) if len(names) > 1 else [*names]


def read_tables(p: Proposal) -> list[Table]:
    """Return the tables of some of the files `p.names`, at least one, with the same column names.

    `p` is the description so far, and `p.names` are the files of recordings. At most 60 of them are
    read, spread evenly over all; if 60 of the size of the first have more than 2 MB, fewer, but at
    least three. Of text files only those count whose form (delimiter, number of columns, header) is
    the most frequent: the keys of `[text]`, which state this form, are set in `p` first. Text files
    of another form move from `p.names` to `p.others`, and `exclude` may be set to `?`: the user
    must say whether they are recordings (`propose_form`). Tables with other column names than the
    most frequent ones, of equally frequent ones those of the largest table, are left out (Parquet
    files of such tables move to `p.others`), and so are damaged files. `p.is_cut` is set if only
    the beginning of a file is used. Raises DataError if no file can be read, also because the
    package that reads such files is missing.
    """
    contents = dict[str, bytes]()
    faults: Faults = []
    size = (p.base / p.names[0]).stat().st_size + 1
    n = min(MOST_FILES, max(3, MOST_BYTES // size))
    for i in np.unique(np.linspace(0, len(p.names) - 1, n).astype(int)):
        name = p.names[i]
        with caught(faults, name):
            contents[name] = read_file(p.base / name)
    names = propose_form(p, contents, faults) if p.description.format == "text" else contents
    files = list[Table]()
    for name in names:
        with caught(faults, name):
            files.append(table_in(p, contents[name], name))
    if not files:
        raise DataError(f"Expected a table of samples, found none: {faults[0]}.")
    usual = most_frequent([((*t.columns,), sum(map(len, t.columns.values()))) for t in files])
    if p.description.format == "parquet":  # a smaller table may be a listing
        p.set_aside([table.source for table in files if (*table.columns,) != usual])
    return [table for table in files if (*table.columns,) == usual]


def table_in(p: Proposal, content: bytes, name: str) -> Table:
    """Return the table of a file with this content; a text file gives all cells as texts.

    `p` has the description so far, with the format of the files and how texts are written; `name`
    is the file's name in errors. An .npz file is read as one that holds all parts if the user
    stated the layout `npz`, `wide` or `long`, or no layout and it is the only file; otherwise as
    one part. Of a text or jsonl file of more than 2 MB only the whole lines of the first 2 MB are
    read (the whole file if no line ends there), and `p.is_cut` is set. Raises DataError if the file
    is damaged. Lines of a text file with a wrong number of cells are left out, unless all lines are
    wrong.
    """
    about = p.description
    if about.format in ("text", "jsonl") and len(content) > MOST_BYTES:
        text = content[:MOST_BYTES].decode(about.text.encoding, "ignore").rpartition("\n")[0]
        content = text.encode(about.text.encoding) or content
        p.is_cut = True
    if about.format == "text":
        table = read_text(content, name, about.text)
        is_damaged = np.isin(table.lines, [error.line for error in table.damage])
        return replace(table.take(~is_damaged), damage=[])
    layout = p.stated.get("layout", "npz" if len(p.names) == 1 else "files")
    return table_of(content, name, replace(about, layout=layout))


def propose_tables(p: Proposal, files: Tables) -> None:
    """Find the layout, then what each column is for, and set the keys that say so in `p`.

    `p` is the description so far. The layout says how files hold parts, like `long` for parts one
    below the other, which `part.column` tells apart. A stated layout stays; if it is `long`,
    `part.column` is looked for all the same, unless it is stated. `files` has the table of each
    file that is looked at. At most the first 50,000 rows of each are used; `p.is_cut` is set if a
    file has more. `p.tables` becomes the tables of the first 240 parts without damage, with only
    the rows that are samples, `p.columns` their columns, and `p.names` (the files of recordings) is
    emptied unless each file is one part. If the layout or `part.column` is `?` (the user must
    answer), nothing more is proposed: `p.tables` and `p.names` stay, and a note on `channels` says
    why. Raises DataError if there is no part without damage, if the tables do not split as a stated
    layout says, if a stated column or setting in `[time]` is wrong, or if no recording has a label
    at the stated place, and SettingError for a malformed `windows.trigger`, the condition at which
    long recordings are cut.
    """
    p.is_cut |= any(len(table.lines) > MOST_ROWS for table in files)
    files = [table.take(slice(MOST_ROWS)) for table in files]
    if "layout" not in p.stated or p.description.layout == "long":
        p.put("layout", layout_of(p, files))
    if UNKNOWN in (p.description.layout, *p.description.part.column):
        p.notes["channels"] = "they follow from layout and part.column"
        return
    parts = parts_of(p, files)
    p.tables = [part for part in parts if not part.damage][:MOST_PARTS]
    if not p.tables:
        why = "".join(f" {error}." for part in parts[:1] for error in part.damage[:1])
        raise DataError(f"Expected recordings in {listed(p.names)}, found none.{why}")
    if p.description.layout != "files":
        p.names = ()
    propose_roles(p)
