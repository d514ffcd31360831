"""Propose what recordings are, by looking at some of them: the only place that infers anything.

A value stands where a rule proves it, with its evidence as a comment; otherwise it is `?`, with the
candidates. `load_dataset` then reads exactly what the description says.
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
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
from .bags import describe_bag
from .cells import Notes, Stated, Tables
from .layout import LEAST_RUN, layout_of, part_columns, places_of
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
ENDING = re.compile(r"\.[^./]*(\.gz)?$", re.IGNORECASE)
# Hidden files, pages for people, and descriptions.
NO_RECORDING = re.compile(
    r"(?i)(^|/)(\.|(readme|licen[sc]e|notes|changelog)(\.[^/]*)?$|recordings\.toml$)"
)
MOST_FILES = 60  # that are read
MOST_BYTES = 2_000_000  # of all files that are read, and of one
MOST_ROWS = 50_000
MUCH_LARGER = 5
NUMBERS = re.compile(r"\d+")
Names = Sequence[str]


@dataclass
class Sample:
    """The files that are looked at.

    base : the folder. names : of all recordings. others : of the files beside them. is_cut :
    whether some file was read in part.
    """

    stated: dict[str, Any]
    base: Path = Path()
    names: Names = ()
    others: Names = ()
    is_cut: bool = False
    notes: Notes = field(default_factory=dict)

    def largest(self, groups: Mapping[str, Names]) -> str:
        """Return the suffix of the recordings, of which there are most files; `?` if it is unclear.

        So it is if two suffixes have several files, or each has one, and none is much larger.
        """
        sizes = dict[str, tuple[int, int]]()
        for suffix, names in groups.items():
            size = sum((self.base / name).stat().st_size for name in names)
            sizes[suffix] = (len(names), size)
        first, *rest = sorted(sizes, key=lambda suffix: sizes[suffix], reverse=True)
        (n, size), (n_second, second) = sizes[first], sizes[rest[0]] if rest else (0, 0)
        is_unclear = n_second > 1 or (n == n_second and size < MUCH_LARGER * second)
        return UNKNOWN if is_unclear else first

    def choose(self, names: Names, groups: Mapping[str, Names]) -> None:
        """Set the names of the recordings, and of the files beside them."""
        self.names = names
        recordings = {*names}
        self.others = [name for name in chain(*groups.values()) if name not in recordings]
        self.stated.setdefault("files", globs(names))

    def contents(self) -> dict[str, bytes]:
        """Return the content of some files, as far as the budget goes.

        They are those whose names are like no other but for numbers, and others evenly spread.
        """
        shapes = Counter(NUMBERS.sub("0", name) for name in self.names)
        rare = [name for name in self.names if shapes[NUMBERS.sub("0", name)] == 1][:MOST_FILES]
        step = max(1, len(self.names) // MOST_FILES)
        contents = dict[str, bytes]()
        for name in dict.fromkeys([*rare, *self.names[::step][:MOST_FILES]]):
            if sum(map(len, contents.values())) < MOST_BYTES:
                with suppress(UnreadableError):
                    contents[name] = read_file(self.base / name)
        return {name: contents[name] for name in self.names if name in contents}

    def leave_out(self, odd: Mapping[str, Look], start: Description) -> Description:
        """Leave out files of another form; if several of one form have samples, it is asked why."""
        self.others = [*self.others, *odd]
        self.names = [name for name in self.names if name not in odd]
        long = [look for look in odd.values() if len(look.rows) >= LEAST_RUN]
        forms = Counter((look.delimiter, look.width) for look in long)
        is_open = max(forms.values(), default=0) > 1 and "exclude" not in self.stated
        return replace(start, exclude=(UNKNOWN,)) if is_open else start

    def tables(self, content: bytes, name: str, start: Description) -> Tables:
        """Return the first tables of a file, of a text with all cells as words.

        Raises DataError if it is damaged.
        """
        kind = start.format
        if kind == "npz" and self.stated.get("layout", "npz") == "npz":
            parts = part_tables(content, name)
            has_many = len(self.names) == 1 or len(parts) > MOST_CHANNELS
            is_curve = has_many and any(len(c) > 1 for c in parts[0].columns.values())
            if "layout" in self.stated or is_curve:
                return parts
        if kind in ("text", "jsonl") and len(content) > MOST_BYTES:
            content = content[: content.rfind(b"\n", 0, MOST_BYTES)]
            self.is_cut = True
        if kind != "text":
            return self.first_rows(tables_of(content, name, start))
        decimal = start.text.decimal.replace(UNKNOWN, ".")
        form = replace(start.text, decimal=decimal)
        return [read_text(content, name, form, lambda _: False, lambda _: True)]

    def first_rows(self, tables: Tables) -> Tables:
        """Return the first rows of large tables."""
        self.is_cut |= any(len(table.lines) > MOST_ROWS for table in tables)
        return [table.take(slice(0, MOST_ROWS)) for table in tables]


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
    sample = Sample(dict(stated or {}))
    if hasattr(source, "columns"):
        start = Description(format="frame").with_values(sample.stated)
        return _describe_tables(start, [sample.first_rows([read_frame(source, "table")])], sample)
    root = Path(source)
    if not root.exists():
        raise DataError(f"Expected a file or a folder of recordings, got {root}, which is none.")
    groups = group_files(root, sample.stated.get("files"))
    if not groups:
        raise DataError(f"Expected files of recordings, {listed(SUFFIXES)}; found none in {root}.")
    sample.base = root if root.is_dir() else root.parent
    suffix = sample.largest(groups)
    if suffix == UNKNOWN and "files" not in sample.stated:
        counts = listed(f"{' '.join(globs(n))} ({len(n)} files)" for n in groups.values())
        notes = {"files": f"one of {counts}", "channels": "they follow from files"}
        return Description(files=(UNKNOWN,), notes=notes)
    names = groups.get(suffix) or [*chain(*groups.values())]
    sample.choose(names, group_files(root, None))
    sample.stated.setdefault("format", SUFFIXES.get(suffix, "text"))
    if sample.stated["format"] == "mcap":
        bags = [sample.base / name for name in sample.names]
        return describe_bag(bags, sample.stated)
    return _describe_files(sample)


def _describe_files(sample: Sample) -> Description:
    """Return the description of files of one format."""
    contents = sample.contents()
    start = Description().with_values(sample.stated)
    if start.format == "text":
        forms = {name: look(content, sample.stated) for name, content in contents.items()}
        looks = {name: form for name, form in forms.items() if form is not None}
        if not looks:
            raise DataError(f"Expected a text with numbers in {listed(sample.names)}, found none.")
        text_form, odd = describe_form(looks, sample.notes)
        start = sample.leave_out({name: looks[name] for name in odd}, start)
        contents = {name: content for name, content in contents.items() if name not in odd}
        start = start.with_values({**text_form, **sample.stated})
    files: list[Tables] = []
    for name, content in contents.items():
        with suppress(*([DataError] if len(contents) > 1 else [])):
            files.append(sample.tables(content, name, start))
    heads = Counter(tuple(t.columns) for tables in files for t in tables[:1]).most_common(1)
    files = [tables for tables in files if tables and tuple(tables[0].columns) == heads[0][0]]
    return _describe_tables(start, files, sample)


def _describe_tables(start: Description, files: Sequence[Tables], sample: Sample) -> Description:
    """Return a description with its layout, and the role of each column."""
    names, stated, notes = sample.names, sample.stated, sample.notes
    if not files:
        raise DataError(f"Expected a table of samples in {listed(names)}, found none.")
    is_archive = start.format == "npz" and len(files[0]) > 1
    layout = stated.get("layout") or ("npz" if is_archive else layout_of(start, files))
    start = replace(start, layout=layout)
    if layout == "long" and "part.column" not in stated:
        start = start.with_values({"part.column": part_columns(files, notes)})
    places = {tables[0].source: Place(tables[0].source, tables[0]) for tables in files}
    if UNKNOWN not in start.part.column:
        places = places_of(files, start, sample.is_cut)
    if not places:
        raise DataError(f"Expected recordings in {listed(names)}, found none.")
    whole = names if layout == "files" and len(places) == len(files) else ()
    return Roles(start, stated, places, whole, sample.base, sample.others, notes).assign()


def group_files(root: Path, stated: Any) -> dict[str, list[str]]:
    """Return the files of a folder by their suffix, each as seen from it, in their natural order.

    Left out are hidden files, descriptions, pages for people, and files of other suffixes.

    stated : patterns of the files, if they are known.
    """
    patterns = [stated] if isinstance(stated, str) else stated or ["**/*"]
    paths = {path for pattern in patterns for path in root.glob(pattern) if path.is_file()}
    names = [root.name] if root.is_file() else [p.relative_to(root).as_posix() for p in paths]
    groups: dict[str, list[str]] = {}
    for name in sorted(names, key=natural_key):
        suffix = Path(name.lower().removesuffix(".gz")).suffix
        is_known = suffix in SUFFIXES or stated or root.is_file()
        if is_known and not NO_RECORDING.search(name):
            groups[suffix] = [*groups.get(suffix, ()), name]
    return groups


def globs(names: Names) -> list[str]:
    """Return the patterns of files of one suffix, or the only file."""
    if len(names) == 1:
        return [*names]
    folders = "**/" if any("/" in name for name in names) else ""
    endings = {match[0] for name in names if (match := ENDING.search(name))}
    return [f"{folders}*{ending}" for ending in sorted(endings) or [""]]
