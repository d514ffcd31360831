"""`guarded`: the engine's way to call code that a user may have written, a model that prepares or
learns. An exception there is logged and never reaches the cell.

Predictions and trainings catch their exceptions where a failure is recorded: a decision in
`decide`, a training in `trainer`, a new version in `candidate`.
"""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

from ..errors import log

P = ParamSpec("P")
T = TypeVar("T")

# What follows from a failed call, for the log.
NOT_READY = "the model that was trained cannot be made ready to predict"
NOT_PRECOMPUTED = "computing in advance of a retrain failed"
NO_REFERENCE = "the model cannot take a labelled trace; the next version learns it from the store"
RULE_MISSED = (
    "an update of the rule failed; every part is verified until the engine is opened again"
)


def guarded(
    consequence: str, call: Callable[P, T], *arguments: P.args, **options: P.kwargs
) -> T | None:
    """Call a function and return its result; if it raises, log the exception and return None.

    `consequence` is the text of the log: it says what follows from the failure. KeyboardInterrupt
    and SystemExit are raised.
    """
    try:
        return call(*arguments, **options)
    except Exception:
        log.exception(consequence)
        return None
