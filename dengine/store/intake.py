"""What both stores take in: a decision is checked and copied before it is queued, for afterwards nobody could be told.

A row that a database refuses is found by its writer, long after `put_decision` returned. So all that any of them refuses is
found here, in every store alike: a replay in memory takes nothing that a cell's database would not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import StoreError
from ..labels import LONGEST, is_name
from ..records import Action, Decision, Reason
from ..wording import shortened
from .checks import as_channels, as_hash, as_part
from .records import DecidedTrace

WHOLE = ("n_success", "n_failure", "model_version")
SHARES = ("lower", "upper", "propensity")
KINDS = {"action": Action, "predicted": Action, "reason": Reason}


def decided_trace(
    decision: Decision, trace: NDArray[np.float32], content_hash: int, quarantined: bool, time: float, part: str | None
) -> DecidedTrace:
    """A decision on its way into a store, with a copy of its trace. StoreError for what no database can hold."""
    check_decision(decision)
    if not math.isfinite(time):
        raise StoreError(f"Expected the time of a decision in seconds, got {time}; look at the store's clock.")
    return DecidedTrace(decision, as_channels(trace), as_hash(content_hash), bool(quarantined), time, as_part(part))


def check_decision(decision: Decision) -> None:
    """StoreError for the first field of a decision that a database could not hold, or hand back as it was."""
    _must(is_name(decision.id), f"an id of 1 to {LONGEST} characters that print", decision.id)
    for name, kind in KINDS.items():
        _must(isinstance(getattr(decision, name), kind), f"{name} as {kind.__name__}", getattr(decision, name))
    for name in WHOLE:
        count = getattr(decision, name)
        _must(_is_whole(count), f"{name} as a whole number from 0 to below 2**63", count)
    for name in SHARES:
        _must(_is_share(getattr(decision, name)), f"{name} as a number from 0 to 1", getattr(decision, name))
    _must(isinstance(decision.audit, bool | np.bool_), "audit as True or False", decision.audit)
    _must(_is_embedding(decision.embedding), "an embedding of numbers, (K, d), or None", decision.embedding)


def _must(fits: bool, what: str, found: Any) -> None:
    if not fits:
        raise StoreError(f"Expected a decision with {what}, got {shortened(found)}; nothing was stored.")


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(0 <= value < 2**63)


def _is_share(value: Any) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and bool(0.0 <= value <= 1.0)  # no NaN


def _is_embedding(value: Any) -> bool:
    return value is None or _is_row(value, lambda point: _is_row(point, _is_number))


def _is_row(value: Any, fits: Callable[[Any], bool]) -> bool:
    return isinstance(value, tuple | list) and all(map(fits, value))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
