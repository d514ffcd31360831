"""Every place that may hold the labels, counted, and whether those places agree.

A word means good or bad only if it is one of a short list of plain verdicts in a place of its own:
the end of a name, a folder, a cell of a column, or a line, whose name is a verdict's.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

from ...errors import DataError, listed
from ..description import UNKNOWN, LabelSource, TextForm
from ..read.places import SUFFIX, LabelReader, Place, listing_table, read_labels
from ..table import UnreadableError
from .cells import MOST_WORDS, Column, Notes, Values, counts_of

GOOD = (
    *("ok", "pass", "passed", "good", "success", "gut", "true", "i.o.", "i.o", "i_o", "io"),
    *("accepted", "合格"),
)
BAD = (
    *("nok", "not ok", "not_ok", "not-ok", "fail", "failed", "bad", "failure", "schlecht", "false"),
    *("n.i.o.", "n.i.o", "n_i_o", "nio", "ng", "reject", "rejected", "不合格"),
)
UNCHECKED = ("", "-", "--", "pending", "open", "offen", "unchecked", "not checked", "n/a")
YES, NO = ("1", "true", "yes", "ja"), ("0", "false", "no", "nein")
NAME = re.compile(
    r"(?i)result|verdict|ergebnis|bewertung|outcome|判定|(^|[^a-z])(label|success|quality|n?i?ok|nio"
    r"|pass(ed)?|class|target|y|status|urteil|accept(ed)?|judg?e?ment)([^a-z]|$)"
)
BAD_NAME = re.compile(
    r"(?i)(^|[^a-z])(fail(ed|ure)?|defect\w*|nok|nio|bad|anomaly|scrap|reject(ed)?)([^a-z]|$)"
)
GOOD_NAME = re.compile(
    r"(?i)(^|[^a-z])(success|ok|io|pass(ed)?|accept(ed)?|good|label|y)([^a-z]|$)"
)
IN_PATHS = (*GOOD, *BAD, "pending", "offen", "unchecked")
WORD = "|".join(sorted(map(re.escape, IN_PATHS), key=len, reverse=True))
NEGATED = re.compile(rf"(?i)(not.(?!ok)|nicht.|(?-i:[-_ .]n)[-_ .](?!i))({WORD})")
PATHS = (  # of verdicts in folders, and at the end or beginning of names
    rf"(?:^|/)({WORD})/",
    rf"(?:^|[-_ ./(=+\[])({WORD})[-_ \d()\]]*$",
    rf"(?:^|/)({WORD})(?=[-_ ][^/]*$)",
)
KINDS = ("listing", "column", "path", "line")
Names = Iterable[str]
Words = Sequence[str]
Sources = list[LabelSource]
Places = Mapping[str, Place]


@dataclass(frozen=True, slots=True)
class Candidate:
    """A source that may hold the labels, and the word of each recording that has one."""

    source: LabelSource
    words: Mapping[str, str]

    @property
    def kind(self) -> str:
        """What kind of place it is."""
        return next(kind for kind in KINDS if getattr(self.source, kind))

    @property
    def labels(self) -> dict[str, int | None]:
        """The label of each recording whose word has a meaning that is known."""
        reader = LabelReader(self.source)
        meanings = {*self.source.good, *self.source.bad, *self.source.unchecked}
        return {name: reader.meaning(w) for name, w in self.words.items() if w in meanings}

    @property
    def is_known(self) -> bool:
        """Whether the meaning of every word is known, and some word is a label."""
        return len(self.labels) == len(self.words) and {*self.labels.values()} != {None}

    @property
    def title(self) -> str:
        """What to type for it, with the counts of its words."""
        keys = ("listing", "key", "column", "path", "line")
        stated = [f"label.{key}={value}" for key in keys if (value := getattr(self.source, key))]
        return f"{' '.join(stated)} ({counts_of(self.words.values())})"

    def disagreements(self, other: "Candidate") -> int:
        """Return for how many recordings that were checked another candidate has another label."""
        pairs = [(label, other.labels.get(name)) for name, label in self.labels.items()]
        return sum({*pair} == {0, 1} for pair in pairs)


def with_meanings(source: LabelSource, words: Names) -> LabelSource:
    """Return a source with the meanings of its words; `?` for those that are not known.

    Plain verdicts mean the same everywhere; `io` is one only beside `nio`, and in a path each is
    one only if some part is good and some bad: `pass_1.csv` may be anything. True, yes and 1 mean
    what the column's name says: good for `success`, bad for `failed`; of other names nothing.
    """
    words = sorted({*words})
    good, bad = _verdicts(source.column or source.line, {word.lower() for word in words})
    kinds = {"good": good, "bad": bad, "unchecked": UNCHECKED}
    meanings = {
        key: tuple(w for w in words if w.lower() in verdicts) for key, verdicts in kinds.items()
    }
    is_one_sided = source.path and not (meanings["good"] and meanings["bad"])
    if is_one_sided or len(words) > sum(map(len, meanings.values())):
        meanings |= {key: meanings[key] or (UNKNOWN,) for key in ("good", "bad")}
    stated: Values = {key: getattr(source, key) or meanings[key] for key in kinds}
    return replace(source, **stated)


def _verdicts(name: str, words: set[str]) -> tuple[Words, Words]:
    """Return the words for good and for bad in a column or line of this name."""
    if not name or not words <= {*YES, *NO, *UNCHECKED}:
        return [word for word in GOOD if word != "io" or "nio" in words], BAD
    if BAD_NAME.search(name):
        return NO, YES
    is_good = GOOD_NAME.search(name) or (words & {"true", "false"} and NAME.search(name))
    return (YES, NO) if is_good else ((), ())


@dataclass(frozen=True, slots=True)
class Labels:
    """Finds the sources of labels of some recordings.

    base : folder with the listings. places, parts : where each recording stands, and its part.
    """

    base: Path
    places: Places
    parts: Mapping[str, str]
    form: TextForm

    def candidate(self, source: LabelSource) -> Candidate:
        """Return a source with the word of each recording that has one, and their meanings."""
        words = dict[str, str]()
        with suppress(DataError):
            reader = read_labels(self.base, source, self.form)
            for name, place in self.places.items():
                with suppress(UnreadableError):
                    words[name] = reader.words(place, self.parts.get(name, ""))[0]
        return Candidate(with_meanings(source, words.values()), words)

    def in_listings(self, names: Names) -> Sources:
        """Return the columns of verdicts in files that list most recordings, with their key."""
        sources: Sources = []
        for name in names:
            try:
                table = listing_table(self.base / name, (), self.form)
            except (DataError, ValueError):
                continue
            for key in table.columns:
                plain = LabelSource(listing=name, key=key, column=key)
                if len(self.candidate(plain).words) > len(self.places) / 2:
                    verdicts = [c for c in table.columns if is_verdict(c, table.words(c))]
                    sources += [replace(plain, column=c) for c in verdicts if c != key]
                    break
        return sources


def in_paths(paths: Names) -> Sources:
    """Return the expressions that find verdicts in most paths; none if a not stands before one."""
    stems = [SUFFIX.sub("", path) for path in paths]
    sources: Sources = []
    for pattern in () if any(map(NEGATED.search, stems)) else PATHS:
        words = [m[1] for stem in stems if (m := re.search(f"(?i){pattern}", stem))]
        if len(words) > len(stems) / 2:
            used = sorted({*words}, key=lambda text: (-len(text), text))
            sources.append(LabelSource(path=pattern.replace(WORD, "|".join(map(re.escape, used)))))
    return sources


def is_verdict(name: str, words: Names) -> bool:
    """Return whether a column has the name of a verdict, and few words; a single one is plain."""
    words = {*words}
    source = with_meanings(LabelSource(column=name), words)
    is_label = len(words) > 1 or bool(source.good or source.bad)
    is_named = NAME.search(name) or BAD_NAME.search(name)
    return is_named is not None and is_label and len(words) <= MOST_WORDS


def in_columns(columns: Iterable[Column]) -> Sources:
    """Return the columns of verdicts.

    A label that changes within a recording is that of its last row, if above it stand only words
    for not checked.
    """
    sources: Sources = []
    for column in columns:
        last = [str(words[-1]) for words in column.words if len(words)]
        above = {word.lower() for words in column.words for word in {*words} - {*words[-1:]}}
        if above <= {*UNCHECKED} and is_verdict(column.name, last):
            sources.append(LabelSource(column=column.name, at="same" if column.fixed else "last"))
    return sources


def line_keys(above: Sequence[str]) -> list[str]:
    """Return the beginnings of lines above a header, before the first mark."""
    return [re.split(r"[;:=\t,]", line.lstrip("#%* \t\"'"))[0].strip(" \"'") for line in above]


def in_lines(above: Sequence[str]) -> Sources:
    """Return the beginnings of lines above a header that are the name of a verdict."""
    return [LabelSource(line=key) for key in line_keys(above) if NAME.search(key)]


def choose(
    candidates: Sequence[Candidate], notes: Notes, hints: Names, n: int
) -> tuple[LabelSource, Sources]:
    """Return the source of the labels, and those that must agree with it.

    The first candidate whose words are known is the label if all such agree, and the others are
    checks if they have a word for each recording. If two disagree, or there is none, the label is
    `?`, and the note lists them all.

    hints : columns that may hold labels under other names. n : recordings that were looked at.
    """
    certain = [candidate for candidate in candidates if candidate.is_known]
    over = f"over {n:,} recordings"
    if text := _disagreement(certain):
        notes["label.column"] = f"{text} of {n:,} recordings: which is right?"
        return LabelSource(column=UNKNOWN), []
    if certain or len(candidates) == 1:
        best, *others = certain or candidates
        checks = [other for other in others if other.words.keys() >= best.words.keys()]
        counts = counts_of(best.words.values())
        kinds = {True: "agrees", False: "of unknown meaning"}
        also = [f"{kinds[c in certain]}: {c.title}" for c in candidates if c is not best]
        notes[f"label.{best.kind}"] = "; ".join([f"{counts}, {over}", *also])
        if UNKNOWN in best.source.good + best.source.bad:
            notes["label.good"] = notes["label.bad"] = f"which of the words? {counts}"
        return best.source, [check.source for check in checks]
    titles = "; ".join([candidate.title for candidate in candidates])
    text = titles or "none was found: state label.column, path, line or listing"
    few = f"; columns of few words: {columns}" if (columns := listed(hints)) else ""
    notes["label.column"] = f"{text}{few}; {over}"
    return LabelSource(column=UNKNOWN), []


def _disagreement(candidates: Sequence[Candidate]) -> str:
    """Return which two candidates disagree, and on how many recordings; "" if all agree."""
    for first, second in combinations(candidates, 2):
        if count := first.disagreements(second):
            return f"{first.title} and {second.title} disagree on {count:,}"
    return ""
