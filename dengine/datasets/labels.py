"""What a recording's label is: in its file's name, in a file of labels, or in a table's column.

Words, in any case: true ok okay pass passed good success successful gut i.O. io yes 1; false nok ng fail
failed bad failure unsuccessful schlecht n.i.O. nio no 0; and a word of the first kind after a not, as in
`run_7_not_ok.csv`. A name ends in the word, but for numbers: `part_7_NOK_1.csv` is bad. A number alone, 1
or 0, is a label of a name only where somebody says so.
"""

import os
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from ..errors import DataError, instead
from ..errors import listed as listing
from .clocks import NOTHING
from .dataset import (
    MOST_WORDS,
    Asked,
    Collected,
    Fault,
    Recorded,
    UnknownWordError,
    UnlabelledError,
    UnreadableError,
    must,
)
from .text import SUFFIXES, Timed, place_of, read_table

GOOD = ("true", "okay", "ok", "passed", "pass", "good", "successful", "success", "gut")
BAD = ("false", "nok", "ng", "failed", "failure", "fail", "bad", "unsuccessful", "schlecht", "nio")
MEANING = dict.fromkeys((*GOOD, "yes", "io", "1"), True) | dict.fromkeys((*BAD, "no", "0"), False)
UNCHECKED = (*NOTHING, "-", "--", "?", "unknown", "unlabelled", "unlabeled", "unchecked", "not checked", "pending")
COPY = re.compile(r"([ _-]+(copy|kopie))?( ?\(\d+\))?$", re.IGNORECASE)  # what a file manager adds to a name
LAST = re.compile(r"(?:^|[_\- ])([^\d_\- ]\D*)$")  # words without a number, at the end of a name
LETTER = r"[^\W\d_]"
BEGIN = rf"(?:(?<!{LETTER})|(?<=[a-z])(?=[A-Z]))"  # of a word in a name: partOK has one, token has none
END = rf"(?:(?!{LETTER})|(?<=[a-z])(?=[A-Z]))"
WORD = (
    r"(?P<not>(?i:not|non|no|nicht)[\W_]*)?"
    rf"(?P<word>(?i:{'|'.join(word for word in MEANING if not word.isdecimal())}"
    r"|(?:n[\W_]*)?i[\W_]?o|n[\W_]*o\.?k|o\.k))"  # i.O., n.i.O., n-ok
)
IN_CELL = re.compile(rf"{WORD}|(?P<digit>[01])")
IN_NAME, AT_END = re.compile(f"{BEGIN}{WORD}{END}"), re.compile(f"{BEGIN}{WORD}$")
GERMAN = ("ergebnis", "bewertung", "urteil")
LABEL_COLUMNS = ("y", "label", "labels", "success", "result", "verdict", "class", "status", "ok", "outcome", *GERMAN)
SIGNALS = ("y", "class", "status", "ok")  # of a recording's columns these may be others: a position, a robot's state
FILE_COLUMNS = ("file", "filename", "file_name", "name", "path", "recording", "source", "insertion", "datei", "dateiname")

FEW = 5  # names, among which each word may be a label

Words = Mapping[str, bool]
NONE: Words = {}
Known = tuple[int, str | None]  # a recording's label, and its part's number


class NoLabelError(UnreadableError):
    """A name without a label. words : the last of the file's name, and of each folder from the nearest on; or ""."""

    def __init__(self, words: Sequence[str]) -> None:
        super().__init__("Expected a label at the end of the name, as in 0001_True.csv or 0001_NOK.csv, found none")
        self.words = tuple(words)


class Labels(NamedTuple):
    """Where the labels of recordings come from.

    find : of a recording's name, its path as seen from the folder; UnreadableError where it has none.
    advice : what to do where most have none.  faults : of the file that lists them.
    rest : a name without the label in it, which the recorded order does not depend on.
    """

    find: Callable[[str], Known]
    advice: str
    faults: Sequence[Fault] = ()
    rest: Callable[[str], str] = str


