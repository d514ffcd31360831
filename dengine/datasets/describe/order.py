"""In which order the parts were made: as their files are named, or as times and numbers say."""

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import groupby, zip_longest
from operator import itemgetter
from pathlib import PurePath
from typing import Any

import numpy as np

from ...errors import DataError, listed
from ..description import UNKNOWN, LabelSource, Strings
from ..read.files import HALF_DAY, file_key, is_unsorted, natural_key, sort_key
from ..read.places import stem_of
from .columns import LIKE_A_TIME, Proposal, Tables
from .labels import lines_of, part_words, tables_of, words_of

STAMP_NAME = re.compile(r"(?i)stamp|created|date|datum|epoch")
STAMP_WORD = re.compile(r"(.*\d){5}")
# A date or a time of day; s, ms, us or ns since 1970; or like 20240131_235959.
STAMP = re.compile(
    rf"{LIKE_A_TIME.pattern}|((1\d|2[0-4])\d{{8}}(\d{{3}}){{0,3}}(\.\d*)?"
    r"|20[0-4]\d[01]\d[0-3]\d[T_ -]?\d{4}(\d\d)?)$"
)
YEAR = re.compile(r"20[0-4]\d([01]\d[0-3]\d((\d\d){1,3})?)?")  # with month, day and time of day
MARK = re.compile(r"[-_. :/]?T?")  # between the numbers of a date
# Numbers of a date with the day or the month first, like 010324 and the time of day.
DAY_FIRST = re.compile(
    r"[0-3]?\d[0-3]\d(20)?[0-4]\d[0-2]\d[0-5]\d([0-5]\d)?|[0-3]?\d[0-3]\d20[0-4]\d"
)
MOST_GAPS = 10  # numbers that a counter may leave out for each that it has
RENAME = "rename the files"


def propose_order(p: Proposal) -> None:
    """Set `order` in `p` to what the paths of the files prove, `name` or `path`, else to `?`.

    `p` is the description so far. The files are sorted by path without the words in it that are
    labels; in the layout `columns` the columns' names count in place of files, as they stand. They
    prove the order in which the parts were made if dates or counting numbers in them rise
    (`proves_order`). `order` is then `name` if file names give the same order, else `path`. If not,
    `order`, which is `name` so far, stays if the file names without folders and labels are distinct
    and prove it; else it is `?`, with a note. While `label.column` is `?`, paths prove nothing, and
    `order` stays, too.

    In this order, or by name if it is not proved, parts are then compared. `order` is also `?` if
    part numbers, dates, times or counters of the recordings have another order (`unsorted_places`);
    of several such places the note is on the last. An `order` that the user stated stays. Raises
    DataError if a check that the user stated (a source of labels that must agree) has a listing (a
    file with a row for each part or recording) without its `key`, and SettingError for a malformed
    `windows.trigger`, the condition at which long recordings are cut.
    """
    about = p.description
    tables = tables_of(p)
    stems = {table.path: stem_of(about, table.path) for table in tables}
    by_path = by_name = [*stems]
    if about.layout != "columns":
        by_path = sorted(stems, key=lambda path: natural_key(stems[path]))
        by_name = sorted(stems, key=file_key)
    files = by_name
    names = [PurePath(stems[path]).name for path in by_name]
    # While it is open where the label stands, any folder or word may be one of a verdict.
    is_known = about.label.column != UNKNOWN
    if is_known and proves_order([stems[path] for path in by_path]):
        files = by_path
        p.put("order", "name" if by_path == by_name else "path")
    elif is_known and not (len({*names}) == len(names) > 1 and proves_order(names)):
        p.put(
            "order",
            UNKNOWN,
            f"name: by file name, or path: folder by folder; {listed(by_name[:3])} prove neither. "
            "If both are wrong, rename the files: a number, or year, month and day in front",
        )
    places = {path: place for place, path in enumerate(files)}
    tables.sort(key=lambda table: places[table.path])
    for place, other in unsorted_places(p, tables):
        p.put("order", UNKNOWN, f"name, or {other}: {place} may have another order")


def proves_order(names: Strings) -> bool:
    """Return whether names in their order prove that the parts were made in this order.

    Dates (`find_date`) must never fall. If the names first differ in the date, the names of one
    date must prove their order, too. If they first differ in another number, it must be distinct in
    each name and rise with few gaps (`may_count`), and any other number that is distinct in each
    must rise. 31.12.2025 is read with the year first; other numbers with the day first
    (010324080000), and AM and PM, prove nothing. If all names are equal, no other order is
    possible.
    """
    pieces = [*zip_longest(*map(natural_key, names), fillvalue="")]
    first = next((i for i, row in enumerate(pieces) if len({*row}) > 1), None)
    if first is None:
        return len({*names}) == 1  # unlike 1 and 01
    date = find_date(pieces)
    dates = [*zip(*pieces[date.start : date.stop : 2], strict=True)]
    if dates != sorted(dates) or any(map(HALF_DAY.search, names)):
        return False
    if first in date:
        days = groupby(zip(dates, names, strict=True), itemgetter(0))
        return all(proves_order([*map(itemgetter(1), day)]) for _, day in days)
    numbers = pieces[1 : date.start : 2] + pieces[date.stop + 1 :: 2]
    # Numbers that each name has, and each another one: "" is where a name has none.
    counters = [row for row in numbers if len({*row, ""}) > len(names)]
    is_odd = any([*row] != sorted(row) or fits_all(DAY_FIRST, row) for row in counters)
    return pieces[first] in counters and not is_odd and may_count(pieces[first])


