"""What stores take and hand back: decisions, labels, traces, versions, events; and how a row holds each."""

import io
import json
import os
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from functools import lru_cache, partial
from types import UnionType
from typing import Any, NamedTuple, Self, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from ..decision.certificate import Outcomes as Outcomes  # counted by every store
from ..errors import DataError, ReportConflictError, ReportError, StoreError, UnknownDecisionError, instead, shortened
from ..files import read_archive
from ..records import Action, Decision, RetrainReport, Source

SAFE_MODE_BEGAN, SAFE_MODE_ENDED = "safe mode", "safe mode ended"  # kinds of events
POLICY_CHANGED, SHADOW_CHANGED = "policy", "shadow"  # kinds of events whose data holds the old and the new policy
T = TypeVar("T")
NO_TRACE: NDArray[np.float32] = np.zeros((0, 0), dtype=np.float32)
LATE_STOP = (True, Source.CONFIRMED), (False, Source.STOP)  # what stands, and what comes: silence was no success after all
FORGOTTEN = 2  # beside 0 and 1: a label that takes no part any more
CHUNK = 500  # rows sent or fetched at a time
KEEP = 5  # newest versions that keep their states
# Beginnings of names in a version's state: what its maker's parts taught its rule.
RULE = ("rule.", "untold", "told_to", "owed", "overdue_to")
OF_DECISION = ("content_hash", "quarantined", "time")  # of a `StoredDecision`, beside the decision itself


def _when(record: Any) -> datetime:
    """`time` as a datetime in UTC."""
    return datetime.fromtimestamp(record.time, UTC)


def unknown_decision(decision_id: str) -> ReportError:
    """Return the error for a report on a decision that the store does not hold."""
    got = f"{shortened(decision_id)}, which this cell's store does not hold"
    do = "report the `Decision.id` that `decide` returned, to the same store and cell_id"
    return UnknownDecisionError(f"Expected the id of a stored decision, got {got}; {do}.")


def already_reported(decision_id: str, first: tuple[bool, Source], second: tuple[bool, Source]) -> ReportError:
    """Return the error for a second label; it names the first, which stands."""
    said, says = (f"{'success' if success else 'failure'} from {source.value}" for success, source in (first, second))
    same = first[0] == second[0]
    advice = "nothing more needs reporting" if same else "if the first was wrong, look at how the part was checked"
    both = f"{said} was reported first and stands, now came {says}"
    return ReportConflictError(f"Expected one report a decision, got a second on {decision_id!r}: {both}; {advice}.")


def nothing_to_correct(decision_id: str) -> ReportError:
    """Return the error for a correction of a decision that was never reported."""
    got = f"{decision_id!r}, of which nothing was reported yet"
    return ReportError(f"Expected a decision with a label, got {got}; there is nothing to correct: report its label.")


