"""Propose what recordings are, by looking at some of them: the only place that infers anything.

A value stands where a rule proves it, with its evidence as a comment; otherwise it is `?`, with the
candidates. `load_dataset` then reads exactly what the description says.
"""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ...errors import DataError, listed
from ..description import FOLDER_FILE, UNKNOWN, Description
from ..read.clock import DATES, ISO
from ..read.files import natural_key, read_file
from ..read.frames import part_tables, read_frame
from ..read.places import Place
from ..read.split import tables_of
from ..read.text import read_text
from ..table import Table, UnreadableError
from .bags import describe_bag
from .cells import Notes, Stated, Tables
from .layout import layout_of, part_columns, places_of
from .roles import Roles
from .text_form import Look, describe_form, look

TEXTS = (".csv", ".tsv", ".txt", ".dat", ".asc", ".lvm", ".log", ".prn")
# The format of files with each suffix; `.gz` may stand behind it.
SUFFIXES = dict.fromkeys(TEXTS, "text") | {
    ".json": "json",
    ".jsonl": "jsonl",
    ".ndjson": "jsonl",
    ".parquet": "parquet",
    ".npz": "npz",
    ".ts": "ts",
    ".mcap": "mcap",
    ".db3": "mcap",
}
PAGES = ("readme", "license", "licence", "notes", "changelog")  # texts for people, by their stems
MOST_FILES = 60  # that are read
MOST_BYTES = 4_000_000  # of all files that are read, and of one
MOST_ROWS = 200_000
MOST_FORMS = 20  # of first lines, of which one file each is looked at
NUMBERS = re.compile(r"[-+]?\d[\d.,]*([eE][-+]?\d+)?")


