"""What a cell program wrote down of its parts: each line is checked before it is believed, and goes into the store once.

    journal = read_journal("cell.csv", TraceSpec(1000))
    report = import_journal("engine.db", "cell.csv")

A journal begins with `# dengine 4 SUM`, of the export that it belongs to. A line is `part,ID,LABEL,PART,ACTION,PREDICTED,
REASON,LOWER,UPPER,N_SUCCESS,N_FAILURE,SAMPLE,...,CRC` or `label,ID,LABEL,CRC`; several channels stand one after the other.
CRC is the CRC-32 of all lines so far, each without its own: where it does not fit, a line was changed, or is missing,
doubled or moved. That line and what follows are set aside, and `aside` says so. FILE.head beside it has the number of its
lines and the last CRC: of a line that is not held `aside` tells too; a missing head is logged. A last line without its end
was being written when the program was killed: it is left out, and `cut` says so. Anything else that does not fit is a
DataError that names the line.
"""

import logging
import os
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..datasets.dataset import expect_data
from ..datasets.importing import ImportReport, import_parts
from ..errors import DataError, StoreError, instead
from ..recipe import Recipe
from ..records import Action, Decision, Reason, TraceSpec, stored_trace_spec
from ..store.opening import opening
from ..traces import as_trace

if TYPE_CHECKING:
    from ..store.opening import StoreLike

log = logging.getLogger("dengine")
FORM = 4
LABELS = {"1": True, "0": False}
LARGEST_COUNT = 2**62
EXPORTED = "export"  # the kind of the events that record a model's sum


@dataclass(frozen=True, slots=True)
class JournalLine:
    """A part: what was decided, its trace (C, T), and its label, None where nothing was heard of it.

    late : whether the label came after the next part was decided on; an accepted part has a line of its own before it then.
    """

    decision: Decision
    trace: NDArray[np.float32]
    label: bool | None
    late: bool = False


@dataclass(frozen=True, slots=True)
class Journal:
    """Lines in the order in which they became known.

    waits : the last part, where it was accepted and nothing came after it.
    sum : the SHA-256 of the export that it belongs to.  cut : bytes of a last line that was cut while it was written.
    aside : what was set aside, in a sentence; "" where nothing was.
    """

    lines: list[JournalLine]
    waits: JournalLine | None
    sum: str
    cut: int
    aside: str = ""


def read_journal(path: str | os.PathLike[str], spec: TraceSpec) -> Journal:
    """The lines of a cell program's journal.

    Left out are rejected parts, which went back to the bin, and verified ones of which nothing was heard yet.
    """
    *whole, tail = Path(path).read_bytes().split(b"\n")
    head = whole[0].decode("utf-8", errors="replace").split() if whole else []
    if len(head) != 4 or head[:3] != ["#", "dengine", str(FORM)]:
        do = "import it with the dengine whose program wrote it"
        raise DataError(f"Expected a journal that begins with '# dengine {FORM} SUM', {path} does not; {do}.")
    lines: list[JournalLine] = []
    parts: dict[str, JournalLine] = {}  # by id, as known by now
    last: list[JournalLine] = []  # the part that was decided on last, while nothing was heard of it
    aside, crc = "", zlib.crc32(whole[0])
    crcs = [crc]
    for number, raw in enumerate(whole[1:], start=2):
        where = f"line {number} of {path}"
        said, _, sum_ = raw.rpartition(b",")
        crc = zlib.crc32(said, crc)
        if f"{crc:08x}".encode() != sum_:
            why = f"The checksum of {where} does not follow from the lines before it: it was changed, or one is missing"
            aside = f"{why}, doubled or moved. It and what follows were set aside, {len(whole) - number + 1} lines."
            break
        crcs.append(crc)
        kind, *words = _words(said, where)
        if kind == "part":
            line = _part(words, spec, where)
            again = line.decision.id in parts
            wanted = f"one line of each part, in {where}"
            expect_data(not again, wanted, line.decision.id, "the journal was pasted together")
            lines += last  # the next part comes: no sooner is an accepted one counted of which nothing was heard
            last = [line] if line.label is None else []
        else:
            line = _labelled(words, parts, where)
            line = replace(line, late=line.decision.id not in [each.decision.id for each in last])
            last = last if line.late else []
        parts[line.decision.id] = line
        lines += [line] if line.label is not None else []
    waits = next((line for line in last if line.decision.action is Action.ACCEPT), None)
    lines = [line for line in [*lines, *last] if line.label is not None or line.decision.action is Action.ACCEPT]
    if not lines:
        raise DataError(aside or f"{path} holds no labels yet.")
    aside = aside or _missing_at_end(path, crcs)
    return Journal(lines, waits, head[3], len(tail), aside)


def _missing_at_end(path: str | os.PathLike[str], crcs: list[int]) -> str:
    """Of lines that a journal's head knows and the journal does not hold, in a sentence; "" where it holds them."""
    head, end = Path(f"{os.fspath(path)}.head"), "lines may have been removed at its end, or lost with the power."
    try:
        number, crc = head.read_text(encoding="ascii").split()
        held = int(crc, 16) in crcs[int(number) - 1 :][:1]
    except (OSError, ValueError):
        log.warning("%s, which knows how long the journal is, is missing or cannot be read: %s", head, end)
        return ""
    return "" if held else f"{path} does not hold line {number}, which its head knows: {end}"


