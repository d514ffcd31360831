"""In which order the parts were made: as their files are named, or as times and numbers say."""

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import zip_longest
from typing import Any

import numpy as np

from ...errors import DataError, listed
from ..description import UNKNOWN, Clock, LabelSource, TextForm
from ..read.clock import times_of
from ..read.files import HALF_DAY, natural_key
from ..read.places import listing_table, without_label, without_suffix
from ..table import Table
from .columns import Column, Proposal
from .labels import WORD, lines_of, part_words, tables_of, words_of

STAMP_NAME = re.compile(r"(?i)stamp|stempel|created|date|datum|epoch")
DATE_IN_PATH = (  # with the year in front
    r"(?<![\d.])((?:19|20)\d\d(?:-[01]\d-|_[01]\d_|\.[01]\d\.|[01]\d)[0-3]\d(?!\d{7})[^/]*)$"
)
YEAR = re.compile(r"20[0-4]\d((\d\d){2,5})?")  # with month and day, and with the time of day
VERDICT_FOLDER = re.compile(rf"(?i)(?<![^/])({WORD})/")


def propose_order(p: Proposal) -> None:
    """Set `order` in `p` to what is certain: `name`, `path` if labels stand first in names, or `?`.

    `p` is the description so far; `name` means by file name, and `path` folder by folder, without
    the text that is the label. It is `?`, with a note, if the files, folder by folder, have another
    order than their names, or if the names do not count the parts: they do not differ first in a
    number or date (`counts_parts`). The text of `label.path` and folders named like a verdict do
    not count; while `label.column` is `?`, names are not looked at. It is `?`, too, if the part
    numbers, or the columns' names where each column is a part, fall or are sorted as texts (P10
    before P2), or if a date or time of each recording does not rise (`falling_stamps`). If several
    of these hold, the note is on the last. An `order` that the user stated stays. Raises
    SettingError for a malformed `windows.trigger`, the condition at which long recordings are cut.
    """
    label = p.description.label
    # A folder of a verdict is no step of the production, even if the label stands elsewhere.
    paths = {
        name: VERDICT_FOLDER.sub("", without_label(label, without_suffix(name))) for name in p.names
    }
    files = sorted(paths, key=lambda name: natural_key(_last(paths[name])))
    # While it is open where the label stands, any folder or word may be one of a verdict.
    if label.column != UNKNOWN:
        names = [_last(paths[name]) for name in files]
        if files != sorted(paths, key=lambda name: natural_key(_last(name))):
            p.put("order", "path")
        by_folder = sorted(paths, key=lambda name: natural_key(paths[name]))
        if files != by_folder or not counts_parts(names):
            p.put(
                "order",
                UNKNOWN,
                f"name: by file name, or path: folder by folder; {listed(names[:3])} prove neither."
                " If both are wrong, rename the files: a number, or year, month and day in front",
            )
    tables = tables_of(p)
    tables.sort(key=lambda table: natural_key(_last(paths.get(table.path, ""))))
    words = part_words(p.description.part, tables)
    if p.description.layout == "columns":
        words = {table.source: table.path for table in tables}
    numbers = [*words.values()]
    rising = sorted(numbers, key=natural_key)
    if numbers != rising and numbers in (sorted(numbers), rising[::-1]):
        name = listed(p.description.part.column) or "path"
        p.put("order", UNKNOWN, f"name, or {name}: the part numbers fall or are sorted as texts")
    for source in falling_stamps(p, tables):
        place = source.column or source.line or "the file names"
        other = "rename the files" if source.listing or not source.column else place
        p.put("order", UNKNOWN, f"name, or {other}: the dates in {place} have another order")


def _last(path: str) -> str:
    """Return the last name in a path."""
    return path.rpartition("/")[2]


def counts_parts(names: Sequence[str]) -> bool:
    """Return whether sorted names prove an order, by what they differ in first.

    The order is that in which the parts were made. What differs must be a number in every name, and
    either another one in each, or a year or a part of a date or time behind it. Different names
    with AM or PM prove nothing. Numbers that repeat may be of a program or a station, and words
    sort before numbers. Equal names prove it, too.
    """
    pieces = [*zip_longest(*map(natural_key, names), fillvalue="")]
    for i, row in enumerate(pieces):
        if len({*row}) > 1:
            years = [all(YEAR.fullmatch(str(n)) for n in row) for row in pieces[1 : i + 1 : 2]]
            is_counter = any(years) or len({*row}) == len(names)
            return i % 2 == 1 and "" not in row and is_counter and not HALF_DAY.search(str(names))
    return True


def falling_stamps(p: Proposal, tables: Sequence[Table]) -> Iterator[LabelSource]:
    """Yield each place with a date or time for each recording, by which these are out of order.

    The places are the file names, if they have dates with the year in front; columns without
    another use that have one word in all rows of a recording; lines above the header of the first
    table; and columns of listings of labels. A column or line counts if its words are dates or
    times of a known form (`Column.forms`), or if its name says so (`timestamp`, `created`); then
    they are sorted as texts, numbers in them by their size (`natural_key`). Equal ones are in
    order, and if several forms fit, one in which they are in order is enough. `p` is the
    description so far. Raises SettingError for a malformed `windows.trigger`, the condition at
    which a part begins.

    tables : the table of each recording, in the order to be compared.
    """
    parts = part_words(p.description.part, tables)
    sources = [LabelSource(path=DATE_IN_PATH)]
    sources += [LabelSource(column=column.name) for column in p.unused if column.fixed]
    sources += [LabelSource(line=line) for line in lines_of(p)]
    for label in p.description.labels:
        with suppress(DataError):
            listing = listing_table(p.base / label.listing, p.description.text)
            sources += [replace(label, column=name) for name in listing.columns]
    for source in sources:
        words = [*words_of(p, source, tables, parts).values()]
        cells = Table("", {"": np.array(words, dtype=object)}, [])
        forms = Column("", [cells], TextForm()).forms if words else []
        ranks: list[Any] = []
        for form in forms:
            with suppress(DataError):  # a word far behind may be no time
                ranks.append(times_of(cells, Clock(("",), (form,)), TextForm()).tolist())
        if source.path or STAMP_NAME.search(source.column or source.line):
            ranks = ranks or [[*map(natural_key, words)]]
        if ranks and not any(rank == sorted(rank) for rank in ranks):
            yield source
