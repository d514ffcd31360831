"""Propose what recordings are, by looking at some of them: the only place that infers anything.

A value stands where a rule proves it, with its evidence as a comment; otherwise it is `?`, with the
candidates. `load_dataset` then reads exactly what the description says.
"""

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

from ...errors import DataError, listed
from ..description import UNKNOWN, Description
from ..read.files import natural_key, read_file
from ..read.frames import MOST_CHANNELS, part_tables, read_frame
from ..read.places import Place
from ..read.split import tables_of
from ..read.text import read_text
from ..table import UnreadableError
from .bags import propose_bag
from .columns import Proposal, Stated, Tables
from .layout import LEAST_RUN, layout_of, places_of, propose_parts
from .roles import propose_roles
from .text_form import Look, look, propose_form

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
ENDING = re.compile(r"\.[^./]*(\.gz)?$", re.IGNORECASE)
# Hidden files, pages for people, and descriptions.
NO_RECORDING = re.compile(
    r"(?i)(^|/)(\.|(readme|licen[sc]e|notes|changelog)(\.[^/]*)?$|recordings\.toml$)"
)
BAG = ".mcap"
MOST_FILES = 60  # that are read
MOST_BYTES = 2_000_000  # of all files that are read, and of one
MOST_ROWS = 50_000
NUMBERS = re.compile(r"\d+")
Names = Sequence[str]


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
    p = Proposal(stated or {}, Description().with_values(stated or {}))
    if hasattr(source, "columns"):
        p.put("format", "frame")
        propose_tables(p, [[read_frame(source, "table")]])
    elif choose_files(p, Path(source)):
        if p.description.format == "mcap":
            p.put("layout", "mcap")
            propose_bag(p)
        else:
            propose_tables(p, read_tables(p))
    return replace(p.description, notes=p.notes)


def choose_files(p: Proposal, root: Path) -> bool:
    """Find which files are the recordings, and their format; return whether that is clear.

    They are those of the only suffix that several files have, or else of a bag, or of any suffix.
    """
    if not root.exists():
        raise DataError(f"Expected a file or a folder of recordings, got {root}, which is none.")
    groups = group_files(root, p.description.files)
    if not groups:
        raise DataError(f"Expected files of recordings, {listed(SUFFIXES)}; found none in {root}.")
    p.base = root if root.is_dir() else root.parent
    bags = [groups[BAG]] if BAG in groups else [*groups.values()]
    clear = [names for names in groups.values() if len(names) > 1] or bags
    if len(clear) > 1 and not p.description.files:
        counts = listed(f"{' '.join(globs(n))} ({len(n)} files)" for n in groups.values())
        p.put("files", UNKNOWN, f"one of {counts}")
        p.notes["channels"] = "they follow from files"
        return False
    p.names = [*chain(*groups.values())] if p.description.files else clear[0]
    every = chain(*group_files(root, ()).values())
    p.others = [name for name in every if name not in {*p.names}]
    p.put("files", globs(p.names))
    p.put("format", SUFFIXES.get(suffix_of(p.names[0]), "text"))
    return True


def suffix_of(name: str) -> str:
    """Return the suffix of a file, in small letters and without `.gz` behind it."""
    return Path(name.lower().removesuffix(".gz")).suffix


def group_files(root: Path, patterns: Names) -> Mapping[str, Names]:
    """Return the files of a folder by their suffix, each as seen from it, in their natural order.

    Left out are hidden files, descriptions, pages for people, and files of other suffixes.

    patterns : of the files, if they are known.
    """
    paths = {path for pattern in patterns or ["**/*"] for path in root.glob(pattern)}
    names = [path.relative_to(root).as_posix() for path in paths if path.is_file()]
    groups = defaultdict[str, list[str]](list)
    for name in [root.name] if root.is_file() else sorted(names, key=natural_key):
        is_known = suffix_of(name) in SUFFIXES or patterns or root.is_file()
        if is_known and not NO_RECORDING.search(name):
            groups[suffix_of(name)].append(name)
    return groups


def globs(names: Names) -> list[str]:
    """Return the patterns of files of one suffix, or the only file."""
    if len(names) == 1:
        return [*names]
    folders = "**/" if any("/" in name for name in names) else ""
    endings = {match[0] for name in names if (match := ENDING.search(name))}
    return [f"{folders}*{ending}" for ending in sorted(endings) or [""]]