def may_count(numbers: Sequence[int]) -> bool:
    """Return whether numbers in names may count the parts.

    They may in three cases: their range is below ten times how many they are; their steps are
    equal; or all are like seconds since 1970 or a date with a time (`STAMP`). Random numbers,
    serial numbers with gaps and times of day are seldom so.
    """
    return (
        max(numbers) - min(numbers) < MOST_GAPS * len(numbers)
        or len({*np.diff(numbers)}) == 1
        or fits_all(STAMP, numbers)
    )


def find_date(pieces: Sequence[Any]) -> range:
    """Return the places of the date in names.

    The date is the first number that is a year from 2000 to 2049, or begins with one (20240131), in
    all names, together with the numbers behind it if only marks like `-` or `/` stand between them.
    Without a date it is the place behind the last piece.

    pieces : for each place, the text or number of each name there; "" if a name has no more.
    """
    n = len(pieces)
    begin = end = next((i for i in range(1, n, 2) if fits_all(YEAR, pieces[i])), n)
    while end + 2 < n and "" not in pieces[end + 2] and fits_all(MARK, pieces[end + 1]):
        end += 2
    return range(begin, end + 1)


def fits_all(pattern: re.Pattern[str], pieces: Sequence[Any]) -> bool:
    """Return whether a regular expression matches each text or number as a whole."""
    return all(map(pattern.fullmatch, map(str, pieces)))


def is_out_of_order(words: Strings, place: str, is_fixed: bool) -> bool:
    """Return whether words that should rise from recording to recording do not.

    Rising means in the order of `sort_key`. Words that are all equal need not rise. Dates and times
    should rise, like 2026-01-31, 20260131_235959 or seconds since 1970, and in a place that is
    named like them any words with five digits or more. If `sort_key` cannot order one of them, like
    01/31/26 (`is_unsorted`), they do not rise.

    Other words should rise only if the place is fixed, all words are different, and one of these
    holds: they are sorted as texts (P10 before P2); they fall throughout; or the last numbers in
    them count the recordings. Those are more than two whole numbers, all different, of which the
    largest is above the smallest by less than twice the number of words.

    words : the word of each recording, in the order to be compared. place : the name of the column
    or line in which they stand. is_fixed : whether the place has one word for each recording.
    """
    if len({*words}) == 1:
        return False
    ranks = [*map(sort_key, words)]
    is_sorted = ranks == sorted(ranks)
    if all(map(STAMP.match, words)) or (
        STAMP_NAME.search(place) and all(map(STAMP_WORD.match, words))
    ):
        return not is_sorted or any(map(is_unsorted, words))
    if is_sorted or not is_fixed or len({*words}) < len(words):
        return False
    return words == sorted(words) or ranks == sorted(ranks, reverse=True) or _count(ranks)


def _count(ranks: Sequence[Any]) -> bool:
    """Return whether the last numbers in words count these; `ranks` has the `sort_key` of each.

    There must be more than two words, each with a whole number, all different, and the largest
    above the smallest by less than twice the number of words.
    """
    counts = [rank[-2] for rank in ranks if len(rank) > 1]
    is_whole = len({*counts}) == len(ranks) > 2 and not any(n % 1 for n in counts)
    return is_whole and max(counts) - min(counts) < 2 * len(counts)


def unsorted_places(p: Proposal, tables: Tables) -> Iterator[tuple[str, str]]:
    """Yield each place whose words rise in another order than the recordings, and the `order` then.

    The places are the part numbers, columns without another use, lines above the header of the
    first table, and columns of listings of labels. A recording's word is its text in a place; in a
    column of its table, the cell of the first row; empty ones are left out. The `order` is a column
    of the tables, or else a text that says what to do. `p` is the description so far. Raises
    SettingError for a malformed `windows.trigger`, the condition at which long recordings are cut.

    tables : the table of each recording, in the order to be compared.
    """
    part = p.description.part
    parts = part_words(part, tables)
    if is_out_of_order([*parts.values()], "part", True):
        yield "part", listed(part.column) or RENAME
    for source in _sources(p):
        words = [*filter(None, words_of(p, source, tables, parts).values())]
        is_column = source.column and not source.listing
        place = source.column or source.line
        if is_out_of_order(words, place, not is_column or bool(p.columns[source.column].fixed)):
            can_sort = is_column and not any(map(is_unsorted, words))
            yield place, source.column if can_sort else RENAME


def _sources(p: Proposal) -> Iterator[LabelSource]:
    """Yield the places for `unsorted_places`, without that of the part numbers.

    A listing that cannot be read is skipped. Raises SettingError for a malformed `windows.trigger`.
    """
    yield from (LabelSource(column=column.name, at="first") for column in p.unused)
    yield from (LabelSource(line=line) for line in lines_of(p))
    for label in p.description.labels:
        with suppress(DataError):  # a label in no listing, or in one that cannot be read
            columns = p.read_listing(label.listing).columns
            yield from (replace(label, column=name) for name in columns)
