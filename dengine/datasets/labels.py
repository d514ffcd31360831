"""Labels of recordings: the words that mean good or bad, columns of them, and sources that agree.

A `LabelSource` finds the label of a recording by its name. `labels_in_column` makes one of a column
of its file, `label_names` one of names, `listings` one of a file that lists recordings.
`collect_recordings` reads recordings with their labels.

Label words, in any case: true ok okay pass passed good success successful gut i.O. io yes 1; false
nok ng fail failed bad failure unsuccessful schlecht n.i.O. nio no 0; and a word of the first kind
after a not, as in `run_7_not_ok.csv`. A file's name ends in the word, except for numbers:
`part_7_NOK_1.csv` is bad. A number alone, 1 or 0, is a label of a name only if the user says so.
A column whose name means the bad outcome, as `failed` or `Ausschuss`, says bad by true, yes or 1.
An empty label, and a word as pending or unknown, is that of a part that was not checked yet.
"""

import itertools
import re
import tomllib
import unicodedata
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import DataError, listed
from . import units
from .cells import fields_beside
from .clocks import EMPTY_CELLS
from .collector import (
    MAX_LABEL_WORDS,
    MEANINGS,
    Reading,
    Recording,
    RecordingCollector,
    label_map_of,
)
from .dataset import (
    Fault,
    LoadOptions,
    UnknownWordError,
    UnlabelledError,
    UnreadableError,
    expect_data,
)
from .recordings import column_place
from .text import read_table

# The words of labels, and the names of their columns.
LISTS = tomllib.loads((files("dengine") / "data" / "label_words.toml").read_text("utf-8"))
GOOD = LISTS["good"]
BAD = LISTS["bad"]
MEANING = {
    **dict.fromkeys((*GOOD, "yes", "io", "1"), True),
    **dict.fromkeys((*BAD, "no", "0"), False),
}
FILE_SUFFIX = re.compile(r"\.[A-Za-z]\w{1,5}$")
UNCHECKED = (*EMPTY_CELLS, *LISTS["unchecked"])
COPY_PREFIX = re.compile(r"^(copy of|kopie von|copie de) ", re.IGNORECASE)
NOT = r"(?P<not>(?i:not|non|no|nicht)[\W_]*)?"
WORDS = "|".join(word for word in MEANING if not word.isdecimal())
# i.O., o.k., and what n makes of them: n.i.O., nio, n-ok.
IN_CELL = re.compile(
    rf"{NOT}(?P<word>(?i:{WORDS}|(?:n[\W_]*)?i[\W_]?o|n[\W_]*o\.?k|o\.k))|(?P<digit>[01])"
)
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
    return label_of_match(match)


def normalized(text: Any) -> str:
    """Return a text whose letters with marks are one character each: macOS writes names in two."""
    return unicodedata.normalize("NFC", str(text))


def letters(text: str) -> str:
    """Return a text in lower case without anything but letters and digits: `n.i.O.` as `nio`."""
    return re.sub(r"[\W_]", "", text).lower()


def label_of_match(match: re.Match[str]) -> int:
    """Return the label, 1 or 0, of a match of `WORD` or `IN_CELL`; a not before it reverses it."""
    groups = match.groupdict()
    word = letters(groups["word"] or groups["digit"])
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


def column_among(header: Sequence[str], names: Sequence[str]) -> int | None:
    """Return where the first of some names stands in a header, in any case; None if none does."""
    lower = [column.lower() for column in header]
    return next((lower.index(name) for name in names if name in lower), None)


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