def _words(said: bytes, where: str) -> list[str]:
    with instead(DataError, f"Expected UTF-8 in {where}, it is damaged, or no journal", UnicodeDecodeError):
        words = said.decode("utf-8").split(",")
    expect_data(words[0] in ("part", "label"), f"a line that begins with part or label in {where}", words[0])
    return words


def _labelled(words: list[str], parts: Mapping[str, JournalLine], where: str) -> JournalLine:
    held = len(words) == 2 and words[0] in parts and words[1] in LABELS
    expect_data(held, f"an earlier part's id and a label of 1 or 0 in {where}", ",".join(words))
    known = parts[words[0]]
    held = known.decision.action is not Action.REJECT and known.label is None
    expect_data(held, f"one label of a part that was not rejected in {where}", words[0])
    return replace(known, label=LABELS[words[1]])


def _part(words: list[str], spec: TraceSpec, where: str) -> JournalLine:
    id_, label, part, *decided = (*words[:10], *[""] * (10 - len(words)))
    with instead(DataError, f"The decision in {where} cannot be read", ValueError):
        action, predicted, reason = Action(decided[0]), Action(decided[1]), Reason(decided[2])
        bound = float(decided[3]), float(decided[4]), int(decided[5]), int(decided[6])
    held = 0.0 <= bound[0] <= bound[1] <= 1.0 and 0 <= min(bound[2:]) <= max(bound[2:]) < LARGEST_COUNT
    expect_data(held, f"bounds between 0 and 1 and counts in {where}", ",".join(decided[3:7]))
    rejected = action is Action.REJECT
    held = id_ != "" and (label == "" or (label in LABELS and not rejected))
    expect_data(held, f"an id, and a label of 1, 0 or nothing in {where}", (id_, label))
    trace = np.zeros((1, 0), dtype=np.float32) if rejected else _trace(words[10:], spec, where)
    known = (*bound, None, 0, reason, reason is Reason.AUDIT, 1.0, part or None)
    return JournalLine(Decision(id_, action, predicted, *known), trace, LABELS.get(label))


def _trace(words: list[str], spec: TraceSpec, where: str) -> NDArray[np.float32]:
    expected = spec.channels * spec.samples
    held = len(words) == expected or (spec.fit != "strict" and len(words) > 0 and len(words) % spec.channels == 0)
    expect_data(held, f"{expected} samples in {where}", len(words), "it is damaged, or of another cell")
    with instead(DataError, f"The samples in {where} are no row of numbers", ValueError), np.errstate(over="ignore"):
        values = np.array([float(word) for word in words]).astype(np.float32)
    return as_trace(values.reshape(spec.channels, -1), spec)


def import_journal(store: "StoreLike", path: str | os.PathLike[str], any_model: bool = False) -> ImportReport:
    """Put what a cell learned into the store of its engine, each part once, however often its journal is imported.

    Rule and certificate count the parts as the engine's own. The report counts labels. Of a journal that lacks a line, what
    stands before is taken: `ImportReport.set_aside`.
    any_model : take a journal of a model that the store has not noted as exported from it.
    Raises DataError, before anything is stored, for a line that cannot be read, and a journal of another store's model;
    StoreError while an engine runs on the cell.
    """
    with opening(store, must_exist=True) as opened:
        opened.claim_cell()  # an engine that runs would never learn of these labels
        known = opened.settings()
        spec = stored_trace_spec(known)
        if spec is None or "recipe" not in known:
            raise StoreError(f"Expected the store that the model was exported from, {store} knows no trace contract.")
        policy = Recipe.from_toml(known["recipe"]).policy
        journal = read_journal(path, spec)
        exports = {event.text.split()[0] for event in opened.events() if event.kind == EXPORTED}
        if exports and journal.sum not in exports and not any_model:
            of = f"{path} belongs to {journal.sum[:12]}…, which is none of its exports"
            do = "name the store that it came from, or say --any-model if it is right"
            raise DataError(f"Expected a journal of a model that was exported from this store, {of}; {do}.")
        parts = [(line.decision, line.trace, line.label) for line in _with_known_outcomes(journal, policy.stops)]
        report = import_parts(opened, parts, spec, policy)
    opened.close()
    return replace(report, cut=journal.cut, set_aside=journal.aside)


def _with_known_outcomes(journal: Journal, stops: str) -> list[JournalLine]:
    """Where all stops are reported, the next decision confirmed an accepted part, unless its stop came late.

    Of the last part nothing is known yet.
    """
    if stops == "some":
        return journal.lines
    late = {line.decision.id: line.label for line in journal.lines if line.late}
    return [
        replace(line, label=True) if line.label is None else line
        for line in journal.lines
        # A late label has a line of its own: it brings the stop, and the first line the confirmation.
        if line is not journal.waits
        and not (line.decision.action is Action.ACCEPT and late.get(line.decision.id) == line.late)
    ]