@dataclass
class Sample:
    """The files that are looked at.

    base : the folder. names : of all recordings. others : of the files beside them. is_cut :
    whether some file was read in part.
    """

    base: Path = Path()
    names: Sequence[str] = ()
    others: Sequence[str] = ()
    is_cut: bool = False
    notes: Notes = field(default_factory=dict)

    def contents(self) -> dict[str, bytes]:
        """Return the content of some files, evenly spread, as far as the budget goes."""
        contents = dict[str, bytes]()
        left = MOST_BYTES
        for name in self.names[:: max(1, len(self.names) // MOST_FILES)][:MOST_FILES]:
            try:
                contents[name] = read_file(self.base / name)
            except UnreadableError:
                continue
            left -= len(contents[name])
            if left < 0:
                break
        return contents

    def tables(self, content: bytes, name: str, start: Description, stated: Stated) -> Tables:
        """Return the first tables of a file, of a text with all cells as words.

        Raises DataError if it is damaged.
        """
        is_npz = start.format == "npz" and stated.get("layout", "npz") == "npz"
        if is_npz:
            parts = part_tables(content, name)
            if "layout" in stated or any(len(c) > 1 for c in parts[0].columns.values()):
                return parts
        if start.format in ("text", "jsonl") and len(content) > MOST_BYTES:
            content = content[: content.rfind(b"\n", 0, MOST_BYTES)]
            self.is_cut = True
        if start.format != "text":
            return [self.first_rows(table) for table in tables_of(content, name, start)]
        decimal = "." if start.text.decimal == UNKNOWN else start.text.decimal
        form = replace(start.text, decimal=decimal)
        return [read_text(content, name, form, lambda _: False, lambda _: True)]

    def first_rows(self, table: Table) -> Table:
        """Return the first rows of a large table."""
        self.is_cut |= len(table.lines) > MOST_ROWS
        return table.take(slice(0, MOST_ROWS)) if len(table.lines) > MOST_ROWS else table


def describe(source: Any, stated: Stated | None = None) -> Description:
    """Propose a description of recordings.

    Parameters
    ----------
    source : path or DataFrame
        A folder, a file or a table of recordings.
    stated : mapping, optional
        Keys that are known, like `{"label.column": "verdict"}`; the others follow from them.

    Returns
    -------
    Description
        With `?` where no rule proves a value. `open_keys` lists these, and `notes` has the evidence
        and the candidates by key.

    Raises
    ------
    DataError
        If there is no file, or none that holds samples.
    """
    stated = dict(stated or {})
    sample = Sample()
    if hasattr(source, "columns"):
        start = Description(format="frame").with_values(stated)
        return _describe_tables(
            start, stated, [[sample.first_rows(read_frame(source, "table"))]], sample
        )
    root = Path(source)
    if not root.exists():
        raise DataError(f"Expected a file or a folder of recordings, got {root}, which is none.")
    groups = group_files(root, stated.get("files"))
    if not groups:
        raise DataError(f"Expected files of recordings, {listed(SUFFIXES)}; found none in {root}.")
    if sum(len(names) > 1 for names in groups.values()) > 1 and "files" not in stated:
        counts = ", ".join(f"{glob_of(names)} ({len(names)} files)" for names in groups.values())
        notes = {"files": f"one of {counts}", "channels": "they follow from files"}
        return Description(files=(UNKNOWN,), notes=notes)
    largest = max(groups, key=lambda suffix: len(groups[suffix]))
    names = groups.pop(largest)
    kind = stated.setdefault("format", SUFFIXES.get(largest, "text"))
    stated.setdefault("files", glob_of(names))
    sample = Sample(root if root.is_dir() else root.parent, names)
    if kind == "mcap":
        return describe_bag([sample.base / name for name in names], stated)
    odd = odd_names(sample, stated) if kind == "text" and len(names) > 2 else []
    sample.others = [*(name for group in groups.values() for name in group), *odd]
    sample.names = [name for name in names if name not in odd]
    return _describe_files(stated, sample)


def _describe_files(stated: Stated, sample: Sample) -> Description:
    """Return the description of files of one format."""
    contents = sample.contents()
    start = Description().with_values(stated)
    if start.format == "text":
        looks = [found for content in contents.values() if (found := look(content, stated))]
        if not looks:
            raise DataError(f"Expected a text with numbers in {listed(sample.names)}, found none.")
        usual = Counter(found.form for found in looks).most_common(1)[0][0]
        form = describe_form([found for found in looks if found.form == usual], sample.notes)
        start = start.with_values({**form, **stated})
    files = []
    for name, content in contents.items():
        try:
            files.append(sample.tables(content, name, start, stated))
        except DataError:
            if len(contents) == 1:
                raise
    files = [tables for tables in files if tables and tables[0].columns]
    heads = Counter(tuple(tables[0].columns) for tables in files)
    usual_head = heads.most_common(1)[0][0] if heads else ()
    files = [tables for tables in files if tuple(tables[0].columns) == usual_head]
    return _describe_tables(start, stated, files, sample)


def _describe_tables(
    start: Description, stated: Stated, files: Sequence[Tables], sample: Sample
) -> Description:
    """Return a description with its layout, and the role of each column."""
    names, notes = sample.names, sample.notes
    if not files:
        raise DataError(f"Expected a table of samples in {listed(names)}, found none.")
    is_archive = start.format == "npz" and len(files[0]) > 1
    layout = "npz" if is_archive else layout_of(start.format, files, stated)
    start = replace(start, layout=stated.get("layout", layout))
    if start.layout == "long" and "part.column" not in stated:
        start = start.with_values({"part.column": part_columns(files, notes)})
    if UNKNOWN in start.part.column:
        places = {tables[0].source: Place(tables[0].source, tables[0]) for tables in files}
    else:
        places = places_of(files, start, sample.is_cut)
    if not places:
        raise DataError(f"Expected recordings in {listed(names)}, found none.")
    whole = names if start.layout == "files" and len(places) == len(files) else ()
    roles = Roles(start, stated, places, whole, sample.base, sample.others, notes)
    description = roles.assign()
    clock = description.time.format if description.time.column else ()
    has_days = any(form == ISO or DATES.search(form) for form in clock)
    has_days |= "since" in notes.get("time.format", "") or "spreadsheets" in notes.get(
        "time.format", ""
    )
    if "order" not in stated and has_days and UNKNOWN not in clock:
        description = replace(description, order="time")
    return description


def group_files(root: Path, stated: Any) -> dict[str, list[str]]:
    """Return the files of a folder by their suffix, each as seen from it, in their natural order.

    Left out are hidden files, descriptions, pages for people, and files of other suffixes.

    stated : patterns of the files, if they are known.
    """
    if root.is_file():
        return {suffix_of(root.name): [root.name]}
    patterns = [stated] if isinstance(stated, str) else stated or ["**/*"]
    found = {path for pattern in patterns for path in root.glob(pattern) if path.is_file()}
    names = sorted((path.relative_to(root).as_posix() for path in found), key=natural_key)
    groups: dict[str, list[str]] = {}
    for name in names:
        path = Path(name)
        is_page = path.stem.lower() in PAGES or path.name == FOLDER_FILE
        is_hidden = any(step.startswith(".") for step in path.parts)
        if (stated or suffix_of(name) in SUFFIXES) and not is_page and not is_hidden:
            groups.setdefault(suffix_of(name), []).append(name)
    return groups


def suffix_of(name: str) -> str:
    """Return the suffix of a file in lower case, without `.gz` behind it."""
    return Path(name.lower().removesuffix(".gz")).suffix


def glob_of(names: Sequence[str]) -> str:
    """Return the pattern of files of one suffix, or the only file."""
    if len(names) == 1:
        return names[0]
    ending = re.search(r"\.[^./]*(\.gz)?$", names[0])
    return f"{'**/' if any('/' in name for name in names) else ''}*{ending[0] if ending else ''}"


def odd_names(sample: Sample, stated: Stated) -> list[str]:
    """Return the files that are written in another form than most.

    Of the files whose first lines are equal but for numbers one is looked at. It is odd if it has
    another delimiter, another number of columns, or no column's name in common with most.
    """
    groups: dict[str, list[str]] = {}
    for name in sample.names:
        with (sample.base / name).open("rb") as file:
            line = file.readline(4000).decode("utf-8", "replace")
        groups.setdefault(NUMBERS.sub("0", line.strip()), []).append(name)
    usual, *others = sorted(groups.values(), key=len, reverse=True)
    if len(others) > MOST_FORMS:
        return []
    form = _look_at(sample, usual[0], stated)
    odd = []
    for names in others:
        found = _look_at(sample, names[0], stated)
        if form and found:
            is_same = found.form == form.form
            if not is_same or (form.names and not {*form.names} & {*found.names}):
                odd += names
    return odd


def _look_at(sample: Sample, name: str, stated: Stated) -> Look | None:
    """Return how a file is written; None if it cannot be read, or is no text."""
    try:
        return look(read_file(sample.base / name), stated)
    except UnreadableError:
        return None
