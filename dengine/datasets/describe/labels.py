"""Every place that may hold the labels, counted, and whether those places agree.

A word means good or bad only if it is one of a short list of plain verdicts in a place of its own:
the end of a name, a folder, a cell of a column, or a line, whose name is a verdict's.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ...errors import listed
from ..description import UNKNOWN, LabelSource, TextForm
from ..read.files import read_file
from ..read.frames import read_objects, read_parquet
from ..read.places import Place, joined, line_word, read_listing, without_suffix
from ..read.text import read_text
from ..table import Table, UnreadableError

GOOD = ("ok", "pass", "passed", "good", "success", "gut", "true", "i.o.", "io", "accepted", "合格")
BAD = (
    *("nok", "fail", "failed", "bad", "failure", "schlecht", "false", "n.i.o.", "nio", "ng"),
    *("reject", "rejected", "not ok", "不合格"),
)
NEEDS_OTHER = {"io": "nio"}  # a word that is a verdict only beside this one
UNCHECKED = ("", "-", "--", "pending", "open", "offen", "unchecked", "not checked", "n/a", "?")
YES, NO = ("1", "true", "yes", "ja"), ("0", "false", "no", "nein")
VERDICT_NAME = re.compile(
    r"(?i)(^|[^a-z])(label|verdict|result|ergebnis|success|outcome|quality|n?i?ok|nio|pass(ed)?|class"
    r"|target|y|status|bewertung|urteil|accept(ed)?|resultat|judg?e?ment|eval(uation)?|判定|label_\w+)"
    r"([^a-z]|$)|(?i:result|verdict|ergebnis)"
)
BAD_NAME = re.compile(
    r"(?i)(^|[^a-z])(fail(ed|ure)?|defect\w*|nok|nio|bad|anomaly|scrap|reject(ed)?)([^a-z]|$)"
)
GOOD_NAME = re.compile(
    r"(?i)(^|[^a-z])(success|ok|io|pass(ed)?|accept(ed)?|good|label|y|i\.o\.)([^a-z]|$)"
)
MOST_WORDS = 12
CHUNK = 200  # files of names that a note quotes


@dataclass(slots=True)
class Candidate:
    """A place that may hold the labels.

    source : the keys of `[label]` that state it.
    words : the word of each recording that has one, by the recording's name.
    good, bad, unchecked : what the words mean; `?` in them stands for words of unknown meaning.
    """

    source: dict[str, str]
    words: dict[str, str]
    good: list[str] = field(default_factory=list)
    bad: list[str] = field(default_factory=list)
    unchecked: list[str] = field(default_factory=list)

    @property
    def is_known(self) -> bool:
        """Whether the meaning of every word is known, and some word is a label."""
        known = {*self.good, *self.bad, *self.unchecked}
        return bool(self.good or self.bad) and {*self.words.values()} <= known

    @property
    def title(self) -> str:
        """What to type for it, with the counts of its words."""
        keys = ", ".join(f"label.{key}={value}" for key, value in self.source.items())
        counts = Counter(self.words.values()).most_common(MOST_WORDS)
        words = ", ".join(f"{word or 'empty'}: {n:,}" for word, n in counts)
        return f"{keys} ({words})"

    def labels(self) -> dict[str, bool]:
        """Return whether each recording is good, of those that have a label."""
        return {
            name: word in self.good
            for name, word in self.words.items()
            if word in self.good or word in self.bad
        }

    def values(self) -> dict[str, Any]:
        """Return the keys of `[label]` for it."""
        meanings = {"good": self.good, "bad": self.bad}
        if not self.is_known:
            meanings = {key: words or [UNKNOWN] for key, words in meanings.items()}
        meanings |= {"unchecked": self.unchecked} if self.unchecked else {}
        return {**self.source, **meanings}


def meaning(words: Iterable[str], name: str = "") -> tuple[list[str], list[str], list[str]]:
    """Return which words mean good, bad and not checked, in a column or line of some name.

    Plain verdicts mean the same everywhere. True, yes and 1 mean what the name says: good for
    `success`, bad for `failed`; of other names they mean nothing.
    """
    words = [*words]
    lower = {word.lower() for word in words}
    good = [
        w for w in words if w.lower() in GOOD and (NEEDS_OTHER.get(w.lower(), w.lower()) in lower)
    ]
    bad = [w for w in words if w.lower() in BAD]
    is_flag = lower <= {*YES, *NO, *UNCHECKED}
    if is_flag and name:
        yes, no = ([w for w in words if w.lower() in some] for some in (YES, NO))
        is_bad = BAD_NAME.search(name) is not None
        is_good = not is_bad and GOOD_NAME.search(name) is not None
        is_verdict = not is_bad and lower & {"true", "false"} and VERDICT_NAME.search(name)
        good, bad = (no, yes) if is_bad else (yes, no) if is_good or is_verdict else ([], [])
    return good, bad, [w for w in words if w.lower() in UNCHECKED]


def in_paths(names: Sequence[str]) -> list[Candidate]:
    """Return the candidates in the paths of files: folders, and the ends or beginnings of names."""
    stems = {name: without_suffix(name) for name in names}
    word = "|".join(sorted(map(re.escape, (*GOOD, *BAD)), key=len, reverse=True))
    patterns = (
        rf"(?:^|/)({word})/",
        rf"(?:^|[-_ ./])({word})(?:[-_ ]?\d+)?$",
        rf"(?:^|/)({word})(?=[-_ ][^/]*$)",
    )
    result = []
    for pattern in patterns:
        expression = re.compile(f"(?i){pattern}")
        words = {
            name: match[1] for name, stem in stems.items() if (match := expression.search(stem))
        }
        used = sorted({*words.values()}, key=lambda text: (-len(text), text))
        good, bad, _ = meaning(used)
        words = {name: text for name, text in words.items() if text in good or text in bad}
        if len(words) > len(names) / 2:
            spelled = pattern.replace(word, "|".join(re.escape(text) for text in used))
            result.append(Candidate({"path": spelled}, words, good, bad))
    return result


def in_columns(views: Mapping[str, Table], names: Iterable[str]) -> list[Candidate]:
    """Return the candidates among columns whose name is a verdict's.

    A label that changes within a recording is that of its last row, if only empty cells, or words
    for not checked, stand above it.
    """
    result = []
    for name in names:
        if not (VERDICT_NAME.search(name) or BAD_NAME.search(name)):
            continue
        words, last = dict[str, str](), False
        for view, table in views.items():
            cells = table.words(name) if name in table.columns else []
            different = {*cells}
            if len(different) > 1:
                last = True
                if {w for w in different if w.lower() not in UNCHECKED} != {cells[-1]}:
                    break
            words[view] = str(cells[-1]) if len(cells) else ""
        different = {*words.values()}
        if len(words) < len(views) or len(different) > MOST_WORDS or different <= {""}:
            continue
        good, bad, unchecked = meaning(sorted(different), name)
        if len(different) < 2 and not (good or bad):
            continue
        source = {"column": name} | ({"at": "last"} if last else {})
        result.append(Candidate(source, words, good, bad, unchecked))
    return result


def in_lines(views: Mapping[str, Table]) -> list[Candidate]:
    """Return the candidates among lines above the header whose beginning is a verdict's name."""
    result = []
    first = next(iter(views.values()))
    for line in first.above:
        key = re.split(r"[;:=\t,]", line.lstrip("#%* \t\"'"))[0].strip(" \"'")
        if not key or not VERDICT_NAME.search(key):
            continue
        words = dict[str, str]()
        for view, table in views.items():
            try:
                words[view] = line_word(key, table, "")
            except UnreadableError:
                continue
        good, bad, unchecked = meaning(sorted({*words.values()}), key)
        if good or bad:
            result.append(Candidate({"line": key}, words, good, bad, unchecked))
    return result


