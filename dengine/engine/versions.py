"""The model that answers, what it learns from each label, and how a new version takes its place.

A candidate that was trained beside the cell comes in by short steps: it learns the labels that came meanwhile, is stored,
and then answers.
"""

from __future__ import annotations

import itertools
import logging
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..decision.policy import Policy
from ..errors import StoreError
from ..model.base import EngineModel
from ..recipe import Recipe
from ..records import Reason, RetrainReport
from ..reducers.base import State
from ..store.base import Store
from ..store.outbox import Outbox
from ..store.records import Change, StoredDecision, without_rule
from .resume import change, join_since, refit, resume, tell_all
from .settings import EvidenceWindow
from .trainer import HUNG, Retrainer, Trained, TrainedOn, Window

log = logging.getLogger("dengine")
STEP = 0.001  # seconds of learning at once: some labels

Point = NDArray[np.float32]


class Candidate:
    """What was trained, until it answers in the place of `previous`; `storing` is its commit, once begun."""

    def __init__(self, trained: Trained, previous: EngineModel, version: int, clock: Callable[[], float]) -> None:
        self.model, self.seq = trained.model, trained.seq
        if self.model is not None:
            self.model.prepare_safely(previous)
        self.report = RetrainReport(version, 0.0, len(trained.seq), trained.n_steps, False, trained.reason)
        self.storing: Future[int] | None = None
        self.until = np.inf  # when its commit takes too long, of `time.monotonic`
        self.patience = 20  # steps that it waits for the labels' numbers, before it asks for them
        self.seconds = clock() - trained.begin  # of work on it: the cell's own, in between, is not counted
        self._clock = clock
        self._seen: set[int] = set()

    def learn(self, window: Window, seconds: float = np.inf) -> bool:
        """Make labels that came during its training references, no longer than that; whether it has all."""
        if (model := self.model) is None:
            return True
        missing = [seq for seq in window.newer(int(self.seq[-1])).tolist() if seq not in self._seen]
        if not missing:
            return True
        begin = self._clock()
        while missing and self._clock() - begin < seconds:
            trace, label, hash_ = window.row(seq := missing.pop(0))
            model.add_safely(model.place_safely(trace, hash_), label, hash_, seq)
            self._seen.add(seq)
        self.seconds += self._clock() - begin
        return not missing


class LabelCount(Protocol):
    """Counts the labels that the next retrain waits for: a cell's own, or (shared) those of all cells of its product."""

    shared: bool

    def resume(self) -> None:
        """Go on: the engine has from the store."""

    def keep(self, trace: NDArray[np.float32], label: int, hash_: int, seq: int) -> None:
        """Take a label of this cell that was stored, and is a reference already."""

    def due(self, retrain_every: int) -> bool:
        """Whether a retrain is this cell's turn."""

    def begin(self) -> None:
        """Know what can be known before a retrain, and count from here."""

    def begin_counting(self) -> None:
        """Count the labels of the next retrain from here."""

    def recount(self, counts_from: int) -> None:
        """Count anew: the window was filled anew."""

    def swapped(self, model: EngineModel) -> None:
        """Take notice of a version that this cell trained, and that answers now."""

    def complete(self) -> None:
        """Know all that was stored, before a person changes something."""

    def state(self) -> dict[str, NDArray[Any]]:
        """What a version has to say of this cell."""


class OwnLabels:
    """The `LabelCount` of a cell without a product, where every label counts as soon as it is known."""

    shared = False

    def __init__(self, versions: ModelVersions) -> None:
        self._versions = versions
        self.begin = self.begin_counting
        self.resume = self.complete = lambda: None  # nobody else has labels
        self.swapped = lambda model: None
        self.state: Callable[[], dict[str, NDArray[Any]]] = dict

    def keep(self, trace: NDArray[np.float32], label: int, hash_: int, seq: int) -> None:
        """Give it to the next retrain."""
        self._versions.retrainer.window.add(trace, label, hash_, seq)

    def due(self, retrain_every: int) -> bool:
        """Whether there are so many."""
        return self._versions.new_labels >= retrain_every

    def begin_counting(self) -> None:
        """None is new."""
        self._versions.new_labels = 0

    def recount(self, counts_from: int) -> None:
        """Those after the ones that were trained on."""
        self._versions.new_labels = len(self._versions.retrainer.window.newer(counts_from))


