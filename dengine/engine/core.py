"""`EngineCore`, the inside of `DataEngine`: it makes the engine's objects, and calls them in order
for each decision, each report and each retrain.

`DataEngine` is the public face of `EngineCore`. `dengine serve` uses the core itself, by
`engine.core_of`, for what only a server needs: a decision that must not wait, one that came too
late, retrains step by step, and the state of the store.
"""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import replace
from types import FrameType
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from ..errors import ExportError, NotTakenError, StoreError, UnknownDecisionError
from ..history.status import Status, retrain_fault
from ..model.base import N_EXAMPLES, EngineModel, Exportable
from ..records import (
    Action,
    Decision,
    PartNumber,
    Reason,
    RetrainReport,
    TraceArray,
    TraceSpec,
    as_id,
    as_success,
)
from ..store.journalled import CLOSE_SECONDS
from ..store.opening import open_outbox
from ..store.records import StoredDecision
from ..traces import convert_trace
from .decide import DecisionMaker, as_part, check_same_trace, verify_decision
from .feedback import Feedback
from .fleet import Peers
from .guard import GuardedModel
from .labels import CellLabels, ProductLabels
from .learner import Learner
from .live_model import LiveModel
from .settings import EngineSettings, SettingsInForce, read_peers_trace_spec
from .trainer import Clock, Limits, Retrainer, TrainingWindow

if TYPE_CHECKING:
    from ..store.sql import SqlStore

log = logging.getLogger("dengine")


