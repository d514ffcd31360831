"""The model that answers, what it learns from each label, and how a new version takes its place.

A candidate that was trained beside the cell comes in by short steps: it learns the labels that came meanwhile, is stored,
and then answers.

Where other cells make the product too, their labels become references, and their newer versions answer here. Labels of a
product have one sequence over all its cells. An engine's window holds every label up to its newest there: one of its own is
a reference at once, and waits for the peers' before it until it enters the window. News is asked for between two cycles,
never by `decide`; a cell whose connection is lost goes on with what it has.
"""

from __future__ import annotations

import itertools
import logging
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..decision.policy import Policy
from ..errors import StoreError
from ..model.base import EngineModel
from ..recipe import Recipe
from ..records import ACTIONS, Decision, Reason, RetrainReport
from ..reducers.base import State
from ..store.outbox import Outbox
from ..store.records import (
    Change,
    Labelled,
    ModelVersion,
    OutcomeRecord,
    StoredDecision,
    overdue_outcomes,
    without_rule,
)
from ..store.rule_progress import read_rule_progress
from .resume import change, join_since, known_to, refit, restored, tell, tell_all
from .settings import EvidenceWindow
from .trainer import HUNG, Retrainer, Trained, TrainedOn, Window

if TYPE_CHECKING:
    from ..store.sql import SqlStore

log = logging.getLogger("dengine")
STEP = 0.0005  # seconds of learning at once: a label or two
NEWS_SECONDS = 1.0  # between two questions for news of a product
MOST = 200  # labels taken in at once: each is embedded, some tenths of a millisecond
ROUNDS = 5  # of them before a retrain: after a long absence it need not know all

Point = NDArray[np.float32]


class Candidate:
    """What was trained, until it answers in the place of `previous`; `storing` is its commit, once begun."""

    def __init__(self, trained: Trained, previous: EngineModel, version: int, clock: Callable[[], float]) -> None:
        self.model, self.seq = trained.model, trained.seq
        self.trained_on: TrainedOn | None = None  # where it is stored with a model
        if self.model is not None:
            self.model.prepare_safely(previous)
        self.report = RetrainReport(version, 0.0, len(trained.seq), trained.n_steps, False, trained.reason)
        self.storing: Future[int] | None = None
        self.until = np.inf  # when its commit takes too long, of `time.monotonic`
        self.patience = 20  # steps that it waits for the labels' numbers, before it asks for them
        self.seconds = clock() - trained.begin  # of work on it: the cell's own, in between, is not counted
        self._clock = clock
        self._known_to = int(self.seq[-1]) if len(self.seq) else 0

    def learn(self, window: Window, seconds: float = np.inf) -> bool:
        """Make labels that came during its training references, no longer than that; whether it has all."""
        if (model := self.model) is None:
            return True
        if not (missing := window.newer(self._known_to)):
            return True
        begin = self._clock()
        while missing and self._clock() - begin < seconds:
            trace, label, hash_ = window.row(seq := missing.pop(0))
            model.add_safely(model.place_safely(trace, hash_), label, hash_, seq)
            self._known_to = seq
        self.seconds += self._clock() - begin
        return not missing


