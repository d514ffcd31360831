"""Journals of exported cells: `read_journal` reads and checks what a cell program wrote, and
`import_journal` imports it into the engine's store, each part once, however often. The subcommand
`dengine import-labels` calls it.

    journal = read_journal("cell.csv", TraceSpec(1000))
    report = import_journal("engine.db", "cell.csv")

A journal begins with `# dengine 4 SUM`, the sum of the export that it belongs to. A line is
`part,ID,LABEL,PART,ACTION,PREDICTED,REASON,LOWER,UPPER,N_SUCCESS,N_FAILURE,SAMPLE,...,CRC` or
`label,ID,LABEL,CRC`; the samples of several channels follow one another. CRC is the CRC-32 of all
lines so far, each without its own. If it does not fit, a line was changed, or is missing, doubled
or moved: that line and all after it are set aside. FILE.head beside the journal has the number of
its lines and the last CRC; if it knows of a line that the journal lacks, the journal says so, and a
missing head is logged. A last line without its end was being written when the program was killed:
it is left out. A line that fits its checksum was written by a cell. If it cannot be read, for
example because its traces have another shape, DataError is raised and names the line.
"""

import zlib
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..datasets.importing import ImportReport, import_parts
from ..errors import DataError, StoreError, TraceError, instead, log
from ..files import FilePath
from ..recipe import Recipe
from ..records import Action, Decision, Reason, TraceArray, TraceSpec, stored_trace_spec
from ..store.opening import opening
from ..traces import as_trace
from .bundle import sibling_path

if TYPE_CHECKING:
    from ..store.opening import StoreLike

FORM = 4
LABELS = {"1": True, "0": False, "": None}
EXPORTED = "export"  # the kind of the events that record a model's sum


@dataclass(frozen=True, slots=True)
class JournalLine:
    """A part as a journal has it.

    Attributes
    ----------
    decision : Decision
        Without what a journal lacks: the embedding is None, the model version 0, the propensity 1.
    trace : array of float32, shape (C, T)
        Empty for a rejected part, shape (1, 0).
    label : bool or None
        True good, False bad; None if no outcome was reported.
    late : bool
        Whether the label came after the next part was decided. An accepted part then also has an
        earlier JournalLine, without the label.
    """

    decision: Decision
    trace: TraceArray
    label: bool | None
    late: bool = False


@dataclass(frozen=True, slots=True)
class CellJournal:
    """The checked content of a journal.

    Attributes
    ----------
    lines : list of JournalLine
        Accepted parts and labelled parts, in the order in which their outcomes became known.
    pending : JournalLine or None
        The last part, if its outcome is not known; the last of `lines` if it was accepted.
    sum : str
        SHA-256 of the export that the journal belongs to.
    cut : int
        Bytes of a last line that was not finished.
    set_aside : str
        What was set aside, in a sentence; "" if nothing was.
    """

    lines: list[JournalLine]
    pending: JournalLine | None
    sum: str
    cut: int
    set_aside: str


