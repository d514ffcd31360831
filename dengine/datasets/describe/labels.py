"""Every place that may hold the labels, counted, and whether those places agree.

A word means good or bad only if it is one of a short list of plain verdicts in a place of its own:
the end of a name, a folder, a cell of a column, or a line, whose name is a verdict's.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from ...errors import DataError, listed
from ..description import UNKNOWN, LabelSource, PartSource, Words
from ..read.places import LabelReader, Place, listing_table, part_of, read_labels, without_suffix
from ..table import Table, UnreadableError
from .columns import MOST_WORDS, Column, Proposal, counts_of

GOOD_ALONE: Words = (
    *("ok", "pass", "passed", "good", "success", "gut", "true", "i.o.", "i.o", "i_o"),
    *("accepted", "合格"),
)
GOOD: Words = (
    *GOOD_ALONE,
    "io",
)  # which is plain only beside `nio`: it also stands for input and output
BAD: Words = (
    *("nok", "not ok", "not_ok", "not-ok", "fail", "failed", "bad", "failure", "schlecht", "false"),
    *("n.i.o.", "n.i.o", "n_i_o", "nio", "ng", "reject", "rejected", "不合格"),
)
UNCHECKED = ("", "-", "--", "pending", "open", "offen", "unchecked", "not checked", "n/a")
YES: Words = ("1", "true", "yes", "ja")
NO: Words = ("0", "false", "no", "nein")
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
Places = Mapping[str, Place]


@dataclass(frozen=True, slots=True)
class Candidate:
    """A source that may hold the labels, and the word of each recording that has one."""

    source: LabelSource
    words: Mapping[str, str]

    @property
    def labels(self) -> dict[str, int | None]:
        """The label of each recording whose word has a meaning that is known."""
        reader, labels = LabelReader(self.source), dict[str, int | None]()
        for name, word in self.words.items():
            with suppress(UnreadableError):
                labels[name] = reader.meaning(word)
        return labels

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
        labels = other.labels
        return sum({label, labels.get(name)} == {0, 1} for name, label in self.labels.items())


def with_meanings(source: LabelSource, words: Names) -> LabelSource:
    """Return a source with the meanings of its words; `?` for those that are not known.

    Plain verdicts mean the same everywhere; `io` is one only beside `nio`, and in a path each is
    one only if some part is good and some bad: `pass_1.csv` may be anything. True, yes and 1 mean
    what the column's name says: good for `success`, bad for `failed`; of other names nothing.
    """
    words = sorted({*words})
    lower = {word.lower() for word in words}
    name = source.column or source.line or source.topic
    good, bad = GOOD if "nio" in lower else GOOD_ALONE, BAD
    if name and lower <= {*YES, *NO, *UNCHECKED}:
        is_good = GOOD_NAME.search(name) or (lower & {"true", "false"} and NAME.search(name))
        good, bad = (YES, NO) if is_good else ((), ())
        good, bad = (NO, YES) if BAD_NAME.search(name) else (good, bad)
    meanings: dict[str, Any] = {
        key: getattr(source, key) or tuple(word for word in words if word.lower() in verdicts)
        for key, verdicts in (("good", good), ("bad", bad), ("unchecked", UNCHECKED))
    }
    is_one_sided = source.path and not (meanings["good"] and meanings["bad"])
    if is_one_sided or {*words}.difference(*meanings.values()):
        meanings |= {key: meanings[key] or (UNKNOWN,) for key in ("good", "bad")}
    return replace(source, **meanings)


def is_plain(source: LabelSource) -> bool:
    """Return whether a source has words for good or bad, and the meaning of all is known."""
    words = source.good + source.bad
    return bool(words) and UNKNOWN not in words


def in_paths(paths: Names) -> list[str]:
    """Return the expressions that find verdicts in most paths; none if a not stands before one."""
    stems = [*map(without_suffix, paths)]
    patterns = []
    for pattern in () if any(map(NEGATED.search, stems)) else PATHS:
        words = [m[1] for stem in stems if (m := re.search(f"(?i){pattern}", stem))]
        if len(words) > len(stems) / 2:
            used = sorted({*words}, key=lambda text: (-len(text), text))
            patterns.append(pattern.replace(WORD, "|".join(map(re.escape, used))))
    return patterns


def is_verdict(name: str, words: Names) -> bool:
    """Return whether a column has the name of a verdict, and few words; a single one is plain."""
    words = {*words}
    is_named = NAME.search(name) or BAD_NAME.search(name)
    is_label = len(words) > 1 or is_plain(with_meanings(LabelSource(column=name), words))
    return bool(is_named) and is_label and len(words) <= MOST_WORDS


def row_of(column: Column) -> str:
    """Return which row of a recording has the label in a column, `same` or `last`; "" for none.

    It is the last if above it stand only words for not checked.
    """
    last = [str(words[-1]) for words in column.words if len(words)]
    above = {word.lower() for words in column.words for word in {*words} - {*words[-1:]}}
    row = "same" if column.fixed else "last"
    return row if above <= {*UNCHECKED} and is_verdict(column.name, last) else ""


def lines_of(p: Proposal, pattern: re.Pattern[str]) -> list[str]:
    """Return the beginnings of lines above a header, before the first mark, that a pattern fits."""
    lines = [line.lstrip("#%* \t\"'") for line in p.tables[0].above]
    return [*filter(pattern.search, (re.split(r"[;:=\t,]", x)[0].strip(" \"'") for x in lines))]


def part_words(source: PartSource, places: Places) -> dict[str, str]:
    """Return the number of the part of each recording that states one."""
    words = dict[str, str]()
    for name, place in places.items():
        with suppress(DataError):
            words[name] = part_of(source, place)
    return words


@dataclass(frozen=True, slots=True)
class Labels:
    """The sources of labels of some recordings, and of the parts they are of."""

    p: Proposal
    places: Places
    parts: Mapping[str, str]

    def candidate(self, source: LabelSource) -> Candidate:
        """Return a source with the word of each recording that has one, and their meanings."""
        words = dict[str, str]()
        with suppress(DataError):
            reader = read_labels(self.p.base, source, self.p.description.text)
            for name, place in self.places.items():
                with suppress(UnreadableError):
                    words[name] = reader.words(place, self.parts.get(name, ""))[0]
        return Candidate(with_meanings(source, words.values()), words)

    def sources(self) -> Iterator[LabelSource]:
        """Yield the sources that may hold labels: listings, paths, columns and lines."""
        p, label = self.p, self.p.description.label
        for name in p.others:
            with suppress(DataError, ValueError):
                table = listing_table(p.base / name, (), p.description.text)
                plain = (replace(label, listing=name, key=k, column=k) for k in table.columns)
                counts = {source.key: len(self.candidate(source).words) for source in plain}
                key = max(counts, key=lambda name: counts[name])
                verdicts = [c for c in table.columns if is_verdict(c, table.words(c)) and c != key]
                if counts[key] > len(self.places) / 2:
                    yield from (replace(label, listing=name, key=key, column=c) for c in verdicts)
        if p.description.layout in ("files", "columns"):
            for path in in_paths(place.path for place in self.places.values()):
                yield replace(label, path=path)
        for column in p.unused:
            if row := row_of(column):
                yield replace(label, column=column.name, at=row)
        for line in lines_of(p, NAME):
            yield replace(label, line=line)


def propose_label(p: Proposal) -> None:
    """Find the source of the labels, and those that must agree with it.

    The first candidate whose words are known is the label if all such agree with it, and the others
    are checks if they have a word for each recording. If one disagrees, or there is none, the label
    is `?`, and the note lists them all.
    """
    places = {name: Place(name, Table(name, {}, [])) for name in p.names} | {**p.places}
    finder = Labels(p, places, part_words(p.description.part, places))
    label = p.description.label
    is_stated = any(getattr(label, kind) for kind in KINDS)
    found = map(finder.candidate, [label] if is_stated else finder.sources())
    candidates = [candidate for candidate in found if candidate.words or is_stated]
    certain = [candidate for candidate in candidates if candidate.is_known]
    over = f"{len(places):,} recordings"
    for other in certain:
        if n := certain[0].disagreements(other):
            text = f"{certain[0].title} and {other.title} disagree on {n:,} of {over}"
            ask_for_label(p, f"{text}: which is right?")
            return
    if not certain and len(candidates) != 1:
        titles = [candidate.title for candidate in candidates]
        text = "; ".join(titles) or "none was found: state label.column, path, line or listing"
        few = [column for column in p.unused if 1 < len({*column.fixed}) <= MOST_WORDS]
        hints = listed(f"{column.name} ({counts_of(column.fixed)})" for column in few)
        text += f"; columns of few words: {hints}" if hints else ""
        ask_for_label(p, f"{text}; over {over}")
        return
    best = (certain or candidates)[0]
    checks = [other.source for other in certain[1:] if other.words.keys() >= best.words.keys()]
    p.description = replace(p.description, label=best.source, check=tuple(checks))
    counts = counts_of(best.words.values())
    kinds = {True: "agrees", False: "of unknown meaning"}
    also = [f"{kinds[c.is_known]}: {c.title}" for c in candidates if c is not best]
    kind = next(kind for kind in KINDS if getattr(best.source, kind))
    p.notes[f"label.{kind}"] = "; ".join([f"{counts}, over {over}", *also])
    if UNKNOWN in best.source.good + best.source.bad:
        p.notes |= dict.fromkeys(("label.good", "label.bad"), f"which of the words? {counts}")


def ask_for_label(p: Proposal, text: str) -> None:
    """Leave the source of the labels open."""
    p.description = replace(p.description, label=replace(p.description.label, column=UNKNOWN))
    p.notes["label.column"] = text
