"""What each column is for: to tell which rows are samples, as clock, part, label or channel, or for
nothing.
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace

import numpy as np

from ...errors import DataError, listed
from ..description import (
    ANY,
    UNKNOWN,
    PartSource,
    RowWords,
    Strings,
    as_option,
    expect_one_of,
)
from ..read.files import natural_key
from ..read.recordings import is_dropped, kept_rows
from ..read.split import match_numbered
from ..table import Table
from ..units import QUANTITY, is_load
from .clock import CLOCK_NAME, is_clock, propose_clock, propose_rate
from .columns import FORCES, LOST, MOST_WORDS, Column, Proposal, columns_of, counts_of
from .labels import VERDICT_NAME, lines_of, part_words, propose_label
from .layout import PART_NAME
from .order import propose_order
from .text_form import is_numbering

SPARSE = 0.1
STRANGE = 0.01
PART_LINE = re.compile(
    r"(?i)^sn$|specimen|serial|(?<!fixture )barcode|dmc|part ?(no|num|id)|teilenummer|serien"
    r"|werkst.ck(?!tr)"
)
QUALIFIER_NAME = re.compile(
    r"(?i)status|valid|g(ü|ue)ltig|qualit|flag|error|fehler|(?<!de)fault(?!.?time)|d[ée]faut|satur(?!d)"
    r"|(?<!e)state(?!l)|overload|(ü|ue)berl|stale|lost(?!.?time)|missing|good(?!s|.?part)"
    r"|[ _.](ok|io)$|^qc?$"
)
SIGNAL = re.compile(r"(?i)(force|kraft|torque|drehmoment|load|last)([_ ]?[xyz])?")
WORD_BEGINS = r"(?i)(^|[^a-z]|(?-i:(?<=[a-z])(?=[A-Z])))"  # also in `forceUnit`
SCALE_NAME = re.compile(
    WORD_BEGINS + r"(unit(?!.*(serial|id|no|nr|under))|uom|einheit|scale|scaling"
    r"|factor|faktor|gain|sensitivity|fs|dt|frequency|interval|takt"
    r"|(sampl\w*|abtast|scan|data|mess)[ _]?(rate|freq\w*))s?($|[^a-z])"
)
FACTOR_NAME = re.compile(
    r"(?i)scale(?!s)|scaling|factor(?!y)|(?<!sicherheits)faktor|(?<!ver)teiler|divisor"
)
FACTOR = re.compile(r"(?!1([.,]0*)?$)-?\d[\d.,]*(e[-+]?\d+)?", re.IGNORECASE)  # not 1
SET_VALUE = re.compile(
    WORD_BEGINS
    + r"(set|vorgabe|nominal|target|consigne|max|min|limit|(cmd|des|ref)(?![a-z])|comm?and"
    r"|desired|demand|(err|est|std|sim|dot|diff|calc)(?![a-z])|error|model|estimate|predict|bias"
    r"|drift|offset)|soll|grenz|abweich"
)
ANY_NAME = re.compile("")


def propose_roles(p: Proposal) -> None:
    """Find what each column is for, and set the keys that say so in `p`.

    The columns are those of `p.tables`. In this order: clock, part, label, channels, and what
    follows from these: words for lost samples, other columns that tell which rows are samples,
    rate, length of the traces, order of the parts, ignored columns and files. If no rule proves a
    value, the key is `?`, or stays empty like `[part]` and `[channels]`. If it is open which rows
    are samples, `traces.samples` is `?` and no rate is set; a clock with `?` gives no rate either,
    and if its column is `?`, `order` stays as it is. `ignored` becomes the columns without any use,
    with their units. `exclude` becomes the files in `p.others` without listings of labels, if there
    are any, unless `exclude` is `?`. Stated keys stay, but a stated `ignored` is replaced, and a
    stated `[rows]` gets further words and columns (`complete_rows`, `qualify_rows`). `p.columns` is
    set, and `p.tables` loses rows that are no samples. Raises DataError if a stated column of
    times, of `[rows]` or channel does not exist, no word of a stated `keep` comes, a setting in
    `[time]` is wrong, a stated source of labels has no words (like `ok`) or cannot be read, or
    cells are lists, and SettingError for a malformed `windows.trigger`.
    """
    p.columns = columns_of(p.tables, p.description.text)
    for name in (*p.description.time.column, *p.description.channels, *p.description.rows):
        expect_one_of(p.columns, name, "the columns")
    complete_rows(p)
    propose_clock(p)
    propose_part(p)
    propose_label(p)
    propose_channels(p, {c.name: c.unit for c in filter(may_be_channel, p.unused)})
    find_lost(p)
    qualify_rows(p)
    clock = p.description.time
    if any(UNKNOWN in about.keep for about in p.description.rows.values()):
        p.put("traces.samples", UNKNOWN, "it follows from rows")
    else:
        if clock.column and UNKNOWN not in clock.column + clock.format:
            propose_rate(p, p.tables)
        propose_lengths(p)
    if p.description.order == "name" and "order" not in p.stated and UNKNOWN not in clock.column:
        propose_order(p)
    others = sorted({*p.others} - p.description.listings, key=natural_key)
    if UNKNOWN not in p.description.exclude and others:
        p.put("exclude", others)
    p.put("ignored", {column.name: column.unit for column in p.unused})


def complete_rows(p: Proposal) -> None:
    """Complete the stated `[rows]` in `p`, and leave out the rows that are no samples.

    The words of a column that `[rows]` does not state are added to `keep`, or to `drop` if `keep`
    is stated; `*` in their place if they are more than 12, and nothing if `*` is stated. Rows that
    are no samples are left out of `p.tables` and `p.columns`; a recording keeps all rows if
    `[rows]` cannot be applied, for example if it lacks a column. But a recording with one cell in
    such a column is left out as a whole if the word of this cell drops it; if that leaves out all
    recordings, all of them stay. Raises DataError if none of the words that `keep` states, without
    a `*`, comes in its column.
    """
    rows = dict(p.description.rows)
    for name, about in p.description.rows.items():
        words = sorted(p.columns[name].counts)
        if about.keep and {*about.keep}.isdisjoint([*words, ANY]):
            expect_one_of(words, about.keep[0], f"rows.{name}")
        others = tuple(word for word in words if about.kinds([word]) == [""])
        if len(others) > MOST_WORDS:
            others = (ANY,)
        key = "drop" if about.keep else "keep"
        rows[name] = replace(about, **{key: getattr(about, key) + others})
    p.description = replace(p.description, rows=rows)
    tables = [table for table in p.tables if not is_dropped(table, rows)]
    for i, table in enumerate(tables):
        with suppress(DataError):
            tables[i] = kept_rows(table, rows)
    p.tables = tables or p.tables
    p.columns = columns_of(p.tables, p.description.text)


def qualify_rows(p: Proposal) -> None:
    """Set `[rows]` in `p` for the columns without another use that tell which rows are samples.

    `may_qualify` says which ones they are. If the cells of such a column have several words, its
    `keep` is `?`, with a note that counts them; if they have only one word, this becomes its
    `keep`. Raises UnreadableError if cells are lists, and SettingError for a malformed
    `windows.trigger`.
    """
    rows = dict(p.description.rows)
    n_rows = max(column.counts.total() for column in p.columns.values())
    for column in p.unused:
        if may_qualify(column, n_rows):
            words = tuple(column.counts)
            if len(words) > 1:
                p.notes[f"rows.{column.name}.keep"] = (
                    "which rows are samples? all: *, or the words of those to keep; the others are "
                    f"dropped: {counts_of(column.odd or column.counts)}; lost samples: invalid; if "
                    "one row has the label, state label.column, and label.at as first or last"
                )
                words = (UNKNOWN,)
            rows[column.name] = RowWords(words)
    p.description = replace(p.description, rows=rows)


def is_status(column: Column) -> bool:
    """Return whether a column is named like a status or verdict, and has a text.

    Those for lost values (`LOST`) are no texts here.
    """
    is_named = QUALIFIER_NAME.search(column.name) or VERDICT_NAME.fullmatch(column.name)
    return bool(is_named and texts_of(column))


def texts_of(column: Column) -> set[str]:
    """Return the words of a column that are neither numbers nor stand for a lost value."""
    return {word for word in column.odd if word.lower() not in LOST}


def may_qualify(column: Column, n_rows: int) -> bool:
    """Return whether the words of a column may tell which rows are samples.

    It must have a cell in each of the `n_rows` rows of all recordings, or a single one for each
    recording that has the column. It must change within a recording, and be a status (`is_status`),
    have 1 to 12 different texts, perhaps beside numbers, like `Max` in a footer, and no times, or
    number the phases of a cycle: 2 to 12 different numbers in steps of whole numbers, with no empty
    cell and no unit. If it does not change, there must be several words, of which one names a force
    or a torque, or it must be named like a status (`Status`, `valid`), a unit, a factor or a rate
    and have just one word in all: recordings with another one become faults.
    """
    words = column.counts
    if words.total() not in (n_rows, len(column.fixed)):
        return False
    if not column.fixed:
        is_text = 0 < len(texts_of(column)) <= MOST_WORDS
        is_time = column.forms or CLOCK_NAME.search(column.name)
        is_phase = 1 < len(words) <= MOST_WORDS and not (
            column.odd or column.unit or (column.steps % 1).any()
        )
        return is_status(column) or is_phase or (is_text and not is_time)
    if len(words) > 1:
        return any(map(SIGNAL.fullmatch, words))
    return bool(QUALIFIER_NAME.search(column.name) or SCALE_NAME.search(column.name))


def sources_named(p: Proposal, column: re.Pattern[str], line: re.Pattern[str]) -> list[PartSource]:
    """Return the columns without a role and the lines above the header that match by name.

    `column` is searched in the names of columns, and `line` in the beginnings of the lines of the
    first table (`lines_of`). Raises SettingError for a malformed `windows.trigger`.
    """
    sources = [PartSource((c.name,)) for c in p.unused if column.search(c.name)]
    return sources + [PartSource(line=name) for name in filter(line.search, lines_of(p))]


def propose_part(p: Proposal) -> None:
    """Set `[part]` in `p` to the column or the line above the header that has the part's number.

    `p` holds the description so far, and a table of each recording. The name must be like that of a
    part's number, and there must be more different words than half the number of `p.tables`.
    Recordings in which the word is missing, empty or changes give none. Columns that the
    description uses already, for example as the clock, are left out, and the lines are those of the
    first table. If several qualify, nothing is set. If none does, but in a table with a row for
    each part such a column or line has several words, at most half as many as rows, and `[rows]`,
    which says what rows are kept, is empty, `part.column` is `?`, with a note: the rows may be
    pieces of a curve. A `[part]` that is set or stated already stays. Raises SettingError for a
    malformed `windows.trigger`.
    """
    about = p.description
    if about.part != PartSource() or "part.column" in p.stated:
        return
    counts = {
        source: len({*part_words(source, p.tables).values()})
        for source in sources_named(p, PART_NAME, PART_LINE)
    }
    many = [source for source, n in counts.items() if n > len(p.tables) / 2]
    names = [source.line or source.column[0] for source, n in counts.items() if n > 1]
    if len(many) == 1:
        p.description = replace(about, part=many[0])
    elif names and about.layout == "wide" and not (many or about.rows):
        p.put(
            "part.column",
            UNKNOWN,
            f"{listed(names)}, or []: is a number in several rows a part that came again? Pieces "
            "of a curve must be joined first",
        )


def propose_channels(p: Proposal, units: Mapping[str, str]) -> None:
    """Set `[channels]` in `p` to one column, with its unit; does nothing if channels are stated.

    It is the only likely one (`likely_channels`). The channels stay empty, with a note, if there is
    none or several, if the column is named like a set value, a limit or an error or stands for
    columns that are not numbered evenly, like `x0`, `x1`, `x5` (`_doubts_on`), or if a unit, a
    factor of scale or a sampling rate that the recordings state differs between them, or a factor
    is not 1 (`_other_scales`). Raises SettingError for a malformed `windows.trigger` (the condition
    at which a part begins).

    units : the columns that may be channels, with their units, "" for unknown.
    """
    if p.description.channels:
        return
    best = likely_channels(units)
    doubts = [*_doubts_on(p, best), *_other_scales(p)]
    if len(best) == 1 and not doubts:
        p.put("channels", {best[0]: units[best[0]]})
        return
    text = "no column has numbers that change; a cell with a unit or a list in it is no number"
    if units:
        text = f"--set channels.COLUMN=UNIT for one or several of: {listed(units)}"
    keys = ("channels", f"channels.{UNKNOWN}")
    p.notes |= dict.fromkeys(keys, "; ".join([text, *doubts]))


def likely_channels(units: Mapping[str, str]) -> list[str]:
    """Return the columns that are likely channels.

    Three rules are tried, and all columns that fit the first one with any are returned: a name like
    a force along z; a name like a force, like `F` or like `value`, or a unit of force or torque; no
    condition. A name counts only if the unit is one of force or torque, or unknown. If no returned
    column has a unit of force or torque, those that have one are added at the end.

    units : the unit of each column that may be a channel, "" for unknown.
    """
    forces = [name for name, unit in units.items() if is_load(unit)]
    likely = [name for name, unit in units.items() if not unit or name in forces]
    along_z, like_a_force = ([*filter(pattern.search, likely)] for pattern in FORCES)
    best = along_z or [*dict.fromkeys([*like_a_force, *forces])] or [*units]
    # One may have the name, another the unit.
    return best if {*best} & {*forces} else [*best, *forces]


def _doubts_on(p: Proposal, names: Strings) -> Iterator[str]:
    """Yield the first reason why a column may not be a channel, for each that has one.

    The reasons: the column is named like a set value, a limit, an error, an offset or the result of
    a model (`F_soll`, `F_max`, `F_err`); its name is like `x*` and stands for the columns `x0`,
    `x1`, ... of the first of `p.tables`, and these are fewer than 20, or their numbers do not rise
    evenly (`is_numbering`). `p` is the description so far, and `p.tables` are the recordings that
    are looked at.

    names : the names of the columns.
    """
    origin = p.tables[0].origin if p.tables else {}
    for name in names:
        numbers = [match[1] for match in match_numbered(name, origin.get(name, ()))]
        if SET_VALUE.search(name):
            yield f"{name} may be no measurement, but a set value, a limit or an error"
        elif numbers and not is_numbering(numbers):
            yield f"{name} is not numbered evenly"


def _other_scales(p: Proposal) -> Iterator[str]:
    """Yield a text for each column or line above the header that shows another scale.

    It is named like a unit, a factor or a rate, or all its words are units, or numbers with one,
    and come twice on average; its word is not the same in all recordings. A word that is the same
    in all recordings counts only if it is a number other than 1 and the name is like that of a
    factor. Recordings in which it is missing, empty or changes are ignored. The columns are those
    without a role (such as channel, clock or label), and the lines are those of the first table.
    Raises SettingError for a malformed `windows.trigger`.
    """
    for source in sources_named(p, ANY_NAME, ANY_NAME):
        name = source.line or source.column[0]
        words = [*part_words(source, p.tables).values()]
        n = len({*words})
        are_units = 2 * n <= len(words) and all(map(QUANTITY.fullmatch, words))
        is_factor = FACTOR_NAME.search(name)
        if n > 1 and (are_units or is_factor or SCALE_NAME.search(name)):
            yield f"{name} differs, {counts_of(words)}: convert them first, or state channels"
        if n == 1 and is_factor and FACTOR.fullmatch(words[0]):
            yield (
                f"{name} is {words[0]}: if it scales the samples, state channels.COLUMN.factor, "
                "else channels"
            )


def may_be_channel(column: Column) -> bool:
    """Return whether a column looks like a channel, by its cells.

    Whether it has another use in the description is not checked. It must have at least three
    different numbers, change within one recording or more, and be neither times nor a status with
    a text (`is_status`), nor a counter, which rises by 1 in each row.
    """
    is_counter = len(column.steps) and (column.steps == 1).all()
    is_other = is_counter or is_clock(column) or is_status(column) or column.fixed
    return not is_other and len(column.counts) - len(column.odd) > 2


def find_lost(p: Proposal) -> None:
    """Set `text.missing` in `p` to the words that stand for lost samples (cells without a value).

    `p` is the description so far. The words are those already there, and those of `LOST`, like
    `nan`, `-` or the empty cell, that a channel has, in any case of letters. If another text is in
    more than 1 % of a channel's cells, or if one of them has a number like -9999 (`far_outliers`),
    `text.missing` is `?`, with a note. So it is if more than 10 % of the cells of a channel are
    empty and `time.column` is set, even to `?`: these rows may belong to another signal. A stated
    `text.missing` stays.
    """
    missing = {*p.description.text.missing}
    strange = dict[str, int]()
    for name in p.description.channels:
        column = p.columns[name]
        n_cells = column.counts.total()
        for word, n in column.odd.items():
            is_sparse = not word and p.description.time.column and n > SPARSE * n_cells
            if word.lower() in LOST and not is_sparse:
                missing.add(word)
            elif n > STRANGE * n_cells and word not in missing:
                strange[word] = n
        strange |= far_outliers(column)
    p.put("text.missing", sorted(missing))
    if strange:
        p.put(
            "text.missing",
            UNKNOWN,
            f"do these mean a lost sample? {counts_of(strange)}; if so "
            f"{as_option('text.missing', [*sorted(missing), *strange])}, else "
            f"{as_option('text.missing', sorted(missing))}; rows of another signal: "
            "rows.COLUMN.drop, and channels.COLUMN",
        )


def far_outliers(column: Column) -> dict[str, int]:
    """Return how often each word comes that is a number far outside all others, like -9999.

    These are marks for lost samples or for overflow. The smallest or largest number, whichever is
    farther from its neighbour, is taken away as long as that gap is more than the range of those
    that remain, which are at least three. Of the numbers taken away, those that come twice or more
    are returned. A number in two forms, like -9999 and -9999.0, has no gap. The result is empty if
    a number is not written as `column.form` says.
    """
    words = np.array([word for word in column.counts if word not in column.odd], dtype=object)
    found = dict[str, int]()
    with suppress(DataError):
        numbers = Table(column.name, {column.name: words}).numbers(column.name, column.form)
        order = np.argsort(numbers).tolist()
        while len(order) > 3:
            steps = np.diff(numbers[order])
            last = 0 if steps[0] > steps[-1] else -1
            word = words[order.pop(last)]
            if steps[last] <= np.ptp(numbers[order]):
                break
            if column.counts[word] > 1:  # once: a peak, behind which marks may lie
                found[word] = column.counts[word]
    return found


def propose_lengths(p: Proposal) -> None:
    """Set `traces.samples` in `p`, if it is 0, to the median length of the recordings.

    `p` is the description so far. The median is rounded down. The length is that of the first
    channel; without one nothing is set. Recordings without rows are ignored; if all are, the length
    is 0. If some have another length than this median, also where `traces.samples` is stated, and
    `traces.lengths` is not stated, a note counts them, and `traces.lengths` becomes `pad` (their
    end is cut, or their last sample repeated) if they are more than 10 % of the recordings, else
    `strict` (they are left out). A stated `traces.samples` stays. Unless `traces.samples` is
    stated, another note counts the recordings that end with two zeros or NaN or more, if they are
    more than 10 %: these may fill up shorter recordings.
    """
    if not p.description.channels:
        return
    column = p.columns[next(iter(p.description.channels))]
    lengths = [len(words) for words in column.words if len(words)]
    usual = int(np.median(lengths or 0))
    others = [n for n in lengths if n != usual]
    most = SPARSE * len(lengths)
    if others:
        p.put(
            "traces.lengths",
            "strict" if len(others) <= most else "pad",
            f"{len(others)} of {len(lengths)} recordings have another length, {min(others)} to "
            f"{max(others)}; other choices: cut, pad-all, resample, strict",
        )
    p.put("traces.samples", p.description.traces.samples or usual)
    n_filled = sum(np.array_equal(np.nan_to_num(x[-2:]), [0, 0]) for x in column.numbers)
    if n_filled > most and "traces.samples" not in p.stated:
        p.notes["traces.samples"] = (
            f"{n_filled} recordings end with several zeros or NaN: are these samples?"
        )