def read_journal(path: FilePath, spec: TraceSpec) -> CellJournal:
    """Read and check the journal that the program of an exported model wrote in a robot cell.

    The journal has a line for each part and each later label. Parts without a label are left out
    unless they were accepted. If the label of an accepted part came after the next part was
    decided, the result has two lines for it: one without a label, and later one with it (`late`). A
    last line that was not finished is left out; `cut` of the result is its length in bytes.

    The first line whose checksum does not fit, and all lines after it, are set aside without an
    error, and `set_aside` of the result says so (or the DataError, if nothing of use is left). If
    all lines fit, they are compared with FILE.head, which holds the number of lines and the last
    checksum: `set_aside` then says if lines are missing at the end. If FILE.head is missing or
    cannot be read, a warning is logged.

    Parameters
    ----------
    path : path-like
    spec : TraceSpec
        What the traces must be; other lengths are cut, padded, resampled or refused, as `spec.fit`
        says.

    Returns
    -------
    CellJournal
        Its `lines` are the accepted and the labelled parts, in the order in which their outcomes
        became known.

    Raises
    ------
    DataError
        For a file that is no journal of format 4, the present one (`FORM`), a line whose checksum
        fits but which cannot be read as `spec` says or has the label of a part without a line, or a
        journal with neither an accepted nor a labelled part.
    OSError
        If the file cannot be read.
    """
    *rows, tail = Path(path).read_bytes().split(b"\n")
    head = rows[0].decode("utf-8", errors="replace").split() if rows else []
    if len(head) != 4 or head[:3] != ["#", "dengine", str(FORM)]:
        raise DataError(
            f"Expected a journal that begins with '# dengine {FORM} SUM', {path} does not; import "
            "it with the dengine whose program wrote it."
        )
    lines: list[JournalLine] = []
    parts: dict[str, JournalLine] = {}  # by id, with the label so far
    pending: JournalLine | None = None  # the part decided last, until its label comes
    set_aside = ""
    crc = zlib.crc32(rows[0])
    crcs = [crc]
    for number, row in enumerate(rows[1:], start=2):
        where = f"line {number} of {path}"
        content, _, written_crc = row.rpartition(b",")
        crc = zlib.crc32(content, crc)
        if f"{crc:08x}".encode() != written_crc:
            set_aside = (
                f"The checksum of {where} does not follow from the lines before it: it was "
                "changed, or one is missing, doubled or moved. It and what follows were set aside, "
                f"{len(rows) - number + 1} lines."
            )
            break
        crcs.append(crc)
        with (
            instead(
                DataError,
                f"{where} is no line of this store's cell",
                ValueError,
                LookupError,
                TraceError,
            ),
            np.errstate(over="ignore"),  # a sample beyond float32 is infinite
        ):
            kind, *words = content.decode().split(",")
            if kind == "part":
                line = _parse_part(words, spec)
                # Only when the next part comes is an accepted one of unknown outcome counted.
                lines += filter(None, [pending])
                pending = line if line.label is None else None
            else:
                line = replace(parts[words[0]], label=LABELS[words[1]])
                if pending is not None and pending.decision.id == line.decision.id:
                    pending = None
                else:
                    line = replace(line, late=True)
        parts[line.decision.id] = line
        if line.label is not None:
            lines.append(line)
    lines = [
        line
        for line in filter(None, [*lines, pending])
        if line.label is not None or line.decision.action is Action.ACCEPT
    ]
    if not lines:
        raise DataError(set_aside or f"{path} holds no labels yet.")
    set_aside = set_aside or _missing_at_end(path, crcs)
    return CellJournal(lines, pending, head[3], len(tail), set_aside)


def _missing_at_end(path: FilePath, crcs: list[int]) -> str:
    """Return a sentence if a journal lacks the line that its head names, else "".

    The head is the file PATH.head; it holds a number of lines and the checksum of the last of them.
    `crcs` are the checksums of the journal's lines, the first line included. If the head is missing
    or cannot be read, a warning is logged and "" is returned.
    """
    head = sibling_path(path, "head")
    risk = "lines may have been removed at its end, or lost with the power."
    try:
        number, crc = head.read_text(encoding="ascii").split()
        has_line = int(crc, 16) in crcs[: int(number)][int(number) - 1 :]
    except (OSError, ValueError):
        log.warning(
            "%s, which knows how long the journal is, is missing or cannot be read: %s", head, risk
        )
        return ""
    return "" if has_line else f"{path} does not hold line {number}, which its head knows: {risk}"


def _parse_part(words: list[str], spec: TraceSpec) -> JournalLine:
    """Return the decision, trace and label of a part from the words of its line in a journal.

    The first word, "part", and the checksum are left out; `words` are id, label ("1", "0" or "" for
    none), number of the part, action, predicted action, reason, lower, upper, n_success, n_failure,
    and the samples, channel after channel. The trace of a rejected part is empty, (1, 0); other
    traces are fitted as `spec.fit` says. The embedding, the model version and the propensity (the
    probability of a check) are not in the line; they become None, 0 and 1. Raises ValueError,
    LookupError or TraceError for words that are no such line.
    """
    id_, label, part, action, predicted, reason, lower, upper, successes, failures, *samples = words
    decision = Decision(
        id=id_,
        action=Action(action),
        predicted=Action(predicted),
        lower=float(lower),
        upper=float(upper),
        n_success=int(successes),
        n_failure=int(failures),
        embedding=None,
        model_version=0,
        reason=Reason(reason),
        audit=reason == Reason.AUDIT.value,
        propensity=1.0,
        part=part or None,
    )
    trace = np.zeros((1, 0), dtype=np.float32)
    if decision.action is not Action.REJECT:
        trace = as_trace(np.array(samples, dtype=np.float32).reshape(spec.channels, -1), spec)
    return JournalLine(decision, trace, LABELS[label])


