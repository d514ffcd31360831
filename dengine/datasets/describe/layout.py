"""What a folder of files, a file or a table holds: its layout, and the role of each column."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import DataError, listed
from ..description import KEYS, UNKNOWN, Description, TextForm
from ..read import frames
from ..read.files import natural_key, read_file
from ..read.places import Place, part_of
from ..read.text import read_text
from ..table import ANY, Table, UnreadableError, as_word
from ..units import bare, quantity_of, unit_in
from . import labels
from .clock import NAME as CLOCK_NAME
from .clock import describe_clock
from .text_form import Look, describe_form, look

MOST_FILES = 60  # that are read
MOST_BYTES = 4_000_000  # of the files that are read, and of one file
LEAST_NUMBERED = 20  # columns with numbers behind one name that are the samples of a part
LEAST_RUN = 8  # rows of a part
LEAST_PARTS = 8  # columns of parts beside each other
MOST_LABELS = 12  # words of a column of labels
FEW_WORDS = 6  # of a column that qualifies rows
SPARSE = 0.1
PART_NAME = re.compile(
    r"(?i)part|serial|episode|teil|werkst|barcode|dmc|trial|piece|sample_?id|^(id|run|sn|cycle|shot|nr|no)$"
    r"|(^|_)(id|run|cycle|sn|nr)$"
)
QUALIFIER_NAME = re.compile(r"(?i)status|valid|quality|flag|error|state")
COUNTER_NAME = re.compile(r"(?i)^(index|row|sample|n|i|punkt|point|count|nr|no|line)s?$")
LOST = ("nan", "null", "none", "n/a", "na", "-", "--", "---", "#n/a", "")
FORCES = (
    re.compile(
        r"(?i)(^|[^a-z])f_?z(?![a-z])|(force|kraft|wrench)[^a-z]*z|z[^a-z]*(force|kraft)|force_2$"
    ),
    re.compile(
        r"(?i)force|kraft|fuerza|forza|load|torque|drehmoment|thrust|couple|effort|last\b|力|荷重"
    ),
    re.compile(r"(?i)^f\b|^value$"),
)


@dataclass
class Material:
    """What is described: files of one kind, or a table in memory.

    kind : one of `FORMATS`. names : the files, as seen from the folder `base`. others : files of
    other kinds beside them, which may list labels. tables : those of each file that was read.
    """

    kind: str
    base: Path
    names: list[str]
    others: list[str]
    tables: list[list[Table]] = field(default_factory=list)
    values: dict[str, Any] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    form: TextForm = field(default_factory=TextForm)
    is_cut: bool = False

    def contents(self, names: Sequence[str]) -> dict[str, bytes]:
        """Return the content of some of the files, evenly spread, as far as the budget goes."""
        step = max(1, len(names) // MOST_FILES)
        result = dict[str, bytes]()
        left = MOST_BYTES
        for name in names[::step][:MOST_FILES]:
            try:
                content = read_file(self.base / name)
            except UnreadableError:
                continue
            result[name] = content
            left -= len(content)
            if left < 0:
                break
        return result


def describe_material(material: Material, stated: Mapping[str, Any]) -> Description:
    """Return the proposed description of files of one kind; DataError if they hold no samples."""
    values, notes = material.values, material.notes
    values |= {"files": stated.get("files", material.names), "format": material.kind}
    if material.kind == "text":
        read_texts(material, stated)
    elif not material.tables:
        read_frames(material)
    if not any(material.tables):
        wanted = "a table of samples"
        raise DataError(f"Expected {wanted} in {listed(material.names)}, found none.")
    values["layout"] = stated.get("layout") or layout_of(material, stated)
    views = views_of(material, values["layout"], stated)
    if not views:
        raise DataError(f"Expected recordings in {listed(material.names)}, found none.")
    roles = Roles(material, views, dict(stated))
    roles.assign()
    values |= {key: value for key, value in stated.items() if not key.startswith("check")}
    return build(values, roles, notes)


def build(values: Mapping[str, Any], roles: "Roles", notes: Mapping[str, str]) -> Description:
    """Return the description of keys like `label.column`, and the roles of the columns."""
    nested: dict[str, Any] = {}
    for name, value in values.items():
        section, _, key = name.partition(".")
        if section in KEYS and key:
            nested.setdefault(section, {})[key] = value
        elif not key:
            nested[section] = value
    nested["channels"] = roles.channels
    nested["rows"] = roles.rows
    nested["ignored"] = {
        name: unit for name, unit in roles.ignored.items() if name not in roles.channels
    }
    stated = {
        name: value
        for name, value in values.items()
        if name.partition(".")[0] in ("channels", "rows")
    }
    description = Description.from_dict({k: v for k, v in nested.items() if v not in ({}, None)})
    checks = tuple(roles.checks)
    return Description(
        **{
            name: getattr(description, name)
            for name in Description.__dataclass_fields__
            if name not in ("check", "notes")
        },
        check=checks,
        notes=dict(notes),
    ).with_values({k: v for k, v in stated.items() if k.startswith("rows.")})


# Reading what is looked at.


def read_texts(material: Material, stated: Mapping[str, Any]) -> None:
    """Read text files: their form is that of most of them, and the others may be listings."""
    odd = odd_names(material)
    names = [name for name in material.names if name not in odd] or material.names
    contents = material.contents(names)
    looks = [found for name, content in contents.items() if (found := look(content, name, stated))]
    if not looks:
        raise DataError(f"Expected a text with numbers in {listed(names)}, found none.")
    usual = Counter(found.form for found in looks).most_common(1)[0][0]
    odd += [found.name for found in looks if found.form != usual]
    chosen = [found for found in looks if found.form == usual]
    values = describe_form(chosen, material.notes)
    values |= {key: value for key, value in stated.items() if key.startswith("text.")}
    material.values |= values
    material.form = _text_form(values)
    material.others += odd
    material.names = [name for name in material.names if name not in odd]
    for found in chosen:
        material.tables += [_read_look(found, contents[found.name], material)]
    heads = Counter(tuple(tables[0].columns) for tables in material.tables if tables)
    usual_head = heads.most_common(1)[0][0] if heads else ()
    material.tables = [
        tables if tables and tuple(tables[0].columns) == usual_head else []
        for tables in material.tables
    ]


def _text_form(values: Mapping[str, Any]) -> TextForm:
    """Return the form to look at cells with, where `?` is replaced by what is usual."""
    known = {
        key.partition(".")[2]: value for key, value in values.items() if key.startswith("text.")
    }
    known = {key: value for key, value in known.items() if value != UNKNOWN}
    for name in ("names", "missing", "drop"):
        if name in known:
            known[name] = tuple(np.atleast_1d(known[name]).tolist())
    return TextForm(**known)


def _read_look(found: Look, content: bytes, material: Material) -> list[Table]:
    """Return the table of a file that was looked at, all cells as words; none if it is damaged."""
    if len(content) > MOST_BYTES:
        content = content[: content.rfind(b"\n", 0, MOST_BYTES)]
        material.is_cut = True
    try:
        return [read_text(content, found.name, material.form, lambda _: False, lambda _: True)]
    except UnreadableError:
        return []


def odd_names(material: Material) -> list[str]:
    """Return the files whose first line is of another form than most, numbers aside."""
    if len(material.names) < 3:
        return []
    firsts = dict[str, str]()
    for name in material.names:
        with (material.base / name).open("rb") as file:
            line = file.readline(4000).decode("utf-8", "replace")
        firsts[name] = re.sub(r"[-+]?\d[\d.,]*([eE][-+]?\d+)?", "0", line.strip())
    counts = Counter(firsts.values())
    usual, n = counts.most_common(1)[0]
    if n < len(material.names) / 2:
        return []
    return [name for name, first in firsts.items() if first != usual and first]


def read_frames(material: Material) -> None:
    """Read files of JSON, Parquet, NumPy or UCR."""
    contents = material.contents(material.names)
    for name, content in contents.items():
        try:
            if material.kind in ("json", "jsonl"):
                material.tables.append(frames.read_objects(content, name, material.form))
            elif material.kind == "ts":
                material.tables.append(frames.read_ts(content, name, material.form))
            elif material.kind == "parquet":
                material.tables.append([frames.read_parquet(content, name)])
            else:
                material.tables.append(_archive_tables(content, name, material))
        except DataError:
            if len(contents) == 1:
                raise
            material.tables.append([])


def _archive_tables(content: bytes, name: str, material: Material) -> list[Table]:
    """Return the tables of an archive: one, or one for each part if its arrays hold many."""
    arrays, _ = frames.read_archive(content, name=name)
    lengths = Counter(len(x) for x in arrays.values() if x.ndim)
    blocks = [x for x in arrays.values() if x.ndim in (2, 3)]
    words = {len(x) for x in arrays.values() if x.ndim == 1}
    n = next((len(x) for x in blocks if len(x) in words), 0)
    if not n and len(material.names) == 1 and blocks:
        n = len(blocks[0])
    if not n or not lengths:
        return [frames.read_npz(content, name)]
    material.values["layout"] = "npz"
    return frames.part_tables(arrays, n, name)


# The layout.


def layout_of(material: Material, stated: Mapping[str, Any]) -> str:
    """Return the layout: how parts are laid out in files, columns or rows."""
    if material.values.get("layout") == "npz":
        return "npz"
    if material.kind == "ts":
        return "wide"
    several = max(map(len, material.tables))
    first = next(tables[0] for tables in material.tables if tables)
    if material.kind in ("json", "jsonl") and (several > 1 or len(material.names) == 1):
        has_lists = any(len(column) > 1 for column in first.columns.values())
        return "wide" if has_lists else "long"
    if numbered_columns(first) or _has_lists(first):
        return "wide"
    if "part.column" in stated and _changes(first, stated["part.column"]):
        return "long"
    if run_columns(material):
        return "long"
    if len(material.names) > 1:
        return "files"
    _refuse_results(first)
    return "columns" if _are_parts_beside(first, material.form) else "long"


def numbered_columns(table: Table) -> dict[str, list[str]]:
    """Return columns with numbers behind one name, by the pattern that matches them."""
    groups: dict[str, list[str]] = {}
    for name in table.columns:
        if match := re.fullmatch(r"(.*?)\d+", name):
            groups.setdefault(f"{match[1]}*", []).append(name)
    return {pattern: names for pattern, names in groups.items() if len(names) >= LEAST_NUMBERED}


def _has_lists(table: Table) -> bool:
    """Return whether cells of a column are lists."""
    cells = [column[0] for column in table.columns.values() if len(column)]
    return any(isinstance(cell, list | np.ndarray) and len(cell) > 1 for cell in cells)


def _changes(table: Table, columns: Any) -> bool:
    """Return whether the words of columns change within a table."""
    return any(
        len({*table.words(name)}) > 1
        for name in np.atleast_1d(columns).tolist()
        if name in table.columns
    )


def run_columns(material: Material) -> list[str]:
    """Return the columns that have one value for each of several runs of rows, best names first."""
    files = [tables[0] for tables in material.tables if tables and len(tables) == 1]
    joined_objects = [frames_joined(tables) for tables in material.tables if len(tables) > 1]
    found = []
    for name in (files or joined_objects)[0].columns if files or joined_objects else ():
        tables = files or joined_objects
        if CLOCK_NAME.search(name) and not PART_NAME.search(name):
            continue
        runs = [_runs(table, name) for table in tables if name in table.columns]
        if runs and sum(n > 1 for n in runs) > len(runs) / 2:
            found.append((not PART_NAME.search(name), -sum(runs), name))
    return [name for *_, name in sorted(found)]


def frames_joined(tables: Sequence[Table]) -> Table:
    """Return one table of tables with a row each."""
    from ..read.places import joined

    return joined(tables, tables[0].source)


def _runs(table: Table, name: str) -> int:
    """Return the number of runs of equal words in a column; 0 if it is none of parts.

    In a column of parts no word returns, and its runs are of 8 rows or more in the mean.
    """
    column = table.columns[name]
    if column.dtype.kind == "f" and not np.all(column == np.round(column)):
        return 0
    words = table.words(name)
    n_rows = len(words)
    starts = np.flatnonzero(words[1:] != words[:-1])
    n = len(starts) + 1
    is_text_fraction = any(re.search(r"\d[.,]\d", str(word)) for word in words[:3])
    if n_rows < LEAST_RUN * n or len({*words}) != n or is_text_fraction or "" in words:
        return 0
    return n


def _are_parts_beside(table: Table, form: TextForm) -> bool:
    """Return whether a table has a column for each part: many columns whose names are alike."""
    names = [name for name in table.columns if not CLOCK_NAME.search(name)]
    verdicts = labels.in_paths(names)
    shapes = Counter(re.sub(r"\d+", "0", name) for name in names)
    is_alike = bool(shapes) and shapes.most_common(1)[0][1] > len(names) / 2
    return len(names) >= LEAST_PARTS and (is_alike or bool(verdicts))


def _refuse_results(table: Table) -> None:
    """Raise DataError for a table with a row for each result, and no samples."""
    for name, column in table.columns.items():
        if column.dtype.kind != "O" or isinstance(column[0], list | np.ndarray):
            continue
        words = table.words(name)
        different = {*words.tolist()}
        good, bad, _ = labels.meaning(different) if len(different) < MOST_LABELS else ([], [], [])
        if good and bad and not verdicts_are_runs(words):
            wanted = f"the samples of each part in {table.source}"
            actual = f"a row for each result, with its verdict in {name}, and no curve"
            raise DataError(f"Expected {wanted}, got {actual}; dengine needs the samples.")


def verdicts_are_runs(words: Any) -> bool:
    """Return whether equal verdicts stand together in runs of one length, as those of parts do."""
    edges = np.flatnonzero(words[1:] != words[:-1])
    return len(edges) > 1 and int(np.gcd.reduce(np.diff(edges))) >= LEAST_RUN


def views_of(material: Material, layout: str, stated: Mapping[str, Any]) -> dict[str, Table]:
    """Return a table for each recording that was looked at, by its name."""
    views = dict[str, Table]()
    for tables in material.tables:
        if not tables:
            continue
        source = tables[0].source
        if layout == "long":
            table = tables[0] if len(tables) == 1 else frames_joined(tables)
            views |= _views_of_parts(table, material, stated)
        elif layout == "files" or len(tables) > 1:
            views |= {
                f"{source}#{i}" if len(tables) > 1 else source: t for i, t in enumerate(tables)
            }
        elif layout == "wide" and _has_lists(tables[0]):
            views |= {f"{source}#{i}": row for i, row in enumerate(frames.rows_of(tables[0]))}
        else:
            views[source] = tables[0]
    return views


def _views_of_parts(
    table: Table, material: Material, stated: Mapping[str, Any]
) -> dict[str, Table]:
    """Return a table for each part of a long table, and name its column."""
    columns = stated.get("part.column")
    if columns is None:
        found = run_columns(material)
        good = [name for name in found if PART_NAME.search(name)] or found
        if len(good) == 1 or (good and PART_NAME.search(good[0])):
            columns = good[0]
            if len(good) > 1:
                material.notes["part.column"] = f"one of {listed(good)}"
        else:
            text = (
                f"one of {listed(good)}" if good else f"one, or several, of {listed(table.columns)}"
            )
            material.notes["part.column"] = f"which column tells the parts apart? {text}"
            columns = UNKNOWN
    material.values["part.column"] = columns
    names = [name for name in np.atleast_1d(columns).tolist() if name in table.columns]
    if not names:
        return {table.source: table}
    words = [table.words(name) for name in names]
    keys = [" ".join(map(str, row)) for row in zip(*words, strict=True)]
    import pandas as pd

    codes, parts = pd.factorize(np.array(keys, dtype=object))
    order = np.argsort(codes, kind="stable")
    ends = np.searchsorted(codes[order], np.arange(len(parts) + 1))
    last = len(parts) - 1 if material.is_cut and len(parts) > 1 else len(parts)
    some = range(last)[: MOST_FILES * 4]
    return {f"{table.source}#{parts[i]}": table.take(order[ends[i] : ends[i + 1]]) for i in some}


# The roles of the columns.


@dataclass
class Roles:
    """Gives each column a role.

    channels : unit of each channel. rows : words of the columns that qualify rows. ignored : unit
    of each column without a role. checks : sources of labels beside the one that counts.
    """

    material: Material
    views: dict[str, Table]
    stated: dict[str, Any]
    channels: dict[str, Any] = field(default_factory=dict)
    rows: dict[str, dict[str, Any]] = field(default_factory=dict)
    ignored: dict[str, str] = field(default_factory=dict)
    checks: list[Any] = field(default_factory=list)

    @property
    def layout(self) -> str:
        """The layout."""
        return str(self.material.values["layout"])

    @property
    def first(self) -> Table:
        """The first recording that was looked at."""
        return next(iter(self.views.values()))

    def assign(self) -> None:
        """Give each column a role, in the order in which one decides about the next."""
        values, notes = self.material.values, self.material.notes
        is_matrix = self.layout == "wide" and bool(numbered_columns(self.first))
        taken = {*np.atleast_1d(values.get("part.column", [])).tolist()}
        clock: set[str] = set()
        if is_matrix or self.layout == "npz":
            if "time.rate_hz" not in self.stated:
                notes["time.rate_hz"] = "unknown, for no clock was found; state it if you know it"
        else:
            self.qualify(taken)
            form = self.material.form
            tables = [*self.kept().values()][:MOST_FILES]
            found, clock = describe_clock(tables, form, self.stated, notes)
            values |= found
        self.find_parts(taken | clock)
        taken |= clock | {*np.atleast_1d(values.get("part.column", [])).tolist()}
        taken |= self.find_labels(taken)
        self.find_channels(taken, is_matrix)
        self.find_lengths(is_matrix)
        self.find_order()
        self.list_others()

    def kept(self) -> dict[str, Table]:
        """Return the recordings without the rows that are not kept."""
        result = {}
        for name, table in self.views.items():
            for column, about in self.rows.items():
                if column in table.columns and UNKNOWN not in np.atleast_1d(about.get("keep", "")):
                    words = table.words(column)
                    drop = [*np.atleast_1d(about.get("drop", [])).tolist()]
                    is_dropped = np.isin(words, drop)
                    if ANY in drop:
                        named = [w for key in about for w in np.atleast_1d(about[key]).tolist()]
                        is_dropped |= ~np.isin(words, named)
                    table = table.take(~is_dropped)
            result[name] = table
        return result

    def qualify(self, taken: set[str]) -> None:
        """Find the columns that qualify rows: few words that change within a recording."""
        for name in self.first.columns:
            given = {
                key.rpartition(".")[2]: value
                for key, value in self.stated.items()
                if key.startswith("rows.") and key[5:].rpartition(".")[0] == name
            }
            is_clock = CLOCK_NAME.search(name) or name in np.atleast_1d(
                self.stated.get("time.column", [])
            )
            if name in taken or (is_clock and not given):
                continue
            columns = [t.columns[name] for t in self.views.values() if name in t.columns]
            if (
                columns[0].dtype.kind not in "OUSb"
                and not given
                and not QUALIFIER_NAME.search(name)
            ):
                continue
            sets = [{*t.words(name).tolist()} for t in self.views.values() if name in t.columns]
            words = sorted(set().union(*sets))
            changes = max(map(len, sets)) > 1
            if given:
                self.rows[name] = self._meanings(given, words)
            elif changes and len(words) <= FEW_WORDS and self._is_qualifier(name, words):
                counts = Counter(w for t in self.views.values() for w in t.words(name).tolist())
                shown = ", ".join(f"{word or 'empty'}: {n:,}" for word, n in counts.most_common())
                self.rows[name] = {"keep": UNKNOWN}
                self.material.notes[f"rows.{name}.keep"] = (
                    f"what do its words say of a row? {shown}; state which rows to keep, drop or "
                    f"take as invalid"
                )

    def _is_qualifier(self, name: str, words: Sequence[str]) -> bool:
        """Return whether words that change within a recording qualify its rows.

        Numbers do so only in a column with the name of a qualifier. A label that is stated in the
        last row does not.
        """
        filled = [word for word in words if word]
        are_numbers = all(re.fullmatch(r"[-+]?\d+([.,]\d+)?", word) for word in filled)
        if are_numbers and not QUALIFIER_NAME.search(name):
            return False
        is_label = labels.in_columns(self.views, [name])
        return not (is_label and is_label[0].good + is_label[0].bad)

    def _meanings(self, given: Mapping[str, Any], words: Sequence[str]) -> dict[str, Any]:
        """Return the words of a column by what they mean: the stated ones, and the others.

        If those to keep are stated, the others are dropped, else they are kept.
        """
        result = {
            key: [str(w) for w in np.atleast_1d(value).tolist()] for key, value in given.items()
        }
        named = {word for some in result.values() for word in some}
        others = [word for word in words if word not in named]
        if others and ANY not in named:
            other = "drop" if "keep" in given else "keep"
            result[other] = [*result.get(other, []), *others]
        return result

    def find_parts(self, taken: set[str]) -> None:
        """Find the column, or the line, with the number of the part, if exactly one has its name."""
        values, notes = self.material.values, self.material.notes
        stated = {"part.column", "part.path", "part.line"} & {*self.stated}
        if stated or self.layout in ("long", "columns"):
            return
        tables = [*self.views.values()]
        found = []
        for name in self.first.columns:
            if name in taken or not PART_NAME.search(name) or name in self.rows:
                continue
            if self.layout in ("wide",) and len(tables) == 1:
                words = [*tables[0].words(name)] if len(tables[0].columns[name]) else []
            else:
                sets = [{*t.words(name).tolist()} for t in tables if name in t.columns]
                words = [next(iter(some)) for some in sets if len(some) == 1]
                if len(words) < len(tables):
                    continue
            if len({*words}) > len(words) / 2 and all(words):
                found.append(name)
        if len(found) == 1:
            values["part.column"] = found[0]
        elif found:
            notes["part.column"] = f"one of {listed(found)} may be the part's number"
        if found or not self.first.above:
            return
        for line in self.first.above:
            key = re.split(r"[;:=\t,]", line.lstrip("#%* \t\"'"))[0].strip(" \"'")
            if key and re.search(r"(?i)serial|barcode|dmc|part ?(no|num|id)|teilenummer", key):
                words = self._line_words(key)
                if len(words) == len(tables) and len({*words}) > len(words) / 2:
                    values["part.line"] = key
                    return

    def _line_words(self, key: str) -> list[str]:
        """Return the words of a line above the header, of the recordings that have it."""
        words = []
        for table in self.views.values():
            try:
                words.append(labels.line_word(key, table, ""))
            except UnreadableError:
                continue
        return [word for word in words if word]

    # Labels.

    def find_labels(self, taken: set[str]) -> set[str]:
        """Find the label, and return the columns that tell it."""
        values, notes = self.material.values, self.material.notes
        stated = {key[6:]: value for key, value in self.stated.items() if key.startswith("label.")}
        places = self._places()
        candidates = self._candidates(places, taken)
        sources = {"column", "path", "line", "listing"} & {*stated}
        if sources:
            found, checks = self._stated_label(stated, candidates, places), []
        else:
            hints = self._label_hints(taken)
            found, checks = labels.choose(candidates, len(places), notes, hints)
            if stated:
                found |= stated
        values |= {f"label.{key}": value for key, value in found.items()}
        self.checks = checks
        columns = {found.get("column", "")} if not found.get("listing") else set()
        columns |= {check.column for check in checks if not check.listing}
        return columns

    def _places(self) -> dict[str, Place]:
        """Return the place of each recording, by its name; of files, of all of them."""
        if self.layout == "columns":
            clock = {*self.material.values.get("time.column", [])}
            return {n: Place(n, self.first) for n in self.first.columns if n not in clock}
        if self.layout == "wide" and len(self.views) == 1:
            table = self.first
            rows = [table.take(slice(i, i + 1)) for i in range(len(table.lines))]
            return {f"{table.source}#{i}": Place(table.source, row) for i, row in enumerate(rows)}
        if self.layout == "files" and all("#" not in name for name in self.views):
            missing = {name: Place(name, self.first) for name in self.material.names}
            return missing | {name: Place(name, table) for name, table in self.views.items()}
        return {name: Place(table.source, table) for name, table in self.views.items()}

    def _candidates(self, places: Mapping[str, Place], taken: set[str]) -> list[labels.Candidate]:
        """Return the candidates for the label, those in files that list it first."""
        parts = dict[str, str]()
        source = Description.from_dict(
            {
                "part": {
                    k[5:]: v
                    for k, v in self.material.values.items()
                    if k.startswith("part.") and v != UNKNOWN
                }
            }
        ).part
        source = self._stated_part(source)
        for name, place in places.items():
            try:
                parts[name] = part_of(source, place)
            except DataError:
                continue
        in_tables = {name: place.table for name, place in places.items()}
        read = in_tables
        if self.layout == "files" and all("#" not in name for name in self.views):
            read = self.views
        columns = [
            name for name in self.first.columns if name not in taken and name not in self.rows
        ]
        if self.layout == "wide":
            columns = [
                c
                for c in columns
                if not any(c in names for names in numbered_columns(self.first).values())
            ]
        others = [name for name in self.material.others if not name.endswith(".toml")]
        result = labels.in_listings(self.material.base, others, places, parts, self.material.form)
        if self.layout in ("files", "columns"):
            result += labels.in_paths([*places])
        if self.layout != "columns":
            result += labels.in_columns(read, columns)
            result += labels.in_lines(read)
        return result

    def _stated_part(self, source: Any) -> Any:
        """Return the source of parts, as the user stated it if so."""
        stated = {key[5:]: value for key, value in self.stated.items() if key.startswith("part.")}
        return Description.from_dict({"part": stated}).part if stated else source

    def _stated_label(
        self,
        stated: Mapping[str, Any],
        candidates: Sequence[labels.Candidate],
        places: Mapping[str, Place],
    ) -> dict[str, Any]:
        """Return the keys of `[label]` for a source that the user stated, with its words."""
        same = [
            c
            for c in candidates
            if all(
                c.source.get(k, v) == v
                for k, v in stated.items()
                if k in ("column", "path", "line", "listing", "key")
            )
        ]
        same = [
            c
            for c in same
            if {"path", "listing", "line"} & {*stated} == {"path", "listing", "line"} & {*c.source}
        ]
        if same and same[0].is_known:
            return {**same[0].values(), **stated}
        source = {
            k: str(v)
            for k, v in stated.items()
            if k in ("column", "path", "line", "listing", "key", "at")
        }
        words = {**self._words_of(source, places)}
        name = stated.get("column") or stated.get("line") or ""
        candidate = labels.Candidate(
            source, words, *labels.meaning(sorted({*words.values()}), name)
        )
        found = {**candidate.values(), **stated}
        if "good" in stated and "bad" not in stated and UNKNOWN in found["bad"]:
            rest = sorted(
                {*words.values()} - {*np.atleast_1d(stated["good"]).tolist(), *candidate.unchecked}
            )
            found["bad"] = rest if len(rest) == 1 else [UNKNOWN]
        for key in ("good", "bad"):
            if UNKNOWN in found[key]:
                self.material.notes[f"label.{key}"] = f"which of the words? {candidate.title}"
        return found

    def _words_of(self, source: Mapping[str, str], places: Mapping[str, Place]) -> dict[str, str]:
        """Return the word of each recording in a source, of those that have one."""
        from ..description import LabelSource
        from ..read.places import LabelReader, read_listing

        label = LabelSource(**{key: value for key, value in source.items()})  # noqa: C416
        listing = None
        if label.listing and label.key and label.column:
            form = self.material.form
            listing = read_listing(
                self.material.base, label.listing, label.key, [label.column], form
            )
        reader = LabelReader(label, listing, set())
        words = dict[str, str]()
        for name, place in places.items():
            if (
                label.column
                and not label.listing
                and name not in self.views
                and self.layout == "files"
            ):
                continue
            try:
                part = part_of(self._stated_part(Description.from_dict({}).part), place)
                words[name] = reader.words(place, part)[0]
            except (UnreadableError, IndexError):
                continue
        return words

    def _label_hints(self, taken: set[str]) -> list[str]:
        """Return the columns of few words that are the same within each recording."""
        hints = []
        for name in self.first.columns:
            if name in taken or self.first.columns[name].dtype.kind == "f":
                continue
            sets = [
                {*table.words(name).tolist()}
                for table in self.views.values()
                if name in table.columns
            ]
            words = set().union(*sets)
            if 1 < len(words) <= FEW_WORDS and (max(map(len, sets)) == 1 or len(sets) == 1):
                hints.append(name)
        return hints

    # Channels and traces.

    def find_channels(self, taken: set[str], is_matrix: bool) -> None:
        """Choose the channel that is named or measured like a force, `?` among several."""
        stated = {
            key[9:]: value for key, value in self.stated.items() if key.startswith("channels.")
        }
        units = self.numeric_units(taken, is_matrix)
        self.ignored |= units
        if stated:
            self.channels = dict(stated)
            return
        if "channels" in self.stated:
            self.channels = {name: units.get(name, "") for name in self.stated["channels"]}
            return
        best = likely_channels(units)
        others = [name for name in units if name not in best]
        if len(best) == 1 or (len(units) == 1):
            name = (best or [*units])[0]
            others = [other for other in units if other != name]
            self.channels = {name: units[name]}
            if others:
                self.material.notes[f"channels.{name}"] = f"others: {listed(others)}"
        else:
            text = ", ".join(f"{name} [{unit}]" if unit else name for name, unit in units.items())
            self.material.notes["channels"] = (
                f"one or several of: {text}" if units else "no column of numbers changes"
            )
            self.material.notes["channels.?"] = self.material.notes["channels"]

    def numeric_units(self, taken: set[str], is_matrix: bool) -> dict[str, str]:
        """Return the unit of each column of numbers that may be a channel."""
        if is_matrix:
            return {
                pattern: unit_in(pattern.rstrip(ANY)) for pattern in numbered_columns(self.first)
            }
        if self.layout == "columns":
            clock = {*self.material.values.get("time.column", [])}
            names = [name for name in self.first.columns if name not in clock]
            counts = Counter(re.sub(r"\d+.*", "", name) for name in names)
            stem = counts.most_common(1)[0][0]
            every = all(name.startswith(stem) for name in names) and bool(stem)
            return {f"{stem}{ANY}" if every else ANY: unit_in(names[0])}
        result = dict[str, str]()
        views = [*self.kept().values()][:MOST_FILES]
        for name in self.first.columns:
            if name in taken or name in self.rows or COUNTER_NAME.fullmatch(name):
                continue
            if self.layout == "npz" and len(self.first.columns[name]) < 2:
                continue
            if self._is_channel(name, views):
                stated = Counter(bare(t.units.get(name, "")) for t in views).most_common(1)[0][0]
                result[name] = stated or unit_in(name)
        return result

    def _is_channel(self, name: str, views: Sequence[Table]) -> bool:
        """Return whether a column holds numbers that change; words for lost samples are noted."""
        odd = Counter[str]()
        n = n_empty = 0
        changes = False
        for table in views:
            if name not in table.columns:
                return False
            cells = table.columns[name]
            if cells.dtype.kind in "iuf":
                finite = cells[np.isfinite(cells)]
                changes |= len(finite) > 1 and bool(np.ptp(finite) > 0)
                n += len(cells)
                continue
            if cells.dtype.kind not in "OUS":
                return False
            words = [as_word(cell) for cell in cells.tolist()]
            from .text_form import NUMBER

            numbers = [word for word in words if NUMBER.fullmatch(word)]
            odd.update(word for word in words if not NUMBER.fullmatch(word))
            n += len(words)
            n_empty += words.count("")
            changes |= len({*numbers}) > 1
        n_odd = odd.total()
        if (
            not changes
            or n_odd > 0.9 * n
            or any(word.lower() not in LOST for word in [w for w, k in odd.items() if k > 0.01 * n])
        ):
            return False
        if n_empty > SPARSE * n:
            self.sparse = {*getattr(self, "sparse", set()), name}
        self.odd = {
            **getattr(self, "odd", {}),
            name: [word for word in odd if word.lower() in LOST],
        }
        return True

    def find_lengths(self, is_matrix: bool) -> None:
        """Find the words for lost samples, and the samples of the traces."""
        values, notes = self.material.values, self.material.notes
        for name in self.channels:
            odd = getattr(self, "odd", {}).get(name, [])
            if name in getattr(self, "sparse", set()) and name not in self.rows:
                self.rows[name] = {"keep": [ANY], "drop": [""]}
                notes[f"rows.{name}.drop"] = "rows without a value are no samples of this channel"
                odd = [word for word in odd if word]
            if odd and "text.missing" not in self.stated:
                values["text.missing"] = sorted({*values.get("text.missing", []), *odd})
        lengths = self._lengths(is_matrix)
        if not lengths or "traces.samples" in self.stated:
            return
        counts = Counter(lengths)
        usual = int(np.median(lengths))
        how = str(self.stated.get("traces.lengths", values.get("traces.lengths", "")))
        if len(counts) == 1 and not how:
            values["traces.samples"] = lengths[0]
            return
        how = how or "pad"
        values["traces.lengths"] = how
        n_usual = counts[usual]
        if n_usual >= 0.9 * len(lengths) and "traces.lengths" not in self.stated and how == "pad":
            values["traces.lengths"] = "strict"
            notes["traces.lengths"] = (
                f"{len(lengths) - n_usual} of {len(lengths)} have another length: faults"
            )
        elif how == "pad":
            notes["traces.lengths"] = (
                f"{min(lengths)} to {max(lengths)} samples; or cut, pad-all, resample"
            )
        values["traces.samples"] = min(lengths) if how == "cut" else usual

    def _lengths(self, is_matrix: bool) -> list[int]:
        """Return the samples of the recordings that were looked at."""
        if not self.channels:
            return []
        first = next(iter(self.channels))
        if self.layout == "columns":
            cells = [self.first.columns[name] for name in self._places()]
            return [_filled(column) for column in cells]
        if is_matrix:
            names = numbered_columns(self.first).get(first, [])
            return [
                _filled(np.array([table.columns[name][i] for name in names], dtype=object))
                for table in self.views.values()
                for i in range(min(len(table.lines), MOST_FILES))
            ]
        result = []
        for table in self.kept().values():
            if first not in table.columns:
                continue
            n = len(table.columns[first])
            if first in self.rows and "" in np.atleast_1d(self.rows[first].get("drop", [])):
                n = int((table.words(first) != "").sum())
            result.append(n)
        return result

    def find_order(self) -> None:
        """Order the recordings by time if their clock tells the date."""
        values, notes = self.material.values, self.material.notes
        forms = [*np.atleast_1d(values.get("time.format", [])).tolist()]
        note = notes.get("time.format", "")
        is_dated = (
            any(form == "iso" or "%Y" in form for form in forms) and "prove neither" not in note
        )
        if is_dated or "since 1970" in note:
            values["order"] = "time"

    def list_others(self) -> None:
        """List the columns without a role, and the files beside the recordings that are not read."""
        values, notes = self.material.values, self.material.notes
        roles = {*self.channels, *self.rows, values.get("label.column", "")}
        roles |= {*np.atleast_1d(values.get("part.column", [])).tolist()}
        roles |= {*np.atleast_1d(values.get("time.column", [])).tolist()}
        roles |= {check.column for check in self.checks}
        groups = numbered_columns(self.first) if self.layout == "wide" else {}
        in_groups = {name for names in groups.values() for name in names}
        if self.layout != "columns":
            for name in self.first.columns:
                if name not in roles and name not in self.ignored and name not in in_groups:
                    self.ignored[name] = ""
        used = {values.get("label.listing"), *(check.listing for check in self.checks)}
        exclude = sorted(
            {name for name in self.material.others if name not in used}, key=natural_key
        )
        if exclude and self.material.kind == "text":
            values["exclude"] = exclude
            notes["exclude"] = "files of another form, which are not read"
        elif exclude:
            notes["exclude"] = f"not read: {listed(exclude)}"


def _filled(cells: Any) -> int:
    """Return the number of cells without those at the end that are empty or lost."""
    words = [as_word(cell).lower() for cell in np.asarray(cells).tolist()]
    n = len(words)
    while n and words[n - 1] in LOST:
        n -= 1
    return n


def likely_channels(units: Mapping[str, str]) -> list[str]:
    """Return the columns of the first rule that any fits: a force along z, then any force.

    A column is a force by its name, or by a unit of force or torque.
    """
    for pattern in FORCES[:2]:
        found = [name for name in units if pattern.search(name)]
        if found:
            return found
    found = [
        n for n, unit in units.items() if (q := quantity_of(unit)) and q[0] in ("force", "torque")
    ]
    return found or [name for name in units if FORCES[2].search(name)]