def label_of(word: Any, words: Words = NONE) -> int:
    """1 or 0 for a label; words : of one's own, in lower case, and whether they are good.

    UnknownWordError for what is no label, UnlabelledError for nothing, as the cell of a part that was not checked yet.
    """
    text = str(word).strip().lower()
    if text in words:
        return int(words[text])
    if text in UNCHECKED:
        raise UnlabelledError(f"Expected a label, got {text or 'none'}")
    found = IN_CELL.fullmatch(text.removesuffix(".0").removesuffix("."))
    if found is None:
        raise UnknownWordError(str(word).strip())
    return _meaning(found)


def _bare(text: str) -> str:
    return re.sub(r"[\W_]", "", text).lower()


def _meaning(found: re.Match[str]) -> int:
    said = found.groupdict()
    return int(MEANING[_bare(said["word"] or said["digit"])] != bool(said["not"]))


def meanings(told: Mapping[str, Any] | str | None) -> dict[str, bool]:
    """`"i.O.=good,n.i.O.=bad"`, or a dict of words and labels: each word, in lower case, and whether it is good."""
    # A word may have a comma in it: the next one begins behind a label.
    if not isinstance(told, Mapping):
        pair = re.compile(r"(.*?)=([^=,]*)(?:,|$)")
        must(not pair.sub("", told or ""), "word=good or word=bad, with commas between", told)
        told = dict(pair.findall(told or ""))
    words = {str(word).strip().lower(): str(label).strip().lower() for word, label in told.items()}
    for word, label in words.items():
        must(bool(word) and IN_CELL.fullmatch(label) is not None, "word=good or word=bad, with commas between", told)
    return {word: bool(label_of(label)) for word, label in words.items()}


def named(pattern: str | None = None, words: Words = NONE) -> Labels:
    """A label in the name: at the end of the file's, or as its folder's; or what a pattern's group finds in the path.

    words : as of `label_of`; a number among them is a label of a name that ends in it, or of a folder that is called so.
    DataError for a pattern that is no regular expression with one group.
    """
    advice = "give the pattern of it in the path (label), or list the files and their labels in a CSV file (labels)"
    if pattern is None:
        return Labels(partial(_find, words=words), advice, rest=partial(_rest, words=words))
    with instead(DataError, f"Expected a regular expression for the label, got {pattern!r}", re.error):
        expression = re.compile(pattern)
    must(expression.groups == 1, "one group in the label's pattern, as in '_(OK|NOK)_'", pattern)

    def find(name: str) -> Known:
        match = expression.search(name)
        if match is None or match[1] is None:
            raise UnreadableError(f"Expected a label where the pattern {pattern} finds it, found none")
        return label_of(match[1], words), None

    def rest(name: str) -> str:
        match = expression.search(name)
        return name if match is None or match[1] is None else name[: match.start(1)] + name[match.end(1) :]

    return Labels(find, advice, rest=rest)


def agreed(cells: Iterable[Any], column: str, words: Words = NONE) -> int:
    """The label that all cells of a column say, but for empty ones; errors as of `label_of`, which words are for too."""
    told = list(dict.fromkeys(word for word in map(str, cells) if word.strip().lower() not in UNCHECKED))
    if len(told) < 2:
        return label_of(told[0] if told else "", words)
    with suppress(UnknownWordError):
        meant = {label_of(word, words) for word in told}
        if len(meant) == 1:
            return meant.pop()
    raise UnreadableError(f"Expected one label in column {column}, got {listing(told)}")


def in_column(paths: Mapping[str, Path], column: str, asked: Asked) -> Labels:
    """A label that stands in a column of each recording, in one row or in all. paths : of the recordings, by name."""
    how = asked if asked.columns else None  # else numbers, whose format need not be known

    def find(name: str) -> Known:
        frame = read_table(paths[name], how).frame
        return agreed(frame.iloc[:, place_of(column, list(frame.columns))], column, asked.words), None

    return Labels(find, f"column {column} has none; name another column (label)")


class _FoundLabel(NamedTuple):
    """A word in a path that is a label.

    text : the word.  start : its place in the path.  is_user_word : whether a label map has it.
    decides : False for a word in the middle of a file's name, which cannot give the label but is an error if it
        contradicts one, as in OK_then_NOK.
    """

    text: str
    label: int
    start: int
    decides: bool = True
    is_user_word: bool = False


