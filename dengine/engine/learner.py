"""`Learner` calls, in the right order, all that an engine learns with: store labels, update the
rule, train, swap, take in peers' news. `core.EngineCore` calls it once per decision, report and
cycle.

It is the only object that calls the others in this order. `Feedback` turns outcomes into labels,
`LiveModel` learns them, `Retrainer` trains a candidate, and `Peers` reads what other cells of the
product made; none of them knows the learner.
"""

from __future__ import annotations

import logging
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ..decision.policy import Policy
from ..errors import StoreError
from ..model.base import EngineModel
from ..recipe import Recipe
from ..records import RetrainReport
from ..store.outbox import Outbox
from ..store.records import Change, StoredDecision, without_rule
from .candidate import Candidate
from .feedback import Feedback, Remedy
from .fleet import MOST, ROUNDS, Peers
from .guard import GuardedModel, logged_failure
from .labels import CellLabels, ProductLabels
from .live_model import LiveModel
from .resume import add_labels_since, find_clean_start, refit
from .settings import EvidenceWindow
from .trainer import Clock, Retrainer, Trained, TrainedOn, TrainingWindow

log = logging.getLogger("dengine")
STEP = 0.0005  # seconds of catching up in one step: a label or two
# So many labels without any retrain were imported, and the first training is worth preparing.
IMPORTED = 500


