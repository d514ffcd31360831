"""`Candidate`: a newly trained version of the model, from the end of its training until it answers.
`learner.Learner` makes one after each training, and takes it through the steps in between.

Meanwhile the previous version goes on answering. The candidate decides on some training traces, by
which its compiled module is compared with what was trained. Then it takes in the labels that came
since its training began, is stored, and replaces the previous version; or it is dropped. This
happens either all at once or in short steps between cycles.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import replace

import numpy as np

from ..decision.scripting import reason_of
from ..model.base import EngineModel
from ..records import RetrainReport
from .guard import GuardedModel
from .trainer import Trained, TrainedOn, TrainingWindow

log = logging.getLogger("dengine")
PATIENCE = 20  # steps that a candidate waits for its labels to be stored before it blocks for that


class Candidate:
    """The outcome of a training, until it answers or is dropped.

    Parameters
    ----------
    trained : Trained
    previous : EngineModel
        The model that answers meanwhile; its rule is taken over.
    version : int
        Of the previous model, for the report of a training that was dropped.
    clock : callable
        Seconds, of any origin.

    Attributes
    ----------
    model : EngineModel or None
        None where the version is dropped: then only the report is stored.
    report : RetrainReport
    trained_on : TrainedOn
        Set by `complete_report`.
    storing : Future or None
        The commit of the version, once it has begun; it returns the version's number in the store.
    """

    def __init__(
        self, trained: Trained, previous: EngineModel, version: int, clock: Callable[[], float]
    ) -> None:
        self.model = trained.model
        self.report = RetrainReport(
            version, 0.0, len(trained.seq), trained.n_steps, False, trained.reason
        )
        self.trained_on = TrainedOn()
        self.storing: Future[int] | None = None
        self._clock = clock
        self._seq = trained.seq
        self._learned_to = int(trained.seq[-1]) if len(trained.seq) else 0
        self._patience = PATIENCE
        self._store_until = np.inf  # by `time.monotonic`
        self._checks = _check_answers(self.model, previous)
        # Of work on it; the cell's own work in between is not counted.
        self._seconds = clock() - trained.begin

    def check(self, seconds: float = np.inf) -> bool:
        """Make the model ready to answer, and compare its answers with what was trained.

        It stops between two steps once `seconds` have passed by the clock; the time counts as work.
        Returns True when all is compared, and always where there is no model. A model that must not
        answer, or raises, is dropped: the report says why.
        """
        begin = self._clock()
        defect: str | None = ""  # None once all is compared
        try:
            while defect == "" and self._clock() - begin < seconds:
                defect = next(self._checks, None)
        except Exception as error:  # no exception inside a model reaches the cell
            log.exception("the model that was trained cannot answer")
            defect = reason_of(error)
        if defect:
            self.model = None
            self.report = replace(self.report, reason=f"dropped: {defect}")
        self._seconds += self._clock() - begin
        return defect is None or self.model is None

    def catch_up(self, window: TrainingWindow, seconds: float = np.inf) -> bool:
        """Make references of the window's labels that came since the training, oldest first.

        It stops between two labels once `seconds` have passed by the clock. The time counts as work
        in the report that `complete_report` makes. A label that the model cannot take is logged and
        skipped. Returns True when no label is left, and always where there is no model.
        """
        if self.model is None:
            return True
        missing = window.newer(self._learned_to)
        if not missing:
            return True
        guarded = GuardedModel(self.model)
        begin = self._clock()
        while missing and self._clock() - begin < seconds:
            seq = missing.pop(0)
            trace, label, hash_ = window.row(seq)
            guarded.add_reference(trace, label, hash_, seq)
            self._learned_to = seq
        self._seconds += self._clock() - begin
        return not missing

    def lose_patience(self) -> bool:
        """Count a step of waiting for label numbers; return True from the `PATIENCE`-th step on."""
        self._patience -= 1
        return self._patience <= 0

    def complete_report(self, version: int, corrected_to: int) -> RetrainReport:
        """Complete the report, and mark the version as accepted if the training gave a model.

        The report gets the seconds of work so far. With a model it also gets `version` as its
        number, and `trained_on` is set, with `corrected_to` as the number of the newest correction
        that the labels had. Without one the report stays that of a dropped retrain. Returns the
        report, which the caller stores.
        """
        self.report = replace(self.report, seconds=self._seconds)  # storing it comes on top
        if self.model is not None:
            self.report = replace(self.report, version=version, accepted=True)
            self.trained_on = TrainedOn(self._seq, corrected_to, int(self._seq[-1]))
        return self.report

    def begin_storing(self, storing: Future[int], seconds: float) -> None:
        """Keep the future of the version's commit, and give it `seconds` from now to begin."""
        self.storing = storing
        self._store_until = time.monotonic() + seconds

    def may_go_on_storing(self) -> bool:
        """Return whether the commit may be waited for.

        True while it runs, and while it is queued and its seconds to begin have not passed. False
        before `begin_storing` and once the commit is done.
        """
        storing = self.storing
        if storing is None or storing.done():
            return False
        return storing.running() or time.monotonic() < self._store_until

    def set_version(self, version: int) -> None:
        """Set the report's version to the number that the store gave; 0 changes nothing.

        The two differ where a peer's version was stored first.
        """
        self.report = replace(self.report, version=version or self.report.version)


def _check_answers(model: EngineModel | None, previous: EngineModel) -> Iterator[str]:
    """Prepare a model to answer after the previous one, then yield from its `check_answers`."""
    if model is not None:
        model.prepare(previous)
        yield ""
        yield from model.check_answers()
