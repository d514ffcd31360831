"""Where the label of a recording is: in its file's name, a file of labels, or a column of a table.

A `LabelSource` finds the label of a recording by its name; `labels_in_names`, `labels_in_file` and
`labels_in_column` make one, and `collect_recordings` reads recordings with their labels.

Label words, in any case: true ok okay pass passed good success successful gut i.O. io yes 1; false
nok ng fail failed bad failure unsuccessful schlecht n.i.O. nio no 0; and a word of the first kind
after a not, as in `run_7_not_ok.csv`. A file's name ends in the word, except for numbers:
`part_7_NOK_1.csv` is bad. A number alone, 1 or 0, is a label of a name only if the user says so.
A column whose name means the bad outcome, as `failed` or `Ausschuss`, says bad by true, yes or 1.
An empty label, and a word as pending or unknown, is that of a part that was not checked yet.
"""

import itertools
import os
import re
import tomllib
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.resources import files
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import DataError, instead, listed
from . import units
from .cells import fields_beside
from .clocks import EMPTY_CELLS
from .containers import PACKED
from .dataset import (
    MAX_LABEL_WORDS,
    MEANINGS,
    Fault,
    LoadOptions,
    Reading,
    Recording,
    RecordingCollector,
    UnknownWordError,
    UnlabelledError,
    UnreadableError,
    expect_data,
    label_map_of,
)
from .recordings import column_place
from .text import SUFFIXES, read_table

if TYPE_CHECKING:
    import pandas as pd

# The words of labels, and the names of their columns.
LISTS = tomllib.loads((files("dengine") / "data" / "label_words.toml").read_text("utf-8"))
GOOD = LISTS["good"]
BAD = LISTS["bad"]
MEANING = {
    **dict.fromkeys((*GOOD, "yes", "io", "1"), True),
    **dict.fromkeys((*BAD, "no", "0"), False),
}
UNCHECKED = (*EMPTY_CELLS, *LISTS["unchecked"])
# What a file manager adds to the name of a copy, behind it or before it.
COPY_SUFFIX = re.compile(r"([ _-]+(copy|kopie))?( ?\(\d+\))?$", re.IGNORECASE)
COPY_PREFIX = re.compile(r"^(copy of|kopie von|copie de) ", re.IGNORECASE)
LEADING_ZEROS = re.compile(r"(?<=_)0+(?=\d)")
FILE_SUFFIX = re.compile(r"\.[A-Za-z]\w{1,5}$")
AGAIN = re.compile(r"(.*\w)(?:[._-]\d| ?\(\d+\))((?:\.[^\W\d]\w*)?)")  # SN12.1, SN12 (2).csv
# A long number as a spreadsheet saves it, without its last digits: 2,40311E+11.
SHORTENED = re.compile(r"\d([.,]\d{0,8})?[eE]\+(09|[1-9]\d)")
LAST_WORD = re.compile(r"(?:^|[_\- ])([^\d_\- ]\D*)$")  # without a number
LETTER = r"[^\W\d_]"
# Ends of a word in a name: partOK has the word OK, token does not.
WORD_START = rf"(?:(?<!{LETTER})|(?<=[a-z])(?=[A-Z]))"
WORD_END = rf"(?:(?!{LETTER})|(?<=[a-z])(?=[A-Z]))"
NOT = r"(?P<not>(?i:not|non|no|nicht)[\W_]*)?"
# Words before a label that may be a not in another language, or something else.
MAYBE_NOT = re.compile(
    rf"{WORD_START}(?i:ikke|inte|icke|ej|ei|pas|ne|niet|geen|nie|não|nao|keine?|není|neni|bez|sin"
    r"|не|isn'?t|never|almost|ohne|without|sans)[\W_]+$"
)
USER_NOT = r"(?P<not>(?i:not|non|no|nicht|keine?)(?:[\W_]+|(?=[A-Z])))?"
WORDS = "|".join(word for word in MEANING if not word.isdecimal())
# i.O., o.k., and what n makes of them: n.i.O., nio, n-ok.
IN_CELL = re.compile(
    rf"{NOT}(?P<word>(?i:{WORDS}|(?:n[\W_]*)?i[\W_]?o|n[\W_]*o\.?k|o\.k))|(?P<digit>[01])"
)
# In a name N may be newtons or a lane, as in 50N_OK and mN.ok: apart from the word it is a not only
# in n.ok, n.i.O. and n_i_O, and not after a letter, nor as a capital after a digit.
APART = rf"(?<!{LETTER})(?:(?-i:n)|(?<!\d)n)"
NOT_IO = rf"{APART}(?P<mark>[._-])i(?P=mark)o|(?<!{LETTER})(?-i:n)[\W_]*i[\W_]?o|nio"
NOT_OK = rf"{APART}\.[\W_]*o\.?k|no\.?k"
WORD = rf"{NOT}(?P<word>(?i:{WORDS}|{NOT_IO}|i[\W_]?o|{NOT_OK}|o\.k))"
IN_NAME = re.compile(f"{WORD_START}{WORD}{WORD_END}")
AT_END = re.compile(f"{WORD_START}{WORD}$")
UNCHECKED_WORDS = "|".join(
    word.replace(" ", r"[\W_]*") for word in UNCHECKED if re.search(LETTER, word)
)
UNCHECKED_AT_END = re.compile(rf"{WORD_START}(?i:{UNCHECKED_WORDS})$")
LABEL_COLUMNS = LISTS["label_columns"]
BAD_COLUMNS = LISTS["bad_columns"]
GOOD_COLUMNS = (*LABEL_COLUMNS, *GOOD, *LISTS["good_columns"])
FLAGS = {**dict.fromkeys(LISTS["yes"], True), **dict.fromkeys(LISTS["no"], False)}
# In the columns of a recording these may be something else: a position, a robot's state.
SIGNAL_COLUMNS = ("y", "class", "status", "ok")
FEW_NAMES = 5  # in fewer names each word may be a label

# A word, and whether it is good; None: it is that of a part that was not checked yet.
LabelMap = Mapping[str, bool | None]
NO_WORDS: LabelMap = {}


class SeveralLabelsError(UnreadableError):
    """A recording whose labels contradict each other, in one place or in two.

    words : the words of the one place in their order; empty for two places.
    """

    def __init__(self, message: str, words: Sequence[str] = ()) -> None:
        super().__init__(message)
        self.words = tuple(words)


class NoLabelError(UnreadableError):
    """A name without a label.

    words : the last word of the file's name, and of each folder from the nearest on; "" for none.
    """

    def __init__(self, words: Sequence[str]) -> None:
        form = "a label at the end of the name, as in 0001_True.csv or 0001_NOK.csv"
        super().__init__(f"Expected {form}, found none")
        self.words = tuple(words)


class NoColumnError(UnreadableError):
    """A file without the column that tells the labels of others."""


class SourcedLabel(NamedTuple):
    """The label of a recording, and where it stands.

    label : int
        1 for success, 0 for failure.
    place : str
        What the place is called: "its name", "column verdict".
    word : str
        What says so there.
    part : str or None
        Number of the part, if it stands there too.
    column : str
        The column, if `place` does not name it.
    """

    label: int
    place: str
    word: str
    part: str | None = None
    column: str = ""

    @property
    def text(self) -> str:
        """What says so, for an error: "its name says good (OK)"."""
        return f"{self.place} says {MEANINGS[self.label]} ({self.word})"

    @property
    def reading(self) -> Reading:
        """The place, without the line in it, and the word."""
        place = self.place.partition(", line")[0].removeprefix("its ")
        column = f", column {self.column}" if self.column else ""
        return Reading("file name" if place == "name" else f"{place}{column}", self.word)