class ModelVersions:
    """The versions of one engine's model: at most one answers, at most one is being trained.

    template : untrained; what the first version is trained from.
    answering : the model that answers; None before the first retrain.  version : its number, from 1; 0 before.
    new_labels : since the last retrain began, of all cells where a product is shared.  fleet : None where none is.
    evidence : what the rule in force is told of.
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
        self.store: SqlStore = outbox.store  # asked without a time limit, so not while the cell waits
        self.answering: EngineModel | None = None
        self.version, self.new_labels, self.corrected_to = 0, 0, 0
        self.store_waiting: Callable[[], None] = lambda: None
        self.journal_cleared: Callable[[], None] = lambda: None
        self.fleet = None if self.store.product is None else Fleet(self.store, self)
        self.overdue: set[str] = set()  # decisions that the rule was told of as wrong: their checks are owed for too long
        self.overdue_to = 0  # number of the newest decision whose check was looked for by then
        self._trained_on: TrainedOn | None = None
        self._newest = 0  # number that a version ever had; after damage an earlier one may answer
        # What was learned, by decision, and the number that a reference has until the store gives one; 0: it is none.
        self._waiting: dict[str, tuple[StoredDecision, bool, int]] = {}
        self._provisional = itertools.count(-1, -1)
        self._news: RetrainReport | None = None
        self._candidate: Candidate | None = None
        self._continues = True  # the last retrain was accepted
        self.dropped: list[str] = []  # reasons of the retrains that were dropped since the last accepted one
        self._ahead: Future[None] | None = None  # features of stored traces, which the next retrain waits for

    @property
    def next_number(self) -> int:
        """What the next version will be called."""
        return self._newest + 1

    @property
    def newest(self) -> EngineModel:
        """The model that answers, or the untrained one."""
        return self.answering or self.template

    def resume(self, within: int, policy_since: int) -> None:
        """Go on from the store, bit for bit: reference embeddings are read, not recomputed.

        within, policy_since : decisions after which a check is overdue, and the first version that counted so.
        """
        store, template, since = self.store, self.template, self.evidence.since
        version = store.last_version()  # before the labels: a peer may store both meanwhile
        labelled = store.labelled(self.retrainer.window.capacity)
        self.retrainer.window.refill(labelled)
        reports = store.retrains()
        self._newest = max((report.version for report in reports), default=0)
        for report in reports:
            self._note_outcome(report)
        # The later versions may be damaged: what an earlier one's rule learned under an earlier policy is left out.
        state = {} if version is None else version.state if version.version >= since else without_rule(version.state)
        model = None if version is None else restored(self.outbox, template, state)
        past = read_rule_progress(store, None if model is None else version, since, within, policy_since)
        self.overdue, self.overdue_to = set(past.overdue_ids), past.overdue_to
        if version is None or model is None:
            if len(labelled.seq) >= 500:  # and no retrain yet: they were imported
                self._precompute(template, labelled)
            template.begin_safely_in(self.evidence.began_in)
            tell(template, self._evidence)
            self.new_labels = len(labelled.seq)
            self.corrected_to = max((each.number for each in store.corrections()), default=0)
        else:
            self.answering, self.version, trained_on = model, version.version, TrainedOn.from_state(version.state)
            self._precompute(model, labelled)
            model.prepare_safely(template)
            self.corrected_to = join_since(model, store, version, self.retrainer.window)
            if past.last_seq:
                tell(model, lambda: self._evidence(past.last_seq))
            else:
                tell_all(model, self._evidence, self.evidence)
            self.new_labels = int((labelled.seq > trained_on.counts_from).sum())
            self._trained_on = trained_on
        if self.fleet is not None:
            self.fleet.resume()

    def _evidence(self, after: int = 0) -> list[OutcomeRecord]:
        """What the rule is told of labels after that number, which are held to the ledger."""
        self.outbox.check_integrity(after)
        return self.store.outcomes_since(after, self.evidence.since, self.overdue_to)

    def _precompute(self, model: EngineModel, labelled: Labelled) -> None:
        """Compute beside the cell what a retrain on these begins with: an opening need not wait for it."""
        pool = ThreadPoolExecutor(1, "dengine-ahead", torch.set_num_threads, (1,))
        self._ahead = pool.submit(model.precompute_safely, labelled.traces, labelled.seq)
        pool.shutdown(wait=False)

    @property
    def training_left(self) -> bool:
        """Whether the answering version lacks training steps, as after many labels were imported at once.

        Not where the last retrain was dropped: its labels wait for the next one. Nor where cells share a product: each of
        them would train the same version.
        """
        alone = self.fleet is None and self.answering is not None
        return alone and self._continues and self.newest.report.n_steps_left > 0

    def take_over(self, model: EngineModel, number: int, trained_on: TrainedOn) -> None:
        """Let a peer's version answer."""
        self.answering, self.version, self._newest = model, number, max(number, self._newest)
        self._trained_on = trained_on

    def learn(self, known: StoredDecision, success: bool, unobserved: int | None) -> Point | None:
        """Take in what became of a part: tell the rule, and make the trace a reference; returns its place, where kept.

        unobserved : accepted parts that went on unheard of before it; None: the rule is not told.
        """
        made, model, point = known.decision, self.answering, None
        if unobserved is not None and made.model_version >= self.evidence.since:
            how = ACTIONS.index(made.predicted), made.inclusion_probability
            self.newest.tell_safely(made.lower, made.upper, success, made.reason is Reason.NOVEL, unobserved, *how)
        number = 0 if model is None else next(self._provisional)
        self._waiting[made.id] = known, success, number
        if model is not None:
            # What this very version embedded when it decided need not be embedded again.
            embedding = made.embedding if made.model_version == self.version else None
            point = model.place_safely(known.trace, known.content_hash, embedding)
            model.add_safely(point, int(success), known.content_hash, number)
        self.new_labels += self.fleet is None  # a product's labels are counted in their order, when they are kept
        return point if self.newest.keeps_references else None

    def owe(self, made: Decision) -> None:
        """Tell the rule that a part was decided wrongly, whichever way: its check was not reported in time."""
        if made.model_version < self.evidence.since:  # of an earlier policy, as in `learn`
            return
        for told in overdue_outcomes(made):
            self.overdue.add(made.id)
            self.newest.tell_safely(*told[1:])

    def unlearn(self, known: StoredDecision) -> None:
        """Take out the reference of a part whose label waits for the store: it was not what happened."""
        *_, number = self._waiting.pop(known.decision.id)
        if number:
            self.newest.change_reference(number, known.content_hash, None)
        self.new_labels -= self.fleet is None

    def keep(self, decision_id: str, seq: int) -> None:
        """Give a label that was learned, and is stored by now, to the next retrain."""
        if decision_id in self._waiting:
            known, success, number = self._waiting.pop(decision_id)
            if number:
                self.newest.renumber_reference(number, seq)
            keep = self.retrainer.window.add if self.fleet is None else self.fleet.keep
            keep(known.trace, int(success), known.content_hash, seq)

    def tell_anew(self) -> None:
        """Tell the rule everything again: what it was told was not what happened. StoreError where the store is away."""
        known = self.outbox.call_store(lambda: self.store.outcomes_since(0, self.evidence.since, self.overdue_to))
        tell_all(self.newest, lambda: known, self.evidence)

    def correct(self, own: bool = True) -> None:
        """Learn the store's newest corrections; a baseline is trained anew, by the cell that corrected."""
        self.outbox.check_integrity(0)  # the rule is told all of it
        window = self.retrainer.window
        last = None if self.fleet is None else window.newest_seq  # what peers stored since comes as their news
        window.refill(self.store.labelled(window.capacity, last=last))
        done = self.newest.keeps_references or self.answering is None
        for each in self.store.corrections(self.corrected_to):
            if self.answering is not None:
                done &= change(self.answering, self.store, each)
            self.corrected_to = each.number
        if self.fleet is None:
            self.new_labels = len(window.newer(0 if self._trained_on is None else self._trained_on.counts_from))
        else:
            self.fleet.recount()
        self.tell_anew()
        if own and not done:
            self.retrain()

    def take_back(self) -> None:
        """Learn that a confirmed part was bad: a correction, after what is being trained without it."""
        self.collect(HUNG)
        self.correct()

    def roll_back(self, number: int, event: Change) -> RetrainReport:
        """Let an earlier version answer again, as a new one, with what came since among its references."""
        self.outbox.check_integrity()
        begin, version = self.clock(), self.store.load_version(number)
        state = without_rule(version.state)  # which goes on
        model, trained_on = self.template.successor(), TrainedOn.from_state(version.state)
        if not model.keeps_references:
            # A baseline cannot take a label back: it learns from the same traces as they are labelled now.
            trained_on = replace(trained_on, corrected_to=self.corrected_to)
        if model.needs_refit(state) and not refit(model, self.outbox, trained_on):
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
        self._begin_counting()
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
        self._note_outcome(report)
        self._newest, self._trained_on = report.version, trained_on

    def _state(self, model: EngineModel, trained_on: TrainedOn) -> State:
        own = {"corrected_to": np.array(self.corrected_to)} | ({} if self.fleet is None else self.fleet.state())
        own |= {"overdue_to": np.array(self.overdue_to)}
        own |= {"includes_overdue": np.array(True)} if self.overdue else {}  # an opened engine tells the rule anew
        return model.get_state() | trained_on.to_state() | own

    def _begin_counting(self) -> None:
        """A retrain begins: it knows what can be known, and the labels of the next one are counted from here."""
        if self._ahead is not None:
            self._ahead.result()
            self._ahead = None
        self.new_labels = 0
        if self.fleet is not None:
            self.fleet.begin()

    def retrain(self) -> RetrainReport:
        """Train and swap, in line."""
        self.collect(HUNG)
        self.store_waiting()
        begin = self.clock()
        self._begin_counting()
        candidate = Candidate(self.retrainer.train(self.newest, begin), self.newest, self.version, self.clock)
        self._candidate, self._news = candidate, None
        self._advance(to_the_end=True)
        return self._news or candidate.report  # it is stored, and waits for the labels since

    def work(self, recipe: Recipe, once: bool = False) -> RetrainReport | None:
        """Retrain where it is due by a recipe and the store is there.

        once : do not continue a training that lacks steps where a retrain has ended since the news was taken.
        """
        every = recipe.retrain_every
        is_due = self.new_labels >= every if self.fleet is None else self.fleet.due(every)
        continues = self.training_left and not (once and self._news is not None)
        has_enough = max(self.new_labels, len(self.retrainer.window)) >= self.newest.min_traces
        if not (is_due and has_enough) and not continues:
            return None
        try:
            self.store_waiting()
        except StoreError:  # told by the outbox; the labels wait in its journal
            return None
        ahead = self.retrainer.executor is not None and self._ahead is not None and not self._ahead.done()
        return None if self.outbox.fault or ahead else self.start_retrain()  # beside the cell, which need not wait for it

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
            self._begin_counting()
            if self.retrainer.start(self.newest):
                return None
        return self.retrain()

    def collect(self, wait: float = 0.0, to_the_end: bool = False) -> None:
        """Bring in what an executor has finished: a step further, or to the end, as where it is waited for."""
        if self.retrainer.future is None and self._candidate is None:
            return
        to_the_end |= wait > 0.0 or self.fleet is not None  # peers' versions and corrections do not come in between
        trained = self.retrainer.collect(wait)
        if trained is not None:
            self._candidate = Candidate(trained, self.newest, self.version, self.clock)
        if self._candidate is not None and (to_the_end or trained is None):  # to take it was a step
            self._advance(to_the_end)

    def _advance(self, to_the_end: bool) -> None:
        """Bring the version on its way in a step further. One that cannot be stored is dropped."""
        if (candidate := self._candidate) is None:
            return
        try:
            if not self._is_stored(candidate, to_the_end) or self._can_wait(candidate, to_the_end):
                return
        except StoreError as error:  # a version that is not stored would be gone with the process
            log.warning("a retrain was dropped, for it could not be stored: %s", error)
            report, self._candidate, self._continues = candidate.report, None, False
            self.new_labels += report.n_traces  # its labels are as many new ones, so that the next retrain is soon
            self._news = replace(report, version=self.version, accepted=False, reason=f"dropped: not stored: {error}")
            self._note_outcome(self._news)
            return
        try:
            self.store_waiting()  # what was confirmed since is to be among its references
        except StoreError as error:
            log.warning("version %d is stored, and answers once the labels since are: %s", candidate.report.version, error)
            return
        candidate.learn(self.retrainer.window)
        self._candidate = None
        self._swap(candidate)

    def _is_stored(self, candidate: Candidate, to_the_end: bool) -> bool:
        """Whether a version is in the store; False where another step is needed. StoreError where it cannot be."""
        if candidate.storing is None:
            if not candidate.learn(self.retrainer.window, np.inf if to_the_end else STEP):
                return False
            if self._can_wait(candidate, to_the_end):
                return False
            self.store_waiting()
            candidate.learn(self.retrainer.window)
            candidate.storing, candidate.until = self._store(candidate), time.monotonic() + self.outbox.limit
        storing = candidate.storing
        if not to_the_end and not storing.done() and (storing.running() or time.monotonic() < candidate.until):
            return False
        number = self.outbox.wait_for_result(storing)  # a peer's version may have come before it
        candidate.report = replace(candidate.report, version=number or candidate.report.version)
        return True

    def _can_wait(self, candidate: Candidate, to_the_end: bool) -> bool:
        """Whether labels are on their way into the store, and the cell need not wait for that."""
        candidate.patience -= 1
        return not to_the_end and candidate.patience > 0 and self.outbox.request_label_drain()

    def _store(self, candidate: Candidate) -> Future[int]:
        model, state = candidate.model, None
        candidate.report = replace(candidate.report, seconds=candidate.seconds)  # storing it comes on top
        if model is not None:
            candidate.report = replace(candidate.report, version=self.next_number, accepted=True)
            candidate.trained_on = TrainedOn(candidate.seq, self.corrected_to, int(candidate.seq[-1]))
            state = self._state(model, candidate.trained_on)
        report, last = candidate.report, self.retrainer.window.newest_seq
        return self.outbox.submit(lambda: self.store.put_version(report, last, state))

    def _swap(self, candidate: Candidate) -> None:
        model, self._news = candidate.model, candidate.report
        self._continues = model is not None
        self._note_outcome(candidate.report)
        if model is not None:
            model.untold = model.untold or self.newest.untold
            self.answering, self.version = model, candidate.report.version  # one reference is swapped
            self._newest, self._trained_on = self.version, candidate.trained_on
            if self.fleet is not None:
                self.fleet.swapped(model)

    def _note_outcome(self, report: RetrainReport) -> None:
        self.dropped = [] if report.accepted else [*self.dropped, report.reason]

    def take_news(self) -> RetrainReport | None:
        """The newest retrain, once."""
        news, self._news = self._news, None
        return news


