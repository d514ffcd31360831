"""What every store checks before it takes something, and the errors that it says alike."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ReportError, StoreError
from ..labels import LONGEST
from ..records import Decision, RetrainReport, Source
from ..wording import shortened


def unknown_decision(decision_id: str, hint: str = "") -> ReportError:
    """Return the error for a report on a decision that the store does not hold."""
    return ReportError(
        f"Expected the id of a stored decision, got {shortened(decision_id)}, which this cell's store does not hold; "
        f"report the `Decision.id` that `decide` returned, to the same store and cell_id.{hint}"
    )


def already_reported(decision_id: str, first: tuple[bool, Source], second: tuple[bool, Source]) -> ReportError:
    """Return the error for a second label; it names the first, which stands."""
    said, says = (f"{'success' if success else 'failure'} from {source.value}" for success, source in (first, second))
    same = first[0] == second[0]
    advice = "nothing more needs reporting" if same else "if the first was wrong, look at how the part was checked"
    return ReportError(
        f"Expected one report a decision, got a second on {decision_id!r}: {said} was reported first and stands, "
        f"now came {says}; {advice}."
    )


def nothing_to_correct(decision_id: str) -> ReportError:
    """Return the error for a correction of a decision that was never reported."""
    return ReportError(
        f"Expected a decision with a label, got {decision_id!r}, of which nothing was reported yet; "
        "there is nothing to correct: report its label."
    )


def as_data(data: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Return an event's data as it comes back from JSON; a StoreError for what JSON has not."""
    if data is None:
        return None
    try:
        text = json.dumps(dict(data), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise StoreError(
            f"Expected an event's data as JSON has it, got {data!r}: {error}; give numbers and text."
        ) from error
    plain: dict[str, Any] = json.loads(as_text(text))
    return plain


def as_channels(trace: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a float32 copy of a trace, (T,) or (C, T) -> (C, T); the caller's buffer may change afterwards."""
    copy = np.array(trace, dtype=np.float32, order="C", ndmin=2)
    if copy.ndim != 2:
        raise StoreError(f"Expected a trace of shape (C, T), got {copy.shape}; store one trace at a time.")
    return copy


def as_hash(content_hash: int) -> int:
    """Return a content hash as a signed 64-bit integer, which is what a database holds."""
    value = int(content_hash)
    if not -(2**63) <= value < 2**63:
        raise StoreError(f"Expected a content hash of signed 64 bits, got {value}; view it as int64.")
    return value


def as_point(point: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
    """Return a float32 copy of an embedded point, (d,)."""
    if point is None:
        return None
    copy = np.array(point, dtype=np.float32, order="C")
    if copy.ndim != 1:
        raise StoreError(f"Expected a point of shape (d,), got {copy.shape}; flatten it before it is stored.")
    return copy


def as_part(part: str | None) -> str | None:
    """Return a part's number as every database can hold it; a StoreError before it is queued, not at the next write."""
    if part is None:
        return None
    if not isinstance(part, str) or len(part) > LONGEST or part != as_text(part):
        raise StoreError(
            f"Expected a part's number as plain text of at most {LONGEST} characters, or None, got {shortened(part)}; "
            "strip what a scanner added."
        )
    return str(part)


def as_text(text: str) -> str:
    """Return a text for people, with escapes for what a database refuses: NUL, and half a surrogate pair."""
    return text.encode("utf-8", "backslashreplace").decode().replace("\0", "\\0")


def as_silent(silent: int) -> int:
    """Return how many accepted parts went on unheard of since the previous label; -1: the label is of one of them."""
    if int(silent) < -1:
        raise StoreError(f"Expected a count of parts that went on in silence, -1 or more, got {silent}; count from 0.")
    return int(silent)


def check_state(report: RetrainReport, state: Mapping[str, NDArray[Any]] | None) -> dict[str, NDArray[Any]] | None:
    """Copy a version's arrays; an accepted version needs them, and none may hold Python objects (a pickle)."""
    if state is None:
        if report.accepted:
            raise StoreError(f"Expected the arrays of accepted version {report.version}, got None; pass its state.")
        return None
    copies = {name: np.array(values) for name, values in state.items()}
    for name, values in copies.items():
        if values.dtype.hasobject:
            raise StoreError(f"Expected plain arrays, got dtype {values.dtype} for {name!r}; store numbers or strings.")
    return copies


def check_import(
    decisions: Sequence[Decision], traces: NDArray[Any], hashes: NDArray[Any], labels: NDArray[Any]
) -> NDArray[np.float32]:
    """Return the traces of an import as (n, C, T) float32, once every part of it has n rows."""
    traces = np.asarray(traces, dtype=np.float32)
    traces = traces[:, None, :] if traces.ndim == 2 else traces
    lengths = (len(decisions), len(traces), len(hashes), len(labels))
    if traces.ndim != 3 or len(set(lengths)) != 1:
        raise StoreError(
            f"Expected n decisions, traces (n, C, T), hashes and labels, got {lengths} of them and traces of shape "
            f"{traces.shape}; give one of each a part."
        )
    twice = [name for name, times in Counter(decision.id for decision in decisions).items() if times > 1]
    if twice:
        raise duplicate_id(twice[0])
    return traces


def check_parts(parts: Sequence[str | None] | None, n: int) -> list[str | None]:
    """Return the part's number of each of n traces of an import; None where none is given."""
    numbers = [as_part(part) for part in ([None] * n if parts is None else parts)]
    if len(numbers) != n:
        raise StoreError(
            f"Expected a part's number for each of {n} traces, got {len(numbers)}; give None where it is unknown."
        )
    return numbers


def duplicate_id(decision_id: str) -> StoreError:
    """Return the error for two decisions of one id; the first stands."""
    return StoreError(
        f"Expected a new decision id, got {decision_id!r}, which this cell's store holds already; "
        "the first decision stands, give every decision an id of its own."
    )


def mixed_shapes(shapes: set[tuple[int, ...]]) -> StoreError:
    """Return the error for traces or points that do not fit together."""
    return StoreError(
        f"Expected one shape in a cell's store, found {sorted(shapes)}; give each kind of trace a cell_id of its own."
    )
