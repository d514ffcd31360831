"""`Column`, one column in all recordings, and `Proposal`, the description so far."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import groupby
from pathlib import Path
from statistics import mode
from typing import Any

import numpy as np

from ...errors import DataError
from ...records import Floats
from ..description import Clock, Description, Stated, Strings, TextForm
from ..read.clock import ISO, times_of
from ..read.places import ListingReader, listing_table
from ..read.split import pattern_of, signals_of, word_columns
from ..table import Cells, Table
from ..units import bare, unit_in

DAY = "%Y-%m-%d"
DAYS = (
    "%d.%m.%Y", "%Y/%m/%d", "%m/%d/%Y", "%d/%m/%Y", "%d-%m-%Y", "%m-%d-%Y",
    "%d.%m.%y", "%d-%b-%y", "%d-%b-%Y",
)  # fmt: skip
TIMES = (
    "%H:%M:%S.%f", "%H:%M:%S:%f", "%H:%M", "%I:%M:%S.%f %p", "%I:%M %p",
)  # fmt: skip
FORMS = (
    DAY, ISO, *DAYS, *TIMES, "%M:%S.%f", "%Y-%m-%d %H:%M:%S.%f UTC", "%Y-%m-%d %H:%M:%S.%f",
    *(f"{day} {time}" for day in DAYS for time in TIMES),
)  # fmt: skip
LIKE_A_TIME = re.compile(
    r"\d+[:\-./T](\d+|[A-Za-z]{3})[:\-./T]\d|\d+:\d+\.\d|\d{8}T\d{6}|\d+:\d\d$"
)
LEAST_RUN = 8  # rows of a part
MOST_WORDS = 12  # that are told apart, as labels
LOST = ("nan", "null", "none", "n/a", "na", "-", "--", "---", "#n/a", "")
MOST_CELLS = 20  # of a recording whose form of times is looked at
# A number with any decimal mark and any mark of groups.
NUMBER = re.compile(
    r"\s*([-+−]\s*)?(?=[.,]?\d)(\d{1,3}([ '’\u202f\xa0.,]\d{3})+|\d*)([.,]\d*)?([eE][-+]?\d+)?\s*"
)
# Names of channels, the likeliest first.
FORCES = (
    re.compile(
        r"(?i)(^|[^a-z])f_?z(?![a-z])|(force|kraft|wrench)[^a-z]*z(?-i:(?![a-z]))|tcp_force_2$"
    ),
    re.compile(
        r"(?i)force|kraft|fuerza|forza|load|torque|drehmoment|thrust|effort|last\b|力|荷重"
        r"|^(.*\.)?_?(f\b.*|value)$"
    ),
)
Tables = Sequence[Table]


def counts_of(words: Iterable[str]) -> str:
    """Return a text like "ok: 1,200, empty: 3" with how often each word comes.

    It has the 12 most frequent words, most frequent first; "empty" stands for "".
    """
    return ", ".join(f"{w or 'empty'}: {n:,}" for w, n in Counter(words).most_common(MOST_WORDS))


@dataclass
class Column:
    """One column in the tables, one for each recording, that have it.

    Its properties are computed when they are first read, and then kept. `form` is the section
    `[text]`: how numbers are written.
    """

    name: str
    tables: Tables
    form: TextForm

    @cached_property
    def words(self) -> list[Cells]:
        """The words of each recording, an array of texts each, as `Table.words` gives them.

        Raises UnreadableError if cells are lists, and so does every property that needs them.
        """
        return [table.words(self.name) for table in self.tables]

    @cached_property
    def counts(self) -> Counter[str]:
        """How often each word comes, in all recordings together; an empty cell is the word ""."""
        return Counter(np.concatenate(self.words).tolist())

    @cached_property
    def odd(self) -> dict[str, int]:
        """How often each word comes that is no number with any decimal mark; "" is such a word."""
        return {word: n for word, n in self.counts.items() if not NUMBER.fullmatch(word)}

    @cached_property
    def runs(self) -> list[list[str]]:
        """The word of each run of successive rows with one word, in each recording."""
        return [[word for word, _ in groupby(words)] for words in self.words]

    @cached_property
    def n_runs(self) -> int:
        """The number of runs of successive rows with one word, in all recordings together."""
        return sum(map(len, self.runs))

    @cached_property
    def fixed(self) -> list[str]:
        """The word of each recording; empty if one has several words or no rows."""
        return [words[0] for words in self.runs] if {*map(len, self.runs)} == {1} else []

    @cached_property
    def numbers(self) -> list[Floats]:
        """The numbers of each recording whose cells in this column are all numbers.

        There is a float64 array for each: (rows,), or (1,) if one cell holds for all rows. `form`
        says how numbers are written; a word that it names as `missing` is NaN. Recordings with
        other cells are left out, and so are those with a number that is infinite or too large for
        float32.
        """
        numbers = list[Floats]()
        for table in self.tables:
            with suppress(DataError):
                numbers.append(table.numbers(self.name, self.form))
        return numbers

    @cached_property
    def steps(self) -> Floats:
        """The differences of successive `numbers` in each recording, float64 of shape (n,).

        Those of the recordings stand one after the other; between recordings there is none.
        """
        return np.concatenate([np.empty(0), *map(np.diff, self.numbers)])

    @cached_property
    def usual_step(self) -> float:
        """The median size of the `steps` that are not 0; 0 if there is none, NaN if one is NaN.

        The sign is ignored, since times fall if the newest row is the first.
        """
        return float(np.median(np.abs(self.steps[self.steps != 0]))) if self.steps.any() else 0.0

    @cached_property
    def unit(self) -> str:
        """The unit that most files state for the column, or else the one in its name, or "".

        It has no brackets. A `.2` (of a name that repeats) or `*` at the end of the name is
        ignored.
        """
        unit = mode(bare(table.units.get(self.name, "")) for table in self.tables)
        return unit or unit_in(re.sub(r"\.\d+$|\*$", "", self.name))

    @cached_property
    def forms(self) -> list[str]:
        """The forms of dates and times, like `%d.%m.%Y`, that fit the cells of the column.

        Only those in `FORMS` are tried; the list is empty if none fits, for example because a cell
        is empty. The first 20 cells and the last cell of each recording are looked at. If an ISO
        date fits, with or without a time of day, it is the only form. A column of datetimes has
        only the form `iso`. Raises UnreadableError if cells are lists.
        """
        if self.tables[0].columns[self.name].dtype.kind == "M":
            return [ISO]
        cells = {word for words in self.words for word in (*words[:MOST_CELLS], *words[-1:])}
        if not all(map(LIKE_A_TIME.match, cells)):
            return []
        table = Table(self.name, {self.name: np.array(sorted(cells), dtype=object)})
        forms = list[str]()
        for form in FORMS:
            with suppress(DataError):
                times_of(table, Clock((self.name,), (form,)), TextForm())
                forms.append(form)
        return forms[:1] if {DAY, ISO} & {*forms} else forms


def most_frequent(items: Sequence[tuple[Any, int]]) -> Any:
    """Return the most frequent value of pairs (value, size); among ties, that of the largest size.

    Raises ValueError if there are no pairs.
    """
    counts = Counter(first for first, _ in items)
    return max(items, key=lambda item: (counts[item[0]], item[1]))[0]


def columns_of(tables: Tables, form: TextForm) -> dict[str, Column]:
    """Return the columns of the first table by their names, each with the tables that have it.

    Columns that only other tables have are left out. `form` says how numbers are written: it is the
    section `[text]` of the description, a file that says how recordings are read.
    """
    return {
        name: Column(name, [table for table in tables if name in table.columns], form)
        for name in tables[0].columns
    }


@dataclass
class Proposal:
    """A description that is put together key by key, and what its keys are inferred from.

    stated : keys that the user gave, with their values. description : the description with all keys
    so far. base : the folder. names : the files of the recordings; empty if a file holds several
    parts. others : the other files in the folder. is_cut : whether only the beginning of some file
    was read. tables : the recordings that are looked at, without rows that are known to be no
    samples. columns : their columns by name. notes : a comment by key.
    """

    stated: Stated
    description: Description
    base: Path = Path()
    names: Strings = ()
    others: Strings = ()
    is_cut: bool = False
    tables: Tables = ()
    columns: Mapping[str, Column] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)

    @cached_property
    def read_listing(self) -> ListingReader:
        """Reads the listing of a name, a file beside the recordings, once (see `listing_table`)."""
        return cache(lambda name: listing_table(self.base / name, self.description.text))

    def put(self, key: str, value: Any, note: str = "") -> None:
        """Set a key like `time.column`, with a note on it; does nothing if the user stated it.

        Of the keys that say where the label stands (like `label.column` and `label.path`), setting
        one clears the others, and likewise for the part number. An earlier note stays if there is
        no new one. Raises DataError for an unknown key or a value of the wrong type
        (`with_values`).
        """
        if key not in self.stated:
            self.description = self.description.with_values({key: value})
            if note:
                self.notes[key] = note

    def set_aside(self, names: Strings) -> None:
        """Move these files from `names`, which hold recordings, to `others`."""
        self.others = [*self.others, *names]
        self.names = [name for name in self.names if name not in names]

    @property
    def unused(self) -> list[Column]:
        """The columns that have no role in the description yet.

        Columns of the clock, part numbers, labels and channels have one, those whose words tell
        which rows are samples (`[rows]`), the column of `order` and the signals of the trigger, the
        condition at which long recordings are cut. Raises SettingError for a malformed trigger.
        """
        about = self.description
        used = {*word_columns(about), *about.time.column, *signals_of(about)}
        for pattern in map(pattern_of, about.channels):
            used.update(filter(pattern.fullmatch, self.columns))
        return [column for name, column in self.columns.items() if name not in used]