@dataclass(frozen=True)
class LabelSource:
    """Where the labels of recordings come from.

    find : callable
        Returns the label of a recording by its name, the path seen from the folder. Raises
        UnreadableError if it has none.
    advice : str
        What to do if most recordings have no label.
    place : str
        What the source is called in errors and notes.
    faults : sequence of Fault
        What is wrong in the file of labels.
    notes : Counter
        What users should know, and how many times; `find` adds to it.
    trust : str
        What to do if another source contradicts a file of labels.
    without_label : callable
        Returns a name without the label in it, by which recordings are put in order.
    """

    find: Callable[[str], SourcedLabel]
    advice: str
    place: str
    faults: Sequence[Fault] = ()
    without_label: Callable[[str], str] = str
    notes: Counter[str] = field(default_factory=Counter)
    trust: str = ""


def label_of(word: Any, words: LabelMap = NO_WORDS) -> int:
    """Return the label that a word means: 1 for success, 0 for failure.

    Parameters
    ----------
    word : object
        Text in upper or lower case, a number or a boolean: OK, n.i.O., not ok, 1.0.
    words : mapping of str to bool or None
        The user's own words in lower case, and whether they are good; they go first. "" is that of
        an empty cell. None is that of a part that was not checked yet.

    Raises
    ------
    UnknownWordError
        If the meaning of the word is unknown.
    UnlabelledError
        If it is empty or in `UNCHECKED`, or the user says so, as of a part that was not checked.
    """
    text = normalized(word).strip().lower()
    key = "" if text in EMPTY_CELLS and text not in words else text
    if key in words:
        meaning = words[key]
        if meaning is None:
            raise UnlabelledError(text)
        return int(meaning)
    if text in UNCHECKED:
        raise UnlabelledError("" if text in EMPTY_CELLS else text)
    match = IN_CELL.fullmatch(text.removesuffix(".0").removesuffix("."))
    if match is None:
        raise UnknownWordError(str(word).strip())
    return _label_of_match(match)


def normalized(text: Any) -> str:
    """Return a text whose letters with marks are one character each: macOS writes names in two."""
    return unicodedata.normalize("NFC", str(text))


def _letters(text: str) -> str:
    """Return a text in lower case without anything but letters and digits: `n.i.O.` as `nio`."""
    return re.sub(r"[\W_]", "", text).lower()


def _label_of_match(match: re.Match[str]) -> int:
    """Return the label, 1 or 0, of a match of `WORD` or `IN_CELL`; a not before it reverses it."""
    groups = match.groupdict()
    word = _letters(groups["word"] or groups["digit"])
    return int(MEANING[word] != bool(groups["not"]))


def parse_label_map(label_map: Mapping[str, Any] | str | None) -> dict[str, bool | None]:
    """Parse the user's own label words: "i.O.=good,n.i.O.=bad", or a dict of words and labels.

    In "0=" the word is that of a part that was not checked yet; in "=good" it is an empty cell.
    Returns each word in lower case, and whether it is good, or None; an empty dict for None. Raises
    DataError for another form.
    """
    wanted = "word=good or word=bad, or word= for a part not checked yet, with commas between"
    if isinstance(label_map, Mapping):
        pairs = dict(label_map)
    else:
        # A word may have a comma in it: the next one begins behind a label.
        pair = re.compile(r"(.*?)=([^=,]*)(?:,|$)")
        expect_data(not pair.sub("", label_map or ""), wanted, label_map)
        pairs = dict(pair.findall(label_map or ""))
    words = {
        normalized(word).strip().lower(): "" if label is None else str(label).strip().lower()
        for word, label in pairs.items()
        if word or label
    }
    for word, label in words.items():
        is_form = IN_CELL.fullmatch(label) is not None or (bool(word) and not label)
        expect_data(is_form, wanted, label_map)
    return {word: bool(label_of(label)) if label else None for word, label in words.items()}


def labels_in_names(pattern: str | None = None, words: LabelMap = NO_WORDS) -> LabelSource:
    """Return a source of labels in the paths of files.

    Parameters
    ----------
    pattern : str, optional
        Regular expression whose one group finds the label in the path. None: the label is at the
        end of the file's name, or of a folder's.
    words : mapping of str to bool
        The user's own words in lower case, and whether they are good. A number among them is a
        label of a name that ends in it, and of a folder that has it as name.

    Raises
    ------
    DataError
        For a pattern that is no regular expression with one group.
    """
    where = "give the pattern of it in the path (label)"
    advice = f"{where}, or list the files and their labels in a CSV file (labels)"
    if pattern is None:
        verdicts = {word: good for word, good in words.items() if good is not None}
        unchecked = words.keys() - verdicts.keys()
        find_label = partial(_find_label, words=verdicts, unchecked=unchecked)
        remove_label = partial(_remove_label, words=verdicts)
        return LabelSource(find_label, advice, "its name", without_label=remove_label)
    message = f"Expected a regular expression for the label, got {pattern!r}"
    with instead(DataError, message, re.error):
        expression = re.compile(pattern)
    wanted = "one group in the label's pattern, as in '_(OK|NOK)_'"
    expect_data(expression.groups == 1, wanted, pattern)

    def find(name: str) -> SourcedLabel:
        """Return the label that the pattern finds in a path."""
        match = expression.search(name)
        if match is None or match[1] is None:
            wanted = f"a label where the pattern {pattern} finds it"
            raise UnreadableError(f"Expected {wanted}, found none")
        return SourcedLabel(label_of(match[1], words), "its path", match[1])

    def without_label(name: str) -> str:
        """Return a path without what the pattern finds in it."""
        match = expression.search(name)
        if match is None or match[1] is None:
            return name
        return name[: match.start(1)] + name[match.end(1) :]

    return LabelSource(find, advice, "its path", without_label=without_label)


def means_bad(column: str) -> bool:
    """Return whether the name of a column means the bad outcome: `failed`, `is_defect`, `n.i.O.`.

    False for the opposite of it, as `not_failed` and `error_free`.
    """
    words = _name_words(column)
    if "".join(words) in BAD_COLUMNS:
        return True
    others = {*LISTS["negations"], *GOOD}  # pass_fail says it of both
    return bool(words) and words[-1] in BAD_COLUMNS and others.isdisjoint(words)


def means_good(column: str) -> bool:
    """Return whether true in a column of this name means good: `passed`, `is_ok`, `not_failed`.

    So it does in a column with the usual name of a label, as `result` or `y`. False for the bad
    outcome, and where the meaning is not known, as of `crack` or `pass_fail`.
    """
    if means_bad(column):
        return False
    words = _name_words(column)
    is_negated = not set(LISTS["negations"]).isdisjoint(words)
    names = {*words[-1:], "".join(words), column.lower()}
    others = BAD_COLUMNS if is_negated else GOOD_COLUMNS
    return not names.isdisjoint(others) or (is_negated and not set(words).isdisjoint(BAD_COLUMNS))


def _name_words(column: str) -> list[str]:
    """Return the words of a column's name in lower case, without such as `flag` at its end."""
    words = units.words_in(column)
    while len(words) > 1 and words[-1] in LISTS["flag_endings"]:
        words.pop()
    return words