def listing_table(path: Path, form: TextForm) -> Table | None:
    """Return the table of a file beside the recordings, all cells as words; None if it is none."""
    try:
        content = read_file(path)
        if path.suffix.lower() == ".parquet":
            return read_parquet(content, path.name)
        if path.suffix.lower() in (".json", ".jsonl"):
            return joined(read_objects(content, path.name, form), path.name)
        for delimiter in (",", ";", "\t", "|"):
            plain = TextForm(form.encoding, delimiter)
            header = content.decode(form.encoding, "replace").partition("\n")[0]
            if delimiter in header:
                columns = {cell.strip() for cell in header.split(delimiter)}
                return read_text(content, path.name, plain, lambda _: False, columns.__contains__)
    except (UnreadableError, ValueError, LookupError):
        return None
    return None


def in_listings(
    base: Path,
    files: Sequence[str],
    places: Mapping[str, Place],
    parts: Mapping[str, str],
    form: TextForm,
) -> list[Candidate]:
    """Return the candidates in files that list the recordings, by file or by part.

    files : of those beside the recordings. places, parts : of each recording, by its name.
    """
    result = []
    for name in files:
        table = listing_table(base / name, form)
        if table is None:
            continue
        for key in table.columns:
            try:
                listing = read_listing(base, name, key, [*table.columns], form)
            except ValueError:
                continue
            rows = dict[str, Mapping[str, str]]()
            for recording, place in places.items():
                try:
                    rows[recording] = listing.find(place, parts.get(recording, ""))[1][0]
                except UnreadableError:
                    continue
            if len(rows) < len(places) / 2:
                continue
            for column in table.columns:
                words = {recording: row[column] for recording, row in rows.items()}
                different = sorted({*words.values()})
                good, bad, unchecked = meaning(different, column)
                is_named = VERDICT_NAME.search(column) or BAD_NAME.search(column)
                is_short = len(different) <= MOST_WORDS and column != key
                if is_short and (good or bad or is_named):
                    source = {"listing": name, "key": key, "column": column}
                    result.append(Candidate(source, words, good, bad, unchecked))
            break
    return result