class Learner:
    """Takes an engine's model from each outcome to the next version.

    Parameters
    ----------
    outbox : Outbox
    live : LiveModel
    window : TrainingWindow
    labels : CellLabels or ProductLabels
    feedback : Feedback
    peers : Peers or None
        None where the cell shares no product.
    retrainer : Retrainer
    clock : callable
        Seconds, of any origin, by which retrains are timed.

    Attributes
    ----------
    dropped : list of str
        Reasons of the retrains that were dropped since the last accepted one.
    """

    def __init__(
        self,
        outbox: Outbox,
        live: LiveModel,
        window: TrainingWindow,
        labels: CellLabels | ProductLabels,
        feedback: Feedback,
        peers: Peers | None,
        retrainer: Retrainer,
        clock: Clock,
    ) -> None:
        self.live = live
        self.labels = labels
        self.dropped: list[str] = []
        self._outbox = outbox
        self._store = outbox.store  # called without a time limit, so never while the cell waits
        self._window = window
        self._feedback = feedback
        self._peers = peers
        self._retrainer = retrainer
        self._clock = clock
        self._candidate: Candidate | None = None
        self._report: RetrainReport | None = None  # of the newest retrain, until it is taken
        self._was_accepted = True  # the last retrain
        self._precomputed: Future[None] | None = None  # what the next retrain begins with
        self._is_requested = False  # a training is to begin as soon as it can
        # What the next training starts from, and the answering version and correction that it is
        # for.
        self._start: tuple[tuple[int, int], EngineModel, str] | None = None

    def resume(self, label_within: int, policy_since: int) -> None:
        """Restore window, version, rule and counts from the store, bit for bit, when an engine
        opens it.

        A check is overdue after `label_within` later decisions; `policy_since` is the first version
        under the policy in force. With a version, or with at least `IMPORTED` labels, it also
        begins in a thread to compute what the next retrain starts with. Raises StoreError where the
        store cannot be read.
        """
        version = (
            self._store.versions.newest()
        )  # before the labels: a peer may store both meanwhile
        labelled = self._store.labels.with_traces(self._window.capacity)
        self._window.refill(labelled)
        reports = self._store.versions.retrains()
        for report in reports:
            self._note_outcome(report)
        newest_version = max((report.version for report in reports), default=0)
        self.live.resume(version, newest_version, label_within, policy_since)
        if self.live.answering is not None or len(labelled.seq) >= IMPORTED:
            self.precompute()
        self.labels.resume(self.live.trained_on.counts_from)
        if self._peers is not None:
            self._peers.resume()

    def precompute(self) -> None:
        """Start a thread that computes what the next retrain begins with; do not wait for it.

        The result is kept in the model that the next training starts from. While an earlier one has
        not been waited for, nothing is started. There must be labels.
        """
        if self._precomputed is not None:
            return
        labelled = self._window.snapshot()
        start = self._choose_start()
        pool = ThreadPoolExecutor(1, "dengine-precompute", torch.set_num_threads, (1,))
        model = GuardedModel(start)
        self._precomputed = pool.submit(model.precompute, labelled.traces, labelled.seq)
        pool.shutdown(wait=False)

    # One outcome

    def report(self, stored: StoredDecision, success: bool) -> None:
        """Learn a reported label, and return once it is on disk.

        If silence had confirmed the part before, it also waits for the store, so that the rule is
        put right now; where the store does not answer, that happens later. A safe mode that began
        or ended is announced. Raises ReportError for a second label, except that a line stop may
        follow a confirmation, and NotTakenError where the label is not known to be on disk: it is
        learned all the same, and the same report may come again.
        """
        self.catch_up()
        confirmed_wrongly = self._feedback.take_in(stored, success)
        self._outbox.sync()
        self._feedback.note_synced(stored.decision.id)
        if confirmed_wrongly:
            with suppress(StoreError):  # then it is put right when the store is back
                self._outbox.drain()
        self.catch_up()
        self._feedback.announce_safe_mode()

    def catch_up(self) -> None:
        """Take in the numbers that a product gave its labels, and do what `Feedback.remedy` asks.

        The remedy, a rebuild of the rule and perhaps a correction, is left to a later call while
        the store lacks records or has a fault. A correction first ends a retrain under way, as
        `end_training` does, and retrains a model that cannot change its references. Where the store
        fails meanwhile, that is logged, and a later call tries again.
        """
        self._feedback.number_labels()
        if self._feedback.remedy is None or not self._outbox.is_drained or self._outbox.fault:
            return
        # A rule that is rebuilt from the store would forget labels that are pending.
        if self._feedback.store_pending() and not self._outbox.is_drained:
            return
        remedy = self._feedback.take_remedy()
        if remedy is None:
            return
        try:
            if remedy is Remedy.CORRECT:
                self.end_training()  # what is being trained does not have the correction
                self.apply_corrections()
            else:
                self.live.rebuild_rule()
        except StoreError:
            self._feedback.retry_remedy(remedy)
            log.exception("the rule is rebuilt when the store is back")

    def store_labels(self) -> None:
        """Wait until every label is in the store and has its number.

        That includes labels of silently confirmed parts. Raises StoreError where the store is away.
        """
        self._feedback.store_pending()
        self._drain_labels()

    def _drain_labels(self) -> None:
        """Wait until the store has the labels that are in the journal, then catch up.

        Raises StoreError where it is away.
        """
        if self._outbox.request_label_drain():
            self._outbox.drain()
        self.catch_up()

    # A retrain

    def retrain(self) -> RetrainReport:
        """Train a version in this thread, let it answer, and return the report.

        A retrain under way in the executor is ended first, and news of peers is taken in. A version
        that fails or cannot be stored is dropped, and the report says so. A version that is stored,
        while labels that came since cannot be, answers at a later call; its report is returned all
        the same. Raises StoreError where the labels before it cannot be stored.
        """
        self.end_training()
        self.store_labels()
        begin = self._clock()
        self._begin_retrain()
        trained = self._retrainer.train(self._choose_start(), begin)
        candidate = self._as_candidate_of(trained)
        self._candidate = candidate
        self._report = None
        self._advance(to_the_end=True)
        # A version that is stored may still wait for labels that came since.
        return self._report or candidate.report

    def start_retrain(self) -> RetrainReport | None:
        """Begin to train in the executor and return None.

        A training under way comes a step further, and a new one begins only if that ended it.
        Before a new one, labels are stored, and news of peers is taken in. While the executor works
        on a training that was discarded, or what a retrain begins with is computed, it begins
        later, by `retrain_if_due`. Without an executor that takes work, retrain in this thread and
        return the report. Raises StoreError where the labels before it cannot be stored.
        """
        self.collect()
        if self._is_at_work:
            return None
        if self._retrainer.executor is not None:
            precomputed = self._precomputed
            is_preparing = precomputed is not None and not precomputed.done()
            if is_preparing or self._retrainer.is_occupied:
                self._is_requested = True
                return None
            self.store_labels()
            self._begin_retrain()
            if self._retrainer.start(self._choose_start()):
                return None
        return self.retrain()

    def retrain_if_due(self, recipe: Recipe, once: bool = False) -> RetrainReport | None:
        """Retrain, or begin to, if enough new labels came or the version lacks training steps.

        There must be as many labels as the model's `min_traces`, unless it was asked for and could
        not begin then. News of peers is taken in first, so another version may answer even if none
        is trained here. A pinned version stays. With `once` a version that lacks steps is not
        trained on until the report of its last retrain was taken.
        Returns the report of a retrain in this thread; else None: none is due, the store is away, a
        training or its preparation is under way, or it was begun in the executor.
        """
        is_due = self._is_due_after_news(recipe.retrain_every)
        if self.live.pinned:
            self._is_requested = False
            return None
        lacks_steps = self._lacks_steps and not (once and self._report is not None)
        n_labels = max(self.labels.new_labels, len(self._window))
        has_enough = n_labels >= self.live.newest.min_traces
        if not (is_due and has_enough) and not lacks_steps and not self._is_requested:
            return None
        try:
            self.store_labels()
        except StoreError:  # logged by the outbox; the labels wait in its journal
            return None
        return None if self._outbox.fault else self.start_retrain()

    @property
    def _lacks_steps(self) -> bool:
        """Whether the newest version has training steps left, as after a large import.

        While it has, the engine retrains without waiting for new labels. False in any of these
        cases: no version is in use yet; the last retrain was dropped; the newest version's retrain
        took no step; or the engine has peers, each of which would train the same version.
        """
        is_alone = self._peers is None and self.live.answering is not None
        if not (is_alone and self._was_accepted):
            return False
        report = self.live.newest.report
        return report.n_steps > 0 and report.n_steps_left > 0

    @property
    def is_swapping(self) -> bool:
        """Whether a trained version is being swapped in, one step with each call of the engine."""
        return self._candidate is not None

    @property
    def _is_at_work(self) -> bool:
        """Whether a training is under way in the executor, or its version is being swapped in."""
        return self._retrainer.future is not None or self.is_swapping

    @property
    def is_busy(self) -> bool:
        """Whether a retrain is under way, or waits until it can begin."""
        return self._is_at_work or self._is_requested

    def end_training(self) -> None:
        """End what is under way without waiting for a training, before a change that it lacks.

        A version that is trained answers, or is dropped. A training that is not done is discarded,
        and another begins as soon as it can, after the change.
        """
        self.collect(to_the_end=True)
        self._discard_training()

    def _discard_training(self) -> None:
        """Discard a training that is under way in the executor, and ask for another one."""
        if self._retrainer.discard():
            log.info("a training was discarded for a change; another one begins")
            self._is_requested = True

    def collect(self, wait: float = 0.0, to_the_end: bool = False) -> None:
        """Take a training's outcome from the executor, and bring its version closer to answering.

        Each call does one short step: take the outcome, catch up on labels, store the version, or
        swap it in. With `to_the_end`, with `wait` above 0, and always where cells share a product,
        it does all steps of a training that is done, and blocks for the store. `wait` is also how
        many seconds to wait for a training that is not done; then that is given up, as is one that
        hangs. Nothing happens while one is not done, or where there is none.
        """
        if not self._is_at_work:
            return
        if self._peers is not None:
            if self._retrainer.is_done:
                self._take_in_all_news()  # a correction or a pinned version discards the training
            to_the_end = True  # no version or correction of a peer comes in between two steps
        trained = self._retrainer.collect(wait)
        if trained is not None:
            self._candidate = self._as_candidate_of(trained)
        to_the_end = to_the_end or wait > 0.0
        if self._candidate is not None and (to_the_end or trained is None):  # taking it was a step
            self._advance(to_the_end)

    def _as_candidate_of(self, trained: Trained) -> Candidate:
        """Return the outcome of a training as a candidate that takes over the answering model's
        rule.
        """
        note = self._start[2] if self._start is not None else ""
        if note:
            trained = replace(trained, reason=f"{trained.reason}; {note}")
        return Candidate(trained, self.live.newest, self.live.version, self._clock)

    def _choose_start(self) -> EngineModel:
        """Return the model that the next training starts from, as `find_clean_start` does.

        It is searched for once for an answering version and the corrections that it has. Where the
        store fails meanwhile, that is logged, and the training starts from initial weights.
        """
        live = self.live
        if not live.corrected_to:  # nothing was ever forgotten, so the store need not be read
            return live.newest
        key = (live.version, live.corrected_to)
        if self._start is None or self._start[0] != key:
            start = live.template, "from initial weights"
            with logged_failure("weights before the forgotten labels cannot be searched for"):
                start = find_clean_start(self._store, live.template, live.newest, live.trained_on)
            self._start = key, *start
        return self._start[1]

    def wait_until_precomputed(self) -> None:
        """Wait until what the next retrain needs of the stored labels' traces is computed.

        This began when the store was opened. Without stored labels nothing is waited for.
        """
        if self._precomputed is not None:
            self._precomputed.result()
            self._precomputed = None

    def _begin_retrain(self) -> None:
        """Prepare for a training: wait for what is computed in advance, take in the peers' news if
        the store answers, and count new labels from zero.
        """
        self.wait_until_precomputed()
        self._take_in_all_news()
        self.labels.begin_retrain()
        self._is_requested = False

    def _advance(self, to_the_end: bool) -> None:
        """Bring the candidate further: check it, catch up on labels, store it, catch up again, swap
        it in.

        It takes one step, or all steps with `to_the_end`; without a candidate none. A candidate
        that cannot be stored is dropped. One that is stored waits for a later call where the newest
        labels cannot be stored; that is logged.
        """
        candidate = self._candidate
        if candidate is None:
            return
        try:
            is_stored = self._store_candidate(candidate, to_the_end)
        except StoreError as error:  # a version that is not stored would be gone with the process
            self._drop(candidate, error)
            return
        if not is_stored or self._waits_for_labels(candidate, to_the_end):
            return
        try:
            self.store_labels()  # what was confirmed since is to be among its references
        except StoreError as error:
            version = candidate.report.version
            log.warning(
                "version %d is stored, and answers once the labels since are: %s", version, error
            )
            return
        candidate.catch_up(self._window)
        self._candidate = None
        self._swap(candidate)

    def _store_candidate(self, candidate: Candidate, to_the_end: bool) -> bool:
        """Store the candidate, set the number that the store gave it, and return True.

        Returns False if another step is needed: labels are missing, or the commit is under way.
        With `to_the_end` it blocks for both instead; without, it blocks only for labels that
        `PATIENCE` steps did not bring. Raises StoreError where it cannot be stored.
        """
        if candidate.storing is None:
            if not candidate.check(np.inf if to_the_end else STEP):
                return False
            if not candidate.catch_up(self._window, np.inf if to_the_end else STEP):
                return False
            if self._waits_for_labels(candidate, to_the_end):
                return False
            self.store_labels()
            candidate.catch_up(self._window)
            candidate.begin_storing(self._begin_storing(candidate), self._outbox.limit)
        if candidate.storing is None or (not to_the_end and candidate.may_go_on_storing()):
            return False
        candidate.set_version(self._outbox.wait_for_result(candidate.storing))
        return True

    def _begin_storing(self, candidate: Candidate) -> Future[int]:
        """Complete the candidate's report, and submit report and model to the thread that stores
        them.

        Returns a future of the version's number: the report's, or a higher one if a peer of the
        product stored a version first. Without a model only the report is stored, and the number is
        the report's. Raises StoreError where the store is unavailable.
        """
        report = candidate.complete_report(self.live.next_version, self.live.corrected_to)
        newest_seq = self._window.newest_seq
        state = None
        if candidate.model is not None:
            state = self._state_of(candidate.model, candidate.trained_on)
        return self._outbox.store_version(report, newest_seq, state)

    def _state_of(self, model: EngineModel, trained_on: TrainedOn) -> dict[str, Any]:
        """Return the arrays of this model as a version, by name, for the store."""
        return self.live.get_state(model, trained_on) | self.labels.get_state()

    def _waits_for_labels(self, candidate: Candidate, to_the_end: bool) -> bool:
        """Return whether the candidate should wait another step for labels to be stored.

        It asks the outbox to store them at once. False with `to_the_end`, and when the candidate
        has waited for `PATIENCE` steps.
        """
        has_lost_patience = candidate.lose_patience()
        return not to_the_end and not has_lost_patience and self._outbox.request_label_drain()

    def _swap(self, candidate: Candidate) -> None:
        """Let a stored candidate answer, with the present rule, and keep its report for
        `take_report`.

        Without a model, when the training was dropped, the old version goes on answering; the
        report is kept, and its reason added to `dropped`.
        """
        self._report = candidate.report
        self._was_accepted = candidate.model is not None
        self._note_outcome(candidate.report)
        if candidate.model is not None:
            self._start = None  # lets go of the previous model
            # An update of the rule may have failed since the candidate took it over.
            GuardedModel(candidate.model).prepare(self.live.newest)
            self.live.swap_in(candidate.model, candidate.report.version, candidate.trained_on)
            self.labels.add_missing_references(candidate.model)

    def _drop(self, candidate: Candidate, error: StoreError) -> None:
        """Drop a candidate that could not be stored, and keep a report that says so, in memory
        only.

        In a cell that learns alone its labels count as new again, so that the next retrain is soon.
        """
        log.warning("a retrain was dropped, for it could not be stored: %s", error)
        self._candidate = None
        self._was_accepted = False
        self.labels.give_back(candidate.report.n_traces)
        self._report = replace(
            candidate.report,
            version=self.live.version,
            accepted=False,
            reason=f"dropped: not stored: {error}",
        )
        self._note_outcome(self._report)

    def _note_outcome(self, report: RetrainReport) -> None:
        """Add the reason of a dropped retrain to `dropped`; an accepted one empties the list."""
        self.dropped = [] if report.accepted else [*self.dropped, report.reason]

    def take_report(self) -> RetrainReport | None:
        """Return the report of the newest retrain, once; None where it was taken."""
        report = self._report
        self._report = None
        return report

    # News of a product

    def _is_due_after_news(self, retrain_every: int) -> bool:
        """Return whether a retrain is due by the number of new labels, and this cell's to do.

        Where cells share a product, news is taken in first, if none was asked for lately: a peer's
        version may answer afterwards. If a retrain is due then, all news is taken in, and it is
        counted again.
        """
        if self._peers is not None and self._peers.is_news_due:
            self._take_in_news(self._peers)
        if not self.labels.is_due(retrain_every):
            return False
        self._take_in_all_news()  # a peer's version may have come
        return self.labels.is_due(retrain_every)

    def _take_in_all_news(self) -> None:
        """Take in the peers' news until there is no more, but at most `ROUNDS` times.

        Where the store is away it stops, `Peers.is_lost` is set, and nothing is raised. Without
        peers it does nothing.
        """
        peers = self._peers
        if peers is None:
            return
        for _ in range(ROUNDS):
            if self._take_in_news(peers) < MOST:
                return

    def _take_in_news(self, peers: Peers) -> int:
        """Take in the peers' newest version, at most `MOST` labels, and corrections.

        Before, it waits until this cell's recorded labels are in the store. Returns the number of
        labels; 0 also where the store is away, which is noted in `peers` and not raised.
        Corrections that cannot be read come with the next news.
        """
        version = None
        try:
            self._drain_labels()  # one of the news may be a label of this cell
            news, has_newer_version = peers.fetch_news()
            if has_newer_version:
                self.store_labels()  # the peers' version is to have them among its references
                version = self._outbox.call_store(self._store.versions.newest)
        except StoreError as error:
            peers.note_loss(error)
            return 0
        peers.note_connection()
        if version is not None:
            peers.take_over(version)
            if self.live.pinned:
                self._discard_training()
        peers.take_in(news)
        if news.correction > self.live.corrected_to:
            self._discard_training()  # it does not have the corrections
            try:
                self.apply_corrections(may_retrain=False)
            except StoreError as error:  # asked for again with the next news
                product = self._store.product
                log.warning("corrections of product %s cannot be had yet: %s", product, error)
        n_labels = len(news.labelled.seq)
        peers.note_taken(n_labels)
        return n_labels

    # What people put right

    def bring_up_to_date(self) -> None:
        """Finish what is under way before a person's change: labels and news of peers.

        A training is ended, as `end_training` does; of the news at most `ROUNDS` times `MOST`
        labels are taken in. Raises StoreError where the store is away, or where labels
        of peers before one of this cell's are missing.
        """
        self.end_training()
        self.store_labels()
        self._take_in_all_news()
        if self._peers is not None and (self._peers.is_lost or self.labels.has_gaps):
            raise StoreError(
                f"News of product {self._store.product!r} cannot be had now; try it again."
            )

    def apply_corrections(self, may_retrain: bool = True) -> None:
        """Apply the store's newest corrections to window, references, count of new labels and rule.

        A model that cannot change a reference is retrained, or a pinned one fitted again, if
        `may_retrain`: only the cell that corrected does so. Where labels were forgotten, what the
        next training starts from is prepared in a thread. Raises StoreError where the store is
        away.
        """
        self._outbox.check_integrity(0)  # the rule is rebuilt from all of it
        last = self.labels.last_to_read
        self._window.refill(self._store.labels.with_traces(self._window.capacity, last=last))
        is_done = self.live.apply_corrections()
        self.labels.recount(self.live.trained_on.counts_from)
        self.live.rebuild_rule()
        self._prepare_start()
        if is_done or not may_retrain:
            return
        if self.live.pinned:
            version = self.live.version
            text = f"version {version} is fitted again, to labels as they count now"
            self.roll_back(version, Change("rollback", text))
        else:
            self.retrain()

    def _prepare_start(self) -> None:
        """Compute in advance for the next training, where it does not start from what answers.

        Where that is in this thread, wait for it now, so that the retrain keeps its budget.
        """
        if self._choose_start() is self.live.newest or not len(self._window):
            return
        if self._precomputed is not None and self._precomputed.done():
            self._precomputed = None  # it was for another model
        self.precompute()
        if self._retrainer.executor is None:
            self.wait_until_precomputed()

    def release(self, author: str) -> Change:
        """Let retrains replace a pinned version again, store that as a new version, and return the
        event.

        Raises StoreError where it cannot be stored: then nothing changes.
        """
        live = self.live
        text = f"version {live.version} is pinned no more: the next retrain may replace it"
        event = Change("release", text, {"was": live.version, "now": live.next_version}, author)
        trained_on = replace(live.trained_on, pinned=0)
        self._store_and_swap_in(event, live.newest, trained_on, "released, the same model", 0.0)
        return event

    def roll_back(self, number: int, event: Change) -> None:
        """Let the earlier version `number` answer again, as a new version, pin it, and store it
        with `event`.

        Later labels, up to the window's capacity, become its references, and the present rule goes
        on. Afterwards news of peers is taken in, and new labels count from zero. Raises StoreError
        for a version that is not kept, where a trace is damaged that the model must be fitted on
        again, and where it cannot be stored.
        """
        self._outbox.check_integrity()
        begin = self._clock()
        version = self._store.versions.load(number)
        state = without_rule(version.state)  # the present rule goes on
        model = self.live.template.successor()
        trained_on = TrainedOn.from_state(version.state)
        if not model.keeps_references:
            # A baseline cannot take a label back: it is trained on the same traces as they are
            # labelled now.
            trained_on = replace(trained_on, corrected_to=self.live.corrected_to)
        if model.needs_refit(state) and not refit(model, self._outbox, trained_on):
            raise StoreError(
                f"Expected the traces that version {number} was fitted on as they were stored, "
                "some have changed; see `dengine verify`, and restore the store from a copy."
            )
        model.set_state(state)
        GuardedModel(model).prepare(self.live.newest)
        add_labels_since(model, self._store, version, self._window)
        trained_on = replace(trained_on, counts_from=self._window.newest_seq, pinned=number)
        reason = f"rolled back to version {number}"
        self._store_and_swap_in(event, model, trained_on, reason, self._clock() - begin)
        self._is_requested = False
        self._take_in_all_news()
        self.labels.begin_retrain()
        self._prepare_start()

    def set_policy(self, policy: Policy | None, evidence: EvidenceWindow, event: Change) -> None:
        """Go on under another policy, as a new version of the same model, and store it with
        `event`.

        With `policy` the rule starts anew and counts the decisions of `evidence`. With None only
        settings outside the model have changed, and its rule goes on. Before the first retrain only
        the event is stored. Raises SettingError for a rule that cannot be made, and StoreError
        where the event cannot be stored: then nothing changes.
        """
        live = self.live
        template = live.template
        model = live.answering
        if policy is not None:
            template, model = live.with_policy(policy, evidence)
        if model is None:
            self._store.corrections.apply(event)
        else:
            self._store_and_swap_in(
                event, model, live.trained_on, "another policy, the same model", 0.0
            )
        live.change_evidence(template, evidence)

    def _store_and_swap_in(
        self, event: Change, model: EngineModel, trained_on: TrainedOn, reason: str, seconds: float
    ) -> None:
        """Store a model as the next version, together with the event of a person, and let it
        answer.

        Its report, accepted after `seconds` for this reason, becomes the newest. StoreError where
        it cannot be stored: then nothing changes.
        """
        n_traces = len(trained_on.seq)
        report = RetrainReport(self.live.next_version, seconds, n_traces, 0, True, reason)
        state = self._state_of(model, trained_on)
        self._store.corrections.apply(
            replace(event, version=(report, self._window.newest_seq, state))
        )
        self.live.swap_in(model, report.version, trained_on)
        self._report = report
        self._note_outcome(report)
