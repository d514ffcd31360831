"""Every place that may hold the labels, counted, and whether those places agree.

A word means good or bad only if it is one of a short list of plain verdicts, and stands by itself:
at the end or beginning of a file's name, as a folder, or in a column or line whose whole name says
that it holds a verdict. Any other place with few words is a candidate, if nothing is certain.
"""

import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import permutations

import numpy as np

from ...errors import DataError, listed
from ..dataset import Faults
from ..description import (
    SOURCES,
    UNKNOWN,
    Description,
    LabelSource,
    PartSource,
    Strings,
    as_option,
)
from ..read.files import caught
from ..read.places import part_of, read_labels, without_suffix
from ..table import Table, UnreadableError
from .columns import MOST_WORDS, Proposal, Tables, counts_of

GOOD = (
    "ok", "pass", "passed", "good", "success", "gut", "i.o.", "i.o", "i_o", "io",
    "accepted", "合格",
)  # fmt: skip
BAD = (
    "nok", "not ok", "not_ok", "not-ok", "fail", "failed", "bad", "failure", "schlecht",
    "n.i.o.", "n.i.o", "n_i_o", "n-io", "n_io", "n io", "n.io", "nio", "ng",
    "reject", "rejected", "不合格",
)  # fmt: skip
UNCHECKED = ("", "-", "--", "pending", "open", "offen", "unchecked", "not checked", "n/a")
YES = ("1", "true", "yes", "ja")
NO = ("0", "false", "no", "nein")
VERDICT = (
    r"(r[eé]sult(s|at)?|verdict|ergebnis|bewertung|outcome|判定|label|success|n?i?ok|nio"
    r"|pass(ed)?|class|target|y|urteil|accept(ed)?|judg?e?ment)"
)
WHOLE = "(total|overall|final|part|teil|gesamt)"
VERDICT_NAME = re.compile(rf"(?i)(({WHOLE}|test|{VERDICT})[-_ ./]?)?{VERDICT}([-_ .]?{WHOLE})?")
GOOD_NAME = re.compile(r"(?i)(.*[./])?(success|ok|io|pass(ed)?|accept(ed)?|good)")
IN_PATHS = (*GOOD, *BAD, "true", "false", "pending", "offen", "unchecked")
WORD = "|".join(sorted(map(re.escape, IN_PATHS), key=len, reverse=True))
NEGATED = re.compile(  # or of a name that may be bad, as in `leak=False`
    rf"(?i)(not.(?!ok)|(?<![a-z])(nicht|non|kein|pas|hors)([-_ .][^-_ ./]+)?[-_ .]|nicht."
    rf"|(?-i:[-_ .]n)[-_ .](?!i))({WORD})"
    r"|[a-z][-_ .=(/]+(true|false)(?![a-z])"
)
ALONE = re.compile(rf"(?i)(?<![^-_ ./(=+\[\d#（])({WORD})(?![^-_ ./)\]）])")  # begins as in PATHS
PATHS = (  # of verdicts in folders, and at the end or beginning of names
    rf"(?:^|/)({WORD})/",
    rf"[-_ =]({WORD})/",
    rf"(?:^|[-_ ./(=+\[\d#（])({WORD})[-_ \d()\]）]*$",
    rf"(?:^|/)({WORD})(?=[-_ ][^/]*$)",
)
# Of any words: folders, their beginnings, and the words of a file's name, counted from the end.
PLACES = (
    "([^/]+)/[^/]*$",
    "([^/]+)/[^/]*/[^/]*$",
    "([^/]+)/[^/]*/[^/]*/[^/]*$",
    "(?:^|/)([^-_ /]+)[-_ ][^/]*/[^/]*$",
    "([^-_ /]+)$",
    "([^-_ /]+)[-_ ][^-_ /]*$",
    "([^-_ /]+)[-_ ][^-_ /]*[-_ ][^-_ /]*$",
    "([^-_ /]+)(?:[-_ ][^-_ /]*){3}$",
    "(?:^|/)([^-_ /]+)[^/]*$",
)
# What ends the beginning of a line: a mark, two blanks, or the blank before a date.
NAME_END = re.compile(r"[;:：=\t,]|  |(?<=[^\W\d]) (?=\d+[-./]\d+[-./]\d)")
Names = Iterable[str]
CHANCE = 0.05  # that two words go with the labels like this
Words = Mapping[str, str]  # by recording
Counted = Mapping[LabelSource, Words]


