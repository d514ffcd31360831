"""Labels in the names of files and folders, as `part_7_NOK.csv` and `good/7.csv`.

`labels_in_names` returns the source of these labels.
"""

import re
from collections.abc import Collection, Iterator, Sequence
from functools import partial
from pathlib import PurePosixPath
from typing import NamedTuple

from ..errors import DataError, instead
from .dataset import UnknownWordError, UnlabelledError, UnreadableError, expect_data
from .labels import (
    BAD,
    FILE_SUFFIX,
    GOOD,
    NO_WORDS,
    NOT,
    UNCHECKED,
    WORDS,
    LabelMap,
    LabelSource,
    NoLabelError,
    SourcedLabel,
    label_of,
    label_of_match,
    letters,
)

# What a file manager adds to the name of a copy, behind it or before it.
COPY_SUFFIX = re.compile(r"([ _-]+(copy|kopie))?( ?\(\d+\))?$", re.IGNORECASE)
LAST_WORD = re.compile(r"(?:^|[_\- ])([^\d_\- ]\D*)$")  # without a number
LETTER = r"[^\W\d_]"
# Ends of a word in a name: partOK has the word OK, token does not.
WORD_START = rf"(?:(?<!{LETTER})|(?<=[a-z])(?=[A-Z]))"
WORD_END = rf"(?:(?!{LETTER})|(?<=[a-z])(?=[A-Z]))"
# Words before a label that may be a not in another language, or something else.
MAYBE_NOT = re.compile(
    rf"{WORD_START}(?i:ikke|inte|icke|ej|ei|pas|ne|niet|geen|nie|não|nao|keine?|není|neni|bez|sin"
    r"|не|isn'?t|never|almost|ohne|without|sans)[\W_]+$"
)
USER_NOT = r"(?P<not>(?i:not|non|no|nicht|keine?)(?:[\W_]+|(?=[A-Z])))?"
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

    def search(name: str) -> re.Match[str] | None:
        """Search a path, and without a match the path without its suffix."""
        return expression.search(name) or expression.search(FILE_SUFFIX.sub("", name))

    def find(name: str) -> SourcedLabel:
        """Return the label that the pattern finds in a path."""
        match = search(name)
        if match is None or match[1] is None:
            wanted = f"a label where the pattern {pattern} finds it"
            raise UnreadableError(f"Expected {wanted}, found none")
        return SourcedLabel(label_of(match[1], words), "its path", match[1])

    def without_label(name: str) -> str:
        """Return a path without what the pattern finds in it."""
        match = search(name)
        if match is None or match[1] is None:
            return name
        return name[: match.start(1)] + name[match.end(1) :]

    return LabelSource(find, advice, "its path", without_label=without_label)


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
        _FoundLabel(match[0], label_of_match(match), start + match.start(), decides=False)
        for match in IN_NAME.finditer(file)
        if letters(match["word"]) in (*GOOD, *BAD)
    ]
    for i, text in enumerate(_name_beginnings(file)):
        match = AT_END.search(text)
        is_number_sign = i > 0 and match is not None and letters(match[0]) == "no"  # part_no_7
        if match and not is_number_sign:
            label = label_of_match(match)
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
    if match is None or (match.start() and letters(match[0]) not in (*GOOD, *BAD)):
        return []
    return [_FoundLabel(match[0], label_of_match(match), start + match.start())]


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
