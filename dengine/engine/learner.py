"""`Learner` calls, in the right order, all that an engine learns with: store labels, update the
rule, train, swap, hear of peers. `engine.DataEngine` calls it once per decision, report and cycle.

It is the only object that calls the others in this order. `Feedback` turns outcomes into labels,
`LiveModel` learns them, `Retrainer` trains a candidate, and `Peers` reads what other cells of the
product made; none of them knows the learner.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import count

import torch

from ..decision.policy import Policy
from ..errors import StoreError, log
from ..model.base import EngineModel
from ..records import RetrainReport
from ..store.records import Change
from .candidate import Candidate
from .feedback import Feedback, Remedy
from .fleet import Peers
from .guard import NOT_PRECOMPUTED, NOT_READY, guarded
from .live_model import LiveModel
from .resume import add_labels_since, find_clean_start, restore_model
from .settings import EvidenceWindow
from .trainer import Retrainer, Trained, TrainedOn

# So many labels without any retrain were imported, and the first training is worth preparing.
IMPORTED = 500
PATIENCE = 20  # steps that a candidate leaves to the thread that stores its labels
# Of a candidate; each yields None, or a function that waits for the store.
Steps = Iterator[Callable[[], object] | None]


class Learner:
    """Takes an engine's model from each outcome to the next version.

    Only the thread that uses the engine calls its methods; other threads may read its properties
    (`EngineState`).

    Parameters
    ----------
    live : LiveModel
    feedback : Feedback
    peers : Peers or None
        None if the robot cell shares no product.
    retrainer : Retrainer
        Its clock times the retrains.

    Attributes
    ----------
    dropped : list of str
        Reasons of the retrains that were dropped since the last accepted one.
    """

    def __init__(
        self, live: LiveModel, feedback: Feedback, peers: Peers | None, retrainer: Retrainer
    ) -> None:
        self.live = live
        self.feedback = feedback
        self.dropped: list[str] = []
        self._outbox = live.outbox
        # Called without a time limit, so never while the cell waits.
        self._store = live.outbox.store
        self._window = live.window
        self._peers = peers
        self._retrainer = retrainer
        self._clock = retrainer.clock
        self._candidate: Candidate | None = None
        self._steps: Steps = iter(())  # of the candidate
        self._report: RetrainReport | None = None  # of the newest retrain, until it is taken
        self._was_accepted = True  # the last retrain
        self._precomputed: Future[None] | None = None  # what the next retrain begins with
        self._is_requested = False  # a training is to begin as soon as it can
        # What the next training starts from, and the answering version and correction that it is
        # for.
        self._start: tuple[tuple[int, int], EngineModel, str] | None = None

    def resume(self) -> None:
        """Restore training window, version, decision rule and count of new labels from the store.

        It is called when an engine opens the store. The training window holds the newest labelled
        traces. The newest version whose arrays are intact is restored bit for bit; but a model of
        which the store has only the numbers of its traces is trained on them again, and if one of
        these is damaged or missing, no model is in force. Damaged arrays and traces are reported by
        events (rows in the store's log). A difference between store and ledger (its hash chain)
        sets `integrity_error` of the outbox, through which the engine writes to the store; from
        then on every part is verified (sent to the slow check). If a model is in force, or the
        training window has at least IMPORTED labels (500), this also starts a thread that computes
        in advance for the next retrain (`precompute`). Raises StoreError if the store cannot be
        read, and the other errors of `LiveModel.resume`.
        """
        reports = self._store.versions.retrains()
        for report in reports:
            self._note_outcome(report)
        newest_version = max((report.version for report in reports), default=0)
        self.live.resume(newest_version)
        self._refill_window(self.live.corrected_to)
        if self.live.answering is not None or len(self._window) >= IMPORTED:
            self.precompute()

    def _refill_window(self, corrected_to: int) -> None:
        """Read the training window (newest labelled traces) from the store; count the new labels.

        Corrections (later changes of labels) up to the number `corrected_to` are applied. A label
        is new if its number is above `counts_from` of the version in force (`TrainedOn`). A damaged
        trace is left out, and reported by an event (a row in the store's log). Raises StoreError if
        the store cannot be read.
        """
        self._window.refill(
            self._store.labels.with_traces(self._window.capacity, corrected_to=corrected_to)
        )
        self.feedback.count_new_labels(self.live.trained_on.counts_from)

    def precompute(self) -> None:
        """Start a thread that computes in advance what the next training needs; do not wait for it.

        These are above all the features of the traces in the training window (the newest labelled
        traces). They are kept in the model that the training starts from. If labels were corrected,
        this call first looks for that model in the store, without a time limit (`_choose_start`). A
        failure is logged. Nothing is started if the training window is empty, or if
        `wait_until_precomputed` has not waited for an earlier thread yet.
        """
        if self._precomputed is not None or not len(self._window):
            return
        labelled = self._window.snapshot()
        start = self._choose_start()
        pool = ThreadPoolExecutor(1, "dengine-precompute", torch.set_num_threads, (1,))
        self._precomputed = pool.submit(
            guarded, NOT_PRECOMPUTED, start.precompute, labelled.traces, labelled.seq
        )
        pool.shutdown(wait=False)

    # Labels

    def catch_up(self) -> None:
        """Give labels the numbers that the store assigned, and put the rule right if it must be.

        The store assigns numbers only in a product (robot cells that share labels and versions).
        Checks whose report is overdue count as wrong decisions, too. The decision rule must be put
        right (`Feedback.remedy`) after it learned a wrong outcome: it is rebuilt from the stored
        outcomes; if a stored label was changed, all changes that the store has by now are first
        applied to what the model learned. This waits for a later call while the store lacks any
        record or has a fault. Before such changes a retrain under way is ended (`end_training`),
        and the store is checked against its ledger (its hash chain): after a difference every part
        is verified. A model that cannot change the label of a trace is retrained here, or, if it is
        pinned (kept in force by a rollback), fitted again. Nothing is raised: if the store fails
        meanwhile, that is logged, and a later call tries again; any other exception, for example of
        a model that is fitted again, is logged, and it is not tried again.
        """
        self.feedback.number_labels()
        remedy = self.feedback.remedy
        if remedy is None or not self._outbox.is_drained or self._outbox.fault:
            return
        self.feedback.remedy = None
        try:
            if remedy is Remedy.CORRECT:
                self.end_training()  # what is being trained does not have the correction
                self.apply_corrections()
            else:
                self.live.rebuild_rule()
        except StoreError:
            self.feedback.remedy = remedy
            log.exception("the rule is rebuilt when the store is back")
        except Exception:  # of a user's model that is fitted again
            log.exception("the model in force does not learn a corrected label")

    def store_labels(self) -> None:
        """Wait until every label is in the store and has its number; then do what `catch_up` does.

        If the store has every label, nothing is waited for. Raises StoreError if it is unavailable
        or takes too long.
        """
        if self._outbox.request_label_drain():
            self._outbox.drain()
        self.catch_up()

    # A retrain

    def retrain(self, wait: bool) -> RetrainReport | None:
        """Train a version and put it in force, in this thread, or begin to in the executor.

        First every label is stored, since a version is trained only on labels that the store has
        numbered. Then the call waits for what `precompute` computes in advance (above all features
        of the traces), and takes in what other cells of the product (robot cells that share labels
        and versions) stored (a newer version, changes of labels, and labels), since these may
        change what the training starts from. Then new labels count from zero, and the training
        begins. If a rollback in another cell has just pinned a version, so that no retrain should
        replace it, nothing begins with `wait` False; with `wait` True it is released first.

        With `wait` True, or if no executor takes work (none is there, or it died or hangs), all is
        done in this thread, which then has one torch thread, and the report is returned. Otherwise
        None is returned, and `advance` puts the version in force later. With `wait` False, None is
        also returned if a training is under way already, and then nothing is begun. If there is an
        executor, and the computing in advance is not done, the training is requested, and
        `retrain_if_due` begins it later.

        A version that fails or cannot be stored is dropped (not put in force), and the report says
        so. If the version is stored, but labels that came since cannot be, it is put in force by a
        later call; its report is returned all the same. Raises StoreError if the labels before the
        training cannot be stored, and in a product if the store does not answer; no training begins
        then. What the copying of a model that the user handed in raises is raised; no label counts
        as new then. With `wait` True no training may be under way (`end_training`).
        """
        if not wait:
            if self.is_at_work:
                return None
            is_preparing = self._precomputed is not None and not self._precomputed.done()
            if self._retrainer.executor is not None and is_preparing:
                self._is_requested = True
                return None
        self.store_labels()
        begin = self._clock()
        self.wait_until_precomputed()
        self._hear_of_peers()
        if self.live.pinned:  # by a peer, just now
            if not wait:
                return None
            self.release("")
        self.feedback.count_new_labels(self._window.newest_seq)
        self._is_requested = False
        start = self._choose_start()
        if not wait and self._retrainer.start(start):
            return None
        self._report = None
        candidate = self._make_candidate(self._retrainer.train(start, begin))
        self._advance(candidate, to_the_end=True)
        # A version that is stored may still wait for labels that came since.
        return self._report or candidate.report

    def retrain_if_due(self, once: bool = False) -> RetrainReport | None:
        """Retrain, or begin to, if there is a reason for it.

        There are three reasons. First, as many labels are new as the recipe's `retrain_every` says,
        and there are as many labels as the model needs for a training (`min_traces`). Second, the
        training of the version in force made some of its steps and not all, for example because the
        time budget ended it; this is a reason only in a robot cell that shares no labels and
        versions with others, and not after a retrain whose version was dropped (never put in
        force). Third, a retrain was requested earlier and could not begin then, or a training was
        discarded and is to begin again. A version that a rollback pinned is not replaced, and such
        a request is withdrawn. What the copying of a model that the user handed in raises is
        raised.

        In a product (robot cells that share labels and versions) a newer version and changes of
        labels of other cells are taken over first, so another cell's version may be in force
        afterwards, even if nothing is trained here. They are looked for once a second, and whenever
        a training can begin because labels are new.

        Parameters
        ----------
        once : bool, default False
            If True, the second reason does not count while the report of the last retrain waits for
            `take_report`.

        Returns
        -------
        RetrainReport or None
            The report of a retrain that was done in this thread. None if there is no reason or the
            version is pinned, if the store or its journal has a fault, if the labels cannot be
            stored, if a training or its preparation is under way, or if the executor now trains.
        """
        peers = self._peers
        may_train = self._has_labels and not (self.live.pinned or self.is_at_work)
        if peers is not None and (may_train or peers.is_look_due):
            self._try_to_hear(peers, with_labels=False)
        if self.live.pinned:
            self._is_requested = False
            return None
        # A training may have ended by its budget, as after a large import; then another begins
        # without new labels. Peers would each train the same version, so they wait for labels.
        is_alone = peers is None and self._was_accepted
        lacks_steps = is_alone and self.live.lacks_steps and not (once and self._report is not None)
        if not (self._has_labels or lacks_steps or self._is_requested):
            return None
        if self._outbox.fault:
            return None
        try:
            return self.retrain(wait=False)
        except StoreError:  # logged by the outbox; the labels wait in its journal
            return None

    @property
    def _has_labels(self) -> bool:
        """Whether as many labels are new as the recipe's `retrain_every` says, and the new ones, or
        those in the training window, are as many as a training needs (`min_traces`).
        """
        n_new = self.feedback.new_labels
        return n_new >= self.live.settings.now.recipe.retrain_every and (
            max(n_new, len(self._window)) >= self.live.newest.min_traces
        )

    @property
    def is_swapping(self) -> bool:
        """Whether a trained version is being put in force, a step with each call of the engine."""
        return self._candidate is not None

    @property
    def is_at_work(self) -> bool:
        """Whether a training is under way in the executor, or its version is not in force yet."""
        return self._retrainer.future is not None or self._candidate is not None

    @property
    def is_busy(self) -> bool:
        """Whether a retrain is under way, or waits until it can begin."""
        return self.is_at_work or self._is_requested

    def end_training(self) -> None:
        """End what is under way, before a change that a running training would lack.

        A version that is trained is put in force or dropped; for that the call waits for the store,
        but it never waits for a training. A training that is not done is discarded, and another
        begins as soon as it can, after the change. A version that is stored, but lacks newer labels
        that the store does not take now, goes on waiting.
        """
        self.advance(to_the_end=True)
        self._discard_training()

    def _discard_training(self) -> None:
        """Discard a training that is under way in the executor, and ask for another one.

        This is logged. Nothing happens if none is under way.
        """
        if self._retrainer.discard():
            log.info("a training was discarded for a change; another one begins")
            self._is_requested = True

    def advance(self, to_the_end: bool = False, wait: float = 0.0) -> None:
        """Take a training's outcome from the executor, or bring its version one step further.

        The executor is a pool of workers that trains beside the engine. Taking the outcome is a
        step; the others test the version, store it and put it in force. With `to_the_end` all steps
        of a training that is done are taken, and the call waits for the store. Nothing happens if
        no training is under way, or while it is not done; but a training that hangs (over 60 s), or
        whose executor died, is given up and dropped (no version of it is put in force). A version
        that cannot be stored is dropped, too. A version that is stored, but lacks newer labels that
        the store does not take now, waits for a later call. Nothing is raised.

        `wait` is the number of seconds to wait for a training that is not done; after that it is
        given up, and so is a training that hangs. In a product (robot cells that share labels and
        versions) all steps are taken in any case. When the training is done, or with `wait` above
        0, the call first takes in what the other cells stored: a change of a label or a rollback
        discards the training, and if the store is unavailable, the training waits for a later call.
        """
        if not self.is_at_work:
            return
        if self._peers is not None:
            to_the_end = True  # no version or correction of a peer comes in between two steps
            is_at_end = self._retrainer.is_done or wait > 0.0
            if is_at_end and not self._try_to_hear(self._peers):
                return
        candidate = self._candidate
        if candidate is None:
            trained = self._retrainer.collect(wait)
            if trained is None:
                return
            candidate = self._make_candidate(trained)
            if not to_the_end:  # taking it was a step
                return
        self._advance(candidate, to_the_end)

    def _make_candidate(self, trained: Trained) -> Candidate:
        """Make the outcome of a training the candidate, the version on its way to be put in force.

        It will take over the decision rule of the model in force. If the training started from
        another model, because labels were forgotten (withdrawn), the reason in its report says from
        which. Returns the candidate, whose steps (test, store, put in force) `_advance` takes; none
        is taken here.
        """
        note = self._start[2] if self._start is not None else ""
        if note:
            trained = replace(trained, reason=f"{trained.reason}; {note}")
        self._candidate = Candidate(trained, self.live, self._clock)
        self._steps = self._see_through(self._candidate)
        return self._candidate

    def _choose_start(self) -> EngineModel:
        """Return the model that the next training starts from: one that saw no forgotten label.

        Forgotten labels were withdrawn by a person. (A model that begins anew with each training
        may have seen one; see `find_clean_start`.) If no label was ever corrected or forgotten, the
        result is the model in force, or the untrained model before the first retrain. Otherwise
        `find_clean_start` chooses it from the store, and the choice is kept until another version
        is in force or another label is changed. If that raises, whatever it is, it is logged, and
        the training starts from initial weights.
        """
        live = self.live
        if not live.corrected_to:  # nothing was ever forgotten, so the store need not be read
            return live.newest
        key = (live.version, live.corrected_to)
        if self._start is None or self._start[0] != key:
            start = guarded(
                "weights before the forgotten labels cannot be searched for",
                find_clean_start,
                self._store,
                live.template,
                live.newest,
                live.trained_on,
            )
            self._start = key, *(start or (live.template, "from initial weights"))
        return self._start[1]

    def wait_until_precomputed(self) -> None:
        """Wait until the thread that `precompute` started is done.

        If no thread was started, or it was waited for before, this returns at once. There is no
        time limit.
        """
        if self._precomputed is not None:
            self._precomputed.result()
            self._precomputed = None

    # A candidate

    def _advance(self, candidate: Candidate, to_the_end: bool) -> None:
        """Bring the candidate, a trained version that is not in force yet, one step further.

        With `to_the_end` it takes all steps that are left: test, learn newer labels, store, learn
        newer labels, put in force. No StoreError is raised: a candidate that cannot be stored, or
        whose labels cannot be stored before it, is dropped (never put in force). A candidate that
        is stored waits for a later call if the newest labels cannot be stored, which is logged. A
        candidate without a model, because its training or its test failed, is not put in force:
        only its report is stored, and the previous version goes on. The time that this takes before
        it is stored counts as work on the retrain, in its report.
        """
        candidate.begin_work()
        try:
            for wait in self._steps:
                if not to_the_end:
                    break
                if wait is not None:
                    wait()
        except StoreError as error:
            if not candidate.is_stored:  # it would be gone with the process
                self._drop(candidate, error)
                return
            log.warning(
                "version %d is stored, and answers once the labels since are: %s",
                candidate.report.version,
                error,
            )
        candidate.end_work()

    def _see_through(self, candidate: Candidate) -> Steps:
        """Generate the steps that bring a trained version, the candidate, into force.

        It is tested first, so that a model that fails the test is never written to the store. It is
        stored with every label that came until then, and before it is in force: else a killed
        process would leave decisions of a version that nobody has. More labels may come while it is
        stored, so it learns these before it is put in force. If the training or the test failed,
        only the report is stored, and the previous version stays in force.

        Yields after each step: None, or, if the store has not done its part yet, a function that
        waits for it. If the store has not begun to commit the version within the seconds that a
        call waits for the store (`limit` of the outbox, which writes to it), the step itself waits
        for it. Raises StoreError if the version cannot be stored. The functions that it yields
        raise StoreError if the labels or the version cannot be stored.
        """
        candidate.check()
        yield None
        yield from self._catch_up_candidate(candidate)
        report = candidate.complete_report(self.live.next_version)
        model = candidate.model
        state = None if model is None else self.live.get_state(model, candidate.trained_on)
        storing = self._outbox.store_version(report, self._window.newest_seq, state)
        deadline = time.monotonic() + self._outbox.limit  # to begin; a commit that runs may go on
        while not storing.done() and (storing.running() or time.monotonic() < deadline):
            yield partial(self._outbox.wait_for_result, storing)
        candidate.end_storing(self._outbox.wait_for_result(storing))
        yield from self._catch_up_candidate(candidate)
        self._swap(candidate)

    def _catch_up_candidate(self, candidate: Candidate) -> Steps:
        """Add all labels that a candidate lacks to its references, and have them stored.

        The candidate is a trained version that is not in force yet; its references are labelled
        points that new traces are compared with. A label that it cannot take is logged and skipped.
        Each round first counts overdue checks (without a report in time) as wrong decisions and, in
        a product (robot cells that share labels and versions), takes over the numbers that the
        store gave the labels (`number_labels`). It yields None after each label, and a function
        that waits for the store if labels are not stored yet; it ends when no label is missing or
        waits to be stored. In a robot cell that never pauses some label always waits, so in every
        20th round this call waits for the store itself; a StoreError there is ignored.
        """
        for n_waits in count(1):
            self.feedback.number_labels()
            while candidate.learn_next(self._window):
                yield None
            if not self._outbox.request_label_drain():
                return
            if n_waits % PATIENCE:
                yield self._outbox.drain
            else:
                with suppress(StoreError):  # then the next time is a step again
                    self._outbox.drain()

    def _swap(self, candidate: Candidate) -> None:
        """Put a stored candidate (trained version) in force; keep its report for `take_report`.

        It takes over the present decision rule; a failure of this is logged. If the training was
        dropped, there is no model: the previous version stays in force, the report is kept, and its
        reason is added to the list `dropped`, which a version that is put in force empties.
        """
        self._candidate = None
        self._report = candidate.report
        self._was_accepted = candidate.model is not None
        self._note_outcome(candidate.report)
        if candidate.model is not None:
            self._start = None  # lets go of the previous model
            # An update of the rule may have failed since the candidate took it over.
            guarded(NOT_READY, candidate.model.prepare, self.live.newest)
            self.live.swap_in(candidate.model, candidate.report.version, candidate.trained_on)

    def _drop(self, candidate: Candidate, error: StoreError) -> None:
        """Drop a candidate (trained version) that could not be stored; keep a report in memory.

        It is logged with the `error`, and the previous version stays in force. As many labels as
        its training had are added to the count of new ones, so that the next retrain is soon. The
        reason in the report is added to `dropped`, the list of such reasons. Training steps that
        the time budget (the seconds of a retrain) cut off are then no reason for another training
        (`retrain_if_due`).
        """
        log.warning("a retrain was dropped, for it could not be stored: %s", error)
        self._candidate = None
        self._was_accepted = False
        self.feedback.give_labels_back(candidate.report.n_traces)
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
        """Return the report of the newest retrain, once; None if it was taken."""
        report = self._report
        self._report = None
        return report

    # The other cells of a product

    def _try_to_hear(self, peers: Peers, with_labels: bool = True) -> bool:
        """Take in what other cells stored (`_hear_of_peers`); return whether the store answered.

        The other cells are those of the product (robot cells that share labels and versions). What
        they stored are versions and corrections (changes of labels); the labels of all cells are
        read, too, if there is such news or with `with_labels`. If the store gave no answer, or this
        cell's labels could not be stored, the result is False; this is logged, once until it
        answers again, and nothing is raised.
        """
        failure = None
        try:
            self._hear_of_peers(with_labels)
        except StoreError as error:
            failure = error
        peers.note_answer(failure)
        return failure is None

    def _hear_of_peers(self, with_labels: bool = True) -> None:
        """Take over a newer version and corrections that other cells of the product stored.

        A product is several robot cells that share labels and versions; a correction is a later
        change of a label. If there is a newer version or correction, or with `with_labels`, this
        cell's labels are stored first, and the labels of all cells are read into the training
        window (the newest labelled traces) at the end. What is read is checked against the ledger
        (the store's hash chain); a difference sets the `integrity_error` of the outbox (by which
        the engine reaches its store), after which every part is verified. A version that cannot be
        used is logged, and the present version stays in force (`Peers.put_in_force`). A correction,
        or a newer version that a rollback pinned (no retrain may replace it), discards a training
        under way in the executor (a pool in which retrains run beside the engine). A correction
        changes one of the model's references (labelled points that new traces are compared with); a
        model that cannot do so is not retrained here. After a newer version the new labels are
        counted from those that it knows. Nothing happens in a cell without a product. Raises
        StoreError if the store is unavailable.
        """
        peers = self._peers
        if peers is None:
            return
        version, correction = peers.look()
        is_corrected = correction > self.live.corrected_to
        if not (version or is_corrected or with_labels):
            return
        self.store_labels()  # they are to be among the references of a peer's version
        self._outbox.check_integrity(self._window.newest_seq)
        is_newer = version > 0 and peers.put_in_force(version)
        if is_corrected or (is_newer and self.live.pinned):
            self._discard_training()  # it lacks the corrections, or would replace the version
        if is_corrected:
            self.apply_corrections(may_retrain=False)
        peers.read_labels()
        if is_newer:
            self.feedback.count_new_labels(self.live.trained_on.counts_from)

    # What people put right

    def bring_up_to_date(self) -> None:
        """Finish what is under way before a person's change: a training, labels, news of peers.

        So the change comes after everything that was known before it. A trained version is put in
        force or dropped, and a training that is not done is discarded and begins again later
        (`end_training`). News is what the product's other robot cells stored (`_hear_of_peers`). A
        trained version that cannot be stored is dropped. Raises StoreError if the engine is closed,
        only reads or was opened before a fork, and if the store is unavailable.
        """
        self._outbox.check_usable()
        self.end_training()
        self.store_labels()
        self._hear_of_peers()

    def apply_corrections(self, may_retrain: bool = True) -> None:
        """Apply the newest corrections (changes of labels) in the store to all that was learned.

        They change the training window (the newest labelled traces), the references (labelled
        points that new traces are compared with) and the count of new labels, and the decision rule
        is rebuilt. If the model cannot change a reference and `may_retrain` is True, it is
        retrained in this thread, or, if it is pinned (kept in force by a rollback), fitted again as
        a new version; only the robot cell that corrected does so, and no training may be under way
        then (`end_training`). If the next training does not start from the model in force, because
        labels were forgotten (withdrawn), its features are computed in advance
        (`_precompute_other_start`). The store is checked against its ledger (its hash chain); a
        difference sets `integrity_error` of the outbox, through which the engine writes to the
        store, after which every part is verified. A damaged trace is reported by an event (a row in
        the store's log). With no new correction the window is read and the rule rebuilt, too; a
        baseline (a model that the user handed in) is then retrained all the same. Raises StoreError
        if the store is unavailable, and what `retrain` raises, or, for a pinned model that is
        fitted again, `roll_back`.
        """
        live = self.live
        self._outbox.check_integrity(0)  # the rule is rebuilt from all of it
        corrections = self._store.corrections.after(live.corrected_to)
        corrected_to = corrections[-1].number if corrections else live.corrected_to
        self._refill_window(corrected_to)
        live.rebuild_rule()
        # After the rule, whose outcomes the store may not give: a later call does not apply these
        # corrections again, so it would not know that the model must be retrained.
        is_done = live.apply_corrections(corrections)
        self._precompute_other_start()
        if is_done or not may_retrain:
            return
        if live.pinned:
            version = live.version
            self.roll_back(
                version,
                Change(
                    "rollback", f"version {version} is fitted again, to labels as they count now"
                ),
            )
        else:
            self.retrain(wait=True)

    def _precompute_other_start(self) -> None:
        """Begin to precompute for the next training if it does not start from the model in force.

        The model in force is the one that decides now. After a label was forgotten (withdrawn), the
        training may start from an earlier version or from initial weights instead. A thread
        computes what that model needs of the traces in the training window (the newest labelled
        traces), and keeps it in that model; a failure is logged. Without labels, and while an
        earlier thread still works, nothing is begun. Without an executor (a pool in which retrains
        run beside the engine) the retrain would wait for the thread, and its report would count
        these seconds; so this call waits for the thread, also for an earlier one.
        """
        if self._choose_start() is self.live.newest:
            return
        if self._precomputed is not None and self._precomputed.done():
            self._precomputed = None  # it was for another model
        self.precompute()
        if self._retrainer.executor is None:
            self.wait_until_precomputed()

    def release(self, author: str) -> Change:
        """Let retrains replace the version that a rollback pinned, and return this change.

        The change is stored as an event, a row in the store's log. The same model, with its
        decision rule, goes on as a new version, of which `take_report` then returns a report. It is
        not checked that a version is pinned. If the new version cannot be stored, also because
        another robot cell that shares versions with this one stored one meanwhile, StoreError is
        raised and nothing changes.
        """
        live = self.live
        event = Change(
            "release",
            f"version {live.version} is pinned no more: the next retrain may replace it",
            {"was": live.version, "now": live.next_version},
            author,
        )
        self._store_and_swap_in(
            event, live.newest, replace(live.trained_on, pinned=0), "released, the same model", 0.0
        )
        return event

    def roll_back(self, number: int, event: Change) -> None:
        """Put the earlier version `number` in force again, as a new version that is pinned.

        Pinned means that no automatic retrain replaces it. No training may be under way
        (`end_training`). The version is stored together with `event`, and `take_report` then
        returns a report of it. Until it is stored nothing changes, so all that can fail comes
        before: checking the store against its ledger (its hash chain), reading the version,
        restoring it, and adding the later labels, up to the capacity of the training window (the
        newest labelled traces), as its references (labelled points that new traces are compared
        with). A difference from the ledger sets the `integrity_error` of the outbox (by which the
        engine reaches its store), after which every part is verified, and a damaged trace is
        reported by an event (a row in the store's log). Once it is in force, new labels count from
        zero, since the version knows all labels until now. A retrain that was requested before is
        not begun any more. If the next training starts from another model, a thread begins to
        precompute for it; without an executor (a pool in which retrains run beside the engine) this
        call waits for the thread.

        A baseline (a model that the user handed in), which is fitted again, gets the labels as they
        count now, since it cannot take a label back. The model takes over the decision rule in
        force; an exception of this is logged.

        Raises StoreError if the version is not kept or is damaged, if a trace is damaged that the
        model must be fitted on again, and if the version cannot be stored, also because another
        robot cell that shares versions with this one stored one meanwhile; and what `restore_model`
        raises.
        """
        begin = self._clock()
        self._outbox.check_integrity()
        version = self._store.versions.load(number)
        template = self.live.template
        trained_on = TrainedOn.from_state(version.state)
        if not template.keeps_references:
            trained_on = replace(trained_on, corrected_to=self.live.corrected_to)
        model = restore_model(self._outbox, template, version, trained_on)
        guarded(NOT_READY, model.prepare, self.live.newest)
        newest = self._window.newest_seq
        add_labels_since(model, self._store, version, self._window.capacity, shared_to=newest)
        trained_on = replace(trained_on, counts_from=newest, pinned=number)
        self._store_and_swap_in(
            event, model, trained_on, f"rolled back to version {number}", self._clock() - begin
        )
        self._is_requested = False  # what was asked for was to replace another version
        self.feedback.count_new_labels(newest)
        self._precompute_other_start()

    def set_policy(self, policy: Policy | None, evidence: EvidenceWindow, event: Change) -> None:
        """Go on under another policy, as a new version of the same model.

        The version is stored with `event`, and `take_report` then returns a report of it. With
        `policy` the decision rule (which turns the bounds of a success probability into an action)
        starts anew and counts the decisions that `evidence` names. With None only settings outside
        the model have changed, and its rule goes on. Before the first retrain only the event is
        stored. A failure to make the model with the new rule ready is logged. Raises SettingError
        if the rule cannot be made, or the recipe (the settings) of another cell of the product
        (robot cells that share labels and versions) cannot be read; StoreError if the event cannot
        be stored, also because another cell of the product stored a version meanwhile; and what the
        constructor of a user's rule raises, except TypeError. After each of these errors nothing is
        changed.
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
        live.change_template(template)

    def _store_and_swap_in(
        self, event: Change, model: EngineModel, trained_on: TrainedOn, reason: str, seconds: float
    ) -> None:
        """Store a model as the next version, with the event of a person's change; put it in force.

        `take_report` then returns a report of it, accepted, with `reason` and `seconds`; this
        empties `dropped`, the list of reasons why retrains were dropped. If the version cannot be
        stored, also because another robot cell that shares versions with this one stored one
        meanwhile, StoreError is raised and nothing changes.
        """
        report = RetrainReport(
            self.live.next_version, seconds, len(trained_on.seq), 0, True, reason
        )
        self._store.corrections.apply(
            replace(
                event,
                version=(report, self._window.newest_seq, self.live.get_state(model, trained_on)),
            )
        )
        self.live.swap_in(model, report.version, trained_on)
        self._report = report
        self._note_outcome(report)