class Fleet:
    """What one engine takes in of its product: the labels of all its cells, and their newest version."""

    def __init__(self, store: SqlStore, versions: ModelVersions) -> None:
        self.store, self.versions = store, versions
        self._ahead: dict[int, tuple[NDArray[np.float32], int, int]] = {}  # own labels, peers' missing
        self._since: list[tuple[int, bool]] = []  # labels since the newest retrain began: number, and whether it is own
        self._trained_to = 0  # newest label that the newest retrain knew
        self._told_to = 0  # newest own label: the rule was told of all until there
        self._holds_to = 0  # references hold every label until there, the window perhaps not yet
        self._refused = 0  # a version that could not be taken over
        self._asked = -np.inf
        self._lost = False
        self._window = versions.retrainer.window

    def resume(self) -> None:
        """The engine has gone on from the store."""
        n, seq = self.versions.new_labels, self._window.newer(0)
        self._since = [(number, False) for number in seq[len(seq) - n :]]
        self._trained_to = seq[-n - 1] if len(seq) > n else 0
        self._told_to, self._asked = self._window.newest_seq, self.versions.clock()

    def state(self) -> dict[str, NDArray[Any]]:
        """What a version has to say of this cell."""
        return {"rule_last_seq": np.array(self._told_to)}

    def keep(self, trace: NDArray[np.float32], label: int, hash_: int, seq: int) -> None:
        """Take a label of this cell that was stored, and is a reference already."""
        self._ahead[seq], self._told_to = (trace, label, hash_), max(seq, self._told_to)
        if seq == self._window.newest_seq + 1:
            self._admit(trace, label, hash_, seq)

    def _admit(self, trace: NDArray[np.float32], label: int, hash_: int, seq: int) -> None:
        own = self._ahead.pop(seq, None) is not None
        self._window.add(trace, label, hash_, seq)
        if seq > self._trained_to:
            self._count([*self._since, (seq, own)])
        model = self.versions.answering
        if not own and seq > self._holds_to and model is not None:
            model.add_safely(model.place_safely(trace, hash_), label, hash_, seq)

    def _count(self, since: list[tuple[int, bool]]) -> None:
        self._since, self.versions.new_labels = since, len(since)

    def due(self, retrain_every: int) -> bool:
        """Whether a retrain is this cell's turn: the label that makes it due is its own, or nobody did it for long."""
        if self.versions.clock() - self._asked >= NEWS_SECONDS:
            self.take_in()
        if not self._turn(retrain_every):
            return False
        self._take_in_all()  # a peer's version may have come
        return self._turn(retrain_every)

    def _turn(self, retrain_every: int) -> bool:
        due, late = self._since[retrain_every - 1 : retrain_every], self._since[2 * retrain_every - 1 :]  # a peer's turn
        return any(own for _, own in (*due, *late))

    def begin(self) -> None:
        """A retrain begins: it knows as much of the product as can be had, and counting starts anew."""
        self._take_in_all()
        self._trained_to = self._window.newest_seq
        self._count([])

    def _take_in_all(self) -> None:
        for _ in range(ROUNDS):
            if self.take_in() < MOST:
                return

    def take_in(self) -> int:
        """Take in the peers' newest version and labels, `MOST` at most; returns how many. A lost connection is none."""
        try:
            self.versions.journal_cleared()
            seq = self._window.newest_seq
            news = self.versions.outbox.call_store(lambda: self.store.news_since(seq, MOST))
            newer = news.version > max(self.versions.version, self._refused)
            if newer or len(news.labelled.seq):
                self.versions.outbox.call_store(lambda: self.versions.outbox.check_integrity(since=seq))
            if newer:
                self.versions.store_waiting()  # the next model is to know of them too
            version = self.versions.outbox.call_store(self.store.last_version) if newer else None
        except StoreError as error:
            if not self._lost:
                log.warning("news of product %s cannot be had; the cell goes on without: %s", self.store.product, error)
            self._lost, self._asked = True, self.versions.clock()
            return 0
        if self._lost:
            log.warning("news of product %s comes again", self.store.product)
        self._lost = False
        if version is not None:
            self._take_over(version)
        labelled = news.labelled
        for row in zip(labelled.traces, labelled.labels, labelled.hashes, labelled.seq, strict=True):
            self._admit(row[0], int(row[1]), int(row[2]), int(row[3]))
        if news.correction > self.versions.corrected_to:
            try:
                self.versions.correct(own=False)
            except StoreError as error:  # asked for again with the next news
                log.warning("corrections of product %s cannot be had yet: %s", self.store.product, error)
        n = len(labelled.seq)
        self._asked = self.versions.clock() if n < MOST else -np.inf  # more is waiting: the next cycle goes on
        return n

    def _take_over(self, version: ModelVersion) -> None:
        """Let a peer's version answer, with every label since and this cell's own rule; one that fails is left alone."""
        versions = self.versions
        trained_on = TrainedOn.from_state(version.state)
        try:
            model = restored(versions.outbox, versions.template, without_rule(version.state))
            if model is None:
                raise StoreError("a trace that it was fitted on has changed; see `dengine verify`.")
            join_since(model, self.store, version, self._window)
        except Exception as error:  # what fails in a model is recorded, and the version before goes on answering
            log.exception("version %d of product %s cannot be taken over", version.version, self.store.product)
            self._refused = self._refused if isinstance(error, StoreError) else version.version
            return
        model.prepare_safely(versions.newest)
        self._holds_to = known_to(version)
        self._add_ahead(model, self._holds_to)
        versions.take_over(model, version.version, trained_on)
        self._trained_to = trained_on.counts_from
        self._count([each for each in self._since if each[0] > self._trained_to])

    def _add_ahead(self, model: EngineModel, last_seq: int) -> None:
        for seq, (trace, label, hash_) in self._ahead.items():
            if seq > last_seq:
                model.add_safely(model.place_safely(trace, hash_), label, hash_, seq)

    def swapped(self, model: EngineModel) -> None:
        """A version that this cell trained answers: labels of its own that wait for peers' before them are in it too."""
        self._holds_to = 0
        self._add_ahead(model, 0)

    def recount(self) -> None:
        """The window was filled anew: what was forgotten does not count, and what counts again does."""
        own = {number for number, mine in self._since if mine}
        self._count([(number, number in own) for number in self._window.newer(self._trained_to)])

    def complete(self) -> None:
        """Take in all news, before a person changes something; StoreError where it cannot be had."""
        self._take_in_all()
        if self._lost or self._ahead:
            raise StoreError(f"News of product {self.store.product!r} cannot be had now; try it again.")
