"""The records that a store takes and returns: decisions, labels, traces, versions, events,
corrections. Beside these dataclasses the file has their conversion to the rows of a table and back
(`to_row`, `from_row`; the columns of a table are the fields of its record, see schema.py), that of
arrays to bytes (`pack`, `to_npz`), the errors for reports on unknown or labelled decisions, the
address of a cell in a store (`CellAddress`), and the rule for which versions keep their arrays
(`keeps_state`). The store and the engine use it.
"""

import io
import json
import os
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from enum import StrEnum
from functools import lru_cache, partial
from types import UnionType
from typing import Any, NamedTuple, Self, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from ..decision.certificate import Outcomes as Outcomes  # counted by every store
from ..errors import (
    DataError,
    ReportConflictError,
    ReportError,
    StoreError,
    UnknownDecisionError,
    instead,
    shortened,
)
from ..files import FilePath, read_archive
from ..records import Action, Arrays, Decision, Ints, RetrainReport, Source, State, TraceArray

# Kinds of events.
SAFE_MODE_BEGAN = "safe mode"
SAFE_MODE_ENDED = "safe mode ended"
POLICY_CHANGED = "policy"  # its data holds the old and the new policy
POLICY_KINDS = (POLICY_CHANGED, "shadow")  # the second is of stores from version 1.0
DATA_LOST = "lost"  # an alarm until the next event ACKNOWLEDGED
ACKNOWLEDGED = "acknowledged"
LOSS_REMEDY = (
    "Report the outcomes of that time again, then end this alarm: dengine verify STORE "
    "--acknowledge."
)
T = TypeVar("T")
Clock = Callable[[], float]  # returns the time, in seconds since 1970
Row = dict[str, Any]  # the values of a row, by column
Settings = Mapping[str, str]  # an engine's, as texts, by name
LabelNumbers = list[tuple[str, int]]  # ids of decisions, with the numbers of their labels
EntryName = tuple[int, str]  # number and digest, hexadecimal, of a ledger entry
NO_TRACE: TraceArray = np.zeros((0, 0), dtype=np.float32)
LABEL_TEXTS = {True: "success", False: "failure", None: "a forgotten label"}
# The first label and a second one that replaces it: silence confirmed the part, then it stopped the
# line.
LATE_STOP = (True, Source.CONFIRMED), (False, Source.STOP)
LABEL_WORDS = {True: "good", False: "bad", None: "none"}
FORGOTTEN = 2  # beside 0 and 1: a label that takes part in nothing any more
CHUNK = 500  # rows sent or fetched at a time
KEEP = 5  # newest versions that keep their states
# Prefixes of the arrays in a version's state that its own cell's outcomes taught its rule.
RULE = ("rule.", "rule_is_stale", "rule_last_seq", "includes_overdue", "overdue_to")
# Columns of `StoredDecision` in the table `decision`, beside those of `Decision`.
OF_DECISION = ("content_hash", "quarantined", "time")


def _when(record: Any) -> datetime:
    """Return a record's time as a datetime in UTC."""
    return datetime.fromtimestamp(record.time, UTC)


def unknown_decision(decision_id: str) -> UnknownDecisionError:
    """Return the error for the id of a decision that the store does not hold."""
    return UnknownDecisionError(
        f"Expected the id of a stored decision, got {shortened(decision_id)}, which this cell's "
        "store does not hold; give the `Decision.id` that `decide` returned, to the same store "
        "and cell_id."
    )


def already_reported(
    decision_id: str, first: tuple[bool | None, Source], second: tuple[bool, Source]
) -> ReportConflictError:
    """Return the error for a second label of a decision; it names both labels.

    If both have the same success, its advice is that nothing more needs reporting. Otherwise it is
    to correct the first label if that was wrong, or if it was forgotten and is to count again.

    Parameters
    ----------
    decision_id : str
    first, second : (bool, Source)
        Success and source of the label that stands, and of the one that came now. None in the place
        of the first success is a forgotten label (withdrawn by a person), which only a correction
        brings back.

    Returns
    -------
    ReportConflictError
    """
    stored, new = (
        f"{LABEL_TEXTS[success]} from {source.value}" for success, source in (first, second)
    )
    advice = "nothing more needs reporting"
    if first[0] is None:
        advice = "if it is to count again, correct it (`dengine correct`)"
    elif first[0] != second[0]:
        advice = "if the first was wrong, correct it (`dengine correct`)"
    return ReportConflictError(
        f"Expected one report a decision, got a second on {decision_id!r}: {stored} was reported "
        f"first and stands, now came {new}; {advice}."
    )