def choose(
    candidates: Sequence[Candidate], n: int, notes: dict[str, str], hints: Sequence[str]
) -> tuple[dict[str, Any], list[LabelSource]]:
    """Return the keys of `[label]`, and the sources that must agree with it.

    The first of the candidates that are known is the label if all of them agree, and the others are
    checks; if two disagree, or none is known, the label is `?`, and the note lists them.

    n : recordings that were looked at. hints : columns that may hold labels under other names.
    """
    known = [candidate for candidate in candidates if candidate.is_known]
    shown = "; ".join(candidate.title for candidate in candidates)
    over = f"; over {n:,} recordings"
    differ = [
        (first, second, count)
        for i, first in enumerate(known)
        for second in known[i + 1 :]
        if (count := _disagreements(first, second))
    ]
    if differ:
        first, second, count = max(differ, key=lambda item: item[2])
        notes["label.column"] = (
            f"{first.title} and {second.title} disagree on {count:,} recordings; which is right?"
            f"{over}"
        )
        return {"column": UNKNOWN}, []
    if known:
        best, *others = known
        key = [*best.source][0]
        notes[f"label.{key}"] = (
            best.title.partition(" (")[2].rstrip(")") + f", over {n:,} recordings"
        )
        return best.values(), [_source(other) for other in others]
    if len(candidates) == 1:
        (only,) = candidates
        for meaning_of in ("good", "bad"):
            notes[f"label.{meaning_of}"] = f"which of the words? {only.title}{over}"
        return only.values(), []
    text = f"one of: {shown}" if candidates else "no label was found: state label.column, "
    text += "" if candidates else "label.path, label.line or label.listing"
    text += f"; columns of few words: {listed(hints)}" if hints else ""
    notes["label.column"] = text + over
    return {"column": UNKNOWN}, []


def _disagreements(first: Candidate, second: Candidate) -> int:
    """Return for how many recordings two candidates have different labels."""
    labels, others = first.labels(), second.labels()
    return sum(labels[name] != others[name] for name in labels.keys() & others.keys())


def _source(candidate: Candidate) -> LabelSource:
    """Return a candidate as a source."""
    words = {key: tuple(getattr(candidate, key)) for key in ("good", "bad", "unchecked")}
    return LabelSource(**candidate.source, **words)  # type: ignore[arg-type]