def is_verdict(column: str, cells: Sequence[Any], words: LabelMap) -> bool:
    """Return whether cells of a column are all one verdict, as OK or n.i.O.; unchecked ones do not
    count, but are no verdict alone.

    A number, yes or true is one only in a column whose name means the bad outcome, or is `ok`.
    """
    with suppress(UnreadableError):
        LabelColumn(column, words, Counter()).find(cells)
        has_flags = any(_flag_of(cell) is not None for cell in cells)
        return not has_flags or means_bad(column) or column.lower() == "ok"
    return False


def _flag_of(cell: Any) -> bool | None:
    """Return whether a cell is true, yes or 1, or false, no or 0; None for anything else."""
    return FLAGS.get(str(cell).strip().lower().removesuffix(".0").removesuffix("."))


def _is_set_at_end(cells: Sequence[Any]) -> bool:
    """Return whether cells are first false, no or 0, and then true, yes or 1 up to the last."""
    flags = [_flag_of(cell) for cell in cells]
    return set(flags) == {False, True} and flags == sorted(flags, key=bool)


class LabelColumn:
    """Reads the labels in the cells of a column.

    If the name of the column means the bad outcome, true, yes and 1 in it are bad, and a note says
    so. If it means neither outcome, they are words of unknown meaning. Words that are verdicts
    themselves, as OK and NOK, keep their meaning, and so do all if the user states the meaning of
    one of true, yes, 1 and so on.

    Parameters
    ----------
    name : str
    words : mapping of str to bool
        As in `label_of`.
    notes : Counter
        What users should know; it is added to.
    """

    def __init__(self, name: str, words: LabelMap, notes: Counter[str]) -> None:
        self.name = name
        self.words = words
        self.notes = notes
        self.is_inverted = means_bad(name) and FLAGS.keys().isdisjoint(words)
        self.is_ambiguous = not (means_bad(name) or means_good(name))
        stated_unchecked = {word for word, good in words.items() if good is None}
        self.unchecked = (set(UNCHECKED) - set(words)) | stated_unchecked

    def label_of(self, cell: Any) -> int:
        """Return the label that a cell means, 1 or 0.

        Raises UnlabelledError for an empty or unchecked cell, UnknownWordError for another word.

        If the column's name means the bad outcome, true, yes and 1 give 0 and false, no and 0 give
        1, and a note is made, unless the user's words have one of these. If the name means neither
        outcome, they raise UnknownWordError, unless the cell is one of the user's words.
        """
        text = str(cell).strip().lower()
        flag = _flag_of(cell)
        if flag is not None and text not in self.words and self.is_ambiguous:
            forms = f"of known meaning, which the name of column {self.name} does not tell"
            raise UnknownWordError(str(cell).strip(), forms)
        if flag is None or text in self.words or not self.is_inverted:
            return label_of(cell, self.words)
        note = f"Column {self.name} tells what is bad, by its name: true, yes or 1 in it is bad"
        self.notes[note] = 1
        return int(not flag)

    def has_labels(self, cells: Iterable[Any]) -> bool:
        """Return whether cells hold nothing but labels and words of parts that were not checked.

        Empty cells are such words, too. False if no cell is a label.
        """
        labels = set[int]()
        with suppress(UnknownWordError):
            for cell in cells:
                with suppress(UnlabelledError):
                    labels.add(self.label_of(cell))
            return bool(labels)
        return False

    def find(self, cells: Iterable[Any], place: str = "") -> SourcedLabel:
        """Return the label that all cells mean; those of a part that is not checked do not count.

        Of true and false, or 1 and 0, the last cell counts if none is false behind a true one, as
        in the bit of a controller that is set at the end of a cycle; a note says so.

        Raises UnlabelledError if the part is not checked, UnknownWordError for a single word of
        unknown meaning, and SeveralLabelsError if labels differ or one of several words is unknown.
        `place` is what the column is called in errors, by default column NAME.
        """
        do = "; keep the line that holds" if place else ""
        place = place or f"column {self.name}"
        cells = list(cells)
        is_known = not (self.is_ambiguous or FLAGS.keys() & self.words)
        if is_known and _is_set_at_end(cells):
            text = "is true or 1 in the last rows alone of some: these count"
            self.notes[f"Column {self.name} {text}"] = 1
            cells = cells[-1:]
        texts = list(dict.fromkeys(str(cell).strip() for cell in cells))
        stated = [text for text in texts if text and text.lower() not in self.unchecked]
        if len(stated) < 2:
            word = next(filter(None, stated or texts), "")
            return SourcedLabel(self.label_of(word), place, word or "empty")
        with suppress(UnknownWordError):
            labels = {self.label_of(text) for text in stated}
            if len(labels) == 1:
                return SourcedLabel(labels.pop(), place, listed(stated))
        message = f"Expected one label in {place}, got {listed(stated)}{do}"
        raise SeveralLabelsError(message, tuple(stated))


def read_cells(path: Path, column: str, options: LoadOptions) -> list[str]:
    """Read a file and return the cells of one of its columns as texts.

    Without such a column it is the value of a line outside the table, as `Result;OK`, or in a
    small file beside it. Raises UnreadableError if the file or the column cannot be read.
    """
    # Without stated columns the label needs no number format.
    table = read_table(path, options, as_text=not options.columns)
    frame = table.frame
    if column not in frame:
        fields = {**table.fields, **fields_beside(path)}
        if column in fields:
            return [fields[column]]
        if not units.find_columns(column, list(frame.columns)):
            actual = listed([*frame.columns, *fields])
            raise NoColumnError(f"Expected a column {column}, got {actual}", table.line)
    return list(map(str, frame.iloc[:, column_place(column, list(frame.columns))]))


def labels_in_column(paths: Mapping[str, Path], column: str, options: LoadOptions) -> LabelSource:
    """Return a source of labels in a column of each recording's file; empty cells do not count.

    If the label changes once from the first row to the last, the last one counts, and a note of the
    source says so: controllers show the result of the last part until the next one is checked. More
    changes are a SeveralLabelsError. A file is read when its label is asked for.

    paths : the files of the recordings, by name.
    """
    notes = Counter[str]()
    label_column = LabelColumn(column, options.words, notes)
    place = f"its column {column}"

    def find(name: str) -> SourcedLabel:
        """Return the label that all cells of a recording's column mean, or the last one."""
        cells = read_cells(paths[name], column, options)
        try:
            return label_column.find(cells, place)
        except SeveralLabelsError as error:
            words = [cell.strip() for cell in cells if cell.strip() in error.words]
            if len(error.words) > 2 or len(list(itertools.groupby(words))) > 2:
                raise
            label = label_column.find(words[-1:], place)
            notes[f"Column {column} changes once in a recording: there its last value counts"] += 1
            return label

    advice = f"column {column} has none; name another column (label)"
    return LabelSource(find, advice, place, notes=notes)


def labels_that_agree(
    first: LabelSource, others: Sequence[LabelSource], do: str, *, fills_in: bool = False
) -> LabelSource:
    """Return a source of the labels of `first`, which other sources must not contradict.

    Its `find` raises SeveralLabelsError, which names both places, if labels contradict each other,
    UnknownWordError for a word of unknown meaning in any source, and without a label the error of
    the first source, or with `fills_in` of the last.

    Parameters
    ----------
    first : LabelSource
    others : sequence of LabelSource
    do : str
        What to do about a contradiction, for the error.
    fills_in : bool, default False
        Whether the others tell the labels that the first source does not.
    """
    notes = Counter[str]()

    def find(name: str) -> SourcedLabel:
        """Return the label of a recording, compared with all sources."""
        finders = {source.place: partial(source.find, name) for source in (first, *others)}
        try:
            return agreed_label(finders, do, notes, fills_in=fills_in)
        finally:
            for source in (first, *others):
                notes.update(source.notes - notes)

    return replace(first, find=find, notes=notes)