def with_meanings(source: LabelSource, words: Names) -> LabelSource:
    """Return a source of labels in which `words` are sorted into `good`, `bad` and `unchecked`.

    A list that the source has already stays; the others get the words of known meaning, like "ok",
    in any case of letters. Then `good` or `bad` becomes `?` if it would be empty: that all files
    say `OK` proves nothing. True, yes and 1 mean good, and their opposites bad, if the name of the
    column, line or topic (a named series of messages in a ROS bag) is one for good, like `success`,
    or in a path whose expression lists its words, like `(False|True)`; elsewhere they have no known
    meaning.
    """
    name = source.column or source.line or source.topic
    groups: Sequence[Sequence[str]] = (GOOD, BAD, UNCHECKED)
    if lists_words(source) or GOOD_NAME.fullmatch(name):
        groups = ((*GOOD, *YES), (*BAD, *NO), UNCHECKED)
    free = sorted({*words}.difference(source.meanings))
    goods, bads, others = (tuple(w for w in free if w.lower() in group) for group in groups)
    return replace(
        source,
        good=source.good or goods or (UNKNOWN,),
        bad=source.bad or bads or (UNKNOWN,),
        unchecked=source.unchecked or others,
    )


def lists_words(source: LabelSource) -> bool:
    """Return whether a group in `source.path` spells out its words: `(ok|nok)`, not `([^/]+)`."""
    # A group of words, with escaped marks.
    return re.search(r"\((?!\?)(?:[\w /|-]|\\\W)+\)", source.path) is not None


def in_paths(paths: Names) -> list[str]:
    """Return the regular expressions that find words like "ok" or "failed" in paths.

    Such a word is or ends the name of a folder, or begins or ends a file name; numbers may stand
    behind it at the end. A word for unchecked is one, too, like "pending". Each expression has only
    the words that it finds; one that finds folders at different heights above the files is left
    out. The list is empty if any path negates such a word, like "not_passed", has true or false
    after a name, like "leak=False" or "data/False/", or has a word for bad and another such word,
    like "F=NOK_S=OK" or "NOK_pending": the meaning is open then.
    """
    stems = [*map(without_suffix, paths)]
    kinds = [{w.lower() in BAD for w in ALONE.findall(stem)} for stem in stems]
    patterns = []
    for pattern in () if any(map(NEGATED.search, stems)) or {False, True} in kinds else PATHS:
        found = [m for stem in stems if (m := re.search(f"(?i){pattern}", stem))]
        words = {m[1] for m in found}
        if len({m.string.count("/", m.end()) for m in found}) == 1:
            patterns.append(pattern.replace(WORD, "|".join(sorted(map(re.escape, words)))))
    return patterns


def is_named_like_verdict(source: LabelSource) -> bool:
    """Return whether a source of labels has the name of a verdict, like `result`.

    This is the name of its column, or the beginning of its line. A path counts if its regular
    expression lists words, like `(ok|nok)`, but not if it takes any word.
    """
    if source.path:
        return lists_words(source)
    return VERDICT_NAME.fullmatch(source.column or source.line) is not None


def may_be_labels(source: LabelSource, words: Collection[str]) -> bool:
    """Return whether a source may hold labels, because it has few different words.

    `words` has the word of each recording, or of each row of a listing. There must be 2 to 12
    different ones, and on average at least two recordings for each. If the source is named like a
    verdict (`is_named_like_verdict`), the average does not matter, and one word is enough if it is
    known to mean good or bad, or if the source states words for good or bad.
    """
    n = len({*words})
    if not is_named_like_verdict(source):
        return 2 <= n <= min(len(words) / 2, MOST_WORDS)
    meanings = with_meanings(source, words)
    is_known = {*meanings.good, *meanings.bad} != {UNKNOWN}
    return 2 - is_known <= n <= MOST_WORDS