def nothing_to_correct(decision_id: str) -> ReportError:
    """Return the error for a correction (a change of a label) of a decision that has no label."""
    return ReportError(
        f"Expected a decision with a label, got {decision_id!r}, of which nothing was reported "
        "yet; there is nothing to correct: report its label."
    )


def as_text(text: str) -> str:
    """Return a text with escapes for what a database refuses: NUL, and half a surrogate pair."""
    return text.encode("utf-8", "backslashreplace").decode().replace("\0", "\\0")


def check_state(report: RetrainReport, state: Arrays | None) -> State | None:
    """Check a version's arrays and return copies of them, by name; None if `state` is None.

    A version is a trained model. Raise StoreError if `report.accepted` is True (the version is to
    be put in force) and `state` is None, and for an array of Python objects, which would need a
    pickle.
    """
    if state is None:
        if report.accepted:
            raise StoreError(
                f"Expected the arrays of accepted version {report.version}, got None; pass its "
                "state."
            )
        return None
    copies = {name: np.array(values) for name, values in state.items()}
    for name, values in copies.items():
        if values.dtype.hasobject:
            raise StoreError(f"Expected plain arrays, not {name!r}, which has {values.dtype}.")
    return copies


@dataclass(frozen=True, slots=True)
class NewLabel:
    """A label on its way into a store.

    Attributes
    ----------
    decision_id : str
    success : bool
    source : Source
    model_version : int
        The version in force when the label came.
    point : array of float32, shape (d,), or None
        Where the trace was added to that version's references; None if it was not added.
    silent : int
        Number of accepted parts since the previous label of which nothing was reported.
    time : float
        When the label was reported, in seconds since 1970.
    content_hash : int
        Of its decision.
    decided : float
        When its decision was made, in seconds since 1970.
    overdue_to : int or None
        Number of the newest decision whose check was overdue when the rule was updated with this
        label; None if unknown.
    seq : int
        Number of the label in its cell's journal, 1, 2, ...; the store keeps it. 0 or less: the
        store gives the next number of the robot cell, or of its product.
    """

    decision_id: str
    success: bool
    source: Source
    model_version: int
    point: NDArray[np.float32] | None
    silent: int = 0
    time: float = 0.0
    content_hash: int = 0
    decided: float = 0.0
    overdue_to: int | None = None
    seq: int = 0


@dataclass(frozen=True, slots=True)
class StoredDecision:
    """A decision as a store holds it, with its label.

    Two are equal if all their fields but `trace` and `number` are.

    Attributes
    ----------
    decision : Decision
    trace : array of float32, shape (C, T)
        Shape (0, 0) where decisions are listed without their traces.
    content_hash : int
        Signed 64 bit hash of the trace's content, or of the part's number where one was given. It
        determines the trace's permanent fold. Traces with the same hash have one vote together.
    quarantined : bool
        The trace is stored and never used in training.
    time : float
        Of the decision, in seconds since 1970.
    success : bool or None
        The label after corrections; None without a label, and if the label was forgotten.
    source : Source or None
        Of the label, a forgotten one included; None without a label.
    label_seq : int or None
        Number of the label.
    label_time : float or None
        When the label came, in seconds since 1970.
    number : int
        Number of the decision, 1, 2, ... in each robot cell; 0 if unknown.
    """

    decision: Decision = field(metadata={"flat": True})
    trace: TraceArray = field(repr=False, compare=False, metadata={"apart": True})
    content_hash: int
    quarantined: bool
    time: float = 0.0
    success: bool | None = None
    source: Source | None = None
    label_seq: int | None = None
    label_time: float | None = None
    number: int = field(default=0, repr=False, compare=False, metadata={"apart": True})

    when = property(_when)

    @property
    def label(self) -> str:
        """The label after corrections in a word: good, bad or none; none if it was forgotten."""
        return LABEL_WORDS[self.success]

    def with_label(self, label: NewLabel) -> Self:
        """Return a copy that has the success and the source of a label, not its number and time."""
        return replace(self, success=label.success, source=label.source)