def agreed_label(
    finders: Mapping[str, Callable[[], SourcedLabel]],
    do: str,
    notes: Counter[str],
    *,
    fills_in: bool = False,
) -> SourcedLabel:
    """Return the label of the first place that has one, after comparing it with all later places.

    A later place that cannot be read, or that is a name without a label, is ignored.

    Parameters
    ----------
    finders : mapping of str to callable
        Returns the label, by the place where it stands. Errors are those of `LabelSource.find`.
    do : str
        What to do about a contradiction, for the error.
    notes : Counter
        If a label is returned, counts each place before its own, which has none, and each later one
        that is empty or unchecked.
    fills_in : bool, default False
        Whether a later place may give the label if the first has none.

    Raises
    ------
    SeveralLabelsError
        If labels contradict each other.
    UnknownWordError
        If a place has a word of unknown meaning, which may contradict the others.
    UnreadableError, OSError
        The error of a place before any label that cannot be read; of the first place, if it has no
        label; or with `fills_in` of the last one, if no place has a label.
    """
    label: SourcedLabel | None = None
    label_place = ""
    places_without = list[str]()
    last_error = UnreadableError("Expected a label, found none")
    for place, find in finders.items():
        try:
            other = _find_beside(label, find, place, do)
        except (NoLabelError, NoColumnError, UnlabelledError) as error:
            if label is None and not fills_in:
                raise
            has_column = not isinstance(error, NoColumnError)
            if has_column and (label is None or isinstance(error, UnlabelledError)):
                places_without.append(place)
            last_error = error
            continue
        if label is None:
            label = other
            label_place = place
        if label.label != other.label:
            raise SeveralLabelsError(f"Expected one label, {label.text}, {other.text}; {do}")
    if label is None:
        raise last_error
    for place in places_without:
        text = f"{place[0].upper()}{place[1:]} tells no label: that of {label_place} is taken"
        notes[text] += 1
    return label


def _find_beside(
    label: SourcedLabel | None, find: Callable[[], SourcedLabel], place: str, do: str
) -> SourcedLabel:
    """Return the label that one place tells, by its `find`.

    `label` is the one of an earlier place, or None; it is returned if this place cannot be read.
    The errors for no label, an unchecked part, an unknown word and several labels are raised in any
    case, the last two with advice.
    """
    try:
        return find()
    except (NoLabelError, NoColumnError, UnlabelledError):
        raise
    except UnknownWordError as error:
        if label is not None:
            error.args = (f"{error} in {place}, where {label.text}; say what it means, or {do}",)
        raise
    except SeveralLabelsError as error:
        if label is not None:
            error.args = (f"{error}, where {label.text}; {do}",)
        raise
    except (UnreadableError, OSError):
        if label is None:
            raise
        return label


class _FoundLabel(NamedTuple):
    """A word in a path that is a label.

    text : str
        The word.
    label : int
    start : int
        Its position in the path.
    decides : bool
        False for a word in the middle of a file's name. It cannot give the label, but is an error
        if it contradicts one, as in OK_then_NOK.
    is_user_word : bool
        Whether it is in the user's label map.
    """

    text: str
    label: int
    start: int
    decides: bool = True
    is_user_word: bool = False


def _find_label(name: str, words: LabelMap, unchecked: Collection[str] = ()) -> SourcedLabel:
    """Return the label in a path.

    Raises NoLabelError if there is none, UnlabelledError if there is only a word of `UNCHECKED` or
    of `unchecked`, the user's, UnknownWordError if a word before it may be a not, as in ikke_ok,
    and UnreadableError if several labels contradict each other.
    """
    labels = _found_labels(name, words)
    deciding = [label for label in labels if label.decides]
    if not deciding:
        unchecked_words = dict.fromkeys(unchecked, False)
        for label in _found_labels(name, unchecked_words) if unchecked else ():
            if label.is_user_word or label.text in unchecked:
                raise UnlabelledError(label.text.lower())
        beginnings = (start for text, _ in _components(name) for start in _name_beginnings(text))
        for match in filter(None, map(UNCHECKED_AT_END.search, beginnings)):
            raise UnlabelledError(match[0].lower())
        raise NoLabelError([_last_word(text) for text, _ in _components(name)])
    first = deciding[0]
    if maybe_not := MAYBE_NOT.search(name[name.rfind("/", 0, first.start) + 1 : first.start]):
        raise UnknownWordError(f"{maybe_not[0]}{first.text}")
    for other in labels:
        if other.label != first.label:
            actual = f"{first.text} and {other.text} contradict each other in its name or folder"
            do = "say which it is by a pattern with a group for it (label)"
            raise UnreadableError(f"Expected one label, {actual}; {do}")
    place = "its folder" if first.start <= name.rfind("/") else "its name"
    return SourcedLabel(first.label, place, first.text)


def suggest_label_sources(
    names: Sequence[str], words: LabelMap = NO_WORDS
) -> Iterator[tuple[str, str, LabelSource]]:
    """Yield ways to find labels in names that do not state them in the usual way.

    Each is the condition under which it is right, the option to give, and the source, by which the
    caller tries whether it finds labels.
    """
    with_digits = {"1": True, "0": False} | dict(words)
    pairs = ["1=good"] * ("1" not in words) + ["0=bad"] * ("0" not in words)
    source = labels_in_names(None, with_digits)
    yield "if 1 and 0 at its end are labels", f"label_map={','.join(pairs)!r}", source
    patterns = {"if 1 and 0 are the folders of its labels": "(?:^|/)([01])/"}
    in_files = (label for name in names for label in _labels_in_file(*_components(name)[0], words))
    endings = {label.text for label in in_files if label.decides}
    if endings:
        longest_first = sorted(endings, key=len, reverse=True)
        choice = "|".join(re.sub(r"\W", "[^A-Za-z]", word) for word in longest_first)
        condition = "if the end of the file's name says it"
        patterns[condition] = f"({choice})[^A-Za-z]*[.][^./]*$"
    for condition, pattern in patterns.items():
        yield condition, f"label='{pattern}'", labels_in_names(pattern, words)


def _remove_label(name: str, words: LabelMap) -> str:
    """Return a path without the words that decide its label."""
    for label in sorted(_found_labels(name, words), key=lambda label: -label.start):
        if label.decides:
            name = name[: label.start] + name[label.start + len(label.text) :]
    return name


def _components(name: str) -> list[tuple[str, int]]:
    """Return the parts of a path with their positions in it.

    The file's name comes first, without suffix and without what a file manager adds to a copy, then
    the folders from the nearest on.
    """
    *folders, file = name.split("/")
    starts = [sum(len(folder) + 1 for folder in folders[:i]) for i in range(len(folders))]
    file_stem = COPY_SUFFIX.sub("", PurePosixPath(file).stem)
    nearest_first = reversed(list(zip(folders, starts, strict=True)))
    return [(file_stem, len(name) - len(file)), *nearest_first]


