"""What a cell program wrote down of its parts: the lines of its journal, checked, and imported into a store.

    journal = read_journal("cell.csv", TraceSpec(1000))
    journal.lines                                          # parts and labels, in the order in which they became known
    report = import_journal("engine.db", "cell.csv")       # what a cell program learned on its own

A last line without its end was being written when the program was killed: it is left out, and `cut` says so. Anything else
that does not fit is a DataError that names the line.
"""

from __future__ import annotations

import os
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ..datasets.importing import CHUNK, ImportReport, import_ids
from ..decision.policy import Policy
from ..engine.decide import source_of
from ..engine.settings import trace_in
from ..errors import DataError, StoreError
from ..folds import own_hash
from ..recipe import Recipe
from ..records import REASONS, Action, Decision, Reason, TraceSpec
from ..store.base import NewLabel, Store, opening
from ..store.outbox import OwnedStore
from ..traces import TraceGate, as_trace

HEAD = "# dengine "
LABELS = {"1": True, "0": False}
LARGEST_COUNT = 2**62
EXPORTED = "export"  # the kind of the events that note a model's sum


@dataclass(frozen=True, slots=True)
class JournalLine:
    """A part in a cell program's journal: its trace (C, T), its label, and what was decided on it, as in `Decision`.

    label : None where nothing was heard of an accepted part.
    id : of the decision; "" in journals of earlier programs.
    late : whether the label came after the next part was decided on; the part has a line of its own before it then, where
        it was accepted.
    """

    trace: NDArray[np.float32]
    label: bool | None
    part: str | None = None
    action: Action = Action.VERIFY
    predicted: Action = Action.VERIFY
    reason: Reason = Reason.NO_MODEL
    lower: float = 0.0
    upper: float = 1.0
    n_success: int = 0
    n_failure: int = 0
    id: str = ""
    late: bool = False


@dataclass(frozen=True, slots=True)
class Journal:
    """A journal that was read.

    lines : in the order in which they became known.  waits : whether the last part was accepted and nothing came after it.
    version : of its form, 1 to 3.  sum : the SHA-256 of the export that it belongs to; "" where it does not say.
    cut : bytes of a last line that was cut while it was written.
    """

    lines: list[JournalLine]
    waits: bool
    version: int
    sum: str
    cut: int


def read_journal(path: str | os.PathLike[str], spec: TraceSpec) -> Journal:
    """The lines of a cell program's journal.

    Where the first line begins with `# dengine 3`, a line is `part,ID,LABEL,PART,ACTION,PREDICTED,REASON,LOWER,UPPER,
    N_SUCCESS,N_FAILURE,SAMPLE,...,CRC` or `label,ID,LABEL,CRC`. With `# dengine 2` it may be
    `LABEL,PART,ACTION,...,SAMPLE,...` as well, and else it is `LABEL,SAMPLE,...`, of verified parts. Several channels stand
    one after the other. Lines that begin with # are comments.
    """
    *whole, tail = Path(path).read_bytes().split(b"\n")
    version, total = _head(whole[0] if whole else b"")
    reader = _Reader(spec, version)
    for number, raw in enumerate(whole, start=1):
        where = f"line {number} of {path}"
        text = _text(raw, where)
        if text.strip() and not text.startswith("#"):
            reader.take(text.rstrip("\r"), where)
    waits, lines = reader.waits, reader.labelled()
    if not lines:
        raise DataError(f"{path} holds no labels yet.")
    return Journal(lines, waits, version, total, len(tail))


def _head(line: bytes) -> tuple[int, str]:
    words = line.decode("utf-8", errors="replace").removeprefix(HEAD).split() if line.startswith(HEAD.encode()) else []
    if len(words) == 2 and words[0] in ("2", "3"):
        return int(words[0]), words[1]
    if len(words) == 2 and words[0].isdigit():
        raise DataError(f"The journal has form {words[0]}, of a newer program; this dengine reads up to 3: upgrade it.")
    return 1, words[0] if len(words) == 1 else ""


def _text(raw: bytes, where: str) -> str:
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DataError(f"Expected UTF-8 in {where}, got other bytes: it is damaged, or no journal.") from error
    if "\0" in text:
        raise DataError(f"Expected text in {where}, got a NUL byte: it is damaged, or no journal.")
    return text