def _find(name: str, words: Words) -> Known:
    verdicts = _found_labels(name, words)
    deciding = [each for each in verdicts if each.decides]
    if not deciding:
        raise NoLabelError([_last_word(text) for text, _ in _components(name)])
    for other in verdicts:
        if other.label != deciding[0].label:
            said = f"{deciding[0].text} and {other.text} contradict each other in its name or folder"
            raise UnreadableError(f"Expected one label, {said}; say which it is by a pattern with a group for it (label)")
    return deciding[0].label, None


def likely(names: Sequence[str], words: Words = NONE) -> Iterator[tuple[str, str, Labels]]:
    """How labels may be told of names that do not tell them by themselves: what it rests on, the option, and its labels."""
    digits = {"1": True, "0": False}
    told = ",".join(f"{word}={'good' if good else 'bad'}" for word, good in (digits | dict(words)).items())
    yield "if 1 and 0 at its end are labels", f"label_map={told!r}", named(None, digits | dict(words))
    patterns = {"if 1 and 0 are the folders of its labels": "(?:^|/)([01])/"}
    ends = {each.text for name in names for each in _in_file(*_components(name)[0], words) if each.decides}
    if ends:
        found = "|".join(re.sub(r"\W", "[^A-Za-z]", word) for word in sorted(ends, key=len, reverse=True))
        patterns["if the end of the file's name says it"] = f"({found})[^A-Za-z]*[.][^./]*$"
    for why, pattern in patterns.items():
        yield why, f"label='{pattern}'", named(pattern, words)


def _rest(name: str, words: Words) -> str:
    for each in sorted(_found_labels(name, words), key=lambda verdict: -verdict.start):
        name = name[: each.start] + name[each.start + len(each.text) :] if each.decides else name
    return name


def _components(name: str) -> list[tuple[str, int]]:
    """The file's name without suffix, then its folders from the nearest on; each with its place in the path."""
    *folders, file = name.split("/")
    places = [(folder, sum(len(before) + 1 for before in folders[:i])) for i, folder in enumerate(folders)]
    return [(COPY.sub("", PurePosixPath(file).stem), len(name) - len(file)), *reversed(places)]


def _found_labels(name: str, words: Words) -> list[_FoundLabel]:
    """All labels in a path. Where one's own words decide, others that are not at an end do not count."""
    (file, at), *folders = _components(name)
    found = _in_file(file, at, words)
    for folder, place in folders:
        found += _in_folder(folder, place, words)
    return [each for each in found if each.decides] if any(each.is_user_word for each in found) else found


def _in_file(file: str, at: int, words: Words) -> list[_FoundLabel]:
    digit = re.search(r"(?:^|(?<=[_\- ]))\d+$", file)
    numbers = [_FoundLabel(digit[0], int(words[digit[0]]), at + digit.start())] if digit and digit[0] in words else []
    if user_word := _find_user_word(file, at, words):
        return [user_word, *numbers]
    inside = [match for match in IN_NAME.finditer(file) if _bare(match["word"]) in (*GOOD, *BAD)]
    hints = [_FoundLabel(match[0], _meaning(match), at + match.start(), decides=False) for match in inside]
    for numbered, text in enumerate(_endings(file)):
        match = AT_END.search(text)
        if match and not (numbered and _bare(match[0]) == "no"):  # part_no_7
            return [_FoundLabel(match[0], _meaning(match), at + match.start()), *hints, *numbers]
    return [*numbers, *hints]


def _in_folder(folder: str, at: int, words: Words) -> list[_FoundLabel]:
    if folder in words and folder.isdecimal():
        return [_FoundLabel(folder, int(words[folder]), at)]
    if user_word := _find_user_word(folder, at, words):
        return [user_word]
    match = AT_END.search(re.sub(r"[\W_]+$", "", folder))
    if match is None or (match.start() and _bare(match[0]) not in (*GOOD, *BAD)):
        return []
    return [_FoundLabel(match[0], _meaning(match), at + match.start())]