def _found_labels(name: str, words: LabelMap) -> list[_FoundLabel]:
    """Return all labels in a path, of the file first.

    If one is a word of the user, words in the middle of a name do not count.
    """
    (file, start), *folders = _components(name)
    labels = _labels_in_file(file, start, words)
    for folder, folder_start in folders:
        labels += _labels_in_folder(folder, folder_start, words)
    if any(label.is_user_word for label in labels):
        labels = [label for label in labels if label.decides]
    return labels


def _labels_in_file(file: str, start: int, words: LabelMap) -> list[_FoundLabel]:
    """Return the labels in a file's name without suffix, which begins at `start` of the path.

    The user's word or else the usual one at its end decides, and so does a number there that is in
    `words`, the user's label map. Without a user's word those in its middle are listed too, but
    only to find contradictions. The list is empty without a label.
    """
    digit = re.search(r"(?:^|(?<=[_\- ]))\d+$", file)
    numbers = []
    if digit and digit[0] in words:
        label = int(bool(words[digit[0]]))
        numbers.append(_FoundLabel(digit[0], label, start + digit.start()))
    if user_word := _find_user_word(file, start, words):
        return [user_word, *numbers]
    inner = [
        _FoundLabel(match[0], _label_of_match(match), start + match.start(), decides=False)
        for match in IN_NAME.finditer(file)
        if _letters(match["word"]) in (*GOOD, *BAD)
    ]
    for i, text in enumerate(_name_beginnings(file)):
        match = AT_END.search(text)
        is_number_sign = i > 0 and match is not None and _letters(match[0]) == "no"  # part_no_7
        if match and not is_number_sign:
            label = _label_of_match(match)
            return [_FoundLabel(match[0], label, start + match.start()), *inner, *numbers]
    return [*numbers, *inner]


def _labels_in_folder(folder: str, start: int, words: LabelMap) -> list[_FoundLabel]:
    """Return the label at the end of a folder's name in a list, which is empty without one.

    The name begins at `start` of the path.
    """
    if folder in words and folder.isdecimal():
        return [_FoundLabel(folder, int(bool(words[folder])), start)]
    if user_word := _find_user_word(folder, start, words):
        return [user_word]
    match = AT_END.search(re.sub(r"[\W_]+$", "", folder))
    if match is None or (match.start() and _letters(match[0]) not in (*GOOD, *BAD)):
        return []
    return [_FoundLabel(match[0], _label_of_match(match), start + match.start())]


def _find_user_word(text: str, start: int, words: LabelMap) -> _FoundLabel | None:
    """Return the longest word of the user's label map in which a name ends, if there is one.

    Any blanks and marks stand for those in the word. A not before the word reverses its meaning.

    start : position of the name in the path.
    """
    longest_first = sorted((word for word in words if not word.isdecimal()), key=len, reverse=True)
    for beginning in _name_beginnings(text):
        for word in longest_first:
            bare = re.sub(r"[\W_]+$", "", word)
            pattern = r"[\W_]*".join(map(re.escape, re.split(r"[\W_]+", bare)))
            match = re.search(f"{WORD_START}{USER_NOT}(?i:{pattern})$", beginning)
            if bare and match:
                label = int(words[word] != bool(match["not"]))
                return _FoundLabel(match[0], label, start + match.start(), is_user_word=True)
    return None


def _name_beginnings(text: str) -> Iterator[str]:
    """Yield the beginnings of a name at whose end a label may stand.

    First the whole name, then the name without its last word as long as that has a number in it:
    `part_NOK_7`, `part_NOK_`, `part_NOK`.
    """
    text = re.sub(r"[\W_]+$", "", text)
    yield text
    while numbered := re.search(r"[^\W_]*\d[^\W_]*$", text):
        yield text.rstrip("0123456789")
        text = re.sub(r"[\W_]+$", "", text[: numbered.start()])
        yield text


def _last_word(text: str) -> str:
    """Return the last word of a name without numbers, "" if there is none."""
    *_, shortest = _name_beginnings(text)
    match = LAST_WORD.search(shortest)
    return "" if match is None else match[1]


class _LabelRow(NamedTuple):
    """The rows of a file of labels that name one recording.

    lines, labels : their lines, and the label in each.
    words : those of the path in `file`, see `_path_words`.
    part : number of the part, if there is a column of them.
    """

    lines: tuple[int, ...]
    words: tuple[str, ...]
    file: str
    labels: tuple[str, ...]
    part: str | None

    def place_in(self, source: str) -> str:
        """Return where the rows are in a file of this name, for an error."""
        return f"{source}, line{'s' if len(self.lines) > 1 else ''} {listed(self.lines)}"


def labels_in_file(
    path: str | os.PathLike[str],
    names: Sequence[str],
    options: LoadOptions,
    frame: "pd.DataFrame | None" = None,
) -> LabelSource:
    """Return a source of labels in a CSV file with a column of files and one of labels.

    A row names a recording by its full path, by the end of it, or by a path with more leading
    folders. The suffix may be left out, and case is ignored. A file without a header, whose first
    line names a .csv, has files and labels in this order. A column of files that has another name
    is found by the names of recordings in it. A recording may have several rows of one label;
    of rows with different paths that match it, only the one with its full path counts, or else the
    longest path. A row that matches several recordings labels only one whose full path it gives;
    for the others `find` raises UnreadableError.

    Parameters
    ----------
    path : path
    names : sequence of str
        Names of all recordings. A row of the file that names none of them is a fault of the source.
    options : LoadOptions
        `label` and `part` are columns of the file. If `label` is None, the columns whose names are
        those of labels (`LABEL_COLUMNS`) must not contradict each other.
    frame : DataFrame, optional
        The rows of the file, by their lines, if it was read before.

    Raises
    ------
    DataError
        If the file cannot be read as one of labels.
    """
    source = Path(path).name
    rows, faults, column, header = _read_label_rows(path, options, names, frame)
    notes = Counter[str]()
    if any(len(row.lines) > 1 for row in rows):
        notes[f"{source} names recordings more than once: their labels must be equal"] = 1
    label_column = LabelColumn(column, options.words, notes)
    name_words = {name: _path_words(name) for name in names}
    matches = _matching_rows(rows, name_words)
    n_names = Counter(row for matching in matches.values() for row in matching)
    times_of = _measured_again(matches)
    for row in rows:
        if not n_names[row]:
            why = ", a number that a spreadsheet has shortened" * bool(
                SHORTENED.fullmatch(row.file)
            )
            message = f"Expected the name of a recording, found no file {row.file}{why}"
            faults.append(Fault(source, row.lines[0], message))

    def find(name: str) -> SourcedLabel:
        """Return the label and the part in the row that names a recording most exactly."""
        if name in times_of:
            wanted = f"a row of {source} for each of {listed(times_of[name])}"
            raise UnreadableError(f"Expected {wanted}, found one: it may be that of any of them")
        if not matches[name]:
            raise UnreadableError(f"Expected a row of {source} that names it, found none")
        path_words = name_words[name]
        row = max(matches[name], key=lambda row: (row.words == path_words, len(row.words)))
        where = row.place_in(source)
        if n_names[row] > 1 and row.words != path_words:
            message = f"Expected its folder in {where}, which names {n_names[row]} recordings"
            raise UnreadableError(message)
        return _label_of_row(row, label_column, where)

    notes.update(_leading_zeros_note(source, [row for row in rows if n_names[row]]))
    files = ", ".join(row.file for row in rows[:3]) or "no files"
    has_files = column_among(header, LISTS["file_columns"]) is not None
    do = "" if has_files else "call its columns file and label, and "
    do = f"{do}write the files as they are, as {listed(names[:1])}"
    advice = f"{source} names {files}: {do}"
    listing = LabelSource(
        find, advice, source, faults, notes=notes, trust=listing_to_trust(source, column)
    )
    if options.label is not None:
        return listing
    others = [
        replace(
            labels_in_file(path, names, replace(options, label=name), frame),
            place=f"column {name}",
        )
        for name in header
        if name != column and name.lower() in LABEL_COLUMNS
    ]
    return labels_that_agree(listing, others, listing.trust)


