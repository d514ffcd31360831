"""The model that answers, and how a new version takes its place."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .asking import Asked
from .current import TELL_ALL, CurrentVersion
from .decision.policy import Policy
from .errors import StoreError
from .fleet import Fleet
from .incoming import STEP, Incoming
from .keeping import Keeper
from .model.base import EngineModel
from .pending import HUNG
from .records import RetrainReport
from .reducers.base import State
from .references import References
from .resuming import Origin, Telling, change, join_since, refit
from .retraining import Retrainer, Trained
from .store.fleet import without_rule
from .store.records import Change
from .store.shared import is_shared

log = logging.getLogger("dengine")

Point = NDArray[np.float32]


class ModelVersions(CurrentVersion):
    """The versions of one engine's model: at most one answers, at most one is being trained."""

    def __init__(
        self,
        template: EngineModel,
        retrainer: Retrainer,
        keeper: Keeper,
        clock: Callable[[], float],
        telling: Telling = TELL_ALL,
    ) -> None:
        super().__init__(template, retrainer, keeper, clock, telling)
        self._incoming: Incoming | None = None
        if is_shared(keeper.store):
            self.fleet = Fleet(keeper.store, self)

    def correct(self, own: bool = True) -> None:
        """Learn what the store's newest corrections say: references, window and rule, before the next decision.

        What keeps references of its own, a rival, is trained anew at once; by the cell that corrected.
        """
        window = self.retrainer.window
        last = None if self.fleet is None else window.newest_seq  # what sisters stored since comes as their news
        window.refill(self.store.labelled(window.capacity, last=last))
        done = self.newest.keeps_references or self.answering is None
        for each in self.store.corrections(self._corrected_to):
            if self.answering is not None:
                done &= change(self.answering, self._references, self.store, each)
            self._corrected_to = each.number
        if self.fleet is None:
            self.new_labels = window.after(0 if self._origin is None else self._origin.counts_from)
        else:
            self.fleet.recount()
        self.tell_anew()
        if own and not done:
            self.retrain()

    def roll_back(self, number: int, event: Change) -> RetrainReport:
        """Let an earlier version answer again, as a new one, with what came since among its references."""
        begin, version = self.clock(), self.store.load_version(number)
        state = without_rule(version.state)  # which goes on
        model, origin = self.template.successor(), Origin.from_state(version.state)
        if not model.keeps_references:
            # A rival cannot take a label back: it learns from the same traces as they are labelled now.
            origin = replace(origin, corrected_to=self._corrected_to)
        if model.needs_refit(state) and not refit(model, self.store, origin):
            raise StoreError(
                f"Expected the traces that version {number} was fitted on as they were stored, some have changed; "
                "see `dengine verify`, and restore the store from a copy."
            )
        model.set_state(state)
        model.prepare_safely(self.newest)
        references, _ = join_since(model, self.store, version, self.retrainer.window)
        origin = replace(origin, counts_from=self.retrainer.window.newest_seq)
        n = len(origin.seq)
        report = RetrainReport(self.next_number, self.clock() - begin, n, 0, True, f"rolled back to version {number}")
        self._record(event, report, model, references, origin)
        self.new_labels = 0
        if self.fleet is not None:
            self.fleet.begin_counting()
        return report

    def set_policy(self, policy: Policy | None, telling: Telling, event: Change) -> None:
        """Go on under another policy, as a new version of the same model; None: only what the engine looks at changed.

        telling : what its rule is to be told.
        """
        template, model = self.template, self.answering
        if policy is not None:
            template = template.under(policy)
            template.begin_safely_in(telling.began_in)
            if model is not None:
                model = model.under(policy)
                model.prepare_safely(template)
        if model is None or self._origin is None:
            self.store.record(event)
        else:
            reason = "another policy, the same model"
            report = RetrainReport(self.next_number, 0.0, len(self._origin.seq), 0, True, reason)
            self._record(event, report, model, self._references, self._origin)
        self.template, self.telling = template, telling

    def _record(
        self, event: Change, report: RetrainReport, model: EngineModel, references: References, origin: Origin
    ) -> None:
        """Store a version together with what a person did; then it answers."""
        state = self._state(model, references, origin)
        self.store.record(replace(event, version=(report, self.retrainer.window.newest_seq, state)))
        self.answering, self.version, self._news = model, report.version, report
        self._newest = report.version
        self._references, self._origin = references, origin

    def _state(self, model: EngineModel, references: References, origin: Origin) -> State:
        own = {"references": references.seqs()} if model.keeps_references else {}
        own |= {} if self.fleet is None else {"told_to": np.array(self.fleet.told_to)}
        return model.get_state() | origin.to_state() | own | {"corrected_to": np.array(self._corrected_to)}

    def retrain(self) -> RetrainReport:
        """Train and swap, in line."""
        self.collect(HUNG)
        self._begin()
        self._take(self.retrainer.train(self.newest))
        self._advance(to_the_end=True)
        assert self._news is not None  # nothing came in between; for the type checker
        return self._news

    def _begin(self) -> None:
        self.store_waiting()
        if self.fleet is not None:
            self.fleet.begin()
        self.new_labels = 0

    def _due(self, retrain_every: int) -> bool:
        return self.new_labels >= retrain_every if self.fleet is None else self.fleet.due(retrain_every)

    def work(self, retrain_every: int) -> RetrainReport | None:
        """Do what is due between two cycles: a retrain after so many labels, else a slice of the encoder's training.

        While the store is away nothing is retrained: a version answers only once it is stored.
        """
        if self._due(retrain_every) and self._ready():
            return self.start_retrain()
        if self.answering is not None:
            self.retrainer.improve(self.answering)
        return None

    def _ready(self) -> bool:
        try:
            self.store_waiting()
        except StoreError:  # told by the keeper; the labels wait in its journal
            return False
        return not self.keeper.fault

    @property
    def swapping(self) -> bool:
        """Whether a version that was trained beside the cell is on its way in."""
        return self._incoming is not None

    @property
    def busy(self) -> bool:
        """Whether a retrain is under way beside the cell, or its version on its way in."""
        return self.retrainer.busy or self.swapping

    def start_retrain(self) -> RetrainReport | None:
        """Train beside the cell where there is an executor, unless it is at it; else in line."""
        self.collect()
        if self.busy:
            return None
        if self.retrainer.executor is not None:
            self._begin()
            if self.retrainer.start(self.newest):
                return None
        return self.retrain()

    def collect(self, wait: float = 0.0, to_the_end: bool = False) -> None:
        """Bring in what an executor has finished: a step further, or to the end, as where it is waited for."""
        to_the_end |= wait > 0.0 or self.fleet is not None  # sisters' versions and corrections do not come in between
        trained = self.retrainer.collect(wait)
        if trained is not None:
            self._take(trained)
        if self._incoming is not None and (to_the_end or trained is None):  # to take it was a step
            self._advance(to_the_end)

    def _take(self, trained: Trained) -> None:
        self._incoming = Incoming(trained, self.newest, self.version, self.clock)

    def _advance(self, to_the_end: bool) -> None:
        """Bring the version on its way in a step further. One that cannot be stored is dropped."""
        incoming, window = self._incoming, self.retrainer.window
        assert incoming is not None  # the caller asked; for the type checker
        try:
            if incoming.storing is None:
                if not incoming.learn(window, np.inf if to_the_end else STEP):
                    return
                self.store_waiting()
                incoming.learn(window)
                incoming.storing = self._store(incoming)
            if not to_the_end and not incoming.storing.due:
                return
            number = incoming.storing.result()
        except StoreError as error:  # a version that is not stored would be gone with the process
            self._incoming = None
            self._not_stored(incoming.report, error)
            return
        try:
            self.store_waiting()  # what was confirmed since is to be among its references
        except StoreError as error:
            log.warning("version %d is stored, and answers once the labels since are: %s", incoming.report.version, error)
            return
        incoming.learn(window)
        self._incoming = None
        self._swap(incoming, number)

    def _store(self, incoming: Incoming) -> Asked[int | None]:
        model, state = incoming.model, None
        incoming.report = replace(incoming.report, seconds=incoming.seconds)  # storing it comes on top
        if model is not None:
            incoming.report = replace(incoming.report, version=self.next_number, accepted=True)
            state = self._state(model, incoming.references, self._origin_of(incoming))
        return self.keeper.version(incoming.report, self.retrainer.window.newest_seq, state)

    def _origin_of(self, incoming: Incoming) -> Origin:
        return Origin(incoming.seq, self._corrected_to, int(incoming.seq[-1]))

    def _swap(self, incoming: Incoming, number: int | None) -> None:
        report, model = incoming.report, incoming.model
        report = replace(report, version=report.version if number is None else number)  # one without products has no other
        if model is not None:
            model.untold = model.untold or self.newest.untold
            self._newest = report.version
            self.answering, self.version = model, report.version  # one reference is swapped
            self._references, self._origin = incoming.references, self._origin_of(incoming)
            if self.fleet is not None:
                self.fleet.swapped(model)
        self._news = report

    def _not_stored(self, report: RetrainReport, error: StoreError) -> None:
        """Drop a version with its reason; its labels are as many new ones, so that the next retrain is soon."""
        log.warning("a retrain was dropped, for it could not be stored: %s", error)
        self.new_labels += report.n_traces
        self._news = replace(report, version=self.version, accepted=False, reason=f"dropped: not stored: {error}")

    def take_news(self) -> RetrainReport | None:
        """The newest retrain, once."""
        news, self._news = self._news, None
        return news
