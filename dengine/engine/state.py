"""`EngineState`: what only the running engine knows, for a server, a page or a watching loop."""

from dataclasses import replace

from ..history.status import Status, retrain_fault
from .learner import Learner


class EngineState:
    """What only the running engine knows; any thread may read it at any time, and nothing waits.

    Parameters
    ----------
    learner : Learner
    """

    def __init__(self, learner: Learner) -> None:
        self._live = learner.live
        self._learner = learner

    @property
    def new_labels(self) -> int:
        """Labels since the last retrain began, as `Feedback.new_labels` counts them."""
        return self._learner.feedback.new_labels

    @property
    def is_retraining(self) -> bool:
        """Whether a retrain is under way in the executor, or its version is not in force yet.

        It is also True while a retrain that was requested waits until it can begin.
        """
        return self._learner.is_busy

    @property
    def is_swapping(self) -> bool:
        """Whether a trained version is being put in force, a step with each call of the engine."""
        return self._learner.is_swapping

    @property
    def retrain_fault(self) -> str:
        """What is wrong if the last three or more retrains were dropped; "" if they were not."""
        return retrain_fault(self._learner.dropped, self._live.version)

    @property
    def integrity_error(self) -> str:
        """What was changed in the store, so that every part is verified; "" if nothing was."""
        return self._live.outbox.integrity_error

    @property
    def store_fault(self) -> str:
        """What is wrong with the store or its journal at present; "" if nothing is.

        That is the `integrity_error` if there is one, else why they cannot be written.
        """
        return self._live.outbox.fault

    @property
    def store_lag(self) -> float:
        """Age in seconds of the oldest journal record that is not in the store; 0.0 if none."""
        return self._live.outbox.lag

    def complete(self, status: Status) -> Status:
        """Return a copy of a status from the store, completed by what only the engine knows.

        That is the number of the model version that decides now, the reason of a safe mode (after
        an alarm every part is verified; "" outside a safe mode), the number of labels since the
        newest retrain began, what is wrong with the store (`store_fault`), the age of the oldest
        record that the store lacks, and whether a retrain is under way (`is_retraining`).
        """
        return replace(
            status,
            version=self._live.version,
            safe_mode=self._live.newest.safe_mode,
            new_labels=self.new_labels,
            store_fault=self.store_fault,
            store_lag=self.store_lag,
            retraining=self.is_retraining,
        )