def _matching_rows(
    rows: Iterable[_LabelRow], name_words: Mapping[str, tuple[str, ...]]
) -> dict[str, list[_LabelRow]]:
    """Return the rows of a listing whose path agrees with each recording's, as far as both go, from
    the file on.
    """
    rows_by_file = defaultdict[str, list[_LabelRow]](list)
    for row in rows:
        rows_by_file[row.words[0]].append(row)

    def is_end(row: _LabelRow, path_words: tuple[str, ...]) -> bool:
        return all(a == b for a, b in zip(row.words, path_words, strict=False))

    return {
        name: [row for row in rows_by_file[path_words[0]] if is_end(row, path_words)]
        for name, path_words in name_words.items()
    }


def _measured_again(matches: Mapping[str, Sequence[_LabelRow]]) -> dict[str, list[str]]:
    """Return the recordings whose row in a listing may be that of another one, each with these.

    They are those of one name, with and without a number behind it, as SN12 and SN12.1, of which
    only the first has a row.

    matches : the rows that match each recording.
    """
    times_of = defaultdict[str, list[str]](list)
    for name, rows in matches.items():
        again = AGAIN.fullmatch(name)
        if again and not rows and matches.get(first := again[1] + again[2]):
            times_of[first] = times_of[first] or [first]
            times_of[first].append(name)
            times_of[name] = times_of[first]
    return dict(times_of)


def _leading_zeros_note(source: str, rows: Sequence[_LabelRow]) -> dict[str, int]:
    """Return a note, and how many times, on the rows of a file that leave leading zeros out.

    It is empty without such rows.
    """
    without = [
        row
        for row in rows
        if row.file.isdecimal() and row.file not in re.split(r"[\W_]+", row.words[0])
    ]
    if not without:
        return {}
    first = without[0]
    return {f"{source} names {first.file}, read as {first.words[0]}, without zeros": len(without)}


def _label_of_row(row: _LabelRow, column: LabelColumn, where: str) -> SourcedLabel:
    """Return the label that a row's words mean together, with the number of its part.

    Raises UnknownWordError, which says where it stands, for a word of unknown meaning, else
    UnlabelledError if no word is a label yet, or SeveralLabelsError if labels differ.
    """
    try:
        for word in row.labels:
            with suppress(UnlabelledError):
                column.label_of(word)
    except UnknownWordError as error:
        error.args = (f"{error} in {where}",)
        raise
    return column.find(row.labels, where)._replace(part=row.part, column=column.name)


def listing_to_trust(file: str, column: str) -> str:
    """Return what to do, for an error, if another source contradicts a file of labels."""
    return f"name the column to trust, label={column!r} of {file}, or leave it out (labels)"


def read_ordered_labels(
    path: str | os.PathLike[str], options: LoadOptions, keys: Mapping[str, Sequence[str]]
) -> tuple[list[str], str]:
    """Return the label words of a file that lists the traces of an array, in the traces' order.

    Its rows are numbered in that order, or name traces by one of the `keys`; those that it does not
    name get an empty word, unless the keys are numbers from 0 or 1. The name of the column of
    labels comes second. Raises DataError if the file cannot be read, or its rows are in
    an order that is not known.

    keys : texts of each trace, as serial numbers, by the names of their arrays.
    """
    rows, faults, column, _ = _read_label_rows(path, options)
    label_of_key = {row.file: row.labels[0] for row in rows if len(row.lines) == 1}
    for texts in keys.values():
        if len(texts) == len(rows) and set(texts) == set(label_of_key):
            return [label_of_key[text] for text in texts], column
        if label_of_key and set(label_of_key) < set(texts) and not {"0", "1"} & set(texts):
            return [label_of_key.get(text, "") for text in texts], column
    numbers = [int((re.findall(r"\d+", row.words[0]) or [-1])[-1]) for row in rows]
    in_order = numbers == list(range(numbers[0], numbers[0] + len(rows))) if numbers else False
    in_order = in_order and len(label_of_key) == len(rows)
    if faults or not in_order:
        texts = [row.file for row in rows[:9]]
        actual = faults[0] if faults else f"[{listed(texts)}]"
        wanted = f"a label of each trace in {path}, numbered in their order"
        do = f" or by an array of them ({listed(keys)})" if keys else ""
        raise DataError(f"Expected {wanted}{do}, got {actual}.")
    return [row.labels[0] for row in rows], column


def _read_label_rows(
    path: str | os.PathLike[str],
    options: LoadOptions,
    names: Sequence[str] = (),
    frame: "pd.DataFrame | None" = None,
) -> tuple[list[_LabelRow], list[Fault], str, list[str]]:
    """Return the rows of a file of labels, file by file, and the faults of its other lines.

    The name of the column of labels and those of all columns come last. `options` name the columns
    of labels and parts; `names`, those of recordings, help to find the column of files. Raises
    DataError if the file cannot be read, or a column cannot be found.
    """
    try:
        table = read_table(Path(path), replace(options, columns=()), as_text=True)
    except (OSError, UnreadableError) as error:
        raise DataError(f"Cannot read the labels in {path}: {error}.") from error
    frame = table.frame if frame is None else frame
    header = list(frame.columns)
    rows_by_line = zip(frame.index, frame.to_numpy().tolist(), strict=True)
    cells = {line: row for line, row in rows_by_line if any(row)}
    files = {_path_words(name)[0] for name in names}
    # No header, but the first row.
    if header[0].lower().endswith(SUFFIXES) or _path_words(header[0])[0] in files:
        cells = {1: header, **cells}
        header = ["file", "label", *header[2:]]
    columns = [list(dict.fromkeys(column)) for column in zip(*cells.values(), strict=True)]
    n_names = [sum(_path_words(cell)[0] in files for cell in column) for column in columns]
    with_names = {i: n for i, n in enumerate(n_names) if n}
    full_names = {
        i: _names_with(column, names) or _names_in_folders(column, names)
        for i, column in enumerate(columns)
        if not with_names
    }
    n_named = max(map(len, full_names.values()), default=0)
    place, texts, names_of_texts = _names_in_two_columns(
        cells, names if full_names else (), more_than=n_named
    )
    if texts:
        full_names = {place: names_of_texts}
        n_named = len(names_of_texts)
    with_names = with_names or {i: n_named for i, x in full_names.items() if len(x) == n_named > 0}
    if names and not with_names:
        _check_not_shortened(dict(zip(header, columns, strict=False)), path)
    with_labels = [
        i
        for i, column in enumerate(columns)
        if LabelColumn(header[i], options.words, Counter()).has_labels(column)
    ]
    most = min(MAX_LABEL_WORDS, len(cells) / 2)
    with_words = {i: column for i, column in enumerate(columns) if 2 <= len(column) <= most}
    of_file, of_label = _label_file_columns(
        header, path, with_names, with_labels, with_words, options, names
    )
    part = options.part
    if part != "part" and part not in header:
        wanted = f"a column {part} of parts' numbers in {path}"
        raise DataError(f"Expected {wanted}, got {', '.join(header)}.")
    rows: dict[tuple[str, ...], _LabelRow] = {}
    for line, values in cells.items():
        number = values[header.index(part)] if part in header else ""
        file = texts.get(line, values[of_file])
        words = _path_words(full_names.get(of_file, {}).get(file, file))
        row = rows.get(words, _LabelRow((), words, file, (), number or None))
        lines = (*row.lines, line)
        rows[words] = row._replace(lines=lines, labels=(*row.labels, values[of_label]))
    return list(rows.values()), table.faults, header[of_label], header