@dataclass(frozen=True, slots=True)
class LabelledTraces:
    """Labelled traces, oldest label first, without the quarantined ones.

    Attributes
    ----------
    seq : array of int64, shape (n,)
        Numbers of the labels, increasing.
    traces : array of float32, shape (n, C, T)
        Shape (0, 0, 0) if there are none.
    labels : array of int8, shape (n,)
        1 for success, 0 for failure.
    hashes : array of int64, shape (n,)
        Content hash of each, as in `StoredDecision`.
    """

    seq: Ints
    traces: TraceArray
    labels: NDArray[np.int8]
    hashes: Ints

    def rows(self) -> Iterator[tuple[int, TraceArray, int, int]]:
        """Return an iterator over the labelled traces, oldest label first.

        Each item is (number of the label, trace of shape (C, T), label, content hash); all but the
        trace are Python integers.
        """
        return zip(
            self.seq.tolist(), self.traces, self.labels.tolist(), self.hashes.tolist(), strict=True
        )


class OutcomeRecord(NamedTuple):
    """The outcome of one part, as a decision rule is updated with it.

    Attributes
    ----------
    seq : int
        Number of the label; 0 for an overdue check.
    lower, upper : float
        Bounds of the success rate by which the part was decided.
    success : bool
        The label.
    novel : bool
        Whether the part was decided as novel, `Reason.NOVEL`.
    silent : int
        Number of accepted parts since the previous label of which nothing was reported.
    predicted : int
        `ActionCode` of what the model alone would have done.
    inclusion_probability : float
        Probability, fixed beforehand, that this part's outcome would be asked for.
    """

    seq: int
    lower: float
    upper: float
    success: bool
    novel: bool
    silent: int
    predicted: int
    inclusion_probability: float