def import_journal(store: "StoreLike", path: FilePath, any_model: bool = False) -> ImportReport:
    """Import the journal of a robot cell that ran an exported model into the store of its engine.

    The journal is the file in which the exported program wrote its parts. A part that was imported
    before is not imported again, but its label is, if it has none yet; a label that contradicts the
    stored one is only counted. A part whose trace has a fault is stored, but never used in
    training. New rows have the time of the import. The decision rule, and the certificate (a bound
    on the share of bad accepted parts), count imported parts like the engine's own. The policy that
    the store has now gives each part its propensity (the probability of a check), and `stops`.
    Under `stops="all"` (every bad accepted part is reported) an accepted part without a report is
    imported as good, unless it is the journal's last part; under "some" it is imported without a
    label. Other parts without a label are left out. If a line is missing or was changed, only the
    lines before it are imported. A store that was passed open stays open; on PostgreSQL it owns the
    cell until it is closed.

    Parameters
    ----------
    store : str, path-like or SqlStore
        The store that the model was exported from.
    path : path-like
        The journal.
    any_model : bool, default False
        Whether to take a journal of a model whose export this store has not recorded as an event. A
        store without any export event takes every journal.

    Returns
    -------
    ImportReport
        It counts labels; `cut` and `set_aside` say what was not imported.

    Raises
    ------
    DataError
        For a file that is no journal, has neither an accepted nor a labelled part, or has a line
        that cannot be read, and for a journal of another model. Nothing is stored then.
    StoreError
        If there is no store, an engine runs on the cell, or the store has no `TraceSpec` or recipe.
        Also if the store fails; chunks of 500 parts that were stored before stay.
    SettingError
        If this version cannot read the store's recipe.
    OSError
        If the journal cannot be read.
    """
    # The cell is claimed, since an engine that runs would never learn these labels.
    with opening(store, must_exist=True) as opened, closing(opened.claim_cell()):
        settings = opened.settings.read()
        spec = stored_trace_spec(settings)
        if spec is None or "recipe" not in settings:
            raise StoreError(
                f"Expected the store that the model was exported from, {store} has no TraceSpec or "
                "no recipe."
            )
        policy = Recipe.from_toml(settings["recipe"]).policy
        journal = read_journal(path, spec)
        exports = {
            event.text.split()[0] for event in opened.events.newest() if event.kind == EXPORTED
        }
        if exports and journal.sum not in exports and not any_model:
            raise DataError(
                "Expected a journal of a model that was exported from this store, "
                f"{path} belongs to {journal.sum[:12]}…, which is none of its exports; "
                "name the store that it came from, or say --any-model if it is right."
            )
        parts = [
            (line.decision, line.trace, line.label)
            for line in _with_known_outcomes(journal, policy.stops)
        ]
        report = import_parts(opened, parts, spec, policy)
    if opened is not store:
        opened.close()
    return replace(report, cut=journal.cut, set_aside=journal.set_aside)


def _with_known_outcomes(journal: CellJournal, stops: str) -> list[JournalLine]:
    """Return the lines of a journal, with the labels of accepted parts that were not reported.

    If `stops` is "some" (not every bad accepted part is reported), the lines are returned as they
    are. If it is "all", an accepted part without a label gets the label good, because the next part
    was decided; the last part, if its outcome is not known yet (`journal.pending`), is left out. An
    accepted part whose label came late has two lines, and only one is returned: the late line if it
    says bad, else the first line, with the label good. If an accepted part has several labels, the
    lines that say bad are returned, else the first line.
    """
    if stops == "some":
        return journal.lines
    stopped = {line.decision.id for line in journal.lines if line.late and not line.label}
    lines = []
    for line in journal.lines:
        is_accept = line.decision.action is Action.ACCEPT
        is_superseded = line.label is not False if line.decision.id in stopped else line.late
        if line is not journal.pending and not (is_accept and is_superseded):
            lines.append(replace(line, label=True) if line.label is None else line)
    return lines
