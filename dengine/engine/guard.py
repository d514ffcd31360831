"""`GuardedModel`: calls of the engine's model in which an exception is logged and never reaches the
cell. Every object of the engine that prepares a model, or teaches it, calls it in this way.

Predictions and trainings are guarded where their failure is recorded, in `decide` and `trainer`.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numpy.typing import NDArray

from ..model.base import Embedding, EngineModel
from ..reducers.base import Floats, Ints

log = logging.getLogger("dengine")


@contextmanager
def logged_failure(consequence: str) -> Iterator[None]:
    """Log an exception of the block together with its consequence, and suppress it."""
    try:
        yield
    except Exception:
        log.exception(consequence)


class GuardedModel:
    """Calls a model's methods and turns each exception into a log entry and a safe result.

    Parameters
    ----------
    model : EngineModel
    """

    def __init__(self, model: EngineModel) -> None:
        self.model = model

    def precompute(self, X: Floats, numbers: Ints | None = None) -> None:
        """Compute in advance, and keep in the model, what a training on traces begins with.

        X has shape (n, channels, samples); `numbers` are their labels' sequence numbers.
        """
        with logged_failure("computing in advance of a retrain failed"):
            self.model.precompute(X, numbers)

    def prepare(self, previous: EngineModel) -> None:
        """Give the model the previous one's rule, and make it ready to predict in its place.

        Where it fails, every prediction will fail.
        """
        with logged_failure("the model that was trained cannot be made ready to predict"):
            self.model.prepare(previous)

    def update_rule(self, *outcome: Any) -> None:
        """Update the model's rule with the outcome of a part.

        `outcome` is what `EngineModel.update_rule` takes: lower, upper, success, novel, unobserved,
        predicted (a position in `ACTIONS`), inclusion_probability. Where it fails, that is logged,
        and the model refuses to predict.
        """
        with logged_failure(
            "an update of the rule failed; every part is verified until the engine is opened again"
        ):
            self.model.update_rule(*outcome)

    def add_reference(
        self,
        x: Floats,
        y: int,
        hash_: int,
        number: int,
        embedding: Embedding | None = None,
        point: NDArray[Any] | None = None,
    ) -> Floats | None:
        """Make a labelled trace a reference and return its point, as `EngineModel.add_reference`
        does.

        The point is float32 of shape (d,); a baseline returns the trace. Where it fails, that is
        logged, no reference is added, and None is returned.
        """
        with logged_failure(
            "the model cannot take a labelled trace; the next version learns it from the store"
        ):
            return self.model.add_reference(x, y, hash_, number, embedding=embedding, point=point)
        return None