def overdue_outcomes(decision: Decision) -> list[OutcomeRecord]:
    """Return the outcomes with which a decision rule is updated for an overdue check.

    A check is overdue if no report has come within `Policy.label_within` later decisions. Until it
    comes the rule counts the worst. If the decision had evidence for success (`lower`, the lower
    bound of the success probability, is above 0), there is an outcome "failure", with this lower
    bound, and 1 as the upper one; its `predicted` is ACCEPT if the model alone would have accepted
    the part. If it had evidence for failure (`upper` < 1), there is then an outcome "success", with
    0 as the lower bound, and the decision's upper one; its `predicted` is REJECT if the model alone
    would have rejected the part. Otherwise `predicted` is VERIFY. It is given as an `ActionCode`: 0
    VERIFY, 1 ACCEPT, 2 REJECT. So there are none, one or two outcomes. All have label number 0
    (`seq`), are not novel (unlike all training traces), count no unreported accepted parts
    (`silent` 0), and have the inclusion probability of the decision, with which a check was asked
    for.
    """
    probability = decision.inclusion_probability
    outcomes = []
    if decision.lower > 0.0:
        accepts = int(decision.predicted is Action.ACCEPT)
        outcomes.append(
            OutcomeRecord(0, decision.lower, 1.0, False, False, 0, accepts, probability)
        )
    if decision.upper < 1.0:
        rejects = 2 * int(decision.predicted is Action.REJECT)
        outcomes.append(OutcomeRecord(0, 0.0, decision.upper, True, False, 0, rejects, probability))
    return outcomes


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened to an engine, for people to read.

    Attributes
    ----------
    number : int
        1, 2, ... in each robot cell.
    time : float
        In seconds since 1970.
    kind : str
        A word, for example `SAFE_MODE_BEGAN`.
    text : str
    data : dict or None
        The same for machines, as JSON has it.
    author : str
        Who did it; "" for the engine itself.
    """

    number: int
    time: float
    kind: str
    text: str
    data: dict[str, Any] | None = None
    author: str = ""

    when = property(_when)


def new_event(
    kind: str, text: str, time: float, data: Mapping[str, Any] | None = None, author: str = ""
) -> Event:
    """Return an event that is not numbered yet, in texts and data that every database takes.

    Its number is 0. In `kind`, `text` and `author` a NUL and half a surrogate pair become escapes;
    `data` is copied as if it was written to JSON and read: a tuple becomes a list, and a key that
    is a number, a bool or None becomes a text. Nothing is stored. Raise StoreError for data that
    JSON does not have, NaN and infinity included.
    """
    with instead(
        StoreError,
        "Expected an event's data as JSON has it",
        TypeError,
        ValueError,
        do="give numbers and text",
    ):
        copied = None if data is None else json.loads(json.dumps(dict(data), allow_nan=False))
    return Event(0, float(time), as_text(kind), as_text(text), copied, as_text(author))


def open_losses(events: Iterable[Any]) -> list[Any]:
    """Return the events of kind DATA_LOST (records are lost) that no later ACKNOWLEDGED ended.

    With one ACKNOWLEDGED a person confirms all losses that came before. `events` are events of a
    robot cell, or their rows, oldest first; so is the result.
    """
    losses: list[Any] = []
    for event in events:
        if event.kind == ACKNOWLEDGED:
            losses.clear()
        elif event.kind == DATA_LOST:
            losses.append(event)
    return losses


@dataclass(frozen=True, slots=True)
class Change:
    """A change that a person makes: one event and everything it changes, committed together.

    Attributes
    ----------
    kind, text, data, author
        Of the event, as in `Event`.
    decisions : sequence of str
        Ids of the decisions whose labels are corrected.
    success : bool or None
        The new label of these; None: their labels are forgotten.
    version : (RetrainReport, int, mapping) or None
        A version that replaces the present one: its report, its newest label, its arrays.
    settings : mapping or None
        New settings, all of them; None leaves the present ones.
    """

    kind: str
    text: str
    data: Mapping[str, Any] | None = None
    author: str = ""
    decisions: Sequence[str] = ()
    success: bool | None = None
    version: tuple[RetrainReport, int, Arrays] | None = None
    settings: Settings | None = None


@dataclass(frozen=True, slots=True)
class Correction:
    """A correction of a label. Nothing is overwritten: the newest correction of a decision counts.

    Attributes
    ----------
    number : int
        1, 2, ... in each robot cell, or product.
    time : float
        In seconds since 1970.
    decision_id : str
    success : bool or None
        The label from now on; None: the label is forgotten, and counts nowhere.
    was : bool or None
        The label until then; None if it was forgotten.
    author : str
    event : int
        Number of the event that records it.
    newest_seq : int
        Number of the newest label of the cell, or product, at that moment.
    seq : int
        Number of the label that is corrected.
    content_hash : int
        Of its decision, see `StoredDecision`.
    """

    number: int
    time: float
    decision_id: str
    success: bool | None
    was: bool | None
    author: str
    event: int
    newest_seq: int
    seq: int
    content_hash: int = field(metadata={"apart": True})  # JavaScript has no integers of 64 bits


@dataclass(frozen=True, slots=True)
class ModelVersion:
    """A version of the model that was put in force, with its arrays.

    Attributes
    ----------
    version : int
    last_seq : int
        Number of the newest label among its references.
    state : dict of str to array
        Weights, references, ids of the training traces, state of the rule.
    """

    version: int
    last_seq: int
    state: State


def without_rule(state: Arrays) -> State:
    """Return a version's arrays without those of its rule, which its own cell's outcomes set.

    They are left out by the prefixes of RULE; the mapping is not changed.
    """
    return {name: values for name, values in state.items() if not name.startswith(RULE)}


class CellAddress(str):
    """A store's file or URL together with a robot cell; accepted wherever a store's name is.

    Attributes
    ----------
    cell_id : str
    product : str or None
        What the cell makes; None: as the store says, or nothing shared.
    """

    cell_id: str
    product: str | None

    def __new__(cls, url: str, cell_id: str, product: str | None = None) -> Self:
        """Return a text equal to `url`, with robot cell and product as its attributes."""
        address = super().__new__(cls, url)
        address.cell_id = cell_id
        address.product = product
        return address


def address(store: FilePath, cell_id: str | None, product: str | None = None) -> str:
    """Return a store's file or URL as text; a `CellAddress` if a robot cell or product is given.

    A `CellAddress` is a text with the attributes `cell_id` and `product` (what the cell makes;
    cells of one product share labels and versions). If only a product is given, or `cell_id` is "",
    the cell is named "cell". If neither is given, a `store` that is a `CellAddress` already is
    returned unchanged; otherwise its own cell and product are both dropped, even if only one is
    given.
    """
    url = os.fspath(store)
    return (
        url if cell_id is None and product is None else CellAddress(url, cell_id or "cell", product)
    )


@lru_cache
def columns(record_type: Any) -> dict[str, tuple[type, bool]]:
    """Return, by name, the type of each field of a record class, and whether it may be None.

    A record class is a dataclass or NamedTuple with type hints. The type is a plain one: that of
    `dict[str, int]` is `dict`, and that of a union is its first. A union must be written with `|`,
    and have None as the last. The result is cached; do not change it.
    """
    return {
        name: (_plain_type(hint), isinstance(hint, UnionType))
        for name, hint in get_type_hints(record_type).items()
    }


def _plain_type(hint: Any) -> type:
    """Return the class of a type hint, of a union's first: `dict` for `dict[str, int] | None`."""
    if isinstance(hint, UnionType):
        return _plain_type(get_args(hint)[0])
    plain = get_origin(hint) or hint
    # A `type` statement names its type here; NumPy's NDArray is one on Python 3.12 and later.
    return _plain_type(plain.__value__) if hasattr(plain, "__value__") else plain