def _find_user_word(text: str, at: int, words: Words) -> _FoundLabel | None:
    """The longest of one's own words that a name ends in."""
    for ending in _endings(text):
        for word in sorted((word for word in words if not word.isdecimal()), key=len, reverse=True):
            bare = re.sub(r"[\W_]+$", "", word)
            if bare and (match := re.search(f"{BEGIN}(?i:{re.escape(bare)})$", ending)):
                return _FoundLabel(match[0], int(words[word]), at + match.start(), is_user_word=True)
    return None


def _endings(text: str) -> Iterator[str]:
    """A name up to where a label may end: whole, and without each word with a number in it that it ends in."""
    text = re.sub(r"[\W_]+$", "", text)
    yield text
    while numbered := re.search(r"[^\W_]*\d[^\W_]*$", text):
        yield text.rstrip("0123456789")
        text = re.sub(r"[\W_]+$", "", text[: numbered.start()])
        yield text


def _last_word(text: str) -> str:
    *_, shortest = _endings(text)
    found = LAST.search(shortest)
    return "" if found is None else found[1]


class _Row(NamedTuple):
    """Of a file of labels. words : of the path that it names, see `_words`."""

    line: int
    words: tuple[str, ...]
    file: str
    label: str
    part: str | None


def listed(path: str | os.PathLike[str], part: str, names: Sequence[str], words: Words = NONE) -> Labels:
    """A labels file: CSV with a column of files and one of labels. DataError where it cannot be read as one.

    A row names a recording by its full path, by the end of it, or by a path with more leading folders. The suffix may
    be left out, and case is ignored.
    part : the column of parts' numbers.  names : of all recordings.  words : as of `label_of`.
    A file without a header, which names a .csv in its first line, has files, labels in this order. A column of files that
    is called otherwise is known by the recordings' names in it.
    """
    source, (rows, faults) = Path(path).name, _rows(path, part, names)
    ends = defaultdict[str, list[_Row]](list)  # by the file's name alone
    for row in rows:
        ends[row.words[0]].append(row)
    alike = {
        name: [row for row in ends[_words(name)[0]] if all(a == b for a, b in zip(row.words, _words(name), strict=False))]
        for name in names
    }
    times = Counter(row for each in alike.values() for row in each)
    lost = [row for row in rows if not times[row]]
    faults += [Fault(source, row.line, f"Expected the name of a recording, found no file {row.file}") for row in lost]

    def find(name: str) -> Known:
        if not alike[name]:
            raise UnreadableError(f"Expected a row of {source} that names it, found none")
        row = max(alike[name], key=lambda row: (row.words == _words(name), len(row.words)))
        if times[row] > 1 and row.words != _words(name):
            raise UnreadableError(f"Expected its folder in {source}, line {row.line}, which names {times[row]} recordings")
        try:
            return label_of(row.label, words), row.part
        except UnknownWordError as error:
            error.args = (f"{error} in {source}, line {row.line}",)
            raise

    few = ", ".join(row.file for row in rows[:3]) or "no files"
    return Labels(find, f"{source} names {few}: call its columns file and label, and the files as they are", faults)


def in_order(path: str | os.PathLike[str], part: str) -> list[str]:
    """The words of a file of labels, of an array's traces in turn; DataError where its rows are numbered otherwise."""
    rows, faults = _rows(path, part)
    numbers = [int(row.file) for row in rows if row.file.isdecimal()]
    if faults or (numbers and numbers != list(range(numbers[0], numbers[0] + len(rows)))):
        got = faults[0] if faults else numbers[:9]
        raise DataError(f"Expected a label of each trace in {path}, in their order, got {got}.")
    return [row.label for row in rows]


def _rows(path: str | os.PathLike[str], part: str, names: Sequence[str] = ()) -> tuple[list[_Row], list[Fault]]:
    try:
        table, faults, *_ = read_table(Path(path))
    except (OSError, UnreadableError) as error:
        raise DataError(f"Cannot read the labels in {path}: {error}.") from error
    header, cells = list(table.columns), dict(zip(table.index, table.to_numpy().tolist(), strict=True))
    if header[0].lower().endswith(SUFFIXES):
        header, cells = ["file", "label", *header[2:]], {1: header, **cells}
    ends = {_words(name)[0] for name in names}
    named = [i for i in range(len(header)) if any(_words(row[i])[0] in ends for row in cells.values())]
    of_file, of_label = _columns(header, path, named)
    if part != "part" and part not in header:
        raise DataError(f"Expected a column {part} of parts' numbers in {path}, got {', '.join(header)}.")
    rows: dict[tuple[str, ...], _Row] = {}
    for line, said in cells.items():
        number = said[header.index(part)] if part in header else ""
        row = _Row(line, _words(said[of_file]), said[of_file], said[of_label], number or None)
        if rows.setdefault(row.words, row) is not row:
            faults.append(Fault(Path(path).name, line, f"Expected each file once, {row.file} came before"))
    return list(rows.values()), faults


