"""`Column`: what the cells of one column are, in all recordings that were looked at."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from ..description import TextForm
from ..read.clock import DATES, ISO
from ..table import Table
from ..units import bare

DAY_FORMS = ("%d.%m.%Y", "%Y/%m/%d", "%m/%d/%Y", "%d/%m/%Y", "%d.%m.%y", "%d-%b-%y", "%d-%b-%Y")
TIME_FORMS = ("%H:%M:%S.%f", "%H:%M:%S", "%H:%M:%S:%f", "%I:%M:%S.%f %p", "%I:%M:%S %p")
FORMS = (
    *(
        ISO,
        "%Y-%m-%d",
        *DAY_FORMS,
        *TIME_FORMS,
        "%M:%S.%f",
        "%Y-%m-%d %H:%M:%S.%f UTC",
        "%Y-%m-%d %H:%M:%S.%f",
    ),
    *(f"{day} {time}" for day in DAY_FORMS for time in TIME_FORMS),
)
LIKE_A_TIME = r"^\d+[:\-./T](?:\d+|[A-Za-z]{3})[:\-./T]\d|^\d+:\d+\.\d|^\d{8}T\d{6}"
MOST_WORDS = 12  # that are told apart, as labels
MOST_CELLS = 20  # of a recording whose form of times is looked at
# A number with any decimal mark and any mark of groups.
NUMBER = re.compile(
    r"\s*[-+−]?(?=[.,]?\d)(\d{1,3}([ '’\u202f\xa0.,]\d{3})+|\d*)([.,]\d*)?([eE][-+]?\d+)?\s*"
)
Stated = Mapping[str, Any]
Notes = dict[str, str]
Values = dict[str, Any]
Tables = Sequence[Table]
Floats = NDArray[np.float64]


def counts_of(words: Iterable[str]) -> str:
    """Return how often each word comes, most frequent first."""
    return ", ".join(f"{w or 'empty'}: {n:,}" for w, n in Counter(words).most_common(MOST_WORDS))


@dataclass
class Column:
    """One column in the tables that have it."""

    name: str
    tables: Tables
    form: TextForm

    @cached_property
    def words(self) -> list[NDArray[Any]]:
        """The words of each recording."""
        return [table.words(self.name) for table in self.tables]

    @cached_property
    def counts(self) -> Counter[str]:
        """How often each word comes."""
        return Counter(np.concatenate(self.words).tolist())

    @property
    def title(self) -> str:
        """How often each word comes, most frequent first."""
        return counts_of(self.counts.elements())

    @cached_property
    def odd(self) -> Counter[str]:
        """How often each word comes that is no number."""
        words = self.counts.items()
        return Counter({word: n for word, n in words if not NUMBER.fullmatch(word)})

    @cached_property
    def numbers(self) -> list[Floats]:
        """The numbers of each recording of two samples or more; none if a cell is none."""
        if any(table.columns[self.name].dtype.kind in "SUMb" for table in self.tables):
            return []
        try:
            numbers = [table.numbers(self.name, self.form) for table in self.tables]
        except DataError:
            return []
        return [values for values in numbers if len(values) > 1]

    @cached_property
    def fixed(self) -> list[str]:
        """The word of each recording; none if it changes within one."""
        is_fixed = all(len(words) and (words == words[0]).all() for words in self.words)
        return [str(words[0]) for words in self.words] if is_fixed else []

    @cached_property
    def unit(self) -> str:
        """The unit that most files state for it; "" if none does."""
        units = Counter(bare(table.units.get(self.name, "")) for table in self.tables)
        return units.most_common(1)[0][0]

    @cached_property
    def time_forms(self) -> list[str]:
        """All forms of dates and times that fit its cells."""
        import pandas as pd

        cells = [table.columns[self.name] for table in self.tables]
        if cells[0].dtype.kind == "M":
            return [ISO]
        if cells[0].dtype.kind != "O":
            return []
        samples = [[*column[:MOST_CELLS], *column[-1:]] for column in cells]
        texts = pd.Series([cell for column in samples for cell in column]).astype(str).str.strip()
        if not texts.str.contains(LIKE_A_TIME, regex=True).all():
            return []
        has_comma = texts.str.contains(",").any()
        texts = texts.drop_duplicates().str.replace(",", ".", regex=False)
        forms = [form for form in FORMS[int(has_comma) :] if _fits(texts, form)]
        is_day = "%Y-%m-%d" in forms
        return ["%Y-%m-%d"] if is_day else forms[:1] if ISO in forms else forms

    @property
    def tells_day(self) -> bool:
        """Whether its cells are dates, perhaps with a time of day."""
        return any(form == ISO or DATES.search(form) for form in self.time_forms)

    @property
    def tells_time(self) -> bool:
        """Whether its cells are times of day, perhaps with a date."""
        return any(form == ISO or "%S" in form for form in self.time_forms)


def _fits(texts: Any, form: str) -> bool:
    """Return whether all texts are dates or times of a form."""
    import pandas as pd

    form = "ISO8601" if form == ISO else form
    if pd.isna(pd.to_datetime(texts.iloc[0], format=form, errors="coerce", utc=True)):
        return False
    return not pd.to_datetime(texts, format=form, errors="coerce", utc=True).isna().any()


def columns_of(tables: Tables, form: TextForm) -> dict[str, Column]:
    """Return the columns of the first table, each with the tables that have it."""
    names = tables[0].columns if tables else ()
    return {name: Column(name, [t for t in tables if name in t.columns], form) for name in names}