def lines_of(p: Proposal) -> list[str]:
    """Return how the lines above the header begin, up to the first mark, two blanks or a date.

    The marks are `; : = ,` and the tab. `p` is the description so far, and only the first table of
    its recordings is looked at. Comment marks and quotes before it are left out. Each beginning
    comes once; empty ones are left out.
    """
    beginnings = [
        NAME_END.split(line.lstrip("#%* \t\"'"))[0].strip(" \"'")
        for table in p.tables[:1]
        for line in table.above
    ]
    return [*filter(None, dict.fromkeys(beginnings))]


def tables_of(p: Proposal) -> list[Table]:
    """Return the table of each recording, without columns if it was not looked at.

    The tables that were looked at, `p.tables`, come first, then those of other files in `p.names`.
    """
    looked_at = {table.source for table in p.tables}
    return [
        *p.tables,
        *(Table(name, {}, path=name) for name in p.names if name not in looked_at),
    ]


def part_words(source: PartSource, tables: Tables) -> Words:
    """Return the part number of each recording that has one, by the recording's `Table.source`.

    `source` says where the number stands; if it states nothing, each number is "". `tables` has the
    table of each recording. Recordings whose number is missing, empty or not the same in all rows
    are left out.
    """
    words = dict[str, str]()
    for table in tables:
        with suppress(UnreadableError):
            words[table.source] = part_of(source, table)
    return words


def sources_of(p: Proposal, paths: Names) -> Iterator[LabelSource]:
    """Yield the sources that may hold the labels.

    They come in this order: pairs of columns of listings (files among `p.others` with a row for
    each recording or workpiece), of which one may name these (`key`), since it has more different
    words than half of its rows, and the other may hold labels, since it has few different words
    (`may_be_labels`); regular expressions for the paths, of words like "ok" in them and of any
    words at fixed places; columns without another use that have one word in all rows of a
    recording; and lines above the header of the first table. A file that cannot be read as a
    listing is skipped. Raises SettingError for a malformed `windows.trigger`, and UnreadableError
    if cells of a column without another use are lists.

    paths : the path of each recording.
    """
    label = p.description.label
    for name in p.others:
        with suppress(DataError, ValueError):
            table = p.read_listing(name)
            for key, column in permutations(table.columns, 2):
                if len({*table.words(key)}) > len(table.lines) / 2:
                    source = replace(label, listing=name, key=key, column=column)
                    if may_be_labels(source, table.words(column)):
                        yield source
    yield from (replace(label, path=path) for path in (*in_paths(paths), *PLACES))
    yield from (replace(label, column=column.name) for column in p.unused if column.fixed)
    yield from (replace(label, line=line) for line in lines_of(p))


def words_of(p: Proposal, source: LabelSource, tables: Tables, parts: Words) -> Words:
    """Return the word of each recording that has one in a source, by its `Table.source`.

    A word is a text like "ok" that stands for a label; `source` says where it stands, for example
    in a listing (a file with a row for each recording or part). `p` is the description as far as it
    is made, `tables` has the table of each recording, and `parts` their part numbers. A recording
    for which the listing has rows with different words has none. The mapping is empty if no
    recording has a word; but if the source is `p.description.label`, which the user stated,
    DataError is raised then. Raises DataError if the source's listing cannot be read or lacks a
    column.
    """
    words = dict[str, str]()
    faults: Faults = []
    reader = read_labels(source, p.read_listing)
    for table in tables:
        with caught(faults, table.source):
            words[table.source] = reader.word(table, parts.get(table.source, ""))
    if source == p.description.label and not words:
        raise DataError(f"Expected words where [label] says they stand, found none. {faults[0]}.")
    return words


def title_of(source: LabelSource, words: Words) -> str:
    """Return a text with the options that state a source, like `--set label.column=result`.

    In brackets follows how often each word comes. `words` has the word of each recording.
    """
    stated = Description(label=source).to_dict()["label"]
    keys = [as_option(f"label.{k}", text) for k, text in stated.items() if isinstance(text, str)]
    return f"{' '.join(keys)} ({counts_of(words.values())})"


