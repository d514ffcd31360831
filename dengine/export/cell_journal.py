"""What a cell program wrote down of its parts: each line is checked before it is believed, and goes into the store once.

    journal = read_journal("cell.csv", TraceSpec(1000))
    report = import_journal("engine.db", "cell.csv")

A journal begins with `# dengine 3 SUM`, of the export that it belongs to. A line is `part,ID,LABEL,PART,ACTION,PREDICTED,
REASON,LOWER,UPPER,N_SUCCESS,N_FAILURE,SAMPLE,...,CRC` or `label,ID,LABEL,CRC`; several channels stand one after the other.
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

from ..datasets.importing import CHUNK, ImportReport
from ..decision.policy import Policy
from ..errors import DataError, StoreError
from ..folds import own_hash
from ..recipe import Recipe
from ..records import REASONS, Action, Decision, Reason, TraceSpec, source_of, trace_in
from ..store.base import Store, opening
from ..store.records import NewLabel
from ..traces import TraceGate, as_trace

FORM = 3
LABELS = {"1": True, "0": False}
LARGEST_COUNT = 2**62
EXPORTED = "export"  # the kind of the events that record a model's sum


@dataclass(frozen=True, slots=True)
class JournalLine:
    """A part: its trace (C, T), its label, None where nothing was heard of it, and what was decided, as in `Decision`.

    late : whether the label came after the next part was decided on; an accepted part has a line of its own before it then.
    """

    id: str
    trace: NDArray[np.float32]
    label: bool | None
    part: str | None
    action: Action
    predicted: Action
    reason: Reason
    lower: float
    upper: float
    n_success: int
    n_failure: int
    late: bool = False


@dataclass(frozen=True, slots=True)
class Journal:
    """Lines in the order in which they became known; whether the last part was accepted and nothing came after it.

    sum : the SHA-256 of the export that it belongs to.  cut : bytes of a last line that was cut while it was written.
    """

    lines: list[JournalLine]
    waits: bool
    sum: str
    cut: int


def read_journal(path: str | os.PathLike[str], spec: TraceSpec) -> Journal:
    """The lines of a cell program's journal.

    Left out are rejected parts, which went back to the bin, and verified ones of which nothing was heard yet.
    """
    *whole, tail = Path(path).read_bytes().split(b"\n")
    head = whole[0].decode("utf-8", errors="replace").split() if whole else []
    if len(head) != 4 or head[:3] != ["#", "dengine", str(FORM)]:
        raise DataError(
            f"Expected a journal that begins with '# dengine {FORM} SUM', {path} does not; import it with the "
            "dengine whose program wrote it."
        )
    reader = _Reader(spec)
    for number, raw in enumerate(whole[1:], start=2):
        reader.take(raw, f"line {number} of {path}")
    waits = reader.open is not None and reader.open.action is Action.ACCEPT
    reader.settle()
    lines = [line for line in reader.lines if line.label is not None or line.action is Action.ACCEPT]
    if not lines:
        raise DataError(f"{path} holds no labels yet.")
    return Journal(lines, waits, head[3], len(tail))


class _Reader:
    """Takes lines in, one after the other."""

    def __init__(self, spec: TraceSpec) -> None:
        self.spec = spec
        self.lines: list[JournalLine] = []
        self.open: JournalLine | None = None  # the part that was decided on last, while nothing was heard of it
        self._parts: dict[str, JournalLine] = {}  # by id, as known by now

    def take(self, raw: bytes, where: str) -> None:
        """Check one line, and take it in."""
        said, _, crc = raw.rpartition(b",")
        if f"{zlib.crc32(said):08x}".encode() != crc:
            raise DataError(f"The checksum of {where} does not fit it: it is damaged; import the lines before it alone.")
        try:
            kind, *words = said.decode("utf-8").split(",")
        except UnicodeDecodeError as error:
            raise DataError(f"Expected UTF-8 in {where}, got other bytes: it is damaged, or no journal.") from error
        if kind == "part":
            self._take_part(self._part(words, where), where)
        elif kind == "label":
            self._take_label(words, where)
        else:
            raise DataError(f"Expected a line that begins with part or label in {where}, got {kind[:20]!r}.")

    def _take_part(self, line: JournalLine, where: str) -> None:
        if line.id in self._parts:
            raise DataError(
                f"Expected one line of the part {line.id}, {where} is another; the journal was pasted together."
            )
        self.settle()
        self._parts[line.id] = line
        if line.label is None:
            self.open = line
        else:
            self.lines.append(line)

    def settle(self) -> None:
        """The next part comes: no sooner is an accepted one counted of which nothing was heard."""
        if self.open is not None:
            self.lines.append(self.open)
        self.open = None

    def _take_label(self, words: list[str], where: str) -> None:
        if len(words) != 2 or words[0] not in self._parts or words[1] not in LABELS:
            raise DataError(
                f"Expected an earlier part's id and a label of 1 or 0 in {where}, got {','.join(words)[:60]!r}."
            )
        known, label = self._parts[words[0]], LABELS[words[1]]
        if known.action is Action.REJECT or known.label is not None:
            raise DataError(f"Expected one label of a part that was not rejected in {where}, got another of {known.id}.")
        late = known is not self.open
        self._parts[known.id] = replace(known, label=label, late=late)
        self.lines.append(self._parts[known.id])
        if not late:
            self.open = None

    def _part(self, words: list[str], where: str) -> JournalLine:
        id_, label, part, *decided = (*words[:10], *[""] * (10 - len(words)))
        try:
            action, predicted, reason = Action(decided[0]), Action(decided[1]), Reason(decided[2])
            bound = float(decided[3]), float(decided[4]), int(decided[5]), int(decided[6])
        except ValueError as error:
            raise DataError(f"The decision in {where} cannot be read: {error}.") from error
        if not (0.0 <= bound[0] <= bound[1] <= 1.0 and 0 <= min(bound[2:]) <= max(bound[2:]) < LARGEST_COUNT):
            raise DataError(f"Expected bounds between 0 and 1 and counts in {where}, got {','.join(decided[3:7])[:60]!r}.")
        rejected = action is Action.REJECT
        if not id_ or (label not in LABELS and label != "") or (rejected and label != ""):
            raise DataError(f"Expected an id, and a label of 1, 0 or nothing in {where}, got {id_[:20]!r}, {label[:20]!r}.")
        trace = np.zeros((1, 0), dtype=np.float32) if rejected else self._trace(words[10:], where)
        return JournalLine(id_, trace, LABELS.get(label), part or None, action, predicted, reason, *bound)

    def _trace(self, words: list[str], where: str) -> NDArray[np.float32]:
        expected = self.spec.channels * self.spec.samples
        if len(words) != expected and (self.spec.fit == "strict" or not words or len(words) % self.spec.channels):
            raise DataError(f"Expected {expected} samples in {where}, got {len(words)}; it is damaged, or of another cell.")
        try:
            with np.errstate(over="ignore"):
                values = np.array([float(word) for word in words]).astype(np.float32)
        except ValueError as error:
            raise DataError(f"The samples in {where} are no row of numbers: {error}.") from error
        return as_trace(values.reshape(self.spec.channels, -1), self.spec)


def import_journal(
    store: str | os.PathLike[str] | Store,
    path: str | os.PathLike[str],
    on_traces: Callable[[int], None] | None = None,
    any_model: bool = False,
) -> ImportReport:
    """Put what a cell learned into the store of its engine, each part once, however often its journal is imported.

    Rule and certificate count the parts as the engine's own. The report counts labels.
    any_model : take a journal of a model that the store has not noted as exported from it.
    Raises DataError, before anything is stored, for a damaged journal, or one of another store's model; StoreError while an
    engine runs on the cell.
    """
    with opening(store, must_exist=True) as opened:
        opened.own()  # an engine that runs would never learn of these labels
        known = opened.settings()
        spec = trace_in(known)
        if spec is None or "recipe" not in known:
            raise StoreError(
                f"Expected the store that the cell's model was exported from, {store} knows no trace contract."
            )
        policy = Recipe.from_toml(known["recipe"]).policy
        journal = read_journal(path, spec)
        exports = {event.text.split()[0] for event in opened.events() if event.kind == EXPORTED}
        if exports and journal.sum not in exports and not any_model:
            raise DataError(
                f"Expected a journal of a model that was exported from this store, {path} belongs to {journal.sum[:12]}…, "
                "which is none of its exports; name the store that it came from, or say --any-model if it is right."
            )
        lines = _with_known_outcomes(journal, policy.stops)
        report = _import_lines(opened, lines, spec, policy, on_traces)
    opened.close()
    return replace(report, cut=journal.cut)


def _with_known_outcomes(journal: Journal, stops: str) -> list[JournalLine]:
    """Where all stops are reported, the next decision confirmed an accepted part, unless its stop came late.

    Of the last part nothing is known yet.
    """
    if stops == "some":
        return journal.lines
    late = {line.id: line.label for line in journal.lines if line.late}
    waits = next((line for line in reversed(journal.lines) if line.label is None), None) if journal.waits else None
    return [
        replace(line, label=True) if line.label is None else line
        for line in journal.lines
        # A late label has a line of its own: it brings the stop, and the first line the confirmation.
        if line is not waits and not (line.action is Action.ACCEPT and late.get(line.id) == line.late)
    ]


def _import_lines(
    store: Store, lines: list[JournalLine], spec: TraceSpec, policy: Policy, on_traces: Callable[[int], None] | None
) -> ImportReport:
    gate, counts = TraceGate(spec), Counter[str]()
    looks = [gate(torch.from_numpy(line.trace)) for line in lines]
    counts_silence = policy.stops == "some"
    since = int(store.settings().get("policy_since", 0))
    silent = len(store.unreported_accepts(since)) - store.silent_total(since) if counts_silence else 0
    for start in range(0, len(lines), CHUNK):
        labels: list[NewLabel] = []
        for i in range(start, min(start + CHUNK, len(lines))):
            line, (fault, hash_) = lines[i], looks[i]
            held = store.get_decision(line.id)
            if held is None:
                audit, reason = line.reason is Reason.AUDIT, REASONS[fault] if fault else line.reason
                counted = line.lower, line.upper, line.n_success, line.n_failure
                propensity = 1.0 if line.predicted is Action.VERIFY else policy.audited_share
                told = (*counted, None, 0, reason, audit, propensity, line.part)
                decision = Decision(line.id, line.action, line.predicted, *told)
                store.put_decision(decision, line.trace, own_hash(hash_, line.part), bool(fault))
            elif held.source is not None:  # a forgotten one has a label too
                if line.label is not None:
                    counts["known" if line.label == held.success else "contradicted"] += 1
                continue
            if counts_silence and line.action is Action.ACCEPT:  # one that was held without a label was counted as silent
                silent += (line.label is None) - (held is not None)
            if line.label is not None:
                source = source_of(line.id, line.action, line.reason is Reason.AUDIT, line.label)
                labels.append(NewLabel(line.id, line.label, source, 0, None, 0 if fault else silent))
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
