"""What a report may say: the id of a decision, and success or failure. Anything else is refused before it is stored.

A label that is guessed is worse than none: `bool("NG")` is True, and -1 is what some controllers call true.
"""

from __future__ import annotations

from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import DataError, ReportError
from .records import Outcome
from .wording import shortened

LONGEST = 200  # characters of an id, or of a part's number


def as_success(value: Any, of: str = "") -> bool:
    """A label as True or False. ReportError for anything but a bool, or a number that is exactly 1 or 0.

    value : bool, int, float, a NumPy scalar, or an array of no dimensions.  of : what it is the label of, for the error.
    """
    plain = value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value
    if isinstance(plain, bool | np.bool_ | Real) and (plain == 0 or plain == 1):
        return bool(plain)
    raise ReportError(
        f"Expected a label, True (success) or False (failure), or exactly 1 or 0,{of and f' of {of},'} got "
        f"{shortened(value)}; nothing was stored: turn it into one of these first, as in success=(answer == 'OK')."
    )


def as_labels(y: ArrayLike) -> NDArray[np.int64]:
    """Labels (n,) as 1 (success) and 0 (failure); DataError where there is anything else among them."""
    labels = np.asarray(y)
    if not np.isin(labels, (0, 1)).all():
        raise DataError("Expected labels 1 (success) and 0 (failure), got others; turn them into these before they count.")
    return labels.astype(np.int64)


def as_outcome(value: Any, of: str = "") -> Outcome:
    """What a cell's `proceed` returned, as an `Outcome`; ReportError for anything else, which would pass for silence."""
    try:
        return Outcome(value)
    except (ValueError, TypeError) as error:
        raise ReportError(
            f"Expected an Outcome, {', '.join(Outcome)},{of and f' of {of},'} got {shortened(value)}; return "
            "Outcome.UNKNOWN from proceed() where nothing is known."
        ) from error


def is_name(value: Any) -> bool:
    """Whether a store can keep it as an id, or a part's number: text that prints, of 1 to LONGEST characters."""
    return isinstance(value, str) and 1 <= len(value) <= LONGEST and value.isprintable()


def as_id(value: Any) -> str:
    """A decision's id; ReportError for what is none."""
    if not is_name(value):
        raise ReportError(
            f"Expected the id of a decision, a text of 1 to {LONGEST} characters that print, got {shortened(value)}; "
            "report the `Decision.id` that `decide` returned."
        )
    return str(value)