def count_sources(p: Proposal, stated: Sequence[LabelSource]) -> dict[LabelSource, Words]:
    """Return the possible sources of labels, each with the words that it has, by recording.

    If the user stated a source, only that one is returned. Otherwise these are the sources that
    have few different words (`may_be_labels`), and a word for more than half of the recordings. A
    source with the same words as an earlier one counts only if it is named like a verdict
    (`is_named_like_verdict`). For listings and paths all recordings count, since their names are
    enough; for columns and lines only those whose tables were looked at (`p.tables`). The words are
    sorted into good, bad and unchecked as `with_meanings` does. Raises DataError if the stated
    source has no words or cannot be read, or, if none is stated, if cells of a column without
    another use are lists; and SettingError for a malformed `windows.trigger`, the condition at
    which long recordings are cut.

    stated : the source that the user stated, `[label]`; empty if there is none.
    """
    tables = tables_of(p)
    parts = part_words(p.description.part, tables)
    counted = dict[LabelSource, Words]()
    for source in stated or sources_of(p, [table.path for table in tables]):
        words = words_of(p, source, tables, parts)
        is_new = words not in counted.values() or is_named_like_verdict(source)
        is_common = 2 * len(words) > len(tables if source.listing or source.path else p.tables)
        if stated or (is_new and is_common and may_be_labels(source, words.values())):
            counted[with_meanings(source, words.values())] = words
    return counted


def place_of(source: LabelSource) -> str:
    """Return the key in `[label]` that says where the label stands, like `path`; "" if none."""
    return next((kind for kind in SOURCES if getattr(source, kind)), "")


def unmatched(p: Proposal, counted: Iterable[LabelSource]) -> Iterator[str]:
    """Yield a text on each listing with a verdict of which `counted` has no source.

    `counted` are the sources of labels for recordings of `p`; a listing that has a word for half of
    them or fewer is not among these, also if its rows with one key have different words. A listing
    is a file with a row for each recording or part, and its verdict a column that is named like
    one. Raises what `sources_of` raises.
    """
    listings = {source.listing for source in counted}
    for source in sources_of(p, ()):
        if source.listing and source.listing not in listings and is_named_like_verdict(source):
            listings.add(source.listing)
            keys = p.read_listing(source.listing).words(source.key)
            yield (
                f"{source.listing} has {source.column}, but {source.key} names too few "
                f"recordings: {listed(keys[:2])}; if a path contains the key, state it, as in "
                f"{as_option('part.path', '([0-9]+)$')}"
            )


def may_contradict(
    source: LabelSource, words: Words, label: Words, meanings: Mapping[str, int | None]
) -> bool:
    """Return whether a source that has words of unknown meaning may contradict the label.

    It may if one of its words stands on good and on bad recordings, and the source either is named
    like a verdict (`is_named_like_verdict`), or has just two words, and these go with the labels
    beyond chance (p below 5 % by Fisher's exact test), like folders `Ausschuss` and `Serie`, if the
    press calls a few parts in `Ausschuss` OK.

    words, label : the word of each recording in the source and in the label. meanings : 1 good, 0
    bad, None not checked, by word of the label; recordings that are not checked do not count.
    """
    from scipy.stats import fisher_exact  # only here, since it takes a second to import

    pairs = Counter((words.get(name), meanings.get(word)) for name, word in label.items())
    counts = np.array([[pairs[word, y] for y in (0, 1)] for word in {*words.values()}])
    is_mixed = counts.all(1).any()
    if not is_named_like_verdict(source):
        is_mixed &= len(counts) == 2 and fisher_exact(counts).pvalue < CHANCE
    return bool(is_mixed)


def is_known(source: LabelSource, words: Words) -> bool:
    """Return whether the words of a source, by recording, all mean good, bad or not checked."""
    return {*words.values()} <= source.meanings.keys()