class ModelVersions:
    """The versions of one engine's model: at most one answers, at most one is being trained.

    template : untrained; what the first version is trained from.
    answering : the model that answers; None before the first retrain.  version : its number, from 1; 0 before.
    new_labels : since the last retrain began, as `count` has them.  evidence : what the rule in force is told of.
    store_waiting, journal_cleared : set by the feedback. The first stores what the rule was told of and the store not yet,
        before any training or swap; both raise StoreError where that cannot be.
    """

    def __init__(
        self,
        template: EngineModel,
        retrainer: Retrainer,
        outbox: Outbox,
        clock: Callable[[], float],
        evidence: EvidenceWindow,
    ) -> None:
        self.template, self.retrainer, self.outbox, self.clock, self.evidence = template, retrainer, outbox, clock, evidence
        self.store: Store = outbox.store  # asked without a time limit, so not while the cell waits
        self.answering: EngineModel | None = None
        self.version, self.new_labels, self.corrected_to = 0, 0, 0
        self.store_waiting: Callable[[], None] = lambda: None
        self.journal_cleared: Callable[[], None] = lambda: None
        self.count: LabelCount = OwnLabels(self)
        self._trained_on: TrainedOn | None = None
        self._newest = 0  # number that a version ever had; after damage an earlier one may answer
        self._waiting: dict[str, int] = {}  # by decision, the numbers that references have until the store gives one
        self._provisional = itertools.count(-1, -1)
        self._news: RetrainReport | None = None
        self._candidate: Candidate | None = None

    @property
    def next_number(self) -> int:
        """What the next version will be called."""
        return self._newest + 1

    @property
    def newest(self) -> EngineModel:
        """The model that answers, or the untrained one."""
        return self.answering or self.template

    def resume(self) -> None:
        """Go on from the store."""
        resumed = resume(self.store, self.template, self.retrainer.window, self.evidence)
        self.answering, self.version, self.new_labels = resumed.model, resumed.version, resumed.new_labels
        self._trained_on, self.corrected_to = resumed.trained_on, resumed.corrected_to
        self._newest = max((report.version for report in self.store.retrains()), default=0)
        self.count.resume()

    def take_over(self, model: EngineModel, number: int, trained_on: TrainedOn) -> None:
        """Let a peer's version answer."""
        self.answering, self.version, self._newest = model, number, max(number, self._newest)
        self._trained_on = trained_on

    def reference_point(self, known: StoredDecision) -> Point | None:
        """Where a decided trace lies as a reference of the version that answers; None without one, and where it fails."""
        if self.answering is None:
            return None
        # What this very version embedded when it decided need not be embedded again.
        embedding = known.decision.embedding if known.decision.model_version == self.version else None
        return self.answering.place_safely(known.trace, known.content_hash, embedding)

    def learn(self, known: StoredDecision, success: bool, point: Point | None, silent: int) -> None:
        """Take in what became of a part: tell the rule, and make the trace a reference."""
        made = known.decision
        if made.model_version >= self.evidence.since:
            self.newest.tell_safely(made.lower, made.upper, success, made.reason is Reason.NOVEL, silent)
        if point is not None:
            number = self._waiting[known.decision.id] = next(self._provisional)
            self.newest.add_safely(point, int(success), known.content_hash, number)
        self.new_labels += not self.count.shared  # a product's labels are counted in their order, when they are kept

    def unlearn(self, known: StoredDecision) -> None:
        """Take out the reference of a part whose label waits for the store: it was not what happened."""
        if (number := self._waiting.pop(known.decision.id, None)) is not None:
            self.newest.change_reference(number, known.content_hash, None)
        self.new_labels -= not self.count.shared

    def keep(self, known: StoredDecision, success: bool, seq: int) -> None:
        """Give a label that is stored to the next retrain."""
        if (number := self._waiting.pop(known.decision.id, None)) is not None:
            self.newest.renumber_reference(number, seq)
        self.count.keep(known.trace, int(success), known.content_hash, seq)

    def tell_anew(self) -> None:
        """Tell the rule everything again: what it was told was not what happened. StoreError where the store is away."""
        known = self.outbox.ask(lambda: self.store.evidence_since(0, self.evidence.since))
        tell_all(self.newest, known, self.evidence)

    def correct(self, own: bool = True) -> None:
        """Learn the store's newest corrections; a rival is trained anew, by the cell that corrected."""
        window = self.retrainer.window
        last = window.newest_seq if self.count.shared else None  # what peers stored since comes as their news
        window.refill(self.store.labelled(window.capacity, last=last))
        done = self.newest.keeps_references or self.answering is None
        for each in self.store.corrections(self.corrected_to):
            if self.answering is not None:
                done &= change(self.answering, self.store, each)
            self.corrected_to = each.number
        self.count.recount(0 if self._trained_on is None else self._trained_on.counts_from)
        self.tell_anew()
        if own and not done:
            self.retrain()

    def roll_back(self, number: int, event: Change) -> RetrainReport:
        """Let an earlier version answer again, as a new one, with what came since among its references."""
        begin, version = self.clock(), self.store.load_version(number)
        state = without_rule(version.state)  # which goes on
        model, trained_on = self.template.successor(), TrainedOn.from_state(version.state)
        if not model.keeps_references:
            # A rival cannot take a label back: it learns from the same traces as they are labelled now.
            trained_on = replace(trained_on, corrected_to=self.corrected_to)
        if model.needs_refit(state) and not refit(model, self.store, trained_on):
            raise StoreError(
                f"Expected the traces that version {number} was fitted on as they were stored, some have changed; "
                "see `dengine verify`, and restore the store from a copy."
            )
        model.set_state(state)
        model.prepare_safely(self.newest)
        join_since(model, self.store, version, self.retrainer.window)
        trained_on = replace(trained_on, counts_from=self.retrainer.window.newest_seq)
        n = len(trained_on.seq)
        report = RetrainReport(self.next_number, self.clock() - begin, n, 0, True, f"rolled back to version {number}")
        self._record(event, report, model, trained_on)
        self.count.begin_counting()
        return report

    def set_policy(self, policy: Policy | None, evidence: EvidenceWindow, event: Change) -> None:
        """Go on under another policy, as a new version of the same model; None: only what the engine looks at changed."""
        template, model = self.template, self.answering
        if policy is not None:
            template = template.under(policy)
            template.begin_safely_in(evidence.began_in)
            if model is not None:
                model = model.under(policy)
                model.prepare_safely(template)
        if model is None or self._trained_on is None:
            self.store.record(event)
        else:
            n = len(self._trained_on.seq)
            report = RetrainReport(self.next_number, 0.0, n, 0, True, "another policy, the same model")
            self._record(event, report, model, self._trained_on)
        self.template, self.evidence = template, evidence

    def _record(self, event: Change, report: RetrainReport, model: EngineModel, trained_on: TrainedOn) -> None:
        """Store a version together with what a person did; then it answers."""
        state = self._state(model, trained_on)
        self.store.record(replace(event, version=(report, self.retrainer.window.newest_seq, state)))
        self.answering, self.version, self._news = model, report.version, report
        self._newest, self._trained_on = report.version, trained_on

    def _state(self, model: EngineModel, trained_on: TrainedOn) -> State:
        own = self.count.state() | {"corrected_to": np.array(self.corrected_to)}
        return model.get_state() | trained_on.to_state() | own

    def retrain(self) -> RetrainReport:
        """Train and swap, in line."""
        self.collect(HUNG)
        self.store_waiting()
        self.count.begin()
        self._candidate = Candidate(self.retrainer.train(self.newest), self.newest, self.version, self.clock)
        self._advance(to_the_end=True)
        assert self._news is not None  # nothing came in between; for the type checker
        return self._news

    def work(self, recipe: Recipe) -> RetrainReport | None:
        """Do what is due between two cycles by a recipe: a retrain, where the store is there."""
        if not self.count.due(recipe.retrain_every):
            return None
        try:
            self.store_waiting()
        except StoreError:  # told by the outbox; the labels wait in its journal
            return None
        return None if self.outbox.fault else self.start_retrain()

    @property
    def swapping(self) -> bool:
        """Whether a version that was trained beside the cell is on its way in."""
        return self._candidate is not None

    @property
    def busy(self) -> bool:
        """Whether a retrain is under way beside the cell, or its version on its way in."""
        return self.retrainer.future is not None or self.swapping

    def start_retrain(self) -> RetrainReport | None:
        """Train beside the cell where there is an executor, unless it is at it; else in line."""
        self.collect()
        if self.busy:
            return None
        if self.retrainer.executor is not None:
            self.store_waiting()
            self.count.begin()
            if self.retrainer.start(self.newest):
                return None
        return self.retrain()

    def collect(self, wait: float = 0.0, to_the_end: bool = False) -> None:
        """Bring in what an executor has finished: a step further, or to the end, as where it is waited for."""
        if self.retrainer.future is None and self._candidate is None:
            return
        to_the_end |= wait > 0.0 or self.count.shared  # peers' versions and corrections do not come in between
        trained = self.retrainer.collect(wait)
        if trained is not None:
            self._candidate = Candidate(trained, self.newest, self.version, self.clock)
        if self._candidate is not None and (to_the_end or trained is None):  # to take it was a step
            self._advance(to_the_end)

    def _advance(self, to_the_end: bool) -> None:
        """Bring the version on its way in a step further. One that cannot be stored is dropped."""
        candidate = self._candidate
        assert candidate is not None  # the caller asked; for the type checker
        try:
            number = self._stored(candidate, to_the_end)
        except StoreError as error:  # a version that is not stored would be gone with the process
            self._candidate = None
            self._not_stored(candidate.report, error)
            return
        if number is None or self._can_wait(candidate, to_the_end):
            return
        try:
            self.store_waiting()  # what was confirmed since is to be among its references
        except StoreError as error:
            log.warning("version %d is stored, and answers once the labels since are: %s", candidate.report.version, error)
            return
        candidate.learn(self.retrainer.window)
        self._candidate = None
        self._swap(candidate, number)

    def _stored(self, candidate: Candidate, to_the_end: bool) -> int | None:
        """The number that a version has in the store; None where another step is needed. StoreError where it has none."""
        if candidate.storing is None:
            if not candidate.learn(self.retrainer.window, np.inf if to_the_end else STEP):
                return None
            if self._can_wait(candidate, to_the_end):
                return None
            self.store_waiting()
            candidate.learn(self.retrainer.window)
            candidate.storing, limit = self._store(candidate), self.outbox.limit
            candidate.until = np.inf if limit is None else time.monotonic() + limit
        storing = candidate.storing
        if not to_the_end and not storing.done() and (storing.running() or time.monotonic() < candidate.until):
            return None
        return self.outbox.result(storing)

    def _can_wait(self, candidate: Candidate, to_the_end: bool) -> bool:
        """Whether labels are on their way into the store, and the cell need not wait for that."""
        candidate.patience -= 1
        return not to_the_end and not self.outbox.drained and candidate.patience > 0

    def _store(self, candidate: Candidate) -> Future[int]:
        model, state = candidate.model, None
        candidate.report = replace(candidate.report, seconds=candidate.seconds)  # storing it comes on top
        if model is not None:
            candidate.report = replace(candidate.report, version=self.next_number, accepted=True)
            state = self._state(model, TrainedOn(candidate.seq, self.corrected_to, int(candidate.seq[-1])))
        return self.outbox.version(candidate.report, self.retrainer.window.newest_seq, state)

    def _swap(self, candidate: Candidate, number: int) -> None:
        report, model = replace(candidate.report, version=number), candidate.model
        if model is not None:
            model.untold = model.untold or self.newest.untold
            self._newest = report.version
            self.answering, self.version = model, report.version  # one reference is swapped
            self._trained_on = TrainedOn(candidate.seq, self.corrected_to, int(candidate.seq[-1]))
            self.count.swapped(model)
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