def _check_not_shortened(
    columns: Mapping[str, Sequence[str]], path: str | os.PathLike[str]
) -> None:
    """Raise DataError if a column of a file holds nothing but long numbers in short, 2,40311E+11.

    columns : the texts of each; none of them names a recording.
    """
    for name, column in columns.items():
        texts = list(filter(None, column))
        if texts and all(map(SHORTENED.fullmatch, texts)):
            actual = f"got {listed(texts[:3])}: a spreadsheet has shortened its numbers"
            do = "they name no recording; export the list anew, with this column as text"
            raise DataError(f"Expected whole numbers in column {name} of {path}, {actual}, {do}.")


def _path_words(path: str) -> tuple[str, ...]:
    """Return a path's file, then its folders from the nearest on, in lower case.

    Of suffixes only those of text files (`SUFFIXES`) and .npz are removed, so `part_3.7` stays.
    Backslashes of Windows are read as slashes; empty words and "." are left out.
    """
    words = normalized(path).lower().replace("\\", "/").split("/")
    words = [word for word in words if word not in ("", ".")] or [""]
    file = words.pop().removesuffix(PACKED)
    suffix = next((suffix for suffix in (*SUFFIXES, ".npz") if file.endswith(suffix)), "")
    return file.removesuffix(suffix), *reversed(words)


def _names_in_two_columns(
    cells: Mapping[int, Sequence[str]], names: Sequence[str], *, more_than: int
) -> tuple[int, dict[int, str], dict[str, str]]:
    """Find two columns of a listing that name files together, as serial number and run.

    The texts of the first column repeat, and more than half of them stand in names of files. It is
    joined with each other column, as `4700_1`; the two by which `_names_with` finds most files are
    taken. Returns the position of the first column, the joined text of each line, and the file of
    each such text; (0, {}, {}) if no two columns name more than `more_than` files.

    cells : the cells of each row, by its line. names : the files.
    """
    best: tuple[int, dict[int, str], dict[str, str]] = (0, {}, {})
    columns = list(zip(*cells.values(), strict=True))
    words_of_names = [_words_between(PurePosixPath(name).name) for name in names]
    for i, column in enumerate(columns):
        texts = set(column) - {""}
        n_in_names = sum(any(_words_between(t) in w for w in words_of_names) for t in texts)
        if len(texts) == len(column) or 2 * n_in_names <= len(texts):
            continue
        for j in range(len(columns)):
            pairs = {line: f"{row[i]}_{row[j]}" for line, row in cells.items()}
            name_of = _names_with(list(dict.fromkeys(pairs.values())), names) if j != i else {}
            if len(name_of) > max(more_than, len(best[2])):
                best = (i, pairs, name_of)
    return best


def _words_between(text: str) -> str:
    """Return the words of a text in lower case, between underscores: `_sn_4700_` for `SN-4700`.

    It is `_` for a text without words.
    """
    return re.sub(r"[\W_]+", "_", f"_{normalized(text).lower()}_")