def to_row(record: Any, *names: str) -> Row:
    """Return the fields of a record as columns of a row, by name; only `names` if they are given.

    Enumerations become text, tuples and dicts JSON text, arrays the bytes of float32, without their
    shape (`pack`). None stays None, and other values are converted to the type of their field.
    Raise ValueError or TypeError for a value that cannot be converted, and AttributeError for a
    name that the record does not have.
    """
    record_type: Any = type(record)
    fields = columns(record_type)
    return {name: _to_column(getattr(record, name), fields[name][0]) for name in names or fields}


def from_row(record_type: Callable[..., T], row: Mapping[str, Any], **given: Any) -> T:
    """Make a record from a row that `to_row` wrote.

    Parameters
    ----------
    record_type : type
        Class of the record, a dataclass or NamedTuple.
    row : mapping of str to value
        It may have more columns, and may lack those that are given or have a default.
    **given
        Values of fields that replace those of the row.

    Returns
    -------
    record_type

    Raises
    ------
    StoreError
        If the row lacks a field, or a value cannot be converted to the type of its field. Fields of
        type str, int and float take any value, unchecked, a field of type bool takes the truth of
        any value, and every field takes None.
    """
    try:
        values = {
            name: _from_column(row[name], type_)
            for name, (type_, _) in columns(record_type).items()
            if name in row and name not in given
        }
        return record_type(**values, **given)
    except (ValueError, TypeError) as error:
        raise StoreError(
            f"Expected a row of {record_type.__name__} as it was written, got another: {error}; "
            "see `dengine verify`, and restore the store from a copy."
        ) from error


def _to_column(value: Any, type_: type) -> Any:
    """Return the value of a field for its column: a text, number, JSON text or packed float32.

    None stays None. `type_` is the type of the field. An enumeration becomes its text. For a tuple
    or dict any value that JSON can hold is written, whatever its type; for an array AttributeError
    is raised if the value is no array. For any other type the value is converted to it. ValueError,
    TypeError or OverflowError is raised if a value cannot be converted or written.
    """
    if value is None:
        return None
    if issubclass(type_, StrEnum):
        return type_(value).value
    as_json = partial(json.dumps, default=float)
    writers: dict[type, Any] = {tuple: as_json, dict: as_json, np.ndarray: pack}
    return writers.get(type_, type_)(value)


def _from_column(value: Any, type_: type) -> Any:
    """Return the value of a field from the column that `_to_column` wrote.

    `type_` is the type of the field. None stays None, and a value of a str, int or float field is
    returned unchecked. A tuple or a dict is read from JSON; a tuple must hold sequences, and
    becomes a tuple of tuples. An array becomes a flat array of float32. Any other type is called
    with the value. Raise ValueError or TypeError for a value that cannot be converted.
    """
    if value is None or type_ in (str, int, float):
        return value
    if type_ is tuple:
        return tuple(tuple(row) for row in json.loads(value))
    readers: dict[type, Any] = {dict: json.loads, np.ndarray: unpack}
    return readers.get(type_, type_)(value)