def as_data(data: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Return an event's data as it comes back from JSON; a StoreError for what JSON has not."""
    with instead(StoreError, "Expected an event's data as JSON has it", TypeError, ValueError, do="give numbers and text"):
        return None if data is None else dict(json.loads(json.dumps(dict(data), allow_nan=False)))


def as_text(text: str) -> str:
    """Return a text for people, with escapes for what a database refuses: NUL, and half a surrogate pair."""
    return text.encode("utf-8", "backslashreplace").decode().replace("\0", "\\0")


def check_state(report: RetrainReport, state: Mapping[str, NDArray[Any]] | None) -> dict[str, NDArray[Any]] | None:
    """Copy a version's arrays; an accepted version needs them, and none may hold Python objects (a pickle)."""
    if state is None and report.accepted:
        raise StoreError(f"Expected the arrays of accepted version {report.version}, got None; pass its state.")
    copies = None if state is None else {name: np.array(values) for name, values in state.items()}
    for name, values in (copies or {}).items():
        if values.dtype.hasobject:
            raise StoreError(f"Expected plain arrays, got dtype {values.dtype} for {name!r}; store numbers or strings.")
    return copies


@dataclass(frozen=True, slots=True)
class NewLabel:
    """A label on its way into a store.

    point : (d,) where the trace joined the references of `model_version`; None where it did not.
    silent : accepted parts that went on since the previous label, and of which nothing was heard.
    time : when it was reported, in seconds.  content_hash, decided : of its decision, and when that was.
    overdue_to : number of the newest decision whose check was overdue when the rule was told of the
        label; None where that is not known.
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


@dataclass(frozen=True, slots=True)
class StoredDecision:
    """A decision as a store holds it, with the label that counts.

    trace : (C, T) float32; (0, 0) where a list of decisions leaves it out.
    content_hash : signed 64 bit, of the trace's content, or of its part's number where one is given. It deals the
        permanent fold, and says who may vote once: equal traces share it, or the traces of one part.
    quarantined : kept, but never given to training.
    time : of the decision, in seconds.
    success, source : the label as it counts, if one was reported: of a corrected one the newest correction's, of a
        forgotten one None, beside the source that it had.
    label_seq, label_time : number of the label, and when it came.
    number : of the decision, 1, 2, ... in each cell; 0 where that is not known.
    """

    decision: Decision = field(metadata={"flat": True})
    trace: NDArray[np.float32] = field(repr=False, compare=False, metadata={"apart": True})
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
        """good, bad or none."""
        return "none" if self.success is None else "good" if self.success else "bad"


@dataclass(frozen=True, slots=True)
class Labelled:
    """Labelled traces without the quarantined ones, oldest label first.

    seq : (n,) label sequence numbers, increasing.
    traces : (n, C, T); (0, 0, 0) where there is none.
    labels : (n,) 1 success, 0 failure.
    hashes : (n,) content hashes: of the trace's content, or of its part's number where one is given.
    """

    seq: NDArray[np.int64]
    traces: NDArray[np.float32]
    labels: NDArray[np.int8]
    hashes: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class News:
    """What became known in a product.

    labelled : labels of all its cells, this one's too, oldest first, as they count now.
    version : number of its newest accepted version; 0 before the first.  correction : of its newest one; 0 likewise.
    """

    labelled: Labelled
    version: int
    correction: int = 0


class Evidence(NamedTuple):
    """What became of a decision, as a rule is told of it.

    seq : number of its label, which is `success`; 0 where a check is overdue.
    lower, upper : the bound that it was decided by.
    novel : whether it was decided as unlike all that was learned from, `Reason.NOVEL`.
    silent : accepted parts of which nothing was heard between the previous label and this one.
    predicted : position in `Action` of what the model alone would have done.  looked : as `Decision.inclusion_probability`.
    """

    seq: int
    lower: float
    upper: float
    success: bool
    novel: bool
    silent: int
    predicted: int
    looked: float


def overdue_evidence(decision: Decision) -> list[Evidence]:
    """Return what a rule is told of a check that was not reported in time: the decision was wrong, whichever it was."""
    told = []
    if decision.lower > 0.0:
        accepts = int(decision.predicted is Action.ACCEPT)
        told.append(Evidence(0, decision.lower, 1.0, False, False, 0, accepts, decision.inclusion_probability))
    if decision.upper < 1.0:
        rejects = 2 * int(decision.predicted is Action.REJECT)
        told.append(Evidence(0, 0.0, decision.upper, True, False, 0, rejects, decision.inclusion_probability))
    return told


@dataclass(frozen=True, slots=True)
class Event:
    """What happened to an engine, for people; number : 1, 2, ... in each cell.  time : in seconds.

    data : the same for machines, as JSON has it; None where there is none.  author : who did it; "" for the engine itself.
    """

    number: int
    time: float
    kind: str
    text: str
    data: dict[str, Any] | None = None
    author: str = ""

    when = property(_when)


@dataclass(frozen=True, slots=True)
class Change:
    """What a person changed, on its way into a store: one event, and what it changes, all or none.

    kind, text, data, author : of the event.
    decisions : whose labels are corrected to `success`, None for a forgotten one.
    version : the retrain's report, its newest label, its state, of a version that takes the present one's place.
    settings : in the place of the present ones; None leaves these.
    """

    kind: str
    text: str
    data: Mapping[str, Any] | None = None
    author: str = ""
    decisions: Sequence[str] = ()
    success: bool | None = None
    version: tuple[RetrainReport, int, Mapping[str, NDArray[Any]]] | None = None
    settings: Mapping[str, str] | None = None


@dataclass(frozen=True, slots=True)
class Correction:
    """A later word on a label. Nothing is overwritten: the newest one of a decision counts.

    number : 1, 2, ... in each cell.  time : in seconds.
    success : the label from now on; None: it is forgotten, and takes no part in anything that is learned or counted.
    was : the label until then, None likewise.
    author : who said so.  event : number of its event.  newest_seq : number of the cell's newest label at that moment.
    seq : number of the label that it corrects.
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


@dataclass(frozen=True, slots=True)
class ModelVersion:
    """A model that was swapped in.

    last_seq : newest label that its references hold.
    state : weights, references, training ids: plain arrays by name.
    """

    version: int
    last_seq: int
    state: dict[str, NDArray[Any]]


def without_rule(state: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """A version's arrays but for what its maker's own parts taught its rule."""
    return {name: values for name, values in state.items() if not name.startswith(RULE)}


class CellAddress(str):
    """A store's file or URL, and whose rows of it: wherever the name of a store is taken, this is too.

    cell_id : the cell.  product : what it makes; None: as the store says, or nothing that is shared.
    """

    cell_id: str
    product: str | None

    def __new__(cls, url: str, cell_id: str, product: str | None = None) -> Self:
        made = super().__new__(cls, url)
        made.cell_id, made.product = cell_id, product
        return made


def address(store: str | os.PathLike[str], cell_id: str | None = None, product: str | None = None) -> str:
    """A store's file or URL with its cell and product, as far as they were given."""
    url = os.fspath(store)
    return url if cell_id is None and product is None else CellAddress(url, cell_id or "cell", product)


@lru_cache
def columns(kind: Any) -> dict[str, tuple[type, bool]]:
    """The fields of a record by name: the type that a column holds, and whether None is a value too."""
    found: dict[str, tuple[type, bool]] = {}
    for name, hint in get_type_hints(kind).items():
        kinds = [each for each in (get_args(hint) if isinstance(hint, UnionType) else (hint,)) if each is not type(None)]
        found[name] = (get_origin(kinds[0]) or kinds[0], isinstance(hint, UnionType))
    return found


def to_row(record: Any, *names: str) -> dict[str, Any]:
    """A record's fields as a row holds them; names : these alone."""
    of: Any = type(record)
    kinds = columns(of)
    return {name: _written(getattr(record, name), kinds[name][0]) for name in names or kinds}


def from_row(kind: Callable[..., T], row: Mapping[str, Any], **given: Any) -> T:
    """The record that `to_row` wrote; a row may hold more, and lack what is given or has a default.

    Raises StoreError for what was not written so.
    """
    wanted = {name: each for name, (each, _) in columns(kind).items() if name in row and name not in given}
    try:
        return kind(**{name: _read(row[name], each) for name, each in wanted.items()}, **given)
    except (ValueError, TypeError) as error:
        name, do = getattr(kind, "__name__", kind), "see `dengine verify`, and restore the store from a copy"
        raise StoreError(f"Expected a row of {name} as it was written, got another: {error}; {do}.") from error


def _written(value: Any, kind: type) -> Any:
    if value is None:
        return None
    if issubclass(kind, StrEnum):
        return kind(value).value
    as_json = partial(json.dumps, default=float)
    writers: dict[type, Callable[[Any], Any]] = {tuple: as_json, dict: as_json, np.ndarray: pack}
    return writers.get(kind, kind)(value)


def _read(value: Any, kind: type) -> Any:
    if value is None or kind in (str, int, float):
        return value
    if kind is tuple:
        return tuple(tuple(row) for row in json.loads(value))
    readers: dict[type, Callable[[Any], Any]] = {dict: json.loads, np.ndarray: unpack}
    return readers.get(kind, kind)(value)


def decision_row(item: StoredDecision) -> dict[str, Any]:
    return to_row(item.decision) | to_row(item, *OF_DECISION)


def trace_row(item: StoredDecision) -> dict[str, Any]:
    channels, samples = item.trace.shape
    return {"decision_id": item.decision.id, "channels": channels, "samples": samples, "data": pack(item.trace)}


def read_decision(row: Any) -> StoredDecision:
    """A row of `decision`, joined with its label where it has one, and with its trace where it is wanted."""
    held = row._mapping
    trace = unpack(row.data).reshape(row.channels, row.samples) if "data" in held else NO_TRACE
    return from_row(StoredDecision, held, decision=from_row(Decision, held), trace=trace)


def pack(values: NDArray[np.float32]) -> bytes:
    """Values as little-endian float32, without their shape."""
    return values.astype("<f4", copy=False).tobytes()


def unpack(blob: bytes) -> NDArray[np.float32]:
    """What `pack` wrote, flat."""
    return np.frombuffer(blob, dtype="<f4").astype(np.float32)


def chunks(rows: Sequence[T]) -> Iterator[Sequence[T]]:
    """The rows in parts of at most CHUNK."""
    return (rows[start : start + CHUNK] for start in range(0, len(rows), CHUNK))


def to_npz(state: Mapping[str, NDArray[Any]]) -> bytes:
    """Arrays as an npz file; written member by member, since `np.savez` reserves the name `file`."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, values in state.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                np.save(member, values, allow_pickle=False)
    return buffer.getvalue()


def from_npz(blob: bytes, name: str) -> dict[str, NDArray[Any]]:
    """What `to_npz` wrote; a pickle in it is refused."""
    with instead(StoreError, "Expected a version of plain arrays", DataError, do=f"restore {name} from a copy"):
        return read_archive(blob, name=f"a version in {name}")[0]


class VersionError(StoreError):
    """A version whose state is not kept, or is damaged; the store itself is well."""


@dataclass(frozen=True, slots=True)
class StoredVersion:
    """A retrain as a store lists it: 1, 2, ... in each cell, or product.

    time : in seconds.  last_seq : the newest label that it knew of.
    n_bytes : of its state; 0 where none is kept.  kept : whether `load_version` can load it.
    """

    number: int
    time: float
    last_seq: int
    report: RetrainReport
    n_bytes: int = 0
    kept: bool = False

    when = property(_when)


def keeps_state(version: int, newest: int, keep: int | None) -> bool:
    """Say whether a version keeps its state: the first, the `keep` newest (None: all), and of older ones ever fewer.

    Of the newest hundred every tenth, of the newest thousand every hundredth, and so on: what is kept grows with the
    logarithm of what was trained.
    """
    age = newest - version
    if keep is None or version == 1 or age < keep:
        return True
    step = 10
    while age >= 10 * step:
        step *= 10
    return version % step == 0