def _names_with(texts: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Return for texts, for example serial numbers, the one file in whose name each stands.

    It must stand there as one or more whole words, in upper or lower case; folders do not count.
    If it stands in none, but in one without leading zeros, which Excel removes, it is this one. A
    text that stands in no name, or in several, is left out. The result is empty if the texts stand
    in no more than half as many files as there are texts.
    """
    name_of = {}
    words_of_name = {name: _words_between(PurePosixPath(name).name) for name in names}
    bare_words = {name: LEADING_ZEROS.sub("", words) for name, words in words_of_name.items()}
    for text in texts:
        wanted = _words_between(text)
        if wanted == "_":  # it has no words
            continue
        matches = [name for name, words in words_of_name.items() if wanted in words]
        if not matches and FILE_SUFFIX.search(text):  # of another file, as a bag
            wanted = _words_between(FILE_SUFFIX.sub("", text.replace("\\", "/").rpartition("/")[2]))
            matches = [name for name, words in words_of_name.items() if wanted in words]
        bare = [] if matches else [n for n, w in bare_words.items() if wanted in w]
        if len(bare) == 1:
            matches = bare
        if len(matches) == 1:
            name_of[text] = matches[0]
    return name_of if 2 * len(set(name_of.values())) > len(texts) else {}


def _names_in_folders(texts: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Return for texts that name a folder, by the end of its path, the one recording inside it.

    The result is empty if a text names folders of several, or most name none.
    """
    inside = defaultdict[tuple[str, ...], list[str]](list)
    for name in names:
        for folder in PurePosixPath(name).parents:
            inside[_path_words(str(folder))].append(name)
    name_of = dict[str, str]()
    for text in filter(None, texts):
        wanted = _path_words(text)
        matches = [
            name
            for words, held in inside.items()
            if words != ("",) and all(a == b for a, b in zip(wanted, words, strict=False))
            for name in held
        ]
        if len(matches) > 1:
            return {}
        for name in matches:
            name_of[text] = name
    return name_of if 2 * len(name_of) > len(texts) else {}


def column_among(header: Sequence[str], names: Sequence[str]) -> int | None:
    """Return where the first of some names stands in a header, in any case; None if none does."""
    lower = [column.lower() for column in header]
    return next((lower.index(name) for name in names if name in lower), None)


def _label_file_columns(
    header: Sequence[str],
    path: str | os.PathLike[str],
    with_names: Mapping[int, int],
    with_labels: Sequence[int],
    with_words: Mapping[int, Sequence[str]],
    options: LoadOptions,
    names: Sequence[str],
) -> tuple[int, int]:
    """Return the positions of the column of files and of the column of labels.

    They are found by their names; the first else by `_columns_of_files`. Of two columns, the one
    that is not of files has the labels; if both have other names, files come first. Of more
    columns, the only one whose name means the bad outcome has the labels, else the only one of
    `with_labels`, or of `with_words`. Raises DataError if one is not found.

    with_names : how many recordings are named in each column in which some are.
    with_labels : the columns of labels alone.
    with_words : the words of those that have few, whose meaning may be asked for.
    options : `label` and `part` are the columns of labels and of parts, if the user stated them.
    names : of the recordings, for the error.
    """
    column = options.label
    of_label = column_among(header, LABEL_COLUMNS if column is None else (column.lower(),))
    if column is not None and of_label is None:
        wanted = f"a column {column} of labels in {path}"
        raise DataError(f"Expected {wanted}, got {', '.join(header)}; leave it out (label).")
    of_files = _columns_of_files(header, with_names, with_labels, options.part)
    of_file = of_files[0] if len(of_files) == 1 else None
    if len(header) == 2:
        if of_file is None:
            of_file = 0 if of_label is None else 1 - of_label
        of_label = 1 - of_file
    bad_columns = [i for i, column in enumerate(header) if i != of_file and means_bad(column)]
    for likely in (bad_columns, with_labels, with_words):
        others = [i for i in likely if i != of_file]
        if of_label is None and len(others) == 1:
            of_label = others[0]
    if of_file is not None and of_label is not None:
        return of_file, of_label
    hints = []
    if of_file is None:
        choice = " or ".join(f"part={header[i]!r}" for i in of_files)
        in_file = f"write their names into a column file, as {listed(names[:2])}"
        hints.append(f"name that of recordings, {choice}" if of_files else in_file)
    if of_label is None:
        labels_in = {header[i]: words for i, words in with_words.items() if i not in of_files}
        do = f", {propose_columns(labels_in)}" if labels_in else " (label)"
        hints.append(f"name that of labels{do}")
    wanted = f"a column that names recordings and one of labels in {path}"
    raise DataError(f"Expected {wanted}, got {', '.join(header)}; {', and '.join(hints)}.")


def _columns_of_files(
    header: Sequence[str], with_names: Mapping[int, int], with_labels: Sequence[int], part: str
) -> list[int]:
    """Return the positions of the columns that may name recordings: one, or several alike, or none.

    It is the one called so, if recordings are named in it or in no column; else that in which most
    are named. If these are several, or none, it is the column of parts.

    with_names, with_labels : as in `_label_file_columns`.
    """
    # A column `insertion` of success and failure has labels.
    of_labels_alone = {*with_labels} - {*with_names}
    candidates = ["" if i in of_labels_alone else name for i, name in enumerate(header)]
    of_file = column_among(candidates, LISTS["file_columns"])
    if of_file is not None and (of_file in with_names or not with_names):
        return [of_file]
    most = [i for i, n in with_names.items() if n == max(with_names.values())]
    return [header.index(part)] if len(most) != 1 and part in header else most


def columns_with_labels(
    cells: Mapping[str, Iterable[Any]], words: LabelMap = NO_WORDS
) -> list[str]:
    """Return the columns in which a cell is a label, or all if none has one.

    cells : the words of each column, by its name.
    """

    def is_label(column: LabelColumn, cell: Any) -> bool:
        """Return whether a cell is the label of a part that was checked."""
        with suppress(UnlabelledError, UnknownWordError):
            return column.label_of(cell) in (0, 1)
        return False

    all_columns = {name: LabelColumn(name, words, Counter()) for name in cells}
    known = [
        name
        for name, column in all_columns.items()
        if any(is_label(column, cell) for cell in cells[name])
    ]
    return known or list(cells)


def propose_columns(cells: Mapping[str, Iterable[Any]], words: LabelMap = NO_WORDS) -> str:
    """Return the options, for an error, that name a column of labels: `label='Decision'`.

    Of several that may be it, each has its first words behind it.

    cells : as in `columns_with_labels`.
    """
    names = columns_with_labels(cells, words)
    if len(names) == 1:
        return f"label={names[0]!r}"
    firsts = {name: listed(itertools.islice(cells[name], 3)) for name in names}
    return " or ".join(f"label={name!r} ({first})" for name, first in firsts.items())


def collect_recordings(
    places: Mapping[str, Any],
    read: Callable[[Any], Recording],
    source: LabelSource,
    collector: RecordingCollector,
) -> RecordingCollector:
    """Read recordings with their labels into a collector, and return it.

    Parameters
    ----------
    places : mapping of str to object
        Where each recording is, by its name.
    read : callable
        Reads the trace at a place.
    source : LabelSource
    collector : RecordingCollector
        Gets the recordings, the faults of those that cannot be read, the notes of the source, and
        words in names that may be labels of unknown meaning.

    Raises
    ------
    DataError
        If most recordings have no label, and the words of their names are no likely ones.
    """
    unlabelled = dict[str, Sequence[str]]()
    changing = list[Sequence[str]]()  # words of the places whose label changes
    n_contradictions = 0
    collector.faults.extend(source.faults)

    def read_labelled(name: str, place: Any) -> Recording:
        """Return a recording with its label; note its name if it has none."""
        nonlocal n_contradictions
        try:
            label = source.find(name)
        except (UnknownWordError, UnlabelledError):
            raise
        except UnreadableError as error:
            unlabelled[name] = getattr(error, "words", ())
            if isinstance(error, SeveralLabelsError):
                n_contradictions += 1
                changing.append(error.words)
                unlabelled[name] = ()
            raise
        recording = read(place)
        reading = recording.reading._replace(place=label.reading.place, word=label.word)
        part = label.part or recording.part
        return recording._replace(label=label.label, source=name, part=part, reading=reading)

    for name, place in places.items():
        collector.add(name, partial(read_labelled, name, place))
    collector.notes.update(source.notes)
    labelled = [recording.source for recording in collector.recordings]
    words = _likely_label_words(unlabelled.values(), labelled)
    collector.unknown_words.update(words)
    if len(unlabelled) - len(words) > len(places) / 2:
        why = next(fault for fault in reversed(collector.faults) if fault.source in unlabelled)
        actual = f"{len(unlabelled)} of {len(places)} have none, as {why}; {source.advice}"
        if n_contradictions > len(unlabelled) / 2:
            actual = f"{n_contradictions} of {len(places)} have labels that differ, as {why}"
            actual += _changing_label_advice(changing)
        raise DataError(f"Expected a label for each recording, {actual}.")
    return collector


def _changing_label_advice(changing: Sequence[Sequence[str]]) -> str:
    """Return advice, for an error, if all labels that change do so from one word to another.

    The word before is then that of a part that is not checked yet. "" if they change otherwise.

    changing : the words of each recording, in their order.
    """
    firsts = {words[0] for words in changing if words}
    lasts = Counter(words[-1] for words in changing if words)
    if len(firsts) != 1 or firsts & set(lasts) or any(len(words) != 2 for words in changing):
        return ""
    first = firsts.pop()
    unknown = Counter[str]()
    for word, n in lasts.items():
        if _flag_of(word) is not None or IN_CELL.fullmatch(word.lower()) is None:
            unknown[word] = n
    pairs = [label_map_of(unknown)] if unknown else []
    label_map = ",".join([*pairs, f"{first}="])
    or_else = ", or with good and bad the other way round" if unknown else ""
    return f"; if {first} means that it is not checked yet, label_map={label_map!r}{or_else}"


def _likely_label_words(
    unlabelled: Collection[Sequence[str]], labelled: Sequence[str]
) -> list[str]:
    """Return words that may be labels, one for each name that has it.

    They tell the names without a label apart from each other, or from those with one. The list is
    empty if there are no such words.

    unlabelled : for each name without a label the last word of its file and of its folders.
    labelled : the names with a label, which have none of these words.
    """
    others = {word for name in labelled for word in re.findall(r"[^\W\d_]+", name.lower())}
    likely = []
    for depth in range(max(map(len, unlabelled), default=0)):
        words = [name[depth] for name in unlabelled if depth < len(name) and name[depth]]
        counts = Counter(word.lower() for word in words)
        # A word that occurs once among many is that of another file.
        n_repeated = sum(n > 1 or len(words) < FEW_NAMES for n in counts.values())
        is_few = 0 < len(counts) <= MAX_LABEL_WORDS
        if (labelled or n_repeated > 1) and is_few and others.isdisjoint(counts):
            likely.append(words)
    return min(likely, key=lambda words: len(set(words)), default=[])