def read_contents(p: Proposal) -> dict[str, bytes]:
    """Return the content of some files, as far as the budget goes.

    They are those whose names are like no other but for numbers, and others evenly spread.
    """
    shapes = {name: NUMBERS.sub("0", name) for name in p.names}
    counts = Counter(shapes.values())
    rare = [name for name in p.names if counts[shapes[name]] == 1]
    step = max(1, len(p.names) // MOST_FILES)
    contents = dict[str, bytes]()
    for name in [*rare[:MOST_FILES], *p.names[::step][:MOST_FILES]]:
        if sum(map(len, contents.values())) < MOST_BYTES:
            with suppress(UnreadableError):
                contents[name] = read_file(p.base / name)
    return {name: contents[name] for name in p.names if name in contents}


def read_tables(p: Proposal) -> list[Tables]:
    """Return the first tables of files of one format, which have the same columns."""
    contents = read_contents(p)
    if p.description.format == "text":
        forms = {name: look(content, p.stated) for name, content in contents.items()}
        looks = {name: form for name, form in forms.items() if form is not None}
        if not looks:
            raise DataError(f"Expected a text with numbers in {listed(p.names)}, found none.")
        leave_out(p, {name: looks[name] for name in propose_form(p, looks)})
    files: list[Tables] = []
    for name in [name for name in p.names if name in contents]:
        with suppress(*([DataError] if len(contents) > 1 else [])):
            files.append(tables_in(p, contents[name], name))
    heads = Counter(tuple(tables[0].columns) for tables in files if tables)
    usual = heads.most_common(1)[0][0] if heads else ()
    return [tables for tables in files if tables and tuple(tables[0].columns) == usual]


def leave_out(p: Proposal, odd: Mapping[str, Look]) -> None:
    """Leave out files of another form; if several of one form have samples, it is asked why."""
    p.others = [*p.others, *odd]
    p.names = [name for name in p.names if name not in odd]
    forms = Counter(look.form for look in odd.values() if len(look.rows) >= LEAST_RUN)
    if max(forms.values(), default=0) > 1:
        p.put("exclude", UNKNOWN)


def tables_in(p: Proposal, content: bytes, name: str) -> Tables:
    """Return the first tables of a file, of a text with all cells as words.

    An archive holds all parts if it is the only one, or has many, and its arrays hold curves.
    Raises DataError if it is damaged.
    """
    form, kind, layout = p.description.text, p.description.format, p.stated.get("layout", "npz")
    if kind == "npz" and layout == "npz":
        parts = part_tables(content, name)
        has_many = len(p.names) == 1 or len(parts) > MOST_CHANNELS
        if has_many and any(len(cells) > 1 for cells in parts[0].columns.values()):
            return parts
    if kind in ("text", "jsonl") and len(content) > MOST_BYTES:
        content = content[: content.rfind(b"\n", 0, MOST_BYTES)]
        p.is_cut = True
    if kind != "text":
        return tables_of(content, name, replace(p.description, layout="files"))
    form = replace(form, decimal=form.decimal.replace(UNKNOWN, "."))
    return [read_text(content, name, form, lambda _: False, lambda _: True)]


def propose_tables(p: Proposal, files: Sequence[Tables]) -> None:
    """Find the layout, and the role of each column."""
    if not files:
        raise DataError(f"Expected a table of samples in {listed(p.names)}, found none.")
    p.is_cut |= any(len(table.lines) > MOST_ROWS for tables in files for table in tables)
    files = [[table.take(slice(0, MOST_ROWS)) for table in tables] for tables in files]
    is_archive = p.description.format == "npz" and len(files[0]) > 1
    p.put("layout", "npz" if is_archive else layout_of(p, files))
    if p.description.layout == "long":
        propose_parts(p, files)
    p.places = {tables[0].source: Place(tables[0].source, tables[0]) for tables in files}
    if UNKNOWN not in p.description.part.column:
        p.places = places_of(p, files)
    if not p.places:
        raise DataError(f"Expected recordings in {listed(p.names)}, found none.")
    if p.description.layout != "files" or len(p.places) != len(files):
        p.names = ()
    propose_roles(p)