def doubt_on(label: LabelSource, counted: Counted, strays: Strings) -> str:
    """Return why a source, though certain in itself, may not be the label; "" if nothing does.

    A source is a place that may hold the labels, like a column, a path or a listing (a file with a
    row for each recording or part). `counted` has the words of each source, also of `label`, by
    recording. Another source may say bad where this one says good, or good where it says bad, or
    have words without a known meaning that may contradict it (`may_contradict`). The first such
    source gives the reason. Without one, the reason is a fixed text if `strays` is not empty; it
    has a text on each listing with a verdict that names too few recordings.
    """
    words = counted[label]
    for source, others in counted.items():
        n_odd = sum(
            {label.meanings.get(word), source.meanings.get(others.get(name, ""))} == {0, 1}
            for name, word in words.items()
        )
        if n_odd:
            return f"two of these disagree on {n_odd:,} of {len(words):,} recordings"
        if not is_known(source, others) and may_contradict(source, others, words, label.meanings):
            return "the words of another one may mean good and bad, too, and go another way"
    return "the labels may stand in that listing" if strays else ""


def doubt_among(named: Sequence[LabelSource], counted: Counted) -> str:
    """Return "" if only one source may be the label, though none is certain; else what to state.

    `counted` has the words of each source by recording, and `named` those sources that are named
    like a verdict or stated; without any the text is returned. Only these are compared, or all in
    `counted` if the words of any mean only good, bad or not checked (`is_known`). Sources that have
    the same word for each recording count as one.
    """
    has_known = any(map(is_known, counted, counted.values()))
    rivals = {tuple(counted[source].items()) for source in (counted if has_known else named)}
    if len(rivals) == 1 and named:
        return ""
    return (
        "none was found that is certain: state label.column, path, line or listing; labels in JSON "
        "or Excel go into a CSV with a column of file names first"
    )


def propose_label(p: Proposal) -> None:
    """Set `[label]` and `[[check]]` in `p`: the source of the labels, and those that must agree.

    A source is a place where each recording has a word like "ok", such as a column, the path or a
    listing (a file with a row for each recording). It is certain if it is named like a verdict
    (`is_named_like_verdict`) or stated by the user, has words for good and for bad, and all its
    words have a known meaning. The first certain source becomes the label, unless another source
    contradicts it (`doubt_on`), or no source is stated and a listing with a verdict names too few
    recordings (`unmatched`). If none is certain, but only one may be the label (`doubt_among`), it
    becomes the label: the first that is named like a verdict or stated. Its `good` or `bad` is `?`
    if none of its words is known to mean that; a word of unknown meaning is in neither list.
    Otherwise `label.column` is `?`, with a note that lists all sources, and the listings with a
    verdict that name too few recordings.

    Further certain sources that have a word for each recording of the label become checks, unless
    checks are stated; a note counts the words of the label, also on `label.good` and `label.bad` if
    these are `?`. Raises DataError if a stated source has no words or cannot be read, or, if none
    is stated, if cells of a column without another use are lists; and SettingError for a malformed
    `windows.trigger`, the condition at which long recordings are cut.
    """
    label = p.description.label
    stated = [label] if place_of(label) else []
    counted = count_sources(p, stated)
    named = [*counted]
    strays: Strings = []
    if not stated:
        named = [*filter(is_named_like_verdict, counted)]
        strays = [*unmatched(p, counted)]
    certain = [s for s in named if is_known(s, counted[s]) and UNKNOWN not in s.good + s.bad]
    doubt = doubt_on(certain[0], counted, strays) if certain else doubt_among(named, counted)
    if doubt:
        p.put(
            "label.column",
            UNKNOWN,
            "; ".join([*map(title_of, counted, counted.values()), *strays, doubt]),
        )
        return
    label = (certain or named)[0]
    words = counted[label]
    checks = p.description.check
    if not (checks or "check" in p.stated):
        checks = tuple(s for s in certain[1:] if counted[s].keys() >= words.keys())
    p.description = replace(p.description, label=label, check=checks)
    note_words(p, words)


def note_words(p: Proposal, words: Words) -> None:
    """Note in `p` how often each word of the label comes, also on its good or bad words if unknown.

    words : the word of each recording.
    """
    label = p.description.label
    note = f"{counts_of(words.values())}, over {len(words):,} recordings"
    p.notes[f"label.{place_of(label)}"] = note
    for key in ("good", "bad"):
        if UNKNOWN in getattr(label, key):
            p.notes[f"label.{key}"] = f"which words, also one that may come? {note}"
