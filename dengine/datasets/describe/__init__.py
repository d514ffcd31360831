"""Propose what recordings are, by looking at some of them: the only place that infers anything.

A value stands where a rule proves it, with its evidence as a comment; otherwise it is `?`, with the
candidates. `load_dataset` then reads exactly what the description says.
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...errors import DataError, listed
from ..description import FOLDER_FILE, UNKNOWN, Description
from ..read.files import natural_key, read_file
from ..read.frames import part_tables, read_frame
from ..read.split import tables_of
from ..read.text import read_text
from ..table import Table, UnreadableError
from .bags import describe_bag
from .columns import Roles
from .layout import layout_of, part_columns, views_of
from .text_form import describe_form, look

TEXTS = (".csv", ".tsv", ".txt", ".dat", ".asc", ".lvm", ".log", ".prn")
# The format of files with each suffix; `.gz` may stand behind it.
SUFFIXES = {
    **dict.fromkeys(TEXTS, "text"),
    ".json": "json",
    ".jsonl": "jsonl",
    ".ndjson": "jsonl",
    ".parquet": "parquet",
    ".npz": "npz",
    ".ts": "ts",
    ".mcap": "mcap",
    ".db3": "mcap",
}
PAGES = (
    "readme",
    "license",
    "licence",
    "notes",
    "changelog",
)  # texts that describe, by their stems
MOST_FILES = 60  # that are read
MOST_BYTES = 4_000_000  # of all files that are read, and of one
Stated = Mapping[str, Any]
Notes = dict[str, str]


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
    notes: Notes = {}
    if hasattr(source, "columns"):
        start = Description(format="frame").with_values(stated)
        return _with_roles(start, stated, [[read_frame(source, "table")]], (), notes, Path(), ())
    root = Path(source)
    if not root.exists():
        raise DataError(f"Expected a file or a folder of recordings, got {root}, which is none.")
    base = root if root.is_dir() else root.parent
    groups = group_files(root, stated.get("files"))
    if not groups:
        raise DataError(f"Expected files of recordings, {listed(SUFFIXES)}; found none in {root}.")
    largest = max(groups, key=lambda suffix: len(groups[suffix]))
    if sum(len(names) > 1 for names in groups.values()) > 1 and "files" not in stated:
        counts = ", ".join(f"{glob_of(names)} ({len(names)} files)" for names in groups.values())
        return Description(files=(UNKNOWN,), notes={"files": f"one of {counts}"})
    names = groups.pop(largest)
    kind = stated.setdefault("format", SUFFIXES.get(largest, "text"))
    stated.setdefault("files", glob_of(names))
    if kind == "mcap":
        return describe_bag([base / name for name in names], stated)
    others = [name for group in groups.values() for name in group] if root.is_dir() else []
    if kind == "text" and len(names) > 2:
        odd = odd_names(base, names)
        others += odd
        names = [name for name in names if name not in odd]
    contents = read_some(base, names)
    start = Description().with_values(stated)
    if kind == "text":
        looks = [
            found for name, content in contents.items() if (found := look(content, name, stated))
        ]
        if not looks:
            raise DataError(f"Expected a text with numbers in {listed(names)}, found none.")
        usual = Counter(found.form for found in looks).most_common(1)[0][0]
        form = describe_form([found for found in looks if found.form == usual], notes)
        start = Description().with_values({**form, **stated})
    files = []
    for name, content in contents.items():
        try:
            files.append(_read_whole(content, name, start, stated))
        except DataError:
            if len(contents) == 1:
                raise
    heads = Counter(tuple(tables[0].columns) for tables in files)
    files = [tables for tables in files if tuple(tables[0].columns) == heads.most_common(1)[0][0]]
    return _with_roles(start, stated, files, names, notes, base, others)


def _read_whole(content: bytes, name: str, start: Description, stated: Stated) -> list[Table]:
    """Return the tables of a file, of a text with all cells as words; UnreadableError if damaged."""
    if start.format == "npz" and stated.get("layout", "npz") == "npz":
        tables = part_tables(content, name)
        if "layout" in stated or any(len(c) > 1 for c in tables[0].columns.values()):
            return tables
    if start.format != "text":
        return tables_of(content, name, start)
    form = start.text
    if form.decimal == UNKNOWN:
        form = replace(form, decimal=".")
    content = (
        content[: content.rfind(b"\n", 0, MOST_BYTES)] if len(content) > MOST_BYTES else content
    )
    return [read_text(content, name, form, lambda _: False, lambda _: True)]


def _with_roles(
    start: Description,
    stated: Stated,
    files: Sequence[Sequence[Table]],
    names: Sequence[str],
    notes: Notes,
    base: Path,
    others: Sequence[str],
) -> Description:
    """Return a description with its layout, and the role of each column."""
    if not files or not files[0]:
        raise DataError(f"Expected a table of samples in {listed(names)}, found none.")
    is_archive = start.format == "npz" and len(files[0]) > 1
    layout = stated.get("layout") or (
        "npz" if is_archive else layout_of(start.format, files, stated)
    )
    start = replace(start, layout=layout)
    if layout == "long" and "part.column" not in stated:
        start = start.with_values({"part.column": part_columns(files, notes)})
    is_cut = any((base / name).stat().st_size > MOST_BYTES for name in names)
    if UNKNOWN in start.part.column:
        views = {tables[0].source: tables[0] for tables in files}
        paths = {name: name for name in views}
    else:
        views, paths = views_of(files, start, is_cut)
    if not views:
        raise DataError(f"Expected recordings in {listed(names)}, found none.")
    whole = names if layout == "files" and len(views) == len(files) else ()
    roles = Roles(start, stated, views, paths, whole, base, others, notes)
    description = roles.assign()
    dated = any(form == "iso" or "%Y" in form for form in description.time.format)
    note = notes.get("time.format", "")
    if "order" not in stated and ((dated and "neither" not in note) or "since 1970" in note):
        description = replace(description, order="time")
    return description


def group_files(root: Path, stated: Any) -> dict[str, list[str]]:
    """Return the files of a folder by their suffix, each as seen from it, in their natural order.

    Left out are hidden files, descriptions, pages that describe, and files of other suffixes.

    stated : patterns of the files, if they are known.
    """
    if root.is_file():
        return {suffix_of(root.name): [root.name]}
    patterns = [stated] if isinstance(stated, str) else stated or ["**/*"]
    found = {path for pattern in patterns for path in root.glob(pattern) if path.is_file()}
    names = sorted((path.relative_to(root).as_posix() for path in found), key=natural_key)
    groups: dict[str, list[str]] = {}
    for name in names:
        is_hidden = re.search(r"(^|/)\.", name) or Path(name).stem.lower() in PAGES
        if (
            (suffix_of(name) in SUFFIXES or stated)
            and not is_hidden
            and Path(name).name != FOLDER_FILE
        ):
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


def odd_names(base: Path, names: Sequence[str]) -> list[str]:
    """Return the files whose first line differs from most, numbers aside; none if most differ."""
    firsts = {}
    for name in names:
        with (base / name).open("rb") as file:
            line = file.readline(4000).decode("utf-8", "replace")
        firsts[name] = re.sub(r"[-+]?\d[\d.,]*([eE][-+]?\d+)?", "0", line.strip())
    usual, n = Counter(firsts.values()).most_common(1)[0]
    return (
        [name for name, first in firsts.items() if first not in (usual, "")]
        if 2 * n > len(names)
        else []
    )


def read_some(base: Path, names: Sequence[str]) -> dict[str, bytes]:
    """Return the content of some files, evenly spread, as far as the budget goes."""
    contents = dict[str, bytes]()
    left = MOST_BYTES
    for name in names[:: max(1, len(names) // MOST_FILES)][:MOST_FILES]:
        try:
            contents[name] = read_file(base / name)
        except UnreadableError:
            continue
        left -= len(contents[name])
        if left < 0:
            break
    return contents
