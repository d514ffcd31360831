"""`Candidate`: a newly trained version of the model, from the end of its training until it is in
force. `learner.Learner` makes a candidate after each training, and `Learner._see_through` names the
steps in between.

Meanwhile the previous version stays in force. The candidate decides on some training traces, by
which its compiled module is compared with what was trained. Then it takes in the labels that came
since its training began, is stored, and replaces the previous version; or it is dropped. This
happens either all at once or in short steps between cycles.
"""

from __future__ import annotations

from dataclasses import replace

from ..decision.scripting import reason_of
from ..errors import log
from ..records import RetrainReport
from ..store.records import Clock
from .guard import NO_REFERENCE, guarded
from .live_model import LiveModel
from .trainer import Trained, TrainedOn, TrainingWindow


class Candidate:
    """The outcome of a training, until it is in force or is dropped.

    Parameters
    ----------
    trained : Trained
    live : LiveModel
        Decides meanwhile, and the candidate takes over the rule that it has now. The report of a
        training that was dropped has the number of its version. The labels of the training had the
        same corrections as its references.
    clock : callable
        Seconds, of any origin.

    Attributes
    ----------
    model : EngineModel or None
        None if the training is dropped: then only the report is stored.
    report : RetrainReport
    trained_on : TrainedOn
        The labels of the training.
    is_stored : bool
        Whether the version, or the report of a dropped one, is in the store.
    """

    def __init__(self, trained: Trained, live: LiveModel, clock: Clock) -> None:
        self.model = trained.model
        self.report = RetrainReport(
            live.version, 0.0, len(trained.seq), trained.n_steps, False, trained.reason
        )
        self._learned_to = int(trained.seq[-1]) if len(trained.seq) else 0
        self.trained_on = TrainedOn(trained.seq, live.corrected_to, self._learned_to)
        self.is_stored = False
        self._previous = live.newest
        self._clock = clock
        self._begin = trained.begin  # of the retrain, put off by the time that is no work on it
        self._work_ended = clock()

    def begin_work(self) -> None:
        """Count the time from now on as work on the retrain, until `end_work`."""
        self._begin += self._clock() - self._work_ended

    def end_work(self) -> None:
        """Count the time from now on as the cell's own, which the retrain's report leaves out."""
        self._work_ended = self._clock()

    def check(self) -> None:
        """Make the model ready to decide, and test it on some traces of its training.

        The model takes over the decision rule (bound to action) of the previous model, which
        decides until now. If the compiled model gives another result than the trained one, or
        raises, the training is dropped (its model is never put in force): `model` becomes None, and
        the report says why. An exception while the rule is taken over drops it, too. Exceptions are
        logged and not raised. If `model` is None already, nothing is done.
        """
        if self.model is None:
            return
        try:
            self.model.prepare(self._previous)
            defect = self.model.check_answers()
        except Exception as error:  # no exception inside a model reaches the cell
            log.exception("the model that was trained cannot answer")
            defect = reason_of(error)
        if defect:
            self.model = None
            self.report = replace(self.report, reason=f"dropped: {defect}")

    def learn_next(self, window: TrainingWindow) -> bool:
        """Make the oldest label since the training began that is not learned yet a reference.

        A reference is a labelled point of the model, with which new traces are compared. `window`
        holds the newest labelled traces. It returns True if there was such a label; a label that
        the model cannot take is logged and skipped. It returns False, and does nothing, if no label
        is left or `model` is None.
        """
        if self.model is None:
            return False
        row = window.row_after(self._learned_to)
        if row is None:
            return False
        self._learned_to, trace, label, hash_ = row
        guarded(NO_REFERENCE, self.model.add_reference, trace, label, hash_, self._learned_to)
        return True

    def complete_report(self, version: int) -> RetrainReport:
        """Put the seconds of work so far into the report, and return it for the caller to store.

        If there is a model, the report is also marked as accepted and gets the number `version`.
        Without a model it stays the report of a dropped retrain (whose version is not put in
        force), with the number of the version in force. Seconds after this call are in no report.
        """
        # Storing it comes on top.
        self.report = replace(self.report, seconds=self._clock() - self._begin)
        if self.model is not None:
            self.report = replace(self.report, version=version, accepted=True)
        return self.report

    def end_storing(self, version: int) -> None:
        """Note that the version is stored, and put the number that it got there in the report.

        It differs from the report's number if another robot cell of the product stored a version
        first.
        """
        self.is_stored = True
        self.report = replace(self.report, version=version)