class _Reader:
    """Takes lines in, one after the other."""

    def __init__(self, spec: TraceSpec, version: int) -> None:
        self.spec, self.version = spec, version
        self.lines: list[JournalLine] = []
        self._parts: dict[str, JournalLine] = {}  # by id, as known by now
        self._open: JournalLine | None = None  # the part that was decided on last, while nothing was heard of it

    @property
    def waits(self) -> bool:
        """Whether the last part was accepted, and nothing came after it."""
        return self._open is not None and self._open.action is Action.ACCEPT

    def labelled(self) -> list[JournalLine]:
        """Without rejected parts, which went back to the bin, and verified ones of which nothing was heard yet."""
        self._settle()
        return [line for line in self.lines if line.label is not None or line.action is Action.ACCEPT]

    def take(self, text: str, where: str) -> None:
        """One line."""
        if self.version > 1 and text.startswith(("part,", "label,")):
            kind, *words = _checked(text, where).split(",")
            if kind == "part":
                self._take_part(self._part(words[1:], words[0], where), where)
            else:
                self._take_label(words, where)
        elif self.version == 2:
            self._take_part(self._part(text.split(","), "", where), where)
        elif self.version == 1:
            self._take_part(self._first_form(text.split(","), where), where)
        else:
            raise DataError(f"Expected a line that begins with part or label in {where}, got {text[:20]!r}.")

    def _take_part(self, line: JournalLine, where: str) -> None:
        if line.id and line.id in self._parts:
            raise DataError(
                f"Expected one line of the part {line.id}, {where} is another; the journal was pasted together."
            )
        self._settle()
        self._parts[line.id] = line
        if line.label is None:
            self._open = line
        else:
            self.lines.append(line)

    def _settle(self) -> None:
        """The next part comes: no sooner is an accepted one counted of which nothing was heard."""
        if self._open is not None:
            self.lines.append(self._open)
        self._open = None

    def _take_label(self, words: list[str], where: str) -> None:
        if len(words) != 2 or not words[0] or words[0] not in self._parts or words[1] not in LABELS:
            raise DataError(
                f"Expected an earlier part's id and a label of 1 or 0 in {where}, got {','.join(words)[:60]!r}."
            )
        known, label = self._parts[words[0]], LABELS[words[1]]
        if known.action is Action.REJECT or known.label is not None:
            raise DataError(f"Expected one label of a part that was not rejected in {where}, got another of {known.id}.")
        late = known is not self._open
        self._parts[known.id] = replace(known, label=label, late=late)
        self.lines.append(self._parts[known.id])
        if not late:
            self._open = None

    def _part(self, words: list[str], id_: str, where: str) -> JournalLine:
        label, part, *decided = (*words[:9], *[""] * (9 - len(words)))
        try:
            action, predicted = Action(decided[0]), Action(decided[1])
            bound = float(decided[3]), float(decided[4]), int(decided[5]), int(decided[6])
            reason = Reason(decided[2])
        except (ValueError, IndexError) as error:
            raise DataError(f"The decision in {where} cannot be read: {error}.") from error
        if not (0.0 <= bound[0] <= bound[1] <= 1.0 and 0 <= min(bound[2:]) <= max(bound[2:]) < LARGEST_COUNT):
            raise DataError(f"Expected bounds between 0 and 1 and counts in {where}, got {','.join(decided[3:7])[:60]!r}.")
        rejected = action is Action.REJECT and bool(id_) and label == ""
        unheard = label == "" and (action is Action.ACCEPT or bool(id_))
        if (action is Action.REJECT and not rejected) or not (unheard or label in LABELS):
            raise DataError(
                f"Expected a verified part with a label of 1 or 0, or an accepted one, in {where}, got {label!r}."
            )
        trace = np.zeros((1, 0), dtype=np.float32) if rejected else _trace(words[9:], self.spec, where)
        return JournalLine(trace, LABELS.get(label), part or None, action, predicted, reason, *bound, id_)

    def _first_form(self, words: list[str], where: str) -> JournalLine:
        trace = _trace(words[1:], self.spec, where)
        if words[0] not in LABELS:
            raise DataError(f"Expected a label of 1 or 0 in {where}, got {words[0][:20]!r}.")
        return JournalLine(trace, LABELS[words[0]])


def _checked(text: str, where: str) -> str:
    """A line without its CRC, which fits."""
    said, _, crc = text.rpartition(",")
    if f"{zlib.crc32(said.encode()):08x}" != crc:
        raise DataError(f"The checksum of {where} does not fit it: it is damaged; import the lines before it alone.")
    return said


def _trace(words: list[str], spec: TraceSpec, where: str) -> NDArray[np.float32]:
    expected = spec.channels * spec.samples
    if len(words) != expected and (spec.fit == "strict" or not words or len(words) % spec.channels):
        raise DataError(f"Expected {expected} samples in {where}, got {len(words)}; it is damaged, or of another cell.")
    try:
        with np.errstate(over="ignore"):
            values = np.array([_number(word) for word in words]).astype(np.float32)
    except ValueError as error:
        raise DataError(f"The samples in {where} are no row of numbers: {error}.") from error
    return as_trace(values.reshape(spec.channels, -1), spec)


def _number(word: str) -> float:
    if "_" in word:
        raise ValueError(
            f"could not convert string to float: {word!r}"
        )  # Python's own numbers have them, a cell's have not
    return float(word)