def _words(path: str) -> tuple[str, ...]:
    """A path's file and folders, from its end, in lower case, without suffix, as Windows or another system writes it."""
    words = [word for word in path.lower().replace("\\", "/").split("/") if word not in ("", ".")] or [""]
    file = words.pop()
    return next((file.removesuffix(end) for end in SUFFIXES if file.endswith(end)), file), *reversed(words)


def column_among(header: Sequence[str], known: Sequence[str]) -> int | None:
    """Where the first of some known names stands in a header, in any case; None where none does."""
    lower = [name.lower() for name in header]
    return next((lower.index(name) for name in known if name in lower), None)


def _columns(header: Sequence[str], path: str | os.PathLike[str], named: Sequence[int]) -> tuple[int, int]:
    """Where files and labels are; of two columns the first and the second, or the other.  named : those with recordings."""
    of_file, of_label = column_among(header, FILE_COLUMNS), column_among(header, LABEL_COLUMNS)
    of_file = named[0] if of_file is None and len(named) == 1 else of_file
    if len(header) == 2:
        of_file = of_file if of_file is not None else 0 if of_label is None else 1 - of_label
        of_label = 1 - of_file
    if of_file is None or of_label is None:
        wanted = FILE_COLUMNS[0] if of_file is None else "label"
        raise DataError(f"Expected a column {wanted} in {path}, got {', '.join(header)}; call it so.")
    return of_file, of_label


def collect(places: Mapping[str, Any], read: Callable[[Any], Timed], labels: Labels, found: Collected) -> Collected:
    """Add recordings by name, with their labels. read : what is at a place: (C, T), and a rate where it has timestamps.

    DataError where most have no label, which a name's words do not tell either.
    """
    unlabelled = dict[str, Sequence[str]]()
    found.faults.extend(labels.faults)

    def recorded(name: str, place: Any) -> Recorded:
        try:
            label, part = labels.find(name)
        except (UnknownWordError, UnlabelledError):
            raise
        except UnreadableError as error:
            unlabelled[name] = getattr(error, "words", ())
            raise
        timed = read(place)
        return Recorded(timed.trace, label, name, part, timed.rate_hz, timed.units)

    for name, place in places.items():
        found.take(name, partial(recorded, name, place))
    words = _likely_label_words(unlabelled.values(), [each.source for each in found.read])
    found.unknown.update(words)
    if len(unlabelled) - len(words) > len(places) / 2:
        why = next(fault for fault in reversed(found.faults) if fault.source in unlabelled)
        none = f"{len(unlabelled)} of {len(places)} have none, as {why}"
        raise DataError(f"Expected a label for each recording, {none}; {labels.advice}.")
    return found


def _likely_label_words(unlabelled: Collection[Sequence[str]], labelled: Sequence[str]) -> list[str]:
    """The words of names without a label, or of their folders, that tell them apart from each other or from labelled ones.

    unlabelled : of each name the words that may be its label.  labelled : the other names, which have none of these words.
    """
    known = {word for name in labelled for word in re.findall(r"[^\W\d_]+", name.lower())}
    likely = []
    for depth in range(max(map(len, unlabelled), default=0)):
        words = [each[depth] for each in unlabelled if depth < len(each) and each[depth]]
        often = Counter(word.lower() for word in words)
        # A word that is there once among many is that of another file.
        several = sum(n > 1 or len(words) < FEW for n in often.values()) > 1
        if (labelled or several) and 0 < len(often) <= MOST_WORDS and known.isdisjoint(often):
            likely.append(words)
    return min(likely, key=lambda words: len(set(words)), default=[])