class ExclusiveUse:
    """A reentrant block that one thread enters at a time, and that SIGINT does not interrupt.

    Entering it while another thread is inside raises StoreError at once. A SIGINT that comes
    meanwhile is handled when the block ends, so that a label is stored and counted, or neither.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._handlers: list[Any] = []  # of SIGINT before each block, of blocks within one another
        self._delayed: list[tuple[int, FrameType | None]] = []

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            raise StoreError(
                "Expected an engine that one thread uses, got a call while another thread "
                "is in one; use it in one thread."
            )
        try:
            # Python delivers signals to the main thread alone. An ignored signal interrupts
            # nothing, nor does one that C code handles.
            is_main = threading.current_thread() is threading.main_thread()
            handler = signal.getsignal(signal.SIGINT) if is_main else None
            if callable(handler):
                signal.signal(signal.SIGINT, self._delay)
        except BaseException:
            self._lock.release()
            raise
        self._handlers.append(handler)

    def _delay(self, number: int, frame: FrameType | None) -> None:
        """Remember a SIGINT; `__exit__` passes the first to the handler that was set before the
        block.
        """
        self._delayed.append((number, frame))

    def __exit__(self, *exception: object) -> None:
        handler = self._handlers.pop()
        try:
            if callable(handler):
                signal.signal(signal.SIGINT, handler)
                delayed = self._delayed
                self._delayed = []
                if delayed:
                    handler(*delayed[0])
        finally:
            self._lock.release()


class EngineCore:
    """The objects of one engine, and the way of a decision and of a report through them.

    Parameters
    ----------
    settings : EngineSettings
    template : EngineModel
        Untrained; the first version is trained from it.
    store : SqlStore
    executor : concurrent.futures.Executor, optional
        Trains while the cell goes on; None: train in the calling thread.
    replaying : bool
        End a retrain by steps alone, and wait for the store without a time limit, so that a seed
        repeats exactly.
    clock : callable
        Seconds, of any origin, by which retrains are timed.
    on_safe_mode : callable, optional
        As `DataEngine` takes it.
    reading : bool
        Only read a store that another engine may own.

    Attributes
    ----------
    exclusive : ExclusiveUse
        Held by every call that decides or learns.
    settings : SettingsInForce
    live : LiveModel
    learner : Learner
    feedback : Feedback
    outbox : Outbox
    """

    def __init__(
        self,
        settings: EngineSettings,
        template: EngineModel,
        store: SqlStore,
        executor: Executor | None = None,
        replaying: bool = False,
        clock: Clock = time.perf_counter,
        on_safe_mode: Callable[[str], object] | None = None,
        reading: bool = False,
    ) -> None:
        torch.set_num_threads(1)
        self._retrains_in_line = executor is None and not reading
        if self._retrains_in_line:
            template.warm_up()  # or the first retrain would wait for it
        recipe = settings.recipe
        self.store = store
        self.clock = clock
        self.exclusive = ExclusiveUse()
        self.outbox = open_outbox(store, recipe.window, reading=reading, patient=replaying)
        self.settings = SettingsInForce(settings, self.outbox)
        window = TrainingWindow(recipe.window)
        self.live = LiveModel(template, window, self.outbox, settings.evidence)
        labels: CellLabels | ProductLabels = CellLabels(window)
        peers = None
        if store.product is not None:
            labels = ProductLabels(window, self.live)
            peers = Peers(self.outbox, self.live, window, labels, clock)
        self.feedback = Feedback(self.outbox, self.live, labels, self.settings, on_safe_mode)
        limits = Limits(None if replaying else recipe.budget, recipe.max_steps)
        retrainer = Retrainer(window, limits, executor, clock)
        self.learner = Learner(
            self.outbox, self.live, window, labels, self.feedback, peers, retrainer, clock
        )
        self._maker = DecisionMaker(self.settings, store.clock)
        self._is_first_trace = True
        self._warm_up = threading.Thread(target=template.warm_up, name="dengine-warm-up")
        if executor is not None:
            self._warm_up.start()

    def wait_until_warm(self) -> None:
        """Wait until the first retrain can begin at once.

        When it returns, the modules that a retrain imports are loaded, and the features of stored
        traces that a retrain would compute first are computed. If there are labels but no version,
        the computation begins here, and the code for decisions is compiled where it can be.
        """
        self._join_warm_up()
        if self.new_labels and not self.live.version:
            self.learner.precompute()
        self.learner.wait_until_precomputed()

    def _join_warm_up(self) -> None:
        """Wait until what a retrain imports is loaded."""
        if self._warm_up.ident is not None:
            self._warm_up.join()

    def resume(self) -> None:
        """Restore what the store holds: version, references, rule, labels and pending checks.

        The engine then decides bit for bit as before it was closed. In a new cell it decides as the
        other cells of its product do. It is called once, before the first decision, and waits for
        the store without a time limit. Where retrains run in the calling thread, it also calls
        `wait_until_warm`.
        """
        settings = self.settings.now
        self.learner.resume(settings.recipe.policy.label_within, settings.policy_since)
        self.feedback.resume()
        if self._retrains_in_line:
            self.wait_until_warm()

    # A decision

    def decide(
        self,
        trace: ArrayLike,
        part: PartNumber = None,
        decision_id: str | None = None,
        timed_out: bool = False,
    ) -> Decision:
        """Decide on one trace, record the decision and return it, as `DataEngine.decide` says.

        With an id, an ACCEPT or REJECT is on disk when this returns. An id that has a decision
        already gets it back, and nothing else happens; TraceError if the trace is another one. An
        id that cannot be looked up gets a VERIFY that is not recorded. With `timed_out` the caller
        has given up waiting, so the decision is VERIFY, `Reason.LATE`, unless a fault of the trace,
        or of the store, is the reason.

        Before it decides, the call takes a short step with a version that the executor has trained
        (where cells share a product, all steps), rebuilds the rule where that is due, and counts
        earlier accepted parts without a report as confirmed or unobserved. Afterwards it announces
        a safe mode that began or ended. Raises TraceError for a wrong trace or part's number,
        SettingError for a first trace that the force limits do not fit, ReportError for what is no
        id, and StoreError for an engine that is closed, only reads, or is in use by another thread.
        """
        self.outbox.check_usable()
        with self.exclusive:
            id_ = None if decision_id is None else as_id(decision_id)
            number = as_part(part)
            if id_ is not None:
                try:
                    earlier = self.outbox.find_earlier(id_)
                except StoreError as error:
                    return self._verify_unrecorded(id_, number, error)
                if earlier is not None:
                    return check_same_trace(earlier, trace, self.settings.now.trace)
            self.learner.collect()
            stored = self._record(trace, number, timed_out, id_)
            if id_ is not None:
                stored = self._sync_decision(stored)
            self.feedback.record_decision(stored)
            self.feedback.announce_safe_mode()
        return stored.decision

    def try_decide(self, trace: ArrayLike, part: PartNumber = None) -> Decision | None:
        """Decide as `decide` without an id, but only where nothing has to be waited for; else
        return None.

        It returns None, and changes nothing, where the outbox is locked, before the first trace,
        while settings are unsaved or the rule must be rebuilt, and where the model is a baseline,
        uses classes of the user's, or is not compiled. The decision is recorded in memory and goes
        to the disk later. Any thread may call it while no other uses the engine, and has one torch
        thread from then on. Swapping versions and announcing safe mode are left to
        `process_retrains`. Raises TraceError for a wrong trace or part's number, and StoreError for
        an engine that is closed, only reads, or is in use by another thread.
        """
        self.outbox.check_usable()
        with self.outbox.try_lock() as is_free, self.exclusive:
            answering = self.live.answering
            is_own_code = (
                self.live.newest.keeps_references and not self.settings.now.recipe.user_classes
            )
            is_quick = is_own_code and (answering is None or answering.is_compiled)
            has_work = self._is_first_trace or self.settings.is_unsaved or self.feedback.remedy
            if not (is_free and is_quick) or has_work:
                return None
            torch.set_num_threads(1)  # it holds for the present thread only
            stored = self._record(trace, as_part(part))
            self.feedback.record_decision(stored)
            return stored.decision

    def record_timeout(
        self, trace: ArrayLike, part: PartNumber = None, *, decision_id: str
    ) -> Decision:
        """Record VERIFY, `Reason.LATE`, for a caller that gave up waiting, without asking the
        model.

        A fault of the trace, or of the store, is the reason instead. Returns the recorded decision
        once it is on disk, or when the store's time limit is over; an id that has a decision
        already gets that one. It may be called in any thread, also during another call. With a
        store in memory, before the first trace, and where the id cannot be looked up, a VERIFY is
        returned that is not recorded; in the first two cases `decide` must record it, with
        `timed_out`. Raises TraceError for a wrong trace or part's number and for an id of another
        trace, ReportError for what is no id, and StoreError for a closed engine.
        """
        self.outbox.check_usable()
        id_ = as_id(decision_id)
        number = as_part(part)
        spec = self.settings.now.trace
        try:
            stored = self.outbox.find_earlier(id_)
        except StoreError as error:
            return self._verify_unrecorded(id_, number, error)
        if stored is None:
            if spec is None or not self.outbox.is_thread_safe:
                return verify_decision(id_, number, self.live.version, Reason.LATE)
            reason = Reason.NO_STORE if self.outbox.verify_all_reason else Reason.LATE
            x = convert_trace(trace, spec, False)
            item = self._maker.decide(x, number, None, self.live.version, reason, id_)
            stored = self.outbox.record_decision(item)
        with suppress(NotTakenError):
            self.outbox.sync()
        return check_same_trace(stored, trace, spec)

    def _record(
        self,
        trace: ArrayLike,
        part: str | None,
        timed_out: bool = False,
        decision_id: str | None = None,
    ) -> StoredDecision:
        """Decide on a trace and hand the decision to the outbox, without waiting until it is on
        disk.

        Before that, `Learner.catch_up` is called, and accepted parts without a report count as
        confirmed or unobserved. The decision is VERIFY where `timed_out` (`Reason.LATE`), and where
        the store is damaged or its journal cannot be written (`Reason.NO_STORE`); a fault of the
        trace is the reason instead. Returns the record with its number, 0 where it could not be
        recorded. Raises TraceError for a wrong shape, and SettingError for a first trace that the
        force limits do not fit.
        """
        x = self._check_trace(trace)
        self.learner.catch_up()
        self.feedback.confirm_silent()
        reason = Reason.LATE if timed_out else None
        if self.outbox.verify_all_reason:
            reason = Reason.NO_STORE
        version = self.live.version
        item = self._maker.decide(x, part, self.live.answering, version, reason, decision_id)
        return self.outbox.record_decision(item)

    def _sync_decision(self, stored: StoredDecision) -> StoredDecision:
        """Wait until a decision is on disk, and return the record that counts.

        Where the disk does not answer in time, an ACCEPT or REJECT is replaced in the outbox by
        VERIFY, `Reason.NO_STORE`, unless it has reached the disk by then. A VERIFY stays as it is.
        """
        try:
            self.outbox.sync()
        except NotTakenError:
            # A decision that lets a part go on unchecked must outlive this process, or its id would
            # have two answers.
            decision = stored.decision
            if decision.action is not Action.VERIFY:
                item = self._maker.decide(
                    stored.trace,
                    decision.part,
                    None,
                    self.live.version,
                    Reason.NO_STORE,
                    decision.id,
                )
                return self.outbox.replace_decision(item)
        return stored

    def _verify_unrecorded(self, decision_id: str, part: str | None, error: StoreError) -> Decision:
        """Return VERIFY, `Reason.NO_STORE`, for an id that cannot be looked up, and log a warning.

        The id may have a decision already, so nothing is recorded. `error` says why the look-up
        failed.
        """
        log.warning(
            "whether %r was decided before cannot be looked up; it is verified: %s",
            decision_id,
            error,
        )
        return verify_decision(decision_id, part, self.live.version, Reason.NO_STORE)

    # The contract of traces

    def set_trace_spec(self, spec: TraceSpec, inferred: bool = False) -> TraceSpec:
        """Set the trace contract (shape, rate and unit of all traces) and return the one in force.

        One that is set already stays, completed by what `spec` states and it does not. Where the
        cell shares a product with others, a contract that these have set is taken in place of
        `spec`, unless it cannot be read. `inferred` says that `spec` comes from a first trace. The
        settings are saved in the store; where that fails, they are saved with a later trace. Raises
        SettingError where the force limits do not fit the contract, and StoreError for an engine
        that is closed, only reads, or is in use by another thread.
        """
        self.outbox.check_usable()
        with self.exclusive:
            present = self.settings.now
            agreed = present.trace
            try:
                if agreed is None and self.store.product is not None:
                    agreed = self.outbox.call_store(lambda: read_peers_trace_spec(self.store))
            except StoreError:  # the cell's own first trace stands
                log.exception("the product's contract of traces cannot be had")
            spec = spec if agreed is None else agreed.completed(spec)
            if spec != present.trace:
                inferred = inferred or present.inferred
                self.settings.change(replace(present, trace=spec, inferred=inferred))
                self.settings.save()
        return spec

    def _check_trace(self, trace: ArrayLike) -> TraceArray:
        """Return a trace as float32, shape (channels, samples), converted as the trace contract
        demands.

        Where none is set, the first trace without a fault sets it, or a contract that peers have
        set is taken. The first finite trace also has an untrained model compute in advance.
        Settings that could not be saved before are saved. Raises TraceError for a wrong shape, or
        too few samples of a first trace, and SettingError where the force limits do not fit the
        contract that it sets; a trace with NaN, or another fault, is returned like any other.
        """
        settings = self.settings.now
        has_learned = self.live.version + self.learner.labels.new_labels > 0
        x = convert_trace(trace, settings.trace, settings.inferred and not has_learned)
        spec = self._maker.infer_trace_spec(x, trace) if settings.trace is None else None
        if spec is not None:
            if self.set_trace_spec(spec, inferred=True) != spec:  # a peer's trace came first
                return convert_trace(trace, self.settings.now.trace, False)
        elif self.settings.is_unsaved:
            self.settings.save()
        if self._is_first_trace and self.settings.now.trace is not None and np.isfinite(x).all():
            self._is_first_trace = False
            if not self.live.version:  # what will answer is compiled before there is much to do
                GuardedModel(self.live.template).precompute(x[None])
        return x

    # A report, and what follows from it

    def report(
        self, decision_id: str, success: bool, trace: ArrayLike | None, part: PartNumber
    ) -> RetrainReport | None:
        """Learn the outcome of a decision; return the report of a retrain done here for it, or
        None.

        `trace` and `part` are used only where the decision is unknown and `success` is False. A
        version that the executor has trained first comes a step further. The label is on disk when
        this returns; NotTakenError is raised where that is not certain. Before it returns, a
        retrain that is due is done in this thread, or begun in the executor. The label of a trace
        with a fault is stored, and sets off no retrain. Raises ReportError for an unknown id, a
        second report or what is no label, TraceError for a wrong `trace` or `part`, and StoreError
        for an engine that is closed, only reads, or is in use by another thread.
        """
        label = as_success(success)  # refused before anything is written
        id_ = as_id(decision_id)
        self.outbox.check_usable()
        with self.exclusive:
            self.learner.collect()
            stored = self.outbox.find_decision(id_, unsynced=True)
            if stored is None:
                stored = self._record_lost_accept(id_, label, trace, part)
            self.learner.report(stored, label)
            if stored.quarantined:
                return None
            return self.learner.retrain_if_due(self.settings.now.recipe)

    def _record_lost_accept(
        self, decision_id: str, success: bool, trace: ArrayLike | None, part: Any
    ) -> StoredDecision:
        """Record an ACCEPT under this id for a line stop whose decision was lost; return the
        record.

        Raises UnknownDecisionError if `trace` is None or `success` is True, and TraceError for a
        wrong trace or part's number; then nothing is recorded.
        """
        if trace is None or success:
            raise UnknownDecisionError(
                f"Expected the id of a decision of this cell, got {decision_id!r}, which is "
                "unknown; "
                "a system stop whose decision was lost can be reported with its trace."
            )
        x = self._check_trace(trace)
        item = self._maker.lost_accept(x, as_part(part), self.live.version, decision_id)
        stored = self.outbox.record_decision(item)
        self.feedback.record_decision(stored)
        return stored

    def retrain(self) -> RetrainReport:
        """Retrain in this thread and return the report, as `DataEngine.retrain`."""
        self.outbox.check_usable()
        with self.exclusive:
            self._join_warm_up()
            return self.learner.retrain()

    def start_retrain(self) -> RetrainReport | None:
        """Begin to retrain in the executor and return None, also while a retrain is under way.

        Without an executor that takes work, retrain in this thread and return the report. Raises
        StoreError where the labels before it cannot be stored.
        """
        return self.learner.start_retrain()

    def process_retrains(self, brief: bool = False) -> RetrainReport | None:
        """Do between two parts what is due: swap in a trained version, retrain, announce safe mode.

        A version that the executor has trained is brought to its end, so that it answers or is
        dropped; with `brief`, in a cell that learns alone, it comes only one step further, a few
        milliseconds. A retrain that is due begins in the executor, or without one runs here.
        Returns the newest report, of a retrain that was accepted or dropped, a rollback or a new
        policy; None if this method has returned it before. `report` and `retrain` may have returned
        it, too. Raises StoreError while another thread uses the engine.
        """
        with self.exclusive:
            self.learner.collect(to_the_end=not brief)
            self.learner.retrain_if_due(self.settings.now.recipe, once=True)
            self.feedback.announce_safe_mode()
            return self.learner.take_report()

    # The store

    def load_decision_ids(self) -> None:
        """Flush, then load the ids of all decisions, so that `decide` need not look up a new id in
        the store.

        It takes a second for a million decisions. Raises NotTakenError as `flush`.
        """
        self.flush()
        self.outbox.load_ids()

    def flush(self, wait: float | None = None) -> None:
        """Wait until everything recorded is on disk, and in the store if that answers in time.

        Labels of silently confirmed parts, which wait in memory, are recorded first, so that they
        are in the training window afterwards. Raises NotTakenError after
        `wait` seconds; None: the store's own limit.
        """
        self.feedback.store_pending()
        self.outbox.flush(wait)
        self.learner.catch_up()

    def close(self) -> None:
        """Finish or give up a retrain under way within `CLOSE_SECONDS`, write everything, close the
        store.

        A second call does nothing. What the journal cannot take is given up. Raises StoreError
        while another thread uses the engine.
        """
        with self.exclusive:
            if self.outbox.is_usable:
                self.feedback.store_pending()
                self.learner.collect(CLOSE_SECONDS)
            self.outbox.close()

    def exported(self, trace: TraceSpec | None = None) -> Exportable:
        """Return the model that answers, with its settings, as an exporter takes it.

        It is no copy: the model goes on learning. `trace` replaces the trace contract in force.
        Raises ExportError before the first retrain, for a baseline, and where the store was changed
        from outside.
        """
        if self.outbox.integrity_error:
            error = self.outbox.integrity_error
            raise ExportError(f"Expected a store as it was written, to export from: {error}")
        settings = self.settings.now
        policy = settings.recipe.policy
        return replace(
            self.live.newest.exported(trace or settings.trace),
            audit_rate=policy.audited_share,
            seed=settings.seed,
            stops_all=policy.stops == "all",
            windows=policy.limits,
            model_version=self.live.version,
            recipe=settings.recipe.to_toml(),
            examples=self.live.window.snapshot().traces[-N_EXAMPLES:],
            note=self.outbox.record_event,
        )

    # What only the running engine knows

    @property
    def new_labels(self) -> int:
        """Labels since the last retrain began."""
        return self.learner.labels.new_labels

    @property
    def is_retraining(self) -> bool:
        """Whether a retrain is under way in the executor, or its version waits to be swapped in."""
        return self.learner.is_busy

    @property
    def is_swapping(self) -> bool:
        """Whether a trained version is being swapped in, one step with each call of the engine."""
        return self.learner.is_swapping

    @property
    def store_fault(self) -> str:
        """Why the store, or its journal, cannot be written at present; "" where both can."""
        return self.outbox.fault

    @property
    def store_lag(self) -> float:
        """Age in seconds of the oldest journal record that is not in the store; 0.0 if none."""
        return self.outbox.lag

    @property
    def retrain_fault(self) -> str:
        """What is wrong if retrains are dropped again and again; "" if they are not."""
        return retrain_fault(self.learner.dropped, self.live.version)

    def complete_status(self, status: Status) -> Status:
        """Return a copy of a status read from the store, with what only the engine knows put in.

        That is version, shadow and safe mode, new labels, fault and lag of the store, and whether a
        retrain is under way.
        """
        return replace(
            status,
            version=self.live.version,
            shadow=self.settings.now.recipe.policy.shadow,
            safe_mode=self.live.newest.safe_mode,
            new_labels=self.new_labels,
            store_fault=self.store_fault,
            store_lag=self.store_lag,
            retraining=self.is_retraining,
        )