def import_journal(
    store: str | os.PathLike[str] | Store,
    path: str | os.PathLike[str],
    on_traces: Callable[[int], None] | None = None,
    any_model: bool = False,
) -> ImportReport:
    """Put what a cell learned into the store of its engine, each part once, however often its journal is imported.

    Parts keep their numbers, the bounds that they were decided by and the sources of their labels, so that the rule and the
    certificate count them as the engine's own. The report counts labels.
    any_model : take a journal of a model that the store has not noted as exported from it.
    Raises DataError, before anything is stored, for a journal that is damaged, or of a model of another store; StoreError
    while an engine runs on the cell.
    """
    with opening(store, must_exist=True) as opened:
        if isinstance(opened, OwnedStore):
            opened.own()  # an engine that runs would never learn of these labels
        known = opened.settings()
        spec = trace_in(known)
        if spec is None or "recipe" not in known:
            raise StoreError(
                f"Expected the store that the cell's model was exported from, {store} knows no trace contract."
            )
        policy = Recipe.from_toml(known["recipe"]).policy
        journal = read_journal(path, spec)
        if not any_model:
            _must_be_of(opened, journal, path)
        lines = _with_known_outcomes(journal, policy.stops)
        report = _import_lines(opened, lines, spec, policy, on_traces)
    opened.close()
    return replace(report, cut=journal.cut)


def _must_be_of(store: Store, journal: Journal, path: str | os.PathLike[str]) -> None:
    """DataError where a journal's model was not exported from the store. Earlier forms are of exports not noted always."""
    exports = {event.text.split()[0] for event in store.events() if event.kind == EXPORTED}
    if journal.version > 2 and exports and journal.sum not in exports:
        raise DataError(
            f"Expected a journal of a model that was exported from this store, {path} belongs to {journal.sum[:12]}…, "
            "which is none of its exports; name the store that it came from, or say --any-model if it is right."
        )


def _with_known_outcomes(journal: Journal, stops: str) -> list[JournalLine]:
    """Where all stops are reported, the next decision confirmed an accepted part, unless its stop came late.

    Of the last part nothing is known yet.
    """
    if stops == "some":
        return journal.lines
    late = {line.id: line.label for line in journal.lines if line.late}
    waits = [line for line in journal.lines if line.label is None][-1:] if journal.waits else []
    return [
        replace(line, label=True) if line.label is None else line
        for line in journal.lines
        if not any(line is each for each in waits) and not _is_elsewhere(line, late.get(line.id) if line.id else None)
    ]


def _is_elsewhere(line: JournalLine, late: bool | None) -> bool:
    """Whether another line brings an accepted part's label: the late one its stop, the first one its confirmation."""
    return line.action is Action.ACCEPT and late is not None and line.late == late


def _import_lines(
    store: Store, lines: list[JournalLine], spec: TraceSpec, policy: Policy, on_traces: Callable[[int], None] | None
) -> ImportReport:
    gate, counts = TraceGate(spec), Counter[str]()
    looks = [gate(torch.from_numpy(line.trace)) for line in lines]
    made = import_ids(np.array([hash_ for _, hash_ in looks], dtype=np.int64))
    ids = [line.id or id_ for line, id_ in zip(lines, made, strict=True)]
    counts_silence = policy.stops == "some"
    since = int(store.settings().get("policy_since", 0))
    silent = len(store.unreported_accepts(since)) - store.silent_total(since) if counts_silence else 0
    for start in range(0, len(lines), CHUNK):
        labels: list[NewLabel] = []
        for i in range(start, min(start + CHUNK, len(lines))):
            line, (fault, hash_), held = lines[i], looks[i], store.get_decision(ids[i])
            if held is None:
                decision = _decided(ids[i], line, fault, policy.audit_rate)
                store.put_decision(decision, line.trace, own_hash(hash_, line.part), bool(fault), line.part)
            elif held.source is not None:  # a forgotten one has a label too
                if line.label is not None:
                    counts["known" if line.label == held.success else "contradicted"] += 1
                continue
            if counts_silence and line.action is Action.ACCEPT:  # one that was held without a label was counted as silent
                silent += (line.label is None) - (held is not None)
            if line.label is not None:
                source = source_of(ids[i], line.action, line.reason is Reason.AUDIT, line.label)
                labels.append(NewLabel(ids[i], line.label, source, 0, None, 0 if fault else silent))
                silent = silent if fault else 0
                counts["quarantined" if fault else "imported"] += 1
        if labels:
            store.put_labels(labels)
        if on_traces is not None:
            on_traces(min(CHUNK, len(lines) - start))
    store.flush()
    return ImportReport(
        counts["imported"], counts["quarantined"], counts["known"], True, contradicted=counts["contradicted"]
    )


def _decided(id_: str, line: JournalLine, fault: int, audit_rate: float) -> Decision:
    audit, reason = line.reason is Reason.AUDIT, REASONS[fault] if fault else line.reason
    counted = line.lower, line.upper, line.n_success, line.n_failure
    propensity = 1.0 if line.predicted is Action.VERIFY else audit_rate
    return Decision(id_, line.action, line.predicted, *counted, None, 0, reason, audit, propensity, line.part)