def decision_row(item: StoredDecision) -> Row:
    """Return the row of the table `decision` for a decision, without number, label and trace."""
    return to_row(item.decision) | to_row(item, *OF_DECISION)


def trace_row(item: StoredDecision) -> Row:
    """Return the row of the table `trace` for a decision, without `cell_id`.

    It has the decision's id, the shape of its trace, and the samples as bytes of float32.
    """
    channels, samples = item.trace.shape
    return {
        "decision_id": item.decision.id,
        "channels": channels,
        "samples": samples,
        "data": pack(item.trace),
    }


def read_decision(row: Any) -> StoredDecision:
    """Return the decision of a row of the table `decision`, with its label and trace if selected.

    Without the trace's columns its trace has shape (0, 0), without the label's columns it has no
    label. Raise StoreError for a field that cannot be read. That the trace is as it was stored must
    have been checked (`is_intact`): ValueError or TypeError is raised for damaged bytes.
    """
    values = row._mapping
    trace = unpack(row.data).reshape(row.channels, row.samples) if "data" in values else NO_TRACE
    return from_row(StoredDecision, values, decision=from_row(Decision, values), trace=trace)


def pack(values: NDArray[np.float32]) -> bytes:
    """Return the values as bytes of little-endian float32, in C order, without their shape."""
    return values.astype("<f4", copy=False).tobytes()


def unpack(blob: bytes) -> NDArray[np.float32]:
    """Return what `pack` wrote as a new flat array of float32, empty for b"".

    Raise ValueError if the number of bytes is no multiple of 4.
    """
    return np.frombuffer(blob, dtype="<f4").astype(np.float32)


def chunks(rows: Sequence[T]) -> Iterator[Sequence[T]]:
    """Return an iterator over the rows in pieces of at most CHUNK, in their order."""
    return (rows[start : start + CHUNK] for start in range(0, len(rows), CHUNK))


def to_npz(state: Arrays) -> bytes:
    """Return arrays as the bytes of an npz file; unlike `np.savez` it takes any name.

    Arrays of integers are compressed, because they repeat many values. Others, like weights or
    booleans, are not. Raise ValueError for an array of Python objects.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, values in state.items():
            info = zipfile.ZipInfo(f"{name}.npy")
            if values.dtype.kind in "iu":
                info.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(info, "w", force_zip64=True) as member:
                np.save(member, values, allow_pickle=False)
    return buffer.getvalue()


def from_npz(blob: bytes, name: str) -> State:
    """Return the arrays that `to_npz` wrote, by name.

    Raise StoreError for anything else, for a pickle, and for arrays that need too much memory (more
    than 8 GiB, or than half of the machine's memory); `name` is the name of the store, for the
    message.
    """
    with instead(
        StoreError,
        "Expected a version of plain arrays",
        DataError,
        do=f"restore {name} from a copy",
    ):
        return read_archive(blob, name=f"a version in {name}")[0]


@dataclass(frozen=True, slots=True)
class StoredVersion:
    """A retrain as a store lists it, also if its version was dropped (not put in force).

    Attributes
    ----------
    number : int
        Number of the retrain: 1, 2, ... in each robot cell, or product.
    time : float
        In seconds since 1970.
    last_seq : int
        Number of the newest label that it knew of.
    report : RetrainReport
    n_bytes : int
        Size of its state; 0 if none is kept.
    kept : bool
        Whether its state is kept, so that `VersionTable.load` loads it unless it is damaged.
    """

    number: int
    time: float
    last_seq: int
    report: RetrainReport
    n_bytes: int = 0
    kept: bool = False

    when = property(_when)


def keeps_state(version: int, newest: int, keep: int | None) -> bool:
    """Return whether a version keeps its state when `newest` is the newest version.

    A version is a trained model, and its state its stored arrays. The first version, number 1, and
    the `keep` newest keep it (None: all do). Of older versions ever fewer do: of the newest hundred
    those whose number is divisible by 10, of the other ones of the newest thousand those whose
    number is divisible by 100, and so on. So the number of states grows with the logarithm of the
    number of versions.
    """
    age = newest - version
    if keep is None or version == 1 or age < keep:
        return True
    step = 10
    while age >= 10 * step:
        step *= 10
    return version % step == 0
