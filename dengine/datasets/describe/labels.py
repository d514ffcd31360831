"""Every place that may hold the labels, counted, and whether those places agree.

A word means good or bad only if it is one of a short list of plain verdicts in a place of its own:
the end of a name, a folder, a cell of a column, or a line, whose name is a verdict's.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ...errors import DataError, listed
from ..description import UNKNOWN, LabelSource, TextForm
from ..read.places import SUFFIX, Place, listing_table, read_labels
from ..table import Table

GOOD = ("ok", "pass", "passed", "good", "success", "gut", "true", "i.o.", "io", "accepted", "合格")
BAD = (
    *("nok", "not ok", "fail", "failed", "bad", "failure", "schlecht", "false", "n.i.o.", "nio"),
    *("ng", "reject", "rejected", "不合格"),
)
UNCHECKED = ("", "-", "--", "pending", "open", "offen", "unchecked", "not checked", "n/a", "?")
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
MOST_WORDS = 12
Names = Iterable[str]


@dataclass(frozen=True, slots=True)
class Candidate:
    """A source that may hold the labels, and the word of each recording that has one."""

    source: LabelSource
    words: Mapping[str, str]

    @property
    def is_known(self) -> bool:
        """Whether the meaning of every word is known, and some word is a label."""
        source = self.source
        labels = {*source.good, *source.bad} - {UNKNOWN}
        return bool(labels) and {*self.words.values()} <= {*labels, *source.unchecked}

    @property
    def title(self) -> str:
        """What to type for it, with the counts of its words."""
        source = self.source
        keys = ("listing", "key", "column", "path", "line")
        stated = [f"label.{key}={getattr(source, key)}" for key in keys if getattr(source, key)]
        return f"{' '.join(stated)} ({counts_of(self.words.values())})"

    def disagreements(self, other: "Candidate") -> int:
        """Return for how many recordings another candidate has another label."""
        good = [
            {name: word in one.source.good for name, word in one.words.items()}
            for one in (self, other)
        ]
        open_ = [
            {n for n, w in one.words.items() if w in one.source.unchecked} for one in (self, other)
        ]
        both = good[0].keys() & good[1].keys() - open_[0] - open_[1]
        return sum(good[0][name] != good[1][name] for name in both)


def counts_of(words: Names) -> str:
    """Return how often each word comes, most frequent first."""
    return ", ".join(f"{w or 'empty'}: {n:,}" for w, n in Counter(words).most_common(MOST_WORDS))


def with_meanings(source: LabelSource, words: Names) -> LabelSource:
    """Return a source with the meanings of its words; `?` for those that are not known.

    Plain verdicts mean the same everywhere; `io` is one only beside `nio`. True, yes and 1 mean
    what the column's name says: good for `success`, bad for `failed`; of other names nothing.
    """
    words = sorted({*words})
    lower = {word.lower() for word in words}
    name = source.column or source.line
    verdicts = {*GOOD} - ({"io"} if "nio" not in lower else set())
    good, bad = verdicts, {*BAD}
    if lower <= {*YES, *NO, *UNCHECKED} and name:
        is_good = GOOD_NAME.search(name) or (lower & {"true", "false"} and NAME.search(name))
        good, bad = ({*YES}, {*NO}) if is_good else (set(), set())
        if BAD_NAME.search(name):
            good, bad = {*NO}, {*YES}
    meanings = {
        "good": [word for word in words if word.lower() in good],
        "bad": [word for word in words if word.lower() in bad],
        "unchecked": [word for word in words if word.lower() in UNCHECKED],
    }
    if {*words} - {*meanings["good"], *meanings["bad"], *meanings["unchecked"]}:
        meanings |= {key: meanings[key] or [UNKNOWN] for key in ("good", "bad")}
    return replace(
        source, **{key: getattr(source, key) or tuple(some) for key, some in meanings.items()}
    )


def candidate(
    base: Path,
    source: LabelSource,
    places: Mapping[str, Place],
    parts: Mapping[str, str],
    form: TextForm,
) -> Candidate:
    """Return a source with the word of each recording that has one, and what the words mean."""
    words = dict[str, str]()
    try:
        reader = read_labels(base, source, form)
    except DataError:
        reader = None
    for name, place in places.items() if reader else ():
        try:
            words[name] = reader.words(place, parts.get(name, ""))[0]  # type: ignore[union-attr]
        except DataError:
            continue
    return Candidate(with_meanings(source, words.values()), words)


def path_sources(paths: Names) -> list[LabelSource]:
    """Return the expressions for verdicts in folders, and at the end or beginning of names."""
    stems = [SUFFIX.sub("", path) for path in paths]
    word = "|".join(sorted(map(re.escape, (*GOOD, *BAD)), key=len, reverse=True))
    patterns = (
        rf"(?:^|/)({word})/",
        rf"(?:^|[-_ ./])({word})(?:[-_ ]?\d+)?$",
        rf"(?:^|/)({word})(?=[-_ ][^/]*$)",
    )
    sources = []
    for pattern in patterns:
        found = [m[1] for stem in stems if (m := re.search(f"(?i){pattern}", stem))]
        if len(found) > len(stems) / 2:
            used = sorted({*found}, key=lambda text: (-len(text), text))
            sources.append(LabelSource(path=pattern.replace(word, "|".join(map(re.escape, used)))))
    return sources


def column_sources(views: Mapping[str, Table], columns: Names) -> list[LabelSource]:
    """Return the columns whose name is a verdict's, and whose words are few.

    A label that changes within a recording is that of its last row, if above it stand only words
    for not checked.
    """
    sources = []
    for name in columns:
        words = [view.words(name) for view in views.values() if name in view.columns]
        if not (NAME.search(name) or BAD_NAME.search(name)) or not all(map(len, words)):
            continue
        changes = [{*cells} - {cells[-1]} for cells in words if len({*cells}) > 1]
        is_last = all(word.lower() in UNCHECKED for some in changes for word in some)
        different = {cells[-1] for cells in words}
        known = with_meanings(LabelSource(column=name), different)
        if (
            is_last
            and len(different) <= MOST_WORDS
            and (len(different) > 1 or known.good or known.bad)
        ):
            sources.append(LabelSource(column=name, at="last" if changes else "same"))
    return sources


def line_sources(above: Sequence[str]) -> list[LabelSource]:
    """Return the beginnings of lines above a header that are the name of a verdict."""
    keys = [re.split(r"[;:=\t,]", line.lstrip("#%* \t\"'"))[0].strip(" \"'") for line in above]
    return [LabelSource(line=key) for key in keys if NAME.search(key)]


def listing_sources(
    base: Path, names: Names, places: Mapping[str, Place], parts: Mapping[str, str], form: TextForm
) -> list[LabelSource]:
    """Return the columns of verdicts in files that list most of the recordings, with their key."""
    sources = []
    for name in names:
        try:
            table = listing_table(base / name, (), form)
        except (DataError, ValueError):
            continue
        for key in table.columns:
            plain = LabelSource(listing=name, key=key, column=key)
            found = candidate(base, plain, places, parts, form).words
            if len(found) > len(places) / 2:
                columns = [column for column in table.columns if column != key]
                view = {
                    row: table.take(slice(i, i + 1)) for i, row in enumerate(map(str, table.lines))
                }
                some = column_sources(view, columns)
                sources += [replace(plain, column=source.column) for source in some]
                break
    return sources


def choose(
    candidates: Sequence[Candidate], notes: dict[str, str], hints: Sequence[str], n: int
) -> tuple[LabelSource, list[LabelSource]]:
    """Return the source of the labels, and those that must agree with it.

    The first candidate whose words are known is the label if all such agree, and the others are
    checks. If two disagree, or there is none, the label is `?`, and the note lists them all.

    hints : columns that may hold labels under other names. n : recordings that were looked at.
    """
    known = [one for one in candidates if one.is_known]
    pairs = [(a, b, a.disagreements(b)) for i, a in enumerate(known) for b in known[i + 1 :]]
    first, second, count = max(pairs, key=lambda pair: pair[2], default=(None, None, 0))
    if first is not None and second is not None and count:
        text = f"{first.title} and {second.title} disagree on {count:,} of {n:,} recordings"
        notes["label.column"] = f"{text}: which is right?"
        return LabelSource(column=UNKNOWN), []
    if known or len(candidates) == 1:
        best, *others = known or candidates
        kind = next(
            key for key in ("listing", "column", "path", "line") if getattr(best.source, key)
        )
        notes[f"label.{kind}"] = f"{counts_of(best.words.values())}, over {n:,} recordings"
        if not best.is_known:
            notes["label.good"] = f"which of the words? {counts_of(best.words.values())}"
        return best.source, [other.source for other in others]
    text = "; ".join(one.title for one in candidates)
    text = f"one of {text}" if text else "none was found: state label.column, path, line or listing"
    text += f"; columns of few words: {listed(hints)}" if hints else ""
    notes["label.column"] = f"{text}; over {n:,} recordings"
    return LabelSource(column=UNKNOWN), []
